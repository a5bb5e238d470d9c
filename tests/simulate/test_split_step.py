import json
import math

import numpy as np
import pytest
import torch

from turbnet.atmosphere.noll import noll_covariance
from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Constant, Tabulated
from turbnet.errors import InputError, ParameterError
from turbnet.optics.propagation import angular_spectrum
from turbnet.optics.psf import airy
from turbnet.optics.pupil import pupil_grid
from turbnet.simulate.point_field import run_points
from turbnet.simulate.sampling import Sampling
from turbnet.simulate.split_step import SplitStep, Turbulence, point_grid
from turbnet.simulate.wavefront import Aperture

NEAR = OpticalPath.from_d_over_r0(2.0, distance=500.0)
FAR = OpticalPath.from_d_over_r0(2.0, distance=7000.0)
STILL = OpticalPath(0.2034, 1000.0, Constant(0.0))


@pytest.fixture(autouse=True)
def one_thread():
    """Operations this small lose more than they gain by a second thread where another process has its core."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def air_of(split_step: SplitStep, layer: int, phase) -> Turbulence:
    """Air whose only phase is `phase(y, x)` on one screen, in metres from the screen's middle."""
    phases = [torch.zeros(1, *screen.shape, dtype=split_step.dtype) for screen in split_step.screens]
    spacing = split_step.sampling.spacing[layer]
    y, x = ((torch.arange(n, dtype=split_step.dtype) - (n - 1) / 2) * spacing for n in phases[layer].shape[1:])
    phases[layer] = (phase(y[:, None], x) + torch.zeros_like(phases[layer][0]))[None]
    return Turbulence(phases)


@pytest.mark.parametrize("shape", [{}, {"grid": 255, "extent": 5.0}])
def test_still_air_gives_a_flat_field_and_the_airy_pattern(shape):
    split_step = SplitStep(Sampling(STILL, **shape), point_grid(STILL, 3, 3, 5.3), dtype=torch.float64)
    fields = split_step.pupil_fields(split_step.draw(torch.Generator()), range(9))
    assert (fields - 1).abs().max() < 3e-3
    psf = Aperture(fields.shape[-1], like=fields.real).psf(fields, 33, q=0.5)[0, 4]
    axis = (torch.arange(33) - 16) * 0.25  # in lambda / D
    expected = torch.from_numpy(airy(torch.hypot(axis[:, None], axis).numpy()))
    assert (psf / psf.max() - expected).abs().max() < 5e-3


@pytest.mark.parametrize("path", [NEAR, FAR])
@pytest.mark.parametrize("layer", [0, 4, 9])
def test_a_wedge_tilts_as_the_spherical_wave_sees_it(path, layer):
    """phi = g.x on the screen at z gives a2 = g_x R (L - z) / (2L), and a piston that follows the line of sight."""
    split_step = SplitStep(Sampling(path), point_grid(path, 2, 3, 3.7), dtype=torch.float64)
    gradient_y, gradient_x = 4.0, -7.0
    air = air_of(split_step, layer, lambda y, x: gradient_y * y + gradient_x * x)
    fields = split_step.pupil_fields(air, range(6))
    phase = split_step.phase(fields, split_step.geometric_phase(air, range(6)))[0]
    found = Aperture(64, like=phase).coefficients(phase)
    share = split_step.sampling.slabs.z[layer] / path.distance
    tilt = (1 - share) * path.aperture / 4
    assert found[:, 1].numpy() == pytest.approx(gradient_x * tilt, rel=2e-3, abs=1e-4)
    assert found[:, 2].numpy() == pytest.approx(gradient_y * tilt, rel=2e-3, abs=1e-4)
    piston = share * (split_step.points @ [gradient_y, gradient_x])
    assert (found[:, 0] - found[0, 0]).numpy() == pytest.approx(piston - piston[0], abs=5e-3)


@pytest.mark.parametrize(("path", "periods"), [(NEAR, 3), (FAR, 1)])
@pytest.mark.parametrize("layer", [1, 5, 8])
def test_a_weak_grating_diffracts_as_theory_says(path, periods, layer):
    """phi = e cos(kx): phase e cos(q) cos(kcx) and log-amplitude e sin(q) cos(kcx), with q = k^2 z c lambda / 4 pi."""
    split_step = SplitStep(Sampling(path), dtype=torch.float64)
    z = split_step.sampling.slabs.z[layer]
    nearness = 1 - z / path.distance
    wavenumber = 2 * np.pi / (path.aperture / periods) / nearness
    strength = 0.01
    field = split_step.pupil_fields(air_of(split_step, layer, lambda y, x: strength * torch.cos(wavenumber * x)))[0, 0]
    angle = wavenumber**2 * z * nearness / (2 * path.wavenumber)
    x = torch.from_numpy(pupil_grid(64)[0]) * path.aperture / 2
    wave = strength * torch.cos(wavenumber * nearness * x)
    expected = torch.polar(torch.exp(math.sin(angle) * wave), math.cos(angle) * wave)
    assert (field - expected).abs().max() < 0.12 * strength


def test_one_strong_screen_against_a_plain_angular_spectrum():
    """The same screen crossed in collimated coordinates by `angular_spectrum`, at four times the sampling."""
    path = OpticalPath.from_d_over_r0(3.0, distance=1500.0)
    split_step = SplitStep(Sampling(path), dtype=torch.float64)
    layer = 6
    z = split_step.sampling.slabs.z[layer]
    nearness = 1 - z / path.distance
    bumps = torch.tensor([[0.03, 0.01, 2.0], [-0.02, 0.02, -3.0], [0.0, -0.03, 2.5]], dtype=torch.float64)

    def phase(y, x):
        return sum(h * torch.exp(-((y - a) ** 2 + (x - b) ** 2) / 0.015**2) for a, b, h in bumps)

    field = split_step.pupil_fields(air_of(split_step, layer, phase))[0, 0]
    fine, count = split_step.sampling.spacing_aperture / 4, 1024
    axis = (torch.arange(count, dtype=torch.float64) - (count - 1) / 2) * fine
    wave = torch.exp(1j * phase(axis[:, None] * nearness, axis * nearness))
    wave = angular_spectrum(wave, path.wavelength, fine, fine, z / nearness)
    start = count // 2 - 2 * 64
    expected = wave[start : start + 256, start : start + 256].unflatten(0, (64, 4)).unflatten(2, (64, 4))
    expected = expected[:, 1:3, :, 1:3].mean(dim=(1, 3))
    ratio = field / expected
    ratio = ratio / (ratio.mean() / ratio.mean().abs())
    assert (ratio - 1).abs().square().mean().sqrt() < 0.01


@pytest.mark.parametrize("path", [NEAR, FAR])
def test_screens_of_neighbours_overlap_and_a_point_does_not_depend_on_company(path):
    points = point_grid(path, 2, 2, 4.0)
    split_step = SplitStep(Sampling(path), points, dtype=torch.float64)
    air = split_step.draw(torch.Generator().manual_seed(5), 2)
    together = split_step.pupil_fields(air, range(4))
    assert together.shape == (2, 4, 64, 64)
    torch.testing.assert_close(split_step.pupil_fields(air, [2])[:, 0], together[:, 2])
    order = split_step.pupil_fields(air, [3, 0])
    torch.testing.assert_close(order, together[:, [3, 0]])
    phase = split_step.phase(together, split_step.geometric_phase(air, range(4)))
    assert (phase[:, 0] - phase[:, 1]).std() < (phase[0] - phase[1]).std()


def test_single_and_double_precision_agree():
    fields = []
    for dtype in (torch.float32, torch.float64):
        split_step = SplitStep(Sampling(FAR), dtype=dtype)
        air = air_of(split_step, 3, lambda y, x: 3 * torch.cos(60 * x) * torch.sin(50 * y))
        fields.append(split_step.pupil_fields(air).to(torch.complex128))
    assert (fields[0] - fields[1]).abs().max() < 1e-3


@pytest.mark.parametrize(("distance", "strength"), [(500.0, 5.0), (2000.0, 3.0), (7000.0, 3.0), (7000.0, 5.0)])
def test_the_part_of_the_grid_it_runs_on_is_enough(distance, strength):
    """The same air on N x N samples in every plane."""
    path = OpticalPath.from_d_over_r0(strength, distance=distance)
    whole, reduced = Sampling(path), Sampling(path)
    vars(whole)["grids"] = np.full(10, 256)
    assert (reduced.grids < 256).sum() >= 3
    air = SplitStep(whole).draw(torch.Generator().manual_seed(9), 4)
    fields = []
    for sampling in (whole, reduced):
        split_step = SplitStep(sampling)
        margins = [(256 - int(n)) // 2 for n in sampling.grids]
        cut = [phase[:, m : 256 - m, m : 256 - m] for m, phase in zip(margins, air.phases, strict=True)]
        fields.append(split_step.pupil_fields(Turbulence(cut)))
    error = (fields[1] - fields[0]).abs().square().mean() / fields[0].abs().square().mean()
    assert error.sqrt() < 0.03


def test_energy_is_neither_made_nor_lost_in_the_aperture():
    split_step = SplitStep(Sampling(NEAR))
    intensity = split_step.pupil_fields(split_step.draw(torch.Generator().manual_seed(6), 24)).abs().square()
    each = intensity.mean(dim=(1, 2, 3))
    assert abs(each.mean() - 1) < max(4 * each.std() / math.sqrt(24), 0.01)


def test_tilt_and_low_modes_have_nolls_variance():
    """240 draws. Diffraction alone, against straight rays through the same draws, is pinned far more tightly."""
    strength, draws = 2.0 ** (5 / 3), 240
    split_step = SplitStep(Sampling(NEAR))
    aperture = Aperture(64, 45)
    generator = torch.Generator().manual_seed(7)
    waves, rays = [], []
    for _ in range(draws // 8):
        air = split_step.draw(generator, 8)
        geometric = split_step.geometric_phase(air)
        rays.append(aperture.coefficients(geometric)[:, 0])
        waves.append(aperture.coefficients(split_step.phase(split_step.pupil_fields(air), geometric))[:, 0])
    squares = torch.cat(waves)[:, 1:15].double().square()
    theory = torch.tensor([noll_covariance(j, j) for j in range(2, 16)]) * strength
    error = squares.std(0) / math.sqrt(draws)
    assert ((squares.mean(0) - theory).abs() < 4.5 * error).all()
    pooled = (squares / theory).mean()
    assert abs(pooled - 1) < 4 * (squares / theory).mean(1).std() / math.sqrt(draws)
    diffraction = (squares - torch.cat(rays)[:, 1:15].double().square()).mean(0) / theory
    assert diffraction.abs().max() < 0.02


def test_screens_follow_a_lopsided_profile():
    """All the air at the camera against all of it at the scene: same plane-wave r0, another tilt."""
    variances = []
    for table in ([1e-13, 0.0], [0.0, 1e-13]):
        path = OpticalPath(0.2034, 500.0, Tabulated([0.0, 500.0], table))
        split_step = SplitStep(Sampling(path))
        air = split_step.draw(torch.Generator().manual_seed(8), 64)
        squares = Aperture(64).coefficients(split_step.geometric_phase(air))[:, 0, 1:3].square() / path.d_over_r0 ** (
            5 / 3
        )
        assert squares.mean() == pytest.approx(noll_covariance(2, 2), rel=4 * math.sqrt(2 / 128))
        variances.append(path.d_over_r0)
    assert variances[0] / variances[1] > 1.5


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(extent=3.0), "extent = 3"),
        (dict(screens=9), "screens = 9"),
        (dict(grid=100, extent=7.0), "must be whole"),
        (dict(grid=255), "must be whole"),
        (dict(grid=16), "grid = 16"),
        (dict(path=OpticalPath.from_d_over_r0(15.0, distance=500.0), grid=128), "use grid >="),
        (dict(path=OpticalPath.from_d_over_r0(18.0), grid=1024, screens=40), "use extent >="),
        (dict(path=OpticalPath.from_d_over_r0(9.0)), "use screens >="),
    ],
)
def test_a_violated_sampling_constraint_is_explained(arguments, message):
    with pytest.raises(ParameterError, match=message):
        Sampling(**{"path": FAR, **arguments})


def test_the_remedy_named_by_an_error_works():
    with pytest.raises(ParameterError, match=r"use screens >= (\d+)") as raised:
        Sampling(OpticalPath.from_d_over_r0(9.0))
    Sampling(OpticalPath.from_d_over_r0(9.0), screens=int(str(raised.value).split()[-1]))


def test_the_way_is_critically_sampled_in_any_geometry():
    for path in (NEAR, FAR):
        sampling = Sampling(path)
        total = path.wavelength * sampling.reduced_distances.sum()
        assert total == pytest.approx(sampling.grid * sampling.spacing_aperture**2)
        assert sampling.spacing_scene == pytest.approx(path.wavelength * path.distance / (4 * path.aperture))


def test_bad_points_are_named():
    for points in ([1.0, 2.0], [(0.0, math.nan)], [(0.0, 1.0, 2.0)]):
        with pytest.raises(ParameterError, match="points must be finite"):
            SplitStep(Sampling(STILL), points)


def test_air_drawn_for_other_points_is_refused():
    air = SplitStep(Sampling(NEAR)).draw(torch.Generator())
    with pytest.raises(ParameterError, match="other points"):
        SplitStep(Sampling(NEAR), point_grid(NEAR, 2, 2, 9.0)).pupil_fields(air)


def small_run() -> SplitStep:
    return SplitStep(Sampling(NEAR, grid=128), point_grid(NEAR, 3, 4))


def test_a_run_tells_its_cost_and_resumes_to_the_last_bit(tmp_path, capfd):
    split_step = small_run()
    whole = run_points(split_step, tmp_path / "whole", seed=3, size=17, chunk=5)
    said = capfd.readouterr().err
    assert "12 points x 10 screens x 128^2" in " ".join(said.split())
    assert split_step.cost.transforms == 240
    files = sorted((tmp_path / "whole").glob("points-*"))
    assert len(files) == 3
    files[1].unlink()
    again = run_points(small_run(), tmp_path / "whole", seed=3, size=17, chunk=5, quiet=True)
    for name in ("psf", "tilt_free_psf", "coefficients"):
        assert torch.equal(getattr(whole, name), getattr(again, name))
    assert capfd.readouterr().err == ""


def test_a_killed_run_leaves_whole_chunks_only(tmp_path, monkeypatch):
    split_step, calls = small_run(), []

    def killed(air, points):
        calls.append(points)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return SplitStep.pupil_fields(split_step, air, points)

    monkeypatch.setattr(split_step, "pupil_fields", killed)
    with pytest.raises(KeyboardInterrupt):
        run_points(split_step, tmp_path, chunk=5, size=17, quiet=True)
    left = sorted(f.name for f in tmp_path.iterdir())
    assert left[0] == "points-000000.safetensors"
    assert left[-1] == "run.json"
    assert all(name.startswith("points-") for name in left[:-1])  # nothing half-written
    assert "points-000005.safetensors" not in left
    resumed = run_points(small_run(), tmp_path, chunk=5, size=17, quiet=True)
    fresh = run_points(small_run(), tmp_path / "fresh", chunk=5, size=17, quiet=True)
    assert torch.equal(resumed.psf, fresh.psf)


def test_a_folder_of_another_run_or_a_damaged_one_is_refused(tmp_path):
    run_points(small_run(), tmp_path, chunk=12, size=17, quiet=True)
    with pytest.raises(InputError, match="another run \\(seed differ"):
        run_points(small_run(), tmp_path, seed=1, chunk=12, size=17, quiet=True)
    (tmp_path / "points-000000.safetensors").write_bytes(b"cut off")
    with pytest.raises(InputError, match="damaged"):
        run_points(small_run(), tmp_path, chunk=12, size=17, quiet=True)
    (tmp_path / "run.json").write_text("{")
    with pytest.raises(InputError, match="cannot use"):
        run_points(small_run(), tmp_path, chunk=12, size=17, quiet=True)
    (tmp_path / "file").write_text(json.dumps({}))
    with pytest.raises(InputError, match="cannot use"):
        run_points(small_run(), tmp_path / "file", quiet=True)
    with pytest.raises(ParameterError, match="PSF size"):
        run_points(small_run(), tmp_path / "new", size=65, quiet=True)


def test_the_image_is_the_scatter_of_the_psfs(tmp_path):
    field = run_points(small_run(), tmp_path, size=17, quiet=True)
    scene = torch.zeros(3, 4)
    scene[1, 2] = 2.0
    image = field.image(scene)
    kernel = field.psf[1 * 4 + 2]
    torch.testing.assert_close(image, 2 * kernel[8 - 1 : 8 + 2, 8 - 2 : 8 + 2])
    with pytest.raises(ParameterError, match="4 x 4"):
        field.image(torch.zeros(4, 4))


def test_zernike_tilt_is_where_the_psf_goes(tmp_path):
    """Full PSF = tilt-free PSF moved by 4 a / pi Nyquist pixels, here checked by the centroid of a weak draw."""
    path = OpticalPath.from_d_over_r0(1.0, distance=500.0)
    field = run_points(SplitStep(Sampling(path), point_grid(path, 2, 2, 20.0)), tmp_path, size=61, quiet=True)
    axis = torch.arange(61.0) - 30
    for j, direction in [(2, axis), (3, axis[:, None])]:
        moved = ((field.psf - field.tilt_free_psf) * direction).sum(dim=(1, 2))
        expected = field.coefficients[:, j - 1] * 4 / math.pi
        torch.testing.assert_close(moved, expected, rtol=0.1, atol=0.02)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_gpu_gives_what_the_processor_gives():
    results = []
    for device in ("cpu", "cuda"):
        split_step = SplitStep(Sampling(NEAR), device=device)
        results.append(split_step.pupil_fields(split_step.draw(torch.Generator().manual_seed(0))).cpu())
    assert (results[0] - results[1]).abs().max() < 1e-2
