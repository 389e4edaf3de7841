"""`kolinear doctor` separates a working installation from one that measures wrongly; kernels compile once."""

from __future__ import annotations

import sys

import pytest

from sfm import cli, warm_up
from sfm.cli.commands.starting import compile_first
from sfm.kernels import warmed


def doctor(monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(sys, "argv", ["kolinear", "doctor"])
    try:
        cli.main()
    except SystemExit as end:
        return int(end.code or 0)
    return 0


@pytest.fixture
def warm(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warmed, "is_warm", lambda: True)


@pytest.mark.usefixtures("warm")
def test_an_installation_that_works(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert doctor(monkeypatch) == 0
    told = capsys.readouterr().out
    assert "4 dots measured" in told and "agrees on the same network" in told
    assert "This installation works." in told
    for subject in ("python", "numpy", "pycolmap", "cores", "browser", "kernels", "free space"):
        assert f"\n{subject}" in f"\n{told}"


@pytest.mark.usefixtures("warm")
def test_one_that_measures_wrongly(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(warm_up, "DOTS", tuple((x + 0.5, y) for x, y in warm_up.DOTS))
    drawn = warm_up.drawn_photograph
    monkeypatch.setattr(warm_up, "drawn_photograph", lambda bright: drawn(bright)[:, ::-1].copy())
    assert doctor(monkeypatch) == 1
    assert "px off, expected 0.1 px at most" in capsys.readouterr().out


def test_kernels_are_compiled_once_for_their_sources(
    monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    runs = []
    folder = tmp_path_factory.mktemp("kept") / "kernels"
    monkeypatch.setattr(warmed, "_folder", lambda: folder)
    monkeypatch.setattr(warmed, "make_user_folder", lambda path: path.mkdir(exist_ok=True))

    def compiled(progress: object) -> None:
        runs.append(progress)
        warmed.set_warm()

    monkeypatch.setattr(warm_up, "main", compiled)
    compile_first()
    compile_first()
    assert len(runs) == 1
    monkeypatch.setattr(warmed, "_mark", lambda: "warm-of-other-sources")
    compile_first()
    assert len(runs) == 2
    assert [path.name for path in folder.iterdir()] == ["warm-of-other-sources"]
