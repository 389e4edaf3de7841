"""Simulated photographs by a lens that no parametric model describes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sfm.model.conventions import FloatArray
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from tests.products.calibration.boards import CAMERA, SimulatedBoard, simulated_board

SIGMA_PX = 0.04


def waves(xy: FloatArray, finer: float = 1.0) -> FloatArray:
    """Shifts of image points by the lens, smooth and without symmetry, px, (k, 2); finer: shorter waves."""
    x, y = finer * xy.T
    across = 0.35 * np.sin(x / 110 + 1.0) * np.cos(y / 100)
    return np.column_stack([across, 0.3 * np.cos((x + y) / 130)])


def strange_board(rng: np.random.Generator, *, photographs: int, finer: float = 1.0) -> SimulatedBoard:
    """Photographs of a board in the left two thirds of the format; the lens has shifted its image points."""
    width = 400 * CAMERA.pixel_mm[0]  # that is cut off on the right
    p = CAMERA.parameters + width / 2 * (np.array(CAMERA.names) == "x0")
    part = replace(CAMERA, size_px=(800, 900), parameters=p)
    board = simulated_board(rng, photographs=photographs, camera=part, off=0.3, distance=(280.0, 500.0))
    seen = board.network.image_points
    covariance = np.tile(SIGMA_PX**2 * np.eye(2), (len(seen), 1, 1))
    seen = replace(seen, xy=seen.xy + waves(seen.xy, finer), covariance=covariance)
    return SimulatedBoard(replace(board.network, image_points=seen), replace(board.truth, cameras=(CAMERA,)))


def noisy(board: SimulatedBoard, rng: np.random.Generator) -> Network:
    """The network with errors of image points."""
    seen = board.network.image_points
    xy = seen.xy + SIGMA_PX * rng.standard_normal(seen.xy.shape)
    return replace(board.network, image_points=replace(seen, xy=xy))


def with_everything_free(truth: Estimate) -> Estimate:
    """The lens of the board without its waves, with all parameters of its model free."""
    (camera,) = truth.cameras
    return replace(truth, cameras=(replace(camera, free=np.ones(len(camera.names), dtype=bool)),))
