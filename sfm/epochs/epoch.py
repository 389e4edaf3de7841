"""Epoch: a result with what it was given, and what it has in common with other epochs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from sfm.conventions import FloatArray
from sfm.network import ObjectPoints, ScaleBars
from sfm.solution import Solution

MAX_SAME_DIFFERENCE = 1e-9  # relative difference of two given values that are the same one


@dataclass(frozen=True)
class Common:
    """Correlation of an epoch with those that it was adjusted together with: C_12 = U_1 diag(signs) U_2'."""

    given: tuple[str, ...]  # values that were given to several, g of them
    columns: FloatArray  # U, those of the given values first, object unit, (3 k, q)
    signs: FloatArray  # (q,)


@dataclass(frozen=True)
class Epoch:
    """One epoch: a result, and what it was given."""

    name: str
    result: Solution
    bars: ScaleBars = field(default_factory=ScaleBars)  # that took part, by index of the result's points
    control: ObjectPoints = field(default_factory=ObjectPoints)  # that took part, as observed
    interior: tuple[tuple[str, str, float, float], ...] = ()  # camera, parameter, value and sigma observed
    sigma0: float = 1.0  # of unit weight, by which the covariance of the result is scaled
    sigma0_px: float | None = None  # a posteriori of an image coordinate, the median; None where not known
    common: Common | None = None  # with the other epochs, of those adjusted together


Observed = tuple[list[tuple[int, float]], float, float]  # gradient by column, standard deviation, value


def given_observations(epoch: Epoch) -> Iterator[tuple[str, Observed]]:
    """Yield bars and coordinates of control that an epoch was given with a standard deviation, by name.

    Args:
        epoch: with its covariance, by whose rows the gradients count.
    """
    names, x = epoch.result.network.points, epoch.result.estimate.points
    bars, row = epoch.bars, epoch.result.covariance_rows(np.arange(len(names)))
    count: Counter[str] = Counter()
    for i, j, length, sigma in zip(bars.start, bars.end, bars.length, bars.sigma, strict=True):
        if not (sigma > 0 and row[i] >= 0 and row[j] >= 0):
            continue
        key = f"bar {' - '.join(sorted((names[i], names[j])))}"
        count[key] += 1
        u = (x[j] - x[i]) / np.linalg.norm(x[j] - x[i])
        gradient = [(3 * int(row[i]) + k, -float(u[k])) for k in range(3)]
        gradient += [(3 * int(row[j]) + k, float(u[k])) for k in range(3)]
        again = f" ({count[key]})" if count[key] > 1 else ""
        yield key + again, (gradient, float(sigma), float(length))
    control = epoch.control
    for j, given, C in zip(control.point, control.xyz, control.covariance, strict=True):
        for k in range(3):
            if 0 < C[k, k] < np.inf and row[j] >= 0:
                key = f"{'XYZ'[k]} of control point {names[j]}"
                yield key, ([(3 * int(row[j]) + k, 1.0)], float(np.sqrt(C[k, k])), float(given[k]))
