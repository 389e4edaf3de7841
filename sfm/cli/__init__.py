"""The entry point of kolinear, and the one line that a person reads when something is wrong.

Nothing is imported here that takes time: Ctrl-C and wrong arguments are answered at once.
"""

from __future__ import annotations

import io
import sys

from sfm.cli.starting import INTERRUPTED, INTERRUPTED_TEXT, loading, stopped_once
from sfm.errors import KolinearError

BAD_INPUT = 2  # exit code where a person must put something right


def main() -> None:
    """Run the command line; errors that a person can put right are one line and exit code 2."""
    if isinstance(sys.stdout, io.TextIOWrapper):  # of a code page that lacks a name's letters
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        with stopped_once():
            _run()
    except KolinearError as error:
        _refuse(str(error))
    except OSError as error:  # a disk, a network drive: nothing that a traceback would help with
        where = f"{error.filename}: " if error.filename else ""
        _refuse(f"{where}{error.strerror or error}")
    except KeyboardInterrupt:
        print(INTERRUPTED_TEXT, file=sys.stderr)
        raise SystemExit(INTERRUPTED) from None


def _run() -> None:
    """Run the command that the arguments name."""
    with loading():
        from sfm.cli.app import USAGE_ERROR, app
    try:
        code = app(prog_name="kolinear", standalone_mode=False)
    except USAGE_ERROR as error:
        if not sys.argv[1:]:  # which asks for the help, and is no mistake
            error.show()
            raise SystemExit(BAD_INPUT) from None
        command = error.ctx.command_path if error.ctx else "kolinear"
        _refuse(f"{error.format_message().rstrip()} (see {command} --help)".replace(". (see", " (see"))
    if code == INTERRUPTED:  # which is what typer makes of Ctrl-C, and says nothing
        raise KeyboardInterrupt
    if isinstance(code, int) and code:
        raise SystemExit(code)


def _refuse(message: str) -> None:
    """End with one line and the exit code of bad input."""
    print(f"kolinear: {_printable(message)}", file=sys.stderr)
    raise SystemExit(BAD_INPUT) from None


def _printable(text: str) -> str:
    """Return a message on one line, without control characters that a file name may carry."""
    return "".join(c if c.isprintable() else " " for c in text)
