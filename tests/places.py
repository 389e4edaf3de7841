"""Where things lie that tests read."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).resolve().parents[1]
DATASETS = ROOT / "datasets"
SHARED = ROOT.parent / "shared"
"""public reference data and figures, which are not part of the project; may be absent"""
ROOMS = tuple(sorted(stub.parent.name for stub in (ROOT / "sfm").glob("**/*/__init__.pyi")))
"""rooms of sfm that have a list of public names"""


def load_page_code(name: str) -> ModuleType:
    """Return a module of docs/, which is no package."""
    spec = importlib.util.spec_from_file_location(name, ROOT / f"docs/{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
