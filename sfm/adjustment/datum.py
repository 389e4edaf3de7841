"""Datum: the points that define position, attitude and scale, with free motions and datum constraints.

The normal equations of image points alone do not change when the whole network is shifted, rotated or scaled.
`free_motions` gives the null vectors H of these motions; fixed and observed values remove some of them. A
datum is a matrix B with B' dx = 0 and B'H regular. The matrix S = I - H (B'H)^-1 B' transforms any solution
into it without a new adjustment.

Normal equations can have further null vectors that no motion explains. Examples are two networks without a
common point, a photograph with a single point, or a principal distance that acts like another height. If such
a null vector moves object points that carry the datum, the datum fixes it like the motions, by an inner
constraint on these points. Two separate networks thus get a free datum each. If it moves none of these
points, it is fixed by an inner constraint on the scaled reduced unknowns. The result therefore does not
depend on how the solver held the null vectors.

A point without accepted rays, or with parallel rays, carries no datum. Its open directions keep their values,
whatever the rest of the network does. A point far behind all others, which its rays hardly place, does not
carry it either, unless the caller names it.

Source: Luhmann et al., Close-Range Photogrammetry (2020), sec. 4.4.3; Baarda (1973), S-transformations and
criterion matrices; Papo and Perelmuter (1980); Foerstner and Wrobel (2016), sec. 4.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import qr
from scipy.linalg.lapack import dgeqrf, dorgqr

from sfm.adjustment.engine.collinearity import State
from sfm.adjustment.engine.normals import NormalEquations, solve_transposed
from sfm.adjustment.engine.observed import ObservedKind, reduced_rows
from sfm.adjustment.engine.unknowns import Unknowns
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.errors import DivergedError, GeometryError
from sfm.model.network import Network
from sfm.runtime.compiling import kernel

MIN_CARRIERS = 3  # points needed to fix position, attitude and scale
# Share of the largest component of a null vector from which a parameter counts as open.
MIN_LEADING_SHARE = 0.1
# |A dx| of the points that carry the datum from which a null vector of length 1 is said to move them.
MIN_DATUM_EFFECT = 1e-6
TINY = float(np.finfo(float).tiny)
SCALE_OPEN = 1e-3  # share of the scale in an open motion; it is 0 or 1 except for rounding
MIN_EFFECT = 1e-9  # relative effect on an observed unknown above which it takes part in the datum
KINDS = ("free", "minimal", "control")
# Median distances from the middle of the points beyond which a point carries no datum. Two points 1,000 of
# them behind 40 others, seen from a base of 2, made the others 2,000 times less precise.
FAR = 300.0


class ResolvedDatum(NamedTuple):
    """A datum on the points of one network."""

    kind: str  # free | minimal | control
    points: BoolArray | None  # which object points carry the datum, all if None, (n,)


@dataclass(frozen=True)
class Datum:
    """The definition of position, attitude and scale of a network.

    free: inner constraints on object points, ignoring control; minimal: the smallest number of fixed
    coordinates; control: the network's control points, fixed or weighted. Scale bars, observed exterior and
    interior orientation take part in every kind. The datum fixes only what they leave open.

    Example:
        >>> import sfm
        >>> sfm.Datum("minimal", points=["501", "502", "503"]).points
        ['501', '502', '503']
    """

    kind: str = "free"  # free | minimal | control
    points: BoolArray | IntArray | Sequence[str] | Sequence[int] | None = None
    # object points that carry the datum: names, indices, or a mask (n,); all if None

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise GeometryError(f"datum: kind '{self.kind}', expected one of {', '.join(KINDS)}")

    def resolve(self, network: Network) -> ResolvedDatum:
        """Return the datum with its points as a mask.

        Args:
            network: network that contains the points.

        Raises:
            GeometryError: a point is not in the network, or no points are given.
        """
        if self.points is None:
            return ResolvedDatum(self.kind, None)
        n = len(network.points)
        given = np.asarray([self.points] if isinstance(self.points, str) else self.points)
        if given.dtype == np.bool_:
            if given.shape != (n,):
                raise GeometryError(
                    f"datum: a mask of shape {given.shape}, expected ({n},), one for each point"
                )
            return ResolvedDatum(self.kind, given)
        if given.ndim != 1 or not len(given):
            raise GeometryError(f"datum: points of shape {given.shape}, expected names or indices of points")
        if given.dtype.kind == "U":
            place = {name: j for j, name in enumerate(network.points)}
            unknown = [name for name in given.tolist() if name not in place]
            index = np.array([place.get(name, -1) for name in given.tolist()], dtype=np.int64)
        elif given.dtype.kind in "iu":
            unknown = [str(j) for j in given if not 0 <= j < n]
            index = given
        else:
            raise GeometryError(f"datum: points of type {given.dtype}, expected names, indices or a mask")
        if unknown:
            raise GeometryError(f"datum: point {unknown[0]} is not in the network of {n} points")
        mask = np.zeros(n, dtype=bool)
        mask[index] = True
        return ResolvedDatum(self.kind, mask)


def without_far_points(datum: ResolvedDatum, points: FloatArray) -> ResolvedDatum:
    """Return the datum without points far behind all others; unchanged if points are named, or none is far.

    Args:
        datum: kind and points.
        points: coordinates of all object points, NaN for unknown ones, (n, 3).
    """
    if datum.points is not None:
        return datum
    known = np.isfinite(points).all(axis=1)
    if known.sum() < 2 * MIN_CARRIERS:
        return datum
    away = np.abs(points - np.median(points[known], axis=0)).max(axis=1)
    near = np.asarray(away <= FAR * np.median(away[known]))
    return datum if near[known].all() else datum._replace(points=near)


@dataclass(frozen=True)
class Motions:
    """Null vectors H of the normal equations and datum constraints B, split like the unknowns.

    The columns are the motions, followed by further null vectors that no motion explains.
    """

    reduced: FloatArray  # H of the reduced unknowns, (reduced, d)
    points: FloatArray  # H of the object points, (n, 3, d)
    constraints: FloatArray  # B of the object points, (n, 3, d)
    on_reduced: FloatArray  # B of the reduced unknowns, used where no free point can carry it, (reduced, d)
    inverse: FloatArray  # (B'H)^-1, (d, d)
    further: int = 0  # number of columns that are further null vectors

    @property
    def defect(self) -> int:
        """Number of motions that the datum has to fix."""
        return len(self.inverse) - self.further

    def orthonormal(self, scale: FloatArray) -> FloatArray:
        """Return an orthonormal basis of the motions of the scaled reduced unknowns, (reduced, d).

        Args:
            scale: divisor of each unknown, (reduced,).
        """
        H = self.reduced[:, : self.defect] / scale[:, None]
        if not 0 < H.shape[1] <= len(H):
            return np.asarray(np.linalg.qr(H)[0])
        reflections, tau, _, _ = dgeqrf(H)  # numpy's qr does the same, but a call takes four times as long
        return np.ascontiguousarray(dorgqr(reflections, tau)[0])

    def transform(self, reduced: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Transform steps into the datum: S dx.

        Args:
            reduced: steps of the reduced unknowns, (reduced, e) or (reduced,).
            points: steps of the object points, (n, 3, e) or (n, 3).
        """
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
    """Return the motions that the observations leave open, and the datum constraints that fix them.

    Args:
        layout: order of the unknowns.
        observed: observations other than image points.
        state: values at which the motions are evaluated; lengths are scaled by the size of the network.
        datum: kind and points.

    Raises:
        GeometryError: the chosen datum points cannot carry the datum.
    """
    try:
        return _motions_of(layout, observed, state, datum, layout.point_on)
    except GeometryError:
        if datum.points is None:
            raise
    return _motions_of(layout, observed, state, datum, layout.point_on & datum.points)  # others may be far


def _motions_of(
    layout: Unknowns, observed: tuple[ObservedKind, ...], state: State, datum: ResolvedDatum, cloud: BoolArray
) -> Motions:
    """Return the motions, with rotations and scale about the points of a cloud, (n,)."""
    poses, mounts, points = free_motions(layout, state, cloud)
    H = np.zeros((layout.reduced, 7))
    H[: layout.pose_free.size] = poses.reshape(-1, 7)
    mounted = layout.mount_column >= 0
    H[layout.mount_column[mounted]] = mounts[mounted]
    H[layout.kept_start :] = points[layout.kept].reshape(-1, 7)
    seen = _seen_by_datum(layout, observed, state, H, mounts[~mounted & layout.rigged], points, cloud)
    if len(seen):
        # without the full U, which would have a column for every row, three per control point
        _, singular, Vt = np.linalg.svd(seen, full_matrices=len(seen) < 7)
        rank = int((singular > MIN_EFFECT * max(1.0, singular[0])).sum())
        open_motions = Vt[rank:].T
    else:
        open_motions = np.eye(7)
    of_scale = [observed_kind.kind.name for observed_kind in observed if observed_kind.kind.needs_scale]
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
    """Return which object points carry the datum, (n,).

    Args:
        layout: order of the unknowns.
        datum: kind and points.
    """
    free: BoolArray = np.asarray(layout.point_free.any(axis=1))
    return free if datum.points is None else free & datum.points


def free_motions(
    layout: Unknowns, state: State, cloud: BoolArray | None = None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the seven similarity motions as changes of poses, mounts and points.

    Rotations and scale refer to the centre of the network and are divided by its size, so that all seven
    motions are of the same order.

    Args:
        layout: order of the unknowns.
        state: values at which the motions are evaluated.
        cloud: points whose centre and size these are, (n,); all that are adjusted if not given.

    Returns:
        Changes of X, w of poses (poses, 6, 7), of X, w of mounts (a, 6, 7), and of X of points (n, 3, 7).
    """
    centre, size = _extent(state, layout.point_on if cloud is None else cloud)
    poses, points = np.zeros((len(state.rig_from_object), 6, 7)), np.zeros((len(state.points), 3, 7))
    _fill_motions(state.pose_position, centre, size, poses)
    _fill_motions(state.points, centre, size, points)
    poses[:, 3:, 3:6] = state.rig_from_object / size
    mounts = np.zeros((len(state.camera_from_rig), 6, 7))
    mounts[:, :3, 6] = state.mount_position / size
    return poses, mounts, points


def _extent(state: State, on: BoolArray) -> tuple[FloatArray, float]:
    """Return centre and size of points, such as those that take part in the adjustment, (n,)."""
    cloud = state.points[on]
    centre = cloud.sum(axis=0) / len(cloud)
    # root mean square distance from the centre, as in `mean_distance`
    return centre, max(float(np.sqrt(((cloud - centre) ** 2).sum(axis=1).mean())), TINY)


@kernel
def _fill_motions(xyz: FloatArray, centre: FloatArray, size: float, motions: FloatArray) -> None:
    """Fill the `similarity_motions` of points, (n, 3 or more, 7); points without coordinates only shift."""
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
    """Return the coordinates that carry a minimal datum, as indices into the flattened n x 3 coordinates.

    They belong to three points far apart. Pivoting selects them so that B'H is well conditioned.

    Args:
        motions: motions of the flattened coordinates, (3 n, d).
        points: object points, (n, 3).
        on: which points may carry the datum, (n,).
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
    cloud: BoolArray,
) -> FloatArray:
    """Return the effect of the motions on fixed unknowns and observations, one row for each, (rows, 7)."""
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
    for observed_kind in observed:
        point = observed_kind.point
        if point is not None:
            J = observed_kind.kind.linearise(state).J[0]
            moved = J @ points[point]
        else:
            columns, J, _ = reduced_rows(observed_kind, layout, state)
            met = observed_kind.kind.met(state)
            at = H
            if met is not state.points:
                at, kept = H.copy(), np.zeros((len(layout.kept), 3, 7))
                _fill_motions(met[layout.kept], *_extent(state, cloud), kept)
                at[layout.kept_start :] = kept.reshape(-1, 7)
            moved = J @ at[columns]
        rows.append(moved[np.diagonal(observed_kind.weight, axis1=1, axis2=2) > 0])
    return np.concatenate([row.reshape(-1, 7) for row in rows])


def on_sound_points(datum: ResolvedDatum, held: IntArray) -> ResolvedDatum:
    """Return the datum without object points that have held directions, if enough other points carry it.

    Args:
        datum: kind and points.
        held: number of held directions of each object point, (n,).
    """
    if not held.any():
        return datum
    sound = held == 0 if datum.points is None else datum.points & (held == 0)
    return datum._replace(points=sound) if sound.sum() >= MIN_CARRIERS else datum


def leading(vectors: FloatArray) -> BoolArray:
    """Return which unknowns each null vector leaves open, (reduced, e).

    Args:
        vectors: null vectors of the scaled unknowns, (reduced, e).
    """
    size = np.abs(vectors)
    return np.asarray(size >= MIN_LEADING_SHARE * size.max(axis=0, keepdims=True, initial=0.0))


def with_further(
    motions: Motions, further: FloatArray, equations: NormalEquations, layout: Unknowns, datum: ResolvedDatum
) -> Motions:
    """Return the motions with further null vectors and the constraints on them.

    Args:
        motions: null vectors that are motions, with the datum constraints on them.
        further: further null vectors, scaled and orthonormal, (reduced, e).
        equations: normal equations with these null vectors.
        layout: order of the unknowns.
        datum: kind and sound points; constraints on points are inner ones, except in a minimal datum.

    Raises:
        DivergedError: unknowns have become so large that their squares overflow.
    """
    if further.shape[1] == 0 and not equations.held.any():
        return motions
    scale, held = equations.scale[:, None], equations.held
    on = carriers(layout, datum)
    loose = (held > 0) & ~on
    if loose.any():
        points = motions.points.copy()
        points[loose] = _moved_points(motions.reduced, equations, layout)[loose]
        motions = replace(motions, points=points)
    if further.shape[1] == 0:
        return motions
    N = scale * further * layout.reduced_free()[:, None]
    N, moved = motions.transform(N, _moved_points(N, equations, layout))
    whitened = np.swapaxes(equations.lower[on], 1, 2) @ moved[on]
    _, singular, Vt = np.linalg.svd(np.linalg.qr(whitened.reshape(3 * len(whitened), N.shape[1]), mode="r"))
    carried = int((singular > MIN_DATUM_EFFECT).sum())
    N, moved = N @ Vt.T, moved @ Vt.T
    on_points, on_reduced = np.zeros_like(moved), np.zeros_like(N)
    on_points[on, :, :carried] = moved[on, :, :carried]
    on_reduced[:, carried:] = N[:, carried:] / scale**2
    on_points[..., :carried] /= np.sqrt((on_points[..., :carried] ** 2).sum(axis=(0, 1)))
    # N meets the constraints on the motions, so B'H of all columns is block triangular
    try:
        inverse = np.linalg.inv(_product(on_points, on_reduced, moved, N))
    except np.linalg.LinAlgError:
        raise DivergedError(
            "datum: the network has diverged, and nothing fixes what it leaves open"
        ) from None
    across = _product(on_points, on_reduced, motions.points, motions.reduced)
    d, e = len(motions.inverse), len(inverse)
    bordered = np.zeros((d + e, d + e))
    bordered[:d, :d], bordered[d:, d:] = motions.inverse, inverse
    bordered[d:, :d] = -inverse @ across @ motions.inverse
    return replace(
        motions,
        reduced=np.hstack([motions.reduced, N]),
        points=np.concatenate([motions.points, moved], axis=2),
        constraints=np.concatenate([motions.constraints, on_points], axis=2),
        on_reduced=np.hstack([motions.on_reduced, on_reduced]),
        inverse=bordered,
        further=e,
    )


def _moved_points(N: FloatArray, equations: NormalEquations, layout: Unknowns) -> FloatArray:
    """Return the displacements of object points by null vectors N of the reduced unknowns, (n, 3, e)."""
    moved = -solve_transposed(equations.lower, equations.times_reduced(N))
    moved[layout.kept] = N[layout.kept_start :].reshape(len(layout.kept), 3, N.shape[1])
    return moved * layout.point_free[:, :, None]


def _product(
    on_points: FloatArray, on_reduced: FloatArray, points: FloatArray, reduced: FloatArray
) -> FloatArray:
    """Return B'H of constraints and null vectors."""
    return np.asarray(np.einsum("npd,npe->de", on_points, points) + on_reduced.T @ reduced)
