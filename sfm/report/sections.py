"""The sections of the report, each an answer to one question of a surveyor."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

from sfm.report.geometry import image_rms
from sfm.report.markup import (
    data_url,
    file_url,
    significant,
    table,
    to_precision,
)
from sfm.report.overlays import Overlay
from sfm.report.section_statistics import observations
from sfm.report.statistics import datum_in_words
from sfm.report.tables import (
    image_rows,
    point_rows,
)
from sfm.report.verdict import Verdict
from sfm.result import SurveyResult

MAX_POINT_ROWS = 2000


def worked_section(result: SurveyResult, verdict: Verdict) -> str:
    """Did it work: what was oriented, whether it converged, what failed, warnings."""
    a = result.adjustment
    rows = [
        (
            "Photographs",
            f"{len(a.network.images)} of {result.images_total} oriented"
            + (f", {len(result.failed)} failed (below)" if result.failed else ""),
        ),
        ("Adjustment", f"{'converged' if a.converged else 'did NOT converge'} in {a.steps}"),
        (
            "Datum",
            f"{datum_in_words(a)}; rank defect of the normal equations {a.defect}, expected "
            f"{a.expected_defect}" + ("" if a.defect == a.expected_defect else " - see the warnings"),
        ),
        (
            "Equations",
            f"{a.observations} observations, {a.unknowns} unknowns, redundancy {a.redundancy}",
        ),
    ]
    if a.undetermined:
        rows.append(("Cannot be determined", ", ".join(a.undetermined)))
    text = table(("", ""), rows, plain_first=True, head=False)
    text += observations(result)
    if result.failed:
        text += "<h3>Photographs that are not in the result</h3>" + table(
            ("photograph", "reason"), [(f.image, f.reason) for f in result.failed]
        )
    if result.warnings:
        text += "<h3>Warnings</h3><ul>" + "".join(f"<li>{escape(w)}</li>" for w in result.warnings) + "</ul>"
    return text


def coordinates_section(result: SurveyResult, *, has_model: bool) -> str:
    """Where are my coordinates: the files, and the coordinates themselves.

    Args:
        result: the result.
        has_model: whether the folder holds the compared solution as a COLMAP model.
    """
    unit = result.length_unit
    listed = [
        ("points.csv", f"object points: X, Y, Z and standard deviations [{unit}], rays, code, angle, RMS"),
        (
            "images.csv",
            f"exterior orientation: X, Y, Z [{unit}], omega, phi, kappa [deg], standard deviations, points, "
            "RMS, coverage",
        ),
        ("cameras.csv", "interior orientation with standard deviations and units"),
        (
            "image_points.csv",
            "image points [px], (0, 0) is the centre of the top-left pixel; residuals; rejected"
            + ("" if result.eccentricity is None else "; corrected for eccentricity (the circle's centre)"),
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
        ("report.txt", "the bundle report on one page of plain text"),
        ("summary.json", "the figures of this page for programs"),
    ]
    if result.comparison is not None and has_model:
        what = (
            f"the solution that was compared, in COLMAP's camera model ({result.comparison.model}): free "
            "datum, equal weights, without control and scale bars; the survey's own result is above"
        )
        listed.append(("colmap/", what))
    text = "<p>In the folder of this report:</p><table>"
    for name, what in listed:
        text += f'<tr><th scope=row><a href="{name}">{name}</a></th><td>{escape(what)}</td></tr>'
    text += "</table>"
    rows = [
        (str(row[0]), *(to_precision(v, s) for v, s in zip(row[1:4], row[4:7], strict=True)),
         *(significant(float(str(s))) for s in row[4:7]), *_of_point(row[7:]))
        for row in _first(point_rows(result), MAX_POINT_ROWS)
    ]  # fmt: skip
    header = ("point", *(f"{c} [{unit}]" for c in ("X", "Y", "Z", "sX", "sY", "sZ")))
    header = (*header, "rays", "code", "angle [deg]", "RMS [px]")
    text += (
        f"<details{' open' if len(rows) <= 60 else ''}><summary>{len(result.code)} object points</summary>"
    )
    text += table(header, rows) + "</details>"
    images = [
        (
            str(row[0]),
            *(to_precision(v, s) for v, s in zip(row[1:7], row[7:13], strict=True)),
            *(significant(float(str(s))) for s in row[7:13]),
            str(row[14]),
            f"{float(str(row[15])):.4f}",
            f"{100 * float(str(row[16])):.0f}",
        )
        for row in _first(image_rows(result.adjustment), MAX_POINT_ROWS)
    ]
    angles = ("omega", "phi", "kappa")
    header = (
        "photograph",
        *(f"{c} [{unit}]" for c in "XYZ"),
        *(f"{c} [deg]" for c in angles),
        *(f"s{c} [{unit}]" for c in "XYZ"),
        *(f"s {c} [deg]" for c in angles),
        "points",
        "RMS [px]",
        "coverage [%]",
    )
    text += f"<details><summary>Exterior orientation of {len(images)} photographs</summary>"
    return text + table(header, images) + "</details>"


def _of_point(cells: Sequence[object]) -> tuple[str, str, str, str]:
    """Write rays, code, intersection angle and RMS of a point."""
    rays, code, angle, rms = cells
    return str(rays), str(code), f"{float(str(angle)):.1f}", f"{float(str(rms)):.3f}"


def photographs_section(result: SurveyResult, overlays: Sequence[Overlay]) -> str:
    """The photographs with what was found in them."""
    if not overlays:
        return "<p>The survey began with image points, there are no photographs to show.</p>"
    rms, count = image_rms(result.adjustment)
    known = {name: (rms[i], count[i]) for i, name in enumerate(result.adjustment.network.images)}
    cards = []
    for overlay in overlays:
        if overlay.image in known:
            r, n = known[overlay.image]
            note = f"{int(n)} points, RMS {r:.3f} px"
        else:
            note = "not in the result"
        cards.append(
            f'<figure><a href="overlays/{file_url(overlay.file_name)}">'
            f'<img loading=lazy alt="overlay of {escape(overlay.image)}" '
            f'src="{data_url(overlay.thumbnail, "jpeg")}"></a>'
            f"<figcaption><b>{escape(overlay.image)}</b> {escape(note)}</figcaption></figure>"
        )
    return (
        "<p>Green: accepted targets with their names; red: rejected in the adjustment; blue: measured, but "
        "not part of the result; yellow: residual vectors, enlarged; crosses: candidates that were not "
        "measured, coloured by reason. A click opens the photograph in full size.</p>"
        f"<div class=cards>{''.join(cards)}</div>"
    )


def process_section(result: SurveyResult) -> str:
    """How it was done: time of each stage, and the conventions of all numbers."""
    total = sum(time.seconds for time in result.seconds)
    rows = [(time.stage, f"{time.seconds:.2f}") for time in result.seconds]
    rows.append(("all", f"{total:.2f}"))
    return (
        table(("stage", "seconds"), rows, last_bold=True)
        + _eccentricity(result)
        + (
            "<p class=note>Pixel frame: (0, 0) is the centre of the top-left pixel, x to the right, y down. "
            "Rotation: R = Rx(omega) Ry(phi) Rz(kappa) turns image axes (x right, y up, looking along -z) "
            "into object axes. "
            "Residuals are computed minus measured. A sigma is one standard deviation.</p>"
        )
    )


def _eccentricity(result: SurveyResult) -> str:
    """How the centres of ellipses became those of circles."""
    found = result.eccentricity
    if found is None:
        return ""
    return (
        "<p>Eccentricity: the centre of an ellipse is not the picture of the circle's centre. Image points "
        f"were corrected by {found.rms_px:.4f} px RMS per coordinate, {found.largest_px:.4f} px at most; the "
        f"correction has a standard deviation of {found.sigma_px:.5f} px, which is part of theirs.</p>"
    )


def _first(rows: Iterable[Sequence[object]], count: int) -> list[Sequence[object]]:
    return [row for _, row in zip(range(count), rows, strict=False)]
