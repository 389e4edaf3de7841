"""What `kolinear resect` prints: one method in full as JSON or text, or all methods side by side."""

from __future__ import annotations

from typing import Any

import numpy as np

from sfm.conventions import angles_from_rotation
from sfm.display import counted
from sfm.errors import GeometryError
from sfm.orientation.resection.candidates import ResectionSolution
from sfm.report.page import Column, Table, plain
from sfm.textbook.resection.by_method import ResectionResult
from sfm.textbook.resection.dlt import DirectLinearTransformation

EXTERIOR = ("X0", "Y0", "Z0", "omega_deg", "phi_deg", "kappa_deg")
METHODS = (
    *(Column("method"), Column("no", format=str)),
    *(Column(name, format=".6f") for name in EXTERIOR[:3]),
    *(Column(name, format=".5f") for name in ("omega", "phi", "kappa")),
    Column("rms mm", format=".6f"),
)


def resection_json(found: ResectionResult, c: float) -> dict[str, Any]:
    """Return what one method finds, ready for JSON.

    Args:
        found: by `resection.by_method.resect`.
        c: principal distance, mm.

    Returns:
        method, points, solutions (best first: X0, Y0, Z0, omega_deg, phi_deg, kappa_deg, M, rms_mm) and,
        where they apply, sigma0_mm, redundancy, dispersion (object unit and deg), history, residuals_mm,
        line_fit, interior, rejected, trials, warning.
    """
    unit = np.array([1, 1, 1, *[np.degrees(1.0)] * 3])
    lines = found.line_fit or ()
    known = {
        "method": found.method,
        "points": found.points,
        "solutions": [
            dict(zip(EXTERIOR, _values(one), strict=True)) | {"M": one.rotation.T, "rms_mm": one.rms * c}
            for one in found.solutions
        ],
        "line_fit": [
            {"slope": one.slope, "intercept_mm": one.intercept * c, "scatter_mm": one.scatter * c}
            for one in lines
        ]
        or None,
        "sigma0_mm": found.sigma0_mm,
        "redundancy": None if found.sigma0_mm is None else found.redundancy,
        "dispersion": None if found.dispersion is None else found.dispersion * np.outer(unit, unit),
        "history": None if found.history is None else found.history * unit[: found.history.shape[1]],
        "residuals_mm": found.residuals_mm,
        "interior": None if found.interior is None else _interior(found.interior),
        "rejected": found.rejected,
        "trials": found.trials,
        "warning": found.warning or None,
    }
    return {name: plain(value) for name, value in known.items() if value is not None}


def comparison_json(found: dict[str, ResectionResult | GeometryError], c: float) -> list[dict[str, Any]]:
    """Return what all methods find, or why one finds nothing, ready for JSON; c in mm."""
    return [
        {"method": name, "error": str(one)} if isinstance(one, GeometryError) else resection_json(one, c)
        for name, one in found.items()
    ]


def comparison_table(found: dict[str, ResectionResult | GeometryError], c: float) -> str:
    """Return what all methods find side by side, and below why others find nothing; c in mm."""
    rows, remarks = [], []
    for name, one in found.items():
        if isinstance(one, GeometryError):
            remarks.append(f"{name}: {str(one).removeprefix(f'{name}: ')}\n")
            continue
        rows += [(name, k, *_values(each), each.rms * c) for k, each in enumerate(one.solutions, start=1)]
        if one.warning:
            remarks.append(f"{name}: {one.warning}\n")
    return (Table(METHODS, rows).text + "".join(remarks)).rstrip("\n")


def resection_text(found: ResectionResult, c: float) -> str:
    """Return what one method finds as text; c in mm."""
    lines = [f"{found.method}, {counted(found.points, 'point')}"]
    for k, one in enumerate(found.solutions, start=1):
        X0, Y0, Z0, omega, phi, kappa = _values(one)
        lines.append(f"solution {k}: rms {one.rms * c:.6f} mm")
        lines.append(f"  X0 Y0 Z0        {X0:.8f} {Y0:.8f} {Z0:.8f}")
        lines.append(f"  omega phi kappa {omega:.7f} {phi:.7f} {kappa:.7f} deg")
        lines += ["  M " + " ".join(f"{value:12.9f}" for value in row) for row in one.rotation.T]
    if found.sigma0_mm is not None and np.isfinite(found.sigma0_mm):
        lines.append(f"sigma0 {found.sigma0_mm:.7g} mm, redundancy {found.redundancy}")
        if found.dispersion is not None:
            sigma = np.sqrt(np.diag(found.dispersion))
            sigma[3:] = np.degrees(sigma[3:])
            lines.append("standard deviations X0 Y0 Z0 " + " ".join(f"{value:.4g}" for value in sigma[:3]))
            lines.append("  omega phi kappa (deg)      " + " ".join(f"{value:.4g}" for value in sigma[3:]))
    if found.interior is not None:
        interior = _interior(found.interior)
        lines.append("interior " + ", ".join(f"{key} {value:.6g}" for key, value in interior.items()))
    if found.rejected is not None:
        lines.append(
            f"rejected {len(found.rejected)}: {', '.join(found.rejected)}"
            if found.rejected
            else "rejected none"
        )
    if found.history is not None:
        lines.append("history")
        for unknowns in found.history:
            values = [*unknowns[:3], *np.degrees(unknowns[3:])]
            lines.append("  " + " ".join(f"{value:14.8f}" for value in values))
    if found.warning:
        lines.append(f"warning: {found.warning}")
    return "\n".join(lines)


def _interior(found: DirectLinearTransformation) -> dict[str, float]:
    return {
        "c_mm": found.c,
        "x0_mm": float(found.principal_point[0]),
        "y0_mm": float(found.principal_point[1]),
        "affinity": found.affinity,
        "shear_deg": float(np.degrees(found.shear)),
    }


def _values(solution: ResectionSolution) -> tuple[float, ...]:
    """Return X0, Y0, Z0 and omega, phi, kappa in degrees."""
    return (*solution.position.tolist(), *np.degrees(angles_from_rotation(solution.rotation)).tolist())
