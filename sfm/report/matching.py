"""Conjugate points for people: the table, JSON and the picture of `kolinear match`."""

from __future__ import annotations

import csv
import io
import json
import math
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sfm.conventions import AnyArray, FloatArray
from sfm.errors import GeometryError, OutputError, SurveyFileError
from sfm.matching.conjugate import ConjugatePoints, match_points
from sfm.matching.interpolation import resample
from sfm.targets.photograph import read_photograph

COLUMNS = (
    "point",
    "x_px",
    "y_px",
    "x_right_px",
    "y_right_px",
    "sx_px",
    "sy_px",
    "r",
    "r_second",
    "steps",
    "reason",
)
ZOOM = 8  # side of a pixel in the picture of patches, px
GAP = 4  # between the patches, px
NO_SECOND = -1.0  # r of the second-best place where there is none
MAX_PICTURES = 25  # points in one picture


def match_command(
    left_path: Path,
    right_path: Path,
    *,
    point: str | None = None,
    points: Path | None = None,
    method: str = "lsm",
    template_px: int = 21,
    search_px: int = 121,
    equalise: bool = False,
    interpolation: str = "six_tap",
    as_json: bool = False,
    out: Path | None = None,
    picture: Path | None = None,
) -> str:
    """Match points of two photograph files and return what the command line prints.

    Args:
        left_path, right_path: the photographs.
        point: "COL,ROW" in the left photograph, px; either this or `points`.
        points: table of points, see `read_points_to_match`.
        method, template_px, search_px, equalise, interpolation: see `sfm.matching.conjugate.match_points`.
        as_json: JSON in place of the table.
        out: file that gets the table as CSV (or JSON), in place of the terminal.
        picture: PNG file that gets template, matched patch and their difference.

    Raises:
        KolinearError: unreadable photographs, points or table, even windows, or files that cannot be written.
    """
    if (point is None) == (points is None):
        raise SurveyFileError("match: give either --point COL,ROW or --points FILE")
    if points is not None:
        names, xy, start = read_points_to_match(points)
    else:
        names, xy, start = ("1",), _parse_point(str(point)), None
    left, right = read_photograph(left_path), read_photograph(right_path)
    found = match_points(
        left,
        right,
        xy,
        xy_right=start,
        method=method,
        template_px=template_px,
        search_px=search_px,
        equalise=equalise,
        interpolation=interpolation,
    )
    if picture is not None:
        drawing = draw_patches(left, right, found, template_px)
        _write(picture, cv2.imencode(".png", drawing)[1].tobytes())
    if out is not None:
        _write(out, (matches_json(names, found) if as_json else matches_csv(names, found)).encode())
        return f"{int(found.good.sum())} of {len(found)} points matched: {out}\n"
    return matches_json(names, found) if as_json else matches_text(names, found)


def read_points_to_match(path: Path) -> tuple[tuple[str, ...], FloatArray, FloatArray | None]:
    """Read point,x_px,y_px[,x_right_px,y_right_px]; the last two are centres of the search windows.

    Returns:
        Names, left points (k, 2) and centres (k, 2) or None, px.

    Raises:
        SurveyFileError: unreadable, wrong columns, or not a finite number.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = [row for row in csv.reader(file) if any(cell.strip() for cell in row)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise SurveyFileError(f"{path}: the table of points cannot be read: {error}") from error
    header = tuple(cell.strip() for cell in rows[0]) if rows else ()
    needed = COLUMNS[:3], COLUMNS[:5]
    if header not in needed:
        raise SurveyFileError(
            f"{path}: columns {','.join(header) or 'none'}, needed "
            f"{' or '.join(','.join(columns) for columns in needed)}"
        )
    values = np.full((len(rows) - 1, len(header) - 1), np.nan)
    for k, row in enumerate(rows[1:]):
        with suppress(ValueError):
            values[k] = [float(cell) for cell in row[1:]]
        if not np.isfinite(values[k]).all():
            raise SurveyFileError(
                f"{path}, row {k + 2}: {','.join(row)!r:.60}, needed {len(header)} columns, finite"
            )
    return (
        tuple(row[0].strip() for row in rows[1:]),
        values[:, :2],
        values[:, 2:] if len(header) == 5 else None,
    )


def matches_text(names: tuple[str, ...], found: ConjugatePoints) -> str:
    """Return the results as an aligned table for the terminal."""
    rows = [
        ("point", "left px", "right px", "sigma px", "r", "second r", "steps", ""),
        *_text_rows(names, found),
    ]
    width = [max(len(row[c]) for row in rows) for c in range(len(rows[0]))]
    lines = ["  ".join(cell.rjust(w) for cell, w in zip(row[:-1], width, strict=False)) for row in rows]
    return "".join(f"{line}  {row[-1]}".rstrip() + "\n" for line, row in zip(lines, rows, strict=True))


def matches_csv(names: tuple[str, ...], found: ConjugatePoints) -> str:
    """Return the results as CSV, empty fields where there is nothing."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for name, row in zip(names, _values(found), strict=True):
        numbers = ["" if not math.isfinite(value) else f"{value:.6g}" for value in row[:-2]]
        writer.writerow([name, *numbers, int(row[-2]), row[-1]])
    return text.getvalue()


def matches_json(names: tuple[str, ...], found: ConjugatePoints) -> str:
    """Return the results as JSON, null where there is nothing."""
    entries = []
    for k, (name, row) in enumerate(zip(names, _values(found), strict=True)):
        clean = [None if isinstance(value, float) and not math.isfinite(value) else value for value in row]
        entry = dict(zip(COLUMNS, (name, *clean), strict=True))
        finite = np.isfinite(found.covariance[k]).all()
        entry["covariance_px2"] = found.covariance[k].tolist() if finite else None
        gain, offset = float(found.gain[k]), float(found.offset[k])
        entry["gain"], entry["offset"] = (v if math.isfinite(v) else None for v in (gain, offset))
        entries.append(entry)
    return json.dumps({"method": found.method, "points": entries}, indent=1, ensure_ascii=False) + "\n"


def draw_patches(left: AnyArray, right: AnyArray, found: ConjugatePoints, template_px: int) -> AnyArray:
    """Return template, matched patch (in the template's intensities) and difference, a row for each point.

    The difference is grey where there is none and saturates at a quarter of the scale of the template.
    """
    half = template_px // 2
    v, u = np.mgrid[-half : half + 1, -half : half + 1].astype(float)
    rows = []
    for k in np.flatnonzero(found.good)[:MAX_PICTURES]:
        template = resample(left, found.left[k] + np.stack([u, v], axis=-1), interpolation="bilinear")
        H = found.warp[k]
        w = H[2, 0] * u + H[2, 1] * v + H[2, 2]
        place = np.stack([(H[i, 0] * u + H[i, 1] * v + H[i, 2]) / w for i in range(2)], axis=-1)
        patch = (resample(right, place, interpolation="bilinear") - found.offset[k]) / found.gain[k]
        low, high = np.nanmin(template), np.nanmax(template)
        scale = 255.0 / max(high - low, 1e-6)
        panels = [(template - low) * scale, (patch - low) * scale, 128 + 4 * (patch - template) * scale]
        big = [
            cv2.resize(
                np.nan_to_num(p).clip(0, 255).astype(np.uint8), None, fx=ZOOM, fy=ZOOM, interpolation=0
            )
            for p in panels
        ]
        gap = np.full((big[0].shape[0], GAP), 255, np.uint8)
        rows += [
            np.hstack([big[0], gap, big[1], gap, big[2]]),
            np.full((GAP, 3 * len(big[0]) + 2 * GAP), 255, np.uint8),
        ]
    if not rows:
        raise GeometryError("match: no point was matched, there is nothing to draw")
    return np.vstack(rows[:-1])


def _values(found: ConjugatePoints) -> list[tuple[Any, ...]]:
    """Return the columns behind the name, one tuple for each point."""
    table = np.column_stack([found.left, found.right, found.sigma, found.correlation, found.second])
    return [
        (*row, int(s), why) for row, s, why in zip(table.tolist(), found.steps, found.reason, strict=True)
    ]


def _text_rows(names: tuple[str, ...], found: ConjugatePoints) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for name, row in zip(names, _values(found), strict=True):
        x, y, xr, yr, sx, sy, r, second, steps, why = row
        place = "-" if why else f"{xr:.3f}, {yr:.3f}"
        sigma = "-" if why else f"{sx:.4f}, {sy:.4f}"
        quality = f"{r:.4f}" if math.isfinite(float(r)) else "-"
        next_best = f"{second:.2f}" if second > NO_SECOND else "-"
        rows.append((name, f"{x:.2f}, {y:.2f}", place, sigma, quality, next_best, str(steps), str(why)))
    return rows


def _parse_point(text: str) -> FloatArray:
    try:
        xy = np.array([[float(part) for part in text.split(",")]])
    except ValueError:
        xy = np.zeros((1, 0))
    if xy.shape != (1, 2) or not np.isfinite(xy).all():
        raise SurveyFileError(f"match: --point {text!r}, needed COL,ROW such as 812.5,403")
    return xy


def _write(path: Path, data: bytes) -> None:
    try:
        path.write_bytes(data)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from error
