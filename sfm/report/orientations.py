"""Output of `kolinear orient` and `georeference`: text and JSON of each step from measurement to control."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from sfm.model.conventions import FloatArray, angles_from_rotation
from sfm.model.display import counted, listed
from sfm.model.distributions import MARGIN
from sfm.model.errors import GeometryError
from sfm.model.similarity import AbsoluteOrientation, orient_absolute
from sfm.products.georeferencing.resampled import MapGrid
from sfm.products.georeferencing.transformation import MODELS, PlaneTransformation, fit_plane
from sfm.report.page import Column, Table, plain
from sfm.textbook.pair import PairOrientation
from sfm.textbook.photo_coordinates import FiducialTransformation, orient_fiducials

MIRROR = np.array([1.0, 1.0, -1.0])
FEWEST = 4  # control points from which a similarity without one of them has redundancy


@dataclass(frozen=True)
class OrientationReport:
    """What a step prints."""

    lines: tuple[str, ...]  # before the table
    table: Table  # of the points
    values: dict[str, Any]  # for programs
    after: tuple[str, ...] = ()  # lines below the table

    def said(self, as_json: bool) -> str:
        """Return the text, or JSON."""
        if as_json:
            points = [dict(record) for record in self.table.records]
            return json.dumps(plain(self.values | {"points": points}), indent=2, allow_nan=False)
        return "\n".join((*self.lines, self.table.text.rstrip("\n"), *self.after))


def fiducials_report(
    transformation: FiducialTransformation,
    marks: Sequence[str],
    points: Sequence[str],
    photo_mm: FloatArray,
    *,
    measured: FloatArray,
    calibrated: FloatArray,
) -> OrientationReport:
    """Return the transformation by fiducial marks, its residuals, and the points that it transformed.

    Args:
        transformation: by the fiducial marks.
        marks: their names, n.
        points: names of the points, k.
        photo_mm: their photo coordinates, (k, 2).
        measured: coordinates of the marks, unit of the comparator or scan, (n, 2).
        calibrated: their photo coordinates, mm, (n, 2).
    """
    t = transformation
    scales = " ".join(f"{scale:.9g}" for scale in t.scales)
    reversed_y = np.linalg.det(t.matrix) < 0
    shear = np.degrees((t.shear + np.pi / 2) % np.pi - np.pi / 2)  # a reversed axis is not a shear of 180 deg
    lines = (
        f"{t.kind} transformation, {counted(len(marks), 'fiducial mark')}",
        f"scales along the measured axes {scales} mm per unit",
        f"rotation {np.degrees(t.rotation):.7f} deg, shear {shear:.7f} deg"
        + (", measured y axis reversed" if reversed_y else ""),
        *_sigma0(1000 * t.sigma0, "um", t.redundancy),
    )
    rows = [(name, *v) for name, v in zip(marks, t.residuals.tolist(), strict=True)]
    columns = (
        Column("mark", "point"),
        Column("vx", "vx_mm", "mm", ".4f"),
        Column("vy", "vy_mm", "mm", ".4f"),
    )
    moved = [(name, *xy) for name, xy in zip(points, photo_mm.tolist(), strict=True)]
    after = [Table(_photo_columns(), moved).text.rstrip("\n")] if moved else []
    reversed_axis = orient_fiducials(measured * (1, -1), calibrated, kind=t.kind).sigma0
    if _fits_better(reversed_axis, t.sigma0, t.redundancy, calibrated):
        after.append(
            f"with one axis reversed sigma0 is {1000 * reversed_axis:.6g} um: "
            "a scan counts rows downwards, --kind affine"
        )
    values = {
        "kind": t.kind,
        "matrix": t.matrix,
        "shift_mm": t.shift,
        "covariance": t.covariance,
        "sigma0_mm": t.sigma0,
        "redundancy": t.redundancy,
        "transformed": [{"point": name, "x_mm": x, "y_mm": y} for name, x, y in moved],
    }
    return OrientationReport(lines, Table(columns, rows), values, tuple(after))


def corrections_report(
    names: Sequence[str], measured_mm: FloatArray, corrected_mm: FloatArray
) -> OrientationReport:
    """Return corrected photo coordinates, and by how much each moved."""
    moved = np.linalg.norm(corrected_mm - measured_mm, axis=1)
    rows = [
        (name, *xy, 1000 * off)
        for name, xy, off in zip(names, corrected_mm.tolist(), moved.tolist(), strict=True)
    ]
    columns = (*_photo_columns(), Column("moved", "moved_um", "um", ".1f"))
    lines = (f"{counted(len(names), 'point')}, moved by at most {1000 * moved.max():.1f} um",)
    return OrientationReport(lines, Table(columns, rows), {})


def pair_report(
    orientation: PairOrientation,
    names: Sequence[str],
    model: FloatArray,
    *,
    c_mm: float,
    alone: Sequence[str],
) -> OrientationReport:
    """Return a relative orientation, the distance of each pair of rays from coplanarity, and the model.

    Args:
        orientation: of the pair.
        names: of the conjugate points, n.
        model: their coordinates, NaN where rays are parallel or meet behind a photograph, (n, 3).
        c_mm: principal distance, which turns tangents into mm.
        alone: points of one photograph only.
    """
    o = orientation
    unit = np.array([1.0 if name in ("by", "bz") else np.degrees(1.0) for name in o.names])
    sigma = np.sqrt(np.diag(o.covariance)) * unit
    lines = [f"{o.kind} relative orientation, {counted(len(names), 'conjugate point')}"]
    for name, value, s in zip(o.names, o.parameters * unit, sigma, strict=True):
        lines.append(f"{name:<7}{value:14.7f} ± {s:.7f}{'' if name in ('by', 'bz') else ' deg'}")
    lines += _sigma0(1000 * o.sigma0 * c_mm, "um", o.redundancy)
    if o.is_ambiguous:
        lines.append("another orientation fits as well: the points are close to a plane, others are needed")
    columns = (
        Column("point", "point"),
        *(Column(axis, axis, "", ".6f", unknown="-") for axis in "XYZ"),
        Column("off coplanarity", "residual_um", "um", ".2f"),
    )
    off = 1000 * o.residuals * c_mm
    rows = [(name, *X, v) for name, X, v in zip(names, model.tolist(), off.tolist(), strict=True)]
    after = [f"in one photograph only: {listed(alone)}"] if alone else []
    behind = [name for name, X in zip(names, model, strict=True) if not np.isfinite(X).all()]
    if behind:
        after.append(f"no place in front of both photographs: {listed(behind)}")
    values = {
        "kind": o.kind,
        "parameters": dict(zip(o.names, (o.parameters * unit).tolist(), strict=True)),
        "sigma": dict(zip(o.names, sigma.tolist(), strict=True)),
        "positions": o.positions,
        "rotations": o.rotations,
        "sigma0_mm": o.sigma0 * c_mm,
        "redundancy": o.redundancy,
        "is_ambiguous": o.is_ambiguous,
    }
    return OrientationReport(tuple(lines), Table(columns, rows), values, tuple(after))


def absolute_report(
    orientation: AbsoluteOrientation,
    model: FloatArray,
    control: FloatArray,
    weights: FloatArray | None,
    common: Sequence[str],
    absent: Sequence[str],
    names: Sequence[str],
    moved: FloatArray,
) -> OrientationReport:
    """Return an absolute orientation, its residuals at the control, and the moved points.

    Args:
        orientation: of the model.
        model: control points in the model, (n, 3).
        control: their coordinates, (n, 3).
        weights: of the control points, (n,); equal if None.
        common: names of these points.
        absent: control points that the model does not have.
        names: of all points of the model, k.
        moved: their coordinates in the frame of the control, (k, 3).
    """
    o, s = orientation, orientation.similarity
    sigma = np.sqrt(np.diag(o.covariance))
    angles = np.degrees(angles_from_rotation(s.rotation))
    shift = " ".join(f"{value:.6f}" for value in s.translation)
    lines = (
        f"absolute orientation, {counted(len(common), 'control point')}",
        f"scale           {s.scale:.9g} ± {sigma[0]:.3g}",
        "omega phi kappa " + " ".join(f"{value:.7f}" for value in angles) + " deg",
        "  ± about X, Y, Z of the control " + " ".join(f"{v:.7f}" for v in np.degrees(sigma[1:4])) + " deg",
        f"shift           {shift}",
        "  ± of the centre of the control " + " ".join(f"{value:.6f}" for value in sigma[4:]),
        *_sigma0(o.sigma0, "", o.redundancy),
    )
    without = np.full(len(common), np.nan)
    if len(common) >= FEWEST:
        for k in range(len(common)):
            rest = np.arange(len(common)) != k
            of_rest = None if weights is None else weights[rest]
            with suppress(GeometryError):  # the others may be on a line
                without[k] = orient_absolute(model[rest], control[rest], weights=of_rest).sigma0
    columns = (
        Column("control", "point"),
        *(Column(f"v{axis}", f"v{axis}", "", ".6f") for axis in "XYZ"),
        Column("sigma0 without it", "sigma0_without", "", ".6g", unknown="-"),
    )
    rows = [
        (name, *v, sigma0)
        for name, v, sigma0 in zip(common, o.residuals.tolist(), without.tolist(), strict=True)
    ]
    placed = Table(
        (Column("point", "point"), *(Column(axis, axis, "", ".6f") for axis in "XYZ")),
        [(name, *X) for name, X in zip(names, moved.tolist(), strict=True)],
    )
    after = [placed.text.rstrip("\n")]
    if absent:
        after.append(f"control that is not in the model: {listed(absent)}")
    mirrored = orient_absolute(model * MIRROR, control, weights=weights).sigma0
    if _fits_better(mirrored, o.sigma0, o.redundancy, control):
        after.append(
            f"the mirrored model fits with sigma0 {mirrored:.6g}: "
            "two columns are exchanged, or one has the other sign"
        )
    values = {
        "scale": s.scale,
        "rotation": s.rotation,
        "translation": s.translation,
        "covariance": o.covariance,
        "sigma0": o.sigma0,
        "redundancy": o.redundancy,
        "sigma0_mirrored": mirrored,
        "moved": [dict(record) for record in placed.records],
    }
    return OrientationReport(lines, Table(columns, rows), values, tuple(after))


def georeferencing_report(
    transformation: PlaneTransformation,
    names: Sequence[str],
    xy: FloatArray,
    places: FloatArray,
    grid: MapGrid,
    *,
    is_turned: bool,
) -> OrientationReport:
    """Return how well a transformation fits, and how well each one that the points bear predicts them.

    Args:
        transformation: that is used.
        names: of the control points, n.
        xy: their coordinates in the plane, (n, 2).
        places: their image points, px, (n, 2).
        grid: squares of the new picture.
        is_turned: whether EXIF data turn the photograph for display.
    """
    t = transformation
    size = t.pixel_size(xy)
    lines = [
        f"{t.model} transformation, {counted(len(names), 'control point')}",
        *_sigma0(t.sigma0, "px", t.redundancy),
        f"picture of {grid.width} x {grid.height} pixels of {grid.pixel:.6g}; "
        f"a pixel of the photograph covers {size.min():.4g} to {size.max():.4g} at the control",
    ]
    rms = {t.model: t.predicted_rms}
    for name in MODELS.keys() - rms.keys():
        with suppress(GeometryError):  # the points are too few for it
            rms[name] = fit_plane(xy, places, model=name).predicted_rms
    known = {name: rms[name] for name in MODELS if np.isfinite(rms.get(name, np.nan))}
    if known:
        listing = ", ".join(f"{name} {value:.3g}" for name, value in known.items())
        lines.append(f"each point predicted from the others, RMS of a coordinate, px: {listing}")
    best = min(known, key=lambda name: known[name], default=t.model)
    after = []
    if t.model in known and _fits_better(known[best], known[t.model], t.redundancy, places):
        after.append(
            f"{best} predicts the points {known[t.model] / known[best]:.2g} times better: --model {best}"
        )
    if t.is_mirrored(xy):
        after.append("the photograph is drawn mirrored: two columns are exchanged, or one has the other sign")
    if is_turned:
        after.append("viewers turn this photograph by its EXIF data; x_px, y_px are of the pixels as stored")
    columns = (
        Column("control", "point"),
        Column("vx", "vx_px", "px", ".3f"),
        Column("vy", "vy_px", "px", ".3f"),
        Column("from the others", "predicted_px", "px", ".3f", unknown="-"),
        Column("in the plane", "predicted", "", ".4g", unknown="-"),
    )
    off = np.linalg.norm(t.predicted, axis=1)
    rows = [
        (name, *v, d, d * s)
        for name, v, d, s in zip(names, t.residuals.tolist(), off.tolist(), size.tolist(), strict=True)
    ]
    values = {"model": t.model, "sigma0_px": t.sigma0, "redundancy": t.redundancy, "predicted_rms_px": known}
    return OrientationReport(tuple(lines), Table(columns, rows), values, tuple(after))


def _photo_columns() -> tuple[Column, ...]:
    return (
        Column("point", "point"),
        Column("x", "x_mm", "mm", ".4f"),
        Column("y", "y_mm", "mm", ".4f"),
    )


def _fits_better(sigma0: float, used: float, redundancy: int, coordinates: FloatArray) -> bool:
    """Return whether another fit to coordinates is better than the used one, beyond chance and rounding."""
    rounding = np.finfo(float).eps * coordinates.size * float(np.abs(coordinates).max())
    return bool(2 * redundancy * np.log(max(used, rounding) / max(sigma0, rounding)) > MARGIN)


def _sigma0(value: float, unit: str, redundancy: int) -> tuple[str, ...]:
    if redundancy == 0:
        return ("no redundancy: nothing checks the points",)
    return (f"sigma0 {value:.6g}{' ' if unit else ''}{unit}, redundancy {redundancy}",)
