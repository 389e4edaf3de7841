"""Results and cameras: read, written, adjusted, compared and measured.

All public names are listed in `sfm/__init__.pyi`. An adapter is imported by the function that needs it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
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
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.solution import Solution, solution_of
from sfm.products.inspection.features_file import read_features_file
from sfm.products.inspection.measurement import Measurement, measure_result

Options = ParamSpec("Options")


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
