"""Photographs that fit worse than the others: mirrored ones leave, less precise ones stay.

On an object with little depth a mirrored picture finds a place behind it or at its side where most of its
image points fit a wide tolerance, and near-duplicates of it bend with it. Turned over it fits the others as
they fit each other, once these are adjusted without it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sfm.camera import tangents_from_pixel
from sfm.conventions import FloatArray
from sfm.network import rows_of
from sfm.orientation.incremental.growth import Growth, Refine
from sfm.orientation.incremental.other_solutions import CONTRADICTING
from sfm.remarks.remark import remark

MIN_OTHERS = 3  # oriented photographs that one is judged by
WORSE = 1.5  # times the typical median residual of a photograph, from which on it is looked at turned over
FAR_BETTER = 8.0  # times smaller residuals, turned over: 20 to 80 of mirrored pictures, 2 of four points


def judge_misfits(growth: Growth, refine: Refine | None) -> bool:
    """Name and take out mirrored photographs, and take back what a rival solution left out though it fits.

    Args:
        growth: settled; changed where a photograph comes or goes.
        refine: the caller's adjustment, of the others alone.

    Returns:
        Whether a photograph came or went, so that the network is to be settled anew.
    """
    changed = False
    for i, reason in list(growth.reasons.items()):
        if not _is_mirrored(growth, i) and reason.kind == CONTRADICTING and growth.resect([i]):
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
        if _resected(growth, i, turned_over=True).median_px < medians[i]:
            with_it = growth.estimate
            growth.release(np.array([i]))
            growth.refined(refine)
            if _is_mirrored(growth, i):
                growth.dropped[i], changed = True, True
            else:
                growth.estimate = with_it
    return changed


def _is_mirrored(growth: Growth, i: int) -> bool:
    """Return whether a photograph fits the others far better turned over, and give that as its reason.

    No fewer of its image points do so: those on a plane alone fit turned over as well, seen from behind.
    """
    as_it_is, turned = _resected(growth, i), _resected(growth, i, turned_over=True)
    before, after = as_it_is.median_px, turned.median_px
    others = np.delete(_medians_px(growth), i)
    mirrored = FAR_BETTER * after < before and bool(after < FAR_BETTER * np.nanmedian(others))
    mirrored &= turned.fitting >= as_it_is.fitting
    if mirrored:
        stated = (before, "px") if np.isfinite(before) else None
        growth.reasons[i] = remark("photograph_mirrored", before=stated, turned=(after, "px"))
    return mirrored


class _Resected(NamedTuple):
    """How a photograph fits the present points."""

    median_px: float  # residual, infinite where it is not resected
    fitting: int  # image points within the tolerance


def _resected(growth: Growth, i: int, *, turned_over: bool = False) -> _Resected:
    """Return how a photograph fits the present points, resected on them.

    Args:
        growth: gives points and interior orientation.
        i: the photograph.
        turned_over: whether left and right of its image points are exchanged.
    """
    seen, camera = growth.network.image_points, growth.estimate.cameras[growth.network.camera[i]]
    rows = np.flatnonzero((seen.image == i) & growth.estimate.determined[seen.point])
    xy = seen.xy[rows]
    uv = tangents_from_pixel(camera, (camera.size_px[0] - 1, 0) + xy * (-1, 1) if turned_over else xy)
    known = np.isfinite(uv).all(axis=1)
    found = growth.resection(i, rows[known], uv[known])
    if not found.found:
        return _Resected(np.inf, 0)
    lengths = np.linalg.norm(found.residuals, axis=1) * camera.c_px
    median = float(np.median(np.where(np.isnan(lengths), np.inf, lengths)))
    return _Resected(median, int(found.inliers.sum()))


def _medians_px(growth: Growth) -> FloatArray:
    """Return the median residual of every photograph, NaN where it has none, px, (m,)."""
    residuals = growth.residuals_px()
    known = np.isfinite(residuals)
    rows = rows_of(growth.network.image_points.image, len(growth.network.images))
    return np.array([np.median(residuals[r][known[r]]) if known[r].any() else np.nan for r in rows])
