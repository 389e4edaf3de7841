"""Formats data for people: small tables for the prompt and notebooks, and shortened lists for messages."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Sequence
from enum import IntFlag
from functools import cache

MAX_LISTED = 5  # items in one message
NO_BREAK = "\N{NO-BREAK SPACE}"
# spaces at which a line may not end, such as those between numbers and their units
WITH_UNIT = re.compile(
    r"(?<=95 %) (?=\d)|(?<=\d) (?=×)|(?<=×) (?=\d)|"
    r"(?<=\d) (?=(?:%|px|[kmcdµun]?m|deg|s|sigma|mrad|iterations?)(?![\w^]))"
)
PROGRAMS = {"kolinear": "Kolinear", "colmap": "COLMAP"}  # key in survey files and tables -> name
TEMPLATE = """\
<table><caption>{{ title }}</caption>
<thead><tr>{% for name in header %}<th>{{ name }}</th>{% endfor %}</tr></thead>
<tbody>{% for row in rows %}<tr>{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}</tbody></table>"""


def program_name(key: str) -> str:
    """Return the name of a program in its usual spelling."""
    return PROGRAMS.get(key, key)


@cache
def in_words(kind: type[IntFlag], flags: int) -> str:
    """Return the names of the flags of a kind that are set, in words such as `cut by border`; or nothing.

    Args:
        kind: what the flags mean.
        flags: flags, one bit each.
    """
    names = [str(member.name).lower() for member in kind if member.value and flags & member.value]
    return ", ".join(names).replace("_", " ")


def html_table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table as HTML; all text is escaped."""
    from jinja2 import Environment

    template = Environment(autoescape=True).from_string(TEMPLATE)
    return template.render(title=title, header=header, rows=rows)


def text_table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table as text, with the first column aligned left and the others aligned right."""
    lines = [header, *rows] if any(header) else list(rows)
    return "\n".join([title, *aligned(lines, [k == 0 for k in range(len(header))])])


def aligned(rows: Sequence[Sequence[str]], left: Sequence[bool]) -> list[str]:
    """Return rows of cells as lines with aligned columns.

    Args:
        rows: rows with the same number of cells.
        left: which columns are aligned left; the others (numbers) are aligned right.

    Examples:
        >>> aligned([("point", "rays"), ("A", "12")], [True, False])
        ['point  rays', 'A        12']
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if at_left else cell.rjust(width)
            for cell, width, at_left in zip(row, widths, left, strict=True)
        ).rstrip()
        for row in rows
    ]


def bound(text: str) -> str:
    """Return a text with no-break spaces between numbers and their units.

    Examples:
        >>> bound("95 % 1.95 px").split(NO_BREAK) == ["95", "%", "1.95", "px"]
        True
    """
    return WITH_UNIT.sub(NO_BREAK, text)


def wrapped(text: str, width: int) -> str:
    """Wrap a text into lines that do not separate a number from its unit.

    Args:
        text: one paragraph.
        width: number of characters in a line.
    """
    lines = textwrap.wrap(bound(text), max(width, 1), break_on_hyphens=False)
    return "\n".join(lines).replace(NO_BREAK, " ")


def plural(noun: str, count: float) -> str:
    """Return a noun as it follows a number, with an s unless the number is 1."""
    return noun if count == 1 else f"{noun}s"


def counted(count: int, noun: str) -> str:
    """Return a number with its noun in the singular or plural.

    Args:
        count: the number.
        noun: noun in the singular.

    Examples:
        >>> counted(1, "photograph"), counted(12, "image point")
        ('1 photograph', '12 image points')
    """
    return f"{count} {plural(noun, count)}"


def agreeing(count: float, forms: str) -> str:
    """Return the form of a verb or pronoun that agrees with a number.

    Args:
        count: the number.
        forms: singular and plural form, such as "is|are".

    Examples:
        >>> agreeing(1, "has|have"), agreeing(2, "its|their")
        ('has', 'their')
    """
    return forms.split("|")[0 if count == 1 else 1]


def listed(texts: Iterable[str], *, most: int = MAX_LISTED, separator: str = ", ") -> str:
    """Join the first few of several texts, and state how many more there are.

    Args:
        texts: names or phrases.
        most: largest number of texts shown.
        separator: text between two of them.

    Examples:
        >>> listed(["501", "502", "503"], most=2)
        '501, 502 and 1 more'
    """
    every = list(texts)
    more = f" and {len(every) - most} more" if len(every) > most else ""
    return separator.join(every[:most]) + more
