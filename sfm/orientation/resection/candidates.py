"""One exterior orientation found by a resection, with the figures that separate good ones from bad ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.arguments import checked_arguments
from sfm.conventions import FloatArray
from sfm.display import counted
from sfm.errors import GeometryError

COINCIDENT = 1e-9  # of the extent of the points
COLLINEAR = 1e-7  # second singular value over the first
MIN_TO_CHOOSE = 4  # three points are fitted by every solution


@dataclass(frozen=True)
class ResectionSolution:
    """An exterior orientation and how it fits the image points it was tested on."""

    position: FloatArray  # projection centre X0, object unit, (3,)
    rotation: FloatArray  # R, image to object axes, (3, 3)
    residuals: FloatArray  # v = computed - measured, tangents; NaN for points behind the camera, (n, 2)

    @property
    def rms(self) -> float:
        """Root mean square residual per coordinate, tangents; inf if a point is behind the camera."""
        if not np.isfinite(self.residuals).all():
            return np.inf
        return float(np.sqrt(np.mean(self.residuals**2)))


def solution_of(
    position: FloatArray, rotation: FloatArray, tangents: FloatArray, points: FloatArray
) -> ResectionSolution:
    """Return an exterior orientation with its residuals at the given points.

    Args:
        position: projection centre X0, shape (3,), object unit.
        rotation: R, image to object axes, shape (3, 3).
        tangents: u = -U/W, v = -V/W of the measured rays, shape (n, 2).
        points: object points, shape (n, 3), object unit.
    """
    return ResectionSolution(position, rotation, tangents_of(position, rotation, points) - tangents)


@dataclass(frozen=True)
class LineFit:
    """Straight line computed = slope measured + intercept through the image coordinates of a solution."""

    slope: float  # 1 for the true solution
    intercept: float  # 0 for the true solution, tangents
    scatter: float  # root mean square distance from the line, tangents
    departure: float  # root mean square distance from the line of slope 1 through 0, tangents


@checked_arguments(tangents="n 2")
def choose_by_line(
    solutions: tuple[ResectionSolution, ...], tangents: FloatArray
) -> tuple[ResectionSolution, tuple[LineFit, ...]]:
    """Return the solution whose computed image coordinates lie nearest to the line computed = measured.

    Args:
        solutions: of a resection from three points, with residuals at all points.
        tangents: measured image points, shape (n, 2), n >= 4.

    Returns:
        The chosen solution, and the line of every solution in the order given.

    Raises:
        GeometryError: fewer than four points, others than those of the solutions, or no solution that has all
            of them in front of the camera.

    Source: document 001, secs. 4.2.1 and 5.1: the unique solution of the P3P by fitting a line through at
    least four points. The document names the principle without formulas; this is our reading of it.
    """
    if len(tangents) < MIN_TO_CHOOSE:
        raise GeometryError(
            f"line fitting: {counted(len(tangents), 'point')}, at least {MIN_TO_CHOOSE} are needed"
        )
    if any(len(solution.residuals) != len(tangents) for solution in solutions):
        raise GeometryError(
            f"line fitting: {counted(len(tangents), 'image point')}, needed those that the solutions have "
            "residuals of"
        )
    lines = tuple(_fit(tangents.ravel(), (tangents + solution.residuals).ravel()) for solution in solutions)
    departures = [line.departure for line in lines]
    if not np.isfinite(departures).any():
        raise GeometryError("line fitting: points lie behind the camera in every solution")
    return solutions[int(np.argmin(departures))], lines


def _fit(measured: FloatArray, computed: FloatArray) -> LineFit:
    """Regression of computed on measured coordinates; infinite if a point is behind the camera."""
    if not np.isfinite(computed).all():
        return LineFit(np.nan, np.nan, np.inf, np.inf)
    slope, intercept = np.polyfit(measured, computed, 1)
    scatter = np.sqrt(np.mean((computed - slope * measured - intercept) ** 2))
    departure = np.sqrt(np.mean((computed - measured) ** 2))
    return LineFit(float(slope), float(intercept), float(scatter), float(departure))


@checked_arguments(position="3", rotation="3 3", points="n 3")
def tangents_of(position: FloatArray, rotation: FloatArray, points: FloatArray) -> FloatArray:
    """Return the tangents of object points by the collinearity equations.

    Args:
        position: projection centre X0, shape (3,), object unit.
        rotation: R, image to object axes, shape (3, 3).
        points: object points, shape (n, 3), object unit.

    Returns:
        u = -U/W, v = -V/W, shape (n, 2); NaN behind the camera.

    Source: Kraus (2007), sec. 4.2.1; document 000, eqs. of the central perspective, with c = 1.
    """
    UVW = (np.asarray(points, dtype=float) - position) @ rotation
    W = np.where(UVW[:, 2] < 0, UVW[:, 2], np.nan)
    return np.asarray(-UVW[:, :2] / W[:, None], dtype=float)


def rotation_from_position(tangents: FloatArray, points: FloatArray, position: FloatArray) -> FloatArray:
    """Return R that turns the measured rays best into the directions from the position to the points.

    Args:
        tangents: u = -U/W, v = -V/W of the measured rays, shape (n, 2), n >= 2.
        points: object points, shape (n, 3), object unit.
        position: projection centre, shape (3,).

    Source: Wahba's problem (1965) by the singular value decomposition of Markley (1988).
    """
    rays = np.concatenate([tangents, -np.ones((len(tangents), 1))], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    directions = points - position
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    U, _, Vt = np.linalg.svd(directions.T @ rays)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


def ordered(solutions: list[ResectionSolution]) -> tuple[ResectionSolution, ...]:
    """Return solutions with the smallest residuals first."""
    return tuple(sorted(solutions, key=lambda solution: solution.rms))


def checked_points(
    method: str, tangents: FloatArray, points: FloatArray, *, needed: int
) -> tuple[FloatArray, FloatArray]:
    """Return image and object points as arrays, or raise with the reason why a method cannot use them.

    Raises:
        GeometryError: too few points, unequal numbers, values that are not finite, coincident points, or
            all points on one line.
    """
    uv = np.ascontiguousarray(tangents, dtype=float).reshape(-1, 2)
    xyz = np.ascontiguousarray(points, dtype=float).reshape(-1, 3)
    n = len(xyz)
    if len(uv) != n:
        raise GeometryError(
            f"{method}: {counted(len(uv), 'image point')} and {counted(n, 'object point')}, "
            "one each is needed"
        )
    if n < needed:
        raise GeometryError(f"{method}: {counted(n, 'point')}, at least {needed} are needed")
    if not (np.isfinite(uv).all() and np.isfinite(xyz).all()):
        raise GeometryError(f"{method}: a coordinate is not a finite number")
    first = xyz[:needed]
    spread = np.linalg.norm(xyz - xyz.mean(axis=0), axis=1).max()
    distance = np.linalg.norm(first[:, None] - first[None], axis=2) + np.eye(len(first)) * spread
    if spread == 0 or distance.min() <= COINCIDENT * spread:
        i, j = np.unravel_index(int(np.argmin(distance)), distance.shape)
        raise GeometryError(f"{method}: points {min(i, j) + 1} and {max(i, j) + 1} coincide")
    for name, values in (("object", xyz), ("image", uv)):
        # those that the method starts from, and all of them
        for some in (values[: max(needed, 3)], values):
            s = np.linalg.svd(some - some.mean(axis=0), compute_uv=False)
            if s[1] <= COLLINEAR * s[0]:
                raise GeometryError(f"{method}: the {len(some)} {name} points lie on one line or coincide")
    return uv, xyz


def thickness(points: FloatArray) -> float:
    """Return the extent of object points across their plane over the largest one; 0 if all coincide."""
    s = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(s[2] / s[0]) if s[0] > 0 else 0.0
