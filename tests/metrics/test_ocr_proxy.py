import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw
from scipy.ndimage import gaussian_filter, shift

from turbnet.data.boxes import TextBox
from turbnet.data.text import fonts, load_font
from turbnet.errors import InputError
from turbnet.metrics.ocr_proxy import legibility_error, score_legibility


def written(text="Hamlet7", size=22, font="DejaVuSerif", paper=0.9, ink=0.2):
    """A picture (H, W, 1) of a text and its box."""
    face = load_font(next(path for path in fonts() if path.stem == font), size)
    left, top, right, bottom = face.getbbox(text)
    canvas = Image.new("L", (right - left + 24, bottom - top + 20))
    ImageDraw.Draw(canvas).text((12 - left, 10 - top), text, fill=255, font=face)
    mask = np.asarray(canvas, dtype=float)[..., None] / 255
    return paper + mask * (ink - paper), TextBox(12, 10, int(right - left), int(bottom - top), text)


def error(picture, box):
    return float(legibility_error(torch.from_numpy(picture.copy()).movedim(-1, 0)[None], [box]))


def test_sharp_text_can_be_read_and_no_text_cannot():
    picture, box = written()
    assert 0 <= error(picture, box) < 0.15
    noise = np.random.default_rng(0).normal(size=(12, *picture.shape)) * 0.1 + 0.5
    lost = [error(frame, box) for frame in noise]
    # Chance is 35/36; 12 pictures of 7 letters that hold noise alone.
    assert np.mean(lost) == pytest.approx(35 / 36, abs=0.04)
    assert error(np.full_like(picture, 0.5), box) == pytest.approx(35 / 36, abs=0.02)


def test_blur_makes_it_worse_step_by_step():
    picture, box = written()
    errors = [error(gaussian_filter(picture, (sigma, sigma, 0)), box) for sigma in (0, 1, 2, 3, 5)]
    assert errors == sorted(errors)
    assert errors[-1] > 0.8


def test_the_transcript_matters():
    picture, box = written("stone")
    wrong = TextBox(box.left, box.top, box.width, box.height, "alarm")
    assert error(picture, wrong) > 0.7 > 0.2 > error(picture, box)


def test_brightness_contrast_polarity_and_colour_do_not_matter():
    picture, box = written()
    expected = error(picture, box)
    assert error(0.3 + 0.5 * picture, box) == pytest.approx(expected, abs=0.01)
    assert error(1 - picture, box) == pytest.approx(expected, abs=0.01)
    assert error(np.repeat(picture, 3, axis=2), box) == pytest.approx(expected, abs=1e-9)


def test_local_registration():
    """A text moved by a tilt is as legible as it was; letters pushed about each on their own too."""
    picture, box = written()
    expected = error(picture, box)
    moved = shift(picture, (1.5, -2, 0), order=3, mode="nearest")
    assert error(moved, box) == pytest.approx(expected, abs=0.08)


def test_a_sloping_text_is_followed():
    picture, box = written("sloping", size=20)
    rows, columns = np.mgrid[0 : picture.shape[0] + 12, 0 : picture.shape[1]]
    fall = np.rint(10 * (columns - box.left) / box.width).astype(int)
    tall = np.pad(picture, ((0, 12), (0, 0), (0, 0)), mode="edge")
    sloping = tall[np.clip(rows - fall, 0, len(tall) - 1), columns]
    assert error(sloping, TextBox(box.left, box.top, box.width, box.height + 10, "sloping")) < 0.3


def test_gradient():
    """With respect to every pixel of a small picture, in float64."""
    picture, box = written("ok", size=9)
    pixels = torch.from_numpy(gaussian_filter(picture, (0.7, 0.7, 0))).movedim(-1, 0)[None].requires_grad_()
    assert torch.autograd.gradcheck(lambda x: legibility_error(x, [box]), pixels, eps=1e-6, atol=1e-6, fast_mode=True)


def test_climbing_the_gradient_makes_text_legible():
    picture, box = written()
    pixels = torch.from_numpy(gaussian_filter(picture, (2, 2, 0))).movedim(-1, 0)[None].requires_grad_()
    before = legibility_error(pixels, [box])
    (gradient,) = torch.autograd.grad(before.sum(), pixels)
    after = legibility_error(pixels - 0.05 * gradient / gradient.abs().max(), [box])
    assert after.item() < before.item() - 0.02


def test_pictures_and_boxes_in_a_batch():
    picture, box = written()
    other = TextBox(box.left, box.top, box.width // 2, box.height, "Ham")
    batch = torch.from_numpy(np.stack([picture, gaussian_filter(picture, (2, 2, 0))])).movedim(-1, 1)
    together = legibility_error(batch, [box, other])
    assert together.shape == (2, 2)
    assert float(together[1, 0]) > float(together[0, 0])
    assert legibility_error(batch, []).shape == (2, 0)


def test_score():
    picture, box = written()
    score = score_legibility(picture, [box, box])
    assert (score.characters, score.boxes) == (14, 2)
    assert score.character_error_rate == pytest.approx(error(picture, box))
    assert score.right == pytest.approx(2 * (1 - error(picture, box)) ** 7)


@pytest.mark.parametrize(
    ("pictures", "box", "says"),
    [
        (torch.zeros(3, 20, 30), TextBox(0, 0, 5, 5, "w"), r"must be \(N, C, H, W\)"),
        (torch.zeros(1, 3, 20, 30) + torch.nan, TextBox(0, 0, 5, 5, "w"), "NaN"),
        (torch.zeros(1, 3, 20, 30), TextBox(26, 0, 5, 5, "w"), "does not lie inside"),
        (torch.zeros(1, 3, 20, 30), TextBox(0, 0, 5, 5, "?!"), "neither a letter nor a digit"),
    ],
)
def test_bad_input(pictures, box, says):
    with pytest.raises(InputError, match=says):
        legibility_error(pictures, [box])
