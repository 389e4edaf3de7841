"""The warp of a patch: homography H from its window to pixels of the right photograph."""

from __future__ import annotations

import numpy as np

from sfm.conventions import FloatArray
from sfm.kernels.options import compiled

MAX_STRETCH = 3.0  # ratio of lengths, of a patch in both photographs, that is a match no more


@compiled
def put_step(H: FloatArray, q: FloatArray, half: int, geometric: int) -> float:
    """Put the step q on H, H <- H dH^-1; return the shift in px, inf if the patch is turned inside out."""
    beta = q[geometric + 1]
    if not beta > 0.0:
        return np.inf
    x, y = H[0, 2], H[1, 2]
    d00, d01, d02 = 1.0, 0.0, half * q[0] / beta
    d10, d11, d12 = 0.0, 1.0, half * q[1] / beta
    d20, d21 = 0.0, 0.0
    if geometric > 2:
        d00 += q[2] / beta
        d01 += q[3] / beta
        d10 += q[4] / beta
        d11 += q[5] / beta
    if geometric > 6:
        d20, d21 = q[6] / (beta * half), q[7] / (beta * half)
    # adjugate of dH; its determinant is only a scale, which the norm H[2, 2] = 1 takes out
    a00, a01, a02 = d11 - d12 * d21, d02 * d21 - d01, d01 * d12 - d02 * d11
    a10, a11, a12 = d12 * d20 - d10, d00 - d02 * d20, d02 * d10 - d00 * d12
    a20, a21, a22 = d10 * d21 - d11 * d20, d01 * d20 - d00 * d21, d00 * d11 - d01 * d10
    if not d00 * a00 + d10 * a01 + d20 * a02 > 1e-3:
        return np.inf
    for i in range(3):
        h0, h1, h2 = H[i, 0], H[i, 1], H[i, 2]
        H[i, 0] = h0 * a00 + h1 * a10 + h2 * a20
        H[i, 1] = h0 * a01 + h1 * a11 + h2 * a21
        H[i, 2] = h0 * a02 + h1 * a12 + h2 * a22
    if not H[2, 2] > 0.0:
        return np.inf
    scale = 1.0 / H[2, 2]
    for i in range(3):
        for j in range(3):
            H[i, j] *= scale
    det = area_ratio(H)
    if not (det > MAX_STRETCH**-2 and det < MAX_STRETCH**2):
        return np.inf
    return float(np.hypot(H[0, 2] - x, H[1, 2] - y))


@compiled
def area_ratio(H: FloatArray) -> float:
    """Return the right area of a unit area at the point: the determinant of d(H x)/dx at x = 0."""
    xx, xy = H[0, 0] - H[0, 2] * H[2, 0], H[0, 1] - H[0, 2] * H[2, 1]
    yx, yy = H[1, 0] - H[1, 2] * H[2, 0], H[1, 1] - H[1, 2] * H[2, 1]
    ratio: float = xx * yy - xy * yx
    return ratio


def linear_part(warp: FloatArray) -> FloatArray:
    """Return d(H x)/dx at x = 0 of homographies (k, 3, 3) whose H[2, 2] is 1, (k, 2, 2)."""
    return np.asarray(warp[:, :2, :2] - warp[:, :2, 2:] * warp[:, 2:, :2])
