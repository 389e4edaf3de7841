"""`kolinear measure`: what a features file asks for, from a simulated network to the page."""

from __future__ import annotations

import json
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from adapters.formats.mesh import read_mesh
from adapters.formats.result_tables import write_tables
from sfm.cli.app import app
from sfm.model.errors import KolinearError
from sfm.model.remarks.remark import kinds_of
from sfm.model.solution import Solution
from sfm.products.inspection.features_file import FeaturesFile, HeldSettings, read_features_file
from sfm.products.inspection.measurement import Measurement, measure_result
from sfm.products.inspection.page import describe_measured
from sfm.report.pages import write_page
from tests.places import ROOT
from tests.products.inspection.benches import (
    DIAMETERS,
    FOCAL_LENGTH,
    HEIGHT,
    object_points,
    one_bench,
    without_covariance,
)
from tests.tables import rows_of

SHAPES = """
[[group]]
name = "plate"
points = ["p1-99", "p*"]
[[shape]]
name = "base"
kind = "plane"
points = "plate"
[[shape]]
name = "flange"
kind = "circle"
points = "c*"
[[shape]]
name = "pipe"
kind = "cylinder"
points = "z*"
[[shape]]
name = "dish"
kind = "paraboloid"
points = ["d?", "d??"]
"""
FEATURES = (
    SHAPES.replace('["p1-99", "p*"]', '["p*"]')
    + """
[alignment]
method = "features"
z_axis = "base"
x_axis = ["p3", "p23"]
origin = "flange"
[[hidden_point]]
name = "tip"
from = "p1"
to = "p2"
distance = 0.25
sigma = 1e-5
[[distance]]
name = "flange over plate"
from = "flange"
to = "base"
[[distance]]
name = "probe"
from = "p2"
to = "tip"
[[angle]]
name = "squareness"
between = ["base", "pipe"]
[[angle]]
name = "corner"
at = "p1"
between = ["p5", "p21"]
[[height]]
name = "rim"
above = "base"
points = ["c1", "c2"]
[[tolerance]]
name = "flatness"
shape = "base"
upper = 0.001
[[tolerance]]
name = "drawing"
nominal = "nominal.csv"
upper = 0.001
[[tolerance]]
name = "slab"
mesh = "slab.stl"
points = "plate"
upper = 0.001
"""
)
SLAB = (
    "solid s\n"
    + "".join(
        "facet normal 0 0 1\nouter loop\n"
        + "".join(f"vertex {x} {y} 0\n" for x, y in corners)
        + "endloop\nendfacet\n"
        for corners in (((-1, -1), (1, -1), (1, 1)), ((-1, -1), (1, 1), (-1, 1)))
    )
    + "endsolid s\n"
)


def features_folder(folder: Path, text: str = FEATURES) -> Path:
    names, xyz = object_points()
    rows = [f"{n},{x},{y},{z}" for n, (x, y, z) in zip(names, xyz.tolist(), strict=True)]
    (folder / "nominal.csv").write_text(
        "id,X,Y,Z\n" + "\n".join([*rows, "nowhere,1,2,3"]) + "\n", encoding="utf-8"
    )
    (folder / "slab.stl").write_text(SLAB, encoding="utf-8")
    path = folder / "features.toml"
    path.write_text(text, encoding="utf-8")
    return path


def measured(folder: Path, text: str, result: Solution | None = None) -> Measurement:
    features, paths = read_features_file(features_folder(folder, text))
    return measure_result(result or one_bench(), features, paths=paths, read_mesh=read_mesh)


def test_everything_is_measured_within_its_standard_deviations(tmp_path: Path) -> None:
    found = measured(tmp_path, FEATURES)
    base, flange, pipe, dish = found.shapes
    for fit, name, truth in (
        (flange, "diameter", DIAMETERS["flange"]),
        (pipe, "diameter", DIAMETERS["pipe"]),
        (dish, "focal_length", FOCAL_LENGTH),
    ):
        assert abs(fit.value(name) - truth) < 4 * fit.sigma_of(name) < 1e-3
        assert fit.fits
    values = {one.name: one for one in found.quantities}
    truths = {"flange over plate": HEIGHT, "probe": 0.25, "rim c1": HEIGHT}
    for name, truth in {**truths, "squareness": np.pi / 2, "corner": np.pi / 2}.items():
        one = values[name]
        assert abs(one.value - truth) < 4 * one.sigma and one.remarks == (), name
    assert values["probe"].sigma == pytest.approx(1e-5, rel=1e-6)
    # the system: the plate at Z = 0, the flange's centre on the Z axis
    np.testing.assert_allclose(flange.function.value[:2], 0, atol=1e-9)
    np.testing.assert_allclose(base.shape.axis, [0, 0, 1], atol=1e-9)
    assert [one.count("in") for one in found.tolerances] == [25, 85, 25]
    assert found.tolerances[1].missing == ("nowhere",) and found.verdict.level == "fair"
    assert kinds_of(found.verdict.remarks) == ("nominal_missing",)
    assert describe_measured(found).startswith("135 deviations judged by ISO 14253-1: 135 in")
    groups = dict(found.groups)
    assert len(groups["plate"]) == 25 and found.group_of(int(groups["plate"][0])) == "plate"


def test_tolerances_decide(tmp_path: Path) -> None:
    text = SHAPES.replace('"p1-99", ', "") + '[[tolerance]]\nname = "flat"\nshape = "base"\nupper = {}\n'
    tight = measured(tmp_path, text.format(1e-7)).tolerances[0]
    fair = measured(tmp_path, text.format(1.5e-4)).tolerances[0]
    assert tight.count("in") == 0 and tight.count("undecided") + tight.count("out") == 25
    assert fair.count("undecided") > 0 and fair.count("in") > 0
    text = text.format(1.0).replace("[[group]]", '[measure]\nweights = "equal"\n[[group]]', 1)
    bare = measured(tmp_path, text, without_covariance(one_bench()))
    assert bare.tolerances[0].count("not known") == 25 and bare.verdict.level == "fair"
    assert kinds_of(bare.verdict.remarks)[:2] == ("tolerance_unknown", "no_precision")


def test_a_free_network_has_remarks_where_its_datum_counts(tmp_path: Path) -> None:
    result = replace(one_bench(), unit="network units")
    found = measured(tmp_path, '[[distance]]\nname = "d"\nfrom = "p1"\nto = "p2"\n', result)
    assert kinds_of(found.quantities[0].remarks) == ("datum_dependent",)
    assert kinds_of(found.remarks) == ("network_units",)
    single = measured(
        tmp_path, '[[distance]]\nname = "d"\nfrom = "p1"\nto = "p2"\n', replace(result, covariance=None)
    )
    assert "covariance_incomplete" in kinds_of(single.remarks)


def test_targets_stand_off_on_the_side_of_the_cameras(tmp_path: Path) -> None:
    text = SHAPES.replace('"p1-99", ', "").replace('points = "plate"', 'points = "plate"\noffset = 0.01')
    base = measured(tmp_path, text).shapes[0]
    below = base.shape.origin - one_bench().estimate.points[:41].mean(axis=0)
    assert base.shape.origin[2] == pytest.approx(
        one_bench().estimate.points[16:41, 2].mean() - 0.01, abs=1e-4
    )
    assert base.rms < 1e-3 and below[2] < 0
    text = SHAPES.replace('"p1-99", ', "").replace(
        'points = "c*"', 'points = "c*"\noffset = 0.01\nside = "d1"'
    )
    flange = measured(tmp_path, text).shapes[1]
    assert flange.shape.origin[2] == pytest.approx(HEIGHT + 0.01, abs=1e-3)
    pipe = SHAPES.replace('"p1-99", ', "").replace('points = "z*"', 'points = "z*"\noffset = 0.01')
    with pytest.raises(
        KolinearError, match=r"shape pipe: offset: .* of the rays come from one side; needed side"
    ):
        measured(tmp_path, pipe)  # without a plate in the way they come from all round


def test_the_folder_holds_tables_drawing_and_page(tmp_path: Path) -> None:
    result = one_bench()
    write_tables(tmp_path / "result", result)
    features = features_folder(tmp_path)
    out = tmp_path / "out"
    words = ["measure", str(tmp_path / "result"), "--features", str(features), "--out", str(out)]
    told = CliRunner().invoke(app, words)
    assert told.exit_code == 0, told.output
    assert (
        "cylinder pipe: radius 0.1" in told.output
        and "squareness (angle between base and pipe): " in told.output
    )
    names = {path.name for path in out.iterdir()}
    assert names == {
        *(
            "points.csv",
            "shapes.csv",
            "shape_points.csv",
            "quantities.csv",
            "deviations.csv",
            "measurement.json",
        ),
        *("measurement.html", "measurement.dxf", "points.ply", "point_covariance.npy", "manifest.json"),
    }
    rows = rows_of(out / "deviations.csv")
    assert len(rows) == 135 and {row["decision"] for row in rows} == {"in"}
    summary = json.loads((out / "measurement.json").read_text(encoding="utf-8"))
    assert summary["tolerances"][0]["in"] == 25 and len(summary["shapes"]) == 4
    page = (out / "measurement.html").read_text(encoding="utf-8")
    assert "flatness" in page and 'id="explore"' in page
    again = CliRunner().invoke(app, words)
    assert again.exit_code == 0


def test_a_result_without_features_gives_its_points(tmp_path: Path) -> None:
    found = measure_result(one_bench())
    assert describe_measured(found) == "85 points." and found.verdict.level == "good"
    page = write_page(found, tmp_path / "out", result=one_bench())
    assert page.is_file()


SHAPE = "[[shape]]\nname = 'x'\n"
TOLERANCE = "[[tolerance]]\nname = 't'\n"
BAD = {
    SHAPE + "kind = 'ball'\npoints = 'c*'\n": "line 3: shape 1.kind: found 'ball', needed one of",
    "[[shapes]]\n": "unknown key 'shapes' in the file, known are measure, group",
    SHAPE + "kind = 'plane'\npoints = 'q*'\n": r"shape x: 'q\*' matches no point",
    SHAPE + "kind = 'circle'\npoints = ['p1', 'p2', 'p3']\n": "circle x: its 3 points lie on a line",
    SHAPE + "kind = 'sphere'\npoints = ['p1', 'p2', 'p3']\n": "sphere x: 3 points, a sphere needs 4",
    "[alignment]\nmethod = '3-2-1'\nplane = ['p1']\n": 'method "3-2-1" needs line',
    "[alignment]\nmethod = 'points'\nnominal = 'none.csv'\n": "none.csv: the table cannot be read",
    "[alignment]\nmethod = 'points'\nnominal = '../x.csv'\n": "leaves the",
    TOLERANCE + "upper = 1.0\n": "tolerance t: found none, needed one of shape, nominal and mesh",
    TOLERANCE + "mesh = 'slab.stl'\nupper = 1.0\n": "a mesh needs the points to be judged",
    TOLERANCE + "shape = 'x'\nupper = 1.0\n": "unknown shape 'x', expected one of none",
    TOLERANCE + "shape = 'x'\nlower = 2\nupper = 1.0\n": "lower limit 2, upper 1, needed lower below",
    "[[distance]]\nname = 'd'\nfrom = 'c1'\nto = 'c99'\n": "unknown point 'c99'",
    "[[angle]]\nname = 'a'\nbetween = ['c1', 'c2']\n": "angle a: unknown shape 'c1', expected one of none",
    2 * "[[group]]\nname = 'g'\npoints = 'p*'\n": "group 'g' is a duplicate",
}


@pytest.mark.parametrize("text", BAD)
def test_bad_input_is_one_line(text: str, tmp_path: Path) -> None:
    with pytest.raises(KolinearError, match=BAD[text]) as error:
        measured(tmp_path, text)
    assert "\n" not in str(error.value)


TEXT = (ROOT / "docs" / "measuring.md").read_text(encoding="utf-8")


def test_features_files_of_the_page_are_read_and_show_every_key(tmp_path: Path) -> None:
    shown: dict[str, set[str]] = {}
    for block in re.findall(r"```toml\n(.*?)```", TEXT, re.S):
        path = tmp_path / "features.toml"
        path.write_text(block, encoding="utf-8")
        features, paths = read_features_file(path)
        assert paths.keys() == {*features.tables(), *features.meshes()}
        for key, given in tomllib.loads(block).items():
            for one in given if isinstance(given, list) else [given]:
                shown.setdefault(key, set()).update(one)
    fields = {field.alias or name: (name, field) for name, field in FeaturesFile.model_fields.items()}
    assert shown.keys() == fields.keys()
    for key, (name, _) in fields.items():
        section = getattr(EVERY, name)
        kind = type(section[0] if isinstance(section, tuple) else section)
        assert shown[key] == {field.alias or name for name, field in kind.model_fields.items()}, key
    for name in HeldSettings.model_fields:
        assert re.search(rf"\b{name}\b", TEXT), name
    assert "measurement.html" in TEXT


BLOCK = re.findall(r"```toml\n(.*?)```", TEXT, re.S)[0]
EVERY = FeaturesFile.model_validate(tomllib.loads(BLOCK))
