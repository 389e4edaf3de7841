"""TOML files read as untrusted: what makes the standard library's parser slow is refused before it runs."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Collection
from pathlib import Path
from typing import Any

from sfm.errors import SurveyFileError
from sfm.files.plain_text import as_plain

MAX_TOML_BYTES = 1_000_000  # such a file is written by people; anything larger is another file
MAX_SAID = 200  # characters of the text of the parser
MAX_KEY_PARTS = 16  # of a dotted key: the parser takes time and memory with their square; 3 are of use

# Usual mistakes in TOML: what the line looks like, and what to write.
SLIPS = (
    (
        re.compile(r"=\s*(?:[-+]?\d+,\d+\s*(?:#.*)?$|\[[^\]\"']*\d,0\d)"),
        "a number has a decimal point, not a comma",
    ),
    (re.compile("[\u201c\u201d\u201e\u2018\u2019]"), "text must be in straight quotation marks, \" or '"),
    (
        re.compile(r'"[^"\n]*\\[^"\n]*"'),
        "write / in a path, or put it between single quotation marks",
    ),
    (re.compile(r"=\s*(?:True|False|yes|no|on|off)\b", re.IGNORECASE), "write true or false"),
    (
        re.compile(r"^\s*\[{1,2}[^\]]*$|^\s*\[\[[^\]]*\][^\]]*$"),
        "a section must be in [ ] or [[ ]]",
    ),
    (re.compile(r"=\s*(?:#.*)?$"), "no value follows the ="),
    (re.compile(r"=\s*[^\W\d][^\"']*$"), "text must be in quotation marks"),
    (re.compile(r"^[^=\[#]+$"), "neither a section in [ ] nor a key with = and its value"),
)

_SECTION = re.compile(r"^\s*\[{1,2}\s*([^\[\]]+?)\s*\]{1,2}\s*(?:#.*)?$")
_PART = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(rf"(?<![\w-]){_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{{MAX_KEY_PARTS}}}")


def read_toml(path: Path, what: str, *, repeated: Collection[str] = ()) -> tuple[str, dict[str, Any]]:
    """Return the text of a file and its table.

    Args:
        path: the file.
        what: it is, with its article, for messages.
        repeated: sections of which a file may have several, each in [[ ]].

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
        raise SurveyFileError(f"{path}{_slip(text, str(error), repeated)}") from error
    except (ValueError, RecursionError) as error:
        reason = "brackets nested too deeply" if isinstance(error, RecursionError) else "a number is too long"
        raise SurveyFileError(f"{path}: not a TOML file: {reason}") from error


def _slip(text: str, message: str, repeated: Collection[str]) -> str:
    """Return where and what is wrong in words; the text of the parser where it is nothing usual."""
    found = re.search(r"\(at line (\d+), column \d+\)$", message)
    number = int(found[1]) if found else 0
    line = text.splitlines()[number - 1] if 0 < number <= text.count("\n") + 1 else ""
    if (section := _SECTION.match(line)) and message.startswith(("Cannot declare", "Cannot overwrite")):
        return f", line {number}: {_doubled(text.splitlines(), number, section[1], repeated)}"
    if message.startswith("Cannot overwrite a value"):
        return f", line {number}: {as_plain(line.partition('=')[0].strip()[:MAX_SAID])} is there twice"
    for looks, write in SLIPS if len(line) <= MAX_SAID else ():
        if looks.search(line):
            return f", line {number}: {as_plain(line.strip())}: {write}"
    return f": not a TOML file: {_cut(message)}"


def _doubled(lines: list[str], number: int, name: str, repeated: Collection[str]) -> str:
    """Return where a section that is there twice is first, and what to write."""
    found = (_SECTION.match(one) for one in lines[: number - 1])
    first = next((k for k, section in enumerate(found, 1) if section and section[1] == name), None)
    shown = as_plain(name[:MAX_SAID])
    where = "" if first is None else f", first in line {first}"
    write = f"write [[{shown}]] above each" if name in repeated else "put its keys into one section"
    return f"[{shown}] is there twice{where}; {write}"


def _cut(message: str) -> str:
    """Return the text of the parser without the middle of a long key; the place comes last."""
    kept = (
        message if len(message) <= MAX_SAID else f"{message[: MAX_SAID // 2]} ... {message[-MAX_SAID // 2 :]}"
    )
    return as_plain(kept)
