r"""A small convolutional recurrent network that reads one line of text, and what its answer means.

A picture of a line, LINE_HEIGHT pixels high, becomes a score for each character or none ("blank") every four columns.
The probability of a text is the sum over all ways of spelling it out with repeated characters and blanks between
(connectionist temporal classification), which is also the loss it learns by:

.. math::  p(\text{text} \mid x) = \sum_{\pi \to \text{text}} \prod_t p(\pi_t \mid x)

Sources: Shi, Bai & Yao, IEEE Trans. Pattern Anal. Mach. Intell. 39, 2298 (2017); Graves et al., ICML (2006). As there,
the characters are digits and letters without regard to case.
"""

from collections.abc import Iterable

import torch
from torch import Tensor, nn

from turbnet.data.words import ALPHABET

BLANK = 0
LINE_HEIGHT = 32
STRIDE = 4
"""Columns of the picture a step of the answer."""


class CRNN(nn.Module):
    """Reads lines: (B, 1, LINE_HEIGHT, W) grey values -> (B, W / STRIDE, 1 + len(ALPHABET)) log-probabilities.

    Args:
        widths: channels after each of the five convolutions.
        hidden: units of the recurrent layer, each way.

    W must be a multiple of STRIDE. Brightness and contrast of a line do not matter: it is brought to mean 0, variance 1.
    """

    def __init__(self, widths: tuple[int, int, int, int, int] = (24, 48, 80, 96, 96), hidden: int = 64) -> None:
        super().__init__()
        self.widths, self.hidden = widths, hidden
        a, b, c, d, e = widths

        def convolution(inner: int, outer: int, kernel: tuple[int, int], stride: int = 1) -> nn.Sequential:
            padding = (0 if kernel[0] == 4 else 1, 1)
            layer = nn.Conv2d(inner, outer, kernel, stride, padding, bias=False)
            return nn.Sequential(layer, nn.BatchNorm2d(outer), nn.ReLU())

        self.features = nn.Sequential(
            convolution(1, a, (3, 3), stride=2),
            convolution(a, b, (3, 3)),
            nn.MaxPool2d(2),
            convolution(b, c, (3, 3)),
            nn.MaxPool2d((2, 1)),
            convolution(c, d, (3, 3)),
            convolution(d, e, (4, 3)),  # what is left of the height
        )
        self.context = nn.GRU(e, hidden, bidirectional=True, batch_first=True)
        self.head = nn.Linear(2 * hidden, 1 + len(ALPHABET))

    def forward(self, lines_B1HW: Tensor) -> Tensor:
        mean = lines_B1HW.mean((-2, -1), keepdim=True)
        deviation = (lines_B1HW - mean).square().mean((-2, -1), keepdim=True).sqrt()
        features = self.features((lines_B1HW - mean) / (deviation + 1e-3))
        context, _ = self.context(features.squeeze(2).transpose(1, 2))
        return torch.log_softmax(self.head(context).float(), dim=-1)


def encode(text: str) -> list[int]:
    """Indices of the characters of a text made of ALPHABET; 0 is the blank."""
    return [1 + ALPHABET.index(character) for character in text]


def decode(indices: Iterable[int]) -> str:
    """The text of the best character of each step: repetitions are one, blanks are none."""
    text, last = "", BLANK
    for index in indices:
        if index not in (BLANK, last):
            text += ALPHABET[index - 1]
        last = index
    return text
