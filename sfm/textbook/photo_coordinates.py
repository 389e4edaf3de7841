"""Photo coordinates: fiducial marks, corrections and their inverses, simulation.

The corrections lead from the measured point to the collinearity equations. They are applied one after the
other: principal point, radial distortion, decentring, refraction, earth curvature. Each is reversed by
fixed-point iteration.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from sfm.model.arguments import checked_arguments
from sfm.model.conventions import FloatArray
from sfm.model.display import counted
from sfm.model.errors import GeometryError
from sfm.orientation.resection.least_squares import tangents_of

SIMILARITY, AFFINE = "similarity", "affine"
FEWEST = {SIMILARITY: 2, AFFINE: 3}
MIN_SINGULAR_RATIO = 1e-9  # second singular value over the first
EARTH_RADIUS_KM = 6372.2  # radius of the sphere in document 004
INVERSE_STEPS = 100
INVERSE_TOLERANCE_MM = 1e-13


@dataclass(frozen=True)
class RadialTable:
    """Radial distortion from a calibration certificate."""

    radius_mm: FloatArray  # ascending, from 0, (k,)
    distortion_mm: FloatArray  # dr at these radii, positive outwards, (k,)


@dataclass(frozen=True)
class PhotoCorrections:
    """The corrections to apply; a correction left at its default is switched off."""

    principal_point_mm: FloatArray = field(default_factory=lambda: np.zeros(2))  # x0, y0, (2,)
    radial_table: RadialTable | None = None  # subtracted: the measured point is displaced outwards
    radial: FloatArray = field(default_factory=lambda: np.zeros(3))  # K1, K2, K3 as in `brown` (added), (3,)
    decentring: FloatArray = field(default_factory=lambda: np.zeros(2))  # P1, P2 as in `brown` (added), (2,)
    flying_height_km: float | None = None  # H of the projection centre above sea level; corrects refraction
    terrain_height_km: float = 0.0  # h of the terrain above sea level
    curvature_height_km: float | None = None  # H above ground; corrects earth curvature


@checked_arguments(xy_mm="... 2")
def correct_photo_coordinates(xy_mm: FloatArray, corrections: PhotoCorrections, *, c_mm: float) -> FloatArray:
    """Correct measured photo coordinates so that the collinearity equations apply.

    Args:
        xy_mm: measured photo coordinates (y up), shape (n, 2), mm.
        corrections: corrections to apply.
        c_mm: principal distance, mm.

    Returns:
        Corrected photo coordinates from the principal point, shape (n, 2), mm.

    Raises:
        GeometryError: a point is beyond the distortion table, or the photograph is below the terrain.

    Source: document 004, "Corrections of photo coordinates": principal point, radial distortion, refraction,
    earth curvature; decentring after the radial part, as in Brown (1971).
    """
    xy = np.asarray(xy_mm, dtype=float) - corrections.principal_point_mm
    for step in _steps(corrections, c_mm):
        xy = step(xy)
    return xy


@checked_arguments(xy_mm="... 2")
def distort_photo_coordinates(xy_mm: FloatArray, corrections: PhotoCorrections, *, c_mm: float) -> FloatArray:
    """Compute measured photo coordinates from ideal ones; the inverse of `correct_photo_coordinates`.

    Args:
        xy_mm: ideal photo coordinates (y up) from the principal point, shape (n, 2), mm.
        corrections: effects present in the photograph.
        c_mm: principal distance, mm.

    Returns:
        Measured photo coordinates, shape (n, 2), mm.

    Raises:
        GeometryError: `correct_photo_coordinates` fails, or a correction is too strong to invert.

    Source: document 004; each correction is inverted by fixed-point iteration, the last one first.
    """
    xy = np.asarray(xy_mm, dtype=float)
    for step in reversed(_steps(corrections, c_mm)):
        target = xy
        for _ in range(INVERSE_STEPS):  # corrections are small compared with coordinates
            miss = target - step(xy)
            xy = xy + miss
            if np.nanmax(np.abs(miss), initial=0.0) < INVERSE_TOLERANCE_MM:
                break
        else:
            raise GeometryError("photo coordinates: a correction is too strong to be inverted")
    return xy + corrections.principal_point_mm


@checked_arguments(points="n 3", position="3", rotation="3 3")
def compute_photo_coordinates(
    points: FloatArray,
    position: FloatArray,
    rotation: FloatArray,
    *,
    c_mm: float,
    corrections: PhotoCorrections | None = None,
) -> FloatArray:
    """Simulate the measured photo coordinates of object points.

    Args:
        points: object points, shape (n, 3), object unit.
        position: projection centre X0, shape (3,), object unit.
        rotation: R, image to object axes, shape (3, 3).
        c_mm: principal distance, mm.
        corrections: effects present in the photograph; none if not given.

    Returns:
        Photo coordinates (y up), shape (n, 2), mm; NaN for points behind the camera.

    Source: document 004, computation of photo coordinates: collinearity, then the inverse corrections.
    """
    ideal = c_mm * tangents_of(position, rotation, points)
    return distort_photo_coordinates(ideal, corrections or PhotoCorrections(), c_mm=c_mm)


@checked_arguments(pixel="... 2", pixel_mm="2")
def photo_from_pixel(
    pixel: FloatArray, size_px: tuple[int, int], pixel_mm: FloatArray, *, rows: str = "down"
) -> FloatArray:
    """Convert pixel coordinates (column, row) to photo coordinates (origin at the sensor centre, y up).

    Args:
        pixel: column and row from the centre of the first pixel, shape (n, 2), px.
        size_px: number of columns and rows of the photograph.
        pixel_mm: width and height of a pixel, shape (2,), mm.
        rows: direction in which rows count, "down" as in eqs. 2.3-2.4 of document 002, "up" as in its table
            of points.

    Returns:
        Photo coordinates, shape (n, 2), mm.

    Raises:
        GeometryError: rows is neither "down" nor "up".

    Source: document 002, eqs. 2.3-2.4.
    """
    centre = np.array(size_px) / 2 - 0.5
    return (np.asarray(pixel, dtype=float) - centre) * np.asarray(pixel_mm) * (1.0, _sign(rows))


@checked_arguments(photo_mm="... 2", pixel_mm="2")
def pixel_from_photo(
    photo_mm: FloatArray, size_px: tuple[int, int], pixel_mm: FloatArray, *, rows: str = "down"
) -> FloatArray:
    """Convert photo coordinates to pixel coordinates; the inverse of `photo_from_pixel`.

    Args:
        photo_mm: photo coordinates (origin at the sensor centre, y up), shape (n, 2), mm.
        size_px: number of columns and rows of the photograph.
        pixel_mm: width and height of a pixel, shape (2,), mm.
        rows: direction in which rows count, "down" or "up", as in `photo_from_pixel`.

    Returns:
        Column and row from the centre of the first pixel, shape (n, 2), px.

    Raises:
        GeometryError: rows is neither "down" nor "up".

    Source: document 002, eq. 2.5.
    """
    centre = np.array(size_px) / 2 - 0.5
    return np.asarray(photo_mm, dtype=float) / (np.asarray(pixel_mm) * (1.0, _sign(rows))) + centre


@checked_arguments()
def radial_from_table(table: RadialTable, radius_mm: FloatArray) -> FloatArray:
    """Interpolate the distortion dr at given radii linearly in the table of a calibration certificate.

    Args:
        table: radii and distortions of the certificate.
        radius_mm: distances from the principal point, any shape, mm.

    Returns:
        dr, positive outwards, same shape, mm.

    Raises:
        GeometryError: the radii of the table do not ascend from 0, or a radius is beyond its end.

    Source: document 004, radial distortion from a table.
    """
    r, dr = np.asarray(table.radius_mm, dtype=float), np.asarray(table.distortion_mm, dtype=float)
    if len(r) < 2 or len(r) != len(dr) or r[0] != 0 or (np.diff(r) <= 0).any():
        raise GeometryError("radial distortion: the radii of the table must ascend from 0, one value at each")
    if np.nanmax(radius_mm, initial=0.0) > r[-1]:
        raise GeometryError(
            f"radial distortion: a point at {np.nanmax(radius_mm):.3f} mm, the table ends at {r[-1]:.3f} mm"
        )
    return np.asarray(np.interp(radius_mm, r, dr))


@checked_arguments()
def refraction_coefficient(flying_height_km: float, terrain_height_km: float) -> float:
    """Return K of the refraction dr = K (r + r^3 / c^2), dimensionless.

    Args:
        flying_height_km: height H of the projection centre above sea level, km.
        terrain_height_km: height h of the terrain above sea level, km.

    Source: document 004 (US Air Force model of the atmosphere): K = (2410 H / (H^2 - 6 H + 250)
    - 2410 h^2 / ((h^2 - 6 h + 250) H)) 1e-6 with H and h in km.

    Raises:
        GeometryError: the photograph is not above the terrain.
    """
    H, h = flying_height_km, terrain_height_km
    if not (max(h, 0.0) < H < np.inf):
        raise GeometryError(f"refraction: flying height {H:g} km, it must be above the terrain at {h:g} km")
    return (2410 * H / (H**2 - 6 * H + 250) - 2410 * h**2 / ((h**2 - 6 * h + 250) * H)) * 1e-6


@checked_arguments()
def curvature_displacement(radius_mm: FloatArray, *, height_km: float, c_mm: float) -> FloatArray:
    """Return the displacement by earth curvature towards the centre, same shape as the radii, mm.

    Args:
        radius_mm: distances from the principal point, any shape, mm.
        height_km: height H of the projection centre above ground, km.
        c_mm: principal distance, mm.

    Source: document 004: dr = H r^3 / (2 R c^2), R = 6372.2 km.
    """
    return np.asarray(height_km * np.asarray(radius_mm) ** 3 / (2 * EARTH_RADIUS_KM * c_mm**2))


def _steps(corrections: PhotoCorrections, c: float) -> list[Callable[[FloatArray], FloatArray]]:
    """Return the corrections that are switched on, in order."""
    steps: list[Callable[[FloatArray], FloatArray]] = []
    table = corrections.radial_table
    if table is not None:
        steps.append(lambda xy: _move_radially(xy, lambda r: -radial_from_table(table, r)))
    if np.any(corrections.radial):
        K = corrections.radial
        steps.append(lambda xy: _move_radially(xy, lambda r: r**3 * (K[0] + r**2 * (K[1] + r**2 * K[2]))))
    if np.any(corrections.decentring):
        P1, P2 = corrections.decentring
        steps.append(lambda xy: xy + _decentring(xy, P1, P2))
    if corrections.flying_height_km is not None:
        K_air = refraction_coefficient(corrections.flying_height_km, corrections.terrain_height_km)
        # refraction displaces points outwards
        steps.append(lambda xy: _move_radially(xy, lambda r: -K_air * (r + r**3 / c**2)))
    if corrections.curvature_height_km is not None:
        H = corrections.curvature_height_km
        # earth curvature displaces points inwards from their image on the tangential plane
        steps.append(lambda xy: _move_radially(xy, lambda r: curvature_displacement(r, height_km=H, c_mm=c)))
    return steps


def _move_radially(xy: FloatArray, displacement: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Move points outwards by a displacement that depends on their radius."""
    r = np.hypot(xy[..., 0], xy[..., 1])
    factor = displacement(r) / np.where(r > 0, r, 1.0)
    return xy * (1 + factor)[..., None]


def _decentring(xy: FloatArray, P1: float, P2: float) -> FloatArray:
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    return np.stack([P1 * (r2 + 2 * x * x) + 2 * P2 * x * y, P2 * (r2 + 2 * y * y) + 2 * P1 * x * y], axis=-1)


def _sign(rows: str) -> float:
    if rows not in ("down", "up"):
        raise GeometryError(f"pixel coordinates: rows '{rows}', expected one of down, up")
    return -1.0 if rows == "down" else 1.0


@dataclass(frozen=True)
class FiducialTransformation:
    """The transformation photo = matrix @ measured + shift, with its precision from the fiducial marks."""

    kind: str  # similarity (4 parameters) | affine (6 parameters)
    matrix: FloatArray  # [[a11, a12], [a21, a22]], mm per comparator unit, (2, 2)
    shift: FloatArray  # mm, (2,)
    residuals: FloatArray  # v = computed - calibrated coordinates of the marks, mm, (n, 2)
    sigma0: float  # a posteriori standard deviation of a mark coordinate, mm; NaN without redundancy
    redundancy: int  # 2 n - 4 or 2 n - 6
    covariance: FloatArray  # order (a, b, tx, ty) or (a11, a12, tx, a21, a22, ty), (4, 4) or (6, 6)

    def apply(self, measured: FloatArray) -> FloatArray:
        """Transform measured coordinates to photo coordinates, mm, shape (..., 2)."""
        return np.asarray(measured, dtype=float) @ self.matrix.T + self.shift

    def invert(self, photo: FloatArray) -> FloatArray:
        """Transform photo coordinates to measured coordinates, comparator unit, shape (..., 2)."""
        return np.asarray((np.asarray(photo, dtype=float) - self.shift) @ np.linalg.inv(self.matrix).T)

    @property
    def scales(self) -> FloatArray:
        """Scale along the two measured axes, mm per comparator unit, (2,)."""
        return np.asarray(np.linalg.norm(self.matrix, axis=0))

    @property
    def rotation(self) -> float:
        """Angle alpha from the measured x axis to the photo x axis, rad."""
        return float(np.arctan2(self.matrix[1, 0], self.matrix[0, 0]))

    @property
    def shear(self) -> float:
        """Deviation epsilon of the measured axes from a right angle, rad; 0 for a similarity."""
        return float(np.arctan2(-self.matrix[0, 1], self.matrix[1, 1])) - self.rotation


@checked_arguments(measured="k 2", calibrated="n 2")
def orient_fiducials(
    measured: FloatArray, calibrated: FloatArray, *, kind: str = AFFINE
) -> FiducialTransformation:
    """Return the transformation from measured fiducial marks to their calibrated coordinates.

    Args:
        measured: comparator or pixel coordinates, shape (n, 2). Pixel coordinates (y down) need the affine
            transformation, because a similarity cannot reverse the y axis.
        calibrated: photo coordinates of the marks from the calibration certificate, shape (n, 2), mm.
        kind: similarity (x = a xm - b ym + tx, y = b xm + a ym + ty; 4 parameters) or affine (6 parameters).

    Returns:
        The transformation, with residuals (mm) and the covariance of its parameters.

    Raises:
        GeometryError: the kind is unknown, there are too few marks, or they do not determine it.

    Source: document 004, eqs. 1.2-1.9; Kraus (2007), sec. 3.2.1.
    """
    if kind not in FEWEST:
        raise GeometryError(f"fiducial marks: kind '{kind}', expected one of {', '.join(FEWEST)}")
    m = np.asarray(measured, dtype=float).reshape(-1, 2)
    f = np.asarray(calibrated, dtype=float).reshape(-1, 2)
    n = len(m)
    if n < FEWEST[kind] or len(f) != n:
        raise GeometryError(
            f"fiducial marks: {counted(min(n, len(f)), 'mark')}, {kind} needs at least {FEWEST[kind]} in "
            "both systems"
        )
    centre = m.mean(axis=0)
    spread = np.linalg.svd(m - centre, compute_uv=False)
    if spread[0] == 0 or (kind == AFFINE and spread[1] <= MIN_SINGULAR_RATIO * spread[0]):
        raise GeometryError("fiducial marks: the marks coincide or lie on one line")
    x, y = (m - centre).T
    ones, zeros = np.ones(n), np.zeros(n)
    if kind == SIMILARITY:
        # unknowns a, b, tx, ty: xf = a x - b y + tx, yf = b x + a y + ty
        A = np.concatenate([np.stack([x, -y, ones, zeros], axis=1), np.stack([y, x, zeros, ones], axis=1)])
    else:
        # unknowns a11, a12, tx, a21, a22, ty
        A = np.concatenate(
            [
                np.stack([x, y, ones, zeros, zeros, zeros], axis=1),
                np.stack([zeros, zeros, zeros, x, y, ones], axis=1),
            ]
        )
    l = np.concatenate([f[:, 0], f[:, 1]])
    p = np.linalg.lstsq(A, l, rcond=None)[0]
    v = (A @ p - l).reshape(2, n).T
    redundancy = 2 * n - A.shape[1]
    sigma0 = float(np.sqrt(np.sum(v**2) / redundancy)) if redundancy > 0 else np.nan
    if kind == SIMILARITY:
        matrix, shift = np.array([[p[0], -p[1]], [p[1], p[0]]]), p[2:]
        J = np.eye(4)  # moves the shift from the centre of the marks to the origin
        J[2, :2] = -centre[0], centre[1]
        J[3, :2] = -centre[1], -centre[0]
    else:
        matrix, shift = np.array([[p[0], p[1]], [p[3], p[4]]]), p[[2, 5]]
        J = np.eye(6)
        J[2, :2] = J[5, 3:5] = -centre
    covariance = sigma0**2 * J @ np.linalg.inv(A.T @ A) @ J.T
    return FiducialTransformation(
        kind, matrix, shift - matrix @ centre, v, sigma0, redundancy, np.asarray(covariance)
    )
