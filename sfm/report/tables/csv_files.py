"""The tables of a result: points, images, cameras, image points, what was left out, given values, tests.

Degrees in files, the object unit of the survey, sigmas are standard deviations a posteriori (those of image
points: as measured). Numbers are written with enough digits to give the same number back.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from sfm.adjustment.quality.reliability import UNCONTROLLED
from sfm.adjustment.result import Adjustment
from sfm.camera import base_name
from sfm.conventions import FloatArray
from sfm.distortion.balanced import BALANCED, UNITS, brown_by_balanced, from_balanced, to_balanced
from sfm.distortion.balanced import MODEL as BALANCED_MODEL
from sfm.errors import GeometryError
from sfm.files.plain_text import csv_text
from sfm.network import Network
from sfm.report.findings.bundle_statistics import Statistics
from sfm.report.findings.findings import Findings
from sfm.report.findings.given_residuals import Given
from sfm.result import SurveyResult
from sfm.solution import CONTROL_COVARIANCE, MEASURED

USUAL_R0 = 2 / 3  # of the largest image radius


def write_tables(findings: Findings, folder: Path) -> None:
    """Write all tables of a result into an existing folder; `summary.write_summary` adds the figures."""
    adjustment, statistics = findings.result.adjustment, findings.statistics
    for name, header, rows in (
        (
            *("points", "id,X,Y,Z,sX,sY,sZ,rays,code,angle_deg,rms_px,limiting_sX,limiting_sY,limiting_sZ"),
            point_rows(findings),
        ),
        (
            "images",
            "image,X,Y,Z,omega_deg,phi_deg,kappa_deg,sX,sY,sZ,somega_deg,sphi_deg,skappa_deg,camera,points,"
            "rms_px,coverage",
            photograph_rows(findings),
        ),
        ("cameras", "camera,parameter,value,sigma,unit", camera_rows(findings)),
        (
            "image_points",
            "image,point,x_px,y_px,sx_px,sy_px,cxy_px2,vx_px,vy_px,rejected",
            image_point_rows(adjustment),
        ),
        ("cameras_balanced", "camera,parameter,value,sigma,unit", balanced_rows(findings)),
        ("targets", "image,x_px,y_px,a_px,b_px,angle_deg,reason", target_rows(findings)),
        ("left_out", "kind,name,image_points,reason", left_out_rows(findings)),
        (
            "given",
            "kind,name,coordinate,unit,given,difference,sigma,r,w",
            given_rows(findings.given, findings.result),
        ),
        (
            "reliability",
            "image,point,vx_px,vy_px,rx,ry,wx,wy,taux,tauy,mdbx_px,mdby_px,extx,exty,weight,rejected,"
            "errorx_px,errory_px",
            reliability_rows(adjustment, statistics),
        ),
        ("variance_components", "kind,group,observations,redundancy,sigma0", component_rows(statistics)),
    ):
        if name == "cameras_balanced" and BALANCED_MODEL not in findings.interior.models:
            continue
        if name == "targets" and not len(findings.result.seen_targets.image):
            continue
        text = csv_text(header.split(","), rows)
        (folder / f"{name}.csv").write_text(text, encoding="utf-8", newline="")
    write_ply(folder / "points.ply", findings)


def point_rows(findings: Findings) -> Iterable[Sequence[object]]:
    """Return coordinates, sigmas, rays, code, intersection angle, RMS and limiting sigmas of every point."""
    for one in findings.points:
        seen = (one.rays, one.code, one.angle_deg, one.rms_px)
        yield (one.name, *one.xyz, *one.sigma, *seen, *one.limiting)


def photograph_rows(findings: Findings) -> Iterable[Sequence[object]]:
    """Return exterior orientation, sigmas, camera, number of points, RMS and coverage of every photograph."""
    for one in findings.photographs:
        yield (one.name, *one.values, *one.sigma, one.camera, one.points, one.rms_px, one.coverage)


def camera_rows(findings: Findings) -> Iterable[Sequence[object]]:
    """Return camera, parameter, value, sigma (empty where it was not adjusted) and unit."""
    cameras = findings.result.adjustment.estimate.cameras
    for camera, sigma in zip(cameras, findings.interior.sigmas, strict=True):
        for name, value, s, unit in zip(camera.names, camera.parameters, sigma, camera.units, strict=True):
            yield (camera.name, name, value, s, unit)


def balanced_rows(findings: Findings) -> Iterable[Sequence[object]]:
    """Return the cameras of model brown_forward in AICON's form, camera, parameter, value, sigma and unit.

    c is negative, as AICON writes it; sigma is empty where nothing of a value was adjusted. R0 is that of the
    survey file, else two thirds of the largest image radius, as is usual. A camera that has no such form, as
    with K4 or distortion that cannot be balanced there, has no rows.
    """
    given = dict(findings.result.balance_radius_mm)
    a = findings.result.adjustment
    for camera, own in zip(a.estimate.cameras, a.covariance.interior, strict=True):
        if camera.model != BALANCED_MODEL:
            continue
        half = float(np.hypot(*(np.array(camera.size_px) * camera.pixel_mm))) / 2
        R0 = given.get(base_name(camera.name, given), USUAL_R0 * half)
        try:
            rows = to_balanced(tuple(zip(camera.names, camera.parameters.tolist(), strict=True)), R0)
        except GeometryError:
            continue
        Q = np.zeros((len(camera.names), len(camera.names)))
        if len(own):
            Q[np.ix_(camera.free, camera.free)] = own
        order = [camera.names.index(name) for name, _ in from_balanced(rows)]
        inverse = np.linalg.inv(brown_by_balanced(rows))
        variance = np.diagonal(inverse @ Q[np.ix_(order, order)] @ inverse.T)
        sigma = np.where(variance > 0, np.sqrt(np.maximum(variance, 0.0)), np.nan)
        at_R0 = BALANCED.index("R0")
        for (name, value), s, unit in zip(rows, np.insert(sigma, at_R0, np.nan), UNITS, strict=True):
            yield (camera.name, name, -value if name == "c" else value, s, unit)


def image_point_rows(adjustment: Adjustment) -> Iterable[Sequence[object]]:
    """Return image, point, position, what was stated of it, residuals and 0 or 1 for rejected.

    Standard deviations and covariance are empty where there are none.
    """
    network = adjustment.network
    seen = network.image_points
    columns = (seen.xy, seen.stated_sigma, seen.stated_covariance, adjustment.residuals)
    for (x, y, sx, sy, sxy, vx, vy), (image, point), rejected in zip(
        np.column_stack(columns).tolist(), _names(network), adjustment.rejected.tolist(), strict=True
    ):
        yield image, point, x, y, sx, sy, sxy or None, vx, vy, int(rejected)


def target_rows(findings: Findings) -> Iterable[Sequence[object]]:
    """Return photograph, place and outline of every target, and why candidates were rejected.

    Rejected candidates have no outline; to 1e-4 px and 1e-3 deg, as they are shown.
    """
    result = findings.result
    seen, names = result.seen_targets, result.network.images
    angle_deg = np.rad2deg(seen.ellipse[:, 2:])
    rounded = np.hstack([np.round(seen.xy, 4), np.round(seen.ellipse[:, :2], 4), np.round(angle_deg, 3)])
    for image, row, reason in zip(seen.image.tolist(), rounded.tolist(), seen.reason, strict=True):
        yield (names[image], *row, reason or MEASURED)


def left_out_rows(findings: Findings) -> Iterable[Sequence[object]]:
    """Return kind, name, image points and reason of every photograph and point that is not in the result."""
    for failed in findings.result.failed:
        yield ("photograph", failed.image, None, failed.reason.text)
    for one in findings.result.left_out:
        yield ("point", one.point, one.image_points, one.reason.text)


def given_rows(given: Given, result: SurveyResult) -> Iterable[Sequence[object]]:
    """Return kind, name, coordinate, unit, given value, difference, sigma, r and w of every given value.

    Of control with correlated coordinates their covariances follow as values.
    """
    for kind in given.kinds:
        for one in kind.values:
            row = (one.name, one.coordinate, one.unit, one.given, one.difference, one.sigma, one.r, one.w)
            yield (kind.kind, *row)
    if result.adjustment.datum == "control":
        for name, pair, value in result.network.correlated_control():
            yield (CONTROL_COVARIANCE, name, pair, f"{result.unit}^2", value, None, None, None, None)


def reliability_rows(adjustment: Adjustment, statistics: Statistics) -> Iterable[Sequence[object]]:
    """Return the tests of every image point: residual, redundancy number, w, tau, smallest error, its effect.

    Empty cells: rejected image points have neither redundancy number nor reliability, and where the
    redundancy number is 0 no error is found.
    """
    network = adjustment.network
    a, found = adjustment, statistics.reliability
    tests = (a.residuals, a.redundancy_numbers, a.standardised, a.tau, found.minimal_bias, found.external)
    error = _gross_error(a.residuals, a.redundancy_numbers)
    for names, values, rejected, size in zip(
        _names(network),
        np.column_stack((*tests, a.weights)).tolist(),
        a.rejected.tolist(),
        error.tolist(),
        strict=True,
    ):
        yield (*names, *values, int(rejected), *size)


def _names(network: Network) -> Iterator[tuple[str, str]]:
    """Return photograph and point of every image point."""
    seen = network.image_points
    for image, point in zip(seen.image.tolist(), seen.point.tolist(), strict=True):
        yield network.images[image], network.points[point]


def _gross_error(v: FloatArray, r: FloatArray) -> FloatArray:
    """Return the size that an error would have, v / r, NaN where nothing checks it, px, (k, 2)."""
    checked = r > UNCONTROLLED
    return np.where(checked, v / np.where(checked, r, 1.0), np.nan)


def component_rows(statistics: Statistics) -> Iterable[Sequence[object]]:
    """Return the variance components of kinds of observation, cameras and photographs."""
    for kind, found in (
        ("kind", statistics.kinds),
        ("camera", statistics.cameras),
        ("photograph", statistics.photographs),
    ):
        for g, name in enumerate(found.names):
            yield (kind, name, int(found.count[g]), found.redundancy[g], found.sigma0[g])


def write_ply(path: Path, findings: Findings) -> None:
    """Write the object points as a PLY point cloud in text form: coded green, uncoded grey.

    Source: Turk, The PLY polygon file format (1994).
    """
    points = findings.points
    lines = [
        "ply",
        "format ascii 1.0",
        f"comment kolinear, {_ascii(findings.result.length_unit)}",
        f"element vertex {len(points)}",
        *(f"property double {axis}" for axis in "xyz"),
        *(f"property uchar {colour}" for colour in ("red", "green", "blue")),
        "end_header",
    ]
    for point in points:
        colour = "120 120 120" if point.code is None else "20 140 60"
        lines.append(" ".join(f"{value:.17g}" for value in point.xyz) + " " + colour)
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def _ascii(text: str) -> str:
    return text.encode("ascii", "replace").decode().replace("\n", " ").replace("\r", " ")
