"""Weights of the image points: gross errors, variance components, points far better than stated."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.judgement.checks import Sigma0
from sfm.model.remarks.remark import of_kind
from sfm.pipeline import run_survey
from sfm.report.phrases import describe_sigma0, describe_weights
from sfm.report.survey_report import text_report
from sfm.survey.inputs.given_values import KnownPoints
from sfm.survey.inputs.survey import read_survey
from tests.findings import findings_of
from tests.surveys import survey_of, write_observed_survey
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
        assert (a.image_sigma_factor == 1).all() and "as stated for all observations" in said
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


SPOILED = 12  # image points, each 8 px off, of 240


@pytest.mark.parametrize("reject", ["tau", "huber", "tukey", "none"])
def test_gross_errors_are_treated_as_the_survey_says(tmp_path: Path, reject: str) -> None:
    path = write_observed_survey(tmp_path / "survey", "robust", images=8, points=30)
    table = path.parent / "image_points.csv"
    header, *rows = table.read_text(encoding="utf-8").splitlines()
    bad = np.arange(SPOILED) * 17 + 5
    for k in bad:
        image, point, x, y = rows[k].split(",")
        rows[k] = f"{image},{point},{float(x) + 8},{y}"
    table.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    with path.open("a", encoding="utf-8") as file:
        file.write(f'[adjust]\nreject = "{reject}"\n')
    result = run_survey(read_survey(path))
    a = result.adjustment
    told = of_kind(findings_of(result).verdict.remarks, "gross_errors_kept")
    assert len(told) == (reject == "none")
    spoiled = np.isin(np.arange(len(rows)), bad)
    assert a.converged and len(a.rejected) == len(rows)
    if reject in ("tau", "tukey"):
        assert (a.rejected == spoiled).all()
        assert a.sigma0 < 1.2
    else:
        assert not a.rejected.any()
        assert a.weights[spoiled].max() < 0.1 if reject == "huber" else (a.weights == 1).all()


SIGMA = 1e-3  # m, of control
FREE = ("c", "x0", "y0", "K1")


@pytest.mark.sweep(0, 3, 5, 6, 12, 15)
@pytest.mark.parametrize("reject", ["tau", "none"])
@pytest.mark.parametrize("control", ["weighted", "rounded"])
@pytest.mark.parametrize("noise_px", [0.0, 1e-6, 3e-4, 1e-2])
def test_control_keeps_its_points_and_its_standard_deviations(
    noise_px: float, control: str, reject: str
) -> None:
    """Its points were rejected, or its standard deviation was that of the image points."""
    rng = seed_of(f"precise image points {control}")
    network, truth = make_network(rng, images=10, points=40, noise_px=noise_px)
    given = truth.points[:6]
    if control == "weighted":
        known = KnownPoints.from_arrays(
            network.points[:6], given + SIGMA * rng.standard_normal((6, 3)), SIGMA
        )
    else:
        known = KnownPoints.from_arrays(network.points[:6], np.round(given, 3), 0.0)
    survey = survey_of(
        network, truth, free=FREE, control=known, datum={"kind": "control"}, adjust={"reject": reject}
    )
    result = run_survey(survey)
    a, verdict = result.adjustment, findings_of(result).verdict
    assert verdict.level == "good", verdict
    assert a.network.points == network.points and a.defect == 0 and not a.rejected.any()
    sigma = np.sqrt(np.diagonal(a.covariance.points, axis1=1, axis2=2))
    assert 0.3 < np.sqrt((((a.estimate.points - truth.points) / sigma) ** 2).mean()) < 2
