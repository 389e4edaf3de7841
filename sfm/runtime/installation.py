"""Kolinear's two packages found by their place, and whether files of other projects lie among them.

Two projects on the registry have packages of the same names, and a user may have a folder of such a name.
Python packages of one name are merged into one folder without a word, and the `__init__.py` of whichever came
last is left.
"""

from __future__ import annotations

import os
import sys
from importlib.util import module_from_spec, spec_from_file_location

FOREIGN = (os.path.join("sfm", "binarysearch.py"), os.path.join("adapters", "composition.py"))
"""a file that each of the others has, PyPI's sfm and adapters, and Kolinear has not"""
ROOT = os.path.abspath(os.path.join(__file__, *[os.pardir] * 3))
COMMANDS = ("kolinear", "kolinear.exe", "-m")  # who starts these reads one line and no traceback
BAD_INPUT = 2


def refuse_mixed_installation(root: str | None = None) -> None:
    """Raise InstallationError where another project's files lie in Kolinear's packages; two calls of stat.

    Args:
        root: folder of the packages; that of this one if not given.
    """
    root = root or ROOT
    for file in FOREIGN:
        path = os.path.join(root, file)
        if os.path.exists(path):
            from sfm.errors import InstallationError

            name = os.path.dirname(file)
            line = (
                f"{path}: a file of another project, whose package is called {name} too; install Kolinear "
                "into a separate environment"
            )
            if os.path.basename(sys.argv[0]) in COMMANDS:
                print(f"kolinear: {line}", file=sys.stderr)
                raise SystemExit(BAD_INPUT)
            raise InstallationError(line)


def load_adapters() -> None:
    """Import the package `adapters` beside sfm, also where the search path finds another of that name first.

    Raises:
        InstallationError: another package of that name is imported already.
    """
    installed = os.path.join(ROOT, "adapters")
    loaded = sys.modules.get("adapters")
    if loaded is not None:
        folders = list(getattr(loaded, "__path__", ()))
        if [os.path.realpath(folder) for folder in folders] == [os.path.realpath(installed)]:
            return
        from sfm.errors import InstallationError

        where = folders[0] if folders else getattr(loaded, "__file__", None)
        raise InstallationError(
            f"{where}: a package called adapters is imported, and Kolinear has one of that name; rename yours"
        )
    spec = spec_from_file_location(
        "adapters", os.path.join(installed, "__init__.py"), submodule_search_locations=[installed]
    )
    if spec is None or spec.loader is None:
        raise ImportError(f"{installed}: not a package", name="adapters")
    sys.modules["adapters"] = package = module_from_spec(spec)
    spec.loader.exec_module(package)
