"""Truth of a rendered photograph: where each target of a scene is in it, and whether it is whole."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.camera import Camera, project
from sfm.conventions import BoolArray, FloatArray
from sfm.rendering.scene import Scene

# A ray meets this many points of the rim when the truth asks whether a target is hidden.
RIM = 16
# Corners of the polygon whose centre of area is the centre of the image of a circle.
OUTLINE = 256


@dataclass(frozen=True)
class ProjectedTargets:
    """Where each target of the scene is in a photograph."""

    centre: FloatArray  # image of the centre of the circle, px, NaN behind the camera, (n, 2)
    outline_centre: FloatArray  # centre of area of the image of the circle, px, (n, 2)
    diameter: FloatArray  # largest diameter of the image, px, (n,)
    visible: BoolArray  # whole in the photograph, seen from the front and not hidden, (n,)


def project_targets(
    scene: Scene, camera: Camera, position: FloatArray, rotation: FloatArray
) -> ProjectedTargets:
    """Return where the targets of a scene are in a photograph and which are whole in it."""
    faces, targets = scene.faces, scene.targets
    n = len(targets)
    angle = 2 * np.pi * np.arange(OUTLINE) / OUTLINE
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rim = targets.centre[:, None] + targets.radius[:, None, None] * circle
    outline = faces.place(np.repeat(targets.face, OUTLINE), rim.reshape(-1, 2))
    centre = project(camera, position, rotation, faces.place(targets.face, targets.centre))
    outline_px = project(camera, position, rotation, outline).reshape(n, OUTLINE, 2)
    width, height = camera.size_px
    inside = ((outline_px > 0) & (outline_px < (width - 1, height - 1))).all(axis=(1, 2))
    normal = faces.normals()
    front = np.einsum("fi,fi->f", normal, position - faces.centre)[targets.face] > 0
    seen = outline.reshape(n, OUTLINE, 3)[:, :: OUTLINE // RIM]
    hidden = np.array(
        [_hidden(scene, position, points, own) for points, own in zip(seen, targets.face, strict=True)],
        dtype=bool,
    )
    across = np.linalg.norm(outline_px - np.roll(outline_px, OUTLINE // 2, axis=1), axis=2)
    diameter = across.max(axis=1, initial=0.0)
    return ProjectedTargets(centre, _centre_of_area(outline_px), diameter, inside & front & ~hidden)


def _hidden(scene: Scene, position: FloatArray, points: FloatArray, own: int) -> bool:
    """Return whether any face stands between the camera and any of the points of one face."""
    faces = scene.faces
    direction = points - position
    for f, normal in enumerate(faces.normals()):
        height = float(normal @ (position - faces.centre[f]))
        if f == own or height <= 0:
            continue
        with np.errstate(divide="ignore", invalid="ignore"):
            part = -height / (direction @ normal)
            hit = position + part[:, None] * direction - faces.centre[f]
        within = (np.abs(hit @ faces.axes[f].T) < faces.half[f]).all(axis=1)
        if (within & (part > 0) & (part < 1 - 1e-9)).any():
            return True
    return False


def _centre_of_area(polygon: FloatArray) -> FloatArray:
    """Return the centres of area of polygons with corners (n, k, 2), taken about their first corner."""
    p = polygon - polygon[:, :1]
    q = np.roll(p, -1, axis=1)
    cross = p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
    moment = ((p + q) * cross[..., None]).sum(axis=1)
    return np.asarray(polygon[:, 0] + moment / (3 * cross.sum(axis=1))[:, None])
