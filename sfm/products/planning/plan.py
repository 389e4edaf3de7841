"""A plan: stations, predicted precision and weaknesses; and photographs to add to a survey.

After a survey, `further_photographs` finds the few additional photographs that improve its weakest points
most. A point is assumed to face the mean direction of its rays. Obstacles in other directions are unknown.

Source: Fedorov (1972), Theory of Optimal Experiments (augmentation of a design).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np

from sfm.adjustment.result import MOTIONS, Adjustment
from sfm.adjustment.solve import predict
from sfm.model.arguments import checked_arguments
from sfm.model.camera import Camera
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.display import counted
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network
from sfm.model.observations.kind import POINT
from sfm.model.remarks.remark import Remark, remark
from sfm.model.remarks.verdict import Level, Verdict, judge
from sfm.products.planning import MIN_PIXELS
from sfm.products.planning.designer import Candidates, Design, StationLimits, candidates, gains, image_rows
from sfm.products.planning.planned_object import PlannedObject
from sfm.products.planning.prediction import (
    MIN_POINTS,
    MIN_RAYS,
    Prediction,
    WantedPrecision,
    short_of,
)
from sfm.products.planning.stations import Shot, Stations, choose_coded, shots
from sfm.products.planning.visibility import STEEPEST_DEG, Seeing, TargetSize, compute_target_size
from sfm.products.planning.weakness import (
    Calibratability,
    Contribution,
    WeakPoint,
    calibratability,
    contributions,
    separate_groups,
    unusable_photographs,
    weak_points,
)
from sfm.runtime.progress import report_step

DISTANCES = (0.8, 1.2)  # factors on the nearest and farthest distance of the survey's photographs
ROOM = 0.25  # margin around the box of its stations, over the size of the box
MAX_LISTED = 10  # points that are listed
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
MIN_CODES = 5  # coded targets of a photograph, one more than its orientation needs


@dataclass(frozen=True)
class Plan:
    """A planned network, with everything that its report states."""

    name: str
    unit: str  # of lengths
    prediction: Prediction
    seeing: Seeing
    wanted: WantedPrecision
    design: Design | None  # None for given stations
    shortfall: float  # largest ratio of predicted to wanted values; 0 without requirements
    weak: tuple[WeakPoint, ...]
    unusable: tuple[str, ...]  # photographs that share too few points with others
    groups: tuple[tuple[str, ...], ...]  # connected photographs, the largest group first
    calibrations: tuple[Calibratability, ...]  # of the cameras that are not held
    contributions: tuple[Contribution, ...]  # of the rig and of observations besides image points
    target: TargetSize  # of MIN_PIXELS from the farthest station
    coded: IntArray  # points that are coded targets: five in every photograph, and those with observations
    shots: tuple[Shot, ...]

    @property
    def reached(self) -> bool:
        """Whether the prediction meets all requirements, and every point is determined."""
        determined = self.prediction.determined.all() and not self.prediction.adjustment.undetermined
        return self.shortfall <= 1 and bool(determined)


def describe_plan(
    name: str,
    unit: str,
    prediction: Prediction,
    seeing: Seeing,
    wanted: WantedPrecision,
    design: Design | None = None,
) -> Plan:
    """Return the plan of a prediction, with its weaknesses and list of photographs.

    Args:
        name: name of the plan.
        unit: unit of lengths.
        prediction: prediction of the network.
        seeing: limits and precision of image points.
        wanted: requirements on the network.
        design: the design of the stations; None for given stations.
    """
    seen = prediction.sight.seen
    every = np.ones(len(prediction.planned.names), dtype=bool)
    network = prediction.adjustment.network
    # Points with observations besides image points need a code as their name.
    observed = [at for kind in network.observations for of, at in kind.blocks() if of == POINT]
    named = np.isin(prediction.point, np.concatenate([*observed, np.zeros(0, dtype=np.int64)]))
    coded = np.union1d(choose_coded(seen), np.flatnonzero(named))
    camera = prediction.cameras[0]
    m, n = np.nonzero(seen)
    rays = prediction.stations.position[m] - prediction.planned.xyz[n]
    width = camera.size_px[0]
    cosine = (rays * prediction.planned.normals[n]).sum(axis=1) / np.linalg.norm(rays, axis=1)
    known = cosine[np.isfinite(cosine)]  # of the angles between rays and normals
    tilt_deg = seeing.max_incidence_deg
    if len(known):
        tilt_deg = math.degrees(math.acos(min(float(known.min()), 1.0)))
    size = compute_target_size(
        p=MIN_PIXELS,
        w_mm=width * float(camera.pixel_mm[0]),
        d=float(np.linalg.norm(rays, axis=1).max()),
        c_mm=camera.c_px * float(np.mean(camera.pixel_mm)),
        n=width,
        tilt_deg=min(tilt_deg, STEEPEST_DEG),
    )
    return Plan(
        name,
        unit,
        prediction,
        seeing,
        wanted,
        design,
        short_of(prediction, wanted, every) if design is None else design.shortfall,
        weak_points(prediction),
        unusable_photographs(prediction),
        separate_groups(prediction),
        tuple(
            calibration
            for a in range(len(prediction.cameras))
            if (calibration := calibratability(prediction, seeing, a)) is not None
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


def verdict_of_plan(plan: Plan) -> Verdict:
    """Return the verdict on a plan, with remarks on its limitations."""
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
        yield remark("plan_has_few", few=few, needed=MIN_RAYS)
    bad = [c for c in plan.calibrations if not c.good]
    if bad:
        reasons = tuple(dict.fromkeys(reason for c in bad for reason in c.reasons))
        reasons = reasons or ("too few image points over the photograph",)
        yield remark("plan_does_not_calibrate", reasons=reasons)
    if plan.unusable:
        yield remark("plan_photographs_apart", photographs=plan.unusable, needed=MIN_POINTS)
    if plan.design is not None and plan.design.limit:
        yield remark("plan_limited", limit=plan.design.limit)
    uncoded = [s.station for s in plan.shots if s.coded < MIN_CODES]
    if uncoded:
        yield remark("plan_has_few", photographs=uncoded, needed=MIN_CODES)
    unstated = {
        "known scale": p.adjustment.expected_defect == MOTIONS,
        "no surface": p.planned.mesh is None,
        "no normals": bool(np.isnan(p.planned.normals).any()),
        "precision of targets": plan.seeing.sigma_px is None,
        "no depth of field": plan.seeing.depth is None,
    }
    if any(unstated.values()):
        yield remark("plan_assumes", assumed=list(compress(unstated, unstated.values())))


@dataclass(frozen=True)
class Further:
    """Photographs to add to a survey, and their effect."""

    camera: str  # camera of these photographs
    stations: Stations
    seen: BoolArray  # which of them shows which point, (m, n)
    shots: tuple[Shot, ...]
    points: IntArray  # indices of the weakest points before, (w,)
    before: FloatArray  # sigma of every point, RMS of its coordinates, object unit, (n,)
    after: FloatArray  # the same with the further photographs, (n,)
    adjustment: Adjustment  # predicted, of the survey together with the further photographs


def image_sigma(network: Network) -> float:
    """Return the standard deviation of a usual image coordinate of a network, px; NaN without any."""
    C = network.image_points.covariance
    return float(np.median(np.sqrt(np.trace(C, axis1=1, axis2=2) / 2))) if len(C) else math.nan


def with_image_sigma(network: Network, sigma_px: float) -> Network:
    """Return a network whose image points are as precise as stated, in the same ratios to one another."""
    seen, factor = network.image_points, (sigma_px / image_sigma(network)) ** 2
    return replace(network, image_points=replace(seen, covariance=seen.covariance * factor))


@checked_arguments()
def further_photographs(
    network: Network,
    estimate: Estimate,
    *,
    sigma_px: float,
    count: int = 3,
    candidate_count: int = 200,
    max_incidence_deg: float = 60.0,
) -> Further:
    """Return the photographs that improve the weakest points of a survey most.

    They use the camera of most photographs, without the other cameras of its rig. Their distances and
    positions are about those of the survey.

    Args:
        network: network of the survey, with the a posteriori standard deviations of its image points.
        estimate: solution of the survey.
        sigma_px: standard deviation of an image coordinate in further photographs, px.
        count: number of photographs to add.
        candidate_count: number of stations to choose from.
        max_incidence_deg: largest angle of a ray to the mean of the existing rays, deg.

    Raises:
        GeometryError: fewer than 2 photographs or 3 points, a count below 1, or no station from which enough
            is seen.

    Source: Fedorov (1972); limiting error propagation, see `sfm.products.planning.designer`.
    """
    if count < 1:
        raise GeometryError(f"plan: {counted(count, 'further photograph')}, needed 1 or more")
    known, oriented = estimate.determined & (network.rays() >= 2), np.flatnonzero(estimate.oriented)
    if len(oriented) < 2 or known.sum() < 3:
        raise GeometryError(
            f"plan: {counted(len(oriented), 'photograph')} and "
            f"{counted(int(known.sum()), 'point')} of two rays, needed 2 and 3"
        )
    before = predict(network, estimate)
    variance = np.trace(before.covariance.points, axis1=1, axis2=2) / 3
    known &= variance > 0
    rows = np.flatnonzero(known)
    planned = _with_mean_normals(network, estimate, rows)
    camera = int(np.bincount(network.camera[oriented]).argmax())
    seeing = Seeing(sigma_px=sigma_px, max_incidence_deg=max_incidence_deg)
    # the room of the survey's stations, slightly enlarged
    position = estimate.position[oriented]
    nearest = np.linalg.norm(planned.xyz[None] - position[:, None], axis=2).min(axis=1)
    low, high = position.min(axis=0), position.max(axis=0)
    margin = ROOM * float(np.linalg.norm(high - low)) + 1e-6 * planned.size
    limits = StationLimits(
        (DISTANCES[0] * float(nearest.min()), DISTANCES[1] * float(nearest.max())),
        np.stack([low - margin, high + margin]),
    )
    room = candidates(
        planned,
        estimate.cameras[camera],
        limits,
        seeing,
        count=candidate_count,
    )
    chosen = _chosen(planned, estimate.cameras[camera], room, before.covariance.points[rows], count)
    numbered = (f"new {k + 1}" for k in range(len(network.images) + len(chosen)))
    names = tuple(name for name in numbered if name not in network.images)[: len(chosen)]
    stations = replace(room.stations.of(chosen), names=names)
    sight = room.sight.of(chosen)
    i, j = np.nonzero(sight.seen)
    seen = network.image_points
    m = len(network.images)
    more = ImagePoints(
        np.concatenate([seen.image, m + i]),
        np.concatenate([seen.point, rows[j]]),
        np.concatenate([seen.xy, sight.xy[i, j]]),
        np.concatenate([seen.covariance, sight.covariance[i, j]]),
    )
    moment = network.moment  # of photographs of a rig; each further photograph has a separate moment
    larger = replace(
        network,
        images=(*network.images, *names),
        camera=np.concatenate([network.camera, np.full(len(chosen), camera)]),
        image_points=more,
        moment=None if moment is None else np.append(moment, moment.max() + 1 + np.arange(len(chosen))),
    )
    state = replace(
        estimate,
        position=np.concatenate([estimate.position, stations.position]),
        rotation=np.concatenate([estimate.rotation, stations.rotation]),
    )
    after = predict(larger, state)
    later = np.trace(after.covariance.points, axis1=1, axis2=2) / 3
    every = np.zeros((len(chosen), len(network.points)), dtype=bool)
    every[:, rows] = sight.seen
    worst = rows[np.argsort(-variance[rows], kind="stable")[:MAX_LISTED]]
    return Further(
        estimate.cameras[camera].name,
        stations,
        every,
        shots(estimate.points, stations, every, np.zeros(0, dtype=np.int64)),
        worst,
        np.sqrt(np.where(known, variance, np.inf)),
        np.sqrt(np.where(known, later, np.inf)),
        after,
    )


def _with_mean_normals(network: Network, estimate: Estimate, rows: IntArray) -> PlannedObject:
    """Return the selected points, with the mean direction of their rays as their normals."""
    seen = network.image_points
    ray = estimate.position[seen.image] - estimate.points[seen.point]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    usable = np.isfinite(ray).all(axis=1)
    total = np.zeros((len(network.points), 3))
    np.add.at(total, seen.point[usable], ray[usable])
    length = np.linalg.norm(total[rows], axis=1, keepdims=True)
    normals = np.where(length > 1e-9, total[rows] / np.maximum(length, 1e-9), np.nan)
    return PlannedObject(tuple(network.points[j] for j in rows), estimate.points[rows], normals)


def _chosen(
    planned: PlannedObject, camera: Camera, room: Candidates, covariance: FloatArray, count: int
) -> IntArray:
    """Return candidates, each the one that then improves the weakest points most, (count,)."""
    rows = image_rows(planned, camera, room.stations, room.sight)
    Q = covariance.copy()
    scale = np.full(len(Q), 3 / np.median(np.trace(Q, axis1=1, axis2=2)))
    open_ = np.ones(len(room.stations), dtype=bool)
    chosen: list[int] = []
    while len(chosen) < min(count, room.count):
        best = int(np.argmax(gains(Q, rows, scale, open_)))
        chosen.append(best)
        report_step("photographs chosen", len(chosen), min(count, room.count))
        open_[[best, (best + room.count) % (2 * room.count)]] = False
        A = rows[best]
        QA = Q @ A.transpose(0, 2, 1)
        Q = Q - QA @ np.linalg.inv(np.eye(2) + A @ QA) @ QA.transpose(0, 2, 1)
    return np.array(chosen, dtype=np.int64)
