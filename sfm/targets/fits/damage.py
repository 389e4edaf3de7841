"""Damaged targets: pixels that the model of a blurred ellipse does not explain, found and left out, compiled.

Nicks and ink splashes in the edge, scratches and marks in the middle leave large residuals in a few connected
pixels. These and their neighbours are left out, the ellipse is fitted to the others, and all pixels are
judged anew until the same ones are left out; the covariance is that of what remains. Where so much is left
out that an ellipse is no longer certain, or in more places than damage explains, the fit to all pixels
stands, and whether it is a target is judged by that.
"""

from __future__ import annotations

import math

import numpy as np

from sfm.conventions import BoolArray, FloatArray
from sfm.kernels.options import compiled
from sfm.targets.edge_rays import RAYS
from sfm.targets.fits import blurred_ellipse as model

# So many pixels whose residuals are above this share of the contrast, and so many sigma of the noise and
# robust sigmas of the residuals beside the edge (retro-reflective sheeting is grainy), are damage.
MIN_PIXELS, SUSPICIOUS, SUSPICIOUS_SIGMAS = 2, 0.08, 6.0
# Pixels are left out above so many robust sigmas of the residuals, of the edge or elsewhere, or of the noise,
# and this share of the contrast; in the first rounds, when the edges on rays alone are known, above these.
OUTLIER_SIGMAS, LEAST_OUTLIER = 5.0, 0.08
FIRST_OUTLIERS = np.array([0.4, 0.2])
# What is left out is called damage if a pixel of it has a residual of this share of the contrast. Sharpening
# and JPEG compression leave a tenth here and there beside the edge, a nick in 2 % of the edge leaves more.
TELLING = 0.2
# Neighbours up to this distance from such a pixel are left out too: the blurred rim of the damage.
RIM_PX = 2
# Targets with a smaller minor semi-axis have too few pixels to tell damage from another shape.
MIN_SEMI_AXIS_PX = 4.0
# Most that is left out of the edge and of the inside, and most places along the edge (a scratch has two).
MAX_EDGE, MAX_INSIDE, MAX_PLACES = 0.3, 0.5, 2
MAX_ROUNDS, TRACES = 8, 3  # of the fit, and of the edges on rays before it
# The edge is so many blurs wide to both sides, and so many px at least.
_EDGE_BLURS, _EDGE_PX = 1.5, 1.0
_MAD = 1.4826


@compiled
def is_damaged(
    pixels: FloatArray,
    n: int,
    theta: FloatArray,
    length: float,
    saturation: float,
    noise: float,
    J: FloatArray,
) -> bool:
    """Whether some pixels are far from the model, as those inside the target and around it are not.

    The edge itself is no measure of that: damage pulls it along.
    """
    residual = np.empty(n)
    least = max(SUSPICIOUS * abs(theta[model.CONTRAST]), SUSPICIOUS_SIGMAS * noise)
    count = 0
    for first in range(0, n, model.BLOCK):
        m = min(model.BLOCK, n - first)
        model.linearise(pixels, first, m, theta, length, saturation, J)
        for i in range(m):
            residual[first + i] = abs(J[model.RESIDUAL + i])
            count += residual[first + i] > least
    if count < MIN_PIXELS:
        return False
    at_edge = np.abs(_distances(pixels, n, theta)) < _edge_width(theta)
    limit = _limits(residual, at_edge, least, SUSPICIOUS_SIGMAS)[0]
    return bool(np.sum(residual > limit) >= MIN_PIXELS)


@compiled
def is_telling(
    pixels: FloatArray, m: int, n: int, theta: FloatArray, length: float, saturation: float, J: FloatArray
) -> bool:
    """Whether a pixel that was left out, behind the first m of n, is far from the model of the others."""
    least = TELLING * abs(theta[model.CONTRAST])
    for first in range(m, n, model.BLOCK):
        count = min(model.BLOCK, n - first)
        model.linearise(pixels, first, count, theta, length, saturation, J)
        for i in range(count):
            if abs(J[model.RESIDUAL + i]) > least:
                return True
    return False


@compiled
def is_large(theta: FloatArray) -> bool:
    """Whether a target has enough pixels to tell damage from another shape."""
    p, q, r = theta[model.P], theta[model.Q], theta[model.R]
    return bool(1 / ((p + r) / 2 + math.hypot((p - r) / 2, q)) >= MIN_SEMI_AXIS_PX)


@compiled
def _limits(residual: FloatArray, at_edge: BoolArray, least: float, sigmas: float) -> FloatArray:
    """Return so many robust sigmas of the residuals elsewhere and at the edge, or the least, (2,)."""
    limits = np.full(2, least)
    for part in range(2):
        own = residual[at_edge == (part == 1)]
        if len(own):
            limits[part] = max(least, sigmas * _MAD * np.median(own))
    return limits


@compiled
def _edge_width(theta: FloatArray) -> float:
    """Return how far the edge reaches to both sides, px."""
    return float(_EDGE_PX + _EDGE_BLURS * theta[model.BLUR])


@compiled
def _distances(pixels: FloatArray, n: int, theta: FloatArray) -> FloatArray:
    """Return the signed distance of each pixel from the ellipse, negative inside, px, (n,)."""
    p, q, r = theta[model.P], theta[model.Q], theta[model.R]
    out = np.empty(n)
    for i in range(n):
        dx, dy = pixels[0, i] - theta[model.X0], pixels[1, i] - theta[model.Y0]
        u, v = p * dx + q * dy, q * dx + r * dy
        rho = math.sqrt(u * u + v * v)
        out[i] = rho * (rho - 1) / (math.hypot(p * u + q * v, q * u + r * v) + 1e-12)
    return out


@compiled
def explained_pixels(
    pixels: FloatArray,
    n: int,
    theta: FloatArray,
    length: float,
    saturation: float,
    noise: float,
    round_: int,
    J: FloatArray,
    kept: BoolArray,
) -> bool:
    """Mark the pixels that the model explains.

    Args:
        pixels: x, y and intensity, shape (3, >= n).
        n: number of pixels.
        theta: unknowns of the model, shape (10,).
        length: L, px.
        saturation: intensities from here on are censored.
        noise: standard deviation of the intensities.
        round_: number of the round from 0 on; in the first ones theta is only known roughly.
        J: work space of BLOCK_SIZE.
        kept: receives which pixels are explained, shape (>= n,).

    Returns:
        Whether enough of the edge and of the inside is left, and what is left out is in few places;
        that is not asked in the first rounds.
    """
    p, q, r = theta[model.P], theta[model.Q], theta[model.R]
    A = abs(theta[model.CONTRAST])
    residual, distance, sector = np.empty(n), _distances(pixels, n, theta), np.empty(n, np.int64)
    for first in range(0, n, model.BLOCK):
        m = min(model.BLOCK, n - first)
        model.linearise(pixels, first, m, theta, length, saturation, J)
        for i in range(m):
            dx, dy = pixels[0, first + i] - theta[model.X0], pixels[1, first + i] - theta[model.Y0]
            u, v = p * dx + q * dy, q * dx + r * dy
            residual[first + i] = abs(J[model.RESIDUAL + i])
            sector[first + i] = int(math.atan2(v, u) * (RAYS / (2 * math.pi)) + RAYS) % RAYS
    at_edge = np.abs(distance) < _edge_width(theta)
    begin = round_ < len(FIRST_OUTLIERS)
    share = FIRST_OUTLIERS[round_] if begin else LEAST_OUTLIER
    least = max(share * A, OUTLIER_SIGMAS * noise)
    limits = np.full(2, least) if begin else _limits(residual, at_edge, least, OUTLIER_SIGMAS)
    left, top = int(pixels[0, :n].min()) - RIM_PX, int(pixels[1, :n].min()) - RIM_PX
    width = int(pixels[0, :n].max()) - left + RIM_PX + 1
    height = int(pixels[1, :n].max()) - top + RIM_PX + 1
    out = np.zeros((height, width), np.bool_)
    for k in range(n):
        if residual[k] > limits[1 if at_edge[k] else 0]:
            x, y = int(pixels[0, k]) - left, int(pixels[1, k]) - top
            for i in range(-RIM_PX, RIM_PX + 1):
                for j in range(-RIM_PX, RIM_PX + 1):
                    if abs(i) + abs(j) < 2 * RIM_PX:  # all but the corners
                        out[y + i, x + j] = True
    edge, edge_lost, inside, inside_lost = 0, 0, 0, 0
    hit = np.zeros(RAYS, np.bool_)
    for k in range(n):
        kept[k] = not out[int(pixels[1, k]) - top, int(pixels[0, k]) - left]
        lost = not kept[k]
        if abs(distance[k]) < _EDGE_PX:
            edge += 1
            edge_lost += lost
            if lost:
                hit[sector[k]] = True
        elif distance[k] < 0:
            inside += 1
            inside_lost += lost
    places = 0
    for k in range(RAYS):  # places that are one ray apart are one
        places += hit[k] and not hit[k - 1] and not hit[k - 2]
    return begin or (
        edge_lost <= MAX_EDGE * edge and inside_lost <= MAX_INSIDE * inside and places <= MAX_PLACES
    )


@compiled
def move_to_front(pixels: FloatArray, n: int, kept: BoolArray) -> int:
    """Order pixels so that those that are kept come first; return how many they are."""
    k = 0
    for i in range(n):
        if kept[i]:
            for row in range(3):
                pixels[row, k], pixels[row, i] = pixels[row, i], pixels[row, k]
            k += 1
    return k
