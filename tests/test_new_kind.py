"""A new kind of observation is one file and one row, from which everything else takes it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.quality.variance_components import by_kind
from sfm.model.conventions import FloatArray
from sfm.model.estimate import values_of
from sfm.model.observations.point_pairs import PointPairs
from sfm.model.observations.tables import TABLES
from sfm.pipeline import run_survey
from sfm.report.output import write_result
from sfm.report.survey_report import text_report
from sfm.survey.inputs.survey import read_survey
from sfm.survey.observation_tables import read_observation_table
from tests.findings import findings_of
from tests.survey.test_rigs import written
from tests.synthetic import make_network, seed_of


class Slopes(PointPairs):  # the file
    """Slopes between object points: dZ over the distance."""

    name: ClassVar[str] = "slopes"
    single: ClassVar[str] = "slope"
    components: ClassVar[tuple[str, ...]] = ("slope",)

    @classmethod
    def computed(cls, d: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return dZ / |d|, and its derivatives."""
        length = np.linalg.norm(d, axis=1, keepdims=True)
        slope = d[:, 2:] / length
        return slope, ((np.array([0.0, 0.0, 1.0]) - slope * d / length) / length)[:, None]


def test_a_new_kind_is_one_file_and_one_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(TABLES, "slope", Slopes)  # the row
    rng = seed_of("new kind")
    network, truth = make_network(rng, images=6, points=20, free=())
    pairs = np.array([rng.choice(20, 2, replace=False) for _ in range(10)])
    planned = Slopes(pairs[:, 0], pairs[:, 1], np.zeros((10, 1)), np.full((10, 1), 1e-4))
    noisy = planned.simulated(values_of(truth), rng).value[:, 0]
    noisy[4] += 2e-3
    cells = [f"{i + 1},{j + 1},{float(v)!r},1e-4" for (i, j), v in zip(pairs.tolist(), noisy, strict=True)]
    (tmp_path / "slopes.csv").write_text("\n".join(["from,to,slope,sslope", *cells]), "utf-8")
    survey = read_survey(written(tmp_path, network, truth, ""))
    table = read_observation_table("slope", tmp_path / "slopes.csv", "survey.toml")
    result = run_survey(replace(survey, tables=(table,), datum=Datum("free")))
    a = result.adjustment
    assert by_kind(a).names == ("image points", "slopes") and a.expected_defect == 5
    found = findings_of(result)
    (slopes,) = found.given.further
    assert len(slopes.values) == 9 and slopes.worst is not None and abs(slopes.worst.w) < 4
    (wrong,) = [one for one in found.verdict.remarks if one.kind == "observations_wrong"]
    assert wrong.names("observations") == ("slope {} - {}".format(*(pairs[4] + 1)),)
    assert "slope" in text_report(found)
    write_result(found, tmp_path / "out")
    stored = json.loads((tmp_path / "out" / "summary.json").read_text("utf-8"))["further_observations"]
    assert len(stored["slope"]) == 9
    assert "Observations: slope" in (tmp_path / "out" / "report.html").read_text("utf-8")
