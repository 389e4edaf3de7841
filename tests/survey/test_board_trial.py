"""Targets that a trial recognises: boards behind empty photographs, of older patterns, cut; CCTags."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.conventions import AnyArray
from sfm.survey.drafting.target_trial import _side_by_side, try_targets
from sfm.targets.codes.concentric import concentric_family
from sfm.targets.codes.plate_search import search_april_grids, search_checkerboard
from sfm.targets.codes.plates import PlateFamily
from sfm.targets.codes.tags import opencv_dictionary
from sfm.targets.detect import find_targets
from tests.synthetic import seed_of
from tests.targets.concentric_tags import draw_tag
from tests.targets.shapes import PAPER
from tests.targets.test_april_grids import drawn, photographed

CHARUCO = PlateFamily("charuco", 7, 5, (), "aruco4x4_50", 0.74)
EMPTY = np.full((520, 640), 128, dtype=np.uint8)
SQUARE_PX = 52


def charuco_photograph(name: str, *, is_older: bool = False) -> AnyArray:
    """Return an oblique photograph of OpenCV's drawing of a board."""
    board = cv2.aruco.CharucoBoard(
        (CHARUCO.columns + 1, CHARUCO.rows + 1), 1.0, CHARUCO.tag_share, opencv_dictionary(CHARUCO.dictionary)
    )
    board.setLegacyPattern(is_older)
    size = SQUARE_PX * (CHARUCO.columns + 1), SQUARE_PX * (CHARUCO.rows + 1)
    sheet = cv2.copyMakeBorder(board.generateImage(size), 30, 30, 30, 30, cv2.BORDER_CONSTANT, value=[255])
    rng = seed_of(name)
    turn = cv2.getRotationMatrix2D((186, 238), rng.uniform(-20, 20), 0.9)
    turn[:, 2] += 134, 22
    H = np.vstack([turn, [*rng.uniform(-2e-4, 2e-4, 2), 1.0]])
    seen = cv2.warpPerspective(sheet, H, (640, 520), flags=cv2.INTER_AREA, borderValue=[200])
    noisy = cv2.GaussianBlur(seen.astype(float), (0, 0), 0.8) * 0.8 + 20 + 2 * rng.standard_normal(seen.shape)
    return np.rint(noisy).clip(0, 255).astype(np.uint8)


def test_an_empty_first_photograph_does_not_hide_an_april_grid() -> None:
    grid = PlateFamily("aprilgrid", 6, 8, (), "apriltag36h11", 0.8, 17)
    shown = [photographed(drawn(grid), f"trial {k}") for k in range(2)]
    (plate,) = search_april_grids([EMPTY, shown[0]], shown[1:])
    assert (plate.rows, plate.columns, plate.first_tag) == (6, 8, 17)


@pytest.mark.slow
@pytest.mark.parametrize("is_older", [False, True])
def test_charuco_boards_of_both_patterns_are_found_behind_an_empty_photograph(
    is_older: bool, tmp_path: Path
) -> None:
    for k in range(5):
        shown = EMPTY if k == 0 else charuco_photograph(f"trial {k}", is_older=is_older)
        cv2.imwrite(str(tmp_path / f"{k}.png"), shown)
    plate = try_targets(sorted(tmp_path.glob("*.png"))).plate
    assert plate is not None
    assert (plate.name, plate.rows, plate.columns, plate.dictionary) == ("charuco", 7, 5, "aruco4x4_50")


def test_crossings_of_both_patterns_have_the_same_numbers() -> None:
    newer, older = (
        find_targets(charuco_photograph("pattern", is_older=one), codes=CHARUCO) for one in (False, True)
    )
    assert len(newer) == len(older) == CHARUCO.count
    off = newer.xy[np.argsort(newer.code)] - older.xy[np.argsort(older.code)]
    assert np.abs(off).max() < 0.5


def test_a_checkerboard_that_is_whole_in_one_photograph_is_found_where_another_cuts_it() -> None:
    squares = np.add.outer(np.arange(8), np.arange(11)) % 2
    board = np.where(squares, 220, 30).astype(np.uint8).repeat(40, 0).repeat(40, 1)
    whole = cv2.GaussianBlur(np.pad(board, 60, constant_values=220), (0, 0), 1.0)
    plate = search_checkerboard([whole, whole[:, 160:480]])  # cut on both sides, 7 by 7 crossings
    assert plate is not None and (plate.rows, plate.columns) == (7, 10)
    for other in (EMPTY, whole[:, 160:340], whole[160:360, 160:480]):  # none, and less than half of it
        assert search_checkerboard([whole, other]) is None
    shorter = np.pad(board[:, :320], 60, constant_values=220)
    assert search_checkerboard([whole, cv2.GaussianBlur(shorter, (0, 0), 1.0)]) is None  # another board


@pytest.mark.parametrize("family", ["cctag3", "cctag4"])
def test_concentric_tags_are_recognised_by_the_codes_that_photographs_share(
    family: str, tmp_path: Path
) -> None:
    """By their rings where these are resolved; the two families have other widths."""
    rng, numbers = seed_of(f"trial {family}"), (3, 10, 17, 24, 31)
    for k in range(2):
        picture = np.full((400, 600), PAPER, dtype=np.uint8)
        for place, number in enumerate(numbers):
            tag = draw_tag(
                concentric_family(family), number, 45.0, tilt_deg=20.0, blur=0.8, noise=1.0, rng=rng
            )
            row, column = divmod(place, 3)
            side = tag.image.shape[0]
            picture[200 * row : 200 * row + side, 200 * column : 200 * column + side] = tag.image
        cv2.imwrite(str(tmp_path / f"{k}.png"), picture)
    trial = try_targets(sorted(tmp_path.iterdir()))
    assert (trial.codes, trial.polarity) == (family, "dark")
    assert sorted(map(int, trial.repeated)) == list(numbers)


def test_a_plate_that_looks_alike_when_turned_is_not_used_beside_another() -> None:
    marks = ((3, 3), (3, 5), (4, 7), (5, 4))
    dots, board = PlateFamily("grid", 9, 11, marks), PlateFamily("checkerboard", 7, 10)
    assert _side_by_side((board, dots)) == ((board, dots), ())
    for alike in (PlateFamily("checkerboard", 7, 9), PlateFamily("grid", 9, 11)):
        assert alike.is_ambiguous
        one, other = (alike, dots) if alike.name == "checkerboard" else (board, alike)
        used, left_out = _side_by_side((one, other))
        assert used == ((dots,) if alike is one else (board,))
        assert [plate for plate, _ in left_out] == [alike]
