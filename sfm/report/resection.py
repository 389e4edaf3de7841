"""What `kolinear resect` prints: one method in full as JSON or text, or all methods side by side."""

from __future__ import annotations

from typing import Any

import numpy as np

from sfm.conventions import FloatArray, angles_from_rotation
from sfm.display import counted
from sfm.errors import GeometryError
from sfm.files.plain_text import or_none
from sfm.orientation.resection.candidates import ResectionSolution
from sfm.textbook.resection.by_method import Resected
from sfm.textbook.resection.dlt import DirectLinearTransformation


def resection_json(found: Resected, c: float) -> dict[str, Any]:
    """Return what one method finds, ready for JSON.

    Args:
        found: by `resection.by_method.resect`.
        c: principal distance, mm.

    Returns:
        method, points, solutions (best first: X0, Y0, Z0, omega_deg, phi_deg, kappa_deg, M, rms_mm) and,
        where they apply, sigma0_mm, redundancy, dispersion (object unit and deg), history, residuals_mm,
        line_fit, interior, rejected, trials, warning.
    """
    out: dict[str, Any] = {"method": found.method, "points": found.points}
    out["solutions"] = [_plain(solution, c) for solution in found.solutions]
    if found.line_fit:
        out["line_fit"] = [
            {"slope": line.slope, "intercept_mm": line.intercept * c, "scatter_mm": line.scatter * c}
            for line in found.line_fit
        ]
    if found.sigma0_mm is not None:
        out |= {"sigma0_mm": or_none(found.sigma0_mm), "redundancy": found.redundancy}
    if found.dispersion is not None:
        unit = np.array([1, 1, 1, *[np.degrees(1.0)] * 3])
        out["dispersion"] = _rows(found.dispersion * np.outer(unit, unit))
    if found.history is not None:
        history = found.history.copy()
        history[:, 3:] = np.degrees(history[:, 3:])
        out["history"] = history.tolist()
    if found.residuals_mm is not None:
        out["residuals_mm"] = _rows(found.residuals_mm)
    if found.interior is not None:
        out["interior"] = _interior(found.interior)
    if found.rejected is not None:
        out["rejected"] = list(found.rejected)
    if found.trials is not None:
        out["trials"] = found.trials
    if found.warning:
        out["warning"] = found.warning
    return out


def comparison_json(found: dict[str, Resected | GeometryError], c: float) -> list[dict[str, Any]]:
    """Return what all methods find, or why one finds nothing, ready for JSON; c in mm."""
    return [
        {"method": name, "error": str(one)} if isinstance(one, GeometryError) else resection_json(one, c)
        for name, one in found.items()
    ]


def comparison_table(found: dict[str, Resected | GeometryError], c: float) -> str:
    """Return what all methods find, or why one finds nothing, side by side; c in mm."""
    header = " ".join(
        [f"{'method':<16} no"]
        + [f"{name:>14}" for name in ("X0", "Y0", "Z0")]
        + [f"{name:>10}" for name in ("omega", "phi", "kappa", "rms mm")]
    )
    lines = [header, "-" * len(header)]
    for name, one in found.items():
        if isinstance(one, GeometryError):
            lines.append(f"{name:<16}  - {str(one).removeprefix(name + ': ')}")
            continue
        lines.extend(_row(name, k, _plain(each, c)) for k, each in enumerate(one.solutions, start=1))
        if one.warning:
            lines.append(f"{'':<16}  ! {one.warning}")
    return "\n".join(lines)


def resection_text(found: Resected, c: float) -> str:
    """Return what one method finds as text; c in mm."""
    lines = [f"{found.method}, {counted(found.points, 'point')}"]
    for k, solution in enumerate(found.solutions, start=1):
        one = _plain(solution, c)
        lines.append(f"solution {k}: rms {one['rms_mm']:.6f} mm")
        lines.append(f"  X0 Y0 Z0        {one['X0']:.8f} {one['Y0']:.8f} {one['Z0']:.8f}")
        lines.append(
            f"  omega phi kappa {one['omega_deg']:.7f} {one['phi_deg']:.7f} {one['kappa_deg']:.7f} deg"
        )
        lines += ["  M " + " ".join(f"{value:12.9f}" for value in row) for row in one["M"]]
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


def _plain(solution: ResectionSolution, c: float) -> dict[str, Any]:
    X0, Y0, Z0 = solution.position.tolist()
    omega, phi, kappa = np.degrees(angles_from_rotation(solution.rotation)).tolist()
    return {
        "X0": X0,
        "Y0": Y0,
        "Z0": Z0,
        "omega_deg": omega,
        "phi_deg": phi,
        "kappa_deg": kappa,
        "M": solution.rotation.T.tolist(),
        "rms_mm": solution.rms * c,
    }


def _rows(values: FloatArray) -> list[list[float | None]]:
    return [[or_none(value) for value in row] for row in values]


def _row(name: str, number: int, one: dict[str, Any]) -> str:
    angles = " ".join(f"{one[key]:10.5f}" for key in ("omega_deg", "phi_deg", "kappa_deg"))
    position = " ".join(f"{one[key]:14.6f}" for key in ("X0", "Y0", "Z0"))
    return f"{name if number == 1 else '':<16} {number:>2} {position} {angles} {one['rms_mm']:10.6f}"
