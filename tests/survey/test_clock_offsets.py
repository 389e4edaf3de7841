"""Clocks of a rig that fit at two offsets: the photographs show which one is right."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timedelta
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image

from sfm.model.conventions import AnyArray, rotation_from_vector
from sfm.model.remarks.remark import of_kind, remark
from sfm.pipeline import run_survey
from sfm.products.rendering.render import render_photographs
from sfm.products.rendering.scene import Optics
from sfm.report.survey_report import text_report
from sfm.survey.clock_offsets import rotation_spread
from sfm.survey.inputs.survey import read_survey
from sfm.survey.orientation import orient_survey
from sfm.survey.rigs import with_moments
from sfm.survey.sources.given import measure_given
from tests.findings import findings_of
from tests.rigs import make_rig
from tests.survey.test_rigs import written
from tests.surveys import SURVEY, camera, code_centres, plates, stations
from tests.synthetic import seed_of

INTERVAL_S = 10.0


@pytest.mark.parametrize("wrong", [True, False])
def test_the_offset_at_which_cameras_keep_their_mounts_is_taken(wrong: bool, tmp_path: Path) -> None:
    """One camera misses the first photograph, and its clock is one interval off."""
    network, truth = make_rig(seed_of("clocks"), moments=8)
    survey = read_survey(written(tmp_path, network, truth))
    measured = measure_given(survey)
    camera, moment = measured.network.camera, measured.network.moment
    assert moment is not None
    names = np.array(measured.network.images)
    right = dict(zip(names.tolist(), [f"{k:02d}" for k in moment], strict=True))
    late = {name: f"{k + (c == 1):02d}" for name, k, c in zip(names.tolist(), moment, camera, strict=True)}
    now, other = (late, right) if wrong else (right, late)
    rig = survey.rigs[0].model_copy(update={"moment": "moments.csv"})
    survey = replace(survey, rigs=(rig,), moments=now, other_moments=other)
    parts = {"camera": "camera 2", "reference": "camera 1", "ahead": (10.0, "s")}
    unsure = remark("clock_differs", unsure="as they are", **parts)  # type: ignore[arg-type]
    measured = replace(
        measured, network=with_moments(survey, replace(measured.network, moment=None)), remarks=(unsure,)
    )
    oriented = orient_survey(survey, measured)
    found, agreed, start = oriented.survey, oriented.measured, oriented.orientation
    assert found.moments == right
    assert [one.severity for one in agreed.remarks] == ["note" if wrong else "warning"]
    assert agreed.network.moment is not None and start.estimate.mounts is not None
    spread, count = rotation_spread(agreed.network.camera, agreed.network.moment, start.estimate)
    assert count == 8 and spread < 1e-5
    base = start.estimate.mounts.position[1] / np.linalg.norm(start.estimate.mounts.position[1])
    assert truth.mounts is not None
    true = truth.mounts.position[1] / np.linalg.norm(truth.mounts.position[1])
    assert base @ true > 0.999


@lru_cache
def rig_pictures(moments: int) -> tuple[tuple[AnyArray, ...], ...]:
    """Render the photographs of the left and the right camera of a rig, 90 mm apart."""
    position, rotation = stations(moments)
    turn = rotation_from_vector(np.array([0.02, 0.1, 0.05]))
    right = position + rotation @ np.array([90.0, 5.0, 0.0]), rotation @ turn
    optics = Optics(blur_px=0.7, exposure=0.9)
    return tuple(
        tuple(render_photographs(plates(), camera(), *poses, optics=optics, seed=1)[0])
        for poses in ((position, rotation), right)
    )


@pytest.mark.sweep(1)
@pytest.mark.parametrize("late", [True, False])
def test_clocks_one_interval_off_in_exif_data_are_tried_at_both_offsets(late: bool, tmp_path: Path) -> None:
    """The right camera misses the first photograph: as they are, its times agree at all its moments."""
    moments = 6
    for name, pictures in zip(("left", "right"), rig_pictures(moments), strict=True):
        for k, picture in enumerate(pictures):
            if name == "right" and k == 0:
                continue
            at = k - 1 if late and name == "right" else k
            taken = datetime(2026, 5, 4, 12, 0, 0) + timedelta(seconds=INTERVAL_S * at)
            exif = Image.Exif()
            exif.get_ifd(ExifTags.IFD.Exif).update(
                {ExifTags.Base.DateTimeOriginal.value: taken.strftime("%Y:%m:%d %H:%M:%S")}
            )
            grey = np.clip(np.rint(picture), 0, 255).astype(np.uint8)
            number = k if name == "left" else 97 + k
            Image.fromarray(grey).save(tmp_path / f"{name}_{number}.jpg", quality=95, exif=exif)
    text = SURVEY.format(name="clocks", backend="none")
    one = text[text.index("[[camera]]") : text.index("[targets]")]
    cameras = [one.replace("small", side).replace("*.png", f"{side}*.jpg") for side in ("left", "right")]
    rig = '[[rig]]\nname = "rig"\ncameras = ["left", "right"]\nmoment = "exif"\n'
    path = tmp_path / "survey.toml"
    path.write_text(text.replace(one, "".join(cameras) + rig), encoding="utf-8")
    result = run_survey(read_survey(path))
    a = result.adjustment
    assert a.converged and a.sigma0 * a.sigma_px < 0.1 and len(a.network.images) == 2 * moments - 1
    (said,) = of_kind(result.remarks, "clock_differs")
    assert said.severity == ("note" if late else "warning")
    assert said.number("ahead") == pytest.approx(-INTERVAL_S if late else INTERVAL_S)
    words = text_report(findings_of(result))
    assert "nan" not in words.split() and "inf" not in words.split() and "e+1" not in words
    (mounted,) = findings_of(result).rigs[0].mounts
    true, found = np.array([code_centres()[one] for one in result.code.tolist()]), a.estimate.points
    size = np.std(found, axis=0), np.std(true, axis=0)
    scale = np.linalg.norm(size[0]) / np.linalg.norm(size[1])
    assert mounted.base / scale == pytest.approx(np.hypot(90.0, 5.0), rel=0.01)
