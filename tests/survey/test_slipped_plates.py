"""A plate that slipped against the other one, by so much that photographs no longer fit, is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sfm.remarks.remark import of_kind
from sfm.report.findings.survey_remarks import findings_of
from tests.survey.seen_plates import Plates, about, plates_survey, run_plates
from tests.synthetic import seed_of


@pytest.mark.parametrize(
    ("slip_mm", "kind"),
    [(3.0, "plate_moved"), (60.0, "plate_elsewhere")],
)
def test_a_plate_that_slipped_far_is_named(tmp_path: Path, slip_mm: float, kind: str) -> None:
    """Before, photographs were mirrored pictures by 3 mm, and 48 codes each at several places by 20 mm."""
    rng, plates = seed_of(f"slipped {slip_mm}"), Plates.side_by_side(2)
    slip = np.array([slip_mm, 0.2 * slip_mm, 0.0])
    survey, poses = plates_survey(tmp_path, 2), about(plates, rng, 8)
    result = run_plates(survey, plates, poses, rng, slipped=(6, 7), slip=slip)
    told = findings_of(result).verdict.remarks
    (found,) = of_kind(told, kind)
    assert {int(name) for name in found.names("points")} == set(range(80, 128))
    others = {"photograph_mirrored", "code_at_several_places", "code_rays_apart", "points_moved"}
    assert not others & {one.kind for one in told} | others & {one.reason.kind for one in result.failed}
    if kind == "plate_elsewhere":
        assert found.names("photographs") == ("6.png", "7.png")
