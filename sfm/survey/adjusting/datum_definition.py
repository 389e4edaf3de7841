"""Scale and place of a survey: its scale bars and control, and what of them does not fit."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.conventions import BoolArray, FloatArray
from sfm.errors import GeometryError
from sfm.network import Estimate, Network, ObjectPoints, ScaleBars
from sfm.remarks.remark import Remark, remark
from sfm.result import ControlCheck, TakenOut
from sfm.similarity import Similarity, fit_similarity
from sfm.survey.inputs.survey import Survey

CONTRADICTED = 0.5  # share of its rays that the test rejects, above which control or a bar is to blame
CLEARLY = 0.25  # of the misfit that the best choice removes: by how much more than the second it must remove
MAX_CANDIDATES = 10  # control points and bars that are taken out in turn, those that lose most rays first
OTHER_UNIT = 8.0  # factor between scales that no start values explain: mm, cm, m, km differ by ten or more
WELL_APART = 10.0  # standard deviations of their distance between places that tell a scale
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


def refuse_other_units(survey: Survey, network: Network, estimate: Estimate) -> None:
    """Raise GeometryError where scales of control, observed exterior orientation and bars differ as units do.

    All are taken from the start values, whatever frame these are in, and by medians, so that a single wrong
    value is left to the tests. Outside of a datum of control, control and exterior orientation only check.
    """
    if survey.datum.kind != "control":
        return
    bars, control, exterior = network.scale_bars, network.control.complete, network.exterior
    known, oriented = estimate.determined[control.point], estimate.oriented[exterior.image]
    points, centres = estimate.points[control.point], estimate.position[exterior.image]
    scales = {
        "control": _scale_by(control.xyz[known], control.covariance[known], points[known]),
        "exterior orientation": _scale_by(
            exterior.position[oriented], exterior.covariance[oriented, :3, :3], centres[oriented]
        ),
        "scale bars": _scale(bars.length, estimate.points[bars.end] - estimate.points[bars.start]),
    }
    given = [(name, scale) for name, scale in scales.items() if scale > 0]
    for (one, first), (other, second) in combinations(given, 2):
        if not 1 / OTHER_UNIT < first / second < OTHER_UNIT:
            raise GeometryError(
                f"lengths by the {one} are {first / second:.4g} times those by the {other}; are both in "
                f"{survey.unit}?"
            )


def _scale_by(given: FloatArray, covariance: FloatArray, found: FloatArray) -> float:
    """Return the scale between places, one after the other; those that are not well apart say nothing."""
    length = np.linalg.norm(np.diff(given, axis=0), axis=1)
    variance = np.einsum("nii->n", covariance)
    apart = length**2 > WELL_APART**2 * (variance[1:] + variance[:-1])
    return _scale(length[apart], np.diff(found, axis=0)[apart])


def _scale(length: FloatArray, difference: FloatArray) -> float:
    """Return the median of lengths over those of differences, NaN where there are none."""
    found = np.linalg.norm(difference, axis=1)
    usable = (found > 0) & (length > 0)
    return float(np.median(length[usable] / found[usable])) if usable.any() else float("nan")


def scale_to_bars(network: Network, estimate: Estimate, datum: Datum) -> Estimate:
    """Bring a network that control does not hold to the length of its scale bars, else of its control."""
    if datum.kind == "control":
        return estimate
    scale = object_scale(network, estimate)
    if not scale > 0:
        return estimate
    centre = np.nanmean(estimate.points, axis=0)
    return Similarity(scale, np.eye(3), (1 - scale) * centre).apply_estimate(estimate)


def place_on_control(network: Network, estimate: Estimate) -> tuple[Estimate, ControlCheck]:
    """Place an adjusted network on its control; scale bars, where there are some, keep its scale."""
    control = network.control.complete
    points = estimate.points[control.point]
    fitted = fit_similarity(points, control.xyz)
    placing = fit_similarity(points, control.xyz, scale=1.0) if len(network.scale_bars) else fitted
    scale = fitted.scale if len(network.scale_bars) else 1.0
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
    keep = len(network.scale_bars) > 0 or len(network.control) == MIN_CONTROL - 1
    scale = object_scale(network, estimate) if len(network.control) and not len(network.scale_bars) else 1.0
    try:
        return fit_similarity(source, target, scale=scale if keep else None).apply_estimate(estimate)
    except GeometryError:  # too few of them, or on a line: the adjustment has kept what they say
        return estimate


@dataclass(frozen=True)
class Contradiction:
    """Control or a scale bar that most rays of a point contradict."""

    freed: Network | None  # without the one to blame; None where it cannot be told
    protected: BoolArray  # points whose rays the test would sacrifice: all of control and bars, (n,)
    found: Remark
    taken_out: TakenOut | None = None  # the one to blame


def find_contradiction(
    network: Network, adjustment: Adjustment, readjust: Callable[[Network], Adjustment], *, unit: str
) -> Contradiction | None:
    """Return what contradicts the photographs where the test rejects most rays of a control point or bar end.

    Coordinates or a length held against the evidence of the photographs would otherwise cost rays one after
    another. Each control point and bar is taken out in turn, with the rays back in: the one to blame is that
    without which v'Pv is smallest, if it is clearly smaller than without any other.

    Args:
        network: all image points, with control and bars.
        adjustment: of a part of it, after the test, points by the same names.
        readjust: adjusts such a part without any test.
        unit: object unit, for the words.

    Returns:
        None where nothing is contradicted, or nothing is left to tell it from.
    """
    part, share = adjustment.network, lost_share(adjustment)
    held = share[part.control.point] if adjustment.datum == "control" else np.zeros(0)
    ends = np.maximum(share[part.scale_bars.start], share[part.scale_bars.end])
    if max(held.max(initial=0.0), ends.max(initial=0.0)) <= CONTRADICTED:
        return None
    carriers = np.zeros(len(part.points), dtype=bool)
    carriers[part.scale_bars.start] = carriers[part.scale_bars.end] = True
    carriers[part.control.point[: len(held)]] = True
    usable = ~adjustment.rejected | carriers[part.image_points.point]
    whole = replace(part, image_points=part.image_points.select(usable))
    suspects = (*_suspect_control(whole, held), *_suspect_bars(whole, ends, alone=not len(held)))
    if len(suspects) < 2:
        return None
    everything, *tried = (
        _readjusted(readjust, one) for one in (whole, *(suspect.without(whole) for suspect in suspects))
    )
    misfit = np.array([a.vPv if a is not None else np.inf for a in tried])
    order = np.argsort(misfit, kind="stable")
    best, second = (tried[k] for k in order[:2])
    if best is None or second is None:
        return None
    total = everything.vPv if everything is not None else float(misfit[np.isfinite(misfit)].max())
    if second.vPv - best.vPv < CLEARLY * (total - best.vPv):
        what = " and ".join(
            name for name, some in (("control points", len(held)), ("scale bars", len(ends))) if some
        )
        near = [k for k in order if misfit[k] - best.vPv < CLEARLY * (total - best.vPv)]
        names = ", ".join(suspects[k].name for k in near)
        line = (
            f"the {what} contradict one another, and which one is wrong cannot be told ({names}); all were "
            "kept, and none of their image points was tested"
        )
        known = {part.points[j] for j in np.flatnonzero(carriers)}
        return Contradiction(
            None,
            np.array([name in known for name in network.points]),
            remark("given_remarkable", line=line),
        )
    blamed = suspects[order[0]]
    return Contradiction(
        blamed.without(network),
        np.zeros(len(network.points), dtype=bool),
        remark("given_remarkable", line=blamed.line(best.estimate.points, unit)),
        TakenOut(blamed.name, blamed.relative(best.estimate.points), resolved=True),
    )


@dataclass(frozen=True)
class _Suspect:
    """A control point or a scale bar that may be what is wrong."""

    names: tuple[str, ...]  # of the control point, or of both ends of the bar
    indices: tuple[int, ...]  # of the same in the network that was adjusted
    given: FloatArray  # coordinates (3,) or length (1,)

    def without(self, network: Network) -> Network:
        """Return a network without it, which may hold other points than that which was adjusted."""
        where = [network.points.index(name) for name in self.names]
        control, bars = network.control, network.scale_bars
        if len(where) == 1:
            keep = control.point != where[0]
            kept = ObjectPoints(control.point[keep], control.xyz[keep], control.covariance[keep])
            return replace(network, control=kept)
        keep = ~((bars.start == where[0]) & (bars.end == where[1]))
        left = ScaleBars(bars.start[keep], bars.end[keep], bars.length[keep], bars.sigma[keep])
        return replace(network, scale_bars=left)

    @property
    def name(self) -> str:
        """What it is called."""
        one = len(self.names) == 1
        return f"control point {self.names[0]}" if one else f"scale bar {self.names[0]} - {self.names[1]}"

    def relative(self, X: FloatArray) -> float:
        """Return by how much it is off from adjusted points, (n, 3), over the object or its own length."""
        at = X[list(self.indices)]
        if len(at) == 1:
            return float(np.linalg.norm(at[0] - self.given) / np.linalg.norm(np.ptp(X, axis=0)))
        return float(abs(np.linalg.norm(at[1] - at[0]) / self.given[0] - 1))

    def line(self, X: FloatArray, unit: str) -> str:
        """Return in words by how much it is off from the adjusted object points, object unit, (n, 3)."""
        at = X[list(self.indices)]
        if len(at) == 1:
            treated = "it was adjusted as a new point"
            by = f"{np.linalg.norm(at[0] - self.given):.3g}"
        else:
            treated = "it was taken out"
            by = f"{self.given[0] - np.linalg.norm(at[1] - at[0]):+.3g}"
        return f"{self.name} does not fit: by the others and the photographs it is {by} {unit} off; {treated}"


def _suspect_control(part: Network, held: FloatArray) -> Iterator[_Suspect]:
    """Return the control points that lose most rays, none where too few would be left.

    Args:
        part: what was adjusted.
        held: share of its rays that each control point lost, none in a datum without control.
    """
    if len(held) > MIN_CONTROL:
        for k in np.argsort(-held, kind="stable")[:MAX_CANDIDATES]:
            point = int(part.control.point[k])
            yield _Suspect((part.points[point],), (point,), part.control.xyz[k])


def _suspect_bars(part: Network, ends: FloatArray, *, alone: bool) -> Iterator[_Suspect]:
    """Return the scale bars whose ends lose most rays, none where the only scale would be lost.

    Args:
        part: what was adjusted.
        ends: larger share of their rays that the ends of each bar lost.
        alone: whether there is no control beside the bars.
    """
    bars = part.scale_bars
    if len(bars) > 1 or not alone:
        for b in np.argsort(-ends, kind="stable")[:MAX_CANDIDATES]:
            at = int(bars.start[b]), int(bars.end[b])
            yield _Suspect((part.points[at[0]], part.points[at[1]]), at, bars.length[b : b + 1])


def _readjusted(readjust: Callable[[Network], Adjustment], network: Network) -> Adjustment | None:
    """Return the adjustment of a network, None where it holds too little or is no evidence."""
    try:
        adjustment = readjust(network)
    except GeometryError:
        return None
    return adjustment if adjustment.converged else None


def lost_share(adjustment: Adjustment) -> FloatArray:
    """Return the share of its rays that each point lost to rejection, (n,)."""
    seen, n = adjustment.network.image_points, len(adjustment.network.points)
    lost = np.bincount(seen.point[adjustment.rejected], minlength=n)
    return np.asarray(lost / np.maximum(np.bincount(seen.point, minlength=n), 1))


def datum_remarks(survey: Survey, network: Network) -> tuple[Remark, ...]:
    """Return remarks on control and scale bars that were not measured, and on a missing scale."""
    remarks, known = [], set(network.points)
    control = [name for name in survey.control.names if name not in known] if survey.control else []
    if control:
        remarks.append(remark("control_missing", points=control))
    bars = [f"{bar.start} - {bar.end}" for bar in survey.scale_bars if not {bar.start, bar.end} <= known]
    if bars:
        remarks.append(remark("scale_bars_missing", bars=bars))
    if survey.datum.kind != "control" and not len(network.scale_bars) and len(network.control) < 2:
        remarks.append(remark("scale_undefined", unit=survey.unit))
    return tuple(remarks)
