"""The scene file (TOML): faces, targets, camera and stations of photographs to be rendered."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from sfm.files.plain_text import read_toml
from sfm.model.camera import Camera, camera_from_values
from sfm.model.conventions import FloatArray
from sfm.model.display import counted
from sfm.model.distortion.models import MODELS
from sfm.model.errors import SurveyFileError
from sfm.products.planning.stations import aim_camera
from sfm.products.rendering.scene import (
    UNCODED,
    CircularTargets,
    Faces,
    Light,
    Marks,
    Optics,
    Scene,
    coded_ring,
    discs,
    join_marks,
    rectangles,
)
from sfm.targets.codes.concentric import ConcentricFamily
from sfm.targets.codes.plates import code_family
from sfm.targets.codes.rings import CodeFamily
from sfm.targets.codes.tags import TagFamily

Two = Annotated[tuple[float, float], Field(strict=False)]
Three = Annotated[tuple[float, float, float], Field(strict=False)]
Part = Annotated[float, Field(ge=0, le=1)]
Length = Annotated[float, Field(gt=0)]
Side = Annotated[int, Field(gt=0, le=20_000)]  # px; photographs are rendered as a whole, with oversampling
Count = Annotated[int, Field(gt=0, le=1000)]

# Code 0 in a grid is a dot without a ring; this code leaves the position empty.
NO_TARGET = -1
# Lines that imitate print consist of words of 2 to 6 letters, each of one or two bars.
WORD_LETTERS = (2, 7)


@dataclass(frozen=True)
class Staging:
    """A scene with everything needed to photograph it."""

    scene: Scene
    camera: Camera
    positions: FloatArray  # projection centres, object unit, (m, 3)
    rotations: FloatArray  # R, image to object axes, (m, 3, 3)
    optics: Optics
    names: tuple[str, ...]  # file names of the photographs, (m,)
    quality: int  # of JPEG, 1 to 100
    seed: int


class _Section(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)


class _Head(_Section):
    photographs: Annotated[
        str, Field(pattern=r"^[^/\\{}]*\{(:0?\d?d)?\}[^/\\{}]*$", max_length=100)
    ]  # file name with {} for the number of the station
    quality: Annotated[int, Field(ge=1, le=100)] = 95
    codes: str = "none"
    background: Part = 0.05
    seed: int = 0


def _known_model(model: str) -> str:
    if model not in MODELS:
        raise ValueError(f"model '{model}', expected one of {', '.join(MODELS)}")
    return model


class _Camera(_Section):
    model: Annotated[str, AfterValidator(_known_model)]
    size_px: Annotated[tuple[Side, Side], Field(strict=False)]
    pixel_mm: Two
    c_mm: Length
    values: dict[str, float] = {}


class _Optics(_Section):
    blur_px: Annotated[float, Field(ge=0)] = 0.7
    vignetting: Part = 0.0
    exposure: Length = 0.9
    noise: Annotated[float, Field(ge=0)] = 0.0
    shot_noise: Annotated[float, Field(ge=0)] = 0.0
    bits: Literal[8, 16] = 8
    oversampling: Annotated[int, Field(ge=1, le=8)] = 2


class _Light(_Section):
    position: Three
    reach: Length
    ambient: Annotated[float, Field(ge=0)]


class _Grid(_Section):
    first: Two  # plane coordinates of the first target
    step: Two = (0.0, 0.0)
    count: Annotated[tuple[Count, Count], Field(strict=False)] = (1, 1)  # columns and rows
    radius: Length
    reflectance: Part
    codes: tuple[int, ...] | list[int] = ()  # row by row; 0 = no ring, -1 = no target; all 0 if omitted
    turn_deg: float = 0.0


class _Rectangle(_Section):
    centre: Two
    size: Two
    turn_deg: float = 0.0
    reflectance: Part


class _Print(_Section):
    at: Two  # left end of the first line
    lines: Count
    length: Length
    height: Length  # of a letter
    turn_deg: float = 0.0
    reflectance: Part


class _Face(_Section):
    name: str
    centre: Three
    a: Three  # direction of the first axis, to the right as seen from outside
    b: Three  # direction of the second axis, up; made perpendicular to a
    size: Two
    reflectance: Part
    texture: Part = 0.0
    grain: Length = 1.0
    rectangle: list[_Rectangle] = []
    print: list[_Print] = []
    grid: list[_Grid] = []


class _Station(_Section):
    position: Three
    look_at: Three
    roll_deg: float = 0.0


class _File(_Section):
    scene: _Head
    camera: _Camera
    optics: _Optics = _Optics()
    light: _Light | None = None
    face: list[_Face]
    station: list[_Station]


def read_scene(path: Path) -> Staging:
    """Read a scene file.

    Args:
        path: the TOML file.

    Returns:
        The scene, camera, stations and everything else needed to render its photographs.

    Raises:
        SurveyFileError: the file is missing, is not TOML, or has an entry that a scene file may not have.
    """
    _, table = read_toml(path, "a scene file")
    try:
        file = _File.model_validate(table)
    except ValidationError as error:
        first = error.errors()[0]
        raise SurveyFileError(
            f"{path}: {'.'.join(map(str, first['loc']))}: {first['msg'].removeprefix('Value error, ')}"
        ) from error
    faces = _faces(file.face)
    family = code_family(file.scene.codes)
    if isinstance(family, TagFamily | ConcentricFamily):
        raise SurveyFileError(f"{path}: codes = '{family.name}', expected rings or arcs")
    rng = np.random.default_rng(file.scene.seed)
    marks: list[Marks] = []
    targets: list[tuple[int, float, float, float, int]] = []
    for k, face in enumerate(file.face):
        for rectangle in face.rectangle:
            centre, half = np.array([rectangle.centre]), np.array([rectangle.size]) / 2
            turn, value = np.array([np.radians(rectangle.turn_deg)]), np.array([rectangle.reflectance])
            marks.append(rectangles(k, centre, half, turn, value))
        marks += [_printed_lines(k, printed, rng) for printed in face.print]
        for grid in face.grid:
            _place_grid(path, k, face.name, grid, family, marks, targets)
    row = np.array(targets, dtype=float).reshape(-1, 5)
    light = None
    if file.light is not None:
        light = Light(np.array(file.light.position), file.light.reach, file.light.ambient)
    scene = Scene(
        faces,
        join_marks(marks),
        CircularTargets(row[:, 0].astype(np.int64), row[:, 1:3], row[:, 3], row[:, 4].astype(np.int64)),
        light,
        file.scene.background,
    )
    camera = camera_from_values(
        "scene",
        file.camera.model,
        file.camera.size_px,
        file.camera.pixel_mm,
        c_mm=file.camera.c_mm,
        values=tuple(file.camera.values.items()),
    )
    stations = [
        aim_camera(np.subtract(station.look_at, station.position), np.radians(station.roll_deg))
        for station in file.station
    ]
    return Staging(
        scene,
        camera,
        np.array([station.position for station in file.station]),
        np.array(stations),
        Optics(**file.optics.model_dump()),
        tuple(file.scene.photographs.format(i + 1) for i in range(len(stations))),
        file.scene.quality,
        file.scene.seed,
    )


def _faces(given: list[_Face]) -> Faces:
    a = np.array([face.a for face in given])
    b = np.array([face.b for face in given])
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b -= (a * b).sum(axis=1, keepdims=True) * a
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    return Faces(
        np.array([face.centre for face in given]),
        np.stack([a, b], axis=1),
        np.array([face.size for face in given]) / 2,
        np.array([face.reflectance for face in given]),
        np.array([face.texture for face in given]),
        np.array([face.grain for face in given]),
    )


def _printed_lines(face: int, printed: _Print, rng: np.random.Generator) -> Marks:
    """Return lines of words that look like print from a distance."""
    centre, half = [], []
    for line in range(printed.lines):
        x, y = 0.0, -1.8 * printed.height * line
        while x < printed.length:
            for _ in range(int(rng.integers(*WORD_LETTERS))):
                upright = rng.random() < 0.7
                size = (0.12, 0.5) if upright else (0.3, 0.1)
                centre.append((x, y + (0.0 if upright else rng.choice([-0.35, 0.0, 0.35]) * printed.height)))
                half.append((size[0] * printed.height, size[1] * printed.height))
                x += (0.45 if upright else 0.75) * printed.height
            x += 0.6 * printed.height
    turn = np.radians(printed.turn_deg)
    cos, sin = np.cos(turn), np.sin(turn)
    at = np.array(centre) @ np.array([[cos, sin], [-sin, cos]]) + printed.at
    count = len(at)
    return rectangles(face, at, np.array(half), np.full(count, turn), np.full(count, printed.reflectance))


def _place_grid(
    path: Path,
    face: int,
    name: str,
    grid: _Grid,
    family: CodeFamily | None,
    marks: list[Marks],
    targets: list[tuple[int, float, float, float, int]],
) -> None:
    columns, rows = grid.count
    codes = list(grid.codes) or [0] * (columns * rows)
    if len(codes) != columns * rows:
        raise SurveyFileError(
            f"{path}: face {name}: {counted(len(codes), 'code')} for a grid of {columns} x {rows} targets"
        )
    for k, code in enumerate(codes):
        x, y = grid.first[0] + grid.step[0] * (k % columns), grid.first[1] + grid.step[1] * (k // columns)
        if code == NO_TARGET:
            continue
        at = np.array([x, y])
        if code == 0:
            marks.append(discs(face, at[None], grid.radius, grid.reflectance))
        elif family is None:
            raise SurveyFileError(f"{path}: face {name}: code {code}, but [scene] codes is none")
        else:
            turn = np.radians(grid.turn_deg)
            marks.append(coded_ring(face, at, grid.radius, code, family, grid.reflectance, turn=turn))
        targets.append((face, x, y, grid.radius, code or UNCODED))
