"""Ring codes: the patterns of the published families, and tables of others in files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sfm.conventions import IntArray
from sfm.errors import SurveyFileError


@dataclass(frozen=True)
class CodeFamily:
    """Geometry and table of one family of coded targets."""

    name: str
    """one of RING_NAMES or the name of a table file"""
    cells: int
    """number of cells of the ring; 0 for arcs, where the number of arcs is the code"""
    number: IntArray
    """code numbers, shape (m,)"""
    pattern: IntArray
    """bit patterns, each the smallest of its rotations, read clockwise in the image, ascending, shape (m,)"""
    inner: float
    """inner radius of the ring in radii of the dot"""
    outer: float
    """outer radius of the ring in radii of the dot"""


# Radii of the ring in radii of the dot: AICON's rings, and the arcs of PhotoModeler's calibration sheet.
RING_INNER, RING_OUTER = 2.0, 3.0
ARCS_INNER, ARCS_OUTER = 2.4, 4.3
MAX_CELLS = 32  # of a ring in a table file; the published codes end at 20
MAX_TABLE_BYTES = 10_000_000
# The families of rings by name, and the cells of each; the number of arcs is a code itself.
RINGS = {"arcs": 0, "ring12": 12, "ring14": 14, "ring20": 20}
# Rings of other makers that use all necklaces, without parity: a cell read wrong is another code.
NECKLACES = {"necklace8": 8, "necklace10": 10, "necklace12": 12}
MIRRORED = "-mirrored"  # behind a name: cells are counted counter-clockwise in the image
RING_NAMES = (
    *RINGS,
    *NECKLACES,
    *(name + MIRRORED for name in (*RINGS, *NECKLACES) if name != "arcs"),
)


def ring_family(name: str) -> CodeFamily:
    """Return the family of a name in RING_NAMES: numbers are places in its table of all patterns, from 1 on.

    A mirrored family has the numbers of its table for the patterns read the other way round.
    """
    plain = name.removesuffix(MIRRORED)
    if plain == "arcs":
        none = np.zeros(0, dtype=np.int64)
        return CodeFamily(name, 0, none, none, ARCS_INNER, ARCS_OUTER)
    cells = NECKLACES[plain] if plain in NECKLACES else RINGS[plain]
    pattern = necklaces(cells) if plain in NECKLACES else ring_patterns(cells)
    number = np.arange(1, len(pattern) + 1)
    if plain != name:
        pattern = smallest_rotation(mirrored_patterns(pattern, cells), cells)
        order = np.argsort(pattern)
        pattern, number = pattern[order], number[order]
    return CodeFamily(name, cells, number, pattern, RING_INNER, RING_OUTER)


def necklaces(cells: int) -> IntArray:
    """Return all patterns of a ring that differ by more than a turn, ascending, but the empty and full one.

    Args:
        cells: number of cells of the ring.

    Returns:
        Patterns, each the smallest of its rotations, shape (m,).
    """
    value = np.arange(1, 1 << (cells - 1), dtype=np.int64)
    return np.asarray(value[smallest_rotation(value, cells) == value])


def mirrored_patterns(pattern: IntArray, cells: int) -> IntArray:
    """Return the patterns with their cells in the opposite order, shape (m,)."""
    out = np.zeros_like(pattern)
    for k in range(cells):
        out |= ((pattern >> k) & 1) << (cells - 1 - k)
    return out


def ring_patterns(cells: int) -> IntArray:
    """Return the bit patterns of a ring code with an even number of cells, ascending.

    A pattern is the smallest number of its rotations, has even parity and at least one pair of opposite
    cells set; the full ring is left out. Code number k is entry k - 1.

    Args:
        cells: number of cells of the ring, even.

    Returns:
        Patterns, shape (m,).

    Source: rule of the AICON ring codes, checked against the published 12, 14 and 20 bit tables.
    """
    value = np.arange(1 << (cells - 1), dtype=np.int64)  # the smallest rotation has its highest bit clear
    half = cells // 2
    value = value[(value & (value >> half) & ((1 << half) - 1)) != 0]
    parity = np.bitwise_count(value) % 2
    value = value[parity == 0]
    return np.asarray(value[smallest_rotation(value, cells) == value])


def smallest_rotation(value: IntArray, cells: int) -> IntArray:
    """Return the smallest number among all rotations of each pattern of the given number of cells."""
    mask = (1 << cells) - 1
    smallest = np.asarray(value).copy()
    rotated = smallest.copy()
    for _ in range(cells - 1):
        rotated = ((rotated << 1) & mask) | (rotated >> (cells - 1))
        smallest = np.minimum(smallest, rotated)
    return smallest


def read_code_table(path: Path) -> CodeFamily:
    """Return the family of a table file with two columns, number and pattern.

    The number of cells is one more than the bits of the largest pattern (a pattern is the smallest of its
    rotations, so its first cell is clear); a line "# cells 14" states it where the table is only a part.

    Args:
        path: text file; empty lines and lines that start with # are skipped.

    Returns:
        The family with the ring radii of the 12, 14 and 20 bit codes.

    Raises:
        SurveyFileError: no such file, or a line that is not a number and a pattern.
    """
    try:
        if not path.is_file() or path.stat().st_size > MAX_TABLE_BYTES:
            raise OSError("no file, or a larger one than any code table")
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError) as error:
        raise SurveyFileError(f"codes: {str(path)!r} is not a readable table") from error
    cells = 0
    entries: dict[int, int] = {}
    for k, line in enumerate(lines, 1):
        words = line.split()
        if words[:2] == ["#", "cells"] and len(words) == 3 and _is_number(words[2]):
            cells = int(words[2])
            if not 2 <= cells <= MAX_CELLS:
                raise SurveyFileError(f"{path}, line {k}: {cells} cells, a ring has 2 to {MAX_CELLS}")
        elif not words or words[0].startswith("#"):
            continue
        elif len(words) == 2 and all(_is_number(w) for w in words):
            if int(words[1]) > 0:  # the published 20 bit table ends with a row 0
                entries[int(words[1])] = int(words[0])
        else:
            raise SurveyFileError(
                f"{path}, line {k}: found {line.strip()!r:.60}, expected a number and a pattern"
            )
    if not entries:
        raise SurveyFileError(f"{path}: no codes found, expected lines with a number and a pattern")
    if max(entries) >> MAX_CELLS:
        raise SurveyFileError(f"{path}: pattern {max(entries)} has more than {MAX_CELLS} cells")
    pattern = np.array(sorted(entries), dtype=np.int64)
    cells = cells or int(pattern[-1]).bit_length() + 1
    wrong = pattern[smallest_rotation(pattern, cells) != pattern]
    if len(wrong):
        raise SurveyFileError(f"{path}: pattern {wrong[0]} is not the smallest rotation of {cells} cells")
    number = np.array([entries[int(p)] for p in pattern], dtype=np.int64)
    return CodeFamily(path.name, cells, number, pattern, RING_INNER, RING_OUTER)


def _is_number(word: str) -> bool:
    """Whether a word is a number of at most 18 digits, which 64 bits hold."""
    return word.isascii() and word.isdigit() and len(word) <= 18
