"""Adjustment: exact at the truth, the same in every datum, covariance against the inverse of the whole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.covariance import shifted
from sfm.adjustment.datum import Datum, free_motions
from sfm.adjustment.engine.collinearity import collinearity, new_workspace, residuals
from sfm.adjustment.engine.unknowns import step, unknowns_of
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.model.conventions import angles_from_rotation, rotation_from_angles
from sfm.model.distortion.models import GENERAL_MODELS, MODELS
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import ExteriorObservations, InteriorObservations, Network, ObjectPoints, ScaleBars
from sfm.model.observations.pose import angle_jacobian
from sfm.model.similarity import fit_similarity
from tests.synthetic import make_network, perturb, seed_of

FREE = Datum("free")


def controlled(network: Network, truth: Estimate, sigma: float) -> Network:
    """The network with its first five points as control of the given sigma, 0 = fixed."""
    return network.with_given(
        ObjectPoints(np.arange(5), truth.points[:5], np.tile(sigma**2 * np.eye(3), (5, 1, 1)))
    )


def distances(a: Adjustment) -> np.ndarray:
    points = a.estimate.points
    return np.linalg.norm(points[:, None] - points[None], axis=2)


@pytest.mark.parametrize("model", MODELS)
def test_residual_and_derivatives_of_one_image_point(model: str) -> None:
    network, truth = make_network(seed_of(model), images=2, points=8, noise_px=0.0, model=model)
    layout, state = unknowns_of(network, truth, use_control=False)
    assert np.abs(residuals(layout.observations, state)).max() < 1e-8
    t = new_workspace.py_func()
    o, h = 5, 1e-4
    i, j = layout.observations.image[o], layout.observations.point[o]
    assert collinearity.py_func(o, layout.observations, state, 1.0, t)
    A, B = t.A[:, :6].copy(), t.B.copy()
    weight = layout.observations.whitening[o, 0]
    for s in range(9):
        v = []
        for f in (-2, -1, 1, 2):
            reduced, points = np.zeros(layout.reduced), np.zeros((8, 3))
            if s < 6:
                reduced[6 * i + s] = f * h
            else:
                points[j, s - 6] = f * h
            v.append(residuals(layout.observations, step(layout, state, reduced, points))[o])
        difference = weight * (v[0] - 8 * v[1] + 8 * v[2] - v[3]) / (12 * h)
        derivative = A[:, s] if s < 6 else B[:, s - 6]
        assert np.abs(derivative - difference).max() < 1e-8 * max(np.abs(A).max(), 1)


@pytest.mark.parametrize("kind", ["free", "minimal", "control"])
@pytest.mark.parametrize("model", (*GENERAL_MODELS, "simple_radial", "opencv_fisheye", "division"))
def test_exact_measurements_give_the_truth(model: str, kind: str) -> None:
    rng = seed_of(f"exact {model} {kind}")
    network, truth = make_network(rng, images=8, points=30, noise_px=0.0, model=model, cameras=2)
    network = controlled(network, truth, 0.0)
    a = adjust(network, perturb(truth, rng, c=0.02), datum=Datum(kind), reject="none")
    assert a.converged
    assert np.abs(a.residuals).max() < 1e-6
    back = fit_similarity(a.estimate.points, truth.points).apply_estimate(a.estimate)
    assert np.abs(back.points - truth.points).max() < 1e-8
    assert np.abs(back.position - truth.position).max() < 1e-7
    if kind == "control":
        assert np.abs(a.estimate.points - truth.points).max() < 1e-8
    for found, camera in zip(a.estimate.cameras, truth.cameras, strict=True):
        assert found.parameters[:3] == pytest.approx(camera.parameters[:3], rel=1e-7, abs=1e-7)
    assert (a.defect, a.expected_defect) == ((0, 0) if kind == "control" else (7, 7))


def test_start_at_the_truth_of_exact_measurements_is_left_alone() -> None:
    network, truth = make_network(seed_of("stay"), images=6, points=20, noise_px=0.0)
    a = adjust(network, truth, datum=FREE, reject="none")
    assert a.iterations == 0
    assert np.abs(a.estimate.points - truth.points).max() < 1e-10


@pytest.mark.parametrize("planar", [False, True])
def test_what_does_not_depend_on_the_datum(planar: bool) -> None:
    rng = seed_of(f"datum {planar}")
    network, truth = make_network(rng, images=8, points=30, planar=planar, visibility=0.8)
    start = perturb(truth, rng)
    some = np.zeros(30, dtype=bool)
    some[:6] = True
    results = [
        adjust(network, start, datum=datum, reject="none")
        for datum in (FREE, Datum("minimal"), Datum("free", some), Datum("minimal", some))
    ]
    a = results[0]
    traces = []
    for b in results:
        assert b.sigma0 == pytest.approx(a.sigma0, rel=1e-9)
        assert np.abs(b.residuals - a.residuals).max() < 1e-6
        assert b.redundancy_numbers.sum() == pytest.approx(b.redundancy, abs=1e-3)
        assert np.abs(b.covariance.interior[0] / a.covariance.interior[0] - 1).max() < 1e-5
        ratio = distances(b)[0, 1:] / distances(a)[0, 1:]
        assert np.ptp(ratio) < 1e-8
        traces.append(np.trace(b.covariance.points.sum(axis=0)))
    assert traces[0] == min(traces)
    chosen = [np.trace(b.covariance.points[some].sum(axis=0)) for b in results]
    assert chosen[2] == min(chosen)
    assert (np.diagonal(results[1].covariance.points, axis1=1, axis2=2) == 0).sum() == 7


@pytest.mark.parametrize("kind", ["free", "minimal", "control", "weighted", "bars"])
def test_covariance_equals_the_inverse_of_the_whole(kind: str) -> None:
    """The normal matrix of all unknowns, bordered by the datum, is inverted at once."""
    rng = seed_of(f"whole {kind}")
    network, truth = make_network(rng, images=5, points=12, free=("c", "x0", "K1"))
    if kind in ("control", "weighted"):
        network = controlled(network, truth, 0.0 if kind == "control" else 1e-3)
    if kind == "bars":
        network = network.with_given(
            ScaleBars(
                np.array([0, 1]),
                np.array([2, 3]),
                np.linalg.norm(truth.points[[0, 1]] - truth.points[[2, 3]], axis=1),
                np.array([1e-3, 2e-3]),
            )
        )
    datum = Datum(
        kind if kind in ("free", "minimal", "control") else "control" if kind == "weighted" else "free"
    )
    a = adjust(network, truth, datum=datum, reject="none")

    use_control = datum.kind == "control"
    layout, state = unknowns_of(network, a.estimate, use_control=use_control)
    m, n = 5, 12
    first = layout.reduced - 3 * len(layout.kept)
    u = first + 3 * n
    N = np.zeros((u, u))
    t = new_workspace.py_func()
    for o in range(len(layout.order)):
        collinearity.py_func(o, layout.observations, state, 1.0, t)
        i, j = layout.observations.image[o], layout.observations.point[o]
        row = np.zeros((2, u))
        row[:, 6 * i : 6 * i + 6] = t.A[:, :6]
        row[:, 6 * m : first] = t.A[:, 6 + layout.interior_free[0]]
        row[:, first + 3 * j : first + 3 * j + 3] = t.B
        N += row.T @ row
    for s in range(len(network.control) if kind == "weighted" else 0):
        own = slice(first + 3 * s, first + 3 * s + 3)
        N[own, own] += np.linalg.inv(network.control.covariance[s])
    for s in range(len(network.scale_bars)):
        p, q = network.scale_bars.start[s], network.scale_bars.end[s]
        d = state.points[q] - state.points[p]
        row = np.zeros(u)
        row[first + 3 * q : first + 3 * q + 3] = d / np.linalg.norm(d)
        row[first + 3 * p : first + 3 * p + 3] = -d / np.linalg.norm(d)
        N += np.outer(row, row) / network.scale_bars.sigma[s] ** 2
    fixed = np.zeros(u, dtype=bool)
    fixed[first:] = ~layout.point_free.ravel()
    if kind == "minimal":
        fixed[first:] = (np.diagonal(a.covariance.points, axis1=1, axis2=2) == 0).ravel()
    keep = ~fixed
    G = np.zeros((u, 0))
    if kind in ("free", "bars"):
        _, _, motions = free_motions(layout, state)
        G = np.zeros((u, 7 if kind == "free" else 6))
        G[first:] = motions.reshape(3 * n, 7)[:, : G.shape[1]]
    scale = 1 / np.sqrt(np.diagonal(N))[keep]
    G = G[keep] * 100
    bordered = np.block(
        [
            [N[np.ix_(keep, keep)] * scale[:, None] * scale, G * scale[:, None]],
            [G.T * scale, np.zeros((G.shape[1],) * 2)],
        ]
    )
    Q = np.zeros((u, u))
    inverse = np.linalg.inv(bordered)[: keep.sum(), : keep.sum()] * scale[:, None] * scale
    Q[np.ix_(keep, keep)] = a.sigma0**2 * inverse
    for j in range(n):
        own = slice(first + 3 * j, first + 3 * j + 3)
        size = np.abs(Q[own, own]).max()
        assert np.abs(a.covariance.points[j] - Q[own, own]).max() <= 1e-5 * size
    interior = slice(6 * m, first)
    assert np.abs(a.covariance.interior[0] / Q[interior, interior] - 1).max() < 1e-5
    for i in range(m):
        own = slice(6 * i, 6 * i + 3)
        size = np.abs(Q[own, own]).max()
        assert np.abs(a.covariance.exterior[i, :3, :3] - Q[own, own]).max() <= 1e-5 * size


def test_angle_covariance_is_that_of_omega_phi_kappa() -> None:
    rng = seed_of("angles")
    network, truth = make_network(rng, images=6, points=20)
    network = controlled(network, truth, 0.0)
    layout, state = unknowns_of(network, truth, use_control=True)
    h = 1e-6
    T = angle_jacobian(state.M)
    for s in range(3):
        reduced = np.zeros(layout.reduced)
        reduced[3 + s : 36 : 6] = h
        moved = step(layout, state, reduced, np.zeros((20, 3)))
        change = angles_from_rotation(np.swapaxes(moved.M, 1, 2)) - angles_from_rotation(
            np.swapaxes(state.M, 1, 2)
        )
        assert (
            np.abs((change + np.pi) % (2 * np.pi) - np.pi - h * T[:, :, s]).max() < 1e-4 * h * np.abs(T).max()
        )


def test_weights_of_control_go_from_fixed_to_free() -> None:
    rng = seed_of("weights")
    network, truth = make_network(rng, images=6, points=20)
    moved = truth.points[:5] + rng.normal(0, 2e-3, (5, 3))

    def with_sigma(sigma: float) -> Adjustment:
        control = ObjectPoints(np.arange(5), moved, np.tile(sigma**2 * np.eye(3), (5, 1, 1)))
        return adjust(network.with_given(control), truth, datum=Datum("control"), reject="none")

    fixed, tight, loose = with_sigma(0.0), with_sigma(1e-9), with_sigma(0.3)
    free = adjust(network, truth, datum=FREE, reject="none")
    assert np.abs(fixed.estimate.points - tight.estimate.points).max() < 1e-8
    assert fixed.redundancy == tight.redundancy == loose.redundancy
    assert loose.sigma0**2 * loose.redundancy == pytest.approx(free.sigma0**2 * free.redundancy, rel=1e-3)
    assert fixed.sigma0 > 2 * free.sigma0


def test_observed_orientation_and_interior_replace_control() -> None:
    rng = seed_of("observed")
    network, truth = make_network(rng, images=6, points=25)
    sigma = np.array([1e-3] * 3 + [np.inf] * 3)
    network = network.with_given(
        ExteriorObservations(
            np.arange(6),
            truth.position + rng.normal(0, 1e-3, (6, 3)),
            angles_from_rotation(truth.rotation),
            np.tile(np.diag(sigma**2), (6, 1, 1)),
        ),
        InteriorObservations(np.array([0]), np.array([0]), np.array([10.0]), np.array([1e-6])),
    )
    a = adjust(network, perturb(truth, rng), datum=FREE, reject="none")
    assert (a.defect, a.expected_defect, a.undetermined) == (0, 0, ())
    assert a.observations == 2 * len(network.image_points) + 18 + 1
    assert a.estimate.cameras[0].value("c") == pytest.approx(10.0, abs=3e-6)
    error = a.estimate.points - truth.points
    Q = a.covariance.points
    assert 0.3 < np.mean(np.einsum("na,nab,nb->n", error, np.linalg.inv(Q), error)) / 3 < 3


def test_scale_bars_scale_the_network() -> None:
    rng = seed_of("bars")
    network, truth = make_network(rng, images=6, points=20)
    length = float(np.linalg.norm(truth.points[3] - truth.points[8]))
    bar = ScaleBars(np.array([3]), np.array([8]), np.array([2 * length]), np.array([1e-5]))
    a = adjust(network.with_given(bar), truth, datum=FREE, reject="none")
    assert (a.defect, a.expected_defect) == (6, 6)
    assert np.linalg.norm(a.estimate.points[3] - a.estimate.points[8]) == pytest.approx(2 * length, abs=1e-8)
    assert a.redundancy == adjust(network, truth, datum=FREE, reject="none").redundancy


def test_two_methods_and_several_cameras_reach_the_same_optimum() -> None:
    rng = seed_of("methods")
    network, truth = make_network(rng, images=9, points=30, cameras=3, visibility=0.7)
    start = perturb(truth, rng, c=0.05, distortion=False)
    a = adjust(network, start, datum=FREE, reject="none", options=AdjustmentOptions(method="gauss-newton"))
    b = adjust(
        network, start, datum=FREE, reject="none", options=AdjustmentOptions(method="levenberg-marquardt")
    )
    assert a.converged and b.converged
    assert a.sigma0 == pytest.approx(b.sigma0, rel=1e-10)
    assert np.abs(a.residuals - b.residuals).max() < 1e-5


def test_correlated_image_coordinates_are_weighted_as_such() -> None:
    rng = seed_of("correlated")
    network, truth = make_network(rng, images=6, points=20, noise_px=0.0)
    C = np.array([[0.04, 0.015], [0.015, 0.01]])
    noise = rng.multivariate_normal(np.zeros(2), C, len(network.image_points))
    points = replace(
        network.image_points, xy=network.image_points.xy + noise, covariance=np.tile(C, (len(noise), 1, 1))
    )
    a = adjust(replace(network, image_points=points), truth, datum=FREE, reject="none")
    v = a.residuals
    vPv = float(np.einsum("ka,ab,kb->", v, np.linalg.inv(C), v))
    assert vPv == pytest.approx(a.sigma0**2 * a.redundancy, rel=1e-8)
    assert a.sigma0 == pytest.approx(1, abs=5 / np.sqrt(2 * a.redundancy))


def test_refusals() -> None:
    network, truth = make_network(seed_of("refusals"), images=4, points=12)
    with pytest.raises(GeometryError, match="reject 'ransac', expected one of"):
        adjust(network, truth, datum=FREE, reject="ransac")
    with pytest.raises(GeometryError, match="method 'newton', expected one of"):
        adjust(network, truth, datum=FREE, options=AdjustmentOptions(method="newton"))
    with pytest.raises(GeometryError, match="kind 'loose', expected one of"):
        Datum("loose")
    line = np.zeros(12, dtype=bool)
    line[0] = True
    with pytest.raises(GeometryError, match="datum points cannot fix"):
        adjust(network, truth, datum=Datum("free", line))
    lost = replace(truth, position=np.full_like(truth.position, np.nan))
    with pytest.raises(GeometryError, match="no image point joins"):
        adjust(network, lost, datum=FREE)


@pytest.mark.parametrize("kind", ["free", "control"])
def test_a_network_far_from_the_origin_is_adjusted_as_one_near_it(kind: str) -> None:
    # 4096 km by 8192 km, exact in binary, so that the coordinates themselves are rounded to 1e-9 m only.
    far = np.array([2.0**22, 2.0**23, 0.0])
    network, truth = make_network(seed_of("far"), images=8, points=30)
    control = ObjectPoints(np.arange(5), truth.points[:5], np.zeros((5, 3, 3)))
    network = network.with_given(control)
    start = perturb(truth, seed_of("far start"))
    distant, distant_start = shifted(network, start, far)
    near = adjust(network, start, datum=Datum(kind), reject="none")
    a = adjust(distant, distant_start, datum=Datum(kind), reject="none")
    assert a.converged
    assert a.network is distant
    assert a.iterations <= near.iterations + 1
    assert a.vPv == pytest.approx(near.vPv, rel=1e-6)
    if kind == "control":
        np.testing.assert_array_equal(a.estimate.points[:5], distant.control.xyz)
        np.testing.assert_allclose(a.estimate.points - far, near.estimate.points, atol=1e-7)
    np.testing.assert_allclose(a.covariance.points, near.covariance.points, rtol=1e-4, atol=1e-15)


def test_angles_at_ninety_degrees_of_phi_have_no_separate_sigma() -> None:
    """Derivatives of omega and kappa grow to 1e8, not to infinity."""
    R = rotation_from_angles(0.3, np.pi / 2, 0.0)
    J = angle_jacobian(R.T[None])[0]
    assert np.isfinite(J).all() and np.linalg.norm(J[0]) == pytest.approx(1e8, rel=1e-6)
