"""The table of `kolinear match` as text, CSV and JSON, and the files that it may replace."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from zlib import crc32

import cv2
import numpy as np

from sfm.conventions import AnyArray
from sfm.errors import OutputError
from sfm.files.whole_files import whole_file
from sfm.matching.conjugate_patches import ConjugatePoints
from sfm.report.page import Column, Table, plain

NO_SECOND = -1.0  # r of the second-best place where there is none
COLUMNS = (
    *(Column("point", "point"), Column(None, "x_px"), Column(None, "y_px"), Column("left px", format=str)),
    *(Column(None, "x_right_px"), Column(None, "y_right_px"), Column("right px", format=str)),
    *(Column(None, "sx_px"), Column(None, "sy_px"), Column("sigma px", format=str)),
    Column("r", "r", format=".4f", unknown="-"),
    Column("second r", "r_second", format=lambda r: f"{r:.2f}" if r > NO_SECOND else "-"),
    *(Column("steps", "steps", format=str), Column("", "reason")),
)
NAMES = tuple(one.name for one in COLUMNS if one.name)
TABLE_ENDINGS = (".csv", ".json")
PICTURE_ENDING = ".png"
PNG_HEAD = 33  # bytes of the signature and the first chunk (PNG specification, sec. 5.2 and 11.2.1)
MARK = b"Software\0kolinear match"  # text in a picture of this program (PNG specification, sec. 11.3.3)
LOOKED_AT = 4096  # bytes of an existing file by which it is recognised


def matches_table(names: tuple[str, ...], found: ConjugatePoints) -> Table:
    """Return the results, NaN where there is nothing."""
    values = np.column_stack([found.left, found.right, found.sigma, found.correlation, found.second])
    rows = []
    for name, row, steps, why in zip(names, values.tolist(), found.steps, found.reason, strict=True):
        x, y, x_right, y_right, sx, sy, r, second = row
        right, sigma = ("-", "-") if why else (f"{x_right:.3f}, {y_right:.3f}", f"{sx:.4f}, {sy:.4f}")
        left = f"{x:.2f}, {y:.2f}"
        rows.append((name, x, y, left, x_right, y_right, right, sx, sy, sigma, r, second, int(steps), why))
    return Table(COLUMNS, rows)


def matches_json(names: tuple[str, ...], found: ConjugatePoints) -> str:
    """Return the results as JSON, null where there is nothing."""
    beside = zip(matches_table(names, found).records, found.covariance, found.gain, found.offset, strict=True)
    entries = [
        entry | {"covariance_px2": Q if np.isfinite(Q).all() else None, "gain": gain, "offset": offset}
        for entry, Q, gain, offset in beside
    ]
    return json.dumps(plain({"method": found.method, "points": entries}), indent=1, ensure_ascii=False) + "\n"


def refuse_outputs(out: Path | None, picture: Path | None, inputs: tuple[Path, ...], as_json: bool) -> None:
    """Refuse outputs of another ending, and those that would take the place of anything but earlier ones.

    Args:
        out: table to be written, or None.
        picture: picture to be written, or None.
        inputs: files that are read.
        as_json: whether JSON is asked for.

    Raises:
        OutputError: with the option at fault, and what was found in its place.
    """
    if out is not None:
        endings = (".json",) if as_json else TABLE_ENDINGS
        _refuse_ending("--out", out, endings)
        _refuse_taken("--out", out, inputs, (",".join(NAMES).encode() + b"\n", b'{\n "method": '))
    if picture is not None:
        _refuse_ending("--picture", picture, (PICTURE_ENDING,))
        _refuse_taken("--picture", picture, inputs, ())


@contextmanager
def whole_outputs(out: Path | None, picture: Path | None) -> Iterator[tuple[Path | None, Path | None]]:
    """Give a table and a picture to write, which take their places when both are finished.

    Raises:
        OutputError: one of them cannot be written; none is then.
    """
    with ExitStack() as stack:
        yield (
            None if out is None else stack.enter_context(whole_file(out, replaces=True)),
            None if picture is None else stack.enter_context(whole_file(picture, replaces=True)),
        )


def picture_file(drawing: AnyArray) -> bytes:
    """Return a picture as PNG with the mark by which it is known again."""
    data = cv2.imencode(PICTURE_ENDING, drawing)[1].tobytes()
    return data[:PNG_HEAD] + _chunk(b"tEXt", MARK) + data[PNG_HEAD:]


def _chunk(kind: bytes, content: bytes) -> bytes:
    """Return a chunk of a PNG file with its check sum (PNG specification, sec. 5.3 and 5.5)."""
    return len(content).to_bytes(4, "big") + kind + content + crc32(kind + content).to_bytes(4, "big")


def _refuse_ending(option: str, path: Path, endings: tuple[str, ...]) -> None:
    if path.suffix.lower() not in endings:
        found = f"ends in '{path.suffix}'" if path.suffix else "has no ending"
        raise OutputError(f"{option} {path}: {found}, needed {' or '.join(endings)}")


def _refuse_taken(option: str, path: Path, inputs: tuple[Path, ...], heads: tuple[bytes, ...]) -> None:
    """Refuse an input, by whatever path, and anything that does not begin like an earlier output."""
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
