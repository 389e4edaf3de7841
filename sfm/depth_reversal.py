"""A network turned inside out in depth, which parallel rays cannot distinguish from itself.

Source: Szeliski and Kang (1997), IEEE PAMI 19(5), for the reversal of depth.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sfm.network import Estimate


def reverse_depth(estimate: Estimate) -> Estimate:
    """Return the estimate reflected in depth: exact where all rays of a photograph are parallel.

    Args:
        estimate: NaN for photographs and points that are not determined, which stay so.
    """
    known, oriented = estimate.determined, estimate.oriented
    d = estimate.rotation[oriented, :, 2].mean(axis=0)
    F = np.eye(3) - 2 * np.outer(d, d) / (d @ d)
    centre = estimate.points[known].mean(axis=0)
    R = F @ estimate.rotation * np.array([1.0, 1.0, -1.0])
    from_centre = np.einsum("mji,mj->mi", estimate.rotation, estimate.position - centre)
    return replace(
        estimate,
        position=centre + np.einsum("mij,mj->mi", R, from_centre),
        rotation=R,
        points=centre + (estimate.points - centre) @ F,
    )
