"""Best-fit shapes by orthogonal distances, with the covariance of the network or with equal weights.

Points are reduced to their centroid and unit size. Start values are refined with equal weights, and then, if
asked for, with the covariance of the points (`refine_weighted`). `parameters_of` converts the result to the
usual parameters, such as centre and radius, with their derivatives.

Source: Ahn (2004), Least Squares Orthogonal Distance Fitting of Curves and Surfaces in Space; Foerstner and
Wrobel (2016), Photogrammetric Computer Vision, secs. 4.8 and 10.6; Luhmann et al. (2020), Close-Range
Photogrammetry and 3D Imaging, sec. 2.3.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfm.comparison.stable_points import critical_value
from sfm.model.arguments import check_indices, checked_arguments
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.display import counted
from sfm.model.distributions import FALSE_ALARM
from sfm.model.errors import GeometryError
from sfm.model.solution import Solved, solution_of
from sfm.products.geometry.measured import Function, MeasuredPoints, measured_points
from sfm.products.geometry.shapes.gauss_helmert import (
    constraint_covariance,
    refine_orthogonal,
    refine_weighted,
)
from sfm.products.geometry.shapes.kinds import KINDS, Kind, Shape
from sfm.products.geometry.shapes.start import robust_shape, start_shapes, with_held

WITH_DIAMETER = ("circle", "sphere", "cylinder")

WEIGHTS = ("network", "equal")
STARTS = 4  # number of likeliest start values that are refined
START_POINTS = 300  # number of points used for start values
START_STEPS = 25
COLLINEAR = 1e-9  # spread of points, relative to their size, below which they lie on a line or plane
UNCERTAIN = 3.0  # the same, relative to the standard deviation of the points
RANK = 1e-9  # ratio of singular values of the scaled design matrix below which a parameter is undetermined


@dataclass(frozen=True)
class ShapeFit:
    """A best-fit shape."""

    name: str
    shape: Shape
    weights: str  # network | equal
    points: IntArray  # indices of its points, (m,)
    used: BoolArray  # whether a robust fit kept each point, (m,)
    parameters: Parameters  # names and kinds of the parameters
    function: Function  # the parameters as a function of the coordinates of its points
    covariance: FloatArray  # covariance of the parameters, (p, p); NaN without redundancy or covariance
    from_residuals: bool  # whether the covariance comes from the residuals, because that of points is unknown
    distances: FloatArray  # signed distances of the points, object unit, (m, c)
    sigma: FloatArray  # standard deviation of each distance, object unit; NaN where unknown, (m,)
    w: FloatArray  # standardised residual: root of T of each point; NaN where unknown, (m,)
    sigma0: float  # a ratio with weights "network", in object units with equal ones; NaN without redundancy
    redundancy: int
    statistic: float  # v' Q^-1 v over the redundancy; NaN where not tested
    critical: float  # critical value of the global test; NaN where not tested
    converged: bool
    offset: float = 0.0  # distance of the targets from the shape along its normal, object unit

    @property
    def deviation(self) -> FloatArray:
        """Distance of each point from the shape, signed for a surface, object unit, (m,)."""
        if self.distances.shape[1] == 1:
            return self.distances[:, 0]
        return np.asarray(np.linalg.norm(self.distances, axis=1))

    @property
    def rms(self) -> float:
        """Root mean square distance of the points used, object unit."""
        return float(np.sqrt((self.deviation[self.used] ** 2).mean()))

    @property
    def form_error(self) -> float:
        """Largest minus smallest distance of the points used; for a curve twice the largest."""
        deviations = self.deviation[self.used]
        return float(2 * deviations.max() if self.distances.shape[1] == 2 else np.ptp(deviations))

    @property
    def fits(self) -> bool | None:
        """Whether the residuals agree with the covariance of the points; None if not tested."""
        return None if np.isnan(self.statistic) else bool(self.statistic <= self.critical)

    @property
    def parameter_sigma(self) -> FloatArray:
        """Standard deviations of the parameters, 0 for held ones, (p,)."""
        return np.asarray(np.sqrt(np.maximum(np.diagonal(self.covariance), 0.0)))

    def value(self, name: str) -> float:
        """Return the value of a scalar parameter, such as `diameter`."""
        return float(self.function.value[self.parameters.rows(name)][0])

    def sigma_of(self, name: str) -> float:
        """Return the standard deviation of a scalar parameter."""
        return float(self.parameter_sigma[self.parameters.rows(name)][0])


@checked_arguments()
def fit_shape(
    points: MeasuredPoints | Solved,
    kind: str,
    chosen: Sequence[str] | IntArray | None = None,
    *,
    name: str = "",
    weights: str = "network",
    hold: Mapping[str, float | Sequence[float]] | None = None,
    robust: bool = False,
    offset: float = 0.0,
) -> ShapeFit:
    """Fit a shape to points by orthogonal distances.

    Args:
        points: result of a survey or an adjustment, or one read from files; or points of any other source.
        kind: line, plane, circle, ellipse, sphere, cylinder, cone, torus or paraboloid (of revolution).
        chosen: names, patterns such as `10*`, or indices of the points; all if not given.
        name: name of the shape, for messages; its kind if empty.
        weights: network (the covariance of the points) or equal.
        hold: values held fixed: `direction` (three numbers), position (`point`, `centre`, `apex` or `vertex`,
            three numbers), form parameters (object unit, rad) or `diameter`.
        robust: whether to leave out points that contradict most of the others.
        offset: signed distance of the targets from the shape, positive on the side of its normal or outside.

    Raises:
        GeometryError: too few points, points that do not determine the shape, unknown names, or invalid
            options.

    Source: Ahn (2004), ch. 3; the general case of least squares as in `refine_weighted`.

    Example:
        >>> import sfm
        >>> sfm.fit_shape(result, "plane", ["1", "2", "3", "4"]).redundancy
        1
    """
    if not isinstance(points, MeasuredPoints):
        points = measured_points(solution_of(points, "fit_shape").with_joint_covariance)
    if kind not in KINDS:
        raise GeometryError(f"shape '{name or kind}': kind '{kind}', expected one of {', '.join(KINDS)}")
    what = f"{kind} {name}".strip()
    if chosen is None:
        rows = np.arange(len(points.names))
    elif isinstance(chosen, np.ndarray):
        check_indices("fit_shape: chosen", chosen, len(points.names))
        rows = chosen.astype(np.int64)
    elif all(isinstance(name, str) for name in chosen) and not set(chosen) <= set(points.names):
        rows = points.matching(chosen, f"{what}: points")
    else:
        rows = points.indices(chosen)
    try:
        return _fit(points, KINDS[kind], rows, name or kind, weights, dict(hold or {}), robust, offset)
    except GeometryError as error:
        raise GeometryError(f"{what}: {error}") from error


def _fit(
    points: MeasuredPoints,
    kind: Kind,
    rows: IntArray,
    name: str,
    weights: str,
    hold: dict[str, float | Sequence[float]],
    robust: bool,
    offset: float,
) -> ShapeFit:
    _refuse_unusable(points, kind, rows, weights, (offset, *hold.values()))
    xyz = points.xyz[rows]
    centroid = xyz.mean(axis=0)
    size = float(np.sqrt(((xyz - centroid) ** 2).sum(axis=1).mean()))
    if not size > 0:
        raise GeometryError(f"its {counted(len(rows), 'point')} coincide")
    x = (xyz - centroid) / size
    Q = None
    if points.covariance is not None:
        Q = points.covariance_of(rows) if points.correlated_among(rows) else points.blocks[rows]
    _refuse_flat(kind, x, points.blocks[rows] / size**2, axis_held="direction" in hold)
    free, origin, axis, form = _held(kind, hold, centroid, size)
    placed = origin is None
    off = np.zeros(kind.constraints)
    off[-1] = offset / size
    used = np.ones(len(rows), dtype=bool)
    if robust:
        shape, used = robust_shape(
            kind, x, free=free, offset=off, origin=origin, axis=axis, form=form, placed=placed
        )
    else:
        shape = _best_start(kind, x, free, off, origin, axis, form, placed)
    if axis is None or kind.name in ("cone", "paraboloid"):
        shape = shape.turned()  # before the offset is applied, because its sign depends on the normal
    elif shape.axis @ axis < 0:
        shape = replace(shape, rotation=shape.rotation * np.array([1.0, -1, -1]))
    shape, cost, converged = refine_orthogonal(shape, x[used], free=free, offset=off, placed=placed)
    d, B, A = shape.design(x[used])
    A = A[..., free].reshape(d.size, -1)
    _refuse_rank(A, d.size)
    redundancy = d.size - A.shape[1]
    n = len(rows)
    linear = np.zeros((A.shape[1], n, 3))
    w = np.full(n, np.nan)
    C: FloatArray
    statistic = critical = np.nan
    if weights == "network":
        assert Q is not None
        of_used = Q
        if not used.all():
            of_used = Q[used] if Q.ndim == 3 else Q[np.ix_(np.repeat(used, 3), np.repeat(used, 3))]
        fit = refine_weighted(shape, x[used], of_used, free=free, offset=off, size=size, placed=placed)
        shape, converged = fit.shape, fit.converged
        linear[:, used] = fit.linear.reshape(A.shape[1], -1, 3)
        C = _product(linear.reshape(len(linear), -1), Q) / size**2
        w[used] = fit.standardised
        sigma0 = np.sqrt(fit.omega / redundancy) if redundancy else np.nan
        if redundancy:
            statistic = fit.omega / redundancy
            critical = critical_value(FALSE_ALARM, redundancy, points.redundancy)
    else:
        inverse: FloatArray = np.asarray(np.linalg.inv(A.T @ A))
        linear[:, used] = -np.einsum("up,pnc,nci->uni", inverse, A.T.reshape(-1, *d.shape), B)
        sigma0 = float(np.sqrt(cost / redundancy)) * size if redundancy else np.nan
        flat = linear.reshape(A.shape[1], -1)
        if Q is None:
            C = inverse * (sigma0 / size) ** 2
        else:
            C = _product(flat, Q) / size**2
    d, B, A = shape.design(x)
    sigma = _sigma_of_distances(Q, d - off, B, A[..., free], linear, C * size**2)
    # back to object units: shifts and lengths scale with the size, angles do not
    units = np.concatenate([np.full(3, size), np.ones(3), _lengths(kind, size)])[free]
    parameters, value, by_local = parameters_of(shape.scaled(size, centroid))
    J = by_local[:, free]
    linear = linear.reshape(len(units), -1) * (units / size)[:, None]
    return ShapeFit(
        name,
        shape.scaled(size, centroid),
        weights,
        rows,
        used,
        parameters,
        Function(value, rows, J @ linear),
        J @ (C * np.outer(units, units)) @ J.T,
        weights == "equal" and Q is None,
        (d - off) * size,
        sigma,
        w,
        float(sigma0),
        redundancy,
        float(statistic),
        float(critical),
        converged,
        offset,
    )


def _refuse_unusable(
    points: MeasuredPoints,
    kind: Kind,
    rows: IntArray,
    weights: str,
    given: Sequence[float | Sequence[float]],
) -> None:
    """Refuse points, weights and given numbers with which no shape can be fitted."""
    for j in rows[~np.isfinite(points.xyz[rows]).all(axis=1)][:1]:
        raise GeometryError(f"point {points.names[j]} has no coordinates, expected numbers")
    if not all(np.isfinite(np.asarray(number, dtype=float)).all() for number in given):
        raise GeometryError("a held value or the offset is not a finite number")
    if weights not in WEIGHTS:
        raise GeometryError(f"weights '{weights}', expected one of {', '.join(WEIGHTS)}")
    if weights == "network" and points.covariance is None:
        raise GeometryError('the standard deviations of the points are unknown, expected weights = "equal"')
    if len(rows) < kind.min_points:
        raise GeometryError(f"{counted(len(rows), 'point')}, a {kind.name} needs {kind.min_points}")


def _product(J: FloatArray, Q: FloatArray) -> FloatArray:
    """Return J Q J' with a joint covariance of all coordinates, or with one of each point."""
    if Q.ndim == 2:
        return np.asarray(J @ Q @ J.T)
    blocks = J.reshape(len(J), -1, 3)
    return np.asarray(np.einsum("uni,nij,vnj->uv", blocks, Q, blocks))


def _lengths(kind: Kind, size: float) -> FloatArray:
    return np.array([1.0 if name == "half_angle" else size for name in kind.form])


def _held(
    kind: Kind, hold: dict[str, float | Sequence[float]], centroid: FloatArray, size: float
) -> tuple[BoolArray, FloatArray | None, FloatArray | None, FloatArray]:
    """Return the free parameters (6 + q,), and held origin, direction and form in the frame of the points."""
    free = np.zeros(6 + len(kind.form), dtype=bool)
    free[list(kind.moves)] = True
    free[6:] = True
    form = np.full(len(kind.form), np.nan)
    if "diameter" in hold and "radius" in kind.form:
        hold["radius"] = float(np.asarray(hold.pop("diameter"))) / 2
    directed = kind.name != "sphere"
    known = (kind.place, *(("direction",) if directed else ()), *kind.form)
    origin = axis = None
    for name, value in hold.items():
        numbers = np.asarray(value, dtype=float)
        wanted = 3 if name in (kind.place, "direction") else 1
        if name not in known or (kind.name == "cone" and name == "radius"):
            of_cone = [
                parameter for parameter in known if not (kind.name == "cone" and parameter == "radius")
            ]
            raise GeometryError(f"hold '{name}', expected one of {', '.join(of_cone)}")
        if numbers.size != wanted or not np.isfinite(numbers).all():
            raise GeometryError(f"hold {name}: found {value}, expected {counted(wanted, 'finite number')}")
        if name == kind.place:
            origin = (numbers - centroid) / size
            free[:3] = False
        elif name == "direction":
            if not np.linalg.norm(numbers) > 0:
                raise GeometryError(f"hold direction: found {value}, expected a non-zero vector")
            axis = numbers / np.linalg.norm(numbers)
            free[3:5] = False
        else:
            if not numbers > 0:
                raise GeometryError(f"hold {name}: found {value}, expected a positive number")
            k = kind.form.index(name)
            form[k] = float(numbers) / _lengths(kind, size)[k]
            free[6 + k] = False
    if kind.name == "cone" and origin is not None:  # the apex is the origin, with radius 0
        form[0] = 0.0
        free[6] = False
    if not free.any():
        raise GeometryError("every parameter is held, nothing is left to fit")
    return free, origin, axis, form


def _best_start(
    kind: Kind,
    x: FloatArray,
    free: BoolArray,
    offset: FloatArray,
    origin: FloatArray | None,
    axis: FloatArray | None,
    form: FloatArray,
    placed: bool,
) -> Shape:
    """Return the best of the likeliest starts after some refinement of each."""
    sample = x
    if len(x) > START_POINTS:
        sample = x[np.linspace(0, len(x) - 1, START_POINTS).astype(np.int64)]
    trials: list[tuple[float, int, Shape]] = []
    first = free.copy()  # a held form has false optima, so the form is free at first (0: an apex)
    first[6:] = form != 0
    for start in start_shapes(kind, sample, origin=origin, axis=axis)[:STARTS]:
        shape = with_held(start, origin, np.full(len(form), np.nan))
        for freed in (first, free) if (first != free).any() else (free,):
            shape, cost, _ = refine_orthogonal(
                shape, sample, free=freed, offset=offset, placed=placed, iterations=START_STEPS
            )
            if freed is not free:
                shape = with_held(shape, origin, form)
        if np.isfinite(cost) and np.isfinite(shape.form).all():
            trials.append((cost, len(trials), shape))
    if not trials:
        raise GeometryError(f"its points do not determine a {kind.name}")
    return min(trials, key=lambda trial: trial[:2])[2]


def _refuse_flat(kind: Kind, x: FloatArray, blocks: FloatArray, *, axis_held: bool) -> None:
    """Refuse points that lie, within their precision, on a line, or on a plane if the shape needs space."""
    spread = np.linalg.svd(x, compute_uv=False) / np.sqrt(len(x))
    known = np.einsum("nii->n", blocks) / 3
    sigma = float(np.sqrt(known.mean())) if np.isfinite(known).all() else 0.0
    limit = max(COLLINEAR * spread[0], min(UNCERTAIN * sigma, 0.1 * spread[0]))
    if kind.name != "line" and not axis_held and (len(spread) < 2 or spread[1] <= limit):
        raise GeometryError(f"its {counted(len(x), 'point')} lie on a line")
    flat = kind.name in ("sphere", "cylinder", "cone", "torus", "paraboloid")
    if flat and not axis_held and (len(spread) < 3 or spread[2] <= limit):
        raise GeometryError(
            f"its {counted(len(x), 'point')} lie on a plane, a {kind.name} needs points in space"
        )


def _refuse_rank(A: FloatArray, constraints: int) -> None:
    """Refuse points that do not determine all parameters."""
    u = A.shape[1]
    if constraints < u:
        raise GeometryError(f"{constraints} distances for {counted(u, 'parameter')}")
    scale = np.maximum(np.linalg.norm(A, axis=0), 1e-300)
    values = np.linalg.svd(A / scale, compute_uv=False)
    rank = int((values > RANK * values[0]).sum())
    if rank < u:
        raise GeometryError(f"its points determine {rank} of its {counted(u, 'parameter')}")


def _sigma_of_distances(
    Q: FloatArray | None, d: FloatArray, B: FloatArray, A: FloatArray, linear: FloatArray, C: FloatArray
) -> FloatArray:
    """Return the standard deviation of each distance, from B dx + A F dx, (n,)."""
    n, c, u = A.shape
    if Q is None:
        return np.full(n, np.nan)
    if Q.ndim == 3:
        of_points = constraint_covariance(Q, B)
        cross = np.einsum("nci,nij,unj->ncu", B, Q, linear)
    else:
        blocks = np.stack([Q[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(n)])
        of_points = np.einsum("nai,nij,nbj->nab", B, blocks, B)
        cross = np.einsum("nci,niu->ncu", B, (Q @ linear.reshape(u, -1).T).reshape(n, 3, u))
    half = np.einsum("ncu,nku->nck", cross, A)
    S = of_points + half + half.transpose(0, 2, 1) + np.einsum("ncu,uv,nkv->nck", A, C, A)
    if c == 1:
        return np.asarray(np.sqrt(np.maximum(S[:, 0, 0], 0.0)))
    length = np.linalg.norm(d, axis=1, keepdims=True)
    along = np.divide(d, length, out=np.full_like(d, np.sqrt(0.5)), where=length > 0)
    return np.asarray(np.sqrt(np.maximum(np.einsum("na,nab,nb->n", along, S, along), 0.0)))


@dataclass(frozen=True)
class Parameters:
    """Names and kinds of the values of a shape."""

    names: tuple[str, ...]  # parameter of each value: centre, direction, radius ...
    axes: tuple[str, ...]  # X, Y or Z for a vector, empty for a scalar
    kinds: tuple[str, ...]  # coordinate | direction | length | angle

    def rows(self, name: str) -> slice:
        """Return the rows of a parameter, given by name."""
        first = self.names.index(name)
        return slice(first, first + self.names.count(name))


_Parameter = tuple[str, str, FloatArray, FloatArray]  # name, kind of value, values, derivatives


def _form_parameters(kind: Kind, form: FloatArray) -> Iterator[_Parameter]:
    """Yield the parameters of the form, with the diameter of shapes that have one."""
    for k, name in enumerate(kind.form):
        if kind.name == "cone" and name == "radius":
            continue  # its radius near the centroid is of no use
        derivatives = np.zeros((1, 6 + len(form)))
        derivatives[0, 6 + k] = 1.0
        yield name, "angle" if name == "half_angle" else "length", form[k : k + 1], derivatives
        if name == "radius" and kind.name in WITH_DIAMETER:
            yield "diameter", "length", 2 * form[k : k + 1], 2 * derivatives


def parameters_of(shape: Shape) -> tuple[Parameters, FloatArray, FloatArray]:
    """Return the parameters of a shape.

    Args:
        shape: shape in object units.

    Returns:
        Names, values (p,), and derivatives by shifts and rotations in the axes of the shape and by its form,
        (p, 6 + q).
    """
    kind, R, form = shape.kind, shape.rotation, shape.form
    q = len(form)
    rows: list[_Parameter] = []
    at = np.zeros((3, 6 + q))
    at[:, :3] = R
    direction = np.zeros((3, 6 + q))
    direction[:, 3], direction[:, 4] = -R[:, 1], R[:, 0]
    place, by_place = shape.origin, at
    if kind.name == "cone" and abs(form[1]) > 1e-9:
        r, angle = form
        along = -r / np.tan(angle)  # of the apex, where the radius is 0
        place, by_place = shape.origin + along * R[:, 2], at + along * direction
        by_place[:, 6:] = np.outer(R[:, 2], np.array([-1 / np.tan(angle), r / np.sin(angle) ** 2]))
    rows.append((kind.place, "coordinate", place, by_place))
    if kind.name != "sphere":
        rows.append(("direction", "direction", R[:, 2], direction))
    if kind.name == "ellipse":
        major = np.zeros((3, 6 + q))
        major[:, 4], major[:, 5] = -R[:, 2], R[:, 1]
        rows.append(("major_axis", "direction", R[:, 0], major))
    if kind.name == "paraboloid":
        by_focus = at + form[0] * direction
        by_focus[:, 6] = R[:, 2]
        rows.append(("focus", "coordinate", shape.origin + form[0] * R[:, 2], by_focus))
    rows += _form_parameters(kind, form)
    names = tuple(name for name, _, value, _ in rows for _ in value)
    axes = tuple(axis for _, _, value, _ in rows for axis in ("XYZ" if len(value) == 3 else ("",)))
    kinds = tuple(kind for _, kind, value, _ in rows for _ in value)
    values = np.concatenate([value for _, _, value, _ in rows])
    return Parameters(names, axes, kinds), values, np.vstack([J for _, _, _, J in rows])
