"""A released network at work: NumPy in, NumPy out. Needs onnxruntime only, neither torch nor onnx."""

import os
from pathlib import Path

import numpy as np
import onnxruntime

from turbnet.deploy.card import ModelCard
from turbnet.deploy.seal import verify
from turbnet.errors import InputError, check_range
from turbnet.media.guard import read_bytes, reading

INPUT, OUTPUT = "frames", "restored"
NEXT = "next_"
"""Before the name of what is carried on to the next frame, as an output."""

LARGEST = 2**31
"""Bytes of the largest model file: that of a protobuf message."""

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
        self._session = open_session(data, self.threads)
        with reading("the model"):  # names that are not UTF-8
            metadata = self._session.get_modelmeta().custom_metadata_map
            found = self._session.get_inputs(), self._session.get_outputs()
        self.card = ModelCard.from_metadata(metadata)
        carried = self.card.carried
        wanted = [INPUT, *carried], [OUTPUT, *(NEXT + name for name in carried)]
        for names, values in zip(wanted, found, strict=True):
            if {v.name: v.type for v in values} != dict.fromkeys(names, "tensor(float)"):
                raise InputError(f"the model does not take and return what its card says: {', '.join(names)}, float32")

    @classmethod
    def load(cls, path: str | Path, threads: int | None = None) -> "Model":
        """Read the model in the file `path`.

        Raises:
            InputError: names the file and what is wrong with it.
        """
        data = read_bytes(path, LARGEST, "the model ")
        try:
            return cls(data, threads)
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
        shape = frames_BTCHW.shape
        if results[0].ndim != 5 or results[0].shape[:2] + results[0].shape[3:] != shape[:2] + shape[3:]:
            raise InputError(f"the model made frames of shape {results[0].shape} of frames of shape {shape}")
        return results

    def _check(self, shape: tuple[int, ...]) -> None:
        card = self.card
        if len(shape) != 5 or shape[2] != card.channels or any(side % card.size_multiple for side in shape[3:]):
            raise InputError(
                f"frames of shape {shape}: the network takes (batch, frames, {card.channels}, height, width), "
                f"height and width multiples of {card.size_multiple}"
            )


def open_session(data: bytes, threads: int) -> onnxruntime.InferenceSession:
    """A session on the processor for the bytes of a sealed file.

    Raises:
        InputError: they are beyond the installed onnxruntime.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    # Planned memory is the sum over all shapes seen, half as much again, and no faster.
    options.enable_mem_pattern = False
    options.log_severity_level = 4  # errors reach the user as InputError, not through onnxruntime's log
    # Activations that fade into denormal numbers slow a processor down tenfold.
    options.add_session_config_entry("session.set_denormal_as_zero", "1")
    # Between two calls the cores belong to the decoder and the encoder, not to threads that spin.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    options.add_session_config_entry("session.load_model_format", "ONNX")  # and not whatever the first bytes say
    try:
        return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's errors share no narrower base class
        raise InputError(f"onnxruntime {onnxruntime.__version__} cannot run the model: {error}") from error


def available_cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
