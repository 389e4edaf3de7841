"""COLMAP as the other adjuster of a validation: adjustment and covariances.

Source: COLMAP 4.2, estimate_ba_covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from adapters.colmap.adjuster import (
    ColmapAdjustment,
    adjust_with_colmap,
    adjustment_config,
    ceres_options,
    colmap_free,
    load_pycolmap,
    quiet,
)
from adapters.colmap.reconstruction import reconstruction
from sfm.conventions import FloatArray
from sfm.network import Estimate, Network


@dataclass(frozen=True)
class ColmapCovariance:
    """Covariances as COLMAP estimates them, for image coordinates of standard deviation 1 px."""

    interior: tuple[FloatArray, ...]  # marginal, of the free parameters of each camera, in order, (f, f)
    points: FloatArray  # with cameras and photographs held fixed (conditional), object unit^2, (n, 3, 3)


def covariance_with_colmap(
    network: Network, estimate: Estimate, *, gauge: str = "two_cameras"
) -> ColmapCovariance | None:
    """Return COLMAP's covariances at a solution, None of rigs and where COLMAP finds it singular.

    What COLMAP calls the covariance of a point is conditional on all photographs and cameras, too small
    by the share that these contribute. That of the interior orientation is marginal and does not depend
    on the gauge.

    Args:
        network: photographs, points and image points.
        estimate: the solution, cameras in a model that COLMAP has.
        gauge: two_cameras | control; COLMAP has no covariance without a gauge.

    Raises:
        BackendError: as for `adjust_with_colmap`.
    """
    pycolmap = load_pycolmap()
    if estimate.mounts is not None:  # COLMAP 4.2 refuses photographs that are not of reference cameras
        return None
    options = ceres_options(pycolmap, colmap_free(estimate.cameras), len(network.images), 1, 1)
    with quiet(pycolmap):
        scene = reconstruction(pycolmap, network, estimate)
        config = adjustment_config(pycolmap, network, estimate, gauge)
        # estimate_ba_covariance wants this adjuster and no other; it need not have been run
        adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, scene)
        wanted = pycolmap.BACovarianceOptions()
        wanted.damping = 0.0
        found = pycolmap.estimate_ba_covariance(wanted, scene, adjuster)
        if found is None:
            return None
        interior = []
        for k, camera in enumerate(estimate.cameras):
            block = found.get_other_params_cov(scene.camera(k + 1).params) if camera.free.any() else None
            interior.append(np.zeros((0, 0)) if block is None else np.array(block))
        points = np.zeros((len(network.points), 3, 3))  # held points have none
        for j in range(len(network.points)):
            block = found.get_point_cov(j + 1)
            if block is not None:
                points[j] = block
    return ColmapCovariance(tuple(interior), points)


def adjust_with_covariance(network: Network, start: Estimate, *, threads: int = 1) -> ColmapAdjustment:
    """Adjust with COLMAP in a free datum, and have its covariances of points at the solution.

    Args, Raises: as `adjust_with_colmap`.
    """
    found = adjust_with_colmap(network, start, threads=threads)
    covariance = covariance_with_colmap(network, found.estimate)
    return replace(found, point_covariance=None if covariance is None else covariance.points)


@dataclass(frozen=True)
class ColmapBackend:
    """COLMAP as the other adjuster of a validation (sfm.comparison.two_adjusters.adjuster_validation)."""

    name: str = "colmap"

    def adjust(self, network: Network, start: Estimate, *, control: bool) -> ColmapAdjustment:
        """Adjust with control points held or the datum free."""
        return adjust_with_colmap(network, start, gauge="control" if control else "free")

    def covariance(self, network: Network, estimate: Estimate, *, control: bool) -> ColmapCovariance | None:
        """Return COLMAP's covariances at a solution."""
        return covariance_with_colmap(network, estimate, gauge="control" if control else "two_cameras")
