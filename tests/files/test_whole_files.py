"""Files and folders appear whole or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from sfm.errors import BackendError, OutputError
from sfm.files.whole_files import refuse_full, whole_file, whole_folder


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
        pytest.raises(OutputError, match="x: the model cannot be written here: "),
        whole(tmp_path / "file" / "x", "the model"),
    ):
        raise AssertionError
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_the_cause_of_a_short_file_is_found(tmp_path: Path) -> None:
    refuse_full(tmp_path)
    assert not list(tmp_path.iterdir())
    with pytest.raises(OSError, match="No such file"):
        refuse_full(tmp_path / "nowhere")
