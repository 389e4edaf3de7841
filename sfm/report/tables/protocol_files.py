"""Tables of the protocol: residuals by photograph and point, control, correlations, covariances.

Covariances are a posteriori and in the datum of the adjustment; those of exterior orientation are of X0, Y0,
Z0 (object unit) and omega, phi, kappa (rad).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.conventions import FloatArray
from sfm.files.plain_text import csv_text
from sfm.report.findings.findings import Findings

EXTERIOR = ("X0", "Y0", "Z0", "omega", "phi", "kappa")
AXES = ("X", "Y", "Z")


def write_protocol(findings: Findings, folder: Path) -> None:
    """Write the tables of the protocol into an existing folder."""
    a = findings.result.adjustment
    for name, header, rows in (
        (
            "residuals",
            "kind,name,accepted,rejected,rmsx_px,rmsy_px,largestx_px,largesty_px,largestx_at,largesty_at",
            _residual_rows(findings),
        ),
        (
            "control_points",
            "use,point,coordinate,given,sigma_prior,adjusted,sigma_posterior,difference,test",
            _control_rows(findings),
        ),
        ("interior_correlations", "camera,first,second,correlation", _correlation_rows(a)),
        (
            "exterior_correlations",
            f"camera,parameter,image,{','.join(EXTERIOR)}",
            _exterior_correlation_rows(findings),
        ),
        ("point_covariances", _header("id", AXES), _covariance_rows(a.network.points, a.covariance.points)),
        (
            "image_covariances",
            _header("image", EXTERIOR),
            _covariance_rows(a.network.images, a.covariance.exterior),
        ),
    ):
        text = csv_text(header.split(","), rows)
        (folder / f"{name}.csv").write_text(text, encoding="utf-8", newline="")
    interior: dict[str, Any] = {f"interior_{k}": Q for k, Q in enumerate(a.covariance.interior)}
    np.savez_compressed(
        folder / "covariances.npz",
        point_names=np.array(a.network.points),
        points=a.covariance.points,
        image_names=np.array(a.network.images),
        exterior=a.covariance.exterior,
        camera_names=np.array([camera.name for camera in a.estimate.cameras]),
        **interior,
    )


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


def _header(name: str, parts: tuple[str, ...]) -> str:
    pairs = [f"{one}_{other}" for k, one in enumerate(parts) for other in parts[k:]]
    return ",".join((name, *pairs))


def _covariance_rows(names: Sequence[str], covariance: FloatArray) -> Iterable[Sequence[object]]:
    """Yield the upper triangle of each covariance matrix, row by row."""
    rows, columns = np.triu_indices(covariance.shape[1])
    for name, Q in zip(names, covariance, strict=True):
        yield (name, *Q[rows, columns])
