"""Correlations of camera parameters and of neighbouring image points; projection uncertainty.

**Camera and orientation.** In a flat network with parallel views, c is strongly correlated with Z0, and x0
and y0 with X0, Y0 or the angles. Both then have large standard deviations, while distances between points may
be precise.

**Neighbouring image points.** Their errors agree if the lens breathes, the shutter rolls, or the surface is
curved inside the matching windows. Sums of residuals over cells of a photograph, from single image points to
half of it, show that. Their squares grow with the number of image points for independent errors, and with its
square for common errors. Object points, orientations and cameras absorb a part of both, mostly of long waves.
Simulation shows how much remains: random fields of known correlation length pass through the linearised
adjustment. A field moves precise and imprecise image points by the same number of px.

**Several sources.** Thousands of image points with errors in common tell little more of orientations and
cameras than a few. Beside a source with independent errors, they would outvote it. Their design effect is the
variance of what they tell of these unknowns, over that of independent errors of the same size. Divided by it,
their weights are those of as many independent observations as they are worth.

**Projection uncertainty.** It states how well a calibrated camera determines where a direction appears in the
photograph. Errors of the interior orientation move the image of a distant point. The part that equals a
rotation of the camera does not count, because every use of the camera determines the rotation again. It is
removed by the small rotation that fits best at the image points of the calibration. Among these the camera is
known; outside them the uncertainty grows.

Source: Luhmann et al., Close-Range Photogrammetry (2020), sec. 7.3.2 (correlations in self-calibration);
Fraser (1997), ISPRS J. Photogramm. Remote Sens. 52(4); variance components by quadratic forms and their
expectations, Koch (1999), sec. 3.6; nested cells, Webster and Oliver (2007), Geostatistics for Environmental
Scientists, sec. 6.3; random fields of a given covariance, Rahimi and Recht (2007), Adv. Neural Inf. Process.
Syst. 20; design effect, Kish (1965), Survey Sampling, sec. 8.2, and Rao and Scott (1984), Ann. Statist. 12;
law of propagation of variances; Kogan, mrcal, "Projection uncertainty".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import ConvexHull, QhullError

from sfm.adjustment.covariance import Marginal, marginal_of, with_error_correlation
from sfm.adjustment.engine.correlated import Linearised, linearise
from sfm.adjustment.engine.unknowns import interior_names
from sfm.adjustment.quality.statistics import MIN_REPORTED_CORRELATION
from sfm.adjustment.result import Adjustment, ErrorCorrelation
from sfm.model.arguments import checked_arguments
from sfm.model.camera import Camera, pixel_from_rays, ray_jacobian, rays_from_pixel, within_reach
from sfm.model.conventions import BoolArray, FloatArray, IntArray, skew
from sfm.model.display import counted
from sfm.model.network import rows_of
from sfm.model.observations.pose import exterior_jacobian
from sfm.runtime.threads import own_threads

CELLS = 24  # grid cells along the longer side of the photograph
HALVINGS = 7  # halvings of the longer side down to the smallest cells and shortest correlation
# Random fields of each length. Together they have at least so many photographs, as mean squares of few
# have much noise; 60 photographs and fewer have the largest number of fields.
FIELDS_OF_PHOTOGRAPHS, MOST_DRAWS = 960, 16
WAVES = 64  # waves in the field of one photograph
ROUNDS = 5  # rounds of weighting by the expectations; the second round hardly changes them
PARTS = ("X0", "Y0", "Z0", "omega", "phi", "kappa")


@dataclass(frozen=True)
class OrientationCorrelation:
    """A camera parameter that is strongly correlated with the exterior orientation of photographs."""

    parameter: str  # the parameter and its camera, in words
    largest: float  # largest correlation, -1 to 1
    part: str  # element of exterior orientation of this correlation: X0, Y0, Z0, omega, phi or kappa
    image: str  # photograph of this correlation
    counts: tuple[tuple[str, int], ...]  # elements beyond the limit, with the number of photographs

    @property
    def partners(self) -> str:
        """All elements of exterior orientation with a strong correlation, in words."""
        return ", ".join(f"{part} of {counted(n, 'photograph')}" for part, n in self.counts)


@dataclass(frozen=True)
class ExteriorCorrelations:
    """Correlations of all adjusted camera parameters with the exterior orientation of every photograph."""

    parameters: tuple[tuple[str, str], ...]  # name and camera of each interior unknown, in words, (i,)
    images: tuple[str, ...]  # photographs, (m,)
    rho: FloatArray  # correlation with X0, Y0, Z0, omega, phi, kappa; 0 if one was held fixed, (m, 6, i)


def exterior_correlations(adjustment: Adjustment) -> ExteriorCorrelations:
    """Return the correlations of camera parameters with exterior orientation, in the datum of an adjustment.

    Args:
        adjustment: finished adjustment with its covariance.

    Raises:
        GeometryError: its normal equations cannot be solved.
    """
    with own_threads():
        names, rho = _correlations(adjustment)
    return ExteriorCorrelations(tuple(names), adjustment.network.images, rho)


def orientation_correlations(
    adjustment: Adjustment, *, limit: float = MIN_REPORTED_CORRELATION
) -> tuple[OrientationCorrelation, ...]:
    """Return the camera parameters correlated with exterior orientation beyond a limit, strongest first.

    Args:
        adjustment: finished adjustment with its covariance; the correlations are in its datum.
        limit: absolute correlation above which a parameter is reported.

    Raises:
        GeometryError: its normal equations cannot be solved.
    """
    return strong_correlations(exterior_correlations(adjustment), limit=limit)


def strong_correlations(
    correlations: ExteriorCorrelations, *, limit: float = MIN_REPORTED_CORRELATION
) -> tuple[OrientationCorrelation, ...]:
    """Return the camera parameters with a correlation beyond a limit, strongest first.

    Args:
        correlations: correlations with the exterior orientation of every photograph.
        limit: absolute correlation above which a parameter is reported.
    """
    if not correlations.rho.size:
        return ()
    images = correlations.images
    reported = []
    for c, (parameter, camera) in enumerate(correlations.parameters):
        size = np.abs(correlations.rho[:, :, c])
        strong = size > limit
        if not strong.any():
            continue
        i, p = np.unravel_index(int(np.argmax(size)), size.shape)
        counts = tuple((part, int(n)) for part, n in zip(PARTS, strong.sum(axis=0), strict=True) if n)
        reported.append(
            OrientationCorrelation(
                f"{parameter} of {camera}", float(correlations.rho[i, p, c]), PARTS[p], images[i], counts
            )
        )
    return tuple(sorted(reported, key=lambda correlation: -abs(correlation.largest)))


def _correlations(adjustment: Adjustment) -> tuple[list[tuple[str, str]], FloatArray]:
    """Return (parameter, camera) of each interior unknown, and its correlations by photograph, (m, 6, i).

    A correlation is 0 if one of the two is fixed or was not adjusted.
    """
    if not any(camera.free.any() for camera in adjustment.estimate.cameras):
        return [], np.zeros((0, 6, 0))
    marginal = marginal_of(adjustment, cross=False)
    layout, optimum, Q = marginal.layout, marginal.optimum, marginal.cofactors
    names = interior_names(layout, adjustment.estimate)
    first, i = layout.pose_free.size, len(names)
    inner = slice(first, first + i)
    H, F, G = optimum.motions.reduced, Q.F_reduced, Q.G
    # S Q S' of the S-transformation, block of exterior x interior unknowns
    of_poses = np.concatenate([Q.mixed[:, :i], Q.border[:, :i]])
    C = of_poses - H @ F[:, inner] - (H[inner] @ F).T + H @ G @ H[inner].T
    columns, J = layout.photograph_terms(optimum.state, np.arange(len(optimum.state.M)))
    C = exterior_jacobian(optimum.state.M) @ J @ C[columns]
    exterior = np.einsum("mpp->mp", adjustment.cofactors.exterior)
    half = H[inner] @ F[:, inner]  # 0 except for null vectors that are not motions of the network
    interior = np.diagonal(Q.border[:i, :i] - half - half.T + H[inner] @ G @ H[inner].T)
    square = exterior[:, :, None] * interior
    known = square > 0
    return names, np.asarray(np.where(known, C / np.sqrt(np.where(known, square, 1.0)), 0.0))


@checked_arguments()
def estimate_error_correlation(adjustment: Adjustment) -> ErrorCorrelation | None:
    """Return the correlation of the errors of neighbouring image points that fits the residuals best.

    The correlation lengths tried are the longer side of the photographs, its half, its quarter, and so on.

    Args:
        adjustment: finished adjustment, with or without its covariance.

    Returns:
        The correlation; None if the errors of neighbours do not agree.
    """
    return _correlation_of(adjustment, *_correlating(adjustment))


def _correlation_of(
    adjustment: Adjustment, m: Marginal, linear: Linearised, used: BoolArray
) -> ErrorCorrelation | None:
    """Return the correlation that fits the residuals best, see `estimate_error_correlation`."""
    from scipy.optimize import nnls  # importing takes half a second, and many commands never need it

    if not used.any():
        return None
    o = m.layout.observations
    size = max(max(camera.size_px) for camera in adjustment.estimate.cameras)
    cells = []  # which image points are in each nonempty cell of the photographs, sparse, (cells, k)
    for n in range(1, HALVINGS + 1):
        place_of_cell = np.floor(o.xy[used] / (size / 2.0**n)).astype(np.int64)
        place_of_cell -= place_of_cell.min(axis=0)
        columns, rows = place_of_cell.max(axis=0) + 1
        number = (o.image[used] * columns + place_of_cell[:, 0]) * rows + place_of_cell[:, 1]
        cell = np.unique(number, return_inverse=True)[1].ravel()
        ones, place = np.ones(len(cell)), (cell, np.flatnonzero(used))
        cells.append(csr_matrix((ones, place), shape=(cell.max() + 1, len(used))))
    v = linear.whitening @ adjustment.residuals[m.layout.order][:, :, None]
    v[~used] = 0.0
    squares = _squares(v, cells)
    count = np.array([used.sum(), *(cell.shape[0] for cell in cells)])
    rng = np.random.default_rng(0)

    def left_of(errors: FloatArray) -> FloatArray:
        """Return the expected squares that errors with unit variance leave in the residuals."""
        errors[~used] = 0.0
        return _squares(linear.residuals(errors.reshape(2 * len(used), -1)), cells)

    relative = adjustment.usual_px * linear.whitening
    draws = _draws(o.image)
    alone = left_of(rng.standard_normal((len(used), 2, draws)))
    best, least = None, np.inf
    for length in size / 2.0 ** np.arange(HALVINGS):
        common = left_of(relative @ _fields(o.image, o.xy, length, draws, rng))
        expected = squares
        for _ in range(ROUNDS):
            sigma = expected / np.sqrt(count)  # for the sum of squares of `count` pairs x, y
            parts, misfit = nnls(np.column_stack([alone, common]) / sigma[:, None], squares / sigma)
            expected = parts[0] * alone + parts[1] * common
        if misfit < least:
            best, least = (parts / adjustment.sigma0**2, length), misfit
    effect = float(1 / o.share[used].min())
    if best is None or (best[0][1] == 0 and effect == 1):
        return None
    (of_each, of_neighbours), length_px = best
    return ErrorCorrelation(float(of_each), float(of_neighbours), float(length_px), effect)


def _correlating(adjustment: Adjustment) -> tuple[Marginal, Linearised, BoolArray]:
    """Return the linearised adjustment, and which image points in its order a correlation is about, (k,)."""
    m = marginal_of(adjustment, cross=False)
    weight = np.ascontiguousarray(adjustment.weights[m.layout.order])
    used = (weight > 0) & adjustment.network.may_correlate[m.layout.order]
    return m, linearise(m.optimum, m.layout, weight), used


@checked_arguments()
def design_effect_of_neighbours(adjustment: Adjustment, *, density: float = 1.0) -> float:
    """Return the factor on the variance of what image points tell of photographs and cameras, at least 1.

    It is due to the correlation of the errors of neighbours that the residuals show.

    Args:
        adjustment: finished adjustment with independent errors.
        density: ratio of the number of image points with errors in common to that in the adjustment, which
            may be a sample.

    Source: Kish (1965), Survey Sampling, sec. 8.2; Rao and Scott (1984), Ann. Statist. 12, for the mean of
    several directions.
    """
    m, linear, used = _correlating(adjustment)
    correlation = _correlation_of(adjustment, m, linear, used)
    if correlation is None:
        return 1.0
    o, rng = m.layout.observations, np.random.default_rng(0)

    def of_shared(errors: FloatArray) -> float:
        """Return the squares of whitened errors that photographs and cameras, not points, absorb."""
        errors[~used] = 0.0
        errors = errors.reshape(2 * len(used), -1)
        moved = errors - linear.B @ (linear.V_inverse @ (linear.B.T @ errors))
        return float((moved**2).sum() - (linear.residuals(errors) ** 2).sum())

    draws = _draws(o.image)
    alone = of_shared(rng.standard_normal((len(used), 2, draws)))
    relative = adjustment.usual_px * linear.whitening
    common = of_shared(relative @ _fields(o.image, o.xy, correlation.length_px, draws, rng))
    return max(correlation.alone + correlation.common * density * common / alone, 1.0) if alone > 0 else 1.0


@checked_arguments()
def with_neighbours(adjustment: Adjustment) -> Adjustment:
    """Return the adjustment with a covariance for the error correlation estimated from its residuals.

    Args:
        adjustment: finished adjustment.
    """
    correlation = estimate_error_correlation(adjustment)
    return adjustment if correlation is None else with_error_correlation(adjustment, correlation)


def _squares(v: FloatArray, cells: list[csr_matrix]) -> FloatArray:
    """Return the sums of squares of residuals, and of their sums over cells of each size, per draw."""
    v = v.reshape(cells[0].shape[1], -1)
    draws = v.shape[1] / 2
    return np.array([float((v**2).sum()), *(float(((cell @ v) ** 2).sum()) for cell in cells)]) / draws


def _draws(image: IntArray) -> int:
    """Return the number of random fields in photographs that have image points, from those of each, (k,)."""
    return min(MOST_DRAWS, -(-FIELDS_OF_PHOTOGRAPHS // len(np.unique(image))))


def _fields(
    image: IntArray, xy: FloatArray, length_px: float, draws: int, rng: np.random.Generator
) -> FloatArray:
    """Return random fields in each photograph with covariance exp(-d / length), (k, 2, draws).

    Wave numbers are drawn from its spectrum, a bivariate Cauchy distribution.
    """
    field = np.empty((len(xy), 2, draws))
    for rows in rows_of(image, int(image.max()) + 1):
        waves = rng.standard_normal((2, WAVES)) / np.abs(rng.standard_normal(WAVES)) / length_px
        phase = xy[rows] @ waves
        amplitude = rng.standard_normal((2, WAVES, 2 * draws)) / np.sqrt(WAVES)
        drawn = np.cos(phase) @ amplitude[0] + np.sin(phase) @ amplitude[1]
        field[rows] = drawn.reshape(len(rows), 2, draws)
    return field


def projection_map(
    camera: Camera, covariance: FloatArray, seen: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the projection uncertainty over the whole photograph.

    Args:
        camera: interior orientation.
        covariance: covariance of its free parameters, (f, f).
        seen: image points of its calibration, px, (k, 2).

    Returns:
        Columns (c,) and rows (r,) of a grid, px, and the root mean square of the standard deviations of both
        coordinates at its nodes, px, (r, c); NaN where the camera model folds over.
    """
    width, height = camera.size_px
    cell = max(width, height) / CELLS
    x = np.linspace(0, width - 1, max(2, round(width / cell) + 1))
    y = np.linspace(0, height - 1, max(2, round(height / cell) + 1))
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    Q = projection_covariance(camera, covariance, seen, grid)
    sigma = np.sqrt(np.einsum("kii->k", Q) / 2)
    return x, y, sigma.reshape(len(y), len(x))


def observed_part(seen: FloatArray, xy: FloatArray) -> tuple[float, BoolArray]:
    """Return the area of the convex hull of image points, px^2, and which positions lie inside.

    Args:
        seen: image points, px, (k, 2).
        xy: positions, px, (n, 2).

    Returns:
        The area, 0 for image points on a line, and whether each position is inside, (n,).
    """
    try:
        hull = ConvexHull(seen)
    except (QhullError, ValueError):  # on a line, or fewer than three
        return 0.0, np.zeros(len(xy), dtype=bool)
    inside = (xy @ hull.equations[:, :2].T + hull.equations[:, 2] <= 0).all(axis=1)
    return float(hull.volume), np.asarray(inside)


def projection_covariance(
    camera: Camera, covariance: FloatArray, seen: FloatArray, xy: FloatArray
) -> FloatArray:
    """Return the covariance of the pixel positions of directions, with rotations removed.

    Args:
        camera: interior orientation.
        covariance: covariance of its free parameters, (f, f).
        seen: image points to which the rotation is fitted, px, (k, 2).
        xy: pixel positions of the directions, px, (n, 2).

    Returns:
        Covariance, px^2, (n, 2, 2); NaN where the camera model cannot be inverted and, 90 degrees or more
        from the axis, beyond the image points; infinite if a parameter is not determined.
    """
    sigma = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    if np.isinf(sigma).any():
        return np.full((len(xy), 2, 2), np.inf)
    known = np.flatnonzero(sigma > 0)
    if not len(known):
        return np.zeros((len(xy), 2, 2))
    correlation = covariance[np.ix_(known, known)] / np.outer(sigma[known], sigma[known])
    steps = np.zeros((len(known), len(camera.parameters)))
    steps[np.arange(len(known)), np.flatnonzero(camera.free)[known]] = sigma[known]
    moved_seen, turned_seen = _moved(camera, steps, seen), _turned(camera, seen)
    sound = np.isfinite(moved_seen).all(axis=(1, 2)) & np.isfinite(turned_seen).all(axis=(1, 2))
    of_rotation = turned_seen[sound].reshape(-1, 3)
    rotation = np.linalg.lstsq(of_rotation, moved_seen[sound].reshape(-1, len(known)), rcond=None)[0]
    J = _moved(camera, steps, xy) - _turned(camera, xy) @ rotation
    Q = np.einsum("nis,st,njt->nij", J, correlation, J)
    return np.asarray(np.where(within_reach(camera, xy, seen)[:, None, None], Q, np.nan))


def _moved(camera: Camera, steps: FloatArray, xy: FloatArray) -> FloatArray:
    """Return the shifts of images of distant points by steps of the parameters (s, p), px, (n, 2, s)."""
    rays = rays_from_pixel(camera, xy)
    columns = []
    for step in steps:
        ahead = pixel_from_rays(camera.with_parameters(camera.parameters + step / 2), rays)
        columns.append(ahead - pixel_from_rays(camera.with_parameters(camera.parameters - step / 2), rays))
    return np.stack(columns, axis=-1)


def _turned(camera: Camera, xy: FloatArray) -> FloatArray:
    """Return the shifts of images of rays by small rotations about the image axes, px/rad, (n, 2, 3)."""
    rays = rays_from_pixel(camera, xy)
    return np.asarray(ray_jacobian(camera, xy, rays) @ -skew(rays))  # w x ray
