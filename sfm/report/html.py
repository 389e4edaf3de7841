"""report.html: one page, readable with no manual, with everything it shows inside it.

In the order of a surveyor's questions: did it work, how good is it, what was thrown out and why, does the
other adjuster agree, where are my coordinates. Every text that came from a file is escaped.
"""

from __future__ import annotations

from collections.abc import Sequence

from sfm.report.checks import object_size, words_of_sigma0
from sfm.report.markup import figure, finer_unit, significant
from sfm.report.overlays import Overlay
from sfm.report.pages import page
from sfm.report.precision import point_precision, without_fixed
from sfm.report.section_baseline import baseline_section
from sfm.report.section_comparison import comparison_section
from sfm.report.section_quality import quality_section
from sfm.report.section_rejected import rejected_section
from sfm.report.sections import coordinates_section, photographs_section, process_section, worked_section
from sfm.report.verdict import verdict_of
from sfm.result import SurveyResult


def render_html(
    result: SurveyResult,
    plots: Sequence[tuple[str, str, bytes]],
    overlays: Sequence[Overlay],
    *,
    has_model: bool = False,
) -> str:
    """Return the report as one HTML page.

    Args:
        result: the result.
        plots: (stem, caption, PNG) of each picture.
        overlays: the drawn photographs; their thumbnails are embedded, links lead to the overlays folder.
        has_model: whether the folder holds the compared solution as a COLMAP model.
    """
    verdict = verdict_of(result)
    pictures = {stem: figure(data, caption) for stem, caption, data in plots}
    baseline = (
        (("baseline", "And COLMAP by itself?", baseline_section(result, result.baseline)),)
        if result.baseline is not None
        else ()
    )
    sections = (
        ("worked", "Did it work?", worked_section(result, verdict) + pictures.get("network", "")),
        ("quality", "How good is it?", quality_section(result, pictures)),
        ("rejected", "What was thrown out, and why?", rejected_section(result)),
        ("comparison", "Does the other adjuster agree?", comparison_section(result)),
        *baseline,
        ("coordinates", "Where are my coordinates?", coordinates_section(result, has_model=has_model)),
        ("photographs", "The photographs", photographs_section(result, overlays)),
        ("process", "How it was done", process_section(result)),
    )
    return page(
        "Survey report",
        result.survey,
        verdict.headline,
        verdict.level,
        [(name, text) for _, name, text in sections],
        remarks=verdict.remarks,
        tiles=_tiles(result),
        anchors=[key for key, _, _ in sections],
    )


def _tiles(result: SurveyResult) -> list[tuple[str, str, str]]:
    """Return the figures that are asked for first."""
    a = result.adjustment
    size = object_size(a.estimate.points)
    typical = float(point_precision(a)[0, 3])
    fixed = without_fixed(a)
    sigma0, words = words_of_sigma0(result)
    factor, unit = finer_unit(result.length_unit, typical)
    tiles = [
        ("Photographs oriented", f"{len(a.network.images)} of {result.images_total}", ""),
        ("Object points", str(len(a.network.points)), _coded_of(result)),
        (
            "Precision of a point",
            f"{significant(typical * factor)} {unit}",
            f"RMS of sX, sY, sZ{f' {fixed}' if fixed else ''}; 1 : {size / typical:,.0f} of the object"
            if typical > 0
            else "",
        ),
        ("RMS residual", f"{a.rms_px:.4f} px", "per image coordinate"),
        (
            "Sigma0",
            sigma0,
            f"{words}, redundancy {a.redundancy}",
        ),
    ]
    both = result.comparison
    if both is not None:
        tiles.append((both.backend, "agrees" if both.agree else "differs", "both in the same camera model"))
    return tiles


def _coded_of(result: SurveyResult) -> str:
    coded = int((result.code >= 0).sum())
    return f"{coded} coded, {len(result.code) - coded} uncoded"
