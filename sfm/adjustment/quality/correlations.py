"""Correlations of camera parameters with the exterior orientation: what the network cannot distinguish.

In a flat network with parallel views c is strongly correlated with Z0, x0 and y0 with X0, Y0 or with the
angles: the standard deviations of both are then large together, while distances between points may be good.

Source: Luhmann et al., Close-Range Photogrammetry (2020), sec. 7.3.2 (correlations in self-calibration);
Fraser (1997), ISPRS J. Photogramm. Remote Sens. 52(4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.adjustment.covariance import marginal_of
from sfm.adjustment.engine.unknowns import interior_names
from sfm.adjustment.quality.statistics import MIN_REPORTED_CORRELATION
from sfm.adjustment.result import Adjustment
from sfm.conventions import FloatArray
from sfm.display import counted
from sfm.kernels.threads import own_threads
from sfm.observations.pose import exterior_jacobian

PARTS = ("X0", "Y0", "Z0", "omega", "phi", "kappa")


@dataclass(frozen=True)
class OrientationCorrelation:
    """A camera parameter that is strongly correlated with the exterior orientation of photographs."""

    parameter: str  # and its camera, in words
    largest: float  # correlation, -1 to 1
    part: str  # X0, Y0, Z0, omega, phi or kappa that it is with
    image: str  # of this photograph
    counts: tuple[tuple[str, int], ...]  # parts beyond the limit, and in how many photographs each

    @property
    def partners(self) -> str:
        """All that it is strongly correlated with, in words."""
        return ", ".join(f"{part} of {counted(n, 'photograph')}" for part, n in self.counts)


@dataclass(frozen=True)
class ExteriorCorrelations:
    """Correlations of all adjusted camera parameters with the orientation of every photograph."""

    parameters: tuple[tuple[str, str], ...]  # name, and camera in words, of each interior unknown, (i,)
    images: tuple[str, ...]  # photographs, (m,)
    rho: FloatArray  # with X0, Y0, Z0, omega, phi, kappa; 0 where one of the two was held, (m, 6, i)


def exterior_correlations(adjustment: Adjustment) -> ExteriorCorrelations:
    """Return the correlations of camera parameters with exterior orientation, in the datum of an adjustment.

    Args:
        adjustment: with its covariance.

    Raises:
        GeometryError: its normal equations cannot be solved.
    """
    with own_threads():
        names, rho = _correlations(adjustment)
    return ExteriorCorrelations(tuple(names), adjustment.network.images, rho)


def orientation_correlations(
    adjustment: Adjustment, *, limit: float = MIN_REPORTED_CORRELATION
) -> tuple[OrientationCorrelation, ...]:
    """Return the camera parameters correlated with exterior orientation beyond a limit, strongest first.

    Args:
        adjustment: with its covariance; the correlations are those in its datum.
        limit: absolute correlation from which a parameter is reported.

    Raises:
        GeometryError: its normal equations cannot be solved.
    """
    return strong_correlations(exterior_correlations(adjustment), limit=limit)


def strong_correlations(
    correlations: ExteriorCorrelations, *, limit: float = MIN_REPORTED_CORRELATION
) -> tuple[OrientationCorrelation, ...]:
    """Return the camera parameters with a correlation beyond a limit, strongest first.

    Args:
        correlations: with the exterior orientation of every photograph.
        limit: absolute correlation from which a parameter is reported.
    """
    if not correlations.rho.size:
        return ()
    images = correlations.images
    found = []
    for c, (parameter, camera) in enumerate(correlations.parameters):
        size = np.abs(correlations.rho[:, :, c])
        strong = size > limit
        if not strong.any():
            continue
        i, p = np.unravel_index(int(np.argmax(size)), size.shape)
        counts = tuple((part, int(n)) for part, n in zip(PARTS, strong.sum(axis=0), strict=True) if n)
        found.append(
            OrientationCorrelation(
                f"{parameter} of {camera}", float(correlations.rho[i, p, c]), PARTS[p], images[i], counts
            )
        )
    return tuple(sorted(found, key=lambda one: -abs(one.largest)))


def _correlations(adjustment: Adjustment) -> tuple[list[tuple[str, str]], FloatArray]:
    """Return (parameter, camera) of each interior unknown, and its correlations by photograph, (m, 6, i).

    0 where one of the two is fixed or was not adjusted.
    """
    if not any(camera.free.any() for camera in adjustment.estimate.cameras):
        return [], np.zeros((0, 6, 0))
    marginal = marginal_of(adjustment, cross=False)
    layout, optimum, Q = marginal.layout, marginal.optimum, marginal.cofactors
    names = interior_names(layout, adjustment.estimate)
    first, i = layout.pose_free.size, len(names)
    inner = slice(first, first + i)
    H, F, G = optimum.motions.reduced, Q.F_reduced, Q.G
    # S Q S' of the S-transformation, the block of exterior by interior unknowns
    of_poses = np.concatenate([Q.mixed[:, :i], Q.border[:, :i]])
    C = of_poses - H @ F[:, inner] - (H[inner] @ F).T + H @ G @ H[inner].T
    columns, J = layout.photograph_terms(optimum.state, np.arange(len(optimum.state.M)))
    C = exterior_jacobian(optimum.state.M) @ J @ C[columns]
    exterior = np.einsum("mpp->mp", adjustment.cofactors.exterior)
    half = H[inner] @ F[:, inner]  # 0 but for null vectors that are none of the motions of the network
    interior = np.diagonal(Q.border[:i, :i] - half - half.T + H[inner] @ G @ H[inner].T)
    square = exterior[:, :, None] * interior
    known = square > 0
    return names, np.asarray(np.where(known, C / np.sqrt(np.where(known, square, 1.0)), 0.0))
