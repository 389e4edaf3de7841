"""Remarks on a plan, and the verdict on it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from sfm.adjustment.result import MOTIONS
from sfm.planning.plan import Plan
from sfm.planning.prediction import MIN_POINTS
from sfm.planning.wanted import MIN_RAYS
from sfm.remarks.remark import Remark, remark
from sfm.remarks.verdict import Level, Verdict, judge

HEADLINES: Mapping[Level, str] = {
    "good": "The photographs determine the network.",
    "fair": "The photographs determine the network, with remarks.",
    "bad": "The photographs do not determine the network.",
}
HEADLINES_OF_WANTED: Mapping[Level, str] = {
    "good": "The plan gives what is wanted.",
    "fair": "The plan determines the network, and does not give all that is wanted.",
    "bad": "The photographs do not determine the network.",
}
MIN_CODES = 5  # coded targets of a photograph, one more than orient it


def verdict_of_plan(plan: Plan) -> Verdict:
    """Return the verdict on a plan with what limits it."""
    return judge(_remarks(plan), HEADLINES_OF_WANTED if plan.wanted.anything else HEADLINES)


def _remarks(plan: Plan) -> Iterator[Remark]:
    p = plan.prediction
    unknown = p.adjustment.undetermined
    if unknown:
        yield remark("plan_undetermined", unknown=unknown[:1], more=len(unknown) - 1 or None)
        for group in plan.groups[1:]:
            yield remark("plan_not_connected", photographs=group, others=plan.groups[0], needed=MIN_POINTS)
    if not p.determined.all():
        lost = [name for name, known in zip(p.planned.names, p.determined, strict=True) if not known]
        yield remark("plan_points_undetermined", lost=len(lost), total=len(p.planned.names), points=lost)
    if plan.wanted.anything and plan.shortfall > 1:
        yield remark("plan_short_of_wanted", times=plan.shortfall)
    few = int((p.rays < MIN_RAYS).sum())
    if few:
        yield remark("plan_points_with_few_rays", few=few, needed=MIN_RAYS)
    bad = [c for c in plan.calibrations if not c.good]
    if bad:
        reasons = tuple(dict.fromkeys(reason for c in bad for reason in c.reasons))
        reasons = reasons or ("too few image points over the photograph",)
        yield remark("plan_does_not_calibrate", reasons=reasons)
    if plan.unusable:
        yield remark("plan_photographs_apart", photographs=plan.unusable, needed=MIN_POINTS)
    if plan.design is not None and plan.design.limit:
        yield remark("plan_limited", limit=plan.design.limit)
    if p.adjustment.expected_defect == MOTIONS:
        yield remark("plan_without_scale")
    if p.planned.mesh is None:
        yield remark("plan_without_surface")
    uncoded = [s.station for s in plan.shots if s.coded < MIN_CODES]
    if uncoded:
        yield remark("plan_few_codes", photographs=uncoded, needed=MIN_CODES)
    if np.isnan(p.planned.normals).any():
        yield remark("plan_without_normals")
    if plan.seeing.sigma_px is None:
        yield remark("plan_sigma_of_targets")
    if plan.seeing.depth is None:
        yield remark("plan_without_depth_of_field")
