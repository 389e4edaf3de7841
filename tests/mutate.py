"""Strength of the tests: small changes of the program, each of which a test must notice.

    python -m tests.mutate [COUNT [SEED [FOLDER ...]]]       `make mutate`

draws mutations of the rooms below: a comparison turned round, a sum in place of a difference, a threshold
doubled or halved, a condition negated. Each is written into a copy of the project, the tests of its room run
until one fails, and the table lists which survived, and how many ended in no time, apart. Before, the tests
of each room run on its unchanged modules, written in the same way; where they fail, nothing is counted.
Nothing is changed in the project.

Some change nothing that a test could notice: in score.py the centre of the motions that `_constraints` fixes,
as rotations about any centre are the same motions, and the scale of the normals, which only rounding needs;
in displacements.py the redundancy from which F is chi-square; in fischler_bolles.py which of two legs is not
polished by its misfit, which saves time, as no wrong one passes the polish; in rings.py the sense in which
rings are sampled, as arcs are counted alike in a mirror; in given.py the length of a direction left open; in
rigid_frames.py the singular values below which a step is cut, which only rounding needs; in intersection.py
how much room there is for directions, of which there may be more; in point_pairs.py the multiple of 2 pi by
which directions are wrapped.
"""

from __future__ import annotations

import ast
import importlib
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from queue import Queue
from typing import Literal

import numpy as np

from tests.places import ROOT

LONGER = 3.0  # times the tests of a room, on its unchanged modules, that those of one mutation may take
COMPILING = 120.0  # s beside it, for kernels that a mutation makes compile again
Ended = Literal["killed", "survived", "timed out"]
ROOMS: dict[str, tuple[str, ...]] = {  # module or package, with the tests that check it
    **{
        f"sfm/judgement/hypotheses/{module}.py": tuple(f"tests/judgement/test_{name}.py" for name in names)
        for module, names in (
            ("alternatives", ("alternatives", "unchecked_assumptions", "hypotheses")),
            ("columns", ("columns", "alternatives", "hypotheses")),
            ("families", ("families", "alternatives", "hypotheses")),
            ("hypotheses", ("families", "hypotheses", "alternatives")),
            ("bumps", ("rig_bumps",)),
            ("rejections", ("rejections", "hypotheses")),
            ("refit", ("families", "unchecked_assumptions", "alternatives", "hypotheses")),
            ("score", ("alternatives", "hypotheses")),
        )
    },
    "sfm/remarks/remark.py": ("tests/remarks",),
    "sfm/remarks/verdict.py": ("tests/remarks",),
    "sfm/adjustment/quality/statistics.py": (
        "tests/adjustment/test_statistical_tests.py",
        "tests/adjustment/test_statistics.py",
        "tests/adjustment/test_minimal_bias.py",
    ),
    **{
        f"sfm/judgement/given/{module}.py": (
            "tests/judgement/test_given_model.py",
            "tests/judgement/test_given_values.py",
        )
        for module in ("values", "points", "mistakes")
    },
    "sfm/adjustment/quality/consistency.py": (
        "tests/report/test_findings.py",
        "tests/report/test_consistency.py",
    ),
    "sfm/adjustment/quality/other_solutions.py": (
        "tests/adjustment/test_other_solutions.py",
        "tests/survey/test_weak_networks.py",
    ),
    "sfm/comparison/causes.py": ("tests/comparison/test_causes.py",),
    "sfm/remarks/catalogue": ("tests/remarks",),
    "sfm/judgement/given/scales.py": (
        "tests/judgement/test_given_thresholds.py",
        "tests/survey/test_wrong_scale.py",
        "tests/survey/test_plates.py",
        "tests/survey/test_unchecked.py",
        "tests/survey/test_mistyped.py::test_what_is_mistyped_is_found_and_named",
    ),
    **{
        f"sfm/judgement/given/{module}.py": (
            "tests/survey/test_survey_observations.py",
            "tests/survey/test_rigs.py",
            "tests/judgement/test_given_model.py",
        )
        for module in ("tables", "mounts", "free_network")
    },
    **{
        f"sfm/judgement/{module}.py": tests
        for module, tests in (
            ("model_choice", ("tests/judgement/test_model_choice.py",)),
            (
                "verdict",
                (
                    "tests/judgement/test_verdict.py",
                    "tests/report/test_findings.py",
                    "tests/report/test_statistics.py",
                    "tests/report/test_camera_remarks.py",
                    "tests/survey/test_unchecked.py",
                ),
            ),
            ("cameras", ("tests/report/test_camera_remarks.py", "tests/report/test_findings.py")),
            (
                "calibrated_cameras",
                (
                    "tests/judgement/test_calibrated_cameras.py",
                    "tests/report/test_camera_remarks.py",
                    "tests/report/test_statistics.py",
                ),
            ),
            (
                "checks",
                (
                    "tests/judgement/test_calibrated_cameras.py",
                    "tests/judgement/test_verdict.py",
                    "tests/report/test_statistics.py",
                    "tests/report/test_findings.py",
                ),
            ),
            (
                "bundle_statistics",
                (
                    "tests/report/test_geometry.py",
                    "tests/report/test_statistics.py",
                    "tests/report/test_findings.py",
                ),
            ),
        )
    },
    "sfm/judgement/stated_precision.py": ("tests/judgement/test_stated_precision.py",),
    "sfm/judgement/given/groups.py": (
        "tests/judgement/test_given_thresholds.py",
        "tests/survey/test_unchecked.py",
    ),
    "sfm/judgement/given/judge.py": (
        "tests/judgement/test_given_thresholds.py",
        "tests/survey/test_unchecked.py",
        "tests/survey/test_wrong_scale.py",
        "tests/survey/test_rigs.py",
        "tests/survey/test_mistyped.py::test_what_is_mistyped_is_found_and_named",
    ),
    "sfm/observations": (
        "tests/survey/test_survey_observations.py",
        "tests/adjustment/test_statistics.py",
        "tests/survey/test_rigs.py",
        "tests/planning/test_planned_rigs.py",
        "tests/test_new_kind.py",
        "tests/adjustment/test_solve.py",
    ),
    **{
        f"sfm/adjustment/{module}.py": (
            *first,
            "tests/adjustment/test_null_space.py",
            "tests/adjustment/test_interior.py",
            "tests/adjustment/test_solve.py",
            "tests/adjustment/test_rigs.py",
            "tests/survey/test_survey_observations.py",
        )
        for module, first in (
            ("datum", ()),
            ("engine/unknowns", ("tests/adjustment/test_rank.py",)),
            ("engine/observed", ()),
            ("engine/iterate", ("tests/adjustment/test_valleys.py", "tests/adjustment/test_robust.py")),
        )
    },
    "sfm/survey/rigs.py": ("tests/survey/test_rigs.py",),
    "sfm/survey/observation_tables.py": ("tests/survey/test_survey_observations.py",),
    "sfm/survey/placing.py": (
        "tests/survey/test_given_values.py",
        "tests/survey/test_exterior.py",
        "tests/survey/test_solution.py",
        "tests/survey/test_survey_observations.py",
    ),
    "sfm/orientation/resection/fischler_bolles.py": (
        "tests/orientation/resection/test_fischler_bolles.py",
        "tests/orientation/resection/test_robust.py",
    ),
    "sfm/orientation/resection/least_squares.py": (
        "tests/orientation/resection/test_least_squares.py",
        "tests/textbook/resection/test_methods.py",
        "tests/orientation/resection/test_robust.py",
    ),
    "sfm/orientation/resection/ransac.py": (
        "tests/orientation/resection/test_robust.py",
        "tests/orientation/test_effort.py::test_the_fewest_fitting_of_a_million_points_are_found_by_halving",
    ),
    "sfm/similarity.py": ("tests/orientation/test_absolute.py", "tests/test_similarity.py"),
    "sfm/orientation/intersection.py": ("tests/orientation/test_intersection.py",),
    "sfm/epochs/displacements.py": ("tests/epochs/test_displacements.py",),
    "sfm/conventions.py": ("tests/test_units.py", "tests/test_conventions_page.py"),
    "sfm/targets/codes/rings.py": ("tests/targets/test_codes.py",),
    "sfm/targets/codes/dot_plates.py": ("tests/targets/test_plates.py",),
}
COMPARED = {
    ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE, ast.LtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
}  # fmt: skip
COMPUTED = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult}


@dataclass(frozen=True)
class Mutation:
    """One small change of one module."""

    file: str
    line: int
    what: str
    tests: tuple[str, ...]
    number: int  # of the changed node
    change: Callable[..., object]

    @property
    def source(self) -> str:
        """The changed module."""
        tree = _tree_of(self.file)
        self.change(next(one for k, one in enumerate(ast.walk(tree)) if k == self.number))
        return ast.unparse(ast.fix_missing_locations(tree))


def _tree_of(file: str) -> ast.Module:
    return ast.parse((ROOT / file).read_text(encoding="utf-8"))


def mutations_of(file: str, tests: tuple[str, ...]) -> Iterator[Mutation]:
    """Return all mutations of a module."""
    numbers = _numbers_of(file)
    for number, node in enumerate(ast.walk(_tree_of(file))):
        for what, change in _changes(node, numbers):
            yield Mutation(file, getattr(node, "lineno", 0), what, tests, number, change)


def _numbers_of(file: str) -> dict[str, object]:
    """Return the constants of a module that are numbers, or several, however they are written."""
    module = importlib.import_module(file.removesuffix(".py").removesuffix("/__init__").replace("/", "."))
    return {name: value for name, value in vars(module).items() if name.isupper() and _is_number(value)}


def _is_number(value: object) -> bool:
    if isinstance(value, tuple):
        return len(value) > 0 and all(_is_number(one) for one in value)
    if isinstance(value, np.ndarray):
        return bool(np.issubdtype(value.dtype, np.number))
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)


def _changes(node: ast.AST, numbers: dict[str, object]) -> Iterator[tuple[str, Callable[..., object]]]:
    """Return what can be changed of a node: words, and a function that changes it."""
    if isinstance(node, ast.Compare) and type(node.ops[0]) in COMPARED:
        new = COMPARED[type(node.ops[0])]
        yield f"{type(node.ops[0]).__name__} -> {new.__name__}", lambda one: one.ops.__setitem__(0, new())
    elif isinstance(node, ast.BinOp) and type(node.op) in COMPUTED and not _is_text(node):
        new = COMPUTED[type(node.op)]
        yield f"{type(node.op).__name__} -> {new.__name__}", lambda one: setattr(one, "op", new())
    elif isinstance(node, ast.BoolOp):
        new = ast.Or if isinstance(node.op, ast.And) else ast.And
        yield f"{type(node.op).__name__} -> {new.__name__}", lambda one: setattr(one, "op", new())
    elif isinstance(node, ast.If | ast.IfExp):
        yield (
            "condition negated",
            lambda one: setattr(one, "test", ast.UnaryOp(ast.Not(), one.test)),
        )
    elif isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
        target = node.targets[0] if isinstance(node, ast.Assign) else node.target
        value = numbers.get(target.id) if isinstance(target, ast.Name) else None
        if isinstance(node.value, ast.Tuple):
            computed = any(isinstance(one, ast.Starred) for one in node.value.elts)
        else:
            computed = isinstance(value, tuple)  # twice it would be no tuple of numbers
        if isinstance(target, ast.Name) and value is not None and not computed:
            yield from _scalings(target.id, value)
    elif isinstance(node, ast.Call):
        for k, one in enumerate(node.keywords):
            if one.arg is not None and _is_limit(node, one):
                yield from _scalings(one.arg, 1.0, k)


def _is_text(node: ast.BinOp) -> bool:
    return any(isinstance(one, ast.JoinedStr) or _is_string(one) for one in (node.left, node.right))


def _is_string(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def _is_limit(call: ast.Call, one: ast.keyword) -> bool:
    """Return whether a keyword is given a number that is no count or index, or a limit of a grade."""
    if isinstance(call.func, ast.Name) and call.func.id == "Grade":
        return one.arg in ("warning", "error")
    return isinstance(one.value, ast.Constant) and isinstance(one.value.value, float) and one.value.value != 0


def _scalings(
    name: str, value: object, keyword: int | None = None
) -> Iterator[tuple[str, Callable[..., object]]]:
    """Return what makes a number, or each of several, twice and half as large."""

    def scale(node: ast.Assign | ast.AnnAssign | ast.Call, factor: float) -> None:
        owner = node if keyword is None else node.keywords[keyword]  # type: ignore[union-attr]
        assert isinstance(owner, ast.Assign | ast.AnnAssign | ast.keyword) and owner.value is not None
        parts = owner.value.elts if isinstance(owner.value, ast.Tuple) else [owner.value]
        values = value if isinstance(owner.value, ast.Tuple) and isinstance(value, tuple) else [value]
        new = [_times(*one, factor) for one in zip(parts, values, strict=True)]
        owner.value = ast.Tuple(new, ast.Load()) if isinstance(owner.value, ast.Tuple) else new[0]

    for factor in (2.0, 0.5):
        yield f"{name} times {factor:g}", lambda node, f=factor: scale(node, f)


def _times(node: ast.expr, value: object, factor: float) -> ast.expr:
    if isinstance(value, int):
        return ast.Constant(max(round(factor * value), 1))
    return ast.BinOp(ast.Constant(factor), ast.Mult(), node)


def files_of(room: str) -> list[str]:
    """Return the modules of a room."""
    path = ROOT / room
    files = [path] if path.is_file() else sorted(path.glob("*.py"))
    return [file.relative_to(ROOT).as_posix() for file in files]


def drawn(count: int, seed: int, rooms: Iterable[str]) -> list[Mutation]:
    """Return so many mutations, spread over rooms by their size."""
    every = [one for room in rooms for file in files_of(room) for one in mutations_of(file, ROOMS[room])]
    random.Random(seed).shuffle(every)
    return every[:count]


def run_changed(
    sources: dict[str, str], tests: tuple[str, ...], folder: Path, limit: float | None = None
) -> tuple[Ended, str]:
    """Return how tests end where modules are other ones, in a copy of the project, and their output.

    The tests may take `limit` seconds.
    """
    before = {file: (folder / file).read_text(encoding="utf-8") for file in sources}
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    try:
        for file, source in sources.items():
            (folder / file).write_text(source, encoding="utf-8")
        ended = subprocess.run(
            command, cwd=folder, capture_output=True, timeout=limit, env=environment, text=True
        )
        return ("killed" if ended.returncode else "survived"), ended.stdout + ended.stderr
    except subprocess.TimeoutExpired:
        return "timed out", ""
    finally:
        for file, source in before.items():
            (folder / file).write_text(source, encoding="utf-8")


def run_unchanged(room: str, folder: Path) -> tuple[str, float]:
    """Return why the tests of a room say nothing, empty if they pass unchanged, and how long they took, s."""
    sources = {file: ast.unparse(_tree_of(file)) for file in files_of(room)}
    start = time.monotonic()
    ended, output = run_changed(sources, ROOMS[room], folder)
    seconds = time.monotonic() - start
    return ("" if ended == "survived" else f"{room}: {ended} without a change\n{output}"), seconds


def main(count: int = 200, seed: int = 1, *rooms: str, processes: int = 2) -> int:
    """Run the mutations of the rooms, or of those in these folders, and print those that survive."""
    chosen = [room for room in ROOMS if room.startswith(rooms or "")]
    some, found = drawn(count, seed, chosen), Counter[tuple[str, Ended]]()
    files = {one.file for one in some}
    with tempfile.TemporaryDirectory() as place, ThreadPoolExecutor(processes) as pool:
        folders: Queue[Path] = Queue()
        for k in range(processes):
            copied = Path(place) / str(k)
            shutil.copytree(
                ROOT, copied, ignore=shutil.ignore_patterns(".venv", ".git", "node_modules", "out", "build")
            )
            folders.put(copied)

        @contextmanager
        def a_copy() -> Iterator[Path]:
            folder = folders.get()
            try:
                yield folder
            finally:
                folders.put(folder)

        def unchanged(room: str) -> tuple[str, float]:
            with a_copy() as folder:
                return run_unchanged(room, folder)

        drawn_rooms = [room for room in chosen if files & set(files_of(room))]
        before = dict(zip(drawn_rooms, pool.map(unchanged, drawn_rooms), strict=True))
        failed = [why for why, _ in before.values() if why]
        if failed:
            print("\n".join(failed))
            return 2
        limits = {
            file: LONGER * seconds + COMPILING
            for room, (_, seconds) in before.items()
            for file in files_of(room)
        }

        def ended_of(one: Mutation) -> Ended:
            with a_copy() as folder:
                return run_changed({one.file: one.source}, one.tests, folder, limits[one.file])[0]

        for k, (one, ended) in enumerate(zip(some, pool.map(ended_of, some), strict=True), start=1):
            found[one.file, ended] += 1
            if ended != "killed":
                print(f"{k} of {count}: {ended}: {one.file}:{one.line} {one.what}", flush=True)
    print(f"{'room':50} killed survived timed out")
    for file in sorted(files):
        print(_row(file, *(found[file, ended] for ended in ("killed", "survived", "timed out"))))
    killed, survived, out = (
        sum(found[file, ended] for file in files) for ended in ("killed", "survived", "timed out")
    )
    print(_row("all", killed, survived, out), f" {100 * killed / max(killed + survived, 1):.0f} %")
    return 0 if killed >= 0.95 * (killed + survived) else 1


def _row(name: str, killed: int, survived: int, out: int) -> str:
    return f"{name:50} {killed:6} {survived:8} {out:9}"


if __name__ == "__main__":
    sys.exit(main(*(int(one) for one in sys.argv[1:3]), *sys.argv[3:]))
