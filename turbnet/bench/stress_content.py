"""Pictures that are hard on arithmetic."""

import torch
from torch import Tensor

BRIGHTEST = 1e6
"""Of the pictures of high dynamic range, full scale 1."""

PROPER = ("texture", "constant", "impulse", "checkerboard", "black", "saturated")
"""Contents in [0, 1]."""
BROKEN = ("NaN", "Inf")
"""Contents with one pixel that is no number."""
CONTENTS = (*PROPER, "HDR", *BROKEN)


def clip(content: str, height: int, width: int, frames: int = 1, channels: int = 3) -> Tensor:
    """A clip (1, T, C, H, W), float64, that moves to and fro by a pixel."""
    generator = torch.Generator().manual_seed(height * width)
    texture = torch.rand(channels, height, width, generator=generator, dtype=torch.float64)
    middle = (..., height // 2, width // 2)
    if content == "constant":
        picture = torch.full_like(texture, 0.5)
    elif content == "black":
        picture = torch.zeros_like(texture)
    elif content == "saturated":
        picture = torch.ones_like(texture)
    elif content == "impulse":
        picture = torch.zeros_like(texture)
        picture[middle] = 1
    elif content == "checkerboard":
        picture = ((torch.arange(height)[:, None] + torch.arange(width)) % 2).expand_as(texture).double()
    elif content == "HDR":
        picture = BRIGHTEST ** (2 * texture - 1)  # 1e-6 to 1e6
        picture[middle] = BRIGHTEST
    else:
        picture = texture
    if content in BROKEN:
        picture[middle] = float(content)
    return torch.stack([picture.roll(t % 2, -1) for t in range(frames)])[None]
