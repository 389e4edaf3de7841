"""The command `plan target-size`: how large targets must be."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sfm.cli.process import loading
from sfm.model.errors import SurveyFileError
from sfm.products.planning import MIN_PIXELS


def plan_target_size(
    distance: Annotated[
        float,
        typer.Option(
            "--distance", metavar="D", help="Largest distance from the camera, in the unit of --unit."
        ),
    ],
    c: Annotated[float, typer.Option("--c-mm", metavar="MM", help="Principal distance (focal length), mm.")],
    width: Annotated[float, typer.Option("--sensor-width-mm", metavar="MM", help="Width of the sensor, mm.")],
    columns: Annotated[int, typer.Option("--width-px", metavar="N", help="Width of the photographs, px.")],
    pixels: Annotated[
        float, typer.Option("--pixels", metavar="P", help="Smallest number of pixels across a target.")
    ] = MIN_PIXELS,
    tilt: Annotated[
        float,
        typer.Option("--tilt-deg", metavar="DEG", help="Largest tilt of a target from its ray, degrees."),
    ] = 0.0,
    family: Annotated[
        str, typer.Option("--family", help="Code family: ring12, ring14, ring20 or arcs.")
    ] = "ring14",
    unit: Annotated[
        str, typer.Option("--unit", help="Unit of the distance: km, m, dm, cm, mm, um, nm, in or ft.")
    ] = "mm",
    diagram: Annotated[
        Path | None,
        typer.Option(
            "--diagram",
            metavar="FILE.svg",
            help="Write a diagram of the diameter against the distance, up to --distance.",
        ),
    ] = None,
) -> None:
    """Compute how large targets must be for a camera and a distance.

    diameter = pixels x sensor width x distance / (c x photograph width x cosine of the tilt)
    """
    with loading():
        from sfm.files.whole_files import refuse_existing, whole_file
        from sfm.model.conventions import METRES
        from sfm.products.planning.visibility import compute_target_size
        from sfm.targets.codes.plates import code_family
        from sfm.targets.codes.rings import CodeFamily

    if diagram is not None:
        if diagram.suffix.lower() != ".svg":
            raise SurveyFileError(f"--diagram {diagram}: expected a file .svg")
        refuse_existing(diagram)
    if unit not in METRES:
        raise SurveyFileError(f"--unit {unit}: expected one of {', '.join(METRES)}")
    if METRES[unit] * distance <= c / 1000:
        raise SurveyFileError(
            f"--distance {distance:g} {unit}: not larger than the principal distance of {c:g} mm; expected "
            "the distance of the object; --unit sets its unit"
        )
    codes = code_family(family)
    if not isinstance(codes, CodeFamily):
        raise SurveyFileError(f"--family {family}: expected a family of rings, such as ring14")
    size = compute_target_size(
        p=pixels, w_mm=width, d=distance, c_mm=c, n=columns, tilt_deg=tilt, ring_per_dot=codes.outer
    )
    print(f"diameter of the dot   {size.diameter:.4g} {unit}, {pixels:g} px across at {tilt:g} deg tilt")
    print(f"ring of the code      {size.ring:.4g} {unit} outer diameter ({codes.name})")
    print(f"a pixel at the object {size.pixel:.4g} {unit}")
    if diagram is not None:
        from sfm.products.planning.page import DIAGRAM_PIXELS, design_diagram

        drawn = design_diagram(
            lines=sorted({*DIAGRAM_PIXELS, pixels}),
            w_mm=width, d=distance, c_mm=c, n=columns, unit=unit, tilt_deg=tilt,
        )  # fmt: skip
        with whole_file(diagram) as part:
            part.write_bytes(drawn)
        print(f"diagram               {diagram}")
