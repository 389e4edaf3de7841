"""Simulated photographs of a board: networks with known truth for tests of calibration."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.model.camera import Camera, camera_from_values, project
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, rows_of

FREE = ("c", "x0", "y0", "K1", "K2", "P1", "P2")
LENS = (("x0", 0.05), ("y0", -0.03), ("K1", -2e-3), ("K2", 2e-5), ("P1", 5e-5))
CAMERA = camera_from_values("cam", "brown", (1200, 900), (0.005, 0.005), c_mm=6.0, free=FREE, values=LENS)
ROWS, COLUMNS, PITCH, SIGMA_PX = 7, 10, 30.0, 0.1


@dataclass(frozen=True)
class SimulatedBoard:
    """Photographs of a board without errors."""

    network: Network
    truth: Estimate

    def noisy(self, rng: np.random.Generator) -> Network:
        """Return the network with errors of image points."""
        seen = self.network.image_points
        xy = seen.xy + SIGMA_PX * rng.standard_normal(seen.xy.shape)
        return replace(self.network, image_points=replace(seen, xy=xy))


def board_points(bent: float = 0.0) -> FloatArray:
    """Return the crossings of a board about its middle, bent in x by a sagitta, mm, (n, 3)."""
    row, column = np.mgrid[0:ROWS, 0:COLUMNS].reshape(2, -1)
    x, y = (column - (COLUMNS - 1) / 2) * PITCH, ((ROWS - 1) / 2 - row) * PITCH
    return np.column_stack([x, y, bent * (1 - (x / np.abs(x).max()) ** 2)])


def facing(tilt: FloatArray, roll: float) -> FloatArray:
    """Return R of a camera that looks against Z, tilted about its x and y axes and rolled, rad, (3, 3)."""
    a, b = tilt
    ca, sa, cb, sb, ck, sk = np.cos(a), np.sin(a), np.cos(b), np.sin(b), np.cos(roll), np.sin(roll)
    x = np.array([[1, 0, 0], [0, ca, -sa], [0, sa, ca]])
    y = np.array([[cb, 0, sb], [0, 1, 0], [-sb, 0, cb]])
    z = np.array([[ck, -sk, 0], [sk, ck, 0], [0, 0, 1]])
    return np.asarray(x @ y @ z)


def board_network(
    image: list[IntArray], point: list[IntArray], xy: list[FloatArray], *, points: int
) -> Network:
    """Return the network of a board from the image points of each photograph, without control."""
    k = sum(map(len, point))
    return Network(
        tuple(f"photo{i:03}" for i in range(len(image))),
        np.zeros(len(image), dtype=np.int64),
        tuple(f"p{j}" for j in range(points)),
        ImagePoints(
            np.concatenate(image), np.concatenate(point), np.vstack(xy),
            np.tile(SIGMA_PX**2 * np.eye(2), (k, 1, 1)),
        ),
    )  # fmt: skip


def simulated_board(
    rng: np.random.Generator,
    *,
    photographs: int = 12,
    camera: Camera = CAMERA,
    fixed: bool = True,
    bent: float = 0.0,
    tilt_deg: float = 35.0,
    off: float = 0.35,
    distance: tuple[float, float] = (250.0, 500.0),
) -> SimulatedBoard:
    """Return photographs of a board, whose middle is off the middle of the format by a share of it."""
    points = board_points(bent)
    position, rotation, image, point, xy = [], [], [], [], []
    for i in range(photographs):
        while True:
            R = facing(np.radians(rng.uniform(-tilt_deg, tilt_deg, 2)), np.pi / 2 * rng.integers(4))
            d = rng.uniform(*distance)
            at = rng.uniform(-off, off, 2) * np.array(camera.size_px) / camera.c_px
            X0 = -R @ np.array([at[0] * d, at[1] * d, -d])
            pixels = project(camera, X0, R, points)
            inside = np.isfinite(pixels).all(axis=1)
            inside &= ((pixels >= 0) & (pixels <= np.array(camera.size_px) - 1)).all(axis=1)
            if inside.sum() >= 25:
                break
        position.append(X0)
        rotation.append(R)
        seen = np.flatnonzero(inside)
        image.append(np.full(len(seen), i))
        point.append(seen)
        xy.append(pixels[seen])
    network = board_network(image, point, xy, points=len(points))
    if fixed:
        network = network.with_control(network.points, board_points(), 0.0)
    truth = Estimate((camera,), np.array(position), np.array(rotation), points)
    return SimulatedBoard(network, truth)


def zoomed(board: SimulatedBoard) -> SimulatedBoard:
    """Return the photographs, the second half of which has a c that is 0.3 % larger."""
    seen, truth = board.network.image_points, board.truth
    xy, camera = seen.xy.copy(), truth.cameras[0]
    longer = camera.with_parameters(camera.parameters * (1 + 0.003 * (np.arange(len(camera.names)) == 0)))
    for i, rows in enumerate(rows_of(seen.image, len(board.network.images))):
        if i >= len(board.network.images) // 2:
            xy[rows] = project(longer, truth.position[i], truth.rotation[i], truth.points[seen.point[rows]])
    return replace(board, network=replace(board.network, image_points=replace(seen, xy=xy)))
