"""Reading text with RapidOCR (PP-OCR's networks): the extra `ocr`, `pip install turbnet[ocr]`; runs offline.

A crop goes to the recogniser as it is, in eight bits; text is neither looked for nor turned upright. Source:
https://github.com/RapidAI/RapidOCR (code and networks under the Apache licence 2.0).
"""

from collections.abc import Sequence

import numpy as np

from turbnet.errors import InputError
from turbnet.metrics.text import Picture


class RapidReader:
    """Reads crops of one word or line each.

    Args:
        threads: processor threads.

    Raises:
        InputError: the extra `ocr` is not installed.
    """

    def __init__(self, threads: int = 1) -> None:
        try:
            from rapidocr import RapidOCR
        except ImportError as error:
            raise InputError(
                "reading text with rapidocr needs the extra 'ocr': pip install 'turbnet[ocr]', or choose another reader"
            ) from error
        engine = "EngineConfig.onnxruntime."
        threading = {engine + "intra_op_num_threads": threads, engine + "inter_op_num_threads": 1}
        self._read = RapidOCR(params={"Global.log_level": "critical", **threading})

    def __call__(self, crops: Sequence[Picture]) -> list[str]:
        """What stands in each crop (H, W, 3), sRGB in [0, 1]; empty where nothing was read."""
        texts = []
        for crop in crops:
            pixels = np.rint(np.clip(crop, 0, 1) * 255).astype(np.uint8)[..., ::-1]  # as OpenCV has them: B, G, R
            found = self._read(np.ascontiguousarray(pixels), use_det=False, use_cls=False, use_rec=True)
            texts.append(" ".join(found.txts or ()))
        return texts
