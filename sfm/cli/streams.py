"""Printing where a code page lacks characters, a disk is full or a reader ends early."""

from __future__ import annotations

import io
import os
import sys
from typing import Any, TextIO

READER_GONE = 141  # exit code; 128 + SIGPIPE, as a shell reports it of other programs


def guard_streams() -> None:
    """Make stdout and stderr tolerate readers that end and names that they cannot encode.

    A reader of stdout that ends, as `head` does, ends the program quietly; one of stderr ends nothing. Lines
    of both have their order where both go to one file or pipe.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):  # of a code page that lacks a name's letters
        sys.stdout.reconfigure(errors="backslashreplace")
    if sys.stdout is sys.__stdout__:
        sys.stdout = _guarded(sys.stdout, ends_program=True)
    if sys.stderr is sys.__stderr__:
        sys.stderr = _guarded(sys.stderr, ends_program=False)


def _guarded(outlet: TextIO | None, *, ends_program: bool) -> TextIO | None:
    """Return what writes to the same file, pipe or socket; terminals and absent streams stay as they are."""
    if not isinstance(outlet, io.TextIOWrapper) or outlet.isatty():
        return outlet
    outlet.flush()
    return io.TextIOWrapper(
        io.BufferedWriter(_Outlet(outlet.fileno(), ends_program=ends_program)),
        encoding=outlet.encoding,
        errors="backslashreplace",
        line_buffering=outlet.line_buffering or not ends_program,
    )


class _Outlet(io.FileIO):
    """An open file that is tried no more once it could not be written.

    Python would try again at its end, and typer and rich take a reader that has ended for exit code 1.
    """

    def __init__(self, number: int, *, ends_program: bool) -> None:
        super().__init__(number, "wb", closefd=False)
        self._ends_program = ends_program

    def write(self, data: Any) -> int:
        if not self._ends_program and sys.stdout is not None and not sys.stdout.closed:
            sys.stdout.flush()  # what was printed before
        try:
            return super().write(data) or 0
        except OSError as error:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self.fileno())
            os.close(nowhere)
            if not isinstance(error, BrokenPipeError):
                raise
            if self._ends_program:
                raise SystemExit(READER_GONE) from None
            return len(data)
