"""Which of two photographs is blurred more, and the sharper one brought to the blur of the other.

Out of focus, or moved during exposure, a photograph shows less of the same texture, and correlation and least
squares matching find nothing alike. How much less needs no conjugate points: spectra of natural texture have
one form, so that the ratio of those of two photographs of one object is that of their blurs.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sfm.conventions import AnyArray, FloatArray
from sfm.matching.radiometry import averaged, grey_of_8_bit

TILE_PX = 128  # side of the squares whose spectra are averaged
LOBE = 2  # frequencies on either side into which the window of a tile spreads each one
NOISE_FREQUENCIES = 6  # the highest ones of a tile, in which photographs have noise only
MIN_SIGNAL_TO_NOISE = 3.0  # of the power of a frequency that is compared
MIN_FREQUENCIES = 4  # two parameters are fitted to them
MIN_DEVIATE = 4.0  # of a difference of blur, in its standard deviations: neighbouring frequencies are alike
SHARP_PX = 0.7  # blur that leaves 9 % of the contrast at two pixels a cycle, and nearly nothing beyond
MAX_TILES = 200  # spread over the photograph


@dataclass(frozen=True)
class EquallyBlurred:
    """Two photographs of one blur, in pixels that are as large as it allows."""

    left: AnyArray
    right: AnyArray
    shrink: int  # px of the photographs that were given along the side of a pixel of these

    def small(self, xy: FloatArray) -> FloatArray:
        """Return places in these photographs from those in the ones given, px, (k, 2)."""
        return (xy + 0.5) / self.shrink - 0.5

    def full(self, xy: FloatArray) -> FloatArray:
        """Return places in the photographs given from those in these, px, (k, 2)."""
        return self.shrink * (xy + 0.5) - 0.5


def equally_blurred(left: AnyArray, right: AnyArray) -> EquallyBlurred:
    """Return both photographs with the blur of the less sharp one.

    The sharper one is smoothed by a Gaussian. Both are then averaged over squares for which that blur is one
    of SHARP_PX: a window contains as much texture as one of a sharp photograph, and its noise is that of
    pixels that have none in common.

    Args:
        left: photograph, (H, W) or (H, W, 3), 8 or 16 bit or float, of an object.
        right: another one of it.
    """
    more = difference_of_blur(left, right)
    sigma = float(np.sqrt(abs(more)))
    if more != 0.0:
        sharper = left if more > 0.0 else right
        smooth = np.asarray(cv2.GaussianBlur(sharper, (0, 0), sigma))
        left, right = (smooth, right) if more > 0.0 else (left, smooth)
    shrink = max(round(sigma / SHARP_PX), 1)
    return EquallyBlurred(averaged(left, shrink), averaged(right, shrink), shrink)


def difference_of_blur(left: AnyArray, right: AnyArray) -> float:
    """Return by how much the variance of the point spread is larger in the right photograph, px^2.

    0 where the spectra do not differ by more than chance, or noise hides them. Blur is counted in the pixels
    of each photograph: of photographs in different scale those of the same lens count as equal.

    Source: the Gaussian as in Pentland (1987), A new sense for depth of field, IEEE Trans. PAMI 9(4): the
    logarithm of the ratio of two power spectra is linear in the squared frequency, and its slope is the
    difference of the variances.
    """
    spectra = [_power_spectrum(grey_of_8_bit(one)) for one in (left, right)]
    if len(spectra[0]) != len(spectra[1]) or len(spectra[0]) <= LOBE + NOISE_FREQUENCIES + MIN_FREQUENCIES:
        return 0.0
    noise = [float(one[-NOISE_FREQUENCIES:].mean()) for one in spectra]
    above = np.all(
        [one > (1.0 + MIN_SIGNAL_TO_NOISE) * floor for one, floor in zip(spectra, noise, strict=True)], axis=0
    )
    first = LOBE
    end = first + int(np.cumprod(above[first:]).sum())
    if end - first < MIN_FREQUENCIES:
        return 0.0
    a, b = ((one - floor)[first:end] for one, floor in zip(spectra, noise, strict=True))
    frequency = np.pi * (np.arange(first, end) + 1.0) / len(spectra[0])  # rad/px
    A = np.column_stack([np.ones(end - first), frequency**2])
    y = np.log(a / b)
    N = A.T @ A
    slope = np.linalg.solve(N, A.T @ y)
    v = y - A @ slope
    sigma = np.sqrt((v @ v) / (len(y) - 2) * np.linalg.inv(N)[1, 1])
    return float(slope[1]) if abs(slope[1]) > MIN_DEVIATE * sigma else 0.0


def _power_spectrum(grey: AnyArray) -> FloatArray:
    """Return the mean power of a photograph at 1, 2 ... cycles a tile, without direction, (n,)."""
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
