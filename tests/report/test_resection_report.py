"""The body of `kolinear resect`: files in, JSON and text out, one clear line for bad input."""

import json

import numpy as np
import pytest

from sfm.cli.commands.resect import resect as resect_command
from sfm.cli.resection_inputs import read_tasks
from sfm.model.errors import GeometryError, SurveyFileError
from sfm.report.single_photographs import comparison_table, resection_json, resection_text
from sfm.textbook.resection import METHODS
from sfm.textbook.resection.by_method import resect, resect_by_all
from tests.orientation.resection.test_least_squares import LAB2, TRUTH
from tests.places import ROOT

TABLE = np.loadtxt(ROOT / "datasets/resection4/resection4_points.csv", delimiter=",", skiprows=1)
FIRST = (0.03701365, 0.69538531, -0.71768222)
# document 003, image 9: dispersion matrix as printed (its angles are in rad, though headed deg)
PRINTED_9 = """
9.6109e-05 -2.7239e-06 -1.6399e-06 9.6521e-07 2.1529e-05 5.0135e-06
-2.7239e-06 7.9096e-05 -2.2975e-05 -1.8865e-05 -5.9816e-07 5.4154e-07
-1.6399e-06 -2.2975e-05 1.5329e-05 5.8205e-06 -5.0113e-07 -3.3482e-07
9.6521e-07 -1.8865e-05 5.8205e-06 4.6197e-06 2.0314e-07 -6.5548e-08
2.1529e-05 -5.9816e-07 -5.0113e-07 2.0314e-07 4.9247e-06 1.0929e-06
5.0135e-06 5.4154e-07 -3.3482e-07 -6.5548e-08 1.0929e-06 8.1437e-07
"""


def read_task(path, **options):
    return read_tasks(path, **options)[0]


def resect_json(task, method):
    return resection_json(resect(task, method), task.c)


def resect_table(task, method):
    if method == "all":
        return comparison_table(resect_by_all(task), task.c)
    return resection_text(resect(task, method), task.c)


def write_points(path, rows):
    lines = ["point,X,Y,Z,x_mm,y_mm"] + [",".join(str(value) for value in row) for row in rows]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture
def four(tmp_path):
    return write_points(tmp_path / "points.csv", [(int(row[0]), *row[1:]) for row in TABLE])


@pytest.mark.parametrize("method", [m for m in METHODS if m != "dlt"])
def test_methods_on_document_001(four, method):
    found = resect_json(read_task(four, c_mm=24, start="0.1,0.6,-0.6"), method)
    json.dumps(found, allow_nan=False)
    best = found["solutions"][0]
    # p4p takes the four points as a plane, which they are to 1.3 thousandths
    atol = 0.02 if method == "p4p" else 5e-6
    np.testing.assert_allclose([best["X0"], best["Y0"], best["Z0"]], FIRST, atol=atol)
    assert np.array(best["M"]).shape == (3, 3)
    np.testing.assert_allclose(best["M"][0], (-0.998033, 0.051274, 0.036079), atol=0.02)
    assert best["rms_mm"] < 0.03


def test_comparison_table(four):
    text = resect_table(read_task(four, c_mm=24), "all")
    for method in METHODS:
        assert f"\n{method}" in text
    assert "dlt: 4 points, at least 6 are needed" in text
    rows = [line.split()[-7:-4] for line in text.splitlines()]
    assert rows.count(["0.037014", "0.695385", "-0.717682"]) >= 3
    assert rows.count(["0.216049", "-0.174261", "0.035674"]) >= 2


@pytest.mark.parametrize(("image", "n", "X0", "angles", "variance", "printed"), TRUTH)
def test_document_003_through_files(tmp_path, image, n, X0, angles, variance, printed):
    seen = np.loadtxt(LAB2 / "lab2_image_points_mm.csv", delimiter=",", skiprows=1)
    seen = seen[seen[:, 0] == image]
    points = np.loadtxt(LAB2 / "lab2_object_points_m.csv", delimiter=",", skiprows=1)
    rows = [(int(p), *points[int(p) - 1, 1:], x, y) for _, p, x, y in seen]
    lines = (LAB2 / "lab2_camera.csv").read_text().splitlines()
    # the document subtracts its distortion where `brown` adds the correction
    turned = [
        ",".join([key, str(-float(value)) if key[0] in "KP" else value, unit])
        for key, value, unit in (line.split(",") for line in lines[1:])
    ]
    (tmp_path / "camera.csv").write_text("\n".join([lines[0], *turned]) + "\n")
    task = read_task(write_points(tmp_path / "points.csv", rows), camera_file=tmp_path / "camera.csv")
    found = resect_json(task, "least-squares")
    best = found["solutions"][0]
    np.testing.assert_allclose([best[k] for k in ("X0", "Y0", "Z0")], X0, atol=1e-7)
    np.testing.assert_allclose([best[k] for k in ("omega_deg", "phi_deg", "kappa_deg")], angles, atol=1e-6)
    assert found["sigma0_mm"] ** 2 == pytest.approx(variance, rel=1e-6)
    assert found["redundancy"] == 2 * n - 6
    assert len(found["residuals_mm"]) == n and len(found["history"][0]) == 6
    if image == 9:
        divisor = (2 * n - 6) / (n - 6)
        unit = np.array([1, 1, 1, *[np.radians(1)] * 3])
        dispersion = np.array(found["dispersion"]) * np.outer(unit, unit) * divisor
        documented = np.array([[float(v) for v in row.split()] for row in PRINTED_9.strip().splitlines()])
        np.testing.assert_allclose(dispersion, documented, rtol=2e-4)


def test_robust_names_the_wrong_points(tmp_path):
    rng = np.random.default_rng(4)
    points = rng.uniform(-1, 1, (20, 3))
    X0 = np.array([0.2, 0.1, 6.0])
    xy = -24 * (points - X0)[:, :2] / (points - X0)[:, 2:] + 0.002 * rng.standard_normal((20, 2))
    xy[[3, 11]] += 1.0
    path = write_points(tmp_path / "p.csv", [(f"P{k}", *points[k], *xy[k]) for k in range(20)])
    found = resect_json(read_task(path, c_mm=24), "robust")
    assert found["rejected"] == ["P3", "P11"]
    assert found["sigma0_mm"] == pytest.approx(0.002, rel=0.4)
    assert "rejected 2: P3, P11" in resect_table(read_task(path, c_mm=24), "robust")
    dlt = resect_json(read_task(path, c_mm=24), "dlt")
    assert set(dlt["interior"]) == {"c_mm", "x0_mm", "y0_mm", "affinity", "shear_deg"}


def test_critical_cylinder_is_a_warning(tmp_path):
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.3]])
    X0 = np.array([0.5, 0.51 + np.sqrt(0.5), 3.0])
    xy = -24 * (points - X0)[:, :2] / (points - X0)[:, 2:]
    path = write_points(tmp_path / "p.csv", [(k, *points[k], *xy[k]) for k in range(4)])
    assert "critical cylinder" in resect_json(read_task(path, c_mm=24), "fischler-bolles")["warning"]
    assert "critical cylinder" in resect_table(read_task(path, c_mm=24), "all")


def test_bad_files(tmp_path, four):
    def refused(match, **options):
        with pytest.raises(SurveyFileError, match=match):
            read_task(options.pop("path", four), **options)

    refused("principal distance is missing")
    refused("expected more than 0", c_mm=-1)
    refused("the table cannot be read: No such file", path=tmp_path / "none.csv", c_mm=24)
    refused(r"--start '1,2': expected X,Y,Z or X,Y,Z,omega,phi,kappa", c_mm=24, start="1,2")
    (tmp_path / "a.csv").write_text("point,X,Y,x_mm,y_mm\n1,2,3,4,5\n")
    refused("a.csv, line 1: no column Z, needed point,X,Y,Z,x_mm,y_mm", path=tmp_path / "a.csv", c_mm=24)
    (tmp_path / "b.csv").write_text("point,X,Y,Z,x_mm,y_mm\n1,2,3,four,5,6\n")
    refused(
        "b.csv, line 2: column Z contains 'four', a finite number is needed", path=tmp_path / "b.csv", c_mm=24
    )
    (tmp_path / "c.csv").write_text("point,X,Y,Z,x_mm,y_mm\n")
    refused("c.csv: no rows below the header", path=tmp_path / "c.csv", c_mm=24)
    (tmp_path / "cam.csv").write_text("parameter,value\nc,24\nfocus,3\n")
    refused("cam.csv, line 3: unknown parameter 'focus'", camera_file=tmp_path / "cam.csv")


def test_bad_geometry(tmp_path, four):
    task = read_task(four, c_mm=24)
    with pytest.raises(GeometryError, match="method 'magic', expected one of fischler-bolles"):
        resect_json(task, "magic")
    with pytest.raises(GeometryError, match="church: a start position is needed"):
        resect_json(task, "church")
    rows = [(int(row[0]), *row[1:]) for row in TABLE]
    two = read_task(write_points(tmp_path / "two.csv", rows[:2]), c_mm=24)
    for method in METHODS:
        with pytest.raises(GeometryError, match=f"{method}: .*(2 points|start)"):
            resect_json(two, method)
    with pytest.raises(GeometryError, match="behind the camera"):
        resect_json(read_task(four, c_mm=24, start="0.0,0.7,-0.7,90,0,0"), "least-squares")
    lines = [(k, k, 2 * k, 0, k / 10, k / 5) for k in range(8)]
    collinear = read_task(write_points(tmp_path / "line.csv", lines), c_mm=24, start="0,0,9")
    for method in METHODS:
        with pytest.raises(GeometryError, match=f"{method}: .*line"):
            resect_json(collinear, method)
    twins = [rows[0], rows[0], *rows[1:], (9, 1, 1, 1, 2, 2), (10, 2, 1, 1, 2, 3)]
    coincident = read_task(write_points(tmp_path / "twins.csv", twins), c_mm=24, start="0,0,9")
    for method in METHODS:
        with pytest.raises(GeometryError, match="points 1 and 2 coincide"):
            resect_json(coincident, method)


@pytest.mark.parametrize("photograph", [9, 10, 14, 18])
@pytest.mark.parametrize("method", ["robust", "all"])
def test_opposite_signs_of_distortion_are_named_where_they_fit_better(photograph, method, capsys):
    """The camera of lab 2 subtracts its distortion; nothing said so."""
    table = ROOT / f"datasets/lab2/photograph_{photograph}.csv"
    for opposite in (False, True):
        resect_command(
            table, method=method, camera=ROOT / "datasets/lab2/lab2_camera.csv", opposite_signs=opposite
        )
        said = capsys.readouterr().out
        assert ("the opposite signs of the distortion fit" in said) is not opposite


def test_without_distortion_there_are_no_signs(four, capsys):
    resect_command(four, c=24)
    assert "opposite" not in capsys.readouterr().out
