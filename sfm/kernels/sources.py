"""The sources that a module depends on: itself and those of every module of the package that it imports.

Expensive results on disk, compiled kernels and measurements of photographs, are kept
for these sources. Numba itself looks at the file of a kernel only, not at those of the functions compiled
into it.
"""

from __future__ import annotations

import hashlib
import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
IMPORT = re.compile(r"^\s*from (sfm[\w.]*) import (\([^)]*\)|[^\n]*)", re.MULTILINE)


def sources_of(*modules: str) -> dict[str, str]:
    """Return the source of modules and of all that they import of this package, by name."""
    found: dict[str, str] = {}
    left = list(modules)
    while left:
        name = left.pop()
        source = None if name in found else _source(name)
        if source is not None:
            found[name] = source
            left += _imported(name)
    return found


@cache
def source_hash(module: str) -> str | None:
    """Return the SHA-256 of a module and of all that it imports of this package; None for other modules."""
    if _source(module) is None:
        return None
    digest = hashlib.sha256()
    for _, source in sorted(sources_of(module).items()):
        digest.update(source.encode())
    return digest.hexdigest()


@cache
def _source(name: str) -> str | None:
    """Return the source of a module or package; None if no file is one."""
    path = ROOT.joinpath(*name.split("."))
    for file in (path.with_suffix(".py"), path / "__init__.py"):
        if file.is_file():
            return file.read_text(encoding="utf-8")
    return None


@cache
def _imported(name: str) -> tuple[str, ...]:
    """Return what a module imports of this package: modules, and names in them that may be modules too."""
    found = []
    for module, names in IMPORT.findall(_source(name) or ""):
        found.append(module)
        found += [f"{module}.{word}" for word in re.findall(r"\w+", names)]
    return tuple(found)
