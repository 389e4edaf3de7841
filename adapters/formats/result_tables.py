"""A survey's result as CSV tables with named columns, read and written.

    points.csv          id,X,Y,Z[,sX,sY,sZ]
    images.csv          image,X,Y,Z,omega_deg,phi_deg,kappa_deg[,sX,sY,sZ],camera
    cameras.csv         camera,parameter,value[,sigma],unit
    image_points.csv    image,point,x_px,y_px[,sx_px,sy_px[,cxy_px2]][,rejected]
    point_covariance.npy    of the points together, see `sfm.files.covariance_file`
    summary.json        name of the survey, model, size and pixel of each camera, redundancy, datum

These are the tables that `kolinear run` writes; other columns are passed over. What a summary does not say of
size and pixel is taken from the COLMAP model in the folder `colmap`.

Source: RFC 4180 for CSV; the columns are described in the README.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from adapters.colmap.names import SIDE_FILE, NamedCamera, read_side_file
from sfm.camera import Camera
from sfm.conventions import BoolArray, FloatArray, angles_from_rotation, rotation_from_angles
from sfm.distortion.models import MODELS
from sfm.errors import OutputError, SurveyFileError
from sfm.files.covariance_file import read_covariance, write_covariance
from sfm.files.csv_tables import CsvTable, read_header, read_table
from sfm.files.json_files import Content, Name, Pixel, Side, Text, read_json
from sfm.files.plain_text import csv_text
from sfm.network import Estimate, ImagePoints, Network
from sfm.stored_result import StoredResult

EXTERIOR = ("X", "Y", "Z", "omega_deg", "phi_deg", "kappa_deg")
SIGMAS = ("sX", "sY", "sZ")
SIGMAS_PX = ("sx_px", "sy_px")
COVARIANCE_PX = "cxy_px2"
CORRELATION_LIMIT = 0.999999  # beyond it a covariance matrix is no longer regular in floating point
PRINCIPAL_DISTANCES = ("c", "fx", "fy")
COLMAP_SIDE_FILE = f"colmap/{SIDE_FILE}"


def read_result(folder: Path) -> StoredResult:
    """Read the tables of a result, rejected image points left out.

    Raises:
        SurveyFileError: what is missing or wrong, with file and line number.
    """
    summary = _summary(folder / "summary.json")
    cameras, sigmas = _cameras(folder, summary)
    index = {camera.name: k for k, camera in enumerate(cameras)}
    table = read_table(
        folder / "images.csv", ("image", "camera"), EXTERIOR, SIGMAS, ignored=None, blank=SIGMAS
    )
    images = table.keys("image")
    for line, name in zip(table.line, table.texts[1], strict=True):
        if name not in index:
            raise SurveyFileError(f"{table.path}, line {line}: camera '{name}' is not in cameras.csv")
    camera = np.array([index[name] for name in table.texts[1]], dtype=np.int64)
    rotation = np.array([rotation_from_angles(*np.deg2rad(row)) for row in table.values[:, 3:6]])
    position, position_covariance = table.values[:, :3].copy(), _covariance(table, table.values[:, 6:])
    table = read_table(folder / "points.csv", ("id",), ("X", "Y", "Z"), SIGMAS, ignored=None, blank=SIGMAS)
    points = table.keys("id")
    seen, rejected = _image_points(folder, images, points)
    network = Network(images, camera, points, seen.select(~rejected))
    known = table.values.shape[1] > 3
    joint, of_points = read_covariance(folder, points, table.values[:, 3:]) if known else (None, None)
    return StoredResult(
        summary.survey or folder.name,
        network,
        Estimate(cameras, position, rotation, table.values[:, :3].copy()),
        _covariance(table, table.values[:, 3:]),
        position_covariance,
        sigmas,
        summary.redundancy,
        summary.length_unit or "",
        joint,
        summary.datum.kind if summary.datum else "",
        covariance_points=of_points,
    )


def read_image_points(folder: Path, network: Network) -> tuple[ImagePoints, BoolArray, FloatArray]:
    """Read all image points of a result, rejected ones included.

    Args:
        folder: of the result.
        network: what `read_result` has read of it.

    Returns:
        The k image points, which of them were rejected, and Baarda's w of both coordinates (k, 2), NaN where
        there is no reliability.csv.

    Raises:
        SurveyFileError: what is missing or wrong, with file and line number.
    """
    seen, rejected = _image_points(folder, network.images, network.points)
    path = folder / "reliability.csv"
    if not path.is_file():
        return seen, rejected, np.full((len(seen), 2), np.nan)
    columns = ("wx", "wy")
    table = read_table(path, ("image", "point"), columns, ignored=None, blank=columns)
    keys = [(network.images[i], network.points[j]) for i, j in zip(seen.image, seen.point, strict=True)]
    if keys != list(zip(*table.texts, strict=True)):
        raise SurveyFileError(f"{path}: its rows are not those of image_points.csv beside it")
    return seen, rejected, table.values


def read_scale_sources(folder: Path) -> tuple[tuple[str, ...] | None, tuple[str, ...]]:
    """Read what gave a result its scale, from given.csv.

    Args:
        folder: of the result.

    Returns:
        "start - end" of its scale bars, None without a given.csv, and the names of its control points.

    Raises:
        SurveyFileError: the table is damaged.
    """
    path = folder / "given.csv"
    if not path.is_file():
        return None, ()
    if not path.read_text(encoding="utf-8").strip().partition("\n")[2]:
        return (), ()
    table = read_table(path, ("kind", "name"), (), ignored=None)
    kinds, names = table.texts
    found = {
        kind: tuple(dict.fromkeys(n for k, n in zip(kinds, names, strict=True) if k == kind))
        for kind in ("scale bar", "control point")
    }
    return found["scale bar"], found["control point"]


def write_tables(folder: Path, result: StoredResult) -> None:
    """Write a result as tables with named columns; standard deviations only where any is known.

    Args:
        folder: made if it is not there.
        result: complete; whoever wants the folder whole or not at all gives one of `sfm.files.whole_files`.

    Raises:
        OutputError: a photograph or point has no place in the object, or the folder cannot be written.
    """
    network, estimate = result.network, result.estimate
    for names, placed, kind in (
        (network.images, estimate.oriented, "photograph"),
        (network.points, estimate.determined, "point"),
    ):
        for k in np.flatnonzero(~placed)[:1]:
            raise OutputError(f"{folder}: {kind} {names[k]} has no coordinates, tables want them of all")
    angles = np.rad2deg(angles_from_rotation(estimate.rotation))
    point_sigma, sigmas_of_points = _sigma_of(result.point_covariance, len(network.points))
    position_sigma, sigmas_of_images = _sigma_of(result.position_covariance, len(network.images))
    seen = network.image_points
    sigma = seen.stated_sigma
    sigmas_of_image_points: tuple[str, ...] = SIGMAS_PX if np.isfinite(sigma).any() else ()
    sigma = sigma[:, : len(sigmas_of_image_points)]
    if seen.stated_covariance.any():
        sigmas_of_image_points += (COVARIANCE_PX,)
        sigma = np.concatenate([sigma, seen.stated_covariance[:, None]], axis=1)
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
        "datum": {"kind": result.datum},
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
            ("id", "X", "Y", "Z", *sigmas_of_points),
            ((n, *x, *s) for n, x, s in zip(network.points, estimate.points, point_sigma, strict=True)),
        )
        _write(
            folder / "images.csv",
            ("image", *EXTERIOR, *sigmas_of_images, "camera"),
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
        _write(folder / "cameras.csv", ("camera", "parameter", "value", "sigma", "unit"), camera_rows)
        _write(
            folder / "image_points.csv",
            ("image", "point", "x_px", "y_px", *sigmas_of_image_points),
            (
                (network.images[i], network.points[j], *xy, *s)
                for i, j, xy, s in zip(seen.image, seen.point, seen.xy, sigma, strict=True)
            ),
        )
        if result.covariance is not None:
            write_covariance(folder, result.covariance, network.points, result.covariance_points)
        text = json.dumps(summary, indent=2, ensure_ascii=False)
        (folder / "summary.json").write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{folder}: the tables cannot be written: {error.strerror}") from error


class _CameraEntry(Content):
    """A camera as the summary names it."""

    name: Name
    model: Literal[tuple(MODELS)]  # type: ignore[valid-type]
    size_px: tuple[Side, Side] | None = None
    pixel_mm: tuple[Pixel, Pixel] | None = None


class _DatumEntry(Content):
    """The datum as the summary names it."""

    kind: Literal["free", "minimal", "control", ""]


class _Summary(Content):
    """What is read of summary.json."""

    survey: Text | None = None
    length_unit: Text | None = None
    datum: _DatumEntry | None = None
    redundancy: Annotated[int, Field(ge=0, strict=True)] | None = None
    cameras: Annotated[tuple[_CameraEntry, ...], Field(min_length=1)]


def _summary(path: Path) -> _Summary:
    """Read the summary, in which no camera may occur twice."""
    summary = read_json(path, _Summary, "the summary of a result")
    names = [camera.name for camera in summary.cameras]
    for name, count in Counter(names).items():
        if count > 1:
            raise SurveyFileError(f"{path}: camera '{name}' is a duplicate")
    return summary


def _cameras(folder: Path, summary: _Summary) -> tuple[tuple[Camera, ...], tuple[FloatArray, ...]]:
    """Cameras in the order of the summary, and the sigmas of their parameters."""
    table = read_table(
        folder / "cameras.csv",
        ("camera", "parameter"),
        ("value",),
        ("sigma",),
        ignored=None,
        blank=("sigma",),
    )
    values, sigma = table.values[:, 0], table.values[:, 1:]
    table.refuse(sigma, sigma < 0, ("sigma",), "0 or more, or nothing")
    keys = tuple(zip(*table.texts, strict=True))
    table.refuse_duplicates(keys, ("camera", "parameter"))
    positive = np.array([name in PRINCIPAL_DISTANCES for name in table.texts[1]])
    table.refuse(values[:, None], (positive & (values <= 0))[:, None], ("value",), "a positive c, fx or fy")
    rows = {key: k for k, key in enumerate(keys)}
    known = {camera.name for camera in summary.cameras}
    for line, name in zip(table.line, table.texts[0], strict=True):
        if name not in known:
            raise SurveyFileError(f"{table.path}, line {line}: camera '{name}' is not in summary.json")
    cameras, sigmas = [], []
    told = all(entry.size_px is not None and entry.pixel_mm is not None for entry in summary.cameras)
    beside = () if told else read_side_file(folder / COLMAP_SIDE_FILE).cameras
    for number, entry in enumerate(summary.cameras):
        names = MODELS[entry.model].names
        missing = [p for p in names if (entry.name, p) not in rows]
        if missing:
            raise SurveyFileError(
                f"{table.path}, line {table.line[-1]}: {missing[0]} of camera {entry.name} is missing"
            )
        chosen = [rows[entry.name, p] for p in names]
        s = sigma[chosen, 0] if sigma.size else np.full(len(chosen), np.nan)
        size, pixel = _size(folder, entry, beside[number : number + 1])
        cameras.append(Camera(entry.name, entry.model, size, pixel, values[chosen], np.isfinite(s)))
        sigmas.append(s)
    return tuple(cameras), tuple(sigmas)


def _size(
    folder: Path, entry: _CameraEntry, beside: tuple[NamedCamera, ...]
) -> tuple[tuple[int, int], FloatArray]:
    """Size and pixel of a camera, from the summary or else from that of the COLMAP model beside it."""
    size, pixel = entry.size_px, entry.pixel_mm
    if beside and (size is None or pixel is None):
        size, pixel = beside[0].size_px, beside[0].pixel_mm
    if size is None or pixel is None:
        raise SurveyFileError(
            f"{folder}: neither summary.json nor {COLMAP_SIDE_FILE} tells size and pixel of camera "
            f"{entry.name}"
        )
    return size, np.array(pixel)


def _image_points(
    folder: Path, images: tuple[str, ...], points: tuple[str, ...]
) -> tuple[ImagePoints, BoolArray]:
    """Read the image points, and which of them were rejected."""
    path = folder / "image_points.csv"
    flagged = ("rejected",) if "rejected" in read_header(path) else ()
    header, sigmas = read_header(path), SIGMAS_PX
    with_covariance = sigmas[0] in header and COVARIANCE_PX in header
    optional = (*sigmas, COVARIANCE_PX) if with_covariance else sigmas
    table = read_table(
        path, ("image", "point"), ("x_px", "y_px", *flagged), optional, ignored=None, blank=optional
    )
    table.refuse_duplicates(tuple(zip(*table.texts, strict=True)), ("image", "point"))
    index = []
    files = ("images.csv", "points.csv")
    for column, names, known, file in zip(table.names, table.texts, (images, points), files, strict=True):
        place = {name: k for k, name in enumerate(known)}
        for line, name in zip(table.line, names, strict=True):
            if name not in place:
                raise SurveyFileError(f"{path}, line {line}: {column} '{name}' is not in {file}")
        index.append(np.array([place[name] for name in names], dtype=np.int64))
    rejected, sigma, mixed = np.split(table.values[:, 2:], (len(flagged), len(flagged) + 2), axis=1)
    table.refuse(rejected, (rejected != 0) & (rejected != 1), flagged, "0 or 1")
    table.refuse(sigma, sigma <= 0, sigmas, "more than 0")
    sigma = sigma if sigma.size else np.full((len(table.line), 2), np.nan)
    image, point = index
    stated = np.asarray(np.isfinite(sigma).all(axis=1))
    sigma = np.where(stated[:, None], sigma, 1.0)
    covariance = np.eye(2) * sigma[:, None, :] ** 2
    if with_covariance:
        mixed = np.where(stated[:, None], np.nan_to_num(mixed), 0.0)
        largest = CORRELATION_LIMIT * sigma.prod(axis=1, keepdims=True)
        table.refuse(
            mixed, np.abs(mixed) > largest, (COVARIANCE_PX,), "a correlation below 1 with the sigmas"
        )
        covariance += (1 - np.eye(2)) * mixed[:, :, None]
    found = ImagePoints(image, point, table.values[:, :2].copy(), covariance, stated)
    return found, rejected[:, 0] == 1 if flagged else np.zeros(len(found), dtype=bool)


def _covariance(table: CsvTable, sigma: FloatArray) -> FloatArray | None:
    """Diagonal covariances (n, 3, 3) of columns sX, sY, sZ; None where no row has any."""
    table.refuse(sigma, sigma < 0, SIGMAS, "0 or more, or nothing")
    return np.eye(3) * sigma[:, None, :] ** 2 if np.isfinite(sigma).any() else None


def _sigma_of(covariance: FloatArray | None, count: int) -> tuple[FloatArray, tuple[str, ...]]:
    """Standard deviations and the names of their columns, none where none is known."""
    if covariance is None or not np.isfinite(covariance).any():
        return np.empty((count, 0)), ()
    return np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)), SIGMAS


def _write(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    path.write_text(csv_text(header, rows), encoding="utf-8", newline="")
