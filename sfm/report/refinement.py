"""The page of a COLMAP model before and after refinement, with standard deviations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.conventions import IntArray
from sfm.display import counted
from sfm.judgement.bundle_statistics import given_of
from sfm.judgement.checks import rms_of_groups, standard_deviations
from sfm.remarks.verdict import judge
from sfm.report.given import given_parts
from sfm.report.page import Column, Note, Page, Paragraph, Part, Section, Table, axes
from sfm.report.phrases import general, significant
from sfm.survey.refining.oriented_windows import PREFIX
from sfm.survey.refining.refinement import MAX_SHIFT_FACTOR, MIN_SHIFT_PX, Refinement
from sfm.survey.refining.windows import MIN_RAYS


@dataclass(frozen=True)
class Numbers:
    """Identifiers in the files of a model, and its interior orientation in COLMAP's terms."""

    image_ids: tuple[int, ...]  # of each photograph
    point_ids: tuple[int, ...]  # of each point
    interior: tuple[tuple[object, ...], ...]  # camera, model, parameter, before, after, sigma; NaN: held
    written: int = 0  # key points with a point in the written files
    written_px: float = 0.0  # their RMS per coordinate as COLMAP computes it


def describe_key_points(found: Refinement, numbers: Numbers) -> str:
    """Return the line on the RMS that COLMAP finds in the files, which exceeds the adjusted RMS."""
    kept = numbers.written - found.refined
    return (
        f"in the files  {numbers.written_px:.4f} px, including {counted(kept, 'unchanged key point')} of "
        f"points not measured anew in {MIN_RAYS} photographs"
    )


def page(found: Refinement, *, numbers: Numbers, title: str) -> Page:
    """Return the page: changes, unused key points, targets, cameras and photographs.

    Args:
        found: the model before and after refinement.
        numbers: identifiers and interior orientation in its files.
        title: title of the page, such as the folder of the model.
    """
    px = significant(found.before_px), significant(found.after_px)
    figures = f"RMS of the key points {px[0]} px before, {px[1]} px after"
    bad = f"Not dependable: {figures}"
    unit = "object units" if found.targets is None else found.targets.unit
    return Page(
        "refinement",
        "Refinement of a COLMAP model",
        title,
        judge(found.remarks, {"good": figures, "fair": figures, "bad": bad}),
        (
            Section("Before and after", *_changes(found, numbers, unit)),
            Section("Key points that took no part", *_reasons(found)),
            Section("Targets, control and scale bars", *_targets(found, unit)),
            Section("Cameras", *_cameras(found, numbers)),
            Section("Photographs", *_photographs(found, numbers, unit)),
        ),
        files=(_points(found, numbers),),
    )


def _changes(found: Refinement, numbers: Numbers, unit: str) -> tuple[Part, ...]:
    columns = (
        Column(),
        *(Column(name, format=str) for name in ("as it came", "adjusted here", "measured anew")),
    )
    control = ""
    if found.adjustment.datum == "control":
        control = ", those after refinement in the datum of the control"
    note = Note(
        "Adjusted here: the key points of the model as they came, in an adjustment with inner constraints "
        f"and without rejection. Measured anew: by least squares matching with windows of {found.window_px} "
        "px. Points whose windows do not overlap are adjusted; the others are intersected afterwards. "
        f"Standard deviations are in the datum of inner constraints{control}, and scaled by sigma0 of the "
        "same column. The files contain the key points measured anew, and the unchanged key points of points "
        f"that could not be measured anew in {MIN_RAYS} photographs. COLMAP finds their RMS in the files."
    )
    return Table(columns, _sizes(found, numbers, unit)), note


def _reasons(found: Refinement) -> tuple[Part, ...]:
    """Return the reasons why key points were not used."""
    if not found.reasons:
        return (Paragraph("None."),)
    columns = (Column("why"), Column("key points", format=str), Column("of all", "", "%", "z.1f"))
    return (
        Table(columns, [(why, count, 100 * count / found.key_points) for why, count in found.reasons]),
        Note(
            f"Too far: farther from the model's key point than {general(MAX_SHIFT_FACTOR, 2)} times the "
            f"robust spread of the model's residuals (at least {general(MIN_SHIFT_PX, 2)} px). Outside: the "
            "window reaches beyond a photograph. Template of a point without a match: the window was found "
            "in no other photograph. Contradict the others: large residual in the adjustment. "
            "Diverged: no solution, or the window became degenerate."
        ),
        Note(
            "A key point that was not measured anew is detached from its point if enough others were, and "
            "stays in the model without a point. Points seen in fewer than three photographs keep their key "
            "points and are intersected anew."
        ),
    )


def _targets(found: Refinement, unit: str) -> tuple[Part, ...]:
    """Return the targets that were adjusted with the key points, and the given values."""
    if found.targets is None:
        return ()
    after = found.adjustment
    given = given_of(after, unit)
    names = [after.network.points[j].removeprefix(PREFIX) for j in found.target_points]
    datum = "datum of the control" if after.datum == "control" else "datum of inner constraints"
    note = Note(
        f"Measured in the photographs in addition to the key points, and adjusted with them, in the {datum}. "
        "targets.csv contains the same with all digits. COLMAP's files do not contain them, since its mapper "
        "requires key points as they are in its database."
    )
    table = _coordinates(found, "target", names, found.target_points, "targets", unit)
    return *given_parts(given, after, unit), table, note


def _cameras(found: Refinement, numbers: Numbers) -> tuple[Part, ...]:
    pairs = [pair for camera in found.start.cameras for pair in zip(camera.names, camera.units, strict=True)]
    unit = {name: "" if unit == "1" else f" [{unit}]" for name, unit in pairs}
    columns = (
        *(Column("camera", "camera_id"), Column("model", "model"), Column("parameter")),
        *(
            Column(None, "parameter"),
            Column("before", "before", format=".8g"),
            Column("after", "after", format=".8g"),
        ),
        Column("sigma", "sigma", format=significant, unknown="held"),
    )
    rows = [
        (camera, model, f"{name}{unit[str(name)]}", name, *values)
        for camera, model, name, *values in numbers.interior
    ]
    note = Note(
        "COLMAP's parameters, with pixel coordinates from the corner of the photograph. Held: not estimated, "
        "because of --fix, because it was 0, or as cx or cy of a camera with few photographs. Sigma: one "
        "standard deviation."
    )
    return Table(columns, rows, "sigma_cameras"), note


def _common_px(a: Adjustment) -> str:
    """Return the standard deviation of the error that neighbouring image points share, px."""
    found = a.error_correlation
    return "none" if found is None else significant(found.sigmas_px(a.sigma0_px)[1])


def _sizes(found: Refinement, numbers: Numbers, unit: str) -> list[tuple[object, ...]]:
    """Return the rows of the comparison: name, before, adjusted here, measured anew."""
    readjusted = found.readjusted
    both = (readjusted, found.adjustment)
    medians = (
        f"Projection centre: median standard deviation [{unit}]",
        "Rotation: median standard deviation [mdeg]",
        f"Point: median standard deviation of a coordinate [{unit}]",
    )
    rms = [general(px, 4) for px in (found.before_px, *(one.rms_px for one in both), numbers.written_px)]
    return [
        ("RMS of key points, per coordinate [px]", *rms[:3]),
        ("sigma0 [px]", "", *(general(one.sigma0_px, 4) for one in both)),
        ("Errors that neighbours share [px]", "", *map(_common_px, both)),
        *((name, "", *s) for name, *s in zip(medians, *map(_median_sigmas, both), strict=True)),
        ("Photographs", len(found.images), *(len(one.network.images) for one in both)),
        ("Points", len(found.points), len(readjusted.network.points), found.points_anew.sum()),
        ("Points whose windows do not overlap, adjusted", "", "", found.points.sum()),
        ("Key points with a point", found.key_points, (~readjusted.rejected).sum(), found.refined),
        ("Key points with a point in the files", found.key_points, "", numbers.written),
        ("of these, unchanged", found.key_points, "", numbers.written - found.refined),
        ("RMS of the key points in the files, per coordinate [px]", rms[0], "", rms[3]),
        *([("Targets", "", "", len(found.target_points))] if found.targets else []),
    ]


def _median_sigmas(one: Adjustment) -> list[str]:
    """Return median standard deviations per coordinate (RMS of three) of centres, rotations and points."""
    C = one.covariance
    parts = (C.exterior[:, :3, :3], np.degrees(1e3) ** 2 * C.exterior[:, 3:, 3:], C.points)
    return [significant(float(np.median(np.sqrt(np.einsum("nii->n", Q) / 3)))) for Q in parts]


def _photographs(found: Refinement, numbers: Numbers, unit: str) -> tuple[Part, ...]:
    """Return the photographs with standard deviations and residuals; NaN if they were not adjusted."""
    seen, a, m = found.model.image_points, found.adjustment, len(found.images)
    used = ~a.rejected
    used[len(found.rows) :] = False  # targets
    after = np.full(m, np.nan)
    seen_anew = a.network.image_points.image[used]
    after[found.images] = rms_of_groups(seen_anew, a.residuals[used], int(found.images.sum()))
    sigma = np.full((m, 6), np.nan)
    sigma[found.images] = standard_deviations(a.covariance.exterior)
    sigma[:, 3:] = np.degrees(sigma[:, 3:])
    columns = (
        *(Column(None, "image_id"), Column("photograph", "name")),
        *(Column(None, name) for name in ("X0", "Y0", "Z0")),
        *(Column(f"sigma {one}", f"s{one}", unit, significant, unknown="") for one in ("X0", "Y0", "Z0")),
        *(Column(None, name) for name in ("somega_deg", "sphi_deg", "skappa_deg")),
        Column("sigma rotation", "", "mdeg", significant, 1000.0, unknown=""),
        Column("key points", "key_points", format=str),
        Column("measured anew", "measured_anew", format=str),
        Column("RMS before", "rms_before_px", "px", significant, unknown=""),
        Column("RMS after", "rms_after_px", "px", significant, unknown="not adjusted"),
    )
    rows = [
        (number, name, *X0, *s, rotation, *others)
        for number, name, X0, s, rotation, *others in zip(
            *(numbers.image_ids, found.model.images, found.estimate.position, sigma),
            np.sqrt((sigma[:, 3:] ** 2).mean(axis=1)),
            np.bincount(seen.image, minlength=m),
            np.bincount(seen.image[found.accepted], minlength=m),
            *(rms_of_groups(seen.image, found.residuals_before, m), after),
            strict=True,
        )
    ]
    note = Note(
        "Sigma X0, Y0, Z0: of the projection centre. sigma_images.csv beside this page contains the same "
        "with all digits; sigma_points.csv and sigma_cameras.csv contain those of points and cameras."
    )
    return Table(columns, rows, "sigma_images"), note


def _points(found: Refinement, numbers: Numbers) -> Table:
    """Return the adjusted points, for a file."""
    names = [numbers.point_ids[j] for j in np.flatnonzero(found.points)]
    return _coordinates(found, "point3D_id", names, np.arange(len(names)), "sigma_points")


def _coordinates(
    found: Refinement, name: str, names: Sequence[object], points: IntArray, file: str, unit: str = ""
) -> Table:
    """Return name, coordinates, standard deviations and rays of some points of the adjustment."""
    a = found.adjustment
    rays = np.bincount(a.network.image_points.point[~a.rejected], minlength=len(a.network.points))
    sigma = standard_deviations(a.covariance.points[points])
    columns = (
        *(Column(name, name), *axes("", unit, ".9g")),
        *(Column(f"sigma {one}", f"s{one}", unit, significant) for one in "XYZ"),
        Column("photographs", "rays", format=str),
    )
    xyz = a.estimate.points[points]
    rows = [(n, *at, *s, r) for n, at, s, r in zip(names, xyz, sigma, rays[points], strict=True)]
    return Table(columns, rows, file)
