"""Space resection by Church, which makes the face angles of image and object pyramid equal by iteration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.model.arguments import checked_arguments
from sfm.model.conventions import FloatArray
from sfm.model.errors import GeometryError
from sfm.orientation.resection.fischler_bolles import rays_from_tangents
from sfm.orientation.resection.least_squares import ResectionSolution, checked_points, solution_of

MIN_POINTS = 3
MAX_STEPS = 100
MAX_LAST_STEP = 1e-12  # last step relative to the distance of the points
HALVINGS = 10
NO_PYRAMID = 1e-12  # determinant of three unit vectors below which they count as coplanar
_I, _J = np.array([0, 1, 2]), np.array([1, 2, 0])


@dataclass(frozen=True)
class ChurchResection(ResectionSolution):
    """The solution of Church's iteration, with the positions of every step."""

    history: FloatArray  # projection centre before the first and after every step, object unit, (s + 1, 3)


@checked_arguments(tangents="k 2", points="n 3", position="3")
def resect_church(tangents: FloatArray, points: FloatArray, position: FloatArray) -> ChurchResection:
    """Return the exterior orientation to which Church's method converges from a start position.

    Args:
        tangents: u = -U/W, v = -V/W of the measured rays, shape (n, 2), n >= 3; the first three give the
            solution, the others only residuals.
        points: object points, shape (n, 3), object unit.
        position: approximate projection centre, shape (3,), object unit.

    Raises:
        GeometryError: there are fewer than three points, they lie on one line, the start coincides with a
            point, or the iteration does not converge.

    Source: Church (1945) as given in document 001, eqs. 2.47-2.63: cos AOB = cos aOb for the three pairs,
    linearised for the position (I, J, A, B, C). The equations are solved as a system, and a step is halved
    while it makes the angles worse. The rotation is the product of the two matrices of direction cosines.
    """
    uv, xyz = checked_points("church", tangents, points, needed=MIN_POINTS)
    X = xyz[:MIN_POINTS]
    lmn = rays_from_tangents(uv[:MIN_POINTS])
    k = np.sum(lmn[_I] * lmn[_J], axis=1)
    position = np.array(position, dtype=float).reshape(3)
    history = [position]
    misfit = np.abs(k - _cosines(X, position)).sum()
    for _ in range(MAX_STEPS):
        step = _step(X, position, k)
        factor = 1.0
        for _half in range(HALVINGS):
            new = np.abs(k - _cosines(X, position + factor * step)).sum()
            if new <= misfit or new < 1e-15:
                break
            factor /= 2
        position = position + factor * step
        misfit = new
        history.append(position)
        distance = np.linalg.norm(X - position, axis=1).mean()
        if np.linalg.norm(factor * step) <= MAX_LAST_STEP * distance:
            break
        if not np.isfinite(position).all() or distance > 1e12 * np.linalg.norm(X - X.mean(axis=0)):
            raise GeometryError("church: the position diverges from this start, a nearer one is needed")
    if misfit > 1e-9:
        raise GeometryError(
            f"church: no convergence in {MAX_STEPS} steps from this start, a nearer one is needed"
        )
    LMN = _directions(X, position)
    if abs(np.linalg.det(lmn)) < NO_PYRAMID:
        raise GeometryError("church: the three rays lie in one plane, direction cosines give no rotation")
    # R l = L for the three rays; the nearest rotation removes rounding errors
    U, _, Vt = np.linalg.svd(LMN.T @ np.linalg.inv(lmn.T))
    if np.linalg.det(U @ Vt) < 0:
        raise GeometryError(
            "church: the iteration ended on the mirror side of the points, start on the other side"
        )
    solution = solution_of(position, U @ Vt, uv, xyz)
    return ChurchResection(solution.position, solution.rotation, solution.residuals, np.array(history))


def _directions(X: FloatArray, position: FloatArray) -> FloatArray:
    """Return the direction cosines L, M, N of the rays to the object points, eq. 2.51, one ray per row."""
    D = np.linalg.norm(X - position, axis=1, keepdims=True)
    if D.min() == 0:
        raise GeometryError("church: the start coincides with an object point")
    return np.asarray((X - position) / D)


def _cosines(X: FloatArray, position: FloatArray) -> FloatArray:
    LMN = _directions(X, position)
    return np.asarray(np.sum(LMN[_I] * LMN[_J], axis=1))


def _step(X: FloatArray, position: FloatArray, k: FloatArray) -> FloatArray:
    """Return the correction of the position, eqs. 2.52-2.58 with K instead of k in I and J.

    d cos / d X0 = L_i (K/D_i - 1/D_j) + L_j (K/D_j - 1/D_i).
    """
    D = np.linalg.norm(X - position, axis=1)
    L = _directions(X, position)
    K = np.sum(L[_I] * L[_J], axis=1)
    along_i, along_j = K / D[_I] - 1 / D[_J], K / D[_J] - 1 / D[_I]
    ABC = L[_I] * along_i[:, None] + L[_J] * along_j[:, None]
    try:
        return np.asarray(np.linalg.solve(ABC, k - K))
    except np.linalg.LinAlgError:
        raise GeometryError(
            "church: the start lies on the danger cylinder or in the plane of the points"
        ) from None
