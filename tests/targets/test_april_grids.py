"""AprilGrids: tags that squares touch are read, and their corners named and measured as crossings."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from sfm.model.conventions import AnyArray, FloatArray
from sfm.targets.codes.boards import MIN_MODULE_PX, _outlines, _unique, name_corners, read_april_tags
from sfm.targets.codes.plate_search import search_april_grids
from sfm.targets.codes.plates import PlateFamily
from sfm.targets.codes.tags import tag_family, tag_modules
from sfm.targets.detect import find_targets
from tests.synthetic import seed_of

MODULE_PX = 8
GRID = PlateFamily("aprilgrid", 6, 8, (), "apriltag36h11", 0.8, 17)
H = np.array([[0.94, -0.21, 90.0], [0.17, 0.9, 30.0], [9e-5, 1.4e-4, 1.0]])  # the oblique view


def drawn(plate: PlateFamily, *, border: int = 2, squares: bool = True, turn: int = 2) -> AnyArray:
    """Return a grid as it is printed, uint8."""
    family = tag_family(plate.dictionary)
    side = MODULE_PX * (family.modules - 2 + 2 * border)
    step = round(side / plate.tag_share)
    gap = step - side
    rows, columns = plate.rows // 2, plate.columns // 2
    sheet = np.full((rows * step + 3 * gap, columns * step + 3 * gap), 225, dtype=np.uint8)
    for number in range(rows * columns):
        row, column = rows - 1 - number // columns, number % columns
        y, x = row * step + 2 * gap, column * step + 2 * gap
        tag = np.pad(tag_modules(family, plate.first_tag + number), border - 1, constant_values=True)
        tag = np.rot90(tag, turn).repeat(MODULE_PX, 0).repeat(MODULE_PX, 1)
        sheet[y : y + side, x : x + side] = np.where(tag, 30, 225)
        for dy in (-gap, side) if squares else ():
            for dx in (-gap, side):
                sheet[y + dy : y + dy + gap, x + dx : x + dx + gap] = 30
    return sheet


def photographed(sheet: AnyArray, name: str) -> AnyArray:
    """Return an oblique photograph of a sheet."""
    seen = cv2.warpPerspective(sheet, H, (640, 520), flags=cv2.INTER_AREA, borderValue=120)
    noisy = cv2.GaussianBlur(seen.astype(float), (0, 0), 1.0) + 2 * seed_of(name).standard_normal(seen.shape)
    return np.rint(noisy).clip(0, 255).astype(np.uint8)


def tilted(
    sheet: AnyArray, name: str, *, degrees: float, contrast: float = 1.0, noise: float = 2.0
) -> AnyArray:
    """Return a photograph of a sheet seen at an angle, for a principal distance of 900 px, 1 px a unit."""
    height, width = sheet.shape
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    plane = np.array([[1, 0, -width / 2], [0, c, -c * height / 2], [0, s, 900 - s * height / 2]])
    H = np.array([[900.0, 0, 320], [0, 900, 260], [0, 0, 1]]) @ plane
    seen = cv2.warpPerspective(sheet, H, (640, 520), flags=cv2.INTER_AREA, borderValue=120)
    soft = contrast * cv2.GaussianBlur(seen.astype(float), (0, 0), 1.0) + 60
    return np.rint(soft + noise * seed_of(name).standard_normal(seen.shape)).clip(0, 255).astype(np.uint8)


# where regions are dark below half of the range 0, below an eighth of it 8 of the oblique grid
@pytest.mark.parametrize(
    ("degrees", "contrast", "noise"), [(68.0, 1.0, 2.0), (0.0, 0.15, 4.0), (0.0, 0.1, 1.0)]
)
def test_tags_are_read_at_an_angle_and_in_faint_light(degrees: float, contrast: float, noise: float) -> None:
    picture = tilted(drawn(GRID), f"tilted {degrees}", degrees=degrees, contrast=contrast, noise=noise)
    number, _ = read_april_tags(picture, GRID.dictionary)
    assert number.tolist() == list(range(17, 29))


def test_outlines_are_as_large_as_tags_that_can_be_read() -> None:
    """Two px for each module of a tag with a narrow border."""
    for side, found in ((14, 0), (24, 1)):
        picture = np.full((300, 300), 200, np.uint8)
        picture[40 : 40 + side, 40 : 40 + side] = 40
        assert len(_unique(np.array(list(_outlines(picture, MIN_MODULE_PX * 8))).reshape(-1, 4, 2))) == found


def test_noise_has_no_outlines() -> None:
    picture = seed_of("no outlines").normal(120, 8, (520, 640)).clip(0, 255).astype(np.uint8)
    assert not list(_outlines(picture, 6.0))


def true_corners(plate: PlateFamily, border: int) -> FloatArray:
    """Return where the corners are in the photograph, px, (n, 2)."""
    side = MODULE_PX * (6 + 2 * border)
    step = round(side / plate.tag_share)
    xy = plate.plane(step)[:, :2] * [1, -1] + 2 * (step - side) - 0.5
    return np.asarray(cv2.perspectiveTransform(xy[None], H)[0])


@pytest.mark.parametrize(("border", "turn"), [(2, 2), (2, 0), (1, 1)])
def test_corners_are_named_and_measured(border: int, turn: int) -> None:
    """With Kalibr's border and a narrow one, however the tags are turned in their rows."""
    picture = photographed(drawn(GRID, border=border, turn=turn), f"named {border} {turn}")
    found = find_targets(picture, codes=GRID)
    assert len(found) == GRID.count
    off = np.linalg.norm(found.xy - true_corners(GRID, border)[found.code], axis=1)
    print("corners:", np.sqrt((off**2).mean()), "px")
    assert off.max() < 0.25
    assert sorted(found.code.tolist()) == list(range(GRID.count))


def test_points_are_numbered_from_the_upper_left_as_printed() -> None:
    number, quads = read_april_tags(drawn(GRID), GRID.dictionary)
    assert number.tolist() == list(range(17, 17 + 12))
    xy, code = name_corners(number, quads, GRID)
    at = dict(zip(code.tolist(), xy, strict=True))
    assert at[0] == pytest.approx([39.5, 39.5], abs=1.0)
    assert at[7] == pytest.approx([39.5 + 380, 39.5], abs=1.0)
    assert at[40] == pytest.approx([39.5, 39.5 + 280], abs=1.0)


def test_tags_of_another_grid_have_no_names() -> None:
    number, quads = read_april_tags(drawn(GRID), GRID.dictionary)
    assert len(name_corners(number + 12, quads, GRID)[1]) == 0
    moved = quads.copy()
    moved[3] += 200.0  # a tag that lies beside the grid
    code = name_corners(number, moved, GRID)[1]
    assert len(code) == GRID.count - 4
    for off, left_out in ((0.1, 0), (0.2, 4)):  # of the distance of tags, 100 px
        moved = quads.copy()
        moved[3] += [100 * off, 0]
        assert len(name_corners(number, moved, GRID)[1]) == GRID.count - left_out
    assert len(name_corners(number[:1], quads[:1], GRID)[1]) == 0  # one tag does not show its turn


@pytest.mark.parametrize("border", [1, 2])
def test_a_grid_is_found(border: int) -> None:
    pictures = [photographed(drawn(GRID, border=border), f"found {k}") for k in range(2)]
    (plate,) = search_april_grids(pictures)
    assert (plate.rows, plate.columns, plate.first_tag) == (6, 8, 17)
    assert plate.tag_share == pytest.approx(GRID.tag_share, abs=0.01)


@pytest.mark.parametrize("first_tag", [29, 40])
def test_two_grids_seen_together_are_both_found(first_tag: int) -> None:
    other = replace(GRID, rows=4, first_tag=first_tag)
    low = np.pad(drawn(other), ((0, len(drawn(GRID)) - len(drawn(other))), (0, 0)), constant_values=255)
    sheets = [np.hstack([drawn(GRID), low]), np.hstack([low, drawn(GRID)])]
    found = [(one.rows, one.columns, one.first_tag) for one in search_april_grids(sheets)]
    assert found == [(6, 8, 17), (4, 8, first_tag)]
    for one in (GRID, other):
        assert len(find_targets(sheets[0], codes=one)) == one.count
    apart = [drawn(GRID), drawn(GRID), low, low]
    assert [one.first_tag for one in search_april_grids(apart)] == [17]


def test_tags_without_squares_are_no_grid() -> None:
    """Their corners are corners, and measured as such."""
    assert search_april_grids([photographed(drawn(GRID, squares=False), f"bare {k}") for k in range(2)]) == ()
    assert search_april_grids([np.full((300, 400), 128, dtype=np.uint8)] * 2) == ()
