"""Findings: true results are not doubted; doubtful rays, blurred photographs."""

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

import sfm.judgement.bundle_statistics as statistics
import sfm.judgement.checks as checks
import sfm.judgement.verdict as verdict
import sfm.report.findings as findings_module
from sfm.adjustment.datum import Datum
from sfm.adjustment.quality.consistency import Consistency, Uneven, consistency_of
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.cli.console import print_result
from sfm.judgement.bundle_statistics import Given
from sfm.judgement.cameras import edges_of, larger_than_the_others, sharpness_remarks
from sfm.judgement.checks import longest_residual
from sfm.judgement.survey_result import FailedImage, PhotographTargets, SurveyResult
from sfm.judgement.verdict import given_remarks
from sfm.model.conventions import FloatArray
from sfm.model.estimate import Estimate
from sfm.model.network import Network, ScaleBars
from sfm.model.remarks.remark import Remark, of_kind, remark
from sfm.pipeline import run_survey
from sfm.report.findings import Findings
from sfm.report.output import SurveyLog, write_result
from tests import compare_results
from tests.findings import findings_of
from tests.places import ROOT
from tests.surveys import survey_of
from tests.synthetic import make_network, seed_of

pytestmark = pytest.mark.usefixtures("plots")

SCRIPT = ROOT / "tests" / "compare_results.py"
COMPUTED = (
    *((checks, name) for name in ("variance_components",)),
    *((statistics, name) for name in ("by_kind", "by_camera", "by_photograph", "w_test", "tau_test")),
    *((statistics, name) for name in ("reliability", "significance", "correlations")),
    *((findings_module, name) for name in ("geometry_of", "precision_of")),
    *((verdict, name) for name in ("judge", "longest_residual")),
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


ERROR_SIGMA = 10.0


def _with_wrong_rays(name: str) -> tuple[Network, Estimate, dict[int, int]]:
    """A network of 60 points, twelve of three rays of which one is wrong; the wrong image point by point."""
    rng = seed_of(name)
    network, truth = make_network(rng, images=10, points=60, visibility=0.8, free=("c",))
    seen = network.image_points
    keep, wrong = np.ones(len(seen), dtype=bool), {}
    xy = seen.xy.copy()
    for j in range(12):
        rows = rng.permutation(np.flatnonzero(seen.point == j))
        keep[rows[3:]] = False
        angle = rng.uniform(0, 2 * np.pi)
        xy[rows[0]] += ERROR_SIGMA * 0.1 * np.array([np.cos(angle), np.sin(angle)])
        wrong[j] = int(rows[0])
    number = np.cumsum(keep) - 1
    moved = replace(seen, xy=xy).select(keep)
    return replace(network, image_points=moved), truth, {j: int(number[k]) for j, k in wrong.items()}


def _blame(networks: int) -> Counter[str]:
    """Count whom the test blames, and which of these points are reported as doubtful."""
    count: Counter[str] = Counter()
    for k in range(networks):
        network, truth, wrong = _with_wrong_rays(f"three rays {k}")
        a = adjust(
            network, truth, options=AdjustmentOptions(alpha=1 - 0.95 ** (0.5 / len(network.image_points)))
        )
        told = {one.point for one in consistency_of(a).doubtful}
        for j, row in wrong.items():
            out = np.flatnonzero(a.rejected & (network.image_points.point == j))
            if not len(out):
                count["not found"] += 1
                continue
            who = "right" if out.tolist() == [row] else "wrong"
            count[f"{who}, {'doubtful' if network.points[j] in told else 'believed'}"] += 1
    print(dict(count))
    return count


def test_given_coordinates_are_not_doubtful() -> None:
    """Before, points of a plate were, whose rays show a wrong camera."""
    network, truth, _ = _with_wrong_rays("three rays 0")
    alpha = 1 - 0.95 ** (0.5 / len(network.image_points))
    assert consistency_of(adjust(network, truth, options=AdjustmentOptions(alpha=alpha))).doubtful
    given = network.with_control(network.points, truth.points)
    assert not consistency_of(
        adjust(given, truth, datum="control", options=AdjustmentOptions(alpha=alpha))
    ).doubtful


def test_a_point_whose_wrong_ray_was_not_the_one_rejected_is_doubtful() -> None:
    count = _blame(6)
    assert count["wrong, doubtful"] >= 5
    assert count["wrong, believed"] == 0
    assert count["right, believed"] > 0


@pytest.mark.slow
def test_how_often_the_wrong_ray_is_blamed_and_believed() -> None:
    count = _blame(60)
    total = sum(count.values())
    assert count["wrong, believed"] < 0.005 * total


def test_doubtful_points_are_a_remark() -> None:
    network, truth, _ = _with_wrong_rays("three rays 1")
    verdict = findings_of(run_survey(survey_of(network, truth, adjust={"reject": "tau"}))).verdict
    assert of_kind(verdict.remarks, "points_doubtful")


def findings(reject: str, *, error_px: float = 0.0, bar: bool = False) -> Findings:
    network, truth = make_network(seed_of("false alarms"), images=8, points=40)
    xy = network.image_points.xy.copy()
    xy[5, 0] += error_px
    network = replace(network, image_points=replace(network.image_points, xy=xy))
    if bar:
        length = np.linalg.norm(truth.points[[0, 1]] - truth.points[[2, 3]], axis=1)
        bars = ScaleBars(np.array([0, 1]), np.array([2, 3]), length, np.full(2, 1e-3))
        network = network.with_given(bars)
    a = adjust(network, truth, datum=Datum("free"), reject=reject)
    return findings_of(SurveyResult("alarms", "m", 8, (), a, np.full(40, -1), None, reject=reject))


def test_huber_with_a_gross_error_whose_influence_it_bounds_is_good() -> None:
    found = findings("huber", error_px=30.0)
    longest = longest_residual(found.result.adjustment)
    assert 0 < longest.weight < 0.1 or longest.over_sigma < 10
    assert not of_kind(found.verdict.remarks, "residual_kept")
    kept = findings("none", error_px=30.0)
    assert of_kind(kept.verdict.remarks, "residual_kept")


def test_a_bar_that_nothing_checks_is_no_contradiction() -> None:
    found = findings("tau", bar=True)
    bars = found.given.bars
    assert bars is not None

    def remarks(r: float) -> tuple[Remark, ...]:
        given = Given((replace(bars, w=np.full(bars.w.shape, 5.7), r=np.full(bars.r.shape, r)),))
        return of_kind(given_remarks(found.result, given, found.statistics, ()), "given_differs")

    assert remarks(0.8e-3) == ()
    assert len(remarks(1.2e-3)) == len(remarks(0.3)) == 1


def photograph(name: str, blur: FloatArray | None, camera: str = "A") -> PhotographTargets:
    k = 0 if blur is None else len(blur)
    none = np.zeros(0, dtype=np.int64)
    return PhotographTargets(
        name,
        Path(name),
        np.zeros((k, 2)),
        np.ones((k, 2)),
        np.zeros(k),
        np.zeros((0, 2)),
        none,
        blur=blur,
        camera=camera,
    )


@pytest.mark.parametrize("count", [5, 8, 20, 60])
def test_chance_calls_one_survey_in_a_hundred_blurred(count: int) -> None:
    rng = seed_of("sharp")
    surveys = [larger_than_the_others(rng.normal(0, 0.1, count), level=0.01).any() for _ in range(1500)]
    assert 0.003 < np.mean(surveys) < 0.025


@pytest.mark.parametrize("blurred", [1, 2, 3])
def test_a_few_blurred_photographs_do_not_hide_one_another(blurred: int) -> None:
    values = np.log(0.8) + seed_of("blurred").normal(0, 0.05, 12)
    values[:blurred] += np.log(2)
    assert np.flatnonzero(larger_than_the_others(values, level=0.01)).tolist() == list(range(blurred))


@pytest.mark.parametrize("values", [[], [1.0], [1.0, 9.0], [1.0, 1.0, 1.0, 1.0]])
def test_too_few_or_equal_values_have_no_outlier(values: list[float]) -> None:
    assert not larger_than_the_others(np.array(values), level=0.01).any()


def test_blurred_photographs_are_named_where_that_explains_something() -> None:
    network, truth = make_network(seed_of("sharpness"), images=6, points=12)
    rng = seed_of("edges")
    sharp = [photograph(f"image {k}", 0.8 * np.exp(rng.normal(0, 0.03, 12))) for k in range(1, 7)]
    soft = [photograph(name, np.append(np.full(9, 2.0), np.nan)) for name in ("lost", "uneven", "no harm")]
    shown = (*sharp, *soft, photograph("crossings", np.full(4, np.nan)), photograph("none", None))
    edges = edges_of(shown)
    assert edges["lost"] == 2.0 and not {"crossings", "none"} & set(edges)
    failed = (FailedImage("lost", remark("photograph_with_few_points", seen=1, needed=4)),)
    solved = adjust(network, truth)
    result = SurveyResult("sharpness", "m", 7, failed, solved, np.full(12, -1), None, photographs=shown)
    uneven = Consistency((), Uneven(1e-6, "uneven", 2.0, 1.0))
    (said,) = sharpness_remarks(result, edges, uneven)
    assert said.kind == "photographs_blurred" and said.severity == "note"
    assert said.names("photographs") == ("lost", "uneven")
    assert said.number("blur") == 2.0 and said.number("others") == pytest.approx(0.8, rel=0.05)
    assert sharpness_remarks(replace(result, failed=()), edges, Consistency((), None)) == ()
    seen = network.image_points
    hidden = adjust(replace(network, image_points=seen.select((seen.image > 0) | (seen.point < 6))), truth)
    few = replace(result, failed=(), adjustment=hidden)
    (said,) = sharpness_remarks(few, edges | {"image 1": 1.9}, Consistency((), None))
    assert said.names("photographs") == ("image 1",)


def test_photographs_are_compared_with_those_of_their_camera() -> None:
    """Edges of a camera of larger pixels or a longer lens are softer in px, and none of its is blurred."""
    network, truth = make_network(seed_of("sharpness"), images=6, points=12)
    rng = seed_of("two cameras")
    edges = {f"A {k}": 0.8 for k in range(12)} | {f"B {k}": 1.6 for k in range(5)}
    few = remark("photograph_with_few_points", seen=1, needed=4)
    lost = tuple(FailedImage(name, few) for name in ("B 0", "B 1"))
    solved = adjust(network, truth)
    for blur, named in ((1.6, ()), (4.0, ("B 0",))):
        edges["B 0"] = blur
        shown = tuple(
            photograph(name, one * np.exp(rng.normal(0, 0.03, 12)), name[0]) for name, one in edges.items()
        )
        result = SurveyResult("both", "m", 17, lost, solved, np.full(12, -1), None, photographs=shown)
        said = sharpness_remarks(result, edges_of(shown), Consistency((), None))
        assert tuple(name for one in said for name in one.names("photographs")) == named
    assert said[0].names("camera") == ("B",)
    assert said[0].number("others") == pytest.approx(1.6, rel=0.05)
