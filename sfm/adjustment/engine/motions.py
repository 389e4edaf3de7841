"""Free similarity motions of a network, inner and minimal constraints on them, S-transformations.

The normal equations of image points alone do not change when the whole network is shifted, turned or
scaled. `free_motions` gives these null vectors H; what is fixed or observed takes some away. A datum
is a matrix B with B' dx = 0 and B'H regular, and any solution is carried into it by
S = I - H (B'H)^-1 B' without a new adjustment.

Source: Baarda (1973), S-transformations and criterion matrices; Papo and Perelmuter (1980); Luhmann et
al., Close-Range Photogrammetry (2020), sec. 4.4.3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import qr
from scipy.linalg.lapack import dgeqrf, dorgqr

from sfm.adjustment.datum import ResolvedDatum
from sfm.adjustment.engine.collinearity import State
from sfm.adjustment.engine.observed import ObservedKind, reduced_rows
from sfm.adjustment.engine.unknowns import Unknowns
from sfm.conventions import BoolArray, FloatArray
from sfm.errors import GeometryError
from sfm.kernels.compiling import kernel

TINY = float(np.finfo(float).tiny)
SCALE_OPEN = 1e-3  # share of the scale in an open motion; it is 0 or 1 but for rounding
MIN_EFFECT = 1e-9  # relative effect on an observed unknown above which it takes part in the datum


@dataclass(frozen=True)
class Motions:
    """Null vectors H of the normal equations and datum constraints B, split as the unknowns are.

    Columns are the motions and, behind them, further null vectors that no motion explains.
    """

    reduced: FloatArray  # H of the reduced unknowns, (reduced, d)
    points: FloatArray  # H of the object points, (n, 3, d)
    constraints: FloatArray  # B of the object points, (n, 3, d)
    on_reduced: FloatArray  # B of the reduced unknowns where no free point can carry it, (reduced, d)
    inverse: FloatArray  # (B'H)^-1, (d, d)
    further: int = 0  # how many of the columns are further null vectors

    @property
    def defect(self) -> int:
        """Number of motions that the datum has to fix."""
        return len(self.inverse) - self.further

    def orthonormal(self, scale: FloatArray) -> FloatArray:
        """Return a basis of the motions of the reduced unknowns over their scales, (reduced, d).

        Args:
            scale: of each unknown, (reduced,).
        """
        H = self.reduced[:, : self.defect] / scale[:, None]
        if not 0 < H.shape[1] <= len(H):
            return np.asarray(np.linalg.qr(H)[0])
        reflections, tau, _, _ = dgeqrf(H)  # as numpy's qr does, which takes four times as long to call
        return np.ascontiguousarray(dorgqr(reflections, tau)[0])

    def transform(self, reduced: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return steps (reduced, e), (n, 3, e), or one (reduced,), (n, 3), carried into the datum: S dx."""
        d = len(self.inverse)
        if d == 0:
            return reduced, points
        B, n = self.constraints, 3 * len(points)
        product = B.reshape(n, d).T @ points.reshape(n, *reduced.shape[1:])
        t = self.inverse @ (product + self.on_reduced.T @ reduced)
        return reduced - self.reduced @ t, points - self.points @ t


def motions_of(
    layout: Unknowns, observed: tuple[ObservedKind, ...], state: State, datum: ResolvedDatum
) -> Motions:
    """Return the motions that the observations leave open and the constraints that the datum puts on them.

    Args:
        layout: order of the unknowns.
        observed: observations beside image points.
        state: where the motions are taken; lengths are scaled by the size of the network.
        datum: kind and points.

    Raises:
        GeometryError: the chosen datum points cannot carry the datum.
    """
    poses, mounts, points = free_motions(layout, state)
    H = np.zeros((layout.reduced, 7))
    H[: layout.pose_free.size] = poses.reshape(-1, 7)
    mounted = layout.mount_column >= 0
    H[layout.mount_column[mounted]] = mounts[mounted]
    H[layout.kept_start :] = points[layout.kept].reshape(-1, 7)
    seen = _seen_by_datum(layout, observed, state, H, mounts[~mounted & layout.rigged], points)
    if len(seen):
        # U would have a column for every row, of which control alone brings three a point
        _, singular, Vt = np.linalg.svd(seen, full_matrices=len(seen) < 7)
        rank = int((singular > MIN_EFFECT * max(1.0, singular[0])).sum())
        open_motions = Vt[rank:].T
    else:
        open_motions = np.eye(7)
    of_scale = [one.kind.name for one in observed if one.kind.needs_scale]
    if of_scale and np.abs(open_motions[6]).max(initial=0.0) > SCALE_OPEN:
        raise GeometryError(
            f"{of_scale[0]}: nothing gives the network a scale, in which their standard deviations are; "
            "add a scale bar, distances or control"
        )
    if len(seen) or not layout.all_free:
        H = H @ open_motions * layout.reduced_free()[:, None]
        points = points @ open_motions * layout.point_free[:, :, None]
    d = open_motions.shape[1]
    on_reduced = np.zeros_like(H)
    if d == 0:
        return Motions(H, points, points, on_reduced, np.zeros((0, 0)))
    on = carriers(layout, datum)
    carrier = points if on.all() else points * on[:, None, None]
    flat = carrier.reshape(-1, d)
    if not on.any():
        on_reduced, B = H.copy(), np.zeros_like(points)
        inverse = _regular_inverse(on_reduced.T @ H)
    else:
        if datum.kind == "minimal":
            picked = minimal_coordinates(flat, state.points, on)
            B = np.zeros_like(points)
            B.reshape(-1, d)[picked] = np.eye(d)
        else:
            B = carrier
        inverse = _regular_inverse(B.reshape(-1, d).T @ points.reshape(-1, d))
    return Motions(H, points, B, on_reduced, inverse)


def carriers(layout: Unknowns, datum: ResolvedDatum) -> BoolArray:
    """Return which object points carry the datum, (n,)."""
    free: BoolArray = np.asarray(layout.point_free.any(axis=1))
    return free if datum.points is None else free & datum.points


def free_motions(layout: Unknowns, state: State) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the seven similarity motions as changes of poses, mounts and points.

    Of X, w of poses and of mounts, (poses, 6, 7) and (a, 6, 7), and of X of points, (n, 3, 7). Shifts, turns
    and scale are about the centre of the network, the latter two over its size, so that all seven are of the
    same order.
    """
    centre, size = _extent(layout, state)
    poses, points = np.zeros((len(state.rig_from_object), 6, 7)), np.zeros((len(state.points), 3, 7))
    _fill_motions(state.pose_position, centre, size, poses)
    _fill_motions(state.points, centre, size, points)
    poses[:, 3:, 3:6] = state.rig_from_object / size
    mounts = np.zeros((len(state.camera_from_rig), 6, 7))
    mounts[:, :3, 6] = state.mount_position / size
    return poses, mounts, points


def _extent(layout: Unknowns, state: State) -> tuple[FloatArray, float]:
    """Return centre and size of the points that take part."""
    cloud = state.points[layout.point_on]
    centre = cloud.sum(axis=0) / len(cloud)
    # root mean square distance from the centre, as `mean_distance`
    return centre, max(float(np.sqrt(((cloud - centre) ** 2).sum(axis=1).mean())), TINY)


@kernel
def _fill_motions(xyz: FloatArray, centre: FloatArray, size: float, motions: FloatArray) -> None:
    """Fill the motions of points (n, 3 or more, 7) by `similarity_motions`; the unknown ones only shift."""
    for i in range(len(xyz)):
        known = np.isfinite(xyz[i, 0]) and np.isfinite(xyz[i, 1]) and np.isfinite(xyz[i, 2])
        x = (xyz[i, 0] - centre[0]) / size if known else 0.0
        y = (xyz[i, 1] - centre[1]) / size if known else 0.0
        z = (xyz[i, 2] - centre[2]) / size if known else 0.0
        motions[i, 0, 0] = motions[i, 1, 1] = motions[i, 2, 2] = 1.0
        motions[i, 0, 4], motions[i, 0, 5], motions[i, 0, 6] = z, -y, x
        motions[i, 1, 3], motions[i, 1, 5], motions[i, 1, 6] = -z, x, y
        motions[i, 2, 3], motions[i, 2, 4], motions[i, 2, 6] = y, -x, z


def minimal_coordinates(motions: FloatArray, points: FloatArray, on: BoolArray) -> FloatArray:
    """Return which coordinates (indices into the flat n x 3) carry a minimal datum.

    They are taken from three points far apart, by pivoting, so that B'H is as regular as it can be.
    """
    index = np.flatnonzero(on)
    X = points[index]
    first = int(np.argmax(((X - X.mean(axis=0)) ** 2).sum(axis=1)))
    second = int(np.argmax(((X - X[first]) ** 2).sum(axis=1)))
    base = X[second] - X[first]
    off = np.cross(X - X[first], base / max(float(np.linalg.norm(base)), np.finfo(float).tiny))
    third = int(np.argmax((off**2).sum(axis=1)))
    rows = (3 * index[[first, second, third], None] + np.arange(3)).ravel()
    _, _, pivots = qr(motions[rows].T, mode="economic", pivoting=True)
    return np.asarray(np.sort(rows[pivots[: motions.shape[1]]]))


def _regular_inverse(BH: FloatArray) -> FloatArray:
    try:
        inverse = np.asarray(np.linalg.inv(BH))
    except np.linalg.LinAlgError:
        inverse = np.full_like(BH, np.inf)
    if not np.linalg.norm(BH) * np.linalg.norm(inverse) * MIN_EFFECT < 1.0:
        raise GeometryError("datum: the datum points cannot fix position, attitude and scale of the network")
    return inverse


def _seen_by_datum(
    layout: Unknowns,
    observed: tuple[ObservedKind, ...],
    state: State,
    H: FloatArray,
    fixed_mounts: FloatArray,
    points: FloatArray,
) -> FloatArray:
    """Return what each motion does to fixed and observed unknowns and to observations, one row for each."""
    if layout.all_free and not observed:
        return np.zeros((0, 7))
    pose_on = np.zeros(len(layout.pose_free), dtype=bool)
    pose_on[layout.observations.pose_of[layout.image_on]] = True
    poses = H[: layout.pose_free.size].reshape(-1, 6, 7)
    rows = [
        points[~layout.point_free & layout.point_on[:, None]],
        poses[~layout.pose_free & pose_on[:, None]],
        fixed_mounts,
    ]
    for one in observed:
        point = one.point
        if point is not None:
            J = one.kind.linearise(state).J[0]
            moved = J @ points[point]
        else:
            columns, J, _ = reduced_rows(one, layout, state)
            met = one.kind.met(state)
            at = H
            if met is not state.points:
                at, kept = H.copy(), np.zeros((len(layout.kept), 3, 7))
                _fill_motions(met[layout.kept], *_extent(layout, state), kept)
                at[layout.kept_start :] = kept.reshape(-1, 7)
            moved = J @ at[columns]
        rows.append(moved[np.diagonal(one.weight, axis1=1, axis2=2) > 0])
    return np.concatenate([row.reshape(-1, 7) for row in rows])
