"""Weights of the image points beside other observations: by their variance component, or all as stated."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.pipeline import run_survey
from sfm.report.findings.checks import Sigma0
from sfm.report.findings.survey_remarks import findings_of
from sfm.report.phrases import describe_sigma0, describe_weights
from sfm.report.survey_report import text_report
from sfm.survey.inputs.given import KnownPoints
from tests.surveys import survey_of
from tests.synthetic import make_network, seed_of


@pytest.mark.parametrize("weights", ["components", "stated"])
def test_stated_weights_have_one_sigma0_for_all(weights: str) -> None:
    """Image points are stated three times too cautious: as stated, that also shrinks what control says."""
    rng = seed_of("weights")
    network, truth = make_network(rng, images=8, points=30)
    control = KnownPoints.from_arrays(
        [str(k + 1) for k in range(6)], truth.points[:6] + 2e-4 * rng.standard_normal((6, 3)), 2e-4
    )
    adjust = {"sigma_px": 0.3, "reject": "none", "weights": weights}
    survey = survey_of(network, truth, control=control, datum={"kind": "control"}, adjust=adjust)
    result = run_survey(survey)
    a, said = result.adjustment, describe_weights(result)
    assert a.sigma0_px == pytest.approx(0.1, rel=0.15)
    if weights == "stated":
        assert (a.image_sigma_factor == 1).all() and "those stated for all observations" in said
        assert a.sigma0 == pytest.approx(1 / 3, rel=0.15)
    else:
        assert a.weight_factor == pytest.approx(1 / 3, rel=0.15) and "variance component" in said
        assert a.sigma0 == pytest.approx(1.0, rel=0.1)
    found = findings_of(result)
    assert found.sigma0.mm == pytest.approx(a.sigma0_px * 0.005)
    assert re.search(
        rf"sigma0 over the standard deviations of the weights +{a.sigma0:.4f}\n", text_report(found)
    )
    assert np.isfinite(a.covariance.points).all()


def test_a_few_weak_points_do_not_change_sigma0_in_px() -> None:
    """Four image points stated to 3 px among those of 0.1 px: their mean square made 0.1 px 0.4 px."""
    network, truth = make_network(seed_of("weak points"), images=8, points=30)
    plain = adjust(network, truth, datum=Datum("free"), reject="none")
    covariance = network.image_points.covariance.copy()
    covariance[[3, 50, 120, 200]] *= 900.0
    weak = replace(network, image_points=replace(network.image_points, covariance=covariance))
    a = adjust(weak, truth, datum=Datum("free"), reject="none")
    assert a.stated_px == pytest.approx(0.1)
    assert a.sigma0_px == pytest.approx(plain.sigma0_px, rel=0.02)
    figure, words = describe_sigma0(Sigma0(0.12, 1.195, 0.1))
    assert figure == "0.1200 px" and words == "1.200 times the 0.100 px expected"  # both of all observations
