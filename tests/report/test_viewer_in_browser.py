"""The viewer in a real browser: chromium with software rendering, from file://, as a person would use it."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sfm.model.conventions import IntArray
from sfm.model.solution import Solution
from sfm.report.view_page import view_page, write_view
from sfm.report.viewer.embedded import scene_of_stored
from sfm.report.viewer.pictures import Bar, Marks, ViewerScene, cut_pictures, distance_sigmas
from tests.browser import Tab
from tests.synthetic import SIZE_PX, make_network, seed_of

EVIL = "<img src=https://example.org/x onerror=document.title='broken'>"
IMAGES, POINTS = 5, 24
RADIUS_PX = 9
REJECTED = 3  # a ray
REASONS = ("measured, not part of the result", "too small")  # what matters most first

SELECT = "([kind, index]) => document.getElementById('explore').viewer.hub.tell('select', {kind, index})"
PLACE = """(j) => {
  const { scene, model } = document.getElementById('explore').viewer
  const at = scene.project(scene.local(model.xyz(j)))
  const box = scene.canvas.getBoundingClientRect()
  return [box.left + at[0], box.top + at[1]]
}"""
IN_PYRAMID = """(i) => {
  const { scene, model } = document.getElementById('explore').viewer
  const [c, R] = [model.centre(i), model.rotation(i)]
  const inside = [0, 1, 2].map((r) => c[r] - 0.6 * scene.pyramid * R[3 * r + 2])
  const at = scene.project(scene.local(inside))
  const box = scene.canvas.getBoundingClientRect()
  return [box.left + at[0], box.top + at[1]]
}"""
PIXELS = """() => {
  const { scene, model } = document.getElementById('explore').viewer
  scene.select(null)
  const over = [scene.photographs.object, scene.given, scene.control, scene.distance]
  for (const part of over) part.visible = false
  scene.draw()
  const copy = document.createElement('canvas')
  Object.assign(copy, { width: scene.canvas.width, height: scene.canvas.height })
  const context = copy.getContext('2d')
  context.drawImage(scene.canvas, 0, 0)
  const ratio = scene.canvas.width / scene.canvas.clientWidth
  const seen = model.points.map((_, j) => {
    const [x, y] = scene.project(scene.local(model.xyz(j)))
    return [...context.getImageData(x * ratio, y * ratio, 1, 1).data].slice(0, 3)
  })
  for (const part of over) part.visible = true
  return seen
}"""


def grey_of(j: int) -> int:
    """Return the intensity by which the target of a point is known again."""
    return 60 + 8 * j


def small_scene() -> ViewerScene:
    network, truth = make_network(seed_of("viewer"), images=IMAGES, points=POINTS, planar=True, noise_px=0.2)
    rng = seed_of("viewer covariance")
    spread = np.repeat(np.geomspace(2e-5, 5e-4, POINTS), 3)  # so that points differ in colour
    root = spread[:, None] * rng.normal(0, 1, (3 * POINTS, 3 * POINTS))
    joint = root @ root.T / POINTS
    own = np.array([joint[3 * j : 3 * j + 3, 3 * j : 3 * j + 3] for j in range(POINTS)])
    network = replace(network, points=(EVIL, *network.points[1:]), images=(EVIL, *network.images[1:]))
    rejected = np.zeros(len(network.image_points), dtype=bool)
    rejected[REJECTED] = True
    stored = Solution("viewer", network, truth, own, unit="m", covariance=joint)
    made = scene_of_stored(stored, rejected=rejected)
    ellipse = np.tile([float(RADIUS_PX), float(RADIUS_PX), 0.0], (len(made.rays), 1))
    marks = Marks(np.array([0, 0]), np.array([[50.0, 60.0], [80.0, 60.0]]), np.array([1, 0]), REASONS)
    bar = Bar(1, 2, 0.5, 1e-4, 2e-5)
    return replace(made, rays=replace(made.rays, ellipse=ellipse), marks=marks, bars=(bar,), control=(3,))


def photographs(scene: ViewerScene, folder: Path) -> dict[str, Path]:
    """Draw every target as a disc of the intensity of its point."""
    found = {}
    for i, name in enumerate(scene.photographs):
        picture = np.full(SIZE_PX[::-1], 30, np.uint8)
        rows: IntArray = np.flatnonzero(scene.rays.photo == i)
        for k in rows:
            centre = tuple(int(x) for x in np.rint(scene.rays.xy[k]))
            cv2.circle(picture, centre, RADIUS_PX, grey_of(int(scene.rays.point[k])), -1)
        found[name] = folder / f"{i}.png"
        cv2.imwrite(str(found[name]), picture)
    return found


@pytest.fixture(scope="module")
def scene() -> ViewerScene:
    return small_scene()


@pytest.fixture(scope="module")
def page_file(scene: ViewerScene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("viewer")
    return write_view(scene, folder / "page.html", source="here", paths=photographs(scene, folder))


@pytest.fixture(scope="module")
def tab(browser: Any, page_file: Path) -> Iterator[Tab]:
    opened = Tab(browser, page_file)
    opened.ready()
    yield opened
    assert opened.complaints == []
    assert opened.requests[:1] == [page_file.as_uri()]
    assert all(url.startswith("data:image/jpeg;base64,") for url in opened.requests[1:])
    assert opened.page.title() == "viewer - Kolinear"  # no name has become markup
    opened.close()


def test_a_click_on_a_point_shows_its_crops(tab: Tab, scene: ViewerScene) -> None:
    page = tab.page
    hint = page.locator(".v-hint").last  # no warning
    assert hint.evaluate("(one) => Number(getComputedStyle(one).fontWeight)") == 400
    for j in (5, 11):
        page.get_by_role("button", name="reset").click()  # a chosen point is seen from near
        page.mouse.click(*page.evaluate(PLACE, j))
        page.wait_for_selector(f".v-title:text-is('Point {scene.points[j]}')")
        own = np.flatnonzero(scene.rays.point == j)
        shown = page.locator(".v-crop").evaluate_all("cards => cards.map((card) => Number(card.dataset.ray))")
        assert sorted(shown) == own.tolist()
        tab.until("n => document.querySelectorAll('.v-crop canvas[data-ready]').length === n", len(own))
        # Away from the cross in the middle and the vector, inside the disc, its intensity is the point's.
        greys = page.locator(".v-crop canvas").evaluate_all(
            "all => all.map((c) => { const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;"
            " const m = []; for (let y = 0.4; y < 0.6; y += 0.01) for (let x = 0.4; x < 0.6; x += 0.01)"
            " m.push(d[4 * (Math.floor(y * c.height) * c.width + Math.floor(x * c.width))]);"
            " return m.sort((a, b) => a - b)[m.length >> 1] })"
        )
        assert np.abs(np.array(greys) - grey_of(j)).max() <= 3


def test_colours_follow_the_legend(tab: Tab, scene: ViewerScene) -> None:
    page = tab.page
    bar = page.evaluate(
        "() => { const c = document.querySelector('.v-legend canvas');"
        " return Array.from(c.getContext('2d').getImageData(0, 0, c.width, 1).data) }"
    )
    colours = np.array(bar).reshape(-1, 4)[:, :3]
    sigma = np.sqrt(np.trace(scene.covariance, axis1=1, axis2=2) / 3)
    low, high = page.evaluate(
        "() => { const { point } = document.getElementById('explore').viewer.scene.scales;"
        " return [point.from, point.to] }"
    )
    assert (low, high) == pytest.approx((sigma.min(), sigma.max()), rel=1e-6)
    places = np.log(sigma / low) / np.log(high / low) * (len(colours) - 1)
    away = np.abs(colours[np.rint(places).astype(int)] - np.array(page.evaluate(PIXELS))).max(axis=1)
    assert (away <= 6).mean() >= 0.8  # some points lie behind others
    assert np.abs(colours[0].astype(int) - colours[-1]).max() > 100
    page.select_option("#points-by", "rays")
    assert page.locator(".v-legend-name").first.inner_text() == "rays of a point"
    page.select_option("#points-by", "sigma")


EXTENT = """() => {
  const { scene, model } = document.getElementById('explore').viewer
  const seen = model.points.map((_, j) => scene.project(scene.local(model.xyz(j))))
  const { clientWidth, clientHeight } = scene.canvas
  return [seen.map((p) => p[0] / clientWidth), seen.map((p) => p[1] / clientHeight)]
}"""


@pytest.mark.parametrize("width", [1300, 400])
@pytest.mark.parametrize("orthographic", [False, True])
def test_the_object_fills_the_canvas_and_a_chosen_point_is_in_its_middle(
    browser: Any, page_file: Path, width: int, orthographic: bool
) -> None:
    tab = Tab(browser, page_file, width=width)
    page = tab.ready()
    if orthographic:
        page.get_by_label("orthographic").check()
    for _ in range(2):
        page.get_by_label("standard views").select_option("home")
        seen = np.array(page.evaluate(EXTENT))
        assert seen.min() >= 0.04 and seen.max() <= 0.96
        assert np.ptp(seen, axis=1).max() == pytest.approx(0.9, abs=0.01)
        before = np.linalg.norm(np.diff(seen[:, [4, 9]]))
        page.evaluate(SELECT, ["point", 9])
        chosen = np.array(page.evaluate(EXTENT))
        np.testing.assert_allclose(chosen[:, 9], 0.5, atol=0.01)
        assert np.linalg.norm(np.diff(chosen[:, [4, 9]])) > 1.3 * before
    page.evaluate(SELECT, ["photograph", 2])  # not seen: the view takes it in
    at = np.array(
        page.evaluate(
            "() => { const { scene, model } = document.getElementById('explore').viewer;"
            " return scene.project(scene.local(model.centre(2))).map((x, k) =>"
            " x / [scene.canvas.clientWidth, scene.canvas.clientHeight][k]) }"
        )
    )
    assert at.min() >= 0 and at.max() <= 1
    assert tab.complaints == []
    tab.close()


STATIONS = """(farther) => {
  const { scene } = document.getElementById('explore').viewer
  const { clientWidth, clientHeight } = scene.canvas
  const stations = scene.stations
  scene.stations = stations.map((p) => p.clone().multiplyScalar(farther))
  scene.home([...scene.object, ...scene.stations])
  const [share, places] = [scene.share(), scene.stations.map((p) => scene.project(p))]
  scene.begin()
  const seen = scene.stations.map((p) => scene.project(p) ?? [-1, -1])
  scene.stations = stations
  return [share, scene.share(), [...places, ...seen].map(([x, y]) => [x / clientWidth, y / clientHeight])]
}"""


@pytest.mark.parametrize("width", [1300, 400])
def test_the_first_view_shows_photographs_too_unless_the_object_is_small_among_them(
    browser: Any, page_file: Path, width: int
) -> None:
    tab = Tab(browser, page_file, width=width)
    page = tab.ready()
    shares = []
    for farther in (0.5, 0.7, 1.0, 1.4, 2.0, 2.8):
        with_photographs, share, places = page.evaluate(STATIONS, farther)
        inside = (np.abs(np.array(places) - 0.5) <= 0.46).all(axis=1)
        assert inside[:IMAGES].all()
        if with_photographs >= 1 / 3:
            assert share == with_photographs and inside.all()
        else:
            assert share == pytest.approx(0.9, abs=0.01) and not inside.all()
        shares.append(with_photographs)
    assert any(1 / 6 < s < 1 / 3 for s in shares) and any(1 / 3 < s < 2 / 3 for s in shares)
    tab.close()


def test_legends_are_beside_the_scene_and_rays_are_drawn_on_demand(tab: Tab, scene: ViewerScene) -> None:
    page = tab.page
    stage = page.locator(".v-stage").bounding_box()
    for legend in page.locator(".v-legend:visible").all():
        box = legend.bounding_box()
        assert box["y"] + box["height"] <= stage["y"] or box["y"] >= stage["y"] + stage["height"]
    drawn = (
        "() => document.getElementById('explore').viewer.scene.rays.accepted"
        ".geometry.attributes.position.count"
    )
    page.evaluate(SELECT, ["point", 8])
    assert page.evaluate(drawn) == 0
    page.get_by_label("rays of the selection").check()
    assert page.evaluate(drawn) == 2 * int((scene.rays.point == 8).sum())
    page.get_by_label("rays of the selection").uncheck()
    assert page.evaluate(drawn) == 0
    page.get_by_role("button", name="reset").click()


def test_every_scale_spans_the_values_of_the_page(tab: Tab, scene: ViewerScene) -> None:
    page = tab.page
    values = {"rays": scene.rays_of_point, "rms": scene.point_rms_px, "angle": scene.angle_deg}
    for key, all_of_them in values.items():
        page.select_option("#points-by", key)
        low, high = page.evaluate(
            "() => { const { point } = document.getElementById('explore').viewer.scene.scales;"
            " return [point.from, point.to] }"
        )
        assert low == pytest.approx(all_of_them.min(), rel=1e-6)
        assert high == pytest.approx(all_of_them.max() if np.ptp(all_of_them) else low + 1, rel=1e-6)
        ends = page.locator(".v-legend").first.locator(".v-end")
        ticks = page.locator(".v-legend").first.locator(".v-ticks span").all_inner_texts()
        assert not {ends.nth(0).input_value(), ends.nth(1).input_value()} & set(ticks)
    page.select_option("#points-by", "sigma")


def test_fixed_points_are_coloured_by_what_the_list_names(
    browser: Any, scene: ViewerScene, tmp_path: Path
) -> None:
    """They have no standard deviation: "fixed" in the table and the panel, and no colours by it."""
    fixed = replace(scene, covariance=np.zeros_like(scene.covariance), distance_sigma=None)
    path = write_view(fixed, tmp_path / "fixed.html", source="here", paths={})
    tab = Tab(browser, path)
    page = tab.ready()
    chosen = page.locator("#points-by")
    assert chosen.input_value() == "rms" and chosen.locator("option[value=sigma]").count() == 0
    assert page.locator(".v-legend-name").first.inner_text().startswith("RMS residual of a point")
    page.evaluate(SELECT, ["point", 3])
    panel = page.locator(".v-panel").inner_text()
    assert panel.count("fixed") == 3 and "sigma" not in panel
    row = page.locator("table:has(th:has-text('sX')) tbody tr:has-text('fixed')").first
    assert row.inner_text().count("fixed") == 4
    tab.close()


def test_colours_are_visible_in_dark_mode(browser: Any, page_file: Path) -> None:
    """Contrast with the background is 3 : 1 at least (WCAG 2.2, success criterion 1.4.11)."""
    tab = Tab(browser, page_file, color_scheme="dark")
    page = tab.ready()
    shades, background = page.evaluate(
        "() => { const { scene } = document.getElementById('explore').viewer; scene.draw();"
        " const copy = document.createElement('canvas'); Object.assign(copy, { width: 9, height: 9 });"
        " const context = copy.getContext('2d'); context.drawImage(scene.canvas, 0, 0);"
        " const all = []; for (let k = 0; k <= 20; k++) for (const scale of ['point', 'photograph'])"
        " all.push(scene.scales[scale].shade(k / 20));"
        " return [all, [...context.getImageData(2, 2, 1, 1).data].slice(0, 3)] }"
    )

    def luminance(rgb: Any) -> Any:
        c = np.asarray(rgb) / 255
        return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4) @ [0.2126, 0.7152, 0.0722]

    assert luminance(background) < 0.02
    assert ((luminance(shades) + 0.05) / (luminance(background) + 0.05)).min() >= 3
    assert tab.complaints == []
    tab.close()


def test_tables_are_sorted_filtered_and_walked_through(tab: Tab, scene: ViewerScene) -> None:
    page = tab.page
    table = page.locator(".v-table").first
    table.get_by_role("button", name="RMS [px]").click()
    first = table.locator("tbody tr[data-row]").first
    assert int(first.get_attribute("data-row")) == int(np.argmax(scene.point_rms_px))
    assert table.locator("th[aria-sort=descending]").count() == 1
    table.get_by_role("button", name="RMS [px]").click()
    assert int(first.get_attribute("data-row")) == int(np.argmin(scene.point_rms_px))
    median = float(np.median(scene.point_rms_px))
    table.locator("input[type=search]").fill(f"rms > {median!r}")
    above = int((scene.point_rms_px.astype(np.float32) > median).sum())
    assert table.locator(".v-count").inner_text() == f"{above} of {POINTS}"
    table.locator("input[type=search]").fill("nothing >> 3")
    assert table.locator("input.v-wrong").count() == 1
    table.locator("input[type=search]").fill("")
    table.get_by_role("button", name="point", exact=True).click()
    table.locator(".v-rows").focus()
    page.keyboard.press("Home")
    page.keyboard.press("ArrowDown")
    chosen = int(table.locator("tr.v-chosen").get_attribute("data-row"))
    assert page.locator(".v-title").inner_text() == f"Point {scene.points[chosen]}"


def test_tables_are_copied_as_csv(browser: Any, page_file: Path, scene: ViewerScene) -> None:
    tab = Tab(browser, page_file)
    page = tab.ready()
    page.evaluate("() => { navigator.clipboard.writeText = async (text) => { window.copied = text } }")
    page.locator(".v-table").first.get_by_role("button", name="Copy as CSV").click()
    tab.until("() => window.copied")
    rows = list(csv.reader(io.StringIO(page.evaluate("window.copied"))))
    assert [row[0] for row in rows[1:]] == list(scene.points)
    assert rows[0][:4] == ["point", "X [m]", "Y [m]", "Z [m]"]
    xyz = np.array([[float(x) for x in row[1:4]] for row in rows[1:]])
    np.testing.assert_allclose(xyz, scene.xyz, rtol=1e-11)
    tab.close()


def test_a_row_a_search_and_a_photograph_choose_the_same(tab: Tab, scene: ViewerScene) -> None:
    page = tab.page
    find = page.get_by_label("find by name")
    find.fill("image 3")
    find.press("Enter")
    page.wait_for_selector(".v-title:text-is('Photograph image 3')")
    page.wait_for_selector(".v-photo[data-ready='1']")
    assert page.locator(".v-rays").count() == 0
    box = page.locator(".v-photo").bounding_box()
    k = int(np.flatnonzero(scene.rays.photo == 2)[4])
    x, y = (scene.rays.xy[k] + 0.5) / SIZE_PX
    page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])
    page.wait_for_selector(f".v-title:text-is('Point {scene.points[scene.rays.point[k]]}')")


def test_rejected_candidates_tell_their_reason(tab: Tab) -> None:
    page = tab.page
    page.evaluate(SELECT, ["photograph", 0])
    page.wait_for_selector(".v-photo[data-ready='1']")
    assert page.locator(".v-title").inner_text() == f"Photograph {EVIL}"
    box = page.locator(".v-photo").bounding_box()
    page.mouse.move(box["x"] + 50.5 / SIZE_PX[0] * box["width"], box["y"] + 60.5 / SIZE_PX[1] * box["height"])
    assert page.locator(".v-told").inner_text() == "x 50.0, y 60.0 px: too small"


def test_what_was_seen_and_not_used_opens_with_what_matters(tab: Tab) -> None:
    page = tab.page
    page.get_by_role("tab", name=re.compile("detected but not used")).click()
    rows = page.get_by_role("table", name="detected but not used").locator("tbody tr[data-row]")
    assert [REASONS[k] in rows.nth(k).inner_text() for k in range(2)] == [True, True]
    page.get_by_role("tab", name=re.compile("^points")).click()


def test_distance_has_its_sigma_from_the_joint_covariance(tab: Tab, scene: ViewerScene) -> None:
    page = tab.page
    page.evaluate(SELECT, ["point", 4])
    page.get_by_role("button", name="Measure a distance from here").click()
    page.evaluate(SELECT, ["point", 9])
    words = page.locator(".v-length").inner_text()
    length = float(np.linalg.norm(scene.xyz[9] - scene.xyz[4]))
    assert float(words.split()[0]) == pytest.approx(length, abs=1e-4)
    assert scene.distance_sigma is not None
    n = POINTS
    sigma = scene.distance_sigma[4 * n - 4 * 5 // 2 + 9 - 5]
    assert float(words.split("sigma ")[1].split()[0]) == pytest.approx(sigma * 1e6, rel=0.006)
    assert "covariance of all points" in words


def test_sigma_of_a_distance_is_that_of_the_law_of_propagation() -> None:
    rng = seed_of("distance")
    xyz = rng.normal(size=(4, 3))
    root = rng.normal(0, 1e-3, (12, 12))
    joint = root @ root.T
    drawn = xyz.ravel() + rng.multivariate_normal(np.zeros(12), joint, 40_000)
    drawn = drawn.reshape(-1, 4, 3)
    pairs = [(i, j) for i in range(4) for j in range(i + 1, 4)]
    spread = [np.linalg.norm(drawn[:, j] - drawn[:, i], axis=1).std() for i, j in pairs]
    np.testing.assert_allclose(distance_sigmas(xyz, joint), spread, rtol=0.03)


def test_a_photograph_shows_its_thumbnail_under_the_pointer(tab: Tab, scene: ViewerScene) -> None:
    page = tab.page
    page.evaluate("document.getElementById('explore').viewer.hub.tell('select', null)")
    page.locator(".v-choice select", has_text="view").select_option("all")
    page.locator(".v-scene").scroll_into_view_if_needed()
    seen = set()
    for i in range(IMAGES):
        page.mouse.move(*page.evaluate(IN_PYRAMID, i))
        page.wait_for_timeout(150)
        if page.locator(".v-hover img").count():
            assert page.locator(".v-hover img").evaluate("one => one.complete && one.naturalWidth") == 160
            seen.add(page.locator(".v-hover b").inner_text())
    assert seen <= set(scene.photographs) and len(seen) >= 3  # some lie behind others or outside


def test_the_scene_is_on_paper(tab: Tab) -> None:
    """The canvas of the scene is empty by the time its page is laid out on paper: a copy stands there."""
    page = tab.page
    page.evaluate(SELECT, ["point", 3])
    page.emulate_media(media="print")
    page.evaluate("window.dispatchEvent(new Event('beforeprint'))")
    copy = page.locator(".v-printed")
    assert copy.is_visible() and not page.locator(".v-scene").is_visible()
    colours = copy.evaluate(
        "(c) => new Set(new Uint32Array("
        "c.getContext('2d').getImageData(0, 0, c.width, c.height).data.buffer)).size"
    )
    assert colours > 20
    page.evaluate("window.dispatchEvent(new Event('afterprint'))")
    page.emulate_media(media="screen")
    assert copy.count() == 0 and page.locator(".v-scene").is_visible()


def test_large_scenes_turn_with_fewer_points_and_say_so(browser: Any, tmp_path: Path) -> None:
    network, truth = make_network(seed_of("many"), images=3, points=6000, planar=True, visibility=0.5)
    many = scene_of_stored(Solution("many", network, truth, unit="m"))
    tab = Tab(browser, write_view(many, tmp_path / "many.html", source="here", paths={}))
    page = tab.ready()
    page.evaluate("() => { document.getElementById('explore').viewer.scene.mean = 1000 }")  # a slow machine
    page.evaluate(
        "() => { const { scene } = document.getElementById('explore').viewer; scene.turn(0.1, 0);"
        " scene.turn(0.1, 0); scene.draw(); window.told = document.querySelector('.v-thin').textContent;"
        " window.drawn = scene.points.geometry.drawRange.count }"
    )
    n = len(many.points)
    told = re.fullmatch(r"1 in (\d+) points shown while the scene moves", page.evaluate("window.told"))
    assert told is not None and int(told[1]) >= 2
    assert page.evaluate("window.drawn") == -(-n // int(told[1]))
    tab.until("n => document.getElementById('explore').viewer.scene.points.geometry.drawRange.count === n", n)
    assert not page.locator(".v-thin").is_visible()
    assert tab.complaints == []
    tab.close()


def test_crops_without_room_are_shown_from_beside_the_page(
    browser: Any, scene: ViewerScene, tmp_path: Path
) -> None:
    pictures = cut_pictures(scene, photographs(scene, tmp_path), budget_mb=0.0, beside="pictures")
    (tmp_path / "pictures").mkdir()
    for name, content in pictures.beside.items():
        (tmp_path / "pictures" / name).write_bytes(content)
    (tmp_path / "page.html").write_text(view_page(scene, pictures, "here"), encoding="utf-8")
    tab = Tab(browser, tmp_path / "page.html")
    page = tab.ready()
    for j in (7, 20):
        page.evaluate(SELECT, ["point", j])
        tab.until("() => document.querySelectorAll('.v-crop canvas:not([data-ready])').length === 0")
        crop = page.locator(".v-crop canvas").first
        data = np.frombuffer(crop.screenshot(), np.uint8)
        seen = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
        h, w = seen.shape
        middle = seen[int(0.4 * h) : int(0.6 * h), int(0.4 * w) : int(0.6 * w)]
        assert abs(float(np.median(middle)) - grey_of(j)) <= 4
    assert tab.complaints == []
    assert all(url.startswith(tmp_path.as_uri() + "/") for url in tab.requests)
    tab.close()
    for path in (tmp_path / "pictures").iterdir():  # as where the page alone was mailed
        path.unlink()
    alone = Tab(browser, tmp_path / "page.html")
    page = alone.ready()
    page.evaluate(SELECT, ["point", 9])
    page.locator(".v-nocrop", has_text="not beside this page").first.wait_for()
    alone.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_narrow_screens_need_no_sideways_scrolling(browser: Any, page_file: Path, scheme: str) -> None:
    tab = Tab(browser, page_file, width=400, color_scheme=scheme)
    page = tab.ready()
    for chosen in (["point", 5], ["photograph", 1]):
        page.evaluate(SELECT, chosen)
        assert page.evaluate("document.documentElement.scrollWidth") <= 400
    rows = page.locator(".v-rows:visible").first
    edges = "(one) => [one.scrollWidth > one.clientWidth, getComputedStyle(one).backgroundAttachment]"
    assert rows.evaluate(edges) == [True, "local, local, scroll, scroll"]  # shaded where columns are hidden
    assert tab.complaints == []
    tab.close()


def test_without_a_script_the_page_still_tells_its_figures(browser: Any, page_file: Path) -> None:
    tab = Tab(browser, page_file, java_script_enabled=False)
    text = tab.page.inner_text("body")
    assert f"{IMAGES} photographs, {POINTS} points" in text
    assert "RMS residual" in text
    assert not tab.page.locator("#explore").is_visible()
    tab.close()


def test_displacements_and_deviations_are_coloured_and_drawn(
    browser: Any, scene: ViewerScene, tmp_path: Path
) -> None:
    """Colours follow the legend, moved points have red arrows, and the panel says the displacement."""
    size = np.linspace(1e-4, 2.4e-3, POINTS)
    displacement = np.zeros((POINTS, 3))
    displacement[:, 2] = size
    state = tuple("moved" if j % 2 else "stable" for j in range(POINTS))
    values = np.linspace(-2e-3, 1e-3, POINTS)
    pages = {
        "displacement": replace(scene, displacement=displacement, state=state, notes=("of the epochs",)),
        "deviation": replace(scene, deviation=values),
    }
    for kind, made in pages.items():
        page = write_view(made, tmp_path / f"{kind}.html", source="here", paths={})
        tab = Tab(browser, page)
        tab.ready()
        assert tab.page.locator("#points-by").input_value() == kind
        assert f"{kind} of a point" in tab.page.locator(".v-legend-name").first.inner_text()
        shades = tab.page.evaluate(
            "() => { const { scene } = document.getElementById('explore').viewer;"
            " return [...scene.scales.values].map((v) => scene.scales.point.colour(v)) }"
        )
        if kind == "displacement":  # whose arrows begin in the middle of the points
            tab.page.get_by_label("displacements", exact=True).uncheck()
        seen = np.array(tab.page.evaluate(PIXELS), dtype=float)
        assert np.median(np.abs(seen - np.array(shades)).max(axis=1)) <= 6
        first, last = np.array(shades[0]), np.array(shades[-1])
        assert np.abs(first - last).max() > 80
        if kind == "displacement":
            assert "moved points in red" in tab.page.locator(".v-top").inner_text()
            tab.page.evaluate(SELECT, ["point", 23])
            panel = tab.page.locator(".v-panel").inner_text()
            assert (
                "2.40 mm (0.00, 0.00, 2.40), moved" in panel
                or "2400.00 µm (0.00, 0.00, 2400.00), moved" in panel
            )
            ends = tab.page.evaluate(
                "() => document.getElementById('explore').viewer.scene.displacements.object.children.map("
                "(part) => part.geometry.attributes.position.count)"
            )
            assert ends == [6 * POINTS // 2, 6 * POINTS // 2]
        assert tab.complaints == []
        tab.close()


def test_a_plan_has_stations_in_view_and_nothing_of_residuals(
    browser: Any, scene: ViewerScene, tmp_path: Path
) -> None:
    """Image points of a plan have no residuals: no scale, no column and no figure of them."""
    planned = replace(
        scene,
        point_rms_px=np.zeros_like(scene.point_rms_px),
        photo_rms_px=np.zeros_like(scene.photo_rms_px),
        position=scene.xyz.mean(axis=0) + 12 * (scene.position - scene.xyz.mean(axis=0)),
    )
    tab = Tab(browser, write_view(planned, tmp_path / "plan.html", source="here", paths={}), width=500)
    page = tab.ready()
    assert page.locator(".v-legend:visible").count() == 1
    assert page.locator("option[value=rms]").count() == 0
    assert page.locator("#explore th:has-text('RMS')").count() == 0
    seen = page.evaluate(
        "() => { const { scene } = document.getElementById('explore').viewer;"
        " return scene.stations.map((p) => "
        "{ const q = p.clone().project(scene.camera); return [q.x, q.y] }) }"
    )
    assert len(seen) == 7 * IMAGES and np.abs(seen).max() <= 0.95
    page.evaluate(SELECT, ["point", 3])
    assert "RMS" not in page.locator(".v-panel").inner_text()
    assert tab.complaints == []
    tab.close()


def test_names_do_not_overlap(tab: Tab) -> None:
    page = tab.page
    page.get_by_label("names", exact=True).check()
    page.evaluate("() => document.getElementById('explore').viewer.scene.draw()")
    boxes = np.array(page.evaluate("() => document.getElementById('explore').viewer.scene.named"))
    page.get_by_label("names", exact=True).uncheck()
    assert len(boxes) > IMAGES
    low, high = boxes[:, None, :2], boxes[None, :, 2:]
    apart = ((low >= high) | (low.swapaxes(0, 1) >= high.swapaxes(0, 1))).any(axis=2)
    assert (apart | np.eye(len(boxes), dtype=bool)).all()


def test_sigmas_of_a_photograph_have_the_unit_of_those_of_points(tab: Tab, scene: ViewerScene) -> None:
    page = tab.page
    page.evaluate("() => document.getElementById('explore').viewer.model.a['photo.sigma'].fill(2e-4)")
    page.evaluate(SELECT, ["photograph", 1])
    panel = page.locator(".v-panel").inner_text()
    unit = page.evaluate("() => document.getElementById('explore').viewer.model.fine.unit")
    assert unit != scene.unit and panel.count(f"sigma 200 {unit}") == 3, panel
