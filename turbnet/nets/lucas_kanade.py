r"""One Lucas-Kanade step: the closed-form answer beside which a network learns.

The shift delta that brings an image I to a reference R minimises, over a small window around each pixel,
sum (I + g . delta - R)^2 + lambda |delta|^2 with g the gradient of both, averaged:

.. math::
    \delta = -\left(\sum g g^T + \lambda\right)^{-1} \sum g\,(I - R)

Source: Lucas & Kanade, IJCAI (1981). The prior lambda keeps flat regions, where nothing can be seen to move, still.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

LARGEST_STEP = 2.0
"""A linear step says nothing beyond the reach of its gradient, pixels."""


def lucas_kanade(image_NCHW: Tensor, reference_NCHW: Tensor, prior: Tensor) -> Tensor:
    """Shift (N, 2, H, W) in pixels, x then y, such that image(x + shift(x)) resembles the reference; in float32.

    Args:
        image_NCHW, reference_NCHW: intensities in [0, 1].
        prior: lambda, a positive number, intensity^2 / pixel^2.
    """
    image, reference = image_NCHW.float(), reference_NCHW.float()
    middle = F.pad((image + reference) / 2, (1, 1, 1, 1), mode="replicate")
    g_x = (middle[..., 1:-1, 2:] - middle[..., 1:-1, :-2]) / 2
    g_y = (middle[..., 2:, 1:-1] - middle[..., :-2, 1:-1]) / 2
    error = image - reference
    products = torch.cat(
        [(a * b).sum(1, keepdim=True) for a, b in ((g_x, g_x), (g_y, g_y), (g_x, g_y), (g_x, error), (g_y, error))],
        dim=1,
    )
    for _ in range(2):  # a tent five pixels wide
        products = F.avg_pool2d(F.pad(products, (1, 1, 1, 1), mode="replicate"), 3, stride=1)
    xx, yy, xy, x_error, y_error = products.split(1, dim=1)
    xx, yy = xx + prior, yy + prior
    # At least prior^2 by Cauchy-Schwarz, but not for rounding where the picture is far brighter than 1.
    determinant = torch.maximum(xx * yy - xy * xy, prior * prior)
    step = torch.cat((yy * x_error - xy * y_error, xx * y_error - xy * x_error), dim=1) / -determinant
    return step.clamp(-LARGEST_STEP, LARGEST_STEP)
