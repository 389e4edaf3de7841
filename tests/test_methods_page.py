"""The page of methods: its functions exist and give their sources, every module of the rooms is on it."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
import types

import pytest

from tests.places import ROOT

PAGE = (ROOT / "docs" / "methods.md").read_text(encoding="utf-8")
ROOMS = ("sfm.orientation", "sfm.matching", "sfm.comparison", "sfm.planning", "sfm.geometry")
MENTIONED = tuple(dict.fromkeys(re.findall(r"`(sfm(?:\.\w+)+)`", PAGE)))


def is_module(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:  # the parent is a module, the name one of its functions
        return False


FUNCTIONS = tuple(name for name in MENTIONED if not is_module(name))


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_of_the_page_exist_and_give_their_source(name: str) -> None:
    module_name, function_name = name.rsplit(".", 1)
    module = importlib.import_module(module_name)
    function = getattr(module, function_name)
    function = getattr(function, "py_func", function)  # a compiled one keeps the written one here
    assert isinstance(function, types.FunctionType), f"{name} is no function"
    assert function.__module__ == module_name, f"{name} is only imported there"
    own = inspect.getdoc(function) or ""
    assert own, f"{name} has no docstring"
    places = own if module_name.startswith(ROOMS) else own + (module.__doc__ or "")
    assert "Source:" in places, f"{name} gives no source"


@pytest.mark.parametrize("name", [name for name in FUNCTIONS if name.startswith(ROOMS)])
def test_functions_of_the_rooms_say_what_they_take(name: str) -> None:
    module_name, function_name = name.rsplit(".", 1)
    function = getattr(importlib.import_module(module_name), function_name)
    function = getattr(function, "py_func", function)
    parameters = inspect.signature(function).parameters
    doc = inspect.getdoc(function) or ""
    missing = [parameter for parameter in parameters if not re.search(rf"\b{re.escape(parameter)}\b", doc)]
    assert not missing, f"{name} says nothing of {', '.join(missing)}"


def test_every_module_of_the_rooms_is_on_the_page() -> None:
    for room in ROOMS:
        package = importlib.import_module(room)
        for module in pkgutil.walk_packages(package.__path__, room + "."):
            if not module.ispkg:
                on_page = any(name == module.name or name.startswith(module.name + ".") for name in MENTIONED)
                assert on_page, f"{module.name} is not on docs/methods.md"


def test_the_page_names_every_method_of_resection() -> None:
    from sfm.orientation.resection import METHODS

    named = {name.rsplit(".", 1)[1] for name in FUNCTIONS if name.startswith("sfm.orientation.resection.")}
    assert {f"resect_{method.replace('-', '_')}" for method in METHODS} <= named
