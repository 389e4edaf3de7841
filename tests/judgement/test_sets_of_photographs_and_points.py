"""Sets that alternatives are chosen from: runs and groups of photographs, points that moved, and how many."""

from __future__ import annotations

from dataclasses import replace
from math import comb, log
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import ErrorCorrelation
from sfm.adjustment.solve import adjust
from sfm.judgement.hypotheses import alternatives, families
from sfm.judgement.hypotheses.alternatives import Part, runs_of
from sfm.judgement.hypotheses.columns import rigid_motions
from sfm.judgement.hypotheses.score import NONE, Gain, gain_of, reduce_adjustment
from sfm.model.conventions import BoolArray, FloatArray
from sfm.survey.inputs.sources import TEXTURE
from tests.synthetic import make_network, seed_of


def random_part(name: str, m: int, moved: list[int], *, by: float = 8.0, f: int = 2) -> Part:
    """Return normal equations of two freedoms of m photographs, in some of which these are off."""
    rng = seed_of(name)
    D = rng.standard_normal((40 * m, m, f)) * (np.arange(40 * m) % m == np.arange(m)[:, None]).T[:, :, None]
    unknowns = rng.standard_normal((40 * m, 5))  # of cameras, that are eliminated
    Q = np.linalg.qr(unknowns)[0]
    flat = D.reshape(len(D), -1)
    left = flat - Q @ (Q.T @ flat)
    beta = np.zeros((m, f))
    beta[moved] = by / np.sqrt(40.0)
    v = rng.standard_normal(len(D)) - flat @ beta.ravel()
    v = v - Q @ (Q.T @ v)
    H = (left.T @ left).reshape(m, f, m, f)
    return Part(H, (left.T @ v).reshape(m, f), (flat**2).sum(axis=0).reshape(m, f))


def test_photographs_in_no_order_are_grouped() -> None:
    part = random_part("grouped", 12, [1, 4, 9])
    groups = part.groups()
    best = max(groups, key=lambda factor: part.gain(factor).value)
    assert np.flatnonzero(best).tolist() in ([1, 4, 9], sorted(set(range(12)) - {1, 4, 9}))
    for factor in groups:
        assert 2 <= factor.sum() <= 10 and set(factor) == {0.0, 1.0}


@pytest.mark.parametrize("number", range(4))
def test_a_group_is_as_good_as_its_neighbours(number: int) -> None:
    """With its parameters held, no photograph that is added or left out lowers v'Pv."""
    part = random_part(f"neighbours {number}", 9, [0, 5, 7], by=4.0)

    def squares(factor: FloatArray, beta: FloatArray) -> float:
        """Return v'Pv less that without the group."""
        b = (factor[:, None] * beta).ravel()
        return float(b @ part.H.reshape(18, 18) @ b + 2 * part.g.ravel() @ b)

    groups = part.groups()
    assert len(groups)
    for factor in groups:
        gain = part.gain(factor)
        least = squares(factor, gain.beta)
        assert least == pytest.approx(-gain.value)
        for i in range(9):
            other = np.where(np.arange(9) == i, 1 - factor, factor)
            assert squares(other, gain.beta) >= least - 1e-9


def test_a_group_has_two_photographs_on_each_side() -> None:
    for moved in ([3], [0, 1, 2, 4, 5, 6]):
        for factor in random_part("one photograph", 7, moved, by=20.0).groups():
            assert 2 <= factor.sum() <= 5
    two = random_part("two photographs", 7, [3, 6], by=20.0).groups()
    five = random_part("five photographs", 7, [0, 1, 2, 4, 5], by=20.0).groups()
    assert [3, 6] in [np.flatnonzero(one).tolist() for one in two]
    assert [0, 1, 2, 4, 5] in [np.flatnonzero(one).tolist() for one in five] or [3, 6] in [
        np.flatnonzero(one).tolist() for one in five
    ]


def test_groups_are_grown_from_the_photographs_that_gain_most(monkeypatch: pytest.MonkeyPatch) -> None:
    """Some of 30, and each until it stays the same, or a while."""
    m, away = 30, 10.0 + np.arange(30)
    part = Part(np.eye(m)[:, None, :, None], ((-1.0) ** np.arange(m) * away)[:, None], np.ones((m, 1)))
    first: list[int] = []
    rounds: list[int] = []

    def alternating(self: Part, factor: FloatArray) -> Gain:
        """Return a step that the other half of the photographs asks for."""
        if factor.sum() == 1:
            first.append(int(factor.argmax()))
            rounds.append(0)
        rounds[-1] += 1
        return Gain(1.0, 1, (-1.0) ** rounds[-1] * np.ones(1))

    monkeypatch.setattr(Part, "gain", alternating)
    groups = part.groups()
    assert first == np.argsort(-away)[: len(first)].tolist() and len(groups) == len(first)
    assert 4 < len(first) < 16 and 10 < min(rounds) == max(rounds) < 40


@pytest.mark.parametrize(("m", "single"), [(50, True), (100, False)])
def test_some_dozen_photographs_have_freedoms_of_their_own(m: int, single: bool) -> None:
    """Neighbours are combined beyond; of some dozen cameras each is tested, of a hundred none."""
    none = np.zeros(m, dtype=np.int64)
    assert (len(np.unique(runs_of(none))) == m) == single
    assert alternatives.too_many_cameras(np.arange(m)) != single
    assert len(alternatives.photographs_among(families.CAMERA_FAMILIES[0], np.arange(m))) == (
        m if single else 0
    )
    assert [one.all() for one in alternatives.photographs_among(families.STRAIN, np.arange(m))] == [True]


def test_with_too_many_cameras_a_run_has_several() -> None:
    run = runs_of(np.arange(120) % 100)
    assert run.tolist() == runs_of(np.zeros(120, dtype=np.int64)).tolist()
    two = runs_of(np.arange(120) % 2)
    assert len(np.unique(two)) == len(np.unique(run)) and two.tolist() != run.tolist()


def test_patterns_need_photographs_on_each_side() -> None:
    camera, object_ = families.CAMERA_FAMILIES[0], families.STRAIN
    names = {
        m: [[name for name, _ in alternatives.patterns_of(one, m)] for one in (camera, object_)]
        for m in (2, 3, 4, 5)
    }
    ordered = ["split", "linear", "alternating"]
    assert names[2] == [[], []] and names[3] == [["single"], []]
    assert names[4] == [["single", *ordered], ordered] and names[5] == [
        ["single", *ordered, "group"],
        ordered,
    ]


def moves_of(
    d: FloatArray, name: str, *, sigma: float = 1.0, noise: bool = True
) -> tuple[Any, alternatives._Moves]:
    """Return a reduced adjustment and the normal equations of points that moved by d standard deviations."""
    n, rng = len(d), seed_of(name)
    alone = np.tile(np.eye(3) / sigma**2, (n, 1, 1))
    g = -d / sigma + (rng.standard_normal((n, 3)) / sigma if noise else 0.0)
    points = rng.uniform(-1, 1, (n, 3))
    moves = alternatives._Moves(
        np.array([0.0, 0, 1, 1]), np.arange(n), alone, np.zeros((n, 3, 1)), g, 2 * alone, alone
    )
    reduced = SimpleNamespace(
        adjustment=SimpleNamespace(estimate=SimpleNamespace(points=points)),
        t=np.zeros(1),
        Sinv=np.zeros((1, 1)),
        redundancy=5000,
        image=np.tile(np.repeat(np.arange(4), n), 50),
        point=np.tile(np.arange(n), 4 * 50),
    )
    return reduced, moves


def test_the_number_of_sets_is_that_of_combinations() -> None:
    _, moves = moves_of(np.zeros((9, 3)), "sets")
    assert [moves.log_sets(k) for k in (0, 1, 4, 9)] == pytest.approx([log(comb(9, k)) for k in (0, 1, 4, 9)])


@pytest.mark.parametrize("moved", [1, 3, 7])
def test_points_that_moved_are_told_from_those_that_stayed(moved: int) -> None:
    d = np.zeros((20, 3))
    d[2 : 2 + moved] = 9.0
    reduced, moves = moves_of(d, f"moved {moved}")
    (one,) = alternatives._each_by_itself(reduced, moves)
    assert sorted(one.points.tolist()) == list(range(2, 2 + moved))
    squares = (moves.g[2 : 2 + moved] ** 2).sum()
    assert one.gain.value == pytest.approx(squares) and one.gain.rank == 3 * moved
    others = np.delete(moves.g, np.arange(2, 2 + moved), axis=0)
    assert one.spread.factor == pytest.approx((others**2).mean())
    assert one.spread.redundancy == 3 * (20 - moved)
    assert one.search == pytest.approx(log(comb(20, moved)))
    np.testing.assert_allclose(one.gain.beta.reshape(-1, 3), -moves.g[one.points], rtol=1e-9)


def test_many_points_that_moved_are_tested_together_and_half_of_them_at_most(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(alternatives, "Spread", lambda *_: NONE)  # all moved, and do not differ by chance
    for n, least, most in ((300, 40, 90), (20, 10, 10), (1, 1, 1)):
        reduced, moves = moves_of(np.full((n, 3), 4.0), f"all moved {n}", noise=False)
        (one,) = alternatives._each_by_itself(reduced, moves)
        assert least <= len(one.points) <= most


def test_points_that_did_not_move_are_tried_a_little_farther() -> None:
    """The search ends where more than twice as many and four have less evidence."""
    d = np.zeros((60, 3))
    d[:2] = 12.0
    reduced, moves = moves_of(d, "tried farther", noise=False)
    sizes: list[int] = []
    gain_of = alternatives.gain_of

    def counted(H: FloatArray, *given: Any) -> Gain:
        sizes.append(len(H) // 3)
        return gain_of(H, *given)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(alternatives, "gain_of", counted)
        (one,) = alternatives._each_by_itself(reduced, moves)
    assert sorted(one.points.tolist()) == [0, 1] and sizes == list(range(1, 10))


def body_motion(points: FloatArray, members: BoolArray, beta: FloatArray) -> FloatArray:
    d = np.zeros_like(points)
    d[members] = rigid_motions(points, members)[members] @ beta
    return d


@pytest.mark.parametrize("count", [3, 5, 8])
def test_points_that_moved_as_a_body_are_found(count: int) -> None:
    """By a shift and a rotation, which are those of least squares; their residuals are the spread."""
    reduced, still = moves_of(np.zeros((20, 3)), f"body {count}")
    points = reduced.adjustment.estimate.points
    members = np.arange(20) < count
    beta = np.array([20.0, -15.0, 10.0, 4.0, -3.0, 5.0])
    d = body_motion(points, members, beta)
    reduced, moves = moves_of(d, f"body {count}")
    np.testing.assert_allclose(moves.g, still.g - d)
    found = list(alternatives._as_one_body(reduced, moves))
    one = max(found, key=lambda each: each.gain.value)
    assert one.points.tolist() == list(range(count))
    M = rigid_motions(points, members)[members].reshape(-1, 6)
    best = np.linalg.lstsq(M, -moves.g[members].ravel(), rcond=None)[0]
    np.testing.assert_allclose(one.gain.beta, best, rtol=1e-6)
    left = moves.g.copy()
    left[members] += (M @ best).reshape(-1, 3)
    assert one.gain.value == pytest.approx((moves.g**2).sum() - (left**2).sum())
    assert one.spread.redundancy == 60 - 6
    assert one.spread.factor == pytest.approx((left**2).sum() / 54)
    assert one.search == pytest.approx(log(comb(20, count)))


def test_two_points_are_no_body() -> None:
    d = np.zeros((12, 3))
    d[[3, 8]] = 40.0
    reduced, moves = moves_of(d, "two points", noise=False)
    assert list(alternatives._as_one_body(reduced, moves)) == []
    d[5] = 40.0
    reduced, moves = moves_of(d, "two points", noise=False)
    found = list(alternatives._as_one_body(reduced, moves))
    assert found and all(one.points.tolist() == [3, 5, 8] for one in found)


def test_sets_that_are_tried_together_have_the_motions_of_each() -> None:
    """The gain, what is left of all points, and the points that fit the motion better than none."""
    reduced, moves = moves_of(np.where(np.arange(20)[:, None] < 6, 12.0, 0.0), "tried together")
    sets = np.array([np.isin(np.arange(20), members) for members in (range(6), (1, 2, 9, 12), range(3, 9))])
    together = alternatives._bodies_of(reduced, moves, sets)
    for body, members in zip(together, sets, strict=True):
        (alone,) = alternatives._bodies_of(reduced, moves, members[None])
        assert body.gain.value == pytest.approx(alone.gain.value) and body.gain.rank == alone.gain.rank == 6
        np.testing.assert_allclose(body.gain.beta, alone.gain.beta, atol=1e-9)
        np.testing.assert_allclose(body.left, alone.left, atol=1e-9)
        assert (body.fitting == alone.fitting).all() and (body.members == members).all()
    assert together[0].gain.value > max(body.gain.value for body in together[1:])


def test_the_motion_of_a_body_is_that_of_its_columns() -> None:
    network, truth = make_network(seed_of("columns of a body"), images=12, points=20, visibility=0.9)
    reduced = reduce_adjustment(adjust(network, truth, datum="free", reject="tau"))
    moves = alternatives._moves(reduced, (np.arange(12) >= 6).astype(float))
    sets = np.array([np.isin(np.arange(len(moves.points)), members) for members in (range(6), range(4, 9))])
    for body in alternatives._bodies_of(reduced, moves, sets):
        points = moves.points[body.members]
        D = families.Alternative(families.BODY, "split", moves.factor, points=points).whitened(reduced)
        gain = gain_of(*reduced.project(D))
        assert (body.gain.rank, body.gain.value) == (gain.rank, pytest.approx(gain.value))
        np.testing.assert_allclose(body.gain.beta, gain.beta, rtol=1e-6, atol=1e-12)
        # what is left are the slopes along each point's motion after that of the body
        motion = np.zeros((len(truth.points), 3, 1))
        for k in range(3):
            motion[:] = 0.0
            motion[moves.points[0], k] = 1.0
            alone = reduced.whiten(
                moves.factor[reduced.image][:, None, None]
                * (reduced.columns.point[reduced.used] @ motion[reduced.point])
            )
            both = np.concatenate([alone, (D @ gain.beta)[:, :, None]], axis=2)
            H, g, _ = reduced.project(both)
            assert body.left[0, k] == pytest.approx(g[0] + H[0, 1], abs=1e-6 * abs(g[0]) + 1e-9)


def test_a_body_that_several_points_lead_to_is_told_once() -> None:
    d = np.full((30, 3), 40.0)
    d[:16] = 0.0
    reduced, moves = moves_of(d, "starts of a body", noise=False)
    (body,) = alternatives._as_one_body(reduced, moves)
    assert body.points.tolist() == list(range(16, 30))


def splits_of(m: int, points: int, unknowns: int, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return at which photographs of m a movement is tested, in a network of this size."""
    first: list[int] = []

    def recorded(_: object, factor: FloatArray) -> str:
        first.append(int(factor.argmax()))
        assert factor.tolist() == (np.arange(m) >= first[-1]).tolist()
        return ""

    monkeypatch.setattr(alternatives, "_moves", recorded)
    monkeypatch.setattr(alternatives, "_each_by_itself", lambda *_: ())
    monkeypatch.setattr(alternatives, "_as_one_body", lambda *_: ())
    reduced: Any = SimpleNamespace(photographs=m, L=np.zeros(points), t=np.zeros(unknowns))
    assert list(alternatives.moved_points(reduced)) == []
    return first


def test_a_movement_is_tested_at_some_places_of_the_sequence(monkeypatch: pytest.MonkeyPatch) -> None:
    """At all of a short one; two photographs are on each side."""
    assert splits_of(8, 40, 48, monkeypatch) == [2, 3, 4, 5, 6]
    assert splits_of(4, 40, 48, monkeypatch) == [2] and splits_of(3, 40, 48, monkeypatch) == []
    many = splits_of(40, 40, 240, monkeypatch)
    assert many[0] == 2 and set(np.diff(many)) == {4} and many[-1] == 38


def test_fewer_places_are_tested_of_a_large_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """About ten seconds, of 2e11 multiplications; one place in any case."""
    products = 6 * 5000 * 1000**2
    count = len(splits_of(40, 5000, 1000, monkeypatch))
    assert 1.2e11 < count * products < 2.8e11
    assert len(splits_of(40, 5000, 9000, monkeypatch)) == 1


def test_the_variance_that_remains_is_of_the_photographs_that_differ() -> None:
    """Of two of four photographs, relative to what their share of the redundancy lets expect."""
    rng = seed_of("remaining variance")
    image = np.repeat(np.arange(4), 10)
    v = rng.standard_normal((40, 2)) * np.where(image < 2, 3.0, 1.0)[:, None]
    reduced: Any = SimpleNamespace(image=image, v=v, share=np.ones(40), redundancy=60, count=80.0)
    some = np.arange(4) < 2
    squares = (v[:20] ** 2).sum()
    found = alternatives._variance_of(reduced, some, Gain(30.0, 3, np.zeros(3)))
    assert found == pytest.approx((squares - 30.0) / (2 * 20 * 60 / 80 - 3))
    assert alternatives._variance_of(reduced, some, Gain(1e9, 3, np.zeros(3))) == 0.0
    assert alternatives._variance_of(reduced, some, Gain(0.0, 29, np.zeros(3))) == pytest.approx(squares)


def test_each_photograph_must_exceed_all_its_other_freedoms() -> None:
    """A camera of each photograph is an alternative where chance does not explain it."""
    part = random_part("each", 8, list(range(8)), by=0.0, f=32)
    reduced: Any = SimpleNamespace(redundancy=10_000)
    run = np.arange(8)
    assert list(alternatives._of_each(reduced, part, run, 0.01)) == []
    strong = Part(part.H, part.g.copy(), part.squares)
    strong.g[:, 0] += np.einsum("iai->ia", part.H[:, :, :, 0])[:, 0] * seed_of("c of each").normal(0, 3, 8)
    found = {one.family.name: one for one in alternatives._of_each(reduced, strong, run, 0.01)}
    one = found["c"]
    assert one.pattern == "each" and one.factor.tolist() == list(range(8)) and one.gain.rank == 8
    H = part.H[:, 0][:, :, 0]
    expected = strong.g[:, 0] @ np.linalg.solve(H, strong.g[:, 0])
    assert one.gain.value == pytest.approx(expected)
    limit = stats.f.isf(0.01, 8, 10_000 - 8)
    scaled = Part(part.H, strong.g * np.sqrt(8 * limit / expected * np.array([[0.97]])), part.squares)
    assert "c" not in [one.family.name for one in alternatives._of_each(reduced, scaled, run, 0.01)]
    scaled = Part(part.H, strong.g * np.sqrt(8 * limit / expected * np.array([[1.04]])), part.squares)
    assert "c" in [one.family.name for one in alternatives._of_each(reduced, scaled, run, 0.01)]
    # what the other freedoms gain beside it, and how many they are
    rest, some = np.arange(1, 32), [0]
    flat = part.H.reshape(8 * 32, 8 * 32)
    rows = (32 * np.arange(8)[:, None] + rest).ravel()
    at = (32 * np.arange(8)[:, None] + some).ravel()
    cross = flat[np.ix_(rows, at)]
    inner = flat[np.ix_(rows, rows)] - cross @ np.linalg.solve(flat[np.ix_(at, at)], cross.T)
    g = strong.g.ravel()[rows] - cross @ np.linalg.solve(flat[np.ix_(at, at)], strong.g.ravel()[at])
    assert one.spread.redundancy == 8 * 31 and not one.spread.among
    assert one.spread.factor == pytest.approx(g @ np.linalg.solve(inner, g) / (8 * 31), rel=1e-6)


def test_errors_of_neighbours_count_for_what_would_be_significant() -> None:
    """Of texture: its gains are divided by the design effect, those of others need none."""
    network, truth = make_network(seed_of("neighbours of texture"), images=8, points=40, free=("c",))
    seen = network.image_points
    by = np.where(seen.image >= 5, 0.03, 0.0)[:, None] * (seen.xy - (999.5, 749.5))
    network = replace(network, image_points=replace(seen, xy=seen.xy + by), sources=(TEXTURE,))
    a = adjust(network, truth, datum=Datum("free"), reject="none")
    correlation = ErrorCorrelation(alone=0.1, common=0.9, length_px=300.0)
    reduced = reduce_adjustment(replace(a, error_correlation=correlation))
    found = alternatives.alternatives_of(reduced)
    needed = np.log(1 / a.levels.family)
    for one in found:
        plain = replace(one, design_effect=1.0).evidence_beside_spread
        assert one.design_effect == 1 or plain > needed
    effects = {(one.family.name, one.pattern): one.design_effect for one in found}
    assert effects["c", "split"] > 1.1
