"""The report of a survey, in the order of a surveyor's questions.

Each section is a function and a row of SECTIONS.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from importlib.metadata import version

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.files.result_tables import LEFT_OUT
from sfm.judgement.survey_result import sort_likeliest_first
from sfm.model.conventions import angles_from_rotation
from sfm.model.display import agreeing, counted, program_name
from sfm.report import survey_quality as quality_of
from sfm.report.figures.overlays import Overlay
from sfm.report.figures.plot_data import Plot
from sfm.report.findings import Findings
from sfm.report.page import (
    Card,
    Cards,
    Column,
    FoldedParts,
    Heading,
    Link,
    Note,
    Page,
    Paragraph,
    Part,
    Section,
    Table,
    Tile,
    axes,
    columns,
    columns_of,
    facts,
    tested_section,
)
from sfm.report.pages import text, wrapped
from sfm.report.phrases import (
    NORMAL_95,
    describe_calibration,
    describe_fixed,
    describe_sigma0,
    describe_view,
    finer_unit,
    fixed,
    or_fixed,
    significant,
    to_precision,
    with_exponent,
    words_left_out,
)
from sfm.report.survey_comparison import adjuster_parts, pipeline_parts
from sfm.report.tables.csv_files import left_out_rows, table_stems
from sfm.report.viewer.embedded import Viewer

MAX_LISTED = 60  # rejected points and thumbnails on the page
MAX_OPEN = 60  # object points that are shown without a click
CONVENTIONS = (
    "Pixel frame: (0, 0) is the centre of the top-left pixel, x to the right, y down. Rotation: "
    "R = Rx(omega) Ry(phi) Rz(kappa) turns image axes (x right, y up, looking along -z) into object axes. "
    "Residuals are computed minus measured. A sigma is one standard deviation, a posteriori; w and minimal "
    "bias use the standard deviations behind the weights."
)


@dataclass(frozen=True)
class Report:
    """The content of the sections of a report."""

    f: Findings
    plots: Sequence[Plot]
    overlays: Sequence[Overlay]
    has_model: bool

    @property
    def a(self) -> Adjustment:
        """The adjustment."""
        return self.f.result.adjustment

    def plot(self, stem: str) -> Plot | None:
        """Return a plot by the stem of its file name; None if there is none."""
        return next((plot for plot in self.plots if plot.stem == stem), None)


def page(
    findings: Findings,
    *,
    plots: Sequence[Plot] = (),
    overlays: Sequence[Overlay] = (),
    has_model: bool = False,
    viewer: Viewer | None = None,
) -> Page:
    """Return the report of a survey.

    Args:
        findings: the findings of the result.
        plots: pictures of the adjustment.
        overlays: annotated photographs; links lead to the folder of overlays.
        has_model: whether the folder contains the compared solution as a COLMAP model.
        viewer: the scene of the 3D viewer, whose pictures may be files beside the page; None omits it.
    """
    report = Report(findings, plots, overlays, has_model)
    return Page(
        "report",
        "Survey report",
        findings.result.survey,
        findings.verdict,
        tuple(section(report) for section in SECTIONS),
        tuple(_tiles(findings)),
        viewer=viewer,
        pictures_beside=viewer is not None,
    )


def text_report(findings: Findings) -> str:
    """Return the text of report.txt, without dates and hosts so that two reports can be compared."""
    files = f"Tables (.csv): {', '.join(table_stems(findings))}."
    return "\n".join([text(page(findings)), *wrapped(CONVENTIONS, behind=0), *wrapped(files, behind=0), ""])


def _tiles(f: Findings) -> Iterator[Tile]:
    """Yield the key figures at the top of the page."""
    result, a = f.result, f.result.adjustment
    for camera in f.calibrated[:2]:
        values, sigmas, within, projection = describe_calibration(camera)
        note = "; ".join(filter(None, (f"1 sigma {sigmas}; 95 % {within}", describe_view(f, camera.name))))
        yield Tile(f"Camera {camera.name}", values, note, wide=True)
        rms = f"{significant(camera.projection_rms_px)} px"
        yield Tile(f"Projection uncertainty of {camera.name}", rms, projection)
    for rig in f.rigs[:1]:
        for mount in rig.mounts[:2]:
            base, sigma = with_exponent(mount.base, mount.base_sigma)
            unit = result.length_unit
            at = f"{mount.camera} from {rig.reference}, 1 sigma {sigma} {unit}"
            yield Tile(f"Base of rig {rig.name}", f"{base} {unit}", at)
    yield Tile("Photographs oriented", f"{len(a.network.images)} of {result.images_total}")
    yield Tile("Object points", len(result.code), result.point_counts)
    if not f.calibrated:
        yield _precision_tile(f)
    yield Tile("RMS residual", f"{fixed(a.rms_px, 4)} px", "per image coordinate")
    sigma0, times = describe_sigma0(f.sigma0)
    yield Tile("Sigma0", sigma0, f"{times}, redundancy {a.redundancy}")
    if adjusters := result.comparison:
        left_out, better = words_left_out(f), adjusters.better
        note = f"with {', '.join(better.free)} free" if better else "image points alone"
        if left_out and not better:
            note += f", {left_out}"
        outcome = "fits better" if adjusters.agree and better else adjusters.outcome
        yield Tile(program_name(adjusters.backend), outcome, note)


def _precision_tile(f: Findings) -> Tile:
    typical = float(f.precision.rms[3])
    if not typical > 0:
        return Tile("Precision of a point", "fixed" if f.precision.fixed_points else "not known")
    factor, unit = finer_unit(f.result.length_unit, typical)
    without = describe_fixed(f.precision)
    return Tile(
        "Precision of a point",
        f"{significant(typical * factor)} {unit}",
        f"1 sigma, RMS of sX, sY, sZ{f' {without}' if without else ''}; 95 %: "
        f"{significant(NORMAL_95 * typical * factor)} {unit}; 1 : {f.object_size / typical:,.0f} of the "
        "object",
    )


def worked(report: Report) -> Section:
    """Return the section on whether the survey worked: photographs, adjustment, rank, observations."""
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
    undetermined = [("Cannot be determined", words) for words in a.undetermined]
    state = facts(
        [
            ("Photographs", f"{oriented}, {len(failed)} failed (below)" if failed else oriented),
            ("Image points", result.image_point_counts),
            ("Adjustment", f"{'converged' if a.converged else 'did NOT converge'}, {a.steps}"),
            ("Datum", f"{datum}; rank defect of the normal equations {a.defect}, {expected}"),
            (
                "Unknowns",
                f"{a.unknowns} (exterior orientation {exterior}, interior {interior}, points {points})",
            ),
            ("Redundancy", str(a.redundancy)),
            *undetermined,
        ]
    )
    rows = (
        ("image coordinates", counts.image),
        ("control coordinates with a standard deviation", counts.control),
        ("parameters of exterior orientation", counts.exterior),
        ("parameters of interior orientation", counts.interior),
        ("scale bars", counts.scale_bars),
        ("further observations", counts.further),
    )
    observed = Table(
        columns("observations", ">number"), [row for row in rows if row[1]], total=("all", counts.total)
    )
    fixes = agreeing(counts.constraints, "fixes|fix")
    besides = f"In addition, {counted(counts.constraints, 'constraint')} {fixes} the datum."
    calibrated: tuple[Part, ...] = ()
    if f.calibrated:  # the cameras are the result of the survey
        of_cameras = []
        for camera in f.calibrated:
            values, sigmas, within, projection = describe_calibration(camera)
            of_cameras.append((camera.name, f"{values}; 1 sigma {sigmas}; 95 % {within}"))
            of_cameras.append(("projection", projection))
            if view := describe_view(f, camera.name):
                of_cameras.append((f"view of {camera.name}", view))
        calibrated = (Heading("Calibrated cameras"), facts(of_cameras))
    lost: tuple[Part, ...] = ()
    if failed:
        lost = (Heading("Photographs not in the result"), left_out("photograph", f))
    return Section(
        "Did it work?",
        *calibrated,
        state,
        Heading("Observations"),
        observed,
        Paragraph(besides) if counts.constraints else None,
        *lost,
        report.plot("network"),
        key="worked",
    )


def left_out(kind: str, f: Findings) -> Table:
    """Return the photographs or points that are not in the result, with the reason, as in left_out.csv."""
    rows = [row for row in left_out_rows(f.result) if row[0] == kind]
    shown = {"name": Column(kind), "reason": Column("reason")}
    if kind == "point":
        shown["image_points"] = Column("image points", format=str)
    return Table(columns_of(LEFT_OUT, shown), rows, most=MAX_LISTED, all_in=LEFT_OUT.file)


def quality(report: Report) -> Section:
    """Return the section on the quality of the survey."""
    f = report.f
    photographs = Heading("Photographs")
    return Section(
        "How good is it?",
        *quality_of.precision_parts(f),
        report.plot("precision"),
        *quality_of.geometry_parts(f),
        *quality_of.given_values_parts(f),
        *quality_of.image_point_parts(f),
        report.plot("distribution"),
        report.plot("residuals"),
        *quality_of.largest_residual_parts(f),
        *quality_of.camera_parts(f),
        report.plot("projection"),
        report.plot("epipolar"),
        photographs,
        report.plot("photographs"),
        *quality_of.component_parts(f),
        key="quality",
    )


def tested(report: Report) -> Section:
    """Return the section on what was tested."""
    return tested_section(report.f.verdict)


def rejected(report: Report) -> Section:
    """Return the section on rejected and omitted points, with the reasons."""
    f, a, result = report.f, report.a, report.f.result
    parts: list[Part] = []
    limits, rows = f"Rejection: {f.protocol.limits}.", np.flatnonzero(a.rejected)
    if len(rows):
        parts.append(
            Paragraph(
                f"Rejected in the adjustment: {len(rows)} of {len(a.rejected)} image points "
                f"({fixed(100 * len(rows) / len(a.rejected), 1)} %). Image points with residuals that are "
                f"too large for their standard deviations do not contribute to the result. {limits}"
            )
        )
        parts.append(_rejected_points(a))
    else:
        words = f"None of the {len(a.rejected)} image points was rejected in the adjustment."
        parts.append(Paragraph(f"{words} {limits}"))
    if result.left_out:
        seen = sum(point.image_points for point in result.left_out)
        lost = left_out("point", f)
        parts += [
            Heading("Measured points not in the result"),
            Paragraph(f"{counted(len(lost.rows), 'point')} with {counted(seen, 'image point')}."),
            lost,
        ]
    if result.no_circles:
        why = "uncoded points were left out because their outlines are not images of a circle in space:"
        words = f"{len(result.no_circles)} {why} {', '.join(result.no_circles)}"
        parts += [Heading("Points that are not circles"), Paragraph(words)]
    if result.photographs:
        parts.append(_candidates(f))
    return Section("What was rejected, and why?", *parts, key="rejected")


def _rejected_points(a: Adjustment) -> Table:
    """Return the rejected image points, the longest residual first."""
    seen, length = a.network.image_points, np.linalg.norm(a.residuals, axis=1)
    rows = np.flatnonzero(a.rejected)
    shown = [
        (
            a.network.images[seen.image[k]],
            a.network.points[seen.point[k]],
            *seen.xy[k],
            *a.residuals[k],
            length[k],
        )
        for k in rows[np.argsort(-np.nan_to_num(length[rows], nan=np.inf))]
    ]
    heads = (
        *columns("photograph", "point"),
        *axes("", "px", ".2f", parts="xy"),
        *axes("v", "px", "+.3f", parts="xy"),
        Column("length", "", "px", ".3f"),
    )
    return Table(heads, shown, most=MAX_LISTED, all_in="image_points.csv")


def _candidates(f: Findings) -> FoldedParts:
    """Return the counts of measured targets and of other candidates, by reason, in each photograph."""
    result = f.result
    used = dict(zip(f.result.adjustment.network.images, f.geometry.image_points.tolist(), strict=True))
    counts = {photograph.image: Counter(dict(photograph.reasons())) for photograph in result.photographs}
    every = sum(counts.values(), Counter[str]())
    reasons = sort_likeliest_first(every)
    rows = []
    for photograph in result.photographs:
        others = [counts[photograph.image][why] or "" for why in reasons]
        rows.append((photograph.image, len(photograph.xy), used.get(photograph.image, 0), *others))
    total = (
        "all",
        sum(len(photograph.xy) for photograph in result.photographs),
        sum(used.values()),
        *map(every.get, reasons),
    )
    note = Note(
        "Blobs that might have been targets but were not measured, by reason; the most target-like first. "
        "Clutter in view produces many of them. The overlays show each one."
    )
    heads = columns(
        "photograph", ">measured", ">accepted in the result", *(f">{reason}" for reason in reasons)
    )
    return FoldedParts("Candidates in the photographs", note, Table(heads, rows, total=total), open=True)


def coordinates(report: Report) -> Section:
    """Return the section with the coordinates: files of the folder, object points, exterior orientation."""
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
            "photographs and points that were measured but are not in the result, with the reason",
        ),
        (
            "given.csv",
            "given values that took part (control, scale bars, interior and exterior orientation): value, "
            "difference, standard deviation, redundancy number, w",
        ),
        (
            "reliability.csv",
            "for every image coordinate: residual [px], redundancy number, w, tau, minimal detectable bias "
            "[px], external reliability [sigmas of an unknown]",
        ),
        ("variance_components.csv", "sigma0 by kind of observation, by camera and by photograph"),
        ("points.ply", f"the object points as a point cloud [{unit}]"),
        ("report.txt", "the bundle report as plain text"),
        ("summary.json", "the numbers of this page, for other programs"),
    ]
    if result.comparison and report.has_model:
        words = (
            f"the compared solution in COLMAP's camera model ({result.comparison.model}): free datum, equal "
            "weights, no control or scale bars; the result of the survey is in the files above"
        )
        files.append(("colmap/", words))
    points, photographs = _object_points(f), _exterior(f)
    return Section(
        "Where are my coordinates?",
        Paragraph("In the folder of this report:"),
        facts([(Link(name, name), words) for name, words in files]),
        FoldedParts(counted(len(points.rows), "object point"), points, open=len(points.rows) <= MAX_OPEN),
        FoldedParts(f"Exterior orientation of {counted(len(photographs.rows), 'photograph')}", photographs),
        key="coordinates",
        in_text=False,
    )


def _object_points(f: Findings) -> Table:
    a, unit, g = f.result.adjustment, f.result.length_unit, f.geometry
    rows = [
        (name, *zip(xyz, sigma, strict=True), *sigma, rays, "" if code < 0 else code, angle, rms)
        for name, xyz, sigma, rays, code, angle, rms in zip(
            a.network.points,
            a.estimate.points,
            f.precision.points,
            g.rays,
            f.result.code,
            g.angle_deg,
            g.point_rms_px,
            strict=True,
        )
    ]
    heads = (
        Column("point"),
        *axes("", unit, _with_digits),
        *axes("s", unit, or_fixed),
        *columns(">rays", ">code"),
        Column("angle", "", "deg", "z.1f"),
        Column("RMS", "", "px", "z.3f"),
    )
    return Table(heads, rows, all_in="points.csv")


def _exterior(f: Findings) -> Table:
    a, unit, g = f.result.adjustment, f.result.length_unit, f.geometry
    angles = np.degrees(angles_from_rotation(a.estimate.rotation))
    of_photographs = zip(
        a.network.images,
        np.hstack([a.estimate.position, angles]),
        f.precision.exterior_deg,
        g.image_points,
        g.image_rms_px,
        g.hull,
        strict=True,
    )
    rows = [(n, *zip(X, s, strict=True), *s, *others) for n, X, s, *others in of_photographs]
    names = ("omega", "phi", "kappa")
    of_angles = [Column(name, "", "deg", _with_digits) for name in names]
    sigmas_of_angles = [Column(f"s {name}", "", "deg", significant) for name in names]
    heads = (
        Column("photograph"),
        *axes("", unit, _with_digits),
        *of_angles,
        *axes("s", unit),
        *sigmas_of_angles,
        *columns(">points"),
        Column("RMS", "", "px", "z.4f"),
        Column("coverage", "", "%", "z.0f", 100.0),
    )
    return Table(heads, rows, all_in="images.csv")


def _with_digits(pair: tuple[float, float]) -> str:
    """Write a coordinate or an angle to the second digit of its standard deviation."""
    return to_precision(*pair)


def photographs(report: Report) -> Section:
    """Return thumbnails of the photographs with their measured targets, linked to the full-size overlays."""
    f, overlays, images = report.f, report.overlays, report.a.network.images
    if not overlays:
        none = Paragraph("The survey started from image points, so there are no photographs to show.")
        return Section("The photographs", none, key="photographs", in_text=False)
    edges = ""
    if f.edges:
        edges = (
            " Edges: median blur of target edges (standard deviation), from lens, focus, motion and pixels."
        )
    legend = Paragraph(
        "Green: accepted targets with their names; red: rejected in the adjustment; blue: measured, but "
        "not part of the result; yellow: residual vectors, enlarged; crosses: candidates that were not "
        f"measured, coloured by reason. Click a picture to see it at full size.{edges}"
    )

    def describe(image: str) -> str:
        words = "not in the result"
        if image in images:
            i = images.index(image)
            points = counted(int(f.geometry.image_points[i]), "point")
            words = f"{points}, RMS {fixed(f.geometry.image_rms_px[i], 3)} px"
        return f"{words}, edges {fixed(f.edges[image], 2)} px" if image in f.edges else words

    parts = overlay_parts(overlays, describe)
    return Section("The photographs", legend, *parts, key="photographs", in_text=False)


def overlay_parts(overlays: Sequence[Overlay], describe: Callable[[str], str]) -> tuple[Part, ...]:
    """Return thumbnails of overlays that link to the large ones, and links to further ones.

    Args:
        overlays: the overlays.
        describe: returns the words below the thumbnail of a photograph, from its name.
    """
    cards = Cards(
        Card(f"overlays/{overlay.file_name}", overlay.thumbnail, overlay.image, describe(overlay.image))
        for overlay in overlays[:MAX_LISTED]
    )
    others = [(Link(overlay.image, f"overlays/{overlay.file_name}"),) for overlay in overlays[MAX_LISTED:]]
    without = f"{counted(len(others), 'further photograph')} without a thumbnail here"
    return (cards, FoldedParts(without, Table(columns("photograph"), others))) if others else (cards,)


def process(report: Report) -> Section:
    """Return the section on processing: settings, times, corrections, conventions."""
    result = report.f.result
    written = datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
    times = [(timed.stage, timed.seconds) for timed in result.seconds]
    settings = facts([("Written", f"{written} by Kolinear {version('kolinear')}"), *result.settings])
    seconds = Table(
        (Column("stage"), Column("seconds", format=".2f")),
        times,
        total=("all", float(np.sum([time for _, time in times]))),
    )
    eccentricity = None
    if corrected := result.eccentricity:
        eccentricity = Paragraph(
            "Eccentricity: the centre of an ellipse is not the image of the circle's centre. Image points "
            f"were corrected by {fixed(corrected.rms_px, 4)} px RMS per coordinate, "
            f"{fixed(corrected.largest_px, 4)} px at most. Their standard deviations include that of the "
            f"correction, {fixed(corrected.sigma_px, 5)} px."
        )
    parts = (settings, seconds, eccentricity, Note(CONVENTIONS))
    return Section("How it was done", *parts, key="process", in_text=False)


def comparison(report: Report) -> Section:
    """Return the section on the agreement with the other adjuster."""
    return Section("Does the other adjuster agree?", *adjuster_parts(report.f), key="comparison")


def baseline(report: Report) -> Section:
    """Return the section on another pipeline run on the photographs alone; empty if none was requested."""
    pipeline = report.f.result.baseline
    return Section(
        f"And {pipeline.name if pipeline else ''} by itself?", *pipeline_parts(report.f), key="baseline"
    )


SECTIONS: tuple[Callable[[Report], Section], ...] = (
    worked,
    quality,
    tested,
    rejected,
    comparison,
    baseline,
    coordinates,
    photographs,
    process,
)
"""The sections of the report, in their order."""
