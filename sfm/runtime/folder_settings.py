"""Settings of libraries and libraries themselves in the current folder, which may have come with a survey.

numba reads `.numba_config.yaml` there, which can name a folder of compiled functions; they are pickles, and
so programs. matplotlib reads `matplotlibrc` there, which can have every text set by LaTeX. And cv2 puts its
libraries and a colon before LD_LIBRARY_PATH; where that is empty, nothing follows the colon, by which the
linker of every process that is started afterwards understands the current folder. Python looks there first
for modules in the processes of multiprocessing and Dask, which are started with `python -c`.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

from sfm.errors import KolinearError

SETTINGS = (".numba_config.yaml", "matplotlibrc")
LIBRARIES = "LD_LIBRARY_PATH"
MODULES, SAFE_PATH = "PYTHONPATH", "PYTHONSAFEPATH"


def refuse_folder_settings() -> None:
    """Raise KolinearError where the current folder contains settings of a library; before any is imported."""
    for name in SETTINGS:
        if os.path.lexists(name):
            raise KolinearError(
                f"the current folder, {os.getcwd()}, contains '{name}', by which it would decide what is "
                "computed or run; start Kolinear from another folder, or remove the file"
            )


@contextmanager
def closed_current_folder() -> Iterator[None]:
    """Take the current folder out of where processes that are started look for modules and libraries.

    The path of libraries is never left empty meanwhile, so that OpenCV can be imported before or after.
    """
    before = {name: os.environ.get(name) for name in (SAFE_PATH, MODULES, LIBRARIES)}
    os.environ[SAFE_PATH] = "1"
    if modules := _folders(MODULES):
        os.environ[MODULES] = modules
    else:
        os.environ.pop(MODULES, None)
    if os.name != "nt":
        os.environ[LIBRARIES] = _folders(LIBRARIES) or os.path.dirname(os.path.abspath(__file__))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _folders(variable: str) -> str:
    """Return a path of folders without empty ones, which mean the current folder."""
    return os.pathsep.join(folder for folder in os.environ.get(variable, "").split(os.pathsep) if folder)
