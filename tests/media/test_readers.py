import tracemalloc
import zlib
from struct import pack

import av
import numpy as np
import pytest
import tifffile
from PIL import Image

from turbnet.errors import InputError
from turbnet.media.clip import open_clip, read_clip, write_clip


def bytes_of(picture):
    return np.rint(picture * 255).astype(np.uint8)


def encode(path, frames, codec, pixel_format, **options):
    with av.open(str(path), "w", options=options) as container:
        stream = container.add_stream(codec, rate=25)
        stream.height, stream.width, stream.pix_fmt = *frames[0].shape[:2], pixel_format
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(bytes_of(frame), "rgb24")))
        container.mux(stream.encode(None))


def png(path, pixels, colour_type):
    """A 16-bit PNG, written by hand from the specification."""

    def chunk(kind, data):
        return pack(">I", len(data)) + kind + data + pack(">I", zlib.crc32(kind + data))

    height, width = pixels.shape[:2]
    lines = b"".join(b"\0" + row.astype(">u2").tobytes() for row in pixels)
    header = pack(">IIBBBBB", width, height, 16, colour_type, 0, 0, 0)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(lines)) + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("name", ["a.png", "a.bmp", "a.webp", "a.tif", "A.PNG"])
def test_eight_bit_stills(tmp_path, picture, name):
    options = {"lossless": True} if name.endswith("webp") else {}
    Image.fromarray(bytes_of(picture)).save(tmp_path / name, **options)
    back, info = read_clip(tmp_path / name)
    np.testing.assert_allclose(back, picture[None], atol=1e-7)
    assert (info.frames, info.height, info.width, info.fps, info.grey) == (1, *picture.shape[:2], 25.0, False)


@pytest.mark.parametrize(("channels", "colour_type"), [(1, 0), (2, 4), (3, 2), (4, 6)])
def test_sixteen_bit_png(tmp_path, channels, colour_type):
    pixels = np.random.default_rng(0).integers(0, 65536, (9, 7, channels))
    if channels in (2, 4):
        pixels[..., -1] = 65535
    png(tmp_path / "deep.png", pixels, colour_type)
    back, info = read_clip(tmp_path / "deep.png")
    expected = np.broadcast_to(pixels[..., : channels - 1 + channels % 2], (9, 7, 3)) / 65535
    np.testing.assert_allclose(back[0], expected, atol=1e-7)
    assert info.grey == (channels == 1)


@pytest.mark.parametrize(
    ("pixels", "options", "expected"),
    [
        (np.array([[0, 65535]], np.uint16), {}, [[0, 1]]),
        (np.array([[0, 51]], np.uint8), {}, [[0, 0.2]]),
        (np.array([[0.25, 1.1]], np.float32), {}, [[0.25, 1.1]]),
        (np.array([[0.25, 1.0]], np.float64), {"compression": "zlib"}, [[0.25, 1]]),
        (np.array([[0, 51]], np.uint8), {"photometric": "miniswhite"}, [[1, 0.8]]),
    ],
)
def test_grey_tiff_kinds(tmp_path, pixels, options, expected):
    tifffile.imwrite(tmp_path / "a.tif", pixels, **{"photometric": "minisblack", **options})
    back, info = read_clip(tmp_path / "a.tif")
    np.testing.assert_allclose(back[0], np.repeat(np.array(expected)[..., None], 3, axis=-1), atol=1e-7)
    assert info.grey


@pytest.mark.parametrize("layout", ["contig", "separate", "lzw", "palette", "alpha"])
def test_colour_tiff_kinds(tmp_path, picture, layout):
    path = tmp_path / "a.tif"
    image = Image.fromarray(bytes_of(picture))
    if layout == "contig":
        tifffile.imwrite(path, np.rint(picture * 65535).astype(np.uint16), photometric="rgb")
    elif layout == "separate":
        planes = np.moveaxis(bytes_of(picture), -1, 0)
        tifffile.imwrite(path, planes, photometric="rgb", planarconfig="separate")
    elif layout == "lzw":
        image.save(path, compression="tiff_lzw")
    elif layout == "palette":
        image = image.quantize(64)
        picture = np.asarray(image.convert("RGB")) / 255
        image.save(path)
    else:
        image.putalpha(51)
        picture = picture * 0.2
        image.save(path)
    back, _ = read_clip(path)
    np.testing.assert_allclose(back[0], picture, atol=1e-5)


def test_multi_page_tiff_is_a_clip(tmp_path, frames):
    tifffile.imwrite(tmp_path / "clip.tif", frames, photometric="rgb")
    back, info = read_clip(tmp_path / "clip.tif")
    np.testing.assert_array_equal(back, frames)
    assert info.frames == len(frames)


def test_alpha_is_laid_over_black(tmp_path):
    Image.new("RGBA", (4, 3), (255, 51, 0, 102)).save(tmp_path / "a.png")
    back, _ = read_clip(tmp_path / "a.png")
    np.testing.assert_allclose(back[0, 0, 0], [0.4, 0.08, 0], atol=1e-6)


def test_camera_orientation_is_applied(tmp_path, picture):
    exif = Image.Exif()
    exif[0x0112] = 6  # the camera was turned: rotate 90 degrees clockwise to show
    Image.fromarray(bytes_of(picture)).save(tmp_path / "a.png", exif=exif)
    back, info = read_clip(tmp_path / "a.png")
    np.testing.assert_allclose(back[0], np.rot90(picture, -1), atol=1e-6)
    assert (info.height, info.width) == back.shape[1:3]


def test_gif_frames_are_composited(tmp_path):
    """The second frame paints a corner only; the rest of the first must stay."""
    first = Image.new("RGB", (8, 8), (255, 0, 0))
    second = first.copy()
    second.paste((0, 0, 255), (0, 0, 3, 3))
    first.save(tmp_path / "a.gif", save_all=True, append_images=[second], duration=40)
    with Image.open(tmp_path / "a.gif") as stored:
        stored.seek(1)
        assert stored.tile[0][1] != (0, 0, 8, 8)  # else this test proves nothing
    back, info = read_clip(tmp_path / "a.gif")
    np.testing.assert_allclose(back, np.stack([np.asarray(first), np.asarray(second)]) / 255, atol=1e-6)
    assert (info.frames, info.fps) == (2, 25.0)


def test_folder_is_read_in_natural_order(tmp_path):
    for number in (10, 9, 1, 2, 100):
        Image.new("L", (5, 4), number).save(tmp_path / f"frame{number}.png")
    (tmp_path / "notes.txt").write_text("not a picture")
    (tmp_path / ".hidden.png").write_text("not a picture either")
    back, info = read_clip(tmp_path)
    np.testing.assert_allclose(back[:, 0, 0, 0] * 255, [1, 2, 9, 10, 100], atol=1e-5)
    assert info.frames == 5
    assert info.grey


@pytest.mark.parametrize(
    ("name", "codec", "pixel_format", "least"),
    [
        ("a.mp4", "libx264", "yuv420p", 30),
        ("a.mp4", "libx264", "yuv420p10le", 30),
        ("a.avi", "mpeg4", "yuv420p", 26),
        ("a.mov", "mpeg4", "yuv420p", 26),
        ("a.mkv", "libx264", "yuv444p", 30),
        ("a.webm", "libvpx", "yuv420p", 26),
    ],
)
def test_video_kinds(tmp_path, frames, name, codec, pixel_format, least):
    encode(tmp_path / name, frames, codec, pixel_format)
    back, info = read_clip(tmp_path / name)
    assert back.shape == frames.shape
    assert -10 * np.log10(np.mean((back - frames) ** 2)) > least
    assert info.fps == pytest.approx(25, rel=1e-3)


@pytest.mark.parametrize(
    ("codec", "pixel_format"),
    [("ffv1", "yuv420p10le"), ("ffv1", "yuv444p12le"), ("ffv1", "gray16le"), ("ffv1", "gray"), ("mjpeg", "yuvj444p")],
)
def test_black_and_white_keep_their_levels(tmp_path, codec, pixel_format):
    frame = np.zeros((32, 64, 3), np.float32)
    frame[:, 32:] = 1
    encode(tmp_path / "a.avi", [frame], codec, pixel_format)
    back, info = read_clip(tmp_path / "a.avi")
    np.testing.assert_allclose(back[0, :, [16, 48]], [np.zeros((32, 3)), np.ones((32, 3))], atol=1.5 / 255)
    assert info.grey == pixel_format.startswith("gray")


def test_sixteen_bit_grey_video_is_exact(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 65536, (32, 48)).astype(np.uint16)
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=25)
        stream.height, stream.width, stream.pix_fmt = 32, 48, "gray16le"
        container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, "gray16le")))
        container.mux(stream.encode(None))
    back, _ = read_clip(tmp_path / "a.mkv")
    np.testing.assert_allclose(back[0], np.repeat(pixels[..., None], 3, axis=-1) / 65535, atol=1e-6)


def test_turned_video_is_shown_upright(tmp_path, frames):
    """The matrix (0, 1, -1, 0) of a telephone held upright: rotate by 90 degrees clockwise to show."""
    write_clip(tmp_path / "a.mp4", frames)
    content = bytearray((tmp_path / "a.mp4").read_bytes())
    matrix = content.index(b"tkhd") + 4 + 40
    assert content[matrix : matrix + 36] == pack(">9i", 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
    content[matrix : matrix + 36] = pack(">9i", 0, 1 << 16, 0, -1 << 16, 0, 0, 74 << 16, 0, 1 << 30)
    plain, _ = read_clip(tmp_path / "a.mp4")
    (tmp_path / "a.mp4").write_bytes(content)
    back, info = read_clip(tmp_path / "a.mp4")
    np.testing.assert_array_equal(back, np.rot90(plain, -1, axes=(1, 2)))
    assert (info.height, info.width) == (100, 74)


def test_name_with_a_colon(tmp_path, frames, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_clip("take2:1.mkv", frames)
    assert len(read_clip("take2:1.mkv")[0]) == len(frames)


def test_crop(tmp_path, frames):
    write_clip(tmp_path / "a.mkv", frames)
    back, info = read_clip(tmp_path / "a.mkv", crop=(11, 5, 40, 30))
    np.testing.assert_allclose(back, frames[:, 5:35, 11:51], atol=1e-6)
    assert (info.height, info.width) == (30, 40)


@pytest.mark.parametrize("crop", [(-1, 0, 10, 10), (0, 70, 10, 10), (95, 0, 10, 10), (0, 0, 0, 10), (0, 0, 101, 74)])
def test_crop_outside(tmp_path, frames, crop):
    write_clip(tmp_path / "a.mkv", frames)
    with pytest.raises(InputError, match="does not lie inside.*100x74"):
        open_clip(tmp_path / "a.mkv", crop)


def test_every_pass_starts_from_the_first_frame(tmp_path, frames):
    write_clip(tmp_path / "a.mkv", frames)
    with open_clip(tmp_path / "a.mkv") as clip:
        next(iter(clip))
        assert len(list(clip)) == len(list(clip)) == len(frames)


def test_memory_does_not_grow_with_the_clip(tmp_path):
    def peak(count):
        write_clip(tmp_path / "a.tif", [np.zeros((128, 128, 3))] * count)
        tracemalloc.start()
        for _ in open_clip(tmp_path / "a.tif"):
            pass
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return most

    # 36 more frames of 196,608 bytes each would add 7 MB.
    assert peak(40) - peak(4) < 1_000_000


# --- bad input ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("missing.mp4", None, "there is no file or folder"),
        ("empty.mp4", b"", "is empty"),
        ("text.mp4", b"just some text, not a video\n" * 50, "cannot read"),
        ("text.png", b"just some text, not a picture\n" * 50, "not an image"),
        ("notes.txt", b"just some text\n", "not a kind of file"),
        ("broken.png", b"\x89PNG\r\n\x1a\n" + b"\0" * 100, "cannot read"),
        ("broken.gif", b"GIF89a" + b"\1" * 100, "cannot read"),
        ("broken.tif", b"II*\0" + b"\xff" * 100, "holds no picture|cannot read"),
        ("broken.mkv", b"\x1a\x45\xdf\xa3" + bytes(range(256)) * 4, "cannot read"),
    ],
)
def test_bad_file(tmp_path, name, content, says):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=says) as caught:
        read_clip(tmp_path / name)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_bad_folders(tmp_path, picture):
    with pytest.raises(InputError, match="is empty"):
        open_clip(tmp_path)
    (tmp_path / "notes.txt").write_text("text")
    with pytest.raises(InputError, match="holds no images"):
        open_clip(tmp_path)
    write_clip(tmp_path / "a1.png", [picture])
    write_clip(tmp_path / "a2.png", [picture[1:]])
    with pytest.raises(InputError, match=r"a2.png is 101x74 pixels but a1.png is 101x75"):
        open_clip(tmp_path)


def test_a_pattern_picks_pictures_of_a_folder(tmp_path, picture):
    for name in ("frame2.png", "frame10.png", "frame1.png"):
        write_clip(tmp_path / name, [picture])
    write_clip(tmp_path / "other.png", [picture[1:]])
    with pytest.raises(InputError, match="pattern such as"):
        open_clip(tmp_path)
    assert open_clip(tmp_path / "frame*.png").info.frames == 3
    assert read_clip(tmp_path / "frame?.png")[0].shape == (2, *picture.shape)
    with pytest.raises(InputError, match="no file matches"):
        open_clip(tmp_path / "nothing*.png")


def test_pages_of_mixed_sizes(tmp_path):
    with tifffile.TiffWriter(tmp_path / "a.tif") as tiff:
        tiff.write(np.zeros((4, 5), np.uint8))
        tiff.write(np.zeros((5, 5), np.uint8))
    with pytest.raises(InputError, match="frame 1 of .*a.tif is 5x5 pixels but the first is 5x4"):
        read_clip(tmp_path / "a.tif")


@pytest.mark.parametrize(("value", "says"), [(np.nan, "NaN or infinite"), (np.inf, "NaN or infinite"), (255, "scale")])
def test_float_tiff_with_unusable_values(tmp_path, value, says):
    tifffile.imwrite(tmp_path / "a.tif", np.array([[0, value]], np.float32))
    with pytest.raises(InputError, match=says):
        read_clip(tmp_path / "a.tif")


@pytest.mark.parametrize("options", [{"truncate": True}, {"volumetric": True, "tile": (16, 16, 16)}])
def test_tiff_whose_frames_share_a_page(tmp_path, options):
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((5, 16, 16), np.uint8), photometric="minisblack", **options)
    with pytest.raises(InputError, match="save one page a frame"):
        open_clip(tmp_path / "a.tif")


def test_signed_tiff_has_no_white_level(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((4, 4), np.int16))
    with pytest.raises(InputError, match="int16"):
        read_clip(tmp_path / "a.tif")


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.avi", "a.gif", "a.tif", "a.png", "a.jpg", "a.webp", "a.bmp"])
def test_truncation_is_never_silent(tmp_path, frames, name):
    still = name[2:] in ("png", "jpg", "webp", "bmp")
    write_clip(tmp_path / name, frames[:1] if still else np.concatenate([frames] * 4))
    whole = (tmp_path / name).read_bytes()
    for part in np.linspace(0.02, 0.8, 9):
        (tmp_path / name).write_bytes(whole[: int(part * len(whole))])
        with pytest.raises(InputError):
            read_clip(tmp_path / name)


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.avi"])
def test_damage_in_the_middle_of_a_video(tmp_path, frames, name):
    write_clip(tmp_path / name, np.concatenate([frames] * 4))
    content = bytearray((tmp_path / name).read_bytes())
    middle, length = len(content) // 2, len(content) // 20
    content[middle : middle + length] = np.random.default_rng(0).bytes(length)
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=name):
        read_clip(tmp_path / name)


def test_damage_that_the_decoder_conceals(tmp_path, frames):
    """MPEG-4 Part 2 paints over what it cannot decode and goes on; single bytes, so that it decodes every packet."""
    encode(tmp_path / "a.avi", np.concatenate([frames] * 4), "mpeg4", "yuv420p")
    content = bytearray((tmp_path / "a.avi").read_bytes())
    with av.open(str(tmp_path / "a.avi")) as container:
        packets = [packet for packet in container.demux(video=0) if packet.size > 200]
    places = [packet.pos + packet.size // 2 for packet in packets]
    for place in places:
        content[place : place + 8] = b"\xff" * 8
    (tmp_path / "a.avi").write_bytes(content)
    with av.open(str(tmp_path / "a.avi")) as container:
        assert any(frame.is_corrupt for frame in container.decode(video=0))  # it decodes, and is marked
    with pytest.raises(InputError, match="is damaged near frame"):
        read_clip(tmp_path / "a.avi")


def test_frames_missing_after_a_whole_header(tmp_path, frames):
    """A download cut off: the header, in front here, is whole, and so is every frame that came through."""
    path = tmp_path / "a.mp4"
    encode(path, np.concatenate([frames] * 4), "mpeg4", "yuv420p", movflags="faststart")
    with av.open(str(path)) as container:
        end = max(packet.pos + packet.size for packet in list(container.demux(video=0))[:15] if packet.size)
    path.write_bytes(path.read_bytes()[:end])
    assert open_clip(path).info.frames == 24
    with pytest.raises(InputError, match="its header says 24 frames, 15 are there"):
        read_clip(path)


def test_frame_count_is_none_where_the_header_has_none(tmp_path, frames):
    write_clip(tmp_path / "a.mkv", frames)
    assert open_clip(tmp_path / "a.mkv").info.frames is None
