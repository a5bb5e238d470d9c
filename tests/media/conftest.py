import numpy as np
import pytest
import skimage.data


@pytest.fixture(scope="session")
def picture():
    """A photograph of odd size, float32 (H, W, 3), exact at 8 bits."""
    return (skimage.data.astronaut()[60:135, 180:281] / 255.0).astype(np.float32)


@pytest.fixture(scope="session")
def frames(picture):
    """Six frames, 74x100, of which two neighbours are equal."""
    even = picture[:74, :100]
    return np.stack([np.roll(even, shift, axis=1) for shift in (0, 3, 3, 6, 9, 12)])
