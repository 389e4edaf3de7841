"""Layout of the unknowns of an adjustment: their order, which of them are free, and how a step changes them.

The reduced unknowns are blocks: [6 per pose: X0, w | free interior parameters, camera by camera | free
parts of mounts, camera by camera | 3 per kept point]. All other object points are eliminated. A pose belongs
to a photograph, or to a rig at one moment; `photograph_terms` relates the orientation of a photograph to the
unknowns in both cases. Points that observations couple with other unknowns are kept, for example the ends of
scale bars. Fixed unknowns keep their columns, with derivatives 0. A parameter shared by several cameras has
one column, that of the first camera.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from sfm.adjustment.engine.collinearity import CAMERA_UNKNOWNS, Observations, State, behind_camera
from sfm.adjustment.engine.ordering import by_point, whitening_of
from sfm.model.camera import Camera
from sfm.model.conventions import BoolArray, FloatArray, IntArray, skew
from sfm.model.display import counted
from sfm.model.distortion.models import MAX_PARAMETERS
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate, Mounts
from sfm.model.network import Network
from sfm.model.observations.kind import POINT
from sfm.model.observations.pose import exterior_jacobian
from sfm.runtime.compiling import compiled
from sfm.runtime.small_algebra import turn

NO_START = ": no start value"  # behind the names of photographs and points that take no part
MIN_RAYS = 2  # fewest rays of an object point that nothing else determines
MIN_POINTS = 3  # fewest points of a pose that nothing else determines
MOUNT_PARTS = ("X", "Y", "Z", "x rotation", "y rotation", "z rotation")


@dataclass(frozen=True)
class Unknowns:
    """Layout of the unknowns of a network, with the image points in the form that compiled code uses."""

    observations: Observations  # image points, grouped by object point
    order: IntArray  # index in network.image_points of each image point of `observations`, (k,)
    active: BoolArray  # image points of `observations` that can take part, (k,)
    pose_free: BoolArray  # which unknowns of each pose are free, (poses, 6)
    interior_free: tuple[IntArray, ...]  # indices of the free parameters of each camera
    interior_column: tuple[IntArray, ...]  # their columns among the reduced unknowns
    mount_column: IntArray  # columns of X, w of the mount of each camera, -1 where not free, (a, 6)
    point_free: BoolArray  # which coordinates of each object point are free, (n, 3)
    image_on: BoolArray  # photographs that take part, (m,)
    point_on: BoolArray  # object points that take part, (n,)
    kept: IntArray  # object points that stay among the reduced unknowns, (s,)
    reduced: int  # number of reduced unknowns, including fixed ones
    held: tuple[str, ...]  # photographs and points held because nothing determines them, in words
    held_defect: int  # rank defect that their unknowns would have caused

    @property
    def kept_start(self) -> int:
        """Column of the first kept point among the reduced unknowns."""
        return self.reduced - 3 * len(self.kept)

    @property
    def rigged(self) -> bool:
        """Whether photographs share poses."""
        return bool(self.observations.mounted.any())

    @property
    def count(self) -> int:
        """Number of free unknowns."""
        return sum(self.counts)

    @property
    def counts(self) -> tuple[int, int, int]:
        """Numbers of free unknowns of poses and mounts, interior orientation, and points."""
        mounts = int((self.mount_column >= 0).sum())
        interior = self.kept_start - self.pose_free.size - mounts
        return int(self.pose_free.sum()) + mounts, interior, int(self.point_free.sum())

    @property
    def all_free(self) -> bool:
        """Whether all unknowns are free and there are no rigs."""
        return bool(self.pose_free.all() and self.point_free.all()) and not self.rigged

    def reduced_free(self) -> BoolArray:
        """Return which reduced unknowns are free, (reduced,)."""
        interior = np.ones(self.kept_start - self.pose_free.size, dtype=bool)
        return np.concatenate([self.pose_free.ravel(), interior, self.point_free[self.kept].ravel()])

    def photograph_terms(self, state: State, images: IntArray) -> tuple[IntArray, FloatArray]:
        """Return the unknowns of the exterior orientation of photographs, and its derivatives by them.

        Args:
            state: values of all unknowns.
            images: indices of photographs, (e,).

        Returns:
            Columns among the reduced unknowns, (e, u), and d (X0, w) / d unknowns, (e, 6, u), 0 for fixed
            unknowns. Without rigs the unknowns are X0, w themselves.
        """
        o, e = self.observations, len(images)
        pose = o.pose_of[images]
        columns: IntArray = 6 * pose[:, None] + np.arange(6)
        J = np.zeros((e, 6, 12 if self.rigged else 6))
        J[:, :, :6] = np.eye(6)
        if self.rigged:
            a = o.camera[images]
            R = np.swapaxes(state.rig_from_object[pose], 1, 2)
            J[:, :3, 3:6] = -R @ skew(state.mount_position[a])
            J[:, 3:, 3:6] = state.camera_from_rig[a]
            of_mount = self.mount_column[a]
            J[:, :3, 6:9], J[:, 3:, 9:] = R, np.eye(3)
            J[:, :, 6:] *= (of_mount >= 0)[:, None]
            columns = np.concatenate([columns, np.maximum(of_mount, 0)], axis=1)
        J[:, :, :6] *= self.pose_free[pose][:, None]
        return columns, J

    def rig_terms(self, state: State) -> tuple[IntArray, FloatArray]:
        """Return the unknowns that photographs of rigs share, and the derivatives of their parameters.

        Args:
            state: values of all unknowns.

        Returns:
            Columns among the reduced unknowns of the free interior parameters of all cameras and then of all
            mounts, (s,). Derivatives of these parameters and of X, Y, Z, omega, phi, kappa of each mount by
            the unknowns, 0 for fixed ones, (s, s). Both are empty without rigs.
        """
        if not self.rigged:
            return np.zeros(0, dtype=np.int64), np.zeros((0, 0))
        free = self.mount_column >= 0
        interior = np.concatenate(self.interior_column)
        mounts = exterior_jacobian(state.camera_from_rig) * free[:, None]
        columns = np.concatenate([interior, np.maximum(self.mount_column, 0).ravel()])
        return columns.astype(np.int64), block_diag(np.eye(len(interior)), *mounts)


def unknowns_of(
    network: Network,
    estimate: Estimate,
    *,
    use_control: bool,
    image_sigma_factor: FloatArray | None = None,
) -> tuple[Unknowns, State]:
    """Return the layout of the unknowns of a network and their start values.

    Args:
        network: the measurements.
        estimate: start values; photographs and points without start values (NaN) take no part.
        use_control: whether the control points of the network take part.
        image_sigma_factor: factor on the stated standard deviations of each image point, 1 if not given,
            (k,).

    Raises:
        GeometryError: no image point can take part.
    """
    k = network.image_points
    m, n = len(network.images), len(network.points)
    pose_of, poses, mounts, mounted = _rigs_of(network, estimate)
    pose_free, pose_known = np.ones((poses, 6), dtype=bool), np.zeros(poses, dtype=bool)
    point_free, point_known = np.ones((n, 3), dtype=bool), np.zeros((n, 3), dtype=bool)
    points = estimate.points.copy()

    if use_control and len(network.control):
        control = network.control
        variance = np.diagonal(control.covariance, axis1=1, axis2=2)
        point_free[control.point] = variance > 0
        point_known[control.point] = np.isfinite(variance)
        value = points[control.point]
        points[control.point] = np.where((variance == 0) | ~np.isfinite(value), control.xyz, value)
    if len(network.exterior):
        variance = np.diagonal(network.exterior.covariance, axis1=1, axis2=2)
        image, fixed = network.exterior.image, (variance == 0).any(axis=1)
        of_rig = image[fixed & mounted[network.camera[image]]]
        if len(of_rig):
            raise GeometryError(
                f"photograph {network.images[of_rig[0]]}: its exterior orientation is fixed, expected "
                "standard deviations, as its camera is mounted on a rig"
            )
        free = np.ones((m, 6), dtype=bool)
        free[image] = variance > 0
        np.logical_and.at(pose_free, pose_of, free)
        pose_known[pose_of[image[np.isfinite(variance).all(axis=1)]]] = True

    start = replace(estimate, points=points)
    active, seen, rays, held, held_defect = _hold_undetermined(
        network, start, pose_of, pose_free, pose_known, point_free, point_known
    )
    if not seen.any():
        raise GeometryError("adjustment: no image point joins an oriented photograph and a determined point")

    interior_free = tuple(np.flatnonzero(camera.free) for camera in estimate.cameras)
    counts = np.array([len(free) for free in interior_free], dtype=np.int64)
    image_on, point_on = seen > 0, rays > 0
    used = np.bincount(network.camera[image_on], minlength=len(counts)) > 0
    interior_free = tuple(f if u else f[:0] for f, u in zip(interior_free, used, strict=True))
    counts = np.where(used, counts, 0)
    free_index = np.zeros((len(counts), CAMERA_UNKNOWNS), dtype=np.int64)
    free_column = np.zeros_like(free_index)
    columns, interior = _interior_columns(estimate.cameras, interior_free, 6 * poses)
    mount_free = mounts.free & (mounted & used)[:, None]
    mount_column: IntArray = np.full(mount_free.shape, -1)
    mount_unknowns = int(mount_free.sum())
    mount_column[mount_free] = 6 * poses + interior + np.arange(mount_unknowns)
    interior += mount_unknowns
    has_interior = counts > 0
    for a, (free_ones, column) in enumerate(zip(interior_free, columns, strict=True)):
        of_mount = np.flatnonzero(mount_free[a])
        counts[a] += len(of_mount)
        free_index[a, : counts[a]] = np.concatenate([free_ones, MAX_PARAMETERS + of_mount])
        free_column[a, : counts[a]] = np.concatenate([column, mount_column[a, of_mount]])
    kept = _coupled_points(network, point_on)

    order, rays_from = by_point(k.image, k.point, pose_of, n)
    covariance = k.covariance
    if image_sigma_factor is not None:
        covariance = scaled_covariance(covariance, image_sigma_factor)
    observations = Observations(
        start=rays_from,
        image=np.take(k.image, order).astype(np.int64, copy=False),
        point=np.repeat(np.arange(n), np.diff(rays_from)),
        xy=np.take(k.xy, order, axis=0).astype(float, copy=False),
        whitening=whitening_of(covariance, order),
        share=np.take(network.share, order),
        camera=np.ascontiguousarray(network.camera, dtype=np.int64),
        pose=pose_of[np.take(k.image, order)],
        pose_of=pose_of,
        poses=poses,
        mounted=mounted,
        model=np.array([camera.index for camera in estimate.cameras], dtype=np.int64),
        frame=np.array([camera.frame for camera in estimate.cameras]),
        interior=np.where(has_interior, [len(camera.names) for camera in estimate.cameras], 0),
        free_count=counts,
        free_index=free_index,
        free_column=free_column,
    )
    layout = Unknowns(
        observations=observations,
        order=order,
        active=active[order],
        pose_free=pose_free,
        interior_free=interior_free,
        interior_column=columns,
        mount_column=mount_column,
        point_free=point_free,
        image_on=image_on,
        point_on=point_on,
        kept=kept,
        reduced=6 * poses + interior + 3 * len(kept),
        held=held,
        held_defect=held_defect,
    )
    parameters = np.zeros((len(estimate.cameras), MAX_PARAMETERS))
    for a, camera in enumerate(estimate.cameras):
        parameters[a, : len(camera.parameters)] = camera.parameters
    return layout, _start_state(estimate, layout.observations, mounts, parameters, points)


def step(layout: Unknowns, state: State, reduced: FloatArray, points: FloatArray) -> State:
    """Return the state after a step.

    Args:
        layout: order of the unknowns.
        state: values of all unknowns before the step.
        reduced: step of the reduced unknowns, shape (reduced,).
        points: step of the object points, including kept ones, shape (n, 3).
    """
    poses = len(state.rig_from_object)
    moved = reduced[: 6 * poses].reshape(poses, 6)
    M, parameters = np.empty_like(state.rig_from_object), state.parameters.copy()
    _turn(state.rig_from_object, moved, M)
    for a, (free, column) in enumerate(zip(layout.interior_free, layout.interior_column, strict=True)):
        parameters[a, free] += reduced[column]
    position = state.pose_position + moved[:, :3]
    if not layout.rigged:
        return State(
            position,
            M,
            parameters,
            state.points + points,
            position,
            M,
            state.mount_position,
            state.camera_from_rig,
        )
    column = layout.mount_column
    of_mounts = np.where(column >= 0, reduced[column], 0.0)
    camera_from_rig = np.empty_like(state.camera_from_rig)
    _turn(state.camera_from_rig, of_mounts, camera_from_rig)
    return _derived(
        layout.observations,
        parameters,
        state.points + points,
        (position, M),
        (state.mount_position + of_mounts[:, :3], camera_from_rig),
    )


@compiled
def _turn(M: FloatArray, exterior: FloatArray, turned: FloatArray) -> None:
    """Fill `turned` with exp(-[w]x) M, the inverse of R exp([w]x), (m, 3, 3), from steps of X0, w, (m, 6)."""
    for i in range(len(M)):
        turn(M[i].T, exterior[i, 3], exterior[i, 4], exterior[i, 5], turned[i].T)


def estimate_of(state: State, estimate: Estimate) -> Estimate:
    """Return the values of a state as an estimate.

    Args:
        state: values of all unknowns.
        estimate: estimate with the names and models of the cameras.
    """
    cameras = tuple(
        camera.with_parameters(state.parameters[a, : len(camera.parameters)])
        for a, camera in enumerate(estimate.cameras)
    )
    mounts = estimate.mounts
    if mounts is not None:
        rotation = np.swapaxes(state.camera_from_rig, 1, 2).copy()
        mounts = replace(mounts, position=state.mount_position, rotation=rotation)
    return Estimate(cameras, state.position, np.swapaxes(state.M, 1, 2).copy(), state.points, mounts)


def start_weights(layout: Unknowns, state: State) -> FloatArray:
    """Return weight 1 for image points that can take part and are in front of the camera, else 0, (k,).

    Args:
        layout: order of the unknowns.
        state: values of all unknowns.
    """
    return (layout.active & ~behind_camera(layout.observations, state)).astype(float)


def interior_names(layout: Unknowns, estimate: Estimate) -> list[tuple[str, str]]:
    """Return (parameter, camera or group of cameras) of each interior or mount unknown, in order of columns.

    Args:
        layout: order of the unknowns.
        estimate: estimate with the cameras.
    """
    first = layout.pose_free.size
    names = [("", "")] * (layout.kept_start - first)
    for camera, free, columns in zip(
        estimate.cameras, layout.interior_free, layout.interior_column, strict=True
    ):
        for s, column in zip(free, columns, strict=True):
            owner = camera.owner_of(s)
            names[column - first] = (camera.names[s], f"camera {owner}")
    for camera, columns in zip(estimate.cameras, layout.mount_column, strict=True):
        for part, column in zip(MOUNT_PARTS, columns, strict=True):
            if column >= 0:
                names[column - first] = (part, f"mount of camera {camera.name}")
    return names


def _interior_columns(
    cameras: tuple[Camera, ...], interior_free: tuple[IntArray, ...], first: int
) -> tuple[tuple[IntArray, ...], int]:
    """Return the column of each free parameter of each camera, starting at `first`, and their number.

    Raises:
        GeometryError: cameras that share a parameter have different start values for it.
    """
    seen: dict[tuple[str, str], tuple[int, Camera, float]] = {}
    columns, count = [], 0
    for camera, free in zip(cameras, interior_free, strict=True):
        of_camera = np.empty(len(free), dtype=np.int64)
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
            of_camera[k] = known[0]
        columns.append(of_camera)
    return tuple(columns), count


def _hold_undetermined(
    network: Network,
    estimate: Estimate,
    pose_of: IntArray,
    pose_free: BoolArray,
    pose_known: BoolArray,
    point_free: BoolArray,
    point_known: BoolArray,
) -> tuple[BoolArray, IntArray, IntArray, tuple[str, ...], int]:
    """Hold poses and points with too few image points, repeatedly until none is left; clear their free flags.

    Return which image points take part, and their number for each photograph's pose and for each point. Also
    return the held photographs and points in words, and the rank defect that they would have caused.
    """
    k = network.image_points
    n, poses = len(network.points), len(pose_free)
    pose_on = np.bincount(pose_of[estimate.oriented], minlength=poses) > 0
    point_on, pose = estimate.determined.copy(), pose_of[k.image]
    held = [f"photograph {network.images[i]}{NO_START}" for i in np.flatnonzero(~pose_on[pose_of])]
    held += [f"point {network.points[j]}{NO_START}" for j in np.flatnonzero(~point_on)]
    needs_points = pose_free.any(axis=1) & ~pose_known
    needs_rays = point_free.any(axis=1) & ~point_known.all(axis=1)
    defect = int(pose_free[~pose_on].sum() + point_free[~point_on].sum())
    while True:
        active = pose_on[pose] & point_on[k.point]
        every = bool(active.all())
        seen = np.bincount(pose if every else pose[active], minlength=poses)
        rays = np.bincount(k.point if every else k.point[active], minlength=n)
        lost_points = point_on & needs_rays & (rays < MIN_RAYS)
        lost_poses = pose_on & needs_points & (seen < MIN_POINTS)
        if not (lost_points.any() or lost_poses.any()):
            break
        held += [
            f"point {network.points[j]}: {counted(rays[j], 'ray')}, {MIN_RAYS} are needed"
            for j in np.flatnonzero(lost_points)
        ]
        held += [
            f"photograph {network.images[i]}: {counted(seen[pose_of[i]], 'point')}, {MIN_POINTS} are needed"
            for i in np.flatnonzero(lost_poses[pose_of])
        ]
        defect += int((3 - 2 * rays[lost_points]).sum() + (6 - 2 * seen[lost_poses]).sum())
        point_on &= ~lost_points
        pose_on &= ~lost_poses
    pose_free[~pose_on] = False
    point_free[~point_on] = False
    return active, seen[pose_of], rays, tuple(held), defect


def _coupled_points(network: Network, point_on: BoolArray) -> IntArray:
    """Return the points that take part and that observations couple with other unknowns, (s,)."""
    coupled = [np.zeros(0, dtype=np.int64)]
    for kind in network.observations:
        blocks = kind.blocks()
        if len(kind) and len(blocks) > 1:
            of_points = [block.at for block in blocks if block.of == POINT]
            on = np.logical_and.reduce([point_on[index] for index in of_points])
            coupled += [index[on] for index in of_points]
    return np.unique(np.concatenate(coupled))


def _rigs_of(network: Network, estimate: Estimate) -> tuple[IntArray, int, Mounts, BoolArray]:
    """Return the pose of each photograph, the number of poses, the mounts, and cameras off the reference.

    Raises:
        GeometryError: photographs of one moment have cameras that are not on one rig.
    """
    m, a = len(network.images), len(estimate.cameras)
    mounts = estimate.mounts
    if network.moment is None or mounts is None or not any(mounts.rig):
        nowhere = Mounts(
            np.zeros((a, 3)), np.tile(np.eye(3), (a, 1, 1)), np.zeros((a, 6), dtype=bool), ("",) * a
        )
        return np.arange(m), m, nowhere, np.zeros(a, dtype=bool)
    moments, pose_of = np.unique(network.moment, return_inverse=True)
    single = np.array([not rig for rig in mounts.rig])[network.camera]
    rigs = np.unique(np.array(mounts.rig), return_inverse=True)[1][network.camera]
    shared = np.bincount(pose_of)[pose_of] > 1
    other = rigs != rigs[np.unique(pose_of, return_index=True)[1]][pose_of]
    for i in np.flatnonzero(shared & (single | other)):
        raise GeometryError(
            f"photograph {network.images[i]}: its moment is that of others, expected those of one rig only"
        )
    at_reference = (mounts.position == 0).all(axis=1) & (mounts.rotation == np.eye(3)).all(axis=(1, 2))
    return pose_of.astype(np.int64), len(moments), mounts, ~at_reference | mounts.free.any(axis=1)


def _start_state(
    estimate: Estimate, o: Observations, mounts: Mounts, parameters: FloatArray, points: FloatArray
) -> State:
    """Return the state of the start values; a rig takes the pose of its first oriented photograph."""
    M = np.ascontiguousarray(np.swapaxes(estimate.rotation, 1, 2))
    position, camera_from_rig = (
        estimate.position.copy(),
        np.ascontiguousarray(np.swapaxes(mounts.rotation, 1, 2)),
    )
    if not o.mounted.any():
        return State(position, M, parameters, points, position, M, mounts.position, camera_from_rig)
    first = np.full(o.poses, len(position), dtype=np.int64)
    oriented = np.flatnonzero(estimate.oriented)
    # the reference camera first
    order = oriented[np.argsort(o.mounted[o.camera[oriented]], kind="stable")]
    first[o.pose_of[order[::-1]]] = order[::-1]
    known = np.flatnonzero(first < len(position))
    pose_position, rig_from_object = np.full((o.poses, 3), np.nan), np.full((o.poses, 3, 3), np.nan)
    i = first[known]
    a = o.camera[i]
    rig_from_object[known] = mounts.rotation[a] @ M[i]
    away = np.einsum("pba,pb->pa", rig_from_object[known], mounts.position[a])
    pose_position[known] = position[i] - away
    return _derived(
        o, parameters, points, (pose_position, rig_from_object), (mounts.position, camera_from_rig)
    )


def _derived(
    o: Observations,
    parameters: FloatArray,
    points: FloatArray,
    poses: tuple[FloatArray, FloatArray],
    mounts: tuple[FloatArray, FloatArray],
) -> State:
    """Return the state with the orientation of each photograph computed from its pose and mount."""
    (pose_position, rig_from_object), (mount_position, camera_from_rig) = poses, mounts
    at = rig_from_object[o.pose_of]
    position = pose_position[o.pose_of] + np.einsum("mba,mb->ma", at, mount_position[o.camera])
    M = np.ascontiguousarray(camera_from_rig[o.camera] @ at)
    return State(
        position, M, parameters, points, pose_position, rig_from_object, mount_position, camera_from_rig
    )


def scaled_covariance(covariance: FloatArray, sigma_factor: FloatArray) -> FloatArray:
    """Return covariances after multiplying standard deviations by a factor.

    Args:
        covariance: covariances, (k, 2, 2).
        sigma_factor: factor on the standard deviations of each, (k,).
    """
    return np.asarray(covariance * sigma_factor[:, None, None] ** 2)
