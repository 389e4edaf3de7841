"""Small square tag measured by a least squares fit of all its modules at once.

If modules are hardly wider than the blur, the two edges at a corner cannot be separated from the code behind
them, but the whole code is known once it is read. Let (u, v) = h(x, y) be the homography from pixels into
modules, B the intensity of clear modules, A the step to black ones, s the blur, and c(i, j) = 1 for black
modules. The intensity at pixel (x, y) is

    I = B + A sum_ij c(i, j) W_i(u) W_j(v),   W_i(u) = Phi((u - i) / s_u) - Phi((u - i - 1) / s_u)

s_u = s |grad u| is the blur in modules. Distortion does not bend edges of so few px. Uneven light (shadows,
highlights) is estimated jointly as a random field, by its values in the middle of modules. The fit also
confirms the reading: the code in uneven light must be far likelier than clutter of the same contrast.

Source: Rasmussen and Williams (2006), Gaussian Processes for Machine Learning, chapters 2 and 5, for the
field and its likelihood; Kass and Raftery (1995), Journal of the American Statistical Association 90(430),
for the ratio of likelihoods.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.runtime.compiling import kernel
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
from sfm.targets.outlines import Flag

# Tags are printed with one clear module around them. Objects behind it affect this many blurs of it.
BEHIND_BLURS = 2.0
# Light on a tag is a random field whose correlation falls to 1/e over this many modules. It changes reflected
# light by a factor, like levels of 1 and 0.6 about their mean (a shadow of 40 %), and adds a part of the step
# (glare).
LIGHT_SIGMA, GLARE_SIGMA, LIGHT_MODULES = 0.25, 0.05, 3.0
# Light that modules do not resolve, in steps, for each pixel; the likeliest of these strengths is chosen.
PIXEL_SIGMA, STRENGTHS = 0.1, (1.0, 0.3, 0.1, 0.03)
LIGHT_ROUNDS = 2  # rounds of estimating it, each with the levels of the round before
MIN_SEEN = 0.3  # part of the usual weight of a module from which a module beside the tag counts
# Unevenness of print, in steps. Clutter is a random field of black and clear, half the step about their
# middle, with strokes one module wide.
PRINT_SIGMA, CLUTTER_SIGMA, CLUTTER_MODULES = 0.03, 0.5, 1.0
# Minimum log likelihood of the code over that of clutter. It must exceed the log number of codes and
# placements tried: about 8 for 1000 codes in 4 rotations, 16 for positions in 1 MP and 20 for shapes. The
# maximum of 66 letters that OpenCV reads in 40 pages is 31. The minimum of 160 tags of 15 to 60 px under
# shadows and highlights is 56, and of 530 tags of 10 to 23 px 59.
MIN_EVIDENCE = 43.0
# Maximum number of steps; the last step moves each corner by less than this, px.
STEPS, LAST_STEP_PX = 200, 1e-3
# In a tilted tag the blur acts on u and v with a correlation. That part is a blur along one direction, summed
# over the nodes of Gauss and Hermite (Abramowitz and Stegun 1964, table 25.10, n = 5, for a unit variance).
NODES = (-2.85697001, -1.35562618, 0.0, 1.35562618, 2.85697001)
WEIGHTS = (0.01125741, 0.22207592, 0.53333333, 0.22207592, 0.01125741)
FAR = 8.3  # standard deviations of the blur beyond which Phi is 0 or 1 to the last digit
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

    In addition, `noise` is the standard deviation of an intensity, relative to which modules are judged. The
    four corners of a tag share background, step, blur and noise. Gains and sharpening are 0.

    Source: Gauss-Markov model with Levenberg-Marquardt steps; covariance of the corners by propagation, wider
    if modules scatter more than their pixels show.
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
    """Fit one tag, write the result into row i, and return its flag."""
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
    inside &= ((uv > 0) & (uv < modules)).any(axis=1)  # the tags of an AprilGrid have squares at the corners
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
    light: _Light | None = None
    for _ in range(1 + LIGHT_ROUNDS):
        solved = _iterate(theta, P, value, used, black, scale, light)
        if solved is None:
            return Flag.NO_CONVERGENCE.value
        theta, J, residual = solved
        corners_px = _corners(theta, modules) * scale + middle
        if np.abs(corners_px - quad).max() > FARTHEST_PX:
            return Flag.NO_CONVERGENCE.value
        seen = _see_modules(theta, P, black)
        light = _estimate_light(seen, residual, used)
    assert light is not None
    row = fits.theta[i]
    if _evidence_of_code(seen, residual, noise) < MIN_EVIDENCE:
        return Flag.POOR_FIT.value
    row[:, :2] = corners_px
    row[:, BACKGROUND], row[:, CONTRAST], row[:, BLUR] = theta[_B], theta[_A], theta[_S] * scale
    variance = float(residual @ light.without(residual)) / max(int(used.sum()) - len(theta), 1)
    cofactor = np.linalg.pinv(J.T @ light.without(J), hermitian=True)
    fits.noise[i] = math.sqrt(variance)
    # At the end of a shadow, the pixels of a module have a common error: the scatter of the contributions of
    # modules (Liang and Zeger 1986, Biometrika 73(1)). As many of them as unknowns are lost.
    parts = np.zeros((len(seen.place), J.shape[1]))
    np.add.at(parts, seen.share.argmax(axis=1), J * light.without(residual)[:, None])
    scatter, shown = parts.T @ parts * len(parts) / (len(parts) - J.shape[1]), []
    for j, place in enumerate(_square(modules)):
        D = np.zeros((5, len(theta)))
        at = np.append(_corners(theta, modules)[j], 1.0)
        D[:2, _H] = -scale * np.linalg.solve(*_derivatives(theta, at, place))
        D[2, _B], D[3, _A], D[4, _S] = 1.0, 1.0, scale
        columns = np.array([X0, Y0, BACKGROUND, CONTRAST, BLUR])
        fits.covariance[i, j] = 0.0
        stated, effect = variance * D @ cofactor @ D.T, D[:2] @ cofactor
        shown.append(np.trace(np.linalg.solve(stated[:2, :2], effect @ scatter @ effect.T)) / 2)
        fits.covariance[i, j][np.ix_(columns, columns)] = stated
    fits.covariance[i] *= max(float(np.mean(shown)), 1.0)
    return 0 if used.all() else Flag.SATURATED.value


@dataclass(frozen=True)
class _Light:
    """Uneven light on a tag: a random field, observed by its pixels and its modules."""

    pixels: FloatArray
    """covariances of the light at pixels with the light at modules, (n, q)"""
    weights: FloatArray
    """matrix from residuals summed over `pixels` to the coefficients of the most probable field, (q, q)"""

    def without(self, values: FloatArray) -> FloatArray:
        """Return values at pixels, (n,) or (n, k), without their most probable light."""
        return np.asarray(values - self.pixels @ (self.weights @ (self.pixels.T @ values)))


def _iterate(
    theta: FloatArray,
    P: FloatArray,
    value: FloatArray,
    used: BoolArray,
    black: BoolArray,
    scale: float,
    light: _Light | None,
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return the unknowns of the least squares fit, its Jacobian and residuals; None without convergence.

    Any given light is estimated jointly. Censored intensities count only if they exceed the model.
    """
    modules, damping = len(black), 1e-3

    def model(theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        share, D = _model(theta, P, black)
        J = np.column_stack([theta[_A] * D[:, :8], np.ones(len(P)), share, theta[_A] * D[:, 8]])
        difference = value - (theta[_B] + theta[_A] * share)
        off = np.where(used, difference, np.maximum(difference, 0.0))
        weighted = off if light is None else light.without(off)
        return J, off, weighted, float(off @ weighted)

    J, residual, weighted, cost = model(theta)
    for _ in range(STEPS):
        N, g = J.T @ (J if light is None else light.without(J)), J.T @ weighted
        step = np.linalg.lstsq(N + damping * np.diag(np.diag(N) + 1e-12), g, rcond=None)[0]
        tried = theta + step
        tried[_S] = np.clip(tried[_S], MIN_BLUR / scale, MAX_BLUR / scale)
        moved = np.abs(_corners(tried, modules) - _corners(theta, modules)).max() * scale
        if not np.isfinite(moved):
            return None
        after = model(tried)
        if after[-1] <= cost:
            theta, damping = tried, damping / 5
            J, residual, weighted, cost = after
        else:
            damping *= 5
        if moved < LAST_STEP_PX:
            return theta, J, residual
    return None


def _square(modules: int) -> FloatArray:
    return np.array([[0, 0], [modules, 0], [modules, modules], [0, modules]], dtype=float)


def _pixels_of(H: FloatArray, places: FloatArray) -> FloatArray:
    """Return positions on the tag in the scaled frame of the pixels, shape (n, 2)."""
    homogeneous = np.column_stack([places, np.ones(len(places))]) @ np.linalg.inv(H).T
    return np.asarray(homogeneous[:, :2] / homogeneous[:, 2:])


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
    """Return the part of black at scaled pixels, (n,), and its derivatives by homography and blur, (n, 9)."""
    uv, w, along, rest = _in_modules(theta, P)
    share, by_uv, d_s = np.zeros(len(P)), np.zeros((len(P), 2)), np.zeros(len(P))
    parts, span = np.empty((4, 2, len(black))), np.empty((2, 2), dtype=np.int64)
    _sum_modules(uv, along, rest, black.astype(float), parts, span, share, by_uv, d_s)
    d_u, d_v = by_uv.T
    D = np.empty((len(P), 9))
    D[:, :3], D[:, 3:6] = d_u[:, None] * P / w[:, None], d_v[:, None] * P / w[:, None]
    D[:, 6:8] = -(d_u * uv[:, 0] + d_v * uv[:, 1])[:, None] * P[:, :2] / w[:, None]
    D[:, 8] = d_s / theta[_S]
    return share, D


@kernel
def _sum_modules(
    uv: FloatArray,
    along: FloatArray,
    rest: FloatArray,
    black: FloatArray,
    parts: FloatArray,
    span: IntArray,
    share: FloatArray,
    by_uv: FloatArray,
    by_ln_s: FloatArray,
) -> None:
    """Sum the modules that each pixel sees, over the nodes of the blur along one direction.

    Args:
        uv: positions of the pixels, modules, (n, 2).
        along: blur along one direction, (n, 2).
        rest: blur of u and v beside it, (n, 2).
        black: 1 for black modules, rows are v, (m, m).
        parts: is overwritten, (4, 2, m).
        span: is overwritten, (2, 2).
        share: receives the part of black, added to it, (n,).
        by_uv: receives its derivatives by the position, (n, 2).
        by_ln_s: receives its derivative by the logarithm of the blur, (n,).
    """
    m = len(black)
    W, by_place, by_blur, seen = parts[0], parts[1], parts[2], parts[3]
    for n in range(len(uv)):
        for k in range(len(NODES)):
            node, weight = NODES[k], WEIGHTS[k]
            for axis in range(2):
                place, blur = uv[n, axis] + node * along[n, axis], rest[n, axis]
                span[axis, 0] = min(max(math.floor(place - FAR * blur), 0), m)
                span[axis, 1] = min(max(math.ceil(place + FAR * blur), 0), m)
                phi = density = at_edge = 0.0
                for e in range(span[axis, 0], span[axis, 1] + 1):
                    t = (place - e) / blur
                    phi_before, density_before, before = phi, density, at_edge
                    phi, density = 0.5 * math.erfc(-t * math.sqrt(0.5)), math.exp(-0.5 * t * t)
                    at_edge = density * t
                    if e > span[axis, 0]:
                        W[axis, e - 1] = phi_before - phi
                        by_place[axis, e - 1] = density_before - density
                        by_blur[axis, e - 1] = at_edge - before
                        seen[axis, e - 1] = 0.0
            for row in range(span[1, 0], span[1, 1]):
                for column in range(span[0, 0], span[0, 1]):
                    seen[0, column] += black[row, column] * W[1, row]
                    seen[1, row] += black[row, column] * W[0, column]
            for i in range(span[0, 0], span[0, 1]):
                share[n] += weight * seen[0, i] * W[0, i]
            for axis in range(2):
                of_place = of_blur = 0.0
                for i in range(span[axis, 0], span[axis, 1]):
                    of_place += seen[axis, i] * by_place[axis, i]
                    of_blur += seen[axis, i] * by_blur[axis, i]
                of_place *= weight / math.sqrt(2 * math.pi) / rest[n, axis]
                by_uv[n, axis] += of_place
                by_ln_s[n] += weight / math.sqrt(2 * math.pi) * of_blur + node * of_place * along[n, axis]


def _in_modules(theta: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return scaled pixels in modules, (n, 2), their denominators, (n,), and the blur there.

    The blur has a part along one direction and a part on u and v independently, each (n, 2).
    """
    H, blur = np.append(theta[_H], 1.0).reshape(3, 3), theta[_S]
    w = P @ H[2]
    uv = P @ H[:2].T / w[:, None]
    gradient = (H[None, :2, :2] - uv[:, :, None] * H[2, :2]) / w[:, None, None]
    sigma = blur * np.sqrt((gradient**2).sum(axis=2))
    rho = blur**2 * (gradient[:, 0] * gradient[:, 1]).sum(axis=1) / sigma.prod(axis=1)
    along = np.sqrt(np.abs(rho))[:, None] * sigma * np.column_stack([np.ones(len(rho)), np.sign(rho)])
    rest = np.maximum(1 - np.abs(rho), np.finfo(float).eps)  # 0 if a tag is seen edge-on
    return uv, w, along, sigma * np.sqrt(rest)[:, None]


@dataclass(frozen=True)
class _Modules:
    """The q modules that pixels see: those of a tag, and the clear ones around it."""

    uv: FloatArray
    """positions of the pixels, modules, (n, 2)"""
    share: FloatArray
    """part of each module in each pixel, (n, q)"""
    weight: FloatArray
    """sum of squares of these parts, (q,)"""
    place: FloatArray
    """centre of each module, modules, (q, 2)"""
    printed: BoolArray
    """black modules, (q,)"""
    judged: BoolArray
    """modules of the tag itself, (q,)"""
    background: float
    step: float

    @property
    def level(self) -> FloatArray:
        """Intensities of the modules in even light, (q,)."""
        return np.asarray(self.background + self.step * self.printed, dtype=float)

    def covariance(self, at: FloatArray, level_at: FloatArray) -> FloatArray:
        """Return covariances of the light at positions (k, 2), intensity (k,), with the light at modules."""
        shade = LIGHT_SIGMA**2 * np.outer(level_at, self.level)
        return np.asarray(
            (shade + (GLARE_SIGMA * max(abs(self.step), np.finfo(float).eps)) ** 2)
            * np.exp(-_distances(at, self.place) / LIGHT_MODULES)
        )


def _see_modules(theta: FloatArray, P: FloatArray, black: BoolArray) -> _Modules:
    """Return the modules of a tag that scaled pixels see."""
    m = len(black)
    uv, _, along, rest = _in_modules(theta, P)
    shares = np.zeros((len(P), m + 2, m + 2))
    for node, weight in zip(NODES, WEIGHTS, strict=True):
        phi = ndtr(((uv + node * along)[:, :, None] - np.arange(-1, m + 2)) / rest[:, :, None])
        W = phi[:, :, :-1] - phi[:, :, 1:]
        shares += weight * W[:, 1, :, None] * W[:, 0, None, :]
    share: FloatArray = shares.reshape(len(P), -1)
    weight_of_module = (share**2).sum(axis=0)
    seen = weight_of_module > MIN_SEEN * np.median(weight_of_module)
    seen[[0, m + 1, -m - 2, -1]] = False
    return _Modules(
        uv,
        share[:, seen],
        weight_of_module[seen],
        np.asarray(np.argwhere(np.ones((m + 2, m + 2)))[seen, ::-1] - 0.5, dtype=float),
        np.pad(black, 1).ravel()[seen],
        np.pad(np.ones_like(black), 1).ravel()[seen],
        float(theta[_B]),
        float(theta[_A]),
    )


def _estimate_light(seen: _Modules, residual: FloatArray, used: BoolArray) -> _Light:
    """Return the light on a tag, by its values at the centres of its modules and of the clear ones around.

    The residuals are those of a fit of the tag and contain the light.
    """
    level_px = seen.background + seen.step * seen.share[:, seen.printed].sum(axis=1)
    K = seen.covariance(seen.place, seen.level)
    pixels = seen.covariance(seen.uv, level_px) * used[:, None]
    seen_by, N = pixels.T @ residual, pixels.T @ pixels
    likeliest = math.inf
    for strength in STRENGTHS:
        R = (PIXEL_SIGMA * max(abs(seen.step), np.finfo(float).eps) / strength) ** 2 * K
        inverse = np.linalg.inv(N + R)
        left = float(residual @ residual - seen_by @ inverse @ seen_by)
        unlikely = len(residual) * math.log(left) + np.linalg.slogdet(N + R)[1] - np.linalg.slogdet(R)[1]
        if unlikely < likeliest:
            likeliest, weights = unlikely, np.asarray(inverse, dtype=float)
    return _Light(pixels, weights)


def _evidence_of_code(seen: _Modules, residual: FloatArray, noise: float) -> float:
    """Return the log likelihood of the code in uneven light over that of clutter.

    The residuals are those of a fit of the tag and contain the light. The result is -inf if a module of the
    code is likelier in the other colour.
    """
    modules, judged, step = seen.share / seen.weight, seen.judged, max(abs(seen.step), np.finfo(float).eps)
    mixed, unseen = modules.T @ seen.share, noise**2 * modules.T @ modules
    unseen += (PRINT_SIGMA * step) ** 2 * np.eye(len(seen.place))
    clutter = (CLUTTER_SIGMA * step) ** 2 * np.exp(-_distances(seen.place, seen.place) / CLUTTER_MODULES)
    off, middle = modules.T @ residual, seen.background + seen.step / 2
    in_light = mixed @ seen.covariance(seen.place, seen.level) @ mixed.T + unseen
    if _has_wrong_module(off, mixed * np.where(seen.printed, -seen.step, seen.step), in_light, judged):
        return -math.inf
    return _ln_likelihood(off, in_light, judged) - _ln_likelihood(
        off + mixed @ (seen.level - middle), mixed @ clutter @ mixed.T + unseen, judged
    )


def _distances(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(np.hypot(*(a[:, None] - b[None]).transpose(2, 0, 1)))


def _has_wrong_module(
    off: FloatArray, inverted: FloatArray, covariance: FloatArray, judged: BoolArray
) -> bool:
    """Return whether the code is likelier with one of its modules in the other colour.

    Args:
        off: intensities of modules less those of the code, (q,).
        inverted: change of these by each module (column) in its other colour, (q, q).
        covariance: covariance of `off`, (q, q).
        judged: modules of the tag, (q,).
    """
    h = inverted[np.ix_(judged, judged)]
    weighted = np.linalg.solve(covariance[np.ix_(judged, judged)], h)
    return bool((weighted.T @ off[judged] > 0.5 * (h * weighted).sum(axis=0)).any())


def _ln_likelihood(values: FloatArray, covariance: FloatArray, judged: BoolArray) -> float:
    """Return the log density of the judged values, without its constant."""
    values, covariance = values[judged], covariance[np.ix_(judged, judged)]
    return -0.5 * float(values @ np.linalg.solve(covariance, values) + np.linalg.slogdet(covariance)[1])
