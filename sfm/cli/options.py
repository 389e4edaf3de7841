"""Options and arguments that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

SurveyFile = Annotated[
    Path, typer.Argument(metavar="SURVEY.toml", help="Survey file; its paths are relative to its folder.")
]
SurveyOrPhotographs = Annotated[
    Path,
    typer.Argument(
        metavar="SURVEY.toml|PHOTOS|VIDEO",
        help="Survey file, whose paths are relative to its folder, or a folder of photographs, a video or a "
        "folder of videos, for which a survey file is drafted.",
    ),
]
Out = Annotated[
    Path | None,
    typer.Option(
        "--out",
        metavar="DIR",
        help="Folder of the result, written completely or not at all; an earlier result of the same survey "
        "is replaced.  [default: out/NAME OF THE SURVEY]",
    ),
]
Overwrite = Annotated[
    bool,
    typer.Option(
        "--overwrite",
        help="Replace a result folder of another survey file or of other photographs; survey files are never "
        "replaced.",
    ),
]
Jobs = Annotated[
    int | None,
    typer.Option(
        "--jobs",
        metavar="N",
        min=1,
        help="Number of photographs processed at a time.  [default: one per core]",
    ),
]
PicturesMb = Annotated[
    float,
    typer.Option(
        "--pictures-mb",
        metavar="MB",
        min=0.0,
        help="Largest total size of photographs and crops inside report.html; the others are in pictures/.",
    ),
]
Cluster = Annotated[
    str | None,
    typer.Option(
        "--cluster",
        metavar="ADDRESS",
        help="Dask scheduler, such as tcp://192.168.1.5:8786, whose workers adjust a large network in "
        "Helmert blocks. They need Kolinear.",
    ),
]
Verbose = Annotated[
    bool, typer.Option("--verbose", "-v", help="Also print every photograph and every warning.")
]
AllowOutside = Annotated[
    bool,
    typer.Option(
        "--allow-outside",
        help="Let the survey file refer to files outside its folder; only for survey files that you trust.",
    ),
]
Calibration = Annotated[
    Path | None,
    typer.Option(
        "--camera",
        metavar="RESULT",
        help="Hold the interior orientation fixed at that of an earlier result; cameras are matched by name.",
    ),
]
Weighted = Annotated[
    bool,
    typer.Option(
        "--camera-weighted",
        help="Do not hold the parameters fixed that were adjusted in the result of --camera: adjust them "
        "again, observed with their full covariance.",
    ),
]
Pitch = Annotated[
    float | None,
    typer.Option(
        "--pitch",
        metavar="MM",
        min=1e-6,
        help="Side of the squares of a board, or distance between the dots of a plate, mm, for a drafted "
        "survey file.  [default: assumed]",
    ),
]
ResultFolder = Annotated[Path, typer.Argument(metavar="RESULT", help="Result folder of a survey.")]
PlanOut = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the page and the tables.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]


def _refuse_unprintable(asked: bool) -> bool:
    """Refuse --pdf before any work where nothing prints pages."""
    if asked:
        from sfm.report.pdf import pdf_printer

        pdf_printer()
    return asked


Pdf = Annotated[
    bool,
    typer.Option(
        "--pdf",
        callback=_refuse_unprintable,
        help="Also print the page into a PDF beside it: A4, with header, page numbers and a place to sign.",
    ),
]
OpenPage = Annotated[bool, typer.Option("--open/--no-open", help="Open the page in the browser.")]
Frames = Annotated[
    int | None,
    typer.Option(
        "--frames",
        metavar="N",
        min=2,
        help="Number of frames to take of a video, evenly spaced by the motion of the camera.  [default: "
        "as many as neighbours need to have points in common]",
    ),
]


def names_in(text: str) -> tuple[str, ...]:
    """Return the names of an option that are separated by commas."""
    return tuple(name.strip() for name in text.split(",") if name.strip())
