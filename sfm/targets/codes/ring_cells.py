"""Levels of the cells of a code ring by least squares; each sample is a blurred mixture of cells."""

from __future__ import annotations

import math

import numpy as np

from sfm.model.conventions import AnyArray, FloatArray, IntArray
from sfm.runtime.compiling import compiled, compiled_fast
from sfm.runtime.sampling import bilinear
from sfm.runtime.small_algebra import invert_symmetric
from sfm.targets.fits.blurred_ellipse import edge_profile

# Samples per cell, and trial positions of the first cell.
SAMPLES, PHASES = 12, 12
# Radii of the samples in the ring, as fractions of its width. Radii beside it: in the clear ring between dot
# and ring, as a fraction of the way from the dot, and behind the ring, as a fraction of the width.
IN_RING = (0.3, 0.5, 0.7)
IN_GAP, BEHIND = 0.5, 1.4
ALL_ROWS = len(IN_RING) + 2
# Interpolation between pixels blurs by this variance, px^2 (mean of f (1 - f), f uniform).
INTERPOLATION = 1 / 6
# Sigmas in units of the step to the dot, for judging the position of the cells: of the residuals of the
# samples, and of the deviations of the cell levels from two values.
_SAMPLE_SIGMA, _CELL_SIGMA = 0.05, 0.15
# Every printed edge is shifted outwards by the spread of the ink, in measured radii of the dot. Ink spread by
# 0.4 mm around a dot of 6 mm gives 0.12. Every edge of a light mark is shifted outwards by the glow, in px;
# in an oblique ring this is a larger part of its short radii. Both are negative if light eats into marks.
# Half the part of the short semi-axis loses one of seven oblique rings on a screen; half or twice the limit
# in px, which concerns large dots, changes none of them.
MAX_SPREAD, MAX_GLOW_PX, MAX_GLOW = 0.14, 1.5, 0.25  # the last in short semi-axes
# Priors of the spreads (mean 0) and of the blur of cell ends over that of the dot (mean 1), as standard
# deviations; that of the blur is of its logarithm. That of the glow is in px; half or twice as much changes
# none of seven oblique rings on a screen.
_SPREAD_SIGMA, _GLOW_SIGMA, _BLUR_SIGMA = 0.05, 0.3, 0.25
# First steps of the search for the position of the first cell (in cells), spread, glow and ln blur. Steps are
# halved when none improves the fit, at most _HALVINGS times; the search ends after _ROUNDS rounds.
_STEP_PLACE, _STEP_SPREAD, _STEP_GLOW, _STEP_BLUR, _HALVINGS, _ROUNDS = 1 / 24, 0.03, 0.3, 0.15, 4, 24
_PLACE, _SPREAD, _GLOW = 0, 1, 2  # of these four quantities
_FIRST_STEPS = (_STEP_PLACE, _STEP_SPREAD, _STEP_GLOW, _STEP_BLUR)
_SIGMAS = np.array([_SPREAD_SIGMA, _GLOW_SIGMA, _BLUR_SIGMA])
# Rows of the result after the levels.
_RESIDUAL, _GAP, _BEHIND_RING, _SIGMA, SPREAD, ROWS = 3, 4, 5, 6, 7, 8


@compiled
def place_cells(
    image: AnyArray,
    xy: FloatArray,
    shape: FloatArray,
    levels: FloatArray,
    blur: FloatArray,
    cells: int,
    inner: float,
    outer: float,
    tilt: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the contents of the cells at the best of twelve positions of the first cell, and this start.

    Samples on ellipses similar to that of the dot are modelled as a sum of cell levels, each blurred like the
    edge of the dot. The position that is best explained by two levels is chosen.

    Args:
        image: intensities, shape (H, W).
        xy: centres of the dots, px, shape (k, 2).
        shape: (p, q, r) of S, which turns image vectors into dot radii, 1/px, shape (k, 3).
        levels: intensity of the background and its step to the dot, shape (k, 2).
        blur: standard deviation of the edge of the dot, px, shape (k,).
        cells: number of cells.
        inner: inner radius of the ring in radii of the dot.
        outer: outer radius of the ring in radii of the dot.
        tilt: perspective, see `ring_ellipses.Rings`, shape (k, 2).

    Returns:
        Contents as from `fit_cells`, (k, 8, cells); cost, position and which cells are set, (k, 2 + cells).
        Both are nan if the photograph cuts the ring.
    """
    m = cells * SAMPLES
    out, start = np.full((len(xy), ROWS, cells), math.nan), np.full((len(xy), 2 + cells), math.nan)
    circle, samples = _circle(m), np.empty((ALL_ROWS, m))
    sigma, ring_part, dot_part = np.empty(m), np.empty((ALL_ROWS, m)), np.empty((ALL_ROWS, m))
    first, W, N = np.empty((m, 2), dtype=np.int64), np.empty((m, cells)), np.empty((cells, cells))
    c, best_c = np.empty((len(IN_RING), cells)), np.empty((len(IN_RING), cells))
    nothing = np.zeros((2, cells))
    for k in range(len(xy)):
        if not _sample(image, xy[k], shape[k], levels[k], inner, outer, tilt[k], circle, ALL_ROWS, samples):
            continue
        _parts(shape[k], blur[k], 0.0, inner, outer, circle, ALL_ROWS, sigma, ring_part, dot_part)
        least, place = math.inf, 0.0
        for phase in range(PHASES):
            _mixture(sigma, phase / PHASES, nothing, first, W)
            cost = _solve(samples, ring_part, dot_part, first, W, N, c)
            if cost < least:
                least, place = cost, phase / PHASES
                best_c[:] = c
        if least == math.inf:
            continue
        start[k, 0], start[k, 1] = least, place
        start[k, 2:] = _two_levels(best_c)[0]
        _mixture(sigma, place, nothing, first, W)
        _solve(samples, ring_part, dot_part, first, W, N, c)
        _compare(samples, ring_part, dot_part, first, W, N, c, out[k])
        out[k, SPREAD] = 0.0
    return out, start


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
    tilt: FloatArray,
    start: FloatArray,
) -> FloatArray:
    """Return the contents of the cells of the ring around each dot; nan if the photograph cuts the ring.

    Four quantities are refined: the position of the first cell, the widening of the set cells along and
    across the ring by spreading ink and light, and the blur.

    Args:
        image: intensities, shape (H, W).
        xy: centres of the dots, px, shape (k, 2).
        shape: (p, q, r) of S, which turns image vectors into dot radii, 1/px, shape (k, 3).
        levels: intensity of the background and its step to the dot, shape (k, 2).
        blur: standard deviation of the edge of the dot, px, shape (k,).
        cells: number of cells.
        inner: inner radius of the ring in radii of the dot.
        outer: outer radius of the ring in radii of the dot.
        tilt: perspective, see `ring_ellipses.Rings`, shape (k, 2).
        start: from `place_cells`, shape (k, 2 + cells).

    Returns:
        For each dot and cell, clockwise, with 0 the background and 1 the dot: three levels of the cell
        (inner, middle and outer); RMS residual in the cell; deviations from the expected level in the clear
        ring before the cell and behind it; sigma of the level for residuals of 1; and the spread of the ink
        in radii of the dot; (k, 8, cells).
    """
    m, rings = cells * SAMPLES, len(IN_RING)
    out = np.full((len(xy), ROWS, cells), math.nan)
    # of the best values so far, and of those that are tried
    samples, new_samples = np.empty((ALL_ROWS, m)), np.empty((ALL_ROWS, m))
    sigma, ring_part, dot_part = np.empty(m), np.empty((ALL_ROWS, m)), np.empty((ALL_ROWS, m))
    new_sigma, new_ring_part, new_dot_part = np.empty(m), np.empty((ALL_ROWS, m)), np.empty((ALL_ROWS, m))
    circle, first = _circle(m), np.empty((m, 2), dtype=np.int64)
    W, N, c = np.empty((m, cells)), np.empty((cells, cells)), np.empty((rings, cells))
    for k in range(len(xy)):
        if math.isnan(start[k, 0]):
            continue
        least, bits = start[k, 0], start[k, 2:]
        # position, spread, glow, ln of the blur over that of the dot
        best, steps = np.array([start[k, 1], 0.0, 0.0, 0.0]), np.array(_FIRST_STEPS)
        if not _sample(image, xy[k], shape[k], levels[k], inner, outer, tilt[k], circle, rings, samples):
            continue
        _parts(shape[k], blur[k], 0.0, inner, outer, circle, rings, sigma, ring_part, dot_part)
        halved = 0
        for _ in range(_ROUNDS):
            before = least
            for parameter in range(len(best)):
                for sign in (-1.0, 1.0):
                    tried = best.copy()
                    tried[parameter] += sign * steps[parameter]
                    if abs(tried[1]) > MAX_SPREAD or abs(tried[2]) > _largest_glow(shape[k]):
                        continue
                    s = blur[k] * math.exp(tried[3])
                    near, far = _spread_ring(inner, outer, tried[1])
                    without = _without_glow(shape[k], tried[2])
                    moves, blurs = parameter in (_SPREAD, _GLOW), parameter != _PLACE
                    if moves and not _sample(
                        image, xy[k], without, levels[k], near, far, tilt[k], circle, rings, new_samples
                    ):
                        continue
                    if blurs:
                        _parts(
                            without, s, tried[2], near, far, circle, rings,
                            new_sigma, new_ring_part, new_dot_part,
                        )  # fmt: skip
                    shifts = _shifts(bits, tried[1], tried[2] / s, near, far)
                    _mixture(new_sigma if blurs else sigma, tried[0], shifts, first, W)
                    cost = _solve(
                        new_samples if moves else samples,
                        new_ring_part if blurs else ring_part,
                        new_dot_part if blurs else dot_part,
                        first, W, N, c,
                    )  # fmt: skip
                    cost += _SAMPLE_SIGMA**2 * ((tried[1:] / _SIGMAS) ** 2).sum()
                    if cost < least:
                        least = cost
                        best[:] = tried
                        if moves:
                            samples, new_samples = new_samples, samples
                        if blurs:
                            sigma, new_sigma = new_sigma, sigma
                            ring_part, new_ring_part = new_ring_part, ring_part
                            dot_part, new_dot_part = new_dot_part, dot_part
                        break
            if least == before:
                halved += 1
                if halved == _HALVINGS:
                    break
                steps /= 2
        s, (near, far) = blur[k] * math.exp(best[3]), _spread_ring(inner, outer, best[1])
        without = _without_glow(shape[k], best[2])
        if not _sample(image, xy[k], without, levels[k], near, far, tilt[k], circle, ALL_ROWS, samples):
            continue
        _parts(without, s, best[2], near, far, circle, ALL_ROWS, sigma, ring_part, dot_part)
        _mixture(sigma, best[0], _shifts(bits, best[1], best[2] / s, near, far), first, W)
        if _solve(samples, ring_part, dot_part, first, W, N, c) < math.inf:
            _compare(samples, ring_part, dot_part, first, W, N, c, out[k])
            out[k, SPREAD] = best[1]
    return out


@compiled
def _largest_glow(shape: FloatArray) -> float:
    """Return the largest permitted glow around a dot, px."""
    p, q, r = shape[0], shape[1], shape[2]
    short = 1 / ((p + r) / 2 + math.hypot((p - r) / 2, q))
    return float(min(MAX_GLOW_PX, MAX_GLOW * short))


@compiled
def _without_glow(shape: FloatArray, glow: float) -> FloatArray:
    """Return (p, q, r) of a dot with its semi-axes reduced by the glow, px: S (1 - glow S)^-1."""
    p, q, r = shape[0], shape[1], shape[2]
    det = (1 - glow * p) * (1 - glow * r) - (glow * q) ** 2
    e, f, g = (1 - glow * r) / det, glow * q / det, (1 - glow * p) / det
    return np.array([p * e + q * f, p * f + q * g, q * f + r * g])


@compiled
def _spread_ring(inner: float, outer: float, spread: float) -> tuple[float, float]:
    """Return the radii of the ring in measured dot radii, with all edges moved outwards by the spread."""
    return inner * (1 - spread) - spread, outer * (1 - spread) + spread


@compiled
def _shifts(bits: FloatArray, spread: float, glow: float, inner: float, outer: float) -> FloatArray:
    """Return the shift of the start of each cell where a set cell meets a clear one.

    Args:
        bits: 1.0 for set cells, (cells,).
        spread: spread of the ink, in radii.
        glow: glow, in blurs.
        inner: inner radius of the ring.
        outer: outer radius of the ring.

    Returns:
        Shifts by the ink, in cells, and by the glow, in blurs, (2, cells).
    """
    cells = len(bits)
    turn = spread / ((inner + outer) / 2) / (2 * math.pi / cells)
    out = np.empty((2, cells))
    for a in range(cells):
        out[0, a] = turn * (bits[a - 1] - bits[a])
        out[1, a] = glow * (bits[a - 1] - bits[a])
    return out


@compiled
def _solve(
    samples: FloatArray,
    ring_part: FloatArray,
    dot_part: FloatArray,
    first: IntArray,
    W: FloatArray,
    N: FloatArray,
    c: FloatArray,
) -> float:
    """Write the least squares levels of the cells and their cofactors, and return their cost.

    The cost is the sum of squares of the residuals and of the scatter of the levels; infinite if singular.
    The other arguments are those of `_mixture`.
    """
    m, cells = W.shape
    g, level = np.empty(cells), np.empty(m)
    N[:] = 0.0
    for i in range(m):
        for j in range(first[i, 1]):
            a = _cell(first[i, 0] + j, cells)
            for k in range(j + 1):
                b = _cell(first[i, 0] + k, cells)
                N[max(a, b), min(a, b)] += W[i, j] * W[i, k]
    if not invert_symmetric(N):
        return math.inf
    squares = 0.0
    for row in range(len(IN_RING)):
        g[:] = 0.0
        for i in range(m):
            level[i] = (samples[row, i] - dot_part[row, i]) / ring_part[row, i]
            for j in range(first[i, 1]):
                g[_cell(first[i, 0] + j, cells)] += W[i, j] * level[i]
        for a in range(cells):
            c[row, a] = 0.0
            for b in range(cells):
                c[row, a] += N[a, b] * g[b]
        for i in range(m):
            v = level[i]
            for j in range(first[i, 1]):
                v -= W[i, j] * c[row, _cell(first[i, 0] + j, cells)]
            squares += v * v
    return squares + (_SAMPLE_SIGMA / _CELL_SIGMA) ** 2 * _scatter(c)


@compiled
def _cell(a: int, cells: int) -> int:
    """Return the number of a cell that is counted on beyond a whole turn."""
    return a - cells if a >= cells else a


@compiled
def _two_levels(c: FloatArray) -> tuple[FloatArray, float]:
    """Return which cells are set (1.0), split at the widest gap between mean levels, and the step."""
    radii, cells = c.shape
    level = np.zeros(cells)
    for a in range(cells):
        for row in range(radii):
            level[a] += c[row, a] / radii
    order = np.sort(level)
    at = int(np.argmax(order[1:] - order[:-1])) + 1
    bits = np.where(level >= order[at], 1.0, 0.0)
    return bits, order[at:].mean() - order[:at].mean()


@compiled
def _scatter(c: FloatArray) -> float:
    """Return the sum of squares of the levels about the means of set and clear cells, over all radii."""
    radii, cells = c.shape
    bits, step = _two_levels(c)
    high, number = 0.0, 0.0
    for a in range(cells):
        number += bits[a]
        for row in range(radii):
            high += bits[a] * c[row, a] / radii
    high /= number
    squares = 0.0
    for a in range(cells):
        for row in range(radii):
            squares += (c[row, a] - high + (1 - bits[a]) * step) ** 2
    return squares


@compiled
def _circle(m: int) -> FloatArray:
    """Return cosine and sine of m directions, clockwise in the image as y is down, (m, 2)."""
    t = 2 * math.pi * np.arange(m) / m
    return np.stack((np.cos(t), np.sin(t)), axis=1)


@compiled
def _sample(
    image: AnyArray,
    xy: FloatArray,
    shape: FloatArray,
    levels: FloatArray,
    inner: float,
    outer: float,
    tilt: FloatArray,
    circle: FloatArray,
    rows: int,
    samples: FloatArray,
) -> bool:
    """Sample the first rows: rings, the clear ring, and behind; False if the photograph cuts the ring."""
    h, w = image.shape
    p, q, r = shape[0], shape[1], shape[2]
    det = p * r - q * q
    for i in range(len(circle)):
        u, v = circle[i, 0], circle[i, 1]
        ex, ey = (r * u - q * v) / det, (p * v - q * u) / det
        away = tilt[0] * u + tilt[1] * v
        for row in range(rows):
            rho = _radius(row, inner, outer)
            seen = rho * (1 + away * rho)
            x, y = xy[0] + seen * ex, xy[1] + seen * ey
            if x >= 0 and y >= 0 and x < w - 1 and y < h - 1:
                samples[row, i] = (bilinear(image, x, y) - levels[0]) / levels[1]
            elif row <= len(IN_RING):
                return False
            else:
                samples[row, i] = math.nan
    return True


@compiled
def _radius(row: int, inner: float, outer: float) -> float:
    """Return the radius of a row of samples, in radii of the dot."""
    if row < len(IN_RING):
        return inner + IN_RING[row] * (outer - inner)
    if row == len(IN_RING):
        return 1 + IN_GAP * (inner - 1)
    return inner + BEHIND * (outer - inner)


@compiled_fast
def _parts(
    shape: FloatArray,
    blur: float,
    glow: float,
    inner: float,
    outer: float,
    circle: FloatArray,
    rows: int,
    sigma: FloatArray,
    ring_part: FloatArray,
    dot_part: FloatArray,
) -> None:
    """Write the parts of ring and dot in each sample of the first rows, and the blur of cell ends, rad.

    Opposite samples have the same.
    """
    p, q, r = shape[0], shape[1], shape[2]
    det = p * r - q * q
    s = math.sqrt(blur * blur + INTERPOLATION)
    half, middle, more = len(circle) // 2, (inner + outer) / 2, glow / s
    steep = np.empty(half)
    for i in range(half):
        u, v = circle[i, 0], circle[i, 1]
        ex, ey = (r * u - q * v) / det, (p * v - q * u) / det
        # Ends of cells lie along e; a turn by dt moves the sample by rho dt / (det |e|) across them.
        sigma[i] = sigma[half + i] = s * det * math.sqrt(ex * ex + ey * ey) / middle
        steep[i] = 1 / (math.sqrt((p * u + q * v) ** 2 + (q * u + r * v) ** 2) * s)  # 1 / (|grad rho| s)
    for row in range(rows):
        rho = _radius(row, inner, outer)
        for i in range(half):
            from_inner, to_outer = (rho - inner) * steep[i] + more, (rho - outer) * steep[i] - more
            ring_part[row, i] = edge_profile(from_inner)[0] - edge_profile(to_outer)[0]
            dot_part[row, i] = edge_profile((1 - rho) * steep[i] + more)[0]
        for i in range(half):
            ring_part[row, half + i], dot_part[row, half + i] = ring_part[row, i], dot_part[row, i]


@compiled
def _mixture(sigma: FloatArray, phase: float, shift: FloatArray, first: IntArray, W: FloatArray) -> None:
    """Write the parts of the cells in each sample, of those that are not zero.

    Args:
        sigma: blur of a cell end at each sample, rad, (m,).
        phase: start of the first cell, in cells.
        shift: shift of the start of each cell from its nominal position, see `_shifts`, (2, cells).
        first: receives the first cell that is in each sample, and the number of cells from there on, (m, 2).
        W: receives the parts of these cells, (m, cells).
    """
    m, cells = W.shape
    width = 2 * math.pi / cells
    for i in range(m):
        position, scale = i / SAMPLES - phase, width / sigma[i]
        reach = min(int(4 / scale + 2), (cells - 1) // 2)
        a = math.floor(position) - reach
        start = a % cells
        far = (position - a - shift[0, start]) * scale - shift[1, start]
        before, count = edge_profile(far)[0], 0
        for _ in range(2 * reach + 1):
            a += 1
            end = _cell(start + 1, cells)
            near = (position - a - shift[0, end]) * scale - shift[1, end]
            after = edge_profile(near)[0]
            if near < 4 and far > -4:
                if count == 0:
                    first[i, 0] = start
                W[i, count] = before - after
                count += 1
            far, before, start = near, after, end
        first[i, 1] = count


@compiled
def _compare(
    samples: FloatArray,
    ring_part: FloatArray,
    dot_part: FloatArray,
    first: IntArray,
    W: FloatArray,
    N: FloatArray,
    c: FloatArray,
    out: FloatArray,
) -> None:
    """Write levels, residuals, deviations beside the ring, and sigma of each cell."""
    m, cells = W.shape
    gap_row, behind_row = len(IN_RING), len(IN_RING) + 1
    weight, seen, squares = np.full(cells, 1e-12), np.full(cells, 1e-12), np.zeros(cells)
    out[_GAP], out[_BEHIND_RING] = 0.0, 0.0
    for i in range(m):
        level = 0.0
        for j in range(first[i, 1]):
            a = _cell(first[i, 0] + j, cells)
            level += W[i, j] * (c[0, a] + c[1, a] + c[2, a]) / 3
        gap = samples[gap_row, i] - dot_part[gap_row, i] - ring_part[gap_row, i] * level
        behind = samples[behind_row, i] - dot_part[behind_row, i] - ring_part[behind_row, i] * level
        mean = 0.0
        for row in range(len(IN_RING)):
            v = samples[row, i] - dot_part[row, i]
            for j in range(first[i, 1]):
                v -= ring_part[row, i] * W[i, j] * c[row, _cell(first[i, 0] + j, cells)]
            mean += v * v / len(IN_RING)
        for j in range(first[i, 1]):
            a = _cell(first[i, 0] + j, cells)
            weight[a] += W[i, j]
            squares[a] += W[i, j] * mean
            out[_GAP, a] += W[i, j] * gap
            if not math.isnan(behind):
                out[_BEHIND_RING, a] += W[i, j] * behind
                seen[a] += W[i, j]
    for a in range(cells):
        for row in range(len(IN_RING)):
            out[row, a] = c[row, a]
        out[_RESIDUAL, a] = math.sqrt(squares[a] / weight[a])
        out[_GAP, a] /= weight[a]
        out[_BEHIND_RING, a] /= seen[a]
        out[_SIGMA, a] = math.sqrt(N[a, a])
