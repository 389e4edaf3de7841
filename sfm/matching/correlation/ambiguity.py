"""Significance of correlation: whether the best place beats the second-best by more than chance."""

from __future__ import annotations

import numpy as np

from sfm.conventions import AnyArray, BoolArray, FloatArray
from sfm.matching.correlation.ncc import template_corners

QUANTILE = 1.645  # of the normal distribution, one-sided, 5 %
MAX_R = 1.0 - 1e-12  # above it Fisher's z is infinite


def ambiguous(best: FloatArray, second: FloatArray, pixels: FloatArray) -> BoolArray:
    """Return whether the second-best place may be as good as the best.

    The difference of their Fisher's z is compared with its standard error, that of independent coefficients
    of so many pixels. Of 3 independent pixels or less nothing can be concluded, and any second place counts.

    Args:
        best: coefficients r of the best places, (k,).
        second: those of the second-best places, -1 where there is none, (k,).
        pixels: pixels of the template that are independent of one another, (k,).

    Source: Fisher (1921), Metron 1, pp. 3-32.
    """
    z = np.arctanh(np.clip([best, second], -MAX_R, MAX_R))
    deviates = (z[0] - z[1]) * np.sqrt(np.maximum(pixels - 3.0, 0.0) / 2.0)
    return np.asarray((second > -1.0) & ~(deviates >= QUANTILE))


def independent_pixels(grey: AnyArray, xy: FloatArray, template_px: int) -> FloatArray:
    """Return how many independent pixels are worth as much as a template, whose neighbours are alike, (k,).

    Args:
        grey: photograph, one channel, (H, W).
        xy: centres of the templates, px, (k, 2); NaN is returned for those that reach outside or are flat.
        template_px: odd side of the templates.

    Source: Clifford, Richardson and Hemon (1989), Biometrics 45, pp. 123-134: 1 + n over the sum of the
    squared autocorrelations. Those estimated from one template have noise, which makes the number up to a
    half too small, and the test the more cautious, where neighbours are not alike at all.
    """
    wide = 2 * template_px  # of the transform, so that the template does not meet itself around the border
    out = np.full(len(xy), np.nan)
    for k, (x, y) in enumerate(template_corners(xy, template_px // 2, grey.shape).tolist()):
        if x < 0:
            continue
        d = grey[y : y + template_px, x : x + template_px].astype(float)
        d -= d.mean()
        if not d.any():
            continue
        rho = np.fft.irfft2(np.abs(np.fft.rfft2(d, (wide, wide))) ** 2, (wide, wide))
        out[k] = 1.0 + d.size / ((rho / rho[0, 0]) ** 2).sum()
    return out
