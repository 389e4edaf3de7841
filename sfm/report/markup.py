"""Pieces of HTML and numbers as people read them."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from urllib.parse import quote

import numpy as np

METRIC = (("km", 1e3), ("m", 1.0), ("mm", 1e-3), ("µm", 1e-6))
"""metric units and their length in metres, largest first"""
SMALL = 1e-3
"""parameters below it are written with an exponent"""
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class Cell:
    """A cell of a table that is more than text."""

    text: str
    url: str = ""  # where it leads, ready for a link
    level: str = ""  # good | fair | bad, its colour


def table(
    header: Sequence[str],
    rows: Iterable[Sequence[str | Cell]],
    *,
    head: bool = True,
    plain_first: bool = False,
    last_bold: bool = False,
) -> str:
    """Return a table of escaped texts; columns of numbers are set to the right by the style sheet."""
    rows = list(rows)
    text = "<div class=scroll><table" + (" class=facts" if plain_first else "") + ">"
    if head:
        numeric = [
            k > 0 and any(len(row) > k and _is_number(row[k]) for row in rows) for k in range(len(header))
        ]
        cells = "".join(
            f"<th{' class=n' if right else ''}>{escape(name)}</th>"
            for name, right in zip(header, numeric, strict=True)
        )
        text += f"<thead><tr>{cells}</tr></thead>"
    text += "<tbody>"
    for k, row in enumerate(rows):
        bold = " class=sum" if last_bold and k == len(rows) - 1 else ""
        cells = "".join(
            f"<td{' class=n' if _is_number(cell) else ''}>{_inside(cell)}</td>" for cell in row[1:]
        )
        text += f"<tr{bold}><th scope=row>{_inside(row[0])}</th>{cells}</tr>"
    return text + "</tbody></table></div>"


def _inside(cell: str | Cell) -> str:
    if isinstance(cell, str):
        return escape(cell)
    text = escape(cell.text)
    if cell.level:
        text = f'<span class="mark {cell.level}">{text}</span>'
    return f'<a href="{cell.url}">{text}</a>' if cell.url else text


def figure(data: bytes, caption: str) -> str:
    return (
        f'<figure class=plot><img alt="{escape(caption)}" src="{data_url(data, "png")}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def data_url(data: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def file_url(name: str) -> str:
    """Return a file name as it may stand in a link."""
    return escape(quote(name))


def significant(value: float, digits: int = 3) -> str:
    """Write a number with so many significant digits and no exponent where that is short."""
    value = float(value)
    if not np.isfinite(value):
        return "not known"
    if value == 0:
        return "0"
    exponent = int(np.floor(np.log10(abs(value))))
    if -6 <= exponent < 7:
        return f"{value:.{max(0, digits - 1 - exponent)}f}"
    return f"{value:.{digits - 1}e}"


def with_exponent(value: float, sigma: float) -> tuple[str, str]:
    """Write a parameter to the second digit of its standard deviation, and the latter; small ones as m e-n.

    Args:
        value: the parameter.
        sigma: its standard deviation, NaN if it was held fixed.
    """
    if not (np.isfinite(sigma) and sigma > 0):
        return (f"{value:.6g}", "held fixed")
    if abs(value) >= SMALL or value == 0:
        return to_precision(value, sigma), significant(sigma, 2)
    power = int(np.floor(np.log10(abs(value))))
    decimals = int(np.clip(1 - np.floor(np.log10(sigma)) + power, 0, 12))
    mantissa = value / 10.0**power
    return f"{mantissa:.{decimals}f}e{power}", f"{sigma / 10.0**power:.{decimals}f}e{power}"


def raised(unit: str) -> str:
    """Write the exponent of a unit such as mm^-2 above the line, nothing for a pure number."""
    if unit == "1":
        return ""
    base, _, power = unit.partition("^")
    return base + power.translate(SUPERSCRIPTS) if power else unit


def signed(value: float) -> str:
    return ("+" if value >= 0 else "") + significant(value)


def to_precision(value: object, sigma: object) -> str:
    """Write a coordinate to the second digit of its standard deviation, six decimals if that is not known."""
    v, s = float(str(value)), float(str(sigma))
    if not np.isfinite(v):
        return "not known"
    decimals = 6 if not (np.isfinite(s) and s > 0) else int(np.clip(1 - np.floor(np.log10(s)), 0, 12))
    return f"{v:.{decimals}f}"


def yes_or_no(value: bool) -> str:
    return "yes" if value else "no"


def _is_number(cell: str | Cell) -> bool:
    if isinstance(cell, Cell) or not cell.lstrip("+-")[:1].isdigit():
        return False
    return not any(c.isalpha() for c in cell.replace("e", ""))


def finer_unit(unit: str, value: float) -> tuple[float, str]:
    """Return by what to multiply lengths of about this size, and the metric unit in which they read well.

    Args:
        unit: object unit of the survey; lengths in a unit that is not metric stay as they are.
        value: the largest of the lengths, in that unit.
    """
    metres = dict((*METRIC, ("cm", 1e-2), ("dm", 1e-1))).get(unit)
    if metres is None or not np.isfinite(value) or value <= 0:
        return 1.0, unit
    name, size = next(((n, s) for n, s in METRIC if value * metres >= s), METRIC[-1])
    return metres / size, name
