"""Cross correlation: windows, pyramid, precision; grey values between pixels."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest

from sfm.matching.conjugate import match_points
from sfm.matching.conjugate_patches import MatchSettings
from sfm.matching.correlation import NccFlag, NccLimits, ambiguous, independent_pixels, match_ncc
from sfm.matching.epipolar import epipolar_paths
from sfm.matching.radiometry import (
    equalise_histogram,
    fit_radiometry,
    grey_of,
    histogram,
    match_brightness,
    radiometry_of,
)
from sfm.model.camera import project
from sfm.model.conventions import FloatArray
from sfm.model.errors import GeometryError, PhotographError
from sfm.runtime.sampling import resample
from sfm.textbook.matching import match_along_line, match_pyramid
from tests.synthetic import make_network
from tests.textures import random_texture, with_noise

SHIFT = np.array([7.3, -4.6])
SIGMA = 2.0


@cache
def _photographs() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Two photographs of one texture, the second shifted and of other brightness, and points in the first."""
    rng = np.random.default_rng(1)
    texture = random_texture(rng, 2.0)
    y, x = np.mgrid[0:260, 0:260].astype(float)
    left = with_noise(texture.value(x, y), SIGMA, 1)
    right = with_noise(20 + 0.8 * texture.value(x - SHIFT[0], y - SHIFT[1]), SIGMA, 2)
    at = np.stack(np.meshgrid(np.arange(50, 210, 16), np.arange(50, 210, 16)), axis=-1).reshape(-1, 2)
    return left, right, at.astype(float)


def test_peak_and_regression() -> None:
    left, right, at = _photographs()
    matches = match_ncc(left, right, at, at, search_px=61)
    assert matches.good.all()
    e = matches.xy - at - SHIFT
    assert np.abs(e).max() < 0.25
    assert matches.gain == pytest.approx(np.full(len(at), 0.8), abs=0.1)
    assert matches.offset == pytest.approx(np.full(len(at), 20), abs=16)
    assert (matches.second < matches.correlation).all()
    sigma = np.sqrt(matches.covariance[:, 0, 0].mean())
    assert 0.2 < sigma / np.sqrt((e**2).mean()) < 5


def test_coefficient_is_that_of_the_definition() -> None:
    left, right, at = _photographs()
    matches = match_ncc(left, right, at[:5], at[:5], template_px=9, search_px=41)
    for k in range(5):
        x, y = at[k].astype(int)
        u, v = matches.peak[k].astype(int)
        a, b = left[y - 4 : y + 5, x - 4 : x + 5].ravel(), right[v - 4 : v + 5, u - 4 : u + 5].ravel()
        assert matches.correlation[k] == pytest.approx(
            np.corrcoef(a.astype(float), b.astype(float))[0, 1], abs=1e-9
        )


def test_pyramid_agrees_with_the_whole_search() -> None:
    left, right, at = _photographs()
    whole, steps = (
        match_ncc(left, right, at, at, search_px=81),
        match_pyramid(left, right, at, at, search_px=81),
    )
    assert steps.good.mean() > 0.95
    both = steps.good & whole.good
    assert steps.xy[both] == pytest.approx(whole.xy[both], abs=1e-3)  # float32 sums


def test_back_matching_confirms_and_refutes() -> None:
    left, right, at = _photographs()
    assert match_ncc(left, right, at, at, search_px=61, back_px=0.5).good.all()
    hidden = right.copy()
    hidden[90:170, 90:170] = right[10:90, 10:90]  # what was there is gone
    matches = match_ncc(
        left, hidden, at, at, search_px=61, back_px=0.5, limits=NccLimits(min_correlation=0.0)
    )
    gone = (np.abs(at + SHIFT - 129.5) < 25).all(axis=1)
    assert gone.any() and not matches.good[gone].any()


def test_along_a_line() -> None:
    left, right, at = _photographs()
    direction = np.array([np.cos(0.5), np.sin(0.5)])
    lines = [p + SHIFT + 0.7 + direction * np.array([[-60], [60]]) for p in at]
    matches = match_along_line(left, right, at, lines)
    assert np.linalg.norm(matches.xy - at - SHIFT, axis=1).max() < 0.5
    beside = [line + 20 * np.array([-direction[1], direction[0]]) for line in lines]
    assert not match_along_line(left, right, at, beside, min_correlation=0.8).good.any()


def test_epipolar_paths_pass_through_the_conjugate_points() -> None:
    network, estimate = make_network(np.random.default_rng(3), images=3, points=12)
    xy = [
        project(
            estimate.cameras[network.camera[i]], estimate.position[i], estimate.rotation[i], estimate.points
        )
        for i in range(2)
    ]
    distance = np.linalg.norm(estimate.position[0] - estimate.points, axis=1)
    paths = epipolar_paths(
        estimate, network.camera, 0, 1, xy[0], nearest=0.5 * distance.min(), farthest=2 * distance.max()
    )
    for path, q in zip(paths, xy[1], strict=True):
        a, d = path[:-1], np.diff(path, axis=0)
        t = np.clip(((q - a) * d).sum(axis=1) / (d * d).sum(axis=1), 0, 1)
        assert np.linalg.norm(a + t[:, None] * d - q, axis=1).min() < 0.5


def test_failures_are_flagged() -> None:
    left, right, at = _photographs()
    one = at[:1]
    flat = np.full((100, 100), 90, np.uint8)
    assert match_ncc(flat, right, one, one).flag[0] == NccFlag.FLAT_TEXTURE
    assert match_ncc(left, right, np.array([[4.0, 50.0]]), one).flag[0] == NccFlag.OUTSIDE
    assert match_ncc(left, right, one, np.array([[-90.0, 50.0]])).flag[0] == NccFlag.OUTSIDE
    assert match_ncc(left, right, one * np.nan, one).flag[0] == NccFlag.OUTSIDE
    noise = np.random.default_rng(1).normal(128, 30, (260, 260))
    assert match_ncc(left, noise, one, one).flag[0] == NccFlag.LOW_CORRELATION
    stripes = np.tile(128 + 60 * np.sin(np.arange(260) * 2 * np.pi / 8), (260, 1))
    twice = match_ncc(stripes, stripes, one, one, limits=NccLimits(max_second=0.9))
    assert twice.flag[0] in (NccFlag.AMBIGUOUS, NccFlag.AT_BORDER)
    cut = match_ncc(left, right, one, np.array([[40.0, 30.0]]), search_px=121)  # window cut by the corner
    assert cut.xy[0] == pytest.approx(one[0] + SHIFT, abs=0.25)


def test_bad_windows_are_refused_in_one_line() -> None:
    left, right, at = _photographs()
    with pytest.raises(GeometryError, match="window of 20 px, needed an odd number"):
        match_ncc(left, right, at, at, template_px=20)
    with pytest.raises(GeometryError, match="search window of 19 px for a template of 21 px"):
        match_ncc(left, right, at, at, template_px=21, search_px=19)
    with pytest.raises(GeometryError, match="100 points in the left photograph, 1 windows"):
        match_ncc(left, right, at, at[:1])


@pytest.mark.parametrize(
    ("method", "tolerance"), [("ncc", 0.25), ("lsm", 0.06), ("lsm8", 0.06), ("shift", 0.05)]
)
def test_conjugate_points(method: str, tolerance: float) -> None:
    left, right, at = _photographs()
    found = match_points(left, right, at, settings=MatchSettings(method=method, search_px=61))
    assert found.good.all()
    assert found.right == pytest.approx(at + SHIFT, abs=tolerance)  # one of a hundred has a smaller window
    assert np.sqrt(((found.right - at - SHIFT) ** 2).mean()) < tolerance / 2.5
    eight_bit = [np.rint(p).clip(0, 255).astype(np.uint8) for p in (left, right)]
    equalised = match_points(
        *eight_bit, at, settings=MatchSettings(method=method, search_px=61, equalise=True)
    )
    assert equalised.right == pytest.approx(at + SHIFT, abs=2 * tolerance)


def test_windows_of_document_002() -> None:
    left, right, at = _photographs()
    eight_bit = [np.rint(p).clip(0, 255).astype(np.uint8) for p in (left, right)]
    found = match_points(
        *eight_bit,
        at,
        xy_right=at + np.rint(SHIFT),
        settings=MatchSettings(template_px=19, search_px=21, equalise=True),
    )
    assert found.good.all()
    assert found.right == pytest.approx(at + SHIFT, abs=0.1)


def test_photographs_of_different_size_depth_and_colour() -> None:
    left, right, at = _photographs()
    some = at[(at < 150).all(axis=1)]
    eight = np.rint(left).clip(0, 255).astype(np.uint8)
    deep = np.rint(right[:190, :210].clip(0, 255) * 257).astype(np.uint16)
    colour = np.repeat(deep[..., None], 3, axis=2)
    whole = match_points(left, right, some, settings=MatchSettings(search_px=61))
    for other in (deep, colour):
        for equalise in (False, True):
            found = match_points(eight, other, some, settings=MatchSettings(search_px=61, equalise=equalise))
            assert found.good.all()
            assert found.right == pytest.approx(whole.right, abs=0.05)
    outside = match_points(
        eight, deep, np.array([[255.0, 100.0], [200.0, 200.0]]), settings=MatchSettings(search_px=31)
    )
    assert outside.reason == (
        "outside: the template in the left photograph",
        "outside: the search window in the right photograph",
    )  # beyond the left, and beyond the smaller right one


def test_a_point_that_is_not_found_says_why() -> None:
    left, right, _ = _photographs()
    found = match_points(
        left, right, np.array([[2.0, 2.0], [100.0, 100.0]]), settings=MatchSettings(search_px=61)
    )
    assert found.reason == ("outside: the template in the left photograph", "")
    assert np.isnan(found.right[0]).all()


def test_float_and_flat_regions_do_not_disturb_the_peak() -> None:
    left, right, at = _photographs()
    dark = right.copy()
    dark[:, 230:] = 0.0
    dark[:40] = 0.0
    inside = (at + SHIFT < 215).all(axis=1) & (at + SHIFT > 55).all(axis=1)
    matches = match_ncc(left, dark, at[inside], at[inside], search_px=101)
    assert np.linalg.norm(matches.xy - at[inside] - SHIFT, axis=1).max() < 0.5


def test_pyramid_of_deep_photographs() -> None:
    left, right, at = _photographs()
    deep = [np.rint(p.clip(0, 255) * 257).astype(np.uint16) for p in (left, right)]
    found = match_pyramid(deep[0], right, at, at, search_px=81)
    assert found.good.mean() > 0.95
    both = match_ncc(deep[0], right, at, at, search_px=81)
    assert found.gain == pytest.approx(both.gain, rel=0.02)
    assert found.offset == pytest.approx(both.offset, abs=2)
    flat = np.full((260, 260), 7000, np.uint16) + np.random.default_rng(1).integers(0, 99, (260, 260))
    assert not match_pyramid(flat.astype(np.uint16), deep[1], at, at, search_px=81).good.any()


@pytest.mark.parametrize("method", ["ncc", "lsm"])
def test_turned_photographs_and_small_templates_are_not_matched(method: str) -> None:
    left, right, at = _photographs()
    y, x = np.mgrid[0:260, 0:260] - 130.0
    c, s = np.cos(np.radians(40)), np.sin(np.radians(40))
    turned = random_texture(np.random.default_rng(1), 2.0).value(130 + c * x - s * y, 130 + s * x + c * y)
    for wrong in (turned, 255 - turned):
        assert not match_points(left, wrong, at, settings=MatchSettings(method=method, wide=False)).good.any()
    small = match_points(left, right, at, settings=MatchSettings(method=method, template_px=3))
    assert not small.good.any()
    assert sum(reason == "ambiguous" for reason in small.reason) > 0.9 * len(at)


@pytest.mark.parametrize("method", ["ncc", "lsm"])
def test_conjugate_points_lead_back(method: str) -> None:
    left, right, _ = _photographs()
    left, right = left.copy(), right.copy()
    rng = np.random.default_rng(5)
    at = np.array([[109.0, 130.0]])
    original = left[110:151, 130:171]  # seen in both photographs; a bad copy of it in the left one alone
    left[110:151, 89:130] = original + 0.5 * (left[200:241, 200:241] - left.mean())
    right[100:156, 90:136] = rng.normal(128, 30, (56, 46))
    assert match_points(left, right, at, settings=MatchSettings(method=method, back_px=None)).good.all()
    found = match_points(left, right, at, settings=MatchSettings(method=method))
    assert found.reason == ("not confirmed",) and np.isnan(found.right).all()


def test_ambiguous_is_a_test_of_significance() -> None:
    # tanh(1) and tanh(0.5) of 53 pixels: 0.5 / sqrt(2 / 50) = 2.5; of 23: 1.58; no second place; 3 pixels
    best, second = np.tanh([1.0, 1.0, 1.0, 9.0]), np.array([*np.tanh([0.5, 0.5]), -1.0, 0.0])
    assert ambiguous(best, second, np.array([53.0, 23.0, 3.0, 3.0])).tolist() == [False, True, False, True]
    rng = np.random.default_rng(7)
    noise = rng.normal(0, 1, (200, 200))
    at = np.stack(np.meshgrid(np.arange(30, 170, 20), np.arange(30, 170, 20)), axis=-1).reshape(-1, 2)
    # the scatter of r of unrelated patches is that of so many independent pixels, or less
    for blur in (1, 3, 5):
        kernel = np.ones(blur) / blur
        smooth = noise
        for axis in (0, 1):
            smooth = np.apply_along_axis(np.convolve, axis, smooth, kernel, "same")
        n = independent_pixels(smooth, at.astype(float), 21)
        patches = np.array([smooth[v - 10 : v + 11, u - 10 : u + 11].ravel() for u, v in at])
        r = np.corrcoef(patches)[np.triu_indices(len(at), 1)]
        assert 0.4 < n.mean() * r.var() < 1.3
    assert np.isnan(independent_pixels(noise, np.array([[5.0, 50.0]]), 21)).all()


def test_sigma_of_the_peak_holds_what_the_parabola_misses() -> None:
    left, _, at = _photographs()
    points = at + np.random.default_rng(3).uniform(-0.5, 0.5, at.shape)
    same = match_ncc(left, left, points, points, search_px=41)  # the same pixels: no noise, only the parabola
    sigma = np.sqrt(np.diagonal(same.covariance, axis1=1, axis2=2))
    ratio = np.sqrt(((same.xy - points) ** 2).mean() / (sigma**2).mean())
    assert 0.5 < ratio < 2.0


RNG = np.random.default_rng(1)
PHOTOGRAPH = RNG.integers(20, 200, (40, 50)).astype(np.uint8)


def test_mean_and_deviation() -> None:
    found = radiometry_of(PHOTOGRAPH)
    assert found.mean == pytest.approx(PHOTOGRAPH.mean())
    assert found.deviation == pytest.approx(PHOTOGRAPH.std(ddof=1))
    assert (found.lowest, found.highest) == (PHOTOGRAPH.min(), PHOTOGRAPH.max())


def test_histogram_counts_every_pixel() -> None:
    counts = histogram(PHOTOGRAPH)
    assert counts.shape == (256,) and counts.sum() == PHOTOGRAPH.size
    assert counts[77] == (PHOTOGRAPH == 77).sum()
    assert histogram(PHOTOGRAPH.astype(np.uint16) * 257).shape == (65536,)
    with pytest.raises(PhotographError, match="a histogram needs 0 to 255"):
        histogram(PHOTOGRAPH.astype(float) * 9)


@pytest.mark.parametrize("factor", [1, 257])
def test_equalised_histogram_is_level(factor: int) -> None:
    kind = np.uint8 if factor == 1 else np.uint16
    dark = (40 + 20 * RNG.random((200, 200)) ** 3) * factor
    level = equalise_histogram(dark.astype(kind))
    assert level.dtype == kind and level.min() == 0 and level.max() == np.iinfo(kind).max
    # half of the pixels below the middle of the scale, to the width of the most frequent intensity
    widest = histogram(dark.astype(kind)).max() / level.size
    assert abs((level < np.iinfo(kind).max / 2).mean() - 0.5) < widest + 0.01


def test_equalisation_of_16_bit_is_that_of_cv2() -> None:
    ours = equalise_histogram(PHOTOGRAPH.astype(np.uint16))
    assert ours / 257 == pytest.approx(cv2.equalizeHist(PHOTOGRAPH), abs=0.51)
    assert (equalise_histogram(np.full((5, 5), 9, np.uint16)) == 9).all()


def test_linear_radiometry() -> None:
    target = 30 + 0.5 * PHOTOGRAPH.astype(float)
    fit = fit_radiometry(PHOTOGRAPH, target)
    assert (fit.offset, fit.gain, fit.correlation) == pytest.approx((30, 0.5, 1), abs=1e-5)
    assert fit_radiometry(np.full((4, 4), 9.0), target[:4, :4]).gain == 0
    with pytest.raises(GeometryError, match="needed the same shape"):
        fit_radiometry(PHOTOGRAPH, target[:4])


def test_brightness_and_contrast_of_another_photograph() -> None:
    matched = match_brightness(PHOTOGRAPH, 30 + 0.5 * PHOTOGRAPH[::-1].astype(float))
    assert matched == pytest.approx(30 + 0.5 * PHOTOGRAPH.astype(float), abs=1e-4)


def test_colour_becomes_luminance() -> None:
    colour = RNG.integers(0, 255, (6, 7, 3)).astype(np.uint8)
    assert grey_of(colour) == pytest.approx(cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY).astype(float), abs=0.51)
    with pytest.raises(PhotographError, match="shape"):
        grey_of(np.zeros((4, 5, 2), np.uint8))


@pytest.mark.parametrize("kernel", ["nearest", "bilinear", "bicubic", "six_tap"])
def test_kernels_return_the_pixels_themselves(kernel: str) -> None:
    y, x = np.mgrid[5:30, 5:40].astype(float)
    assert resample(PHOTOGRAPH, np.stack([x, y], axis=-1), interpolation=kernel) == pytest.approx(
        PHOTOGRAPH[5:30, 5:40].astype(float), abs=1e-4
    )


@pytest.mark.parametrize(("kernel", "degree"), [("bilinear", 1), ("bicubic", 2), ("six_tap", 5)])
def test_kernels_reproduce_polynomials(kernel: str, degree: int) -> None:
    y, x = np.mgrid[0:20, 0:20] / 10.0
    places = RNG.uniform(4, 14, (50, 2))
    for power in range(degree + 1):
        expected = (places[:, 0] / 10) ** power - 0.5 * (places[:, 1] / 10) ** power
        assert resample(x**power - 0.5 * y**power, places, interpolation=kernel) == pytest.approx(
            expected, abs=1e-5
        )


def test_better_kernels_have_smaller_errors() -> None:
    texture = random_texture(np.random.default_rng(2), 2.0)
    y, x = np.mgrid[0:60, 0:60].astype(float)
    places = RNG.uniform(5, 50, (500, 2))
    truth = texture.value(places[:, 0], places[:, 1])
    photograph = texture.value(x, y)
    errors = [
        np.sqrt(((resample(photograph, places, interpolation=k) - truth) ** 2).mean())
        for k in ("nearest", "bilinear", "bicubic", "six_tap")
    ]
    assert (np.diff(errors) < 0).all()


def test_bilinear_is_that_of_cv2_and_the_border_is_nan() -> None:
    places = RNG.uniform(0, 38, (100, 2)).astype(np.float32)
    remapped = cv2.remap(
        PHOTOGRAPH.astype(np.float32), places[:, :1], places[:, 1:], cv2.INTER_LINEAR
    ).ravel()
    # cv2 rounds fractions to 1/32 px
    assert resample(PHOTOGRAPH, places, interpolation="bilinear") == pytest.approx(remapped, abs=180 / 32)
    assert np.isnan(
        resample(PHOTOGRAPH, np.array([[-0.1, 5.0], [0.5, 5.0], [48.9, 5.0], [np.nan, 1.0]]))
    ).all()
    assert np.isfinite(resample(PHOTOGRAPH, np.array([[0.5, 0.5]]), interpolation="bilinear")).all()
