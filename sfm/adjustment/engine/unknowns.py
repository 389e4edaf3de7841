"""The unknowns of an adjustment: which there are, which are free, in what order, and how a step moves them.

The reduced unknowns are [6 per photograph: X0, w | free interior parameters, camera by camera |
3 per kept point]; all other object points are eliminated. Points at the ends of scale bars are kept,
because an observed distance couples two points. Fixed unknowns keep their place with derivatives 0.
A parameter that several cameras share stands in one column, that of the first of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.engine.collinearity import Observations, State, behind_camera
from sfm.adjustment.engine.ordering import by_point, whitening_of
from sfm.adjustment.result import scaled_covariance
from sfm.camera import Camera
from sfm.conventions import BoolArray, FloatArray, IntArray, angles_from_rotation
from sfm.display import counted
from sfm.distortion.models import MAX_PARAMETERS
from sfm.errors import GeometryError
from sfm.kernels.options import compiled
from sfm.kernels.small_algebra import turn
from sfm.network import Estimate, Network

MIN_RAYS = 2  # per object point that is not known otherwise
MIN_COS_PHI = 1e-8  # nearer to +-90 deg omega and kappa have no sigmas of their own
MIN_POINTS = 3  # per photograph whose orientation is not known otherwise


@dataclass(frozen=True)
class Unknowns:
    """Layout of the unknowns of one network and the image points as compiled code takes them."""

    observations: Observations  # image points, grouped by object point
    order: IntArray  # index in network.image_points of each of observations, (k,)
    active: BoolArray  # image points of observations that can take part, (k,)
    exterior_free: BoolArray  # (m, 6)
    interior_free: tuple[IntArray, ...]  # indices of the free parameters of each camera
    interior_column: tuple[IntArray, ...]  # their columns among the reduced unknowns
    point_free: BoolArray  # (n, 3)
    image_on: BoolArray  # photographs that take part, (m,)
    point_on: BoolArray  # object points that take part, (n,)
    kept: IntArray  # object points that stay among the reduced unknowns, (s,)
    bars: IntArray  # scale bars of the network whose ends take part, (b,)
    reduced: int  # number of reduced unknowns, fixed ones included
    held: tuple[str, ...]  # photographs and points held because nothing determines them, in words
    held_defect: int  # rank defect that their unknowns would have had

    @property
    def kept_start(self) -> int:
        """Column of the first kept point among the reduced unknowns."""
        return self.reduced - 3 * len(self.kept)

    @property
    def count(self) -> int:
        """Number of free unknowns."""
        return sum(self.counts)

    @property
    def counts(self) -> tuple[int, int, int]:
        """Numbers of free unknowns: exterior orientation, interior orientation, coordinates of points."""
        interior = self.kept_start - self.exterior_free.size
        return int(self.exterior_free.sum()), interior, int(self.point_free.sum())

    @property
    def all_free(self) -> bool:
        """Whether nothing is fixed or held."""
        return bool(self.exterior_free.all() and self.point_free.all())

    def reduced_free(self) -> BoolArray:
        """Return which of the reduced unknowns are free, (reduced,)."""
        interior = np.ones(self.kept_start - self.exterior_free.size, dtype=bool)
        return np.concatenate([self.exterior_free.ravel(), interior, self.point_free[self.kept].ravel()])


def unknowns_of(
    network: Network,
    estimate: Estimate,
    *,
    use_control: bool,
    image_sigma_factor: FloatArray | None = None,
) -> tuple[Unknowns, State]:
    """Return the layout of the unknowns of a network and the state they start from.

    Args:
        network: what was measured.
        estimate: start values; photographs and points without (NaN) are held out.
        use_control: whether the control points of the network take part.
        image_sigma_factor: on the stated standard deviations of each image point, 1 if not given, (k,).

    Raises:
        GeometryError: no image point can take part.
    """
    k = network.image_points
    m, n = len(network.images), len(network.points)
    exterior_free, exterior_known = np.ones((m, 6), dtype=bool), np.zeros((m, 6), dtype=bool)
    point_free, point_known = np.ones((n, 3), dtype=bool), np.zeros((n, 3), dtype=bool)
    position, rotation, points = estimate.position.copy(), estimate.rotation, estimate.points.copy()

    if use_control and len(network.control):
        control = network.control
        variance = np.diagonal(control.covariance, axis1=1, axis2=2)
        point_free[control.point] = variance > 0
        point_known[control.point] = np.isfinite(variance)
        value = points[control.point]
        points[control.point] = np.where((variance == 0) | ~np.isfinite(value), control.xyz, value)
    if len(network.exterior):
        variance = np.diagonal(network.exterior.covariance, axis1=1, axis2=2)
        exterior_free[network.exterior.image] = variance > 0
        exterior_known[network.exterior.image] = np.isfinite(variance)

    start = replace(estimate, position=position, points=points)
    active, seen, rays, held, held_defect = _hold_undetermined(
        network, start, exterior_free, exterior_known, point_free, point_known
    )
    if not seen.any():
        raise GeometryError("adjustment: no image point joins an oriented photograph and a determined point")

    interior_free = tuple(np.flatnonzero(camera.free) for camera in estimate.cameras)
    counts = np.array([len(free) for free in interior_free], dtype=np.int64)
    image_on, point_on = seen > 0, rays > 0
    used = np.bincount(network.camera[image_on], minlength=len(counts)) > 0
    interior_free = tuple(f if u else f[:0] for f, u in zip(interior_free, used, strict=True))
    counts = np.where(used, counts, 0)
    free_index = np.zeros((len(counts), MAX_PARAMETERS), dtype=np.int64)
    free_column = np.zeros_like(free_index)
    columns, interior = _interior_columns(estimate.cameras, interior_free, 6 * m)
    for a, (free, column) in enumerate(zip(interior_free, columns, strict=True)):
        free_index[a, : len(free)] = free
        free_column[a, : len(free)] = column
    bars = np.flatnonzero(point_on[network.scale_bars.start] & point_on[network.scale_bars.end])
    ends = np.concatenate([network.scale_bars.start[bars], network.scale_bars.end[bars]])
    kept = np.unique(ends).astype(np.int64) if len(ends) else np.zeros(0, dtype=np.int64)

    order, rays_from = by_point(k, m, n)
    covariance = k.covariance
    if image_sigma_factor is not None:
        covariance = scaled_covariance(covariance, image_sigma_factor)
    observations = Observations(
        start=rays_from,
        image=np.take(k.image, order).astype(np.int64, copy=False),
        point=np.repeat(np.arange(n), np.diff(rays_from)),
        xy=np.take(k.xy, order, axis=0).astype(float, copy=False),
        whitening=whitening_of(covariance, order),
        camera=np.ascontiguousarray(network.camera, dtype=np.int64),
        model=np.array([camera.index for camera in estimate.cameras], dtype=np.int64),
        frame=np.array([camera.frame for camera in estimate.cameras]),
        interior=np.where(counts > 0, [len(camera.names) for camera in estimate.cameras], 0),
        free_count=counts,
        free_index=free_index,
        free_column=free_column,
    )
    layout = Unknowns(
        observations=observations,
        order=order,
        active=active[order],
        exterior_free=exterior_free,
        interior_free=interior_free,
        interior_column=columns,
        point_free=point_free,
        image_on=image_on,
        point_on=point_on,
        kept=kept,
        bars=bars,
        reduced=6 * m + interior + 3 * len(kept),
        held=held,
        held_defect=held_defect,
    )
    parameters = np.zeros((len(estimate.cameras), MAX_PARAMETERS))
    for a, camera in enumerate(estimate.cameras):
        parameters[a, : len(camera.parameters)] = camera.parameters
    M = np.ascontiguousarray(np.swapaxes(rotation, 1, 2))
    return layout, State(position, M, parameters, points)


def step(layout: Unknowns, state: State, reduced: FloatArray, points: FloatArray) -> State:
    """Return the state moved by a step.

    Args:
        layout: order of the unknowns.
        state: where the step starts.
        reduced: step of the reduced unknowns, shape (reduced,).
        points: step of the object points, kept ones included, shape (n, 3).
    """
    m = len(state.position)
    exterior = reduced[: 6 * m].reshape(m, 6)
    M, parameters = np.empty_like(state.M), state.parameters.copy()
    _turn(state.M, exterior, M)
    for a, (free, column) in enumerate(zip(layout.interior_free, layout.interior_column, strict=True)):
        parameters[a, free] += reduced[column]
    return State(
        state.position + exterior[:, :3],
        M,
        parameters,
        state.points + points,
    )


@compiled
def _turn(M: FloatArray, exterior: FloatArray, turned: FloatArray) -> None:
    """Fill turned (m, 3, 3) = exp(-[w]x) M, the inverse of R exp([w]x), with the steps (m, 6) of X0, w."""
    for i in range(len(M)):
        turn(M[i].T, exterior[i, 3], exterior[i, 4], exterior[i, 5], turned[i].T)


def estimate_of(state: State, estimate: Estimate) -> Estimate:
    """Return an estimate of the values of a state; cameras keep their names and models."""
    cameras = tuple(
        camera.with_parameters(state.parameters[a, : len(camera.parameters)])
        for a, camera in enumerate(estimate.cameras)
    )
    return Estimate(cameras, state.position, np.swapaxes(state.M, 1, 2).copy(), state.points)


def angle_jacobian(M: FloatArray) -> FloatArray:
    """Return d (omega, phi, kappa) / d w of small rotations in the image axes, R <- R exp([w]x).

    Args:
        M: object to image axes, shape (m, 3, 3).

    Returns:
        Derivatives, shape (m, 3, 3); huge where phi is near +-90 deg and omega is not separable.
    """
    _, phi, kappa = np.moveaxis(angles_from_rotation(np.swapaxes(M, 1, 2)), -1, 0)
    sk, ck = np.sin(kappa), np.cos(kappa)
    cos_phi = np.maximum(np.cos(phi), MIN_COS_PHI)
    T = np.zeros(M.shape)
    T[:, 0, 0], T[:, 0, 1] = ck / cos_phi, -sk / cos_phi
    T[:, 1, 0], T[:, 1, 1] = sk, ck
    T[:, 2, :2] = -np.sin(phi)[:, None] * T[:, 0, :2]
    T[:, 2, 2] = 1.0
    return T


def exterior_jacobian(M: FloatArray) -> FloatArray:
    """Return d (X0, omega, phi, kappa) / d (X0, w), see `angle_jacobian`, (m, 6, 6)."""
    J = np.zeros((len(M), 6, 6))
    J[:, :3, :3] = np.eye(3)
    J[:, 3:, 3:] = angle_jacobian(M)
    return J


def start_weights(layout: Unknowns, state: State) -> FloatArray:
    """Return weight 1 for image points that can take part, 0 for others and those behind the camera, (k,)."""
    return (layout.active & ~behind_camera(layout.observations, state)).astype(float)


def interior_names(layout: Unknowns, estimate: Estimate) -> list[tuple[str, str]]:
    """Return (parameter, camera or group of cameras) of each interior unknown, in order of columns."""
    names = [("", "")] * (layout.kept_start - layout.exterior_free.size)
    for camera, free, columns in zip(
        estimate.cameras, layout.interior_free, layout.interior_column, strict=True
    ):
        for s, column in zip(free, columns, strict=True):
            owner = camera.owner_of(s)
            names[column - layout.exterior_free.size] = (camera.names[s], f"camera {owner}")
    return names


def _interior_columns(
    cameras: tuple[Camera, ...], interior_free: tuple[IntArray, ...], first: int
) -> tuple[tuple[IntArray, ...], int]:
    """Return the column of each free parameter of each camera, from the first on, and how many there are.

    Raises:
        GeometryError: cameras that share a parameter start from different values of it.
    """
    seen: dict[tuple[str, str], tuple[int, Camera, float]] = {}
    columns, count = [], 0
    for camera, free in zip(cameras, interior_free, strict=True):
        own = np.empty(len(free), dtype=np.int64)
        for k, s in enumerate(free):
            group, value = camera.group_of(s), float(camera.parameters[s])
            known = seen.get((group, camera.names[s])) if group else None
            if known is None:
                known = (first + count, camera, value)
                count += 1
                if group:
                    seen[group, camera.names[s]] = known
            elif known[2] != value:
                raise GeometryError(
                    f"cameras {known[1].name} and {camera.name} share {camera.names[s]}, but start from "
                    f"{known[2]:g} and {value:g}; one value is needed"
                )
            own[k] = known[0]
        columns.append(own)
    return tuple(columns), count


def _hold_undetermined(
    network: Network,
    estimate: Estimate,
    exterior_free: BoolArray,
    exterior_known: BoolArray,
    point_free: BoolArray,
    point_known: BoolArray,
) -> tuple[BoolArray, IntArray, IntArray, tuple[str, ...], int]:
    """Hold photographs and points with too few image points, until none is left; clears their free flags.

    Returns which image points take part, how many of each photograph and of each point, who is held, in
    words, and the rank defect that these would have had.
    """
    k = network.image_points
    m, n = len(network.images), len(network.points)
    image_on, point_on = estimate.oriented.copy(), estimate.determined.copy()
    held = [f"photograph {network.images[i]}: no start value" for i in np.flatnonzero(~image_on)]
    held += [f"point {network.points[j]}: no start value" for j in np.flatnonzero(~point_on)]
    needs_points = exterior_free.any(axis=1) & ~exterior_known.all(axis=1)
    needs_rays = point_free.any(axis=1) & ~point_known.all(axis=1)
    defect = 0
    while True:
        active = image_on[k.image] & point_on[k.point]
        every = bool(active.all())
        seen = np.bincount(k.image if every else k.image[active], minlength=m)
        rays = np.bincount(k.point if every else k.point[active], minlength=n)
        lost_points = point_on & needs_rays & (rays < MIN_RAYS)
        lost_images = image_on & needs_points & (seen < MIN_POINTS)
        if not (lost_points.any() or lost_images.any()):
            break
        held += [
            f"point {network.points[j]}: {counted(rays[j], 'ray')}, {MIN_RAYS} are needed"
            for j in np.flatnonzero(lost_points)
        ]
        held += [
            f"photograph {network.images[i]}: {counted(seen[i], 'point')}, {MIN_POINTS} are needed"
            for i in np.flatnonzero(lost_images)
        ]
        defect += int((3 - 2 * rays[lost_points]).sum() + (6 - 2 * seen[lost_images]).sum())
        point_on &= ~lost_points
        image_on &= ~lost_images
    exterior_free[~image_on] = False
    point_free[~point_on] = False
    return active, seen, rays, tuple(held), defect
