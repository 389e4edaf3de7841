"""Scale and place of a survey by its scale bars and control."""

from __future__ import annotations

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.conventions import BoolArray
from sfm.errors import GeometryError
from sfm.network import Estimate, Network
from sfm.remarks.remark import Remark, remark
from sfm.result import ControlCheck
from sfm.similarity import Similarity, fit_similarity
from sfm.survey.inputs.plate import is_plate_control, plate_control
from sfm.survey.inputs.survey import Survey

MIN_CONTROL = 3  # points that a control datum needs, and that place a free network


def object_scale(network: Network, estimate: Estimate) -> float:
    """Return object units per unit of an estimate by its scale bars, else its control, else NaN."""
    bars, control = network.scale_bars, network.control.complete
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


def scale_to_bars(network: Network, estimate: Estimate, datum: Datum) -> Estimate:
    """Bring a network that control does not hold to the length of its scale bars, else of its control."""
    if datum.kind == "control" or has_held_mounts(estimate):
        return estimate
    scale = object_scale(network, estimate)
    if not scale > 0:
        return estimate
    centre = np.nanmean(estimate.points, axis=0)
    return Similarity(scale, np.eye(3), (1 - scale) * centre).apply_estimate(estimate)


def is_scaled(network: Network, estimate: Estimate) -> bool:
    """Return whether scale bars, other observations or mounts held fixed give a network its scale."""
    return bool(len(network.scale_bars) or len(network.observations) or has_held_mounts(estimate))


def has_held_mounts(estimate: Estimate) -> bool:
    """Return whether the mount of a camera is held fixed, beside those of reference cameras."""
    mounts = estimate.mounts
    if mounts is None:
        return False
    return bool((mounts.position.any(axis=1) & ~mounts.free[:, :3].any(axis=1)).any())


def place_on_control(network: Network, estimate: Estimate) -> tuple[Estimate, ControlCheck]:
    """Place an adjusted network on its control; scale bars, where there are some, keep its scale."""
    control = network.control.complete
    points = estimate.points[control.point]
    fitted = fit_similarity(points, control.xyz)
    scaled = is_scaled(network, estimate)
    placing = fit_similarity(points, control.xyz, scale=1.0) if scaled else fitted
    scale = fitted.scale if scaled else 1.0
    names = tuple(network.points[j] for j in control.point)
    return placing.apply_estimate(estimate), ControlCheck(names, placing.apply(points) - control.xyz, scale)


def place_on_frame(
    network: Network, estimate: Estimate, frame: Estimate, carriers: BoolArray | None
) -> Estimate:
    """Place an adjusted free network on the coordinates that its inner constraints refer to.

    The similarity of least squares over the datum points meets the inner constraints exactly, however
    far the network moved in between: the sum of the differences and their turning and scaling moments are 0.
    Scale bars keep the scale, and so do two control points.

    Args:
        network: what was adjusted, in a free datum.
        estimate: adjusted.
        frame: coordinates to refer to, NaN where there are none; with fewer than three points those of
            the projection centres count.
        carriers: points that carry the datum, all if None, (n,).
    """
    on = frame.determined if carriers is None else frame.determined & carriers
    source, target = estimate.points[on], frame.points[on]
    if on.sum() < MIN_CONTROL:
        both = frame.oriented & estimate.oriented
        source, target = estimate.position[both], frame.position[both]
    scaled = is_scaled(network, estimate)
    keep = scaled or len(network.control) == MIN_CONTROL - 1
    scale = object_scale(network, estimate) if len(network.control) and not scaled else 1.0
    try:
        return fit_similarity(source, target, scale=scale if keep else None).apply_estimate(estimate)
    except GeometryError:  # too few of them, or on a line: the adjustment has kept what they say
        return estimate


def datum_remarks(survey: Survey, network: Network, *, has_scale: bool) -> tuple[Remark, ...]:
    """Return remarks on control and scale bars that were not measured, and on a missing or assumed scale.

    Points of a plate may be out of view: nobody expects all of them in the result.
    """
    remarks, known = [], set(network.points)
    plate = is_plate_control(survey.control, plate_control(survey.targets))
    control = [name for name in survey.control.names if name not in known] if survey.control else []
    if control and not plate:
        remarks.append(remark("control_missing", points=control))
    if survey.targets.pitch_assumed and survey.targets.pitch is not None:
        remarks.append(remark("plate_pitch_assumed", pitch=(survey.targets.pitch, survey.unit)))
    bars = [f"{bar.start} - {bar.end}" for bar in survey.scale_bars if not {bar.start, bar.end} <= known]
    if bars:
        remarks.append(remark("scale_bars_missing", bars=bars))
    if not has_scale:
        remarks.append(remark("scale_undefined", unit=survey.unit))
    return tuple(remarks)
