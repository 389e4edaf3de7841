"""Describes the keys of the survey file, from the models that check it: type, bounds, default and meaning."""

from __future__ import annotations

import ast
import inspect
import typing
from collections.abc import Iterable
from typing import Any

from annotated_types import Ge, Gt, Le, Len, MaxLen
from pydantic_core import PydanticUndefined

from sfm.survey.inputs import settings
from sfm.survey.inputs.settings import Section

KINDS = {"bool": "true | false", "int": "integer", "float": "number", "str": "text"}
SHAPES = {  # types with several values: notation in the file, and type of each value
    "TwoLengths": ("[number, number]", settings.Length),
    "TwoCounts": ("[integer, integer]", settings.Side),
    "Observed": ("table { parameter = [value, sigma] }", settings.Sigma),
    "Values": ("table { parameter = value }", settings.Value),
    "Correlations": ("list of [parameter, parameter, correlation]", settings.Correlation),
    "Marks": ("list of [row, column]", int),
    "Names": ("list of texts", str),
    "Globs": ("text or list of texts", str),
}


def section_of(annotation: Any) -> type[Section]:
    """Return the section class of a field of the survey file, which may be repeated or optional.

    Args:
        annotation: annotation of the field.

    Raises:
        TypeError: the field is not a section.
    """
    if inspect.isclass(annotation) and issubclass(annotation, Section):
        return annotation
    for inner in typing.get_args(annotation):
        if inspect.isclass(inner) and issubclass(inner, Section):
            return inner
    raise TypeError(f"{annotation} has no section")


def rows_of(section: type[Section]) -> list[tuple[str, ...]]:
    """Return key, type, default and meaning of every key of a section."""
    comments: dict[str, str] = {}
    for parent in reversed(section.__mro__):
        if issubclass(parent, Section):  # inherited keys too
            comments |= comments_of(parent)
    rows = []
    for name, field in section.model_fields.items():
        default = "required" if field.default is PydanticUndefined else shown(field.default)
        kind = type_of(field.annotation, field.metadata)
        default = "{}" if default == "[]" and kind.startswith("table") else default
        rows.append((field.alias or name, kind, default, comments.get(name, "")))
    return rows


def comments_of(section: type[Section]) -> dict[str, str]:
    """Return the comment on each field of a section, from the lines before it and at its own lines."""
    source = inspect.getsource(section)
    lines, comments = source.splitlines(), {}
    body: Any = ast.parse(source).body[0]
    for statement in body.body:
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
            said = [line.partition("  # ")[2] for line in lines[statement.lineno - 1 : statement.end_lineno]]
            above = statement.lineno - 2
            while lines[above].lstrip().startswith("# "):
                said.insert(0, lines[above].strip().removeprefix("# "))
                above -= 1
            texts = [text for text in said if text and not text.startswith("type:")]
            if texts:
                comments[statement.target.id] = " ".join(texts)
    return comments


def shown(value: Any) -> str:
    """Return a default value as it is written in a survey file."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    return "[]" if value == () else f'"{value}"' if isinstance(value, str) else str(value)


def type_of(annotation: Any, metadata: Iterable[Any] = ()) -> str:
    """Return the type of a key in words, with its bounds.

    Args:
        annotation: annotation of the field.
        metadata: metadata that pydantic removed from the annotation of a field that is not optional.
    """
    for name, (words, each) in SHAPES.items():
        known = getattr(settings, name)
        if annotation == known or (annotation == typing.get_args(known)[0] and "tuple" in str(annotation)):
            longest = [
                limit.max_length for limit in metadata if isinstance(limit, MaxLen | Len) and limit.max_length
            ]
            return words + bounds_of(typing.get_args(each)[1:]) + "".join(f", at most {n}" for n in longest)
    origin, inner = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Literal:
        return " | ".join(str(literal) for literal in inner)
    if origin is typing.Annotated:
        return type_of(inner[0], inner[1:])
    if type(None) in inner:
        return " | ".join(type_of(alternative) for alternative in inner if alternative is not type(None))
    return KINDS[annotation.__name__] + bounds_of(metadata)


def bounds_of(metadata: Iterable[Any]) -> str:
    """Return the bounds of a number in words; an empty text if it has none."""
    bounds = []
    for constraint in metadata:
        for part in getattr(constraint, "metadata", [constraint]):  # pydantic's Field has several parts
            if isinstance(part, Ge):
                bounds.append(f"from {part.ge:g}")
            elif isinstance(part, Gt):
                bounds.append(f"above {part.gt:g}")
            elif isinstance(part, Le):
                bounds.append(f"to {part.le:g}")
    return f", {' '.join(bounds)}" if bounds else ""
