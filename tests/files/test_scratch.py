"""Folders of killed runs are removed by the next one; those at work, or of others, are left alone."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from sfm.files.user_cache import PREFIX, scratch_folder

RUN = """
import time
from sfm.files.user_cache import scratch_folder
with scratch_folder() as folder:
    (folder / "set-aside").write_text("x")
    print(folder, flush=True)
    time.sleep(60)
"""


def test_a_killed_run_leaves_nothing_after_the_next_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    runs = [subprocess.Popen([sys.executable, "-c", RUN], stdout=subprocess.PIPE, text=True) for _ in "12"]
    try:
        killed, working = (Path(run.stdout.readline().strip()) for run in runs if run.stdout)
        runs[0].send_signal(signal.SIGKILL)
        runs[0].wait()
        assert (killed / "set-aside").exists()
        (tmp_path / f"{PREFIX}new").mkdir()  # a run that has no lock yet
        (tmp_path / f"{PREFIX}link").symlink_to(tmp_path / "elsewhere")
        with scratch_folder() as own:
            assert not killed.parent.exists() and (working / "set-aside").exists()
            assert own.is_dir() and own.parent.stat().st_mode & 0o077 == 0
        assert not own.parent.exists()
        assert (tmp_path / f"{PREFIX}new").exists() and (tmp_path / f"{PREFIX}link").is_symlink()
    finally:
        for run in runs:
            run.kill()
            run.communicate()
