"""The Zernike field as drawn against theory: covariances over the picture, opposite edges, frozen flow."""

from collections.abc import Callable, Iterable
from itertools import product

import numpy as np
import torch

from turbnet.atmosphere.covariance import drift_covariance, zernike_covariance
from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Array, Constant, Profile, Tabulated
from turbnet.report import Row
from turbnet.simulate.field import ZernikeField

Track = Callable[[str, int], Iterable[int]]

PATHS: dict[str, Profile] = {
    "constant Cn2": Constant(1e-15),
    "Cn2 falling towards the scene": Tabulated((0, 7000), (2e-15, 0)),
    "Cn2 rising towards the scene": Tabulated((0, 7000), (0, 2e-15)),
}
SEPARATIONS = (0, 8, 32, 128, 512)
MODES = range(2, 12)
TRAVEL = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
STRIDE = 4


def measure(draws: int, track: Track) -> list[Row]:
    """Rows of the family; `track(name, count)` yields once a draw and may show progress."""
    rows = []
    for name, profile in PATHS.items():
        path = OpticalPath(0.2034, 7000.0, profile, 525e-9)
        field = ZernikeField(path, 125, 513, modes=MODES[-1], stride=STRIDE)
        drawn = _covariances(field, track(f"field, {name}", draws))
        offsets = -np.array(SEPARATIONS) * path.pixel
        exact = np.stack([[zernike_covariance(path, i, j, offsets) for j in MODES] for i in MODES])
        held = np.stack([[field.covariance(i, j, -np.array(SEPARATIONS)) for j in MODES] for i in MODES])
        sizes = np.sqrt(np.diagonal(exact[..., 0]))
        scale = (sizes[:, None] * sizes)[..., None]

        def rms(values: Array, exact: Array = exact, scale: Array = scale) -> float:
            return float(np.sqrt(np.mean(((values - exact) / scale) ** 2)))

        pairs = "all pairs j = 2..11, 0 to 512 px"
        label = f"field, {name}: RMS error of the covariance, {pairs}"
        rows.append(Row(f"{label}, {draws} draws", rms(drawn), "", 0.0, 0.03, rms(drawn) <= 0.03))
        rows.append(Row(f"{label}, held by the waves", rms(held), "", 0.0, 0.03, rms(held) <= 0.03))
        for mode, letter in ((0, "a2"), (1, "a3")):
            theory = exact[mode, mode, -1] / exact[mode, mode, 0]
            edge = drawn[mode, mode, -1] / drawn[mode, mode, 0]
            rows.append(
                Row.compared(f"field, {name}: correlation of {letter} at opposite edges, 512 px", edge, theory, 0.06)
            )
        worst = max((_drift_error(field, mode, way) for mode, way in product((2, 3), TRAVEL)), key=abs)
        rows.append(Row.compared(f"field, {name}: worst error of the tilts' autocorrelation, held", worst, 0.0, 0.05))
    rows += _drawn_drift(max(draws // 3, 20), track)
    return rows


def _covariances(field: ZernikeField, seeds: Iterable[int]) -> Array:
    """E[a_i(u) a_j(u + s)], (i, j, s), means over points and draws."""
    total = torch.zeros(len(MODES), len(MODES), len(SEPARATIONS), dtype=torch.float64)
    count = 0
    for seed in seeds:
        a = field.draw([seed]).coefficients[0, 0]
        for index, separation in enumerate(SEPARATIONS):
            lag = separation // STRIDE
            near, far = a[:, :, : a.shape[2] - lag].flatten(1), a[:, :, lag:].flatten(1)
            total[..., index] += (near @ far.T / near.shape[1]).double()
        count += 1
    return np.asarray(total / count)


def _drift_error(field: ZernikeField, mode: int, way: float) -> float:
    """Error of the autocorrelation of a tilt after all air has moved by `way`, m, along x."""
    exact = float(drift_covariance(field.path, mode, mode, way) / drift_covariance(field.path, mode, mode, 0.0))
    held = float(field.covariance(mode, mode, 0.0, 0.0, (way, 0.0)) / field.covariance(mode, mode, 0.0))
    return held - exact


def _drawn_drift(draws: int, track: Track) -> list[Row]:
    """The tilts' autocorrelation of drawn clips, against theory within 5 % or three standard errors."""
    path = OpticalPath(0.2034, 7000.0, PATHS["constant Cn2"], 525e-9)
    field = ZernikeField(path, 125, 125, modes=3, stride=STRIDE)
    products = np.zeros((draws, len(TRAVEL), 2))
    squares = np.zeros((draws, 2))
    for seed in track("field, frozen flow", draws):
        first = field.draw([seed], 1, torch.tensor([1.0, 0.0]), 1.0).coefficients[0, 0]
        squares[seed] = first.square().mean((1, 2))
        for index, way in enumerate(TRAVEL):
            later = field.draw([seed], 1, torch.tensor([way, 0.0]), 1.0, start=1).coefficients[0, 0]
            products[seed, index] = (first * later).mean((1, 2))
    rows = []
    for index, way in enumerate(TRAVEL):
        for mode in (2, 3):
            p, s = products[:, index, mode - 2], squares[:, mode - 2]
            ratio = p.mean() / s.mean()
            error = np.std(p - ratio * s, ddof=1) / np.sqrt(draws) / s.mean()
            theory = float(drift_covariance(path, mode, mode, way) / drift_covariance(path, mode, mode, 0.0))
            name = f"field, frozen flow: autocorrelation of a{mode} after {way:g} m, {draws} draws"
            rows.append(Row.compared(name, float(ratio), theory, max(0.05, 3 * float(error))))
    return rows
