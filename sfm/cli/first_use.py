"""The first command of an installation, which compiles the kernels, all cores at it."""

from __future__ import annotations

import sys


def compile_first() -> None:
    """Compile the kernels of a survey unless it was done for these sources, and report it on stderr."""
    from sfm.kernels.warmed import is_warm

    if is_warm():
        return
    from sfm import warm_up
    from sfm.runtime.progress_bar import drawn_progress

    print("kolinear: compiling the kernels, once, a minute or two", file=sys.stderr, flush=True)
    with drawn_progress() as drawn:
        warm_up.main(drawn)
