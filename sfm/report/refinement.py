"""A model before and after refinement as a page, and its standard deviations as tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.conventions import FloatArray, IntArray
from sfm.display import agreeing, counted
from sfm.files.plain_text import csv_text
from sfm.remarks.remark import remark
from sfm.remarks.verdict import judge
from sfm.report.findings.given_residuals import given_of
from sfm.report.html.page import render
from sfm.report.numbers import general, significant
from sfm.survey.refining.refinement import MAX_SHIFT_FACTOR, MIN_SHIFT_PX, Refinement
from sfm.survey.refining.targets import PREFIX
from sfm.survey.refining.windows import MIN_RAYS

PAGE = "refinement.html"
POINT_COLUMNS = ("point3D_id", "X", "Y", "Z", "sX", "sY", "sZ", "rays")
IMAGE_COLUMNS = (
    *("image_id", "name", "X0", "Y0", "Z0", "sX0", "sY0", "sZ0"),
    *("somega_deg", "sphi_deg", "skappa_deg", "key_points", "measured_anew", "rms_before_px", "rms_after_px"),
)
TARGET_COLUMNS = ("target", "X", "Y", "Z", "sX", "sY", "sZ", "rays")
CAMERA_COLUMNS = ("camera_id", "model", "parameter", "before", "after", "sigma")


@dataclass(frozen=True)
class Numbers:
    """How the file of a model counts photographs and points, and its interior orientation in its terms."""

    image_ids: tuple[int, ...]  # of each photograph
    point_ids: tuple[int, ...]  # of each point
    interior: tuple[tuple[object, ...], ...]  # rows of CAMERA_COLUMNS, sigma NaN where held
    in_rigs: int = 0  # photographs that belong to rigs of several cameras
    written: int = 0  # key points with a point in the files
    written_px: float = 0.0  # their RMS per coordinate by COLMAP


def refinement_files(found: Refinement, numbers: Numbers, *, title: str) -> dict[str, str]:
    """Return the page and the tables by the names of their files.

    Args:
        found: the model before and after.
        numbers: as its file counts.
        title: of the page, such as the folder of the model.
    """
    images = image_rows(found, numbers)
    targets = {} if found.targets is None else {"targets.csv": csv_text(TARGET_COLUMNS, target_rows(found))}
    return targets | {
        "sigma_points.csv": csv_text(POINT_COLUMNS, _point_rows(found, numbers)),
        "sigma_images.csv": csv_text(IMAGE_COLUMNS, images),
        "sigma_cameras.csv": csv_text(CAMERA_COLUMNS, [[_blank(c) for c in row] for row in numbers.interior]),
        PAGE: _page(found, numbers, images, title),
    }


def words_of_key_points(found: Refinement, numbers: Numbers) -> str:
    """Return the line of the RMS that COLMAP finds in the files, and why it is larger than that adjusted."""
    kept = numbers.written - found.refined
    return (
        f"in the files  {numbers.written_px:.4f} px, with {counted(kept, 'key point')} as "
        f"{agreeing(kept, 'it|they')} came, of points not measured anew in {MIN_RAYS} photographs"
    )


def _page(found: Refinement, numbers: Numbers, images: list[list[object]], title: str) -> str:
    """Return the page."""
    after, before = found.adjustment, found.readjusted
    rigs = (remark("rigs_held_together", photographs=numbers.in_rigs),) if numbers.in_rigs else ()
    px = significant(found.before_px), significant(found.after_px)
    figures = f"RMS of the key points {px[0]} px before, {px[1]} px after"
    bad = f"Not dependable: {figures}"
    verdict = judge((*found.remarks, *rigs), {"good": figures, "fair": figures, "bad": bad})
    unit = "object units" if found.targets is None else found.targets.unit
    given = given_of(after, unit)
    return render(
        "refinement.html",
        title=title,
        unit=unit,
        given=given,
        targets=target_rows(found),
        headline=verdict.headline,
        level=verdict.level,
        remarks=verdict.lines,
        sizes=_sizes(found, numbers, unit),
        found=found,
        limits={"shift_px": MIN_SHIFT_PX, "shift_factor": MAX_SHIFT_FACTOR, "rays": MIN_RAYS},
        after=after,
        before=before,
        interior=numbers.interior,
        units=_units(found),
        images=images,
    )


def _units(found: Refinement) -> dict[str, str]:
    """Return what stands behind the name of each interior parameter: its unit in brackets, if it has one."""
    pairs = [pair for camera in found.start.cameras for pair in zip(camera.names, camera.units, strict=True)]
    return {name: "" if unit == "1" else f" [{unit}]" for name, unit in pairs}


def _common_px(a: Adjustment) -> str:
    """Return the standard deviation of what neighbouring image points err together, px."""
    found = a.error_correlation
    return "none" if found is None else significant(found.sigmas_px(a.sigma0_px)[1])


def _sizes(found: Refinement, numbers: Numbers, unit: str) -> list[tuple[str, ...]]:
    """Return rows of what the page compares: name, before, adjusted here, after."""
    both = (found.readjusted, found.adjustment)
    rows: list[tuple[str, ...]] = [
        (
            "RMS of key points, per coordinate [px]",
            general(found.before_px, 4),
            *(general(one.rms_px, 4) for one in both),
        ),
        ("sigma0 [px]", "", *(general(one.sigma0_px, 4) for one in both)),
        ("Errors that neighbours have in common [px]", "", *map(_common_px, both)),
    ]
    for name, of, factor in (
        (f"Projection centre: median standard deviation [{unit}]", _centre_sigmas, 1.0),
        ("Rotation: median standard deviation [mdeg]", _rotation_sigmas, 1000.0),
        (f"Point: median standard deviation of a coordinate [{unit}]", _point_sigmas, 1.0),
    ):
        rows.append((name, "", *(significant(factor * float(np.median(of(one)))) for one in both)))
    rows.append(("Photographs", str(len(found.images)), *(str(len(one.network.images)) for one in both)))
    points = (len(found.points), len(found.readjusted.network.points), int(found.points_anew.sum()))
    rows.append(("Points", *(str(one) for one in points)))
    rows.append(("Points whose windows do not overlap, adjusted", "", "", str(int(found.points.sum()))))
    used = (found.key_points, int((~found.readjusted.rejected).sum()), found.refined)
    rows.append(("Key points with a point", *(str(one) for one in used)))
    kept = numbers.written - found.refined
    rows.append(("Key points with a point in the files", rows[-1][1], "", str(numbers.written)))
    rows.append(("of these, as they came", rows[-1][1], "", str(kept)))
    rows.append(
        (
            "RMS of the key points in the files, per coordinate [px]",
            general(found.before_px, 4),
            "",
            general(numbers.written_px, 4),
        )
    )
    if found.targets is not None:
        rows.append(("Targets", "", "", str(len(found.target_points))))
    return rows


def _centre_sigmas(one: Adjustment) -> FloatArray:
    return _root_mean(one.covariance.exterior[:, :3, :3])


def _rotation_sigmas(one: Adjustment) -> FloatArray:
    return np.degrees(_root_mean(one.covariance.exterior[:, 3:, 3:]))


def _point_sigmas(one: Adjustment) -> FloatArray:
    return _root_mean(one.covariance.points)


def _root_mean(covariance: FloatArray) -> FloatArray:
    """Return the standard deviation of one coordinate, the mean of three, (n,)."""
    return np.asarray(np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 3))


def image_rows(found: Refinement, numbers: Numbers) -> list[list[object]]:
    """Return the rows of sigma_images.csv; empty cells of photographs that were not adjusted."""
    seen, accepted = found.model.image_points, found.accepted
    m = len(found.images)
    count = np.bincount(seen.image, minlength=m)
    anew = np.bincount(seen.image[accepted], minlength=m)
    before = _rms_of(found.residuals_before, seen.image, m)
    own = found.adjustment
    used = ~own.rejected
    after = np.full(m, np.nan)
    used[len(found.rows) :] = False  # targets
    after[found.images] = _rms_of(
        own.residuals[used], own.network.image_points.image[used], int(found.images.sum())
    )
    sigma = np.full((m, 6), np.nan)
    sigma[found.images] = np.sqrt(np.diagonal(own.covariance.exterior, axis1=1, axis2=2))
    sigma[:, 3:] = np.degrees(sigma[:, 3:])
    return [
        [
            numbers.image_ids[i],
            found.model.images[i],
            *(_blank(value) for value in (*found.estimate.position[i], *sigma[i])),
            int(count[i]),
            int(anew[i]),
            _blank(before[i]),
            _blank(after[i]),
        ]
        for i in range(m)
    ]


def _point_rows(found: Refinement, numbers: Numbers) -> list[list[object]]:
    """Return the rows of sigma_points.csv: the adjusted points."""
    names = [numbers.point_ids[j] for j in np.flatnonzero(found.points)]
    return _coordinates(found, names, np.arange(len(names)))


def target_rows(found: Refinement) -> list[list[object]]:
    """Return the rows of targets.csv: the adjusted targets, by their names."""
    rows = found.target_points
    names = [found.adjustment.network.points[j].removeprefix(PREFIX) for j in rows]
    return _coordinates(found, names, rows)


def _coordinates(found: Refinement, names: Sequence[object], points: IntArray) -> list[list[object]]:
    """Return name, coordinates, their standard deviations and rays of points of the adjustment."""
    own = found.adjustment
    rays = np.bincount(own.network.image_points.point[~own.rejected], minlength=len(own.network.points))
    sigma = np.sqrt(np.diagonal(own.covariance.points[points], axis1=1, axis2=2))
    xyz = own.estimate.points[points]
    return [
        [name, *at, *s, int(r)]
        for name, at, s, r in zip(names, xyz.tolist(), sigma.tolist(), rays[points].tolist(), strict=True)
    ]


def _rms_of(v: FloatArray, image: IntArray, m: int) -> FloatArray:
    """Return the RMS per coordinate of residuals (k, 2) of each photograph, NaN where there is none, (m,)."""
    known = np.isfinite(v).all(axis=1)
    count = np.bincount(image[known], minlength=m)
    squares = np.bincount(image[known], (v[known] ** 2).sum(axis=1), minlength=m)
    return np.asarray(np.sqrt(np.where(count > 0, squares / (2 * np.maximum(count, 1)), np.nan)))


def _blank(value: object) -> object:
    """Return a value, an empty text in place of what is not known."""
    return "" if isinstance(value, float) and not np.isfinite(value) else value
