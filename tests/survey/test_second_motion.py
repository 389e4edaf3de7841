"""Tie points of two rigid bodies that move against each other are reported; errors by chance are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.camera import project
from sfm.network import Estimate, Network, empty_estimate
from sfm.orientation.incremental.sequence import Orientation, orient
from sfm.survey.diagnosis.lost_photographs import MOTION_POINTS, find_second_motion
from sfm.survey.orientation import refine
from tests.synthetic import make_network, seed_of

IMAGES, POINTS, NOISE_PX = 8, 200, 0.1


def walked(count: int, *, by_chance: bool = False) -> tuple[Network, Estimate]:
    """Return a network of which the last points walk on together from photograph to photograph, and the rest.

    Args:
        count: of these points.
        by_chance: whether each has errors of its own instead.
    """
    rng = seed_of("second motion")
    network, truth = make_network(rng, images=IMAGES, points=POINTS, free=(), noise_px=NOISE_PX)
    seen, xy = network.image_points, network.image_points.xy.copy()
    for i in range(IMAGES):
        rows = np.flatnonzero((seen.image == i) & (seen.point >= POINTS - count))
        moved = truth.points + 0.03 * i * np.array([1.0, 0.5, 0.2])
        at = project(truth.cameras[0], truth.position[i], truth.rotation[i], moved[seen.point[rows]])
        xy[rows] = at + NOISE_PX * rng.standard_normal(at.shape)
        if by_chance:
            xy[rows] = seen.xy[rows] + rng.uniform(-60, 60, at.shape)
    return replace(network, image_points=replace(seen, xy=xy)), truth


def oriented(network: Network, truth: Estimate) -> Orientation:
    return orient(network, empty_estimate(network, truth.cameras), refine=refine)


def orient_again(network: Network, start: Estimate) -> Orientation:
    return orient(network, start, refine=refine)


@pytest.mark.parametrize("count", [60, MOTION_POINTS + 5])
def test_points_that_walk_on_together_are_reported_with_their_share(count: int) -> None:
    network, truth = walked(count)
    (found,) = find_second_motion(network, oriented(network, truth), orient_again)
    assert found.kind == "second_motion" and found.severity == "error"
    assert found.number("share") == pytest.approx(count / POINTS, abs=0.02)
    assert found.number("points") == pytest.approx(count, abs=4) and len(found.names("photographs")) == IMAGES


def test_errors_by_chance_are_no_motion() -> None:
    network, truth = walked(60, by_chance=True)
    found = oriented(network, truth)
    assert found.estimate.oriented.all()
    assert find_second_motion(network, found, orient_again) == ()


@pytest.mark.parametrize("count", [0, MOTION_POINTS - 2])
def test_few_points_are_not_even_tried(count: int) -> None:
    network, truth = walked(count)

    def refuse(_: Network, __: Estimate) -> Orientation:
        raise AssertionError("tried")

    assert find_second_motion(network, oriented(network, truth), refuse) == ()


def test_photographs_without_orientation_have_their_own_reason() -> None:
    """Their points are not those of another motion, as where they show another object."""
    network, truth = walked(60)
    found = oriented(network, truth)
    position = found.estimate.position.copy()
    position[2:] = np.nan
    found = replace(found, estimate=replace(found.estimate, position=position))
    assert find_second_motion(network, found, orient_again) == ()
