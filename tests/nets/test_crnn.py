import itertools

import pytest
import torch
import torch.nn.functional as F

from turbnet.data.words import ALPHABET
from turbnet.nets.crnn import BLANK, CRNN, LINE_HEIGHT, STRIDE, decode, encode


@pytest.mark.parametrize("width", [STRIDE, 7 * STRIDE, 30 * STRIDE])
def test_shape_and_probabilities(width):
    scores = CRNN((4, 6, 8, 8, 8), 5)(torch.rand(2, 1, LINE_HEIGHT, width))
    assert scores.shape == (2, width // STRIDE, 1 + len(ALPHABET))
    torch.testing.assert_close(scores.exp().sum(-1), torch.ones(2, width // STRIDE))


def test_brightness_and_contrast_do_not_matter():
    network = CRNN((4, 6, 8, 8, 8), 5).eval()
    lines = torch.rand(1, 1, LINE_HEIGHT, 40)
    torch.testing.assert_close(network(0.2 + 0.5 * lines), network(lines), atol=2e-2, rtol=0)


def test_decoding():
    a, b = encode("ab")
    assert decode([BLANK, a, a, BLANK, a, b, b, BLANK]) == "aab"
    assert decode([]) == ""
    assert decode(encode(ALPHABET)) == ALPHABET


def test_loss_is_the_sum_over_spellings():
    """CTC by brute force: every path of four steps over three classes that decodes to "01"."""
    scores = torch.log_softmax(torch.randn(4, 1, 3, generator=torch.Generator().manual_seed(0)), -1)
    target = encode("01")
    total = sum(
        float(scores[range(4), 0, list(path)].sum().exp())
        for path in itertools.product(range(3), repeat=4)
        if decode(path) == "01"
    )
    loss = F.ctc_loss(scores, torch.tensor([target]), torch.tensor([4]), torch.tensor([2]), reduction="sum")
    assert float(loss) == pytest.approx(-torch.tensor(total).log().item(), rel=1e-5)
