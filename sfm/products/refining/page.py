"""The page of a COLMAP model before and after refinement, with standard deviations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sfm.judgement.bundle_statistics import given_of
from sfm.judgement.checks import standard_deviations
from sfm.model.conventions import IntArray
from sfm.model.display import counted
from sfm.model.remarks.verdict import judge
from sfm.products.refining.oriented_windows import PREFIX
from sfm.products.refining.refinement import MAX_SHIFT_FACTOR, MIN_SHIFT_PX, Refinement
from sfm.products.refining.windows import MIN_RAYS
from sfm.report.given_residuals import given_parts
from sfm.report.network_geometry import rms_of_groups
from sfm.report.page import Column, Note, Page, Paragraph, Part, Section, Table, axes, columns, file_columns
from sfm.report.phrases import general, significant


@dataclass(frozen=True)
class Numbers:
    """Identifiers in the files of a model, and its interior orientation in COLMAP's terms."""

    image_ids: tuple[int, ...]  # of each photograph
    point_ids: tuple[int, ...]  # of each point
    interior: tuple[tuple[object, ...], ...]  # camera, model, parameter, before, after, sigma; NaN: held
    written: int = 0  # key points with a point in the written files
    written_px: float = 0.0  # their RMS per coordinate as COLMAP computes it


def describe_key_points(refinement: Refinement, numbers: Numbers) -> str:
    """Return the line on the RMS that COLMAP finds in the files, which exceeds the adjusted RMS."""
    if not refinement.better:
        as_they_came = counted(numbers.written, "key point")
        return (
            f"in the files  {numbers.written_px:.4f} px, {as_they_came} as they came; sigma_cameras.csv is "
            "of these, sigma_images.csv and sigma_points.csv of those measured anew"
        )
    kept = numbers.written - refinement.refined
    return (
        f"in the files  {numbers.written_px:.4f} px, including {counted(kept, 'unchanged key point')} of "
        f"points not measured anew in {MIN_RAYS} photographs"
    )


def page(refinement: Refinement, *, numbers: Numbers, title: str) -> Page:
    """Return the page: changes, unused key points, targets, cameras and photographs.

    Args:
        refinement: the model before and after refinement.
        numbers: identifiers and interior orientation in its files.
        title: title of the page, such as the folder of the model.
    """
    px = significant(refinement.before_px), significant(refinement.after_px)
    figures = f"RMS of the key points {px[0]} px before, {px[1]} px after"
    bad = f"Not dependable: {figures}"
    unit = "object units" if refinement.targets is None else refinement.targets.unit
    names = [numbers.point_ids[j] for j in np.flatnonzero(refinement.points)]
    return Page(
        "refinement",
        "Refinement of a COLMAP model",
        title,
        judge(refinement.remarks, {"good": figures, "fair": figures, "bad": bad}),
        (
            Section("Before and after", *_changes(refinement, numbers, unit)),
            Section("Key points that took no part", *_reasons(refinement)),
            Section("Targets, control and scale bars", *_targets(refinement, unit)),
            Section("Cameras", *_cameras(refinement, numbers)),
            Section("Photographs", *_photographs(refinement, numbers, unit)),
        ),
        files=(_coordinates(refinement, "point3D_id", names, np.arange(len(names)), "sigma_points"),),
    )


def _changes(refinement: Refinement, numbers: Numbers, unit: str) -> tuple[Part, ...]:
    heads = columns("", ">as it came", ">adjusted here", ">measured anew")
    control = ""
    if refinement.adjustment.datum == "control":
        control = ", those after refinement in the datum of the control"
    in_files = (
        " The files contain the key points measured anew, and the unchanged key points of points that could "
        f"not be measured anew in {MIN_RAYS} photographs. COLMAP finds their RMS in the files."
    )
    if not refinement.better:
        in_files = " No file contains the key points measured anew."
    note = Note(
        "Adjusted here: the key points of the model as they came, in an adjustment with inner constraints "
        "and without rejection. Measured anew: by least squares matching with windows of "
        f"{refinement.window_px} px. Points whose windows do not overlap are adjusted; the others are "
        f"intersected afterwards. Standard deviations are in the datum of inner constraints{control}, and "
        "scaled by sigma0 of the same column." + in_files
    )
    return Table(heads, _sizes(refinement, numbers, unit)), note


def _reasons(refinement: Refinement) -> tuple[Part, ...]:
    """Return the reasons why key points were not used."""
    if not refinement.reasons:
        return (Paragraph("None."),)
    heads = (Column("why"), Column("key points", format=str), Column("of all", "", "%", "z.1f"))
    return (
        Table(
            heads, [(why, count, 100 * count / refinement.key_points) for why, count in refinement.reasons]
        ),
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


def _targets(refinement: Refinement, unit: str) -> tuple[Part, ...]:
    """Return the targets that were adjusted with the key points, and the given values."""
    if refinement.targets is None:
        return ()
    after = refinement.adjustment
    given = given_of(after, unit)
    names = [after.network.points[j].removeprefix(PREFIX) for j in refinement.target_points]
    datum = "datum of the control" if after.datum == "control" else "datum of inner constraints"
    note = Note(
        f"Measured in the photographs in addition to the key points, and adjusted with them, in the {datum}. "
        "targets.csv contains the same with all digits. COLMAP's files do not contain them, since its mapper "
        "requires key points as they are in its database."
    )
    table = _coordinates(refinement, "target", names, refinement.target_points, "targets", unit)
    return *given_parts(given, after, unit), table, note


def _cameras(refinement: Refinement, numbers: Numbers) -> tuple[Part, ...]:
    pairs = [
        pair for camera in refinement.start.cameras for pair in zip(camera.names, camera.units, strict=True)
    ]
    unit = {name: "" if unit == "1" else f" [{unit}]" for name, unit in pairs}
    heads = (
        Column("camera", "camera_id"),
        Column("model", "model"),
        Column("parameter"),
        Column(None, "parameter"),
        Column("before", "before", format=".8g"),
        Column("after", "after", format=".8g"),
        Column("sigma", "sigma", format=significant, unknown="held"),
    )
    rows = [
        (camera, model, f"{name}{unit[str(name)]}", name, *values)
        for camera, model, name, *values in numbers.interior
    ]
    own = "" if refinement.better or not numbers.written else "After: by the key points in the files. "
    note = Note(
        f"{own}COLMAP's parameters, with pixel coordinates from the corner of the photograph. Held: not "
        "estimated, because of --fix, because it was 0, or as cx or cy of a camera with few photographs. "
        "Sigma: one standard deviation."
    )
    return Table(heads, rows, "sigma_cameras"), note


def _sizes(refinement: Refinement, numbers: Numbers, unit: str) -> list[tuple[object, ...]]:
    """Return the rows of the comparison: name, before, adjusted here, measured anew."""
    readjusted = refinement.readjusted
    adjustments = (readjusted, refinement.adjustment)
    names = (
        f"Projection centre: median standard deviation [{unit}]",
        "Rotation: median standard deviation [mdeg]",
        f"Point: median standard deviation of a coordinate [{unit}]",
    )
    sigmas, shared = [], []
    for adjusted in adjustments:
        C, correlation = adjusted.covariance, adjusted.error_correlation
        parts = (C.exterior[:, :3, :3], np.degrees(1e3) ** 2 * C.exterior[:, 3:, 3:], C.points)
        variances = [np.einsum("nii->n", Q) / 3 for Q in parts]  # per coordinate
        known = [of_part[of_part > 0] for of_part in variances]  # else rounding hides them
        sigmas.append(
            [significant(float(np.sqrt(np.median(of_part)))) if len(of_part) else "none" for of_part in known]
        )
        shared.append(
            "none" if correlation is None else significant(correlation.sigmas_px(adjusted.sigma0_px)[1])
        )
    medians = [(name, "", *each) for name, *each in zip(names, *sigmas, strict=True)]
    rms = [
        general(px, 4)
        for px in (refinement.before_px, *(adjusted.rms_px for adjusted in adjustments), numbers.written_px)
    ]
    rows: list[tuple[object, ...]] = [
        ("RMS of key points, per coordinate [px]", *rms[:3]),
        ("sigma0 [px]", "", *(general(adjusted.sigma0_px, 4) for adjusted in adjustments)),
        ("Errors that neighbours share [px]", "", *shared),
        *medians,
        ("Photographs", len(refinement.images), *(len(adjusted.network.images) for adjusted in adjustments)),
        ("Points", len(refinement.points), len(readjusted.network.points), refinement.points_anew.sum()),
        ("Points whose windows do not overlap, adjusted", "", "", refinement.points.sum()),
        ("Key points with a point", refinement.key_points, (~readjusted.rejected).sum(), refinement.refined),
    ]
    if refinement.better:
        kept = numbers.written - refinement.refined
        rows += [
            ("Key points with a point in the files", refinement.key_points, "", numbers.written),
            ("of these, unchanged", refinement.key_points, "", kept),
            ("RMS of the key points in the files, per coordinate [px]", rms[0], "", rms[3]),
        ]
    elif numbers.written:
        rows += [
            ("Key points with a point in the files", refinement.key_points, numbers.written, ""),
            ("RMS of the key points in the files, per coordinate [px]", rms[0], rms[3], ""),
        ]
    return [*rows, ("Targets", "", "", len(refinement.target_points))] if refinement.targets else rows


def _photographs(refinement: Refinement, numbers: Numbers, unit: str) -> tuple[Part, ...]:
    """Return the photographs with standard deviations and residuals; NaN if they were not adjusted."""
    seen, a, m = refinement.model.image_points, refinement.adjustment, len(refinement.images)
    used = ~a.rejected
    used[len(refinement.rows) :] = False  # targets
    after = np.full(m, np.nan)
    seen_anew = a.network.image_points.image[used]
    after[refinement.images] = rms_of_groups(seen_anew, a.residuals[used], int(refinement.images.sum()))
    sigma = np.full((m, 6), np.nan)
    sigma[refinement.images] = standard_deviations(a.covariance.exterior)
    sigma[:, 3:] = np.degrees(sigma[:, 3:])
    centre = ("X0", "Y0", "Z0")
    sigmas = [Column(f"sigma {name}", f"s{name}", unit, significant, unknown="") for name in centre]
    heads = (
        Column(None, "image_id"),
        Column("photograph", "name"),
        *file_columns(*centre),
        *sigmas,
        *file_columns("somega_deg", "sphi_deg", "skappa_deg"),
        Column("sigma rotation", "", "mdeg", significant, 1000.0, unknown=""),
        Column("key points", "key_points", format=str),
        Column("measured anew", "measured_anew", format=str),
        Column("RMS before", "rms_before_px", "px", significant, unknown=""),
        Column("RMS after", "rms_after_px", "px", significant, unknown="not adjusted"),
    )
    rows = [
        (number, name, *X0, *s, rotation, *others)
        for number, name, X0, s, rotation, *others in zip(
            numbers.image_ids,
            refinement.model.images,
            refinement.estimate.position,
            sigma,
            np.sqrt((sigma[:, 3:] ** 2).mean(axis=1)),
            np.bincount(seen.image, minlength=m),
            np.bincount(seen.image[refinement.accepted], minlength=m),
            rms_of_groups(seen.image, refinement.residuals_before, m),
            after,
            strict=True,
        )
    ]
    note = Note(
        "Sigma X0, Y0, Z0: of the projection centre. sigma_images.csv beside this page contains the same "
        "with all digits; sigma_points.csv and sigma_cameras.csv contain those of points and cameras."
    )
    return Table(heads, rows, "sigma_images"), note


def _coordinates(
    refinement: Refinement, name: str, names: Sequence[object], points: IntArray, file: str, unit: str = ""
) -> Table:
    """Return name, coordinates, standard deviations and rays of some points of the adjustment."""
    a = refinement.adjustment
    rays = np.bincount(a.network.image_points.point[~a.rejected], minlength=len(a.network.points))
    sigma = standard_deviations(a.covariance.points[points])
    sigmas = [Column(f"sigma {axis}", f"s{axis}", unit, significant) for axis in "XYZ"]
    heads = (
        Column(name, name),
        *axes("", unit, ".9g"),
        *sigmas,
        Column("photographs", "rays", format=str),
    )
    xyz = a.estimate.points[points]
    rows = [(n, *at, *s, r) for n, at, s, r in zip(names, xyz, sigma, rays[points], strict=True)]
    return Table(heads, rows, file)
