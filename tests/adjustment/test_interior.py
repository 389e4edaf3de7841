"""Interior orientation shared by all photographs, by groups of them, or of one, parameter by parameter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.covariance import marginal_of
from sfm.adjustment.datum import Datum
from sfm.adjustment.engine.collinearity import residuals
from sfm.adjustment.engine.normals import normal_equations
from sfm.adjustment.engine.observed import observed_of
from sfm.adjustment.engine.solvers import choice
from sfm.adjustment.engine.solvers.dense import schur_complement
from sfm.adjustment.engine.solvers.multifrontal import MultifrontalSolver
from sfm.adjustment.engine.unknowns import interior_names, start_weights, step, unknowns_of
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.comparison.solutions import reprojection
from sfm.model.camera import Camera, project
from sfm.model.conventions import FloatArray
from sfm.model.errors import GeometryError, SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, InteriorObservations, Network, ObjectPoints
from sfm.textbook.direct import adjust_separately
from tests.synthetic import make_network, perturb, seed_of

FREE = Datum("free")
SHARED = ("x0", "y0", "K1", "K2", "P1", "P2")
IMAGES = 8


def photograph_cameras(camera: Camera, own: tuple[str, ...], groups: tuple[str, ...]) -> tuple[Camera, ...]:
    """One camera for each photograph; the parameters named in `own` are theirs, the others of their group."""
    return tuple(
        replace(camera, name=f"A {i}", shared=tuple("" if name in own else group for name in camera.names))
        for i, group in enumerate(groups)
    )


def zoomed(
    name: str, *, noise_px: float, groups: tuple[str, ...] = ("A",) * IMAGES, points: int = 40
) -> tuple[Network, Estimate]:
    """A network whose photographs differ in c by up to 2 %, all else of the lens being of their group."""
    rng = seed_of(name)
    network, truth = make_network(rng, images=IMAGES, points=points, noise_px=0.0)
    cameras = photograph_cameras(truth.cameras[0], ("c",), groups)
    c = truth.cameras[0].value("c") * (1 + rng.uniform(-0.02, 0.02, IMAGES))
    cameras = tuple(
        camera.with_parameters(np.concatenate([[c[i]], camera.parameters[1:]]))
        for i, camera in enumerate(cameras)
    )
    k = network.image_points
    xy = np.empty_like(k.xy)
    for i, camera in enumerate(cameras):
        rows = k.image == i
        xy[rows] = project(camera, truth.position[i], truth.rotation[i], truth.points[k.point[rows]])
    xy += noise_px * rng.standard_normal(xy.shape)
    return (
        replace(
            network, camera=np.arange(IMAGES), image_points=ImagePoints(k.image, k.point, xy, k.covariance)
        ),
        replace(truth, cameras=cameras),
    )


def spoilt(truth: Estimate, name: str) -> Estimate:
    """Start values: one common c, no distortion."""
    start = perturb(truth, seed_of(name), distortion=False)
    c = float(np.mean([camera.value("c") for camera in truth.cameras]))
    p = start.cameras[0].parameters.copy()
    p[0] = c
    return replace(start, cameras=tuple(camera.with_parameters(p) for camera in start.cameras))


@pytest.mark.parametrize("method", ["gauss-newton", "levenberg-marquardt"])
def test_c_of_each_photograph_is_recovered_with_shared_distortion(method: str) -> None:
    network, truth = zoomed("zoom", noise_px=0.0)
    a = adjust(
        network, spoilt(truth, "start"), datum=FREE, reject="none", options=AdjustmentOptions(method=method)
    )
    assert a.converged and a.defect == 7 and not a.undetermined
    for found, true in zip(a.estimate.cameras, truth.cameras, strict=True):
        assert found.parameters == pytest.approx(true.parameters, rel=1e-6, abs=1e-9)


def test_unknowns_are_counted_once_and_redundancy_numbers_add_up() -> None:
    network, truth = zoomed("count", noise_px=0.1)
    a = adjust(network, truth, datum=FREE, reject="none")
    n, k = len(network.points), len(network.image_points)
    assert a.unknowns == 6 * IMAGES + IMAGES + len(SHARED) + 3 * n
    assert a.redundancy == 2 * k - a.unknowns + 7
    assert a.redundancy_numbers.sum() == pytest.approx(a.redundancy, abs=1e-3)
    assert a.sigma0 == pytest.approx(1, abs=4 / np.sqrt(2 * a.redundancy))
    first = a.estimate.cameras[0]
    for camera, Q in zip(a.estimate.cameras, a.covariance.interior, strict=True):
        assert (camera.parameters[1:] == first.parameters[1:]).all()
        assert (Q[1:, 1:] == a.covariance.interior[0][1:, 1:]).all()
    difference = [f.value("c") - t.value("c") for f, t in zip(a.estimate.cameras, truth.cameras, strict=True)]
    sigma = [np.sqrt(Q[0, 0]) for Q in a.covariance.interior]
    assert (np.abs(difference) < 4.5 * np.array(sigma)).all()
    whole = replace(truth, cameras=tuple(replace(c, shared=("A",) * 10) for c in truth.cameras))
    with pytest.raises(GeometryError, match="cameras A 0 and A 1 share c, but start from"):
        adjust(network, whole, datum=FREE)


def test_normal_equations_equal_those_of_differences() -> None:
    """Parameters of three kinds at once: c of each photograph, x0 and y0 of two groups, the rest of all."""
    network, truth = zoomed("normals", noise_px=0.1, points=10)
    groups = tuple("even" if i % 2 == 0 else "odd" for i in range(IMAGES))
    kinds = {"c": lambda i: "", "x0": lambda i: groups[i], "y0": lambda i: groups[i]}
    truth = replace(
        truth,
        cameras=tuple(
            replace(camera, shared=tuple(kinds.get(name, lambda i: "A")(i) for name in camera.names))
            for i, camera in enumerate(truth.cameras)
        ),
    )
    fixed = ObjectPoints(np.arange(10), truth.points, np.zeros((10, 3, 3)))  # so that nothing is eliminated
    network = network.with_given(fixed)
    layout, state = unknowns_of(network, truth, use_control=True)
    names = interior_names(layout, truth)
    assert len(names) == len(set(names)) == IMAGES + 4 + 4
    assert names.count(("x0", "camera even")) == 1 and ("K1", "camera A") in names
    J = np.empty((2 * len(network.image_points), layout.reduced))
    none = np.zeros((10, 3))
    for s in range(layout.reduced):
        h = 1e-4 if s < 6 * IMAGES else 1e-3 * max(1e-4, abs(_value(layout, state, s)))
        moved = [
            residuals(
                layout.observations, step(layout, state, f * h * np.eye(layout.reduced)[s], none)
            ).ravel()
            for f in (-2, -1, 1, 2)
        ]
        J[:, s] = (moved[0] - 8 * moved[1] + 8 * moved[2] - moved[3]) / (12 * h)
    observed = observed_of(network, layout, state, use_control=True)
    weight = start_weights(layout, state)
    equations = normal_equations(layout, observed, state, weight)
    N = 100 * J.T @ J
    scale = 1 / np.sqrt(np.diagonal(N))
    S = schur_complement(equations, layout) / equations.parts.scale[:, None] / equations.parts.scale
    assert np.abs((np.triu(S) - np.triu(N)) * scale[:, None] * scale).max() < 1e-8
    g = 100 * J.T @ residuals(layout.observations, state).ravel()
    assert np.abs((equations.parts.g - g) * scale).max() < 1e-7 * np.abs(g * scale).max()


def _value(layout, state, column: int) -> float:  # type: ignore[no-untyped-def]
    for a, columns in enumerate(layout.interior_column):
        for s, own in zip(layout.interior_free[a], columns, strict=True):
            if own == column:
                return float(state.parameters[a, s])
    return 0.0


def test_covariance_equals_the_inverse_of_the_whole() -> None:
    network, truth = zoomed("inverse", noise_px=0.1, points=15)
    control = ObjectPoints(np.arange(4), truth.points[:4], np.zeros((4, 3, 3)))
    a = adjust(network.with_given(control), truth, datum=Datum("control"), reject="none")
    m = marginal_of(a)
    interior = np.arange(6 * IMAGES, 6 * IMAGES + IMAGES + len(SHARED))
    Q = m.joint(interior, np.zeros(0, dtype=int))
    names = interior_names(m.layout, a.estimate)
    for i in range(IMAGES):
        rows = [names.index(("c", f"camera A {i}"))] + [names.index((s, "camera A")) for s in SHARED]
        own = Q[np.ix_(rows, rows)]
        sigma = np.sqrt(np.diagonal(own))
        assert np.abs((own - a.covariance.interior[i]) / sigma[:, None] / sigma).max() < 1e-5


def test_fronts_and_full_normal_equations_share_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    network, truth = zoomed("fronts", noise_px=0.1)
    full = adjust(network, truth, datum=FREE, reject="none")
    monkeypatch.setattr(choice, "SMALL", 0)
    monkeypatch.setattr(choice, "FACTOR_RATE", 1e-3)  # so that fronts are always less work
    monkeypatch.setattr(choice, "MOSTLY", 1.0)
    layout, _ = unknowns_of(network, truth, use_control=False)
    assert isinstance(choice.choose_solver(layout), MultifrontalSolver)
    fronts = adjust(network, truth, datum=FREE, reject="none")
    assert fronts.sigma0 == pytest.approx(full.sigma0, rel=1e-9)
    for one, other in zip(fronts.covariance.interior, full.covariance.interior, strict=True):
        sigma = np.sqrt(np.diagonal(other))
        assert np.abs((one - other) / sigma[:, None] / sigma).max() < 1e-5
    assert np.abs(fronts.redundancy_numbers - full.redundancy_numbers).max() < 1e-6


def test_one_camera_is_the_case_of_all_parameters_shared() -> None:
    network, truth = make_network(seed_of("all shared"), images=IMAGES, points=30)
    one = adjust(network, truth, datum=FREE, reject="none")
    cameras = photograph_cameras(truth.cameras[0], (), ("A",) * IMAGES)
    many = adjust(
        replace(network, camera=np.arange(IMAGES)), replace(truth, cameras=cameras), datum=FREE, reject="none"
    )
    assert (many.unknowns, many.redundancy) == (one.unknowns, one.redundancy)
    assert many.sigma0 == pytest.approx(one.sigma0, rel=1e-10)
    assert np.abs(many.estimate.points - one.estimate.points).max() < 1e-9
    assert many.covariance.interior[3] == pytest.approx(one.covariance.interior[0], rel=1e-5, abs=1e-16)


def test_separate_adjustment_ends_at_the_same_optimum() -> None:
    network, truth = zoomed("separate", noise_px=0.1, points=25)
    control = ObjectPoints(np.arange(25), truth.points, np.zeros((25, 3, 3)))
    network = network.with_given(control)
    together = adjust(network, truth, datum=Datum("control"), reject="none")
    apart = adjust_separately(network, truth)
    assert apart.converged
    assert apart.vPv == pytest.approx(together.vPv, rel=1e-9)


def test_parameters_are_free_fixed_or_weighted_one_by_one() -> None:
    """c of each photograph weighted, K1 of all weighted tightly, P1, P2 fixed, the rest free."""
    network, truth = zoomed("weighted", noise_px=0.1)
    names = truth.cameras[0].names
    fixed = np.array([name not in ("P1", "P2") for name in names])
    truth = replace(truth, cameras=tuple(replace(c, free=c.free & fixed) for c in truth.cameras))
    K1 = names.index("K1")
    observed = InteriorObservations(
        camera=np.array([*range(IMAGES), 0]),
        parameter=np.array([0] * IMAGES + [K1]),
        value=np.array([*(c.value("c") for c in truth.cameras), 8.5e-4]),
        sigma=np.array([*[1e-3] * IMAGES, 1e-9]),
    )
    free = adjust(network, truth, datum=FREE, reject="none")
    a = adjust(network.with_given(observed), truth, datum=FREE, reject="none")
    assert a.observations == free.observations + IMAGES + 1
    assert a.redundancy == free.redundancy + IMAGES + 1
    for camera, was, Q, before in zip(
        a.estimate.cameras, truth.cameras, a.covariance.interior, free.covariance.interior, strict=True
    ):
        assert camera.value("K1") == pytest.approx(8.5e-4, abs=1e-7)
        assert (camera.value("P1"), camera.value("P2")) == (was.value("P1"), was.value("P2"))
        assert Q[0, 0] / a.sigma0**2 < min(1e-6, before[0, 0] / free.sigma0**2)


def test_a_calibration_and_a_survey_one_after_the_other_are_both_together() -> None:
    """With the full covariance of the calibration as observation; its diagonal alone does not do it.

    What is left is of second order: 0.065, 0.006, 0.0006 sigma with a noise of 0.1, 0.01, 0.001 px.
    """
    network, truth = make_network(seed_of("two steps"), images=8, points=30, model="brown", noise_px=0.01)
    control = ObjectPoints(np.arange(30), truth.points, np.zeros((30, 3, 3)))
    network = network.with_given(control)
    seen = network.image_points

    def part(chosen: np.ndarray, interior: InteriorObservations | None = None) -> Adjustment:
        images = np.flatnonzero(chosen)
        rows = np.flatnonzero(chosen[seen.image])
        points = replace(seen.select(rows), image=np.searchsorted(images, seen.image[rows]))
        own = replace(
            network,
            images=tuple(network.images[i] for i in images),
            camera=network.camera[images],
            image_points=points,
        ).with_given(interior or InteriorObservations())
        start = replace(truth, position=truth.position[images], rotation=truth.rotation[images])
        return adjust(own, start, datum=Datum("control"), reject="none")

    together = part(np.ones(8, dtype=bool))
    first = part(np.arange(8) < 4)
    camera, Q = first.estimate.cameras[0], first.covariance.interior[0] / first.sigma0**2
    free = np.flatnonzero(camera.free)
    sigma = np.sqrt(np.diagonal(Q))
    R = Q / np.outer(sigma, sigma)
    values = np.zeros(len(free), dtype=np.int64), free, camera.parameters[free], sigma
    due = together.covariance.interior[0] / together.sigma0**2
    unit = np.sqrt(np.diagonal(due))
    for correlation, same in ((R, True), (None, False)):
        second = part(np.arange(8) >= 4, InteriorObservations(*values, correlation))
        found = second.covariance.interior[0] / second.sigma0**2
        off = (second.estimate.cameras[0].parameters - together.estimate.cameras[0].parameters)[free] / unit
        assert (np.abs(off).max() < 0.01) == same
        assert (np.abs(np.sqrt(np.diagonal(found)) / unit - 1).max() < 0.01) == same
    assert second.observations == together.observations - first.observations + len(free)


def test_tables_of_groups_are_as_long_as_the_parameters() -> None:
    _, truth = make_network(seed_of("refused"), images=4, points=10)
    with pytest.raises(SurveyFileError, match="3 groups of 10 parameters"):
        replace(truth.cameras[0], shared=("A", "A", "A"))


def gradient(network: Network, estimate: Estimate) -> FloatArray:
    layout, state = unknowns_of(network, estimate, use_control=False)
    observed = observed_of(network, layout, state, use_control=False)
    return normal_equations(layout, observed, state, start_weights(layout, state)).parts.g


def test_gradient_vanishes_at_the_truth() -> None:
    network, truth = zoomed("gradient", noise_px=0.0)
    assert np.abs(gradient(network, truth)).max() < 1e-4


def test_sigma0_at_the_start_values_is_that_of_their_residuals() -> None:
    network, truth = make_network(seed_of("start"), images=6, points=30)
    start = replace(truth, points=truth.points + 0.01)
    a = adjust(network, start, reject="none", options=AdjustmentOptions(max_iterations=50))
    v = reprojection(network, start)
    sigma = float(np.sqrt(network.image_points.covariance[0, 0, 0]))
    assert a.start_sigma0 == pytest.approx(np.sqrt((v**2).sum() / sigma**2 / a.redundancy), rel=1e-6)
