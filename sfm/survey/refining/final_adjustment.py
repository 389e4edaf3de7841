"""The last adjustment of a refined model, where its targets bring control and scale bars."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.quality.variance_components import estimate_components
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.conventions import FloatArray
from sfm.network import Estimate, Network
from sfm.remarks.remark import Remark, remark
from sfm.survey.adjusting.datum_definition import CONTRADICTED, find_contradiction, lost_share
from sfm.survey.adjusting.settling import FALSE_ALARM, MANY_ITERATIONS, MAX_ITERATIONS

GROUPS = ("key points", "targets")


def adjust_finally(
    part: Network, start: Estimate, datum: Datum, *, matched: int, unit: str
) -> tuple[Adjustment, tuple[Remark, ...]]:
    """Return the last adjustment with its covariance, and what of control and bars was taken out.

    Where control or scale bars take part, key points and targets are weighted by their own variance
    components, so that these keep the standard deviations that were stated for them. Control or a bar that
    the photographs contradict is taken out.

    Args:
        part: accepted image points, with control and scale bars.
        start: its solution in a free datum, near that of the control.
        datum: how position, attitude and scale are decided.
        matched: points before the targets.
        unit: object unit.
    """
    alpha = 1 - (1 - FALSE_ALARM) ** (1 / (2 * len(part.image_points)))

    def tested(
        network: Network,
        factor: float | FloatArray,
        *,
        reject: str,
        covariance: bool = True,
        max_iterations: int = MAX_ITERATIONS,
    ) -> Adjustment:
        return adjust(
            network,
            start,
            datum=datum,
            reject=reject,
            alpha=alpha,
            image_sigma_factor=factor,
            covariance=covariance,
            max_iterations=max_iterations,
        )

    def untested(network: Network) -> Adjustment:
        # tension that something wrong causes takes many steps to go
        return tested(network, 1.0, reject="none", covariance=False, max_iterations=MANY_ITERATIONS)

    if not (len(part.scale_bars) or datum.kind == "control"):
        return tested(part, 1.0, reject="tau"), ()
    remarks: list[Remark] = []
    reject = "tau"
    while True:
        checked = tested(part, 1.0, reject=reject)
        found = find_contradiction(part, checked, untested, unit=unit) if reject == "tau" else None
        if found is None:
            break
        remarks.append(found.found)
        if found.freed is None:
            reject = "none"
        else:
            part = found.freed
    lost = np.flatnonzero(lost_share(checked) > CONTRADICTED)
    held = (part.control.point,) if datum.kind == "control" else ()
    against = np.intersect1d(lost, np.concatenate([*held, part.scale_bars.start, part.scale_bars.end]))
    if len(against):
        remarks.append(remark("given_points_rejected", points=[part.points[j] for j in against]))
    good = replace(part, image_points=part.image_points.select(~checked.rejected))
    group = np.asarray(good.image_points.point >= matched, dtype=np.int64)
    _, factor, settled = estimate_components(
        lambda factor: tested(good, factor, reject="none"), group, GROUPS
    )
    if not settled:
        remarks.append(remark("weights_not_converged", groups="key points and targets"))
    weights = factor[np.asarray(part.image_points.point >= matched, dtype=np.int64)]
    return tested(part, weights, reject=reject), tuple(remarks)
