"""The command `undistort`: photographs without distortion, and rectified pairs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sfm.cli.process import loading
from sfm.runtime.faults import working_on


def undistort(
    cameras: Annotated[
        Path, typer.Argument(metavar="RESULT|CAMERA", help="Result folder, or a file of calibrated cameras.")
    ],
    photographs: Annotated[Path, typer.Argument(metavar="PHOTOS", help="Folder of photographs, or one.")],
    pairs: Annotated[
        bool,
        typer.Option("--pairs", help="Rectify the pairs of a rig: conjugate points on equal rows."),
    ] = False,
    camera: Annotated[
        str | None,
        typer.Option(
            "--camera", metavar="NAME", help="Camera of all photographs.  [default: by their names]"
        ),
    ] = None,
    alpha: Annotated[
        float | None,
        typer.Option(
            "--alpha",
            metavar="A",
            help="0: no border is empty, 1: everything is visible.  [default: c and principal point kept; "
            "0 for pairs]",
        ),
    ] = None,
    read_as: Annotated[
        str | None,
        typer.Option("--from", metavar="F", help="Format of the cameras.  [default: by their content]"),
    ] = None,
    to_format: Annotated[
        str, typer.Option("--to", metavar="F", help="Format of the files of the new cameras.")
    ] = "opencv-camera",
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for photographs and new cameras.")
    ] = Path("out/undistorted"),
) -> None:
    """Write photographs without distortion, and their new cameras.

    Photographs keep their names, bits, colours and EXIF data. Pairs of a rig are rectified with --pairs:
    their cameras, R1, R2, P1, P2 and Q are those of OpenCV's stereoRectify, with zero disparity at infinity.
    """
    with loading():
        from sfm.cli.undistorted import undistort_photographs
        from sfm.runtime.progress_bar import drawn_progress

    with working_on(str(cameras)), drawn_progress() as progress:
        lines = undistort_photographs(
            cameras,
            photographs,
            out,
            read_as=read_as,
            camera=camera,
            pairs=pairs,
            alpha=alpha,
            to=to_format,
            progress=progress,
        )
    for line in lines:
        print(line)
