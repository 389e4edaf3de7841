"""Arguments at the border: what is taken, what it becomes, and what a refusal states."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from sfm.model.arguments import check_indices, checked_arguments
from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.model.errors import GeometryError


@checked_arguments(points="n 3", weights="n", rotation="... 3 3")
def collect(
    points: FloatArray | None = None,
    *,
    weights: FloatArray | None = None,
    rotation: FloatArray | None = None,
    index: IntArray | None = None,
    used: BoolArray | None = None,
    grey: AnyArray | None = None,
    paths: Sequence[FloatArray] = (),
    names: Sequence[str] | IntArray = (),
    size: tuple[int, int] = (1, 1),
    order: list[str] | None = None,
    tolerance: float = 1.0,
    count: int = 1,
    robust: bool = False,
    given: Mapping[str, float] | None = None,
    judge: Callable[[int], float] | None = None,
) -> dict[str, Any]:
    """Return the arguments."""
    return dict(locals())


@pytest.mark.parametrize(
    ("name", "value", "becomes"),
    [
        ("points", [[1, 2, 3]], np.float64),
        ("points", np.ones((2, 3), dtype=np.float32), np.float64),
        ("index", [], np.int64),
        ("index", np.array([1, 2], dtype=np.int32), np.int64),
        ("used", [True, False], np.bool_),
        ("grey", np.zeros((2, 2), dtype=np.uint8), np.uint8),
        ("names", [3, 1], np.int64),
        ("names", ["a"], list),
        ("paths", [[[1, 2]], np.ones((1, 2))], list),
        ("size", [3, 4], tuple),
        ("order", ("a", "b"), list),
        ("tolerance", np.float32(2), np.float32),
        ("count", np.int32(2), np.int32),
        ("robust", np.bool_(True), np.bool_),
        ("given", {"a": 1.0}, dict),
        ("judge", abs, type(abs)),
        ("judge", None, type(None)),
    ],
)
def test_what_is_taken(name: str, value: object, becomes: Any) -> None:
    found = collect(**{name: value})[name]  # type: ignore[arg-type]
    assert found.dtype == becomes if isinstance(found, np.ndarray) else type(found) is becomes
    if name == "paths":
        assert all(isinstance(path, np.ndarray) for path in found)


@pytest.mark.parametrize(
    ("name", "value", "states"),
    [
        ("points", "x", "is 'x', expected an array of numbers or None"),
        ("points", [[1, 2], [3]], "is a list of list, expected an array of numbers"),
        ("points", np.array(["a"]), "is an array of <U1 of shape (1,), expected an array of numbers"),
        ("points", np.zeros(3), "is an array of shape (3,), expected shape (n, 3)"),
        ("points", np.zeros((3, 2)), "is an array of shape (3, 2), expected shape (n, 3)"),
        ("rotation", np.zeros(3), "is an array of shape (3,), expected shape (..., 3, 3)"),
        ("index", [1.5], "is a list of float, expected an array of whole numbers"),
        ("used", [1, 0], "is a list of int, expected an array of True and False"),
        ("names", "abc", "is 'abc', expected Sequence of text or an array of whole numbers"),
        ("size", (1, 2, 3), "is a tuple of int, expected tuple of a whole number"),
        ("paths", [["a"]], "is a list of list, expected Sequence of an array of numbers"),
        ("tolerance", "1", "is '1', expected a number"),
        ("tolerance", None, "is None, expected a number"),
        ("count", 1.5, "is 1.5, expected a whole number"),
        ("robust", 1, "is 1, expected True or False"),
        ("given", [1], "is a list of int, expected Mapping or None"),
        ("judge", 3, "is 3, expected a function or None"),
    ],
)
def test_what_is_refused(name: str, value: object, states: str) -> None:
    with pytest.raises(GeometryError) as caught:
        collect(**{name: value})  # type: ignore[arg-type]
    assert str(caught.value).startswith(f"collect: {name} {states}")


def test_a_letter_is_one_length() -> None:
    assert len(collect(np.zeros((4, 3)), weights=[1, 1, 1, 1])["weights"]) == 4
    with pytest.raises(
        GeometryError, match=r"weights is an array of shape \(3,\), expected shape \(n,\) with n = 4"
    ):
        collect(np.zeros((4, 3)), weights=[1, 1, 1])


def test_arguments_that_no_function_has_are_left_to_python() -> None:
    for call in (lambda: collect(1, 2), lambda: collect(scale=3)):
        with pytest.raises((TypeError, GeometryError)):
            call()  # type: ignore[no-untyped-call]
    with pytest.raises(TypeError, match="scale"):
        collect(scale=3)  # type: ignore[call-arg]


class Unread(Sequence[Any]):
    """A sequence whose elements cost something, as photographs that are read when they are asked for."""

    def __len__(self) -> int:
        return 3

    def __getitem__(self, index: Any) -> Any:
        raise AssertionError("an element was asked for")


def test_elements_that_are_read_from_files_are_left_alone() -> None:
    paths = Unread()
    assert collect(paths=paths)["paths"] is paths


def test_indices_lead_to_something() -> None:
    check_indices("f: point", np.array([0, 4]), 5)
    check_indices("f: point", np.zeros(0, dtype=np.int64), 0)
    for wrong in (5, -1):
        with pytest.raises(GeometryError, match=f"f: point contains {wrong}, expected 0 to 4"):
            check_indices("f: point", np.array([0, wrong]), 5)
