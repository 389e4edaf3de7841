"""Gain of one more photograph for the points that it shows, the orientations of all photographs held.

Each image point adds A'PA to the 3 x 3 normal matrix of its point, so that the gain of every candidate
follows from updates of rank 2, without any system of equations: limiting error propagation.

    Q' = Q - Q A' (P^-1 + A Q A')^-1 A Q

Source: Fraser (1987), Photogramm. Eng. Remote Sens. 53(5) (limiting error propagation); Foerstner and Wrobel
(2016), sec. 4.2.7 (recursive estimation).
"""

from __future__ import annotations

import numpy as np

from sfm.camera import Camera, pixel_jacobian
from sfm.conventions import BoolArray, FloatArray
from sfm.kernels.options import compiled
from sfm.planning.planned_object import PlannedObject
from sfm.planning.sight.visibility import Sight
from sfm.planning.stations import Stations

POWER = 4  # of the variances in the sum that represents the worst: smooth, so that ties are broken


def image_rows(planned: PlannedObject, camera: Camera, stations: Stations, sight: Sight) -> FloatArray:
    """Return A of every image point over its standard deviation, 0 where it is not seen, (m, n, 2, 3)."""
    m, n = sight.why.shape
    rows = np.zeros((m, n, 2, 3))
    for i in range(m):
        used = np.flatnonzero(sight.seen[i])
        if not len(used):
            continue
        R = stations.rotation[i]
        U, V, W = ((planned.xyz[used] - stations.position[i]) @ R).T
        zero = np.zeros(len(used))
        of_tangents = np.stack(
            [np.stack([-1 / W, zero, U / W**2], axis=1), np.stack([zero, -1 / W, V / W**2], axis=1)], axis=1
        )
        A = pixel_jacobian(camera, sight.xy[i, used]) @ of_tangents @ R.T
        whitening = np.linalg.inv(np.linalg.cholesky(sight.covariance[i, used]))
        rows[i, used] = whitening @ A
    return rows


def cost_of(variance: FloatArray, scale: FloatArray) -> float:
    """Return the sum of the variances of points over what is wanted, each to a power."""
    return float(((variance * scale) ** POWER).sum())


def gains(Q: FloatArray, rows: FloatArray, scale: FloatArray, open_: BoolArray) -> FloatArray:
    """Return by how much each candidate reduces the cost, (m,); -1 where it may not be taken.

    Args:
        Q: covariance of each point, object unit^2, (n, 3, 3).
        rows: of the candidates, see `image_rows`, (m, n, 2, 3).
        scale: 1 over the variance that is wanted of each point, (n,).
        open_: which candidates may be taken, (m,).
    """
    return np.asarray(_gains(Q, rows, scale, open_))


@compiled
def _gains(Q: FloatArray, rows: FloatArray, scale: FloatArray, open_: BoolArray) -> FloatArray:
    m, n = rows.shape[0], rows.shape[1]
    out = np.full(m, -1.0)
    QA = np.empty((3, 2))
    for c in range(m):
        if not open_[c]:
            continue
        total = 0.0
        for j in range(n):
            A = rows[c, j]
            if A[0, 0] == 0.0 and A[0, 1] == 0.0 and A[0, 2] == 0.0:
                continue
            for i in range(3):
                for a in range(2):
                    QA[i, a] = Q[j, i, 0] * A[a, 0] + Q[j, i, 1] * A[a, 1] + Q[j, i, 2] * A[a, 2]
            s00, s01, s11 = 1.0, 0.0, 1.0
            g00, g01, g11 = 0.0, 0.0, 0.0
            for i in range(3):
                s00 += A[0, i] * QA[i, 0]
                s01 += A[0, i] * QA[i, 1]
                s11 += A[1, i] * QA[i, 1]
                g00 += QA[i, 0] * QA[i, 0]
                g01 += QA[i, 0] * QA[i, 1]
                g11 += QA[i, 1] * QA[i, 1]
            drop = (s11 * g00 - 2.0 * s01 * g01 + s00 * g11) / (s00 * s11 - s01 * s01)
            before = scale[j] * (Q[j, 0, 0] + Q[j, 1, 1] + Q[j, 2, 2]) / 3.0
            after = max(before - scale[j] * drop / 3.0, 0.0)
            total += before**4 - after**4
        out[c] = total
    return out
