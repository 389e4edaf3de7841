"""The network that two adjusters are given alike: one model, equal weights, free datum, the same unknowns."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.camera import Camera
from sfm.comparison.camera_conversion import Conversion, convert_camera
from sfm.conventions import BoolArray
from sfm.errors import GeometryError
from sfm.network import Estimate, ImagePoints, Network
from sfm.reduced_network import reduce_network, supported

MIN_RAYS, MIN_POINTS = 2, 3  # photographs that determine a point, points that determine a photograph


def common_problem(
    adjustment: Adjustment, *, model: str | None = None
) -> tuple[Network, Estimate, tuple[Conversion, ...], tuple[str, ...]]:
    """Return the network, start values, conversions and changes of free parameters of a comparison.

    Left are photographs that are oriented and show three points, points in two photographs, and accepted
    image points, each with the covariance sigma_px^2 I. Parameters of a group that COLMAP frees as a
    whole (focal lengths, principal point, distortion) are all free if one of them is, and in all cameras
    that are not fixed.

    Raises:
        GeometryError: fewer than two photographs with accepted image points.
    """
    estimate = adjustment.estimate
    cameras = estimate.cameras
    if model is None:
        one = {camera.model for camera in cameras}
        model = one.pop() if len(one) == 1 and not cameras[0].in_mm else "full_opencv"
    conversions = tuple(convert_camera(camera, model) for camera in cameras)
    converted = tuple(conversion.camera for conversion in conversions)
    grouped = grouped_free(converted)
    freed = tuple(
        f"{camera.name}: " + ", ".join(np.array(camera.names)[now.free & ~camera.free])
        for camera, now in zip(converted, grouped, strict=True)
        if (now.free & ~camera.free).any()
    )
    accepted = ~adjustment.rejected
    images, points = supported(
        adjustment.network, estimate, accepted, min_points=MIN_POINTS, min_rays=MIN_RAYS
    )
    if images.sum() < 2:
        raise GeometryError("comparison: fewer than two photographs with accepted image points are left")
    network, start = reduce_network(
        adjustment.network, replace(estimate, cameras=grouped), images, points, accepted
    )
    seen = network.image_points
    unit = np.tile(np.eye(2) * adjustment.sigma_px**2, (len(seen), 1, 1))
    # Nothing but image points: no control, scale bars or other observations.
    network = Network(
        network.images,
        network.camera,
        network.points,
        ImagePoints(seen.image, seen.point, seen.xy, unit),
        moment=network.moment,
    )
    return network, start, conversions, freed


def grouped_free(cameras: tuple[Camera, ...]) -> tuple[Camera, ...]:
    """Return cameras whose free parameters are whole groups, the same in all that are not fixed."""
    free = [any(camera.free[camera.parts[g]].any() for camera in cameras) for g in range(3)]
    out = []
    for camera in cameras:
        flags: BoolArray = np.zeros(len(camera.names), dtype=bool)
        if camera.free.any():
            for group, is_free in zip(camera.parts, free, strict=True):
                flags[group] = is_free
        out.append(replace(camera, free=flags))
    return tuple(out)


def distortion_held(camera: Camera) -> Camera:
    """Return a camera with its distortion fixed."""
    return replace(camera, free=camera.free & ~camera.parts[2])
