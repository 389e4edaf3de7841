"""The command `convert`, which carries a survey between programs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sfm.cli.process import loading
from sfm.model.errors import SurveyFileError
from sfm.runtime.faults import working_on

if TYPE_CHECKING:
    pass


def convert(
    source: Annotated[Path, typer.Argument(metavar="IN", help="File or folder to read.")],
    target: Annotated[Path, typer.Argument(metavar="OUT", help="File or folder to write.")],
    to_format: Annotated[
        str | None,
        typer.Option(
            "--to",
            metavar="F",
            help="Format to write.  [default: by the ending of OUT: .xml metashape, .ply ply, .db "
            "colmap-database, none tables]",
        ),
    ] = None,
    from_format: Annotated[
        str | None,
        typer.Option("--from", metavar="F", help="Format to read.  [default: by the content of IN]"),
    ] = None,
    straighten: Annotated[
        bool,
        typer.Option(
            "--undistort", help="Correct image points for distortion, for formats without distortion."
        ),
    ] = False,
    control: Annotated[
        Path | None,
        typer.Option(
            "--control", metavar="FILE", help="Control points of a PhotoModeler export: id,label,X,Y,Z..."
        ),
    ] = None,
) -> None:
    """Convert a survey from one program's format to another's.

    A camera whose model the format lacks is converted to one that it has. Formats: colmap, colmap-text,
    colmap-database, tables, metashape, photomodeler, bal, sba, bundle-matlab, bundle-csharp, rig (calibration
    files of rigs for OpenCV, COLMAP, DICe, MatchID, Kalibr, ROS and mrcal) and ply.
    """
    with loading():
        from adapters.formats.content import with_cameras
        from adapters.formats.registry import (
            ENDINGS,
            FORMATS,
            describe_stored,
            format_named,
            losses_in_words,
            read_content,
            refuse_taken,
            write_content,
        )
        from sfm.comparison.camera_conversion import Conversion, convert_cameras, undistort

    ending = target.suffix.lower()
    if to_format is None and ending and ending not in ENDINGS:
        raise SurveyFileError(
            f"{target}: unknown ending {ending}, expected {', '.join(ENDINGS)}, a folder for tables, or --to "
            f"with one of {', '.join(known.name for known in FORMATS)}"
        )
    form = format_named(to_format or ENDINGS.get(ending, "tables"))
    refuse_taken(target, form)
    with working_on(str(source)):
        content = read_content(source, from_format, control=control)
    network, estimate = content.result.network, content.result.estimate
    cameras = estimate.cameras
    conversions: tuple[Conversion, ...] = ()
    if form.models:
        if straighten:
            network, estimate = undistort(network, estimate, form.models)
        estimate, conversions = convert_cameras(estimate, form.models, held=form.lacks)
    changed, gone = with_cameras(content, network, estimate)
    changed = replace(changed, result=replace(changed.result, name=target.name))
    write_content(target, form.name, changed)
    for camera, conversion in zip(cameras, conversions, strict=False):
        if straighten:
            print(f"camera {camera.name}: image points corrected for {camera.model}, ideal camera written")
        elif conversion.camera is not camera:
            print(
                f"camera {camera.name}: {conversion.source_model} to {conversion.camera.model}, "
                f"misfit {conversion.rms_px:.4f} px RMS, {conversion.max_px:.4f} px at most"
            )
    for note in content.notes:
        print(f"{source}: {note}")
    print(f"{target}: {describe_stored(form.name, network, estimate)} as {form.name}")
    for loss in losses_in_words(form.name, content, gone):
        print(f"{target}: {loss} left out, format {form.name} cannot store them")
