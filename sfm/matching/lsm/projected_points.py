"""Pictures of object points in oriented photographs, and of windows on planes through them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sfm.camera import Camera, pixel_from_tangents, ray_directions, tangents_from_pixel
from sfm.conventions import FloatArray, IntArray
from sfm.network import Estimate, rows_of


def pictures_of(estimate: Estimate, camera: IntArray, image: IntArray, points: FloatArray) -> FloatArray:
    """Return the picture of one object point for each row, px, NaN behind the photograph, (k, 2)."""
    UVW = _in_photographs(estimate, image, points)
    out = np.full((len(image), 2), np.nan)
    for lens, rows in _of_cameras(estimate, camera, image):
        out[rows] = pixel_from_tangents(lens, _in_front(UVW[rows]))
    return out


def plane_warps(
    estimate: Estimate,
    camera: IntArray,
    i: int,
    j: int | IntArray,
    xy: FloatArray,
    points: FloatArray,
    normal: FloatArray,
    reach_px: float,
) -> FloatArray:
    """Return the homographies of windows of one photograph in another, relative to both points, (k, 3, 3).

    A window is seen in perspective, and its middle is not the middle of its picture: over 15 px at 45 degrees
    an affine warp is off by about 0.01 px, in the same direction all over a photograph.

    Args:
        estimate: interior and exterior orientation of all photographs.
        camera: index of the camera of each photograph, (m,).
        i: photograph of the windows.
        j: the other photograph, of all or of each, (k,).
        xy: windows' middles in i, px, (k, 2).
        points: object points of these, (k, 3).
        normal: of the surface there, (k, 3).
        reach_px: from the middle to where the perspective is taken from: half the side of the windows.
    """
    R, X0 = estimate.rotation[i], estimate.position[i]
    lens, other = estimate.cameras[camera[i]], np.broadcast_to(np.asarray(j), (len(xy),))
    height = np.einsum("kc,kc->k", normal, points - X0)

    def seen(offset: tuple[float, float]) -> FloatArray:
        uv = tangents_from_pixel(lens, xy + np.array(offset))
        d = ray_directions(uv, R)
        on_plane = X0 + d * (height / np.einsum("kc,kc->k", normal, d))[:, None]
        return pictures_of(estimate, camera, other, on_plane)

    h = reach_px
    middle = seen((0.0, 0.0))
    warps = np.zeros((len(xy), 3, 3))
    warps[:, 2, 2] = 1.0
    for a, (forth, back) in enumerate((((h, 0.0), (-h, 0.0)), ((0.0, h), (0.0, -h)))):
        after, before = seen(forth), seen(back)
        linear, bent = (after - before) / (2 * h), (after + before - 2 * middle) / (2 * h * h)
        warps[:, :2, a] = linear
        warps[:, 2, a] = -np.einsum("kc,kc->k", bent, linear) / np.einsum("kc,kc->k", linear, linear)
    return warps


def _in_photographs(estimate: Estimate, image: IntArray, points: FloatArray) -> FloatArray:
    """Return the point of each row in the axes of its photograph, (k, 3)."""
    return np.asarray(np.einsum("ki,kij->kj", points - estimate.position[image], estimate.rotation[image]))


def _in_front(UVW: FloatArray) -> FloatArray:
    """Return the tangents of rays, NaN behind the photograph, (k, 2)."""
    W = np.where(UVW[:, 2:] < 0, UVW[:, 2:], np.nan)
    return np.asarray(-UVW[:, :2] / W)


def _of_cameras(estimate: Estimate, camera: IntArray, image: IntArray) -> Iterator[tuple[Camera, IntArray]]:
    """Yield each camera that has rows, and its rows."""
    for lens, rows in zip(estimate.cameras, rows_of(camera[image], len(estimate.cameras)), strict=True):
        if len(rows):
            yield lens, rows
