"""`turbnet simulate`: turbulence on a picture or a clip."""

from pathlib import Path
from typing import Annotated

import typer

from turbnet.cli.typed import run_typed


def simulate(
    source: Annotated[Path, typer.Argument(metavar="INPUT", help="Picture, clip, folder of frames or TIFF.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Clip to write; its kind is told by its extension.")],
    aperture: Annotated[float, typer.Option(help="Diameter of the entrance pupil, m.")] = 0.2034,
    distance: Annotated[float, typer.Option(help="From the aperture to the scene, m.")] = 7000.0,
    cn2: Annotated[float | None, typer.Option(help="Structure parameter of the air, m^(-2/3).")] = None,
    d_over_r0: Annotated[
        float | None, typer.Option("--d-over-r0", help="Strength instead of --cn2: aperture over Fried parameter.")
    ] = None,
    wavelength: Annotated[float, typer.Option(help="Wavelength, m.")] = 525e-9,
    frames: Annotated[int | None, typer.Option(help="Frames; by default 60 of a picture, all of a clip.")] = None,
    fps: Annotated[float | None, typer.Option(help="Frames a second; by default 30, or the clip's own.")] = None,
    wind: Annotated[float, typer.Option(help="Speed of the air across the path, m/s.")] = 2.0,
    independent: Annotated[
        bool, typer.Option("--independent", help="An atmosphere of its own for each frame.")
    ] = False,
    read_noise: Annotated[float, typer.Option(help="Standard deviation, fraction of full scale.")] = 0.0,
    full_well: Annotated[float, typer.Option(help="Electrons at full scale, for shot noise.")] = float("inf"),
    crop: Annotated[str | None, typer.Option(help="LEFT,TOP,WIDTH,HEIGHT of the part to use, pixels.")] = None,
    truth: Annotated[
        Path | None, typer.Option(help="Folder for the truth: tilt.npy (T, 2, H, W) px, blur_only and tilt_only clips.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Of the atmosphere and the noise.")] = 0,
    json: Annotated[Path | None, typer.Option(help="Write the path's figures as JSON.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bar, no table.")] = False,
) -> None:
    """Look at a picture or a clip through turbulent air; with --dataset OUT, write many pairs to train on instead.

    A pixel of the input is taken as the Nyquist pixel lambda L / (2 D) of the path. Give the strength by --cn2 or by
    --d-over-r0; without either, Cn2 is 1e-15 m^(-2/3). `turbnet simulate --dataset OUT --help` tells of datasets.
    """
    from turbnet.atmosphere.path import OpticalPath
    from turbnet.atmosphere.profiles import Constant
    from turbnet.cli.options import parse_crop
    from turbnet.errors import InputError
    from turbnet.media.atomic import check_output
    from turbnet.report import Report, Row
    from turbnet.simulate.sensor import Sensor
    from turbnet.simulate.write import write_simulation

    if json is not None:
        check_output(json)
    if cn2 is not None and d_over_r0 is not None:
        raise InputError("give --cn2 or --d-over-r0, not both: each decides the strength")
    if d_over_r0 is not None:
        path = OpticalPath.from_d_over_r0(d_over_r0, aperture, distance, wavelength)
    else:
        path = OpticalPath(aperture, distance, Constant(1e-15 if cn2 is None else cn2), wavelength)
    report = Report()
    report.add(Row("D/r0", path.d_over_r0))
    report.add(Row("Fried parameter r0", path.r0, "m"))
    report.add(Row("isoplanatic angle", path.theta0, "rad"))
    report.add(Row("isoplanatic angle", path.theta0_pixels, "pixels"))
    report.add(Row("pixel in the scene", path.pixel, "m"))
    if not quiet:
        for row in report.rows:
            print(f"{row.name:22s}{row.value:.4g} {row.unit}")
    write_simulation(
        source,
        output,
        path,
        frames=frames,
        fps=fps,
        wind=None if independent else (wind, 0.0),
        sensor=Sensor(full_well, read_noise),
        crop=parse_crop(crop),
        truth=truth,
        seed=seed,
        quiet=quiet,
    )
    if json is not None:
        report.write(json)


def main(arguments: list[str]) -> int:
    """Run the verb."""
    if any(argument.partition("=")[0] == "--dataset" for argument in arguments):
        from turbnet.cli import dataset

        return dataset.main(arguments)
    return run_typed(simulate, arguments, "simulate")
