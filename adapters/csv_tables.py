"""A survey's result as CSV tables with named columns, read and written.

    points.csv          id,X,Y,Z[,sX,sY,sZ]
    images.csv          image,X,Y,Z,omega_deg,phi_deg,kappa_deg[,sX,sY,sZ],camera
    cameras.csv         camera,parameter,value[,sigma],unit
    image_points.csv    image,point,x_px,y_px[,sx_px,sy_px][,rejected]
    summary.json        name of the survey, model, size and pixel of each camera, redundancy

These are the tables that `kolinear run` writes; other columns are passed over. What a summary does not say of
size and pixel is taken from the COLMAP model in the folder `colmap`.

Source: RFC 4180 for CSV; the columns are described in the README.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sfm.camera import Camera
from sfm.conventions import FloatArray, angles_from_rotation, rotation_from_angles
from sfm.distortion.models import MODELS
from sfm.errors import OutputError, SurveyFileError
from sfm.network import Estimate, ImagePoints, Network

SIGMAS = ("sX", "sY", "sZ")
COLMAP_SIDE_FILE = "colmap/kolinear.json"  # as written by adapters.colmap


@dataclass(frozen=True)
class TableResult:
    """A result as its tables tell it."""

    name: str  # of the survey
    network: Network
    estimate: Estimate
    point_covariance: FloatArray | None = None  # diagonal: of sX, sY, sZ, object unit^2, (n, 3, 3)
    position_covariance: FloatArray | None = None  # likewise of the projection centres, (m, 3, 3)
    interior_sigma: tuple[FloatArray, ...] | None = None  # of each parameter, NaN where fixed
    redundancy: int | None = None
    unit: str = ""  # of lengths, as people call it; empty where nobody knows


def read_result(folder: Path) -> TableResult:
    """Read the tables of a result, rejected image points left out.

    Raises:
        SurveyFileError: what is missing or wrong, with file and line number.
    """
    summary = _summary(folder / "summary.json")
    cameras, sigmas = _cameras(folder, summary)
    index = {camera.name: k for k, camera in enumerate(cameras)}
    table = _Table.of(
        folder / "images.csv", ("image", "X", "Y", "Z", "omega_deg", "phi_deg", "kappa_deg", "camera")
    )
    images = table.keys("image")
    for row, name in zip(table.rows, table.text("camera"), strict=True):
        if name not in index:
            raise table.error(row, f"camera '{name}' is not in cameras.csv")
    exterior = table.numbers(("X", "Y", "Z", "omega_deg", "phi_deg", "kappa_deg"))
    rotation = np.array([rotation_from_angles(*np.deg2rad(row)) for row in exterior[:, 3:]]).reshape(-1, 3, 3)
    position_sigma = table.maybe_numbers(SIGMAS)
    camera = np.array([index[name] for name in table.text("camera")], dtype=np.int64)
    table = _Table.of(folder / "points.csv", ("id", "X", "Y", "Z"))
    points = table.keys("id")
    xyz, point_sigma = table.numbers(("X", "Y", "Z")), table.maybe_numbers(SIGMAS)
    network = Network(images, camera, points, _image_points(folder, images, points))
    return TableResult(
        str(summary.get("survey", folder.name)),
        network,
        Estimate(cameras, exterior[:, :3].copy(), rotation, xyz),
        None if point_sigma is None else np.eye(3) * point_sigma[:, None, :] ** 2,
        None if position_sigma is None else np.eye(3) * position_sigma[:, None, :] ** 2,
        sigmas,
        summary.get("redundancy"),
        str(summary.get("length_unit", "")),
    )


def write_tables(folder: Path, result: TableResult) -> None:
    """Write a result as tables with named columns.

    Raises:
        OutputError: the folder cannot be written.
    """
    network, estimate = result.network, result.estimate
    angles = np.rad2deg(angles_from_rotation(estimate.rotation))
    point_sigma = _sigma_of(result.point_covariance, len(network.points))
    position_sigma = _sigma_of(result.position_covariance, len(network.images))
    seen = network.image_points
    sigma = np.sqrt(np.diagonal(seen.covariance, axis1=1, axis2=2))
    camera_rows = []
    for k, camera in enumerate(estimate.cameras):
        known = np.full(len(camera.names), np.nan)
        known = known if result.interior_sigma is None else result.interior_sigma[k]
        camera_rows += [
            (camera.name, name, value, s, unit)
            for name, value, s, unit in zip(camera.names, camera.parameters, known, camera.units, strict=True)
        ]
    summary: dict[str, Any] = {
        "survey": result.name,
        "redundancy": result.redundancy,
        "length_unit": result.unit,
        "cameras": [
            {
                "name": camera.name,
                "model": camera.model,
                "size_px": list(camera.size_px),
                "pixel_mm": [float(value) for value in camera.pixel_mm],
            }
            for camera in estimate.cameras
        ],
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _write(
            folder / "points.csv",
            "id,X,Y,Z,sX,sY,sZ",
            ((n, *x, *s) for n, x, s in zip(network.points, estimate.points, point_sigma, strict=True)),
        )
        _write(
            folder / "images.csv",
            "image,X,Y,Z,omega_deg,phi_deg,kappa_deg,sX,sY,sZ,camera",
            (
                (
                    name,
                    *estimate.position[i],
                    *angles[i],
                    *position_sigma[i],
                    estimate.cameras[network.camera[i]].name,
                )
                for i, name in enumerate(network.images)
            ),
        )
        _write(folder / "cameras.csv", "camera,parameter,value,sigma,unit", camera_rows)
        _write(
            folder / "image_points.csv",
            "image,point,x_px,y_px,sx_px,sy_px",
            (
                (network.images[i], network.points[j], *xy, *s)
                for i, j, xy, s in zip(seen.image, seen.point, seen.xy, sigma, strict=True)
            ),
        )
        text = json.dumps(summary, indent=2, ensure_ascii=False)
        (folder / "summary.json").write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{folder}: the tables cannot be written ({error.strerror})") from error


def _summary(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SurveyFileError(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        line = getattr(error, "lineno", 1)
        raise SurveyFileError(f"{path}, line {line}: not valid JSON ({error})") from error
    if not isinstance(found, dict) or not isinstance(found.get("cameras"), list):
        raise SurveyFileError(f"{path}, line 1: not the summary of a result, it names no cameras")
    return found


def _cameras(folder: Path, summary: dict[str, Any]) -> tuple[tuple[Camera, ...], tuple[FloatArray, ...]]:
    """Cameras in the order of the summary, and the sigmas of their parameters."""
    table = _Table.of(folder / "cameras.csv", ("camera", "parameter", "value"))
    values = table.numbers(("value",))[:, 0]
    sigma = table.maybe_numbers(("sigma",))
    rows = {}
    for k, key in enumerate(zip(table.text("camera"), table.text("parameter"), strict=True)):
        if key in rows:
            raise table.error(table.rows[k], f"parameter {key[1]} of camera {key[0]} stands twice")
        rows[key] = k
    cameras, sigmas = [], []
    for number, entry in enumerate(summary["cameras"]):
        name, model = entry.get("name"), entry.get("model")
        if model not in MODELS:
            raise SurveyFileError(f"{folder / 'summary.json'}: camera {name} has the unknown model '{model}'")
        missing = [p for p in MODELS[model].names if (name, p) not in rows]
        if missing:
            raise SurveyFileError(
                f"{table.path}, line {table.last}: {missing[0]} of camera {name} is missing"
            )
        chosen = [rows[name, p] for p in MODELS[model].names]
        s = np.full(len(chosen), np.nan) if sigma is None else sigma[chosen, 0]
        size, pixel = _size(folder, entry, number)
        cameras.append(Camera(name, model, size, pixel, values[chosen], np.isfinite(s)))
        sigmas.append(s)
    return tuple(cameras), tuple(sigmas)


def _size(folder: Path, entry: dict[str, Any], number: int) -> tuple[tuple[int, int], FloatArray]:
    """Size and pixel of a camera, from the summary or else from the COLMAP model beside it."""
    if "size_px" in entry and "pixel_mm" in entry:
        return (int(entry["size_px"][0]), int(entry["size_px"][1])), np.array(entry["pixel_mm"], dtype=float)
    try:
        side = json.loads((folder / COLMAP_SIDE_FILE).read_text(encoding="utf-8"))["cameras"][number]
        size = (int(side["size_px"][0]), int(side["size_px"][1]))
        return size, np.array(side["pixel_mm"], dtype=float)
    except (OSError, ValueError, LookupError) as error:
        raise SurveyFileError(
            f"{folder}: neither summary.json nor {COLMAP_SIDE_FILE} tells size and pixel of camera "
            f"{number + 1}"
        ) from error


def _image_points(folder: Path, images: tuple[str, ...], points: tuple[str, ...]) -> ImagePoints:
    table = _Table.of(folder / "image_points.csv", ("image", "point", "x_px", "y_px"))
    image_index = {name: i for i, name in enumerate(images)}
    point_index = {name: j for j, name in enumerate(points)}
    image, point = [], []
    for row, a, b in zip(table.rows, table.text("image"), table.text("point"), strict=True):
        if a not in image_index:
            raise table.error(row, f"image '{a}' is not in images.csv")
        if b not in point_index:
            raise table.error(row, f"point '{b}' is not in points.csv")
        image.append(image_index[a])
        point.append(point_index[b])
    sigma = table.maybe_numbers(("sx_px", "sy_px"))
    sigma = np.ones((len(image), 2)) if sigma is None else sigma
    found = ImagePoints(
        np.array(image, dtype=np.int64),
        np.array(point, dtype=np.int64),
        table.numbers(("x_px", "y_px")),
        np.eye(2) * sigma[:, None, :] ** 2,
    )
    if "rejected" in table.header:
        found = found.select(np.array([text != "1" for text in table.text("rejected")], dtype=bool))
    return found


@dataclass
class _Table:
    """A CSV table and the line of each of its rows."""

    path: Path
    header: list[str]
    rows: list[tuple[int, list[str]]]  # line number and cells
    last: int  # number of the last line

    @classmethod
    def of(cls, path: Path, needed: tuple[str, ...]) -> _Table:
        try:
            with Path(path).open(encoding="utf-8-sig", newline="") as file:
                reader = csv.reader(file, strict=True)
                lines = [(reader.line_num, row) for row in reader if row]
        except OSError as error:
            raise SurveyFileError(f"{path}: cannot be read ({error.strerror})") from error
        except (csv.Error, UnicodeDecodeError) as error:
            raise SurveyFileError(f"{path}, line {reader.line_num + 1}: not a CSV table ({error})") from error
        if not lines:
            raise SurveyFileError(f"{path}, line 1: the table is empty")
        header = [cell.strip() for cell in lines[0][1]]
        missing = [name for name in needed if name not in header]
        if missing:
            raise SurveyFileError(
                f"{path}, line {lines[0][0]}: no column {missing[0]}, needed {','.join(needed)}"
            )
        table = cls(path, header, lines[1:], lines[-1][0])
        for row in table.rows:
            if len(row[1]) != len(header):
                raise table.error(row, f"{len(row[1])} cells, the header has {len(header)}")
        return table

    def error(self, row: tuple[int, list[str]], message: str) -> SurveyFileError:
        return SurveyFileError(f"{self.path}, line {row[0]}: {message}")

    def text(self, name: str) -> list[str]:
        k = self.header.index(name)
        return [cells[k].strip() for _, cells in self.rows]

    def keys(self, name: str) -> tuple[str, ...]:
        """Cells of a column in which none may stand twice or be empty."""
        known: set[str] = set()
        for row, key in zip(self.rows, self.text(name), strict=True):
            if key in known or not key:
                raise self.error(row, f"{name} '{key}' stands twice" if key else f"{name} is empty")
            known.add(key)
        return tuple(self.text(name))

    def numbers(self, names: Sequence[str], *, empty: bool = False) -> FloatArray:
        """Columns of finite numbers; with `empty`, a cell without one is NaN."""
        columns = [self.header.index(name) for name in names]
        out = np.empty((len(self.rows), len(names)))
        for k, row in enumerate(self.rows):
            for c, column in enumerate(columns):
                cell = row[1][column].strip()
                try:
                    value = np.nan if empty and not cell else float(cell)
                except ValueError:
                    value = np.inf
                if not (np.isfinite(value) or (empty and not cell)):
                    raise self.error(row, f"{names[c]} '{cell[:40]}' is not a number")
                out[k, c] = value
        return out

    def maybe_numbers(self, names: tuple[str, ...]) -> FloatArray | None:
        return self.numbers(names, empty=True) if set(names) <= set(self.header) else None


def _sigma_of(covariance: FloatArray | None, count: int) -> FloatArray:
    if covariance is None:
        return np.full((count, 3), np.nan)
    return np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))


def _write(path: Path, header: str, rows: Iterable[Sequence[object]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header.split(","))
        writer.writerows([_cell(value) for value in row] for row in rows)


def _cell(value: object) -> str:
    if isinstance(value, float | np.floating):
        return repr(float(value)) if np.isfinite(value) else ""
    return str(value)
