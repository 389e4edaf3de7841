"""Compares speed and reliability of the resections with OpenCV and COLMAP in the same run."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, TypeVar

import cv2
import numpy as np
import pycolmap

from sfm.model.conventions import FloatArray, rotation_from_vector
from sfm.orientation.resection.fischler_bolles import rays_from_tangents, resect_triples
from sfm.orientation.resection.ransac import resect_robust
from sfm.textbook.resection.zeng_wang import resect_triples_zeng_wang

TRIPLES = 10_000
RIGHT = 1e-6  # largest error of position and rotation of a correct solution
SIZE_PX, C_PX = (3000, 3000), 2000.0
POINTS, WRONG, SIGMA_PX, TOLERANCE_PX = 200, 0.3, 0.5, 2.0
SCENES = 100

T = TypeVar("T")


def main() -> None:
    """Print the comparison of triples, then of robust resections."""
    triples()
    robust()


def triples() -> None:
    """Compare compiled batches of three points with a loop of cv2.solveP3P."""
    uv, points, X0, R = random_triples(np.random.default_rng(1), TRIPLES)
    rays, vision = rays_from_tangents(uv), np.ascontiguousarray(uv * (1.0, -1.0))

    def opencv() -> list[Any]:
        K = np.eye(3)
        return [cv2.solveP3P(points[i], vision[i], K, None, cv2.SOLVEPNP_P3P) for i in range(TRIPLES)]

    ours, poses = best_time(lambda: resect_triples(rays, points), 20)
    zeng, zeng_poses = best_time(lambda: resect_triples_zeng_wang(rays, points), 20)
    theirs, found = best_time(opencv, 5)
    D = np.diag([1.0, -1.0, -1.0])
    missed = 0
    for i, (count, turns, shifts, *_) in enumerate(found):
        best = np.inf
        for k in range(count):
            Rc = cv2.Rodrigues(turns[k])[0]
            error = np.linalg.norm(-Rc.T @ shifts[k].ravel() - X0[i])
            best = min(best, max(error, np.abs((D @ Rc).T - R[i]).max()))
        missed += not best < RIGHT
    print(f"P3P on {TRIPLES} noise-free triples, depths 0.1 to 100")
    print(f"{'':<26} {'us/triple':>10} {'ratio':>7} {'not found':>10}")
    for name, seconds, miss in (
        ("cv2.solveP3P, loop", theirs, missed),
        ("Fischler-Bolles, batch", ours, misses(poses.position, poses.rotation, X0, R)),
        ("Zeng-Wang, batch", zeng, misses(zeng_poses.position, zeng_poses.rotation, X0, R)),
    ):
        print(f"{name:<26} {seconds / TRIPLES * 1e6:>10.3f} {theirs / seconds:>7.1f} {miss:>10}")


def robust() -> None:
    """Compare RANSAC and adjustment of many points with gross errors with COLMAP's."""
    rng = np.random.default_rng(2)
    scenes = [random_scene(rng) for _ in range(SCENES)]
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE",
        width=SIZE_PX[0],
        height=SIZE_PX[1],
        params=[C_PX, SIZE_PX[0] / 2, SIZE_PX[1] / 2],
        camera_id=1,
    )
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = TOLERANCE_PX
    half = np.array(SIZE_PX) / 2

    def ours() -> FloatArray:
        return np.array(
            [
                resect_robust(uv, points, tolerance=TOLERANCE_PX / C_PX, seed=k).position
                for k, (uv, points, _) in enumerate(scenes)
            ]
        )

    def theirs() -> FloatArray:
        out = []
        for uv, points, _ in scenes:
            xy = C_PX * uv * (1.0, -1.0) + half
            found = pycolmap.estimate_and_refine_absolute_pose(xy, points, camera, estimation_options=options)
            if found is None:
                out.append(np.full(3, np.nan))
                continue
            pose = found["cam_from_world"]
            out.append(-pose.rotation.matrix().T @ pose.translation)
        return np.array(out)

    truth = np.array([X0 for _, _, X0 in scenes])
    print(f"\nrobust, {POINTS} points, {WRONG:.0%} wrong, {SIGMA_PX} px noise, {SCENES} scenes")
    print(f"{'':<44} {'us/photograph':>14} {'ratio':>7} {'RMS of position':>16}")
    their_time, their_X0 = best_time(theirs, 3)
    our_time, our_X0 = best_time(ours, 3)
    for name, seconds, X0 in (
        ("pycolmap.estimate_and_refine_absolute_pose", their_time, their_X0),
        ("resect_robust", our_time, our_X0),
    ):
        rms = np.sqrt(np.mean(np.sum((X0 - truth) ** 2, axis=1)))
        print(f"{name:<44} {seconds / SCENES * 1e6:>14.0f} {their_time / seconds:>7.1f} {rms:>16.5f}")


def best_time(function: Callable[[], T], repeats: int) -> tuple[float, T]:
    """Return the shortest time of several calls after a warm-up call, s, and the last result."""
    result = function()
    best = np.inf
    for _ in range(repeats):
        start = time.perf_counter()
        result = function()
        best = min(best, time.perf_counter() - start)
    return best, result


def misses(position: FloatArray, rotation: FloatArray, X0: FloatArray, R: FloatArray) -> int:
    """Return the number of triples without a solution within RIGHT of the truth."""
    error = np.fmax(
        np.linalg.norm(position - X0[:, None], axis=2), np.abs(rotation - R[:, None]).max(axis=(2, 3))
    )
    return int(np.sum(~(np.nan_to_num(error, nan=np.inf).min(axis=1) < RIGHT)))


def random_triples(rng: np.random.Generator, k: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return random triples: tangents (k, 3, 2), points (k, 3, 3), positions (k, 3), rotations (k, 3, 3)."""
    uv = rng.uniform(-1, 1, (k, 3, 2))
    depth = np.exp(rng.uniform(np.log(0.1), np.log(100), (k, 3, 1)))
    R = rotation_from_vector(rng.standard_normal((k, 3)) * 2)
    X0 = rng.normal(size=(k, 3))
    points = X0[:, None] + np.einsum("kij,knj->kni", R, np.concatenate([uv, -np.ones((k, 3, 1))], 2) * depth)
    return uv, points, X0, R


def random_scene(rng: np.random.Generator) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return tangents (n, 2), points (n, 3) and position of a photograph with noise and gross errors."""
    R = rotation_from_vector(rng.standard_normal(3) * 2)
    X0 = rng.normal(size=3) * 5
    uv = rng.uniform(-0.6, 0.6, (POINTS, 2))
    depth = rng.uniform(4, 8, (POINTS, 1))
    points = X0 + (np.concatenate([uv, -np.ones((POINTS, 1))], axis=1) * depth) @ R.T
    uv = uv + SIGMA_PX / C_PX * rng.standard_normal(uv.shape)
    wrong = int(WRONG * POINTS)
    uv[:wrong] = rng.uniform(-0.6, 0.6, (wrong, 2))
    return uv, points, X0


if __name__ == "__main__":
    main()
