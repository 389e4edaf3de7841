"""Compares the uncertainty of projection of a camera calibrated by a board with mrcal's.

    python -m benchmarks.projection --mrcal PYTHON [--seeds 5]

A camera of 1600 x 1200 px photographs a board with 10 x 7 corners, 40 mm apart, from 24 directions; the noise
is 0.1 px. Both programs adjust the same corners in the same model (opencv, 8 parameters; the board is held),
and state the standard deviations of the projection of points at 0.5 m, 1 m and at infinity over a grid of
9 x 7 pixels, for a noise of 0.1 px. PYTHON is an interpreter with mrcal installed.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.stereo import OPTIMIZE, board_corners, calibrated, seen_from
from sfm.model.camera import Camera, project
from sfm.model.conventions import FloatArray, rotation_from_vector
from sfm.model.distortion.models import MODELS
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network
from sfm.products.calibration import projection_uncertainty

PHOTOGRAPHS, NOISE_PX, PITCH, ROWS, COLUMNS = 24, 0.1, 40.0, 7, 10
SIZE = (1600, 1200)
VALUES = {
    "fx": 1300.0,
    "fy": 1302.0,
    "cx": 806.0,
    "cy": 594.0,
    "k1": -0.21,
    "k2": 0.07,
    "p1": 4e-4,
    "p2": -3e-4,
}
DISTANCES = (500.0, 1000.0, np.inf)  # mm

MRCAL = (
    OPTIMIZE
    + """
data = np.load(sys.argv[1])
rows, columns = data["xy"].shape[1:3]
inputs = dict(
    intrinsics=data["intrinsics"][None].copy(), rt_cam_ref=np.zeros((0, 6)),
    rt_ref_frame=data["rt_ref_frame"].copy(),
    observations_board=np.concatenate([data["xy"], np.ones((*data["xy"].shape[:-1], 1))], axis=-1),
    indices_frame_camintrinsics_camextrinsics=data["indices"], lensmodel="LENSMODEL_OPENCV4",
    imagersizes=data["size"][None].astype(np.int32), calibration_object_spacing=float(data["pitch"]),
    do_optimize_intrinsics_core=True, do_optimize_intrinsics_distortions=True, do_optimize_frames=True,
    do_optimize_extrinsics=True, do_optimize_calobject_warp=False, do_apply_outlier_rejection=False,
    do_apply_regularization=False, verbose=False)
optimize(inputs)
model = mrcal.cameramodel(optimization_inputs=inputs, icam_intrinsics=0)
directions = mrcal.unproject(data["pixels"], *model.intrinsics(), normalize=True)
covariance = [
    mrcal.projection_uncertainty(
        directions * (distance if np.isfinite(distance) else 1.0), model,
        atinfinity=not np.isfinite(distance), what="covariance",
        observed_pixel_uncertainty=float(data["noise_px"]))
    for distance in data["distances"]]
np.savez(sys.argv[2], covariance=np.array(covariance), intrinsics=inputs["intrinsics"][0])
"""
)


def scene(seed: int) -> tuple[Network, Estimate]:
    """Return a network with noisy corners, and the true values."""
    rng = np.random.default_rng(seed)
    board = board_corners(ROWS, COLUMNS, PITCH)
    names = MODELS["opencv"].names
    free = np.array([name in VALUES for name in names])
    camera = Camera(
        "camera", "opencv", SIZE, np.ones(2), np.array([VALUES.get(name, 0.0) for name in names]), free=free
    )
    position, rotation, corners = [], [], []
    while len(position) < PHOTOGRAPHS:
        R = rotation_from_vector(rng.normal(0.0, [0.4, 0.4, 0.3]))  # image axes to those of the board
        X = board.mean(axis=0) + R @ (np.array([0, 0, rng.uniform(500, 900)]) + rng.normal(0, 70, 3))
        xy = project(camera, X, R, board)
        if ((xy > 0) & (xy < np.array(SIZE) - 1)).all():
            position.append(X)
            rotation.append(R)
            corners.append(xy + NOISE_PX * rng.standard_normal(xy.shape))
    image = np.repeat(np.arange(PHOTOGRAPHS), len(board))
    measured = ImagePoints(
        image,
        np.tile(np.arange(len(board)), PHOTOGRAPHS),
        np.concatenate(corners),
        np.tile(NOISE_PX**2 * np.eye(2), (len(image), 1, 1)),
    )
    network = Network(
        tuple(f"photograph {t}" for t in range(PHOTOGRAPHS)),
        np.zeros(PHOTOGRAPHS, dtype=int),
        tuple(map(str, range(len(board)))),
        measured,
    ).with_control(tuple(map(str, range(len(board)))), board)
    return network, Estimate((camera,), np.array(position), np.array(rotation), board)


def with_mrcal(
    python: str, network: Network, start: Estimate, pixels: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the covariances of projections, px^2, (distances, k, 2, 2), and the interior parameters."""
    frames = [seen_from(R, X) for R, X in zip(start.rotation, start.position, strict=True)]
    with tempfile.TemporaryDirectory() as folder:
        given, answer = Path(folder) / "given.npz", Path(folder) / "answer.npz"
        np.savez(
            given,
            xy=network.image_points.xy.reshape(PHOTOGRAPHS, ROWS, COLUMNS, 2),
            intrinsics=start.cameras[0].parameters[:8],
            rt_ref_frame=np.array(frames),
            indices=np.array([[t, 0, -1] for t in range(PHOTOGRAPHS)], dtype=np.int32),
            size=np.array(SIZE),
            pitch=PITCH,
            pixels=pixels,
            distances=np.array(DISTANCES),
            noise_px=NOISE_PX,
        )
        subprocess.run([python, "-c", MRCAL, str(given), str(answer)], check=True)
        with np.load(answer) as read:
            return read["covariance"], read["intrinsics"]


def main() -> None:
    """Print the ratios of standard deviations, ours over mrcal's."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--mrcal", required=True, help="interpreter with mrcal")
    parser.add_argument("--seeds", type=int, default=5)
    options = parser.parse_args()
    x, y = np.linspace(0, SIZE[0] - 1, 9), np.linspace(0, SIZE[1] - 1, 7)
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    ratios = []
    for seed in range(options.seeds):
        network, truth = scene(seed)
        adjustment = calibrated(network, truth, NOISE_PX)
        known = projection_uncertainty(adjustment)
        known = replace(known, covariance=known.covariance / adjustment.sigma0**2)
        theirs, interior = with_mrcal(options.mrcal, network, truth, pixels)
        ours = np.array([known.covariance_at(pixels, distance) for distance in DISTANCES])
        ratios.append(np.sqrt(np.trace(ours, axis1=2, axis2=3) / np.trace(theirs, axis1=2, axis2=3)))
        moved = np.abs(interior - adjustment.estimate.cameras[0].parameters[:8]).max()
        print(f"seed {seed}: interior parameters differ by at most {moved:.1g}")
    for distance, ratio in zip(DISTANCES, np.stack(ratios, axis=1), strict=True):
        where = f"{distance / 1000:g} m" if np.isfinite(distance) else "infinity"
        print(f"{where:9} sigma over mrcal's {ratio.min():.4f} to {ratio.max():.4f}, mean {ratio.mean():.4f}")


if __name__ == "__main__":
    sys.exit(main())
