"""What the photographs themselves say of orientations that a few marks leave open.

Five marks in two photographs, and three known points in one, fit several orientations. The right one is
that in which other features of the photographs lie on their epipolar lines: natural features that look
alike, and the targets, which need not be told apart. Hits by chance are subtracted.

Source: Longuet-Higgins (1981), Nature 293, for the epipolar constraint.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from functools import cache

import cv2
import numpy as np

from sfm.matching.epipolar import essential_matrices
from sfm.matching.tracks.features import MAX_SIDE_PX, Features, match_features, sift_features
from sfm.model.camera import Camera, project, tangents_from_pixel
from sfm.model.conventions import AnyArray, FloatArray
from sfm.targets.detect import find_targets

# Distances from an epipolar line, and from the place of a point, that a few marks give: the mean of the
# hits within each counts near ones most, and those far off with a lens that is not known yet.
NEAR_PX, PLACE_PX = (2.0, 4.0, 8.0), (5.0, 10.0, 20.0)
Pose = tuple[FloatArray, FloatArray]  # projection centre (3,) and rotation, image to object axes, (3, 3)


class PictureEvidence:
    """Features of photographs that support orientations; each photograph is searched once."""

    def __init__(self, read: Callable[[int], AnyArray], cameras: Sequence[Camera]) -> None:
        """Take the photographs.

        Args:
            read: returns the intensities of a photograph, (H, W).
            cameras: the camera of each photograph.
        """
        self._cameras = tuple(cameras)
        self._features: Callable[[int], Features] = cache(lambda i: sift_features(read(i)))
        self._targets: Callable[[int], FloatArray] = cache(lambda i: _reduced_targets(read(i)))
        self._alike: Callable[[int, int], tuple[FloatArray, FloatArray]] = cache(self._match)

    def with_cameras(self, cameras: Sequence[Camera]) -> PictureEvidence:
        """Return the same features with another interior orientation of each photograph."""
        other = copy(self)
        other._cameras = tuple(cameras)
        return other

    def matches(self, i: int, j: int) -> tuple[FloatArray, FloatArray]:
        """Return the tangents of features of two photographs that look alike, (k, 2) each."""
        a, b = self._alike(i, j)
        return tangents_from_pixel(self._cameras[i], a), tangents_from_pixel(self._cameras[j], b)

    def support(self, i: int, j: int, first: Pose, second: Pose) -> float:
        """Return the number of features that lie on epipolar lines, beyond chance.

        Args:
            i: index of a photograph.
            j: index of another photograph.
            first: orientation of photograph i.
            second: orientation of photograph j.
        """
        position, rotation = np.array([first[0], second[0]]), np.array([first[1], second[1]])
        E = essential_matrices(position, rotation, np.array([[0, 1]]))[0]
        near = [px / self._cameras[j].c_px for px in NEAR_PX]
        a, b = self.matches(i, j)
        alike = 0.0
        if len(a):
            off = _distances(E, a, b, pairs=True)
            alike = float(np.mean([(off <= limit).sum() for limit in near]))
        p, q = (tangents_from_pixel(self._cameras[k], self._targets(k)) for k in (i, j))
        if not (len(p) and len(q)):
            return alike
        off = _distances(E, p, q, pairs=False).min(axis=1)
        height = float(np.ptp(q[:, 1]))
        beyond = [
            (off <= limit).sum() - len(p) * (1 - (1 - min(2 * limit / (height + 2 * limit), 1.0)) ** len(q))
            for limit in near
        ]
        return alike + float(np.mean(beyond))

    def places(self, i: int, pose: Pose, points: FloatArray) -> float:
        """Return the number of points with a target where an orientation predicts them, beyond chance.

        Args:
            i: index of a photograph.
            pose: its orientation.
            points: object points, NaN where unknown, object unit, (n, 3).
        """
        camera, targets = self._cameras[i], self._targets(i)
        at = project(camera, pose[0], pose[1], points)
        at = at[np.isfinite(at).all(axis=1)]
        inside = ((at >= 0) & (at <= np.array(camera.size_px) - 1)).all(axis=1)
        at = at[inside]
        if not (len(at) and len(targets)):
            return 0.0
        off = np.linalg.norm(at[:, None] - targets, axis=2).min(axis=1)
        area = float(np.prod(camera.size_px))
        beyond = [
            (off <= limit).sum() - len(at) * min(len(targets) * np.pi * limit**2 / area, 1.0)
            for limit in PLACE_PX
        ]
        return float(np.mean(beyond))

    def _match(self, i: int, j: int) -> tuple[FloatArray, FloatArray]:
        """Return the places of features of two photographs that look alike, px, (k, 2) each."""
        a, b = self._features(i), self._features(j)
        rows = match_features(a, b)
        return a.xy[rows[:, 0]], b.xy[rows[:, 1]]


def _reduced_targets(photograph: AnyArray) -> FloatArray:
    """Return the targets of a photograph, px, (k, 2), found in it at a size that is searched in a second."""
    shrink = -(-max(photograph.shape) // MAX_SIDE_PX)
    if shrink == 1:
        return find_targets(photograph).xy
    height, width = (side // shrink for side in photograph.shape)
    part = photograph[: height * shrink, : width * shrink]
    small = np.asarray(cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA))
    return np.asarray(shrink * (find_targets(small).xy + 0.5) - 0.5)


def _distances(E: FloatArray, first: FloatArray, second: FloatArray, *, pairs: bool) -> FloatArray:
    """Return the distances of rays from epipolar lines, tangents: of pairs, (k,), or all, (k, l)."""
    p, q = (np.column_stack([uv, -np.ones(len(uv))]) for uv in (first, second))
    lines = p @ E.T
    length = np.hypot(lines[:, 0], lines[:, 1])
    product = np.einsum("ki,ki->k", lines, q) if pairs else lines @ q.T
    return np.asarray(np.abs(product) / (length if pairs else length[:, None]))
