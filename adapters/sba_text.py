"""Text files of the sba package: cameras, points with their projections, calibration matrix.

    cameras   one a line: [fu u0 v0 ar s] qw qx qy qz tx ty tz, x = K [R|t] X, y down
    points    one a line: X Y Z n (frame x y [covariance, 4 numbers])*n, frames from 0
    calib     the 3 x 3 matrix K; not needed where the cameras carry their own five parameters
    sigmas    optional: sigma_x sigma_y (px) of each projection, in the order of the points file

sba says nothing of where a pixel has its origin; its coordinates are taken as they are.

Source: M. Lourakis and A. Argyros (2009), ACM TOMS 36(1), and the README of sba 1.6.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from sfm.camera import Camera, camera_from_values
from sfm.conventions import FloatArray
from sfm.errors import SurveyFileError
from sfm.network import Estimate, ImagePoints, Network

AXES = np.diag([1.0, -1.0, -1.0])  # sba's camera axes (y down, z forward) in ours
POSE, POSE_WITH_CAMERA = 7, 12  # numbers of a camera line
PLAIN, WITH_COVARIANCE = 3, 7  # numbers of a projection
MIN_QUATERNION = 1e-6  # length; unit quaternions are due
MAX_NUMBER = 1e12  # no length or pixel is larger; squares and products of larger ones overflow
SIGMA_PX = 1.0  # of projections that come without


def read_sba_text(
    cameras: Path, points: Path, calibration: Path | None = None, *, sigmas: Path | None = None
) -> tuple[Network, Estimate]:
    """Read a bundle adjustment problem of sba as a network and its start values.

    All cameras are calibrated (nothing of their interior orientation is free); those with the same five
    parameters are one camera, in model `opencv` without distortion. Without sigmas or covariances an
    image coordinate has a standard deviation of 1 px.

    Raises:
        SurveyFileError: what is wrong, with file and line number.
    """
    rows = _rows(cameras)
    lengths = {len(values) for _, values in rows}
    if lengths not in ({POSE}, {POSE_WITH_CAMERA}):
        raise SurveyFileError(
            f"{cameras}: lines of {sorted(lengths)} numbers, all must have {POSE} or all {POSE_WITH_CAMERA}"
        )
    table = np.array([values for _, values in rows])
    for k in np.flatnonzero(np.linalg.norm(table[:, -7:-3], axis=1) < MIN_QUATERNION)[:1]:
        raise SurveyFileError(f"{cameras}, line {rows[k][0]}: a quaternion of zeros is no rotation")
    image_points, xyz = _points(points, len(rows))
    if sigmas is not None:
        image_points = _with_sigmas(image_points, sigmas)
    size = tuple(int(v) + 1 for v in np.ceil(image_points.xy.max(axis=0)))
    if table.shape[1] == POSE_WITH_CAMERA:
        inner, camera = np.unique(table[:, :5], axis=0, return_inverse=True)
    elif calibration is None:
        raise SurveyFileError(f"{cameras}: cameras without calibration, a calibration matrix is needed")
    else:
        inner, camera = _calibration(calibration)[None], np.zeros(len(rows), dtype=np.int64)
    made = tuple(
        _camera(f"camera {a + 1}", values, (size[0], size[1]), cameras) for a, values in enumerate(inner)
    )
    R = Rotation.from_quat(table[:, -7:-3], scalar_first=True).as_matrix()
    network = Network(
        images=tuple(str(i) for i in range(len(rows))),
        camera=np.asarray(camera, dtype=np.int64).ravel(),
        points=tuple(str(j) for j in range(len(xyz))),
        image_points=image_points,
    )
    position = -np.einsum("mab,ma->mb", R, table[:, -3:])
    return network, Estimate(made, position, np.swapaxes(AXES @ R, 1, 2).copy(), xyz)


def _camera(name: str, values: FloatArray, size_px: tuple[int, int], path: Path) -> Camera:
    fu, u0, v0, aspect, skew = values
    if skew != 0:
        raise SurveyFileError(f"{path}: skew {skew}, only cameras without skew can be read")
    return camera_from_values(
        name,
        "opencv",
        size_px,
        (1.0, 1.0),
        c_mm=fu,
        values=(("fx", fu), ("fy", fu * aspect), ("cx", u0), ("cy", v0)),
    )


def _calibration(path: Path) -> FloatArray:
    rows = _rows(path)
    K = np.array([values for _, values in rows if len(values) == 3])
    if K.shape != (3, 3) or not K[0, 0] > 0:
        raise SurveyFileError(f"{path}: {len(K)} lines of 3 numbers, a 3 x 3 calibration matrix is needed")
    return np.array([K[0, 0], K[0, 2], K[1, 2], K[1, 1] / K[0, 0], K[0, 1]])


def _points(path: Path, frames: int) -> tuple[ImagePoints, FloatArray]:
    image, point, xy, covariance = [], [], [], []
    xyz: list[list[float]] = []
    for number, values in _rows(path):
        if len(values) < 4 or values[3] < 0 or values[3] != int(values[3]):
            raise SurveyFileError(f"{path}, line {number}: X Y Z and a number of projections are needed")
        n = int(values[3])
        width, rest = divmod(len(values) - 4, max(n, 1))
        if rest or (n and width not in (PLAIN, WITH_COVARIANCE)):
            raise SurveyFileError(
                f"{path}, line {number}: {len(values) - 4} numbers for {n} projections, "
                f"{PLAIN} or {WITH_COVARIANCE} each are needed"
            )
        for p in range(n):
            own = values[4 + p * width : 4 + (p + 1) * width]
            if not 0 <= own[0] < frames:
                raise SurveyFileError(f"{path}, line {number}: frame {own[0]:g}, there are {frames} cameras")
            image.append(int(own[0]))
            point.append(len(xyz))
            xy.append(own[1:3])
            covariance.append(own[3:7] if width == WITH_COVARIANCE else [SIGMA_PX**2, 0.0, 0.0, SIGMA_PX**2])
        xyz.append(values[:3])
    if not image:
        raise SurveyFileError(f"{path}: no projections")
    return (
        ImagePoints(
            np.array(image, dtype=np.int64),
            np.array(point, dtype=np.int64),
            np.array(xy),
            np.array(covariance).reshape(-1, 2, 2),
        ),
        np.array(xyz),
    )


def _with_sigmas(image_points: ImagePoints, path: Path) -> ImagePoints:
    sigma = np.array([value for _, values in _rows(path) for value in values])
    if len(sigma) != 2 * len(image_points) or not (sigma > 0).all():
        raise SurveyFileError(
            f"{path}: {len(sigma)} numbers, {2 * len(image_points)} positive standard deviations are needed"
        )
    covariance = np.zeros((len(image_points), 2, 2))
    covariance[:, 0, 0], covariance[:, 1, 1] = sigma.reshape(-1, 2).T ** 2
    return ImagePoints(image_points.image, image_points.point, image_points.xy, covariance)


def _rows(path: Path) -> list[tuple[int, list[float]]]:
    """Return line number and numbers of each line that holds any; # starts a comment."""
    rows = []
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SurveyFileError(f"{path}: cannot be read ({error})") from error
    for number, line in enumerate(text.splitlines(), start=1):
        fields = line.split("#")[0].split()
        if not fields:
            continue
        try:
            values = [float(field) for field in fields]
        except ValueError as error:
            raise SurveyFileError(f"{path}, line {number}: {error}") from error
        if not all(abs(value) <= MAX_NUMBER for value in values):
            raise SurveyFileError(
                f"{path}, line {number}: finite numbers of at most {MAX_NUMBER:g} are needed"
            )
        rows.append((number, values))
    if not rows:
        raise SurveyFileError(f"{path}: no numbers")
    return rows
