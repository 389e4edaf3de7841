"""What is folded on the screen is printed, on numbered pages."""

from __future__ import annotations

import re
import shutil
import subprocess
from importlib.resources import files
from pathlib import Path

import pytest

CHROMIUM = shutil.which("chromium")
ROWS = 300


@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
def test_folded_tables_are_printed_whole(tmp_path: Path) -> None:
    style = (files("sfm.report") / "templates" / "report.css").read_text(encoding="utf-8")
    assert "counter(page)" in style
    rows = "".join(f"<tr><th>{k}</th><td>{k}</td></tr>" for k in range(ROWS))
    table = f"<div class=scroll><table><tbody>{rows}</tbody></table></div>"
    page = f"<style>{style}</style><details><summary>s</summary>{table}</details>"
    (tmp_path / "page.html").write_text(page, encoding="utf-8")
    printed = tmp_path / "page.pdf"
    subprocess.run(
        [
            str(CHROMIUM), "--headless", "--no-sandbox", "--disable-gpu",
            f"--user-data-dir={tmp_path}/profile", f"--print-to-pdf={printed}",
            (tmp_path / "page.html").as_uri(),
        ],
        check=True, capture_output=True, timeout=120,
    )  # fmt: skip
    assert len(re.findall(rb"/Type\s*/Page\b", printed.read_bytes())) > 3
