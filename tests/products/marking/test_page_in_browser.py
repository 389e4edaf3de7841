"""The page for marking in a real browser, with the server of `kolinear mark`, as a person would use it."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from adapters.formats.result_tables import read_result
from datasets.textured import render as textured
from sfm.model.camera import project, tangents_from_pixel
from sfm.model.conventions import FloatArray
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.similarity import fit_similarity
from sfm.model.solution import Solution
from sfm.products.marking.project import MarkedProject, project_of_survey
from sfm.survey.inputs.marks_file import read_marks
from sfm.survey.inputs.survey import read_survey
from tests.browser import chromium
from tests.marking import (
    MORE,
    PAGE,
    PAIR,
    PLACE,
    Marking,
    Person,
    Targets,
    demo_survey,
    open_page,
    served,
    targets_of,
)
from tests.places import ROOT

SIZE = (900, 640)
DISCS = np.array([[x, y] for y in (120.25, 320.5, 520.75) for x in (150.25, 350.5, 550.75, 750.0)])
SHIFT = np.array([7.5, -4.25])  # of the second photograph against the first, px
EVIL = "<img src=x onerror=document.title='broken'>"


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A running browser; the test is skipped where there is none."""
    with chromium() as running:
        yield running


def picture(places: FloatArray) -> Any:
    """Return a photograph of discs of 9 px diameter and of one single bright pixel."""
    big = np.full((SIZE[1] * 4, SIZE[0] * 4), 60, np.uint8)
    for x, y in places:
        centre = tuple(round(16 * (4 * (v + 0.5) - 0.5)) for v in (x, y))
        cv2.circle(big, centre, 16 * 18, 210, -1, cv2.LINE_AA, 4)
    small = cv2.resize(big, SIZE, interpolation=cv2.INTER_AREA)
    noise = np.random.default_rng(5).normal(0, 1.0, small.shape)
    return np.clip(cv2.GaussianBlur(small, (0, 0), 0.7) + noise, 0, 255).astype(np.uint8)


SURVEY = f"""
[survey]
name = "discs"
unit = "mm"
[[camera]]
name = "scene"
images = "*.png"
size_px = [{SIZE[0]}, {SIZE[1]}]
pixel_mm = [0.005, 0.005]
c_mm = 8.0
[targets]
codes = "none"
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four photographs of discs, one of them with a name that would be markup."""
    folder = tmp_path_factory.mktemp("discs")
    for i in range(3):
        cv2.imwrite(str(folder / f"photo {i + 1}.png"), picture(DISCS + i * SHIFT))
    cv2.imwrite(str(folder / f"{EVIL}.png"), picture(DISCS[:1]))
    (folder / "survey.toml").write_text(SURVEY, encoding="utf-8")
    return folder


@pytest.fixture
def discs(browser: Any, folder: Path, tmp_path: Path) -> Iterator[Marking]:
    """The page of photographs of discs, without marks."""
    with served(folder / "survey.toml", tmp_path / "marks.csv") as server:
        marking = open_page(browser, server)
        yield marking
        assert all(url.startswith(server.address.url) for url in marking.tab.requests if url[:5] != "data:")
        marking.close()


def pane_of(marking: Marking, name: str) -> None:
    marking.page.locator(".m-pane select").first.select_option(label=name)
    marking.ready()


def test_a_click_measures_and_its_mark_lies_on_the_disc(discs: Marking) -> None:
    page = discs.page
    image = next(p["index"] for p in discs.state["photographs"] if p["name"] == "photo 1.png")
    pane_of(discs, "photo 1.png")
    discs.click(0, DISCS[5] + (2.5, -2))
    (mark,) = discs.state["marks"]
    assert (mark["image"], mark["point"], mark["kind"], mark["by"]) == (image, "P1", "target", "measured")
    np.testing.assert_allclose([mark["x"], mark["y"]], DISCS[5], atol=0.05)
    assert "P1 in photo 1.png: target, sigma" in discs.said()
    assert page.locator(".m-card h2").first.inner_text() == "Point P1"
    picture = page.locator(".m-fit img")
    discs.tab.until("() => document.querySelector('.m-fit img')?.naturalWidth > 50")
    assert picture.get_attribute("alt") == "fit of P1 in photo 1.png"
    discs.key("g")  # large
    page.wait_for_timeout(300)
    place = page.evaluate(PLACE, [0, mark["x"], mark["y"]])
    page.evaluate(
        "() => { for (const c of document.querySelectorAll('.m-overlay')) c.style.visibility = 'hidden' }"
    )
    clip = {"x": round(place[0]) - 60, "y": round(place[1]) - 60, "width": 120, "height": 120}
    shot = cv2.imdecode(np.frombuffer(page.screenshot(clip=clip), np.uint8), cv2.IMREAD_GRAYSCALE)
    bright = np.clip(shot.astype(float) - 130, 0, None)
    rows, columns = np.indices(shot.shape)
    centre = np.array([(bright * columns).sum(), (bright * rows).sum()]) / bright.sum() + 0.5
    centre += np.array([clip["x"], clip["y"]])
    np.testing.assert_allclose(centre, place, atol=0.6)  # px of the screen, magnified


def test_nothing_to_measure_is_said_and_by_hand_it_is_marked(discs: Marking) -> None:
    pane_of(discs, "photo 1.png")
    empty = (450.0, 220.0)
    discs.key("1")
    discs.click(0, empty)
    assert discs.state["marks"] == [] and "no target can be measured" in discs.said()
    discs.key("7")
    discs.page.get_by_label("sigma").fill("0.5")
    discs.page.get_by_label("sigma").press("Tab")
    discs.page.wait_for_timeout(400)  # no double click
    discs.click(0, empty)
    (mark,) = discs.state["marks"]
    assert (mark["kind"], mark["by"], mark["sigma"]) == ("hand", "hand", [0.5, 0.5])
    np.testing.assert_allclose([mark["x"], mark["y"]], empty, atol=1.0)


def test_marks_are_renamed_measured_again_deleted_and_all_is_undone(discs: Marking, tmp_path: Path) -> None:
    page = discs.page
    pane_of(discs, "photo 1.png")
    discs.click(0, DISCS[0])
    discs.click(0, DISCS[1])
    assert {mark["point"] for mark in discs.state["marks"]} == {"P1", "P2"}
    page.mouse.dblclick(*page.evaluate(PLACE, [0, *DISCS[2]]))
    discs.settled()
    assert {mark["point"] for mark in discs.state["marks"]} == {"P1", "P2", "P3"}
    discs.key("z")
    discs.click(0, DISCS[0])  # chooses what is there
    assert page.locator(".m-aim b").inner_text() == "P1" and len(discs.state["marks"]) == 2
    discs.key("r")
    page.get_by_label("name", exact=True).fill(EVIL)
    page.keyboard.press("Enter")
    discs.tab.until("(name) => document.querySelector('.m-card h2').textContent === 'Point ' + name", EVIL)
    discs.tab.until("() => !document.querySelector('dialog')")
    page.keyboard.down("Shift")
    discs.click(0, DISCS[2])
    page.keyboard.up("Shift")
    moved = next(mark for mark in discs.state["marks"] if mark["point"] == EVIL)
    np.testing.assert_allclose([moved["x"], moved["y"]], DISCS[2], atol=0.05)
    discs.key("Delete")
    assert [mark["point"] for mark in discs.state["marks"]] == ["P2"]
    for _ in range(5):
        discs.key("z")
    assert discs.state["marks"] == [] and discs.state["undo"] is None
    discs.key("Shift+Z")
    assert [mark["point"] for mark in discs.state["marks"]] == ["P1"]
    assert [key[1] for key in read_marks(tmp_path / "marks.csv").marks] == ["P1"]
    assert "broken" not in page.title()


def test_control_and_bars_are_stated_in_forms(discs: Marking) -> None:
    page = discs.page
    pane_of(discs, "photo 1.png")
    discs.click(0, DISCS[0])
    discs.click(0, DISCS[1])
    discs.key("c")
    for field, value in (
        ("X [mm]", "1.5"),
        ("Y [mm]", "-2"),
        ("Z [mm]", "x"),
        *((f"sigma {a} [mm]", "0.01") for a in "XYZ"),
    ):
        page.get_by_label(field, exact=True).fill(value)
    page.keyboard.press("Enter")
    assert page.get_by_role("alert").get_by_text("x is not a number.").count() == 1
    page.get_by_label("Z [mm]", exact=True).fill("0,25")
    page.keyboard.press("Enter")
    discs.tab.until("() => !document.querySelector('dialog')")
    point = next(p for p in discs.state["points"] if p["name"] == "P2")
    assert point["control"] == {"X": [1.5, -2, 0.25], "sigma": [0.01] * 3, "given": False}
    discs.key("b")
    page.get_by_label("to point").fill("P1")
    page.get_by_label("length [mm]").fill("400.003")
    page.get_by_label("sigma [mm]").fill("0.004")
    page.keyboard.press("Enter")
    discs.tab.until("() => !document.querySelector('dialog')")
    (bar,) = discs.state["bars"]
    assert (bar["start"], bar["end"], bar["length"], bar["sigma"]) == ("P2", "P1", 400.003, 0.004)
    page.get_by_role("button", name="delete the bar from P2 to P1").click()
    discs.settled()
    assert discs.state["bars"] == []


def test_two_pages_keep_each_other_current(browser: Any, folder: Path, tmp_path: Path) -> None:
    with served(folder / "survey.toml", tmp_path / "marks.csv") as server:
        pages = [open_page(browser, server), open_page(browser, server)]
        for page in pages:
            pane_of(page, "photo 1.png")
        pages[0].click(0, DISCS[0])
        pages[1].tab.until("() => document.getElementById('marking').page.model.state.marks.length === 1")
        pages[1].click(0, DISCS[1])
        pages[0].tab.until("() => document.getElementById('marking').page.model.state.marks.length === 2")
        names = [sorted(mark["point"] for mark in page.state["marks"]) for page in pages]
        assert names == [["P1", "P2"], ["P1", "P2"]]
        for page in pages:
            page.close()


@pytest.mark.parametrize("left", [True, False])
def test_a_late_answer_does_not_choose_again_what_the_person_has_left(discs: Marking, left: bool) -> None:
    """A click that takes long, N, and a click on another feature: another point; without N the same."""
    page = discs.page
    pane_of(discs, "photo 1.png")
    page.locator(".m-pane select").nth(1).select_option(label="photo 2.png")
    discs.ready()
    held: list[Any] = []
    page.route("**/click", lambda route: held.append(route) if not held else route.continue_())
    places = page.evaluate(PLACE, [0, *DISCS[0]]), page.evaluate(PLACE, [1, *(DISCS[1] + SHIFT)])
    page.mouse.click(*places[0])
    page.keyboard.press("n" if left else "h")
    page.keyboard.press("1")
    page.wait_for_timeout(450)
    page.mouse.click(*places[1])
    page.keyboard.press("7")  # of the next click
    page.keyboard.press("n")
    page.wait_for_timeout(50)
    held[0].continue_()
    discs.settled()
    marks = {(mark["image"], mark["point"], mark["kind"]) for mark in discs.state["marks"]}
    assert {(point, kind) for _, point, kind in marks} == {
        ("P1", "target"),
        ("P2" if left else "P1", "target"),
    }
    assert len({image for image, _, _ in marks}) == 2
    assert discs.chosen == "None"


def test_z_undoes_what_another_page_did_only_at_the_second_time(
    browser: Any, folder: Path, tmp_path: Path
) -> None:
    with served(folder / "survey.toml", tmp_path / "marks.csv") as server:
        pages = [open_page(browser, server), open_page(browser, server)]
        for page in pages:
            pane_of(page, "photo 1.png")
        pages[0].click(0, DISCS[0])
        pages[1].tab.until(f"() => {PAGE}.model.state.marks.length === 1")
        pages[1].key("z")
        assert "Another page made the last change: P1 marked in photo 1.png." in pages[1].said()
        assert len(pages[1].state["marks"]) == 1
        pages[1].key("z")
        assert pages[1].state["marks"] == [] and pages[1].said() == "Undone: P1 marked in photo 1.png."
        for page in pages:
            page.close()


def test_a_page_that_nobody_sees_holds_no_connection(discs: Marking, folder: Path) -> None:
    page = discs.page
    page.evaluate(
        "() => { Object.defineProperty(document, 'hidden', { configurable: true, get: () => true });"
        " document.dispatchEvent(new Event('visibilitychange')) }"
    )
    page.wait_for_timeout(200)
    asked = len(discs.tab.requests)
    server = discs.page.evaluate("() => location.href")
    pane_of(discs, "photo 1.png")
    discs.click(0, DISCS[0])  # changes are sent and answered
    assert len(discs.state["marks"]) == 1
    page.wait_for_timeout(500)
    assert not any("state" in url for url in discs.tab.requests[asked:]), server
    page.evaluate(
        "() => { Object.defineProperty(document, 'hidden', { configurable: true, get: () => false });"
        " document.dispatchEvent(new Event('visibilitychange')) }"
    )
    discs.tab.until(f"() => {PAGE}.model.state.adjustment.state !== 'running'")
    discs.page.wait_for_timeout(100)
    assert any("state" in url for url in discs.tab.requests[asked:])
    assert page.locator("#m-lost:visible").count() == 0


def test_a_lost_program_is_told_and_the_click_is_made_when_it_answers(discs: Marking) -> None:
    page = discs.page
    pane_of(discs, "photo 1.png")
    page.route("**/*", lambda route: route.abort())
    page.mouse.click(*page.evaluate(PLACE, [0, *DISCS[3]]))
    page.locator("#m-lost", has_text="does not answer").wait_for()
    assert discs.state["marks"] == []
    page.unroute("**/*")
    discs.settled()
    page.locator("#m-lost").wait_for(state="hidden")
    assert [mark["point"] for mark in discs.state["marks"]] == ["P1"]
    assert page.locator(".m-warning:visible").count() == 0
    discs.tab.complaints.clear()  # of the browser, about requests that failed


def test_everything_is_done_by_keys(discs: Marking) -> None:
    page = discs.page
    page.keyboard.press("?")
    assert page.locator("dialog kbd").count() > 40
    page.keyboard.press("Escape")
    page.locator(".m-view").first.focus()
    start = page.evaluate(f"() => {PAGE}.panes.map((pane) => pane.image)")
    discs.key(".")
    assert page.evaluate(f"() => {PAGE}.panes[0].image") == start[0] + 1
    discs.ready()
    place = page.evaluate(f"() => {PAGE}.panes[0].crosshair()")  # in the middle
    goal = DISCS[5]
    discs.key("ArrowRight")  # shows the crosshair
    scale = page.evaluate(f"() => {PAGE}.panes[0].frame().scale")
    steps = np.rint((goal - place) * scale).astype(int)
    for count, keys in zip(steps, (("ArrowLeft", "ArrowRight"), ("ArrowUp", "ArrowDown")), strict=True):
        for _ in range(abs(count) // 10):
            discs.key(keys[int(count > 0)])
        for _ in range(abs(count) % 10):
            discs.key(f"Shift+{keys[int(count > 0)]}")
    discs.key("Space")
    (mark,) = discs.state["marks"]
    np.testing.assert_allclose([mark["x"], mark["y"]], goal, atol=0.05)
    before = page.evaluate(f"() => {{ const p = {PAGE}; return [p.lights.brightness, p.lights.contrast] }}")
    for key in ("]", "]", "[", "}", "l", "h", "v", "t", "f", "PageDown"):
        discs.key(key)
    discs.ready()
    after = page.evaluate(f"() => {{ const p = {PAGE}; return [p.lights.brightness, p.lights.contrast] }}")
    assert after[0] > before[0] and after[1] > before[1]
    assert page.locator(".m-pane").count() == 4
    assert "brightness(1.15)" in page.locator(".m-stage canvas").first.evaluate(
        "(c) => getComputedStyle(c).filter"
    )
    # the focus is seen wherever Tab leads
    for _ in range(30):
        page.keyboard.press("Tab")
        outline = page.evaluate(
            "() => [document.activeElement].every((one) =>"
            " one === document.body || getComputedStyle(one).outlineStyle !== 'none')"
        )
        assert outline


def test_the_filmstrip_and_the_list_are_walked_through_by_keys(discs: Marking) -> None:
    page = discs.page
    discs.key(".")
    discs.ready()
    for place in DISCS[[0, 5, 9]]:
        discs.click(0, place)
    page.locator(".m-frame[aria-current]").focus()
    page.keyboard.press("End")
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("Enter")
    assert discs.images[0] == len(discs.state["photographs"]) - 2
    page.get_by_role("region", name="points; arrow keys select a row").focus()
    for key, point in (("Home", "P1"), ("ArrowDown", "P2"), ("End", "P3")):
        page.keyboard.press(key)
        assert discs.chosen == point
    page.keyboard.press("Escape")
    assert discs.chosen == "None"
    discs.key("k")
    assert discs.chosen == "P1"


def test_a_photograph_that_changed_is_named(browser: Any, folder: Path, tmp_path: Path) -> None:
    for path in folder.iterdir():
        shutil.copy(path, tmp_path)
    survey, marks = tmp_path / "survey.toml", tmp_path / "marks.csv"
    for changed in (False, True):
        if changed:
            cv2.imwrite(str(tmp_path / "photo 1.png"), picture(DISCS + 3))
        with served(survey, marks) as server:
            marking = open_page(browser, server)
            pane_of(marking, "photo 1.png")
            if not changed:
                marking.click(0, DISCS[0])
            frame = marking.page.get_by_role("button", name=re.compile("^photo 1.png: changed since"))
            assert frame.count() == int(changed)
            assert marking.page.locator(".m-warning:visible").count() == int(changed)
            marking.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1400, 800])
def test_the_page_is_readable(browser: Any, folder: Path, tmp_path: Path, scheme: str, width: int) -> None:
    with served(folder / "survey.toml", tmp_path / "marks.csv") as server:
        marking = open_page(browser, server, width=width, color_scheme=scheme)
        pane_of(marking, "photo 1.png")
        marking.click(0, DISCS[0])
        page = marking.page
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        ground, ink = page.evaluate(
            "() => { const s = getComputedStyle(document.body); return [s.backgroundColor, s.color] }"
        )
        light = [sum(int(v) for v in text[4:-1].split(",")) for text in (ground, ink)]
        assert (light[0] > light[1]) == (scheme == "light")
        for count in ("1", "4"):
            page.locator("label:has-text('side by side') select").select_option(count)
            marking.ready()
            sizes = page.locator(".m-view").evaluate_all(
                "all => all.map((v) => [v.clientWidth, v.clientHeight])"
            )
            assert len(sizes) == int(count) and np.min(sizes) > 150
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        marking.close()


@pytest.fixture(scope="module")
def demo(demo_photographs: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Targets]:
    """The survey of the demo without codes, and where its targets are."""
    return demo_survey(tmp_path_factory.mktemp("demo"), demo_photographs), targets_of(demo_photographs)


def normalised(xyz: FloatArray, sigma: FloatArray, truth: FloatArray) -> float:
    """Return the RMS of the errors after a similarity, in parts of their standard deviations."""
    to_truth = fit_similarity(xyz, truth)
    return float(np.sqrt((((to_truth.apply(xyz) - truth) / (to_truth.scale * sigma)) ** 2).mean()))


def test_from_nothing_to_a_report_by_clicks_and_keys(
    browser: Any, demo: tuple[Path, Targets], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Twelve points in twelve photographs, no code read; then everything else is found automatically."""
    monkeypatch.chdir(tmp_path)  # the result is in the folder out
    survey, targets = demo
    with served(survey, survey.parent / "marks.csv") as server:
        marking = open_page(browser, server, width=1400)
        person = Person(marking, targets)
        person.mark_pair(PAIR)
        person.orient_others()
        person.mark_more(MORE)
        while any(proposal["measured"] for proposal in marking.adjusted()["proposals"]):
            marking.key("Shift+Enter")
        assert marking.pressed < 60
        state = marking.state
        assert len(state["marks"]) == 144 and len({mark["point"] for mark in state["marks"]}) == 12
        assert all(photograph["oriented"] for photograph in state["photographs"])
        assert state["adjustment"]["sigma0_px"] < 0.05
        assert state["adjustment"]["worst"] is None or not state["adjustment"]["worst"]["flagged"]
        truth = np.array([targets.xyz[person.target_of[point["name"]]] for point in state["points"]])
        xyz, sigma = (np.array([point[key] for point in state["points"]]) for key in ("X", "sigma"))
        assert normalised(xyz, sigma, truth) < 2
        marking.key("a")
        assert marking.page.get_by_role("progressbar", name="automatic run").is_visible()
        marking.tab.until(f"() => {PAGE}.model.state.run.state !== 'running'")
        assert marking.state["run"]["state"] == "done", marking.state["run"]
        link = marking.page.get_by_role("link", name="Open the report")
        with marking.tab.context.expect_page() as opened:
            link.click()
        report = opened.value
        report.wait_for_load_state()
        assert "12 photographs" in report.inner_text("body")
        (tmp_path / "other.txt").write_text("not of the report", encoding="utf-8")
        for name, status in (("points.csv", 200), ("..%2F..%2Fother.txt", 404), ("%2Fetc%2Fhostname", 404)):
            assert report.request.get(f"{server.address.url}report/{name}").status == status
        result = read_result(Path(marking.state["run"]["report"]).parent)
        rows = [result.network.points.index(point["name"]) for point in state["points"]]
        assert len(result.network.points) > 60 and result.point_covariance is not None
        variance = np.diagonal(result.point_covariance[rows], axis1=1, axis2=2)
        assert normalised(result.estimate.points[rows], np.sqrt(variance), truth) < 1.3
        marking.close()


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[MarkedProject, FloatArray]:
    """Two oriented photographs of natural texture, and the projection centres."""
    folder = tmp_path_factory.mktemp("pair")
    position = np.array([[-0.2, 0.0, 1.6], [0.2, 0.0, 1.6]])
    rotation = np.tile(np.eye(3), (2, 1, 1))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(textured, "stations", lambda: (position, rotation))
        skin = textured.texture()
        for i in range(2):
            photograph = textured.photograph(i, textured.intensities(i, skin))
            cv2.imwrite(str(folder / f"surface_{i + 1}.png"), photograph)
    survey = (ROOT / "datasets" / "textured" / "survey.toml").read_text(encoding="utf-8")
    (folder / "survey.toml").write_text(survey, encoding="utf-8")
    x, y = (part.ravel() for part in np.meshgrid(np.linspace(-0.3, 0.3, 5), np.linspace(-0.3, 0.3, 4)))
    points = np.column_stack([x, y, textured.height(x, y)])
    camera = textured.camera()
    network = Network.from_arrays(
        image=[f"surface_{i + 1}.png" for i in range(2) for _ in points],
        point=[f"N{j + 1}" for _ in range(2) for j in range(len(points))],
        xy=np.concatenate([project(camera, position[i], rotation[i], points) for i in range(2)])
        + np.random.default_rng(2).normal(0, 0.02, (2 * len(points), 2)),
        sigma_px=0.02,
    )
    estimate = Estimate((camera,), position, rotation, points)
    solution = Solution("textured", network, estimate, unit="m")
    return project_of_survey(read_survey(folder / "survey.toml"), solution=solution), position


def marks_of(marking: Marking, point: str) -> list[Any]:
    marks = [mark for mark in marking.state["marks"] if mark["point"] == point]
    return sorted(marks, key=lambda mark: int(mark["image"]))


def distance_to(line: FloatArray, place: FloatArray) -> float:
    """Return the distance of a place from a polyline, px."""
    start, along = line[:-1], np.diff(line, axis=0)
    t = np.clip(((place - start) * along).sum(axis=1) / (along**2).sum(axis=1), 0, 1)
    return float(np.linalg.norm(start + t[:, None] * along - place, axis=1).min())


def test_a_click_in_the_left_photograph_is_matched_in_the_right(
    browser: Any, pair: tuple[MarkedProject, FloatArray], tmp_path: Path
) -> None:
    """Document 002: a pair, a click at the left, its match at the right, and the coordinates."""
    marked, position = pair
    camera = textured.camera()
    with served(marked, tmp_path / "marks.csv") as server:
        marking = open_page(browser, server)
        page = marking.page
        marking.key("6")
        for xy in ((620.0, 300.0), (560.0, 500.0), (700.0, 420.0)):
            marking.key("n")
            marking.click(0, xy)
            (left,) = marks_of(marking, marking.chosen)
            uv = tangents_from_pixel(camera, np.array([[left["x"], left["y"]]]))
            truth = textured.surface_points(position[0], np.column_stack([uv, [-1.0]]))
            seen = project(camera, position[1], np.eye(3), truth)[0]
            state = marking.adjusted()
            (line,) = (line for line in state["lines"] if line["point"] == marking.chosen)
            assert line["image"] == 1 and distance_to(np.array(line["xy"]), seen) < 0.1
            page.mouse.move(*page.evaluate(PLACE, [0, left["x"], left["y"]]))  # the ray of sight there
            marking.tab.until(f"() => {PAGE}.panes[1].sight.length")
            page.wait_for_timeout(150)
            ray = np.array(page.evaluate(f"() => {PAGE}.panes[1].sight[0]"))
            assert distance_to(ray, seen) < 2  # as exact as a place on the screen
            (proposal,) = marking.proposals_of(marking.chosen)
            assert proposal["image"] == 1 and proposal["measured"]
            marking.key("Enter")
            right = marks_of(marking, marking.chosen)[1]
            np.testing.assert_allclose([right["x"], right["y"]], seen, atol=0.2)
            state = marking.adjusted()
            point = next(p for p in state["points"] if p["name"] == marking.chosen)
            assert (np.abs(point["X"] - truth[0]) < 5 * np.array(point["sigma"])).all()
            shown = page.locator(".m-card").first.inner_text()
            assert all(f"{axis}\t" in shown or f"{axis}\n" in shown for axis in "XYZ") and "sigma" in shown
        for xy in ((520.0, 350.0), (650.0, 560.0)):  # proposals stay until all are accepted
            marking.click(0, xy)
            marking.adjusted()
        assert sum(proposal["measured"] for proposal in marking.state["proposals"]) == 2
        marking.key("Shift+Enter")
        assert all(len(marks_of(marking, f"P{k + 1}")) == 2 for k in range(5))
        marking.close()
