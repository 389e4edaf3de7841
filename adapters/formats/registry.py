"""The formats of other programs by name: which file is which, what each can hold, reading and writing.

Source: the module of each format names its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from adapters.colmap.camera_models import read_model, write_model
from adapters.colmap.database import read_database, write_database
from adapters.formats.bal import read_bal, write_bal
from adapters.formats.bundle_text import (
    INTERIOR,
    read_bundle_csharp,
    read_bundle_matlab_folder,
    write_bundle_csharp,
    write_bundle_matlab_folder,
)
from adapters.formats.lines import Lines
from adapters.formats.metashape import read_metashape, write_metashape
from adapters.formats.photomodeler import read_photomodeler, write_photomodeler
from adapters.formats.ply import write_ply
from adapters.formats.result_tables import TableResult, read_result, write_tables
from adapters.formats.sba_text import read_sba_text, sba_files, write_sba_text
from sfm.camera import Camera
from sfm.distortion.models import MODELS
from sfm.errors import KolinearError, OutputError, SurveyFileError
from sfm.files.whole_files import whole_folder
from sfm.network import Estimate, Network, empty_estimate, reduce_network


@dataclass(frozen=True)
class FileFormat:
    """What is known of a format."""

    name: str  # as --from and --to say it
    models: tuple[str, ...]  # camera models that it can hold, the most capable first; empty: no cameras
    folder: bool  # whether it is a folder of files
    readable: bool
    lacks: tuple[str, ...] = ()  # parameters of these models that it has no place for, others can stand in
    straight: tuple[str, ...] = ()  # parameters that it has no place for and nothing can stand in


_OPENCV_DISTORTION = ("k1", "k2", "p1", "p2")
_BROWN_DISTORTION = MODELS["brown"].names[3:]
FORMATS = (
    FileFormat("colmap", ("full_opencv", "opencv"), True, True),
    FileFormat("colmap-text", ("full_opencv", "opencv"), True, True),
    FileFormat("colmap-database", ("full_opencv", "opencv"), False, True),
    FileFormat("tables", tuple(MODELS), True, True),
    FileFormat(
        *("metashape", ("brown_forward", "full_opencv", "opencv"), False, True),
        lacks=("b1", "b2", "k4", "k5", "k6"),
    ),
    FileFormat("photomodeler", ("brown",), False, True, lacks=("b1", "b2")),
    FileFormat("bal", ("opencv",), False, True, straight=("p1", "p2")),
    FileFormat("bundle-csharp", ("brown",), False, True, straight=_BROWN_DISTORTION),
    FileFormat("bundle-matlab", ("brown",), True, True, straight=_BROWN_DISTORTION),
    FileFormat("sba", ("opencv",), True, True, straight=_OPENCV_DISTORTION),
    FileFormat("ply", (), False, False),
)
PLACED = ("colmap", "colmap-text", "tables", "ply")  # leave out what has no place in the object
ENDINGS = {".xml": "metashape", ".ply": "ply", ".db": "colmap-database"}


def format_named(name: str) -> FileFormat:
    """Return a format by its name.

    Raises:
        SurveyFileError: there is none of that name.
    """
    found = next((one for one in FORMATS if one.name == name), None)
    if found is None:
        raise SurveyFileError(f"format '{name}' is none of {', '.join(one.name for one in FORMATS)}")
    return found


def format_of(path: Path) -> FileFormat:
    """Return the format of a file or folder that is there, by what it holds.

    Raises:
        SurveyFileError: it is not there, or nothing in it is known.
    """
    if path.is_dir():
        for file, name in (
            ("cameras.bin", "colmap"),
            ("cameras.txt", "colmap-text"),
            ("points.csv", "tables"),
            (INTERIOR, "bundle-matlab"),
        ):
            if (path / file).is_file():
                return format_named(name)
        if any(path.glob("*cams*.txt")):
            return format_named("sba")
        raise SurveyFileError(
            f"{path}: neither a COLMAP model, nor tables of a result, nor files of a bundle program are in "
            "this folder"
        )
    if path.suffix.lower() in ENDINGS:
        return format_named(ENDINGS[path.suffix.lower()])
    text = Lines.of(path)
    counts = [len((text.maybe_line() or "").split()) for _ in range(4)]
    if "cams" in path.name:
        return format_named("sba")
    if counts[2:4] == [9, 10]:
        return format_named("photomodeler")
    if counts[:2] == [3, 4]:
        return format_named("bal")
    if counts[:2] == [4, 7]:
        return format_named("bundle-csharp")
    raise SurveyFileError(
        f"{path}, line 1: this is no format that is known, name it with --from (compare: --from-a, --from-b)"
    )


def read_any(path: Path, name: str | None = None) -> tuple[Network, Estimate]:
    """Read a network and its solution.

    Args:
        path: file or folder.
        name: of the format; found from what is there if not given.

    Raises:
        SurveyFileError: what is wrong, with file and line number.
    """
    form = format_of(path) if name is None else format_named(name)
    if form.name in ("colmap", "colmap-text"):
        return read_model(path, text=form.name == "colmap-text")
    if form.name == "colmap-database":
        network, cameras = read_database(path)
        return network, empty_estimate(network, cameras)
    if form.name == "tables":
        result = read_result(path)
        return result.network, result.estimate
    if form.name == "metashape":
        return read_metashape(path)
    if form.name == "photomodeler":
        return read_photomodeler(path)
    if form.name == "bal":
        return read_bal(path)
    if form.name == "bundle-csharp":
        return read_bundle_csharp(path)
    if form.name == "bundle-matlab":
        return read_bundle_matlab_folder(path)
    if form.name == "sba":
        files = sba_files(path)
        return read_sba_text(*files[:3], sigmas=files[3])
    raise SurveyFileError(f"{path}: format {form.name} holds no photographs, it is written only")


def read_comparable(path: Path, name: str | None = None) -> TableResult:
    """Read whatever can be compared: tables with standard deviations, any other format without.

    Raises:
        SurveyFileError: what is wrong, with file and line number.
    """
    form = format_of(path) if name is None else format_named(name)
    if form.name == "tables":
        return read_result(path)
    if not form.readable:
        raise SurveyFileError(
            f"{path}: format {form.name} holds points only, results with photographs are compared"
        )
    network, estimate = read_any(path, form.name)
    if not (estimate.oriented.any() or estimate.determined.any()):
        raise SurveyFileError(
            f"{path}: {len(network.image_points)} image points as format {form.name}, but no coordinates of "
            "photographs or points that could be compared"
        )
    return TableResult(path.name, network, estimate)


def write_any(path: Path, name: str, network: Network, estimate: Estimate) -> None:
    """Write a network and its solution; cameras must be in a model that the format holds.

    Raises:
        KolinearError: the format cannot hold it, or it cannot be written.
    """
    form = format_named(name)
    if path.exists() and (form.folder != path.is_dir() or (form.folder and any(path.iterdir()))):
        needed = "a new or empty folder" if form.folder else "a new file"
        raise OutputError(f"{path}: it is there already; format {name} needs {needed}")
    _refuse_cameras(form, estimate.cameras)
    if form.name in PLACED:
        points_only = not form.models
        if not (estimate.determined.any() and (points_only or estimate.oriented.any())):
            raise OutputError(
                f"{path}: format {name} holds what has a place in the object, but no "
                f"{'point' if points_only else 'photograph or no point'} has coordinates"
            )
    if form.folder:
        with whole_folder(path) as folder:
            _write_folder(folder, name, path.name, network, estimate)
    elif name == "colmap-database":
        write_database(path, network, estimate.cameras)
    elif name == "metashape":
        write_metashape(path, network, estimate)
    elif name == "photomodeler":
        write_photomodeler(path, network, estimate)
    elif name == "bal":
        write_bal(path, network, estimate)
    elif name == "bundle-csharp":
        write_bundle_csharp(path, network, estimate)
    else:
        write_ply(path, network.points, estimate.points)


def _refuse_cameras(form: FileFormat, cameras: tuple[Camera, ...]) -> None:
    """Raise KolinearError for the first camera that a format cannot hold."""
    for camera in cameras if form.models else ():
        if camera.model not in form.models:
            raise KolinearError(
                f"camera {camera.name}: format {form.name} holds models {', '.join(form.models)}, "
                f"not {camera.model}"
            )
        left = [
            name for name in (*form.lacks, *form.straight) if name in camera.names and camera.value(name) != 0
        ]
        if form.name == "bal" and camera.value("fx") != camera.value("fy"):
            left.append("fx other than fy")
        if left:
            remedy = "; --undistort corrects the image points for it" if form.straight else ""
            raise KolinearError(
                f"camera {camera.name}: format {form.name} has no place for {', '.join(left)} of "
                f"{camera.model}{remedy}"
            )


def written(name: str, network: Network, estimate: Estimate) -> str:
    """Return what of a network a format holds, in words."""
    form = format_named(name)
    if not form.models:
        return f"{int(estimate.determined.sum())} points"
    image_points = f"{len(network.image_points)} image points"
    if name == "colmap-database":
        return f"{len(network.images)} photographs, {image_points}, no coordinates of points"
    images, points = estimate.oriented, estimate.determined
    if name not in PLACED:
        images, points = np.ones_like(images), np.ones_like(points)
    seen = network.image_points
    kept = images[seen.image] & (points[seen.point] | (name != "tables"))
    return f"{int(images.sum())} photographs, {int(points.sum())} points, {int(kept.sum())} image points"


def _write_folder(folder: Path, name: str, title: str, network: Network, estimate: Estimate) -> None:
    """Write the files of a format that is a folder."""
    if name in ("colmap", "colmap-text"):
        write_model(folder, network, estimate, text=name == "colmap-text")
    elif name == "tables":
        every = np.ones(len(network.image_points), dtype=bool)
        placed = reduce_network(network, estimate, estimate.oriented, estimate.determined, every)
        write_tables(folder, TableResult(title, *placed))
    elif name == "bundle-matlab":
        write_bundle_matlab_folder(folder, network, estimate)
    else:
        write_sba_text(folder / "cams.txt", folder / "pts.txt", network, estimate)
