"""The formats of other programs by name: which file is which, what each can hold, reading and writing.

Source: the module of each format names its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from adapters.bal import read_bal, write_bal
from adapters.bundle_text import (
    INTERIOR,
    read_bundle_csharp,
    read_bundle_matlab_folder,
    write_bundle_csharp,
    write_bundle_matlab_folder,
)
from adapters.colmap_database import read_database, write_database
from adapters.colmap_model import read_model, write_model
from adapters.csv_tables import TableResult, read_result, write_tables
from adapters.metashape import read_metashape, write_metashape
from adapters.photomodeler import read_photomodeler, write_photomodeler
from adapters.ply import write_ply
from adapters.sba_text import read_sba_text, sba_files, write_sba_text
from sfm.distortion.models import MODELS
from sfm.errors import KolinearError, OutputError, SurveyFileError
from sfm.network import Estimate, Network, empty_estimate
from sfm.whole_files import whole_folder


@dataclass(frozen=True)
class FileFormat:
    """What is known of a format."""

    name: str  # as --from and --to say it
    models: tuple[str, ...]  # camera models that it can hold, the most capable first; empty: no cameras
    folder: bool  # whether it is a folder of files
    readable: bool


FORMATS = (
    FileFormat("colmap", ("full_opencv", "opencv"), True, True),
    FileFormat("colmap-text", ("full_opencv", "opencv"), True, True),
    FileFormat("colmap-database", ("full_opencv", "opencv"), False, True),
    FileFormat("tables", tuple(MODELS), True, True),
    FileFormat("metashape", ("brown_forward", "opencv"), False, True),
    FileFormat("photomodeler", ("brown",), False, True),
    FileFormat("bal", ("opencv",), False, True),
    FileFormat("bundle-csharp", ("brown",), False, True),
    FileFormat("bundle-matlab", ("brown",), True, True),
    FileFormat("sba", ("opencv",), True, True),
    FileFormat("ply", (), False, False),
)
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
    try:
        with path.open(encoding="utf-8", errors="replace") as text:
            lines = [text.readline() for _ in range(4)]
    except OSError as error:
        raise SurveyFileError(f"{path}: cannot be read ({error.strerror})") from error
    counts = [len(line.split()) for line in lines]
    if "cams" in path.name:
        return format_named("sba")
    if counts[2:4] == [9, 10]:
        return format_named("photomodeler")
    if counts[:2] == [3, 4]:
        return format_named("bal")
    if counts[:2] == [4, 7]:
        return format_named("bundle-csharp")
    raise SurveyFileError(f"{path}, line 1: this is no format that is known, name it with --from")


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
    network, estimate = read_any(path, form.name)
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
    wrong = [camera for camera in estimate.cameras if form.models and camera.model not in form.models]
    if wrong:
        raise KolinearError(
            f"camera {wrong[0].name}: format {name} holds models {', '.join(form.models)}, "
            f"not {wrong[0].model}"
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


def _write_folder(folder: Path, name: str, title: str, network: Network, estimate: Estimate) -> None:
    """Write the files of a format that is a folder."""
    if name in ("colmap", "colmap-text"):
        write_model(folder, network, estimate, text=name == "colmap-text")
    elif name == "tables":
        write_tables(folder, TableResult(title, network, estimate))
    elif name == "bundle-matlab":
        write_bundle_matlab_folder(folder, network, estimate)
    else:
        write_sba_text(folder / "cams.txt", folder / "pts.txt", network, estimate)
