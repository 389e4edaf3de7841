"""A converted network is a survey: its control, standard deviations and given values are read back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapters.formats.content import Content
from adapters.formats.control_tables import read_given
from adapters.formats.photomodeler import write_photomodeler
from adapters.formats.registry import read_any, read_content, write_any, write_content
from sfm.files.result_tables import GIVEN
from sfm.model.errors import SurveyFileError
from sfm.model.network import ImagePoints, Network
from sfm.pipeline import run_survey
from sfm.report.tables.csv_files import write_tables
from sfm.survey.inputs.given_values import KnownPoints
from sfm.survey.inputs.survey import read_survey
from tests.findings import findings_of
from tests.surveys import survey_of
from tests.synthetic import make_network, seed_of

HEADER = "kind,name,coordinate,unit,given,difference,sigma,r,w\n"
ROWS = (
    "control point,501,X,m,1.5,0.001,0.002,0.5,1\n"
    "control point,501,Z,m,2.5,0.001,0,,\n"
    "scale bar,a - b - 501,length,m,0.75,0.001,0.0001,0.5,1\n"
    "scale bar,a - gone,length,m,0.75,0.001,0.0001,0.5,1\n"
    "interior orientation,c of camera lens,value,mm,24.5,0.001,0.01,0.5,1\n"
    "projection centre,1.jpg,X0,m,3.5,0.001,0.01,0.5,1\n"
)


def network() -> Network:
    nothing = ImagePoints(*(np.zeros(0, dtype=np.int64),) * 2, np.zeros((0, 2)), np.zeros((0, 2, 2)))
    return Network(("1.jpg",), np.zeros(1, dtype=np.int64), ("501", "a - b", "a"), nothing)


@pytest.fixture(autouse=True)
def summary(tmp_path: Path) -> None:
    (tmp_path / "summary.json").write_text('{"sigma0": 0.5}', encoding="utf-8")


def test_bars_control_and_interior_orientation(tmp_path: Path) -> None:
    (tmp_path / "given.csv").write_text(HEADER + ROWS, encoding="utf-8")
    given = read_given(tmp_path, network())
    assert given.bars.start.tolist() == [1] and given.bars.end.tolist() == [0]  # the name holds a dash
    assert given.bars.length.tolist() == [0.75] and given.bars.sigma.tolist() == [0.0001]
    assert given.control.point.tolist() == [0]
    assert given.control.xyz[0, [0, 2]].tolist() == [1.5, 2.5]
    assert np.diagonal(given.control.covariance[0]).tolist() == [0.002**2, np.inf, 0.0]
    assert given.interior == (("lens", "c", 24.5, 0.01),) and given.sigma0 == 0.5


def test_a_result_without_the_table_was_given_nothing(tmp_path: Path) -> None:
    given = read_given(tmp_path, network())
    assert not len(given.bars) and not len(given.control) and given.interior == ()


def test_a_damaged_table_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "given.csv").write_text(HEADER + ROWS.replace("0.002", "-1"), encoding="utf-8")
    with pytest.raises(SurveyFileError, match=r"given.csv, line 2"):
        read_given(tmp_path, network())


def test_correlated_control_of_a_run_comes_back(tmp_path: Path) -> None:
    seen, truth = make_network(seed_of("correlated control"), images=6, points=20, free=("c",))
    covariances = np.array([[2e-7, 0.0, -1e-7], [0.0, 0.0, 0.0], [3e-7, 1e-7, 0.0], [0.0, 1e-7, 0.0]])
    known = KnownPoints(seen.points[:4], truth.points[:4], np.full((4, 3), 1e-3), covariances=covariances)
    survey = survey_of(seen, truth, control=known, datum={"kind": "control"})
    result = run_survey(survey)
    result.write(tmp_path / "run")
    for folder in (tmp_path / "run", tmp_path / "converted"):
        content = read_content(folder, "tables")
        control = content.result.network.control
        expected = result.network.control.covariance
        np.testing.assert_allclose(control.covariance, expected, rtol=1e-12, atol=0)
        if folder.name == "run":
            write_content(tmp_path / "converted", "tables", content)


def test_a_result_in_a_minimal_datum_is_read_back(tmp_path: Path) -> None:
    """The seven coordinates that it fixes have no variance, in the covariance of all points neither."""
    seen, truth = make_network(seed_of("minimal read"), images=6, points=20, free=("c",))
    result = run_survey(survey_of(seen, truth, datum={"kind": "minimal"}))
    result.write(tmp_path / "run")
    joint = read_content(tmp_path / "run", "tables").result.covariance
    assert joint is not None and int((np.diagonal(joint) == 0).sum()) == 7
    fixed = np.diagonal(joint) == 0
    assert not joint[fixed].any() and np.linalg.eigvalsh(joint[~fixed][:, ~fixed]).min() > 0


def test_a_result_and_a_converted_one_have_the_same_given_values(tmp_path: Path) -> None:
    """All that does not need the adjustment: kinds, names, coordinates, units, values and sigmas."""
    network, truth = make_network(seed_of("two writers"), images=6, points=20)
    known = KnownPoints.from_arrays(["1", "2", "3", "4"], truth.points[:4], 1e-3)
    result = run_survey(survey_of(network, truth, control=known, datum={"kind": "control"}))
    write_tables(findings_of(result), tmp_path)
    write_content(tmp_path / "converted", "tables", Content(replace(result.solution, network=result.network)))
    first, second = (GIVEN.read(folder) for folder in (tmp_path, tmp_path / "converted"))
    assert len(first.texts[0]) == 12 and first.texts == second.texts
    np.testing.assert_array_equal(first.values, second.values)


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
