"""Leaner and wider camera models, decided by the photographs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import sfm
from sfm.adjustment.result import Adjustment
from sfm.products.calibration.models import compare_models
from tests.products.calibration.boards import CAMERA, simulated_board
from tests.synthetic import seed_of


def adjusted(free: tuple[str, ...], **values: float) -> Adjustment:
    true = dict(zip(CAMERA.names, CAMERA.parameters.tolist(), strict=True)) | {"P1": 3e-4} | values
    lens = CAMERA.with_parameters(np.array(list(true.values())))
    board = simulated_board(seed_of("models"), photographs=15, camera=lens)
    start = replace(lens, free=np.array([name in free for name in lens.names]))
    held = start.with_parameters(np.where(start.free | lens.plays(), lens.parameters, 0.0))
    network = board.noisy(seed_of("n"))
    return sfm.adjust(network, replace(board.truth, cameras=(held,)), datum="control", reject="none")


def test_the_true_model_is_borne() -> None:
    alternatives = compare_models(adjusted(("c", "x0", "y0", "K1", "K2", "P1", "P2")))
    by_name = {alternative.parameters: alternative for alternative in alternatives}
    assert by_name["K2",].borne and not by_name["K2",].added and by_name["P1", "P2"].borne
    assert by_name["K3",].added and not by_name["K3",].borne and not by_name["b1",].borne
    assert not any(alternative.contradicts for alternative in alternatives)


def test_a_missing_and_a_needless_parameter_are_named() -> None:
    lean = compare_models(adjusted(("c", "x0", "y0", "K1", "P1", "P2")))
    assert [a.parameters for a in lean if a.contradicts] == [("K2",)]
    wide = compare_models(adjusted(("c", "x0", "y0", "K1", "K2", "K3", "P1", "P2", "b1")))
    assert [a.parameters for a in wide if a.contradicts] == [("K3",), ("b1",)]


def test_a_held_camera_has_no_alternatives() -> None:
    assert compare_models(adjusted(())) == ()
