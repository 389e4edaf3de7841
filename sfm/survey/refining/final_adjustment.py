"""The last adjustment of a refined model, where its targets bring control and scale bars."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.quality.reliability import FALSE_ALARM, level_of_single
from sfm.adjustment.quality.variance_components import estimate_components
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.conventions import FloatArray
from sfm.network import Estimate, Network, without_given
from sfm.remarks.remark import Remark, remark
from sfm.survey.adjusting.settling import MANY_ITERATIONS, MAX_ITERATIONS
from sfm.survey.hypotheses.given import judge_given

GROUPS = ("key points", "targets")


def adjust_finally(
    part: Network, start: Estimate, datum: Datum, *, matched: int, unit: str
) -> tuple[Adjustment, tuple[Remark, ...]]:
    """Return the last adjustment with its covariance, and what of control and bars was left out.

    Where control or scale bars take part, key points and targets are weighted by their own variance
    components, so that these keep the standard deviations that were stated for them. Control or a bar that
    the key points and targets contradict is left out.

    Args:
        part: accepted image points, with control and scale bars.
        start: its solution in a free datum, near that of the control.
        datum: how position, attitude and scale are decided.
        matched: points before the targets.
        unit: object unit.
    """
    alpha = level_of_single(FALSE_ALARM, 2 * len(part.image_points))

    def tested(network: Network, factor: float | FloatArray, *, reject: str) -> Adjustment:
        return adjust(
            network,
            start,
            datum=datum,
            reject=reject,
            alpha=alpha,
            image_sigma_factor=factor,
            max_iterations=MAX_ITERATIONS,
        )

    if not (len(part.scale_bars) or datum.kind == "control"):
        return tested(part, 1.0, reject="tau"), ()
    free = adjust(
        without_given(part),
        start,
        reject="tau",
        alpha=alpha,
        covariance=False,
        max_iterations=MANY_ITERATIONS,
    )
    given = judge_given(part, free, datum, unit=unit)
    part, datum = given.network, given.datum
    remarks = list(given.remarks)
    if given.placing is not None and datum.kind == "control":
        start = given.placing.apply_estimate(free.estimate)
    checked = tested(part, 1.0, reject="tau")
    good = replace(part, image_points=part.image_points.select(~checked.rejected))
    group = np.asarray(good.image_points.point >= matched, dtype=np.int64)
    _, factor, settled = estimate_components(
        lambda factor: tested(good, factor, reject="none"), group, GROUPS
    )
    if not settled:
        remarks.append(remark("weights_not_converged", groups=GROUPS))
    weights = factor[np.asarray(part.image_points.point >= matched, dtype=np.int64)]
    return tested(part, weights, reject="tau"), tuple(remarks)
