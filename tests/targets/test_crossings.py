"""Crossings of boards against their true places; boards that the border of a photograph cuts."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import pytest

from sfm.model.camera import project
from sfm.model.conventions import AnyArray, FloatArray
from sfm.targets.codes.boards import bend_of_edges, find_crossings, name_cut_board
from sfm.targets.codes.plates import PlateFamily
from sfm.targets.detect import find_targets
from sfm.targets.fits.saddle import MAX_HALF_SPACINGS, measure_saddles
from tests.plates import NOISE, PITCH, camera, plate_pictures, stations
from tests.synthetic import seed_of


def errors_over_stated(plate: PlateFamily, name: str, *, noise: float) -> tuple[float, float]:
    """Return the RMS of the errors of crossings in a rendered photograph, px, and over the stated ones."""
    picture = plate_pictures(plate, seed_of(name), 2, noise=noise, bits=16)[1]
    position, rotation = stations(seed_of(name), 2, plate)
    found, code = find_crossings(picture, plate, scale=65535.0, noise=65535 * noise)
    assert len(code) > 0.8 * plate.count
    off = found.xy - project(camera(), position[1], rotation[1], plate.plane(PITCH))[code]
    ratio = np.einsum("ki,kij,kj->k", off, np.linalg.inv(found.covariance), off).mean() / 2
    return float(np.sqrt((off**2).mean())), float(np.sqrt(ratio))


# RMS 0.024, 0.028, 0.032, 0.044 px; windows as large as those of a checkerboard see the tags: 0.23 px at 0.8
@pytest.mark.sweep(0, 3)
@pytest.mark.parametrize(("share", "rms_px"), [(0.5, 0.032), (0.6, 0.036), (0.7, 0.042), (0.8, 0.055)])
def test_crossings_of_charuco_boards_do_not_see_the_tags(share: float, rms_px: float) -> None:
    plate = PlateFamily("charuco", 7, 10, (), "aruco5x5_50", share)
    rms, ratio = errors_over_stated(plate, f"crossings {share}", noise=NOISE)
    print(f"share {share}: RMS {rms:.4f} px, {ratio:.2f} of the stated one")
    assert rms < rms_px
    assert 0.8 < ratio < 1.3


@pytest.mark.parametrize("share", [0.65, 0.77])
def test_corners_of_april_grids_are_as_good_as_stated(share: float) -> None:
    plate = PlateFamily("aprilgrid", 8, 10, (), "apriltag36h11", share)
    rms, ratio = errors_over_stated(plate, f"corners {share}", noise=NOISE)
    print(f"share {share}: RMS {rms:.4f} px, {ratio:.2f} of the stated one")
    assert rms < 0.06
    assert 0.8 < ratio < 1.3


def test_faint_noise_leaves_crossings_of_a_checkerboard_as_good_as_stated() -> None:
    rms, ratio = errors_over_stated(PlateFamily("checkerboard", 7, 10), "faint crossings", noise=NOISE / 4)
    print(f"RMS {rms:.4f} px, {ratio:.2f} of the stated one")
    assert rms < 0.008
    assert 0.8 < ratio < 1.3


@pytest.mark.parametrize(("bent", "blur", "rms_px"), [(0.0, 2.0, 0.08), (1 / 300, 0.8, 0.06)])
def test_windows_see_enough_of_the_edges_and_no_bend_of_them(bent: float, blur: float, rms_px: float) -> None:
    """Half as large ones have more noise, twice as large ones see how distortion bends the edges."""
    fine, spacing, n = 4, 24, 10
    side = 12 * spacing
    x, y = np.meshgrid(*2 * [(np.arange(side * fine) + 0.5) / fine - side / 2])
    column, row = (np.floor((u + bent * v * v / 2) / spacing + 40) for u, v in ((x, y), (y, x)))
    sharp = np.where((column + row) % 2, 220.0, 40.0)
    soft = cv2.GaussianBlur(sharp, (0, 0), blur * fine)
    rng = seed_of(f"windows {bent}")
    picture = cv2.resize(soft, (side, side), interpolation=cv2.INTER_AREA)
    picture += 4 * rng.standard_normal(picture.shape)
    at = spacing * np.arange(-n // 2 + 2, n // 2 - 1)
    edges = np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2).astype(float)
    true = edges.copy()
    for _ in range(30):  # x + bent y^2 / 2 and y + bent x^2 / 2 are those of the edges
        true = edges - bent * true[:, ::-1] ** 2 / 2
    true += side / 2 - 0.5
    found = measure_saddles(picture, true, np.full(len(true), MAX_HALF_SPACINGS * spacing), noise=4.0)
    rms = np.sqrt(((found.xy - true) ** 2).mean())
    print(f"bent {bent:.4f} / px, blur {blur:g} px: RMS {rms:.3f} px")
    assert rms < rms_px


@pytest.mark.parametrize("between_deg", [90, 65])
def test_the_blur_of_edges_is_measured(between_deg: float) -> None:
    """To 15 % from 0.8 px to a fifth of the window, whatever the directions of the two edges."""
    rng, n, fine = seed_of("blur of crossings"), 60, 8
    y, x = (np.mgrid[: n * fine, : n * fine] + 0.5) / fine - 0.5
    for turn in (0.0, 25.0):
        a, b = np.radians([turn, turn + between_deg])
        u, v = (-np.sin(t) * (x - 30.3) + np.cos(t) * (y - 29.6) for t in (a, b))
        for blur in (0.8, 1.2, 2.0):
            soft = cv2.GaussianBlur(np.where(u * v > 0, 200.0, 40.0), (0, 0), blur * fine)
            seen = cv2.resize(soft, (n, n), interpolation=cv2.INTER_AREA) + rng.normal(0, 3.0, (n, n))
            found = measure_saddles(
                np.rint(seen).astype(np.uint8), np.array([[30.3, 29.6]]), np.array([12.0]), noise=3.0
            )
            assert found.blur[0] == pytest.approx(np.hypot(blur, 12**-0.5), rel=0.15), (turn, blur)


SQUARE, SIZE = 60, (640, 480)  # px of the drawing and of a photograph


@lru_cache
def drawn(rows: int, columns: int) -> AnyArray:
    """Return a board with a margin of a square, the square right below the first crossing is dark."""
    r, c = np.mgrid[: rows + 1, : columns + 1]
    squares = np.where((r + c) % 2 == 0, 30, 210).astype(np.uint8)
    board = np.kron(squares, np.ones((SQUARE, SQUARE), np.uint8))
    return cv2.copyMakeBorder(board, *[SQUARE] * 4, cv2.BORDER_CONSTANT, value=210)


def photographed(
    rows: int, columns: int, name: str, *, turn: float, away: tuple[float, float], zoom: float = 0.9
) -> tuple[AnyArray, FloatArray]:
    """Return an oblique photograph of a board, and where its crossings are, px, (rows, columns, 2)."""
    rng, board = seed_of(name), drawn(rows, columns)
    height, width = board.shape
    c, s = np.cos(turn), np.sin(turn)
    to_middle = np.array([[1, 0, -width / 2], [0, 1, -height / 2], [0, 0, 1.0]])
    tilt = np.array([[1, 0, 0], [0, 1, 0], [*rng.uniform(-3e-4, 3e-4, 2), 1.0]])
    place = np.array([[c, -s, SIZE[0] / 2 + away[0]], [s, c, SIZE[1] / 2 + away[1]], [0, 0, 1.0]])
    H = place @ np.diag([zoom * 0.8, zoom * 0.8, 1]) @ tilt @ to_middle
    soft = cv2.GaussianBlur(board, (0, 0), 1.5)
    picture = cv2.warpPerspective(soft, H, SIZE, flags=cv2.INTER_AREA, borderValue=210).astype(float)
    picture += 3 * rng.standard_normal(picture.shape)
    row, column = np.mgrid[:rows, :columns]
    flat = SQUARE * (2 + np.stack([column, row], axis=2)) - 0.5
    xy = cv2.perspectiveTransform(flat.reshape(1, -1, 2).astype(float), H)[0]
    return np.rint(picture).clip(0, 255).astype(np.uint8), xy.reshape(rows, columns, 2)


@pytest.mark.parametrize("rows", [6, 7])
def test_what_is_seen_of_a_board_is_named(rows: int) -> None:
    """Cut on one or two neighbouring sides, turned by any quarter; odd and even boards."""
    columns, named = 9, 0
    for k in range(12):
        turn = 0.5 * np.pi * (k % 4) * (rows + columns) % (4 * np.pi) if (rows + columns) % 2 else 0.0
        turn += seed_of(f"turn {k}").uniform(-0.2, 0.2)
        away = seed_of(f"away {k}").uniform(-1, 1, 2) * (230, 160)
        picture, truth = photographed(rows, columns, f"board {rows} {k}", turn=turn, away=tuple(away))
        xy, code = name_cut_board(picture, rows, columns)
        if len(code):
            named += 1
            # a place beside the border may be some px off, squares are 40 px wide
            assert np.hypot(*(xy - truth.reshape(-1, 2)[code]).T).max() < 5.0
    assert named >= 8


def test_a_board_cut_on_opposite_sides_is_not_named() -> None:
    picture, _ = photographed(6, 9, "too near", turn=0.0, away=(0.0, 0.0), zoom=1.8)
    assert len(name_cut_board(picture, 6, 9)[1]) == 0


def test_other_boards_are_not_named() -> None:
    picture, _ = photographed(6, 9, "other", turn=0.1, away=(0.0, 0.0), zoom=0.8)
    assert len(name_cut_board(picture, 5, 8)[1]) == 0
    rng = seed_of("noise")
    assert len(name_cut_board(rng.integers(0, 255, (300, 400)).astype(np.uint8), 5, 8)[1]) == 0


def test_a_cut_board_is_measured() -> None:
    picture, truth = photographed(7, 8, "measured", turn=0.1, away=(190.0, 20.0))
    found = find_targets(picture, codes=PlateFamily("checkerboard", 7, 8))
    assert 20 < len(found) < 56
    assert np.abs(found.xy - truth.reshape(-1, 2)[found.code]).max() < 0.3


@pytest.mark.parametrize("flat", [0.7, 0.5, 0.4])
def test_a_board_whose_diagonals_are_shorter_than_its_rows_is_named(flat: float) -> None:
    """Compressed along the diagonal of its squares, as by a tilt of up to 66 degrees."""
    squares = np.pad(np.add.outer(np.arange(7), np.arange(10)) % 2, 1, constant_values=1)
    board = np.where(squares, 220, 30).astype(np.uint8).repeat(60, 0).repeat(60, 1)
    turn = np.array([[1.0, -1.0], [1.0, 1.0]]) / np.sqrt(2)
    A = np.diag([1.0, flat]) @ turn
    middle = (np.array(board.shape[::-1]) - 1) / 2
    move = np.column_stack([A, np.array([400.0, 300.0]) - A @ middle])
    picture = cv2.warpAffine(
        cv2.GaussianBlur(board, (0, 0), 1.5), move, (800, 600), flags=cv2.INTER_AREA, borderValue=220.0
    )
    xy, code = name_cut_board(np.asarray(picture), 6, 9)
    row, column = np.mgrid[1:7, 1:10]
    true = 60 * np.stack([column + 1, row + 1], axis=2).reshape(-1, 2) - 0.5
    assert sorted(code) == list(range(54))
    assert np.hypot(*(xy - (true @ A.T + move[:, 2])[code]).T).max() < 0.5


def test_bent_edges_do_not_move_crossings() -> None:
    """Edges of a curvature of 1/700 px, as a fisheye lens bends them, take 0.03 px in windows of 15 px."""
    rows, columns, side, finer = 6, 9, 50.0, 10

    def flat(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        return x - 320 + (y - 240) ** 2 / 1400, y - 240 + (x - 320) ** 2 / 1400

    x, y = (((np.arange(size * finer) + 0.5) / finer - 0.5).astype(np.float32) for size in (640, 480))
    squares, inside = np.zeros((480 * finer, 640 * finer), np.int8), np.True_
    for along, count in zip(flat(x[None], y[:, None]), (columns, rows), strict=True):
        square = np.floor(along / side + (count / 2 + 0.5)).astype(np.int8)  # 0 is the border
        inside = inside & (square >= 0) & (square <= count)
        squares += square
    dark = np.where(inside & (squares % 2 == 0), np.float32(40), np.float32(210))
    picture = cv2.resize(dark, (640, 480), interpolation=cv2.INTER_AREA)
    picture = np.rint(cv2.GaussianBlur(picture, (0, 0), 1.0)).astype(np.uint8)
    row, column = np.mgrid[:rows, :columns]
    corners = side * (np.stack([column, row], axis=2).reshape(-1, 2) + 0.5 - (columns / 2, rows / 2))
    true = corners + np.array([320.0, 240.0])
    for _ in range(50):
        true -= np.stack(flat(*true.T), axis=1) - corners
    board = PlateFamily("checkerboard", rows, columns)
    crossings, code = find_crossings(picture, board, scale=255.0, noise=0.3)
    assert len(code) == rows * columns
    shift = bend_of_edges(crossings, code, board, np.full(len(code), 15.0))
    error, before = (
        np.sqrt(((xy[:, None] - true) ** 2).sum(axis=2).min(axis=1).mean())
        for xy in (crossings.xy, crossings.xy - shift)
    )
    print(f"RMS {error:.4f} px, {before:.4f} px with the bend")
    assert error < 0.4 * before and before > 0.03
