"""The part of summary.json on other programs: the other adjuster, the other pipeline."""

from __future__ import annotations

from typing import Any

import numpy as np

from sfm.conventions import FloatArray
from sfm.files.plain_text import or_none
from sfm.report.precision import root_mean_square
from sfm.result import SurveyResult


def comparison_summary(result: SurveyResult) -> dict[str, Any] | None:
    """Return the comparison with the other adjuster, None without one."""
    both = result.comparison
    if both is None:
        return None
    difference = both.comparison
    return {
        "backend": both.backend,
        "agree": both.agree,
        "model": both.model,
        "max_position": or_none(difference.max_position),
        "max_rotation_deg": or_none(difference.max_rotation_deg),
        "max_point": or_none(difference.max_point),
        "max_interior_px": or_none(float(np.nanmax(difference.interior_px, initial=0.0))),
        "object_size": or_none(difference.object_size),
        "rms_px": {"kolinear": difference.rms_px[0], both.backend: difference.rms_px[1]},
        "cost": {"kolinear": difference.cost[0], both.backend: difference.cost[1]},
        "point_sigma_rms": {
            "kolinear_marginal": _point_sigma(both.adjustment.covariance.points),
            "kolinear_conditional": _point_sigma(both.adjustment.covariance.points_limiting),
            f"{both.backend}_conditional": None
            if both.backend_points is None
            else _point_sigma(both.backend_points),
        },
        "exceeded": list(difference.exceeded),
        "held": list(both.held),
        "unshared": list(both.unshared),
        "freed": list(both.freed),
        "conversions": [
            {
                "camera": one.camera.name,
                "from": one.source_model,
                "to": one.camera.model,
                "rms_px": or_none(one.rms_px),
                "max_px": or_none(one.max_px),
            }
            for one in both.conversions
        ],
    }


def baseline_summary(result: SurveyResult) -> dict[str, Any] | None:
    """Return the comparison with the other pipeline, None without one."""
    found = result.baseline
    if found is None:
        return None

    def pair(values: tuple[float, float]) -> dict[str, float | None]:
        return {"kolinear": or_none(values[0]), found.name: or_none(values[1])}

    return {
        "pipeline": found.name,
        "images": {"kolinear": found.photographs[0], found.name: found.photographs[1], "total": found.total},
        "rms_px": pair(found.rms_px),
        "seconds": pair(found.seconds),
        "targets": found.targets,
        "target_rms_px": or_none(found.target_rms_px),
        "point_rms": or_none(found.point_rms),
        "max_point": or_none(found.max_point),
        "position_rms": or_none(found.position_rms),
        "max_rotation_deg": or_none(found.max_rotation_deg),
    }


def _point_sigma(covariance: FloatArray) -> float | None:
    """Root mean square standard deviation of a coordinate, object unit."""
    return or_none(root_mean_square(np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))))
