"""Adjustment timed against COLMAP's Ceres adjuster on the same networks: problem set-up plus solve, warm.

    python benchmarks/adjustment.py [--networks small|all] [--no-covariance] [--repeat N] [--cpu]

Both start from the same values, adjust the same 8 shared parameters of an `opencv` camera and must end at
the same cost. "default" is what a user of pycolmap gets; "best" is pycolmap tuned: DENSE_SCHUR or
SPARSE_SCHUR, whichever wins, function_tolerance 1e-6, start radius 1e8, 1 or 2 threads, whichever wins.
Only ratios within one run mean anything; run it on a machine that does nothing else. With --cpu everything
gets one thread and CPU time is compared, which other programs disturb less.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.camera import camera_from_values, project
from sfm.conventions import FloatArray, rotation_from_vector
from sfm.network import Estimate, ImagePoints, Network

NOISE_PX = 0.1
SIZE_PX = (2000, 1500)
SLOW_S = 20.0  # a run that takes longer is not repeated


@dataclass(frozen=True)
class Case:
    """A network to time."""

    name: str
    images: int
    points: int
    visibility: float
    large: bool = False


CASES = (
    Case("convergent 20 / 100", 20, 100, 0.75),
    Case("convergent 60 / 500", 60, 500, 0.73),
    Case("convergent 100 / 1000", 100, 1000, 0.75),
    Case("convergent 200 / 2000", 200, 2000, 0.75, large=True),
    Case("convergent 400 / 5000", 400, 5000, 0.26, large=True),
)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--networks", choices=("small", "all"), default="small")
    parser.add_argument("--no-covariance", action="store_true")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--cpu", action="store_true")
    options = parser.parse_args()
    clock = time.process_time if options.cpu else time.perf_counter
    threads = (1,) if options.cpu else (1, 2)
    if options.cpu:
        threadpool_limits(1)
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores (times mean nothing above 0.5)")
    print(f"{'network':24}{'image points':>13}{'default':>10}{'best':>10}{'adjust':>10}{'faster':>8}", end="")
    print(f"{'best+cov':>11}{'adjust+cov':>11}{'faster':>8}{'cost ratio - 1':>16}")
    for case in CASES:
        if case.large and options.networks == "small":
            continue
        line = row(
            case,
            repeat=options.repeat,
            with_covariance=not options.no_covariance,
            clock=clock,
            threads=threads,
        )
        print(line, flush=True)


def row(
    case: Case,
    *,
    repeat: int,
    with_covariance: bool,
    clock: Callable[[], float],
    threads: tuple[int, ...],
) -> str:
    """Return one line of the table."""
    network, start = convergent(case)
    ours, a = timed(lambda: run_adjust(network, start, covariance=False), repeat, clock)
    default, _ = timed(lambda: run_ceres(network, start, tuned=None), 1, clock)
    best, cost, how = np.inf, np.inf, ("", 0)
    for solver in ("DENSE_SCHUR", "SPARSE_SCHUR"):
        for count in threads:
            seconds, (reached, _) = timed(
                lambda s=solver, t=count: run_ceres(network, start, tuned=(s, t)),  # type: ignore[misc]
                repeat,
                clock,
            )
            if seconds < best:
                best, cost, how = seconds, reached, (solver, count)
    line = f"{case.name:24}{len(network.image_points):13d}{ms(default)}{ms(best)}{ms(ours)}{best / ours:8.1f}"
    if with_covariance:
        full, _ = timed(lambda: run_adjust(network, start, covariance=True), repeat, clock)
        other, _ = timed(lambda: run_ceres(network, start, tuned=how, covariance=True), 1, clock)
        line += f"{ms(other, 11)}{ms(full, 11)}{other / full:8.1f}"
    else:
        line += " " * 30
    return line + f"{a / cost - 1:16.1e}"


def ms(seconds: float, width: int = 10) -> str:
    """Format seconds as ms or s."""
    text = f"{seconds * 1e3:.1f} ms" if seconds < 1 else f"{seconds:.2f} s"
    return f"{text:>{width}}"


def timed(run: Callable[[], Any], repeat: int, clock: Callable[[], float]) -> tuple[float, Any]:
    """Return the shortest of some runs after a warm one, and its result."""
    started = clock()
    result = run()
    first = clock() - started
    times = [first] if first > SLOW_S else []
    while len(times) < (1 if first > SLOW_S else repeat):
        started = clock()
        result = run()
        times.append(clock() - started)
    return min(times), result


def run_adjust(network: Network, start: Estimate, *, covariance: bool) -> float:
    """Adjust and return half the sum of squares in px^2."""
    a = adjust(
        network, start, datum=Datum("free"), reject="none", method="gauss-newton", covariance=covariance
    )
    return float((a.residuals**2).sum() / 2)


def run_ceres(
    network: Network, start: Estimate, *, tuned: tuple[str, int] | None, covariance: bool = False
) -> tuple[float, object]:
    """Adjust with pycolmap and return the cost in px^2, and the covariance if asked for."""
    import pycolmap
    import pycolmap.pyceres

    scene = reconstruction(network, start)
    config = pycolmap.BundleAdjustmentConfig()
    for i in range(len(network.images)):
        config.add_image(i + 1)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    options.print_summary = False
    if tuned is not None:
        solver, threads = tuned
        options.ceres.auto_select_solver_type = False
        ceres = options.ceres.solver_options
        ceres.linear_solver_type = getattr(pycolmap.pyceres.LinearSolverType, solver)
        ceres.function_tolerance = 1e-6
        ceres.initial_trust_region_radius = 1e8
        ceres.num_threads = threads
        options.ceres.min_num_residuals_for_cpu_multi_threading = 0 if threads > 1 else 10**9
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, scene)
    summary: Any = adjuster.solve()
    cost = float(summary.ceres_summary.final_cost)
    if not covariance:
        return cost, None
    return cost, pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), scene, adjuster)


def reconstruction(network: Network, start: Estimate) -> Any:
    """Build pycolmap's scene; half a pixel makes no difference to the time and is left out."""
    import pycolmap

    scene = pycolmap.Reconstruction()
    scene.add_camera_with_trivial_rig(
        pycolmap.Camera(
            model="OPENCV",
            width=SIZE_PX[0],
            height=SIZE_PX[1],
            params=start.cameras[0].parameters,
            camera_id=1,
        )
    )
    k = network.image_points
    axes = np.diag([1.0, -1.0, -1.0])
    tracks: list[list[tuple[int, int]]] = [[] for _ in network.points]
    for i, name in enumerate(network.images):
        own = np.flatnonzero(k.image == i)
        R = axes @ start.rotation[i].T
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(R), -R @ start.position[i])
        scene.add_image_with_trivial_frame(
            pycolmap.Image(name=name, keypoints=k.xy[own], camera_id=1, image_id=i + 1), pose
        )
        for place, j in enumerate(k.point[own]):
            tracks[j].append((i + 1, place))
    for j, track in enumerate(tracks):
        elements = [pycolmap.TrackElement(i, place) for i, place in track]
        scene.add_point3D(start.points[j], pycolmap.Track(elements))
    return scene


def convergent(case: Case) -> tuple[Network, Estimate]:
    """Return a convergent network and start values a few per cent off."""
    rng = np.random.default_rng(case.images)
    camera = camera_from_values(
        "A",
        "opencv",
        SIZE_PX,
        (0.005, 0.005),
        c_mm=10.0,
        free=("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
        values=(("k1", -0.08), ("k2", 0.04), ("p1", 3e-4), ("p2", -2e-4)),
    )
    X = rng.uniform(-0.7, 0.7, (case.points, 3))
    azimuth, elevation = rng.uniform(0, 2 * np.pi, case.images), rng.uniform(-1.1, 1.1, case.images)
    z = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    roll = np.zeros((case.images, 3))
    roll[:, 2] = rng.uniform(0, 2 * np.pi, case.images)
    rotation = np.stack([x, np.cross(z, x), z], axis=2) @ rotation_from_vector(roll)
    position = z * rng.uniform(3.6, 4.4, (case.images, 1))
    image, point, xy = [], [], []
    for i in range(case.images):
        j = np.flatnonzero(rng.random(case.points) < case.visibility)
        seen = project(camera, position[i], rotation[i], X[j])
        inside = ((seen > 0) & (seen < np.array(SIZE_PX) - 1)).all(axis=1)
        image.append(np.full(inside.sum(), i))
        point.append(j[inside])
        xy.append(seen[inside] + NOISE_PX * rng.standard_normal((inside.sum(), 2)))
    measured = np.concatenate(xy)
    network = Network(
        tuple(f"{i}" for i in range(case.images)),
        np.zeros(case.images, dtype=np.int64),
        tuple(f"{j}" for j in range(case.points)),
        ImagePoints(
            np.concatenate(image), np.concatenate(point), measured, np.tile(np.eye(2), (len(measured), 1, 1))
        ),
    )
    return network, spoiled(Estimate((camera,), position, rotation, X), rng)


def spoiled(truth: Estimate, rng: np.random.Generator) -> Estimate:
    """Return start values: positions and points off by 1 cm at 4 m, 0.3 deg, c by 0.5 %, no distortion."""
    camera = truth.cameras[0]

    def noise(shape: tuple[int, ...], size: float) -> FloatArray:
        return size * rng.standard_normal(shape)

    factors = np.array([1.005, 1.005, 1, 1, 0, 0, 0, 0])
    return Estimate(
        (camera.with_parameters(camera.parameters * factors),),
        truth.position + noise(truth.position.shape, 0.01),
        truth.rotation @ rotation_from_vector(noise(truth.position.shape, 0.005)),
        truth.points + noise(truth.points.shape, 0.01),
    )


if __name__ == "__main__":
    main()
