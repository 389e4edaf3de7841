"""Moments of rigs by the times in EXIF data, whose clocks differ."""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image

from sfm.errors import SurveyFileError
from sfm.survey.inputs.from_exif import moments_from_exif
from sfm.survey.inputs.measurements import find_photographs
from sfm.survey.inputs.settings import RigSettings
from sfm.survey.inputs.survey import CameraSetup, Survey
from tests.synthetic import seed_of

START = datetime(2026, 5, 4, 12, 0, 0)


def photographed(folder: Path, camera: str, seconds: list[float | None]) -> None:
    """Write a photograph for each time; None states none."""
    for k, one in enumerate(seconds):
        exif, at = Image.Exif(), START + timedelta(seconds=one or 0.0)
        if one is not None:
            exif.get_ifd(ExifTags.IFD.Exif).update(
                {
                    ExifTags.Base.DateTimeOriginal.value: at.strftime("%Y:%m:%d %H:%M:%S"),
                    ExifTags.Base.SubsecTimeOriginal.value: f"{at.microsecond:06d}",
                }
            )
        Image.new("L", (8, 8)).save(folder / f"{camera}{k}.jpg", exif=exif)


def survey_of(folder: Path, tolerance_s: float) -> Survey:
    cameras = [CameraSetup(name=one, images=f"{one}*.jpg", c_mm=8.0) for one in ("left", "right")]
    rig = RigSettings(name="stereo", cameras=("left", "right"), moment="exif", tolerance_s=tolerance_s)
    return Survey(name="times", cameras=cameras, rigs=(rig,), folder=folder)  # type: ignore[arg-type]


@pytest.mark.parametrize("ahead", [0.0, 0.3, -7261.5])
def test_photographs_at_one_time_are_of_one_moment(ahead: float, tmp_path: Path) -> None:
    """Nine moments at irregular times, of which one camera misses one; triggers differ by some 10 ms."""
    rng = seed_of("times")
    times = np.cumsum(rng.uniform(3.0, 20.0, 9))
    photographed(tmp_path, "left", times.tolist())
    late = np.delete(times, 4) + ahead + 0.01 * rng.standard_normal(8)
    photographed(tmp_path, "right", late.tolist())
    survey = survey_of(tmp_path, 0.5)
    found, remarks = moments_from_exif(survey, find_photographs(survey))
    moment = found.moments
    of_right = [moment[f"right{k}.jpg"] for k in range(8)]
    assert of_right == [moment[f"left{k}.jpg"] for k in range(9) if k != 4]
    assert len(set(of_right)) == 8
    if abs(ahead) < 0.5:
        assert not remarks
    else:
        assert remarks[0].kind == "clock_differs"
        assert remarks[0].number("ahead") == pytest.approx(ahead, abs=0.05)


def test_a_photograph_without_time_is_refused(tmp_path: Path) -> None:
    photographed(tmp_path, "left", [0.0, 10.0])
    photographed(tmp_path, "right", [0.0, None])
    survey = survey_of(tmp_path, 0.5)
    with pytest.raises(SurveyFileError, match=r"photograph 'right1\.jpg' states no time"):
        moments_from_exif(survey, find_photographs(survey))


def test_regular_intervals_with_clocks_that_differ_are_refused(tmp_path: Path) -> None:
    """One photograph at the end is missing: two differences of the clocks fit as well."""
    times = 10.0 * np.arange(9)
    photographed(tmp_path, "left", times.tolist())
    photographed(tmp_path, "right", (times[:8] + 3600.0).tolist())
    survey = survey_of(tmp_path, 0.5)
    with pytest.raises(SurveyFileError, match="by 3590 s or 3600 s, and as many photographs agree"):
        moments_from_exif(survey, find_photographs(survey))
