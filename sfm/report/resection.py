"""What `kolinear resect` says: one method in full as JSON or text, or all methods side by side."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from sfm.conventions import FloatArray, angles_from_rotation, rotation_from_angles
from sfm.errors import GeometryError
from sfm.files.plain_text import or_none
from sfm.orientation.resection import METHODS
from sfm.orientation.resection.candidates import (
    Solution,
    checked_points,
    choose_by_line,
    rotation_from_position,
)
from sfm.orientation.resection.church import resect_church
from sfm.orientation.resection.critical_cylinder import cylinder_warning
from sfm.orientation.resection.dlt import resect_dlt
from sfm.orientation.resection.fischler_bolles import resect_fischler_bolles
from sfm.orientation.resection.least_squares import resect_least_squares
from sfm.orientation.resection.p4p import resect_p4p
from sfm.orientation.resection.rampal import resect_rampal
from sfm.orientation.resection.ransac import resect_robust
from sfm.orientation.resection.zeng_wang import resect_zeng_wang
from sfm.survey.inputs.resection_points import Task

START_TOLERANCE = 0.1  # of c: what the start of least squares may be off
ALL_POINTS = 3  # fewest points of any method


def resect_json(task: Task, method: str) -> dict[str, Any]:
    """Return what one method finds, ready for JSON.

    Returns:
        method, points, solutions (best first: X0, Y0, Z0, omega_deg, phi_deg, kappa_deg, M, rms_mm) and,
        where they apply, sigma0_mm, redundancy, dispersion (object unit and deg), history, residuals_mm,
        line_fit, interior, rejected, trials, warning.

    Raises:
        GeometryError: unknown method, or the points do not allow it.
    """
    found = _run(task, method)
    solutions = tuple(s for s in found["solutions"] if np.isfinite(s.rms) or method == "robust")
    if not solutions:
        raise GeometryError(f"{method}: points lie behind the camera in every solution")
    out: dict[str, Any] = {"method": method, "points": len(task.points)}
    out["solutions"] = [_plain(solution, task.c) for solution in solutions]
    if len(task.points) >= 4 and method in ("fischler-bolles", "zeng-wang"):
        _, lines = choose_by_line(solutions, task.tangents)
        out["line_fit"] = [
            {
                "slope": line.slope,
                "intercept_mm": line.intercept * task.c,
                "scatter_mm": line.scatter * task.c,
            }
            for line in lines
        ]
    out.update({key: value for key, value in found.items() if key != "solutions"})
    if method in ("fischler-bolles", "church", "zeng-wang", "rampal"):
        warning = cylinder_warning(solutions[0].position, task.points[:3])
        if warning:
            out["warning"] = warning
    return out


def resect_table(task: Task, method: str) -> str:
    """Return what one method finds, or with "all" what all methods find, as text for people."""
    if method != "all":
        return "\n".join(_text_of(resect_json(task, method)))
    header = " ".join(
        [f"{'method':<16} no"]
        + [f"{name:>14}" for name in ("X0", "Y0", "Z0")]
        + [f"{name:>10}" for name in ("omega", "phi", "kappa", "rms mm")]
    )
    lines = [header, "-" * len(header)]
    if task.start is None:
        # as the comparison of document 001 does: Church starts from what Fischler-Bolles found
        with suppress(GeometryError):
            task = replace(task, start=resect_fischler_bolles(task.tangents, task.points)[0].position)
    for name in METHODS:
        try:
            found = resect_json(task, name)
        except GeometryError as error:
            lines.append(f"{name:<16}  - {str(error).removeprefix(name + ': ')}")
            continue
        lines.extend(_row(name, k, one) for k, one in enumerate(found["solutions"], start=1))
        if "warning" in found:
            lines.append(f"{'':<16}  ! {found['warning']}")
    return "\n".join(lines)


def _run(task: Task, method: str) -> dict[str, Any]:
    """Solutions of a method and what it knows beside them, under their JSON names."""
    match method:
        case "fischler-bolles":
            return {"solutions": resect_fischler_bolles(task.tangents, task.points)}
        case "p4p":
            return {"solutions": resect_p4p(task.tangents, task.points)}
        case "church":
            return _church(task)
        case "zeng-wang":
            return {"solutions": resect_zeng_wang(task.tangents, task.points)}
        case "rampal":
            return {"solutions": resect_rampal(task.tangents, task.points)}
        case "dlt":
            return _dlt(task)
        case "robust":
            return _robust(task)
        case "least-squares":
            return _least_squares(task)
    raise GeometryError(f"resect: method '{method}', expected one of {', '.join(METHODS)}, all")


def _church(task: Task) -> dict[str, Any]:
    if task.start is None:
        raise GeometryError("church: a start position is needed (--start X,Y,Z)")
    result = resect_church(task.tangents, task.points, task.start[:3])
    return {"solutions": (result.solution,), "history": result.history.tolist()}


def _dlt(task: Task) -> dict[str, Any]:
    checked_points("dlt", task.xy_mm, task.points, needed=6)
    result = resect_dlt(task.xy_mm, task.points)
    solution = Solution(result.position, result.rotation, result.residuals / task.c)
    interior = {
        "c_mm": result.c,
        "x0_mm": float(result.principal_point[0]),
        "y0_mm": float(result.principal_point[1]),
        "affinity": result.affinity,
        "shear_deg": float(np.degrees(result.shear)),
    }
    return {
        "solutions": (solution,),
        "sigma0_mm": or_none(result.sigma0),
        "redundancy": result.redundancy,
        "interior": interior,
    }


def _robust(task: Task) -> dict[str, Any]:
    uv, xyz = checked_points("robust", task.tangents, task.points, needed=4)
    result = resect_robust(uv, xyz, tolerance=task.tolerance_mm / task.c)
    if not result.found:
        raise GeometryError(f"robust: {result.reason}")
    fitting = Solution(result.position, result.rotation, result.residuals[result.inliers])
    return {
        "solutions": (fitting,),
        "sigma0_mm": or_none(result.sigma0 * task.c),
        "redundancy": int(2 * result.inliers.sum() - 6),
        "dispersion": _in_degrees(result.covariance),
        "residuals_mm": _rows(result.residuals * task.c),
        "rejected": [name for name, fits in zip(task.names, result.inliers, strict=True) if not fits],
        "trials": result.trials,
    }


def _least_squares(task: Task) -> dict[str, Any]:
    uv, xyz = checked_points("least-squares", task.tangents, task.points, needed=3)
    position, rotation = _start(task)
    result = resect_least_squares(uv, xyz, position, rotation)
    if not result.converged:
        raise GeometryError("least-squares: no convergence from this start, a nearer one is needed")
    history = result.history.copy()
    history[:, 3:] = np.degrees(history[:, 3:])
    return {
        "solutions": (Solution(result.position, result.rotation, result.residuals),),
        "sigma0_mm": or_none(result.sigma0 * task.c),
        "redundancy": result.redundancy,
        "dispersion": _in_degrees(result.covariance),
        "history": history.tolist(),
        "residuals_mm": _rows(result.residuals * task.c),
    }


def _start(task: Task) -> tuple[FloatArray, FloatArray]:
    """Start of least squares: as given, with the rotation from the rays if need be, or by P3P."""
    if task.start is None:
        if len(task.points) == ALL_POINTS:
            solution = resect_fischler_bolles(task.tangents, task.points)[0]
            return solution.position, solution.rotation
        result = resect_robust(task.tangents, task.points, tolerance=START_TOLERANCE)
        if not result.found:
            raise GeometryError(f"least-squares: no start found ({result.reason}), give one (--start)")
        return result.position, result.rotation
    if len(task.start) == 6:
        return task.start[:3], rotation_from_angles(*task.start[3:])
    return task.start, rotation_from_position(task.tangents, task.points, task.start)


def _plain(solution: Solution, c: float) -> dict[str, Any]:
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


def _in_degrees(covariance: FloatArray) -> list[list[float | None]]:
    unit = np.array([1, 1, 1, *[np.degrees(1.0)] * 3])
    return _rows(covariance * np.outer(unit, unit))


def _rows(values: FloatArray) -> list[list[float | None]]:
    return [[or_none(value) for value in row] for row in values]


def _row(name: str, number: int, one: dict[str, Any]) -> str:
    angles = " ".join(f"{one[key]:10.5f}" for key in ("omega_deg", "phi_deg", "kappa_deg"))
    position = " ".join(f"{one[key]:14.6f}" for key in ("X0", "Y0", "Z0"))
    return f"{name if number == 1 else '':<16} {number:>2} {position} {angles} {one['rms_mm']:10.6f}"


def _text_of(found: dict[str, Any]) -> list[str]:
    """Lines of the text report of one method."""
    lines = [f"{found['method']}, {found['points']} points"]
    for k, one in enumerate(found["solutions"], start=1):
        lines.append(f"solution {k}: rms {one['rms_mm']:.6f} mm")
        lines.append(f"  X0 Y0 Z0        {one['X0']:.8f} {one['Y0']:.8f} {one['Z0']:.8f}")
        lines.append(
            f"  omega phi kappa {one['omega_deg']:.7f} {one['phi_deg']:.7f} {one['kappa_deg']:.7f} deg"
        )
        lines += ["  M " + " ".join(f"{value:12.9f}" for value in row) for row in one["M"]]
    if found.get("sigma0_mm") is not None:
        lines.append(f"sigma0 {found['sigma0_mm']:.7g} mm, redundancy {found['redundancy']}")
        if "dispersion" in found:
            sigma = np.sqrt(np.diag(np.array(found["dispersion"], dtype=float)))
            lines.append("standard deviations X0 Y0 Z0 " + " ".join(f"{value:.4g}" for value in sigma[:3]))
            lines.append("  omega phi kappa (deg)      " + " ".join(f"{value:.4g}" for value in sigma[3:]))
    if found.get("interior"):
        lines.append(
            "interior " + ", ".join(f"{key} {value:.6g}" for key, value in found["interior"].items())
        )
    if "rejected" in found:
        rejected = found["rejected"]
        lines.append(f"rejected {len(rejected)}: {', '.join(rejected)}" if rejected else "rejected none")
    if "history" in found:
        lines.append("history")
        lines += ["  " + " ".join(f"{value:14.8f}" for value in row) for row in found["history"]]
    if "warning" in found:
        lines.append(f"warning: {found['warning']}")
    return lines
