"""Plates whose stated sizes contradict one another: a remark on plates, not on bars."""

from __future__ import annotations

from pathlib import Path

import pytest

from sfm.remarks.remark import Remark
from sfm.report.findings.survey_remarks import findings_of
from tests.survey.seen_plates import Plates, about, plates_survey, run_plates
from tests.synthetic import seed_of

TOO_LARGE = "pitch = 12.024"  # of 12; the tags are 9 mm, so that the plate is 0.16 % too large


def remark_on_sizes(folder: Path, count: int, wrong: int, lines: tuple[str, ...] = ()) -> Remark:
    """Return what is reported of plates of which one is stated too large."""
    rng, plates = seed_of(f"sizes {count} {wrong}"), Plates.side_by_side(count)
    pitch = tuple(TOO_LARGE if k == wrong else "" for k in range(count))
    survey = plates_survey(folder, count, pitch)
    result = run_plates(survey, plates, about(plates, rng, 8), rng)
    (found,) = (one for one in findings_of(result).verdict.remarks if one.severity != "note")
    return found


def test_of_two_plates_either_may_be_wrong(tmp_path: Path) -> None:
    found = remark_on_sizes(tmp_path, 2, 1)
    assert (found.kind, found.names("given")) == ("plate_sizes_contradict", ("plate 1", "plate 2"))
    assert found.number("off") == pytest.approx(0.16, abs=0.08)
    assert "pitch" in found.remedy and "plate_sigma" in found.remedy


def test_of_three_plates_the_others_identify_one(tmp_path: Path) -> None:
    """Before, both diagonals of each plate were lengths of their own, and none was identified."""
    found = remark_on_sizes(tmp_path, 3, 1)
    assert (found.kind, found.names("given")) == ("plate_size_left_out", ("plate 2",))
    assert found.number("off") == pytest.approx(0.16, abs=0.06)


def test_the_plate_that_is_control_is_not_left_out(tmp_path: Path) -> None:
    found = remark_on_sizes(tmp_path, 3, 0)
    assert (found.kind, found.names("given")) == ("plate_sizes_contradict", ("plate 1",))
    assert found.names("others") == ("plate 2", "plate 3")
