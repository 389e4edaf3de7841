"""How far the errors of neighbouring image points agree, from the residuals of an adjustment.

A lens that breathes, a shutter that rolls and a surface that is curved inside of windows move neighbouring
image points together. Sums of residuals over cells of a photograph, from single image points to half of
it, show that: for independent errors their squares grow with the number of image points, for common ones with
its square. Object points, orientations and cameras take a part of either, of long waves the most. How much
is left is found by simulation: random fields of known length go through the linearised adjustment. A field
moves precise image points by as many px as others.

Source: variance components by quadratic forms and their expectations, Koch (1999), sec. 3.6; nested cells,
Webster and Oliver (2007), Geostatistics for Environmental Scientists, sec. 6.3; random fields of a given
covariance, Rahimi and Recht (2007), Adv. Neural Inf. Process. Syst. 20.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls
from scipy.sparse import csr_matrix

from sfm.adjustment.covariance import marginal_of, with_error_correlation
from sfm.adjustment.engine.linearised import linearise
from sfm.adjustment.result import Adjustment, ErrorCorrelation
from sfm.arguments import checked_arguments
from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.network import rows_of

HALVINGS = 7  # of the longer side of the photographs, to the smallest cells and to the shortest correlation
DRAWS = 16  # fields of each length
WAVES = 64  # of a field in one photograph
ROUNDS = 5  # of weighting by the expectations; the second hardly changes them


@checked_arguments()
def estimate_error_correlation(adjustment: Adjustment) -> ErrorCorrelation | None:
    """Return the correlation of the errors of neighbouring image points that fits the residuals best.

    Lengths from the longer side of the photographs down, halved in turn, are tried.

    Args:
        adjustment: the adjustment, with its covariance or without.

    Returns:
        None where the errors of neighbours do not agree.
    """
    m = marginal_of(adjustment, cross=False)
    o = m.layout.observations
    weight = np.ascontiguousarray(adjustment.weights[m.layout.order])
    linear = linearise(m.optimum, m.layout, weight)
    used = weight > 0
    size = max(max(camera.size_px) for camera in adjustment.estimate.cameras)
    cells = [_cells(o.image, o.xy, used, size / 2.0**n) for n in range(1, HALVINGS + 1)]
    v = linear.whitening @ adjustment.residuals[m.layout.order][:, :, None]
    v[~used] = 0.0
    found = _squares(v, cells)
    count = np.array([used.sum(), *(one.shape[0] for one in cells)])
    rng = np.random.default_rng(0)

    def left_of(errors: FloatArray) -> FloatArray:
        """Return what the adjustment is expected to leave of errors with unit variance."""
        errors[~used] = 0.0
        return _squares(linear.residuals(errors.reshape(2 * len(used), -1)), cells)

    relative = adjustment.usual_px * linear.whitening
    alone = left_of(rng.standard_normal((len(used), 2, DRAWS)))
    best, least = None, np.inf
    for length in size / 2.0 ** np.arange(HALVINGS):
        common = left_of(relative @ _fields(o.image, o.xy, length, rng))
        expected = found
        for _ in range(ROUNDS):
            sigma = expected / np.sqrt(count)  # of the sum of squares of so many pairs x, y
            parts, misfit = nnls(np.column_stack([alone, common]) / sigma[:, None], found / sigma)
            expected = parts[0] * alone + parts[1] * common
        if misfit < least:
            best, least = (parts / adjustment.sigma0**2, length), misfit
    if best is None or best[0][1] == 0:
        return None
    (of_each, of_neighbours), length_px = best
    return ErrorCorrelation(float(of_each), float(of_neighbours), float(length_px))


@checked_arguments()
def with_neighbours(adjustment: Adjustment) -> Adjustment:
    """Return the adjustment with the covariance of errors that neighbours have in common by the residuals."""
    found = estimate_error_correlation(adjustment)
    return adjustment if found is None else with_error_correlation(adjustment, found)


def _cells(image: IntArray, xy: FloatArray, used: BoolArray, side_px: float) -> csr_matrix:
    """Return which image points are in each cell of the photographs that has some, (cells, k)."""
    of_cell = np.column_stack([image, np.floor(xy / side_px)])[used]
    cell = np.unique(of_cell, axis=0, return_inverse=True)[1].ravel()
    return csr_matrix((np.ones(len(cell)), (cell, np.flatnonzero(used))), shape=(cell.max() + 1, len(used)))


def _squares(v: FloatArray, cells: list[csr_matrix]) -> FloatArray:
    """Return the sums of squares of residuals, and of their sums over cells of each size, of a draw."""
    v = v.reshape(cells[0].shape[1], -1)
    draws = v.shape[1] / 2
    return np.array([float((v**2).sum()), *(float(((one @ v) ** 2).sum()) for one in cells)]) / draws


def _fields(image: IntArray, xy: FloatArray, length_px: float, rng: np.random.Generator) -> FloatArray:
    """Return random fields in each photograph with covariance exp(-d / length), (k, 2, DRAWS).

    Wave numbers are drawn from its spectrum, that of a bivariate Cauchy distribution.
    """
    field = np.empty((len(xy), 2, DRAWS))
    for rows in rows_of(image, int(image.max()) + 1):
        waves = rng.standard_normal((2, WAVES)) / np.abs(rng.standard_normal(WAVES)) / length_px
        phase = xy[rows] @ waves
        amplitude = rng.standard_normal((2, WAVES, 2 * DRAWS)) / np.sqrt(WAVES)
        drawn = np.cos(phase) @ amplitude[0] + np.sin(phase) @ amplitude[1]
        field[rows] = drawn.reshape(len(rows), 2, DRAWS)
    return field
