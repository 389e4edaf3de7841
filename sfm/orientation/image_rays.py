"""Rays of image points: their intersections and angles, and homographies of planes."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from sfm.model.camera import Camera, pixel_from_rays, rays_from_pixel, tangents_from_pixel
from sfm.model.conventions import BoolArray, FloatArray, IntArray, skew
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, rows_of
from sfm.orientation.intersection import Intersection, RayLimits, intersect

PLANAR_POINTS = 4
RANSAC_TRIALS = 60  # only planes with four fifths of the pairs matter: one is missed with probability 2e-14
NO_BASE = 1e-9  # (sigma1 - sigma3) of a homography with sigma2 = 1 below which it is a rotation
MAX_PAIRS = 4_000_000  # pairs of rays compared at a time


def image_tangents(seen: ImagePoints, camera: IntArray, cameras: Sequence[Camera]) -> FloatArray:
    """Return the tangents u = -U/W, v = -V/W of image points, (k, 2).

    NaN for image points without a ray, and with one 90 degrees or more from the axis.

    Args:
        seen: image points.
        camera: index of the camera of each photograph, (m,).
        cameras: interior orientations.
    """
    uv = np.full((len(seen), 2), np.nan)
    for k, rows in enumerate(rows_of(camera[seen.image], len(cameras))):
        uv[rows] = tangents_from_pixel(cameras[k], seen.xy[rows])
    return uv


def intersect_image_points(
    seen: ImagePoints, camera: IntArray, estimate: Estimate, *, n_points: int, tolerance_px: float
) -> Intersection:
    """Return the object points that most rays of oriented photographs support; see `intersect`.

    Rays of wide-angle cameras are compared by angles: each becomes the axis of a separate photograph. With
    tangents, one pixel at 70 degrees off the axis would weigh as much as eight in the middle, and there are
    none at 90 degrees.

    Args:
        seen: image points.
        camera: index of the camera of each photograph, (m,).
        estimate: interior and exterior orientation.
        n_points: number of object points.
        tolerance_px: largest residual of a ray that takes part, in px of the camera with the shortest c.
    """
    uv, image = image_tangents(seen, camera, estimate.cameras), seen.image
    position, rotation = estimate.position, estimate.rotation
    wide = np.array([lens.wide_angle for lens in estimate.cameras])[camera[image]]
    if wide.any():
        position = np.concatenate([position, position[image[wide]]])
        rays = np.empty((len(seen), 3))
        for k, rows in enumerate(rows_of(camera[image], len(estimate.cameras))):
            if estimate.cameras[k].wide_angle:
                rays[rows] = rays_from_pixel(estimate.cameras[k], seen.xy[rows])
        rotation = np.concatenate([rotation, rotation[image[wide]] @ axes_along(rays[wide])])
        image = image.copy()
        image[wide] = len(estimate.position) + np.arange(int(wide.sum()))
        uv[wide] = 0.0 * rays[wide][:, :2]  # keeps NaN
    return intersect(
        uv,
        image,
        seen.point,
        position,
        rotation,
        n_points=n_points,
        limits=RayLimits(tolerance=tolerance_px / min(lens.c_px for lens in estimate.cameras)),
    )


def axes_along(rays: FloatArray) -> FloatArray:
    """Return rotations from axes whose -z is along a ray, and whose x is level, into those of the rays.

    Args:
        rays: directions, of any length, (k, 3).

    Returns:
        Rotation matrices, (k, 3, 3).
    """
    z = -rays / np.linalg.norm(rays, axis=1, keepdims=True)
    x = np.column_stack([z[:, 2], 0 * z[:, 1], -z[:, 0]])
    length = np.linalg.norm(x, axis=1, keepdims=True)
    x = np.where(length > 0, x / np.where(length > 0, length, 1.0), (1.0, 0.0, 0.0))  # a ray along y
    return np.stack([x, np.cross(z, x), z], axis=2)


def image_residuals(network: Network, estimate: Estimate) -> FloatArray:
    """Return computed minus measured position of every image point, px, NaN where undetermined, (k, 2).

    Args:
        network: network of k image points.
        estimate: estimate of this network.
    """
    seen = network.image_points
    computed = np.full((len(seen), 2), np.nan)
    away = estimate.points[seen.point] - estimate.position[seen.image]
    rays = np.einsum("ka,kab->kb", away, estimate.rotation[seen.image])
    of_camera = rows_of(network.camera[seen.image], len(estimate.cameras))
    for camera, rows in zip(estimate.cameras, of_camera, strict=True):
        computed[rows] = pixel_from_rays(camera, rays[rows])
    computed[~estimate.oriented[seen.image]] = np.nan
    return computed - seen.xy


def ray_angles(network: Network, estimate: Estimate, used: BoolArray) -> FloatArray:
    """Return the largest angle between two rays of each point, deg, NaN with fewer than two, (n,).

    Opposite rays count as parallel, so no angle exceeds 90 degrees.

    Args:
        network: network of k image points and n points.
        estimate: estimate of this network, with everything used determined.
        used: image points with rays that count, (k,).
    """
    seen = network.image_points.select(used)
    order = np.argsort(seen.point, kind="stable")
    image, point = seen.image[order], seen.point[order]
    ray = estimate.points[point] - estimate.position[image]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    count = np.bincount(point, minlength=len(network.points))
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    angle = np.full(len(network.points), np.nan)
    for r in np.unique(count[count >= 2]):
        points = np.flatnonzero(count == r)
        for part in np.array_split(points, 1 + len(points) * r * r // MAX_PAIRS):
            u = ray[first[part][:, None] + np.arange(r)]
            sine = np.sqrt(np.maximum(1 - np.einsum("nia,nja->nij", u, u) ** 2, 0))
            angle[part] = np.degrees(np.arcsin(np.minimum(sine.max(axis=(1, 2)), 1)))
    return angle


def fit_homography(
    first: FloatArray, second: FloatArray, *, tolerance: float, seed: int = 0
) -> tuple[FloatArray, BoolArray]:
    """Return H with r2 ~ H r1 for rays r = (u, v, -1), and the pairs that fit it.

    Args:
        first: tangents u = -U/W, v = -V/W of rays of photograph 1, shape (n, 2), n >= 4.
        second: the conjugate rays of photograph 2, shape (n, 2).
        tolerance: largest residual in photograph 2, tangents.
        seed: seed of the random samples.
    """
    n = len(first)
    used = np.ones(n, dtype=bool)
    if n > PLANAR_POINTS:
        cv2.setRNGSeed(seed)
        _, mask = cv2.findHomography(first, second, cv2.RANSAC, tolerance, maxIters=RANSAC_TRIALS)
        if mask is None or mask.sum() < PLANAR_POINTS:
            return np.eye(3), np.zeros(n, dtype=bool)
        used = mask.ravel().astype(bool)
    # the direct linear solution with conditioned coordinates (Hartley, Zisserman 2004, alg. 4.2)
    T1, T2 = _conditioner(first[used]), _conditioner(second[used])
    r1, r2 = rays_of(first[used]) @ T1.T, rays_of(second[used]) @ T2.T
    equations = np.einsum("nij,nk->nijk", skew(r2), r1).reshape(-1, 9)
    h = np.linalg.svd(equations, full_matrices=False)[2][-1].reshape(3, 3)
    H = np.asarray(np.linalg.inv(T2) @ h @ T1)
    if np.sum((rays_of(first[used]) @ H.T) * rays_of(second[used])) < 0:
        H = -H
    residuals = np.linalg.norm(transfer_residuals(H, first, second), axis=1)
    return H, np.asarray(residuals <= tolerance)


def transfer_residuals(H: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """Return computed minus measured tangents in photograph 2, NaN for rays behind it, shape (n, 2).

    Args:
        H: homography with r2 ~ H r1, shape (3, 3).
        first: tangents of rays of photograph 1, shape (n, 2).
        second: tangents of the conjugate rays of photograph 2, shape (n, 2).
    """
    mapped = rays_of(first) @ H.T
    W = np.where(mapped[:, 2] < 0, mapped[:, 2], np.nan)
    return np.asarray(-mapped[:, :2] / W[:, None] - second)


def decompose_homography(H: FloatArray, first: FloatArray) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
    """Return (base, rotation, normal) of the camera pairs that a homography describes.

    Args:
        H: r2 ~ H r1 for rays r = (u, v, -1), with the sign that makes depths positive, shape (3, 3).
        first: tangents u = -U/W, v = -V/W of rays of photograph 1 to points of the plane, shape (n, 2).

    Returns:
        The solutions with the plane in front of photograph 1: two, one if they coincide, none for a pure
        rotation.

    Source: Ma et al. (2004), alg. 5.2: H = R' + t n', from the eigenvectors of H'H.
    """
    _, s, Vt = np.linalg.svd(H)
    H = H / s[1]
    s1, s3 = s[0] / s[1], s[2] / s[1]
    if s1 - s3 < NO_BASE:
        return []
    v1, v2, v3 = Vt
    p, q = np.sqrt(max(1 - s3**2, 0.0)), np.sqrt(max(s1**2 - 1, 0.0))
    solutions: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    for sign in (1.0, -1.0):
        u = (p * v1 + sign * q * v3) / np.sqrt(s1**2 - s3**2)
        normal = np.cross(v2, u)
        R21 = np.stack([H @ v2, H @ u, np.cross(H @ v2, H @ u)], axis=1) @ np.stack([v2, u, normal])
        t = (H - R21) @ normal
        if np.sum(rays_of(first) @ normal) < 0:
            normal, t = -normal, -t
        base = -R21.T @ t
        solutions.append((base / np.linalg.norm(base), np.asarray(R21.T), np.asarray(normal)))
    if abs(solutions[0][2] @ solutions[1][2]) > 1 - NO_BASE:
        return solutions[:1]
    return solutions


def _conditioner(uv: FloatArray) -> FloatArray:
    centre = uv.mean(axis=0)
    spread = np.sqrt(np.mean(np.sum((uv - centre) ** 2, axis=1)) / 2)
    return np.asarray(np.array([[1, 0, centre[0]], [0, 1, centre[1]], [0, 0, spread]]) / spread)


def rays_of(uv: FloatArray) -> FloatArray:
    """Return (u, v, -1) of tangents, shape (n, 3)."""
    return np.concatenate([uv, -np.ones((len(uv), 1))], axis=1)
