r"""The phase-to-space network: from Zernike coefficients to weights of PSF components without a Fourier transform.

The amplitude of a PSF at the pixels +-x is a sum over pairs of points +-rho of the aperture. With the phase split into
its even and odd part over such a pair, phi(+-rho) = u +- v,

.. math::
    h(\pm x) = A(x) \pm B(x), \qquad A(x) = \sum_k G^c_{xk}\, e^{i u_k} \cos v_k, \quad
    B(x) = \sum_k G^s_{xk}\, e^{i u_k} \sin v_k

so a PSF is linear in E(x) = |A|^2 + |B|^2 and O(x) = Re(A B^*). The network has just this form, with few points k (of half
the disk), few pixels x (of half the plane) and u, v, G and the last linear layer, to all pixels of the kernel, learned:
it starts from a cubature of the disk and training makes up for the points that are missing. Its last layer followed by
a PSF basis's own projection is one small matrix, whatever the basis. Named after Z. Mao, N. Chimitt and S. H. Chan,
"Accelerating atmospheric turbulence simulation via learned phase-to-space transform" (2021), whose perceptron of three
layers it replaces.
"""

from functools import lru_cache

import numpy as np
import torch
from torch import Tensor, nn

from turbnet.errors import ParameterError
from turbnet.optics.zernike import noll_to_nm, zernike_basis
from turbnet.simulate.psf_basis import PUPIL, PSFBasis, tilt_free_psf
from turbnet.weights.released import read_weights

MODES = 36
_RINGS, _SPOKES = 5, 12  # of the cubature, over half the disk
_RADIUS = 8.0  # pixels to which amplitudes are summed
_SIZE = 2 * PUPIL - 1
_CHUNK = 1024
_BASES = 8  # whose projections are kept: one for each wavelength of a few simulators

_EVEN = [j - 4 for j in range(4, MODES + 1) if noll_to_nm(j)[0] % 2 == 0]
_ODD = [j - 4 for j in range(4, MODES + 1) if noll_to_nm(j)[0] % 2]


class PhaseToSpace(nn.Module):
    """Tilt-free PSFs of a_4..a_36 at Nyquist pixels; until it is trained, as the cubature of the aperture gives them."""

    def __init__(self) -> None:
        super().__init__()
        node, weight = np.polynomial.legendre.leggauss(_RINGS)
        ring = np.arange(_RINGS)[:, None]
        angle = ((np.arange(_SPOKES) + 0.5 * (ring % 2)) * np.pi / _SPOKES).ravel()
        radius = np.repeat(np.sqrt((node + 1) / 2), _SPOKES)  # equal areas
        share = np.repeat(weight / 2 / _SPOKES, _SPOKES)
        modes = torch.from_numpy(zernike_basis(range(4, MODES + 1), radius, angle)).float()
        pixel = np.arange(_SIZE) - _SIZE // 2
        x, y = np.meshgrid(pixel, pixel)
        kept = ((y > 0) | ((y == 0) & (x >= 0))) & (np.hypot(x, y) <= _RADIUS)
        ramp = np.pi / 2 * (np.outer(radius * np.cos(angle), x[kept]) + np.outer(radius * np.sin(angle), y[kept]))
        self.even = nn.Parameter(modes[_EVEN])
        self.odd = nn.Parameter(modes[_ODD])
        self.cosine = nn.Parameter(torch.from_numpy(share[:, None] * np.cos(ramp)).float())
        self.sine = nn.Parameter(torch.from_numpy(share[:, None] * np.sin(ramp)).float())
        self.head = nn.Linear(2 * int(kept.sum()), _SIZE**2)

    def features(self, high_PN: Tensor) -> Tensor:
        """E and O, (P, F), of coefficients a_4..a_J (P, J-3), J <= 36, rad."""
        missing = MODES - 3 - high_PN.shape[1]
        if missing < 0:
            raise ParameterError(f"the phase-to-space network knows modes to {MODES}, not {high_PN.shape[1] + 3}")
        high_PN = high_PN.to(self.even)
        if missing:
            high_PN = torch.cat((high_PN, high_PN.new_zeros(len(high_PN), missing)), 1)
        u, v = high_PN[:, _EVEN] @ self.even, high_PN[:, _ODD] @ self.odd
        cos_u, sin_u, cos_v, sin_v = u.cos(), u.sin(), v.cos(), v.sin()
        a = torch.cat((cos_u * cos_v, sin_u * cos_v)) @ self.cosine  # real parts, then imaginary ones
        b = torch.cat((cos_u * sin_v, sin_u * sin_v)) @ self.sine
        squares = a * a + b * b
        products = a * b
        count = len(high_PN)
        return torch.cat((squares[:count] + squares[count:], products[:count] + products[count:]), 1)

    def forward(self, high_PN: Tensor) -> Tensor:
        """PSFs (P, 31, 31); they sum to one to the network's precision."""
        psf: Tensor = self.head(self.features(high_PN))
        return psf.view(-1, _SIZE, _SIZE)

    def weights(self, high_PN: Tensor, basis: PSFBasis) -> Tensor:
        """Weights (P, M) of the PSFs in a basis; differentiable in the coefficients."""
        matrix, offset = self._through(basis)
        parts = [torch.addmm(offset, self.features(chunk), matrix) for chunk in high_PN.split(_CHUNK)]
        return torch.cat(parts).to(high_PN)

    def _through(self, basis: PSFBasis) -> tuple[Tensor, Tensor]:
        """The last layer followed by the basis's projection: (F, M) and (M,)."""
        if basis.points != PUPIL:
            raise ParameterError(f"the phase-to-space network knows apertures of {PUPIL} samples, not {basis.points}")
        projection = self._known.get(basis)
        if projection is None:
            nyquist = basis.nyquist_columns[:, :-1].T.view(-1, 2 * PUPIL, 2 * PUPIL)
            # A PSF that sums to one at Nyquist pixels sums to 1 / q^2 when read at pixels of q.
            dual = basis.q**2 * torch.fft.fftshift(nyquist, dim=(1, 2))[:, 1:, 1:].flatten(1).to(self.head.weight)
            offset = dual @ self.head.bias.detach() - (basis.dual * basis.mean).sum((1, 2)).to(dual)
            projection = ((dual @ self.head.weight.detach()).T.contiguous(), offset)
            if len(self._known) >= _BASES:
                self._known.clear()
            self._known[basis] = projection
        return projection

    @property
    def _known(self) -> dict[PSFBasis, tuple[Tensor, Tensor]]:
        known: dict[PSFBasis, tuple[Tensor, Tensor]] = self.__dict__.setdefault("_projections", {})
        return known

    @torch.no_grad()
    def fit_head(self, high_PN: Tensor, ridge: float = 1e-6) -> None:
        """Set the last layer to the least-squares fit of the exact PSFs of some coefficients."""
        features = self.features(high_PN).double()
        centre = features.mean(0)
        scale = features.std(0).clamp(min=1e-12)
        design = torch.cat(((features - centre) / scale, features.new_ones(len(features), 1)), 1)
        target = tilt_free_psf(high_PN).flatten(1).double()
        normal = design.T @ design + ridge * len(design) * torch.eye(design.shape[1], dtype=torch.float64)
        solution = torch.linalg.solve(normal, design.T @ target)
        weight = solution[:-1] / scale[:, None]
        self.head.weight.copy_(weight.T)
        self.head.bias.copy_(solution[-1] - centre @ weight)


@lru_cache(maxsize=1)
def released() -> PhaseToSpace:
    """The network that comes with the package, trained by tools/train_phase_to_space.py; see its card.

    Raises:
        InputError: the file is missing or is not the one its card describes.
    """
    network = PhaseToSpace()
    network.load_state_dict(read_weights("phase_to_space"))
    return network.requires_grad_(False).eval()
