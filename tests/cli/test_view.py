"""`kolinear view`: one page of a result folder or a COLMAP model, and nothing of a stranger's is replaced."""

from __future__ import annotations

import base64
import gzip
import json
import re
import webbrowser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adapters.formats.registry import write_any
from adapters.formats.result_tables import read_result
from sfm.cli.commands.inspecting import view
from sfm.errors import OutputError, SurveyFileError
from sfm.pipeline import run_survey
from sfm.report.findings.survey_remarks import findings_of
from sfm.report.output import write_result
from sfm.report.view_page import photographs_in
from sfm.survey.inputs.survey import read_survey
from tests.surveys import write_photograph_survey
from tests.synthetic import make_network, seed_of


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
    with pytest.raises(OutputError, match=r"out\.html: is there already and is left alone"):
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
