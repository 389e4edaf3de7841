"""Helmert blocks on worker processes of this computer against the adjustment in one piece.

    python -m benchmarks.blocks --photographs 1000 3000 --workers 2 4

For each network: processor time, peak memory of every process, the interface, what a step sends, and the
largest difference of the results. Each adjustment runs in a process of its own, free, with covariance.
"""

from __future__ import annotations

import argparse
import pickle
import resource
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context

import numpy as np

from adapters.dask_cluster import local_engine
from benchmarks.networks import block
from sfm.adjustment.datum import Datum
from sfm.adjustment.engine.solvers.partition import partition_of
from sfm.adjustment.engine.unknowns import unknowns_of
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.model.conventions import FloatArray
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.runtime.executor import Blocking, in_blocks

SHAPES = {100: (10, 10), 300: (15, 20), 1000: (25, 40), 3000: (50, 60), 10000: (100, 100)}


@dataclass(frozen=True)
class Taken:
    """What an adjustment took, and its result."""

    iterations: int
    seconds: float  # processor time of the calling process
    gigabytes: float  # its peak
    workers: tuple[tuple[float, float], ...]  # the same of each worker
    points: FloatArray  # (n, 3)
    covariance: FloatArray  # (n, 3, 3)


def usage() -> tuple[float, float]:
    """Return the processor time of this process, s, and its peak memory, 10^9 bytes."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime, used.ru_maxrss * 1024 / 1e9


def adjusted(network: Network, start: Estimate) -> Taken:
    """Adjust in the blocks that are set, if any."""
    before, _ = usage()
    options = AdjustmentOptions(redundancy_numbers=False)
    a = adjust(network, start, datum=Datum("free"), reject="none", options=options)
    after, peak = usage()
    return Taken(a.iterations, after - before, peak, (), a.estimate.points, a.covariance.points)


def run(photographs: int, workers: int) -> Taken:
    """Adjust a block of photographs with so many workers, or in one piece with 0."""
    network, start = block(*SHAPES[photographs])
    if not workers:
        return adjusted(network, start)
    with local_engine(workers) as engine, in_blocks(Blocking(engine, workers)):
        before = engine.client.run(usage)
        taken = adjusted(network, start)
        after = engine.client.run(usage)
    of_workers = tuple((after[name][0] - before[name][0], after[name][1]) for name in before)
    return Taken(taken.iterations, taken.seconds, taken.gigabytes, of_workers, taken.points, taken.covariance)


def in_a_process(photographs: int, workers: int) -> Taken:
    """Run in a new process, whose peak memory is that of this run."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(run, photographs, workers).result()


def interface(photographs: int, blocks: int) -> str:
    """Return the unknowns of the interface, and what each block sends of them in a step."""
    network, start = block(*SHAPES[photographs])
    layout, state = unknowns_of(network, start, use_control=False)
    partition = partition_of(layout, blocks, np.zeros(0, dtype=np.int64))
    if partition is None:
        return "not cut"
    parts = [len(piece.at) * (len(piece.at) + 1) / 2 * 8 / 1e6 for piece in partition.pieces]
    values = sum(len(pickle.dumps(piece.state(state))) for piece in partition.pieces) / 1e6
    return (
        f"interface {len(partition.columns)} unknowns; a step sends {sum(parts):.1f} MB of it "
        f"({', '.join(f'{part:.1f}' for part in parts)}) and {values:.1f} MB of values"
    )


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--photographs", type=int, nargs="+", default=[1000], choices=sorted(SHAPES))
    parser.add_argument("--workers", type=int, nargs="+", default=[2, 4])
    given = parser.parse_args()
    for photographs in given.photographs:
        whole = in_a_process(photographs, 0)
        print(
            f"{photographs} photographs in one piece: {whole.iterations} iterations, {whole.seconds:.1f} s, "
            f"{whole.gigabytes:.2f} GB"
        )
        sigma = np.sqrt(np.diagonal(whole.covariance, axis1=1, axis2=2))
        for workers in given.workers:
            taken = in_a_process(photographs, workers)
            moved = np.abs(taken.points - whole.points) / sigma
            apart = np.abs(taken.covariance - whole.covariance) / (sigma[:, :, None] * sigma[:, None])
            each = ", ".join(f"{seconds:.1f} s {gigabytes:.2f} GB" for seconds, gigabytes in taken.workers)
            print(
                f"  {workers} workers: {taken.iterations} iterations, {taken.seconds:.1f} s, "
                f"{taken.gigabytes:.2f} GB; workers {each}"
            )
            print(f"    {interface(photographs, workers)}")
            print(
                f"    points {np.nanmax(moved):.1e} sigma apart, covariances {np.nanmax(apart):.1e}, half of "
                f"them {np.nanmedian(apart.max(axis=(1, 2))):.1e}",
                flush=True,
            )


if __name__ == "__main__":
    main()
