"""Checkerboards that the border of a photograph cuts: named right, or not at all."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import pytest

from sfm.conventions import AnyArray, FloatArray
from sfm.targets.codes.boards import name_cut_board
from sfm.targets.codes.plates import PlateFamily
from sfm.targets.detect import find_targets
from tests.synthetic import seed_of

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
