"""Figures and the table of docs/guide/simulate.md, from embedded pictures. Run from the top of the checkout."""

from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw

from turbnet.atmosphere.covariance import zernike_covariance
from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Constant
from turbnet.data.sources import embedded_paths, load_picture
from turbnet.media.colour import to_linear, to_srgb
from turbnet.simulate.field import ZernikeField
from turbnet.simulate.simulator import Simulator

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


if __name__ == "__main__":
    strengths()
    covariance_table()
