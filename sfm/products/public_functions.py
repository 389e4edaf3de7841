"""The public functions that need more than one package, or an adapter.

All public names are listed in `sfm/__init__.pyi`. An adapter is imported by the function that needs it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial, wraps
from pathlib import Path
from typing import Any, ParamSpec

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust as adjust_network
from sfm.comparison.significance import ResultComparison, compare_results
from sfm.judgement.survey_result import SurveyResult
from sfm.judgement.verdict import judge_adjustment
from sfm.model.arguments import checked_arguments
from sfm.model.camera_file import CameraFile
from sfm.model.errors import BackendError, GeometryError, SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.remarks.remark import Remark, remark
from sfm.model.solution import Solution, solution_of
from sfm.pipeline import run_survey as run_stages
from sfm.products.inspection.features_file import read_features_file
from sfm.products.inspection.measurement import Measurement, measure_result
from sfm.runtime.installation import load_adapters
from sfm.runtime.progress import SILENT, Progress
from sfm.runtime.threads import cores
from sfm.survey.assembly import OtherPrograms
from sfm.survey.inputs.named_folders import named_folder
from sfm.survey.inputs.survey import Survey, read_survey
from sfm.survey.measuring.measured_store import MeasuredStore

load_adapters()
BACKENDS = ("colmap", "none")
Options = ParamSpec("Options")


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
    with ExitStack() as stack:
        stack.enter_context(one_blas_thread())
        watching: Progress = SILENT
        if progress is True:
            from sfm.runtime.progress_bar import drawn_progress

            watching = stack.enter_context(drawn_progress())
        elif progress is not False:
            watching = progress
        return run_stages(
            survey,
            images_dir=named_folder(survey, None if images is None else Path(images)),
            jobs=jobs or cores(),
            others=others,
            store=None if store is None else MeasuredStore(Path(store)),
            progress=watching,
        )


@checked_arguments()
def read_result(path: str | Path) -> Solution:
    """Read a result: the folder of a survey, a COLMAP model, or another known format.

    Args:
        path: folder or file.

    Raises:
        SurveyFileError: the files cannot be read; the message gives the reason, the file and the line number.

    Example:
        >>> import sfm
        >>> sfm.read_result(result_folder).point("1").xyz.shape
        (3,)
    """
    from adapters.formats.registry import read_comparable

    return read_comparable(Path(path))


@checked_arguments()
def read_cameras(path: str | Path, *, form: str | None = None) -> CameraFile:
    """Read calibrated cameras: a file of OpenCV, ROS, Kalibr, mrcal, COLMAP and others, or a result.

    Args:
        path: file or folder.
        form: name of the format, such as "ros-camera"; by the content of the file if not given.

    Returns:
        The cameras, and what is known of their precision and mounts.

    Raises:
        SurveyFileError: no cameras are in it; the message gives the reason.

    Example:
        >>> import sfm
        >>> len(sfm.read_cameras(result_folder).cameras)
        1
    """
    from adapters.formats.cameras.registry import read_cameras as read

    return read(Path(path), form)


@checked_arguments()
def write_cameras(cameras: CameraFile, path: str | Path, *, form: str) -> Path:
    """Write calibrated cameras into a new file of another program.

    Args:
        cameras: in models that the format has; `kolinear convert` adjusts them in such models.
        path: the file.
        form: name of the format, such as "opencv-camera".

    Returns:
        The path of the file.

    Raises:
        OutputError: the format does not store a camera, or the file exists or cannot be written.

    Example:
        >>> import sfm, tempfile, pathlib
        >>> camera = sfm.camera_from_values("a", "opencv", (640, 480), (0.01, 0.01), c_mm=5.0)
        >>> file = sfm.CameraFile("a", (camera,), (None,))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = sfm.write_cameras(file, pathlib.Path(folder) / "a.yaml", form="ros-camera")
        ...     sfm.read_cameras(path).cameras[0].value("fx")
        500.0
    """
    from adapters.formats.cameras.registry import write_cameras as write

    write(Path(path), form, cameras)
    return Path(path)


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


def judged(solve: Callable[Options, Adjustment]) -> Callable[Options, Adjustment]:
    """Return a function that adjusts a network and judges the result; `Adjustment.verdict` states it."""

    @wraps(solve)
    def adjust(*args: Options.args, **options: Options.kwargs) -> Adjustment:
        return judge_adjustment(solve(*args, **options), rejects=options.get("reject") != "none")

    adjust.__module__ = __name__  # where pickle finds it
    return adjust


adjust = judged(adjust_network)


@checked_arguments()
def compare(
    a: SurveyResult | Adjustment | Solution,
    b: SurveyResult | Adjustment | Solution,
    *,
    align: str = "points",
    control: tuple[str, ...] = (),
) -> ResultComparison:
    """Compare two results: differences b - a after an alignment, their standard deviations and tests.

    Args:
        a: result that stays as it is; points and photographs correspond by name.
        b: result that is aligned with a.
        align: points (all common points), cameras (projection centres), control (the named points) or none.
        control: names of the points for align = control.

    Raises:
        GeometryError: unknown alignment, too little in common for it, or nothing in common at all.

    Example:
        >>> import sfm
        >>> result = sfm.read_result(result_folder)
        >>> sfm.compare(result, result).point_difference.max() < 1e-9
        np.True_
    """
    first, second = (solution_of(result, "compare").with_joint_covariance for result in (a, b))
    return compare_results(
        first, second, align=align, control=(control,) if isinstance(control, str) else tuple(control)
    )


@checked_arguments()
def distance(result: SurveyResult | Adjustment | Solution, start: str, end: str) -> tuple[float, float]:
    """Return the distance between two points and its standard deviation, object unit.

    Args:
        result: result of a survey or an adjustment, or one read from files.
        start: name of one point.
        end: name of the other point.

    Raises:
        UnknownNameError: no point has that name.
        GeometryError: the points coincide, or their joint covariance is unknown.

    Example:
        >>> import sfm
        >>> length, sigma = sfm.distance(result, "1", "2")
        >>> bool(0 < sigma < length)
        True
    """
    solution = solution_of(result, "distance")
    between = solution.point(end).xyz - solution.point(start).xyz
    length = float(np.linalg.norm(between))
    if not length > 0:
        raise GeometryError(f"distance: points {start} and {end} are in one place")
    J = np.concatenate([-between, between]) / length
    return length, float(np.sqrt(J @ solution.covariance_of((start, end)) @ J))


@checked_arguments()
def measure(
    result: SurveyResult | Adjustment | Solution,
    features: str | Path | None = None,
    *,
    allow_outside: bool = False,
) -> Measurement:
    """Measure a result: hidden points, alignment, shapes, distances, angles and tolerances.

    Args:
        result: result of a survey or an adjustment, or one read from files.
        features: features file that lists the features to measure, see docs/measuring.md; points only if not
            given.
        allow_outside: whether the features file may name files outside its folder.

    Raises:
        KolinearError: a feature cannot be measured; the message says why.

    Example:
        >>> import sfm
        >>> len(sfm.measure(result).points.names) == len(result.points)
        True
    """
    from adapters.formats.mesh import read_mesh

    stored = solution_of(result, "measure").with_joint_covariance
    asked, paths = (
        (None, {}) if features is None else read_features_file(Path(features), allow_outside=allow_outside)
    )
    return measure_result(stored, asked, paths=paths, read_mesh=read_mesh)


def network_from_colmap(model: str | Path | Any) -> tuple[Network, Estimate]:
    """Convert a COLMAP model to a network and its solution; each image point gets a sigma of 1 px.

    Args:
        model: folder of the model, or a pycolmap.Reconstruction.

    Raises:
        SurveyFileError: the folder contains no model, or the model cannot be read.
        BackendError: pycolmap is missing, or Kolinear has no equivalent of a camera model.

    Example:
        >>> import sfm
        >>> network, estimate = sfm.network_from_colmap(colmap_model)
        >>> len(network.images) == len(estimate.position)
        True
    """
    from adapters.colmap.camera_models import network_of_scene, read_model

    if isinstance(model, str | Path):
        return read_model(Path(model))
    if not hasattr(model, "points3D"):
        raise GeometryError(
            f"network_from_colmap: model is a {type(model).__name__}, expected a folder or a "
            "pycolmap.Reconstruction"
        )
    return network_of_scene(model)


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


def colmap_writer(result: SurveyResult) -> Callable[[Path], Any] | None:
    """Return a function that writes the compared solution as a COLMAP model; None without a comparison."""
    comparison = result.comparison
    if comparison is None:
        return None
    from adapters.colmap.camera_models import write_model

    return lambda folder: write_model(folder, comparison.network, comparison.adjustment.estimate)


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit BLAS to one thread: photographs are processed in parallel, and BLAS pools would compete."""
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1, user_api="blas"):
        yield
