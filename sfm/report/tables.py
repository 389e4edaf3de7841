"""The tables of a result: points, images, cameras, image points, given values, reliability, groups.

Degrees in files, the object unit of the survey, sigmas are standard deviations a posteriori (those of image
points: as measured). Numbers are written with enough digits to give the same number back.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.conventions import FloatArray, angles_from_rotation
from sfm.files.plain_text import csv_text
from sfm.report.geometry import geometry_of, image_rms
from sfm.report.given import given_rows
from sfm.report.statistics import Statistics, parameter_sigmas, statistics_of
from sfm.result import SurveyResult

UNCODED = -1


def write_tables(result: SurveyResult, folder: Path) -> None:
    """Write all tables of a result into a folder; `summary.write_summary` adds the figures.

    Args:
        result: the result.
        folder: an existing folder.
    """
    adjustment = result.adjustment
    _write_csv(folder / "points.csv", "id,X,Y,Z,sX,sY,sZ,rays,code,angle_deg,rms_px", point_rows(result))
    _write_csv(
        folder / "images.csv",
        "image,X,Y,Z,omega_deg,phi_deg,kappa_deg,sX,sY,sZ,somega_deg,sphi_deg,skappa_deg,camera,points,rms_px"
        ",coverage",
        image_rows(adjustment),
    )
    _write_csv(folder / "cameras.csv", "camera,parameter,value,sigma,unit", camera_rows(adjustment))
    _write_csv(
        folder / "image_points.csv",
        "image,point,x_px,y_px,sx_px,sy_px,vx_px,vy_px,rejected",
        image_point_rows(adjustment),
    )
    _write_csv(
        folder / "given.csv", "kind,name,coordinate,unit,given,difference,sigma,r,w", given_rows(result)
    )
    statistics = statistics_of(result)
    _write_csv(
        folder / "reliability.csv",
        "image,point,vx_px,vy_px,rx,ry,wx,wy,taux,tauy,mdbx_px,mdby_px,extx,exty,weight,rejected",
        reliability_rows(adjustment, statistics),
    )
    _write_csv(
        folder / "variance_components.csv",
        "kind,group,observations,redundancy,sigma0",
        component_rows(statistics),
    )
    write_ply(folder / "points.ply", result)


def point_rows(result: SurveyResult) -> Iterable[Sequence[object]]:
    """Return id, X, Y, Z, sX, sY, sZ, accepted rays, code, intersection angle and RMS of every point."""
    adjustment = result.adjustment
    found = geometry_of(adjustment)
    sigma = point_sigmas(adjustment)
    for j, name in enumerate(adjustment.network.points):
        code = "" if result.code[j] == UNCODED else int(result.code[j])
        own = (int(found.rays[j]), code, found.angle_deg[j], found.point_rms_px[j])
        yield (name, *adjustment.estimate.points[j], *sigma[j], *own)


def image_rows(adjustment: Adjustment) -> Iterable[Sequence[object]]:
    """Return exterior orientation, sigmas, camera, number of points, RMS and coverage of every photograph."""
    network, estimate = adjustment.network, adjustment.estimate
    angles = np.degrees(angles_from_rotation(estimate.rotation))
    sigma = _sqrt_diagonal(adjustment.covariance.exterior)
    _, count = image_rms(adjustment)
    found = geometry_of(adjustment)
    for i, name in enumerate(network.images):
        yield (
            name,
            *estimate.position[i],
            *angles[i],
            *sigma[i, :3],
            *np.degrees(sigma[i, 3:]),
            estimate.cameras[network.camera[i]].name,
            int(count[i]),
            found.image_rms_px[i],
            found.hull[i],
        )


def camera_rows(adjustment: Adjustment) -> Iterable[Sequence[object]]:
    """Return camera, parameter, value, sigma (empty where it was not adjusted) and unit."""
    for index, camera in enumerate(adjustment.estimate.cameras):
        sigma = parameter_sigmas(adjustment, index)
        for name, value, s, unit in zip(camera.names, camera.parameters, sigma, camera.units, strict=True):
            yield (camera.name, name, value, s, unit)


def image_point_rows(adjustment: Adjustment) -> Iterable[Sequence[object]]:
    """Return image, point, position, sigmas as measured, residuals and 0 or 1 for rejected."""
    network = adjustment.network
    seen = network.image_points
    sigma = _sqrt_diagonal(seen.covariance)
    for k in range(len(seen)):
        yield (
            network.images[seen.image[k]],
            network.points[seen.point[k]],
            *seen.xy[k],
            *sigma[k],
            *adjustment.residuals[k],
            int(adjustment.rejected[k]),
        )


def reliability_rows(adjustment: Adjustment, statistics: Statistics) -> Iterable[Sequence[object]]:
    """Return the tests of every image point: residual, redundancy number, w, tau, smallest error, its effect.

    Empty cells: rejected image points have neither redundancy number nor reliability, and where the
    redundancy number is 0 no error is found.
    """
    network = adjustment.network
    seen, found = network.image_points, statistics.reliability
    for k in range(len(seen)):
        yield (
            network.images[seen.image[k]],
            network.points[seen.point[k]],
            *adjustment.residuals[k],
            *adjustment.redundancy_numbers[k],
            *adjustment.standardised[k],
            *adjustment.tau[k],
            *found.minimal_bias[k],
            *found.external[k],
            float(adjustment.weights[k]),
            int(adjustment.rejected[k]),
        )


def component_rows(statistics: Statistics) -> Iterable[Sequence[object]]:
    """Return the variance components of kinds of observation, cameras and photographs."""
    for kind, found in (
        ("kind", statistics.kinds),
        ("camera", statistics.cameras),
        ("photograph", statistics.photographs),
    ):
        for g, name in enumerate(found.names):
            yield (kind, name, int(found.count[g]), found.redundancy[g], found.sigma0[g])


def point_sigmas(adjustment: Adjustment) -> FloatArray:
    """Return the standard deviations of X, Y, Z, object unit, (n, 3)."""
    return _sqrt_diagonal(adjustment.covariance.points)


def write_ply(path: Path, result: SurveyResult) -> None:
    """Write the object points as a PLY point cloud in text form: coded green, uncoded grey.

    Source: Turk, The PLY polygon file format (1994).
    """
    points = result.adjustment.estimate.points
    lines = [
        "ply",
        "format ascii 1.0",
        f"comment kolinear, {_ascii(result.length_unit)}",
        f"element vertex {len(points)}",
        *(f"property double {axis}" for axis in "xyz"),
        *(f"property uchar {colour}" for colour in ("red", "green", "blue")),
        "end_header",
    ]
    for xyz, code in zip(points, result.code, strict=True):
        colour = "120 120 120" if code == UNCODED else "20 140 60"
        lines.append(" ".join(f"{value:.17g}" for value in xyz) + " " + colour)
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def _write_csv(path: Path, header: str, rows: Iterable[Sequence[object]]) -> None:
    path.write_text(csv_text(header.split(","), rows), encoding="utf-8", newline="")


def _ascii(text: str) -> str:
    return text.encode("ascii", "replace").decode().replace("\n", " ").replace("\r", " ")


def _sqrt_diagonal(covariance: FloatArray) -> FloatArray:
    """Return standard deviations of covariance matrices (..., d, d), shape (..., d)."""
    diagonal = np.einsum("...ii->...i", covariance)
    return np.asarray(np.sqrt(np.where(diagonal >= 0, diagonal, np.nan)))
