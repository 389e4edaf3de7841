"""TOML files read as untrusted: what makes the standard library's parser slow is refused before it runs."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

from sfm.errors import SurveyFileError
from sfm.files.plain_text import as_plain

MAX_TOML_BYTES = 1_000_000  # such a file is written by people; anything larger is another file
MAX_SAID = 200  # characters of what the parser says
MAX_KEY_PARTS = 16  # of a dotted key: the parser takes time and memory with their square; 3 are of use

_PART = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(rf"(?<![\w-]){_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{{MAX_KEY_PARTS}}}")


def read_toml(path: Path, what: str) -> tuple[str, dict[str, Any]]:
    """Return the text of a file and its table.

    Args:
        path: the file.
        what: it is, with its article, for messages.

    Raises:
        SurveyFileError: unreadable, too large, or no TOML.
    """
    try:
        if path.exists() and not path.is_file():  # reading a pipe would never end
            raise SurveyFileError(f"{path}: not a file, {what} (TOML) is needed")
        size = path.stat().st_size
        if size > MAX_TOML_BYTES:
            raise SurveyFileError(f"{path}: {size} bytes, {what} has at most {MAX_TOML_BYTES}")
        text = path.read_text(encoding="utf-8-sig")  # editors of Windows put a byte order mark first
    except OSError as error:
        raise SurveyFileError(f"{path}: {what} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise SurveyFileError(
            f"{path}: not a text file in UTF-8 (byte {error.start}); save it as such"
        ) from error
    long = _LONG_KEY.search(text)
    if long:
        line = text.count("\n", 0, long.start()) + 1
        raise SurveyFileError(f"{path}, line {line}: more than {MAX_KEY_PARTS} words joined by dots")
    try:
        return text, tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SurveyFileError(f"{path}: not a TOML file: {_cut(str(error))}") from error
    except (ValueError, RecursionError) as error:
        told = "brackets nested too deeply" if isinstance(error, RecursionError) else "a number is too long"
        raise SurveyFileError(f"{path}: not a TOML file: {told}") from error


def _cut(message: str) -> str:
    """Return what the parser says without the middle of a long key; where it stands comes last."""
    kept = (
        message if len(message) <= MAX_SAID else f"{message[: MAX_SAID // 2]} ... {message[-MAX_SAID // 2 :]}"
    )
    return as_plain(kept)
