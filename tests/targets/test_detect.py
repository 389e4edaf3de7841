"""Finding, measuring and decoding in whole photographs: synthetic ones, then the public real ones."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from sfm.model.conventions import AnyArray, FloatArray
from sfm.model.errors import KolinearError, PhotographError
from sfm.photographs.reading import read_photograph
from sfm.targets.codes.plates import code_family
from sfm.targets.detect import find_targets
from sfm.targets.fits.blurred_ellipse import BLUR
from sfm.targets.measure import SOFTEST_EDGE, axes_from_shape, fit_ellipse_model, judge_fits
from sfm.targets.outlines import Flag, count_flags, estimate_noise
from tests.places import SHARED

DATA = SHARED / "data"
SUPER = 4


def scene(
    size: tuple[int, int], ellipses: FloatArray, *, background: float, step: FloatArray, blur: float = 0.8
) -> AnyArray:
    """Return an area sampled picture of ellipses (x, y, a, b, angle) on a background."""
    w, h = size
    picture = np.full((h, w), float(background))
    for (x0, y0, a, b, angle), A in zip(ellipses, step, strict=True):
        reach = int(a + 6)
        left, top = int(x0) - reach, int(y0) - reach
        n = 2 * reach + 1
        y, x = (np.mgrid[: n * SUPER, : n * SUPER] + 0.5) / SUPER - 0.5
        c, s = np.cos(angle), np.sin(angle)
        dx, dy = x + left - x0, y + top - y0
        u, v = (c * dx + s * dy) / a, (c * dy - s * dx) / b
        rho = np.hypot(u, v) + 1e-9
        distance = rho * (rho - 1) / (np.hypot(u / a, v / b) + 1e-9)
        inside = np.clip(0.5 - distance * SUPER, 0, 1)  # share of each sample's area
        soft = cv2.GaussianBlur(inside.astype(np.float32), (0, 0), blur * SUPER)
        small = cv2.resize(soft, (n, n), interpolation=cv2.INTER_AREA)
        i0, i1, j0, j1 = max(top, 0), min(top + n, h), max(left, 0), min(left + n, w)
        picture[i0:i1, j0:j1] += A * small[i0 - top : i1 - top, j0 - left : j1 - left]
    return picture


def grid(count: int, spacing: float, rng: np.random.Generator, low: float, high: float) -> FloatArray:
    """Return ellipses on a jittered grid with semi-axes between two limits and tilts up to 65 degrees."""
    i, j = np.divmod(np.arange(count**2), count)
    xy = spacing * (np.column_stack([j, i]) + 0.5) + rng.uniform(-2, 2, (count**2, 2))
    a = rng.uniform(low, high, count**2)
    b = np.maximum(a * np.cos(rng.uniform(0, np.radians(65), count**2)), low)
    return np.column_stack([xy, a, b, rng.uniform(-1.5, 1.5, count**2)])


def noisy(picture: AnyArray, sigma: float, rng: np.random.Generator, dtype: type = np.uint8) -> AnyArray:
    top = np.iinfo(dtype).max
    return np.round(picture + rng.normal(0, sigma, picture.shape)).clip(0, top).astype(dtype)


@pytest.mark.parametrize("polarity", ["dark", "bright", "auto"])
def test_all_targets_are_found_and_none_invented(polarity: str) -> None:
    rng = np.random.default_rng(5)
    truth = grid(14, 48, rng, 2.0, 14)
    n = len(truth)
    sign = {"dark": -np.ones(n), "bright": np.ones(n), "auto": np.where(np.arange(n) % 2, 1, -1)}[polarity]
    picture = noisy(scene((672, 672), truth, background=125, step=100 * sign), 2, rng)
    found = find_targets(picture, polarity=polarity, min_diameter_px=3.5)
    assert len(found) == n
    distance = np.hypot(*(found.xy[:, None] - truth[None, :, :2]).transpose(2, 0, 1))
    match = distance.argmin(axis=1)
    assert len(set(match)) == n
    assert distance.min(axis=1).max() < 0.25
    np.testing.assert_array_equal(found.polarity, sign[match])
    error = found.xy - truth[match, :2]
    squared = np.einsum("ki,kij,kj->k", error, np.linalg.inv(found.covariance), error) / 2
    # mean of 392 squared deviates: 1 +- 0.07
    assert np.mean(squared) == pytest.approx(1.0, abs=0.21)


def test_large_targets_16_bit_and_shading() -> None:
    rng = np.random.default_rng(6)
    truth = np.array([[110.3, 120.8, 100, 70, 0.4], [330.2, 90.1, 60, 25, -0.7], [330.9, 250.2, 40, 40, 0.0]])
    shade = np.linspace(0.6, 1.2, 440)[None, :]
    clean = scene((440, 320), truth, background=40000, step=np.full(3, -30000.0)) * shade
    found = find_targets(noisy(clean, 300, rng, np.uint16), polarity="auto")
    assert len(found) == 3
    for x, y, a, b, _ in truth:
        k = np.hypot(*(found.xy - (x, y)).T).argmin()
        assert np.hypot(*(found.xy[k] - (x, y))) < 0.1
        np.testing.assert_allclose(found.semi_axes[k], (a, b), rtol=0.01)


def test_rejections_are_counted_by_reason() -> None:
    rng = np.random.default_rng(7)
    ellipses = np.array(
        [
            [2.0, 60, 9, 9, 0],  # cut by the border
            [60, 60, 9, 9, 0],  # good
            [120, 60, 2.2, 2.2, 0],  # too small
            [180, 60, 30, 30, 0],  # too large
            [60, 150, 26, 2, 0.3],  # too oblique
        ]
    )
    picture = scene((260, 260), ellipses, background=30, step=np.full(5, 150.0))
    picture[180:200, 100:120] += 150  # square
    picture[180:190, 160:190] += 150  # bar
    picture[140:150, 225:235] += 150  # two touching squares
    picture[150:160, 235:245] += 150
    found = find_targets(noisy(picture, 2, rng), polarity="bright", min_diameter_px=6, max_diameter_px=56)
    assert len(found) == 1
    np.testing.assert_allclose(found.xy[0], (60, 60), atol=0.05)
    counts = dict(count_flags(found.rejected_flag))
    assert counts.pop("cut_by_border") == 1
    assert counts.pop("too_small") >= 1
    assert counts.pop("too_large") == 1
    assert counts.pop("too_oblique") >= 1
    assert sum(counts.values()) >= 3
    square = np.hypot(*(found.rejected_xy - (109.5, 189.5)).T).argmin()
    reasons = Flag.NOT_ELLIPTIC | Flag.UNEVEN_EDGE | Flag.POOR_FIT | Flag.LOBED
    assert Flag(int(found.rejected_flag[square])) in reasons


def test_a_coded_target_hides_its_ring() -> None:
    rng = np.random.default_rng(8)
    family = code_family("ring14")
    assert family is not None
    y, x = (np.mgrid[: 200 * SUPER, : 200 * SUPER] + 0.5) / SUPER - 0.5
    dx, dy = (x - 100.3) / 9, (y - 99.6) / 7
    rho, angle = np.hypot(dx, dy), np.degrees(np.arctan2(dy, dx)) % 360
    cell = (angle / (360 / 14)).astype(int)
    pattern = int(family.pattern[200])
    inside = (rho < 1) | ((rho > 2) & (rho < 3) & ((pattern >> (13 - cell)) & 1 == 1))
    coverage = cv2.resize(inside.astype(np.float32), (200, 200), interpolation=cv2.INTER_AREA)
    picture = noisy(40 + 130 * cv2.GaussianBlur(coverage, (0, 0), 0.7), 2, rng)
    found = find_targets(picture, polarity="auto", codes="ring14")
    assert found.code.tolist() == [201]
    np.testing.assert_allclose(found.xy[0], (100.3, 99.6), atol=0.03)
    assert found.confidence[0] > 0.5


def test_an_empty_photograph_has_no_targets() -> None:
    rng = np.random.default_rng(9)
    for picture in (np.full((90, 120), 7, np.uint8), noisy(np.full((300, 300), 100.0), 5, rng)):
        found = find_targets(picture, codes="ring14")
        assert len(found) == 0
        assert found.covariance.shape == (0, 2, 2)


def test_noise_is_estimated() -> None:
    rng = np.random.default_rng(10)
    for sigma in (1.5, 6.0):
        picture = noisy(np.full((400, 400), 120.0), sigma, rng)
        assert estimate_noise(picture) == pytest.approx(sigma, rel=0.05)


def test_wrong_arguments_are_refused() -> None:
    with pytest.raises(PhotographError, match="float64 of shape"):
        find_targets(np.zeros((10, 10)))
    with pytest.raises(KolinearError, match="polarity 'white', expected one of dark, bright, auto"):
        find_targets(np.zeros((50, 50), np.uint8), polarity="white")


def nearest(found: FloatArray, reference: FloatArray) -> tuple[AnyArray, FloatArray]:
    distance = np.hypot(*(reference[:, None] - found[None]).transpose(2, 0, 1))
    return distance.argmin(axis=1), distance.min(axis=1)


@pytest.mark.slow
@pytest.mark.skipif(not (DATA / "camcal").exists(), reason="../shared/data is absent")
def test_camcal_reference_points_are_measured() -> None:
    reference: dict[int, list[tuple[float, ...]]] = {}
    for line in (DATA / "camcal" / "camcal-pmexport.txt").read_text().splitlines():
        words = line.split()
        if len(words) == 6 and words[0].isdigit() and words[1].isdigit():
            point = (float(words[1]), float(words[2]) - 0.5, float(words[3]) - 0.5)
            reference.setdefault(int(words[0]), []).append(point)
    assert sum(map(len, reference.values())) == 2074
    missed, extra, difference = 0, 0, []
    for photo, points in reference.items():
        picture = read_photograph(DATA / "camcal" / "images" / f"P82500{21 + photo}.JPG")
        found = find_targets(picture, polarity="dark", codes="arcs", min_diameter_px=6)
        marks = np.array(points)
        at, distance = nearest(found.xy, marks[:, 1:])
        missed += int((distance > 1).sum())
        extra += len(found) - len(set(at[distance <= 1]))
        difference.append((found.xy[at] - marks[:, 1:])[distance <= 1])
        control = marks[:, 0] > 1000
        assert found.code[at[control]].tolist() == (marks[control, 0] - 1000).astype(int).tolist()
        assert (found.code >= 0).sum() == control.sum()
    assert missed <= 4
    assert extra <= 21  # dark spots of the parquet, one per photograph; later no ray meets theirs
    d = np.concatenate(difference)
    assert np.abs(d.mean(axis=0)).max() < 0.05
    assert d.std(axis=0).max() < 0.17  # the marks of the reference have about 0.14 px themselves


@pytest.mark.slow
@pytest.mark.skipif(not (DATA / "retro-panel").exists(), reason="../shared/data is absent")
def test_retro_panel_codes_are_read() -> None:
    text = (DATA / "retro-panel" / "reference-image-points.csv").read_text().splitlines()[1:]
    reference: dict[str, list[tuple[float, ...]]] = {}
    for name, *numbers in (line.split(",") for line in text):
        reference.setdefault(name, []).append(tuple(map(float, numbers)))
    difference, others = [], []
    for name, points in reference.items():
        picture = read_photograph(DATA / "retro-panel" / "images" / name)
        found = find_targets(picture, polarity="auto", codes="ring14", min_diameter_px=6)
        marks = np.array(points)
        at, distance = nearest(found.xy, marks[:, 1:])
        assert distance.max() < 0.3
        assert found.code[at].tolist() == marks[:, 0].astype(int).tolist()
        difference.append(found.xy[at] - marks[:, 1:])
        others += [int(c) for c in np.delete(found.code, at) if c >= 0]
    assert sorted(others) == [20, 21, 63]  # on the panel, seen in the photographs, absent from the reference
    d = np.concatenate(difference)
    assert np.sqrt((d**2).mean(axis=0)).max() < 0.025


@pytest.mark.parametrize(("sigmas", "reason"), [(2.0, 0), (4.0, Flag.BLURRED)])
def test_an_edge_is_too_soft_where_it_certainly_is(sigmas: float, reason: int) -> None:
    y, x = np.mgrid[:60, :80]
    disc = np.clip(12.5 - np.hypot(x - 40.3, y - 29.8), 0, 1)
    picture = cv2.GaussianBlur(200 - 160 * disc, (0, 0), 1.0).astype(np.uint8)
    fit = fit_ellipse_model(
        picture,
        np.array([[40.3, 29.8]]),
        np.array([[1 / 12, 0, 1 / 12]]),
        np.array([-1]),
        noise=1.0,
        saturation=255,
    )
    sigma = np.sqrt(fit.full_covariance[:, BLUR, BLUR])
    minor = axes_from_shape(fit.shape)[0][:, 1]
    soft = replace(fit, blur=SOFTEST_EDGE * minor + sigmas * sigma)
    judged = judge_fits(soft, noise=1.0, scale=255.0, min_diameter_px=4.0, max_diameter_px=80.0)
    assert judged.tolist() == [reason]
