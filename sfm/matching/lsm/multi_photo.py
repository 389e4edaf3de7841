"""Multi-photo least squares matching: one point in k photographs at once, tied together by their orientation.

Each photograph has its own warp and radiometry against the template of the reference, as in `lsm`. What is
common is the object point: its pictures x_i(X) are where the warped windows must be, up to the sigma of the
orientation. A step solves the shift s_i of every window and its covariance C_i, intersects the object point
from x_i + s_i, and lets each shift give way to it by what both weigh; affine parameters follow the shift.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sfm.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.errors import GeometryError
from sfm.kernels.cholesky import solve_factorised
from sfm.kernels.options import compiled
from sfm.kernels.sampling import interpolation_index
from sfm.matching.lsm.patch_equations import MODELS, RADIOMETRIC, dot, new_workspace, prepare_template
from sfm.matching.lsm.patch_precision import CXX, CXY, CYY, FLAG, OUTPUTS, STEPS, R, judge
from sfm.matching.lsm.projected_points import derivatives, facing_warps, pictures_of
from sfm.matching.lsm.warp import put_step
from sfm.matching.lsm.window import resample_patch
from sfm.matching.match_flags import DIVERGED, FLAT_TEXTURE, LOW_CORRELATION, MATCHED, OUTSIDE, TOO_FAR
from sfm.matching.radiometry import grey_of, odd_window
from sfm.network import Estimate, rows_of

MAX_STEPS = 15
STOP_PX = 0.005
SIZE = MODELS["affine"] + RADIOMETRIC
LAST_FLAG = STEPS  # steps are counted for all windows together: the column holds the flag of the last one
MIN_EIGENVALUE = 1e-12  # part of the largest, what rounding leaves of parallel rays


@dataclass(frozen=True)
class MultiMatches:
    """Object points and their image points, measured together."""

    points: FloatArray  # object points, NaN where fewer than two photographs agree, (n, 3)
    point_covariance: FloatArray  # of the object points with the orientation held, (n, 3, 3)
    xy: FloatArray  # image points, NaN where the flag says why, px, (k, 2)
    covariance: FloatArray  # of the image points from their own windows, px^2, (k, 2, 2)
    correlation: FloatArray  # r of the template and each window, 1 in the reference, (k,)
    flag: IntArray  # see LsmFlag, (k,)
    steps: int  # Gauss-Newton steps

    @property
    def good(self) -> BoolArray:
        """Which image points were matched, (k,)."""
        return np.asarray(self.flag == 0)


def match_multi(
    photographs: Sequence[AnyArray],
    estimate: Estimate,
    camera: IntArray,
    image: IntArray,
    point: IntArray,
    xy: FloatArray,
    reference: IntArray,
    *,
    orientation_px: float | None = 0.1,
    window_px: int = 15,
    interpolation: str = "six_tap",
    max_shift_px: float = 5.0,
    min_correlation: float = 0.5,
    start: FloatArray | None = None,
) -> MultiMatches:
    """Match points in all their photographs at once and intersect them.

    Args:
        photographs: m photographs, (H, W).
        estimate: interior and exterior orientation of all, and object points to start from, (n, 3).
        camera: index of the camera of each photograph, (m,).
        image: photograph of each image point, (k,).
        point: object point of each image point, (k,).
        xy: approximate image points; in the reference the place itself, px, (k, 2).
        reference: the row of each point that is its template, (n,).
        orientation_px: standard deviation of a projected point because of the orientation, px; None leaves
            every window free, and the object point is intersected afterwards.
        window_px: odd side of the windows.
        interpolation: kernel of resampling.
        max_shift_px: farther from the start is too far.
        min_correlation: below it a window is not alike.
        start: linear part of each warp, right px per reference px, (k, 2, 2); from the orientation, for a
            surface that faces the reference, if not given.

    Raises:
        GeometryError: even windows, or photographs without orientation.

    Source: Gruen and Baltsavias (1988), Photogramm. Eng. 54(5): geometrically constrained matching.
    """
    kind = interpolation_index(interpolation)
    half = odd_window("multi-photo matching", window_px) // 2
    used = np.unique(image)
    if not estimate.oriented[used].all():
        first = int(used[~estimate.oriented[used]][0])
        raise GeometryError(f"multi-photo matching: photograph {first + 1} has no orientation")
    greys = [grey_of(one) for one in photographs]
    ref = reference[point]
    windows = np.flatnonzero(ref != np.arange(len(image)))
    X = estimate.points.copy()
    linear = facing_warps(estimate, camera, image, ref, X[point]) if start is None else start
    warp = np.zeros((len(image), 3, 3))
    warp[:, :2, :2], warp[:, :2, 2], warp[:, 2, 2] = linear, xy, 1.0
    out = np.zeros((len(image), OUTPUTS))
    length = np.full(len(image), np.inf)
    both = np.column_stack([image[ref[windows]], image[windows]])
    pairs, pair = np.unique(both, axis=0, return_inverse=True)
    rows_of_pair = rows_of(pair.ravel(), len(pairs))
    groups = [(i, j, windows[own]) for (i, j), own in zip(pairs.tolist(), rows_of_pair, strict=False)]
    step = 0
    q, follow = np.zeros((len(image), SIZE)), np.zeros((len(image), SIZE, 2))
    moving = np.ones(len(X), dtype=bool)  # points with a window that still moves
    while step < MAX_STEPS and moving.any():
        step += 1
        for i, j, own in groups:
            rows = own[(out[own, FLAG] == MATCHED) & moving[point[own]]]
            out[rows], q[rows], follow[rows] = _window_steps(
                greys[i], greys[j], half, kind, xy[ref[rows]], warp[rows]
            )
        now, C = _measured(xy, warp, q, out, reference, point, windows, half)
        X, N = _intersect(estimate, camera, image, point, X, now, C, orientation_px or 0.0)
        target = now if orientation_px is None else _give_way(
            estimate, camera, image, point, X, now, C, warp[:, :2, 2], orientation_px
        )  # fmt: skip
        rows = windows[(out[windows, FLAG] == MATCHED) & moving[point[windows]]]
        shift = target[rows] - warp[rows, :2, 2]
        warp[rows], length[rows] = _move_windows(warp[rows], q[rows], follow[rows], shift, half)
        far = np.hypot(*(warp[rows, :2, 2] - xy[rows]).T) > max_shift_px
        out[rows, FLAG] = np.where(np.isfinite(length[rows]), np.where(far, TOO_FAR, MATCHED), DIVERGED)
        still = rows[(out[rows, FLAG] == MATCHED) & (length[rows] > STOP_PX)]
        moving = np.bincount(point[still], minlength=len(X)) > 0
        q[~moving[point], :2] = 0.0  # they are where they want to be
    matched = out[:, FLAG] == MATCHED
    out[matched & (length > STOP_PX) & (ref != np.arange(len(image))), FLAG] = DIVERGED
    out[windows[(out[windows, FLAG] == MATCHED) & (out[windows, LAST_FLAG] == FLAT_TEXTURE)], FLAG] = (
        FLAT_TEXTURE
    )
    out[windows[(out[windows, FLAG] == MATCHED) & (out[windows, R] < min_correlation)], FLAG] = (
        LOW_CORRELATION
    )
    flag = out[:, FLAG].astype(np.int64)
    good = flag == MATCHED
    seen = np.bincount(point[good], minlength=len(X)) >= 2
    now[windows] = warp[windows, :2, 2]
    last = np.where((good & seen[point])[:, None], now, np.nan)
    X, N = _intersect(estimate, camera, image, point, X, last, C, orientation_px or 0.0)
    seen &= _regular(N)
    good &= seen[point]
    covariance = np.full((len(X), 3, 3), np.nan)
    covariance[seen] = np.linalg.inv(N[seen])
    X[~seen] = np.nan
    out[reference, R] = 1.0
    return MultiMatches(
        X, covariance, np.where(good[:, None], now, np.nan), np.where(good[:, None, None], C, np.nan),
        out[:, R], flag, step,
    )  # fmt: skip


def _measured(
    xy: FloatArray,
    warp: FloatArray,
    q: FloatArray,
    out: FloatArray,
    reference: IntArray,
    point: IntArray,
    windows: IntArray,
    half: int,
) -> tuple[FloatArray, FloatArray]:
    """Return where the windows want to be and with which covariance; NaN for those that failed.

    Half of the noise of a match is that of the template and goes to the reference, as in `tie_points`.
    """
    good = windows[out[windows, FLAG] == MATCHED]
    now, C = np.full(xy.shape, np.nan), np.full((len(xy), 2, 2), np.nan)
    A = warp[good, :2, :2]
    now[good] = warp[good, :2, 2] - np.einsum("kij,kj->ki", A, half * q[good, :2] / q[good, -1:])
    C[good] = out[good][:, [CXX, CXY, CXY, CYY]].reshape(-1, 2, 2) / 2
    back = np.linalg.inv(A)
    mean = np.zeros((len(reference), 2, 2))
    np.add.at(mean, point[good], back @ C[good] @ back.transpose(0, 2, 1))
    count = np.bincount(point[good], minlength=len(reference))
    some = count > 0
    now[reference[some]] = xy[reference[some]]
    C[reference[some]] = mean[some] / count[some, None, None]
    return now, C


def _intersect(
    estimate: Estimate,
    camera: IntArray,
    image: IntArray,
    point: IntArray,
    points: FloatArray,
    now: FloatArray,
    C: FloatArray,
    orientation_px: float,
) -> tuple[FloatArray, FloatArray]:
    """One Gauss-Newton step of the object points; returns them and their normal matrices, (n, 3, 3)."""
    r = now - pictures_of(estimate, camera, image, points[point])  # NaN of points behind a photograph
    rows = np.flatnonzero(np.isfinite(r).all(axis=1) & np.isfinite(C).all(axis=(1, 2)))
    J = derivatives(estimate, camera, image[rows], points[point[rows]])
    W = np.linalg.inv(C[rows] + orientation_px**2 * np.eye(2))
    N, b = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
    JW = J.transpose(0, 2, 1) @ W
    np.add.at(N, point[rows], JW @ J)
    np.add.at(b, point[rows], np.einsum("kij,kj->ki", JW, r[rows]))
    solvable = (np.bincount(point[rows], minlength=len(points)) >= 2) & _regular(N)
    moved = points.copy()
    moved[solvable] += np.linalg.solve(N[solvable], b[solvable, :, None])[..., 0]
    return moved, N


def _regular(N: FloatArray) -> BoolArray:
    """Return which normal matrices determine their point: rays that are parallel do not, (n,)."""
    values = np.linalg.eigvalsh(N)
    return np.asarray(values[:, 0] > MIN_EIGENVALUE * values[:, 2])


def _give_way(
    estimate: Estimate,
    camera: IntArray,
    image: IntArray,
    point: IntArray,
    points: FloatArray,
    now: FloatArray,
    C: FloatArray,
    place: FloatArray,
    orientation_px: float,
) -> FloatArray:
    """Return the weighted mean of where a window wants to be and where its object point is, px, (k, 2)."""
    picture = pictures_of(estimate, camera, image, points[point])
    good = np.isfinite(now).all(axis=1) & np.isfinite(picture).all(axis=1)
    target = place.copy()
    share = C[good] @ np.linalg.inv(C[good] + orientation_px**2 * np.eye(2))
    target[good] = now[good] + np.einsum("kij,kj->ki", share, picture[good] - now[good])
    return target


@compiled
def _window_steps(
    left: AnyArray, right: AnyArray, half: int, kind: int, xy: FloatArray, warp: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return judgement (k, OUTPUTS), step q (k, 8) and how q follows its shift (k, 8, 2)."""
    work = new_workspace(half, kind, SIZE - RADIOMETRIC)
    L, unit = work.L, np.empty((2, SIZE))
    out, q, follow = np.zeros((len(xy), OUTPUTS)), np.zeros((len(xy), SIZE)), np.zeros((len(xy), SIZE, 2))
    for k in range(len(xy)):
        out[k, FLAG] = prepare_template(left, xy[k, 0], xy[k, 1], work)
        if out[k, FLAG] != MATCHED:
            continue
        if not resample_patch(right, warp[k], half, kind, work.wx, work.wy, work.patch):
            out[k, FLAG] = OUTSIDE
            continue
        for a in range(SIZE):
            work.rhs[a] = q[k, a] = dot(work.J[a], work.patch)
        solve_factorised(L, q[k])
        if not q[k, SIZE - 1] > 0.0:
            out[k, FLAG] = DIVERGED
            continue
        work.q[:] = q[k]
        # far from the solution misfit looks like noise: whether the texture is flat, the last step tells
        out[k, LAST_FLAG] = judge(work, -1.0, warp[k], out[k])
        for a in range(2):
            unit[a] = 0.0
            unit[a, a] = 1.0
            solve_factorised(L, unit[a])
        det = unit[0, 0] * unit[1, 1] - unit[0, 1] * unit[1, 0]
        for a in range(SIZE):
            follow[k, a, 0] = (unit[0, a] * unit[1, 1] - unit[1, a] * unit[0, 1]) / det
            follow[k, a, 1] = (unit[1, a] * unit[0, 0] - unit[0, a] * unit[1, 0]) / det
    return out, q, follow


@compiled
def _move_windows(
    warp: FloatArray, q: FloatArray, follow: FloatArray, shift: FloatArray, half: int
) -> tuple[FloatArray, FloatArray]:
    """Put steps of given shift (px) on warps, the other parameters follow; return warps and lengths, px."""
    length, step = np.empty(len(warp)), np.empty(SIZE)
    for k in range(len(warp)):
        H = warp[k]
        det = H[0, 0] * H[1, 1] - H[0, 1] * H[1, 0]
        factor = q[k, SIZE - 1] / (det * half)
        dx = -(H[1, 1] * shift[k, 0] - H[0, 1] * shift[k, 1]) * factor - q[k, 0]
        dy = -(H[0, 0] * shift[k, 1] - H[1, 0] * shift[k, 0]) * factor - q[k, 1]
        for a in range(SIZE):
            step[a] = q[k, a] + follow[k, a, 0] * dx + follow[k, a, 1] * dy
        length[k] = put_step(H, step, half, SIZE - 2)
    return warp, length
