"""OpenSfM reconstructions and the projects of OpenDroneMap, which hold them in a folder opensfm/.

    reconstruction.json   a list of parts; each has cameras, shots (photographs), points, by their names
    tracks.csv            image track feature x y scale ..., separated by tabs; a track is a point

A shot has a rotation vector and a translation, x = R X + t, with axes x right, y down, z forward. A
photograph of a rig may only have the pose of its rig, x = R_camera (R_rig X + t_rig) + t_camera. Lengths in
photographs are in parts of the longer side, from the middle; with a = x/z, b = y/z, r2 = a2 + b2 and
theta = atan(r)

    perspective          focal (1 + k1 r2 + k2 r4) a
    simple_radial        focal_x (1 + k1 r2) a + c_x
    radial               focal_x (1 + k1 r2 + k2 r4) a + c_x
    brown                focal_x ((1 + k1 r2 + k2 r4 + k3 r6) a + 2 p1 a b + p2 (r2 + 2 a2)) + c_x
    fisheye              focal theta (1 + k1 theta2 + k2 theta4) a / r
    fisheye_opencv       focal_x theta (1 + k1 theta2 + ... + k4 theta8) a / r + c_x

and the same for y with b, focal_y, c_y and p1, p2 exchanged.

Source: OpenSfM documentation, "Geometric models" and "Reconstruction file format".
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from adapters.formats.cameras.lens_terms import camera_in_pixels
from adapters.formats.content import Content, select_placed
from adapters.formats.stated_model import (
    StatedModel,
    content_of,
    file_in,
    from_vision_axes,
    numbers_of_slots,
    rigs_of,
    to_vision_axes,
)
from adapters.reading.text_lines import Lines, write_lines
from adapters.reading.trees import Tree, read_trees
from sfm.files.plain_text import shorten
from sfm.files.whole_files import whole_file
from sfm.model.camera import Camera
from sfm.model.conventions import FloatArray, pixel_from_longer_side
from sfm.model.display import counted

WHAT = "a reconstruction.json of OpenSfM"
RECONSTRUCTION, TRACKS = "reconstruction.json", "tracks.csv"
PLACES = (RECONSTRUCTION, f"opensfm/{RECONSTRUCTION}")  # in the folder of OpenSfM, and of OpenDroneMap
VERSION = "OPENSFM_TRACKS_VERSION_v2"
ONE, TWO = ("focal",), ("focal_x", "focal_y", "c_x", "c_y")
# the camera models by projection_type: the model here, the keys of its plane and of its other parameters
PROJECTIONS = {
    "perspective": ("radial", ONE, ("k1", "k2")),
    "simple_radial": ("opencv", TWO, ("k1",)),
    "radial": ("opencv", TWO, ("k1", "k2")),
    "brown": ("full_opencv", TWO, ("k1", "k2", "p1", "p2", "k3")),
    "fisheye": ("radial_fisheye", ONE, ("k1", "k2")),
    "fisheye_opencv": ("opencv_fisheye", TWO, ("k1", "k2", "k3", "k4")),
}
PARAMETERS = {"radial": 2, "radial_fisheye": 2, "opencv": 4, "full_opencv": 8, "opencv_fisheye": 4}
COLUMNS = 5  # of tracks.csv that are read; further ones differ between its versions


def read_opensfm(path: Path) -> Content:
    """Read the largest part of a reconstruction, and its tracks where tracks.csv is beside it.

    Args:
        path: reconstruction.json, its folder, or the folder of an OpenDroneMap project.

    Raises:
        SurveyFileError: with the file and its key or line.
    """
    file = file_in(path, *PLACES) or path
    parts = read_trees(file, WHAT)
    sizes = [len(part.entries("shots")) for part in parts]
    part = parts[int(np.argmax(sizes))]
    stated = StatedModel(file)
    if len(parts) > 1:
        others = sum(sizes) - max(sizes)
        stated.notes.append(
            f"{counted(len(parts) - 1, 'smaller part')} of the reconstruction with "
            f"{counted(others, 'photograph')} left out, one part has one datum"
        )
    cameras = part.entries("cameras")
    stated.cameras = [_camera(name, tree) for name, tree in cameras.items()]
    number = {name: a for a, name in enumerate(cameras)}
    rigs = _read_rigs(part, stated)
    for name, shot in part.entries("shots").items():
        of = shot.text("camera")
        if of not in number:
            raise shot.error(f"{shot.place}camera is '{shorten(of)}', which is not among its cameras")
        if name in rigs:
            place, instance, pose = rigs[name]
            stated.on_rig[len(stated.images)] = (place, instance)
        R, t = pose if name in rigs and shot.key("rotation") is None else _pose(shot)
        stated.add_image(name, number[of], -R.T @ t, from_vision_axes(R))
    points: dict[str, int] = {}
    for name, tree in part.entries("points").items():
        if not name.isascii() or not name.isalnum():
            raise tree.error(
                f"{tree.place}: the name of a point is '{shorten(name)}', needed letters or digits"
            )
        points[name] = stated.add_point(
            f"u{name}" if name.isdecimal() else name, tree.numbers(("coordinates",), 3).tolist()
        )
    tracks = file_in(file.parent, TRACKS)
    if tracks is not None:
        _read_tracks(tracks, stated, points)
    elif stated.images and points:
        stated.notes.append(f"no {TRACKS} is beside it: the points are without image points")
    return content_of(stated)


def write_opensfm(folder: Path, content: Content) -> None:
    """Write what has coordinates as reconstruction.json and tracks.csv.

    Raises:
        OutputError: the folder cannot be written.
    """
    result = select_placed(content).result
    network, estimate = result.network, result.estimate
    names = [f"{a + 1} {camera.name}" for a, camera in enumerate(estimate.cameras)]
    rotation = to_vision_axes(estimate.rotation)
    shots = {
        name: {"camera": names[a]} | _keys_of_pose(R, -R @ position)
        for name, a, R, position in zip(
            network.images, network.camera.tolist(), rotation, estimate.position, strict=True
        )
    }
    part: dict[str, Any] = {
        "cameras": {name: _keys_of(camera) for name, camera in zip(names, estimate.cameras, strict=True)},
        "shots": shots,
        "points": {
            f"{j}": {"color": [0.0, 0.0, 0.0], "coordinates": xyz}
            for j, xyz in enumerate(estimate.points.tolist())
        },
    }
    places, frames = rigs_of(network, estimate)
    if places:
        part["rig_cameras"] = {names[a]: _keys_of_pose(*pose) for a, pose in places.items()}
        part["rig_instances"] = {
            f"{t}": _keys_of_pose(*frame.pose)
            | {"rig_camera_ids": {network.images[i]: names[network.camera[i]] for i in frame.photographs}}
            for t, frame in frames.items()
        }
    folder.mkdir(parents=True, exist_ok=True)
    with whole_file(folder / RECONSTRUCTION) as file:
        file.write_text(json.dumps([part], indent=1, allow_nan=False) + "\n", encoding="utf-8")
    seen = network.image_points
    size = np.array([camera.size_px for camera in estimate.cameras], dtype=float).reshape(-1, 2)
    size = size[network.camera[seen.image]]
    longer = size.max(axis=1)
    xy = (seen.xy - (size - 1) / 2) / longer[:, None]
    scale = np.sqrt(np.einsum("kii->k", seen.covariance) / 2) / longer
    columns = zip(
        seen.image.tolist(), seen.point.tolist(), numbers_of_slots(seen.image).tolist(), xy.tolist(),
        scale.tolist(), strict=True,
    )  # fmt: skip
    rows = [
        f"{network.images[i]}\t{j}\t{slot}\t{x!r}\t{y!r}\t{s!r}\t0\t0\t0\t-1\t-1"
        for i, j, slot, (x, y), s in columns
    ]
    write_lines(folder / TRACKS, [VERSION, *rows])


def _camera(name: str, tree: Tree) -> Camera:
    """Return a camera in px; a pixel is 1 mm, as the file does not state its size."""
    kind = tree.text("projection_type", "perspective")
    if kind not in PROJECTIONS:
        raise tree.error(
            f"{tree.place}projection_type is {kind}, which no model here has; expected one of "
            f"{', '.join(PROJECTIONS)}"
        )
    model, keys, others = PROJECTIONS[kind]
    size = tree.sides(("width",), ("height",))
    longer, middle = max(size), (np.array(size) - 1) / 2
    plane = np.array([tree.number(key) if key in ("focal", "focal_x", "focal_y") or tree.key(key) else 0.0
                      for key in keys]) * longer  # fmt: skip
    plane = np.concatenate([plane, middle]) if keys == ONE else plane + np.concatenate([[0, 0], middle])
    values = np.zeros(PARAMETERS[model])
    values[: len(others)] = [tree.number(key) if tree.key(key) else 0.0 for key in others]
    if model == "full_opencv" and not values[4:].any():
        model, values = "opencv", values[:4]
    return camera_in_pixels(f"{tree.path}: {tree.place}", name, model, size, np.concatenate([plane, values]))


def _keys_of(camera: Camera) -> dict[str, Any]:
    """Return the keys of a camera: its projection has all its parameters, and no others that are not 0."""
    p = dict(zip(camera.names, camera.parameters.tolist(), strict=True))
    width, height = camera.size_px
    longer = max(width, height)
    c_x, c_y = ((p["cx"] - (width - 1) / 2) / longer, (p["cy"] - (height - 1) / 2) / longer)
    fisheye = camera.model in ("radial_fisheye", "opencv_fisheye")
    one = "f" in p and not (c_x or c_y)
    kind = ("fisheye" if one else "fisheye_opencv") if fisheye else "perspective" if one else "brown"
    _, keys, others = PROJECTIONS[kind]
    fx, fy = (p["f"], p["f"]) if "f" in p else (p["fx"], p["fy"])
    of = {"focal": fx / longer, "focal_x": fx / longer, "focal_y": fy / longer, "c_x": c_x, "c_y": c_y}
    return (
        {"projection_type": kind, "width": width, "height": height}
        | {key: of[key] for key in keys}
        | {key: p.get(key, 0.0) for key in others}
    )


def _keys_of_pose(R: FloatArray, t: FloatArray) -> dict[str, Any]:
    """Return the keys of a pose x = R X + t."""
    return {"rotation": Rotation.from_matrix(R).as_rotvec().tolist(), "translation": t.tolist()}


def _pose(tree: Tree) -> tuple[FloatArray, FloatArray]:
    """Return R (3, 3) and t (3,) of a rotation vector and a translation."""
    vector = tree.numbers(("rotation",), 3)
    return Rotation.from_rotvec(vector).as_matrix(), tree.numbers(("translation",), 3)


def _read_rigs(part: Tree, stated: StatedModel) -> dict[str, tuple[str, str, tuple[FloatArray, FloatArray]]]:
    """Add the places on rigs, and return place, moment and pose of the photographs of rigs by their names."""
    mounts = stated.places = {name: _pose(tree) for name, tree in part.entries("rig_cameras").items()}
    shots = {}
    for name, instance in part.entries("rig_instances").items():
        R, t = _pose(instance)
        of_shots = instance.below("rig_camera_ids")
        for shot in of_shots.values:
            mount = of_shots.text(shot)
            if mount not in mounts:
                raise instance.error(
                    f"{instance.place}rig_camera_ids: '{shorten(mount)}' is not among the rig_cameras"
                )
            R_mount, t_mount = mounts[mount]
            shots[shot] = (mount, name, (R_mount @ R, R_mount @ t + t_mount))
    return shots


def _read_tracks(path: Path, stated: StatedModel, points: dict[str, int]) -> None:
    """Add the image points of the photographs and points of a part."""
    text = stated.text = Lines.of(path)
    image = {name: i for i, name in enumerate(stated.images)}
    sizes = np.array([camera.size_px for camera in stated.cameras], dtype=float).reshape(-1, 2)
    left_out = 0
    while (line := text.maybe_line()) is not None:
        if not line.strip() or (text.number == 1 and line.startswith("OPENSFM_TRACKS_VERSION")):
            continue
        words = line.split("\t")
        if len(words) < COLUMNS:
            raise text.error(f"{len(words)} columns, needed {COLUMNS} or more: image, track, feature, x, y")
        xy = np.array([[text.number_of(words[3]), text.number_of(words[4])]])
        if words[0] not in image or words[1] not in points:
            left_out += 1
            continue
        i = image[words[0]]
        x, y = pixel_from_longer_side(xy, sizes[[stated.camera[i]]])[0].tolist()
        stated.add_image_point(i, points[words[1]], x, y)
    stated.text = None
    if left_out:
        stated.notes.append(
            f"{counted(left_out, 'image point')} of {TRACKS} left out, whose photograph or point is not in "
            "the reconstruction"
        )
