"""make demo: the whole path on embedded pictures, nothing to download.

Clean pictures -> turbulence in the loop -> a tiny network trained on the CPU -> ONNX -> a restored clip, scored on a
picture that was never trained on. Leaves everything in outputs/demo/. Exits with 1 if the restored clip does not beat
both its input and the temporal mean in PSNR.
"""

import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from turbnet.data.pairs import PairMaker
from turbnet.data.sources import embedded_paths, load_picture
from turbnet.data.text import fonts
from turbnet.media.clip import read_clip, write_clip

OUTPUT = Path("outputs/demo")
SIZE, FRAMES, STRENGTH = 256, 24, 2.5


def main() -> int:
    started = time.perf_counter()
    shutil.rmtree(OUTPUT, ignore_errors=True)
    OUTPUT.mkdir(parents=True)
    say(f"held-out clip: {FRAMES} frames of astronaut with a line of text, D/r0 = {STRENGTH}")
    clean = held_out_scene()
    turbulent = look_through_turbulence(clean)
    Image.fromarray(to_bytes(clean)).save(OUTPUT / "clean.png")
    write_clip(OUTPUT / "turbulent.mkv", turbulent, fps=30)

    say("training (turbnet train experiment=tiny)")
    turbnet("train", "experiment=tiny", f"output={OUTPUT / 'train'}")
    say("export")
    turbnet("export", OUTPUT / "train/checkpoints/last.ckpt", "-o", OUTPUT / "tiny.onnx")
    say("restore")
    turbnet(
        *("restore", OUTPUT / "turbulent.mkv", "-o", OUTPUT / "restored.mkv"),
        *("--model", OUTPUT / "tiny.onnx", "--json", OUTPUT / "restore.json"),
    )
    say("evaluate")
    turbnet(
        *("evaluate", "--restored", OUTPUT / "restored.mkv", "--reference", OUTPUT / "clean.png"),
        *("--input", OUTPUT / "turbulent.mkv", "--json", OUTPUT / "metrics.json"),
    )
    restored, _ = read_clip(OUTPUT / "restored.mkv")
    side_by_side(turbulent[0], turbulent.mean(0), restored[0], clean).save(OUTPUT / "comparison.png")

    figures = rows("metrics.json") | rows("restore.json")
    print(f"\n{'':16s}{'PSNR dB':>9s}{'SSIM':>9s}")
    for name in ("input", "temporal mean", "restored"):
        print(f"{name:16s}{figures[f'{name} psnr']:9.2f}{figures[f'{name} ssim']:9.4f}")
    print(f"\nrestoring took {figures['time a frame']:.0f} ms a frame; all of it {time.perf_counter() - started:.0f} s")
    print(f"clips, picture, model and card: {OUTPUT}/")
    return int(figures["restored psnr"] <= max(figures["input psnr"], figures["temporal mean psnr"]))


def held_out_scene() -> np.ndarray:
    """A part of a picture that is never trained on, with a line of text."""
    picture = load_picture(embedded_paths("test")[0])
    scene = Image.fromarray(to_bytes(picture[:SIZE, 110 : 110 + SIZE]))
    draw = ImageDraw.Draw(scene)
    font = ImageFont.truetype(str(next(path for path in fonts() if path.name == "DejaVuSans-Bold.ttf")), 26)
    draw.rectangle((12, 212, 244, 246), fill=(235, 235, 225))
    draw.text((20, 214), "TURBNET 7 KM", fill=(20, 20, 30), font=font)
    return np.asarray(scene, dtype=np.float32) / 255


def look_through_turbulence(clean: np.ndarray) -> np.ndarray:
    """Frames (T, H, W, 3) of a still scene under a fresh breeze."""
    scene = torch.from_numpy(clean).permute(2, 0, 1).expand(1, FRAMES, 3, SIZE, SIZE)
    maker = PairMaker(
        SIZE,
        SIZE,
        d_over_r0=(STRENGTH, STRENGTH),
        wind=(8.0, 8.0),
        independent=0.0,
        stride=4,
        components=20,
        margin=None,
    )
    return maker(scene, [2026]).frames[0].permute(0, 2, 3, 1).numpy()


def side_by_side(*pictures: np.ndarray) -> Image.Image:
    """Input, temporal mean, restored and clean, with their names."""
    names = ("one input frame", "temporal mean", "restored", "clean")
    sheet = Image.new("RGB", (len(names) * (SIZE + 4) - 4, SIZE + 18), "white")
    draw = ImageDraw.Draw(sheet)
    for index, (name, picture) in enumerate(zip(names, pictures, strict=True)):
        sheet.paste(Image.fromarray(to_bytes(picture)), (index * (SIZE + 4), 18))
        draw.text((index * (SIZE + 4) + 2, 3), name, fill="black")
    return sheet


def to_bytes(picture: np.ndarray) -> np.ndarray:
    return (picture.clip(0, 1) * 255 + 0.5).astype(np.uint8)


def rows(name: str) -> dict[str, float]:
    return {row["name"]: row["value"] for row in json.loads((OUTPUT / name).read_text())["rows"]}


def turbnet(*arguments: object) -> None:
    """Run the command line as a user does."""
    subprocess.run([sys.executable, "-m", "turbnet", *map(str, arguments)], check=True)


def say(text: str) -> None:
    print(f"\n-- {text}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
