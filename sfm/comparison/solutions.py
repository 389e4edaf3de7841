"""Comparison of two solutions of one network, and of a survey with another pipeline.

The datum is not part of a solution. Before anything is subtracted, one solution is aligned to the other by a
7-parameter similarity over the object points. Differences are judged in standard deviations.

A baseline has the photographs of a survey oriented by another pipeline, without targets, scale or covariance.
The survey's accepted image points of the targets are intersected with the orientations of the baseline. Both
then have the same object points, whatever points the baseline found itself.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from sfm.adjustment.result import Adjustment, Covariance
from sfm.comparison.pairing import rounding_of
from sfm.model.arguments import checked_arguments
from sfm.model.camera import Camera, pixel_from_rays, project, rays_from_pixel
from sfm.model.conventions import MAD_TO_SIGMA, FloatArray
from sfm.model.display import counted
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, rows_of
from sfm.model.similarity import Similarity, fit_similarity
from sfm.orientation.image_rays import image_tangents
from sfm.orientation.intersection import intersect

MIN_RAYS = 2
DATUM = 7  # coordinates, angles and scale that image points do not tell
LEAST_SIGMA_PX = 1e-3  # of image points that a model fits without residuals, as those of a simulation
EFFECT_STEPS = 9  # positions along each side of the photograph where interior orientations are compared
ROUNDING_PX = 1e-7  # rounding errors of residuals, and of interior orientation in the photograph
ROUNDING_RAD = 1e-9
SAME_SIGMAS = 0.01  # two solutions that differ by less, in standard deviations, are the same optimum


@dataclass(frozen=True)
class Comparison:
    """Differences b - a of two solutions of one network, after a similarity of b onto a."""

    names: tuple[str, str]  # of a and b
    a: Estimate  # first solution
    b: Estimate  # second solution, in the datum of the first
    a_from_b: Similarity
    object_size: float  # diagonal of the box around the object points, object unit
    position: FloatArray  # of the projection centres, object unit, (m, 3)
    rotation_deg: FloatArray  # angle between the two rotations of each photograph, deg, (m,)
    points: FloatArray  # of the object points, object unit, (n, 3)
    interior: tuple[FloatArray, ...]  # of the parameters of each camera, their units; NaN across models
    interior_px: FloatArray  # largest shift of a ray in the photograph, px, (cameras,)
    rms_px: tuple[float, float]  # root mean square residual per coordinate of a and b, px
    cost: tuple[float, float]  # half the sum of squared residuals of a and b, px^2
    # (parameter that differs most, difference in its standard deviations in a) for each kind of parameter
    # with known standard deviations
    sigmas: tuple[tuple[str, float], ...]

    @property
    def max_sigmas(self) -> float:
        """Largest difference of any parameter, in its standard deviations."""
        return max((value for _, value in self.sigmas), default=0.0)

    @property
    def exceeded(self) -> tuple[str, ...]:
        """Sentences on differences too large for two solutions of one optimum; empty without any."""
        return tuple(
            f"{what} differs by {value:.2g} of its standard deviation, {SAME_SIGMAS:g} is allowed"
            for what, value in self.sigmas
            if not value <= SAME_SIGMAS
        )

    @property
    def agree(self) -> bool:
        """Whether both are the same optimum."""
        return not self.exceeded

    @property
    def max_position(self) -> float:
        """Largest difference of a projection centre, object unit."""
        return _longest(self.position)

    @property
    def max_rotation_deg(self) -> float:
        """Largest angle between two rotations, deg."""
        return float(np.max(self.rotation_deg, initial=0.0))

    @property
    def max_point(self) -> float:
        """Largest difference of an object point, object unit."""
        return _longest(self.points)


@checked_arguments()
def compare(
    a: Estimate,
    b: Estimate,
    network: Network,
    *,
    covariance: Covariance,
    names: tuple[str, str] = ("kolinear", "colmap"),
) -> Comparison:
    """Compare two solutions of the same network, each in any datum.

    Args:
        a: first solution.
        b: second solution; photographs and points that only one solution has are not compared.
        network: has the image points for the residuals of both.
        covariance: covariance of the first solution in a free datum on all points, which judges the
            differences.
        names: names of a and b.

    Returns:
        Differences b - a after a similarity of b onto a.

    Raises:
        GeometryError: fewer than three points in common, or all of them on a line.

    Source: the 7-parameter similarity of Horn (1987) over all points, as for any two free networks: Caspary
    (2000), Concepts of network and deformation analysis, sec. 7.
    """
    common = a.determined & b.determined
    a_from_b = fit_similarity(b.points[common], a.points[common])
    moved = a_from_b.apply_estimate(b)
    images = a.oriented & b.oriented
    size = float(np.linalg.norm(np.ptp(a.points[common], axis=0)))
    position = np.where(images[:, None], moved.position - a.position, np.nan)
    points = np.where(common[:, None], moved.points - a.points, np.nan)
    angle = np.full(len(images), np.nan)
    angle[images] = rotation_angle_deg(a.rotation[images], moved.rotation[images])
    squares = [(reprojection(network, estimate) ** 2).ravel() for estimate in (a, b)]
    rms = tuple(float(np.sqrt(np.mean(s))) if len(s) else 0.0 for s in squares)
    interior = tuple(
        q.parameters - p.parameters if p.model == q.model else np.full(len(p.parameters), np.nan)
        for p, q in zip(a.cameras, b.cameras, strict=True)
    )
    interior_px = [interior_effect_px(p, q) for p, q in zip(a.cameras, b.cameras, strict=True)]
    rounding = rounding_of(a.points[common])
    return Comparison(
        names,
        a,
        moved,
        a_from_b,
        size,
        position,
        angle,
        points,
        interior,
        np.array(interior_px),
        (rms[0], rms[1]),
        (float(squares[0].sum() / 2), float(squares[1].sum() / 2)),
        _in_sigmas(
            network,
            a,
            covariance,
            _unless_rounding(points, rounding),
            _unless_rounding(position, rounding),
            _unless_rounding(np.deg2rad(angle), ROUNDING_RAD),
            tuple(
                np.zeros_like(d) if px < ROUNDING_PX else d
                for px, d in zip(interior_px, interior, strict=True)
            ),
        ),
    )


def _unless_rounding(difference: FloatArray, rounding: float) -> FloatArray:
    """Return differences, with 0 for rounding errors."""
    return np.where(np.abs(difference) <= rounding, 0.0, difference)


def _in_sigmas(
    network: Network,
    a: Estimate,
    covariance: Covariance,
    points: FloatArray,
    position: FloatArray,
    angle: FloatArray,
    interior: tuple[FloatArray, ...],
) -> tuple[tuple[str, float], ...]:
    """Return, for each kind of parameter, the one that differs most in standard deviations, and by how many.

    A rotation is judged by the smallest standard deviation of its three angles.
    """
    exterior = np.diagonal(covariance.exterior, axis1=1, axis2=2)
    kinds: list[tuple[tuple[str, ...], FloatArray, FloatArray]] = [
        (
            tuple(f"object point {name}" for name in network.points),
            points,
            np.diagonal(covariance.points, axis1=1, axis2=2),
        ),
        (tuple(f"projection centre of {name}" for name in network.images), position, exterior[:, :3]),
        (
            tuple(f"rotation of {name}" for name in network.images),
            angle[:, None],
            exterior[:, 3:].min(axis=1, keepdims=True),
        ),
    ]
    for camera, difference, Q in zip(a.cameras, interior, covariance.interior, strict=True):
        free = np.flatnonzero(camera.free)
        if len(Q) == len(free):
            names = tuple(f"{camera.names[k]} of camera {camera.name}" for k in free)
            kinds.append((names, difference[free, None], np.diagonal(Q)[:, None]))
    largest = []
    for names, difference, variance in kinds:
        known = np.isfinite(difference) & (variance > 0)
        if known.any():
            ratio = np.where(known, np.abs(difference), 0.0) / np.sqrt(np.where(known, variance, 1.0))
            worst = int(np.argmax(ratio.max(axis=1)))
            largest.append((names[worst], float(ratio[worst].max())))
    return tuple(largest)


def reprojection(network: Network, estimate: Estimate) -> FloatArray:
    """Return computed minus measured image points that the estimate determines, px, (k, 2)."""
    seen = network.image_points
    use = estimate.oriented[seen.image] & estimate.determined[seen.point]
    v = np.zeros((len(seen), 2))
    for i, of_photograph in enumerate(rows_of(seen.image, len(network.images))):
        rows = of_photograph[use[of_photograph]]
        if not len(rows):
            continue
        computed = project(
            estimate.cameras[network.camera[i]],
            estimate.position[i],
            estimate.rotation[i],
            estimate.points[seen.point[rows]],
        )
        v[rows] = computed - seen.xy[rows]
    return v[use]


def redundancy_of(seen: ImagePoints) -> int:
    """Return the redundancy of image points with all their photographs and points unknown, at least 1."""
    unknowns = 6 * len(np.unique(seen.image)) + 3 * len(np.unique(seen.point)) - DATUM
    return max(2 * len(seen) - unknowns, 1)


def robust_sigma_px(residuals: FloatArray, redundancy: int) -> float:
    """Return the robust standard deviation of a coordinate, px: residuals are smaller than errors.

    Args:
        residuals: of image points, px, (k, 2).
        redundancy: of the image points.
    """
    share = min(1.0, redundancy / residuals.size)
    spread = MAD_TO_SIGMA * float(np.median(np.abs(residuals)))
    return max(spread / float(np.sqrt(share)), LEAST_SIGMA_PX)


def rotation_angle_deg(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the angles between rotations, (k, 3, 3) each, deg, (k,); exact to rounding near 0."""
    D = np.einsum("kji,kjl->kil", a, b)
    sine = np.stack([D[:, 2, 1] - D[:, 1, 2], D[:, 0, 2] - D[:, 2, 0], D[:, 1, 0] - D[:, 0, 1]], axis=1) / 2
    cosine = (np.trace(D, axis1=1, axis2=2) - 1) / 2
    return np.asarray(np.rad2deg(np.arctan2(np.linalg.norm(sine, axis=1), cosine)))


def interior_effect_px(a: Camera, b: Camera) -> float:
    """Return the largest shift of a ray in the photograph between two interior orientations, px."""
    width, height = a.size_px
    x = np.linspace(-0.5, width - 0.5, EFFECT_STEPS)
    y = np.linspace(-0.5, height - 0.5, EFFECT_STEPS)
    xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    shift = pixel_from_rays(b, rays_from_pixel(a, xy)) - xy
    return _longest(shift)


def _longest(vectors: FloatArray) -> float:
    """Return the length of the longest vector, ignoring vectors with NaN."""
    return float(np.nanmax(np.linalg.norm(vectors, axis=1), initial=0.0))


class Baseline(Protocol):
    """Result of another pipeline for the photographs of a survey."""

    @property
    def name(self) -> str:
        """Name of the pipeline."""

    @property
    def network(self) -> Network:
        """The photographs that it oriented, by the survey's names, and its points in them."""

    @property
    def estimate(self) -> Estimate:
        """Its cameras, orientations and points, in its frame and scale."""

    @property
    def total(self) -> int:
        """Number of given photographs."""

    @property
    def rms_px(self) -> float:
        """Root mean square residual per coordinate of its points, px."""

    @property
    def seconds(self) -> float:
        """Time from photographs to model, s."""


@dataclass(frozen=True)
class BaselineComparison:
    """A survey and a baseline side by side; pairs are (survey, baseline)."""

    name: str  # of the baseline
    photographs: tuple[int, int]  # numbers of oriented photographs
    total: int  # number of given photographs
    rms_px: tuple[float, float]  # residuals of the image points of each, per coordinate, px
    targets: int  # object points of the survey that the baseline's photographs also determine
    target_rms_px: float  # of the survey's image points with the baseline's orientations, px
    points: FloatArray  # baseline minus survey after the similarity, object unit, NaN if missing, (n, 3)
    position: FloatArray  # the same for the projection centres, object unit, (m, 3)
    rotation_deg: FloatArray  # angle between the rotations of each photograph, deg, (m,)
    seconds: tuple[float, float]  # from photographs to result, s

    @property
    def point_rms(self) -> float:
        """Root mean square difference of a coordinate of the targets, object unit."""
        return float(np.sqrt(np.nanmean(self.points**2)))

    @property
    def position_rms(self) -> float:
        """Root mean square difference of a coordinate of the projection centres, object unit."""
        return float(np.sqrt(np.nanmean(self.position**2)))

    @property
    def max_position(self) -> float:
        """Largest difference of a projection centre, object unit."""
        return float(np.nanmax(np.linalg.norm(self.position, axis=1)))

    @property
    def max_rotation_deg(self) -> float:
        """Largest angle between the rotations of a photograph, deg."""
        return float(np.nanmax(self.rotation_deg))

    @property
    def max_point(self) -> float:
        """Largest difference of a target, object unit."""
        return float(np.nanmax(np.linalg.norm(self.points, axis=1)))


def compare_baseline(adjustment: Adjustment, baseline: Baseline, *, seconds: float) -> BaselineComparison:
    """Compare a survey with the orientations that another pipeline found for its photographs.

    Args:
        adjustment: adjustment of the survey.
        baseline: result of the other pipeline from the same photographs.
        seconds: time of the survey from photographs to adjustment, s.

    Raises:
        GeometryError: fewer than three targets can be determined with the baseline's photographs.
    """
    survey, network, estimate = adjustment.network, baseline.network, baseline.estimate
    index = {image: i for i, image in enumerate(network.images) if estimate.oriented[i]}
    of_survey = np.array([index.get(image, -1) for image in survey.images], dtype=np.int64)
    seen = survey.image_points
    use = ~adjustment.rejected & (of_survey[seen.image] >= 0)
    seen = seen.select(use)
    image = of_survey[seen.image]
    tangents = image_tangents(replace(seen, image=image), network.camera, estimate.cameras)
    known = np.isfinite(tangents).all(axis=1)
    intersection = intersect(
        tangents[known],
        image[known],
        seen.point[known],
        estimate.position,
        estimate.rotation,
        n_points=len(survey.points),
    )
    points = np.where((intersection.rays >= MIN_RAYS)[:, None], intersection.points, np.nan)
    common = np.isfinite(points).all(axis=1) & adjustment.estimate.determined
    if common.sum() < 3:
        raise GeometryError(
            f"baseline {baseline.name}: its photographs determine {counted(common.sum(), 'target')} of the "
            "survey, 3 are needed"
        )
    transform = fit_similarity(points[common], adjustment.estimate.points[common])
    oriented = (of_survey >= 0) & adjustment.estimate.oriented
    m = len(survey.images)
    position, angle = np.full((m, 3), np.nan), np.full(m, np.nan)
    theirs = of_survey[oriented]
    position[oriented] = transform.apply(estimate.position[theirs]) - adjustment.estimate.position[oriented]
    angle[oriented] = rotation_angle_deg(
        adjustment.estimate.rotation[oriented], transform.rotation @ estimate.rotation[theirs]
    )
    measured = Network(
        network.images,
        network.camera,
        survey.points,
        ImagePoints(image, seen.point, seen.xy, seen.covariance),
    )
    v = reprojection(measured, Estimate(estimate.cameras, estimate.position, estimate.rotation, points))
    return BaselineComparison(
        baseline.name,
        (int(adjustment.estimate.oriented.sum()), len(index)),
        baseline.total,
        (adjustment.rms_px, baseline.rms_px),
        int(common.sum()),
        float(np.sqrt(np.nanmean(v**2))),
        np.where(common[:, None], transform.apply(points) - adjustment.estimate.points, np.nan),
        position,
        angle,
        (seconds, baseline.seconds),
    )
