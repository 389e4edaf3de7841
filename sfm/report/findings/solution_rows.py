"""The solution row by row: every object point and every photograph with precision, rays and residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.conventions import FloatArray, angles_from_rotation
from sfm.report.findings.geometry import Geometry
from sfm.report.findings.precision import Precision
from sfm.result import SurveyResult

UNCODED = -1


@dataclass(frozen=True)
class PointRow:
    """An object point."""

    name: str
    xyz: FloatArray  # object unit, (3,)
    sigma: FloatArray  # standard deviations of the same, 0 where fixed, (3,)
    rays: int  # accepted image points
    code: int | None  # code number, None if uncoded
    angle_deg: float  # largest angle between two rays; NaN with fewer than two
    rms_px: float  # root mean square residual per coordinate
    limiting: FloatArray  # standard deviations with the cameras free of error, object unit, (3,)

    @property
    def sigma_length(self) -> float:
        """Length of the vector of its standard deviations, object unit; 0 where not known."""
        return float(np.linalg.norm(np.nan_to_num(self.sigma)))


@dataclass(frozen=True)
class PhotographRow:
    """A photograph."""

    name: str
    values: FloatArray  # X0, Y0, Z0, object unit, and omega, phi, kappa, deg, (6,)
    sigma: FloatArray  # standard deviations of the same, (6,)
    camera: str
    points: int  # accepted image points
    rms_px: float  # root mean square residual per coordinate
    coverage: float  # share of the photograph within the convex hull of its image points


def points_of(result: SurveyResult, precision: Precision, geometry: Geometry) -> tuple[PointRow, ...]:
    """Return every object point."""
    network = result.adjustment.network
    return tuple(
        PointRow(
            name,
            result.adjustment.estimate.points[j],
            precision.points[j],
            int(geometry.rays[j]),
            None if result.code[j] == UNCODED else int(result.code[j]),
            float(geometry.angle_deg[j]),
            float(geometry.point_rms_px[j]),
            precision.limiting_points[j],
        )
        for j, name in enumerate(network.points)
    )


def photographs_of(
    adjustment: Adjustment, precision: Precision, geometry: Geometry
) -> tuple[PhotographRow, ...]:
    """Return every photograph."""
    network, estimate = adjustment.network, adjustment.estimate
    values = np.hstack([estimate.position, np.degrees(angles_from_rotation(estimate.rotation))])
    sigma = np.hstack([precision.exterior[:, :3], np.degrees(precision.exterior[:, 3:])])
    return tuple(
        PhotographRow(
            name,
            values[i],
            sigma[i],
            estimate.cameras[network.camera[i]].name,
            int(geometry.image_points[i]),
            float(geometry.image_rms_px[i]),
            float(geometry.hull[i]),
        )
        for i, name in enumerate(network.images)
    )
