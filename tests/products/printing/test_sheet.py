"""Sheets of coded targets: read back by the detector, true scale, files whole or not at all."""

import re
from dataclasses import replace
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from sfm.model.camera import camera_from_values
from sfm.model.errors import GeometryError, OutputError, SurveyFileError
from sfm.products.printing.sheet import MARGIN_MM, RULER_MM, lay_out_sheet, write_sheet
from sfm.products.rendering.render import render_photograph
from sfm.products.rendering.scene import CircularTargets, Faces, Optics, Scene
from sfm.targets.codes.plates import code_family
from sfm.targets.detect import find_targets
from tests.pdf_text import pages_of, streams_of

PX_PER_MM = 8


def drawn(svg, size_mm):
    """Rasterise the outlines of an SVG page by flattening its curves, y down."""
    fine = 4 * PX_PER_MM  # OpenCV dents the edges of what it fills, alike where these lie alike on the grid
    height, width = round(size_mm[1] * PX_PER_MM), round(size_mm[0] * PX_PER_MM)
    picture = np.full((4 * height, 4 * width), 255, dtype=np.uint8)
    t = np.linspace(0, 1, 17)[1:, None]
    for path in ElementTree.parse(svg).getroot().iter("{http://www.w3.org/2000/svg}path"):
        points = []
        for letter, words in re.findall(r"([MLC])([^MLCZ]*)", path.get("d")):
            xy = np.array(words.split(), dtype=float).reshape(-1, 2)
            if letter == "C":
                a, (b, c, d) = points[-1], xy
                points.extend((1 - t) ** 3 * a + 3 * (1 - t) ** 2 * t * b + 3 * (1 - t) * t**2 * c + t**3 * d)
            else:
                points.append(xy[0])
        polygon = np.round((np.array(points) * fine - 0.5) * 16).astype(np.int32)
        ink = 255 if path.get("fill") == "#fff" else 0
        cv2.fillPoly(picture, [polygon], ink, lineType=cv2.LINE_AA, shift=4)
    picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(picture, (0, 0), 0.8)


def assert_as_printed(found, sheet, numbers, *, radius_mm):
    """Assert that all targets of a page are read, at their places and in their size."""
    read = found.code >= 0
    assert sorted(found.code[read]) == numbers.tolist()
    page = sheet.pages[0]
    for xy, axes, code in zip(found.xy[read], found.semi_axes[read], found.code[read], strict=True):
        at = page.centre[np.flatnonzero(page.number == code)[0]]
        expected = np.array([at[0], sheet.size_mm[1] - at[1]]) * PX_PER_MM - 0.5
        assert xy == pytest.approx(expected, abs=0.1)
        # OpenCV fills the pixels of the outline as well, so dots come out larger by up to a pixel.
        assert axes == pytest.approx(radius_mm * PX_PER_MM, abs=1.0)


@pytest.mark.sweep(0, 4, 5)
@pytest.mark.parametrize("family", ["ring12", "ring14", "ring20"])
@pytest.mark.parametrize("dark", [True, False])
def test_the_printed_page_is_read_back(tmp_path, family, dark):
    numbers = code_family(family).number[:12]
    sheet = lay_out_sheet(family, numbers, diameter_mm=8.0, dark=dark)
    (file,) = write_sheet(sheet, tmp_path / "sheet.svg")
    picture = drawn(file, sheet.size_mm)
    found = find_targets(picture, polarity="dark" if dark else "bright", codes=family, min_diameter_px=40)
    assert_as_printed(found, sheet, numbers, radius_mm=4.0)


@pytest.mark.sweep(0, 3)
@pytest.mark.parametrize("dark", [True, False])
@pytest.mark.parametrize("family", ["cctag3", "cctag4"])
def test_printed_concentric_tags_are_read_back(tmp_path, family, dark):
    numbers = np.array([0, 5, 10, 21, 31])
    sheet = lay_out_sheet(family, numbers, diameter_mm=16.0, dark=dark)
    assert sheet.ring_mm == 16.0
    (file,) = write_sheet(sheet, tmp_path / "sheet.svg")
    picture = drawn(file, sheet.size_mm)[: 60 * PX_PER_MM]
    found = find_targets(picture, polarity="dark" if dark else "bright", codes=family, min_diameter_px=40)
    assert_as_printed(found, sheet, numbers, radius_mm=8.0)
    with pytest.raises(SurveyFileError, match="at least"):
        lay_out_sheet(family, numbers, diameter_mm=4.0)
    with pytest.raises(SurveyFileError, match="radii of the ring"):
        lay_out_sheet(family, numbers, diameter_mm=16.0, ring_radii=(2.0, 3.0))
    with pytest.raises(GeometryError):
        lay_out_sheet(family, np.array([128]), diameter_mm=16.0)


@pytest.mark.parametrize(
    ("family", "first", "count"),
    [("cctag3", 0, 32), ("apriltag16h5", 0, 30), ("ring14", 1, 100), ("arcs", 1, 4)],
)
def test_a_sheet_without_numbers_has_the_first_of_the_family(family, first, count):
    sheet = lay_out_sheet(family, None, diameter_mm=10.0)
    numbers = np.concatenate([page.number for page in sheet.pages])
    assert numbers.tolist() == list(range(first, first + count))


def test_rings_of_other_radii_are_printed_and_read(tmp_path):
    sheet = lay_out_sheet("ring12", np.arange(1, 9), diameter_mm=8.0, ring_radii=(1.7, 2.4))
    assert sheet.ring_mm == pytest.approx(2.4 * 8)
    (file,) = write_sheet(sheet, tmp_path / "sheet.svg")
    picture = drawn(file, sheet.size_mm)
    family = replace(code_family("ring12"), inner=1.7, outer=2.4)
    found = find_targets(picture, polarity="dark", codes=family, min_diameter_px=40)
    assert sorted(found.code[found.code >= 0]) == list(range(1, 9))
    usual = find_targets(picture, polarity="dark", codes="ring12", min_diameter_px=40)
    assert sorted(usual.code[usual.code >= 0]) == list(range(1, 9))  # the radii are those of the photograph
    for radii in ((0.9, 2.0), (2.0, 2.0)):
        with pytest.raises(SurveyFileError, match="radii of the ring"):
            lay_out_sheet("ring12", np.arange(1, 9), diameter_mm=8.0, ring_radii=radii)


def test_a_dot_has_its_diameter_on_paper(tmp_path):
    (file,) = write_sheet(lay_out_sheet("ring14", np.array([1]), diameter_mm=8.0), tmp_path / "one.svg")
    root = ElementTree.parse(file).getroot()
    assert (root.get("width"), root.get("height"), root.get("viewBox")) == ("210mm", "297mm", "0 0 210 297")
    dot = next(root.iter("{http://www.w3.org/2000/svg}path")).get("d")
    ends = np.array([words.split()[-2:] for words in re.findall(r"[MLC]([^MLCZ]*)", dot)], dtype=float)
    centre = ends[:-1].mean(axis=0)
    assert np.linalg.norm(ends - centre, axis=1) == pytest.approx(4.0, abs=1e-4)


def test_the_layout_photographed_gives_its_ids():
    sheet = lay_out_sheet("ring14", np.arange(1, 13), diameter_mm=10.0)
    width, height = sheet.size_mm
    page = sheet.pages[0]
    marks = page.marks.__class__(
        page.marks.face, page.marks.kind, page.marks.centre - (width / 2, height / 2), page.marks.shape,
        0.05 * page.marks.value,
    )  # fmt: skip
    face = Faces(
        np.zeros((1, 3)), np.array([[[1.0, 0, 0], [0, 1, 0]]]), np.array([[width / 2, height / 2]]),
        np.array([0.9]), np.zeros(1), np.ones(1),
    )  # fmt: skip
    none = np.zeros(0, dtype=np.int64)
    scene = Scene(face, marks, CircularTargets(none, np.zeros((0, 2)), np.zeros(0), none))
    camera = camera_from_values("c", "brown", (600, 800), (0.01, 0.01), c_mm=10.0)
    photograph, _ = render_photograph(
        scene, camera, np.array([0.0, 0.0, 400.0]), np.eye(3), optics=Optics(noise=0.005),
        rng=np.random.default_rng(0),
    )  # fmt: skip
    found = find_targets(photograph, codes="ring14", min_diameter_px=10)
    assert sorted(found.code[found.code >= 0]) == list(range(1, 13))


def test_all_numbers_are_on_pages_that_they_fit_on():
    sheet = lay_out_sheet("ring14", np.arange(1, 101), diameter_mm=10.0)
    assert np.concatenate([p.number for p in sheet.pages]).tolist() == list(range(1, 101))
    for page in sheet.pages:
        reach = sheet.ring_mm / 2
        assert (page.centre - reach >= MARGIN_MM).all()
        assert (page.centre + reach <= np.array(sheet.size_mm) - MARGIN_MM).all()
        apart = np.linalg.norm(page.centre[:, None] - page.centre, axis=2) + 1e9 * np.eye(len(page.centre))
        assert apart.min() > 1.3 * sheet.ring_mm


def printed_outlines(stream, height_mm):
    """Return what a page fills: corners and ends of curves on the paper, mm from its lower left corner."""
    outlines = []
    for body in re.findall(rb"(-?[\d.]+ -?[\d.]+ m [^mh]*) h f", stream):
        ends = re.findall(rb"(-?[\d.]+) (-?[\d.]+) [mlc]\b", body)
        outlines.append(np.array(ends, dtype=float) * 25.4 / 72 * (1, -1) + (0, height_mm))
    return outlines


@pytest.mark.parametrize("page", ["a4", "letter", "a2"])
def test_marks_of_a_pdf_are_true_on_paper(tmp_path, page):
    sheet = lay_out_sheet("ring14", np.arange(1, 101), diameter_mm=10.0, page=page)
    (file,) = write_sheet(sheet, tmp_path / "new" / "sheet.pdf")
    content = file.read_bytes()
    box = re.search(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", content)
    np.testing.assert_allclose(np.array(box.groups(), dtype=float) * 25.4 / 72, sheet.size_mm, atol=0.002)
    streams = [stream for stream in streams_of(content).values() if b" Tj ET" in stream]
    assert len(streams) == len(sheet.pages)
    for stream, laid in zip(streams, sheet.pages, strict=True):
        outlines = printed_outlines(stream, sheet.size_mm[1])
        dots = [ends[:-1] for ends in outlines if len(ends) == 9]  # eight arcs and the start
        centres = np.array([dot.mean(axis=0) for dot in dots])
        np.testing.assert_allclose(centres, laid.centre, atol=1e-4)
        radii = [np.linalg.norm(dot - centre, axis=1) for dot, centre in zip(dots, centres, strict=True)]
        np.testing.assert_allclose(radii, 5.0, atol=1e-4)
        (ruler,) = [ends for ends in outlines if np.ptp(ends[:, 0]) > 50]
        np.testing.assert_allclose([ruler[0], ruler[1]], [(10, 10), (10 + RULER_MM, 10)], atol=1e-4)
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["sheet.pdf"]


def test_svg_pages_are_numbered(tmp_path):
    sheet = lay_out_sheet("ring14", np.arange(1, 60), diameter_mm=14.0)
    files = write_sheet(sheet, tmp_path / "t.svg")
    assert [f.name for f in files] == [f"t-{k + 1}.svg" for k in range(len(sheet.pages))]


def test_what_cannot_be_printed_is_named(tmp_path):
    with pytest.raises(SurveyFileError, match="page 'b5', expected one of a4"):
        lay_out_sheet("ring14", np.array([1]), diameter_mm=10.0, page="b5")
    with pytest.raises(SurveyFileError, match=r"ring of 300\.0 mm .* does not fit on a4"):
        lay_out_sheet("ring14", np.array([1]), diameter_mm=100.0)
    with pytest.raises(SurveyFileError, match="diameter is 0 mm"):
        lay_out_sheet("ring14", np.array([1]), diameter_mm=0)
    with pytest.raises(SurveyFileError, match="has no codes"):
        lay_out_sheet("none", np.array([1]), diameter_mm=10.0)
    with pytest.raises(GeometryError, match="code 9999"):
        lay_out_sheet("ring14", np.array([9999]), diameter_mm=10.0)
    with pytest.raises(OutputError, match=r"written as \.pdf or \.svg"):
        write_sheet(lay_out_sheet("ring14", np.array([1]), diameter_mm=10.0), tmp_path / "t.doc")


@pytest.mark.parametrize(
    "name", ["köln (1).txt", "a<b&c.txt", "a (1.txt", "b\\).txt", "日本.txt", 90 * "x" + ".txt"]
)
def test_any_name_of_a_code_table_is_written_as_text(tmp_path, name):
    table = tmp_path / name
    family = code_family("ring12")
    table.write_text(
        "# cells 12\n" + "".join(f"{n} {p}\n" for n, p in zip(family.number, family.pattern, strict=True))
    )
    sheet = lay_out_sheet(str(table), np.arange(1, 5), diameter_mm=10.0)
    shown = name if len(name) <= 40 else name[:37] + "..."
    (svg,) = write_sheet(sheet, tmp_path / "k.svg")
    texts = [t.text for t in ElementTree.parse(svg).getroot().iter("{http://www.w3.org/2000/svg}text")]
    assert texts[-1].startswith(f"{shown}, dot 10 mm")
    (pdf,) = write_sheet(sheet, tmp_path / "k.pdf")
    (page,) = pages_of(pdf.read_bytes())
    said = page.splitlines()
    assert said[:-1] == ["1", "2", "3", "4"]
    known = re.sub("[日本]", "?", shown)  # of which the font has no letters
    assert said[-1].startswith(f"{known}, dot 10 mm")


def test_what_is_ignored_or_unprintable_is_refused():
    with pytest.raises(SurveyFileError, match="radii of the ring belong to rings, apriltag36h11 has none"):
        lay_out_sheet("apriltag36h11", np.arange(4), diameter_mm=40.0, ring_radii=(2.0, 3.0))
    with pytest.raises(SurveyFileError, match="number 1 is named 3 times"):
        lay_out_sheet("ring14", np.array([1, 2, 1, 1]), diameter_mm=10.0)
    with pytest.raises(SurveyFileError, match=r"diameter is 0\.1 mm, needed at least 1 mm for ring14"):
        lay_out_sheet("ring14", np.arange(1, 4), diameter_mm=0.1)
    with pytest.raises(SurveyFileError, match=r"needed at least 2 mm for apriltag36h11"):
        lay_out_sheet("apriltag36h11", np.arange(4), diameter_mm=1.9)
    assert len(lay_out_sheet("apriltag36h11", np.arange(4), diameter_mm=2.0).pages) == 1


def test_only_earlier_sheets_are_replaced(tmp_path):
    sheet = lay_out_sheet("ring14", np.arange(1, 60), diameter_mm=14.0)
    files = (*write_sheet(sheet, tmp_path / "t.svg"), *write_sheet(sheet, tmp_path / "t.pdf"))
    assert (*write_sheet(sheet, tmp_path / "t.svg"), *write_sheet(sheet, tmp_path / "t.pdf")) == files
    (tmp_path / "d.pdf").mkdir()
    with pytest.raises(OutputError, match=r"d\.pdf: is a folder"):
        write_sheet(sheet, tmp_path / "d.pdf")
    for name, other in (("o.pdf", b"%PDF-1.4 a letter"), ("o-2.svg", b"<svg/>")):
        (tmp_path / name).write_bytes(other)
        with pytest.raises(OutputError, match="exists and is not an earlier sheet"):
            write_sheet(sheet, tmp_path / name.replace("-2", ""))
        assert (tmp_path / name).read_bytes() == other
    assert not (tmp_path / "o-1.svg").exists()
    with pytest.raises(OutputError, match="cannot be written"):
        write_sheet(sheet, tmp_path / "t.pdf" / "in.pdf")
    assert not list(tmp_path.glob(".*"))
