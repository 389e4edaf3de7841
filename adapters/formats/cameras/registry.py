"""The formats of cameras by name: how files are recognised, which lenses they store, who reads and writes.

To add a format, write its module beside this one, and add a row to CAMERA_FORMATS. A result, or a survey in a
format of `adapters.formats.registry`, is a file of cameras too.

Source: named in the module of each format.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from adapters.colmap.reconstruction import COLMAP_NAMES, as_opencv
from adapters.formats.cameras.australis import read_australis, write_australis
from adapters.formats.cameras.blender import read_blender, write_blender
from adapters.formats.cameras.colmap import read_colmap, write_colmap
from adapters.formats.cameras.kalibr import read_kalibr, write_kalibr
from adapters.formats.cameras.lens_terms import LEAN
from adapters.formats.cameras.metashape import read_metashape_camera, write_metashape_camera
from adapters.formats.cameras.mrcal import STEREOGRAPHIC, read_mrcal, write_mrcal
from adapters.formats.cameras.nerfstudio import read_nerfstudio, write_nerfstudio
from adapters.formats.cameras.opencv import is_pair, read_opencv, write_opencv
from adapters.formats.cameras.ros import read_ros, write_ros
from adapters.formats.registry import FORMATS, format_of, read_content, row_named
from adapters.reading.trees import head_of
from sfm.files.open_folders import refuse_links_out
from sfm.files.whole_files import refuse_existing, whole_file
from sfm.model.camera import Camera
from sfm.model.camera_file import CameraFile, cameras_of
from sfm.model.display import counted
from sfm.model.errors import OutputError, SurveyFileError

SURVEYS = tuple(form.name for form in FORMATS if form.readable)


class LensForm(NamedTuple):
    """A model of which a format stores all parameters but some, which must be 0."""

    model: str
    held: tuple[str, ...] = ()

    def holds(self, camera: Camera) -> bool:
        """Return whether a camera has this form."""
        held = (camera.value(name) for name in self.held if name in camera.names)
        return camera.model == self.model and not any(held)


@dataclass(frozen=True)
class CameraFormat:
    """A format of cameras: its properties, its reader and its writer."""

    name: str  # as for --from and --to
    program: str  # that it belongs to, for people
    suffixes: tuple[str, ...]  # of its files, the first is usual
    forms: tuple[LensForm, ...]  # lenses that it stores, those with fewest parameters first
    recognises: Callable[[Path, str], bool]  # by the path and the beginning of the file
    read: Callable[[Path], CameraFile]
    write: Callable[[Path, CameraFile], str | bytes]  # returns the content of a new file
    several: Callable[[CameraFile], bool] = lambda file: False  # whether a file holds such several cameras
    mounted: Callable[[CameraFile], bool] = lambda file: False  # whether it stores the mounts of such cameras
    exact: Callable[[Camera], bool] = lambda camera: True  # what else a camera must be to be stored

    def stored(self, camera: Camera) -> Camera | None:
        """Return a camera as the format stores it without conversion; None if it does not."""
        for same in (camera, as_opencv(camera)):
            if any(form.holds(same) for form in self.forms) and self.exact(same):
                return same
        return None


_OPENCV = (LensForm("opencv"), LensForm("full_opencv", LEAN), LensForm("full_opencv"))
_FISHEYE = LensForm("opencv_fisheye")
CAMERA_FORMATS = (
    CameraFormat(
        "mrcal-camera",
        "mrcal",
        (".cameramodel",),
        (*_OPENCV, LensForm("eucm")),
        lambda path, head: path.suffix == ".cameramodel" or "'lensmodel'" in head or '"lensmodel"' in head,
        read_mrcal,
        write_mrcal,
        exact=lambda camera: camera.model != "eucm" or tuple(camera.parameters[-2:]) == STEREOGRAPHIC,
    ),
    CameraFormat(
        "metashape-camera",
        "Agisoft Metashape",
        (".xml",),
        (LensForm("opencv"), LensForm("full_opencv", LEAN), LensForm("brown_forward_affine")),
        lambda path, head: "<calibration>" in head and "<chunk" not in head and "<document" not in head,
        read_metashape_camera,
        write_metashape_camera,
    ),
    CameraFormat(
        "australis-camera",
        "Australis",
        (".txt",),
        (LensForm("brown_affine"), LensForm("brown", ("b1", "b2"))),
        lambda path, head: "Australis" in head or "Results for Camera" in head,
        read_australis,
        write_australis,
        several=lambda file: True,
    ),
    CameraFormat(
        "colmap-camera",
        "COLMAP",
        (".txt", ".bin"),
        tuple(LensForm(name) for name in ("opencv", *COLMAP_NAMES)),
        lambda path, head: (
            path.name in ("cameras.txt", "cameras.bin") or "# Camera list with one line" in head
        ),
        read_colmap,
        write_colmap,
        several=lambda file: True,
    ),
    CameraFormat(
        "kalibr-camera",
        "Kalibr",
        (".yaml", ".yml"),
        (LensForm("opencv"), _FISHEYE, LensForm("fov"), LensForm("eucm")),
        lambda path, head: re.search(r"^cam0:", head, re.MULTILINE) is not None,
        read_kalibr,
        write_kalibr,
        several=lambda file: True,
        mounted=lambda file: True,
    ),
    CameraFormat(
        "ros-camera",
        "ROS",
        (".yaml", ".yml"),
        (*_OPENCV, _FISHEYE),
        lambda path, head: "distortion_model:" in head and not head.startswith("%YAML:"),
        read_ros,
        write_ros,
    ),
    CameraFormat(
        "nerfstudio-camera",
        "nerfstudio",
        (".json",),
        (
            *(LensForm("opencv"), LensForm("full_opencv", LEAN)),
            *(LensForm("brown_forward_affine", ("b2",)), _FISHEYE),
        ),
        lambda path, head: any(f'"{key}"' in head for key in ("fl_x", "camera_angle_x", "transform_matrix")),
        read_nerfstudio,
        write_nerfstudio,
    ),
    CameraFormat(
        "blender-camera",
        "Blender",
        (".json",),
        (LensForm("opencv", ("k1", "k2", "p1", "p2")), LensForm("pinhole")),
        lambda path, head: '"sensor_width"' in head and '"lens"' in head,
        read_blender,
        write_blender,
    ),
    CameraFormat(
        "opencv-camera",
        "OpenCV",
        (".yaml", ".yml", ".json"),
        (*_OPENCV, _FISHEYE),
        lambda path, head: (
            head.startswith("%YAML:1")
            or "opencv-matrix" in head
            or re.search(r"\b(K|K1|camera_matrix|cameraMatrix|mtx)\b\"?\s*:", head) is not None
        ),
        read_opencv,
        write_opencv,
        several=is_pair,
        mounted=is_pair,
    ),
)
NAMES = tuple(form.name for form in CAMERA_FORMATS)


def camera_format(name: str) -> CameraFormat:
    """Return a format of cameras by its name.

    Raises:
        SurveyFileError: no format has that name.
    """
    return row_named(name, CAMERA_FORMATS, "camera format")


def camera_format_of(path: Path) -> CameraFormat | None:
    """Return the format of a file of cameras by its content; None for a folder or a file of another kind.

    Raises:
        SurveyFileError: the file cannot be read.
    """
    if path.is_dir():
        return None
    head = head_of(path)
    return next((form for form in CAMERA_FORMATS if form.recognises(path, head)), None)


def read_cameras(path: Path, name: str | None = None) -> CameraFile:
    """Read the cameras of a file, or of a result or survey in any format that is read.

    Args:
        path: file or folder.
        name: name of the format, of cameras or of a survey; None detects it.

    Raises:
        SurveyFileError: no cameras are in it, or a format has no such name; with the file and, where there is
            one, the line.
    """
    if path.parent.is_dir():
        refuse_links_out_of(path)
    form = camera_format_of(path) if name is None else None
    if name in NAMES:
        form = camera_format(name)
    if form is not None:
        file = form.read(path)
        for called, count in Counter(camera.name for camera in file.cameras).items():
            if count > 1:
                raise SurveyFileError(
                    f"{path}: {counted(count, 'camera')} of the name '{called}', needed one"
                )
        return replace(file, name=str(path))
    if name is None and not path.is_dir():
        try:
            format_of(path)
        except SurveyFileError as error:
            raise SurveyFileError(
                f"{path}: not a file of a camera in a format that is read ({', '.join(NAMES)}), nor a result"
            ) from error
    return replace(cameras_of(read_content(path, name).result), name=str(path))


def refuse_links_out_of(path: Path) -> None:
    """Raise SurveyFileError if a file of somebody else is a link that leaves its folder."""
    if path.is_dir():
        refuse_links_out(path)
    elif path.is_file() and path.is_symlink() and not path.resolve().is_relative_to(path.parent.resolve()):
        raise SurveyFileError(f"{path}: a link that leaves its folder; the file itself is needed there")


def write_cameras(path: Path, name: str, file: CameraFile) -> None:
    """Write cameras into a new file, whole or not at all.

    Args:
        path: the file.
        name: name of the format.
        file: cameras that the format stores without conversion; one, if a file of the format has only one.

    Raises:
        OutputError: the format does not store a camera, a number is not finite, or the file exists.
        SurveyFileError: no format has that name.
    """
    form = camera_format(name)
    refuse_existing(path)
    if len(file.cameras) > 1 and not form.several(file):
        raise OutputError(f"{path}: a file of format {name} has one camera, not {len(file.cameras)}")
    stored = []
    for camera in file.cameras:
        if not np.isfinite(camera.parameters).all():
            raise OutputError(f"{path}: camera {camera.name} has parameters that are not finite")
        same = form.stored(camera)
        if same is None:
            raise OutputError(
                f"{path}: camera {camera.name}: format {name} stores "
                f"{', '.join(dict.fromkeys(lens.model for lens in form.forms))}, not {camera.model} with all "
                "its parameters; convert it"
            )
        stored.append(same)
    content = form.write(path, replace(file, cameras=tuple(stored)))
    with whole_file(path) as part:
        part.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8"))
