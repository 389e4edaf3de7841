"""Matching over wide baselines."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from benchmarks.wide_matching import count_matches, photograph, points_and_truth, wide_scene
from datasets.textured import render
from sfm.matching import conjugate
from sfm.matching.conjugate import KeyPoints, affinities_around, match_points
from sfm.matching.conjugate_patches import ConjugatePoints, MatchSettings
from sfm.matching.lsm.surface_planes import match_where_plane
from sfm.matching.lsm.two_photo import LsmSettings, match_lsm
from sfm.matching.tracks.features import Features, sift_features
from sfm.model.conventions import FloatArray
from tests.synthetic import seed_of
from tests.textures import MEAN, affine_pairs, random_texture, with_noise

SIZE = (180, 150)
POINTS = np.array([[x, y] for y in (60.0, 75.0, 90.0) for x in (65.0, 77.5, 90.0, 102.0, 115.3)])
NOISE = 2.0


@cache
def _turned(angle_deg: float, scale: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Two photographs of one plane texture, and the truth of POINTS in the second."""
    rng = np.random.default_rng(5)
    fine, coarse = random_texture(rng, 2.0), random_texture(rng, 8.0)
    angle = np.radians(angle_deg)
    A = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    middle = np.array(SIZE) / 2
    y, x = np.mgrid[0 : SIZE[1], 0 : SIZE[0]].astype(float)
    back = (np.stack([x, y], axis=-1) - middle) @ np.linalg.inv(A).T + middle
    left, right = (
        0.5 * (fine.value(u, v) + coarse.value(u, v)) for u, v in ((x, y), (back[..., 0], back[..., 1]))
    )
    return with_noise(left, NOISE, 1), with_noise(right, NOISE, 2), (POINTS - middle) @ A.T + middle


def _right(found: ConjugatePoints, truth: FloatArray) -> int:
    """Count the points matched, all of which must be right."""
    assert (np.abs(found.right - truth)[found.good] < 0.2).all()
    return int(found.good.sum())


def test_key_points_lead_to_places_that_are_turned_and_scaled() -> None:
    left, right, truth = _turned(75.0, 0.8)
    assert _right(match_points(left, right, POINTS, settings=MatchSettings(wide=False)), truth) == 0
    assert _right(match_points(left, right, POINTS), truth) >= 14
    # with search windows elsewhere they must not lead out of them
    elsewhere = match_points(
        left, right, POINTS[:2], xy_right=truth[:2] + 90.0, settings=MatchSettings(search_px=61)
    )
    assert not elsewhere.good.any()


def test_key_points_are_extracted_once_and_only_if_points_are_lost(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    left, right, _ = _turned(75.0, 0.8)
    third, extracted = with_noise(right, 1.0, 3), list[int]()

    def features(photograph: FloatArray, **options: int) -> Features:
        extracted.append(photograph.size)
        return sift_features(photograph, **options)

    monkeypatch.setattr(conjugate, "sift_features", features)
    shared = KeyPoints()
    alone = [match_points(left, other, POINTS) for other in (right, third)]
    assert len(extracted) == 4
    together = [match_points(left, other, POINTS, key_points=shared) for other in (right, third)]
    assert len(extracted) == 4 + 3
    for one, other in zip(alone, together, strict=True):
        np.testing.assert_array_equal(one.right, other.right)
    some = slice(None, None, 3)
    assert _right(match_points(left, left, POINTS[some], key_points=shared), POINTS[some]) == 5
    assert len(extracted) == 4 + 3
    match_points(left.copy(), right, POINTS, key_points=shared)
    assert len(extracted) == 4 + 3 + 1


@pytest.mark.parametrize(("angle_deg", "scale"), [(27.0, 0.8), (-15.0, 1.27)])
def test_without_key_points_templates_are_turned(
    monkeypatch: pytest.MonkeyPatch, angle_deg: float, scale: float
) -> None:
    none = np.zeros((0, 2))
    monkeypatch.setattr(
        conjugate, "local_affinities", lambda _l, _r, at, **_: affinities_around(none, none, at)
    )
    left, right, truth = _turned(angle_deg, scale)
    some, start = POINTS[::3], truth[::3] + np.array([6.0, -5.0])
    assert (
        _right(
            match_points(left, right, some, xy_right=start, settings=MatchSettings(search_px=61, wide=False)),
            truth[::3],
        )
        < 3
    )
    # this texture has one grain: at another scale it is taken for a blurred one, and smoothed
    assert (
        _right(
            match_points(left, right, some, xy_right=start, settings=MatchSettings(search_px=61)), truth[::3]
        )
        >= len(some) - 1
    )
    other = with_noise(
        random_texture(np.random.default_rng(6), 3.0).value(*np.mgrid[0:180, 0:150]).T, NOISE, 3
    )
    assert not match_points(left, other, some, settings=MatchSettings(search_px=61)).good.any()


def test_key_points_that_agree_by_half_only_lead_nowhere() -> None:
    """Any twelve pairs have a map that half of them are nearer to than the other half."""
    rng = np.random.default_rng(9)
    left = rng.uniform(0, 100, (12, 2))
    right = left + rng.uniform(-40, 40, (12, 2))
    assert np.isnan(affinities_around(left, right, np.array([[50.0, 50.0]])).xy).all()


def test_repeated_marks_whose_partner_is_out_of_reach_are_not_matched() -> None:
    """One mark every 130 px, turned by 20 degrees: the window without a given centre holds another one."""
    size, step, turn = 560, 130.0, np.radians(20.0)
    A = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    y, x = np.mgrid[0:size, 0:size].astype(float)
    middle, texture = np.array([size, size]) / 2, random_texture(np.random.default_rng(4), 3.0)

    def marks(u: FloatArray, v: FloatArray) -> FloatArray:
        p, q = u % step - step / 2, v % step - step / 2
        grey, inside = np.full(p.shape, MEAN), np.hypot(p, q) < 25.0
        grey[inside] = texture.value(p[inside], q[inside])
        return grey

    at = (np.stack([x, y], axis=-1) - middle) @ A + middle
    left, right = with_noise(marks(x, y), NOISE, 1), with_noise(marks(at[..., 0], at[..., 1]), NOISE, 2)
    points = np.array([[step / 2, step * (j + 0.5)] for j in range(4)])
    truth = (points - middle) @ A.T + middle
    found = match_points(left, right, points)
    assert not (found.good & (np.linalg.norm(found.right - truth, axis=1) > 2.0)).any()


def test_the_map_around_a_point_is_that_of_most_key_points() -> None:
    rng = np.random.default_rng(7)
    A, shift = np.array([[0.9, -0.4], [0.5, 1.1]]), np.array([40.0, 7.0])
    left = rng.uniform(0, 100, (40, 2))
    right = left @ A.T + shift + rng.normal(0, 0.3, left.shape)
    right[::4] = rng.uniform(0, 200, right[::4].shape)
    found = affinities_around(left, right, np.array([[50.0, 50.0], [1000.0, 50.0], [np.nan, 50.0]]))
    assert found.xy[0] == pytest.approx(A @ [50.0, 50.0] + shift, abs=1.0)
    assert found.linear[0] == pytest.approx(A, abs=0.05)
    assert 0.2 < found.spread_px[0] < 1.5
    assert np.isnan(found.xy[1:]).all()  # too far from all key points, and nowhere


def test_a_large_window_sums_up_weak_texture() -> None:
    """Contrast of 10 and noise of 2: each pixel's gradient is noise, and 961 of them are texture."""
    pairs = affine_pairs(11, 100, grain_px=4.0, half=15, distortion=0.03)
    left, right = (
        with_noise(MEAN + 0.25 * (one - MEAN), NOISE, k) for k, one in enumerate((pairs.left, pairs.right))
    )
    found = match_lsm(left, right, pairs.centre, pairs.centre, settings=LsmSettings(window_px=31))
    assert found.good.mean() > 0.9
    e = (found.xy - pairs.centre - pairs.shift)[found.good]
    assert np.sqrt((e**2).mean()) < 0.06
    z2 = np.einsum("ki,kij,kj->k", e, np.linalg.inv(found.covariance[found.good]), e) / 2
    assert z2.mean() == pytest.approx(1.0, abs=0.3)  # 200 squares: 0.1
    noise = [with_noise(np.full(left.shape, MEAN), NOISE, k) for k in (3, 4)]
    assert not match_lsm(
        *noise, pairs.centre, pairs.centre, settings=LsmSettings(window_px=31, min_correlation=0.0)
    ).good.any()


def test_windows_shrink_where_the_surface_is_not_plane() -> None:
    """On the crests of ripples a template of 21 px is off by the parallax of its mean depth, 0.5 px."""
    texture = random_texture(np.random.default_rng(8), 2.0)
    y, x = np.mgrid[0:120, 0:260].astype(float)
    left = with_noise(texture.value(x, y), NOISE, 1)
    at_left = x.copy()
    for _ in range(30):
        at_left = x - 3.0 * np.cos(2 * np.pi * at_left / 60)
    right = with_noise(texture.value(at_left, y), NOISE, 2)
    points = np.array([[30.0 * k, row] for k in range(2, 7) for row in (40.0, 60.0, 80.0)])
    truth = points + 3.0 * np.cos(2 * np.pi * points[:, :1] / 60) * [1.0, 0.0]
    large = match_lsm(left, right, points, truth, settings=LsmSettings(window_px=21))
    assert np.median(np.abs(large.xy[:, 0] - truth[:, 0])) > 0.35
    found = match_points(left, right, points, settings=MatchSettings(search_px=41))
    e = found.right - truth
    assert found.good.sum() >= 13 and np.abs(e[found.good]).max() < 0.25
    assert np.sqrt((e[found.good] ** 2 / found.sigma[found.good] ** 2).mean()) < 2.0


def test_windows_stay_large_on_a_plane() -> None:
    left, right, truth = _turned(4.0, 1.02)
    upright = match_lsm(left, right, POINTS, truth, settings=LsmSettings(window_px=21))
    kept, off = match_where_plane(left, right, POINTS, upright, window_px=21)
    assert (kept.xy == upright.xy)[upright.good].all(axis=1).mean() > 0.8
    assert (off == 0.0).all(axis=1).mean() > 0.8


@pytest.mark.slow
@pytest.mark.parametrize(
    ("roughness", "least", "wrong"), [("smooth", 0.95, 0), ("medium", 0.9, 0), ("rough", 0.4, 0)]
)
def test_wide_baselines_of_rendered_surfaces(roughness: str, least: float, wrong: int) -> None:
    """Convergence of 20, 40 and 60 degrees and a turn by 90; ripples are bent over a template of 21 px."""
    views = ((20.0, 0.0, 1.0), (40.0, 0.0, 1.0), (60.0, 0.0, 1.0), (20.0, 90.0, 1.0))
    scene, skin = wide_scene(roughness, views), render.texture()
    left = photograph(scene, 0, skin)
    for index in range(1, len(views) + 1):
        xy, truth = points_and_truth(scene, index, 60)
        counts = count_matches(left, photograph(scene, index, skin), xy, truth, "key points")
        assert counts.wrong <= wrong and counts.right >= least * counts.points, views[index - 1]


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
