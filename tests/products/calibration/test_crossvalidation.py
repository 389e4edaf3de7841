"""Cross-validation: halves of the photographs differ by chance only if nothing else is wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sfm
from sfm.products.calibration.crossvalidation import cross_validate
from tests.products.calibration.boards import CAMERA, simulated_board, zoomed
from tests.synthetic import seed_of

SIMULATIONS, LENS_K3 = 20, 1e-5


def ratios(fixed: bool, simulations: int, change: str = "") -> dict[str, list[float]]:
    """Return difference over prediction of each division, in simulated calibrations with a model error."""
    found: dict[str, list[float]] = {}
    for number in range(simulations):
        rng = seed_of(f"halves {number}")
        lens = CAMERA
        if change == "lens":  # K3 is not adjusted
            K3 = CAMERA.names.index("K3")
            lens = CAMERA.with_parameters(CAMERA.parameters + LENS_K3 * (np.arange(len(CAMERA.names)) == K3))
        board = simulated_board(rng, photographs=16, camera=lens, fixed=fixed)
        if change == "zoom":
            board = zoomed(board)
        network = board.noisy(rng)
        start = replace(board.truth, cameras=(CAMERA,))
        a = sfm.adjust(network, start, datum="control" if fixed else "free", reject="none")
        validated = cross_validate(a)
        assert not validated.untested
        for halves in validated.differences:
            assert halves.photographs == (8, 8) and halves.camera == "cam" and halves.dof <= len(CAMERA.free)
            found.setdefault(halves.division, []).append(halves.ratio)
    return found


@pytest.mark.parametrize("fixed", [True, False], ids=["fixed board", "free board"])
def test_without_model_error_the_difference_is_as_predicted(fixed: bool) -> None:
    for division, of_division in ratios(fixed, SIMULATIONS).items():
        assert 0.8 < np.sqrt(np.square(of_division).mean()) < 1.25, (division, of_division)


@pytest.mark.parametrize("fixed", [True, False], ids=["fixed board", "free board"])
def test_a_lens_that_the_model_does_not_describe_is_seen(fixed: bool) -> None:
    found = ratios(fixed, 5, "lens")
    assert (np.max(list(found.values()), axis=0) > 2).all(), found


def test_a_camera_that_changed_is_seen_in_first_and_last() -> None:
    found = ratios(True, 5, "zoom")
    assert min(found["first and last photographs"]) > 2
    assert np.median(found["first and last photographs"]) > np.median(found["every other photograph"])


def test_few_photographs_have_no_halves() -> None:
    board = simulated_board(seed_of("few"), photographs=4)
    a = sfm.adjust(board.noisy(seed_of("n")), board.truth, datum="control", reject="none")
    validated = cross_validate(a)
    assert not validated.differences and len(validated.untested) == 4
    assert validated.untested[0][1] == "camera cam: half of its photographs are 2, needed 3"
    assert validated.clearest("cam") is None


def test_the_clearest_of_differences_beyond_all_chance_is_the_largest() -> None:
    board = simulated_board(seed_of("beyond"), photographs=8)
    a = sfm.adjust(board.noisy(seed_of("n")), board.truth, datum="control", reject="none")
    validated = cross_validate(a)
    beyond = tuple(
        replace(halves, probability=0.0, chi2=chi2)
        for halves, chi2 in zip(validated.differences, (2e3, 9e3, 4e3, 3e3), strict=True)
    )
    assert replace(validated, differences=beyond).clearest("cam") is beyond[1]
