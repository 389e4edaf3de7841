"""Reading of text files line by line, so that every error names file and line."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sfm.files.csv_tables import MAX_NUMBER, MAX_ROWS, MAX_TABLE_BYTES
from sfm.files.plain_text import MAX_NAME, is_name, shorten
from sfm.files.whole_files import whole_file
from sfm.model.conventions import FloatArray
from sfm.model.errors import SurveyFileError

MAX_LINES = 2 * MAX_ROWS  # as for tables
MAX_LINE = 10_000_000  # characters; the image points of a photograph can be on one line
MAX_DIGITS = 20  # digits of a whole number, like COLMAP's largest
MAX_PHOTOGRAPHS = 100_000
MAX_POINTS = 5_000_000  # points whose names are kept
MAX_IMAGE_POINTS = 20_000_000  # about 100 to 200 bytes each
MAX_BLOCK_LINES = 2_000_000  # lines kept one by one, about 0.5 GB


@dataclass
class Lines:
    """The lines of a file, read one after another."""

    path: Path
    size: int  # bytes
    source: Iterator[str]
    number: int = 0  # of the last line read, from 1
    current: str = ""  # the last line read
    ended: bool = True  # whether that line has a line end
    again: bool = False  # whether that line is also the next one

    @classmethod
    def of(cls, path: Path) -> Lines:
        """Open a file of permitted size.

        Raises:
            SurveyFileError: the file cannot be read or is too large.
        """
        try:
            if path.exists() and not path.is_file():  # reading a pipe would never end
                raise SurveyFileError(f"{path}: not a file, a text file is needed")
            size = path.stat().st_size
            if size > MAX_TABLE_BYTES:
                raise SurveyFileError(f"{path}: {size} bytes, at most {MAX_TABLE_BYTES} are read")
            with path.open("rb"):
                return cls(path, size, _lines_of(path))
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise SurveyFileError(f"{path}: cannot be read ({reason})") from error

    @property
    def where(self) -> str:
        """File and number of the last line read."""
        return f"{self.path}, line {self.number}"

    def error(self, message: str) -> SurveyFileError:
        """Return an error at the last line read."""
        return SurveyFileError(f"{self.where}: {message}")

    def maybe_line(self) -> str | None:
        """Return the next line; None at the end."""
        if self.again:
            self.again = False
        else:
            line = next(self.source, None)
            if line is None:
                return None
            self.ended = line.endswith("\n")
            self.current = line.removesuffix("\n")
        self.number += 1
        return self.current

    def line(self) -> str:
        """Return the next line, which must exist.

        Raises:
            SurveyFileError: the file ends here.
        """
        line = self.maybe_line()
        if line is None:
            self.number += 1
            raise self.error("the file ends here, more was expected")
        return line

    def read_again(self) -> None:
        """Make the last line read the next one."""
        self.number, self.again = self.number - 1, True

    def row(self) -> list[str] | None:
        """Return the words of the next line that is not empty or a # comment; None at the end."""
        while (line := self.maybe_line()) is not None:
            words = line.split("#")[0].split()
            if words:
                return words
        return None

    def due_row(self, what: str) -> list[str]:
        """Return the words of the next row, which must exist.

        Raises:
            SurveyFileError: the file ends here.
        """
        words = self.row()
        if words is None:
            self.number += 1
            raise self.error(f"the file ends here, {what} was expected")
        return words

    def cells(self) -> list[str]:
        """Return the cells of the last line read, separated by commas.

        Raises:
            SurveyFileError: it is no line of a CSV table.
        """
        try:
            return next(csv.reader([self.current]), [])
        except csv.Error as error:
            raise self.error(f"not a CSV table: {error}") from error

    def end(self) -> None:
        """Refuse anything that follows.

        Raises:
            SurveyFileError: something follows.
        """
        words = self.row()
        if words is not None:
            raise self.error(f"'{shorten(' '.join(words))}' after the end of the data")

    def number_of(self, text: str) -> float:
        """Return a finite number of permitted size.

        Raises:
            SurveyFileError: not a number, not finite or too large.
        """
        try:
            value = float(text) if text.isascii() and "_" not in text else np.nan
        except ValueError:
            value = np.nan
        if not np.isfinite(value):
            raise self.error(f"'{shorten(text)}' is not a number")
        if abs(value) > MAX_NUMBER:
            raise self.error(f"'{shorten(text)}', needed a number of at most {MAX_NUMBER:g}")
        return value

    def whole_of(self, text: str, fewest: int, most: int, what: str) -> int:
        """Return a whole number within bounds.

        Raises:
            SurveyFileError: not a whole number within the bounds.
        """
        digits = text.removeprefix("-")
        sound = digits.isascii() and digits.isdecimal() and len(digits) <= MAX_DIGITS
        if not (sound and fewest <= int(text) <= most):
            raise self.error(f"{what} is '{shorten(text)}', needed a whole number from {fewest} to {most}")
        return int(text)

    def name_of(self, text: str, what: str) -> str:
        """Return a name, which must be plain text.

        Raises:
            SurveyFileError: empty, too long or not plain text.
        """
        if not is_name(text):
            raise self.error(f"{what} is '{shorten(text)}', needed plain text of 1 to {MAX_NAME} characters")
        return text

    def index_of(self, text: str, count: int, what: str) -> int:
        """Return an index from 0 to count - 1."""
        return self.whole_of(text, 0, count - 1, what)

    def count_of(self, text: str, what: str, most: int = MAX_LINES) -> int:
        """Return a count of at least 1, limited by what a file can contain."""
        return self.whole_of(text, 1, most, f"the number of {what}")

    def refuse_more(self, count: int, most: int, what: str) -> None:
        """Raise an error at the last line read if a count exceeds its limit.

        Raises:
            SurveyFileError: the count is too large.
        """
        if count > most:
            raise self.error(f"more than {most} {what}, no more are read")

    def numbers(self, fewest: int, most: int, *, photograph: str | None = None) -> FloatArray:
        """Return a line of numbers, the first of which must be the number of the photograph if given.

        Raises:
            SurveyFileError: a wrong count of numbers, or a line of another photograph.
        """
        parts = self.line().split()
        if not fewest <= len(parts) <= most:
            needed = f"{fewest}" if fewest == most else f"{fewest} to {most}"
            raise self.error(f"{len(parts)} numbers, needed {needed}")
        if photograph is not None and parts[0] != photograph:
            raise self.error(
                f"'{shorten(parts[0])}' at the start, needed the number {photograph} of the photograph"
            )
        return np.array([self.number_of(part) for part in parts])

    def block(self, count: int) -> list[tuple[str, str, FloatArray]]:
        """Return lines of `count` numbers up to an empty line, as (where, first, others)."""
        rows: list[tuple[str, str, FloatArray]] = []
        while self.line().strip():
            self.read_again()
            row = self.numbers(count, count)
            self.refuse_more(len(rows) + 1, MAX_BLOCK_LINES, "lines of a block")
            rows.append((self.where, f"{row[0]:.0f}", row[1:]))
        return rows


def _lines_of(path: Path) -> Iterator[str]:
    """Yield the lines of a file with their ends, within the limits of length and number."""
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            for number in range(1, MAX_LINES + 2):
                line = file.readline(MAX_LINE + 1)
                if not line:
                    return
                if number > MAX_LINES:
                    raise SurveyFileError(f"{path}: more than {MAX_LINES} lines, no more are read")
                if len(line) > MAX_LINE:
                    raise SurveyFileError(f"{path}, line {number}: more than {MAX_LINE} characters")
                yield line
    except OSError as error:
        raise SurveyFileError(f"{path}: cannot be read ({error.strerror})") from error


def write_lines(path: Path, lines: list[str]) -> None:
    """Write a text file, whole or not at all.

    Raises:
        OutputError: the file cannot be written.
    """
    with whole_file(path) as part:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")
