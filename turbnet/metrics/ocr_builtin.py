"""Reading text with the network that comes with turbnet: no extra packages, digits and letters without case.

It is a small convolutional recurrent network (`turbnet.nets.crnn`), trained by tools/train_recogniser.py and run by
onnxruntime. A crop becomes grey, 32 pixels high, in its own proportions; the best character of each step, repetitions
and blanks taken out, is the text. Needs neither torch nor lightning.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from turbnet.data.boxes import TextBox
from turbnet.deploy.card import RecogniserCard
from turbnet.deploy.seal import verify
from turbnet.deploy.session import LARGEST, open_session
from turbnet.deploy.weights import released_recogniser
from turbnet.errors import InputError
from turbnet.media.guard import read_bytes
from turbnet.metrics.text import Picture, crop_boxes

_GREY = np.array([0.299, 0.587, 0.114])


class Recogniser:
    """Reads the boxes of a picture, one word or line each.

    Args:
        data: the bytes of a sealed recogniser.
        threads: processor threads.

    Raises:
        InputError: the bytes are no recogniser of turbnet, or were changed.
    """

    def __init__(self, data: bytes, threads: int = 1) -> None:
        verify(data)
        self._session = open_session(data, threads)
        self.card = RecogniserCard.from_metadata(self._session.get_modelmeta().custom_metadata_map)

    @classmethod
    def load(cls, path: str | Path | None = None) -> "Recogniser":
        """Read the recogniser in the file `path`; None: the one that comes with turbnet.

        Raises:
            InputError: names the file and what is wrong with it.
        """
        path = released_recogniser() if path is None else path
        data = read_bytes(path, LARGEST, "the recogniser ")
        try:
            return cls(data)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error

    def __call__(self, picture: Picture, boxes: Sequence[TextBox]) -> list[str]:
        """What stands in each box of a picture (H, W, 3) or (H, W, 1), sRGB in [0, 1].

        Raises:
            InputError: a box does not lie inside the picture, the picture holds NaN.
        """
        lines = [self.line(crop)[None, None] for crop in crop_boxes(picture, boxes)]
        return [self._decode(self.scores(line)[0].argmax(-1)) for line in lines]

    def scores(self, lines_B1HW: NDArray[np.float32]) -> NDArray[np.float32]:
        """Log-probabilities (B, W / stride, classes) of lines (B, 1, line_height, W)."""
        scores: NDArray[np.float32] = self._session.run(["scores"], {"lines": lines_B1HW})[0]
        return scores

    def line(self, crop: Picture) -> NDArray[np.float32]:
        """The crop in grey at the height of the network, (line_height, W), W a multiple of the stride."""
        grey = np.asarray(crop @ _GREY if crop.shape[-1] == 3 else crop[..., 0], dtype=np.float32)
        height, stride = self.card.line_height, self.card.stride
        width = stride * max(2, round(grey.shape[1] * height / grey.shape[0] / stride))
        image = Image.fromarray(grey).resize((width, height), Image.Resampling.BILINEAR)
        return np.asarray(image, dtype=np.float32)

    def _decode(self, classes: Any) -> str:
        changes = np.flatnonzero(np.diff(classes, prepend=-1))
        return "".join(self.card.alphabet[k - 1] for k in classes[changes] if k)
