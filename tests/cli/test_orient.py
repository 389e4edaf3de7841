"""`kolinear orient`: from measured coordinates of an aerial pair to object coordinates, step by step."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sfm.model.conventions import FloatArray, rotation_from_angles
from sfm.textbook.pair import intersect_pair, orient_independent
from sfm.textbook.photo_coordinates import PhotoCorrections, compute_photo_coordinates
from tests.commands import kolinear, refused
from tests.synthetic import seed_of

C_MM = 152.15
FIDUCIALS = np.array([[106.0, 106], [-106, 106], [-106, -106], [106, -106], [110, 0], [-110, 0]])
SCAN = np.array([[71.2, 0.9], [0.8, -71.4]])  # px per mm, rows count downwards
SCAN_ORIGIN = np.array([8200.0, 8150.0])
CORRECTIONS = PhotoCorrections(
    np.array([0.012, -0.007]), radial=np.array([-1.2e-8, 0.0, 0.0]), flying_height_km=1.9
)


@dataclass(frozen=True)
class Pair:
    """An aerial pair over terrain, as a scan of it is measured."""

    names: tuple[str, ...]
    X: FloatArray  # m, (n, 3)
    measured: tuple[FloatArray, FloatArray]  # px of the scans, (n, 2) each
    folder: Path

    def write(self, name: str, header: str, keys: Any, values: FloatArray) -> Path:
        path = self.folder / name
        rows = (",".join([str(key), *map(repr, row)]) for key, row in zip(keys, values.tolist(), strict=True))
        path.write_text(header + "\n" + "\n".join(rows) + "\n", encoding="utf-8")
        return path


def scanned(photo_mm: FloatArray) -> FloatArray:
    return photo_mm @ SCAN.T + SCAN_ORIGIN


@pytest.fixture
def pair(tmp_path: Path) -> Pair:
    rng = seed_of("aerial pair")
    X = np.column_stack([rng.uniform(-300, 900, 18), rng.uniform(-500, 500, 18), rng.uniform(0, 150, 18)])
    stations = [
        (np.array([0.0, 10, 1700]), rotation_from_angles(0.01, -0.02, 0.05)),
        (np.array([620.0, -15, 1712]), rotation_from_angles(-0.015, 0.01, 0.02)),
    ]
    photo = [compute_photo_coordinates(X, at, R, c_mm=C_MM, corrections=CORRECTIONS) for at, R in stations]
    noisy = [xy + 0.002 * rng.standard_normal(xy.shape) for xy in photo]
    first, second = map(scanned, noisy)
    return Pair(tuple(f"P{k}" for k in range(len(X))), X, (first, second), tmp_path)


def said(capsys: pytest.CaptureFixture[str], *arguments: object) -> Any:
    assert kolinear(*arguments, "--json") == 0
    return json.loads(capsys.readouterr().out)


def test_from_scans_to_object_coordinates(pair: Pair, capsys: pytest.CaptureFixture[str]) -> None:
    """Fiducials, corrections, relative and absolute orientation, each the input of the next."""
    folder = pair.folder
    marks = pair.write(
        "marks.csv", "mark,x,y,x_mm,y_mm", range(6), np.hstack([scanned(FIDUCIALS), FIDUCIALS])
    )
    camera = folder / "camera.csv"
    camera.write_text("parameter,value\nc,152.15\nx0,0.012\ny0,-0.007\nK1,-1.2e-8\n")
    corrected = []
    for side, measured in zip(("left", "right"), pair.measured, strict=True):
        points = pair.write(f"{side}.csv", "point,x,y", pair.names, measured)
        photo, out = folder / f"{side}_mm.csv", folder / f"{side}_corrected.csv"
        transformed = said(capsys, "orient", "fiducials", marks, "--points", points, "--out", photo)
        assert transformed["redundancy"] == 6 and transformed["sigma0_mm"] < 1e-9
        assert kolinear("orient", "fiducials", marks) == 0
        assert "shear 0.08" in (shown := capsys.readouterr().out) and "y axis reversed" in shown
        moved = said(
            capsys, *("orient", "correct", photo, "--camera", camera, "--flying-height", 1.9, "--out", out)
        )
        assert max(point["moved_um"] for point in moved["points"]) > 10
        corrected.append(out)
    model = folder / "model.csv"
    relative = said(capsys, "orient", "pair", *corrected, "--c", C_MM, "--out", model)
    assert relative["redundancy"] == 13 and 0.0008 < relative["sigma0_mm"] < 0.004
    control = pair.write("control.csv", "point,X,Y,Z", pair.names[:5], pair.X[:5])
    placed = said(capsys, "orient", "absolute", model, control, "--out", folder / "object.csv")
    moved = np.array([[point[axis] for axis in "XYZ"] for point in placed["moved"]])
    error = np.sqrt(((moved - pair.X) ** 2).mean(axis=0))
    # 2 um at 1,700 m and c 152 mm: 0.02 m in X and Y, in Z by the ratio of height and base 0.06 m
    assert (error < [0.1, 0.1, 0.2]).all() and error.max() > 0.002
    assert placed["redundancy"] == 8


def test_both_kinds_of_parameters_give_the_same_model(pair: Pair, capsys: pytest.CaptureFixture[str]) -> None:
    """After one absolute orientation each; b_x is that which is asked for."""
    tables = [
        pair.write(f"{side}.csv", "point,x_mm,y_mm", pair.names, (xy - SCAN_ORIGIN) @ np.linalg.inv(SCAN).T)
        for side, xy in zip(("left", "right"), pair.measured, strict=True)
    ]
    control = pair.write(
        "control.csv", "point,X,Y,Z,sigma", pair.names[:5], np.hstack([pair.X[:5], np.ones((5, 1))])
    )
    placed = []
    for kind in ("dependent", "independent"):
        model = pair.folder / f"{kind}.csv"
        relative = said(
            capsys, *("orient", "pair", *tables, "--c", C_MM, "--kind", kind, "--bx", 92.0, "--out", model)
        )
        base = np.linalg.norm(np.subtract(*relative["positions"]))
        assert base == pytest.approx(92.0, rel=0.01) if kind == "dependent" else base == pytest.approx(1.0)
        placed.append(said(capsys, "orient", "absolute", model, control)["moved"])
    for a, b in zip(*placed, strict=True):
        assert [a[axis] for axis in "XYZ"] == pytest.approx([b[axis] for axis in "XYZ"], abs=1e-5)


def test_a_wrong_control_point_is_the_one_without_which_the_rest_fits(
    pair: Pair, capsys: pytest.CaptureFixture[str]
) -> None:
    wrong = pair.X[:6].copy()
    wrong[2, 2] += 5.0
    model = pair.write("model.csv", "point,X,Y,Z", pair.names, 0.3 * pair.X + 1.0)
    control = pair.write(
        "control.csv", "point,X,Y,Z", [*pair.names[:6], "Q"], np.vstack([wrong, [[0, 0, 0.0]]])
    )
    placed = said(capsys, "orient", "absolute", model, control)
    without = {point["point"]: point["sigma0_without"] for point in placed["points"]}
    assert min(without, key=lambda name: without[name]) == "P2" and without["P2"] < 1e-6 < 0.5 < without["P1"]
    assert kolinear("orient", "absolute", model, control) == 0
    shown = capsys.readouterr().out
    assert "control that is not in the model: Q" in shown and "sigma0 without it" in shown


def test_points_of_one_photograph_are_named(pair: Pair, capsys: pytest.CaptureFixture[str]) -> None:
    photo = [(xy - SCAN_ORIGIN) @ np.linalg.inv(SCAN).T for xy in pair.measured]
    left = pair.write("left.csv", "point,x_mm,y_mm", pair.names[:-1], photo[0][:-1])
    right = pair.write("right.csv", "point,x_mm,y_mm", pair.names[2:], photo[1][2:])
    assert kolinear("orient", "pair", left, right, "--c", C_MM) == 0
    shown = capsys.readouterr().out
    assert "dependent relative orientation, 15 conjugate points" in shown
    assert "in one photograph only: P0, P1, P17" in shown and "sigma0" in shown


def test_bad_input_gets_one_line(pair: Pair, capsys: pytest.CaptureFixture[str]) -> None:
    photo = (pair.measured[0] - SCAN_ORIGIN) @ np.linalg.inv(SCAN).T
    left = pair.write("left.csv", "point,x_mm,y_mm", pair.names, photo)
    other = pair.write("other.csv", "point,x_mm,y_mm", [f"Q{k}" for k in range(18)], photo)
    few = pair.write("few.csv", "point,X,Y,Z", pair.names[:2], pair.X[:2])
    table = pair.folder / "radial.csv"
    table.write_text("radius_mm,distortion_mm\n5,0.001\n3,0.002\n")
    for told, *arguments in (
        ("the principal distance is missing, give --c", "pair", left, left),
        ("no point has the same name in both", "pair", left, other, "--c", C_MM),
        (
            "--kind absolute: expected dependent or independent",
            "pair",
            left,
            left,
            "--c",
            1,
            "--kind",
            "absolute",
        ),
        ("bx is 0", "pair", left, left, "--c", C_MM, "--bx", 0),
        ("2 control points of the model, at least 3 are needed", "absolute", few, few),
        ("expected ascending radii from 0", "correct", left, "--c", C_MM, "--radial", table),
        ("--curvature needs --flying-height", "correct", left, "--c", C_MM, "--curvature"),
        ("flying height nan km", "correct", left, "--c", C_MM, "--flying-height", "nan"),
        ("unknown parameter", "correct", left, "--camera", few),
        (
            "kind 'projective'",
            "fiducials",
            pair.write("m.csv", "mark,x,y,x_mm,y_mm", range(6), np.hstack([FIDUCIALS, FIDUCIALS])),
            "--kind",
            "projective",
        ),
    ):
        if told == "unknown parameter":
            camera = pair.folder / "camera.csv"
            camera.write_text("parameter,value\nc,152\nb1,0.1\n")
            arguments[-1] = camera
        assert told in refused(capsys, "orient", *arguments), told


def test_photographs_at_one_place_have_no_base(pair: Pair, capsys: pytest.CaptureFixture[str]) -> None:
    photo = (pair.measured[0] - SCAN_ORIGIN) @ np.linalg.inv(SCAN).T
    left = pair.write("left.csv", "point,x_mm,y_mm", pair.names, photo)
    assert "no base to determine" in refused(capsys, "orient", "pair", left, left, "--c", C_MM)


def test_an_existing_file_is_left_alone(pair: Pair, capsys: pytest.CaptureFixture[str]) -> None:
    model = pair.write("model.csv", "point,X,Y,Z", pair.names, pair.X)
    before = model.read_bytes()
    assert "exists already" in refused(capsys, "orient", "absolute", model, model, "--out", model)
    assert model.read_bytes() == before


def photographs(X: FloatArray, noise: str) -> tuple[FloatArray, FloatArray]:
    """Return the photo coordinates of points in two photographs, the second to the right, mm."""
    rng = seed_of(noise)
    stations = [
        (np.array([100.0, 0, 1500]), rotation_from_angles(0.017, 0.035, 0.052)),
        (np.array([700.0, 20, 1520]), rotation_from_angles(-0.017, 0.017, 0.087)),
    ]
    first, second = (
        compute_photo_coordinates(X, at, R, c_mm=C_MM) + 0.005 * rng.standard_normal((len(X), 2))
        for at, R in stations
    )
    return first, second


@pytest.mark.parametrize("seed", range(6))
def test_of_a_plane_the_orientation_with_points_in_front_is_taken(pair: Pair, seed: int) -> None:
    """The other solution of a plane often fits better, with points behind a photograph."""
    X = pair.X.copy()
    X[:, 2] = 20 + 0.1 * X[:, 0]
    first, second = (xy / C_MM for xy in photographs(X, f"plane {seed}"))
    orientation = orient_independent(first, second)
    assert np.isfinite(intersect_pair(orientation, first, second)).all() and not orientation.is_ambiguous
    assert np.degrees(np.abs(orientation.parameters)).max() < 10


def test_two_orientations_of_a_small_plane_are_said(pair: Pair, capsys: pytest.CaptureFixture[str]) -> None:
    rng = seed_of("small plane")
    X = np.column_stack([rng.uniform(700, 900, 12), rng.uniform(-100, 100, 12), np.zeros(12)])
    X[:, 2] = 0.1 * X[:, 0]
    tables = [
        pair.write(f"{side}.csv", "point,x_mm,y_mm", range(12), xy)
        for side, xy in zip("lr", photographs(X, "small"), strict=True)
    ]
    assert kolinear("orient", "pair", *tables, "--c", C_MM) == 0
    assert "another orientation fits as well" in capsys.readouterr().out
    assert said(capsys, "orient", "pair", *tables, "--c", C_MM)["is_ambiguous"] is True


def test_five_points_and_a_wrong_sign_of_bx_are_refused(
    pair: Pair, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = photographs(pair.X, "order")
    left, right = (
        pair.write(f"{side}.csv", "point,x_mm,y_mm", pair.names, xy)
        for side, xy in (("l", first), ("r", second))
    )
    few = [
        pair.write(f"{k}.csv", "point,x_mm,y_mm", pair.names[:5], xy[:5])
        for k, xy in enumerate((first, second))
    ]
    assert "5 pairs, at least 6" in refused(capsys, "orient", "pair", *few, "--c", C_MM)
    assert "the other sign" in refused(capsys, "orient", "pair", right, left, "--c", C_MM)
    assert "the other sign" in refused(capsys, "orient", "pair", left, right, "--c", C_MM, "--bx", -1)
    assert "bx is nan" in refused(capsys, "orient", "pair", left, right, "--c", C_MM, "--bx", "nan")
    model = pair.folder / "turned.csv"
    turned = said(capsys, "orient", "pair", right, left, "--c", C_MM, "--bx", -600, "--out", model)
    assert all(point["Z"] < 0 for point in turned["points"])


def test_a_model_has_only_points_with_a_place(pair: Pair, capsys: pytest.CaptureFixture[str]) -> None:
    """A pair of rays that meet behind the photographs gives no row, so that the model can be read."""
    first, second = photographs(pair.X, "behind")
    second[3, 0] = first[3, 0] + 20.0  # parallax of the other sign
    left, right = (
        pair.write(f"{side}.csv", "point,x_mm,y_mm", pair.names, xy)
        for side, xy in (("l", first), ("r", second))
    )
    model = pair.folder / "model.csv"
    assert kolinear("orient", "pair", left, right, "--c", C_MM, "--out", model) == 0
    assert "no place in front of both photographs: P3" in capsys.readouterr().out
    written = model.read_text()
    assert "P3," not in written and "P4," in written


def test_a_model_of_the_other_hand_is_said(pair: Pair, capsys: pytest.CaptureFixture[str]) -> None:
    """Control of which two columns are exchanged; without one point the rest seemed to fit."""
    model = pair.write("model.csv", "point,X,Y,Z", pair.names, 0.3 * pair.X + 1.0)
    noisy = pair.X[:6] + 0.05 * seed_of("control").standard_normal((6, 3))
    control = pair.write("control.csv", "point,Y,X,Z", pair.names[:6], noisy)
    assert kolinear("orient", "absolute", model, control) == 0
    assert "the mirrored model fits with sigma0 0.0" in capsys.readouterr().out
    right = pair.write("right.csv", "point,X,Y,Z", pair.names[:6], noisy)
    flat = pair.write("flat.csv", "point,X,Y,Z", pair.names, pair.X * [1, 1, 0])
    for tables in ((model, right), (model, model), (flat, flat)):
        assert kolinear("orient", "absolute", *tables) == 0
        assert "mirrored" not in capsys.readouterr().out


def test_control_on_a_line_but_for_one_point(pair: Pair, capsys: pytest.CaptureFixture[str]) -> None:
    """The orientation is determined, that without the one point is not."""
    X = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [1, 2, 0]])
    control = pair.write("control.csv", "point,X,Y,Z", "ABCDE", X)
    placed = said(capsys, "orient", "absolute", control, control)
    assert [point["sigma0_without"] is None for point in placed["points"]] == [False] * 4 + [True]


def test_rows_of_a_scan_need_the_affine_transformation(
    pair: Pair, capsys: pytest.CaptureFixture[str]
) -> None:
    marks = pair.write(
        "marks.csv", "mark,x,y,x_mm,y_mm", range(6), np.hstack([scanned(FIDUCIALS), FIDUCIALS])
    )
    assert kolinear("orient", "fiducials", marks, "--kind", "similarity") == 0
    assert "with one axis reversed sigma0 is" in capsys.readouterr().out
    assert kolinear("orient", "fiducials", marks) == 0
    assert "--kind" not in capsys.readouterr().out
    out = pair.folder / "mm.csv"
    assert "expected --points" in refused(capsys, "orient", "fiducials", marks, "--out", out)
    assert not out.exists()
