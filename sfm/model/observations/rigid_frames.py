"""Rigid frames: points in fixed relation, such as bars with several targets, scale crosses, and probes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np
from scipy.linalg import block_diag

from sfm.model.conventions import FloatArray, rotation_from_vector, skew
from sfm.model.observations.kind import Fit, Group, Names, OwnParameters, Values, inverse_of_determined

ROUNDING = 1e-13  # of the frame: a smaller step of its motion is only rounding
ON_LINE = 1e-6  # share of the largest singular value below which a rotation does not change given coordinates


@dataclass(frozen=True)
class RigidFrames(Group):
    """Coordinates of points in a local system, known up to a rigid motion.

    Points of the frame that no photograph shows, such as the tip of a probe, are parameters. They add nothing
    to the adjustment, and follow from the motion of the frame.
    """

    name: ClassVar[str] = "rigid frames"
    single: ClassVar[str] = "rigid frame"
    components: ClassVar[tuple[str, ...]] = ("X", "Y", "Z")
    least: ClassVar[int] = 2

    hidden: tuple[str, ...] = ()  # names of points that no photograph shows, (q,)
    hidden_value: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))  # local coordinates, (q, 3)
    hidden_sigma: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))  # (q, 3)

    @property
    def reported(self) -> tuple[str, ...]:
        """Names of the coordinates of points that no photograph shows."""
        return tuple(f"{name} {axis}" for name in self.hidden for axis in self.components)

    def own_parameters(self, values: Values) -> OwnParameters:
        """Return the points that no photograph shows, R l + t, with the effect of errors of the motion.

        If the visible points lie on a line, the rotation about it is not determined, and neither are hidden
        points off the line. Their cofactors are infinite.
        """
        X, W = values.points[self.point], self.weights
        R, t = self._fitted(X)
        local = (X - t) @ R
        H = self._by_motion(local)[0].reshape(len(W), -1)
        Q = inverse_of_determined((H.T * W) @ H)
        by_motion = -Q @ (H.T * W) @ np.kron(np.eye(len(X)), R.T)  # derivatives of d(local) = R' dX
        arm = self.hidden_value - self.value.mean(axis=0)
        A = np.concatenate([np.broadcast_to(R, (len(arm), 3, 3)), -R @ skew(arm)], axis=2).reshape(-1, 6)
        alone = R @ (self.hidden_sigma[:, :, None] ** 2 * R.T)
        cofactor = A @ Q @ A.T + block_diag(*alone)
        _, about = self._axes
        turned = (np.abs(A[:, 3:] @ about.T) > ON_LINE * np.abs(arm).max()).any(axis=1)
        cofactor[turned, turned] = np.inf
        J = (A @ by_motion).reshape(len(A), -1, 3)
        return OwnParameters((self.hidden_value @ R.T + t).ravel(), cofactor, J)

    def table_rows(self, network: Names) -> list[tuple[str | float, ...]]:
        """Return the rows of the table of coordinates, with points that no photograph shows last."""
        numbers = np.hstack([self.hidden_value, self.hidden_sigma]).tolist()
        rows = zip(self.hidden, numbers, strict=True)
        return [*super().table_rows(network), *((self.group, name, *values) for name, values in rows)]

    def fit(self, X: FloatArray) -> Fit:
        """Return R'(X - t) - observed for the best motion R, t, with derivatives H by the motion."""
        R, t = self._fitted(X)
        local = (X - t) @ R
        H, about = self._by_motion(local)
        Jx = np.zeros((len(X), 3, len(X), 3))
        Jx[np.arange(len(X)), :, np.arange(len(X))] = R.T
        if len(self._axes[1]):
            Jx, H = self._without(about, Jx), self._without(about, H)
        return Fit(local - self.value, Jx, H)

    def _fitted(self, X: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the motion R, t that fits the frame to its points best: X near R local + t."""
        W = self.weights.reshape(-1, 3)
        w = W.mean(axis=1)
        a, b = ((x * w[:, None]).sum(axis=0) / w.sum() for x in (self.value, X))
        U, _, Vt = np.linalg.svd((X - b).T @ ((self.value - a) * w[:, None]))
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        t, size, root = b - R @ a, np.abs(self.value - a).max(), np.sqrt(W)
        for _ in range(5):  # iterations with the weights of single coordinates
            local = (X - t) @ R
            H, _ = self._by_motion(local)
            rows, l = root.reshape(-1, 1) * H.reshape(-1, 6), (root * (local - self.value)).ravel()
            step: FloatArray = np.asarray(-np.linalg.lstsq(rows, l, rcond=1e-12)[0], dtype=float)
            turned = R @ rotation_from_vector(step[3:])
            t = t + R @ step[:3] + (R - turned) @ self._centre
            R = turned
            if max(np.abs(step[:3]).max(), size * np.abs(step[3:]).max()) < ROUNDING * size:
                break
        return R, t

    def mistakes(self) -> Mapping[str, Self]:
        """Return the coordinates in a mirrored system."""
        return {**super().mistakes(), "mirrored": replace(self, value=self.value * [1.0, 1.0, -1.0])}

    def _by_motion(self, local: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives of R'(X - t) by a shift and a rotation about the centre, (p, 3, 6).

        If the points lie on a line, a rotation about it changes only the errors of their coordinates, so it
        is not a parameter. Its derivatives are the second array, (p, 3, 3).

        Args:
            local: R'(X - t), (p, 3).
        """
        moments, H = skew(local - self._centre), np.zeros((len(local), 3, 6))
        H[:, :, :3] = -np.eye(3)
        (on, off), H[:, :, 3:] = self._axes, moments
        if not len(off):
            return H, np.zeros((len(local), 3, 3))
        H[:, :, 3:] = moments @ on.T @ on
        return H, moments @ off.T @ off

    @cached_property
    def _centre(self) -> FloatArray:
        """Return the mean of the given coordinates, (3,)."""
        return np.asarray(self.value.mean(axis=0))

    @cached_property
    def _axes(self) -> tuple[FloatArray, FloatArray]:
        """Return the axes of rotations that change the given coordinates, (3 or 2, 3), and any other axis."""
        given = skew(self.value - self._centre).reshape(-1, 3)
        _, singular, Vt = np.linalg.svd(given, full_matrices=False)
        on = singular > ON_LINE * singular[0]
        return Vt[on], Vt[~on]

    def _without(self, about: FloatArray, A: FloatArray) -> FloatArray:
        """Return derivatives without their part along a rotation about the line of the points.

        This rotation must not fix any attitude.

        Args:
            about: derivatives by the rotation, (p, 3, 3).
            A: derivatives, (p, 3, ...).
        """
        root = np.sqrt(self.weights)[:, None]
        U, singular, _ = np.linalg.svd(root * about.reshape(len(root), -1), full_matrices=False)
        U, flat = U[:, singular > ON_LINE * singular[0]], A.reshape(len(root), -1)
        return np.asarray(flat - U / root @ (U.T @ (root * flat))).reshape(A.shape)
