"""A simulated network on an object with a plate, a flange, a pipe and a dish, adjusted with a scale bar."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

import sfm
from sfm.model.camera import camera_from_values, project
from sfm.model.conventions import FloatArray
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.solution import Solution
from tests.synthetic import seed_of

SIZE_PX = (2000, 1500)
NOISE_PX = 0.05
DIAMETERS = {"flange": 1.0, "pipe": 0.3}  # m
FOCAL_LENGTH = 0.3  # of the dish, m
HEIGHT = 0.2  # of the flange above the plate, m


def object_points() -> tuple[tuple[str, ...], FloatArray]:
    """Return names and coordinates (m): c1.. flange, p1.. plate, z1.. pipe, d1.. dish."""
    rng = seed_of("bench")
    turn = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    r = DIAMETERS["flange"] / 2
    flange = np.stack([r * np.cos(turn), r * np.sin(turn), np.full(16, HEIGHT)], axis=1)
    grid = np.linspace(-0.6, 0.6, 5)
    plate = np.array([[x, y, 0.0] for x in grid for y in grid])
    turn = rng.uniform(0, 2 * np.pi, 20)
    r = DIAMETERS["pipe"] / 2
    pipe = np.stack([r * np.cos(turn), r * np.sin(turn), rng.uniform(0.1, 0.6, 20)], axis=1)
    r, turn = 0.35 * np.sqrt(rng.uniform(0, 1, 24)), rng.uniform(0, 2 * np.pi, 24)
    dish = np.stack([r * np.cos(turn), r * np.sin(turn), r * r / (4 * FOCAL_LENGTH) - 0.4], axis=1)
    names = [f"{kind}{k + 1}" for kind, own in (("c", flange), ("p", plate), ("z", pipe), ("d", dish))
             for k in range(len(own))]  # fmt: skip
    return tuple(names), np.vstack([flange, plate, pipe, dish])


def bench_network(seed: str, *, images: int = 10) -> tuple[Network, Estimate]:
    """Return the network with noise that depends on the seed, and its truth."""
    rng = seed_of(seed)
    names, xyz = object_points()
    camera = camera_from_values(
        "camera", "brown", SIZE_PX, (0.005, 0.005), c_mm=10.0, free=("c",), values=(("K1", 8e-4),)
    )
    azimuth = 2 * np.pi * np.arange(images) / images
    lift = np.where(np.arange(images) % 2, 0.5, 1.1)
    position = 4 * np.stack(
        [np.cos(lift) * np.cos(azimuth), np.cos(lift) * np.sin(azimuth), np.sin(lift)], axis=1
    )
    rotation = np.empty((images, 3, 3))
    for i, z in enumerate(position / 4):
        x = np.cross([0.0, 0, 1], z)
        x /= np.linalg.norm(x)
        turn = np.pi / 2 * (i % 4)
        roll = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
        rotation[i] = np.stack([x, np.cross(z, x), z], axis=1) @ roll
    xy = np.concatenate([project(camera, position[i], rotation[i], xyz) for i in range(images)])
    network = sfm.Network.from_arrays(
        [f"image {i + 1}" for i in range(images) for _ in names],
        names * images,
        xy + NOISE_PX * rng.standard_normal(xy.shape),
        sigma_px=NOISE_PX,
    )
    bar = float(np.linalg.norm(xyz[names.index("p1")] - xyz[names.index("p25")]))
    network = network.with_scale_bar("p1", "p25", bar + 1e-5 * rng.standard_normal(), 1e-5)
    return network, Estimate((camera,), position, rotation, xyz)


def bench_result(seed: str) -> Solution:
    """Return an adjusted network as files hold it, with the covariance of all points.

    Nothing is rejected: its noise has no gross errors. Data snooping at 0.1 % takes 1.8 good image points of
    850 away, by which sigma0^2 falls by 1.5 % and the statistics of shapes rise by 3 % (46 in place of 37 of
    600 fits rejected at 5 %).
    """
    network, truth = bench_network(seed)
    a = sfm.adjust(network, truth, reject="none")
    return replace(a.solution, name="bench", unit="m").with_joint_covariance


@lru_cache
def one_bench() -> Solution:
    """Return the same result for all tests of a module."""
    return bench_result("one bench")


def without_covariance(result: Solution) -> Solution:
    """Return a result as another program would give it."""
    return replace(result, point_covariance=None, covariance=None, position_covariance=None)
