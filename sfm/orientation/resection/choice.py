"""Which of several resection solutions is the true one: the line of computed against measured coordinates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.conventions import FloatArray
from sfm.errors import GeometryError
from sfm.orientation.resection.solution import Solution

MIN_POINTS = 4  # three points are fitted by every solution


@dataclass(frozen=True)
class LineFit:
    """Straight line computed = slope measured + intercept through the image coordinates of a solution."""

    slope: float  # 1 for the true solution
    intercept: float  # 0 for the true solution, tangents
    scatter: float  # root mean square distance from the line, tangents
    departure: float  # root mean square distance from the line of slope 1 through 0, tangents


def choose_by_line(
    solutions: tuple[Solution, ...], tangents: FloatArray
) -> tuple[Solution, tuple[LineFit, ...]]:
    """Return the solution whose computed image coordinates lie nearest to the line computed = measured.

    Args:
        solutions: of a resection from three points, with residuals at all points.
        tangents: measured image points, shape (n, 2), n >= 4.

    Returns:
        The chosen solution, and the line of every solution in the order given.

    Raises:
        GeometryError: fewer than four points, or no solution that has all of them in front of the camera.

    Source: document 001, secs. 4.2.1 and 5.1: the unique solution of the P3P by fitting a line through at
    least four points. The document names the principle without formulas; this is our reading of it.
    """
    if len(tangents) < MIN_POINTS:
        raise GeometryError(f"line fitting: {len(tangents)} points, at least {MIN_POINTS} are needed")
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
