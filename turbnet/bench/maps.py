r"""`turbnet bench maps`: does a network that restores single frames know where it is wrong?

Every still scene and every text of the frozen benchmark, one frame at each strength, through a checkpoint that has
uncertainty maps. The error is that of the restored frame, mean over 5 x 5 pixels and channels; the map is the scale of both
parts together,

.. math:: b = \tau \sqrt{b_{tilt}^2 + b_{blur}^2},

as smooth. The temperature tau is fitted on one half of the scenes and judged on the other. Beside the map stand the gradient
magnitude of the input, which knows where edges are, and what may be had by Monte-Carlo dropout.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from turbnet.bench.measurement import Panel, Series
from turbnet.bench.suite import SUITES, make_clip, names
from turbnet.deploy.checkpoint import load_network
from turbnet.errors import InputError
from turbnet.metrics.calibration import (
    LEVELS,
    STEPS,
    Array,
    ause,
    calibration_error,
    rank_correlation,
    reliability,
    sparsification,
    temperature,
)
from turbnet.nets.still import StillRestorer
from turbnet.nets.uncertainty import smoothed
from turbnet.progress import progress_bar
from turbnet.report import Report, Row

BORDER = 8
PASSES = 8
_MAPS = ("one pass", "Monte-Carlo dropout", "gradient magnitude")


@dataclass(frozen=True)
class Found:
    """What was measured.

    Attributes:
        report: rows.
        panels: reliability and sparsification.
    """

    report: Report
    panels: list[Panel]

    @property
    def text(self) -> str:
        """The rows as a Markdown table."""
        lines = [f"| {row.name} | {row.value:.3f} |" for row in self.report.rows]
        return "\n".join(["| figure | value |", "|---|---|", *lines])


@torch.no_grad()
def run(checkpoint: str | Path, suite: str = "standard", quiet: bool = False) -> Found:
    """Measure the maps of a checkpoint.

    Raises:
        InputError: the checkpoint cannot be read, or its network has no maps.
    """
    network = load_network(checkpoint)[0]
    if not isinstance(network, StillRestorer) or network.maps is None:
        raise InputError(f"{checkpoint}: its network has no uncertainty maps; turbnet train experiment=still makes one")
    scenes = [name for name in names(SUITES[suite]) if name[0] != "dynamic"]
    torch.manual_seed(0)
    halves: list[list[dict[str, Array]]] = [[], []]
    with progress_bar(quiet) as progress:
        for kind, scene, strength in progress.track(scenes, description="restoring"):
            clip = make_clip(kind, scene, strength, 1)
            frame, clean = (torch.from_numpy(x).permute(0, 3, 1, 2)[None] for x in (clip.frames, clip.target))
            halves[scene % 2].append(_measure(network, frame, clean))
    fitted, judged = halves if halves[1] else (halves[0], halves[0])

    def whole(half: list[dict[str, Array]], name: str) -> Array:
        return np.concatenate([part[name] for part in half])

    report = Report()
    residual, error = whole(judged, "residual"), whole(judged, "error")
    sparse = [Series("errors known", np.arange(STEPS) / STEPS, sparsification(error, error))]
    reliable = [Series("as it should be", LEVELS, LEVELS)]
    for name in _MAPS:
        found = whole(judged, name)
        report.add(Row(f"{name}: rank correlation with the local error", rank_correlation(error, found)))
        report.add(Row(f"{name}: AUSE", ause(error, found)))
        sparse.append(Series(name, np.arange(STEPS) / STEPS, sparsification(error, found), approximate=True))
        if name == "gradient magnitude":
            continue
        tau = temperature(whole(fitted, "residual"), whole(fitted, f"{name}, scale"))
        scale = whole(judged, f"{name}, scale")
        report.add(Row(f"{name}: expected calibration error", calibration_error(residual, scale)))
        report.add(Row(f"{name}: temperature", tau))
        report.add(Row(f"{name}: expected calibration error after it", calibration_error(residual, tau * scale)))
        reliable.append(Series(name, LEVELS, reliability(residual, tau * scale), approximate=True))
    panels = [
        Panel("maps-reliability", "reliability of the maps", "probability", "share of errors within it", reliable),
        Panel("maps-sparsification", "sparsification", "share taken away", "error of the rest", sparse),
    ]
    return Found(report, panels)


def _measure(network: StillRestorer, frame_BTCHW: Tensor, clean_BTCHW: Tensor) -> dict[str, Array]:
    assert network.maps is not None
    restored = network.stages(frame_BTCHW)
    assert restored.uncertainty is not None
    residual = (clean_BTCHW - restored.frames.clamp(0, 1))[0, 0]
    grey = frame_BTCHW[0, 0].mean(0)
    gradient = torch.hypot(*torch.gradient(grey))
    inner = (slice(BORDER, -BORDER), slice(BORDER, -BORDER))

    def local(x_HW: Tensor) -> Array:
        kept: Array = smoothed(x_HW[None, None])[0, 0][inner].numpy().ravel()
        return kept

    out = {
        "residual": residual[:, *inner].numpy().ravel(),
        "error": local(residual.abs().mean(0)),
        "gradient magnitude": local(gradient),
    }
    for name, found in (
        ("one pass", restored.uncertainty),
        ("Monte-Carlo dropout", network.maps.monte_carlo(frame_BTCHW, PASSES)),
    ):
        both = found.maps[0, 0].square().sum(0).sqrt()
        out[name] = local(both)
        out[f"{name}, scale"] = both[inner].expand(len(residual), -1, -1).numpy().ravel()
    return out


def draw_figures(panels: list[Panel], folder: Path) -> None:
    """Write each panel into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for panel in panels:
        panel.draw(folder)
