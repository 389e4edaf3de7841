"""Area sampling of marks on planes: the fraction of a photograph's cell that a disc, arc or rectangle covers.

This is the compiled part of `render`. A cell is one of n^2 parts of a pixel. Plane coordinates are linear
within a cell to second order. The edge of a mark is taken as straight in each of PARTS^2 parts of a cell.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sfm.model.conventions import AnyArray, FloatArray, IntArray
from sfm.products.rendering.scene import ARC, DISC, RECTANGLE
from sfm.runtime.compiling import compiled

# An edge counts as straight within 1 / PARTS of a cell; an arc of 4 px radius deviates by 1e-3 px there.
PARTS = 3


class Cell(NamedTuple):
    """A cell of the photograph on the plane of a face, object unit; zeros behind the camera."""

    a: float
    """plane coordinates of its centre"""
    b: float
    a_column: float
    """steps of the plane coordinates to the next cell in the row"""
    b_column: float
    a_row: float
    """steps of the plane coordinates to the next cell in the column"""
    b_row: float


class Lamp(NamedTuple):
    """The light over a face."""

    a: float
    """plane coordinates of the lamp, object unit"""
    b: float
    height: float
    """above the plane, object unit"""
    reach2: float
    """squared distance at which the lamp gives strength 1, 0 without a lamp"""
    ambient: float
    """light from all directions"""


class Ends(NamedTuple):
    """Directions of the ends of an arc, or of the sides of a rectangle (the first)."""

    cos_start: float
    sin_start: float
    cos_end: float
    sin_end: float


@compiled
def fill_face(
    value: AnyArray,
    cover: AnyArray,
    box: IntArray,
    rays: FloatArray,
    H: FloatArray,
    rectangle: FloatArray,
    mean: float,
    amplitude: float,
    grain: float,
    seed: int,
    lamp: Lamp,
    n: int,
) -> None:
    """Fill value and cover of the cells of a face: its lit texture, and the fraction of each cell inside it.

    Light and texture are computed once per pixel; only pixels at the edge of the face are divided into cells.

    Args:
        value: receives the intensities, (rows, columns) of the box.
        cover: receives the fractions inside the face, 0 to 1, of the same shape.
        box: first and last row and column of the cells of the face, in whole pixels, (4,).
        rays: tangents at the corners of the pixels, (height + 1, width + 1, 2).
        H: plane coordinates from rays, (3, 3).
        rectangle: the face as the shape of a mark, (4,).
        mean: reflectance of the face.
        amplitude: amplitude of its texture.
        grain: size of a grain of the texture, object unit.
        seed: seed of the texture.
        lamp: the light.
        n: cells along a pixel.
    """
    ends = ends_of(rectangle)
    for y in range(box[0] // n, box[1] // n):
        for x in range(box[2] // n, box[3] // n):
            i, j = y * n - box[0], x * n - box[2]
            ahead, cell = on_plane(rays, H, y, x, 0.5, 0.5, 1.0)
            inside = area_inside(RECTANGLE, cell, 0.0, 0.0, rectangle, ends) if ahead else 0.0
            shade = 0.0
            if inside > 0:
                texture = 0.0
                if amplitude > 0:
                    texture = amplitude * smooth_noise(cell.a / grain, cell.b / grain, seed)
                shade = (mean + texture) * light_on(cell.a, cell.b, lamp)
            for r in range(n):
                for c in range(n):
                    value[i + r, j + c] = shade
                    cover[i + r, j + c] = inside
                    if 0 < inside < 1:
                        ahead, cell = on_plane(rays, H, y, x, (c + 0.5) / n, (r + 0.5) / n, 1.0 / n)
                        cover[i + r, j + c] = (
                            area_inside(RECTANGLE, cell, 0.0, 0.0, rectangle, ends) if ahead else 0.0
                        )


@compiled
def paint_mark(
    value: AnyArray,
    box: IntArray,
    part: IntArray,
    rays: FloatArray,
    H: FloatArray,
    kind: int,
    centre: FloatArray,
    shape: FloatArray,
    mark: float,
    lamp: Lamp,
    n: int,
) -> None:
    """Blend a lit mark into the cells of its face by the area that it covers in each.

    Args:
        value: intensities of the cells of the face.
        box: first and last row and column of these cells, (4,).
        part: first and last row and column of the cells around the mark, (4,).
        rays: tangents at the corners of the pixels, (height + 1, width + 1, 2).
        H: plane coordinates from rays, (3, 3).
        kind: DISC, ARC or RECTANGLE.
        centre: plane coordinates of the mark, object unit, (2,).
        shape: see `Marks`, (4,).
        mark: reflectance of the mark.
        lamp: the light.
        n: cells along a pixel.
    """
    ends = ends_of(shape)
    for row in range(part[0], part[1]):
        y = row // n
        fy = (row - y * n + 0.5) / n
        for column in range(part[2], part[3]):
            x = column // n
            ahead, cell = on_plane(rays, H, y, x, (column - x * n + 0.5) / n, fy, 1.0 / n)
            area = area_inside(kind, cell, centre[0], centre[1], shape, ends) if ahead else 0.0
            if area > 0:
                i, j = row - box[0], column - box[2]
                value[i, j] += area * (mark * light_on(cell.a, cell.b, lamp) - value[i, j])


@compiled
def cover_with(fine: AnyArray, box: IntArray, value: AnyArray, cover: AnyArray) -> None:
    """Blend a face into the cells of a photograph by the fraction of each that it covers.

    Args:
        fine: intensities of all cells.
        box: first and last row and column of the cells of the face, (4,).
        value: intensities of the face, (rows, columns) of the box.
        cover: fractions inside the face, 0 to 1, of the same shape.
    """
    for i in range(value.shape[0]):
        for j in range(value.shape[1]):
            if cover[i, j] > 0:
                below = fine[box[0] + i, box[2] + j]
                fine[box[0] + i, box[2] + j] = below + cover[i, j] * (value[i, j] - below)


@compiled
def light_on(a: float, b: float, lamp: Lamp) -> float:
    """Return the light at a point of a face: ambient, and a lamp by the cosine and inverse square laws."""
    d2 = (a - lamp.a) ** 2 + (b - lamp.b) ** 2 + lamp.height**2
    return lamp.ambient + max(lamp.height, 0.0) / math.sqrt(d2) * lamp.reach2 / d2


@compiled
def on_plane(
    rays: FloatArray, H: FloatArray, y: int, x: int, fx: float, fy: float, step: float
) -> tuple[bool, Cell]:
    """Project a position in pixel (x, y) onto the plane of a face.

    Args:
        rays: tangents at the corners of the pixels, (height + 1, width + 1, 2).
        H: plane coordinates from rays, (3, 3).
        y: row of the pixel.
        x: column of the pixel.
        fx: position in the pixel from its left edge, 0 to 1.
        fy: position in the pixel from its upper edge, 0 to 1.
        step: width of a cell, px.

    Returns:
        Whether the plane is in front of the camera, and the cell on it.
    """
    u, uc, ur = interpolate(
        rays[y, x, 0], rays[y, x + 1, 0], rays[y + 1, x, 0], rays[y + 1, x + 1, 0], fx, fy, step
    )
    v, vc, vr = interpolate(
        rays[y, x, 1], rays[y, x + 1, 1], rays[y + 1, x, 1], rays[y + 1, x + 1, 1], fx, fy, step
    )
    w = H[2, 0] * u + H[2, 1] * v - H[2, 2]
    if w >= 0:
        return False, Cell(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    down = 1.0 / w
    wc, wr = H[2, 0] * uc + H[2, 1] * vc, H[2, 0] * ur + H[2, 1] * vr
    a = (H[0, 0] * u + H[0, 1] * v - H[0, 2]) * down
    b = (H[1, 0] * u + H[1, 1] * v - H[1, 2]) * down
    ac = (H[0, 0] * uc + H[0, 1] * vc - a * wc) * down
    bc = (H[1, 0] * uc + H[1, 1] * vc - b * wc) * down
    ar = (H[0, 0] * ur + H[0, 1] * vr - a * wr) * down
    br = (H[1, 0] * ur + H[1, 1] * vr - b * wr) * down
    return True, Cell(a, b, ac, bc, ar, br)


@compiled
def interpolate(
    top_left: float,
    top_right: float,
    bottom_left: float,
    bottom_right: float,
    fx: float,
    fy: float,
    step: float,
) -> tuple[float, float, float]:
    """Return the bilinear value in a pixel, and its change to the next cell along columns and rows."""
    top = top_left + fx * (top_right - top_left)
    bottom = bottom_left + fx * (bottom_right - bottom_left)
    across = (1 - fy) * (top_right - top_left) + fy * (bottom_right - bottom_left)
    return top + fy * (bottom - top), across * step, (bottom - top) * step


@compiled
def area_inside(kind: int, cell: Cell, a0: float, b0: float, shape: FloatArray, ends: Ends) -> float:
    """Return the fraction of a cell inside a mark, exact for edges that are straight in PARTS^2 parts."""
    a, b = cell.a - a0, cell.b - b0
    f, fa, fb = distance_inside(kind, a, b, shape, ends)
    gc, gr = fa * cell.a_column + fb * cell.b_column, fa * cell.a_row + fb * cell.b_row
    if abs(f) > abs(gc) + abs(gr):  # the edge is beyond the corners of the cell
        return 1.0 if f > 0 else 0.0
    area = 0.0
    for i in range(PARTS):
        for j in range(PARTS):
            dr, dc = (i + 0.5) / PARTS - 0.5, (j + 0.5) / PARTS - 0.5
            a_part = a + dc * cell.a_column + dr * cell.a_row
            b_part = b + dc * cell.b_column + dr * cell.b_row
            f, fa, fb = distance_inside(kind, a_part, b_part, shape, ends)
            gc, gr = fa * cell.a_column + fb * cell.b_column, fa * cell.a_row + fb * cell.b_row
            area += half_plane(f, gc, gr, 1.0 / PARTS)
    return area / PARTS**2


@compiled
def half_plane(f: float, gx: float, gy: float, side: float) -> float:
    """Return the fraction of a square where f + gx x + gy y > 0, with x and y from its centre."""
    gx, gy = abs(gx) * side, abs(gy) * side
    if gx + gy < 1e-300:
        return 1.0 if f > 0 else 0.0
    # Distance from the corner that is farthest on the negative side, in the unit of f.
    low, high = min(gx, gy), max(gx, gy)
    t = f + 0.5 * (gx + gy)
    if t <= 0:
        return 0.0
    if t >= gx + gy:
        return 1.0
    if low < 1e-12 * high:
        return t / high
    if t < low:
        return t * t / (2 * low * high)
    if t <= high:
        return (t - 0.5 * low) / high
    rest = gx + gy - t
    return 1.0 - rest * rest / (2 * low * high)


@compiled
def ends_of(shape: FloatArray) -> Ends:
    """Return the directions of the ends of an arc or of a rectangle, whose angles are the last two values."""
    start, end = shape[2], shape[2] + shape[3]
    return Ends(math.cos(start), math.sin(start), math.cos(end), math.sin(end))


@compiled
def distance_inside(
    kind: int, a: float, b: float, shape: FloatArray, ends: Ends
) -> tuple[float, float, float]:
    """Return the distance inside a mark, object unit, at plane coordinates from its centre; its gradient."""
    if kind == DISC:
        radius = math.sqrt(a * a + b * b)
        if radius == 0.0:
            return shape[0], 1.0, 0.0
        return shape[0] - radius, -a / radius, -b / radius
    if kind == ARC:
        radius = max(math.sqrt(a * a + b * b), 1e-300)
        f, fa, fb = radius - shape[0], a / radius, b / radius
        if shape[1] - radius < f:
            f, fa, fb = shape[1] - radius, -a / radius, -b / radius
        # Distances from the lines of both ends; an arc of more than half a circle is the union of both sides.
        from_start = -ends.sin_start * a + ends.cos_start * b
        from_end = ends.sin_end * a - ends.cos_end * b
        first = from_start < from_end
        if shape[3] > math.pi:
            first = not first
        if first:
            side, sa, sb = from_start, -ends.sin_start, ends.cos_start
        else:
            side, sa, sb = from_end, ends.sin_end, -ends.cos_end
        if side < f:
            f, fa, fb = side, sa, sb
        return f, fa, fb
    cos, sin = ends.cos_start, ends.sin_start
    x, y = cos * a + sin * b, -sin * a + cos * b
    fx, fy = shape[0] - abs(x), shape[1] - abs(y)
    if fx < fy:
        sign = -1.0 if x > 0 else 1.0
        return fx, sign * cos, sign * sin
    sign = -1.0 if y > 0 else 1.0
    return fy, -sign * sin, sign * cos


@compiled
def smooth_noise(x: float, y: float, seed: int) -> float:
    """Return noise of about +-1 that changes smoothly over a unit and is reproducible at each position.

    Source: value noise after Perlin (1985), Computer Graphics 19(3), on a lattice of hashed values.
    """
    i, j = math.floor(x), math.floor(y)
    fx, fy = x - i, y - j
    fx, fy = fx * fx * (3 - 2 * fx), fy * fy * (3 - 2 * fy)
    top = lattice(i, j, seed) * (1 - fx) + lattice(i + 1, j, seed) * fx
    bottom = lattice(i, j + 1, seed) * (1 - fx) + lattice(i + 1, j + 1, seed) * fx
    return top * (1 - fy) + bottom * fy


@compiled
def lattice(i: int, j: int, seed: int) -> float:
    """Return the value of a lattice point, between -1 and 1.

    Source: finaliser of MurmurHash3 (Appleby 2011), 32 bit.
    """
    h = (int(i) * 73856093 ^ int(j) * 19349663 ^ int(seed) * 83492791) & 0xFFFFFFFF
    h ^= h >> 16
    h = (h * 0x85EBCA6B) & 0xFFFFFFFF
    h ^= h >> 13
    h = (h * 0xC2B2AE35) & 0xFFFFFFFF
    h ^= h >> 16
    return h / 2147483648.0 - 1.0
