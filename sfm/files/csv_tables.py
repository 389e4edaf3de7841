"""CSV tables with named columns, read as untrusted files, and point clouds written as PLY.

The size of a table is checked before memory is allocated. Every error message states the line and the column.

Source: RFC 4180; Turk, The PLY polygon file format (1994).
"""

from __future__ import annotations

import csv
import math
import sys
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from operator import itemgetter
from pathlib import Path
from typing import TextIO

import numpy as np

from sfm.files.plain_text import MAX_NAME, as_plain, from_cell, is_plain, is_word
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.display import counted
from sfm.model.errors import OutputError, SurveyFileError

SIGMAS = ("sx", "sy", "sz")
COLOURS = ("red", "green", "blue")
# Enough for the largest networks that are adjusted here; each row takes about 100 bytes of memory.
MAX_TABLE_BYTES = 2_000_000_000
MAX_ROWS = 20_000_000
MAX_LINE = 10_000  # characters
COMMENT = "# "  # begins a line above the header
MAX_NUMBER = 1e12  # no length, angle or pixel is larger; squares and products of larger numbers overflow


@dataclass(frozen=True)
class CsvTable:
    """Columns of a CSV file or of arrays, with the position of each row for error messages."""

    path: Path  # path of the file, or name of the arrays
    names: tuple[str, ...]  # names of the columns of text
    texts: tuple[tuple[str, ...], ...]  # one tuple per column of text
    values: FloatArray  # columns of numbers, (rows, columns)
    line: IntArray  # line of each row in the file, (rows,)
    word: str = "line"  # "line" for files, "row" for arrays
    numbers: tuple[str, ...] = ()  # names of the columns of numbers

    def place(self, row: int) -> str:
        """Return the position of a row, for error messages."""
        return f"{self.path}, {self.word} {self.line[row]}"

    def keys(self, column: str) -> tuple[str, ...]:
        """Return a column of unique names; raise SurveyFileError if a name occurs twice."""
        values = self.texts[self.names.index(column)]
        self.refuse_duplicates(values, (column,))
        return values

    def places(self, column: str, known: Sequence[str], source: str, *, what: str = "") -> IntArray:
        """Return the index of each name of a column in a list from another file, (rows,).

        Args:
            column: a column of names.
            known: all known names.
            source: file of the known names, for the error message.
            what: what the names stand for, for the error message; the name of the column if not given.

        Raises:
            SurveyFileError: a name is unknown.
        """
        place = {name: k for k, name in enumerate(known)}
        names = self.texts[self.names.index(column)]
        for k, name in enumerate(names):
            if name not in place:
                raise SurveyFileError(f"{self.place(k)}: {what or column} '{name}' is not in {source}")
        return np.array([place[name] for name in names], dtype=np.int64)

    def part(self, names: tuple[str, ...]) -> FloatArray:
        """Return columns of numbers, NaN for columns that the file does not have, (rows, columns)."""
        columns = np.full((len(self.line), len(names)), np.nan)
        for k, name in enumerate(names):
            if name in self.numbers:
                columns[:, k] = self.values[:, self.numbers.index(name)]
        return columns

    @property
    def copies(self) -> BoolArray:
        """Which rows have the names and numbers of an earlier row, (rows,)."""
        rows = zip(zip(*self.texts, strict=True), map(tuple, self.values.tolist()), strict=True)
        seen: set[object] = set()
        repeated = []
        for row in rows:
            repeated.append(row in seen)
            seen.add(row)
        return np.array(repeated, dtype=bool)

    def select(self, rows: BoolArray) -> CsvTable:
        """Return the table with some of its rows."""
        texts = tuple(tuple(compress(column, rows)) for column in self.texts)
        return replace(self, texts=texts, values=self.values[rows], line=self.line[rows])

    def refuse(self, values: FloatArray, wrong: BoolArray, columns: tuple[str, ...], needed: str) -> None:
        """Raise SurveyFileError for the first wrong value.

        Args:
            values: numbers, (rows, columns).
            wrong: which of them are wrong, (rows, columns).
            columns: names of the columns.
            needed: description of the needed values.
        """
        for k, c in np.argwhere(wrong)[:1]:
            where = f"{self.place(k)}: column {columns[c]}"
            raise SurveyFileError(f"{where} contains {values[k, c]:g}, needed {needed}")

    def refuse_duplicates(self, keys: tuple[object, ...], columns: tuple[str, ...]) -> None:
        """Raise SurveyFileError if a key occurs twice.

        Args:
            keys: one key per row, a name or a tuple of names.
            columns: names of the columns of a key.
        """
        if len(set(keys)) == len(keys):
            return
        first: dict[object, int] = {}
        for key, line in zip(keys, self.line.tolist(), strict=True):
            if key in first:
                names = key if isinstance(key, tuple) else (key,)
                what = ", ".join(f"{c} '{name}'" for c, name in zip(columns, names, strict=True))
                raise SurveyFileError(
                    f"{self.path}, {self.word} {line}: {what} is on {self.word} {first[key]} already"
                )
            first[key] = line


def read_table(
    path: Path,
    texts: tuple[str, ...],
    numbers: tuple[str, ...],
    optional: tuple[str, ...] = (),
    *,
    aliases: tuple[tuple[str, str], ...] = (),
    ignored: tuple[str, ...] | None = (),
    blank: tuple[str, ...] = (),
    may_be_empty: bool = False,
) -> CsvTable:
    """Read a CSV file with a header of column names, below comments if it begins with them.

    Args:
        path: the file, UTF-8, comma separated, with a decimal point.
        texts: columns of names.
        numbers: columns of numbers.
        optional: columns of numbers that are all present or all missing.
        aliases: (other name, name) of columns.
        ignored: further columns that may be present; None for any.
        blank: columns of numbers whose cells may be empty, which gives NaN.
        may_be_empty: whether there may be no rows below the header.

    Raises:
        SurveyFileError: the file is unreadable, too large or has wrong columns, or a number is not finite or
            too large.
    """
    header = tuple(dict(aliases).get(name, name) for name in read_header(path))
    numbers = _numbers_in(path, header, texts, numbers, optional, ignored)
    text_at = [header.index(name) for name in texts]
    number_at = [header.index(name) for name in numbers]
    columns: list[list[str]] = [[] for _ in texts]
    values, lines = array("d"), array("q")
    for line, row in _rows(path, len(header)):
        where = f"{path}, line {line}"
        if len(lines) == MAX_ROWS:
            raise SurveyFileError(f"{where}: more than {MAX_ROWS} rows, no more are read")
        for column, at, name in zip(columns, text_at, texts, strict=True):
            column.append(_name(row[at], f"{where}: column {name}"))
        for at, name in zip(number_at, numbers, strict=True):
            empty = name in blank and not row[at].strip()
            values.append(math.nan if empty else _number(row[at], f"{where}: column {name}"))
        lines.append(line)
    if not lines and not may_be_empty:
        raise SurveyFileError(f"{path}: no rows below the header, at least one is needed")
    return CsvTable(
        path,
        texts,
        tuple(tuple(column) for column in columns),
        np.array(values).reshape(len(lines), len(numbers)),
        np.array(lines, dtype=np.int64),
        numbers=numbers,
    )


def _numbers_in(
    path: Path,
    header: tuple[str, ...],
    texts: tuple[str, ...],
    numbers: tuple[str, ...],
    optional: tuple[str, ...],
    ignored: tuple[str, ...] | None,
) -> tuple[str, ...]:
    """Return the columns of numbers that a header has; raise SurveyFileError if its columns are wrong."""
    wanted = (*texts, *numbers)
    shape = ",".join(wanted) + (f"[,{','.join(optional)}]" if optional else "")
    for name in header:
        if header.count(name) > 1:
            raise SurveyFileError(f"{path}, line 1: column {name!r:.60} is a duplicate in the header")
        if ignored is not None and name not in (*wanted, *optional, *ignored):
            hint = "; commas must separate the columns" if ";" in name or "\t" in name else ""
            raise SurveyFileError(f"{path}, line 1: unknown column {name!r:.60}, needed {shape}{hint}")
    if any(name in header for name in optional):
        numbers = (*numbers, *optional)
    for name in (*texts, *numbers):
        if name not in header:
            raise SurveyFileError(f"{path}, line 1: no column {name}, needed {shape}")
    return numbers


def array_table(
    what: str,
    texts: Mapping[str, Sequence[str]],
    numbers: Mapping[str, FloatArray],
    *,
    blank: tuple[str, ...] = (),
    line: Sequence[int] | None = None,
) -> CsvTable:
    """Return arrays as a table, with the same checks as for a file.

    Args:
        what: name of the arrays, for error messages.
        texts: columns of names.
        numbers: columns of numbers, of the same length.
        blank: columns of numbers that may be NaN.
        line: line of each row in the file that the arrays are from; rows are counted if not given.

    Raises:
        SurveyFileError: columns of different lengths, no rows, a bad name, or a number that is not finite or
            too large.
    """
    rows = len(next(iter(texts.values())))
    for name, column in texts.items():
        if len(column) != rows:
            raise SurveyFileError(f"{what}: {counted(len(column), 'value')} of {name}, expected {rows}")
    if not rows:
        raise SurveyFileError(f"{what}: no rows, at least one is needed")
    word, places = ("row", range(1, rows + 1)) if line is None else ("line", line)
    names = tuple(
        _names(name, list(map(str, column)), f"{what}, {word}", places) for name, column in texts.items()
    )
    values = np.column_stack([np.zeros((rows, 0)), *numbers.values()])
    table = CsvTable(Path(what), tuple(texts), names, values, np.array(places), word, tuple(numbers))
    wrong = ~(np.abs(values) <= MAX_NUMBER)
    wrong &= ~(np.isnan(values) & np.isin(list(numbers), blank))
    table.refuse(values, wrong, tuple(numbers), f"a finite number of at most {MAX_NUMBER:g}")
    return table


def _rows(path: Path, columns: int) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and cells of every nonempty row below the header."""
    with _opened(path) as file:
        lines = _Lines(path, file)
        reader = csv.reader(lines)
        try:
            next(reader, None)
            for row in reader:
                lines.characters = 0
                if not any(cell.strip() for cell in row):
                    continue
                if len(row) != columns:
                    raise SurveyFileError(
                        f"{path}, line {lines.number}: {counted(len(row), 'column')}, the header has "
                        f"{columns}"
                    )
                yield lines.number, row
        except UnicodeDecodeError as error:
            raise SurveyFileError(
                f"{path}: not a text file in UTF-8 (after line {lines.number}); save it as such"
            ) from error
        except csv.Error as error:
            raise SurveyFileError(f"{path}, line {lines.number}: not a CSV table: {error}") from error
        except OSError as error:
            raise SurveyFileError(f"{path}: the table cannot be read: {error.strerror}") from error


class _Lines:
    """The lines of a file below its comments, with limits on the length of a row and the number of lines."""

    def __init__(self, path: Path, file: TextIO) -> None:
        self.path, self.file = path, file
        self.number = 0
        self.in_table = False  # below the comments
        self.characters = 0  # of the row so far; quoted cells may span several lines

    def __iter__(self) -> _Lines:
        return self

    def __next__(self) -> str:
        line = self.read()
        while not self.in_table and line.startswith(COMMENT):
            line, self.characters = self.read(), 0
        self.in_table = True
        return line

    def read(self) -> str:
        """Return the next line, comments included."""
        line = self.file.readline(MAX_LINE + 1)
        if not line:
            raise StopIteration
        self.number += 1
        if self.number >= 2 * MAX_ROWS:
            raise SurveyFileError(f"{self.path}: more than {2 * MAX_ROWS} lines, no more are read")
        self.characters += len(line)
        if self.characters > MAX_LINE:
            raise SurveyFileError(
                f"{self.path}, line {self.number}: more than {MAX_LINE} characters, not a CSV table"
            )
        return line


def read_comments(path: Path) -> tuple[tuple[int, str], ...]:
    """Return the comments above the header of a table: line and text of each, without the sign.

    Raises:
        SurveyFileError: the file cannot be read.
    """
    comments = []
    with _opened(path) as file:
        lines = _Lines(path, file)
        try:
            while (line := lines.read()).startswith(COMMENT):
                comments.append((lines.number, line.removeprefix(COMMENT).rstrip("\r\n")))
                lines.characters = 0
        except StopIteration:
            pass
        except UnicodeDecodeError as error:
            raise SurveyFileError(f"{path}: not a text file in UTF-8; save it as such") from error
        except OSError as error:
            raise SurveyFileError(f"{path}: the table cannot be read: {error.strerror}") from error
    return tuple(comments)


def read_header(path: Path) -> tuple[str, ...]:
    """Return the names of the columns.

    Raises:
        SurveyFileError: the file cannot be read or is not a CSV table.
    """
    with _opened(path) as file:
        try:
            return tuple(name.strip() for name in next(csv.reader(_Lines(path, file)), []))
        except (UnicodeDecodeError, csv.Error) as error:
            raise SurveyFileError(f"{path}, line 1: not a CSV table in UTF-8; save it as such") from error
        except OSError as error:
            raise SurveyFileError(f"{path}: the table cannot be read: {error.strerror}") from error


def _opened(path: Path) -> TextIO:
    """Open a table if it is a file within the size limit."""
    try:
        if path.exists() and not path.is_file():  # reading a pipe would never end
            raise SurveyFileError(f"{path}: not a file, a CSV table is needed")
        if path.stat().st_size > MAX_TABLE_BYTES:
            raise SurveyFileError(f"{path}: {path.stat().st_size} bytes, at most {MAX_TABLE_BYTES} are read")
        return path.open(encoding="utf-8-sig", newline="")
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise SurveyFileError(f"{path}: the table cannot be read: {reason}") from error


def _names(column: str, cells: list[str], where: str, places: Iterable[int]) -> tuple[str, ...]:
    """Return the names in the cells of a column, each checked once, where it is first."""
    first = dict(zip(reversed(cells), reversed(list(places)), strict=True))
    in_order = sorted(first.items(), key=itemgetter(1))
    names = {cell: _name(cell, f"{where} {place}: {column}") for cell, place in in_order}
    return tuple(map(names.__getitem__, cells))


def _name(cell: str, where: str) -> str:
    """Return a name; refuse empty or very long names and invisible characters."""
    name = cell.strip()
    if is_word(name) and len(name) <= MAX_NAME:
        return sys.intern(name)
    name = from_cell(name)
    if not name:
        raise SurveyFileError(f"{where} is empty, a name is needed")
    if len(name) > MAX_NAME or not is_plain(name):
        raise SurveyFileError(
            f"{where} contains '{as_plain(name):.60}', needed plain text of at most {MAX_NAME} characters"
        )
    return sys.intern(name)


def _number(cell: str, where: str) -> float:
    """Return a number as programs write it; float() would also accept 1_0 and digits of other scripts."""
    text = cell.strip()
    try:
        value = float(text) if text.isascii() and "_" not in text else math.nan
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise SurveyFileError(f"{where} contains {cell!r:.60}, a finite number is needed")
    if abs(value) > MAX_NUMBER:
        raise SurveyFileError(f"{where} contains {text:.60}, needed a number of at most {MAX_NUMBER:g}")
    return value


def write_ply(
    path: Path,
    xyz: FloatArray,
    *,
    names: tuple[str, ...] = (),
    sigma: FloatArray | None = None,
    colours: Sequence[tuple[int, int, int]] | None = None,
    unit: str = "",
) -> None:
    """Write points as PLY; points with NaN are left out.

    Args:
        path: the file; a path from `sfm.files.whole_files` makes it appear completely or not at all.
        xyz: coordinates, (n, 3).
        names: names of the points, written as comments "name <id>" in their order, if given.
        sigma: standard deviations, (n, 3).
        colours: red, green and blue of each point, 0 to 255.
        unit: unit of lengths, for a comment.

    Raises:
        OutputError: a name has spaces that a comment does not preserve.
    """
    if any(" ".join(name.split()) != name for name in names):
        raise OutputError("PLY: names of points cannot begin or end with a space or have two in a row")
    table = np.asarray(xyz) if sigma is None else np.hstack([xyz, sigma])
    kept = np.flatnonzero(np.isfinite(table).all(axis=1)).tolist()
    words = " ".join(unit.encode("ascii", "replace").decode().split())
    lines = ["ply", "format ascii 1.0", f"comment kolinear, {words}" if words else "comment kolinear"]
    lines += [f"comment name {names[j]}" for j in kept if names]
    lines.append(f"element vertex {len(kept)}")
    lines += [f"property double {name}" for name in ("x", "y", "z", *(() if sigma is None else SIGMAS))]
    lines += [f"property uchar {name}" for name in (COLOURS if colours else ())]
    lines.append("end_header")
    for j in kept:
        row = (*table[j].tolist(), *(colours[j] if colours else ()))
        lines.append(" ".join(map(repr, row)))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
