"""Relative orientations of two photographs, as of a camera that a machine has moved."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar, Self

import numpy as np

from sfm.conventions import angles_from_rotation, skew
from sfm.observations.kind import PHOTOGRAPH, Linear, Values
from sfm.observations.point_pairs import Pairs
from sfm.observations.pose import angle_jacobian


class RelativeOrientations(Pairs):
    """Position and angles of one photograph in the image axes of another."""

    name: ClassVar[str] = "relative orientations"
    single: ClassVar[str] = "relative orientation"
    components: ClassVar[tuple[str, ...]] = ("X", "Y", "Z", "omega", "phi", "kappa")
    angles: ClassVar[tuple[str, ...]] = ("omega", "phi", "kappa")
    texts_of: ClassVar[str] = PHOTOGRAPH

    def linearise(self, values: Values) -> Linear:
        """Return t = M1 (X2 - X1) and the angles of M1 R2, less those observed.

        With R <- R exp([w]x) the derivatives of t are -M1, [t]x by X1, w1 and M1, 0 by X2, w2; the second
        photograph turns by w2 - R2' R1 w1 in the axes of the first.
        """
        M1, M2 = values.M[self.start], values.M[self.end]
        t = np.einsum("nab,nb->na", M1, values.position[self.end] - values.position[self.start])
        R = M1 @ np.swapaxes(M2, 1, 2)
        turned = (angles_from_rotation(R) - self.value[:, 3:] + np.pi) % (2 * np.pi) - np.pi
        by_turn = angle_jacobian(np.swapaxes(R, 1, 2))
        first, second = np.zeros((2, len(self), 6, 6))
        first[:, :3, :3], first[:, :3, 3:] = -M1, skew(t)
        first[:, 3:, 3:] = -by_turn @ np.swapaxes(R, 1, 2)
        second[:, :3, :3], second[:, 3:, 3:] = M1, by_turn
        return Linear(np.hstack([t - self.value[:, :3], turned]), (first, second))

    def mistakes(self) -> Mapping[str, Self]:
        """Return the orientations of exchanged photographs."""
        return {**super().mistakes(), "exchanged": replace(self, start=self.end, end=self.start)}
