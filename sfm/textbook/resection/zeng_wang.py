"""Space resection by Zeng and Wang, and by Rampal.

Both find the distances from the camera to three points, then the position from the distances. Zeng and Wang
solve a quartic and find all solutions. Rampal iterates the angles of the triangles that
the camera forms with the points.
"""

from __future__ import annotations

from itertools import combinations, islice

import numpy as np

from sfm.model.arguments import checked_arguments
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.errors import GeometryError
from sfm.orientation.resection.fischler_bolles import (
    MAX_DOUBLE_ROOT_MISFIT,
    MAX_SOLUTIONS,
    Poses,
    is_known,
    is_triangle,
    polish_legs,
    rays_from_tangents,
    squared_sides,
)
from sfm.orientation.resection.least_squares import (
    ResectionSolution,
    checked_points,
    rotation_from_position,
    solution_of,
    sort_solutions,
)
from sfm.runtime.compiling import compiled
from sfm.runtime.small_algebra import MAX_ROOTS, find_positive_roots

MAX_STEPS = 100
MAX_LAST_STEP = 1e-14  # rad
MARGIN = 0.9  # largest step, as a fraction of the step to a flat triangle
SPAN = 0.02  # smallest relative singular value of a direction that the points span well
MAX_SAME_DISTANCE = 1e-6  # largest distance of equal positions, in extents of the points
MAX_TRIPLES = 20
MIN_POINTS = 3


@checked_arguments(tangents="k 2", points="n 3")
def resect_zeng_wang(tangents: FloatArray, points: FloatArray) -> tuple[ResectionSolution, ...]:
    """Return the exterior orientations by Zeng and Wang; the best fit of all points comes first.

    Args:
        tangents: u = -U/W, v = -V/W of the measured rays, shape (n, 2), n >= 3.
        points: object points, shape (n, 3), object unit. The first three give the solutions; the order of
            the solutions has a meaning only with four or more points.

    Raises:
        GeometryError: there are fewer than three points, they lie on one line, or there is no solution.

    Source: Zeng, Wang (1992), A general solution of a closed-form space resection, PE&RS 58(3);
    document 001, eqs. 2.64-2.93.
    """
    uv, xyz = checked_points("zeng-wang", tangents, points, needed=MIN_POINTS)
    poses = resect_triples_zeng_wang(rays_from_tangents(uv[:MIN_POINTS])[None], xyz[None, :MIN_POINTS])
    solutions = [
        solution_of(poses.position[0, s], poses.rotation[0, s], uv, xyz) for s in range(poses.count[0])
    ]
    if not solutions:
        raise GeometryError("zeng-wang: no camera sees the first three points at these angles")
    return sort_solutions(solutions)


def resect_triples_zeng_wang(rays: FloatArray, points: FloatArray) -> Poses:
    """Return all exterior orientations of many triples of points by Zeng and Wang.

    Args:
        rays: unit vectors in the image frame, shape (k, 3, 3).
        points: object points, shape (k, 3, 3), object unit.
    """
    rays = np.ascontiguousarray(rays, dtype=float).reshape(-1, 3, 3)
    points = np.ascontiguousarray(points, dtype=float).reshape(-1, 3, 3)
    return Poses(*_resect_batch(rays, points))


@checked_arguments(rays="3 3", points="3 3")
def distance_quartic(rays: FloatArray, points: FloatArray) -> FloatArray:
    """Return the coefficients N1 to N5 of the quartic in n = R3/R1 of one triple, shape (5,).

    Args:
        rays: unit vectors in the image frame, shape (3, 3).
        points: object points, shape (3, 3), object unit.

    Source: Zeng, Wang (1992); document 001, eq. 2.72.
    """
    ab, ac, bc = squared_sides(np.asarray(points, dtype=float))
    gab, gac, gbc = squared_sides(np.asarray(rays, dtype=float))
    return np.array(_quartic(ab, ac, bc, gab / 2, gac / 2, gbc / 2)[::-1])


@checked_arguments(rays="3 3")
def direction_test(rays: FloatArray) -> float:
    """Return the sign of T = 1S . (12 x 13), which follows from the sense of rotation of the image points.

    Args:
        rays: unit vectors in the image frame, shape (3, 3).

    Returns:
        +1 or -1.

    Source: document 001, eq. 2.82, which takes the image points clockwise, so that T > 0. Here they can have
    any order.
    """
    return float(_turning_sign(np.ascontiguousarray(rays)))


@checked_arguments(points="3 3", distances="3")
def trilaterate(points: FloatArray, distances: FloatArray, T: float) -> FloatArray:
    """Return the point at three distances from three points, on the side of their plane that T gives.

    Args:
        points: object points, shape (3, 3), object unit.
        distances: distances of the new point from the three points, shape (3,), object unit.
        T: sign of the direction test, +1 or -1.

    Returns:
        The new point, shape (3,), object unit; in the plane of the three points if the distances are too
        short.

    Source: Awange, Grafarend (2004), after eqs. 2.79-2.81 of document 001. Their elimination divides by
    differences of Y and Z, which may be zero. The axes of the triangle (x along 12, z along 12 x 13) avoid
    this.
    """
    S = np.empty(3)
    _fill_position(np.ascontiguousarray(points), np.ascontiguousarray(distances), float(T), S)
    return S


@checked_arguments(rays="3 3", points="3 3", position="3")
def pope_hinsken(rays: FloatArray, points: FloatArray, position: FloatArray) -> FloatArray:
    """Return R from the unit vectors to the points in object and image axes, by the parameters d, a, b, c.

    The differences of corresponding vectors are perpendicular to the rotation axis g. So g is the cross
    product of two differences. The vectors are the three rays and their cross products. The pair with the
    longest product gives g, so rays near the axis do no harm.

    Args:
        rays: unit vectors in the image frame, shape (3, 3).
        points: object points, shape (3, 3), object unit.
        position: projection centre, shape (3,), object unit.

    Returns:
        R, image to object axes, shape (3, 3).

    Source: Hinsken (1988), PE&RS 54(7), and Zeng, Wang (1992); document 001, eqs. 2.83-2.93. The sign of
    the angle, which eq. 2.91 leaves open, is taken from g . (image x object).
    """
    rotation = np.empty((3, 3))
    rays, points = np.ascontiguousarray(rays), np.ascontiguousarray(points)
    _fill_rotation(rays, points, np.ascontiguousarray(position), rotation)
    return rotation


@compiled
def _resect_batch(
    rays: FloatArray, points: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Return number, positions, rotations and distances of the solutions of every triple."""
    k = len(rays)
    count = np.zeros(k, dtype=np.int64)
    position = np.full((k, MAX_SOLUTIONS, 3), np.nan)
    rotation = np.full((k, MAX_SOLUTIONS, 3, 3), np.nan)
    distances = np.full((k, MAX_SOLUTIONS, 3), np.nan)
    for i in range(k):
        count[i] = _solve(rays[i], points[i], position[i], rotation[i], distances[i])
    return count, position, rotation, distances


@compiled
def _solve(
    rays: FloatArray, points: FloatArray, position: FloatArray, rotation: FloatArray, distances: FloatArray
) -> int:
    """Fill positions (4, 3), rotations (4, 3, 3) and distances (4, 3) of one triple; return their number."""
    roots, R123, S = np.empty(MAX_ROOTS), np.empty(3), np.empty(3)
    L3, L2, L1 = squared_sides(points)
    g12, g13, g23 = squared_sides(rays)
    g12, g13, g23 = 0.5 * g12, 0.5 * g13, 0.5 * g23  # 1 - cos, exact also for small angles
    if not is_triangle(L3, L2, L1) or not (g12 > 0.0 and g13 > 0.0 and g23 > 0.0):
        return 0
    N5, N4, N3, N2, N1 = _quartic(L3, L2, L1, g12, g13, g23)
    n = 0
    for k in range(find_positive_roots(N5, N4, N3, N2, N1, roots)):
        x = roots[k]
        p2 = L2 / ((x - 1.0) ** 2 + 2.0 * x * g13)  # R1^2, from side 13
        p = np.sqrt(p2)
        # R2 from side 12 (eq. 2.77 with L3, which the document misprints as L2); side 23 picks the root
        radicand = L3 / p2 - g12 * (2.0 - g12)
        root = np.sqrt(radicand) if radicand > 0.0 else 0.0
        high, low = 1.0 - g12 + root, 1.0 - g12 - root
        off_high = abs(((high - x) ** 2 + 2.0 * high * x * g23) * p2 / L1 - 1.0)
        off_low = abs(((low - x) ** 2 + 2.0 * low * x * g23) * p2 / L1 - 1.0)
        for side in range(2):
            m, off, other = (high, off_high, off_low) if side == 0 else (low, off_low, off_high)
            if m <= 0.0 or (off > other and off > MAX_DOUBLE_ROOT_MISFIT):
                continue
            fits, R1, R2, R3 = polish_legs(p, m * p, x * p, L3, L2, L1, g12, g13, g23)
            if not fits or n == MAX_SOLUTIONS or is_known(R1, R2, R3, distances, n):
                continue
            R123[0], R123[1], R123[2] = R1, R2, R3
            _fill_position(points, R123, _turning_sign(rays), S)
            distances[n] = R123
            position[n] = S
            _fill_rotation(rays, points, S, rotation[n])
            n += 1
    return n


@compiled
def _quartic(
    L3: float, L2: float, L1: float, g12: float, g13: float, g23: float
) -> tuple[float, float, float, float, float]:
    """Return N5 to N1, the coefficients of 1 to n^4, from A^2 - D1 A B + B^2 C = 0.

    L1 to L3 are squared sides, and g12, g13, g23 are 1 - cos of the angles. The difference of the equations
    of sides 12 and 23 gives m = R2/R1 = A/B. With q = n^2 - F1 n + 1, A = (K32 - K12) q + n^2 - 1,
    B = E1 n - D1 and C = 1 - K32 q.
    """
    D1, F1, E1 = 2.0 * (1.0 - g12), 2.0 * (1.0 - g13), 2.0 * (1.0 - g23)
    K12, K32 = L1 / L2, L3 / L2
    K = K32 - K12
    a2, a1, a0 = K + 1.0, -K * F1, K - 1.0
    c2, c1, c0 = -K32, K32 * F1, 1.0 - K32
    N1 = a2 * a2 + E1 * E1 * c2
    N2 = 2.0 * a2 * a1 - D1 * E1 * a2 + E1 * E1 * c1 - 2.0 * E1 * D1 * c2
    N3 = a1 * a1 + 2.0 * a2 * a0 - D1 * (E1 * a1 - D1 * a2) + E1 * E1 * c0 - 2.0 * E1 * D1 * c1 + D1 * D1 * c2
    N4 = 2.0 * a1 * a0 - D1 * (E1 * a0 - D1 * a1) - 2.0 * E1 * D1 * c0 + D1 * D1 * c1
    N5 = a0 * a0 + D1 * D1 * a0 + D1 * D1 * c0
    return N5, N4, N3, N2, N1


@compiled
def _turning_sign(rays: FloatArray) -> float:
    """Return the result of `direction_test`."""
    det = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        det += rays[0, i] * (rays[1, j] * rays[2, k] - rays[1, k] * rays[2, j])
    return -1.0 if det > 0.0 else 1.0


@compiled
def _fill_position(points: FloatArray, distances: FloatArray, T: float, S: FloatArray) -> None:
    """Fill S, the new point of `trilaterate`."""
    e, f, g, q = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for d in range(3):
        e[d] = points[1, d] - points[0, d]
        q[d] = points[2, d] - points[0, d]
    length = np.sqrt(e[0] ** 2 + e[1] ** 2 + e[2] ** 2)
    for d in range(3):
        e[d] /= length
    for d in range(3):
        i, j = (d + 1) % 3, (d + 2) % 3
        g[d] = e[i] * q[j] - e[j] * q[i]
    height = np.sqrt(g[0] ** 2 + g[1] ** 2 + g[2] ** 2)
    for d in range(3):
        g[d] /= height
    for d in range(3):
        i, j = (d + 1) % 3, (d + 2) % 3
        f[d] = g[i] * e[j] - g[j] * e[i]
    q_e = e[0] * q[0] + e[1] * q[1] + e[2] * q[2]
    R1, R2, R3 = distances[0], distances[1], distances[2]
    x = 0.5 * ((R1 - R2) * (R1 + R2) / length + length)
    y = 0.5 * ((R1 - R3) * (R1 + R3) + q_e * q_e + height * height - 2.0 * q_e * x) / height
    z2 = R1 * R1 - x * x - y * y
    z = T * np.sqrt(z2) if z2 > 0.0 else 0.0
    for d in range(3):
        S[d] = points[0, d] + x * e[d] + y * f[d] + z * g[d]


@compiled
def _fill_rotation(rays: FloatArray, points: FloatArray, S: FloatArray, rotation: FloatArray) -> None:
    """Fill the rotation of `pope_hinsken`."""
    p, l, diff = np.empty((6, 3)), np.empty((6, 3)), np.empty((6, 3))
    for i in range(3):
        norm = np.sqrt((points[i, 0] - S[0]) ** 2 + (points[i, 1] - S[1]) ** 2 + (points[i, 2] - S[2]) ** 2)
        for d in range(3):
            p[i, d] = rays[i, d]
            l[i, d] = (points[i, d] - S[d]) / norm
    for i in range(3):
        j = (i + 1) % 3
        for d in range(3):
            m, n = (d + 1) % 3, (d + 2) % 3
            p[3 + i, d] = p[i, m] * p[j, n] - p[i, n] * p[j, m]
            l[3 + i, d] = l[i, m] * l[j, n] - l[i, n] * l[j, m]
        np_, nl = np.sqrt((p[3 + i] ** 2).sum()), np.sqrt((l[3 + i] ** 2).sum())
        p[3 + i] /= np_
        l[3 + i] /= nl
    for i in range(6):
        diff[i] = p[i] - l[i]
    best, g, h = 0.0, np.zeros(3), np.empty(3)
    for i in range(6):
        for j in range(i):
            square = 0.0
            for d in range(3):
                m, n = (d + 1) % 3, (d + 2) % 3
                h[d] = diff[i, m] * diff[j, n] - diff[i, n] * diff[j, m]
                square += h[d] * h[d]
            if square > best:
                best = square
                g[:] = h
    if best == 0.0:  # all vectors equal: no rotation
        rotation[:] = 0.0
        rotation[0, 0] = rotation[1, 1] = rotation[2, 2] = 1.0
        return
    g /= np.sqrt(best)
    # angle about g from image to object vectors, from the sums of sines and cosines over all vectors
    sine, cosine = 0.0, 0.0
    for i in range(6):
        along_p = g[0] * p[i, 0] + g[1] * p[i, 1] + g[2] * p[i, 2]
        along_l = g[0] * l[i, 0] + g[1] * l[i, 1] + g[2] * l[i, 2]
        cosine += p[i, 0] * l[i, 0] + p[i, 1] * l[i, 1] + p[i, 2] * l[i, 2] - along_p * along_l
        for d in range(3):
            m, n = (d + 1) % 3, (d + 2) % 3
            sine += g[d] * (p[i, m] * l[i, n] - p[i, n] * l[i, m])
    half = 0.5 * np.arctan2(sine, cosine)
    d0, s = np.cos(half), np.sin(half)
    a, b, c = s * g[0], s * g[1], s * g[2]
    rotation[0, 0] = d0 * d0 + a * a - b * b - c * c
    rotation[0, 1] = 2.0 * (a * b - c * d0)
    rotation[0, 2] = 2.0 * (a * c + b * d0)
    rotation[1, 0] = 2.0 * (a * b + c * d0)
    rotation[1, 1] = d0 * d0 - a * a + b * b - c * c
    rotation[1, 2] = 2.0 * (b * c - a * d0)
    rotation[2, 0] = 2.0 * (a * c - b * d0)
    rotation[2, 1] = 2.0 * (b * c + a * d0)
    rotation[2, 2] = d0 * d0 - a * a - b * b + c * c


@checked_arguments(tangents="k 2", points="n 3")
def resect_rampal(tangents: FloatArray, points: FloatArray) -> tuple[ResectionSolution, ...]:
    """Return the exterior orientation by Rampal's method, which needs no approximate values.

    Args:
        tangents: u = -U/W, v = -V/W of the measured rays, shape (n, 2), n >= 3. Three rays give the
            distances; further points contribute equations for the position.
        points: object points, shape (n, 3), object unit.

    Returns:
        The solutions that the iteration reaches from the angles of the photograph, that is, from an image
        plane parallel to the object. Three points give one solution. More points give the different solutions
        of their triples, the best fit of all points first.

    Raises:
        GeometryError: there are fewer than three points, they lie on one line, or nothing converges.

    Source: Rampal (1979), A closed solution for space resection, PE&RS 45(9); document 001, eqs. 2.32-2.43.
    The camera forms a triangle with each of the sides 12, 23, 31. The angles at the points are those of the
    photograph plus or minus alpha, beta, gamma. Each distance is equal in two triangles, which gives three
    equations. They are linearised and iterated.
    """
    uv, xyz = checked_points("rampal", tangents, points, needed=MIN_POINTS)
    solutions: list[ResectionSolution] = []
    failure = GeometryError("rampal: no solution")
    for triple in islice(combinations(range(len(xyz)), 3), MAX_TRIPLES):
        order = [*triple, *(i for i in range(len(xyz)) if i not in triple)]
        try:
            # from the distances of the first three points and of all others
            rays, X = rays_from_tangents(uv[order]), xyz[order]
            S = _distances(uv[order[:MIN_POINTS]], rays[:MIN_POINTS], X[:MIN_POINTS])
            for i in range(MIN_POINTS, len(X)):
                S = np.append(S, _further_distance(S, rays, X, i))
            position = _position(S, rays, X)
        except GeometryError as error:
            failure = error
            continue
        solution = solution_of(position, rotation_from_position(uv, xyz, position), uv, xyz)
        size = np.linalg.norm(xyz - xyz.mean(axis=0), axis=1).max()
        if all(
            np.linalg.norm(solution.position - other.position) > MAX_SAME_DISTANCE * size
            for other in solutions
        ):
            solutions.append(solution)
    if not solutions:
        raise failure
    return sort_solutions(solutions)


def _distances(uv: FloatArray, rays: FloatArray, X: FloatArray) -> FloatArray:
    """Return S1, S2, S3 by eqs. 2.32-2.39; row t of an array refers to the triangle of points t and t + 1."""
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
        # the distance of the first point of a side is opposite the angle at the second, and vice versa
        near, far = scale * np.sin(second), scale * np.sin(first)
        # S of point j[t] is `far` of triangle t and `near` of triangle j[t]
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
            "relative to the points, use fischler-bolles"
        )
    return np.asarray(S)


def _further_distance(S: FloatArray, rays: FloatArray, X: FloatArray, i: int) -> float:
    """Return the distance of point i from triangles with points 1 and 2, by the root that fits both best."""
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
    """Return the projection centre from distances by linear differences of spheres, eqs. 2.40-2.43.

    For coplanar points (three points always are), the linear equations do not determine the component normal
    to the plane. It comes from the spheres of the first three points.
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
