"""Space resection by Rampal: corrections of the face angles, linearised, then linear equations."""

from __future__ import annotations

from itertools import combinations, islice

import numpy as np

from sfm.arguments import checked_arguments
from sfm.conventions import FloatArray
from sfm.errors import GeometryError
from sfm.orientation.resection.candidates import (
    ResectionSolution,
    checked_points,
    ordered,
    rotation_from_position,
    solution_of,
)
from sfm.orientation.resection.fischler_bolles import rays_from_tangents
from sfm.textbook.resection.zeng_wang import direction_test, trilaterate

MIN_POINTS = 3
MAX_STEPS = 100
MAX_LAST_STEP = 1e-14  # rad
MARGIN = 0.9  # part of the way to a flat triangle that one step may go
SPAN = 0.02  # singular value, relative, from which on the points span a direction well
MAX_SAME_DISTANCE = 1e-6  # distance of two positions, in extents of the points, below which they are one
MAX_TRIPLES = 20


@checked_arguments(tangents="k 2", points="n 3")
def resect_rampal(tangents: FloatArray, points: FloatArray) -> tuple[ResectionSolution, ...]:
    """Return the exterior orientation by Rampal, which needs no approximate values.

    Args:
        tangents: u = -U/W, v = -V/W of the measured rays, shape (n, 2), n >= 3. Three of them give
            the distances, further points take part in the equations of the position.
        points: object points, shape (n, 3), object unit.

    Returns:
        The solutions reached from the angles of the photograph, that is from an image plane parallel to the
        object: one from three points; from more points one for each triple as far as they differ, the
        one that fits all points best first.

    Raises:
        GeometryError: fewer than three points, points on one line, or no convergence.

    Source: Rampal (1979), A closed solution for space resection, PE&RS 45(9); document 001, eqs. 2.32-2.43.
    In the triangles of the camera with the sides 12, 23, 31 the angles at the points are those of the
    photograph plus and minus alpha, beta, gamma; equal distances from two triangles give three equations,
    linearised and repeated.
    """
    uv, xyz = checked_points("rampal", tangents, points, needed=MIN_POINTS)
    found: list[ResectionSolution] = []
    failure = GeometryError("rampal: no solution")
    for triple in islice(combinations(range(len(xyz)), 3), MAX_TRIPLES):
        order = [*triple, *(i for i in range(len(xyz)) if i not in triple)]
        try:
            position = _position_from(uv[order], xyz[order])
        except GeometryError as error:
            failure = error
            continue
        solution = solution_of(position, rotation_from_position(uv, xyz, position), uv, xyz)
        size = np.linalg.norm(xyz - xyz.mean(axis=0), axis=1).max()
        if all(np.linalg.norm(solution.position - one.position) > MAX_SAME_DISTANCE * size for one in found):
            found.append(solution)
    if not found:
        raise failure
    return ordered(found)


def _position_from(uv: FloatArray, xyz: FloatArray) -> FloatArray:
    """Projection centre with the distances of the first three points."""
    rays = rays_from_tangents(uv)
    S = _distances(uv[:MIN_POINTS], rays[:MIN_POINTS], xyz[:MIN_POINTS])
    for i in range(MIN_POINTS, len(xyz)):
        S = np.append(S, _further_distance(S, rays, xyz, i))
    return _position(S, rays, xyz)


def _distances(uv: FloatArray, rays: FloatArray, X: FloatArray) -> FloatArray:
    """S1, S2, S3 by eqs. 2.32-2.39; row t of an array belongs to the triangle of points t and t + 1."""
    j = [1, 2, 0]
    D = np.linalg.norm(X - X[j], axis=1)
    theta = 2 * np.arcsin(np.clip(np.linalg.norm(rays - rays[j], axis=1) / 2, 0, 1))
    if theta.min() < 1e-12:
        raise GeometryError("rampal: two image points coincide")
    s = np.sqrt(1 + np.sum(uv**2, axis=1))
    # angle at the first point of each side in the photograph, from the vectors of the triangle
    side, to_camera = np.c_[uv[j] - uv, np.zeros(3)], -np.c_[uv, -np.ones(3)]
    cosine = np.sum(side * to_camera, axis=1) / (np.linalg.norm(side, axis=1) * s)
    first = np.arccos(np.clip(cosine, -1, 1))
    scale = D / np.sin(theta)
    for _ in range(MAX_STEPS):
        second = np.pi - theta - first
        # distance of the first point of a side is opposite to the angle at the second, and vice versa
        near, far = scale * np.sin(second), scale * np.sin(first)
        # S of point j[t]: far of triangle t equals near of triangle j[t]
        misfit = far - near[j]
        A = np.diag(scale * np.cos(first))
        A[[0, 1, 2], j] += scale[j] * np.cos(second[j])
        try:
            step = -np.linalg.solve(A, misfit)
        except np.linalg.LinAlgError:
            raise GeometryError("rampal: the equations of the angles are singular at these points") from None
        room = np.where(step > 0, second, first)
        factor = min(1.0, float(np.min(MARGIN * room / np.maximum(np.abs(step), 1e-300))))
        first = first + factor * step
        if np.abs(step).max() < MAX_LAST_STEP:
            break
    S = scale * np.sin(np.pi - theta - first)
    sides = np.sqrt((S - S[j]) ** 2 + 4 * S * S[j] * np.sin(theta / 2) ** 2)
    if not np.allclose(sides, D, rtol=1e-9):
        raise GeometryError(
            f"rampal: the angles did not converge in {MAX_STEPS} steps; the photograph is tilted too much "
            "against the points, use fischler-bolles"
        )
    return np.asarray(S)


def _further_distance(S: FloatArray, rays: FloatArray, X: FloatArray, i: int) -> float:
    """Distance of point i from the triangles with points 1 and 2: of two roots the one that fits both."""
    best, misfit = np.nan, np.inf
    for a, b in ((0, 1), (1, 0)):
        cosine = rays[a] @ rays[i]
        radicand = np.sum((X[a] - X[i]) ** 2) - S[a] ** 2 * (1 - cosine**2)
        root = np.sqrt(max(radicand, 0.0))
        for length in (S[a] * cosine + root, S[a] * cosine - root):
            other = S[b] ** 2 + length**2 - 2 * S[b] * length * (rays[b] @ rays[i])
            off = abs(other - np.sum((X[b] - X[i]) ** 2))
            if length > 0 and off < misfit:
                best, misfit = length, off
    return float(best)


def _position(S: FloatArray, rays: FloatArray, X: FloatArray) -> FloatArray:
    """Projection centre from distances: differences of the spheres are linear in it, eqs. 2.40-2.43.

    Across the plane of coplanar points (and of three) the linear equations determine nothing; there the
    spheres of the first three points close the solution.
    """
    closing = trilaterate(X[:3], S[:3], direction_test(rays[:3]))
    centre = X.mean(axis=0)
    P = X - centre
    # |X0|^2 - 2 P . X0 + |P|^2 = S^2 minus its mean over the points
    rhs = np.sum(P**2, axis=1) - S**2
    U, s, Vt = np.linalg.svd(2 * P, full_matrices=False)
    spanned = s > SPAN * s[0]
    along = (U.T @ (rhs - rhs.mean())) / np.where(spanned, s, 1.0)
    components = np.where(spanned, along, Vt @ (closing - centre))
    return np.asarray(centre + components @ Vt)
