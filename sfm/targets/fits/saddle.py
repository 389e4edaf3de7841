"""Crossings of a checkerboard: the point that all edges around it run through, with its covariance.

Every pixel of an edge says that the crossing lies on the line through it across its gradient. Their
intersection, weighted by the squared gradient, is the crossing; blur, which is the same on both sides of an
edge, does not move it. The covariance is that of the noise of the intensities, carried through the filters.

Source: Foerstner and Guelch (1987), ISPRS Intercommission Workshop Interlaken (precise location of corners).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sfm.conventions import AnyArray, BoolArray, FloatArray

WINDOW = 0.35  # half side of the window, in the distance of the nearest crossing
MIN_HALF_PX, MAX_HALF_PX = 3, 15
ROUNDS, LAST_STEP_PX = 20, 1e-3
FARTHEST = 1.0  # of the half window, by which a crossing may be off where it was expected
SMOOTHING_PX = 0.7  # of the gradients
REACH_PX = 4  # of the filters


@dataclass(frozen=True)
class Saddles:
    """Measured crossings."""

    xy: FloatArray  # px, NaN where it failed, (k, 2)
    covariance: FloatArray  # px^2, (k, 2, 2)
    contrast: FloatArray  # between dark and bright squares, units of the photograph, (k,)

    def select(self, rows: BoolArray) -> Saddles:
        """Return some of them."""
        return Saddles(self.xy[rows], self.covariance[rows], self.contrast[rows])


def measure_saddles(image: AnyArray, start: FloatArray, spacing_px: FloatArray, *, noise: float) -> Saddles:
    """Measure crossings near approximate places.

    Args:
        image: intensities, shape (H, W).
        start: approximate places, px, (k, 2).
        spacing_px: distance of the nearest other crossing, px, (k,).
        noise: standard deviation of an intensity.
    """
    k = len(start)
    out = Saddles(np.full((k, 2), np.nan), np.full((k, 2, 2), np.nan), np.full(k, np.nan))
    if not k:
        return out
    smooth = np.asarray(cv2.GaussianBlur(image.astype(np.float64), (0, 0), SMOOTHING_PX), dtype=float)
    gradient = np.stack([_derivative(smooth, 1, 0), _derivative(smooth, 0, 1)], axis=2)
    for i in range(k):
        half = int(np.clip(round(WINDOW * spacing_px[i]), MIN_HALF_PX, MAX_HALF_PX))
        found = _measure(gradient, start[i].astype(float), half, noise)
        if found is None:
            continue
        out.xy[i], out.covariance[i] = found
        column, row = (round(float(v)) for v in found[0])
        part = smooth[row - half : row + half + 1, column - half : column + half + 1]
        out.contrast[i] = float(np.quantile(part, 0.9) - np.quantile(part, 0.1))
    return out


def _measure(
    gradient: FloatArray, start: FloatArray, half: int, noise: float
) -> tuple[FloatArray, FloatArray] | None:
    """Return a crossing and its covariance; None where there is none, or the border cuts it off."""
    h, w, _ = gradient.shape
    at = start
    margin = half + REACH_PX + 1
    for _ in range(ROUNDS):
        column, row = round(float(at[0])), round(float(at[1]))
        if not (margin <= column < w - margin and margin <= row < h - margin):
            return None
        reach = half + REACH_PX
        y, x = np.mgrid[row - reach : row + reach + 1, column - reach : column + reach + 1].astype(float)
        g = gradient[row - reach : row + reach + 1, column - reach : column + reach + 1]
        # a round window about the point itself, so that a step of a pixel changes nothing
        away = np.stack([x - at[0], y - at[1]], axis=2)
        weight = np.exp(-0.5 * (away**2).sum(axis=2) / (half / 2) ** 2)
        weight[(np.abs(away) > half).any(axis=2)] = 0.0
        N = np.einsum("ij,ija,ijb->ab", weight, g, g)
        if np.linalg.det(N) <= 1e-6 * np.trace(N) ** 2:
            return None
        step = np.linalg.solve(N, np.einsum("ij,ija,ijb,ijb->a", weight, g, g, away))
        at = at + step
        if np.hypot(*(at - start)) > FARTHEST * half:
            return None
        if np.hypot(*step) < LAST_STEP_PX:
            break
    else:
        return None
    # by how much each intensity moves the crossing: the filters of the gradient, the other way round
    away = np.stack([x - at[0], y - at[1]], axis=2)
    lines = (g * away).sum(axis=2)
    moved = []
    for axis in range(2):
        by_gradient = weight[:, :, None] * g[:, :, axis, None] * away
        by_gradient[:, :, axis] += weight * lines
        there = _derivative(by_gradient[:, :, 0], 1, 0) + _derivative(by_gradient[:, :, 1], 0, 1)
        moved.append(cv2.GaussianBlur(there, (0, 0), SMOOTHING_PX).ravel())
    J = np.linalg.solve(N, np.array(moved))
    return at, noise**2 * J @ J.T


def _derivative(image: FloatArray, dx: int, dy: int) -> FloatArray:
    """Return the derivative of intensities along x or y, per px."""
    return np.asarray(cv2.Sobel(image, cv2.CV_64F, dx, dy, ksize=3, scale=1 / 8))
