"""A released network at work: NumPy in, NumPy out. Needs onnxruntime only, neither torch nor onnx."""

import os
from pathlib import Path

import numpy as np
import onnxruntime

from turbnet.deploy.card import ModelCard
from turbnet.deploy.seal import verify
from turbnet.errors import InputError, check_range

INPUT, OUTPUT = "frames", "restored"
NEXT = "next_"
"""Before the name of what is carried on to the next frame, as an output."""

Carried = dict[str, np.ndarray]
"""What a network that goes frame by frame takes along, by name."""


class Model:
    """A network read from a sealed ONNX file.

    Args:
        data: the bytes of the file; the seal is checked before onnxruntime sees them.
        threads: processor threads of one call; None: every core this process may use.

    Raises:
        InputError: the bytes are no turbnet model, were changed, or are beyond the installed onnxruntime.
    """

    def __init__(self, data: bytes, threads: int | None = None) -> None:
        self.digest = verify(data)
        self.threads = int(check_range("threads", available_cores() if threads is None else threads, 1, 1024))
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = self.threads
        options.inter_op_num_threads = 1
        options.log_severity_level = 4  # errors reach the user as InputError, not through onnxruntime's log
        # Activations that fade into denormal numbers slow a processor down tenfold.
        options.add_session_config_entry("session.set_denormal_as_zero", "1")
        # Between two calls the cores belong to the decoder and the encoder, not to threads that spin.
        options.add_session_config_entry("session.force_spinning_stop", "1")
        try:
            self._session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's errors share no narrower base class
            raise InputError(f"onnxruntime {onnxruntime.__version__} cannot run the model: {error}") from error
        self.card = ModelCard.from_metadata(self._session.get_modelmeta().custom_metadata_map)

    @classmethod
    def load(cls, path: str | Path, threads: int | None = None) -> "Model":
        """Read the model in the file `path`.

        Raises:
            InputError: names the file and what is wrong with it.
        """
        try:
            return cls(Path(path).read_bytes(), threads)
        except OSError as error:
            raise InputError(f"cannot read the model {path}: {error.strerror or error}") from error
        except InputError as error:
            raise InputError(f"{path}: {error}") from error

    def __call__(self, frames_BTCHW: np.ndarray) -> np.ndarray:
        """Restore all frames: float32 (batch, frames, channels, height, width) in, the same shape out.

        At once, or one after the other where the network carries something from frame to frame.

        Raises:
            InputError: the shape is not what the card asks for, or memory does not suffice.
        """
        if not self.card.carried:
            return self._run(frames_BTCHW, {})[0]
        self._check(frames_BTCHW.shape)
        batch, count, _, height, width = frames_BTCHW.shape
        carried, restored = self.nothing(batch, height, width), []
        for time in range(count):
            frame_BTCHW, carried = self.step(frames_BTCHW[:, time : time + 1], carried)
            restored.append(frame_BTCHW)
        return np.concatenate(restored, axis=1)

    def step(self, frames_BTCHW: np.ndarray, carried: Carried) -> tuple[np.ndarray, Carried]:
        """Restore the next frames of a clip, given what was carried on from those before; as `__call__`."""
        restored_BTCHW, *following = self._run(frames_BTCHW, carried)
        return restored_BTCHW, dict(zip(self.card.carried, following, strict=True))

    def nothing(self, batch: int, height: int, width: int) -> Carried:
        """What is carried before the first frame."""
        shapes = self.card.carried_shapes(batch, height, width)
        return {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}

    def _run(self, frames_BTCHW: np.ndarray, carried: Carried) -> list[np.ndarray]:
        self._check(frames_BTCHW.shape)
        outputs = [OUTPUT, *(NEXT + name for name in carried)]
        try:
            results: list[np.ndarray] = self._session.run(
                outputs, {INPUT: np.ascontiguousarray(frames_BTCHW, np.float32), **carried}
            )
        except Exception as error:  # as above
            raise InputError(
                f"onnxruntime failed on frames of shape {frames_BTCHW.shape} ({error}); "
                "take smaller tiles or a shorter window"
            ) from error
        return results

    def _check(self, shape: tuple[int, ...]) -> None:
        card = self.card
        if len(shape) != 5 or shape[2] != card.channels or any(side % card.size_multiple for side in shape[3:]):
            raise InputError(
                f"frames of shape {shape}: the network takes (batch, frames, {card.channels}, height, width), "
                f"height and width multiples of {card.size_multiple}"
            )


def available_cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
