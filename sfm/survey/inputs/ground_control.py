"""Ground control with its image points, as OpenDroneMap and OpenSfM write it.

    gcp_list.txt                a projection, then X Y Z x_px y_px photograph [name] in each line; NaN for an
                                unknown Z; names of photographs may have spaces
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
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from sfm.files.csv_tables import array_table
from sfm.files.plain_text import Content, read_json
from sfm.model.conventions import METRES
from sfm.model.display import counted
from sfm.model.errors import SurveyFileError
from sfm.photographs.exif import SatellitePosition, local_coordinates
from sfm.photographs.reading import SUFFIXES
from sfm.survey.inputs.given_values import AXES, KnownPoints, Observations, known_points, read_control
from sfm.survey.inputs.settings import ControlSettings

ZONE = "(0?[1-9]|[1-5][0-9]|60)"
OPTIONS = r"( \+(zone=\d+|south|datum=WGS84|ellps=(WGS84|GRS80)|units=m|no_defs|type=crs|towgs84=[0,]+))*"
GEOGRAPHIC = re.compile(rf"WGS84|EPSG:4326|\+proj=(longlat|latlong){OPTIONS}", re.I)
UTM = re.compile(rf"WGS84 UTM {ZONE}[NS]|EPSG:32[67](0[1-9]|[1-5][0-9]|60)|\+proj=utm{OPTIONS}", re.I)
COORDINATES = 5  # of a line, before the photograph
NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)(e[+-]?[0-9]+)?|nan", re.I)
PHOTOGRAPH = re.compile(rf".*?({'|'.join(map(re.escape, SUFFIXES))})(?!\S)|\S+", re.I)  # may have spaces
NO_SIGMA = (math.nan, math.nan, math.nan)


@dataclass(frozen=True)
class GroundControl:
    """Known points of a file, and their image points if it has any."""

    points: KnownPoints
    image_points: Observations | None = None
    is_geographic: bool = False  # whether the file has latitudes and longitudes


@dataclass
class _Rows:
    """The points and image points of a file, as they are written there."""

    path: Path
    unit: str  # of image points
    is_geographic: bool
    xyz: dict[str, tuple[float, float, float]] = field(default_factory=dict)  # by the names of the points
    line: list[int] = field(default_factory=list)  # of the points; empty if the file has no lines
    image: list[str] = field(default_factory=list)
    point: list[str] = field(default_factory=list)
    xy: list[tuple[float, float]] = field(default_factory=list)
    image_line: list[int] = field(default_factory=list)  # of the image points

    def add_point(self, name: str, xyz: tuple[float, float, float], where: str) -> None:
        """Add a point, which may be known already.

        where: its place in the file.
        """
        for value, what, most in zip(xyz, ("longitude", "latitude"), (180, 90), strict=False):
            if self.is_geographic and not abs(value) <= most:
                raise SurveyFileError(
                    f"{self.path}, {where}: {what} {value:g}, needed -{most} to {most} degrees"
                )
        known = self.xyz.setdefault(name, xyz)
        if not np.array_equal(known, xyz, equal_nan=True):
            raise SurveyFileError(f"{self.path}, {where}: point '{name}' has other coordinates than before")


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
    control = GroundControl(read_control(path)) if reader is None else _with_image_points(reader(path), unit)
    points = control.points
    if settings.sigma is not None:
        plane, height = settings.sigma
        points = replace(points, sigma=np.where(points.sigma == 0, [plane, plane, height], points.sigma))
    for name in settings.check:
        if name not in points.names:
            raise SurveyFileError(f"{path}: no point '{name}', which control.check names")
    if settings.check:
        check = np.isin(points.names, settings.check)[:, None] & np.isfinite(points.xyz)
        points = replace(points, check=check if points.check is None else points.check | check)
    return replace(control, points=points)


def _with_image_points(rows: _Rows, unit: str) -> GroundControl:
    names, where = tuple(rows.xyz), str(rows.path)
    if not names:
        raise SurveyFileError(f"{where}: no point of the file has coordinates, at least one is needed")
    xyz = np.array([rows.xyz[name] for name in names])
    if rows.is_geographic:
        _, xyz = local_coordinates([SatellitePosition(y, x, z, NO_SIGMA) for x, y, z in xyz.tolist()])
    columns = dict(zip(AXES, (xyz / METRES[unit]).T, strict=True))
    points = known_points(array_table(where, {"id": names}, columns, blank=AXES, line=rows.line or None))
    if not rows.point:
        return GroundControl(points, None, rows.is_geographic)
    xy = np.array(rows.xy)
    table = array_table(
        where,
        {"image": rows.image, "point": rows.point},
        {"x": xy[:, 0], "y": xy[:, 1]},
        line=rows.image_line or None,
    )
    image, point = table.texts
    seen = Observations(image, point, xy, None, rows.unit, table, of_control=True)
    return GroundControl(points, seen, rows.is_geographic)


def _read_gcp_list(path: Path) -> _Rows:
    try:
        lines = path.read_text("utf-8-sig").splitlines()
    except (OSError, ValueError) as error:
        raise SurveyFileError(f"{path}: not a readable text file: {error}") from None
    stated = [(k, line) for k, line in enumerate(lines, 1) if line.strip() and line.split()[0][0] != "#"]
    first, projection = stated[0] if stated else (1, "")
    projection = projection.strip()
    if not (GEOGRAPHIC.fullmatch(projection) or UTM.fullmatch(projection)):
        raise SurveyFileError(
            f"{path}, line {first}: projection '{projection[:60]}', expected WGS84, EPSG:4326, WGS84 UTM "
            "32N, EPSG:32632 or +proj=utm"
        )
    rows = _Rows(path, "px", bool(GEOGRAPHIC.fullmatch(projection)))
    numbered: dict[tuple[float | None, ...], str] = {}
    for number, line in stated[1:]:
        where = f"line {number}"
        *fields, names = line.split(None, COORDINATES)
        if len(fields) < COORDINATES:
            raise SurveyFileError(
                f"{path}, {where}: {counted(len(fields) + 1, 'field')} between spaces, "
                "expected X Y Z x_px y_px photograph [name]"
            )
        for text in fields:
            if NUMBER.fullmatch(text) is None:
                raise SurveyFileError(f"{path}, {where}: found '{text[:40]}', expected a number")
        x, y, z, column, row = map(float, fields)
        if not all(map(math.isfinite, (x, y, column, row))):
            raise SurveyFileError(f"{path}, {where}: found NaN, which only Z may be")
        image = PHOTOGRAPH.match(names)
        assert image is not None  # a line has no spaces at its ends
        name = next(iter(names[image.end() :].split()), None)
        if name is None:  # a point is where its coordinates are
            place = tuple(None if math.isnan(value) else value for value in (x, y, z))
            name = numbered.setdefault(place, f"gcp {len(numbered) + 1}")
        if name not in rows.xyz:
            rows.line.append(number)
        rows.add_point(name, (x, y, z), where)
        rows.image.append(image.group())
        rows.point.append(name)
        rows.xy.append((column, row))
        rows.image_line.append(number)
    return rows


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


class OpenSfmPoints(Content):
    """Content of ground_control_points.json."""

    points: tuple[_Point, ...]


def _read_opensfm(path: Path) -> _Rows:
    rows = _Rows(path, "of the longer side", is_geographic=True)
    names = set[str]()
    for point in read_json(path, OpenSfmPoints, "a file of ground control points").points:
        if point.id in names:
            raise SurveyFileError(f"{path}: two points have the id '{point.id}'")
        names.add(point.id)
        at = point.position
        if at is not None:
            height = math.nan if at.altitude is None else at.altitude
            rows.add_point(point.id, (at.longitude, at.latitude, height), f"point '{point.id}'")
        for seen in point.observations:
            rows.image.append(seen.shot_id)
            rows.point.append(point.id)
            rows.xy.append(seen.projection)
    return rows


READERS: Mapping[str, Callable[[Path], _Rows]] = {".txt": _read_gcp_list, ".json": _read_opensfm}
