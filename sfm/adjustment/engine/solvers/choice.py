"""Chooses the solver of the normal equations that takes the least work.

The reduced normal matrix has a nonzero block for each pair of photographs that share a point. In an aerial
block each photograph shares points with its neighbours only. There nested dissection eliminates photographs
with little fill, in fronts. A full matrix is summed as a product of full rows if most photographs see most
points, otherwise pair by pair of rays. The choice counts operations among the solvers that fit in memory.

Source: George and Liu (1981), Computer Solution of Large Sparse Positive Definite Systems, ch. 8;
operations: Golub and Van Loan (2013), sec. 4.2.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix

from sfm.adjustment.engine.collinearity import Observations
from sfm.adjustment.engine.observed import ObservedKind, coupled_poses
from sfm.adjustment.engine.solvers import protocol
from sfm.adjustment.engine.solvers.dense import DenseSolver
from sfm.adjustment.engine.solvers.fronts import BYTES, fronts_of, pairs_of
from sfm.adjustment.engine.solvers.helmert import HelmertSolver
from sfm.adjustment.engine.solvers.multifrontal import MultifrontalSolver
from sfm.adjustment.engine.solvers.partition import partition_of
from sfm.adjustment.engine.solvers.protocol import Solver
from sfm.adjustment.engine.unknowns import Unknowns
from sfm.model.conventions import AnyArray, IntArray
from sfm.model.display import counted
from sfm.model.network import Network
from sfm.runtime.compiling import compiled
from sfm.runtime.executor import current_blocking

# Operations per second, one thread, AVX-512 (OpenBLAS 0.3.30); only their ratios matter
PRODUCT_RATE = 80e9  # symmetric product of full rows, mostly in single precision
FACTOR_RATE = 25e9  # Cholesky factor of a full matrix, which uses one thread where the sums use two
FRONT_RATE = 20e9  # Cholesky factors of many smaller matrices, which are added to one another
PAIR_RATE = 25e9  # product of two rays of a point, compiled
PAIR_OPERATIONS = 216  # operations of a 6 x 6 x 3 product
# An iteration in one process takes 0.6 to 1 microsecond per image point (646,000 to 7 million), and its
# messages to two workers on one computer 0.25 to 0.5 s.
IMAGE_POINT_SECONDS, MESSAGES_SECONDS = 0.8e-6, 0.25
SMALL = 64  # number of photographs up to which the product of full rows is always cheap enough
SAMPLED = 2  # pairs of rays for each pair of photographs in the sample that shows whether most share points
TRIED_PAIRS = 1000  # sampled pairs of photographs; a share of 0.5 then has the standard deviation 0.016
MOSTLY = 0.5  # share of pairs of photographs with a common point above which fronts save nothing


def choose_solver(layout: Unknowns) -> Solver:
    """Return the solver that takes the least work for a network.

    The choices are fronts, or a full matrix summed pair by pair of rays or as a product of full rows.

    Args:
        layout: order of the unknowns and the image points.
    """
    observations = layout.observations
    m = observations.poses
    if m <= SMALL:
        return DenseSolver(layout)
    rays = np.diff(observations.start).astype(float)
    pairs = float((rays * (rays + 1) / 2).sum())
    summed = PAIR_OPERATIONS * pairs / PAIR_RATE
    product = 3.0 * len(rays) * layout.reduced**2 / PRODUCT_RATE
    full = min(summed, product) + layout.reduced**3 / 3.0 / FACTOR_RATE

    fits = DenseSolver(layout).bytes <= protocol.available_bytes()

    def dense() -> DenseSolver:
        return DenseSolver(layout, pairs_of(observations) if summed < product else None)

    if summed > full and fits:
        return dense()
    joined = np.zeros((m, m), dtype=np.uint8)
    step = max(1, int(2 * pairs / (SAMPLED * m**2)))
    _join(observations, np.arange(0, len(rays), step), joined)
    if joined.mean() > MOSTLY:
        return dense()
    if step > 1:
        _join(observations, np.arange(len(rays)), joined)
    fronts = fronts_of(observations, csr_matrix(joined))
    if summed + fronts.operations / FRONT_RATE > full and fits:
        return dense()
    return MultifrontalSolver(layout, fronts)


def blocks_of(layout: Unknowns, observed: tuple[ObservedKind, ...]) -> HelmertSolver | None:
    """Return the solver in blocks where blocks are wanted and the network has them; None otherwise.

    Args:
        layout: order of the unknowns and the image points.
        observed: observations other than image points.
    """
    blocking = current_blocking()
    if blocking is None:
        return None
    count, k, partition = blocking.blocks or blocking.keeper.workers, len(layout.order), None
    if count < 2:
        how = "here, since one block is the whole network"
    elif blocking.blocks is None and k * IMAGE_POINT_SECONDS * (1 - 1 / count) < MESSAGES_SECONDS:
        how = "here, since its steps take less time than the messages of blocks"
    else:
        partition = partition_of(layout, count, coupled_poses(observed, layout))
        how = "here, since it has no small separator"
        if partition is not None:
            how = f"in {len(partition.pieces)} Helmert blocks"
    photographs = counted(len(layout.observations.pose_of), "photograph")
    blocking.largest.note(k, f"the network of {photographs} is adjusted {how}")
    return None if partition is None else HelmertSolver(layout, observed, partition, blocking.keeper)


def refuse_too_large(network: Network) -> None:
    """Refuse a network that no solver could adjust, before hours are spent on its orientation.

    Args:
        network: the network; a sample of pairs shows whether most of its photographs share points.

    Raises:
        GeometryError: most photographs share points, and their normal equations do not fit in memory.
    """
    m = len(network.images)
    size = 3 * BYTES * (6.0 * m) ** 2  # factor, its inverse, their product
    if size <= protocol.available_bytes():
        return
    sees = network.incidence(np.ones(len(network.image_points), dtype=bool))
    step = np.arange(TRIED_PAIRS)
    first = step * m // TRIED_PAIRS
    second = (first + 1 + step * 7919 % (m - 1)) % m  # from neighbours to far apart in the sequence
    if (sees[first].multiply(sees[second]).sum(axis=1) > 0).mean() > MOSTLY:
        protocol.refuse_what_does_not_fit(size, f"{counted(6 * m, 'unknown')} that are all connected")


@compiled
def _join(observations: Observations, points: IntArray, joined: AnyArray) -> None:
    """Set 1 where two poses share one of the given object points, (m, m)."""
    for j in points:
        for s in range(observations.start[j], observations.start[j + 1]):
            for t in range(observations.start[j], observations.start[j + 1]):
                joined[observations.pose[s], observations.pose[t]] = 1
