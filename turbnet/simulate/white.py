"""White noise that a seed and a frame's number decide, alone or in any batch."""

import numpy as np
import torch
from torch import Tensor


def white_noise(seed: int, frame: int, *shape: int) -> Tensor:
    """Independent standard normal values of the given shape."""
    mixed = np.random.SeedSequence([int(seed), frame]).generate_state(1, np.uint64)[0]
    return torch.randn(*shape, generator=torch.Generator().manual_seed(int(mixed)))
