"""The terms of OpenCV's camera models, which OpenCV, ROS, Kalibr, mrcal and nerfstudio share.

    K = [[fx, skew, cx], [0, fy, cy], [0, 0, 1]], px from the centre of the top-left pixel
    D = k1, k2, p1, p2 [, k3 [, k4, k5, k6 [, s1, s2, s3, s4 [, tau_x, tau_y]]]]
    D = k1, k2, k3, k4 of fisheye lenses

Four coefficients are model `opencv`, five or eight `full_opencv`; a fifth of 0 is `opencv` too. Thin prisms
(s) and tilted sensors (tau) are no part of these models and are refused unless they are 0.

Programs that distort the ideal point with polynomials of their own make `brown_forward`, in `forward_camera`.

Source: OpenCV 4 documentation, "Camera Calibration and 3D Reconstruction" and "Fisheye camera model".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from adapters.colmap.reconstruction import as_opencv
from sfm.files.plain_text import shorten
from sfm.model.camera import Camera, camera_from_values
from sfm.model.conventions import VISION_AXES, FloatArray
from sfm.model.distortion.models import MODELS
from sfm.model.errors import SurveyFileError
from sfm.model.estimate import Mounts

COUNTS = (0, 4, 5, 8, 12, 14)  # of coefficients
FULL = MODELS["full_opencv"].names[4:]  # k1, k2, p1, p2, k3, k4, k5, k6
FORWARD = MODELS["brown_forward"].names[3:]  # K1 to K4, P1, P2, b1, b2
LEAN = ("k4", "k5", "k6")  # held at 0 for five coefficients


def camera_in_pixels(
    where: str, name: str, model: str, size_px: tuple[int, int], parameters: FloatArray
) -> Camera:
    """Return a camera of a model in px; a pixel is 1 mm, as such files do not state its size.

    Args:
        where: file and key, for the error message.
        name: name of the camera.
        model: a model in px.
        size_px: width and height of its photographs, px.
        parameters: in the order of the model, (n,).

    Raises:
        SurveyFileError: a focal length that is not positive.
    """
    camera = Camera(name, model, size_px, np.ones(2), np.asarray(parameters, dtype=float))
    focal = camera.parameters[camera.parts[0]]
    if not (focal > 0).all():
        raise SurveyFileError(f"{where}: focal length {focal.min():g} px, it must be positive")
    return camera


def camera_of_matrix(
    where: str, name: str, size_px: tuple[int, int], K: FloatArray, D: FloatArray, *, fisheye: bool = False
) -> Camera:
    """Return the camera of a matrix and coefficients.

    Args:
        where: file and key, for error messages.
        name: name of the camera.
        size_px: width and height of its photographs, px.
        K: camera matrix, (3, 3) or its nine numbers.
        D: coefficients, (n,).
        fisheye: whether they are those of OpenCV's fisheye lenses.

    Raises:
        SurveyFileError: a skew, coefficients that no model has, or a focal length that is not positive.
    """
    K = np.asarray(K, dtype=float).reshape(3, 3)
    if K[0, 1] or K[1, 0] or K[2, 0] or K[2, 1] or K[2, 2] != 1:
        raise SurveyFileError(
            f"{where}: a camera matrix with skew {K[0, 1]:g} is not read, needed fx 0 cx, 0 fy cy, 0 0 1"
        )
    plane = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
    D = np.asarray(D, dtype=float).ravel()
    if fisheye:
        if len(D) not in (0, 4):
            raise SurveyFileError(f"{where}: {len(D)} coefficients of a fisheye lens, needed 4")
        values = np.concatenate([plane, D, np.zeros(4 - len(D))])
        return camera_in_pixels(where, name, "opencv_fisheye", size_px, values)
    if len(D) not in COUNTS:
        raise SurveyFileError(f"{where}: {len(D)} coefficients of distortion, needed 4, 5, 8, 12 or 14")
    if D[8:].any():
        raise SurveyFileError(
            f"{where}: thin prism or tilted sensor ({shorten(str(D[8:]))}), which no model has"
        )
    D = np.concatenate([D, np.zeros(8)])[:8]
    model = "full_opencv" if D[4:].any() else "opencv"
    return camera_in_pixels(where, name, model, size_px, np.concatenate([plane, D if D[4:].any() else D[:4]]))


def forward_camera(
    name: str,
    size_px: tuple[int, int],
    pixel_mm: tuple[float, float],
    plane: tuple[float, float, float],
    terms: tuple[float, ...],
    *,
    scale: float = 1.0,
) -> Camera:
    """Return the camera in model brown_forward of a polynomial with a linear term.

    With X = c u, Y = c v and r2 = X2 + Y2 the distorted point is x0 + X (s + K1 r2 + ... + K4 r8) + b1 X +
    b2 Y + P1 (r2 + 2 X2) + 2 P2 X Y, and likewise y; s goes into the principal distance.

    Args:
        name: name of the camera.
        size_px: width and height of its photographs, px.
        pixel_mm: width and height of a pixel, mm.
        plane: c, x0 and y0, mm.
        terms: K1, K2, K3, K4, P1, P2, b1, b2, in powers of mm.
        scale: s, positive.
    """
    power = (3, 5, 7, 9, 2, 2, 1, 1)
    values = {f: value / scale**n for f, value, n in zip(FORWARD, terms, power, strict=True)}
    values |= {"x0": plane[1], "y0": plane[2]}
    return camera_from_values(
        name, "brown_forward", size_px, pixel_mm, c_mm=scale * plane[0], values=tuple(values.items())
    )


def matrix_of(camera: Camera) -> FloatArray:
    """Return K of a camera with a model in px and two focal lengths, (3, 3)."""
    fx, fy, cx, cy = (camera.value(name) for name in ("fx", "fy", "cx", "cy"))
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def coefficients_of(camera: Camera, *, fewest: int = 5) -> list[float]:
    """Return the coefficients of distortion of a camera in a model of OpenCV.

    Args:
        camera: in model opencv, full_opencv or opencv_fisheye.
        fewest: how many there are at least, 4 or 5; four always of a fisheye lens.

    Returns:
        Four, five or eight coefficients, as few as the camera needs.
    """
    if camera.model == "opencv_fisheye":
        return [camera.value(name) for name in ("k1", "k2", "k3", "k4")]
    D = [camera.value(name) if name in camera.names else 0.0 for name in FULL]
    needed = 8 if any(D[5:]) else 5 if D[4] else 4
    return D[: max(needed, fewest)]


def numbers_text(values: FloatArray | list[float]) -> str:
    """Write numbers with all digits and a decimal point each, since 1e-5 is a word in YAML 1.1."""
    texts = [repr(float(value)) for value in np.ravel(values)]
    return ", ".join(text if "." in text else text.replace("e", ".0e") for text in texts)


@dataclass(frozen=True)
class Mounted:
    """A camera of a rig: x = R x_reference + T in axes x right, y down, z forward."""

    camera: Camera
    R: FloatArray  # (3, 3)
    T: FloatArray  # (3,)

    @classmethod
    def of(cls, camera: Camera, mounts: Mounts, a: int) -> Mounted:
        """Return camera a as it is mounted."""
        R = VISION_AXES @ mounts.rotation[a].T @ VISION_AXES
        return cls(as_opencv(camera), R, -R @ VISION_AXES @ mounts.position[a])

    @property
    def pose(self) -> FloatArray:
        """The pose as one matrix, (4, 4)."""
        return np.block([[self.R, self.T[:, None]], [np.array([[0.0, 0.0, 0.0, 1.0]])]])

    def scaled(self, factor: float) -> Mounted:
        """Return the camera with lengths in another unit."""
        return Mounted(self.camera, self.R, factor * self.T)


def alone(camera: Camera) -> Mounted:
    """Return a camera without a rig."""
    return Mounted(as_opencv(camera), np.eye(3), np.zeros(3))


def mounts_of(poses: list[tuple[FloatArray, FloatArray]]) -> Mounts:
    """Return the mounts of cameras whose first one is the reference.

    Args:
        poses: R (3, 3) and T (3,) of each camera, x = R x_reference + T in axes x right, y down, z forward.
    """
    turned = [VISION_AXES @ nearest(R).T @ VISION_AXES for R, _ in poses]
    position = np.array([-VISION_AXES @ nearest(R).T @ T for R, T in poses])
    free = np.tile(np.arange(len(poses))[:, None] > 0, (1, 6))
    return Mounts(position, np.array(turned), free, ("rig",) * len(poses))


def is_rotation(R: FloatArray) -> bool:
    """Return whether a matrix (3, 3) is a rotation but for rounding of its numbers, and no reflection."""
    return bool(np.allclose(R @ R.T, np.eye(3), atol=1e-3) and np.linalg.det(R) > 0)


def nearest(R: FloatArray) -> FloatArray:
    """Return the rotation nearest to a matrix with rounded numbers, (3, 3)."""
    return np.asarray(Rotation.from_matrix(R).as_matrix())
