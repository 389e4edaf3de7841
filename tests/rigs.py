"""Synthetic surveys of rigs: some cameras on one frame, photographed with at several moments."""

from __future__ import annotations

import numpy as np

from sfm.model.camera import project
from sfm.model.conventions import FloatArray, rotation_from_vector
from sfm.model.estimate import Estimate, Mounts
from sfm.model.network import ImagePoints, Network
from tests.synthetic import SIZE_PX, make_network


def make_rig(
    rng: np.random.Generator,
    *,
    cameras: int = 2,
    moments: int = 10,
    points: int = 40,
    noise_px: float = 0.1,
    free: tuple[str, ...] = (),
    planar: bool = False,
    figure: FloatArray | None = None,
) -> tuple[Network, Estimate]:
    """Return a network of a rig with noisy image points, and its truth.

    Photographs are in the order of moments, and of cameras in each; camera 1 is the reference.

    Args:
        rng: source of all randomness.
        cameras, moments, points: how many there are.
        noise_px: standard deviation of an image coordinate, px.
        free: parameters of interior orientation to adjust.
        planar: whether all points lie in one plane.
        figure: the first object points, (n, 3).
    """
    network, seen = make_network(rng, images=cameras * moments, points=points, free=free, cameras=cameras,
                                 planar=planar, figure=figure)  # fmt: skip
    a, width = np.arange(cameras), 0.4 / max(cameras - 1, 1)
    mounts = Mounts(
        np.stack([width * a, 0.05 * np.sin(a), 0.04 * np.sin(2 * a)], axis=1),
        np.array(
            [rotation_from_vector(np.array([0.02 * np.sin(k), width * k / 4, 0.3 * np.sin(k)])) for k in a]
        ),
        np.tile(a[:, None] > 0, (1, 6)),
        ("rig",) * cameras,
    )
    first = np.arange(moments) * cameras
    moment, camera = np.repeat(np.arange(moments), cameras), np.tile(a, moments)
    position, rotation = seen.position[first][moment], seen.rotation[first][moment]
    truth = Estimate(
        seen.cameras,
        position + np.einsum("mab,mb->ma", rotation, mounts.position[camera]),
        rotation @ mounts.rotation[camera],
        seen.points,
        mounts,
    )
    rows = []
    for i, of in enumerate(camera):
        xy = project(truth.cameras[of], truth.position[i], truth.rotation[i], truth.points)
        inside = np.isfinite(xy).all(1) & (xy > 0).all(1) & (xy < np.array(SIZE_PX) - 1).all(1)
        j = np.flatnonzero(inside)
        rows.append((np.full(len(j), i), j, xy[j]))
    image, point, xy = (np.concatenate(part) for part in zip(*rows, strict=True))
    measured = ImagePoints(
        image,
        point,
        xy + noise_px * rng.standard_normal(xy.shape),
        np.tile(max(noise_px, 0.01) ** 2 * np.eye(2), (len(xy), 1, 1)),
    )
    names = tuple(f"moment {t + 1} camera {c + 1}" for t, c in zip(moment, camera, strict=True))
    return Network(names, camera, network.points, measured, moment=moment), truth
