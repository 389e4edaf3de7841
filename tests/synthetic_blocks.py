"""Synthetic blocks and unordered collections of many photographs, and how tests adjust them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.model.camera import Camera, camera_from_values, project
from sfm.model.conventions import FloatArray, IntArray, rotation_from_vector
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network
from tests.synthetic import seed_of

SIZE_PX, NOISE_PX = (2000, 1500), 0.1
HEIGHT, FOOTPRINT = 100.0, np.array([100.0, 75.0])
FREE = ("c", "x0", "y0", "K1", "P1", "P2")


def lens(free: tuple[str, ...] = FREE) -> Camera:
    return camera_from_values(
        "A", "brown", SIZE_PX, (0.005, 0.005), c_mm=10.0, free=free, values=(("K1", -1e-4),)
    )


def aerial(
    name: str,
    strips: int,
    per_strip: int,
    points: int,
    *,
    rays: float = 6.0,
    tilt: float = 0.05,
    hills: float = 8.0,
    noise_px: float = NOISE_PX,
) -> tuple[Network, Estimate]:
    """A block of near-nadir photographs in strips, and its truth."""
    rng = np.random.default_rng(seed_of(name))
    m = strips * per_strip
    step = np.sqrt(FOOTPRINT.prod() / rays) * np.array([1.1, 1 / 1.1])
    strip, place = np.divmod(np.arange(m), per_strip)
    shuffled = rng.permutation(m)  # the order in which photographs are named says nothing
    X0 = np.stack([place * step[0], strip * step[1], np.full(m, HEIGHT)], axis=1)[shuffled]
    X0 += rng.normal(0, 1, X0.shape) * (tilt > 0)
    R = rotation_from_vector(rng.normal(0, 1, (m, 3)) * tilt)
    X = np.empty((points, 3))
    X[:, :2] = rng.uniform(-FOOTPRINT / 4, np.array([per_strip, strips]) * step, (points, 2))
    X[:, 2] = hills * np.sin(X[:, 0] / 37) * np.cos(X[:, 1] / 29)
    return photographed(Estimate((lens(),), X0, R, X), np.ones((m, points), dtype=bool), rng, noise_px)


def unordered(name: str, photographs: int, points: int, rays: int) -> tuple[Network, Estimate]:
    """Photographs all around a cloud of points, each point seen in a few photographs at random."""
    rng = np.random.default_rng(seed_of(name))
    z = rng.normal(size=(photographs, 3))
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    x = np.cross([0.1, 0.2, 1.0], z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    R = np.stack([x, np.cross(z, x), z], axis=2)
    X = rng.uniform(-0.7, 0.7, (points, 3))
    seen = rng.random((photographs, points)).argsort(axis=0) < rays
    return photographed(Estimate((lens(),), 4 * z, R, X), seen, rng)


def photographed(
    truth: Estimate, seen: IntArray, rng: np.random.Generator, noise_px: float = NOISE_PX
) -> tuple[Network, Estimate]:
    """The noisy image points of points with at least two rays, and the truth of these."""
    image, point, xy = [], [], []
    for i, on in enumerate(seen):
        j = np.flatnonzero(on)
        pixel = project(truth.cameras[0], truth.position[i], truth.rotation[i], truth.points[j])
        inside = ((pixel > 0) & (pixel < np.array(SIZE_PX) - 1)).all(axis=1)
        image.append(np.full(inside.sum(), i))
        point.append(j[inside])
        xy.append(pixel[inside] + noise_px * rng.standard_normal((inside.sum(), 2)))
    i, j, measured = (np.concatenate(part) for part in (image, point, xy))
    used = np.bincount(j, minlength=len(truth.points)) >= 2
    on, number = used[j], np.cumsum(used) - 1
    k = int(on.sum())
    network = Network(
        tuple(f"{i}" for i in range(len(seen))),
        np.zeros(len(seen), dtype=np.int64),
        tuple(f"{j}" for j in range(used.sum())),
        ImagePoints(i[on], number[j[on]], measured[on], np.tile(np.eye(2) * NOISE_PX**2, (k, 1, 1))),
    )
    return network, replace(truth, points=truth.points[used])


def spoiled(truth: Estimate, name: str, size: float) -> Estimate:
    """Start values: positions and points off by a share of the distance, 0.3 deg, c by 0.5 %."""
    rng = np.random.default_rng(seed_of(name + " start"))
    c = truth.cameras[0]
    factors = np.where(np.arange(len(c.parameters)) == 0, 1.005, 0)
    return Estimate(
        (c.with_parameters(c.parameters * factors),),
        truth.position + rng.normal(0, size, truth.position.shape),
        truth.rotation @ rotation_from_vector(rng.normal(0, 0.005, truth.position.shape)),
        truth.points + rng.normal(0, size, truth.points.shape),
    )


def run(network: Network, start: Estimate, covariance: bool = True, **options: Any) -> Adjustment:
    return adjust(
        network,
        start,
        datum=Datum("free"),
        reject="none",
        covariance=covariance,
        options=AdjustmentOptions(**options),
    )


def in_sigmas(Q: FloatArray, reference: FloatArray) -> float:
    """Largest difference of two covariances over the product of the standard deviations."""
    sigma = np.sqrt(np.diagonal(reference, axis1=-2, axis2=-1))
    return float(np.abs((Q - reference) / (sigma[..., :, None] * sigma[..., None, :])).max())
