"""Given start values of a network: completed and adjusted as they are, judged afterwards.

A photograph is oriented anew only where most of its image points do not fit the others after the adjustment;
where most photographs do not, the given values are wrong, and the caller starts without them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.conventions import IntArray
from sfm.network import Estimate
from sfm.orientation.incremental.growth import MIN_SHARE, Growth, Refine, residual_lengths
from sfm.remarks.remark import Remark, remark

MAX_COMPLETIONS = 50  # rounds of resection and intersection of what no values were given for
KEPT_SHARE = 0.5  # of the photographs must fit, each with most of its image points, for given values to stay
KEPT_TOLERANCE = 2.0  # times the final tolerance, that the residuals from given values may need
ROUNDS = 3  # of adjustment, while image points come or go


@dataclass(frozen=True)
class GivenStart:
    """Given values that stay, with what was oriented and intersected beside them."""

    estimate: Estimate  # before the adjustment that judges them
    replaced: tuple[Remark, ...]  # given orientations of single photographs that did not fit


def start_from_given(growth: Growth, refine: Refine | None, final_tolerance_px: float) -> GivenStart | None:
    """Complete given values and adjust them; None where they do not fit the image points.

    Args:
        growth: begun with given values; contains the adjusted network afterwards.
        refine: the caller's adjustment.
        final_tolerance_px: below this no image point is put aside, px.
    """
    control = growth.network.control.complete
    held = control.point[growth.fixed[control.point]]
    _complete(growth)
    start = growth.estimate
    if start.oriented.sum() < 2:
        return None
    rough = bool(np.median(growth.share_fitting()[start.oriented]) < KEPT_SHARE)
    replaced: tuple[Remark, ...] = ()
    for _ in range(ROUNDS):
        changed = growth.refined(refine, everything=rough)
        growth.adapt_tolerance(final_tolerance_px)
        if not replaced:
            replaced = _replace_misfits(growth)
        growth.intersect(only_missing=True)
        if not changed and not replaced:
            break
        rough = False
    fitting = growth.share_fitting()[growth.estimate.oriented] >= KEPT_SHARE
    if fitting.mean() <= KEPT_SHARE or (growth.tolerance_px > KEPT_TOLERANCE * final_tolerance_px).any():
        return None
    return GivenStart(start, replaced) if _near_control(growth, start, held) else None


def _complete(growth: Growth) -> None:
    """Orient and intersect what no values were given for; what was given stays as it is."""
    for _ in range(MAX_COMPLETIONS):
        growth.intersect(only_missing=True)
        if not growth.resect_next():
            break


def _replace_misfits(growth: Growth) -> tuple[Remark, ...]:
    """Resect the photographs most of whose image points do not fit; return what was replaced."""
    before = growth.share_fitting()
    wrong = np.flatnonzero(growth.estimate.oriented & (before < MIN_SHARE)).tolist()
    if not wrong:
        return ()
    growth.resect(wrong)
    after = growth.share_fitting()
    count = np.bincount(growth.network.image_points.image, minlength=len(after))
    return tuple(
        remark(
            "orientation_replaced",
            photograph=growth.network.images[i],
            before=round(before[i] * count[i]),
            after=round(after[i] * count[i]),
            image_points=int(count[i]),
        )
        for i in wrong
        if after[i] >= MIN_SHARE
    )


def _near_control(growth: Growth, start: Estimate, held: IntArray) -> bool:
    """Return whether most rays of control that is held to its coordinates meet it from the given stations."""
    seen = growth.network.image_points
    rows = np.isin(seen.point, held) & start.oriented[seen.image]
    if not rows.any():
        return True
    limit = growth.start_tolerance_px[growth.network.camera[seen.image]]
    lengths = residual_lengths(
        growth.network, Estimate(growth.estimate.cameras, start.position, start.rotation, start.points)
    )
    return bool((lengths <= limit)[rows].mean() >= KEPT_SHARE)
