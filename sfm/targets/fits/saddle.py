"""Crossings of a checkerboard: the point on all edges around it, with its covariance.

Every pixel of an edge shows that the crossing lies on the line through the pixel perpendicular to its
gradient. The crossing is the intersection of these lines, weighted by the squared gradient. Blur is the same
on both sides of an edge and does not move it. The covariance is that of the noise of the intensities,
propagated through the filters and through the window, which moves with the crossing.

Source: Foerstner and Guelch (1987), ISPRS Intercommission Workshop Interlaken (precise location of corners,
and their roundness, the squared sine of the angle between the edges).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.runtime.compiling import compiled

# Largest half side of the window, in distances to the nearest crossing. On 14 photographs of a printed board
# residuals are 0.128, 0.125, 0.128 and 0.134 px RMS with 0.25, 0.35, 0.43 and 0.5: distortion bends edges,
# print is uneven, and smaller windows have more noise.
MAX_HALF_SPACINGS = 0.35
MIN_HALF_PX, MAX_HALF_PX = 3, 15
ROUNDS, LAST_STEP_PX = 20, 1e-3
MAX_OFF_FRACTION = 1.0  # maximum distance of a crossing from its expected position, in half windows
MIN_SINE = 0.3  # of the angle between the two edges, as of rows and columns of a lattice; a single edge has 0
SMOOTHING_PX = 0.7  # of the gradients
SMOOTHED_PX = math.sqrt(
    SMOOTHING_PX**2 + 1 / 3
)  # standard deviation of an edge that was sharp, with its pixels
MIN_BLUR_PX = 0.1  # smallest blur distinguishable from that of the filters
REACH_PX = 4  # of the filters


@dataclass(frozen=True)
class Saddles:
    """Measured crossings."""

    xy: FloatArray  # px, NaN if the measurement failed, (k, 2)
    covariance: FloatArray  # px^2, (k, 2, 2)
    contrast: FloatArray  # between dark and bright squares, units of the photograph, (k,)
    blur: FloatArray  # standard deviation of the edges, px; underestimated above a fifth of the window, (k,)

    def select(self, rows: BoolArray) -> Saddles:
        """Return some of the crossings."""
        return Saddles(self.xy[rows], self.covariance[rows], self.contrast[rows], self.blur[rows])


def measure_saddles(image: AnyArray, start: FloatArray, half_px: FloatArray, *, noise: float) -> Saddles:
    """Measure crossings near approximate positions.

    Args:
        image: intensities, shape (H, W).
        start: approximate positions, px, (k, 2).
        half_px: half sides of the windows, which must contain no other edges than those of the crossing, px,
            (k,).
        noise: standard deviation of an intensity.
    """
    k = len(start)
    empty = np.full((k, 2), np.nan), np.full((k, 2, 2), np.nan)
    out = Saddles(*empty, np.full(k, np.nan), np.full(k, np.nan))
    if not k:
        return out
    half = window_half(half_px)
    smooth, gx, gy = _filtered(image, start, half)
    _measure_all(
        smooth,
        gx,
        gy,
        start.astype(float),
        half,
        noise,
        out.xy,
        out.covariance,
        out.contrast,
        out.blur,
    )
    return out


def window_half(half_px: FloatArray) -> IntArray:
    """Return the half sides of the windows that are used where larger ones are allowed, px, (k,)."""
    return np.clip(np.floor(half_px), MIN_HALF_PX, MAX_HALF_PX).astype(np.int64)


def _filtered(image: AnyArray, start: FloatArray, half: IntArray) -> tuple[AnyArray, AnyArray, AnyArray]:
    """Return smoothed intensities and their derivatives by x and y, (H, W) each, around crossings.

    They are 0 elsewhere: windows of a board are a fifth of its photograph, and filters take longer than
    the measurement. Windows of more pixels than the photograph are filtered together.

    Args:
        image: intensities, (H, W).
        start: approximate positions of the crossings, px, (k, 2).
        half: half sides of their windows, px, (k,).
    """
    size = np.array(image.shape)
    reach = np.ceil((1 + MAX_OFF_FRACTION) * half).astype(np.int64) + REACH_PX + 2
    place = np.rint(start[:, ::-1]).astype(np.int64)
    low = np.clip(place - reach[:, None], 0, size)
    high = np.clip(place + reach[:, None] + 1, 0, size)
    if (high - low).prod(axis=1).sum() > image.size:
        low, high = np.zeros((1, 2), dtype=np.int64), size[None]
    smooth, gx, gy = (np.zeros(image.shape, dtype=np.float32) for _ in range(3))
    for (top, left), (bottom, right) in zip(low.tolist(), high.tolist(), strict=True):
        if top >= bottom or left >= right:
            continue
        above, before = max(top - REACH_PX, 0), max(left - REACH_PX, 0)
        window = image[above : bottom + REACH_PX, before : right + REACH_PX].astype(np.float32)
        part = np.asarray(cv2.GaussianBlur(window, (0, 0), SMOOTHING_PX))
        own = slice(top - above, bottom - above), slice(left - before, right - before)
        smooth[top:bottom, left:right] = part[own]
        gx[top:bottom, left:right] = cv2.Sobel(part, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)[own]
        gy[top:bottom, left:right] = cv2.Sobel(part, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)[own]
    return smooth, gx, gy


# Weights of a derivative's smoothing along and across it, 2 REACH_PX + 1 each.
_SMOOTHING = cv2.getGaussianKernel(2 * REACH_PX - 1, SMOOTHING_PX)[:, 0]
ALONG, ACROSS = np.convolve(_SMOOTHING, [-0.5, 0.0, 0.5]), np.convolve(_SMOOTHING, [0.25, 0.5, 0.25])
NOISE_OF_GRADIENT = float(np.sqrt((ALONG**2).sum() * (ACROSS**2).sum()))


@compiled
def _measure_all(
    smooth: AnyArray,
    gx: AnyArray,
    gy: AnyArray,
    start: FloatArray,
    half_px: IntArray,
    noise: float,
    xy: FloatArray,
    covariance: FloatArray,
    contrast: FloatArray,
    blur: FloatArray,
) -> None:
    """Fill positions, covariances, contrasts and blurs of crossings; failed ones remain unchanged.

    Args:
        smooth: smoothed intensities, (H, W).
        gx: derivative along x, per px, (H, W).
        gy: derivative along y, per px, (H, W).
        start: approximate positions, px, (k, 2).
        half_px: half sides of the windows, px, (k,).
        noise: standard deviation of an intensity.
        xy: receives the positions, (k, 2).
        covariance: receives their covariance, (k, 2, 2).
        contrast: receives their contrast, (k,).
        blur: receives the blur of their edges, px, (k,).
    """
    for i in range(len(start)):
        half = half_px[i]
        x, y = _crossing(gx, gy, start[i, 0], start[i, 1], half)
        if math.isnan(x):
            continue
        xy[i, 0], xy[i, 1] = x, y
        _propagate(gx, gy, x, y, half, noise, covariance[i])
        column, row = round(x), round(y)
        part = np.sort(smooth[row - half : row + half + 1, column - half : column + half + 1].copy().ravel())
        last = len(part) - 1
        contrast[i] = part[round(0.9 * last)] - part[round(0.1 * last)]
        blur[i] = _blur(gx, gy, x, y, half, noise, contrast[i])


@compiled
def _blur(gx: AnyArray, gy: AnyArray, x: float, y: float, half: int, noise: float, contrast: float) -> float:
    """Return the blur of the edges around a crossing, px, too small if they fill the window, or NaN.

    Across an edge of contrast C and blur s the squared gradient adds up to C^2 / (2 sqrt(pi) s) on each px of
    its length. Two edges in a circle of radius r are 4 r long; at their intersection 2.257 s of each is lost.
    """
    squares, count = 0.0, 0
    for row in range(round(y) - half, round(y) + half + 1):
        for column in range(round(x) - half, round(x) + half + 1):
            if (column - x) ** 2 + (row - y) ** 2 <= half * half:
                squares += gx[row, column] ** 2 + gy[row, column] ** 2
                count += 1
    squares -= 2 * count * (noise * NOISE_OF_GRADIENT) ** 2
    if not squares > 0 or not contrast > 0:
        return math.nan
    C2 = contrast * contrast
    s = 4 * half * C2 / (2 * math.sqrt(math.pi) * squares + 4.514 * C2)
    of_edge = s * s - SMOOTHING_PX**2 - 1 / 3  # without the blur of the filters
    return math.sqrt(max(of_edge, MIN_BLUR_PX**2))


@compiled
def _weight(dx: float, dy: float, half: int) -> float:
    """Return the weight of a pixel: a round window around the point itself, with a gradual cut-off.

    No small step of the point may change the weights abruptly, because the iteration would not converge.
    """
    inside_x, inside_y = half + 0.5 - abs(dx), half + 0.5 - abs(dy)
    if inside_x <= 0 or inside_y <= 0:
        return 0.0
    return min(inside_x, 1.0) * min(inside_y, 1.0) * math.exp(-2.0 * (dx * dx + dy * dy) / (half * half))


@compiled
def _falloff(d: float, half: int) -> float:
    """Return the relative growth of a pixel's weight per px that the window moves towards it."""
    inside = half + 0.5 - abs(d)
    return 4.0 * d / (half * half) + (math.copysign(1.0, d) / inside if inside < 1.0 else 0.0)


@compiled
def _crossing(gx: AnyArray, gy: AnyArray, x0: float, y0: float, half: int) -> tuple[float, float]:
    """Return a crossing; NaN if there is none, or if the border cuts it."""
    height, width = gx.shape
    margin, x, y = half + REACH_PX + 1, x0, y0
    for _ in range(ROUNDS):
        column, row = round(x), round(y)
        if not (margin <= column < width - margin and margin <= row < height - margin):
            break
        xx = xy = yy = nx = ny = 0.0
        for r in range(row - half - 1, row + half + 2):
            for c in range(column - half - 1, column + half + 2):
                dx, dy = c - x, r - y
                w = _weight(dx, dy, half)
                a, b = float(gx[r, c]), float(gy[r, c])
                line = w * (a * dx + b * dy)
                xx += w * a * a
                xy += w * a * b
                yy += w * b * b
                nx += a * line
                ny += b * line
        det = xx * yy - xy * xy
        if 4 * det <= (MIN_SINE * (xx + yy)) ** 2:
            break
        step_x, step_y = (yy * nx - xy * ny) / det, (xx * ny - xy * nx) / det
        x, y = x + step_x, y + step_y
        if math.hypot(x - x0, y - y0) > MAX_OFF_FRACTION * half:
            break
        if math.hypot(step_x, step_y) < LAST_STEP_PX:
            return x, y
    return math.nan, math.nan


@compiled
def _propagate(
    gx: AnyArray, gy: AnyArray, x: float, y: float, half: int, noise: float, out: FloatArray
) -> None:
    """Fill the covariance of a crossing, px^2, (2, 2).

    The effect of each intensity on the crossing follows from the gradient filters, applied in reverse. Lines
    of pixels beside the middle of a blurred edge miss the crossing, and the window changes their weights as
    it moves.
    """
    column, row = round(x), round(y)
    side, reach = 2 * (half + REACH_PX) + 1, half + REACH_PX
    by_gx, by_gy = np.zeros((2, side, side)), np.zeros((2, side, side))
    J = np.zeros((2, 2))  # of the sum that is zero at the crossing, by the crossing
    for r in range(REACH_PX - 1, side - REACH_PX + 1):
        for c in range(REACH_PX - 1, side - REACH_PX + 1):
            dx, dy = column - reach + c - x, row - reach + r - y
            w = _weight(dx, dy, half)
            a, b = (
                float(gx[row - reach + r, column - reach + c]),
                float(gy[row - reach + r, column - reach + c]),
            )
            line = w * (a * dx + b * dy)
            by_gx[0, r, c], by_gy[0, r, c] = w * a * dx + line, w * a * dy
            by_gx[1, r, c], by_gy[1, r, c] = w * b * dx, w * b * dy + line
            if w > 0:
                by_x, by_y = line * _falloff(dx, half) - w * a, line * _falloff(dy, half) - w * b
                J[0, 0] += a * by_x
                J[0, 1] += a * by_y
                J[1, 0] += b * by_x
                J[1, 1] += b * by_y
    moved = np.zeros((2, side, side))
    rows = np.empty((side, side))
    for axis in range(2):
        _add_filtered(by_gx[axis], ALONG, ACROSS, rows, moved[axis])
        _add_filtered(by_gy[axis], ACROSS, ALONG, rows, moved[axis])
    det = J[0, 0] * J[1, 1] - J[0, 1] * J[1, 0]
    move_x = (J[1, 1] * moved[0] - J[0, 1] * moved[1]) / det
    move_y = (J[0, 0] * moved[1] - J[1, 0] * moved[0]) / det
    out[0, 0], out[1, 1] = noise**2 * (move_x**2).sum(), noise**2 * (move_y**2).sum()
    out[0, 1] = out[1, 0] = noise**2 * (move_x * move_y).sum()


@compiled
def _add_filtered(
    image: FloatArray, along_x: FloatArray, along_y: FloatArray, rows: FloatArray, out: FloatArray
) -> None:
    """Add an image (n, n) filtered by two rows of weights to `out`; the image is zero near its border."""
    n = len(image)
    rows[:] = 0.0
    for k in range(2 * REACH_PX + 1):
        low, high = max(0, REACH_PX - k), min(n, n + REACH_PX - k)
        for r in range(n):
            for c in range(low, high):
                rows[r, c] += along_x[k] * image[r, c + k - REACH_PX]
    for k in range(2 * REACH_PX + 1):
        for r in range(max(0, REACH_PX - k), min(n, n + REACH_PX - k)):
            for c in range(n):
                out[r, c] += along_y[k] * rows[r + k - REACH_PX, c]
