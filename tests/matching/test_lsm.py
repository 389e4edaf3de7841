"""Least squares matching against the Cramer-Rao bound, speckle photographs, and failures."""

from __future__ import annotations

from functools import cache
from typing import Any

import cv2
import numpy as np
import pytest

from sfm.matching.conjugate import match_points
from sfm.matching.conjugate_patches import MatchSettings
from sfm.matching.correlation import LsmFlag, match_ncc
from sfm.matching.lsm.two_photo import LsmMatches, LsmSettings, match_lsm
from sfm.model.conventions import AnyArray, FloatArray
from sfm.model.errors import GeometryError, PhotographError
from tests.places import SHARED
from tests.textures import MEAN, Pairs, affine_pairs, with_noise

SIGMA = 2.0
PATCHES = 250
SPECKLE = SHARED / "data" / "speckle-shift"


@cache
def _pairs() -> tuple[Pairs, FloatArray, FloatArray]:
    pairs = affine_pairs(11, PATCHES)
    return pairs, with_noise(pairs.left, SIGMA, 1), with_noise(pairs.right, SIGMA, 2)


def _ratio_to_bound(matches: LsmMatches, pairs: Pairs) -> float:
    """RMS error over the bound, pooled by the bound of each patch."""
    e = matches.xy - pairs.centre - pairs.shift
    normalised = np.einsum("ki,kij,kj->k", e, np.linalg.inv(pairs.bound * SIGMA**2), e)
    return float(np.sqrt(normalised.mean() / 2))


# 2 x 250 normal errors leave the ratio uncertain by 1 / sqrt(4 x 250) = 3.2 %
UNCERTAIN = 1 / np.sqrt(4 * PATCHES)


def test_errors_reach_the_cramer_rao_bound() -> None:
    pairs, left, right = _pairs()
    matches = match_lsm(left, right, pairs.centre, pairs.centre)
    assert matches.good.all()
    ratio = _ratio_to_bound(matches, pairs)
    assert 1 - 3 * UNCERTAIN < ratio < 1.05
    assert matches.gain == pytest.approx(pairs.gain, abs=0.05)


@pytest.mark.parametrize(("kernel", "least", "most"), [("bilinear", 1.15, 1.45), ("bicubic", 1.03, 1.25)])
def test_cheaper_kernels_cost_what_is_said(kernel: str, least: float, most: float) -> None:
    pairs, left, right = _pairs()
    assert (
        least
        < _ratio_to_bound(
            match_lsm(left, right, pairs.centre, pairs.centre, settings=LsmSettings(interpolation=kernel)),
            pairs,
        )
        < most
    )


def test_predicted_covariance_is_true() -> None:
    pairs, left, right = _pairs()
    matches = match_lsm(left, right, pairs.centre, pairs.centre)
    e = matches.xy - pairs.centre - pairs.shift
    predicted = np.sqrt(np.trace(matches.covariance, axis1=1, axis2=2).mean() / 2)
    assert predicted == pytest.approx(np.sqrt((e**2).mean()), rel=0.1)
    normalised = np.einsum("ki,kij,kj->k", e, np.linalg.inv(matches.covariance), e)
    assert normalised.mean() / 2 == pytest.approx(1, abs=0.2)
    assert matches.sigma0.mean() == pytest.approx(SIGMA * np.sqrt(1 + (pairs.gain**2).mean()), rel=0.1)


def test_a_difference_of_blur_moves_no_window() -> None:
    """A photograph that is blurred along one direction, as an oblique surface is; window of tie points."""
    pairs, left, _ = _pairs()
    blurred = cv2.GaussianBlur(pairs.right, (0, 0), 0.4, sigmaY=0.05)  # 0.16 px^2 along x

    def errors(left: AnyArray, right: AnyArray, *, blur: bool) -> tuple[FloatArray, LsmMatches]:
        matches = match_lsm(
            left, right, pairs.centre, pairs.centre, settings=LsmSettings(window_px=15, blur=blur)
        )
        return matches.xy - pairs.centre - pairs.shift, matches

    sharp, _ = errors(pairs.left, blurred, blur=False)
    own, _ = errors(pairs.left, blurred, blur=True)
    assert np.sqrt((own**2).mean()) < 0.3 * np.sqrt((sharp**2).mean()) < 0.003
    e, matches = errors(left, with_noise(blurred, SIGMA, 2), blur=True)
    normalised = np.einsum("ki,kij,kj->k", e, np.linalg.inv(matches.covariance), e)
    assert normalised.mean() / 2 == pytest.approx(1, abs=0.2)
    assert matches.sigma0.mean() == pytest.approx(SIGMA * np.sqrt(1 + (pairs.gain**2).mean()), rel=0.1)


def test_pictures_without_noise_are_matched() -> None:
    """A picture and its copy: no residual is left, and the covariance is 0 and nothing less."""
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 255, (200, 260)).astype(np.uint8)
    picture = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 1.5), None, 0, 255, cv2.NORM_MINMAX)
    at = np.array([[x, y] for x in range(50, 210, 20) for y in range(50, 160, 20)], dtype=float)
    same = match_lsm(picture, picture, at, at, settings=LsmSettings(window_px=15, blur=True))
    part = match_lsm(
        picture, picture, at, at, LsmSettings("shift", window_px=15, blur=True, linear=True)
    ).linear
    assert part is not None and np.isfinite(part.score).all() and (part.variance >= 0).all()
    assert same.good.all() and np.isfinite(same.sigma0).all()
    assert (np.diagonal(same.covariance, axis1=1, axis2=2) >= 0).all()
    for levels in (picture, (picture // 64 * 64).astype(np.uint8)):
        found = match_points(levels, levels, at, settings=MatchSettings(method="lsm", search_px=41))
        assert found.good.mean() > 0.9
        np.testing.assert_allclose(found.right[found.good], at[found.good], atol=1e-3)


@pytest.mark.parametrize("model", ["affine", "projective"])
def test_converges_from_two_pixels_away(model: str) -> None:
    pairs, left, right = _pairs()
    angle = np.random.default_rng(5).uniform(0, 2 * np.pi, PATCHES)
    start = pairs.centre + pairs.shift + 2 * np.column_stack([np.cos(angle), np.sin(angle)])
    matches = match_lsm(left, right, pairs.centre, start, settings=LsmSettings(model=model))
    right_place = np.linalg.norm(matches.xy - pairs.centre - pairs.shift, axis=1) < 0.1
    assert right_place.mean() >= 0.995
    assert not (matches.good & ~right_place).any()


def test_the_direction_of_the_start_is_forgotten() -> None:
    """Steps that end early leave neighbours an error in common, which an adjustment takes for a rotation."""
    pairs, left, right = _pairs()
    there = pairs.centre + pairs.shift
    one, other = (match_lsm(left, right, pairs.centre, there + side) for side in (0.3, -0.3))
    assert np.abs((one.xy - other.xy).mean(axis=0)).max() < 1e-4


def test_noise_and_blur_do_not_slow_down_the_steps_of_a_shift() -> None:
    """The derivatives of the template have its noise: with them alone, steps shrink by a constant ratio."""
    pairs = affine_pairs(3, 100, distortion=0.0)
    left, right = with_noise(pairs.left, 12.0, 1), with_noise(pairs.right, 12.0, 2)
    start = pairs.centre + pairs.shift + 0.4
    ends = [
        match_lsm(left, right, pairs.centre, start, LsmSettings("shift", 15, blur=True, stop_px=stop_px))
        for stop_px in (0.0002, 1e-8)
    ]
    good = ends[0].good & ends[1].good
    assert good.mean() > 0.9 and ends[0].steps[good].mean() < 6
    assert np.abs(ends[0].xy[good] - ends[1].xy[good]).max() < 0.002


def test_converges_from_three_pixels_after_correlation() -> None:
    pairs, left, right = _pairs()
    angle = np.random.default_rng(6).uniform(0, 2 * np.pi, PATCHES)
    start = pairs.centre + pairs.shift + 3 * np.column_stack([np.cos(angle), np.sin(angle)])
    found = match_ncc(left, right, pairs.centre, start, template_px=21, search_px=31)
    matches = match_lsm(left, right, pairs.centre, found.peak)
    assert (np.linalg.norm(matches.xy - pairs.centre - pairs.shift, axis=1) < 0.1).mean() >= 0.99


def test_shift_model_on_patches_that_are_only_shifted() -> None:
    pairs = affine_pairs(3, 100, distortion=0.0)
    left, right = with_noise(pairs.left, SIGMA, 1), with_noise(pairs.right, SIGMA, 2)
    matches = match_lsm(left, right, pairs.centre, pairs.centre, settings=LsmSettings(model="shift"))
    e = matches.xy - pairs.centre - pairs.shift
    # 200 errors: the mean of their normalised squares is uncertain by sqrt(2 / 200) = 0.1
    assert (e**2 / matches.covariance[:, [0, 1], [0, 1]]).mean() == pytest.approx(1, abs=0.3)


@pytest.mark.parametrize("missing", [0.0, 0.005, 0.02])
def test_residuals_of_shifted_windows_show_the_linear_part_that_is_missing(missing: float) -> None:
    """What they show has its stated covariance, and corrects the shift, whose residuals are too large."""
    pairs, left, right = _pairs()
    linear = np.random.default_rng(3).uniform(-missing, missing, (PATCHES, 2, 2))
    start = pairs.linear @ np.linalg.inv(np.eye(2) + linear)

    def over_stated(error: FloatArray, covariance: FloatArray) -> float:
        square = np.einsum("ki,kij,kj->k", error, np.linalg.inv(covariance), error)
        return float(np.sqrt(square.mean() / error.shape[1]))

    def matched(settings: LsmSettings) -> LsmMatches:
        return match_lsm(left, right, pairs.centre, pairs.centre, settings, start=start)

    shift = matched(LsmSettings(model="shift", linear=True))
    assert matched(LsmSettings(model="shift")).xy == pytest.approx(shift.xy, abs=0)
    part = shift.linear
    assert part is not None
    back = np.linalg.inv(part.derivative)
    d = (back @ part.score[:, :, None])[:, :, 0]
    of_d = back @ (part.variance[:, None, None] * part.spread) @ back.transpose(0, 2, 1)
    moved = pairs.linear @ part.shift
    off = shift.xy - pairs.centre - pairs.shift
    corrected = off + np.einsum("kab,kb->ka", moved, d)
    whole = shift.covariance + moved @ of_d @ moved.transpose(0, 2, 1)
    assert over_stated(d - linear.reshape(-1, 4), of_d) == pytest.approx(1, abs=0.08)
    if missing < 0.01:
        assert over_stated(corrected, whole) == pytest.approx(1, abs=0.1)
        affine = match_lsm(left, right, pairs.centre, pairs.centre)
        variances = [np.trace(C, axis1=1, axis2=2).mean() for C in (whole, affine.covariance)]
        assert variances[0] == pytest.approx(variances[1], rel=0.1)
    else:
        assert over_stated(corrected, whole) < 0.9 and over_stated(off, shift.covariance) > 1.8
        assert (d * linear.reshape(-1, 4)).sum() / (linear**2).sum() == pytest.approx(1, abs=0.03)


def test_without_noise_the_warp_itself_is_found() -> None:
    pairs = affine_pairs(4, 30, grain_px=3.0)
    matches = match_lsm(
        pairs.left, pairs.right, pairs.centre, pairs.centre, settings=LsmSettings(stop_px=1e-6)
    )
    assert matches.xy == pytest.approx(pairs.centre + pairs.shift, abs=1e-3)
    assert matches.warp[:, :2, :2] == pytest.approx(pairs.linear, abs=1e-3)
    assert matches.gain == pytest.approx(pairs.gain, abs=1e-3)


def test_points_between_pixels_of_the_left_photograph() -> None:
    pairs = affine_pairs(4, 30, grain_px=3.0)
    offset = np.array([0.3, -0.4])
    matches = match_lsm(
        pairs.left, pairs.right, pairs.centre + offset, pairs.centre, settings=LsmSettings(stop_px=1e-6)
    )
    truth = pairs.centre + pairs.shift + np.einsum("kij,j->ki", pairs.linear, offset)
    assert matches.xy == pytest.approx(truth, abs=1e-3)


def test_failures_are_flagged() -> None:
    pairs, left, right = _pairs()
    at = pairs.centre[:1]
    flat = np.full((60, 60), 100.0) + np.random.default_rng(1).normal(0, SIGMA, (60, 60))
    edge = np.tile(np.where(np.arange(60) < 30, 50.0, 150.0), (60, 1)) + flat - 100
    middle = np.array([[30.0, 30.0]])
    noisy = match_lsm(flat, flat[::-1], middle, middle)
    assert noisy.flag[0] & (LsmFlag.FLAT_TEXTURE | LsmFlag.DIVERGED | LsmFlag.TOO_FAR)
    assert match_lsm(edge, edge[::-1], middle, middle).flag[0] == LsmFlag.FLAT_TEXTURE  # free along the edge
    assert match_lsm(np.full((60, 60), 7, np.uint8), flat, middle, middle).flag[0] == LsmFlag.FLAT_TEXTURE
    assert match_lsm(left, right, np.array([[3.0, 30.0]]), at).flag[0] == LsmFlag.OUTSIDE
    assert match_lsm(left, right, at, np.array([[3.0, 30.0]])).flag[0] == LsmFlag.OUTSIDE
    assert match_lsm(left, right, at + np.nan, at).flag[0] == LsmFlag.OUTSIDE
    far = match_lsm(left, right, at, at + pairs.shift[:1] + 2.0, settings=LsmSettings(max_shift_px=1.0))
    assert far.flag[0] == LsmFlag.TOO_FAR
    assert np.isnan(far.xy).all() and np.isnan(far.covariance).all()
    assert match_lsm(left, right, at, at, settings=LsmSettings(max_steps=1)).flag[0] == LsmFlag.DIVERGED
    assert not match_lsm(left, right, at, pairs.centre[1:2]).good[0]  # another texture
    assert (
        match_lsm(left, right, at, at, settings=LsmSettings(min_correlation=0.999)).flag[0]
        == LsmFlag.LOW_CORRELATION
    )


def test_kinds_of_photographs() -> None:
    pairs, left, right = _pairs()
    some = pairs.centre[:20]
    grey = match_lsm(left, right, some, some)
    colour = [np.repeat(one[..., None], 3, axis=2).clip(0, 255).astype(np.uint8) for one in (left, right)]
    deep = [(one.clip(0, 255) * 257).astype(np.uint16) for one in (left, right)]
    for other in (colour, deep):
        assert match_lsm(*other, some, some).xy == pytest.approx(grey.xy, abs=0.01)
    assert match_lsm(left, right, some, some, threads=2).xy == pytest.approx(grey.xy, abs=0)


def test_bad_input_is_refused_in_one_line() -> None:
    photograph, at = np.full((60, 60), MEAN), np.array([[30.0, 30.0]])
    with pytest.raises(GeometryError, match="window of 20 px, needed an odd number"):
        match_lsm(photograph, photograph, at, at, settings=LsmSettings(window_px=20))
    wrong: dict[str, Any] = {"window_px": "21"}
    with pytest.raises(GeometryError, match=r"LsmSettings: window_px is .*, expected a whole number"):
        LsmSettings(**wrong)
    with pytest.raises(GeometryError, match="model 'helmert', expected one of"):
        match_lsm(photograph, photograph, at, at, settings=LsmSettings(model="helmert"))
    with pytest.raises(
        GeometryError, match="score of a linear part with model 'affine', needed model 'shift'"
    ):
        match_lsm(photograph, photograph, at, at, settings=LsmSettings(linear=True))
    with pytest.raises(GeometryError, match="window of 3 px with a linear part, expected more than 11"):
        match_lsm(photograph, photograph, at, at, LsmSettings("shift", window_px=3, blur=True, linear=True))
    with pytest.raises(GeometryError, match="interpolation 'sinc', expected one of"):
        match_lsm(photograph, photograph, at, at, settings=LsmSettings(interpolation="sinc"))
    with pytest.raises(GeometryError, match="1 point in the left photograph, 2 in the right"):
        match_lsm(photograph, photograph, at, np.vstack([at, at]))
    with pytest.raises(PhotographError, match="int32 intensities"):
        match_lsm(photograph.astype(np.int32), photograph, at, at)
    with pytest.raises(PhotographError, match="not finite"):
        match_lsm(photograph * np.nan, photograph, at, at)


needs_speckle = pytest.mark.skipif(not SPECKLE.is_dir(), reason="needs ../shared/data/speckle-shift")
SETS, STEPS = ["hc_dic", "trxy_s2_00"], [1, 3, 5, 7, 10]


@needs_speckle
@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("step", STEPS)
def test_speckle_photographs_as_they_come(name: str, step: int) -> None:
    """They were shifted by bilinear interpolation; bicubic interpolation lags behind by as much as that."""
    first, other = _speckle(name, 0), _speckle(name, step)
    at = _grid(first)
    matches = match_lsm(first, other, at, at, settings=LsmSettings(interpolation="bicubic", stop_px=1e-5))
    assert matches.good.all()
    e = matches.xy - at - [-step / 10, 0]
    assert np.abs(e.mean(axis=0)).max() <= 0.005
    assert e.std(axis=0).max() <= 0.01
    ecc = np.array([_ecc(first, other, p) for p in at.astype(int)]) - at - [-step / 10, 0]
    assert np.sqrt((e**2).mean()) <= 1.1 * np.sqrt((ecc**2).mean()) + 1e-4  # whole steps: none at all


@needs_speckle
@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("step", STEPS)
def test_speckle_photographs_shifted_exactly(name: str, step: int) -> None:
    """The same photographs, every wave of them shifted by the same part of a pixel; ECC is off by 0.01 px."""
    first = _speckle(name, 0).astype(float)
    frequency = np.fft.rfftfreq(first.shape[1])
    waves = np.fft.rfft(first, axis=1) * np.exp(2j * np.pi * frequency * step / 10)
    other = np.fft.irfft(waves, n=first.shape[1], axis=1).astype(np.float32)
    at = _grid(first)
    matches = match_lsm(first, other, at, at, settings=LsmSettings(stop_px=1e-5))
    assert matches.good.all()
    e = matches.xy - at - [-step / 10, 0]
    assert np.abs(e.mean(axis=0)).max() <= 0.002
    assert e.std(axis=0).max() <= 0.001


@needs_speckle
@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("step", [1, 3, 5, 7])
def test_why_no_exact_method_finds_the_stated_shift_of_the_speckle_photographs(name: str, step: int) -> None:
    """Their spectra tell how they were shifted, and by how much on the average over their gradients.

    The average needs no interpolation at all: it is the least squares solution of the phases of all waves.
    """
    t = step / 10
    first, other = _speckle(name, 0).astype(float), _speckle(name, step).astype(float)
    height, width = first.shape
    taper = np.outer(np.hanning(height), np.hanning(width))
    A, B = (np.fft.rfft2((one - first.mean()) * taper) for one in (first, other))
    w = 2 * np.pi * np.fft.rfftfreq(width)
    transfer = (A.conj() * B).sum(axis=0) / (np.abs(A) ** 2).sum(axis=0)
    fine = (w > 0.3) & (w < 1.5)  # coarser waves feel the taper, finer ones have little power
    bilinear = (1 - t) + t * np.exp(1j * w)
    assert np.sqrt((np.abs(transfer - bilinear)[fine] ** 2).mean()) < 0.02
    w = np.where(w < 2.8, w, 0.0)  # waves of two pixels have no direction
    lag = A.conj() * B * np.exp(-1j * w * t)
    late = -float((w * lag.imag).sum() / (w**2 * lag.real).sum())  # px to the right of the stated place
    at = _grid(first)
    matches = match_lsm(first, other, at, at, settings=LsmSettings(stop_px=1e-5))
    assert (matches.xy - at)[:, 0].mean() + t == pytest.approx(late, abs=0.003)
    if name == "hc_dic" and step in (1, 3, 7):
        assert abs(late) > 0.01  # twice what is asked of matching: truth itself is off


def _speckle(name: str, step: int) -> AnyArray:
    return np.asarray(cv2.imread(str(SPECKLE / f"{name}_{step}.tiff"), cv2.IMREAD_UNCHANGED))


def _grid(photograph: AnyArray) -> FloatArray:
    """Two hundred points."""
    height, width = photograph.shape
    x, y = np.meshgrid(np.linspace(30, width - 31, 20).round(), np.linspace(30, height - 31, 10).round())
    return np.column_stack([x.ravel(), y.ravel()])


def _ecc(first: FloatArray, other: FloatArray, p: FloatArray, half: int = 10) -> FloatArray:
    template = first[p[1] - half : p[1] + half + 1, p[0] - half : p[0] + half + 1]
    warp = np.array([[1, 0, p[0] - half], [0, 1, p[1] - half]], dtype=np.float32)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-6)
    _, warp = cv2.findTransformECC(template, other, warp, cv2.MOTION_AFFINE, stop, None, 1)
    return np.asarray(warp @ [half, half, 1.0])
