"""Alternative hypotheses, each with its gain, and common causes of rejected image points.

A family is a set of columns, and a pattern gives each photograph a factor on them, see `moved`. The level of
the test is divided among all alternatives. It is also lowered by the search inside an alternative: the number
of patterns, or of sets of points, from which the best was chosen.

Rejected image points have common causes, such as exchanged names or points at a second position. The test of
the adjustment has separated them from the good image points. Here they are explained on their own, with the
adjusted photographs. They take no part in the tests of alternatives, because a few of them would dominate.

Source: the score test of `sfm.judgement.hypotheses.score`; Holm (1979), Scand. J. Statist. 6, for the level;
Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.6.5 (alternative hypotheses).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.quality.consistency import intersect_rays
from sfm.adjustment.result import Adjustment
from sfm.camera import project
from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.distortion.models import Role
from sfm.distributions import chi2_isf, chi2_sf
from sfm.judgement.hypotheses.columns import Columns, shared_columns
from sfm.judgement.hypotheses.families import (
    FORMAT,
    GIVEN,
    HELD,
    MOVED,
    OF_EACH,
    OF_PHOTOGRAPHS,
    SHIFTED,
    Alternative,
    CameraFamily,
    Family,
    InteriorFamily,
    ObjectFamily,
    format_columns,
)
from sfm.judgement.hypotheses.moved import (
    MIN_GROUP,
    Part,
    Pattern,
    moved_bodies,
    moved_points,
    patterns_of,
    runs_of,
    score_alternative,
    too_many_cameras,
)
from sfm.judgement.hypotheses.score import (
    NONE,
    Gain,
    Reduced,
    Spread,
    determined_inverse,
    gain_of,
    least_share,
    log_likelihood_gain,
    log_probability,
)
from sfm.likelihood import price_of
from sfm.network import rows_of
from sfm.remarks.remark import Remark, remark

MIN_EXCHANGED = 2  # photographs with two names exchanged from which this is systematic, not accidental
MIN_RAYS = 3  # rays that meet at a second position; two nearly meet anywhere along an epipolar line
# Largest ratio of the variance of a prediction plus its measurement to that of the measurement.
MAX_PREDICTION_RATIO = 2.0
ALPHA = 0.01  # probability of naming any alternative if none is true
OF_ONE = ("single", "pair")  # patterns of one photograph


def alternatives_of(
    a: Adjustment, reduced: Reduced, columns: Columns, bodies: Sequence[IntArray] = ()
) -> tuple[Alternative, ...]:
    """Return all alternatives, best evidence first.

    Args:
        a: adjustment of the image points alone, or with control. With control, only changes of the camera and
            of the object, and a wrong shape of the control, are tested.
        reduced: its normal equations.
        columns: its derivatives.
        bodies: object points of each rigid body that may move relative to the others.
    """
    if a.datum == "control":
        found = [*_by_photographs(a, reduced, columns), *_shapes_of_control(reduced, columns)]
        return _by_evidence(a, reduced, columns, found)
    found = [
        *interiors(a, reduced, HELD),
        *interiors(a, reduced, GIVEN),
        *_in_all(reduced, FORMAT, format_columns(a)),
        *_by_photographs(a, reduced, columns),
        *moved_points(reduced),
        *moved_bodies(a, reduced, columns, bodies),
    ]
    return _by_evidence(a, reduced, columns, found)


def _by_evidence(
    a: Adjustment, reduced: Reduced, columns: Columns, found: Sequence[Alternative]
) -> tuple[Alternative, ...]:
    """Sort alternatives by evidence, after dividing their gains by the design effect of correlated errors."""

    def tested(one: Alternative) -> Alternative:
        grows = log_likelihood_gain(one.gain.value, reduced.redundancy) - one.price
        if reduced.correlation is None or not grows > np.log(1 / ALPHA):
            return one  # not significant in any case
        effect = reduced.design_effect(reduced.whiten(one.columns(a, columns)))
        return one.with_design_effect(effect, reduced.redundancy)

    return tuple(sorted(map(tested, found), key=lambda one: -one.evidence))


def count_alternatives(a: Adjustment, bodies: int = 0) -> int:
    """Return the number of alternatives tested for an adjustment, including some that have no gain.

    They are held and given parameters, families of photographs with their patterns, the format, moved points
    and moved bodies.

    Args:
        a: adjustment.
        bodies: number of rigid bodies.
    """
    owners = [one for family in (HELD, GIVEN) for one in interior_parameters(a, family)]
    held = sum(len(one) + (len(one) > 1) for one in owners)
    if len(a.network.images) < MIN_GROUP:
        return held + 1
    camera = cameras_of_photographs(a)
    run, patterns = runs_of(camera), 0
    for family in OF_PHOTOGRAPHS:
        for among in photographs_among(family, camera):
            m = len(np.unique(run[among]))
            names = [name for name, _, _ in patterns_of(m) if family.of_camera or name not in OF_ONE]
            patterns += len(names) + (m > 2 * MIN_GROUP)
    return held + patterns + len(OF_EACH) + len((FORMAT, MOVED, SHIFTED)) + bodies


def is_significant(one: Alternative, rows: int) -> bool:
    """Return whether chance would produce such a gain in fewer than ALPHA of all surveys.

    Args:
        one: alternative.
        rows: number of alternatives tested together.
    """
    return bool(one.log_p < np.log(ALPHA / rows) - one.search)


def needed_gain(rank: int, touched: int, search: float, rows: int) -> float:
    """Return the smallest gain for which an alternative is named, with a known variance factor.

    Args:
        rank: number of parameters of the alternative.
        touched: number of image points that they move.
        search: ln of the number of patterns from which it was chosen.
        rows: number of alternatives tested together.
    """
    level = np.exp(np.log(ALPHA / rows) - search)
    return float(max(chi2_isf(level, rank), 2 * (price_of(rank, touched, search) + np.log(1 / ALPHA))))


def interior_parameters(a: Adjustment, family: InteriorFamily) -> list[list[tuple[tuple[int, int], ...]]]:
    """Return the held or given parameters of each camera or group of cameras, as (camera, parameter).

    Args:
        a: adjustment.
        family: family of held or of given parameters.
    """
    network = a.network
    given = network.interior
    owners: dict[str, dict[str, list[tuple[int, int]]]] = {}
    for index, camera in enumerate(a.estimate.cameras):
        if not (network.camera == index).any():
            continue
        some = ~camera.free
        if family.of_given:
            weighted = given.parameter[(given.camera == index) & (given.sigma > 0)]
            some = camera.free & np.isin(np.arange(len(camera.free)), weighted)
        # the denominator of a fraction describes the same effect as its numerator
        for s in np.flatnonzero(some & ~camera.plays(Role.DENOMINATOR)).tolist():
            owner = owners.setdefault(camera.owner_of(s), {})
            owner.setdefault(camera.names[s], []).append((index, s))
    return [[tuple(one) for one in owner.values()] for owner in owners.values()]


def interiors(a: Adjustment, reduced: Reduced, family: InteriorFamily) -> Iterator[Alternative]:
    """Yield an alternative for each held or given interior parameter, and one for all of a camera.

    Args:
        a: adjustment.
        reduced: its normal equations.
        family: family of held or of given parameters.
    """
    everywhere = Pattern("all", np.ones(len(a.network.images)))
    for sets in interior_parameters(a, family):
        whole = tuple(pair for one in sets for pair in one)
        D = reduced.whiten(shared_columns(a, list(whole))[0])
        every = gain_of(*reduced.project(D))
        for parameters, columns in [
            *((one, [k]) for k, one in enumerate(sets)),
            *([(whole, list(range(len(sets))))] if len(sets) > 1 else []),
        ]:
            freed = D[:, :, columns]
            H, g, squares = reduced.project(freed)
            gain = gain_of(H, g, squares, least_share(len(H)))
            if gain.rank:
                # evidence of the photographs once this parameter, or all parameters of the camera, are free
                variance = float(gain.beta @ H @ gain.beta)
                spread = min(
                    (
                        _of_scores(reduced.scores(freed @ gain.beta, step), variance)
                        for step in (freed @ gain.beta, D @ every.beta)
                    ),
                    key=lambda one: one.factor,
                )
                yield score_alternative(reduced, family, everywhere, gain, spread, parameters=parameters)


def _in_all(reduced: Reduced, family: Family, columns: FloatArray) -> Iterator[Alternative]:
    """Yield the alternative of a family with the same columns, px, (k, 2, q), in all photographs."""
    D = reduced.whiten(columns)
    H, g, squares = reduced.project(D)
    gain = gain_of(H, g, squares)
    if gain.rank:
        step = D @ gain.beta
        spread = _of_scores(reduced.scores(step, step), float(gain.beta @ H @ gain.beta))
        yield score_alternative(reduced, family, Pattern("all", np.ones(reduced.photographs)), gain, spread)


def _of_scores(scores: FloatArray, variance: float) -> Spread:
    """Return the spread of the scores of photographs in one direction, (m,), over their expected variance.

    Source: White (1982), Econometrica 50, for a score test with dependent observations.
    """
    m = len(scores)
    return Spread(float(scores @ scores) / variance * m / (m - 1), m - 1, among=False) if m > 1 else NONE


def _by_photographs(a: Adjustment, reduced: Reduced, columns: Columns) -> Iterator[Alternative]:
    """Yield the alternatives of cameras, strain and bending in some of the photographs.

    If there are more than MAX_RUNS photographs, neighbours in the sequence are combined. A camera changes in
    some of its photographs, an object in some of all photographs.
    """
    camera = cameras_of_photographs(a)
    run = runs_of(camera)
    m = int(run.max()) + 1
    H, g, squares = reduced.project_by_run(reduced.whiten(columns.freedoms), run)
    if m >= 2 * MIN_GROUP and not too_many_cameras(camera):
        yield from _each(reduced, H, g, squares, run)
    for family in OF_PHOTOGRAPHS:
        some = np.array(family.places)
        for among in photographs_among(family, camera):
            runs = np.unique(run[among])
            part = Part(H[np.ix_(runs, some, runs, some)], g[np.ix_(runs, some)], squares[np.ix_(runs, some)])
            for pattern, factors, search in patterns_of(len(runs)):
                if pattern in OF_ONE and not family.of_camera:
                    continue  # if only one photograph shows another shape, the fault lies with the photograph
                gains = [part.gain(factor) for factor in factors]
                best = max(range(len(gains)), key=lambda k: gains[k].value)
                spread = part.spread(factors[best], gains[best])
                factor = _of_photographs(factors[best], runs, run, m)
                if pattern in OF_ONE:
                    alone = among if pattern == "pair" else factor > 0
                    of_family = _variance_of(reduced, alone, gains[best])
                    spread = replace(spread, factor=max(spread.factor, of_family))
                yield score_alternative(
                    reduced, family, Pattern(pattern, factor, search, among), gains[best], spread
                )
            if len(runs) > 2 * MIN_GROUP:
                members, gain = part.group()
                if MIN_GROUP <= members.sum() <= len(runs) - MIN_GROUP:
                    factor, search = _of_photographs(members, runs, run, m), (len(runs) - 1) * np.log(2)
                    grown = Pattern("group", factor, search, among)
                    yield score_alternative(reduced, family, grown, gain, part.spread(members, gain))


def _shapes_of_control(reduced: Reduced, columns: Columns) -> Iterator[Alternative]:
    """Yield the alternatives of strained or bent control, which affects all photographs alike."""
    for family in OF_PHOTOGRAPHS:
        if not family.of_camera:
            yield from _in_all(reduced, family, columns.freedoms[:, :, list(family.places)])


def cameras_of_photographs(a: Adjustment) -> IntArray:
    """Return the camera number of each photograph, (m,); cameras that share parameters count as one.

    Args:
        a: adjustment.
    """
    names = [camera.shared_name for camera in a.estimate.cameras]
    _, number = np.unique([names[k] for k in a.network.camera], return_inverse=True)
    return np.asarray(number)


def photographs_among(family: CameraFamily | ObjectFamily, camera: IntArray) -> list[BoolArray]:
    """Return the sets of photographs within which some may differ: those of each camera, or all, (m,) each.

    More than MAX_RUNS cameras are too many to test.

    Args:
        family: family of a camera or of the object.
        camera: camera of each photograph, see `cameras_of_photographs`, (m,).
    """
    if not family.of_camera:
        return [np.ones(len(camera), dtype=bool)]
    return [] if too_many_cameras(camera) else [camera == k for k in range(int(camera.max()) + 1)]


def _of_photographs(factor: FloatArray, runs: IntArray, run: IntArray, count: int) -> FloatArray:
    """Return the factors of photographs, (m,), from the factors of some runs, with 0 in the others."""
    every = np.zeros(count)
    every[runs] = factor
    return every[run]


def _each(
    reduced: Reduced, H: FloatArray, g: FloatArray, squares: FloatArray, run: IntArray
) -> Iterator[Alternative]:
    """Yield the alternatives of a per-photograph camera.

    Such a camera must exceed, by an F test, the effect of all other freedoms of the photographs once it is
    included. Errors common to the image points of a photograph need not come from the camera.
    """
    m, f = g.shape
    for family in OF_EACH:
        some = np.array(family.places)
        rest = np.setdiff1d(np.arange(f), some)
        q, p = m * len(some), m * len(rest)
        of_some = H[:, some][:, :, :, some].reshape(q, q)
        gain = gain_of(of_some, g[:, some].ravel(), squares[:, some].ravel())
        if not log_probability(gain.value, gain.rank, reduced.redundancy) < np.log(ALPHA):
            continue
        cross = H[:, rest][:, :, :, some].reshape(p, q)
        inverse = determined_inverse(of_some, squares[:, some].ravel())
        others = gain_of(
            H[:, rest][:, :, :, rest].reshape(p, p) - cross @ inverse @ cross.T,
            g[:, rest].ravel() + cross @ gain.beta,
            squares[:, rest].ravel(),
        )
        spread = Spread(others.value / others.rank, others.rank, among=False) if others.rank else NONE
        yield score_alternative(reduced, family, Pattern("each", run.astype(float), parts=m), gain, spread)


def _variance_of(reduced: Reduced, some: BoolArray, gain: Gain) -> float:
    """Return the variance that remains in some photographs, (m,), relative to that of all photographs."""
    v = reduced.v[some[reduced.image]]
    expected = v.size * reduced.redundancy / reduced.count
    return float(max((v**2).sum() - gain.value, 0.0) / max(expected - gain.rank, 1.0))


@dataclass(frozen=True)
class SecondPlace:
    """A point that some photographs show at another position."""

    point: int
    distance: float  # between both positions, object unit
    over_sigma: float  # the same in standard deviations of the difference
    images: IntArray  # photographs that show it there


def explain_rejections(
    a: Adjustment, *, unit: str = "", bodies: Sequence[Collection[str]] = ()
) -> tuple[Remark, ...]:
    """Return remarks that explain the rejected image points of an adjustment.

    Args:
        a: finished adjustment.
        unit: object unit, for the remarks.
        bodies: names of the points of each rigid body, such as a plate, that may move relative to the others.
    """
    if not a.rejected.any() or not a.sigma0 > 0 or a.undetermined:
        return ()
    misnamed = _other_points(a)
    pairs, rest = _exchanged(a, misnamed)
    remarks = [
        remark(
            "names_exchanged",
            first=a.network.points[p],
            second=a.network.points[q],
            photographs=tuple(a.network.images[i] for i in images),
        )
        for (p, q), images in sorted(pairs.items())
    ]
    if rest:
        seen = a.network.image_points
        remarks.append(
            remark(
                "image_points_misnamed",
                count=len(rest),
                photographs=tuple(sorted({a.network.images[seen.image[row]] for row in rest})),
            )
        )
    used = set(rest) | {row for row, q in misnamed.items() if _key(a, row, q) in pairs}
    return (*remarks, *_of_places(a, _second_places(a, used), unit, bodies))


def _other_points(a: Adjustment) -> dict[int, int]:
    """Return the rejected image points that lie where another point is expected, with that point."""
    network, estimate, seen = a.network, a.estimate, a.network.image_points
    rejected = np.flatnonzero(a.rejected)
    tolerance = float(np.sqrt(MAX_PREDICTION_RATIO * chi2_isf(ALPHA, 2))) * a.sigma0_px
    found: dict[int, int] = {}
    for i, rows in enumerate(rows_of(seen.image[rejected], len(network.images))):
        if not len(rows):
            continue
        camera = estimate.cameras[network.camera[i]]
        at = project(camera, estimate.position[i], estimate.rotation[i], estimate.points)
        for row in rejected[rows].tolist():
            away = np.linalg.norm(at - seen.xy[row], axis=1)
            away[seen.point[row]] = np.inf
            q = int(np.nanargmin(away)) if np.isfinite(away).any() else -1
            if q >= 0 and away[q] < tolerance:
                found[row] = q
    return found


def _key(a: Adjustment, row: int, q: int) -> tuple[int, int]:
    p = int(a.network.image_points.point[row])
    return min(p, q), max(p, q)


def _exchanged(a: Adjustment, misnamed: dict[int, int]) -> tuple[dict[tuple[int, int], list[int]], list[int]]:
    """Return the point pairs exchanged in several photographs, with these, and the remaining image points."""
    seen = a.network.image_points
    where: dict[tuple[int, int], dict[int, list[int]]] = defaultdict(lambda: defaultdict(list))
    for row, q in misnamed.items():
        where[_key(a, row, q)][int(seen.image[row])].append(row)
    pairs, rest = {}, []
    for key, images in where.items():
        both = [i for i, rows in images.items() if len(rows) == 2]
        if len(both) >= MIN_EXCHANGED:
            pairs[key] = sorted(images)
        else:
            rest += [row for rows in images.values() for row in rows]
    return pairs, rest


def _second_places(a: Adjustment, explained: set[int]) -> list[SecondPlace]:
    """Return the points with rejected rays that meet at another position."""
    seen = a.network.image_points
    left = np.array([row for row in np.flatnonzero(a.rejected).tolist() if row not in explained], dtype=int)
    places = []
    for j in np.unique(seen.point[left]).tolist():
        out = left[seen.point[left] == j]
        kept = np.flatnonzero((seen.point == j) & ~a.rejected)
        if len(out) < MIN_RAYS or len(kept) < 2:
            continue
        X, Q, misfit = intersect_rays(a, out)
        first, Q0, _ = intersect_rays(a, kept)
        if not np.isfinite(misfit) or chi2_sf(misfit, 2 * len(out) - 3) < ALPHA:
            continue
        apart = X - first
        over = float(np.sqrt(apart @ np.linalg.pinv(Q + Q0) @ apart))
        if chi2_sf(over**2, 3) < ALPHA / len(left):
            places.append(SecondPlace(j, float(np.linalg.norm(apart)), over, np.sort(seen.image[out])))
    return places


def _of_places(
    a: Adjustment, places: list[SecondPlace], unit: str, bodies: Sequence[Collection[str]] = ()
) -> list[Remark]:
    """Return remarks on points that moved together at one photograph, and on each other point.

    Points that are most of one of several bodies, and nothing else, are reported as that body.
    """
    names = a.network.images
    together: dict[int, list[SecondPlace]] = defaultdict(list)
    alone = []
    for one in places:
        others = _kept_images(a, one.point)
        if one.images.min() > others.max() or one.images.max() < others.min():
            together[int(max(one.images.min(), others.min()))].append(one)
        else:
            alone.append(one)
    moved = {start: {a.network.points[one.point] for one in some} for start, some in together.items()}
    of_body = {
        start
        for start, points in moved.items()
        if len(bodies) > 1 and any(points <= set(one) and 2 * len(points) > len(one) for one in bodies)
    }
    remarks = [
        remark(
            "plate_moved" if start in of_body else "points_moved",
            points=tuple(a.network.points[one.point] for one in some),
            distance=(max(one.distance for one in some), unit),
            shift=max(one.over_sigma for one in some),
            wrong=0.0,  # rejected image points do not shift the others
            **{"from": names[start]},
        )
        for start, some in sorted(together.items())
    ]
    return remarks + [
        remark(
            "two_places",
            point=a.network.points[one.point],
            distance=(one.distance, unit),
            sigmas=one.over_sigma,
            photographs=tuple(names[i] for i in one.images),
        )
        for one in alone
    ]


def _kept_images(a: Adjustment, point: int) -> IntArray:
    seen = a.network.image_points
    return np.asarray(seen.image[(seen.point == point) & ~a.rejected])
