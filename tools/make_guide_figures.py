"""Pictures and the table of wavelengths of docs/guide/simulate.md. Run from the top of the checkout."""

from pathlib import Path

import numpy as np
import torch
from matplotlib.colors import hsv_to_rgb
from PIL import Image, ImageDraw

from turbnet.atmosphere.path import OpticalPath
from turbnet.data.sources import embedded_paths, load_picture
from turbnet.media.atomic import atomic_path
from turbnet.media.colour import to_linear, to_srgb
from turbnet.simulate.simulator import Simulator

IMAGES, PAGE = Path("docs/images"), Path("docs/guide/simulate.md")
BEGIN, END = "<!-- wavelengths: begin -->", "<!-- wavelengths: end -->"


def astronaut(size: int) -> torch.Tensor:
    """(3, size, size), sRGB."""
    return torch.from_numpy(load_picture(embedded_paths("test")[0])[:size, 120 : 120 + size]).permute(2, 0, 1)


def sheet(pictures: list[np.ndarray], titles: list[str], path: Path, columns: int | None = None) -> None:
    """Square pictures (H, H, 3) in [0, 1] under their titles, row by row; `columns` None: all in one row."""
    size, columns = pictures[0].shape[0], columns or len(pictures)
    whole = Image.new("RGB", (columns * (size + 4) - 4, -(-len(pictures) // columns) * (size + 16)), "white")
    for index, (picture, title) in enumerate(zip(pictures, titles, strict=True)):
        left, top = index % columns * (size + 4), index // columns * (size + 16)
        whole.paste(Image.fromarray((picture.clip(0, 1) * 255 + 0.5).astype(np.uint8)), (left, top + 16))
        ImageDraw.Draw(whole).text((left + 2, top + 2), title, fill="black")
    with atomic_path(path) as temporary:
        whole.save(temporary, format="PNG", optimize=True)


def strengths(size: int = 224) -> None:
    """One frame of the same atmosphere at four strengths."""
    scene, values, frames = astronaut(size), (1.0, 2.0, 3.0, 4.5), []
    for value in values:
        simulator = Simulator(OpticalPath.from_d_over_r0(value), size, size, margin=64)
        seen = simulator(to_linear(scene)[None, None], simulator.draw([3]).centred())
        frames.append(to_srgb(seen.frames[0, 0].clamp(0, 1)).permute(1, 2, 0).numpy())
    sheet(frames, [f"D/r0 = {value}" for value in values], IMAGES / "strengths.png")


def point_grid(size: int = 240) -> None:
    """Points through the whole simulator, each with its own tilt and blur."""
    values, pictures = (1.0, 3.0, 4.5), []
    scene = torch.zeros(1, 1, 1, size, size)
    scene[..., 12::24, 12::24] = 1.0
    for value in values:
        simulator = Simulator(OpticalPath.from_d_over_r0(value), size, size, margin=64, uniform=False, exact=True)
        seen = simulator(scene, simulator.draw([5]).centred()).frames[0, 0, 0].clamp(min=0)
        pictures.append(np.repeat((seen / seen.max()).sqrt().numpy()[..., None], 3, axis=2))
    sheet(pictures, [f"D/r0 = {value}" for value in values], IMAGES / "point-grid.png")


def tilt_map(size: int = 128, frames: int = 30) -> None:
    """Tilts of a clip, hue by direction and brightness by length."""
    simulator = Simulator(OpticalPath.from_d_over_r0(3.0), size, size)
    draw = simulator.draw([1], frames, torch.tensor([2.0, 0.0]), frame_rate=20.0).centred()
    x, y = simulator(torch.full((1, 1, 1, size, size), 0.5), draw).tilt[0].unbind(1)
    length = torch.hypot(x, y)
    hue = (torch.atan2(y, x) / (2 * torch.pi)) % 1
    colours = hsv_to_rgb(torch.stack((hue, torch.ones_like(hue), (length / length.max()) ** 0.7), -1).numpy())
    pictures = [Image.fromarray((colour * 255).astype(np.uint8)).quantize(64) for colour in colours]
    with atomic_path(IMAGES / "tilt-map.gif") as temporary:
        pictures[0].save(temporary, format="GIF", save_all=True, append_images=pictures[1:], duration=50, loop=0)


def wavelengths(size: int = 192) -> str:
    """Three wavelengths against one for all, as a table."""
    scene = to_linear(astronaut(size))[None, None]
    rows = ["| D/r0 | PSNR |", "|---|---|"]
    for strength in (1.0, 3.0, 4.5):
        path = OpticalPath.from_d_over_r0(strength, wavelength=535e-9)
        one = Simulator(path, size, size, margin=64, exact=True, components=60)
        three = Simulator(path, size, size, margin=64, exact=True, components=60, wavelengths=(620e-9, 535e-9, 460e-9))
        draw = one.draw([0])
        error = (three(scene, draw).frames - one(scene, draw).frames).square().mean()
        rows.append(f"| {strength:g} | {-10 * torch.log10(error):.1f} dB |")
    return "\n".join(rows)


def main() -> None:
    IMAGES.mkdir(exist_ok=True)
    with torch.no_grad():
        strengths()
        point_grid()
        tilt_map()
        table = wavelengths()
    print(table)
    head, rest = PAGE.read_text().split(BEGIN)
    PAGE.write_text(f"{head}{BEGIN}\n\n{table}\n\n{END}{rest.split(END)[1]}")


if __name__ == "__main__":
    main()
