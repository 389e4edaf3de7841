"""The patterns: photographs in which a family is freed, with its gain and the test of the alternative.

A pattern gives each photograph, or run of photographs, a factor on the columns of a family.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sfm.adjustment.hypotheses.families import (
    Alternative,
    Family,
)
from sfm.adjustment.hypotheses.score import (
    NONE,
    Gain,
    Reduced,
    Spread,
    gain_of,
    gains_of,
    least_share,
    log_f_sf,
    log_probability,
)
from sfm.conventions import BoolArray, FloatArray, IntArray

MIN_GROUP = 2  # photographs on each side of a split
MAX_RUNS = 60  # photographs, or runs of them, that have freedoms by themselves
ROUNDS = 20  # of two means
STARTS = 8  # photographs from which a group is grown


@dataclass(frozen=True)
class Pattern:
    """Photographs in which a family is freed."""

    name: str
    factor: FloatArray  # of each photograph, (m,)
    search: float = 0.0  # ln of the number of patterns, or of sets of points, from which it was taken
    among: BoolArray | None = None  # photographs of which some differ, (m,); None: all
    parts: int = 1  # each of which has parameters by itself


def score_alternative(
    reduced: Reduced,
    family: Family,
    pattern: Pattern,
    gain: Gain,
    spread: Spread = NONE,
    *,
    points: IntArray | None = None,
    parameters: tuple[tuple[int, int], ...] = (),
) -> Alternative:
    """Return an alternative with its test."""
    r, parts, search = reduced.redundancy, pattern.parts, pattern.search
    on = pattern.factor[reduced.image] != 0 if parts == 1 else np.ones(len(reduced.image), dtype=bool)
    some = np.zeros(0, dtype=np.int64) if points is None else points
    if len(some):
        on &= np.isin(reduced.point, some)
    touched = int(on.sum()) // parts
    log_p = log_probability(gain.value, gain.rank, r)
    if spread.factor > 1:
        f = spread.ratio(gain.value, gain.rank, r)
        log_p = max(log_p, log_f_sf(f, gain.rank, spread.redundancy)) if gain.rank else 0.0
    price = price_of(gain.rank, touched, search)
    evidence = spread.evidence(gain.value, gain.rank, r) - price
    return Alternative(
        *(family, pattern.name, pattern.factor, gain, spread, log_p, price, search, evidence),
        points=some,
        parameters=parameters,
        among=pattern.among,
    )


def price_of(rank: int, touched: int, search: float) -> float:
    """Return what parameters must gain in ln likelihood, by the number of image points that they move.

    Source: Kass and Raftery (1995), J. Am. Stat. Assoc. 90, on the n of the Bayesian information criterion.
    """
    return float(rank / 2 * np.log(2 * max(touched, 2)) + search)


def patterns_of(m: int) -> Iterator[tuple[str, FloatArray, float]]:
    """Return the patterns: name, factors of the photographs (p, m), ln of the number p."""
    if m == MIN_GROUP:
        yield "pair", np.eye(m)[1:], 0.0  # that the other one differs is the same statement
    elif m > MIN_GROUP:
        yield "single", np.eye(m), np.log(m)
    if m < 2 * MIN_GROUP:
        return
    splits = np.array([np.arange(m) >= k for k in range(MIN_GROUP, m - MIN_GROUP + 1)], dtype=float)
    yield "split", splits, np.log(len(splits))
    yield "linear", np.linspace(-1, 1, m)[None], 0.0
    yield "alternating", (np.arange(m) % 2)[None].astype(float), 0.0


@dataclass(frozen=True)
class Part:
    """Normal equations of a family in each photograph."""

    H: FloatArray  # (m, f, m, f)
    g: FloatArray  # (m, f)
    squares: FloatArray  # (m, f)

    def gain(self, factor: FloatArray) -> Gain:
        """Return the gain where the photographs have the family with these factors."""
        return gain_of(
            np.tensordot(np.tensordot(factor, self.H, (0, 0)), factor, (1, 0)),
            factor @ self.g,
            factor**2 @ self.squares,
            least_share(self.g.shape[1]),
        )

    def spread(self, factor: FloatArray, gain: Gain) -> Spread:
        """Return how much the photographs differ in the family beyond what a pattern explains."""
        m = len(self.g)
        left = self.g + np.tensordot(self.H, factor, (2, 0)) @ gain.beta
        some = np.ones(m, dtype=bool) if np.count_nonzero(factor) > 1 else factor == 0
        values, ranks = gains_of(self.blocks[some], left[some], self.squares[some])
        redundancy = int(ranks.sum()) - gain.rank
        return NONE if redundancy < 1 else Spread(float(values.sum()) / redundancy, redundancy)

    @property
    def blocks(self) -> FloatArray:
        """Normal equations of each photograph by itself, (m, f, f)."""
        return np.asarray(np.einsum("iaib->iab", self.H))

    def group(self) -> tuple[FloatArray, Gain]:
        """Return the photographs that together have the largest gain, as factors 0 and 1, by two means."""
        m = len(self.g)
        single, _ = gains_of(self.blocks, self.g, self.squares)
        best, most = np.zeros(m), None
        for first in np.argsort(-single)[:STARTS]:
            factor = (np.arange(m) == first).astype(float)
            for _ in range(ROUNDS):
                beta = self.gain(factor).beta
                # v'Pv as a function of the factors: s'Qs + 2 l's with beta held, one photograph after another
                Q = np.tensordot(beta, self.H, (0, 1)) @ beta
                linear = self.g @ beta
                again = factor.copy()
                for i in range(m):
                    others = Q[i] @ again - Q[i, i] * again[i]
                    again[i] = float(Q[i, i] + 2 * (linear[i] + others) < 0)
                if (again == factor).all() or not again.any():
                    break
                factor = again
            gain = self.gain(factor)
            if most is None or gain.value > most.value:
                best, most = factor, gain
        assert most is not None
        return best, most


def runs_of(camera: IntArray) -> IntArray:
    """Return the run of each photograph, (m,): those of one camera that follow one another.

    Of more cameras than are tested a run has several.
    """
    m = len(camera)
    if m <= MAX_RUNS:
        return np.arange(m)
    if too_many_cameras(camera):
        camera = np.zeros_like(camera)
    piece = np.empty(m, dtype=np.int64)
    piece[np.argsort(camera, kind="stable")] = np.arange(m) * MAX_RUNS // m
    _, run = np.unique([camera, piece], axis=1, return_inverse=True)
    middle = np.bincount(run, weights=np.arange(m)) / np.bincount(run)
    return np.asarray(np.argsort(np.argsort(middle, kind="stable"))[run])


def too_many_cameras(camera: IntArray) -> bool:
    """Return whether there are more cameras, by `cameras_of_photographs`, than are tested."""
    return int(camera.max()) >= MAX_RUNS
