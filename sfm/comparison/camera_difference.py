"""Difference of two calibrated cameras, in px over the format, after the rotation that it implies.

Two calibrations of one camera differ in parameters that compensate one another, and in the rotation that the
exterior orientations of their photographs took up. What a user sees is where the same direction is imaged.
For pixels q of camera a, their rays, at a distance d or at infinity, are turned (and at a distance shifted)
into camera b and imaged there:

    difference(q) = pixel_b(R ray_a(q) + t) - q

R and t minimise the sum of squares of the differences over the region in which both cameras are known: the
hull of their image points, or all of the format where these are unknown. All points are at one distance, so
that t is proportional to it, and the differences are the same at any. The covariance of the differences
follows from those of the parameters of both cameras, with what R and t absorb removed.

Whether the cameras differ is decided by the RMS over the region. Without a difference its square is a sum of
chi-square variables, weighted by the eigenvalues of the covariance of all differences.

Source: mrcal 2.5, "Differences" (the implied transformation); Satterthwaite (1946), An approximate
distribution of estimates of variance components, Biometrics Bulletin 2(6), for the sum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from sfm.adjustment.quality.correlations import observed_part
from sfm.model.arguments import checked_arguments
from sfm.model.camera import Camera, parameter_jacobian, pixel_from_rays, ray_jacobian, rays_from_pixel
from sfm.model.conventions import BoolArray, FloatArray, rotation_from_vector, skew
from sfm.model.display import html_table, text_table
from sfm.model.distributions import LEVEL, chi2_sf
from sfm.model.errors import GeometryError

STEPS = 36  # of the grid along the longer side
ROUNDS = 20  # of the rotation and translation; after five they change no more
CONVERGED = 1e-12  # rad, and distances


@dataclass(frozen=True, repr=False)
class CameraDifference:
    """Differences b - a of two cameras over the format of a, after the implied transformation."""

    names: tuple[str, str]
    size_px: tuple[int, int]  # of the photographs
    x: FloatArray  # columns of the grid, px, (c,)
    y: FloatArray  # rows of the grid, px, (r,)
    difference: FloatArray  # px, NaN where a ray has no pixel, (r, c, 2)
    covariance: FloatArray  # of the differences, px^2; NaN where neither camera has one, (r, c, 2, 2)
    known: BoolArray  # the region in which both cameras are known, (r, c)
    has_sigma: tuple[bool, bool]  # whether the covariance of a and of b is known
    distance: float  # of the points whose images are compared; infinite for directions
    rotation: FloatArray  # rotation vector from a to b, axes x right, y up, z back, rad, (3,)
    translation: FloatArray  # from a to b, in the unit of the distance; 0 at infinity, (3,)
    p_value: float  # probability of so large an RMS without a difference; NaN without covariances
    independent: bool = True  # whether the cameras come from separate calibrations, as the test requires

    @property
    def length_px(self) -> FloatArray:
        """Lengths of the differences, px, (r, c)."""
        return np.asarray(np.hypot(self.difference[..., 0], self.difference[..., 1]))

    @property
    def sigma_px(self) -> FloatArray:
        """Standard deviations of the differences along their directions, px, (r, c)."""
        along = self.difference / np.where(self.length_px > 0, self.length_px, np.nan)[..., None]
        return np.asarray(np.sqrt(np.einsum("rca,rcab,rcb->rc", along, self.covariance, along)))

    @property
    def rms_px(self) -> float:
        """Root mean square length of the differences in the known region, px."""
        return float(np.sqrt(np.mean(self.length_px[self.known] ** 2)))

    @property
    def expected_rms_px(self) -> float:
        """What chance alone gives for the RMS, from both covariances, px; NaN without them."""
        return float(np.sqrt(np.mean(np.einsum("rcii->rc", self.covariance)[self.known])))

    @property
    def largest(self) -> tuple[int, int]:
        """Row and column, in the grid, of the largest difference in the known region."""
        length = np.where(self.known, self.length_px, -1.0)
        row, column = np.unravel_index(int(np.argmax(length)), length.shape)
        return int(row), int(column)

    @property
    def largest_px(self) -> float:
        """The largest difference in the known region, px."""
        return float(self.length_px[self.largest])

    @property
    def over_sigma(self) -> float:
        """RMS of the differences over what chance alone gives; NaN without covariances."""
        expected = self.expected_rms_px
        return self.rms_px / expected if expected > 0 else float("nan")

    @property
    def significant(self) -> bool | None:
        """Whether the cameras differ by more than chance; None if that is not known.

        Without covariances it is not, nor where calibrations that are not separate differ by little: what
        they have in common makes their difference smaller than the covariances let expect.
        """
        if np.isnan(self.p_value) or (self.p_value >= LEVEL and not self.independent):
            return None
        return bool(self.p_value < LEVEL)

    def _rows(self) -> list[tuple[str, str]]:
        over = "not known" if np.isnan(self.over_sigma) else f"{self.over_sigma:.3g}"
        return [
            ("difference", f"{self.rms_px:.3g} px RMS, {self.largest_px:.3g} px at most"),
            ("over its standard deviation", over),
            ("implied rotation", f"{np.degrees(np.linalg.norm(self.rotation)):.3g} deg"),
        ]

    def __repr__(self) -> str:
        return text_table(f"Difference of {' and '.join(self.names)}", ("", ""), self._rows())

    def _repr_html_(self) -> str:
        return html_table(f"Difference of {' and '.join(self.names)}", ("", ""), self._rows())


@checked_arguments()
def compare_cameras(
    a: Camera,
    b: Camera,
    *,
    covariance: tuple[FloatArray | None, FloatArray | None] = (None, None),
    seen_px: tuple[FloatArray | None, FloatArray | None] = (None, None),
    distance: float = np.inf,
    independent: bool = True,
) -> CameraDifference:
    """Return the difference of two cameras in px over their format.

    Args:
        a: first camera.
        b: second camera, with photographs of the same size.
        covariance: of all parameters of a and of b, in their units, (p, p) each; None if unknown, which
            treats the camera as free of error.
        seen_px: image points of the calibrations of a and of b, px, (k, 2) each, whose hulls are the known
            region; None for the whole photograph.
        distance: of the points whose images are compared, along their rays; a shift of the projection centre
            is then implied too, and is all that depends on the distance. Infinite: directions.
        independent: whether the cameras come from separate calibrations; otherwise their correlation is left
            out, and the result says so.

    Raises:
        GeometryError: photographs of other sizes, a distance that is not positive, or cameras with fewer than
            four known places in common.

    Example:
        >>> import sfm
        >>> a = sfm.camera_from_values("a", "brown", (600, 400), (0.01, 0.01), c_mm=6.0)
        >>> b = a.with_parameters(a.parameters + (0, 0, 0, 1e-4, 0, 0, 0, 0, 0, 0))
        >>> 0.1 < compare_cameras(a, b).largest_px < 1.0
        True
    """
    if a.size_px != b.size_px:
        raise GeometryError(
            f"cameras {a.name} and {b.name}: photographs of {a.size_px[0]} x {a.size_px[1]} px and of "
            f"{b.size_px[0]} x {b.size_px[1]} px, needed the same size"
        )
    if not distance > 0:
        raise GeometryError(f"cameras {a.name} and {b.name}: distance {distance:g}, it must be positive")
    width, height = a.size_px
    step = max(width, height) / STEPS
    x = np.linspace(0, width - 1, max(2, round(width / step) + 1))
    y = np.linspace(0, height - 1, max(2, round(height / step) + 1))
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    rays = _points(a, grid)
    fits = np.isfinite(rays).all(axis=1) & np.isfinite(pixel_from_rays(b, rays)).all(axis=1)
    known: BoolArray = np.array(fits)
    for seen in seen_px:
        if seen is not None and len(seen):
            known = np.asarray(known & observed_part(seen, grid)[1])
    if known.sum() < 4:
        raise GeometryError(
            f"cameras {a.name} and {b.name}: {known.sum()} of {len(grid)} places of the photograph are known "
            "to both, needed at least 4"
        )
    shifts = 0 if np.isinf(distance) else 3
    R, t = _implied(b, rays, grid, known, shifts)
    points = rays @ R.T + t
    difference = pixel_from_rays(b, points) - grid
    difference[~fits] = np.nan
    known = np.asarray(known & np.isfinite(difference).all(axis=1))
    C, p_value = np.full((len(grid), 2, 2), np.nan), float("nan")
    sigmas = []
    if covariance[0] is not None:  # a pixel of a keeps its place, so that its ray moves the other way
        pairs = [(_points(a, grid + off), _points(a, grid - off)) for off in np.eye(2)]  # over two pixels
        rays_by_pixel = np.stack([(after - before) / 2 for after, before in pairs], axis=-1)
        by_pixel = ray_jacobian(b, pixel_from_rays(b, points), points) @ R @ rays_by_pixel
        sigmas.append(-by_pixel @ _moved_by_sigma(a, rays, covariance[0]))
    if covariance[1] is not None:
        sigmas.append(_moved_by_sigma(b, points, covariance[1]))
    if any(columns.shape[2] for columns in sigmas):
        both = np.concatenate(sigmas, axis=2)
        # without what a rotation and shift, fitted where the difference is known, take up
        lever = _lever(b, points, shifts)
        sound = known & np.isfinite(lever).all(axis=(1, 2)) & np.isfinite(both).all(axis=(1, 2))
        A, by_sigma = lever[sound].reshape(-1, lever.shape[2]), both[sound].reshape(-1, both.shape[2])
        free = both - lever @ np.linalg.lstsq(A, by_sigma, rcond=None)[0]
        C = free @ np.swapaxes(free, 1, 2)
        known = np.asarray(known & np.isfinite(free).all(axis=(1, 2)))  # not at the end of a model's range
        p_value = _probability(float((difference[known] ** 2).sum()), free[known])
    shape = (len(y), len(x))
    return CameraDifference(
        (a.name, b.name),
        a.size_px,
        x,
        y,
        difference.reshape(*shape, 2),
        C.reshape(*shape, 2, 2),
        known.reshape(shape),
        (covariance[0] is not None, covariance[1] is not None),
        float(distance),
        np.asarray(Rotation.from_matrix(R).as_rotvec()),
        distance * t if shifts else t,
        p_value,
        independent,
    )


def _implied(
    b: Camera, points: FloatArray, xy: FloatArray, known: BoolArray, shifts: int
) -> tuple[FloatArray, FloatArray]:
    """Return the transformation into b with the smallest differences.

    Args:
        b: the second camera.
        points: at distance 1 in the axes of the first camera, (k, 3).
        xy: their pixels there, px, (k, 2).
        known: which pixels count, (k,).
        shifts: 3 if a translation is implied too, otherwise 0.

    Returns:
        Rotation matrix (3, 3) and translation, in distances, (3,).
    """
    R, t = np.eye(3), np.zeros(3)
    for _ in range(ROUNDS):
        at = (points @ R.T + t)[known]
        lever, off = _lever(b, at, shifts), pixel_from_rays(b, at) - xy[known]
        sound = np.isfinite(lever).all(axis=(1, 2)) & np.isfinite(off).all(axis=1)
        A, rest = lever[sound].reshape(-1, 3 + shifts), -off[sound].ravel()
        step = np.asarray(np.linalg.lstsq(A, rest, rcond=None)[0], dtype=float)
        turn = rotation_from_vector(step[:3])
        R, t = turn @ R, turn @ t + (step[3:] if shifts else 0.0)
        if np.abs(step).max() < CONVERGED:
            break
    return R, t


def _points(camera: Camera, xy: FloatArray) -> FloatArray:
    """Return the points at distance 1 on the rays of pixels, in camera axes, (k, 3)."""
    rays = rays_from_pixel(camera, xy)
    return np.asarray(rays / np.linalg.norm(rays, axis=1)[:, None])


def _lever(b: Camera, points: FloatArray, shifts: int) -> FloatArray:
    """Return the derivatives of the pixels of points by a rotation and a shift, px, (k, 2, 3 + shifts).

    Args:
        b: the camera.
        points: in its axes, (k, 3).
        shifts: 3 for the derivatives by a shift too, otherwise 0.
    """
    pixels = pixel_from_rays(b, points)
    known = np.isfinite(pixels).all(axis=1)
    by_point = np.full((len(points), 2, 3), np.nan)
    by_point[known] = ray_jacobian(b, pixels[known], points[known])
    columns = [by_point @ -skew(points)] + ([by_point] if shifts else [])  # w x point
    return np.concatenate(columns, axis=2)


def _moved_by_sigma(camera: Camera, rays: FloatArray, Q: FloatArray) -> FloatArray:
    """Return how independent unit variables of a camera move the pixels of rays, px, (k, 2, n).

    These are variables whose covariance is the identity, so that the sum of the outer products of the columns
    is the covariance of the pixels.

    Args:
        camera: the camera.
        rays: directions in its axes, (k, 3).
        Q: covariance of its parameters, (p, p).
    """
    n = len(camera.parameters)
    if Q.shape != (n, n) or not np.isfinite(Q).all():
        raise GeometryError(f"camera {camera.name}: a covariance of shape {Q.shape}, needed {n} x {n}")
    sigma = np.sqrt(np.maximum(np.diagonal(Q), 0.0))
    free = np.flatnonzero(sigma > 0)
    if not len(free):
        return np.zeros((len(rays), 2, 0))
    values, vectors = np.linalg.eigh(Q[np.ix_(free, free)] / np.outer(sigma[free], sigma[free]))
    root = sigma[free][:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(parameter_jacobian(camera, rays)[:, :, free] @ root)


def _probability(square_sum: float, moved: FloatArray) -> float:
    """Return the probability of a larger sum of squares of differences that have only chance in them.

    Args:
        square_sum: of the differences, px^2.
        moved: how independent unit variables move them, px, (k, 2, n).
    """
    columns = moved.reshape(-1, moved.shape[2])
    variances = np.linalg.eigvalsh(columns.T @ columns)
    total, squares = float(variances.sum()), float((variances**2).sum())
    if not total > 0:
        return 0.0 if square_sum > 0 else 1.0
    return float(chi2_sf(square_sum * total / squares, total**2 / squares))
