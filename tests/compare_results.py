"""Say whether two result folders are the same: tables, summary, reports, pictures, and what differs.

    python tests/compare_results.py OLD NEW [--relative 1e-12] [--wording]

Numbers are the same if they are equal to the last bit, or within the relative difference that is allowed.
Times and logs are not compared: they differ from run to run. Exit code 0 if the results are the same, 1 if
not, 2 if one is no result folder.
"""

from __future__ import annotations

import argparse
import csv
import difflib
import json
import math
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np

TIMES = ("seconds",)  # keys of summary.json
TIMED_SECTION = "process"  # of report.html, whose table is of times
IGNORED = ("log.jsonl", "manifest.json")  # times, and the hashes of files that hold times
MAX_TOLD = 5  # differences of a file that are told one by one
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
PICTURES = (".png", ".jpg")


@dataclass
class Compared:
    """What came of one file."""

    name: str
    differences: list[str] = field(default_factory=list)  # what differs, in words
    numbers: int = 0  # compared
    equal: int = 0  # of them, those equal to the last bit
    largest: float = 0.0  # relative difference of the others
    notes: list[str] = field(default_factory=list)  # what differs and does not count

    def number(self, old: float, new: float, relative: float, where: str) -> None:
        """Compare two numbers."""
        self.numbers += 1
        if old == new or (math.isnan(old) and math.isnan(new)):
            self.equal += 1
            return
        scale = max(abs(old), abs(new))
        apart = abs(old - new) / scale if math.isfinite(scale) else math.inf
        self.largest = max(self.largest, apart)
        if not apart <= relative:
            self.differences.append(f"{where}: {old!r} became {new!r}, relative difference {apart:.1e}")

    def value(self, old: object, new: object, relative: float, where: str) -> None:
        """Compare two values, as numbers where both are."""
        a, b = as_number(old), as_number(new)
        if a is not None and b is not None:
            self.number(a, b, relative, where)
        elif old != new:
            self.differences.append(f"{where}: {old!r} became {new!r}")

    def __str__(self) -> str:
        told = [f"    {words}" for words in self.differences[:MAX_TOLD]]
        if len(self.differences) > MAX_TOLD:
            told.append(f"    and {len(self.differences) - MAX_TOLD} more")
        same = "differs" if self.differences else "same"
        numbers = f", {self.equal} of {self.numbers} numbers equal to the last bit" if self.numbers else ""
        apart = f", the others within {self.largest:.1e}" if self.equal < self.numbers else ""
        told += [f"    ({note})" for note in self.notes]
        return "\n".join([f"{self.name}: {same}{numbers}{apart}", *told])


class VisibleText(HTMLParser):
    """The words that a page shows, and where its links lead."""

    def __init__(self) -> None:
        super().__init__()
        self.words: list[str] = []
        self.links: list[str] = []
        self._hidden = 0  # elements around that show nothing
        self._section = ""

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        """Note links, sections and what is not shown."""
        values = dict(attributes)
        if tag == "section":
            self._section = values.get("id") or ""
        if tag == "a":
            self.links.append(values.get("href") or "")
        self._hidden += tag in ("style", "script") or (tag == "table" and self._section == TIMED_SECTION)

    def handle_endtag(self, tag: str) -> None:
        """Note the end of what is not shown."""
        hidden = tag in ("style", "script") or (tag == "table" and self._section == TIMED_SECTION)
        self._hidden -= hidden

    def handle_data(self, data: str) -> None:
        """Note words that are shown."""
        if not self._hidden:
            self.words += data.split()


def compare_folders(
    old: Path, new: Path, *, relative: float = 0.0, wording: bool = False
) -> tuple[Compared, ...]:
    """Return what differs between two result folders, file by file.

    Args:
        old, new: the folders.
        relative: largest relative difference of two numbers that are the same.
        wording: whether texts are the same if their numbers are.
    """
    names = [names_in(folder) for folder in (old, new)]
    listed = Compared("files")
    listed.differences += [f"{name} is missing in {new}" for name in sorted(names[0] - names[1])]
    listed.differences += [f"{name} is new in {new}" for name in sorted(names[1] - names[0])]
    return (
        listed,
        *(
            compare_files(name, old / name, new / name, relative=relative, wording=wording)
            for name in sorted(names[0] & names[1])
        ),
    )


def names_in(folder: Path) -> set[str]:
    """Return the files of a folder and of those below it.

    Raises:
        SystemExit: it is no result folder.
    """
    if not (folder / "summary.json").is_file():
        print(f"{folder}: no result folder, it has no summary.json", file=sys.stderr)
        raise SystemExit(2)
    paths = (path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    return {path.as_posix() for path in paths if path.name not in IGNORED and not path.name.startswith(".")}


def compare_files(name: str, old: Path, new: Path, *, relative: float, wording: bool) -> Compared:
    """Return what differs between two files of a result."""
    found = Compared(name)
    match Path(name).suffix:
        case ".csv":
            _compare_tables(found, old, new, relative)
        case ".json":
            _compare_values(found, *(json.loads(path.read_text("utf-8")) for path in (old, new)), relative)
        case ".ply":
            a, b = (path.read_text("ascii").split() for path in (old, new))
            _compare_sequences(found, a, b, relative)
        case ".html":
            _compare_pages(found, old.read_text("utf-8"), new.read_text("utf-8"), wording=wording)
        case ".txt":
            _compare_words(found, *(path.read_text("utf-8").split() for path in (old, new)), wording=wording)
        case suffix if suffix in PICTURES:
            _compare_pictures(found, old, new)
        case _:
            if old.read_bytes() != new.read_bytes():
                found.differences.append("the bytes differ")
    return found


def as_number(value: object) -> float | None:
    """Return a value as number, None if it is none."""
    if isinstance(value, bool) or value is None:
        return None
    try:
        return float(str(value))
    except ValueError:
        return None


def _compare_tables(found: Compared, old: Path, new: Path, relative: float) -> None:
    tables = []
    for path in (old, new):
        with path.open(encoding="utf-8", newline="") as file:
            tables.append(list(csv.reader(file)))
    (a, *rows_a), (b, *rows_b) = tables
    if a != b:
        found.differences.append(f"the columns {','.join(a)} became {','.join(b)}")
    if len(rows_a) != len(rows_b):
        found.differences.append(f"{len(rows_a)} rows became {len(rows_b)}")
    for number, (x, y) in enumerate(zip(rows_a, rows_b, strict=False), start=2):
        for column, before in zip(a, x, strict=False):
            if column in b:
                where = f"line {number} ({x[0]}), {column}"
                found.value(before, y[b.index(column)], relative, where)


def _compare_values(found: Compared, old: Any, new: Any, relative: float, where: str = "") -> None:
    if isinstance(old, dict) and isinstance(new, dict):
        for key in (*old, *(key for key in new if key not in old)):
            place = f"{where}.{key}" if where else key
            if key not in new or key not in old:
                found.differences.append(f"{place} is {'missing' if key in old else 'new'}")
            elif key not in TIMES:
                _compare_values(found, old[key], new[key], relative, place)
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for k, (a, b) in enumerate(zip(old, new, strict=True)):
            _compare_values(found, a, b, relative, f"{where}[{k}]")
    else:
        found.value(old, new, relative, where)


def _compare_sequences(found: Compared, old: list[str], new: list[str], relative: float) -> None:
    if len(old) != len(new):
        found.differences.append(f"{len(old)} values became {len(new)}")
    for k, (a, b) in enumerate(zip(old, new, strict=False)):
        found.value(a, b, relative, f"value {k}")


def _compare_pages(found: Compared, old: str, new: str, *, wording: bool) -> None:
    pages = []
    for text in (old, new):
        page = VisibleText()
        page.feed(text)
        pages.append(page)
    _compare_words(found, pages[0].words, pages[1].words, wording=wording)
    if pages[0].links != pages[1].links:
        found.differences.append("the links differ")


def _compare_words(found: Compared, old: list[str], new: list[str], *, wording: bool) -> None:
    """Compare texts word by word, whatever the spaces; numbers in them must be the same in any case."""
    for before, after in _changes(old, new):
        numbers = [NUMBER.findall(" ".join(words)) for words in (before, after)]
        told = f"'{' '.join(before)}' became '{' '.join(after)}'"
        (found.notes if wording and numbers[0] == numbers[1] else found.differences).append(told)


def _changes(old: list[str], new: list[str]) -> Iterator[tuple[list[str], list[str]]]:
    """Return the words that were replaced, and by which."""
    for kind, a, b, c, d in difflib.SequenceMatcher(None, old, new, autojunk=False).get_opcodes():
        if kind != "equal":
            yield old[a:b], new[c:d]


def _compare_pictures(found: Compared, old: Path, new: Path) -> None:
    if old.read_bytes() == new.read_bytes():
        return
    pictures = [cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR) for path in (old, new)]
    if pictures[0].shape != pictures[1].shape:
        found.differences.append(f"{pictures[0].shape} pixels became {pictures[1].shape}")
        return
    apart = np.abs(pictures[0].astype(int) - pictures[1])
    if apart.any():
        found.differences.append(
            f"{int((apart > 0).any(axis=2).sum())} pixels differ, by {apart.max()} at most"
        )


def main() -> int:
    """Compare two folders and print what differs."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("old", type=Path, metavar="OLD", help="a result folder")
    parser.add_argument("new", type=Path, metavar="NEW", help="the result folder to compare with it")
    parser.add_argument(
        "--relative", type=float, default=0.0, metavar="R", help="relative difference that is allowed"
    )
    parser.add_argument("--wording", action="store_true", help="texts are the same if their numbers are")
    options = parser.parse_args()
    compared = compare_folders(options.old, options.new, relative=options.relative, wording=options.wording)
    for found in compared:
        print(found)
    differ = [found.name for found in compared if found.differences]
    print(f"{len(differ)} of {len(compared) - 1} files differ" if differ else "the results are the same")
    return 1 if differ else 0


if __name__ == "__main__":
    sys.exit(main())
