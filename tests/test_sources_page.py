"""The page that reproduces the documents: its commands are run, and the numbers below them are looked for."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
import shutil
import sys
from pathlib import Path

import pytest

from sfm import cli
from tests.places import ROOT

PAGE = (ROOT / "docs" / "how-to" / "reproduce-the-sources.md").read_text(encoding="utf-8")
STEPS = re.findall(r"^## (Document \d+).*?\n```(sh|python)\n(.*?)```\n+```text\n(.*?)```", PAGE, re.S | re.M)


def test_every_document_is_reproduced() -> None:
    assert [title for title, *_ in STEPS] == [f"Document {number:03}" for number in range(5)]


@pytest.mark.parametrize(("title", "language", "code", "told"), STEPS, ids=[step[0] for step in STEPS])
def test_the_numbers_of_a_document_come_out(
    title: str, language: str, code: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(ROOT / "datasets", tmp_path / "datasets", ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.chdir(tmp_path)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        if language == "python":
            exec(compile(code, title, "exec"), {})
        else:
            for line in code.splitlines():
                monkeypatch.setattr(sys, "argv", shlex.split(line))
                with contextlib.suppress(SystemExit):
                    cli.main()
    words = " ".join(printed.getvalue().split())
    for number in told.splitlines():
        assert number in words, f"{number} is not in: {words}"
