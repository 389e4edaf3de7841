"""The notebooks run as they stand, and what they claim holds; building the site runs all of them."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.places import ROOT

FOLDER = ROOT / "docs/notebooks"


def run(name: str, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Run the cells of a notebook without Jupyter; return its names."""
    import matplotlib

    matplotlib.use("Agg")
    monkeypatch.chdir(FOLDER)
    monkeypatch.syspath_prepend(str(FOLDER))
    monkeypatch.delitem(sys.modules, "simulated", raising=False)
    text = (FOLDER / f"{name}.md").read_text(encoding="utf-8")
    cells = re.findall(r"```\{code-cell\}\n(.*?)```", text, re.S)
    assert len(cells) > 5
    names: dict[str, Any] = {}
    for number, cell in enumerate(cells):
        exec(compile(cell, f"{name}, cell {number + 1}", "exec"), names)
    names["plt"].close("all")
    return names


def test_every_notebook_is_in_the_gallery_and_compiles() -> None:
    gallery = (FOLDER / "index.md").read_text(encoding="utf-8")
    pages = {page.stem for page in FOLDER.glob("*.md")} - {"index"}
    assert pages == set(re.findall(r"\]\(([\w-]+)\.md\)", gallery))
    for page in pages:
        text = (FOLDER / f"{page}.md").read_text(encoding="utf-8")
        assert text.startswith("---\nfile_format: mystnb\n"), page
        for cell in re.findall(r"```\{code-cell\}\n(.*?)```", text, re.S):
            compile(cell, page, "exec")


def test_epochs_name_what_moved_and_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    names = run("epochs", monkeypatch)
    assert names["series"].changed and not names["again"].changed
    assert len(names["moved"]) > 7
    assert all(name.startswith("B") for name in names["moved"])  # the beam, none of the abutments


@pytest.mark.slow
def test_the_datum_changes_ellipses_and_no_ratio(monkeypatch: pytest.MonkeyPatch) -> None:
    names = run("datum", monkeypatch)
    (a, sa), (b, sb) = (names["ratio_and_sigma"](names[one]) for one in ("free", "minimal"))
    assert (a, sa) == pytest.approx((b, sb), rel=1e-6)
    spread = [names[one].covariance.points.trace(axis1=1, axis2=2).mean() for one in ("free", "minimal")]
    assert spread[1] > 2 * spread[0]


@pytest.mark.slow
def test_the_colmap_model_is_mended(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pycolmap")
    names = run("colmap", monkeypatch)
    assert names["full"].rms_px < 0.8 * names["same"].rms_px
    assert names["found"].sum() > 0.45 * names["wrong"].sum()  # the others are less than 5 sigma off
    assert names["full"].rejected.sum() <= names["found"].sum() + 1
    assert (names["error_mm"](names["full"])[0] ** 2).mean() < 0.7 * (
        names["error_mm"](names["same"])[0] ** 2
    ).mean()


@pytest.mark.slow
def test_the_first_survey_is_true(monkeypatch: pytest.MonkeyPatch) -> None:
    names = run("first-survey", monkeypatch)
    assert len(names["coded"]) > 20
    assert ((names["error"] / names["sigma"]) ** 2).mean() < 2.5
    assert Path(names["folder"]).is_dir()
