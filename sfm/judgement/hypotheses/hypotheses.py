"""Finds the assumption of a survey that is wrong, if any: tests alternatives, adjusts and judges the best.

All alternatives are tested at once with the accepted image points of the free network, without a new
adjustment. The best alternatives that chance does not explain are adjusted with all unknowns. The best of
these is named if its likelihood outweighs its parameters and the search, and if coordinates shift by at least
one standard deviation.

Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.6.4 and 4.6.5 (separability).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Literal, NamedTuple

import numpy as np

from sfm.adjustment.covariance import with_error_correlation
from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.judgement.hypotheses.alternatives import (
    MIN_GROUP,
    alternatives_of,
    cameras_of_photographs,
    is_significant,
)
from sfm.judgement.hypotheses.columns import columns_of, interior_columns
from sfm.judgement.hypotheses.families import HELD, MOVED, Alternative, InteriorFamily, PointFamily
from sfm.judgement.hypotheses.parts import SharedEvidence, of_all_parts, parts_of, reduced_to
from sfm.judgement.hypotheses.refit import (
    Refit,
    log_likelihood_of,
    precision_factor,
    readjusted,
    refit,
    shifts_of,
    spread_of_photographs,
    unchecked_assumptions,
)
from sfm.judgement.hypotheses.score import (
    Gain,
    Reduced,
    log_likelihood_gain,
    reduce_adjustment,
    squares_gained,
)
from sfm.model.conventions import BoolArray, FloatArray
from sfm.model.distributions import MIN_LEAD
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.likelihood import price_of
from sfm.model.network import Network, rows_of, without_given
from sfm.model.reduced_network import reduce_network
from sfm.model.remarks.remark import Remark, remark
from sfm.model.similarity import fit_similarity
from sfm.runtime.progress import reported

MAX_CAUSES = 4  # number of causes, each sought beside the others
MAX_TRIED = 2  # alternatives of each kind that are adjusted, those with most evidence in the score test
MAX_IMAGE_POINTS = 6_000  # largest tested network; of a larger one, the points with most rays are used
# Adjustments of a search times the cube of the photographs, to which their time is proportional. Its
# alternatives share them, and only the best is adjusted to the end: 46 of 186 photographs, half a minute.
MAX_WORK = 3e8
MAX_PHOTOGRAPHS = 300  # largest network that is tested as a whole, as its normal equations are dense
PART_PHOTOGRAPHS = 60  # of the parts of a larger one
PART_IMAGE_POINTS = 2_000  # of a part: with more, the parts of 1,000 photographs take a minute
WITHOUT = "the other photographs"  # with which those of a part do not shift
MIN_SHAPE = 4  # given points with a shape that the datum does not determine
OF_FREE_POINTS = (  # tests that do not apply to given points
    "assumptions_tested",
    "assumptions_untested",
    "photographs_untested",
    "constancy_weakly_tested",
    "held_weakly_tested",
)
# Shift of coordinates, in standard deviations, below which a cause does not matter.
MIN_NAMED_SIGMAS = 1.0


@dataclass(frozen=True)
class Cause:
    """An accepted alternative."""

    alternative: Alternative
    refit: Refit
    as_well: tuple[tuple[Alternative, Refit], ...]  # other causes that explain almost as much

    @property
    def otherwise(self) -> float | None:
        """Largest shift by another cause that explains the image points almost as well; None if unknown.

        That of a camera for each photograph is not known: what its many parameters leave open is much larger
        than what they shift.
        """
        known = [refitted.shift for alternative, refitted in self.as_well if alternative.pattern != "each"]
        return max((shift for shift in known if np.isfinite(shift)), default=None)

    @property
    def matters(self) -> bool:
        """Whether it, or another that explains as much, shifts the result; an unknown shift (NaN) does."""
        return not max(self.refit.shift, self.otherwise or 0.0) < MIN_NAMED_SIGMAS

    @property
    def evidence(self) -> float:
        """Gain of ln likelihood minus the price of parameters and search."""
        redundancy = self.refit.adjustment.redundancy
        return self.alternative.deflated(self.refit.gain, redundancy) - self.alternative.price


@dataclass(frozen=True)
class JudgedAssumptions:
    """Tests of the assumptions of an adjustment by the image points."""

    causes: tuple[Remark, ...] = ()  # causes of contradictions, clearest first
    unchecked: tuple[Remark, ...] = ()  # assumptions that are not tested, or only weakly


def judge_alternatives(final: Adjustment, *, unit: str = "") -> JudgedAssumptions:
    """Return the evidence of the image points against the assumptions of a finished adjustment."""
    photographs = final.network.images
    if not final.converged or not final.sigma0 > 0 or final.is_exact:
        return JudgedAssumptions()  # no result, or an exact one, which nothing contradicts
    if len(photographs) > MAX_PHOTOGRAPHS:
        return _judge_parts(final, unit)
    calibration = _is_calibration(final)
    without = "control" if calibration or not final.unknown_counts[2] else None
    free = free_network(final)
    judged = _judge_free(free, unit, without, len(final.network.image_points))
    if not calibration:
        return judged
    try:
        cause = cause_in_calibration(final, free)
    except np.linalg.LinAlgError:
        return judged
    if cause is not None:
        judged = replace(judged, causes=(remark_of(final, cause, unit),))
    few = () if cause is not None else _calibrated_from_few(final)
    unchecked = (
        unchecked_remark
        for unchecked_remark in judged.unchecked
        if unchecked_remark.kind not in OF_FREE_POINTS
    )
    sample = {} if free is None else _sample_of(len(free.network.image_points), len(final.rejected))
    tested = remark("assumptions_tested", photographs=photographs, causes=len(judged.causes), **sample)
    return replace(judged, unchecked=(tested, *few, *unchecked))


def _judge_parts(final: Adjustment, unit: str) -> JudgedAssumptions:
    """Return the evidence of the image points of each part of a large network, and of all parts together."""
    network = final.network
    parts = parts_of(network, ~final.rejected, PART_PHOTOGRAPHS)
    causes, said, tested = list[Cause](), list[Remark](), np.zeros(len(network.images), dtype=bool)
    solved, shared = list[Adjustment](), SharedEvidence()
    for images, plain in zip(parts, _free_parts(final, parts), strict=True):
        if plain is None:
            continue
        try:
            reduced = reduce_adjustment(plain)
            accepted = find_causes(plain, reduced)
        except np.linalg.LinAlgError:
            continue
        tested |= images
        solved.append(plain)
        shared.add(reduced)
        causes += accepted
        said += [remark_of(plain, cause, unit, WITHOUT) for cause in accepted]
    said += _shared_by_parts(solved, shared, causes, unit)
    joined, unchecked = of_all_parts(said), []
    names = [[network.images[i] for i in np.flatnonzero(tested == which)] for which in (False, True)]
    if tested.any():
        size = {"parts": len(parts), "most": max(int(part.sum()) for part in parts)}
        count = int((tested[network.image_points.image] & ~final.rejected).sum())
        size |= _sample_of(sum(len(plain.network.image_points) for plain in solved), count)
        unchecked.append(remark("assumptions_tested", photographs=names[True], causes=len(said), **size))
    if not tested.all():
        unchecked.append(remark("photographs_untested", photographs=names[False], most=PART_PHOTOGRAPHS))
    return JudgedAssumptions(joined, tuple(unchecked))


def _free_parts(final: Adjustment, parts: Sequence[BoolArray]) -> Iterator[Adjustment | None]:
    """Yield the adjustment of the image points of each part alone; None where they determine no solution."""
    reduced = reduced_to(final.network, final.estimate, ~final.rejected, parts)
    alarm = final.false_alarm / (len(parts) + 1)  # of each part, and of all together
    for part, start, rows in reported("parts tested", reduced, len(parts)):
        factor = final.image_sigma_factor[rows]
        plain = adjust_image_points(
            part, start, final.rejected[rows], factor, false_alarm=alarm, most=PART_IMAGE_POINTS
        )
        if plain is not None and final.error_correlation is not None:
            plain = with_error_correlation(plain, final.error_correlation)
        yield plain


def _shared_by_parts(
    solved: Sequence[Adjustment], evidence: SharedEvidence, causes: Sequence[Cause], unit: str
) -> list[Remark]:
    """Return the remark on the held parameter that all parts together demand, if no part names it alone.

    It is told of the part that gains most by it.
    """
    if not solved:
        return []
    level = solved[0].levels.family
    every = evidence.together(level)
    shared = max(every, key=lambda parameter: parameter.joint.evidence, default=None)
    if shared is None or not shared.joint.evidence > -np.log(level):
        return []
    named = {
        pair for cause in causes if cause.alternative.family == HELD for pair in cause.alternative.parameters
    }
    if not named.isdisjoint(shared.joint.parameters) or not is_significant(shared.joint, len(every), level):
        return []
    clearest = max(shared.of_parts, key=lambda test: test.own.gain.value)
    plain, own = solved[clearest.part], clearest.own
    beta, seen = np.array([shared.change / clearest.unit]), plain.network.image_points
    with_it = replace(seen, xy=seen.xy - interior_columns(plain, own.parameters)[0] @ beta)
    refitted = readjusted(plain, replace(plain.network, image_points=with_it), plain)
    if refitted is None:
        return []
    gain = log_likelihood_of(refitted) - log_likelihood_of(plain)
    cause = Cause(own, Refit(refitted, beta, gain, *shifts_of(plain, plain, refitted, own, beta)), ())
    return [remark_of(plain, cause, unit, WITHOUT)] if cause.matters else []


def _sample_of(tested: int, count: int) -> dict[str, int]:
    """Return the numbers of tested and of all image points where those tested are a sample; else nothing."""
    return {"sample": tested, "image_points": count} if tested < count else {}


def _judge_free(
    plain: Adjustment | None, unit: str, without: str | None, image_points: int
) -> JudgedAssumptions:
    """Return the evidence of the image points alone; `plain` is None if they determine no network.

    They may be a sample of the number of image points that is given.
    """
    if plain is None:
        return JudgedAssumptions(unchecked=(remark("assumptions_untested"),))
    photographs = plain.network.images
    try:
        causes = find_causes(plain)
        unchecked = unchecked_assumptions(plain, without)
    except np.linalg.LinAlgError:
        return JudgedAssumptions(unchecked=(remark("assumptions_untested"),))
    sample = _sample_of(len(plain.network.image_points), image_points)
    tested = remark("assumptions_tested", photographs=photographs, causes=len(causes), **sample)
    unchecked = (tested, *unchecked)
    if len(photographs) < 2 * MIN_GROUP:
        few = remark("photographs_untested", photographs=photographs, needed=2 * MIN_GROUP)
        unchecked = (few, *unchecked)
    return JudgedAssumptions(tuple(remark_of(plain, cause, unit, without) for cause in causes), unchecked)


def _is_calibration(final: Adjustment) -> bool:
    """Return whether cameras are adjusted, most points are given, and nothing else is given.

    The other points may be given ones that were left out because a changed camera displaces them.
    """
    network = final.network
    given, seen = network.control.complete.point, network.image_points.point[~final.rejected]
    beside = len(network.scale_bars) or len(network.exterior)
    adjusted = final.datum == "control" and final.unknown_counts[1]
    return bool(adjusted and not beside and 2 * len(given) > len(np.unique(seen)))


def _calibrated_from_few(final: Adjustment) -> tuple[Remark, ...]:
    """Return a remark for each camera with at most MIN_GROUP photographs."""
    number, names = cameras_of_photographs(final), np.array(final.network.images)
    return tuple(
        remark(
            "calibrated_from_few",
            camera=final.estimate.cameras[final.network.camera[rows[0]]].shared_name,
            photographs=names[rows].tolist(),
        )
        for rows in (np.flatnonzero(number == k) for k in range(int(number.max()) + 1))
        if len(rows) <= MIN_GROUP
    )


def cause_in_calibration(final: Adjustment, free: Adjustment | None) -> Cause | None:
    """Return the cause that given points reveal: another camera in some photographs, or strained control.

    Image points alone reveal little about the cameras of a few photographs, or of many photographs of a
    plane. `free` is the adjustment of the image points alone; None if they determine no network.

    Raises:
        numpy.linalg.LinAlgError: the network is not determined.
    """
    held: Adjustment | None = final
    if free is not None and len(free.rejected) < len(final.rejected):
        start, factor = final.estimate, final.image_sigma_factor  # all are compared on the same sample
        held = adjust_image_points(
            final.network, start, final.rejected, factor, datum="control", false_alarm=final.false_alarm
        )
    if held is None:
        return None
    cause = _best(held, beside=() if free is None else _with_free_shape(held, free))
    if cause is None or not (cause.matters or cause.alternative.kind == "shape_of_control"):
        return None
    return cause


def remark_of(plain: Adjustment, cause: Cause, unit: str, without: str | None = None) -> Remark:
    """Return the remark on a cause that an adjustment does not include.

    `without` is what fixes all coordinates of the result, so that only those of the adjustment shift.
    """
    alternative, refitted = cause.alternative, cause.refit
    instead = tuple(dict.fromkeys(other.kind for other, _ in cause.as_well))
    parts = alternative.family.parts(alternative, refitted.adjustment, refitted.beta, unit)
    of = "coordinates" if without is None else f"coordinates without {without}"
    if plain.datum == "control":
        of = "cameras"
    wrong, factor = refitted.shift, None
    if (
        alternative.kind == "camera_varies"
    ):  # a random error of each photograph biases nothing, but widens the scatter
        wrong = factor = precision_factor(plain)
    rms = None if of == "cameras" else refitted.rms
    size = {"shift": refitted.shift, "wrong": wrong, "rms": rms, "factor": factor}
    return remark(
        alternative.kind, of=of, **size, instead=instead or None, otherwise=cause.otherwise, **parts
    )


def find_causes(plain: Adjustment, reduced: Reduced | None = None) -> tuple[Cause, ...]:
    """Return the accepted alternatives, clearest first, for an adjustment of the image points alone.

    Args:
        plain: the adjustment.
        reduced: the same with all unknowns eliminated, if that is known.
    """
    causes: tuple[Cause, ...] = ()
    for _ in range(MAX_CAUSES):
        cause = _best(plain, causes, reduced=causes[-1].refit.reduced if causes else reduced)
        if cause is None:
            break
        causes = _still_needed(plain, causes, cause)
    return tuple(cause for cause in _with_joint_shifts(plain, causes) if cause.matters)


class _Adjusted(NamedTuple):
    """An alternative with an adjustment of its own."""

    evidence: float  # gain of ln likelihood minus the price of parameters and search
    alternative: Alternative
    refit: Refit


def _best(
    plain: Adjustment,
    causes: tuple[Cause, ...] = (),
    *,
    beside: Sequence[tuple[Alternative, Refit]] = (),
    reduced: Reduced | None = None,
) -> Cause | None:
    """Return the accepted alternative, in addition to known causes, that gives the best adjustment.

    The alternatives with most evidence are adjusted, because the score test is linear: for a large error it
    favours the alternative with most parameters. Those of `beside` are adjusted already. `reduced` is the
    adjustment with the known causes, all unknowns eliminated, if that is known.
    """
    current = causes[-1].refit.adjustment if causes else plain
    before = [(cause.alternative, cause.refit.beta) for cause in causes]
    reduced = reduced or reduce_adjustment(current)
    every, level = alternatives_of(reduced), plain.levels.family
    to_try = _to_adjust(every, level)
    work = max(len(to_try), 1) * len(plain.network.images) ** 3

    def judge(alternative: Alternative, refitted: Refit, asked: float) -> None:
        evidence = _evidence_of(alternative, refitted, reduced.redundancy, before, asked)
        if holding and not evidence > max(tried.evidence for tried in holding):
            refitted = replace(refitted, reduced=None)  # only that of the best is needed
        holding.append(_Adjusted(evidence, alternative, refitted))

    def least_asked() -> float:
        """Return the least evidence of an alternative that is named, or that explains as much."""
        return float(max([np.log(1 / level), *(tried.evidence for tried in holding)]) - MIN_LEAD)

    def adjust_all(alternatives: Iterable[Alternative]) -> None:
        most = int(MAX_WORK / work)
        for alternative in alternatives:
            asked = least_asked()
            asked_gain, columns = asked + alternative.price, reduced.columns
            refitted = refit(
                plain, alternative, current, before, asked=asked_gain, most=most, columns=columns
            )
            if refitted is not None:
                judge(alternative, refitted, asked)

    holding: list[_Adjusted] = []
    for alternative, refitted in beside:
        judge(alternative, refitted, least_asked())
    adjust_all(reported("alternatives adjusted", to_try, len(to_try)))
    best = max(holding, key=attrgetter("evidence"), default=None)
    if best is None or not best.evidence > np.log(1 / level):
        return None
    finished = best.refit
    if not finished.finished:
        finished = refit(plain, best.alternative, current, before) or finished
    # a large error makes photographs differ, whatever caused it: that separates it from no other explanation
    near = best.alternative.evidence_beside_spread - MIN_LEAD
    tried = {other.alternative.kind for other in holding}
    rivals = {
        alternative.kind: alternative
        for alternative in reversed(every)
        if alternative.evidence_beside_spread > near
    }
    adjust_all([rival for kind, rival in rivals.items() if kind not in tried])
    as_well = tuple(
        (other.alternative, other.refit)
        for other in holding
        if other.alternative.kind != best.alternative.kind and best.evidence - other.evidence < MIN_LEAD
    )
    return Cause(best.alternative, finished, as_well)


def _to_adjust(every: Sequence[Alternative], level: float) -> list[Alternative]:
    """Return the alternatives with most evidence: one of each cause, and at most MAX_TRIED of a kind."""
    needed = np.log(1 / level)
    once: dict[tuple[object, ...], Alternative] = {}
    for alternative in every:
        if is_significant(alternative, len(every), level) and alternative.evidence > needed:
            once.setdefault(alternative.family.cause(alternative), alternative)
    if once:  # if one parameter of all photographs explains the errors, no other cause is needed
        for alternative in every:
            if isinstance(alternative.family, InteriorFamily) and alternative.evidence_beside_spread > needed:
                once.setdefault(alternative.family.cause(alternative), alternative)
    of_kind: Counter[object] = Counter()
    to_try = []
    for cause, alternative in once.items():
        of_kind[cause[0]] += 1
        if of_kind[cause[0]] <= MAX_TRIED:
            to_try.append(alternative)
    return to_try


def _with_free_shape(held: Adjustment, free: Adjustment) -> list[tuple[Alternative, Refit]]:
    """Return the alternative that given points have another shape; none if they do not determine one.

    The image points alone state the shape. All its coordinates are parameters.

    held: adjustment with control.
    free: adjustment of its image points alone.
    """
    given = held.network.control.complete
    if len(given) < MIN_SHAPE:
        return []
    number = {name: j for j, name in enumerate(free.network.points)}
    X = free.estimate.points[[number[held.network.points[j]] for j in given.point]]
    try:
        away = fit_similarity(X, given.xyz).apply(X) - given.xyz
    except GeometryError:
        return []
    beta, q = away.ravel(), away.size - 7
    gain = log_likelihood_of(free, q) - log_likelihood_of(held)
    seen = np.isin(held.network.image_points.point, given.point)
    price = price_of(q, int(seen.sum()) // len(given))  # each moves its image points only
    free_shape = Alternative(
        MOVED,
        "all",
        np.ones(len(held.network.images)),
        Gain(squares_gained(gain, held.redundancy), q, beta),
        points=given.point,
        price=price,
        redundancy=held.redundancy,
    )
    return [(free_shape, Refit(free, beta, gain, *shifts_of(held, held, free, free_shape, beta)))]


def _evidence_of(
    alternative: Alternative,
    refitted: Refit,
    redundancy: int,
    before: Sequence[tuple[Alternative, FloatArray]],
    asked: float,
) -> float:
    """Return the evidence of an adjusted alternative beside known causes, to the last where it is `asked`."""
    evidence = alternative.deflated(refitted.gain, redundancy) - alternative.price
    if not before or evidence < asked:
        return evidence
    return min(evidence, _beyond_spread(alternative, refitted, redundancy, before) - alternative.price)


def _beyond_spread(
    alternative: Alternative,
    refitted: Refit,
    redundancy: int,
    before: Sequence[tuple[Alternative, FloatArray]],
) -> float:
    """Return the gain of ln likelihood by another cause beyond the usual differences between photographs.

    It is not known for the first cause, because its large error itself makes photographs differ.
    """
    if isinstance(alternative.family, InteriorFamily):
        return refitted.gain
    squares = squares_gained(refitted.gain, redundancy)
    beyond = alternative.spread.evidence(squares, alternative.gain.rank, redundancy)
    if not isinstance(alternative.family, PointFamily):
        return beyond
    among = spread_of_photographs(refitted, alternative, [other for other, _ in before])
    return min(beyond, log_likelihood_gain(squares / max(among, 1.0), redundancy))


def _still_needed(plain: Adjustment, causes: tuple[Cause, ...], latest: Cause) -> tuple[Cause, ...]:
    """Return the causes with a new one, without those that the others explain too."""
    for cause in causes:
        joint = zip(causes, latest.refit.before, strict=True)
        before = [(known, beta) for known, beta in joint if known is not cause]
        new = replace(latest.alternative, gain=replace(latest.alternative.gain, beta=latest.refit.beta))
        others = [(known.alternative, beta) for known, beta in before]
        price = cause.alternative.price + np.log(1 / plain.levels.family)
        loss = cause.alternative.inflated(price, plain.redundancy)  # with so much, it is needed
        start, reduced = latest.refit.adjustment, latest.refit.reduced
        columns = None if reduced is None else reduced.columns
        alone = refit(plain, new, start, others, least=-np.inf, asked=-loss, columns=columns)
        if alone is not None and -alone.gain < loss:
            causes, latest = tuple(known for known, _ in before), replace(latest, refit=alone)
    joint = zip(causes, latest.refit.before, strict=True)
    kept = tuple(replace(known, refit=replace(known.refit, beta=beta, reduced=None)) for known, beta in joint)
    return (*kept, latest)


def _with_joint_shifts(plain: Adjustment, causes: tuple[Cause, ...]) -> tuple[Cause, ...]:
    """Return the causes with what each shifts while the effects of all others are removed."""
    if len(causes) < 2:
        return causes
    last, shifted = causes[-1].refit.adjustment, []
    reduced, seen = causes[-1].refit.reduced, last.network.image_points
    columns = columns_of(last) if reduced is None else reduced.columns
    for cause in causes:
        alternative, beta = cause.alternative, cause.refit.beta
        with_effect = replace(seen, xy=seen.xy + alternative.columns(last, columns) @ beta)
        left = readjusted(plain, replace(plain.network, image_points=with_effect), last)
        shift = rms = float("nan")
        if left is not None:
            shift, rms = shifts_of(plain, left, last, alternative, beta)
        shifted.append(replace(cause, refit=replace(cause.refit, shift=shift, rms=rms)))
    return tuple(shifted)


def contradicted_parameters(a: Adjustment) -> tuple[tuple[str, str], ...]:
    """Return (camera or group, parameter) of held parameters that image points contradict, clearest first.

    Each improves the fit of the finished adjustment beyond chance when it alone is freed. Of a large network,
    the evidence of its parts is added.
    """
    if not a.converged or not a.sigma0 > 0 or a.redundancy < 2:
        return ()
    if len(a.network.images) <= MAX_PHOTOGRAPHS:
        solved: Iterable[Adjustment | None] = [free_network(a)]
    else:
        solved = _free_parts(a, parts_of(a.network, ~a.rejected, PART_PHOTOGRAPHS))
    evidence, level = SharedEvidence(), a.levels.family
    for part in solved:
        with suppress(np.linalg.LinAlgError):
            if part is not None:
                evidence.add(reduce_adjustment(part))
    every = [parameter.joint for parameter in evidence.together(level)]
    significant = [interior for interior in every if is_significant(interior, len(every), level)]
    contradicted = sorted(significant, key=lambda interior: -interior.gain.value)
    names = []
    for interior in contradicted:
        index, s = interior.parameters[0]
        camera = a.estimate.cameras[index]
        names.append((camera.owner_of(s), camera.names[s]))
    return tuple(names)


def free_network(final: Adjustment) -> Adjustment | None:
    """Return the adjustment of the image points alone, with gross errors rejected; None without one."""
    if not final.converged or not final.sigma0 > 0 or final.redundancy < 2:
        return None
    network, correlation = final.network, final.error_correlation
    alone = not (len(network.scale_bars) or len(network.exterior))
    tested = final.rejected.any() and not final.reweighted and not final.undetermined
    if alone and tested and final.datum != "control" and len(final.rejected) <= MAX_IMAGE_POINTS:
        return final
    free = adjust_image_points(
        network, final.estimate, final.rejected, final.image_sigma_factor, false_alarm=final.false_alarm
    )
    return free if free is None or correlation is None else with_error_correlation(free, correlation)


def adjust_image_points(
    network: Network,
    estimate: Estimate,
    rejected: BoolArray,
    factor: FloatArray,
    *,
    datum: Literal["free", "control"] = "free",
    false_alarm: float,
    most: int | None = None,
) -> Adjustment | None:
    """Adjust the image points of a network alone, or a sample of many; None if they determine no solution.

    Args:
        network: network in which all photographs and points have start values.
        estimate: start values.
        rejected: image points left out at the start, (k,).
        factor: factor on the standard deviations of image points, (k,).
        datum: "control" to adjust them with the given points.
        false_alarm: probability that right image points are called wrong.
        most: image points of the sample; MAX_IMAGE_POINTS if None.
    """
    alone = without_given(network)
    if datum == "control":
        alone = alone.with_given(network.control)
    part, start, rows = _sample(alone, estimate, MAX_IMAGE_POINTS if most is None else most)
    try:
        free = adjust(
            part,
            start,
            datum=Datum(datum),
            reject="tau",
            false_alarm=false_alarm,
            rejected=rejected[rows],
            options=AdjustmentOptions(image_sigma_factor=factor[rows]),
        )
    except (GeometryError, np.linalg.LinAlgError):
        return None
    return free if free.converged and not free.undetermined and free.redundancy > 1 else None


def best_explanation(plain: Adjustment) -> Cause | None:
    """Return the alternative that best explains an adjustment of image points alone; None if none does."""
    if len(plain.network.images) > MAX_PHOTOGRAPHS:
        return None
    try:
        return _best(plain)
    except np.linalg.LinAlgError:
        return None


def _sample(network: Network, values: Estimate, most: int) -> tuple[Network, Estimate, BoolArray]:
    """Return a network of at most about so many image points, its estimate, and which these are.

    Points with many rays are preferred, and each photograph gets its share.
    """
    seen, m = network.image_points, len(network.images)
    points = np.ones(len(network.points), dtype=bool)
    if len(seen) > most:
        points[:] = False
        images = [seen.image[rows] for rows in rows_of(seen.point, len(points))]
        count = np.zeros(m, dtype=np.int64)
        for j in np.argsort([-len(of_point) for of_point in images], kind="stable"):
            if (count[images[j]] < most / m).any():
                points[j] = True
                np.add.at(count, images[j], 1)
    rows = points[seen.point]
    every = np.ones(m, dtype=bool)
    part, estimate = reduce_network(network, values, every, points, np.ones_like(rows))
    return part, estimate, rows
