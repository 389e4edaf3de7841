"""Libraries of the formats of point clouds, which come with an extra."""

from __future__ import annotations

from types import ModuleType

import pytest

WITHOUT = "the extra kolinear[exchange] is not installed"
LIBRARIES = {"laz": ("lazrs", "laspy"), "e57": ("pye57",)}


def library(form: str) -> ModuleType | None:
    """Return the library of a format of point clouds, None of another; skip where its extra is missing."""
    modules = [pytest.importorskip(name, reason=WITHOUT) for name in LIBRARIES.get(form, ())]
    return modules[-1] if modules else None
