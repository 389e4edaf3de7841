"""`import sfm`: the list of public names, their examples, and a survey from Python from start to end."""

from __future__ import annotations

import doctest
import inspect
import json
import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import sfm
from adapters.colmap.camera_models import write_model
from sfm.comparison.camera_conversion import convert_cameras
from sfm.files import csv_tables
from sfm.judgement.survey_result import SurveyResult
from sfm.model.errors import UnknownNameError
from tests.places import ROOMS
from tests.surveys import write_observed_survey, write_photograph_survey
from tests.synthetic import make_network, seed_of

ROOT = Path(sfm.__file__).resolve().parent
PUBLIC = {
    *(
        "Adjustment",
        "AdjustmentOptions",
        "Camera",
        "CameraSetup",
        "Datum",
        "Estimate",
        "KnownPoints",
        "KolinearError",
        "Network",
    ),
    *(
        "OrientSettings",
        "Observations",
        "ObservationTable",
        "ObservedExterior",
        "PairList",
        "ScaleBar",
        "Similarity",
        "Solution",
        "Survey",
        "SurveyResult",
    ),
    *(
        "Targets",
        "adjust",
        "empty_estimate",
        "camera_from_values",
        "change_datum",
        "compare",
        "distance",
        "find_targets",
        "fit_shape",
        "helmert_blocks",
        "measure",
        "fit_similarity",
        "network_from_colmap",
        "project",
    ),
    *(
        "OrientSettings",
        "orient",
        "CameraFile",
        "read_cameras",
        "write_cameras",
        "read_photograph",
        "read_result",
        "read_survey",
        "run_survey",
        "write_result",
    ),
}


@pytest.fixture(scope="module")
def observed_survey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = write_observed_survey(tmp_path_factory.mktemp("public") / "observed", "observed")
    bar = '[[scale_bar]]\nfrom = "1"\nto = "2"\nlength = 1.0\nsigma = 0.1\n'
    path.write_text(path.read_text(encoding="utf-8") + bar, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def result(observed_survey: Path) -> SurveyResult:
    return sfm.run_survey(sfm.read_survey(observed_survey), compare_with="none")


@pytest.fixture(scope="module")
def result_folder(result: SurveyResult, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return result.write(tmp_path_factory.mktemp("public") / "out").parent


@pytest.fixture(scope="module")
def colmap_model(result: SurveyResult, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("colmap")
    estimate, _ = convert_cameras(result.estimate, ("full_opencv",))
    write_model(folder, result.network, estimate)
    return folder


@pytest.fixture(scope="module")
def photograph_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_photograph_survey(tmp_path_factory.mktemp("photo") / "s", "s").parent / "photo 1.png"


def test_the_public_names_are_these() -> None:
    rooms = {*ROOMS, "camera", "conventions"}
    assert set(sfm.__all__) == set(dir(sfm)) == PUBLIC | rooms
    assert all(inspect.ismodule(getattr(sfm, name)) for name in rooms)
    assert (ROOT / "py.typed").is_file()
    with pytest.raises(AttributeError, match="no attribute 'adjusted'"):
        sfm.adjusted  # noqa: B018


@pytest.mark.parametrize("name", sorted(PUBLIC))
def test_every_public_name_is_explained_and_its_example_runs(
    name: str,
    observed_survey: Path,
    result_folder: Path,
    result: SurveyResult,
    colmap_model: Path,
    photograph_file: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(ROOT.parent)
    value = getattr(sfm, name)
    assert inspect.getdoc(value), f"{name} has no docstring"
    given = {
        **vars(sys.modules[value.__module__]),
        "sfm": sfm,
        "np": np,
        "observed_survey": observed_survey,
        "result_folder": result_folder,
        "result": result,
        "colmap_model": colmap_model,
        "photograph_file": photograph_file,
    }
    finder = doctest.DocTestFinder(recurse=False)
    examples = [one for one in finder.find(value, name, globs=given) if one.examples]
    assert examples or name in ("KolinearError", "Targets", "Camera"), f"{name} has no example"
    for example in examples:
        assert doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(example).failed == 0


def test_what_the_page_on_python_shows_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first Python block of docs/how-to/python.md, on a survey of rendered photographs."""
    path = write_photograph_survey(tmp_path / "page", "page", suffix=".jpg")
    folder = path.parent
    bar = '[[scale_bar]]\nfrom = "{}"\nto = "{}"\nlength = 100.0\nsigma = 0.1\n'
    first = sfm.run_survey(sfm.read_survey(path), compare_with="none")
    names = first.points.names
    path.write_text(path.read_text(encoding="utf-8") + bar.format(*names[:2]), encoding="utf-8")
    monkeypatch.chdir(folder)
    (folder / "photo 1.jpg").rename(folder / "a.jpg")
    first.write("out/last")
    page = (ROOT.parent / "docs" / "how-to" / "python.md").read_text(encoding="utf-8")
    code = page[page.index("```python\n") + len("```python\n") :].split("```")[0]
    assert "sfm.change_datum(again" in code and "result.write(" in code
    for shown, own in zip(("501", "502", "503", "506"), names, strict=False):
        code = code.replace(f'"{shown}"', f'"{own}"')
    try:
        import pandas  # noqa: F401
    except ImportError:
        code = code.replace("result.points.to_pandas()", "")
    given: dict[str, object] = {}
    exec(compile(code, "python.md", "exec"), given)
    moved = given["moved"]
    assert isinstance(moved, sfm.Adjustment) and moved.datum == "minimal"
    assert (folder / "out" / "today" / "report.html").is_file()


def test_a_bad_survey_prints_what_the_page_on_python_shows(capsys: pytest.CaptureFixture[str]) -> None:
    """Verdict and remarks as they are; further figures without their digits."""
    network, _ = make_network(seed_of("arrays"), images=6, points=30, noise_px=0.1)
    seen = network.image_points
    given = {
        "image": [network.images[i] for i in seen.image],
        "point": [str(j + 1) for j in seen.point],
        "xy": seen.xy,
    }
    page = (ROOT.parent / "docs" / "how-to" / "python.md").read_text(encoding="utf-8")
    code, rest = page.split("```python\n")[3].split("```", 1)
    capsys.readouterr()
    exec(compile(code, "python.md", "exec"), given)
    printed = capsys.readouterr().out.splitlines()
    shown = rest.split("```text\n")[1].split("```")[0].splitlines()
    verdict = printed.index("The survey has no dependable result.")
    assert (printed[0], printed[verdict:]) == (shown[0], shown[verdict:])
    without = [re.sub(r"\d+", "0", " ".join("\n".join(lines).split())) for lines in (printed, shown)]
    assert without[0] == without[1]


def test_a_survey_made_in_python_is_that_of_its_file(observed_survey: Path, result: SurveyResult) -> None:
    said = sfm.read_survey(observed_survey)
    given = said.observations
    assert given is not None
    camera = dict(said.cameras[0])
    made = sfm.Survey(
        name=said.name,
        unit=said.unit,
        cameras=[sfm.CameraSetup(**{**camera, "size_px": np.array(camera["size_px"])})],  # type: ignore[arg-type]
        observations=sfm.Observations.from_arrays(given.image, given.point, given.xy),
        scale_bars=[sfm.ScaleBar("1", "2", 1.0, 0.1)],  # type: ignore[arg-type]
    )
    again = sfm.run_survey(made, compare_with="none")
    for one, other in ((again, result),):
        np.testing.assert_array_equal(one.points.xyz, other.points.xyz)
        np.testing.assert_array_equal(one.points.covariance, other.points.covariance)
        assert one.remarks == other.remarks


def test_photographs_of_a_survey_made_in_python(tmp_path: Path) -> None:
    path = write_photograph_survey(tmp_path / "s", "s")
    camera = sfm.CameraSetup(name="small", images="*.png", pixel_mm=[0.01, 0.01], c_mm=8.0, free=["c"])
    made = sfm.Survey(
        name="s",
        unit="mm",
        cameras=[camera],  # type: ignore[arg-type]
        targets={"polarity": "dark", "codes": "ring14"},  # type: ignore[arg-type]
        folder=path.parent,
    )
    a = sfm.run_survey(made, compare_with="none", store=tmp_path / "store")
    b = sfm.run_survey(sfm.read_survey(path), compare_with="none", store=tmp_path / "store")
    np.testing.assert_array_equal(a.points.xyz, b.points.xyz)
    assert sfm.compare(a, b).same_share == 1


@pytest.mark.parametrize(
    ("wrong", "match"),
    [
        ({"cameras": []}, "survey s: no cameras"),
        (
            {"targets": {"polarity": "grey"}},
            r"survey s: targets: polarity: found 'grey', needed one of 'dark'",
        ),
        ({"targets": {"code": "x"}}, r"survey s: targets: unknown key 'code' in it, known are codes"),
        ({"targets": "ring14"}, "survey s: targets: found 'ring14', needed settings as in the survey file"),
        ({"name": "a\nb"}, "needed plain text"),
        ({"datum": {"kind": "control"}}, "datum kind 'control' needs"),
    ],
)
def test_what_is_wrong_in_a_survey_made_in_python_is_one_line(wrong: dict[str, object], match: str) -> None:
    camera = sfm.CameraSetup(name="one", images="*.jpg")
    with pytest.raises(sfm.KolinearError, match=match) as caught:
        sfm.Survey(**{"name": "s", "cameras": [camera], **wrong})  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: sfm.CameraSetup(name="one", c_mm=-1.0), "camera one: c_mm: found -1.0, needed more than 0"),
        (
            lambda: sfm.KnownPoints.from_arrays(["1", "1"], np.zeros((2, 3))),
            "control, row 2: id '1' is on",
        ),
        (
            lambda: sfm.KnownPoints.from_arrays(["1"], [[0, 0, np.inf]]),
            "row 1: column Z contains inf",
        ),
        (lambda: sfm.KnownPoints.from_arrays(["1"], [[0, 0]]), r"X, Y, Z have the shape \(1, 2\), expected"),
        (lambda: sfm.KnownPoints.from_arrays(["1"], np.zeros((1, 3)), -1), "column sX contains -1, needed 0"),
        (lambda: sfm.Observations.from_arrays(["a"], ["1", "2"], [[1, 2]]), "2 values of point, expected 1"),
        (
            lambda: sfm.Observations.from_arrays(["a"], ["1"], [[1, 2]], unit="m"),
            "unit 'm', expected px or mm",
        ),
        (
            lambda: sfm.PairList.from_arrays(["a", "b"], ["b", "a"]),
            "pairs, row 2: image 'a', other 'b'",
        ),
        (lambda: sfm.PairList.from_arrays(["a"], []), "pairs: 0 values of other, expected 1"),
        (lambda: sfm.ObservedExterior.from_arrays(["a"], [[0, 0, 0]], -1), "column sX contains -1"),
        (lambda: sfm.ScaleBar("1", "2", -1.0, 0.1), "scale bar 1 - 2: length -1.0, needed more than 0"),
        (lambda: sfm.Network.from_arrays(["a"], ["1"], [1, 2]), "expected k names, k names and finite"),
        (lambda: sfm.run_survey("s", compare_with="x"), "compare_with 'x', expected one of colmap, none"),
    ],
)
def test_bad_arrays_are_refused(make: object, match: str) -> None:
    with pytest.raises(sfm.KolinearError, match=match):
        make()  # type: ignore[operator]


def test_networks_from_arrays_are_adjusted(result: SurveyResult) -> None:
    seen = result.solution.network.image_points
    network = sfm.Network.from_arrays(
        [result.network.images[i] for i in seen.image],
        [result.network.points[j] for j in seen.point],
        seen.xy,
        sigma_px=np.sqrt(np.einsum("kii->ki", seen.covariance)),
    ).with_scale_bar("1", "2", 1.0, 0.1)
    assert network.points == result.network.points
    again = sfm.adjust(network, result.estimate, reject="none")
    np.testing.assert_allclose(again.estimate.points, result.points.xyz, atol=1e-6)


def test_names_are_indices(result: SurveyResult) -> None:
    table = result.points
    assert table["3"].name == "3" and "3" in table and len(table[["1", "3"]]) == 2
    np.testing.assert_array_equal(table[table.rays >= 2].xyz, table.xyz)
    np.testing.assert_array_equal(result.point("3").xyz, table[table.index("3")].xyz)
    assert result.image("image 1").rotation.shape == (3, 3)
    assert result.camera("synthetic").model == "brown"
    for ask in (result.point, result.image, result.camera):
        with pytest.raises(UnknownNameError, match="'<x>', expected one of"):
            ask("<x>")


def test_a_network_from_arrays_becomes_a_solution_as_the_page_on_python_shows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Image points, orientation, adjustment, covariance of a distance, written, read and compared."""
    network, truth = make_network(seed_of("arrays"), images=6, points=30, noise_px=0.1)
    seen = network.image_points
    names = {network.images[0]: "a.jpg"}
    given = {
        "image": [names.get(network.images[i], network.images[i]) for i in seen.image],
        "point": [str(j + 1) for j in seen.point],
        "xy": seen.xy,
    }
    page = (ROOT.parent / "docs" / "how-to" / "python.md").read_text(encoding="utf-8")
    code = page.split("```python\n")[2].split("```")[0]
    assert code.count("sfm.camera_from_values(") == 1 and "solution.write(" in code
    code = re.sub(r"sfm\.camera_from_values\([^)]*\)[^)]*\)[^)]*\)", "lens", code)
    monkeypatch.chdir(tmp_path)
    given["lens"] = truth.cameras[0]
    exec(compile(code, "python.md", "exec"), given)
    a, C, again = given["adjustment"], given["C"], given["again"]
    assert a.converged and 0.8 < a.sigma0 < 1.2
    np.testing.assert_allclose(C[:3, :3], a.covariance.points[a.network.point_index("1")], rtol=1e-6)
    of_first = a.covariance.exterior[a.network.image_index("a.jpg")]
    np.testing.assert_allclose(C[6:, 6:], of_first, rtol=1e-6, atol=1e-6 * np.abs(of_first).max())
    np.testing.assert_allclose(C, C.T, atol=1e-9 * np.abs(C).max())
    assert np.linalg.eigvalsh(C / np.sqrt(np.outer(np.diag(C), np.diag(C)))).min() > -1e-9
    assert sfm.distance(again, "1", "3") == pytest.approx(sfm.distance(a, "1", "3"), rel=1e-6)
    np.testing.assert_allclose(again.covariance_of((), ["a.jpg"]), of_first)
    with pytest.raises(sfm.KolinearError, match="joint covariance"):
        again.covariance_of(["1"], ["a.jpg"])


def test_the_version_is_that_of_the_installation() -> None:
    assert sfm.__version__.count(".") == 2


def test_notebooks_show_tables_in_which_names_are_escaped(result: SurveyResult) -> None:
    assert "sigma0" in repr(result) and "<table>" in result._repr_html_()
    point = sfm.Solution("<script>", result.network, result.estimate)
    assert "<script>" not in point._repr_html_() and "&lt;script&gt;" in point._repr_html_()
    assert repr(result.points).splitlines()[1].split() == ["point", "X", "Y", "Z", "sX", "sY", "sZ", "rays"]
    short = (result.network, result.estimate, result.adjustment, result.point("1"), result.solution)
    for value in (*short, sfm.compare(result, result)):
        assert 20 < len(repr(value)) < 500, type(value)


def test_a_pycolmap_reconstruction_is_a_network(result: SurveyResult, colmap_model: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    network, found = sfm.network_from_colmap(pycolmap.Reconstruction(str(colmap_model)))
    assert network.images == result.network.images
    np.testing.assert_allclose(found.points, result.points.xyz, atol=1e-9)
    named, _ = sfm.network_from_colmap(colmap_model)
    assert named.points == result.network.points


def test_every_table_of_a_survey_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_observed_survey(tmp_path / "s", "s")
    first = sfm.run_survey(sfm.read_survey(path), compare_with="none")
    first.write(tmp_path / "out")
    text = path.read_text(encoding="utf-8")
    for name in ("images", "points"):
        (path.parent / f"{name}.csv").write_bytes((tmp_path / "out" / f"{name}.csv").read_bytes())
    rows = "".join(f"{p.name},{','.join(repr(float(v)) for v in p.xyz)}\n" for p in first.points)
    (path.parent / "control.csv").write_text(f"id,X,Y,Z\n{rows}", encoding="utf-8")
    (path.parent / "diameters.csv").write_text("id,diameter\n1,0.1\n", encoding="utf-8")
    text += (
        '[control]\nfile = "control.csv"\n[exterior]\nfile = "images.csv"\n[targets]\n'
        'diameters = "diameters.csv"\n'
        '[approximate]\npoints = "points.csv"\n[datum]\nkind = "control"\n'
    )
    path.write_text(text, encoding="utf-8")
    opened: list[str] = []
    original = csv_tables._rows

    def counted(file: Path, columns: int) -> object:
        opened.append(file.name)
        return original(file, columns)

    monkeypatch.setattr(csv_tables, "_rows", counted)
    sfm.run_survey(sfm.read_survey(path), compare_with="none")
    assert sorted(opened) == ["control.csv", "diameters.csv", "image_points.csv", "images.csv", "points.csv"]


@pytest.mark.parametrize("file", ["sfm/binarysearch.py", "adapters/composition.py"])
def test_files_of_another_project_are_noticed(tmp_path: Path, file: str) -> None:
    """Copies of our packages beside a planted file, as two installations in one environment would leave."""
    for package in ("sfm", "adapters"):
        (tmp_path / package).mkdir()
        for source in (ROOT.parent / package).rglob("*.py*"):
            if source.suffix not in (".py", ".pyi"):
                continue
            copy = tmp_path / source.relative_to(ROOT.parent)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(source.read_bytes())
    told = [sys.executable, "-I", "-c", f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import sfm"]
    assert subprocess.run(told, capture_output=True, check=False).returncode == 0
    (tmp_path / file).write_text("", encoding="utf-8")
    failed = subprocess.run(told, capture_output=True, text=True, check=False)
    last = failed.stderr.strip().splitlines()[-1]
    assert failed.returncode == 1 and "InstallationError" in last
    assert file in last and "a separate environment" in last
    command = told[3].replace("import sfm", "sys.argv = ['kolinear', '--help']; import sfm.cli")
    line = subprocess.run([*told[:3], command], capture_output=True, text=True, check=False)
    assert line.returncode == 2 and line.stderr.count("\n") == 1 and line.stderr.startswith("kolinear: ")
    (tmp_path / "sfm" / "__init__.py").write_text("", encoding="utf-8")  # the other one was installed last
    line = subprocess.run(
        [*told[:3], command.replace("sfm.cli", "sfm.cli; sfm.cli.main()")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert line.returncode == 2 and line.stderr.count("\n") == 1 and "a separate environment" in line.stderr


READ = "import sfm; print(sfm.read_result(sys.argv[1]).points.xyz.shape[0])"


@pytest.mark.sweep(0)
@pytest.mark.parametrize("regular", [True, False])
def test_a_folder_called_adapters_beside_a_script_is_not_taken_for_ours(
    tmp_path: Path, result_folder: Path, result: SurveyResult, regular: bool
) -> None:
    (tmp_path / "adapters").mkdir()
    (tmp_path / "adapters" / "mine.py").write_text("VALUE = 1", encoding="utf-8")
    if regular:
        (tmp_path / "adapters" / "__init__.py").write_text("", encoding="utf-8")
    script = tmp_path / "script.py"

    def run(text: str) -> subprocess.CompletedProcess[str]:
        script.write_text(f"import sys; {text}", encoding="utf-8")
        command = [sys.executable, str(script), str(result_folder)]
        return subprocess.run(command, capture_output=True, text=True, check=False)

    found = run(READ)
    assert found.stdout.split() == [str(len(result.points))], found.stderr
    if regular:  # which is the user's own, whatever the place of ours in the search path
        refused = run(f"import adapters.mine; {READ}")
        last = refused.stderr.strip().splitlines()[-1]
        assert "InstallationError" in last and str(tmp_path / "adapters") in last


def test_photographs_and_targets_are_arrays(tmp_path: Path) -> None:
    folder = write_photograph_survey(tmp_path / "s", "s", photographs=1).parent
    photograph = sfm.read_photograph(folder / "photo 1.png")
    found = sfm.find_targets(photograph, codes="ring14")
    assert found.xy.shape == (len(found), 2) and (found.code >= 0).sum() >= 5
    with pytest.raises(sfm.KolinearError, match="expected"):
        sfm.find_targets(cv2.cvtColor(photograph, cv2.COLOR_GRAY2BGR))
    with pytest.raises(sfm.KolinearError, match="polarity"):
        sfm.find_targets(photograph, polarity="grey")


def test_summary_of_a_written_result_is_read_back(result: SurveyResult, result_folder: Path) -> None:
    stored = sfm.read_result(result_folder)
    np.testing.assert_array_equal(stored.points.xyz, result.points.xyz)
    np.testing.assert_allclose(stored.points.sigma, result.points.sigma, rtol=1e-12)
    assert json.loads((result_folder / "summary.json").read_text(encoding="utf-8"))["survey"] == result.name


NOT_IN_THE_TABLE = {
    "allow_outside",
    "photographs",
    "source",
    "copied",
    "other_moments",
    "refused",
    "marked_hashes",
    "equipment",
    "diameters",
    "start_orientations",
    "start_cameras",
}


def test_the_table_of_the_page_on_python_has_every_part_of_a_survey() -> None:
    """Each cell is an argument of `sfm.Survey` that is accepted; rigs and tables were missing."""
    page = (ROOT.parent / "docs" / "how-to" / "python.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\|[^|]+\| `([a-z_]+=.*)` \|$", page, re.MULTILINE)
    xyz, sigma = np.zeros((1, 3)), np.full((1, 3), 1e-3)
    given: dict[str, Any] = {"sfm": sfm, "xyz": xyz, "sigma": sigma, "names": ["1"], "images": ["a.jpg"]}
    given |= {"points": ["1"], "xy": np.zeros((1, 2))}
    known, found = dict[str, Any](), set[str]()
    for row in rows:
        values = eval(f"dict({row})", dict(given))
        found |= set(values)
        known |= {name: value for name, value in values.items() if name in ("name", "unit", "cameras")}
    assert found | NOT_IN_THE_TABLE == {one.name for one in fields(sfm.Survey)}
    right = {"name": "right", "images": "r*.png", "c_mm": 24.0}
    pair = [{**right, "name": "left", "images": "l*.png"}, right]
    for row in rows:
        values = eval(f"dict({row})", dict(given))
        if "rigs" in values or "mounts" in values or "moments" in values:
            values = {"rigs": [{"name": "pair", "cameras": ["left", "right"], "moment": "order"}], **values}
            values["cameras"] = pair
        if "plates" in values:
            first = {"codes": "asymmetric-grid", "rows": 7, "columns": 5, "pitch": 10.0}
            values = {"targets": first, **values}
        sfm.Survey(**{**known, **values})
