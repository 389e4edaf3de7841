"""Truth of the sigma of dots that are no perfect circles: polygons, JPEG, sharpening, rough edges, damage.

    python -m tests.targets.shapes [CLASS ...]

prints for each class how many dots are found, the RMS of the errors of their centres in px and in stated
standard deviations (1 where these are true), the share flagged as damaged, and the share with a target more
than half a pixel from the centre. In the classes of damage every fourth dot of a photograph is damaged; the
intact ones of the same photographs have a line of their own.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from typing import NamedTuple

import cv2
import numpy as np

from sfm.model.conventions import AnyArray, BoolArray, FloatArray
from sfm.targets.detect import find_targets
from sfm.targets.outlines import Flag
from tests.synthetic import seed_of

# Fine cells per px, their coverage is exact; corners of the polygon that stands for a circle.
SUPER, CORNERS = 4, 720
PAPER, INK = 200.0, 45.0
# Radius in px and dots per side of a photograph.
SIZES = ((3.0, 10), (6.0, 8), (14.0, 6), (25.0, 5), (60.0, 4))
DAMAGED_EVERY = 4
FAR_PX = 0.5

Outline = Callable[[FloatArray, np.random.Generator], FloatArray]


def polygon_coverage(corners: FloatArray, height: int, width: int) -> FloatArray:
    """Return the exact share of each unit cell inside a polygon; cell (0, 0) spans 0 to 1 in x and y.

    Every edge is cut at the grid lines; a piece dy high covers all cells of its row to its right by dy and
    the one it lies in by the trapezium to the right of it.
    """
    start, end = corners, np.roll(corners, -1, axis=0)
    low, high = np.minimum(start, end), np.maximum(start, end)
    every = np.arange(len(corners))
    edge, t = [every, every], [np.zeros(len(corners)), np.ones(len(corners))]
    for axis in range(2):
        first = np.floor(low[:, axis]) + 1
        count = np.maximum(np.ceil(high[:, axis]) - first, 0).astype(int)
        of = np.repeat(every, count)
        line = first[of] + np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count)
        edge.append(of)
        t.append((line - start[of, axis]) / (end - start)[of, axis])
    of, cut = np.concatenate(edge), np.concatenate(t)
    order = np.lexsort((cut, of))
    of, cut = of[order], cut[order]
    points = start[of] + cut[:, None] * (end - start)[of]
    x0, y0, x1, y1 = np.concatenate([points[:-1], points[1:]], axis=1)[of[:-1] == of[1:]].T
    middle, dy = (x0 + x1) / 2, y1 - y0
    column = np.clip(np.floor(middle).astype(int), 0, width - 1)
    row = np.floor((y0 + y1) / 2).astype(int)
    inside = (row >= 0) & (row < height)
    column, row, middle, dy = column[inside], row[inside], middle[inside], dy[inside]
    share = 1 - np.clip(middle - column, 0, 1)
    cover = np.zeros((height, width + 1))
    np.add.at(cover, (row, column), dy * share)
    np.add.at(cover, (row, column + 1), dy * (1 - share))
    return np.abs(np.cumsum(cover, axis=1)[:, :width])


def circle(phi: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return the radius of a circle of unit area over pi in the directions phi."""
    return np.ones_like(phi)


def regular(corners: int) -> Outline:
    """Return the outline of regular polygons in one orientation."""

    def radius(phi: FloatArray, rng: np.random.Generator) -> FloatArray:
        sector = 2 * math.pi / corners
        return math.cos(sector / 2) / np.cos((phi - 0.1) % sector - sector / 2)

    return radius


def rough(amplitude: float, power: float) -> Outline:
    """Return the outline of circles with random harmonics of amplitude / k^power radii each."""

    def radius(phi: FloatArray, rng: np.random.Generator) -> FloatArray:
        k = np.arange(1, 25)
        a = amplitude * rng.standard_normal((2, len(k))) / k**power
        angles = k[:, None] * phi
        return 1 + a[0] @ np.cos(angles) + a[1] @ np.sin(angles)

    return radius


def paint(ink: FloatArray, corners: FloatArray, level: float) -> None:
    """Cover a part of the fine picture of the ink with another level."""
    share = polygon_coverage(corners, *ink.shape)
    ink[:] = ink * (1 - share) + level * share


def bow(centre: FloatArray, inner: float, outer: float, begin: float, end: float) -> FloatArray:
    """Return the corners of a sector of a ring."""
    phi = np.linspace(begin, end, 60)
    rays = np.stack([np.cos(phi), np.sin(phi)], axis=1)
    return centre + np.concatenate([outer * rays, inner * rays[::-1]])


def no_damage(ink: FloatArray, centre: FloatArray, R: float, rng: np.random.Generator) -> None:
    """Leave a dot as it is."""


def nick(ink: FloatArray, centre: FloatArray, R: float, rng: np.random.Generator) -> None:
    """Take 2 to 20 % of the edge away."""
    half = math.pi * rng.uniform(0.02, 0.2)
    begin = rng.uniform(0, 2 * math.pi)
    paint(ink, bow(centre, R * rng.uniform(0.4, 0.85), 1.2 * R, begin - half, begin + half), 0.0)


def occlusion(ink: FloatArray, centre: FloatArray, R: float, rng: np.random.Generator) -> None:
    """Cover 2 to 20 % of the circumference by something straight of a third level."""
    half, turn = math.pi * rng.uniform(0.02, 0.2), rng.uniform(0, 2 * math.pi)
    out = np.array([math.cos(turn), math.sin(turn)])
    side = np.array([-out[1], out[0]])
    near, far = centre + R * math.cos(half) * out, centre + (R + 16 * SUPER) * out
    wide = 2 * R + 16 * SUPER
    paint(ink, np.stack([near + wide * side, far + wide * side, far - wide * side, near - wide * side]), 0.6)


def scratch(ink: FloatArray, centre: FloatArray, R: float, rng: np.random.Generator) -> None:
    """Scratch through the whole dot, 0.5 to 2.5 px wide."""
    turn, half = rng.uniform(0, 2 * math.pi), SUPER * rng.uniform(0.25, 1.25)
    out = np.array([math.cos(turn), math.sin(turn)])
    along = np.array([-out[1], out[0]])
    middle = centre + rng.uniform(-0.9, 0.9) * R * out
    far = 1.3 * R * along
    corners = [
        middle + far + half * out,
        middle - far + half * out,
        middle - far - half * out,
        middle + far - half * out,
    ]
    paint(ink, np.stack(corners), 0.0)


def stain(ink: FloatArray, centre: FloatArray, R: float, rng: np.random.Generator) -> None:
    """Put a pale round stain into the dot, or over its edge."""
    size, turn = R * rng.uniform(0.25, 0.7), rng.uniform(0, 2 * math.pi)
    away = rng.uniform(0.02, 0.9) * R
    middle = centre + away * np.array([math.cos(turn), math.sin(turn)])
    phi = np.linspace(0, 2 * math.pi, 90, endpoint=False)
    corners = middle + size * np.stack([np.cos(phi), np.sin(phi)], axis=1)
    paint(ink, corners, rng.uniform(0.0, 0.5))


class Kind(NamedTuple):
    """A class of dots."""

    outline: Outline = circle
    damage: Callable[[FloatArray, FloatArray, float, np.random.Generator], None] = no_damage
    quality: int = 0  # of JPEG, 0 without
    sharpening: float = 0.0  # amount of unsharp mask


KINDS = {
    "circle": Kind(),
    "12-gon": Kind(regular(12)),
    "24-gon": Kind(regular(24)),
    "JPEG 60": Kind(quality=60),
    "JPEG 75": Kind(quality=75),
    "JPEG 85": Kind(quality=85),
    "JPEG 95": Kind(quality=95),
    "sharpened": Kind(sharpening=1.0),
    "sharpened 12-gon": Kind(regular(12), sharpening=1.0),
    "rough, flat": Kind(rough(0.002, 0.0)),
    "rough, 1/k": Kind(rough(0.005, 1.0)),
    "nick": Kind(damage=nick),
    "nick, JPEG 85": Kind(damage=nick, quality=85),
    "nick, 12-gon": Kind(regular(12), damage=nick),
    "occlusion": Kind(damage=occlusion),
    "scratch": Kind(damage=scratch),
    "stain": Kind(damage=stain),
}


class Dots(NamedTuple):
    """Dots of a photograph."""

    image: AnyArray
    truth: FloatArray
    """centres, px, (k, 2)"""
    damaged: BoolArray
    """which dots are damaged, (k,)"""
    radius: float
    """mean radius, px"""


def draw_photograph(
    kind: Kind, radius: float, side: int, blur: float, noise: float, rng: np.random.Generator
) -> Dots:
    """Draw side x side dots of one kind, which are alike but for the size (5 %), and damage every fourth."""
    tile = 2 * math.ceil(1.1 * radius + 3 * blur + 9)
    picture = np.empty((side * tile, side * tile), np.float32)
    phi = np.linspace(0, 2 * math.pi, CORNERS, endpoint=False)
    truth, damaged = [], []
    for k in range(side * side):
        R = radius * rng.uniform(0.95, 1.05)
        centre = tile / 2 - 0.5 + rng.uniform(-0.5, 0.5, 2)
        fine = SUPER * (centre + 0.5)
        rays = np.stack([np.cos(phi), np.sin(phi)], axis=1)
        ink = polygon_coverage(
            fine + SUPER * R * kind.outline(phi, rng)[:, None] * rays, tile * SUPER, tile * SUPER
        )
        damaged.append(kind.damage is not no_damage and k % DAMAGED_EVERY == 0)
        if damaged[-1]:
            kind.damage(ink, fine, SUPER * R, rng)
        soft = cv2.GaussianBlur((PAPER + (INK - PAPER) * ink).astype(np.float32), (0, 0), blur * SUPER)
        row, column = divmod(k, side)
        picture[row * tile :, column * tile :][:tile, :tile] = cv2.resize(
            soft, (tile, tile), interpolation=cv2.INTER_AREA
        )
        truth.append(centre + np.array([column, row]) * tile)
    picture += noise * rng.standard_normal(picture.shape, dtype=np.float32)
    if kind.sharpening:
        picture += kind.sharpening * (picture - cv2.GaussianBlur(picture, (0, 0), 1.0))
    image = np.rint(picture).clip(0, 255).astype(np.uint8)
    if kind.quality:
        image = cv2.imdecode(
            cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, kind.quality])[1], cv2.IMREAD_GRAYSCALE
        )
    return Dots(image, np.array(truth), np.array(damaged), radius)


def draw_photographs(name: str, sizes: tuple[tuple[float, int], ...] = SIZES) -> Iterator[Dots]:
    """Draw photographs of one class, of several sizes, blurs of 0.5 to 3 px and noises of 1 to 5."""
    rng = seed_of(f"shapes {name}")
    for radius, side in sizes:
        for blur, noise in ((0.5, 1.0), (0.8, 2.0), (1.3, 5.0), (3.0, 2.0)):
            if blur < 0.3 * radius:
                yield draw_photograph(KINDS[name], radius, side, blur, noise, rng)


class Measured(NamedTuple):
    """What was measured of k dots."""

    error: FloatArray
    """of the nearest target within the dot, px, nan where there is none, (k, 2)"""
    normalised: FloatArray
    """in standard deviations, (k, 2)"""
    flagged: BoolArray
    """as damaged, (k,)"""
    far: BoolArray
    """some target in the dot is more than half a pixel from its centre, (k,)"""


def measure(dots: Dots) -> Measured:
    """Measure a photograph and compare it with the truth."""
    found = find_targets(dots.image)
    k = len(dots.truth)
    error, normalised = np.full((k, 2), np.nan), np.full((k, 2), np.nan)
    flagged, far = np.zeros(k, bool), np.zeros(k, bool)
    for i, xy in enumerate(dots.truth):
        distance = np.hypot(*(found.xy - xy).T)
        far[i] = ((distance > FAR_PX) & (distance < dots.radius)).any()
        if len(distance) and distance.min() < dots.radius:
            j = int(distance.argmin())
            error[i] = found.xy[j] - xy
            normalised[i] = np.linalg.solve(np.linalg.cholesky(found.covariance[j]), error[i])
            flagged[i] = bool(found.flag[j] & Flag.DAMAGED)
    return Measured(error, normalised, flagged, far)


def measure_class(
    name: str, sizes: tuple[tuple[float, int], ...] = SIZES
) -> tuple[Measured, BoolArray, FloatArray]:
    """Measure all photographs of a class; return also which dots are damaged, and their radii."""
    parts = [(measure(dots), dots) for dots in draw_photographs(name, sizes)]
    joined = Measured(*(np.concatenate(one) for one in zip(*(m for m, _ in parts), strict=True)))
    damaged = np.concatenate([d.damaged for _, d in parts])
    return joined, damaged, np.concatenate([np.full(len(d.truth), d.radius) for _, d in parts])


def over_stated(measured: Measured, of: BoolArray) -> float:
    """Return the RMS of the normalised errors of some of the dots."""
    normalised = measured.normalised[of]
    return float(np.sqrt(np.nanmean(normalised**2))) if np.isfinite(normalised).any() else math.nan


def main() -> None:
    """Print the table."""
    print(
        f"{'class':26} {'dots':>5} {'found':>7} {'RMS px':>8} {'over stated':>11} {'flagged':>8} {'far':>7}"
    )
    for name in sys.argv[1:] or KINDS:
        measured, damaged, radius = measure_class(name)
        groups = [("", ~damaged)] if not damaged.any() else [("", damaged), (", intact", ~damaged)]
        rows = [(name + part, of) for part, of in groups]
        rows += [(f"{name}, r {r:.0f}", groups[0][1] & (radius == r)) for r in np.unique(radius)]
        for title, of in rows:
            seen = np.isfinite(measured.error[of, 0])
            rms = np.sqrt(np.nanmean(measured.error[of] ** 2)) if seen.any() else math.nan
            print(
                f"{title:26} {of.sum():5} {100 * seen.mean():6.1f}% {rms:8.4f}"
                f" {over_stated(measured, of):11.2f} {100 * measured.flagged[of].mean():7.2f}%"
                f" {100 * measured.far[of].mean():6.2f}%",
                flush=True,
            )


if __name__ == "__main__":
    main()
