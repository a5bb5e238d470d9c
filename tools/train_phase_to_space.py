"""Train the phase-to-space network, write it with its card and draw its error curve: two minutes on one core.

    python tools/train_phase_to_space.py

Run from the top of the checkout. The network starts from a cubature of the aperture and the least-squares last layer;
gradient steps on fresh draws make up for the points that are missing.
"""

import argparse
import hashlib
import json
import math
import time
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save
from torch import Tensor

from turbnet._version import __version__
from turbnet.atmosphere.noll import noll_matrix
from turbnet.media.atomic import atomic_path
from turbnet.simulate.phase_to_space import MODES, PhaseToSpace
from turbnet.simulate.psf_basis import tilt_free_psf

STRONGEST, BATCH, RATE, SEED = 6.0, 2048, 1e-4, 0
STRENGTHS = (0.25, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0, 6.0)
WEIGHTS, FIGURE = Path("turbnet/weights/phase_to_space.safetensors"), Path("docs/images/phase-to-space.png")


class Draws:
    """Coefficients a_4..a_36 of Kolmogorov turbulence with the full Noll covariance."""

    def __init__(self, seed: int) -> None:
        self._generator = torch.Generator().manual_seed(seed)
        self._factor = torch.from_numpy(np.linalg.cholesky(noll_matrix(range(4, MODES + 1)))).float()

    def __call__(self, count: int, d_over_r0: float | None = None) -> tuple[Tensor, Tensor]:
        """(count, 33) and the strengths (count, 1): one, or uniform from 0 to STRONGEST."""
        strength = STRONGEST * torch.rand(count, 1, generator=self._generator)
        if d_over_r0 is not None:
            strength = torch.full_like(strength, d_over_r0)
        white = torch.randn(count, MODES - 3, generator=self._generator)
        return white @ self._factor.T * strength ** (5 / 6), strength


def train(steps: int) -> PhaseToSpace:
    """The network after so many gradient steps."""
    draws, network = Draws(SEED), PhaseToSpace()
    network.fit_head(draws(20_000)[0])
    optimiser = torch.optim.Adam(network.parameters())
    for step in range(steps):
        for group in optimiser.param_groups:
            group["lr"] = RATE * 0.5 * (1 + math.cos(math.pi * step / steps))
        high, strength = draws(BATCH)
        exact = tilt_free_psf(high)
        error = (network(high) - exact).square().sum((1, 2)) / exact.square().sum((1, 2))
        # Weak turbulence counts as much as strong: its PSFs differ less and must be known better.
        loss = (error / (0.01 + 0.02 * strength[:, 0]) ** 2).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        if step % 500 == 0:
            print(f"step {step}: loss {loss.item():.4f}", flush=True)
    return network


@torch.no_grad()
def errors(network: PhaseToSpace, seed: int = 1) -> list[dict[str, float]]:
    """Relative L2 error of PSFs never trained on, beside that of the mean PSF of the same strength."""
    draws, rows = Draws(seed), []
    for strength in STRENGTHS:
        high, _ = draws(4000, strength)
        exact = tilt_free_psf(high).flatten(1)
        size = exact.norm(dim=1)
        learned = (network(high).flatten(1) - exact).norm(dim=1) / size
        mean = (exact.mean(0) - exact).norm(dim=1) / size
        rows.append(
            {
                "d_over_r0": strength,
                "median": float(learned.median()),
                "95 %": float(learned.quantile(0.95)),
                "median of the mean PSF": float(mean.median()),
            }
        )
    return rows


def draw_curve(rows: list[dict[str, float]], path: Path) -> None:
    """Error over D/r0, beside the mean PSF's."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.6, 3.6), layout="constrained")
    axes = figure.subplots()
    strength = [row["d_over_r0"] for row in rows]
    for name, style in (("median", "o-"), ("95 %", "--"), ("median of the mean PSF", "s-")):
        axes.plot(strength, [100 * row[name] for row in rows], style, label=name, markersize=4)
    axes.axhline(5, color="grey", linewidth=0.8)
    axes.set(yscale="log", xlabel="$D/r_0$", ylabel="relative $L_2$ error of the PSF (%)")
    axes.legend(fontsize=8)
    axes.grid(alpha=0.3)
    with atomic_path(path) as temporary:
        FigureCanvasAgg(figure).print_png(temporary, metadata={"Software": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=3000)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    start = time.process_time()
    network = train(arguments.steps)
    seconds = time.process_time() - start
    rows = errors(network)
    data = save({name: value.detach().contiguous() for name, value in network.state_dict().items()})
    card = {
        "architecture": "turbnet.simulate.phase_to_space.PhaseToSpace",
        "maps": "Zernike coefficients a_4..a_36 (rad, Noll) to the tilt-free PSF on 31 x 31 pixels of lambda / (2 D)",
        "data": f"Kolmogorov draws with the full Noll covariance, D/r0 uniform 0..{STRONGEST:g}, fresh at every step",
        "seed": SEED,
        "steps": arguments.steps,
        "processor seconds": round(seconds),
        "recipe": "python tools/train_phase_to_space.py",
        "relative L2 error over D/r0": rows,
        "known failures": "beyond D/r0 = 6 the outer speckles, farther than 8 pixels, are missing; other apertures than a "
        "full disk",
        "version": __version__,
        "sha256": hashlib.sha256(data).hexdigest(),
    }
    table = "\n".join(
        f"| {r['d_over_r0']:g} | {r['median']:.2%} | {r['95 %']:.2%} | {r['median of the mean PSF']:.1%} |"
        for r in rows
    )
    facts = "\n".join(f"| {k} | {v} |" for k, v in card.items() if not isinstance(v, list))
    text = (
        f"# phase_to_space\n\n| | |\n|---|---|\n{facts}\n\nRelative L2 error of PSFs never trained on:\n\n"
        f"| D/r0 | median | 95 % of PSFs below | mean PSF instead |\n|---|---|---|---|\n{table}\n"
    )
    for path, content in (
        (WEIGHTS, data),
        (WEIGHTS.with_suffix(".json"), (json.dumps(card, indent=2) + "\n").encode()),
        (WEIGHTS.with_suffix(".md"), text.encode()),
    ):
        with atomic_path(path) as temporary:
            temporary.write_bytes(content)
    draw_curve(rows, FIGURE)
    print(table)


if __name__ == "__main__":
    main()
