"""The report of a survey, in the order of a surveyor's questions: a section a function, a row in SECTIONS."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from importlib.metadata import version

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.display import agreeing, counted, program_name
from sfm.remarks.remark import of_kind
from sfm.report import survey_quality as quality_of
from sfm.report.figures.overlays import Overlay
from sfm.report.figures.plot_data import Plot
from sfm.report.findings.findings import ComparisonFindings, Findings
from sfm.report.numbers import finer_unit, fixed, general, or_fixed, scientific, significant, to_precision
from sfm.report.page import (
    Card,
    Cards,
    Column,
    Folded,
    Heading,
    Link,
    Note,
    Page,
    Paragraph,
    Part,
    Section,
    Statement,
    Table,
    Tile,
    axes,
    columns,
    facts,
)
from sfm.report.phrases import (
    NORMAL_95,
    words_left_out,
    words_of_calibration,
    words_of_fixed,
    words_of_sigma0,
)
from sfm.report.text import text, wrapped
from sfm.report.viewer.embedded import Viewer

MAX_LISTED = 60  # rejected points and small pictures on the page
MAX_OPEN = 60  # object points that are shown without a click
CONVENTIONS = (
    "Pixel frame: (0, 0) is the centre of the top-left pixel, x to the right, y down. Rotation: "
    "R = Rx(omega) Ry(phi) Rz(kappa) turns image axes (x right, y up, looking along -z) into object axes. "
    "Residuals are computed minus measured. A sigma is one standard deviation."
)


@dataclass(frozen=True)
class Report:
    """What the sections of a report show."""

    f: Findings
    plots: Sequence[Plot]
    overlays: Sequence[Overlay]
    has_model: bool

    @property
    def a(self) -> Adjustment:
        """The adjustment."""
        return self.f.result.adjustment

    def plot(self, stem: str) -> Plot | None:
        """Return a plot by the name of its file; None without it."""
        return next((one for one in self.plots if one.stem == stem), None)


def page(
    found: Findings,
    *,
    plots: Sequence[Plot] = (),
    overlays: Sequence[Overlay] = (),
    has_model: bool = False,
    viewer: Viewer | None = None,
) -> Page:
    """Return the report of a survey.

    Args:
        found: the result and what is stated of it.
        plots: the pictures of the adjustment.
        overlays: the drawn photographs; links lead to the folder of overlays.
        has_model: whether the folder contains the compared solution as a COLMAP model.
        viewer: the scene to explore, whose pictures may lie beside the page; None leaves it out.
    """
    report = Report(found, plots, overlays, has_model)
    return Page(
        "report",
        "Survey report",
        found.result.survey,
        found.verdict,
        tuple(section(report) for section in SECTIONS),
        tuple(_tiles(found)),
        viewer=viewer,
        pictures_beside=viewer is not None,
    )


def text_report(found: Findings) -> str:
    """Return report.txt: no dates and hosts, so that two reports can be compared."""
    return "\n".join([text(page(found)), *wrapped(CONVENTIONS, behind=0), ""])


def _tiles(f: Findings) -> Iterator[Tile]:
    """Yield the figures that a reader sees first."""
    result, a = f.result, f.result.adjustment
    for one in f.calibrated[:2]:
        values, sigmas, within, projection = words_of_calibration(one)
        yield Tile(f"Camera {one.name}", values, f"1 sigma {sigmas}; 95 % {within}", wide=True)
        rms = f"{significant(one.projection_rms_px)} px"
        yield Tile(f"Projection uncertainty of {one.name}", rms, projection)
    yield Tile("Photographs oriented", f"{len(a.network.images)} of {result.images_total}")
    coded = int((result.code >= 0).sum())
    yield Tile("Object points", len(result.code), f"{coded} coded, {len(result.code) - coded} uncoded")
    if not f.calibrated:
        yield _precision_tile(f)
    yield Tile("RMS residual", f"{fixed(a.rms_px, 4)} px", "per image coordinate")
    sigma0, times = words_of_sigma0(f.sigma0)
    yield Tile("Sigma0", sigma0, f"{times}, redundancy {a.redundancy}")
    if f.comparison:
        both, left_out = f.comparison.both, words_left_out(f)
        better = both.better
        note = f"with {', '.join(better.free)} free" if better else "image points alone"
        if left_out and not better:
            note += f", {left_out}"
        outcome = "fits better" if both.agree and better else both.outcome
        yield Tile(program_name(both.backend), outcome, note)


def _precision_tile(f: Findings) -> Tile:
    typical = float(f.precision.rms[3])
    if not typical > 0:
        return Tile("Precision of a point", "fixed" if f.precision.fixed_points else "not known")
    factor, unit = finer_unit(f.result.length_unit, typical)
    without = words_of_fixed(f.precision)
    return Tile(
        "Precision of a point",
        f"{significant(typical * factor)} {unit}",
        f"1 sigma, RMS of sX, sY, sZ{f' {without}' if without else ''}; 95 %: "
        f"{significant(NORMAL_95 * typical * factor)} {unit}; 1 : {f.object_size / typical:,.0f} of the "
        "object",
    )


def worked(report: Report) -> Section:
    """Return whether the survey worked: photographs, adjustment, rank, observations."""
    f, a, result = report.f, report.a, report.f.result
    counts, failed = f.counts, result.failed
    oriented = f"{len(a.network.images)} of {result.images_total} oriented"
    exterior, interior, points = a.unknown_counts
    expected = (
        "as expected" if a.defect == a.expected_defect else f"expected {a.expected_defect}, see the remarks"
    )
    datum = a.datum
    if a.datum_points is not None:
        datum = f"{datum} on {counted(int(a.datum_points.sum()), 'chosen point')}"
    state = facts(
        [
            ("Photographs", f"{oriented}, {len(failed)} failed (below)" if failed else oriented),
            ("Image points", result.image_point_counts),
            ("Adjustment", f"{'converged' if a.converged else 'did NOT converge'}, {a.steps}"),
            ("Datum", f"{datum}; rank defect of the normal equations {a.defect}, {expected}"),
            (
                "Unknowns",
                f"{a.unknowns} ({exterior} exterior orientation, {interior} interior, {points} points)",
            ),
            ("Redundancy", str(a.redundancy)),
            *(("Cannot be determined", words) for words in a.undetermined),
        ]
    )
    rows = (
        ("image coordinates", counts.image),
        ("coordinates of control with a standard deviation", counts.control),
        ("parameters of exterior orientation", counts.exterior),
        ("parameters of interior orientation", counts.interior),
        ("scale bars", counts.scale_bars),
        ("further observations", counts.further),
    )
    observed = Table(
        columns("observations", ">number"), [row for row in rows if row[1]], total=("all", counts.total)
    )
    fixes = agreeing(counts.constraints, "fixes|fix")
    besides = f"Besides, {counted(counts.constraints, 'constraint')} {fixes} the datum."
    lost = Table(
        columns("photograph", "reason"),
        [(one.image, one.reason.text) for one in failed],
        all_in="left_out.csv",
    )
    return Section(
        "Did it work?",
        *_calibrated(f),
        *(state, Heading("Observations"), observed, Paragraph(besides) if counts.constraints else None),
        *((Heading("Photographs that are not in the result"), lost) if failed else ()),
        report.plot("network"),
        key="worked",
    )


def _calibrated(f: Findings) -> Iterator[Part]:
    """Yield the cameras where they are the result."""
    if f.calibrated:
        rows = []
        for one in f.calibrated:
            values, sigmas, within, projection = words_of_calibration(one)
            rows += [(one.name, f"{values}; 1 sigma {sigmas}; 95 % {within}"), ("projection", projection)]
        yield Heading("Calibrated cameras")
        yield facts(rows)


def quality(report: Report) -> Section:
    """Return how good the survey is."""
    f = report.f
    photographs = Heading("Photographs")
    return Section(
        "How good is it?",
        *(*quality_of.precision_parts(f), report.plot("precision")),
        *quality_of.geometry_parts(f),
        *quality_of.given_values_parts(f),
        *(*quality_of.image_point_parts(f), report.plot("distribution"), report.plot("residuals")),
        *quality_of.largest_residual_parts(f),
        *(*quality_of.camera_parts(f), report.plot("projection")),
        *(photographs, report.plot("photographs"), *quality_of.component_parts(f)),
        key="quality",
    )


def rejected(report: Report) -> Section:
    """Return what was rejected or left out, and why."""
    f, a, result = report.f, report.a, report.f.result
    parts: list[Part] = []
    found, total = f.rejected.points, len(a.rejected)
    if found:
        parts.append(
            Paragraph(
                f"{len(found)} of {total} image points were rejected in the adjustment "
                f"({fixed(100 * f.rejected.share, 1)} %). Their residuals are too long for their standard "
                f"deviations; they took no part in the result. Rejection: {f.protocol.limits}."
            )
        )
        heads = (
            *columns("photograph", "point"),
            *axes("", "px", ".2f", parts="xy"),
            *axes("v", "px", "+.3f", parts="xy"),
            Column("length", "", "px", ".3f"),
        )
        rows = [(one.image, one.point, *one.xy, *one.v, one.length) for one in found]
        parts.append(Table(heads, rows, most=MAX_LISTED, all_in="image_points.csv"))
        rays = [
            (one.point, f"{len(one.images)} of {one.rays}", ", ".join(one.images))
            for one in f.protocol.rejected
        ]
        by_point = Table(columns("point", "rays", "photographs"), rows=rays, all_in="image_points.csv")
        parts.append(Folded("Rejected rays by point", by_point, in_text=True))
    else:
        words = f"None of the {total} image points was rejected in the adjustment."
        parts.append(Paragraph(f"{words} Rejection: {f.protocol.limits}."))
    if result.left_out:
        seen = sum(one.image_points for one in result.left_out)
        lost = [(one.point, one.image_points, one.reason.text) for one in result.left_out]
        parts += [
            Heading("Measured points that are not in the result"),
            Paragraph(f"{counted(len(lost), 'point')} with {counted(seen, 'image point')}."),
            Table(columns("point", ">image points", "reason"), lost, most=MAX_LISTED, all_in="left_out.csv"),
        ]
    if result.no_circles:
        why = "uncoded points were left out, their outlines are not the images of a circle in space:"
        words = f"{len(result.no_circles)} {why} {', '.join(result.no_circles)}"
        parts += [Heading("Points that are not circles"), Paragraph(words)]
    if f.rejected.candidates:
        parts.append(_candidates(f))
    return Section("What was rejected, and why?", *parts, key="rejected")


def _candidates(f: Findings) -> Folded:
    reasons = f.rejected.reasons
    note = Note(
        "Blobs that might have been targets and were not measured, by reason, those most like targets first. "
        "Clutter in view makes many of them; the overlays show each."
    )
    heads = columns("photograph", ">measured", ">accepted in the result", *(f">{one}" for one in reasons))
    *rows, total = (
        (one.image, one.measured, one.accepted, *(one.reasons[reason] or "" for reason in reasons))
        for one in (*f.rejected.candidates, f.rejected.total)
    )
    return Folded("Candidates in the photographs", note, Table(heads, rows, total=total), open=True)


def comparison(report: Report) -> Section:
    """Return whether the other adjuster agrees."""
    found = report.f.comparison
    parts = (Paragraph("The survey asked for no comparison."),) if found is None else _compared(report, found)
    return Section("Does the other adjuster agree?", *parts, key="comparison", in_text=found is not None)


def _compared(report: Report, found: ComparisonFindings) -> Iterator[Part]:
    f, both, unit = report.f, found.both, report.f.result.length_unit
    d, name = both.comparison, program_name(both.backend)
    alike = " ".join(one.text for one in of_kind(f.verdict.remarks, "adjuster_fits_alike"))
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
        yield facts([("because", reason) for reason in found.reasons])
    left_out, models = words_left_out(f), " and ".join(found.survey_models)
    unchecked = f", and {name} does not check what is left out here" if left_out else ""
    yield Paragraph(
        f"Both adjusters had the {len(both.network.image_points)} accepted image points alone, with equal "
        "weights, in a free datum and in the camera model "
        f"{both.model}{f', {left_out}' if left_out else ''}. The survey itself is another adjustment: its "
        f"RMS residual is {fixed(report.a.rms_px, 4)} px with its weights in {models}{unchecked}. One "
        "solution is brought onto the other by shift, rotation and scale before anything is compared."
    )
    rms, cost = ([write(one) for one in pair] for write, pair in ((_nine, d.rms_px), (_general, d.cost)))
    ends = [(one and "yes") or "no" for one in (both.adjustment.converged, both.backend_converged)]
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
        ("interior orientation, in the photograph", scientific(found.max_interior_px, 2), "px", ""),
    )
    yield Table(columns("largest difference", ">value", "unit", ">of the object size"), largest)
    yield Heading("Precision of the points")
    factor, finer = finer_unit(unit, found.marginal.largest)
    sigmas = (
        ("Kolinear: everything adjusted is uncertain (marginal)", found.marginal),
        ("Kolinear: photographs and cameras held (conditional)", found.conditional),
        (f"{name}: photographs, cameras held (conditional)", found.backend_conditional),
    )
    precision = [
        (words, *(significant(factor * value, 4) for value in (one.rms, one.largest)), finer)
        for words, one in sigmas
        if one
    ]
    yield Table(columns("standard deviation of a coordinate", ">RMS", ">largest", "unit"), precision)
    yield Note(
        "With photographs and cameras held, what is uncertain of them is missing: only the marginal standard "
        f"deviations are those of the whole adjustment. {name} gives the conditional ones alone. They are of "
        "the compared adjustment, with its sigma0."
    )
    if found.converted:
        yield Heading("Cameras written in another model")
        heads = (Column("misfit RMS", "", "px", ".4f"), Column("largest", "", "px", ".4f"))
        converted = [
            (one.camera.name, one.source_model, one.camera.model, one.rms_px, one.max_px)
            for one in found.converted
        ]
        yield Table((*columns("camera", "from", "to"), *heads), converted)
        yield Note(
            "The misfit is the part of the survey's model that the other model cannot reproduce. It is the "
            "same for both adjusters and does not affect the result of the survey."
        )
    if both.held:
        yield Note(
            "The distortion was held at the survey's result in both adjusters, since the image points do not "
            f"determine all of it in this model: {', '.join(both.held)}."
        )
    if both.unshared:
        yield Note(
            f"{name} shares all parameters of a camera among photographs or none. Held at the survey's "
            f"result in both adjusters were therefore: {'; '.join(both.unshared)}."
        )
    if both.freed:
        yield Note(f"Free in the comparison besides the survey's parameters: {'; '.join(both.freed)}.")


def _nine(value: float) -> str:
    return fixed(value, 9)


def _general(value: float) -> str:
    return general(value, 9)


def baseline(report: Report) -> Section:
    """Return how another pipeline does on the photographs alone; nothing where the survey does not ask."""
    found, unit = report.f.result.baseline, report.f.result.length_unit
    if found is None:
        return Section("")
    name = found.name
    factor, finer = finer_unit(unit, found.point_rms)
    point, most, centre, most_centre, sigma = (
        significant(factor * one)
        for one in (
            *(found.point_rms, found.max_point, found.position_rms, found.max_position),
            float(report.f.precision.rms[3]),
        )
    )
    words = Paragraph(
        f"{name} oriented {found.photographs[1]} of {found.total} photographs from their natural texture "
        f"alone, Kolinear {found.photographs[0]} from the survey's points. Brought onto the survey by "
        f"shift, rotation and scale, its orientations put {found.targets} points of the survey {point} "
        f"{finer} (RMS of a coordinate) from where the survey has them; the survey's standard deviation is "
        f"{sigma} {finer}."
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
    heads = columns("difference after the similarity", ">RMS of a coordinate", ">largest", "unit")
    note = Note(
        f"The survey's accepted image points were intersected with the orientations and camera of {name}, so "
        "that the same points are compared. It knows no scale."
    )
    both = Table(columns("", ">Kolinear", f">{name}", "unit"), rows)
    return Section(f"And {name} by itself?", words, both, Table(heads, apart), note, key="baseline")


def coordinates(report: Report) -> Section:
    """Return where the coordinates are: the files of the folder, the object points, the orientations."""
    f, result, unit = report.f, report.f.result, report.f.result.length_unit
    corrected = "; corrected for eccentricity (the circle's centre)" if result.eccentricity else ""
    files = [
        ("points.csv", f"object points: X, Y, Z and standard deviations [{unit}], rays, code, angle, RMS"),
        (
            "images.csv",
            f"exterior orientation: X, Y, Z [{unit}], omega, phi, kappa [deg], standard deviations, points, "
            "RMS, coverage",
        ),
        ("cameras.csv", "interior orientation with standard deviations and units"),
        (
            "image_points.csv",
            f"image points [px], (0, 0) is the centre of the top-left pixel; residuals; rejected{corrected}",
        ),
        (
            "left_out.csv",
            "photographs and points that were measured and are not in the result, with the reason",
        ),
        (
            "given.csv",
            "control, scale bars, interior and exterior orientation that took part: given value, difference, "
            "standard deviation, redundancy number, w",
        ),
        (
            "reliability.csv",
            "of every image coordinate: residual [px], redundancy number, w, tau, minimal detectable bias "
            "[px], external reliability [sigmas of an unknown]",
        ),
        ("variance_components.csv", "sigma0 of kinds of observation, cameras and photographs"),
        ("points.ply", f"the object points as a point cloud [{unit}]"),
        ("report.txt", "the bundle report as plain text"),
        ("summary.json", "the figures of this page for programs"),
    ]
    if result.comparison and report.has_model:
        words = (
            f"the solution that was compared, in COLMAP's camera model ({result.comparison.model}): free "
            "datum, equal weights, without control and scale bars; the survey's result is above"
        )
        files.append(("colmap/", words))
    points, photographs = _object_points(f), _exterior(f)
    return Section(
        "Where are my coordinates?",
        *(
            Paragraph("In the folder of this report:"),
            facts([(Link(name, name), words) for name, words in files]),
        ),
        Folded(counted(len(f.points), "object point"), points, open=len(f.points) <= MAX_OPEN),
        Folded(f"Exterior orientation of {counted(len(f.photographs), 'photograph')}", photographs),
        key="coordinates",
        in_text=False,
    )


def _object_points(f: Findings) -> Table:
    unit = f.result.length_unit
    rows = [
        (
            *(one.name, *map(to_precision, one.xyz, one.sigma), *one.sigma, one.rays),
            *("" if one.code is None else one.code, one.angle_deg, one.rms_px),
        )
        for one in f.points
    ]
    heads = (
        *(Column("point"), *axes("", unit, str), *axes("s", unit, or_fixed), *columns(">rays", ">code")),
        *(Column("angle", "", "deg", "z.1f"), Column("RMS", "", "px", "z.3f")),
    )
    return Table(heads, rows, all_in="points.csv")


def _exterior(f: Findings) -> Table:
    unit, angles = f.result.length_unit, ("omega", "phi", "kappa")
    rows = [
        (
            one.name,
            *map(to_precision, one.values, one.sigma),
            *one.sigma,
            one.points,
            one.rms_px,
            one.coverage,
        )
        for one in f.photographs
    ]
    heads = (
        *(Column("photograph"), *axes("", unit, str), *(Column(name, "", "deg", str) for name in angles)),
        *axes("s", unit),
        *(Column(f"s {name}", "", "deg", significant) for name in angles),
        *(*columns(">points"), Column("RMS", "", "px", "z.4f"), Column("coverage", "", "%", "z.0f", 100.0)),
    )
    return Table(heads, rows, all_in="images.csv")


def photographs(report: Report) -> Section:
    """Return small pictures of the photographs with what was measured in them, leading to the large ones."""
    f, overlays, images = report.f, report.overlays, report.a.network.images
    if not overlays:
        none = Paragraph("The survey began with image points, there are no photographs to show.")
        return Section("The photographs", none, key="photographs", in_text=False)
    edges = ""
    if f.edges:
        edges = (
            " Edges: median standard deviation of the edges of targets, by lens, focus, motion and pixels."
        )
    legend = Paragraph(
        "Green: accepted targets with their names; red: rejected in the adjustment; blue: measured, but "
        "not part of the result; yellow: residual vectors, enlarged; crosses: candidates that were not "
        f"measured, coloured by reason. A click opens the photograph in full size.{edges}"
    )
    cards = []
    for one in overlays[:MAX_LISTED]:
        words = "not in the result"
        if one.image in images:
            i = images.index(one.image)
            points = counted(int(f.geometry.image_points[i]), "point")
            words = f"{points}, RMS {fixed(f.geometry.image_rms_px[i], 3)} px"
        if one.image in f.edges:
            words += f", edges {fixed(f.edges[one.image], 2)} px"
        cards.append(Card(f"overlays/{one.file_name}", one.thumbnail, one.image, words))
    others = [(Link(one.image, f"overlays/{one.file_name}"),) for one in overlays[MAX_LISTED:]]
    without = f"The other {len(others)} photographs, without a small picture here"
    more = Folded(without, Table(columns("photograph"), others)) if others else None
    return Section("The photographs", legend, Cards(cards), more, key="photographs", in_text=False)


def process(report: Report) -> Section:
    """Return how it was done: settings, times, corrections, conventions."""
    result = report.f.result
    written = datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
    times = [(one.stage, one.seconds) for one in result.seconds]
    settings = facts([("Written", f"{written} by Kolinear {version('kolinear')}"), *result.settings])
    seconds = Table(
        (Column("stage"), Column("seconds", format=".2f")),
        times,
        total=("all", float(np.sum([time for _, time in times]))),
    )
    eccentricity = None
    if found := result.eccentricity:
        eccentricity = Paragraph(
            "Eccentricity: the centre of an ellipse is not the picture of the circle's centre. Image "
            f"points were corrected by {fixed(found.rms_px, 4)} px RMS per coordinate, "
            f"{fixed(found.largest_px, 4)} px at most; the correction has a standard deviation of "
            f"{fixed(found.sigma_px, 5)} px, which is part of theirs."
        )
    parts = (settings, seconds, eccentricity, Note(CONVENTIONS))
    return Section("How it was done", *parts, key="process", in_text=False)


SECTIONS: tuple[Callable[[Report], Section], ...] = (
    *(worked, quality, rejected, comparison, baseline),
    *(coordinates, photographs, process),
)
"""The sections of the report, in their order."""
