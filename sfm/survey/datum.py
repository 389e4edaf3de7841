"""Scale and place of a survey: its scale bars and control, and what of them does not fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.conventions import BoolArray, FloatArray
from sfm.errors import GeometryError
from sfm.network import Estimate, Network, ObjectPoints, ScaleBars
from sfm.project import Survey
from sfm.report.result import ControlCheck
from sfm.similarity import Similarity, fit_similarity
from sfm.survey.start import control_points, scale_bars

CONTRADICTED = 0.5  # share of its rays that the test rejects, above which control or a bar is to blame
CLEARLY = 0.25  # of the misfit that the best choice removes: by how much more than the second it must remove
MOST_CANDIDATES = 10  # control points and bars that are taken out in turn, those that lose most rays first
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


@dataclass(frozen=True)
class Contradiction:
    """Control or a scale bar that most rays of a point contradict."""

    freed: Network | None  # without the one to blame; None where it cannot be told
    protected: BoolArray  # points whose rays the test would sacrifice: all of control and bars, (n,)
    line: str  # in words


def contradiction(
    network: Network, adjustment: Adjustment, readjust: Callable[[Network], Adjustment]
) -> Contradiction | None:
    """Return what contradicts the photographs where the test rejects most rays of a control point or bar end.

    Coordinates or a length held against the evidence of the photographs would otherwise cost rays one after
    another. Each control point and bar is taken out in turn, with the rays back in: the one to blame is that
    without which v'Pv is smallest, if it is clearly smaller than without any other.

    Args:
        network: all image points, with control and bars.
        adjustment: of a part of it, after the test, points by the same names.
        readjust: adjusts such a part without any test.

    Returns:
        None where nothing is contradicted, or nothing is left to tell it from.
    """
    part, seen = adjustment.network, adjustment.network.image_points
    use_control = adjustment.datum == "control"
    bars = part.scale_bars
    share = lost_share(adjustment)
    ends = np.maximum(share[bars.start], share[bars.end])
    held = share[part.control.point] if use_control else np.zeros(0)
    if max(held.max(initial=0.0), ends.max(initial=0.0)) <= CONTRADICTED:
        return None
    carriers = np.zeros(len(part.points), dtype=bool)
    carriers[bars.start], carriers[bars.end] = True, True
    if use_control:
        carriers[part.control.point] = True
    usable = ~adjustment.rejected | carriers[seen.point]
    whole = replace(part, image_points=seen.select(usable))
    ways: list[tuple[Network, Network, str, int]] = []  # part and network without one, name, which
    if len(held) > MIN_CONTROL:
        for k in np.argsort(-held, kind="stable")[:MOST_CANDIDATES]:
            point = int(part.control.point[k])
            ways.append(
                (
                    _without_control(whole, point),
                    _without_control(network, network.points.index(part.points[point])),
                    f"control point {part.points[point]}",
                    point,
                )
            )
    if len(bars) > 1 or (use_control and len(bars)):
        for b in np.argsort(-ends, kind="stable")[:MOST_CANDIDATES]:
            names = part.points[bars.start[b]], part.points[bars.end[b]]
            start, end = (network.points.index(name) for name in names)
            ways.append(
                (
                    _without_bar(whole, int(bars.start[b]), int(bars.end[b])),
                    _without_bar(network, start, end),
                    f"scale bar {names[0]} - {names[1]}",
                    -1 - int(b),
                )
            )
    if len(ways) < 2:
        return None
    tried: list[Adjustment | None] = []
    for one in (whole, *(way[0] for way in ways)):
        try:
            tried.append(readjust(one))
        except GeometryError:  # nothing that fits: the others hold too little
            tried.append(None)
    misfit = np.array([a.vPv if a is not None else np.inf for a in tried[1:]])
    order = np.argsort(misfit, kind="stable")
    best, second = (tried[1 + k] for k in order[:2])
    if best is None or second is None:
        return None
    total = tried[0].vPv if tried[0] is not None else float(misfit[np.isfinite(misfit)].max())
    if second.vPv - best.vPv < CLEARLY * (total - best.vPv):
        what = "control points" if len(held) else "scale bars"
        what = "control points and scale bars" if len(held) and len(bars) else what
        line = (
            f"the {what} contradict one another, and which one is wrong cannot be told; all were kept, and "
            "none of their image points was tested"
        )
        known = {part.points[j] for j in np.flatnonzero(carriers)}
        return Contradiction(None, np.array([name in known for name in network.points]), line)
    _, freed, name, which = ways[order[0]]
    X = best.estimate.points
    if which >= 0:
        given = part.control.xyz[part.control.point == which][0]
        off, treated = float(np.linalg.norm(X[which] - given)), "it was adjusted as a new point"
    else:
        b = -1 - which
        off = float(bars.length[b] - np.linalg.norm(X[bars.end[b]] - X[bars.start[b]]))
        treated = "it was taken out"
    by = f"{off:.3g}" if which >= 0 else f"{off:+.3g}"
    line = f"{name} does not fit: by the others and the photographs it is {by} off (object unit); {treated}"
    return Contradiction(freed, np.zeros(len(network.points), dtype=bool), line)


def lost_share(adjustment: Adjustment) -> FloatArray:
    """Return the share of its rays that each point lost to rejection, (n,)."""
    seen, n = adjustment.network.image_points, len(adjustment.network.points)
    lost = np.bincount(seen.point[adjustment.rejected], minlength=n)
    return np.asarray(lost / np.maximum(np.bincount(seen.point, minlength=n), 1))


def _without_control(network: Network, point: int) -> Network:
    control = network.control
    keep = control.point != point
    kept = ObjectPoints(control.point[keep], control.xyz[keep], control.covariance[keep])
    return replace(network, control=kept)


def _without_bar(network: Network, start: int, end: int) -> Network:
    bars = network.scale_bars
    keep = ~((bars.start == start) & (bars.end == end))
    kept = ScaleBars(bars.start[keep], bars.end[keep], bars.length[keep], bars.sigma[keep])
    return replace(network, scale_bars=kept)


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
