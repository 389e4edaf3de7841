"""The installation: foreign packages of the same names, and settings in the current folder.

Two other projects on the registry have packages with the names of Kolinear's two packages, and a user may
have a folder of such a name. Installers silently merge packages of one name into one folder, in which the
last `__init__.py` remains. Therefore Kolinear finds its packages by their path, and refuses to run if files
of other projects are among them.

The current folder may contain settings of libraries, or modules, that came with a survey of a stranger. numba
reads `.numba_config.yaml` there, which can name a folder of compiled functions. These are pickles, and thus
programs. matplotlib reads `matplotlibrc` there, which can have every text set by LaTeX. Python searches it
first for modules in processes of multiprocessing and Dask, which are started with `python -c`, unless
PYTHONSAFEPATH is set.
"""

from __future__ import annotations

import os
import sys
from importlib.util import module_from_spec, spec_from_file_location

from sfm.model.errors import InstallationError, KolinearError

SETTINGS = (".numba_config.yaml", "matplotlibrc")
FOREIGN = (os.path.join("sfm", "binarysearch.py"), os.path.join("adapters", "composition.py"))
"""a file of each of the other projects, PyPI's sfm and adapters, that Kolinear does not have"""
ROOT = os.path.abspath(os.path.join(__file__, *[os.pardir] * 3))
COMMANDS = ("kolinear", "kolinear.exe", "-m")  # these print one line and no traceback
BAD_INPUT = 2


def refuse_mixed_installation() -> None:
    """Raise InstallationError if Kolinear's packages have files of other projects; two calls of stat."""
    for file in FOREIGN:
        path = os.path.join(ROOT, file)
        if os.path.exists(path):
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
    """Import the package `adapters` beside sfm, even if the search path has another one of that name first.

    Raises:
        InstallationError: another package of that name is already imported.
    """
    installed = os.path.join(ROOT, "adapters")
    loaded = sys.modules.get("adapters")
    if loaded is not None:
        folders = list(getattr(loaded, "__path__", ()))
        if [os.path.realpath(folder) for folder in folders] == [os.path.realpath(installed)]:
            return
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


def ignore_current_folder() -> None:
    """Keep new processes from importing modules of the current folder; call it before importing libraries.

    Raises:
        KolinearError: the folder has settings of a library.
    """
    refuse_folder_settings()
    os.environ["PYTHONSAFEPATH"] = "1"


def refuse_folder_settings() -> None:
    """Raise KolinearError if the current folder has settings of a library; call it before importing any."""
    for name in SETTINGS:
        if os.path.lexists(name):
            raise KolinearError(
                f"the current folder, {os.getcwd()}, contains '{name}', which would decide what is "
                "computed or run; start Kolinear from another folder, or remove the file"
            )
