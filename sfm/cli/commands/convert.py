"""The command `convert`, which carries a survey between programs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from sfm.cli.options import Verbose
from sfm.cli.process import loading
from sfm.model.errors import SurveyFileError
from sfm.runtime.faults import working_on

MOST_LINES = 3  # on what a conversion loses


def convert(
    source: Annotated[Path, typer.Argument(metavar="IN", help="File or folder to read.")],
    target: Annotated[Path, typer.Argument(metavar="OUT", help="File or folder to write.")],
    to_format: Annotated[
        str | None,
        typer.Option(
            "--to",
            metavar="F",
            help="Format to write.  [default: by the ending of OUT: .xml metashape, .ply ply, .laz and "
            ".las laz, .e57 e57, .csv points-csv, .geojson geojson, .db colmap-database, .nvm nvm, .sfm "
            "alicevision, none tables]",
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
    crs: Annotated[
        str | None,
        typer.Option(
            "--crs",
            metavar="EPSG:N",
            help="For formats of points: coordinate system to write; points of a known one are transformed.",
        ),
    ] = None,
    verbose: Verbose = False,
    camera: Annotated[
        str | None,
        typer.Option("--camera", metavar="NAME", help="For formats of cameras: the only camera to write."),
    ] = None,
    inexact: Annotated[
        bool,
        typer.Option("--inexact", help="For formats of cameras and rig: accept a misfit above 0.05 px RMS."),
    ] = False,
) -> None:
    """Convert a survey or cameras between formats of programs.

    A camera whose model the format lacks is converted to one that it has. Formats of surveys: colmap,
    colmap-text, colmap-database, tables, metashape, photomodeler, opensfm (also projects of OpenDroneMap),
    openmvg, alicevision (Meshroom), nerfstudio, bundler, nvm (VisualSFM), micmac, aicon (also of JAG3D),
    realitycapture (CSV), agisoft-reference (CSV), resection (of resect --json, only read), bal, sba,
    bundle-matlab, bundle-csharp, rig (calibration files of rigs for OpenCV, COLMAP, DICe, MatchID, Kalibr,
    ROS and mrcal), and those of points alone: laz, e57, points-csv, geojson and ply.

    Formats of cameras, to read and write: opencv-camera, ros-camera, kalibr-camera, mrcal-camera,
    colmap-camera, metashape-camera, australis-camera, nerfstudio-camera and blender-camera. A camera of a
    result is adjusted again in the other model, from the same image points, and its misfit stated.
    """
    with loading():
        from adapters.formats.cameras.registry import NAMES, camera_format_of
        from adapters.formats.content import with_cameras
        from adapters.formats.point_tables import in_system
        from adapters.formats.registry import (
            ENDINGS,
            FORMATS,
            describe_stored,
            format_named,
            losses_in_words,
            read_content,
            recognised_format,
            refuse_taken,
            write_content,
        )
        from sfm.cli.written_cameras import readjusted_content, write_camera_files
        from sfm.comparison.camera_conversion import Conversion, convert_cameras, undistort

    ending = target.suffix.lower()
    if to_format is None and ending == ".cameramodel":
        to_format = "mrcal-camera"
    if to_format in NAMES:
        with working_on(str(source)):
            print(
                write_camera_files(
                    source, target, to_format, read_as=from_format, camera=camera, inexact=inexact
                )
            )
        return
    if to_format is None and ending and ending not in ENDINGS:
        raise SurveyFileError(
            f"{target}: unknown ending {ending}, expected {', '.join(ENDINGS)}, a folder for tables, or --to "
            f"with one of {', '.join((*(known.name for known in FORMATS), *NAMES))}"
        )
    form = format_named(to_format or ENDINGS.get(ending, "tables"))
    refuse_taken(target, form)
    survey = not source.is_file() or from_format is not None or recognised_format(source) is not None
    if not survey and camera_format_of(source) is not None:
        raise SurveyFileError(
            f"{source}: a file of cameras, without a survey; --to needs one of {', '.join(NAMES)}"
        )
    if crs is not None and not form.only_points:
        raise SurveyFileError(
            f"--crs: format {form.name} has photographs; only formats of points are transformed"
        )
    with working_on(str(source)):
        content = read_content(source, from_format, control=control)
    whole = content
    if crs is not None:
        content = in_system(content, crs)
    network, estimate = content.result.network, content.result.estimate
    cameras = estimate.cameras
    conversions: tuple[Conversion, ...] = ()
    adjusted: tuple[str, ...] = ()
    if form.name == "rig" and not straighten:
        content, anew = readjusted_content(content, form.name, inexact=inexact)
        network, estimate = content.result.network, content.result.estimate
        adjusted = tuple(conversion.words for conversion in anew)
    elif form.models:
        if straighten:
            network, estimate = undistort(network, estimate, form.models)
        estimate, conversions = convert_cameras(estimate, form.models, held=form.lacks, square=form.square)
    changed, gone = with_cameras(content, network, estimate)
    changed = replace(changed, result=replace(changed.result, name=target.name))
    write_content(target, form.name, changed)
    for words in adjusted:
        print(words)
    for former, conversion in zip(cameras, conversions, strict=False):
        if straighten:
            print(f"camera {former.name}: image points corrected for {former.model}, ideal camera written")
        elif conversion.camera is not former:
            print(
                f"camera {former.name}: {conversion.source_model} to {conversion.camera.model}, "
                f"misfit {conversion.rms_px:.4f} px RMS, {conversion.max_px:.4f} px at most"
            )
    for note in content.notes:
        print(f"{source}: {note}")
    print(f"{target}: {describe_stored(form.name, network, estimate)} as {form.name}")
    lost = losses_in_words(form.name, replace(whole, crs=content.crs), gone)
    told = len(lost) if verbose or len(lost) <= MOST_LINES else MOST_LINES - 1
    for loss in lost[:told]:
        print(f"{target}: {loss} left out, they are not written as {form.name}")
    if lost[told:]:
        print(f"{target}: also left out, a line for each with -v: {', '.join(lost[told:])}")
