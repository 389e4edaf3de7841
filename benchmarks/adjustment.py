"""Times the adjustment against COLMAP's Ceres adjuster on the same networks: set-up plus solution, warm.

    python -m benchmarks.adjustment [--networks small|all|block] [--no-covariance] [--repeat N] [--cpu]
    python -m benchmarks.adjustment --growth [--photographs N] [--ceres] [--ceres-limit S] [--cpu]

Both adjusters start from the same values and adjust the same 8 shared parameters of an `opencv` camera.
"default" is pycolmap with its default settings. "best" is pycolmap tuned: the faster of DENSE_SCHUR and
SPARSE_SCHUR, function_tolerance 1e-6, start radius 1e8, and the faster of 1 and 2 threads.

Both adjusters stop at the same relative decrease of the cost, 1e-6 = (|A dx| / |v|)^2. The distance of each
cost from the optimum is printed; the optimum is an adjustment to the last digit. The network and pycolmap's
scene are built from arrays before the clock starts.

--growth adjusts blocks of 100 to 10,000 photographs and a dense convergent network of 1,000 x 1,000 without
the covariance, each adjuster in a separate process. The time limit of Ceres is wall time and includes
building its scene.

Only ratios within one run are meaningful; use an otherwise idle machine. With --cpu, both adjusters have one
thread and CPU time is compared, which other programs disturb less. Memory is the peak of a separate process
while it adjusts, including the network or scene.
"""

from __future__ import annotations

import argparse
import copy
import ctypes
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.networks import SIZE_PX, block, convergent
from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.model.estimate import Estimate
from sfm.model.network import Network

SLOW_S = 20.0  # longer runs are not repeated
COST_TOLERANCE = 1e-6  # relative decrease of the cost at which both adjusters stop
LAST_DIGIT = 1e-9  # |A dx| / |v| of the adjustment that defines the optimum
SOLVERS = ("DENSE_SCHUR", "SPARSE_SCHUR")


@dataclass(frozen=True)
class Case:
    """A network to time."""

    name: str
    group: str  # small | all | block
    made: Callable[[], tuple[Network, Estimate]]


CASES = (
    Case("convergent 20 / 100", "small", lambda: convergent(20, 100, 0.75)),
    Case("convergent 60 / 500", "small", lambda: convergent(60, 500, 0.73)),
    Case("convergent 100 / 1000", "small", lambda: convergent(100, 1000, 0.75)),
    Case("convergent 200 / 2000", "all", lambda: convergent(200, 2000, 0.75)),
    Case("convergent 400 / 5000", "all", lambda: convergent(400, 5000, 0.26)),
    Case("block 1000 / 99000", "block", lambda: block(25, 40)),
)
# number of strips and of photographs per strip, for the blocks of --growth
GROWTH = ((10, 10), (15, 20), (25, 40), (50, 60), (100, 100))
DENSE = 1000  # photographs and points of the dense network of --growth; three of four photographs see a point
MEMORY_BLOCK = (25, 40)  # strips and photographs per strip of the block whose peak memory is compared


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--networks", choices=("small", "all", "block"), default="small")
    parser.add_argument("--no-covariance", action="store_true")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--cpu", action="store_true")
    parser.add_argument("--growth", action="store_true", help="print how time and memory grow with a block")
    parser.add_argument("--photographs", type=int, default=1000, help="number in the largest block")
    parser.add_argument("--ceres", action="store_true", help="also run COLMAP's adjuster in --growth")
    parser.add_argument(
        "--ceres-limit", type=float, default=600.0, help="limit per network including building, s"
    )
    parser.add_argument(
        "--grown", choices=("adjust", "ceres"), help="run one network of --growth of a --size"
    )
    parser.add_argument("--size", default="10,10", help="strips,photographs per strip; or dense")
    parser.add_argument("--peak", choices=("adjust", "best"), help="print the peak memory for the block")
    options = parser.parse_args()
    clock = time.process_time if options.cpu else time.perf_counter
    if options.cpu:
        threadpool_limits(1)
    if options.peak:
        print(peak_of(options.peak))
        return
    if options.grown:
        threads = 1 if options.cpu else os.cpu_count() or 1
        print(grown_here(options.grown, options.size, options.repeat, clock, threads))
        return
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores (times mean nothing above 0.5)")
    if options.growth:
        growth(
            options.repeat,
            options.photographs,
            options.ceres_limit if options.ceres else 0.0,
            cpu=options.cpu,
        )
        return
    print(f"{'network':23}{'image points':>13}{'default':>10}{'best':>10}{'adjust':>10}{'faster':>7}", end="")
    print(f"{'best+cov':>10}{'adjust+cov':>11}{'faster':>7}{'cost - best':>13}{'best cost':>11}")
    groups = {"small": ("small",), "all": ("small", "all", "block"), "block": ("block",)}[options.networks]
    for case in CASES:
        if case.group in groups:
            threads = (1,) if options.cpu else (1, 2)
            print(row(case, options.repeat, not options.no_covariance, clock, threads), flush=True)
    if "block" in groups:
        ours, other = (peak_in_own_process(what) for what in ("adjust", "best"))
        print(
            f"peak memory, block: adjust {ours:.0f} MB, best {other:.0f} MB, {other / ours:.1f} times as much"
        )


def row(
    case: Case, repeat: int, with_covariance: bool, clock: Callable[[], float], threads: tuple[int, ...]
) -> str:
    """Return one line of the table."""
    network, start = case.made()
    scene = reconstruction(network, start)
    ours, reached = timed(lambda: run_adjust(network, start), repeat, clock)
    default, _ = timed_ceres(scene, None, 1, clock)
    runs = [
        (*timed_ceres(scene, (solver, count), repeat, clock), (solver, count))
        for solver in SOLVERS
        for count in threads
    ]
    best, ceres, how = min(runs, key=lambda run: run[0])
    optimum = run_adjust(network, start, tolerance=LAST_DIGIT)
    line = f"{case.name:23}{len(network.image_points):13d}{ms(default)}{ms(best)}{ms(ours)}{best / ours:7.1f}"
    if with_covariance:
        full, _ = timed(lambda: run_adjust(network, start, covariance=True), repeat, clock)
        other, _ = timed_ceres(scene, how, 1, clock, covariance=True)
        line += f"{ms(other)}{ms(full, 11)}{other / full:7.1f}"
    else:
        line += " " * 28
    return line + f"{reached / optimum - 1:13.0e}{ceres / optimum - 1:11.0e}"


def ms(seconds: float, width: int = 10) -> str:
    """Format seconds as ms or s."""
    text = f"{seconds * 1e3:.1f} ms" if seconds < 1 else f"{seconds:.2f} s"
    return f"{text:>{width}}"


def timed(run: Callable[[], Any], repeat: int, clock: Callable[[], float]) -> tuple[float, Any]:
    """Return the shortest time of several runs after a warm-up run, and the result."""
    times = []
    for _ in range(repeat + 1):
        started = clock()
        result = run()
        times.append(clock() - started)
        if times[-1] > SLOW_S:
            break
    return min(times), result


def timed_ceres(
    scene: Any,
    tuned: tuple[str, int] | None,
    repeat: int,
    clock: Callable[[], float],
    *,
    covariance: bool = False,
) -> tuple[float, float]:
    """Return the shortest time of pycolmap's adjustment of copies of a scene, and its cost in px^2."""
    times = []
    for _ in range(repeat + 1):
        copied = copy.deepcopy(scene)
        started = clock()
        cost = run_ceres(copied, tuned, covariance=covariance)
        times.append(clock() - started)
        if times[-1] > SLOW_S:
            break
    return min(times), cost


def run_adjust(
    network: Network, start: Estimate, *, covariance: bool = False, tolerance: float = COST_TOLERANCE**0.5
) -> float:
    """Adjust and return half the sum of squares in px^2."""
    a = adjust(
        network,
        start,
        datum=Datum("free"),
        reject="none",
        covariance=covariance,
        options=AdjustmentOptions(method="gauss-newton", tolerance=tolerance, redundancy_numbers=False),
    )
    return float((a.residuals**2).sum() / 2)


def run_ceres(scene: Any, tuned: tuple[str, int] | None, *, covariance: bool = False) -> float:
    """Adjust a scene with pycolmap in place, with the covariance if asked for; return the cost in px^2."""
    import pycolmap
    import pycolmap.pyceres

    config = pycolmap.BundleAdjustmentConfig()
    for i in range(scene.num_images()):
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
        ceres.function_tolerance = COST_TOLERANCE
        ceres.initial_trust_region_radius = 1e8
        ceres.num_threads = threads
        options.ceres.min_num_residuals_for_cpu_multi_threading = 0 if threads > 1 else 10**9
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, scene)
    summary: Any = adjuster.solve()
    if covariance:
        pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), scene, adjuster)
    return float(summary.ceres_summary.final_cost)


def reconstruction(network: Network, start: Estimate) -> Any:
    """Build pycolmap's scene, without the shift by half a pixel, which does not affect the time."""
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
    order = np.argsort(k.image, kind="stable")
    for i, rows in enumerate(
        np.split(order, np.cumsum(np.bincount(k.image, minlength=len(network.images)))[:-1])
    ):
        R = axes @ start.rotation[i].T
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(R), -R @ start.position[i])
        scene.add_image_with_trivial_frame(
            pycolmap.Image(name=network.images[i], keypoints=k.xy[rows], camera_id=1, image_id=i + 1), pose
        )
        for place, j in enumerate(k.point[rows]):
            tracks[j].append((i + 1, place))
    for j, track in enumerate(tracks):
        elements = [pycolmap.TrackElement(i, place) for i, place in track]
        scene.add_point3D(start.points[j], pycolmap.Track(elements))
    return scene


def growth(repeat: int, most: int, ceres_limit: float, *, cpu: bool) -> None:
    """Print how time and peak memory grow with the photographs of a block, and both for a dense network.

    Args:
        repeat: largest number of runs after a warm-up run; slow runs are not repeated.
        most: photographs of the largest network.
        ceres_limit: time after which COLMAP's adjuster is stopped, s; 0 to leave it out.
        cpu: whether to measure CPU time of one thread.
    """
    print(f"{'network':>20}{'image points':>14}{'adjust':>10}{'us/point':>10}{'peak':>9}{'grows':>8}", end="")
    print(f"{'Ceres':>12}{'peak':>9}{'faster':>8}" if ceres_limit else "")
    blocks = [(f"block {a * b}", a * b, f"{a},{b}") for a, b in GROWTH if a * b <= most]
    known: list[tuple[int, float]] = []
    for name, photographs, size in [*blocks, (f"{DENSE} x {DENSE}", DENSE, "dense")]:
        if photographs > most:
            continue
        points, seconds, mb = grown("adjust", size, repeat, cpu)
        line = f"{name:>20}{points:14.0f}{ms(seconds)}{seconds / points * 1e6:10.2f}{mb / 1e3:6.2f} GB"
        exponent = ""
        if size != "dense":
            if known:
                exponent = f"n^{np.log(seconds / known[-1][1]) / np.log(photographs / known[-1][0]):.2f}"
            known.append((photographs, seconds))
        line += f"{exponent:>8}"
        if ceres_limit:
            try:
                _, other, other_mb = grown("ceres", size, 1, cpu, ceres_limit)
                line += f"{ms(other, 12)}{other_mb / 1e3:6.2f} GB{other / seconds:8.1f}"
            except subprocess.TimeoutExpired:
                line += f"{'> ' + format(ceres_limit, '.0f') + ' s':>12}"
        print(line, flush=True)
    if len(known) > 1:
        exponent = np.log(known[-1][1] / known[0][1]) / np.log(known[-1][0] / known[0][0])
        print(f"time grows with the photographs of a block as n^{exponent:.2f}")


def grown(
    what: str, size: str, repeat: int, cpu: bool, limit: float | None = None
) -> tuple[float, float, float]:
    """Adjust a network in a separate process; return number of image points, time, s, peak memory, MB."""
    command = [
        sys.executable,
        "-m",
        "benchmarks.adjustment",
        "--grown",
        what,
        "--size",
        size,
        "--repeat",
        str(repeat),
    ]
    command += ["--cpu"] if cpu else []
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=limit)
    points, seconds, mb = (float(word) for word in done.stdout.split()[-3:])
    return points, seconds, mb


def grown_here(what: str, size: str, repeat: int, clock: Callable[[], float], threads: int) -> str:
    """Adjust a network in this process; return the line that `grown` reads: image points, s and MB."""
    if size == "dense":
        network, start = convergent(DENSE, DENSE, 0.75)
    else:
        strips, per_strip = (int(word) for word in size.split(","))
        network, start = block(strips, per_strip)
    points = len(network.image_points)
    if what == "ceres":
        scene = reconstruction(network, start)
        del network, start
        solver = "DENSE_SCHUR" if size == "dense" else "SPARSE_SCHUR"
        forget_peak()
        started = clock()
        run_ceres(scene, (solver, threads))
        return f"{points} {clock() - started} {peak_mb()}"
    run_adjust(*block(9, 8))  # kernels are there, as they are in any second adjustment
    forget_peak()
    seconds, _ = timed(lambda: run_adjust(network, start), repeat, clock)
    return f"{points} {seconds} {peak_mb()}"


def peak_of(what: str) -> float:
    """Adjust the block with one adjuster and return the peak memory of this process meanwhile, MB."""
    network, start = block(*MEMORY_BLOCK)
    if what == "adjust":
        run_adjust(*block(9, 8))  # kernels are there, as they are in any second adjustment
    else:
        scene = reconstruction(network, start)
        del network, start
    forget_peak()
    if what == "adjust":
        run_adjust(network, start)
    else:
        run_ceres(scene, ("SPARSE_SCHUR", 1))
    return peak_mb()


def forget_peak() -> None:
    """Return free memory to the system, and reset the peak memory of this process."""
    ctypes.CDLL("libc.so.6").malloc_trim(0)
    Path("/proc/self/clear_refs").write_text("5")


def peak_mb() -> float:
    """Return the peak memory of this process since `forget_peak`, MB."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1e3


def peak_in_own_process(what: str) -> float:
    """Return the peak memory that `peak_of` measures in a separate process, MB."""
    command = [sys.executable, "-m", "benchmarks.adjustment", "--peak", what]
    return float(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


if __name__ == "__main__":
    main()
