"""Reading text with RapidOCR (PP-OCR's networks): the extra `ocr`, `pip install turbnet[ocr]`; runs offline.

Two ways. Either each box is cut out and read as a line, in eight bits, without looking for text in it or turning it
upright. Or the whole picture is searched, and what is found with its middle inside a box counts as read there: harder,
since text must first be recognised as such, and the nearer to what a user of the picture would do. Source:
https://github.com/RapidAI/RapidOCR (code and networks under the Apache licence 2.0).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from turbnet.data.boxes import TextBox
from turbnet.errors import InputError
from turbnet.metrics.text import Picture, crop_boxes


class RapidReader:
    """Reads the boxes of a picture.

    Args:
        find: search the whole picture for text, instead of reading each box as a line.
        threads: processor threads.

    Raises:
        InputError: the extra `ocr` is not installed.
    """

    def __init__(self, find: bool = False, threads: int = 1) -> None:
        try:
            from rapidocr import RapidOCR
        except ImportError as error:
            raise InputError(
                "reading text with rapidocr needs the extra 'ocr': pip install 'turbnet[ocr]', or choose another reader"
            ) from error
        engine = "EngineConfig.onnxruntime."
        threading = {engine + "intra_op_num_threads": threads, engine + "inter_op_num_threads": 1}
        self._read: Any = RapidOCR(params={"Global.log_level": "critical", **threading})
        self._find = find

    def __call__(self, picture: Picture, boxes: Sequence[TextBox]) -> list[str]:
        """What stands in each box of a picture (H, W, 3), sRGB in [0, 1]; empty where nothing was read.

        Raises:
            InputError: a box does not lie inside the picture, the picture holds NaN.
        """
        crops = crop_boxes(picture, boxes)
        return self._found(picture, boxes) if self._find else [self._line(crop) for crop in crops]

    def _line(self, crop: Picture) -> str:
        return " ".join(self._read(_pixels(crop), use_det=False, use_cls=False, use_rec=True).txts or ())

    def _found(self, picture: Picture, boxes: Sequence[TextBox]) -> list[str]:
        found = self._read(_pixels(picture), use_det=True, use_cls=False, use_rec=True)
        outlines = () if found.boxes is None else found.boxes
        middles = [(*np.mean(outline, axis=0), text) for outline, text in zip(outlines, found.txts or (), strict=True)]
        return [
            " ".join(
                text
                for x, y, text in sorted(middles)
                if 0 <= x - box.left <= box.width and 0 <= y - box.top <= box.height
            )
            for box in boxes
        ]


def _pixels(picture: Picture) -> NDArray[np.uint8]:
    """Eight bits as OpenCV has them: blue, green, red."""
    return np.ascontiguousarray(np.rint(np.clip(picture, 0, 1) * 255).astype(np.uint8)[..., ::-1])
