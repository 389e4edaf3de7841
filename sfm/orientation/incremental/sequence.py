"""Orient a whole network from nothing but image points: a start, then photograph by photograph.

The start is control or given approximate values where there are some, else the pair of photographs
whose model most other photographs can be resected on. Planar pairs have two solutions; the one
is taken that the other photographs confirm. After that: resection of every photograph that sees enough
points, intersection of all points, and adjustment by a function of the caller, so that the interior
orientation is learnt while the network grows. At last photographs that the others contradict leave. Given
values are start values: they are completed and adjusted as they are, and only where the image points do not
fit the result are photographs oriented anew, with them or, if they lead nowhere, without them.

Given start values are judged afterwards. A photograph is oriented anew only where most of its image points do
not fit the others after the adjustment; where most photographs do not, the given values are wrong, and the
caller starts without them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfm.arguments import checked_arguments
from sfm.camera import Camera
from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.display import counted, listed
from sfm.errors import GeometryError
from sfm.network import Estimate, Network, empty_estimate
from sfm.orientation.incremental.growth import (
    FIRST_ADJUSTMENT,
    MIN_SHARE,
    Growth,
    Refine,
    has_given_values,
    residual_lengths,
)
from sfm.orientation.incremental.poor_photographs import (
    SMALLER_TOLERANCES,
    bounded_costs,
    casts_doubt,
    judge_misfits,
    reversed_growth,
    worst_photographs,
)
from sfm.orientation.incremental.starting_pair import Start
from sfm.orientation.intersection import intersect
from sfm.remarks.remark import Remark, remark
from sfm.similarity import fit_similarity

PARALLEL_SIGMAS = 4.0  # standard deviations of its angle by which two rays must differ from parallel ones
MAX_COMPLETIONS = 50  # rounds of resection and intersection of what no values were given for
KEPT_SHARE = 0.5  # of the photographs must fit, each with most of its image points, for given values to stay
KEPT_TOLERANCE = 2.0  # times the final tolerance, that the residuals from given values may need
ROUNDS = 3  # of adjustment, while image points come or go
Judge = Callable[[Estimate], float]
MIN_POINTS = 4  # of a photograph: three are always fitted by P3P, the fourth checks it
START_TOLERANCE = 0.03  # of the photograph's diagonal: what an unknown distortion leaves after resection
FINAL_TOLERANCE_PX = 4.0  # below this no image point is put aside here; the adjustment tests further
MIN_RIVALS = 3  # oriented photographs: of two, what is known besides decides, see `best_start`
GROWTH = 1.25  # the network is adjusted when it has this many times the photographs of last time
MAX_ROUNDS = 200
FINAL_ROUNDS = 3  # of resection, intersection and adjustment of all, while image points come or go


@dataclass(frozen=True)
class Orientation:
    """Approximate values of a whole network and what could not be had."""

    estimate: Estimate  # NaN for photographs and points that are not determined
    failures: tuple[tuple[str, Remark], ...]  # (name of the photograph, reason)
    point_failures: tuple[tuple[str, Remark], ...]  # (name of the point, reason)
    pair: tuple[str, str] | None  # photographs it started from; None: from control or given values
    kind: str  # start: spatial | planar | control | given
    fits: BoolArray  # image points within the tolerance, (k,)
    rms_px: float  # over these, per coordinate, px
    tolerance_px: FloatArray  # last tolerance of each camera, px, one per camera
    remarks: tuple[Remark, ...] = ()  # given values of no use, and what the image points do not decide


@checked_arguments()
def orient(
    network: Network,
    estimate: Estimate | Sequence[Camera],
    *,
    seed: int = 0,
    refine: Refine | None = None,
    start_tolerance: float = START_TOLERANCE,
    final_tolerance_px: float = FINAL_TOLERANCE_PX,
    min_points: int = MIN_POINTS,
    contradicting: bool = False,
    judge: Judge | None = None,
) -> Orientation:
    """Return exterior orientations and points of a network, from its image points.

    Args:
        network: measured facts; image points without a known object point belong out of it.
        estimate: cameras with start values, or an estimate in which exterior orientation and points are NaN,
            or given where known.
        seed: of all random choices.
        refine: adjusts a fully determined part of the network (no NaN in it) and returns it adjusted; the
            cameras it is given have as many free parameters as the part can determine. Its result
            is taken only if the image points fit better with it.
        start_tolerance: largest residual at the beginning, as a fraction of the photograph's diagonal.
        final_tolerance_px: the tolerance follows the residuals down to this, px.
        min_points: points that a photograph must share with the network, at least 4.
        contradicting: whether points whose rays do not meet within the tolerance get coordinates, too, for
            an adjustment that is to judge them.
        judge: returns the misfit of an estimate with what is known besides the image points; it is asked
            where two photographs of points in a plane have two orientations that fit alike.

    Returns:
        The orientation, NaN with a reason for every photograph that could not be oriented, and for every
        point that its rays do not determine.

    Raises:
        GeometryError: no two photographs could be oriented, with the given values or without them, or fewer
            cameras than the network has.

    Source: Luhmann et al. (2020), sec. 4.4.4 (orientation of image networks), with resection by Fischler and
    Bolles (1981) in every photograph.

    Example:
        >>> import sfm
        >>> sfm.orient(result.network, result.estimate.cameras).failures
        ()
    """
    if not isinstance(estimate, Estimate):
        estimate = empty_estimate(network, _as_cameras(estimate, int(network.camera.max()) + 1))

    def begin(values: Estimate, share: float = 1.0) -> Growth:
        diagonal = np.array([np.hypot(*camera.size_px) for camera in values.cameras])
        tolerance_px = share * start_tolerance * diagonal
        return Growth(network, values, seed, tolerance_px, max(min_points, MIN_POINTS))

    def grow(values: Estimate) -> Orientation:
        growth = begin(values)
        start = _grow(growth, refine, final_tolerance_px, judge)
        if start.pair is not None and refine is not None:
            growth, start = _best_of_rivals(growth, start, values, begin, refine, final_tolerance_px, judge)
        settle_misfits(growth)
        return _finish(growth, start, values.cameras, contradicting=contradicting)

    def settle_misfits(growth: Growth) -> None:
        if judge_misfits(growth, refine):
            _settle(growth, refine, final_tolerance_px)

    if not has_given_values(network, estimate):
        return grow(estimate)
    growth = begin(estimate)
    kept = start_from_given(growth, refine, final_tolerance_px)
    if kept is not None:
        settle_misfits(growth)
        given = Start(None, "given", kept.estimate.position, kept.estimate.rotation, kept.estimate.points)
        oriented = _finish(growth, given, estimate.cameras, contradicting=contradicting)
        return replace(oriented, remarks=(*oriented.remarks, *kept.replaced))
    try:
        with_given = grow(estimate)
    except GeometryError:
        with_given = None
    if with_given is not None and not with_given.failures and _holds_control(network, with_given):
        return with_given
    try:
        without = grow(empty_estimate(network, estimate.cameras))
    except GeometryError as error:
        if with_given is not None:
            return with_given
        raise GeometryError(f"{error}, neither from the given approximate values nor without them") from error
    before = 0 if with_given is None else int(with_given.estimate.oriented.sum())
    now = int(without.estimate.oriented.sum())
    if with_given is not None:
        better = (now, _holds_control(network, without)) > (before, _holds_control(network, with_given))
        if not better:
            return with_given
    unused = (
        remark("approximate_unused", before=before, now=now)
        if before < now
        else remark("approximate_contradicts_control")
    )
    return replace(without, remarks=(*without.remarks, unused))


def _as_cameras(cameras: Sequence[Camera], count: int) -> tuple[Camera, ...]:
    """Return the cameras of a network; GeometryError for anything else."""
    found = tuple(cameras) if isinstance(cameras, Sequence) else ()
    if len(found) < count or not all(isinstance(one, Camera) for one in found):
        raise GeometryError(
            f"orient: {type(cameras).__name__}, expected an Estimate or {counted(count, 'camera')}"
        )
    return found


def _holds_control(network: Network, found: Orientation) -> bool:
    """Return whether every control point that is measured fits in some photograph."""
    control, seen = network.control.complete, network.image_points
    measured = np.isin(control.point, seen.point[found.estimate.oriented[seen.image]])
    return bool(np.isin(control.point[measured], seen.point[found.fits]).all())


def _best_of_rivals(
    growth: Growth,
    start: Start,
    values: Estimate,
    begin: Callable[[Estimate, float], Growth],
    refine: Refine,
    final_tolerance_px: float,
    judge: Judge | None,
) -> tuple[Growth, Start]:
    """Return the solution with the smallest residuals, of that found first and, if in doubt, of its rivals.

    A solution is in doubt if its reversal in depth fits hardly worse, if it leaves residuals beyond the final
    tolerance, or if a photograph had to leave it.

    Args:
        growth: with the first solution.
        start: what it started from.
        values: cameras to begin anew with.
        begin: begins anew with a share of the start tolerance.
        refine: the caller's adjustment.
        final_tolerance_px: below this no image point is put aside, px.
        judge: as in `orient`.
    """
    oriented = growth.estimate.oriented
    if oriented.sum() < MIN_RIVALS:
        return growth, start
    image = growth.network.image_points.image
    found, first = [(growth, start)], growth.residuals_px()
    none_dropped = np.zeros(len(oriented), dtype=bool)
    other_side = reversed_growth(growth, begin(values, 1.0), refine, none_dropped)
    loose = bool((growth.tolerance_px > final_tolerance_px).any() or growth.dropped.any())
    if not loose and not casts_doubt(first, other_side.residuals_px()):
        return growth, start
    rivals = [other_side]
    worst = worst_photographs(first, image, len(oriented))
    if worst.any() and (oriented & ~worst).sum() >= MIN_RIVALS:
        rivals.append(reversed_growth(growth, begin(values, 1.0), refine, worst))
    for rival in rivals:
        _settle(rival, refine, final_tolerance_px)
        found.append((rival, start))
    for share in SMALLER_TOLERANCES:
        rival = begin(values, share)
        try:
            found.append((rival, _grow(rival, refine, final_tolerance_px, judge)))
        except GeometryError:
            continue
    return found[int(np.argmin(bounded_costs([one.residuals_px() for one, _ in found], image)))]


def _grow(growth: Growth, refine: Refine | None, final_tolerance_px: float, judge: Judge | None) -> Start:
    """Start, resect and intersect until nothing more comes, and remove what does not belong."""
    start = growth.begin(judge)
    adjusted = 0
    for _ in range(MAX_ROUNDS):
        added = growth.resect_next()
        growth.intersect()
        now = int(growth.estimate.oriented.sum())
        if now >= FIRST_ADJUSTMENT and (now >= GROWTH * adjusted or (not added and now > adjusted)):
            growth.refined(refine)
            growth.adapt_tolerance(final_tolerance_px)
            growth.intersect()
            adjusted = now
        elif not added:
            break
    if _settle(growth, refine, final_tolerance_px):
        growth.drop_unsupported()
    return start


def _settle(growth: Growth, refine: Refine | None, final_tolerance_px: float) -> bool:
    """Settle a network, and the rest of it once photographs that the others do not support are removed.

    Returns:
        Whether a photograph was removed, now or before.
    """
    _settle_oriented(growth, refine, final_tolerance_px)
    dropped = growth.drop_unsupported() > 0
    if dropped:
        _settle_oriented(growth, refine, final_tolerance_px)
    return dropped


def _settle_oriented(growth: Growth, refine: Refine | None, final_tolerance_px: float) -> None:
    """Resect, intersect and adjust all that is oriented until no image point comes or goes."""
    for _ in range(FINAL_ROUNDS):
        growth.adapt_tolerance(final_tolerance_px)
        growth.resect_all()
        growth.intersect()
        if not growth.refined(refine):
            break


def _finish(growth: Growth, start: Start, cameras: tuple[Camera, ...], *, contradicting: bool) -> Orientation:
    """Intersect the remaining points, bring the network onto control if it started free, and report."""
    lost = intersect_remaining(growth, contradicting=contradicting)
    network, control = growth.network, growth.network.control.complete
    seen = network.image_points
    residuals = growth.residuals_px()
    fits = residuals <= growth.tolerance_px[network.camera[seen.image]]
    if growth.estimate.oriented.sum() < 2:
        raise GeometryError(
            f"orientation: {growth.estimate.oriented.sum()} of {len(network.images)} photographs could be "
            f"oriented, at least 2 are needed: {_list_failures(_failures(growth))}"
        )
    if start.pair is not None and len(control) >= 3:
        known = growth.estimate.determined[control.point]
        if known.sum() >= 3:
            model = growth.estimate.points[control.point[known]]
            growth.estimate = fit_similarity(model, control.xyz[known]).apply_estimate(growth.estimate)
    failures = _failures(growth)
    pair = None if start.pair is None else (network.images[start.pair[0]], network.images[start.pair[1]])
    used = residuals[fits]
    rms = float(np.sqrt(np.mean(used**2) / 2)) if len(used) else np.nan
    restored = tuple(
        replace(new, free=old.free) for new, old in zip(growth.estimate.cameras, cameras, strict=True)
    )
    estimate = replace(growth.estimate, cameras=restored)
    twofold = start.twofold and pair is not None
    remarks = (remark("plane_ambiguous", photographs=pair),) if twofold else ()
    return Orientation(
        estimate, failures, lost, pair, start.kind, fits, rms, growth.tolerance_px, remarks=remarks
    )


def _failures(growth: Growth) -> tuple[tuple[str, Remark], ...]:
    """Return (name, reason) of every photograph that is not oriented."""
    few = remark("photograph_with_few_points", seen=0, needed=growth.min_points)
    return tuple(
        (growth.network.images[i], growth.reasons.get(int(i), few))
        for i in np.flatnonzero(~growth.estimate.oriented)
    )


def _list_failures(failures: tuple[tuple[str, Remark], ...]) -> str:
    """Return the reasons with the photographs that they are of, each reason once."""
    of_reason: dict[str, list[str]] = {}
    for name, reason in failures:
        of_reason.setdefault(reason.text.rstrip("."), []).append(name)
    words = (f"{listed(names, most=10)}: {reason}" for reason, names in of_reason.items())
    return listed(words, most=10, separator="; ")


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


def intersect_remaining(growth: Growth, *, contradicting: bool) -> tuple[tuple[str, Remark], ...]:
    """Intersect the points that are still missing; return (name, reason) of those that have no place.

    Nothing is oriented on them any more, so that a small angle does no harm: their standard deviations
    show it. Rays that are parallel within their precision, or within the tolerance of the orientation,
    have no point of intersection.

    Args:
        growth: all photographs oriented that can be; gets the points.
        contradicting: whether points whose rays do not meet within the tolerance get a place, too.
    """
    network, estimate = growth.network, growth.estimate
    seen, n = network.image_points, len(network.points)
    missing = ~estimate.determined
    rows = missing[seen.point]
    if not rows.any():
        return _reasons(growth, np.zeros(n, dtype=np.int64), np.zeros(n, dtype=bool))
    oriented = rows & estimate.oriented[seen.image]
    rays = np.bincount(seen.point[oriented], minlength=n)
    uv = np.where(rows[:, None], growth.tangents(), np.nan)
    c = np.array([camera.c_px for camera in estimate.cameras])[network.camera[seen.image]]
    sigma = np.sqrt(np.trace(seen.covariance, axis1=1, axis2=2) / 2) / c
    worst = np.zeros(n)
    np.maximum.at(worst, seen.point[oriented], sigma[oriented])
    points, parallel = estimate.points.copy(), np.zeros(n, dtype=bool)
    tolerance = float(growth.tolerance().max())
    for limit in (tolerance, np.inf) if contradicting else (tolerance,):
        found = intersect(
            uv, seen.image, seen.point, estimate.position, estimate.rotation, n_points=n, tolerance=limit
        )
        # beyond the precision of the rays and what the orientation is known to; False where NaN
        clear = found.angle > np.maximum(PARALLEL_SIGMAS * np.sqrt(2) * worst, tolerance)
        parallel |= np.isfinite(found.angle) & ~clear
        points = np.where((missing & clear & ~np.isfinite(points[:, 0]))[:, None], found.points, points)
    growth.estimate = replace(estimate, points=points)
    return _reasons(growth, rays, parallel)


def _reasons(growth: Growth, rays: np.ndarray, parallel: np.ndarray) -> tuple[tuple[str, Remark], ...]:
    """Say why points have no coordinates, of whose rays so many are from oriented photographs, (n,)."""
    measured = growth.network.rays()
    out = []
    for j in np.flatnonzero(~growth.estimate.determined & (measured > 0)):
        if measured[j] < 2:
            reason = remark("point_with_few_rays", rays=1, needed=2)
        elif rays[j] < 2:
            reason = remark("point_of_lost_photographs", measured=int(measured[j]), needed=2)
        elif parallel[j]:
            reason = remark("point_with_parallel_rays", rays=int(rays[j]))
        else:
            reason = remark("point_with_rays_apart", rays=int(rays[j]))
        out.append((growth.network.points[j], reason))
    return tuple(out)
