"""Photographs of a plan: its points are shown as circular targets, coded ones with their ring.

Each target is on a separate card that faces in the direction of its point. Cards and background have the same
brightness, so that only targets are visible. A photograph shows the targets that the plan predicts; objects
that hide other targets are not drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from sfm.model.camera import Camera
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.errors import GeometryError, OutputError
from sfm.products.rendering.render import corner_rays, render_photograph
from sfm.products.rendering.scene import (
    UNCODED,
    CircularTargets,
    Faces,
    Marks,
    Optics,
    Scene,
    coded_ring,
    discs,
    join_marks,
)
from sfm.targets.codes.rings import CodeFamily

PAPER, INK = 0.8, 0.08  # reflectance of cards and of targets
MARGIN = 1.25  # size of a card over its target or ring


@dataclass(frozen=True)
class PlannedTargets:
    """Targets of a plan, all of one size."""

    xyz: FloatArray  # centres, object unit, (n, 3)
    normals: FloatArray  # directions in which they face, length 1, (n, 3)
    code: IntArray  # code numbers, UNCODED = a dot without a ring, (n,)
    radius: float  # of the dots, object unit
    family: CodeFamily  # of the codes

    @property
    def reach(self) -> FloatArray:
        """Radius of each with its ring, object unit, (n,)."""
        return self.radius * np.where(self.code == UNCODED, 1.0, self.family.outer)

    def select(self, rows: BoolArray) -> PlannedTargets:
        """Return some of the targets, (n,)."""
        return replace(self, xyz=self.xyz[rows], normals=self.normals[rows], code=self.code[rows])


def planned_scene(planned: PlannedTargets) -> Scene:
    """Return a scene of targets, each on a card that faces along a normal.

    Raises:
        GeometryError: the family has no such code.
    """
    xyz, normals, code, radius = planned.xyz, planned.normals, planned.code, planned.radius
    helper = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    a = np.cross(helper, normals)
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    n = len(xyz)
    half = MARGIN * planned.reach
    faces = Faces(
        xyz,
        np.stack([a, np.cross(normals, a)], axis=1),
        np.column_stack([half, half]),
        np.full(n, PAPER),
        np.zeros(n),
        np.ones(n),
    )
    middle = np.zeros((1, 2))
    marks: list[Marks] = [
        discs(k, middle, radius, INK)
        if code[k] == UNCODED
        else coded_ring(k, middle[0], radius, int(code[k]), planned.family, INK)
        for k in range(n)
    ]
    targets = CircularTargets(np.arange(n), np.zeros((n, 2)), np.full(n, radius), code)
    return Scene(faces, join_marks(marks), targets, background=PAPER)


def write_planned_photographs(
    paths: Sequence[Path],
    camera: Camera,
    position: FloatArray,
    rotation: FloatArray,
    *,
    targets: PlannedTargets,
    seen: BoolArray,
    optics: Optics,
    seed: int,
) -> None:
    """Render the photographs of a plan and write them into existing folders.

    Args:
        paths: files of the photographs, m of them.
        camera: interior orientation.
        position: projection centres, object unit, (m, 3).
        rotation: R of each, (m, 3, 3).
        targets: the targets of the plan, n of them.
        seen: which photograph shows which target, (m, n).
        optics: blur, exposure and noise.
        seed: seed of the noise.

    Raises:
        GeometryError: a code that the family does not have, or targets that overlap.
        OutputError: a photograph cannot be written.
    """
    _refuse_overlap(targets.xyz, targets.reach, seen)
    rays = corner_rays(camera)
    sources = np.random.default_rng(seed).spawn(len(paths))
    for i, path in enumerate(paths):
        scene = planned_scene(targets.select(seen[i]))
        photograph, _ = render_photograph(
            scene, camera, position[i], rotation[i], optics=optics, rng=sources[i], rays=rays
        )
        if not cv2.imwrite(str(path), photograph, [cv2.IMWRITE_PNG_COMPRESSION, 1]):
            raise OutputError(f"{path}: the photograph could not be written")


def _refuse_overlap(xyz: FloatArray, reach: FloatArray, seen: BoolArray) -> None:
    """Raise GeometryError if two targets in one photograph are closer than their rings allow."""
    together = seen.T.astype(np.int64) @ seen.astype(np.int64) > 0
    distance = np.linalg.norm(xyz[:, None] - xyz[None], axis=2) - MARGIN * (reach[:, None] + reach[None])
    np.fill_diagonal(distance, np.inf)
    distance[~together] = np.inf
    j, k = np.unravel_index(int(np.argmin(distance)), distance.shape)
    if distance[j, k] < 0:
        apart = float(np.linalg.norm(xyz[j] - xyz[k]))
        raise GeometryError(
            f"simulation: targets {apart:.4g} apart with rings of {2 * reach[j]:.4g} and {2 * reach[k]:.4g} "
            "overlap; needed fewer points or smaller targets"
        )
