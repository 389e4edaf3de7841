"""Published deformation analyses: a levelling network analysed by PANDA, and a wall with its cofactors."""

from __future__ import annotations

import numpy as np
import pytest

from sfm.comparison.stable_points import (
    StablePoints,
    candidates_of,
    critical_value,
    find_stable_points,
    in_datum,
    robust_weights,
    single_tests,
)
from sfm.model.conventions import FloatArray
from tests.places import ROOT
from tests.tables import rows_of

FOLDER = ROOT / "datasets/deformation"
NAMES = ("A2", "A3", "O1", "O2", "O3", "O4")
FREEDOM = 8


def levelling() -> tuple[FloatArray, FloatArray, float, list[float]]:
    """Return d (6, 1) mm, its cofactors, the pooled variance and sigma0 of both free adjustments."""
    rows = rows_of(FOLDER / "levelling.csv")
    A = np.zeros((len(rows), 6))
    for k, row in enumerate(rows):
        A[k, NAMES.index(row["from"])], A[k, NAMES.index(row["to"])] = -1.0, 1.0
    P = np.diag([1 / (1.5**2 * float(row["length_m"]) / 1000) for row in rows])
    Q = np.linalg.pinv(A.T @ P @ A)
    heights, squares = [], []
    for epoch in ("epoch1_m", "epoch2_m"):
        observed = 1000 * np.array([float(row[epoch]) for row in rows])
        heights.append(Q @ A.T @ P @ observed)
        v = A @ heights[-1] - observed
        squares.append(float(v @ P @ v))
    return (
        (heights[1] - heights[0])[:, None],
        2 * Q,
        sum(squares) / FREEDOM,
        [float(np.sqrt(square / 4)) for square in squares],
    )


def search(points: int = 6) -> tuple[StablePoints, FloatArray, FloatArray]:
    d, Q, variance, _ = levelling()
    among = candidates_of(d, variance * Q, np.ones((6, 1)), np.arange(6) < points)
    found = find_stable_points(among, least=3, redundancy=FREEDOM)
    return found, d, variance * Q


def test_epochs_of_the_levelling_network() -> None:
    d, _, variance, sigma0 = levelling()
    assert sigma0 == pytest.approx([1.031190, 1.282405], abs=1e-6)
    assert np.sqrt(variance) == pytest.approx(1.163597, abs=1e-6)
    assert d[:, 0] == pytest.approx([0.37649, 0.60391, 0.84115, 0.36865, -0.85293, -1.33727], abs=1e-5)


def test_stable_points_of_the_levelling_network() -> None:
    """Every removal is followed by the S-transformation to the points that are left."""
    found, _, _ = search()
    variance = levelling()[2]
    assert [step.omega * variance for step in found.steps] == pytest.approx(
        [180.2606, 67.3296, 5.9251], abs=1e-4
    )
    assert [step.freedom for step in found.steps] == [5, 4, 3]
    assert [step.statistic for step in found.steps] == pytest.approx([26.627, 12.432, 1.459], abs=1e-3)
    assert [step.critical for step in found.steps] == pytest.approx([3.687, 3.838, 4.066], abs=1e-3)
    assert [NAMES[step.removed] for step in found.steps if step.removed is not None] == ["O4", "O3"]
    assert [name for name, stable in zip(NAMES, found.stable, strict=True) if stable] == [
        "A2",
        "A3",
        "O1",
        "O2",
    ]


def test_displacements_of_the_levelling_network() -> None:
    found, d, Q = search()
    moved, covariance = in_datum(d, Q, np.ones((6, 1)), found.stable.astype(float))
    assert moved[4:, 0] == pytest.approx([-1.4005, -1.8848], abs=1e-4)
    assert single_tests(moved, covariance)[4:] == pytest.approx([32.63, 60.72], abs=0.01)
    assert critical_value(0.05, 1, FREEDOM) == pytest.approx(5.318, abs=1e-3)


def test_removal_is_the_s_transformation_to_the_points_that_are_left() -> None:
    """The update of one inverse against d_S' Q_S^+ d_S of the set that is left."""
    found, d, Q = search()
    left = np.ones(6, dtype=bool)
    for step in found.steps:
        moved, covariance = in_datum(d, Q, np.ones((6, 1)), left.astype(float))
        inner = covariance[np.ix_(left, left)]
        assert step.omega == pytest.approx(moved[left, 0] @ np.linalg.pinv(inner) @ moved[left, 0], rel=1e-9)
        if step.removed is not None:
            left[step.removed] = False


def test_the_robust_start_is_the_common_shift_of_most_points() -> None:
    d, _, _, _ = levelling()
    weight = robust_weights(d, np.ones((6, 1)), np.ones(6, dtype=bool))
    assert 0.3686 < float(weight @ d[:, 0] / weight.sum()) < 0.3766


def test_points_of_the_wall() -> None:
    """Both epochs in the frame of the same pillars: nothing is removed from the differences."""
    rows = np.loadtxt(FOLDER / "wall_points.csv", delimiter=",", skiprows=1)
    first, second = (np.loadtxt(FOLDER / f"wall_cofactors_{k}.csv", delimiter=",") for k in (1, 2))
    d = 1000 * (rows[:, 3:5] - rows[:, 1:3])
    T = single_tests(d, 1.08**2 * first + 1.01**2 * second)
    assert pytest.approx([1.1946, 0.7334, 0.1582, 0.6142, 0.8819], abs=1e-4) == 2 * T
    limit = 2 * critical_value(0.05, 2, 292)
    assert limit == pytest.approx(6.0534, abs=1e-4) and (limit > 2 * T).all()
