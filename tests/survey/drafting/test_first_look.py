"""The first look at large photographs: texture is known at once, targets of any size are not missed."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.conventions import AnyArray
from sfm.survey.drafting import target_trial
from sfm.survey.drafting.target_trial import LOOK_PX, MIN_PIXEL_RATIO, try_targets
from sfm.targets.codes import plate_search
from sfm.targets.codes.plate_search import Part, part_of_checkerboard
from tests.synthetic import seed_of

SIDE = int(np.sqrt(MIN_PIXEL_RATIO) * LOOK_PX) + 200


def texture(seed: str) -> AnyArray:
    rng = seed_of(seed)
    noise = rng.normal(0, 1, (SIDE, SIDE)).astype(np.float32)
    return np.clip(128 + 120 * cv2.GaussianBlur(noise, (0, 0), 3.0), 0, 255).astype(np.uint8)


def with_dots(photograph: AnyArray, *, diameter: int, spacing: int) -> AnyArray:
    shown = photograph.copy()
    for x in range(spacing, SIDE - spacing // 2, spacing):
        for y in range(spacing, SIDE - spacing // 2, spacing):
            cv2.circle(shown, (x, y), diameter, 235, -1, cv2.LINE_AA)
            cv2.circle(shown, (x, y), diameter // 2, 20, -1, cv2.LINE_AA)
    return shown


def test_texture_is_not_measured_for_targets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for i, photograph in enumerate((texture("look 0"), np.full((SIDE, SIDE), 128, np.uint8))):
        cv2.imwrite(str(tmp_path / f"{i}.png"), photograph)
    monkeypatch.setattr(target_trial, "_measure", lambda *args: pytest.fail("measured"))
    searched: list[AnyArray] = []

    def part(grey: AnyArray) -> Part | None:
        searched.append(grey)
        return part_of_checkerboard(grey)

    for module in (target_trial, plate_search):
        monkeypatch.setattr(module, "part_of_checkerboard", part)
    trial = try_targets(sorted(tmp_path.iterdir()))
    assert len(searched) == 2  # each photograph once, which takes a tenth of the time
    assert trial.codes == "none" and trial.plate is None and len(trial.photographs) == 2


@pytest.mark.parametrize(("diameter", "spacing"), [(10, 60), (60, 200)])
def test_small_and_large_targets_are_seen(diameter: int, spacing: int) -> None:
    """Of 10 px, which are lost at low resolution, and of 60 px, few of which are in the middle."""
    photograph = with_dots(texture("look"), diameter=diameter, spacing=spacing)
    assert target_trial._look(photograph).shows_targets


@pytest.mark.parametrize("side", [24, pytest.param(48, marks=pytest.mark.slow), 200])
def test_tags_are_seen(side: int) -> None:
    photograph = texture("look at tags")
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_6X6_250)
    step = 2 * side
    for number, (x, y) in enumerate(
        (x, y) for x in range(step, SIDE - step, 2 * step) for y in range(step, SIDE - step, 2 * step)
    ):
        tag = cv2.aruco.generateImageMarker(dictionary, number % 250, side)
        photograph[y - side // 4 : y + side + side // 4, x - side // 4 : x + side + side // 4] = 255
        photograph[y : y + side, x : x + side] = tag
    assert target_trial._look(photograph).shows_targets
