"""Which photographs are worth matching: found from a few features, in a ring and in two parts."""

from __future__ import annotations

import numpy as np
import pytest

from sfm.matching.tracks import feature_tracks
from sfm.matching.tracks.feature_tracks import link_features
from sfm.matching.tracks.features import (
    MANY_PARTNERS,
    Features,
    common_features,
    connected_parts,
    connecting_pairs,
    overlapping_pairs,
    sift_features,
)
from tests.synthetic import seed_of
from tests.textures import random_texture


def _strip(m: int, *, features: int = 60, step: int = 8, seed: str = "strip") -> list[Features]:
    """Features of m photographs along a strip, each `step` features beyond the one before."""
    rng = seed_of(seed)
    n = features + step * m
    descriptor = rng.random((n, 128)).astype(np.float32)
    xyz = rng.uniform([-1, -1, 3], [1, 1, 5], (n, 3))
    scale = rng.uniform(2, 10, n)
    found = []
    for i in range(m):
        own = slice(step * i, step * i + features)
        d = descriptor[own] + 0.03 * rng.standard_normal((features, 128)).astype(np.float32)
        xy = 800 * (xyz[own, :2] - [0.3 * i, 0.1 * i]) / xyz[own, 2:] + 500
        unit = d / np.linalg.norm(d, axis=1, keepdims=True)
        found.append(Features(xy, scale[own], np.zeros(features), unit))
    return found


def test_neighbours_in_a_strip_are_chosen_and_strangers_are_not() -> None:
    strip = _strip(24)
    score = common_features([one.descriptor for one in strip], [one.scale for one in strip])
    i, j = np.triu_indices(24, 1)
    assert (score[i, j] == np.maximum(60 - 8 * (j - i), 0)).mean() > 0.95
    pairs = overlapping_pairs(score, partners=6)
    chosen = {tuple(pair) for pair in pairs.tolist()}
    assert all((k, k + 1) in chosen and (k, k + 2) in chosen for k in range(22))
    assert len(pairs) < 24 * 6  # of 276
    assert len(overlapping_pairs(score[:5, :5])) == 10


def test_a_photograph_without_clear_partners_is_matched_with_all() -> None:
    strip = _strip(16)
    lost = _strip(1, seed="another")[0]
    photographs = [*strip, lost, Features(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros((0, 128)))]
    score = common_features(
        [np.float32(one.descriptor) for one in photographs], [one.scale for one in photographs]
    )
    assert (overlapping_pairs(score, partners=6) == 16).any(axis=1).sum() == 17


def test_neighbours_are_partners_whatever_the_photographs_show() -> None:
    """On a repeated façade, photographs far apart have more in common than those side by side."""
    m = 40
    score = np.triu(np.where((np.arange(m)[:, None] - np.arange(m)) % 3 == 0, 50, 0), 1)
    near = np.array([[k + 1, k - 1, k + 2, k - 2, k + 4, k - 4] for k in range(m)])
    near[(near < 0) | (near >= m)] = -1

    def chosen(pairs: np.ndarray) -> set[tuple[int, ...]]:
        return {tuple(pair) for pair in pairs.tolist()}

    alike, with_near = chosen(overlapping_pairs(score)), chosen(overlapping_pairs(score, neighbours=(near,)))
    assert all(i % 3 == j % 3 for i, j in alike)
    by_place = {(k, k + step) for k in range(m) for step in (1, 2) if k + step < m}
    assert with_near == alike | by_place


def test_a_photograph_that_shows_little_has_many_partners_and_all_its_neighbours() -> None:
    m = 80
    score = np.triu(np.full((m, m), 20), 1)
    score[7], score[:, 7] = 0, 0
    score[7, 70:] = 1
    near = np.tile(np.arange(50, 60), (m, 1))
    pairs = overlapping_pairs(score, neighbours=(near,))
    partners = set(pairs[(pairs == 7).any(axis=1)].ravel().tolist()) - {7}
    assert partners >= {*range(70, 80), *range(50, 60)} and 30 <= len(partners) <= 40


def test_pairs_grow_with_the_photographs_only() -> None:
    def count(m: int) -> int:
        """Photographs in a strip of which each has two partners, and features in common by chance."""
        score = seed_of("chance").integers(0, 4, (m, m))
        score[np.arange(m - 1), np.arange(1, m)] = 40
        near = np.column_stack([np.arange(1, m + 1), np.arange(-1, m - 1)])
        near[-1, 0] = -1
        pairs = overlapping_pairs(np.triu(score, 1), neighbours=(near,))
        assert {(k, k + 1) for k in range(m - 1)} <= {tuple(pair) for pair in pairs.tolist()}
        # all of them alone: each is offered some of the others, never itself or one that was tried
        rest = connecting_pairs(np.triu(score, 1), np.arange(m), pairs)
        assert (rest[:, 0] < rest[:, 1]).all()
        assert not np.isin(rest @ [m, 1], pairs @ [m, 1]).any()
        return len(pairs) + len(rest)

    assert count(31) == 31 * 30 / 2
    assert count(300) < 300 * (2 * MANY_PARTNERS + 2)  # of 44,850


def test_only_pairs_of_different_parts_connect_them() -> None:
    score = np.triu(np.arange(36).reshape(6, 6), 1)
    part = np.array([0, 0, 0, 1, 1, 2])
    pairs = connecting_pairs(score, part, np.array([[0, 1], [2, 3]]))
    every = {(i, j) for i in range(6) for j in range(i + 1, 6) if part[i] != part[j]}
    assert {tuple(pair) for pair in pairs.tolist()} == every - {(2, 3)}


def test_parts_that_the_choice_leaves_apart_are_matched_too(monkeypatch: pytest.MonkeyPatch) -> None:
    strip = _strip(4)
    apart = np.array([[0, 1], [2, 3]])
    monkeypatch.setattr(feature_tracks, "overlapping_pairs", lambda *_, **__: apart)
    tracks = link_features(strip, min_rays=4)
    assert set(tracks.image) == {0, 1, 2, 3} and tracks.point.max() + 1 == 60 - 3 * 8
    assert connected_parts(apart, 5).tolist() == [0, 0, 1, 1, 2]


def test_features_of_a_smaller_picture_are_where_they_are_in_the_photograph() -> None:
    y, x = np.mgrid[0:121, 0:162].astype(float)
    texture = random_texture(seed_of("smaller picture"), 4.0)
    pictures = [texture.value(x + shift, y) for shift in (0.0, 2.0)]
    for most in (20, 5000):  # from the half, and, as it has too few, from the whole photograph
        a, b = (sift_features(one, max_features=most).xy for one in pictures)
        gap = a[:, None] - b[None] - [2.0, 0.0]
        assert np.median(np.linalg.norm(gap, axis=2).min(axis=1)) < 0.25
    blob = np.exp(-((x - 80.3) ** 2 + (y - 59.6) ** 2) / (2 * 6.0**2))
    found = sift_features(255 * blob, max_features=1)
    assert found.xy[0] == pytest.approx([80.3, 59.6], abs=0.35)
