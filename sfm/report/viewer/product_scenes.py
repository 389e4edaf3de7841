"""Scenes of what follows from solutions: displacements, measurements and plans."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sfm.comparison.stable_points import point_blocks
from sfm.conventions import FloatArray
from sfm.geometry.tolerance import Deviations
from sfm.network import Estimate, ImagePoints, Network
from sfm.report.viewer.embedded import Viewer, viewer_of
from sfm.report.viewer.pictures import Pictures, cut_pictures
from sfm.report.viewer.scene import ViewerScene
from sfm.report.viewer.solution_scene import scene_of_stored
from sfm.solution import Solution

if TYPE_CHECKING:
    from sfm.epochs.displacements import Displacements
    from sfm.epochs.series import EpochSeries
    from sfm.geometry.shapes.fit import ShapeFit
    from sfm.inspection.measure import Measurement
    from sfm.planning.plan import Plan

MOVED, STABLE, UNTESTED = "moved", "stable", "not tested"


def displacements_viewer(found: EpochSeries) -> Viewer | None:
    """Return the scene of the first epoch with the displacements to the last; None without photographs."""
    if not found.first.result.estimate.oriented.any():
        return None
    scene = _scene_of_displacements(found.since_first[-1].displacements, found.first.result)
    return viewer_of(scene, cut_pictures(scene, {}, budget_mb=0.0))


def _scene_of_displacements(found: Displacements, first: Solution) -> ViewerScene:
    """Return the scene of an epoch with the displacement of every point and the outcome of its test.

    Standard deviations and ellipsoids are those of the displacements.

    Args:
        found: displacements from this epoch to another one.
        first: the epoch.
    """
    names = first.network.points
    row = {name: j for j, name in enumerate(names)}
    tested = np.array([row[name] for name in found.differences.points], dtype=np.int64)
    covariance = np.full((len(names), 3, 3), np.nan)
    covariance[tested] = point_blocks(found.covariance, 3)
    scene = scene_of_stored(replace(first, point_covariance=covariance, covariance=None))
    displacement = np.full((len(names), 3), np.nan)
    displacement[tested] = found.displacement
    state = [UNTESTED] * len(names)
    for k, j in enumerate(tested.tolist()):
        state[j] = MOVED if found.moved[k] else STABLE if found.stable[k] else ""
    kept = [row[name] for name in scene.points]
    return replace(
        scene,
        name=" to ".join(found.differences.names),
        displacement=displacement[kept],
        state=tuple(state[j] for j in kept),
        notes=(
            *scene.notes,
            f"Displacements from {found.differences.names[0]} to {found.differences.names[1]}; standard "
            "deviations and ellipsoids are those of the displacements.",
        ),
    )


def measurement_viewer(found: Measurement, result: Solution) -> Viewer | None:
    """Return the scene in the system of a measurement; None without photographs."""
    if not result.estimate.oriented.any():
        return None
    estimate, n = result.estimate, int(result.estimate.determined.sum())
    positions = result.position_covariance
    if found.alignment is not None:
        estimate = found.alignment.aligned_from_object.apply_estimate(estimate)
        positions = None
    kept = np.flatnonzero(result.estimate.determined)
    covariance = np.full((len(result.network.points), 3, 3), np.nan)
    covariance[kept] = found.points.blocks[:n]
    moved = replace(
        result,
        estimate=estimate,
        point_covariance=covariance,
        position_covariance=positions,
        covariance=None,
        unit=found.unit,
    )
    scene = scene_of_stored(moved)
    deviation = _worst_deviation(found)[:n]
    if np.isfinite(deviation).any():
        scene = replace(scene, deviation=deviation)
    return viewer_of(scene, cut_pictures(scene, {}, budget_mb=0.0))


def _worst_deviation(found: Measurement) -> FloatArray:
    """Return of each point its largest deviation from what tolerances, else shapes, say; NaN without any."""
    worst = np.full(len(found.points.names), np.nan)
    judged: list[Deviations | ShapeFit] = [*found.tolerances] or [*found.shapes]
    for one in judged:
        value = one.value if isinstance(one, Deviations) else one.deviation
        larger = ~(np.abs(value) <= np.abs(worst[one.points]))
        worst[one.points[larger]] = value[larger]
    return worst


def plan_viewer(plan: Plan) -> Viewer:
    """Return the scene of a plan: stations, rays and all points, those not determined included."""
    p = plan.prediction
    a = p.adjustment
    m, n = np.nonzero(p.sight.seen)
    network = Network(
        p.stations.names,
        p.stations.camera,
        p.planned.names,
        ImagePoints(m, n, p.sight.xy[m, n], p.sight.covariance[m, n]),
    )
    estimate = Estimate(p.cameras, p.stations.position, p.stations.rotation, p.planned.xyz)
    covariance = np.where(np.isfinite(p.covariance), p.covariance, np.nan)
    of_position = np.full((len(p.stations), 3, 3), np.nan)
    used = p.photograph >= 0
    of_position[used] = a.covariance.exterior[p.photograph[used], :3, :3]
    solution = Solution(plan.name, network, estimate, covariance, of_position, unit=plan.unit)
    return viewer_of(scene_of_stored(solution), Pictures())
