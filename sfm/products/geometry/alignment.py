"""Alignment of a result with its covariance: 3-2-1, by features, or by best fit to nominal points.

If a transformation x' = s R x + t is computed from the points themselves, it depends on their errors:
dx' = s R dx + M dT with dT = F dx. With D = diag(s R), the covariance is Q' = (D + M F) Q (D + M F)', the
S-transformation to the new datum. The defining coordinates have no variance afterwards.

A best fit is weighted with the covariance of the points in their datum. In another datum of the same network
the fit differs within its uncertainty, and its test is the same.

Source: Baarda (1973), S-transformations and criterion matrices; Luhmann et al. (2020), Close-Range
Photogrammetry and 3D Imaging, secs. 2.2.4 and 6.2.3; Horn (1987) for the start of the best fit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from sfm.comparison.pairing import fit_robustly
from sfm.comparison.stable_points import critical_value
from sfm.model.arguments import checked_arguments
from sfm.model.conventions import BoolArray, FloatArray, IntArray, rotation_from_vector
from sfm.model.display import counted
from sfm.model.distributions import FALSE_ALARM
from sfm.model.errors import GeometryError
from sfm.model.network import indices_of
from sfm.model.similarity import Similarity, fit_similarity, similarity_motions
from sfm.products.geometry.measured import Function, MeasuredPoints, coordinates_of, join_functions

ITERATIONS = 50
CONVERGED = 1e-13
REJECTED = 4.685  # robust standard deviations beyond which a point takes no part
MEDIAN_OF_LENGTH = 1.538  # median length of a vector of three independent normal deviations, in sigmas


@dataclass(frozen=True)
class Alignment:
    """A transformation into another system, with its derivatives by the points that define it."""

    method: str  # 3-2-1 | features | points
    aligned_from_object: Similarity
    points: IntArray  # indices of the defining points, (m,)
    linear: FloatArray  # F: shifts, rotations, scale in the new system by their coordinates, (7, 3 m)
    covariance_of_nominal: FloatArray  # contribution of nominal points to the covariance of the seven, (7, 7)
    scaled: bool  # whether the scale was fitted
    fitted: BestFit | None = None

    def apply(self, points: MeasuredPoints) -> MeasuredPoints:
        """Return points in the new system with their covariance.

        Args:
            points: points of the same result.
        """
        T = self.aligned_from_object
        xyz = T.apply(points.xyz)
        if points.covariance is None:
            covariance = None
        elif points.covariance.ndim == 2:
            covariance = self._moved_covariance(points.covariance, xyz)
        else:
            covariance = self._moved_blocks(points.covariance, xyz)
        sample, known = points.sample, None
        if sample is not None and points.sample_covariance is not None:
            if points.correlated_among(self.points):
                place = np.full(len(points.names), -1)
                place[sample] = np.arange(len(sample))
                of_sample = replace(self, points=place[self.points])
                known = of_sample._moved_covariance(points.sample_covariance, xyz[sample])
                assert covariance is not None  # points with a sample have marginal covariances
                covariance[sample] = [known[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(len(sample))]
            else:  # the system depends on points without a joint covariance with the others
                sample = None
        has_scale = points.has_scale or self.scaled
        return replace(
            points,
            xyz=xyz,
            covariance=covariance,
            datum="aligned",
            has_scale=has_scale,
            sample=sample,
            sample_covariance=known,
        )

    def _moved_covariance(self, Q: FloatArray, xyz: FloatArray) -> FloatArray:
        D, M = self._derivatives(xyz)
        n = len(xyz)
        M = M.reshape(3 * n, 7)
        rows = coordinates_of(self.points)
        # (D + M F) Q (D + M F)' = D Q D' + M (F Q D') + (F Q D')' M' + M (F Q F') M'
        cross = _times_blocks(self.linear @ Q[rows], D)
        middle = self.linear @ Q[np.ix_(rows, rows)] @ self.linear.T + self.covariance_of_nominal
        moved = _times_blocks(_times_blocks(Q, D).T, D)
        half = M @ (cross + middle @ M.T / 2)
        return np.asarray(moved + half + half.T)

    def _moved_blocks(self, Q: FloatArray, xyz: FloatArray) -> FloatArray:
        D, M = self._derivatives(xyz)
        F = np.zeros((7, len(xyz), 3))
        F[:, self.points] = self.linear.reshape(7, -1, 3)
        FQ = np.einsum("uni,nij->unj", F, Q)
        middle = np.einsum("uni,vni->uv", FQ, F) + self.covariance_of_nominal
        half = np.einsum("nau,unj,bj->nab", M, FQ, D)
        return np.asarray(
            np.einsum("ai,nij,bj->nab", D, Q, D)
            + half
            + half.transpose(0, 2, 1)
            + np.einsum("nau,uv,nbv->nab", M, middle, M)
        )

    def _derivatives(self, xyz: FloatArray) -> tuple[FloatArray, FloatArray]:
        T = self.aligned_from_object
        return T.scale * T.rotation, similarity_motions(xyz, centre=np.zeros(3))


@dataclass(frozen=True)
class BestFit:
    """Result of a best fit to nominal points."""

    names: tuple[str, ...]  # names of the common points, (n,)
    used: BoolArray  # whether each point took part, (n,)
    difference: FloatArray  # aligned minus nominal, object unit, (n, 3)
    scale: float
    sigma0: float  # a ratio with weights "network", in object units with equal ones; NaN without redundancy
    redundancy: int
    statistic: float  # test statistic of the global test; NaN where not tested
    critical: float


@dataclass(frozen=True)
class Nominal:
    """Nominal points, for example of a drawing."""

    names: tuple[str, ...]  # (n,)
    xyz: FloatArray  # object unit, (n, 3)
    covariance: FloatArray | None = None  # of each point, object unit^2; None for exact points, (n, 3, 3)


@checked_arguments()
def align_321(points: MeasuredPoints, plane: list[str], line: list[str], origin: str) -> Alignment:
    """Return the 3-2-1 alignment: three points on Z = 0, two on Y = 0, one on X = 0.

    Args:
        points: points of a result.
        plane: names of the three points; seen from the side of Z, they are in counter-clockwise order.
        line: names of the two points; X points from the first to the second.
        origin: name of the point with X = 0.

    Raises:
        UnknownNameError: a name is not that of a point.
        GeometryError: the points do not determine the system.

    Source: Luhmann et al. (2020), Close-Range Photogrammetry and 3D Imaging, sec. 6.2.3.
    """
    if len(plane) != 3 or len(line) != 2:
        raise GeometryError(
            f"alignment 3-2-1: {counted(len(plane), 'point')} of the plane and {len(line)} "
            "of the line, expected 3 and 2"
        )
    a, b, c = (points.xyz[points.index(name)] for name in plane)
    d, e = (points.xyz[points.index(name)] for name in line)
    normal = np.cross(b - a, c - a)
    if not np.linalg.norm(normal) > 1e-9 * np.linalg.norm(b - a) * np.linalg.norm(c - a):
        raise GeometryError(f"alignment 3-2-1: points {', '.join(plane)} of the plane lie on a line")
    rotation = _axes(normal, e - d, "3-2-1")
    at = points.index(origin)
    t = -np.array([rotation[0] @ points.xyz[at], rotation[1] @ d, rotation[2] @ a])
    rows = [(name, axis) for names, axis in ((plane, 2), (line, 1), ([origin], 0)) for name in names]
    entities = [
        (Function(points.xyz[points.index(name)], np.array([points.index(name)]), np.eye(3)), False, axis)
        for name, axis in rows
    ]
    return _align_by_coordinates("3-2-1", Similarity(1.0, rotation, t), entities)


@checked_arguments()
def align_features(
    z_axis: Function, x_axis: Function, origin: Function, *, on_plane: Function | None = None
) -> Alignment:
    """Return the alignment by features: one direction becomes Z, another X, and a position the origin.

    Args:
        z_axis: direction that becomes Z, such as the normal of a plane.
        x_axis: direction that becomes X after projection along Z.
        origin: position with X = Y = 0, and also Z = 0 if `on_plane` is not given.
        on_plane: position with Z = 0.

    Raises:
        GeometryError: the directions are parallel.

    Source: Luhmann et al. (2020), Close-Range Photogrammetry and 3D Imaging, sec. 6.2.3.
    """
    rotation = _axes(z_axis.value, x_axis.value, "by features")
    at = rotation @ origin.value
    if on_plane is not None:
        at[2] = float(rotation[2] @ on_plane.value)
    entities = [
        (z_axis, True, 0),
        (z_axis, True, 1),
        (x_axis, True, 1),
        (origin, False, 0),
        (origin, False, 1),
        (origin if on_plane is None else on_plane, False, 2),
    ]
    return _align_by_coordinates("features", Similarity(1.0, rotation, -at), entities)


@checked_arguments()
def align_points(
    points: MeasuredPoints,
    nominal: Nominal,
    *,
    scale: bool = False,
    weights: str = "network",
    robust: bool = False,
) -> Alignment:
    """Return the best fit of points to nominal points of the same names.

    Args:
        points: points of a result.
        nominal: nominal points; those that were not measured do not count.
        scale: whether to fit the scale, too.
        weights: network (the covariance of both) or equal.
        robust: whether to leave out points that contradict most of the others.

    Raises:
        GeometryError: fewer than three points in common, or all of them on a line.

    Source: Horn (1987), J. Opt. Soc. Am. A 4(4); Caspary (2000), sec. 7, for both covariances.
    """
    measured = set(points.names)
    common = [name for name in nominal.names if name in measured]
    if len(common) < 3:
        raise GeometryError(
            f"alignment: {counted(len(common), 'nominal point')} measured, a best fit needs 3"
        )
    rows = points.indices(common)
    nominal_rows = indices_of(nominal.names, common)
    target = nominal.xyz[nominal_rows]
    fixed = None if scale else 1.0
    if weights == "network" and points.covariance is None and nominal.covariance is None:
        raise GeometryError(
            "alignment: neither measured nor nominal points have standard deviations, expected weights = "
            '"equal"'
        )
    blocks = np.nan_to_num(points.blocks[rows])
    if nominal.covariance is not None:
        blocks = blocks + nominal.covariance[nominal_rows]
    used = np.ones(len(rows), dtype=bool)
    if robust:
        used = _agreeing_points(points.xyz[rows], target, fixed, blocks if weights == "network" else None)
    first = fit_similarity(points.xyz[rows[used]], target[used], scale=fixed)
    Qn = None if nominal.covariance is None else nominal.covariance[nominal_rows[used]]
    T, linear, of_nominal, omega = _refine(points, rows[used], target[used], Qn, first, scale, weights)
    difference = T.apply(points.xyz[rows]) - target
    redundancy = 3 * int(used.sum()) - (7 if scale else 6)
    statistic = critical = np.nan
    if weights == "network" and redundancy:
        statistic = omega / redundancy
        critical = critical_value(FALSE_ALARM, redundancy, points.redundancy)
    sigma0 = float(np.sqrt(omega / redundancy)) if redundancy else np.nan
    fit = BestFit(tuple(common), used, difference, T.scale, sigma0, redundancy, float(statistic), critical)
    return Alignment("points", T, rows[used], linear, of_nominal, scale, fit)


def _refine(
    points: MeasuredPoints,
    rows: IntArray,
    target: FloatArray,
    Qn: FloatArray | None,
    T: Similarity,
    scale: bool,
    weights: str,
) -> tuple[Similarity, FloatArray, FloatArray, float]:
    """Return the best fit, F, the contribution of nominal points to the covariance, and v' P v."""
    source, n = points.xyz[rows], len(rows)
    u = 7 if scale else 6
    Q = None if points.covariance is None else points.covariance_of(rows)
    size = float(np.sqrt(((target - target.mean(axis=0)) ** 2).sum(axis=1).mean()))
    spread = np.zeros((3 * n, 3 * n))
    if Qn is not None:
        for k in range(n):
            spread[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = Qn[k]
    if weights == "network":
        # at the start, which is so close that the weights do not change; rotating Q takes most of the time
        D, M = T.scale * T.rotation, similarity_motions(T.apply(source), centre=np.zeros(3))
        M = M.reshape(3 * n, 7)[:, :u]
        Qd = spread.copy() if Q is None else _times_blocks(_times_blocks(Q, D).T, D) + spread
        unit = np.sqrt(np.trace(Qd) / len(Qd) / (M**2).mean(axis=0))
        Qd += (M * unit) @ (M * unit).T
        try:
            factor = cho_factor(Qd, lower=True, overwrite_a=True, check_finite=False)
        except LinAlgError as error:
            raise GeometryError(
                "alignment: the covariance of the points is singular beyond its datum, expected "
                'weights = "equal"'
            ) from error
    for _ in range(ITERATIONS):
        xyz = T.apply(source)
        D = T.scale * T.rotation
        M = similarity_motions(xyz, centre=np.zeros(3)).reshape(3 * n, 7)[:, :u]
        d = (xyz - target).ravel()
        PM = M if weights == "equal" else cho_solve(factor, M, check_finite=False)
        pull: FloatArray = np.asarray(np.linalg.solve(M.T @ PM, PM.T))
        step = -pull @ d
        if not np.abs(step[3:]).max() < 1:
            break
        spin, growth = rotation_from_vector(step[3:6]), 1 + (step[6] if scale else 0.0)
        T = Similarity(T.scale * growth, spin @ T.rotation, growth * spin @ T.translation + step[:3])
        if np.abs(step[:3]).max() < CONVERGED * size and np.abs(step[3:]).max() < CONVERGED:
            break
    else:
        step = np.full(u, np.inf)
    if not np.abs(step[3:]).max() < 1:
        apart = float(np.sqrt(((T.apply(source) - target) ** 2).sum(axis=1).mean()))
        raise GeometryError(
            f"alignment: the best fit did not converge, measured and nominal points are {apart:.4g} apart "
            "(RMS): check their units and names, or fit a scale"
        )
    d = (T.apply(source) - target).ravel()
    omega = float(d @ d) if weights == "equal" else float(d @ cho_solve(factor, d))
    linear, of_nominal = np.zeros((7, 3 * n)), np.zeros((7, 7))
    linear[:u] = -_times_blocks(pull, D.T)
    of_nominal[:u, :u] = pull @ spread @ pull.T
    return T, linear, of_nominal, omega


def _agreeing_points(
    source: FloatArray, target: FloatArray, scale: float | None, blocks: FloatArray | None
) -> BoolArray:
    """Return the points that agree with most of the others, (n,)."""
    n = len(source)
    if n < 5:
        raise GeometryError(f"alignment: {counted(n, 'common point')}, a robust best fit needs 5 or more")
    d = fit_robustly(source, target, scale=scale).apply(source) - target
    length = np.linalg.norm(d, axis=1)
    if blocks is not None:
        length = length / np.sqrt(np.einsum("nii->n", blocks) / 3)
    sigma = (1 + 5 / (3 * n - 6)) * float(np.median(length)) / MEDIAN_OF_LENGTH
    return np.asarray(length <= max(REJECTED * sigma, 1e-12))


def _axes(z: FloatArray, x: FloatArray, what: str) -> FloatArray:
    """Return the axes of the new system as rows: Z along z, X along the part of x perpendicular to Z."""
    z = z / np.linalg.norm(z)
    across = x - (x @ z) * z
    if not np.linalg.norm(across) > 1e-9 * np.linalg.norm(x):
        raise GeometryError(f"alignment {what}: the directions of X and Z are parallel")
    across = across / np.linalg.norm(across)
    return np.stack([across, np.cross(z, across), z])


def _align_by_coordinates(
    method: str, T: Similarity, entities: list[tuple[Function, bool, int]]
) -> Alignment:
    """Return the alignment that holds one coordinate of each of six positions or directions.

    Args:
        method: name of the method.
        T: the transformation.
        entities: position or direction, whether it is a direction, and the axis along which it is held.
    """
    held = join_functions([function for function, _, _ in entities])
    moves, by_places = np.zeros((6, 7)), np.zeros((6, len(held.value)))
    for k, (function, is_direction, axis) in enumerate(entities):
        value = T.rotation @ function.value if is_direction else T.apply(function.value)
        motions = similarity_motions(value[None], centre=np.zeros(3))[0]
        if is_direction:
            motions = motions * np.array([0.0, 0, 0, 1, 1, 1, 0])
        moves[k] = motions[axis]
        by_places[k, 3 * k : 3 * k + 3] = T.rotation[axis]
    # a held coordinate does not change: moves dT + by_places dx = 0
    linear = np.zeros((7, held.jacobian.shape[1]))
    linear[:6] = -np.linalg.solve(moves[:, :6], by_places @ held.jacobian)
    return Alignment(method, T, held.points, linear, np.zeros((7, 7)), False)


def _times_blocks(matrix: FloatArray, D: FloatArray) -> FloatArray:
    """Return matrix diag(D, D, ...)', (k, 3 n)."""
    return np.asarray((matrix.reshape(len(matrix), -1, 3) @ D.T).reshape(matrix.shape))
