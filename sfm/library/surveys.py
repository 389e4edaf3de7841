"""Surveys, from the photographs to the written result, and the programs that they are compared with.

An adapter is imported by the function that needs it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path

from sfm.adjustment.result import Adjustment
from sfm.judgement.survey_result import SurveyResult
from sfm.model.arguments import checked_arguments
from sfm.model.conventions import AnyArray
from sfm.model.errors import BackendError, SurveyFileError
from sfm.model.remarks.remark import Remark, remark
from sfm.model.solution import Solution, solution_of
from sfm.pipeline import run_survey as run_stages
from sfm.runtime.executor import current_blocking
from sfm.runtime.forecast import RunHistory, forecast
from sfm.runtime.progress import SILENT, Progress
from sfm.runtime.threads import cores, one_blas_thread
from sfm.survey.assembly import OtherPrograms
from sfm.survey.inputs.measurements import NO_PHOTOGRAPHS, find_photographs, work_of
from sfm.survey.inputs.named_folders import named_folder
from sfm.survey.inputs.sources import reads_photographs
from sfm.survey.inputs.survey import Survey, read_survey
from sfm.survey.measuring.measured_store import MeasuredStore

BACKENDS = ("colmap", "none")


@checked_arguments()
def run_survey(
    survey: Survey | str | Path,
    *,
    images: str | Path | None = None,
    compare_with: str | None = None,
    jobs: int | None = None,
    store: str | Path | None = None,
    progress: bool | Progress = False,
) -> SurveyResult:
    """Run a survey from its photographs, or from the image points that it gives in place of them.

    Args:
        survey: settings and given data, or the survey file.
        images: folder of the photographs; the folder named in the survey if not given.
        compare_with: "colmap" (its adjuster on the same network) or "none"; the choice of the survey if
            not given.
        jobs: number of photographs measured at the same time; the number of cores if not given.
        store: folder that keeps the measurements, so that no photograph is measured twice.
        progress: True draws a progress bar in the terminal; an object receives stages and photographs.

    Raises:
        KolinearError: the survey cannot be run; the message states the remedy.

    Example:
        >>> import sfm
        >>> survey = sfm.read_survey(observed_survey)
        >>> sfm.run_survey(survey, compare_with="none").adjustment.converged
        True
    """
    if compare_with not in (*BACKENDS, None):
        raise SurveyFileError(f"compare_with '{compare_with}', expected one of {', '.join(BACKENDS)}")
    if not isinstance(survey, Survey):
        survey = read_survey(survey)
    others = programs_of(
        compare_with or survey.compare.backend, "none" if compare_with == "none" else survey.compare.baseline
    )
    images_dir = named_folder(survey, None if images is None else Path(images))
    with ExitStack() as stack:
        stack.enter_context(one_blas_thread())
        watching: Progress = SILENT
        files = (
            find_photographs(survey, images_dir=images_dir) if reads_photographs(survey) else NO_PHOTOGRAPHS
        )
        expected = forecast(work_of(survey, files), RunHistory.of_user().read(), without=("report",))
        if current_blocking() is None:  # else other computers may adjust it
            expected.refuse()
        if progress is True:
            from sfm.runtime.progress_bar import drawn_progress

            watching = drawn = stack.enter_context(drawn_progress())
            if sentence := expected.announced():
                print(sentence, file=sys.stderr)
            drawn.countdown.expected = expected.seconds
        elif progress is not False:
            watching = progress
        return run_stages(
            survey,
            images_dir=images_dir,
            jobs=jobs or cores(),
            others=others,
            store=None if store is None else MeasuredStore(Path(store)),
            progress=watching,
        )


@checked_arguments()
def write_result(
    result: SurveyResult | Adjustment | Solution,
    folder: str | Path,
    *,
    jobs: int | None = None,
    pictures_mb: float = 15.0,
) -> Path:
    """Write a result into a folder, whole or not at all.

    Args:
        result: a survey is written as tables, figures and the report; any other solution as tables only.
        folder: an earlier result in it is replaced; any other content is an error.
        jobs: number of photographs drawn at the same time; the number of cores if not given.
        pictures_mb: limit for the pictures inside report.html, 10^6 bytes; the rest goes to pictures/.

    Returns:
        The path of report.html, or of points.csv if there is no report.

    Raises:
        OutputError: the folder cannot be written, or contains anything but an earlier result.

    Example:
        >>> import sfm
        >>> sfm.write_result(result, result_folder).name
        'report.html'
    """
    if not isinstance(result, SurveyResult):
        from adapters.formats.content import Content
        from adapters.formats.registry import write_content

        write_content(
            Path(folder), "tables", Content(solution_of(result, "write_result").with_joint_covariance)
        )
        return Path(folder) / "points.csv"
    from sfm.report.findings import findings_of
    from sfm.report.output import write_result as write

    with one_blas_thread():
        return write(
            findings_of(result),
            Path(folder),
            write_colmap=colmap_writer(result),
            jobs=jobs or cores(),
            budget_mb=pictures_mb,
        )


def programs_of(backend: str, baseline: str, *, threads: int = -1) -> OtherPrograms:
    """Return the programs that a survey is compared with; their library is imported only here.

    Args:
        backend: colmap or none.
        baseline: mapper or none.
        threads: number of threads of the mapper; -1 for the number of cores.
    """
    others = OtherPrograms()
    if backend == "colmap":
        from adapters.colmap.adjuster import adjust_with_covariance

        others = replace(others, adjuster=adjust_with_covariance)
    if baseline == "mapper":
        from adapters.colmap.mapper import map_photographs

        others = replace(others, mapper=partial(map_photographs, threads=threads))
    return others


def sensor_widths(note: Callable[[Remark], None]) -> Callable[[str, str], float | None]:
    """Return a function that looks up the sensor width of a camera, mm, by make and model in COLMAP's list.

    Args:
        note: receives a remark on each camera that could not be looked up, for example without pycolmap.
    """
    from adapters.colmap.mapper import sensor_width_mm

    def width(make: str, model: str) -> float | None:
        try:
            return sensor_width_mm(make, model)
        except BackendError as error:
            note(remark("camera_assumed", cameras=f"{make} {model}", reason=str(error)))
            return None

    return width


def colmap_writer(result: SurveyResult) -> Callable[[Path, AnyArray | None], None] | None:
    """Return a function that writes the compared solution as a COLMAP model; None without a comparison.

    The function receives a folder, and the colours of the points of the result, uint8, (n, 3), if known.
    """
    comparison = result.comparison
    if comparison is None:
        return None
    from adapters.colmap.camera_models import write_model

    network = comparison.network
    numbers = {name: j for j, name in enumerate(result.adjustment.network.points)}
    order = [numbers[name] for name in network.points]

    def write(folder: Path, colours: AnyArray | None) -> None:
        own = None if colours is None else colours[order]
        write_model(folder, network, comparison.adjustment.estimate, colours=own)

    return write
