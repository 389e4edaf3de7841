"""Values as files hold them: numbers with the digits that give them back, names as plain text."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence

import numpy as np

MAX_NAME = 500  # characters of a name that is read from a file


def or_none(value: float) -> float | None:
    """Return a number for JSON, which knows no NaN and no infinity."""
    return float(value) if math.isfinite(value) else None


def csv_text(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table as CSV."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(header)
    writer.writerows([_cell(value) for value in row] for row in rows)
    return buffer.getvalue()


def is_plain(text: str) -> bool:
    """Whether a name is fit for tables and terminals: no control characters, nothing that UTF-8 lacks.

    On Linux the name of a file is any bytes; those that are no UTF-8 come as lone surrogates (PEP 383).
    """
    return not any(ord(c) < 32 or 127 <= ord(c) < 160 or 0xD800 <= ord(c) < 0xE000 for c in text)


def as_plain(text: str) -> str:
    """Return a text with what is not plain in it written out, as \\xff or \\n."""
    return "".join(c if is_plain(c) else repr(c)[1:-1].replace("\\udc", "\\x") for c in text)


def _cell(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, float | np.floating):
        return repr(float(value)) if math.isfinite(value) else ""
    return str(value)
