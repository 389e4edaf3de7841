"""A COLMAP model opened to be changed in place: what is solved anew is put in, all else stays as it is.

Numbers, colours, key points that no point claims, points of two photographs, camera models and rigs are
those of the model that was opened.

Source: COLMAP 4.2 documentation, "Camera Models" and "Rigs and Frames".
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from adapters.colmap.adjuster import load_pycolmap, quiet
from adapters.colmap.camera_models import named_network, read_scene
from adapters.colmap.reconstruction import AXES, HALF_PIXEL, colmap_camera
from sfm.camera import Camera
from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.network import Estimate, Network, rows_of
from sfm.similarity import Similarity, fit_similarity

# COLMAP's models with one focal length, and how many coefficients of radial distortion they have: they are
# read as the model of ours that has one, too
SINGLE_FOCAL = {"SIMPLE_PINHOLE": 0, "SIMPLE_RADIAL": 1, "RADIAL": 2}
STEPS = 200  # of COLMAP's adjuster, that holds the cameras of a rig together


@dataclass(frozen=True)
class OpenModel:
    """A COLMAP model, and how its image points are counted."""

    scene: Any  # pycolmap.Reconstruction
    network: Network
    estimate: Estimate
    camera_ids: tuple[int, ...]  # COLMAP's numbers
    image_ids: tuple[int, ...]
    point_ids: tuple[int, ...]
    slot: IntArray  # number of each image point among the key points of its photograph, (k,)

    @property
    def models(self) -> tuple[str, ...]:
        """COLMAP's names of the camera models."""
        return tuple(str(self.scene.camera(i).model_name) for i in self.camera_ids)

    @property
    def rigs(self) -> int:
        """Rigs of more than one camera."""
        return sum(rig.num_sensors() > 1 for rig in self.scene.rigs.values())


def open_model(folder: Path) -> OpenModel:
    """Read a COLMAP model, binary or text, to be changed.

    Raises:
        SurveyFileError: as `adapters.colmap.camera_models.read_model`.
        BackendError: likewise, such as a fisheye camera.
    """
    scene = read_scene(folder)
    network, estimate = named_network(folder, scene)
    camera_ids, image_ids = sorted(scene.cameras), sorted(scene.images)
    cameras = tuple(
        _single_focal(scene.camera(i), camera) for i, camera in zip(camera_ids, estimate.cameras, strict=True)
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


def place_model(model: OpenModel, object_from_model: Similarity) -> OpenModel:
    """Return a model in another frame and scale, rigs with it; its scene is changed."""
    pycolmap = load_pycolmap()
    model.scene.transform(_sim3d(pycolmap, object_from_model))
    return replace(model, estimate=object_from_model.apply_estimate(model.estimate))


def update_model(
    model: OpenModel,
    estimate: Estimate,
    *,
    xy: FloatArray,
    measured: BoolArray,
    images: BoolArray,
    points: BoolArray,
) -> int:
    """Put a solution into a model.

    Where a photograph belongs to a rig of several cameras, COLMAP's adjuster then holds them together.

    Args:
        model: is changed.
        estimate: of the same photographs and points.
        xy: image points, px, used where measured, (k, 2).
        measured: image points measured anew; the others of adjusted points claim none any more, (k,).
        images: photographs that were adjusted, (m,).
        points: points that were adjusted, (n,).

    Returns:
        How many photographs are in rigs of several cameras.
    """
    pycolmap = load_pycolmap()
    scene, seen = model.scene, model.network.image_points
    with quiet(pycolmap):
        for k, i in enumerate(model.camera_ids):
            if images[model.network.camera == k].any():
                scene.camera(i).params = colmap_parameters(
                    pycolmap, estimate.cameras[k], str(scene.camera(i).model_name)
                )
        for i, rows in enumerate(rows_of(seen.image, len(images))):
            image = scene.image(model.image_ids[i])
            key_points = image.points2D
            for row in rows[measured[rows]].tolist():
                key_points[int(model.slot[row])].xy = xy[row] + HALF_PIXEL
            lost = rows[~measured[rows] & points[seen.point[rows]]]
            for row in lost.tolist():
                scene.delete_observation(model.image_ids[i], int(model.slot[row]))
            if images[i] and image.frame.rig.num_sensors() == 1:
                R = AXES @ estimate.rotation[i].T
                pose = pycolmap.Rigid3d(pycolmap.Rotation3d(R), -R @ estimate.position[i])
                image.frame.set_cam_from_world(image.camera_id, pose)
        for j, xyz in enumerate(estimate.points):
            if np.isfinite(xyz).all() and scene.exists_point3D(model.point_ids[j]):
                scene.point3D(model.point_ids[j]).xyz = xyz
        in_rigs = sum(
            scene.image(model.image_ids[i]).frame.rig.num_sensors() > 1 for i in np.flatnonzero(images)
        )
        if in_rigs:
            _adjust_rigs(pycolmap, scene, {model.point_ids[j] for j in np.flatnonzero(points)})
    return int(in_rigs)


def interior_rows(
    model: OpenModel, before: Estimate, after: Estimate, covariance: tuple[FloatArray, ...]
) -> tuple[tuple[object, ...], ...]:
    """Return camera, model, parameter, value before and after and sigma (NaN if held), in COLMAP's terms.

    Args:
        model: of the cameras.
        before: as it came.
        after: adjusted.
        covariance: of the free parameters of each camera, (f, f).
    """
    pycolmap = load_pycolmap()
    rows: list[tuple[object, ...]] = []
    for k, number in enumerate(model.camera_ids):
        found = model.scene.camera(number)
        name, camera = str(found.model_name), after.cameras[k]
        values = colmap_parameters(pycolmap, camera, name)
        free = np.flatnonzero(camera.free)
        J = colmap_jacobian(camera, name)[:, free]
        Q = covariance[k] if len(covariance[k]) else np.full((len(free),) * 2, np.nan)  # no photographs
        with np.errstate(invalid="ignore"):
            sigma = np.sqrt(np.einsum("if,fg,ig->i", J, Q, J))
        names = [one.strip() for one in str(found.params_info).split(",")]
        first = colmap_parameters(pycolmap, before.cameras[k], name)
        rows += [
            (number, name, *one[:3], one[3] if one[3] > 0 else float("nan"))
            for one in zip(names, first.tolist(), values.tolist(), sigma.tolist(), strict=True)
        ]
    return tuple(rows)


def colmap_parameters(pycolmap: Any, camera: Camera, model: str) -> FloatArray:
    """Return a camera's parameters in the order of the COLMAP model that it was read from."""
    if model in SINGLE_FOCAL:
        c, x0, y0, K1, K2 = camera.parameters[:5]
        width, height = camera.size_px
        return np.array([c, x0 + width / 2, height / 2 - y0, K1 * c**2, K2 * c**4])[: 3 + SINGLE_FOCAL[model]]
    whole = np.array(colmap_camera(pycolmap, camera, 1).params, dtype=float)
    return whole[:4] if model == "PINHOLE" else whole


def colmap_jacobian(camera: Camera, model: str) -> FloatArray:
    """Return d (parameters of the COLMAP model) / d (parameters of ours), (q, p); see `colmap_parameters`."""
    p = len(camera.parameters)
    if model not in SINGLE_FOCAL:
        return np.eye(4 if model == "PINHOLE" else p, p)
    c, _, _, K1, K2 = camera.parameters[:5]
    J = np.zeros((5, p))
    J[range(5), range(5)] = 1, 1, -1, c**2, c**4
    J[3:, 0] = 2 * K1 * c, 4 * K2 * c**3
    return J[: 3 + SINGLE_FOCAL[model]]


def _single_focal(found: Any, camera: Camera) -> Camera:
    """Return a camera with one focal length in the model of ours that has one, others as they are."""
    if found.model_name not in SINGLE_FOCAL:
        return camera
    f, cx, cy, *k = np.array(found.params, dtype=float).tolist()
    parameters = np.zeros(11)
    parameters[:3] = f, cx - found.width / 2, found.height / 2 - cy
    parameters[3 : 3 + len(k)] = [value / f ** (2 * n + 2) for n, value in enumerate(k)]
    return Camera(camera.name, "brown_forward", camera.size_px, np.ones(2), parameters)


def _adjust_rigs(pycolmap: Any, scene: Any, points: set[int]) -> None:
    """Adjust the refined points with the cameras of each rig held together, and take over what that gives.

    Interior orientation is held: COLMAP frees it by groups of parameters, of all cameras alike, and would
    free what the adjustment before held. Its gauge is free, so that the whole is brought back to where the
    points were.
    """
    part = pycolmap.Reconstruction(scene)
    for j in set(part.point3D_ids()) - points:
        part.delete_point3D(j)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.solver_options.max_num_iterations = STEPS
    config = pycolmap.BundleAdjustmentConfig()
    for i in part.reg_image_ids():
        config.add_image(i)
    for i in part.cameras:
        config.set_constant_cam_intrinsics(i)
    pycolmap.create_default_ceres_bundle_adjuster(options, config, part).solve()  # as a whole, it logs
    common = sorted(points & set(part.point3D_ids()))
    found, wanted = (np.array([one.point3D(j).xyz for j in common]) for one in (part, scene))
    part.transform(_sim3d(pycolmap, fit_similarity(found, wanted)))
    for number, rig in scene.rigs.items():
        for sensor in rig.non_ref_sensors:
            if part.rig(number).has_sensor_from_rig(sensor):
                rig.set_sensor_from_rig(sensor, part.rig(number).sensor_from_rig(sensor))
    for number in scene.frames:
        if part.frame(number).has_pose:
            scene.frame(number).rig_from_world = part.frame(number).rig_from_world
    for j in common:
        scene.point3D(j).xyz = part.point3D(j).xyz


def _sim3d(pycolmap: Any, similarity: Similarity) -> Any:
    """Return a similarity as COLMAP has it."""
    return pycolmap.Sim3d(similarity.scale, pycolmap.Rotation3d(similarity.rotation), similarity.translation)
