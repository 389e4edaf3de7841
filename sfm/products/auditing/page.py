"""The page of an audit: what a model states of itself, and what its own image points say."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sfm.judgement.bundle_statistics import given_of
from sfm.judgement.checks import root_mean_square, standard_deviations
from sfm.model.camera import Camera
from sfm.model.conventions import FloatArray
from sfm.model.display import counted, listed
from sfm.model.network import rows_of
from sfm.model.remarks.verdict import Level
from sfm.products.auditing.audit import Audit, mean_of_points
from sfm.report.given_residuals import given_parts
from sfm.report.page import Column, Note, Page, Paragraph, Part, Section, Table, columns, tested_section
from sfm.report.phrases import fixed, general, significant

MAX_ROWS = 30  # parameters on the page; the file has all
STRONG = 0.95  # coefficient of correlation from which two parameters are hardly told apart
_NOTHING_GIVEN = Paragraph(
    "None. The scale of the model, and any bending that the cameras allow, are not checked: add control or "
    "scale bars by --survey FILE."
)


def page(audit: Audit, *, report: str) -> Page:
    """Return the page: figures side by side, cameras, what moved, datum, given values.

    Args:
        audit: the model and its adjustment.
        report: file name of the report of the adjustment, beside the page.
    """
    result, a = audit.result, audit.result.adjustment
    unit = result.length_unit
    rms = f"RMS {significant(audit.stated.rms_px)} px as stated, {significant(a.rms_px)} px adjusted"
    headlines: dict[Level, str] = {
        "good": f"The image points determine this model: {rms}.",
        "fair": f"The image points determine this model, with remarks: {rms}.",
        "bad": f"The image points give no dependable model: {rms}.",
    }
    more = Note(f"All tables, tests and pictures of the adjustment: {report}.")
    given = given_parts(given_of(a, unit), a, unit)
    return Page(
        "audit",
        "Audit of a model",
        audit.model.name,
        replace(result.verdict, headline=headlines[result.verdict.level]),
        (
            Section("As it states, and as its image points give", *_figures(audit, unit), more),
            Section("Are the cameras determined?", *_cameras(audit)),
            Section("What the adjustment moved", *_moved(audit, unit)),
            Section("Standard deviations depend on the datum", *_gauge(audit, unit)),
            Section("Control, scale bars and other given values", *(given or (_NOTHING_GIVEN,))),
            tested_section(result.verdict),
        ),
    )


def _figures(audit: Audit, unit: str) -> Iterator[Part]:
    """Yield the figures of the model beside those of the adjustment."""
    stated, result, model = audit.stated, audit.result, audit.model
    a = result.adjustment
    v = a.residuals[~a.rejected]
    lost = len(stated.residuals) + stated.unseen - len(a.rejected)
    accepted = f"{len(v)} ({counted(int(a.rejected.sum()), 'gross error')} rejected)"
    covariances = (model.point_covariance, model.position_covariance)
    sigma_points, sigma_stations = (
        "not stated" if covariance is None else significant(root_mean_square(standard_deviations(covariance)))
        for covariance in covariances
    )
    own = a.covariance
    points, stations = (
        significant(root_mean_square(standard_deviations(covariance)))
        for covariance in (own.points, own.exterior[:, :3, :3])
    )
    mean = float(np.linalg.norm(v, axis=1).mean())
    of_points = mean_of_points(v, a.network.image_points.point[~a.rejected])
    yield Table(
        columns("", ">the model", ">adjusted here"),
        [
            ("Photographs", stated.photographs, len(a.network.images)),
            ("Points", stated.points, len(a.network.points)),
            ("Image points", len(stated.residuals) + stated.unseen, accepted),
            *([("Image points of points or photographs that are left out", "", lost)] if lost else []),
            ("RMS residual per coordinate [px]", general(stated.rms_px, 4), general(a.rms_px, 4)),
            ("Mean length of a residual [px]", general(stated.mean_length_px, 4), general(mean, 4)),
            (
                "Mean over points of their residuals' lengths [px]",
                general(stated.mean_of_points_px, 4),
                general(of_points, 4),
            ),
            ("Standard deviation of an image coordinate [px]", "not stated", general(a.sigma0_px, 4)),
            (f"Standard deviation of a point, RMS [{unit}]", sigma_points, points),
            (f"Standard deviation of a station, RMS [{unit}]", sigma_stations, stations),
        ],
    )
    if stated.unseen:
        yield Paragraph(
            f"Left out of the model's residuals: {counted(stated.unseen, 'image point')}. The camera does "
            "not see the point where the model has both."
        )
    for words in audit.notes:
        yield Paragraph(f"{words[:1].upper()}{words[1:]}.")
    share = a.redundancy / (2 * len(v))
    yield Note(
        "The model's residuals are those of its own cameras, photographs and points. The mean length of a "
        "residual is what many programs call mean reprojection error; COLMAP's is that over points. They "
        f"say how well the model fits, not how precise it is. Of {2 * len(v)} image coordinates "
        f"{a.redundancy} are redundant, {fixed(share, 2)} each; the standard deviation of an image "
        "coordinate takes this into account."
    )


def _cameras(audit: Audit) -> Iterator[Part]:
    """Yield the interior orientation before and after, with its standard deviations and correlations."""
    a = audit.result.adjustment
    theirs = _cameras_of_model(audit)
    rows, held = [], dict[str, int]()
    for k, camera in enumerate(a.estimate.cameras):
        before = theirs[k]
        sigma = a.interior_sigma(k)
        partners = _strongest(a.covariance.interior[k], camera.free, camera.names)
        for p, (name, unit) in enumerate(zip(camera.names, camera.units, strict=True)):
            value = float(camera.parameters[p])
            start = np.nan if before is None else float(before.parameters[p])
            if not camera.free[p]:
                held[name] = held.get(name, 0) + bool(value or camera.parts[1][p])
                continue
            times = (value - start) / sigma[p] if sigma[p] > 0 else np.nan
            rows.append(
                (
                    camera.name,
                    name if unit == "1" else f"{name} [{unit}]",
                    start,
                    value,
                    float(sigma[p]),
                    times,
                    partners.get(name, ""),
                )
            )
    heads = (
        Column("camera", "camera"),
        Column("parameter", "parameter"),
        Column("the model", "stated", format=".8g", unknown=""),
        Column("adjusted", "adjusted", format=".8g"),
        Column("sigma", "sigma", format=significant),
        Column("change / sigma", "change_over_sigma", format="z.1f", unknown=""),
        Column("strongest correlation", "correlation"),
    )
    yield Table(heads, rows, "audit_cameras", most=MAX_ROWS)
    yield Note(
        f"Two parameters that correlate by more than {STRONG:g} are hardly told apart: only their combined "
        "effect is known as well as the residuals suggest."
    )
    for like in audit.like:
        yield Paragraph(f"{like}.")
    kept = [f"{name} of {counted(count, 'camera')}" for name, count in held.items() if count]
    if kept:
        yield Paragraph(
            f"Held at the model's values: {listed(kept)}. Few photographs do not tell them, the model holds "
            "them, or --fix does."
        )
    strong = audit.result.orientation_correlations
    if strong:
        words = "; ".join(f"{of.parameter} with {of.partners}" for of in strong)
        yield Paragraph(f"Correlated with the orientation of photographs: {words}.")


def _cameras_of_model(audit: Audit) -> list[Camera | None]:
    """Return the model's camera for each adjusted camera; None if it has several or another lens model."""
    a, model = audit.result.adjustment, audit.model
    number = {name: i for i, name in enumerate(model.network.images)}
    of_photograph = model.network.camera[[number[name] for name in a.network.images]]
    cameras: list[Camera | None] = []
    for camera, rows in zip(
        a.estimate.cameras, rows_of(a.network.camera, len(a.estimate.cameras)), strict=True
    ):
        of_model = [model.estimate.cameras[k] for k in np.unique(of_photograph[rows])]
        same = len(of_model) == 1 and of_model[0].model == camera.model
        same = same and np.allclose(of_model[0].pixel_mm, camera.pixel_mm)
        cameras.append(of_model[0] if same else None)
    return cameras


def _strongest(covariance: FloatArray, free: np.ndarray, names: tuple[str, ...]) -> dict[str, str]:
    """Return for each free parameter the other one that it correlates with most, in words."""
    sigma = np.sqrt(np.diagonal(covariance))
    if len(sigma) < 2 or not (sigma > 0).all():
        return {}
    correlation = covariance / np.outer(sigma, sigma) - np.eye(len(sigma))
    free_names = [name for name, is_free in zip(names, free.tolist(), strict=True) if is_free]
    most = np.argmax(np.abs(correlation), axis=1)
    return {
        name: f"{free_names[j]} {correlation[i, j]:+.2f}"
        for i, (name, j) in enumerate(zip(free_names, most.tolist(), strict=True))
    }


def _moved(audit: Audit, unit: str) -> tuple[Part, ...]:
    """Return how far points and photographs moved."""
    heads = (
        Column(""),
        Column("RMS of a coordinate", unit=unit, format=significant),
        Column("largest", unit=unit, format=significant),
        Column("of"),
        Column("RMS / sigma", format=significant, unknown="not known"),
    )
    rows = [(m.kind, m.rms, m.largest, m.name, m.over_sigma) for m in audit.moved]
    note = Note(
        "Adjusted minus stated, after the similarity that fits the points best. Below one standard deviation "
        "the model is as good as its image points; far above, the program that made it did not reach their "
        "best solution, kept gross errors, held a parameter, or weights them differently."
    )
    return Table(heads, rows), note


def _gauge(audit: Audit, unit: str) -> tuple[Part, ...]:
    """Return the standard deviations in another datum."""
    heads = (
        Column("datum"),
        Column("points, RMS", unit=unit, format=significant),
        Column("stations, RMS", unit=unit, format=significant),
    )
    note = Note(
        "Image points alone tell nothing of position, rotation and scale of the whole. Each program fixes "
        "them in its way, and its standard deviations contain the way: those of the same model differ as "
        "above. Distances and shape do not. Compare standard deviations only in one datum."
    )
    return Table(heads, audit.gauge), note
