"""Points that are too far away to be intersected are left out by name, and do not stop a survey."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.camera import project
from sfm.network import Estimate, ImagePoints, Network
from sfm.pipeline import run_survey
from tests.surveys import survey_of
from tests.synthetic import SIZE_PX, make_network, observed_anew, seed_of

NOISE_PX = 0.1


def network_with_far_points(number: int, count: int, distance: float) -> tuple[Network, Estimate]:
    """Return photographs from above of 30 points, and of points so far below them, in units of the object."""
    rng = seed_of(f"far points {number}")
    network, truth = make_network(rng, points=30, planar=True)
    relief = rng.uniform(-0.2, 0.2, (30, 1)) * [0, 0, 1]
    truth = replace(truth, points=truth.points + relief)
    network = observed_anew(network, truth, NOISE_PX, rng)
    sideways = rng.uniform(-0.2, 0.2, (count, 2))
    far = distance * np.column_stack([sideways, -np.ones(count)])
    seen, rows = network.image_points, []
    for i in range(len(network.images)):
        xy = project(truth.cameras[0], truth.position[i], truth.rotation[i], far)
        inside = ((xy > 0) & (xy < np.array(SIZE_PX) - 1)).all(axis=1)
        rows += [(i, 30 + j, *(xy[j] + NOISE_PX * rng.standard_normal(2))) for j in np.flatnonzero(inside)]
    image, point, x, y = np.array(rows).T
    both = ImagePoints(
        np.concatenate([seen.image, image.astype(np.int64)]),
        np.concatenate([seen.point, point.astype(np.int64)]),
        np.concatenate([seen.xy, np.column_stack([x, y])]),
        np.concatenate([seen.covariance, np.tile(seen.covariance[:1], (len(rows), 1, 1))]),
    )
    names = (*network.points, *(f"far {k + 1}" for k in range(count)))
    return (
        replace(network, points=names, image_points=both),
        replace(truth, points=np.vstack([truth.points, far])),
    )


@pytest.mark.parametrize(
    ("count", "distance"),
    [
        (1, 1e4),
        (8, 1e4),
        (4, 1e7),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in ((4, 1e4), (1, 1e5), (4, 1e5))),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in ((8, 1e5), (1, 1e7), (8, 1e7))),
    ],
)
def test_far_points_are_left_out_by_name(count: int, distance: float) -> None:
    for number in range(3):
        network, truth = network_with_far_points(number, count, distance)
        result = run_survey(survey_of(network, truth))
        assert len(result.network.images) == len(network.images) and result.adjustment.converged
        assert set(result.network.points) == set(network.points[:30])
        measured = {network.points[j] for j in np.flatnonzero(network.rays())}
        assert {one.point for one in result.left_out} == measured - set(network.points[:30])
        assert {one.reason.kind for one in result.left_out} <= {
            "point_with_parallel_rays",
            "point_with_few_rays",
            "point_with_rays_apart",
        }


def test_points_at_a_distance_that_is_measured_stay() -> None:
    """A hundred object sizes away they have a parallax of some 60 px."""
    network, truth = network_with_far_points(0, 3, 100.0)
    seen = network.rays()[30:] >= 2
    result = run_survey(survey_of(network, truth))
    assert seen.any() and {network.points[30 + j] for j in np.flatnonzero(seen)} <= set(result.network.points)
