"""The next photographs of a calibration: the poses that make the worst corner of the format known best.

Candidates are a grid of views of the object: tilted about both axes of the image and rolled or not, near and
far as in the photographs so far, with the object in the middle, at the sides and in the corners of the
format. A candidate shows at least as many points as every photograph so far, since a board without tags is
read only as a whole. They keep half the distance of their neighbours from the border, or the least distance
at which a point was measured so far. The image points of a candidate, its own unknown pose eliminated, add to
the information on interior orientation and object points:

    Qxx' = Qxx - Qxx A' (I + A Qxx A')^-1 A Qxx

for the whitened derivatives A. The candidate that lowers the largest sigma of projection in the corners most
is taken, and the next one is sought with it among the others.

Source: Foerstner, Wrobel (2016), sec. 4.2.7 (update of a covariance); Fedorov (1972), Theory of Optimal
Experiments (greedy design); Fraser (1997), ISPRS J. Photogramm. Remote Sens. 52(4) (views of a calibration).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.spatial import cKDTree

from sfm.adjustment.covariance import marginal_of
from sfm.adjustment.quality.correlations import observed_part
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import predict
from sfm.model.arguments import checked_arguments
from sfm.model.camera import (
    Camera,
    outermost_reached,
    parameter_jacobian,
    project,
    ray_jacobian,
    rays_from_pixel,
)
from sfm.model.conventions import FloatArray, IntArray, rotation_from_angles, skew
from sfm.model.network import ImagePoints
from sfm.products.calibration.projection import (
    ProjectionUncertainty,
    grid_of,
    projection_uncertainty,
)
from sfm.runtime.threads import own_threads

# About the axes of the image; together 41 degrees. Plates are photographed from 20 to 40 degrees off their
# normal, see docs/how-to/calibrate-a-camera.md.
TILTS_DEG = (-30.0, 0.0, 30.0)
PLACES = (1 / 6, 1 / 2, 5 / 6)  # of the middle of the object, in widths and heights of the format
ROLLS_DEG = (0.0, 90.0)
MAX_POINTS = 60  # of the object in the search; the weights of the others are theirs


@dataclass(frozen=True)
class Pose:
    """A photograph to take next."""

    position: FloatArray  # projection centre, object unit, (3,)
    rotation: FloatArray  # R, image to object axes, (3, 3)
    tilt_deg: tuple[float, float]  # about the x and y axes of the image
    roll_deg: float
    place: tuple[float, float]  # of the middle of the object, in widths and heights of the format
    distance: float  # of the middle of the object, object unit
    xy: FloatArray  # image points of the object, px; NaN where not seen, (n, 2)


@dataclass(frozen=True)
class NextPoses:
    """The next photographs of a camera, with sigma of projection at infinity in the worst corner."""

    camera: str
    poses: tuple[Pose, ...]
    before: float  # of the photographs so far, px
    after: tuple[float, ...]  # with the first pose, with the first two, and so on, px


@checked_arguments()
def next_poses(adjustment: Adjustment, camera: int = 0, count: int = 3) -> NextPoses:
    """Return the poses of a camera that lower the sigma of projection of its worst corner most.

    Args:
        adjustment: finished, with its covariance.
        camera: index of the camera.
        count: number of poses.

    Example:
        >>> from sfm.products.calibration import next_poses
        >>> further = next_poses(result.adjustment, count=1)
        >>> len(further.poses), further.after[0] < further.before
        (1, True)
    """
    lens = adjustment.estimate.cameras[camera]
    seen = adjustment.network.image_points.select(~adjustment.rejected)
    corners = corners_of(lens, seen.xy[adjustment.network.camera[seen.image] == camera])
    before = worst_corner(adjustment, camera, corners)
    if not np.isfinite(before) or not lens.free.any():
        return NextPoses(lens.name, (), before, ())
    taken = _chosen(adjustment, camera, corners, list(candidates(adjustment, camera)), count)
    after = []
    for number in range(1, len(taken) + 1):
        planned = with_poses(adjustment, camera, taken[:number])
        after.append(worst_corner(planned, camera, corners))
    return NextPoses(lens.name, tuple(taken), before, tuple(after))


def corners_of(camera: Camera, seen: FloatArray) -> FloatArray:
    """Return the corners of the format, or the places nearest to them that the camera reaches, px, (4, 2).

    Args:
        camera: interior orientation.
        seen: its image points, px, (k, 2); see `within_reach`.
    """
    corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * (np.array(camera.size_px) - 1.0)
    return outermost_reached(camera, corners, seen)


def worst_corner(adjustment: Adjustment, camera: int, corners: FloatArray) -> float:
    """Return the largest sigma of projection at infinity, RMS of both coordinates, px.

    Args:
        adjustment: finished, with its covariance.
        camera: index of the camera.
        corners: places, px, (4, 2).
    """
    return float(projection_uncertainty(adjustment, camera).sigma_at(corners, np.inf).max())


def candidates(adjustment: Adjustment, camera: int) -> Iterator[Pose]:
    """Yield the views that may be photographed next.

    Args:
        adjustment: finished.
        camera: index of the camera.
    """
    network, estimate = adjustment.network, adjustment.estimate
    lens = estimate.cameras[camera]
    seen = network.image_points.select(~adjustment.rejected)
    of_camera = network.camera[seen.image] == camera
    shown = np.unique(seen.point[of_camera])
    points = estimate.points[shown]
    per_photograph = np.bincount(seen.image[of_camera])
    least = int(per_photograph[per_photograph > 0].min())
    images = np.flatnonzero(per_photograph)
    middle = points.mean(axis=0)
    away = estimate.position[images] - middle
    distances = np.quantile(np.linalg.norm(away, axis=1), (0.0, 0.5, 1.0))
    # R of a camera before the object, upright as in most photographs, along the normal of its plane
    _, _, axes = np.linalg.svd(points - middle, full_matrices=False)
    normal = axes[2] * (np.sign((away @ axes[2]).sum()) or 1.0)
    along = axes[0] * (np.sign((estimate.rotation[images][:, :, 0] @ axes[0]).sum()) or 1.0)
    facing = np.column_stack([along, np.cross(normal, along), normal])
    neighbour = cKDTree(points).query(points, k=2)[1][:, 1] if len(points) > 1 else np.zeros(1, dtype=int)
    measured = seen.xy[of_camera]
    least_px = float(np.minimum(measured, np.array(lens.size_px) - 1 - measured).min())
    width, height = lens.size_px
    places = [(x, y) for x, y in product(PLACES, PLACES)]
    rays = rays_from_pixel(lens, np.array(places) * (width, height) - 0.5)
    for a, b, roll, distance in product(TILTS_DEG, TILTS_DEG, ROLLS_DEG, distances):
        rotation = facing @ rotation_from_angles(np.radians(a), np.radians(b), np.radians(roll))
        for place, ray in zip(places, rays, strict=True):
            if not np.isfinite(ray).all():
                continue
            position = middle - rotation @ (distance * ray)
            xy = np.full((len(network.points), 2), np.nan)
            all_xy = project(lens, position, rotation, points)  # NaN beyond its last ray
            apart = np.linalg.norm(all_xy - all_xy[neighbour], axis=1) / 2
            border = np.minimum(all_xy, np.array(lens.size_px) - 1 - all_xy).min(axis=1)
            inside = border >= np.minimum(apart, least_px)
            xy[shown[inside]] = all_xy[inside]
            if np.isfinite(xy[:, 0]).sum() >= least:
                yield Pose(position, rotation, (a, b), roll, place, float(distance), xy)


def with_poses(adjustment: Adjustment, camera: int, poses: Sequence[Pose]) -> Adjustment:
    """Return the predicted adjustment of the photographs so far and further ones.

    Args:
        adjustment: finished, with its covariance.
        camera: index of the camera.
        poses: the further photographs.
    """
    network, estimate = adjustment.network, adjustment.estimate
    m, sigma = len(network.images), adjustment.sigma0
    seen = network.image_points.select(~adjustment.rejected)
    covariance = sigma**2 * adjustment.image_covariance[~adjustment.rejected]
    usual = (sigma * adjustment.usual_px) ** 2 * np.eye(2)
    parts = [ImagePoints(seen.image, seen.point, seen.xy, covariance)]
    for number, pose in enumerate(poses):
        point = np.flatnonzero(np.isfinite(pose.xy[:, 0]))
        image = np.full(len(point), m + number)
        parts.append(ImagePoints(image, point, pose.xy[point], np.tile(usual, (len(point), 1, 1))))
    moment = network.moment
    if moment is not None:
        moment = np.concatenate([moment, moment.max() + 1 + np.arange(len(poses))])
    further = replace(
        network,
        images=(*network.images, *(f"next {number + 1}" for number in range(len(poses)))),
        camera=np.concatenate([network.camera, np.full(len(poses), camera)]),
        moment=moment,
        image_points=ImagePoints.joined(parts),
        sources=network.sources[:1],
    )
    planned = replace(
        estimate,
        position=np.vstack([estimate.position, *(pose.position[None] for pose in poses)]),
        rotation=np.concatenate([estimate.rotation, *(pose.rotation[None] for pose in poses)]),
    )
    return predict(further, planned, datum="control" if adjustment.datum == "control" else "free")


def _chosen(
    adjustment: Adjustment, camera: int, corners: FloatArray, views: list[Pose], count: int
) -> list[Pose]:
    """Return the views that lower the worst corner most, one after the other."""
    lens = adjustment.estimate.cameras[camera]
    shown = np.zeros(0, dtype=np.int64)
    if views:
        shown = np.flatnonzero(np.any([np.isfinite(view.xy[:, 0]) for view in views], axis=0))
    places = np.linspace(0, len(shown) - 1, min(len(shown), MAX_POINTS))
    sample = shown[np.unique(places.astype(np.int64))]
    if not len(sample):
        return []
    with own_threads():
        marginal = marginal_of(adjustment, cross=False)
        columns = marginal.layout.interior_column[camera]
        Q = marginal.joint(columns, sample)
    effect = _corner_effect(adjustment, camera, corners)
    f = len(columns)
    known = np.concatenate([np.arange(f), f + np.flatnonzero(np.diagonal(Q)[f:] > 0)])
    Q = Q[np.ix_(known, known)]
    sigma = adjustment.sigma0 * adjustment.usual_px
    rows = [_information(adjustment, lens, view, sample, known) / sigma for view in views]
    taken: list[Pose] = []
    views = list(views)
    for _ in range(min(count, len(views))):
        scores = []  # largest variance of a corner with each view
        for A in rows:
            AQ = A @ Q
            half = np.linalg.solve(np.linalg.cholesky(np.eye(len(A)) + AQ @ A.T), AQ[:, :f])
            with_view = Q[:f, :f] - half.T @ half
            scores.append(float(np.einsum("nis,st,nit->n", effect, with_view, effect).max()))
        best = int(np.argmin(scores))
        observed = rows.pop(best)
        AQ = observed @ Q
        Q = Q - AQ.T @ np.linalg.solve(np.eye(len(observed)) + AQ @ observed.T, AQ)
        taken.append(views.pop(best))
    return taken


def _corner_effect(adjustment: Adjustment, camera: int, corners: FloatArray) -> FloatArray:
    """Return the effects of the free parameters on the corners after a rotation, px, (4, 2, f).

    The rotation is fitted to the part of the format that has image points.
    """
    lens, network = adjustment.estimate.cameras[camera], adjustment.network
    seen = network.image_points.select(~adjustment.rejected)
    nodes = np.stack(np.meshgrid(*grid_of(lens)), axis=-1).reshape(-1, 2)
    nodes = nodes[observed_part(seen.xy[network.camera[seen.image] == camera], nodes)[1]]
    free: IntArray = np.flatnonzero(lens.free)
    effects = ProjectionUncertainty(lens, free, np.zeros((0, 0)))
    inner, outer = effects.derivatives(nodes, np.inf), effects.derivatives(corners, np.inf)
    inner = inner[np.isfinite(inner).all(axis=(1, 2))].reshape(-1, 6 + len(free))
    turn = np.linalg.lstsq(inner[:, 3:6], inner[:, 6:], rcond=None)[0]
    return np.asarray(outer[:, :, 6:] - outer[:, :, 3:6] @ turn)


def _information(
    adjustment: Adjustment, lens: Camera, view: Pose, sample: IntArray, known: IntArray
) -> FloatArray:
    """Return the derivatives of the image points of a view by the unknowns, its pose eliminated, px.

    Each point of the sample has the weight of all points that it stands for.
    """
    seen = np.flatnonzero(np.isfinite(view.xy[sample, 0]))
    points = adjustment.estimate.points[sample[seen]]
    UVW = (points - view.position) @ view.rotation
    by_point = ray_jacobian(lens, view.xy[sample[seen]], UVW)
    pose = np.concatenate([by_point, by_point @ skew(UVW)], axis=2).reshape(-1, 6)
    interior = parameter_jacobian(lens, UVW)[:, :, np.flatnonzero(lens.free)]
    f = interior.shape[2]
    A = np.zeros((len(seen), 2, f + 3 * len(sample)))
    A[:, :, :f] = interior
    for row, place in enumerate(seen):
        A[row, :, f + 3 * place : f + 3 * place + 3] = by_point[row] @ view.rotation.T
    A = A.reshape(2 * len(seen), -1)[:, known]
    ok = np.isfinite(A).all(axis=1) & np.isfinite(pose).all(axis=1)
    A, pose = A[ok], pose[ok]
    basis, _ = np.linalg.qr(pose)
    share = np.isfinite(view.xy[:, 0]).sum() / max(len(seen), 1)
    return np.asarray(np.sqrt(share) * (A - basis @ (basis.T @ A)))
