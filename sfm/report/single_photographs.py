"""Output of `kolinear match` and `kolinear resect`: tables, JSON, text and pictures."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from zlib import crc32

import cv2
import numpy as np

from sfm.files.whole_files import whole_file
from sfm.matching.conjugate_patches import ConjugatePoints
from sfm.model.conventions import AnyArray, angles_from_rotation
from sfm.model.display import counted
from sfm.model.errors import GeometryError, OutputError
from sfm.orientation.resection.least_squares import ResectionSolution
from sfm.report.page import Column, Table, plain
from sfm.textbook.resection.by_method import ResectionResult
from sfm.textbook.resection.dlt import DirectLinearTransformation

EXTERIOR = ("X0", "Y0", "Z0", "omega_deg", "phi_deg", "kappa_deg")
METHODS = (
    Column("method"),
    Column("no", format=str),
    Column("X0", format=".6f"),
    Column("Y0", format=".6f"),
    Column("Z0", format=".6f"),
    Column("omega", format=".5f"),
    Column("phi", format=".5f"),
    Column("kappa", format=".5f"),
    Column("rms mm", format=".6f"),
)
NO_SECOND = -1.0  # r of the second-best position if there is none
COLUMNS = (
    Column("point", "point"),
    Column(None, "x_px"),
    Column(None, "y_px"),
    Column("left px", format=str),
    Column(None, "x_right_px"),
    Column(None, "y_right_px"),
    Column("right px", format=str),
    Column(None, "sx_px"),
    Column(None, "sy_px"),
    Column("sigma px", format=str),
    Column("r", "r", format=".4f", unknown="-"),
    Column("second r", "r_second", format=lambda r: f"{r:.2f}" if r > NO_SECOND else "-"),
    Column("steps", "steps", format=str),
    Column("", "reason"),
)
NAMES = tuple(column.name for column in COLUMNS if column.name)
TABLE_ENDINGS = (".csv", ".json")
PICTURE_ENDING = ".png"
PNG_HEAD = 33  # bytes of the signature and the first chunk (PNG specification, sec. 5.2 and 11.2.1)
MARK = b"Software\0kolinear match"  # identifies pictures by this program (PNG specification, sec. 11.3.3)
LOOKED_AT = 4096  # bytes of an existing file that are checked


def matches_table(names: tuple[str, ...], matches: ConjugatePoints) -> Table:
    """Return the matches as a table, NaN for missing values."""
    values = np.column_stack(
        [matches.left, matches.right, matches.sigma, matches.correlation, matches.second]
    )
    rows = []
    for name, row, steps, why in zip(names, values.tolist(), matches.steps, matches.reason, strict=True):
        x, y, x_right, y_right, sx, sy, r, second = row
        right, sigma = ("-", "-") if why else (f"{x_right:.3f}, {y_right:.3f}", f"{sx:.4f}, {sy:.4f}")
        left = f"{x:.2f}, {y:.2f}"
        rows.append((name, x, y, left, x_right, y_right, right, sx, sy, sigma, r, second, int(steps), why))
    return Table(COLUMNS, rows)


def matches_json(names: tuple[str, ...], matches: ConjugatePoints) -> str:
    """Return the matches as JSON, null for missing values."""
    beside = zip(
        matches_table(names, matches).records, matches.covariance, matches.gain, matches.offset, strict=True
    )
    entries = [
        entry | {"covariance_px2": Q if np.isfinite(Q).all() else None, "gain": gain, "offset": offset}
        for entry, Q, gain, offset in beside
    ]
    return (
        json.dumps(
            plain({"method": matches.method, "points": entries}),
            indent=1,
            ensure_ascii=False,
            allow_nan=False,
        )
        + "\n"
    )


def refuse_outputs(out: Path | None, picture: Path | None, inputs: tuple[Path, ...], as_json: bool) -> None:
    """Refuse outputs with a wrong suffix, and outputs that would replace anything but earlier outputs.

    Args:
        out: table to be written, or None.
        picture: picture to be written, or None.
        inputs: files that are read.
        as_json: whether JSON is requested.

    Raises:
        OutputError: with the option at fault, and what was found at its path.
    """
    if out is not None:
        endings = (".json",) if as_json else TABLE_ENDINGS
        _refuse_ending("--out", out, endings)
        _refuse_existing("--out", out, inputs, (",".join(NAMES).encode() + b"\n", b'{\n "method": '))
    if picture is not None:
        _refuse_ending("--picture", picture, (PICTURE_ENDING,))
        _refuse_existing("--picture", picture, inputs, ())


@contextmanager
def whole_outputs(out: Path | None, picture: Path | None) -> Iterator[tuple[Path | None, Path | None]]:
    """Yield temporary paths for a table and a picture, which replace the final files when both are finished.

    Raises:
        OutputError: one of them cannot be written; then neither is.
    """
    with ExitStack() as stack:
        yield (
            None if out is None else stack.enter_context(whole_file(out, replaces=True)),
            None if picture is None else stack.enter_context(whole_file(picture, replaces=True)),
        )


def picture_file(drawing: AnyArray) -> bytes:
    """Return a picture as PNG with a mark that identifies it."""
    data = cv2.imencode(PICTURE_ENDING, drawing)[1].tobytes()
    return data[:PNG_HEAD] + _chunk(b"tEXt", MARK) + data[PNG_HEAD:]


def _chunk(kind: bytes, content: bytes) -> bytes:
    """Return a chunk of a PNG file with its check sum (PNG specification, sec. 5.3 and 5.5)."""
    return len(content).to_bytes(4, "big") + kind + content + crc32(kind + content).to_bytes(4, "big")


def _refuse_ending(option: str, path: Path, endings: tuple[str, ...]) -> None:
    if path.suffix.lower() not in endings:
        ending = f"ends in '{path.suffix}'" if path.suffix else "has no ending"
        raise OutputError(f"{option} {path}: {ending}, needed {' or '.join(endings)}")


def _refuse_existing(option: str, path: Path, inputs: tuple[Path, ...], heads: tuple[bytes, ...]) -> None:
    """Refuse an input, by any path, and a file that does not begin like an earlier output."""
    if not path.exists() and not path.is_symlink():
        return
    for given in inputs:
        if path.exists() and given.exists() and path.samefile(given):
            raise OutputError(f"{option} {path}: is the input {given}, which is not written over")
    if not path.is_file():
        raise OutputError(f"{option} {path}: exists and is not a file")
    with path.open("rb") as file:
        begin = file.read(LOOKED_AT)
    earlier = begin.startswith(heads) if heads else begin[PNG_HEAD:].startswith(_chunk(b"tEXt", MARK))
    if not earlier:
        raise OutputError(f"{option} {path}: exists and was not written by kolinear match")


def resection_json(result: ResectionResult, c: float, photograph: str = "") -> dict[str, Any]:
    """Return the result of one method, ready for JSON.

    Args:
        result: result of `resection.by_method.resect`.
        c: principal distance, mm.
        photograph: its name, if it has one.

    Returns:
        photograph, method, points, solutions (best first: X0, Y0, Z0, omega_deg, phi_deg, kappa_deg, M,
        rms_mm) and, if they apply, sigma0_mm, redundancy, dispersion (object unit and deg), history,
        residuals_mm, line_fit, interior, rejected, trials, warning.
    """
    unit = np.array([1, 1, 1, *[np.degrees(1.0)] * 3])
    lines = result.line_fit or ()
    known = {
        "photograph": photograph or None,
        "method": result.method,
        "points": result.points,
        "solutions": [
            dict(zip(EXTERIOR, _values(solution), strict=True))
            | {"M": solution.rotation.T, "rms_mm": solution.rms * c}
            for solution in result.solutions
        ],
        "line_fit": [
            {"slope": line.slope, "intercept_mm": line.intercept * c, "scatter_mm": line.scatter * c}
            for line in lines
        ]
        or None,
        "sigma0_mm": result.sigma0_mm,
        "redundancy": None if result.sigma0_mm is None else result.redundancy,
        "dispersion": None if result.dispersion is None else result.dispersion * np.outer(unit, unit),
        "history": None if result.history is None else result.history * unit[: result.history.shape[1]],
        "residuals_mm": result.residuals_mm,
        "interior": None if result.interior is None else _interior(result.interior),
        "rejected": result.rejected,
        "trials": result.trials,
        "warning": result.warning or None,
    }
    return {name: plain(value) for name, value in known.items() if value is not None}


def comparison_json(results: dict[str, ResectionResult | GeometryError], c: float) -> list[dict[str, Any]]:
    """Return the results of all methods, or the reason for no result, ready for JSON; c in mm."""
    return [
        {"method": name, "error": str(result)}
        if isinstance(result, GeometryError)
        else resection_json(result, c)
        for name, result in results.items()
    ]


def comparison_table(results: dict[str, ResectionResult | GeometryError], c: float) -> str:
    """Return the results of all methods in a table, and below it the reasons for no result; c in mm."""
    rows, remarks = [], []
    for name, result in results.items():
        if isinstance(result, GeometryError):
            remarks.append(f"{name}: {str(result).removeprefix(f'{name}: ')}\n")
            continue
        rows += [
            (name, k, *_values(solution), solution.rms * c)
            for k, solution in enumerate(result.solutions, start=1)
        ]
        if result.warning:
            remarks.append(f"{name}: {result.warning}\n")
    return (Table(METHODS, rows).text + "".join(remarks)).rstrip("\n")


def resection_text(result: ResectionResult, c: float) -> str:
    """Return the result of one method as text; c in mm."""
    lines = [f"{result.method}, {counted(result.points, 'point')}"]
    for k, solution in enumerate(result.solutions, start=1):
        X0, Y0, Z0, omega, phi, kappa = _values(solution)
        lines.append(f"solution {k}: rms {solution.rms * c:.6f} mm")
        lines.append(f"  X0 Y0 Z0        {X0:.8f} {Y0:.8f} {Z0:.8f}")
        lines.append(f"  omega phi kappa {omega:.7f} {phi:.7f} {kappa:.7f} deg")
        lines += ["  M " + " ".join(f"{value:12.9f}" for value in row) for row in solution.rotation.T]
    if result.sigma0_mm is not None and np.isfinite(result.sigma0_mm):
        lines.append(f"sigma0 {result.sigma0_mm:.7g} mm, redundancy {result.redundancy}")
        if result.dispersion is not None:
            sigma = np.sqrt(np.diag(result.dispersion))
            sigma[3:] = np.degrees(sigma[3:])
            lines.append("standard deviations X0 Y0 Z0 " + " ".join(f"{value:.4g}" for value in sigma[:3]))
            lines.append("  omega phi kappa (deg)      " + " ".join(f"{value:.4g}" for value in sigma[3:]))
    if result.interior is not None:
        interior = _interior(result.interior)
        lines.append("interior " + ", ".join(f"{key} {value:.6g}" for key, value in interior.items()))
    if result.rejected is not None:
        lines.append(
            f"rejected {len(result.rejected)}: {', '.join(result.rejected)}"
            if result.rejected
            else "rejected none"
        )
    if result.history is not None:
        lines.append("history")
        for unknowns in result.history:
            values = [*unknowns[:3], *np.degrees(unknowns[3:])]
            lines.append("  " + " ".join(f"{value:14.8f}" for value in values))
    if result.warning:
        lines.append(f"warning: {result.warning}")
    return "\n".join(lines)


def _interior(transformation: DirectLinearTransformation) -> dict[str, float]:
    return {
        "c_mm": transformation.c,
        "x0_mm": float(transformation.principal_point[0]),
        "y0_mm": float(transformation.principal_point[1]),
        "affinity": transformation.affinity,
        "shear_deg": float(np.degrees(transformation.shear)),
    }


def _values(solution: ResectionSolution) -> tuple[float, ...]:
    """Return X0, Y0, Z0 and omega, phi, kappa in degrees."""
    return (*solution.position.tolist(), *np.degrees(angles_from_rotation(solution.rotation)).tolist())
