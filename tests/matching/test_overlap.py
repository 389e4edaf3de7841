"""Which photographs are compared, and which of them are matched."""

from __future__ import annotations

import numpy as np
import pytest

from sfm.matching.tracks import feature_tracks
from sfm.matching.tracks.feature_tracks import link_features
from sfm.matching.tracks.features import RATIO, Features
from sfm.matching.tracks.overlap import (
    COMPARED,
    MANY_PARTNERS,
    ComparedPairs,
    compare_parts,
    compare_photographs,
    connected_parts,
    connecting_pairs,
    overlapping_pairs,
)
from sfm.matching.tracks.retrieval import similar_photographs
from sfm.model.conventions import AnyArray, IntArray
from tests.synthetic import seed_of

NOTHING = Features(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros((0, 128), np.float32))


def unit(descriptor: AnyArray) -> AnyArray:
    return np.asarray(descriptor / np.linalg.norm(descriptor, axis=-1, keepdims=True), dtype=np.float32)


def strip(
    m: int,
    *,
    features: int = 60,
    step: int = 8,
    windows: int = 0,
    own: int = 0,
    ring: bool = False,
    seed: str = "strip",
) -> list[Features]:
    """Return the features of m photographs along a strip, each `step` features beyond the one before.

    Args:
        m: number of photographs.
        features: features of the strip in each of them.
        step: features between the first ones of two photographs.
        windows: features that all photographs show, like equal windows of a façade.
        own: features of each photograph that no other one shows.
        ring: whether the last photographs show the beginning again.
        seed: name of the random numbers.
    """
    rng = seed_of(seed)
    n = step * m if ring else features + step * m
    points, alike = rng.random((n, 128)), rng.random((windows, 128))
    xyz, scale = rng.uniform([-1, -1, 3], [1, 1, 5], (n, 3)), rng.uniform(2, 10, n)
    photographs = []
    for i in range(m):
        rows = (step * i + np.arange(features)) % n
        shown = np.concatenate([points[rows], alike, rng.random((own, 128))])
        shown += 0.03 * rng.standard_normal(shown.shape)
        xy = np.zeros((len(shown), 2))
        xy[:features] = 800 * (xyz[rows, :2] - [0.3 * i, 0.1 * i]) / xyz[rows, 2:] + 500
        of_scale = np.concatenate([scale[rows], np.full(windows + own, 6.0)])
        photographs.append(Features(xy, of_scale, np.zeros(len(shown)), unit(shown)))
    return photographs


def in_random_order(photographs: list[Features]) -> tuple[list[Features], IntArray]:
    """Return photographs in another order, and the place of each in the first one."""
    order = seed_of("order").permutation(len(photographs))
    return [photographs[i] for i in order.tolist()], order


def of_scores(score: IntArray) -> ComparedPairs:
    """Return all pairs with given numbers of common features, (m, m), of which i < j count."""
    i, j = np.triu_indices(len(score), 1)
    return ComparedPairs(len(score), np.column_stack([i, j]), score[i, j])


def set_of(pairs: IntArray) -> set[tuple[int, ...]]:
    return {tuple(pair) for pair in pairs.tolist()}


def pairs_of_strip(compared: IntArray, order: IntArray, apart: int) -> tuple[int, int]:
    """Return how many photographs at most so far `apart` in a strip are among the pairs, and how many are."""
    m = len(order)
    near = np.abs(np.subtract(*order[compared].T)) <= apart
    return int(near.sum()), sum(m - k for k in range(1, apart + 1))


def test_neighbours_in_a_strip_are_chosen_and_strangers_are_not() -> None:
    compared = compare_photographs(strip(24))
    i, j = compared.pairs.T
    assert len(i) == 24 * 23 / 2
    assert (compared.common == np.maximum(60 - 8 * (j - i), 0)).mean() > 0.95
    pairs = overlapping_pairs(compared, partners=6)
    assert all({(k, k + 1), (k, k + 2)} <= set_of(pairs) for k in range(22))
    assert len(pairs) < 24 * 6  # of 276
    assert len(overlapping_pairs(compare_photographs(strip(5)))) == 10


def test_few_photographs_are_all_compared_by_the_mutual_nearest_of_their_coarsest_features() -> None:
    """Against the definition, feature by feature; one photograph has no features, another a single one.

    Every other photograph has some features twice: both choose the same one of a photograph that has it once.
    """
    rng = seed_of("twice")
    photographs = strip(COMPARED - 1, windows=6, own=20)
    for of_photograph in photographs[::2]:
        again = of_photograph.descriptor[:30] + 0.004 * rng.standard_normal((30, 128))
        of_photograph.descriptor[60:] = unit(again[:26])
    single = Features(*(values[:1] for values in vars(photographs[3]).values()))
    photographs = [*photographs[:5], NOTHING, single, *photographs[5:]]
    compared = compare_photographs(photographs, threads=2)
    assert len(compared.pairs) == len(photographs) * (len(photographs) - 1) / 2
    for (i, j), common in zip(compared.pairs[::7].tolist(), compared.common[::7].tolist(), strict=True):
        a, b = photographs[i].descriptor, photographs[j].descriptor
        expected = 0
        for k, similarity in enumerate(b @ a.T):
            if len(a) < 2:
                continue
            nearest, second = np.argmax(similarity), np.sort(similarity)[-2]
            mutual = np.argmax(b @ a[nearest]) == k
            expected += bool(mutual and 1 - similarity.max() < RATIO**2 * (1 - second))
        assert common == expected, (i, j)


def test_a_photograph_has_one_vote_of_a_feature_however_often_it_shows_the_like() -> None:
    rng = seed_of("votes")
    wanted, rest = rng.random((1, 128)), rng.random((4000, 128))

    def alike(count: int, noise: float) -> AnyArray:
        return wanted + noise * rng.standard_normal((count, 128))

    shown = [wanted, alike(12, 0.02), alike(1, 0.04), alike(1, 0.08), rest]
    photographs = [Features(np.zeros((len(d), 2)), np.ones(len(d)), np.zeros(len(d)), unit(d)) for d in shown]
    rows = [np.arange(len(of_photograph)) for of_photograph in photographs]
    asking = np.arange(5) == 0
    for part, expected in (
        ([0, 1, 2, 3, 4], [[0, 1], [0, 2]]),
        ([0, 0, 1, 2, 3], [[0, 2]]),
    ):  # none of its part
        votes = [
            similar_photographs(photographs, rows, np.array(part), asking, len(expected), seed=seed).tolist()
            for seed in range(10)
        ]
        assert votes.count(expected) >= 7  # if one of the like is a centre, another may be in its cell alone


@pytest.mark.parametrize("windows", [0, 30])
def test_of_many_photographs_those_that_overlap_are_compared(windows: int) -> None:
    """In random order, a third of the features repeated in all photographs, a third in one only."""
    per_photograph = []
    for m in (90, 180):
        photographs, order = in_random_order(strip(m, windows=windows, own=30))
        compared = compare_photographs(photographs)
        assert (compared.pairs[:, 0] < compared.pairs[:, 1]).all()
        assert len(np.unique(compared.pairs, axis=0)) == len(compared.pairs) <= m * COMPARED
        near, of = pairs_of_strip(compared.pairs, order, 6)  # they share a fifth and more
        assert near >= 0.98 * of
        chosen, of = pairs_of_strip(overlapping_pairs(compared), order, 4)
        assert chosen >= 0.98 * of
        per_photograph.append(len(compared.pairs) / m)
    assert per_photograph[1] < 1.1 * per_photograph[0]


def test_the_end_of_a_ring_is_compared_with_its_beginning() -> None:
    m = 100
    photographs, order = in_random_order(strip(m, ring=True, windows=20, own=20))
    pairs = order[overlapping_pairs(compare_photographs(photographs))]
    gap = np.abs(pairs[:, 0] - pairs[:, 1])
    steps = np.bincount(np.minimum(gap, m - gap))
    assert (steps[1:4] == m).all()
    assert connected_parts(pairs, m).max() == 0


def test_the_comparison_depends_neither_on_threads_nor_on_chance() -> None:
    photographs = strip(70, own=30)
    first, again = compare_photographs(photographs), compare_photographs(photographs, threads=3)
    assert (first.pairs == again.pairs).all() and (first.common == again.common).all()


def test_odd_photographs_among_many_are_no_obstacle() -> None:
    """One without features, one of all that the others show, three copies, one that shows nothing of them."""
    some = strip(60, own=20)
    overview = np.concatenate([of_photograph.descriptor[::12] for of_photograph in some])
    k = len(overview)
    whole = Features(np.zeros((k, 2)), np.full(k, 20.0), np.zeros(k), overview)
    photographs = [NOTHING, whole, *some, some[30], some[30], strip(1, seed="another")[0]]
    compared = compare_photographs(photographs)
    assert len(compared.pairs) < 45 * len(photographs)
    assert not (compared.pairs == 0).any()  # nothing to compare
    pairs = set_of(overlapping_pairs(compared))
    assert {(32, 62), (32, 63), (62, 63)} <= pairs
    assert {(k, k + 1) for k in range(2, 61)} <= pairs
    copies = overlapping_pairs(compare_photographs(some[:1] * 60))
    assert connected_parts(copies, 60).max() == 0
    nothing = compare_photographs([NOTHING] * 60)
    assert len(overlapping_pairs(nothing)) == 0
    single = Features(np.zeros((1, 2)), np.ones(1), np.zeros(1), some[0].descriptor[:1])
    assert len(overlapping_pairs(compare_photographs([single, *[NOTHING] * 60]))) == 0


def test_neighbours_of_many_photographs_are_compared_whatever_they_show() -> None:
    m = 60
    near = np.column_stack([np.arange(m) - 30, np.full(m, -1)])
    compared = compare_photographs(strip(m), neighbours=(near,))
    assert {(k - 30, k) for k in range(30, m)} <= set_of(compared.pairs)


def test_parts_of_many_photographs_are_compared_where_they_may_be_connected() -> None:
    """The features of two strips have their likes in the same strip; a few are also in the other one."""
    m = 50
    first, other = strip(m, own=20, seed="first"), strip(m - 8, own=20, seed="other")
    bridge = first[20].descriptor[60:72]  # own features of a photograph
    other[10].descriptor[60:72] = unit(bridge + 0.01 * seed_of("bridge").standard_normal(bridge.shape))
    photographs, part = [*first, *other], np.repeat([0, 1], [m, m - 8])
    compared = compare_photographs(photographs)
    inside = part[compared.pairs[:, 0]] == part[compared.pairs[:, 1]]
    compared = ComparedPairs(len(part), compared.pairs[inside], compared.common[inside])
    both = compare_parts(photographs, compared, part)
    assert set_of(compared.pairs) < set_of(both.pairs)
    new = both.pairs[~np.isin(both.pairs @ [1000, 1], compared.pairs @ [1000, 1])]
    assert (part[new[:, 0]] != part[new[:, 1]]).all()
    assert np.bincount(new[:, 1]).max() <= COMPARED
    assert (20, m + 10) in set_of(connecting_pairs(both, part, compared.pairs))
    # a stray is compared with some of the others, not they with it
    stray = np.zeros(len(part), dtype=np.int64)
    stray[5] = 1
    added = compare_parts(photographs, compared, stray).pairs
    assert 0 < len(set_of(added) - set_of(compared.pairs)) <= COMPARED


def test_a_photograph_without_clear_partners_is_matched_with_all() -> None:
    lost = strip(1, seed="another")[0]
    compared = compare_photographs([*strip(16), lost, NOTHING])
    assert (overlapping_pairs(compared, partners=6) == 16).any(axis=1).sum() == 17


def test_neighbours_are_partners_whatever_the_photographs_show() -> None:
    """On a repeated façade, photographs far apart have more in common than those side by side."""
    m = 40
    compared = of_scores(np.where((np.arange(m)[:, None] - np.arange(m)) % 3 == 0, 50, 0))
    near = np.array([[k + 1, k - 1, k + 2, k - 2, k + 4, k - 4] for k in range(m)])
    near[(near < 0) | (near >= m)] = -1
    alike = set_of(overlapping_pairs(compared))
    assert all(i % 3 == j % 3 for i, j in alike)
    by_place = {(k, k + step) for k in range(m) for step in (1, 2) if k + step < m}
    assert set_of(overlapping_pairs(compared, neighbours=(near,))) == alike | by_place


def test_a_photograph_that_shows_little_has_many_partners_and_all_its_neighbours() -> None:
    m = 80
    score = np.full((m, m), 20)
    score[7], score[:, 7] = 0, 0
    score[7, 70:] = 1
    near = np.tile(np.arange(50, 60), (m, 1))
    pairs = overlapping_pairs(of_scores(score), neighbours=(near,))
    partners = set(pairs[(pairs == 7).any(axis=1)].ravel().tolist()) - {7}
    assert partners >= {*range(70, 80), *range(50, 60)} and 30 <= len(partners) <= 40


def test_pairs_grow_with_the_photographs_only() -> None:
    def count(m: int) -> int:
        """Photographs in a strip of which each has two partners, and features in common by chance."""
        score = seed_of("chance").integers(0, 4, (m, m))
        score[np.arange(m - 1), np.arange(1, m)] = 40
        near = np.column_stack([np.arange(1, m + 1), np.arange(-1, m - 1)])
        near[-1, 0] = -1
        pairs = overlapping_pairs(of_scores(score), neighbours=(near,))
        assert {(k, k + 1) for k in range(m - 1)} <= set_of(pairs)
        # all of them alone: each is offered some of the others, never itself or one that was tried
        rest = connecting_pairs(of_scores(score), np.arange(m), pairs)
        assert (rest[:, 0] < rest[:, 1]).all()
        assert not np.isin(rest @ [m, 1], pairs @ [m, 1]).any()
        return len(pairs) + len(rest)

    assert count(31) == 31 * 30 / 2
    assert count(300) < 300 * (2 * MANY_PARTNERS + 2)  # of 44,850


def test_only_pairs_of_different_parts_connect_them() -> None:
    part = np.array([0, 0, 0, 1, 1, 2])
    pairs = connecting_pairs(of_scores(np.arange(36).reshape(6, 6)), part, np.array([[0, 1], [2, 3]]))
    every = {(i, j) for i in range(6) for j in range(i + 1, 6) if part[i] != part[j]}
    assert set_of(pairs) == every - {(2, 3)}


def test_parts_that_the_choice_leaves_apart_are_matched_too(monkeypatch: pytest.MonkeyPatch) -> None:
    apart = np.array([[0, 1], [2, 3]])
    monkeypatch.setattr(feature_tracks, "overlapping_pairs", lambda *_, **__: apart)
    tracks = link_features(strip(4), min_rays=4)
    assert set(tracks.image) == {0, 1, 2, 3} and tracks.point.max() + 1 == 60 - 3 * 8
    assert connected_parts(apart, 5).tolist() == [0, 0, 1, 1, 2]
