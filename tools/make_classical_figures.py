"""Pictures and tables of docs/classical, from pictures inside scikit-image. Run from the top of the checkout; minutes."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import skimage.data
import torch
from PIL import Image, ImageDraw

from turbnet.atmosphere.path import OpticalPath
from turbnet.classical import deconvolution, sharpness
from turbnet.classical.blind import KernelModel, blind_deconvolution, strength_of_dance
from turbnet.classical.fusion import fourier_burst, fuse, hard_weights, patch_fusion, soft_weights
from turbnet.classical.local import luminance
from turbnet.classical.pipeline import restore
from turbnet.classical.reference import low_rank_plus_sparse, non_local_mean, still_variance, temporal_mean
from turbnet.classical.registration import control_point_flow, optical_flow, register
from turbnet.media.colour import to_linear, to_srgb
from turbnet.metrics.fidelity import psnr
from turbnet.simulate.simulator import Simulator

IMAGES = Path("docs/images")
STRENGTH, NOISE, BORDER = 3.0, 0.005, 8


def simulate(picture: np.ndarray, frames: int, strength: float = STRENGTH) -> tuple[np.ndarray, np.ndarray]:
    """A scene (H, W, 3), linear, and a clip of it (T, H, W, 3) of 8-bit frames."""
    scene = to_linear((picture / 255).astype(np.float32))
    simulator = Simulator(OpticalPath.from_d_over_r0(strength), *scene.shape[:2])
    planes = torch.from_numpy(np.moveaxis(scene, -1, 0).copy())[None, None]
    clip = np.moveaxis(simulator(planes, simulator.draw([1], frames).centred()).frames[0].numpy(), 1, -1)
    clip = clip + NOISE * np.random.default_rng(1).standard_normal(clip.shape)
    return scene, to_linear((to_srgb(clip.clip(0, 1)) * 255).round() / 255).astype(np.float32)


def score(picture: np.ndarray, scene: np.ndarray) -> float:
    """PSNR, dB, of the encoded picture."""
    return float(psnr(to_srgb(picture.clip(0, 1)), to_srgb(scene), BORDER))


def sheet(name: str, pictures: dict[str, np.ndarray]) -> None:
    """Linear pictures side by side, each under its name."""
    height, width = next(iter(pictures.values())).shape[:2]
    paper = Image.new("RGB", (len(pictures) * (width + 4) - 4, height + 16), "white")
    for index, (title, picture) in enumerate(pictures.items()):
        pixels = (to_srgb(picture.clip(0, 1)) * 255 + 0.5).astype(np.uint8)
        paper.paste(Image.fromarray(pixels), (index * (width + 4), 16))
        ImageDraw.Draw(paper).text((index * (width + 4) + 2, 2), title, fill="black")
    paper.save(IMAGES / f"classical-{name}.png", optimize=True)


def table(title: str, rows: dict[str, np.ndarray], scene: np.ndarray) -> None:
    print(f"\n{title}\n\n| | PSNR, dB |\n|---|---|")
    for name, picture in rows.items():
        print(f"| {name} | {score(picture, scene):.2f} |")


def with_disk(frames: np.ndarray) -> np.ndarray:
    """A yellow disk crosses the scene."""
    count, height, width, _ = frames.shape
    y, x = np.mgrid[:height, :width]
    centres = np.linspace(0.1 * width, 0.9 * width, count)
    inside = np.stack([(x - centre) ** 2 + (y - 0.7 * height) ** 2 < 14**2 for centre in centres])
    return np.where(inside[..., None], np.array([0.9, 0.8, 0.1], np.float32), frames)


def references(scene: np.ndarray, frames: np.ndarray) -> None:
    middle = len(frames) // 2
    makers: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        "frame": lambda clip: clip[middle],
        "temporal mean": temporal_mean,
        "low rank": lambda clip: low_rank_plus_sparse(clip)[0][middle],
        "non-local mean": lambda clip: non_local_mean(clip, middle),
    }
    moving = with_disk(frames)
    sheet("reference", {name: make(moving) for name, make in makers.items()})
    table("references, still scene", {name: make(frames) for name, make in makers.items()}, scene)


def registrations(scene: np.ndarray, frames: np.ndarray) -> np.ndarray:
    mean = temporal_mean(frames)
    flow, _ = register(frames, mean, optical_flow)
    half, _ = register(frames, mean, optical_flow, reduction=2)
    spline, _ = register(frames, mean, control_point_flow)
    rows = {"temporal mean": mean, "optical flow": flow.mean(0), "B-spline": spline.mean(0)}
    sheet("registration", {"frame": frames[0], **rows, "scene": scene})
    table("mean of registered frames", {**rows, "optical flow, half resolution": half.mean(0)}, scene)
    return half


def fusions(scene: np.ndarray, registered: np.ndarray) -> None:
    y = luminance(registered)
    rows = {"mean": registered.mean(0)}
    for name, measure in sharpness.MEASURES.items():
        rows[f"{name}, soft, p = 2"] = fuse(registered, soft_weights(measure(y)))
        rows[f"{name}, hard, a quarter"] = fuse(registered, hard_weights(measure(y)))
    likeness = sharpness.consistency(y, y.mean(0))
    rows["consistency, soft, p = 8"] = fuse(registered, soft_weights(likeness, 8.0))
    rows["variance, hard, patches"] = patch_fusion(registered, hard_weights(sharpness.variance(y)))
    rows["Fourier burst, p = 11"] = fourier_burst(registered)
    shown = ("mean", "variance, soft, p = 2", "variance, hard, a quarter", "Fourier burst, p = 11")
    sheet("fusion", {**{name: rows[name] for name in shown}, "scene": scene})
    table("fusion of registered frames", rows, scene)


def deconvolutions(scene: np.ndarray, frames: np.ndarray) -> None:
    registered, shifts = register(frames, temporal_mean(frames), reduction=2)
    picture = registered.mean(0)
    strength = strength_of_dance(shifts)
    noise = float(np.sqrt(still_variance(luminance(registered)).mean() / len(registered)))
    kernel = KernelModel.around(strength, components=0).mean
    ratio = (2 * np.pi * noise / deconvolution.mean_step(picture)) ** 2
    denoise = deconvolution.non_local_means
    rows = {
        "registered mean": picture,
        "Wiener": deconvolution.wiener(picture, kernel, ratio),
        "Richardson-Lucy": deconvolution.richardson_lucy(picture, kernel),
        "total variation": deconvolution.total_variation(picture, kernel, noise),
        "plug and play": deconvolution.plug_and_play(picture, kernel, denoise, noise, 2.0),
        "blind": blind_deconvolution(picture, noise, strength)[0],
    }
    sheet("deconvolution", {**rows, "scene": scene})
    table(f"deconvolution, D/r0 seen in the dance {strength:.2f}, true {STRENGTH:g}", rows, scene)
    print("\n| kernel for D/r0 = | " + " | ".join(f"{d:g}" for d in (1, 2, 3, 4)) + " |")
    scores = (
        score(deconvolution.total_variation(picture, KernelModel.around(d, 0).mean, noise), scene) for d in (1, 2, 3, 4)
    )
    print("|---|---|---|---|---|\n| PSNR, dB | " + " | ".join(f"{value:.2f}" for value in scores) + " |")


def pipelines(pictures: dict[str, np.ndarray]) -> None:
    print("\n| scene | D/r0 | frames | input | temporal mean | pipeline | D/r0 seen |\n|---|---|---|---|---|---|---|")
    for name, picture in pictures.items():
        for strength, count in ((1.5, 12), (3.0, 12), (3.0, 50), (4.5, 50)):
            scene, frames = simulate(picture, count, strength)
            done = restore(frames, cores=2)
            cells = (
                np.mean([score(frame, scene) for frame in clip]) for clip in (frames, [frames.mean(0)], done.frames)
            )
            figures = " | ".join(f"{value:.2f}" for value in cells)
            print(f"| {name} | {strength:g} | {count} | {figures} | {done.d_over_r0:.2f} |", flush=True)
            if (name, strength, count) == ("astronaut", 3.0, 50):
                shown = {"frame": frames[25], "temporal mean": frames.mean(0), "pipeline": done.frames[25]}
                sheet("pipeline", {**shown, "scene": scene})


if __name__ == "__main__":
    IMAGES.mkdir(exist_ok=True)
    astronaut = skimage.data.astronaut()[:160, 150:310]
    scene, frames = simulate(astronaut, 12)
    references(scene, frames)
    registered = registrations(scene, frames)
    fusions(scene, registered)
    deconvolutions(scene, frames)
    camera = np.repeat(skimage.data.camera()[80:240, 150:310, None], 3, axis=-1)
    pipelines({"astronaut": astronaut, "camera": camera, "coffee": skimage.data.coffee()[100:260, 220:380]})
