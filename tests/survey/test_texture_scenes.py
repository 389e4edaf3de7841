"""Weak and wrong scenes of natural texture: none is wrong and believed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from tests.survey.texture_scenes import KINDS, NUMBERS, SHARE, WRONG, outcome_of, study, water, write_scene
from tests.synthetic import seed_of


@pytest.mark.slow
def test_moving_water_is_left_out_of_a_shore(tmp_path: Path) -> None:
    rng = seed_of("water 0")
    scene = water(rng)
    write_scene(tmp_path, scene, rng)
    found = outcome_of(tmp_path, scene)
    assert found.oriented == len(scene.position) and found.level in ("good", "fair")
    assert found.over_sigma < WRONG and found.share < SHARE
    assert replace(found, over_sigma=2 * WRONG, share=2 * SHARE).is_wrong_and_believed


@pytest.mark.slow
def test_no_scene_is_wrong_and_believed() -> None:
    assert not [one for one in study(0, NUMBERS, list(KINDS)) if one[2].is_wrong_and_believed]
