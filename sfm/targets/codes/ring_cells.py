"""Levels of the cells of a code ring by least squares: a sample is a blurred mixture of cells."""

from __future__ import annotations

import math

import numpy as np

from sfm.conventions import AnyArray, FloatArray
from sfm.kernels.cholesky import invert_symmetric
from sfm.kernels.options import compiled
from sfm.kernels.sampling import bilinear

# Samples along a cell, and positions of the first cell that are tried.
SAMPLES, PHASES = 12, 12
# Radii of the samples in the ring, as fractions of its width, and beside it: in the clear ring between dot
# and ring, and behind the ring, as fractions of the way from the dot and of the width.
IN_RING = (0.3, 0.5, 0.7)
IN_GAP, BEHIND = 0.5, 1.4
# Interpolation between pixels blurs by this variance, px^2 (mean of f (1 - f), f uniform).
INTERPOLATION = 1 / 6
# The position of the cells is judged by the residuals of the samples and by how far the levels of the cells
# are from being two: their sigmas in units of the step to the dot.
_SAMPLE_SIGMA, _CELL_SIGMA = 0.05, 0.15
# Rows of the result after the levels.
_RESIDUAL, _GAP, _BEHIND_RING, _SIGMA, ROWS = 3, 4, 5, 6, 7


@compiled
def fit_cells(
    image: AnyArray,
    xy: FloatArray,
    shape: FloatArray,
    levels: FloatArray,
    blur: FloatArray,
    cells: int,
    inner: float,
    outer: float,
) -> FloatArray:
    """Return what is in the cells of the ring about each dot; nan where the photograph cuts the ring.

    Samples on ellipses similar to that of the dot are modelled as sum of the cells' levels, each blurred as
    the edge of the dot is; the position of the first cell is the one that explains them best by two levels.

    Args:
        image: intensities, shape (H, W).
        xy: centres of the dots, px, shape (k, 2).
        shape: (p, q, r) of S, which turns image vectors into dot radii, 1/px, shape (k, 3).
        levels: intensity of the background and its step to the dot, shape (k, 2).
        blur: standard deviation of the edge of the dot, px, shape (k,).
        cells: number of cells.
        inner: inner radius of the ring in radii of the dot.
        outer: outer radius of the ring in radii of the dot.

    Returns:
        For each dot and cell, clockwise, with 0 the background and 1 the dot: three levels of the cell,
        inside, middle and outside; RMS of the residuals in the cell; deviation from what is expected in the
        clear ring before the cell and behind it; and sigma of the level for residuals of 1; (k, 7, cells).
    """
    m = cells * SAMPLES
    out = np.full((len(xy), ROWS, cells), math.nan)
    samples = np.empty((len(IN_RING) + 2, m))
    sigma, ring_part = np.empty(m), np.empty((len(IN_RING) + 2, m))
    dot_part = np.empty((len(IN_RING) + 2, m))
    W, best_W = np.empty((m, cells)), np.empty((m, cells))
    N, best_N = np.empty((cells, cells)), np.empty((cells, cells))
    c, best_c = np.empty((len(IN_RING), cells)), np.empty((len(IN_RING), cells))
    g = np.empty(cells)
    for k in range(len(xy)):
        if not _sample(
            image, xy[k], shape[k], levels[k], blur[k], inner, outer, samples, sigma, ring_part, dot_part
        ):
            continue
        least = math.inf
        for phase in range(PHASES):
            _mixture(sigma, phase / PHASES, W)
            N[:] = 0.0
            for i in range(m):
                for a in range(cells):
                    if W[i, a] != 0.0:
                        for b in range(a + 1):
                            N[a, b] += W[i, a] * W[i, b]
            if not invert_symmetric(N):
                continue
            squares = 0.0
            for row in range(len(IN_RING)):
                g[:] = 0.0
                for i in range(m):
                    for a in range(cells):
                        g[a] += W[i, a] * (samples[row, i] - dot_part[row, i]) / ring_part[row, i]
                for a in range(cells):
                    c[row, a] = 0.0
                    for b in range(cells):
                        c[row, a] += N[a, b] * g[b]
                for i in range(m):
                    v = (samples[row, i] - dot_part[row, i]) / ring_part[row, i]
                    for a in range(cells):
                        v -= W[i, a] * c[row, a]
                    squares += v * v
            cost = squares + (_SAMPLE_SIGMA / _CELL_SIGMA) ** 2 * _scatter(c)
            if cost < least:
                least = cost
                best_W[:], best_N[:], best_c[:] = W, N, c
        if least < math.inf:
            _compare(samples, ring_part, dot_part, best_W, best_N, best_c, out[k])
    return out


@compiled
def _scatter(c: FloatArray) -> float:
    """Return the sum of squares of the levels about the means of set and of clear cells, for all radii."""
    radii, cells = c.shape
    level = np.zeros(cells)
    for a in range(cells):
        for row in range(radii):
            level[a] += c[row, a] / radii
    order = np.sort(level)
    at = int(np.argmax(order[1:] - order[:-1])) + 1
    low, high = order[:at].mean(), order[at:].mean()
    squares = 0.0
    for a in range(cells):
        mean = high if level[a] >= order[at] else low
        for row in range(radii):
            squares += (c[row, a] - mean) ** 2
    return squares


@compiled
def _phi(t: float) -> float:
    return 0.5 * math.erfc(-t / math.sqrt(2.0))


@compiled
def _sample(
    image: AnyArray,
    xy: FloatArray,
    shape: FloatArray,
    levels: FloatArray,
    blur: float,
    inner: float,
    outer: float,
    samples: FloatArray,
    sigma: FloatArray,
    ring_part: FloatArray,
    dot_part: FloatArray,
) -> bool:
    """Sample the rings; write the share of ring and dot in each sample and the blur of a cell's end, rad."""
    h, w = image.shape
    p, q, r = shape[0], shape[1], shape[2]
    det = p * r - q * q
    s = math.sqrt(blur * blur + INTERPOLATION)
    m = samples.shape[1]
    middle = (inner + outer) / 2
    for i in range(m):
        t = 2 * math.pi * i / m  # y is down, so growing angles run clockwise in the image
        u, v = math.cos(t), math.sin(t)
        ex, ey = (r * u - q * v) / det, (p * v - q * u) / det
        # Ends of cells lie along e; a turn by dt moves the sample by rho dt / (det |e|) across them.
        sigma[i] = s * det * math.hypot(ex, ey) / middle
        steepness = math.hypot(p * u + q * v, q * u + r * v)  # |grad rho|
        for row in range(samples.shape[0]):
            if row < len(IN_RING):
                rho = inner + IN_RING[row] * (outer - inner)
            elif row == len(IN_RING):
                rho = 1 + IN_GAP * (inner - 1)
            else:
                rho = inner + BEHIND * (outer - inner)
            x, y = xy[0] + rho * ex, xy[1] + rho * ey
            if not (x >= 0 and y >= 0 and x < w - 1 and y < h - 1):
                if row <= len(IN_RING):
                    return False
                samples[row, i] = math.nan
            else:
                samples[row, i] = (bilinear(image, x, y) - levels[0]) / levels[1]
            f = 1 / (steepness * s)
            ring_part[row, i] = _phi((rho - inner) * f) - _phi((rho - outer) * f)
            dot_part[row, i] = _phi((1 - rho) * f)
    return True


@compiled
def _mixture(sigma: FloatArray, phase: float, W: FloatArray) -> None:
    """Write the share of each cell in each sample; phase is where the first cell begins, in cells."""
    m, cells = W.shape
    width = 2 * math.pi / cells
    for i in range(m):
        position = i / SAMPLES - phase
        for a in range(cells):
            away = (
                position - a - 0.5 + cells / 2
            ) % cells - cells / 2  # from the middle of the cell, in cells
            near, far = (away - 0.5) * width / sigma[i], (away + 0.5) * width / sigma[i]
            W[i, a] = _phi(far) - _phi(near) if near < 4 and far > -4 else 0.0


@compiled
def _compare(
    samples: FloatArray,
    ring_part: FloatArray,
    dot_part: FloatArray,
    W: FloatArray,
    N: FloatArray,
    c: FloatArray,
    out: FloatArray,
) -> None:
    """Write levels, residuals, deviations beside the ring and sigma of each cell."""
    m, cells = W.shape
    gap_row, behind_row = len(IN_RING), len(IN_RING) + 1
    weight, seen, squares = np.full(cells, 1e-12), np.full(cells, 1e-12), np.zeros(cells)
    out[_GAP], out[_BEHIND_RING] = 0.0, 0.0
    for i in range(m):
        level = 0.0
        for a in range(cells):
            level += W[i, a] * (c[0, a] + c[1, a] + c[2, a]) / 3
        gap = samples[gap_row, i] - dot_part[gap_row, i] - ring_part[gap_row, i] * level
        behind = samples[behind_row, i] - dot_part[behind_row, i] - ring_part[behind_row, i] * level
        mean = 0.0
        for row in range(len(IN_RING)):
            v = samples[row, i] - dot_part[row, i]
            for a in range(cells):
                v -= ring_part[row, i] * W[i, a] * c[row, a]
            mean += v * v / len(IN_RING)
        for a in range(cells):
            weight[a] += W[i, a]
            squares[a] += W[i, a] * mean
            out[_GAP, a] += W[i, a] * gap
            if not math.isnan(behind):
                out[_BEHIND_RING, a] += W[i, a] * behind
                seen[a] += W[i, a]
    for a in range(cells):
        for row in range(len(IN_RING)):
            out[row, a] = c[row, a]
        out[_RESIDUAL, a] = math.sqrt(squares[a] / weight[a])
        out[_GAP, a] /= weight[a]
        out[_BEHIND_RING, a] /= seen[a]
        out[_SIGMA, a] = math.sqrt(N[a, a])
