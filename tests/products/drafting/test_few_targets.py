"""Few small targets of large photographs, plates of few dots, and rings that no family reads."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.model.conventions import AnyArray, FloatArray, IntArray
from sfm.model.remarks.remark import of_kind
from sfm.products.drafting import target_trial
from sfm.products.drafting.draft import draft_survey
from sfm.products.drafting.target_trial import try_targets
from sfm.targets.codes.plate_search import has_interrupted_ring, search_dots
from sfm.targets.codes.plates import PlateFamily
from sfm.targets.codes.rings import ring_family
from sfm.targets.codes.tags import DICTIONARIES, smallest_dictionary, tag_family
from tests.commands import kolinear
from tests.synthetic import seed_of

LARGE = (3000, 4000)  # rows and columns of the photograph of a telephone
CORNERS = ((500, 400), (3500, 380), (420, 2600), (3600, 2550), (2000, 300))  # x, y; none is in the middle


def scene(seed: str, shape: tuple[int, int] = LARGE) -> AnyArray:
    """Soft and coarse natural background without edges, fast to search."""
    noise = seed_of(seed).normal(0, 1, (shape[0] // 20, shape[1] // 20)).astype(np.float32)
    coarse = cv2.GaussianBlur(noise, (0, 0), 3.0)
    return np.clip(128 + 250 * cv2.resize(coarse, shape[::-1]), 30, 220).astype(np.uint8)


def paste(photograph: AnyArray, patch: AnyArray, x: int, y: int) -> None:
    half = patch.shape[0] // 2
    photograph[y - half : y - half + len(patch), x - half : x - half + len(patch)] = patch


def tag(dictionary: str, number: int, module_px: int) -> AnyArray:
    found = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARIES[dictionary]))
    side = module_px * (found.markerSize + 2)
    marker = found.generateImageMarker(number, side)
    return np.pad(np.where(marker > 0, 230, 25).astype(np.uint8), module_px, constant_values=230)


def ring(
    number: int, dot_px: float, *, inner: float = 2.0, outer: float = 3.0, family: str | None = "ring14"
) -> AnyArray:
    """A dot of a diameter with its ring, whose radii are in radii of the dot; drawn larger, then reduced.

    Without a family it has 17 cells, some of them set, which no family has.
    """
    side = 16 * round(dot_px)
    y, x = 8 * (np.mgrid[:side, :side] - side / 2 + 0.5) / side
    if family is None:
        bits = seed_of(f"ring {number}").uniform(size=17) < 0.5
    else:
        rings = ring_family(family)
        pattern = int(rings.pattern[number - 1])
        bits = np.array([pattern >> (rings.cells - 1 - k) & 1 for k in range(rings.cells)], dtype=bool)
    radius, cell = np.hypot(x, y), (np.arctan2(y, x) % (2 * np.pi) / (2 * np.pi) * len(bits)).astype(int)
    on = (radius < 1) | ((radius > inner) & (radius < outer) & bits[cell % len(bits)])
    return cv2.resize(
        np.where(on, 25, 230).astype(np.uint8), (side // 4, side // 4), interpolation=cv2.INTER_AREA
    )


@pytest.mark.sweep(0, 3)
@pytest.mark.parametrize(
    ("dictionary", "numbers", "module_px"),
    [
        ("aruco4x4_50", (1, 3, 4, 5, 6), 7),
        ("aruco6x6_250", (3, 17, 60, 140, 200), 5),
        ("apriltag36h11", (5, 80, 400, 581, 12), 4),
        ("apriltag16h5", (2, 9, 20, 4, 11), 6),
        ("aruco_original", (7, 300, 1000, 20, 55), 5),
    ],
)
def test_few_small_tags_of_a_large_photograph_are_seen(
    dictionary: str, numbers: tuple[int, ...], module_px: int
) -> None:
    read = []
    for k in range(2):
        photograph = scene(f"few tags {k}")
        for number, (x, y) in zip(numbers, CORNERS, strict=True):
            paste(photograph, tag(dictionary, number, module_px), x, y)
        look = target_trial._look(photograph)
        assert look.shows_targets
        read.append(look.tags)
    family, largest = target_trial._shared_family(read)
    assert family == dictionary and set(read[0][largest][0]) == set(numbers)


def test_few_small_rings_and_dots_of_a_large_photograph_are_seen() -> None:
    photograph = scene("few rings")
    for number, (x, y) in zip((3, 20, 40, 50, 80), CORNERS, strict=True):
        paste(photograph, ring(number, 24.0), x, y)
    assert target_trial._look(photograph).shows_targets
    photograph = scene("few dots")
    photograph[100:600, 200:700] = 230
    for row in range(4):
        for column in range(4):
            cv2.circle(photograph, (300 + 80 * column, 220 + 80 * row), 10, 25, -1, cv2.LINE_AA)
    assert target_trial._look(photograph).shows_targets
    assert not target_trial._look(scene("nothing")).shows_targets


def test_every_dictionary_has_a_smallest_part() -> None:
    for name in DICTIONARIES:
        last = np.array([tag_family(name).count - 1])
        assert tag_family(smallest_dictionary(name, last)).count > last[0]
    assert smallest_dictionary("aruco5x5_1000", np.array([3, 99])) == "aruco5x5_100"


def seen(
    plate: PlateFamily, seed: str, *, missing: Sequence[int] = ()
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Circles of a plate in a tilted photograph with some distortion: px, radii, polarity."""
    rng = seed_of(seed)
    plane = plate.plane(1.0)[:, :2]
    plane = (plane - plane.mean(axis=0)) * [1, -1]
    a, b, t = *rng.uniform(-0.04, 0.04, 2), rng.uniform(-0.4, 0.4)
    turned = plane @ np.array([[np.cos(t), np.sin(t)], [-np.sin(t), np.cos(t)]])
    ideal = turned / (1 + turned @ [a, b])[:, None]
    xy = (
        500
        + 60 * ideal * (1 - 0.004 * (ideal**2).sum(axis=1, keepdims=True))
        + rng.normal(0, 0.1, ideal.shape)
    )
    keep = np.delete(np.arange(plate.count), missing)
    return xy[keep], np.full(len(keep), 12.0), np.full(len(keep), -1)


@pytest.mark.parametrize(
    ("name", "rows", "columns"),
    [("grid", 3, 6), ("grid", 4, 4), ("grid", 3, 4), ("asymmetric-grid", 6, 3), ("hexagonal-grid", 4, 4)],
)
def test_plates_of_few_dots_are_found(name: str, rows: int, columns: int) -> None:
    plate = PlateFamily(name, rows, columns)
    found = search_dots([seen(plate, f"{name} {k}", missing=[5][: k % 2]) for k in range(4)])
    assert found is not None and found.name == name
    assert (found.rows, found.columns) in ((rows, columns), (columns, rows))


def test_few_dots_at_random_are_no_plate() -> None:
    rng, plates = seed_of("dots at random"), 0
    for _ in range(100):
        photographs = []
        for _ in range(3):
            xy: list[FloatArray] = []
            for one in rng.uniform(0, 1000, (160, 2)):
                if len(xy) < 40 and all(np.hypot(*(one - other)) > 40 for other in xy):
                    xy.append(one)
            photographs.append((np.array(xy), np.full(len(xy), 10.0), np.full(len(xy), -1)))
        plates += search_dots(photographs) is not None
    assert plates == 0


def sheet(rows: int, columns: int, *, inner: float, outer: float) -> AnyArray:
    """Dots in rows, with rings that no family has."""
    picture = np.full((180 * rows + 60, 180 * columns + 60), 230, np.uint8)
    for k in range(rows * columns):
        row, column = divmod(k, columns)
        patch = ring(3 + 2 * k, 36.0, inner=inner, outer=outer, family=None)
        paste(picture, patch, 120 + 180 * column, 120 + 180 * row)
    return picture


def photographs_of(picture: AnyArray, folder: Path, count: int = 3) -> None:
    h, w = picture.shape
    corners = np.array([[0, 0], [w, 0], [w, h], [0, h]], np.float32)
    for k in range(count):
        moved = corners + seed_of(f"corners {k}").uniform(0, 60, (4, 2)).astype(np.float32)
        H = cv2.getPerspectiveTransform(corners, moved)
        warped = cv2.warpPerspective(picture, H, (w + 60, h + 60), borderValue=230.0)
        noisy = warped + seed_of(f"noise {k}").normal(0, 1.5, warped.shape)
        cv2.imwrite(str(folder / f"{k}.png"), np.clip(noisy, 0, 255).astype(np.uint8))


def test_rings_in_rows_that_no_family_reads_are_no_plate_but_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "rings"
    folder.mkdir()
    photographs_of(sheet(4, 5, inner=1.5, outer=1.9), folder)
    monkeypatch.chdir(tmp_path)
    assert kolinear("init", folder, "--out", "rings.toml") == 0
    told = capsys.readouterr().err
    assert "have rings that no known family of codes reads" in told and "rings-rings.png" in told
    assert "tie_points" in tomllib.loads(Path("rings.toml").read_text())
    picture = cv2.imread("rings-rings.png", cv2.IMREAD_GRAYSCALE)
    assert picture is not None and min(picture.shape) > 300 and np.ptp(picture) > 150
    plain = tmp_path / "dots"
    plain.mkdir()
    photographs_of(sheet(4, 5, inner=9.0, outer=9.1), plain)
    trial = try_targets(sorted(plain.iterdir()))
    assert trial.plate is not None and trial.plate.count == 20 and not trial.ringed


def test_rings_are_told_from_labels_and_neighbours() -> None:
    picture = np.full((600, 1400), 230, np.uint8)
    at = np.array([(150, 150), (450, 150), (750, 150), (1050, 150), (1110, 150), (150, 450), (450, 450)])
    paste(picture, ring(20, 36.0, inner=1.6, outer=1.95), 150, 150)
    cv2.rectangle(picture, (370, 70), (530, 230), 25, -1)  # a dark frame around a label
    cv2.rectangle(picture, (400, 100), (500, 200), 230, -1)
    cv2.circle(picture, (750, 150), 50, 25, 6)  # a closed ring
    for x, y in at[1:]:
        cv2.circle(picture, (int(x), int(y)), 18, 25, -1)
    shape, levels = np.tile([1 / 18, 0, 1 / 18], (len(at), 1)), np.tile([230.0, -205.0], (len(at), 1))
    found = has_interrupted_ring(picture, at.astype(float), shape, levels)
    assert found.tolist() == [True] + 6 * [False]


def test_dots_in_rows_that_are_cut_are_offered_as_a_plate(tmp_path: Path) -> None:
    """No two photographs show the plate whole, as without marks nothing tells which part is seen."""
    for k in range(3):
        picture = np.full((480, 640), 225, np.uint8)
        for row in range(4):
            for column in range(3 + k):
                cv2.circle(picture, (60 + 110 * column + 5 * row, 60 + 110 * row), 20, 30, -1, cv2.LINE_AA)
        cv2.imwrite(str(tmp_path / f"{k}.png"), picture)
    draft = draft_survey(tmp_path)
    (remark,) = of_kind(draft.remarks, "circles_without_codes")
    assert "4 rows and 5 columns" in remark.text
    section = draft.text.partition("in place of [tie_points]:\n")[2].split("\n\n")[0]
    offered = tomllib.loads("\n".join(line.removeprefix("# ") for line in section.splitlines()))
    assert offered["targets"]["codes"] == "grid" and offered["targets"]["columns"] == 5


@pytest.mark.parametrize(("codes", "both"), [((6, 6, 1), True), ((6, 6, 4), False)])
def test_texture_is_drafted_beside_targets_where_a_photograph_shows_few(
    tmp_path: Path, codes: tuple[int, ...], both: bool
) -> None:
    for k, count in enumerate(codes):
        photograph = scene(f"both {k}", (700, 1000))
        for number in range(count):
            row, column = divmod(number, 3)
            paste(photograph, ring(3 + 7 * number, 24.0), 200 + 250 * column, 200 + 250 * row)
        cv2.imwrite(str(tmp_path / f"{k}.png"), photograph)
    drafted = tomllib.loads(draft_survey(tmp_path).text)
    assert drafted["targets"]["codes"] == "ring14"
    assert ("tie_points" in drafted) == both
