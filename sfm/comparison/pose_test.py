"""Differences of exterior orientations in two results of one coordinate system, and their test.

The six elements of a photograph are tested together: T = d' (Qa + Qb)^-1 d / 6 for the difference d. 6 T has
the chi-square distribution of six degrees of freedom if the variances are known, and T the F distribution if
they are estimated from a redundancy. An unknown covariance counts as 0. The measurements must be separate.

Source: Luhmann et al. (2020), Close-Range Photogrammetry and 3D Imaging, sec. 2.4.2; Foerstner and Wrobel
(2016), Photogrammetric Computer Vision, sec. 4.6.5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.comparison.stable_points import critical_value
from sfm.model.conventions import BoolArray, FloatArray, IntArray, angles_from_rotation
from sfm.model.solution import Solution

ELEMENTS = 6  # X0, Y0, Z0, omega, phi, kappa


@dataclass(frozen=True)
class PoseTest:
    """Differences b - a of X0, Y0, Z0 (object unit), omega, phi and kappa (rad), and their tests."""

    difference: FloatArray  # (m, 6)
    sigma: FloatArray  # NaN where a photograph is not tested, (m, 6)
    statistic: FloatArray  # T of each photograph, NaN where it is not tested, (m,)
    critical: float  # critical value of T for one photograph among all
    redundancy: int | None  # of the variances; None if they are known

    @property
    def significant(self) -> BoolArray:
        """Which photographs differ, (m,)."""
        return self.statistic > self.critical

    @property
    def sigmas(self) -> FloatArray:
        """Differences in their standard deviations, (m, 6)."""
        return self.difference / self.sigma


def has_pose_sigma(result: Solution) -> bool:
    """Return whether the covariance of any exterior orientation is known."""
    Q = result.exterior_covariance
    return Q is not None and bool(np.isfinite(Q).all(axis=(1, 2)).any())


def compare_poses(a: Solution, b: Solution, images: IntArray, alpha: float) -> PoseTest | None:
    """Return the differences and tests of common photographs; None if none can be tested.

    Args:
        a: first result.
        b: second result, in the same coordinate system.
        images: indices of the photographs in a and in b, (m, 2).
        alpha: level of all tests together.
    """
    known = [result for result in (a, b) if has_pose_sigma(result)]
    if not known or any(result.datum != "control" for result in known):
        return None
    elements = [
        np.column_stack(
            [
                result.estimate.position[rows],
                np.array([angles_from_rotation(R) for R in result.estimate.rotation[rows]]).reshape(-1, 3),
            ]
        )
        for result, rows in zip((a, b), images.T, strict=True)
    ]
    difference = elements[1] - elements[0]
    difference[:, 3:] = (difference[:, 3:] + np.pi) % (2 * np.pi) - np.pi
    blocks = np.array(
        [
            result.exterior_covariance[images[:, k]]
            for k, result in enumerate((a, b))
            if result.exterior_covariance is not None and has_pose_sigma(result)
        ]
    )
    finite = np.isfinite(blocks).all(axis=(2, 3), keepdims=True)  # of one result it may be unknown
    total = np.where(finite, blocks, 0.0).sum(axis=0)
    Q = np.where(finite.any(axis=0), total, np.nan)
    sigma = np.sqrt(np.einsum("kii->ki", Q))  # NaN where it is unknown
    # of correlations, as the elements have several units
    correlation = Q / np.einsum("ki,kj->kij", sigma, sigma)
    testable = np.isfinite(correlation).all(axis=(1, 2))
    rank = np.linalg.matrix_rank(np.nan_to_num(correlation), hermitian=True)
    testable &= np.asarray(rank) == ELEMENTS
    if not testable.any():
        return None
    statistic = np.full(len(images), np.nan)
    d = (difference / sigma)[testable]
    statistic[testable] = np.einsum(
        "ki,ki->k", d, np.linalg.solve(correlation[testable], d[..., None])[..., 0]
    )
    redundancies = [result.redundancy for result in known if result.redundancy is not None]
    redundancy = min(redundancies) if redundancies else None  # each result has a sigma0 of its own
    critical = critical_value(alpha / int(testable.sum()), ELEMENTS, redundancy)
    return PoseTest(difference, sigma, statistic / ELEMENTS, critical, redundancy)
