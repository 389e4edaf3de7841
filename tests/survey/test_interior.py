"""Interior orientation in the survey file: of all, of groups, of each; from the result of another survey."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sfm
from adapters.colmap.adjuster import adjust_with_colmap
from sfm.adjustment.covariance import change_datum, marginal_of
from sfm.adjustment.datum import Datum
from sfm.judgement.survey_result import SurveyResult
from sfm.model.camera import project
from sfm.model.conventions import angles_from_rotation
from sfm.model.errors import GeometryError, SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.remarks.remark import of_kind
from sfm.pipeline import run_survey
from sfm.report.survey_report import text_report
from sfm.report.tables.summary import summary
from sfm.survey.assembly import OtherPrograms
from sfm.survey.inputs.survey import read_survey
from tests.commands import kolinear
from tests.findings import findings_of
from tests.surveys import write_observed_survey
from tests.synthetic import make_network, seed_of
from tests.tables import rows_of

IMAGES = 8
SURVEY = """\
[survey]
name = "zoom"
unit = "m"
[[camera]]
name = "A"
size_px = [2000, 1500]
pixel_mm = [0.005, 0.005]
{camera}
[observations]
file = "image_points.csv"
[approximate]
images = "images.csv"
points = "points.csv"
[adjust]
reject = "tau"
[compare]
backend = "none"
"""
LENS = 'c_mm = 10.0\nfree = ["c", "x0", "y0", "K1", "K2", "P1", "P2", "b1"]\n'


def zoomed(
    folder: Path, camera: str, *, x0_of_groups: tuple[float, float] = (0.03, 0.03)
) -> tuple[Path, Estimate]:
    """Write a survey of photographs that differ in c, and in x0 by group; return its file and the truth."""
    rng = seed_of("zoomed survey")
    network, truth = make_network(rng, images=IMAGES, points=40, noise_px=0.0)
    c = 10.0 * (1 + rng.uniform(-0.02, 0.02, IMAGES))
    cameras = []
    for i in range(IMAGES):
        p = truth.cameras[0].parameters.copy()
        p[0], p[1] = c[i], x0_of_groups[i % 2]
        cameras.append(truth.cameras[0].with_parameters(p))
    truth = replace(truth, cameras=tuple(cameras))
    write(folder, camera, network, truth, rng)
    return folder / "survey.toml", truth


def write(folder: Path, camera: str, network: Network, truth: Estimate, rng: np.random.Generator) -> None:
    names = [f"{'even' if i % 2 == 0 else 'odd'}_{i}.jpg" for i in range(IMAGES)]
    k = network.image_points
    lines = ["image,point,x_px,y_px"]
    for i, lens in enumerate(truth.cameras):
        rows = np.flatnonzero(k.image == i)
        xy = project(lens, truth.position[i], truth.rotation[i], truth.points[k.point[rows]])
        xy += rng.normal(0, 0.1, xy.shape)
        lines += [
            f"{names[i]},p{j},{x!r},{y!r}" for j, (x, y) in zip(k.point[rows], xy.tolist(), strict=True)
        ]
    (folder / "image_points.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    rows_of_points = "".join(f"p{j},{x!r},{y!r},{z!r}\n" for j, (x, y, z) in enumerate(truth.points.tolist()))
    (folder / "points.csv").write_text("point,X,Y,Z\n" + rows_of_points, encoding="utf-8")
    angles = np.degrees(angles_from_rotation(truth.rotation)).tolist()
    images = "".join(
        f"{name},{X!r},{Y!r},{Z!r},{o!r},{p!r},{q!r}\n"
        for name, (X, Y, Z), (o, p, q) in zip(names, truth.position.tolist(), angles, strict=True)
    )
    (folder / "images.csv").write_text("image,X,Y,Z,omega_deg,phi_deg,kappa_deg\n" + images, encoding="utf-8")
    (folder / "survey.toml").write_text(SURVEY.format(camera=camera), encoding="utf-8")


def assert_recovered(result: SurveyResult, truth: Estimate, parameter: str) -> None:
    a = result.adjustment
    for camera, Q, index in zip(
        a.estimate.cameras, a.covariance.interior, range(len(a.estimate.cameras)), strict=True
    ):
        image = int(np.flatnonzero(a.network.camera == index)[0])
        number = int(a.network.images[image].split("_")[1].split(".")[0])
        s = int(np.flatnonzero(np.flatnonzero(camera.free) == camera.names.index(parameter))[0])
        difference = camera.value(parameter) - truth.cameras[number].value(parameter)
        assert abs(difference) < 4.5 * np.sqrt(Q[s, s]), (camera.name, parameter)


def test_c_of_each_photograph_x0_of_groups_and_the_rest_of_all(tmp_path: Path) -> None:
    given = LENS + 'per_photograph = ["c"]\nper_group = ["x0"]\ngroups = ["even_*", "odd_*"]\n'
    path, truth = zoomed(tmp_path, given, x0_of_groups=(0.02, 0.05))
    result = run_survey(read_survey(path))
    a = result.adjustment
    assert a.converged and a.defect == 7 and not a.undetermined
    assert a.unknowns == 6 * IMAGES + IMAGES + 2 + 6 + 3 * len(a.network.points)
    assert a.sigma0 == pytest.approx(1, abs=4 / np.sqrt(2 * a.redundancy))
    assert {camera.name for camera in a.estimate.cameras} == {f"A {name}" for name in a.network.images}
    for parameter in ("c", "x0", "K1"):
        assert_recovered(result, truth, parameter)
    whole, _ = zoomed(tmp_path, LENS, x0_of_groups=(0.02, 0.05))
    assert run_survey(read_survey(whole)).adjustment.sigma0 > 1 + 6 / np.sqrt(2 * a.redundancy)


def test_inner_constraints_on_chosen_points(tmp_path: Path) -> None:
    path, _ = zoomed(tmp_path, LENS + 'per_photograph = ["c"]\n')
    all_points = run_survey(read_survey(path)).adjustment
    path.write_text(path.read_text(encoding="utf-8") + '[datum]\npoints = ["p1", "p5", "p9", "q"]\n')
    result = run_survey(read_survey(path))
    a = result.adjustment
    assert a.datum_points is not None and a.datum_points.sum() == 3
    (missing,) = of_kind(result.remarks, "names_missing")
    assert missing.names("names") == ("q",)
    on = [a.network.points.index(name) for name in ("p1", "p5", "p9")]
    changed = change_datum(all_points, Datum("free", a.datum_points))
    # carried over without a new adjustment, from points that were adjusted in another datum
    ratio = np.trace(changed.covariance.points[on].sum(axis=0)) / np.trace(
        a.covariance.points[on].sum(axis=0)
    )
    scale = np.linalg.norm(np.diff(all_points.estimate.points[on[:2]], axis=0))
    scale /= np.linalg.norm(np.diff(a.estimate.points[on[:2]], axis=0))
    assert ratio == pytest.approx(scale**2, rel=1e-4)
    assert "free on 3 chosen points" in text_report(findings_of(result))
    assert summary(findings_of(result))["datum"]["points"] == ["p1", "p5", "p9"]
    again = marginal_of(a).joint(np.zeros(0, dtype=int), np.array(on))
    assert again[:3, :3] == pytest.approx(a.covariance.points[on[0]], rel=1e-4)
    path.write_text(path.read_text(encoding="utf-8").replace('"p5", "p9"', '"r", "s"'))
    with pytest.raises(GeometryError, match=r"1 of the 4 datum\.points are in the network, at least 3"):
        run_survey(read_survey(path))


def test_one_camera_for_each_group(tmp_path: Path) -> None:
    given = LENS + 'per_group = ["c", "x0"]\ngroups = ["even_*", "odd_*"]\n'
    path, _ = zoomed(tmp_path, given)
    a = run_survey(read_survey(path)).adjustment
    assert [camera.name for camera in a.estimate.cameras] == ["A even_*", "A odd_*"]
    assert a.unknowns == 6 * IMAGES + 4 + 6 + 3 * len(a.network.points)


def test_observed_parameters_are_adjusted_with_their_weight(tmp_path: Path) -> None:
    given = (
        'free = ["x0", "y0", "K1", "K2"]\nper_photograph = ["c"]\n'
        "fixed = {b1 = 2e-4}\nweighted = {c = [10.0, 0.1], P1 = [3e-5, 1e-6], P2 = [-2e-5, 1e-9]}\n"
    )
    path, truth = zoomed(tmp_path, given)
    result = run_survey(read_survey(path))
    a = result.adjustment
    assert len(a.network.interior) == IMAGES + 2
    used = int((~a.rejected).sum())
    assert a.observations == 2 * used + IMAGES + 2
    assert a.redundancy == a.observations - a.unknowns + 7
    assert a.estimate.cameras[3].value("P2") == pytest.approx(-2e-5, abs=1e-8)
    assert a.estimate.cameras[3].value("b1") == 2e-4
    assert_recovered(result, truth, "c")


def test_comparison_says_what_colmap_cannot_share(tmp_path: Path) -> None:
    path, _ = zoomed(tmp_path, LENS + 'per_photograph = ["c"]\n')
    result = run_survey(read_survey(path), others=OtherPrograms(adjuster=adjust_with_colmap))
    both = result.comparison
    assert both is not None
    assert len(both.network.camera) == len(set(both.network.camera.tolist())) == IMAGES
    assert both.agree
    assert both.unshared == (f"x0, y0, K1, K2, P1, P2, b1 of A, shared by {IMAGES} cameras",)
    for camera in both.adjustment.estimate.cameras:
        assert camera.free[:2].all() and not camera.free[2:].any()


@pytest.mark.parametrize(
    ("given", "match"),
    [
        (LENS + 'per_photograph = ["K3"]', r"'K3' is in per_photograph but is not adjusted"),
        (LENS + 'per_photograph = ["K9"]', r"has no parameter 'K9'"),
        (LENS + 'per_group = ["c"]', r"per_group is given, groups is needed with it"),
        (LENS + 'groups = ["even_*"]', r"groups is given, per_group is needed with it"),
        (LENS + 'per_photograph = ["c"]\nper_group = ["c"]\ngroups = ["*"]', r"both per_photograph and"),
        (LENS + 'per_group = ["c"]\ngroups = ["even_*", "*_3.jpg"]', r"photograph 'odd_1.jpg' is in no gr"),
        (LENS + 'per_group = ["c"]\ngroups = ["*", "odd_*"]', r"photograph 'odd_1.jpg' is in 2 groups"),
        (LENS + "weighted = {c = [10.0, 0.1]}", r"'c' is both weighted and free"),
        (LENS + "weighted = {K3 = [0.0, 0.0]}", r"weighted.*found 0.0, needed more than 0"),
        (LENS + "weighted = {K3 = 0.1}", r"weighted.*needed a list in square brackets"),
        ("c_mm = 10.0\nweighted = {c = [10.0, 0.1]}", r"c_mm and weighted.c are both given"),
    ],
)  # fmt: skip
def test_contradictions_are_named(tmp_path: Path, given: str, match: str) -> None:
    path, _ = zoomed(tmp_path, given)
    with pytest.raises(SurveyFileError, match=match):
        run_survey(read_survey(path))


def parameters(result: Path) -> dict[str, tuple[str, str]]:
    return {row["parameter"]: (row["value"], row["sigma"]) for row in rows_of(result / "cameras.csv")}


def test_weighted_it_comes_with_its_full_covariance(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = write_observed_survey(tmp_path / "a" / "first", "first")
    first.write_text(first.read_text().replace('free = ["c"]', 'free = ["c", "K3"]'))
    lens = tmp_path / "a" / "lens"
    assert kolinear("adjust", first, "--out", lens) == 0
    weighted = ("--camera", lens, "--camera-weighted", "--out", tmp_path / "weighted")
    assert kolinear("adjust", first, *weighted) == 0
    found, again = parameters(lens), parameters(tmp_path / "weighted")
    for name, (value, sigma) in found.items():
        if sigma:  # the same observations again: the same values, with standard deviations less by root 2
            assert float(again[name][0]) == pytest.approx(float(value), abs=0.02 * float(sigma))
            assert float(again[name][1]) == pytest.approx(float(sigma) / np.sqrt(2), rel=0.02)
    named = tmp_path / "a" / "named.toml"
    text = first.read_text()
    begin, end = text.index("[[camera]]"), text.index("[observations]")
    camera = 'name = "lens"\nimages = "*"\ncalibration = "lens"\ncalibration_use = "weighted"\n'
    named.write_text(text[:begin] + "[[camera]]\n" + camera + text[end:])
    (tmp_path / "a" / "image_points.csv").write_bytes((first.parent / "image_points.csv").read_bytes())
    survey = sfm.read_survey(named)
    assert survey.cameras[0].correlations and dict(survey.cameras[0].weighted).keys() == {
        name for name, (_, sigma) in found.items() if sigma
    }
    capsys.readouterr()
    assert kolinear("adjust", first, "--camera-weighted", "--out", tmp_path / "none") == 2
    assert "expected --camera RESULT" in capsys.readouterr().err
    assert kolinear("adjust", first, "--camera", tmp_path / "held", "--out", tmp_path / "x") == 2
    capsys.readouterr()


def test_a_calibration_travels_and_is_held(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = write_observed_survey(tmp_path / "first", "first")
    assert kolinear("adjust", first, "--out", tmp_path / "calibrated") == 0
    second = write_observed_survey(tmp_path / "second", "second")
    second.write_text(second.read_text().replace("c_mm = 10.0", "c_mm = 10.3"))
    assert kolinear("adjust", second, "--camera", tmp_path / "calibrated", "--out", tmp_path / "held") == 0
    given, held = parameters(tmp_path / "calibrated"), parameters(tmp_path / "held")
    assert given["c"][1] and {name: value for name, (value, _) in given.items()} == {
        name: value for name, (value, _) in held.items()
    }
    assert not any(sigma for _, sigma in held.values())

    second.write_text(second.read_text().replace("[2000, 1500]", "[2000, 1600]"))
    capsys.readouterr()
    assert kolinear("adjust", second, "--camera", tmp_path / "calibrated", "--out", tmp_path / "other") == 2
    error = capsys.readouterr().err
    assert "has 2000 x 1600 px" in error and error.count("\n") == 1 and not (tmp_path / "other").exists()
