"""Clips made to harm: what they claim costs nothing, and they read no other file."""

import subprocess
import sys
import zipfile
import zlib
from struct import pack

import numpy as np
import pytest
import tifffile
from PIL import Image

from turbnet.data.pack import packed_pictures
from turbnet.errors import InputError
from turbnet.media.clip import open_clip, read_clip, write_clip
from turbnet.media.guard import read_bytes, read_json

BLACK = zlib.compress(bytes(10**6))
READ = """
import resource, sys
import turbnet.media.clip as clip
pages = int(open("/proc/self/statm").read().split()[0])
resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + 2**29, -1))  # half a GiB more
for path in sys.argv[1:]:
    try:
        clip.read_clip(path)
        print("read")
    except clip.InputError as error:
        print(error)
"""


def png_of(width, height, bits=8):
    """A header that claims a size, and a few lines of black."""

    def chunk(kind, data):
        return pack(">I", len(data)) + kind + data + pack(">I", zlib.crc32(kind + data))

    header = pack(">IIBBBBB", width, height, bits, 2, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(10**6))) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


def tiff_of(width, height, compression=8, data=BLACK):
    fields = [(256, 4, width), (257, 4, height), (258, 3, 8), (259, 3, compression), (262, 3, 1)]
    fields += [(273, 4, 8), (277, 3, 1), (278, 4, height), (279, 4, len(data))]
    entries = b"".join(pack("<HHI", tag, kind, 1) + pack("<I", value) for tag, kind, value in fields)
    return b"II*\0" + pack("<I", 8 + len(data)) + data + pack("<H", len(fields)) + entries + pack("<I", 0)


def test_claimed_sizes_cost_no_memory(tmp_path):
    """60000 x 60000 pixels, and the largest that a format can claim."""
    files = {
        "a.png": png_of(60_000, 60_000),
        "deep.png": png_of(60_000, 60_000, bits=16),
        "near.png": png_of(12_000, 12_000),  # below Pillow's own limit
        "a.tif": tiff_of(60_000, 60_000),
        "plain.tif": tiff_of(60_000, 60_000, compression=1),
        "a.gif": b"GIF89a" + pack("<HH", 65535, 65535) + b"\x80\0\0" + bytes(6) + b",\0\0\0\0\xff\xff\xff\xff\0\2\0;",
        "a.bmp": b"BM" + pack("<IHHI", 54, 0, 0, 54) + pack("<IiiHHIIiiII", 40, 60_000, 60_000, 1, 24, *[0] * 6),
        "a.mkv": video_of(16_000, 16_000, tmp_path),
    }
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    paths = [str(tmp_path / name) for name in files]
    done = subprocess.run([sys.executable, "-c", READ, *paths], capture_output=True, text=True, timeout=120)
    assert done.stderr == ""
    lines = done.stdout.splitlines()
    assert len(lines) == len(files), done.stdout
    for path, line in zip(paths, lines, strict=True):
        assert path in line
        assert "pixels" in line, line


def video_of(width, height, folder):
    """A video of 300 x 280 whose header claims another size."""
    write_clip(folder / "small.mkv", np.zeros((2, 280, 300, 3)))
    data = (folder / "small.mkv").read_bytes()
    for old, new in ((b"\xb0\x82" + pack(">H", 300), width), (b"\xba\x82" + pack(">H", 280), height)):
        assert data.count(old) == 1
        data = data.replace(old, old[:2] + pack(">H", new))
    return data


def test_a_strip_that_inflates_to_more_than_its_picture(tmp_path):
    """Ten megabytes for 64 pixels; of what inflates to a thousand times its size, memory would follow."""
    (tmp_path / "a.tif").write_bytes(tiff_of(8, 8, data=zlib.compress(bytes(10**7))))
    with pytest.raises(InputError, match="inflates to more than its pixels"):
        read_clip(tmp_path / "a.tif")
    (tmp_path / "a.tif").write_bytes(tiff_of(8, 8, data=zlib.compress(bytes(64))))
    assert read_clip(tmp_path / "a.tif")[0].shape == (1, 8, 8, 3)


@pytest.mark.parametrize("compression", ["zlib", "lzma"])
def test_compressed_tiffs_still_open(tmp_path, compression):
    frames = np.random.default_rng(0).integers(0, 65535, (2, 40, 50, 3)).astype(np.uint16)
    tifffile.imwrite(tmp_path / "a.tif", frames, photometric="rgb", compression=compression, rowsperstrip=7)
    np.testing.assert_allclose(read_clip(tmp_path / "a.tif")[0], frames / 65535, atol=1e-6)
    tifffile.imwrite(tmp_path / "b.tif", frames, photometric="rgb", compression=compression, tile=(64, 64))
    np.testing.assert_allclose(read_clip(tmp_path / "b.tif")[0], frames / 65535, atol=1e-6)


def test_pages_that_run_in_a_circle(tmp_path):
    data = tiff_of(8, 8, compression=1, data=bytes(64))
    (tmp_path / "a.tif").write_bytes(data[:-4] + pack("<I", 8 + 64))
    with pytest.raises(InputError, match="run in a circle"):
        open_clip(tmp_path / "a.tif")


SCRIPTS = {
    "concat": "ffconcat version 1.0\nfile secret.mkv\n",
    "hls": "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nsecret.mkv\n#EXT-X-ENDLIST\n",
    "sdp": "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nt=0 0\nm=video 5004 RTP/AVP 96\n",
    "dash": '<?xml version="1.0"?>\n<MPD type="static"><Period><AdaptationSet mimeType="video/mp4"/></Period></MPD>',
}


@pytest.mark.parametrize("kind", SCRIPTS)
@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".ts", ".ogv"])
def test_a_playlist_named_as_a_video_reads_nothing_else(tmp_path, frames, kind, suffix):
    write_clip(tmp_path / "secret.mkv", frames)
    (tmp_path / f"clip{suffix}").write_text(SCRIPTS[kind])
    with pytest.raises(InputError, match="cannot read"):
        read_clip(tmp_path / f"clip{suffix}")


def test_names_that_no_system_takes(tmp_path):
    for name in ("a" * 300 + ".mp4", "a**b", "\0.png"):
        with pytest.raises(InputError, match="cannot read|no file"):
            open_clip(tmp_path / name)


@pytest.mark.parametrize("name", ["clip.mp4", "clip.png", "clip.tif"])
def test_a_folder_where_a_file_is_meant(tmp_path, name):
    (tmp_path / name).mkdir()
    with pytest.raises(InputError, match="is empty"):
        open_clip(tmp_path / name)


def test_a_folder_that_holds_itself(tmp_path):
    (tmp_path / "a.png").symlink_to(tmp_path)
    (tmp_path / "b.png").symlink_to(tmp_path)
    with pytest.raises(InputError):
        open_clip(tmp_path)


def test_frame_counts_that_are_not_there(tmp_path):
    """An animated PNG that claims a thousand million frames."""
    images = [Image.new("RGB", (8, 8), (k, 0, 0)) for k in range(3)]
    images[0].save(tmp_path / "a.png", save_all=True, append_images=images[1:])
    data = (tmp_path / "a.png").read_bytes()
    start = data.index(b"acTL")
    control = b"acTL" + pack(">I", 10**9) + data[start + 8 : start + 12]
    (tmp_path / "a.png").write_bytes(data[:start] + control + pack(">I", zlib.crc32(control)) + data[start + 16 :])
    with pytest.raises(InputError, match="cannot read"):
        read_clip(tmp_path / "a.png")


def test_a_pack_that_claims_more_than_it_has(tmp_path):
    with zipfile.ZipFile(tmp_path / "p.zip", "w") as archive:
        archive.writestr("000000.webp", b"x" * 100)
    data = bytearray((tmp_path / "p.zip").read_bytes())
    entry = data.index(b"PK\1\2")
    data[entry + 20 : entry + 28] = pack("<II", 2**32 - 2, 2**32 - 2)
    (tmp_path / "p.zip").write_bytes(data)
    with pytest.raises(InputError, match="claims more bytes"):
        packed_pictures(tmp_path / "p.zip")


def test_whole_files_are_bounded_and_regular(tmp_path):
    with (tmp_path / "sparse.json").open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(InputError, match=r"at most \d+ are read"):
        read_json(tmp_path / "sparse.json")
    with pytest.raises(InputError, match="it is not a file"):
        read_bytes("/dev/zero", 100)
    with pytest.raises(InputError, match="directory"):
        read_bytes(tmp_path, 10**6)
    (tmp_path / "deep.json").write_text("[" * 10**5)
    with pytest.raises(InputError, match="cannot read"):
        read_json(tmp_path / "deep.json")
