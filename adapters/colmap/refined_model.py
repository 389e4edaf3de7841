"""A COLMAP model that is opened, updated with a new solution, and otherwise left unchanged.

Numbers, colours, key points without a point, points of two photographs, camera models and rigs remain those
of the model that was opened.

Source: COLMAP 4.2 documentation, "Camera Models" and "Rigs and Frames".
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from adapters.colmap.adjuster import load_pycolmap, quiet
from adapters.colmap.camera_models import named_network, read_scene
from adapters.colmap.reconstruction import HALF_PIXEL, camera_from_rig, camera_of, colmap_parameters
from sfm.model.conventions import VISION_AXES, BoolArray, FloatArray, IntArray
from sfm.model.errors import BackendError
from sfm.model.estimate import Estimate
from sfm.model.network import Network, rows_of
from sfm.model.similarity import Similarity


@dataclass(frozen=True)
class OpenModel:
    """A COLMAP model, and the numbering of its image points."""

    scene: Any  # pycolmap.Reconstruction
    network: Network
    estimate: Estimate
    camera_ids: tuple[int, ...]  # COLMAP's numbers
    image_ids: tuple[int, ...]
    point_ids: tuple[int, ...]
    slot: IntArray  # index of each image point among the key points of its photograph, (k,)

    @property
    def models(self) -> tuple[str, ...]:
        """COLMAP's names of the camera models."""
        return tuple(str(self.scene.camera(i).model_name) for i in self.camera_ids)

    @property
    def rigs(self) -> int:
        """Number of rigs with more than one camera."""
        return sum(rig.num_sensors() > 1 for rig in self.scene.rigs.values())


def open_model(folder: Path) -> OpenModel:
    """Read a COLMAP model, binary or text, to update it.

    Raises:
        SurveyFileError: as `adapters.colmap.camera_models.read_model`.
        BackendError: likewise, for example for a panorama.
    """
    scene = read_scene(folder)
    network, estimate = named_network(folder, scene)
    camera_ids, image_ids = sorted(scene.cameras), sorted(scene.images)
    same = [camera_of(scene.camera(i)) for i in camera_ids]
    cameras = tuple(
        camera if camera.model == original.model else replace(original, name=camera.name)
        for original, camera in zip(same, estimate.cameras, strict=True)
    )
    slots = [
        np.array([k for k, p in enumerate(scene.image(i).points2D) if p.has_point3D()], dtype=np.int64)
        for i in image_ids
    ]
    return OpenModel(
        scene,
        network,
        replace(estimate, cameras=cameras),
        tuple(camera_ids),
        tuple(image_ids),
        tuple(sorted(scene.point3D_ids())),
        np.concatenate([np.zeros(0, dtype=np.int64), *slots]),
    )


def join_cameras_of(model: OpenModel, network: Network, estimate: Estimate, owner: IntArray) -> OpenModel:
    """Return a model with fewer cameras, each numbered as the first of those that it replaces.

    Args:
        model: the model, without rigs.
        network: its network with the new cameras.
        estimate: its solution with the new cameras.
        owner: new camera of each camera of the model, (a,).

    Raises:
        BackendError: the model has rigs.
    """
    if model.rigs:
        raise BackendError("cameras of a model with rigs are not joined")
    pycolmap = load_pycolmap()
    first = [model.camera_ids[k] for k in np.unique(owner, return_index=True)[1].tolist()]
    scene = pycolmap.Reconstruction()
    with quiet(pycolmap):
        for number, camera in zip(first, estimate.cameras, strict=True):
            of_scene = model.scene.camera(number)
            of_scene.params = colmap_parameters(camera)
            scene.add_camera_with_trivial_rig(of_scene)
        for i, a in zip(model.image_ids, network.camera.tolist(), strict=True):
            image = model.scene.image(i)
            copy = pycolmap.Image(
                name=image.name, points2D=image.points2D, camera_id=first[a], image_id=image.image_id
            )
            if image.has_pose:
                scene.add_image_with_trivial_frame(copy, image.cam_from_world())
            else:
                scene.add_image_with_trivial_frame(copy)
        for j in model.point_ids:
            scene.add_point3D_with_id(j, model.scene.point3D(j))
    return replace(model, scene=scene, network=network, estimate=estimate, camera_ids=tuple(first))


def place_model(model: OpenModel, object_from_model: Similarity) -> OpenModel:
    """Return a model in another frame and scale, including its rigs; its scene is changed in place."""
    pycolmap = load_pycolmap()
    rotation = pycolmap.Rotation3d(object_from_model.rotation)
    model.scene.transform(pycolmap.Sim3d(object_from_model.scale, rotation, object_from_model.translation))
    return replace(model, estimate=object_from_model.apply_estimate(model.estimate))


def update_model(
    model: OpenModel,
    estimate: Estimate,
    *,
    xy: FloatArray,
    measured: BoolArray,
    images: BoolArray,
    points: BoolArray,
) -> None:
    """Update a model with a solution: cameras, mounts, poses, points and image points.

    Args:
        model: the model, which is changed in place.
        estimate: solution for the same photographs and points.
        xy: image points, px, used where measured, (k, 2).
        measured: image points measured anew; the others are detached from their points if adjusted, (k,).
        images: photographs that were adjusted, (m,).
        points: points that were adjusted, (n,).
    """
    pycolmap = load_pycolmap()
    scene, seen = model.scene, model.network.image_points
    with quiet(pycolmap):
        for k, i in enumerate(model.camera_ids):
            if images[model.network.camera == k].any():
                scene.camera(i).params = colmap_parameters(estimate.cameras[k])
        for rig in scene.rigs.values():
            for sensor in rig.non_ref_sensors:
                k = model.camera_ids.index(sensor.id)
                if estimate.mounts is not None and estimate.mounts.rig[k]:
                    rig.set_sensor_from_rig(sensor, camera_from_rig(pycolmap, estimate.mounts, k))
        for i, rows in enumerate(rows_of(seen.image, len(images))):
            image = scene.image(model.image_ids[i])
            key_points = image.points2D
            for row in rows[measured[rows]].tolist():
                key_points[int(model.slot[row])].xy = xy[row] + HALF_PIXEL
            lost = rows[~measured[rows] & points[seen.point[rows]]]
            for row in lost.tolist():
                scene.delete_observation(model.image_ids[i], int(model.slot[row]))
            if images[i]:
                R = VISION_AXES @ estimate.rotation[i].T
                pose = pycolmap.Rigid3d(pycolmap.Rotation3d(R), -R @ estimate.position[i])
                image.frame.set_cam_from_world(image.camera_id, pose)
        for j, xyz in enumerate(estimate.points):
            if np.isfinite(xyz).all() and scene.exists_point3D(model.point_ids[j]):
                scene.point3D(model.point_ids[j]).xyz = xyz


def keep_key_points(model: OpenModel, estimate: Estimate) -> None:
    """Update a model with a solution of its own key points, which stay as they are.

    Args:
        model: the model, which is changed in place.
        estimate: solution for the same photographs and points.
    """
    seen = model.network.image_points
    update_model(
        model,
        estimate,
        xy=seen.xy,
        measured=np.ones(len(seen), dtype=bool),
        images=estimate.oriented,
        points=np.zeros(len(model.network.points), dtype=bool),
    )


def key_points_of(model: OpenModel) -> tuple[int, float]:
    """Return the number of key points with a point, and the RMS per coordinate by COLMAP's projection, px."""
    scene, count, projected, squares = model.scene, 0, 0, 0.0
    for i in scene.reg_image_ids():
        image = scene.image(i)
        used = [p for p in image.points2D if p.has_point3D()]
        if used:
            pose = image.cam_from_world().matrix()
            xyz = np.array([scene.point3D(p.point3D_id).xyz for p in used]) @ pose[:, :3].T + pose[:, 3]
            computed = scene.camera(image.camera_id).img_from_cam(xyz)
            before = np.isfinite(computed).all(axis=1)  # COLMAP does not project points behind a photograph
            squares += float(((computed - np.array([p.xy for p in used]))[before] ** 2).sum())
            count += len(used)
            projected += int(before.sum())
    return count, float(np.sqrt(squares / (2 * max(projected, 1))))


def interior_rows(
    model: OpenModel, before: Estimate, after: Estimate, covariance: tuple[FloatArray, ...]
) -> tuple[tuple[object, ...], ...]:
    """Return camera, model, parameter, values before and after, and sigma (NaN if held), in COLMAP's terms.

    Args:
        model: model of the cameras.
        before: estimate as it was read.
        after: adjusted estimate.
        covariance: covariance of the free parameters of each camera, (f, f).
    """
    rows: list[tuple[object, ...]] = []
    for k, number in enumerate(model.camera_ids):
        camera = after.cameras[k]
        sigma = np.full(len(camera.names), np.nan)
        if len(covariance[k]):  # none without photographs
            sigma[camera.free] = np.sqrt(np.diagonal(covariance[k]))
        values = (colmap_parameters(estimate.cameras[k]).tolist() for estimate in (before, after))
        rows += [
            (number, model.models[k], *row) for row in zip(camera.names, *values, sigma.tolist(), strict=True)
        ]
    return tuple(rows)
