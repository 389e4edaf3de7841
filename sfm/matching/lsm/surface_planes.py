"""Local planes of the surface that a photograph sees, and windows as large as the surface is plane.

The centre of a window and the mean of its contents coincide only on a plane. On a curved surface a match is
off by the parallax of the mean depth over the window, which grows with the square of its side. Smaller
windows then lead to another position. The largest window that no smaller one contradicts is therefore chosen.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.spatial import cKDTree

from sfm.matching.lsm.patch_equations import linear_part
from sfm.matching.lsm.two_photo import LsmMatches, LsmSettings, match_lsm
from sfm.model.camera import Camera, tangents_from_pixel
from sfm.model.conventions import MAD_TO_SIGMA, AnyArray, BoolArray, FloatArray, IntArray
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, rows_of

SIDE_RATIO = 0.75  # of the next window to the one before
MIN_WINDOW_PX = 9  # smaller windows hardly determine the parameters of an affine warp
# Squared difference of two windows, over the covariance of the smaller one, from which the larger one is off.
# Half of that noise is common to both: chance leads this far in less than one case in a hundred.
MAX_SQUARED_RATIO = 6.0
ROUNDING_PX = 1e-6  # of positions from intensities in single precision
NEIGHBOURS = 6  # object points that define the plane at a position
PARAMETERS = 3  # of a plane
NEAREST, FARTHEST = 0.5, 2.0  # depths allowed for a plane, times those of the nearest and farthest point
TOLERANCE_FACTOR = 6.0  # of the spread of points about the planes of their neighbours
# Fraction of the squares of neighbours' tangents that is added in case they lie in a row.
REGULARISATION_FRACTION = 1e-6


@dataclass(frozen=True)
class Planes:
    """Planes of the surface at positions in a photograph; NaN where there are none in front of it.

    The slope of a plane is the change of its inverse depth per px of the photograph, relative to that at the
    position.
    """

    points: FloatArray  # object points at the positions, (k, 3)
    normal: FloatArray  # of the surface there, towards the photograph, unit vectors, (k, 3)
    slope_covariance: FloatArray  # 1 / px^2, (k, 2, 2); NaN where no further point shows it

    def select(self, rows: BoolArray | IntArray) -> Planes:
        """Return the selected planes."""
        return Planes(self.points[rows], self.normal[rows], self.slope_covariance[rows])


def planes_at(estimate: Estimate, camera: IntArray, i: int, xy: FloatArray, point: IntArray) -> Planes:
    """Project positions in a photograph onto the planes through the object points around them.

    Over a plane the inverse of the depth is linear in the tangents: 1 / t = a u + b v + c. The covariance of
    a slope is that of the fit, with the spread of its own points, but not less than that of all points about
    the planes of their neighbours: three degrees of freedom alone often show too little.

    Args:
        estimate: orientation and object points.
        camera: index of the camera of each photograph, (m,).
        i: the photograph.
        xy: positions, px, (k, 2).
        point: object points that it sees.
    """
    lens, X0, R = estimate.cameras[camera[i]], estimate.position[i], estimate.rotation[i]
    points, normal = np.full((len(xy), 3), np.nan), np.full((len(xy), 3), np.nan)
    covariance = np.full((len(xy), 2, 2), np.nan)
    UVW = (estimate.points[point] - X0) @ R
    UVW = UVW[UVW[:, 2] < 0]
    uv = tangents_from_pixel(lens, xy)
    rows = np.flatnonzero(np.isfinite(uv).all(axis=1))
    if len(UVW) < NEIGHBOURS or not len(rows):
        return Planes(points, normal, covariance)
    known, inverse, uv = -UVW[:, :2] / UVW[:, 2:], -1 / UVW[:, 2], uv[rows]
    near = cKDTree(known).query(uv, k=NEIGHBOURS)[1]
    away = known[near] - uv[:, None]
    plane, N = _planes(away, inverse[near])
    spread = np.full(len(uv), np.nan)
    if len(known) > NEIGHBOURS:
        v = inverse[near] - np.einsum("kij,kj->ki", away, plane[:, :2]) - plane[:, 2:]
        own = np.sqrt((v**2).sum(axis=1) / (NEIGHBOURS - PARAMETERS))
        usual = MAD_TO_SIGMA * float(np.median(np.abs(_off_neighbours(known, inverse)[0])))
        spread = np.maximum(own, usual)
    value = plane[:, 2].copy()  # inverse of the depth at the position
    plane[:, 2] -= np.sum(plane[:, :2] * uv, axis=1)
    inside = (value > inverse.min() / FARTHEST) & (value < inverse.max() / NEAREST)
    rows, uv, value, plane = rows[inside], uv[inside], value[inside], plane[inside]
    T = _tangents_per_px(lens, xy[rows]) * (spread[inside] / value)[:, None, None]
    covariance[rows] = T @ np.linalg.inv(N[inside])[:, :2, :2] @ T.transpose(0, 2, 1)
    points[rows] = X0 + (np.column_stack([uv, -np.ones(len(uv))]) / value[:, None]) @ R.T
    across = -(plane * [1.0, 1.0, -1.0]) @ R.T
    normal[rows] = across / np.linalg.norm(across, axis=1, keepdims=True)
    return Planes(points, normal, covariance)


def tilted_planes(
    estimate: Estimate, camera: IntArray, i: int, xy: FloatArray, planes: Planes, slope: FloatArray
) -> Planes:
    """Return the planes at positions in a photograph after a change of their slopes.

    Args:
        estimate: orientation.
        camera: index of the camera of each photograph, (m,).
        i: the photograph.
        xy: positions, px, (k, 2).
        planes: planes there.
        slope: changes, 1 / px, (k, 2).
    """
    lens, R = estimate.cameras[camera[i]], estimate.rotation[i]
    uv = tangents_from_pixel(lens, xy)
    normal = planes.normal @ R  # of U, V, W = t (u, v, -1); scaled so that 1 / t is 1 at the position
    normal /= (normal[:, :2] * uv).sum(axis=1, keepdims=True) - normal[:, 2:]
    change = np.linalg.solve(_tangents_per_px(lens, xy), slope[:, :, None])[:, :, 0]
    normal[:, :2] += change
    normal[:, 2] += (change * uv).sum(axis=1)
    across = -normal @ R.T
    return replace(planes, normal=across / np.linalg.norm(across, axis=1, keepdims=True))


def _tangents_per_px(lens: Camera, xy: FloatArray) -> FloatArray:
    """Return d(u, v) / d(x) in the first row and d(u, v) / d(y) in the second, (k, 2, 2)."""
    moved = [
        (tangents_from_pixel(lens, xy + half) - tangents_from_pixel(lens, xy - half))
        for half in np.eye(2) / 2
    ]
    return np.stack(moved, axis=1)


def on_surface(seen: ImagePoints, estimate: Estimate, doubtful: BoolArray) -> BoolArray:
    """Return which object points lie on the surface of their neighbours in all their photographs, (n,).

    An error along the epipolar line moves a point with two rays towards its photographs or away from them,
    and has no other effect. A point is rejected if its distance from the plane through its neighbours exceeds
    TOLERANCE_FACTOR times the usual one in the photograph. Among neighbours the farthest is rejected first,
    since it distorts the planes of the others.

    Args:
        seen: image points of n object points.
        estimate: orientation and object points.
        doubtful: points that may be wrong, (n,); the others are assumed to be right.
    """
    good = np.asarray(estimate.determined | ~doubtful)
    for i, rows in enumerate(rows_of(seen.image, len(estimate.position))):
        point = np.unique(seen.point[rows])
        UVW = (estimate.points[point] - estimate.position[i]) @ estimate.rotation[i]
        before = np.isfinite(UVW).all(axis=1) & (UVW[:, 2] < 0)
        good[point[~before & doubtful[point]]] = False
        while True:
            on = np.flatnonzero(before & good[point])
            if not doubtful[point[on]].any():
                break
            if len(on) <= NEIGHBOURS:  # no surface
                good[point[on[doubtful[point[on]]]]] = False
                break
            uv, inverse = -UVW[on, :2] / UVW[on, 2:], -1 / UVW[on, 2]
            off, near = _off_neighbours(uv, inverse)
            off = np.abs(off)
            out = doubtful[point[on]] & (off > TOLERANCE_FACTOR * MAD_TO_SIGMA * np.median(off))
            if not out.any():
                break
            worst = out & (off >= np.where(out[near], off[near], 0.0).max(axis=1))
            good[point[on[worst]]] = False
    return good


def _off_neighbours(uv: FloatArray, inverse: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return how far points are from the planes of their neighbours, and these.

    Args:
        uv: tangents of more than NEIGHBOURS points, (k, 2).
        inverse: their inverse depths, (k,).

    Returns:
        Differences of inverse depths, all with the standard deviation of that of a point, (k,), and indices,
        (k, NEIGHBOURS).
    """
    near = cKDTree(uv).query(uv, k=NEIGHBOURS + 1)[1]
    itself = near == np.arange(len(near))[:, None]
    itself[~itself.any(axis=1), -1] = True  # several at one position
    near = near[~itself].reshape(len(near), -1)
    plane, N = _planes(uv[near] - uv[:, None], inverse[near])
    return (inverse - plane[:, 2]) / np.sqrt(1 + np.linalg.inv(N)[:, 2, 2]), near


def _planes(away: FloatArray, inverse: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a, b, c of the planes 1 / t = a u + b v + c around k positions, and their normal matrices.

    Args:
        away: tangents of the neighbours minus those of the position, (k, NEIGHBOURS, 2).
        inverse: inverse depths of the neighbours, (k, NEIGHBOURS).
    """
    A = np.concatenate([away, np.ones((*away.shape[:2], 1))], axis=2)
    N = np.einsum("kij,kil->kjl", A, A)
    N += (
        REGULARISATION_FRACTION
        * np.einsum("kij,kij->k", away, away)[:, None, None]
        * np.diag([1.0, 1.0, 0.0])
    )
    return np.linalg.solve(N, np.einsum("kij,ki->kj", A, inverse)[:, :, None])[:, :, 0], N


def match_where_plane(
    left: AnyArray,
    right: AnyArray,
    xy_left: FloatArray,
    matches: LsmMatches,
    *,
    window_px: int,
    interpolation: str = "six_tap",
) -> tuple[LsmMatches, FloatArray]:
    """Return for each point the match of the largest window that no smaller one contradicts.

    Args:
        left: photograph, (H, W).
        right: the other photograph.
        xy_left: points in the left photograph, px, (k, 2).
        matches: matches of these points, with an affine or projective warp.
        window_px: odd side of the windows of these matches.
        interpolation: kernel for the right photograph.

    Returns:
        The matches, and by how much those of smaller windows may still be off, px, (k, 2).

    Source: Lepski (1991), Theory Probab. Appl. 35(3), for the choice; Kanade and Okutomi (1994), IEEE Trans.
    PAMI 16(9), for windows that adapt to the surface.
    """
    rows = np.flatnonzero(matches.good)
    start, linear = matches.xy[rows].copy(), linear_part(matches.warp[rows])
    names = [field.name for field in fields(matches) if field.name != "linear"]
    good = LsmMatches(**{name: getattr(matches, name)[rows] for name in names})
    sides, by_size = [window_px], [good]
    while len(rows) and (side := int(SIDE_RATIO * sides[-1]) | 1) >= MIN_WINDOW_PX:
        settings = LsmSettings(window_px=side, interpolation=interpolation)
        smaller = match_lsm(left, right, xy_left[rows], start, settings, start=linear)
        start[smaller.good], linear[smaller.good] = (
            smaller.xy[smaller.good],
            linear_part(smaller.warp[smaller.good]),
        )
        sides.append(side)
        by_size.append(smaller)
    chosen, off = _largest_that_agrees(by_size), np.zeros((len(matches), 2))
    columns = {name: getattr(matches, name).copy() for name in names}
    for number in range(1, len(sides)):
        of_size = np.flatnonzero(chosen == number)
        for name, column in columns.items():
            column[rows[of_size]] = getattr(by_size[number], name)[of_size]
        moved = by_size[number].xy[of_size] - by_size[0].xy[of_size]
        off[rows[of_size]] = moved * sides[number] ** 2 / (sides[0] ** 2 - sides[number] ** 2)
    return LsmMatches(**columns), off


def _largest_that_agrees(by_size: list[LsmMatches]) -> IntArray:
    """Return the number of the first window of each point that no smaller window contradicts, (k,).

    Args:
        by_size: matches of the same points with smaller and smaller windows; all of the first are good.
    """
    chosen = np.full(len(by_size[0]), -1, dtype=np.int64)
    for number in reversed(range(len(by_size))):
        agrees = by_size[number].good
        for smaller in by_size[number + 1 :]:
            good = np.flatnonzero(agrees & smaller.good)
            d, C = smaller.xy[good] - by_size[number].xy[good], smaller.covariance[good]
            agrees[good] = squares_over_covariance(d, C) <= MAX_SQUARED_RATIO
        chosen[agrees] = number
    return chosen


def squares_over_covariance(d: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return d' C^-1 d for differences of positions, px, (k,); NaN where C is.

    For photographs without noise C is 0, but no position is known better than ROUNDING_PX.
    """
    C = covariance + ROUNDING_PX**2 * np.eye(2)
    return np.asarray(np.einsum("ki,ki->k", d, np.linalg.solve(C, d[:, :, None])[:, :, 0]))
