"""A converted network is a survey: its control and standard deviations stay, and it can be adjusted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from adapters.formats.photomodeler import write_photomodeler
from adapters.formats.registry import read_any, write_any
from sfm.pipeline import run_survey
from sfm.survey.inputs.survey import read_survey
from tests.synthetic import make_network, seed_of


def test_control_of_photomodeler_is_kept_and_the_survey_runs(tmp_path: Path) -> None:
    network, truth = make_network(seed_of("kept control"), images=6, points=20, free=("c",))
    camera = replace(truth.cameras[0], parameters=truth.cameras[0].parameters * 1.0)
    names = camera.names
    camera.parameters[[names.index("b1"), names.index("b2")]] = 0.0
    truth = replace(truth, cameras=(camera,))
    sigma = np.array([1e-3, 1e-3, 2e-3])
    network = network.with_control(["1", "2", "3", "4"], truth.points[:4], sigma)
    write_photomodeler(tmp_path / "project.txt", network, truth)
    write_any(tmp_path / "tables", "tables", *read_any(tmp_path / "project.txt", "photomodeler"))
    survey = read_survey(tmp_path / "tables" / "survey.toml")
    assert survey.control is not None and survey.datum.kind == "control"
    np.testing.assert_allclose(survey.control.sigma, np.tile(sigma, (4, 1)), rtol=1e-6)
    np.testing.assert_allclose(survey.control.xyz, truth.points[:4], atol=1e-9)
    a = run_survey(survey).adjustment
    assert a.converged and len(a.network.control) == 4 and len(a.network.points) == 20
