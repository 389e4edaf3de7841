"""Which tests execute a line of the program, and how long each takes: measured, not listed.

`measured` runs the ordinary tests under coverage.py, with a context for each test, in a copy of the project.
What it finds is kept in build/executed.json. Later only the tests of files that were changed since are
measured again. Lines that were changed since keep the tests of those that they replace.

pytest loads this module as a plugin, which keeps how long tests take and runs chosen ones in their order.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from difflib import SequenceMatcher
from pathlib import Path
from types import MappingProxyType

import pytest
from coverage import CoverageData

from tests.places import ROOT

KEPT = ROOT / "build/executed.json"
CHOSEN = "KOLINEAR_CHOSEN_TESTS"  # environment variables: a file of tests to run, each on its line
TAKEN = "KOLINEAR_SECONDS_TAKEN"  # one to write the seconds of each test to
FAILED = "KOLINEAR_FAILED_TEST"  # and one to write the last test that failed to
SECONDS = defaultdict[str, float](float)


@dataclass
class Executed:
    """What each test executes of the program."""

    program: dict[str, str]  # text of each module as it was measured
    tests: dict[str, str]  # digest of each file of tests
    seconds: dict[str, float]  # of each test, s
    lines: dict[str, dict[int, set[str]]]  # tests that execute each line of a module
    passed: tuple[str, set[str]]  # digest of the program, and tests that passed on it

    def executing(self, file: str, lines: range) -> set[str]:
        """Return the tests that execute one of these lines."""
        return set().union(*(self.lines.get(file, {}).get(line, ()) for line in lines))


def measured(folder: Path) -> Executed:
    """Return what the tests execute, measuring in this copy of the project what is not known yet.

    Raises:
        RuntimeError: if a test fails.
    """
    known = _read() if KEPT.is_file() else Executed({}, {}, {}, {}, ("", set()))
    program = {
        file.relative_to(folder).as_posix(): file.read_text(encoding="utf-8")
        for place in ("sfm", "adapters")
        for file in sorted((folder / place).rglob("*.py"))
    }
    tests = {
        file.relative_to(folder).as_posix(): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted((folder / "tests").rglob("test_*.py"))
    }
    anew = [file for file, digest in tests.items() if known.tests.get(file) != digest]
    seconds = {
        test: s for test, s in known.seconds.items() if test.split("::")[0] in tests.keys() - set(anew)
    }
    lines = {
        file: {line: found & seconds.keys() for line, found in followed.items()}
        for file, text in program.items()
        for followed in [_followed(known.lines.get(file, {}), known.program.get(file, ""), text)]
    }
    digest = digest_of(folder)
    passed = known.passed[1] & seconds.keys() if known.passed[0] == digest else set()
    if anew:
        before = set(seconds)
        for file, of_file in _measure(anew if known.tests else [], folder, seconds).items():
            for line, found in of_file.items():
                lines.setdefault(file, {}).setdefault(line, set()).update(found)
        passed |= seconds.keys() - before
    now = Executed(program, tests, seconds, lines, (digest, passed))
    if anew or program != known.program:
        keep(now)
    return now


def digest_of(folder: Path) -> str:
    """Return what changes with the program, and with what its tests share."""
    digest = hashlib.sha256()
    for file in sorted(
        one for place in ("sfm", "adapters", "tests") for one in (folder / place).rglob("*.py")
    ):
        if not file.name.startswith("test_"):
            digest.update(f"{file.relative_to(folder)}\0".encode() + file.read_bytes() + b"\0")
    return digest.hexdigest()


def run_tests(
    chosen: Iterable[str],
    folder: Path,
    *options: str,
    limit: float | None = None,
    environment: Mapping[str, str] = MappingProxyType({}),
) -> subprocess.CompletedProcess[str]:
    """Run tests or files of tests in a copy of the project, in this order; all of them if none is chosen.

    Raises:
        subprocess.TimeoutExpired: if they take longer than `limit` seconds.
    """
    chosen = list(chosen)
    files = list(dict.fromkeys(test.split("::")[0] for test in chosen))
    with tempfile.TemporaryDirectory() as place:
        (Path(place) / "chosen").write_text("\n".join(chosen), encoding="utf-8")
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "tests.executed"]
        return subprocess.run(
            [*command, *options, *files],
            cwd=folder,
            env={
                **os.environ,
                "OMP_NUM_THREADS": "1",
                "OPENBLAS_NUM_THREADS": "1",
                "PYTHONPATH": str(folder),  # processes of tests run this copy, too
                CHOSEN: str(Path(place) / "chosen"),
                **environment,
            },
            capture_output=True,
            text=True,
            timeout=limit,
        )


def _measure(files: list[str], folder: Path, seconds: dict[str, float]) -> dict[str, dict[int, set[str]]]:
    """Return the lines that tests execute; their seconds are added to those given."""
    with tempfile.TemporaryDirectory() as place:
        data, taken = Path(place) / "coverage", Path(place) / "seconds"
        options = ("--cov=sfm", "--cov=adapters", "--cov-context=test", "--cov-report=")
        ended = run_tests(
            files, folder, *options, environment={"COVERAGE_FILE": str(data), TAKEN: str(taken)}
        )
        if ended.returncode:
            raise RuntimeError(f"tests fail on the unchanged program\n{ended.stdout}{ended.stderr}")
        seconds |= json.loads(taken.read_text(encoding="utf-8"))
        found = CoverageData(str(data))
        found.read()
        return {
            Path(file).relative_to(folder).as_posix(): {
                line: {one.rsplit("|", 1)[0] for one in contexts if one}
                for line, contexts in found.contexts_by_lineno(file).items()
            }
            for file in found.measured_files()
        }


def _followed(lines: dict[int, set[str]], before: str, now: str) -> dict[int, set[str]]:
    """Return the tests of lines after a change of the module; new lines have those of what they replace."""
    if before == now:
        return lines
    found: dict[int, set[str]] = {}
    matched = SequenceMatcher(None, before.splitlines(), now.splitlines(), autojunk=False)
    for what, first, end, new_first, new_end in matched.get_opcodes():
        replaced = set().union(*(lines.get(k, ()) for k in range(max(first, 1), end + 1)))
        for k in range(new_first, new_end):
            found[k + 1] = lines.get(first + k - new_first + 1, set()) if what == "equal" else replaced
    return found


def keep(now: Executed) -> None:
    """Write what is known, whole or not at all."""
    numbers = {test: k for k, test in enumerate(now.seconds)}
    content = {
        "program": now.program,
        "tests": now.tests,
        "seconds": now.seconds,
        "lines": {
            file: {line: sorted(numbers[test] for test in found) for line, found in of_file.items() if found}
            for file, of_file in now.lines.items()
        },
        "passed": [now.passed[0], sorted(now.passed[1])],
    }
    KEPT.parent.mkdir(exist_ok=True)
    beside = KEPT.with_suffix(".new")
    beside.write_text(json.dumps(content), encoding="utf-8")
    beside.replace(KEPT)


def _read() -> Executed:
    content = json.loads(KEPT.read_text(encoding="utf-8"))
    names = list(content["seconds"])
    lines = {
        file: {int(line): {names[k] for k in found} for line, found in of_file.items()}
        for file, of_file in content["lines"].items()
    }
    digest, passed = content["passed"]
    return Executed(content["program"], content["tests"], content["seconds"], lines, (digest, set(passed)))


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave the tests that are chosen by name, in their order; all of the files chosen without any."""
    chosen = Path(os.environ[CHOSEN]).read_text(encoding="utf-8").splitlines()
    places = {test: k for k, test in enumerate(chosen) if "::" in test}
    if places:
        left_out = [item for item in items if item.nodeid not in places]
        config.hook.pytest_deselected(items=left_out)
        items[:] = sorted(
            (item for item in items if item.nodeid in places), key=lambda one: places[one.nodeid]
        )


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Add the time of one part of a test, and keep which one failed."""
    SECONDS[report.nodeid] += report.duration
    if report.failed and FAILED in os.environ:
        Path(os.environ[FAILED]).write_text(report.nodeid, encoding="utf-8")


def pytest_sessionfinish() -> None:
    """Write how long each test took."""
    if TAKEN in os.environ:
        Path(os.environ[TAKEN]).write_text(json.dumps(SECONDS), encoding="utf-8")
