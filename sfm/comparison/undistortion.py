"""Image points corrected for distortion, for programs that know none.

The measured points are moved to where a camera without distortion and with square pixels sees the same rays.
Nothing is lost but the raw coordinates; the way back needs the camera that they were measured with.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sfm.camera import Camera, camera_from_values, pixel_from_tangents, pixel_jacobian, tangents_from_pixel
from sfm.comparison.camera_conversion import corresponding_free
from sfm.display import counted
from sfm.distortion.models import Role
from sfm.errors import GeometryError
from sfm.network import Estimate, Network, rows_of

PINHOLE = (Role.FOCAL, Role.X0, Role.Y0)  # parts that a camera without distortion has


def undistort(network: Network, estimate: Estimate, models: tuple[str, ...]) -> tuple[Network, Estimate]:
    """Return image points without distortion and the ideal cameras that see them.

    The rays are the same to rounding; covariances of image points follow.

    Args:
        network: measured image points.
        estimate: cameras they were measured with.
        models: that the ideal cameras may be in, with all distortion 0; brown or opencv must be one of them.

    Raises:
        GeometryError: a distortion that cannot be inverted at a measured point.
    """
    seen = network.image_points
    xy, covariance = seen.xy.copy(), seen.covariance.copy()
    ideal = tuple(ideal_camera(camera, models) for camera in estimate.cameras)
    of_camera = rows_of(network.camera[seen.image], len(estimate.cameras))
    for k, (camera, rows) in enumerate(zip(estimate.cameras, of_camera, strict=True)):
        if not len(rows):
            continue
        uv = tangents_from_pixel(camera, seen.xy[rows])
        lost = ~np.isfinite(uv).all(axis=1)
        if lost.any():
            row = rows[np.argmax(lost)]
            raise GeometryError(
                f"camera {camera.name}: its distortion cannot be inverted at "
                f"{counted(int(lost.sum()), 'image point')}, "
                f"the first is point {network.points[seen.point[row]]} in {network.images[seen.image[row]]}"
            )
        xy[rows] = pixel_from_tangents(ideal[k], uv)
        before = pixel_jacobian(camera, seen.xy[rows])
        G = pixel_jacobian(ideal[k], xy[rows]) @ np.linalg.inv(before)
        carried = G @ seen.covariance[rows] @ np.swapaxes(G, 1, 2)
        covariance[rows] = (carried + np.swapaxes(carried, 1, 2)) / 2  # symmetric to the last bit
    return (
        replace(network, image_points=replace(seen, xy=xy, covariance=covariance)),
        replace(estimate, cameras=ideal),
    )


def ideal_camera(camera: Camera, models: tuple[str, ...]) -> Camera:
    """Return the camera without distortion: its principal distance and principal point, square pixels."""
    sx, sy = (float(side) for side in camera.pixel_mm)
    centre = (np.asarray(camera.size_px) - 1) / 2
    if camera.in_mm:
        c = camera.value("c")
        principal = centre + np.array([camera.value("x0") / sx, -camera.value("y0") / sy])
    else:
        c = float(camera.parameters[camera.plays(Role.FOCAL)][-1]) * sy
        principal = np.array([camera.value("cx"), camera.value("cy")])
    model = "brown" if "opencv" not in models or (camera.in_mm and "brown" in models) else "opencv"
    x0, y0 = (principal - centre) * (sy, -sy)
    values = (("x0", x0), ("y0", y0)) if model == "brown" else (("cx", principal[0]), ("cy", principal[1]))
    ideal = camera_from_values(
        camera.name,
        model,
        camera.size_px,
        (sy, sy),
        c_mm=c,
        values=tuple((name, float(value)) for name, value in values),
    )
    return replace(ideal, free=corresponding_free(camera, model) & ideal.plays(*PINHOLE))
