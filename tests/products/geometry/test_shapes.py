"""Best-fit shapes: published figures, exactly known solutions, and what does not depend on the datum."""

from __future__ import annotations

import numpy as np
import pytest

from sfm.model.conventions import FloatArray
from sfm.model.errors import GeometryError
from sfm.products.geometry.measured import MeasuredPoints
from sfm.products.geometry.shapes.fit import ShapeFit, fit_shape, parameters_of
from sfm.products.geometry.shapes.kinds import KINDS, Shape
from tests.places import DATASETS
from tests.products.geometry.simulated import (
    design_of,
    in_free_datum,
    in_null_space,
    points_on,
    random_covariance,
    simulated_shape,
)
from tests.synthetic import seed_of

SIZE = 1000.0
COUNT = 24


def measured(xyz: FloatArray, covariance: FloatArray | None = None, **more: object) -> MeasuredPoints:
    return MeasuredPoints(tuple(f"{k + 1}" for k in range(len(xyz))), xyz, covariance, "mm", **more)  # type: ignore[arg-type]


def table(name: str) -> MeasuredPoints:
    values = np.genfromtxt(DATASETS / "fits" / name, delimiter=",", skip_header=1)
    xyz = np.zeros((len(values), 3))
    xyz[:, : values.shape[1]] = values
    return measured(xyz)


def squares(fit: ShapeFit) -> float:
    return float((fit.deviation**2).sum())


def values_of(shape: Shape, xyz: FloatArray) -> FloatArray:
    return parameters_of(shape.placed(xyz.mean(axis=0)).turned())[1]


def test_sphere_of_jaeger_mueller_saler_and_schwaeble() -> None:
    fit = fit_shape(table("sphere6.csv"), "sphere", weights="equal")
    np.testing.assert_allclose(fit.function.value[:4], (9.999725, 7.999807, 6.999306, 5.000542), atol=6e-7)
    np.testing.assert_allclose(fit.parameter_sigma[:4], (0.001057, 0.000531, 0.001584, 0.001414), atol=6e-7)
    assert squares(fit) == pytest.approx(4.55958e-7, rel=2e-6)
    assert fit.sigma0 == pytest.approx(4.7747e-4, rel=1e-5)
    assert fit.from_residuals and fit.redundancy == 2 and fit.fits is None


def test_sphere_of_a_held_radius_starts_from_the_free_fit() -> None:
    fit = fit_shape(table("sphere6.csv"), "sphere", weights="equal", hold={"diameter": 12.0})
    np.testing.assert_allclose(fit.function.value[:3], (9.342098, 8.185318, 5.952304), atol=6e-7)
    assert squares(fit) == pytest.approx(0.0694287, rel=1e-6)
    assert fit.value("radius") == 6.0 and fit.sigma_of("radius") == 0


def test_circle_of_gander_golub_and_strebel() -> None:
    fit = fit_shape(table("circle6.csv"), "circle", weights="equal")
    np.testing.assert_allclose(fit.function.value[:3], (4.739782, 2.983533, 0.0), atol=6e-7)
    assert fit.value("radius") == pytest.approx(4.714226, abs=6e-7)
    assert squares(fit) == pytest.approx(1.227599, abs=6e-7)


@pytest.mark.parametrize("kind", KINDS)
def test_offsets_in_the_null_space_leave_the_shape_where_it_is(kind: str) -> None:
    rng = seed_of(f"null space {kind}")
    truth = simulated_shape(kind, rng)
    foot = points_on(truth, COUNT, rng)
    normals, J = design_of(truth, foot)
    r = 5.0 * in_null_space(J, rng).reshape(COUNT, -1)
    xyz = foot + np.einsum("nc,nci->ni", r, normals)
    fit = fit_shape(measured(xyz), kind, weights="equal")
    assert fit.converged
    np.testing.assert_allclose(fit.function.value, values_of(truth, xyz), atol=1e-9 * SIZE, rtol=0)
    np.testing.assert_allclose(fit.deviation if r.shape[1] == 2 else np.abs(fit.deviation),
                               np.linalg.norm(r, axis=1), atol=1e-9 * SIZE)  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_with_the_covariance_of_a_network(kind: str) -> None:
    """Correlates k with A' k = 0 give residuals v = Q B' k of which the adjusted shape is known exactly."""
    rng = seed_of(f"weighted {kind}")
    truth = simulated_shape(kind, rng)
    foot = points_on(truth, COUNT, rng)
    normals, A = design_of(truth, foot)
    Q = random_covariance(COUNT, 2.0, rng)
    correlates = np.einsum("nci,nc->ni", normals, in_null_space(A, rng).reshape(COUNT, -1)).ravel()
    xyz = foot - (Q @ correlates).reshape(-1, 3)
    points = measured(xyz, Q)
    fit = fit_shape(points, kind)
    assert fit.converged
    np.testing.assert_allclose(fit.function.value, values_of(truth, xyz), atol=1e-9 * SIZE, rtol=0)
    assert fit.statistic * fit.redundancy == pytest.approx(correlates @ Q @ correlates, rel=1e-9)
    assert fit.redundancy == len(A) - A.shape[1]
    normals, A = design_of(fit.shape, foot)  # by the equations, in place of the propagation through them
    Qw = np.einsum("kci,kinj,nej->kcne", normals, Q.reshape(COUNT, 3, COUNT, 3), normals).reshape(len(A), -1)
    by_local = parameters_of(fit.shape)[2]
    J = by_local[:, [*fit.shape.kind.moves, *range(6, by_local.shape[1])]]
    C = J @ np.linalg.inv(A.T @ np.linalg.solve(Qw, A)) @ J.T
    np.testing.assert_allclose(fit.covariance, C, atol=1e-7 * np.abs(C).max())


@pytest.mark.parametrize("kind", KINDS)
def test_residuals_and_form_do_not_depend_on_the_datum(kind: str) -> None:
    """Nor does it matter that the covariance of a free network is singular, all its points on the shape."""
    rng = seed_of(f"datum {kind}")
    truth = simulated_shape(kind, rng)
    foot = points_on(truth, COUNT, rng)
    if kind == "line":  # points on one line carry no datum
        foot = np.vstack([foot, rng.normal(scale=SIZE, size=(6, 3))])
    Q = random_covariance(len(foot), 1.0, rng)
    xyz = foot + np.linalg.cholesky(Q).dot(rng.normal(size=foot.size)).reshape(-1, 3)
    own = np.arange(COUNT)
    one = fit_shape(measured(xyz, Q, datum="control"), kind, own)
    free = measured(xyz, in_free_datum(Q, xyz), datum="free")
    other = fit_shape(free, kind, own)
    assert other.statistic == pytest.approx(one.statistic, rel=1e-2)  # linearised at other points
    np.testing.assert_allclose(other.w, one.w, atol=0.02)
    lengths = np.array([what in ("length", "angle") for what in one.parameters.kinds])
    if lengths.any():
        np.testing.assert_allclose(other.parameter_sigma[lengths], one.parameter_sigma[lengths], rtol=1e-2)
    np.testing.assert_array_equal(free.depends_on_datum(other.function), ~lengths)


@pytest.mark.parametrize("kind", ["plane", "circle", "sphere", "cylinder"])
def test_a_robust_fit_leaves_out_what_most_points_contradict(kind: str) -> None:
    rng = seed_of(f"robust {kind}")
    truth = simulated_shape(kind, rng)
    xyz = points_on(truth, 30, rng) + rng.normal(scale=0.1, size=(30, 3))
    normals, _ = design_of(truth, xyz)
    wrong = rng.permutation(30)[:5]
    xyz[wrong] += normals[wrong, 0] * rng.uniform(30, 90, (5, 1)) * rng.choice([-1, 1], (5, 1))
    Q = np.eye(90) * 0.01
    fit = fit_shape(measured(xyz, Q), kind, robust=True)
    assert set(np.flatnonzero(~fit.used)) == set(wrong)
    assert fit.fits
    assert not fit_shape(measured(xyz, Q), kind).fits


@pytest.mark.parametrize("kind", ["plane", "sphere", "cylinder", "cone", "torus", "paraboloid", "circle"])
def test_an_offset_of_the_targets_is_taken_away(kind: str) -> None:
    rng = seed_of(f"offset {kind}")
    truth = simulated_shape(kind, rng).turned()
    xyz = points_on(truth, COUNT, rng)
    truth = truth.placed(xyz.mean(axis=0))
    targets = xyz + 3.0 * truth.design(xyz)[1][:, -1]
    fit = fit_shape(measured(targets), kind, weights="equal", offset=3.0)
    np.testing.assert_allclose(fit.shape.distances(xyz), 0, atol=1e-7)
    np.testing.assert_allclose(fit.deviation, 0, atol=1e-7)


def test_what_is_held_stays() -> None:
    rng = seed_of("held")
    truth = simulated_shape("cone", rng).turned()
    xyz = points_on(truth, COUNT, rng) + rng.normal(scale=0.5, size=(COUNT, 3))
    direction = truth.axis.tolist()
    fit = fit_shape(measured(xyz), "cone", weights="equal", hold={"direction": direction, "half_angle": 0.35})
    np.testing.assert_allclose(fit.shape.axis, truth.axis, atol=1e-12)
    assert fit.value("half_angle") == 0.35
    apex = fit_shape(measured(xyz), "cone", weights="equal").function.value[:3] + 1.0
    fit = fit_shape(measured(xyz), "cone", weights="equal", hold={"apex": apex})
    np.testing.assert_allclose(fit.function.value[:3], apex, atol=1e-9)
    np.testing.assert_allclose(fit.parameter_sigma[:3], 0, atol=1e-12)
    fit = fit_shape(measured(xyz), "line", weights="equal", hold={"point": [1.0, 2.0, 3.0]})
    np.testing.assert_allclose(np.cross([1.0, 2, 3] - fit.shape.origin, fit.shape.axis), 0, atol=1e-9)


@pytest.mark.parametrize(
    ("kind", "xyz", "options", "told"),
    [
        ("circle", [[0, 0, 0], [1, 0, 0]], {}, "circle hole: 2 points, a circle needs 3"),
        ("circle", [[0, 0, 0], [1, 0, 0], [3, 0, 0]], {}, "circle hole: its 3 points lie on a line"),
        ("sphere", [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 2, 0]], {}, "lie on a plane, a sphere needs"),
        ("plane", [[1, 1, 1]] * 3, {}, "its 3 points coincide"),
        ("ball", [[0, 0, 0]], {}, "kind 'ball', expected one of line, plane"),
        ("circle", [[0, 0, 0], [1, 0, 0], [0, 1, 0]], {"weights": "network"}, "unknown, expected weights"),
        ("circle", [[0, 0, 0], [1, 0, 0], [0, 1, 0]], {"hold": {"radius": -1}}, "expected a positive number"),
        ("circle", [[0, 0, 0], [1, 0, 0], [0, 1, 0]], {"hold": {"colour": 1}}, "expected one of centre"),
        ("circle", [[0, 0, 0], [1, 0, 0], [0, 1, 0]], {"robust": True}, "3 points, a robust fit"),
        ("line", [[0, 0, 0], [1, 0, 0]], {"hold": {"direction": [0, 0, 0]}}, "a non-zero vector"),
    ],
)
def test_bad_input_is_one_line(
    kind: str, xyz: list[list[float]], options: dict[str, object], told: str
) -> None:
    with pytest.raises(GeometryError, match=told):
        fit_shape(measured(np.array(xyz, dtype=float)), kind, name="hole", **{"weights": "equal"} | options)  # type: ignore[arg-type]


def test_points_on_a_line_within_their_precision_are_no_circle() -> None:
    rng = seed_of("nearly a line")
    xyz = np.zeros((10, 3))
    xyz[:, 0] = np.arange(10) * 100.0
    xyz += rng.normal(scale=0.1, size=xyz.shape)
    with pytest.raises(GeometryError, match="lie on a line"):
        fit_shape(measured(xyz, np.eye(30) * 0.01), "circle")


def test_what_cannot_be_known_of_a_free_network_cannot_be_held() -> None:
    rng = seed_of("held free")
    truth = simulated_shape("plane", rng)
    xyz = points_on(truth, COUNT, rng)
    Q = in_free_datum(random_covariance(COUNT, 1.0, rng), xyz)
    with pytest.raises(GeometryError, match='expected weights = "equal"'):
        fit_shape(measured(xyz, Q), "plane", hold={"direction": truth.axis.tolist()})


@pytest.mark.parametrize("seed", [5, 9, 15])
def test_few_points_far_from_a_cone_have_one_all_the_same(seed: int) -> None:
    """Their squared distances from any axis fall with the height, so no quadric of them is a cone."""
    rng = np.random.default_rng(seed)
    truth = simulated_shape("cone", rng)
    foot = points_on(truth, 20, rng)
    Q = random_covariance(20, 100.0, rng)
    xyz = foot + (np.linalg.cholesky(Q) @ rng.normal(size=60)).reshape(-1, 3)
    fit = fit_shape(measured(xyz), "cone", weights="equal")
    assert fit.converged and fit.rms <= np.sqrt((truth.distances(xyz) ** 2).mean())


def test_a_point_beside_the_axis_of_an_ellipse_overflows_nothing() -> None:
    """Its foot point lies where one denominator of its equation is 0."""
    d, _, _ = KINDS["ellipse"].distance(
        np.array([[1e-20, 0.0, 0.0], [0.0, 1e-20, 0.0]]), np.array([1.0, 2.0])
    )
    np.testing.assert_allclose(d[:, 0], -1.0)


def test_a_diverging_fit_is_one_line() -> None:
    """Twenty points all about, and a covariance as any."""
    rng = np.random.default_rng(21)
    xyz = rng.standard_normal((20, 3)) * [100.0, 80.0, 60.0]
    A = 0.01 * rng.standard_normal((60, 60))
    with pytest.raises(GeometryError, match=r"diverges .*: they are too far from any cone"):
        fit_shape(measured(xyz, A @ A.T), "cone")


def test_what_is_no_number_is_refused() -> None:
    points = table("sphere6.csv")
    for kind in KINDS:
        xyz = points.xyz.copy()
        xyz[2, 1] = np.nan
        with pytest.raises(GeometryError, match="point 3 has no coordinates"):
            fit_shape(measured(xyz), kind, weights="equal")
    for more in ({"offset": np.nan}, {"hold": {"radius": np.nan}}):
        with pytest.raises(GeometryError, match="not a finite number"):
            fit_shape(points, "sphere", weights="equal", **more)  # type: ignore[arg-type]
