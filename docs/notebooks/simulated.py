"""Simulated measurements for the notebooks: an object, a ring of photographs, and what they show of it."""

from __future__ import annotations

import numpy as np

import sfm
from sfm.model.camera import project
from sfm.model.conventions import FloatArray

NOISE_PX = 0.1
LENS = (("K1", 4e-4), ("x0", 0.06), ("y0", -0.04))


def lens(free: tuple[str, ...] = ("c", "x0", "y0", "K1"), model: str = "brown") -> sfm.Camera:
    """Return the true camera: 3000 x 2000 px of 8 µm, 20 mm, a barrel lens."""
    return sfm.camera_from_values(
        "lens", model, (3000, 2000), (0.008, 0.008), c_mm=20.0, free=free, values=LENS
    )


def stations(count: int, distance: float, elevation_deg: float) -> tuple[FloatArray, FloatArray]:
    """Return projection centres, m, and rotations of photographs from a ring, every other one rolled."""
    positions, rotations = [], []
    for i, azimuth in enumerate(np.linspace(0, 2 * np.pi, count, endpoint=False)):
        elevation = np.deg2rad(elevation_deg + 12 * (i % 3 - 1))
        back = np.array(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        )
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        if i % 2:
            right = np.cross(back, right)
        positions.append(distance * back)
        rotations.append(np.column_stack([right, np.cross(back, right), back]))
    return np.array(positions), np.array(rotations)


def photographed(
    names: tuple[str, ...], xyz: FloatArray, seed: int, *, count: int = 12, camera: sfm.Camera | None = None
) -> tuple[sfm.Network, sfm.Estimate]:
    """Return noisy image points of an object, and the truth.

    Args:
        names: of the object points.
        xyz: their coordinates, m, (n, 3).
        seed: of the noise.
        count: photographs.
        camera: of all photographs.
    """
    camera = camera or lens()
    rng = np.random.default_rng(seed)
    positions, rotations = stations(count, distance=3.0, elevation_deg=45.0)
    rows = []
    for i in range(count):
        xy = project(camera, positions[i], rotations[i], xyz)
        inside = ((xy > 0) & (xy < np.array(camera.size_px) - 1)).all(axis=1)
        rows += [(f"IMG_{i + 1}", names[j], xy[j]) for j in np.flatnonzero(inside)]
    image, point, xy = zip(*rows, strict=True)
    measured = np.array(xy) + rng.normal(0.0, NOISE_PX, (len(rows), 2))
    network = sfm.Network.from_arrays(image, point, measured, sigma_px=NOISE_PX)
    order = [names.index(name) for name in network.points]
    which = [int(name.removeprefix("IMG_")) - 1 for name in network.images]
    return network, sfm.Estimate((camera,), positions[which], rotations[which], xyz[order])
