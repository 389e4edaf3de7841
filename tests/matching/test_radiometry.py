"""Radiometry and resampling against definitions and cv2."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from sfm.errors import GeometryError, PhotographError
from sfm.kernels.sampling import resample
from sfm.matching.radiometry import (
    equalise_histogram,
    fit_radiometry,
    grey_of,
    histogram,
    match_brightness,
    patch_around,
    radiometry_of,
)
from tests.textures import random_texture

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


def test_patches() -> None:
    assert (patch_around(PHOTOGRAPH, (10, 20), 5) == PHOTOGRAPH[18:23, 8:13]).all()
    with pytest.raises(GeometryError, match="reaches beyond the photograph of 50 x 40 px"):
        patch_around(PHOTOGRAPH, (1, 20), 5)
    with pytest.raises(GeometryError, match="odd number"):
        patch_around(PHOTOGRAPH, (10, 20), 4)


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
