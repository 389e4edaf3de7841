"""The sections of the report, each an answer to one question of a surveyor."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

import numpy as np

from sfm.report.markup import (
    data_url,
    file_url,
    finer_unit,
    raised,
    signed,
    significant,
    table,
    to_precision,
    with_exponent,
    yes_or_no,
)
from sfm.report.overlays import Overlay
from sfm.report.result import SurveyResult
from sfm.report.tables import (
    image_rms,
    image_rows,
    parameter_sigmas,
    point_rows,
    point_sigmas,
    root_mean_square,
)
from sfm.report.verdict import Verdict

MAX_REJECTED_ROWS = 60
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
        ("Adjustment", f"{'converged' if a.converged else 'did NOT converge'} in {a.iterations} iterations"),
        (
            "Datum",
            f"{a.datum}; rank defect of the normal equations {a.defect}, expected {a.expected_defect}"
            + ("" if a.defect == a.expected_defect else " - see the warnings"),
        ),
        (
            "Equations",
            f"{a.observations} observations, {a.unknowns} unknowns, redundancy {a.redundancy}",
        ),
    ]
    if a.undetermined:
        rows.append(("Cannot be determined", ", ".join(a.undetermined)))
    text = table(("", ""), rows, plain_first=True, head=False)
    if result.failed:
        text += "<h3>Photographs that are not in the result</h3>" + table(
            ("photograph", "reason"), [(f.image, f.reason) for f in result.failed]
        )
    if result.warnings:
        text += "<h3>Warnings</h3><ul>" + "".join(f"<li>{escape(w)}</li>" for w in result.warnings) + "</ul>"
    return text


def quality_section(result: SurveyResult, pictures: dict[str, str]) -> str:
    """How good is it: precision of points, check at control, image coordinates, cameras."""
    a = result.adjustment
    sigma = point_sigmas(a)
    limiting = np.sqrt(np.einsum("nii->ni", a.covariance.points_limiting))
    factor, unit = finer_unit(result.length_unit, float(np.nanmax(sigma)))
    text = "<h3>Object points</h3>"
    text += table(
        (f"standard deviation [{unit}]", "X", "Y", "Z", "all"),
        [
            (name, *(significant(value * factor) for value in (*columns, over_all)))
            for name, columns, over_all in (
                ("RMS", np.sqrt(np.nanmean(sigma**2, axis=0)), root_mean_square(sigma)),
                ("largest", np.nanmax(sigma, axis=0), np.nanmax(sigma)),
                (
                    "RMS if the cameras were free of error",
                    np.sqrt(np.nanmean(limiting**2, axis=0)),
                    root_mean_square(limiting),
                ),
            )
        ],
    )
    text += (
        "<p class=note>Standard deviations are a posteriori and in the datum of the adjustment "
        f"({escape(a.datum)}); in a free network they say how the points lie to one another, not in an outer "
        "frame.</p>"
    )
    text += _control(result)
    text += "<h3>Image coordinates</h3>"
    text += table(
        ("", "px"),
        [
            ("sigma0, a posteriori standard deviation of a coordinate", f"{a.sigma0_px:.5f}"),
            ("RMS residual per coordinate", f"{a.rms_px:.5f}"),
            ("longest residual vector among the accepted", f"{a.max_residual_px:.4f}"),
            ("mean redundancy number (0 none, 1 full control)", f"{np.nanmean(a.redundancy_numbers):.3f}"),
        ],
    )
    text += pictures.get("distribution", "") + pictures.get("residuals", "")
    text += "<h3>Cameras</h3>"
    for index, camera in enumerate(a.estimate.cameras):
        s = parameter_sigmas(a, index)
        rows = [
            (
                name,
                *with_exponent(value, s[k]),
                raised(unit),
                f"{abs(value) / s[k]:.1f}" if np.isfinite(s[k]) and s[k] > 0 else "",
            )
            for k, (name, value, unit) in enumerate(
                zip(camera.names, camera.parameters, camera.units, strict=True)
            )
            if camera.free[k] or value != 0
        ]
        width, height = camera.size_px
        text += (
            f"<h4>{escape(camera.name)}</h4><p class=note>model {escape(camera.model)}, {width} x "
            f"{height} px of {camera.pixel_mm[0] * 1e3:.5g} x {camera.pixel_mm[1] * 1e3:.5g} &micro;m</p>"
        )
        text += table(("parameter", "value", "sigma", "unit", "value / sigma"), rows)
    text += "<h3>Photographs</h3>" + pictures.get("photographs", "")
    return text


def _control(result: SurveyResult) -> str:
    """Return the differences at control that took no part, nothing if there is none."""
    check = result.control_check
    if check is None:
        return ""
    factor, unit = finer_unit(result.length_unit, float(np.abs(check.differences).max()))
    rows = [
        (name, *(signed(v) for v in d), significant(float(np.linalg.norm(d))))
        for name, d in zip(check.points, check.differences * factor, strict=True)
    ]
    rms = check.rms * factor
    rows.append(("RMS", *(significant(v) for v in rms), significant(float(np.linalg.norm(rms)))))
    return (
        "<h3>Check at the control</h3><p class=note>The control took no part in the adjustment. The result "
        f"was placed on it afterwards by shift, rotation and scale ({check.scale:.9g}); what remains at each "
        f"point, placed minus nominal [{escape(unit)}]:</p>"
        + table(("control point", "dX", "dY", "dZ", "length"), rows)
    )


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
    notes = [
        f"{conversion.camera.name}: {conversion.source_model} written as {both.model} differs by "
        f"{conversion.rms_px:.4f} px RMS, {conversion.max_px:.4f} px at most"
        for conversion in both.conversions
        if conversion.source_model != both.model
    ]
    notes += [f"free in the comparison besides the survey's own: {line}" for line in both.freed]
    return text + "".join(f"<p class=note>{escape(note)}</p>" for note in notes)


def coordinates_section(result: SurveyResult) -> str:
    """Where are my coordinates: the files, and the coordinates themselves."""
    unit = result.length_unit
    listed = [
        ("points.csv", f"object points: X, Y, Z and standard deviations [{unit}], number of rays, code"),
        (
            "images.csv",
            f"exterior orientation: X, Y, Z [{unit}], omega, phi, kappa [deg], standard deviations",
        ),
        ("cameras.csv", "interior orientation with standard deviations and units"),
        (
            "image_points.csv",
            "image points [px], (0, 0) is the centre of the top-left pixel; residuals; rejected",
        ),
        ("points.ply", f"the object points as a point cloud [{unit}]"),
        ("summary.json", "the figures of this page for programs"),
    ]
    if result.comparison is not None:
        listed.append(("colmap/", f"the solution in {result.comparison.model} as a COLMAP model"))
    text = "<p>In the folder of this report:</p><table>"
    for name, what in listed:
        text += f'<tr><th scope=row><a href="{name}">{name}</a></th><td>{escape(what)}</td></tr>'
    text += "</table>"
    rows = [
        (str(row[0]), *(to_precision(v, s) for v, s in zip(row[1:4], row[4:7], strict=True)),
         *(significant(float(str(s))) for s in row[4:7]), str(row[7]), str(row[8]))
        for row in _first(point_rows(result), MAX_POINT_ROWS)
    ]  # fmt: skip
    header = ("point", *(f"{c} [{unit}]" for c in ("X", "Y", "Z", "sX", "sY", "sZ")), "rays", "code")
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
    )
    text += f"<details><summary>Exterior orientation of {len(images)} photographs</summary>"
    return text + table(header, images) + "</details>"


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
    return table(("stage", "seconds"), rows, last_bold=True) + (
        "<p class=note>Pixel frame: (0, 0) is the centre of the top-left pixel, x to the right, y down. "
        "Rotation: R = Rx(omega) Ry(phi) Rz(kappa) turns image axes (x right, y up, looking along -z) into "
        "object axes. "
        "Residuals are computed minus measured. A sigma is one standard deviation.</p>"
    )


def _first(rows: Iterable[Sequence[object]], count: int) -> list[Sequence[object]]:
    return [row for _, row in zip(range(count), rows, strict=False)]
