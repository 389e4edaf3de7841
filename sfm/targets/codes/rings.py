"""Ring codes: published patterns, tables in files, and the reading of the ring around a dot."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.model.errors import SurveyFileError
from sfm.runtime.compiling import compiled
from sfm.runtime.sampling import as_grey, bilinear
from sfm.targets.codes.ring_cells import fit_cells, place_cells
from sfm.targets.codes.ring_ellipses import may_have_rings, measure_rings, trace_crossings

UNCODED = -1
UNREADABLE = -2
# Sampling of the ring: angles, and radii as fractions between inner and outer radius of the ring. The first
# radius lies in the gap between dot and ring, the last outside the ring, and the others in the ring.
ANGLES = 360
RADII = np.array([-0.45, 0.25, 0.5, 0.75, 1.4])
# Level between background (0) and dot (1) that separates set from clear, and the minimum distance from it on
# both sides for a certain reading of arcs.
HALF = 0.5
MARGIN = 0.15
# A dot has no code if nothing in the ring around it is above this level.
MIN_SET = 0.3
# Step from clear to set cells in units of that from background to dot, and the minimum gap between the levels
# of set and clear cells, in steps. Codes of the retro-panel have 0.89 to 1.05 and 0.61.
MIN_STEP, MAX_STEP, MIN_JUMP = 0.6, 1.5, 0.4
# Maximum deviations, in steps, with the worst value of the retro-panel: of a clear cell from the background
# (0.08), or under glare (0.18) from the mean before and behind it (0.06); beside the ring from the background
# (0.12); of a set cell from shading (0.08), with the sigma of its change over the radius; of a cell on one
# radius from its mean (0.05, and 0.18 at the limit of resolution); of the samples (0.04).
CLEAR_TOLERANCE, GLARE, GLARE_TOLERANCE = 0.1, 0.25, 0.07
GAP_TOLERANCE, SET_TOLERANCE, SHADING = 0.15, 0.1, 0.15
RADIAL_TOLERANCE, RESIDUAL_TOLERANCE, NOISE_SIGMAS = 0.2, 0.1, 3.0
# Part of the circle just behind the ring that other objects may cover, and the maximum level behind a set
# cell, in steps (0.24 at the limit of resolution): objects that make a clear cell look set mostly extend
# outwards.
OUTSIDE_CLUTTER, BEHIND_SET = 0.25, 0.3
# Before the search for position, ink and light: maximum mean level behind set cells, in steps, and of a free
# corner of a border. 785 rings that are read (retro-panel, other proportions, and the tests of spread ink and
# light, blur and tilt) have up to 0.33 and 0.20; 2,179 keys of rendered keyboards have at least 0.67.
FIRST_BEHIND_SET, FIRST_CLEAR = 0.5, 0.3
# Blur of an edge in a sharp photograph, px.
SHARP_PX = 0.8
# Number of different codes that must be read with radii measured in the photograph: the neighbours of a dot
# in a grid may look like a code, but like the same one around most dots.
MIN_READ = 2
# Maximum angle of an interruption of the ring, and minimum angle of an arc.
SHORTEST_ARC_DEG = 12


@dataclass(frozen=True)
class CodeFamily:
    """Geometry and code table of one family of coded targets."""

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
MAX_CELLS = 32  # of a ring in a table file; the published codes end at 20 cells
MAX_TABLE_BYTES = 10_000_000
# The families of rings by name, and their number of cells; for arcs, the number of arcs is the code. Of two
# with one number the stricter table comes first: a draft takes the first of those that read most.
RINGS = {"arcs": 0, "ring12": 12, "ring14": 14, "ring20": 20, "even14": 14}
# Rings of other makers that use all necklaces, without parity: a misread cell gives another valid code.
NECKLACES = {"necklace8": 8, "necklace10": 10, "necklace12": 12}
MIRRORED = "-mirrored"  # suffix of a name: cells are counted counter-clockwise in the image
_ROUND = (*RINGS, *NECKLACES)
RING_NAMES = _ROUND + tuple(name + MIRRORED for name in _ROUND if name != "arcs")


def ring_family(name: str) -> CodeFamily:
    """Return the family with a name in RING_NAMES; numbers are positions in its pattern table, from 1.

    A mirrored family has the numbers of its table for the patterns read in the opposite direction.
    """
    plain = name.removesuffix(MIRRORED)
    if plain == "arcs":
        none = np.zeros(0, dtype=np.int64)
        return CodeFamily(name, 0, none, none, ARCS_INNER, ARCS_OUTER)
    cells = NECKLACES[plain] if plain in NECKLACES else RINGS[plain]
    even = plain.startswith("even")  # its numbers ascend with the patterns read counter-clockwise
    pattern = (necklaces if plain in NECKLACES else even_patterns if even else ring_patterns)(cells)
    number = np.arange(1, len(pattern) + 1)
    if (plain != name) != even:
        pattern = smallest_rotation(mirrored_patterns(pattern, cells), cells)
        order = np.argsort(pattern)
        pattern, number = pattern[order], number[order]
    return CodeFamily(name, cells, number, pattern, RING_INNER, RING_OUTER)


def necklaces(cells: int) -> IntArray:
    """Return all ring patterns that differ by more than a rotation, ascending, without empty and full ring.

    Args:
        cells: number of cells of the ring.

    Returns:
        Patterns, each the smallest of its rotations, shape (m,).
    """
    value = np.arange(1, 1 << (cells - 1), dtype=np.int64)
    return np.asarray(value[smallest_rotation(value, cells) == value])


def mirrored_patterns(pattern: IntArray, cells: int) -> IntArray:
    """Return patterns with their cells in the opposite order, shape (m,)."""
    out = np.zeros_like(pattern)
    for k in range(cells):
        out |= ((pattern >> k) & 1) << (cells - 1 - k)
    return out


def ring_patterns(cells: int) -> IntArray:
    """Return the bit patterns of a ring code with an even number of cells, ascending.

    A pattern is the smallest number of its rotations, has even parity and at least one pair of opposite
    cells set; the full ring is excluded. Code number k is entry k - 1.

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


def even_patterns(cells: int) -> IntArray:
    """Return the bit patterns of a ring code of even parity that covers more than half a ring, ascending.

    A pattern is the smallest number of its rotations, has even parity and at least four set cells, which are
    not all in one half of the ring; the full ring is excluded. Code number k is entry k - 1.

    Args:
        cells: number of cells of the ring, even.

    Returns:
        Patterns, shape (m,).

    Source: numbers printed beside rings of 14 cells in photographs of a public project
    (github.com/lcmrl/multicamera-calibration); the rule gives all of the 37 numbers that were compared.
    """
    value = necklaces(cells)
    set_cells = np.bitwise_count(value)
    return np.asarray(value[(set_cells % 2 == 0) & (set_cells >= 4) & (value >> (cells // 2) > 0)])


def smallest_rotation(value: IntArray, cells: int) -> IntArray:
    """Return the smallest number among all rotations of each pattern of a given number of cells."""
    mask = (1 << cells) - 1
    smallest = np.asarray(value).copy()
    rotated = smallest.copy()
    for _ in range(cells - 1):
        rotated = ((rotated << 1) & mask) | (rotated >> (cells - 1))
        smallest = np.minimum(smallest, rotated)
    return smallest


def read_code_table(path: Path) -> CodeFamily:
    """Return the family of a table file with two columns, number and pattern.

    The number of cells is one more than the bits of the largest pattern, because a pattern is the smallest of
    its rotations and its first cell is therefore clear. A line "# cells 14" states it for a partial table.

    Args:
        path: text file; empty lines and lines that start with # are skipped.

    Returns:
        The family with the ring radii of the 12, 14 and 20 bit codes.

    Raises:
        SurveyFileError: the file does not exist, or a line is not a number and a pattern.
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
    """Return whether a word is a number of at most 18 digits, which 64 bits can represent."""
    return word.isascii() and word.isdigit() and len(word) <= 18


class RingCodes(NamedTuple):
    """Codes read around k dots."""

    code: IntArray
    """code numbers, `UNCODED` if there is nothing around the dot and `UNREADABLE` if the ring is not a valid
    code, shape (k,)"""
    confidence: FloatArray
    """confidence of the reading, 0 to 1, shape (k,)"""
    outer: FloatArray
    """outer radius of the ring in radii of the dot, shape (k,)"""
    ringed: BoolArray
    """whether the surroundings look like a ring of this number of cells before the search, shape (k,)"""


def read_codes(
    photograph: AnyArray,
    xy: FloatArray,
    shape: FloatArray,
    levels: FloatArray,
    family: CodeFamily,
    *,
    blur_px: FloatArray | None = None,
    noise: FloatArray | None = None,
) -> RingCodes:
    """Read the code around each measured dot.

    The ring is sampled on ellipses similar to the dot's, which removes tilt and rotation. Intensities are
    scaled to 0 = background and 1 = dot, so dark and bright targets are read alike. Codes that are not read
    so are read again from the rings that the photograph shows: with the radii that several of them have in
    common, and on their own ellipses, see `ring_ellipses`.

    Args:
        photograph: intensities, shape (H, W).
        xy: centres of the dots, px, shape (k, 2).
        shape: (p, q, r) with (p q; q r) turning image vectors into dot radii, 1/px, shape (k, 3).
        levels: intensity of the background and its step to the dot, shape (k, 2).
        family: the family of codes.
        blur_px: standard deviation of the edge of each dot, including the pixel box, shape (k,); default is
            that of a sharp photograph.
        noise: standard deviation of the intensities about the fit of each dot, shape (k,); default is 0.

    Returns:
        Codes, confidence and the radius of each ring.
    """
    return RingReader(photograph, xy, shape, levels, blur_px=blur_px, noise=noise).read(family)


class RingReader:
    """Reads the codes around the dots of a photograph, in as many families as are asked for.

    Where rays cross rings, and what the cells contain for a number of cells and two radii, does not depend on
    the table of codes. It is measured once for all families.
    """

    def __init__(
        self,
        photograph: AnyArray,
        xy: FloatArray,
        shape: FloatArray,
        levels: FloatArray,
        *,
        blur_px: FloatArray | None = None,
        noise: FloatArray | None = None,
    ) -> None:
        """Take the dots; the arguments are those of `read_codes`."""
        self.grey, self.xy, self.shape = as_grey(photograph), xy, shape
        self.levels = np.asarray(levels, dtype=float)
        self.blur = np.full(len(xy), SHARP_PX) if blur_px is None else np.asarray(blur_px, dtype=float)
        misfit = np.zeros(len(xy)) if noise is None else np.asarray(noise, dtype=float)
        self.misfit = misfit / np.abs(self.levels[:, 1])
        self._contents: dict[tuple[int, float, float, bool], dict[int, FloatArray | None]] = {}

    @cached_property
    def crossings(self) -> FloatArray:
        """Radii where rays cross a ring, see `trace_crossings`, (k, ANGLES, 2)."""
        return trace_crossings(self.grey, self.xy, self.shape, self.levels)

    def read(self, family: CodeFamily, *, as_seen: bool = True) -> RingCodes:
        """Return the codes of a family, see `read_codes`; with its own radii only if not `as_seen`."""
        if family.cells == 0:
            return _read_arcs(self.grey, self.xy, self.shape, self.levels, family)
        every = np.arange(len(self.xy))
        codes = self._read_with_radii(every, self.shape, np.zeros((len(every), 2)), family, as_seen=False)
        unread = np.flatnonzero(codes.code < 0)
        if not (as_seen and len(unread)):
            return codes
        rings = measure_rings(self.crossings[unread], self.shape[unread], (family.inner, family.outer))
        of = unread[rings.row]
        seen = replace(family, inner=rings.inner, outer=rings.outer)
        again = self._read_with_radii(of, rings.shape, rings.tilt, seen, as_seen=True)
        codes.ringed[of] |= again.ringed
        read = again.code >= 0
        if not rings.are_other or len(np.unique(again.code[read])) >= MIN_READ:
            for part, values in zip(codes, again, strict=True):
                part[of[read]] = values[read]
        return codes

    def _read_with_radii(
        self, of: IntArray, shape: FloatArray, tilt: FloatArray, family: CodeFamily, *, as_seen: bool
    ) -> RingCodes:
        """Read the codes around dots with the radii of the family.

        Args:
            of: dots, (k,).
            shape: (p, q, r) of S of their rings, 1/px, (k, 3).
            tilt: perspective of their rings, see `ring_ellipses.Rings`, (k, 2).
            family: the family of codes.
            as_seen: whether shape and tilt are those that the photograph shows.
        """
        radii = family.inner + RADII * (family.outer - family.inner)
        polar = _sample_rings(self.grey, self.xy[of], shape, self.levels[of], radii, ANGLES)
        code, confidence = np.full(len(of), UNCODED, dtype=np.int64), np.zeros(len(of))
        body = polar[:, 1:4]
        ring = np.flatnonzero((body > MIN_SET).any(axis=(1, 2)))  # nan is not above
        code[ring] = UNREADABLE
        ring = ring[np.isfinite(body[ring]).all(axis=(1, 2))]
        ring = ring[may_have_rings(self.crossings[of[ring]], family.inner, family.outer)]
        kept = self._contents.setdefault((family.cells, family.inner, family.outer, as_seen), {})
        new = np.array([k for k in ring if int(of[k]) not in kept], dtype=np.int64)
        kept.update(zip(of[new].tolist(), self._fit(of[new], shape[new], tilt[new], family), strict=True))
        ringed = np.zeros(len(of), dtype=bool)
        for k in ring:
            contents = kept[int(of[k])]
            if contents is not None:
                ringed[k] = True
                code[k], confidence[k] = _read_cells(contents, family, self.misfit[of[k]])
        return RingCodes(code, confidence, np.full(len(of), family.outer), ringed)

    def _fit(
        self, of: IntArray, shape: FloatArray, tilt: FloatArray, family: CodeFamily
    ) -> list[FloatArray | None]:
        """Return the contents of the cells around dots; None where the first comparison shows no ring."""
        proportions = family.cells, family.inner, family.outer
        xy, levels, blur = self.xy[of], self.levels[of], self.blur[of]
        contents, start = place_cells(self.grey, xy, shape, levels, blur, *proportions, tilt)
        ends = [k for k in range(len(of)) if _ends(contents[k], start[k, 2:])]
        geometry = xy[ends], shape[ends], levels[ends], blur[ends]
        cells = fit_cells(self.grey, *geometry, *proportions, tilt[ends], start[ends])
        of_dots: list[FloatArray | None] = [None] * len(of)
        for k, fitted in zip(ends, cells, strict=True):
            of_dots[k] = fitted
        return of_dots


@compiled
def _sample_rings(
    image: AnyArray, xy: FloatArray, shape: FloatArray, levels: FloatArray, radii: FloatArray, angles: int
) -> FloatArray:
    """Return normalised intensities on rings around each dot, (k, radii, angles); nan outside the image."""
    height, width = image.shape
    out = np.empty((len(xy), len(radii), angles))
    for k in range(len(xy)):
        p, q, r = shape[k]
        det = p * r - q * q
        for j in range(angles):
            t = 2 * np.pi * j / angles  # y is down, so growing angles run clockwise in the image
            c, s = np.cos(t), np.sin(t)
            ex, ey = (r * c - q * s) / det, (p * s - q * c) / det
            for i in range(len(radii)):
                x, y = xy[k, 0] + radii[i] * ex, xy[k, 1] + radii[i] * ey
                if x >= 0 and y >= 0 and x < width - 1 and y < height - 1:
                    out[k, i, j] = (bilinear(image, x, y) - levels[k, 0]) / levels[k, 1]
                else:
                    out[k, i, j] = np.nan
    return out


def _read_arcs(
    grey: AnyArray, xy: FloatArray, shape: FloatArray, levels: FloatArray, family: CodeFamily
) -> RingCodes:
    """Read the number of arcs around each dot, see `read_codes`."""
    radii = family.inner + RADII * (family.outer - family.inner)
    polar = _sample_rings(grey, xy, shape, levels, radii, ANGLES)
    count = np.full(len(polar), UNCODED, dtype=np.int64)
    confidence = np.zeros(len(polar))
    for k, rings in enumerate(polar):
        gap, body, outside = rings[0], rings[1:4], rings[4]
        inside = np.isfinite(body).all(axis=0)
        if not inside.any() or not (body[:, inside] > HALF).any():
            continue
        count[k] = UNREADABLE
        if not inside.all() or np.isnan(gap).any() or gap.max() > HALF:
            continue
        state = body[1] > HALF
        edges = np.flatnonzero(state != np.roll(state, 1))
        if len(edges) == 0 or np.nanmax(outside) > HALF:
            continue
        length = np.diff(np.append(edges, edges[0] + len(state))) * 360 / len(state)
        # Away from the ends of the arcs all radii must agree.
        blur = round(SHORTEST_ARC_DEG / 3 * len(state) / 360)
        sure = np.ones(len(state), dtype=bool)
        for shift in range(-blur, blur + 1):
            sure &= np.roll(state, shift) == state
        certainty = np.abs(body - HALF)[:, sure].min()
        agree = ((body > HALF) == state)[:, sure].all()
        if length.min() < SHORTEST_ARC_DEG or not agree or certainty < MARGIN:
            continue
        count[k] = len(edges) // 2
        confidence[k] = min(1.0, 2 * certainty)
    return RingCodes(count, confidence, np.full(len(xy), family.outer), count != UNCODED)


def _read_cells(contents: FloatArray, family: CodeFamily, misfit: float) -> tuple[int, float]:
    """Return code number and confidence of one ring from the levels of its cells, see `fit_cells`.

    Set and clear cells are separated at the widest gap between their sorted levels, so a shadow across the
    ring does no harm. A ring that is partly covered, or an object that looks like a ring by chance, must not
    be read. Therefore clear cells, the clear ring and the area behind set cells must have the level of the
    background, except for the border of a label. Set cells must have one level, except for shading. Each cell
    must have the same level on all radii and over its length. A misfit of the model at the dot (in steps),
    for example from sharpening halos, is added to the tolerance for the samples.
    """
    if not np.isfinite(contents).all():
        return UNREADABLE, 0.0
    at_radii, (residual, gap, behind, sigma) = contents[:3], contents[3:7]
    level = at_radii.mean(axis=0)
    order = np.sort(level)
    jump = np.diff(order)
    at = jump.argmax()
    bits = level > (order[at] + order[at + 1]) / 2
    step = level[bits].mean() - level[~bits].mean()
    if not MIN_STEP <= step <= MAX_STEP or jump[at] < MIN_JUMP * step:
        return UNREADABLE, 0.0
    # Shading makes the levels of the set cells a plane, with a prior so that few cells do not fit any plane.
    angle = 2 * np.pi * np.arange(family.cells) / family.cells
    A = np.column_stack([np.ones(family.cells), np.cos(angle), np.sin(angle)])[bits]
    prior = np.diag([0.0, 1.0, 1.0]) * (SET_TOLERANCE / SHADING) ** 2
    plane = A @ np.linalg.solve(A.T @ A + prior, A.T @ level[bits])
    noise = NOISE_SIGMAS * sigma * residual
    # Glare across the ring appears in a clear cell as it does before and behind it.
    glare = np.abs(level - (gap + behind) / 2) * (CLEAR_TOLERANCE / GLARE_TOLERANCE)
    uneven = np.minimum(np.abs(level), glare)
    uneven[bits] = np.abs(level[bits] - plane) * (CLEAR_TOLERANCE / SET_TOLERANCE)
    behind = np.where(_find_border(behind, step), 0.0, behind)
    clutter = np.abs(behind) > GAP_TOLERANCE * step + noise
    tests = (
        np.abs(at_radii - level) <= RADIAL_TOLERANCE * step + noise,
        uneven <= CLEAR_TOLERANCE * step + noise,
        np.abs(level[~bits]) <= GLARE * step,
        np.abs(gap) <= GAP_TOLERANCE * step + noise,
        residual <= np.hypot(RESIDUAL_TOLERANCE * step, misfit),
        clutter.mean() <= OUTSIDE_CLUTTER,
        np.abs(behind[bits]) <= BEHIND_SET * step + noise[bits],
    )
    value = smallest_rotation(np.array([bits @ (1 << np.arange(family.cells - 1, -1, -1))]), family.cells)[0]
    entry = np.searchsorted(family.pattern, value)
    known = entry < len(family.pattern) and family.pattern[entry] == value
    if not known or not all(np.all(t) for t in tests):
        return UNREADABLE, 0.0
    return int(family.number[entry]), float(min(1.0, jump[at] / step))


def _ends(contents: FloatArray, bits: FloatArray) -> bool:
    """Return whether what looks like set cells ends at the outer radius, or whether a label's border follows.

    Objects larger than a ring, such as neighbouring keys, go on behind it. A search would not change that.

    Args:
        contents: contents of the cells, see `place_cells`, (8, cells).
        bits: 1.0 for set cells, (cells,).
    """
    if not np.isfinite(contents).all():
        return False
    level, behind = contents[:3].mean(axis=0), contents[5]
    step = level[bits > 0].mean() - level[bits == 0].mean()
    rest = np.where(_find_border(behind, step, FIRST_CLEAR), 0.0, np.abs(behind))
    return bool(rest[bits > 0].mean() <= FIRST_BEHIND_SET * step)


def _find_border(behind: FloatArray, step: float, tolerance: float = GAP_TOLERANCE) -> BoolArray:
    """Return which cells have the border of a label behind them, on all four sides of a square, (cells,).

    A border surrounds the dot, is equal to half a step at each quarter turn, and leaves corners free. Other
    objects cover one or two sides. An edge on four sides that reaches into the ring leaves no corner free
    behind it. Rings whose number of cells is not a multiple of four show no border.

    The tolerance for a free corner is in steps.
    """
    if len(behind) % 4:
        return np.zeros(len(behind), bool)
    sides, clear = behind.reshape(4, -1), tolerance * step
    free_corner = (np.abs(sides.mean(axis=0)) <= clear).any()
    alike = (np.ptp(sides, axis=0) <= HALF * step).all()
    on_all_sides = (np.abs(sides) > clear).all(axis=0)
    return np.tile(on_all_sides & free_corner & alike, 4)
