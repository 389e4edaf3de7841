"""Model of a circular target: a blurred ellipse on a background, with its derivatives, compiled.

Let d be the signed distance of pixel (x, y) from the edge of the ellipse (negative inside), s the blur of the
edge, B the background, A the step to the target, and g the change of the gain over L. The intensity is

    I = (B + A Phi(-d / s)) (1 + gx (x - x0) / L + gy (y - y0) / L)

The ellipse is |S (x - x0, y - y0)| = 1 with a symmetric S = (p q; q r), which is regular for circles as well.
With rho = |S dx|, d = rho (rho - 1) / |S S dx|. The box of the pixel is part of s: it adds 1/12 to s^2.
"""

from __future__ import annotations

import math

from sfm.model.conventions import FloatArray
from sfm.runtime.compiling import compiled_fast, inlined_fast

# Unknowns of the fit in their order: x0, y0, p, q, r, B, A, s, gx, gy.
UNKNOWNS = 10
X0, Y0, P, Q, R, BACKGROUND, CONTRAST, BLUR, GAIN_X, GAIN_Y = range(UNKNOWNS)
# Pixels are processed in blocks of this size. A block contains the derivatives by one unknown after another,
# followed by the residuals and the weights.
BLOCK = 256
RESIDUAL, WEIGHT = UNKNOWNS * BLOCK, (UNKNOWNS + 1) * BLOCK
BLOCK_SIZE = (UNKNOWNS + 2) * BLOCK
_SQRT_HALF = math.sqrt(0.5)
_DENSITY_0 = 1 / math.sqrt(2 * math.pi)


@inlined_fast
def edge_profile(t: float) -> tuple[float, float]:
    """Return Phi(t) of the normal distribution, and exp(-t^2 / 2), without branches.

    Source: Abramowitz and Stegun (1964), 7.1.26, error below 1.5e-7; exp(y) = exp(y / 64)^64 by its series.
    """
    z = min(abs(t) * _SQRT_HALF, 4.0)
    y = z * z / -64
    e = 1 + y * (1 + y * (1 / 2 + y * (1 / 6 + y * (1 / 24 + y / 120))))
    for _ in range(6):
        e *= e
    k = 1 / (1 + 0.3275911 * z)
    tail = 0.254829592 + k * (-0.284496736 + k * (1.421413741 + k * (-1.453152027 + k * 1.061405429)))
    tail *= 0.5 * e * k
    return (1 - tail if t > 0 else tail), e


@compiled_fast
def linearise(
    pixels: FloatArray, first: int, m: int, theta: FloatArray, length: float, saturation: float, J: FloatArray
) -> None:
    """Write the derivatives, residuals and weights of a block of pixels into J.

    The loop has no branches, so that it runs on several pixels at a time. A pixel at the end of the scale has
    no weight if the model is also beyond the scale, since nothing more is known of it (censored observation).
    """
    x0, y0, p, q, r = theta[X0], theta[Y0], theta[P], theta[Q], theta[R]
    B, A, s, gx, gy = (
        theta[BACKGROUND],
        theta[CONTRAST],
        theta[BLUR],
        theta[GAIN_X] / length,
        theta[GAIN_Y] / length,
    )
    for i in range(m):
        dx, dy, value = pixels[0, first + i] - x0, pixels[1, first + i] - y0, pixels[2, first + i]
        u, v = p * dx + q * dy, q * dx + r * dy
        rho = math.sqrt(u * u + v * v) + 1e-12
        wx, wy = p * u + q * v, q * u + r * v  # S S dx
        nw = 1 / (math.sqrt(wx * wx + wy * wy) + 1e-12)
        d = rho * (rho - 1) * nw
        phi, e = edge_profile(-d / s)
        gain = 1 + gx * dx + gy * dy
        level = B + A * phi
        model = level * gain
        censored = (value >= saturation and model >= saturation) or (value <= 0 and model <= 0)
        weight = 0.0 if censored else 1.0
        level *= weight
        # d' = (2 rho - 1) rho' / |w| - d |w|' / |w|, rho' = u.u' / rho, |w|' = w.w' / |w|, w' = S u' + S' u
        slope = weight * A * _DENSITY_0 * e * gain / s  # -dI/dd
        f1 = -slope * (2 * rho - 1) * nw / rho
        f2 = slope * d * nw * nw
        ax, ay = p * wx + q * wy, q * wx + r * wy  # S w
        J[X0 * BLOCK + i] = -f1 * (u * p + v * q) - f2 * (ax * p + ay * q) - level * gx
        J[Y0 * BLOCK + i] = -f1 * (u * q + v * r) - f2 * (ax * q + ay * r) - level * gy
        J[P * BLOCK + i] = f1 * (u * dx) + f2 * (ax * dx + wx * u)
        J[Q * BLOCK + i] = f1 * (u * dy + v * dx) + f2 * (ax * dy + ay * dx + wx * v + wy * u)
        J[R * BLOCK + i] = f1 * (v * dy) + f2 * (ay * dy + wy * v)
        J[BACKGROUND * BLOCK + i] = weight * gain
        J[CONTRAST * BLOCK + i] = weight * phi * gain
        J[BLUR * BLOCK + i] = slope * d / s
        J[GAIN_X * BLOCK + i] = level * dx / length
        J[GAIN_Y * BLOCK + i] = level * dy / length
        J[RESIDUAL + i] = weight * (value - model)
        J[WEIGHT + i] = weight


@compiled_fast
def normal_equations(
    pixels: FloatArray,
    n: int,
    theta: FloatArray,
    length: float,
    saturation: float,
    J: FloatArray,
    N: FloatArray,
    g: FloatArray,
) -> tuple[float, int]:
    """Sum up N = J'J (lower triangle) and g = J'v of one target.

    The pixels are processed in blocks, so that the sums run over contiguous numbers in the cache.

    Args:
        pixels: x, y and intensity of the pixels, shape (3, >= n).
        n: number of pixels.
        theta: unknowns, shape (10,).
        length: L, px.
        saturation: intensities from this value on are censored.
        J: work space of size BLOCK_SIZE.
        N: receives the normal equations, shape (10, 10).
        g: receives their right-hand side, shape (10,).

    Returns:
        Sum of squared residuals, and the number of pixels used.
    """
    N[:] = 0.0
    g[:] = 0.0
    squares, used = 0.0, 0.0
    for first in range(0, n, BLOCK):
        m = min(BLOCK, n - first)
        linearise(pixels, first, m, theta, length, saturation, J)
        for j in range(UNKNOWNS):
            for k in range(j + 1):
                product = 0.0
                for i in range(m):
                    product += J[j * BLOCK + i] * J[k * BLOCK + i]
                N[j, k] += product
            product = 0.0
            for i in range(m):
                product += J[j * BLOCK + i] * J[RESIDUAL + i]
            g[j] += product
        for i in range(m):
            squares += J[RESIDUAL + i] ** 2
            used += J[WEIGHT + i]
    return squares, int(used)
