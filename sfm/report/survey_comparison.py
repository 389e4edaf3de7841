"""Comparisons in the report of a survey: with the other adjuster, and with another pipeline."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sfm.comparison.two_adjusters.adjusters import AdjusterComparison
from sfm.model.display import counted, program_name
from sfm.model.remarks.remark import of_kind
from sfm.report.findings import Findings
from sfm.report.page import Column, Heading, Note, Paragraph, Part, Statement, Table, columns, facts
from sfm.report.phrases import finer_unit, fixed, general, scientific, significant, words_left_out
from sfm.report.precision import point_sigma


def adjuster_parts(f: Findings) -> Iterator[Part]:
    """Yield the parts on whether the other adjuster agrees."""
    adjusters = f.result.comparison
    if adjusters is None:
        yield Paragraph("The survey did not request a comparison.")
        return
    yield from _agreement(f, adjusters)
    yield from _largest_differences(f, adjusters)
    yield from _point_precision(f.result.length_unit, adjusters)
    yield from _conversions(adjusters)
    yield from _notes(adjusters)


def _agreement(f: Findings, adjusters: AdjusterComparison) -> Iterator[Part]:
    """Yield whether both end at the same optimum, and what was compared."""
    name = program_name(adjusters.backend)
    if adjusters.stopped_early:
        short = significant(adjusters.comparison.max_sigmas)
        words = f"find the same optimum; {name} stopped {short} standard deviations short."
        yield Statement(f"Yes: Kolinear and {name} {words}", "good")
    elif adjusters.better and adjusters.agree:
        better = " ".join(remark.text for remark in of_kind(f.verdict.remarks, "adjuster_fits_better"))
        yield Statement(f"{better} Kolinear and {name} agree on that camera.", "fair")
    elif adjusters.agree:
        yield Statement(f"Yes: Kolinear and {name} end at the same optimum.", "good")
    elif adjusters.outcome == "fits alike":
        alike = " ".join(test.text for test in of_kind(f.verdict.tests, "adjuster_fits_alike"))
        yield Statement(alike, "good")
    else:
        yield Statement(f"No: Kolinear and {name} do not end at the same optimum.", "bad")
        yield facts([("because", reason) for reason in _reasons(adjusters)])
    survey_px = f.result.adjustment.rms_px
    left_out, models = words_left_out(f), " and ".join(f.interior.models)
    unchecked = f", and {name} does not check what is omitted here" if left_out else ""
    yield Paragraph(
        f"Both adjusters had only the {len(adjusters.network.image_points)} accepted image points, with "
        f"equal weights, in a free datum and in the camera model {adjusters.model}"
        f"{f', {left_out}' if left_out else ''}. The survey itself is a different adjustment: "
        f"its RMS residual is {fixed(survey_px, 4)} px with its weights in {models}{unchecked}. One "
        "solution is fitted to the other by shift, rotation and scale before anything is compared."
    )


def _largest_differences(f: Findings, adjusters: AdjusterComparison) -> Iterator[Table]:
    """Yield how both adjustments ended, and the largest differences of their results."""
    d, unit, name = adjusters.comparison, f.result.length_unit, program_name(adjusters.backend)
    rms, cost = [fixed(value, 9) for value in d.rms_px], [general(value, 9) for value in d.cost]
    converged = (adjusters.adjustment.converged, adjusters.backend_converged)
    ends = ["yes" if end else "no" for end in converged]
    interior = float(np.nanmax(d.interior_px, initial=0.0))
    rows = (
        ("RMS residual per coordinate", *rms, "px"),
        ("cost (half the sum of squares)", *cost, "px²"),
        ("converged", *ends, ""),
        ("iterations", adjusters.adjustment.iterations, adjusters.backend_iterations, ""),
    )
    yield Table(columns("", ">Kolinear", f">{name}", "unit"), rows)
    size = d.object_size
    largest = (
        ("projection centre", scientific(d.max_position, 2), unit, scientific(d.max_position / size, 1)),
        ("object point", scientific(d.max_point, 2), unit, scientific(d.max_point / size, 1)),
        ("rotation", scientific(d.max_rotation_deg, 2), "deg", ""),
        ("any parameter, in its standard deviations", scientific(d.max_sigmas, 1), "", ""),
        ("interior orientation, in the photograph", scientific(interior, 2), "px", ""),
    )
    yield Table(columns("largest difference", ">value", "unit", ">of the object size"), largest)


def _point_precision(unit: str, adjusters: AdjusterComparison) -> Iterator[Part]:
    """Yield the standard deviations of the points by both."""
    name = program_name(adjusters.backend)
    yield Heading("Precision of the points")
    C = adjusters.adjustment.covariance
    sigmas = (
        ("Kolinear: all unknowns uncertain (marginal)", C.points),
        ("Kolinear: photographs and cameras held (conditional)", C.points_limiting),
        (f"{name}: photographs and cameras held (conditional)", adjusters.backend_points),
    )
    factor, finer = finer_unit(unit, point_sigma(C.points)[1])
    precision = [
        (words, *(significant(factor * sigma, 4) for sigma in point_sigma(Q)), finer)
        for words, Q in sigmas
        if Q is not None
    ]
    yield Table(columns("standard deviation of a coordinate", ">RMS", ">largest", "unit"), precision)
    yield Note(
        "With photographs and cameras held, their uncertainty is missing: only the marginal standard "
        f"deviations are those of the whole adjustment. {name} gives only the conditional ones. All refer to "
        "the compared adjustment, with its sigma0."
    )


def _conversions(adjusters: AdjusterComparison) -> Iterator[Part]:
    """Yield how far the survey's cameras can be written in the model of the comparison."""
    rows = [
        (c.camera.name, c.source_model, c.camera.model, c.rms_px, c.max_px)
        for c in adjusters.conversions
        if c.source_model != c.camera.model
    ]
    if rows:
        yield Heading("Cameras converted to another model")
        heads = (Column("misfit RMS", "", "px", ".4f"), Column("largest", "", "px", ".4f"))
        yield Table((*columns("camera", "from", "to"), *heads), rows)
        yield Note(
            "The misfit is the part of the survey's model that the other model cannot reproduce. It is the "
            "same for both adjusters and does not affect the result of the survey."
        )


def _notes(adjusters: AdjusterComparison) -> Iterator[Note]:
    """Yield which parameters the comparison holds or frees otherwise than the survey."""
    if adjusters.held:
        yield Note(
            "The distortion was held at the survey's result in both adjusters, because the image points do "
            f"not determine all of it in this model: {', '.join(adjusters.held)}."
        )
    if adjusters.unshared:
        yield Note(
            f"{program_name(adjusters.backend)} shares all parameters of a camera among photographs or none. "
            "Therefore these were held at the survey's result in both adjusters: "
            f"{'; '.join(adjusters.unshared)}."
        )
    if adjusters.freed:
        yield Note(
            f"Free in the comparison in addition to the survey's parameters: {'; '.join(adjusters.freed)}."
        )


def _reasons(adjusters: AdjusterComparison) -> list[str]:
    """Return the reasons why two adjusters do not agree."""
    reasons = [*adjusters.comparison.exceeded]
    if reasons and adjusters.adjustment.converged:
        ours, theirs = adjusters.comparison.cost
        lower = program_name("kolinear" if ours < theirs else adjusters.backend)
        ratio = max(ours, theirs) / min(ours, theirs) if min(ours, theirs) > 0 else np.inf
        reasons.append(
            f"continuing from {program_name(adjusters.backend)}'s solution does not lead to Kolinear's: "
            f"there are two minima, and that of {lower} is lower, by a factor of {ratio:.6g} in the sum of "
            "squares"
        )
    if not adjusters.adjustment.converged:
        reasons.append("Kolinear did not converge in this model")
    if not adjusters.backend_converged:
        reasons.append(f"{program_name(adjusters.backend)} did not converge")
    return reasons


def pipeline_parts(f: Findings) -> Iterator[Part]:
    """Yield the parts on the result of another pipeline on the photographs alone."""
    baseline, unit = f.result.baseline, f.result.length_unit
    if baseline is None:
        return
    name = baseline.name
    factor, finer = finer_unit(unit, baseline.point_rms)
    point, most, centre, most_centre, sigma = (
        significant(factor * length)
        for length in (
            baseline.point_rms,
            baseline.max_point,
            baseline.position_rms,
            baseline.max_position,
            float(f.precision.rms[3]),
        )
    )
    ours, theirs = baseline.photographs
    yield Paragraph(
        f"{name} oriented {theirs} of {baseline.total} photographs from their natural texture alone, "
        f"Kolinear {ours} from the survey's points. After a fit to the survey by shift, rotation and scale, "
        f"its orientations place {counted(baseline.targets, 'point')} of the survey {point} {finer} "
        "(RMS of a coordinate) from their positions in the survey; their standard deviation there is "
        f"{sigma} {finer}."
    )
    oriented = (f"{count} of {baseline.total}" for count in baseline.photographs)
    rms = [significant(value) for value in baseline.rms_px]
    seconds = [fixed(value, 1) for value in baseline.seconds]
    rows = (
        ("photographs oriented", *oriented, ""),
        ("RMS residual of each program's image points, per coordinate", *rms, "px"),
        ("RMS residual of the survey's image points", rms[0], significant(baseline.target_rms_px), "px"),
        ("time from photographs to orientation", *seconds, "s"),
    )
    apart = (
        ("object point", point, most, finer),
        ("projection centre", centre, most_centre, finer),
        ("rotation", "", significant(baseline.max_rotation_deg), "deg"),
    )
    heads = columns("difference after the fit", ">RMS of a coordinate", ">largest", "unit")
    yield Table(columns("", ">Kolinear", f">{name}", "unit"), rows)
    yield Table(heads, apart)
    yield Note(
        f"The survey's accepted image points were intersected with the orientations and camera of {name}, so "
        "the same points are compared. It does not know the scale."
    )
