"""Incremental orientation: orients a whole network from its image points, photograph by photograph.

The start is control or given approximate values, if there are any. Otherwise it is the pair of photographs
with the model on which most other photographs can be resected. A planar pair has two solutions; the other
photographs confirm one of them. Then every photograph that sees enough points is resected, all points are
intersected, and a function of the caller adjusts the network. So the interior orientation is determined while
the network grows. Finally, photographs that the others contradict are removed.

Given approximate values are first completed and adjusted, and then judged. A photograph is oriented again
only if most of its image points do not fit the others after the adjustment. If most photographs do not fit,
the given values are wrong. Then the network is grown from them or, if they do not help, without them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfm.model.arguments import checked_arguments, checked_fields
from sfm.model.camera import Camera
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.display import counted, listed
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network, empty_estimate
from sfm.model.remarks.remark import Remark, remark
from sfm.model.similarity import fit_similarity
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
    best_connected,
    bounded_costs,
    casts_doubt,
    judge_misfits,
    reinstate_dropped,
    reversed_growth,
    worst_photographs,
)
from sfm.orientation.incremental.starting_pair import Start
from sfm.orientation.intersection import RayLimits, intersect

PARALLEL_SIGMAS = 4.0  # smallest ray angle, in its standard deviations, for rays that are not parallel
MAX_COMPLETIONS = 50  # rounds of resection and intersection without given values
KEPT_SHARE = 0.5  # share of photographs, each with most image points fitting, needed to keep given values
KEPT_TOLERANCE = 2.0  # largest tolerance with given values, as a multiple of the final tolerance
ROUNDS = 3  # most rounds of adjustment, while the set of image points changes
Judge = Callable[[Estimate], float]
MIN_POINTS = 4  # fewest points of a photograph: P3P always fits three, the fourth checks the result
START_TOLERANCE = 0.03  # share of the photograph's diagonal: residuals of unknown distortion after resection
FINAL_TOLERANCE_PX = 4.0  # no image point is excluded below this here; the adjustment tests further
# Share of oriented photographs from which a dropped one casts no doubt on the others. Of 40 simulated castles
# of 9 photographs with 25 % wrong matches, growing again corrected one, of which 5 were oriented, and none
# with more than this share; it takes three times as long.
MOST = 0.75
TRIED_FIRST = 60  # photographs of the part on which a reversal in depth, or another c, is tried first
MIN_RIVALS = 3  # oriented photographs; with two, other knowledge decides, see `best_start`
GROWTH = 1.25  # growth in the number of photographs after which the network is adjusted again
MAX_ROUNDS = 200
FINAL_ROUNDS = 3  # most rounds of resection, intersection and adjustment of all


@dataclass(frozen=True)
class Orientation:
    """Approximate values of a whole network, and what could not be determined."""

    estimate: Estimate  # NaN for photographs and points that are not determined
    failures: tuple[tuple[str, Remark], ...]  # (name of the photograph, reason)
    point_failures: tuple[tuple[str, Remark], ...]  # (name of the point, reason)
    pair: tuple[str, str] | None  # starting pair; None if it started from control or given values
    kind: str  # start: spatial | planar | control | given
    fits: BoolArray  # image points within the tolerance, (k,)
    rms_px: float  # root mean square residual of these, per coordinate, px
    tolerance_px: FloatArray  # last tolerance of each camera, px, (a,)
    remarks: tuple[Remark, ...] = ()  # on useless given values, and on ambiguities of the image points


class NotOrientedError(GeometryError):
    """Too few photographs could be oriented."""

    def __init__(self, message: str, failures: tuple[tuple[str, Remark], ...] = ()) -> None:
        super().__init__(message, failures)
        self.failures = failures  # (name of the photograph, reason)

    def __str__(self) -> str:
        return str(self.args[0])


@checked_fields
@dataclass(frozen=True)
class OrientSettings:
    """Settings of the orientation of a network.

    Example:
        >>> import sfm
        >>> settings = sfm.OrientSettings(seed=1)
        >>> sfm.orient(result.network, result.estimate.cameras, settings).estimate.oriented.all()
        np.True_
    """

    seed: int = 0  # of all random choices
    start_tolerance: float = START_TOLERANCE
    """largest residual at the start, as a fraction of the photograph's diagonal"""
    final_tolerance_px: float = FINAL_TOLERANCE_PX
    """smallest tolerance, px; the tolerance follows the residuals down to it"""
    min_points: int = MIN_POINTS  # points that a photograph must share with the network, at least 4


@checked_arguments()
def orient(
    network: Network,
    estimate: Estimate | Sequence[Camera],
    settings: OrientSettings = OrientSettings(),
    *,
    refine: Refine | None = None,
    contradicting: bool = False,
    judge: Judge | None = None,
) -> Orientation:
    """Return exterior orientations and points of a network, from its image points.

    Args:
        network: the measurements, without image points of unknown object points.
        estimate: cameras with start values, or an estimate in which exterior orientation and points are given
            where known and NaN elsewhere.
        settings: tolerances, and the seed of random choices.
        refine: adjusts a fully determined part of the network (without NaN) and returns it. The cameras
            passed to it have as many free parameters as the part can determine. Its result is used only if
            the image points fit better.
        contradicting: whether points with rays that do not meet within the tolerance also get coordinates,
            for an adjustment that judges them.
        judge: returns the misfit of an estimate with knowledge other than the image points. It is called if
            two photographs of points in a plane have two orientations that fit equally well.

    Returns:
        The orientation. Photographs that could not be oriented, and points that their rays do not determine,
        are NaN and have a reason.

    Raises:
        GeometryError: no two photographs could be oriented, with or without the given values, or there are
            fewer cameras than in the network.

    Source: Luhmann et al. (2020), sec. 4.4.4 (orientation of image networks), with resection by Fischler and
    Bolles (1981) in every photograph.

    Example:
        >>> import sfm
        >>> sfm.orient(result.network, result.estimate.cameras).failures
        ()
    """
    if not isinstance(estimate, Estimate):
        count = int(network.camera.max()) + 1
        cameras = tuple(estimate) if isinstance(estimate, Sequence) else ()
        if len(cameras) < count or not all(isinstance(camera, Camera) for camera in cameras):
            raise GeometryError(
                f"orient: {type(estimate).__name__}, expected an Estimate or {counted(count, 'camera')}"
            )
        estimate = empty_estimate(network, cameras)

    final_tolerance_px = settings.final_tolerance_px

    def begin(values: Estimate, share: float = 1.0) -> Growth:
        diagonal = np.array([np.hypot(*camera.size_px) for camera in values.cameras])
        tolerance_px = share * settings.start_tolerance * diagonal
        return Growth(network, values, settings.seed, tolerance_px, max(settings.min_points, MIN_POINTS))

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
        before = growth.state()
        if reinstate_dropped(growth):
            _settle(growth, refine, final_tolerance_px)
            if growth.estimate.oriented.sum() <= before.estimate.oriented.sum():
                growth.restore(before)

    if not has_given_values(network, estimate):
        return grow(estimate)
    growth = begin(estimate)
    kept = start_from_given(growth, refine, final_tolerance_px)
    if kept is not None:
        settle_misfits(growth)
        given = Start(None, "given", kept.estimate.position, kept.estimate.rotation, kept.estimate.points)
        oriented = _finish(growth, given, estimate.cameras, contradicting=contradicting)
        return replace(oriented, remarks=(*oriented.remarks, *kept.replaced))
    return _with_or_without_given(network, estimate, grow)


def _with_or_without_given(
    network: Network, estimate: Estimate, grow: Callable[[Estimate], Orientation]
) -> Orientation:
    """Return the orientation that starts from given values, or the one without them if it orients more.

    Args:
        network: the measurements.
        estimate: cameras and given values.
        grow: orients the network from an estimate.
    """
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
        raise GeometryError(f"{error}, with and without the given approximate values") from error
    before = 0 if with_given is None else int(with_given.estimate.oriented.sum())
    now = int(without.estimate.oriented.sum())
    if with_given is not None:
        better = (now, _holds_control(network, without)) > (before, _holds_control(network, with_given))
        if not better:
            return with_given
    unused = (
        remark("approximate_unused", before=before, now=now)
        if before < now
        else remark("approximate_unused", control="control")
    )
    return replace(without, remarks=(*without.remarks, unused))


def _holds_control(network: Network, orientation: Orientation) -> bool:
    """Return whether every measured control point fits in at least one photograph."""
    control, seen = network.control.complete, network.image_points
    measured = np.isin(control.point, seen.point[orientation.estimate.oriented[seen.image]])
    return bool(np.isin(control.point[measured], seen.point[orientation.fits]).all())


def _best_of_rivals(
    growth: Growth,
    start: Start,
    values: Estimate,
    begin: Callable[[Estimate, float], Growth],
    refine: Refine,
    final_tolerance_px: float,
    judge: Judge | None,
) -> tuple[Growth, Start]:
    """Return the solution with the smallest residuals among the first one and, if it is in doubt, its rivals.

    A solution is in doubt if its reversal in depth fits almost as well, if it leaves residuals beyond the
    final tolerance, or if photographs had to be dropped and many are not oriented. The reversal of many
    photographs is adjusted only if that of a part fits almost as well.

    Args:
        growth: network with the first solution.
        start: its start.
        values: cameras for a new start.
        begin: starts again with a share of the start tolerance.
        refine: the caller's adjustment.
        final_tolerance_px: tolerance below which no image point is excluded, px.
        judge: as in `orient`.
    """
    oriented = growth.estimate.oriented
    if oriented.sum() < MIN_RIVALS:
        return growth, start
    image = growth.network.image_points.image
    solutions, first = [(growth, start)], growth.residuals_px()
    split = growth.dropped.any() and oriented.mean() < MOST
    loose = bool((growth.tolerance_px > final_tolerance_px).any() or split)
    if not loose:  # a part that cannot be reversed excludes that of the whole
        others = oriented & ~best_connected(growth.network, growth.estimate, TRIED_FIRST)
        if others.any():
            part = reversed_growth(growth, begin(values, 1.0), refine, others)
            if not casts_doubt(growth, part):
                return growth, start
    none_dropped = np.zeros(len(oriented), dtype=bool)
    other_side = reversed_growth(growth, begin(values, 1.0), refine, none_dropped)
    if not loose and not casts_doubt(growth, other_side):
        return growth, start
    rivals = [other_side]
    worst = worst_photographs(first, image, len(oriented))
    if worst.any() and (oriented & ~worst).sum() >= MIN_RIVALS:
        rivals.append(reversed_growth(growth, begin(values, 1.0), refine, worst))
    for rival in rivals:
        _settle(rival, refine, final_tolerance_px)
        solutions.append((rival, start))
    for share in SMALLER_TOLERANCES:
        rival = begin(values, share)
        try:
            solutions.append((rival, _grow(rival, refine, final_tolerance_px, judge)))
        except GeometryError:
            continue
    return solutions[
        int(np.argmin(bounded_costs([solution.residuals_px() for solution, _ in solutions], image)))
    ]


def _grow(growth: Growth, refine: Refine | None, final_tolerance_px: float, judge: Judge | None) -> Start:
    """Start, resect and intersect until nothing is added, and remove photographs that do not belong."""
    start = growth.begin(judge)
    adjusted = 0
    for _ in range(MAX_ROUNDS):
        added = growth.resect_next()
        growth.intersect()
        now = int(growth.estimate.oriented.sum())
        if now >= FIRST_ADJUSTMENT and (now >= GROWTH * adjusted or (not added and now > adjusted)):
            growth.adjust(refine)
            growth.adapt_tolerance(final_tolerance_px)
            growth.intersect()
            adjusted = now
        elif not added:
            break
    if _settle(growth, refine, final_tolerance_px):
        growth.drop_unsupported()
    return start


def _settle(growth: Growth, refine: Refine | None, final_tolerance_px: float) -> bool:
    """Settle a network, and settle it again after removing photographs that the others do not support.

    Returns:
        Whether a photograph was removed, now or earlier.
    """
    _settle_oriented(growth, refine, final_tolerance_px)
    dropped = growth.drop_unsupported() > 0
    if dropped:
        _settle_oriented(growth, refine, final_tolerance_px)
    return dropped


def _settle_oriented(growth: Growth, refine: Refine | None, final_tolerance_px: float) -> None:
    """Resect, intersect and adjust everything oriented until the set of image points stays the same."""
    for _ in range(FINAL_ROUNDS):
        growth.adapt_tolerance(final_tolerance_px)
        growth.resect_all()
        growth.intersect()
        if not growth.adjust(refine):
            break


def _finish(growth: Growth, start: Start, cameras: tuple[Camera, ...], *, contradicting: bool) -> Orientation:
    """Intersect the remaining points, transform a free network to control, and return the orientation."""
    lost = intersect_remaining(growth, contradicting=contradicting)
    network, control = growth.network, growth.network.control.complete
    seen = network.image_points
    residuals = growth.residuals_px()
    fits = residuals <= growth.tolerance_px[network.camera[seen.image]]
    if growth.estimate.oriented.sum() < 2:
        failures = _failures(growth)
        of_reason: dict[str, list[str]] = {}
        for name, reason in failures:
            of_reason.setdefault(reason.text.rstrip("."), []).append(name)
        reasons = [f"{listed(names, most=10)}: {reason}" for reason, names in of_reason.items()]
        raise NotOrientedError(
            f"orientation: {growth.estimate.oriented.sum()} of {len(network.images)} photographs could be "
            f"oriented, at least 2 are needed: {listed(reasons, most=10, separator='; ')}",
            failures,
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


@dataclass(frozen=True)
class GivenStart:
    """Accepted given values, completed by resection and intersection."""

    estimate: Estimate  # before the adjustment that judges them
    replaced: tuple[Remark, ...]  # on given orientations of single photographs that did not fit


def start_from_given(growth: Growth, refine: Refine | None, final_tolerance_px: float) -> GivenStart | None:
    """Complete given values and adjust them; return None if they do not fit the image points.

    Args:
        growth: network started from given values; contains the adjusted network afterwards.
        refine: the caller's adjustment.
        final_tolerance_px: tolerance below which no image point is excluded, px.
    """
    control = growth.network.control.complete
    held = control.point[growth.fixed[control.point]]
    # orient and intersect everything without given values; given values do not change
    for _ in range(MAX_COMPLETIONS):
        growth.intersect(only_missing=True)
        if not growth.resect_next():
            break
    start = growth.estimate
    if start.oriented.sum() < 2:
        return None
    rough = bool(np.median(growth.share_fitting()[start.oriented]) < KEPT_SHARE)
    replaced: tuple[Remark, ...] = ()
    for _ in range(ROUNDS):
        changed = growth.adjust(refine, everything=rough)
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
    seen = growth.network.image_points
    rows = np.isin(seen.point, held) & start.oriented[seen.image]
    if rows.any():  # most rays of fixed control points fit their coordinates from the given orientations
        limit = growth.start_tolerance_px[growth.network.camera[seen.image]]
        lengths = residual_lengths(
            growth.network, Estimate(growth.estimate.cameras, start.position, start.rotation, start.points)
        )
        if not (lengths <= limit)[rows].mean() >= KEPT_SHARE:
            return None
    return GivenStart(start, replaced)


def _replace_misfits(growth: Growth) -> tuple[Remark, ...]:
    """Resect the photographs with most image points not fitting; return remarks on those replaced."""
    before = growth.share_fitting()
    wrong = np.flatnonzero(growth.estimate.oriented & (before < MIN_SHARE)).tolist()
    if not wrong:
        return ()
    growth.resect(wrong)
    after = growth.share_fitting()
    count = np.bincount(growth.network.image_points.image, minlength=len(after))
    return tuple(
        remark(
            "approximate_unused",
            photograph=growth.network.images[i],
            fitting=round(before[i] * count[i]),
            after=round(after[i] * count[i]),
            image_points=int(count[i]),
        )
        for i in wrong
        if after[i] >= MIN_SHARE
    )


def intersect_remaining(growth: Growth, *, contradicting: bool) -> tuple[tuple[str, Remark], ...]:
    """Intersect the points that are still missing; return (name, reason) of those without coordinates.

    No more photographs are oriented on them, so small angles do no harm; the standard deviations show them.
    Rays that are parallel within their precision, or within the tolerance of the orientation, do not
    intersect.

    Args:
        growth: network with all photographs oriented that can be; receives the points.
        contradicting: whether points with rays that do not meet within the tolerance also get coordinates.
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
        intersection = intersect(
            uv,
            seen.image,
            seen.point,
            estimate.position,
            estimate.rotation,
            n_points=n,
            limits=RayLimits(tolerance=limit),
        )
        # beyond the precision of the rays and the tolerance of the orientation; False where NaN
        clear = intersection.angle > np.maximum(PARALLEL_SIGMAS * np.sqrt(2) * worst, tolerance)
        parallel |= np.isfinite(intersection.angle) & ~clear
        points = np.where(
            (missing & clear & ~np.isfinite(points[:, 0]))[:, None], intersection.points, points
        )
    growth.estimate = replace(estimate, points=points)
    return _reasons(growth, rays, parallel)


def _reasons(growth: Growth, rays: IntArray, parallel: BoolArray) -> tuple[tuple[str, Remark], ...]:
    """Return the reasons why points lack coordinates; `rays` counts rays from oriented photographs, (n,)."""
    measured = growth.network.rays()
    out = []
    for j in np.flatnonzero(~growth.estimate.determined & (measured > 0)):
        if measured[j] < 2:
            reason = remark("points_not_determined", rays=1, needed=2)
        elif rays[j] < 2:
            reason = remark("points_not_determined", measured=int(measured[j]), least=2)
        elif parallel[j]:
            reason = remark("points_not_determined", parallel=int(rays[j]))
        else:
            reason = remark("points_contradicted", rays=int(rays[j]))
        out.append((growth.network.points[j], reason))
    return tuple(out)
