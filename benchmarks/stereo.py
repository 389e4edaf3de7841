"""Compares the scatter of the base of a stereo rig in repeated calibrations with its sigma, and with mrcal.

    python -m benchmarks.stereo [--draws 100] [--mrcal PYTHON]

Two cameras of 640 x 480 px, 100 mm apart, photograph a board with 9 x 6 corners, 30 mm apart, at 14 moments.
The noise is 0.03 px. Both programs start from the truth and adjust the same corners in the same model
(opencv, 8 parameters). PYTHON is an interpreter with mrcal installed.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.model.camera import Camera, project
from sfm.model.conventions import FloatArray, angles_from_rotation, rotation_from_vector
from sfm.model.distortion.models import MODELS
from sfm.model.estimate import Estimate, Mounts
from sfm.model.network import ImagePoints, Network
from sfm.report.rig_mounts import rigs_of

MOMENTS, NOISE_PX, PITCH = 14, 0.03, 30.0
ROWS, COLUMNS, BASE = 6, 9, 100.0
FLIP = np.diag([1.0, -1.0, -1.0])  # mrcal's camera axes in Kolinear's

# of mrcal 2.2 and later, which have other names of some arguments
OPTIMIZE = """
import json, sys
import numpy as np, mrcal
def optimize(inputs):
    if "rt_cam_ref" not in mrcal.optimize.__doc__:  # version 2.2
        inputs.update(
            extrinsics_rt_fromref=inputs.pop("rt_cam_ref"), frames_rt_toref=inputs.pop("rt_ref_frame"),
            points=np.zeros((0, 3)), observations_point=np.zeros((0, 3)),
            indices_point_camintrinsics_camextrinsics=np.zeros((0, 3), dtype=np.int32))
    return mrcal.optimize(**inputs)
"""
MRCAL = (
    OPTIMIZE
    + """
data = np.load(sys.argv[1])
found = []
for xy in data["xy"]:
    observations = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
    rt_cam_ref = data["rt_cam_ref"].copy()
    inputs = dict(
        intrinsics=data["intrinsics"].copy(), rt_cam_ref=rt_cam_ref,
        rt_ref_frame=data["rt_ref_frame"].copy(), observations_board=observations,
        indices_frame_camintrinsics_camextrinsics=data["indices"], lensmodel="LENSMODEL_OPENCV4",
        imagersizes=np.array([[640, 480]] * 2, dtype=np.int32),
        calibration_object_spacing=float(data["pitch"]),
        do_optimize_intrinsics_core=True, do_optimize_intrinsics_distortions=True, do_optimize_frames=True,
        do_optimize_extrinsics=True, do_optimize_calobject_warp=False, do_apply_outlier_rejection=False,
        do_apply_regularization=False, verbose=False)
    stats = optimize(inputs)
    found.append((rt_cam_ref[0].tolist(), float(stats["rms_reproj_error__pixels"])))
print(json.dumps(found))
"""
)


def cameras() -> tuple[Camera, ...]:
    """Return two cameras with the distortion of ordinary lenses and all eight parameters free."""
    free = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    values = {"fx": 533.5, "fy": 533.5, "k1": -0.288, "k2": 0.097, "p1": 0.001, "p2": -0.0003}
    made = []
    for name, cx, cy in (("left", 341.6, 235.2), ("right", 326.3, 250.1)):
        names = MODELS["opencv"].names
        parameters = np.array([(values | {"cx": cx, "cy": cy})[name] for name in names])
        on = np.array([name in free for name in names])
        made.append(Camera(name, "opencv", (640, 480), np.ones(2), parameters, free=on))
    return tuple(made)


def scene() -> tuple[Network, Estimate]:
    """Return the network with image points without noise, and the true values."""
    rng = np.random.default_rng(27)
    board = board_corners(ROWS, COLUMNS, PITCH)
    mounts = Mounts(
        np.array([[0.0, 0.0, 0.0], [BASE, -1.1, 0.0]]),
        np.array([np.eye(3), rotation_from_vector(np.array([-0.007, 0.0045, 0.0035]))]),
        np.array([[False] * 6, [True] * 6]),
        ("stereo", "stereo"),
    )
    made = cameras()
    position, rotation, rows = [], [], []
    while len(position) < 2 * MOMENTS:
        R = rotation_from_vector(rng.normal(0.0, [0.35, 0.35, 0.2]))  # image axes to those of the board
        X = board.mean(axis=0) + R @ (np.array([0, 0, rng.uniform(350, 550)]) + rng.normal(0, 40, 3))
        pair = [(X + R @ t, R @ Q) for t, Q in zip(mounts.position, mounts.rotation, strict=True)]
        seen = [project(made[a], *pose, board) for a, pose in enumerate(pair)]
        if all(((xy > 0) & (xy < [639, 479])).all() for xy in seen):
            rows += seen
            position += [pose[0] for pose in pair]
            rotation += [pose[1] for pose in pair]
    image = np.repeat(np.arange(2 * MOMENTS), len(board))
    k = ImagePoints(
        image,
        np.tile(np.arange(len(board)), 2 * MOMENTS),
        np.concatenate(rows),
        np.tile(NOISE_PX**2 * np.eye(2), (len(image), 1, 1)),
    )
    network = Network(
        tuple(f"{t} {name}" for t in range(MOMENTS) for name in ("left", "right")),
        np.tile([0, 1], MOMENTS),
        tuple(map(str, range(len(board)))),
        k,
        moment=np.repeat(np.arange(MOMENTS), 2),
    )
    network = network.with_control(network.points, board)
    return network, Estimate(made, np.array(position), np.array(rotation), board, mounts)


def noisy(network: Network, draws: int) -> list[FloatArray]:
    """Return the noisy image points of repeated surveys, (k, 2) each."""
    rng, xy = np.random.default_rng(5), network.image_points.xy
    return [xy + NOISE_PX * rng.standard_normal(xy.shape) for _ in range(draws)]


def board_corners(rows: int, columns: int, pitch: float) -> FloatArray:
    """Return the corners of a flat board by rows, (rows * columns, 3)."""
    grid = np.mgrid[0:rows, 0:columns].reshape(2, -1)
    return np.stack([pitch * grid[1], pitch * grid[0], np.zeros(rows * columns)], axis=1)


def calibrated(network: Network, start: Estimate, noise_px: float) -> Adjustment:
    """Return the adjustment of corners of a board that is held, with this noise."""
    return adjust(
        network,
        start,
        datum=Datum("control"),
        reject="none",
        options=AdjustmentOptions(sigma_px=noise_px),
    )


def seen_from(R: FloatArray, X: FloatArray) -> FloatArray:
    """Return mrcal's rotation vector and translation into a photograph with a rotation and position, (6,)."""
    turn = FLIP @ R.T
    return np.concatenate([vector_of(turn), -turn @ X])


def with_mrcal(python: str, truth: Estimate, drawn: list[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return the base of each draw from mrcal, mm, and the RMS residuals, px."""

    assert truth.mounts is not None
    # the flip applies to the axes of both cameras, but not to those of the board
    turn = FLIP @ truth.mounts.rotation[1].T @ FLIP
    right = np.concatenate([vector_of(turn), -turn @ FLIP @ truth.mounts.position[1]])
    frames = [seen_from(R, X) for R, X in zip(truth.rotation[::2], truth.position[::2], strict=True)]
    shape = (2 * MOMENTS, ROWS, COLUMNS, 2)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "draws.npz"
        np.savez(
            path,
            xy=np.array([xy.reshape(shape) for xy in drawn]),
            intrinsics=np.array([camera.parameters[:8] for camera in truth.cameras]),
            rt_cam_ref=right[None],
            rt_ref_frame=np.array(frames),
            indices=np.array([[t, a, a - 1] for t in range(MOMENTS) for a in (0, 1)], dtype=np.int32),
            pitch=PITCH,
        )
        said = subprocess.run([python, "-c", MRCAL, str(path)], capture_output=True, text=True, check=True)
    calibrated = json.loads(said.stdout.splitlines()[-1])
    return np.array([np.linalg.norm(rt[3:]) for rt, _ in calibrated]), np.array(
        [rms for _, rms in calibrated]
    )


def vector_of(R: FloatArray) -> FloatArray:
    """Return the rotation vector of a rotation by less than pi, (3,)."""
    import cv2

    return np.asarray(cv2.Rodrigues(R)[0][:, 0])


def main() -> None:
    """Print scatter, stated standard deviations and coverage of base and angles."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--mrcal", help="interpreter with mrcal")
    options = parser.parse_args()
    network, truth = scene()
    drawn = noisy(network, options.draws)
    assert truth.mounts is not None
    angles = np.degrees(angles_from_rotation(truth.mounts.rotation[1]))
    exact = np.array([np.linalg.norm(truth.mounts.position[1]), *angles])
    errors, sigmas, rms = [], [], []
    for xy in drawn:
        measured = replace(network, image_points=replace(network.image_points, xy=xy))
        a = calibrated(measured, truth, NOISE_PX)
        mount = rigs_of(a)[0].mounts[0]
        errors.append(np.array([mount.base, *mount.rotation_deg]) - exact)
        sigmas.append(np.array([mount.base_sigma, *mount.rotation_sigma_deg]))
        rms.append(a.rms_px)
    e, s = np.array(errors), np.array(sigmas)
    print(f"{options.draws} draws, residuals {np.mean(rms):.5f} px RMS per coordinate")
    for k, (name, unit) in enumerate((("base", "mm"), ("omega", "deg"), ("phi", "deg"), ("kappa", "deg"))):
        scatter, stated = np.sqrt((e[:, k] ** 2).mean()), np.sqrt((s[:, k] ** 2).mean())
        inside = (np.abs(e[:, k]) < 1.96 * s[:, k]).mean()
        print(
            f"{name:6} error {scatter:.5f} {unit} RMS, stated {stated:.5f}, stated over error "
            f"{stated / scatter:.3f} +- {stated / scatter / np.sqrt(2 * len(e)):.3f}, "
            f"within 95 %: {100 * inside:.0f} %"
        )
    if options.mrcal:
        base, residual = with_mrcal(options.mrcal, truth, drawn)
        difference = base - exact[0] - e[:, 0]
        print(
            f"mrcal  error {np.sqrt(((base - exact[0]) ** 2).mean()):.5f} mm RMS, residuals "
            f"{residual.mean():.5f} px RMS per coordinate, difference from ours at most "
            f"{np.abs(difference).max():.2g} mm"
        )


if __name__ == "__main__":
    sys.exit(main())
