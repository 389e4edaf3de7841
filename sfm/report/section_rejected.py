"""What was thrown out, and why: image points by the test, points and candidates by their looks."""

from __future__ import annotations

from html import escape

import numpy as np

from sfm.report.geometry import image_rms
from sfm.report.markup import table
from sfm.result import SurveyResult

MAX_REJECTED_ROWS = 60


def rejected_section(result: SurveyResult) -> str:
    """What was thrown out and why: image points by the test, candidates by their looks."""
    a = result.adjustment
    rejected = np.flatnonzero(a.rejected)
    total = len(a.rejected)
    text = (
        f"<p>{len(rejected)} of {total} image points were rejected in the adjustment"
        f" ({100 * len(rejected) / max(total, 1):.1f} %). Their residuals are too long for their standard "
        "deviations; they took no part in the result.</p>"
    )
    if len(rejected):
        length = np.linalg.norm(a.residuals[rejected], axis=1)
        order = rejected[np.argsort(-np.nan_to_num(length, nan=np.inf))]
        seen = a.network.image_points
        text += table(
            ("photograph", "point", "x [px]", "y [px]", "vx [px]", "vy [px]", "length [px]"),
            [
                (
                    a.network.images[seen.image[k]],
                    a.network.points[seen.point[k]],
                    f"{seen.xy[k, 0]:.2f}",
                    f"{seen.xy[k, 1]:.2f}",
                    f"{a.residuals[k, 0]:+.3f}",
                    f"{a.residuals[k, 1]:+.3f}",
                    f"{np.linalg.norm(a.residuals[k]):.3f}",
                )
                for k in order[:MAX_REJECTED_ROWS]
            ],
        )
        if len(order) > MAX_REJECTED_ROWS:
            text += f"<p class=note>The {MAX_REJECTED_ROWS} longest; all are in image_points.csv.</p>"
    if result.no_circles:
        text += (
            "<h3>Points that are no circles</h3>"
            f"<p>{len(result.no_circles)} uncoded points were left out, their outlines are not the images of "
            f"a circle in space: {escape(', '.join(result.no_circles))}</p>"
        )
    if result.photographs:
        text += _rejected_candidates(result)
    return text


def _rejected_candidates(result: SurveyResult) -> str:
    """Return what was seen in the photographs but not measured, by reason and photograph."""
    by_photograph = [dict(photograph.reasons()) for photograph in result.photographs]
    total: dict[str, int] = {}
    for counts in by_photograph:
        for reason, count in counts.items():
            total[reason] = total.get(reason, 0) + count
    reasons = sorted(total, key=lambda reason: (-total[reason], reason))
    used = dict(zip(result.adjustment.network.images, image_rms(result.adjustment)[1], strict=True))
    rows = [
        (
            photograph.image,
            str(len(photograph.xy)),
            str(int(used.get(photograph.image, 0))),
            *(str(counts.get(reason, "")) for reason in reasons),
        )
        for photograph, counts in zip(result.photographs, by_photograph, strict=True)
    ]
    rows.append(
        (
            "all",
            str(sum(len(photograph.xy) for photograph in result.photographs)),
            str(int(sum(used.values()))),
            *(str(total[reason]) for reason in reasons),
        )
    )
    return (
        "<h3>Candidates in the photographs</h3><p class=note>Blobs that might have been targets and were not "
        "measured, by reason. Clutter in view makes many of them; the overlays show each.</p>"
        + table(("photograph", "measured", "accepted in the result", *reasons), rows, last_bold=True)
    )
