"""PSFs of a whole grid of object points by split-step propagation, kept on disk as they come, so a killed run goes on.

The folder of a run holds `run.json`, which says what is computed, and one file for every chunk of points. Each appears
whole or not at all. The air is drawn anew from the seed, and a chunk depends on nothing but the air and its own points,
so an interrupted run gives to the last bit what an uninterrupted one does. The path enters `run.json` as its repr: a
profile of one's own should be a dataclass, or state its values in another way.
"""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import torch
from rich.console import Console
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from turbnet._version import __version__
from turbnet.errors import InputError, ParameterError, check_range
from turbnet.media.atomic import atomic_path
from turbnet.media.guard import read_json
from turbnet.optics.superposition import scatter
from turbnet.progress import progress_bar
from turbnet.simulate.parallel import on_all_cores
from turbnet.simulate.split_step import SplitStep
from turbnet.simulate.wavefront import Aperture

MODES = 36


@dataclass(frozen=True)
class PointField:
    """What the camera sees of every point.

    Attributes:
        psf: full PSFs with their tilt, (P, K, K), unit sum.
        tilt_free_psf: the same with Zernike modes 2 and 3 taken off.
        coefficients: Zernike coefficients a_1 .. a_36, (P, 36), rad; index j - 1.
    """

    psf: Tensor
    tilt_free_psf: Tensor
    coefficients: Tensor

    def image(self, scene: Tensor) -> Tensor:
        """The turbulent image of a scene (..., H, W) whose pixels are the points, row by row: an exact scatter.

        Raises:
            ParameterError: the scene has another number of pixels than there are points.
        """
        height, width = scene.shape[-2:]
        if height * width != len(self.psf):
            raise ParameterError(f"a scene of {height} x {width} pixels needs as many points, not {len(self.psf)}")
        return scatter(scene, self.psf.unflatten(0, (height, width)).to(scene.dtype))


def run_points(
    split_step: SplitStep,
    folder: str | Path,
    seed: int = 0,
    size: int = 33,
    q: float = 1.0,
    chunk: int = 4,
    *,
    quiet: bool = False,
) -> PointField:
    """Propagate every point of `split_step` through one draw of the air; go on where an earlier call stopped.

    Says what it will cost before it starts and shows a progress bar, both on standard error, unless `quiet`.

    Args:
        split_step: path, sampling and points.
        folder: of the run; made if need be.
        seed: of the air.
        size: PSF pixels along a side, odd.
        q: PSF pixel in units of lambda / (2D).
        chunk: points propagated, and kept, together.
        quiet: no output.

    Raises:
        InputError: the folder cannot be used or holds another run.
    """
    check_range("PSF size", size, 1, 2 * split_step.sampling.across / q, "pixels")
    check_range("chunk", chunk, 1, 4096, "points")
    folder = Path(folder)
    _claim(folder, split_step, {"seed": seed, "size": size, "q": q, "chunk": chunk})
    starts = range(0, len(split_step.points), chunk)
    files = [folder / f"points-{start:06d}.safetensors" for start in starts]
    missing = [(start, file) for start, file in zip(starts, files, strict=True) if not file.exists()]
    console = Console(stderr=True, quiet=quiet)
    if missing:
        console.print(str(split_step.cost), highlight=False)
        turbulence = split_step.draw(torch.Generator().manual_seed(seed))
        aperture = Aperture(split_step.sampling.across, MODES, turbulence.phases[0])

        def propagate(piece: tuple[int, Path]) -> None:
            start, file = piece
            points = range(start, min(start + chunk, len(split_step.points)))
            fields = split_step.pupil_fields(turbulence, points)[0]
            phase = split_step.phase(fields, split_step.geometric_phase(turbulence, points)[0])
            coefficients = aperture.coefficients(phase)
            tilt = coefficients[:, :3] * coefficients.new_tensor([0.0, 1.0, 1.0])
            state = {
                "psf": aperture.psf(fields, size, q),
                "tilt_free_psf": aperture.psf(fields, size, q, without=tilt),
                "coefficients": coefficients,
            }
            with atomic_path(file) as temporary:
                save_file({name: value.cpu().contiguous() for name, value in state.items()}, temporary)

        # A GPU takes one piece at a time, and all of it.
        cores = torch.get_num_threads() if turbulence.phases[0].device.type == "cpu" else 1
        pieces = on_all_cores(propagate, missing, cores)
        with progress_bar(quiet) as progress:
            task = progress.add_task("split-step", total=len(files), completed=len(files) - len(missing))
            for _ in pieces:
                progress.advance(task)
    states = []
    for start, file in zip(starts, files, strict=True):
        count = min(start + chunk, len(split_step.points)) - start
        shapes = {"psf": (count, size, size), "tilt_free_psf": (count, size, size), "coefficients": (count, MODES)}
        try:
            state = load_file(file)
        except (OSError, SafetensorError) as error:
            raise InputError(f"cannot read {file}: {error}; delete the damaged file and run again") from error
        if {name: tuple(value.shape) for name, value in state.items()} != shapes:
            raise InputError(f"cannot read {file}: it holds other points; delete it and run again")
        states.append(state)
    return PointField(**{name: torch.cat([state[name] for state in states]) for name in states[0]})


def _claim(folder: Path, split_step: SplitStep, request: dict[str, float]) -> None:
    """Write what the folder will hold, or check that it holds just that."""
    sampling = split_step.sampling
    plan = {
        "version": __version__,
        "path": repr(sampling.path),
        "grid": sampling.grid,
        "extent": sampling.extent,
        "screens": sampling.screens,
        "scales": [str(scale) for scale in split_step.scales],
        "points": hashlib.sha256(split_step.points.tobytes()).hexdigest(),
        "dtype": str(split_step.dtype),
        **request,
    }
    file = folder / "run.json"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        found = read_json(file) if file.exists() else None
    except (OSError, InputError) as error:
        raise InputError(f"cannot use {folder} for a split-step run: {error}") from error
    if found is None:
        with atomic_path(file) as temporary:
            temporary.write_text(json.dumps(plan, indent=2) + "\n")
    elif found != plan:
        differing = [key for key in plan if not isinstance(found, dict) or found.get(key) != plan[key]]
        raise InputError(
            f"{folder} holds another run ({', '.join(differing)} differ); choose another folder or delete it"
        )
