"""Given points on the free network: how much is tried, when it ends, and how causes are weighed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sfm.judgement.given import points as given_points
from sfm.judgement.given.points import GivenPoints, PlacedPoints, Strain, judge_points, parameters_of
from sfm.judgement.given.values import GivenModel, Judgement
from sfm.model.conventions import FloatArray, rotation_from_vector
from sfm.model.distributions import MARGIN
from sfm.model.similarity import Similarity
from tests.given_figures import Figure, judge
from tests.synthetic import seed_of

SIGMA, LEVEL = 1e-3, 1e-3
FRAME = Similarity(0.4, rotation_from_vector(np.array([0.3, -0.2, 1.1])), np.array([5.0, -2.0, 1.0]))


def figure(n: int, name: str, *, noise: float = SIGMA) -> Figure:
    """Return n points given with noise, and of a free network in another frame."""
    rng = seed_of(name)
    X = rng.uniform(-1, 1, (n, 3))
    given = X + noise * rng.standard_normal((n, 3))
    stated = np.tile(SIGMA**2 * np.eye(3), (n, 1, 1))
    return Figure(given, stated, FRAME.apply(X), (0.1 * SIGMA) ** 2 * np.eye(3 * n), 500)


@pytest.mark.parametrize(("n", "least", "most"), [(4, 4, 4), (12, 220, 220), (40, 200, 450)])
def test_some_hundred_triples_are_tried(
    n: int, least: int, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All of a dozen points; of more as many at random, each of three points."""
    tried: list[FloatArray] = []
    fit = given_points.fit_similarities
    monkeypatch.setattr(given_points, "fit_similarities", lambda X, Y: tried.append(X) or fit(X, Y))
    one = figure(n, "triples")
    assert len(list(given_points._starts(one.points, None))) == 2
    assert least <= len(tried[0]) <= most
    corners = tried[0]
    assert all(len(np.unique(three, axis=0)) == 3 for three in corners)
    assert len(list(given_points._starts(figure(3, "triples").points, None))) == 1


def steps_of(points: GivenPoints, placing: Similarity, monkeypatch: pytest.MonkeyPatch) -> tuple[int, Any]:
    """Return how many steps a similarity takes, and where it ends."""
    count = 0
    moved = GivenPoints.moved

    def counted(self: GivenPoints, *given: Any) -> Similarity:
        nonlocal count
        count += 1
        return moved(self, *given)

    monkeypatch.setattr(GivenPoints, "moved", counted)
    ended = given_points._converged(points, placing, (), False)
    return count, ended


def test_a_similarity_converges_in_few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """From a start that is off by a fifth of a radian and of the scale."""
    one = figure(8, "converges")
    right = FRAME.inverse()
    start = Similarity(
        1.2 * right.scale,
        rotation_from_vector(np.array([0.2, -0.1, 0.1])) @ right.rotation,
        right.translation,
    )
    count, (placing, model) = steps_of(one.points, start, monkeypatch)
    assert 2 <= count < 10
    np.testing.assert_allclose(placing.apply(one.free), one.given, atol=5 * SIGMA)
    dx = parameters_of(model, np.ones(24, dtype=bool)) @ model.v
    assert np.abs(dx).max() < 1e-8  # nothing is left to move


def test_a_similarity_that_does_not_converge_is_left_at_its_start(monkeypatch: pytest.MonkeyPatch) -> None:
    one = figure(6, "no end")
    start, count = FRAME.inverse(), 0

    def away(self: GivenPoints, placing: Similarity, *_: Any) -> Similarity:
        nonlocal count
        count += 1
        return replace(placing, translation=placing.translation + 0.1)

    monkeypatch.setattr(GivenPoints, "moved", away)
    placing, model = given_points._converged(one.points, start, (), False)
    assert placing is start and 10 < count < 40
    np.testing.assert_array_equal(model.v, one.points.model(start, estimated=False).v)


def test_a_step_below_rounding_ends_the_iteration(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of points far from the origin, whose coordinates have no more digits; or 1e-9 of their size."""
    one = figure(6, "rounding ends")
    for far, step, ended in ((0.0, 1e-11, True), (0.0, 1e-6, False), (1e9, 1e-6, True)):
        start = replace(FRAME.inverse(), translation=FRAME.inverse().translation + far)
        shifted = replace(one, given=one.given + far).points
        monkeypatch.setattr(
            GivenPoints,
            "moved",
            lambda self, placing, *_, by=step: replace(placing, translation=placing.translation + by),
        )
        placing, _ = given_points._converged(shifted, start, (), False)
        assert (placing is not start) == ended


def placed(
    n: int, cost: float, *, order: tuple[int, ...] = (), mirrored: bool = False, **found: Any
) -> PlacedPoints:
    """Return judged points of which the explanation costs so much."""
    one = figure(n, "explained").points
    judgement = Judgement(cost, 3 * n - 7, 1e-6, **found)
    model = GivenModel(
        np.zeros(3 * n), np.eye(3 * n), np.eye(3 * n), np.zeros((3 * n, 7)), np.repeat(np.arange(n), 3), 9
    )
    return PlacedPoints(
        judgement, FRAME.inverse(), model, one, unmirrored=9e9 if mirrored else None, order=order
    )


def judged(
    found: PlacedPoints, others: list[PlacedPoints], monkeypatch: pytest.MonkeyPatch, strained: Any = None
) -> PlacedPoints:
    monkeypatch.setattr(given_points, "_placed", lambda *_: found)
    monkeypatch.setattr(given_points, "_corrected", lambda *_: iter(others))
    monkeypatch.setattr(given_points, "_strained", lambda *_: strained)
    one = judge_points(found.points, LEVEL)
    assert one is not None
    return one


@pytest.mark.parametrize(("ahead", "taken"), [(0.9, False), (1.1, True)])
def test_an_explanation_must_be_ahead_by_the_margin(
    ahead: float, taken: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the points as given, and of every other explanation."""
    as_given = placed(6, 500.0, doubtful=(0, 1))
    swap = placed(
        6, 500.0 - ahead * MARGIN - given_points.cost_of_choice((1, 0, 2, 3, 4, 5)), order=(1, 0, 2, 3, 4, 5)
    )
    found = judged(as_given, [swap], monkeypatch)
    assert (found is swap) == taken
    if not taken:
        assert found.judgement.doubtful == (0, 1) and found.exchangeable == (0, 1) and not found.order
    best = placed(6, 100.0, order=(1, 0, 2, 3, 4, 5))
    rival = placed(6, 100.0 + ahead * MARGIN, order=(0, 1, 3, 2, 4, 5))
    found = judged(as_given, [best, rival], monkeypatch)
    assert (found is best) == taken
    if not taken:
        assert found.judgement.doubtful == found.exchangeable == (0, 1, 2, 3)


def test_points_as_given_stay_where_nothing_explains_more(monkeypatch: pytest.MonkeyPatch) -> None:
    as_given = placed(6, 100.0, doubtful=(0,))
    assert judged(as_given, [], monkeypatch) is as_given
    worse = placed(6, 101.0, order=(1, 0, 2, 3, 4, 5))
    assert judged(as_given, [worse], monkeypatch) is as_given
    fits = placed(6, 100.0)
    assert judged(fits, [placed(6, 0.0, order=(1, 0, 2, 3, 4, 5))], monkeypatch) is fits


def test_mirrored_points_are_mirrored_whatever_names_explain(monkeypatch: pytest.MonkeyPatch) -> None:
    as_given = placed(6, 900.0, doubtful=(0,))
    mirrored = placed(6, 100.0, mirrored=True)
    swap = placed(6, 100.0 + 0.9 * MARGIN, order=(1, 0, 2, 3, 4, 5))
    far = placed(6, 100.0 + 1.1 * MARGIN, order=(0, 1, 3, 2, 4, 5))
    found = judged(as_given, [mirrored, swap, far], monkeypatch)
    assert found.mirrored and found.exchangeable == (0, 1)


def strained(cost: float) -> PlacedPoints:
    strain = Strain(given_points.STRAINS[0], np.diag([1.01, 1.0, 1.0]), "X", 20.0)
    return replace(placed(6, cost), strain=strain)


def test_a_strain_leaves_open_which_axes_are_right(monkeypatch: pytest.MonkeyPatch) -> None:
    as_given = placed(6, 900.0, doubtful=(0,))
    found = judged(as_given, [], monkeypatch, strained(100.0))
    assert found.strain is not None and found.judgement.doubtful == (0, 1, 2, 3, 4, 5)
    like = judged(as_given, [], monkeypatch, strained(900.0 - 0.5 * MARGIN))
    assert like.strain is None and like.judgement.doubtful == (0, 1, 2, 3, 4, 5)
    near = judged(as_given, [], monkeypatch, strained(900.0 + 0.9 * MARGIN))
    assert near.strain is None and near.judgement.doubtful == (0, 1, 2, 3, 4, 5)
    assert judged(as_given, [], monkeypatch, strained(900.0 + 1.1 * MARGIN)) is as_given
    swap = placed(6, 100.0 + 0.5 * MARGIN, order=(1, 0, 2, 3, 4, 5))
    both = judged(as_given, [swap], monkeypatch, strained(100.0))
    assert both.strain is None and both.judgement.doubtful == (0, 1, 2, 3, 4, 5)


def test_the_elongation_of_a_strain() -> None:
    along = Strain(given_points.STRAINS[1], np.diag([1.0, 0.97, 1.0]))
    assert along.elongation == pytest.approx(-0.03)
    every = Strain(given_points.STRAINS[3], np.diag([1.02, 0.97, 1.0]))
    assert every.elongation == pytest.approx(1.02 / 0.97 - 1)


@pytest.mark.parametrize("far", [0.0, 50.0])
def test_a_strain_is_about_the_centre_of_points(far: float) -> None:
    """Derivatives of the differences by its parameters, and the differences after it."""
    one = figure(5, "derivatives of a strain", noise=0.0)
    X = one.given + far
    m = 15
    model = GivenModel(np.zeros(m), np.eye(m), np.eye(m), np.ones((m, 1)), np.repeat(np.arange(5), 3), 9)
    F = np.diag([1.02, 1.0, 0.99])
    strain = Strain(given_points.STRAINS[3], F)
    found = strain.of(model, X)
    centre = X.mean(axis=0)
    np.testing.assert_allclose(found.v.reshape(-1, 3), -(X - centre) @ (F - np.eye(3)).T, atol=1e-12)
    turned = np.kron(np.eye(5), F)
    np.testing.assert_allclose(found.network, turned @ turned.T)
    np.testing.assert_allclose(found.A[:, 0], turned @ np.ones(m))
    size = np.abs(X - centre).max()
    for u, by in enumerate(given_points.STRAINS[3]):
        np.testing.assert_allclose(found.A[:, 1 + u].reshape(-1, 3), (X - centre) @ by.T / size, atol=1e-12)


def test_parameters_are_those_of_the_weights() -> None:
    rng = seed_of("weights of parameters")
    half, A = rng.normal(size=(12, 12)), rng.normal(size=(12, 3))
    model = GivenModel(rng.normal(size=12), half @ half.T, np.eye(12), A, np.arange(12), 9)
    kept = np.arange(12) != 4
    W = np.linalg.inv((model.network + model.stated)[np.ix_(kept, kept)])
    right = np.linalg.solve(A[kept].T @ W @ A[kept], A[kept].T @ W)
    np.testing.assert_allclose(parameters_of(model, kept), right, rtol=1e-6, atol=1e-9)
    plain = parameters_of(replace(model, estimated=True), kept)
    np.testing.assert_allclose(plain, np.linalg.pinv(A[kept]), atol=1e-12)


def test_the_extent_of_points_is_twice_their_median_distance() -> None:
    one = figure(5, "extent", noise=0.0)
    X = np.array([[0.0, 0, 0], [3, 0, 0], [-3, 0, 0], [0, 5, 0], [0, -9, 0]])
    one = replace(one, given=X, free=FRAME.apply(X))
    assert one.points.model(FRAME.inverse(), estimated=False).extent == pytest.approx(6.0)


def test_variances_are_means_of_three_coordinates() -> None:
    one = figure(3, "variances")
    joint = np.diag(np.arange(9.0))
    stated = np.stack([np.diag([1.0, 2.0, 6.0])] * 3)
    of_free, of_given = replace(one, joint=joint, stated=stated).points.variances
    assert of_free.tolist() == [1.0, 4.0, 7.0] and of_given.tolist() == [3.0, 3.0, 3.0]


def test_agreeing_points_are_those_beside_wrong_ones() -> None:
    right = judge(figure(6, "agree"), LEVEL)
    one = figure(6, "agree")
    given = one.given.copy()
    given[2] += 0.1
    wrong = judge(replace(one, given=given), LEVEL)
    assert right is not None and right.agreeing is None and wrong is not None
    assert wrong.agreeing is wrong.placing and wrong.renamed == ()
    renamed = replace(wrong, order=(1, 0, 3, 2, 4, 5))
    assert renamed.renamed == (0, 1, 3)  # without the wrong one
