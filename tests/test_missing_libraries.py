"""Without pycolmap and Dask: surveys run, and each command says what it lacks."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

import sfm
from sfm.cli.commands.batch import InProcess
from sfm.model.errors import BackendError, KolinearError, MissingLibraryError
from sfm.model.remarks.remark import Remark
from sfm.runtime import warmed
from sfm.runtime.executor import Call, Done, Event, Lost, Send, Sent, Work
from tests.commands import kolinear
from tests.surveys import write_observed_survey

INSTALL_PYCOLMAP = "pycolmap is not installed: pip install 'pycolmap==4.2.*'"
INSTALL_DASK = "pip install 'dask[distributed]' cryptography, the extra kolinear[cluster]"


@pytest.fixture(autouse=True)
def core_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide the two libraries, and spare the drawing, which is not what is tested."""
    for name in ("pycolmap", "pycolmap.pyceres", "dask", "distributed"):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.delitem(sys.modules, "adapters.dask_cluster", raising=False)
    monkeypatch.delattr("adapters.dask_cluster", raising=False)
    monkeypatch.setattr(warmed, "is_warm", lambda: True)


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str]:
    """Return exit code and what is printed."""
    code, shown = kolinear(*arguments), capsys.readouterr()
    return code, shown.out + shown.err


def test_a_survey_is_not_compared_and_says_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    survey = write_observed_survey(tmp_path / "s", "alone", images=5, points=12, backend="colmap")
    out = tmp_path / "out"
    assert run(capsys, "adjust", survey, "--out", out)[0] == 0
    tests = json.loads((out / "summary.json").read_text(encoding="utf-8"))["verdict"]["tests"]
    (found,) = [one for one in tests if one["kind"] == "not_compared"]
    assert found["subjects"] == {"what": ["adjuster"], "reason": [INSTALL_PYCOLMAP]}
    for page in ("report.html", "report.txt"):
        assert "not compared: pycolmap" in " ".join((out / page).read_text(encoding="utf-8").split())


@pytest.mark.parametrize("arguments", [("refine", "MODEL", "--images", ".")])
def test_commands_that_need_pycolmap_end_in_one_line(
    arguments: tuple[object, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "MODEL").mkdir()
    for name in ("cameras", "images", "points3D"):
        (tmp_path / "MODEL" / f"{name}.txt").write_text("")
    code, told = run(capsys, *arguments)
    assert code == 2 and told.count("\n") == 1 and INSTALL_PYCOLMAP in told
    assert sorted(path.name for path in tmp_path.iterdir()) == ["MODEL"]


def test_a_broken_pycolmap_is_not_called_missing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "pycolmap.py").write_text("raise ImportError('libceres.so: cannot open')")
    monkeypatch.delitem(sys.modules, "pycolmap")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(BackendError, match=r"cannot be imported \(libceres\.so") as told:
        sfm.network_from_colmap(tmp_path)
    assert not isinstance(told.value, MissingLibraryError)


def test_a_batch_runs_in_this_process(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    surveys = [
        write_observed_survey(tmp_path / name, name, images=5, points=12) for name in ("first", "second")
    ]
    code, told = run(capsys, "batch", *surveys, "--out", tmp_path / "out", "--jobs", 2)
    assert code == 0, told
    assert f"Dask is not installed: surveys run one after the other in this process; {INSTALL_DASK}" in told
    for name in ("first", "second"):
        assert (tmp_path / "out" / name / "report.html").exists()


def test_a_scheduler_cannot_be_used(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    survey = write_observed_survey(tmp_path / "b", "second")
    out = tmp_path / "out"
    code, told = run(capsys, "batch", survey, "--out", out, "--cluster", "tcp://10.0.0.1:8")
    assert code == 2 and f"--cluster tcp://10.0.0.1:8: Dask is not installed: {INSTALL_DASK}" in told
    assert not out.exists()
    code, told = run(capsys, "adjust", survey, "--out", out, "--cluster", "tcp://10.0.0.1:8")
    assert code == 2 and f"Helmert blocks: Dask is not installed: {INSTALL_DASK}" in told
    assert not out.exists()


def test_doctor_calls_the_core_sound(capsys: pytest.CaptureFixture[str]) -> None:
    code, told = run(capsys, "doctor")
    assert code == 0 and "This installation works." in told
    assert f"colmap: no comparison, {INSTALL_PYCOLMAP}" in " ".join(told.split())


def test_a_camera_that_was_not_looked_up_is_reported() -> None:
    unknown: list[Remark] = []
    assert sfm.library.surveys.sensor_widths(unknown.append)("OLYMPUS", "C4040Z") is None
    (one,) = unknown
    assert one.kind == "camera_assumed" and one.names("cameras") == ("OLYMPUS C4040Z",)
    assert one.names("reason") == (INSTALL_PYCOLMAP,)


def double(value: int, *, send: Send) -> int:
    send({"photograph": str(value)})
    return 2 * value


def add(first: int, parts: list[int], *, send: Send) -> int:
    send({"stage": "sum"})
    if first < 0:
        raise ZeroDivisionError("nobody thought of it")
    if not parts:
        raise KolinearError("nothing to add")
    return first + sum(parts)


def test_the_engine_tells_in_order_and_one_fault_is_alone() -> None:
    def events(first: int, *parts: int) -> list[Event]:
        work = Work(f"w{first}", tuple(Call(double, (one,)) for one in parts), Call(add, (first,)))
        return list(InProcess().run([work, Work("after", work.parts, Call(add, (0,)))], at_a_time=3))

    told = [Sent("w1", {"photograph": "2"}), Sent("w1", {"photograph": "3"}), Sent("w1", {"stage": "sum"})]
    assert events(1, 2, 3)[:4] == [*told, Done("w1", 11)]
    found = events(-1, 2)
    assert Lost("w-1", "it failed: ZeroDivisionError: nobody thought of it") in found
    assert found[-1] == Done("after", 4)
    with pytest.raises(KolinearError, match="nothing to add"):
        events(1)
