"""Verdict: judges the result of a survey or of an adjustment by all that its image points show.

`judge_survey` adds the verdict to what the stages of a survey found, and `judge_adjustment` to an adjustment
without a survey around it. Both ask the same questions of the adjustment: convergence, rank, residuals that
were rejected or remain, rays, and consistency.

Given values are judged by the image points alone before they take part. The tests here judge those that took
part, and those that only check the result. They do not test given interior orientation. Whether it is wrong
is decided by an alternative hypothesis (`sfm.judgement.hypotheses`), which states the shift of object
points.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from sfm.adjustment.engine.unknowns import NO_START
from sfm.adjustment.quality.consistency import Consistency, consistency_of
from sfm.adjustment.quality.statistics import component_tests, more_than_chance, robust_test
from sfm.adjustment.quality.variance_components import IMAGE_POINTS, INTERIOR
from sfm.adjustment.result import Adjustment
from sfm.judgement.bundle_statistics import Given, Statistics, given_of, statistics_of
from sfm.judgement.calibrated_cameras import calibrated_cameras, interior_of
from sfm.judgement.cameras import camera_remarks, edges_of, sharpness_remarks
from sfm.judgement.checks import (
    ControlCoordinate,
    LongestResidual,
    Sigma0,
    check_coordinates,
    longest_residual,
    sigma0_of,
)
from sfm.judgement.stated_precision import stated_precision_remarks
from sfm.judgement.survey_result import SurveyResult
from sfm.model.conventions import METRES, BoolArray
from sfm.model.display import counted, program_name
from sfm.model.distributions import binomial_sf, normal_ppf
from sfm.model.network import rows_of
from sfm.model.observation_residuals import GivenResiduals, GivenValue
from sfm.model.remarks.remark import Remark, remark, unless_note
from sfm.model.remarks.row import Grade
from sfm.model.remarks.verdict import Level, Verdict, judge

MM = 1e-3  # m
JUDGED_AS = {"control points": "control", "exterior orientation": "centres", "scale bars": "scale"}
# Below this redundancy number, the rest of a value's error is smaller than rounding and the neglected second
# order of other errors, and w magnifies those.
MIN_REDUNDANCY = 1e-3
MAX_MAGNIFICATION = 1.0  # median image distance c over object distance; beyond it is macrophotography
HEADLINES: Mapping[Level, str] = {
    "good": "The {what} worked: {found}.",
    "fair": "The {what} worked, with remarks: {found}.",
    "bad": "The {what} has no dependable result.",
}


def judge_survey(result: SurveyResult) -> SurveyResult:
    """Return the result of a survey with its verdict; an earlier verdict is replaced."""
    a = result.adjustment
    statistics, consistency = statistics_of(a), consistency_of(a)
    of_sigma0 = sigma0_remarks(sigma0_of(a), a)
    of_stages = result.stage_remarks
    if not any(said.kind == "sigma0_high" for said in of_sigma0):  # by a cause, whatever it shifts
        of_stages = slight_as_tests(of_stages)
    stated = () if result.photographs else stated_precision_remarks(a)  # only given image points state theirs
    remarks = (
        *convergence_remarks(a),
        *photograph_remarks(result),
        *of_stages,
        *other_solution_remarks(result),
        *of_sigma0,
        *residual_remarks(longest_residual(a)),
        *gross_error_remarks(a, rejects=result.reject != "none"),
        *ray_remarks(a),
        *consistency_remarks(consistency, int(a.rejected.sum()), automatic=a.network.automatic_points),
        *stated,
        *sharpness_remarks(result, edges_of(result.photographs), consistency),
        *camera_remarks(result, calibrated_cameras(result, interior_of(a))),
        *given_remarks(result, given_of(a, result.length_unit), statistics, check_coordinates(result)),
        *comparison_remarks(result),
    )
    photographs = f"{len(a.network.images)} of {result.images_total} photographs oriented"
    return replace(result, verdict=judge(remarks, _headlines("survey", a, photographs)))


def judge_adjustment(adjustment: Adjustment, *, rejects: bool = True) -> Adjustment:
    """Return the adjustment of a network, without a survey around it, with its verdict.

    The verdict, which replaces an earlier one, is computed when it is asked for. Photographs and points
    without start values take no part; such photographs are missing.

    Args:
        adjustment: adjustment of a network.
        rejects: whether gross errors were rejected or weighted down.
    """
    return replace(adjustment, judge=partial(_verdict_of_adjustment, rejects=rejects))


def _verdict_of_adjustment(a: Adjustment, *, rejects: bool) -> Verdict:
    """Return the verdict on an adjustment, see `judge_adjustment`."""
    total, oriented = len(a.network.images), int(a.estimate.oriented.sum())
    missing, of_missing = total - oriented, list[Remark]()
    if missing:
        of_missing = [remark("photographs_missing", missing=missing, total=total, share=missing / total)]
    remarks = (
        *convergence_remarks(a),
        *of_missing,
        *a.remarks,
        *sigma0_remarks(sigma0_of(a), a),
        *residual_remarks(longest_residual(a)),
        *gross_error_remarks(a, rejects=rejects),
        *ray_remarks(a),
        *consistency_remarks(consistency_of(a), int(a.rejected.sum())),
        *stated_precision_remarks(a),
    )
    photographs = f"{oriented} of {counted(total, 'photograph')}"
    return judge(remarks, _headlines("adjustment", a, photographs))


def slight_as_tests(remarks: Sequence[Remark]) -> tuple[Remark, ...]:
    """Return remarks with a test in place of each effect that shifts the result less than users expect."""

    def is_slight(effect: Remark) -> bool:
        grade = None if effect.test is not None else effect.row.severity
        return isinstance(grade, Grade) and grade.number == "shift" and effect.severity == "note"

    return tuple(
        remark("slight_effect", cause=effect.kind, shift=effect.number("shift"))
        if is_slight(effect)
        else effect
        for effect in remarks
    )


def with_remark(result: SurveyResult, new: Remark) -> SurveyResult:
    """Return a result with one more remark, judged again."""
    return judge_survey(replace(result, stage_remarks=(*result.stage_remarks, new)))


def _headlines(what: str, a: Adjustment, photographs: str) -> dict[Level, str]:
    """Return the headline of each level."""
    counts = f"{photographs}, {counted(int(a.estimate.determined.sum()), 'object point')}"
    return {level: text.format(what=what, found=counts) for level, text in HEADLINES.items()}


def _took_part(a: Adjustment) -> BoolArray:
    """Return which image points are of photographs and points with start values, (k,)."""
    seen = a.network.image_points
    return np.asarray(a.estimate.oriented[seen.image] & a.estimate.determined[seen.point])


def convergence_remarks(a: Adjustment) -> tuple[Remark, ...]:
    """Return remarks on convergence, on undetermined unknowns, and on the rejected part."""
    remarks = []
    if not a.converged:
        remarks.append(remark("not_converged", iterations=a.iterations))
    undetermined = [name for name in a.undetermined if not name.endswith(NO_START)]  # the others took no part
    without_start = len(undetermined) < len(a.undetermined)
    if undetermined or (a.defect != a.expected_defect and not without_start):
        remarks.append(
            remark(
                "rank_defect",
                defect=a.defect,
                expected=a.expected_defect,
                undetermined=undetermined or None,
            )
        )
    took_part = _took_part(a)
    rejected, total = int((a.rejected & took_part).sum()), int(took_part.sum())
    share = rejected / max(total, 1)
    remarks += unless_note(remark("image_points_rejected", rejected=rejected, total=total, share=share))
    return tuple(remarks)


def photograph_remarks(result: SurveyResult) -> tuple[Remark, ...]:
    """Return remarks on photographs that are not in the result, on unreadable files, and on copies."""
    copies = [photograph.image for photograph in result.failed if photograph.is_copy]
    unreadable = [photograph.image for photograph in result.failed if photograph.is_unreadable]
    total = result.images_total
    missing = total - len(result.adjustment.network.images)
    remarks: list[Remark] = []
    if missing:
        remarks.append(remark("photographs_missing", missing=missing, total=total, share=missing / total))
        remarks += _mirrored(result)
    if unreadable:
        remarks.append(remark("photographs_unreadable", photographs=unreadable))
    if copies:
        remarks.append(remark("copies", copies=copies))
    return tuple(remarks)


def _mirrored(result: SurveyResult) -> tuple[Remark, ...]:
    """Return why mirrored photographs are not in the result, once for those mirrored together.

    If nothing checks the handedness, only a much larger part shows that the other part is mirrored.
    """
    single = [photograph for photograph in result.failed if photograph.reason.kind == "photograph_mirrored"]
    groups = {
        photograph.reason.names("photographs"): photograph.reason
        for photograph in result.failed
        if photograph.reason.kind == "photograph_of_mirror_image"
    }
    right, mirrored = len(result.adjustment.network.images), len(single) + sum(map(len, groups))
    decided: dict[str, tuple[str, ...]] = {}
    unknown = not result.adjustment.network.named.any() or any(
        stage_remark.kind == "handedness_unchecked" for stage_remark in result.stage_remarks
    )
    if not unknown:
        decided = {"decided_by": ("known handedness",)}
    elif binomial_sf(right - 1, right + mirrored, 0.5) < result.adjustment.false_alarm:  # a sign test
        decided = {"decided_by": ("most photographs",)}
    of_single = [
        replace(photograph.reason, subjects={"photograph": (photograph.image,)}) for photograph in single
    ]
    of_groups = [replace(reason, subjects={**reason.subjects, **decided}) for reason in groups.values()]
    return tuple(of_single + of_groups)


def other_solution_remarks(result: SurveyResult) -> tuple[Remark, ...]:
    """Return the farthest other solution that the image points allow, and the farthest reversed in depth.

    A flat valley of c contains many solutions; those in between add nothing.
    """
    farthest_of: dict[bool, Remark] = {}
    for other in sorted(result.other_solutions, key=lambda solution: -solution.moved):
        of_camera = {"camera": other.camera, "c": (other.c, other.unit), "c_moved": other.c_moved or None}
        parts = {"reversed": "object"} if other.reflected else of_camera
        farthest = remark("other_solution", vPv=other.vPv, moved=other.moved, **parts)
        farthest_of.setdefault(other.reflected, farthest)
    return tuple(farthest_of.values())


def sigma0_remarks(sigma0: Sigma0, adjustment: Adjustment) -> tuple[Remark, ...]:
    """Return sigma0 as a test of the stated value, and the remark on a sigma0 that is far above it.

    The remark states errors that neighbours share.
    """
    parts, shared = {}, adjustment.error_correlation
    if shared is not None and shared.common > shared.alone * shared.design_effect:
        parts["common"] = (shared.sigmas_px(adjustment.sigma0_px)[1], "px")
        parts["length"] = (shared.length_px, "px")
    stated = (sigma0.stated_px, "px")
    tested = remark(
        "image_sigma_tested",
        tested=2 * int((~adjustment.rejected).sum()),
        stated=stated,
        found=(sigma0.image_points_px, "px"),
    )
    return (tested, *unless_note(remark("sigma0_high", ratio=sigma0.ratio, stated=stated, **parts)))


def residual_remarks(worst: LongestResidual) -> tuple[Remark, ...]:
    """Return the longest accepted residual where it is too long."""
    kept = remark(
        "residual_kept",
        point=worst.point,
        photograph=worst.image,
        length=(worst.length_px, "px"),
        over_sigma=worst.over_sigma,
    )
    return unless_note(kept) if np.isfinite(worst.over_sigma) else ()


def gross_error_remarks(a: Adjustment, *, rejects: bool) -> tuple[Remark, ...]:
    """Return the test of the accepted image coordinates; as a remark if nothing was rejected."""
    test = robust_test(a)
    numbers = {
        "beyond": test.beyond,
        "tested": test.tested,
        "critical": test.critical,
        "chance": test.expected,
    }
    tested = (remark("gross_errors_tested", **numbers),) if test.tested else ()
    return tested if rejects or not test.far_more else (*tested, remark("gross_errors_kept", **numbers))


def ray_remarks(a: Adjustment) -> tuple[Remark, ...]:
    """Return the points that lost more rays than by chance, and those with two rays, whose errors remain.

    Known coordinates check the rays of a point, however few there are.
    """
    network, rejected = a.network, a.rejected
    n, point = len(network.points), network.image_points.point
    took_part = _took_part(a)
    lost = np.bincount(point[rejected & took_part], minlength=n)
    rays = np.bincount(point[took_part], minlength=n)
    most = np.flatnonzero(more_than_chance(lost, rays, a.levels.family))
    by_rays = np.ones(n, dtype=bool)
    if a.datum == "control":
        by_rays[network.control.complete.point] = False
    two = int((by_rays & (rays - lost == 2)).sum())
    names = [network.points[j] for j in most] or None
    tested = remark("rays_tested", tested=int(took_part.sum()), more=len(most), points=names)
    return (tested, remark("third_ray_missing", two=two, total=n)) if two else (tested,)


def consistency_remarks(
    consistency: Consistency, rejected: int, *, automatic: frozenset[str] = frozenset()
) -> tuple[Remark, ...]:
    """Return the tests of points and photographs, and remarks on those that a person can correct.

    Automatic points are those that nobody named, such as those of natural texture, or can correct.
    """
    remarks = []
    doubtful = [point.point for point in consistency.doubtful]
    if consistency.tested:
        large = {"larger": len(consistency.large), "points": consistency.large or None}
        of_rejected = {"doubtful": len(doubtful), "points": doubtful or None}
        remarks += [
            remark("points_tested", tested=consistency.tested, **large),
            remark("doubtful_tested", tested=rejected, **of_rejected),
        ]
    if consistency.parts:
        remarks.append(
            remark("parts_tested", parts=consistency.parts, different=int(consistency.change is not None))
        )
    if consistency.change is not None:
        change = consistency.change
        differ = remark(
            "photographs_differ",
            first=change.first,
            next=change.next,
            count=change.points,
            times=change.times,
            shift=change.shift,
        )
        remarks += unless_note(differ)
    for kind, points in (
        ("points_doubtful", doubtful),
        ("points_with_large_residuals", consistency.outlying),
    ):
        correctable = [name for name in points if name not in automatic]
        if correctable:
            remarks.append(remark(kind, points=correctable))
    uneven = consistency.uneven
    if uneven is not None:
        remarks.append(
            remark(
                "photographs_uneven",
                photograph=uneven.worst,
                p=uneven.probability,
                ratio=uneven.largest / uneven.median,
            )
        )
    return tuple(remarks)


def comparison_remarks(result: SurveyResult) -> tuple[Remark, ...]:
    """Return remarks on whether the other adjuster agrees, and whether its camera fits better."""
    comparison = result.comparison
    if comparison is None:
        return ()
    program, better = program_name(comparison.backend), comparison.better
    remarks = []
    if comparison.outcome == "differs":
        remarks.append(remark("adjuster_differs", program=program))
    elif comparison.outcome == "fits alike":
        remarks.append(remark("adjuster_fits_alike", program=program, gap=comparison.gap))
    if better is not None:
        remarks.append(
            remark(
                "adjuster_fits_better",
                program=program,
                parameters=better.free,
                times=better.times,
                rms=(better.rms_px, "px"),
                before=(better.own_rms_px, "px"),
            )
        )
    return tuple(remarks)


def given_remarks(
    result: SurveyResult, given: Given, statistics: Statistics, checks: Sequence[ControlCoordinate]
) -> tuple[Remark, ...]:
    """Return the remarks on given values that took part or check the result.

    The checks are coordinates that took no part.
    """
    level = result.adjustment.levels.question
    tests = [
        remark(
            "given_tested",
            of=test.what,
            chi2=test.statistic,
            others=test.others,
            dof=test.dof,
            p=test.probability,
            judged=test.judged,
            given=test.given,
        )
        for test in result.given_tests
        if test.dof  # else nothing was tested
    ]
    return (
        *_differing(given, level),
        *_kinds(statistics, {test.what for test in result.given_tests}, level),
        *_checks(checks, result.length_unit, level),
        *_scale(result),
        *tests,
    )


def _kinds(statistics: Statistics, judged: set[str], level: float) -> tuple[Remark, ...]:
    """Return the remarks on kinds of given values with residuals that are too large by more than chance.

    Kinds that were judged against the free network already have a remark.
    """
    kinds = statistics.kinds
    level /= max(len(kinds.names) - 1, 1)
    return tuple(
        remark("given_sigmas", of=test.of, factor=float(kinds.sigma0[g]))
        for g, test in enumerate(component_tests(kinds, alpha=2 * level))
        if test.of not in (IMAGE_POINTS, INTERIOR)
        and JUDGED_AS.get(test.of) not in judged
        and kinds.count[g] > 1
        and test.statistic > test.upper
    )


def _differing(given: Given, level: float) -> Iterator[Remark]:
    """Yield the remark on the value with the largest w of each kind, if chance does not explain it.

    The shift is that of the adjusted value itself, |w| sqrt((1 - r) / r), for a coordinate or a length of the
    object. The orientation of a photograph is neither, so no shift is given for it.
    """
    for kind in (given.control, given.bars, *given.further):
        worst = _beyond_chance(kind, level) if kind else None
        if kind and worst:
            shift = abs(worst.w) * np.sqrt((1 - worst.r) / worst.r)
            yield remark("given_differs", shift=shift, harm=shift, **_parts(worst, kind))
    for kind in given.exterior:
        worst = _beyond_chance(kind, level)
        if worst:
            yield remark("given_differs", harm=0.0, **_parts(worst, kind))


def _beyond_chance(kind: GivenResiduals, level: float) -> GivenValue | None:
    """Return the value of a kind with the largest w, if w is larger than by chance."""
    tested = [value for value in kind.by_w if np.isfinite(value.w) and value.r >= MIN_REDUNDANCY]
    if not tested or not abs(tested[0].w) > -normal_ppf(level / (2 * len(tested))):
        return None
    return tested[0]


def _parts(value: GivenValue, kind: GivenResiduals) -> dict[str, str | float | tuple[float, str]]:
    """Return a value, its difference and its w in the form of a remark."""
    return {
        "given": f"{value.coordinate} of {kind.kind} {value.name}",
        "difference": (abs(value.difference), value.unit),
        "sigmas": abs(value.w),
    }


def _checks(checks: Sequence[ControlCoordinate], unit: str, level: float) -> tuple[Remark, ...]:
    """Return the remark on the coordinates that took no part and differ."""
    tested = [check for check in checks if np.isfinite(check.test)]
    critical = -normal_ppf(level / (2 * max(len(tested), 1)))
    beyond = [check for check in tested if abs(check.test) > critical]
    if not beyond:
        return ()
    points = {check.point for check in tested}
    differing = list(dict.fromkeys(check.point for check in beyond))
    coordinates = sorted({check.coordinate for check in beyond})
    farthest = max(abs(check.difference) for check in beyond)
    return (
        remark(
            "checks_differ",
            points=differing,
            coordinates=coordinates,
            count=len(differing),
            all=len(points),
            more=2 * len(differing) - len(points),
            distance=(farthest, unit),
            sigmas=max(abs(check.test) for check in beyond),
        ),
    )


def _scale(result: SurveyResult) -> tuple[Remark, ...]:
    """Return the remark on a scale that puts the object nearer to the camera than any lens can focus.

    At an object distance equal to the image distance c the image is as large as the object. Source: DIN
    19040-2 (macrophotography is photography at 1 : 1 and larger); Luhmann et al. (2020), sec. 3.1.1 (thin
    lens).
    """
    a, metres = result.adjustment, METRES.get(result.length_unit)
    if metres is None or not result.has_scale:
        return ()
    network, largest, nearest = a.network, 0.0, np.nan
    seen = network.image_points
    for i, rows in enumerate(rows_of(seen.image, len(network.images))):
        camera = a.estimate.cameras[network.camera[i]]
        used = rows[~a.rejected[rows]]
        if not camera.in_mm or not len(used):
            continue
        d = (a.estimate.points[seen.point[used]] - a.estimate.position[i]) @ a.estimate.rotation[i]
        distance = float(np.median(-d[:, 2])) * metres
        magnification = abs(float(camera.parameters[0])) * MM / distance if distance > 0 else 0.0
        if magnification > largest:
            largest, nearest = magnification, distance
    if not largest > MAX_MAGNIFICATION:
        return ()
    return (remark("scale_implausible", distance=(nearest / MM, "mm"), magnification=largest),)
