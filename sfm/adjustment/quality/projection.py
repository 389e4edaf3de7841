"""Projection uncertainty: how well a calibrated camera knows where a direction is seen in the photograph.

The covariance of the interior orientation moves the picture of a distant point. The part that equals a
rotation of the camera is no error of the camera, since every use of it finds the rotation anew: it is taken
out by the small rotation that fits best to the image points of the calibration. Between these the camera is
known, beyond them the uncertainty grows.

Source: law of propagation of variances; Kogan, mrcal, "Projection uncertainty".
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from sfm.camera import Camera, pixel_from_tangents, pixel_jacobian, tangents_from_pixel
from sfm.conventions import BoolArray, FloatArray

CELLS = 24  # of the grid along the longer side of the photograph


def projection_map(
    camera: Camera, covariance: FloatArray, seen: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the projection uncertainty over the whole photograph.

    Args:
        camera: interior orientation.
        covariance: of its free parameters, (f, f).
        seen: image points that calibrated it, px, (k, 2).

    Returns:
        Columns (c,) and rows (r,) of a grid, px, and the root mean square standard deviation of both
        coordinates at its crossings, px, (r, c); NaN where the camera model folds over.
    """
    width, height = camera.size_px
    cell = max(width, height) / CELLS
    x = np.linspace(0, width - 1, max(2, round(width / cell) + 1))
    y = np.linspace(0, height - 1, max(2, round(height / cell) + 1))
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    Q = projection_covariance(camera, covariance, seen, grid)
    sigma = np.sqrt(np.einsum("kii->k", Q) / 2)
    return x, y, sigma.reshape(len(y), len(x))


def observed_part(seen: FloatArray, xy: FloatArray) -> tuple[float, BoolArray]:
    """Return the area that image points cover, their convex hull, px^2, and which places are in it.

    Args:
        seen: image points, px, (k, 2).
        xy: places, px, (n, 2).

    Returns:
        The area, 0 of image points on one line, and whether each place is inside, (n,).
    """
    try:
        hull = ConvexHull(seen)
    except (QhullError, ValueError):  # on one line, or fewer than three
        return 0.0, np.zeros(len(xy), dtype=bool)
    inside = (xy @ hull.equations[:, :2].T + hull.equations[:, 2] <= 0).all(axis=1)
    return float(hull.volume), np.asarray(inside)


def projection_covariance(
    camera: Camera, covariance: FloatArray, seen: FloatArray, xy: FloatArray
) -> FloatArray:
    """Return the covariance of the places at which directions are seen, rotations taken out.

    Args:
        camera: interior orientation.
        covariance: of its free parameters, (f, f).
        seen: image points to which the rotation is fitted, px, (k, 2).
        xy: where the directions are seen, px, (n, 2).

    Returns:
        px^2, (n, 2, 2); NaN where the camera model cannot be inverted, infinite where a parameter is not
        determined.
    """
    sigma = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    if np.isinf(sigma).any():
        return np.full((len(xy), 2, 2), np.inf)
    known = np.flatnonzero(sigma > 0)
    if not len(known):
        return np.zeros((len(xy), 2, 2))
    correlation = covariance[np.ix_(known, known)] / np.outer(sigma[known], sigma[known])
    steps = np.zeros((len(known), len(camera.parameters)))
    steps[np.arange(len(known)), np.flatnonzero(camera.free)[known]] = sigma[known]
    moved_seen, turned_seen = _moved(camera, steps, seen), _turned(camera, seen)
    sound = np.isfinite(moved_seen).all(axis=(1, 2)) & np.isfinite(turned_seen).all(axis=(1, 2))
    of_rotation = turned_seen[sound].reshape(-1, 3)
    rotation = np.linalg.lstsq(of_rotation, moved_seen[sound].reshape(-1, len(known)), rcond=None)[0]
    J = _moved(camera, steps, xy) - _turned(camera, xy) @ rotation
    return np.asarray(np.einsum("nis,st,njt->nij", J, correlation, J))


def _moved(camera: Camera, steps: FloatArray, xy: FloatArray) -> FloatArray:
    """Return by how much steps of the parameters (s, p) move pictures of distant points, px, (n, 2, s)."""
    uv = tangents_from_pixel(camera, xy)
    columns = []
    for step in steps:
        ahead = pixel_from_tangents(camera.with_parameters(camera.parameters + step / 2), uv)
        columns.append(ahead - pixel_from_tangents(camera.with_parameters(camera.parameters - step / 2), uv))
    return np.stack(columns, axis=-1)


def _turned(camera: Camera, xy: FloatArray) -> FloatArray:
    """Return how small rotations of the rays about the image axes move their pictures, px/rad, (n, 2, 3)."""
    u, v = tangents_from_pixel(camera, xy).T
    # of rays (u, v, -1): w x ray, divided by its depth again
    turned = np.array([[u * v, -1 - u**2, -v], [1 + v**2, -u * v, u]])
    return np.asarray(np.einsum("nij,jkn->nik", pixel_jacobian(camera, xy), turned))
