"""Tie points: points of natural texture found in several photographs and measured by least squares matching.

SIFT features have descriptors that depend neither on scale nor on rotation. They are matched pair by pair,
and matches that fit an epipolar geometry are kept. Features connected over all photographs form one point.
Each point has a reference, the photograph that shows it best. In the reference the point is moved to the most
precise position nearby. Least squares matching then transfers it into the other photographs. It starts from
the scales and directions of the features.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from sfm.matching.correlation import MIN_CORRELATION
from sfm.matching.lsm.two_photo import LsmSettings, match_lsm
from sfm.matching.radiometry import GreyPhotographs
from sfm.matching.tracks.features import (
    EPIPOLAR_PX,
    MIN_PAIR_MATCHES,
    Features,
    TwoMotions,
)
from sfm.matching.tracks.interest import NaturalPoints
from sfm.matching.tracks.matched_pairs import MatchedPairs, Matches
from sfm.matching.tracks.overlap import (
    compare_parts,
    compare_photographs,
    connected_parts,
    connecting_pairs,
    overlapping_pairs,
)
from sfm.model.arguments import checked_arguments, checked_fields
from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.model.display import counted
from sfm.model.errors import GeometryError
from sfm.model.network import rows_of
from sfm.runtime.compiling import compiled
from sfm.runtime.progress import reported
from sfm.runtime.threads import in_threads

WINDOW_PX = 15  # larger windows are less noisy, but over them an affine warp cannot follow a curved surface
SNAP_PX = 6.0  # an interest point this close to a feature replaces its position


@dataclass(frozen=True)
class Tracks:
    """The features that belong to each point."""

    image: IntArray  # (k,)
    feature: IntArray  # index among the features of that photograph, (k,)
    point: IntArray  # 0 to n - 1, sorted, (k,)
    still: FloatArray  # share of the matched features of each photograph that stand still, (m,)


@dataclass(frozen=True)
class TiePoints:
    """Image points of natural texture."""

    image: IntArray  # index of the photograph, (k,)
    point: IntArray  # 0 to n - 1, (k,)
    xy: FloatArray  # px, (k, 2)
    covariance: FloatArray  # px^2, (k, 2, 2)
    reference: IntArray  # the photograph in which each point was chosen, (n,)
    still: FloatArray  # share of the matched features of each photograph that stand still, (m,)

    def __len__(self) -> int:
        return len(self.image)


@checked_fields
@dataclass(frozen=True)
class TrackSettings:
    """Settings of the measurement of natural points in several photographs."""

    window_px: int = WINDOW_PX  # odd side of the window of least squares matching
    min_rays: int = 3  # fewest photographs per point
    min_image_points: int = 0  # a photograph with fewer image points also receives its points with two rays
    min_correlation: float = MIN_CORRELATION  # smallest coefficient r of a match


@checked_arguments()
def find_tie_points(
    photographs: Sequence[AnyArray],
    natural: Sequence[NaturalPoints],
    settings: TrackSettings = TrackSettings(),
    *,
    seed: int = 0,
    threads: int = 1,
    known: MatchedPairs | None = None,
    neighbours: Sequence[IntArray] = (),
    pairs: IntArray | None = None,
) -> TiePoints:
    """Find and measure points common to several photographs, without any knowledge of their orientation.

    Args:
        photographs: m photographs, (H, W), 8 or 16 bit, grey or colour.
        natural: the result of `natural_points` for each of them.
        settings: windows, and what a point needs.
        seed: seed of the random samples.
        threads: number of pairs of photographs matched at the same time.
        known: see `link_features`.
        neighbours: see `link_features`.
        pairs: see `link_features`.

    Returns:
        The tie points; n may be 0.

    Raises:
        GeometryError: no photographs, or a different number of photographs and natural points.

    Source: Lowe (2004), IJCV 60(2), for the features; Foerstner and Guelch (1987) for the positions; Gruen
    (1985) for the measurement.
    """
    if not photographs or len(natural) != len(photographs):
        raise GeometryError(
            f"find_tie_points: {counted(len(photographs), 'photograph')} and natural points of "
            f"{len(natural)}, expected those of each"
        )
    m, fewest = len(photographs), settings.min_rays
    if settings.min_image_points:
        fewest = min(2, fewest)
    tracks = link_features(
        natural,
        min_rays=fewest,
        seed=seed,
        threads=threads,
        known=known,
        neighbours=neighbours,
        pairs=pairs,
    )
    kept = _needed(tracks.image, tracks.point, m, settings)
    _, point = np.unique(tracks.point[kept], return_inverse=True)
    return measure_tracks(
        photographs,
        natural,
        Tracks(tracks.image[kept], tracks.feature[kept], point.ravel(), tracks.still),
        settings,
        threads=threads,
    )


def _needed(image: IntArray, point: IntArray, m: int, settings: TrackSettings) -> BoolArray:
    """Return which image points belong to points with enough rays, or with two where needed, (k,)."""
    n = int(point.max(initial=-1)) + 1
    rays = np.bincount(point, minlength=n)
    enough = rays >= settings.min_rays
    scarce = np.bincount(image[enough[point]], minlength=m) < settings.min_image_points
    enough |= (rays >= 2) & (np.bincount(point[scarce[image]], minlength=n) > 0)
    return np.asarray(enough[point])


def link_features(
    features: Sequence[Features],
    *,
    min_rays: int = 3,
    seed: int = 0,
    threads: int = 1,
    known: MatchedPairs | None = None,
    neighbours: Sequence[IntArray] = (),
    pairs: IntArray | None = None,
) -> Tracks:
    """Match the features of overlapping photographs and combine the features that belong to one point.

    If the matches leave the photographs in several separate parts, pairs between these are matched as well.

    A point has at most one feature in each photograph. The most distinctive matches are used first. A match
    that would join two features of one photograph is skipped, so a wrong match splits a track but does not
    lose it. Features that stand still before a camera that does are no points.

    Args:
        features: features of m photographs.
        min_rays: fewest photographs per point.
        seed: seed of the random samples.
        threads: number of pairs compared and matched at the same time.
        known: matches of pairs of photographs that need not be matched again; new matches are added to them.
        neighbours: photographs taken near each photograph, see `overlapping_pairs`.
        pairs: the only pairs of photographs that are matched, i < j, (p, 2); those that overlap if not given.
    """
    known = MatchedPairs() if known is None else known
    first = np.concatenate([[0], np.cumsum([len(of_photograph) for of_photograph in features])]).astype(
        np.int64
    )

    def match(of: IntArray) -> _MatchedFeatures:
        return _matched_features(known.add(features, of, seed=seed, threads=threads), features, first)

    if pairs is not None:
        matched = match(pairs)
    else:
        compared = compare_photographs(features, neighbours=neighbours, seed=seed, threads=threads)
        overlapping = overlapping_pairs(compared, neighbours=neighbours)
        matched = match(overlapping)
        part = connected_parts(overlapping[np.unique(matched.pair)], len(features))
        if part.max(initial=0):
            compared = compare_parts(features, compared, part, seed=seed, threads=threads)
            matched = match(np.concatenate([overlapping, connecting_pairs(compared, part, overlapping)]))
    image = np.repeat(np.arange(len(features)), np.diff(first))
    edge = matched.edge[np.argsort(-matched.distinct, kind="stable")]
    group = joined_features(edge, image, len(features))
    size = np.bincount(group, minlength=len(group))
    rows = np.flatnonzero(size[group] >= min_rays)
    _, point = np.unique(group[rows], return_inverse=True)
    order = np.argsort(point, kind="stable")
    rows = rows[order]
    return Tracks(image[rows], rows - first[image[rows]], point[order], matched.still)


class _MatchedFeatures(NamedTuple):
    """Matches between the features of all photographs, numbered together."""

    edge: IntArray  # the two features of a match, (e, 2)
    distinct: FloatArray  # see `sfm.matching.tracks.features.PairMatches`, (e,)
    pair: IntArray  # number of the pair of photographs, (e,)
    still: FloatArray  # see `Tracks`, (m,)


def _matched_features(matches: Matches, features: Sequence[Features], first: IntArray) -> _MatchedFeatures:
    """Return the matches of all pairs, without the features that stand still before a camera that does.

    It does if more than half of the photographs are connected by pairs in which some features stand still and
    the others agree on another motion: an object turns before its background, or writing is burned into the
    photographs. Features that stand still in a pair of these photographs and move in none are left out.
    Where a camera on a tripod takes each of several places twice, what stands still is the object itself.

    Args:
        matches: matches of each pair.
        features: features of m photographs.
        first: number of the first feature of each photograph, and the number of all, (m + 1,).
    """
    m, xy = len(features), np.concatenate([of_photograph.xy for of_photograph in features])
    pairs = np.array(list(matches), dtype=np.int64).reshape(-1, 2)
    camera = connected_parts(pairs[[match.motions is not None for match in matches.values()]], m)
    sizes = np.bincount(camera)
    standing = (camera == np.argmax(sizes)) & (2 * sizes.max() > m)
    inside = standing[pairs].all(axis=1)
    used = [
        match.motions if within and match.motions is not None else match
        for match, within in zip(matches.values(), inside.tolist(), strict=True)
    ]
    none = np.zeros((0, 2), dtype=np.int64)
    edge = np.concatenate([none, *(match.rows + first[row] for match, row in zip(used, pairs, strict=True))])
    distinct = np.concatenate([np.zeros(0), *(match.distinct for match in used)])
    pair = np.repeat(np.arange(len(used)), [len(match.rows) for match in used])
    moves = np.linalg.norm(xy[edge[:, 0]] - xy[edge[:, 1]], axis=1) > EPIPOLAR_PX
    beside = [
        match.still + first[row]
        for match, row in zip(used, pairs, strict=True)
        if isinstance(match, TwoMotions)
    ]
    stands = np.concatenate([none, *beside, edge[inside[pair] & ~moves]])
    still, moving, seen = (
        np.isin(np.arange(len(xy)), rows) for rows in (stands, edge[moves], np.concatenate([edge, stands]))
    )
    still &= ~moving
    kept = ~still[edge].any(axis=1)
    kept &= (np.bincount(pair[kept], minlength=len(used)) >= MIN_PAIR_MATCHES)[pair]
    photograph = np.repeat(np.arange(m), np.diff(first))
    share = np.bincount(photograph[still], minlength=m) / np.maximum(
        np.bincount(photograph[seen], minlength=m), 1
    )
    return _MatchedFeatures(edge[kept], distinct[kept], pair[kept], share)


@compiled
def joined_features(edge: IntArray, image: IntArray, m: int) -> IntArray:
    """Return the group of every feature (the number of its first feature), no photograph twice in any, (k,).

    Args:
        edge: matches, the most distinctive first, (e, 2).
        image: photograph of each feature, (k,).
        m: number of photographs.
    """
    k = len(image)
    group, following, last = np.arange(k), np.full(k, -1), np.arange(k)
    stamp = np.full(m, -1)
    for e in range(len(edge)):
        a, b = group[edge[e, 0]], group[edge[e, 1]]
        if a == b:
            continue
        member = a
        while member >= 0:
            stamp[image[member]] = e
            member = following[member]
        free, member = True, b
        while member >= 0 and free:
            free = stamp[image[member]] != e
            member = following[member]
        if not free:
            continue
        member = b
        while member >= 0:
            group[member] = a
            member = following[member]
        following[last[a]] = b
        last[a] = last[b]
    return group


def measure_tracks(
    photographs: Sequence[AnyArray],
    natural: Sequence[NaturalPoints],
    tracks: Tracks,
    settings: TrackSettings = TrackSettings(),
    *,
    threads: int = 1,
) -> TiePoints:
    """Measure the points of tracks by least squares matching from their references.

    The reference is the photograph with the middle feature scale of the point, because the template should be
    neither the finest nor the coarsest image. Matching measures a difference of two noises. Half of its
    covariance is assigned to the point in the reference, half to the point in the other photograph.

    Args:
        photographs: m photographs.
        natural: natural points of each photograph; corners near features replace their positions.
        tracks: the features that belong to each point.
        settings: windows, and what a point needs.
        threads: number of pairs of photographs matched at the same time.
    """
    xy = _values_of_tracks([points.xy for points in natural], tracks)
    scale = _values_of_tracks([points.scale for points in natural], tracks)
    angle = _values_of_tracks([points.angle for points in natural], tracks)
    n = int(tracks.point.max(initial=-1)) + 1
    order = np.lexsort([scale, tracks.point])
    first = np.searchsorted(tracks.point[order], np.arange(n))
    count = np.bincount(tracks.point, minlength=n)
    reference = np.asarray(order[first + count // 2])  # the larger of two scales
    position = xy[reference].copy()
    for points, rows in zip(natural, rows_of(tracks.image[reference], len(natural)), strict=True):
        position[rows] = _snapped(position[rows], points.corners)
    position = np.rint(position)  # a template of whole pixels needs no resampling
    ref = reference[tracks.point]
    offset = (position - xy[reference])[tracks.point]
    turn, stretch = angle - angle[ref], scale / scale[ref]
    A = stretch[:, None, None] * np.stack(
        [np.stack([np.cos(turn), -np.sin(turn)], -1), np.stack([np.sin(turn), np.cos(turn)], -1)], axis=1
    )
    start = xy + np.einsum("kij,kj->ki", A, offset)
    measured, covariance = np.full((len(xy), 2), np.nan), np.full((len(xy), 2, 2), np.nan)
    at_reference = np.full((len(xy), 2, 2), np.nan)
    grey = GreyPhotographs(photographs.__getitem__)
    others = np.flatnonzero(tracks.image[ref] != tracks.image)
    pairs, pair = np.unique(
        np.column_stack([tracks.image[ref], tracks.image])[others], axis=0, return_inverse=True
    )

    windows = LsmSettings(window_px=settings.window_px, min_correlation=settings.min_correlation)

    def match(number: int) -> None:
        i, j = pairs[number].tolist()
        rows = others[of_pair[number]]
        matched = match_lsm(
            grey[i],
            grey[j],
            position[tracks.point[rows]],
            start[rows],
            windows,
            start=A[rows],
        )
        measured[rows], covariance[rows] = matched.xy, matched.covariance / 2
        back = np.linalg.inv(matched.warp[:, :2, :2])
        at_reference[rows] = back @ (matched.covariance / 2) @ back.transpose(0, 2, 1)

    of_pair = rows_of(pair.ravel(), len(pairs))
    matches = in_threads(match, range(len(pairs)), threads)
    for _ in reported("pairs of photographs measured", matches, len(pairs)):
        pass
    good = np.isfinite(measured).all(axis=1)
    matched = np.bincount(tracks.point[good], minlength=n)
    for a in range(2):
        for b in range(2):
            total = np.bincount(tracks.point[good], at_reference[good, a, b], minlength=n)
            covariance[reference, a, b] = total / np.maximum(matched, 1)
    measured[reference] = position
    keep = np.flatnonzero(np.isfinite(measured).all(axis=1))
    needed = _needed(tracks.image[keep], tracks.point[keep], len(photographs), settings)
    keep = keep[needed]
    _, point = np.unique(tracks.point[keep], return_inverse=True)
    kept = np.unique(tracks.point[keep])
    return TiePoints(
        tracks.image[keep],
        point,
        measured[keep],
        covariance[keep],
        tracks.image[reference[kept]],
        tracks.still,
    )


def _values_of_tracks(values: Sequence[FloatArray], tracks: Tracks) -> FloatArray:
    """Return the values of the features of tracks, from the values of m photographs, (k, ...)."""
    first = np.cumsum([0, *(len(of_photograph) for of_photograph in values)])
    return np.asarray(np.concatenate(values)[first[tracks.image] + tracks.feature])


def _snapped(xy: FloatArray, corners: FloatArray) -> FloatArray:
    """Return for each position the first (strongest) corner within reach, or the position itself."""
    if not len(xy) or not len(corners):
        return xy
    snapped = xy.copy()
    for k, near in enumerate(cKDTree(corners).query_ball_point(xy, SNAP_PX, return_sorted=True)):
        if near:
            snapped[k] = corners[near[0]]
    return snapped
