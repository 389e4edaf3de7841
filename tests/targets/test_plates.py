"""Calibration plates: which dot is which, crossings with their true sigma, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.model.camera import project
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.errors import SurveyFileError
from sfm.products.rendering.render import render_photograph
from sfm.products.rendering.scene import Optics
from sfm.survey.inputs.survey import read_survey
from sfm.targets.codes import dot_plates
from sfm.targets.codes.boards import FLAGS, REDUCED_PX, reduce_photograph
from sfm.targets.codes.dot_plates import Lattice, name_dots, placements
from sfm.targets.codes.plates import PlateFamily
from sfm.targets.detect import Targets, find_targets
from sfm.targets.fits.saddle import measure_saddles
from tests.plates import BOARD, GRID, PITCH, PIXEL_MM, SURVEY, camera, plate_scene, stations
from tests.synthetic import seed_of

NO_MARKS = replace(GRID, marks=())


def seen(plate: PlateFamily, name: str) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return places, radii and true points of the dots in a photograph that shows a part of a plate."""
    rng = seed_of(name)
    position, rotation = stations(rng, 4, plate)
    i = int(rng.integers(4))
    xy = project(camera(), position[i], rotation[i], plate.plane(PITCH))
    radius = 900 * 3.0 / np.linalg.norm(plate.plane(PITCH) - position[i], axis=1)
    is_mark = np.isin(np.arange(plate.count), [r * plate.columns + c for r, c in plate.marks])
    radius[is_mark] *= 1.5
    return xy + 0.3 * rng.standard_normal(xy.shape), radius, np.arange(plate.count)


def test_shifted_rows_are_placed_in_twelve_ways_none_of_them_mirrored() -> None:
    """A hexagonal grid looks the same after each of its own turns, which the lattice may be sheared by."""
    lattice = Lattice(np.arange(3), np.array([[0, 0], [0, 1], [1, 0]]), np.zeros((3, 2)))
    ways = placements(lattice, PlateFamily("hexagonal-grid", 5, 4))
    found = {tuple(map(tuple, way.tolist())) for way in ways}
    assert len(found) == len(ways)
    for _, across, down in ways:
        assert down[0] * across[1] - down[1] * across[0] == 2  # area of a cell, half columns by rows
        assert all(int(step.sum()) % 2 == 0 for step in (down, across))  # from dot to dot


@pytest.mark.sweep(1)
@pytest.mark.parametrize("rings", [False, True])
def test_dots_are_named_by_their_marks_however_the_plate_is_seen(rings: bool) -> None:
    """Half of the plate beyond the border, a tenth of the dots not found, others that are none."""
    named = 0
    for k in range(20):
        xy, radius, truth = seen(GRID, f"seen {k}")
        rng = seed_of(f"lost {k}")
        is_ring = np.isin(truth, [r * GRID.columns + c for r, c in GRID.marks]) & rings
        kept = (rng.random(len(xy)) > 0.1) & (xy[:, 0] > rng.uniform(-100, 200))
        kept |= np.isin(truth, [r * GRID.columns + c for r, c in GRID.marks])
        strange = rng.uniform(0, 800, (6, 2))
        code = name_dots(
            np.vstack([xy[kept], strange]),
            np.append(radius[kept], np.full(6, 9.0)),
            np.append(is_ring[kept], np.zeros(6, dtype=bool)),
            GRID,
        )
        right = code[: kept.sum()]
        assert (right[right >= 0] == truth[kept][right >= 0]).all()
        named += (right >= 0).mean() > 0.8
    assert named >= 16


LAYOUTS = {
    "far apart": ((2, 2), (2, 8), (6, 2)),
    "in the centre": ((4, 5), (4, 6), (5, 5)),
    "in a corner": ((0, 0), (0, 1), (1, 0)),
    "in three corners": ((0, 0), (0, 10), (8, 0)),
}


@pytest.mark.sweep(0, 3)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_three_marks_are_enough_wherever_they_are(layout: str) -> None:
    """Whole plates, and with a column of dots beyond the plate."""
    plate = replace(GRID, marks=LAYOUTS[layout])
    wider = replace(GRID, columns=12)
    is_mark = np.isin(np.arange(plate.count), [r * plate.columns + c for r, c in plate.marks])
    for k in range(4):
        rng = seed_of(f"{layout} {k}")
        position, rotation = stations(rng, 4, plate)
        xy = project(camera(), position[k], rotation[k], wider.plane(PITCH))
        radius = 900 * 3.0 / np.linalg.norm(wider.plane(PITCH) - position[k], axis=1)
        radius *= np.exp(0.01 * rng.standard_normal(len(radius)))
        on_plate = np.arange(wider.count) % wider.columns < plate.columns
        radius[np.flatnonzero(on_plate)[is_mark]] *= 1.4
        none = np.zeros(wider.count, dtype=bool)
        whole = name_dots(xy[on_plate], radius[on_plate], none[on_plate], plate)
        assert (whole == np.arange(plate.count)).all()
        larger = name_dots(xy, radius, none, plate)
        assert (larger[on_plate] == np.arange(plate.count)).all() and (larger[~on_plate] == -1).all()


@pytest.mark.parametrize("strange", [0.01, 0.3])
def test_sizes_have_a_density(strange: float) -> None:
    z = np.linspace(-dot_plates.RANGE_SIGMAS / 2, dot_plates.RANGE_SIGMAS / 2, 20001)
    density = np.exp(dot_plates._log_likelihood(z, strange))
    assert np.trapezoid(density, z) == pytest.approx(1, abs=2e-3)


def test_smaller_dots_are_no_marks() -> None:
    """Three that are a fifth smaller, as the marks are arranged, where the marks are beyond the border."""
    plate = replace(GRID, marks=LAYOUTS["in a corner"])
    rng = seed_of("smaller")
    position, rotation = stations(rng, 4, plate)
    xy = project(camera(), position[0], rotation[0], plate.plane(PITCH))
    radius = 12 * np.exp(0.01 * rng.standard_normal(plate.count))
    row = np.arange(plate.count) // plate.columns
    radius[[r * plate.columns + c for r, c in ((2, 0), (2, 1), (3, 0))]] *= 0.8
    seen = row >= 2
    assert (name_dots(xy[seen], radius[seen], np.zeros(seen.sum(), dtype=bool), plate) == -1).all()


def test_a_plate_whose_marks_are_not_seen_gets_no_names() -> None:
    xy, radius, truth = seen(GRID, "no marks")
    kept = truth % GRID.columns > 7
    assert (name_dots(xy[kept], radius[kept], np.zeros(kept.sum(), dtype=bool), GRID) == -1).all()


def test_a_plate_without_marks_must_be_whole() -> None:
    xy, radius, truth = seen(NO_MARKS, "whole 3")
    none = np.zeros(len(xy), dtype=bool)
    code = name_dots(xy, radius, none, NO_MARKS)
    assert (code == truth).all() or (code == truth[::-1]).all()  # it looks alike turned by 180 degrees
    assert (xy[:, 0] - xy[:, 0].mean()) @ (code % NO_MARKS.columns) > 0  # columns run to the right
    part = truth >= NO_MARKS.columns
    assert (name_dots(xy[part], radius[part], none[part], NO_MARKS) == -1).all()


@pytest.mark.parametrize("side", [6, 7])
def test_a_square_board_is_named_upright_with_its_first_square_dark(side: int) -> None:
    """Of an odd number of crossings, squares tell two of four turns; of an even number, none."""
    squares = np.add.outer(np.arange(side + 1), np.arange(side + 1)) % 2
    drawn = (
        np.pad(np.where(squares, 220, 30).astype(np.uint8), 1, constant_values=220)
        .repeat(40, 0)
        .repeat(40, 1)
    )
    board = PlateFamily("checkerboard", side, side)
    for turn in range(4):
        picture = cv2.GaussianBlur(np.rot90(drawn, turn).copy(), (0, 0), 1.0)
        found = find_targets(picture, codes=board)
        assert len(found) == board.count
        xy = found.xy[np.argsort(found.code)].reshape(side, side, 2)
        across, down = xy[0, 1] - xy[0, 0], xy[1, 0] - xy[0, 0]
        x, y = np.rint(xy[0, 0] + (across + down) / 2).astype(int)
        assert picture[y, x] < 100
        if side == 6 or turn % 2 == 0:
            assert across[0] > 30


@lru_cache
def photographed(plate: PlateFamily, rings: bool) -> tuple[Targets, FloatArray]:
    """Return the targets of a rendered plate upside down, and where its points are, px."""
    rng = seed_of(f"photographed {plate.name} {rings}")
    position, rotation = stations(rng, 4, plate)
    optics = Optics(blur_px=0.8, exposure=0.9, noise=0.02, oversampling=3)
    scene = plate_scene(plate, rings=rings)
    picture, _ = render_photograph(scene, camera(), position[2], rotation[2], optics=optics, rng=rng)
    found = find_targets(picture, polarity="auto" if rings else "dark", codes=plate)
    return found, project(camera(), position[2], rotation[2], plate.plane(PITCH))


@pytest.mark.parametrize("rings", [False, True])
def test_rendered_dots_are_all_found(rings: bool) -> None:
    found, xy = photographed(GRID, rings)
    assert sorted(found.code.tolist()) == list(range(GRID.count))
    assert np.abs(found.xy - xy[found.code]).max() < 0.25  # eccentricity, which the survey corrects


@pytest.mark.parametrize("square_px", [14, 60, 130])
def test_boards_are_found_in_large_photographs(square_px: int) -> None:
    """Sought reduced, measured in full."""
    squares = np.add.outer(np.arange(7), np.arange(10)) % 2
    drawn = np.pad(np.where(squares, 220, 30).astype(np.uint8), 1, constant_values=220)
    photograph = np.full((1300, 1900), 220, dtype=np.uint8)
    board = drawn.repeat(square_px, 0).repeat(square_px, 1)
    photograph[40 : 40 + len(board), 90 : 90 + board.shape[1]] = board
    found = find_targets(cv2.GaussianBlur(photograph, (0, 0), 1.0), codes=PlateFamily("checkerboard", 6, 9))
    row, column = np.divmod(np.arange(54), 9)
    true = np.stack([90 + square_px * (column + 2), 40 + square_px * (row + 2)], axis=1) - 0.5
    assert np.abs(found.xy[np.argsort(found.code)] - true).max() < 0.02


def test_small_squares_are_found_in_the_reduced_photograph() -> None:
    """Squares of 9 px there, in a sixteenth of the pixels; those of half the width are not."""
    squares = np.pad(np.add.outer(np.arange(7), np.arange(10)) % 2, 1, constant_values=1)
    photograph = np.full((2400, 3200), 220, dtype=np.uint8)
    board = np.where(squares, 220, 30).astype(np.uint8).repeat(36, 0).repeat(36, 1)
    photograph[700 : 700 + len(board), 900 : 900 + board.shape[1]] = board
    for largest_px, is_found in ((REDUCED_PX, True), (REDUCED_PX // 2, False)):
        small, _ = reduce_photograph(cv2.GaussianBlur(photograph, (0, 0), 1.5), largest_px)
        assert cv2.findChessboardCornersSB(small, (9, 6), flags=FLAGS)[0] == is_found
        assert small.size <= photograph.size / 16


def measured_crossing(drawn: FloatArray) -> FloatArray:
    """Return the crossing in the middle of a drawn photograph, (2,)."""
    picture = np.rint(cv2.GaussianBlur(drawn, (0, 0), 1.5)).astype(np.uint8)
    return measure_saddles(picture, np.array([[41.0, 39.6]]), np.array([14.0]), noise=1.0).xy[0]


@pytest.mark.parametrize(("weak", "is_crossing"), [(0.0, False), (0.1, False), (0.2, True)])
def test_an_edge_is_no_crossing(weak: float, is_crossing: bool) -> None:
    """Finders of boards take a point on an edge for a crossing now and then; a weak second edge is chance."""
    y, x = np.mgrid[-40:41, -40:41] - 0.5
    found = measured_crossing(120 + 60 * np.sign(x) + 60 * weak * np.sign(y))
    assert np.isfinite(found).all() == is_crossing


@pytest.mark.parametrize("sine", [0.5, 0.55, 0.6, 0.65, 0.8, 0.99])
def test_oblique_edges_are_a_crossing(sine: float) -> None:
    y, x = np.mgrid[-40:41, -40:41] - np.array([0.27, 0.31])[:, None, None]
    half = np.arcsin(sine) / 2
    first, second = (np.sign(x * np.sin(a) + y * np.cos(a)) for a in (half, -half))
    # drawn in whole pixels
    assert measured_crossing(120 + 80 * first * second) == pytest.approx([40.31, 40.27], abs=0.35)


def test_crossings_are_as_precise_as_they_say() -> None:
    found, xy = photographed(BOARD, False)
    assert found.code.tolist() == list(range(BOARD.count))
    error = found.xy - xy
    over = np.einsum("ka,kab,kb->k", error, np.linalg.inv(found.covariance), error)
    assert np.sqrt((error**2).mean()) < 0.03
    assert over.mean() / 2 == pytest.approx(1.0, abs=0.45)  # 88 of them, 2 degrees of freedom each


def test_a_charuco_board_is_named_where_a_part_of_it_is_seen() -> None:
    """OpenCV's own drawing of a board, seen obliquely, its right third beyond the border."""
    plate = PlateFamily("charuco", 6, 8, dictionary="aruco4x4_50", tag_share=0.75)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    drawn = cv2.aruco.CharucoBoard((9, 7), 1.0, 0.75, dictionary).generateImage((1440, 1120), marginSize=0)
    corners = np.array([[0, 0], [1440, 0], [1440, 1120], [0, 1120]], dtype=np.float32)
    places = np.array([[60, 90], [950, 30], [1010, 700], [40, 620]], dtype=np.float32)
    H = cv2.getPerspectiveTransform(corners, places)
    # pixels of the drawing are squares: the centre of its first one is (0.5, 0.5) of the drawing
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    drawn = cv2.GaussianBlur(drawn, (0, 0), 2.0)  # as sharp as the pixels of the photograph, which sample it
    picture = cv2.warpPerspective(drawn, H @ half, (720, 760), flags=cv2.INTER_LINEAR, borderValue=255)
    found = find_targets(picture, codes=plate)
    row, column = np.divmod(np.arange(48), 8)
    flat = np.stack([160.0 * (column + 1), 160.0 * (row + 1)], axis=1)
    xy = cv2.perspectiveTransform(flat[None], H)[0]
    assert 25 < len(found) < 40
    assert np.abs(found.xy - xy[found.code]).max() < 0.15


def survey_text(**changes: str) -> str:
    text = SURVEY.format(
        name="plate", polarity="dark", pixel=PIXEL_MM, codes="grid", rows=9, columns=11, pitch=12.0,
        marks=[list(mark) for mark in GRID.marks], datum="control",
    )  # fmt: skip
    for old, new in changes.items():
        lines = [new if line.startswith(f"{old} =") else line for line in text.splitlines()]
        text = "\n".join(line for line in lines if line)
    return text


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pitch": ""}, "targets.pitch is missing, codes = 'grid' needs it"),
        ({"codes": 'codes = "ring14"'}, "targets.rows belongs to a calibration plate, codes = 'ring14'"),
        ({"marks": "marks = [[3, 3], [12, 4]]"}, r"mark \[12, 4\] is not on a plate of 9 rows"),
        ({"marks": "marks = [[3, 3], [5, 3]]"}, "the marks look alike turned by 180 degrees"),
        ({"marks": "", "kind": 'kind = "free"'}, "looks alike turned by 180 degrees has no"),
        (
            {"marks": "", "columns": "columns = 9", "kind": 'kind = "free"'},
            "looks alike turned by 90 degrees has no",
        ),
        ({"codes": 'codes = "charuco"', "marks": ""}, "targets.dictionary = '', codes = 'charuco' needs"),
        (
            {"codes": 'codes = "aprilgrid"\ndictionary = "apriltag36h11"\ntag_size = 9.0', "marks": ""},
            "an AprilGrid of 9 x 11 corners, even numbers",
        ),
        (
            {
                "codes": 'codes = "aprilgrid"\ndictionary = "apriltag16h5"\ntag_size = 9.0\nfirst_tag = 8',
                "rows": "rows = 12",
                "columns": "columns = 10",
                "marks": "",
            },
            "the board has tags 8 to 37, dictionary 'apriltag16h5' has 0 to 29",
        ),
        ({"marks": "first_tag = 3"}, "targets.first_tag belongs to codes = 'charuco' or 'aprilgrid'"),
        ({"codes": 'codes = "checkerboard"'}, "targets.marks belong to grid, asymmetric-grid"),
        ({"codes": 'codes = "checkerboard"', "rows": "rows = 2", "marks": ""}, "board of 2 x 11 cross"),
        ({"unit": 'unit = "mm"\n[control]\nfile = "c.csv"'}, r"\[control\] is given, but the calib"),
    ],
)  # fmt: skip
def test_plates_that_cannot_be_are_refused(tmp_path: Path, changes: dict[str, str], message: str) -> None:
    (tmp_path / "c.csv").write_text("id,X,Y,Z\n1,0,0,0\n", encoding="utf-8")
    path = tmp_path / "survey.toml"
    path.write_text(survey_text(**changes), encoding="utf-8")
    with pytest.raises(SurveyFileError, match=message):
        read_survey(path)


def test_the_plate_is_control_and_start_value(tmp_path: Path) -> None:
    path = tmp_path / "survey.toml"
    path.write_text(survey_text(pitch="pitch = 12.0\nplate_sigma = 0.004"), encoding="utf-8")
    survey = read_survey(path)
    assert (
        survey.control is not None and len(survey.control.names) == 99 and survey.control.sigma[0, 0] == 0.004
    )
    assert survey.start_points is survey.control
    assert np.allclose(survey.control.xyz[12], (12, -12, 0))
    assert replace(survey, name="again").control is not None


def test_a_ring_is_ten_standard_deviations_larger_than_the_dots() -> None:
    rng = seed_of("ring sizes")
    place = np.array([[row, column] for row in range(4) for column in range(5)])
    radius = 8.0 * np.exp(0.01 * rng.standard_normal(20))
    ring = np.arange(20) == 7
    radius[7] *= 2.0
    size = dot_plates.size_of_marks(Lattice(np.arange(20), place, np.zeros((20, 2))), radius, ring)
    assert size[ring].tolist() == [10.0] and np.abs(size[~ring]).max() < 8.0


@pytest.mark.parametrize("sign", [1, -1])
def test_rings_are_of_the_other_polarity_than_most(sign: int) -> None:
    polarity = sign * np.array([1, 1, -1, 1, 1, -1, 1])
    assert dot_plates.rings_among(polarity).tolist() == [False, False, True, False, False, True, False]
