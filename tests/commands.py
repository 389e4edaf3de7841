"""The command line in this process, as a person meets it."""

from __future__ import annotations

import sys
from typing import Any

import pytest

from sfm import cli
from sfm.cli.app import commands


def kolinear(*arguments: object) -> int:
    """Run the command as the shell does and return its exit code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["kolinear", *map(str, arguments)])
        try:
            cli.main()
        except SystemExit as end:
            return int(end.code or 0) if not isinstance(end.code, str) else 1
    return 0


def command_of(words: str) -> Any:
    """Return the command that typer builds for the words that follow `kolinear`."""
    command = commands()
    for word in words.split():
        command = command.commands[word]
    return command


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Run a command that must end with exit code 2 and one line; return the line."""
    assert kolinear(*arguments) == 2
    shown = capsys.readouterr()
    lines = shown.err.splitlines()
    assert shown.out == ""
    assert len(lines) == 1, shown.err
    assert lines[0].startswith("kolinear: ")
    return lines[0]
