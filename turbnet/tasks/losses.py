"""Losses on clips (B, T, C, H, W)."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from turbnet.nets.blocks import warp
from turbnet.nets.restorer import Restored
from turbnet.nets.tilt import ERROR_AT_HALF, SCALES, Registered


def charbonnier(a: Tensor, b: Tensor, epsilon: float = 1e-3, weight: Tensor | float = 1.0) -> Tensor:
    """Mean of weight sqrt((a-b)^2 + epsilon^2): absolute error, smooth at zero."""
    return (weight * torch.sqrt((a.float() - b.float()).square() + epsilon**2)).mean()


def moving_weights(clip_BTCHW: Tensor, weight: float) -> Tensor:
    """`weight` where a clean clip moves (it differs from its mean over time by over 0.01), 1 elsewhere; (B, T, 1, H, W)."""
    moves = (clip_BTCHW - clip_BTCHW.mean(1, keepdim=True)).abs().mean(2, keepdim=True) > 0.01
    return 1 + (weight - 1) * moves.float()


def psnr(a: Tensor, b: Tensor) -> Tensor:
    """Mean over clips of the peak signal-to-noise ratio, dB, full scale 1; values are cut to [0, 1]."""
    error = (a.float().clamp(0, 1) - b.float()).square().flatten(1).mean(1)
    return (-10 * torch.log10(error.clamp(min=1e-12))).mean()


def registration_loss(frames: Tensor, blur_only: Tensor, tilts: Sequence[Tensor]) -> Tensor:
    """Charbonnier distance of the registered frames to the blur-only frames at 1/4, 1/2 and full resolution.

    Each scale is registered with the tilt estimated at half its resolution.
    """
    flat, truth = frames.flatten(0, 1), blur_only.flatten(0, 1)
    loss = frames.new_zeros(())
    for coarse, tilt in zip(SCALES, tilts, strict=True):
        scale = coarse // 2
        fine = F.interpolate(tilt.flatten(0, 1), scale_factor=2.0, mode="bilinear", align_corners=False)
        small = F.avg_pool2d(flat, scale) if scale > 1 else flat
        wanted = F.avg_pool2d(truth, scale) if scale > 1 else truth
        loss = loss + charbonnier(warp(small, fine / scale), wanted)
    return loss / len(SCALES)


def tilt_loss(registered: Registered, tilt_map: Tensor) -> Tensor:
    r"""Negative log-likelihood of the true tilt map, mean over three scales: |t - t^| e^z / b_0 - z.

    The error |t - t^| is the length of the vector, pixels, rounded off below 0.05.
    """
    truth = tilt_map.flatten(0, 1)
    parts = []
    for scale, tilt, logit in zip(SCALES, registered.tilts, registered.logits, strict=True):
        error = (tilt.float() - F.avg_pool2d(truth, scale).unflatten(0, tilt.shape[:2])).square().sum(2, keepdim=True)
        length, z = torch.sqrt(error + 0.05**2), logit.float()
        parts.append((length * z.exp() / ERROR_AT_HALF - z).mean())
    return torch.stack(parts).mean()


def tilt_error(registered: Registered, tilt_map: Tensor) -> Tensor:
    """Root mean square error of the finest tilts in one axis, pixels."""
    scale, tilt = SCALES[-1], registered.tilts[-1]
    return (
        (tilt.float() - F.avg_pool2d(tilt_map.flatten(0, 1), scale).unflatten(0, tilt.shape[:2])).square().mean().sqrt()
    )


def frequency_loss(a: Tensor, b: Tensor) -> Tensor:
    """Mean absolute difference of the (orthonormal) Fourier transforms: fine detail counts as much as coarse."""
    difference = torch.fft.rfft2(a.float() - b.float(), norm="ortho")
    return torch.sqrt(difference.real.square() + difference.imag.square() + 1e-8).mean()


def scene_loss(scene_B1CHW: Tensor, target: Tensor) -> Tensor:
    """Charbonnier distance of the still scene to the target where that is still."""
    return charbonnier(scene_B1CHW, target, weight=moving_weights(target, 0.0))


def gate_loss(restored: Restored, target: Tensor) -> Tensor:
    r"""Cross-entropy of the gate against which is nearer the target, frame or still scene, by how much that matters:

    .. math::
        \frac{\sum |e_S - e_O|\, \mathrm{BCE}(g, e_O < e_S)}{\sum |e_S - e_O|}

    e the absolute error, mean over 9 x 9 pixels and channels. Where both are as good the label is chance, and counts little.
    Learned from the restored frames alone a gate closes in the first steps, when the scene is the better everywhere.
    """
    with torch.no_grad():
        scene, own = (
            F.avg_pool2d((x.float() - target.float()).abs().mean(2), 9, 1, 4, count_include_pad=False)
            for x in (restored.scene, restored.own)
        )
        gain = (scene - own)[:, :, None]
        matters = gain.abs() / gain.abs().mean(dim=(1, 2, 3, 4), keepdim=True).clamp(min=1e-4)  # clips do not mix
    return F.binary_cross_entropy_with_logits(restored.gate.float(), (gain > 0).float(), weight=matters)
