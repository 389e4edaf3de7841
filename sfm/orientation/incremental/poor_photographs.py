"""Photographs that fit worse than the others, and other solutions for a flat object.

**Mirrored photographs.** A mirrored photograph of an object with little depth gets a wrong position, behind
or beside the object. Most of its image points fit a wide tolerance there. Near-duplicates of it are distorted
with it. Once the other photographs are adjusted without it, it fits them when it is turned over, as well as
they fit each other.

**Reversed depth.** A flat object photographed at moderate angles looks almost the same with its depth
reversed. A start tolerance of tens of pixels hardly separates the two solutions, for all photographs or for
some. An adjustment then ends in the nearest minimum. The reversal in depth of a first solution shows
whether the solution is in doubt. With strong rays the reversal fits a hundred times worse, or not at all. A
solution in doubt is also sought from smaller start tolerances, and the one with the smallest residuals is
kept.

Source: Szeliski and Kang (1997), IEEE PAMI 19(5) (reversal of depth); Rousseeuw and Leroy (1987), Robust
Regression and Outlier Detection, sec. 1.2 (bounded residuals).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix

from sfm.model.camera import tangents_from_pixel
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.estimate import Estimate
from sfm.model.network import Network, rows_of
from sfm.model.remarks.remark import remark
from sfm.model.similarity import reverse_depth
from sfm.orientation.incremental.growth import Growth, Refine

DOUBTFUL = 30.0  # multiple of the median residual of a solution below which its reversal casts doubt on it
SMALLER_TOLERANCES = (1 / 3, 1 / 10)  # shares of the first start tolerance, for a solution in doubt
FAR_WORSE = 3.0  # multiple of the median residual from which a photograph may not belong to the others
CONTRADICTING, MIRRORED = remark("photograph_contradicting"), "photograph_mirrored"
BOUND = 6.0  # multiple of the median residual of the best solution to which residuals are limited
MIN_OTHERS = 3  # oriented photographs needed to judge another one
WORSE = 1.5  # multiple of the typical median residual from which a photograph is tested turned over
FAR_BETTER = 8.0  # ratio of residuals before and after turning: 20 to 80 if mirrored, 2 with four points


def judge_misfits(growth: Growth, refine: Refine | None) -> bool:
    """Remove mirrored photographs, and reinstate fitting photographs that a rival solution left out.

    Args:
        growth: settled network; it changes if a photograph is removed or reinstated.
        refine: the caller's adjustment, used for the other photographs.

    Returns:
        Whether a photograph was removed or reinstated, so that the network must settle again.
    """
    changed = False
    for i, reason in list(growth.reasons.items()):
        if not _is_mirrored(growth, i) and reason == CONTRADICTING and growth.resect([i]):
            growth.dropped[i], changed = False, True
    looked_at = ~growth.estimate.oriented
    while growth.estimate.oriented.sum() > MIN_OTHERS:
        medians = _medians_px(growth)
        if not np.isfinite(medians).any():
            break
        waiting = np.where(looked_at | ~(medians > WORSE * np.nanmedian(medians)), -np.inf, medians)
        i = int(np.argmax(waiting))
        if not np.isfinite(waiting[i]):
            break
        looked_at[i] = True
        if _fit_resected(growth, i, turned_over=True).median_px < medians[i]:
            with_it = growth.estimate
            growth.release(np.array([i]))
            growth.adjust(refine)
            if _is_mirrored(growth, i):
                growth.dropped[i], changed = True, True
            else:
                growth.estimate = with_it
    return changed


def reinstate_dropped(growth: Growth) -> bool:
    """Resect the dropped photographs again in the settled network; return whether any fits.

    A photograph may be dropped before its neighbours, the points beside it or the interior orientation are
    known well. Settling again drops it again if the others do not support it.
    """
    mirrored = [i for i, reason in growth.reasons.items() if reason.kind == MIRRORED]
    dropped = np.setdiff1d(np.flatnonzero(growth.dropped), mirrored).tolist()
    reasons = dict(growth.reasons)
    returned = [i for i in dropped if growth.resect([i])]
    growth.reasons = {i: reason for i, reason in reasons.items() if i not in returned}
    growth.dropped[returned] = False
    return bool(returned)


def _is_mirrored(growth: Growth, i: int) -> bool:
    """Return whether a photograph fits the others far better turned over; if so, record it as the reason.

    At least as many of its image points must fit turned over. Image points of a plane alone also fit turned
    over, as if seen from behind.
    """
    as_it_is, turned = _fit_resected(growth, i), _fit_resected(growth, i, turned_over=True)
    before, after = as_it_is.median_px, turned.median_px
    others = np.delete(_medians_px(growth), i)
    mirrored = FAR_BETTER * after < before and bool(after < FAR_BETTER * np.nanmedian(others))
    mirrored &= turned.fitting >= as_it_is.fitting
    if mirrored:
        stated = (before, "px") if np.isfinite(before) else None
        growth.reasons[i] = remark(MIRRORED, before=stated, turned=(after, "px"))
    return mirrored


class _ResectionFit(NamedTuple):
    """Fit of a photograph to the present points."""

    median_px: float  # median residual, infinite if it cannot be resected
    fitting: int  # number of image points within the tolerance


def _fit_resected(growth: Growth, i: int, *, turned_over: bool = False) -> _ResectionFit:
    """Return the fit of a photograph after resection on the present points.

    Args:
        growth: network with points and interior orientation.
        i: index of the photograph.
        turned_over: whether to exchange left and right of its image points.
    """
    seen, camera = growth.network.image_points, growth.estimate.cameras[growth.network.camera[i]]
    rows = np.flatnonzero((seen.image == i) & growth.estimate.determined[seen.point])
    xy = seen.xy[rows]
    uv = tangents_from_pixel(camera, (camera.size_px[0] - 1, 0) + xy * (-1, 1) if turned_over else xy)
    known = np.isfinite(uv).all(axis=1)
    resected = growth.resection(i, rows[known], uv[known])
    if not resected.found:
        return _ResectionFit(np.inf, 0)
    lengths = np.linalg.norm(resected.residuals, axis=1) * camera.c_px
    median = float(np.median(np.where(np.isnan(lengths), np.inf, lengths)))
    return _ResectionFit(median, int(resected.inliers.sum()))


def _medians_px(growth: Growth) -> FloatArray:
    """Return the median residual of every photograph, NaN where undetermined, px, (m,)."""
    residuals = growth.residuals_px()
    known = np.isfinite(residuals)
    rows = rows_of(growth.network.image_points.image, len(growth.network.images))
    return np.array([np.median(residuals[r][known[r]]) if known[r].any() else np.nan for r in rows])


def bounded_costs(residuals_px: Sequence[FloatArray], image: IntArray) -> FloatArray:
    """Return the mean logarithm of the median residual of the photographs, for each of several solutions.

    Each photograph has one vote, limited to BOUND times the median of the best solution. An undetermined
    photograph counts as much as a contradicting one, so a solution does not improve by leaving photographs
    out. And a single wrong photograph cannot win by distorting all others a little.

    Args:
        residuals_px: lengths of all image residuals in each solution, inf where undetermined, px, (k,) each.
        image: photograph of each image point, (k,).
    """
    of_photograph = [rows for rows in rows_of(image, int(image.max(initial=-1)) + 1) if len(rows)]
    medians = np.array(
        [[float(np.median(solution_px[rows])) for rows in of_photograph] for solution_px in residuals_px]
    )
    known = np.where(np.isfinite(medians), medians, np.nan)
    most = np.isfinite(medians).mean(axis=1)
    typical = [
        float(np.nanmedian(medians_px)) for medians_px, share in zip(known, most, strict=True) if share > 0.5
    ]
    least = max(min(typical, default=1.0), float(np.finfo(float).tiny))
    return np.asarray(np.log(np.clip(medians / least, 1 / BOUND, BOUND)).mean(axis=1))


def reversed_growth(growth: Growth, empty: Growth, refine: Refine, without: BoolArray) -> Growth:
    """Return a network reversed in depth and adjusted, without photographs that may have reversed it.

    Args:
        growth: the network.
        empty: the same network before its start, which receives the reversal.
        refine: the caller's adjustment.
        without: photographs that take no part, (m,).
    """
    turned = reverse_depth(growth.estimate)
    empty.estimate = replace(turned, position=np.where(without[:, None], np.nan, turned.position))
    empty.fixed, empty.tolerance_px = growth.fixed.copy(), growth.tolerance_px.copy()
    empty.dropped, empty.reasons = growth.dropped | without, dict(growth.reasons)
    for i in np.flatnonzero(without).tolist():
        empty.reasons[i] = CONTRADICTING
    empty.adjust(refine, everything=True)
    return empty


def best_connected(network: Network, estimate: Estimate, most: int) -> BoolArray:
    """Return a part of the oriented photographs, (m,): each has most points in common with those before.

    Args:
        network: network of m photographs.
        estimate: its orientation.
        most: number of photographs; all oriented ones if there are fewer.
    """
    if estimate.oriented.sum() <= most:
        return estimate.oriented
    seen = network.image_points
    seen = seen.select(estimate.oriented[seen.image] & estimate.determined[seen.point])
    shape = len(network.images), len(network.points)
    shows = csr_matrix((np.ones(len(seen)), (seen.image, seen.point)), shape)
    common, chosen = np.bincount(seen.image, minlength=shape[0]).astype(float), np.zeros(shape[0], dtype=bool)
    covered = np.zeros(shape[1])
    for _ in range(most):
        best = int(np.argmax(np.where(estimate.oriented & ~chosen, common, -1.0)))
        chosen[best] = True
        covered[shows.indices[shows.indptr[best] : shows.indptr[best + 1]]] = 1.0
        common = shows @ covered
    return chosen


def worst_photographs(residuals_px: FloatArray, image: IntArray, m: int) -> BoolArray:
    """Return which oriented photographs fit far worse than the others and may have reversed them, (m,).

    Args:
        residuals_px: lengths of the image residuals, inf where undetermined, px, (k,).
        image: photograph of each image point, (k,).
        m: number of photographs.
    """
    known = np.isfinite(residuals_px)
    rows = rows_of(image, m)
    median = np.array([np.median(residuals_px[r][known[r]]) if known[r].any() else np.nan for r in rows])
    return np.asarray(median > FAR_WORSE * np.nanmedian(median))


def casts_doubt(growth: Growth, reversal: Growth) -> bool:
    """Return whether the reversal of a solution in depth fits so well that either may be the true solution.

    A reversal that the adjustment has turned back shows no other solution, but the way to the first one.

    Args:
        growth: network with the solution.
        reversal: its adjusted reversal.
    """
    first_px, reversed_px = growth.residuals_px(), reversal.residuals_px()
    known = np.isfinite(first_px) & np.isfinite(reversed_px)
    if not known.any() or not np.median(reversed_px[known]) < DOUBTFUL * np.median(first_px[known]):
        return False
    seen = growth.network.image_points.select(known)
    first, other = (
        np.log(np.linalg.norm(estimate.points[seen.point] - estimate.position[seen.image], axis=1))
        for estimate in (growth.estimate, reversal.estimate)
    )
    for rows in rows_of(seen.image, len(growth.network.images)):
        if len(rows):
            first[rows] -= first[rows].mean()
    return not float(first @ other) > 0
