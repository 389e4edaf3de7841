"""The tables of a survey result: solution, omitted points and photographs, given values, and tests."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from sfm.adjustment.quality.statistics import MIN_CHECKED_REDUNDANCY
from sfm.adjustment.result import Adjustment
from sfm.files import result_tables as tables
from sfm.files.covariance_file import write_covariances
from sfm.files.csv_tables import write_ply
from sfm.files.result_tables import MOMENTS, MOUNTS, write_rigs
from sfm.judgement.bundle_statistics import Statistics
from sfm.judgement.survey_result import SurveyResult
from sfm.model.camera import base_name
from sfm.model.conventions import AnyArray
from sfm.model.distortion.brown import (
    BALANCED,
    BALANCED_MODEL,
    BALANCED_UNITS,
    brown_by_balanced,
    from_balanced,
    to_balanced,
)
from sfm.model.errors import GeometryError
from sfm.model.observation_residuals import given_rows
from sfm.model.solution import MEASURED
from sfm.report.findings import Findings

CODED_COLOUR, UNCODED_COLOUR = (20, 140, 60), (120, 120, 120)  # in points.ply
USUAL_R0 = 2 / 3  # usual R0 over the largest image radius


def write_tables(findings: Findings, folder: Path, colours: AnyArray | None = None) -> None:
    """Write all tables of a result into an existing folder; `summary.write_summary` adds the key figures.

    colours: red, green and blue of the points in the photographs, uint8, (n, 3), for those of texture.
    """
    result, statistics = findings.result, findings.statistics
    a = result.adjustment
    g, codes = findings.geometry, [None if code < 0 else code for code in result.code.tolist()]
    limiting = findings.precision.limiting_points.T.tolist()
    seen = [g.rays.tolist(), codes, g.angle_deg.tolist(), g.point_rms_px.tolist(), *limiting]
    further = (seen, [values.tolist() for values in (g.image_points, g.image_rms_px, g.hull)], a.residuals)
    tables.write_solution(folder, result.solution, a.network.image_points, a.rejected, *further)
    tables.LEFT_OUT.write_rows(folder, left_out_rows(result))
    tables.GIVEN.write_rows(folder, given_rows(findings.given.kinds, result.network, result.unit))
    write_reliability(folder, a, statistics)
    tables.VARIANCE_COMPONENTS.write_rows(folder, component_rows(statistics))
    tables.RESIDUALS.write_rows(folder, findings.protocol.residuals)
    tables.CONTROL_POINTS.write_rows(folder, findings.protocol.control)
    interior = list[Sequence[object]]()  # all correlations of the interior parameters of each camera
    for camera, Q in zip(a.estimate.cameras, a.covariance.interior, strict=True):
        free = [camera.names[s] for s in np.flatnonzero(camera.free)[: len(Q)]]
        sigma = np.sqrt(np.clip(np.diagonal(Q), 0, None))
        for i, j in combinations(range(len(free)), 2):
            known = sigma[i] * sigma[j]
            interior.append((camera.name, free[i], free[j], Q[i, j] / known if known > 0 else np.nan))
    tables.INTERIOR_CORRELATIONS.write_rows(folder, interior)
    correlations = result.exterior_correlations
    exterior: Iterable[Sequence[object]] = ()
    if correlations is not None:  # of interior parameters with the exterior orientation of each photograph
        exterior = (
            (owner.removeprefix("camera "), parameter, image, *rho)
            for c, (parameter, owner) in enumerate(correlations.parameters)
            for image, rho in zip(correlations.images, correlations.rho[:, :, c], strict=True)
        )
    tables.EXTERIOR_CORRELATIONS.write_rows(folder, exterior)
    for table, names, covariance in (
        (tables.POINT_COVARIANCES, a.network.points, a.covariance.points),
        (tables.IMAGE_COVARIANCES, a.network.images, a.covariance.exterior),
    ):
        rows, columns = np.triu_indices(covariance.shape[1])
        table.write(folder, names, covariance[:, rows, columns])
    write_rigs(folder, result.solution)
    write_covariances(folder, result.solution, points=True)
    if _is_balanced(findings):
        tables.CAMERAS_BALANCED.write_rows(folder, balanced_rows(findings))
    if len(result.seen_targets.image):
        tables.TARGETS.write_rows(folder, target_rows(findings))
    shades = [UNCODED_COLOUR if code is None else CODED_COLOUR for code in codes]
    if colours is not None:
        of_texture = a.network.windows
        for j, (name, colour) in enumerate(zip(a.network.points, colours.tolist(), strict=True)):
            shades[j] = tuple(colour) if name in of_texture else shades[j]
    unit = result.length_unit
    write_ply(folder / "points.ply", a.estimate.points, colours=shades, unit=unit)


def table_stems(findings: Findings) -> tuple[str, ...]:
    """Return the names of the tables that `write_tables` writes, without suffix."""
    optional = {tables.CAMERAS_BALANCED: _is_balanced(findings)}
    optional[tables.TARGETS] = len(findings.result.seen_targets.image) > 0
    written = [table.file.removesuffix(".csv") for table in tables.TABLES if optional.get(table, True)]
    rigs = (MOUNTS, MOMENTS) if findings.rigs else ()
    return (*written, *(name.removesuffix(".csv") for name in rigs))


def _is_balanced(findings: Findings) -> bool:
    return BALANCED_MODEL in findings.interior.models


def balanced_rows(findings: Findings) -> Iterable[Sequence[object]]:
    """Return the cameras of model brown_forward in AICON's form: camera, parameter, value, sigma and unit.

    c is negative, as AICON writes it; sigma is empty if a value was not adjusted. R0 is taken from the survey
    file, or else is two thirds of the largest image radius, as is usual. A camera without such a form has no
    rows: one with K4, or with distortion that cannot be balanced at R0.
    """
    given = dict(findings.result.balance_radius_mm)
    a = findings.result.adjustment
    for camera, covariance in zip(a.estimate.cameras, a.covariance.interior, strict=True):
        if camera.model != BALANCED_MODEL:
            continue
        half = float(np.hypot(*(np.array(camera.size_px) * camera.pixel_mm))) / 2
        R0 = given.get(base_name(camera.name, given), USUAL_R0 * half)
        try:
            rows = to_balanced(tuple(zip(camera.names, camera.parameters.tolist(), strict=True)), R0)
        except GeometryError:
            continue
        Q = np.zeros((len(camera.names), len(camera.names)))
        if len(covariance):
            Q[np.ix_(camera.free, camera.free)] = covariance
        order = [camera.names.index(name) for name, _ in from_balanced(rows)]
        inverse = np.linalg.inv(brown_by_balanced(rows))
        variance = np.diagonal(inverse @ Q[np.ix_(order, order)] @ inverse.T)
        sigma = np.where(variance > 0, np.sqrt(np.maximum(variance, 0.0)), np.nan)
        at_R0 = BALANCED.index("R0")
        for (name, value), s, unit in zip(rows, np.insert(sigma, at_R0, np.nan), BALANCED_UNITS, strict=True):
            yield (camera.name, name, -value if name == "c" else value, s, unit)


def target_rows(findings: Findings) -> Iterable[Sequence[object]]:
    """Return photograph, position and outline of every target, and the reasons for rejected candidates.

    Rejected candidates have no outline. Values are rounded to 1e-4 px and 1e-3 deg, as they are shown.
    """
    result = findings.result
    seen, names = result.seen_targets, result.network.images
    angle_deg = np.rad2deg(seen.ellipse[:, 2:])
    rounded = np.hstack([np.round(seen.xy, 4), np.round(seen.ellipse[:, :2], 4), np.round(angle_deg, 3)])
    for image, row, reason in zip(seen.image.tolist(), rounded.tolist(), seen.reason, strict=True):
        yield (names[image], *row, reason or MEASURED)


def left_out_rows(result: SurveyResult) -> Iterable[Sequence[Any]]:
    """Return kind, name, image points and reason of every photograph and point not in the result."""
    for failed in result.failed:
        yield ("photograph", failed.image, None, failed.reason.text)
    for point in result.left_out:
        yield ("point", point.point, point.image_points, point.reason.text)


def write_reliability(folder: Path, a: Adjustment, statistics: Statistics) -> None:
    """Write the tests of every image point: residual, redundancy number, w, tau, minimal bias, its effect.

    Rejected image points have empty cells instead of redundancy number and reliability. So have image points
    with a redundancy number of 0, since no error in them is detected.
    """
    network, reliability = a.network, statistics.reliability
    seen = network.image_points
    checked = a.redundancy_numbers > MIN_CHECKED_REDUNDANCY
    error = np.where(checked, a.residuals / np.where(checked, a.redundancy_numbers, 1.0), np.nan)
    tests = (a.tau, reliability.minimal_bias, reliability.external, a.weights)
    tables.RELIABILITY.write(
        folder,
        [[network.images[i] for i in seen.image.tolist()], [network.points[j] for j in seen.point.tolist()]],
        np.column_stack([a.residuals, a.redundancy_numbers]),
        a.standardised,
        [*np.column_stack(tests).T, a.rejected.astype(np.int64), *error.T],
    )


def component_rows(statistics: Statistics) -> Iterable[Sequence[Any]]:
    """Return the variance components of kinds of observation, sources, cameras and photographs."""
    of_sources = (("source", statistics.sources),) if len(statistics.sources.names) > 1 else ()
    for kind, components in (
        ("kind", statistics.kinds),
        *of_sources,
        ("camera", statistics.cameras),
        ("photograph", statistics.photographs),
    ):
        for g, name in enumerate(components.names):
            yield (kind, name, int(components.count[g]), components.redundancy[g], components.sigma0[g])
