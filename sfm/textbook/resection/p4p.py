"""Space resection from coplanar points by Fischler and Bolles (P4P).

A collineation maps the object plane to the image. Its two vanishing lines give the position over the plane.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from itertools import combinations

import numpy as np

from sfm.model.arguments import checked_arguments
from sfm.model.conventions import FloatArray, IntArray, skew
from sfm.model.errors import GeometryError
from sfm.orientation.resection.least_squares import (
    ResectionSolution,
    checked_points,
    rotation_from_position,
    solution_of,
    thickness,
)

MIN_POINTS = 4
# Thickness up to which points count as coplanar; the residuals show the resulting error.
MAX_COPLANAR_THICKNESS = 0.01
# |(a1, a2)| over |a3| of the vanishing line below which image and object plane are parallel.
MAX_PARALLEL_RATIO = 1e-12
# The same for some of the points: what belongs to a plane is not known from that, but from their image.
MAX_THICKNESS_OF_SOME = 0.002
MOST_PLANES = 2000  # of points in space that are tried, all of 23 points


@checked_arguments(tangents="k 2", points="n 3")
def resect_p4p(tangents: FloatArray, points: FloatArray) -> tuple[ResectionSolution, ...]:
    """Return the exterior orientation from four or more points in one plane.

    Args:
        tangents: u = -U/W, v = -V/W of the measured rays, shape (n, 2), n >= 4.
        points: coplanar object points, shape (n, 3), object unit; no three of four may lie on a line.

    Returns:
        The only solution. It is exact for four exact points. Errors of the image points are not adjusted,
        because the collineation has two more parameters than the exterior orientation.

    Raises:
        GeometryError: there are fewer than four points, they are not coplanar, or three of four lie on a
            line.

    Source: Fischler, Bolles (1981), appendix B; document 001, eqs. 2.19-2.30, with f = 1 (tangents).
    """
    uv, xyz = checked_points("p4p", tangents, points, needed=MIN_POINTS)
    if thickness(xyz) > MAX_COPLANAR_THICKNESS:
        raise GeometryError(
            f"p4p: the points are not in one plane (thickness {thickness(xyz):.2g} of their extent), "
            "use robust, or dlt from six points on"
        )
    origin = xyz.mean(axis=0)
    axes = np.linalg.svd(xyz - origin, full_matrices=False)[2]
    axes[2] = np.cross(axes[0], axes[1])
    Q = (xyz - origin) @ axes[:2].T
    T = _collineation(Q, uv)
    depth = np.concatenate([Q, np.ones((len(Q), 1))], axis=1) @ T[2]
    if not ((depth > 0).all() or (depth < 0).all()):
        raise GeometryError("p4p: the points lie on both sides of the camera, or three of them on one line")
    if np.linalg.det(T) * depth[0] < 0:  # the camera sees the plane from behind: reverse the normal
        axes[1:], Q = -axes[1:], Q * (1, -1)
        T = T * (1.0, -1.0, 1.0)
    position = origin + _position_over_plane(T) @ axes
    R = rotation_from_position(uv, xyz, position)
    return (solution_of(position, R, uv, xyz),)


def coplanar_sets(points: FloatArray, *, seed: int = 0) -> Iterator[IntArray]:
    """Yield the indices of four or more points that are in one plane, (k,), each set once.

    Planes are those through three points each; of many points, MOST_PLANES of them at random are tried.

    Args:
        points: object points, shape (n, 3), object unit.
        seed: of the random choice.
    """
    xyz, found = np.asarray(points, dtype=float), set[tuple[int, ...]]()
    triples: Iterable[tuple[int, ...]] = combinations(range(len(xyz)), 3)
    if math.comb(len(xyz), 3) > MOST_PLANES:
        rng = np.random.default_rng(seed)
        triples = [tuple(rng.choice(len(xyz), 3, replace=False)) for _ in range(MOST_PLANES)]
    for chosen in triples:
        origin, p, q = xyz[list(chosen)]
        normal = np.cross(p - origin, q - origin)
        extent = np.linalg.norm(xyz - origin, axis=1).max() * np.linalg.norm(normal)
        near = np.flatnonzero(np.abs((xyz - origin) @ normal) <= MAX_THICKNESS_OF_SOME * extent)
        if extent > 0 and len(near) >= MIN_POINTS and tuple(near) not in found:
            found.add(tuple(near))
            yield near


def _collineation(Q: FloatArray, uv: FloatArray) -> FloatArray:
    """Return T of unit norm with k (u, v, 1) = T (X, Y, 1), by direct linear solution, eqs. 2.19-2.20."""
    scale = np.sqrt(np.mean(Q**2))
    q = np.concatenate([Q / scale, np.ones((len(Q), 1))], axis=1)
    spread = np.sqrt(np.mean((uv - uv.mean(axis=0)) ** 2))
    N = np.array([[1, 0, -uv[:, 0].mean()], [0, 1, -uv[:, 1].mean()], [0, 0, spread]]) / spread
    p = np.concatenate([uv, np.ones((len(uv), 1))], axis=1) @ N.T
    rows = np.einsum("nij,nk->nijk", skew(p), q).reshape(-1, 9)
    _, s, Vt = np.linalg.svd(rows, full_matrices=False)
    if s[7] <= 1e-9 * s[0]:
        raise GeometryError("p4p: three of the four points lie on one line")
    T = np.linalg.inv(N) @ Vt[8].reshape(3, 3) @ np.diag([1 / scale, 1 / scale, 1.0])
    return np.asarray(T / np.linalg.norm(T))


def _position_over_plane(T: FloatArray) -> FloatArray:
    """Return the projection centre in the axes of the plane, eqs. 2.21-2.30."""
    inverse = np.linalg.inv(T)
    a = inverse[2]  # vanishing line of the plane in the image
    b = T[2]  # vanishing line of the image in the plane
    c = inverse[:, 2]  # point of the plane on the optical axis
    DI_inverse = np.hypot(a[0], a[1]) / abs(a[2])
    foot = c[:2] / c[2]
    if DI_inverse < MAX_PARALLEL_RATIO:
        # parallel planes: the image scale, a square root of a ratio of areas, gives the distance
        scale = np.sqrt(abs(np.linalg.det(T[:2, :2]))) / abs(T[2, 2])
        return np.array([foot[0], foot[1], 1 / scale])
    theta = np.arctan(DI_inverse)
    DO = abs(b @ c) / (abs(c[2]) * np.hypot(b[0], b[1]))
    DCP = DO * np.sin(theta)
    # the camera is between the foot of its axis and the vanishing line (eqs. 2.28, 2.29)
    towards = -np.sign((b @ c) / c[2]) * b[:2] / np.hypot(b[0], b[1])
    xy = foot + towards * DCP * np.sin(theta)
    return np.array([xy[0], xy[1], DCP * np.cos(theta)])
