"""Scale and place of a survey: its scale bars and control, and what of them does not fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.network import Estimate, Network, ObjectPoints
from sfm.project import Survey
from sfm.report.result import ControlCheck
from sfm.similarity import Similarity, fit_similarity
from sfm.survey.start import control_points, scale_bars

CONTRADICTED = 0.5  # share of its rays that the test rejects, above which control itself is to blame
MIN_CONTROL = 3  # points that a control datum needs


def object_scale(network: Network, estimate: Estimate) -> float:
    """Return object units per unit of an estimate by its scale bars, else its control, else NaN."""
    bars, control = network.scale_bars, network.control
    length = np.linalg.norm(estimate.points[bars.end] - estimate.points[bars.start], axis=1)
    usable = np.isfinite(length) & (length > 0)
    if usable.any():
        return float(np.median(bars.length[usable] / length[usable]))
    known = estimate.determined[control.point]
    if known.sum() < 2:
        return float("nan")
    given, found = control.xyz[known], estimate.points[control.point[known]]
    spread = np.linalg.norm(found - found.mean(axis=0))
    return float(np.linalg.norm(given - given.mean(axis=0)) / spread) if spread > 0 else float("nan")


def rescaled(network: Network, estimate: Estimate, datum: Datum) -> Estimate:
    """Bring a network that control does not hold to the length of its scale bars, else of its control."""
    if datum.kind == "control":
        return estimate
    scale = object_scale(network, estimate)
    return Similarity(scale, np.eye(3), np.zeros(3)).apply_estimate(estimate) if scale > 0 else estimate


def placed_on_control(network: Network, estimate: Estimate) -> tuple[Estimate, ControlCheck]:
    """Place an adjusted network on its control; scale bars, where there are some, keep its scale."""
    control = network.control
    points = estimate.points[control.point]
    fitted = fit_similarity(points, control.xyz)
    placing = fit_similarity(points, control.xyz, scale=1.0) if len(network.scale_bars) else fitted
    scale = fitted.scale if len(network.scale_bars) else 1.0
    names = tuple(network.points[j] for j in control.point)
    return placing.apply_estimate(estimate), ControlCheck(names, placing.apply(points) - control.xyz, scale)


def without_contradicted_control(
    network: Network, adjustment: Adjustment
) -> tuple[Network, str] | tuple[None, str]:
    """Return the network without the control point that most of its own rays contradict, and a line on it.

    A point whose coordinates are held against the evidence of the photographs would otherwise lose its
    rays one after another. It stays in the network, as a new point.

    Args:
        network: all image points, with the control.
        adjustment: of a part of it, after the test, points by the same names.

    Returns:
        None where no control point is contradicted, or too few would be left.
    """
    part, seen = adjustment.network, adjustment.network.image_points
    rays = np.bincount(seen.point, minlength=len(part.points))
    lost = np.bincount(seen.point[adjustment.rejected], minlength=len(part.points))
    share = (lost / np.maximum(rays, 1))[part.control.point]
    if len(share) <= MIN_CONTROL or share.max() <= CONTRADICTED:
        return None, ""
    worst = part.control.point[np.argmax(share)]
    name = part.points[worst]
    keep = network.control.point != network.points.index(name)
    control = network.control
    line = (
        f"control point {name} does not fit: {lost[worst]} of its {rays[worst]} image points contradict its "
        "coordinates; it was adjusted as a new point"
    )
    return replace(
        network, control=ObjectPoints(control.point[keep], control.xyz[keep], control.covariance[keep])
    ), line


def datum_warnings(survey: Survey, network: Network) -> tuple[str, ...]:
    """Return a line for control and scale bars that were not measured, and for a missing scale."""
    lines = []
    _, control = control_points(survey, network.points)
    if control:
        lines.append(f"control not in the result: {', '.join(control)}")
    _, bars = scale_bars(survey, network.points)
    if bars:
        lines.append(f"scale bars with an end that is not in the result: {', '.join(bars)}")
    if survey.datum.kind != "control" and not len(network.scale_bars) and len(network.control) < 2:
        lines.append(
            f"the survey holds no scale: lengths are not in {survey.unit} until a scale bar or control is "
            "measured"
        )
    return tuple(lines)
