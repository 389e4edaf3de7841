"""Warming up works on problems that the stages solve, else it would compile half of the kernels."""

from __future__ import annotations

import numpy as np

from sfm import warm_up
from sfm.targets.detect import find_targets


def test_parts_run() -> None:
    for part in warm_up.PARTS:
        part()


def test_drawn_photograph_has_four_dots_and_one_code() -> None:
    for bright in (False, True):
        found = find_targets(warm_up._photograph(bright), polarity="auto", codes="ring14")
        assert len(found) == 4
        assert sorted(found.code)[:3] == [-1, -1, -1]
        assert (found.polarity == (1 if bright else -1)).all()
        np.testing.assert_allclose(sorted(found.xy[:, 0]), [60.3, 60.4, 180.1, 180.6], atol=0.1)
