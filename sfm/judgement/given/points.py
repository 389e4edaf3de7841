"""Given points: judges given coordinates by their differences from the free network.

A similarity on which most points agree transforms the free network to the given points. If points do not
fit, they may be wrong, stretched, left-handed or have exchanged names.

Source: Mikhail (1976), Observations and Least Squares, ch. 8; Rousseeuw (1984), J. Am. Stat. Assoc. 79(388).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations
from math import comb, log

import numpy as np

from sfm.judgement.given.free_network import Reference, centre_and_size
from sfm.judgement.given.mistakes import assignments, cost_of_choice, explanations, find_renamed
from sfm.judgement.given.values import RANK, GivenModel, Judgement, cost_of_scatter, judge_values, misfit_of
from sfm.model.conventions import BoolArray, FloatArray, IntArray, rotation_from_vector
from sfm.model.distributions import MARGIN
from sfm.model.errors import GeometryError
from sfm.model.observations.kind import CoordinateKind
from sfm.model.similarity import Similarity, extended_axes, fit_similarities, fit_similarity

MAX_TRIPLES = 300  # tried similarities from three points; with half of the points correct, 37 are correct
MAX_STEPS = 20  # iterations of a similarity; one that fits needs fewer than ten
ALONG_AXES = tuple(np.diag(e)[None] for e in np.eye(3))
AFFINITY = np.array(
    [np.diag([1.0, -1, 0]), np.diag([0, 1.0, -1])]
    + [np.outer(a, b) + np.outer(b, a) for a, b in combinations(np.eye(3), 2)]
)
STRAINS = (*ALONG_AXES, AFFINITY)  # derivatives of coordinates by the parameters, (u, 3, 3)
UNCHANGED = Similarity(1.0, np.eye(3), np.zeros(3))
ROUNDING = 16 * np.finfo(float).eps  # rounding error of transformed coordinates, relative to the largest


@dataclass(frozen=True, eq=False)
class Strain:
    """A strain of the given coordinates; if it involves all axes, the scale is left out."""

    derivatives: FloatArray  # derivatives of coordinates by the parameters, (u, 3, 3)
    F: FloatArray  # matrix from original to stretched coordinates about their centre, (3, 3)
    axis: str | None = None  # stretched axis, if no other axis explains as much
    chi2: float = 0.0  # chi-square with the strain

    @property
    def elongation(self) -> float:
        """Relative elongation along the axis; for all axes, that of the longest relative to the shortest."""
        d = np.linalg.svd(self.F, compute_uv=False)
        return float(np.trace(self.F) - 3 if len(self.derivatives) == 1 else d[0] / d[-1] - 1)

    def of(self, model: GivenModel, X: FloatArray) -> GivenModel:
        """Return the differences of points X, (n, 3), that are stretched; the strain is a parameter."""
        centre, size = centre_and_size(X)
        by_strain = np.einsum("uab,nb->nau", self.derivatives, (X - centre) / size)
        A = np.hstack([self._turned(model.A), by_strain.reshape(len(model.v), -1)])
        away = (X - centre) @ (self.F - np.eye(3)).T
        network = self._turned(self._turned(model.network).T)
        return replace(model, v=model.v - away.ravel(), network=network, A=A)

    def _turned(self, rows: FloatArray) -> FloatArray:
        """Return the effect of changes of points on the stretched points, (3 n, u)."""
        turned = np.einsum("ab,nbu->nau", self.F, rows.reshape(-1, 3, rows.shape[1]))
        return np.asarray(turned.reshape(rows.shape))


@dataclass(frozen=True)
class GivenPoints:
    """Given coordinates of points or projection centres, which are compared with the free network."""

    kind: CoordinateKind
    reference: Reference
    strain: Strain | None = None  # strain of the given coordinates

    @property
    def given(self) -> FloatArray:
        """Given coordinates; NaN where unknown, (n, 3)."""
        return self.kind.coordinates

    @property
    def stated(self) -> FloatArray:
        """Covariance of the given coordinates, 0 where fixed or unknown, (n, 3, 3)."""
        covariance = self.kind.coordinate_covariance
        return np.where(np.isfinite(covariance), covariance, 0.0)

    @property
    def free(self) -> FloatArray:
        """Points in the frame of the free network, (n, 3)."""
        return self.reference.places(self.kind)

    @property
    def complete(self) -> IntArray:
        """Points with all three coordinates known."""
        return np.flatnonzero(np.isfinite(self.given).all(axis=1))

    def select(self, rows: IntArray) -> GivenPoints:
        """Return the points of the given indices."""
        return replace(self, kind=self.kind.select(np.asarray(rows)))

    @property
    def variances(self) -> tuple[FloatArray, FloatArray]:
        """Mean variance of a coordinate of free points, in their frame, and of given ones, (n,) each."""
        everything = self.kind.with_coordinate_covariance(self.stated)
        model, _ = self.reference.differences([everything], UNCHANGED)
        of_free = np.diagonal(model.network).reshape(-1, 3).mean(axis=1)
        return of_free, np.einsum("nii->n", self.stated) / 3

    def with_stated(self, stated: FloatArray) -> GivenPoints:
        """Return the points with another covariance of the known coordinates, (n, 3, 3)."""
        covariance = self.kind.coordinate_covariance
        covariance = np.where(np.isfinite(covariance), stated, covariance)
        return replace(self, kind=self.kind.with_coordinate_covariance(covariance))

    def mirrored(self) -> GivenPoints:
        """Return the points in a mirrored system."""
        return replace(self, kind=self.kind.mistakes()["mirrored"])

    def model(self, placing: Similarity, *, estimated: bool) -> GivenModel:
        """Return the differences from the free network after a similarity to the given frame."""
        X = self.reference.places(self.kind, placing)
        if self.strain is None:
            model, _ = self.reference.differences([self.kind], placing)
        else:
            everything = self.kind.with_coordinate_covariance(self.stated)
            model, _ = self.reference.differences([everything], placing)
            model = self.strain.of(model, X).part(np.isfinite(self.given).ravel())
        rounding = (ROUNDING * np.abs(X).max()) ** 2 * np.eye(len(model.v))
        extent = 2 * float(np.median(np.linalg.norm(X - np.median(X, axis=0), axis=1)))
        return replace(model, network=model.network + rounding, estimated=estimated, extent=extent)

    def moved(self, placing: Similarity, model: GivenModel, without: tuple[int, ...]) -> Similarity:
        """Return the similarity that best fits the given values, without some, by generalised least squares.

        Source: Mikhail (1976), Observations and Least Squares, ch. 8.
        """
        kept = ~np.isin(model.item, without)
        dx = parameters_of(model, kept) @ model.v[kept]
        centre, size = centre_and_size(self.reference.places(self.kind, placing))
        R, scale = rotation_from_vector(dx[3:6] / size), float(np.exp(dx[6] / size))
        rotation = R @ placing.rotation
        shift = centre + dx[:3] + scale * R @ (placing.translation - centre)
        return Similarity(scale * placing.scale, rotation, shift)


def parameters_of(model: GivenModel, kept: BoolArray) -> FloatArray:
    """Return the matrix that gives the parameters from the kept differences, (u, m)."""
    S = (model.network + model.stated)[np.ix_(kept, kept)]
    A = model.A[kept]
    unit = max(float(np.trace(S)), np.finfo(float).tiny)
    if model.estimated:
        return np.asarray(np.linalg.pinv(A, rcond=RANK))
    # additional covariance along the parameters does not change them, and makes a singular one regular
    P = np.linalg.inv(S + unit * A @ A.T + RANK**1.5 * unit * np.eye(len(S)))
    return np.asarray(np.linalg.pinv(A.T @ P @ A, rcond=RANK, hermitian=True) @ A.T @ P)


@dataclass(frozen=True)
class PlacedPoints:
    """Judged given points, and the similarity between them and the free network."""

    judgement: Judgement
    placing: Similarity  # given frame from the frame of the free network
    model: GivenModel  # differences after the similarity
    points: GivenPoints  # with corrected names
    unmirrored: float | None = None  # chi-square without mirroring, if only the mirrored network fits
    order: tuple[int, ...] = ()  # point whose coordinates each point has, if they fit with other names
    exchangeable: tuple[int, ...] = ()  # points whose exchanged names would explain the differences as well
    strain: Strain | None = None  # strain that explains the differences
    cost_of_strain: float = 0.0

    @property
    def mirrored(self) -> bool:
        """Whether the points fit the mirrored network only."""
        return self.unmirrored is not None

    @property
    def misfit(self) -> float:
        """Chi-square after accounting for the errors found, plus the cost of these errors."""
        return misfit_of(self.model, self.judgement)

    @property
    def cost(self) -> float:
        """Misfit plus the cost of a strain and of the choice of other names."""
        return self.misfit + self.cost_of_strain + cost_of_choice(self.order)

    @property
    def agreeing(self) -> Similarity | None:
        """The similarity, if more than half of the points agree on it."""
        return self.placing if self.judgement.wrong else None

    @property
    def renamed(self) -> tuple[int, ...]:
        """Points that have the coordinates of another point."""
        return tuple(k for k in find_renamed(self.order) if k not in self.judgement.wrong)


def judge_points(
    points: GivenPoints, level: float, *, start: Similarity | None = None, estimated: bool = False
) -> PlacedPoints | None:
    """Return the errors of given points, and the similarity from the free network to the other points.

    The most likely explanation is chosen: errors of single points, or all points mirrored, stretched or with
    exchanged names. If it does not exceed the others by the margin, the points contradict one another. The
    exception is a mirrored figure, which is reported as mirrored.

    Args:
        points: given points, and the same points of the free network.
        level: probability that correct points are reported as wrong.
        start: approximate similarity, used with fewer than three complete points.
        estimated: whether the standard deviations are unknown.

    Returns:
        The judged points; None if they do not determine a similarity.
    """
    as_given = _placed(points, level, start, estimated)
    if as_given is None or as_given.judgement.fits:
        return as_given
    others = list(_corrected(points, level, as_given, estimated))
    strained = _strained(points, level, as_given, estimated)
    if strained is not None:
        others.append(strained)
    if not others or min(other.cost for other in others) >= as_given.misfit:
        if strained is not None and strained.cost < as_given.misfit + MARGIN:
            return _contradiction(as_given, [strained])
        return as_given
    best = min(others, key=lambda other: other.cost)
    like = [other for other in others if other.cost < best.cost + MARGIN]
    if best.cost >= as_given.misfit - MARGIN:
        return _contradiction(as_given, [as_given, *like])
    either = next((other for other in like if other.mirrored), None)
    if either is not None:
        # names of left and right may be exchanged as a whole, which is not a choice among all orders
        like = [other for other in others if other.misfit < either.misfit + MARGIN]
        return replace(either, exchangeable=_points_of(like))
    if len(like) > 1:
        return _contradiction(as_given, like)
    return replace(_contradiction(as_given, like), strain=best.strain) if best.strain else best


def excludes_mirror(placed: PlacedPoints) -> bool:
    """Return whether points fit the network, but not the mirrored network, without the wrong ones.

    They must not be mirrored. With n differences the mirror image is less likely by n ln of the ratio of both
    chi-squares, in -2 ln likelihood. This assumes an unknown variance factor of at least 1. Both chi-squares
    include the misfit of points that contradict one another.

    Source: Seber and Wild (1989), Nonlinear Regression, sec. 2.2.
    """
    kept = np.setdiff1d(np.arange(len(placed.points.given)), placed.judgement.wrong)
    mirrored = placed.points.select(kept).mirrored()
    start = next(_starts(mirrored, None), None)
    if start is None:
        return False
    like = placed.model.part(np.isin(placed.model.item, kept)).all_kept
    unlike = mirrored.model(start, estimated=False).all_kept
    n = like.dof
    return n > 0 and n * float(np.log(max(unlike.chi2, n) / max(like.chi2, n))) > MARGIN


def _corrected(
    points: GivenPoints, level: float, as_given: PlacedPoints, estimated: bool
) -> Iterator[PlacedPoints]:
    """Yield the points with other names, and mirrored, that explain the differences."""

    def judge(mended: list[CoordinateKind]) -> PlacedPoints | None:
        placed = _placed(replace(points, kind=mended[0]), level, None, estimated)
        return placed if placed is not None and placed.judgement.explained else None

    orders = {
        f"names {order}": order
        for order in assignments(points.free, points.given, points.variances, as_given.agreeing)
    }
    renamed = {name: points.kind.reordered(np.array(order)) for name, order in orders.items()}
    corrected = {**renamed, **points.kind.mistakes()}
    for mistake, placed in explanations([points.kind], judge, [corrected]).items():
        unmirrored = as_given.judgement.statistic if mistake == "mirrored" else None
        yield replace(placed, order=orders.get(mistake, ()), unmirrored=unmirrored)


def _points_of(explanations: list[PlacedPoints]) -> tuple[int, ...]:
    """Return the points whose names are exchanged in any of the explanations."""
    return tuple(sorted({k for explanation in explanations for k in explanation.renamed}))


def _contradiction(as_given: PlacedPoints, like: list[PlacedPoints]) -> PlacedPoints:
    """Return points as given, marked as doubtful because several explanations are possible."""
    suspected = {
        k
        for explanation in like
        for k in (
            *find_renamed(explanation.order),
            *explanation.judgement.wrong,
            *explanation.judgement.doubtful,
        )
    }
    if not suspected or any(explanation.mirrored or explanation.strain for explanation in like):
        suspected = set(range(as_given.model.items))
    return replace(
        as_given,
        judgement=as_given.judgement.contradicted(tuple(sorted(suspected))),
        exchangeable=_points_of(like),
    )


def _strained(
    points: GivenPoints, level: float, as_given: PlacedPoints, estimated: bool
) -> PlacedPoints | None:
    """Return points that fit with the most likely strain, along one axis or more; None if no strain fits.

    Which axes are right, and whether the scale is, cannot be decided.
    """
    fitting: list[tuple[PlacedPoints, Strain]] = []
    for derivatives in _determined_strains(points.given[points.complete]):
        strain, placing = Strain(derivatives, np.eye(3)), as_given.placing
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
            q = as_given.judgement.dof - judgement.dof
            fall = as_given.judgement.statistic - judgement.statistic
            cost = cost_of_scatter(q, fall, len(model.v)) + 2 * log(len(STRAINS))
            fitting.append((PlacedPoints(judgement, placing, model, points, cost_of_strain=cost), strain))
    if not fitting:
        return None
    best, strain = min(fitting, key=lambda fit: fit[0].cost)
    like = [
        other for placed, other in fitting if placed.cost < best.cost + MARGIN and len(other.derivatives) == 1
    ]
    axis = "XYZ"[int(strain.derivatives[0].diagonal().argmax())] if like == [strain] else None
    return replace(best, strain=replace(strain, axis=axis, chi2=best.judgement.statistic))


def _determined_strains(xyz: FloatArray) -> list[FloatArray]:
    """Return the strains that points determine: not along the normal of a plane, or across a line."""
    axes = extended_axes(xyz)[0]
    if len(axes) < 2:  # along a line a strain is the scale
        return []
    onto = axes.T @ axes
    shown = []
    for derivatives in STRAINS:
        inside = onto @ derivatives @ onto
        if len(inside) > 1:  # without the scale
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
    """Judge points with the similarity of all points or, if they do not fit, with one on which most agree."""
    best: PlacedPoints | None = None
    for k, placing in enumerate(_starts(points, start)):
        # with the similarity on which most agree, the others are left out before they can change it
        out = judge_values(points.model(placing, estimated=estimated), level).wrong if k else ()
        tried: set[tuple[int, ...]] = set()
        while out not in tried:  # until the similarity is free of wrong points
            tried.add(out)
            placing, model = _converged(points, placing, out, estimated)
            judgement = judge_values(model, level)
            out = judgement.wrong
        judged = PlacedPoints(judgement, placing, model, points)
        if judged.judgement.fits:
            return judged
        if best is None or judged.judgement.misfit < best.judgement.misfit:
            best = judged
    return best


def _converged(
    points: GivenPoints, placing: Similarity, without: tuple[int, ...], estimated: bool
) -> tuple[Similarity, GivenModel]:
    """Return the similarity that fits points best, with some left out, and the model after it.

    The iteration ends when a step changes no coordinate by more than RANK times the size, or rounding. Points
    that do not fit at all may not converge, because a larger scale increases the covariance of the network.
    They are judged at their start.
    """
    start = placing, points.model(placing, estimated=estimated)
    placing, model = start
    for _ in range(MAX_STEPS):
        with np.errstate(over="ignore", invalid="ignore"):
            moved = points.moved(placing, model, without)
            X, Y = placing.apply(points.free), moved.apply(points.free)
            if not np.isfinite((Y / ROUNDING) ** 2).all():  # its weights would not be finite either
                break
        placing, model = moved, points.model(moved, estimated=estimated)
        if np.abs(Y - X).max() <= RANK * centre_and_size(Y)[1] + ROUNDING * np.abs(Y).max():
            return placing, model
    return start


def _starts(points: GivenPoints, start: Similarity | None) -> Iterator[Similarity]:
    """Yield the similarity from all points, then the one from three points on which most points agree.

    Without a similarity from all points, yield the given start. The best triple has the smallest median
    distance, with h = [n / 2] + 1, because a similarity does not fit three points exactly.

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
        for similarity in fit_similarities(X[triples], given[triples]):
            if similarity is None:
                continue
            distance = float(np.partition(np.linalg.norm(similarity.apply(X) - given, axis=1), h - 1)[h - 1])
            if distance < least:
                best, least = similarity, distance
    if best is not None:
        yield best


@lru_cache(maxsize=64)
def _triples(n: int, most: int) -> IntArray:
    """Return all triples of n points, or `most` random triples if there are more, (t, 3)."""
    if comb(n, 3) <= most:
        return np.array(list(combinations(range(n), 3)))
    rng = np.random.default_rng(n)
    return np.array([rng.choice(n, 3, replace=False) for _ in range(most)])
