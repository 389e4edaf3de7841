"""The commands view and match: one page of a result or a model, windows of points in two photographs."""

from __future__ import annotations

import base64
import gzip
import json
import re
import webbrowser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from adapters.formats.registry import write_any
from adapters.formats.result_tables import read_result
from sfm.cli.commands.view import view
from sfm.cli.matched_photographs import match_photographs
from sfm.matching.conjugate_patches import MatchSettings
from sfm.model.errors import GeometryError, OutputError, PhotographError, SurveyFileError
from sfm.pipeline import run_survey
from sfm.report.figures.overlays import LINE, MAX_PICTURES
from sfm.report.output import write_result
from sfm.report.view_page import photographs_in
from sfm.survey.inputs.survey import read_survey
from tests.findings import findings_of
from tests.surveys import write_photograph_survey
from tests.synthetic import make_network, seed_of
from tests.tables import rows_of
from tests.textures import random_texture, with_noise


@pytest.fixture(scope="module")
def result_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("view")
    survey = read_survey(write_photograph_survey(folder / "survey", "view"))
    return write_result(findings_of(run_survey(survey)), folder / "out").parent


def data_of(page: Path) -> tuple[dict[str, Any], dict[str, np.ndarray[Any, Any]]]:
    """Return header and arrays of the scene in a page."""
    (text,) = re.findall(r'id="viewer-data">([^<]*)<', page.read_text(encoding="utf-8"))
    data = gzip.decompress(base64.b64decode(text))
    header = json.loads(data[4 : 4 + int.from_bytes(data[:4], "little")])
    kinds = {"f8": "<f8", "f4": "<f4", "u4": "<u4", "u1": "|u1"}
    arrays = {
        name: np.frombuffer(data, kinds[kind], count, first)
        for name, (kind, first, count) in header["arrays"].items()
    }
    return header, arrays


def test_a_result_folder_is_shown_as_its_report_shows_it(result_folder: Path, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    view(result_folder, out=page, images=result_folder.parent / "survey", budget=15.0, browser=False)
    (own, ours), (read, theirs) = data_of(result_folder / "report.html"), data_of(page)
    assert own["points"] == read["points"] and own["photographs"] == read["photographs"]
    np.testing.assert_allclose(theirs["point.xyz"], ours["point.xyz"], rtol=1e-14)
    for name, tolerance in (("ray.v", 1e-5), ("ray.w", 1e-5), ("point.rms", 1e-6), ("point.angle", 1e-4)):
        np.testing.assert_allclose(theirs[name], ours[name], atol=tolerance, err_msg=name)
    np.testing.assert_array_equal(theirs["ray.rejected"], ours["ray.rejected"])
    np.testing.assert_allclose(theirs["pair.sigma"], ours["pair.sigma"], rtol=1e-4)
    assert len(theirs["crop.ray"]) == len(theirs["ray.point"])
    assert np.isfinite(ours["ray.ellipse"]).all()


def test_the_page_lies_beside_the_folder_and_is_replaced_only_if_it_is_ours(
    result_folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda address: bool(opened.append(address)) or True)
    page = result_folder.parent / "out.html"
    for _ in range(2):
        view(result_folder, browser=True, budget=1.0)
    assert opened == [page.as_uri()] * 2
    assert f"Page: {page}" in capsys.readouterr().out
    assert len(data_of(page)[1]["thumbnail.length"]) == 6  # of the folder pictures of the result
    page.write_text("<p>mine", encoding="utf-8")
    with pytest.raises(OutputError, match=r"out\.html: exists already and is left alone"):
        view(result_folder, browser=False, budget=1.0)
    assert page.read_text(encoding="utf-8") == "<p>mine"
    page.unlink()
    read_result(result_folder)  # nothing was added to it


def test_a_colmap_model_is_shown_with_its_residuals(tmp_path: Path) -> None:
    network, truth = make_network(seed_of("colmap view"), model="opencv", images=5, points=30, noise_px=0.5)
    write_any(tmp_path / "model", "colmap", network, truth)
    view(tmp_path / "model", browser=False, budget=15.0)
    header, arrays = data_of(tmp_path / "model.html")
    assert len(header["points"]) == 30 and header["rms_px"] == pytest.approx(0.5, rel=0.2)
    assert "pair.sigma" not in arrays and np.isnan(arrays["point.covariance"]).all()
    assert header["notes"]["no_crop"].startswith("no photograph was read")


def test_what_cannot_be_shown_is_one_clear_line(tmp_path: Path, result_folder: Path) -> None:
    with pytest.raises(SurveyFileError, match="neither a COLMAP model, nor tables"):
        view(tmp_path, browser=False, budget=1.0)
    with pytest.raises(OutputError, match=r"--images .*none: there is no such folder"):
        view(result_folder, images=tmp_path / "none", out=tmp_path / "a.html", browser=False, budget=1.0)
    assert not (tmp_path / "a.html").exists()


def test_names_do_not_lead_out_of_the_folder_of_photographs(tmp_path: Path) -> None:
    (tmp_path / "inside").mkdir()
    for path in (tmp_path / "secret.jpg", tmp_path / "inside" / "a.jpg"):
        path.write_bytes(b"x")
    (tmp_path / "inside" / "link.jpg").symlink_to(tmp_path / "secret.jpg")
    names = ("a.jpg", "../secret.jpg", str(tmp_path / "secret.jpg"), "link.jpg", "x" * 5000, "b.jpg", "a\0")
    assert photographs_in(tmp_path / "inside", names).keys() == {"a.jpg"}


SHIFT = (4.3, -2.6)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("photographs")
    texture = random_texture(np.random.default_rng(1), 2.0)
    y, x = np.mgrid[0:160, 0:200].astype(float)
    for k, (dx, dy) in enumerate([(0.0, 0.0), SHIFT]):
        grey = with_noise(texture.value(x - dx, y - dy), 2.0, k).clip(0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / f"{k}.png"), grey)
    return folder / "0.png", folder / "1.png"


def test_one_point_on_the_terminal(photographs: tuple[Path, Path]) -> None:
    text, matched = match_photographs(*photographs, point="100,80", settings=MatchSettings(search_px=61))
    assert matched
    header, line = text.splitlines()
    assert "sigma px" in header
    x, y = (float(part.rstrip(",")) for part in line.split()[3:5])
    assert (x, y) == pytest.approx((100 + SHIFT[0], 80 + SHIFT[1]), abs=0.05)


@pytest.mark.parametrize("method", ["ncc", "lsm", "lsm8", "shift"])
def test_json(photographs: tuple[Path, Path], method: str) -> None:
    found = json.loads(
        match_photographs(
            *photographs, point="100,80", as_json=True, settings=MatchSettings(method=method, search_px=61)
        )[0]
    )
    assert found["method"] == method
    entry = found["points"][0]
    assert entry["x_right_px"] == pytest.approx(100 + SHIFT[0], abs=0.25)
    assert entry["r"] > 0.9 and entry["reason"] == "" and entry["sx_px"] > 0
    lost = json.loads(
        match_photographs(*photographs, point="2,2", as_json=True, settings=MatchSettings(method=method))[0]
    )["points"][0]
    assert (
        lost["x_right_px"] is None
        and lost["covariance_px2"] is None
        and lost["reason"].startswith("outside: ")
    )


def test_tables_and_picture(photographs: tuple[Path, Path], tmp_path: Path) -> None:
    table = tmp_path / "points.csv"
    table.write_text(
        "point,x_px,y_px,x_right_px,y_right_px\na,60,60,64,58\nb,100.5,80,104,78\n", encoding="utf-8"
    )
    out, picture = tmp_path / "out.csv", tmp_path / "patches.png"
    line, _ = match_photographs(
        *photographs, points=table, out=out, picture=picture, settings=MatchSettings(search_px=41)
    )
    assert line.startswith("2 of 2 points matched")
    rows = rows_of(out)
    assert [row["point"] for row in rows] == ["a", "b"]
    assert float(rows[1]["x_right_px"]) == pytest.approx(100.5 + SHIFT[0], abs=0.05)
    as_json = json.loads(
        match_photographs(*photographs, points=table, as_json=True, settings=MatchSettings(search_px=41))[0]
    )["points"]
    assert [float(row["x_right_px"]) for row in rows] == [one["x_right_px"] for one in as_json]  # all digits
    drawn = cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE)
    assert drawn.shape == (2 * (21 * 8 + LINE), 3 * 21 * 8 + 8)
    difference = drawn[LINE : LINE + 21 * 8, -21 * 8 :].astype(float)
    assert abs(difference.mean() - 128) < 10  # grey: the patches are the same but for noise
    # earlier outputs may be replaced, by a run of another kind of table or of other points, too
    match_photographs(
        *photographs, point="100,80", out=out, picture=picture, settings=MatchSettings(search_px=61)
    )
    assert len(out.read_text(encoding="utf-8").splitlines()) == 2
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize("option", ["out", "picture"])
def test_nothing_but_earlier_outputs_is_written_over(
    photographs: tuple[Path, Path], tmp_path: Path, option: str
) -> None:
    left, right = (tmp_path / p.name for p in photographs)
    for mine, given in zip((left, right), photographs, strict=True):
        mine.write_bytes(given.read_bytes())
    ending = {"out": ".csv", "picture": ".png"}[option]
    points = tmp_path / "points.csv"
    points.write_text("point,x_px,y_px\na,60,60\n", encoding="utf-8")
    other, link, folder = tmp_path / f"o{ending}", tmp_path / f"link{ending}", tmp_path / f"f{ending}"
    other.write_bytes(left.read_bytes() if option == "picture" else b"point,X,Y,Z\n")
    link.symlink_to(left)
    folder.mkdir()
    before = {p: p.read_bytes() for p in (left, right, points, other)}
    taken = [(other, "was not written by"), (link, "is the input"), (folder, "is not a file")]
    if option == "picture":
        taken += [(left, "is the input"), (tmp_path / "f.png" / ".." / "1.png", "is the input")]
        taken += [(tmp_path / "p.jpg", r"ends in '.jpg', needed .png")]
    else:
        taken += [(points, "is the input"), (left, "ends in '.png', needed .csv or .json")]
    for path, why in taken:
        both = {"out": tmp_path / "t.json", "picture": tmp_path / "p.png", option: path}
        with pytest.raises(OutputError, match=why):
            match_photographs(left, right, points=points, **both)
        assert {p: p.read_bytes() for p in before} == before and link.is_symlink()
        assert not (tmp_path / "t.json").exists() and not (tmp_path / "p.png").exists()
    with pytest.raises(OutputError, match=r"needed \.json"):
        match_photographs(left, right, points=points, out=tmp_path / "t.csv", as_json=True)


def test_no_match_is_written_with_its_reason(photographs: tuple[Path, Path], tmp_path: Path) -> None:
    out, picture = tmp_path / "t.json", tmp_path / "p.png"
    line, matched = match_photographs(*photographs, point="2,2", out=out, picture=picture)
    assert not matched and line.startswith("0 of 1 points matched")
    assert "outside" in json.loads(out.read_text(encoding="utf-8"))["points"][0]["reason"]
    assert cv2.imread(str(picture)) is not None


def test_picture_tells_how_many_it_leaves_out(photographs: tuple[Path, Path], tmp_path: Path) -> None:
    table, picture = tmp_path / "points.csv", tmp_path / "p.png"
    rows = "".join(f"{k},{60 + k},80\n" for k in range(MAX_PICTURES + 1))
    table.write_text(f"point,x_px,y_px\n{rows}", encoding="utf-8")
    match_photographs(*photographs, points=table, picture=picture)
    drawn = cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE)
    assert len(drawn) == MAX_PICTURES * (21 * 8 + LINE) + LINE
    assert (drawn[-LINE:] < 100).any()  # the remark


def test_bad_input_is_one_line(photographs: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(SurveyFileError, match="either --point COL,ROW or --points FILE"):
        match_photographs(*photographs)
    with pytest.raises(SurveyFileError, match="expected COL,ROW such as"):
        match_photographs(*photographs, point="12")
    with pytest.raises(GeometryError, match="window of 20 px, needed an odd number"):
        match_photographs(*photographs, point="80,80", settings=MatchSettings(template_px=20))
    with pytest.raises(GeometryError, match="method 'sift', expected one of"):
        match_photographs(*photographs, point="80,80", settings=MatchSettings(method="sift"))
    with pytest.raises(GeometryError, match="expected one of bilinear, bicubic, six_tap"):
        match_photographs(*photographs, point="80,80", settings=MatchSettings(interpolation="nearest"))
    with pytest.raises(PhotographError, match=r"LEFT \.: is a folder"):
        match_photographs(Path(), photographs[1], point="80,80")
    blocked = tmp_path / "blocked"
    blocked.touch()
    with pytest.raises(OutputError, match="cannot be written"):
        match_photographs(*photographs, point="80,80", out=blocked / "o.csv")
    table = tmp_path / "points.csv"
    for text, why in (
        ("id,x\n1,2\n", "unknown column 'id', needed point,x_px,y_px"),
        ("point,x_px,y_px\n1,2,nan\n", "line 2: column y_px contains 'nan'"),
        ("point,x_px,y_px\na,60,60\nb,240\n", "line 3: 2 columns, the header has 3"),
        ("point,x_px,y_px\na,60,60\na,70,60\n", "line 3: point 'a' is on line 2 already"),
        ("point,x_px,y_px\n", "no rows below the header"),
        ("", "no column point"),
    ):
        table.write_text(text, encoding="utf-8")
        with pytest.raises(SurveyFileError, match=why):
            match_photographs(*photographs, points=table)
