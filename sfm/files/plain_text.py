"""Numbers and names as plain text, and JSON and TOML from untrusted files.

Spreadsheets compute cells that begin with =, +, @ or a - that does not begin a number, even after spaces.
Some also begin a new cell after each semicolon. Writing CSV inserts an apostrophe at every such position of a
text, and reading removes it. Existing apostrophes get one more, so that texts are restored exactly. Control
characters are not allowed in names, since a tab or carriage return also begins formulas. In other texts they
are written as escapes.

Source: OWASP, "CSV Injection"; Unicode Standard 15, property Default_Ignorable_Code_Point, and UAX 9 for
bidirectional characters.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Collection, Iterable, Iterator, Sequence
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    StrictStr,
    StringConstraints,
    ValidationError,
)
from pydantic_core import to_json

from sfm.model.conventions import AnyArray
from sfm.model.errors import SurveyFileError

MAX_TOML_BYTES = 1_000_000  # people write such files; a larger file is something else
MAX_SAID = 200  # characters of the parser's message
MAX_KEY_PARTS = 16  # of a dotted key: time and memory of the parser grow with their square; 3 are useful
# Usual mistakes in TOML: (pattern of the line, advice).
SLIPS = (
    (
        re.compile(r"=\s*(?:[-+]?\d+,\d+\s*(?:#.*)?$|\[[^\]\"']*\d,0\d)"),
        "a number has a decimal point, not a comma",
    ),
    (re.compile("[\u201c\u201d\u201e\u2018\u2019]"), "text must be in straight quotation marks, \" or '"),
    (re.compile(r'"[^"\n]*\\[^"\n]*"'), "write / in a path, or put it between single quotation marks"),
    (re.compile(r"=\s*(?:True|False|yes|no|on|off)\b", re.IGNORECASE), "write true or false"),
    (re.compile(r"^\s*\[{1,2}[^\]]*$|^\s*\[\[[^\]]*\][^\]]*$"), "a section must be in [ ] or [[ ]]"),
    (re.compile(r"=\s*(?:#.*)?$"), "no value follows the ="),
    (re.compile(r"=\s*[^\W\d][^\"']*$"), "text must be in quotation marks"),
    (re.compile(r"^[^=\[#]+$"), "neither a section in [ ] nor a key with = and its value"),
)
_SECTION = re.compile(r"^\s*\[{1,2}\s*([^\[\]]+?)\s*\]{1,2}\s*(?:#.*)?$")
_PART = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(rf"(?<![\w-]){_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{{MAX_KEY_PARTS}}}")
MAX_JSON_BYTES = 100_000_000  # names of four million points, for which reading takes 2 GB
MAX_SIDE_PX = 1_000_000  # of a photograph; no sensor or scan is larger
MAX_PIXEL_MM = 1e3  # of a pixel; it is 1 mm for COLMAP's models without a pixel size
MAX_NAME = 500  # characters of a name in a file
BLOCK = 10_000  # rows that are written at a time
SHOWN = 40  # characters of a found value that an error message repeats
# Invisible characters, and characters that change the display of the text around them: categories Cc, Cf, Cs,
# Zl and Zp, and all others that are ignorable by default.
_HIDDEN = re.compile(
    r"[\x00-\x1f\x7f-\x9f\xad\u034f\u0600-\u0605\u061c\u06dd\u070f\u0890\u0891\u08e2\u115f\u1160\u17b4\u17b5"
    r"\u180b-\u180f\u200b-\u200f\u2028-\u202e\u2060-\u206f\u3164\ud800-\udfff\ufe00-\ufe0f\ufeff\uffa0"
    r"\ufff0-\ufffb\U000110bd\U000110cd\U00013430-\U0001343f\U0001bca0-\U0001bca3\U0001d173-\U0001d17a"
    r"\U000e0000-\U000e0fff]"
)
_START = r"(\A|;)"  # of a cell; some spreadsheets separate cells by semicolons
_NUMBER = r"\d+(?:\.\d*)?(?:[eE][-+]?\d+)? *(?:\Z|;)"
_FORMULA = rf"('*\s*(?:[=+@\uff1d\uff0b\uff20]|[-\uff0d](?!{_NUMBER})))"  # including full-width characters
_BARE, _QUOTED = re.compile(_START + _FORMULA), re.compile(_START + "'" + _FORMULA)


def or_none(value: float) -> float | None:
    """Return a number for JSON, which has no NaN or infinity, or None."""
    return float(value) if math.isfinite(value) else None


def csv_text(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table as CSV (RFC 4180).

    Args:
        header: names of the columns.
        rows: rows of cells, each as long as the header.
    """
    return "".join(csv_blocks(header, rows))


def csv_blocks(header: Sequence[str], rows: Iterable[Sequence[object]]) -> Iterator[str]:
    """Yield a table as CSV in blocks of rows, see `csv_text`.

    Cells are converted column by column, since a survey of natural texture has millions of cells, most of
    them numbers.

    Args:
        header: names of the columns.
        rows: rows of cells, each as long as the header.
    """
    yield ",".join(map(_quoted, header)) + "\n"
    rows = iter(rows)
    while block := list(islice(rows, BLOCK)):
        yield _block([_column(values) for values in zip(*block, strict=True)])


def csv_blocks_of_columns(
    header: Sequence[str], columns: Sequence[Sequence[object] | AnyArray]
) -> Iterator[str]:
    """Yield a table as CSV in blocks of rows, from its columns, see `csv_blocks`.

    Args:
        header: names of the columns.
        columns: values of each column, as many in each.
    """
    yield ",".join(map(_quoted, header)) + "\n"
    for first in range(0, len(columns[0]) if columns else 0, BLOCK):
        yield _block([_column(values[first : first + BLOCK]) for values in columns])


def _block(columns: list[list[str]]) -> str:
    """Return rows of cells as lines of CSV."""
    if len(columns) == 1:
        columns = [[cell or '""' for cell in columns[0]]]  # an empty line would not be a row
    return "\n".join(map(",".join, zip(*columns, strict=True))) + "\n"


def is_word(text: str) -> bool:
    """Return whether a text has ASCII letters and digits only, so that it is its own cell."""
    return text.isascii() and text.isalnum()


def as_cell(text: str) -> str:
    """Return a text with an apostrophe before every part that a spreadsheet would take as a formula."""
    return _BARE.sub(r"\1'\2", text)


def from_cell(cell: str) -> str:
    """Return the original text of a cell from `as_cell`."""
    return _QUOTED.sub(r"\1\2", cell)


def is_plain(text: str) -> bool:
    """Return whether a name suits tables and terminals: no control, bidirectional or invisible characters.

    On Linux a file name may have any bytes. Bytes that are not UTF-8 appear as lone surrogates (PEP 383),
    which are not plain either.
    """
    return _HIDDEN.search(text) is None


def is_name(text: str) -> bool:
    """Return whether a text is acceptable as a name from a file."""
    return 0 < len(text) <= MAX_NAME and is_plain(text)


def shorten(text: str) -> str:
    """Return the beginning of a text, for an error message."""
    return as_plain(text[:SHOWN])


def as_plain(text: str) -> str:
    r"""Return a text with its characters that are not plain written as escapes, such as \xff or \n."""
    return _HIDDEN.sub(lambda hidden: ascii(hidden[0])[1:-1].replace("\\udc", "\\x"), text)


def _column(values: Sequence[object] | AnyArray) -> list[str]:
    """Return the cells of a column."""
    values = values.tolist() if isinstance(values, np.ndarray) else values
    kinds = set(map(type, values))
    if kinds == {float}:
        return _number_cells(cast(Sequence[float], values))
    if kinds == {int}:
        return list(map(str, values))
    if kinds == {str}:
        texts = cast(Sequence[str], values)
        cell_of = {text: text if is_word(text) else _text_cell(text) for text in set(texts)}
        return list(map(cell_of.__getitem__, texts))
    return [_cell(value) for value in values]


def _quoted(cell: str) -> str:
    """Return a cell, in quotes if it needs them."""
    return '"' + cell.replace('"', '""') + '"' if "," in cell or '"' in cell else cell


def _number_cells(numbers: Sequence[float]) -> list[str]:
    """Return the cells of numbers, with all digits that tell them from others; empty if not finite."""
    cells = str(to_json(numbers, inf_nan_mode="null"), "ascii")[1:-1].split(",")
    return ["" if cell == "null" else cell for cell in cells] if "null" in cells else cells


def _cell(value: object) -> str:
    """Return the cell of a value."""
    if isinstance(value, str):
        return _text_cell(value)
    if isinstance(value, float | np.floating):
        return _number_cells([float(value)])[0]
    return "" if value is None else str(value)


@lru_cache(maxsize=4096)
def _text_cell(text: str) -> str:
    """Return the cell of a text; cached, since names of photographs are in thousands of rows."""
    return _quoted(as_cell(as_plain(text)))


def _plain(text: str) -> str:
    if not is_plain(text):
        raise ValueError("plain text without control or invisible characters")
    return text


Text = Annotated[StrictStr, StringConstraints(max_length=MAX_NAME), AfterValidator(_plain)]
Name = Annotated[Text, StringConstraints(min_length=1)]
Side = Annotated[int, Field(ge=1, le=MAX_SIDE_PX, strict=True)]
Pixel = Annotated[FiniteFloat, Field(gt=0, le=MAX_PIXEL_MM, strict=True)]


class Content(BaseModel):
    """The declared part of a file; the rest is ignored."""

    model_config = ConfigDict(extra="ignore", frozen=True)


ContentT = TypeVar("ContentT", bound=Content)


def read_json(path: Path, content: type[ContentT], what: str) -> ContentT:
    """Read and check a JSON file.

    Args:
        path: the file.
        content: declaration of its content.
        what: name of such a file with its article, for error messages.

    Raises:
        SurveyFileError: the file is unreadable, too large or not JSON, or a value is not as declared.
    """
    try:
        size = path.stat().st_size
        if size > MAX_JSON_BYTES:
            raise SurveyFileError(f"{path}: {size} bytes, at most {MAX_JSON_BYTES} are read")
        return content.model_validate_json(path.read_bytes())
    except OSError as error:
        raise SurveyFileError(f"{path}: cannot be read ({error.strerror})") from error
    except ValidationError as error:
        raise SurveyFileError(_first_error(path, error, what)) from error


def _first_error(path: Path, error: ValidationError, what: str) -> str:
    """Describe the first error: its position, the value found, and the value needed."""
    first = error.errors(include_url=False)[0]
    message = " ".join(first["msg"].split())
    if first["type"] == "json_invalid":
        line = re.search(r" at line (\d+) column \d+$", message)
        number, reason = (line[1], message[: line.start()]) if line else ("1", message)
        return f"{path}, line {number}: not {what} ({as_plain(reason)})"
    place = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in first["loc"]).lstrip(".")
    place = as_plain(place[:MAX_NAME])
    if first["type"] == "missing":
        return f"{path}: {place} is missing, which {what} needs"
    given = " ".join(as_plain(repr(first["input"])[: SHOWN + 1]).split())
    given = given if len(given) <= SHOWN else given[:SHOWN] + "..."
    needed = message.removeprefix("Input should be ").removeprefix("Value error, ")
    return f"{path}: {place or 'the content'} is {given}, needed {needed}"


def read_toml(path: Path, what: str, *, repeated: Collection[str] = ()) -> tuple[str, dict[str, Any]]:
    """Return the text of a TOML file and its table.

    Args:
        path: the file.
        what: name of such a file with its article, for error messages.
        repeated: sections that may occur several times, each in [[ ]].

    Raises:
        SurveyFileError: the file is unreadable, too large, or not TOML.
    """
    try:
        if path.exists() and not path.is_file():  # reading a pipe would never end
            raise SurveyFileError(f"{path}: not a file, {what} (TOML) is needed")
        size = path.stat().st_size
        if size > MAX_TOML_BYTES:
            raise SurveyFileError(f"{path}: {size} bytes, {what} has at most {MAX_TOML_BYTES}")
        text = path.read_text(encoding="utf-8-sig")  # editors on Windows write a byte order mark
    except OSError as error:
        raise SurveyFileError(f"{path}: {what} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise SurveyFileError(
            f"{path}: not a text file in UTF-8 (byte {error.start}); save it as such"
        ) from error
    long = _LONG_KEY.search(text)
    if long:
        line = text.count("\n", 0, long.start()) + 1
        raise SurveyFileError(f"{path}, line {line}: more than {MAX_KEY_PARTS} words joined by dots")
    try:
        return text, tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SurveyFileError(f"{path}{_advice_on_mistake(text, str(error), repeated)}") from error
    except (ValueError, RecursionError) as error:
        reason = "brackets nested too deeply" if isinstance(error, RecursionError) else "a number is too long"
        raise SurveyFileError(f"{path}: not a TOML file: {reason}") from error


def _advice_on_mistake(text: str, message: str, repeated: Collection[str]) -> str:
    """Return position and advice for a usual mistake; for others the message of the parser."""
    position = re.search(r"\(at line (\d+), column \d+\)$", message)
    number = int(position[1]) if position else 0
    line = text.splitlines()[number - 1] if 0 < number <= text.count("\n") + 1 else ""
    if (section := _SECTION.match(line)) and message.startswith(("Cannot declare", "Cannot overwrite")):
        sections = (_SECTION.match(earlier) for earlier in text.splitlines()[: number - 1])
        name = section[1]
        first = next((k for k, other in enumerate(sections, 1) if other and other[1] == name), None)
        shown = as_plain(name[:MAX_SAID])
        where = "" if first is None else f", first in line {first}"
        write = f"write [[{shown}]] above each" if name in repeated else "put its keys into one section"
        return f", line {number}: [{shown}] is there twice{where}; {write}"
    if message.startswith("Cannot overwrite a value"):
        return f", line {number}: {as_plain(line.partition('=')[0].strip()[:MAX_SAID])} is there twice"
    for looks, write in SLIPS if len(line) <= MAX_SAID else ():
        if looks.search(line):
            return f", line {number}: {as_plain(line.strip())}: {write}"
    if len(message) > MAX_SAID:  # a long key; the end states the position
        message = f"{message[: MAX_SAID // 2]} ... {message[-MAX_SAID // 2 :]}"
    return f": not a TOML file: {as_plain(message)}"
