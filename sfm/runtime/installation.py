"""Whether files of other projects lie among Kolinear's: two on the registry have packages of the same names.

Python packages of one name are merged into one folder without a word, and the `__init__.py` of whichever came
last is left.
"""

from __future__ import annotations

import os
import sys

FOREIGN = (os.path.join("sfm", "binarysearch.py"), os.path.join("adapters", "composition.py"))
"""a file that each of the others has, PyPI's sfm and adapters, and Kolinear has not"""
COMMANDS = ("kolinear", "kolinear.exe", "-m")  # who starts these reads one line and no traceback
BAD_INPUT = 2


def refuse_foreign_files(root: str | None = None) -> None:
    """Raise InstallationError where another project's files lie in Kolinear's packages; two calls of stat.

    Args:
        root: folder of the packages; that of this one if not given.
    """
    root = root or os.path.abspath(os.path.join(__file__, *[os.pardir] * 3))
    for file in FOREIGN:
        path = os.path.join(root, file)
        if os.path.exists(path):
            from sfm.errors import InstallationError

            name = os.path.dirname(file)
            line = (
                f"{path}: a file of another project, whose package is called {name} too; install Kolinear "
                "into an environment of its own"
            )
            if os.path.basename(sys.argv[0]) in COMMANDS:
                print(f"kolinear: {line}", file=sys.stderr)
                raise SystemExit(BAD_INPUT)
            raise InstallationError(line)
