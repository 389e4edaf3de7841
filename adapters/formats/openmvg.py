"""Scenes of OpenMVG (sfm_data.json).

    root_path        folder of the photographs
    views            photographs: local_path, filename, width, height, id_view, id_intrinsic, id_pose
    intrinsics       width, height, focal_length, principal_point, and the distortion by its own key
    extrinsics       rotation (3 x 3, by rows) and center, x = R (X - center)
    structure        points: X, and observations of them (the key is an id_view) at x

Every list has entries {key, value}. Axes are x right, y down, z forward. The principal point and image points
count from the centre of the first pixel. A ray (a, b) with r2 = a2 + b2 is distorted to

    disto_k1, disto_k3   (1 + k1 r2 + k2 r4 + k3 r6) a
    disto_t2             (1 + k1 r2 + k2 r4 + k3 r6) a + 2 t1 a b + t2 (r2 + 2 a2)
    fisheye              theta (1 + k1 theta2 + ... + k4 theta8) a / r, theta = atan(r)

There is one focal length, as in `brown_forward`.

Source: OpenMVG documentation, "openMVG_main_SfMInit_ImageListing" and "openMVG cameras".
"""

from __future__ import annotations

import json
from pathlib import Path, PurePosixPath
from typing import Any

from adapters.formats.content import Content, select_placed
from adapters.formats.stated_model import (
    StatedModel,
    content_of,
    from_vision_axes,
    numbers_of_slots,
    to_vision_axes,
)
from adapters.reading.trees import Tree, read_tree
from sfm.files.plain_text import shorten
from sfm.files.whole_files import whole_file
from sfm.model.camera import Camera, camera_from_values
from sfm.model.network import rows_of

WHAT = "a sfm_data.json of OpenMVG"
VERSION = "0.3"
NEW = 2**31  # added to the number of a kind, or an object, where it is stated first
VIEW = 2**30  # number of the kind of a view without further kinds
# polymorphic_name, and the number of parameters, by the key of the distortion
LENSES = {
    "disto_k1": ("pinhole_radial_k1", 1),
    "disto_k3": ("pinhole_radial_k3", 3),
    "disto_t2": ("pinhole_brown_t2", 5),
    "fisheye": ("fisheye", 4),
}


def read_openmvg(path: Path) -> Content:
    """Read a scene; views without a pose have no orientation.

    Raises:
        SurveyFileError: with the file and its key.
    """
    tree = read_tree(path, WHAT)
    stated = StatedModel(path)
    cameras: dict[str, int] = {}
    for entry in tree.items("intrinsics"):
        name = entry.text("key")
        cameras[name] = len(cameras)
        stated.cameras.append(_camera(name, entry.below("value")))
    poses = {entry.text("key"): entry.below("value") for entry in tree.items("extrinsics")}
    images: dict[str, int] = {}
    without = 0
    for entry in tree.items("views"):
        view = entry.below("value").below("ptr_wrapper").below("data")
        view = view.below("value0") if view.key("value0") else view  # of a view with an observed position
        of = view.text("id_intrinsic")
        if of not in cameras:
            without += 1
            continue
        name = view.text("filename")
        folder = view.text("local_path", "").strip("/\\") if view.values.get("local_path") else ""
        name = f"{folder}/{name}" if folder and not name.startswith(folder) else name
        images[entry.text("key")] = len(images)
        pose = poses.get(view.text("id_pose"))
        if pose is None:
            stated.add_image(name, cameras[of])
            continue
        R = pose.numbers(("rotation",), 9).reshape(3, 3)
        stated.add_image(name, cameras[of], pose.numbers(("center",), 3), from_vision_axes(R))
    ids = {entry.text("key") for entry in tree.items("views")}
    for entry in tree.items("structure"):
        key = entry.text("key")
        if not (key.isascii() and key.isdecimal()):
            raise entry.error(f"{entry.place}key is '{shorten(key)}', needed a whole number")
        point = entry.below("value")
        j = stated.add_point(f"u{key}", point.numbers(("X",), 3).tolist())
        for observation in point.items("observations"):
            view_id = observation.text("key")
            if view_id not in ids:
                raise observation.error(
                    f"{observation.place}key is '{shorten(view_id)}', which is not among the views"
                )
            if view_id in images:
                x, y = observation.below("value").numbers(("x",), 2).tolist()
                stated.add_image_point(images[view_id], j, x, y)
    if without:
        stated.notes.append(f"{without} views without a camera left out")
    if tree.items("control_points"):
        stated.notes.append("its control points are left out")
    return content_of(stated)


def write_openmvg(path: Path, content: Content) -> None:
    """Write what has coordinates as a scene.

    Args:
        path: new file.
        content: cameras in model brown_forward with square pixels, without K4, b1 and b2, or opencv_fisheye
            with fx = fy.

    Raises:
        OutputError: the file cannot be written.
    """
    result = select_placed(content).result
    network, estimate = result.network, result.estimate
    R = to_vision_axes(estimate.rotation)
    seen = network.image_points
    slot, image, xy = numbers_of_slots(seen.image).tolist(), seen.image.tolist(), seen.xy.tolist()
    points = zip(estimate.points.tolist(), rows_of(seen.point, len(network.points)), strict=True)
    kinds: dict[str, int] = {}
    views = []
    for i, (name, a) in enumerate(zip(network.images, network.camera.tolist(), strict=True)):
        width, height = estimate.cameras[a].size_px
        folder, filename = str(PurePosixPath(name).parent), PurePosixPath(name).name
        data = {
            "local_path": "" if folder == "." else folder,
            "filename": filename,
            "width": width,
            "height": height,
            "id_view": i,
            "id_intrinsic": a,
            "id_pose": i,
        }
        views.append(_entry(i, {"polymorphic_id": VIEW, "ptr_wrapper": {"id": NEW + 1 + i, "data": data}}))
    first = NEW + 1 + len(views)
    scene: dict[str, Any] = {
        "sfm_data_version": VERSION,
        "root_path": "",
        "views": views,
        "intrinsics": [
            _entry(a, _intrinsic(camera, kinds, first + a)) for a, camera in enumerate(estimate.cameras)
        ],
        "extrinsics": [
            _entry(i, {"rotation": R[i].tolist(), "center": estimate.position[i].tolist()})
            for i in range(len(network.images))
        ],
        "structure": [
            _entry(
                j,
                {
                    "X": xyz,
                    "observations": [
                        _entry(image[r], {"id_feat": slot[r], "x": xy[r]}) for r in rows.tolist()
                    ],
                },
            )
            for j, (xyz, rows) in enumerate(points)
        ],
        "control_points": [],
    }
    with whole_file(path) as part:
        text = json.dumps(scene, indent=1, ensure_ascii=False, allow_nan=False)
        part.write_text(text + "\n", encoding="utf-8")


def _entry(key: int, value: dict[str, Any]) -> dict[str, Any]:
    return {"key": key, "value": value}


def _camera(name: str, value: Tree) -> Camera:
    """Return a camera; a pixel is 1 mm, as the file does not state its size."""
    data = value.below("ptr_wrapper").below("data")
    plane = data.below("value0") if data.key("value0") else data  # as OpenMVG before 1.5 writes it
    kind = value.text("polymorphic_name", "")
    lens = data.key(*LENSES)
    if lens is None and not plane.key("focal_length"):
        raise data.error(
            f"{data.place}: the camera is {shorten(kind) or 'of no kind'}, which no model here has; expected "
            f"pinhole, {', '.join(name for name, _ in LENSES.values())}"
        )
    size = plane.sides(("width",), ("height",))
    f = plane.number("focal_length")
    if not f > 0:
        raise plane.error(f"{plane.place}focal_length {f:g} px, it must be positive")
    x, y = plane.numbers(("principal_point",), 2).tolist()
    k = [0.0] * 5
    if lens is not None:
        values = data.numbers((lens,), LENSES[lens][1]).tolist()
        if lens == "fisheye":
            p = dict(
                zip(("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"), (f, f, x, y, *values), strict=True)
            )
            return camera_from_values(
                name, "opencv_fisheye", size, (1.0, 1.0), c_mm=f, values=tuple(p.items())
            )
        k[: len(values)] = values
    k1, k2, k3, t1, t2 = k
    of = {"x0": x - (size[0] - 1) / 2, "y0": (size[1] - 1) / 2 - y, "P1": t2 / f, "P2": -t1 / f}
    of |= {"K1": k1 / f**2, "K2": k2 / f**4, "K3": k3 / f**6}
    return camera_from_values(name, "brown_forward", size, (1.0, 1.0), c_mm=f, values=tuple(of.items()))


def _intrinsic(camera: Camera, kinds: dict[str, int], number: int) -> dict[str, Any]:
    """Return the value of an intrinsic.

    Args:
        camera: the camera.
        kinds: numbers of the kinds that were stated already; the new one is added.
        number: of the object, from 2^31.
    """
    p = dict(zip(camera.names, camera.parameters.tolist(), strict=True))
    width, height = camera.size_px
    principal = camera.principal_point_px - 0.5
    if camera.model == "opencv_fisheye":
        lens, values = "fisheye", [p[f"k{i}"] for i in (1, 2, 3, 4)]
    else:
        c = p["c"]
        k = [p[f"K{i}"] * c ** (2 * i) for i in (1, 2, 3)]
        tangential = [-p["P2"] * c, p["P1"] * c]
        lens, values = ("disto_t2", k + tangential) if any(tangential) else ("disto_k3", k)
    data = {
        "width": width,
        "height": height,
        "focal_length": camera.c_px,
        "principal_point": principal.tolist(),
        lens: values,
    }
    kind = LENSES[lens][0]
    wrapper = {"ptr_wrapper": {"id": number, "data": data}}
    if kind in kinds:
        return {"polymorphic_id": kinds[kind], **wrapper}
    kinds[kind] = len(kinds) + 1
    return {"polymorphic_id": NEW + kinds[kind], "polymorphic_name": kind, **wrapper}
