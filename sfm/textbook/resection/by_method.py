"""Resection by any method, chosen by its name, and the critical cylinder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sfm.model.arguments import checked_arguments
from sfm.model.conventions import FloatArray, IntArray, rotation_from_angles
from sfm.model.display import listed
from sfm.model.distributions import MARGIN
from sfm.model.errors import GeometryError
from sfm.orientation.resection.fischler_bolles import resect_fischler_bolles
from sfm.orientation.resection.least_squares import (
    LineFit,
    ResectionSolution,
    checked_points,
    choose_by_line,
    resect_least_squares,
    rotation_from_position,
    solution_of,
    thickness,
)
from sfm.orientation.resection.ransac import resect_robust
from sfm.textbook.resection.church import resect_church
from sfm.textbook.resection.dlt import DirectLinearTransformation, resect_dlt
from sfm.textbook.resection.p4p import MAX_COPLANAR_THICKNESS, MIN_POINTS, coplanar_sets, resect_p4p
from sfm.textbook.resection.unknown_noise import resect_unknown_noise
from sfm.textbook.resection.zeng_wang import resect_rampal, resect_zeng_wang

# Distance from the critical cylinder, in radii, below which the position error grows more than tenfold.
MAX_RELATIVE_DISTANCE = 0.05
START_TOLERANCE = 0.1  # tangents: tolerated error of the start of least squares
ALL_POINTS = 3  # fewest points of any method
ON_A_LINE = ("fischler-bolles", "zeng-wang")  # methods with several solutions; a fourth point decides
ON_A_CYLINDER = ("fischler-bolles", "church", "zeng-wang", "rampal")  # methods that use three points


@dataclass(frozen=True)
class Task:
    """Image and object points of one photograph, ready for any method."""

    names: tuple[str, ...]  # point names
    xy_mm: FloatArray  # measured image coordinates, mm, (n, 2)
    tangents: FloatArray  # ray tangents, interior orientation applied, (n, 2)
    points: FloatArray  # object points, object unit, (n, 3)
    c: float  # principal distance, mm
    start: FloatArray | None  # X0, Y0, Z0 [, omega, phi, kappa in rad], (3,) or (6,)
    tolerance_mm: float | None = None  # tolerance of `robust`, mm; found from the points if not given


@dataclass(frozen=True)
class ResectionResult:
    """The result of one method; None where the method gives no value. Object unit and rad."""

    method: str
    points: int  # number of points that were used
    solutions: tuple[ResectionSolution, ...]  # best first
    sigma0_mm: float | None = None  # standard deviation of an image coordinate, mm; NaN without redundancy
    redundancy: int | None = None
    dispersion: FloatArray | None = None  # covariance of X0, Y0, Z0, omega, phi, kappa, (6, 6)
    history: FloatArray | None = None  # unknowns of each iteration
    residuals_mm: FloatArray | None = None  # residuals of the image points, mm, (n, 2)
    interior: DirectLinearTransformation | None = None  # DLT result with the interior orientation
    rejected: tuple[str, ...] | None = None  # names of rejected points
    trials: int | None = None  # number of trials of the random sample consensus
    line_fit: tuple[LineFit, ...] = ()  # line fit of each solution, which identifies the true one
    warning: str = ""  # on points that hardly determine the position, those used, or signs of the distortion


@checked_arguments()
def resect(task: Task, method: str) -> ResectionResult:
    """Return the exterior orientation of a photograph by one of `resection.METHODS`.

    Args:
        task: image and object points of the photograph.
        method: one of METHODS.

    Raises:
        GeometryError: the method is unknown, or fails with these points.

    Source: the module of each method names its source; document 001, sec. 3.3.1 and 4.1.1, for the fourth
    point that decides between the solutions.
    """
    if method not in _FUNCTIONS:
        raise GeometryError(f"resect: method '{method}', expected one of {', '.join(_FUNCTIONS)}, all")
    result = _FUNCTIONS[method](task)
    solutions = tuple(
        solution for solution in result.solutions if np.isfinite(solution.rms) or method == "robust"
    )
    if not solutions:
        raise GeometryError(f"{method}: points lie behind the camera in every solution")
    lines: tuple[LineFit, ...] = ()
    if len(task.points) >= 4 and method in ON_A_LINE:
        lines = choose_by_line(solutions, task.tangents)[1]
    if method in ON_A_CYLINDER:
        result = replace(result, warning=cylinder_warning(solutions[0].position, task.points[:3]))
    return replace(result, solutions=solutions, line_fit=lines)


@checked_arguments()
def resect_by_all(task: Task) -> dict[str, ResectionResult | GeometryError]:
    """Return the result of every method, or the error with which it fails, by the name of the method.

    Without a start, Church's method starts from the solution of Fischler and Bolles.

    Args:
        task: image and object points of the photograph.

    Source: document 001, sec. 4.1 (comparison of the methods).
    """
    results: dict[str, ResectionResult | GeometryError] = {}
    for method in _FUNCTIONS:
        first = results.get("fischler-bolles")
        if task.start is None and method == "church" and isinstance(first, ResectionResult):
            started = replace(task, start=first.solutions[0].position)
        else:
            started = task
        try:
            results[method] = resect(started, method)
        except GeometryError as error:
            results[method] = error
    return results


def _closed_form(
    method: str, function: Callable[[FloatArray, FloatArray], tuple[ResectionSolution, ...]]
) -> Callable[[Task], ResectionResult]:
    return lambda task: ResectionResult(method, len(task.points), function(task.tangents, task.points))


def _p4p(task: Task) -> ResectionResult:
    """Return the result of all points, or of those in the plane by which all are imaged best."""
    checked_points("p4p", task.tangents, task.points, needed=MIN_POINTS)
    if thickness(task.points) <= MAX_COPLANAR_THICKNESS:
        return ResectionResult("p4p", len(task.points), resect_p4p(task.tangents, task.points))
    best: tuple[ResectionSolution, IntArray] | None = None
    for rows in coplanar_sets(task.points):
        try:
            (of_plane,) = resect_p4p(task.tangents[rows], task.points[rows])
        except GeometryError:  # three of them are on a line
            continue
        of_all = solution_of(of_plane.position, of_plane.rotation, task.tangents, task.points)
        if best is None or np.nan_to_num(of_all.rms, nan=np.inf) < np.nan_to_num(best[0].rms, nan=np.inf):
            best = of_all, rows
    if best is None:
        raise GeometryError(
            "p4p: no four of the points are in one plane, use robust, or dlt from six points on"
        )
    solution, rows = best
    named = listed((task.names[k] for k in rows.tolist()), most=len(rows))
    warning = f"only {named} were used, which are in one plane"
    return ResectionResult("p4p", len(rows), (solution,), warning=warning)


def _church(task: Task) -> ResectionResult:
    if task.start is None:
        raise GeometryError("church: a start position is needed (--start X,Y,Z)")
    result = resect_church(task.tangents, task.points, task.start[:3])
    return ResectionResult("church", len(task.points), (result,), history=result.history)


def _dlt(task: Task) -> ResectionResult:
    checked_points("dlt", task.xy_mm, task.points, needed=6)
    result = resect_dlt(task.xy_mm, task.points)
    solution = ResectionSolution(result.position, result.rotation, result.residuals / task.c)
    return ResectionResult(
        "dlt",
        len(task.points),
        (solution,),
        sigma0_mm=result.sigma0,
        redundancy=result.redundancy,
        interior=result,
    )


def _robust(task: Task) -> ResectionResult:
    uv, xyz = checked_points("robust", task.tangents, task.points, needed=4)
    result = (
        resect_unknown_noise(uv, xyz)
        if task.tolerance_mm is None
        else resect_robust(uv, xyz, tolerance=task.tolerance_mm / task.c)
    )
    if not result.found:
        raise GeometryError(f"robust: {result.reason}")
    return ResectionResult(
        "robust",
        len(task.points),
        (ResectionSolution(result.position, result.rotation, result.residuals[result.inliers]),),
        sigma0_mm=result.sigma0 * task.c,
        redundancy=int(2 * result.inliers.sum() - 6),
        dispersion=result.covariance,
        residuals_mm=result.residuals * task.c,
        rejected=tuple(name for name, fits in zip(task.names, result.inliers, strict=True) if not fits),
        trials=result.trials,
    )


def _least_squares(task: Task) -> ResectionResult:
    uv, xyz = checked_points("least-squares", task.tangents, task.points, needed=3)
    position, rotation = _start(task)
    result = resect_least_squares(uv, xyz, position, rotation)
    if not result.converged:
        raise GeometryError("least-squares: no convergence from this start, a nearer one is needed")
    return ResectionResult(
        "least-squares",
        len(task.points),
        (ResectionSolution(result.position, result.rotation, result.residuals),),
        sigma0_mm=result.sigma0 * task.c,
        redundancy=result.redundancy,
        dispersion=result.covariance,
        history=result.history,
        residuals_mm=result.residuals * task.c,
    )


def _start(task: Task) -> tuple[FloatArray, FloatArray]:
    """Return the start of least squares: as given, with the rotation from the rays if missing, or by P3P."""
    if task.start is None:
        if len(task.points) == ALL_POINTS:
            solution = resect_fischler_bolles(task.tangents, task.points)[0]
            return solution.position, solution.rotation
        result = resect_robust(task.tangents, task.points, tolerance=START_TOLERANCE)
        if not result.found:
            raise GeometryError(f"least-squares: no start found ({result.reason}), give one (--start)")
        return result.position, result.rotation
    if len(task.start) == 6:
        return task.start[:3], rotation_from_angles(*task.start[3:])
    return task.start, rotation_from_position(task.tangents, task.points, task.start)


_FUNCTIONS: dict[str, Callable[[Task], ResectionResult]] = {
    "fischler-bolles": _closed_form("fischler-bolles", resect_fischler_bolles),
    "p4p": _p4p,
    "church": _church,
    "zeng-wang": _closed_form("zeng-wang", resect_zeng_wang),
    "rampal": _closed_form("rampal", resect_rampal),
    "dlt": _dlt,
    "robust": _robust,
    "least-squares": _least_squares,
}


@checked_arguments(position="3", points="3 3")
def cylinder_distance(position: FloatArray, points: FloatArray) -> float:
    """Return the distance of a projection centre from the critical cylinder of three points, in radii.

    Args:
        position: projection centre, shape (3,), object unit.
        points: three object points, shape (3, 3), object unit.

    Returns:
        Distance from the axis over radius, minus 1: 0 on the cylinder, -1 on the axis, positive outside.

    Raises:
        GeometryError: the points lie on one line.

    Source: Finsterwalder (1903); Thompson (1966), Photogramm. Record 5(27): the circular cylinder through the
    three points whose axis is perpendicular to their plane.
    """
    A, B, C = np.asarray(points, dtype=float)
    b, c = B - A, C - A
    normal = np.cross(b, c)
    square = normal @ normal
    if square <= 1e-20 * (b @ b) * (c @ c):
        raise GeometryError("critical cylinder: the three points lie on one line or coincide")
    centre = (np.cross(normal, b) * (c @ c) + np.cross(c, normal) * (b @ b)) / (2 * square)
    offset = np.asarray(position) - A - centre
    across = offset - (offset @ normal) / square * normal
    return float(np.linalg.norm(across) / np.linalg.norm(centre) - 1)


def signs_warning(task: Task, opposite: Task) -> str:
    """Return a warning if the opposite signs of the distortion fit clearly better, else an empty string.

    Programs differ in whether they add or subtract distortion, and the numbers do not show it. Both choices
    have the same unknowns, so that their likelihoods decide, with the margin of other explanations.

    Args:
        task: image and object points of the photograph.
        opposite: the same, with the opposite signs of the distortion.
    """
    if np.array_equal(task.tangents, opposite.tangents):
        return ""
    try:
        rms, other = (_robust(signed).solutions[0].rms for signed in (task, opposite))
    except GeometryError:
        return ""
    lead = 2 * task.tangents.size * float(np.log(rms / max(other, np.finfo(float).tiny)))
    if not lead > MARGIN:
        return ""
    return (
        f"the opposite signs of the distortion fit {rms / other:.3g} times better, RMS "
        f"{other * task.c:.6f} in place of {rms * task.c:.6f} mm; see --opposite-signs"
    )


def cylinder_warning(position: FloatArray, points: FloatArray) -> str:
    """Return a warning if the camera is near the critical cylinder of three points, else an empty string."""
    distance = cylinder_distance(position, points)
    if abs(distance) >= MAX_RELATIVE_DISTANCE:
        return ""
    where = "outside" if distance > 0 else "inside"
    return (
        f"the camera is {abs(distance):.1%} of the radius {where} the critical cylinder of the three points, "
        "where position and rotation are weak"
    )
