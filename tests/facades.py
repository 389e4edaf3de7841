"""Tie points of a shallow façade, as a camera walking past a church front sees it; object unit m.

Relief of a thirtieth of the distance and moderate angles: from a few photographs the façade and its reversal
in depth look almost alike, for all photographs or for a part of them, and a start tolerance of the usual size
tells them apart badly. `facade_network` returns the network and its truth; the start situation (focal length,
path, aims, outliers) is drawn from the generator of the caller.
"""

from __future__ import annotations

import numpy as np

from sfm.model.camera import camera_from_values, project
from sfm.model.conventions import FloatArray
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network

SIZE_PX = (1536, 1024)
PIXEL_MM = (0.0156, 0.0156)  # a sensor of 24 mm
FREE = ("c", "x0", "y0", "K1", "K2")


def facade_network(
    rng: np.random.Generator,
    *,
    images: int = 8,
    points: int = 900,
    relief: float = 0.5,
    arc_deg: tuple[float, float] = (20.0, 120.0),
    outliers: float = 0.01,
    noise_px: float = 0.15,
    sigma_px: float | None = None,
) -> tuple[Network, Estimate]:
    """Return tie points of a façade of 20 m x 12 m with a relief, and the truth.

    Args:
        rng: source of all randomness.
        images, points: how many photographs and object points.
        relief: standard deviation of the depth of the points, m.
        outliers: share of image points that are anywhere within 40 px.
        noise_px: standard deviation of an image coordinate, px.
        sigma_px: the stated one, px; as noise_px if not given.
    """
    c_mm = rng.uniform(18.0, 40.0)
    camera = camera_from_values(
        "camera", "brown", SIZE_PX, PIXEL_MM, c_mm=c_mm, free=FREE,
        values=(("x0", 0.1), ("y0", -0.08), ("K1", rng.uniform(-1, 2) * 1e-4), ("K2", -1e-7)),
    )  # fmt: skip
    xyz = rng.uniform((-10, 0, 0), (10, 12, 0), (points, 3))
    steps = np.round(2 * np.sin(xyz[:, 0] * 1.3) * np.cos(xyz[:, 1])) / 2  # buttresses and niches
    xyz[:, 2] = relief * (steps + 0.2 * rng.standard_normal(points))
    distance = rng.uniform(0.7, 1.2) * 14 * c_mm / 24
    half_arc = np.radians(rng.uniform(*arc_deg)) / 2  # the stations lie on an arc, as far as the place allows
    along = np.linspace(-half_arc, half_arc, images) + rng.normal(0, 0.15, images) * half_arc / images
    away = distance * rng.uniform(0.85, 1.15, images)
    position = np.column_stack([away * np.sin(along), rng.uniform(1.4, 2.2, images), away * np.cos(along)])
    aim = np.column_stack([rng.uniform(-2, 2, images), rng.uniform(4, 7, images), np.zeros(images)])
    rotation = np.array([_look(p, a, rng.normal(0, 0.02)) for p, a in zip(position, aim, strict=True)])
    truth = Estimate((camera,), position, rotation, xyz)
    run = rng.choice([3, 4, 5], points, p=[0.6, 0.3, 0.1])  # neighbouring photographs that show a point
    first = rng.integers(0, np.maximum(images - run + 1, 1))
    rows = []
    for i in range(images):
        xy = project(camera, position[i], rotation[i], xyz)
        j = np.flatnonzero(np.isfinite(xy).all(1) & (xy > 0).all(1) & (xy < np.array(SIZE_PX) - 1).all(1))
        j = j[(np.abs(first[j] + (run[j] - 1) / 2 - i) <= (run[j] - 1) / 2) & (rng.random(len(j)) < 0.9)]
        rows.append((np.full(len(j), i), j, xy[j]))
    image, point, xy = (np.concatenate(part) for part in zip(*rows, strict=True))
    xy = xy + noise_px * rng.standard_normal(xy.shape)
    wrong = rng.random(len(xy)) < outliers
    xy[wrong] += rng.uniform(-40, 40, (int(wrong.sum()), 2))
    network = Network(
        tuple(f"P{i + 1}.jpg" for i in range(images)),
        np.zeros(images, dtype=np.int64),
        tuple(f"t{j + 1:05d}" for j in range(points)),
        ImagePoints(image, point, xy, np.tile((sigma_px or noise_px) ** 2 * np.eye(2), (len(xy), 1, 1))),
    )
    return network, truth


def _look(position: FloatArray, aim: FloatArray, roll: float) -> FloatArray:
    """Return the rotation of a camera that looks at a place, its y axis up."""
    z = (position - aim) / np.linalg.norm(position - aim)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    return np.column_stack([x * np.cos(roll) + y * np.sin(roll), y * np.cos(roll) - x * np.sin(roll), z])
