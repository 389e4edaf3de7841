"""Residuals as a vector field over the format, with significance: what the camera model leaves over.

The format is divided into square cells. The mean residual of a
cell is tested twice: against the standard deviations of its residuals, for independent errors; and
against the scatter of the sums of single photographs, by Hotelling's T^2. Errors that neighbours share, or
that a bent board causes, differ from photograph to photograph, so that the second test does not take them for
the lens. A cell counts as significant if both tests find it. The whole field is tested by the sum over all
cells, each with the larger variance of both.

Source: Hotelling (1931), Ann. Math. Stat. 2; Baarda (1968) for the covariance of residuals; Luhmann et al.,
Close-Range Photogrammetry (2020), sec. 3.3 (systematic residuals).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.distributions import chi2_sf, f_sf

CELLS = 8  # along the longer side of the format
MIN_PHOTOGRAPHS = 4  # with image points in a cell; T^2 needs three, and three have no power


@dataclass(frozen=True)
class ResidualField:
    """Mean residuals of n cells of the format of a camera that have enough photographs."""

    camera: str
    centre: FloatArray  # mean position of the image points of each cell, px, (n, 2)
    mean: FloatArray  # mean residual, computed minus measured, px, (n, 2)
    sigma: FloatArray  # standard deviation of the mean by chance, RMS of both coordinates, px, (n,)
    count: IntArray  # image points, (n,)
    photographs: IntArray  # photographs, (n,)
    probability: FloatArray  # of such a mean by chance, in one cell, (n,)
    whole: float  # probability of such a field by chance; NaN without cells

    @property
    def rms_px(self) -> float:
        """Field beyond chance, RMS per coordinate over the cells, px; 0 if chance explains all."""
        if not len(self.mean):
            return 0.0
        return float(np.sqrt(max(((self.mean**2).mean(axis=1) - self.sigma**2).mean(), 0.0)))

    def significant(self, level: float) -> BoolArray:
        """Return which cells have a mean that chance does not explain, (n,).

        Args:
            level: probability that any cell of a field without systematic errors is called significant.
        """
        return np.asarray(self.probability < -np.expm1(np.log1p(-level) / max(len(self.probability), 1)))


def residual_field(adjustment: Adjustment, camera: int = 0) -> ResidualField:
    """Return the mean residuals of a camera over its format.

    Args:
        adjustment: finished, with redundancy numbers.
        camera: index of the camera.

    Example:
        >>> from sfm.products.calibration.residual_field import residual_field
        >>> field = residual_field(result.adjustment)
        >>> field.mean.shape == field.centre.shape
        True
    """
    network, estimate = adjustment.network, adjustment.estimate
    used = ~adjustment.rejected & (network.camera[network.image_points.image] == camera)
    xy, image = network.image_points.xy[used], network.image_points.image[used]
    v = adjustment.residuals[used]
    variance = np.einsum("kii->ki", adjustment.image_covariance[used]) * adjustment.sigma0**2
    r = adjustment.redundancy_numbers[used]
    variance = variance * np.where(np.isfinite(r), r, 1.0)
    size = np.array(estimate.cameras[camera].size_px)
    side = size.max() / CELLS
    column, row = np.clip(xy // side, 0, CELLS - 1).astype(np.int64).T
    rows: list[tuple[FloatArray, FloatArray, float, int, int, float, float]] = []
    for cell in np.unique(CELLS * row + column):
        inside = np.flatnonzero(CELLS * row + column == cell)
        photographs, of = np.unique(image[inside], return_inverse=True)
        k, m = len(inside), len(photographs)
        if m < MIN_PHOTOGRAPHS:
            continue
        sums = np.zeros((m, 2))
        np.add.at(sums, of, v[inside])
        mean = sums.sum(axis=0) / k
        alone = variance[inside].sum(axis=0) / k**2  # of the mean, in x and y
        between = m * np.cov(sums, rowvar=False) / k**2
        T2 = float(mean @ np.linalg.pinv(between) @ mean)
        by_photographs = float(f_sf((m - 2) / (2 * (m - 1)) * T2, 2, m - 2))
        by_points = float(chi2_sf(float((mean**2 / np.maximum(alone, np.finfo(float).tiny)).sum()), 2))
        larger = np.maximum(alone, np.diagonal(between))
        rows.append(
            (
                xy[inside].mean(axis=0),
                mean,
                float(np.sqrt(larger.mean())),
                k,
                m,
                max(by_photographs, by_points),
                float((mean**2 / np.maximum(larger, np.finfo(float).tiny)).sum()),
            )
        )
    chi2 = sum(row[6] for row in rows)
    return ResidualField(
        estimate.cameras[camera].name,
        np.array([row[0] for row in rows]).reshape(-1, 2),
        np.array([row[1] for row in rows]).reshape(-1, 2),
        np.array([row[2] for row in rows]),
        np.array([row[3] for row in rows], dtype=np.int64),
        np.array([row[4] for row in rows], dtype=np.int64),
        np.array([row[5] for row in rows]),
        float(chi2_sf(chi2, 2 * len(rows))) if rows else float("nan"),
    )
