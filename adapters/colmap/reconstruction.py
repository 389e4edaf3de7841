"""Conversion of Kolinear's networks to COLMAP's scenes and back.

All differences are converted here and nowhere else:

    pixel origin   COLMAP counts from the corner of the top-left pixel, Kolinear from its centre: +0.5 px
    camera axes    COLMAP looks along +z with y down: R_colmap = diag(1, -1, -1) M, t = -R_colmap X0
    numbers        cameras, photographs and points are numbered from 1 in COLMAP
    rigs, frames   since COLMAP 4 a photograph belongs to a frame of a rig: a moment is a frame, and a
                   photograph without a rig has a separate frame

The caller passes pycolmap, which only `adapters.colmap.adjuster` imports.

Source: COLMAP 4.2 documentation, "Camera Models" and "Rigs and Frames".
"""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np

from adapters.colmap.model_files import MODELS as COLMAP_MODELS
from sfm.model.camera import Camera
from sfm.model.conventions import VISION_AXES, AnyArray, BoolArray, FloatArray
from sfm.model.distortion.models import MODELS, Role
from sfm.model.errors import BackendError
from sfm.model.estimate import Estimate, Mounts
from sfm.model.network import Network, rows_of

HALF_PIXEL = 0.5  # COLMAP's pixel coordinates minus ours, px
# COLMAP's camera models by the names of Kolinear's, which have the same parameters in the same order
COLMAP_NAMES = {name: name.upper() for name in MODELS if name.upper() in COLMAP_MODELS}
OPENCV_NAMES = {"f": "fx", "k": "k1"}  # for models with one focal length or one coefficient
PARTS_OF_OPENCV = ("simple_pinhole", "pinhole", "simple_radial", "radial")


def reconstruction(
    pycolmap: ModuleType,
    network: Network,
    estimate: Estimate,
    *,
    rejected: BoolArray | None = None,
    colours: AnyArray | None = None,
) -> Any:
    """Return a network as a pycolmap.Reconstruction, with cameras, photographs and points numbered from 1.

    rejected: image points that are not linked to their point, (k,). colours: of points, uint8, (n, 3).
    """
    scene = pycolmap.Reconstruction()
    rigged = _add_cameras(pycolmap, scene, estimate, None if network.moment is None else estimate.mounts)
    frames: dict[int, Any] = {}
    seen = network.image_points
    claimed = np.ones(len(seen), dtype=bool) if rejected is None else ~rejected
    determined = estimate.determined
    claimed &= estimate.oriented[seen.image] & determined[seen.point]
    slot = np.zeros(len(seen), dtype=np.int64)  # index of each image point in its photograph
    for i, rows in enumerate(rows_of(seen.image, len(network.images))):
        if not estimate.oriented[i]:
            continue
        slot[rows] = np.arange(len(rows))
        R = VISION_AXES @ estimate.rotation[i].T
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(R), -R @ estimate.position[i])
        keypoints = seen.xy[rows] + HALF_PIXEL
        a = int(network.camera[i])
        image = pycolmap.Image(name=network.images[i], keypoints=keypoints, camera_id=a + 1, image_id=i + 1)
        if network.moment is None or a not in rigged:
            scene.add_image_with_trivial_frame(image, pose)
        else:
            frames.setdefault(int(network.moment[i]), []).append((image, pose, a))
    for images in frames.values():
        _add_frame(pycolmap, scene, images, rigged)
    for j, rows in enumerate(rows_of(seen.point, len(network.points))):
        if not determined[j]:
            continue
        track = pycolmap.Track(
            [pycolmap.TrackElement(int(seen.image[r]) + 1, int(slot[r])) for r in rows if claimed[r]]
        )
        point = pycolmap.Point3D(xyz=estimate.points[j], track=pycolmap.Track())
        if colours is not None:
            point.color = colours[j]
        scene.add_point3D_with_id(j + 1, point)
        for element in track.elements:
            scene.add_observation(j + 1, element)
    return scene


def _add_cameras(
    pycolmap: ModuleType, scene: Any, estimate: Estimate, mounts: Mounts | None
) -> dict[int, tuple[int, Any]]:
    """Add cameras and rigs to a scene; return the rig of each rigged camera, and the camera from the rig."""
    names = ("",) * len(estimate.cameras) if mounts is None else mounts.rig
    rigs: dict[int, tuple[int, Any]] = {}
    for k, camera in enumerate(estimate.cameras):
        if names[k]:
            scene.add_camera(colmap_camera(pycolmap, camera, k + 1))
        else:
            scene.add_camera_with_trivial_rig(colmap_camera(pycolmap, camera, k + 1))
    if mounts is None:
        return rigs
    for number, on in enumerate(mounts.by_rig().values()):
        rig = pycolmap.Rig(rig_id=len(names) + number + 1)
        for k in on:
            from_rig = camera_from_rig(pycolmap, mounts, k)
            sensor = sensor_of(pycolmap, k)
            if k == on[0]:
                rig.add_ref_sensor(sensor)
            else:
                rig.add_sensor(sensor, from_rig)
            rigs[k] = rig.rig_id, from_rig
        scene.add_rig(rig)
    return rigs


def _add_frame(
    pycolmap: ModuleType, scene: Any, images: list[tuple[Any, Any, int]], rigged: dict[int, tuple[int, Any]]
) -> None:
    """Add the photographs of one moment (image, pose and camera) to a scene."""
    _, pose, camera = images[0]
    rig, from_rig = rigged[camera]
    frame = pycolmap.Frame(frame_id=images[0][0].image_id, rig_id=rig)
    for image, _, k in images:
        frame.add_data_id(pycolmap.data_t(sensor_of(pycolmap, k), image.image_id))
        image.frame_id = frame.frame_id
    frame.rig_from_world = from_rig.inverse() * pose
    scene.add_frame(frame)
    for image, _, _ in images:
        scene.add_image(image)
    scene.register_frame(frame.frame_id)


def sensor_of(pycolmap: ModuleType, camera: int) -> Any:
    """Return COLMAP's sensor for the camera of an index."""
    return pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera + 1)


def colmap_camera(pycolmap: ModuleType, camera: Camera, number: int) -> Any:
    """Return a camera as a pycolmap.Camera with a given number.

    Raises:
        BackendError: a camera model that COLMAP does not have.
    """
    if camera.model not in COLMAP_NAMES:
        raise BackendError(
            f"camera {camera.name}: COLMAP has no model {camera.model}, convert it to opencv or full_opencv"
        )
    width, height = camera.size_px
    return pycolmap.Camera(
        model=COLMAP_NAMES[camera.model],
        width=width,
        height=height,
        params=colmap_parameters(camera),
        camera_id=number,
    )


def colmap_parameters(camera: Camera) -> FloatArray:
    """Return the parameters of a camera in COLMAP's pixel frame, (n,)."""
    return camera.parameters + HALF_PIXEL * camera.plays(Role.X0, Role.Y0)


def with_colmap_parameters(camera: Camera, params: Any) -> Camera:
    """Return a camera with other parameters, given in COLMAP's pixel frame."""
    return camera.with_parameters(np.array(params) - HALF_PIXEL * camera.plays(Role.X0, Role.Y0))


def camera_of(scene_camera: Any) -> Camera:
    """Return a COLMAP camera as a Kolinear camera in the same model, with pixel size 1.

    Raises:
        BackendError: a COLMAP model that Kolinear does not read.
    """
    model = str(scene_camera.model_name).lower()
    if model not in COLMAP_NAMES:
        raise BackendError(
            f"camera {scene_camera.camera_id}: COLMAP's model {scene_camera.model_name} is not read, "
            f"expected one of {', '.join(COLMAP_NAMES.values())}; make perspective photographs of it first"
        )
    size = int(scene_camera.width), int(scene_camera.height)
    camera = Camera(str(scene_camera.camera_id), model, size, np.ones(2), np.zeros(len(MODELS[model].names)))
    return with_colmap_parameters(camera, scene_camera.params)


def as_opencv(camera: Camera) -> Camera:
    """Return a camera as `opencv` if its model is a special case of that model; otherwise unchanged."""
    if camera.model not in PARTS_OF_OPENCV:
        return camera
    of = {OPENCV_NAMES.get(name, name): s for s, name in enumerate(camera.names)}
    of = {"fy": of["fx"]} | of
    names = MODELS["opencv"].names
    parameters = np.array([camera.parameters[of[name]] if name in of else 0.0 for name in names])
    free = np.array([name in of and bool(camera.free[of[name]]) for name in names])
    return replace(camera, model="opencv", parameters=parameters, free=free, shared=())


def estimate_of(scene: Any, start: Estimate) -> Estimate:
    """Return the adjusted values of a scene, in the order of the start values."""
    cameras = [
        with_colmap_parameters(camera, scene.camera(k + 1).params) for k, camera in enumerate(start.cameras)
    ]
    poses = [scene.image(i + 1).cam_from_world().matrix() for i in range(len(start.position))]
    R = np.array([(VISION_AXES @ pose[:, :3]).T for pose in poses])
    position = np.array([-pose[:, :3].T @ pose[:, 3] for pose in poses])
    points = np.array([scene.point3D(j + 1).xyz for j in range(len(start.points))])
    mounts = start.mounts
    if mounts is not None:
        of_mount, turned = mounts.position.copy(), mounts.rotation.copy()
        for rig in scene.rigs.values():
            for sensor, from_rig in rig.non_ref_sensors.items():
                of_mount[sensor.id - 1], turned[sensor.id - 1] = mount_of(from_rig)
        mounts = replace(mounts, position=of_mount, rotation=turned)
    return Estimate(tuple(cameras), position, R, points, mounts)


def camera_from_rig(pycolmap: ModuleType, mounts: Mounts, camera: int) -> Any:
    """Return COLMAP's pose of a camera in its rig, whose axes are COLMAP's axes of the reference camera."""
    R = VISION_AXES @ mounts.rotation[camera].T
    return pycolmap.Rigid3d(pycolmap.Rotation3d(R @ VISION_AXES), -R @ mounts.position[camera])


def mount_of(from_rig: Any) -> tuple[FloatArray, FloatArray]:
    """Return position (3,) and rotation (3, 3) of a mount from COLMAP's pose of a camera in its rig."""
    pose = from_rig.matrix()
    R = VISION_AXES @ pose[:, :3].T @ VISION_AXES
    return -R @ VISION_AXES @ pose[:, 3], R


def residuals_of(scene: Any, network: Network) -> FloatArray:
    """Return computed minus measured image points by COLMAP's projection, px, (k, 2)."""
    seen = network.image_points
    xy = np.empty((len(seen), 2))
    for i, rows in enumerate(rows_of(seen.image, len(network.images))):
        image = scene.image(i + 1)
        pose = image.cam_from_world().matrix()
        points = np.array([scene.point3D(int(j) + 1).xyz for j in seen.point[rows]]).reshape(-1, 3)
        if len(rows):
            xy[rows] = scene.camera(image.camera_id).img_from_cam(points @ pose[:, :3].T + pose[:, 3])
    return xy - HALF_PIXEL - seen.xy
