"""Pairs of photographs: dependent and independent relative orientation, and normal images.

The dependent orientation keeps the frame of photograph 1. Its parameters are by, bz (for a given bx) and
omega, phi, kappa of photograph 2. The independent orientation takes the base as the X axis of the model. Its
parameters are phi1, kappa1 of photograph 1 (omega1 = 0) and omega2, phi2, kappa2 of photograph 2; model
coordinates are in units of the base.

Normal images of two oriented photographs are free of distortion, and their rows are epipolar lines. Both
have the same rotation, with the base as x axis, and the same principal distance. Conjugate points have the
same y, and their x differ by the parallax c b / depth. So matching along a row is matching along an epipolar
line.

Source: document 002, sec. II.1.2.1 (normalisation); Kraus (2007), Photogrammetry, sec. 4.3 and 6.8.4 (normal
images); Fusiello, Trucco and Verri (2000), Machine Vision and Applications 12, 16-22 (rotation).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sfm.model.arguments import checked_arguments
from sfm.model.camera import (
    Camera,
    border_pixels,
    camera_from_values,
    project,
    ray_directions,
    tangents_from_pixel,
)
from sfm.model.conventions import AnyArray, FloatArray, angles_from_rotation, rotation_from_angles
from sfm.model.display import counted
from sfm.model.distributions import MARGIN
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.orientation.intersection import intersect
from sfm.orientation.relative import (
    SPATIAL_POINTS,
    UNKNOWNS,
    refine_coplanarity,
    relative_orientations,
    turned_pair,
)
from sfm.runtime.sampling import resample

BORDER_POINTS = 40  # points per side of a photograph that give the format of its normal image
MAX_LARGER = 4.0  # largest area of a normal image over that of its photograph; beyond, the base is along rays
DIFFERENCE = 1e-6  # rad, step of central differences: their error is about 1e-12 of the derivative
NO_BX = 1e-6  # smallest |bx| over the base for which a given bx determines by and bz
SAME = 1e-6  # of base and rotation: adjustments that end at one solution differ less
FIVE_POINT_TOLERANCE = 0.01  # tangents: the five-point start rejects pairs with larger residuals
DEPENDENT = ("by", "bz", "omega", "phi", "kappa")
INDEPENDENT = ("phi1", "kappa1", "omega2", "phi2", "kappa2")


@dataclass(frozen=True)
class PairOrientation:
    """The five parameters of a pair, adjusted by least squares on the coplanarity condition."""

    kind: str  # dependent | independent
    names: tuple[str, ...]  # parameter names
    parameters: FloatArray  # by, bz in the unit of bx, angles in rad, (5,)
    covariance: FloatArray  # covariance of the parameters; NaN without redundancy, (5, 5)
    positions: FloatArray  # both projection centres in the frame of the pair, (2, 3)
    rotations: FloatArray  # R of both photographs, image axes to the frame of the pair, (2, 3, 3)
    residuals: FloatArray  # distance of each pair of rays from coplanarity, tangents, (n,)
    sigma0: float  # a posteriori standard deviation of an image coordinate, tangents; NaN without redundancy
    redundancy: int  # n - 5
    is_ambiguous: bool = False  # whether another orientation fits, as of points close to a plane


@checked_arguments(first="n 2", second="n 2", start="5")
def orient_dependent(
    first: FloatArray, second: FloatArray, *, bx: float = 1.0, start: FloatArray | None = None
) -> PairOrientation:
    """Return the dependent relative orientation: by, bz, omega, phi, kappa of photograph 2.

    Args:
        first: tangents u = -U/W, v = -V/W of rays of photograph 1, shape (n, 2), n >= 5.
        second: tangents of the conjugate rays of photograph 2, shape (n, 2).
        bx: X component of the base, which sets the scale of the model.
        start: approximate by, bz (in the unit of bx), omega, phi, kappa (rad), shape (5,). Without a start
            the five-point solution is taken, which needs at least six pairs.

    Returns:
        The five parameters with their covariance, and both photographs in the frame of photograph 1.

    Raises:
        GeometryError: there are too few pairs, the pairs do not determine the parameters, the base is
            undetermined or has no X component, or without a start bx has the wrong sign.

    Source: document 004, "dependent relative orientation"; Kraus (2007), sec. 4.3.
    """
    if not (np.isfinite(bx) and bx != 0):
        raise GeometryError(f"dependent pair: bx is {bx:g}, but it sets the scale, expected another value")
    is_ambiguous = False
    if start is None:
        b, R, is_ambiguous = _orient_without_start(first, second)
        if b[0] * bx < 0:
            raise GeometryError(
                f"dependent pair: with bx = {bx:g} the rays meet behind the photographs, expected the other "
                "sign, or the photographs in the other order"
            )
    else:
        b = np.array([bx, start[0], start[1]])
        R = rotation_from_angles(start[2], start[3], start[4])

    def parameters(base: FloatArray, rotation: FloatArray) -> FloatArray:
        return np.array([*(base[1:] * bx / base[0]), *angles_from_rotation(rotation)])

    b, R, v, Q = refine_coplanarity(first, second, b / np.linalg.norm(b), R)
    if abs(b[0]) < NO_BX:
        raise GeometryError("dependent pair: the base has no X component, use the independent pair")
    positions = np.stack([np.zeros(3), b * bx / b[0]])
    rotations = np.stack([np.eye(3), R])
    values, covariance, sigma0 = _with_precision(parameters, b, R, v, Q)
    return PairOrientation(
        "dependent",
        DEPENDENT,
        values,
        covariance,
        positions,
        rotations,
        v,
        sigma0,
        len(v) - UNKNOWNS,
        is_ambiguous,
    )


@checked_arguments(first="n 2", second="n 2", start="5")
def orient_independent(
    first: FloatArray, second: FloatArray, *, start: FloatArray | None = None
) -> PairOrientation:
    """Return the independent relative orientation phi1, kappa1, omega2, phi2, kappa2 in the base frame.

    Args:
        first: tangents u = -U/W, v = -V/W of rays of photograph 1, shape (n, 2), n >= 5.
        second: tangents of the conjugate rays of photograph 2, shape (n, 2).
        start: approximate phi1, kappa1, omega2, phi2, kappa2, rad, shape (5,). Without a start the five-point
            solution is taken, which needs at least six pairs.

    Returns:
        The five parameters with their covariance, and both photographs in the frame of the base.

    Raises:
        GeometryError: there are too few pairs, the pairs do not determine the parameters, or the base is
            undetermined.

    Source: document 004, "independent relative orientation"; Kraus (2007), sec. 4.3.
    """
    is_ambiguous = False
    if start is None:
        b, R, is_ambiguous = _orient_without_start(first, second)
    else:
        R1 = rotation_from_angles(0.0, start[0], start[1])
        b, R = R1[0], R1.T @ rotation_from_angles(start[2], start[3], start[4])

    def parameters(base: FloatArray, rotation: FloatArray) -> FloatArray:
        R1 = _base_frame(base)
        return np.array([*angles_from_rotation(R1)[1:], *angles_from_rotation(R1 @ rotation)])

    b, R, v, Q = refine_coplanarity(first, second, b, R)
    R1 = _base_frame(b)
    positions = np.array([[0.0, 0, 0], [1, 0, 0]])
    rotations = np.stack([R1, R1 @ R])
    values, covariance, sigma0 = _with_precision(parameters, b, R, v, Q)
    return PairOrientation(
        "independent",
        INDEPENDENT,
        values,
        covariance,
        positions,
        rotations,
        v,
        sigma0,
        len(v) - UNKNOWNS,
        is_ambiguous,
    )


@checked_arguments(first="n 2", second="n 2")
def intersect_pair(orientation: PairOrientation, first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the model coordinates of the conjugate rays of an oriented pair, unit of its base, (n, 3).

    Args:
        orientation: of the pair.
        first: tangents of rays of photograph 1, shape (n, 2).
        second: tangents of the conjugate rays of photograph 2, shape (n, 2).

    Returns:
        Points with the smallest sum of squared image residuals; NaN where rays are parallel or meet behind a
        photograph.
    """
    return _intersect(orientation.positions, orientation.rotations, first, second)


def _intersect(
    positions: FloatArray, rotations: FloatArray, first: FloatArray, second: FloatArray
) -> FloatArray:
    n = len(first)
    return intersect(
        np.concatenate([first, second]),
        np.repeat([0, 1], n),
        np.tile(np.arange(n), 2),
        positions,
        rotations,
        n_points=n,
    ).points


def _base_frame(base: FloatArray) -> FloatArray:
    """Return R1 = Ry(phi1) Rz(kappa1), which rotates the base to the X axis: its first row is the base."""
    phi = np.arcsin(np.clip(base[2], -1.0, 1.0))
    kappa = np.arctan2(-base[1], base[0])
    return rotation_from_angles(0.0, phi, kappa)


def _orient_without_start(first: FloatArray, second: FloatArray) -> tuple[FloatArray, FloatArray, bool]:
    """Return base and rotation without start values, and whether another orientation fits as well.

    Two orientations fit the rays of a plane. The right one has the points in front of both photographs;
    the other one may have them there too.
    """
    if len(first) < SPATIAL_POINTS:
        raise GeometryError(
            f"relative orientation: {counted(len(first), 'pair')}, at least {SPATIAL_POINTS} are needed "
            "without start values"
        )
    solutions = relative_orientations(first, second, tolerance=FIVE_POINT_TOLERANCE)
    if solutions[0].kind == "infinite":
        raise GeometryError(
            "relative orientation: a rotation alone explains the rays, there is no base to determine"
        )
    if solutions[0].kind != "planar":
        return solutions[0].base, solutions[0].rotation, False
    fits = []
    for solution in solutions:
        b, R, v, _ = refine_coplanarity(first, second, solution.base, solution.rotation)
        points = _intersect(np.stack([np.zeros(3), b]), np.stack([np.eye(3), R]), first, second)
        fits.append((-int(np.isfinite(points).all(axis=1).sum()), float(v @ v), b, R))
    in_front, squares, b, R = min(fits, key=lambda fit: fit[:2])
    is_ambiguous = any(
        fit[0] == in_front
        and len(first) * np.log(fit[1] / squares) < MARGIN
        and not (np.allclose(fit[2], b, atol=SAME) and np.allclose(fit[3], R, atol=SAME))
        for fit in fits
    )
    return b, R, is_ambiguous


def _with_precision(
    parameters: Callable[[FloatArray, FloatArray], FloatArray],
    base: FloatArray,
    rotation: FloatArray,
    residuals: FloatArray,
    cofactors: FloatArray,
) -> tuple[FloatArray, FloatArray, float]:
    """Return parameters, covariance and sigma0; the covariance follows from small rotations of the pair."""
    J = np.empty((UNKNOWNS, UNKNOWNS))
    for k, step in enumerate(np.eye(UNKNOWNS) * DIFFERENCE):
        plus = parameters(*turned_pair(base, rotation, step))
        minus = parameters(*turned_pair(base, rotation, -step))
        change = plus - minus
        # an angle may jump by 360 deg between the two
        change[-3:] = (change[-3:] + np.pi) % (2 * np.pi) - np.pi
        J[:, k] = change / (2 * DIFFERENCE)
    redundancy = len(residuals) - UNKNOWNS
    sigma0 = float(np.sqrt(np.sum(residuals**2) / redundancy)) if redundancy > 0 else np.nan
    return parameters(base, rotation), sigma0**2 * J @ cofactors @ J.T, sigma0


@dataclass(frozen=True)
class NormalImages:
    """The normal images of a pair; the left photograph comes first."""

    images: tuple[str, str]
    """names of the photographs"""
    cameras: tuple[Camera, Camera]
    """cameras of the normal images, without distortion; both share principal distance, format and y0"""
    position: FloatArray
    """projection centres, object unit, (2, 3)"""
    rotation: FloatArray
    """common R, image to object axes, (3, 3)"""
    source: Estimate
    """interior and exterior orientation of the two photographs"""

    def normal_xy(self, side: int, xy: FloatArray) -> FloatArray:
        """Map points of a photograph to its normal image, px, (k, 2); NaN without an image.

        Args:
            side: 0 for the left image, 1 for the right.
            xy: points in the photograph, px, (k, 2).
        """
        here = self.source
        return _project_rays(self.cameras[side], self.rotation, here.cameras[side], here.rotation[side], xy)

    def photograph_xy(self, side: int, xy: FloatArray) -> FloatArray:
        """Map points of a normal image to its photograph, px, (k, 2); NaN without an image.

        Args:
            side: 0 for the left image, 1 for the right.
            xy: points in the normal image, px, (k, 2).
        """
        here = self.source
        return _project_rays(here.cameras[side], here.rotation[side], self.cameras[side], self.rotation, xy)

    def resample(self, side: int, photograph: AnyArray) -> FloatArray:
        """Resample a photograph to its normal image, intensities, (H, W); NaN outside the photograph.

        Args:
            side: 0 for the left image, 1 for the right.
            photograph: intensities, (h, w).
        """
        width, height = self.cameras[side].size_px
        y, x = np.mgrid[:height, :width]
        xy = self.photograph_xy(side, np.stack([x, y], axis=-1).reshape(-1, 2).astype(float))
        return resample(photograph, xy.reshape(height, width, 2), interpolation="bicubic")


@checked_arguments()
def make_normal_images(network: Network, estimate: Estimate, first: str, second: str) -> NormalImages:
    """Return the normal images of two oriented photographs, large enough to show both photographs in full.

    Args:
        network: network that contains the photographs.
        estimate: orientation of the photographs.
        first: name of one photograph.
        second: name of the other photograph.

    Raises:
        UnknownNameError: there is no photograph of that name.
        GeometryError: a photograph is not oriented, the base is zero, or the base is along the rays, so that
            a normal image would be infinite.

    Source: document 002, sec. II.1.2.1; Kraus (2007), sec. 6.8.4.
    """
    rows = [network.image_index(name) for name in (first, second)]
    position, rotation = estimate.position[rows], estimate.rotation[rows]
    if not (np.isfinite(position).all() and np.isfinite(rotation).all()):
        raise GeometryError(f"normal images: {first} or {second} is not oriented")
    base = position[1] - position[0]
    if not np.linalg.norm(base) > 0:
        raise GeometryError(
            f"normal images: {first} and {second} share one projection centre, a base is needed"
        )
    if base @ (rotation[0] + rotation[1])[:, 0] < 0:  # x of the images points the other way
        rows, position, rotation, base = rows[::-1], position[::-1], rotation[::-1], -base
    cameras = tuple(estimate.cameras[network.camera[i]] for i in rows)
    x = base / np.linalg.norm(base)
    y = np.cross((rotation[0] + rotation[1])[:, 2], x)
    if not np.linalg.norm(y) > 0:
        raise GeometryError(f"normal images: the base of {first} and {second} is along their axes")
    y /= np.linalg.norm(y)
    R = np.column_stack([x, y, np.cross(x, y)])
    names = network.images[rows[0]], network.images[rows[1]]
    source = replace(estimate, cameras=cameras, position=position, rotation=rotation)
    c_px = float(np.mean([camera.c_px for camera in cameras]))
    centred = camera_from_values("centred", "brown", (1, 1), (1.0, 1.0), c_mm=c_px)
    seen = [
        _project_rays(centred, R, camera, turned, border_pixels(camera, BORDER_POINTS))
        for camera, turned in zip(cameras, rotation, strict=True)
    ]
    if not all(np.isfinite(part).all() for part in seen):
        raise GeometryError(f"normal images: {first} or {second} looks along the base, or behind it")
    low, high = (np.array([edge(part, axis=0) for part in seen]) for edge in (np.min, np.max))
    size = np.ceil([(high - low)[:, 0].max(), high[:, 1].max() - low[:, 1].min()]).astype(int) + 1
    area = max(float(np.prod(camera.size_px)) for camera in cameras)
    if size[0] * size[1] > MAX_LARGER * area:
        raise GeometryError(
            f"normal images: {size[0]} x {size[1]} px for {first} and {second}, at most {MAX_LARGER:g} "
            "times the area of the photographs is allowed; the base is nearly along the rays"
        )
    normal = []
    for k in range(2):
        x0 = 0.5 - low[k, 0] - size[0] / 2  # the leftmost point of each image is in column 0
        y0 = size[1] / 2 - 0.5 + low[:, 1].min()  # and the highest point of both in row 0
        normal.append(
            camera_from_values(
                f"{names[k]}, normal",
                "brown",
                (int(size[0]), int(size[1])),
                (1.0, 1.0),
                c_mm=c_px,
                values=(("x0", x0), ("y0", y0)),
            )
        )
    return NormalImages(names, (normal[0], normal[1]), position, R, source)


def _project_rays(
    camera: Camera, rotation: FloatArray, source: Camera, source_rotation: FloatArray, xy: FloatArray
) -> FloatArray:
    """Project the rays of one camera into another with the same centre, px, (k, 2); NaN behind it."""
    ray = ray_directions(tangents_from_pixel(source, xy), source_rotation)
    return project(camera, np.zeros(3), rotation, ray)
