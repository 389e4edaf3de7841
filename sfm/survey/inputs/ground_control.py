"""Ground control with its image points, as OpenDroneMap and OpenSfM write it.

    gcp_list.txt                a projection, then X Y Z x_px y_px photograph [name] in each line; NaN for an
                                unknown Z
    ground_control_points.json  latitude, longitude and, if known, altitude; positions in photographs, from
                                the middle, as parts of the longer side

Latitudes and longitudes (WGS 84) become east, north and up, m, at the median point. UTM coordinates stay as
they are. Pixels are counted from the centre of the top-left one.

Source: documentation of OpenDroneMap and of OpenSfM, "Ground Control Points".
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sfm.conventions import METRES
from sfm.errors import SurveyFileError
from sfm.files.csv_tables import array_table
from sfm.files.plain_text import Content, read_json
from sfm.photographs.exif import SatellitePosition, local_coordinates
from sfm.survey.inputs.given import KnownPoints, Observations, read_control
from sfm.survey.inputs.settings import ControlSettings

ZONE = "(0?[1-9]|[1-5][0-9]|60)"
OPTIONS = r"( \+(zone=\d+|south|datum=WGS84|ellps=(WGS84|GRS80)|units=m|no_defs|type=crs|towgs84=[0,]+))*"
GEOGRAPHIC = re.compile(rf"WGS84|EPSG:4326|\+proj=(longlat|latlong){OPTIONS}", re.I)
UTM = re.compile(rf"WGS84 UTM {ZONE}[NS]|EPSG:32[67](0[1-9]|[1-5][0-9]|60)|\+proj=utm{OPTIONS}", re.I)
FIELDS = 6  # of a line, and a name if there is one
NO_SIGMA = (math.nan, math.nan, math.nan)


@dataclass(frozen=True)
class GroundControl:
    """Known points of a file, and their image points if it has any."""

    points: KnownPoints
    image_points: Observations | None = None
    is_geographic: bool = False  # whether the file has latitudes and longitudes


@dataclass(frozen=True)
class _Rows:
    """The image points of a file, each with the coordinates of its point."""

    xyz: Mapping[str, tuple[float, float, float]]  # by the names of the points
    image: list[str]
    point: list[str]
    xy: list[tuple[float, float]]
    unit: str
    is_geographic: bool


def read_ground_control(path: Path, settings: ControlSettings, unit: str) -> GroundControl:
    """Read known points, with their image points if the file has any.

    Args:
        path: a table of control, gcp_list.txt or ground_control_points.json, by the ending of its name.
        settings: standard deviations of coordinates that state none, and names of check points.
        unit: object unit of the survey.

    Raises:
        SurveyFileError: the file is unreadable or has wrong lines, another projection, a point at two
            positions, or no point that is named as a check point.
    """
    reader = READERS.get(path.suffix.lower())
    found = (
        GroundControl(read_control(path)) if reader is None else _with_image_points(path, reader(path), unit)
    )
    points = found.points
    if settings.sigma is not None:
        plane, height = settings.sigma
        points = replace(points, sigma=np.where(points.sigma == 0, [plane, plane, height], points.sigma))
    for name in settings.check:
        if name not in points.names:
            raise SurveyFileError(f"{path}: no point '{name}', which control.check names")
    if settings.check:
        check = np.isin(points.names, settings.check)[:, None] & np.isfinite(points.xyz)
        points = replace(points, check=check if points.check is None else points.check | check)
    return replace(found, points=points)


def _with_image_points(path: Path, rows: _Rows, unit: str) -> GroundControl:
    names = tuple(rows.xyz)
    if not names:
        raise SurveyFileError(f"{path}: no point of the file has coordinates, at least one is needed")
    xyz = np.array([rows.xyz[name] for name in names])
    if rows.is_geographic:
        _, xyz = local_coordinates([SatellitePosition(y, x, z, NO_SIGMA) for x, y, z in xyz.tolist()])
    points = KnownPoints.from_arrays(names, xyz / METRES[unit])
    if not rows.point:
        return GroundControl(points, None, rows.is_geographic)
    xy = np.array(rows.xy)
    table = array_table(str(path), {"image": rows.image, "point": rows.point}, {"x": xy[:, 0], "y": xy[:, 1]})
    image, point = table.texts
    seen = Observations(image, point, xy, None, rows.unit, table)
    return GroundControl(points, seen, rows.is_geographic)


def _read_gcp_list(path: Path) -> _Rows:
    try:
        projection, *lines = path.read_text("utf-8-sig").splitlines() or [""]
    except (OSError, ValueError) as error:
        raise SurveyFileError(f"{path}: not a readable text file: {error}") from None
    projection = projection.strip()
    if not (GEOGRAPHIC.fullmatch(projection) or UTM.fullmatch(projection)):
        raise SurveyFileError(
            f"{path}, line 1: projection '{projection[:60]}', expected WGS84, EPSG:4326, WGS84 UTM 32N, "
            "EPSG:32632 or +proj=utm"
        )
    rows = _Rows({}, [], [], [], "px", bool(GEOGRAPHIC.fullmatch(projection)))
    xyz: dict[str, tuple[float, float, float]] = {}
    numbered: dict[tuple[str, ...], str] = {}
    for number, line in enumerate(lines, 2):
        fields = line.split()
        if not fields or fields[0].startswith("#"):
            continue
        if len(fields) < FIELDS:
            raise SurveyFileError(
                f"{path}, line {number}: {len(fields)} fields, expected X Y Z x_px y_px photograph [name]"
            )
        x, y, z, column, row = (_number(field, path, number) for field in fields[: FIELDS - 1])
        if not all(map(math.isfinite, (x, y, column, row))):
            raise SurveyFileError(f"{path}, line {number}: found NaN, which only Z may be")
        name = fields[FIELDS] if len(fields) > FIELDS else None
        if name is None:  # a point is where its coordinates are
            name = numbered.setdefault(tuple(fields[:3]), f"gcp {len(numbered) + 1}")
        known = xyz.setdefault(name, (x, y, z))
        if not np.array_equal(known, (x, y, z), equal_nan=True):
            raise SurveyFileError(f"{path}, line {number}: point '{name}' has other coordinates than before")
        rows.image.append(fields[FIELDS - 1])
        rows.point.append(name)
        rows.xy.append((column, row))
    return replace(rows, xyz=xyz)


def _number(field: str, path: Path, line: int) -> float:
    try:
        return float(field)
    except ValueError:
        raise SurveyFileError(f"{path}, line {line}: found '{field[:40]}', expected a number") from None


class _Position(Content):
    latitude: float
    longitude: float
    altitude: float | None = None


class _Projection(Content):
    shot_id: str
    projection: tuple[float, float]


class _Point(Content):
    id: str
    position: _Position | None = None
    observations: tuple[_Projection, ...] = ()


class _Points(Content):
    points: tuple[_Point, ...]


def _read_opensfm(path: Path) -> _Rows:
    points = read_json(path, _Points, "a file of ground control points").points
    names = [point.id for point in points]
    for name in names:
        if names.count(name) > 1:
            raise SurveyFileError(f"{path}: two points have the id '{name}'")
    seen = [(point.id, where) for point in points for where in point.observations]
    return _Rows(
        {
            point.id: (at.longitude, at.latitude, math.nan if at.altitude is None else at.altitude)
            for point in points
            for at in [point.position]
            if at is not None
        },
        [where.shot_id for _, where in seen],
        [name for name, _ in seen],
        [where.projection for _, where in seen],
        "of the longer side",
        True,
    )


READERS: Mapping[str, Callable[[Path], _Rows]] = {".txt": _read_gcp_list, ".json": _read_opensfm}
