"""The survey beside another pipeline that had the same photographs and no targets."""

from __future__ import annotations

from html import escape

from sfm.comparison.baseline import BaselineComparison
from sfm.report.markup import finer_unit, significant, table
from sfm.report.precision import point_precision
from sfm.result import SurveyResult


def baseline_section(result: SurveyResult, found: BaselineComparison) -> str:
    """Both surveys side by side, then how far they are apart."""
    name = found.name
    factor, unit = finer_unit(result.length_unit, found.point_rms)
    sigma = factor * point_precision(result.adjustment)[0, 3]
    apart = factor * found.point_rms
    text = (
        f"<p>{escape(name)} oriented {found.photographs[1]} of {found.total} photographs from their natural "
        f"texture alone, kolinear {found.photographs[0]} from the survey's points. Brought onto the survey "
        f"by shift, rotation and scale, its orientations put {found.targets} points of the survey "
        f"{significant(apart)} {unit} (RMS of a coordinate) from where the survey has them; the survey's own "
        f"standard deviation is {significant(sigma)} {unit}.</p>"
    )
    text += table(
        ("", "kolinear", name, "unit"),
        [
            ("photographs oriented", *(f"{n} of {found.total}" for n in found.photographs), ""),
            ("RMS residual of its own image points, per coordinate", *_two(found.rms_px), "px"),
            (
                "RMS residual of the survey's image points",
                *_two((found.rms_px[0], found.target_rms_px)),
                "px",
            ),
            ("time from photographs to orientation", *(f"{t:.1f}" for t in found.seconds), "s"),
        ],
    )
    text += table(
        ("difference after the similarity", "RMS of a coordinate", "largest", "unit"),
        [
            ("object point", significant(apart), significant(factor * found.max_point), unit),
            (
                "projection centre",
                significant(factor * found.position_rms),
                significant(factor * found.max_position),
                unit,
            ),
            ("rotation", "", significant(found.max_rotation_deg), "deg"),
        ],
    )
    return text + (
        "<p class=note>The survey's accepted image points were intersected with the orientations and camera "
        f"of {escape(name)}, so that the same points are compared. It knows no scale of its own.</p>"
    )


def _two(values: tuple[float, float]) -> tuple[str, str]:
    return significant(values[0]), significant(values[1])
