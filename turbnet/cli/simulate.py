"""`turbnet simulate`: turbulence on a picture or a clip."""

from math import cos, radians, sin
from pathlib import Path
from typing import Annotated, Any, cast

import typer

from turbnet.cli.typed import run_typed


def simulate(
    source: Annotated[Path, typer.Argument(metavar="INPUT", help="Picture, clip, folder of frames or TIFF.")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Clip to write; its kind is told by its extension.")
    ] = None,
    aperture: Annotated[float, typer.Option(help="Diameter of the entrance pupil, m.")] = 0.2034,
    distance: Annotated[float, typer.Option(help="From the aperture to the scene, m.")] = 7000.0,
    cn2: Annotated[float | None, typer.Option(help="Structure parameter of the air, m^(-2/3).")] = None,
    d_over_r0: Annotated[
        float | None, typer.Option("--d-over-r0", help="Strength instead of --cn2: aperture over Fried parameter.")
    ] = None,
    wavelength: Annotated[float, typer.Option(help="Wavelength, m.")] = 525e-9,
    like: Annotated[
        Path | None, typer.Option(help="Real clip of a still scene, whose strength is estimated and used.")
    ] = None,
    focal_length: Annotated[float | None, typer.Option(help="Of the camera, m; with --pixel-pitch.")] = None,
    pixel_pitch: Annotated[float | None, typer.Option(help="Of the camera's sensor, m; with --focal-length.")] = None,
    outer_scale: Annotated[float, typer.Option(help="Of the air, m; infinite for Kolmogorov.")] = float("inf"),
    wavelengths: Annotated[
        str | None, typer.Option(help="RED,GREEN,BLUE, m: one for each channel instead of one for all.")
    ] = None,
    frames: Annotated[int | None, typer.Option(help="Frames; by default 60 of a picture, all of a clip.")] = None,
    fps: Annotated[float | None, typer.Option(help="Frames a second; by default 30, or the clip's own.")] = None,
    wind: Annotated[float, typer.Option(help="Speed of the air across the path, m/s.")] = 2.0,
    wind_direction: Annotated[float, typer.Option(help="Of the wind in the picture, degrees: 0 right, 90 down.")] = 0.0,
    boiling: Annotated[float, typer.Option(help="Time in which the air becomes other air, s.")] = float("inf"),
    independent: Annotated[
        bool, typer.Option("--independent", help="An atmosphere of its own for each frame.")
    ] = False,
    read_noise: Annotated[float, typer.Option(help="Standard deviation, fraction of full scale.")] = 0.0,
    full_well: Annotated[float, typer.Option(help="Electrons at full scale, for shot noise.")] = float("inf"),
    bits: Annotated[int, typer.Option(help="Depth of quantisation before gamma; 0 for none.")] = 0,
    exposures: Annotated[int, typer.Option(help="Moments averaged into a frame.")] = 1,
    shutter: Annotated[float, typer.Option(help="Part of a frame's time over which they are spread.")] = 1.0,
    jpeg: Annotated[int | None, typer.Option(help="Quality of JPEG compression of each frame, 1 to 100.")] = None,
    tolerance: Annotated[float, typer.Option(help="Error budget, dB PSNR: less is faster.")] = 45.0,
    plan: Annotated[bool, typer.Option("--plan", help="Say what would be left out for this input, and stop.")] = False,
    crop: Annotated[str | None, typer.Option(help="LEFT,TOP,WIDTH,HEIGHT of the part to use, pixels.")] = None,
    truth: Annotated[
        Path | None,
        typer.Option(help="Folder for the truth: tilt.npy (T, 2, H, W) px, blur_strength.npy, blur_only, tilt_only."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Of the atmosphere and the noise.")] = 0,
    json: Annotated[Path | None, typer.Option(help="Write the path's figures as JSON.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bar, no table.")] = False,
) -> None:
    """Look at a picture or a clip through turbulent air; with --dataset OUT, write many pairs to train on instead.

    A pixel of the input is taken as the Nyquist pixel lambda L / (2 D) of the path, unless a camera is given. Give the
    strength by --cn2, --d-over-r0 or --like; without any, Cn2 is 1e-15 m^(-2/3). `turbnet simulate --dataset OUT --help`
    tells of datasets.
    """
    from turbnet.atmosphere.path import OpticalPath
    from turbnet.atmosphere.profiles import Constant
    from turbnet.cli.options import parse_crop, parse_wavelengths
    from turbnet.errors import InputError
    from turbnet.media.atomic import check_output
    from turbnet.report import Report, Row
    from turbnet.simulate.camera import Camera
    from turbnet.simulate.sensor import Sensor
    from turbnet.simulate.write import fitted_strength, plan_of, write_simulation

    if json is not None:
        check_output(json)
    if output is None and not plan:
        raise InputError("give the clip to write with -o, or --plan to see what would be done")
    if sum(value is not None for value in (cn2, d_over_r0, like)) > 1:
        raise InputError("give --cn2, --d-over-r0 or --like, not both: each decides the strength")
    if (focal_length is None) != (pixel_pitch is None):
        raise InputError("give --focal-length and --pixel-pitch together: it takes both to know the size of a pixel")
    options: dict[str, Any] = {"tolerance": tolerance, "outer_scale": outer_scale, "boiling": boiling}
    if focal_length is not None and pixel_pitch is not None:
        options["q"] = Camera(aperture, focal_length, pixel_pitch, wavelength).sampling
    if wavelengths is not None:
        options["wavelengths"] = parse_wavelengths(wavelengths)
    sensor = Sensor(full_well, read_noise, bits, exposures, jpeg=jpeg)
    if like is not None:
        fit = fitted_strength(like, OpticalPath.from_d_over_r0(1.0, aperture, distance, wavelength))
        d_over_r0 = fit.d_over_r0
        if not quiet:
            print(f"{like}: D/r0 = {fit.d_over_r0:.2f} +- {fit.uncertainty:.2f}")
    if d_over_r0 is not None:
        path = OpticalPath.from_d_over_r0(d_over_r0, aperture, distance, wavelength)
    else:
        path = OpticalPath(aperture, distance, Constant(1e-15 if cn2 is None else cn2), wavelength)
    if plan:
        print(plan_of(source, path, parse_crop(crop), **options))
        return
    report = Report()
    report.add(Row("D/r0", path.d_over_r0))
    report.add(Row("Fried parameter r0", path.r0, "m"))
    report.add(Row("isoplanatic angle", path.theta0, "rad"))
    report.add(Row("isoplanatic angle", path.theta0_pixels, "pixels"))
    report.add(Row("pixel in the scene", path.pixel * options.get("q", 1.0), "m"))
    if not quiet:
        for row in report.rows:
            print(f"{row.name:22s}{row.value:.4g} {row.unit}")
    write_simulation(
        source,
        cast(Path, output),
        path,
        frames=frames,
        fps=fps,
        wind=None if independent else (wind * cos(radians(wind_direction)), wind * sin(radians(wind_direction))),
        sensor=sensor,
        crop=parse_crop(crop),
        truth=truth,
        seed=seed,
        quiet=quiet,
        shutter=shutter,
        **options,
    )
    if json is not None:
        report.write(json)


def main(arguments: list[str]) -> int:
    """Run the verb."""
    if any(argument.partition("=")[0] == "--dataset" for argument in arguments):
        from turbnet.cli import dataset

        return dataset.main(arguments)
    return run_typed(simulate, arguments, "simulate")
