"""Videos of cameras that are mounted to one another: at one time all of them move, or stand still.

The apparent motion of each video is compared with that of another, at every difference of their clocks. A
difference is taken if most of the motion is common, and if that is no chance: motions that are not related
correlate by as much as their length in correlation times allows, at the best of all differences.

Source: Caspi and Irani (2002), IEEE PAMI 24(11) (cameras whose relative pose is constant, by their motion);
Bartlett (1946), J. R. Stat. Soc. Suppl. 8 (variance of the correlation of two autocorrelated series).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.model.conventions import FloatArray
from sfm.model.distributions import LEVEL, normal_sf

COMMON_SHARE = 0.5  # of the variance of the motion, above which it is that of one rig
MIN_OVERLAP = 0.5  # of the shorter video
MAX_STEPS = 200_000  # between frames, two hours at 30 frames a second; longer ones have a damaged time
# Standard deviation of the place of a maximum between frames by the parabola through three correlations, in
# frames: 0.1 in rendered pairs of 12 and 15 frames a second.
FRAME_SHARE = 0.1


@dataclass(frozen=True)
class ClockDifference:
    """By how much the clock of one video is ahead of that of another."""

    ahead_s: float
    sigma_s: float
    correlation: float  # of their motions


def clock_difference(
    reference: tuple[FloatArray, FloatArray], other: tuple[FloatArray, FloatArray]
) -> ClockDifference | None:
    """Return by how much the clock of a video is ahead of the reference; None unless they move together.

    Args:
        reference: times of its frames, s, and the speed of their apparent motion, (k,).
        other: the same of the other video.
    """
    videos = (reference, other)
    if min(len(times) for times, _ in videos) < 2:
        return None
    step = max(float(np.median(np.diff(times))) for times, _ in videos)
    longest = max(float(times[-1] - times[0]) for times, _ in videos)
    if step <= 0 or longest > MAX_STEPS * step:
        return None
    series = []
    for times, speed in videos:
        known, at = np.isfinite(speed), np.arange(times[0], times[-1] + step / 2, step)
        evenly = np.interp(at, times[known], speed[known]) if known.any() else np.zeros(len(at))
        series.append(np.sqrt(evenly))  # few fast moments say little
    a, b = series
    shortest = round(MIN_OVERLAP * min(len(a), len(b)))
    if shortest < 4:
        return None
    shifts = np.arange(shortest - len(a), len(b) - shortest + 1)
    r = np.zeros(len(shifts))
    for k, shift in enumerate(shifts.tolist()):
        of_a, of_b = _overlap(a, b, shift)
        length = float(np.linalg.norm(of_a)) * float(np.linalg.norm(of_b))
        r[k] = float(of_a @ of_b) / length if length else 0.0  # 0 if one of them is constant
    k = int(np.argmax(r))
    correlation, periods = float(r[k]), _periods(*_overlap(a, b, int(shifts[k])))
    z = np.arctanh(min(correlation, 1 - 1e-12)) * np.sqrt(max(periods - 3, 0.0))
    tried = max(1.0, len(shifts) * periods / max(len(a), len(b)))
    if correlation <= 0 or correlation**2 < COMMON_SHARE or tried * float(normal_sf(z)) >= LEVEL:
        return None
    place = float(shifts[k])
    if 0 < k < len(r) - 1 and (curved := r[k - 1] - 2 * r[k] + r[k + 1]) < 0:
        place += (r[k - 1] - r[k + 1]) / (2 * curved)
    ahead = step * place + float(other[0][0] - reference[0][0])
    return ClockDifference(ahead, FRAME_SHARE * step, correlation)


def _overlap(a: FloatArray, b: FloatArray, shift: int) -> tuple[FloatArray, FloatArray]:
    """Return two series where they overlap, each less its mean.

    shift: place in `b` of the first value of `a`.
    """
    first, last = max(0, -shift), min(len(a), len(b) - shift)
    of_a, of_b = a[first:last], b[first + shift : last + shift]
    return of_a - of_a.mean(), of_b - of_b.mean()


def _periods(a: FloatArray, b: FloatArray) -> float:
    """Return how many independent values the correlation of two series has, whose means are zero."""
    n, product = len(a), np.ones(len(a) // 4)
    for series in (a, b):
        power = float(series @ series)
        if not power:
            return 0.0
        spectrum = np.abs(np.fft.rfft(series, 2 * n)) ** 2
        product *= np.fft.irfft(spectrum, 2 * n)[1 : 1 + n // 4] / power  # correlation with itself, later
    return n / (1 + 2 * float(product.clip(min=0).sum()))
