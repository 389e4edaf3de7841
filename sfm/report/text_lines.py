"""Lines, headings and columns of the reports in plain text."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

WIDTH = 100
MOST_ROWS = 12  # of a list; the rest is in the tables of the result
MOST_CHARACTERS = 40  # of a cell


def head(title: str) -> list[str]:
    """Return a heading with an empty line above it."""
    return ["", f"{title} ".ljust(WIDTH, "-")]


def line(name: str, text: str) -> str:
    """Return a line of a name and what is told of it."""
    return f"  {name:<21} {text}"


def lines(name: str, text: str) -> list[str]:
    """Return the same on as many lines as it needs, one below the other."""
    return wrapped(line(name, text), behind=len(line("", "")))


def columns(header: Sequence[str], rows: Iterable[Sequence[str]], *, left: int) -> list[str]:
    """Return rows in columns; the first `left` ones set to the left, numbers to the right."""
    cells = [tuple(header), *(tuple(row) for row in rows)]
    widths = [min(max(len(row[c]) for row in cells), MOST_CHARACTERS) for c in range(len(header))]
    return [
        "  "
        + "  ".join(
            f"{row[c][:MOST_CHARACTERS]:<{width}}" if c < left else f"{row[c]:>{width}}"
            for c, width in enumerate(widths)
        )
        for row in cells
    ]


def wrapped(text: str, *, behind: int | None = None) -> list[str]:
    """Break a line between words; what follows stands behind so many spaces, two more than it has if None."""
    indent = " " * (len(text) - len(text.lstrip()) + 2 if behind is None else behind)
    lines, rest = [], text
    while len(rest) > WIDTH:
        cut = rest.rfind(" ", len(indent) + 1, WIDTH)
        cut = WIDTH if cut < 0 else cut
        lines.append(rest[:cut])
        rest = indent + rest[cut:].strip()
    return [*lines, rest]
