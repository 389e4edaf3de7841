"""Residuals over the format: significant where the model does not describe the lens, and only there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sfm
from sfm.model.conventions import FloatArray
from sfm.products.calibration.residual_field import ResidualField, residual_field
from tests.products.calibration.boards import CAMERA, simulated_board
from tests.synthetic import seed_of

LEVEL = 0.01


def field(number: int, *, lens: float = 0.0, bent: float = 0.0, step: float = 0.0) -> ResidualField:
    """Return the field of a simulated calibration with K3, a bent board, or a step on the sensor, px."""
    rng = seed_of(f"field {number}")
    K3 = np.arange(len(CAMERA.names)) == CAMERA.names.index("K3")
    board = simulated_board(
        rng, photographs=25, camera=CAMERA.with_parameters(CAMERA.parameters + lens * K3), bent=bent
    )
    network = board.noisy(rng)
    xy: FloatArray = network.image_points.xy.copy()
    right = (xy[:, 0] > 600) & (xy[:, 0] < 750) & (xy[:, 1] > 450) & (xy[:, 1] < 600)
    xy[right, 0] += step
    network = replace(network, image_points=replace(network.image_points, xy=xy))
    a = sfm.adjust(network, replace(board.truth, cameras=(CAMERA,)), datum="control", reject="none")
    return residual_field(a)


def test_noise_alone_is_not_significant() -> None:
    fields = [field(number) for number in range(20)]
    assert sum(one.whole < LEVEL for one in fields) <= 1
    assert sum(one.significant(LEVEL).any() for one in fields) <= 1
    assert max(one.rms_px for one in fields) < 0.02
    ratio = [float(((one.mean**2).mean(axis=1) / one.sigma**2).mean()) for one in fields]
    assert 0.6 < float(np.mean(ratio)) < 1.1  # the larger of two variances, so 1 at most


def test_a_lens_that_the_model_does_not_describe_is_significant() -> None:
    lens = field(1, lens=3e-5)
    assert lens.whole < 1e-6 and lens.significant(LEVEL).any() and lens.rms_px > 0.05


def test_a_bent_board_is_not_taken_for_the_lens() -> None:
    bent = field(1, bent=2.0)
    assert np.abs(bent.mean).max() > 0.3 and not bent.whole < LEVEL and not bent.significant(LEVEL).any()


@pytest.mark.parametrize("number", range(3))
def test_a_part_of_the_sensor_that_is_shifted_is_where_the_field_is(number: int) -> None:
    stepped = field(number, step=0.3)
    worst = stepped.centre[stepped.probability.argmin()]
    assert stepped.significant(LEVEL).any() and (600 < worst[0] < 750) and (450 < worst[1] < 600)
    assert stepped.mean[stepped.probability.argmin(), 0] < -0.1  # computed minus measured


def test_a_camera_with_few_photographs_has_no_field() -> None:
    board = simulated_board(seed_of("few"), photographs=3)
    a = sfm.adjust(board.noisy(seed_of("n")), board.truth, datum="control", reject="none")
    empty = residual_field(a)
    assert not len(empty.mean) and np.isnan(empty.whole) and empty.rms_px == 0
    assert not empty.significant(LEVEL).any()
