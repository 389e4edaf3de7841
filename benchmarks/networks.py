"""Synthetic networks on which the adjustment is timed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from sfm.model.camera import Camera, camera_from_values, project
from sfm.model.conventions import FloatArray, IntArray, rotation_from_vector
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network

NOISE_PX = 0.1
SIZE_PX = (2000, 1500)
HEIGHT = 100.0  # flying height of a block above the ground
FOOTPRINT = (100.0, 75.0)  # size of a photograph on the ground


def shared_camera() -> Camera:
    """Return the camera of all networks, with free distortion, principal distances and principal point."""
    return camera_from_values(
        "A",
        "opencv",
        SIZE_PX,
        (0.005, 0.005),
        c_mm=10.0,
        free=("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
        values=(("k1", -0.08), ("k2", 0.04), ("p1", 3e-4), ("p2", -2e-4)),
    )


def convergent(images: int, points: int, visibility: float) -> tuple[Network, Estimate]:
    """Return a network of photographs around a cloud of points, and start values a few per cent off."""
    rng = np.random.default_rng(images)
    camera = shared_camera()
    X = rng.uniform(-0.7, 0.7, (points, 3))
    azimuth, elevation = rng.uniform(0, 2 * np.pi, images), rng.uniform(-1.1, 1.1, images)
    z = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    roll = np.zeros((images, 3))
    roll[:, 2] = rng.uniform(0, 2 * np.pi, images)
    rotation = np.stack([x, np.cross(z, x), z], axis=2) @ rotation_from_vector(roll)
    position = z * rng.uniform(3.6, 4.4, (images, 1))
    seen = [np.flatnonzero(rng.random(points) < visibility) for _ in range(images)]
    truth = Estimate((camera,), position, rotation, X)
    return photographed(truth, seen, rng), spoiled(truth, rng, shift=0.01)


def block(strips: int, per_strip: int, *, rays: float = 6.9) -> tuple[Network, Estimate]:
    """Return a block of near-nadir photographs over hilly ground, and start values with small errors.

    Args:
        strips: number of strips, flown in alternate directions.
        per_strip: photographs per strip.
        rays: mean number of photographs that see a point inside the block; each photograph has 99 points.
    """
    rng = np.random.default_rng(strips * per_strip)
    m = strips * per_strip
    step = np.sqrt(FOOTPRINT[0] * FOOTPRINT[1] / rays) * np.array([1.1, 1 / 1.1])
    strip, place = np.divmod(np.arange(m), per_strip)
    position = np.stack([place * step[0], strip * step[1], np.full(m, HEIGHT)], axis=1)
    position += rng.normal(0, [1.0, 1.0, 3.0], (m, 3))
    turn = rng.normal(0, 0.05, (m, 3))
    heading = np.zeros((m, 3))
    heading[:, 2] = np.pi * (strip % 2)
    rotation = rotation_from_vector(heading) @ rotation_from_vector(turn)
    n = 99 * m
    ground = np.array([per_strip, strips]) * step + np.array(FOOTPRINT) / 2
    X = np.empty((n, 3))
    X[:, :2] = rng.uniform(-np.array(FOOTPRINT) / 4, ground - np.array(FOOTPRINT) / 4, (n, 2))
    X[:, 2] = 8 * np.sin(X[:, 0] / 37) * np.cos(X[:, 1] / 29) + rng.normal(0, 1.5, n)
    tree = cKDTree(X[:, :2])
    seen = [np.array(sorted(near)) for near in tree.query_ball_point(position[:, :2], 85.0)]
    truth = Estimate((shared_camera(),), position, rotation, X)
    network = photographed(truth, seen, rng)
    k = network.image_points
    used = np.bincount(k.point, minlength=n) >= 2
    on = used[k.point]
    number = np.cumsum(used) - 1
    network = replace(
        network,
        points=tuple(f"{j}" for j in range(used.sum())),
        image_points=ImagePoints(k.image[on], number[k.point[on]], k.xy[on], k.covariance[on]),
    )
    return network, spoiled(replace(truth, points=X[used]), rng, shift=0.25)


def photographed(truth: Estimate, seen: list[IntArray], rng: np.random.Generator) -> Network:
    """Return the noisy image points of the object points that each photograph may see."""
    image, point, xy = [], [], []
    for i, j in enumerate(seen):
        pixel = project(truth.cameras[0], truth.position[i], truth.rotation[i], truth.points[j])
        inside = ((pixel > 0) & (pixel < np.array(SIZE_PX) - 1)).all(axis=1)
        image.append(np.full(inside.sum(), i))
        point.append(j[inside])
        xy.append(pixel[inside] + NOISE_PX * rng.standard_normal((inside.sum(), 2)))
    measured = np.concatenate(xy)
    return Network(
        tuple(f"{i}" for i in range(len(seen))),
        np.zeros(len(seen), dtype=np.int64),
        tuple(f"{j}" for j in range(len(truth.points))),
        ImagePoints(
            np.concatenate(image), np.concatenate(point), measured, np.tile(np.eye(2), (len(measured), 1, 1))
        ),
    )


def spoiled(truth: Estimate, rng: np.random.Generator, *, shift: float) -> Estimate:
    """Return start values: positions and points shifted, angles off by 0.3 deg, c by 0.5 %, no distortion."""
    camera = truth.cameras[0]

    def noise(shape: tuple[int, ...], size: float) -> FloatArray:
        return size * rng.standard_normal(shape)

    factors = np.array([1.005, 1.005, 1, 1, 0, 0, 0, 0])
    return Estimate(
        (camera.with_parameters(camera.parameters * factors),),
        truth.position + noise(truth.position.shape, shift),
        truth.rotation @ rotation_from_vector(noise(truth.position.shape, 0.005)),
        truth.points + noise(truth.points.shape, shift),
    )
