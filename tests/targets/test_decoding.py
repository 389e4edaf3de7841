"""Decoding of thousands of rendered rings: no wrong code, and nearly all of the legible ones are read."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
from numba import njit

from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.targets.codes import ring_cells
from sfm.targets.codes import rings as ring_reading
from sfm.targets.codes.plates import code_family
from sfm.targets.codes.rings import CodeFamily, smallest_rotation
from sfm.targets.detect import find_targets

SUPER = 3
TILE, ACROSS = 180, 8
# Occluders: none, a straight edge, a disc, straight edges on two opposite sides.
NOTHING, HALF_PLANE, DISC, TWO_EDGES = 0, 1, 2, 3
# Least difference between an occluder and the background, in steps from background to dot.
VISIBLE = 0.15


@dataclass(frozen=True)
class Rings:
    """Rings in perspective, the last of whose cells may be covered."""

    number: IntArray  # code, (n,)
    pattern: IntArray  # bits, (n,)
    diameter: FloatArray  # largest diameter of the dot, px, (n,)
    tilt: FloatArray  # rad, (n,)
    turn: FloatArray  # of the ring in its plane, and of the axis of the tilt, rad, (n, 2)
    centre: FloatArray  # in the tile, px, (n, 2)
    levels: FloatArray  # intensity of background, dot and occluder, (n, 3)
    blur: FloatArray  # px, (n,)
    noise: FloatArray  # (n,)
    occluder: FloatArray  # kind, direction (rad), distance of its edge in radii, size in radii, (n, 4)
    spread: float = 0.0  # of the ink: how far all edges lie outwards, radii of the dot
    hole: float = 0.0  # in the middle of each dot, radii
    sharpening: float = 0.0  # by the camera: so much of what a blur of 2 px takes away is added


def random_rings(count: int, family: CodeFamily, rng: np.random.Generator) -> Rings:
    """Return rings at random, dark or bright, a tenth of them covered in part by something of any grey."""
    k = rng.integers(len(family.number), size=count)
    dark = rng.random(count) < 0.5
    low, high = rng.uniform(10, 60, count), rng.uniform(130, 230, count)
    occluder = np.zeros((count, 4))
    hidden = rng.random(count) < 0.1
    occluder[hidden, 0] = rng.integers(HALF_PLANE, DISC + 1, hidden.sum())
    occluder[:, 1] = rng.uniform(0, 2 * np.pi, count)
    occluder[:, 2] = rng.uniform(-0.5, family.outer, count)
    occluder[:, 3] = rng.uniform(0.4, 2.0, count)
    background = np.where(dark, high, low)
    # What has the grey of the background and covers whole cells makes another code, so it is another grey;
    # less than this difference is shading to the reader.
    least = VISIBLE * (high - low)
    grey = rng.uniform(5 + least, 245 - least)
    grey += np.where(grey > background, least, -least)
    return Rings(
        family.number[k],
        family.pattern[k],
        rng.uniform(6, 40, count),
        rng.uniform(0, np.radians(70), count),
        rng.uniform(0, 2 * np.pi, (count, 2)),
        TILE / 2 + rng.uniform(-1, 1, (count, 2)),
        np.column_stack([background, np.where(dark, low, high), grey]),
        rng.uniform(0.5, 0.9, count),
        rng.uniform(0.5, 4.0, count),
        occluder,
    )


def render(rings: Rings, k: int, family: CodeFamily, rng: np.random.Generator) -> AnyArray:
    """Return one tile: area sampling of the perspective picture, blur, noise, rounding."""
    tilt, (turn, axis), R = rings.tilt[k], rings.turn[k], rings.diameter[k] / 2
    # A camera 25 dot diameters away: x = R * 50 * X / (50 + Z) with the plane turned about the axis.
    c, s = math.cos(axis), math.sin(axis)
    flip = np.array([[c, -s], [s, c]])
    squeeze = np.array([[1.0, 0.0], [0.0, math.cos(tilt)]])
    affine = R * flip @ squeeze @ flip.T
    depth = math.sin(tilt) / 50 * flip[:, 1]
    H = np.zeros((3, 3))
    H[:2, :2], H[2, :2], H[2, 2] = affine + np.outer(rings.centre[k], depth), depth, 1.0
    H[:2, 2] = rings.centre[k]
    fine = _paint(
        TILE * SUPER, np.linalg.inv(H), int(rings.pattern[k]), family.cells, family.inner, family.outer,
        turn, rings.levels[k], rings.occluder[k], rings.spread, rings.hole,
    )  # fmt: skip
    soft = cv2.GaussianBlur(fine, (0, 0), rings.blur[k] * SUPER)
    picture = cv2.resize(soft, (TILE, TILE), interpolation=cv2.INTER_AREA)
    picture += rings.sharpening * (picture - cv2.GaussianBlur(picture, (0, 0), 2.0))
    return picture + rings.noise[k] * rng.standard_normal(picture.shape, dtype=np.float32)


@njit(cache=True, error_model="numpy")
def _paint(
    size: int,
    G: FloatArray,
    pattern: int,
    cells: int,
    inner: float,
    outer: float,
    turn: float,
    levels: FloatArray,
    occluder: FloatArray,
    spread: float,
    hole: float,
) -> AnyArray:
    """Paint dot, ring and occluder on a fine raster, G maps pixels to radii in the plane of the target."""
    out = np.empty((size, size), np.float32)
    nx, ny = math.cos(occluder[1]), math.sin(occluder[1])
    ox, oy = nx * (occluder[2] + occluder[3]), ny * (occluder[2] + occluder[3])
    for i in range(size):
        for j in range(size):
            x, y = (j + 0.5) / SUPER - 0.5, (i + 0.5) / SUPER - 0.5
            w = G[2, 0] * x + G[2, 1] * y + G[2, 2]
            a, b = (G[0, 0] * x + G[0, 1] * y + G[0, 2]) / w, (G[1, 0] * x + G[1, 1] * y + G[1, 2]) / w
            rho = math.hypot(a, b)
            value = levels[0]
            if hole <= rho < 1 + spread:
                value = levels[1]
            elif inner - spread < rho < outer + spread:
                at = (math.atan2(b, a) + turn + 4 * math.pi) % (2 * math.pi) / (2 * math.pi) * cells
                wide = spread / rho / (2 * math.pi) * cells
                ends = 0
                for place in (at - wide, at, at + wide):
                    ends += pattern >> (cells - 1 - int(place + cells) % cells) & 1
                if ends == 3 or (spread >= 0 and ends > 0):
                    value = levels[1]
            if (
                (occluder[0] == HALF_PLANE and a * nx + b * ny > occluder[2])
                or (occluder[0] == TWO_EDGES and abs(a * nx + b * ny) > occluder[2])
                or (occluder[0] == DISC and math.hypot(a - ox, b - oy) < occluder[3])
            ):
                value = levels[2]
            out[i, j] = value
    return out


def decode(rings: Rings, family: CodeFamily, rng: np.random.Generator) -> tuple[IntArray, IntArray]:
    """Return the code read at each ring, -1 for none, and how many codes were read elsewhere."""
    count = len(rings.number)
    read, elsewhere = np.full(count, -1), 0
    for first in range(0, count, ACROSS**2):
        part = range(first, min(first + ACROSS**2, count))
        picture = np.zeros((ACROSS * TILE, ACROSS * TILE), np.float32)
        for k in part:
            i, j = divmod(k - first, ACROSS)
            picture[i * TILE : (i + 1) * TILE, j * TILE : (j + 1) * TILE] = render(rings, k, family, rng)
        found = find_targets(np.rint(picture).clip(0, 255).astype(np.uint8), codes=family, min_diameter_px=3)
        for xy, code in zip(found.xy, found.code, strict=True):
            j, i = (xy // TILE).astype(int)
            k = first + i * ACROSS + j
            if code < 0:
                continue
            if k < count and np.hypot(*(xy - rings.centre[k] - (j * TILE, i * TILE))) < 1.5:
                read[k] = code
            else:
                elsewhere += 1
    return read, elsewhere


def legible(rings: Rings) -> BoolArray:
    """Return which rings are whole and neither tiny nor very oblique."""
    return (rings.diameter > 8) & (rings.tilt < np.radians(60)) & (rings.occluder[:, 0] == NOTHING)


def study(name: str, count: int, seed: int, least_recall: float) -> None:
    family = code_family(name)
    assert family is not None
    rng = np.random.default_rng(seed)
    rings = random_rings(count, family, rng)
    read, elsewhere = decode(rings, family, rng)
    wrong = (read >= 0) & (read != rings.number)
    recall = (read == rings.number)[legible(rings)].mean()
    print(name, count, "wrong", wrong.sum(), "elsewhere", elsewhere, "recall", recall)
    assert wrong.sum() == 0
    assert elsewhere == 0
    assert recall >= least_recall


@pytest.mark.sweep(0)
@pytest.mark.parametrize("name", ["ring12", "ring14", pytest.param("ring20", marks=pytest.mark.slow)])
def test_few_rings_are_decoded(name: str) -> None:
    study(name, 128, 1, 0.98)  # 95 are legible: one may be missed


def printed_rings(count: int, family: CodeFamily, seed: int, spread_mm: float) -> Rings:
    """Return whole dark rings around dots of 6 mm, 9 to 24 px across, as ink that runs widens them."""
    rng = np.random.default_rng(seed)
    rings = random_rings(count, family, rng)
    dark, light = rng.uniform(10, 60, count), rng.uniform(130, 230, count)
    return replace(
        rings,
        diameter=rng.uniform(9, 24, count),
        tilt=rng.uniform(0, np.radians(50), count),
        levels=np.column_stack([light, dark, light]),
        occluder=np.zeros((count, 4)),
        spread=spread_mm / 3.0,
    )


def count_read(
    name: str, count: int, seed: int, spread_mm: float, *, hole: float = 0.0, sharpening: float = 0.0
) -> tuple[int, int]:
    """Return how many printed rings are read right, and how many wrong."""
    family = code_family(name)
    assert isinstance(family, CodeFamily)
    rings = replace(printed_rings(count, family, seed, spread_mm), hole=hole, sharpening=sharpening)
    read, elsewhere = decode(rings, family, np.random.default_rng(seed))
    right = int((read == rings.number).sum())
    wrong = int((read >= 0).sum()) - right + elsewhere
    print(f"{name} {spread_mm:.2f} mm: {right} of {count} read, {wrong} wrong")
    return right, wrong


@pytest.mark.parametrize("spread_mm", [-0.3, 0.4])
def test_ink_and_light_that_spread_are_read(spread_mm: float) -> None:
    right, wrong = count_read("ring14", 64, 5, spread_mm)
    assert right >= 63 and wrong == 0


def test_dots_with_a_hole_are_read_from_a_sharpened_photograph() -> None:
    right, wrong = count_read("necklace12", 64, 8, -0.2, hole=0.25, sharpening=1.5)
    assert right >= 60 and wrong == 0


def oblique_ring(bits: str, glow_px: float) -> AnyArray:
    """Return a bright ring seen at 70 degrees in a square border, all edges outwards by so many px."""
    cells = 4  # per px
    y, x = (np.mgrid[: cells * 170, : cells * 110] + 0.5) / cells - 0.5
    a, b = (x - 55.2) / 6.0, (y - 84.7) / 18.0
    rho, at = np.hypot(a, b), (np.arctan2(b, a) % (2 * np.pi)) / (2 * np.pi) * len(bits)
    set_cell = np.array([bit == "1" for bit in bits])[at.astype(int) % len(bits)]
    side = np.maximum(np.abs(a), np.abs(b))
    white = (rho < 1) | ((rho > 2) & (rho < 3) & set_cell) | ((side > 3.25) & (side < 4))
    reach = 2 * round(cells * glow_px) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))
    fine = cv2.dilate(white.astype(np.float32), disc)
    soft = cv2.resize(cv2.GaussianBlur(fine, (0, 0), 0.6 * cells), (110, 170), interpolation=cv2.INTER_AREA)
    noise = np.random.default_rng(9).normal(0, 2, soft.shape)
    return np.rint(70 + 160 * soft + noise).clip(0, 255).astype(np.uint8)


def number_of(bits: str) -> int:
    """Return the number of a ring of the family of all necklaces of 12 cells."""
    family = code_family("necklace12")
    assert isinstance(family, CodeFamily)
    value = smallest_rotation(np.array([int(bits, 2)]), len(bits))[0]
    return int(family.number[np.searchsorted(family.pattern, value)])


def test_light_that_spreads_about_oblique_rings_is_no_ink() -> None:
    """In px it is alike in all directions; a border behind the ring is about the whole of it."""
    for bits in ("110000110000", "101001101001", "110111110000"):
        found = find_targets(oblique_ring(bits, 0.8), polarity="bright", codes="necklace12")
        assert [int(code) for code in found.code if code >= 0] == [number_of(bits)]


def test_glow_is_bounded_by_the_size_of_the_dot_and_in_px() -> None:
    for long, short, bound in ((12.0, 4.0, 1.0), (30.0, 30.0, 1.5)):
        shape = np.array([1 / short, 0.0, 1 / long])
        assert ring_cells._largest_glow(shape) == pytest.approx(bound)


def test_a_border_is_on_all_four_sides_of_a_ring() -> None:
    def find(behind: list[float], step: float = 1.0) -> list[int]:
        return np.flatnonzero(ring_reading._find_border(np.array(behind), step)).tolist()

    behind = [0.8, 0.0, 0.7, -0.1, 0.4, 0.2, 0.9, 0.0]
    assert find(behind) == [0, 2, 4, 6]
    assert find(behind, 0.9) == []  # 0.5 is more than half of 0.9
    assert find([*behind, 0.7, 0.0]) == []
    for level in (0.4, 1.0):
        assert find([0, 0, level, level, 0, 0, level, level]) == []
        assert find([level, 0, level, 0, level, 0, 0, 0]) == []


def test_the_stroke_of_a_letter_is_no_border() -> None:
    """It has no free corners."""
    assert not ring_reading._find_border(np.full(8, 0.8), 1.0).any()


def cut_rings(count: int, family: CodeFamily, seed: int) -> Rings:
    """Return rings in a strip that is narrower than they are, on what has the grey of their dots."""
    rng = np.random.default_rng(seed)
    rings = random_rings(count, family, rng)
    kind, across = np.full(count, TWO_EDGES), rng.uniform(0, 2 * np.pi, count)
    half_width = rng.uniform(0.9 * family.inner, family.outer, count)
    levels = rings.levels[:, [0, 1, 1]]
    return replace(
        rings,
        diameter=rng.uniform(10, 30, count),
        tilt=rng.uniform(0, np.radians(40), count),
        levels=levels,
        occluder=np.column_stack([kind, across, half_width, np.zeros(count)]),
    )


@pytest.mark.parametrize("name", [pytest.param("ring12", marks=pytest.mark.slow), "ring14"])
def test_rings_that_are_cut_on_two_sides_are_not_read_wrong(name: str) -> None:
    family = code_family(name)
    assert isinstance(family, CodeFamily)
    rings = cut_rings(128, family, 7)
    read, elsewhere = decode(rings, family, np.random.default_rng(7))
    assert not ((read >= 0) & (read != rings.number)).any()
    assert elsewhere == 0


@pytest.mark.slow
@pytest.mark.parametrize("spread_mm", [-0.3, -0.15, 0.0, 0.15, 0.2, 0.25, 0.3, 0.4])
@pytest.mark.parametrize("name", ["ring12", "ring14", "ring20"])
def test_319_rings_of_a_printer_are_read(name: str, spread_mm: float) -> None:
    right, wrong = count_read(name, 319, 6, spread_mm)
    assert right >= 300 and wrong == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ring12", "ring14", "ring20"])
def test_ten_thousand_rings_are_decoded(name: str) -> None:
    study(name, 10_000, 2, 0.995)
