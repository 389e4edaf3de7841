"""Points that are rigid to one another: bars of several targets, scale crosses, probes, frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar, Self

import numpy as np

from sfm.conventions import FloatArray, rotation_from_vector, skew
from sfm.observations.groups import Fit, Group

ON_LINE = 1e-6  # of the largest singular value, below which a turn does not change coordinates given


class RigidFrames(Group):
    """Coordinates of points in a system of their own, known up to a motion of it."""

    name: ClassVar[str] = "rigid frames"
    single: ClassVar[str] = "rigid frame"
    components: ClassVar[tuple[str, ...]] = ("X", "Y", "Z")
    least: ClassVar[int] = 2

    def fit(self, X: FloatArray) -> Fit:
        """Return R'(X - t) - observed of the best motion R, t; H by it."""
        W = self.weights.reshape(-1, 3)
        R, t = _motion(self.value, X, W.mean(axis=1))
        for _ in range(5):  # to the weights of single coordinates
            local = (X - t) @ R
            H, _ = self._by_motion(local)
            root = np.sqrt(W)
            rows, l = root.reshape(-1, 1) * H.reshape(-1, 6), (root * (local - self.value)).ravel()
            step: FloatArray = np.asarray(-np.linalg.lstsq(rows, l, rcond=1e-12)[0], dtype=float)
            centre = self.value.mean(axis=0)
            turned = R @ rotation_from_vector(step[3:])
            t = t + R @ step[:3] + (R - turned) @ centre
            R = turned
        local = (X - t) @ R
        H, about = self._by_motion(local)
        Jx = np.zeros((len(X), 3, len(X), 3))
        Jx[np.arange(len(X)), :, np.arange(len(X))] = R.T
        return Fit(local - self.value, self._without(about, Jx), self._without(about, H))

    def mistakes(self) -> Mapping[str, Self]:
        """Return the coordinates of a mirrored system."""
        return {"mirrored": replace(self, value=self.value * [1.0, 1.0, -1.0])}

    def _by_motion(self, local: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives of R'(X - t) by a shift and a turn about the centre of the frame, (p, 3, 6).

        Of points on a line a turn about it changes nothing but the errors of their coordinates: it is no
        parameter. Its derivatives are the second array, (p, 3, 3).

        Args:
            local: R'(X - t), (p, 3).
        """
        given, found = (skew(x - self.value.mean(axis=0)) for x in (self.value, local))
        _, singular, Vt = np.linalg.svd(given.reshape(-1, 3), full_matrices=False)
        on = singular > ON_LINE * singular[0]
        shift = np.tile(-np.eye(3), (len(local), 1, 1))
        turn, about = (found @ Vt[rows].T @ Vt[rows] for rows in (on, ~on))
        return np.concatenate([shift, turn], axis=2), about

    def _without(self, about: FloatArray, A: FloatArray) -> FloatArray:
        """Return derivatives without their part along a turn about the points, which may fix no attitude.

        Args:
            about: derivatives by turns, (p, 3, 3).
            A: derivatives, (p, 3, ...).
        """
        root = np.sqrt(self.weights)[:, None]
        U, singular, _ = np.linalg.svd(root * about.reshape(len(root), -1), full_matrices=False)
        U, flat = U[:, singular > ON_LINE * singular[0]], A.reshape(len(root), -1)
        return np.asarray(flat - U / root @ (U.T @ (root * flat))).reshape(A.shape)


def _motion(source: FloatArray, target: FloatArray, w: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return R, t with target near R source + t, by weighted least squares."""
    a, b = ((x * w[:, None]).sum(axis=0) / w.sum() for x in (source, target))
    U, _, Vt = np.linalg.svd((target - b).T @ ((source - a) * w[:, None]))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return R, b - R @ a
