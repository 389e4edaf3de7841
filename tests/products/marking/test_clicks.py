"""A click beside a feature measures it, or says that it cannot."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest

from sfm.model.conventions import AnyArray, FloatArray
from sfm.model.distributions import chi2_isf
from sfm.model.errors import GeometryError
from sfm.products.marking.clicks import Template, measure_click
from sfm.survey.inputs.marks_file import Kind
from sfm.targets.codes.plates import code_family
from tests.products.marking.photographs import SIDE, click_beside, pattern_of, rendered

LIMITS_PX = {"target": 0.05, "saddle": 0.05, "corner": 0.1, "cross": 0.1}
FLAGGED_PX = 1.0


@cache
def clicked(kind: Kind, count: int) -> list[tuple[AnyArray, FloatArray, FloatArray]]:
    """Return photographs of a feature, its place in each and a click beside it, px."""
    rng = np.random.default_rng(count)
    clicks = []
    for _ in range(count):
        centre = (SIDE - 1) / 2 + rng.uniform(-0.5, 0.5, 2)
        photograph = rendered(pattern_of(kind, centre, rng), rng)
        clicks.append((photograph, centre, click_beside(centre, rng)))
    return clicks


def errors_of(kind: Kind, count: int, *, asked: Kind | None) -> tuple[list[float], list[float], int]:
    """Return errors (px) of clicks, their squares over the covariance, and how many clicks failed."""
    errors: list[float] = []
    squares: list[float] = []
    refused = 0
    for photograph, centre, click in clicked(kind, count):
        try:
            measured = measure_click(photograph, *click, asked)
        except GeometryError:
            refused += 1
            continue
        if measured.kind != kind:
            refused += 1
            continue
        off = np.array([measured.x, measured.y]) - centre
        errors += off.tolist()
        squares.append(float(off @ np.linalg.solve(measured.covariance, off)))
    return errors, squares, refused


@pytest.mark.parametrize("asked", [True, False])
@pytest.mark.parametrize("kind", LIMITS_PX)
def test_a_click_5_px_off_measures_the_feature(kind: Kind, asked: bool) -> None:
    errors, squares, refused = errors_of(kind, 40, asked=kind if asked else None)
    assert refused <= 2
    assert np.sqrt(np.mean(np.square(errors))) < LIMITS_PX[kind]
    assert np.max(np.abs(errors)) < FLAGGED_PX
    assert 0.3 < np.median(squares) / chi2_isf(0.5, 2) < 3.0


@pytest.mark.slow
@pytest.mark.parametrize("kind", LIMITS_PX)
def test_500_clicks_5_px_off(kind: Kind) -> None:
    errors, _, refused = errors_of(kind, 500, asked=kind)
    assert refused <= 25
    assert np.sqrt(np.mean(np.square(errors))) < LIMITS_PX[kind]
    assert np.max(np.abs(errors)) < FLAGGED_PX


def texture(rng: np.random.Generator, side: int) -> AnyArray:
    layers = [
        cv2.GaussianBlur(rng.normal(size=(side, side)).astype(np.float32), (0, 0), s) for s in (1.5, 4, 10)
    ]
    total = sum(layer / layer.std() for layer in layers)
    return np.asarray(120 + 30 * total / np.std(total))


def errors_of_windows(count: int) -> tuple[list[float], int]:
    """Return errors of clicks beside windows in a turned photograph, px, and how many failed."""
    rng = np.random.default_rng(count)
    errors: list[float] = []
    refused = 0
    for _ in range(count):
        ground = texture(rng, 400)
        turn, scale = np.radians(rng.uniform(-20, 20)), rng.uniform(0.85, 1.15)
        c, s = scale * np.cos(turn), scale * np.sin(turn)
        A = np.array([[c, -s], [s, c]]) @ np.array([[1, rng.uniform(-0.15, 0.15)], [0, 1]])
        shift = 100 + rng.uniform(-3, 3, 2)
        warp = np.column_stack([A, shift - A @ [200, 200]])
        other = np.asarray(cv2.warpAffine(ground, warp, (200, 200), flags=cv2.INTER_LANCZOS4))
        left, right = (
            np.clip(np.rint(one + rng.normal(0, 2, one.shape)), 0, 255).astype(np.uint8)
            for one in (ground[100:300, 100:300], other)
        )
        place = 100 + rng.uniform(-15, 15, 2)
        truth = A @ (place - 100) + shift
        try:
            found = measure_click(right, *click_beside(truth, rng), template=Template(left, *place))
        except GeometryError:
            refused += 1
            continue
        errors += (np.array([found.x, found.y]) - truth).tolist()
    return errors, refused


def test_a_click_5_px_off_finds_the_window_of_a_point() -> None:
    errors, refused = errors_of_windows(30)
    assert refused <= 2
    assert np.sqrt(np.mean(np.square(errors))) < 0.15
    assert np.max(np.abs(errors)) < FLAGGED_PX


@pytest.mark.slow
def test_500_clicks_5_px_off_find_the_windows_of_points() -> None:
    errors, refused = errors_of_windows(500)
    assert refused <= 25
    assert np.sqrt(np.mean(np.square(errors))) < 0.15
    assert np.max(np.abs(errors)) < FLAGGED_PX


def test_a_natural_place_that_is_not_distinct_is_taken_as_it_is_and_says_so() -> None:
    ground = texture(np.random.default_rng(3), 200)
    photograph = np.clip(np.rint(ground), 0, 255).astype(np.uint8)
    measured = measure_click(photograph, 100.25, 90.5, "window")
    assert (measured.x, measured.y) == pytest.approx((100.25, 90.5))
    assert "the place itself" in measured.note


@pytest.mark.parametrize("kind", ["target", "ring", "saddle", "cross", "corner", "window", None])
def test_nothing_is_measured_where_nothing_is(kind: Kind | None) -> None:
    rng = np.random.default_rng(0)
    photograph = np.clip(np.rint(100 + rng.normal(0, 2, (200, 200))), 0, 255).astype(np.uint8)
    with pytest.raises(GeometryError, match="can be measured within"):
        measure_click(photograph, 100.0, 100.0, kind)


def test_a_dot_is_no_ring_without_its_code() -> None:
    rng = np.random.default_rng(5)
    photograph = rendered(pattern_of("target", np.array([60.0, 60.0]), rng), rng)
    with pytest.raises(GeometryError, match="no ring"):
        measure_click(photograph, 62.0, 60.0, "ring", family=code_family("ring14"))


def test_a_click_outside_is_refused() -> None:
    with pytest.raises(GeometryError, match="outside the photograph of 20 x 10 px"):
        measure_click(np.zeros((10, 20), dtype=np.uint8), 20.0, 5.0)


@pytest.mark.parametrize("kind", LIMITS_PX)
def test_the_border_of_a_photograph_is_no_fault(kind: Kind) -> None:
    rng = np.random.default_rng(7)
    photograph = rendered(pattern_of(kind, np.array([60.0, 60.0]), rng), rng)[50:, 50:]
    try:
        measured = measure_click(np.ascontiguousarray(photograph), 12.0, 11.0, kind)
    except GeometryError:
        return
    assert np.hypot(measured.x - 10, measured.y - 10) < FLAGGED_PX
