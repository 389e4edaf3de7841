"""Displacements between epochs: false alarms and finds, tilted blocks, moved points of reference."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from sfm.comparison.stable_points import point_blocks
from sfm.model.conventions import FloatArray
from sfm.model.errors import GeometryError
from sfm.products.epochs.differences import epoch_differences
from sfm.products.epochs.displacements import Displacements, detectable_shift, find_displacements
from sfm.products.epochs.series import block_motion
from tests.products.epochs.scenes import BAR_SIGMA, POINTS, epoch, scene

MOVED = (4, 16, 21, 40, 57)


def compared(seed: int, shift: FloatArray | None = None, **options: object) -> Displacements:
    return find_displacements(epoch_differences(epoch(2 * seed), epoch(2 * seed + 1, shift)), **options)  # type: ignore[arg-type]


def shift_of(points: tuple[int, ...], sigmas: float, seed: int) -> FloatArray:
    """Return shifts as long as some standard deviations of a displacement, in any direction, (n, 3)."""
    rng = np.random.default_rng(seed)
    blocks = point_blocks(compared(0).covariance, 3)
    shift = np.zeros((POINTS, 3))
    for j in points:
        direction = rng.standard_normal(3)
        length = sigmas * np.sqrt(np.trace(blocks[j]))
        shift[j] = length * direction / np.linalg.norm(direction)
    return shift


def false_alarms(runs: int) -> tuple[int, int]:
    """Return how often the global test and all tests together say that something moved where nothing did."""
    found = [compared(seed) for seed in range(1000, 1000 + runs)]
    whole = sum(one.congruency.first_test.statistic > one.congruency.first_test.critical for one in found)
    return whole, sum(one.changed for one in found)


def finds(runs: int) -> tuple[int, int]:
    """Return in how many runs all five points that moved by 5 sigma are found, and how many others."""
    complete = others = 0
    for seed in range(2000, 2000 + runs):
        moved = set(np.flatnonzero(compared(seed, shift_of(MOVED, 5.0, seed)).moved).tolist())
        complete += moved >= set(MOVED)
        others += len(moved - set(MOVED))
    return complete, others


def test_nothing_is_found_where_nothing_moved() -> None:
    whole, alarms = false_alarms(6)
    assert whole <= 2 and alarms <= 2


def test_five_points_that_moved_are_found() -> None:
    assert finds(3) == (3, 0)


@pytest.mark.slow
def test_rates() -> None:
    """At 5 %, half of it for the global test: 10 of 400 expected, sigma 3.1; a point must be named, too."""
    whole, alarms = false_alarms(400)
    complete, others = finds(200)
    print(f"\n400 pairs without a change: global test {whole}, all tests {alarms}")
    print(f"200 pairs with 5 of 60 points moved by 5 sigma: all found in {complete}, {others} others named")
    assert 1 <= whole <= 19 and alarms <= 33
    assert complete >= 180 and others <= 0.05 * 200 * (POINTS - len(MOVED))


def test_a_point_of_reference_that_moved_is_found_and_the_datum_does_without_it() -> None:
    shift = shift_of((10,), 8.0, 1)
    reference = np.arange(POINTS) < 20
    found = compared(9, shift, reference=reference)
    assert found.moved.tolist() == [j == 10 for j in range(POINTS)] and not found.stable[10]
    step = found.congruency.first_test
    assert step.removed == 10 and step.statistic > step.critical
    T = (found.displacement[10] - shift[10]) @ np.linalg.solve(
        point_blocks(found.covariance, 3)[10], found.displacement[10] - shift[10]
    )
    assert T < 16.3  # chi-square with 3 degrees of freedom at 0.1 %


def test_points_that_are_no_reference_are_judged_in_its_datum() -> None:
    reference = np.arange(POINTS) < 30
    shift = np.zeros((POINTS, 3))
    shift[30:] = [0.01, -0.02, 0.005]  # more than half of all points
    found = compared(4, shift, reference=reference)
    assert found.moved.tolist() == (~reference).tolist() and found.stable.sum() == 30
    assert np.abs((found.displacement - shift) / found.sigma).max() < 5


def test_more_than_a_third_of_the_points_moved_together() -> None:
    shift = np.zeros((POINTS, 3))
    shift[:25] = [0.0, 0.0, 0.02]
    found = compared(5, shift)
    assert found.moved[:25].all() and found.moved[25:].sum() <= 1 and found.agreed


def test_a_tilted_block_is_reported_from_a_deformed_one() -> None:
    x = scene()[1].points
    block = np.arange(POINTS) < 15
    tilt = np.where(block[:, None], np.cross([0.0, 0.02, 0.0], x - x[block].mean(axis=0)), 0.0)
    found = compared(6, tilt)
    motion = block_motion(found, block, name="block")
    assert motion.fits and motion.moved
    translation, rotation = motion.parts
    assert rotation.significant and not translation.significant
    assert np.abs((motion.value[3:] - [0.0, 0.02, 0.0]) / motion.sigma[3:]).max() < 4
    stretched = np.where(block[:, None], 0.05 * (x - x[block].mean(axis=0)) * [1.0, 0.0, 0.0], 0.0)
    bent = block_motion(compared(7, stretched), block, name="block")
    assert not bent.fits
    affine = block_motion(compared(7, stretched), block, name="block", model="affine")
    assert affine.fits
    expected = {
        "scale": 0.05 / 3,
        "eXX-eYY": 0.05 / 3,
        "eXX-eZZ": 0.05 / 3,
        "eXY": 0.0,
        "eXZ": 0.0,
        "eYZ": 0.0,
    }
    for name, value in expected.items():
        k = affine.parameters.index(name)
        assert abs(affine.value[k] - value) < 4 * affine.sigma[k], name


def test_a_bar_that_both_epochs_share_makes_no_difference() -> None:
    """Its error is in both: the size of the object is known far better as a difference than in either."""
    errors = np.array([3.0, -2.0]) * BAR_SIGMA
    same = epoch_differences(epoch(50, bar_errors=errors), epoch(51, bar_errors=errors))
    own = epoch_differences(epoch(50), epoch(51, given=1e-7))
    assert same.shared == ("bar 1 - 31", "bar 12 - 50") and own.shared == ()
    stretch = (same.xyz - same.xyz.mean(axis=0)).ravel()
    stretch /= stretch @ stretch

    def sigma_of_scale(covariance: FloatArray) -> float:
        return float(np.sqrt(stretch @ covariance @ stretch))

    assert sigma_of_scale(same.covariance) < 0.5 * sigma_of_scale(own.covariance)
    scales = []
    for seed in range(60, 70):
        errors = BAR_SIGMA * np.random.default_rng(seed).standard_normal(2)
        one = epoch_differences(epoch(2 * seed, bar_errors=errors), epoch(2 * seed + 1, bar_errors=errors))
        scales.append(stretch @ one.difference.ravel())
    ratio = float(np.sqrt(np.mean(np.square(scales)))) / sigma_of_scale(same.covariance)
    assert 0.5 < ratio < 1.6  # chi-square with 10 degrees of freedom at 1 %


def test_the_stated_power_is_reached() -> None:
    """Shifts as large as stated, in the worst direction of a point that is judged by itself."""
    reference = np.arange(POINTS) != 25
    first = compared(8, reference=reference)
    values, vectors = np.linalg.eigh(point_blocks(first.covariance, 3)[25])
    shift = np.zeros((POINTS, 3))
    shift[25] = first.detectable[25] * vectors[:, -1]
    found = sum(bool(compared(seed, shift, reference=reference).moved[25]) for seed in range(3000, 3010))
    assert values[-1] > 0 and 5 <= found <= 10  # 8 expected, sigma 1.3


def test_noncentrality_is_that_of_baarda() -> None:
    """sqrt(17.075) for one coordinate at 0.1 % and 80 %, as his nomograms say."""
    assert detectable_shift(0.001, 0.8, 1, None) == pytest.approx(4.1321, abs=1e-3)
    assert detectable_shift(0.05, 0.8, 1, 20) > detectable_shift(0.05, 0.8, 1, None)


def test_a_sigma0_of_one_is_taken_as_given() -> None:
    """Without it, that of the solution is."""
    given = epoch(50)
    assert replace(given, sigma0=1.0).sigma0 == 1.0
    assert replace(given, sigma0=None).sigma0 == given.result.solution.sigma0 != 1.0


def test_a_bar_that_both_share_makes_no_difference_whatever_sigma0_is() -> None:
    """With all weights stated wrong alike, covariances and sigma0 are scaled, and so is what is left."""
    errors = np.array([3.0, -2.0]) * BAR_SIGMA
    first, second = epoch(50, bar_errors=errors), epoch(51, bar_errors=errors)
    Q = epoch_differences(first, second).covariance
    for sigma0 in (0.5, 2.0):
        scaled = [
            replace(
                one,
                sigma0=sigma0 * (one.sigma0 or 1.0),
                result=replace(one.result, covariance=sigma0**2 * np.asarray(one.result.covariance)),
            )
            for one in (first, second)
        ]
        assert (
            np.abs(epoch_differences(*scaled).covariance - sigma0**2 * Q).max() < 1e-9 * np.abs(Q).max()
        )  # rounding is not scaled


def test_results_that_keep_the_covariance_of_a_sample_share_bars_alike() -> None:
    errors = np.array([3.0, -2.0]) * BAR_SIGMA
    first, second = epoch(50, bar_errors=errors), epoch(51, bar_errors=errors)
    kept = np.array([0, 2, 5, 11, 20, 30, 33, 40, 49, 55])
    rows = (3 * kept[:, None] + np.arange(3)).ravel()
    sampled = [
        replace(
            one,
            result=replace(
                one.result,
                covariance=np.asarray(one.result.covariance)[np.ix_(rows, rows)],
                covariance_points=kept,
            ),
        )
        for one in (first, second)
    ]
    found, whole = epoch_differences(*sampled), epoch_differences(first, second)
    assert found.points == tuple(whole.points[j] for j in kept) and len(found.untested) == 50
    assert found.shared == whole.shared
    # the frame is over the common points of either, so that they differ by some 1e-4 of a turn
    assert (
        np.abs(found.covariance - whole.covariance[np.ix_(rows, rows)]).max()
        < 1e-3 * np.abs(whole.covariance).max()
    )


def test_points_of_reference_are_found_with_the_stated_power() -> None:
    """With few of them a point that moved pulls the datum along, so that more is needed to find it."""
    reference = np.isin(np.arange(POINTS), (5, 14, 22, 33, 41, 52))
    first = compared(8, reference=reference)
    weights = first.congruency.weights[5]
    shift = np.zeros((POINTS, 3))
    values, vectors = np.linalg.eigh(weights)
    shift[5] = first.detectable[5] * vectors[:, 0]
    assert first.stable[5] and values[0] > 0
    found = sum(bool(compared(seed, shift, reference=reference).moved[5]) for seed in range(4000, 4012))
    assert 6 <= found <= 12  # 9.6 expected, sigma 1.4


def test_a_reference_on_a_line_is_refused() -> None:
    found = epoch_differences(epoch(1), epoch(2))
    line = replace(found, xyz=np.where(np.arange(POINTS)[:, None] < 5, found.xyz * [1.0, 0, 0], found.xyz))
    with pytest.raises(GeometryError, match="lie on a line"):
        find_displacements(line, reference=np.arange(POINTS) < 5)


def test_bad_input_is_one_line() -> None:
    found = epoch_differences(epoch(1), epoch(2))
    with pytest.raises(GeometryError, match=r"3 points of reference, expected 4 or more"):
        find_displacements(found, reference=np.arange(POINTS) < 3)
    moved = find_displacements(found)
    with pytest.raises(GeometryError, match=r"group pier: 2 points, a rigid motion needs 3 or more"):
        block_motion(moved, np.arange(POINTS) < 2, name="pier")
    with pytest.raises(GeometryError, match="0 stable points outside it"):
        block_motion(moved, np.ones(POINTS, dtype=bool), name="all")
    with pytest.raises(GeometryError, match="expected one of rigid, similarity, affine"):
        block_motion(moved, np.arange(POINTS) < 9, name="pier", model="bent")


@pytest.mark.parametrize("m", [1, 3, 2000])
def test_a_shift_is_found_with_the_power_that_is_stated(m: int) -> None:
    """However many coordinates are tested together."""
    shift = detectable_shift(0.001, 0.8, m, None)
    assert stats.ncx2.sf(stats.chi2.isf(0.001, m), m, shift**2) == pytest.approx(0.8, abs=2e-3)
