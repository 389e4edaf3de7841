"""The report: what is written can be read back, says the same everywhere, and appears whole or not at all."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from markupsafe import escape

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.cli.console import print_result
from sfm.comparison.two_adjusters.adjusters import compare_adjusters
from sfm.files.open_folders import refuse_foreign_folder
from sfm.judgement.survey_result import (
    ControlCheck,
    FailedImage,
    PhotographTargets,
    StageTime,
    SurveyResult,
    sort_likeliest_first,
)
from sfm.model.conventions import FloatArray, angles_from_rotation
from sfm.model.display import bound, counted
from sfm.model.errors import OutputError
from sfm.model.network import Network, ObjectPoints, ScaleBars, Source
from sfm.model.remarks.remark import kinds_of, remark
from sfm.model.remarks.verdict import lines_of
from sfm.report import survey_report
from sfm.report.figures import overlays
from sfm.report.figures.overlays import USED, Overlay, draw_photograph, overlay_names
from sfm.report.figures.plots import SHADES, all_plots, network_figure, plan_axes
from sfm.report.network_geometry import geometry_of
from sfm.report.output import plot_data, write_result
from sfm.report.page import Paragraph, Section
from sfm.report.pages import WIDTH, html_of, page_of, wrapped
from sfm.report.phrases import (
    alike,
    describe_precision,
    finer_unit,
    placed,
    probability,
    significant,
    to_precision,
    with_exponent,
    words_left_out,
)
from sfm.report.survey_report import text_report
from sfm.report.tables.csv_files import write_tables
from sfm.report.tables.summary import summary, write_summary
from sfm.survey.inputs.given_values import read_exterior, read_image_points, read_points
from sfm.targets.outlines import LIKELIEST_FIRST, Flag
from tests.browser import Tab
from tests.findings import findings_of
from tests.other_adjuster import in_house_adjuster
from tests.places import ROOT
from tests.synthetic import make_network, seed_of
from tests.tables import rows_of
from tests.written import WRITTEN

pytestmark = pytest.mark.usefixtures("plots")

EVIL = "<script>alert('x')</script>&\"é€"


@pytest.fixture(scope="module")
def adjustment() -> Adjustment:
    network, truth = make_network(seed_of("report"), images=8, points=40, noise_px=0.1)
    seen = network.image_points
    xy = seen.xy.copy()
    xy[7] += (3.0, -2.0)
    return adjust(replace(network, image_points=replace(seen, xy=xy)), truth, datum=Datum("free"))


@pytest.fixture(scope="module")
def result(adjustment: Adjustment, tmp_path_factory: pytest.TempPathFactory) -> SurveyResult:
    folder = tmp_path_factory.mktemp("photographs")
    network = adjustment.network
    photographs = []
    for i, name in enumerate(network.images):
        width, height = adjustment.estimate.cameras[0].size_px
        path = folder / f"{name}.png"
        cv2.imencode(".png", np.full((height, width), 128, np.uint8))[1].tofile(path)
        xy = network.image_points.xy[network.image_points.image == i]
        k = len(xy)
        photographs.append(
            PhotographTargets(
                name,
                path,
                xy,
                np.full((k, 2), 6.0),
                np.zeros(k),
                np.array([[10.0, 20.0], [30.0, 40.0], [50.0, 60.0]]),
                np.array([Flag.TOO_SMALL.value, Flag.TOO_SMALL.value, Flag.CUT_BY_BORDER.value]),
            )
        )
    return SurveyResult(
        survey="synthetic " + EVIL,
        unit="m",
        images_total=9,
        failed=(FailedImage(EVIL + ".jpg", remark("photographs_unreadable", reason="3 bytes")),),
        adjustment=adjustment,
        code=np.where(np.arange(len(network.points)) < 10, np.arange(len(network.points)), -1),
        comparison=None,
        photographs=tuple(photographs),
        control_check=ControlCheck(("1", "2"), np.array([[3e-5, 0, 4e-5], [-3e-5, 0, -4e-5]]), 1.5),
        stage_remarks=(remark("names_missing", of="bars", names=["1 - 2"]),),
        seconds=(StageTime("targets", 1.25),),
    )


def test_small_probabilities_are_written_as_such() -> None:
    assert [probability(p) for p in (0.0, 0.00099, 0.0012, 0.25)] == [
        *("p < 0.001", "p < 0.001", "p = 0.001", "p = 0.250")
    ]


@pytest.mark.parametrize(
    ("value", "size", "written"),
    [
        (6.56e-14, 1252.71, "0.00"),
        (-2e-13, 1252.71, "0.00"),
        (1252.714, 1252.714, "1252.71"),
        (3.0, 4e7, "3"),
    ],
)
def test_coordinates_have_the_decimals_of_the_largest(value: float, size: float, written: str) -> None:
    assert placed(value, size) == written


def test_tables_give_back_every_number(result: SurveyResult, tmp_path: Path) -> None:
    write_tables(findings_of(result), tmp_path)
    a = result.adjustment
    points = rows_of(tmp_path / "points.csv")
    seen = ["rays", "code", "angle_deg", "rms_px"]
    limiting = ["limiting_sX", "limiting_sY", "limiting_sZ"]
    assert list(points[0]) == ["id", "X", "Y", "Z", "sX", "sY", "sZ", *seen, *limiting]
    limits = np.array([[float(row[name]) for name in limiting] for row in points])
    held = np.sqrt(np.einsum("nii->ni", a.covariance.points_limiting))
    np.testing.assert_allclose(limits, held, rtol=1e-14)
    assert [row["id"] for row in points] == list(a.network.points)
    np.testing.assert_array_equal([[float(row[c]) for c in "XYZ"] for row in points], a.estimate.points)
    variances = np.array([[float(row[f"s{c}"]) for c in "XYZ"] for row in points]) ** 2
    np.testing.assert_allclose(variances, np.einsum("nii->ni", a.covariance.points), rtol=1e-14)
    assert sum(int(row["rays"]) for row in points) == int((~a.rejected).sum())
    assert [row["code"] for row in points[9:11]] == ["9", ""]

    images = rows_of(tmp_path / "images.csv")
    degrees = [[float(row[f"{c}_deg"]) for c in ("omega", "phi", "kappa")] for row in images]
    np.testing.assert_allclose(degrees, np.degrees(angles_from_rotation(a.estimate.rotation)), rtol=1e-14)
    sigma = [[float(row[f"s{c}_deg"]) for c in ("omega", "phi", "kappa")] for row in images]
    np.testing.assert_allclose(
        np.radians(sigma) ** 2, np.einsum("nii->ni", a.covariance.exterior)[:, 3:], rtol=1e-13
    )

    cameras = rows_of(tmp_path / "cameras.csv")
    camera = a.estimate.cameras[0]
    assert [row["parameter"] for row in cameras] == list(camera.names)
    assert [row["unit"] for row in cameras] == list(camera.units)
    np.testing.assert_array_equal([float(row["value"]) for row in cameras], camera.parameters)
    assert [row["sigma"] != "" for row in cameras] == camera.free.tolist()

    measured = rows_of(tmp_path / "image_points.csv")
    np.testing.assert_array_equal(
        [[float(row["vx_px"]), float(row["vy_px"])] for row in measured], a.residuals
    )
    assert [row["rejected"] == "1" for row in measured] == a.rejected.tolist()
    assert a.rejected[7]


def test_tables_of_a_result_can_be_input_of_another_survey(result: SurveyResult, tmp_path: Path) -> None:
    write_tables(findings_of(result), tmp_path)
    a = result.adjustment
    np.testing.assert_array_equal(read_points(tmp_path / "points.csv").xyz, a.estimate.points)
    np.testing.assert_allclose(
        read_exterior(tmp_path / "images.csv").rotation, a.estimate.rotation, atol=1e-14
    )
    observed = read_image_points(tmp_path / "image_points.csv")
    np.testing.assert_array_equal(observed.xy, a.network.image_points.xy)
    assert observed.sigma is not None


def test_summary_says_what_the_adjustment_says(result: SurveyResult, tmp_path: Path) -> None:
    write_tables(findings_of(result), tmp_path)
    write_summary(findings_of(result), tmp_path)
    a = result.adjustment
    text = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert text == json.loads(json.dumps(summary(findings_of(result))))
    assert text["survey"] == result.survey
    assert text["images"] == {
        "used": 8,
        "total": 9,
        "failed": [{"image": result.failed[0].image, "reason": result.failed[0].reason.as_dict()}],
    }
    assert text["points"] == {"total": 40, "coded": 10, "uncoded": 30}
    assert text["observations"]["used"] + text["observations"]["rejected"] == len(a.rejected)
    assert text["datum"]["kind"] == "free"
    assert text["datum"]["defect"] == 7
    assert (text["unknowns"], text["redundancy"]) == (a.unknowns, a.redundancy)
    assert text["sigma0_px"] == pytest.approx(a.sigma0 * 0.1, rel=1e-15)
    assert text["rms_px"] == a.rms_px
    assert text["max_residual_px"] == a.max_residual_px
    c = text["cameras"][0]["parameters"]["c"]
    assert c["value"] == a.estimate.cameras[0].value("c")
    assert c["sigma"] == pytest.approx(np.sqrt(a.covariance.interior[0][0, 0]), rel=1e-15)
    assert c["unit"] == "mm"
    assert text["cameras"][0]["parameters"]["b2"]["sigma"] is None
    assert text["comparison"] is None
    assert text["seconds"] == {"targets": 1.25}


def test_unknown_numbers_are_null_and_empty_cells(result: SurveyResult, tmp_path: Path) -> None:
    covariance = replace(
        result.adjustment.covariance, points=np.full_like(result.adjustment.covariance.points, np.nan)
    )
    unknown = replace(
        result, adjustment=replace(result.adjustment, covariance=covariance, sigma0=float("nan"))
    )
    write_tables(findings_of(unknown), tmp_path)
    write_summary(findings_of(unknown), tmp_path)
    text = (tmp_path / "summary.json").read_text(encoding="utf-8")
    assert json.loads(text, parse_constant=lambda name: pytest.fail(name))["sigma0_px"] is None
    assert rows_of(tmp_path / "points.csv")[0]["sX"] == ""


def test_a_result_is_not_lost_to_figures_that_are_not_finite(result: SurveyResult, tmp_path: Path) -> None:
    """A rejected point behind its camera has no residual, and COLMAP's RMS of a sound network can be NaN."""
    a = result.adjustment
    other = compare_adjusters(a, in_house_adjuster)
    rows = np.flatnonzero(a.rejected)
    assert len(rows)
    residuals = a.residuals.copy()
    residuals[rows] = np.nan
    lost = replace(other.comparison, rms_px=(0.1, float("nan")), cost=(1.0, float("inf")))
    bad = replace(
        result,
        adjustment=replace(a, residuals=residuals),
        comparison=replace(other, comparison=lost),
        photographs=result.photographs[:2] + result.photographs[-1:],
    )
    write_result(findings_of(bad), tmp_path / "out")
    text = (tmp_path / "out" / "summary.json").read_text(encoding="utf-8")
    found = json.loads(text, parse_constant=lambda name: pytest.fail(name))
    assert found["comparison"]["rms_px"] == {"kolinear": 0.1, "colmap": None}
    assert {"comparison.rms_px.colmap", "comparison.cost.colmap"} <= set(found["not_finite"])
    assert len(list((tmp_path / "out" / "overlays").iterdir())) == 3


def test_points_as_ply(result: SurveyResult, tmp_path: Path) -> None:
    write_tables(findings_of(replace(result, unit="µm\nend_header")), tmp_path)
    lines = (tmp_path / "points.ply").read_text(encoding="ascii").splitlines()
    assert lines[0] == "ply"
    assert "element vertex 40" in lines
    body = lines[lines.index("end_header") + 1 :]
    xyz = [[float(value) for value in line.split()[:3]] for line in body]
    np.testing.assert_array_equal(xyz, result.adjustment.estimate.points)


def test_image_rms_adds_up_to_that_of_the_network(adjustment: Adjustment) -> None:
    rms, count = (geometry := geometry_of(adjustment)).image_rms_px, geometry.image_points
    assert count.sum() == (~adjustment.rejected).sum()
    assert np.sqrt((rms**2 * count).sum() / count.sum()) == pytest.approx(adjustment.rms_px, rel=1e-12)


class Tags(HTMLParser):
    """Collects tags and what they point to."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.sources: list[str] = []
        self.text = ""
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.sources += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def test_page_is_whole_escaped_and_self_contained(result: SurveyResult) -> None:
    page = html_of(findings_of(result), plots=all_plots(plot_data(findings_of(result))))
    tags = Tags()
    tags.feed(page)
    assert tags.open == []
    assert tags.tags.count("script") == 1  # that of the tables; nothing needs it
    assert EVIL in tags.text
    assert EVIL + ".jpg" in tags.text
    assert tags.tags.count("img") == 11  # panels of six plots
    for source in tags.sources:
        assert source.startswith(("data:image/png;base64,", "#")) or source.rstrip("/") in WRITTEN, source
    for question in (
        "Did it work?",
        "How good is it?",
        "What was rejected, and why?",
        "Does the other adjuster agree?",
        "Where are my coordinates?",
    ):
        assert question in tags.text
    assert "too small" in tags.text
    assert f"{EVIL}.jpg could not be read." in tags.text
    assert f"{result.adjustment.sigma0_px:.4f}\N{NO-BREAK SPACE}px" in tags.text


def test_a_new_section_is_a_function_and_a_row(result: SurveyResult, monkeypatch: pytest.MonkeyPatch) -> None:
    def weather(report: survey_report.Report) -> Section:
        return Section("Weather", Paragraph(f"dry in {report.f.result.unit}"), key="weather")

    monkeypatch.setattr(survey_report, "SECTIONS", (*survey_report.SECTIONS, weather))
    found = findings_of(result)
    page, lines = html_of(found), text_report(found).splitlines()
    assert '<a href="#weather">Weather</a></nav>' in page and '<section id="weather">' in page
    at = lines.index("Weather ".ljust(WIDTH, "="))
    assert lines[at + 1] == "  dry in m"
    keys = [one.key for one in page_of(found).sections if one.parts]
    assert keys == [
        *("worked", "quality", "tested", "rejected", "comparison", "coordinates", "photographs", "process"),
        "weather",
    ]
    assert [one for one in lines if one.endswith("===")] == [
        "=" * WIDTH,
        *(f"{one.title} ".ljust(WIDTH, "=") for one in page_of(found).sections if one.parts and one.in_text),
    ]


def test_plots_are_legible_on_a_telephone(browser: Any, result: SurveyResult, tmp_path: Path) -> None:
    """Their panels go below one another, whole, and are hardly made smaller."""
    found = findings_of(result)
    (tmp_path / "report.html").write_text(html_of(found, plots=all_plots(plot_data(found))), "utf-8")
    sizes = "all => all.map((one) => [one.clientWidth, one.naturalWidth, one.getBoundingClientRect().left])"
    for width, scale, columns in ((390, 0.6, 1), (1300, 0.9, 2)):
        tab = Tab(browser, tmp_path / "report.html", width=width)
        shown = np.array(tab.page.locator(".plot img").evaluate_all(sizes))
        assert (shown[:, 0] >= scale * shown[:, 1]).all()
        assert len(np.unique(shown[:, 2])) == columns
        assert tab.page.evaluate("document.documentElement.scrollWidth") <= width
        tab.close()


def test_plots_are_on_the_paper_of_the_page_light_and_dark(
    browser: Any, result: SurveyResult, tmp_path: Path
) -> None:
    found = findings_of(result)
    (tmp_path / "report.html").write_text(html_of(found, plots=all_plots(plot_data(found))), "utf-8")
    for scheme, paper, ink in (("light", (255, 255, 255), 0), ("dark", (23, 29, 37), 255)):
        tab = Tab(browser, tmp_path / "report.html", color_scheme=scheme)
        image = cv2.imdecode(np.frombuffer(tab.page.locator(".plot img").first.screenshot(), np.uint8), 1)
        assert np.abs(image[4, 4, ::-1].astype(int) - paper).max() <= 1
        assert (np.abs(image.astype(int) - ink).max(axis=2) < 40).any()
        tab.close()


def test_colours_of_values_are_visible_on_light_and_on_dark_pages() -> None:
    """Contrast by WCAG 2.1; the large values have more of it. Dark pages turn the intensities over."""

    def luminance(rgb: FloatArray) -> FloatArray:
        linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
        return np.asarray(linear @ [0.2126, 0.7152, 0.0722])

    small, large = SHADES([0.0, 1.0])[:, :3]
    for paper, shown in (
        (np.ones(3), (small, large)),
        (np.array([23, 29, 37]) / 255, (1 - small, 1 - large)),
    ):
        light = luminance(paper)
        pairs = [sorted((luminance(one) + 0.05, light + 0.05)) for one in shown]
        low, high = (b / a for a, b in pairs)
        assert 1.5 < low < high and high > 7


def test_wide_tables_show_that_there_is_more(browser: Any, result: SurveyResult, tmp_path: Path) -> None:
    """The edge is shaded beyond which columns are hidden, and not where they all are seen."""
    (tmp_path / "report.html").write_text(html_of(findings_of(result)), "utf-8")
    place = "(all) => all.findIndex((one) => one.checkVisibility() && one.scrollWidth - one.clientWidth SIGN)"
    tab = Tab(browser, tmp_path / "report.html", width=390)
    tables = tab.page.locator(".scroll")
    for sign, shaded in (("> 50", True), ("== 0", False)):
        table = tables.nth(tables.evaluate_all(place.replace("SIGN", sign)))
        seen = cv2.imdecode(np.frombuffer(table.screenshot(), np.uint8), 0)
        assert (int(np.median(seen[:, -2])) < 200) is shaded
    tab.close()


def test_edges_are_explained_only_where_they_are_stated(result: SurveyResult) -> None:
    overlays = [Overlay(one, f"{one}.jpg", b"", b"") for one in result.adjustment.network.images]
    first, *others = result.photographs
    soft = replace(first, blur=np.full(len(first.xy), 0.87))
    for shown, stated in (((first, *others), 0), ((soft, *others), 1)):
        page = html_of(findings_of(replace(result, photographs=shown)), overlays=overlays)
        assert page.count("edges 0.87 px") == page.count("Edges: ") == stated


def test_pictures_are_cut_into_panels_that_show_something(result: SurveyResult) -> None:
    drawn = {one.stem: one for one in all_plots(plot_data(findings_of(result)))}
    width = {
        stem: [cv2.imdecode(np.frombuffer(png, np.uint8), 0).shape[1] for png in (one.png, *one.panels)]
        for stem, one in drawn.items()
    }
    assert len(width.pop("projection")) == 2  # the place of a second camera is empty
    assert len(width) == 5
    assert all(len(found) == 3 and found[0] == found[1] + found[2] for found in width.values())


def test_precision_is_reported_as_one_sigma_and_as_what_95_of_100_are_within(
    result: SurveyResult, capsys: pytest.CaptureFixture[str]
) -> None:
    found = findings_of(result)
    factor, _ = finer_unit(result.length_unit, float(found.precision.largest[3]))
    within = significant(1.959964 * factor * float(found.precision.rms[3]))
    print_result(found, Path("page"), seconds=1.0, verbose=False)
    for told in (capsys.readouterr().out, html_of(found), text_report(found)):
        assert "1 sigma" in told and "95 %" in told and within in told


def test_maps_show_the_precision_of_points_and_the_projection_of_each_camera(result: SurveyResult) -> None:
    shown = plot_data(findings_of(result))
    sigma = np.sqrt(np.einsum("nii->n", result.adjustment.covariance.points) / 3)
    factor, unit = finer_unit(result.length_unit, float(findings_of(result).precision.largest[3]))
    np.testing.assert_allclose(shown.sigma, factor * sigma)
    assert shown.sigma_unit == unit
    found = shown.projection[0]
    assert found is not None and (found.sigma > 0).all()
    stems = [plot.stem for plot in all_plots(shown)]
    assert stems[-2:] == ["precision", "projection"]


def test_one_of_a_kind_is_no_plural() -> None:
    assert (counted(0, "point"), counted(1, "point"), counted(2, "point")) == (
        "0 points",
        "1 point",
        "2 points",
    )
    words = re.compile(r"'s' (?:if|\*)|\"s\" (?:if|\*)|else ['\"]s['\"]")
    by_hand = [str(path) for path in (ROOT / "sfm").rglob("*.py") if words.search(path.read_text("utf-8"))]
    assert not by_hand, "sfm.model.display.counted writes numbers of things"


def test_reasons_are_reported_from_what_is_most_like_a_target(result: SurveyResult) -> None:
    first = result.photographs[0]
    flag = np.array([Flag.TOO_SMALL.value, Flag.TOO_SMALL.value, Flag.POOR_FIT.value])
    found = findings_of(replace(result, photographs=(replace(first, rejected_flag=flag),)))
    page = html_of(found)
    assert page.index(">poor fit<") < page.index(">too small<")  # and not the most frequent first
    assert set(sort_likeliest_first(["too small", "measured", "poor fit"])[:1]) == {"measured"}
    rejections = {flag for flag in Flag if Flag.CUT_BY_BORDER <= flag < Flag.DAMAGED}
    assert set(LIKELIEST_FIRST) == rejections


def test_fixed_coordinates_have_neither_unknown_precision_nor_residuals() -> None:
    network, truth = make_network(seed_of("all fixed"), images=4, points=12, noise_px=0.1)
    fixed = ObjectPoints(np.arange(12), truth.points, np.zeros((12, 3, 3)))
    a = adjust(network.with_given(fixed), truth, datum=Datum("control"))
    found = findings_of(SurveyResult("fixed", "mm", 4, (), a, np.arange(12), None))
    page = html_of(found)
    assert np.isnan(found.precision.rms).all() and "standard deviation [" not in page
    assert "held fixed" in text_report(found) and "not known" not in page
    assert ">rX</th>" not in page and page.count(">sX [") == 2  # of points and photographs
    assert "None of the" in page and " 0 of " not in page


def test_a_network_without_scale_has_no_metric_unit(result: SurveyResult) -> None:
    free = replace(result, control_check=None)
    assert not free.has_scale
    known = ObjectPoints(np.arange(2), free.adjustment.estimate.points[:2], np.zeros((2, 3, 3)))
    network = free.adjustment.network.with_given(known)
    assert replace(free, adjustment=replace(free.adjustment, network=network)).length_unit == "m"
    assert "network units" in html_of(findings_of(free))
    bars = ScaleBars(np.array([0]), np.array([1]), np.array([1.0]), np.array([0.1]))
    network = free.adjustment.network.with_given(bars)
    assert replace(free, adjustment=replace(free.adjustment, network=network)).length_unit == "m"


def test_verdict(result: SurveyResult) -> None:
    assert findings_of(result).verdict.level == "fair"
    assert set(kinds_of(findings_of(result).verdict.remarks)) >= {
        "names_missing",
        "photographs_unreadable",
    }
    fine = replace(result, images_total=8, failed=(), stage_remarks=())
    assert findings_of(fine).verdict.level == "good"
    assert (
        findings_of(fine).verdict.headline
        == "The survey worked: 8 of 8 photographs oriented, 40 object points."
    )
    lost = replace(fine, adjustment=replace(fine.adjustment, converged=False))
    assert findings_of(lost).verdict.level == "bad"
    weak = replace(fine, adjustment=replace(fine.adjustment, undetermined=("camera 1 c",), defect=8))
    found = findings_of(weak).verdict.remarks[0]
    assert found.kind == "rank_defect" and found.names("undetermined") == ("camera 1 c",)
    assert (found.number("defect"), found.number("expected")) == (8, 7)
    many = replace(fine, adjustment=replace(fine.adjustment, rejected=np.arange(320) < 100))
    assert findings_of(many).verdict.level == "fair"


def test_every_remark_is_shown_once_by_every_renderer(
    result: SurveyResult, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    missing = [f"control point {k} with a name of some length" for k in range(4)]
    more = replace(
        result,
        stage_remarks=(
            remark("names_missing", of="control", names=missing),
            remark("scale_undefined", unit="m"),
        ),
    )
    findings = findings_of(more)
    text = text_report(findings)
    assert max(map(len, text.splitlines())) <= WIDTH
    words = " ".join(text.split())
    print_result(findings, Path("report.html"), seconds=1.0, verbose=False)
    told, page = capsys.readouterr().out, html_of(findings)
    for one in findings.verdict.remarks:
        assert words.count(one.text) == 1 and told.count(one.text) == 1
        assert page.count(str(escape(bound(one.text)))) == 1 and str(escape(one.remedy)) in page
    assert result.failed[0].reason.text in words
    write_summary(findings, tmp_path)
    stored = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))["verdict"]["remarks"]
    assert stored == [one.as_dict() for one in findings.verdict.remarks]


def test_of_many_remarks_of_a_kind_the_first_are_shown() -> None:
    many = [remark("names_missing", of="control", names=[str(k)]) for k in range(8)]
    lines = lines_of([*many, remark("scale_undefined", unit="m")])
    assert [one.severity for one in lines] == ["warning"] * 6 + ["note"]
    assert [bool(one.remedy) for one in lines] == [True] + [False] * 5 + [True]
    assert lines[5].text.startswith("3 more")


def test_overlay_shows_targets_where_they_are(result: SurveyResult) -> None:
    photograph = result.photographs[0]
    picture = draw_photograph(photograph, result.adjustment, 100.0)
    width, height = result.adjustment.estimate.cameras[0].size_px
    assert picture.shape == (height, width, 3)
    # Of the outline one row or column of pixels beside the target is green to the right, left, up and down.
    seen = 0
    for x, y in photograph.xy:
        for dx, dy in ((8, 0), (-8, 0), (0, 8), (0, -8)):
            column, row = round(x + dx), round(y + dy)
            if 1 <= column < width - 1 and 1 <= row < height - 1:
                patch = picture[row - 1 : row + 2, column - 1 : column + 2].reshape(-1, 3).astype(int)
                seen += bool((np.abs(patch - USED).sum(axis=1) < 150).any())
    assert seen > 0.7 * 4 * len(photograph.xy)  # names and vectors cover some


@pytest.mark.parametrize("most", [300, 3])
def test_in_a_crowd_the_names_that_last_are_written(
    result: SurveyResult, monkeypatch: pytest.MonkeyPatch, most: int
) -> None:
    written: list[str] = []
    monkeypatch.setattr(overlays, "_label", lambda picture, name, *_: written.append(name))
    monkeypatch.setattr(overlays, "MAX_NAMED_POINTS", most)
    photograph, network = result.photographs[0], result.adjustment.network
    seen = network.image_points
    mixed = replace(
        network,
        image_points=replace(seen, source=seen.point % 2),
        sources=(Source("targets"), Source("texture", names_last=False)),
    )
    crowd = replace(photograph, xy=np.tile(photograph.xy, (300, 1)))
    draw_photograph(crowd, mixed, None)
    here = seen.point[seen.image == network.images.index(photograph.image)]
    named = [network.points[j] for j in here.tolist() if j % 2 == 0]
    assert len(named) > 3 and written == (named if most == 300 else [])


def test_overlays_have_different_names() -> None:
    names = overlay_names(("a.jpg", "A.png", "sub/a.jpg", "ä b.JPG", "a_2.tif", ".jpg"))
    assert len({name.lower() for name in names}) == 6
    assert names[0] == "a.jpg"
    assert names[3] == "ä b.jpg"
    assert all("/" not in name for name in names)


def test_result_appears_whole_and_replaces_an_earlier_one(result: SurveyResult, tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    page = write_result(
        findings_of(result), out, write_colmap=lambda folder, _: (folder / "x.bin").touch(), jobs=2
    )
    assert page == out / "report.html"
    # the run itself adds the log; only of many points a sample has its covariance kept
    assert {path.name for path in out.iterdir()} == set(WRITTEN) - {
        "log.jsonl",
        "point_covariance_points.csv",
        "cameras_balanced.csv",
        "mounts.csv",
        "moments.csv",
    }
    assert len(list((out / "overlays").iterdir())) == 8
    assert [path.name for path in out.parent.iterdir()] == ["out"]
    before = (out / "points.csv").read_bytes()
    large = page.stat().st_size
    write_result(findings_of(replace(result, survey="again")), out, jobs=2, budget_mb=0.0)
    assert page.stat().st_size < large - 50_000 and len(list((out / "pictures").iterdir())) >= 8
    assert json.loads((out / "summary.json").read_text(encoding="utf-8"))["survey"] == "again"
    assert not (out / "colmap").exists()
    assert (out / "points.csv").read_bytes() == before
    assert [path.name for path in out.parent.iterdir()] == ["out"]


def test_a_failure_leaves_nothing_and_the_earlier_result(result: SurveyResult, tmp_path: Path) -> None:
    out = tmp_path / "out"
    small = replace(result, photographs=())
    write_result(findings_of(small), out)

    def fail(folder: Path, colours: object) -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(OutputError, match="out: the result cannot be written: No space left on device"):
        write_result(findings_of(replace(small, survey="new")), out, write_colmap=fail)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert json.loads((out / "summary.json").read_text(encoding="utf-8"))["survey"] == result.survey


def test_other_peoples_folders_are_not_touched(tmp_path: Path) -> None:
    refuse_foreign_folder(tmp_path / "new")
    refuse_foreign_folder(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="a file has this name"):
        refuse_foreign_folder(tmp_path / "file")
    with pytest.raises(OutputError, match="the folder contains 'file'; --out needs a new or empty folder"):
        refuse_foreign_folder(tmp_path)
    (tmp_path / "file").rename(tmp_path / "summary.json")
    with pytest.raises(OutputError, match=r"contains 'summary.json'; --out needs"):
        refuse_foreign_folder(tmp_path)


@pytest.fixture
def locked(tmp_path: Path) -> Iterator[Path]:
    """A folder that a part of the path is a file in, which nobody can write below, root neither."""
    (tmp_path / "file").touch()
    yield tmp_path / "file" / "out"


def test_a_place_that_cannot_be_written(result: SurveyResult, locked: Path) -> None:
    with pytest.raises(
        OutputError, match=r"out: (the result )?cannot be written here: (File exists|Not a dir)"
    ):
        write_result(findings_of(replace(result, photographs=())), locked)


def test_plan_of_an_upright_wall_is_seen_from_its_front() -> None:
    rng = seed_of("wall")
    wall = rng.uniform(-1, 1, (30, 3)) * (5.0, 0.1, 3.0)
    axes, names = plan_axes(wall)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    assert abs(axes[2, 1]) > 0.9
    assert names[0] == "along"
    assert plan_axes(wall[:, [0, 2, 1]])[1] == ("X", "Y", "Z")


def test_plots_of_small_and_plain_results() -> None:
    network, truth = make_network(seed_of("plots"), images=3, points=12, noise_px=0.0, cameras=2, free=())
    names = tuple(f"$x_{k}^ä.jpg" for k in range(3))
    bars = ScaleBars(np.array([0]), np.array([1]), np.array([1.0]), np.array([0.1]))
    plain: Network = replace(network, images=names).with_given(bars)
    a = adjust(plain, truth, datum=Datum("free"))
    plots = all_plots(plot_data(findings_of(SurveyResult("plots", "$m", 3, (), a, np.full(12, -1), None))))
    assert [plot.stem for plot in plots] == [
        "network",
        "residuals",
        "distribution",
        "photographs",
        "precision",
    ]
    assert all(plot.png.startswith(b"\x89PNG") for plot in plots)


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (123456.0, "123456"), (0.00123456, "0.00123"), (1.5e-9, "1.50e-09"), (np.nan, "not known")],
)
def test_significant_digits(value: float, text: str) -> None:
    assert significant(value) == text


def test_numbers_end_where_their_sigma_does() -> None:
    assert to_precision(1.23456789, 0.0012) == "1.2346"
    assert to_precision(1.23456789, float("nan")) == "1.234568"
    assert with_exponent(7.456893, 0.00105) == ("7.4569", "0.0010")
    assert with_exponent(-4.5135e-5, 2.2e-6) == ("-4.51e-5", "0.22e-5")
    assert with_exponent(0.5, float("nan")) == ("0.5", "held fixed")


def test_the_comparison_says_what_of_the_survey_it_leaves_out(
    result: SurveyResult, capsys: pytest.CaptureFixture[str]
) -> None:
    """Fixed control takes no part in it: COLMAP agrees on the image points alone."""
    found = findings_of(result)
    barred = replace(found, counts=replace(found.counts, scale_bars=2))
    assert words_left_out(barred).endswith("2 scale bars")
    fixed = replace(
        found,
        counts=replace(found.counts, scale_bars=0, control=0),
        precision=replace(found.precision, fixed_points=7),
        result=replace(result, adjustment=replace(result.adjustment, datum="control")),
    )
    told = words_left_out(fixed)
    assert "7 fixed points" in told
    minimal = replace(result, adjustment=replace(result.adjustment, datum="minimal"))
    assert words_left_out(replace(fixed, result=minimal)) == ""
    both = compare_adjusters(result.adjustment, in_house_adjuster)
    fixed = replace(
        fixed,
        result=replace(fixed.result, comparison=both),
    )
    print_result(fixed, Path("page"), seconds=1.0, verbose=False)
    for shown in (" ".join(capsys.readouterr().out.split()), html_of(fixed)):
        assert told in shown


def test_the_terminal_says_once_why_photographs_are_lost(
    result: SurveyResult, capsys: pytest.CaptureFixture[str]
) -> None:
    """Reasons that are alike are one line, and those that a remark of these photographs explains none."""
    few, apart = (remark("photograph_with_few_points", seen=seen, needed=4) for seen in (0, 2))
    lost = (FailedImage("lost 1", few), FailedImage("lost 2", few), FailedImage("lost 3", apart))
    for explained in ((), ("lost 2", "lost 3")):
        group = remark("not_connected", photographs=explained, oriented=8, needed=4)
        board = remark("plate_not_found", plate="checkerboard", photographs=explained, size="7 x 9")
        said = replace(result, failed=lost, stage_remarks=(group, board) if explained else ())
        print_result(findings_of(said), Path("page"), seconds=1.0, verbose=False)
        told = [line.strip() for line in capsys.readouterr().out.splitlines()]
        ends = tuple(f"{one.text} {one.remedy}" for one in (few, apart))
        reasons = [line for line in told if line.startswith("lost") and line.endswith(ends)]
        assert any(line.endswith(board.remedy) for line in told) == bool(explained)
        assert [line.split(":")[0] for line in reasons] == (
            ["lost 1"] if explained else ["lost 1, lost 2, each", "lost 3"]
        )


def test_numbers_of_one_quantity_are_written_alike(
    result: SurveyResult, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert alike([9.15e-7, 1.56e-6]) == ("9.15e-07", "1.56e-06")
    assert alike([9.15e-3, 1.56e-2, np.nan]) == ("0.00915", "0.0156", "not known")
    told = describe_precision(9.15e-7, 1.56e-6, "network units")
    assert told.count("× 10⁻⁶ network units") == 4 and "0.915" in told and "1.56" in told
    monkeypatch.setenv("COLUMNS", "60")
    print_result(findings_of(result), Path("page"), seconds=1.0, verbose=True)
    for line in capsys.readouterr().out.splitlines():
        assert not re.match(r" +(?:%|px|mm|m|deg)(?:[ ,;]|$)", line), line
    page = html_of(findings_of(result))
    assert re.search(r"95(?: |&nbsp;|\xa0)%", page) and not re.search(r"<small>[^<]*\d px", page)


def test_names_in_the_plan_view_do_not_overlap(result: SurveyResult) -> None:
    """Photographs near one another have no room for the names of all; those apart have theirs."""
    shown = plot_data(findings_of(result))
    assert len(shown.position) == 8
    drawn = []
    for spread in (1.0, 0.02):
        middle = shown.position.mean(axis=0)
        figure = network_figure(replace(shown, position=middle + spread * (shown.position - middle)))
        figure.draw_without_rendering()
        boxes = [text.get_window_extent() for text in figure.axes[0].texts if text.get_text()]
        assert not any(a.overlaps(b) for k, a in enumerate(boxes) for b in boxes[:k])
        drawn.append(len(boxes))
    assert drawn[0] > drawn[1] >= 1


def test_lines_of_the_text_report_part_no_number_from_its_unit() -> None:
    line = "camera " + "c 29.991 mm, " * 20
    for start in range(12):
        lines = wrapped(" " * start + line, behind=start)
        assert len(lines) > 2 and not any(one.strip().startswith("mm") for one in lines)
