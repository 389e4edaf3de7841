"""Radiometry of grey patches and photographs: contrast, histograms, brightness, and a cache of photographs.

Brightness and contrast are the mean and standard deviation of intensities, and gain and offset follow from a
linear regression of one patch on another.

`GreyPhotographs` keeps as many grey photographs as fit into memory, because each is needed with many others.
If more photographs than fit are used in turn, again and again, the oldest one is always needed next. Removing
the oldest would therefore read every photograph every time, so a random one is removed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from random import Random
from threading import Lock

import cv2
import numpy as np

from sfm.model.arguments import checked_arguments
from sfm.model.conventions import AnyArray, FloatArray, IntArray
from sfm.model.errors import GeometryError, PhotographError

MEMORY_BYTES = 200_000_000  # of photographs kept as they were read: 16 of 12 megapixels with 8 bit
GREY_BYTES = 100_000_000  # of photographs kept in single precision
LEVELS_8, LEVELS_16 = 256, 65536
FULL_SCALE_8, FULL_SCALE_16 = LEVELS_8 - 1.0, LEVELS_16 - 1.0
# Rec. 601, which cv2 uses for grey; photographs in memory are red, green, blue here.
LUMINANCE = (0.299, 0.587, 0.114)
MIN_WINDOW_PX = 3


@dataclass(frozen=True)
class Radiometry:
    """Brightness and contrast of a patch or photograph."""

    mean: float  # mean intensity
    deviation: float  # standard deviation of the intensities, divisor n - 1
    lowest: float
    highest: float


@dataclass(frozen=True)
class LinearRadiometry:
    """target = offset + gain * source, by least squares over the pixels of two patches."""

    offset: float  # target units
    gain: float  # target units per source unit
    correlation: float  # coefficient r of the two patches, 0 where one is flat


@dataclass(frozen=True)
class Grey:
    """A result of `grey_of`, which need not be checked again for every match."""

    pixels: AnyArray  # float32, finite, (H, W)


def grey_of(photograph: AnyArray | Grey) -> AnyArray:
    """Return a photograph as one channel of float32 with unchanged intensities (0-255, 0-65535 or as given).

    Args:
        photograph: shape (H, W), or (H, W, 3) in the order red, green, blue; 8 or 16 bit or float.

    Raises:
        PhotographError: other types or shapes, no pixels, or intensities that are not finite.
    """
    if isinstance(photograph, Grey):
        return photograph.pixels
    array = np.asarray(photograph)
    if array.dtype not in (np.uint8, np.uint16, np.float32, np.float64):
        raise PhotographError(f"found {array.dtype} intensities, expected 8 or 16 bit or float")
    if array.ndim == 3 and array.shape[2] == 3:
        array = array.astype(np.float32) @ np.array(LUMINANCE, dtype=np.float32)
    if array.ndim != 2 or array.size == 0:
        raise PhotographError(f"found a photograph of shape {array.shape}, expected (H, W) or (H, W, 3)")
    if array.dtype.kind == "f":
        with np.errstate(over="ignore", invalid="ignore"):
            total = array.sum()  # if their sum is finite, all intensities are, and it is faster
        if not (np.isfinite(total) or np.isfinite(array).all()):
            raise PhotographError("found intensities that are not finite, needed finite numbers everywhere")
    return np.ascontiguousarray(array, dtype=np.float32)


def grey_of_8_bit(photograph: AnyArray) -> AnyArray:
    """Return a photograph as `grey_of` does, with intensities scaled to the full scale of 8 bit."""
    return grey_of(photograph) * np.float32(FULL_SCALE_8 / full_scale(photograph))


def full_scale(photograph: AnyArray) -> float:
    """Return the highest intensity possible in a photograph; floats count as 8 bit."""
    return FULL_SCALE_16 if np.asarray(photograph).dtype == np.uint16 else FULL_SCALE_8


def shrink_photograph(photograph: AnyArray, shrink: int) -> AnyArray:
    """Return a photograph averaged over squares of side `shrink`; a remainder at the border is cut off."""
    if shrink == 1:
        return photograph
    height, width = (side // shrink for side in photograph.shape[:2])
    blocks = photograph[: height * shrink, : width * shrink]
    return np.asarray(cv2.resize(blocks, (width, height), interpolation=cv2.INTER_AREA))


def odd_window(what: str, side_px: int) -> int:
    """Return the side of a window that has a central pixel.

    Raises:
        GeometryError: an even side, or less than 3.
    """
    if side_px < MIN_WINDOW_PX or side_px % 2 == 0:
        raise GeometryError(
            f"{what}: a window of {side_px} px, needed an odd number of at least {MIN_WINDOW_PX}"
        )
    return int(side_px)


@checked_arguments()
def radiometry_of(patch: AnyArray) -> Radiometry:
    """Return mean, standard deviation and extremes of a patch or photograph.

    Args:
        patch: shape (H, W) or (H, W, 3), 8 or 16 bit or float.

    Source: document 002, eq. 2.1 (mean and standard deviation of the grey values).
    """
    values = grey_of(patch).astype(float)
    deviation = float(values.std(ddof=1)) if values.size > 1 else 0.0
    return Radiometry(float(values.mean()), deviation, float(values.min()), float(values.max()))


@checked_arguments()
def histogram(photograph: AnyArray) -> IntArray:
    """Return the number of pixels at each intensity, (256,) or (65536,) for 16 bit.

    Args:
        photograph: shape (H, W) or (H, W, 3); colour is converted to grey.

    Raises:
        PhotographError: intensities beyond the scale.

    Source: document 002, sec. II.1.1.1.
    """
    levels = LEVELS_16 if photograph.dtype == np.uint16 else LEVELS_8
    values = np.rint(grey_of(photograph)).astype(np.int64).ravel()
    if values.min() < 0 or values.max() >= levels:
        raise PhotographError(
            f"intensities from {values.min()} to {values.max()}, a histogram needs 0 to {levels - 1}"
        )
    return np.asarray(np.bincount(values, minlength=levels))


@checked_arguments()
def equalise_histogram(photograph: AnyArray) -> AnyArray:
    """Return the photograph with all intensities made equally frequent, same type.

    The lowest intensity becomes 0 and the highest the end of the scale. A photograph of one intensity is
    returned unchanged.

    Args:
        photograph: shape (H, W) or (H, W, 3), 8 or 16 bit, or float on the 8 bit scale.

    Source: Gonzalez and Woods, Digital Image Processing, sec. 3.3.1; 8 bit is cv2.equalizeHist.
    """
    if photograph.dtype == np.uint8 and photograph.ndim == 2:
        return np.asarray(cv2.equalizeHist(photograph))
    counts = histogram(photograph)
    kind = np.uint16 if photograph.dtype == np.uint16 else np.uint8
    values = np.rint(grey_of(photograph)).astype(np.int64)
    first = int(values.min())
    rest = values.size - counts[first]
    if rest == 0:
        return values.astype(kind)
    share = (np.cumsum(counts) - counts[first]) / rest
    return np.asarray(np.rint(np.clip(share, 0, 1) * (len(counts) - 1)).astype(kind)[values])


@checked_arguments()
def fit_radiometry(source: AnyArray, target: AnyArray) -> LinearRadiometry:
    """Fit the gain and offset that bring the intensities of one patch closest to another, pixel by pixel.

    Args:
        source: patch, shape (H, W) or (H, W, 3).
        target: patch of the same shape.

    Returns:
        Offset, gain and the coefficient r.

    Raises:
        GeometryError: patches of different shape.

    Source: the radiometric part of least squares matching, Gruen (1985); document 002, sec. II.1.2.1.2.
    """
    a, b = grey_of(source).astype(float), grey_of(target).astype(float)
    if a.shape != b.shape:
        raise GeometryError(f"radiometry: patches of shape {a.shape} and {b.shape}, needed the same shape")
    da, db = a - a.mean(), b - b.mean()
    aa, bb, ab = float((da * da).sum()), float((db * db).sum()), float((da * db).sum())
    if aa == 0.0:
        return LinearRadiometry(float(b.mean()), 0.0, 0.0)
    gain = ab / aa
    r = ab / np.sqrt(aa * bb) if bb > 0.0 else 0.0
    return LinearRadiometry(float(b.mean() - gain * a.mean()), gain, float(r))


@checked_arguments()
def match_brightness(source: AnyArray, target: AnyArray) -> FloatArray:
    """Return the source with mean and standard deviation of the target; they need not show the same object.

    Args:
        source: photograph or patch; a flat one receives only the mean.
        target: photograph or patch.

    Returns:
        Intensities in units of the target, shape (H, W) of the source.

    Source: Kraus (2007), sec. 3.5 (contrast and brightness transfer).
    """
    a, b = radiometry_of(source), radiometry_of(target)
    gain = b.deviation / a.deviation if a.deviation > 0 else 0.0
    return np.asarray(b.mean + gain * (grey_of(source).astype(float) - a.mean))


class GreyPhotographs:
    """Photographs that are read when needed and removed when memory is full. Threads may share it.

    Most are kept as they were read, which takes a quarter of the memory of single precision.
    """

    def __init__(
        self,
        read: Callable[[int], AnyArray],
        *,
        memory_bytes: int = MEMORY_BYTES,
        grey_bytes: int = GREY_BYTES,
    ) -> None:
        """Start empty.

        Args:
            read: returns a photograph, (H, W) or (H, W, 3), 8 or 16 bit or float.
            memory_bytes: limit for photographs kept as they were read.
            grey_bytes: limit for photographs in single precision; the last two are always kept.
        """
        self._read = read
        self._stored: dict[int, AnyArray] = {}
        self._grey: dict[int, AnyArray] = {}
        self._most = memory_bytes, grey_bytes
        self._chance = Random(0)
        self._lock = Lock()

    def __getitem__(self, i: int) -> Grey:
        """Return one photograph."""
        with self._lock:
            grey, stored = self._grey.get(i), self._stored.get(i)
            if grey is not None:
                self._mark_used(i, grey)
        if grey is None:
            if stored is None:
                stored = self._read(i)
            grey = grey_of(stored)
            with self._lock:
                self._mark_used(i, grey)
                self._stored[i] = stored
                while _bytes(self._stored) > self._most[0]:
                    del self._stored[self._chance.choice(list(self._stored))]
                while len(self._grey) > 2 and _bytes(self._grey) > self._most[1]:
                    del self._grey[next(iter(self._grey))]
        return Grey(grey)

    def _mark_used(self, i: int, grey: AnyArray) -> None:
        """Mark a photograph as used last."""
        self._grey.pop(i, None)
        self._grey[i] = grey


def _bytes(kept: dict[int, AnyArray]) -> int:
    return sum(photograph.nbytes for photograph in kept.values())
