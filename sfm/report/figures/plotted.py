"""Findings to what the plots of a report show of them."""

from __future__ import annotations

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.conventions import BoolArray, FloatArray
from sfm.report.figures.plot_data import PlotCamera, PlotData, ProjectionMap
from sfm.report.findings.calibrated_cameras import projection_of
from sfm.report.findings.findings import Findings
from sfm.report.findings.precision import adjusted_sigmas, root_mean_square
from sfm.report.numbers import finer_unit


def plot_data(findings: Findings) -> PlotData:
    """Return what the plots of a report show."""
    adjustment, interior, geometry = findings.result.adjustment, findings.interior, findings.geometry
    network, estimate, used = adjustment.network, adjustment.estimate, ~adjustment.rejected
    seen = network.image_points.select(used)
    sigma = np.array([root_mean_square(one) for one in adjusted_sigmas(adjustment.covariance.points)])
    factor, unit = finer_unit(findings.result.length_unit, float(findings.precision.largest[3]))
    centre = np.array([camera.frame[:2] for camera in estimate.cameras])
    return PlotData(
        unit=findings.result.length_unit,
        images=network.images,
        position=estimate.position,
        rotation=estimate.rotation,
        points=estimate.points,
        cameras=tuple(PlotCamera(one.name, one.camera.c_px, one.camera.size_px) for one in interior.families),
        camera=interior.family,
        image=seen.image,
        xy=seen.xy,
        from_centre=seen.xy - centre[network.camera[seen.image]],
        residuals=adjustment.residuals[used],
        standardised=_standardised_residuals(adjustment),
        image_rms_px=geometry.image_rms_px,
        image_points=geometry.image_points,
        rms_px=adjustment.rms_px,
        sigma=sigma * factor,
        sigma_unit=unit,
        projection=tuple(
            _projection(adjustment, interior.family == f) for f in range(len(interior.families))
        ),
    )


def _projection(adjustment: Adjustment, photographs: BoolArray) -> ProjectionMap | None:
    """Return the projection uncertainty of the camera of photographs, (m,); None where it was held."""
    found = projection_of(adjustment, photographs)
    return None if found is None else ProjectionMap(*found)


def _standardised_residuals(adjustment: Adjustment) -> FloatArray:
    """Return accepted residuals over their own standard deviation a posteriori, shape (2k,).

    Source: Baarda (1968): sigma of v = sigma0 * sigma * sqrt(r) with the redundancy number r.
    """
    used = ~adjustment.rejected
    variance = np.einsum("kii->ki", adjustment.image_covariance[used])
    r = adjustment.redundancy_numbers[used]
    sigma = adjustment.sigma0 * np.sqrt(np.where(r > 1e-6, variance * r, np.nan))
    return np.asarray((adjustment.residuals[used] / sigma).ravel())
