"""Observed exterior orientation in the survey file: what may be written, what it does, where it is told."""

from __future__ import annotations

import json
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from sfm.adjustment.covariance import marginal_of
from sfm.adjustment.result import Adjustment
from sfm.judgement.bundle_statistics import given_of
from sfm.judgement.survey_result import SurveyResult
from sfm.model.conventions import FloatArray, angles_from_rotation
from sfm.model.errors import GeometryError, SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import ObjectPoints
from sfm.model.observations.pose import MountObservations
from sfm.model.remarks.remark import Remark
from sfm.pipeline import run_survey
from sfm.report.output import write_result
from sfm.report.pages import html_of
from sfm.report.survey_report import text_report
from sfm.survey import placing
from sfm.survey.inputs.exterior_table import read_observed_exterior
from sfm.survey.inputs.survey import read_survey
from tests.findings import findings_of
from tests.rigs import make_rig
from tests.surveys import observed_text, remarks_on_given, stations, write_photograph_survey
from tests.synthetic import make_network, seed_of

IMAGES = 8
SIGMA = 2e-3  # of an observed projection centre, m
SIGMA_DEG = 0.05
ANY = 1e-6  # probability with which a right result fails a test here
CENTRES = "image,X,Y,Z,sX,sY,sZ\n"
WHOLE = "image,X,Y,Z,sX,sY,sZ,omega_deg,phi_deg,kappa_deg,somega_deg,sphi_deg,skappa_deg\n"


def written(
    folder: Path,
    name: str,
    exterior: str | None = None,
    *,
    datum: str = "control",
    images: int = IMAGES,
    control: bool = False,
) -> tuple[Path, Estimate]:
    """Write a survey of observed projection centres, with no control or one point known to 100 m."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = seed_of(name)
    network, truth = make_network(rng, images=images, points=25, free=("c",))
    k = network.image_points
    rows = [
        f"{network.images[i]},{network.points[j]},{x!r},{y!r}"
        for i, j, (x, y) in zip(k.image, k.point, k.xy.tolist(), strict=True)
    ]
    (folder / "image_points.csv").write_text("\n".join(["image,point,x_px,y_px", *rows]), encoding="utf-8")
    seen = truth.position + SIGMA * rng.standard_normal(truth.position.shape)
    if exterior is None:
        exterior = CENTRES + "".join(
            f"{image},{X!r},{Y!r},{Z!r},{SIGMA},{SIGMA},{SIGMA}\n"
            for image, (X, Y, Z) in zip(network.images, seen.tolist(), strict=True)
        )
    (folder / "exterior.csv").write_text(exterior, encoding="utf-8")
    (folder / "control.csv").write_text("id,X,Y,Z,sX,sY,sZ\n1,0,0,0,100,100,100\n", encoding="utf-8")
    text = observed_text(name, "m") + f'[datum]\nkind = "{datum}"\n'
    text += '[exterior]\nfile = "exterior.csv"\n'
    text += '[control]\nfile = "control.csv"\n' if control else ""
    (folder / "survey.toml").write_text(text, encoding="utf-8")
    return folder / "survey.toml", truth


def solved(path: Path) -> SurveyResult:
    return run_survey(read_survey(path))


def truth_of(a: Adjustment, truth: Estimate) -> FloatArray:
    """Return the true coordinates of the points in the order of the result, (n, 3)."""
    return truth.points[[int(name) - 1 for name in a.network.points]]


def farthest(error: FloatArray, covariance: FloatArray) -> float:
    """Return the largest e' Q^-1 e of many vectors of three."""
    return float(np.einsum("na,nab,nb->n", error, np.linalg.inv(covariance), error).max())


@pytest.mark.parametrize("control", [False, True])
def test_projection_centres_place_a_survey_within_its_standard_deviations(
    tmp_path: Path, control: bool
) -> None:
    path, truth = written(tmp_path, "placed by centres", control=control)
    a = solved(path).adjustment
    assert a.converged and a.datum == "control"
    assert (a.defect, a.undetermined) == (0, ())
    limit = stats.chi2.ppf(1 - ANY, 3)
    assert a.network.images == tuple(f"image {i + 1}" for i in range(IMAGES))
    points = a.estimate.points - truth_of(a, truth)
    assert farthest(points, a.covariance.points) < limit
    assert farthest(a.estimate.position - truth.position, a.covariance.exterior[:, :3, :3]) < limit
    # the frame is known no better than the mean of the centres, and the network itself far better
    sigma = np.sqrt(np.einsum("nii->ni", a.covariance.points))
    assert SIGMA / np.sqrt(IMAGES) * 0.8 < sigma.mean() < 2 * SIGMA


def test_predicted_and_found_errors_agree_over_many_surveys(tmp_path: Path) -> None:
    squares = []
    for k in range(6):
        path, truth = written(tmp_path / str(k), f"many surveys {k}", images=6)
        a = solved(path).adjustment
        error = (a.estimate.points - truth_of(a, truth)).mean(axis=0)
        n = len(a.network.points)
        joint = marginal_of(a).joint(np.zeros(0, dtype=np.int64), np.arange(n))
        Q = joint.reshape(n, 3, n, 3).mean(axis=(0, 2))
        squares.append(float(error @ np.linalg.solve(Q, error)))
    total, freedom = sum(squares), 3 * len(squares)
    low, high = stats.chi2.ppf([1e-4, 1 - 1e-4], freedom)
    assert low < total < high


def test_fixed_stations_stay_where_they_are(tmp_path: Path) -> None:
    path, truth = written(tmp_path, "fixed stations")
    rows = "".join(
        f"image {i + 1},{X!r},{Y!r},{Z!r}\n" for i, (X, Y, Z) in enumerate(truth.position[:4].tolist())
    )
    (tmp_path / "exterior.csv").write_text("photograph,X0,Y0,Z0\n" + rows, encoding="utf-8")
    a = solved(path).adjustment
    np.testing.assert_array_equal(a.estimate.position[:4], truth.position[:4])
    assert (a.covariance.exterior[:4, :3, :3] == 0).all()
    error = a.estimate.points - truth_of(a, truth)
    assert farthest(error, a.covariance.points) < stats.chi2.ppf(1 - ANY, 3)


def test_fixed_stations_beside_fixed_control_are_no_observations(tmp_path: Path) -> None:
    path, truth = written(tmp_path, "all fixed", control=True)
    for name, header, label, places in (
        ("exterior.csv", "image", "image ", truth.position[:2]),
        ("control.csv", "id", "", truth.points[:3]),
    ):
        rows = "".join(f"{label}{k + 1},{X!r},{Y!r},{Z!r}\n" for k, (X, Y, Z) in enumerate(places.tolist()))
        (tmp_path / name).write_text(f"{header},X,Y,Z\n{rows}", encoding="utf-8")
    a = solved(path).adjustment
    assert a.converged and (a.defect, a.undetermined) == (0, ())
    assert a.observations == 2 * int((~a.rejected).sum())
    np.testing.assert_array_equal(a.estimate.position[:2], truth.position[:2])


@pytest.mark.parametrize("fixed", [False, True])
def test_two_centres_and_the_angles_of_one_photograph_are_enough(tmp_path: Path, fixed: bool) -> None:
    path, truth = written(tmp_path, "two centres and angles")
    omega, phi, kappa = np.degrees(angles_from_rotation(truth.rotation[0])).tolist()
    s = 0 if fixed else SIGMA_DEG
    rows = [
        f"image 1,{','.join(map(repr, truth.position[0].tolist()))},{SIGMA},{SIGMA},{SIGMA},"
        f"{omega},{phi},{kappa},{s},{s},{s}",
        f"image 2,{','.join(map(repr, truth.position[1].tolist()))},{SIGMA},{SIGMA},{SIGMA},,,,,,",
        "image 3,,,,,,,,,,,,",
    ]
    (tmp_path / "exterior.csv").write_text(WHOLE + "\n".join(rows) + "\n", encoding="utf-8")
    a = solved(path).adjustment
    assert (a.defect, a.undetermined, a.converged) == (0, (), True)
    error = a.estimate.points - truth_of(a, truth)
    assert farthest(error, a.covariance.points) < stats.chi2.ppf(1 - ANY, 3)
    if fixed:
        np.testing.assert_allclose(a.estimate.rotation[0], truth.rotation[0], atol=1e-12)


def test_too_little_to_place_the_network_is_said(tmp_path: Path) -> None:
    path, truth = written(tmp_path, "too little")
    X, Y, Z = truth.position[0].tolist()
    (tmp_path / "exterior.csv").write_text(f"image,X,Y,Z\nimage 1,{X!r},{Y!r},{Z!r}\n", encoding="utf-8")
    needed = (
        "1 place of projection centres and control points with X, Y and Z, and the angles of 0 photographs"
    )
    with pytest.raises(GeometryError, match=needed):
        solved(path)


@pytest.mark.parametrize("off", [0.0, SIGMA / 2])
def test_projection_centres_on_a_line_do_not_place_a_network(tmp_path: Path, off: float) -> None:
    path, _ = written(tmp_path, "line")
    rows = "".join(
        f"image {k + 1},{k},{2 * k},{off * (k == 1)!r},{SIGMA},{SIGMA},{SIGMA}\n" for k in range(3)
    )
    (tmp_path / "exterior.csv").write_text(CENTRES + rows, encoding="utf-8")
    with pytest.raises(
        GeometryError, match="places of projection centres and control points with X, Y and Z, on a line, and"
    ):
        solved(path)


def test_extents_of_places_do_not_depend_on_where_they_are() -> None:
    line = np.array([100.0, -50.0, 7.0]) + np.linspace(0.0, 3.0, 5)[:, None] * [0.6, 0.0, 0.8]
    length, breadth = placing._extents(line, np.array([1.0, 2.0, 3.0, 2.0, 1.0]))
    assert length == pytest.approx(0.75 * np.sqrt(12 / 9)) and breadth < 1e-12


@pytest.mark.parametrize("size", [1e-2, 1e3])
@pytest.mark.parametrize(("breadth", "placed"), [(0.1, True), (0.02, False)])
def test_control_places_a_network_from_a_twentieth_of_its_length(
    size: float, breadth: float, placed: bool
) -> None:
    """Broad control has placed the orientation before; narrow control places it here."""
    b = breadth
    figure = size * np.array([[-1, -b, 0], [1, -b, 0], [1, b, 0], [-1, b, 0.5 * b]])
    network, truth = make_network(seed_of("breadth"), images=3, points=4, free=(), figure=figure)
    control = ObjectPoints(np.arange(4), truth.points + 3.0 * size, np.zeros((4, 3, 3)))
    found = placing.place_on_exterior(network.with_given(control), truth)
    assert (found is truth) is placed
    if not placed:
        np.testing.assert_allclose(found.points, control.xyz, atol=1e-9 * size)


@pytest.mark.parametrize(("breadth", "on_a_line"), [(0.8e-6, True), (1.5e-6, False)])
def test_places_are_on_a_line_within_a_millionth_of_their_extent(breadth: float, on_a_line: bool) -> None:
    b = breadth
    figure = np.array([[-1, -b, 0], [1, -b, 0], [1, b, 0], [-1, b, 0]])
    network, truth = make_network(seed_of("line"), images=3, points=4, free=(), figure=figure)
    control = ObjectPoints(np.arange(4), truth.points + 3.0, np.zeros((4, 3, 3)))
    refused = pytest.raises(GeometryError, match="on a line")
    with refused if on_a_line else nullcontext():
        found = placing.place_on_exterior(network.with_given(control), truth)
        np.testing.assert_allclose(found.points, control.xyz, atol=1e-9)


def test_a_control_datum_needs_control_or_exterior(tmp_path: Path) -> None:
    path, _ = written(tmp_path, "nothing")
    path.write_text(path.read_text().replace('[exterior]\nfile = "exterior.csv"\n', ""), encoding="utf-8")
    with pytest.raises(
        SurveyFileError, match=r"needs \[control\] with the file of known points, or \[exterior\]"
    ):
        read_survey(path)


def test_in_a_free_datum_it_takes_no_part_and_a_note_says_so(tmp_path: Path) -> None:
    path, _ = written(tmp_path, "free", datum="free")
    result = solved(path)
    path.write_text(path.read_text().replace('[exterior]\nfile = "exterior.csv"\n', ""), encoding="utf-8")
    without = solved(path)
    np.testing.assert_array_equal(result.adjustment.estimate.points, without.adjustment.estimate.points)
    (said,) = (one for one in result.remarks if one not in without.remarks)
    assert said.kind == "exterior_unused" and said.names("datum") == ("free",)


def test_residuals_and_tests_stand_in_every_report(tmp_path: Path) -> None:
    path, _ = written(tmp_path / "survey", "told")
    table = (tmp_path / "survey" / "exterior.csv").read_text().splitlines()
    name, X, *rest = table[3].split(",")
    table[3] = ",".join([name, repr(float(X) + 4 * SIGMA), *rest])  # that no test finds
    (tmp_path / "survey" / "exterior.csv").write_text("\n".join(table), encoding="utf-8")
    result = solved(path)
    given = given_of(result.adjustment, result.length_unit)
    both = given.of("projection centre"), given.of("rotation")
    found, angles = both
    assert found is not None and angles is not None
    assert np.isnan(angles.sigma).all()
    e, k = np.unravel_index(np.nanargmax(np.abs(found.w)), found.w.shape)
    assert (found.names[e], k) == ("image 3", 0)
    assert found.difference[e, k] < -2 * SIGMA
    write_result(findings_of(result), tmp_path / "out")
    rows = json.loads((tmp_path / "out" / "summary.json").read_text())["observed_exterior"]
    assert len(rows) == 3 * IMAGES
    worst = max(rows, key=lambda row: abs(row["w"]))
    assert (worst["image"], worst["parameter"], worst["unit"]) == ("image 3", "X0", "m")
    lines = (tmp_path / "out" / "given.csv").read_text().splitlines()
    assert sum(line.startswith("projection centre,") for line in lines) == 3 * IMAGES
    assert not any(line.startswith("rotation,") for line in lines)
    text, page = text_report(findings_of(result)), html_of(findings_of(result))
    for shown in (text, page):
        assert (
            f"{found.w[e, k]:+.2f}" in shown and "Observed exterior orientation: projection centres" in shown
        )
    (component,) = (row for row in text.splitlines() if row.split()[:2] == ["exterior", "orientation"])
    assert float(component.split()[3]) == pytest.approx(float(np.nansum(found.r)), abs=0.06)
    again = read_observed_exterior(tmp_path / "out" / "images.csv")
    np.testing.assert_array_equal(again.value[:, :3], result.adjustment.estimate.position)
    assert np.isfinite(again.sigma).all()


def said_of_right_points(path: Path, truth: Estimate) -> Remark:
    """Return the only remark on given values but notes, of a survey whose points are as good as stated."""
    result = solved(path)
    error = result.estimate.points - truth_of(result.adjustment, truth)
    assert farthest(error, result.adjustment.covariance.points) < stats.chi2.ppf(1 - ANY, 3)
    (said,) = (one for one in remarks_on_given(result) if one.severity != "note")
    return said


def test_a_projection_centre_that_does_not_fit_is_left_out(tmp_path: Path) -> None:
    path, truth = written(tmp_path, "wrong centre")
    table = (tmp_path / "exterior.csv").read_text().splitlines()
    name, X, *rest = table[3].split(",")
    table[3] = ",".join([name, repr(float(X) + 20 * SIGMA), *rest])
    (tmp_path / "exterior.csv").write_text("\n".join(table), encoding="utf-8")
    said = said_of_right_points(path, truth)
    assert (said.kind, said.names("given")) == ("given_left_out", ("image 3",))
    assert said.number("distance") == pytest.approx(20 * SIGMA, rel=0.2)


def test_exchanged_projection_centres_are_exchanged_again(tmp_path: Path) -> None:
    """They were found, and took part as they were given."""
    path, truth = written(tmp_path, "exchanged centres")
    head, *rows = (tmp_path / "exterior.csv").read_text().splitlines()
    cells = [row.split(",", 1) for row in rows]
    cells[1][0], cells[4][0] = cells[4][0], cells[1][0]
    (tmp_path / "exterior.csv").write_text("\n".join([head, *map(",".join, cells)]), encoding="utf-8")
    said = said_of_right_points(path, truth)
    assert (said.kind, said.names("of")) == ("given_renamed", ("centres",))
    assert sorted(said.names("given")) == sorted([cells[1][0], cells[4][0]])


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (CENTRES + "image 1,nan,2,3,1,1,1\n", r"line 2: column X contains 'nan', a finite number is needed"),
        (CENTRES + "image 1,1,2,3,1,inf,1\n", r"line 2: column sY contains 'inf', a finite number is needed"),
        (CENTRES + "image 1,1,2,3,1,-1,1\n", r"line 2: column sY contains -1, needed 0 \(fixed\) or more"),
        (CENTRES + "image 1,1,2,3,1,,1\n", r"line 2: column sY is empty beside a value in Y; needed both"),
        (CENTRES + "image 1,1,,3,1,1,1\n", r"line 2: column Y is empty beside a value in sY; needed both"),
        (CENTRES + "image 1,0,0,0,1,1,1\nimage 1,1,1,1,1,1,1\n", r"line 3: image 'image 1' is on line 2"),
        (
            CENTRES + "image 1,0,0,0,1,1,1\nimage 9,1,1,1,1,1,1\n",
            r"line 3: column image: 'image 9' has no obs",
        ),
        (
            CENTRES + "image 1,0,0,0,1,1,1\nimage 2,5000,1,1,1e-3,1,1\n",
            r"line 3: column sX contains 0.001, needed at least 0.005",
        ),
        ("image,X,Y\nimage 1,0,0\n", r"line 1: no column Z, needed image,X,Y,Z\[,sX,sY,sZ,omega_deg,"),
        ("image,X,Y,Z,height\n", r"line 1: unknown column 'height', needed image,X,Y,Z\[,sX"),
        (WHOLE + "image 1,,,,,,,0,0,400,1,1,1\n", r"line 2: column kappa_deg contains 400, needed degrees"),
        (WHOLE + "image 1,,,,,,,0,90,0,1,1,1\n", r"line 2: column phi_deg contains 90, needed another than"),
        (
            WHOLE + "image 1,,,,,,,0,0,0,1,0,1\n",
            r"line 2: column sphi_deg contains 0, needed omega, phi, kappa fix",
        ),
        (
            WHOLE + "image 1,,,,,,,0,0,0,1,1e-12,1\n",
            r"line 2: column sphi_deg contains 1e-12, needed at",
        ),
    ],
)
def test_wrong_tables_are_refused_with_line_and_column(tmp_path: Path, text: str, match: str) -> None:
    path, _ = written(tmp_path, "refused", text)
    with pytest.raises(SurveyFileError, match=match):
        solved(path)


def test_photographs_are_placed_by_their_observed_stations(tmp_path: Path) -> None:
    path = write_photograph_survey(tmp_path / "photographs", "stations")
    position, _ = stations(6)
    seen = position + 0.5 * seed_of("stations").standard_normal(position.shape)
    rows = "".join(
        f"photo {i + 1}.png,{X!r},{Y!r},{Z!r},0.5,0.5,0.5\n" for i, (X, Y, Z) in enumerate(seen.tolist())
    )
    (path.parent / "exterior.csv").write_text(CENTRES + rows, encoding="utf-8")
    (path.parent / "control.csv").write_text("id,X,Y,Z,sX,sY,sZ\n5,0,0,0,9e3,9e3,9e3\n", encoding="utf-8")
    with path.open("a", encoding="utf-8") as file:
        file.write(
            '[datum]\nkind = "control"\n[control]\nfile = "control.csv"\n[exterior]\nfile = "exterior.csv"\n'
        )
    a = run_survey(read_survey(path)).adjustment
    assert a.converged and a.network.images == tuple(f"photo {i + 1}.png" for i in range(6))
    error = a.estimate.position - position
    assert farthest(error, a.covariance.exterior[:, :3, :3]) < stats.chi2.ppf(1 - ANY, 3)
    assert np.linalg.norm(error, axis=1).max() < 2.0  # mm, of stations 600 mm away
    (path.parent / "exterior.csv").write_text(
        CENTRES + rows.replace("photo 3.png", "photo 9.png"), encoding="utf-8"
    )
    with pytest.raises(SurveyFileError, match=r"line 4: column image: .photo 9.png. is no photograph"):
        run_survey(read_survey(path))


@pytest.mark.parametrize(("observed", "held"), [(True, False), (False, True), (False, False)])
def test_mounts_that_are_observed_or_held_fixed_give_the_scale(observed: bool, held: bool) -> None:
    network, truth = make_rig(seed_of("scale of mounts"), moments=2)
    assert truth.mounts is not None
    free = np.tile(~truth.mounts.at_reference[:, None], (1, 6)) & (not held)
    truth = replace(truth, mounts=replace(truth.mounts, free=free))
    if observed:
        mount = truth.mounts.position[1:], np.zeros((1, 3)), np.eye(6)[None]
        network = network.with_given(further=(MountObservations(np.array([1]), *mount),))
    assert placing.mounts_give_scale(network, truth) is (observed or held)
