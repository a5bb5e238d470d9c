"""Phase screens against their structure function: exactly, as a sum over their waves, and as drawn."""

import numpy as np
import torch

from turbnet.atmosphere.screens import PhaseScreen
from turbnet.atmosphere.structure import phase_structure
from turbnet.bench.measurement import Measurement, Panel, Series, mean_and_error

SIZE, SPACING, R0 = 256, 0.01, 0.1
SEPARATIONS = np.array([2, 4, 8, 16, 32, 64, 128])
OUTER_SCALE = 1.0


def measure(draws: int, seed: int) -> tuple[list[Measurement], list[Panel]]:
    """Kolmogorov and von Karman, two samples to half the screen; allowed: 3 %."""
    measurements, series = [], []
    for name, outer in [("Kolmogorov", np.inf), (f"von Karman, L0 = {OUTER_SCALE:g} m", OUTER_SCALE)]:
        source = PhaseScreen((SIZE, SIZE), SPACING, R0, outer)
        every = np.arange(1.0, SIZE // 2 + 1)
        represented = source.structure_function(0 * every, every)
        theory = phase_structure(every * SPACING, R0, outer)
        worst = 1 + int(np.argmax(np.abs(represented[1:] / theory[1:] - 1)))
        label = f"{name}: structure function held by the screens, worst of 2 .. {SIZE // 2} samples"
        measurements.append(Measurement(label, theory[worst], represented[worst], 0.0, 0.03, "rad^2"))
        generator = torch.Generator().manual_seed(seed)
        squares = []
        for _ in range(draws):
            screen = source.draw(1, generator)[0]
            squares.append([_square(screen, int(r)) for r in SEPARATIONS])
        drawn, error = mean_and_error(np.array(squares))
        for r, value, deviation in zip(SEPARATIONS, drawn, error, strict=True):
            label = f"{name}: structure function, drawn, at {r} samples"
            measurements.append(Measurement(label, theory[r - 1], value, deviation, 0.03, "rad^2"))
        series += [
            Series(f"{name}, theory", every * SPACING, theory),
            Series("drawn", SPACING * SEPARATIONS, drawn, error),
        ]
    title = f"Structure function of {SIZE} x {SIZE} screens, r0 = {R0} m"
    panel = Panel("structure-function", title, "separation (m)", "D (rad$^2$)", series, ("log", "log"))
    return measurements, [panel]


def _square(screen: torch.Tensor, r: int) -> float:
    """Mean squared difference at r samples, over both axes."""
    rows, columns = screen[r:] - screen[:-r], screen[:, r:] - screen[:, :-r]
    return float((rows.square().mean() + columns.square().mean()) / 2)
