"""Moments of closed outlines, as truth for ellipses."""

from __future__ import annotations

import numpy as np

from sfm.model.conventions import FloatArray


def moments_of_area(outline: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return centre and second central moments of the area in a closed outline (n, 2), by Green's theorem."""
    o = outline - outline.mean(axis=0)
    q = np.roll(o, -1, axis=0)
    cross = o[:, 0] * q[:, 1] - q[:, 0] * o[:, 1]
    area = cross.sum() / 2
    m = ((o + q) * cross[:, None]).sum(axis=0) / (6 * area)
    second = np.einsum("k,kij->ij", cross, o[:, :, None] * o[:, None] + q[:, :, None] * q[:, None])
    mixed = np.einsum("k,kij->ij", cross, o[:, :, None] * q[:, None])
    return m + outline.mean(axis=0), (2 * second + mixed + mixed.T) / (24 * area) - np.outer(m, m)
