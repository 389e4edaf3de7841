"""Sheets of coded targets, laid out on pages and written as vector graphics at true scale."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np

from sfm.files.open_folders import disk_errors
from sfm.files.whole_files import whole_file
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.errors import OutputError, SurveyFileError, missing_library
from sfm.products.rendering.scene import (
    ARC,
    DISC,
    MAX_ARCS,
    RECTANGLE,
    Marks,
    coded_ring,
    concentric_rings,
    join_marks,
    square_tag,
)
from sfm.targets.codes.concentric import ConcentricFamily
from sfm.targets.codes.plates import Family, code_family
from sfm.targets.codes.rings import CodeFamily
from sfm.targets.codes.tags import TagFamily

# ISO 216 and ANSI/ASME Y14.1, width and height in mm.
PAGES_MM = {
    "a4": (210.0, 297.0),
    "a3": (297.0, 420.0),
    "a2": (420.0, 594.0),
    "letter": (215.9, 279.4),
    "tabloid": (279.4, 431.8),
}
MM_PER_INCH = 25.4
POINTS_PER_INCH = 72.0
MARGIN_MM = 10.0  # not printed by desktop printers
RULER_MM = 100.0  # length of the ruler, which shows the scale of the print
FOOT_MM = 16.0  # room for the ruler and its text
LABEL_MM = 4.0  # room for the id below a target
# Clear radius around a target, in radii of its ring, so that neighbours are not read as code.
CLEAR = 1.35
# Printers of 600 dots per inch print 24 dots across the smallest target, and 6 across a module of the
# smallest tag or the narrowest ring of the smallest concentric tag.
MIN_DOT_MM, MIN_MODULE_MM = 1.0, 0.25
DEFAULT_TARGETS = 100
FONT = "dejavusans"  # as fpdf2 keys it
MAX_LETTERS = 40  # of the name of a code table, so that its line fits on the page
MAX_SHEET_BYTES = 100_000_000  # for 10,000 targets
CHECK = "print without scaling and check"  # on every page; a file with this text is an earlier sheet


@dataclass(frozen=True)
class Page:
    """One page of targets; plane coordinates in mm from the lower left corner of the page, y up."""

    number: IntArray  # code numbers on the page, (k,)
    centre: FloatArray  # centres of the targets, mm, (k, 2)
    marks: Marks  # dots, arcs and rectangles, value 1 = printed, 0 = background


@dataclass(frozen=True)
class Sheet:
    """Coded targets on pages of one size."""

    family: str
    diameter_mm: float  # of the dot, or of a whole concentric tag; side of a square tag
    ring_mm: float  # outer diameter of the ring; side of a square tag
    size_mm: tuple[float, float]  # width and height of a page
    pages: tuple[Page, ...]
    dark: bool  # dark on white; else white on dark squares
    whole: str = ""  # word for the part with the diameter, if that is the whole target


def lay_out_sheet(
    family: str,
    numbers: IntArray | None,
    *,
    diameter_mm: float,
    page: str = "a4",
    dark: bool = True,
    ring_radii: tuple[float, float] | None = None,
) -> Sheet:
    """Lay coded targets out on pages, row by row from the upper left.

    Args:
        family: arcs, ring12, ring14, ring20, a family of tags, cctag3, cctag4 or the path of a code table.
        numbers: code numbers, (k,); None for the first DEFAULT_TARGETS of the family.
        diameter_mm: diameter of the dot, or of the outer edge of concentric rings, or side of a square tag,
            mm.
        page: one of PAGES_MM.
        dark: whether the targets are dark on white; else they are white on dark squares.
        ring_radii: inner and outer radius of the rings in radii of the dot; else those of the family.

    Returns:
        The sheet, with as many pages as needed.

    Raises:
        SurveyFileError: an unknown page or family, impossible radii, a number twice, or a target that is too
            small to print or larger than the page.
        GeometryError: the family does not have a number.
    """
    codes = code_family(family)
    if codes is None:
        raise SurveyFileError("targets: family 'none' has no codes to print")
    if page not in PAGES_MM:
        raise SurveyFileError(f"targets: page {page!r}, expected one of {', '.join(PAGES_MM)}")
    if not diameter_mm > 0:
        raise SurveyFileError(f"targets: diameter is {diameter_mm} mm, needed more than 0")
    width, height = PAGES_MM[page]
    smallest = MIN_DOT_MM
    if isinstance(codes, TagFamily):
        smallest = MIN_MODULE_MM * codes.modules
    elif isinstance(codes, ConcentricFamily):
        smallest = 2 * MIN_MODULE_MM / codes.narrow
    if diameter_mm < smallest:
        raise SurveyFileError(
            f"targets: diameter is {diameter_mm:g} mm, needed at least {smallest:g} mm for {codes.name} to "
            "be printed"
        )
    if numbers is None:
        numbers = codes.number if isinstance(codes, CodeFamily) else np.arange(codes.count)
        numbers = numbers[:DEFAULT_TARGETS]
        if codes.name.startswith("arcs"):  # their number of arcs is the code
            numbers = np.arange(1, MAX_ARCS + 1)
    values, count = np.unique(numbers, return_counts=True)
    if (count > 1).any():
        raise SurveyFileError(
            f"targets: number {values[count > 1][0]} is named {count[count > 1][0]} times, a survey needs "
            "every code once"
        )
    if ring_radii is not None:
        if not isinstance(codes, CodeFamily):
            raise SurveyFileError(f"targets: radii of the ring belong to rings, {codes.name} has none")
        if not 1 < ring_radii[0] < ring_radii[1]:
            raise SurveyFileError(
                f"targets: radii of the ring are {ring_radii[0]:g} and {ring_radii[1]:g} radii of the dot, "
                "needed more than 1 and the second larger"
            )
        codes = replace(codes, inner=ring_radii[0], outer=ring_radii[1])
    word = {TagFamily: "square", ConcentricFamily: "outer edge"}.get(type(codes), "")
    ring = codes.outer * diameter_mm if isinstance(codes, CodeFamily) else diameter_mm
    across, down = CLEAR * ring, CLEAR * ring + LABEL_MM
    columns = int((width - 2 * MARGIN_MM) // across)
    rows = int((height - 2 * MARGIN_MM - FOOT_MM) // down)
    if columns < 1 or rows < 1:
        raise SurveyFileError(
            f"targets: a {'tag' if word else 'ring'} of {ring:.1f} mm with its surroundings does not fit "
            f"on {page} ({width:g} x {height:g} mm)"
        )
    pages = []
    for first in range(0, len(numbers), columns * rows):
        page_numbers = np.asarray(numbers[first : first + columns * rows], dtype=np.int64)
        k = np.arange(len(page_numbers))
        left = (width - columns * across) / 2 + across / 2
        top = height - MARGIN_MM - across / 2
        centre = np.column_stack([left + across * (k % columns), top - down * (k // columns)])
        marks = [
            _target(at, diameter_mm / 2, int(n), codes) for at, n in zip(centre, page_numbers, strict=True)
        ]
        pages.append(Page(page_numbers, centre, join_marks(marks)))
    return Sheet(codes.name, diameter_mm, ring, (width, height), tuple(pages), dark, word)


def _target(at: FloatArray, half: float, number: int, codes: Family) -> Marks:
    """Return the marks of one target; centre `at`, (2,), and half its diameter in mm."""
    if isinstance(codes, TagFamily):
        return square_tag(0, at, half, number, codes, 1.0, 0.0)
    if isinstance(codes, ConcentricFamily):
        return concentric_rings(0, at, half, number, codes, 1.0)
    return coded_ring(0, at, half, number, codes, 1.0)


def write_sheet(sheet: Sheet, path: Path) -> tuple[Path, ...]:
    """Write a sheet as PDF (one file) or SVG (one file per page) at true scale.

    Args:
        sheet: result of `lay_out_sheet`.
        path: file name ending in .pdf or .svg; several SVG pages get -1, -2, ... before the ending.

    Returns:
        The written files; either all of them appear, or none.

    Raises:
        OutputError: another ending, a file at this path that is not a sheet, or the file cannot be written.
    """
    if path.suffix.lower() not in (".pdf", ".svg"):
        raise OutputError(f"{path}: a sheet is written as .pdf or .svg")
    count = len(sheet.pages)
    if path.suffix.lower() == ".pdf":
        names, contents = [path], [_pdf(sheet)]
    else:
        names = [path if count == 1 else path.with_stem(f"{path.stem}-{k + 1}") for k in range(count)]
        contents = [_svg(sheet, k).encode() for k in range(count)]
    for name in names:
        with disk_errors(f"{name}: the sheet cannot be written"):
            if name.is_dir():
                raise OutputError(f"{name}: is a folder, needed the name of a file")
            beginning = b""
            if name.is_file():
                with name.open("rb") as file:
                    beginning = file.read(MAX_SHEET_BYTES)
            if name.exists() and CHECK.encode() not in beginning:
                raise OutputError(f"{name}: exists and is not an earlier sheet, needed another name")
    with ExitStack() as files:
        for name, content in zip(names, contents, strict=True):
            files.enter_context(whole_file(name, "the sheet", replaces=True)).write_bytes(content)
    return tuple(names)


@dataclass(frozen=True)
class _Path:
    """A closed outline of lines and cubic curves, filled black or white."""

    commands: tuple[tuple[str, tuple[float, ...]], ...]  # M x y | L x y | C x1 y1 x2 y2 x y, mm, y up
    white: bool = False


def _outlines(sheet: Sheet, page: Page) -> list[_Path]:
    """Return all filled outlines of a page."""
    half = CLEAR * sheet.ring_mm / 2
    paths = [] if sheet.dark else [_rectangle(x - half, y - half, 2 * half, 2 * half) for x, y in page.centre]
    marks = page.marks
    for kind, (x, y), shape, value in zip(marks.kind, marks.centre, marks.shape, marks.value, strict=True):
        if kind == DISC:
            turn = _arc(x, y, shape[0], 0.0, 2 * np.pi)
            paths.append(_Path((("M", (x + shape[0], y)), *turn), not sheet.dark))
        elif kind == RECTANGLE:
            corner, size = (x - shape[0], y - shape[1]), (2 * shape[0], 2 * shape[1])
            paths.append(_rectangle(*corner, *size, white=(value == 0) == sheet.dark))
        elif kind == ARC:
            inner, outer, start, length = shape
            end = start + length
            paths.append(
                _Path(
                    (
                        ("M", (x + outer * np.cos(start), y + outer * np.sin(start))),
                        *_arc(x, y, outer, start, length),
                        ("L", (x + inner * np.cos(end), y + inner * np.sin(end))),
                        *_arc(x, y, inner, end, -length),
                    ),
                    not sheet.dark,
                )
            )
    low = MARGIN_MM
    paths.append(_rectangle(MARGIN_MM, low, RULER_MM, 0.2))
    for k in range(int(RULER_MM) + 1):
        tall = 5.0 if k % 10 == 0 else 3.5 if k % 5 == 0 else 2.0
        paths.append(_rectangle(MARGIN_MM + k - 0.05, low, 0.1, tall))
    return paths


def _rectangle(x: float, y: float, width: float, height: float, *, white: bool = False) -> _Path:
    corners = ((x + width, y), (x + width, y + height), (x, y + height))
    return _Path((("M", (x, y)), *(("L", corner) for corner in corners)), white)


def _arc(
    x: float, y: float, radius: float, start: float, length: float
) -> list[tuple[str, tuple[float, ...]]]:
    """Return cubic curves along an arc, in steps of an eighth of a turn, accurate to 3e-7 of the radius.

    Source: Goldapp (1991), Comput. Aided Geom. Des. 8(3): handles of 4/3 tan(angle / 4).
    """
    steps = max(1, int(np.ceil(abs(length) / (np.pi / 4) - 1e-9)))
    angle = length / steps
    handle = 4 / 3 * np.tan(angle / 4) * radius
    curves: list[tuple[str, tuple[float, ...]]] = []
    for k in range(steps):
        a, b = start + k * angle, start + (k + 1) * angle
        ax, ay = x + radius * np.cos(a), y + radius * np.sin(a)
        bx, by = x + radius * np.cos(b), y + radius * np.sin(b)
        first = (ax - handle * np.sin(a), ay + handle * np.cos(a))
        second = (bx + handle * np.sin(b), by - handle * np.cos(b))
        curves.append(("C", (*first, *second, bx, by)))
    return curves


def _texts(sheet: Sheet, k: int) -> list[tuple[float, float, float, str]]:
    """Return x, y (mm), height (mm) and text of every label on page k."""
    page = sheet.pages[k]
    below = CLEAR * sheet.ring_mm / 2 + 0.5 * LABEL_MM
    height = 0.6 * LABEL_MM
    texts = [(x, y - below, height, str(n)) for (x, y), n in zip(page.centre, page.number, strict=True)]
    size = f"dot {sheet.diameter_mm:g} mm, ring {sheet.ring_mm:g} mm"
    if sheet.whole:
        size = f"{sheet.whole} {sheet.diameter_mm:g} mm"
    family = "".join(letter if letter.isprintable() else "?" for letter in sheet.family)
    if len(family) > MAX_LETTERS:
        family = family[: MAX_LETTERS - 3] + "..."
    note = f"{family}, {size}, page {k + 1} of {len(sheet.pages)}; ruler {RULER_MM:g} mm: {CHECK}"
    return [*texts, (sheet.size_mm[0] / 2, MARGIN_MM + 7.5, height, note)]


def _svg(sheet: Sheet, k: int) -> str:
    """Return page k as SVG."""
    width, height = sheet.size_mm
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:g}mm" height="{height:g}mm" '
        f'viewBox="0 0 {width:g} {height:g}">',
        f'<rect width="{width:g}" height="{height:g}" fill="#fff"/>',
    ]
    for path in _outlines(sheet, sheet.pages[k]):
        words = []
        for letter, numbers in path.commands:
            xy = np.array(numbers).reshape(-1, 2) * (1, -1) + (0, height)
            words.append(letter + " ".join(f"{v:.5f}" for v in xy.ravel()))
        lines.append(f'<path d="{"".join(words)}Z" fill="{"#fff" if path.white else "#000"}"/>')
    lines += [
        f'<text x="{x:.3f}" y="{height - y:.3f}" font-family="Helvetica, Arial, sans-serif" '
        f'font-size="{size:g}" text-anchor="middle">{escape(words)}</text>'
        for x, y, size, words in _texts(sheet, k)
    ]
    return "\n".join([*lines, "</svg>", ""])


def _pdf(sheet: Sheet) -> bytes:
    """Return the sheet as PDF with its font.

    Lengths are given in points, which fpdf2 writes with four decimals (35 nm); in millimetres it would round
    the scale of the page to 16 ppm.

    Source: ISO 32000-1:2008, sec. 8.3.2.3 (points); fpdf2 2.8 documentation.
    """
    from fpdf import FPDF
    from fpdf.drawing import PaintedPath
    from fpdf.fonts import TTFFont

    scale = POINTS_PER_INCH / MM_PER_INCH
    width, height = (scale * side for side in sheet.size_mm)
    pdf = FPDF(unit="pt", format=(width, height))
    pdf.set_auto_page_break(False)
    pdf.set_subject(CHECK)  # metadata are not compressed
    pdf.add_font(FONT, fname=_font_file())
    font = pdf.fonts[FONT]
    letters = font.cmap if isinstance(font, TTFFont) else {}
    for k, page in enumerate(sheet.pages):
        pdf.add_page()
        with pdf.drawing_context() as drawing:
            for outline in _outlines(sheet, page):
                path = PaintedPath()
                path.style.fill_color = "#ffffff" if outline.white else "#000000"
                path.style.stroke_color = None
                draw: dict[str, Callable[..., PaintedPath]]
                draw = {"M": path.move_to, "L": path.line_to, "C": path.curve_to}
                for letter, numbers in outline.commands:
                    xy = np.array(numbers).reshape(-1, 2) * (scale, -scale) + (0, height)
                    draw[letter](*xy.ravel().tolist())
                path.close()
                drawing.add_item(path)
        for x, y, size, words in _texts(sheet, k):
            known = "".join(letter if ord(letter) in letters else "?" for letter in words)
            pdf.set_font(FONT, size=scale * size)
            left = scale * x - pdf.get_string_width(known) / 2
            pdf.text(left, height - scale * y, known)
    return bytes(pdf.output())


def _font_file() -> Path:
    """Return the path of the font that matplotlib brings, without importing it."""
    spec = find_spec("matplotlib")
    if spec is None or not spec.submodule_search_locations:
        raise missing_library("a sheet as PDF", ("matplotlib",), "all")
    return Path(spec.submodule_search_locations[0], "mpl-data", "fonts", "ttf", "DejaVuSans.ttf")
