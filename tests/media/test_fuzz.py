"""Spoiled clips, packs and tables give a result or one line; see tools/fuzz.py for longer runs."""

import pytest

CLIPS = ["a.mp4", "a.mov", "a.mkv", "a.avi", "b.avi", "a.webm", "a.mpg", "a.ts", "a.gif", "a.png", "deep.png"]
CLIPS += ["moving.png", "a.jpg", "a.bmp", "a.webp", "moving.webp", "a.tif", "lzw.tif", "deflated.tif", "pack", "boxes"]


@pytest.mark.parametrize("kind", CLIPS)
def test_spoiled_files_give_a_result_or_one_line(fuzz, kind):
    found = {number: fuzz.run_case((kind, 0, number)) for number in range(12)}
    assert not any(found.values()), found


def test_most_spoiled_files_are_refused_and_some_are_read(fuzz, tmp_path):
    """Else the generator would prove nothing."""
    import numpy as np

    from turbnet.errors import InputError

    refused = 0
    for number in range(60):
        path = fuzz.KINDS["a.mkv"].make(tmp_path, np.random.default_rng(number))
        try:
            fuzz.KINDS["a.mkv"].read(path)
        except InputError:
            refused += 1
    assert 20 < refused < 60


def test_what_goes_wrong_is_found(fuzz, monkeypatch):
    """An exception of another kind, an error of two lines, a warning."""
    from turbnet.errors import InputError

    def read(error):
        def fail(path):
            raise error

        monkeypatch.setitem(fuzz.KINDS, "a.png", fuzz.Kind(fuzz.KINDS["a.png"].make, fail))
        return fuzz.run_case(("a.png", 0, 0))

    assert read(KeyError("x")).startswith("KeyError")
    assert read(MemoryError()).startswith("MemoryError")
    assert "several lines" in read(InputError("a\nb"))
    assert read(InputError("a")) == ""
