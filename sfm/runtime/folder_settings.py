"""Settings of libraries that lie in the current folder, which may have come with a survey.

numba reads `.numba_config.yaml` there, which can name a folder of compiled functions; they are pickles, and
so programs. matplotlib reads `matplotlibrc` there, which can have every text set by LaTeX.
"""

from __future__ import annotations

import os

from sfm.errors import KolinearError

SETTINGS = (".numba_config.yaml", "matplotlibrc")


def refuse_folder_settings() -> None:
    """Raise KolinearError where the current folder holds settings of a library; before any is imported."""
    for name in SETTINGS:
        if os.path.lexists(name):
            raise KolinearError(
                f"the current folder, {os.getcwd()}, holds '{name}', by which it would decide what is "
                "computed or run; start Kolinear from another folder, or remove the file"
            )
