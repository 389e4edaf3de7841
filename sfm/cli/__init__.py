"""The entry point of kolinear: runs a command and reports every error in one line.

Slow imports are left to the commands, so Ctrl-C and wrong arguments are answered at once.
"""

from __future__ import annotations

import atexit
import gc
import re
import sys

from sfm.cli.process import INTERRUPTED, INTERRUPTED_TEXT, guard_streams, loading, stopped_once
from sfm.model.errors import KolinearError
from sfm.runtime.installation import ignore_current_folder, load_adapters, refuse_mixed_installation
from sfm.runtime.progress import share_freed_memory

YOUNG_OBJECTS = 100_000  # new objects before Python collects cycles, far more than its default
BAD_INPUT = 2  # exit code of errors that the user can correct


def main() -> None:
    """Run the command line and report every error in one line.

    Exit code 2 is an error that the user can correct, 70 an unforeseen error.
    """
    guard_streams()
    try:
        with stopped_once():
            try:
                share_freed_memory()  # before a second thread starts
                # Rare collection of cycles saves a tenth of the time of a run. At exit, Python would search
                # all objects once more for half a second, which the freeze prevents.
                gc.set_threshold(YOUNG_OBJECTS)
                atexit.register(gc.freeze)
                # checked here too: another project's sfm/__init__.py may have replaced ours
                refuse_mixed_installation()
                ignore_current_folder()
                load_adapters()
                _run()
            finally:
                if sys.stdout is not None:
                    sys.stdout.flush()  # while a full disk can still be reported
    except KolinearError as error:
        _refuse(str(error))
    except OSError as error:  # a disk or a network drive; a traceback would not help
        where = f"{error.filename}: " if error.filename else ""
        _refuse(f"{where}{error.strerror or error}")
    except KeyboardInterrupt:
        print(INTERRUPTED_TEXT, file=sys.stderr)
        raise SystemExit(INTERRUPTED) from None
    except Exception as error:
        from sfm.runtime.faults import ending_of

        message, code = ending_of(error)
        _refuse(message, code=code)


def _run() -> None:
    """Run the command named by the arguments."""
    with loading():
        from sfm.cli.app import USAGE_ERROR, commands
    try:
        code = commands()(prog_name="kolinear", standalone_mode=False)
    except USAGE_ERROR as error:
        command = error.ctx.command_path if error.ctx else "kolinear"
        said, arguments = error.format_message().rstrip(), sys.argv[1:]
        values = (
            following if given == name else given.removeprefix(f"{name}=")
            for name in getattr(getattr(error, "param", None), "opts", ())
            for given, following in zip(arguments, [*arguments[1:], ""], strict=True)
        )
        if "number" in said:
            comma = next((value for value in values if re.fullmatch(r"[-+]?\d+,\d+", value)), None)
            said += "" if comma is None else f"; use a decimal point, not a comma: {comma.replace(',', '.')}"
        _refuse(f"{said} (see {command} --help)".replace(". (see", " (see"))
    if code == INTERRUPTED:  # typer turns Ctrl-C into this code without a message
        raise KeyboardInterrupt
    if isinstance(code, int) and code:
        raise SystemExit(code)


def _refuse(message: str, *, code: int = BAD_INPUT) -> None:
    """Print one line and exit with a code."""
    # without the control characters that a file name may contain
    line = "".join(c if c.isprintable() else " " for c in message)
    print(f"kolinear: {line}", file=sys.stderr)
    raise SystemExit(code) from None
