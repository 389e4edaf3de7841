"""Given points and lengths as differences from the free network.

Points place the free network by a similarity, which most of them agree upon; lengths and placed points each
give its scale.

Source: Mikhail (1976), Observations and Least Squares, ch. 8; Rousseeuw (1984), J. Am. Stat. Assoc. 79(388).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from math import comb

import numpy as np

from sfm.adjustment.quality.given_values import MARGIN, RANK, GivenModel, Judgement, judge_values
from sfm.conventions import BoolArray, FloatArray, IntArray, rotation_from_vector
from sfm.errors import GeometryError
from sfm.similarity import Similarity, fit_similarity, similarity_motions

MAX_TRIPLES = (
    300  # similarities by three points that are tried: with half of them right, 37 are by three such
)
RELINEARISED = 3
MAX_DECIMALS = 8  # of coordinates; more are those of computed ones
SAME_DECIMAL = 1e-6  # by which a number in its last place may differ from a whole one, by its binary rounding
ROUNDING = 16 * np.finfo(float).eps  # of coordinates after a similarity, over the largest of them


@dataclass(frozen=True)
class GivenPoints:
    """Points with given coordinates, and the same points of the free network."""

    given: FloatArray  # NaN where not known, (n, 3)
    stated: FloatArray  # covariance of the known ones, 0 where fixed, (n, 3, 3)
    free: FloatArray  # in the frame of the free network, (n, 3)
    joint: FloatArray  # covariance of the free ones, (3 n, 3 n)
    redundancy: int  # of the free network

    @property
    def known(self) -> FloatArray:
        """Which coordinates are known, (n, 3)."""
        return np.isfinite(self.given)

    @property
    def complete(self) -> IntArray:
        """Points of which all three coordinates are known."""
        return np.flatnonzero(self.known.all(axis=1))

    def select(self, some: IntArray) -> GivenPoints:
        """Return some of the points."""
        rows = (3 * np.asarray(some)[:, None] + np.arange(3)).ravel()
        return replace(
            self,
            given=self.given[some],
            stated=self.stated[some],
            free=self.free[some],
            joint=self.joint[np.ix_(rows, rows)],
        )

    def rounded(self) -> GivenPoints:
        """Return them with the standard deviations that rounding to their last decimal place gives.

        Source: Foerstner and Wrobel (2016), sec. 2.3 (uniform distribution).
        """
        variance = decimal_step(self.given) ** 2 / 12
        return replace(self, stated=np.broadcast_to(variance * np.eye(3), self.stated.shape))

    def mirrored(self) -> GivenPoints:
        """Return them with the free network mirrored."""
        flip = np.tile([-1.0, 1.0, 1.0], len(self.free))
        return replace(
            self, free=self.free * (-1.0, 1.0, 1.0), joint=self.joint * flip[:, None] * flip[None, :]
        )

    def model(self, placing: Similarity, *, estimated: bool) -> GivenModel:
        """Return the differences from the free network as a similarity places it."""
        rows = np.flatnonzero(self.known.ravel())
        X = placing.apply(self.free)
        centre, size = _centre_and_size(X)
        A = similarity_motions(X, centre=centre, size=size).reshape(-1, 7)[rows]
        n = len(X)
        turned = np.einsum(
            "ab,ibjc,dc->iajd", placing.rotation, self.joint.reshape(n, 3, n, 3), placing.rotation
        )
        network = placing.scale**2 * turned.reshape(3 * n, 3 * n)[np.ix_(rows, rows)]
        network[np.diag_indices(len(rows))] += (ROUNDING * np.abs(X).max()) ** 2
        stated = np.zeros((3 * n, 3 * n))
        for k in range(n):
            stated[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = self.stated[k]
        return GivenModel(
            (self.given - X).ravel()[rows],
            network,
            stated[np.ix_(rows, rows)],
            A,
            rows // 3,
            self.redundancy,
            estimated,
        )

    def moved(self, placing: Similarity, model: GivenModel, without: tuple[int, ...]) -> Similarity:
        """Return the similarity that fits the given values best, some left out, by generalised least squares.

        Source: Mikhail (1976), Observations and Least Squares, ch. 8.
        """
        kept = ~np.isin(model.item, without)
        dx = parameters_of(model, kept) @ model.v[kept]
        X = placing.apply(self.free)
        centre, size = _centre_and_size(X)
        R, scale = rotation_from_vector(dx[3:6] / size), float(np.exp(dx[6] / size))
        rotation = R @ placing.rotation
        shift = centre + dx[:3] + scale * R @ (placing.translation - centre)
        return Similarity(scale * placing.scale, rotation, shift)


def decimal_step(numbers: FloatArray) -> float:
    """Return the unit of the last decimal place of numbers; 0 of whole ones and of computed ones."""
    known = numbers[np.isfinite(numbers)]
    if np.abs(known - np.rint(known)).max(initial=0.0) < SAME_DECIMAL:
        return 0.0  # whole numbers may be nominal ones
    steps = 10.0 ** -np.arange(1, MAX_DECIMALS + 1)
    return next(
        (s for s in steps.tolist() if np.abs(known / s - np.rint(known / s)).max() < SAME_DECIMAL), 0.0
    )


def _centre_and_size(X: FloatArray) -> tuple[FloatArray, float]:
    """Return the centre of points and their farthest coordinate from it."""
    centre = X.mean(axis=0)
    return centre, max(float(np.abs(X - centre).max()), np.finfo(float).tiny)


def parameters_of(model: GivenModel, kept: BoolArray) -> FloatArray:
    """Return the parameters as a linear function of the kept differences, (u, m)."""
    S = (model.network + model.stated)[np.ix_(kept, kept)]
    A = model.A[kept]
    unit = max(float(np.trace(S)), np.finfo(float).tiny)
    if model.estimated:
        return np.asarray(np.linalg.pinv(A, rcond=RANK))
    # covariance along the parameters does not change them, and makes that of a free network regular
    P = np.linalg.inv(S + unit * A @ A.T + RANK**1.5 * unit * np.eye(len(S)))
    return np.asarray(np.linalg.pinv(A.T @ P @ A, rcond=RANK, hermitian=True) @ A.T @ P)


@dataclass(frozen=True)
class PlacedPoints:
    """Given points judged, and how they place the free network."""

    judgement: Judgement
    placing: Similarity  # given frame from that of the free network
    model: GivenModel  # at it
    unmirrored: float | None = None  # chi-square as given, where only the mirrored network fits

    @property
    def mirrored(self) -> bool:
        """Whether they fit the mirrored network and not the network."""
        return self.unmirrored is not None


def judge_points(
    points: GivenPoints, level: float, *, start: Similarity | None = None, estimated: bool = False
) -> PlacedPoints | None:
    """Return what is wrong of given points, and how the others place the free network.

    Args:
        points: given, and of the free network.
        level: probability with which right points are said to be wrong.
        start: approximate similarity, used with fewer than three complete points.
        estimated: whether their standard deviations are unknown.

    Returns:
        None where they do not place the network.
    """
    found = _placed(points, level, start, estimated)
    if found is None or found.judgement.fits or found.judgement.wrong or found.judgement.exchanged:
        return found
    other = _placed(points.mirrored(), level, None, estimated)
    if other is not None and (other.judgement.fits or other.judgement.wrong):
        out, as_given = other.judgement.wrong, found.judgement.statistic
        better = other.model.kept(out).chi2 + MARGIN < found.model.kept(out).chi2
        if better and found.model.kept(out).probability() < level:
            return replace(other, unmirrored=as_given)
    return found


def _placed(
    points: GivenPoints, level: float, start: Similarity | None, estimated: bool
) -> PlacedPoints | None:
    """Judge points at the similarity that most of them agree upon."""
    placing = _start(points, start)
    if placing is None:
        return None
    given = points.given.ravel()[np.flatnonzero(points.known.ravel())]
    judgement = None
    for _ in range(RELINEARISED):
        model = points.model(placing, estimated=estimated)
        judgement = judge_values(model, level, given)
        out = judgement.wrong or judgement.exchanged or ()
        placing = points.moved(placing, model, out)
        if not np.isfinite(placing.translation).all():
            return None
    assert judgement is not None
    model = points.model(placing, estimated=estimated)
    return PlacedPoints(judge_values(model, level, given), placing, model)


def _start(points: GivenPoints, start: Similarity | None) -> Similarity | None:
    """Return the similarity by three points of the smallest median distance, else by all, else as given.

    Source: Rousseeuw (1984), J. Am. Stat. Assoc. 79(388), least median of squares.
    """
    at = points.complete
    if len(at) < 3:
        return start
    X, given = points.free[at], points.given[at]
    try:
        best = fit_similarity(X, given)
    except GeometryError:
        return start
    if len(at) == 3:
        return best
    least = float(np.median(np.linalg.norm(best.apply(X) - given, axis=1)))
    every = comb(len(at), 3) <= MAX_TRIPLES
    rng = np.random.default_rng(len(at))
    triples = (
        combinations(range(len(at)), 3)
        if every
        else (rng.choice(len(at), 3, replace=False) for _ in range(MAX_TRIPLES))
    )
    for some in triples:
        own = list(some)
        try:
            one = fit_similarity(X[own], given[own])
        except GeometryError:
            continue
        median = float(np.median(np.linalg.norm(one.apply(X) - given, axis=1)))
        if median < least:
            best, least = one, median
    return best


@dataclass(frozen=True)
class GivenScale:
    """Object units per unit of the free network, by one bar or by all given points together."""

    log: float  # natural logarithm
    rows: FloatArray  # its derivative by the points of the free network, (3 n,)
    variance: float  # of the logarithm, by what was stated


def scale_of_length(length: float, sigma: float, free: FloatArray, start: int, end: int) -> GivenScale:
    """Return the scale by a length between two points of the free network, (n, 3)."""
    apart = free[end] - free[start]
    found = float(np.linalg.norm(apart))
    rows = np.zeros(free.shape)
    rows[end], rows[start] = -apart / found**2, apart / found**2
    return GivenScale(float(np.log(length / found)), rows.ravel(), (sigma / length) ** 2)


def scale_of_points(
    points: GivenPoints, placed: PlacedPoints, without: tuple[int, ...], at: IntArray, count: int
) -> GivenScale:
    """Return the scale by given points, some left out.

    Args:
        points: given, and of the free network.
        placed: the same, judged.
        without: those left out.
        at: which points of the free network they are, (k,).
        count: how many points the free network has, n.
    """
    model, placing = placed.model, placed.placing
    kept = ~np.isin(model.item, without)
    G = parameters_of(model, kept)[6] / _centre_and_size(placing.apply(points.free))[1]
    axis = (np.flatnonzero(points.known.ravel()) % 3)[kept]
    rows = np.zeros((count, 3))
    np.subtract.at(rows, at[model.item[kept]], G[:, None] * placing.scale * placing.rotation[axis])
    return GivenScale(
        float(np.log(placing.scale)), rows.ravel(), float(G @ model.stated[np.ix_(kept, kept)] @ G)
    )


def scale_model(scales: tuple[GivenScale, ...], joint: FloatArray, redundancy: int) -> GivenModel:
    """Return the differences of scales, with the covariance of the points of the free network, (3 n, 3 n)."""
    H = np.stack([one.rows for one in scales])
    return GivenModel(
        np.array([one.log for one in scales]),
        H @ joint @ H.T,
        np.diag([one.variance for one in scales]),
        np.ones((len(scales), 1)),
        np.arange(len(scales)),
        redundancy,
    )
