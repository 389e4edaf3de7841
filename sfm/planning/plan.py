"""A plan: stations, what they will give, where that is weak, and what has to be taken along."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sfm.camera import Camera
from sfm.conventions import IntArray
from sfm.network import Network
from sfm.observations.kind import POINT
from sfm.planning.contributions import Contribution, contributions
from sfm.planning.design.designer import Design
from sfm.planning.planned_object import PlannedObject
from sfm.planning.prediction import Prediction, ScaleBarPlan, predict_network
from sfm.planning.shots import Shot, choose_coded, shots
from sfm.planning.sight import MIN_PIXELS
from sfm.planning.sight.visibility import Seeing
from sfm.planning.stations import Stations
from sfm.planning.target_size import STEEPEST_DEG, TargetSize, compute_target_size
from sfm.planning.wanted import WantedPrecision, short_of
from sfm.planning.weakness import (
    Calibratability,
    WeakPoint,
    calibratability,
    separate_groups,
    unusable_photographs,
    weak_points,
)


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
