"""Write the list of commands into a page: python docs/command_list.py README.md.

The list is the block of code whose first line is that of the first command of `sfm.cli.app.COMMANDS`.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from sfm.cli.app import COMMANDS

WIDTH = 47  # column of the purposes


def command_list() -> str:
    """Return a line for each command: what to type, and its purpose."""
    lines = (f"kolinear {command.words} {command.usage}".rstrip() for command in COMMANDS)
    return "".join(
        f"{line:<{WIDTH}}# {command.purpose}\n" for line, command in zip(lines, COMMANDS, strict=True)
    )


def with_list(text: str) -> str:
    """Return the text of a page with the present list of commands.

    Raises:
        ValueError: the page has no list.
    """
    old = rf"^```sh\nkolinear {COMMANDS[0].words} .*#.*\n(?:kolinear .*\n)*"
    page, count = re.subn(old, lambda _: f"```sh\n{command_list()}", text, flags=re.M)
    if count != 1:
        raise ValueError(f"{count} lists of commands, expected 1")
    return page


if __name__ == "__main__":
    for name in sys.argv[1:]:
        path = Path(name)
        path.write_text(with_list(path.read_text(encoding="utf-8")), encoding="utf-8")
