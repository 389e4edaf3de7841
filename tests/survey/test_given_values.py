"""Given values: approximate ones, control of single coordinates, correlated ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapters.formats.result_tables import read_result
from adapters.formats.result_tables import write_tables as write_stored
from datasets.camcal.reference import prepare
from sfm.judgement.checks import longest_residual
from sfm.judgement.survey_result import SurveyResult
from sfm.model.errors import SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.observations.control_and_bars import ObjectPoints, ScaleBars
from sfm.model.remarks.remark import of_kind
from sfm.model.similarity import fit_similarity
from sfm.pipeline import run_survey
from sfm.report.tables.csv_files import write_tables
from sfm.report.tables.summary import write_summary
from sfm.survey.inputs.given_values import (
    KnownPoints,
    ScaleBar,
    StartOrientations,
    read_control,
    read_exterior,
    read_image_points,
    read_points,
    read_start_cameras,
)
from sfm.survey.inputs.survey import CameraSetup, Survey, read_survey
from sfm.survey.placing import place_on_control
from sfm.survey.sources.given import measure_given
from tests.findings import findings_of
from tests.places import DATASETS, SHARED
from tests.surveys import remarks_on_given, survey_of
from tests.synthetic import SIZE_PX, make_network, seed_of

CAMCAL, RETRO = SHARED / "data" / "camcal", SHARED / "data" / "retro-panel"
FREE = ("c", "x0", "y0", "K1", "K2", "P1", "P2")
SAME = 1e-6  # standard deviations


# In number 7 three image points fitted another resection.
SIX = [pytest.param(f"six {k}", marks=() if k == 7 else pytest.mark.slow) for k in range(20)]


@pytest.mark.sweep(0, 4, 8, 11)
@pytest.mark.parametrize("reject", ["tau", "tukey", "huber"])
@pytest.mark.parametrize("name", ["six", "eight", "nine", *SIX])
def test_a_photograph_with_five_good_points_and_a_wild_one_is_kept(reject: str, name: str) -> None:
    """Before, it was lost by tau and tukey and left far off by huber."""
    network, truth = _with_a_wild_point(name)
    result = run_survey(survey_of(network, truth, start=truth, adjust={"reject": reject}))
    i = result.network.image_index("image 8")
    rows = result.network.image_points.image == i
    residual = np.linalg.norm(result.adjustment.residuals[rows], axis=1)
    print(f"{name}, {reject}: residuals {', '.join(f'{v:.2f}' for v in sorted(residual))} px")
    assert result.adjustment.converged and len(residual) == 6
    largest = 2.0 if reject == "huber" else 0.3  # px, of the other five: three standard deviations
    assert sorted(residual)[4] < largest and max(residual) > 1000
    sigma = np.sqrt(np.diagonal(result.adjustment.covariance.exterior[i])[:3])
    index = [network.point_index(point) for point in result.network.points]
    placing = fit_similarity(result.estimate.points, truth.points[index])
    error = placing.apply(result.estimate.position[i]) - truth.position[7]
    assert np.abs(error).max() < 5 * placing.scale * sigma.max()


def _with_a_wild_point(name: str) -> tuple[Network, Estimate]:
    """Eight photographs, the last with six image points of which one is 1,250 px wrong."""
    network, truth = make_network(seed_of(name), images=8, points=60, visibility=0.8)
    seen = network.image_points
    keep = np.ones(len(seen), dtype=bool)
    keep[np.flatnonzero(seen.image == 7)[6:]] = False
    seen = seen.select(keep)
    xy = seen.xy.copy()
    wild = np.flatnonzero(seen.image == 7)[2]
    xy[wild] = (xy[wild] + np.array(SIZE_PX) / 2) % SIZE_PX
    return replace(network, image_points=replace(seen, xy=xy)), truth


def test_a_photograph_with_a_wrong_given_orientation_is_oriented_anew_and_reported() -> None:
    network, truth = make_network(seed_of("wrong one"), images=8, points=40)
    rotation, position = truth.rotation.copy(), truth.position.copy()
    rotation[3], position[3] = rotation[6], position[6]
    result = run_survey(survey_of(network, truth, start=replace(truth, position=position, rotation=rotation)))
    assert len(result.network.images) == 8 and result.adjustment.converged
    assert longest_residual(result.adjustment).over_sigma < 6
    (replaced,) = of_kind(result.remarks, "approximate_unused")
    assert replaced.names("photograph") == ("image 4",) and replaced.number("image_points") == 40


def test_a_photograph_of_three_points_with_a_given_orientation_takes_part() -> None:
    network, truth = make_network(seed_of("three points"), images=8, points=40)
    seen = network.image_points
    keep = np.ones(len(seen), dtype=bool)
    keep[np.flatnonzero(seen.image == 7)[3:]] = False
    network = replace(network, image_points=seen.select(keep))
    result = run_survey(survey_of(network, truth, start=truth))
    assert "image 8" in result.network.images and result.failed == ()
    without = run_survey(survey_of(network, truth))
    assert [one.image for one in without.failed] == ["image 8"]


def _restart(survey: Survey, folder: Path, *, cameras: bool = True) -> tuple[SurveyResult, float]:
    """Return the result of a survey, and by how many sigmas it moves when started from its own tables."""
    first = run_survey(survey)
    folder.mkdir()
    write_tables(findings_of(first), folder)
    again = run_survey(
        replace(
            survey,
            start_orientations=read_exterior(folder / "images.csv"),
            start_points=read_points(folder / "points.csv"),
            start_cameras=read_start_cameras(folder / "cameras.csv") if cameras else None,
        )
    )
    assert again.network.points == first.network.points and again.adjustment.converged
    assert (again.adjustment.rejected == first.adjustment.rejected).all()
    sigma = np.sqrt(np.diagonal(first.adjustment.covariance.points, axis1=1, axis2=2))
    moved = np.abs(again.estimate.points - first.estimate.points)
    largest = float((moved[sigma > 0] / sigma[sigma > 0]).max())
    print(
        f"{survey.name}: {len(first.network.points)} points, started again they move by {largest:.1e} sigma"
    )
    return first, largest


@pytest.mark.sweep(0, 2, 5, 6)
@pytest.mark.parametrize("what", ["cameras", "no cameras", "bars", "check", "two", "control", "minimal"])
def test_a_restart_from_the_own_result_reproduces_it(what: str, tmp_path: Path) -> None:
    rng = seed_of("restart")
    network, truth = make_network(rng, images=10, points=40, visibility=0.6)
    X = truth.points

    def length(i: int, j: int) -> float:
        return float(np.linalg.norm(X[i] - X[j]) + 1e-5 * rng.standard_normal())

    def control(count: int) -> KnownPoints:
        noisy = X[:count] + 1e-5 * rng.standard_normal((count, 3))
        return KnownPoints.from_arrays([str(k + 1) for k in range(count)], noisy, 1e-5)

    given: dict[str, object] = {}
    if what == "bars":
        ends = ((0, 1), (2, 3), (4, 5))
        given = {"scale_bars": tuple(ScaleBar(str(i + 1), str(j + 1), length(i, j), 1e-5) for i, j in ends)}
    elif what in ("check", "two", "control"):
        given = {"control": control(2 if what == "two" else 5)}
    if what in ("control", "minimal"):
        given["datum"] = {"kind": what}
    survey = survey_of(network, truth, free=FREE, **given)
    _, moved = _restart(survey, tmp_path / "first", cameras=what == "cameras")
    assert moved < SAME


def test_inner_constraints_refer_to_the_given_coordinates() -> None:
    rng = seed_of("frame")
    network, truth = make_network(rng, images=10, points=40)
    given = truth.points + 0.003 * rng.standard_normal(truth.points.shape)
    start = replace(truth, points=given)
    result = run_survey(survey_of(network, truth, free=FREE, start=start))
    index = [network.point_index(point) for point in result.network.points]
    d, X = result.estimate.points - given[index], result.estimate.points
    for moment in (d.sum(axis=0), np.cross(X, d).sum(axis=0), (X * d).sum()):
        np.testing.assert_allclose(moment, 0, atol=1e-9)


@pytest.mark.skipif(not CAMCAL.exists(), reason="../shared/data/camcal is absent")
@pytest.mark.slow
@pytest.mark.parametrize("name", ["reference_free", "reference_fixed"])
def test_camcal_restarts(name: str, tmp_path: Path) -> None:
    prepare(CAMCAL, tmp_path / "camcal")
    survey = read_survey(tmp_path / "camcal" / f"{name}.toml")
    _, moved = _restart(survey, tmp_path / "first", cameras=False)
    assert moved < SAME


@pytest.mark.skipif(not RETRO.exists(), reason="../shared/data/retro-panel is absent")
def test_retro_panel_restarts(tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_text(_retro_points(), encoding="utf-8")
    text = (DATASETS / "retro-panel" / "survey.toml").read_text("utf-8")
    head, tail = text.split("[targets]")
    file = tmp_path / "survey.toml"
    file.write_text(head + '[observations]\nfile = "points.csv"\n[datum]' + tail.split("[datum]")[1], "utf-8")
    first, moved = _restart(read_survey(file), tmp_path / "first", cameras=False)
    assert moved < SAME and len(first.network.points) > 50


def _retro_points() -> str:
    """MicMac's image points in the columns of [observations]."""
    return (RETRO / "reference-image-points.csv").read_text("utf-8")


def test_start_values_of_cameras_are_read_and_refused(tmp_path: Path) -> None:
    network, truth = make_network(seed_of("start"), images=6, points=20)
    survey = survey_of(network, truth, free=("c", "K1"))
    table = tmp_path / "cameras.csv"

    def started(text: str) -> Survey:
        table.write_text(text, encoding="utf-8")
        return replace(survey, start_cameras=read_start_cameras(table))

    good = started("camera,parameter,value,sigma,unit\nsynthetic,c,10.1,,mm\nsynthetic,K1,8e-4,1e-6,mm^-2\n")
    assert run_survey(good).adjustment.converged
    with pytest.raises(SurveyFileError, match=r"line 2: camera 'other' is not in the survey"):
        run_survey(started("camera,parameter,value\nother,c,10.1\n"))
    with pytest.raises(SurveyFileError, match="is on line 2 already"):
        started("camera,parameter,value\nsynthetic,c,10.1\nsynthetic,c,10.1\n")
    settings = {"name": "a", "images": "*", "size_px": [100, 80], "pixel_mm": [0.01, 0.01]}
    with pytest.raises(SurveyFileError, match="'K1' is not in free"):
        Survey(
            name="x",
            cameras=(CameraSetup(**settings, c_mm=10.0, free=["c"], start={"K1": 1e-4}),),
            observations=survey.observations,
        )


def test_start_values_of_distortion_are_where_the_adjustment_begins() -> None:
    network, truth = make_network(seed_of("lens"), images=6, points=20)
    survey = survey_of(network, truth, free=("c", "K1", "K2"))
    camera = survey.cameras[0].model_copy(update={"start": (("K1", 8e-4), ("K2", -4e-6))})
    measured = measure_given(replace(survey, cameras=(camera,)))
    assert measured.cameras[0].value("K1") == 8e-4 and measured.cameras[0].value("K2") == -4e-6
    assert measure_given(survey).cameras[0].value("K1") == 0.0


def test_start_orientations_alone_are_enough() -> None:
    network, truth = make_network(seed_of("alone"), images=6, points=20)
    survey = survey_of(network, truth, start=replace(truth, points=np.full_like(truth.points, np.nan)))
    assert isinstance(survey.start_orientations, StartOrientations) and survey.start_points is None
    result = run_survey(survey)
    np.testing.assert_allclose(  # the frame is that of the given stations
        result.estimate.position.mean(axis=0), truth.position.mean(axis=0), atol=1e-9
    )


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


@pytest.mark.parametrize("bars", [True, False])
def test_scale_bars_keep_their_scale_where_control_places_the_network(bars: bool) -> None:
    """Control is 1 % larger than the network."""
    network, truth = make_network(seed_of("placed"), images=4, points=10)
    given = ObjectPoints(np.arange(5), 1.01 * truth.points[:5], np.zeros((5, 3, 3)))
    one = ScaleBars(np.array([0]), np.array([1]), np.array([1.0]), np.array([1e-4])) if bars else ScaleBars()
    placed, check = place_on_control(network.with_given(given, one), truth)
    assert fit_similarity(truth.points, placed.points).scale == pytest.approx(1.0 if bars else 1.01)
    assert check.scale == pytest.approx(1.01 if bars else 1.0)


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


@pytest.mark.parametrize("mistake", ["axes", "depth", None])
def test_the_mistake_in_coordinates_of_single_points_is_named(mistake: str | None) -> None:
    """Other points fit. Where X alone is a fifth too short, no mistake explains it."""
    network, truth = make_network(seed_of("depths"), images=8, points=30)
    apart = np.abs(truth.points[:, 0] - truth.points[:, 1]) + np.abs(truth.points[:, 2])
    far = np.argsort(-apart)[:12]
    xyz = truth.points[far].copy()
    xyz[:2] = {
        "axes": xyz[:2][:, [1, 0, 2]],
        "depth": xyz[:2] * [1, 1, -1],
        None: xyz[:2] * [0.8, 1, 1],
    }[mistake]
    control = KnownPoints.from_arrays([network.points[j] for j in far], xyz, 1e-4)
    result = run_survey(survey_of(network, truth, control=control, datum={"kind": "control"}))
    left_out = next(said for said in remarks_on_given(result) if said.kind == "given_left_out")
    assert set(left_out.names("given")) == {network.points[j] for j in far[:2]}
    assert left_out.names("mistake") == (() if mistake is None else (mistake,))
    assert ("They fit if" in left_out.text) == (mistake is not None)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("\n1,,,,,,\n2,5,6,7,0.1,0.1,0.1", "at least one coordinate"),
        (
            "\n1,1,2,3,,0.1,0.1\n2,5,6,7,0.1,0.1,0.1",
            "column sX contains nan, needed a number where the coord",
        ),
        (",checkX,checkY,checkZ\n1,0,0,,1,1,,,,1\n2,5,6,7,1,1,1,,,", "checkZ contains 1"),
        (
            ",checkX,checkY,checkZ\n1,0,0,0,1,1,1,2,,\n2,5,6,7,1,1,1,,,",
            "column checkX contains 2, needed 0,",
        ),
    ],
)
def test_control_without_sense_is_refused(rows: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(SurveyFileError, match=message):
        _control(tmp_path / "control.csv", f"id,X,Y,Z,sX,sY,sZ{rows}\n")


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
    with pytest.raises(SurveyFileError, match=r"control.csv: control point 1: .* a positive definite matrix"):
        _control(
            tmp_path / "control.csv",
            "id,X,Y,Z,sX,sY,sZ,cXY,cXZ,cYZ\n1,0,0,0,1,1,1,0.9,0.9,-0.9\n2,9,9,9,1,1,1,,,\n",
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
    measured = measure_given(replace(survey, observations=read_image_points(path)))
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
        said = [one for one in found.verdict.remarks if one.kind == "checks_differ"]
        assert bool(said) == bool(wrong) and found.verdict.level == ("fair" if wrong else "good")
        if wrong:
            assert (said[0].names("coordinates"), said[0].names("points")) == (("Z",), ("7",))
            assert said[0].number("sigmas") == pytest.approx(abs(tests[2])) and abs(tests[2]) > 30
