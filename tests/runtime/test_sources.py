"""What is kept for sources is forgotten when any of them changes, those of inlined functions too."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from sfm.runtime import compiling as options
from sfm.runtime import compiling as sources


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A package of which `outer` imports `inner` by way of a folder, and `other` nothing."""
    folder = tmp_path / "sfm" / "room"
    folder.mkdir(parents=True)
    for name, text in (
        ("../outer", "from sfm.room import (\n    inner,\n)\n"),
        ("__init__", ""),
        ("inner", "A = 1\n"),
        ("../other", "B = 1\n"),
    ):
        (folder / f"{name}.py").write_text(text)
    monkeypatch.setattr(sources, "ROOT", tmp_path)
    monkeypatch.setattr(options, "KEPT", tmp_path / "kept" / "__pycache__")
    (tmp_path / "kept").mkdir()
    forget()
    yield folder
    forget()


def forget() -> None:
    """As a new process would."""
    for cached in (sources.source_hash, sources._source, sources._imported, options.cache_folder):
        cached.cache_clear()


def test_a_change_of_what_is_imported_is_a_change(package: Path) -> None:
    outer, other = sources.source_hash("sfm.outer"), sources.source_hash("sfm.other")
    (package / "inner.py").write_text("A = 2\n")
    forget()
    assert sources.source_hash("sfm.outer") != outer
    assert sources.source_hash("sfm.other") == other
    assert sources.source_hash("numpy") is None


def test_kernels_of_earlier_sources_are_removed(package: Path) -> None:
    first = Path(options.cache_folder("sfm.outer"))
    first.mkdir(parents=True)
    kept = Path(options.cache_folder("sfm.other"))
    kept.mkdir()
    (package / "inner.py").write_text("A = 2\n")
    forget()
    second = Path(options.cache_folder("sfm.outer"))
    assert second != first and not first.exists() and kept.exists()
    assert options.cache_folder("tests.somewhere") == ""
