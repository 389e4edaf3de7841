"""Space resection from three points by Fischler and Bolles: quartic in the ratio of two legs (P3P)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from sfm.conventions import FloatArray, IntArray
from sfm.orientation.resection.quartic import MAX_ROOTS, find_positive_roots

MAX_SOLUTIONS = 4
NEWTON_STEPS = 20
NEWTON_CONVERGED = 1e-10  # relative step; the error after it is its square
FITS = 1e-9  # misfit of the squared sides, relative to the largest, below which legs are a solution
SAME = 1e-9  # relative difference of legs below which two solutions are one
NEAR = 0.05  # relative misfit above which the second root for the third leg is not worth polishing


@dataclass(frozen=True)
class Poses:
    """Exterior orientations of a batch of triples, up to four each; unused places are NaN."""

    count: IntArray  # number of solutions of each triple, (k,)
    position: FloatArray  # projection centres X0, object unit, (k, 4, 3)
    rotation: FloatArray  # R, image to object axes, (k, 4, 3, 3)
    legs: FloatArray  # distances from the projection centre to the points, object unit, (k, 4, 3)


def resect_triples(rays: FloatArray, points: FloatArray) -> Poses:
    """Return all exterior orientations that see three object points along three rays, for many triples.

    Args:
        rays: unit vectors from the projection centre in the image frame (camera looks along -z),
            shape (k, 3, 3), one ray per row.
        points: object points, shape (k, 3, 3), object unit.

    Returns:
        Up to four solutions per triple; none where the points lie on a line or coincide.

    Source: Fischler, Bolles (1981), Comm. ACM 24(6), appendix A: sides R^2 = a^2 + b^2 - 2ab cos(theta),
    quartic G4 x^4 + ... + G0 = 0 in x = b/a; the legs are then polished by Newton's method on the
    three equations.
    """
    rays = np.ascontiguousarray(rays, dtype=float).reshape(-1, 3, 3)
    points = np.ascontiguousarray(points, dtype=float).reshape(-1, 3, 3)
    return Poses(*_resect_batch(rays, points))


def leg_quartic(rays: FloatArray, points: FloatArray) -> FloatArray:
    """Return the coefficients G4, G3, G2, G1, G0 of the quartic in x = b/a of one triple, shape (5,).

    Args:
        rays: unit vectors in the image frame, shape (3, 3).
        points: object points, shape (3, 3), object unit.
    """
    g = np.empty(5)
    sides, gaps = np.empty(3), np.empty(3)
    sides_and_gaps(np.asarray(rays, dtype=float), np.asarray(points, dtype=float), sides, gaps)
    _quartic(sides, gaps, g)
    return g[::-1].copy()


def rays_from_tangents(tangents: FloatArray) -> FloatArray:
    """Return unit vectors in the image frame of tangents u = -U/W, v = -V/W, shape (..., 3)."""
    uv = np.asarray(tangents, dtype=float)
    rays = np.concatenate([uv, -np.ones((*uv.shape[:-1], 1))], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


@njit(cache=True)
def _resect_batch(rays, points):  # type: ignore[no-untyped-def]
    k = len(rays)
    count = np.zeros(k, dtype=np.int64)
    position = np.full((k, MAX_SOLUTIONS, 3), np.nan)
    rotation = np.full((k, MAX_SOLUTIONS, 3, 3), np.nan)
    legs = np.full((k, MAX_SOLUTIONS, 3), np.nan)
    work = np.empty(32)
    for i in range(k):
        count[i] = solve_triple(rays[i], points[i], position[i], rotation[i], legs[i], work)
    return count, position, rotation, legs


@njit(cache=True)
def solve_triple(rays, points, position, rotation, legs, work):  # type: ignore[no-untyped-def]
    """Fill positions (4, 3), rotations (4, 3, 3) and legs (4, 3) of one triple; return their number.

    `work` is scratch space of at least 32 numbers, so that a batch allocates nothing.
    """
    sides, gaps, g, roots, abc = work[:3], work[3:6], work[6:11], work[11 : 11 + MAX_ROOTS], work[20:23]
    sides_and_gaps(rays, points, sides, gaps)
    if not is_triangle(sides) or not (gaps[0] > 0.0 and gaps[1] > 0.0 and gaps[2] > 0.0):
        return 0
    Rab2, Rac2 = sides[0], sides[1]
    gab, gac, gbc = gaps[0], gaps[1], gaps[2]
    _quartic(sides, gaps, g)
    found = find_positive_roots(g, roots)
    n = 0
    for k in range(found):
        x = roots[k]
        a2 = Rab2 / ((x - 1.0) ** 2 + 2.0 * x * gab)
        a = np.sqrt(a2)
        # third leg: (y - cos)^2 = cos^2 - 1 + Rac^2 / a^2, written without cancellation
        radicand = Rac2 / a2 - gac * (2.0 - gac)
        root = np.sqrt(radicand) if radicand > 0.0 else 0.0
        y_plus, y_minus = 1.0 - gac + root, 1.0 - gac - root
        misfit_plus = abs((x - y_plus) ** 2 + 2.0 * x * y_plus * gbc - sides[2] / a2) / (sides[2] / a2)
        misfit_minus = abs((x - y_minus) ** 2 + 2.0 * x * y_minus * gbc - sides[2] / a2) / (sides[2] / a2)
        for side in range(2):
            y, misfit, other = y_plus, misfit_plus, misfit_minus
            if side == 1:
                y, misfit, other = y_minus, misfit_minus, misfit_plus
            if y <= 0.0 or (misfit > other and misfit > NEAR):
                continue
            abc[0], abc[1], abc[2] = a, a * x, a * y
            if not polish_legs(abc, sides, gaps) or n == MAX_SOLUTIONS or is_known(abc, legs, n):
                continue
            legs[n, 0], legs[n, 1], legs[n, 2] = abc[0], abc[1], abc[2]
            _pose_from_legs(rays, points, abc, position[n], rotation[n])
            n += 1
    return n


@njit(cache=True)
def sides_and_gaps(rays, points, sides, gaps):  # type: ignore[no-untyped-def]
    """Squared sides Rab^2, Rac^2, Rbc^2 and 1 - cos of the face angles, exact also for small angles."""
    for k in range(3):
        i = 0 if k < 2 else 1
        j = 1 if k == 0 else 2
        side, gap = 0.0, 0.0
        for d in range(3):
            side += (points[i, d] - points[j, d]) ** 2
            gap += (rays[i, d] - rays[j, d]) ** 2
        sides[k] = side
        gaps[k] = 0.5 * gap


@njit(cache=True)
def is_triangle(sides):  # type: ignore[no-untyped-def]
    """Whether the squared sides are those of a triangle with an area (Heron)."""
    ab, ac, bc = sides[0], sides[1], sides[2]
    area16 = 2.0 * (ab * ac + ac * bc + bc * ab) - (ab * ab + ac * ac + bc * bc)
    largest = max(ab, max(ac, bc))
    return area16 > 1e-14 * largest * largest and min(ab, min(ac, bc)) > 0.0


@njit(cache=True)
def _quartic(sides, gaps, g):  # type: ignore[no-untyped-def]
    """Coefficients g[i] of x^i: G0 to G4 of Fischler and Bolles, appendix A."""
    cab, cac, cbc = 1.0 - gaps[0], 1.0 - gaps[1], 1.0 - gaps[2]
    K1, K2 = sides[2] / sides[1], sides[2] / sides[0]
    K12 = K1 * K2
    minus, plus = K12 - K1 - K2, K12 + K1 - K2
    g[4] = minus**2 - 4.0 * K12 * cbc**2
    g[3] = 4.0 * minus * K2 * (1.0 - K1) * cab + 4.0 * K1 * cbc * (
        (K12 + K2 - K1) * cac + 2.0 * K2 * cab * cbc
    )
    g[2] = (
        (2.0 * K2 * (1.0 - K1) * cab) ** 2
        + 2.0 * plus * minus
        + 4.0 * K1 * ((K1 - K2) * cbc**2 + (1.0 - K2) * K1 * cac**2 - 2.0 * K2 * (1.0 + K1) * cab * cac * cbc)
    )
    g[1] = 4.0 * plus * K2 * (1.0 - K1) * cab + 4.0 * K1 * (
        (K12 - K1 + K2) * cac * cbc + 2.0 * K12 * cab * cac**2
    )
    g[0] = plus**2 - 4.0 * K1 * K12 * cac**2


@njit(cache=True)
def polish_legs(abc, sides, gaps):  # type: ignore[no-untyped-def]
    """Newton's method on R^2 = (a - b)^2 + 2 a b (1 - cos); returns whether the legs fit."""
    largest = max(sides[0], max(sides[1], sides[2]))
    gab, gac, gbc = gaps[0], gaps[1], gaps[2]
    misfit = 1e300
    for _ in range(NEWTON_STEPS):
        a, b, c = abc[0], abc[1], abc[2]
        f0 = (a - b) ** 2 + 2.0 * a * b * gab - sides[0]
        f1 = (a - c) ** 2 + 2.0 * a * c * gac - sides[1]
        f2 = (b - c) ** 2 + 2.0 * b * c * gbc - sides[2]
        misfit = abs(f0) + abs(f1) + abs(f2)
        # rows: (p0, q0, 0), (p1, 0, q1), (0, p2, q2)
        p0, q0 = 2.0 * (a - b + b * gab), 2.0 * (b - a + a * gab)
        p1, q1 = 2.0 * (a - c + c * gac), 2.0 * (c - a + a * gac)
        p2, q2 = 2.0 * (b - c + c * gbc), 2.0 * (c - b + b * gbc)
        det = -p0 * q1 * p2 - q0 * p1 * q2
        if det == 0.0:
            break
        da = (-f0 * q1 * p2 - q0 * f1 * q2 + q0 * q1 * f2) / det
        db = (-p0 * q1 * f2 + p0 * f1 * q2 - f0 * p1 * q2) / det
        dc = (-p0 * f1 * p2 - q0 * p1 * f2 + f0 * p1 * p2) / det
        # a step beyond half of a leg has left the neighbourhood of the root
        longest = max(abs(da) / a, max(abs(db) / b, abs(dc) / c))
        if longest > 0.5:
            da, db, dc = da * 0.5 / longest, db * 0.5 / longest, dc * 0.5 / longest
        abc[0], abc[1], abc[2] = a - da, b - db, c - dc
        if longest < NEWTON_CONVERGED:
            break
    return misfit < FITS * largest


@njit(cache=True)
def is_known(abc, legs, n):  # type: ignore[no-untyped-def]
    for i in range(n):
        if abs(abc[0] - legs[i, 0]) + abs(abc[1] - legs[i, 1]) + abs(abc[2] - legs[i, 2]) < SAME * (
            abc[0] + abc[1] + abc[2]
        ):
            return True
    return False


@njit(cache=True)
def _pose_from_legs(rays, points, legs, position, rotation):  # type: ignore[no-untyped-def]
    """R from the orthonormal frames of the two triangles, X0 from their centres."""
    ax, ay, az = legs[0] * rays[0, 0], legs[0] * rays[0, 1], legs[0] * rays[0, 2]
    bx, by, bz = legs[1] * rays[1, 0], legs[1] * rays[1, 1], legs[1] * rays[1, 2]
    cx, cy, cz = legs[2] * rays[2, 0], legs[2] * rays[2, 1], legs[2] * rays[2, 2]
    i0, i1, i2, j0, j1, j2, k0, k1, k2 = _frame(bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az)
    x0, x1, x2, y0, y1, y2, z0, z1, z2 = _frame(
        points[1, 0] - points[0, 0],
        points[1, 1] - points[0, 1],
        points[1, 2] - points[0, 2],
        points[2, 0] - points[0, 0],
        points[2, 1] - points[0, 1],
        points[2, 2] - points[0, 2],
    )
    rotation[0, 0] = x0 * i0 + y0 * j0 + z0 * k0
    rotation[0, 1] = x0 * i1 + y0 * j1 + z0 * k1
    rotation[0, 2] = x0 * i2 + y0 * j2 + z0 * k2
    rotation[1, 0] = x1 * i0 + y1 * j0 + z1 * k0
    rotation[1, 1] = x1 * i1 + y1 * j1 + z1 * k1
    rotation[1, 2] = x1 * i2 + y1 * j2 + z1 * k2
    rotation[2, 0] = x2 * i0 + y2 * j0 + z2 * k0
    rotation[2, 1] = x2 * i1 + y2 * j1 + z2 * k1
    rotation[2, 2] = x2 * i2 + y2 * j2 + z2 * k2
    mx, my, mz = (ax + bx + cx) / 3.0, (ay + by + cy) / 3.0, (az + bz + cz) / 3.0
    for d in range(3):
        centre = (points[0, d] + points[1, d] + points[2, d]) / 3.0
        position[d] = centre - (rotation[d, 0] * mx + rotation[d, 1] * my + rotation[d, 2] * mz)


@njit(cache=True)
def _frame(px, py, pz, qx, qy, qz):  # type: ignore[no-untyped-def]
    """Right-handed orthonormal frame: x along p, z along p x q."""
    zx, zy, zz = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
    z = 1.0 / np.sqrt(zx * zx + zy * zy + zz * zz)
    p = 1.0 / np.sqrt(px * px + py * py + pz * pz)
    px, py, pz, zx, zy, zz = px * p, py * p, pz * p, zx * z, zy * z, zz * z
    return px, py, pz, zy * pz - zz * py, zz * px - zx * pz, zx * py - zy * px, zx, zy, zz
