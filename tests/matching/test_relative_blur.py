"""Photographs of which one is blurred more: by how much, and whether they are matched all the same."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest

from sfm.conventions import FloatArray
from sfm.matching.conjugate import difference_of_blur, match_points
from tests.textures import natural_texture, with_noise

SIZE = (420, 380)
NOISE = 2.0
A, SHIFT = np.array([[1.03, -0.05], [0.04, 0.98]]), np.array([6.4, -9.7])
MIDDLE = np.array(SIZE) / 2


@cache
def _pair(blur_left: float, blur_right: float) -> tuple[FloatArray, FloatArray]:
    scene = natural_texture(np.random.default_rng(3), SIZE)
    back = np.linalg.inv(A)
    M = np.column_stack([back, MIDDLE - back @ (MIDDLE + SHIFT)])
    warped = cv2.warpAffine(
        scene, M, SIZE, flags=cv2.INTER_LANCZOS4 | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REFLECT
    )
    both = (
        cv2.GaussianBlur(one, (0, 0), blur) if blur else one
        for one, blur in ((scene, blur_left), (warped, blur_right))
    )
    left, right = (with_noise(one, NOISE, k) for k, one in enumerate(both))
    return left, right


def _points() -> FloatArray:
    y, x = np.mgrid[100:281:30, 100:321:30].astype(float)
    return np.column_stack([x.ravel(), y.ravel()]) + 0.3


@pytest.mark.parametrize("sigma", [1.0, 1.5, 3.0, 5.0])
def test_difference_of_blur_is_that_put_in(sigma: float) -> None:
    assert difference_of_blur(*_pair(0.0, sigma)) == pytest.approx(sigma**2, rel=0.15)
    assert difference_of_blur(*_pair(sigma, 0.0)) == pytest.approx(-(sigma**2), rel=0.15)


def test_photographs_alike_have_no_difference_of_blur() -> None:
    assert abs(difference_of_blur(*_pair(0.0, 0.0))) < 0.1
    noise = [with_noise(np.full(SIZE, 128.0), NOISE, k) for k in (5, 6)]
    assert difference_of_blur(*noise) == 0.0
    assert difference_of_blur(np.zeros((9, 9), np.uint8), np.zeros((9, 9), np.uint8)) == 0.0


@pytest.mark.parametrize(("blur_left", "blur_right"), [(0.0, 3.0), (3.0, 0.0), (0.0, 1.5)])
def test_one_photograph_out_of_focus_is_matched(blur_left: float, blur_right: float) -> None:
    points = _points()
    truth = (points - MIDDLE) @ A.T + MIDDLE + SHIFT
    found = match_points(*_pair(blur_left, blur_right), points, search_px=81)
    e = (found.right - truth)[found.good]
    assert found.good.mean() > 0.6
    assert np.abs(e).max() < 1.5 and np.sqrt((e**2).mean()) < 0.3
    assert np.sqrt((e**2 / found.sigma[found.good] ** 2).mean()) == pytest.approx(1.0, abs=0.5)
    k = int(np.flatnonzero(found.good)[0])
    mapped = found.warp[k] @ [0.0, 0.0, 1.0]
    assert mapped[:2] / mapped[2] == pytest.approx(found.right[k], abs=1e-9)
    assert found.warp[k, :2, :2] == pytest.approx(A, abs=0.3)
