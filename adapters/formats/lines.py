"""Reading text files line by line, so that whatever is wrong is named with file and line."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from sfm.conventions import FloatArray
from sfm.errors import SurveyFileError
from sfm.files.csv_tables import MAX_NUMBER, MAX_ROWS, MAX_TABLE_BYTES
from sfm.files.whole_files import whole_file

MAX_LINES = 2 * MAX_ROWS  # as of tables
MAX_DIGITS = 20  # of a whole number; COLMAP's largest have as many
SHOWN = 40  # characters of a bad piece that a message repeats


@dataclass
class Lines:
    """The lines of a file and how far they are read."""

    path: Path
    lines: list[str]
    number: int = 0  # of the line read last, from 1
    ended: bool = True  # whether the last line has its end

    @classmethod
    def of(cls, path: Path) -> Lines:
        """Read a file of bearable size.

        Raises:
            SurveyFileError: it is none.
        """
        try:
            if path.exists() and not path.is_file():  # reading a pipe would never end
                raise SurveyFileError(f"{path}: not a file, a text file is needed")
            if path.stat().st_size > MAX_TABLE_BYTES:
                raise SurveyFileError(
                    f"{path}: {path.stat().st_size} bytes, at most {MAX_TABLE_BYTES} are read"
                )
            with path.open(encoding="utf-8", errors="replace") as file:
                lines = list(islice(file, MAX_LINES + 1))
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise SurveyFileError(f"{path}: cannot be read ({reason})") from error
        if len(lines) > MAX_LINES:
            raise SurveyFileError(f"{path}: more than {MAX_LINES} lines, no more are read")
        ended = not lines or lines[-1].endswith("\n")
        return cls(path, [line.removesuffix("\n") for line in lines], ended=ended)

    @property
    def where(self) -> str:
        """File and number of the line read last."""
        return f"{self.path}, line {self.number}"

    def error(self, message: str) -> SurveyFileError:
        """Return the error of the line read last."""
        return SurveyFileError(f"{self.where}: {message}")

    def line(self) -> str:
        """Return the next line."""
        self.number += 1
        if self.number > len(self.lines):
            raise self.error("the file ends here, more was due")
        return self.lines[self.number - 1]

    def row(self) -> list[str] | None:
        """Return the words of the next line that is neither empty nor a # comment, None at the end."""
        while self.number < len(self.lines):
            words = self.line().split("#")[0].split()
            if words:
                return words
        return None

    def due_row(self, what: str) -> list[str]:
        """Return the words of the next row, which must be there."""
        words = self.row()
        if words is None:
            self.number += 1
            raise self.error(f"the file ends here, {what} was due")
        return words

    def due_words(self, count: int, what: str) -> list[str]:
        """Return the next row, which must be there and have so many words."""
        words = self.due_row(what)
        if len(words) != count:
            raise self.error(f"{len(words)} words, needed {count}: {what}")
        return words

    def end(self) -> None:
        """Refuse anything that follows."""
        words = self.row()
        if words is not None:
            raise self.error(f"'{' '.join(words)[:SHOWN]}' after the end of the data")

    def number_of(self, text: str) -> float:
        """Return a finite number of bearable size."""
        try:
            value = float(text) if text.isascii() and "_" not in text else np.nan
        except ValueError:
            value = np.nan
        if not np.isfinite(value):
            raise self.error(f"'{text[:SHOWN]}' is not a number")
        if abs(value) > MAX_NUMBER:
            raise self.error(f"'{text[:SHOWN]}', needed a number of at most {MAX_NUMBER:g}")
        return value

    def whole_of(self, text: str, fewest: int, most: int, what: str) -> int:
        """Return a whole number within bounds."""
        digits = text.removeprefix("-")
        sound = digits.isascii() and digits.isdecimal() and len(digits) <= MAX_DIGITS
        if not (sound and fewest <= int(text) <= most):
            raise self.error(f"{what} is '{text[:SHOWN]}', needed a whole number from {fewest} to {most}")
        return int(text)

    def index_of(self, text: str, count: int, what: str) -> int:
        """Return an index from 0 to count - 1."""
        return self.whole_of(text, 0, count - 1, what)

    def count_of(self, text: str, what: str) -> int:
        """Return a number of things, 1 or more, that the file can have room for."""
        return self.whole_of(text, 1, MAX_LINES, f"the number of {what}")

    def numbers(self, fewest: int, most: int, *, photograph: str | None = None) -> FloatArray:
        """Return a line of numbers, the first of which is that of the photograph if given."""
        parts = self.line().split()
        if not fewest <= len(parts) <= most:
            needed = f"{fewest}" if fewest == most else f"{fewest} to {most}"
            raise self.error(f"{len(parts)} numbers, needed {needed}")
        if photograph is not None and parts[0] != photograph:
            raise self.error(
                f"'{parts[0][:SHOWN]}' at the start, needed the number {photograph} of the photograph"
            )
        return np.array([self.number_of(part) for part in parts])

    def block(self, count: int) -> list[tuple[str, str, FloatArray]]:
        """Return lines of so many numbers up to an empty one, as (where, first, others)."""
        rows = []
        while self.line().strip():
            self.number -= 1
            row = self.numbers(count, count)
            rows.append((self.where, f"{row[0]:.0f}", row[1:]))
        return rows


def write_lines(path: Path, lines: list[str]) -> None:
    """Write a text file, whole or not at all.

    Raises:
        OutputError: the file cannot be written.
    """
    with whole_file(path) as part:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")
