"""PSNR, SSIM and MS-SSIM of frames against their reference, by torchmetrics, on values with black at 0, white at 1.

    PSNR = 10 log10(1 / MSE) dB, MSE over the pixels and channels of a frame; infinite for equal frames.
    SSIM = mean of (2 mu_x mu_y + C1)(2 s_xy + C2) / ((mu_x^2 + mu_y^2 + C1)(s_x^2 + s_y^2 + C2)),
           Gaussian window of sigma 1.5 (11 x 11), C1 = 0.01^2, C2 = 0.03^2, over the channels and the pixels whose
           window lies inside the frame (Wang et al., IEEE Trans. Image Process. 13, 600, 2004).

    MS-SSIM = product over five scales, each half the one before, of the contrast and structure terms and, at the
           coarsest, of the luminance term, raised to 0.0448, 0.2856, 0.3001, 0.2363, 0.1333 (Wang et al., Asilomar
           (2003)); negative terms count as 0. Edges as torchmetrics has them: reflected.

PSNR and SSIM agree with scikit-image's (`gaussian_weights=True, sigma=1.5, use_sample_covariance=False`), MS-SSIM with
torchmetrics'. The figure of a clip is the mean over its frames. Nothing is registered here: a restoration that is
shifted scores as what it is, and `turbnet.metrics.registration` tells how far the whole is shifted.
"""

from typing import Any, overload

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torchmetrics.functional.image import (
    multiscale_structural_similarity_index_measure,
    peak_signal_noise_ratio,
    structural_similarity_index_measure,
)

from turbnet.errors import InputError, check_range

Frames = NDArray[np.floating[Any]]

_SIGMA = 1.5
_REACH = 5  # pixels from the window's centre to its edge: 3.5 sigma
_WINDOW = 2 * _REACH + 1
MS_SSIM_SIZE = 2**4 * _WINDOW
"""Least height and width for MS-SSIM, pixels: the window must fit into the coarsest of five scales."""


@overload
def psnr(restored: Tensor, reference: Tensor, border: int = 0) -> Tensor: ...
@overload
def psnr(restored: Frames, reference: Frames, border: int = 0) -> Frames: ...
def psnr(restored: Any, reference: Any, border: int = 0) -> Any:
    """Peak signal-to-noise ratio in dB of each frame.

    Args:
        restored: frames (..., H, W, C), values in [0, 1], NumPy or torch.
        reference: the same, or one frame (H, W, C) that all are compared with.
        border: pixels left out at each edge.

    Returns:
        Scores, the shape of the leading axes (...), a torch tensor if `restored` is one.

    Raises:
        InputError: sizes differ, values are not finite, or the border leaves nothing.
    """
    first_NCHW, second_NCHW, finish = _prepare(restored, reference, border, smallest=1)
    first_NCHW, second_NCHW = first_NCHW.double(), second_NCHW.double()
    scores = peak_signal_noise_ratio(first_NCHW, second_NCHW, data_range=1.0, reduction="none", dim=(1, 2, 3))
    return finish(scores)


@overload
def ssim(restored: Tensor, reference: Tensor, border: int = 0) -> Tensor: ...
@overload
def ssim(restored: Frames, reference: Frames, border: int = 0) -> Frames: ...
def ssim(restored: Any, reference: Any, border: int = 0) -> Any:
    """Structural similarity of each frame, at most 1. Arguments and errors as `psnr`; frames need 11 x 11 pixels.

    Computed in the precision of the frames, float32 at least: it is eight times as fast and right to about 1e-6 where there
    is texture, 1e-4 in bright and nearly flat pictures, whose variance it takes from the difference of large numbers.
    """
    first_NCHW, second_NCHW, finish = _prepare(restored, reference, border, smallest=_WINDOW)
    return finish(torch.stack([_ssim(*pair) for pair in zip(first_NCHW, second_NCHW, strict=True)]))


@overload
def ms_ssim(restored: Tensor, reference: Tensor, border: int = 0) -> Tensor: ...
@overload
def ms_ssim(restored: Frames, reference: Frames, border: int = 0) -> Frames: ...
def ms_ssim(restored: Any, reference: Any, border: int = 0) -> Any:
    """Multi-scale structural similarity of each frame, 0 to 1. Arguments and errors as `psnr`; frames need 176 x 176."""
    first_NCHW, second_NCHW, finish = _prepare(restored, reference, border, smallest=MS_SSIM_SIZE)
    return finish(
        multiscale_structural_similarity_index_measure(
            first_NCHW, second_NCHW, sigma=_SIGMA, data_range=1.0, reduction="none", normalize="relu"
        )
    )


def _ssim(first_CHW: Tensor, second_CHW: Tensor) -> Tensor:
    _, similarity_NCHW = structural_similarity_index_measure(
        first_CHW[None], second_CHW[None], sigma=_SIGMA, data_range=1.0, reduction="none", return_full_image=True
    )
    # torchmetrics averages over its reflected margin as well.
    return similarity_NCHW[..., _REACH:-_REACH, _REACH:-_REACH].mean()


def _tensor(frames: Any) -> Tensor:
    # A copy, since torch accepts neither read-only arrays nor reversed ones.
    tensor = frames if isinstance(frames, Tensor) else torch.from_numpy(np.array(frames))
    if not tensor.is_floating_point():
        raise InputError(f"cannot compare frames of type {tensor.dtype}; scale them to floating point in [0, 1]")
    return tensor


def _prepare(restored: Any, reference: Any, border: int, smallest: int) -> tuple[Tensor, Tensor, Any]:
    """Both as floating-point (N, C, H, W), and what gives the scores (N,) the caller's shape and type."""
    first, second = _tensor(restored), _tensor(reference)
    if first.ndim < 3 or first.shape[-3:] != second.shape[-3:] or (second.ndim > 3 and first.shape != second.shape):
        raise InputError(
            f"cannot compare frames of shape {tuple(first.shape)} with {tuple(second.shape)}; "
            "both must be (..., H, W, C)"
        )
    check_range("border", border, 0, float("inf"), "pixels")
    height, width = first.shape[-3:-1]
    kept = min(height, width) - 2 * border
    if kept < smallest:
        raise InputError(
            f"frames of {width}x{height} pixels are too small for a border of {border} pixels; "
            f"at least {smallest}x{smallest} must remain"
        )
    if not (torch.isfinite(first).all() and torch.isfinite(second).all()):
        raise InputError("cannot compare frames that hold NaN or infinite pixels")

    # Variances are differences of large numbers: half precision holds none.
    precision = torch.promote_types(torch.promote_types(first.dtype, second.dtype), torch.float32)

    def arranged(frames: Tensor) -> Tensor:
        inner = frames[..., border : height - border, border : width - border, :].to(precision)
        return inner.expand(*first.shape[:-3], *inner.shape[-3:]).reshape(-1, *inner.shape[-3:]).movedim(-1, 1)

    def finish(scores: Tensor) -> Any:
        scores = scores.reshape(first.shape[:-3])
        return scores if isinstance(restored, Tensor) else scores.numpy()

    return arranged(first), arranged(second), finish
