"""Pages: folded on the screen, printed whole, in words without a script; overlays."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.comparison.comparison_remarks import verdict_of_comparison
from sfm.comparison.significance import ResultComparison, compare_results
from sfm.comparison.two_adjusters.adjusters import compare_adjusters
from sfm.files.whole_files import remove_leftovers
from sfm.judgement.survey_result import BaselineComparison, SurveyResult
from sfm.model.display import bound
from sfm.model.errors import GeometryError, OutputError
from sfm.model.network import Network
from sfm.model.remarks.remark import kinds_of
from sfm.model.solution import Solution
from sfm.pipeline import run_survey
from sfm.report.differences import largest_difference
from sfm.report.figures.overlays import INK, REASON_COLOURS, SHIFT, _crosses
from sfm.report.output import write_result
from sfm.report.page import FoldedParts, Heading, Paragraph, Part, Statement, Table
from sfm.report.pages import html_of, page_of, write_page
from sfm.report.survey_comparison import adjuster_parts, pipeline_parts
from sfm.report.survey_report import text_report
from sfm.survey.inputs.survey import read_survey
from sfm.targets.outlines import Flag
from tests.findings import findings_of
from tests.other_adjuster import in_house_adjuster
from tests.places import ROOT
from tests.surveys import write_observed_survey, write_photograph_survey
from tests.synthetic import make_network, seed_of
from tests.tables import rows_of

pytestmark = pytest.mark.usefixtures("plots")


def test_foreign_folders_are_left_alone(moved: tuple[ResultComparison, np.ndarray], tmp_path: Path) -> None:
    comparison, xyz = moved
    write_page(comparison, tmp_path / "out", xyz=xyz)
    write_page(comparison, tmp_path / "out", xyz=xyz)  # an earlier one is replaced
    (tmp_path / "out" / "mine.txt").write_text("keep")
    with pytest.raises(OutputError, match=r"contains 'mine\.txt'"):
        write_page(comparison, tmp_path / "out", xyz=xyz)
    assert (tmp_path / "out" / "mine.txt").read_text() == "keep"
    with pytest.raises(OutputError, match="a file has this name"):
        write_page(comparison, tmp_path / "out" / "mine.txt", xyz=xyz)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out"]


@pytest.mark.parametrize("moment", [1, 2, 3])
def test_an_earlier_page_outlives_a_run_that_is_killed_while_it_replaces_it(
    moment: int, moved: tuple[ResultComparison, np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class KilledError(BaseException):
        """After it nothing is done any more."""

    comparison, xyz = moved
    page = write_page(comparison, tmp_path / "out", xyz=xyz)
    before, renamed = page.read_text(), []

    def rename(path: Path, target: Path, real: Any = Path.replace) -> None:
        renamed.append(path)
        if len(renamed) == moment:
            raise KilledError
        real(path, target)

    def rmtree(path: Path, real: Any = shutil.rmtree, **options: Any) -> None:
        if len(renamed) < moment:
            real(path, **options)

    with monkeypatch.context() as patch, pytest.raises(KilledError):
        patch.setattr(Path, "replace", rename)
        patch.setattr(shutil, "rmtree", rmtree)
        write_page(comparison, tmp_path / "out", xyz=xyz)
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
    rows = {row["id"]: row for row in rows_of(tmp_path / "out" / "differences.csv")}
    assert len(rows) == 20
    assert [name for name, row in rows.items() if row["significant"] == "1"] == ["5"]
    assert float(rows["5"]["dX"]) == pytest.approx(0.003)
    summary = json.loads((tmp_path / "out" / "comparison.json").read_text())
    assert summary["significant"] == ["5"] and summary["changed"] is True
    page = path.read_text(encoding="utf-8")
    verdict = verdict_of_comparison(moved[0])
    (said, weaker), (approximate,) = verdict.remarks, verdict.tests
    assert weaker.kind == "weaker_solution" and weaker.names("weaker") == ("after <b>",)
    assert (
        approximate.kind == "differences_tested"
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
    assert kinds_of(verdict.remarks) == ("no_covariance",) and verdict.remarks[0].text in page
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
    assert kinds_of(verdict_of_comparison(photographs_only).remarks) == ("untestable",)
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


def test_crosses_are_those_drawn_one_by_one() -> None:
    """Two lines through each candidate, short ones where it is too small; the first reason has the colour."""
    rng = np.random.default_rng(3)
    flags = [reason.value for reason, _ in REASON_COLOURS] + [0, (Flag.LOBED | Flag.TOO_SMALL).value]
    flag = np.repeat(flags, 3)
    xy = rng.permutation(np.stack(np.meshgrid(np.arange(8), np.arange(8)), axis=2).reshape(-1, 2))[
        : len(flag)
    ] * 30 + rng.uniform(5, 20, (len(flag), 2))
    picture, expected = np.full((250, 250, 3), 90, np.uint8), np.full((250, 250, 3), 90, np.uint8)
    _crosses(picture, xy, flag, 0.9)
    for at, value in zip(xy, flag.tolist(), strict=True):
        colour = next((colour for reason, colour in REASON_COLOURS if value & reason.value), INK)
        arm = (2 if value & Flag.TOO_SMALL.value else 4) << SHIFT
        x, y = (round(float(c)) for c in ((at + 0.5) * 0.9 - 0.5) * (1 << SHIFT))
        for sign in (1, -1):
            ends = (x - arm, y - sign * arm), (x + arm, y + sign * arm)
            cv2.line(expected, *ends, colour, 1, cv2.LINE_AA, SHIFT)
    assert (picture != 90).any()
    assert np.array_equal(picture, expected)


def test_no_candidates_draw_nothing() -> None:
    """A photograph without rejected candidates, and one outside of the picture."""
    picture = np.full((20, 20, 3), 90, np.uint8)
    _crosses(picture, np.zeros((0, 2)), np.zeros(0, np.int64), 1.0)
    _crosses(picture, np.array([[-500.0, 9e9]]), np.array([Flag.LOBED.value]), 1.0)
    assert (picture == 90).all()


def test_photographs_that_vanish_during_a_run_are_named(tmp_path: Path) -> None:
    folder = write_photograph_survey(tmp_path / "s", "vanished").parent
    result = run_survey(read_survey(folder / "survey.toml"))
    (folder / "photo 2.png").unlink()
    write_result(findings_of(result), tmp_path / "out")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    (said,) = [one for one in summary["verdict"]["remarks"] if one["kind"] == "photographs_not_drawn"]
    assert said["severity"] == "note" and "photo 2.png" in said["text"] and "photo 1.png" not in said["text"]
    assert said["text"] in " ".join((tmp_path / "out" / "report.txt").read_text(encoding="utf-8").split())
    assert len(list((tmp_path / "out" / "overlays").iterdir())) == len(result.photographs) - 1


NUMBER = re.compile(r"(?<![\w.^-])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.]*\w)")


class Words(HTMLParser):
    """The text of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.text = ""
        self.hidden = False

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.hidden = tag in ("style", "script")

    def handle_endtag(self, tag: str) -> None:
        self.hidden = False

    def handle_data(self, data: str) -> None:
        self.text += "" if self.hidden else f" {data}"


def said(text: str) -> set[float]:
    return {float(number) for number in NUMBER.findall(text)}


@pytest.mark.parametrize("write", [write_photograph_survey, write_observed_survey])
def test_the_page_says_what_the_text_says(write: object, tmp_path: Path) -> None:
    findings = findings_of(run_survey(read_survey(write(tmp_path / "survey", "text in page"))))  # type: ignore[operator]
    words = Words()
    words.feed(html_of(findings))
    text = text_report(findings)
    missing = sorted(said(text) - said(words.text))
    lines = [line for line in text.splitlines() if said(line) & set(missing)]
    assert missing == [], "\n".join(lines)
    assert len(said(text)) > 60


@pytest.fixture(scope="module")
def result() -> SurveyResult:
    network, truth = make_network(seed_of("compared"), images=5, points=20, noise_px=0.1)
    a = adjust(network, truth, datum=Datum("free"))
    both = compare_adjusters(a, in_house_adjuster)
    return SurveyResult("compared", "m", 5, (), a, np.full(20, -1), both)


@pytest.mark.parametrize(
    ("changed", "level", "reasons"),
    [
        ({}, "good", 0),
        ({"stopped_early": True}, "good", 0),
        ({"backend_converged": False}, "good", 0),  # fits alike
        ({"backend_converged": False, "cost": (1.0, 2.0)}, "bad", 1),
    ],
)
def test_the_outcome_comes_first_with_its_reasons(
    result: SurveyResult, changed: dict[str, Any], level: str, reasons: int
) -> None:
    both = result.comparison
    assert both is not None
    cost = changed.pop("cost", both.comparison.cost)
    both = replace(both, comparison=replace(both.comparison, cost=cost), **changed)
    first, second, *_ = adjuster_parts(findings_of(replace(result, comparison=both)))
    assert isinstance(first, Statement) and first.level == level and first.text
    assert (isinstance(second, Table) and len(second.rows)) == (reasons or False)
    (none,) = adjuster_parts(findings_of(replace(result, comparison=None)))
    assert type(none) is Paragraph


def test_the_other_pipeline_is_compared_in_a_unit_that_reads_well(result: SurveyResult) -> None:
    found = BaselineComparison(
        "mapper", (5, 4), 5, (0.1, 0.5), 18, 0.25,
        np.full((18, 3), 1e-3), np.full((4, 3), 2e-3), np.full(4, 0.01), (2.0, 30.0),
    )  # fmt: skip
    _, both, apart, _ = pipeline_parts(findings_of(replace(result, baseline=found)))
    assert isinstance(both, Table) and isinstance(apart, Table)
    assert both.rows[0] == ("photographs oriented", "5 of 5", "4 of 5", "")
    assert both.rows[2][1:] == ("0.100", "0.250", "px")
    (_, point, _, unit), (_, centre, _, same), rotation = apart.rows
    assert float(centre) == 2 * float(point) and unit == same and rotation[-1] == "deg"
    assert list(pipeline_parts(findings_of(result))) == []


PAGE = re.sub(r"\s+", " ", (ROOT / "docs" / "reading-the-report.md").read_text(encoding="utf-8")).lower()
OF_FIGURES = ("", "observations", "standard deviation", "reliability")  # first columns that name figures


def labels(parts: tuple[Part, ...]) -> Iterator[str]:
    for part in parts:
        if isinstance(part, FoldedParts):
            yield from labels(part.parts)
        elif isinstance(part, Heading):
            yield re.sub(r"^The \d+ ", "", part.text)
        elif isinstance(part, Table) and (part.facts or part.header[0] in OF_FIGURES):
            yield from (str(row[0]).removesuffix(" small") for row in part.rows)  # the name of the camera
        elif isinstance(part, Table):
            reasons = (
                part.header[1:] if "accepted in the result" not in str(part.header) else part.header[1:3]
            )
            yield from (one.removeprefix(">").partition(" [")[0] for one in reasons)


def test_every_figure_of_the_report_is_explained(tmp_path: Path) -> None:
    found = findings_of(run_survey(read_survey(write_photograph_survey(tmp_path / "survey", "page"))))
    sections = {one.key: one for one in page_of(found).sections}
    names = {
        one for key in ("worked", "quality", "rejected", "comparison") for one in labels(sections[key].parts)
    }
    assert len(names) > 60
    missing = sorted(one for one in names if one.lower() not in PAGE)
    assert not missing, missing
    titles = [sections[key].title for key in ("worked", "quality", "rejected", "comparison")]
    assert all(f"## {title}".lower() in PAGE for title in titles), titles
