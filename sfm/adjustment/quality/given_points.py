"""Given points as differences from the free network.

Points place the free network by a similarity, which most of them agree upon. Where points do not fit, they
may also be stretched, left-handed or have one another's names.

Source: Mikhail (1976), Observations and Least Squares, ch. 8; Rousseeuw (1984), J. Am. Stat. Assoc. 79(388).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations
from math import comb, log

import numpy as np

from sfm.adjustment.quality.given_names import assignments, cost_of_choice, moved_by
from sfm.adjustment.quality.given_values import (
    MARGIN,
    RANK,
    GivenModel,
    Judgement,
    cost_of_scatter,
    judge_values,
    misfit_of,
)
from sfm.conventions import BoolArray, FloatArray, IntArray, rotation_from_vector
from sfm.errors import GeometryError
from sfm.similarity import Similarity, extended_axes, fit_similarities, fit_similarity, similarity_motions

MAX_TRIPLES = (
    300  # similarities by three points that are tried: with half of them right, 37 are by three such
)
MAX_STEPS = 20  # of a similarity to the best one; those to one that fits are fewer than ten
MAX_DECIMALS = 8  # of coordinates; more are those of computed ones
SAME_DECIMAL = 1e-6  # by which a number in its last place may differ from a whole one, by its binary rounding
STRAINS = (  # derivatives of coordinates by their parameters, along an axis or of an affinity, (u, 3, 3)
    *(np.diag(e)[None] for e in np.eye(3)),
    np.array(
        [np.diag([1.0, -1, 0]), np.diag([0, 1.0, -1])]
        + [np.outer(a, b) + np.outer(b, a) for a, b in combinations(np.eye(3), 2)]
    ),
)
ROUNDING = 16 * np.finfo(float).eps  # of coordinates after a similarity, over the largest of them


@dataclass(frozen=True, eq=False)
class Strain:
    """Stretched coordinates, but for their scale where it stretches all axes."""

    derivatives: FloatArray  # by its parameters, (u, 3, 3)
    F: FloatArray  # stretched coordinates from those that are not, about their centre, (3, 3)
    axis: str | None = None  # the only one that is stretched, where no other explains as much
    chi2: float = 0.0  # of points that are not stretched

    @property
    def elongation(self) -> float:
        """Relative elongation along the axis; of all axes that of the longest over the shortest."""
        d = np.linalg.svd(self.F, compute_uv=False)
        return float(np.trace(self.F) - 3 if len(self.derivatives) == 1 else d[0] / d[-1] - 1)


@dataclass(frozen=True)
class GivenPoints:
    """Points with given coordinates, and the same points of the free network."""

    given: FloatArray  # NaN where not known, (n, 3)
    stated: FloatArray  # covariance of the known ones, 0 where fixed, (n, 3, 3)
    free: FloatArray  # in the frame of the free network, (n, 3)
    joint: FloatArray  # covariance of the free ones, (3 n, 3 n)
    redundancy: int  # of the free network
    strain: Strain | None = None  # of the given coordinates

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

    @property
    def variances(self) -> tuple[FloatArray, FloatArray]:
        """Mean variance of a coordinate of free points, in their frame, and of given ones, (n,) each."""
        of_free = np.diagonal(self.joint).reshape(-1, 3).mean(axis=1)
        return of_free, np.einsum("nii->n", self.stated) / 3

    def reordered(self, order: tuple[int, ...]) -> GivenPoints:
        """Return them with the given coordinates of others."""
        return replace(self, given=self.given[list(order)], stated=self.stated[list(order)])

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
        centre, size = centre_and_size(X)
        A = similarity_motions(X, centre=centre, size=size).reshape(-1, 3, 7)
        n, R = len(X), placing.rotation
        if self.strain is not None:
            E, F = self.strain.derivatives, self.strain.F
            by_strain = np.einsum("uab,nb->nau", E, (X - centre) / size)
            X, R = centre + (X - centre) @ F.T, F @ R
            A = np.concatenate([np.einsum("ab,nbu->nau", F, A), by_strain], axis=2)
        A = A.reshape(3 * n, -1)[rows]
        turned = np.einsum("ab,ibjc,dc->iajd", R, self.joint.reshape(n, 3, n, 3), R)
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
            2 * float(np.median(np.linalg.norm(X - np.median(X, axis=0), axis=1))),
        )

    def moved(self, placing: Similarity, model: GivenModel, without: tuple[int, ...]) -> Similarity:
        """Return the similarity that fits the given values best, some left out, by generalised least squares.

        Source: Mikhail (1976), Observations and Least Squares, ch. 8.
        """
        kept = ~np.isin(model.item, without)
        dx = parameters_of(model, kept) @ model.v[kept]
        X = placing.apply(self.free)
        centre, size = centre_and_size(X)
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


def centre_and_size(X: FloatArray) -> tuple[FloatArray, float]:
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
    order: tuple[int, ...] = ()  # whose coordinates each has, where they fit with other names
    exchangeable: tuple[int, ...] = ()  # those whose names, if exchanged, explain the differences as well
    strain: Strain | None = None  # that explains the differences
    cost_of_strain: float = 0.0

    @property
    def mirrored(self) -> bool:
        """Whether they fit the mirrored network and not the network."""
        return self.unmirrored is not None

    @property
    def misfit(self) -> float:
        """Chi-square with what is wrong, and its cost."""
        return misfit_of(self.model, self.judgement)

    @property
    def cost(self) -> float:
        """Their misfit, and what a strain and the choice of other names cost."""
        return self.misfit + self.cost_of_strain + cost_of_choice(self.order)

    @property
    def agreeing(self) -> Similarity | None:
        """The similarity, if more than half of the points agree upon it."""
        return self.placing if self.judgement.wrong else None

    @property
    def renamed(self) -> tuple[int, ...]:
        """Those with the coordinates of another."""
        return tuple(k for k in moved_by(self.order) if k not in self.judgement.wrong)


def judge_points(
    points: GivenPoints, level: float, *, start: Similarity | None = None, estimated: bool = False
) -> PlacedPoints | None:
    """Return what is wrong of given points, and how the others place the free network.

    The most likely explanation counts: errors of single points, that all are mirrored, stretched, or have one
    another's names. Where it is not more likely than others by the margin, they contradict one another, but
    for what may be mirrored: that is no figure to be placed.

    Args:
        points: given, and of the free network.
        level: probability with which right points are reported as wrong.
        start: approximate similarity, used with fewer than three complete points.
        estimated: whether their standard deviations are unknown.

    Returns:
        None where they do not place the network.
    """
    found = _placed(points, level, start, estimated)
    if found is None or found.judgement.fits:
        return found
    others = list(_renamed(points, level, found.agreeing, estimated))
    mirrored = _placed(points.mirrored(), level, None, estimated)
    if mirrored is not None and mirrored.judgement.explained:
        others.append(replace(mirrored, unmirrored=found.judgement.statistic))
    strained = _strained(points, level, found, estimated)
    if strained is not None:
        others.append(strained)
    if not others or min(one.cost for one in others) >= found.misfit:
        if strained is not None and strained.cost < found.misfit + MARGIN:
            return _contradiction(found, [strained])
        return found
    best = min(others, key=lambda one: one.cost)
    like = [one for one in others if one.cost < best.cost + MARGIN]
    if best.cost >= found.misfit - MARGIN:
        return _contradiction(found, [found, *like])
    either = next((one for one in like if one.mirrored), None)
    if either is not None:
        # as a whole left and right may be exchanged, which is no choice among all orders
        like = [one for one in others if one.order and one.misfit < either.misfit + MARGIN]
        return replace(either, exchangeable=_points_of(like))
    if len(like) > 1:
        return _contradiction(found, like)
    return replace(_contradiction(found, like), strain=best.strain) if best.strain else best


def excludes_mirror(points: GivenPoints, found: PlacedPoints) -> bool:
    """Return whether points, those left out that are wrong, fit the network and not the mirrored one.

    Of n differences the mirror image is less likely by n ln of the ratio of chi-square over n, in -2 ln
    likelihood with a variance factor that is not known, and at least 1: where some contradict one another,
    both have their misfit.

    Args:
        points: given, and of the free network.
        found: the same, judged and not mirrored.

    Source: Seber and Wild (1989), Nonlinear Regression, sec. 2.2.
    """
    kept = np.setdiff1d(np.arange(len(points.given)), found.judgement.wrong)
    mirrored = (points.reordered(found.order) if found.order else points).select(kept).mirrored()
    start = next(_starts(mirrored, None), None)
    if start is None:
        return False
    like = found.model.part(np.isin(found.model.item, kept)).all_kept
    unlike = mirrored.model(start, estimated=False).all_kept
    n = like.dof
    return n > 0 and n * float(np.log(max(unlike.chi2, n) / max(like.chi2, n))) > MARGIN


def _renamed(
    points: GivenPoints, level: float, agreed: Similarity | None, estimated: bool
) -> Iterator[PlacedPoints]:
    """Yield points with other names, where these explain the differences."""
    for order in assignments(points.free, points.given, points.variances, agreed):
        one = _placed(points.reordered(order), level, None, estimated)
        if one is not None and one.judgement.explained:
            yield replace(one, order=order)


def _points_of(explanations: list[PlacedPoints]) -> tuple[int, ...]:
    """Return the points whose names explanations exchange."""
    return tuple(sorted({k for one in explanations for k in one.renamed}))


def _contradiction(found: PlacedPoints, like: list[PlacedPoints]) -> PlacedPoints:
    """Return points as given, of which nothing shows which of several explanations is right."""
    some = {k for one in like for k in (*moved_by(one.order), *one.judgement.wrong, *one.judgement.doubtful)}
    if not some or any(one.mirrored or one.strain for one in like):
        some = set(range(found.model.items))
    return replace(
        found, judgement=found.judgement.contradicted(tuple(sorted(some))), exchangeable=_points_of(like)
    )


def _strained(points: GivenPoints, level: float, found: PlacedPoints, estimated: bool) -> PlacedPoints | None:
    """Return points that fit as stretched ones, along an axis or more, by the most likely strain.

    Nothing shows which axes are right, and whether the scale is.
    """
    fitting: list[tuple[PlacedPoints, Strain]] = []
    for derivatives in _determined_strains(points.given[points.complete]):
        strain, placing = Strain(derivatives, np.eye(3)), found.placing
        model: GivenModel | None = None
        for _ in range(MAX_STEPS):
            try:
                placing, model = _converged(replace(points, strain=strain), placing, (), estimated)
            except np.linalg.LinAlgError:  # a strain that flattens the points explains nothing
                model = None
                break
            size = centre_and_size(placing.apply(points.free))[1]
            step = parameters_of(model, np.ones(len(model.v), dtype=bool))[7:] @ model.v / size
            F = strain.F + np.einsum("u,uab->ab", step, derivatives)
            if not np.linalg.det(F) > 0 or np.abs(step).max() <= RANK:
                break
            strain = replace(strain, F=F)
        if model is not None and model.fits(level) and model.confirms_rest(()):
            judgement = judge_values(model, level)
            q, fall = found.judgement.dof - judgement.dof, found.judgement.statistic - judgement.statistic
            cost = cost_of_scatter(q, fall, len(model.v)) + 2 * log(len(STRAINS))
            fitting.append((PlacedPoints(judgement, placing, model, cost_of_strain=cost), strain))
    if not fitting:
        return None
    best, strain = min(fitting, key=lambda one: one[0].cost)
    like = [other for one, other in fitting if one.cost < best.cost + MARGIN and len(other.derivatives) == 1]
    axis = "XYZ"[int(strain.derivatives[0].diagonal().argmax())] if like == [strain] else None
    return replace(best, strain=replace(strain, axis=axis, chi2=best.judgement.statistic))


def _determined_strains(xyz: FloatArray) -> list[FloatArray]:
    """Return the strains that show in points: not those along the normal of a plane, or beside a line."""
    axes = extended_axes(xyz)[0]
    if len(axes) < 2:  # along a line it is the scale
        return []
    onto = axes.T @ axes
    shown = []
    for derivatives in STRAINS:
        inside = onto @ derivatives @ onto
        if len(inside) > 1:  # beside the scale
            inside = inside - np.trace(inside, axis1=1, axis2=2)[:, None, None] / len(axes) * onto
        shares, directions = np.linalg.svd(inside.reshape(len(inside), 9), full_matrices=False)[1:]
        rank = int((shares > RANK).sum()) if len(axes) < 3 else len(derivatives)
        if rank == len(derivatives):
            shown.append(inside)
        elif rank and len(derivatives) > 1:
            shown.append(directions[:rank].reshape(rank, 3, 3))
    return shown


def _placed(
    points: GivenPoints, level: float, start: Similarity | None, estimated: bool
) -> PlacedPoints | None:
    """Judge points at the similarity of all, and where they do not fit, at that which most agree upon."""
    best: PlacedPoints | None = None
    for k, placing in enumerate(_starts(points, start)):
        # at what most agree upon, the others are left out before they move it
        at_start = judge_values(points.model(placing, estimated=estimated), level) if k else None
        found = _judged(points, placing, () if at_start is None else at_start.wrong, level, estimated)
        if found.judgement.fits:
            return found
        if best is None or found.judgement.misfit < best.judgement.misfit:
            best = found
    return best


def _judged(
    points: GivenPoints, placing: Similarity, out: tuple[int, ...], level: float, estimated: bool
) -> PlacedPoints:
    """Judge points at the similarity that fits them best, until it is without those that are wrong."""
    tried: set[tuple[int, ...]] = set()
    while True:
        tried.add(out)
        placing, model = _converged(points, placing, out, estimated)
        judgement = judge_values(model, level)
        out = judgement.wrong
        if out in tried:
            return PlacedPoints(judgement, placing, model)


def _converged(
    points: GivenPoints, placing: Similarity, without: tuple[int, ...], estimated: bool
) -> tuple[Similarity, GivenModel]:
    """Return the similarity that fits points best, some left out, and the model at it.

    A step that changes no coordinate beyond their linear dependence or their rounding is the last one. Points
    that do not fit at all need not converge, as a larger scale makes the covariance of the network larger:
    they are judged where they started.
    """
    start = placing, points.model(placing, estimated=estimated)
    placing, model = start
    for _ in range(MAX_STEPS):
        with np.errstate(over="ignore", invalid="ignore"):
            moved = points.moved(placing, model, without)
            X, Y = placing.apply(points.free), moved.apply(points.free)
            if not np.isfinite((Y / ROUNDING) ** 2).all():  # nor would its weights be
                break
        placing, model = moved, points.model(moved, estimated=estimated)
        if np.abs(Y - X).max() <= RANK * centre_and_size(Y)[1] + ROUNDING * np.abs(Y).max():
            return placing, model
    return start


def _starts(points: GivenPoints, start: Similarity | None) -> Iterator[Similarity]:
    """Yield the similarity by all points, then that by three of them which most agree upon; else as given.

    Of the triples, that with the smallest median distance, h = [n / 2] + 1: a similarity does not meet three
    points exactly.

    Source: Rousseeuw (1984), J. Am. Stat. Assoc. 79(388), least median of squares.
    """
    at = points.complete
    X, given = points.free[at], points.given[at]
    try:
        every = None if len(at) < 3 else fit_similarity(X, given)
    except GeometryError:
        every = None
    if every is None:
        if start is not None:
            yield start
        return
    yield every
    best, least, h = None, np.inf, len(at) // 2 + 1
    if len(at) > 3:
        triples = _triples(len(at), MAX_TRIPLES)
        for one in fit_similarities(X[triples], given[triples]):
            if one is None:
                continue
            distance = float(np.partition(np.linalg.norm(one.apply(X) - given, axis=1), h - 1)[h - 1])
            if distance < least:
                best, least = one, distance
    if best is not None:
        yield best


@lru_cache(maxsize=64)
def _triples(n: int, most: int) -> IntArray:
    """Return all threes of n points, or `most` random ones where these are more, (t, 3)."""
    if comb(n, 3) <= most:
        return np.array(list(combinations(range(n), 3)))
    rng = np.random.default_rng(n)
    return np.array([rng.choice(n, 3, replace=False) for _ in range(most)])
