"""`turbnet simulate` as a user runs it."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import skimage.data
from PIL import Image

from turbnet.media.clip import read_clip, write_clip


def simulate(folder: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "turbnet", "simulate", *map(str, arguments)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def photo(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("photo") / "photo.png"
    Image.fromarray(skimage.data.astronaut()[40:97, 180:243]).save(path)
    return path


def test_a_photo_becomes_a_turbulent_clip_with_its_truth(tmp_path, photo):
    path = ("--aperture", 0.2, "--distance", 7000, "--cn2", 1e-15)
    done = simulate(tmp_path, photo, "-o", "clip.mkv", *path, "--frames", 4, "--truth", "truth", "--json", "path.json")
    assert done.returncode == 0, done.stderr
    frames, info = read_clip(tmp_path / "clip.mkv")
    assert frames.shape == (4, 57, 63, 3)
    assert info.fps == pytest.approx(30)
    tilt = np.load(tmp_path / "truth/tilt.npy")
    assert tilt.shape == (4, 2, 57, 63)
    # sqrt(0.449 (D/r0)^(5/3)) rad, 4/pi pixels each; one clip of few frames scatters widely about it.
    assert 0.3 < tilt.std() < 6
    for name in ("blur_only", "tilt_only"):
        assert read_clip(tmp_path / f"truth/{name}.mkv")[0].shape == frames.shape
    rows = {row["name"]: row for row in json.loads((tmp_path / "path.json").read_text())["rows"]}
    assert rows["D/r0"]["value"] == pytest.approx(4.19, abs=0.01)
    assert rows["Fried parameter r0"]["unit"] == "m"


def test_the_same_seed_gives_the_same_clip(tmp_path, photo):
    clips = []
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        assert simulate(tmp_path, photo, "-o", f"{name}.mkv", "--frames", 2, "--seed", seed, "--quiet").returncode == 0
        clips.append(read_clip(tmp_path / f"{name}.mkv")[0])
    assert np.array_equal(clips[0], clips[1])
    assert not np.array_equal(clips[0], clips[2])


def test_still_air_changes_nothing(tmp_path, photo):
    assert simulate(tmp_path, photo, "-o", "out.png", "--cn2", 0, "--frames", 1).returncode == 0
    np.testing.assert_array_equal(Image.open(tmp_path / "out.png"), Image.open(photo))


def test_frames_of_a_wind_are_coherent_and_independent_ones_are_not(tmp_path, photo):
    jumps = []
    for arguments in (("--wind", 0.5), ("--independent",)):
        assert simulate(tmp_path, photo, "-o", "c.mkv", "--frames", 5, *arguments).returncode == 0
        clip, _ = read_clip(tmp_path / "c.mkv")
        jumps.append(float(np.abs(np.diff(clip, axis=0)).mean()))
    assert jumps[0] < 0.5 * jumps[1]


def test_a_camera_s_whole_chain(tmp_path, photo):
    """Pixel pitch, colours, exposures, boiling air, outer scale, compression: together and reproducible."""
    camera = ("--focal-length", 2, "--pixel-pitch", 4e-6, "--wavelengths", "620e-9,535e-9,460e-9", "--jpeg", 60)
    air = ("--d-over-r0", 2, "--boiling", 0.5, "--outer-scale", 5, "--wind-direction", 90)
    for name in ("a.mkv", "b.mkv"):
        more = ("--frames", 2, "--exposures", 3, "--shutter", 0.5, "--bits", 8, "--truth", f"truth-{name}")
        done = simulate(tmp_path, photo, "-o", name, *camera, *air, *more)
        assert done.returncode == 0, done.stderr
    # q = 2 D p / (lambda f) = 1.55 Nyquist pixels of 9.03 mm.
    assert "0.014 m" in done.stdout
    np.testing.assert_array_equal(read_clip(tmp_path / "a.mkv")[0], read_clip(tmp_path / "b.mkv")[0])
    strength = np.load(tmp_path / "truth-a.mkv/blur_strength.npy")
    assert strength.shape == (2, 57, 63)
    # sqrt of 0.134 (D/r0)^(5/3) less what modes beyond 36 hold; one small patch scatters about it.
    assert 0.2 < strength.mean() < 1.2


def test_the_plan_is_printed_and_nothing_written(tmp_path, photo):
    done = simulate(tmp_path, photo, "--plan", "--d-over-r0", 1)
    assert done.returncode == 0, done.stderr
    assert "of the work saved" in done.stdout
    assert not list(tmp_path.iterdir())


def test_a_clip_like_another(tmp_path):
    scene = Image.fromarray(skimage.data.astronaut()[:128, 160:288])
    scene.save(tmp_path / "scene.png")
    made = simulate(
        tmp_path, "scene.png", "-o", "real.mkv", "--d-over-r0", 2, "--frames", 40, "--independent", "--quiet"
    )
    assert made.returncode == 0, made.stderr
    done = simulate(tmp_path, "scene.png", "-o", "like.mkv", "--like", "real.mkv", "--frames", 1, "--json", "path.json")
    assert done.returncode == 0, done.stderr
    rows = {row["name"]: row for row in json.loads((tmp_path / "path.json").read_text())["rows"]}
    assert rows["D/r0"]["value"] == pytest.approx(2.0, rel=0.15)


def test_a_grey_clip_stays_grey_and_keeps_its_frames(tmp_path):
    rng = np.random.default_rng(0)
    grey = np.repeat(rng.random((3, 24, 20, 1), dtype=np.float32), 3, axis=3)
    write_clip(tmp_path / "grey.tif", grey, grey=True)
    assert simulate(tmp_path, "grey.tif", "-o", "out.tif", "--d-over-r0", 1).returncode == 0
    frames, info = read_clip(tmp_path / "out.tif")
    assert frames.shape == grey.shape
    assert info.grey


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("missing.png", "-o", "out.mkv"), "missing.png"),
        (("PHOTO", "-o", "out.xyz"), "out.xyz"),
        (("PHOTO", "-o", "no/such/folder/out.mkv"), "folder"),
        (("PHOTO", "-o", "out.mkv", "--cn2", "-1e-15"), "Cn2"),
        (("PHOTO", "-o", "out.mkv", "--wavelength", "525"), "wavelength"),
        (("PHOTO", "-o", "out.mkv", "--cn2", "1e-15", "--d-over-r0", "2"), "not both"),
        (("PHOTO", "-o", "out.mkv", "--frames", "0"), "frames"),
        (("PHOTO",), "-o"),
        (("PHOTO", "-o", "out.mkv", "--focal-length", "2"), "--pixel-pitch"),
        (("PHOTO", "-o", "out.mkv", "--focal-length", "2", "--pixel-pitch", "4"), "pixel pitch"),
        (("PHOTO", "-o", "out.mkv", "--wavelengths", "620,535"), "--wavelengths"),
        (("PHOTO", "-o", "out.mkv", "--wavelengths", "620,535,460"), "wavelength"),
        (("PHOTO", "-o", "out.mkv", "--exposures", "0"), "exposures"),
        (("PHOTO", "-o", "out.mkv", "--jpeg", "101"), "jpeg"),
        (("PHOTO", "-o", "out.mkv", "--boiling", "0"), "boiling"),
        (("PHOTO", "-o", "out.mkv", "--tolerance", "200"), "tolerance"),
        (("PHOTO", "-o", "out.mkv", "--like", "PHOTO"), "frames"),
        (("PHOTO", "-o", "out.mkv", "--crop", "1,2,3"), "--crop"),
        (("PHOTO", "-o", "out.mkv", "--crop", "0,0,1000,1000"), "crop"),
        (("PHOTO", "-o", "out.mkv", "--frobnicate"), "frobnicate"),
    ],
)
def test_bad_input_is_one_line(tmp_path, photo, arguments, complaint):
    done = simulate(tmp_path, *(photo if a == "PHOTO" else a for a in arguments))
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
    assert complaint in done.stderr
    assert not list(tmp_path.iterdir())


def test_a_pipe_gives_what_its_file_gives(tmp_path):
    clip = np.random.default_rng(0).random((5, 32, 40, 3), dtype=np.float32)
    write_clip(tmp_path / "in.mkv", clip)
    options = ["--d-over-r0", "2", "--seed", "3", "--quiet"]
    assert simulate(tmp_path, "in.mkv", "-o", "file.mkv", *options).returncode == 0
    command = [sys.executable, "-m", "turbnet", "simulate", "-", "-o", "pipe.mkv", *options]
    done = subprocess.run(
        command, cwd=tmp_path, input=(tmp_path / "in.mkv").read_bytes(), capture_output=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, b"")
    assert (tmp_path / "pipe.mkv").read_bytes() == (tmp_path / "file.mkv").read_bytes()


def test_it_never_imports_lightning(tmp_path, photo):
    code = (
        "import sys; from turbnet.cli import run; "
        f"code = run(['simulate', {str(photo)!r}, '-o', 'o.png', '--frames', '1', '--quiet']); "
        "assert not any(name.split('.')[0] == 'lightning' for name in sys.modules); sys.exit(code)"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=False).returncode == 0
