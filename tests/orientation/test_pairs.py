"""Two photographs are a survey: stereo rigs, single views among the common points, planes, and refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, empty_estimate
from sfm.model.remarks.remark import kinds_of
from sfm.model.similarity import fit_similarity
from sfm.orientation.incremental.sequence import orient
from tests.synthetic import make_network, seed_of


def pair(name: str, *, single: int = 1, planar: bool = False) -> tuple[Network, Estimate]:
    """Two photographs of 50 points, of which some are not measured in the second."""
    network, truth = make_network(seed_of(name), images=6, points=50, planar=planar, free=())
    seen = network.image_points
    inner = np.argsort(np.linalg.norm(truth.points, axis=1))[:single]
    keep = (seen.image < 2) & ~((seen.image == 1) & np.isin(seen.point, inner))
    two = replace(
        network, images=network.images[:2], camera=network.camera[:2], image_points=seen.select(keep)
    )
    return two, replace(truth, position=truth.position[:2], rotation=truth.rotation[:2])


def largest_error(points: np.ndarray, truth: np.ndarray) -> float:
    known = np.isfinite(points[:, 0])
    moved = fit_similarity(points[known], truth[known]).apply(points[known])
    return float(np.linalg.norm(moved - truth[known], axis=1).max())


@pytest.mark.parametrize("single", [1, 12])
def test_points_of_one_photograph_do_not_undo_a_pair(single: int) -> None:
    network, truth = pair("pair", single=single)
    found = orient(network, empty_estimate(network, truth.cameras))
    assert found.failures == () and found.kind == "spatial" and found.remarks == ()
    assert found.estimate.determined.sum() == 50 - single
    assert largest_error(found.estimate.points, truth.points) < 0.01


def test_names_of_another_object_contradict_a_pair() -> None:
    """Ten common points leave five conditions, against which more points in their midst speak."""
    network, truth = pair("strange pair", single=40)
    with pytest.raises(GeometryError, match="0 of 2 photographs could be oriented") as error:
        orient(network, empty_estimate(network, truth.cameras))
    assert error.match(
        r"image 1: Its image points contradict the network: \d\d of \d\d, and 5 conditions confirm it"
    )
    assert error.match("image 2: ")


def test_a_plane_has_two_orientations_in_two_photographs() -> None:
    network, truth = pair("plane d", single=0, planar=True)
    start = empty_estimate(network, truth.cameras)
    found = orient(network, start)
    assert kinds_of(found.remarks) == ("plane_ambiguous",)
    assert found.remarks[0].names("photographs") == ("image 1", "image 2")

    def misfit(estimate: Estimate) -> float:
        return largest_error(estimate.points, truth.points)

    judged = orient(network, start, judge=misfit)
    assert judged.remarks == () and misfit(judged.estimate) < 0.01

    def opposite(estimate: Estimate) -> float:
        return 1 / misfit(estimate)

    assert misfit(orient(network, start, judge=opposite).estimate) > 0.1


def test_a_stereo_rig_with_a_small_base() -> None:
    """A base of 0.25 m at 4 m: 3.6 degrees, which no survey of more photographs would start from."""
    network, truth = make_network(seed_of("rig"), images=2, points=50, free=(), noise_px=0.0)
    position, rotation = truth.position.copy(), truth.rotation.copy()
    position[1], rotation[1] = position[0] + 0.25 * rotation[0][:, 0], rotation[0]
    network, truth = seen_from(network, replace(truth, position=position, rotation=rotation))
    found = orient(network, empty_estimate(network, truth.cameras))
    assert found.failures == ()
    assert largest_error(found.estimate.points, truth.points) < 0.02
    position[1] = position[0] + 0.1 * rotation[0][:, 0]
    network, truth = seen_from(network, replace(truth, position=position))
    with pytest.raises(GeometryError, match=r"1\.\d degrees at most \(median\), 3 are needed"):
        orient(network, empty_estimate(network, truth.cameras))


def seen_from(network: Network, truth: Estimate) -> tuple[Network, Estimate]:
    """Return the network as its two photographs see all points, 0.02 px noise."""
    from sfm.model.camera import project

    noise = 0.02 * seed_of("seen from").standard_normal((2 * len(truth.points), 2))
    xy = np.concatenate(
        [project(truth.cameras[0], truth.position[i], truth.rotation[i], truth.points) for i in range(2)]
    )
    n = len(truth.points)
    image_points = ImagePoints(
        np.repeat([0, 1], n), np.tile(np.arange(n), 2), xy + noise, np.tile(4e-4 * np.eye(2), (2 * n, 1, 1))
    )
    return replace(network, image_points=image_points), truth
