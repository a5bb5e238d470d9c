"""Stress of `OpticalPath` and the closed forms of the atmosphere: any strength, any geometry that is accepted."""

from collections.abc import Iterator
from functools import partial
from itertools import product

import numpy as np

from turbnet.atmosphere.exposure import long_exposure_otf, short_exposure_otf, tilt_free_otf
from turbnet.atmosphere.lucky import lucky_probability
from turbnet.atmosphere.noll import noll_covariance
from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Constant
from turbnet.atmosphere.slabs import slabs
from turbnet.atmosphere.structure import phase_structure
from turbnet.bench.stress_cell import Cell, Check, close, finite, within

STRENGTHS = (0.0, 0.01, 1.0, 5.0, 10.0, 20.0, 50.0)
"""D/r0."""
CN2 = (0.0, 1e-20, 1e-18, 1e-16, 1e-14, 1e-12, 1e-10)
"""m^(-2/3)."""
GEOMETRIES = ((1e-3, 1.0, 1e-7), (0.2034, 7000.0, 525e-9), (50.0, 1e6, 2e-5))
"""Aperture, distance, wavelength, m: least, usual and greatest."""
REFUSED = (-1e-16, 1e-8, float("nan"), float("inf"))
"""Values of Cn2 that nothing can be made of."""

_EXACT = 1e-9  # quadrature of a power of z on panels that narrow to its zero


def cells(quick: bool) -> Iterator[Cell]:
    """Cheap: all of them, whether quick or not."""
    for strength in STRENGTHS:
        yield Cell("path", f"D/r0 = {strength:g}", partial(_strength, strength))
        yield Cell("path", f"exposures, D/r0 = {strength:g}", partial(_exposures, strength))
    for cn2, geometry in product(CN2, GEOMETRIES):
        name = f"Cn2 = {cn2:g}, aperture {geometry[0]:g} m, {geometry[1]:g} m, {geometry[2]:g} m"
        yield Cell("path", name, partial(_closed_forms, cn2, geometry))
    for cn2 in REFUSED:
        yield Cell("path", f"Cn2 = {cn2:g}", partial(_closed_forms, cn2, GEOMETRIES[1]), must_refuse=True)
    for order in (2, 37, 10**4, 10**6):
        yield Cell("path", f"variance of mode {order}", partial(_noll, order))


def _strength(strength: float) -> Iterator[Check]:
    path = OpticalPath.from_d_over_r0(strength)
    yield Check("D/r0 asked for and had", path.d_over_r0, strength, _EXACT * strength)
    yield finite("Rytov variances", path.rytov_plane, path.rytov_spherical)
    yield Check("whether still air has no isoplanatic angle", float(np.isinf(path.theta0)), float(strength == 0))


def _exposures(strength: float) -> Iterator[Check]:
    frequency = np.linspace(0, 1, 9)
    for name, otf in (("long", long_exposure_otf), ("short", short_exposure_otf), ("tilt-free", tilt_free_otf)):
        yield within(f"OTF, {name} exposure", otf(frequency, strength), 0.0, 1.0, 1e-12)
    yield within("lucky probability", lucky_probability(strength), 0.0, 1.0)


def _closed_forms(cn2: float, geometry: tuple[float, float, float]) -> Iterator[Check]:
    aperture, length, wavelength = geometry
    path = OpticalPath(aperture, length, Constant(cn2), wavelength)
    k = 2 * np.pi / wavelength
    if cn2 == 0:
        yield Check("whether r0 is infinite", float(np.isinf(path.r0) and np.isinf(path.theta0)), 1.0)
        yield Check("D/r0", path.d_over_r0)
    else:
        yield close("r0", path.r0, (0.423 * k**2 * cn2 * length * 3 / 8) ** (-3 / 5), _EXACT)
        yield close("theta0", path.theta0, (2.914 * k**2 * cn2 * length ** (8 / 3) * 3 / 8) ** (-3 / 5), _EXACT)
        yield finite("structure of the phase", phase_structure(np.array([0.0, aperture]), max(path.r0, 1e-6), 10.0))
    yield close("Rytov variance", path.rytov_plane, 2.25 * 6 / 11 * k ** (7 / 6) * cn2 * length ** (11 / 6), _EXACT)
    strengths = slabs(path, 7).cn2_dz
    yield close("strength of seven slabs", strengths.sum(), cn2 * length, _EXACT)


def _noll(order: int) -> Iterator[Check]:
    variance = noll_covariance(order, order)
    yield finite("variance", variance)
    yield within("variance", variance, 0.0, noll_covariance(2, 2))
