"""Tables of the protocol: residuals by photograph and point, control, correlations, covariances.

Covariances are a posteriori and in the datum of the adjustment; those of exterior orientation are of X0, Y0,
Z0 (object unit) and omega, phi, kappa (rad).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.files.result_tables import (
    CONTROL_POINTS,
    EXTERIOR_CORRELATIONS,
    IMAGE_COVARIANCES,
    INTERIOR_CORRELATIONS,
    POINT_COVARIANCES,
    RESIDUALS,
    write_covariances,
)
from sfm.report.findings.findings import Findings


def write_protocol(findings: Findings, folder: Path) -> None:
    """Write the tables of the protocol into an existing folder."""
    a = findings.result.adjustment
    RESIDUALS.write_rows(folder, _residual_rows(findings))
    CONTROL_POINTS.write_rows(folder, _control_rows(findings))
    INTERIOR_CORRELATIONS.write_rows(folder, _correlation_rows(a))
    EXTERIOR_CORRELATIONS.write_rows(folder, _exterior_correlation_rows(findings))
    for table, names, covariance in (
        (POINT_COVARIANCES, a.network.points, a.covariance.points),
        (IMAGE_COVARIANCES, a.network.images, a.covariance.exterior),
    ):
        rows, columns = np.triu_indices(covariance.shape[1])
        table.write(folder, names, covariance[:, rows, columns])
    write_covariances(folder, findings.result.solution, points=True)


def _residual_rows(findings: Findings) -> Iterable[Sequence[object]]:
    for one in findings.protocol.residuals:
        yield (
            *(one.kind, one.name, one.accepted, one.rejected),
            *(*one.rms_px, *one.largest_px, *one.largest_at),
        )


def _control_rows(findings: Findings) -> Iterable[Sequence[object]]:
    for one in findings.protocol.control:
        yield (
            *(one.use, one.point, one.coordinate, one.given, one.prior),
            *(one.adjusted, one.posterior, one.difference, one.test),
        )


def _correlation_rows(a: Adjustment) -> Iterable[Sequence[object]]:
    """Yield all correlations of the interior parameters of each camera."""
    for camera, Q in zip(a.estimate.cameras, a.covariance.interior, strict=True):
        names = [camera.names[s] for s in np.flatnonzero(camera.free)[: len(Q)]]
        sigma = np.sqrt(np.clip(np.diagonal(Q), 0, None))
        for r, first in enumerate(names):
            for c in range(r + 1, len(names)):
                known = sigma[r] * sigma[c]
                yield camera.name, first, names[c], Q[r, c] / known if known > 0 else np.nan


def _exterior_correlation_rows(findings: Findings) -> Iterable[Sequence[object]]:
    """Yield the correlations of every interior parameter with every photograph."""
    found = findings.result.exterior_correlations
    if found is None:
        return
    for c, (parameter, camera) in enumerate(found.parameters):
        for image, rho in zip(found.images, found.rho[:, :, c], strict=True):
            yield (camera.removeprefix("camera "), parameter, image, *rho)
