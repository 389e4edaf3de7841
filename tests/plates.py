"""Rendered calibration plates with their truth: dots with marks, and checkerboards. Object unit mm."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from sfm.model.camera import Camera, camera_from_values
from sfm.model.conventions import AnyArray, FloatArray, rotation_from_vector
from sfm.products.rendering.render import corner_rays, render_photograph
from sfm.products.rendering.scene import (
    CircularTargets,
    Faces,
    Marks,
    Optics,
    Scene,
    discs,
    join_marks,
    rectangles,
)
from sfm.targets.codes.plates import GRIDS, PlateFamily
from sfm.targets.codes.tags import opencv_dictionary, tag_family, tag_modules

PITCH = 12.0
SIZE_PX, PIXEL_MM = (800, 600), 0.0075
NOISE = 0.02  # standard deviation of an intensity, part of the full scale
TRUTH = {"c": 8.137, "x0": 0.041, "y0": -0.033, "K1": -1.1e-3, "K2": 2.3e-5}
MARKS = ((3, 3), (3, 5), (4, 7), (5, 4))
GRID = PlateFamily("grid", 9, 11, MARKS)
BOARD = PlateFamily("checkerboard", 8, 11)

SURVEY = """
[survey]
name = "{name}"
unit = "mm"

[[camera]]
name = "small"
images = "*.png"
pixel_mm = [{pixel}, {pixel}]
c_mm = 8.0
free = ["c", "x0", "y0", "K1", "K2"]

[targets]
polarity = "{polarity}"
codes = "{codes}"
rows = {rows}
columns = {columns}
pitch = {pitch}
marks = {marks}

[datum]
kind = "{datum}"

[adjust]
sigma_px = 0.01

[compare]
backend = "none"
"""


def camera() -> Camera:
    """Return the true camera."""
    free = ("c", "x0", "y0", "K1", "K2")
    values = [(name, value) for name, value in TRUTH.items() if name != "c"]
    made = camera_from_values("small", "brown", SIZE_PX, (PIXEL_MM, PIXEL_MM), c_mm=TRUTH["c"], free=free)
    p = made.parameters.copy()
    for name, value in values:
        p[made.names.index(name)] = value
    return made.with_parameters(p)


def plate_scene(
    plate: PlateFamily,
    *,
    rings: bool = False,
    move: FloatArray | None = None,
    mark: float = 4.6,
    border: int = 2,
) -> Scene:
    """Return a plate with its first point at the origin, X to the right, Y up.

    Args:
        plate: the plate.
        rings: whether its marks are rings.
        move: shifts its points.
        mark: radius of the marks, 3 that of the other dots.
        border: modules of the border of the tags of an AprilGrid.
    """
    xyz = plate.plane(PITCH) + (0.0 if move is None else move)
    middle = plate.plane(PITCH).mean(axis=0)
    half = np.ptp(plate.plane(PITCH), axis=0)[None, :2] / 2 + PITCH
    faces = Faces(middle[None], np.eye(3)[None, :2], half, np.array([0.85]), np.zeros(1), np.ones(1))
    xy = (xyz - middle)[:, :2]
    if plate.name in GRIDS:
        is_mark = np.isin(np.arange(plate.count), [r * plate.columns + c for r, c in plate.marks])
        marks: list[Marks] = [discs(0, xy[~is_mark], 3.0, 0.06), discs(0, xy[is_mark], mark, 0.06)]
        radius = np.where(is_mark, mark, 3.0)
        if rings:
            marks.append(discs(0, xy[is_mark], 0.52 * mark, 0.85))
            radius = np.where(is_mark, 0.52 * mark, 3.0)
        targets = CircularTargets(np.zeros(plate.count, dtype=np.int64), xy, radius, np.arange(plate.count))
        return Scene(faces, join_marks(marks), targets)
    none = CircularTargets(
        np.zeros(0, dtype=np.int64), np.zeros((0, 2)), np.zeros(0), np.zeros(0, dtype=np.int64)
    )
    if plate.name == "aprilgrid":
        return Scene(faces, _april_tags(plate, middle, border), none)
    row, column = np.mgrid[-1 : plate.rows, -1 : plate.columns]
    # the square right below the first crossing is dark
    dark = (row + column) % 2 == 0
    centre = np.stack([(column[dark] + 0.5) * PITCH, -(row[dark] + 0.5) * PITCH], axis=1) - middle[:2]
    k = len(centre)
    squares = rectangles(0, centre, np.full((k, 2), PITCH / 2), np.zeros(k), np.full(k, 0.06))
    if plate.name == "charuco":
        squares = join_marks([squares, _tags_of(plate, middle)])
    return Scene(faces, squares, none)


def _tags_of(plate: PlateFamily, middle: FloatArray) -> Marks:
    """Return the tags in the white squares of a board."""
    family, dictionary = tag_family(plate.dictionary), opencv_dictionary(plate.dictionary)
    size = plate.columns + 1, plate.rows + 1
    board = cv2.aruco.CharucoBoard(size, PITCH, plate.tag_share * PITCH, dictionary)
    side, centre = plate.tag_share * PITCH / family.modules, []
    for number, corners in enumerate(board.getObjPoints()):
        row, column = np.nonzero(tag_modules(family, number))
        x, y = (column + 0.5) * side + corners[0, 0] - PITCH, (row + 0.5) * side + corners[0, 1] - PITCH
        centre.append(np.stack([x, -y], axis=1) - middle[:2])
    joined = np.concatenate(centre)
    k = len(joined)
    return rectangles(0, joined, np.full((k, 2), side / 2), np.zeros(k), np.full(k, 0.06))


def _april_tags(plate: PlateFamily, middle: FloatArray, border: int) -> Marks:
    """Return the tags of an AprilGrid, upside down as Kalibr prints them, and squares at their corners."""
    size, family = plate.tag_share * PITCH, tag_family(plate.dictionary)
    black, white, half = [], [], np.array([size, size]) / 2
    gap = PITCH - size
    for corner in plate.plane(PITCH)[:, :2].reshape(plate.rows, plate.columns, 2)[::2, ::2].reshape(-1, 2):
        row, column = round(-corner[1] / PITCH), round(corner[0] / PITCH)
        number = plate.first_tag + (plate.rows // 2 - 1 - row) * plate.columns // 2 + column
        modules = np.rot90(np.pad(tag_modules(family, number), border - 1, constant_values=True), 2)
        side = size / len(modules)
        r, c = np.nonzero(~modules)
        white.append(corner + side * np.stack([c + 0.5, -r - 0.5], axis=1))
        # edges that are drawn in parts, or twice, would move
        black.append((corner + half * [1, -1], half))
        right, below = column == plate.columns // 2 - 1, row == plate.rows // 2 - 1
        square = np.full(2, gap / 2)
        black.extend(
            (corner + np.array([x, y]), square)
            for x in (-gap / 2, size + gap / 2)[: 1 + right]
            for y in (gap / 2, -size - gap / 2)[: 1 + below]
        )
    at, halves = (np.array(part) for part in zip(*black, strict=True))
    squares = rectangles(0, at - middle[:2], halves, np.zeros(len(at)), np.full(len(at), 0.06))
    bright = np.concatenate(white)
    k = len(bright)
    return join_marks(
        [
            squares,
            rectangles(0, bright - middle[:2], np.full((k, 2), side / 2), np.zeros(k), np.full(k, 0.85)),
        ]
    )


def stations(rng: np.random.Generator, count: int, plate: PlateFamily) -> tuple[FloatArray, FloatArray]:
    """Return stations about the plate that show most or all of it, rolled by up to 180 degrees."""
    middle = plate.plane(PITCH).mean(axis=0)
    distance = rng.uniform(210, 250, count)
    azimuth = 2 * np.pi * np.arange(count) / count + rng.uniform(0, 0.5)
    tilt = np.radians(rng.uniform(18, 32, count))
    tilt[0] = 0.02
    position, rotation = np.empty((count, 3)), np.empty((count, 3, 3))
    for i in range(count):
        z = np.array(
            [np.sin(tilt[i]) * np.cos(azimuth[i]), np.sin(tilt[i]) * np.sin(azimuth[i]), np.cos(tilt[i])]
        )
        x = np.cross([0.0, 1.0, 0.0], z)
        x /= np.linalg.norm(x)
        roll = rotation_from_vector(np.array([0.0, 0.0, [0.1, np.pi / 2, np.pi, -0.2][i % 4]]))
        position[i] = middle + distance[i] * z
        rotation[i] = np.stack([x, np.cross(z, x), z], axis=1) @ roll
    return position, rotation


def plate_pictures(
    plate: PlateFamily,
    rng: np.random.Generator,
    count: int,
    *,
    rings: bool = False,
    mark: float = 4.6,
    noise: float = NOISE,
    bits: int = 8,
) -> list[AnyArray]:
    """Return rendered photographs of a plate."""
    scene, truth = plate_scene(plate, rings=rings, mark=mark), camera()
    optics = Optics(blur_px=0.8, exposure=0.9, noise=noise, oversampling=3, bits=bits)
    position, rotation = stations(rng, count, plate)
    rays = corner_rays(truth)
    return [
        render_photograph(scene, truth, position[i], rotation[i], optics=optics, rng=rng, rays=rays)[0]
        for i in range(count)
    ]


def with_noise(pictures: list[AnyArray], rng: np.random.Generator, noise: float = NOISE) -> list[AnyArray]:
    """Return photographs of 8 bit with noise from noiseless ones of 16 bit."""
    noisy = [one / 257 + 255 * noise * rng.standard_normal(one.shape, dtype=np.float32) for one in pictures]
    return [np.rint(one).clip(0, 255).astype(np.uint8) for one in noisy]


def write_plate_survey(
    folder: Path,
    plate: PlateFamily,
    rng: np.random.Generator,
    *,
    count: int = 6,
    datum: str = "control",
    rings: bool = False,
    pictures: list[AnyArray] | None = None,
) -> Path:
    """Write a survey of photographs of a plate, rendered here unless they are given; return its file."""
    folder.mkdir(parents=True, exist_ok=True)
    pictures = plate_pictures(plate, rng, count, rings=rings) if pictures is None else pictures
    for k, picture in enumerate(pictures):
        cv2.imwrite(str(folder / f"photo {k + 1}.png"), picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    text = SURVEY.format(
        name=folder.name,
        polarity="auto" if rings else "dark",
        pixel=PIXEL_MM,
        codes=plate.name,
        rows=plate.rows,
        columns=plate.columns,
        pitch=PITCH,
        marks=[list(mark) for mark in plate.marks],
        datum=datum,
    )
    if not plate.marks:
        text = text.replace("marks = []\n", "")
    (folder / "survey.toml").write_text(text, encoding="utf-8")
    return folder / "survey.toml"
