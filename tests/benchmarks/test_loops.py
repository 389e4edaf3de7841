"""A walk around an object: errors grow along the loop, and what closes it takes them away."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.loops import Walked, walk, walked

PHOTOGRAPHS = 60


@pytest.fixture(scope="module")
def closed() -> Walked:
    return walked(*walk(PHOTOGRAPHS, 0))


@pytest.fixture(scope="module")
def unclosed() -> Walked:
    return walked(*walk(PHOTOGRAPHS, 0, closed=False))


def test_a_loop_closes_within_three_standard_deviations(closed: Walked) -> None:
    assert closed.oriented == PHOTOGRAPHS and not closed.result.failed
    assert closed.closure_sigmas < 3 and closed.mahalanobis < 1.3
    assert 0.5 < closed.centres / closed.predicted < 2


def test_where_nothing_closes_a_loop_its_ends_are_apart_as_predicted(
    closed: Walked, unclosed: Walked
) -> None:
    assert unclosed.oriented == PHOTOGRAPHS and unclosed.closure_sigmas < 3
    assert (unclosed.closure_sigma > 3 * closed.closure_sigma).any()
    assert np.linalg.norm(unclosed.closure) > 3 * np.linalg.norm(closed.closure_sigma)
