"""The entry point of kolinear, and the one line that a person reads when something is wrong.

Nothing is imported here that takes time: Ctrl-C and wrong arguments are answered at once.
"""

from __future__ import annotations

import atexit
import gc
import re
import sys
from collections.abc import Sequence
from typing import Any

from sfm.cli.commands.starting import INTERRUPTED, INTERRUPTED_TEXT, guard_streams, loading, stopped_once
from sfm.errors import KolinearError
from sfm.runtime.installation import (
    closed_current_folder,
    load_adapters,
    refuse_folder_settings,
    refuse_mixed_installation,
)
from sfm.runtime.progress import share_freed_memory

YOUNG_OBJECTS = 100_000  # that Python waits for before it looks for cycles, far more than usual
BAD_INPUT = 2  # exit code where a person must put something right


def main() -> None:
    """Run the command line; every error is one line.

    Exit code 2 means something that a person can put right, 70 an unforeseen error.
    """
    guard_streams()
    try:
        with stopped_once():
            try:
                _begin()
                with closed_current_folder():
                    _run()
            finally:
                if sys.stdout is not None:
                    sys.stdout.flush()  # while a full disk can still be reported
    except KolinearError as error:
        _refuse(str(error))
    except OSError as error:  # a disk, a network drive: nothing that a traceback would help with
        where = f"{error.filename}: " if error.filename else ""
        _refuse(f"{where}{error.strerror or error}")
    except KeyboardInterrupt:
        print(INTERRUPTED_TEXT, file=sys.stderr)
        raise SystemExit(INTERRUPTED) from None
    except Exception as error:
        _report_fault(error)


def _begin() -> None:
    """Refuse what must not decide what is run, and look for cycles less often: a tenth of the time of a run.

    At the end Python would look through all objects again, for half a second.
    """
    share_freed_memory()  # before there is a second thread
    gc.set_threshold(YOUNG_OBJECTS)
    atexit.register(gc.freeze)
    refuse_mixed_installation()  # asked here too: the other project's sfm/__init__.py may lie over ours
    refuse_folder_settings()
    load_adapters()


def _run() -> None:
    """Run the command that the arguments name."""
    with loading():
        from sfm.cli.app import USAGE_ERROR, commands
    try:
        code = commands()(prog_name="kolinear", standalone_mode=False)
    except USAGE_ERROR as error:
        if not sys.argv[1:]:  # which asks for the help, and is no mistake
            error.show()
            raise SystemExit(BAD_INPUT) from None
        command = error.ctx.command_path if error.ctx else "kolinear"
        said = f"{error.format_message().rstrip()}{_decimal_comma(error, sys.argv[1:])}"
        _refuse(f"{said} (see {command} --help)".replace(". (see", " (see"))
    if code == INTERRUPTED:  # which typer makes of Ctrl-C without a message
        raise KeyboardInterrupt
    if isinstance(code, int) and code:
        raise SystemExit(code)


def _decimal_comma(error: Any, arguments: Sequence[str]) -> str:
    """Return what is wrong with a decimal comma in a numeric option; nothing for other errors."""
    if "number" not in error.format_message():
        return ""
    for name in getattr(getattr(error, "param", None), "opts", ()):
        for given, following in zip(arguments, (*arguments[1:], ""), strict=True):
            value = following if given == name else given.removeprefix(f"{name}=")
            if re.fullmatch(r"[-+]?\d+,\d+", value):
                return f"; a number has a decimal point, not a comma: {value.replace(',', '.')}"
    return ""


def _report_fault(error: Exception) -> None:
    """End with one line about an unforeseen error; not enough memory is something to put right."""
    from sfm.runtime.faults import ending_of

    message, code = ending_of(error)
    _refuse(message, code=code)


def _refuse(message: str, *, code: int = BAD_INPUT) -> None:
    """End with one line and an exit code."""
    print(f"kolinear: {_printable(message)}", file=sys.stderr)
    raise SystemExit(code) from None


def _printable(text: str) -> str:
    """Return a message on one line, without control characters that a file name may carry."""
    return "".join(c if c.isprintable() else " " for c in text)
