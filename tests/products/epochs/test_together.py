"""Epochs adjusted together: one camera for all of them, against one adjustment of all photographs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.covariance import marginal_of
from sfm.adjustment.solve import adjust
from sfm.comparison.stable_points import in_datum
from sfm.model.conventions import FloatArray
from sfm.model.distortion.models import Role
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, InteriorObservations, Network, ObjectPoints, ScaleBars
from sfm.products.epochs.differences import Differences, Epoch, epoch_differences
from sfm.products.epochs.displacements import find_displacements
from sfm.products.epochs.series import analyse_epochs
from sfm.products.epochs.together import adjust_together
from tests.products.epochs.scenes import BAR_SIGMA, POINTS, epoch, scene

EVERY = np.ones(POINTS)


def merged(epochs: tuple[Epoch, Epoch]) -> tuple[Network, Estimate]:
    """Return all photographs of two epochs as one network: points of their own, one camera.

    Each epoch has a minimal datum: six of its coordinates are held.
    """
    networks = [one.result.network for one in epochs]
    estimates = [one.result.estimate for one in epochs]
    m, n = len(networks[0].images), POINTS
    seen = [one.image_points for one in networks]
    control = []
    for k in range(2):
        for j, variances in ((0, (0.0, 0.0, 0.0)), (29, (np.inf, 0.0, 0.0)), (51, (np.inf, np.inf, 0.0))):
            control.append((n * k + j, estimates[k].points[j], np.diag(variances)))
    bars = [one.bars for one in epochs]
    network = Network(
        tuple(f"{k}/{name}" for k in range(2) for name in networks[k].images),
        np.zeros(2 * m, dtype=np.int64),
        tuple(f"{k}/{name}" for k in range(2) for name in networks[k].points),
        ImagePoints(
            np.concatenate([seen[k].image + m * k for k in range(2)]),
            np.concatenate([seen[k].point + n * k for k in range(2)]),
            np.vstack([one.xy for one in seen]),
            np.vstack([one.covariance for one in seen]),
        ),
        observations=(
            ObjectPoints(
                np.array([j for j, _, _ in control]),
                np.array([x for _, x, _ in control]),
                np.array([C for _, _, C in control]),
            ),
            ScaleBars(
                np.concatenate([bars[k].start + n * k for k in range(2)]),
                np.concatenate([bars[k].end + n * k for k in range(2)]),
                np.concatenate([one.length for one in bars]),
                np.concatenate([one.sigma for one in bars]),
            ),
        ),
    )
    estimate = Estimate(
        estimates[0].cameras,
        np.vstack([one.position for one in estimates]),
        np.vstack([one.rotation for one in estimates]),
        np.vstack([one.points for one in estimates]),
    )
    return network, estimate


def in_one_datum(found: Differences, d: FloatArray, Q: FloatArray) -> tuple[FloatArray, FloatArray]:
    return in_datum(d, Q, found.motions, EVERY)


def test_it_is_one_adjustment_of_all_photographs() -> None:
    """Differences and covariance of all points, in a datum that neither chooses."""
    given = epoch(80), epoch(81, given=1e-7)
    (first, second), (camera,) = adjust_together(given)
    assert camera.same and len(camera.parameters) == 8
    found = epoch_differences(first, second)
    d, Q = in_one_datum(found, found.difference, found.covariance)

    expected, covariance = adjusted_as_one(given, found)
    sigma = np.sqrt(np.diagonal(covariance).reshape(-1, 3))
    off = float(np.abs((d - expected) / sigma).max())
    assert off < 1e-3  # the condition is linear, and either epoch has its own sigma0
    assert np.abs(np.sqrt(np.diagonal(Q).reshape(-1, 3)) / sigma - 1).max() < 0.04
    alone = epoch_differences(*given)
    d_alone, Q_alone = in_one_datum(alone, alone.difference, alone.covariance)
    assert np.abs((d_alone - expected) / sigma).max() > 5 * off
    assert np.linalg.eigvalsh(Q_alone - Q)[0] > -1e-3 * np.diagonal(Q).mean()


def test_a_weighted_calibration_stays_one_observation() -> None:
    """Both epochs were given it; all photographs in one adjustment have it once."""
    lens = scene()[1].cameras[0]
    stated = lens.parameters[lens.plays(Role.FOCAL)] + 0.04
    given = epoch(86, calibration=stated), epoch(87, given=1e-7, calibration=stated)
    with pytest.raises(GeometryError, match=r"share the weighted fx of camera .*--together"):
        epoch_differences(*given)
    (first, second), _ = adjust_together(given)
    found = epoch_differences(first, second)
    assert [words for words in found.shared if words.startswith("fx of camera")]
    d, Q = in_one_datum(found, found.difference, found.covariance)

    expected, covariance = adjusted_as_one(given, found)
    sigma = np.sqrt(np.diagonal(covariance).reshape(-1, 3))
    assert np.abs((d - expected) / sigma).max() < 1e-3
    assert np.abs(np.sqrt(np.diagonal(Q).reshape(-1, 3)) / sigma - 1).max() < 0.04


def adjusted_as_one(given: tuple[Epoch, Epoch], found: Differences) -> tuple[FloatArray, FloatArray]:
    """Return differences and covariance of one adjustment of all photographs, in the datum of all points."""
    network, estimate = merged(given)
    lens = estimate.cameras[0]
    rows = given[0].interior
    network = network.with_given(
        InteriorObservations(
            np.zeros(len(rows), dtype=np.int64),
            np.array([lens.names.index(parameter) for _, parameter, _, _ in rows], dtype=np.int64),
            np.array([value for _, _, value, _ in rows]),
            np.array([sigma for _, _, _, sigma in rows]),
        )
    )
    a = adjust(network, estimate, datum="control", reject="none")
    assert a.converged
    joint = marginal_of(a).joint(np.zeros(0, dtype=np.int64), np.arange(2 * POINTS)) / a.sigma0**2
    x = a.estimate.points
    J = np.hstack([-np.eye(3 * POINTS), np.eye(3 * POINTS)])
    R, shift = second_in_first(x)
    J[:, 3 * POINTS :] = np.kron(np.eye(POINTS), R)
    return in_one_datum(found, x[POINTS:] @ R.T + shift - x[:POINTS], J @ joint @ J.T)


def second_in_first(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rotation and shift of the second half of the points onto the first."""
    a, b = x[:POINTS], x[POINTS:]
    U, _, V = np.linalg.svd((b - b.mean(axis=0)).T @ (a - a.mean(axis=0)))
    R = (U @ np.diag([1, 1, np.linalg.det(U @ V)]) @ V).T
    return R, a.mean(axis=0) - R @ b.mean(axis=0)


def statistics(pairs: int) -> list[float]:
    """Return T of all points of pairs of epochs that share their bars and their camera."""
    found = []
    for seed in range(5000, 5000 + pairs):
        errors = BAR_SIGMA * np.random.default_rng(seed).standard_normal(2)
        pair = epoch(2 * seed, bar_errors=errors), epoch(2 * seed + 1, bar_errors=errors)
        differences = epoch_differences(*adjust_together(pair)[0])
        assert differences.shared == ("bar 1 - 31", "bar 12 - 50")
        found.append(find_displacements(differences).congruency.first_test.statistic)
    return found


def test_bars_that_both_share_stay_one_observation() -> None:
    """The mean of T of n pairs, 174 degrees of freedom each: 1, sigma sqrt(2 / 174 / n)."""
    found = statistics(3)
    assert abs(np.mean(found) - 1) < 4 * np.sqrt(2 / 174 / len(found))


@pytest.mark.slow
def test_statistics_of_many_pairs() -> None:
    found = statistics(100)
    print(np.mean(found), np.sqrt(2 / 174 / len(found)))
    assert abs(np.mean(found) - 1) < 3.5 * np.sqrt(2 / 174 / len(found))


def test_a_camera_that_changed_is_refused() -> None:
    first, second = epoch(82), epoch(83, longer=4.0)
    with pytest.raises(GeometryError, match=r"is not the same: T .* f[xy] of epoch 82 and epoch 83 differs"):
        analyse_epochs((first, second), together=True)
    assert analyse_epochs((first, epoch(83)), together=True).cameras[0].same


def test_what_cannot_be_adjusted_together_is_one_line() -> None:
    first, second = epoch(84), epoch(85)
    camera = second.result.estimate.cameras[0]

    def with_camera(**changes: object) -> Epoch:
        estimate = replace(second.result.estimate, cameras=(replace(camera, **changes),))
        return replace(second, result=replace(second.result, estimate=estimate))

    with pytest.raises(GeometryError, match="no camera is in two of them"):
        adjust_together((first, with_camera(name="another")))
    with pytest.raises(GeometryError, match="has another model, size or other free parameters in epoch 85"):
        adjust_together((first, with_camera(free=np.zeros(len(camera.free), dtype=bool))))
    with pytest.raises(GeometryError, match=r"epoch 85: its summary\.json has no sigma0_px"):
        adjust_together((first, replace(second, sigma0_px=None)))
    heavier = replace(second, sigma0_px=10.0)
    with pytest.raises(GeometryError, match="epoch 85: adjusting its image points again leads"):
        adjust_together((first, heavier))
