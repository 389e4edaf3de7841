"""Image points far better than stated, or without noise at all, beside control of ordinary precision."""

from __future__ import annotations

import numpy as np
import pytest

from sfm.pipeline import run_survey
from sfm.report.findings.survey_remarks import findings_of
from sfm.survey.inputs.given import KnownPoints
from tests.surveys import survey_of
from tests.synthetic import make_network, seed_of

SIGMA = 1e-3  # m, of control
FREE = ("c", "x0", "y0", "K1")


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
