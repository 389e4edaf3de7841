"""Interest points, tie points, windows on planes and the survey without targets."""

from __future__ import annotations

import tracemalloc
import weakref
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from adapters.colmap.adjuster import adjust_with_colmap
from adapters.colmap.camera_models import read_model
from adapters.colmap.mapper import map_photographs
from datasets.textured import render
from sfm.adjustment.result import Adjustment
from sfm.matching.epipolar import epipolar_paths
from sfm.matching.lsm.coverage import (
    MAX_SHARED_FRACTION,
    CoveredPixels,
    first_alike,
    plane_warps,
    points_apart,
)
from sfm.matching.lsm.surface_planes import Planes, planes_at, tilted_planes
from sfm.matching.lsm.two_photo import LsmSettings, match_lsm
from sfm.matching.radiometry import GreyPhotographs, grey_of
from sfm.matching.tracks import interest, matched_pairs
from sfm.matching.tracks.feature_tracks import (
    TrackSettings,
    _needed,
    _snapped,
    find_tie_points,
    joined_features,
    link_features,
)
from sfm.matching.tracks.features import Features, PairMatches, matched_features, sift_features
from sfm.matching.tracks.interest import (
    foerstner_points,
    natural_points,
    squares_side_by_side,
    textured_pixels,
)
from sfm.matching.tracks.matched_pairs import MatchedPairs
from sfm.model.camera import Camera, project, tangents_from_pixel
from sfm.model.conventions import (
    AnyArray,
    BoolArray,
    FloatArray,
    IntArray,
    angles_from_rotation,
    rotation_from_vector,
)
from sfm.model.errors import GeometryError, PhotographError, SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network
from sfm.model.remarks.remark import kinds_of
from sfm.model.similarity import fit_similarity
from sfm.orientation.image_rays import intersect_image_points
from sfm.orientation.relative import relative_orientations
from sfm.pipeline import run_survey
from sfm.products.batch.run import run_batch
from sfm.products.drafting.draft import draft_survey
from sfm.products.refining.refinement import RefineSettings, refine_model, refinement_text
from sfm.report.output import read_log
from sfm.survey.assembly import OtherPrograms
from sfm.survey.inputs.survey import read_survey
from sfm.survey.measuring.covering_points import (
    Squares,
    _returning,
    find_covering_points,
    match_squares,
)
from sfm.survey.measuring.surface_points import remarks_on_disagreement
from sfm.textbook.matching import match_along_line
from tests.engines import ALONE, HERE, Notes
from tests.synthetic import seed_of
from tests.tables import rows_of
from tests.textures import random_texture, with_noise


def test_corners_of_a_chessboard() -> None:
    board = np.kron(np.indices((6, 6)).sum(axis=0) % 2, np.ones((16, 16))) * 160 + 40
    shifted = cv2.GaussianBlur(board, (0, 0), 0.8)
    found = foerstner_points(with_noise(shifted, 1.0, 1), min_distance_px=8)
    corners = np.stack(np.meshgrid(np.arange(1, 6) * 16 - 0.5, np.arange(1, 6) * 16 - 0.5), axis=-1).reshape(
        -1, 2
    )
    distance = np.linalg.norm(found.xy[:, None] - corners[None], axis=2).min(axis=0)
    # between pixels a window of whole pixels has more of the edges on one side
    assert distance.max() < 0.2
    assert (found.roundness[:25] > 0.8).all() and (np.diff(found.weight) <= 0).all()
    assert (np.linalg.eigvalsh(found.covariance) > 0).all()


def test_interest_points_keep_their_distance_and_number() -> None:
    y, x = np.mgrid[0:120, 0:160].astype(float)
    photograph = with_noise(random_texture(np.random.default_rng(2), 2.0).value(x, y), 2.0, 1)
    found = foerstner_points(photograph, min_distance_px=12, max_points=30, border_px=15)
    assert len(found) == 30
    apart = np.linalg.norm(found.xy[:, None] - found.xy[None], axis=2) + 99 * np.eye(30)
    assert apart.min() > 12 - 2 * 3.5  # pixels keep the distance, edges meet within the window of 7 px
    assert len(foerstner_points(np.full((50, 50), 9, np.uint8))) == 0


def test_a_weak_texture_has_features_everywhere() -> None:
    """OpenCV's own threshold of contrast leaves a quarter of the photograph without any feature."""
    y, x = np.mgrid[0:300, 0:400].astype(float)
    light = 120 + (random_texture(np.random.default_rng(2), 2.0).value(x, y) - 128) * np.where(
        x < 100, 0.08, 1.0
    )
    photograph = with_noise(light, 0.5, 1)
    found = sift_features(photograph, max_features=400)
    assert len(found) == 400
    assert (found.xy[:, 0] < 100).sum() > 60
    cells = np.unique((found.xy // 50).astype(int), axis=0)
    assert len(cells) >= 46  # of 48


def test_features_that_contradict_each_other_are_no_point() -> None:
    rng = np.random.default_rng(4)
    descriptor = rng.random((40, 128)).astype(np.float32)
    descriptor /= np.linalg.norm(descriptor, axis=1, keepdims=True)
    xyz = rng.uniform([-1, -1, 3], [1, 1, 5], (40, 3))

    def view(shift: float) -> Features:
        xy = 800 * (xyz[:, :2] - [shift, 0.1 * shift]) / xyz[:, 2:] + 500
        return Features(xy, np.full(40, 4.0), np.zeros(40), descriptor)

    views = [view(0.0), view(0.5), view(-0.5)]
    tracks = link_features(views)
    assert np.bincount(tracks.point).tolist() == [3] * 40
    assert (tracks.feature.reshape(40, 3) == tracks.feature.reshape(40, 3)[:, :1]).all()
    swapped = views[2].descriptor.copy()
    swapped[[0, 1]] = swapped[[1, 0]]  # two wrong matches, off their epipolar lines
    views[2] = Features(views[2].xy, views[2].scale, views[2].angle, swapped)
    assert set(np.unique(link_features(views).feature)) == set(range(2, 40))


def test_a_wrong_match_splits_a_track_and_does_not_lose_it() -> None:
    """One false match along the epipolar lines joins two points of three photographs each."""
    image = np.tile(np.arange(3), 2)  # features 0, 1, 2 are one point, 3, 4, 5 the other
    true = [[0, 1], [1, 2], [3, 4], [4, 5]]
    assert joined_features(np.array([*true, [2, 4]]), image, 3).tolist() == [0, 0, 0, 3, 3, 3]
    first = joined_features(np.array([[2, 4], *true]), image, 3)  # the false one is the most distinctive
    assert all(len(set(image[first == g])) == (first == g).sum() for g in first)


SIZE = (480, 360)


def _pictures(lens: Camera, position: FloatArray, rotation: FloatArray) -> list[AnyArray]:
    """Photographs of the textured surface, with noise."""
    skin = cv2.GaussianBlur(render.texture(), (0, 0), 1.8)
    pictures = []
    for i, (X0, R) in enumerate(zip(position, rotation, strict=True)):
        y, x = np.mgrid[0 : SIZE[1], 0 : SIZE[0]]
        uv = tangents_from_pixel(lens, np.column_stack([x.ravel(), y.ravel()]))
        rays = np.column_stack([uv, -np.ones(len(uv))]) @ R.T
        at = render.surface_points(X0, rays)[:, :2] / render.TEXEL_M + len(skin) / 2
        at = at.astype(np.float32).reshape(SIZE[1], SIZE[0], 2)
        light = cv2.remap(skin, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        pictures.append(with_noise(255 * light, render.NOISE, i).clip(0, 255).astype(np.float32))
    return pictures


@cache
def _scene() -> tuple[tuple[AnyArray, ...], Estimate, FloatArray]:
    """Three small photographs of the textured surface, their orientation, and points on the surface."""
    lens = render.camera_from_values("lens", "opencv", SIZE, render.PIXEL_MM, c_mm=render.C_MM)
    position, rotation = (part[[0, 1, 7]] for part in render.stations())
    photographs = _pictures(lens, position, rotation)
    x, y = np.meshgrid(np.arange(120, 361, 40.0), np.arange(100, 261, 40.0))
    uv = tangents_from_pixel(lens, np.column_stack([x.ravel(), y.ravel()]))
    points = render.surface_points(position[0], np.column_stack([uv, -np.ones(len(uv))]) @ rotation[0].T)
    return (
        tuple(photographs),
        Estimate((lens,), position, rotation, points),
        np.column_stack([x.ravel(), y.ravel()]),
    )


def test_places_are_put_on_the_planes_of_the_points_around_them() -> None:
    _, truth, at = _scene()
    lens, X0, R = truth.cameras[0], truth.position[0], truth.rotation[0]
    camera = np.zeros(3, dtype=np.int64)
    normal, height = np.array([0.1, 0.2, 1.0]) / np.sqrt(1.05), 0.05

    def on_plane(xy: FloatArray) -> FloatArray:
        d = np.column_stack([tangents_from_pixel(lens, xy), -np.ones(len(xy))]) @ R.T
        return np.asarray(X0 + d * ((height - normal @ X0) / (d @ normal))[:, None])

    lost = np.vstack([on_plane(at), [X0 + R[:, 2], [np.nan] * 3]])  # one behind, one that is not known
    estimate = replace(truth, points=lost)
    places = np.vstack([at[:5] + np.array([7.0, -3.0]), [[np.nan, 0.0]]])
    planes = planes_at(estimate, camera, 0, places, np.arange(len(lost)))
    points, normals = planes.points, planes.normal
    assert points[:5] == pytest.approx(on_plane(places[:5]), abs=1e-6)
    assert normals[:5] == pytest.approx(np.tile(normal, (5, 1)), abs=1e-4)
    assert np.isnan(points[5]).all() and np.isnan(normals[5]).all()
    assert np.isnan(planes_at(estimate, camera, 0, places, np.arange(5)).points).all()  # too few for a plane


def _seen(image: Sequence[int], point: Sequence[int], xy: Sequence[Sequence[float]]) -> ImagePoints:
    n = len(image)
    return ImagePoints(np.array(image), np.array(point), np.array(xy, dtype=float), np.zeros((n, 2, 2)))


def test_points_whose_windows_overlap_give_way_to_those_with_more_rays() -> None:
    xy = [[20, 20], [20, 20], [20, 20], [22, 22], [22, 22], [60, 20], [60, 20], [20, 60], [24, 62]]
    seen = _seen([0, 1, 2, 0, 1, 0, 1, 0, 1], [0, 0, 0, 1, 1, 2, 2, 3, 3], xy)
    kept = points_apart(seen, np.ones(9, dtype=bool), 15.0, n_points=5)
    assert kept.tolist() == [True, False, True, True, False]
    fits = seen.image != 2
    fits[:2] = False
    kept = points_apart(seen, fits, 15.0, n_points=5)
    assert kept.tolist() == [False, True, True, True, False]
    assert not points_apart(seen, np.zeros(9, dtype=bool), 15.0, n_points=5).any()


def test_windows_on_both_sides_of_a_line_of_the_grid_overlap_too() -> None:
    rng = np.random.default_rng(7)
    n, side = 800, 15.0
    xy = np.concatenate([rng.uniform(-40, 260, (n, 2)) for _ in range(2)])
    seen = _seen(np.repeat([0, 1], n).tolist(), [*range(n), *range(n)], xy.tolist())
    kept = points_apart(seen, np.ones(2 * n, dtype=bool), side, n_points=n)
    share = np.zeros((n, n))
    for i in range(2):
        own = seen.xy[seen.image == i]
        share += np.prod(np.maximum(1 - np.abs(own[:, None] - own[None]) / side, 0.0), axis=2) / 2
    np.fill_diagonal(share, 0.0)
    with_earlier = np.tril(share)[np.ix_(kept, kept)].sum(axis=1)  # all have two rays: the first come first
    assert 0.05 < with_earlier.max() <= MAX_SHARED_FRACTION
    left_out = np.tril(share)[np.ix_(~kept, kept)].sum(axis=1)
    assert left_out.min() > MAX_SHARED_FRACTION


def test_squares_with_texture_lie_side_by_side() -> None:
    rng = np.random.default_rng(3)
    photograph = np.full((120, 160), 90, np.uint8)
    photograph[:, :80] = rng.integers(0, 255, (120, 80))
    textured = textured_pixels(photograph, 15)
    xy = squares_side_by_side(textured, 15, border_px=11)
    assert len(xy) == 7 * 6 and (xy == np.rint(xy)).all() and (xy[:, 0] < 80 + 8).all()
    assert xy.min() >= 11 and len({tuple(one) for one in ((xy - 11) % 15).tolist()}) == 1
    hidden = np.zeros(photograph.shape, dtype=bool)
    hidden[:60] = True
    lower = squares_side_by_side(textured & ~hidden, 15, border_px=11)
    assert 0 < len(lower) < len(xy) and lower[:, 1].min() == 60
    assert not textured_pixels(np.full((60, 60), 9, np.uint8), 15).any()


def test_only_the_part_around_what_is_not_masked_is_searched_for_texture() -> None:
    photograph = np.random.default_rng(4).integers(0, 255, (120, 400)).astype(np.uint8)
    photograph[:, 200:] //= 20  # weaker than a tenth of the mean of the whole, but not of itself
    hidden = np.zeros(photograph.shape, dtype=bool)
    hidden[:, :330] = True
    assert not textured_pixels(photograph, 15)[:, 330:].any()
    shown = textured_pixels(photograph, 15, hidden)
    assert not shown[:, :256].any() and shown[10:-10, 330:-10].all()


def test_texture_is_the_same_strip_by_strip(monkeypatch: pytest.MonkeyPatch) -> None:
    photograph = np.random.default_rng(5).integers(0, 255, (100, 60)).astype(np.uint8)
    whole = foerstner_points(photograph)
    monkeypatch.setattr(interest, "STRIP", 16)
    in_strips = foerstner_points(photograph)
    np.testing.assert_array_equal(in_strips.xy, whole.xy)
    np.testing.assert_array_equal(in_strips.weight, whole.weight)


def test_covered_pixels_are_not_free() -> None:
    covered = CoveredPixels([(100, 120), (50, 50)])
    covered.cover(np.array([0, 0]), np.array([[20.0, 30.0], [118.0, 98.0]]), np.array([10.0, 20.0]))
    assert int(covered.pixels(0).sum()) > 100 and not covered.pixels(1).any()
    at = np.array([[20.0, 30.0], [31.0, 30.0], [27.0, 30.0], [100.0, 20.0]])
    assert covered.is_free(0, at, 11).tolist() == [False, True, False, True]
    assert covered.is_free(1, at, 11).all()
    x, y = at.astype(int).T
    assert covered.free_middles(0, 11)[y, x].tolist() == [False, True, False, True]


def test_preferred_windows_give_way_to_clearly_better_ones() -> None:
    assert first_alike([(15, 3.1), (11, 3.0)]) == 15
    assert first_alike([(15, 3.4), (11, 3.0)]) == 11


def test_windows_of_a_plane_are_seen_in_perspective() -> None:
    _, truth, _ = _scene()
    lens, camera = truth.cameras[0], np.zeros(3, dtype=np.int64)
    normal = np.array([[0.1, 0.2, 1.0]]) / np.sqrt(1.05)
    point = truth.points[:1]
    middle = project(lens, truth.position[0], truth.rotation[0], point)
    corner = middle + np.array([[10.0, -10.0]])
    uv = tangents_from_pixel(lens, corner)
    ray = np.column_stack([uv, -np.ones(1)]) @ truth.rotation[0].T
    to_plane = np.sum(normal * (point - truth.position[0])) / np.sum(normal * ray)
    seen = project(lens, truth.position[2], truth.rotation[2], truth.position[0] + to_plane * ray)
    H = plane_warps(truth, camera, 0, 2, middle, point, normal, 10.0)[0]
    x, y, w = H @ [10.0, -10.0, 1.0]
    start = project(lens, truth.position[2], truth.rotation[2], point)
    assert np.array([x / w, y / w]) == pytest.approx((seen - start)[0], abs=1e-3)
    assert np.abs(H[:2, :2] @ [10.0, -10.0] - (seen - start)[0]).max() > 0.01  # what an affine warp is off by


def test_covering_points_cover_photographs_that_are_oriented() -> None:
    photographs, truth, _ = _scene()
    lens, camera = truth.cameras[0], np.zeros(3, dtype=np.int64)
    n = len(truth.points)
    image, point = np.repeat(np.arange(3), n), np.tile(np.arange(n), 3)
    xy = np.concatenate(
        [project(lens, X0, R, truth.points) for X0, R in zip(truth.position, truth.rotation, strict=True)]
    )
    ties = ImagePoints(image, point, xy, np.tile(0.01 * np.eye(2), (3 * n, 1, 1)))
    network = Network(("a", "b", "c"), camera, tuple(map(str, range(n))), ties)
    found = find_covering_points(photographs, network, truth, window_px=15, side_px=15)
    seen, count = found.image_points, np.bincount(found.image_points.point)
    assert (count == 3).sum() > 3 * n and set(count.tolist()) == {2, 3}
    # every reference is on whole pixels; no pixel of it is in two windows, and most pixels are in one
    reference = np.flatnonzero((seen.xy == np.rint(seen.xy)).all(axis=1))
    assert len(reference) == len(found.points)

    def windows(of: BoolArray) -> list[IntArray]:
        times = [np.zeros(one.shape[:2], dtype=int) for one in photographs]
        for i, (x, y) in zip(seen.image[of].tolist(), np.rint(seen.xy[of]).astype(int).tolist(), strict=True):
            times[i][y - 7 : y + 8, x - 7 : x + 8] += 1
        return times

    for one in windows(np.ones(len(seen), dtype=bool)):
        assert (one > 1).sum() < 0.2 * (one > 0).sum()
        assert (one[40:-40, 40:-40] > 0).mean() > 0.6
    times = windows(count[seen.point] == 3)
    # of the first hardly a pixel, although windows of others are smaller or larger, and move to their matches
    assert (times[0] > 1).sum() < 0.01 * (times[0] > 0).sum()
    # The orientation is the true one; photographs are blurred differently on an oblique surface, which adds
    # 0.12 to 1, and chance 0.04.
    v, dof = found.residuals, 2 * len(seen) - 3 * len(found.points)
    assert 1.0 < np.einsum("ka,kab,kb->", v, np.linalg.inv(seen.covariance), v) / dof < 1.24
    height = found.points[:, 2] - render.height(found.points[:, 0], found.points[:, 1])
    assert np.sqrt((height**2).mean()) < 3e-4
    assert np.sqrt((found.residuals**2).mean()) < 0.05
    none = find_covering_points(photographs, network, truth, window_px=15, side_px=15, references=[])
    assert len(none.points) == 0
    assert len(seen) >= 0.95 * found.matched and remarks_on_disagreement(found) == ()
    # a photograph that is turned by 3 px: its windows are found, their rays do not meet the others
    turned = truth.rotation.copy()
    turned[2] = turned[2] @ rotation_from_vector(np.array([3 / lens.c_px, 0.0, 0.0]))
    apart = replace(truth, rotation=turned)
    wrong = find_covering_points(photographs, network, apart, window_px=15, side_px=15)
    assert wrong.matched > 100
    (found_wrong,) = remarks_on_disagreement(wrong)
    assert found_wrong.number("share") == pytest.approx(1 - len(wrong.residuals) / wrong.matched)
    assert found_wrong.severity == "error"


@pytest.mark.parametrize("tilt", [0.1, 0.3])
def test_planes_with_wrong_slopes_give_the_same_depths(tilt: float) -> None:
    photographs, truth, _ = _scene()
    lens, camera = truth.cameras[0], np.zeros(3, dtype=np.int64)
    grey = GreyPhotographs(photographs.__getitem__)
    xy = squares_side_by_side(textured_pixels(grey[0].pixels, 15), 15, border_px=60)
    planes = planes_at(truth, camera, 0, xy, np.arange(len(truth.points)))
    known = np.isfinite(planes.slope_covariance).all(axis=(1, 2))
    xy, planes = xy[known], planes.select(known)
    sigma = tilt / lens.c_px
    slope = seed_of("wrong slopes").normal(size=(len(xy), 2)) * sigma
    tilted = tilted_planes(truth, camera, 0, xy, planes, slope)
    tilted = replace(tilted, slope_covariance=planes.slope_covariance + sigma**2 * np.eye(2))

    def height_error(on: Planes) -> FloatArray:
        squares, shown = Squares(0, xy, on), np.ones((3, len(xy)), dtype=bool)
        rays = match_squares(grey, truth, camera, squares, shown, 15, 1, both_ways=False)
        met = intersect_image_points(rays.image_points, camera, truth, n_points=len(xy), tolerance_px=1.0)
        X, Y, Z = met.points[np.isfinite(met.points).all(axis=1)].T
        return np.asarray(Z - render.height(X, Y))

    right, corrected = height_error(planes), height_error(tilted)
    assert len(right) > 300 and len(corrected) >= 0.98 * len(right)
    assert np.sqrt((corrected**2).mean()) < 1.1 * np.sqrt((right**2).mean()) < 6e-5


def test_pairs_whose_matches_are_known_are_not_matched_again(monkeypatch: pytest.MonkeyPatch) -> None:
    photographs, _, _ = _scene()
    natural = [natural_points(one, max_features=600) for one in photographs]
    matched: list[tuple[int, int]] = []

    def match(a: Features, b: Features, *, seed: int) -> PairMatches:
        matched.append((len(a), len(b)))
        return matched_features(a, b, seed=seed)

    monkeypatch.setattr(matched_pairs, "matched_features", match)
    known = MatchedPairs()
    first = link_features(natural, known=known)
    assert len(matched) == 3 and sorted(known.known) == [(0, 1), (0, 2), (1, 2)]
    known.forget({2})
    second = link_features(natural, known=known)
    assert len(matched) == 5 and (first.feature == second.feature).all()


def test_interest_operators_take_a_small_part_of_a_large_photograph_at_a_time() -> None:
    """Gradients, their products and sums in double precision would take twenty times its memory."""
    photograph = np.random.default_rng(1).integers(0, 255, (3000, 1000)).astype(np.uint8)
    for find in (foerstner_points, lambda one: textured_pixels(one, 15)):
        tracemalloc.start()
        find(photograph)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 20 * photograph.size  # bytes: that is five pictures in single precision


def test_tie_points_of_three_photographs() -> None:
    photographs, truth, _ = _scene()
    found = find_tie_points(photographs, [natural_points(one, max_features=600) for one in photographs])
    n = len(found.reference)
    assert n > 40 and (np.bincount(found.point) == 3).all()
    at = found.xy[found.image == found.reference[found.point]]
    points = np.full((n, 3), np.nan)
    for i in range(3):
        own = np.flatnonzero(found.reference == i)
        uv = tangents_from_pixel(truth.cameras[0], at[own])
        rays = np.column_stack([uv, -np.ones(len(own))]) @ truth.rotation[i].T
        points[own] = render.surface_points(truth.position[i], rays)
    e = np.array(
        [
            project(truth.cameras[0], truth.position[i], truth.rotation[i], points[j : j + 1])[0] - xy
            for i, j, xy in zip(found.image, found.point, found.xy, strict=True)
        ]
    )
    others = found.image != found.reference[found.point]
    assert np.median(np.linalg.norm(e[others], axis=1)) < 0.1
    with pytest.raises(GeometryError, match="detector 'orb', expected one of"):
        natural_points(photographs[0], detector="orb")
    blank = [np.zeros((90, 90), np.uint8)] * 3
    assert len(find_tie_points(blank, [natural_points(one) for one in blank])) == 0


def test_points_of_two_rays_are_taken_for_photographs_that_have_few_others() -> None:
    photographs, _, _ = _scene()
    natural = [natural_points(one, max_features=600) for one in photographs]
    three = find_tie_points(photographs, natural)
    per_photograph = np.bincount(three.image)
    same = find_tie_points(
        photographs, natural, settings=TrackSettings(min_image_points=int(per_photograph.min()))
    )
    assert (same.xy == three.xy).all()
    more = find_tie_points(
        photographs, natural, settings=TrackSettings(min_image_points=int(per_photograph.max()) + 1)
    )
    rays = np.bincount(more.point)
    assert set(rays.tolist()) == {2, 3} and (rays == 3).sum() == per_photograph[0]


def test_a_photograph_that_has_enough_points_needs_none_of_two_rays() -> None:
    """Of a point of three and one of two, photographs 0 and 1 see both."""
    image, point = np.array([0, 1, 2, 0, 1]), np.array([0, 0, 0, 1, 1])
    for fewest, kept in ((0, 3), (1, 3), (2, 5)):
        assert _needed(image, point, 3, TrackSettings(min_image_points=fewest)).sum() == kept
    image = np.array([0, 1, 2, 2, 3])  # photograph 3 has no other
    assert _needed(image, point, 4, TrackSettings(min_image_points=1)).all()


def test_matches_that_do_not_come_back_are_refused() -> None:
    """A place that is wrong by a pixel leads back to one that is wrong by a pixel."""
    photographs, truth, at = _scene()
    left, right = (grey_of(one) for one in photographs[:2])
    there = project(truth.cameras[0], truth.position[1], truth.rotation[1], truth.points)
    match = match_lsm(left, right, at, there, settings=LsmSettings(window_px=15, blur=True))
    assert match.good.sum() > 15
    good = _returning(left, right, at, match, 15)
    assert good.sum() >= match.good.sum() - 2
    first, *_ = np.flatnonzero(good).tolist()
    moved = match.xy.copy()
    moved[first] += [1.0, 0.0]
    again = _returning(left, right, at, replace(match, xy=moved), 15)
    assert not again[first] and again.sum() == good.sum() - 1


def test_few_photographs_are_in_memory_as_floats_at_a_time() -> None:
    """Of a hundred photographs of 24 megapixels all as floats would be 10 GB."""
    photographs = [np.full((40, 50), i, np.uint8) for i in range(5)]
    read: list[int] = []
    alive: list[weakref.ref[AnyArray]] = []

    def reading(i: int) -> AnyArray:
        read.append(i)
        return photographs[i]

    three = GreyPhotographs(reading, memory_bytes=3 * 40 * 50, grey_bytes=2 * 4 * 40 * 50)
    for i in (0, 1, 2, 0, 3, 0, 1, 4):
        one = three[i]
        assert one.pixels.dtype == np.float32 and (one.pixels == i).all()
        alive.append(weakref.ref(one.pixels))
        del one
        assert len({id(one()) for one in alive if one() is not None}) <= 2
    assert read[:4] == [0, 1, 2, 3]
    with pytest.raises(PhotographError, match="not finite"):
        GreyPhotographs(lambda i: np.full((9, 9), np.nan))[0]


def test_photographs_that_are_needed_in_turn_are_not_read_every_time() -> None:
    """As they are where the oldest one of more than there is place for gives way."""
    read: list[int] = []

    def reading(i: int) -> AnyArray:
        read.append(i)
        return np.full((40, 50), i, np.uint8)

    four = GreyPhotographs(reading, memory_bytes=4 * 40 * 50, grey_bytes=0)
    for turn in range(100):
        assert four[turn % 5].pixels[0, 0] == turn % 5
    assert len(read) < 60


def test_along_epipolar_lines_of_an_orientation_computed_from_the_photographs() -> None:
    lens = render.camera_from_values("lens", "opencv", SIZE, render.PIXEL_MM, c_mm=render.C_MM)
    position = np.array([[-0.06, 0.0, 1.6], [0.06, 0.05, 1.65]])
    left, right = _pictures(lens, position, np.tile(np.eye(3), (2, 1, 1)))
    natural = [natural_points(one, max_features=600) for one in (left, right)]
    found = find_tie_points([left, right], natural, settings=TrackSettings(min_rays=2))
    xy = [found.xy[found.image == i][np.argsort(found.point[found.image == i])] for i in range(2)]
    uv = [tangents_from_pixel(lens, one) for one in xy]
    pair = relative_orientations(uv[0], uv[1], tolerance=1.0 / lens.c_px)[0]
    assert pair.kind == "spatial"
    computed = Estimate(
        (lens,), np.stack([np.zeros(3), pair.base]), np.stack([np.eye(3), pair.rotation]), np.zeros((0, 3))
    )
    x, y = np.meshgrid(np.arange(180, 440, 40.0), np.arange(60, 301, 40.0))
    at = np.column_stack([x.ravel(), y.ravel()])
    cameras = np.zeros(2, dtype=np.int64)
    paths = epipolar_paths(computed, cameras, 0, 1, at, nearest=6.0, farthest=20.0)  # in bases
    along = match_along_line(left, right, at, paths)
    rays = np.column_stack([tangents_from_pixel(lens, at), -np.ones(len(at))])
    truth = project(lens, position[1], np.eye(3), render.surface_points(position[0], rays))
    inside = ((truth > 20) & (truth < np.array(SIZE) - 21)).all(axis=1)
    assert inside.sum() > 25 and along.good[inside].mean() > 0.9
    assert np.nanmax(np.linalg.norm(along.xy - truth, axis=1)[inside]) < 0.5


def test_survey_file_refuses_contradictions(tmp_path: Path) -> None:
    text = (Path(render.__file__).parent / "survey.toml").read_text(encoding="utf-8")
    survey = tmp_path / "survey.toml"
    survey.write_text(text.replace('detector = "foerstner"', "window_px = 14"), encoding="utf-8")
    with pytest.raises(SurveyFileError, match="window_px: found 14, needed an odd number"):
        read_survey(survey)
    survey.write_text(text.replace('"foerstner"', '"orb"'), encoding="utf-8")
    with pytest.raises(SurveyFileError, match="detector"):
        read_survey(survey)


def _write_small_survey(folder: Path, name: str, *, side: int = 1) -> Path:
    """Write three small photographs, a copy of one, a broken one, and a survey that knows their stations.

    Side -1 puts the stations on the other side of the origin, where they look away from the surface.
    """
    photographs, truth, _ = _scene()
    folder.mkdir(parents=True)
    for i, one in enumerate(photographs):
        cv2.imwrite(str(folder / f"{i + 1}.png"), np.rint(one).astype(np.uint8))
    (folder / "copy.png").write_bytes((folder / "2.png").read_bytes())
    (folder / "broken.png").write_bytes(b"no photograph")
    angles = [angles_from_rotation(R) for R in truth.rotation]
    rows = [
        f"{i + 1}.png," + ",".join(f"{v:.6f}" for v in (*(side * X0), *np.degrees(w)))
        for i, (X0, w) in enumerate(zip(truth.position, angles, strict=True))
    ]
    table = "\n".join(["image,X,Y,Z,omega_deg,phi_deg,kappa_deg", *rows]) + "\n"
    (folder / "images.csv").write_text(table, encoding="utf-8")
    survey = folder / "survey.toml"
    survey.write_text(
        f"""
[survey]
name = "{name}"
unit = "m"
[[camera]]
name = "lens"
images = "*.png"
pixel_mm = [{render.PIXEL_MM[0]}, {render.PIXEL_MM[1]}]
c_mm = {render.C_MM}
model = "opencv"
free = []
[targets]
codes = "none"
[tie_points]
max_features = 600
[approximate]
images = "images.csv"
[adjust]
sigma_px = 0.02
[compare]
backend = "none"
""",
        encoding="utf-8",
    )
    return survey


def test_small_survey_names_copies_and_reasons_and_starts_from_given_values(tmp_path: Path) -> None:
    survey = _write_small_survey(tmp_path / "a", "small")
    result = run_survey(read_survey(survey))
    a = result.adjustment
    assert a.network.images == ("1.png", "2.png", "3.png") and a.converged
    reasons = {one.image: one.reason for one in result.failed}
    assert reasons["copy.png"].names("original") == ("2.png",)
    broken = reasons["broken.png"]
    assert broken.kind == "photographs_unreadable" and "broken.png" not in broken.text  # stands beside it
    # the given values hold the datum of a free network up to what its inner constraints move
    _, truth, _ = _scene()
    assert np.abs(a.estimate.position - truth.position).max() < 0.02
    table = survey.parent / "images.csv"
    table.write_text(table.read_text(encoding="utf-8").replace("3.png", "9.png"), encoding="utf-8")
    with pytest.raises(SurveyFileError, match=r"image '9\.png' is no photograph of the survey"):
        run_survey(read_survey(survey))
    away = run_survey(read_survey(_write_small_survey(tmp_path / "b", "away", side=-1)))
    assert {"approximate_unused"} & set(kinds_of(away.remarks))


def test_batch_of_a_survey_without_targets_is_that_survey(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    survey = _write_small_survey(tmp_path / "a", "small")
    out = tmp_path / "out"
    looked: list[int] = []
    monkeypatch.setattr(
        "sfm.survey.measuring.tie_points.natural_points",
        lambda *given, **options: looked.append(1) or natural_points(*given, **options),
    )
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for stored in (False, True):
        (row,) = run_batch([survey], out, HERE, ALONE, Notes())
        assert len(looked) == 3  # in each photograph once, by the worker that has it
        log = {e["image"]: e for e in read_log(out / "small" / "log.jsonl") if e["event"] == "photograph"}
        assert sorted(log) == ["1.png", "2.png", "3.png", "broken.png", "copy.png"]
        for name, entry in log.items():
            found = entry.get("features", 0) > 0 and entry["stored"] == (stored or name == "copy.png")
            assert entry["failed"] if name == "broken.png" else found
    assert row.status == "done" and row.photographs == 3 and row.photographs_total == 3
    alone = run_survey(read_survey(survey)).adjustment
    rows = rows_of(out / "small" / "points.csv")
    assert [one["id"] for one in rows] == list(alone.network.points)
    xyz = np.array([[float(one[axis]) for axis in "XYZ"] for one in rows])
    assert xyz == pytest.approx(alone.estimate.points, abs=1e-9)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rendered = tmp_path_factory.mktemp("textured")
    render.render(rendered)
    return rendered


@pytest.mark.slow
@pytest.mark.parametrize("detector", ["foerstner", "sift"])
def test_textured_survey_from_photographs_to_result(folder: Path, tmp_path: Path, detector: str) -> None:
    survey = folder / f"{detector}.toml"
    text = (folder / "survey.toml").read_text(encoding="utf-8")
    survey.write_text(text.replace('"foerstner"', f'"{detector}"'), encoding="utf-8")
    result = run_survey(read_survey(survey), jobs=2, others=OtherPrograms(adjust_with_colmap))
    a = result.adjustment
    assert len(a.network.images) == render.PHOTOGRAPHS and not result.failed
    assert a.converged and len(a.network.points) > 2000
    assert result.comparison is not None and result.comparison.agree
    assert a.estimate.cameras[0].value("fx") == pytest.approx(render.C_MM / render.PIXEL_MM[0], abs=0.1)
    assert a.covariance is not None
    share, z_rms = _from_surface(a.network, a.estimate, a.covariance.points)
    assert share >= 0.99
    assert 0.85 < z_rms < 1.1  # 1.18 with blur left out, 1.11 with tie points as they were found
    near, z2, noise, stated = _from_their_places(a, folder)
    assert near >= 0.99
    # surfaces that are not plane move all pictures of a point by a few thousandths of a pixel together
    assert 0.8 < z2 < 1.3
    assert noise == pytest.approx(stated, rel=0.2)


@pytest.mark.slow
def test_photographs_without_exif_data_tell_their_principal_distance(folder: Path, tmp_path: Path) -> None:
    for path in folder.glob("*.png"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    survey = tmp_path / "survey.toml"
    drafted = draft_survey(tmp_path).text
    assert "1.2 times the longer side" in drafted  # 1200 px in place of 1333 px
    survey.write_text(drafted.replace('"colmap"', '"none"'), encoding="utf-8")
    a = run_survey(read_survey(survey), jobs=2).adjustment
    found, sigma = a.estimate.cameras[0], a.interior_sigma(0)[0] / a.estimate.cameras[0].pixel_mm[0]
    assert sigma < 0.2 and abs(found.c_px - render.camera().c_px) < 4 * sigma
    assert a.covariance is not None
    share, z_rms = _from_surface(a.network, a.estimate, a.covariance.points)
    assert share >= 0.99 and 0.8 < z_rms < 1.2


def _from_surface(network: Network, estimate: Estimate, covariance: FloatArray) -> tuple[float, float]:
    """Share of points within 3 sigma of the surface, along its normal, and RMS of distance over sigma."""
    position, _ = render.stations()
    place = fit_similarity(estimate.position, position)
    start = place.apply(estimate.points)
    foot = np.column_stack([start[:, :2], render.height(start[:, 0], start[:, 1])])
    place = fit_similarity(estimate.points, foot)  # finer: all points on the surface they are near to
    X = place.apply(estimate.points)
    h = 1e-6
    slope = [
        (render.height(X[:, 0] + dx, X[:, 1] + dy) - render.height(X[:, 0] - dx, X[:, 1] - dy)) / (2 * h)
        for dx, dy in ((h, 0.0), (0.0, h))
    ]
    normal = np.column_stack([-slope[0], -slope[1], np.ones(len(X))])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    in_model = place.scale * normal @ place.rotation
    sigma = np.sqrt(np.einsum("ki,kij,kj->k", in_model, covariance, in_model))
    z = (X[:, 2] - render.height(X[:, 0], X[:, 1])) * normal[:, 2] / sigma
    return float((np.abs(z) < 3).mean()), float(np.sqrt((z**2).mean()))


def _from_their_places(a: Adjustment, folder: Path) -> tuple[float, float, float, float]:
    """Compare object points in space with the places of the surface that their templates show.

    What a template shows is not quite what is at its middle: its noise has a shift too, which goes into all
    matches of the point. Without noise its own photograph tells the shift.

    Returns:
        Share of points within three times their point error sqrt(sX2 + sY2 + sZ2), mean of the squares of
        normalised coordinates, and the shift of templates, RMS and as stated by their covariance, px.
    """
    seen, skin = a.network.image_points, render.texture()
    whole = np.flatnonzero((seen.xy == np.rint(seen.xy)).all(axis=1) & ~a.rejected)  # templates are
    point, X = seen.point[whole], np.full((len(whole), 3), np.nan)
    shift = np.full((len(whole), 2), np.nan)
    for i in range(render.PHOTOGRAPHS):
        own = np.flatnonzero(seen.image[whole] == i)
        at = seen.xy[whole[own]]
        noisy = cv2.imread(str(folder / f"surface_{i + 1}.png"), cv2.IMREAD_UNCHANGED)
        shift[own] = (
            match_lsm(
                noisy, render.intensities(i, skin), at, at, settings=LsmSettings(window_px=15, blur=True)
            ).xy
            - at
        )
        X[own] = render.surface_at(i, at + shift[own])
    assert a.covariance is not None and len(np.unique(point)) == len(point) > 2000
    known = np.isfinite(X).all(axis=1)
    X, point = X[known], point[known]
    place = fit_similarity(a.estimate.points[point], X)
    C = place.scale**2 * place.rotation @ a.covariance.points[point] @ place.rotation.T
    e = place.apply(a.estimate.points[point]) - X
    near = np.linalg.norm(e, axis=1) < 3 * np.sqrt(np.trace(C, axis1=1, axis2=2))
    z2 = np.einsum("ki,kij,kj->k", e, np.linalg.inv(C), e) / 3
    stated = a.sigma0 * np.sqrt(seen.covariance[whole][:, [0, 1], [0, 1]].mean())
    return float(near.mean()), float(z2.mean()), float(np.sqrt((shift[known] ** 2).mean())), float(stated)


def test_refining_what_another_program_wrote(tmp_path: Path) -> None:
    """A simple radial camera, folders, a photograph not registered, points with two rays or far astray."""
    pycolmap = pytest.importorskip("pycolmap")
    photographs, truth, _ = _scene()
    rng = np.random.default_rng(9)
    scene = pycolmap.Reconstruction()
    width, height = SIZE
    focal = render.C_MM / render.PIXEL_MM[0]
    lens = pycolmap.Camera(
        model="SIMPLE_RADIAL",
        width=width,
        height=height,
        camera_id=1,
        params=[focal, 240, 180, 0],
    )
    scene.add_camera_with_trivial_rig(lens)
    seen = [
        project(truth.cameras[0], truth.position[i], truth.rotation[i], truth.points)
        + rng.normal(0, 0.3, (len(truth.points), 2))
        for i in range(3)
    ]
    for i, one in enumerate(photographs):
        M = np.diag([1.0, -1.0, -1.0]) @ truth.rotation[i].T
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(M), -M @ truth.position[i])
        name = f"{'ab'[i // 2]}/{i}.png"
        image = pycolmap.Image(name=name, keypoints=seen[i] + 0.5, camera_id=1, image_id=i + 1)
        scene.add_image_with_trivial_frame(image, pose)
        (tmp_path / name).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / name), np.rint(one).astype(np.uint8))
    for j, xyz in enumerate(truth.points):
        images = (1, 2) if j < 5 else (1, 2, 3)
        xyz = np.array([0.0, 0.0, 50.0]) if j == 9 else xyz  # behind all photographs
        scene.add_point3D(
            xyz, pycolmap.Track([pycolmap.TrackElement(i, j) for i in images]), np.zeros(3, np.uint8)
        )
    (tmp_path / "model").mkdir()
    scene.write_binary(str(tmp_path / "model"))
    network, estimate = read_model(tmp_path / "model")
    lost = replace(estimate, position=np.vstack([estimate.position, np.full(3, np.nan)]))
    lost = replace(lost, rotation=np.vstack([estimate.rotation, np.full((1, 3, 3), np.nan)]))
    beside = replace(network, images=(*network.images, "not registered.png"), camera=np.zeros(4, np.int64))
    result = refine_model(beside, lost, tmp_path)
    reasons = dict(result.reasons)
    assert reasons["of a point that fewer than 3 photographs see"] == 10
    assert reasons["behind the photograph or more than 85 degrees off the axis"] == 3
    assert result.refined >= 0.8 * (result.key_points - 13) and result.after_px < 0.1 < result.before_px
    text = refinement_text(result)
    assert "RMS before" in text and "RMS after" in text
    lenient = refine_model(beside, lost, tmp_path, RefineSettings(false_alarm=0.9))
    assert lenient.adjustment.false_alarm == 0.9 and lenient.refined < result.refined
    (tmp_path / "b" / "2.png").unlink()
    with pytest.raises(SurveyFileError, match=r"photograph 'b/2\.png' of the model is not in this folder"):
        refine_model(network, estimate, tmp_path)
    cv2.imwrite(str(tmp_path / "b" / "2.png"), np.zeros((50, 60), np.uint8))
    with pytest.raises(PhotographError, match="60 x 50 px, its camera has 480 x 360 px"):
        refine_model(network, estimate, tmp_path)
    (tmp_path / "b" / "2.png").unlink()  # what is refused now is refused before any photograph is read
    for wrong, message in (
        ({"window_px": 301}, "window is 301 px, needed at most 101 px"),
        ({"window_px": 16}, "16"),
        ({"min_correlation": float("nan")}, "smallest correlation is nan, needed 0 to 1"),
        ({"min_correlation": 7.0}, "smallest correlation is 7, needed 0 to 1"),
        ({"false_alarm": 7.0}, "false_alarm = 7.0, expected a number between 0 and 1"),
    ):
        with pytest.raises(GeometryError, match=message):
            RefineSettings(**wrong)
    nothing = replace(estimate, points=estimate.points * np.nan)
    with pytest.raises(GeometryError, match="nothing to refine"):
        refine_model(network, nothing, tmp_path)


@pytest.mark.slow
def test_refining_a_model(folder: Path) -> None:
    """Key points of a solved model with 0.5 px of noise become points of a few hundredths."""
    position, rotation = render.stations()
    lens = render.camera()
    rng = np.random.default_rng(3)
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, 16), np.linspace(-0.3, 0.3, 16))
    points = np.column_stack([x.ravel(), y.ravel(), render.height(x.ravel(), y.ravel())])
    m, n = render.PHOTOGRAPHS, len(points)
    seen = np.concatenate([project(lens, position[i], rotation[i], points) for i in range(m)])
    inside = ((seen > 15) & (seen < np.array(render.SIZE_PX) - 16)).all(axis=1)
    image, point = np.repeat(np.arange(m), n)[inside], np.tile(np.arange(n), m)[inside]
    network = Network(
        tuple(f"surface_{i + 1}.png" for i in range(m)),
        np.zeros(m, dtype=np.int64),
        tuple(str(j) for j in range(n)),
        ImagePoints(
            image,
            point,
            seen[inside] + rng.normal(0, 0.5, (len(image), 2)),
            np.tile(np.eye(2), (len(image), 1, 1)),
        ),
    )
    result = refine_model(network, Estimate((lens,), position, rotation, points), folder)
    assert result.before_px == pytest.approx(0.5, rel=0.1)
    assert result.after_px < 0.05
    assert result.refined > 0.8 * result.key_points
    with pytest.raises(
        SurveyFileError, match=r"photograph 'surface_1.png' of the model is not in this folder"
    ):
        refine_model(network, Estimate((lens,), position, rotation, points), folder / "..")


@pytest.mark.slow
def test_refining_the_model_of_colmaps_mapper(folder: Path) -> None:
    names = tuple(f"surface_{i + 1}.png" for i in range(render.PHOTOGRAPHS))
    mapped = map_photographs(folder, (names,), threads=1)
    result = refine_model(mapped.network, mapped.estimate, folder)
    assert result.before_px > 0.15
    assert result.after_px < 0.06 and result.refined > 0.9 * result.key_points


def test_places_move_to_the_strongest_corner_within_reach_without_a_table_of_all_pairs() -> None:
    corners = np.array([[50.0, 50.0], [12.0, 10.0], [10.5, 10.0]])  # the strongest first
    places = np.array([[10.0, 10.0], [30.0, 30.0], [51.0, 50.0]])
    found = _snapped(places, corners)
    assert found.tolist() == [[12.0, 10.0], [30.0, 30.0], [50.0, 50.0]]
    rng = np.random.default_rng(1)
    places, corners = rng.uniform(0, 4000, (3000, 2)), rng.uniform(0, 4000, (5000, 2))
    tracemalloc.start()
    _snapped(places, corners)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 16 * len(places) * len(corners) / 50
