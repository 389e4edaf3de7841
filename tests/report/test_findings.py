"""Findings are computed once, renderers print them; two result folders are compared by a script."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sfm.report.findings.bundle_statistics as statistics
import sfm.report.findings.checks as checks
import sfm.report.findings.survey_remarks as findings_module
from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.cli.console import print_result
from sfm.report.findings.survey_remarks import findings_of
from sfm.report.output import SurveyLog, write_result
from sfm.result import SurveyResult
from tests import compare_results
from tests.places import ROOT
from tests.synthetic import make_network, seed_of

SCRIPT = ROOT / "tests" / "compare_results.py"
COMPUTED = (
    *((checks, name) for name in ("variance_components",)),
    *((statistics, name) for name in ("by_kind", "by_camera", "by_photograph", "w_test", "tau_test")),
    *((statistics, name) for name in ("reliability", "significance", "correlations")),
    *(
        (findings_module, name)
        for name in ("statistics_of", "geometry_of", "given_of", "interior_of", "judge")
    ),
    *((findings_module, name) for name in ("precision_of", "sigma0_of", "longest_residual")),
)


@pytest.fixture(scope="module")
def result() -> SurveyResult:
    network, truth = make_network(seed_of("findings"), images=5, points=20, noise_px=0.1)
    a = adjust(network, truth, datum=Datum("free"))
    return SurveyResult("findings", "m", 5, (), a, np.full(20, -1), None)


def test_every_number_of_a_survey_is_computed_once(
    result: SurveyResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    calls: Counter[str] = Counter()
    for module, name in COMPUTED:
        real = getattr(module, name)

        def counted(*args: Any, _name: str = name, _real: Any = real, **options: Any) -> Any:
            calls[_name] += 1
            return _real(*args, **options)

        monkeypatch.setattr(module, name, counted)
    findings = findings_of(result)
    with SurveyLog() as log:
        page = write_result(findings, tmp_path / "out", finish=lambda part: log.close_into(part, findings))
    print_result(findings, page, seconds=1.0, verbose=True)
    assert findings.verdict.headline in capsys.readouterr().out
    assert calls == dict.fromkeys((name for _, name in COMPUTED), 1)


@pytest.fixture(scope="module")
def written(result: SurveyResult, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("written") / "out"
    write_result(findings_of(result), folder)
    return folder


@pytest.fixture
def folders(written: Path, tmp_path: Path) -> tuple[Path, Path]:
    for name in ("old", "new"):
        shutil.copytree(written, tmp_path / name)
    return tmp_path / "old", tmp_path / "new"


Compared = Callable[..., tuple[int, str]]


@pytest.fixture
def compared(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Compared:
    """The script in this process, which gives its exit code and what it prints."""

    def run(old: Path, new: Path, *options: str) -> tuple[int, str]:
        monkeypatch.setattr("sys.argv", [str(SCRIPT), str(old), str(new), *options])
        return compare_results.main(), capsys.readouterr().out

    return run


def test_a_result_written_twice_is_the_same(
    result: SurveyResult, folders: tuple[Path, Path], compared: Compared
) -> None:
    shutil.rmtree(folders[1])
    write_result(findings_of(result), folders[1])  # the times differ
    code, told = compared(*folders)
    assert code == 0 and "the results are the same" in told, told


def test_a_number_that_differs_is_reported_with_its_place(
    folders: tuple[Path, Path], compared: Compared
) -> None:
    old, new = folders
    lines = (new / "points.csv").read_text().splitlines()
    cells = lines[3].split(",")
    cells[2] = repr(float(np.nextafter(float(cells[2]), np.inf)))
    (new / "points.csv").write_text("\n".join([*lines[:3], ",".join(cells), *lines[4:]]) + "\n")
    code, told = compared(old, new)
    assert code == 1 and f"line 4 ({cells[0]}), Y:" in told and "1 of " in told.splitlines()[-1]
    code, told = compared(old, new, "--relative", "1e-12")
    assert code == 0, told
    summary = json.loads((new / "summary.json").read_text())
    summary["statistics"]["redundancy_number"]["min"] *= 1 + 1e-9
    (new / "summary.json").write_text(json.dumps(summary))
    code, told = compared(old, new, "--relative", "1e-12")
    assert code == 1 and "statistics.redundancy_number.min:" in told


@pytest.mark.parametrize(
    ("name", "before", "after", "wording"),
    [
        ("report.html", "How good is it?", "How precise is it?", 0),
        ("report.html", "20 object points", "21 object points", 1),
        ("report.txt", "Geometry of the network", "Geometry", 0),
        ("report.txt", "5 of 5", "4 of 5", 1),
    ],
)
def test_words_may_differ_where_that_is_meant_but_numbers_may_not(
    folders: tuple[Path, Path], compared: Compared, name: str, before: str, after: str, wording: int
) -> None:
    old, new = folders
    text = (new / name).read_text(encoding="utf-8")
    assert before in text
    (new / name).write_text(text.replace(before, after), encoding="utf-8")
    assert compared(old, new)[0] == 1
    assert compared(old, new, "--wording")[0] == wording


def test_missing_files_and_other_folders_are_reported(
    folders: tuple[Path, Path], compared: Compared, tmp_path: Path
) -> None:
    old, new = folders
    (new / "given.csv").unlink()
    code, told = compared(old, new)
    assert code == 1 and "given.csv is missing" in told
    (tmp_path / "empty").mkdir()
    done = subprocess.run(
        [sys.executable, SCRIPT, old, tmp_path / "empty"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2 and "no result folder" in done.stderr


def test_a_bar_in_a_name_is_written_as_it_is(result: SurveyResult) -> None:
    from sfm.report.survey_report import text_report

    network = result.adjustment.network
    named = replace(network, images=("a|b", *network.images[1:]))
    text = text_report(findings_of(replace(result, adjustment=replace(result.adjustment, network=named))))
    assert "  a|b  " in text
