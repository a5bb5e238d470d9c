"""Print the guide's table of `fit_strength`: known strengths, recovered from simulated clips; six minutes.

python tools/fit_table.py
"""

from collections.abc import Iterator

import numpy as np
import skimage.data
import torch

from turbnet.atmosphere.path import OpticalPath
from turbnet.simulate.fit import Fit, fit_strength
from turbnet.simulate.sensor import Sensor
from turbnet.simulate.simulator import Simulator

SIZE, FRAMES, READ_NOISE, SEEDS = 160, 40, 0.01, (11, 12, 13)
PICTURES = {
    "astronaut": skimage.data.astronaut()[20:, 150:].mean(-1) / 255,
    "camera": skimage.data.camera()[60:, 130:] / 255,
}
STRENGTHS = (1.0, 2.0, 4.0)
WINDS = {"independent": None, "wind 2 m/s": (2.0, 0.0)}


def clip(scene: np.ndarray, strength: float, seed: int, wind: tuple[float, float] | None) -> torch.Tensor:
    """40 noisy frames (T, H, W), linear."""
    simulator = Simulator(OpticalPath.from_d_over_r0(strength), SIZE, SIZE, sensor=Sensor(read_noise=READ_NOISE))
    picture = torch.from_numpy(scene[:SIZE, :SIZE].copy()).float()[None, None, None]
    velocity = None if wind is None else torch.tensor(wind)
    with torch.no_grad():
        frames = [
            simulator(picture, simulator.draw([seed], 1, velocity, start=t), noise_seed=1000 * seed + t).frames
            for t in range(FRAMES)
        ]
    return torch.cat(frames)[:, 0, 0]


def fits() -> Iterator[tuple[str, str, float, list[Fit]]]:
    """Picture, kind of clip, true D/r0 and the fit of each seed. The fit is told the geometry, not the strength."""
    geometry = OpticalPath.from_d_over_r0(3.0)
    for kind, wind in WINDS.items():
        for name, scene in PICTURES.items():
            for strength in STRENGTHS:
                yield name, kind, strength, [fit_strength(clip(scene, strength, s, wind), geometry) for s in SEEDS]


def main() -> None:
    print("| picture | frames | D/r0 | recovered, three seeds | error, % | stated error, % |")
    print("|---|---|---|---|---|---|")
    for name, kind, strength, found in fits():
        values = ", ".join(f"{f.d_over_r0:.2f}" for f in found)
        errors = ", ".join(f"{100 * (f.d_over_r0 / strength - 1):+.0f}" for f in found)
        stated = ", ".join(f"{100 * f.uncertainty / f.d_over_r0:.0f}" for f in found)
        print(f"| {name} | {kind} | {strength:g} | {values} | {errors} | {stated} |", flush=True)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
