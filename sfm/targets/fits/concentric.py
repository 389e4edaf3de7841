"""Concentric rings measured by a least squares fit of all their edges at once.

A plane in perspective maps circles of radius k around one centre to the curves rho = k of

    rho(x, y) = |S dx| / (1 + l dx),   dx = (x - x0, y - y0),   S = (p q; q r)

where (x0, y0) is the image of the common centre. These seven unknowns are all that a homography changes in
circles around one point. Let r_i be the radii from the outside inwards, e the spread of the ink, B the paper,
A the step to the ink, s the blur and c_i the curvature of the edges (1/px). The intensity is

    I = (B + A sum_i (-1)^i Phi(z_i)) (1 + gx dx + gy dy)
    z_i = (r_i + (-1)^i e - rho) / (s |grad rho|) - s c_i / 2

with dx and dy of the gain in units of L, the mean radius. The last term is the shift of a curved edge by the
blur, to first order. The box of the pixel is part of s. A camera that sharpens adds a times what a mask of
standard deviation h removes: Phi(z_i) becomes (1 + a) Phi(z_i) - a Phi(z_i'), with s' = sqrt(s^2 + h^2).

Source: Kim, Gurdjos and Kweon (2005), "Geometric and algebraic constraints of projected concentric circles
and their applications to camera calibration", IEEE PAMI 27(4), for the pencil of conics; motion of edges by
curvature: Koenderink (1984), Biological Cybernetics 50.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.targets.fits.corner import MASK_PX, SHARPENING_SIGMA
from sfm.targets.measure import QUANTISATION
from sfm.targets.outlines import Flag

# Unknowns in their order: x0, y0, p, q, r, two of l, B, A, s, e, gx, gy, a.
UNKNOWNS, GEOMETRY = 14, 7
BACKGROUND, CONTRAST, BLUR, SPREAD, GAIN_X, GAIN_Y, SHARPENING = range(7, 14)
# Paper around the rings is fitted up to this radius; there must be nothing else on it.
SURROUNDINGS = 1.15
# A priori sigma of the spread of the ink in outer radii: 0.1 mm on a tag of 40 mm. It only matters if the
# blur makes spread and contrast indistinguishable.
SPREAD_SIGMA = 0.005
# Largest change of scale by the perspective over a radius: beyond it the plane is nearly seen edge-on.
STEEPEST = 0.5
MIN_BLUR, MAX_BLUR, MAX_STEPS, LAST_STEP_PX = 0.25, 4.0, 40, 1e-3
_DENSITY_0 = 1 / math.sqrt(2 * math.pi)


@dataclass(frozen=True)
class ConcentricFit:
    """Rings of known radii fitted to a part of a photograph."""

    theta: FloatArray
    """unknowns, shape (14,)"""
    covariance: FloatArray
    """covariance of the unknowns from the residuals, shape (14, 14)"""
    noise: float
    """standard deviation of the intensities about the fit"""
    radius_information: FloatArray
    """normal equations of corrections of the radii inside the first, in units of the noise, with all other
    unknowns except the spread eliminated, shape (n, n)"""
    radius_gradient: FloatArray
    """right-hand side of these equations, shape (n,)"""
    sectors: FloatArray
    """root mean square residual in each of 16 directions from the centre, shape (16,)"""
    flag: int
    """remarks and reasons for failure, see Flag"""


def rho_at(geometry: FloatArray, xy: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rho, shape (n,), and its derivatives by the unknowns of the geometry, shape (7, n).

    Args:
        geometry: x0, y0, p, q, r and two of l, shape (7,).
        xy: positions, px, shape (n, 2).
    """
    x0, y0, p, q, r, lx, ly = geometry
    dx, dy = xy[:, 0] - x0, xy[:, 1] - y0
    u, v = p * dx + q * dy, q * dx + r * dy
    size = np.hypot(u, v) + 1e-9
    w = 1 + lx * dx + ly * dy
    rho = size / w
    along = 1 / (size * w)
    away = -rho / w  # d rho / d l
    return rho, np.stack(
        [
            -(p * u + q * v) * along - away * lx,
            -(q * u + r * v) * along - away * ly,
            u * dx * along,
            (u * dy + v * dx) * along,
            v * dy * along,
            away * dx,
            away * dy,
        ]
    )


def positions_at(geometry: FloatArray, rho: FloatArray, angle: FloatArray) -> FloatArray:
    """Return positions with given rho (m,) on rays from the centre at angles (k,), px, shape (k, m, 2)."""
    x0, y0, p, q, r, lx, ly = geometry
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    det = p * r - q * q
    vx, vy = (r * c - q * s) / det, (p * s - q * c) / det  # |S v| = 1
    t = rho / (1 - rho * (lx * vx + ly * vy))
    return np.stack([x0 + t * vx, y0 + t * vy], axis=-1)


def fit_edges(geometry: FloatArray, xy: FloatArray, ring: IntArray, rings: int) -> FloatArray | None:
    """Return the geometry of concentric circles with unknown radii through points on their edges.

    Args:
        geometry: approximate values, shape (7,).
        xy: points on the edges, px, shape (n, 2).
        ring: edge of each point, 0 for the outermost, whose radius is 1, shape (n,).
        rings: number of edges; with one edge the perspective is not estimated but kept.

    Returns:
        x0, y0, p, q, r and two of l, shape (7,); None if no circles pass through the points.
    """
    theta = np.append(geometry, [np.median(rho_at(geometry, xy)[0][ring == i]) for i in range(rings)])
    theta[GEOMETRY] = 1.0
    free = np.r_[:GEOMETRY, GEOMETRY + 1 : GEOMETRY + rings] if rings > 1 else np.arange(5)
    for _ in range(MAX_STEPS):
        rho, by = rho_at(theta[:GEOMETRY], xy)
        scale = 1 / np.hypot(by[0], by[1])
        A = np.zeros((len(xy), GEOMETRY + rings))
        A[:, :GEOMETRY] = by.T
        A[np.arange(len(xy)), GEOMETRY + ring] = -1.0
        v = (theta[GEOMETRY + ring] - rho) * scale
        # A ray may meet objects other than the edges: points that are far off lose weight (Huber).
        limit = 3 * max(1.4826 * float(np.median(np.abs(v))), 0.05)
        weight = np.sqrt(np.minimum(1.0, limit / np.maximum(np.abs(v), 1e-12)))
        step = np.linalg.lstsq(A[:, free] * (scale * weight)[:, None], v * weight, rcond=None)[0]
        theta[free] += step
        p, q, r = theta[2:5]
        if (
            not np.isfinite(theta).all()
            or p * r <= q * q
            or np.hypot(*theta[5:7]) > STEEPEST * math.sqrt(p * r - q * q)
        ):
            return None
        if np.hypot(step[0], step[1]) < LAST_STEP_PX:
            return np.asarray(theta[:GEOMETRY])
    return None


def fit_concentric(
    image: AnyArray,
    geometry: FloatArray,
    radii: FloatArray,
    blur: float,
    *,
    noise: float,
    saturation: float,
) -> ConcentricFit | None:
    """Fit rings of known radii.

    Args:
        image: integer intensities, shape (H, W).
        geometry: approximate x0, y0, p, q, r and two of l, shape (7,).
        radii: radii of the edges from the outside inwards, starting with 1, shape (n + 1,).
        blur: approximate standard deviation of the edges, px.
        noise: approximate standard deviation of the intensities; weights spread of the ink and sharpening.
        saturation: intensities from this value on are censored.

    Returns:
        The fit; None if it does not converge or leaves the photograph.

    Source: Gauss-Markov model with Levenberg-Marquardt steps.
    """
    length = float(abs(geometry[2] * geometry[4] - geometry[3] ** 2) ** -0.5)
    pixels = _pixels(image, geometry)
    if pixels is None:
        return None
    xy, value = pixels
    prior = np.zeros(UNKNOWNS)
    prior[SPREAD] = (max(noise, math.sqrt(QUANTISATION)) / SPREAD_SIGMA) ** 2
    prior[SHARPENING] = (max(noise, math.sqrt(QUANTISATION)) / SHARPENING_SIGMA) ** 2
    theta = np.concatenate([geometry, [0.0, 1.0, blur, 0.0, 0.0, 0.0, 0.0]])
    J, _, _, _ = _linearise(theta, xy, value, radii, length, math.inf)
    levels = J[[BACKGROUND, CONTRAST]]
    theta[[BACKGROUND, CONTRAST]] = np.linalg.lstsq(levels.T, value, rcond=None)[0]
    damping, settled = 1e-3, False
    J, v, weight, _ = _linearise(theta, xy, value, radii, length, saturation)
    squares = float(v @ v)
    for _ in range(MAX_STEPS):
        N = J @ J.T + np.diag(prior)
        diagonal = np.maximum(np.diag(N), 1e-12)
        step = np.linalg.solve(N + damping * np.diag(diagonal), J @ v - prior * theta)
        trial = theta + step
        trial[BLUR] = min(max(trial[BLUR], MIN_BLUR), MAX_BLUR)
        p, q, r = trial[2:5]
        regular = p > 0 and p * r > q * q and np.hypot(*trial[5:7]) < STEEPEST / length
        if not regular or np.hypot(*(trial[:2] - geometry[:2])) > length:
            return None
        J1, v1, weight, edges = _linearise(trial, xy, value, radii, length, saturation)
        after = float(v1 @ v1 + prior @ trial**2)
        if after <= squares * (1 + 1e-9):
            theta, J, v, squares = trial, J1, v1, after
            damping /= 10
        elif np.hypot(step[0], step[1]) >= LAST_STEP_PX:
            damping *= 10
        # The derivatives are approximate, so the last steps, far below the sigma, may increase the cost.
        if np.hypot(step[0], step[1]) < LAST_STEP_PX and damping <= 1e-3:
            settled = True
            break
    if not settled:
        return None
    J, v, weight, edges = _linearise(theta, xy, value, radii, length, saturation)
    used = int(weight.sum())
    variance = max(float(v @ v) / max(used - UNKNOWNS, 1), QUANTISATION)
    cofactor = _inverse(J @ J.T + np.diag(prior))
    covariance = variance * cofactor
    # Corrections of the radii inside the first, after all other unknowns except the spread are eliminated.
    others = np.delete(J, SPREAD, axis=0)
    shared = edges[1:] @ others.T @ _inverse(others @ others.T)
    information = (edges[1:] @ edges[1:].T - shared @ (others @ edges[1:].T)) / variance
    gradient = (edges[1:] @ v - shared @ (others @ v)) / variance
    dx, dy = (xy - theta[:2]).T
    sector = (np.floor(np.arctan2(dy, dx) / (2 * math.pi) * 16).astype(int)) % 16
    sectors = np.sqrt(
        np.bincount(sector, v * v, minlength=16) / np.maximum(np.bincount(sector, weight, 16), 1)
    )
    flag = Flag.SATURATED if used < len(value) else Flag.NONE
    return ConcentricFit(theta, covariance, math.sqrt(variance), information, gradient, sectors, int(flag))


def _inverse(N: FloatArray) -> FloatArray:
    """Return the inverse of normal equations whose unknowns differ in magnitude."""
    scale = 1 / np.sqrt(np.maximum(np.diag(N), 1e-300))
    return np.asarray(np.linalg.pinv(N * np.outer(scale, scale), hermitian=True) * np.outer(scale, scale))


def _pixels(image: AnyArray, geometry: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Return position and intensity of the pixels on the rings and on the paper around them."""
    angle = np.linspace(0, 2 * math.pi, 64, endpoint=False)
    outline = positions_at(geometry, np.array([SURROUNDINGS]), angle)[:, 0]
    low, high = np.floor(outline.min(axis=0)).astype(int), np.ceil(outline.max(axis=0)).astype(int)
    height, width = image.shape
    if low.min() < 0 or high[0] >= width or high[1] >= height:
        return None
    y, x = np.mgrid[low[1] : high[1] + 1, low[0] : high[0] + 1]
    xy = np.stack([x.ravel(), y.ravel()], axis=1).astype(float)
    inside = rho_at(geometry, xy)[0] < SURROUNDINGS
    part = image[low[1] : high[1] + 1, low[0] : high[0] + 1].ravel().astype(float)
    return xy[inside], part[inside]


def _linearise(
    theta: FloatArray,
    xy: FloatArray,
    value: FloatArray,
    radii: FloatArray,
    length: float,
    saturation: float,
) -> tuple[FloatArray, FloatArray, BoolArray, FloatArray]:
    """Return derivatives by the unknowns (14, n), residuals (n,), which pixels count, derivatives by radii.

    The scale of the blur, |grad rho|, is treated as constant, as its change matters only away from the edges.
    """
    _, _, p, q, r = theta[:5]
    B, A, s, e, gx, gy, a = theta[GEOMETRY:]
    masked = math.hypot(s, MASK_PX)
    dx, dy = (xy - theta[:2]).T
    rho, by = rho_at(theta[:GEOMETRY], xy)
    slope = np.hypot(by[0], by[1]) + 1e-12
    u, v = p * dx + q * dy, q * dx + r * dy
    wx, wy = p * u + q * v, q * u + r * v
    w = np.hypot(wx, wy) + 1e-12
    # An edge in this direction has curvature |S t|^2 / |S S dx| where its radius is rho, with t along it.
    bent = ((p * wy - q * wx) ** 2 + (q * wy - r * wx) ** 2) / w**3 * rho
    ink, by_rho, by_blur, by_spread, by_sharpening = (np.zeros(len(xy)) for _ in range(5))
    edges = np.zeros((len(radii), len(xy)))
    for i, radius in enumerate(radii):
        sign = 1 - 2 * (i % 2)
        curvature = bent / radius
        for part, way, blur in (
            (1 + a, 1.0, s),
            (-a, -1.0, masked),
        ):  # sharpened part; part removed by the mask
            z = (radius + sign * e - rho) / (blur * slope) - blur * curvature / 2
            density = part * _DENSITY_0 * np.exp(-z * z / 2)
            smooth = sign * ndtr(z)
            ink += part * smooth
            by_sharpening += way * smooth
            edges[i] += sign * density / (blur * slope)
            by_blur -= sign * density * (z / blur + curvature) * s / blur
        by_rho -= edges[i]
        by_spread += sign * edges[i]
    gain = 1 + (gx * dx + gy * dy) / length
    level = B + A * ink
    model = level * gain
    censored = ((value >= saturation) & (model >= saturation)) | ((value <= 0) & (model <= 0))
    weight = ~censored
    step = A * gain
    J = np.empty((UNKNOWNS, len(xy)))
    J[:GEOMETRY] = by * (step * by_rho)
    J[0] -= level * gx / length
    J[1] -= level * gy / length
    J[BACKGROUND], J[CONTRAST] = gain, ink * gain
    J[BLUR], J[SPREAD] = step * by_blur, step * by_spread
    J[SHARPENING] = step * by_sharpening
    J[GAIN_X], J[GAIN_Y] = level * dx / length, level * dy / length
    return J * weight, (value - model) * weight, weight, edges * step * weight
