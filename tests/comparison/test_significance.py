"""Comparison of two results: alignment, standard deviations of differences, tests, tables as CSV."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapters.colmap.camera_models import read_model, write_model
from adapters.colmap.mapper import MapperBaseline
from adapters.formats.result_tables import read_result, write_tables
from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.comparison.significance import compare_results
from sfm.comparison.solutions import compare_baseline, reprojection
from sfm.conventions import rotation_from_vector
from sfm.errors import GeometryError, SurveyFileError
from sfm.network import Estimate, Network
from sfm.similarity import Similarity
from sfm.solution import Solution
from tests.synthetic import make_network, seed_of

TURN = Similarity(1000.0, rotation_from_vector(np.array([0.3, -1.1, 0.7])), np.array([10.0, -20.0, 5.0]))


def measured(name: str, *, shift: np.ndarray | None = None, model: str = "opencv") -> Solution:
    """One epoch of an object of 60 points, of which some may have moved, adjusted free."""
    network, truth = make_network(seed_of("object"), model=model, images=10, noise_px=0.0)
    points = truth.points if shift is None else truth.points + shift
    rng = seed_of(f"epoch {name}")
    moved = replace(truth, points=points)
    seen = network.image_points
    xy = seen.xy + reprojection(network, moved) + 0.1 * rng.standard_normal(seen.xy.shape)
    network = replace(network, image_points=replace(seen, xy=xy))
    a = adjust(network, moved, datum=Datum("free"), sigma_px=0.1, reject="none")
    sigma = []
    for camera, Q in zip(a.estimate.cameras, a.covariance.interior, strict=True):
        s = np.full(len(camera.names), np.nan)
        s[camera.free] = np.sqrt(np.diag(Q))
        sigma.append(s)
    return Solution(
        name,
        network,
        a.estimate,
        a.covariance.points,
        a.covariance.exterior[:, :3, :3],
        tuple(sigma),
        a.redundancy,
    )


@pytest.fixture(scope="module")
def epochs() -> tuple[Solution, Solution]:
    first, second = measured("one"), measured("two")
    moved = TURN.apply_estimate(second.estimate)
    J = TURN.scale * TURN.rotation
    assert second.point_covariance is not None
    covariance = J @ second.point_covariance @ J.T
    return first, replace(second, estimate=moved, point_covariance=covariance)


def test_two_epochs_without_change_differ_by_their_sigmas(epochs: tuple[Solution, Solution]) -> None:
    found = compare_results(*epochs)
    assert found.a_from_b.scale == pytest.approx(1e-3, rel=1e-3)
    assert len(found.points) == 60 and len(found.images) == 10
    # mean of 60 values of chi-square(3)/3: 1 with a standard deviation of 0.105, less 7 parameters of 180
    assert 1 - 7 / 180 - 0.4 < found.global_statistic < 1 + 0.4
    assert found.changed is False
    assert not found.significant.any()
    assert np.abs(found.point_difference / found.point_sigma).max() < 4.5
    assert found.interior[0].conversion is None
    assert np.nanmax(np.abs(found.interior[0].difference / found.interior[0].sigma)) < 4


def test_a_moved_point_is_found(epochs: tuple[Solution, Solution]) -> None:
    shift = np.zeros((60, 3))
    shift[17] = [0.0, 0.002, 0.0]
    found = compare_results(epochs[0], measured("three", shift=shift))
    assert found.changed is True
    assert list(np.flatnonzero(found.significant)) == [17]
    assert found.point_difference[17] == pytest.approx([0, 0.002, 0], abs=5 * found.point_sigma[17].max())


@pytest.mark.parametrize("align", ["points", "cameras", "control"])
def test_alignments_bring_the_datum_back(align: str, epochs: tuple[Solution, Solution]) -> None:
    first, _ = epochs
    turned = replace(first, estimate=TURN.apply_estimate(first.estimate), point_covariance=None)
    found = compare_results(first, turned, align=align, control=("1", "5", "9", "20"))
    assert np.abs(found.point_difference).max() < 1e-11
    assert np.abs(found.position_difference).max() < 1e-11
    assert found.rotation_deg.max() < 1e-10
    with pytest.raises(GeometryError, match="control point 99 is not in both"):
        compare_results(first, turned, align="control", control=("99",))
    with pytest.raises(GeometryError, match="align 'middle', expected one of"):
        compare_results(first, turned, align="middle")


def test_without_alignment_and_covariance_differences_remain_and_no_test_is_made(
    epochs: tuple[Solution, Solution],
) -> None:
    first, _ = epochs
    bare = replace(first, point_covariance=None, estimate=TURN.apply_estimate(first.estimate))
    found = compare_results(replace(first, point_covariance=None), bare, align="none")
    assert found.changed is None
    assert np.isnan(found.critical)
    assert np.linalg.norm(found.point_difference, axis=1).min() > 5


def test_results_are_matched_by_name_and_models_are_converted(
    epochs: tuple[Solution, Solution],
) -> None:
    first, _ = epochs
    brown = measured("four", model="brown")
    order = np.random.default_rng(1).permutation(60)
    names = tuple(brown.network.points[j] for j in order)
    inverse = np.argsort(order)
    seen = brown.network.image_points
    assert brown.point_covariance is not None
    shuffled = replace(
        brown,
        network=replace(brown.network, points=names, image_points=replace(seen, point=inverse[seen.point])),
        estimate=replace(brown.estimate, points=brown.estimate.points[order]),
        point_covariance=brown.point_covariance[order],
    )
    a, b = compare_results(first, brown), compare_results(first, shuffled)
    assert a.points == b.points
    np.testing.assert_allclose(a.point_difference, b.point_difference, atol=1e-12)
    assert a.interior[0].model == "opencv"
    assert a.interior[0].conversion is not None and a.interior[0].conversion.source_model == "brown"
    nothing = replace(first, network=replace(first.network, points=tuple(f"x{j}" for j in range(60))))
    with pytest.raises(GeometryError, match="0 points in common, alignment needs 3"):
        compare_results(first, nothing)


def test_tables_go_round_to_the_last_digit(epochs: tuple[Solution, Solution], tmp_path: Path) -> None:
    first, _ = epochs
    write_tables(tmp_path, first)
    again = read_result(tmp_path)
    assert again.name == "one" and again.redundancy == first.redundancy
    assert again.network.images == first.network.images and again.network.points == first.network.points
    np.testing.assert_array_equal(again.estimate.points, first.estimate.points)
    np.testing.assert_array_equal(again.estimate.position, first.estimate.position)
    np.testing.assert_allclose(again.estimate.rotation, first.estimate.rotation, atol=1e-15)
    np.testing.assert_array_equal(again.network.image_points.xy, first.network.image_points.xy)
    np.testing.assert_array_equal(again.estimate.cameras[0].parameters, first.estimate.cameras[0].parameters)
    np.testing.assert_array_equal(again.estimate.cameras[0].free, first.estimate.cameras[0].free)
    assert again.point_covariance is not None and first.point_covariance is not None
    np.testing.assert_allclose(
        np.einsum("njj->nj", again.point_covariance),
        np.einsum("njj->nj", first.point_covariance),
        rtol=1e-14,
    )
    second = tmp_path / "again"
    write_tables(second, again)
    for name in ("points.csv", "image_points.csv", "cameras.csv", "summary.json"):
        assert (second / name).read_text() == (tmp_path / name).read_text()


@pytest.mark.parametrize(
    "name", ["points.csv", "images.csv", "cameras.csv", "image_points.csv", "summary.json"]
)
@pytest.mark.parametrize("part", [0.0, 0.4, 0.8])
def test_truncated_tables_are_refused(
    name: str, part: float, epochs: tuple[Solution, Solution], tmp_path: Path
) -> None:
    write_tables(tmp_path, epochs[0])
    data = (tmp_path / name).read_bytes()
    cut = data[: int(part * len(data))]
    if b"\n" in data[len(cut) - 1 : len(cut) + 1]:  # a table cut between two rows is a shorter table
        cut = cut[: cut.rstrip(b"\n").rfind(b",")]
    (tmp_path / name).write_bytes(cut)
    with pytest.raises(SurveyFileError, match=r"\.(csv|json), line \d+: "):
        read_result(tmp_path)


def test_colmap_model_is_compared_with_tables(epochs: tuple[Solution, Solution], tmp_path: Path) -> None:
    first, _ = epochs
    write_model(tmp_path / "colmap", first.network, first.estimate)
    network, estimate = read_model(tmp_path / "colmap")
    found = compare_results(first, Solution("colmap", network, estimate))
    assert np.abs(found.point_difference).max() < 1e-12
    assert np.abs(found.interior[0].difference).max() < 1e-9


def test_baseline_is_compared_at_the_targets(epochs: tuple[Solution, Solution]) -> None:
    network, truth = make_network(seed_of("baseline"), model="opencv", images=8, noise_px=0.1)
    a = adjust(network, truth, datum=Datum("free"), sigma_px=0.1, reject="none")
    # a baseline that oriented six of eight photographs, in a frame of its own, and a camera wrong by 1 px
    kept = [0, 2, 3, 4, 6, 7]
    theirs = TURN.apply_estimate(a.estimate)
    camera = theirs.cameras[0].with_parameters(
        theirs.cameras[0].parameters + np.array([0, 0, 1, 0, 0, 0, 0, 0])
    )
    baseline = Estimate((camera,), theirs.position[kept], theirs.rotation[kept], np.zeros((0, 3)))
    photographs = Network(
        tuple(network.images[i] for i in kept),
        np.zeros(6, dtype=np.int64),
        (),
        network.image_points.select(slice(0)),  # type: ignore[arg-type]
    )
    found = compare_baseline(
        a, MapperBaseline(photographs, baseline, total=8, rms_px=0.5, seconds=50.0), seconds=1.0
    )
    assert found.photographs == (8, 6) and found.total == 8
    assert found.targets == 60
    assert 0.2 < found.target_rms_px < 1.0
    assert np.isnan(found.rotation_deg[[1, 5]]).all()
    assert np.nanmax(found.rotation_deg) < 0.1
    assert 1e-5 < found.point_rms < 1e-3
