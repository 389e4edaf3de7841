"""The pages of theory: what they name exists, and every method of the methods page is reached from them."""

from __future__ import annotations

import importlib
import importlib.util
import re

import pytest

from tests.places import ROOT

TICKED = r"`((?:sfm|adapters)(?:\.\w+)+)`"
PAGES = {
    page.name: page.read_text(encoding="utf-8")
    for page in sorted((ROOT / "docs/theory").glob("*.md"))
    if page.name != "index.md"
}
NAMED = set(re.findall(TICKED, "\n".join(PAGES.values())))
METHODS = (ROOT / "docs/methods.md").read_text(encoding="utf-8").partition("## The modules of these rooms")[0]


def module_of(name: str) -> str:
    """Return the longest part of a name that is a module."""
    module, _, _ = name.rpartition(".")
    try:
        return name if importlib.util.find_spec(name) else module_of(module)
    except ModuleNotFoundError:  # the part before the last is a module, the last one of its functions
        return module_of(module)


@pytest.mark.parametrize("page", PAGES)
def test_every_function_of_the_pages_exists(page: str) -> None:
    names = re.findall(TICKED, PAGES[page])
    assert len(names) > 10
    for name in names:
        module = module_of(name)
        rest = name.removeprefix(module).strip(".")
        assert not rest or hasattr(importlib.import_module(module), rest), f"{page}: there is no {name}"


def source_of(name: str) -> str:
    """Return the module in which a function of a room is written."""
    module = module_of(name)
    value = getattr(importlib.import_module(module), name.removeprefix(module).strip("."), None)
    return getattr(value, "__module__", module)


def test_every_method_is_reached_from_the_theory() -> None:
    """Its function is named there, or another one of its module."""
    reached = {source_of(name) for name in NAMED}
    missing = sorted({name for name in re.findall(TICKED, METHODS) if source_of(name) not in reached})
    assert not missing, missing
