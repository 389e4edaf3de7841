"""Painting order: which face of a scene hides which, seen from a camera."""

from __future__ import annotations

import numpy as np

from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.rendering.scene import Scene

# Faces that reach into each other by less than this part of the largest one only touch.
TOUCHING = 1e-6


def painting_order(scene: Scene, position: FloatArray) -> IntArray:
    """Return the faces turned to the camera, from back to front (painter's algorithm).

    Of two faces whose images overlap, one is painted first if it lies on the far side of the plane of the
    other, or the other on the near side of its own.

    Source: Newell, Newell and Sancha (1972), Proc. ACM National Conference, p. 443 (tests 2 to 4).
    """
    faces = scene.faces
    normal = faces.normals()
    turned = np.flatnonzero(np.einsum("fi,fi->f", normal, position - faces.centre) > 0)
    corners = faces.corners()
    # Height of the corners of face g above the plane of face f.
    above = np.einsum("fi,fgci->fgc", normal, corners[None] - faces.centre[:, None, None])
    slack = TOUCHING * np.abs(faces.half).max(initial=0.0)
    far = (above <= slack).all(axis=2).T  # [g, f]: g is on the far side of f
    near = (above >= -slack).all(axis=2).T
    may_precede = far | near.T  # [g, f]: g may be painted before f
    must_precede = may_precede & ~may_precede.T
    distance = np.linalg.norm(faces.centre - position, axis=1)
    rest = list(turned[np.argsort(-distance[turned], kind="stable")])
    must_precede &= ~_apart(corners - position, slack)
    order: list[int] = []
    while rest:
        ready = [g for g in rest if not any(must_precede[f, g] for f in rest)]
        # Faces that overlap in a circle have no order; then the farthest goes first.
        order.append(int((ready or rest)[0]))
        rest.remove(order[-1])
    return np.array(order, dtype=np.int64)


def _apart(corners: FloatArray, slack: float) -> BoolArray:
    """Return which faces have images apart from each other, (f, f), from corners (f, 4, 3) off the camera.

    Two convex images are apart if a plane through the camera and an edge of one has the other outside.
    """
    sight = np.cross(corners, np.roll(corners, -1, axis=1))  # normals of these planes
    sight /= np.linalg.norm(sight, axis=2, keepdims=True)
    side = np.einsum("fei,gci->fegc", sight, corners)
    inner = np.einsum("fei,fi->fe", sight, corners.mean(axis=1))
    outside = (side * -np.sign(inner)[:, :, None, None] >= -slack).all(axis=3).any(axis=1)
    return np.asarray(outside | outside.T)
