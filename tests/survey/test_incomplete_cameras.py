"""What is missing of the cameras is said at once, before photographs are measured; odd pixels are told."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

import sfm
from sfm.camera import camera_from_values
from sfm.errors import SurveyFileError
from sfm.survey.adjusting.solution_remarks import unlike_squares
from sfm.survey.inputs.survey import CameraSetup


def test_all_that_is_missing_of_all_cameras_is_said_before_anything_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a1", "a2", "b1", "b2"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.full((40, 60), 200, dtype=np.uint8))
    monkeypatch.setattr("sfm.pipeline.measure_targets", lambda *a, **k: pytest.fail("measured"))
    cameras = [
        CameraSetup(name="a", images="a*.png"),
        CameraSetup(name="b", images="b*.png", sensor_mm=(36, 24)),
    ]
    survey = sfm.Survey(name="s", cameras=cameras, folder=tmp_path)
    with pytest.raises(
        SurveyFileError,
        match=r"what is needed of camera a: pixel_mm or sensor_mm and c_mm; camera b: c_mm$",
    ):
        sfm.run_survey(survey, compare_with="none")


@pytest.mark.parametrize(
    ("settings", "pixel", "free", "told"),
    [
        ({"sensor_mm": (23.7, 15.6)}, (23.7 / 6000, 15.6 / 4000), ("c",), True),
        ({"sensor_mm": (23.7, 15.6)}, (23.7 / 6000, 15.6 / 4000), ("c", "b1"), False),
        ({"sensor_mm": (23.5, 15.6)}, (23.5 / 6000, 15.6 / 4000), ("c",), False),
        ({}, (0.0040, 0.0041), ("c",), True),
        ({"pixel_mm": (0.0040, 0.0041)}, (0.0040, 0.0041), ("c",), False),  # stated: as on a line scanner
    ],
)
def test_nominal_sensor_sizes_that_make_odd_pixels_are_reported(
    settings: dict[str, tuple[float, float]], pixel: tuple[float, float], free: tuple[str, ...], told: bool
) -> None:
    camera = CameraSetup(name="a", images="*.png", free=free, **settings)
    remarks = unlike_squares([camera], [camera_from_values("a", "brown", (60, 40), pixel, c_mm=50.0)])
    assert [one.kind for one in remarks] == (["pixels_not_square"] if told else [])
