"""Bundle Adjustment in the Large (BAL) problems, read and written.

    <cameras> <points> <observations>
    <camera> <point> <x> <y>            per observation
    <camera values>                     per camera 9 lines: rotation vector, translation, f, k1, k2
    <point values>                      per point 3 lines: X, Y, Z

P = R X + t, p = -P / P_z, p' = f (1 + k1 |p|^2 + k2 |p|^4) p, in px, with the origin at the centre of the
photograph, x right, y up. The camera looks along -z like Kolinear's, R is Kolinear's M, and p are its
tangents. BAL states neither names nor sizes of photographs; every photograph has a separate camera.

Source: Agarwal, Snavely, Seitz, Szeliski (2010), Bundle adjustment in the large, ECCV; and the page
https://grail.cs.washington.edu/projects/bal/.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from adapters.reading.text_lines import MAX_LINES, MAX_PHOTOGRAPHS, Lines, write_lines
from sfm.files.csv_tables import MAX_ROWS
from sfm.model.camera import camera_from_values
from sfm.model.distortion.models import Role
from sfm.model.errors import OutputError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network

CAMERA_VALUES = 9
MODELS = ("opencv", "radial")  # permitted camera models
FOCAL = 6  # index of the focal length among the camera values
OBSERVATION_BYTES, VALUE_BYTES = 7, 1  # of the shortest lines; the last value may lack a line end
FREE = ("f", "k1", "k2")  # adjusted by BAL


def read_bal(path: Path, *, size_px: tuple[int, int] | None = None) -> tuple[Network, Estimate]:
    """Read a BAL problem as a network and its start values; photographs and points are named from 0.

    Args:
        path: the problem.
        size_px: width and height of the photographs; None chooses the smallest that contains all image
            points.

    Raises:
        SurveyFileError: with file and line number.
    """
    text = Lines.of(path)
    head = text.due_row("the number of cameras, points and observations")
    if len(head) != 3:
        raise text.error(f"{len(head)} words, needed the number of cameras, points and observations")
    m, n, k = (
        text.count_of(word, what, most)
        for word, what, most in zip(
            head, ("cameras", "points", "observations"), (MAX_PHOTOGRAPHS, MAX_ROWS, MAX_LINES), strict=True
        )
    )
    due = OBSERVATION_BYTES * k + VALUE_BYTES * (CAMERA_VALUES * m + 3 * n)
    if due > text.size:
        raise text.error(f"{text.size} bytes in the file, these numbers need at least {due}")
    image, point = np.empty(k, dtype=np.int64), np.empty(k, dtype=np.int64)
    xy = np.empty((k, 2))
    for row in range(k):
        words = text.due_row(f"observation {row} of {k}")
        if len(words) != 4:
            raise text.error(f"{len(words)} words, an observation is camera, point, x, y")
        image[row] = text.index_of(words[0], m, "camera")
        point[row] = text.index_of(words[1], n, "point")
        xy[row] = text.number_of(words[2]), text.number_of(words[3])
    values = np.empty(CAMERA_VALUES * m + 3 * n)
    for row in range(len(values)):
        what = f"value {row} of {len(values)}"
        words = text.due_row(what)
        if len(words) != 1:
            raise text.error(f"{len(words)} words, {what} was expected")
        values[row] = text.number_of(words[0])
        if row < CAMERA_VALUES * m and row % CAMERA_VALUES == FOCAL and values[row] <= 0:
            raise text.error(f"focal length {values[row]:g} px, it must be positive")
    text.end()
    cams = values[: CAMERA_VALUES * m].reshape(m, CAMERA_VALUES)
    width, height = 2 * np.ceil(np.abs(xy).max(axis=0) + 1).astype(int)
    size = (int(width), int(height)) if size_px is None else size_px
    M = Rotation.from_rotvec(cams[:, :3]).as_matrix()
    cameras = tuple(
        camera_from_values(
            f"{i}", "radial", size, (1.0, 1.0), c_mm=f, free=FREE, values=(("k1", k1), ("k2", k2))
        )
        for i, (f, k1, k2) in enumerate(cams[:, 6:].tolist())
    )
    centre = (np.asarray(size, dtype=float) - 1) / 2
    network = Network(
        tuple(f"{i}" for i in range(m)),
        np.arange(m, dtype=np.int64),
        tuple(f"{j}" for j in range(n)),
        ImagePoints(
            image, point, centre + xy * (1, -1), np.tile(np.eye(2), (k, 1, 1)), np.zeros(k, dtype=bool)
        ),
    )
    position = -np.einsum("iba,ib->ia", M, cams[:, 3:6])
    return network, Estimate(
        cameras,
        position,
        np.ascontiguousarray(M.transpose(0, 2, 1)),
        values[CAMERA_VALUES * m :].reshape(n, 3),
    )


def write_bal(path: Path, network: Network, estimate: Estimate) -> None:
    """Write a network as a BAL problem.

    Args:
        path: file to write.
        network: the measured network.
        estimate: complete; cameras in model radial, or in opencv with one focal length and no decentring.

    Raises:
        OutputError: BAL cannot store the network, or the file cannot be written.
    """
    for camera in estimate.cameras:
        focal, further = camera.parameters[camera.plays(Role.FOCAL)], camera.plays(Role.DECENTRING)
        if camera.model not in MODELS or np.ptp(focal) or camera.parameters[further].any():
            raise OutputError(
                f"camera {camera.name}: BAL has one focal length with k1 and k2, and no other parameters"
            )
    if not (estimate.oriented.all() and estimate.determined.all()):
        raise OutputError("BAL requires start values of all photographs and points, some have none")
    seen = network.image_points
    m, n = len(network.images), len(network.points)
    lines = [f"{m} {n} {len(seen)}"]
    principal = np.array([[c.value("cx"), c.value("cy")] for c in estimate.cameras])
    principal = principal[network.camera[seen.image]]
    xy = (seen.xy - principal) * (1, -1)
    lines += [f"{i} {j}     {x:.9e} {y:.9e}" for i, j, (x, y) in zip(seen.image, seen.point, xy, strict=True)]
    M = estimate.rotation.transpose(0, 2, 1)
    translation = -np.einsum("iab,ib->ia", M, estimate.position)
    for i, vector in enumerate(Rotation.from_matrix(M).as_rotvec()):
        camera = estimate.cameras[network.camera[i]]
        values = (*vector, *translation[i], camera.c_px, camera.value("k1"), camera.value("k2"))
        lines += [f"{value:.16e}" for value in values]
    lines += [f"{value:.16e}" for value in estimate.points.ravel()]
    write_lines(path, lines)
