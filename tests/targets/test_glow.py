"""Retro-reflective targets: saturation is censored, halo and flare are flagged; none moves the centre."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from sfm.model.conventions import AnyArray, FloatArray
from sfm.report.figures.overlays import REASON_COLOURS, REMARK_COLOURS
from sfm.targets.detect import Targets, find_targets
from sfm.targets.outlines import Flag

SUPER, SIZE, NOISE = 5, 120, 2.0
CENTRE = np.array([60.3, 58.6])
RADIUS = 8.0


def fine_disc(radius: float, centre: FloatArray = CENTRE) -> AnyArray:
    """Return a disc on the fine raster, 0 to 1."""
    y, x = (np.mgrid[: SIZE * SUPER, : SIZE * SUPER] + 0.5) / SUPER - 0.5
    return np.clip(0.5 + SUPER * (radius - np.hypot(x - centre[0], y - centre[1])), 0, 1).astype(np.float32)


def photographed(light: AnyArray, seed: int, *, halo: float = 0.0, halo_px: float = 1.0) -> AnyArray:
    """Return the photograph of a fine raster of light (255 = end of the scale), with scattered light."""
    soft = cv2.GaussianBlur(light, (0, 0), 0.7 * SUPER)
    if halo:
        soft = (1 - halo) * soft + halo * cv2.GaussianBlur(light, (0, 0), halo_px * SUPER)
    picture = cv2.resize(soft, (SIZE, SIZE), interpolation=cv2.INTER_AREA)
    noise = NOISE * np.random.default_rng(seed).standard_normal(picture.shape)
    return np.rint(picture + noise).clip(0, 255).astype(np.uint8)


def measured(picture: AnyArray) -> Targets:
    """Return the one bright target of a photograph."""
    found = find_targets(picture, polarity="bright")
    assert len(found) == 1
    return found


def normalised_error(found: Targets) -> float:
    error = found.xy[0] - CENTRE
    return float(error @ np.linalg.inv(found.covariance[0]) @ error / 2)


@pytest.mark.parametrize(
    ("level", "halo", "halo_px"),
    [(110, 0.0, 1.0), (400, 0.0, 1.0), (1000, 0.0, 1.0), (110, 0.5, 5.0), (250, 0.5, 5.0), (1000, 0.15, 5.0)],
)
def test_saturation_and_halo_are_flagged_and_do_not_move_the_centre(
    level: float, halo: float, halo_px: float
) -> None:
    squares, halos = [], 0
    for seed in range(8):
        found = measured(photographed(20 + level * fine_disc(RADIUS), seed, halo=halo, halo_px=halo_px))
        flag = int(found.flag[0])
        assert bool(flag & Flag.SATURATED) == (level * (1 - halo) > 235)
        halos += bool(flag & Flag.HALO)
        assert not flag & Flag.FLARE
        squares.append(normalised_error(found))
    assert (
        halos == 0 if halo == 0 else halos >= 6
    )  # of 8; a halo is seen in the noise of a few hundred pixels
    # the residuals of a halo are not noise, but alike all round; saturated pixels carry no weight
    assert np.mean(squares) < 1 + 4 / np.sqrt(len(squares))


def test_glare_around_the_rim_is_flare() -> None:
    # white surface, black rim, and a target that is grey beside it: bright seen from its rim
    light = 250 - 210 * fine_disc(RADIUS + 2) + 110 * fine_disc(RADIUS)
    found = measured(photographed(light, 1))
    assert found.flag[0] & Flag.FLARE
    assert np.abs(found.xy[0] - CENTRE).max() < 0.05


def test_glare_on_one_side_is_flare() -> None:
    y, x = (np.mgrid[: SIZE * SUPER, : SIZE * SUPER] + 0.5) / SUPER - 0.5
    glare = 180 * np.exp(-((x - 88) ** 2 + (y - 60) ** 2) / (2 * 14**2))
    light = (25 + glare + 110 * fine_disc(RADIUS)).astype(np.float32)
    found = find_targets(photographed(light, 2), polarity="bright")
    near = np.linalg.norm(found.xy - CENTRE, axis=1) < 1
    assert near.sum() == 1
    assert found.flag[near][0] & Flag.FLARE


def test_every_flag_has_its_own_colour_in_the_overlays() -> None:
    remarks = (Flag.DAMAGED, Flag.CONCENTRIC)
    rejections = [flag for flag in Flag if flag.value >= 1 << 8 and flag not in remarks]
    colours = (*REASON_COLOURS, *REMARK_COLOURS)
    assert [flag for flag, _ in REASON_COLOURS] == rejections
    assert len({colour for _, colour in colours}) == len(colours)
