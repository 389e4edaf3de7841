"""Pages of a validation and of a comparison: complete, self-contained, escaped, whole or not at all."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sfm.comparison.findings import verdict_of_comparison
from sfm.comparison.significance import ResultComparison, compare_results
from sfm.comparison.two_adjusters.adjuster_validation import Trial, Validation
from sfm.comparison.two_adjusters.random_network import Plan
from sfm.display import bound
from sfm.errors import GeometryError, OutputError
from sfm.files.open_folders import move
from sfm.files.whole_files import remove_leftovers
from sfm.network import Network
from sfm.remarks.remark import Remark, kinds_of, remark
from sfm.report.differences import TRIALS, largest_difference, verdict_of_validation
from sfm.report.pages import write_page
from sfm.solution import Solution
from tests.synthetic import make_network, seed_of

PLAN = Plan("ring", 8, 60, False, 0.8, 0.1, "opencv", 1, "all", "free")


def trial(number: int, *, cost: float = 10.0, ended: Remark | None = None) -> Trial:
    return Trial(
        number,
        PLAN,
        60,
        400,
        (10.0, cost),
        (0.1, 0.1),
        (5, 12),
        (0.01, 0.02),
        1e-6,
        2e-6,
        3e-6,
        4e-6,
        1e-12,
        np.nan,
        1.4,
        ended or remark("same_optimum", network=number, program="COLMAP", apart=0.0),
    )


def test_validation_is_written_with_every_figure(tmp_path: Path) -> None:
    failed = remark(
        "other_adjuster_failed", network=1, program="COLMAP", apart=np.nan, their_message="<out of order>"
    )
    lost = trial(1, cost=np.nan, ended=failed)
    path = write_page(Validation("colmap", 7, (trial(0), lost)), tmp_path / "out")
    with (tmp_path / "out" / "validation.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == [one.name for one in TRIALS if one.name]
    assert rows[0]["ended"] == "same_optimum" and rows[1]["cost_other_px2"] == ""
    assert rows[1]["message"] == "<out of order>"
    summary = json.loads((tmp_path / "out" / "validation.json").read_text())
    assert summary["passed"] is True and summary["verdict"] == "fair"
    assert summary["ended"] == {"same_optimum": 1, "other_adjuster_failed": 1}
    assert summary["largest"]["cost"] == 0.0
    assert summary["trials"][1]["cost"] == [10.0, None]
    assert summary["trials"][1]["remark"] == failed.as_dict()
    page = path.read_text(encoding="utf-8")
    assert "1 of 2 networks" in page
    assert "&lt;out of order&gt;" in page and "<out of order>" not in page
    assert 'src="http' not in page and 'href="http' not in page


def test_a_worse_kolinear_comes_first(tmp_path: Path) -> None:
    def ended(kind: str, number: int) -> Trial:
        return trial(number, cost=9.0, ended=remark(kind, network=number, program="COLMAP", apart=4.0))

    validation = Validation("colmap", 7, (trial(0), ended("kolinear_lower", 1), ended("kolinear_higher", 2)))
    verdict = verdict_of_validation(validation)
    assert verdict.level == "bad" and not validation.passed
    assert kinds_of(verdict.remarks) == ("kolinear_higher", "kolinear_lower")
    page = write_page(validation, tmp_path / "out").read_text()
    assert '<div class="banner bad"><strong>1 of 3 networks' in page and verdict.remarks[0].text in page
    good = verdict_of_validation(Validation("colmap", 7, (trial(0),)))
    assert good.level == "good" and good.remarks == ()


def test_foreign_folders_are_left_alone(tmp_path: Path) -> None:
    validation = Validation("colmap", 7, (trial(0),))
    write_page(validation, tmp_path / "out")
    write_page(validation, tmp_path / "out")  # an earlier one is replaced
    (tmp_path / "out" / "mine.txt").write_text("keep")
    with pytest.raises(OutputError, match=r"contains 'mine\.txt'"):
        write_page(validation, tmp_path / "out")
    assert (tmp_path / "out" / "mine.txt").read_text() == "keep"
    with pytest.raises(OutputError, match="a file has this name"):
        write_page(validation, tmp_path / "out" / "mine.txt")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out"]


@pytest.mark.parametrize("moment", [1, 2, 3])
def test_an_earlier_page_outlives_a_run_that_is_killed_while_it_replaces_it(
    moment: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class KilledError(BaseException):
        """After it nothing is done any more."""

    validation = Validation("colmap", 7, (trial(0),))
    page = write_page(validation, tmp_path / "out")
    before, renamed = page.read_text(), []

    def rename(*given: Any) -> None:
        renamed.append(given)
        if len(renamed) == moment:
            raise KilledError
        move(*given)

    def rmtree(path: Path, real: Any = shutil.rmtree, **options: Any) -> None:
        if len(renamed) < moment:
            real(path, **options)

    with monkeypatch.context() as patch, pytest.raises(KilledError):
        patch.setattr("sfm.files.whole_files.move", rename)
        patch.setattr(shutil, "rmtree", rmtree)
        write_page(validation, tmp_path / "out")
    remove_leftovers(tmp_path / "out")
    assert page.read_text() == before
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.fixture
def moved() -> tuple[ResultComparison, np.ndarray]:
    network, truth = make_network(seed_of("page"), model="opencv", images=5, points=20)
    covariance = np.tile(np.eye(3) * 1e-8, (20, 1, 1))
    points = truth.points.copy()
    points[4] += 0.003
    a = Solution("before", network, truth, covariance, redundancy=100, unit="m")
    b = Solution(
        "after <b>", measured_again(network), replace(truth, points=points), covariance, redundancy=100
    )
    found = compare_results(a, b, align="control", control=("1", "2", "9", "15"))
    return found, truth.points


def measured_again(network: Network) -> Network:
    seen = network.image_points
    return replace(network, image_points=replace(seen, xy=seen.xy + 0.1))


def test_comparison_is_written_with_every_point(
    moved: tuple[ResultComparison, np.ndarray], tmp_path: Path
) -> None:
    path = write_page(moved[0], tmp_path / "out", xyz=moved[1])
    with (tmp_path / "out" / "differences.csv").open() as file:
        rows = {row["id"]: row for row in csv.DictReader(file)}
    assert len(rows) == 20
    assert [name for name, row in rows.items() if row["significant"] == "1"] == ["5"]
    assert float(rows["5"]["dX"]) == pytest.approx(0.003)
    summary = json.loads((tmp_path / "out" / "comparison.json").read_text())
    assert summary["significant"] == ["5"] and summary["changed"] is True
    page = path.read_text(encoding="utf-8")
    said, approximate = verdict_of_comparison(moved[0]).remarks
    assert (
        approximate.kind == "tested_singly"
        and said.kind == "points_differ"
        and said.names("points") == ("5",)
        and bound(said.text) in page
    )
    assert largest_difference(moved[0]) == "5.20 mm"
    assert "after &lt;b&gt;" in page and "after <b>" not in page


def test_comparison_without_sigmas_says_so(tmp_path: Path) -> None:
    network, truth = make_network(seed_of("bare"), model="opencv", images=5, points=20)
    found = compare_results(Solution("a", network, truth), Solution("b", measured_again(network), truth))
    page = write_page(found, tmp_path / "out", xyz=truth.points).read_text()
    verdict = verdict_of_comparison(found)
    assert kinds_of(verdict.remarks) == ("no_sigmas",) and verdict.remarks[0].text in page
    assert json.loads((tmp_path / "out" / "comparison.json").read_text())["changed"] is None


def test_results_of_the_same_image_points_are_not_tested(tmp_path: Path) -> None:
    network, truth = make_network(seed_of("same"), model="opencv", images=5, points=20)
    covariance = np.tile(np.eye(3) * 1e-8, (20, 1, 1))
    a, b = (Solution(name, network, truth, covariance) for name in "ab")
    found = compare_results(a, b)
    assert found.same_share == 1.0 and found.changed is None and not found.significant.any()
    page = write_page(found, tmp_path / "out", xyz=truth.points).read_text()
    (said,) = verdict_of_comparison(found).remarks
    assert said.kind == "same_image_points" and said.number("share") == 1.0 and bound(said.text) in page
    write_page(found, tmp_path / "out", xyz=truth.points)  # again, over its own files


def test_nothing_in_common_is_no_agreement(tmp_path: Path) -> None:
    network, truth = make_network(seed_of("strangers"), model="opencv", images=5, points=20)
    other = replace(
        network,
        points=tuple(f"other {name}" for name in network.points),
        images=tuple(f"other {name}" for name in network.images),
    )
    for align in ("points", "cameras", "none"):
        with pytest.raises(GeometryError, match="a and b have no points and no photographs in common"):
            compare_results(Solution("a", network, truth), Solution("b", other, truth), align=align)
    photographs_only = compare_results(
        Solution("a", network, truth),
        Solution("b", replace(other, images=network.images), truth),
        align="cameras",
    )
    assert kinds_of(verdict_of_comparison(photographs_only).remarks) == ("no_common_points",)
    write_page(photographs_only, tmp_path / "out", xyz=truth.points[:0])


def test_sigmas_of_one_result_are_enough() -> None:
    """Those of the other, unknown as a whole or for single points, count as 0."""
    network, truth = make_network(seed_of("one-sided"), model="opencv", images=5, points=20)
    covariance = np.tile(np.eye(3) * 1e-8, (20, 1, 1))
    unknown = np.full((20, 3, 3), np.nan)
    some = covariance.copy()
    some[3] = np.nan
    a = Solution("a", network, truth, some)
    b = Solution("b", measured_again(network), truth, unknown)
    found = compare_results(a, b)
    assert found.has_sigma == (True, False)
    assert np.isnan(found.statistic).tolist() == [j == 3 for j in range(20)]
    assert found.changed is False
