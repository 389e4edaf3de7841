"""Measurements in a result: hidden points, alignment, shapes, functions and tolerances, in this order.

Source: Luhmann et al. (2020), Close-Range Photogrammetry and 3D Imaging, chs. 6 and 8; the module of each
step states its source.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sfm.files.csv_tables import read_table
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.errors import GeometryError, SurveyFileError
from sfm.model.remarks.remark import Remark, remark
from sfm.model.remarks.verdict import Level, Verdict, judge
from sfm.model.solution import Solution
from sfm.products.geometry.alignment import Alignment, Nominal, align_321, align_features, align_points
from sfm.products.geometry.measured import (
    Function,
    MeasuredPoints,
    angle_at,
    angle_of_directions,
    difference,
    distance,
    distance_from_axis,
    height,
    measured_points,
    point_function,
    with_hidden_point,
)
from sfm.products.geometry.shapes.fit import ShapeFit, fit_shape
from sfm.products.geometry.tolerance import (
    OUT,
    UNDECIDED,
    UNKNOWN,
    Deviations,
    Mesh,
    Tolerance,
    deviations_from_mesh,
    deviations_from_points,
    deviations_from_shape,
)
from sfm.products.inspection.features_file import (
    AlignmentSettings,
    FeaturesFile,
    ShapeSettings,
    ToleranceSettings,
)

SIGMAS = ("sX", "sY", "sZ")
HEADLINES: Mapping[Level, str] = {
    "good": "The result is measured.",
    "fair": "The result is measured, with remarks.",
    "bad": "The result cannot be measured as asked.",
}
HEADLINES_OF_TOLERANCES: Mapping[Level, str] = {
    "good": "All tolerances are proven to be kept.",
    "fair": "It is not proven that all tolerances are kept.",
    "bad": "Tolerances are not kept.",
}
WITH_AXIS = ("line", "cylinder", "cone", "torus", "paraboloid")
SEEN_FROM = 0.8  # least share of the rays of targets that come from one side of a surface
MeshReader = Callable[[Path], tuple[FloatArray, IntArray]]


@dataclass(frozen=True)
class Quantity:
    """A distance, an angle or a height."""

    name: str
    what: str  # description, for people
    kind: str  # length | angle
    value: float  # object unit, rad
    sigma: float  # NaN if unknown
    remarks: tuple[Remark, ...] = ()  # on limitations of the sigma


@dataclass(frozen=True)
class Measurement:
    """A measured result."""

    name: str  # of the result
    points: MeasuredPoints  # in the system of the alignment, hidden points included
    groups: tuple[tuple[str, IntArray], ...]  # (name, indices of points)
    alignment: Alignment | None
    shapes: tuple[ShapeFit, ...]
    quantities: tuple[Quantity, ...]
    tolerances: tuple[Deviations, ...]
    coverage: float  # k of the uncertainties
    remarks: tuple[Remark, ...]  # on the result and its shapes

    @property
    def unit(self) -> str:
        """The unit of lengths."""
        return self.points.unit or "object units"

    def group_of(self, point: int) -> str:
        """Return the name of the first group that contains a point, empty if none does."""
        return next((name for name, members in self.groups if point in members), "")

    @property
    def verdict(self) -> Verdict:
        """Whether all tolerances are proven to be kept."""
        judged = [said for tolerance in self.tolerances for said in self._of_tolerance(tolerance)]
        return judge((*judged, *self.remarks), HEADLINES_OF_TOLERANCES if self.tolerances else HEADLINES)

    def _of_tolerance(self, tolerance: Deviations) -> Iterator[Remark]:
        total = len(tolerance.points)
        if tolerance.count(OUT):
            names = [
                self.points.names[j]
                for j, decision in zip(tolerance.points, tolerance.decision, strict=True)
                if decision == OUT
            ]
            yield remark(
                "out_of_tolerance", tolerance=tolerance.name, out=len(names), total=total, points=names
            )
        if tolerance.count(UNDECIDED):
            yield remark(
                "tolerance_undecided",
                tolerance=tolerance.name,
                undecided=tolerance.count(UNDECIDED),
                total=total,
            )
        if tolerance.count(UNKNOWN):
            yield remark(
                "tolerance_unknown", tolerance=tolerance.name, unknown=tolerance.count(UNKNOWN), total=total
            )
        if tolerance.missing:
            yield remark("nominal_missing", tolerance=tolerance.name, points=tolerance.missing)


def measure_result(
    result: Solution,
    features: FeaturesFile | None = None,
    *,
    paths: Mapping[str, Path] | None = None,
    read_mesh: MeshReader | None = None,
) -> Measurement:
    """Measure a result.

    Args:
        result: result of a survey, or of another program.
        features: requested features; only the coordinates if not given.
        paths: paths of the tables and meshes named in `features`.
        read_mesh: reads the vertices and triangles of a mesh.

    Raises:
        KolinearError: the points of a feature do not determine it, a name is unknown, or a table cannot be
            read.
    """
    features = FeaturesFile() if features is None else features
    paths = {} if paths is None else paths
    points = measured_points(result)
    if not len(points.names):
        raise GeometryError(f"{result.name}: no point has coordinates, nothing can be measured")
    for hidden in features.hidden_points:
        points = with_hidden_point(
            points, hidden.name, hidden.start, hidden.end, hidden.distance, hidden.sigma
        )
    work = _Work(result, features, paths, read_mesh, points)
    return work.measured()


class _Work:
    """State of a measurement in progress."""

    def __init__(
        self,
        result: Solution,
        features: FeaturesFile,
        paths: Mapping[str, Path],
        read_mesh: MeshReader | None,
        points: MeasuredPoints,
    ) -> None:
        self.result, self.features, self.paths, self.read_mesh = result, features, paths, read_mesh
        self.points = points
        self.patterns = {group.name: group.points for group in features.groups}
        self.shapes: dict[str, ShapeFit] = {}
        self.tables = {name: _nominal(paths[name]) for name in features.tables()}
        network, estimate = result.network, result.estimate
        seen = network.image_points
        number = np.cumsum(estimate.determined) - 1  # of a point among those with coordinates
        kept = estimate.oriented[seen.image] & estimate.determined[seen.point]
        self.rays = number[seen.point[kept]], estimate.position[seen.image[kept]]

    def measured(self) -> Measurement:
        features = self.features
        groups = tuple(
            (group.name, self.chosen((group.name,), f"group {group.name}")) for group in features.groups
        )
        alignment = None
        if features.alignment is not None:
            if features.alignment.method == "features":
                self.fit_shapes()
            alignment = self.aligned(features.alignment)
            self.points = alignment.apply(self.points)
            self.rays = self.rays[0], alignment.aligned_from_object.apply(self.rays[1])
        self.fit_shapes()
        quantities = tuple(self.quantities())
        tolerances = tuple(self.tolerance(tolerance) for tolerance in features.tolerances)
        return Measurement(
            self.result.name,
            self.points,
            groups,
            alignment,
            tuple(self.shapes.values()),
            quantities,
            tolerances,
            features.measure.coverage,
            tuple(self.remarks()),
        )

    def chosen(self, patterns: tuple[str, ...], what: str) -> IntArray:
        """Return the points that names, patterns and groups select."""
        flat = [name for pattern in patterns for name in self.patterns.get(pattern, (pattern,))]
        return self.points.matching(flat, what)

    def fit_shapes(self) -> None:
        self.shapes = {settings.name: self.shape(settings) for settings in self.features.shapes}

    def shape(self, settings: ShapeSettings) -> ShapeFit:
        rows = self.chosen(settings.points, f"shape {settings.name}")
        weights = settings.weights or self.features.measure.weights

        def fitted(offset: float) -> ShapeFit:
            held = {key: value for key, value in settings.hold.model_dump().items() if value is not None}
            if "half_angle_deg" in held:
                held["half_angle"] = float(np.deg2rad(held.pop("half_angle_deg")))
            return fit_shape(
                self.points,
                settings.kind,
                rows,
                name=settings.name,
                weights=weights,
                hold=held,
                robust=settings.robust,
                offset=offset,
            )

        first = fitted(0.0)
        return first if settings.offset == 0 else fitted(settings.offset * self.side(settings, first))

    def side(self, settings: ShapeSettings, fit: ShapeFit) -> float:
        """Return the side of a shape on which its targets are: 1 for the side of its normals, else -1."""
        xyz = self.points.xyz[fit.points]
        normals = fit.shape.design(xyz)[1][:, -1]
        if settings.side != "cameras":
            view = self.points.xyz[self.points.index(settings.side)]
            return 1.0 if float(np.einsum("ni,ni->n", view - xyz, normals).mean()) >= 0 else -1.0
        point, camera = self.rays
        place = np.full(len(self.points.names), -1)
        place[fit.points] = np.arange(len(fit.points))
        k = place[point]
        towards = np.einsum("ri,ri->r", camera - xyz[k], normals[k])[k >= 0]
        share = float((towards > 0).mean()) if len(towards) else 0.5
        if max(share, 1 - share) < SEEN_FROM:
            seen = f"{share:.0%} of the rays come from one side" if len(towards) else "no photographs"
            raise GeometryError(
                f"shape {settings.name}: offset: {seen}; needed side = the name of a point on the side of "
                "the targets"
            )
        return 1.0 if share > 0.5 else -1.0

    def aligned(self, settings: AlignmentSettings) -> Alignment:
        if settings.method == "3-2-1":
            assert settings.plane is not None and settings.line is not None and settings.origin is not None
            return align_321(self.points, list(settings.plane), list(settings.line), settings.origin)
        if settings.method == "features":
            assert settings.z_axis is not None and settings.x_axis is not None and settings.origin is not None
            primary = self.shape_named(settings.z_axis, "alignment: z_axis")
            if len(settings.x_axis) == 1:
                x_axis = self.direction(self.shape_named(settings.x_axis[0], "alignment: x_axis"))
            elif len(settings.x_axis) == 2:
                start, end = map(self.place, settings.x_axis)
                x_axis = difference(start, end)
            else:
                raise GeometryError(
                    f"alignment: x_axis names {len(settings.x_axis)}, expected one shape or two points or "
                    "shapes"
                )
            flat = primary.shape.kind.name == "plane"
            return align_features(
                self.direction(primary),
                x_axis,
                self.place(settings.origin),
                on_plane=primary.function[primary.parameters.rows("point")] if flat else None,
            )
        assert settings.nominal is not None
        nominal = self.tables[settings.nominal]
        if settings.points is not None:
            wanted = {self.points.names[j] for j in self.chosen(settings.points, "alignment: points")}
            rows = np.array([k for k, name in enumerate(nominal.names) if name in wanted], dtype=np.int64)
            covariance = None if nominal.covariance is None else nominal.covariance[rows]
            nominal = Nominal(tuple(nominal.names[k] for k in rows), nominal.xyz[rows], covariance)
        weights = settings.weights or self.features.measure.weights
        return align_points(
            self.points, nominal, scale=settings.scale, weights=weights, robust=settings.robust
        )

    def shape_named(self, name: str, what: str) -> ShapeFit:
        if name not in self.shapes:
            known = ", ".join(self.shapes) or "none"
            raise GeometryError(f"{what}: unknown shape '{name}', expected one of {known}")
        return self.shapes[name]

    def direction(self, fit: ShapeFit) -> Function:
        if "direction" not in fit.parameters.names:
            raise GeometryError(f"shape {fit.name}: a {fit.shape.kind.name} has no direction")
        return fit.function[fit.parameters.rows("direction")]

    def place(self, name: str) -> Function:
        """Return the coordinates of a point, or the position of a shape."""
        if name in self.shapes:
            fit = self.shapes[name]
            return fit.function[fit.parameters.rows(fit.shape.kind.place)]
        return point_function(self.points, name)

    def quantities(self) -> list[Quantity]:
        quantities = []
        for pair in self.features.distances:
            try:
                function = self.distance(pair.start, pair.end)
            except GeometryError as error:
                raise GeometryError(f"distance {pair.name}: {error}") from error
            quantities.append(
                self.quantity(pair.name, f"distance {pair.start} to {pair.end}", "length", function)
            )
        for angle in self.features.angles:
            a, b = angle.between
            if angle.at is not None:
                function = angle_at(self.place(angle.at), self.place(a), self.place(b))
                what = f"angle at {angle.at} between {a} and {b}"
            else:
                fits = [self.shape_named(name, f"angle {angle.name}") for name in (a, b)]
                function = angle_of_directions(*map(self.direction, fits), undirected=True)
                if (
                    sum(fit.shape.kind.name == "plane" for fit in fits) == 1
                ):  # from the angle with the plane's normal
                    flip = np.array([[-1.0]])
                    function = function.times(flip, np.pi / 2 - function.value)
                what = f"angle between {a} and {b}"
            quantities.append(self.quantity(angle.name, what, "angle", function))
        for asked in self.features.heights:
            plane = self.shape_named(asked.above, f"height {asked.name}")
            if plane.shape.kind.name != "plane":
                raise GeometryError(
                    f"height {asked.name}: {asked.above} is a {plane.shape.kind.name}, expected a plane"
                )
            place = plane.function[plane.parameters.rows("point")]
            for j in self.chosen(asked.points, f"height {asked.name}"):
                name = self.points.names[j]
                function = height(point_function(self.points, name), place, self.direction(plane))
                what = f"height of {name} above {asked.above}"
                quantities.append(self.quantity(f"{asked.name} {name}", what, "length", function))
        return quantities

    def distance(self, start: str, end: str) -> Function:
        """Return the distance of two positions, or of a position from a plane or an axis."""
        for position, other in ((start, end), (end, start)):
            fit = self.shapes.get(other)
            if fit is None or (
                position in self.shapes and self.shapes[position].shape.kind.name in WITH_AXIS
            ):
                continue
            where = fit.function[fit.parameters.rows(fit.shape.kind.place)]
            if fit.shape.kind.name == "plane":
                signed = height(self.place(position), where, self.direction(fit))
                return signed.times(np.array([[1.0 if signed.value[0] >= 0 else -1.0]]), np.abs(signed.value))
            if fit.shape.kind.name in ("line", "cylinder"):
                return distance_from_axis(self.place(position), where, self.direction(fit))
        return distance(self.place(start), self.place(end))

    def quantity(self, name: str, what: str, kind: str, function: Function) -> Quantity:
        variance = float(self.points.covariance_between([function])[0, 0])
        dependent = not np.isnan(variance) and self.points.depends_on_datum(function).any()
        remarks = [remark("datum_dependent")] if dependent else []
        sigma = float(np.sqrt(max(variance, 0.0))) if not np.isnan(variance) else float("nan")
        return Quantity(name, what, kind, float(function.value[0]), sigma, tuple(remarks))

    def tolerance(self, settings: ToleranceSettings) -> Deviations:
        coverage = settings.coverage or self.features.measure.coverage
        chosen = (
            None if settings.points is None else self.chosen(settings.points, f"tolerance {settings.name}")
        )
        if settings.nominal is not None:
            distance = Tolerance(settings.name, upper=settings.upper, coverage=coverage)
            nominal = self.tables[settings.nominal]
            return deviations_from_points(self.points, nominal, distance, chosen=chosen)
        lower = -settings.upper if settings.lower is None else settings.lower
        tolerance = Tolerance(settings.name, lower, settings.upper, coverage)
        if settings.shape is not None:
            fit = self.shape_named(settings.shape, f"tolerance {settings.name}")
            return deviations_from_shape(self.points, fit, tolerance)
        assert settings.mesh is not None and chosen is not None
        if self.read_mesh is None:
            raise GeometryError(f"tolerance {settings.name}: nothing here reads the mesh {settings.mesh}")
        return deviations_from_mesh(
            self.points,
            Mesh(*self.read_mesh(self.paths[settings.mesh])),
            chosen,
            tolerance,
            against=settings.mesh,
            offset=settings.offset,
        )

    def remarks(self) -> Iterator[Remark]:
        """Yield the remarks on limitations of the result, and on its shapes."""
        points = self.points
        if points.covariance is None:
            yield remark("no_precision")
        elif points.sample is not None:
            yield remark("covariance_incomplete", known=len(points.sample), total=len(points.names))
        elif not points.correlated:
            yield remark("covariance_incomplete", known=0, total=len(points.names))
        if not points.has_scale:
            yield remark("network_units")
        for fit in self.shapes.values():
            shape = f"{fit.shape.kind.name} {fit.name}"
            if not fit.converged:
                yield remark("shape_not_converged", shape=shape)
            if fit.fits is False:
                yield remark(
                    "shape_deviates", shape=shape, times=fit.sigma0, limit=float(np.sqrt(fit.critical))
                )
            if not fit.used.all():
                left = [points.names[j] for j in fit.points[~fit.used]]
                yield remark("shape_points_left_out", shape=shape, points=left)


def _nominal(path: Path) -> Nominal:
    """Read nominal points; a table with standard deviations gives their covariance."""
    table = read_table(path, ("id",), ("X", "Y", "Z"), SIGMAS, ignored=None, blank=SIGMAS)
    names = table.keys("id")
    sigma = table.values[:, 3:]
    table.refuse(sigma, sigma < 0, SIGMAS, "0 or more, or nothing")
    covariance = None
    if sigma.size:
        if not np.isfinite(sigma).all():
            raise SurveyFileError(f"{path}: standard deviations of some points only, expected all or none")
        covariance = np.eye(3) * sigma[:, None, :] ** 2
    return Nominal(names, table.values[:, :3].copy(), covariance)
