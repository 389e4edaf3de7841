"""The cameras of a calibration: what matters in a result whose points are all held fixed, as on a plate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.adjustment.quality.projection import projection_map
from sfm.adjustment.result import Adjustment
from sfm.conventions import BoolArray, FloatArray
from sfm.distortion.models import Role
from sfm.report.findings.interior_parameters import InteriorOrientation, InteriorParameter
from sfm.report.findings.precision import root_mean_square

OF_CAMERA = (Role.FOCAL, Role.X0, Role.Y0)


@dataclass(frozen=True)
class CalibratedCamera:
    """An adjusted camera, shared parameters once."""

    name: str
    parameters: tuple[InteriorParameter, ...]  # focal lengths and principal point
    projection_rms_px: float  # projection uncertainty, 1 sigma, over the whole photograph, px
    projection_largest_px: float  # its largest value, px


def calibrated_cameras(adjustment: Adjustment, interior: InteriorOrientation) -> tuple[CalibratedCamera, ...]:
    """Return the adjusted cameras where all points are held fixed; none where a coordinate was adjusted."""
    if adjustment.unknown_counts[2]:
        return ()
    found = []
    for f, family in enumerate(interior.families):
        projection = projection_of(adjustment, interior.family == f)
        if projection is None:
            continue
        sigma = projection[2]
        known = sigma[np.isfinite(sigma)]
        found.append(
            CalibratedCamera(
                family.name,
                tuple(one for one in family.parameters if one.parameter.role in OF_CAMERA),
                root_mean_square(known),
                float(known.max(initial=np.nan if not known.size else -np.inf)),
            )
        )
    return tuple(found)


def projection_of(
    adjustment: Adjustment, photographs: BoolArray
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return the projection uncertainty of the camera of some photographs.

    Args:
        adjustment: finished, with its covariance.
        photographs: which photographs, (m,).

    Returns:
        Columns (c,) and rows (r,) of a grid, px, and the standard deviation at its crossings, px, (r, c);
        None where the camera was held.
    """
    network, seen = adjustment.network, adjustment.network.image_points.select(~adjustment.rejected)
    if not photographs.any():
        return None
    k = int(network.camera[photographs][0])  # of several that share parameters the first
    camera, covariance = adjustment.estimate.cameras[k], adjustment.covariance.interior[k]
    if not len(covariance) or not np.isfinite(covariance).all() or not np.diagonal(covariance).any():
        return None
    return projection_map(camera, covariance, seen.xy[photographs[seen.image]])
