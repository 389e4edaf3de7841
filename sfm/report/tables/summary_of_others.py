"""What summary.json says of the other adjuster and of the other pipeline."""

from __future__ import annotations

from typing import Any

from sfm.files.plain_text import or_none
from sfm.report.findings.findings import Findings
from sfm.result import SurveyResult


def summary_of_comparison(findings: Findings) -> dict[str, Any] | None:
    """Return the comparison with the other adjuster, None without one."""
    found = findings.comparison
    if found is None:
        return None
    both, difference = found.both, found.both.comparison
    other = found.backend_conditional
    return {
        "backend": both.backend,
        "agree": both.agree,
        "outcome": both.outcome,
        "gap": or_none(both.gap),
        "model": both.model,
        "stopped_early": both.stopped_early,
        "max_sigmas": or_none(difference.max_sigmas),
        "max_position": or_none(difference.max_position),
        "max_rotation_deg": or_none(difference.max_rotation_deg),
        "max_point": or_none(difference.max_point),
        "max_interior_px": or_none(found.max_interior_px),
        "object_size": or_none(difference.object_size),
        "rms_px": {"kolinear": difference.rms_px[0], both.backend: difference.rms_px[1]},
        "cost": {"kolinear": difference.cost[0], both.backend: difference.cost[1]},
        "point_sigma_rms": {
            "kolinear_marginal": or_none(found.marginal.rms),
            "kolinear_conditional": or_none(found.conditional.rms),
            f"{both.backend}_conditional": None if other is None else or_none(other.rms),
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


def summary_of_baseline(result: SurveyResult) -> dict[str, Any] | None:
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
