"""A principal distance that was adjusted far from its start value is told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.pipeline import run_survey
from sfm.remarks.remark import of_kind
from sfm.report.findings.survey_remarks import findings_of
from sfm.survey.adjusting.solution_remarks import far_principal_distances
from tests.surveys import survey_of
from tests.synthetic import make_network, seed_of


@pytest.mark.parametrize("model", ["brown", "opencv"])
def test_c_far_from_its_start_value_is_reported(model: str) -> None:
    _, truth = make_network(seed_of("far c"), images=3, points=12, model=model)
    name = replace(truth.cameras[0], name="synthetic")
    estimate = replace(truth, cameras=(name,))
    network, brown = make_network(seed_of("far c"), images=3, points=12)
    survey = survey_of(network, brown)  # says c_mm = 10
    assert far_principal_distances(survey, estimate, [0.01]) == ()
    p = name.parameters.copy()
    p[: 1 if name.in_mm else 2] *= 0.22
    for factor, told in ((0.85, False), (1.15, False), (0.75, True), (1.35, True)):
        near = name.with_parameters(np.where(name.parts[0], factor * name.parameters, name.parameters))
        remarks = far_principal_distances(survey, replace(estimate, cameras=(near,)), [0.01])
        assert len(remarks) == told
    far = replace(estimate, cameras=(name.with_parameters(p),))
    c = abs(far.cameras[0].parameters[0])
    for share, severity in ((4.9e-4, "note"), (5.1e-4, "warning"), (np.nan, "warning")):
        (one,) = far_principal_distances(survey, far, [share * c])
        assert one.severity == severity
    assert one.kind == "c_far_from_given" and one.names("camera") == ("synthetic",)
    assert [one.number(name) for name in ("given", "found", "change")] == pytest.approx([10, 2.2, -78])
    held = replace(estimate, cameras=(replace(far.cameras[0], free=name.free & False),))
    (one,) = far_principal_distances(survey, held, [0.01])
    assert one.kind == "c_held_elsewhere" and one.severity == "error"
    assert [one.number(name) for name in ("given", "found")] == pytest.approx([10, 2.2])


def test_a_wrong_start_value_of_c_is_a_note_where_the_network_determines_c() -> None:
    network, truth = make_network(seed_of("wrongly given"), images=8, points=40)
    camera = truth.cameras[0]
    p = camera.parameters.copy()
    p[0] *= 1.4
    free = ("c", "x0", "y0", "K1", "K2", "P1", "P2")
    wrong = replace(truth, cameras=(camera.with_parameters(p),))
    result = run_survey(survey_of(network, wrong, free=free, start=truth))
    assert result.estimate.cameras[0].value("c") == pytest.approx(10.0, rel=1e-2)
    (far,) = of_kind(result.remarks, "c_far_from_given")
    assert far.number("given") == pytest.approx(14) and far.number("change") < -20
    assert far.severity == "note" and findings_of(result).verdict.level == "good"
