"""Damage and noise of outlines against the population of a photograph: statistics, and rendered dots."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import cast

import cv2
import numpy as np
import pytest

from datasets.bridge import render
from sfm.model.conventions import AnyArray, BoolArray, FloatArray
from sfm.products.rendering.render import render_photographs
from sfm.products.rendering.scene import Optics
from sfm.targets.detect import find_targets
from sfm.targets.edge_rays import RAYS
from sfm.targets.fits import goodness, undamaged
from sfm.targets.fits import outline_noise as damage
from sfm.targets.fits.ellipse_fit import fit_ellipses
from sfm.targets.fits.outline_noise import (
    MIN_POPULATION,
    OutlineShape,
    common_shape,
    find_damage,
    gap_shifts,
    harmonics,
    judge_outlines,
    moderate,
    most_telling,
    rise_to_first,
)
from sfm.targets.fits.undamaged import _stands_out
from sfm.targets.measure import EllipseFit, find_duplicates
from sfm.targets.outlines import Flag
from tests.survey.several_sources import NOISE, sheet_of
from tests.surveys import camera
from tests.synthetic import seed_of
from tests.targets.shapes import measure_class, over_stated, polygon_coverage


def damaged_sectors(z: FloatArray, alike: int = 0) -> list[int]:
    """Return the damaged sectors of an outline beside so many that are exact circles."""
    h = np.vstack([z, np.zeros((alike, RAYS))])
    sound = np.arange(1 + alike) > 0
    found = find_damage(h, np.ones_like(h), sound, np.zeros(1 + alike))
    assert not found[1:].any()
    return np.flatnonzero(found[0]).tolist()


def spikes(height: float, *at: int) -> FloatArray:
    return height * np.isin(np.arange(RAYS), at)


def test_level_of_the_scan() -> None:
    """0.01 / (2 x 3 widths x 32 sectors) is 3.88 sigmas; twice and half the level are 3.71 and 4.04."""
    assert damaged_sectors(spikes(3.80, 5)) == []
    assert damaged_sectors(spikes(3.97, 5)) == [5]


def test_neighbours_are_tested_together() -> None:
    """The ellipse follows part of low damage: neither two nor four sectors alone are significant here."""
    assert damaged_sectors(spikes(3.6, 3)) == []
    assert damaged_sectors(spikes(3.6, 3, 4)) == [3, 4]
    assert damaged_sectors(spikes(4.0, *range(3, 7))) == [3, 4, 5, 6]


def test_the_edge_beside_damage_is_kept() -> None:
    """A window about strong damage is significant with whole sectors in it."""
    assert {4, 5, 6} <= set(damaged_sectors(spikes(200.0, 4, 5, 6))) <= set(range(3, 8))


def test_three_places_are_shape_where_no_others_show_it() -> None:
    assert damaged_sectors(spikes(20.0, 4, 20)) == [4, 20]
    assert damaged_sectors(spikes(20.0, 4, 14, 24)) == []
    assert damaged_sectors(spikes(20.0, 4, 14, 24), alike=MIN_POPULATION) == [4, 14, 24]


def test_scatter_is_excused_up_to_three_times_the_usual() -> None:
    """Damage in nine targets is beyond 4.5 sigmas."""
    alternating = np.where(np.arange(RAYS) % 2, 1.0, -1.0)
    assert damaged_sectors(10 * alternating, alike=MIN_POPULATION) == []
    assert len(damaged_sectors(20 * alternating, alike=MIN_POPULATION)) == RAYS


def test_the_usual_scan_is_that_of_noise() -> None:
    h = seed_of("usual scan").standard_normal((3000, RAYS))
    weight = np.ones_like(h)
    z = damage._robust_residuals(h, weight)
    level = np.maximum(damage.MAD * np.median(np.abs(z), axis=1), 1.0)
    largest = damage._scan(z, weight).max(axis=(1, 2)) / level
    assert np.median(largest) == pytest.approx(damage.USUAL_SCAN, abs=0.05)


def test_eight_targets_show_a_common_shape() -> None:
    shape = 0.01 * harmonics(4, 4)[:, 0]
    for k, expected in ((8, shape), (7, np.zeros(RAYS))):
        h = np.tile(shape, (k, 1))
        np.testing.assert_allclose(common_shape(h, np.ones_like(h), np.ones(k, bool)), expected)


def test_blobs_of_texture_do_not_make_their_outlines_the_usual_ones() -> None:
    """A px of the edge of a target of full contrast tells some 50 times as much as one of a blob."""
    information = np.concatenate([np.linspace(40, 60, 10), np.linspace(0.5, 2, 40)])
    sound = np.arange(50) != 3
    np.testing.assert_array_equal(most_telling(sound, information), sound & (np.arange(50) < 10))
    few = np.arange(50) >= 5  # five targets do not show what is usual, however many blobs there are
    assert most_telling(few, information).sum() < MIN_POPULATION
    alike = np.linspace(1, 8, 50)  # targets of one make in uneven light
    assert most_telling(sound, alike) is sound
    assert not most_telling(np.zeros(50, bool), information).any()


def test_targets_are_found_among_texture() -> None:
    sheet = sheet_of(0)
    for i in (19, 22):
        (photograph,), (truth,) = render_photographs(
            sheet.scene, camera(), sheet.position[[i]], sheet.rotation[[i]],
            optics=Optics(blur_px=0.7, exposure=0.9, noise=NOISE / 255), seed=i,
        )  # fmt: skip
        found = find_targets(photograph, polarity="dark", codes="ring14")
        read = dict(zip(found.code.tolist(), found.xy, strict=True))
        shown = dict(zip(sheet.scene.targets.code.tolist(), truth.outline_centre, strict=True))
        codes = sheet.scene.targets.code[truth.visible].tolist()
        off = [read[code] - shown[code] for code in codes if code in read]
        assert len(off) >= len(codes) - 1 >= 6 and np.abs(off).max() < 0.1
        stated = dict(zip(found.code.tolist(), found.covariance, strict=True))
        C = np.array([stated[code] for code in codes if code in read])
        squares = np.einsum("ka,kab,kb->k", off, np.linalg.inv(C), off)
        assert 0.5 < math.sqrt(squares.mean() / 2) < 2.0


def test_dots_in_uneven_light_are_found() -> None:
    """Bright ones tell more of an outline, which makes faint ones no worse: 182 of 192 were found."""
    x, y = np.meshgrid(np.arange(8), np.arange(6))
    rows, columns = np.mgrid[0:380, 0:500]
    count = 0
    for k in range(4):
        rng = seed_of(f"uneven light {k}")
        contrast = np.minimum(0.2 * np.exp(0.7 * rng.standard_normal(48)), 0.9)
        contrast[20] = min(5 * contrast[20], 0.9)
        centre = np.column_stack([40 + 60 * x.ravel(), 40 + 60 * y.ravel()]) + rng.uniform(-1, 1, (48, 2))
        photograph = np.full(rows.shape, 0.05)
        for (u, v), light in zip(centre, contrast, strict=True):
            beyond = (np.hypot(columns - u, rows - v) - 7.0) / 0.6
            photograph += light / (1 + np.exp(np.minimum(beyond, 50.0)))
        noisy = np.clip(photograph + 0.004 * rng.standard_normal(rows.shape), 0, 1)
        found = find_targets(np.rint(255 * noisy).astype(np.uint8), polarity="bright")
        off = np.linalg.norm(found.xy[:, None] - centre, axis=2).min(axis=0)
        count += int((off < 0.2).sum())
    assert count >= 189


def test_a_common_shape_in_a_gap_shifts_the_centre() -> None:
    """The median shape is what an ellipse through the rest follows; without a gap nothing is."""
    shape, keep = 0.01 * harmonics(3, 3)[:, 0], np.ones((2, RAYS), bool)
    keep[1, :6] = False
    design = np.column_stack([np.ones(RAYS), harmonics(1, 2)])[keep[1]]
    shift = gap_shifts(shape, np.ones((2, RAYS)), keep)
    np.testing.assert_allclose(shift[0], 0, atol=1e-9)
    np.testing.assert_allclose(shift[1], np.linalg.lstsq(design, shape[keep[1]])[0][1:3], atol=1e-6)


def test_variances_are_drawn_to_the_population_but_outliers_are_not() -> None:
    rng = seed_of("moderate")
    ratio = 3 * rng.chisquare(8, 400) / 8  # all of one variance
    ratio[0] = 60.0
    factor, strange = moderate(ratio, np.ones(400, bool), 8)
    assert np.flatnonzero(strange).tolist() == [0]
    assert factor[0] == 60.0
    np.testing.assert_allclose(factor[1:], 3.0, rtol=0.25)
    spread = ratio * 8 / rng.chisquare(8, 400)  # of variances with 8 degrees of freedom
    np.testing.assert_allclose(moderate(np.array([5.0]), np.ones(1, bool), 8)[0], 3.0)  # half of it is prior
    assert np.corrcoef(np.log(moderate(spread, np.ones(400, bool), 8)[0]), np.log(spread))[0, 1] > 0.9


def outlines(exponent: float, k: int) -> FloatArray:
    """Return outlines whose harmonics from 3 on have powers 1 / harmonic^exponent, exactly."""
    order = np.arange(3, 13)
    amplitude = 1e5 * np.repeat(order ** (-exponent / 2), 2)
    h = harmonics(3, 12) @ (amplitude / np.repeat(np.sinc(order / RAYS), 2) ** -1)
    return np.tile(h, (k, 1))


def test_power_of_the_first_harmonic() -> None:
    weight = np.ones((400, RAYS))
    assert rise_to_first(outlines(0.0, 400), weight, 0.0) == 1.0
    k = np.arange(3.0, 7.0)
    for exponent, used in ((2.0, 2.0), (3.0, 3.0), (5.0, 3.0)):
        assert rise_to_first(outlines(exponent, 400), weight, 0.0) == pytest.approx(
            1 / np.mean(k**-used), rel=0.02
        )
    # blur leaves too few harmonics from 0.24 radii on
    assert rise_to_first(outlines(2.0, 400), weight, 0.22) > 1
    assert rise_to_first(outlines(2.0, 400), weight, 0.27) == 1.0


def test_an_exponent_is_used_from_two_sigmas_on() -> None:
    spread = np.log(np.arange(3, 13))
    needed = 2 * (2 / ((spread - spread.mean()) ** 2).sum()) / 0.5**2 * 2  # targets for 2 sigmas of 0.5
    for count, rises in ((int(1.3 * needed), True), (int(needed / 1.3), False)):
        assert (rise_to_first(outlines(0.5, count), np.ones((count, RAYS)), 0.0) > 1) == rises


def test_harmonics_that_blur_hides_show_the_first() -> None:
    """A local nick has all harmonics alike; by what is left of them its variance was 5 times too small."""
    softness, a, k = 0.3, 40.0, 100
    left = np.repeat(np.exp(-0.5 * (softness * np.arange(3, 7)) ** 2), 2)
    shape = seed_of("hidden harmonics").standard_normal((k, 8))
    shape[0] = a * left
    outlines = OutlineShape(
        shape, np.tile(np.eye(8), (k, 1, 1)), np.zeros((k, 2, 8)), np.zeros(k), np.zeros(k)
    )
    noise = judge_outlines(outlines, np.ones(k), np.arange(k) > 0, np.full(k, softness), 1.0)
    assert noise.factor[0] == pytest.approx(a**2, rel=0.02)
    assert noise.factor[1:].max() < 1.5


def test_what_is_unlike_the_others() -> None:
    sound = np.arange(41) > 0
    for scatter, limit in ((0.0, 0.5), (0.4, 2.0)):  # 5 sigmas of 0.1 at least
        others = np.exp(scatter * np.where(np.arange(40) % 2, 1, -1) / damage.MAD)
        for z, unlike in ((0.75 * limit, False), (1.3 * limit, True)):
            values = np.append(math.exp(z), others)
            assert _stands_out(values, values[sound])[0] == unlike


@pytest.mark.sweep(2, 3)
@pytest.mark.parametrize(
    ("name", "size"),
    [
        ("12-gon", (25.0, 5)),
        pytest.param("12-gon", (60.0, 4), marks=pytest.mark.slow),
        ("JPEG 60", (25.0, 5)),
        ("sharpened", (14.0, 5)),
        ("rough, flat", (14.0, 6)),
    ],
)
def test_shape_is_not_damage_and_sigma_is_true(name: str, size: tuple[float, int]) -> None:
    """Before: 0.98 and 10 % flagged, 0.32, 1.78, 0.61, 3; 128 to 288 coordinates give 1 +- 0.06 at most."""
    measured, damaged, _ = measure_class(name, (size,))
    assert not damaged.any()
    assert measured.flagged.mean() < 0.01
    assert 0.8 < over_stated(measured, ~damaged) < 1.3


def test_cells_of_codes_are_no_population_of_dots() -> None:
    """Before: sigmas of 0.024 px where 0.008 is true, and cells of the codes in the edges of the dots."""
    staging = render.staging("second")
    photographs, truths = render_photographs(
        staging.scene,
        staging.camera,
        staging.positions[:2],
        staging.rotations[:2],
        optics=staging.optics,
        seed=seed_of("bridge").integers(1 << 31),
    )
    normalised, error = [], []
    for photograph, truth in zip(photographs, truths, strict=True):
        found = find_targets(photograph)
        for xy in truth.outline_centre[truth.visible]:
            at = int(np.hypot(*(found.xy - xy).T).argmin())
            assert not found.flag[at] & Flag.DAMAGED
            error.append(found.xy[at] - xy)
            normalised.append(np.linalg.solve(np.linalg.cholesky(found.covariance[at]), error[-1]))
    assert len(error) > 80
    assert np.sqrt(np.mean(np.square(error))) < 0.009
    assert 0.8 < np.sqrt(np.mean(np.square(normalised))) < 1.2


def test_nicks_are_left_out_and_widen_the_sigma() -> None:
    """Before: 1.71 of the stated sigma."""
    measured, damaged, _ = measure_class("nick", ((25.0, 5),))
    assert measured.flagged[damaged].mean() > 0.7
    assert np.isfinite(measured.error[~damaged]).all()  # one was lost before, and is flagged now
    assert measured.flagged[~damaged].sum() <= 1
    assert 0.6 < over_stated(measured, damaged) < 1.3


def test_scratches_along_small_dots_reject_them() -> None:
    """No edge shows them, residuals that lie together do: before, three were kept, off by 6.1 sigmas."""
    measured, damaged, _ = measure_class("scratch", ((6.0, 8),))
    assert np.isfinite(measured.error[~damaged]).all()
    assert not (np.abs(measured.error[damaged]) > 0.05).any()


@pytest.mark.parametrize(
    ("major", "minor", "blur"), [(40.0, 10.4, 3.6), (20.0, 8.0, 1.4), (12.0, 4.0, 1.35), (8.0, 2.2, 0.77)]
)
def test_what_the_model_lacks_at_curved_edges(major: float, minor: float, blur: float) -> None:
    """Of the mean residual that is excused in a square of two blurs, six tenths are needed at least."""
    cells, side = 8, int(2 * major + 24)
    phi = np.linspace(0, 2 * math.pi, 720, endpoint=False)
    outline = side / 2 + 0.2 + np.column_stack([major * np.cos(phi), minor * np.sin(phi)])
    ink = polygon_coverage(cells * outline, cells * side, cells * side)
    soft = cv2.GaussianBlur(ink.astype(np.float32), (0, 0), cells * math.sqrt(blur**2 - 1 / 12))
    fits = fit_ellipses(
        200 - 160 * cv2.resize(soft, (side, side), interpolation=cv2.INTER_AREA),
        np.array([[side / 2 - 0.3, side / 2 - 0.3, 1 / major, 0.0, 1 / minor]]),
        np.array([-1]),
        0.3,
        math.inf,
        np.ones((1, RAYS), bool),
        np.array([math.inf]),
    )
    lacking = fits.statistics[0, goodness.TOGETHER] / (160 * 2 * max(fits.theta[0, 7], 1.0))
    allowed = undamaged._model_misfit(fits.theta)[0]
    assert 0.6 * allowed < lacking < allowed


def test_a_hot_pixel_is_no_mark() -> None:
    """Residuals are a mark where several pixels have them."""
    rng, side = np.random.default_rng(4), 48
    y, x = np.mgrid[:side, :side]
    ink = np.clip(12.5 - np.hypot(x - 24.2, y - 23.7), 0, 1).astype(np.float32)
    dot = 200 - 160 * cv2.GaussianBlur(ink, (0, 0), 0.8) + rng.normal(0, 1, ink.shape)

    def coherence(where: tuple[slice, slice], more: float) -> FloatArray:
        picture = dot.astype(np.float32)  # as photographs; float64 would be compiled anew
        picture[where] += more
        start = np.array([[24.0, 24.0, 1 / 12, 0.0, 1 / 12]])
        whole = np.ones((1, RAYS), bool), np.array([math.inf])
        found = fit_ellipses(picture, start, np.array([-1]), 1.0, math.inf, *whole).statistics[0]
        return np.asarray(found[[goodness.INSIDE, goodness.TOGETHER]] / found[goodness.SPREAD])

    assert (coherence((slice(24, 25), slice(26, 27)), 150) < 6).all()
    assert (coherence((slice(24, 26), slice(26, 28)), 20) > 15).all()


@pytest.mark.parametrize("radius", [pytest.param(14.0, marks=pytest.mark.slow), 25.0])
def test_stains_are_not_measured(radius: float) -> None:
    """Before: a target more than half a pixel from the centre in 33 and 61 % of the stained dots."""
    measured, damaged, _ = measure_class("stain", ((radius, 5),))
    assert not measured.far.any()
    assert np.isfinite(measured.error[~damaged]).all()


def picture_of(dots: list[tuple[float, float, float, float]]) -> AnyArray:
    """Return a noisy picture of soft discs (x, y, radius, level) painted in this order."""
    y, x = np.mgrid[:300, :300].astype(float)
    image = np.full((300, 300), 200.0)
    for x0, y0, radius, level in dots:
        share = np.clip(radius - np.hypot(x - x0, y - y0) + 0.5, 0, 1)
        image += share * (level - image)
    image = cv2.GaussianBlur(image, (0, 0), 0.8) + seed_of("picture").normal(0, 2, image.shape)
    return np.rint(image).clip(0, 255).astype(np.uint8)


GRID = [(40.3 + 55 * i, 40.7 + 55 * j, 16.0, 40.0) for i in range(5) for j in range(5)]


def test_rings_are_measured_at_their_holes_and_stains_are_not() -> None:
    x, y = GRID[12][:2]
    ring = find_targets(picture_of([*GRID, (x, y, 8.0, 200.0)]))
    assert len(ring) == 25
    at = np.hypot(*(ring.xy - (x, y)).T).argmin()
    assert ring.polarity[at] == 1 and np.hypot(*(ring.xy[at] - (x, y))) < 0.1
    for shift in (0.4, 2.0, 6.0):
        stained = find_targets(picture_of([*GRID, (x + shift, y, 8.0, 200.0)]))
        assert (stained.polarity == -1).all() and len(stained) >= 24
        assert np.hypot(*(stained.xy[:, None] - np.array(GRID)[:, :2]).T).min(axis=0).max() < 0.1


def hole_in_a_dot(
    radii: tuple[float, ...], off: tuple[float, float], sigma: float
) -> tuple[BoolArray, FloatArray]:
    """Return the judgement of a dot, a hole in it that is so far off, of this sigma, and another dot, px."""
    radius, sigmas = np.array(radii), np.array([0.02, sigma, 0.02])
    fit = SimpleNamespace(
        xy=np.array([(0.0, 0.0), off, (60.0, 0.0)]),
        shape=np.column_stack([1 / radius, 0 * radius, 1 / radius]),
        covariance=sigmas[:, None, None] ** 2 * np.eye(2),
    )
    polarity = np.array([-1, 1, -1])
    return find_duplicates(cast(EllipseFit, fit), polarity, np.zeros(3, np.int64), np.zeros(3, bool))


@pytest.mark.parametrize(("sigma", "duplicate"), [(0.01, False), (0.5, False), (0.95, True)])
def test_a_hole_must_be_shown_to_be_concentric(sigma: float, duplicate: bool) -> None:
    """Five of its sigmas are less than half its radius."""
    found, off_centre = hole_in_a_dot((14.0, 8.0, 14.0), (0.1, 0.1), sigma)
    assert found.tolist() == [not duplicate, duplicate, False]
    beyond = 0.1 - 0.02 * 8 / math.sqrt(2)  # less than nothing: perspective alone may do it
    assert beyond < 0 and not off_centre.any()


def test_a_hole_is_as_sure_as_it_is_concentric() -> None:
    """Stains that are not shown to be apart were measured to 0.014 px, 0.16 px off."""
    duplicate, off_centre = hole_in_a_dot((6.0, 2.0, 6.0), (0.0, 0.14), 0.02)
    assert duplicate.tolist() == [True, False, False]
    np.testing.assert_allclose(off_centre, [(0, 0), (0, 0.14 - 0.02 * 2.0), (0, 0)])


@pytest.mark.parametrize(("radius", "rejected"), [(3.2, True), (7.0, False)])
def test_small_damaged_targets_are_rejected(radius: float, rejected: bool) -> None:
    dots = [(x, y, radius, 40.0) for x, y, _, _ in GRID]
    x, y = GRID[12][:2]
    found = find_targets(picture_of([*dots, (x + radius, y, 0.3 * radius, 200.0)]), polarity="dark")
    at = np.hypot(*(found.xy - (x, y)).T) < 1
    assert at.sum() == (0 if rejected else 1)
    assert len(found) == 24 + at.sum()
    assert all(found.flag[at] & Flag.DAMAGED)


@pytest.mark.parametrize(("depth", "flagged"), [(2.0, False), (12.0, True)])
def test_marks_inside_are_left_out(depth: float, flagged: bool) -> None:
    """Residuals inside that lie together, of a noise of 2 here, are 5 sigmas at most."""
    x, y = GRID[12][:2]
    found = find_targets(picture_of([*GRID, (x + 4, y, 2.5, 40.0 + depth)]), polarity="dark")
    assert ((found.flag & Flag.DAMAGED) != 0).sum() == flagged
    assert len(found) == 25


def test_letters_are_no_population_of_larger_targets() -> None:
    """Sizes without others between them are populations by themselves, but for few targets."""
    radius = np.array([7.3] * 20 + [10.4] * 3 + [12.5] * 12 + [13.0, 14.0, 40.0])
    classes = undamaged.sizes_apart(radius)
    assert [sorted(radius[one].tolist()) for one in classes] == [[7.3] * 20, sorted(radius[20:].tolist())]
    steps = np.exp(np.linspace(0, 2, 30))  # of perspective
    assert [len(one) for one in undamaged.sizes_apart(steps)] == [30]
    assert [len(one) for one in undamaged.sizes_apart(np.array([5.0]))] == [1]
    assert undamaged.sizes_apart(np.zeros(0)) == []


def test_dark_targets_are_judged_by_dark_ones() -> None:
    """As on a screen, whose pixels dark dots show; before, 22 of 25 were lost beside faint bright ones."""
    rng, (y, x) = seed_of("polarities"), np.mgrid[0:900, 0:900].astype(float)
    dots = [(90 + 170 * i, 90 + 170 * j) for i in range(5) for j in range(5)]
    places = [(45 + 70 * i, 48 + 70 * j) for i in range(12) for j in range(12)]
    faint = [(a, b) for a, b in places if min(np.hypot(a - u, b - v) for u, v in dots) > 50]

    def discs(places: list[tuple[int, int]]) -> np.ndarray:
        away = np.full(x.shape, np.inf)
        for a, b in places:
            near = np.s_[max(b - 16, 0) : b + 17, max(a - 16, 0) : a + 17]
            away[near] = np.minimum(away[near], np.hypot(x[near] - a, y[near] - b))
        return np.asarray(np.clip(0.5 - (away - 14) / 1.6, 0, 1))

    screen = 1 + 0.2 * np.sin(2 * np.pi * x / 5) * np.sin(2 * np.pi * y / 5)
    grey = 160 - 140 * screen * discs(dots) + 30 * discs(faint) + rng.normal(0, 1, x.shape)
    picture = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    assert len(find_targets(picture, polarity="dark").xy) == len(dots)
    both = find_targets(picture, polarity="auto")
    assert (both.polarity < 0).sum() == len(dots) < len(both.xy)
