"""Functions of points, alignment to given systems, deviations and their decisions by ISO 14253-1."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sfm.model.conventions import FloatArray, rotation_from_vector
from sfm.model.errors import GeometryError
from sfm.model.similarity import Similarity
from sfm.products.geometry.alignment import Alignment, Nominal, align_321, align_features, align_points
from sfm.products.geometry.measured import (
    Function,
    MeasuredPoints,
    angle_at,
    angle_of_directions,
    coordinates_in,
    difference,
    distance,
    distance_from_axis,
    height,
    matches,
    measured_points,
    point_function,
    with_hidden_point,
)
from sfm.products.geometry.shapes.fit import fit_shape
from sfm.products.geometry.tolerance import (
    Mesh,
    Tolerance,
    decide,
    deviations_from_mesh,
    deviations_from_points,
    deviations_from_shape,
    distances_from_mesh,
)
from tests.products.geometry.simulated import in_free_datum, points_on, random_covariance, simulated_shape
from tests.products.inspection.benches import one_bench
from tests.synthetic import seed_of

NAMES = tuple("ABCDEFGH")


def points() -> MeasuredPoints:
    rng = seed_of("functions")
    xyz = rng.normal(size=(8, 3))
    xyz /= np.linalg.norm(
        xyz, axis=1, keepdims=True
    )  # derivatives of a fit hold where points are on the shape
    return MeasuredPoints(NAMES, xyz, random_covariance(8, 1e-3, rng), "m", "free")


def p(points: MeasuredPoints, name: str) -> Function:
    return point_function(points, name)


def unit(points: MeasuredPoints) -> Function:
    v = difference(p(points, "B"), p(points, "C"))
    length = np.linalg.norm(v.value)
    u = v.value / length
    return v.times((np.eye(3) - np.outer(u, u)) / length, u)


FUNCTIONS: dict[str, Callable[[MeasuredPoints], Function]] = {
    "distance": lambda m: distance(p(m, "A"), p(m, "B")),
    "angle at a point": lambda m: angle_at(p(m, "A"), p(m, "B"), p(m, "C")),
    "angle": lambda m: angle_of_directions(unit(m), difference(p(m, "D"), p(m, "E")), undirected=True),
    "height": lambda m: height(p(m, "A"), p(m, "B"), unit(m)),
    "from axis": lambda m: distance_from_axis(p(m, "A"), p(m, "B"), unit(m)),
    "coordinates": lambda m: coordinates_in(m, ["B", "A"], np.ones(3), np.eye(3)[::-1], 2.0),
    "centre to point": lambda m: distance(fit_shape(m, "sphere").function[:3], p(m, "A")),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_derivatives_are_those_of_differences(name: str) -> None:
    measured = points()
    found = FUNCTIONS[name](measured)
    for k, j in enumerate(found.points):
        for axis in range(3):
            h = np.zeros((8, 3))
            h[j, axis] = 1e-6
            up, down = (FUNCTIONS[name](replace(measured, xyz=measured.xyz + s * h)).value for s in (1, -1))
            np.testing.assert_allclose(found.jacobian[:, 3 * k + axis], (up - down) / 2e-6, atol=1e-6)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_only_what_the_network_determines_has_a_covariance_without_a_remark(name: str) -> None:
    measured = points()
    found = FUNCTIONS[name](measured)
    other = replace(measured, covariance=in_free_datum(measured.covariance, measured.xyz))
    same = np.allclose(measured.covariance_between([found]), other.covariance_between([found]), rtol=1e-6)
    assert measured.depends_on_datum(found).any() == (not same) == (name == "coordinates")
    assert not replace(measured, datum="control").depends_on_datum(found).any()
    without = replace(measured, has_scale=False)
    assert without.depends_on_datum(found).any() == ("angle" not in name)


def test_correlations_count() -> None:
    """Two points that move together keep their distance."""
    xyz = np.array([[0.0, 0, 0], [1, 0, 0]])
    one = random_covariance(1, 1.0, seed_of("together"))
    measured = MeasuredPoints(("A", "B"), xyz, np.tile(one, (2, 2)), "m", "control")
    found = distance(p(measured, "A"), p(measured, "B"))
    assert measured.covariance_between([found])[0, 0] == pytest.approx(0, abs=1e-12)
    apart = replace(measured, covariance=np.stack([one, one]))
    assert not apart.correlated
    assert apart.covariance_between([found])[0, 0] == pytest.approx(2 * one[0, 0])


def test_patterns_name_points() -> None:
    assert matches("105", "101-120") and not matches("a105", "101-120") and matches("rim 1", "rim*")
    assert not matches("21", "101-120") and matches("1-2", "1-2")
    measured = points()
    assert measured.matching(["A", "[FG]"], "x").tolist() == [0, 5, 6]
    with pytest.raises(GeometryError, match="group rim: 'x1' matches no point"):
        measured.matching(["A", "x1"], "group rim")


def test_what_has_no_derivative_is_refused() -> None:
    measured = points()
    with pytest.raises(GeometryError, match="coincide"):
        distance(p(measured, "A"), p(measured, "A"))
    with pytest.raises(GeometryError, match="parallel"):
        angle_of_directions(unit(measured), difference(p(measured, "B"), p(measured, "C")))


def test_points_of_a_sample_are_known_together() -> None:
    """As of a result of more than 1000 points: distances, hidden points, shapes and alignment."""
    whole = measured_points(one_bench())
    n = len(whole.names)
    kept = np.flatnonzero([name[0] != "d" for name in whole.names])
    some = measured_points(
        replace(
            one_bench(),
            covariance=whole.covariance_of(kept),
            covariance_points=kept,
        )
    )
    assert some.sample is not None and not some.correlated and some.correlated_among(kept)
    assert not some.correlated_among(np.arange(n))
    inside, across = ("p3", "c7"), ("p3", "d4")
    for names, same in ((inside, True), (across, False)):
        functions = [distance(*(point_function(one, name) for name in names)) for one in (whole, some)]
        variance = [
            one.covariance_between([f])[0, 0] for one, f in zip((whole, some), functions, strict=True)
        ]
        assert (abs(variance[1] / variance[0] - 1) < 1e-12) == same
    both = [with_hidden_point(one, "tip", "p1", "p2", 0.1, 1e-5) for one in (whole, some)]
    aligned = [align_321(one, ["p1", "p5", "p25"], ["p1", "p5"], "p1").apply(one) for one in both]
    for pair in (both, aligned):
        fits = [fit_shape(one, "circle", one.matching(["c*"], "flange")).sigma_of("diameter") for one in pair]
        assert fits[1] == pytest.approx(fits[0], rel=1e-9)
        functions = [distance(point_function(one, "tip"), point_function(one, "z3")) for one in pair]
        first, second = (one.covariance_between([f])[0, 0] for one, f in zip(pair, functions, strict=True))
        assert second == pytest.approx(first, rel=1e-9)
        assert pair[1].blocks[kept] == pytest.approx(pair[0].blocks[kept], rel=1e-9)
    lost = align_321(some, ["d1", "d5", "d9"], ["d1", "d5"], "d1").apply(some)
    assert lost.sample is None and not lost.correlated_among(kept)


COUNT = 12
NUMBERS = tuple(f"{k}" for k in range(COUNT))
MOVED = Similarity(1.0, rotation_from_vector(np.array([0.3, -0.5, 0.8])), np.array([100.0, -50, 20]))


def nominal_points() -> FloatArray:
    rng = seed_of("nominal")
    xyz = rng.uniform(-300, 300, (COUNT, 3))
    xyz[:5, 2] = 0  # a base
    xyz[5] = (-250, 0, 70)
    xyz[6] = (250, 0, 70)
    return xyz


def measured(xyz: FloatArray, *, sigma: float = 0.1) -> MeasuredPoints:
    Q = random_covariance(COUNT, sigma, seed_of("alignment"))
    return MeasuredPoints(NUMBERS, MOVED.apply(xyz), Q, "mm", "control")


def aligned_321(points: MeasuredPoints) -> Alignment:
    return align_321(points, ["0", "1", "2"], ["5", "6"], "5")


def aligned_features(points: MeasuredPoints) -> Alignment:
    base = fit_shape(points, "plane", ["0", "1", "2", "3", "4"], weights="equal")
    x = difference(point_function(points, "5"), point_function(points, "6"))
    place, direction = (base.function[base.parameters.rows(name)] for name in ("point", "direction"))
    return align_features(direction, x, point_function(points, "5"), on_plane=place)


def aligned_points(points: MeasuredPoints, **options: object) -> Alignment:
    covariance = np.tile(0.05**2 * np.eye(3), (COUNT, 1, 1))
    return align_points(points, Nominal(NUMBERS, nominal_points(), covariance), **options)  # type: ignore[arg-type]


METHODS = {"3-2-1": aligned_321, "features": aligned_features, "points": aligned_points}


@pytest.mark.parametrize("method", METHODS)
def test_the_covariance_goes_along(method: str) -> None:
    """Against differences: each coordinate is moved a little, and the alignment done anew."""
    points = measured(nominal_points())
    found = METHODS[method](points)
    J = np.empty((3 * COUNT, 3 * COUNT))
    for k in range(3 * COUNT):
        h = np.zeros(3 * COUNT)
        h[k] = 1e-3
        up, down = (replace(points, xyz=points.xyz + s * h.reshape(-1, 3)) for s in (1, -1))
        J[:, k] = (METHODS[method](up).apply(up).xyz - METHODS[method](down).apply(down).xyz).ravel() / 2e-3
    Q = J @ points.covariance @ J.T
    if method == "points":  # the nominal points add their own, by the same 7 as the measured ones
        own = replace(points, covariance=np.zeros_like(points.covariance))
        Q = Q + found.apply(own).covariance
    np.testing.assert_allclose(found.apply(points).covariance, Q, atol=1e-6 * np.abs(Q).max())


@pytest.mark.parametrize("method", METHODS)
def test_it_brings_points_home_whatever_their_datum(method: str) -> None:
    points = measured(nominal_points())
    there = METHODS[method](points).apply(points)
    wanted = nominal_points() if method == "points" else nominal_points() - [*nominal_points()[5, :2], 0]
    if there.xyz[-1, 2] * wanted[-1, 2] < 0:
        wanted = wanted * [1, -1, -1]  # the normal of the base has either sign
    np.testing.assert_allclose(there.xyz, wanted, atol=1e-8)
    free = replace(points, covariance=in_free_datum(points.covariance, points.xyz), datum="free")
    again = METHODS[method](free).apply(free)
    assert again.datum == "aligned"
    if method == "points":
        noisy = points.xyz + seed_of("noise").normal(scale=0.1, size=(COUNT, 3))
        fit, other = (METHODS[method](replace(m, xyz=noisy)).fitted for m in (points, free))
        assert fit is not None and other is not None and fit.statistic > 0.1
        assert fit.statistic == pytest.approx(other.statistic, rel=1e-3)
    else:
        np.testing.assert_allclose(again.covariance, there.covariance, atol=1e-9)
    before, after = (distance(point_function(m, "1"), point_function(m, "9")) for m in (points, there))
    np.testing.assert_allclose(there.covariance_between([after]), points.covariance_between([before]))


def test_what_a_system_is_defined_by_has_no_variance() -> None:
    points = measured(nominal_points())
    there = aligned_321(points).apply(points)
    sigma = np.sqrt(np.maximum(np.diagonal(there.covariance), 0)).reshape(-1, 3)
    held = np.zeros((COUNT, 3), dtype=bool)
    held[[0, 1, 2], 2] = held[[5, 6], 1] = held[5, 0] = True
    assert sigma[held].max() < 1e-6 < 1e-3 < sigma[~held].min()


def test_points_that_others_contradict_are_held_out() -> None:
    rng = seed_of("held out")
    points = measured(nominal_points())
    xyz = points.xyz + (np.linalg.cholesky(points.covariance) @ rng.normal(size=3 * COUNT)).reshape(-1, 3)
    xyz[[3, 8]] += [[5.0, 0, 0], [0, -4.0, 3]]
    moved = replace(points, xyz=xyz)
    fit = aligned_points(moved, robust=True).fitted
    assert fit is not None and set(np.flatnonzero(~fit.used)) == {3, 8}
    assert fit.statistic < fit.critical and fit.redundancy == 24
    errors = np.array([[5.0, 0, 0], [0, -4, 3]]) @ MOVED.rotation
    np.testing.assert_allclose(fit.difference[[3, 8]], errors, atol=1.0)
    every = aligned_points(moved).fitted
    assert every is not None and every.statistic > every.critical


def test_the_scale_is_fitted_where_it_is_asked_for() -> None:
    points = measured(nominal_points())
    half = replace(points, xyz=points.xyz / 2, covariance=points.covariance / 4, has_scale=False)
    found = aligned_points(half, scale=True)
    assert found.aligned_from_object.scale == pytest.approx(2.0, rel=1e-12)
    assert found.apply(half).has_scale
    kept = aligned_points(half, weights="equal")
    with pytest.raises(GeometryError, match="the best fit did not converge, measured and nominal points are"):
        aligned_points(half)
    assert kept.aligned_from_object.scale == 1 and not kept.apply(half).has_scale


def test_single_covariances_give_single_covariances() -> None:
    points = measured(nominal_points())
    blocks = points.blocks
    full = np.zeros_like(points.covariance)
    for k in range(COUNT):
        full[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = blocks[k]
    one, other = (aligned_points(replace(points, covariance=Q)).apply(replace(points, covariance=Q))
                  for Q in (blocks, full))  # fmt: skip
    np.testing.assert_allclose(one.blocks, other.blocks, rtol=1e-9)


def test_bad_input_is_one_line() -> None:
    points = measured(nominal_points())
    with pytest.raises(GeometryError, match="2 points of the plane and 2 of the line, expected 3 and 2"):
        align_321(points, ["0", "1"], ["5", "6"], "5")
    with pytest.raises(GeometryError, match="lie on a line"):
        align_321(points, ["0", "1", "0"], ["5", "6"], "5")
    with pytest.raises(GeometryError, match="2 nominal points measured, a best fit needs 3"):
        align_points(points, Nominal(("0", "1", "x"), np.eye(3)))
    bare = replace(points, covariance=None)
    with pytest.raises(GeometryError, match='expected weights = "equal"'):
        align_points(bare, Nominal(NUMBERS, nominal_points()))
    assert (
        align_points(bare, Nominal(NUMBERS, nominal_points()), weights="equal").apply(bare).covariance is None
    )
    z = difference(point_function(points, "5"), point_function(points, "6"))
    with pytest.raises(GeometryError, match="the directions of X and Z are parallel"):
        align_features(z, z, point_function(points, "0"))


FACES = ((0, 2, 1), (0, 3, 2), (4, 5, 6), (4, 6, 7), (0, 1, 5), (0, 5, 4), (1, 2, 6), (1, 6, 5),
         (2, 3, 7), (2, 7, 6), (3, 0, 4), (3, 4, 7))  # fmt: skip
CORNERS = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
CUBE = Mesh(100.0 * np.array(CORNERS, dtype=float), np.array(FACES))


def cube_distance(xyz: FloatArray) -> FloatArray:
    q = np.abs(xyz - 50) - 50
    outside = np.linalg.norm(np.maximum(q, 0), axis=1)
    return np.asarray(outside + np.minimum(q.max(axis=1), 0))


def test_distances_from_a_cube_are_exact_inside_and_outside() -> None:
    xyz = seed_of("cube").uniform(-60, 160, (500, 3))
    found = distances_from_mesh(xyz, CUBE)
    np.testing.assert_allclose(found.distance, cube_distance(xyz), atol=1e-9)
    step = 1e-5
    for axis in range(3):
        moved = distances_from_mesh(xyz + step * np.eye(3)[axis], CUBE).distance
        slope = (moved - found.distance) / step
        assert np.median(np.abs(slope - found.normal[:, axis])) < 1e-6
    on_edge = distances_from_mesh(np.array([[100.0, 50, 100], [100, 100, 100]]), CUBE)
    np.testing.assert_allclose(on_edge.distance, 0)
    np.testing.assert_allclose(on_edge.normal[0], [np.sqrt(0.5), 0, np.sqrt(0.5)], atol=0.2)


def test_triangles_of_very_different_size_are_found() -> None:
    """A fan of long triangles beside small ones: the nearest has its centroid far away."""
    fine = np.array([[x, y, 0.0] for x in range(5) for y in range(5)])
    small = [(5 * i + j, 5 * i + j + 5, 5 * i + j + 1) for i in range(4) for j in range(4)]
    vertices = np.vstack([fine, [[-5000.0, -1, 1], [5000, -1, 1], [0, -3000, 1]]])
    mesh = Mesh(vertices, np.array([*small, (25, 27, 26)]))
    found = distances_from_mesh(np.array([[3000.0, -2.0, 3.0], [1.2, 1.1, 0.5]]), mesh)
    np.testing.assert_allclose(np.abs(found.distance), [2.0, 0.5], atol=1e-9)


def test_nothing_is_decided_within_the_uncertainty() -> None:
    value = np.array([0.0, 0.079, 0.085, 0.119, 0.121, -0.121, 0.05])
    sigma = np.array([0.01] * 6 + [np.nan])
    told = decide(value, sigma, -0.1, 0.1, 2.0)
    assert told == ("in", "in", "undecided", "undecided", "out", "out", "not known")
    assert decide(np.array([0.0]), np.array([0.06]), -0.1, 0.1, 2.0) == ("undecided",)


def test_a_length_has_the_sigma_of_its_direction() -> None:
    Q = np.diag([1e-4, 4e-4, 9e-4, 1e-4, 1e-4, 1e-4])
    points = MeasuredPoints(("a", "b"), np.array([[0.0, 0.5, 0], [1, 1, 1]]), Q, "mm", "aligned")
    nominal = Nominal(("a", "c"), np.zeros((2, 3)), np.tile(5e-4 * np.eye(3), (2, 1, 1)))
    found = deviations_from_points(points, nominal, Tolerance("x", upper=0.6))
    assert found.value.tolist() == [0.5] and found.missing == ("c",)
    assert found.sigma[0] == pytest.approx(0.03) and found.decision == ("in",)
    with pytest.raises(GeometryError, match="tolerance x: no nominal point was measured"):
        deviations_from_points(points, Nominal(("c",), np.zeros((1, 3))), Tolerance("x", upper=1.0))


def test_deviations_from_a_mesh_and_a_shape_have_the_uncertainty_of_both() -> None:
    rng = seed_of("deviations")
    truth = simulated_shape("cylinder", rng)
    xyz = points_on(truth, 30, rng)
    points = MeasuredPoints(tuple(map(str, range(30))), xyz, random_covariance(30, 0.1, rng), "mm", "aligned")
    fit = fit_shape(points, "cylinder")
    found = deviations_from_shape(points, fit, Tolerance("roundness", -1.0, 1.0))
    assert found.count("in") == 30
    # a residual has less than the point itself, since the shape follows it
    assert np.median(found.sigma) < np.median(np.sqrt(np.einsum("nii->n", points.blocks) / 3))
    found = deviations_from_mesh(points, CUBE, np.arange(5), Tolerance("m", -1.0, 1.0), against="cube.stl")
    assert (found.sigma > 0).all() and len(found.decision) == 5


def test_a_hidden_point_takes_the_covariance_of_its_targets() -> None:
    rng = seed_of("hidden")
    xyz = np.array([[0.0, 0, 0], [100, 0, 0], [0, 50, 0]])
    points = MeasuredPoints(("a", "b", "c"), xyz, random_covariance(3, 0.1, rng), "mm", "free")
    found = with_hidden_point(points, "tip", "a", "b", 200.0, 0.05)
    np.testing.assert_allclose(found.xyz[3], [300, 0, 0])
    J = np.zeros((3, 9))
    for k in range(9):
        h = np.zeros(9)
        h[k] = 1e-4
        moved = [replace(points, xyz=xyz + s * h.reshape(3, 3)) for s in (1, -1)]
        up, down = (with_hidden_point(one, "tip", "a", "b", 200.0).xyz[3] for one in moved)
        J[:, k] = (up - down) / 2e-4
    Q = J @ points.covariance @ J.T + np.diag([0.05**2, 0, 0])
    np.testing.assert_allclose(found.covariance[9:, 9:], Q, rtol=1e-6)
    np.testing.assert_allclose(found.covariance[9:, :9], J @ points.covariance, rtol=1e-5, atol=1e-9)
    own = distance(point_function(found, "b"), point_function(found, "tip"))
    assert found.covariance_between([own])[0, 0] == pytest.approx(0.05**2, rel=1e-6)
    single = with_hidden_point(replace(points, covariance=points.blocks), "tip", "a", "b", 200.0)
    assert single.blocks.shape == (4, 3, 3)
    for told, call in {
        "a point of that name": lambda: with_hidden_point(points, "c", "a", "b", 1.0),
        "coincide": lambda: with_hidden_point(points, "tip", "a", "a", 1.0),
    }.items():
        with pytest.raises(GeometryError, match=told):
            call()
