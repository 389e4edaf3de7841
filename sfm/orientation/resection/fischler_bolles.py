"""Space resection from three points by Fischler and Bolles (P3P), by a quartic in the ratio of two legs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.model.arguments import checked_arguments
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.errors import GeometryError
from sfm.orientation.resection.least_squares import (
    ResectionSolution,
    checked_points,
    solution_of,
    sort_solutions,
)
from sfm.runtime.compiling import compiled_fused
from sfm.runtime.small_algebra import MAX_ROOTS, find_positive_roots

MAX_SOLUTIONS = 4
WORK = MAX_ROOTS  # size of the scratch space
FLAT = 1e-14  # 16 area^2 over the fourth power of the largest side below which a triangle is a line
NEWTON_STEPS = 20
NEWTON_CONVERGED = 1e-10  # relative step; the error after it is its square
FITS = 1e-9  # misfit of the squared sides, relative to the largest, below which legs are a solution
MAX_SAME_DIFFERENCE = 1e-9  # relative difference of legs below which two solutions are the same
# Relative misfit above which the second root for the third leg is not a separate solution.
MAX_DOUBLE_ROOT_MISFIT = 1e-6


@dataclass(frozen=True)
class Poses:
    """Exterior orientations of a batch of triples, up to four each; unused entries are NaN."""

    count: IntArray  # number of solutions of each triple, (k,)
    position: FloatArray  # projection centres X0, object unit, (k, 4, 3)
    rotation: FloatArray  # R, image to object axes, (k, 4, 3, 3)
    legs: FloatArray  # distances from the projection centre to the points, object unit, (k, 4, 3)


@checked_arguments(tangents="k 2", points="n 3")
def resect_fischler_bolles(tangents: FloatArray, points: FloatArray) -> tuple[ResectionSolution, ...]:
    """Return the exterior orientations from the first three points, best fit to all points first.

    Args:
        tangents: u = -U/W, v = -V/W of the measured rays, shape (n, 2), n >= 3.
        points: object points, shape (n, 3), object unit.

    Returns:
        One to four solutions; with at least four points their order is meaningful (see also
        `choose_by_line`).

    Raises:
        GeometryError: fewer than three points, collinear or coincident points, or no solution.

    Source: as for `resect_triples`.
    """
    uv, xyz = checked_points("fischler-bolles", tangents, points, needed=3)
    poses = resect_triples(rays_from_tangents(uv[:3])[None], xyz[None, :3])
    solutions = [
        solution_of(poses.position[0, s], poses.rotation[0, s], uv, xyz) for s in range(poses.count[0])
    ]
    if not solutions:
        raise GeometryError("fischler-bolles: no camera sees the first three points under these angles")
    return sort_solutions(solutions)


def resect_triples(rays: FloatArray, points: FloatArray) -> Poses:
    """Return all exterior orientations that see three object points along three rays, for many triples.

    Args:
        rays: unit vectors from the projection centre in the image frame (camera looks along -z),
            shape (k, 3, 3), one ray per row.
        points: object points, shape (k, 3, 3), object unit.

    Returns:
        Up to four solutions per triple; none if the points are collinear or coincide.

    Source: Fischler, Bolles (1981), Comm. ACM 24(6), appendix A: sides R^2 = a^2 + b^2 - 2ab cos(theta),
    quartic G4 x^4 + ... + G0 = 0 in x = b/a. The legs are then polished by Newton's method on the three
    equations.
    """
    rays = np.ascontiguousarray(rays, dtype=float).reshape(-1, 3, 3)
    points = np.ascontiguousarray(points, dtype=float).reshape(-1, 3, 3)
    return Poses(*_resect_batch(rays, points))


@checked_arguments(rays="3 3", points="3 3")
def leg_quartic(rays: FloatArray, points: FloatArray) -> FloatArray:
    """Return the coefficients G4, G3, G2, G1, G0 of the quartic in x = b/a of one triple, shape (5,).

    Args:
        rays: unit vectors in the image frame, shape (3, 3).
        points: object points, shape (3, 3), object unit.

    Source: Fischler, Bolles (1981), appendix A; document 001, sec. 2.3.4.
    """
    ab, ac, bc = squared_sides(np.asarray(points, dtype=float))
    gab, gac, gbc = squared_sides(np.asarray(rays, dtype=float))
    return np.array(_quartic(ab, ac, bc, 1 - gab / 2, 1 - gac / 2, 1 - gbc / 2)[::-1])


def rays_from_tangents(tangents: FloatArray) -> FloatArray:
    """Return unit vectors in the image frame from tangents u = -U/W, v = -V/W, shape (..., 3)."""
    uv = np.asarray(tangents, dtype=float)
    rays = np.concatenate([uv, -np.ones((*uv.shape[:-1], 1))], axis=-1)
    return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))


@compiled_fused
def _resect_batch(
    rays: FloatArray, points: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Return number, positions, rotations and legs of the solutions of every triple."""
    k = len(rays)
    count = np.empty(k, dtype=np.int64)
    position = np.empty((k, MAX_SOLUTIONS, 3))
    rotation = np.empty((k, MAX_SOLUTIONS, 3, 3))
    legs = np.empty((k, MAX_SOLUTIONS, 3))
    work = np.empty(WORK)
    for i in range(k):
        n = solve_triple(rays[i], points[i], position[i], rotation[i], legs[i], work)
        count[i] = n
        position[i, n:] = np.nan
        rotation[i, n:] = np.nan
        legs[i, n:] = np.nan
    return count, position, rotation, legs


@compiled_fused
def solve_triple(
    rays: FloatArray,
    points: FloatArray,
    position: FloatArray,
    rotation: FloatArray,
    legs: FloatArray,
    work: FloatArray,
) -> int:
    """Fill positions (4, 3), rotations (4, 3, 3) and legs (4, 3) of one triple; return their number.

    Args:
        rays: unit vectors in the image frame, shape (3, 3).
        points: object points, shape (3, 3), object unit.
        position: receives the projection centres, (4, 3).
        rotation: receives the rotations, (4, 3, 3).
        legs: receives the distances to the points, (4, 3).
        work: scratch space of WORK numbers, so that a batch needs no allocation.
    """
    Rab2, Rac2, Rbc2 = squared_sides(points)
    gab, gac, gbc = squared_sides(rays)
    gab, gac, gbc = 0.5 * gab, 0.5 * gac, 0.5 * gbc  # 1 - cos of the face angles, exact also if small
    if not is_triangle(Rab2, Rac2, Rbc2) or not (gab > 0.0 and gac > 0.0 and gbc > 0.0):
        return 0
    g0, g1, g2, g3, g4 = _quartic(Rab2, Rac2, Rbc2, 1.0 - gab, 1.0 - gac, 1.0 - gbc)
    n = 0
    for k in range(find_positive_roots(g0, g1, g2, g3, g4, work)):
        x = work[k]
        a2 = Rab2 / ((x - 1.0) ** 2 + 2.0 * x * gab)
        # third leg: (y - cos)^2 = cos^2 - 1 + Rac^2 / a^2, written without cancellation
        radicand = Rac2 / a2 - gac * (2.0 - gac)
        root = np.sqrt(radicand) if radicand > 0.0 else 0.0
        y_plus, y_minus = 1.0 - gac + root, 1.0 - gac - root
        misfit_plus = abs(((x - y_plus) ** 2 + 2.0 * x * y_plus * gbc) * a2 - Rbc2)
        misfit_minus = abs(((x - y_minus) ** 2 + 2.0 * x * y_minus * gbc) * a2 - Rbc2)
        for y, misfit, other in (
            (y_plus, misfit_plus, misfit_minus),
            (y_minus, misfit_minus, misfit_plus),
        ):
            if y <= 0.0 or (misfit > other and misfit > MAX_DOUBLE_ROOT_MISFIT * Rbc2):
                continue
            a = np.sqrt(a2)
            fits, a, b, c = polish_legs(a, a * x, a * y, Rab2, Rac2, Rbc2, gab, gac, gbc)
            if not fits or n == MAX_SOLUTIONS or is_known(a, b, c, legs, n):
                continue
            legs[n, 0], legs[n, 1], legs[n, 2] = a, b, c
            _pose_from_legs(rays, points, a, b, c, position[n], rotation[n])
            n += 1
    return n


@compiled_fused
def squared_sides(p: FloatArray) -> tuple[float, float, float]:
    """Return the squared distances 12, 13 and 23 of three points, one per row."""
    ab = (p[0, 0] - p[1, 0]) ** 2 + (p[0, 1] - p[1, 1]) ** 2 + (p[0, 2] - p[1, 2]) ** 2
    ac = (p[0, 0] - p[2, 0]) ** 2 + (p[0, 1] - p[2, 1]) ** 2 + (p[0, 2] - p[2, 2]) ** 2
    bc = (p[1, 0] - p[2, 0]) ** 2 + (p[1, 1] - p[2, 1]) ** 2 + (p[1, 2] - p[2, 2]) ** 2
    return ab, ac, bc


@compiled_fused
def is_triangle(ab: float, ac: float, bc: float) -> bool:
    """Return whether squared sides form a triangle with an area (Heron)."""
    area16 = 2.0 * (ab * ac + ac * bc + bc * ab) - (ab * ab + ac * ac + bc * bc)
    largest = max(ab, max(ac, bc))
    return area16 > FLAT * largest * largest and min(ab, min(ac, bc)) > 0.0


@compiled_fused
def _quartic(
    Rab2: float, Rac2: float, Rbc2: float, cab: float, cac: float, cbc: float
) -> tuple[float, float, float, float, float]:
    """Return G0 to G4 (appendix A) from squared sides and cosines of the face angles."""
    K1, K2 = Rbc2 / Rac2, Rbc2 / Rab2
    K12 = K1 * K2
    minus, plus = K12 - K1 - K2, K12 + K1 - K2
    G4 = minus**2 - 4.0 * K12 * cbc**2
    G3 = 4.0 * minus * K2 * (1.0 - K1) * cab + 4.0 * K1 * cbc * ((K12 + K2 - K1) * cac + 2.0 * K2 * cab * cbc)
    G2 = (
        (2.0 * K2 * (1.0 - K1) * cab) ** 2
        + 2.0 * plus * minus
        + 4.0 * K1 * ((K1 - K2) * cbc**2 + (1.0 - K2) * K1 * cac**2 - 2.0 * K2 * (1.0 + K1) * cab * cac * cbc)
    )
    G1 = 4.0 * plus * K2 * (1.0 - K1) * cab + 4.0 * K1 * (
        (K12 - K1 + K2) * cac * cbc + 2.0 * K12 * cab * cac**2
    )
    G0 = plus**2 - 4.0 * K1 * K12 * cac**2
    return G0, G1, G2, G3, G4


@compiled_fused
def polish_legs(
    a: float,
    b: float,
    c: float,
    Rab2: float,
    Rac2: float,
    Rbc2: float,
    gab: float,
    gac: float,
    gbc: float,
) -> tuple[bool, float, float, float]:
    """Improve legs by Newton's method on R^2 = (a - b)^2 + 2 a b (1 - cos).

    Args:
        a: distance to the first point.
        b: distance to the second point.
        c: distance to the third point.
        Rab2: squared side between the first and second point.
        Rac2: squared side between the first and third point.
        Rbc2: squared side between the second and third point.
        gab: 1 - cos of the angle between the first and second ray.
        gac: 1 - cos of the angle between the first and third ray.
        gbc: 1 - cos of the angle between the second and third ray.

    Returns:
        Whether the legs fit the sides, and the legs.
    """
    misfit = np.inf
    for _ in range(NEWTON_STEPS):
        f0 = (a - b) ** 2 + 2.0 * a * b * gab - Rab2
        f1 = (a - c) ** 2 + 2.0 * a * c * gac - Rac2
        f2 = (b - c) ** 2 + 2.0 * b * c * gbc - Rbc2
        misfit = abs(f0) + abs(f1) + abs(f2)
        # rows: (p0, q0, 0), (p1, 0, q1), (0, p2, q2)
        p0, q0 = 2.0 * (a - b + b * gab), 2.0 * (b - a + a * gab)
        p1, q1 = 2.0 * (a - c + c * gac), 2.0 * (c - a + a * gac)
        p2, q2 = 2.0 * (b - c + c * gbc), 2.0 * (c - b + b * gbc)
        det = -p0 * q1 * p2 - q0 * p1 * q2
        if det == 0.0:
            break
        inverse = 1.0 / det
        da = (-f0 * q1 * p2 - q0 * f1 * q2 + q0 * q1 * f2) * inverse
        db = (-p0 * q1 * f2 + p0 * f1 * q2 - f0 * p1 * q2) * inverse
        dc = (-p0 * f1 * p2 - q0 * p1 * f2 + f0 * p1 * p2) * inverse
        # a step longer than half a leg leaves the neighbourhood of the root
        while abs(da) > 0.5 * a or abs(db) > 0.5 * b or abs(dc) > 0.5 * c:
            da, db, dc = 0.5 * da, 0.5 * db, 0.5 * dc
        a, b, c = a - da, b - db, c - dc
        if abs(da) + abs(db) + abs(dc) < NEWTON_CONVERGED * min(a, min(b, c)):
            break
    return misfit < FITS * max(Rab2, max(Rac2, Rbc2)), a, b, c


@compiled_fused
def is_known(a: float, b: float, c: float, legs: FloatArray, n: int) -> bool:
    """Return whether legs equal those of one of the first n solutions."""
    for i in range(n):
        if abs(a - legs[i, 0]) + abs(b - legs[i, 1]) + abs(c - legs[i, 2]) < MAX_SAME_DIFFERENCE * (
            a + b + c
        ):
            return True
    return False


@compiled_fused
def _pose_from_legs(
    rays: FloatArray,
    points: FloatArray,
    a: float,
    b: float,
    c: float,
    position: FloatArray,
    rotation: FloatArray,
) -> None:
    """Fill R from the orthonormal frames of the two triangles, and X0 from their centres."""
    ax, ay, az = a * rays[0, 0], a * rays[0, 1], a * rays[0, 2]
    bx, by, bz = b * rays[1, 0], b * rays[1, 1], b * rays[1, 2]
    cx, cy, cz = c * rays[2, 0], c * rays[2, 1], c * rays[2, 2]
    in_image = _frame(bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az)
    mx, my, mz = (ax + bx + cx) / 3.0, (ay + by + cy) / 3.0, (az + bz + cz) / 3.0
    in_object = _frame(
        points[1, 0] - points[0, 0],
        points[1, 1] - points[0, 1],
        points[1, 2] - points[0, 2],
        points[2, 0] - points[0, 0],
        points[2, 1] - points[0, 1],
        points[2, 2] - points[0, 2],
    )
    for d in range(3):
        for e in range(3):
            rotation[d, e] = (
                in_object[d] * in_image[e]
                + in_object[3 + d] * in_image[3 + e]
                + in_object[6 + d] * in_image[6 + e]
            )
    for d in range(3):
        centre = (points[0, d] + points[1, d] + points[2, d]) / 3.0
        position[d] = centre - (rotation[d, 0] * mx + rotation[d, 1] * my + rotation[d, 2] * mz)


@compiled_fused
def _frame(
    px: float, py: float, pz: float, qx: float, qy: float, qz: float
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Return the right-handed axes x along p, y, and z along p x q, three numbers each."""
    zx, zy, zz = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
    z = 1.0 / np.sqrt(zx * zx + zy * zy + zz * zz)
    p = 1.0 / np.sqrt(px * px + py * py + pz * pz)
    px, py, pz, zx, zy, zz = px * p, py * p, pz * p, zx * z, zy * z, zz * z
    return px, py, pz, zy * pz - zz * py, zz * px - zx * pz, zx * py - zy * px, zx, zy, zz
