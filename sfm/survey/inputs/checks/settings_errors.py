"""Errors in a survey file, in one line each: file, line, key, what was found and what was needed."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, get_args

from pydantic import ValidationError

from sfm.display import counted, listed
from sfm.files.plain_text import as_plain
from sfm.survey.inputs.settings import Section

MAX_SHOWN = 60  # characters of a key
MAX_TOLD = 10  # keys that one line names
FEW = 3  # values of a list that has a fixed number of them

_NEEDED = (
    ("string_type", "a text in quotes"),
    ("float_type", "a number"),
    ("int_type", "a whole number"),
    ("int_from_float", "a whole number"),
    ("bool_type", "true or false"),
    ("date_type", "a date without quotes, such as 2026-03-01"),
    ("tuple_type", "a list in square brackets"),
    ("finite_number", "a finite number"),
    ("model_type", "a table"),
)


def first_error(path: Path | str, text: str, error: ValidationError, whole: type[Section]) -> str:
    """Return the first error of pydantic as one line with file, line, key, found and needed.

    Unknown keys come first: a misspelt key is unknown, and missing under its right name.

    Args:
        path: the survey file, or what else messages begin with.
        text: its content; empty for settings from Python.
        error: what pydantic found.
        whole: the file as a section, for the keys that it may have.
    """
    errors = error.errors(include_url=False)
    first = next((one for one in errors if one["type"] == "extra_forbidden"), errors[0])
    location = first["loc"]
    kind, context = first["type"], first.get("ctx", {})
    line = _line_of(text, location)
    where = f"{path}, line {line}: " if line else f"{path}: "
    key = _key(location)
    if kind == "extra_forbidden":
        table = _key(location[:-1])
        inside = f"[{table}]" if table else "the file" if text else "it"
        known = _known(location[:-1], whole)
        return f"{where}unknown key '{_key(location[-1:])}' in {inside}, known are {known}"
    if kind == "missing" and isinstance(location[-1], int) and isinstance(first["input"], list | tuple):
        found = _found(list(first["input"]))
        return f"{where}{_key(location[:-1])}: found {found}, needed {counted(location[-1] + 1, 'value')}"
    if kind == "missing":
        every = [_key(one["loc"]) for one in errors if one["type"] == "missing"]
        return f"{where}{listed(every, most=MAX_TOLD)} {'is' if len(every) == 1 else 'are'} missing"
    if kind == "tuple_type" and len(location) == 1 and isinstance(first["input"], dict):
        return f"{where}found [{key}], needed [[{key}]] in double brackets, since there may be several"
    needed = dict(_NEEDED).get(kind)
    if kind == "literal_error":
        needed = f"one of {context['expected']}"
    elif kind == "greater_than":
        needed = f"more than {context['gt']:g}"
    elif kind == "greater_than_equal":
        least = context["ge"]
        needed = "more than 0" if least > 0 >= first["input"] else f"at least {least:g}"
    elif kind == "less_than_equal":
        needed = f"at most {context['le']:g}"
    elif kind == "too_long":
        most = context["max_length"]
        needed = f"{counted(most, 'value')}" if most <= FEW else f"at most {counted(most, 'value')}"
    elif kind == "too_short":
        needed = f"at least {context['min_length']}"
    if needed is None:
        said = first["msg"].removeprefix("Value error, ")
        return f"{where}{key}: {said[0].lower()}{said[1:]}"
    return f"{where}{key}: found {_found(first['input'])}, needed {needed}"


def _found(value: Any) -> str:
    """Show a value as it is in a TOML file, shortened."""
    shown = str(value).lower() if isinstance(value, bool) else repr(value)
    return shown if len(shown) <= 60 else shown[:57] + "..."


def _key(location: tuple[str | int, ...]) -> str:
    """Write a location as a person would: camera 2 pixel_mm, value 1."""
    words: list[str] = []
    for part in location:
        if isinstance(part, int):
            words[-1:] = [f"{words[-1]} {part + 1}"] if words else [str(part + 1)]
        else:
            words.append(as_plain(part[:MAX_SHOWN]))
    return ".".join(words)


def _known(location: tuple[str | int, ...], whole: type[Section]) -> str:
    """Return the keys that the table at a location may have."""
    section = whole
    for key in (part for part in location if isinstance(part, str)):
        fields = {field.alias or name: field for name, field in section.model_fields.items()}
        section = _section_in(fields[key].annotation) or section
    return ", ".join(field.alias or name for name, field in section.model_fields.items())


def _section_in(annotation: Any) -> type[Section] | None:
    """Return the section that the type of a field is, or is a list of."""
    if isinstance(annotation, type) and issubclass(annotation, Section):
        return annotation
    return next(filter(None, (_section_in(part) for part in get_args(annotation))), None)


def _line_of(text: str, location: tuple[str | int, ...]) -> int | None:
    """Return the line of the survey file on which the key of a location is, None if not found."""
    keys = [str(part) for part in location if isinstance(part, str)]
    # An index behind the table is that of a table in double brackets, a later one counts values of a key.
    number = location[1] if len(location) > 1 and isinstance(location[1], int) else 0
    count: dict[str, int] = {}
    table, last = "", None
    for k, line in enumerate(text.splitlines(), 1):
        header = re.match(r"\s*\[\[?([\w.\- \t]+)\]", line)  # without two parts that may share blanks
        if header:
            table = header[1].strip()
            count[table] = count.get(table, -1) + 1
            if table == ".".join(keys) and count[table] == number:
                return k
            if table == keys[0] and count[table] == number:
                last = k
            continue
        key = re.match(r"\s*([\w\-.]+|\"[^\"]*\"|'[^']*')\s*=", line)
        if key and count.get(keys[0], number) == number:
            full = ".".join(filter(None, (table, key[1].strip("\"'"))))
            if full == ".".join(keys):
                return k
    return last
