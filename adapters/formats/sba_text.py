"""Text files of the sba package, read and written: cameras, points with projections, calibration matrix.

    cameras   one a line: [fu u0 v0 ar s] qw qx qy qz tx ty tz, x = K [R|t] X, y down
    points    one a line: X Y Z n (frame x y [covariance, 4 numbers])*n, frames from 0
    calib     the 3 x 3 matrix K; not needed if the cameras have the five parameters
    sigmas    optional: sigma_x sigma_y (px) of each projection, in the order of the points file

The files are in one folder and found by their names: *cams*.txt, *pts*.txt, calib.txt, *sigmas*.txt. sba does
not state the origin of its pixel coordinates; they are used unchanged.

Source: M. Lourakis and A. Argyros (2009), ACM TOMS 36(1), and the README of sba 1.6.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from adapters.reading.text_lines import MAX_IMAGE_POINTS, MAX_LINES, MAX_PHOTOGRAPHS, Lines, write_lines
from sfm.model.camera import Camera, camera_from_values
from sfm.model.conventions import VISION_AXES, FloatArray
from sfm.model.errors import OutputError, SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, rows_of

POSE, POSE_WITH_CAMERA = 7, 12  # numbers of a camera line
PLAIN, WITH_COVARIANCE = 3, 7  # numbers of a projection
MIN_QUATERNION = 1e-6  # minimum length; quaternions should have unit length
SIGMA_PX = 1.0  # of projections without a standard deviation


def read_sba_text(
    cameras: Path, points: Path, calibration: Path | None = None, *, sigmas: Path | None = None
) -> tuple[Network, Estimate]:
    """Read a bundle adjustment problem of sba as a network and its start values.

    All cameras are calibrated: nothing of their interior orientation is free. Lines with the same five
    parameters become one camera, in model `opencv` without distortion. Without sigmas or covariances an
    image coordinate has a standard deviation of 1 px.

    Raises:
        SurveyFileError: with file and line number.
    """
    rows = list(_rows(cameras, MAX_PHOTOGRAPHS))
    for number, values in rows:
        if len(values) not in (POSE, POSE_WITH_CAMERA) or len(values) != len(rows[0][1]):
            raise SurveyFileError(
                f"{cameras}, line {number}: {len(values)} numbers, all lines must have {POSE} or all "
                f"{POSE_WITH_CAMERA}"
            )
    table = np.array([values for _, values in rows])
    for k in np.flatnonzero(np.linalg.norm(table[:, -7:-3], axis=1) < MIN_QUATERNION)[:1]:
        raise SurveyFileError(f"{cameras}, line {rows[k][0]}: a quaternion of zeros is not a rotation")
    image_points, xyz = _points(points, len(rows))
    seen = np.bincount(image_points.image, minlength=len(rows))
    for i in np.flatnonzero(seen == 0)[:1]:
        raise SurveyFileError(
            f"{points}: no projection in frame {i} of {cameras}, line {rows[i][0]}, nor in "
            f"{int((seen == 0).sum()) - 1} other frames; the points are cut off or belong to other cameras"
        )
    if sigmas is not None:
        image_points = _with_sigmas(image_points, sigmas)
    size = tuple(max(int(v), 0) + 1 for v in np.ceil(image_points.xy.max(axis=0)))
    if table.shape[1] == POSE_WITH_CAMERA:
        inner, camera = np.unique(table[:, :5], axis=0, return_inverse=True)
    elif calibration is None:
        raise SurveyFileError(f"{cameras}: cameras without calibration, a calibration matrix is needed")
    else:
        lines = list(_rows(calibration, 4))
        if [len(values) for _, values in lines] != [3, 3, 3] or not lines[0][1][0] > 0:
            raise SurveyFileError(
                f"{calibration}, line {lines[-1][0]}: three lines of 3 numbers are needed, a matrix K"
            )
        K = np.array([values for _, values in lines])
        inner = np.array([[K[0, 0], K[0, 2], K[1, 2], K[1, 1] / K[0, 0], K[0, 1]]])
        camera = np.zeros(len(rows), dtype=np.int64)
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
    return network, Estimate(made, position, np.swapaxes(VISION_AXES @ R, 1, 2).copy(), xyz)


def write_sba_text(cameras: Path, points: Path, network: Network, estimate: Estimate) -> None:
    """Write a network as sba's two files: cameras with their parameters, projections with covariances.

    Names of photographs and points are lost.

    Raises:
        OutputError: the files cannot store the network, or they cannot be written.
    """
    for camera in estimate.cameras:
        if camera.model != "opencv" or camera.parameters[4:].any():
            raise OutputError(f"camera {camera.name}: sba's files cannot store distortion")
    if not (estimate.oriented.all() and estimate.determined.all()):
        raise OutputError("sba's files require start values of all photographs and points")
    rotation = VISION_AXES @ np.swapaxes(estimate.rotation, 1, 2)
    translation = -np.einsum("mab,mb->ma", rotation, estimate.position)
    quaternion = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
    lines = ["# fu u0 v0 ar s qw qx qy qz tx ty tz"]
    for i, k in enumerate(network.camera):
        fx, fy, cx, cy = estimate.cameras[k].parameters[:4]
        lines.append(_numbers(fx, cx, cy, fy / fx, 0.0, *quaternion[i], *translation[i]))
    seen = network.image_points
    stated = bool(np.isfinite(seen.stated_sigma).any())
    point_lines = [f"# X Y Z n (frame x y{' covariance' if stated else ''})*n"]
    for xyz, rows in zip(estimate.points, rows_of(seen.point, len(estimate.points)), strict=True):
        frames = [
            f"{seen.image[r]} {_numbers(*seen.xy[r], *(seen.covariance[r].ravel() if stated else ()))}"
            for r in rows[np.argsort(seen.image[rows], kind="stable")]
        ]
        point_lines.append(" ".join([_numbers(*xyz), f"{len(rows)}", *frames]))
    cameras.parent.mkdir(parents=True, exist_ok=True)
    write_lines(cameras, lines)
    write_lines(points, point_lines)


def read_sba(path: Path) -> tuple[Network, Estimate]:
    """Read a problem by the file of its cameras, or from the folder of a single problem; see `sba_files`.

    Raises:
        SurveyFileError: what is missing or wrong, with file and line number.
    """
    cameras, points, calibration, sigmas = sba_files(path)
    return read_sba_text(cameras, points, calibration, sigmas=sigmas)


def write_sba_folder(folder: Path, network: Network, estimate: Estimate) -> None:
    """Write cams.txt and pts.txt.

    Raises:
        OutputError: the files cannot store the network, or they cannot be written.
    """
    write_sba_text(folder / "cams.txt", folder / "pts.txt", network, estimate)


def sba_files(path: Path) -> tuple[Path, Path, Path | None, Path | None]:
    """Return the files of cameras, points, calibration and sigmas; the last two are None if missing.

    Args:
        path: file of the cameras, or folder of a single problem.

    Raises:
        SurveyFileError: the folder has no problem or several, or the points are missing.
    """
    cameras = path
    if path.is_dir():
        camera_files = sorted(path.glob("*cams*.txt"))
        if len(camera_files) != 1:
            names = ", ".join(file.name for file in camera_files) or "none"
            raise SurveyFileError(f"{path}: needed one file *cams*.txt, found: {names}")
        cameras = camera_files[0]
    points = cameras.with_name(cameras.name.replace("cams", "pts"))
    if "cams" not in cameras.name or not points.is_file():
        raise SurveyFileError(f"{cameras}: sba's cameras are in a file *cams*.txt beside one *pts*.txt")
    others = (cameras.with_name("calib.txt"), cameras.with_name(cameras.name.replace("cams", "sigmas")))
    calibration, sigmas = (other if other.is_file() else None for other in others)
    return cameras, points, calibration, sigmas


def _numbers(*values: float) -> str:
    """Write numbers that are read back to the last bit."""
    return " ".join(repr(float(value)) for value in values)


def _camera(name: str, values: FloatArray, size_px: tuple[int, int], path: Path) -> Camera:
    fu, u0, v0, aspect, skew = values
    if not (fu > 0 and aspect > 0):
        raise SurveyFileError(
            f"{path}: focal length {fu:g} px, aspect ratio {aspect:g}: both must be positive"
        )
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


def _points(path: Path, frames: int) -> tuple[ImagePoints, FloatArray]:
    stated: list[bool] = []
    image, point, xy, covariance, xyz = array("q"), array("q"), array("d"), array("d"), array("d")
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
            projection = values[4 + p * width : 4 + (p + 1) * width]
            if not 0 <= projection[0] < frames:
                raise SurveyFileError(
                    f"{path}, line {number}: frame {projection[0]:g}, there are {frames} cameras"
                )
            image.append(int(projection[0]))
            point.append(len(xyz) // 3)
            xy.extend(projection[1:3])
            stated.append(width == WITH_COVARIANCE)
            xx, c_xy, c_yx, yy = projection[3:7] if stated[-1] else (SIGMA_PX**2, 0.0, 0.0, SIGMA_PX**2)
            if not (c_xy == c_yx and xx > 0 and xx * yy - c_xy * c_yx > 0):
                raise SurveyFileError(
                    f"{path}, line {number}: covariance {projection[3:7]} of frame {projection[0]:g} "
                    "is not symmetric and positive definite"
                )
            covariance.extend((xx, c_xy, c_yx, yy))
        xyz.extend(values[:3])
        if len(image) + len(xyz) // 3 > MAX_IMAGE_POINTS:
            raise SurveyFileError(
                f"{path}, line {number}: more than {MAX_IMAGE_POINTS} points and projections"
            )
    if not image:
        raise SurveyFileError(f"{path}, line {number}: no projections to the end")
    return (
        ImagePoints(
            np.array(image, dtype=np.int64),
            np.array(point, dtype=np.int64),
            np.array(xy).reshape(-1, 2),
            np.array(covariance).reshape(-1, 2, 2),
            np.array(stated, dtype=bool),
        ),
        np.array(xyz).reshape(-1, 3),
    )


def _with_sigmas(image_points: ImagePoints, path: Path) -> ImagePoints:
    given, last = array("d"), 1
    for number, values in _rows(path):
        given.extend(values)
        last = number
    sigma = np.array(given)
    if len(sigma) != 2 * len(image_points) or not (sigma > 0).all():
        raise SurveyFileError(
            f"{path}, line {last}: {len(sigma)} numbers to the end, {2 * len(image_points)} positive "
            "standard deviations are needed"
        )
    covariance = np.zeros((len(image_points), 2, 2))
    covariance[:, 0, 0], covariance[:, 1, 1] = sigma.reshape(-1, 2).T ** 2
    return ImagePoints(image_points.image, image_points.point, image_points.xy, covariance)


def _rows(path: Path, most: int = MAX_LINES) -> Iterator[tuple[int, list[float]]]:
    """Yield line number and numbers of each nonempty line, at least one; # starts a comment."""
    text, count = Lines.of(path), 0
    while (words := text.row()) is not None:
        count += 1
        text.refuse_more(count, most, "lines of numbers")
        yield text.number, [text.number_of(word) for word in words]
    if not count:
        raise SurveyFileError(f"{path}, line 1: no numbers")
