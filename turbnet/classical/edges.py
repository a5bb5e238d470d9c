r"""How wide a picture's sharpest edges are: blur that nobody has to model.

A step of contrast c blurred by a Gaussian of the standard deviation s rises by at most

.. math:: |\nabla y| = \frac{c}{s \sqrt{2\pi}}

so that contrast over steepness, at the steepest points of strong edges, tells s; the sharpest tenth of them are those that
were sharp in the scene. Fine lines and corners rise less for their contrast nearby and count as wider edges. Pictures
that were never blurred have s = 0.75 to 1.06 pixels in this measure (those inside scikit-image): differences over two pixels
alone make 0.7.
"""

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from turbnet.classical.local import Array

_AROUND = 15  # pixels a side within which an edge's contrast is taken: widths up to 3 are told right
_APART = 5  # pixels a side within which only the steepest point counts
_STRONG = 0.25  # least contrast, over that which a twentieth of the picture exceeds
_SHARPEST = 10  # per cent of the edges
_FEWEST = 20
_BORDER = 10


def edge_width(luminance_HW: Array) -> float:
    """s of the sharpest edges, pixels; 0 where there are too few to tell.

    Args:
        luminance_HW: linear intensities.
    """
    along_y, along_x = np.gradient(luminance_HW)
    steepness = np.hypot(along_x, along_y)
    contrast = maximum_filter(luminance_HW, _AROUND) - minimum_filter(luminance_HW, _AROUND)
    edges = (steepness >= maximum_filter(steepness, _APART)) & (steepness > 0)
    edges &= contrast > _STRONG * np.percentile(contrast, 95)
    inner = edges[_BORDER:-_BORDER, _BORDER:-_BORDER]
    if inner.sum() < _FEWEST:
        return 0.0
    cut = (slice(_BORDER, -_BORDER),) * 2
    widths = contrast[cut][inner] / (np.sqrt(2 * np.pi) * steepness[cut][inner])
    return float(np.percentile(widths, _SHARPEST))
