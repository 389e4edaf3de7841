"""After a survey: which few photographs more would help its weakest points most.

Directions are taken from the existing rays: a point faces the mean of its rays. Obstacles in other directions
are not known.

Source: Fedorov (1972), Theory of Optimal Experiments (augmentation of a design).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import predict
from sfm.arguments import checked_arguments
from sfm.camera import Camera
from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.display import counted
from sfm.errors import GeometryError
from sfm.network import Estimate, ImagePoints, Network
from sfm.planning.design.candidates import Candidates, StationLimits, candidates, gains, image_rows
from sfm.planning.planned_object import PlannedObject
from sfm.planning.sight.visibility import Seeing
from sfm.planning.stations import Shot, Stations, shots
from sfm.runtime.progress import report_step

DISTANCES = (0.8, 1.2)  # of those that the survey was photographed from
ROOM = 0.25  # by which the box around its stations may be left, of its size
MAX_LISTED = 10  # points that are listed


@dataclass(frozen=True)
class Further:
    """Photographs to be added to a survey, and what they will give."""

    camera: str  # that they are taken with
    stations: Stations
    seen: BoolArray  # which of them shows which point, (m, n)
    shots: tuple[Shot, ...]
    points: IntArray  # the weakest points before, as indices, (w,)
    before: FloatArray  # sigma of every point, RMS of its coordinates, object unit, (n,)
    after: FloatArray  # with the further photographs, (n,)
    adjustment: Adjustment  # predicted, of survey and further photographs together


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
    """Return the photographs that help the weakest points of a survey most.

    They are taken with the camera that most photographs have, without the others of its rig, from the
    distances and within the room that it was photographed from.

    Args:
        network: of the survey, with the standard deviations that its image points turned out to have.
        estimate: its solution.
        sigma_px: standard deviation of an image coordinate in further photographs, px.
        count: photographs to add.
        candidate_count: stations to choose from.
        max_incidence_deg: of a ray to the mean of the rays that there are.

    Raises:
        GeometryError: fewer than 2 photographs or 3 points, no count, or nothing is seen from there.

    Source: Fedorov (1972); limiting error propagation, see `sfm.planning.design.candidates`.
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
    planned = _faced(network, estimate, rows)
    camera = int(np.bincount(network.camera[oriented]).argmax())
    seeing = Seeing(sigma_px=sigma_px, max_incidence_deg=max_incidence_deg)
    room = candidates(
        planned,
        estimate.cameras[camera],
        _room(planned, estimate.position[oriented]),
        seeing,
        count=candidate_count,
    )
    chosen = _chosen(planned, estimate.cameras[camera], room, before.covariance.points[rows], count)
    names = _new_names(network.images, len(chosen))
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
    moment = network.moment  # of photographs of a rig: further ones are single
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


def _faced(network: Network, estimate: Estimate, rows: IntArray) -> PlannedObject:
    """Return some points with the mean of their rays as the direction that they face."""
    seen = network.image_points
    ray = estimate.position[seen.image] - estimate.points[seen.point]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    usable = np.isfinite(ray).all(axis=1)
    total = np.zeros((len(network.points), 3))
    np.add.at(total, seen.point[usable], ray[usable])
    length = np.linalg.norm(total[rows], axis=1, keepdims=True)
    normals = np.where(length > 1e-9, total[rows] / np.maximum(length, 1e-9), np.nan)
    return PlannedObject(tuple(network.points[j] for j in rows), estimate.points[rows], normals)


def _room(planned: PlannedObject, position: FloatArray) -> StationLimits:
    """Return the room that a survey was photographed from, a little larger."""
    nearest = np.linalg.norm(planned.xyz[None] - position[:, None], axis=2).min(axis=1)
    low, high = position.min(axis=0), position.max(axis=0)
    margin = ROOM * float(np.linalg.norm(high - low)) + 1e-6 * planned.size
    return StationLimits(
        (DISTANCES[0] * float(nearest.min()), DISTANCES[1] * float(nearest.max())),
        np.stack([low - margin, high + margin]),
    )


def _chosen(
    planned: PlannedObject, camera: Camera, room: Candidates, covariance: FloatArray, count: int
) -> IntArray:
    """Return the candidates of which each next one helps the weakest points most, (count,)."""
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


def _new_names(taken: tuple[str, ...], count: int) -> tuple[str, ...]:
    """Return names of further photographs that no photograph has."""
    free = (f"new {k}" for k in range(1, len(taken) + count + 1) if f"new {k}" not in taken)
    return tuple(next(free) for _ in range(count))
