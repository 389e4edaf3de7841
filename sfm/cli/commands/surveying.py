"""Commands about a survey: run and adjust."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sfm.cli.commands.drafting import Pitch, drafted_beside, refuse_pitch
from sfm.cli.commands.starting import FAILED, loading
from sfm.cli.first_use import compile_first
from sfm.errors import KolinearError
from sfm.runtime.faults import working_on

if TYPE_CHECKING:
    from sfm.survey.inputs.survey import Survey


SURVEY_FILE = "survey.toml"  # in a folder of photographs

SurveyFile = Annotated[
    Path, typer.Argument(metavar="SURVEY.toml", help="The survey file; its paths are relative to it.")
]
SurveyOrPhotographs = Annotated[
    Path,
    typer.Argument(
        metavar="SURVEY.toml|PHOTOS",
        help="The survey file, whose paths are relative to it, or a folder of photographs, for which one is "
        "drafted.",
    ),
]
Out = Annotated[
    Path | None,
    typer.Option(
        "--out",
        metavar="DIR",
        help="Folder of the result, written whole or not at all; an earlier result of the survey is "
        "replaced.  [default: out/NAME OF THE SURVEY]",
    ),
]
Overwrite = Annotated[
    bool,
    typer.Option(
        "--overwrite",
        help="Replace the folder of a result of another survey file or of other photographs; survey files "
        "are never replaced.",
    ),
]
Jobs = Annotated[
    int | None,
    typer.Option("--jobs", metavar="N", min=1, help="Photographs worked on at a time.  [default: all cores]"),
]
PicturesMb = Annotated[
    float,
    typer.Option(
        "--pictures-mb",
        metavar="MB",
        min=0.0,
        help="Largest size of photographs and crops inside report.html; the rest is in pictures/.",
    ),
]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Print more: every photograph and warning.")]
AllowOutside = Annotated[
    bool,
    typer.Option(
        "--allow-outside",
        help="Let the survey file name files outside its folder; only for survey files that you trust.",
    ),
]


Calibration = Annotated[
    Path | None,
    typer.Option(
        "--camera",
        metavar="RESULT",
        help="Hold the interior orientation at that of an earlier result; cameras are matched by name.",
    ),
]
Weighted = Annotated[
    bool,
    typer.Option(
        "--camera-weighted",
        help="Adjust the parameters that --camera adjusted, observed with their values and full covariance.",
    ),
]


def run(
    survey_file: SurveyOrPhotographs,
    images: Annotated[
        Path | None,
        typer.Option(
            "--images", metavar="DIR", help="Folder of the photographs, in place of that of the survey file."
        ),
    ] = None,
    pitch: Pitch = None,
    camera: Calibration = None,
    camera_weighted: Weighted = False,
    out: Out = None,
    overwrite: Overwrite = False,
    jobs: Jobs = None,
    pictures_mb: PicturesMb = 15.0,
    allow_outside: AllowOutside = False,
    verbose: Verbose = False,
) -> None:
    """Run a survey from its photographs to the report.

    With a folder, its survey.toml is run, or a survey file is drafted from the photographs, written beside
    the result and run; change it there and run it again with --images PHOTOS.

    Exit code 0 with a result, remarks or none; 1 if the result cannot be depended on, the report says
    why; 2 where a person must put something right.
    """
    if survey_file.is_dir():
        if images is not None:
            raise KolinearError(f"{survey_file}: a folder of photographs needs no --images {images}")
        if (survey_file / SURVEY_FILE).is_file():
            survey_file = survey_file / SURVEY_FILE
            print(f"Running {survey_file}", file=sys.stderr)
        else:
            images = survey_file
            survey_file, out = drafted_beside(images, out, pitch, overwrite=overwrite)
            pitch = None
    if survey_file.is_file():
        refuse_pitch(pitch, survey_file)
    _run_survey(
        survey_file,
        images,
        out,
        jobs,
        allow_outside,
        verbose,
        from_photographs=True,
        camera=camera,
        weighted=camera_weighted,
        overwrite=overwrite,
        pictures_mb=pictures_mb,
    )


def adjust(
    survey_file: SurveyFile,
    camera: Calibration = None,
    camera_weighted: Weighted = False,
    out: Out = None,
    overwrite: Overwrite = False,
    allow_outside: AllowOutside = False,
    verbose: Verbose = False,
) -> None:
    """Run a survey from measured image points to the report.

    They are those of [observations] in the survey file, in place of photographs.  Exit code 0 with a
    result, remarks or none; 1 if the result cannot be depended on, the report states why; 2 where a person
    must put something right.
    """
    _run_survey(
        *(survey_file, None, out, None, allow_outside, verbose),
        from_photographs=False,
        camera=camera,
        weighted=camera_weighted,
        overwrite=overwrite,
    )


def run_file(survey_file: Path) -> Path:
    """Run a survey file, with photographs or without, and return the folder of its result, out/NAME."""
    return _run_survey(
        *(survey_file, None, None, None, False, False),
        from_photographs=None,
        camera=None,
        weighted=False,
        overwrite=False,
        pictures_mb=15.0,
    )


def _run_survey(
    survey_file: Path,
    images: Path | None,
    out: Path | None,
    jobs: int | None,
    allow_outside: bool,
    verbose: bool,
    *,
    from_photographs: bool | None,
    camera: Path | None,
    weighted: bool,
    overwrite: bool,
    pictures_mb: float = 0.0,
) -> Path:
    """Run a survey, write and print its result, return its folder; the command is for photographs or not."""
    begun = time.perf_counter()
    with loading():
        from sfm.api import colmap_writer, one_blas_thread, programs_of, read_result
        from sfm.cli.console import print_result
        from sfm.files.globs import nearest_name
        from sfm.pipeline import run_survey
        from sfm.report.figures.plot_process import plot_process
        from sfm.report.findings.findings import findings_of
        from sfm.report.log import SurveyLog
        from sfm.report.origin import Origin, refuse_other_origin
        from sfm.report.output import write_result
        from sfm.runtime.cores import cores
        from sfm.runtime.progress_bar import drawn_progress
        from sfm.survey.drafting.draft import SUFFIXES
        from sfm.survey.inputs.calibration import Calibration, read_calibrations
        from sfm.survey.inputs.photograph_list import find_photographs
        from sfm.survey.inputs.survey import survey_of_file, with_calibration
        from sfm.survey.inputs.survey_file import read_survey_file
        from sfm.survey.measuring.measured_store import MeasuredStore

    if not survey_file.exists():
        raise KolinearError(f"{survey_file}: neither a survey file nor a folder{nearest_name(survey_file)}")
    if survey_file.suffix.lower() in SUFFIXES:
        raise KolinearError(f"{survey_file}: is a photograph, not a survey file; give its folder")
    with working_on(str(survey_file)):
        described = read_survey_file(survey_file, allow_outside=allow_outside)
    if from_photographs is None:  # whichever it is
        from_photographs = described.observations is None
    if from_photographs and described.observations is not None:
        raise KolinearError(
            f"{survey_file}: it has [observations] in place of photographs: kolinear adjust {survey_file}"
        )
    if not from_photographs and described.observations is None:
        raise KolinearError(
            f"{survey_file}: it has no [observations]; with photographs: kolinear run {survey_file}"
        )
    with working_on(str(survey_file)):
        survey = survey_of_file(described)
    if camera is not None:
        with working_on(str(camera)):
            if (camera / "cameras.csv").is_file():
                calibrations = read_calibrations(camera)
            else:
                cameras = read_result(camera).estimate.cameras
                calibrations = tuple(Calibration.of_camera(one) for one in cameras)
            survey = with_calibration(survey, calibrations, str(camera), weighted=weighted)
    elif weighted:
        raise KolinearError("--camera-weighted: expected --camera RESULT with it")
    others = programs_of(survey.compare.backend, survey.compare.baseline)
    folder = _folder(survey, out)
    origin = Origin(survey_file, images or survey_file.parent)
    if not overwrite:
        refuse_other_origin(folder, origin, survey=survey.name, photographs=from_photographs)
    if from_photographs:
        find_photographs(survey, images_dir=images)  # a wrong folder is reported before anything is compiled
    compile_first()
    jobs = jobs or cores()
    workers = jobs if from_photographs else 1
    store = None
    if from_photographs:
        store = MeasuredStore.of_user()
        store.remove_old()
    with (
        working_on(str(survey_file)),
        drawn_progress() as drawn,
        one_blas_thread(),
        plot_process(jobs) as plots,
        _written(folder),
        SurveyLog(watch=drawn) as log,
    ):
        log.start(survey.name, survey_file, **origin.written(folder))
        result = run_survey(survey, images_dir=images, jobs=workers, others=others, store=store, progress=log)
        findings = findings_of(result)
        page = write_result(
            findings,
            folder,
            write_colmap=colmap_writer(result),
            finish=lambda part: log.close_into(part, findings),
            jobs=workers,
            budget_mb=pictures_mb,
            progress=log,
            plot_process=plots,
        )
    if not print_result(findings, page, seconds=time.perf_counter() - begun, verbose=verbose):
        raise SystemExit(FAILED)
    return folder


def _folder(survey: Survey, out: Path | None) -> Path:
    """Return the folder of the result, before any work is done for one that cannot be used."""
    from sfm.files.manifest import refuse_foreign_folder
    from sfm.report.output import folder_name

    out = Path("out") / folder_name(survey.name) if out is None else out
    refuse_foreign_folder(out)
    return out


@contextmanager
def _written(folder: Path) -> Iterator[None]:
    """Keep other runs from writing the same folder, and clear away what killed ones have left there."""
    from sfm.files.folder_lock import locked
    from sfm.files.whole_files import remove_leftovers

    with locked(folder.parent / f".{folder.name}.lock", folder):
        remove_leftovers(folder)
        yield
