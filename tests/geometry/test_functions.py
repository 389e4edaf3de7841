"""Functions of coordinates: derivatives against differences, and which of them a free datum determines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sfm.errors import GeometryError
from sfm.geometry.alignment import align_321
from sfm.geometry.measured import (
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
from sfm.geometry.shapes.fit import fit_shape
from tests.geometry.simulated import in_free_datum, random_covariance
from tests.inspection.benches import one_bench
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
    with pytest.raises(GeometryError, match="group rim: 'x1' is the name of no point, and no pattern"):
        measured.matching(["A", "x1"], "group rim")


def test_what_has_no_derivative_is_refused() -> None:
    measured = points()
    with pytest.raises(GeometryError, match="in one place"):
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
