"""Unforeseen errors and lack of memory, reported in one line with the step that failed.

A fault is an error of the program, not of its input. Its traceback is stored in a file for the developers.
"""

from __future__ import annotations

import os
import sys
import tempfile
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sfm.model.errors import KolinearError, one_line

BAD_INPUT = 2  # exit code if a person must correct something
FAULT = 70  # exit code; EX_SOFTWARE of sysexits.h
OPENCV_NO_MEMORY = -4  # cv::Error::StsNoMem
# Messages of the C library if a shared library finds no room (dlopen), and of Python if a thread finds no
# stack.
NO_MEMORY = ("failed to map segment", "annot allocate memory", "can't start new thread")
MAX_LETTERS = 200  # characters of an error message


@contextmanager
def working_on(what: str) -> Iterator[None]:
    """Add a note on the running step to unforeseen errors; the innermost step comes first."""
    try:
        yield
    except KolinearError:
        raise
    except Exception as error:
        error.add_note(what)
        raise


def is_fault(error: Exception) -> bool:
    """Return whether an error is a fault of the program, not of its input, the disk or the memory size."""
    return not (isinstance(error, KolinearError | OSError) or _is_out_of_memory(error))


def error_in_words(error: Exception) -> str:
    """Return an error in one line; a fault with its position in the code, a lack of memory with the step."""
    if isinstance(error, KolinearError | OSError):
        return str(error)
    message = one_line(error)[:MAX_LETTERS]
    at_work = ", ".join(getattr(error, "__notes__", ()))
    if _is_out_of_memory(error):
        reason = "" if message == type(error).__name__ else f" ({message})"
        return f"not enough memory{f' for {at_work}' if at_work else ''}{reason}"
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    kind = type(error).__name__
    text = kind if message == kind else f"{kind}: {message}"
    return f"a fault of Kolinear: {text}{place}{f', at {at_work}' if at_work else ''}"


def ending_of(error: Exception) -> tuple[str, int]:
    """Return the last line of a program and its exit code; the traceback of a fault is stored."""
    text = error_in_words(error)
    if not is_fault(error):
        return text, BAD_INPUT
    path = keep_traceback(error)
    where = "its traceback cannot be written" if path is None else f"its traceback is in {path}"
    return f"{text}; {where}", FAULT


def keep_traceback(error: Exception) -> Path | None:
    """Write a traceback into a new file that only this user can read; None if that fails."""
    from importlib.metadata import version

    lines = (f"kolinear {version('kolinear')}, Python {sys.version}\n", f"{sys.argv}\n\n")
    try:
        number, name = tempfile.mkstemp(prefix="kolinear-fault-", suffix=".txt")
        with os.fdopen(number, "w", encoding="utf-8", errors="backslashreplace") as file:
            file.writelines((*lines, *traceback.format_exception(error)))
    except OSError:
        return None
    return Path(name)


def _is_out_of_memory(error: BaseException | None) -> bool:
    """Return whether an error, or an error that caused it, is a lack of memory."""
    while error is not None:
        said = isinstance(error, ImportError | RuntimeError) and any(
            sentence in str(error) for sentence in NO_MEMORY
        )
        if said or isinstance(error, MemoryError) or getattr(error, "code", None) == OPENCV_NO_MEMORY:
            return True
        error = error.__cause__ or error.__context__
    return False
