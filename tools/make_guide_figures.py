"""Picture, tables and figures of docs/guide/simulate.md, from embedded pictures. Run from the top of the checkout."""

from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw

from turbnet.atmosphere.covariance import zernike_covariance
from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Constant
from turbnet.data.sources import embedded_paths, load_picture
from turbnet.media.colour import to_linear, to_srgb
from turbnet.optics.psf import psf
from turbnet.optics.pupil import circular, pupil_grid
from turbnet.optics.superposition import scatter
from turbnet.optics.zernike import zernike_basis
from turbnet.simulate.blur import KERNEL, psf_basis, tilt_free_psf
from turbnet.simulate.field import ZernikeField
from turbnet.simulate.simulator import Simulator
from turbnet.simulate.tilt import upsample

IMAGES = Path("docs/images")
PAIRS = ((2, 2), (3, 3), (4, 4), (2, 4), (2, 8), (4, 11))
SEPARATIONS = (0, 8, 32, 128, 512)


def strengths(size: int = 224) -> None:
    """One frame of the same atmosphere at four strengths."""
    scene = torch.from_numpy(load_picture(embedded_paths("test")[0])[:size, 120 : 120 + size]).permute(2, 0, 1)
    values = (1.0, 2.0, 3.0, 4.5)
    sheet = Image.new("RGB", (len(values) * (size + 4) - 4, size + 16), "white")
    for index, value in enumerate(values):
        simulator = Simulator(OpticalPath.from_d_over_r0(value), size, size)
        seen = simulator(to_linear(scene)[None, None], simulator.draw([3]).centred())
        frame = to_srgb(seen.frames[0, 0].clamp(0, 1)).permute(1, 2, 0).numpy()
        sheet.paste(Image.fromarray((frame * 255 + 0.5).astype(np.uint8)), (index * (size + 4), 16))
        ImageDraw.Draw(sheet).text((index * (size + 4) + 2, 2), f"D/r0 = {value}", fill="black")
    IMAGES.mkdir(exist_ok=True)
    sheet.save(IMAGES / "strengths.png", optimize=True)


def covariance_table() -> None:
    """What the field holds against quadrature."""
    path = OpticalPath(0.2034, 7000.0, Constant(1e-15), 525e-9)
    field = ZernikeField(path, 513, 513, modes=11)
    print("| pair | " + " | ".join(f"{s} px" for s in SEPARATIONS) + " |")
    print("|---" * (len(SEPARATIONS) + 1) + "|")
    offsets = np.array(SEPARATIONS) * path.pixel
    for i, j in PAIRS:
        exact = zernike_covariance(path, i, j, offsets)
        scale = np.sqrt(zernike_covariance(path, i, i, 0.0) * zernike_covariance(path, j, j, 0.0))
        error = 100 * (field.covariance(i, j, np.array(SEPARATIONS)) - exact) / scale
        print(f"| a{i} a{j} | " + " | ".join(f"{e:+.1f}" for e in np.ravel(error)) + " |")


def fine_psfs(coefficients_PN: torch.Tensor, first: int, points: int, size: int) -> torch.Tensor:
    """PSFs of a_first..a_36 from a pupil of `points` samples across, (P, size, size)."""
    x, y = pupil_grid(points)
    modes = torch.from_numpy(zernike_basis(range(first, 37), np.hypot(x, y), np.arctan2(y, x))).float()
    pupil = torch.from_numpy(circular(points, subsamples=16)).float()
    parts = [psf(torch.einsum("pn,nyx->pyx", c, modes), pupil, size) for c in coefficients_PN.split(512)]
    return torch.cat(parts)


def picture_error(size: int = 112, edge: int = 24, window: int = 47) -> None:
    """PSNR of the simulator against dense scatter with whole PSFs, and what a uniform scene does without its division."""
    scene = torch.from_numpy(load_picture(embedded_paths("test")[0])[100 : 100 + size, 150 : 150 + size, 0].copy())
    print("\n| D/r0 | 10 components | 20 | 40 | uniform scene flickers by, if undivided | PSF against a finer pupil |")
    print("|---|---|---|---|---|---|")
    for strength in (1.0, 2.0, 3.0, 4.5, 6.0):
        simulator = Simulator(OpticalPath.from_d_over_r0(strength), size, size, margin=0)
        draw = simulator.draw([0])
        fine = upsample(draw.coefficients[0], draw.stride, size, size)[0].flatten(1).T
        whole = fine_psfs(fine, 2, 32, window).view(size, size, window, window)
        uniform = scatter(torch.ones_like(scene), whole)
        exact = scatter(scene, whole) / uniform
        cells = []
        for components in (10, 20, 40):
            simulator.basis = psf_basis(components, strength, strength)
            error = (simulator(scene[None, None, None], draw).frames[0, 0, 0] - exact)[edge:-edge, edge:-edge]
            cells.append(f"{-10 * torch.log10(error.square().mean()):.1f} dB")
        flicker = 100 * uniform[edge:-edge, edge:-edge].std()
        points = fine[::97, 2:]
        truth = fine_psfs(points, 4, 64, KERNEL)
        relative = 100 * (tilt_free_psf(points) - truth).norm() / truth.norm()
        print(f"| {strength} | " + " | ".join(cells) + f" | {flicker:.0f} % | {relative:.1f} % |")


if __name__ == "__main__":
    strengths()
    covariance_table()
    picture_error()
