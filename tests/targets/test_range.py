"""The range of targets that is found: 3 to 1100 px, tilts to 75 degrees, touching, any channel of colour."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.model.conventions import AnyArray
from sfm.survey.inputs.settings import TargetSettings
from sfm.survey.measuring.targets import measure_photograph
from sfm.targets.detect import find_targets
from sfm.targets.outlines import Flag
from tests.targets.shapes import polygon_coverage
from tests.targets.test_bound import coverage

PITCH = 260
# Largest diameter in px and tilt in degrees; the least minor axis of all is 3 px.
CASES = [
    (3, 0),
    (3.5, 30),
    (6.1, 60),
    (12, 75),
    (30, 75),
    (60, 70),
    (100, 75),
    (150, 45),
    (200, 0),
    (200, 75),
]


def mixed_photograph(sixteen_bit: bool, seed: int) -> tuple[AnyArray, list[tuple[float, float, int]]]:
    """Return dark and bright targets on grey under vignetting and shading, and their places and signs."""
    rng = np.random.default_rng(seed)
    width, height = 5 * PITCH, 4 * PITCH
    image = np.full((height, width), 120.0, np.float32)
    truth = []
    for k in range(20):
        diameter, tilt = CASES[k % 10]
        sign = 1 if k < 10 else -1
        x, y = PITCH * (k % 5 + 0.5) + rng.uniform(-3, 3), PITCH * (k // 5 + 0.5) + rng.uniform(-3, 3)
        left, top = int(x) - PITCH // 2 + 4, int(y) - PITCH // 2 + 4
        a = diameter / 2
        b = a * np.cos(np.radians(tilt))
        size = PITCH - 8
        shape = coverage(x - left, y - top, a, b, rng.uniform(-1.5, 1.5), 0.7, size)
        image[top : top + size, left : left + size] += sign * 80 * shape
        truth.append((x, y, sign))
    j, i = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
    image *= 1 - 0.25 * (i * i + j * j) / 2 + 0.1 * j
    image += 1.5 * rng.standard_normal(image.shape, dtype=np.float32)
    if sixteen_bit:
        return np.rint(image * 257).clip(0, 65535).astype(np.uint16), truth
    return np.rint(image).clip(0, 255).astype(np.uint8), truth


@pytest.mark.sweep(0)
@pytest.mark.parametrize("sixteen_bit", [False, True])
def test_all_sizes_and_tilts_of_both_polarities_in_one_photograph(sixteen_bit: bool) -> None:
    image, truth = mixed_photograph(sixteen_bit, 3)
    found = find_targets(image, polarity="auto", min_diameter_px=2.5)
    assert len(found) == len(truth)
    for x, y, sign in truth:
        error = found.xy - (x, y)
        k = int(np.argmin(np.hypot(*error.T)))
        sigma = np.sqrt(np.diag(found.covariance[k]))
        # a quarter of a hundredth of a pixel is what area sampling and rounding leave
        assert (np.abs(error[k]) < 5 * sigma + 0.01).all()
        assert found.polarity[k] == sign
    for sign, polarity in ((1, "bright"), (-1, "dark")):
        one = find_targets(image, polarity=polarity, min_diameter_px=2.5)
        assert (one.polarity == sign).all()
        assert len(one) == len(truth) // 2


def test_a_target_may_be_as_large_as_the_photograph() -> None:
    """Dots of 400 to 1100 px across, each alone: found, and as far from the truth as their sigma allows."""
    rng, normalised = np.random.default_rng(5), []
    height, width = 1200, 1300
    phi = np.linspace(0, 2 * np.pi, 4000, endpoint=False)
    for a in (200, 300, 450, 560):
        centre = np.array([width / 2, height / 2]) + rng.uniform(-15, 15, 2)
        b, turn = a * rng.uniform(0.8, 1), 0.4
        axes = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) * (a, b)
        outline = centre + 0.5 + np.stack([np.cos(phi), np.sin(phi)], axis=1) @ axes.T
        sharp = (200 - 155 * polygon_coverage(outline, height, width)).astype(np.float32)
        image = cv2.GaussianBlur(sharp, (0, 0), 0.9)
        image += 2 * rng.standard_normal(image.shape, dtype=np.float32)
        targets = find_targets(np.rint(image).clip(0, 255).astype(np.uint8))
        (k,) = np.flatnonzero(np.hypot(*(targets.xy - centre).T) < 1)
        assert targets.semi_axes[k] == pytest.approx((a, b), abs=0.1)
        root = np.linalg.cholesky(targets.covariance[k])
        normalised.append(np.linalg.solve(root, targets.xy[k] - centre))
    assert np.sqrt(np.mean(np.square(normalised))) < 1.7  # of 8 values; the 0.999 quantile is 1.8


def test_touching_and_cut_targets_are_not_measured_as_one() -> None:
    image = np.full((200, 300), 200.0, np.float32)
    for x, y in ((60.0, 60.0), (79.0, 63.0), (150.0, 60.0), (172.0, 60.0), (250.0, 60.0), (100.0, 197.0)):
        left, top = int(x) - 25, int(y) - 25
        patch = coverage(x - left, y - top, 10, 10, 0.0, 0.7, 51)
        rows, columns = slice(max(top, 0), min(top + 51, 200)), slice(left, left + 51)
        image[rows, columns] -= 150 * patch[: rows.stop - rows.start]
    image += 2 * np.random.default_rng(1).standard_normal(image.shape)
    found = find_targets(np.rint(image).clip(0, 255).astype(np.uint8), polarity="dark")
    near = np.array([(150.0, 60.0), (172.0, 60.0), (250.0, 60.0)])
    distance = np.hypot(*(found.xy[:, None] - near[None]).transpose(2, 0, 1))
    assert len(found) == 3
    assert distance.min(axis=1).max() < 0.05
    close = found.flag[distance.argmin(axis=0)[:2]]
    assert (close & Flag.CLOSE_NEIGHBOUR != 0).all()
    reasons = {Flag.NOT_ELLIPTIC | Flag.UNEVEN_EDGE: (70, 61), Flag.CUT_BY_BORDER: (100, 194)}
    for reason, place in reasons.items():
        away = np.hypot(*(found.rejected_xy - place).T)
        assert (found.rejected_flag[away < 6] & reason).any()


def test_the_channel_of_the_survey_is_measured(tmp_path: Path) -> None:
    clean = np.full((100, 100), 200.0, np.float32) - 150 * np.pad(
        coverage(25, 25, 8, 8, 0.0, 0.7, 51), ((20, 29), (20, 29))
    )
    other = np.full_like(clean, 200)
    noise = np.random.default_rng(1).standard_normal((100, 100, 3))
    colour = np.stack([other, other, clean], axis=-1) + 2 * noise  # blue, green, red
    path = tmp_path / "c.png"
    cv2.imwrite(str(path), np.rint(colour).clip(0, 255).astype(np.uint8))
    for channel, count in (("red", 1), ("blue", 0), ("green", 0)):
        targets, _ = measure_photograph(path, TargetSettings(channel=channel, polarity="dark"), None)
        assert len(targets) == count
    assert np.abs(measure_photograph(path, TargetSettings(channel="red"), None)[0].xy[0] - 45).max() < 0.05
