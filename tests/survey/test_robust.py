"""How a survey file treats gross errors: by Pope's test, Huber's or Tukey's estimator, or not at all."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sfm.pipeline import run_survey
from sfm.remarks.remark import of_kind
from sfm.report.findings.survey_remarks import findings_of
from sfm.survey.inputs.survey import read_survey
from tests.surveys import write_observed_survey

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
