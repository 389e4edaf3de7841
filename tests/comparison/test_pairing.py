"""Which point of one result is which of another: by names that mean something, image points, or place."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapters.formats.registry import format_named, read_comparable, write_any
from sfm.comparison.camera_conversion import convert_cameras, undistort
from sfm.comparison.pairing import pair_results
from sfm.comparison.significance import compare_results
from sfm.model.conventions import rotation_from_vector
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.similarity import Similarity
from sfm.model.solution import Solution
from tests.synthetic import make_network, seed_of

CODED = 12  # of the points bear codes, the others numbers of one run


def named(network: Network) -> Network:
    """The same with codes for the first points and numbers for the others."""
    n = len(network.points)
    return replace(network, points=tuple(str(100 + j) if j < CODED else f"u{j + 1:03d}" for j in range(n)))


def run_again(network: Network, truth: Estimate, *, turn: Similarity | None = None) -> Solution:
    """Another run on the same photographs: uncoded points numbered anew, measured anew, maybe elsewhere."""
    rng = seed_of("again")
    n = len(network.points)
    order = np.concatenate([np.arange(CODED), CODED + rng.permutation(n - CODED)])
    place = np.argsort(order)
    seen = network.image_points
    xy = seen.xy + 0.05 * rng.standard_normal(seen.xy.shape)
    names = tuple(network.points[j] for j in range(n))  # the numbers stay, the points behind them do not
    again = replace(network, points=names, image_points=replace(seen, point=place[seen.point], xy=xy))
    estimate = replace(truth, points=truth.points[order])
    return Solution("again", again, estimate if turn is None else turn.apply_estimate(estimate))


@pytest.fixture(scope="module")
def run() -> tuple[Network, Estimate]:
    network, truth = make_network(seed_of("pairing"), images=6, points=60, model="opencv")
    return named(network), truth


def test_uncoded_points_are_recognised_by_their_image_points(run: tuple[Network, Estimate]) -> None:
    found = compare_results(Solution("first", *run), run_again(*run))
    assert len(found.points) == 60
    assert (found.pairing.points_by_name, found.pairing.points_by_image_points) == (CODED, 60 - CODED)
    assert np.abs(found.point_difference).max() < 1e-12


def test_and_by_their_place_where_the_photographs_are_others(run: tuple[Network, Estimate]) -> None:
    turn = Similarity(2.0, rotation_from_vector(np.array([0.3, -0.8, 0.2])), np.array([3.0, 1.0, -2.0]))
    other = run_again(*run, turn=turn)
    other = replace(other, network=replace(other.network, images=tuple(f"b{i}" for i in range(6))))
    found = compare_results(Solution("first", *run), other)
    assert found.pairing.points_by_name == CODED and found.pairing.points_by_place > 40
    assert np.abs(found.point_difference).max() < 1e-9
    assert len(found.images) == 0


def test_one_point_moved_is_still_recognised(run: tuple[Network, Estimate]) -> None:
    other = run_again(*run)
    points = other.estimate.points.copy()
    points[30] += [0.01, 0, 0]
    found = compare_results(
        Solution("first", *run), replace(other, estimate=replace(other.estimate, points=points))
    )
    assert np.sort(np.linalg.norm(found.point_difference, axis=1))[-1] == pytest.approx(0.01, rel=0.05)


def test_numbers_that_mean_nothing_are_never_compared(run: tuple[Network, Estimate]) -> None:
    """Two results without codes and of other photographs in other frames have nothing in common."""
    network, truth = run
    uncoded = replace(network, points=tuple(f"u{j + 1:03d}" for j in range(60)))
    turn = Similarity(2.0, rotation_from_vector(np.array([0.3, -0.8, 0.2])), np.array([3.0, 1.0, -2.0]))
    other = Solution(
        "b", replace(uncoded, images=tuple(f"b{i}" for i in range(6))), turn.apply_estimate(truth)
    )
    with pytest.raises(GeometryError, match="no points and no photographs in common"):
        compare_results(Solution("a", uncoded, truth), other)


@pytest.mark.parametrize("form", ["colmap-text", "bal", "sba", "tables"])
def test_a_result_is_paired_with_its_own_file_of_any_format(form: str, tmp_path: Path) -> None:
    """Formats that number photographs and points: paired by image points or place, and no difference."""
    network, truth = make_network(seed_of("files"), images=6, points=40, model="opencv", noise_px=0.1)
    camera = truth.cameras[0]
    values = dict(zip(camera.names, camera.parameters, strict=True)) | {"p1": 0.0, "p2": 0.0}
    values["fy"] = values["fx"]
    if form == "sba":
        values |= {"k1": 0.0, "k2": 0.0}
    if form == "bal":
        values |= {"cx": 999.5, "cy": 749.5}
    truth = replace(truth, cameras=(camera.with_parameters(np.array([values[n] for n in camera.names])),))
    path = tmp_path / ("net.txt" if form == "bal" else "files")
    write_any(path, form, network, truth)
    stored = read_comparable(path, form)
    found = compare_results(Solution("own", network, truth), stored)
    assert len(found.points) == 40 and len(found.images) == 6
    assert found.points == network.points and found.images == network.images
    assert np.abs(found.point_difference).max() < 1e-6
    if form in ("bal", "sba"):
        assert found.pairing.points_by_name == 0 and found.pairing.images_by_name == 0
        assert found.pairing.points_by_image_points == 40
        assert found.same_share == 1.0  # not tested as if it were an independent result


@pytest.mark.parametrize("form", ["bal", "sba"])
def test_image_points_corrected_for_distortion_are_recognised_by_their_rays(
    form: str, tmp_path: Path
) -> None:
    """In another frame and without a name: neither names nor places nor pixels are the same."""
    network, truth = make_network(seed_of("rays"), images=6, points=40, model="brown", noise_px=0.1)
    kind = format_named(form)
    straight, ideal = undistort(network, truth, kind.models)
    ideal, _ = convert_cameras(ideal, kind.models, held=kind.lacks)
    turn = Similarity(2.0, rotation_from_vector(np.array([0.3, -0.8, 0.2])), np.array([3.0, 1.0, -2.0]))
    path = tmp_path / ("net.txt" if form == "bal" else "files")
    write_any(path, form, straight, turn.apply_estimate(ideal))
    found = compare_results(Solution("own", network, truth), read_comparable(path, form))
    assert found.pairing.points_by_image_points == 40 and found.points == network.points
    assert found.images == network.images and found.same_share == 1.0
    assert np.abs(found.point_difference).max() < 1e-6


def test_pairs_are_one_to_one(run: tuple[Network, Estimate]) -> None:
    pairing = pair_results(Solution("first", *run), run_again(*run))
    for column in (*pairing.points.T, *pairing.images.T):
        assert len(np.unique(column)) == len(column)
