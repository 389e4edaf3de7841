"""Settings of libraries and libraries themselves in the current folder, which may have come with a survey.

numba reads `.numba_config.yaml` there, which can name a folder of compiled functions; they are pickles, and
so programs. matplotlib reads `matplotlibrc` there, which can have every text set by LaTeX. And cv2 puts its
libraries and a colon before LD_LIBRARY_PATH; where that is empty, nothing follows the colon, by which the
linker of every process that is started afterwards understands the current folder. Python looks there first
for modules in the processes of multiprocessing and Dask, which are started with `python -c`.
"""

from __future__ import annotations

import os

from sfm.errors import KolinearError

SETTINGS = (".numba_config.yaml", "matplotlibrc")
LIBRARIES = "LD_LIBRARY_PATH"
SAFE_PATH = "PYTHONSAFEPATH"


def refuse_folder_settings() -> None:
    """Raise KolinearError where the current folder holds settings of a library; before any is imported."""
    for name in SETTINGS:
        if os.path.lexists(name):
            raise KolinearError(
                f"the current folder, {os.getcwd()}, holds '{name}', by which it would decide what is "
                "computed or run; start Kolinear from another folder, or remove the file"
            )


def close_current_folder() -> None:
    """Take the current folder out of where processes that are started look for modules and libraries.

    The path of libraries is never left empty, so that OpenCV can be imported before or after.
    """
    os.environ[SAFE_PATH] = "1"
    if os.name != "nt":
        folders = [folder for folder in os.environ.get(LIBRARIES, "").split(os.pathsep) if folder]
        os.environ[LIBRARIES] = os.pathsep.join(folders) or os.path.dirname(os.path.abspath(__file__))
