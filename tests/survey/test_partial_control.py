"""Control of which single coordinates are not known, and correlated control and image coordinates."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapters.formats.result_tables import read_result
from adapters.formats.result_tables import write_tables as write_stored
from sfm.errors import SurveyFileError
from sfm.pipeline import run_survey
from sfm.report.findings.survey_remarks import findings_of
from sfm.report.tables.csv_files import write_tables
from sfm.report.tables.summary import write_summary
from sfm.survey.inputs.given import KnownPoints, read_control, read_image_points
from sfm.survey.inputs.start import measurements_from_observations
from tests.surveys import remarks_on_given, survey_of
from tests.synthetic import make_network, seed_of


def _control(path: Path, text: str) -> KnownPoints:
    path.write_text(text, encoding="utf-8")
    return read_control(path)


@pytest.mark.parametrize("kind", ["control", "free"])
def test_control_with_unknown_coordinates_is_used_for_those_that_are_known(kind: str, tmp_path: Path) -> None:
    """Three full points, heights of four others, one of which is 50 m from where its mean would be."""
    network, truth = make_network(seed_of("heights"), images=8, points=30)
    rng = seed_of("heights noise")
    X = truth.points + np.array([0.0, 0.0, 50.0]) + 1e-4 * rng.standard_normal(truth.points.shape)
    rows = [f"{j + 1},{','.join(map(str, X[j]))},1e-4,1e-4,1e-4" for j in range(3)]
    rows += [f"{j + 1},,,{X[j, 2]},,,1e-4" for j in range(3, 7)]
    control = _control(tmp_path / "control.csv", "id,X,Y,Z,sX,sY,sZ\n" + "\n".join(rows) + "\n")
    assert np.isnan(control.xyz[3, :2]).all() and np.isinf(control.sigma[3, :2]).all()
    result = run_survey(survey_of(network, truth, control=control, datum={"kind": kind}))
    a = result.adjustment
    index = [network.point_index(name) for name in result.network.points]
    away = np.linalg.norm(a.estimate.points - truth.points[index] - (0.0, 0.0, 50.0), axis=1)
    assert a.converged and away.max() < 0.003
    found = findings_of(result)
    assert found.verdict.level == "good", found.verdict.remarks
    if kind == "control":
        assert found.counts.control == 3 * 3 + 4
        given = found.given.control
        assert given is not None and np.isnan(given.r[3, :2]).all() and np.isfinite(given.r[3, 2])
    else:
        assert result.control_check is not None and result.control_check.points == ("1", "2", "3")


def test_a_wrong_height_is_found(tmp_path: Path) -> None:
    network, truth = make_network(seed_of("heights"), images=8, points=30)
    rows = [f"{j + 1},{','.join(map(str, truth.points[j]))},1e-4,1e-4,1e-4" for j in range(4)]
    rows.append(f"5,,,{truth.points[4, 2] + 0.01},,,1e-4")
    control = _control(tmp_path / "control.csv", "id,X,Y,Z,sX,sY,sZ\n" + "\n".join(rows) + "\n")
    survey = survey_of(network, truth, control=control, datum={"kind": "control"}, adjust={"reject": "none"})
    result = run_survey(survey)
    said = next(one for one in remarks_on_given(result) if one.kind == "given_left_out")
    assert said.names("given") == ("5",) and said.number("distance") == pytest.approx(0.01, rel=0.1)
    assert findings_of(result).verdict.level == "fair"


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("1,,,,,,", "at least one coordinate"),
        ("1,1.0,2.0,3.0,,0.1,0.1", "column sX contains nan, needed a number where the coordinate is given"),
    ],
)
def test_control_without_sense_is_refused(row: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(SurveyFileError, match=message):
        _control(tmp_path / "control.csv", f"id,X,Y,Z,sX,sY,sZ\n{row}\n2,5.0,6.0,7.0,0.1,0.1,0.1\n")


def test_covariances_of_control_are_weights(tmp_path: Path) -> None:
    control = _control(
        tmp_path / "control.csv",
        "id,X,Y,Z,sX,sY,sZ,cXY,cXZ,cYZ\n1,0,0,0,0.1,0.2,0.1,0.01,,\n2,1,1,1,0.1,0.1,0.1,,,\n",
    )
    np.testing.assert_allclose(control.covariance[0, 0], [0.01, 0.01, 0.0])
    with pytest.raises(SurveyFileError, match=r"column cXY contains 0\.03, needed a correlation below 1"):
        _control(
            tmp_path / "control.csv",
            "id,X,Y,Z,sX,sY,sZ,cXY,cXZ,cYZ\n1,0,0,0,0.1,0.2,0.1,0.03,,\n2,1,1,1,0.1,0.1,0.1,,,\n",
        )


@pytest.mark.parametrize(("unit", "expected"), [("px", 0.005), ("mm", -0.005)])
def test_covariances_of_image_coordinates_are_weights(unit: str, expected: float, tmp_path: Path) -> None:
    network, truth = make_network(seed_of("correlated"), images=6, points=20)
    survey = survey_of(network, truth)
    given = survey.observations
    assert given is not None
    size = 0.005 if unit == "mm" else 1.0
    path = tmp_path / "image_points.csv"
    header = f"image,point,x_{unit},y_{unit},sx_{unit},sy_{unit},cxy_{unit}2\n"
    centre = np.array([999.5, 749.5]) if unit == "mm" else np.zeros(2)
    up = -1 if unit == "mm" else 1
    places = (given.xy - centre) * size * (1, up)
    own = f"{0.1 * size},{0.1 * size},{0.005 * size**2}"
    rows = [f"{i},{p},{x},{y},{own}" for i, p, (x, y) in zip(given.image, given.point, places, strict=True)]
    path.write_text(header + "\n".join(rows) + "\n", encoding="utf-8")
    measured = measurements_from_observations(replace(survey, observations=read_image_points(path)))
    np.testing.assert_allclose(measured.network.image_points.covariance[:, 0, 1], expected)
    path.write_text(header + rows[0].rsplit(",", 1)[0] + ",1\n", encoding="utf-8")
    with pytest.raises(SurveyFileError, match="a correlation below 1"):
        read_image_points(path)


def test_covariances_of_image_points_come_back_from_the_tables(tmp_path: Path) -> None:
    network, truth = make_network(seed_of("correlated"), images=6, points=20)
    C = np.array([[0.01, 0.004], [0.004, 0.02]])
    survey = survey_of(network, truth, sigma=True)
    given = survey.observations
    assert given is not None
    n = len(given.xy)
    given = replace(given, sigma=np.tile(np.sqrt(np.diagonal(C)), (n, 1)), covariance=np.full(n, C[0, 1]))
    result = run_survey(replace(survey, observations=given))
    write_tables(findings_of(result), tmp_path)
    again = read_image_points(tmp_path / "image_points.csv")
    assert again.covariance is not None
    np.testing.assert_allclose(again.covariance, C[0, 1], rtol=1e-14)
    a, b = (run_survey(replace(survey, observations=one)).adjustment for one in (given, again))
    np.testing.assert_allclose(b.estimate.points, a.estimate.points, atol=1e-9)
    write_summary(findings_of(result), tmp_path)
    stored = read_result(tmp_path)
    np.testing.assert_allclose(stored.network.image_points.covariance, np.tile(C, (n, 1, 1)), rtol=1e-12)
    write_stored(tmp_path / "stored", stored)
    twice = read_result(tmp_path / "stored").network.image_points.covariance
    np.testing.assert_allclose(twice, stored.network.image_points.covariance, rtol=1e-12)


def test_heights_check_points_of_which_place_is_control(tmp_path: Path) -> None:
    """X and Y of five points hold the network with four full points, their Z only check it."""
    network, truth = make_network(seed_of("heights check"), images=8, points=30)
    rng = seed_of("heights check noise")
    X = truth.points[:9] + 1e-4 * rng.standard_normal((9, 3))
    header = "id,X,Y,Z,sX,sY,sZ,checkX,checkY,checkZ\n"
    for wrong in (0.0, 0.01):
        X[6, 2] += wrong
        rows = [f"{j + 1},{','.join(map(str, X[j]))},1e-4,1e-4,1e-4,,,{int(j >= 4)}" for j in range(9)]
        control = _control(tmp_path / "control.csv", header + "\n".join(rows) + "\n")
        result = run_survey(survey_of(network, truth, control=control, datum={"kind": "control"}))
        found = findings_of(result)
        assert found.counts.control == 4 * 3 + 5 * 2
        rows_of_check = [row for row in found.protocol.control if row.use == "check"]
        assert [(row.point, row.coordinate) for row in rows_of_check] == [(str(j), "Z") for j in range(5, 10)]
        tests = np.array([row.test for row in rows_of_check])
        assert (np.abs(np.delete(tests, 2)) < 4).all()
        said = [one for one in found.verdict.remarks if one.kind == "check_differs"]
        assert bool(said) == bool(wrong) and found.verdict.level == ("fair" if wrong else "good")
        if wrong:
            assert (said[0].names("coordinate"), said[0].names("point")) == (("Z",), ("7",))
            assert said[0].number("sigmas") == pytest.approx(abs(tests[2])) and abs(tests[2]) > 30


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("1,0,0,,1,1,,,,1", "checkZ contains 1"),
        ("1,0,0,0,1,1,1,2,,", "column checkX contains 2, needed 0,"),
    ],
)
def test_checks_without_sense_are_refused(row: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(SurveyFileError, match=message):
        _control(
            tmp_path / "control.csv",
            f"id,X,Y,Z,sX,sY,sZ,checkX,checkY,checkZ\n{row}\n2,5,6,7,1,1,1,,,\n",
        )
