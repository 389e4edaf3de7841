"""A plan: stations, what they will give, where that is weak, and what has to be taken along.

Remarks on a plan, and the verdict on it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sfm.adjustment.result import MOTIONS
from sfm.camera import Camera
from sfm.conventions import IntArray
from sfm.network import Network
from sfm.observations.kind import POINT
from sfm.planning.design.designer import Design
from sfm.planning.planned_object import PlannedObject
from sfm.planning.prediction import MIN_POINTS, Prediction, ScaleBarPlan, predict_network
from sfm.planning.sight import MIN_PIXELS
from sfm.planning.sight.visibility import STEEPEST_DEG, Seeing, TargetSize, compute_target_size
from sfm.planning.stations import Shot, Stations, choose_coded, shots
from sfm.planning.wanted import MIN_RAYS, WantedPrecision, short_of
from sfm.planning.weakness import (
    Calibratability,
    Contribution,
    WeakPoint,
    calibratability,
    contributions,
    separate_groups,
    unusable_photographs,
    weak_points,
)
from sfm.remarks.remark import Remark, remark
from sfm.remarks.verdict import Level, Verdict, judge

HEADLINES: Mapping[Level, str] = {
    "good": "The photographs determine the network.",
    "fair": "The photographs determine the network, with remarks.",
    "bad": "The photographs do not determine the network.",
}
HEADLINES_OF_WANTED: Mapping[Level, str] = {
    "good": "The plan gives what is wanted.",
    "fair": "The plan determines the network, and does not give all that is wanted.",
    "bad": "The photographs do not determine the network.",
}
MIN_CODES = 5  # coded targets of a photograph, one more than orient it


@dataclass(frozen=True)
class Plan:
    """A planned network with all remarks on it."""

    name: str
    unit: str  # of lengths
    prediction: Prediction
    seeing: Seeing
    wanted: WantedPrecision
    design: Design | None  # None where the stations were given
    shortfall: float  # largest of predicted over wanted; 0 where nothing is wanted
    weak: tuple[WeakPoint, ...]
    unusable: tuple[str, ...]  # photographs that share too few points with others
    groups: tuple[tuple[str, ...], ...]  # of photographs that are connected, the largest first
    calibrations: tuple[Calibratability, ...]  # of the cameras that are not held
    contributions: tuple[Contribution, ...]  # of the rig and of observations beside image points
    target: TargetSize  # that shows MIN_PIXELS from the farthest station
    coded: IntArray  # points that are coded targets: five in every photograph, and those that are observed
    shots: tuple[Shot, ...]

    @property
    def reached(self) -> bool:
        """Whether all that is wanted is predicted, and every point is determined."""
        whole = self.prediction.determined.all() and not self.prediction.adjustment.undetermined
        return self.shortfall <= 1 and bool(whole)


def plan_of(
    name: str,
    unit: str,
    planned: PlannedObject,
    camera: Camera | Sequence[Camera],
    stations: Stations,
    seeing: Seeing,
    *,
    wanted: WantedPrecision,
    bars: Sequence[ScaleBarPlan] = (),
    given: Callable[[Network], Network] | None = None,
) -> Plan:
    """Return the plan of given stations; arguments as of `predict_network`.

    Raises:
        GeometryError: as `predict_network`.
    """
    prediction = predict_network(planned, camera, stations, seeing, bars=bars, given=given)
    every = np.ones(len(planned.names), dtype=bool)
    return describe_plan(name, unit, prediction, seeing, wanted, short_of(prediction, wanted, every), None)


def describe_plan(
    name: str,
    unit: str,
    prediction: Prediction,
    seeing: Seeing,
    wanted: WantedPrecision,
    shortfall: float,
    design: Design | None,
) -> Plan:
    """Return the remarks on a prediction."""
    seen = prediction.sight.seen
    coded = np.union1d(choose_coded(seen), _observed(prediction))
    camera = prediction.cameras[0]
    far = max(float(d) for d in _distances(prediction))
    width = camera.size_px[0]
    size = compute_target_size(
        p=MIN_PIXELS,
        w_mm=width * float(camera.pixel_mm[0]),
        d=far,
        c_mm=camera.c_px * float(np.mean(camera.pixel_mm)),
        n=width,
        tilt_deg=min(_tilt(prediction, seeing), STEEPEST_DEG),
    )
    return Plan(
        name,
        unit,
        prediction,
        seeing,
        wanted,
        design,
        shortfall,
        weak_points(prediction),
        unusable_photographs(prediction),
        separate_groups(prediction),
        tuple(
            found
            for a in range(len(prediction.cameras))
            if (found := calibratability(prediction, seeing, a)) is not None
        ),
        contributions(prediction),
        size,
        coded,
        shots(
            prediction.planned.xyz,
            prediction.stations,
            seen,
            coded,
            focus=None if seeing.depth is None else seeing.depth.focus,
        ),
    )


def _observed(prediction: Prediction) -> IntArray:
    """Return the points that observations beside image points are of; a code names them."""
    network = prediction.adjustment.network
    points = [at for kind in network.kinds for of, at in kind.blocks() if of == POINT]
    return np.flatnonzero(np.isin(prediction.point, np.concatenate([*points, np.zeros(0, dtype=np.int64)])))


def _tilt(prediction: Prediction, seeing: Seeing) -> float:
    """Return the largest angle between a ray of a plan and the normal of its point, deg."""
    m, n = np.nonzero(prediction.sight.seen)
    ray = prediction.stations.position[m] - prediction.planned.xyz[n]
    cosine = (ray * prediction.planned.normals[n]).sum(axis=1) / np.linalg.norm(ray, axis=1)
    known = cosine[np.isfinite(cosine)]
    return math.degrees(math.acos(min(float(known.min()), 1.0))) if len(known) else seeing.max_incidence_deg


def _distances(prediction: Prediction) -> tuple[float, ...]:
    m, n = np.nonzero(prediction.sight.seen)
    return tuple(np.linalg.norm(prediction.planned.xyz[n] - prediction.stations.position[m], axis=1).tolist())


def verdict_of_plan(plan: Plan) -> Verdict:
    """Return the verdict on a plan with what limits it."""
    return judge(_remarks(plan), HEADLINES_OF_WANTED if plan.wanted.anything else HEADLINES)


def _remarks(plan: Plan) -> Iterator[Remark]:
    p = plan.prediction
    unknown = p.adjustment.undetermined
    if unknown:
        yield remark("plan_undetermined", unknown=unknown[:1], more=len(unknown) - 1 or None)
        for group in plan.groups[1:]:
            yield remark("plan_not_connected", photographs=group, others=plan.groups[0], needed=MIN_POINTS)
    if not p.determined.all():
        lost = [name for name, known in zip(p.planned.names, p.determined, strict=True) if not known]
        yield remark("plan_points_undetermined", lost=len(lost), total=len(p.planned.names), points=lost)
    if plan.wanted.anything and plan.shortfall > 1:
        yield remark("plan_short_of_wanted", times=plan.shortfall)
    few = int((p.rays < MIN_RAYS).sum())
    if few:
        yield remark("plan_points_with_few_rays", few=few, needed=MIN_RAYS)
    bad = [c for c in plan.calibrations if not c.good]
    if bad:
        reasons = tuple(dict.fromkeys(reason for c in bad for reason in c.reasons))
        reasons = reasons or ("too few image points over the photograph",)
        yield remark("plan_does_not_calibrate", reasons=reasons)
    if plan.unusable:
        yield remark("plan_photographs_apart", photographs=plan.unusable, needed=MIN_POINTS)
    if plan.design is not None and plan.design.limit:
        yield remark("plan_limited", limit=plan.design.limit)
    if p.adjustment.expected_defect == MOTIONS:
        yield remark("plan_without_scale")
    if p.planned.mesh is None:
        yield remark("plan_without_surface")
    uncoded = [s.station for s in plan.shots if s.coded < MIN_CODES]
    if uncoded:
        yield remark("plan_few_codes", photographs=uncoded, needed=MIN_CODES)
    if np.isnan(p.planned.normals).any():
        yield remark("plan_without_normals")
    if plan.seeing.sigma_px is None:
        yield remark("plan_sigma_of_targets")
    if plan.seeing.depth is None:
        yield remark("plan_without_depth_of_field")
