"""Commands before a survey: how large its targets must be."""

from __future__ import annotations

from typing import Annotated

import typer

from sfm.cli.commands.starting import loading
from sfm.errors import SurveyFileError
from sfm.planning.target_size import MIN_PIXELS, target_size

plan = typer.Typer(name="plan", help="Plan a survey before the photographs are taken.")


@plan.callback()
def _plans() -> None:
    """Plan a survey before the photographs are taken."""


@plan.command("target-size")
def target_size_command(
    distance: Annotated[
        float,
        typer.Option(
            "--distance", metavar="D", help="Farthest distance of the camera, in the unit of --unit."
        ),
    ],
    c: Annotated[float, typer.Option("--c-mm", metavar="MM", help="Principal distance (focal length), mm.")],
    width: Annotated[float, typer.Option("--sensor-width-mm", metavar="MM", help="Width of the sensor, mm.")],
    columns: Annotated[int, typer.Option("--width-px", metavar="N", help="Width of the photographs, px.")],
    pixels: Annotated[
        float, typer.Option("--pixels", metavar="P", help="Pixels across a target, at least.")
    ] = MIN_PIXELS,
    tilt: Annotated[
        float, typer.Option("--tilt-deg", metavar="DEG", help="Largest tilt of a target to its ray, deg.")
    ] = 0.0,
    family: Annotated[
        str, typer.Option("--family", help="Rings around the dots: ring12, ring14, ring20 or arcs.")
    ] = "ring14",
    unit: Annotated[
        str, typer.Option("--unit", help="Unit of the distance: km, m, dm, cm, mm, um, in or ft.")
    ] = "mm",
) -> None:
    """Tell how large targets must be for a camera and a distance.

    diameter = pixels x sensor width x distance / (c x photograph width), over the cosine of the tilt.
    """
    with loading():
        from sfm.conventions import METRES
        from sfm.targets.codes.families import code_family
        from sfm.targets.codes.rings import CodeFamily

    if unit not in METRES:
        raise SurveyFileError(f"--unit {unit}: expected one of {', '.join(METRES)}")
    if METRES[unit] * distance <= c / 1000:
        raise SurveyFileError(
            f"--distance {distance:g} {unit}: not farther than the principal distance of {c:g} mm; expected "
            "that of the object, in another unit with --unit"
        )
    codes = code_family(family)
    if not isinstance(codes, CodeFamily):
        raise SurveyFileError(f"--family {family}: needed rings, such as ring14")
    size = target_size(
        p=pixels, w_mm=width, d=distance, c_mm=c, n=columns, tilt_deg=tilt, ring_per_dot=codes.outer
    )
    print(f"diameter of the dot   {size.diameter:.4g} {unit}, {pixels:g} px across at {tilt:g} deg tilt")
    print(f"ring of the code      {size.ring:.4g} {unit} outer diameter ({codes.name})")
    print(f"a pixel at the object {size.pixel:.4g} {unit}")
