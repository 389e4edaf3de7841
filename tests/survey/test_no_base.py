"""Photographs from one place are refused; those with a base, and a wall from the front, are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.camera import camera_from_values, project
from sfm.conventions import FloatArray
from sfm.errors import GeometryError
from sfm.network import Estimate, Network
from sfm.survey.diagnosis.lost_photographs import MIN_PARALLAX, refuse_no_base
from tests.synthetic import seed_of

SIGMA_PX, C_PX, SIZE_PX = 0.1, 600.0, (640, 480)
IMAGES, POINTS, DISTANCE = 6, 300, 5.0


def turned(base_px: float, *, frontal: bool = False, distant: float = 0.0) -> tuple[Network, Estimate]:
    """Return photographs side by side, the image points of each moved by so many px against the last.

    Args:
        base_px: parallax of neighbours at the middle distance.
        frontal: a wall from the front; else an object in space, and the camera turns.
        distant: part of the points a hundred times as far away.
    """
    rng = seed_of("no base")
    lens = () if frontal else (("K1", -2e-4),)
    camera = camera_from_values(
        "a", "brown", SIZE_PX, (0.01, 0.01), c_mm=C_PX * 0.01, values=lens, free=("c",)
    )
    step = base_px * DISTANCE / C_PX
    position = np.column_stack([step * np.arange(IMAGES), np.zeros((IMAGES, 2))])
    angle = np.zeros(IMAGES) if frontal else np.linspace(-0.3, 0.3, IMAGES)
    depth = np.full(POINTS, DISTANCE) if frontal else rng.uniform(0.7, 3.0, POINTS) * DISTANCE
    depth = np.where(np.arange(POINTS) < distant * POINTS, 100 * DISTANCE, depth)
    spread = rng.uniform(-0.7, 0.7, (POINTS, 2))
    points = np.column_stack([spread * depth[:, None], -depth])
    names, places, xy = [], [], []
    for i in range(IMAGES):
        at = project(camera, position[i], _about_y(angle[i]), points)
        for j in np.flatnonzero((at > 0).all(axis=1) & (at < np.array(SIZE_PX)).all(axis=1)):
            names.append(f"image {i}")
            places.append(str(j))
            xy.append(at[j] + SIGMA_PX * rng.standard_normal(2))
    network = Network.from_arrays(names, places, np.array(xy), sigma_px=SIGMA_PX)
    given = camera_from_values("a", "brown", SIZE_PX, (0.01, 0.01), c_mm=1.3 * C_PX * 0.01, free=("c",))
    rotation = np.tile(np.eye(3), (IMAGES, 1, 1))
    return network, Estimate((given,), position, rotation, np.zeros((len(network.points), 3)))


def _about_y(angle: float) -> FloatArray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


@pytest.mark.parametrize("parallax", [0.0, 0.5])
def test_photographs_from_one_place_are_refused_with_their_parallax(parallax: float) -> None:
    network, start = turned(parallax * MIN_PARALLAX * SIGMA_PX)
    with pytest.raises(GeometryError, match="no base: the 6 photographs were taken from one place"):
        refuse_no_base(network, start.cameras)


@pytest.mark.parametrize("parallax", [12.0, 60.0])
def test_a_base_of_some_pixels_is_one(parallax: float) -> None:
    network, start = turned(parallax * MIN_PARALLAX * SIGMA_PX)
    refuse_no_base(network, start.cameras)


def test_one_photograph_from_another_place_gives_a_base() -> None:
    network, start = turned(0.0)
    moved, _ = turned(60.0)
    last = network.image_points.image == IMAGES - 1
    names = {(int(i), network.points[j]): k for k, (i, j) in enumerate(_rows(network))}
    other = {(int(i), moved.points[j]): k for k, (i, j) in enumerate(_rows(moved))}
    xy = network.image_points.xy.copy()
    both = [(k, other[key]) for key, k in names.items() if last[k] and key in other]
    assert len(both) > 20
    keep = ~last
    for k, there in both:
        xy[k], keep[k] = moved.image_points.xy[there], True
    seen = replace(network.image_points, xy=xy).select(keep)
    refuse_no_base(replace(network, image_points=seen), start.cameras)


def _rows(network: Network) -> list[tuple[int, int]]:
    seen = network.image_points
    return list(zip(seen.image.tolist(), seen.point.tolist(), strict=True))


@pytest.mark.parametrize("parallax_px", [30.0, 90.0])
def test_a_wall_from_the_front_is_no_camera_that_turns(parallax_px: float) -> None:
    network, start = turned(parallax_px, frontal=True)
    refuse_no_base(network, start.cameras)


def test_few_points_in_common_say_nothing() -> None:
    network, start = turned(0.0)
    few = network.image_points.point < 10
    refuse_no_base(replace(network, image_points=network.image_points.select(few)), start.cameras)


def test_a_near_object_before_distant_hills_has_a_base() -> None:
    network, start = turned(60.0 * MIN_PARALLAX * SIGMA_PX, distant=0.75)
    refuse_no_base(network, start.cameras)
