"""A survey result as CSV tables, and the targets measured in its photographs.

These are the tables that `kolinear run` writes, see `sfm.files.result_tables`; other columns are ignored.
Sizes and pixels missing in a summary are taken from the COLMAP model in the folder `colmap`.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from adapters.colmap.camera_models import SIDE_FILE, NamedCamera, read_side_file
from adapters.formats.content import Content
from adapters.formats.control_tables import Statistics, read_given, read_known_points, write_given
from sfm.files import result_tables as tables
from sfm.files.covariance_file import (
    read_covariance,
    read_covariances,
    write_covariance,
    write_covariances,
)
from sfm.files.csv_tables import CsvTable
from sfm.files.open_folders import disk_errors, refuse_links_out
from sfm.files.plain_text import Content as Json
from sfm.files.plain_text import Name, Pixel, Side, Text, as_plain, or_none, read_json
from sfm.files.result_tables import TARGETS, read_rigs, write_rigs
from sfm.model.camera import Camera
from sfm.model.conventions import BoolArray, FloatArray, rotation_from_angles
from sfm.model.distortion.models import MODELS
from sfm.model.errors import OutputError, SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, InteriorObservations, Network, Source
from sfm.model.reduced_network import CORRELATION_LIMIT
from sfm.model.remarks.remark import Remark
from sfm.model.remarks.row import Quantity
from sfm.model.remarks.verdict import Verdict
from sfm.model.solution import MEASURED, SeenTargets, Solution

SIGMAS, SIGMAS_PX = ("sX", "sY", "sZ"), ("sx_px", "sy_px")
PRINCIPAL_DISTANCES = ("c", "fx", "fy")
COLMAP_SIDE_FILE = f"colmap/{SIDE_FILE}"


def read_result(folder: Path) -> Solution:
    """Read the tables of a result, without rejected image points, and its verdict.

    The verdict is None if the result was not judged, or by a version with other kinds of remarks.

    Raises:
        SurveyFileError: with file and line number.
    """
    refuse_links_out(folder, COLMAP_SIDE_FILE)
    path = folder / "summary.json"
    if not path.exists():
        raise SurveyFileError(f"{folder}: not the folder of a result, {path.name} is missing")
    summary = read_json(path, _Summary, "the summary of a result")
    for name, count in Counter(camera.name for camera in summary.cameras).items():
        if count > 1:
            raise SurveyFileError(f"{path}: camera '{name}' is a duplicate")
    cameras, sigmas = _cameras(folder, summary)
    names = [camera.name for camera in cameras]
    table = tables.IMAGES.read(folder)
    images, camera = table.keys("image"), table.places("camera", names, "cameras.csv")
    angles = np.deg2rad(table.values[:, 3:6])
    rotation = np.array([rotation_from_angles(*row) for row in angles]).reshape(-1, 3, 3)
    position, position_covariance = table.values[:, :3].copy(), _covariance(table, table.values[:, 6:])
    table = tables.POINTS.read(folder)
    points = table.keys("id")
    sources = tuple(source.content for source in summary.sources) or Network.sources
    seen, rejected = _image_points(folder, images, points, sources)
    network = Network(images, camera, points, seen.select(~rejected), sources=sources)
    mounts, moment = read_rigs(folder, names, network)
    network = replace(network, moment=moment)
    known = table.values.shape[1] > 3
    joint, of_points = read_covariance(folder, points, table.values[:, 3:]) if known else (None, None)
    result = Solution(
        summary.survey or folder.name,
        network,
        Estimate(cameras, position, rotation, table.values[:, :3].copy(), mounts),
        _covariance(table, table.values[:, 3:]),
        position_covariance,
        sigmas,
        summary.redundancy,
        summary.length_unit or "",
        joint,
        summary.datum.kind if summary.datum else "",
        covariance_points=of_points,
        judged=None if summary.verdict is None else summary.verdict.content,
    )
    return read_covariances(folder, result)


def read_image_points(folder: Path, network: Network) -> tuple[ImagePoints, BoolArray, FloatArray]:
    """Read all image points of a result, including rejected ones.

    Args:
        folder: folder of the result.
        network: network of the result from `read_result`.

    Returns:
        The k image points, which of them were rejected, and Baarda's w of both coordinates (k, 2), NaN
        without reliability.csv.

    Raises:
        SurveyFileError: with file and line number.
    """
    seen, rejected = _image_points(folder, network.images, network.points, network.sources)
    path = folder / tables.RELIABILITY.file
    if not path.is_file():
        return seen, rejected, np.full((len(seen), 2), np.nan)
    table = tables.RELIABILITY.read(folder)
    keys = [(network.images[i], network.points[j]) for i, j in zip(seen.image, seen.point, strict=True)]
    if keys != list(zip(*table.texts, strict=True)):
        raise SurveyFileError(f"{path}: its rows are not those of image_points.csv beside it")
    return seen, rejected, table.values


def read_scale_sources(folder: Path) -> tuple[tuple[str, ...] | None, tuple[str, ...]]:
    """Read which given values scaled a result, from given.csv.

    Args:
        folder: folder of the result.

    Returns:
        "start - end" of its scale bars, None without given.csv, and the names of its control points.

    Raises:
        SurveyFileError: the table is damaged.
    """
    path = folder / tables.GIVEN.file
    if not path.is_file():
        return None, ()
    if not path.read_text(encoding="utf-8").strip().partition("\n")[2]:
        return (), ()
    kinds, names, _ = tables.GIVEN.read(folder).texts
    named = {
        kind: tuple(dict.fromkeys(n for k, n in zip(kinds, names, strict=True) if k == kind))
        for kind in ("scale bar", "control point")
    }
    return named["scale bar"], named["control point"]


def write_tables(folder: Path, result: Solution) -> None:
    """Write a result like `write_content`."""
    write_content(folder, Content(result))


def write_content(folder: Path, content: Content) -> None:
    """Write a result as tables with named columns; standard deviations only if any is known.

    Args:
        folder: created if it does not exist.
        content: complete; for a folder written whole or not at all, pass one of `sfm.files.whole_files`.

    Raises:
        OutputError: a photograph or point has no coordinates, or the folder cannot be written.
    """
    result = content.result
    network, estimate = result.network, result.estimate
    for names, placed, kind in (
        (network.images, estimate.oriented, "photograph"),
        (network.points, estimate.determined, "point"),
    ):
        for k in np.flatnonzero(~placed)[:1]:
            raise OutputError(f"{folder}: {kind} {names[k]} has no coordinates, which tables require of all")
    seen = network.image_points
    if len(content.rejected):
        seen = ImagePoints.joined([seen, content.rejected])
    summary: dict[str, Any] = {
        "survey": result.name,
        "redundancy": result.redundancy,
        "length_unit": result.unit,
        "datum": {"kind": result.datum},
        "sigma0": None if content.sigma0 is None else or_none(content.sigma0),
        "sigma0_px": None if content.sigma0_px is None else or_none(content.sigma0_px),
        "verdict": None if result.verdict is None else result.verdict.entry,
        "sources": [
            {name: getattr(source, name) for name in _SourceEntry.model_fields} for source in network.sources
        ],
        "cameras": [
            {
                "name": camera.name,
                "model": camera.model,
                "size_px": list(camera.size_px),
                "pixel_mm": [float(value) for value in camera.pixel_mm],
                "free": [name for name, free in zip(camera.names, camera.free, strict=True) if free],
            }
            for camera in estimate.cameras
        ],
    }
    with disk_errors(f"{folder}: the tables cannot be written"):
        folder.mkdir(parents=True, exist_ok=True)
        tables.write_solution(folder, result, seen, np.arange(len(seen)) >= len(network.image_points))
        if result.covariance is not None:
            write_covariance(folder, result.covariance, network.points, result.covariance_points)
        write_rigs(folder, result)
        full = (result.exterior_covariance, result.rig_covariance)
        if any(Q is not None for Q in full) or any(map(len, result.interior_covariance)):
            write_covariances(folder, result)
        write_given(folder, network, estimate, result.unit)
        text = json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False)
        (folder / "summary.json").write_text(text + "\n", encoding="utf-8")


def read_content(folder: Path) -> Content:
    """Read the tables of a result, with everything given, rejected and estimated.

    Raises:
        SurveyFileError: with file and line number.
    """
    result = read_result(folder)
    network = result.network
    seen, rejected, _ = read_image_points(folder, network)
    given = read_given(folder, network)
    control, checks = read_known_points(folder, network, given.control)
    cameras = _with_shared(result)
    # each parameter belongs to a camera and to those that share it, of which the first observes it
    column_of: dict[tuple[str, str], tuple[int, int]] = {}
    for k, camera in enumerate(cameras):
        for p, parameter in enumerate(camera.names):
            column_of.setdefault((camera.owner_of(p), parameter), (k, p))
    interior = []
    for owner, parameter, value, sigma in given.interior:
        if (owner, parameter) not in column_of:
            raise SurveyFileError(
                f"{folder}/given.csv: {parameter} of camera '{owner}', which is not in cameras.csv"
            )
        interior.append((*column_of[owner, parameter], value, sigma))
    rows = np.array(interior, dtype=float).reshape(-1, 4)
    network = network.with_given(
        control,
        given.exterior,
        InteriorObservations(
            rows[:, 0].astype(np.int64), rows[:, 1].astype(np.int64), rows[:, 2], rows[:, 3]
        ),
        given.bars,
    )
    summary = read_json(folder / "summary.json", Statistics, "the summary of a result")
    return Content(
        replace(result, network=network, estimate=replace(result.estimate, cameras=cameras)),
        seen.select(rejected),
        checks,
        summary.sigma0,
        summary.sigma0_px,
    )


def _with_shared(result: Solution) -> tuple[Camera, ...]:
    """Return the cameras, with the parameters shared by cameras of single photographs marked as shared.

    A survey with `per_photograph` names such cameras by camera and photograph, and their shared parameters
    have equal values.
    """
    network, cameras = result.network, result.estimate.cameras
    base: dict[str, list[int]] = {}
    for i, k in enumerate(network.camera):
        name, ending = cameras[k].name, f" {network.images[i]}"
        if name.endswith(ending) and (network.camera == k).sum() == 1:
            base.setdefault(name.removesuffix(ending), []).append(int(k))
    made = list(cameras)
    for name, members in base.items():
        models = {(cameras[k].model, cameras[k].size_px) for k in members}
        if len(members) < 2 or len(models) > 1:
            continue
        values = np.array([cameras[k].parameters for k in members])
        equal = (values == values[0]).all(axis=0)
        if not equal.any() or equal.all():
            continue
        shared = tuple(name if same else "" for same in equal)
        for k in members:
            made[k] = replace(cameras[k], shared=shared)
    return tuple(made)


class _CameraEntry(Json):
    """A camera in the summary."""

    name: Name
    model: Literal[tuple(MODELS)]  # type: ignore[valid-type]
    size_px: tuple[Side, Side] | None = None
    pixel_mm: tuple[Pixel, Pixel] | None = None
    free: tuple[Name, ...] | None = None  # None: the parameters with a sigma


class _DatumEntry(Json):
    """The datum in the summary."""

    kind: Literal["free", "minimal", "control", ""]


class _QuantityEntry(Json):
    """A number of a remark; None if it is not finite."""

    value: float | None = None
    unit: str = ""


class _RemarkEntry(Json):
    """A remark, or a row of the table of tests."""

    kind: str
    severity: Literal["note", "warning", "error"] = "note"
    subjects: dict[str, tuple[str, ...]] = Field(default_factory=dict)
    numbers: dict[str, _QuantityEntry] = Field(default_factory=dict)

    @property
    def content(self) -> Remark:
        """The remark; names that are not plain are replaced."""
        return Remark(
            self.kind,
            {role: tuple(map(as_plain, names)) for role, names in self.subjects.items()},
            {
                name: Quantity(
                    math.nan if quantity.value is None else quantity.value, as_plain(quantity.unit)
                )
                for name, quantity in self.numbers.items()
            },
            self.severity,
        )


class _VerdictEntry(Json):
    """The verdict on a result."""

    level: Literal["good", "fair", "bad"]
    headline: str
    remarks: tuple[_RemarkEntry, ...] = ()
    tests: tuple[_RemarkEntry, ...] = ()

    @property
    def content(self) -> Verdict | None:
        """The verdict; None if a remark has a kind or parts that this version does not know."""
        remarks, tests = (tuple(remark.content for remark in kind) for kind in (self.remarks, self.tests))
        if not all(remark.is_known for remark in (*remarks, *tests)):
            return None
        return Verdict(self.level, as_plain(self.headline), remarks, tests)


class _SourceEntry(Json):
    name: Text
    names_last: bool
    has_common_errors: bool = False
    design_effect: Annotated[float, Field(ge=1, allow_inf_nan=False)] = 1.0

    @property
    def content(self) -> Source:
        """The source; what only its measurement needs is not in the summary."""
        return Source(
            self.name,
            self.names_last,
            has_common_errors=self.has_common_errors,
            design_effect=self.design_effect,
        )


class _Summary(Json):
    """The part of summary.json that is read."""

    survey: Text | None = None
    length_unit: Text | None = None
    datum: _DatumEntry | None = None
    redundancy: Annotated[int, Field(ge=0, strict=True)] | None = None
    cameras: tuple[_CameraEntry, ...]  # none of points alone
    sources: tuple[_SourceEntry, ...] = ()
    verdict: _VerdictEntry | None = None


def _cameras(folder: Path, summary: _Summary) -> tuple[tuple[Camera, ...], tuple[FloatArray, ...]]:
    """Return the cameras in the order of the summary, and the sigmas of their parameters."""
    table = tables.CAMERAS.read(folder)
    values, sigma = table.values[:, 0], table.values[:, 1:]
    table.refuse(sigma, sigma < 0, ("sigma",), "0 or more, or nothing")
    keys = tuple(zip(*table.texts, strict=True))
    table.refuse_duplicates(keys, ("camera", "parameter"))
    positive = np.array([name in PRINCIPAL_DISTANCES for name in table.texts[1]], dtype=bool)
    table.refuse(values[:, None], (positive & (values <= 0))[:, None], ("value",), "a positive c, fx or fy")
    rows = {key: k for k, key in enumerate(keys)}
    table.places("camera", [camera.name for camera in summary.cameras], "summary.json")
    cameras, sigmas = [], []
    complete = all(entry.size_px is not None and entry.pixel_mm is not None for entry in summary.cameras)
    beside = () if complete else read_side_file(folder / COLMAP_SIDE_FILE).cameras
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
        free = np.isfinite(s) if entry.free is None else np.array([name in entry.free for name in names])
        cameras.append(Camera(entry.name, entry.model, size, pixel, values[chosen], free))
        sigmas.append(s)
    return tuple(cameras), tuple(sigmas)


def _size(
    folder: Path, entry: _CameraEntry, beside: tuple[NamedCamera, ...]
) -> tuple[tuple[int, int], FloatArray]:
    """Return size and pixel of a camera, from the summary or else from the COLMAP model beside it."""
    size, pixel = entry.size_px, entry.pixel_mm
    if beside and (size is None or pixel is None):
        size, pixel = beside[0].size_px, beside[0].pixel_mm
    if size is None or pixel is None:
        raise SurveyFileError(
            f"{folder}: neither summary.json nor {COLMAP_SIDE_FILE} states size and pixel of camera "
            f"{entry.name}"
        )
    return size, np.array(pixel)


def _image_points(
    folder: Path, images: tuple[str, ...], points: tuple[str, ...], sources: tuple[Source, ...]
) -> tuple[ImagePoints, BoolArray]:
    """Read the image points, and which of them were rejected."""
    table = tables.IMAGE_POINTS.read(folder)
    table.refuse_duplicates(tuple(zip(*table.texts[:2], strict=True)), ("image", "point"))
    image = table.places("image", images, "images.csv")
    point = table.places("point", points, "points.csv")
    rejected, sigma = np.nan_to_num(table.part(("rejected",))), table.part(SIGMAS_PX)
    table.refuse(rejected, (rejected != 0) & (rejected != 1), ("rejected",), "0 or 1")
    table.refuse(sigma, sigma <= 0, SIGMAS_PX, "more than 0")
    stated = np.asarray(np.isfinite(sigma).all(axis=1))
    sigma = np.where(stated[:, None], sigma, 1.0)
    covariance = np.eye(2) * sigma[:, None, :] ** 2
    mixed = np.where(stated[:, None], np.nan_to_num(table.part(("cxy_px2",))), 0.0)
    largest = CORRELATION_LIMIT * sigma.prod(axis=1, keepdims=True)
    table.refuse(mixed, np.abs(mixed) > largest, ("cxy_px2",), "a correlation below 1 with the sigmas")
    covariance += (1 - np.eye(2)) * mixed[:, :, None]
    source = None
    if len(table.texts) > 2:
        source = table.places("source", [declared.name for declared in sources], "summary.json")
    image_points = ImagePoints(image, point, table.values[:, :2].copy(), covariance, stated, source)
    return image_points, rejected[:, 0] == 1


def _covariance(table: CsvTable, sigma: FloatArray) -> FloatArray | None:
    """Return diagonal covariances (n, 3, 3) from columns sX, sY, sZ; None if all are empty."""
    table.refuse(sigma, sigma < 0, SIGMAS, "0 or more, or nothing")
    return np.eye(3) * sigma[:, None, :] ** 2 if np.isfinite(sigma).any() else None


def read_targets(folder: Path, network: Network) -> SeenTargets | None:
    """Read the targets and rejected candidates of a result; None if it has no such table.

    Args:
        folder: folder of the result.
        network: network of the result from `read_result`.

    Raises:
        SurveyFileError: with file and line number.
    """
    path = folder / TARGETS.file
    if not path.is_file():
        return None
    table = TARGETS.read(folder)
    image, reasons = table.places("image", network.images, "images.csv"), table.texts[1]
    axes = table.values[:, 2:4]
    table.refuse(axes, axes <= 0, ("a_px", "b_px"), "more than 0, or nothing")
    ellipse = np.column_stack([axes, np.deg2rad(table.values[:, 4])])
    for line, reason, outline in zip(table.line, reasons, ellipse, strict=True):
        if reason == MEASURED and not np.isfinite(outline).all():
            raise SurveyFileError(f"{path}, line {line}: a measured target without a_px, b_px and angle_deg")
    return SeenTargets(
        image,
        table.values[:, :2].copy(),
        ellipse,
        tuple("" if reason == MEASURED else reason for reason in reasons),
    )
