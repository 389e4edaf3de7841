"""Scenes of AliceVision and Meshroom (.sfm, and .json of the node ConvertSfMFormat).

    version      three numbers
    views        photographs: viewId, poseId, intrinsicId, path, of a rig also rigId and subPoseId
    intrinsics   width, height, sensorWidth, focalLength (mm), pixelRatio, principalPoint, distortionParams
    poses        rotation (3 x 3, by columns) and center, x = R (X - center)
    structure    points: X, and observations of them (observationId is a viewId) at x

All leaves are texts. Axes are x right, y down, z forward. The principal point counts from the middle of the
photograph (w/2, h/2), before version 1.2.1 from its corner; pixels count from the centre of the first, where
its features are measured. fx = width focalLength / sensorWidth and fy = fx pixelRatio, before 1.2.5
fx / pixelRatio; before 1.2.2 both are pxFocalLength. A ray (a, b) with r2 = a2 + b2 is distorted to

    radialk1, radialk3   (1 + k1 r2 + k2 r4 + k3 r6) a
    brown                (1 + k1 r2 + k2 r4 + k3 r6) a + 2 t1 a b + t2 (r2 + 2 a2)
    fisheye4             theta (1 + k1 theta2 + ... + k4 theta8) a / r, theta = atan(r)

The view of a rig has the pose x = R_sub (R_rig (X - center_rig) - center_sub).

Source: AliceVision, scenes in src/aliceVision/sfmDataIO/compatibilityData and their documentation there.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from adapters.formats.content import Content, select_placed
from adapters.formats.stated_model import (
    StatedModel,
    content_of,
    from_vision_axes,
    numbers_of_slots,
    rigs_of,
    to_vision_axes,
)
from adapters.reading.trees import Tree, read_tree
from sfm.files.plain_text import MAX_PIXEL_MM, shorten
from sfm.files.whole_files import whole_file
from sfm.model.camera import Camera, camera_from_values
from sfm.model.conventions import FloatArray
from sfm.model.estimate import Estimate
from sfm.model.network import Network, rows_of

WHAT = "a scene of AliceVision"
# versions since which principal points, focal lengths and ratios are as described
FROM_MIDDLE, IN_MM, LARGER_RATIO = (1, 2, 1), (1, 2, 2), (1, 2, 5)
WRITTEN = ("1", "2", "8")
SENSOR_MM = 36.0  # AliceVision's width of a sensor that is not stated
# the model here and the parameters by distortionType, or by type in files without it
LENSES: dict[str, tuple[str, tuple[str, ...]]] = {
    "none": ("opencv", ()),
    "pinhole": ("opencv", ()),
    "radialk1": ("opencv", ("k1",)),
    "radial1": ("opencv", ("k1",)),
    "radialk3": ("full_opencv", ("k1", "k2", "k3")),
    "radial3": ("full_opencv", ("k1", "k2", "k3")),
    "brown": ("full_opencv", ("k1", "k2", "k3", "p1", "p2")),
    "fisheye4": ("opencv_fisheye", ("k1", "k2", "k3", "k4")),
}


def read_alicevision(path: Path) -> Content:
    """Read a scene; views without a pose have no orientation.

    Raises:
        SurveyFileError: with the file and its key.
    """
    tree = read_tree(path, WHAT)
    version = tuple(int(number) for number in tree.numbers(("version",), 3))
    stated = StatedModel(path)
    cameras: dict[str, int] = {}
    for intrinsic in tree.items("intrinsics"):
        name = intrinsic.text("intrinsicId")
        cameras[name] = len(cameras)
        stated.cameras.append(_camera(name, intrinsic, version))
    poses = {
        pose.text("poseId"): _pose(pose.below("pose").below("transform")) for pose in tree.items("poses")
    }
    for rig in tree.items("rigs"):
        for k, sub in enumerate(rig.items("subPoses")):
            place = sub.below("pose")
            R, centre = _pose(place.below("transform") if place.key("transform") else place)
            stated.places[f"{rig.text('rigId')} {k}"] = (R, -R @ centre)
    images: dict[str, int] = {}
    for view in tree.items("views"):
        of = view.text("intrinsicId")
        if of not in cameras:
            raise view.error(f"{view.place}intrinsicId is {of}, which is not among the intrinsics")
        pose = poses.get(view.text("poseId", view.text("viewId")))
        own = view.key("isPoseIndependant") is None or view.truth("isPoseIndependant")
        if pose is not None and view.key("rigId") and not own:
            rig_id, sub_pose = view.text("rigId"), _number(view, "subPoseId")
            at = f"{rig_id} {sub_pose}"
            if at not in stated.places:
                raise view.error(
                    f"{view.place}subPoseId is {sub_pose}, which is not in rig {shorten(rig_id)}"
                )
            stated.on_rig[len(stated.images)] = (at, view.text("poseId", view.text("viewId")))
            (R, t), (R_rig, centre_rig) = stated.places[at], pose
            pose = R @ R_rig, centre_rig - R_rig.T @ R.T @ t
        images[view.text("viewId")] = len(images)
        name = view.text("path", f"{view.text('viewId')}.jpg")
        if pose is None:
            stated.add_image(name, cameras[of])
        else:
            stated.add_image(name, cameras[of], pose[1], from_vision_axes(pose[0]))
    for landmark in tree.items("structure"):
        X = landmark.numbers(("X",), 3).tolist()
        j = stated.add_point(f"u{_number(landmark, 'landmarkId')}", X)
        for seen in landmark.items("observations"):
            view_id = seen.text("observationId")
            if view_id not in images:
                raise seen.error(f"{seen.place}observationId is {view_id}, which is not among the views")
            if seen.key("x"):
                x, y = seen.numbers(("x",), 2).tolist()
                stated.add_image_point(images[view_id], j, x, y)
    if stated.points and not len(stated.image):
        stated.notes.append("its structure has no observations: the points are without image points")
    return content_of(stated)


def write_alicevision(path: Path, content: Content) -> None:
    """Write what has coordinates as a scene.

    Raises:
        OutputError: the file cannot be written.
    """
    result = select_placed(content).result
    network, estimate = result.network, result.estimate
    rotation = to_vision_axes(estimate.rotation)
    poses: dict[str, tuple[FloatArray, FloatArray]] = {}  # R and centre by poseId
    rigs, of_rig = _rigs(network, estimate, poses)
    poses |= {f"{i}": (rotation[i], estimate.position[i]) for i in range(len(rotation)) if i not in of_rig}
    size = [estimate.cameras[a].size_px for a in network.camera.tolist()]
    seen = network.image_points
    slot, image, xy = numbers_of_slots(seen.image).tolist(), seen.image.tolist(), seen.xy.tolist()
    points = zip(estimate.points.tolist(), rows_of(seen.point, len(network.points)), strict=True)
    scene: dict[str, Any] = {
        "version": list(WRITTEN),
        "views": [
            {
                "viewId": f"{i}",
                "poseId": f"{i}",
                "intrinsicId": f"{network.camera[i]}",
                "path": name,
                "width": f"{size[i][0]}",
                "height": f"{size[i][1]}",
                "metadata": "",
            }
            | of_rig.get(i, {})
            for i, name in enumerate(network.images)
        ],
        "intrinsics": [_intrinsic(a, camera) for a, camera in enumerate(estimate.cameras)],
        "poses": [
            {
                "poseId": number,
                "pose": {"transform": _transform(R, centre), "locked": "0"},
            }
            for number, (R, centre) in poses.items()
        ],
        **({"rigs": rigs} if rigs else {}),
        "structure": [
            {
                "landmarkId": f"{j}",
                "descType": "unknown",
                "color": ["0", "0", "0"],
                "X": _texts(xyz),
                "observations": [
                    {
                        "observationId": f"{image[r]}",
                        "featureId": f"{slot[r]}",
                        "x": _texts(xy[r]),
                        "scale": "0",
                    }
                    for r in rows.tolist()
                ],
            }
            for j, (xyz, rows) in enumerate(points)
        ],
    }
    with whole_file(path) as part:
        part.write_text(json.dumps(scene, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def _rigs(
    network: Network, estimate: Estimate, poses: dict[str, tuple[FloatArray, FloatArray]]
) -> tuple[list[dict[str, Any]], dict[int, dict[str, str]]]:
    """Return the rigs, and the keys of their views by photograph; poses get R and centre of their moments."""
    places, frames = rigs_of(network, estimate)
    rigs, sub_pose = list[dict[str, Any]](), dict[int, tuple[str, str]]()
    for number, cameras in enumerate(estimate.mounts.by_rig().values() if estimate.mounts else ()):
        on = [a for a in cameras if a in places]
        sub_pose |= {a: (f"{number}", f"{k}") for k, a in enumerate(on)}
        transforms = [_transform(R, -R.T @ t) for R, t in (places[a] for a in on)]
        rigs.append(
            {
                "rigId": f"{number}",
                "subPoses": [{"status": "estimated", "pose": transform} for transform in transforms],
            }
        )
    views: dict[int, dict[str, str]] = {}
    for frame in frames.values():
        R, t = frame.pose
        first = f"{frame.photographs[0]}"  # the poses of other photographs are not used
        poses[first] = (R, -R.T @ t)
        for i in frame.photographs:
            rig, sub = sub_pose[int(network.camera[i])]
            views[i] = {"poseId": first, "rigId": rig, "subPoseId": sub, "isPoseIndependant": "false"}
    return rigs if views else [], views


def _transform(R: FloatArray, centre: FloatArray) -> dict[str, list[str]]:
    return {"rotation": _texts(R.T), "center": _texts(centre)}


def _camera(name: str, tree: Tree, version: tuple[int, ...]) -> Camera:
    """Return the camera of an intrinsic."""
    kind, lens = tree.text("type"), tree.text("distortionType", tree.text("type"))
    if lens not in LENSES or kind == "equidistant":
        raise tree.error(
            f"{tree.place}type is {shorten(kind)} with distortion {shorten(lens)}, which no model here has; "
            f"expected one of {', '.join(LENSES)}"
        )
    size = tree.sides(("width",), ("height",))
    sensor = tree.number("sensorWidth") if tree.key("sensorWidth") else SENSOR_MM
    pixel = sensor / size[0]
    if version < IN_MM:
        fx, fy = tree.numbers(("pxFocalLength",), 1, 2)[[0, -1]].tolist()
    else:
        ratio = tree.number("pixelRatio") if tree.key("pixelRatio") else 1.0
        fx = tree.number("focalLength") / pixel if pixel > 0 else 0.0
        fy = fx * ratio if version >= LARGER_RATIO or not ratio else fx / ratio
    if not (0 < pixel <= MAX_PIXEL_MM and fx > 0 and fy > 0):
        raise tree.error(
            f"{tree.place}sensorWidth {sensor:g} mm and focal lengths {fx:g} and {fy:g} px: all must be more "
            "than 0"
        )
    model, names = LENSES[lens]
    stated = tree.values.get("distortionParams") or []  # Boost writes "" for an empty list
    values = tree.numbers(("distortionParams",), len(names)).tolist() if stated or names else []
    offset = tree.numbers(("principalPoint",), 2) if tree.key("principalPoint") else np.zeros(2)
    p = dict(zip(names, values, strict=True))
    if model == "full_opencv" and not p.get("k3"):
        model = "opencv"
        p.pop("k3", None)
    middle = np.array(size) / 2 if version >= FROM_MIDDLE else np.zeros(2)
    p |= {"fx": fx, "fy": fy, "cx": middle[0] + offset[0], "cy": middle[1] + offset[1]}
    return camera_from_values(
        name, model, size, (pixel, pixel), c_mm=fx * pixel, values=tuple((k, float(v)) for k, v in p.items())
    )


def _intrinsic(number: int, camera: Camera) -> dict[str, Any]:
    """Return the intrinsic of a camera in model opencv, full_opencv or opencv_fisheye."""
    p = dict(zip(camera.names, camera.parameters.tolist(), strict=True))
    width, height = camera.size_px
    pixel = float(camera.pixel_mm[0])
    lens = "fisheye4" if camera.model == "opencv_fisheye" else "brown" if p["p1"] or p["p2"] else "radialk3"
    values = [p.get(name, 0.0) for name in LENSES[lens][1]]
    return {
        "intrinsicId": f"{number}",
        "width": f"{width}",
        "height": f"{height}",
        "sensorWidth": repr(width * pixel),
        "sensorHeight": repr(height * float(camera.pixel_mm[1])),
        "serialNumber": camera.name,
        "type": "pinhole",
        "initializationMode": "estimated",
        "initialFocalLength": "-1",
        "focalLength": repr(p["fx"] * pixel),
        "pixelRatio": repr(p["fy"] / p["fx"]),
        "pixelRatioLocked": "false",
        "principalPoint": _texts([p["cx"] - width / 2, p["cy"] - height / 2]),
        "distortionInitializationMode": "none",
        "distortionParams": _texts(values),
        "undistortionOffset": ["0", "0"],
        "undistortionParams": "",
        "distortionType": lens,
        "undistortionType": "none",
        "locked": "false",
    }


def _pose(tree: Tree) -> tuple[FloatArray, FloatArray]:
    """Return R (3, 3), object to camera axes, and centre (3,) of a transform."""
    return tree.numbers(("rotation",), 9).reshape(3, 3).T, tree.numbers(("center",), 3)


def _number(tree: Tree, name: str) -> int:
    text = tree.text(name)
    if not (text.isascii() and text.isdecimal()):
        raise tree.error(f"{tree.place}{name} is '{shorten(text)}', needed a whole number")
    return int(text)


def _texts(values: Any) -> list[str]:
    return [repr(float(value)) for value in np.ravel(values)]
