"""Alternatives as remarks: which kind each is, with its subjects and numbers."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from sfm.adjustment.hypotheses.alternatives import CAMERA_SETS, Alternative
from sfm.adjustment.hypotheses.columns import interior_step, object_fields
from sfm.adjustment.hypotheses.refit import Refit
from sfm.adjustment.result import Adjustment
from sfm.conventions import FloatArray
from sfm.network import Network
from sfm.remarks.remark import Quantity, Remark, remark

MOVED = ("moved", "shifted")


def kind_of(one: Alternative) -> str:
    """Return the kind of remark that an alternative is."""
    if one.family in CAMERA_SETS:
        return "camera_drift" if one.pattern == "linear" else "other_camera"
    if one.family == "interior":
        return "held_parameter"
    if one.family == "format":
        return "distortion_not_described"
    if one.family in MOVED:
        return "points_moved"
    return "object_deforming" if one.pattern == "linear" else "object_deformed"


def remark_of(
    plain: Adjustment, one: Alternative, found: Refit, others: Iterable[Alternative], unit: str
) -> Remark:
    """Return the remark on an alternative that holds.

    Args:
        plain: the adjustment without it.
        one: the alternative.
        found: the adjustment with it.
        others: alternatives that explain the image points about as well.
        unit: object unit.
    """
    kind, network = kind_of(one), plain.network
    parts: dict[str, str | Iterable[str] | float | tuple[float, str] | Quantity | None] = {
        "shift": found.shift,
        "rms": found.rms,
        "photographs": tuple(network.images[i] for i in one.photographs),
        "instead": tuple(dict.fromkeys(kind_of(other) for other in others)) or None,
    }
    if one.family in CAMERA_SETS:
        parts |= _camera(plain, one, found.beta)
    elif one.family == "interior":
        parts |= _interior(plain, one, found.beta)
    elif one.family == "format":
        parts["largest"] = float(np.linalg.norm(found.beta.reshape(-1, 2), axis=1).max()), "px"
    elif one.family in MOVED:
        parts |= _moved(plain, one, found.beta, unit)
    else:
        parts["deformation"] = 1000 * _relative(plain, one, found.beta), "‰ of the object"
    return remark(kind, **parts)


def _camera(a: Adjustment, one: Alternative, beta: FloatArray) -> dict[str, tuple[float, str]]:
    """Return by how much c and the principal point differ in the photographs of an alternative."""
    camera = a.estimate.cameras[a.network.camera[int(one.photographs[0])]]
    half = max(camera.size_px) / 2
    sign = 1.0 if one.pattern == "linear" or one.factor[one.photographs[0]] > 0 else -1.0
    # a column is 1 px at the edge, and moves what is measured
    largest = float(np.ptp(one.factor))  # from the first photograph to the last of a drift
    parts = {"change": (100 * sign * largest * float(beta[0]) / half, "%")}
    if len(beta) > 2 and one.pattern != "linear":
        parts["away"] = (float(np.hypot(beta[1], beta[2])), "px")
    return parts


def _interior(
    a: Adjustment, one: Alternative, beta: FloatArray
) -> dict[str, str | tuple[str, ...] | Quantity]:
    """Return which parameters are held, and the value of the first that the image points ask for."""
    index, s = one.parameters[0]
    camera = a.estimate.cameras[index]
    unit = "" if camera.units[s] == "1" else camera.units[s]
    value = float(camera.parameters[s])
    names = tuple(dict.fromkeys(a.estimate.cameras[i].names[p] for i, p in one.parameters))
    parts: dict[str, str | tuple[str, ...] | Quantity] = {
        "camera": camera.group_of(s) or camera.name,
        "parameters": names,
    }
    if len(names) == 1:
        change = float(beta[0]) * interior_step(a, index, s)
        parts |= {"value": Quantity(value, unit), "instead_of": Quantity(value + change, unit)}
    return parts


def _moved(
    a: Adjustment, one: Alternative, beta: FloatArray, unit: str
) -> dict[str, tuple[str, ...] | Quantity]:
    """Return which points moved, how far at most, and the last photograph before."""
    network: Network = a.network
    parts: dict[str, tuple[str, ...] | Quantity] = {
        "points": tuple(network.points[j] for j in one.points),
        "from": (network.images[int(np.flatnonzero(one.factor > 0)[0])],),
        "distance": Quantity(float(np.linalg.norm(beta.reshape(-1, 3), axis=1).max()), unit),
    }
    return parts


def _relative(a: Adjustment, one: Alternative, beta: FloatArray) -> float:
    """Return the largest displacement of a point over the size of the object (root mean square distance)."""
    strain, bending, size = object_fields(a.estimate.points)
    field = strain if one.family == "strain" else bending
    away = np.linalg.norm(field @ beta, axis=1) / size
    return float(np.nanmax(away) * np.ptp(one.factor))
