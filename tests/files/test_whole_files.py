"""Files and folders appear whole or not at all."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import pytest

from sfm.files.whole_files import refuse_full, refuse_unwritable, whole_file, whole_files, whole_folder
from sfm.model.errors import BackendError, OutputError

NOBODY = 65534  # a user of no rights


def test_a_folder_takes_the_place_of_an_earlier_one_when_it_is_finished(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    for text in ("old", "new"):
        with whole_folder(out, replaceable=True) as folder:
            (folder / "inner").mkdir()
            (folder / "inner" / "file").write_text(text)
            assert folder.parent == out.parent
            assert not out.exists() or (out / "inner" / "file").read_text() == "old"
    assert (out / "inner" / "file").read_text() == "new"
    assert list(out.parent.iterdir()) == [out]


def test_files_and_folders_are_written_and_never_through_a_link(tmp_path: Path) -> None:
    for text in ("old", "new"):
        with whole_folder(tmp_path / "a" / "out", replaceable=True) as folder:
            (folder / "file").write_text(text)
        with whole_files(tmp_path / "b" / "out") as folder:
            (folder / "file").write_text(text)
        with whole_file(tmp_path / "c" / "file", replaces=True) as part:
            part.write_text(text)
        for path in ("a/out/file", "b/out/file", "c/file"):
            assert (tmp_path / path).read_text() == text
    assert sorted(path.name for path in tmp_path.glob("*/*")) == ["file", "out", "out"]
    with pytest.raises(OutputError, match="file: exists already"), whole_file(tmp_path / "c" / "file"):
        raise AssertionError
    (tmp_path / "link").symlink_to(tmp_path / "a")
    for whole in (whole_folder, whole_files, whole_file):
        with pytest.raises(OutputError, match="'link' is a link to"), whole(tmp_path / "link" / "x"):
            raise AssertionError


def test_a_place_that_cannot_be_written_is_refused_before_the_work(tmp_path: Path) -> None:
    refuse_unwritable(tmp_path / "a" / "deep" / "out")
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").write_text("text")
    with pytest.raises(OutputError, match="file/out: cannot be written here: Not a directory"):
        refuse_unwritable(tmp_path / "file" / "out")
    with pytest.raises(OutputError, match="file: exists already"):
        refuse_unwritable(tmp_path / "file")


@pytest.mark.skipif(not hasattr(os, "O_PATH") or os.geteuid() != 0, reason="Linux, and root as who tests")
def test_a_folder_that_one_may_pass_but_not_list_is_passed() -> None:
    """As /home often is."""
    with tempfile.TemporaryDirectory() as name:
        (Path(name) / "own").mkdir()
        (Path(name) / "own").chmod(0o777)
        Path(name).chmod(0o711)
        os.seteuid(NOBODY)
        try:
            with whole_file(Path(name) / "own" / "file") as part:
                part.write_text("data")
        finally:
            os.seteuid(0)
        assert (Path(name) / "own" / "file").read_text() == "data"


def test_a_file_leaves_nothing_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "a.db"
    with whole_file(path) as part:
        part.write_text("data")
        part.with_name("a.db-wal").write_text("of the library")
        assert not path.exists()
    assert path.read_text() == "data"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("whole", [whole_file, whole_folder])
def test_failures_leave_nothing_and_speak_of_the_place_asked_for(whole, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    out = tmp_path / "out"
    with pytest.raises(OutputError, match=r"out: cannot be written: No space left on device$"), whole(out):
        raise OSError(28, "No space left on device")
    with pytest.raises(BackendError) as told, whole(out, "the model") as part:
        raise BackendError(f"{part}: cameras differ")
    assert str(told.value) == f"{out}: cameras differ"
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").touch()
    with (
        pytest.raises(OutputError, match=r"x: (the model )?cannot be written here: "),
        whole(tmp_path / "file" / "x", "the model"),
    ):
        raise AssertionError
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_the_cause_of_a_short_file_is_found(tmp_path: Path) -> None:
    refuse_full(tmp_path)
    assert not list(tmp_path.iterdir())
    with pytest.raises(OSError, match="No such file"):
        refuse_full(tmp_path / "nowhere")
