"""A survey beside a baseline: photographs oriented by another pipeline, without targets, scale or covariance.

The survey's accepted image points of the targets are intersected with the orientations of the baseline. That
gives the same object points from both, whatever points the baseline found itself.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.comparison.solutions import reprojection, rotation_angle_deg
from sfm.conventions import FloatArray
from sfm.display import counted
from sfm.errors import GeometryError
from sfm.network import Estimate, ImagePoints, Network
from sfm.orientation.image_rays import image_tangents
from sfm.orientation.intersection import intersect
from sfm.similarity import Similarity, fit_similarity

MIN_RAYS = 2


class Baseline(Protocol):
    """Result of another pipeline for the photographs of a survey."""

    @property
    def name(self) -> str:
        """Name of the pipeline."""

    @property
    def network(self) -> Network:
        """The photographs it oriented, by the survey's names, and its points in them."""

    @property
    def estimate(self) -> Estimate:
        """Its cameras, orientations and points, in its own frame and scale."""

    @property
    def total(self) -> int:
        """Photographs it was given."""

    @property
    def rms_px(self) -> float:
        """Root mean square residual per coordinate of its points, px."""

    @property
    def seconds(self) -> float:
        """From photographs to model, s."""


@dataclass(frozen=True)
class BaselineComparison:
    """A survey and a baseline side by side; pairs are (survey, baseline)."""

    name: str  # of the baseline
    photographs: tuple[int, int]  # oriented
    total: int  # photographs given
    rms_px: tuple[float, float]  # of the points and image points of each, per coordinate, px
    targets: int  # object points of the survey that the baseline's photographs determine too
    target_rms_px: float  # of the survey's image points under the baseline's orientations, px
    survey_from_baseline: Similarity
    points: FloatArray  # baseline minus survey after the similarity, object unit, NaN without, (n, 3)
    position: FloatArray  # likewise of the projection centres, object unit, (m, 3)
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
        adjustment: of the survey.
        baseline: what the other pipeline made of the same photographs.
        seconds: of the survey, from photographs to adjustment, s.

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
    found = intersect(
        tangents[known],
        image[known],
        seen.point[known],
        estimate.position,
        estimate.rotation,
        n_points=len(survey.points),
    )
    points = np.where((found.rays >= MIN_RAYS)[:, None], found.points, np.nan)
    both = np.isfinite(points).all(axis=1) & adjustment.estimate.determined
    if both.sum() < 3:
        raise GeometryError(
            f"baseline {baseline.name}: its photographs determine {counted(both.sum(), 'target')} of the "
            "survey, 3 are needed"
        )
    transform = fit_similarity(points[both], adjustment.estimate.points[both])
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
        int(both.sum()),
        float(np.sqrt(np.nanmean(v**2))),
        transform,
        np.where(both[:, None], transform.apply(points) - adjustment.estimate.points, np.nan),
        position,
        angle,
        (seconds, baseline.seconds),
    )
