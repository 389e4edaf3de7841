"""Two adjusters agree on a camera with fx and fy of its own: whether the survey's fits as well is told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.comparison.two_adjusters.adjusters import AdjusterComparison, compare_adjusters
from sfm.remarks.remark import of_kind
from sfm.report.findings.survey_remarks import findings_of
from sfm.result import SurveyResult
from tests.other_adjuster import in_house_adjuster
from tests.synthetic import make_network, seed_of


def compared(stretch: float, free: tuple[str, ...]) -> tuple[AdjusterComparison, SurveyResult]:
    """Adjust and compare photographs whose pixels are wider than the survey says, by a factor."""
    network, truth = make_network(seed_of("better"), images=10, points=50, model="brown_forward", free=free)
    camera = truth.cameras[0]
    start = replace(truth, cameras=(replace(camera, pixel_mm=camera.pixel_mm * np.array([stretch, 1.0])),))
    a = adjust(network, start, datum=Datum("free"), reject="none")
    both = compare_adjusters(a, in_house_adjuster, name="other", model="opencv")
    codes = np.full(len(network.points), -1)
    return both, SurveyResult("s", "m", len(network.images), (), a, codes, both)


USUAL = ("c", "x0", "y0", "K1", "K2", "P1", "P2")


def test_a_camera_that_fits_many_times_better_is_no_agreement() -> None:
    both, result = compared(1.007, USUAL)
    assert both.agree and both.better is not None
    assert both.better.free == ("b1",)
    assert both.better.rms_px == pytest.approx(0.1, rel=0.1) and both.better.times > 5
    (found,) = of_kind(findings_of(result).verdict.remarks, "adjuster_fits_better")
    assert found.names("parameters") == ("b1",) and found.severity == "warning"
    assert found.number("times") == both.better.times


@pytest.mark.parametrize(("stretch", "free"), [(1.0, USUAL), (1.007, (*USUAL, "b1"))])
def test_a_camera_that_fits_as_well_is_not_reported(stretch: float, free: tuple[str, ...]) -> None:
    both, result = compared(stretch, free)
    assert both.agree and both.better is None
    assert not of_kind(findings_of(result).verdict.remarks, "adjuster_fits_better")
