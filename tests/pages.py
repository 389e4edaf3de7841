"""Pages of docs/ whose numbers are computed: their examples run, and show what is printed there."""

from __future__ import annotations

import doctest
import re
from pathlib import Path
from typing import Any

from tests.places import ROOT

FLAGS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS


def text_of(page: str) -> str:
    return (ROOT / "docs" / page).read_text(encoding="utf-8")


def examples_of(page: str) -> str:
    """All ```pycon blocks of a page, one after the other, each line where it stands on the page."""
    lines, inside = [], False
    for line in text_of(page).splitlines():
        if line.startswith("```"):
            inside = line == "```pycon"
            line = ""
        lines.append(line if inside else "")
    return "\n".join(lines) + "\n"


def run_examples(page: str, names: dict[str, Any]) -> doctest.TestResults:
    """Run the examples of a page, which add to the names; what differs is printed."""
    test = doctest.DocTestParser().get_doctest(examples_of(page), names, page, page, 0)
    results = doctest.DocTestRunner(optionflags=FLAGS).run(test, clear_globs=False)
    names.update(test.globs)
    return results


def show(path: Path, pattern: str) -> None:
    """Print what matches in a file, a match a line, its numbers to nine digits."""
    for match in re.findall(pattern, path.read_text(encoding="utf-8")):
        print(re.sub(r"-?\d+\.\d+(e[+-]?\d+)?", lambda number: f"{float(number[0]):.9g}", match))
