"""Values as files hold them: numbers with the digits that give them back, names as plain text.

Spreadsheets compute cells that begin with =, +, @ or a - that begins no number, after spaces, too, and
some begin a cell after each semicolon. In every such place of a text an apostrophe is put before it where CSV
is written, and taken away where it is read; apostrophes that are there already get one more, so that texts
come back as they were. Control characters (a tab or carriage return begins formulas, too) are no part of
names, and written out in other texts.

Source: OWASP, "CSV Injection"; Unicode Standard 15, property Default_Ignorable_Code_Point, and UAX 9 for
bidirectional characters.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from itertools import islice
from typing import cast

import numpy as np

MAX_NAME = 500  # characters of a name that is read from a file
BLOCK = 10_000  # rows that are written at a time
SHOWN = 40  # characters of what was found that a message repeats

# Invisible characters, and those that change how the text around them is seen: categories Cc, Cf, Cs, Zl and
# Zp, and all else that is ignored by default.
_HIDDEN = re.compile(
    r"[\x00-\x1f\x7f-\x9f\xad\u034f\u0600-\u0605\u061c\u06dd\u070f\u0890\u0891\u08e2\u115f\u1160\u17b4\u17b5"
    r"\u180b-\u180f\u200b-\u200f\u2028-\u202e\u2060-\u206f\u3164\ud800-\udfff\ufe00-\ufe0f\ufeff\uffa0"
    r"\ufff0-\ufffb\U000110bd\U000110cd\U00013430-\U0001343f\U0001bca0-\U0001bca3\U0001d173-\U0001d17a"
    r"\U000e0000-\U000e0fff]"
)
_START = r"(\A|;)"  # of a cell, also where a spreadsheet separates cells by semicolons
_NUMBER = r"\d+(?:\.\d*)?(?:[eE][-+]?\d+)? *(?:\Z|;)"
_FORMULA = (
    rf"('*\s*(?:[=+@\uff1d\uff0b\uff20]|[-\uff0d](?!{_NUMBER})))"  # also in the width of Chinese letters
)
_BARE, _QUOTED = re.compile(_START + _FORMULA), re.compile(_START + "'" + _FORMULA)


def or_none(value: float) -> float | None:
    """Return a number for JSON, which knows no NaN and no infinity."""
    return float(value) if math.isfinite(value) else None


def csv_text(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table as CSV (RFC 4180), each row as long as the header."""
    return "".join(csv_blocks(header, rows))


def csv_blocks(header: Sequence[str], rows: Iterable[Sequence[object]]) -> Iterator[str]:
    """Yield a table as CSV, block by block of its rows, see `csv_text`.

    Column by column, since a survey of natural texture has millions of cells, most of them numbers.
    """
    yield ",".join(map(_quoted, header)) + "\n"
    rows = iter(rows)
    while block := list(islice(rows, BLOCK)):
        columns = [_column(values) for values in zip(*block, strict=True)]
        if len(columns) == 1:
            columns = [[cell or '""' for cell in columns[0]]]  # an empty line is no row
        yield "\n".join(map(",".join, zip(*columns, strict=True))) + "\n"


def as_cell(text: str) -> str:
    """Return a text with an apostrophe before everything in it that a spreadsheet takes for a formula."""
    return _BARE.sub(r"\1'\2", text)


def from_cell(cell: str) -> str:
    """Return the text that `as_cell` has made this of."""
    return _QUOTED.sub(r"\1\2", cell)


def is_plain(text: str) -> bool:
    """Whether a name is fit for tables and terminals: no control, bidirectional or invisible characters.

    On Linux the name of a file is any bytes; those that are no UTF-8 come as lone surrogates (PEP 383), which
    are none of these either.
    """
    return _HIDDEN.search(text) is None


def is_name(text: str) -> bool:
    """Whether a text is fit for a name that is read from a file."""
    return 0 < len(text) <= MAX_NAME and is_plain(text)


def shown(text: str) -> str:
    """Return the beginning of a text as a message can repeat it."""
    return as_plain(text[:SHOWN])


def as_plain(text: str) -> str:
    r"""Return a text with what is not plain in it written out, as \xff or \n."""
    return _HIDDEN.sub(lambda found: ascii(found[0])[1:-1].replace("\\udc", "\\x"), text)


def _column(values: Sequence[object]) -> list[str]:
    """Return the cells of a column."""
    if all(type(value) is float for value in values):
        numbers = cast(Sequence[float], values)
        return [repr(value) if value - value == 0 else "" for value in numbers]  # neither NaN nor infinite
    return [_cell(value) for value in values]


def _quoted(cell: str) -> str:
    """Return a cell in quotes, if it needs them."""
    return '"' + cell.replace('"', '""') + '"' if "," in cell or '"' in cell else cell


def _cell(value: object) -> str:
    """Return the text as it is in the table."""
    if isinstance(value, str):
        return _text_cell(value)
    if isinstance(value, float | np.floating):
        return repr(float(value)) if math.isfinite(value) else ""
    return "" if value is None else str(value)


@lru_cache(maxsize=4096)
def _text_cell(text: str) -> str:
    """Return the cell of a text; most are names of photographs that are in thousands of rows."""
    return _quoted(as_cell(as_plain(text)))
