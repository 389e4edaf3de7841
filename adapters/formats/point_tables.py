"""Points with standard deviations and coordinate system: as CSV, and as GeoJSON for geographic programs.

    CSV       # crs: EPSG:32632, or well-known text; absent where unknown
              id,X,Y,Z[,sX,sY,sZ]
    GeoJSON   a FeatureCollection of Points with the properties name, sX, sY, sZ, and its crs

GeoJSON without a crs is in longitude and latitude, as RFC 7946 wants it; `convert --crs EPSG:4979` writes
these. A local object has "crs": null, which means in the older GeoJSON that nothing is known of it.

Source: RFC 4180; RFC 7946; GeoJSON format specification 1.0 (2008), sec. 3, for other coordinate systems.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from adapters.formats.clouds import refuse_large, refuse_unusable
from adapters.formats.content import Content, content_of_points, select_placed
from adapters.reading.trees import read_tree
from sfm.files.csv_tables import read_comments, read_header, read_table
from sfm.files.plain_text import csv_text
from sfm.files.whole_files import whole_file
from sfm.model.conventions import FloatArray
from sfm.model.errors import OutputError, SurveyFileError, missing_library

AXES, SIGMAS = ("X", "Y", "Z"), ("sX", "sY", "sZ")
HEAD = re.compile(r"^(# .*\n)*id,X,Y,Z(,sX,sY,sZ)?\s*$", re.MULTILINE)
CRS_LINE = "crs: "
GEOGRAPHIC = "EPSG:4979"  # longitude, latitude and height of WGS 84


def coordinate_system(name: str, where: str) -> Any:
    """Return the coordinate system of pyproj of a name such as EPSG:32632, or of well-known text.

    Args:
        name: of the system.
        where: file or option, for the message.

    Raises:
        SurveyFileError: pyproj does not know it.
        MissingLibraryError: pyproj is not installed.
    """
    try:
        import pyproj
    except ImportError as error:
        raise missing_library("a coordinate system", ("pyproj",), "exchange") from error
    try:
        return pyproj.CRS.from_user_input(name)
    except pyproj.exceptions.CRSError as error:
        raise SurveyFileError(
            f"{where}: '{name:.60}' is no coordinate system, expected such as EPSG:32632"
        ) from error


def in_system(content: Content, name: str) -> Content:
    """Return points in another coordinate system, with their covariances; in this one if theirs is not known.

    Args:
        content: a survey; its photographs are not transformed.
        name: such as EPSG:32632.

    Raises:
        SurveyFileError: the system is not known, or a point has no coordinates in it.
        MissingLibraryError: pyproj is not installed.
    """
    target = coordinate_system(name, "--crs")
    wkt = str(target.to_wkt())
    if not content.crs:
        return replace_points(content, content.result.estimate.points, content.result.point_covariance, wkt)
    import pyproj

    source = coordinate_system(content.crs, "the coordinate system of the points")
    turned = pyproj.Transformer.from_crs(source, target, always_xy=True)

    def apply(xyz: FloatArray) -> FloatArray:
        return np.stack(turned.transform(*xyz.T), axis=1)

    known = content.result.estimate.determined
    points = content.result.estimate.points.copy()
    points[known] = apply(points[known])
    if not np.isfinite(points[known]).all():
        raise SurveyFileError(f"--crs: a point has no coordinates in {name:.60}")
    C = content.result.point_covariance
    if C is not None and known.any():
        before = content.result.estimate.points[known]
        # half a unit in the seventh digit of the coordinates, as for any difference
        step = 1e-7 * np.maximum(np.abs(before).max(axis=0), 1.0)
        ends = [(apply(before + way) - apply(before - way)) / 2 for way in np.diag(step)]
        J = np.stack([end / s for end, s in zip(ends, step, strict=True)], axis=2)
        C = C.copy()
        C[known] = J @ C[known] @ J.transpose(0, 2, 1)
    return replace_points(content, points, C, wkt)


def replace_points(content: Content, points: FloatArray, C: FloatArray | None, crs: str) -> Content:
    """Return points with their names and other coordinates; all else of a survey is left behind."""
    result = content.result
    names = result.network.points if result.points_named else None
    sigma = None if C is None else np.sqrt(np.diagonal(C, axis1=1, axis2=2))
    return content_of_points(
        result.name, points, sigma, names=names, unit=result.unit, crs=crs, notes=content.notes
    )


def read_points_csv(path: Path) -> Content:
    """Read a table of points.

    Raises:
        SurveyFileError: with file and line number.
    """
    optional = SIGMAS if SIGMAS[0] in read_header(path) else ()
    table = read_table(path, ("id",), (*AXES, *optional), ignored=None)
    refuse_large(path, len(table.line))
    sigma = table.part(SIGMAS) if optional else None
    if sigma is not None:
        table.refuse(sigma, sigma < 0, SIGMAS, "0 or more")
    crs = ""
    for line, comment in read_comments(path):
        if comment.startswith(CRS_LINE):
            crs = str(coordinate_system(comment.removeprefix(CRS_LINE), f"{path}, line {line}").to_wkt())
    return content_of_points(path.name, table.part(AXES), sigma, names=table.keys("id"), crs=crs)


def write_points_csv(path: Path, content: Content) -> None:
    """Write the points that have coordinates.

    Raises:
        OutputError: the file cannot be written.
    """
    names, xyz, sigma = _points(content)
    numbers = xyz if sigma is None else np.hstack([xyz, sigma])
    header = ("id", *AXES, *(() if sigma is None else SIGMAS))
    head = f"# {CRS_LINE}{_short(content.crs)}\n" if content.crs else ""
    text = csv_text(header, ((name, *row) for name, row in zip(names, numbers.tolist(), strict=True)))
    with whole_file(path) as part:
        part.write_text(head + text, encoding="utf-8", newline="")


def read_geojson(path: Path) -> Content:
    """Read the points of a FeatureCollection; those without a name are numbered.

    Raises:
        SurveyFileError: with the file and its key.
    """
    tree = read_tree(path, "a GeoJSON file of points")
    features = tree.items("features")
    refuse_large(path, len(features))
    names: list[str] = []
    rows, named = [], True
    for k, feature in enumerate(features):
        geometry = feature.below("geometry")
        if geometry.text("type") != "Point":
            raise geometry.error(f"{geometry.place}type is {geometry.text('type'):.40}, only points are read")
        xyz = geometry.numbers(("coordinates",), 3)
        properties = feature.below("properties") if feature.key("properties") else None
        given = properties.key("name", "id") if properties is not None else None
        named &= given is not None
        names.append(properties.text(given) if properties is not None and given is not None else f"u{k}")
        known = properties is not None and properties.key("sX") is not None
        rows.append(
            (*xyz, *(properties.number(s) if properties is not None and known else np.nan for s in SIGMAS))
        )
    if len(set(names)) < len(names):
        raise tree.error("two points have one name, needed different ones")
    values = np.array(rows, dtype=float).reshape(-1, 6)
    refuse_unusable(path, values[:, :3])
    if (values[:, 3:] < 0).any():
        raise tree.error("a standard deviation is less than 0")
    crs = str(coordinate_system(GEOGRAPHIC, str(path)).to_wkt()) if "crs" not in tree.values else ""
    if tree.key("crs"):
        name = tree.below("crs").below("properties").text("name")
        crs = str(coordinate_system(name, str(path)).to_wkt())
    sigma = values[:, 3:] if np.isfinite(values[:, 3:]).all() else None
    return content_of_points(path.name, values[:, :3], sigma, names=tuple(names) if named else None, crs=crs)


def write_geojson(path: Path, content: Content) -> None:
    """Write the points that have coordinates.

    Raises:
        OutputError: its coordinate system has no number, or the file cannot be written.
    """
    names, xyz, sigma = _points(content)
    features = []
    for k, (name, row) in enumerate(zip(names, xyz.tolist(), strict=True)):
        properties: dict[str, Any] = {"name": name}
        if sigma is not None:
            properties |= dict(zip(SIGMAS, sigma[k].tolist(), strict=True))
        geometry = {"type": "Point", "coordinates": row}
        features.append({"type": "Feature", "properties": properties, "geometry": geometry})
    file: dict[str, Any] = {"type": "FeatureCollection"}
    system = _short(content.crs) if content.crs else ""
    if system.startswith("EPSG:") and system not in (GEOGRAPHIC, "EPSG:4326"):
        urn = f"urn:ogc:def:crs:EPSG::{system.removeprefix('EPSG:')}"
        file["crs"] = {"type": "name", "properties": {"name": urn}}
    elif not system:
        file["crs"] = None
    elif not system.startswith("EPSG:"):
        raise OutputError(f"{path}: its coordinate system has no number of the EPSG; name one with --crs")
    with whole_file(path) as part:
        text = json.dumps(file | {"features": features}, indent=1, ensure_ascii=False, allow_nan=False)
        part.write_text(text + "\n", encoding="utf-8")


def _points(content: Content) -> tuple[tuple[str, ...], FloatArray, FloatArray | None]:
    """Return names, coordinates and standard deviations of the points that have coordinates."""
    result = select_placed(content).result
    C = result.point_covariance
    sigma = None if C is None else np.sqrt(np.diagonal(C, axis1=1, axis2=2))
    if sigma is not None and not np.isfinite(sigma).all():
        sigma = None
    return result.network.points, result.estimate.points, sigma


def _short(crs: str) -> str:
    """Return EPSG and number of a coordinate system, or its well-known text in one line."""
    system = coordinate_system(crs, "the coordinate system of the points")
    number = system.to_epsg()
    return f"EPSG:{number}" if number else " ".join(str(system.to_wkt()).split())
