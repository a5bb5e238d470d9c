import numpy as np
import pytest
import skimage.data
from scipy.ndimage import gaussian_filter
from scipy.signal import fftconvolve

from turbnet.classical.edges import edge_width
from turbnet.classical.pipeline import SHARP, _widened
from turbnet.media.colour import to_linear
from turbnet.optics.psf import exponential_psf
from turbnet.simulate.psf_basis import psf_basis


@pytest.mark.parametrize("sigma", [1.5, 2.0, 3.0])
def test_width_of_blurred_steps(sigma):
    """A chequerboard with fields far wider than the blur; differences over two pixels add 0.7 pixels of their own."""
    y, x = np.mgrid[:192, :192]
    board = 0.2 + 0.6 * ((x // 32 + y // 32) % 2)
    assert edge_width(gaussian_filter(board, sigma)) == pytest.approx(np.hypot(sigma, 0.7), rel=0.06)


@pytest.mark.parametrize("wide", [1.5, 3.0, 4.5, 8.0])
def test_strokes_are_told_from_steps(wide):
    """Lone bars, light and dark: contrast over slope alone would say 0.7 of the blur of the narrowest."""
    sigma, fine = 2.0, np.full((6, 400), 0.5)
    fine[:, round(200 - 5 * wide) : round(200 + 5 * wide)] += 0.4 * np.array([[1], [-1]] * 3)
    bars = gaussian_filter(np.tile(fine.reshape(240, 10).mean(-1), (240, 1)), sigma)
    want = np.hypot(sigma, 0.7)
    assert edge_width(bars) == pytest.approx(want, rel=0.16)
    assert edge_width(bars.T) == edge_width(bars)
    if wide == 1.5:
        assert np.ptp(bars[:, :40]) / (np.sqrt(2 * np.pi) * np.gradient(bars[0]).max()) < 0.8 * want


@pytest.mark.parametrize("name", ["astronaut", "coffee", "cat", "camera"])
def test_pictures_never_blurred(name):
    """Blur adds to the width that a picture has of its own by their squares."""
    picture = getattr(skimage.data, name)()
    grey = to_linear((picture / 255).astype(np.float32))
    grey = grey @ np.float32([0.2126, 0.7152, 0.0722]) if grey.ndim == 3 else grey
    widths = [edge_width(gaussian_filter(grey, sigma) if sigma else grey) for sigma in (0, 1, 2, 3)]
    assert 0.9 < widths[0] < 1.6
    assert np.sqrt(widths[2] ** 2 - widths[0] ** 2) == pytest.approx(2.0, rel=0.2)
    assert widths == sorted(widths)


def test_a_flat_picture_tells_nothing():
    assert edge_width(np.full((64, 64), 0.5, np.float32)) == 0.0
    assert edge_width(np.zeros((12, 15), np.float32)) == 0.0


@pytest.mark.parametrize("strength", [0.0, 2.0, 8.0])
@pytest.mark.parametrize("width", [3.5, 6.0])
def test_the_kernel_takes_in_what_edges_show_beyond_it(strength, width):
    """A step, blurred by the kernel, is as steep as one blurred by a Gaussian of the width that was seen."""
    kernel = psf_basis(0, strength, 2.0).mean.numpy()
    own = 1 / (np.sqrt(2 * np.pi) * kernel.sum(0).max())
    assert _widened(kernel, np.hypot(1.6 * own, SHARP)) is kernel  # explained
    wide = _widened(kernel, np.hypot(width, SHARP))
    assert wide.sum() == pytest.approx(1, abs=1e-5)
    assert 1 / (np.sqrt(2 * np.pi) * wide.sum(0).max()) == pytest.approx(width, rel=0.005)
    assert len(wide) >= len(kernel)


@pytest.mark.parametrize("sigma", [2.0, 3.5])
def test_of_a_blur_with_tails_edges_tell_the_width(sigma):
    """The kernel that edges blurred by exp(-sqrt(3) r / sigma) lead to has their width, if none of it is known before."""
    board = np.kron(np.indices((8, 8)).sum(0) % 2, np.ones((40, 40))).astype(np.float32)
    seen = fftconvolve(np.pad(board, 30, mode="reflect"), exponential_psf(sigma, 61).numpy(), mode="valid")
    point = np.zeros((31, 31), np.float32)
    point[15, 15] = 1
    kernel = _widened(point, edge_width(seen))
    x = np.arange(len(kernel)) - len(kernel) // 2
    assert np.sqrt((kernel.sum(0) * x**2).sum()) == pytest.approx(sigma, rel=0.1)
