"""Does the other adjuster agree: the verdict first, then both in numbers."""

from __future__ import annotations

from html import escape

import numpy as np

from sfm.comparison.adjusters import AdjusterComparison
from sfm.report.markup import finer_unit, significant, table, yes_or_no
from sfm.report.precision import root_mean_square
from sfm.result import SurveyResult


def comparison_section(result: SurveyResult) -> str:
    """Does the other adjuster agree: the verdict first, then both in numbers."""
    both = result.comparison
    if both is None:
        return "<p>The survey asked for no comparison.</p>"
    d = both.comparison
    unit = result.length_unit
    name = both.backend
    verdict = (
        f"Yes: kolinear and {name} end at the same optimum."
        if both.agree
        else f"No: kolinear and {name} do not end at the same optimum."
    )
    text = f'<p class="verdict {"good" if both.agree else "bad"}">{escape(verdict)}</p>'
    if not both.agree:
        reasons = list(d.exceeded)
        reasons += [] if both.adjustment.converged else ["kolinear did not converge in this model"]
        reasons += [] if both.backend_converged else [f"{name} did not converge"]
        text += "<ul>" + "".join(f"<li>{escape(reason)}</li>" for reason in reasons) + "</ul>"
    survey_model = " and ".join(sorted({camera.model for camera in result.adjustment.estimate.cameras}))
    text += (
        f"<p>Both adjusters had the {len(both.network.image_points)} accepted image points with equal "
        f"weights in the camera model {escape(both.model)} (the survey's own: {escape(survey_model)}), "
        "without control and scale bars. One solution is brought onto the other by shift, rotation "
        "and scale before anything is compared.</p>"
    )
    text += table(
        ("", "kolinear", name, "unit"),
        [
            ("RMS residual per coordinate", f"{d.rms_px[0]:.9f}", f"{d.rms_px[1]:.9f}", "px"),
            ("cost (half the sum of squares)", f"{d.cost[0]:.9g}", f"{d.cost[1]:.9g}", "px\u00b2"),
            ("converged", yes_or_no(both.adjustment.converged), yes_or_no(both.backend_converged), ""),
            ("iterations", str(both.adjustment.iterations), str(both.backend_iterations), ""),
        ],
    )
    size = d.object_size
    text += table(
        ("largest difference", "value", "unit", "of the object size"),
        [
            ("projection centre", f"{d.max_position:.2e}", unit, f"{d.max_position / size:.1e}"),
            ("object point", f"{d.max_point:.2e}", unit, f"{d.max_point / size:.1e}"),
            ("rotation", f"{d.max_rotation_deg:.2e}", "deg", ""),
            (
                "interior orientation, in the photograph",
                f"{np.nanmax(d.interior_px, initial=0.0):.2e}",
                "px",
                "",
            ),
        ],
    )
    return text + _precision(result, both) + _conversions(result, both)


def _precision(result: SurveyResult, both: AdjusterComparison) -> str:
    """Standard deviations of the points by both, marginal and conditional, each called what it is."""
    covariance = both.adjustment.covariance
    rows = [
        ("kolinear: everything adjusted is uncertain (marginal)", covariance.points),
        (
            "kolinear: photographs and cameras held (conditional, limiting precision)",
            covariance.points_limiting,
        ),
    ]
    if both.backend_points is not None:
        rows.append((f"{both.backend}: photographs, cameras held (conditional)", both.backend_points))
    sigmas = [np.sqrt(np.diagonal(Q, axis1=1, axis2=2)) for _, Q in rows]
    factor, unit = finer_unit(result.length_unit, float(np.nanmax(sigmas[0])))
    return (
        "<h3>Precision of the points</h3>"
        + table(
            ("standard deviation of a coordinate", "RMS", "largest", "unit"),
            [
                (
                    what,
                    significant(factor * root_mean_square(sigma), 4),
                    significant(factor * float(np.nanmax(sigma)), 4),
                    unit,
                )
                for (what, _), sigma in zip(rows, sigmas, strict=True)
            ],
        )
        + "<p class=note>With photographs and cameras held, what is uncertain of them is missing: only the "
        f"marginal standard deviations are those of the whole adjustment. {escape(both.backend)} gives the "
        "conditional ones alone. They are of the compared adjustment, with its sigma0.</p>"
    )


def _conversions(result: SurveyResult, both: AdjusterComparison) -> str:
    """What the comparison had to change: camera models, and what was held or free besides the survey's."""
    text = ""
    converted = [one for one in both.conversions if one.source_model != one.camera.model]
    if converted:
        text += "<h3>Cameras written in another model</h3>" + table(
            ("camera", "from", "to", "misfit RMS [px]", "largest [px]"),
            [
                (
                    one.camera.name,
                    one.source_model,
                    one.camera.model,
                    f"{one.rms_px:.4f}",
                    f"{one.max_px:.4f}",
                )
                for one in converted
            ],
        )
        text += (
            "<p class=note>By so much the other model cannot say the same as the survey's. Both adjusters "
            "have it alike, and the result of the survey is not touched by it.</p>"
        )
    if both.held:
        text += (
            "<p class=note>The distortion was held at the survey's result in both adjusters, since the image "
            f"points do not determine all of it in this model: {escape(', '.join(both.held))}.</p>"
        )
    if both.unshared:
        text += (
            f"<p class=note>{escape(both.backend)} shares all parameters of a camera among photographs or "
            "none. Held at the survey's result in both adjusters were therefore: "
            f"{escape('; '.join(both.unshared))}.</p>"
        )
    if both.freed:
        text += (
            "<p class=note>Free in the comparison besides the survey's own: "
            f"{escape('; '.join(both.freed))}.</p>"
        )
    return text
