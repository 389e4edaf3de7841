"""Plates that are photographed from the front only: nothing determines c, and no calibration is reported."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sfm.network import Estimate
from sfm.remarks.remark import kinds_of
from sfm.report.findings.survey_remarks import findings_of
from sfm.survey.adjusting.solution_remarks import not_calibrated
from tests.plates import camera
from tests.survey.seen_plates import FREE, Plates, about, plates_survey, run_plates
from tests.synthetic import seed_of


@pytest.mark.parametrize(("count", "more"), [(2, ("calibrated_from_few",)), (3, ())])
def test_no_camera_is_calibrated_from_the_front(tmp_path: Path, count: int, more: tuple[str, ...]) -> None:
    """Before, c was held 1 mm wrong and the survey worked."""
    rng, plates = seed_of("from the front"), Plates.side_by_side(1)
    result = run_plates(
        plates_survey(tmp_path, 1, free="", c_mm=8.88), plates, about(plates, rng, count, 0.0, 250.0), rng
    )
    findings = findings_of(result)
    found, *others = (one for one in findings.verdict.remarks if one.severity != "note")
    assert kinds_of(others) == more
    assert (found.kind, found.severity, findings.calibrated) == ("calibration_failed", "error", ())
    assert found.number("held") == result.adjustment.estimate.cameras[0].parameters[0]


def test_projection_uncertainty_is_not_that_of_a_guess(tmp_path: Path) -> None:
    rng, plates = seed_of("a guess"), Plates.side_by_side(2)
    survey = plates_survey(tmp_path, 2, free=FREE.replace('"c", ', ""), c_mm=8.137)
    result = run_plates(survey, plates, about(plates, rng, 4), rng)
    estimate = result.adjustment.estimate
    assert len(findings_of(result).calibrated) == 1 and not_calibrated(survey, estimate) == ()
    asked = plates_survey(tmp_path, 2)
    told = not_calibrated(asked, estimate)
    assert kinds_of(told) == ("calibration_failed",)
    assert findings_of(replace(result, remarks=(*result.remarks, *told))).calibrated == ()
    free = replace(
        estimate, cameras=tuple(replace(one, free=np.ones_like(one.free)) for one in estimate.cameras)
    )
    assert not_calibrated(asked, free) == ()


def test_a_camera_is_known_by_its_whole_name(tmp_path: Path) -> None:
    """Before, of "cam" and "cam 2" both were reported where the second was held."""
    survey = plates_survey(tmp_path, 1)
    first = replace(camera(), name="cam", free=np.ones(10, dtype=bool))
    second = replace(first, name="cam 2 a.png", free=np.zeros(10, dtype=bool))
    both = tuple(survey.cameras[0].model_copy(update={"name": name}) for name in ("cam", "cam 2"))
    survey = replace(survey, cameras=both)
    nothing = np.zeros((0, 3))
    estimate = Estimate((first, second), nothing, np.zeros((0, 3, 3)), nothing)
    (found,) = not_calibrated(survey, estimate)
    assert found.names("camera") == ("cam 2",)
