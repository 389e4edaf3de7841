"""Conjugate points: find points of one photograph in another by correlation and least squares matching.

Correlation finds the position in a search window to one pixel. Least squares matching starts there and
refines it. Points that are not found this way are searched for again with rotated and scaled templates.

Wide baselines: if two photographs were taken far apart, a patch looks rotated, scaled and sheared, and
correlation finds nothing or the wrong point. Affine maps are therefore estimated first, from the key points
near each point. The descriptors of key points depend neither on scale nor on rotation.

Blur: a photograph that is out of focus, or was moved during exposure, shows less of the texture, and the
patches are no longer similar. The sharper photograph is therefore smoothed to the blur of the other. The
difference of blur can be estimated without conjugate points. The spectra of natural texture all have the same
shape, so the ratio of the spectra of two photographs of one object is the ratio of their blurs.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations

import cv2
import numpy as np

from sfm.matching.conjugate_patches import (
    METHODS,
    ConjugatePoints,
    MatchSettings,
    Starts,
    flag_unconfirmed,
    match_upright,
    match_warped,
)
from sfm.matching.correlation import (
    LsmFlag,
    NccFlag,
    NccLimits,
    ambiguous,
    independent_pixels,
    match_ncc,
    match_ncc_warped,
)
from sfm.matching.radiometry import grey_of, grey_of_8_bit, shrink_photograph
from sfm.matching.tracks.features import Features, match_features, sift_features
from sfm.model.arguments import checked_arguments
from sfm.model.conventions import MAD_TO_SIGMA, AnyArray, FloatArray, IntArray
from sfm.model.display import in_words
from sfm.model.errors import GeometryError

TILE_PX = 128  # side of the squares whose spectra are averaged
LOBE = 2  # frequencies on either side over which the window of a tile spreads each frequency
NOISE_FREQUENCIES = 6  # the highest frequencies of a tile, at which photographs contain only noise
MIN_SIGNAL_TO_NOISE = 3.0  # of the power at a frequency that is compared
MIN_FREQUENCIES = 4  # for the two parameters that are fitted
MIN_DEVIATE = 4.0  # of a difference of blur, in standard deviations: neighbouring frequencies are correlated
SHARP_PX = 0.7  # blur that leaves 9 % of the contrast at two pixels a cycle, and nearly nothing beyond
MAX_TILES = 200  # spread over the photograph
NEAR_KEY_POINTS = 12  # key points nearest to a point
MIN_AGREEING = 6  # of these, on one affine map: three determine it, and three confirm it
FARTHEST_PX = 150.0  # of the third-nearest key point: farther away it may lie on another surface
MARGIN_PX = 300.0  # around the points, within which key points are extracted
MAX_STRETCH = 4.0  # largest ratio of lengths that a map may have in any direction
LOCALISATION_PX = 1.0  # smallest standard deviation of a key point
GROSS_SPREADS = 3.0  # multiple of the robust spread beyond which a key point belongs to another map
MAX_SPREAD_PX = 5.0  # of the key points of one map; with a large spread, half of any set fits some map
MAX_FEATURES = 10_000
TRIPLES = np.array(list(combinations(range(NEAR_KEY_POINTS), 3)))
# Smallest area of a triangle of key points, as a fraction of the squared extent of all of them.
MIN_TRIANGLE_FRACTION = 1e-3
# Correlation tolerates a rotation of 5 degrees and a scale of 7 % between template and photograph.
ANGLES_DEG = (-30.0, -20.0, -10.0, 0.0, 10.0, 20.0, 30.0)
SCALES = (1 / 1.3, 1 / 1.14, 1.0, 1.14, 1.3)
SAME_PX = 5.0  # peaks of two shapes closer than this are the same position
REACH_PX = 3  # of the match that follows
OWN_PX = 500  # around a point, within which similar patches are searched for
MIN_TEMPLATE_PX = 7  # smaller templates match almost anything once they are rotated and scaled
REACH_SIGMAS = 3.0  # of the position that key points predict
MIN_REACH_PX = 4  # of that search
# Reasons to try a larger template, which shows more: a second position is as good, or there is hardly any
# texture.
TOO_LITTLE_TEXTURE = (in_words(NccFlag, NccFlag.AMBIGUOUS), in_words(LsmFlag, LsmFlag.FLAT_TEXTURE))


class KeyPoints:
    """Key points of photographs, extracted once although each photograph is matched with several others.

    They are kept as long as the array of the photograph is: one that is smoothed to be as blurred as another
    photograph is another array.
    """

    def __init__(self) -> None:
        """Start empty."""
        self._kept: dict[int, tuple[weakref.ref[AnyArray], dict[tuple[int, ...], Features]]] = {}

    def of(self, photograph: AnyArray, part: tuple[int, int, int, int], max_features: int) -> Features:
        """Return the key points of a part of a photograph, in px of that part.

        Args:
            photograph: (H, W), 8 or 16 bit or float, grey or colour; not to be changed afterwards.
            part: first column and row, and the column and row after the last.
            max_features: largest number of key points; the strongest are kept.
        """
        number = id(photograph)
        kept = self._kept.get(number)
        if kept is None or kept[0]() is not photograph:
            kept = weakref.ref(photograph, lambda _: self._kept.pop(number, None)), {}
            self._kept[number] = kept
        key = (*part, max_features)
        if key not in kept[1]:
            left, top, right, bottom = part
            kept[1][key] = sift_features(photograph[top:bottom, left:right], max_features=max_features)
        return kept[1][key]


@checked_arguments(xy_left="k 2", xy_right="k 2")
def match_points(
    left: AnyArray,
    right: AnyArray,
    xy_left: FloatArray,
    settings: MatchSettings = MatchSettings(),
    *,
    xy_right: FloatArray | None = None,
    key_points: KeyPoints | None = None,
) -> ConjugatePoints:
    """Find points of the left photograph in the right one.

    A point that is not found upright in its search window is searched for again (`wide`). If the key points
    around it agree on an affine map to the right photograph, the position and shape of that map are used.
    Otherwise the template is rotated by up to 30 degrees and scaled by up to 1.3 within the search window.
    Points that are ambiguous or have no texture are tried once more with templates twice as large.

    If one photograph is more blurred, the other is smoothed to match it. Both are then reduced until that
    blur is the blur of a sharp photograph. Templates and windows keep their number of pixels, but of the
    larger pixels.

    Args:
        left: photograph, (H, W), 8 or 16 bit or float, grey or colour.
        right: the other photograph.
        xy_left: points in the left photograph, px, (k, 2).
        settings: method, sizes of template and search window, and limits of a match.
        xy_right: centres of the search windows, px, (k, 2); by default the positions in the left photograph.
            If they are given, positions predicted by key points must lie within the windows.
        key_points: those of both photographs, shared by the calls that match them with others.

    Returns:
        One result per point.

    Raises:
        GeometryError: unknown method, even windows, or different numbers of left and right points.

    Source: document 002, sec. 2 (equations 2.1 to 2.20).
    """
    if settings.method not in METHODS:
        raise GeometryError(f"matching: method '{settings.method}', expected one of {', '.join(METHODS)}")
    a = np.asarray(xy_left, dtype=float).reshape(-1, 2)
    b = a if xy_right is None else np.asarray(xy_right, dtype=float).reshape(-1, 2)
    seen = equally_blurred(left, right)
    side = settings.template_px
    reach = -(-((settings.search_px - side) // 2) // seen.shrink)
    back = None if settings.back_px is None else settings.back_px / seen.shrink
    wide = settings.wide and side >= MIN_TEMPLATE_PX
    by = replace(settings, search_px=side + 2 * reach, back_px=back, wide=wide)
    shared = KeyPoints() if key_points is None else key_points
    matched = _match_by_size(
        seen.left,
        seen.right,
        seen.small(a),
        seen.small(b),
        by,
        given=xy_right is not None,
        key_points=shared,
    )
    right_xy = np.where(matched.good[:, None], seen.full(matched.right), np.nan)
    covariance = np.where(matched.good[:, None, None], seen.shrink**2 * matched.covariance, np.nan)
    warp = matched.warp.copy()
    warp[:, :2, 2], warp[:, 2, :2] = seen.full(warp[:, :2, 2]), warp[:, 2, :2] / seen.shrink
    return replace(matched, left=a, right=right_xy, covariance=covariance, warp=warp)


def _match_by_size(
    left: AnyArray,
    right: AnyArray,
    a: FloatArray,
    b: FloatArray,
    by: MatchSettings,
    *,
    given: bool,
    key_points: KeyPoints,
) -> ConjugatePoints:
    """Match points with templates of the requested size, and with larger ones where these show too little.

    Args:
        left: the left photograph.
        right: the right photograph.
        a: points in the left photograph, px, (k, 2).
        b: centres of the search windows, px, (k, 2).
        by: matching settings.
        given: whether the caller gave the centres; if not, they are the positions in the left photograph.
        key_points: those of the photographs.
    """
    if not by.wide:
        return flag_unconfirmed(left, right, match_upright(left, right, a, b, by), by)

    @cache
    def predicted() -> LocalAffinities:
        """Return the maps of the key points, which take long and are not needed if all points are found."""
        maps = local_affinities(left, right, a, key_points=key_points)
        if given:
            maps.xy[~(np.abs(maps.xy - b) <= by.search_px // 2).all(axis=1)] = np.nan
        return maps

    matched = _match(left, right, a, b, by, predicted, given=given)
    few = np.flatnonzero([why in TOO_LITTLE_TEXTURE for why in matched.reason])
    if len(few):
        more = by.template_px - 1
        larger = replace(by, template_px=by.template_px + more, search_px=by.search_px + more)
        again = _match(left, right, a[few], b[few], larger, lambda: predicted().rows(few), given=given)
        matched = matched.with_rows(few[again.good], again.rows(again.good))
    return matched


def _match(
    left: AnyArray,
    right: AnyArray,
    a: FloatArray,
    b: FloatArray,
    by: MatchSettings,
    predicted: Callable[[], LocalAffinities],
    *,
    given: bool,
) -> ConjugatePoints:
    """Match points with templates of one size: upright, then as key points predict, or else rotated.

    Args:
        left: the left photograph.
        right: the right photograph.
        a: points in the left photograph, px, (k, 2).
        b: centres of the search windows, px, (k, 2).
        by: matching settings.
        predicted: returns the positions and shapes that the key points predict.
        given: whether the caller gave the centres; if not, they are the positions in the left photograph.
    """
    matched = flag_unconfirmed(left, right, match_upright(left, right, a, b, by), by)
    lost = np.array([bool(why) and "left photograph" not in why for why in matched.reason], dtype=bool)
    if not lost.any():
        return matched
    maps = predicted()
    led = np.isfinite(maps.xy).all(axis=1)
    rows = np.flatnonzero(lost & led)
    if len(rows):
        least = np.ceil(REACH_SIGMAS * maps.spread_px[rows]).astype(np.int64)
        reach = np.maximum(least, MIN_REACH_PX)
        again = match_warped(left, right, a[rows], Starts(maps.xy[rows], maps.linear[rows], reach), by)
        again = flag_unconfirmed(left, right, again, by, 2 * reach)
        matched = matched.with_rows(rows[again.good], again.rows(again.good))
    rows = np.flatnonzero(lost & ~led)
    if len(rows):
        again = match_turned(left, right, a[rows], b[rows], by, given=given)
        again = flag_unconfirmed(left, right, again, by, np.full(len(rows), by.reach_px))
        matched = matched.with_rows(rows[again.good], again.rows(again.good))
    return matched


def match_turned(
    left: AnyArray,
    right: AnyArray,
    xy_left: FloatArray,
    xy_right: FloatArray,
    by: MatchSettings,
    *,
    given: bool,
) -> ConjugatePoints:
    """Match points whose templates appear rotated by up to 30 degrees and scaled by up to 1.3 on the right.

    The best two positions of all shapes are matched. The better one is accepted if it is better by more than
    chance. With steps of 10 degrees the templates are not similar enough to decide before matching.

    Args:
        left: the left photograph.
        right: the right photograph.
        xy_left: points in the left photograph, px, (k, 2).
        xy_right: centres of the search windows, px, (k, 2).
        by: matching settings.
        given: whether the centres are known. If not, the point may lie outside its window, and the window may
            contain a similar patch. The template must then be unique in the left photograph within OWN_PX.
    """
    best, rival, second = _starts(left, right, xy_left, xy_right, by)
    first, other = (match_warped(left, right, xy_left, start, by) for start in (best, rival))
    swap = other.good & ~(first.good & (first.correlation >= other.correlation))
    r = np.where(swap, other.correlation, first.correlation)
    lesser, is_other = (
        np.where(swap, first.correlation, other.correlation),
        np.where(swap, first.good, other.good),
    )
    second = np.where(is_other, np.fmax(lesser, second), second)
    if not given:
        to_left = match_ncc(
            left, left, xy_left, xy_left, template_px=by.template_px, search_px=2 * OWN_PX + 1
        )
        second = np.fmax(second, to_left.second)
    pixels = independent_pixels(grey_of(left), xy_left, by.template_px)
    doubt = first.good | other.good
    doubt &= ambiguous(r, second, pixels)
    reason = np.where(swap, np.array(other.reason, dtype=object), np.array(first.reason, dtype=object))
    reason[doubt] = in_words(NccFlag, NccFlag.AMBIGUOUS)
    chosen = first.with_rows(np.flatnonzero(swap), other.rows(swap))
    return replace(chosen, second=second, reason=tuple(reason.tolist()))


def _starts(
    left: AnyArray, right: AnyArray, xy_left: FloatArray, xy_right: FloatArray, by: MatchSettings
) -> tuple[Starts, Starts, FloatArray]:
    """Return the best position of all shapes, the best one elsewhere, and the second r of that best shape."""
    grey_left, grey_right = grey_of_8_bit(left), grey_of_8_bit(right)
    shapes, peaks, r, second = [], [], [], []
    for angle in np.radians(ANGLES_DEG):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        for scale in SCALES:
            linear = np.tile(scale * turn, (len(xy_left), 1, 1))
            correlated = match_ncc_warped(
                grey_left,
                grey_right,
                xy_left,
                xy_right,
                linear,
                reach_px=np.full(len(xy_left), max(round(by.reach_px / scale), 1)),
                template_px=by.template_px,
                limits=NccLimits(by.start_correlation),
            )
            shapes.append(linear)
            peaks.append(correlated.peak)
            r.append(np.nan_to_num(correlated.correlation, nan=-1.0))
            second.append(np.nan_to_num(correlated.second, nan=-1.0))
    every, positions, rows = np.array(r), np.array(peaks), np.arange(len(xy_left))
    best = every.argmax(axis=0)
    elsewhere = np.where(np.linalg.norm(positions - positions[best, rows], axis=2) > SAME_PX, every, -1.0)
    rival = elsewhere.argmax(axis=0)
    starts = []
    for number, least in ((best, every[best, rows]), (rival, elsewhere[rival, rows])):
        position = np.where((least >= by.start_correlation)[:, None], positions[number, rows], np.nan)
        starts.append(Starts(position, np.array(shapes)[number, rows], np.full(len(rows), REACH_PX)))
    return starts[0], starts[1], np.array(second)[best, rows]


@dataclass(frozen=True)
class LocalAffinities:
    """Positions of points in the other photograph, and their rotation and scale there; NaN if unknown."""

    xy: FloatArray  # position in the right photograph, px, (k, 2)
    linear: FloatArray  # right px per left px, (k, 2, 2)
    spread_px: FloatArray  # standard deviation of the position along an axis, right px, (k,)

    def rows(self, rows: IntArray) -> LocalAffinities:
        """Return the entries of some points."""
        return LocalAffinities(self.xy[rows], self.linear[rows], self.spread_px[rows])


def local_affinities(
    left: AnyArray,
    right: AnyArray,
    xy: FloatArray,
    *,
    key_points: KeyPoints,
    max_features: int = MAX_FEATURES,
    seed: int = 0,
) -> LocalAffinities:
    """Return the affine map around each point on which the key points near it agree.

    Args:
        left: photograph, (H, W), 8 or 16 bit or float, grey or colour.
        right: the other photograph.
        xy: points in the left photograph, px, (k, 2).
        key_points: those of the photographs.
        max_features: largest number of key points per photograph; the strongest are kept.
        seed: seed of the random samples for the epipolar geometry.

    Source: Lowe (2004), IJCV 60(2), for the key points; Rousseeuw (1984), J. Am. Stat. Assoc. 79, for the
    least median of squares over all triples of the nearest key points.
    """
    at = np.asarray(xy, dtype=float).reshape(-1, 2)
    if not len(at):
        return affinities_around(at, at, at)
    low = np.maximum(np.floor(at.min(axis=0) - MARGIN_PX), 0).astype(int)  # only the part near points matters
    high = np.minimum(np.ceil(at.max(axis=0) + MARGIN_PX).astype(int), left.shape[1::-1])
    x, y = low.tolist()
    a = key_points.of(left, (x, y, *high.tolist()), max_features)
    b = key_points.of(right, (0, 0, right.shape[1], right.shape[0]), max_features)
    pairs = match_features(a, b, seed=seed)
    return affinities_around(a.xy[pairs[:, 0]] + low, b.xy[pairs[:, 1]], at)


def affinities_around(key_left: FloatArray, key_right: FloatArray, xy: FloatArray) -> LocalAffinities:
    """Return the affine maps around points, px, (k, 2), from conjugate key points, px, (m, 2) each."""
    at = np.asarray(xy, dtype=float).reshape(-1, 2)
    maps = LocalAffinities(
        np.full((len(at), 2), np.nan), np.full((len(at), 2, 2), np.nan), np.full(len(at), np.nan)
    )
    if len(key_left) < NEAR_KEY_POINTS:
        return maps
    for k, point in enumerate(at):
        if not np.isfinite(point).all():
            continue
        distance = np.linalg.norm(key_left - point, axis=1)
        near = np.argpartition(distance, NEAR_KEY_POINTS - 1)[:NEAR_KEY_POINTS]
        if np.sort(distance[near])[2] > FARTHEST_PX:
            continue
        agreed = _agreed_map(key_left[near] - point, key_right[near])
        if agreed is not None:
            maps.linear[k], maps.xy[k], maps.spread_px[k] = agreed[0], agreed[1], agreed[2]
    return maps


def _agreed_map(offset: FloatArray, target: FloatArray) -> tuple[FloatArray, FloatArray, float] | None:
    """Return linear part, position of the point and its standard deviation, px; None if too few agree.

    Args:
        offset: key points minus the point, left px, (NEAR_KEY_POINTS, 2).
        target: positions of the key points in the right photograph, px, (NEAR_KEY_POINTS, 2).
    """
    full = np.column_stack([offset, np.ones(len(offset))])  # (n, 3)
    area = np.abs(np.linalg.det(full[TRIPLES]))
    triples = TRIPLES[area > MIN_TRIANGLE_FRACTION * np.ptp(offset, axis=0).max() ** 2]
    if not len(triples):
        return None
    maps = np.linalg.solve(full[triples], target[triples])  # (t, 3, 2)
    off = np.linalg.norm(full @ maps - target, axis=2)  # (t, n)
    best = int(np.median(off, axis=1).argmin())
    spread = max(MAD_TO_SIGMA * float(np.median(off[best])), LOCALISATION_PX)
    if spread > MAX_SPREAD_PX:
        return None
    agree = off[best] <= GROSS_SPREADS * spread
    if agree.sum() < MIN_AGREEING:
        return None
    # near key points predict the position better than far ones, since the surface is curved
    length = np.linalg.norm(offset[agree], axis=1)
    weight = 1.0 / (1.0 + (length / max(float(np.median(length)), 1.0)) ** 2)
    N = full[agree].T @ (weight[:, None] * full[agree])
    if np.linalg.matrix_rank(N) < 3:
        return None
    solved = np.linalg.solve(N, full[agree].T @ (weight[:, None] * target[agree]))
    linear = solved[:2].T
    stretch = np.linalg.svd(linear, compute_uv=False)
    if not (np.linalg.det(linear) > 0 and stretch[0] < MAX_STRETCH and stretch[1] > 1 / MAX_STRETCH):
        return None
    v = full[agree] @ solved - target[agree]
    redundancy = max(2 * int(agree.sum()) - 6, 1)
    variance = max(float((weight[:, None] * v * v).sum()) / redundancy, LOCALISATION_PX**2)
    return linear, solved[2], float(np.sqrt(variance * np.linalg.inv(N)[2, 2]))


@dataclass(frozen=True)
class EquallyBlurred:
    """Two photographs of equal blur, with pixels as large as the blur allows."""

    left: AnyArray
    right: AnyArray
    shrink: int  # side of one of these pixels, px of the photographs that were given

    def small(self, xy: FloatArray) -> FloatArray:
        """Convert positions in the given photographs to positions in these, px, (k, 2)."""
        return (xy + 0.5) / self.shrink - 0.5

    def full(self, xy: FloatArray) -> FloatArray:
        """Convert positions in these photographs to positions in the given ones, px, (k, 2)."""
        return self.shrink * (xy + 0.5) - 0.5


def equally_blurred(left: AnyArray, right: AnyArray) -> EquallyBlurred:
    """Return both photographs with the blur of the less sharp one.

    The sharper one is smoothed by a Gaussian. Both are then averaged over squares, so large that the blur
    becomes SHARP_PX. A window then contains as much texture as a window of a sharp photograph. Its noise is
    the noise of pixels without overlap.

    Args:
        left: photograph of an object, (H, W) or (H, W, 3), 8 or 16 bit or float.
        right: another photograph of the same object.
    """
    more = difference_of_blur(left, right)
    sigma = float(np.sqrt(abs(more)))
    if more != 0.0:
        sharper = left if more > 0.0 else right
        smooth = np.asarray(cv2.GaussianBlur(sharper, (0, 0), sigma))
        left, right = (smooth, right) if more > 0.0 else (left, smooth)
    shrink = max(round(sigma / SHARP_PX), 1)
    return EquallyBlurred(shrink_photograph(left, shrink), shrink_photograph(right, shrink), shrink)


def difference_of_blur(left: AnyArray, right: AnyArray) -> float:
    """Return the difference of the variances of the point spread, right minus left, px^2.

    The result is 0 if the spectra differ by no more than chance, or if noise hides them. Blur is measured in
    the pixels of each photograph: two photographs of different scale, taken with the same lens, are equally
    blurred.

    Source: the Gaussian model of Pentland (1987), A new sense for depth of field, IEEE Trans. PAMI 9(4). The
    logarithm of the ratio of two power spectra is linear in the squared frequency, and its slope is the
    difference of the variances.
    """
    spectra = [_power_spectrum(grey_of_8_bit(photograph)) for photograph in (left, right)]
    if len(spectra[0]) != len(spectra[1]) or len(spectra[0]) <= LOBE + NOISE_FREQUENCIES + MIN_FREQUENCIES:
        return 0.0
    noise = [float(spectrum[-NOISE_FREQUENCIES:].mean()) for spectrum in spectra]
    above = np.all(
        [
            spectrum > (1.0 + MIN_SIGNAL_TO_NOISE) * floor
            for spectrum, floor in zip(spectra, noise, strict=True)
        ],
        axis=0,
    )
    first = LOBE
    end = first + int(np.cumprod(above[first:]).sum())
    if end - first < MIN_FREQUENCIES:
        return 0.0
    a, b = ((spectrum - floor)[first:end] for spectrum, floor in zip(spectra, noise, strict=True))
    frequency = np.pi * (np.arange(first, end) + 1.0) / len(spectra[0])  # rad/px
    A = np.column_stack([np.ones(end - first), frequency**2])
    y = np.log(a / b)
    N = A.T @ A
    slope = np.linalg.solve(N, A.T @ y)
    v = y - A @ slope
    sigma = np.sqrt((v @ v) / (len(y) - 2) * np.linalg.inv(N)[1, 1])
    return float(slope[1]) if abs(slope[1]) > MIN_DEVIATE * sigma else 0.0


def _power_spectrum(grey: AnyArray) -> FloatArray:
    """Return the mean power of a photograph at 1, 2 ... cycles per tile, averaged over directions, (n,)."""
    side = min(TILE_PX, *grey.shape)
    side -= side % 2
    taper = np.hanning(side + 2)[1:-1].astype(np.float32)
    window = np.outer(taper, taper)
    total = np.zeros((side, side // 2 + 1))
    step = max(side // 2, int(np.sqrt(grey.size / MAX_TILES)))
    for y in range(0, grey.shape[0] - side + 1, step):
        for x in range(0, grey.shape[1] - side + 1, step):
            tile = grey[y : y + side, x : x + side]
            total += np.abs(np.fft.rfft2((tile - tile.mean()) * window)) ** 2
    ring = np.rint(side * np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)[None, :])).astype(
        np.int64
    )
    power = np.bincount(ring.ravel(), weights=total.ravel()) / np.bincount(ring.ravel())
    return np.asarray(power[1 : side // 2 + 1])
