"""Arguments of public functions, checked at the border against their annotations.

Where an array is annotated, a function decorated with `checked_arguments` takes whatever numpy makes an array
of. Everything else it refuses in one line: what was found, and what was expected.
"""

from __future__ import annotations

import types
import typing
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from inspect import signature
from numbers import Integral, Real
from typing import Any, ParamSpec, TypeVar

import numpy as np

from sfm.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.errors import GeometryError

P = ParamSpec("P")
R = TypeVar("R")

ARRAYS: tuple[tuple[Any, str, Any, str], ...] = (
    (FloatArray, "iuf", np.float64, "numbers"),
    (IntArray, "iu", np.int64, "whole numbers"),
    (BoolArray, "b", np.bool_, "True and False"),
    (AnyArray, "biuf", None, "numbers"),
)
"""annotation, kinds of values that are taken (numpy's letters), what they become, how they are called"""
SEQUENCES = (list, tuple, Sequence)
DIGITS = frozenset("0123456789")
NUMBERS: Mapping[Any, tuple[type, str]] = {float: (Real, "a number"), int: (Integral, "a whole number")}


def checked_arguments(**shapes: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator that checks the arguments of a function before it begins.

    Args:
        shapes: shape of array arguments by name, as "n 3"; a letter is one length in all of them, "..." any
            number of axes.

    Raises:
        GeometryError: by the function, for an argument of another type or shape.

    Example:
        >>> @checked_arguments(points="n 3")
        ... def centre(points: FloatArray) -> FloatArray:
        ...     return points.mean(axis=0)
        >>> centre([[0, 0, 0], [2, 2, 2]])
        array([1., 1., 1.])
        >>> centre([[0, 0]])
        Traceback (most recent call last):
        sfm.errors.GeometryError: centre: points is an array of shape (1, 2), expected shape (n, 3)
    """
    axes = {name: shape.split() for name, shape in shapes.items()}

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        names = tuple(signature(function).parameters)
        annotated: dict[str, tuple[tuple[Any, ...], frozenset[Any]]] = {}
        called = function.__name__

        def take(name: str, value: object, lengths: dict[str, int]) -> Any:
            if name not in annotated:
                return value  # of no parameter, which Python says itself
            allowed, exact = annotated[name]
            kind = value.dtype if isinstance(value, np.ndarray) else type(value)
            if kind not in exact:
                value = _taken(f"{called}: {name}", value, allowed)
            if name in axes and isinstance(value, np.ndarray):
                before = dict(lengths)
                if not _has_shape(value.shape, axes[name], lengths):
                    raise _wrong_shape(f"{called}: {name}", value.shape, axes[name], before)
            return value

        @wraps(function)
        def checked(*args: P.args, **kwargs: P.kwargs) -> R:
            if not annotated:  # which is read late, when all modules are there
                hints = typing.get_type_hints(function)
                annotated.update({name: _alternatives(hints[name]) for name in names})
            lengths: dict[str, int] = {}
            positional: Any = [take(*pair, lengths) for pair in zip(names, args, strict=False)]
            named: Any = {name: take(name, value, lengths) for name, value in kwargs.items()}
            return function(*(*positional, *args[len(names) :]), **named)

        return checked

    return decorate


def check_indices(where: str, indices: IntArray, count: int) -> None:
    """Refuse indices that lead outside of what they count.

    Args:
        where: the function and its argument.
        indices: any number of them.
        count: of what there is.

    Raises:
        GeometryError: one is negative or too large.
    """
    outside = (indices < 0) | (indices >= count)
    if outside.any():
        raise GeometryError(f"{where} contains {indices[outside][0]}, expected 0 to {count - 1}")


def _alternatives(hint: Any) -> tuple[tuple[Any, ...], frozenset[Any]]:
    """Return the types that an annotation allows, and those of values that need no further look."""
    allowed = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
    arrays = {np.dtype(dtype) for array, _, dtype, _ in ARRAYS if dtype is not None and array in allowed}
    return allowed, frozenset({one for one in allowed if type(one) is type} | arrays)


def _taken(where: str, value: object, allowed: tuple[Any, ...]) -> object:
    """Return an argument, an array made of it where one is expected; GeometryError if it is none of these."""
    for hint in allowed:
        array = next((row for row in ARRAYS if row[0] == hint), None)
        if array is not None:
            made = _array_of(value, array[1], array[2])
            if made is not None:
                return made
        elif _fits(value, hint):
            return _as_annotated(value, hint)
    expected = " or ".join(dict.fromkeys(_called(hint) for hint in allowed))
    raise GeometryError(f"{where} is {_described(value)}, expected {expected}")


def _array_of(value: object, kinds: str, dtype: Any) -> AnyArray | None:
    """Return an array of a value, None if it is none of these kinds."""
    try:
        made = np.asarray(value)
    except (TypeError, ValueError):  # rows of unequal length, or what is no sequence
        return None
    if made.dtype.kind not in kinds and (made.size or made.dtype.kind != "f"):
        return None
    return made if dtype is None else made.astype(dtype, copy=False)


def _as_annotated(value: Any, hint: Any) -> object:
    """Return a value that fits, as the list or tuple of arrays that is annotated."""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if isinstance(value, list | tuple) and origin in SEQUENCES and any(row[0] == inner[0] for row in ARRAYS):
        value = [_taken("", one, inner[:1]) for one in value]
    return origin(value) if origin in (list, tuple) else value


def _fits(value: object, hint: Any) -> bool:
    """Return whether a value is of a type that is no array; elements of sequences are looked at too."""
    if hint is type(None) or hint is None:
        return value is None
    if hint in NUMBERS:
        return isinstance(value, NUMBERS[hint][0])
    if hint is bool:
        return isinstance(value, bool | np.bool_)
    origin, inner = typing.get_origin(hint) or hint, typing.get_args(hint)
    if not isinstance(origin, type) or getattr(origin, "_is_protocol", False):
        return origin is typing.Any or callable(value)
    if origin in SEQUENCES:
        origin = Sequence
    if not isinstance(value, origin) or (isinstance(value, str) and origin is not str):
        return False
    if not isinstance(value, list | tuple) or not inner:  # others may read their elements from files
        return True
    if typing.get_origin(hint) is tuple and Ellipsis not in inner:
        return len(value) == len(inner) and all(map(_is, value, inner))
    return all(_is(one, inner[0]) for one in value)


def _is(value: object, hint: Any) -> bool:
    try:
        _taken("", value, _alternatives(hint)[0])
    except GeometryError:
        return False
    return True


def _has_shape(shape: tuple[int, ...], axes: list[str], lengths: dict[str, int]) -> bool:
    """Return whether an array has a shape, by the lengths of the letters up to now; new ones are added."""
    if axes[0] == "...":
        axes = axes[1:]
        shape = shape[-len(axes) :]
    if len(shape) != len(axes):
        return False
    for axis, length in zip(axes, shape, strict=True):
        if length != (int(axis) if axis in DIGITS else lengths.setdefault(axis, length)):
            return False
    return True


def _wrong_shape(
    where: str, shape: tuple[int, ...], axes: list[str], lengths: dict[str, int]
) -> GeometryError:
    expected = f"({', '.join(axes)}{',' if len(axes) == 1 else ''})"
    known = ", ".join(f"{axis} = {lengths[axis]}" for axis in axes if axis in lengths)
    return GeometryError(
        f"{where} is an array of shape {shape}, expected shape {expected}{' with ' if known else ''}{known}"
    )


def _described(value: object) -> str:
    """Return how a message calls a value: by its kind and shape, or as it is where it is short."""
    if isinstance(value, np.ndarray):
        return f"an array of {value.dtype} of shape {value.shape}"
    if value is None or isinstance(value, str | int | float | bool):
        return repr(value)[:40]
    within = f" of {type(value[0]).__name__}" if isinstance(value, list | tuple) and value else ""
    return f"a {type(value).__name__}{within}"


def _called(hint: Any) -> str:
    """Return an annotation as it is called in a message."""
    for array, _, _, values in ARRAYS:
        if array == hint:
            return f"an array of {values}"
    if hint in NUMBERS:
        return NUMBERS[hint][1]
    if hint is type(None) or hint is None:
        return "None"
    origin, inner = typing.get_origin(hint) or hint, typing.get_args(hint)
    name = getattr(origin, "__name__", str(hint))
    if name == "Callable" or getattr(origin, "_is_protocol", False):
        return "a function"
    elements = f" of {_called(inner[0])}" if name in ("list", "tuple", "Sequence") and inner else ""
    return {"str": "text", "bool": "True or False"}.get(name, name) + elements
