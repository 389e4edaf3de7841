"""Generates the tables of remarks in docs/symptoms.md from the catalogue.

`python docs/remark_tables.py docs/symptoms.md` writes the tables between their marks.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from sfm.model.remarks.catalogue import SUBJECTS, TESTS
from sfm.model.remarks.row import FIELD, Grade, Kind, Unless

BEGIN, END = "<!-- remarks: written by docs/remark_tables.py -->", "<!-- end of remarks -->"
VARIES = "…"


def remark_tables() -> str:
    """Return one table of remarks for each subject of the catalogue, and that of the tests, in Markdown."""
    parts = []
    for subject, rows in SUBJECTS.items():
        parts += [f"### {subject}", "", "| remark | severity | cause | remedy |", "|---|---|---|---|"]
        parts += [_row(kind) for kind in rows]
        parts.append("")
    parts += ["### What was tested", "", "| test | tested on | result, or why not |", "|---|---|---|"]
    for row in TESTS.values():
        cells = (f"{_pattern(row.test)} `{row.name}`", _pattern(row.on), _pattern(row.result))
        parts.append("| " + " | ".join(cells) + " |")
    parts.append("")
    return "\n".join(parts)


def with_tables(page: str) -> str:
    """Return a page with the tables between the marks."""
    head, _, rest = page.partition(BEGIN)
    return f"{head}{BEGIN}\n\n{remark_tables()}\n{END}{rest.partition(END)[2]}"


def _row(kind: Kind) -> str:
    cells = (
        f"{_pattern(kind.sentence)} `{kind.name}`",
        _severity(kind),
        _pattern(kind.cause),
        _pattern(kind.remedy),
    )
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _pattern(sentence: str) -> str:
    """Return a sentence with … for variable parts, and plural forms where a number decides."""

    def field(match: re.Match[str]) -> str:
        spec = match.group(2) or ""
        if "|" in spec:
            return spec.split("|")[1]
        return f"{VARIES} {spec}s" if spec and spec[0].isalpha() else VARIES

    alternatives = re.sub(r"\]\]\[\[(?=[A-Za-z{])", " / ", sentence)
    return FIELD.sub(field, alternatives.replace("[[", "").replace("]]", ""))


def _severity(kind: Kind) -> str:
    """Return the severity, or the limits of the number that it depends on."""
    if isinstance(kind.severity, Unless):
        parts = " or the ".join(kind.severity.parts)
        return f"{kind.severity.severity}, {kind.severity.named} if the {parts} is known"
    if not isinstance(kind.severity, Grade):
        return kind.severity
    grade: Grade | None = kind.severity
    limits: dict[str, str] = {}
    while grade is not None:
        for name, limit in (("warning", grade.warning), ("error", grade.error)):
            if limit < float("inf"):
                text = name if limit == -float("inf") else f"{name} from {grade.number} {limit:g}"
                if grade.at_most is not None and name == "error":
                    text += f" and {grade.at_most.number} {grade.at_most.error:g}"
                limits.setdefault(name, text)
        grade = grade.also
    return ", ".join(limits.values())


if __name__ == "__main__":
    path = Path(sys.argv[1])
    path.write_text(with_tables(path.read_text(encoding="utf-8")), encoding="utf-8")
