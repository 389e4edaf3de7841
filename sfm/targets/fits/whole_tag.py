"""Small square tag by the least squares fit of all its modules at once.

Where modules are hardly wider than the blur, the two edges at a corner cannot be told apart from the code
behind them, but the whole code is known once it is read. Model of the intensity at pixel (x, y) with the
homography (u, v) = h(x, y) into modules, B the intensity of clear modules, A the step to black ones, s the
blur, and c(i, j) = 1 for black modules:

    I = B + A sum_ij c(i, j) W_i(u) W_j(v),   W_i(u) = Phi((u - i) / s_u) - Phi((u - i - 1) / s_u)

s_u = s |grad u| is the blur in modules. Distortion does not bend edges of so few px. A wrong code, or a
picture that is no tag, leaves modules off the levels of the code: the fit confirms the reading as well.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.special import ndtr

from sfm.conventions import AnyArray, BoolArray, FloatArray
from sfm.targets.fits.corner import (
    BACKGROUND,
    BLUR,
    BLUR_START,
    CONTRAST,
    FARTHEST_PX,
    MAX_BLUR,
    MIN_BLUR,
    UNKNOWNS,
    X0,
    Y0,
    CornerFits,
)
from sfm.targets.flags import Flag

# Tags are printed with one clear module around them. What is behind it acts up to so many blurs into it.
BEHIND_BLURS = 2.0
# Largest RMS of the distances of modules from the levels of their code, in steps, beyond what noise explains.
# Of tags of 10 to 120 px with noise of 1 to 10 % of the step, in a light that changes by 30 % over them or on
# bent paper the largest is 0.061; covered by a disc at one corner 0.073. The least of 67 letters read as tags
# is 0.099. The edge of a shadow that takes 40 % of the light makes 0.08 to 0.18.
MAX_MODULE_RMS = 0.08
# Largest number of steps; the last one is less than this for each corner, px.
STEPS, LAST_STEP_PX = 40, 1e-3
# In a tilted tag the blur acts on u and v with a correlation. That part is a blur along one direction, summed
# up at the nodes of Gauss and Hermite (Abramowitz and Stegun 1964, table 25.10, n = 5, for a unit variance).
NODES = (-2.85697001, -1.35562618, 0.0, 1.35562618, 2.85697001)
WEIGHTS = (0.01125741, 0.22207592, 0.53333333, 0.22207592, 0.01125741)
_H, _B, _A, _S = slice(0, 8), 8, 9, 10


def fit_whole_tags(
    image: AnyArray,
    quads: FloatArray,
    tag_from_pixel: FloatArray,
    clear: BoolArray,
    saturation: float,
    noise: float,
) -> CornerFits:
    """Fit all modules of every tag; arguments and results are those of `corner.fit_corners`.

    Also given is the standard deviation of an intensity, against which modules are judged.
    The four corners of a tag share background, step, blur and noise. Gains and sharpening are 0.

    Source: Gauss-Markov model with Levenberg-Marquardt steps; covariance of the corners by propagation.
    """
    k = len(quads)
    fits = CornerFits(
        np.zeros((k, 4, UNKNOWNS)),
        np.full((k, 4, UNKNOWNS, UNKNOWNS), math.nan),
        np.full((k, 4), math.nan),
        np.zeros((k, 4), np.int64),
    )
    for i in range(k):
        fits.theta[i, :, :2] = quads[i]
        flag = _fit_tag(image, quads[i], tag_from_pixel[i], ~clear[i], saturation, noise, fits, i)
        fits.flag[i] = flag
    return fits


def _fit_tag(
    image: AnyArray,
    quad: FloatArray,
    tag_from_pixel: FloatArray,
    black: BoolArray,
    saturation: float,
    noise: float,
    fits: CornerFits,
    i: int,
) -> int:
    """Fit one tag, write what is found into row i, and return its flag."""
    modules, (height, width) = len(black), image.shape
    middle, scale = quad.mean(axis=0), float(np.ptp(quad, axis=0).max())
    if not np.isfinite(scale) or scale <= 0:
        return Flag.NO_CONVERGENCE.value
    side = np.linalg.norm(quad - np.roll(quad, 1, axis=0), axis=1).min()
    margin = max(1 - BEHIND_BLURS * BLUR_START * modules / side, 0.0)
    reach = (0.5 + 2 * margin / modules) * scale * math.sqrt(2)
    low, high = np.floor(middle - reach).astype(int), np.ceil(middle + reach).astype(int)
    y, x = np.mgrid[max(low[1], 0) : min(high[1] + 1, height), max(low[0], 0) : min(high[0] + 1, width)]
    xy = np.column_stack([x.ravel(), y.ravel()])
    P = np.column_stack([(xy - middle) / scale, np.ones(len(xy))])
    H = tag_from_pixel @ np.array([[scale, 0, middle[0]], [0, scale, middle[1]], [0, 0, 1.0]])
    uv = P @ H.T
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = uv[:, :2] / uv[:, 2:]
    inside = ((uv > -margin) & (uv < modules + margin)).all(axis=1)
    outer = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * margin + _square(modules)
    around = _pixels_of(H, outer) * scale + middle
    if not ((around >= 0) & (around <= (width - 1, height - 1))).all():
        return Flag.CUT_BY_BORDER.value
    P, value = P[inside], image[xy[inside, 1], xy[inside, 0]].astype(float)
    used = value < saturation
    theta = np.concatenate([(H / H[2, 2]).ravel()[:8], [0.0, 0.0, BLUR_START / scale]])
    pattern, _ = _model(theta, P, black)
    if used.sum() <= len(theta):
        return Flag.NO_CONVERGENCE.value
    design = np.column_stack([np.ones(len(P)), pattern])
    theta[_B : _A + 1] = np.linalg.lstsq(design[used], value[used], rcond=None)[0]
    damping, converged = 1e-3, False
    predicted, J = _intensity(theta, P, black)
    residual = np.where(used, value - predicted, np.maximum(value - predicted, 0.0))
    for _ in range(STEPS):
        N, g = J.T @ J, J.T @ residual
        step = np.linalg.lstsq(N + damping * np.diag(np.diag(N) + 1e-12), g, rcond=None)[0]
        tried = theta + step
        tried[_S] = np.clip(tried[_S], MIN_BLUR / scale, MAX_BLUR / scale)
        corners = [_corners(one, modules) for one in (theta, tried)]
        moved = np.abs(corners[1] - corners[0]).max() * scale
        if not np.isfinite(moved):
            return Flag.NO_CONVERGENCE.value
        predicted, J_tried = _intensity(tried, P, black)
        after = np.where(used, value - predicted, np.maximum(value - predicted, 0.0))
        if after @ after <= residual @ residual:
            theta, J, residual, damping = tried, J_tried, after, damping / 5
        else:
            damping *= 5
        if moved < LAST_STEP_PX:
            converged = True
            break
    corners_px = _corners(theta, modules) * scale + middle
    row = fits.theta[i]
    if not converged or np.abs(corners_px - quad).max() > FARTHEST_PX:
        return Flag.NO_CONVERGENCE.value
    variance = float(residual @ residual) / max(int(used.sum()) - len(theta), 1)
    if _module_rms(theta, P, residual, noise, black) > MAX_MODULE_RMS:
        return Flag.POOR_FIT.value
    row[:, :2] = corners_px
    row[:, BACKGROUND], row[:, CONTRAST], row[:, BLUR] = theta[_B], theta[_A], theta[_S] * scale
    cofactor = np.linalg.pinv(J.T @ J, hermitian=True)
    fits.noise[i] = math.sqrt(variance)
    for j, place in enumerate(_square(modules)):
        D = np.zeros((5, len(theta)))
        at = np.append(_corners(theta, modules)[j], 1.0)
        D[:2, _H] = -scale * np.linalg.solve(*_derivatives(theta, at, place))
        D[2, _B], D[3, _A], D[4, _S] = 1.0, 1.0, scale
        columns = np.array([X0, Y0, BACKGROUND, CONTRAST, BLUR])
        fits.covariance[i, j] = 0.0
        fits.covariance[i, j][np.ix_(columns, columns)] = variance * D @ cofactor @ D.T
    return 0 if used.all() else Flag.SATURATED.value


def _square(modules: int) -> FloatArray:
    return np.array([[0, 0], [modules, 0], [modules, modules], [0, modules]], dtype=float)


def _pixels_of(H: FloatArray, places: FloatArray) -> FloatArray:
    """Return where places of the tag are, in the scaled frame of the pixels, shape (n, 2)."""
    found = np.column_stack([places, np.ones(len(places))]) @ np.linalg.inv(H).T
    return np.asarray(found[:, :2] / found[:, 2:])


def _corners(theta: FloatArray, modules: int) -> FloatArray:
    return _pixels_of(np.append(theta[_H], 1.0).reshape(3, 3), _square(modules))


def _derivatives(theta: FloatArray, at: FloatArray, place: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives of (u, v) at a scaled pixel by the pixel, (2, 2), and the homography, (2, 8)."""
    H = np.append(theta[_H], 1.0).reshape(3, 3)
    w = H[2] @ at
    by_pixel = (H[:2, :2] - place[:, None] * H[2, :2]) / w
    by_h = np.zeros((2, 8))
    by_h[0, :3] = by_h[1, 3:6] = at / w
    by_h[:, 6:] = -place[:, None] * at[:2] / w
    return by_pixel, by_h


def _model(theta: FloatArray, P: FloatArray, black: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return the share of black at scaled pixels, (n,), and its derivatives by homography and blur (n, 9)."""
    modules = len(black)
    uv, w, along, rest = _in_modules(theta, P)
    c = black.astype(float)  # rows are v, columns u
    share, d_u, d_v, d_s = np.zeros((4, len(P)))
    for node, weight in zip(NODES, WEIGHTS, strict=True):
        t = ((uv + node * along)[:, :, None] - np.arange(modules + 1)) / rest[:, :, None]
        phi, density = ndtr(t), np.exp(-0.5 * t**2) / math.sqrt(2 * math.pi)
        W = weight * (phi[:, :, :-1] - phi[:, :, 1:])
        by_uv = (density[:, :, :-1] - density[:, :, 1:]) / rest[:, :, None]
        by_ln_s = -(density * t)[:, :, :-1] + (density * t)[:, :, 1:]
        along_v, along_u = W[:, 1] @ c, W[:, 0] @ c.T
        share += (along_v * W[:, 0]).sum(axis=1) / weight
        by_u, by_v = (along_v * by_uv[:, 0]).sum(axis=1), (along_u * by_uv[:, 1]).sum(axis=1)
        d_u += by_u
        d_v += by_v
        d_s += (along_v * by_ln_s[:, 0]).sum(axis=1) + (along_u * by_ln_s[:, 1]).sum(axis=1)
        d_s += node * (by_u * along[:, 0] + by_v * along[:, 1])
    d_s /= theta[_S]
    D = np.empty((len(P), 9))
    D[:, :3], D[:, 3:6] = d_u[:, None] * P / w[:, None], d_v[:, None] * P / w[:, None]
    D[:, 6:8] = -(d_u * uv[:, 0] + d_v * uv[:, 1])[:, None] * P[:, :2] / w[:, None]
    D[:, 8] = d_s
    return share, D


def _in_modules(theta: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return where scaled pixels are in modules, (n, 2), their denominators, (n,), and the blur there.

    It acts along one direction, and on u and v by themselves, both (n, 2).
    """
    H, blur = np.append(theta[_H], 1.0).reshape(3, 3), theta[_S]
    w = P @ H[2]
    uv = P @ H[:2].T / w[:, None]
    gradient = (H[None, :2, :2] - uv[:, :, None] * H[2, :2]) / w[:, None, None]
    sigma = blur * np.sqrt((gradient**2).sum(axis=2))
    rho = blur**2 * (gradient[:, 0] * gradient[:, 1]).sum(axis=1) / sigma.prod(axis=1)
    along = np.sqrt(np.abs(rho))[:, None] * sigma * np.column_stack([np.ones(len(rho)), np.sign(rho)])
    rest = np.maximum(1 - np.abs(rho), np.finfo(float).eps)  # 0 where a tag is seen edge on
    return uv, w, along, sigma * np.sqrt(rest)[:, None]


def _module_rms(
    theta: FloatArray, P: FloatArray, residual: FloatArray, noise: float, black: BoolArray
) -> float:
    """Return how far modules are from the levels of their code, RMS in steps, without the share of noise.

    The light may change linearly over the tag.
    """
    uv, _, along, rest = _in_modules(theta, P)
    share = np.zeros((len(P), *black.shape))
    for node, weight in zip(NODES, WEIGHTS, strict=True):
        phi = ndtr(((uv + node * along)[:, :, None] - np.arange(len(black) + 1)) / rest[:, :, None])
        W = phi[:, :, :-1] - phi[:, :, 1:]
        share += weight * W[:, 1, :, None] * W[:, 0, None, :]
    level = theta[_B] + theta[_A] * share[:, black].sum(axis=1)
    design = np.column_stack([np.ones(len(P)), level, level[:, None] * P[:, :2]])
    unexplained = residual - design @ np.linalg.lstsq(design, residual, rcond=None)[0]
    steps = theta[_A] * share.reshape(len(P), -1)
    weight_of_module = np.maximum((steps**2).sum(axis=0), 1e-12)
    error = steps.T @ unexplained / weight_of_module
    return math.sqrt(max(float((error**2 - noise**2 / weight_of_module).mean()), 0.0))


def _intensity(theta: FloatArray, P: FloatArray, black: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return the intensities of the model, (n,), and their derivatives, (n, 11)."""
    share, D = _model(theta, P, black)
    J = np.column_stack([theta[_A] * D[:, :8], np.ones(len(P)), share, theta[_A] * D[:, 8]])
    return theta[_B] + theta[_A] * share, J
