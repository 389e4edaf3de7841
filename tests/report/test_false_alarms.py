"""Results that are true are not doubted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.network import ScaleBars
from sfm.remarks.remark import Remark, of_kind
from sfm.report.findings.bundle_statistics import Given
from sfm.report.findings.checks import longest_residual
from sfm.report.findings.survey_remarks import Findings, findings_of, given_remarks
from sfm.result import SurveyResult
from tests.synthetic import make_network, seed_of


def findings(reject: str, *, error_px: float = 0.0, bar: bool = False) -> Findings:
    network, truth = make_network(seed_of("false alarms"), images=8, points=40)
    xy = network.image_points.xy.copy()
    xy[5, 0] += error_px
    network = replace(network, image_points=replace(network.image_points, xy=xy))
    if bar:
        length = np.linalg.norm(truth.points[[0, 1]] - truth.points[[2, 3]], axis=1)
        bars = ScaleBars(np.array([0, 1]), np.array([2, 3]), length, np.full(2, 1e-3))
        network = replace(network, scale_bars=bars)
    a = adjust(network, truth, datum=Datum("free"), reject=reject)
    return findings_of(SurveyResult("alarms", "m", 8, (), a, np.full(40, -1), None, reject=reject))


def test_huber_with_a_gross_error_whose_influence_it_bounds_is_good() -> None:
    found = findings("huber", error_px=30.0)
    longest = longest_residual(found.result.adjustment)
    assert 0 < longest.weight < 0.1 or longest.over_sigma < 10
    assert not of_kind(found.verdict.remarks, "residual_kept")
    kept = findings("none", error_px=30.0)
    assert of_kind(kept.verdict.remarks, "residual_kept")


def test_a_bar_that_nothing_checks_is_no_contradiction() -> None:
    found = findings("tau", bar=True)
    bars = found.given.bars
    assert bars is not None

    def remarks(r: float) -> tuple[Remark, ...]:
        given = Given((replace(bars, w=np.full(bars.w.shape, 5.7), r=np.full(bars.r.shape, r)),))
        return of_kind(given_remarks(found.result, given, found.statistics, ()), "given_differs")

    assert remarks(0.8e-3) == ()
    assert len(remarks(1.2e-3)) == len(remarks(0.3)) == 1
