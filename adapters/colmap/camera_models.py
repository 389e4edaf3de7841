"""COLMAP models, binary and text, and kolinear.json beside them, written and read.

COLMAP cannot store the names of cameras and points, the size of a pixel, and which parameters are free.
kolinear.json stores them beside a model.

Source: COLMAP 4.2 documentation, "Output Format".
"""

from __future__ import annotations

import errno
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from pydantic import Field

from adapters.colmap.adjuster import load_pycolmap, quiet, reason_of
from adapters.colmap.model_files import check_model_files, names_with_blanks
from adapters.colmap.reconstruction import HALF_PIXEL, as_opencv, camera_of, mount_of, reconstruction
from sfm.files.open_folders import disk_errors, refuse_links_out
from sfm.files.plain_text import MAX_NAME, Content, Name, Pixel, Side, is_name, read_json, shorten
from sfm.files.result_tables import refuse_moments
from sfm.files.whole_files import refuse_full
from sfm.model.conventions import VISION_AXES, AnyArray, BoolArray
from sfm.model.errors import OutputError, SurveyFileError
from sfm.model.estimate import Estimate, Mounts
from sfm.model.network import ImagePoints, Network

SIDE_FILE = "kolinear.json"


def write_model(
    folder: Path,
    network: Network,
    estimate: Estimate,
    *,
    rejected: BoolArray | None = None,
    colours: AnyArray | None = None,
    text: bool = False,
) -> None:
    """Write a network and its solution as a COLMAP model: cameras, rigs, frames, images and points.

    Image points keep their order within each photograph; rejected ones are written without a point.

    Args:
        folder: created if it does not exist.
        network: the measured network.
        estimate: cameras in a model that COLMAP has; photographs without orientation are left out.
        rejected: image points that are not linked to their point, (k,).
        colours: red, green and blue of the points, uint8, (n, 3); black if None.
        text: whether to write text files instead of binary ones.

    Raises:
        BackendError: pycolmap is missing, or COLMAP does not have the model of a camera.
        OutputError: the folder cannot be written.
    """
    pycolmap = load_pycolmap()
    with quiet(pycolmap):
        scene = reconstruction(pycolmap, network, estimate, rejected=rejected, colours=colours)
    write_scene(folder, scene, text=text)
    with disk_errors(f"{folder}: the COLMAP model cannot be written"):
        as_read = replace(estimate, cameras=tuple(as_opencv(camera) for camera in estimate.cameras))
        write_side_file(folder / SIDE_FILE, network, as_read)


def write_scene(folder: Path, scene: Any, *, text: bool = False) -> None:
    """Write a pycolmap.Reconstruction, and read it back to check that it is complete and finite.

    Raises:
        OutputError: the folder cannot be written, or the scene has a number that `read_model` would refuse.
    """
    pycolmap = load_pycolmap()
    with quiet(pycolmap):
        scene.update_point_3d_errors()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if text:
                scene.write_text(str(folder))
            else:
                scene.write_binary(str(folder))
            _refuse_incomplete(pycolmap, folder, scene, text=text)
        except OSError as error:
            reason = error.strerror or error
            raise OutputError(f"{folder}: the COLMAP model cannot be written: {reason}") from error
        except (RuntimeError, ValueError) as error:
            raise OutputError(f"{folder}: the COLMAP model cannot be written: {reason_of(error)}") from error


def _refuse_incomplete(pycolmap: ModuleType, folder: Path, scene: Any, *, text: bool) -> None:
    """Raise OSError unless a model can be read back complete: COLMAP ignores a full disk.

    Raises:
        OutputError: what was written has numbers that are not finite or too large.
    """
    try:
        check_model_files(folder, text=text)
        written = _opened(pycolmap, folder, text=text)
        complete = all(
            getattr(written, count)() == getattr(scene, count)()
            for count in ("num_images", "num_points3D", "compute_num_observations")
        )
    except SurveyFileError as error:
        refuse_full(folder)
        raise OutputError(str(error)) from error
    except (ValueError, RuntimeError, IndexError, OSError):
        complete = False
    if not complete:
        refuse_full(folder)
        raise OSError(errno.EIO, "what COLMAP wrote cannot be read back")


def _opened(pycolmap: ModuleType, folder: Path, *, text: bool) -> Any:
    """Return the model in the text or binary files of a folder, which may contain both."""
    scene = pycolmap.Reconstruction()
    (scene.read_text if text else scene.read_binary)(str(folder))
    return scene


def read_model(folder: Path, *, text: bool | None = None) -> tuple[Network, Estimate]:
    """Read a COLMAP model, binary or text, as a network and its solution.

    Cameras in COLMAP's pinhole and radial models become `opencv` cameras; others keep their model. Unless
    `write_model` wrote the model, points and cameras are named by their numbers in COLMAP, and a pixel is
    1 mm. The covariance of every image point is 1 px^2, since COLMAP stores none.

    Args:
        folder: folder of the model.
        text: whether to read text or binary files; None prefers binary files.

    Raises:
        SurveyFileError: the folder contains no model, or one that cannot be read.
        BackendError: pycolmap is missing, or Kolinear has no equivalent of a camera model.
    """
    return named_network(folder, read_scene(folder, text=text))


def read_scene(folder: Path, *, text: bool | None = None) -> Any:
    """Return the pycolmap.Reconstruction of a folder; see `read_model`."""
    pycolmap = load_pycolmap()
    if not any((folder / f"cameras.{kind}").is_file() for kind in ("bin", "txt")):
        raise SurveyFileError(f"{folder}: no COLMAP model (cameras.bin or cameras.txt) in this folder")
    refuse_links_out(folder)
    if text and not (folder / "cameras.txt").is_file():
        raise SurveyFileError(f"{folder}: no COLMAP model of text files (cameras.txt), only binary ones")
    if text is False and not (folder / "cameras.bin").is_file():
        raise SurveyFileError(f"{folder}: no binary COLMAP model (cameras.bin), only text files")
    if text is None:
        text = not (folder / "cameras.bin").is_file()
    check_model_files(folder, text=text)
    with quiet(pycolmap):
        try:
            scene = _opened(pycolmap, folder, text=text)
        except (ValueError, RuntimeError, LookupError, OSError, MemoryError) as error:
            raise SurveyFileError(
                f"{folder}: each file of the COLMAP model is in order, but they do not fit together "
                f"({reason_of(error)})"
            ) from error
    for number, name in names_with_blanks(folder).items() if text else ():
        scene.image(number).name = name
    return scene


def named_network(folder: Path, scene: Any) -> tuple[Network, Estimate]:
    """Return a scene as a network and its solution, with the names from kolinear.json in its folder."""
    side = read_side_file(folder / SIDE_FILE)
    try:
        network, estimate = network_of_scene(scene, side)
    except UnicodeDecodeError as error:
        raise SurveyFileError(f"{folder}: the name of a photograph is not in UTF-8") from error
    except SurveyFileError as error:
        raise SurveyFileError(f"{folder}: {error}") from error
    if len(side.cameras) != len(estimate.cameras):
        return network, estimate
    for camera, extra in zip(estimate.cameras, side.cameras, strict=True):
        if len(extra.free) != len(camera.free):
            raise SurveyFileError(
                f"{folder / SIDE_FILE}: camera {extra.name}: {len(extra.free)} parameters, "
                f"the model has {len(camera.free)}"
            )
    cameras = tuple(
        replace(camera, name=extra.name, pixel_mm=np.array(extra.pixel_mm), free=np.array(extra.free))
        for camera, extra in zip(estimate.cameras, side.cameras, strict=True)
    )
    mounts = estimate.mounts
    if mounts is not None:
        rig, free = list(mounts.rig), mounts.free.copy()
        for a, extra in enumerate(side.cameras):
            rig[a] = rig[a] and (extra.rig or rig[a])
            free[a] &= free[a] if extra.mount_free is None else np.array(extra.mount_free)
        mounts = replace(mounts, rig=tuple(rig), free=free)
    return network, replace(estimate, cameras=cameras, mounts=mounts)


def network_of_scene(scene: Any, side: Names | None = None) -> tuple[Network, Estimate]:
    """Return a pycolmap.Reconstruction as a network and its solution.

    Args:
        scene: the reconstruction.
        side: names that COLMAP cannot store; None for none.

    Returns:
        The network, with a covariance of 1 px^2 for every image point, since COLMAP stores none, and the
        solution; photographs without a pose are NaN.

    Raises:
        BackendError: Kolinear has no equivalent of a camera model.
        SurveyFileError: the name of a photograph has control or invisible characters or is a duplicate, an
            image point belongs to a missing point, the pose of a camera in its rig is not known, or a frame
            has two photographs by one camera.
    """
    side = side or Names()
    camera_ids = sorted(scene.cameras)
    cameras = tuple(as_opencv(camera_of(scene.camera(i))) for i in camera_ids)
    mounts = _mounts_of(scene, camera_ids)
    image_ids = sorted(scene.images)
    images = [scene.image(i) for i in image_ids]
    point_ids = sorted(scene.point3D_ids())
    poses = [
        image.cam_from_world().matrix() if image.has_pose else np.full((3, 4), np.nan) for image in images
    ]
    M = np.array([VISION_AXES @ pose[:, :3] for pose in poses]).reshape(-1, 3, 3)
    position = np.array([-pose[:, :3].T @ pose[:, 3] for pose in poses]).reshape(-1, 3)
    network = Network(
        _labels_of(image_ids, images, side),
        np.searchsorted(camera_ids, [image.camera_id for image in images]).astype(np.int64),
        tuple(side.points.get(str(j), str(j)) for j in point_ids),
        _image_points_of(image_ids, images, point_ids),
    )
    points = np.array([scene.point3D(j).xyz for j in point_ids]).reshape(-1, 3)
    if mounts is not None:
        frames = [
            (image.frame_id,) if mounts.rig[a] else ("", i)
            for i, (image, a) in enumerate(zip(images, network.camera, strict=True))
        ]
        number = {frame: t for t, frame in enumerate(dict.fromkeys(frames))}
        moment = np.array([number[frame] for frame in frames], dtype=np.int64)
        refuse_moments("frames", [camera.name for camera in cameras], network, mounts, moment)
        network = replace(network, moment=moment)
    return network, Estimate(cameras, position, M.transpose(0, 2, 1).copy(), points, mounts)


def _labels_of(image_ids: list[int], images: list[Any], side: Names) -> tuple[str, ...]:
    """Return the names of photographs, of which COLMAP's text format loses the part after a space."""
    full = {i: side.images.get(str(i), "") for i in image_ids}
    short = [image.name for image in images]
    labels = tuple(
        full[i] if full[i].split()[:1] == [name] else name for i, name in zip(image_ids, short, strict=True)
    )
    for i, name in zip(image_ids, labels, strict=True):
        if not is_name(name):
            raise SurveyFileError(
                f"the name of image {i} is '{shorten(name)}', needed plain text of 1 to {MAX_NAME} characters"
            )
    duplicate = next((name for name, count in Counter(labels).items() if count > 1), None)
    if duplicate is not None:
        raise SurveyFileError(f"more than one photograph has the name '{shorten(duplicate)}'")
    return labels


def _image_points_of(image_ids: list[int], images: list[Any], point_ids: list[int]) -> ImagePoints:
    """Return the key points of photographs that belong to a point."""
    index = {j: k for k, j in enumerate(point_ids)}
    seen = [np.zeros((0, 4))]  # an array for each photograph takes less memory than lists of all
    for i, image in enumerate(images):
        try:
            rows = [(i, index[p.point3D_id], p.x(), p.y()) for p in image.points2D if p.has_point3D()]
        except KeyError as error:
            raise SurveyFileError(
                f"image {image_ids[i]} has a key point of point {error}, which is not in the model"
            ) from error
        seen.append(np.array(rows, dtype=float).reshape(-1, 4))
    table = np.concatenate(seen)
    return ImagePoints(
        table[:, 0].astype(np.int64),
        table[:, 1].astype(np.int64),
        table[:, 2:] - HALF_PIXEL,
        np.tile(np.eye(2), (len(table), 1, 1)),
        np.zeros(len(table), dtype=bool),
    )


def _mounts_of(scene: Any, camera_ids: list[int]) -> Mounts | None:
    """Return the mounts of the cameras of a scene; None if every camera is single.

    The reference is COLMAP's, or the first camera of a rig whose reference sensor is not a camera.
    """
    pycolmap = load_pycolmap()
    count, index = len(camera_ids), {number: a for a, number in enumerate(camera_ids)}
    position, rotation = np.zeros((count, 3)), np.tile(np.eye(3), (count, 1, 1))
    free, names = np.zeros((count, 6), dtype=bool), [""] * count
    for number, rig in sorted(scene.rigs.items()):
        at_rig = rig.ref_sensor_id
        poses = {at_rig.id: pycolmap.Rigid3d()} if at_rig.type == pycolmap.SensorType.CAMERA else {}
        for sensor, pose in sorted(rig.non_ref_sensors.items(), key=lambda entry: entry[0].id):
            if sensor.type == pycolmap.SensorType.CAMERA:
                poses[sensor.id] = pose
        if len(poses) < 2:
            continue
        for camera, pose in poses.items():
            if camera not in index or names[index[camera]]:
                raise SurveyFileError(f"rig {number}: camera {camera} is not in the model, or on another rig")
            if pose is None:
                raise SurveyFileError(f"rig {number}: the pose of camera {camera} in it is not known")
            names[index[camera]] = f"rig {number}"
        reference, *others = poses
        for camera in others:
            a = index[camera]
            position[a], rotation[a] = mount_of(poses[camera] * poses[reference].inverse())
            free[a] = True
    return Mounts(position, rotation, free, tuple(names)) if any(names) else None


class NamedCamera(Content):
    """Properties of a camera that COLMAP does not know."""

    name: Name
    pixel_mm: tuple[Pixel, Pixel]  # width and height of a pixel, mm
    free: tuple[bool, ...]  # whether each parameter is to be adjusted
    size_px: tuple[Side, Side] | None = None  # width and height of its photographs, px
    rig: Name | None = None  # name of its rig
    mount_free: tuple[bool, bool, bool, bool, bool, bool] | None = None  # free ones of X, Y, Z and rotations


class Names(Content):
    """Content of kolinear.json."""

    cameras: tuple[NamedCamera, ...] = ()  # in the order of COLMAP's numbers
    images: dict[str, Name] = Field(default_factory=dict)  # names by COLMAP's number of the photograph
    points: dict[str, Name] = Field(default_factory=dict)  # names by COLMAP's number of the point


def read_side_file(path: Path) -> Names:
    """Read kolinear.json; the content is empty if the file is missing.

    Raises:
        SurveyFileError: the file is not valid.
    """
    if not path.is_file():
        return Names()
    return read_json(path, Names, "the names beside a COLMAP model")


def write_side_file(path: Path, network: Network, estimate: Estimate) -> None:
    """Write what COLMAP cannot store to kolinear.json."""
    mounts = estimate.mounts
    side = {
        "cameras": [
            {
                "name": camera.name,
                "size_px": [int(side) for side in camera.size_px],
                "pixel_mm": [float(side) for side in camera.pixel_mm],
                "free": camera.free.tolist(),
            }
            | (
                {"rig": mounts.rig[a], "mount_free": mounts.free[a].tolist()}
                if mounts is not None and mounts.rig[a]
                else {}
            )
            for a, camera in enumerate(estimate.cameras)
        ],
        "images": {str(i + 1): name for i, name in enumerate(network.images)},
        "points": {str(j + 1): name for j, name in enumerate(network.points)},
    }
    path.write_text(json.dumps(side, ensure_ascii=False, indent=1) + "\n", encoding="utf-8")
