"""Uncertainty of projection: how well a calibrated camera predicts where a point in front of it is imaged.

A pixel q and a distance d from the projection centre give a point p in the axes of the camera. It is fixed to
the object through each photograph of the camera. If all unknowns change, each photograph i gives another p,

    dp_i = p x w_i - R_i' dX0_i

for small rotations w_i about its image axes. The mean over the photographs is projected with the changed
interior orientation. Its shift is linear in the mean motion of the photographs and the interior parameters,
so their joint covariance gives its covariance. At an infinite distance only the rotations count.

A parameter that the pose absorbs, such as the principal point by a rotation, thus adds no uncertainty.
Neither do motions and scale of the object as a whole, unless it is held: given points with a standard
deviation would turn it by their errors, and more the worse they are given.

Source: Kogan (2021), mrcal documentation, "Projection uncertainty", which states this definition for boards
that move in front of a camera; Foerstner, Wrobel (2016), sec. 2.7 (propagation of covariances).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.adjustment.covariance import marginal_of
from sfm.adjustment.datum import Datum
from sfm.adjustment.quality.correlations import CELLS
from sfm.adjustment.result import Adjustment
from sfm.model.arguments import checked_arguments
from sfm.model.camera import Camera, parameter_jacobian, ray_jacobian, rays_from_pixel
from sfm.model.conventions import FloatArray, IntArray, skew
from sfm.model.errors import GeometryError
from sfm.model.network import index_of
from sfm.runtime.threads import own_threads


@dataclass(frozen=True)
class ProjectionUncertainty:
    """A calibrated camera with the joint covariance of its interior orientation and mean motion."""

    camera: Camera
    free: IntArray  # indices of the adjusted parameters, (f,)
    # of the mean of -R'dX0 (object unit) and w (rad) over its photographs, then the f parameters; infinite if
    # a parameter is not determined, (6 + f, 6 + f)
    covariance: FloatArray

    def covariance_at(self, xy: FloatArray, distance: float) -> FloatArray:
        """Return the covariance of the projections of points at pixels and a distance.

        Args:
            xy: pixels, px, (k, 2).
            distance: from the projection centre, object unit; infinity is allowed.

        Returns:
            Covariance, px^2, (k, 2, 2); NaN where the camera model has no ray, infinite if a parameter is not
            determined.
        """
        if not np.isfinite(self.covariance).all():
            return np.full((len(xy), 2, 2), np.inf)
        J = self.derivatives(xy, distance)
        return np.asarray(J @ self.covariance @ np.swapaxes(J, 1, 2))

    def derivatives(self, xy: FloatArray, distance: float) -> FloatArray:
        """Return the derivatives of projections by the mean motion and the parameters, px, (k, 2, 6 + f).

        Args:
            xy: pixels, px, (k, 2).
            distance: as in `covariance_at`.
        """
        ray = rays_from_pixel(self.camera, xy)
        shift = np.linalg.norm(ray, axis=1)[:, None, None] * np.eye(3) / distance
        motion = np.concatenate([shift, skew(ray)], axis=2)  # of the ray, in its length
        of_pose = ray_jacobian(self.camera, xy, ray) @ motion
        return np.concatenate([of_pose, parameter_jacobian(self.camera, ray)[:, :, self.free]], axis=2)

    def sigma_at(self, xy: FloatArray, distance: float) -> FloatArray:
        """Return the standard deviation of a projection, RMS of both coordinates, px, (k,).

        Args:
            xy: pixels, px, (k, 2).
            distance: as in `covariance_at`.
        """
        return np.asarray(np.sqrt(np.einsum("kii->k", self.covariance_at(xy, distance)) / 2))

    def map_at(self, distance: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return columns (c,) and rows (r,) of a grid over the format, px, and sigma at its nodes, (r, c).

        Args:
            distance: as in `covariance_at`.
        """
        x, y = grid_of(self.camera)
        nodes = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        return x, y, self.sigma_at(nodes, distance).reshape(len(y), len(x))


def grid_of(camera: Camera) -> tuple[FloatArray, FloatArray]:
    """Return columns (c,) and rows (r,) of a grid over the format of a camera, px."""
    cell = max(camera.size_px) / CELLS
    width, height = camera.size_px
    x, y = (np.linspace(0, side - 1, max(2, round(side / cell) + 1)) for side in (width, height))
    return x, y


@checked_arguments()
def projection_uncertainty(adjustment: Adjustment, camera: str | int = 0) -> ProjectionUncertainty:
    """Return the uncertainty of projection of a camera of an adjustment.

    The object is what its points are in the mean: the datum is that of inner constraints on all points, or on
    the given ones if all of them have standard deviations. Given points that are held are the object.

    Args:
        adjustment: finished, with its covariance.
        camera: name or index of the camera.

    Raises:
        GeometryError: the adjustment has no photograph of the camera, or its normal equations cannot be
            solved.
        UnknownNameError: no camera has that name.

    Example:
        >>> import numpy as np
        >>> from sfm.products.calibration import projection_uncertainty
        >>> known = projection_uncertainty(result.adjustment)
        >>> known.covariance_at(np.array([[100.0, 100.0]]), np.inf).shape
        (1, 2, 2)
    """
    cameras = adjustment.estimate.cameras
    k = camera if isinstance(camera, int) else index_of([c.name for c in cameras], camera, "camera")
    network = adjustment.network
    taken = np.bincount(network.image_points.image[~adjustment.rejected], minlength=len(network.images)) > 0
    images = np.flatnonzero((network.camera == k) & taken)
    if not len(images):
        raise GeometryError(f"camera {cameras[k].name}: no photograph of it took part in the adjustment")
    free = np.flatnonzero(cameras[k].free)
    interior = adjustment.covariance.interior[k]
    if not np.isfinite(interior).all():
        return ProjectionUncertainty(cameras[k], free, np.full((6 + len(free), 6 + len(free)), np.inf))
    with own_threads():
        datum = Datum("free") if adjustment.datum != "control" else None
        marginal = marginal_of(adjustment, datum=datum, cross=False)
        layout, state = marginal.layout, marginal.optimum.state
        columns, by = layout.photograph_terms(state, images)
        unknowns, place = np.unique(
            np.concatenate([columns.ravel(), layout.interior_column[k]]), return_inverse=True
        )
        # measured points that are given; none if some of them have no standard deviation
        control, seen = adjustment.network.control.complete, adjustment.network.image_points
        measured = control.point[np.isin(control.point, seen.point[~adjustment.rejected])]
        held = not (np.diagonal(control.covariance, axis1=1, axis2=2) > 0).all()
        points = measured[:0] if adjustment.datum != "control" or held or len(measured) < 3 else measured
        joint = marginal.joint(unknowns, points)
    motion = np.zeros((len(images), 6, 6))
    motion[:, :3, :3] = -np.swapaxes(adjustment.estimate.rotation[images], 1, 2)
    motion[:, 3:, 3:] = np.eye(3)
    by_unknowns = (motion @ by / len(images)).transpose(1, 0, 2).reshape(6, -1)
    A = np.zeros((6 + len(layout.interior_column[k]), len(joint)))
    for part in range(6):
        np.add.at(A[part], place[: columns.size], by_unknowns[part])
    A[6 + np.arange(len(A) - 6), place[columns.size :]] = 1.0
    A[:6, len(unknowns) :] = -_motion_with_object(adjustment, images, points)
    adjusted = np.asarray(layout.interior_free[k])
    return ProjectionUncertainty(cameras[k], adjusted, A @ joint @ A.T)


def _motion_with_object(adjustment: Adjustment, images: IntArray, points: IntArray) -> FloatArray:
    """Return the derivatives of the mean motion of photographs by points that carry the object, (6, 3 p).

    A similarity fitted to the shifts of the points moves the photographs with them.
    """
    if not len(points):
        return np.zeros((6, 0))
    estimate = adjustment.estimate
    middle = estimate.points[points].mean(axis=0)

    def by_similarity(places: FloatArray) -> FloatArray:  # translation, rotation, scale
        away = places - middle
        shift = np.tile(np.eye(3), (len(away), 1, 1))
        return np.concatenate([shift, -skew(away), away[:, :, None]], axis=2)

    into_image = np.swapaxes(estimate.rotation[images], 1, 2)
    turn = np.hstack([np.zeros((3, 3)), np.eye(3), np.zeros((3, 1))])
    moved = -into_image @ by_similarity(estimate.position[images])
    mean = np.vstack([moved.mean(axis=0), (into_image @ turn).mean(axis=0)])
    return np.asarray(mean @ np.linalg.pinv(by_similarity(estimate.points[points]).reshape(-1, 7)))
