r"""How wide a picture's sharpest edges are: blur that nobody has to model.

A step of contrast c blurred by a Gaussian of the standard deviation s rises by at most

.. math:: |\nabla y| = \frac{c}{s \sqrt{2\pi}}

so that contrast over steepness, at the steepest points of strong edges, tells s. Of a bar narrower than 4 s, a stroke of a
letter say, it tells too little, down to 0.66 s: neither its contrast nor its slope is a step's. How much of the contrast
lies between the points three of these widths before and behind, all of it across a step, tells which it is, and by how much
to correct. The sharpest twelfth of the edges are those that were sharp in the scene. Of pictures that were never blurred s
is 1 to 1.5 pixels in this measure (those inside scikit-image), 0.6 to 0.9 of rendered text: differences over two pixels
alone make 0.7.
"""

import numpy as np
from scipy.ndimage import map_coordinates, maximum_filter, minimum_filter

from turbnet.classical.local import Array

_AROUND = 15  # pixels a side within which an edge's contrast is taken: widths up to 3 are told right
_APART = 5  # pixels a side within which only the steepest point counts
_STRONG = 0.25  # least contrast, over that which a twentieth of the picture exceeds
_SHARPEST = 8  # per cent of the edges
_FEWEST = 20
_BORDER = 10
# Bars of 0, 2, 2.5, 3, 3.5, 4 and 5 s: the part of the contrast between three widths before and behind, width over s.
_ACROSS = (0.611, 0.640, 0.681, 0.748, 0.832, 0.909, 0.988)
_OF_STEP = (0.658, 0.766, 0.821, 0.876, 0.922, 0.955, 0.988)


def edge_width(luminance_HW: Array) -> float:
    """s of the sharpest edges, pixels; 0 where there are too few to tell.

    Args:
        luminance_HW: linear intensities.
    """
    gradient = np.asarray(np.gradient(luminance_HW))
    steepness: Array = np.hypot(*gradient)
    contrast = maximum_filter(luminance_HW, _AROUND) - minimum_filter(luminance_HW, _AROUND)
    edges = (steepness >= maximum_filter(steepness, _APART)) & (steepness > 0)
    edges &= contrast > _STRONG * np.percentile(contrast, 95)
    edges[:_BORDER] = edges[-_BORDER:] = edges[:, :_BORDER] = edges[:, -_BORDER:] = False
    y, x = np.nonzero(edges)
    if len(y) < _FEWEST:
        return 0.0
    slope, rise = steepness[y, x], contrast[y, x]
    widths = rise / (np.sqrt(2 * np.pi) * slope)
    across = gradient[:, y, x] * (3 * widths / slope)
    before, behind = (map_coordinates(luminance_HW, (y, x) + way, order=1, mode="nearest") for way in (across, -across))
    widths /= np.interp((before - behind) / rise, _ACROSS, _OF_STEP)
    return float(np.percentile(widths, _SHARPEST))
