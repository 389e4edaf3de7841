"""Comparisons in the report of a survey: with the other adjuster, and with another pipeline."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sfm.comparison.two_adjusters.adjusters import AdjusterComparison
from sfm.display import counted, program_name
from sfm.judgement.checks import point_sigma
from sfm.remarks.remark import of_kind
from sfm.report.findings import Findings
from sfm.report.page import Column, Heading, Note, Paragraph, Part, Statement, Table, columns, facts
from sfm.report.phrases import finer_unit, fixed, general, scientific, significant, words_left_out


def adjuster_parts(f: Findings) -> Iterator[Part]:
    """Yield the parts on whether the other adjuster agrees."""
    both, unit = f.result.comparison, f.result.length_unit
    if both is None:
        yield Paragraph("The survey did not request a comparison.")
        return
    d, name = both.comparison, program_name(both.backend)
    alike = " ".join(one.text for one in of_kind(f.verdict.tests, "adjuster_fits_alike"))
    better = " ".join(one.text for one in of_kind(f.verdict.remarks, "adjuster_fits_better"))
    if both.stopped_early:
        short = significant(d.max_sigmas)
        words = f"find the same optimum; {name} stopped {short} standard deviations short."
        yield Statement(f"Yes: Kolinear and {name} {words}", "good")
    elif both.better and both.agree:
        yield Statement(f"{better} Kolinear and {name} agree on that camera.", "fair")
    elif both.agree:
        yield Statement(f"Yes: Kolinear and {name} end at the same optimum.", "good")
    elif both.outcome == "fits alike":
        yield Statement(alike, "good")
    else:
        yield Statement(f"No: Kolinear and {name} do not end at the same optimum.", "bad")
        yield facts([("because", reason) for reason in _reasons(both)])
    survey_px = f.result.adjustment.rms_px
    left_out, models = words_left_out(f), " and ".join(f.interior.models)
    unchecked = f", and {name} does not check what is omitted here" if left_out else ""
    yield Paragraph(
        f"Both adjusters had only the {len(both.network.image_points)} accepted image points, with equal "
        "weights, in a free datum and in the camera model "
        f"{both.model}{f', {left_out}' if left_out else ''}. The survey itself is a different adjustment: "
        f"its RMS residual is {fixed(survey_px, 4)} px with its weights in {models}{unchecked}. One "
        "solution is fitted to the other by shift, rotation and scale before anything is compared."
    )
    rms, cost = [fixed(one, 9) for one in d.rms_px], [general(one, 9) for one in d.cost]
    ends = ["yes" if one else "no" for one in (both.adjustment.converged, both.backend_converged)]
    interior = float(np.nanmax(d.interior_px, initial=0.0))
    rows = (
        ("RMS residual per coordinate", *rms, "px"),
        ("cost (half the sum of squares)", *cost, "px²"),
        ("converged", *ends, ""),
        ("iterations", both.adjustment.iterations, both.backend_iterations, ""),
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
    yield Heading("Precision of the points")
    C = both.adjustment.covariance
    sigmas = (
        ("Kolinear: all unknowns uncertain (marginal)", C.points),
        ("Kolinear: photographs and cameras held (conditional)", C.points_limiting),
        (f"{name}: photographs and cameras held (conditional)", both.backend_points),
    )
    factor, finer = finer_unit(unit, point_sigma(C.points)[1])
    precision = [
        (words, *(significant(factor * one, 4) for one in point_sigma(Q)), finer)
        for words, Q in sigmas
        if Q is not None
    ]
    yield Table(columns("standard deviation of a coordinate", ">RMS", ">largest", "unit"), precision)
    yield Note(
        "With photographs and cameras held, their uncertainty is missing: only the marginal standard "
        f"deviations are those of the whole adjustment. {name} gives only the conditional ones. All refer to "
        "the compared adjustment, with its sigma0."
    )
    converted = [one for one in both.conversions if one.source_model != one.camera.model]
    if converted:
        yield Heading("Cameras converted to another model")
        heads = (Column("misfit RMS", "", "px", ".4f"), Column("largest", "", "px", ".4f"))
        written = [
            (one.camera.name, one.source_model, one.camera.model, one.rms_px, one.max_px) for one in converted
        ]
        yield Table((*columns("camera", "from", "to"), *heads), written)
        yield Note(
            "The misfit is the part of the survey's model that the other model cannot reproduce. It is the "
            "same for both adjusters and does not affect the result of the survey."
        )
    if both.held:
        yield Note(
            "The distortion was held at the survey's result in both adjusters, because the image points do "
            f"not determine all of it in this model: {', '.join(both.held)}."
        )
    if both.unshared:
        yield Note(
            f"{name} shares all parameters of a camera among photographs or none. Therefore these were held "
            f"at the survey's result in both adjusters: {'; '.join(both.unshared)}."
        )
    if both.freed:
        yield Note(f"Free in the comparison in addition to the survey's parameters: {'; '.join(both.freed)}.")


def _reasons(both: AdjusterComparison) -> list[str]:
    """Return the reasons why two adjusters do not agree."""
    reasons = [*both.comparison.exceeded]
    if reasons and both.adjustment.converged:
        reasons.append(_other_minimum(both))
    reasons += [] if both.adjustment.converged else ["Kolinear did not converge in this model"]
    return reasons + ([] if both.backend_converged else [f"{program_name(both.backend)} did not converge"])


def _other_minimum(both: AdjusterComparison) -> str:
    """Return in words which of two minima is lower."""
    ours, theirs = both.comparison.cost
    lower = program_name("kolinear" if ours < theirs else both.backend)
    ratio = max(ours, theirs) / min(ours, theirs) if min(ours, theirs) > 0 else np.inf
    return (
        f"continuing from {program_name(both.backend)}'s solution does not lead to Kolinear's: there are two "
        f"minima, and that of {lower} is lower, by a factor of {ratio:.6g} in the sum of squares"
    )


def pipeline_parts(f: Findings) -> Iterator[Part]:
    """Yield the parts on the result of another pipeline on the photographs alone."""
    found, unit = f.result.baseline, f.result.length_unit
    if found is None:
        return
    name = found.name
    factor, finer = finer_unit(unit, found.point_rms)
    point, most, centre, most_centre, sigma = (
        significant(factor * one)
        for one in (
            *(found.point_rms, found.max_point, found.position_rms, found.max_position),
            float(f.precision.rms[3]),
        )
    )
    yield Paragraph(
        f"{name} oriented {found.photographs[1]} of {found.total} photographs from their natural texture "
        f"alone, Kolinear {found.photographs[0]} from the survey's points. After a fit to the survey by "
        f"shift, rotation and scale, its orientations place {counted(found.targets, 'point')} of the survey "
        f"{point} {finer} (RMS of a coordinate) from their positions in the survey; their standard "
        f"deviation there is {sigma} {finer}."
    )
    oriented = (f"{one} of {found.total}" for one in found.photographs)
    rms, seconds = [significant(one) for one in found.rms_px], [fixed(one, 1) for one in found.seconds]
    rows = (
        ("photographs oriented", *oriented, ""),
        ("RMS residual of each program's image points, per coordinate", *rms, "px"),
        ("RMS residual of the survey's image points", rms[0], significant(found.target_rms_px), "px"),
        ("time from photographs to orientation", *seconds, "s"),
    )
    apart = (
        ("object point", point, most, finer),
        ("projection centre", centre, most_centre, finer),
        ("rotation", "", significant(found.max_rotation_deg), "deg"),
    )
    heads = columns("difference after the fit", ">RMS of a coordinate", ">largest", "unit")
    yield Table(columns("", ">Kolinear", f">{name}", "unit"), rows)
    yield Table(heads, apart)
    yield Note(
        f"The survey's accepted image points were intersected with the orientations and camera of {name}, so "
        "the same points are compared. It does not know the scale."
    )
