"""Plates that are better than is stated: their standard deviation is no measure of that of image points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sfm.adjustment.quality.consistency import consistency_of
from tests.survey.seen_plates import SIGMA_PX, Plates, about, plates_survey, run_plates
from tests.synthetic import seed_of

RUNS = 4


def test_a_plate_better_than_stated_costs_no_image_points(tmp_path: Path) -> None:
    """Before, in most runs: residuals of control were in the sigma0 that image points are tested by."""
    plates, rejected, doubtful, sigma = Plates.side_by_side(1), 0, 0, list[float]()
    survey = plates_survey(tmp_path, 1, ("plate_sigma = 0.02",))
    for k in range(RUNS):
        rng = seed_of(f"better than stated {k}")
        a = run_plates(survey, plates, about(plates, rng, 4, distance=170.0), rng).adjustment
        found = consistency_of(a)
        rejected += bool(a.rejected.any())
        doubtful += bool(found.doubtful or found.large)
        sigma.append(a.image_sigma0 * a.sigma0_px / a.sigma0)
        assert a.sigma0 < 0.97 * a.image_sigma0
    print(f"rejected in {rejected}, doubtful in {doubtful} of {RUNS}; {np.mean(sigma):.4f} px")
    assert rejected + doubtful <= 1
    assert np.mean(sigma) == pytest.approx(SIGMA_PX, rel=0.05)
