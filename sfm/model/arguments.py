"""Checks the arguments of public functions against their annotations.

A function decorated with `checked_arguments` accepts anything numpy can convert where an array is annotated.
It refuses everything else in one line: what was found, and what was expected.
"""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from inspect import signature
from numbers import Integral, Real
from typing import Any, ParamSpec, TypeVar

import numpy as np

from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.model.errors import GeometryError

P = ParamSpec("P")
R = TypeVar("R")

ARRAYS: tuple[tuple[Any, str, Any, str], ...] = (
    (FloatArray, "iuf", np.float64, "numbers"),
    (IntArray, "iu", np.int64, "whole numbers"),
    (BoolArray, "b", np.bool_, "True and False"),
    (AnyArray, "biuf", None, "numbers"),
)
"""annotation, accepted kinds of values (numpy's letters), resulting dtype, name in messages"""
SEQUENCES = (list, tuple, Sequence)
DIGITS = frozenset("0123456789")
NUMBERS: Mapping[Any, tuple[tuple[type, ...], str]] = {  # what is one, and its name in messages
    float: ((Real,), "a number"),
    int: ((Integral,), "a whole number"),
    bool: ((bool, np.bool_), "True or False"),
}


def checked_arguments(**shapes: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator that checks the arguments of a function before it runs.

    Args:
        shapes: shapes of array arguments by name, such as "n 3"; a letter is the same length in all of them,
            "..." is any number of axes.

    Raises:
        GeometryError: the decorated function is called with an argument of another type or shape.

    Example:
        >>> @checked_arguments(points="n 3")
        ... def centre(points: FloatArray) -> FloatArray:
        ...     return points.mean(axis=0)
        >>> centre([[0, 0, 0], [2, 2, 2]])
        array([1., 1., 1.])
        >>> centre([[0, 0]])
        Traceback (most recent call last):
        sfm.model.errors.GeometryError: centre: points is an array of shape (1, 2), expected shape (n, 3)
    """
    axes = {name: shape.split() for name, shape in shapes.items()}

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        names = tuple(signature(function).parameters)
        annotated: dict[str, tuple[tuple[Any, ...], frozenset[Any]]] = {}
        called = function.__name__

        def check(name: str, value: object, lengths: dict[str, int]) -> Any:
            if name not in annotated:
                return value  # no such parameter: Python raises the error itself
            allowed, exact = annotated[name]
            kind = value.dtype if isinstance(value, np.ndarray) else type(value)
            if kind not in exact:
                value = _checked(f"{called}: {name}", value, allowed)
            if name in axes and isinstance(value, np.ndarray):
                before = dict(lengths)
                if not _has_shape(value.shape, axes[name], lengths):
                    expected = f"({', '.join(axes[name])}{',' if len(axes[name]) == 1 else ''})"
                    known = ", ".join(f"{axis} = {before[axis]}" for axis in axes[name] if axis in before)
                    raise GeometryError(
                        f"{called}: {name} is an array of shape {value.shape}, expected shape {expected}"
                        f"{' with ' if known else ''}{known}"
                    )
            return value

        @wraps(function)
        def checked(*args: P.args, **kwargs: P.kwargs) -> R:
            if not annotated:  # read at the first call, when all modules are imported
                hints = typing.get_type_hints(function)
                annotated.update({name: _alternatives(hints[name]) for name in names})
            lengths: dict[str, int] = {}
            positional: Any = [check(*pair, lengths) for pair in zip(names, args, strict=False)]
            named: Any = {name: check(name, value, lengths) for name, value in kwargs.items()}
            return function(*(*positional, *args[len(names) :]), **named)

        return checked

    return decorate


def checked_fields(cls: type[R]) -> type[R]:
    """Return a dataclass whose fields are checked against their annotations when it is made.

    Args:
        cls: dataclass of settings; arrays stay as they are given.

    Raises:
        GeometryError: the class is called with a value of another type.
    """
    make, names = cls.__init__, tuple(field.name for field in dataclasses.fields(cls))  # type: ignore[arg-type]
    allowed: dict[str, tuple[Any, ...]] = {}

    @wraps(make)
    def checked(self: Any, *args: Any, **kwargs: Any) -> None:
        if not allowed:
            hints = typing.get_type_hints(cls)
            allowed.update({name: _alternatives(hints[name])[0] for name in names})
        for name, value in (*zip(names, args, strict=False), *kwargs.items()):
            if name in allowed:  # Python refuses other names itself
                _checked(f"{cls.__name__}: {name}", value, allowed[name])
        make(self, *args, **kwargs)

    cls.__init__ = checked  # type: ignore[method-assign]
    return cls


def check_indices(where: str, indices: IntArray, count: int) -> None:
    """Refuse indices that are out of range.

    Args:
        where: names of the function and its argument, for the message.
        indices: indices, any shape.
        count: number of elements that they refer to.

    Raises:
        GeometryError: an index is negative or too large.
    """
    outside = (indices < 0) | (indices >= count)
    if outside.any():
        raise GeometryError(f"{where} contains {indices[outside][0]}, expected 0 to {count - 1}")


def _alternatives(hint: Any) -> tuple[tuple[Any, ...], frozenset[Any]]:
    """Return the types that an annotation allows, and those whose values need no further check."""
    allowed = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
    arrays = {np.dtype(dtype) for array, _, dtype, _ in ARRAYS if dtype is not None and array in allowed}
    return allowed, frozenset({alternative for alternative in allowed if type(alternative) is type} | arrays)


def _checked(where: str, value: object, allowed: tuple[Any, ...]) -> object:
    """Return an argument, converted to an array where one is expected; GeometryError if no type fits."""
    for hint in allowed:
        array = next((row for row in ARRAYS if row[0] == hint), None)
        if array is not None:
            _, kinds, dtype, _ = array
            try:
                made = np.asarray(value)
            except (TypeError, ValueError):  # rows of unequal length, or no sequence
                continue
            if made.dtype.kind in kinds or (made.dtype.kind == "f" and not made.size):
                return made if dtype is None else made.astype(dtype, copy=False)
        elif _fits(value, hint):
            origin, inner = typing.get_origin(hint), typing.get_args(hint)
            of_arrays = origin in SEQUENCES and any(row[0] == inner[0] for row in ARRAYS)
            if of_arrays and isinstance(value, list | tuple):
                value = [_checked("", element, inner[:1]) for element in value]
            return origin(value) if origin in (list, tuple) else value
    expected = " or ".join(dict.fromkeys(_type_name(hint) for hint in allowed))
    raise GeometryError(f"{where} is {_describe_value(value)}, expected {expected}")


def _fits(value: object, hint: Any) -> bool:
    """Return whether a value is of a type other than an array; elements of sequences are checked too."""
    if hint is type(None) or hint is None:
        return value is None
    if hint in NUMBERS:
        return isinstance(value, NUMBERS[hint][0])
    origin, inner = typing.get_origin(hint) or hint, typing.get_args(hint)
    if not isinstance(origin, type) or _is_function(origin):
        return origin is typing.Any or callable(value)
    if getattr(origin, "_is_protocol", False):
        return all(hasattr(type(value), name) for name in vars(origin) if not name.startswith("_"))
    if origin in SEQUENCES:
        origin = Sequence
    if not isinstance(value, origin) or (isinstance(value, str) and origin is not str):
        return False
    if not isinstance(value, list | tuple) or not inner:  # other sequences may read elements from files
        return True
    if typing.get_origin(hint) is tuple and Ellipsis not in inner:
        return len(value) == len(inner) and all(map(_matches, value, inner))
    return all(_matches(element, inner[0]) for element in value)


def _matches(value: object, hint: Any) -> bool:
    try:
        _checked("", value, _alternatives(hint)[0])
    except GeometryError:
        return False
    return True


def _has_shape(shape: tuple[int, ...], axes: list[str], lengths: dict[str, int]) -> bool:
    """Return whether an array has a shape; lengths of letters that are new are added to `lengths`."""
    if axes[0] == "...":
        axes = axes[1:]
        shape = shape[-len(axes) :]
    if len(shape) != len(axes):
        return False
    for axis, length in zip(axes, shape, strict=True):
        if length != (int(axis) if axis in DIGITS else lengths.setdefault(axis, length)):
            return False
    return True


def _describe_value(value: object) -> str:
    """Return the description of a value for a message: a short value itself, else its type and shape."""
    if isinstance(value, np.ndarray):
        return f"an array of {value.dtype} of shape {value.shape}"
    if value is None or isinstance(value, str | int | float | bool):
        return repr(value)[:40]
    within = f" of {type(value[0]).__name__}" if isinstance(value, list | tuple) and value else ""
    return f"a {type(value).__name__}{within}"


def _is_function(origin: Any) -> bool:
    """Return whether a type is a protocol of functions."""
    return bool(getattr(origin, "_is_protocol", False)) and "__call__" in vars(origin)


def _type_name(hint: Any) -> str:
    """Return the name of an annotated type for a message."""
    for array, _, _, values in ARRAYS:
        if array == hint:
            return f"an array of {values}"
    if hint in NUMBERS:
        return NUMBERS[hint][1]
    if hint is type(None) or hint is None:
        return "None"
    origin, inner = typing.get_origin(hint) or hint, typing.get_args(hint)
    name = getattr(origin, "__name__", str(hint))
    if name == "Callable" or _is_function(origin):
        return "a function"
    if getattr(origin, "_is_protocol", False):  # described by the first sentence of its docstring
        sentence = (origin.__doc__ or name).partition(".")[0].replace("`", "")
        return sentence[:1].lower() + sentence[1:]
    elements = f" of {_type_name(inner[0])}" if name in ("list", "tuple", "Sequence") and inner else ""
    return {"str": "text"}.get(name, name) + elements
