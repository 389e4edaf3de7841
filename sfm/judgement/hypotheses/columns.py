"""Columns of the design matrix that alternatives add: derivatives of image points by each freedom.

- Camera: the effect of c in the camera's model, including distortion; effects of principal point, radial,
  decentring and affine distortion, the same for all models.
- Strain: a homogeneous deformation of the object, without scale, which a photograph absorbs by its distance.
- Bending: a displacement quadratic in the coordinates.
- Interior: the derivatives by the parameters of the camera's model.

Source: Brown (1971), Close-range camera calibration, Photogramm. Eng. 37(8); Foerstner and Wrobel (2016),
Photogrammetric Computer Vision, sec. 4.6.4 (systematic errors), 12.2 (small rotations).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.model.camera import parameter_jacobian, pixel_jacobian
from sfm.model.conventions import BoolArray, FloatArray, IntArray, skew
from sfm.model.distortion.models import Role
from sfm.model.network import rows_of
from sfm.model.similarity import mean_distance
from sfm.runtime.compiling import compiled

CAMERA = ("c", "x0", "y0", "K1", "K2", "P1", "P2", "b1", "b2")
CAMERA_ROLES = (
    Role.FOCAL,
    Role.X0,
    Role.Y0,
    Role.RADIAL,
    Role.RADIAL,
    Role.DECENTRING,
    Role.DECENTRING,
    Role.AFFINITY,
    Role.SHEAR,
)
STRAIN, BENDING = 5, 18  # columns
CAMERA_PLACES = tuple(range(len(CAMERA)))  # indices in the freedoms of a photograph
STRAIN_PLACES = tuple(range(len(CAMERA), len(CAMERA) + STRAIN))
BENDING_PLACES = tuple(range(len(CAMERA) + STRAIN, len(CAMERA) + STRAIN + BENDING))


@dataclass(frozen=True)
class Columns:
    """Derivatives of the k image points of an adjustment, including rejected ones, px."""

    adjustment: Adjustment
    exterior: FloatArray  # derivatives by X0 and small rotation of the photograph, (k, 2, 6)
    point: FloatArray  # derivatives by the object point, (k, 2, 3)
    usable: BoolArray  # whether all of these are finite, (k,); the others are 0

    @cached_property
    def freedoms(self) -> FloatArray:
        """Derivatives by the freedoms of a single photograph, (k, 2, 9 + 5 + 18).

        They are those of `CAMERA`, px at the edge of the photograph, then strain and bending of the object,
        with its size as unit.
        """
        network, estimate = self.adjustment.network, self.adjustment.estimate
        seen = network.image_points
        UVW = _in_photographs(self.adjustment, np.arange(len(seen)))
        uv = -UVW[:, :2] / UVW[:, 2:]
        freedoms, flat = np.empty((len(seen), 2, len(CAMERA) + STRAIN + BENDING)), np.empty((len(seen), 2))
        for camera, rows in zip(
            estimate.cameras, rows_of(network.camera[seen.image], len(estimate.cameras)), strict=True
        ):
            if len(rows):
                half, focal = max(camera.size_px) / 2, camera.plays(Role.FOCAL)
                flat[rows] = uv[rows] * camera.c_px / half
                # with another c, the same rays pass through other parts of the distortion
                by_focal = parameter_jacobian(camera, uv[rows])[:, :, focal] @ camera.parameters[focal]
                freedoms[rows, :, 0] = np.nan_to_num(by_focal) / half
        # the freedoms of a camera other than c, 1 px at the edge, by tangents over that of half the side
        x, y = flat.T
        r2, ones, zero = x**2 + y**2, np.ones(len(seen)), np.zeros(len(seen))
        across = [ones, zero, x * r2, x * r2**2, r2 + 2 * x**2, 2 * x * y, x, y]
        down = [zero, ones, y * r2, y * r2**2, 2 * x * y, r2 + 2 * y**2, zero, zero]
        freedoms[:, 0, 1 : len(CAMERA)] = np.stack(across, -1)
        freedoms[:, 1, 1 : len(CAMERA)] = -np.stack(down, -1)
        fields = object_fields(estimate.points)[0]
        freedoms[:, :, len(CAMERA) :] = self.point @ fields[seen.point]
        freedoms[~self.usable] = 0.0
        return freedoms


def columns_of(a: Adjustment) -> Columns:
    """Return the derivatives of all image points of an adjustment."""
    network, estimate = a.network, a.estimate
    seen = network.image_points
    UVW, k = _in_photographs(a, np.arange(len(seen))), len(seen)
    J = np.zeros((k, 2, 2))
    for camera, rows in zip(
        estimate.cameras, rows_of(network.camera[seen.image], len(estimate.cameras)), strict=True
    ):
        if len(rows):
            J[rows] = pixel_jacobian(camera, seen.xy[rows])
    exterior, point = np.empty((k, 2, 6)), np.empty((k, 2, 3))
    _by_poses_and_points(J, UVW, np.ascontiguousarray(estimate.rotation), seen.image, exterior, point)
    usable = np.isfinite(point).all(axis=(1, 2)) & (UVW[:, 2] < 0)
    for part in (exterior, point):
        part[~usable] = 0.0
    return Columns(a, exterior, point, usable)


@compiled
def _by_poses_and_points(
    J: FloatArray, UVW: FloatArray, R: FloatArray, image: IntArray, exterior: FloatArray, point: FloatArray
) -> None:
    """Fill the derivatives of image points by X0 and small rotation, (k, 2, 6), and by the point, (k, 2, 3).

    Args:
        J: derivatives by the tangents u = -U / W and v = -V / W, (k, 2, 2).
        UVW: object points in the system of their photograph, (k, 3).
        R: rotations of the photographs, (m, 3, 3).
        image: photograph of each image point, (k,).
        exterior: to fill.
        point: to fill.
    """
    for k in range(len(J)):
        U, V, W = UVW[k, 0], UVW[k, 1], UVW[k, 2]
        turn = R[image[k]]
        for row in range(2):
            # d (u, v) / d (U, V, W) = -(1, 0, u) / W
            a, b = -J[k, row, 0] / W, -J[k, row, 1] / W
            c = -(a * U + b * V) / W
            for axis in range(3):
                by_axis = a * turn[axis, 0] + b * turn[axis, 1] + c * turn[axis, 2]
                point[k, row, axis] = by_axis
                exterior[k, row, axis] = -by_axis
            exterior[k, row, 3] = b * W - c * V
            exterior[k, row, 4] = c * U - a * W
            exterior[k, row, 5] = a * V - b * U


def object_fields(points: FloatArray) -> tuple[FloatArray, float]:
    """Return the displacements of points by strain and bending, (n, 3, 5 + 18), and the size of the object.

    The size is the root mean square distance from the centre, where points are known. A parameter of 1
    displaces points by that size.
    """
    known = np.asarray(np.isfinite(points).all(axis=1))
    centre = points[known].mean(axis=0)
    size = mean_distance(points[known])
    x, y, z = (np.where(known[:, None], points - centre, 0.0) / size).T
    zero = np.zeros_like(x)
    strain = np.stack(
        [
            np.stack([x, -y, zero], -1),
            np.stack([x, y, -2 * z], -1),
            np.stack([y, x, zero], -1),
            np.stack([z, zero, x], -1),
            np.stack([zero, z, y], -1),
        ],
        axis=2,
    )
    terms = np.stack([x * x, y * y, z * z, x * y, x * z, y * z], axis=-1)
    bending = np.einsum("nt,cd->nctd", terms, np.eye(3)).reshape(len(points), 3, BENDING)
    return size * np.concatenate([strain, bending], axis=2), size


def rigid_motions(points: FloatArray, body: IntArray | BoolArray) -> FloatArray:
    """Return the displacements of points by the six motions of a rigid body, (..., n, 3, 6).

    The motions are three shifts and three small rotations about its centre, which also move its points by 1.

    Args:
        points: coordinates, (n, 3); not known (NaN) of points that are in no body only.
        body: points of each body, (..., n); or the indices of those of one.
    """
    members = np.asarray(body if body.dtype == bool else np.isin(np.arange(len(points)), body))
    used = np.asarray(members.reshape(-1, len(points)).any(axis=0))
    known = np.where(used[:, None], points, 0.0)
    count = members.sum(axis=-1)[..., None]
    away = points - ((members @ known) / count)[..., None, :]
    square = (np.where(members[..., None], away, 0.0) ** 2).sum(axis=(-2, -1))[..., None]
    motions = np.zeros((*members.shape, 3, 6))
    motions[..., :3] = np.eye(3)
    motions[..., 3:] = -skew(away) / np.sqrt(square / count)[..., None, None]
    return motions


def interior_columns(
    a: Adjustment, parameters: Sequence[tuple[int, int]]
) -> tuple[FloatArray, list[tuple[str, str]], list[float]]:
    """Return the derivatives by interior parameters; cameras that share a parameter have one column for it.

    They are 0 in photographs of other cameras. The unit of a parameter is scaled so that its largest effect
    is 1 px. So parameters of all units have columns of similar size.

    Args:
        a: adjustment.
        parameters: (camera, parameter) by their indices.

    Returns:
        Columns (k, 2, g), (camera or group, parameter name) of each, and the change of the parameter for one
        unit of the column.
    """
    network, estimate = a.network, a.estimate
    seen = network.image_points
    owners = [
        (estimate.cameras[index].owner_of(s), estimate.cameras[index].names[s]) for index, s in parameters
    ]
    groups = {owner: np.zeros((len(seen), 2)) for owner in owners}
    units: dict[tuple[str, str], float] = {}
    for index in dict.fromkeys(index for index, _ in parameters):
        camera = estimate.cameras[index]
        rows = np.flatnonzero(network.camera[seen.image] == index)
        UVW = _in_photographs(a, rows)
        jacobian = np.nan_to_num(parameter_jacobian(camera, UVW))
        largest = np.abs(jacobian).max(axis=(0, 1), initial=0.0)
        for (other, s), owner in zip(parameters, owners, strict=True):
            if other == index:
                unit = units.setdefault(owner, 1 / float(largest[s]) if largest[s] > 0 else 1.0)
                groups[owner][rows] += jacobian[:, :, s] * unit
    stacked = np.stack(list(groups.values()), axis=2) if groups else np.zeros((len(seen), 2, 0))
    return stacked, list(groups), [units[owner] for owner in groups]


def _in_photographs(a: Adjustment, rows: IntArray) -> FloatArray:
    """Return the object points of image points in the system of their photograph, (r, 3)."""
    image, point = a.network.image_points.image[rows], a.network.image_points.point[rows]
    away = a.estimate.points[point] - a.estimate.position[image]
    return np.asarray(np.einsum("kji,kj->ki", a.estimate.rotation[image], away))
