"""Calibrated rigs for other programs: a folder with the files of each program, including rectification.

    opencv-LEFT-RIGHT.yml        of each camera with the reference of its rig, for cv2.FileStorage: width,
                                 height (px), K1, D1, K2, D2, R, T, E, F, rectification R1, R2, P1, P2, Q
    dice-LEFT-RIGHT.xml          the same pairs, camera system of DICe
    matchid-LEFT-RIGHT.caldat    the same pairs for MatchID, in mm; if the unit of length is known
    rig_config.json              COLMAP's rig configuration, of all rigs
    kalibr-RIG.yaml              camera chain of Kalibr
    ros-CAMERA.yaml              camera_info of ROS; of a rig of two cameras with rectification
    mrcal-CAMERA.cameramodel     camera model of mrcal

Camera axes are x right, y down, z forward. Pixels count from the centre of the top-left pixel (COLMAP: from
its corner). Lengths are in the unit of the result; for Kalibr, ROS and mrcal in metres if the unit is known.

Rectification follows OpenCV: a common image plane with rows as epipolar lines. Each camera is rotated by half
of their relative rotation, and then so that the base is along rows (or columns). Focal length and principal
point are the same in both, and show as much as possible without empty borders.

Source: OpenCV 4 documentation, "stereoCalibrate", "stereoRectify" and "XML/YAML Persistence"; COLMAP 4.2
documentation, "Rigs and Frames"; DICe, DICe_CameraSystem.cpp and its tests/component/cal; pyvale 2026.10, its
example calib.caldat, whose cameras converge by x_right = R x_left + T in these axes; Kalibr wiki, "YAML
formats"; ROS REP 104 and sensor_msgs/CameraInfo; mrcal 2.5, "The .cameramodel file format"; cv::stereoRectify
of OpenCV 4 (after Bouguet), with CALIB_ZERO_DISPARITY and alpha = 0.
"""

from __future__ import annotations

import json
import re
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np
from scipy.spatial.transform import Rotation

from adapters.colmap.reconstruction import AXES, COLMAP_NAMES, colmap_parameters
from adapters.formats.content import Content
from sfm.files.open_folders import disk_errors
from sfm.model.camera import Camera, tangents_from_pixel
from sfm.model.conventions import METRES, FloatArray, rotation_from_vector, skew
from sfm.model.errors import OutputError
from sfm.model.estimate import Mounts
from sfm.model.network import Network

GRID = 9  # grid points along each side of a photograph


@dataclass(frozen=True)
class _Mounted:
    """A camera of a rig: x = R x_reference + T in axes x right, y down, z forward."""

    camera: Camera
    R: FloatArray  # (3, 3)
    T: FloatArray  # (3,)

    @classmethod
    def of(cls, camera: Camera, mounts: Mounts, a: int) -> _Mounted:
        """Return camera a as it is mounted."""
        R = AXES @ mounts.rotation[a].T @ AXES
        return cls(camera, R, -R @ AXES @ mounts.position[a])

    @property
    def pose(self) -> FloatArray:
        """The pose as one matrix, (4, 4)."""
        return np.block([[self.R, self.T[:, None]], [np.array([[0.0, 0.0, 0.0, 1.0]])]])

    def scaled(self, factor: float) -> _Mounted:
        """Return the camera with lengths in another unit."""
        return _Mounted(self.camera, self.R, factor * self.T)


def write_rig_files(folder: Path, content: Content) -> None:
    """Write the rigs of a result, with cameras in model opencv, into a folder.

    Raises:
        OutputError: the result has no rigs, or two names give the same file name.
    """
    result = content.result
    network, mounts = result.network, result.estimate.mounts
    if mounts is None or not any(mounts.rig):
        raise OutputError(f"{folder}: the result has no rigs, which format rig requires; see [[rig]]")
    unit, metres = result.unit or "unknown units", METRES.get(result.unit)
    in_metres = "m" if metres else unit
    configs, files = [], {}

    def add(name: str, text: str) -> None:
        path = re.sub(r"[^\w.\-]+", "_", name)
        if path in files:
            raise OutputError(f"{folder}: two files would be {path}; rename cameras or rigs")
        files[path] = text

    for rig, on in mounts.by_rig().items():
        cameras = [_Mounted.of(result.estimate.cameras[a], mounts, a) for a in on]
        if len(on) < 2:
            raise OutputError(f"{folder}: rig {rig} has one camera, needed at least 2")
        configs.append(_colmap(cameras, _prefixes(network, on, [mounted.camera.name for mounted in cameras])))
        for second in cameras[1:]:
            pair = f"{cameras[0].camera.name}-{second.camera.name}"
            add(f"opencv-{pair}.yml", "\n".join(_opencv(cameras[0].camera, second, unit)) + "\n")
            add(f"dice-{pair}.xml", "\n".join(_dice([cameras[0], second], unit)) + "\n")
            if metres:
                text = "\n".join(_matchid([cameras[0], second.scaled(1000.0 * metres)]))
                add(f"matchid-{pair}.caldat", text + "\n")
        scaled = [mounted.scaled(metres or 1.0) for mounted in cameras]
        add(f"kalibr-{rig}.yaml", "\n".join(_kalibr(scaled, in_metres)) + "\n")
        for k, mounted in enumerate(scaled):
            add(f"ros-{mounted.camera.name}.yaml", "\n".join(_ros(scaled, k, in_metres)) + "\n")
            add(f"mrcal-{mounted.camera.name}.cameramodel", "\n".join(_mrcal(mounted, in_metres)) + "\n")
    add("rig_config.json", json.dumps(configs, indent=1) + "\n")
    with disk_errors(f"{folder}: the files of the rig cannot be written"):
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in files.items():
            (folder / name).write_text(text, encoding="utf-8", newline="")


def _matrix(camera: Camera) -> FloatArray:
    """Return K of a camera, (3, 3)."""
    fx, fy, cx, cy = (camera.value(name) for name in ("fx", "fy", "cx", "cy"))
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _distortion(camera: Camera) -> list[float]:
    return [camera.value(name) for name in ("k1", "k2", "p1", "p2")]


def _numbers(values: FloatArray | Sequence[float]) -> str:
    """Write numbers with all digits and a decimal point each, since 1e-5 is a word in YAML 1.1."""
    texts = [repr(float(value)) for value in np.ravel(values)]
    return ", ".join(text if "." in text else text.replace("e", ".0e") for text in texts)


def _opencv(first: Camera, mounted: _Mounted, unit: str) -> Iterator[str]:
    """Yield the lines of a pair of cameras."""
    R, T, second = mounted.R, mounted.T, mounted.camera
    K1, K2 = _matrix(first), _matrix(second)
    E = skew(T) @ R
    F = np.linalg.inv(K2).T @ E @ np.linalg.inv(K1)
    matrices = {"K1": K1, "D1": np.array([[*_distortion(first), 0.0]])}
    matrices |= {"K2": K2, "D2": np.array([[*_distortion(second), 0.0]])}
    matrices |= {"R": R, "T": T[:, None], "E": E, "F": F / (F[2, 2] or 1.0)}
    rectified = rectify(first, second, R, T)
    yield from ("%YAML:1.0", "---", f"# T is in {unit}: x2 = R x1 + T")
    yield f"camera1: {json.dumps(first.name, ensure_ascii=False)}"
    yield f"camera2: {json.dumps(second.name, ensure_ascii=False)}"
    yield from (f"width: {first.size_px[0]}", f"height: {first.size_px[1]}")
    if rectified is None:
        yield "# no rectification: the viewing directions differ too much for a common image plane"
    else:
        matrices |= rectified._asdict()
    for name, M in matrices.items():
        yield f"{name}: !!opencv-matrix"
        yield from (f"   rows: {M.shape[0]}", f"   cols: {M.shape[1]}", "   dt: d")
        yield f"   data: [ {_numbers(M)} ]"


def _dice(pair: list[_Mounted], unit: str) -> Iterator[str]:
    """Yield the lines of a system of two cameras, the second relative to the first."""

    def entry(name: str, kind: str, value: object) -> str:
        return f'<Parameter name="{name}" type="{kind}" value={quoteattr(str(value))} />'

    yield from ("<ParameterList>", f"  <!-- TX, TY, TZ are in {unit} -->")
    yield "  " + entry("xml_file_format", "string", "DICe_xml_camera_system_file")
    yield "  " + entry("system_type_3D", "string", "OPENCV")
    yield "  " + entry("extrinsics_relative_camera_to_camera", "bool", "true")
    for k, mounted in enumerate(pair):
        K, size = _matrix(mounted.camera), mounted.camera.size_px
        values = dict(zip(("CX", "CY", "FX", "FY"), (K[0, 2], K[1, 2], K[0, 0], K[1, 1]), strict=True))
        values |= zip(("K1", "K2", "P1", "P2"), _distortion(mounted.camera), strict=True)
        values |= zip(("TX", "TY", "TZ"), mounted.T.tolist(), strict=True)
        yield f'  <ParameterList name="CAMERA {k}">'
        yield "    " + entry("CAMERA_ID", "string", mounted.camera.name)
        yield from ("    " + entry(name, "double", repr(float(value))) for name, value in values.items())
        yield "    " + entry("LENS_DISTORTION_MODEL", "string", "OPENCV_LENS_DISTORTION")
        yield "    " + entry("IMAGE_HEIGHT_WIDTH", "string", f"{{ {size[1]}, {size[0]} }}")
        yield '    <ParameterList name="rotation_3x3_matrix">'
        for r, row in enumerate(mounted.R):
            yield "      " + entry(f"ROW {r}", "string", f"{{ {_numbers(row)} }}")
        yield from ("    </ParameterList>", "  </ParameterList>")
    yield "</ParameterList>"


def _matchid(pair: list[_Mounted]) -> Iterator[str]:
    """Yield the lines of two cameras; T in mm, R = Rz(Psi) Ry(Phi) Rx(Theta)."""
    for k, mounted in enumerate(pair):
        K, (k1, k2, p1, p2) = _matrix(mounted.camera), _distortion(mounted.camera)
        values = {"Fx [pixels]": K[0, 0], "Fy [pixels]": K[1, 1], "Fs [pixels]": 0.0}
        values |= {"Kappa 1": k1, "Kappa 2": k2, "Kappa 3": 0.0, "P1": p1, "P2": p2}
        values |= {"Cx [pixels]": K[0, 2], "Cy [pixels]": K[1, 2]}
        yield from (f"Cam{k}_{name};{float(value)!r}" for name, value in values.items())
    yield from (f"T{axis} [mm];{value!r}" for axis, value in zip("xyz", pair[1].T.tolist(), strict=True))
    angles = Rotation.from_matrix(pair[1].R).as_euler("xyz", degrees=True).tolist()
    names = ("Theta", "Phi", "Psi")
    yield from (f"{name} [deg];{value!r}" for name, value in zip(names, angles, strict=True))


def _colmap(cameras: list[_Mounted], prefixes: list[str]) -> dict[str, list[dict[str, Any]]]:
    """Return a rig in COLMAP's configuration."""
    entries: list[dict[str, Any]] = []
    for k, (mounted, prefix) in enumerate(zip(cameras, prefixes, strict=True)):
        entry: dict[str, Any] = {"image_prefix": prefix}
        if k == 0:
            entry["ref_sensor"] = True
        else:
            quaternion = Rotation.from_matrix(mounted.R).as_quat(scalar_first=True)
            entry |= {
                "cam_from_rig_rotation": quaternion.tolist(),
                "cam_from_rig_translation": mounted.T.tolist(),
            }
        entry["camera_model_name"] = COLMAP_NAMES[mounted.camera.model]
        entry["camera_params"] = colmap_parameters(mounted.camera).tolist()
        entries.append(entry)
    return {"cameras": entries}


def _prefixes(network: Network, on: list[int], names: list[str]) -> list[str]:
    """Return the start of the photograph names of each camera, before the part shared within a moment.

    If the names have no such start, the photographs are expected in folders named like the cameras.
    """
    folders = [re.sub(r"[^\w.\- ]+", "_", name) + "/" for name in names]  # names may contain glob patterns
    if network.moment is None:
        return folders
    moments: dict[int, dict[int, str]] = defaultdict(dict)
    for name, t, a in zip(network.images, network.moment.tolist(), network.camera.tolist(), strict=True):
        if a in on:
            moments[t][a] = name
    starts: dict[int, set[str]] = {a: set() for a in on}
    for together in moments.values():
        if len(together) > 1:
            backwards = [name[::-1] for name in together.values()]
            same = zip(*backwards, strict=False)
            end = "".join(c[0] for c in takewhile(lambda c: len(set(c)) == 1, same))[::-1]
            end = re.sub(r"^[^\W\d_]*[\W_]*", "", end)  # from the end of the word in which it begins
            for a, name in together.items():
                starts[a].add(name.removesuffix(end))
    if any(len(of_camera) != 1 for of_camera in starts.values()):
        return folders
    prefixes = [next(iter(starts[a])) for a in on]
    mixed = any(
        prefix.startswith(other)
        for k, prefix in enumerate(prefixes)
        for other in prefixes[:k] + prefixes[k + 1 :]
    )
    return folders if mixed else prefixes


def _kalibr(cameras: list[_Mounted], unit: str) -> Iterator[str]:
    """Yield the lines of a camera chain, each camera relative to the one before."""
    yield f"# translations are in {unit}"
    for k, mounted in enumerate(cameras):
        camera, K = mounted.camera, _matrix(mounted.camera)
        yield f"cam{k}:  # {json.dumps(camera.name)}"
        if k:
            yield "  T_cn_cnm1:"
            pose = mounted.pose @ np.linalg.inv(cameras[k - 1].pose)
            yield from (f"  - [{_numbers(row)}]" for row in pose)
        yield f"  cam_overlaps: [{', '.join(str(o) for o in range(len(cameras)) if o != k)}]"
        yield "  camera_model: pinhole"
        yield f"  distortion_coeffs: [{_numbers(_distortion(camera))}]"
        yield "  distortion_model: radtan"
        yield f"  intrinsics: [{_numbers([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])}]"
        yield f"  resolution: [{camera.size_px[0]}, {camera.size_px[1]}]"
        yield f"  rostopic: /cam{k}/image_raw"


def _ros(cameras: list[_Mounted], k: int, unit: str) -> Iterator[str]:
    """Yield the lines of the camera_info of a camera, rectified if the rig is a stereo pair."""
    camera, K = cameras[k].camera, _matrix(cameras[k].camera)
    R, P = np.eye(3), np.hstack([K, np.zeros((3, 1))])
    pair = (
        rectify(cameras[0].camera, cameras[1].camera, cameras[1].R, cameras[1].T)
        if len(cameras) == 2
        else None
    )
    if pair is not None:
        R, P = (pair.R1, pair.P1) if k == 0 else (pair.R2, pair.P2)
    yield f"# fourth column of projection_matrix: px times {unit}"
    yield from (f"image_width: {camera.size_px[0]}", f"image_height: {camera.size_px[1]}")
    yield f"camera_name: {json.dumps(camera.name)}"
    yield "distortion_model: plumb_bob"
    for name, M in (
        ("camera_matrix", K),
        ("distortion_coefficients", np.array([[*_distortion(camera), 0.0]])),
        ("rectification_matrix", R),
        ("projection_matrix", P),
    ):
        yield f"{name}:"
        yield from (f"  rows: {M.shape[0]}", f"  cols: {M.shape[1]}", f"  data: [{_numbers(M)}]")


def _mrcal(mounted: _Mounted, unit: str) -> Iterator[str]:
    """Yield the lines of a camera model, in the coordinates of the reference camera."""
    K, pose = _matrix(mounted.camera), _numbers([*Rotation.from_matrix(mounted.R).as_rotvec(), *mounted.T])
    intrinsics = _numbers([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *_distortion(mounted.camera)])
    yield f"# {json.dumps(mounted.camera.name)}, translations are in {unit}"
    yield from ("{", "    'lensmodel':  'LENSMODEL_OPENCV4',", f"    'intrinsics': [ {intrinsics} ],")
    yield f"    'rt_cam_ref': [ {pose} ],"
    yield f"    'extrinsics': [ {pose} ],  # the same for mrcal before 2.5"
    yield from (f"    'imagersize': [ {mounted.camera.size_px[0]}, {mounted.camera.size_px[1]} ],", "}")


class Rectification(NamedTuple):
    """Rotations to the rectified cameras, their projections (px), and disparity to depth, as in OpenCV."""

    R1: FloatArray  # (3, 3)
    R2: FloatArray
    P1: FloatArray  # (3, 4)
    P2: FloatArray
    Q: FloatArray  # (4, 4)


def rectify(first: Camera, second: Camera, R: FloatArray, T: FloatArray) -> Rectification | None:
    """Return the rectification of two cameras to the size of the first one.

    Args:
        first: the first camera, whose axes are those of x1.
        second: the second camera, whose axes are those of x2.
        R: rotation of x2 = R x1 + T, axes x right, y down, z forward, (3, 3).
        T: its translation, any unit, (3,).

    Returns:
        The rectification; None if a photograph would reach behind the common image plane.
    """
    half = rotation_from_vector(-0.5 * np.asarray(Rotation.from_matrix(R).as_rotvec()))
    t = half @ T
    axis = 0 if abs(t[0]) > abs(t[1]) else 1
    along = np.zeros(3)
    along[axis] = 1.0 if t[axis] > 0 else -1.0
    normal = np.cross(t, along)
    length = float(np.linalg.norm(normal))
    if length > 0:
        normal *= np.arccos(min(abs(t[axis]) / np.linalg.norm(t), 1.0)) / length
    turn = rotation_from_vector(normal)
    rotations = (turn @ half.T, turn @ half)
    base = float((rotations[1] @ T)[axis])
    cameras = (first, second)
    other = "fy" if axis == 0 else "fx"
    f = sum(camera.value(other) for camera in cameras) / 2
    centres = []
    for camera, rotation in zip(cameras, rotations, strict=True):
        corners = _rectified(camera, rotation, 2)
        if corners is None:
            return None
        centres.append((np.array(camera.size_px) - 1) / 2 - f * corners.reshape(-1, 2).mean(axis=0))
    c = np.mean(centres, axis=0)
    size, scale = np.array(first.size_px), 0.0
    for camera, rotation in zip(cameras, rotations, strict=True):
        grid = _rectified(camera, rotation, GRID)
        if grid is None:
            return None
        least = f * np.array([grid[:, 0, 0].max(), grid[0, :, 1].max()])  # of the largest inner box, from c
        most = f * np.array([grid[:, -1, 0].min(), grid[-1, :, 1].min()])
        if not ((least < 0) & (most > 0)).all():
            return None
        scale = max(scale, *(c / -least), *((size - 1 - c) / most))
    f *= scale
    P1 = np.array([[f, 0.0, c[0], 0.0], [0.0, f, c[1], 0.0], [0.0, 0.0, 1.0, 0.0]])
    P2 = P1.copy()
    P2[axis, 3] = f * base
    Q = np.array(
        [[1.0, 0.0, 0.0, -c[0]], [0.0, 1.0, 0.0, -c[1]], [0.0, 0.0, 0.0, f], [0.0, 0.0, -1 / base, 0.0]]
    )
    return Rectification(*rotations, P1, P2, Q)


def _rectified(camera: Camera, rotation: FloatArray, count: int) -> FloatArray | None:
    """Return x/z and y/z of a grid on a photograph after a rotation, (n, n, 2); None if any is behind."""
    x, y = (np.linspace(0.0, side - 1.0, count) for side in camera.size_px)
    uv = tangents_from_pixel(camera, np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    rays = np.column_stack([uv[:, 0], -uv[:, 1], np.ones(len(uv))]) @ rotation.T
    if not (rays[:, 2] > 0).all():
        return None
    return np.asarray((rays[:, :2] / rays[:, 2:]).reshape(count, count, 2))
