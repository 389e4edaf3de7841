"""The page of methods: each is one import and gives its source, and every module of the rooms is there."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import pkgutil
import re
from types import FunctionType, ModuleType

import pytest

import sfm
from tests.places import ROOT

PAGE = (ROOT / "docs" / "methods.md").read_text(encoding="utf-8")
ROOMS = (
    *("sfm.orientation", "sfm.textbook", "sfm.matching"),
    *("sfm.comparison", "sfm.products.planning", "sfm.products.geometry"),
)
MENTIONED = tuple(dict.fromkeys(re.findall(r"`(sfm(?:\.\w+)+)`", PAGE)))


def is_module(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:  # the parent is a module, the name one of its functions
        return False


FUNCTIONS = tuple(name for name in MENTIONED if not is_module(name))


def room_and_function(name: str) -> tuple[ModuleType, FunctionType]:
    room, _, function = name.rpartition(".")
    module = importlib.import_module(room)
    return module, getattr(module, function)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_methods_are_one_import_and_give_their_source(name: str) -> None:
    room, function = room_and_function(name)
    assert isinstance(function, FunctionType), f"{name} is no function"
    faces = {getattr(sfm, public) for public in dir(sfm) if isinstance(getattr(sfm, public), ModuleType)}
    assert room in faces, f"{name} is not in the list of a room"
    if hasattr(room, "__path__"):
        assert name.rpartition(".")[2] in room.__all__
    own = inspect.getdoc(function) or ""
    assert own, f"{name} has no docstring"
    module = importlib.import_module(function.__module__)
    places = own if name.startswith(ROOMS) else own + (module.__doc__ or "")
    assert "Source:" in places, f"{name} gives no source"


@pytest.mark.parametrize("name", [name for name in FUNCTIONS if name.startswith(ROOMS)])
def test_functions_of_the_rooms_say_what_they_take(name: str) -> None:
    _, function = room_and_function(name)
    parameters = inspect.signature(function).parameters
    doc = inspect.getdoc(function) or ""
    missing = [parameter for parameter in parameters if not re.search(rf"\b{re.escape(parameter)}\b", doc)]
    assert not missing, f"{name} says nothing of {', '.join(missing)}"


def test_every_module_of_the_rooms_is_on_the_page() -> None:
    on_page = {*MENTIONED, *(room_and_function(name)[1].__module__ for name in FUNCTIONS)}
    for room in ROOMS:
        package = importlib.import_module(room)
        for module in pkgutil.walk_packages(package.__path__, room + "."):
            if not module.ispkg:
                assert module.name in on_page, f"{module.name} is not on docs/methods.md"


def test_the_page_names_every_method_of_resection() -> None:
    from sfm.textbook.resection import METHODS

    named = {name.rpartition(".")[2] for name in FUNCTIONS}
    assert {f"resect_{method.replace('-', '_')}" for method in METHODS} <= named
