"""Photographs to mark: rendered features with known places, and a survey of three photographs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from sfm.model.camera import Camera, camera_from_values, project
from sfm.model.conventions import AnyArray, FloatArray
from sfm.model.network import ImagePoints, Network

OVERSAMPLING, SIDE = 8, 121
Pattern = Callable[[AnyArray, AnyArray], AnyArray]


def rendered(pattern: Pattern, rng: np.random.Generator, *, noise: float = 2.0) -> AnyArray:
    """Return a photograph of a pattern, which is 0 or 1 at (x, y) px, blurred and with noise, uint8."""
    fine = OVERSAMPLING
    at = (np.arange(SIDE * fine) + 0.5) / fine - 0.5
    sharp = pattern(at[None], at[:, None]).astype(np.float32)
    blurred = cv2.GaussianBlur(sharp, (0, 0), 0.8 * fine)
    pixels = np.asarray(cv2.resize(blurred, (SIDE, SIDE), interpolation=cv2.INTER_AREA))
    grey = np.clip(np.rint(40 + 170 * pixels + rng.normal(0, noise, pixels.shape)), 0, 255).astype(np.uint8)
    return 255 - grey if rng.random() < 0.5 else grey


def turned(
    x: AnyArray, y: AnyArray, centre: FloatArray, angle: float, shear: float
) -> tuple[AnyArray, AnyArray]:
    """Return the coordinates of a turned and sheared pattern at columns x, (1, w), and rows y, (h, 1)."""
    u, v = x - centre[0], y - centre[1]
    c, s = np.cos(angle), np.sin(angle)
    return (c - shear * s) * u + (s + shear * c) * v, c * v - s * u


def pattern_of(kind: str, centre: FloatArray, rng: np.random.Generator) -> Pattern:
    """Return a target, saddle, corner or cross at a place, turned and sheared, of a random size."""
    angle, shear, r = rng.uniform(0, 2 * np.pi), rng.uniform(-0.4, 0.4), rng.uniform(6, 14)

    def pattern(x: AnyArray, y: AnyArray) -> AnyArray:
        u, v = turned(x, y, centre, angle, shear)
        if kind == "target":
            return u * u + v * v < r * r
        if kind == "saddle":
            return (np.floor(u / (2 * r)) + np.floor(v / (2 * r))) % 2 == 0
        if kind == "corner":
            return (u > 0) & (v > 0)
        w = r / 4
        return ((abs(u) < w) & (abs(v) < 2 * r)) | ((abs(v) < w) & (abs(u) < 2 * r))

    return pattern


def click_beside(centre: FloatArray, rng: np.random.Generator, away_px: float = 5.0) -> FloatArray:
    turn = rng.uniform(0, 2 * np.pi)
    return np.asarray(centre + away_px * np.array([np.cos(turn), np.sin(turn)]))


def looking_at_origin(place: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return R of a camera that looks at the origin, with a small roll."""
    z = place / np.linalg.norm(place)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    c, s = np.cos(roll := rng.uniform(-0.3, 0.3)), np.sin(roll)
    axes = np.column_stack([x, np.cross(z, x), z])
    return np.asarray(axes @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]))


LENS: Camera = camera_from_values(
    "lens", "brown", (3000, 2000), (0.004, 0.004), c_mm=9.0, free=("c", "x0", "y0", "K1")
)


def stations(
    rng: np.random.Generator, count: int, *, around: float = 2 * np.pi
) -> tuple[FloatArray, FloatArray]:
    """Return places (m, 3) and rotations (m, 3, 3) of photographs around an object of two units."""
    turn = rng.uniform(0, 2 * np.pi) + around * np.arange(count) / count + rng.uniform(-0.15, 0.15, count)
    places = np.column_stack([2.5 * np.cos(turn), 2.5 * np.sin(turn), rng.uniform(1.4, 2.4, count)])
    return places, np.array([looking_at_origin(place, rng) for place in places])


def seen_points(places: FloatArray, rotations: FloatArray, points: FloatArray) -> FloatArray:
    """Return the places of points in photographs, px, (m, n, 2)."""
    return np.array([project(LENS, X0, R, points) for X0, R in zip(places, rotations, strict=True)])


def network_of_points(xy: FloatArray, marked: AnyArray, sigma_px: float) -> Network:
    """Return the network of the marked places, (m, n, 2) and (m, n)."""
    image, point = np.nonzero(marked)
    covariance = np.tile(sigma_px**2 * np.eye(2), (len(image), 1, 1))
    return Network(
        tuple(f"i{k}.png" for k in range(len(xy))),
        np.zeros(len(xy), dtype=np.int64),
        tuple(f"p{j}" for j in range(xy.shape[1])),
        ImagePoints(image, point, xy[image, point], covariance),
    )


def write_photographs(
    folder: Path, rng: np.random.Generator, *, count: int = 3, points: int = 9
) -> FloatArray:
    """Write photographs of dots on a flat board, and return the places of the dots, px, (m, n, 2)."""
    board = np.array([[-0.6 + 0.6 * (k % 3), -0.6 + 0.6 * (k // 3), 0.15 * (k % 2)] for k in range(points)])
    places, rotations = stations(rng, count, around=1.2)
    xy = seen_points(places, rotations, board) / 4 + 10  # a quarter of the size
    for i in range(count):
        picture = np.full((520, 770), 200, dtype=np.uint8)
        for x, y in xy[i]:
            centre = tuple(round(16 * float(v)) for v in (x, y))
            cv2.circle(picture, centre, 16 * 6, 40, -1, cv2.LINE_AA, 4)
        picture = cv2.GaussianBlur(picture, (0, 0), 0.8)
        cv2.imwrite(str(folder / f"i{i}.png"), picture)
    return xy
