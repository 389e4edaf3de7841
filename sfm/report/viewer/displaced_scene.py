"""The scene of two epochs: the points of the first with their displacements to the second."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sfm.comparison.stable_points import point_blocks
from sfm.epochs.displacements import Displacements
from sfm.report.viewer.scene import ViewerScene
from sfm.report.viewer.stored_scene import scene_of_stored
from sfm.solution import Solution

MOVED, STABLE, UNTESTED = "moved", "stable", "not tested"


def scene_of_displacements(found: Displacements, first: Solution) -> ViewerScene:
    """Return the scene of an epoch with the displacement of every point and what the test says of it.

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
