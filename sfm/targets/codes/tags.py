"""Square tags (AprilTag, ArUco): found and read by OpenCV, with corners measured to sub-pixel precision.

A tag gives four named points: "7a" is the upper left corner of the black square of tag 7 as printed,
"7b" the upper right, "7c" the lower right and "7d" the lower left one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.model.errors import GeometryError
from sfm.runtime.sampling import as_grey
from sfm.targets.fits.corner import BACKGROUND, BLUR, CONTRAST, CornerFits, fit_corners
from sfm.targets.fits.whole_tag import fit_whole_tags
from sfm.targets.outlines import Flag, as_bytes, estimate_noise

# OpenCV's dictionary for each name used in survey files.
DICTIONARIES = {
    **{f"apriltag{kind}": f"DICT_APRILTAG_{kind}" for kind in ("16h5", "25h9", "36h10", "36h11")},
    **{f"aruco{n}x{n}_{k}": f"DICT_{n}X{n}_{k}" for n in (4, 5, 6, 7) for k in (50, 100, 250, 1000)},
    "aruco_original": "DICT_ARUCO_ORIGINAL",
    "aruco_mip_36h12": "DICT_ARUCO_MIP_36h12",
}
MIRRORED = "-mirrored"  # suffix of a name: read from a mirrored print or photograph
# Without the dictionaries that are the first tags of a larger one.
LARGEST_DICTIONARIES = tuple(name for name in DICTIONARIES if not name.endswith(("_50", "_100", "_250")))
CORNERS = "abcd"
# A black module narrower than this is not resolved from the code behind it, and the whole tag is fitted. The
# same fit confirms the codes of larger tags, in a picture reduced to modules of this width.
MIN_MODULE_PX = 3.0
FEWEST_MODULES = 6  # along a side of a tag, with its border: those of 4x4
# Such tags are searched in a picture enlarged by this factor, down to this side.
ENLARGED, MIN_SIDE_PX = 2, 6.0
# Part of the correctable bits that is corrected, and part of the border bits that may be wrong, for a code
# that no fit confirms.
CORRECTED, WRONG_IN_BORDER = 0.2, 0.1
NARROWEST_RIM = (
    0.02  # of paper around a tag that is told from it, a third of a module of 4x4, over the outline
)
# Picture of a module in which its colour is counted, and what is left out around; the least part of modules
# that has the colour of the rest, 0.92 to 1 of tags that are read, 0.7 to 0.93 of other things.
MODULE_PX, MODULE_EDGE_PX, LEAST_OF_ONE_COLOUR = 8, 1, 0.9
# A corner is rejected if its residuals exceed this part of the contrast, if an edge is softer than this part
# of a module, or if its contrast is less than this part of the tag's.
POOR_FIT, SOFTEST_EDGE, MIN_CONTRAST_SHARE = 0.1, 0.4, 0.3
# Maximum noise of undisturbed corners over that of the best quarter, and the number of px over which the
# residuals of other corners are correlated. Without it, their errors are 3 to 4 sigmas in shadows of 20 to
# 40 %.
MAX_NOISE_RATIO, TOGETHER_PX = 1.3, 16.0
NO_CORNER = int(Flag.CUT_BY_BORDER | Flag.NO_CONVERGENCE | Flag.POOR_FIT)
# Radius of the circle drawn at a corner in place of an outline, px.
DRAWN_PX = 4.0


@dataclass(frozen=True)
class TagFamily:
    """A dictionary of square tags."""

    name: str
    """a name in DICTIONARIES"""
    modules: int
    """modules along a side of the black square, including its border"""
    count: int
    """number of tags; their ids begin with 0"""


@dataclass(frozen=True)
class TagCorners:
    """Corners of the tags of one photograph, measured and rejected ones."""

    xy: FloatArray
    """corners, px, shape (k, 2)"""
    covariance: FloatArray
    """covariance of the corners from the fit and its residuals, px^2, shape (k, 2, 2)"""
    edge_covariance: FloatArray
    """covariance of background, step and blur, shape (k, 3, 3)"""
    code: IntArray
    """4 times the id of the tag plus 0 to 3 for the corners a to d, shape (k,)"""
    levels: FloatArray
    """intensity around the tag and the step to its border, shape (k, 2)"""
    blur: FloatArray
    """standard deviation of the edges, px, shape (k,)"""
    noise: FloatArray
    """standard deviation of the intensities about the fit, shape (k,)"""
    flag: IntArray
    """remarks, see sfm.targets.outlines.Flag, shape (k,)"""
    rejected_xy: FloatArray
    """corners that could not be measured, px, shape (m, 2)"""
    rejected_flag: IntArray
    """reasons for their rejection, shape (m,)"""
    quads: FloatArray
    """outlines of the tags whose code was confirmed by the fit of all modules, corners a to d from OpenCV,
    px, shape (t, 4, 2)"""


def tag_family(name: str) -> TagFamily:
    """Return the family with a name in DICTIONARIES."""
    dictionary = opencv_dictionary(name)
    return TagFamily(name, dictionary.markerSize + 2, len(dictionary.bytesList))


def tag_modules(family: TagFamily, number: int) -> BoolArray:
    """Return which modules of a tag are black, with the border, by rows from the top, (modules, modules).

    Raises:
        GeometryError: the family has no such tag.
    """
    if not 0 <= number < family.count:
        raise GeometryError(f"tag {number}: family {family.name} has 0 to {family.count - 1}")
    return np.asarray(opencv_dictionary(family.name).generateImageMarker(number, family.modules) == 0)


def corner_name(code: int) -> str:
    """Return the name of a corner for its code, such as 7a."""
    return f"{code // 4}{CORNERS[code % 4]}"


def find_tags(photograph: AnyArray, family: TagFamily, *, polarity: str, scale: float) -> TagCorners:
    """Find, read and measure the tags of one photograph.

    Args:
        photograph: intensities, shape (H, W), uint8 or uint16.
        family: the dictionary.
        polarity: dark (black border on white), bright (inverted) or auto (both).
        scale: largest intensity that the photograph can represent; intensities that reach it are censored.

    Returns:
        The corners, tag by tag.

    Source: Garrido-Jurado et al. (2014), Pattern Recognition 47(6), for finding and reading in OpenCV.
    """
    grey = as_bytes(photograph, scale)
    # OpenCV's search for inverted tags loses upright ones, so the photograph is inverted instead.
    pictures = {"dark": (grey,), "bright": (255 - grey,)}.get(polarity, (grey, 255 - grey))
    detected = [_detect_all(picture, family) for picture in pictures]
    quads = np.concatenate([corners for corners, _ in detected])
    number = np.concatenate([ids for _, ids in detected])
    order = np.argsort(number, kind="stable")
    quads, number = quads[order], number[order]
    fits, small, confirmed = _fitted(photograph, quads, number, family, float(scale))
    flag, noise = fits.flag, fits.noise
    contrast, blur = fits.theta[..., CONTRAST], fits.theta[..., BLUR]
    module = np.repeat(_modules_px(quads, family)[:, None], 4, axis=1)
    typical = np.median(contrast, axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        tests = (
            (Flag.CUT_BY_BORDER, (flag & Flag.CUT_BY_BORDER) != 0),
            (Flag.NO_CONVERGENCE, (flag & Flag.NO_CONVERGENCE) != 0),
            (Flag.LOW_CONTRAST, contrast / typical < MIN_CONTRAST_SHARE),
            (Flag.BLURRED, (blur > SOFTEST_EDGE * module) & ~small[:, None]),
            (Flag.POOR_FIT, ((flag & Flag.POOR_FIT) != 0) | (noise / np.abs(contrast) > POOR_FIT)),
        )
    reason = np.zeros(flag.shape, dtype=np.int64)
    for name, against in tests:
        reason[(reason == 0) & against] = name.value
    good = reason == 0
    if polarity != "auto":  # inverted tags do not belong to the survey
        wrong = np.sign(contrast) != (-1 if polarity == "dark" else 1)
        reason[good & wrong] = Flag.LOW_CONTRAST.value
        good &= ~wrong
    code = 4 * number[:, None] + np.arange(4)
    return TagCorners(
        fits.theta[good][:, :2],
        fits.covariance[good][:, :2, :2] * _widening(noise[good])[:, None, None],
        fits.covariance[good][:, BACKGROUND : BLUR + 1, BACKGROUND : BLUR + 1],
        code[good],
        fits.theta[good][:, BACKGROUND : CONTRAST + 1],
        blur[good],
        noise[good],
        flag[good] | Flag.CORNER.value,
        quads[~good],
        reason[~good],
        quads[confirmed & (~small | good.any(axis=1))],
    )


def _widening(noise: FloatArray) -> FloatArray:
    """Return the factors that widen the covariance of each corner for unexplained residuals, (k,).

    The edge of a shadow or a stain leaves residuals that are correlated over TOGETHER_PX neighbouring px.
    Noise above that of the undisturbed corners of the photograph is attributed to such causes.
    """
    if not len(noise):
        return noise
    usual, tiny = MAX_NOISE_RATIO * float(np.quantile(noise, 0.25)), np.finfo(float).eps
    return np.asarray(1 + TOGETHER_PX * np.maximum(1 - ((usual + tiny) / (noise + tiny)) ** 2, 0.0))


def _modules_px(quads: FloatArray, family: TagFamily) -> FloatArray:
    """Return the width of a module along the shortest side of each tag, px, shape (t,)."""
    side = np.linalg.norm(quads - np.roll(quads, 1, axis=1), axis=2).min(axis=1, initial=np.inf)
    return np.asarray(side / family.modules)


def _fitted(
    photograph: AnyArray, quads: FloatArray, number: IntArray, family: TagFamily, scale: float
) -> tuple[CornerFits, BoolArray, BoolArray]:
    """Fit the corners of tags twice, the second time with their codes placed by the first corners.

    Returns:
        The fits; which tags are so small that all their modules were fitted at once, (t,); and for which tags
        the fit of all modules confirms the code, (t,). Corners of the others are flagged as a poor fit.
    """
    m, grey, noise = family.modules, as_grey(photograph), estimate_noise(photograph)
    clear = np.array([~tag_modules(family, int(tag)) for tag in number], dtype=bool).reshape(-1, m, m)
    small = _modules_px(quads, family) < MIN_MODULE_PX

    def fit(quads: FloatArray) -> CornerFits:
        parts = [
            method(grey, quads[rows], _tag_from_pixel(quads[rows], m), clear[rows], scale, *args)
            for method, rows, args in ((fit_corners, ~small, ()), (fit_whole_tags, small, (noise,)))
        ]
        back = np.argsort(np.concatenate([np.flatnonzero(~small), np.flatnonzero(small)]))
        return CornerFits(*(np.concatenate(part)[back] for part in zip(*parts, strict=True)))

    fits = fit(quads)
    fitted = np.isfinite(fits.covariance[..., 0, 0]) & (fits.flag & NO_CORNER == 0)
    corners = np.where(fitted[..., None], fits.theta[..., :2], quads)
    fits, confirmed = fit(corners), np.ones(len(quads), dtype=bool)
    for k in np.flatnonzero(~small):
        reduced, quad, share = _reduced(grey, corners[k], family)
        whole_tag = fit_whole_tags(
            reduced, quad[None], _tag_from_pixel(quad[None], m), clear[k : k + 1], scale, noise * share
        )
        confirmed[k] = not (whole_tag.flag & NO_CORNER).any()
    fits.flag[~confirmed] |= Flag.POOR_FIT.value
    return fits, small, confirmed


def _tag_from_pixel(quads: FloatArray, modules: int) -> FloatArray:
    """Return the homographies from px to modules, (t, 3, 3)."""
    square = np.array([[0, 0], [modules, 0], [modules, modules], [0, modules]], dtype=np.float32)
    H = [cv2.getPerspectiveTransform(quad.astype(np.float32), square) for quad in quads]
    return np.array(H, dtype=float).reshape(-1, 3, 3)


def _reduced(grey: AnyArray, quad: FloatArray, family: TagFamily) -> tuple[AnyArray, FloatArray, float]:
    """Return the picture of a tag reduced to modules of MIN_MODULE_PX, its corners (4, 2), and the scale.

    Outside the photograph the pixels at its border are repeated.
    """
    scale = MIN_MODULE_PX / float(_modules_px(quad[None], family)[0])
    margin = np.ptp(quad, axis=0).max() / family.modules + 2 / scale
    low, high = np.floor(quad.min(axis=0) - margin), np.ceil(quad.max(axis=0) + margin)
    x, y = (np.arange(low[k], high[k] + 1).clip(0, grey.shape[1 - k] - 1).astype(int) for k in range(2))
    window = grey[np.ix_(y, x)]
    size = tuple(max(round(n * scale), 1) for n in window.shape[::-1])
    factor = np.array(size) / window.shape[::-1]
    reduced = cv2.resize(window, size, interpolation=cv2.INTER_AREA)
    return np.asarray(reduced), (quad - low + 0.5) * factor - 0.5, float(np.sqrt(factor.prod()))


def read_dictionaries(photograph: AnyArray) -> dict[str, tuple[IntArray, FloatArray]]:
    """Return the tags of every dictionary in a photograph, not measured.

    OpenCV finds their quadrilaterals once; their codes are compared with those of all dictionaries together.

    Args:
        photograph: intensities, uint8, shape (H, W).

    Returns:
        Numbers (t,) and corners (t, 4, 2), px, of the tags by the name of their dictionary. A dictionary that
        is part of another is listed under the largest. Where a mirror shows more tags, they are listed too,
        by the name and MIRRORED.
    """
    settings = cv2.aruco.DetectorParameters()  # for small tags too; OpenCV begins at 45 px of 6000
    settings.minMarkerPerimeterRate = min(
        settings.minMarkerPerimeterRate, _least_perimeter(FEWEST_MODULES) / max(photograph.shape)
    )
    settings.minMarkerDistanceRate = NARROWEST_RIM  # else the edge of the paper stands for the tag on it
    finder = cv2.aruco.ArucoDetector(opencv_dictionary(LARGEST_DICTIONARIES[0]), settings)
    tags: dict[str, tuple[IntArray, FloatArray]] = {}
    mirrored: dict[str, tuple[IntArray, FloatArray]] = {}
    for picture in (photograph, 255 - photograph):  # dark tags, or inverted ones
        as_read, _, unread = finder.detectMarkers(picture)
        quads = np.array([*as_read, *unread], dtype=float).reshape(-1, 4, 2)
        if not len(quads):
            continue
        modules = [(codes, *_read_modules(picture, quads, codes.modules)) for codes in _codes_by_size()]
        tags = _tags_in(quads, modules)
        flipped = [(codes, clear[:, :, ::-1], is_tag) for codes, clear, is_tag in modules]
        mirrored = max(mirrored, _tags_in(quads[:, [1, 0, 3, 2]], flipped), key=_most)
        if tags:
            break
    if _most(mirrored) > _most(tags):
        tags |= {name + MIRRORED: read for name, read in mirrored.items()}
    return tags


def _most(tags: dict[str, tuple[IntArray, FloatArray]]) -> int:
    """Return the number of tags of the dictionary that has most."""
    return max((len(number) for number, _ in tags.values()), default=0)


def _tags_in(
    quads: FloatArray, modules: Sequence[tuple[_Codes, BoolArray, BoolArray]]
) -> dict[str, tuple[IntArray, FloatArray]]:
    """Return numbers and corners of the tags in quadrilaterals, by the name of their dictionary.

    Args:
        quads: corners, px, (q, 4, 2).
        modules: codes of one size, clear modules of that size, (q, n, n), and what looks like a tag, (q,).
    """
    # by quadrilateral and dictionary, once each, since some tags look the same when turned
    read: dict[tuple[int, str], tuple[int, int]] = {}
    for codes, clear, is_tag in modules:
        wrong = np.bitwise_count(_words(clear)[:, None] ^ codes.words)
        for row, k in zip(*np.nonzero(is_tag[:, None] & (wrong <= codes.correctable)), strict=True):
            read.setdefault((int(row), codes.dictionary[k]), (int(codes.number[k]), int(codes.turn[k])))
    tags: dict[str, tuple[IntArray, FloatArray]] = {}
    for name in LARGEST_DICTIONARIES:
        of_name = [(row, *tag) for (row, of), tag in read.items() if of == name]
        if of_name:
            corners = [np.roll(quads[row], -turn, axis=0) for row, _, turn in of_name]
            tags[name] = np.array([number for _, number, _ in of_name]), np.array(corners)
    return tags


@dataclass(frozen=True)
class _Codes:
    """The tags of all dictionaries with one number of modules, in four directions each."""

    modules: int
    """modules along a side, without the border"""
    words: AnyArray
    """clear modules by rows, as bits of uint64, (k,)"""
    turn: IntArray
    """by how many corners an upright tag is turned, (k,)"""
    number: IntArray
    """number of the tag, (k,)"""
    dictionary: tuple[str, ...]
    """name of its dictionary"""
    correctable: IntArray
    """bits that may be wrong, (k,)"""


@cache
def _codes_by_size() -> tuple[_Codes, ...]:
    """Return the codes of all dictionaries by the number of their modules."""
    by_size: dict[int, list[_Codes]] = {}
    for name in LARGEST_DICTIONARIES:
        dictionary, family = opencv_dictionary(name), tag_family(name)
        numbers = range(family.count)
        clear = np.array([~tag_modules(family, number)[1:-1, 1:-1] for number in numbers])
        n = family.modules - 2
        codes = _Codes(
            n,
            np.concatenate([_words(np.rot90(clear, -turn, axes=(1, 2))) for turn in range(4)]),
            np.repeat(np.arange(4), family.count),
            np.tile(numbers, 4),
            (name,) * 4 * family.count,
            np.full(4 * family.count, int(dictionary.maxCorrectionBits * CORRECTED)),
        )
        by_size.setdefault(n, []).append(codes)
    return tuple(
        _Codes(
            n,
            np.concatenate([codes.words for codes in parts]),
            np.concatenate([codes.turn for codes in parts]),
            np.concatenate([codes.number for codes in parts]),
            tuple(name for codes in parts for name in codes.dictionary),
            np.concatenate([codes.correctable for codes in parts]),
        )
        for n, parts in by_size.items()
    )


def _words(clear: BoolArray) -> AnyArray:
    """Return modules (t, n, n) by rows as the bits of a word each, uint64, (t,)."""
    weights = 1 << np.arange(clear[0].size, dtype=np.uint64)
    return np.asarray((clear.reshape(len(clear), -1) * weights).sum(axis=1, dtype=np.uint64))


def _read_modules(picture: AnyArray, quads: FloatArray, modules: int) -> tuple[BoolArray, BoolArray]:
    """Return which modules inside the border of quadrilaterals are clear, and which look like a tag.

    The border of a tag is dark, and its modules are of one colour each.

    Args:
        picture: intensities, uint8, (H, W).
        quads: corners, px, (t, 4, 2).
        modules: along a side, without the border.

    Returns:
        Clear modules, (t, modules, modules), and whether it looks like a tag, (t,).
    """
    n = modules + 2
    side, edge = n * MODULE_PX, MODULE_EDGE_PX
    corners = np.array([[0, 0], [side - 1, 0], [side - 1, side - 1], [0, side - 1]], dtype=np.float32)
    share = np.zeros((len(quads), n, n))  # of a module that is white
    for k, quad in enumerate(quads):
        H = cv2.getPerspectiveTransform(quad.astype(np.float32), corners)
        square = cv2.warpPerspective(picture, H, (side, side), flags=cv2.INTER_LINEAR)
        _, white = cv2.threshold(square, 0, 1, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
        share[k] = white.reshape(n, MODULE_PX, n, MODULE_PX)[:, edge:-edge, :, edge:-edge].mean(axis=(1, 3))
    clear, of_one_colour = share > 0.5, np.maximum(share, 1 - share).mean(axis=(1, 2)) > LEAST_OF_ONE_COLOUR
    inside = clear[:, 1:-1, 1:-1]
    in_border = clear.sum(axis=(1, 2)) - inside.sum(axis=(1, 2))
    return inside, of_one_colour & (in_border <= WRONG_IN_BORDER * modules**2)


def smallest_dictionary(name: str, number: IntArray) -> str:
    """Return the smallest part of a dictionary that contains these numbers."""
    kind, _, count = name.rpartition("_")
    parts = (f"{kind}_{n}" for n in (50, 100, 250, 1000)) if count == "1000" else (name,)
    return next(part for part in parts if tag_family(part).count > number.max(initial=0))


def _least_perimeter(modules: int) -> float:
    """Return the outline of the smallest tag, px; OpenCV counts its pixels, fewer along a diagonal."""
    return 4 * MIN_MODULE_PX * modules / math.sqrt(2)


def _detect_all(picture: AnyArray, family: TagFamily) -> tuple[FloatArray, IntArray]:
    """Return corners a to d (t, 4, 2) and ids (t,) of the tags that OpenCV finds.

    They are read with OpenCV's default rate of correction, as the fit of all modules confirms each code. Tags
    with narrow modules are also read from an enlarged picture.
    """
    dictionary, settings = opencv_dictionary(family.name), cv2.aruco.DetectorParameters()
    longest = max(picture.shape)
    settings.minMarkerPerimeterRate = _least_perimeter(family.modules) / longest
    quads, number = _detect(cv2.aruco.ArucoDetector(dictionary, settings), picture)
    for enlarged in (ENLARGED, 1):
        settings = cv2.aruco.DetectorParameters()
        settings.minMarkerPerimeterRate = 4 * MIN_SIDE_PX / longest
        settings.maxMarkerPerimeterRate = 8 * MIN_MODULE_PX * family.modules / longest
        settings.adaptiveThreshWinSizeStep *= enlarged
        settings.adaptiveThreshWinSizeMax *= enlarged
        size = (picture.shape[1] * enlarged, picture.shape[0] * enlarged)
        large = cv2.resize(picture, size, interpolation=cv2.INTER_CUBIC)
        also, also_number = _detect(cv2.aruco.ArucoDetector(dictionary, settings), large)
        also = (also + 0.5) / enlarged - 0.5
        apart = also.mean(axis=1)[:, None] - quads.mean(axis=1)
        near = np.hypot(*np.moveaxis(apart, 2, 0)) < np.ptp(also, axis=1).max(axis=1, keepdims=True) / 2
        new = ~near.any(axis=1) & (_modules_px(also, family) < MIN_MODULE_PX)
        quads, number = np.concatenate([quads, also[new]]), np.concatenate([number, also_number[new]])
    return quads, number


def _detect(detector: cv2.aruco.ArucoDetector, picture: AnyArray) -> tuple[FloatArray, IntArray]:
    """Return corners a to d (t, 4, 2) and ids (t,) of the tags that one detector finds."""
    corners, ids, _ = detector.detectMarkers(picture)
    number = np.zeros(0) if ids is None else np.asarray(ids)
    return np.array(corners, dtype=float).reshape(-1, 4, 2), number.reshape(-1).astype(np.int64)


def inside_tags(xy: FloatArray, tags: TagCorners, family: TagFamily) -> BoolArray:
    """Return which positions are on a tag or within one module around it, (k,)."""
    inside = np.zeros(len(xy), dtype=bool)
    for quad in tags.quads if len(xy) else ():
        middle = quad.mean(axis=0)
        outline = (middle + (1 + 2 / family.modules) * (quad - middle)).astype(np.float32)
        inside |= [cv2.pointPolygonTest(outline, (float(x), float(y)), False) >= 0 for x, y in xy]
    return inside


def opencv_dictionary(name: str) -> cv2.aruco.Dictionary:
    """Return OpenCV's dictionary for a name in DICTIONARIES."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARIES[name]))
