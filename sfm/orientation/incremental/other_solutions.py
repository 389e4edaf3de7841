"""Solutions that a network could have in place of the first one found, and which of them fits best.

A flat object photographed at moderate angles is almost the same as itself turned inside out in depth; a start
tolerance of some tens of pixels hardly separates the two, for all photographs or for a part of them, and
an adjustment ends in the minimum that it starts nearest to. The reversal in depth of a first solution shows
whether it is in doubt: where the rays are strong the reversal fits a hundred times worse or not at all. A
solution in doubt is followed from smaller start tolerances too, and the one with the smallest residuals is
kept.

Source: Szeliski and Kang (1997), IEEE PAMI 19(5) (reversal of depth); Rousseeuw and Leroy (1987), Robust
Regression and Outlier Detection, sec. 1.2 (bounded residuals).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.depth_reversal import reverse_depth
from sfm.network import rows_of
from sfm.orientation.incremental.growth import Growth, Refine
from sfm.remarks.remark import remark

DOUBTFUL = 30.0  # times the RMS residual of a solution, below which its reversal casts doubt on it
SMALLER_TOLERANCES = (
    1 / 3,
    1 / 10,
)  # of the first start tolerance, from which a solution in doubt is followed
FAR_WORSE = 3.0  # times the median residual of all photographs, of one that may not belong to them
CONTRADICTING = "photograph_against_the_others"
BOUND = 6.0  # times the median residual of the best solution: what lies farther off counts as that


def bounded_costs(residuals_px: Sequence[FloatArray], image: IntArray) -> FloatArray:
    """Return the mean logarithm of the median residual of the photographs in several solutions.

    Photographs have a vote each, bounded at BOUND times the median of the best solution: what a solution does
    not determine counts as much as what contradicts it, so that none is better for leaving photographs out,
    and one photograph that does not belong cannot bend all others a little to fit itself.

    Args:
        residuals_px: of each solution the lengths of all image residuals, inf where undetermined, px, (k,).
        image: photograph of each image point, (k,).
    """
    of_photograph = [rows for rows in rows_of(image, int(image.max(initial=-1)) + 1) if len(rows)]
    medians = np.array([[float(np.median(one[rows])) for rows in of_photograph] for one in residuals_px])
    known = np.where(np.isfinite(medians), medians, np.nan)
    most = np.isfinite(medians).mean(axis=1)
    typical = [float(np.nanmedian(one)) for one, share in zip(known, most, strict=True) if share > 0.5]
    least = max(min(typical, default=1.0), float(np.finfo(float).tiny))
    return np.asarray(np.log(np.clip(medians / least, 1 / BOUND, BOUND)).mean(axis=1))


def reversed_growth(growth: Growth, empty: Growth, refine: Refine, without: BoolArray) -> Growth:
    """Return a network reversed in depth and adjusted, without the photographs that may have turned it over.

    Args:
        growth: the network.
        empty: the same network before its start, which takes the reversal over.
        refine: the caller's adjustment.
        without: photographs that take no part, (m,).
    """
    turned = reverse_depth(growth.estimate)
    empty.estimate = replace(turned, position=np.where(without[:, None], np.nan, turned.position))
    empty.fixed, empty.tolerance_px = growth.fixed.copy(), growth.tolerance_px.copy()
    empty.dropped, empty.reasons = growth.dropped | without, dict(growth.reasons)
    for i in np.flatnonzero(without).tolist():
        empty.reasons[i] = remark(CONTRADICTING)
    empty.refined(refine, everything=True)
    return empty


def worst_photographs(residuals_px: FloatArray, image: IntArray, m: int) -> BoolArray:
    """Return which oriented photographs fit far worse than the others: these may have turned all over, (m,).

    Args:
        residuals_px: lengths of the image residuals, inf where undetermined, px, (k,).
        image: photograph of each image point, (k,).
        m: number of photographs.
    """
    known = np.isfinite(residuals_px)
    rows = rows_of(image, m)
    median = np.array([np.median(residuals_px[r][known[r]]) if known[r].any() else np.nan for r in rows])
    return np.asarray(median > FAR_WORSE * np.nanmedian(median))


def casts_doubt(first_px: FloatArray, reversed_px: FloatArray) -> bool:
    """Return whether the reversal of a solution in depth fits well enough for either to be the true one.

    Args:
        first_px: lengths of the image residuals, inf where undetermined, px, (k,).
        reversed_px: the same of its reversal, adjusted.
    """
    both = np.isfinite(first_px) & np.isfinite(reversed_px)
    if not both.any():
        return False
    return bool(np.median(reversed_px[both]) < DOUBTFUL * np.median(first_px[both]))
