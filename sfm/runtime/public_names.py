"""Public names of a package, which are imported on first use.

They are listed once, in the stub `__init__.pyi` of their package,
which type checkers and editors read. Every row of the stub is one public name, `from module import name as
name`, or one room, `from place import room as room`. A new name only needs a new row.

Source: lazy loading as in Scientific Python's SPEC 1, https://scientific-python.org/specs/spec-0001/.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from importlib import import_module

Face = tuple[Callable[[str], object], Callable[[], list[str]], list[str]]


def public_names(package: str, folder: str) -> Face:
    """Return `__getattr__`, `__dir__` and `__all__` of a package from its stub.

    Args:
        package: name of the package.
        folder: folder of the package, with its `__init__.pyi`.

    Raises:
        AttributeError: from `__getattr__`, if a name is not public.
    """
    module_of = {}  # module of each name that the stub imports
    with open(os.path.join(folder, "__init__.pyi"), encoding="utf-8") as lines:
        for line in lines:
            if line.startswith("from "):
                _, module_name, _, public, *_ = line.split()
                module_of[public] = f"{package}.{public}" if module_name == "." else module_name
    names = sorted(module_of)

    def get(name: str) -> object:
        if name not in module_of:
            raise AttributeError(f"module '{package}' has no attribute '{name}'", name=name)
        module = import_module(module_of[name])
        if module.__name__ == f"{package}.{name}":
            value: object = module
        elif hasattr(module, name):
            value = getattr(module, name)
        else:  # a room within another
            value = import_module(f"{module_of[name]}.{name}")
        setattr(sys.modules[package], name, value)
        return value

    return get, lambda: list(names), names
