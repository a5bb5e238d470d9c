import av
import numpy as np
import pytest
from PIL import Image

from turbnet.errors import InputError
from turbnet.media.clip import open_writer, read_clip, write_clip


def psnr(a, b):
    return -10 * np.log10(np.mean((a - b) ** 2))


# 8-bit files hold these frames exactly but for single precision; a lossy kind is held to a PSNR.
LOSSLESS = ["clip.mkv", "clip.avi", "clip.tif", "clip.tiff", "clip"]
LOSSY = {"clip.mp4": 36, "clip.mov": 36, "clip.gif": 32}


@pytest.mark.parametrize("odd", [False, True])
@pytest.mark.parametrize("name", [*LOSSLESS, *LOSSY])
def test_round_trip(tmp_path, frames, picture, name, odd):
    clip = np.stack([picture] * 3) if odd else frames
    write_clip(tmp_path / name, clip, fps=12.5)
    back, info = read_clip(tmp_path / name)
    assert back.dtype == np.float32
    assert back.shape == clip.shape  # equal neighbours are not merged, odd sizes lose no pixel
    assert (info.frames, info.height, info.width, info.grey) == (len(clip), *clip.shape[1:3], False)
    if name in LOSSLESS:
        np.testing.assert_allclose(back, clip, atol=1e-6)
    else:
        assert psnr(back, clip) > LOSSY[name]
    if name not in ("clip.tif", "clip.tiff", "clip"):
        assert info.fps == pytest.approx(12.5)
    assert [entry.name for entry in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("name", [*LOSSLESS, "clip.gif"])
def test_grey_is_stored_in_one_channel(tmp_path, frames, name):
    grey = np.repeat(frames[..., 1:2], 3, axis=-1)
    write_clip(tmp_path / name, grey, grey=True)
    back, info = read_clip(tmp_path / name)
    assert info.grey
    np.testing.assert_allclose(back, grey, atol=1e-6)


def test_colours_survive_h264(tmp_path):
    """Saturated patches, in the middle of which chroma subsampling plays no part: the right matrix and range."""
    colours = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [0, 0, 0], [1, 1, 1], [0.5, 0.5, 0.5]])
    frame = np.repeat(np.repeat(colours[None], 32, axis=0), 32, axis=1).astype(np.float32)
    write_clip(tmp_path / "clip.mp4", [frame] * 2)
    back, _ = read_clip(tmp_path / "clip.mp4")
    np.testing.assert_allclose(back[:, 16, 16::32], [colours] * 2, atol=2.5 / 255)
    with av.open(str(tmp_path / "clip.mp4")) as container:
        context = container.streams.video[0].codec_context
        assert (context.colorspace, context.color_primaries, context.color_trc, context.color_range) == (1, 1, 1, 1)


def test_h264_gives_the_same_bytes_each_time(tmp_path):
    """Cuts from frame to frame: what looks ahead has much to weigh."""
    coarse = np.random.default_rng(1).random((30, 17, 30, 1), np.float32)
    cuts = np.broadcast_to(coarse.repeat(16, 1).repeat(16, 2), (30, 272, 480, 3))
    written = set()
    for _ in range(10):
        write_clip(tmp_path / "cuts.mp4", cuts)
        written.add((tmp_path / "cuts.mp4").read_bytes())
    assert len(written) == 1


def test_h264_keeps_the_mean(tmp_path, frames):
    """FFmpeg's fast conversions darken a picture by a level; H.264 itself moves the mean by a fraction of one."""
    write_clip(tmp_path / "clip.mp4", frames)
    back, _ = read_clip(tmp_path / "clip.mp4")
    luma = [0.2126, 0.7152, 0.0722]
    assert (back @ luma).mean() == pytest.approx((frames @ luma).mean(), abs=0.3 / 255)


def test_rate_of_broadcast_video_is_exact(tmp_path, frames):
    write_clip(tmp_path / "clip.mp4", frames, fps=30000 / 1001)
    with av.open(str(tmp_path / "clip.mp4")) as container:
        rate = container.streams.video[0].average_rate
    assert (rate.numerator, rate.denominator) == (30000, 1001)


@pytest.mark.parametrize("name", ["still.png", "still.bmp", "still.webp", "still.jpg"])
def test_still(tmp_path, picture, name):
    write_clip(tmp_path / name, [picture])
    with Image.open(tmp_path / name) as image:
        pixels = np.asarray(image.convert("RGB")) / 255.0
    np.testing.assert_allclose(pixels, picture, atol=0.15 if name.endswith("jpg") else 1e-6)


def test_values_are_clipped_and_rounded(tmp_path):
    with open_writer(tmp_path / "still.png") as writer:
        writer.write(np.array([[[-0.5, 1.5, 0.5], [0.4 / 255, 0.6 / 255, np.inf]]]))
    assert np.asarray(Image.open(tmp_path / "still.png")).tolist() == [[[0, 255, 128], [0, 1, 255]]]


@pytest.mark.parametrize("name", ["clip.mp4", "clip.mkv", "clip.gif", "clip.tif", "still.png", "clip"])
def test_exception_in_the_block_leaves_nothing(tmp_path, frames, name):
    with pytest.raises(KeyError), open_writer(tmp_path / name) as writer:  # noqa: PT012
        writer.write(frames[0])
        raise KeyError
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["clip.mp4", "clip.mkv", "clip.gif", "clip.tif", "still.png", "clip"])
def test_no_frames(tmp_path, name):
    with pytest.raises(InputError, match="no frames"):
        write_clip(tmp_path / name, [])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("bad", "says"),
    [
        (np.full((74, 100, 3), np.nan), "frame 1 holds NaN"),
        (np.zeros((70, 100, 3)), "frame 1 has shape"),
        (np.zeros((74, 100)), r"not \(H, W, 3\)"),
    ],
)
def test_bad_frame(tmp_path, frames, bad, says):
    with pytest.raises(InputError, match=says):
        write_clip(tmp_path / "clip.mkv", [frames[0], bad])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "fps", "says"),
    [
        ("clip.xyz", 25, "unknown kind '.xyz'"),
        ("none/clip.mp4", 25, "does not exist"),
        ("still.png", 25, "choose a video, or no extension for a folder"),
        ("clip.mp4", 0, "fps = 0 is outside"),
        ("clip.mp4", float("nan"), "fps = nan is outside"),
    ],
)
def test_bad_output(tmp_path, frames, name, fps, says):
    with pytest.raises(InputError, match=says):
        write_clip(tmp_path / name, frames, fps=fps)
    assert not list(tmp_path.iterdir())
