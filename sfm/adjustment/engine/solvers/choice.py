"""Which photographs share object points, and the order that brings them near one another.

The reduced normal matrix has a block wherever two photographs share a point. In a block of photographs every
one shares points with its neighbours only, and in a good order (reverse Cuthill-McKee) all of them lie near
the diagonal: a band. A full matrix is summed as a product of full rows where most photographs see most
points, else pair by pair of rays. Which is the least work is told by counting operations.

Source: Cuthill and McKee (1969), Proc. 24th ACM Conf.; George and Liu (1981), Computer Solution of Large
Sparse Positive Definite Systems, ch. 4; operations: Golub and Van Loan (2013), sec. 4.2 and 4.3.5.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee

from sfm.adjustment.engine.collinearity import Observations
from sfm.adjustment.engine.solvers.banded import BandSolver
from sfm.adjustment.engine.solvers.dense import DenseSolver
from sfm.adjustment.engine.solvers.pairs import pairs_of
from sfm.adjustment.engine.solvers.protocol import Solver
from sfm.adjustment.engine.unknowns import Unknowns
from sfm.conventions import AnyArray
from sfm.kernels.options import compiled

# Operations in a second, one thread, AVX-512 (OpenBLAS 0.3.30); only their ratios matter
PRODUCT_RATE = 80e9  # symmetric product of full rows, most of them in single precision
FACTOR_RATE = 25e9  # Cholesky factor of a full matrix, which has one thread where the sums have two
BAND_RATE = 20e9  # Cholesky factor of a band by LAPACK's dpbtrf, one thread too
PAIR_RATE = 25e9  # product of two rays of a point, compiled
PAIR_OPERATIONS = 216  # of a 6 x 6 x 3 product
SMALL = 64  # photographs up to which the product of full rows costs so little that nothing else is sought


def choose_solver(layout: Unknowns) -> Solver:
    """Return the solver that takes the least work for a network.

    A band, or a full matrix that is summed pair by pair of rays or as a product of full rows.

    Args:
        layout: order of the unknowns and the image points.
    """
    observations = layout.observations
    m = len(observations.camera)
    rays = np.diff(observations.start).astype(float)
    pairs = float((rays * (rays + 1) / 2).sum())
    summed = PAIR_OPERATIONS * pairs / PAIR_RATE
    product = 3.0 * len(rays) * layout.reduced**2 / PRODUCT_RATE
    full = min(summed, product) + layout.reduced**3 / 3.0 / FACTOR_RATE
    # a point joins all its photographs, so no order has a narrower band than its rays
    least = summed + 6.0 * m * (6.0 * rays.max()) ** 2 / BAND_RATE
    if m <= SMALL:
        return DenseSolver(layout)
    if least > full:
        return DenseSolver(layout, pairs_of(observations) if summed < product else None)
    rows, columns = np.nonzero(_joined(observations, np.zeros((m, m), dtype=np.uint8)))
    graph = csr_matrix((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(m, m))
    place = np.empty(m, dtype=np.int64)
    place[reverse_cuthill_mckee(graph, symmetric_mode=True)] = np.arange(m)
    width = int(np.abs(place[rows] - place[columns]).max(initial=0))
    banded = summed + 6.0 * m * (6.0 * width + 6.0) ** 2 / BAND_RATE
    if banded > full:
        return DenseSolver(layout, pairs_of(observations) if summed < product else None)
    earliest = np.full(len(rays), m)
    np.minimum.at(earliest, observations.point, place[observations.image])
    return BandSolver(layout, place, np.argsort(earliest, kind="stable"), width)


@compiled
def _joined(observations: Observations, joined: AnyArray) -> AnyArray:
    """Return 1 where two photographs share an object point, (m, m)."""
    for j in range(len(observations.start) - 1):
        for s in range(observations.start[j], observations.start[j + 1]):
            for t in range(observations.start[j], observations.start[j + 1]):
                joined[observations.image[s], observations.image[t]] = 1
    return joined
