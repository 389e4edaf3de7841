"""The formats of other programs by name: how files are recognised, what formats store, who reads and writes.

To add a format, write its module beside this one, with a reader, a writer or both, and add a row to FORMATS.
If its files can be recognised by their content, add that to `format_of`.

Source: named in the module of each format.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np

from adapters.colmap.camera_models import SIDE_FILE, read_model, write_model
from adapters.colmap.database import read_database, write_database
from adapters.colmap.reconstruction import COLMAP_NAMES
from adapters.formats import agisoft_reference, aicon, micmac, realitycapture
from adapters.formats.agisoft_reference import read_reference, write_reference
from adapters.formats.aicon import read_aicon, write_aicon
from adapters.formats.alicevision import read_alicevision, write_alicevision
from adapters.formats.bal import read_bal, write_bal
from adapters.formats.bundle_text import (
    INTERIOR,
    OF_SIGMAS,
    read_bundle_csharp,
    read_bundle_matlab_folder,
    write_bundle_csharp,
    write_bundle_matlab_folder,
)
from adapters.formats.bundler import PLACES as BUNDLER_PLACES
from adapters.formats.bundler import read_bundler, write_bundler
from adapters.formats.cameras.rig_folder import write_rig_files
from adapters.formats.content import ALL, UNSTATED, Content, losses, refuse_not_finite, select_placed
from adapters.formats.e57 import HEAD as E57_HEAD
from adapters.formats.e57 import read_e57, write_e57
from adapters.formats.las import HEAD as LAS_HEAD
from adapters.formats.las import read_laz, write_laz
from adapters.formats.metashape import read_metashape, write_metashape
from adapters.formats.micmac import read_micmac, write_micmac
from adapters.formats.nerfstudio import read_nerfstudio_poses, write_nerfstudio_poses
from adapters.formats.nvm import HEADER as NVM_HEADER
from adapters.formats.nvm import read_nvm, write_nvm
from adapters.formats.openmvg import read_openmvg, write_openmvg
from adapters.formats.opensfm import PLACES as OPENSFM_PLACES
from adapters.formats.opensfm import read_opensfm, write_opensfm
from adapters.formats.photomodeler import FREE as PHOTOMODELER_FREE
from adapters.formats.photomodeler import MODELS as PHOTOMODELER_MODELS
from adapters.formats.photomodeler import read_export, write_export
from adapters.formats.point_tables import HEAD as POINTS_HEAD
from adapters.formats.point_tables import read_geojson, read_points_csv, write_geojson, write_points_csv
from adapters.formats.realitycapture import read_realitycapture, write_realitycapture
from adapters.formats.resection import read_resection
from adapters.formats.result_tables import read_content as read_tables
from adapters.formats.result_tables import read_result
from adapters.formats.result_tables import write_content as write_content_tables
from adapters.formats.sba_text import read_sba, write_sba_folder
from adapters.formats.survey_file import write_survey_file
from adapters.reading.text_lines import Lines
from adapters.reading.trees import head_of
from sfm.files.csv_tables import write_ply
from sfm.files.open_folders import refuse_links, refuse_links_out
from sfm.files.plain_text import as_plain
from sfm.files.whole_files import whole_file, whole_folder
from sfm.model.camera import Camera
from sfm.model.display import counted
from sfm.model.distortion.models import MODELS, Role
from sfm.model.errors import KolinearError, OutputError, SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.solution import Solution

SPARSE = "sparse"  # folder of the models of a project
Reader = Callable[[Path], tuple[Network, Estimate]]
Writer = Callable[[Path, Network, Estimate], None]


class NamedRow(Protocol):
    """What a table of formats has a row of."""

    @property
    def name(self) -> str:
        """As for --from and --to."""


Row = TypeVar("Row", bound=NamedRow)


@dataclass(frozen=True)
class FileFormat:
    """A file format: its properties, its reader and its writer."""

    name: str  # as for --from and --to
    models: tuple[str, ...]  # camera models that it can store, most capable first; empty: no cameras
    keeps: frozenset[str]  # the kinds of `content` that are unchanged when read again
    read: Reader | None = None  # of a file or folder; None: `read_all`, or the format is write-only
    write: Writer | None = None  # to a new file, or into an empty folder; None: `write_all`
    folder: bool = False  # whether it is a folder of files
    placed: bool = False  # whether it omits what has no coordinates in the object
    lacks: tuple[str, ...] = ()  # parameters of these models that it cannot store, but can approximate
    frees: tuple[str, ...] = ()  # parameters that become free when read, if it does not state which are
    straight: tuple[str, ...] = ()  # parameters that it can neither store nor approximate
    one_focal: bool = False  # whether fx and fy must be equal
    square: bool = False  # whether pixels must be square
    names: tuple[bool, bool] = (True, True)  # whether it names points and photographs; else it numbers them
    read_all: Callable[..., Content] | None = None  # for a format with more content than `read` returns
    write_all: Callable[[Path, Content], None] | None = None  # likewise for `write`
    control: bool = False  # whether `read_all` accepts a control file as keyword
    adjusts: bool = False  # whether it is the input of an adjustment with the standard deviations in it
    recognises: Callable[[str], bool] = lambda head: False  # whether a file is of it, by its beginning
    marks: tuple[str, ...] = ()  # patterns of files in a folder of it, of which one is enough
    needs: str = (
        ""  # the kind of content without which a survey cannot be stored; a problem of adjustment does
    )
    of_photographs: bool = False  # whether it has the cameras of photographs only
    flat: bool = False  # whether its names of photographs have no folders
    keeps_also: Callable[[Content], frozenset[str]] = lambda content: (
        frozenset()
    )  # kinds kept of some surveys

    def held(self, content: Content) -> frozenset[str]:
        """Return the kinds of content that are unchanged when a survey is read again."""
        cameras = content.result.estimate.cameras
        frees = all(
            {name for name, free in zip(camera.names, camera.free, strict=True) if free}
            in (set(), set(camera.names) & set(self.frees))
            for camera in cameras
        )
        held = self.keeps | self.keeps_also(content)
        if self.flat and any("/" in image for image in content.result.network.images):
            held -= {"image names"}
        return held | {"free"} if frees else held

    @property
    def only_points(self) -> bool:
        """Whether it has object points and no photographs."""
        return "object points" in self.keeps and "exterior orientations" not in self.keeps

    @property
    def writable(self) -> bool:
        """Whether it can be written."""
        return self.write is not None or self.write_all is not None

    @property
    def readable(self) -> bool:
        """Whether it has photographs and can be read."""
        return not self.only_points and (self.read is not None or self.read_all is not None)


def _write_tables(folder: Path, content: Content) -> None:
    placed = select_placed(content)
    write_content_tables(folder, placed)
    write_survey_file(folder, placed, title=content.result.name)


def _write_ply(path: Path, content: Content) -> None:
    result = content.result
    C = result.point_covariance
    sigma = None if C is None else np.sqrt(np.diagonal(C, axis1=1, axis2=2))
    with whole_file(path) as part:
        write_ply(part, result.estimate.points, names=result.network.points, sigma=sigma)


_COLMAP = ("full_opencv", *(name for name in COLMAP_NAMES if name != "full_opencv"))
_OPENCV_DISTORTION = ("k1", "k2", "p1", "p2")
_BROWN_DISTORTION = MODELS["brown"].names[3:]
_FRACTION = ("k4", "k5", "k6")  # of full_opencv, in its denominator
NUMBERS = (False, False)
_SOLVED = frozenset({"cameras", "exterior orientations", "object points", "image points", "uncoded"})
_NAMED = _SOLVED | {"point names", "image names"}
_CLOUD = frozenset({"object points", "point sigmas", "crs"})
_RIGS = frozenset({"rigs", "moments"})
_SIDE = _NAMED | _RIGS | {"free", "rig names", "held mounts"}  # stored beside a COLMAP model
FORMATS = (
    FileFormat(
        name="colmap",
        models=_COLMAP,
        read=partial(read_model, text=False),
        write=partial(write_model, text=False),
        keeps=_SIDE,
        folder=True,
        placed=True,
    ),
    FileFormat(
        name="colmap-text",
        models=_COLMAP,
        read=partial(read_model, text=True),
        write=partial(write_model, text=True),
        keeps=_SIDE,
        folder=True,
        placed=True,
    ),
    FileFormat(
        name="colmap-database",
        models=_COLMAP,
        read=read_database,
        write=lambda path, network, estimate: write_database(path, network, estimate.cameras),
        keeps=frozenset({"cameras", "image points", "image names", "uncoded"}),
        names=(False, True),
    ),
    FileFormat(
        name="tables",
        models=tuple(MODELS),
        read_all=read_tables,
        write_all=_write_tables,
        keeps=ALL - {"exterior correlations", "interior correlations", "unplaced", "crs"},
        folder=True,
        placed=True,
    ),
    FileFormat(
        name="metashape",
        models=("brown_forward_affine", "full_opencv", "opencv"),
        read=read_metashape,
        write=write_metashape,
        keeps=_NAMED | {"control", "unplaced"},
        lacks=_FRACTION,
    ),
    FileFormat(
        name="photomodeler",
        models=PHOTOMODELER_MODELS,
        needs="image points",
        read_all=read_export,
        write_all=write_export,
        keeps=(_NAMED - {"uncoded"}) | {"control", "point sigmas", "position sigmas", "image sigmas"},
        lacks=("b1", "b2"),
        frees=PHOTOMODELER_FREE,
        control=True,
        adjusts=True,
    ),
    FileFormat(
        name="bal",
        models=("opencv", "radial"),
        needs="image points",
        read=read_bal,
        write=write_bal,
        keeps=_SOLVED,
        frees=("f", "fx", "fy", "k1", "k2"),
        straight=("p1", "p2"),
        one_focal=True,
        names=NUMBERS,
    ),
    FileFormat(
        name="bundle-csharp",
        models=("brown",),
        needs="image points",
        read=read_bundle_csharp,
        write=write_bundle_csharp,
        keeps=_NAMED | {"image sigmas"},
        straight=_BROWN_DISTORTION,
        adjusts=True,
    ),
    FileFormat(
        name="bundle-matlab",
        models=("brown",),
        needs="image points",
        read=read_bundle_matlab_folder,
        write=write_bundle_matlab_folder,
        keeps=_SOLVED | {"image names", "image sigmas"},
        folder=True,
        straight=_BROWN_DISTORTION,
        names=(False, True),
        adjusts=True,
    ),
    FileFormat(
        name="sba",
        models=("opencv",),
        needs="image points",
        read=read_sba,
        write=write_sba_folder,
        keeps=_SOLVED | {"image sigmas", "image covariances"},
        folder=True,
        straight=_OPENCV_DISTORTION,
        names=NUMBERS,
        adjusts=True,
    ),
    FileFormat(
        name="opensfm",
        models=("full_opencv", "opencv", "opencv_fisheye", "radial", "radial_fisheye"),
        read_all=read_opensfm,
        write_all=write_opensfm,
        keeps=_SOLVED | _RIGS | {"image names"},
        folder=True,
        placed=True,
        lacks=_FRACTION,
        names=(False, True),
        recognises=lambda head: head.startswith("[") and '"projection_type"' in head,
        marks=OPENSFM_PLACES,
    ),
    FileFormat(
        name="nerfstudio",
        models=("brown_forward_affine", "full_opencv", "opencv", "opencv_fisheye"),
        read_all=read_nerfstudio_poses,
        write_all=write_nerfstudio_poses,
        keeps=frozenset({"cameras", "exterior orientations", "image names"}),
        placed=True,
        lacks=("b2", *_FRACTION),
        names=(False, True),
        recognises=lambda head: head.startswith("{") and '"transform_matrix"' in head,
    ),
    FileFormat(
        name="bundler",
        models=("radial",),
        of_photographs=True,
        read_all=read_bundler,
        write_all=write_bundler,
        keeps=_SOLVED | {"image names"},
        folder=True,
        placed=True,
        names=(False, True),
        recognises=lambda head: head.startswith("# Bundle file"),
        marks=BUNDLER_PLACES,
    ),
    FileFormat(
        name="nvm",
        models=("brown",),
        of_photographs=True,
        read_all=read_nvm,
        write_all=write_nvm,
        keeps=_SOLVED | {"image names"},
        placed=True,
        lacks=("K2", "K3", "P1", "P2", "b1", "b2"),
        square=True,
        names=(False, True),
        recognises=lambda head: head.startswith(NVM_HEADER),
    ),
    FileFormat(
        name="alicevision",
        models=("full_opencv", "opencv", "opencv_fisheye"),
        read_all=read_alicevision,
        write_all=write_alicevision,
        keeps=_SOLVED | _RIGS | {"image names"},
        placed=True,
        lacks=_FRACTION,
        names=(False, True),
        recognises=lambda head: head.startswith("{") and '"viewId"' in head,
    ),
    FileFormat(
        name="openmvg",
        models=("brown_forward", "opencv_fisheye"),
        read_all=read_openmvg,
        write_all=write_openmvg,
        keeps=_SOLVED | {"image names"},
        placed=True,
        lacks=("K4", "b1", "b2"),
        one_focal=True,
        square=True,
        names=(False, True),
        recognises=lambda head: head.startswith("{") and '"sfm_data_version"' in head,
    ),
    FileFormat(
        name="micmac",
        models=("brown_forward",),
        read_all=read_micmac,
        write_all=write_micmac,
        keeps=_NAMED - {"object points"} | {"control"},
        folder=True,
        square=True,
        recognises=lambda head: any(root in head for root in micmac.ROOTS),
        marks=micmac.PLACES,
        flat=True,
    ),
    FileFormat(
        name="aicon",
        models=("brown_forward",),
        read_all=read_aicon,
        write_all=write_aicon,
        keeps=_NAMED - {"image names"} | {"scale bars", "image sigmas", "point sigmas", "rejected"},
        folder=True,
        placed=True,
        lacks=("K4",),
        names=(True, False),
        adjusts=True,
        marks=aicon.PLACES,
    ),
    FileFormat(
        name="realitycapture",
        models=("brown_forward",),
        of_photographs=True,
        read_all=read_realitycapture,
        write_all=write_realitycapture,
        keeps=frozenset({"cameras", "exterior orientations", "image names"}),
        placed=True,
        lacks=("b1", "b2"),
        square=True,
        names=(False, True),
        recognises=lambda head: head.startswith(realitycapture.HEAD),
    ),
    FileFormat(
        name="resection",
        models=(),
        read_all=read_resection,
        keeps=frozenset({"exterior orientations", "image names", "exterior"}),
        names=(False, True),
        recognises=lambda head: head.startswith(("{", "[")) and '"solutions"' in head,
    ),
    FileFormat(
        name="agisoft-reference",
        models=(),
        read_all=read_reference,
        write_all=write_reference,
        keeps=_NAMED - {"cameras", "image points"} | {"control", "checks", "unit", "crs", "unplaced"},
        folder=True,
        recognises=lambda head: agisoft_reference.HEAD.match(head) is not None,
        marks=(agisoft_reference.IMAGES, agisoft_reference.POINTS),
        keeps_also=agisoft_reference.kinds_kept,
    ),
    FileFormat(
        name="rig",
        models=("opencv",),
        write_all=write_rig_files,
        keeps=frozenset({"cameras", "rigs", "rig names", "unit"}),
        folder=True,
    ),
    FileFormat(
        name="laz",
        models=(),
        read_all=read_laz,
        write_all=write_laz,
        keeps=_CLOUD,
        placed=True,
        names=NUMBERS,
        recognises=lambda head: head.startswith(LAS_HEAD),
    ),
    FileFormat(
        name="e57",
        models=(),
        read_all=read_e57,
        write_all=write_e57,
        keeps=_CLOUD,
        placed=True,
        names=NUMBERS,
        recognises=lambda head: head.startswith(E57_HEAD),
    ),
    FileFormat(
        name="points-csv",
        models=(),
        read_all=read_points_csv,
        write_all=write_points_csv,
        keeps=_CLOUD | {"point names", "uncoded"},
        placed=True,
        recognises=lambda head: POINTS_HEAD.match(head) is not None,
    ),
    FileFormat(
        name="geojson",
        models=(),
        read_all=read_geojson,
        write_all=write_geojson,
        keeps=_CLOUD | {"point names", "uncoded"},
        placed=True,
        recognises=lambda head: head.startswith("{") and '"FeatureCollection"' in head,
    ),
    FileFormat(
        name="ply",
        models=(),
        write_all=_write_ply,
        keeps=frozenset({"object points", "point sigmas", "point names", "uncoded"}),
        placed=True,
    ),
)
ENDINGS = {
    ".xml": "metashape",
    ".ply": "ply",
    ".laz": "laz",
    ".las": "laz",
    ".e57": "e57",
    ".db": "colmap-database",
    ".nvm": "nvm",
    ".sfm": "alicevision",
    ".csv": "points-csv",
    ".geojson": "geojson",
}


def format_named(name: str) -> FileFormat:
    """Return a format by its name.

    Raises:
        SurveyFileError: no format has that name.
    """
    return row_named(name, FORMATS, "format")


def row_named(name: str, rows: tuple[Row, ...], what: str) -> Row:
    """Return the row of a table of formats by its name.

    Args:
        name: of the row.
        rows: the table.
        what: is in a row of it, for people.

    Raises:
        SurveyFileError: no row has that name.
    """
    named = {row.name: row for row in rows}
    if name not in named:
        raise SurveyFileError(f"{what} '{name}', expected one of {', '.join(named)}")
    return named[name]


def format_of(path: Path) -> FileFormat:
    """Return the format of an existing file or folder, by its content.

    Raises:
        SurveyFileError: it does not exist, or its format is not known.
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
        if any(path.glob(f"*_*{OF_SIGMAS}.txt")):
            return format_named("bundle-matlab")
        if any(path.glob("*cams*.txt")):
            return format_named("sba")
        for form in FORMATS:
            if any(file.is_file() for mark in form.marks for file in path.glob(mark)):
                return form
        raise SurveyFileError(
            f"{path}: neither a COLMAP model, nor tables of a result, nor files of a bundle program are in "
            "this folder"
        )
    recognised = recognised_format(path)
    if recognised is not None:
        return recognised
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
        f"{path}, line 1: the format is not known, name it with --from (compare: --from-a, --from-b)"
    )


def recognised_format(path: Path) -> FileFormat | None:
    """Return the format of a file whose beginning names it; None of any other.

    Raises:
        SurveyFileError: the file cannot be read.
    """
    head = head_of(path).lstrip("\ufeff \t\r\n")
    return next((form for form in FORMATS if form.recognises(head)), None)


def read_any(path: Path, name: str | None = None) -> tuple[Network, Estimate]:
    """Read a network and its solution; see `read_content`."""
    result = read_content(path, name).result
    return result.network, result.estimate


def read_content(path: Path, name: str | None = None, *, control: Path | None = None) -> Content:
    """Read everything in a file or folder.

    If a format only numbers its points, they are read as uncoded points, named u and the number. Such names
    are never matched with the names of other points.

    Args:
        path: file or folder.
        name: name of the format; None detects it.
        control: control file that replaces the control of a PhotoModeler export.

    Raises:
        SurveyFileError: with file and line number.
    """
    form = format_of(path) if name is None else format_named(name)
    if form.read is None and form.read_all is None:
        raise SurveyFileError(f"{path}: format {form.name} has no photographs, it can only be written")
    if control is not None and not form.control:
        raise SurveyFileError(f"{path}: format {form.name} takes no control file, photomodeler does")
    refuse_links_out(path)
    if form.read_all is not None:
        content = form.read_all(path, control=control) if form.control else form.read_all(path)
    else:
        assert form.read is not None
        network, estimate = form.read(path)
        points_named = (
            (path / SIDE_FILE).is_file() if form.name in ("colmap", "colmap-text") else form.names[0]
        )
        if not points_named:
            uncoded = tuple(f"u{name}" if name.isdecimal() else name for name in network.points)
            network = replace(network, points=uncoded)
        content = Content(
            Solution(
                model_name(path), network, estimate, points_named=points_named, images_named=form.names[1]
            )
        )
    seen = content.result.network.image_points
    stated = bool(len(seen) and np.isfinite(seen.stated_sigma).all())
    return replace(content, stated_weights=stated and form.adjusts)


def model_name(path: Path) -> str:
    """Return the name of a model: that of its file or folder, after that of its project where it is a number.

    COLMAP and others that make several models of a project write them into sparse/0, sparse/1 and so on.
    """
    parts = path.resolve().parts[1:]
    k = len(parts) - 1
    while k > 0 and (parts[k].isdecimal() or parts[k] == SPARSE):
        k -= 1
    return " ".join(as_plain(part) for part in parts[k:] if part != SPARSE) or path.name


def read_comparable(path: Path, name: str | None = None) -> Solution:
    """Read a result for comparison: tables with standard deviations, any other format without.

    Raises:
        SurveyFileError: with file and line number.
    """
    form = format_of(path) if name is None else format_named(name)
    if form.name == "tables":
        return read_result(path)
    if not form.readable:
        raise SurveyFileError(
            f"{path}: format {form.name} has only points, a comparison needs results with photographs"
        )
    result = read_content(path, form.name).result
    network, estimate = result.network, result.estimate
    if not (estimate.oriented.any() or estimate.determined.any()):
        raise SurveyFileError(
            f"{path}: {counted(len(network.image_points), 'image point')} as format "
            f"{form.name}, but no coordinates of "
            "photographs or points that could be compared"
        )
    return result


def write_any(path: Path, name: str, network: Network, estimate: Estimate) -> None:
    """Write a network and its solution; see `write_content`."""
    write_content(path, name, Content(Solution(path.name, network, estimate)))


def write_content(path: Path, name: str, content: Content) -> None:
    """Write everything that a format keeps of a survey; it must have the models of the cameras.

    Raises:
        KolinearError: the format cannot store the survey, a number is not finite, or it cannot be written.
    """
    form = format_named(name)
    if not form.writable:
        raise OutputError(f"{path}: format {form.name} can only be read")
    estimate = content.result.estimate
    refuse_taken(path, form)
    refuse_not_finite(path, content)
    _refuse_cameras(form, estimate.cameras)
    if form.placed:
        _refuse_unplaced(path, form, content)
    _refuse_empty(path, form, content)
    with whole_folder(path) if form.folder else nullcontext(path) as target:
        if form.write_all is not None:
            form.write_all(target, content)
        elif form.write is not None:
            form.write(target, content.result.network, estimate)


def _refuse_unplaced(path: Path, form: FileFormat, content: Content) -> None:
    """Raise OutputError if nothing that was measured has coordinates; any part of a model may be missing."""
    network, estimate = content.result.network, content.result.estimate
    if form.only_points and not estimate.determined.any():
        raise OutputError(
            f"{path}: format {form.name} needs coordinates in the object, but no point has coordinates"
        )
    measured = len(network.images) + len(network.points)
    if measured and not (estimate.oriented.any() or estimate.determined.any()):
        raise OutputError(
            f"{path}: format {form.name} needs coordinates in the object, but no photograph and no point has "
            "coordinates"
        )


def _refuse_empty(path: Path, form: FileFormat, content: Content) -> None:
    """Raise OutputError if a format stores nothing of a survey, rather than write a file without anything."""
    network, estimate = content.result.network, content.result.estimate
    parts = {
        "cameras": any(camera.name != UNSTATED for camera in estimate.cameras),
        "exterior orientations": bool(estimate.oriented.any()),
        "object points": bool(estimate.determined.any()),
        "image points": len(network.image_points) > 0,
        "control": len(network.control.complete) > 0,
    }
    if form.needs and not parts[form.needs]:
        raise OutputError(f"{path}: format {form.name} stores no survey without {form.needs}")
    alone = {"cameras"} if form.of_photographs and not parts["exterior orientations"] else set()
    if not any(there and kind in form.keeps - alone for kind, there in parts.items()):
        there = [kind for kind, present in parts.items() if present] or ["nothing"]
        raise OutputError(
            f"{path}: format {form.name} stores nothing of this survey, in which there is "
            f"{' and '.join(there)} only"
        )


def losses_in_words(name: str, content: Content, gone: frozenset[str] = frozenset()) -> tuple[str, ...]:
    """Return the parts of a survey that a format cannot store, a line for each kind.

    Args:
        name: name of the format.
        content: content of the survey.
        gone: kinds dropped because their cameras were converted.
    """
    form = format_named(name)
    return tuple(f"{count} {kind.words}" for kind, count in losses(content, form.held(content) - gone))


def refuse_taken(path: Path, form: FileFormat) -> None:
    """Raise OutputError if the path of an output exists and is not an empty folder for a folder format."""
    refuse_links(path)
    empty = form.folder and path.is_dir() and not any(path.iterdir())
    if os.path.lexists(path) and not empty:
        needed = "a new or empty folder" if form.folder else "a new file"
        raise OutputError(f"{path}: already exists and is left alone; format {form.name} needs {needed}")


def _refuse_cameras(form: FileFormat, cameras: tuple[Camera, ...]) -> None:
    """Raise KolinearError for the first camera that a format cannot store."""
    for camera in cameras if form.models else ():
        if camera.model not in form.models:
            raise KolinearError(
                f"camera {camera.name}: format {form.name} has models {', '.join(form.models)}, "
                f"not {camera.model}"
            )
        held = () if camera.wide_angle else (*form.lacks, *form.straight)  # they are of other models
        left = [name for name in held if name in camera.names and camera.value(name) != 0]
        if form.one_focal and np.ptp(camera.parameters[camera.plays(Role.FOCAL)]):
            left.append("fx other than fy")
        if form.square and camera.in_mm and np.ptp(camera.pixel_mm):
            left.append("pixels that are not square")
        if left:
            corrected = form.straight or form.square
            remedy = "; --undistort corrects the image points for it" if corrected else ""
            raise KolinearError(
                f"camera {camera.name}: format {form.name} cannot store {', '.join(left)} of "
                f"{camera.model}{remedy}"
            )


def describe_stored(name: str, network: Network, estimate: Estimate) -> str:
    """Return in words which part of a network a format keeps."""
    form = format_named(name)
    if form.only_points:
        return counted(int(estimate.determined.sum()), "point")
    if name == "rig":
        rigs = [rig for rig in (estimate.mounts.rig if estimate.mounts is not None else ()) if rig]
        return f"{counted(len(rigs), 'camera')} of {counted(len(set(rigs)), 'rig')}"
    image_points = counted(len(network.image_points), "image point")
    if name == "colmap-database":
        return f"{counted(len(network.images), 'photograph')}, {image_points}, no coordinates of points"
    images, points = estimate.oriented, estimate.determined
    if not form.placed:
        images, points = np.ones_like(images), np.ones_like(points)
    seen = network.image_points
    kept = images[seen.image] & (points[seen.point] | (name != "tables"))
    parts = [counted(int(images.sum()), "photograph")]
    if "object points" in form.keeps:
        parts.append(counted(int(points.sum()), "point"))
    elif "control" in form.keeps:
        parts.append(counted(len(network.control.complete), "control point"))
    else:
        parts.append("no points")
    if "image points" in form.keeps:
        parts.append(counted(int(kept.sum()), "image point"))
    return ", ".join(parts)
