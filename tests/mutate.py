"""Strength of the tests: small changes of the program, each of which a test must notice.

    python -m tests.mutate [COUNT [SEED [FOLDER ...]]]       `make mutate`

draws mutations of the rooms below: a comparison turned round, a sum in place of a difference, a threshold
doubled or halved, a condition negated. Each is written into a copy of the project. The tests that execute the
mutated line run until one fails, quickest first; tests/executed.py measures which these are. Of a constant,
and whatever else runs while modules are loaded, they are the tests that execute what loads its name. Tests of
the same files follow, as they may share what the first of them computed. A mutation that is not noticed
within `BUDGET` survives, although a slower test may notice it. The table lists which survived, and how many
ended in no time, apart. In the end, each test that noticed one runs once on the unchanged program; where it
fails, nothing is counted. Nothing is changed in the project.

Some change nothing that a test could notice: in score.py the centre of the motions that `_constraints` fixes,
as rotations about any centre are the same motions, and the scale of the normals, which only rounding needs;
in displacements.py the redundancy from which F is chi-square; in fischler_bolles.py which of two legs is not
polished by its misfit, which saves time, as no wrong one passes the polish; in rings.py the sense in which
rings are sampled, as arcs are counted alike in a mirror; in given.py the length of a direction left open; in
rigid_frames.py the singular values below which a step is cut, which only rounding needs; in intersection.py
how much room there is for directions, of which there may be more; in point_pairs.py the multiple of 2 pi by
which directions are wrapped; in bumps.py the step of a numerical derivative; in mounts.py and
rig_mounts.py the smallest number that divides; in values.py how much covariance along the parameters
makes that of fixed values regular.
"""

from __future__ import annotations

import ast
import importlib
import random
import shutil
import subprocess
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from queue import Queue
from typing import Literal

import numpy as np
import pytest

from tests.executed import FAILED, Executed, keep, measured, run_tests
from tests.places import ROOT

BUDGET = 60.0  # s that the tests of one mutation take on the unchanged program; slower ones are not tried
LONGER = 3.0  # times as long may they take on the mutation
COMPILING = 120.0  # s beside it, for kernels that a mutation makes compile again
Ended = Literal["killed", "survived", "timed out"]
ROOMS = (  # modules, and folders with all that are in them
    "sfm/judgement",
    "sfm/report/precision.py",
    "sfm/report/network_geometry.py",
    "sfm/report/rig_mounts.py",
    "sfm/model/remarks",
    "sfm/model/observations",
    "sfm/adjustment/quality/statistics.py",
    "sfm/adjustment/quality/consistency.py",
    "sfm/adjustment/quality/other_solutions.py",
    "sfm/adjustment/datum.py",
    "sfm/adjustment/engine/unknowns.py",
    "sfm/adjustment/engine/observed.py",
    "sfm/adjustment/engine/iterate.py",
    "sfm/comparison/causes.py",
    "sfm/survey/rigs.py",
    "sfm/survey/observation_tables.py",
    "sfm/survey/placing.py",
    "sfm/orientation/resection/fischler_bolles.py",
    "sfm/orientation/resection/least_squares.py",
    "sfm/orientation/resection/ransac.py",
    "sfm/orientation/intersection.py",
    "sfm/model/similarity.py",
    "sfm/products/epochs/displacements.py",
    "sfm/model/conventions.py",
    "sfm/targets/codes/rings.py",
    "sfm/targets/codes/dot_plates.py",
)
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
    source: str  # the changed module
    tests: tuple[str, ...]  # that may notice it, in their order
    seconds: float  # they take unchanged, s


class Module:
    """A module of the program, its statements, and where it loads which name."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.text = (ROOT / file).read_bytes()
        self.tree = ast.parse(self.text)
        self.parent = {child: node for node in ast.walk(self.tree) for child in ast.iter_child_nodes(node)}
        self.starts = [0, *accumulate(len(line) for line in self.text.splitlines(keepends=True))]

    def around(self, node: ast.AST) -> list[ast.AST]:
        """Return what a node is part of, from itself to the module."""
        found = [node]
        while found[-1] in self.parent:
            found.append(self.parent[found[-1]])
        return found

    def statement_of(self, node: ast.AST) -> ast.AST:
        """Return the statement that a node is part of."""
        return next(one for one in self.around(node) if isinstance(one, ast.stmt | ast.Module))

    def changed(self, old: ast.expr, new: ast.expr) -> str:
        """Return the text with another expression in one place."""
        texts = [one for one in self.around(old) if isinstance(one, ast.JoinedStr)]
        place = texts[-1] if texts else old  # parts of formatted text have no places before Python 3.12
        start, end = (
            self.starts[(line or 1) - 1] + (column or 0)
            for line, column in (
                (place.lineno, place.col_offset),
                (place.end_lineno, place.end_col_offset),
            )
        )
        written = ast.unparse(_Replacing(old, new).visit(place))
        _Replacing(new, old).visit(place)  # the tree as it was
        return b"".join((self.text[:start], f"({written})".encode(), self.text[end:])).decode()


@dataclass(frozen=True)
class _Replacing(ast.NodeTransformer):
    old: ast.AST
    new: ast.AST

    def visit(self, node: ast.AST) -> ast.AST:
        return self.new if node is self.old else self.generic_visit(node)


class Noticing:
    """Which tests may notice a change of which line."""

    def __init__(self, executed: Executed) -> None:
        self.executed = executed
        self.modules = {file: Module(file) for file in executed.program}
        self.loading: dict[str, list[tuple[Module, ast.AST]]] = defaultdict(list)
        for module in self.modules.values():
            for node in ast.walk(module.tree):
                for name in _loaded(node):
                    self.loading[name].append((module, module.statement_of(node)))
        self.of_file = defaultdict[str, set[str]](set)
        for test in executed.seconds:
            self.of_file[test.split("::")[0]].add(test)

    def of(self, module: Module, node: ast.AST) -> tuple[str, ...]:
        """Return the tests of the statement that a node is part of: first those that execute it."""
        seconds = self.executed.seconds
        executing = self._executing(module, module.statement_of(node), set())
        beside = set().union(*(self.of_file[test.split("::")[0]] for test in executing)) - executing
        order = [*sorted(executing, key=seconds.__getitem__), *sorted(beside, key=seconds.__getitem__)]
        sums = accumulate(seconds[test] for test in order)
        return tuple(test for test, s in zip(order, sums, strict=True) if s <= BUDGET)

    def _executing(self, module: Module, statement: ast.AST, seen: set[ast.AST]) -> set[str]:
        """Return the tests that execute a statement, or what loads the names that it is known by."""
        seen.add(statement)
        around = module.around(statement)[1:]
        if any(isinstance(one, ast.FunctionDef) for one in around):
            found = self.executed.executing(module.file, _lines_of(statement))
            if found:
                return found
        names = {one.name for one in around if isinstance(one, ast.FunctionDef | ast.ClassDef)}
        if not any(isinstance(one, ast.FunctionDef) for one in around):
            names |= set(_defined(statement))
        loads = [one for name in names for one in self.loading[name]]
        return set().union(*(self._executing(*one, seen) for one in loads if one[1] not in seen))


def _lines_of(statement: ast.AST) -> range:
    """Return the lines of a statement, without those of statements in it."""
    assert isinstance(statement, ast.stmt)
    body = getattr(statement, "body", None)
    last = max(body[0].lineno - 1, statement.lineno) if body else statement.end_lineno
    return range(statement.lineno, (last or statement.lineno) + 1)


def _loaded(node: ast.AST) -> tuple[str, ...]:
    """Return the names that a node loads."""
    if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
        return (node.id,)
    if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load):
        return (node.attr,)
    return tuple(one.name for one in node.names if one.asname) if isinstance(node, ast.ImportFrom) else ()


def _defined(statement: ast.AST) -> tuple[str, ...]:
    """Return the names by which a statement that runs while its module is loaded is known."""
    if isinstance(statement, ast.FunctionDef | ast.ClassDef):
        return (statement.name,)
    if isinstance(statement, ast.ImportFrom):
        return tuple(one.asname for one in statement.names if one.asname)
    names = (one for one in ast.walk(statement) if isinstance(one, ast.Name))
    return tuple(one.id for one in names if isinstance(one.ctx, ast.Store))


def changes_of(module: Module) -> Iterator[tuple[str, ast.AST, ast.expr, ast.expr]]:
    """Return all changes of a module: words, where, an expression and another in its place."""
    numbers = _numbers_of(module.file)
    for node in ast.walk(module.tree):
        for what, old, new in _changes(node, numbers):
            yield what, node, old, new


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


def _changes(node: ast.AST, numbers: dict[str, object]) -> Iterator[tuple[str, ast.expr, ast.expr]]:
    """Return what can be changed of a node: words, an expression and another in its place."""
    if isinstance(node, ast.Compare) and type(node.ops[0]) in COMPARED:
        turned = COMPARED[type(node.ops[0])]
        new = ast.Compare(node.left, [turned(), *node.ops[1:]], node.comparators)
        yield f"{type(node.ops[0]).__name__} -> {turned.__name__}", node, new
    elif isinstance(node, ast.BinOp) and type(node.op) in COMPUTED and not _is_text(node):
        computed = COMPUTED[type(node.op)]
        other = ast.BinOp(node.left, computed(), node.right)
        yield f"{type(node.op).__name__} -> {computed.__name__}", node, other
    elif isinstance(node, ast.BoolOp):
        joined = ast.Or if isinstance(node.op, ast.And) else ast.And
        yield f"{type(node.op).__name__} -> {joined.__name__}", node, ast.BoolOp(joined(), node.values)
    elif isinstance(node, ast.If | ast.IfExp):
        yield "condition negated", node.test, ast.UnaryOp(ast.Not(), node.test)
    elif isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
        target = node.targets[0] if isinstance(node, ast.Assign) else node.target
        value = numbers.get(target.id) if isinstance(target, ast.Name) else None
        if isinstance(node.value, ast.Tuple):
            starred = any(isinstance(one, ast.Starred) for one in node.value.elts)
        else:
            starred = isinstance(value, tuple)  # twice it would be no tuple of numbers
        if isinstance(target, ast.Name) and value is not None and not starred:
            yield from _scalings(target.id, node.value, value)
    elif isinstance(node, ast.Call):
        for one in node.keywords:
            if one.arg is not None and _is_limit(node, one):
                yield from _scalings(one.arg, one.value, 1.0)


def _is_text(node: ast.BinOp) -> bool:
    return any(isinstance(one, ast.JoinedStr) or _is_string(one) for one in (node.left, node.right))


def _is_string(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def _is_limit(call: ast.Call, one: ast.keyword) -> bool:
    """Return whether a keyword is given a number that is no count or index, or a limit of a grade."""
    if isinstance(call.func, ast.Name) and call.func.id == "Grade":
        return one.arg in ("warning", "error")
    return isinstance(one.value, ast.Constant) and isinstance(one.value.value, float) and one.value.value != 0


def _scalings(name: str, old: ast.expr, value: object) -> Iterator[tuple[str, ast.expr, ast.expr]]:
    """Return what makes a number, or each of several, twice and half as large."""
    for factor in (2.0, 0.5):
        if isinstance(old, ast.Tuple) and isinstance(value, tuple):
            parts = [_times(*one, factor) for one in zip(old.elts, value, strict=True)]
            yield f"{name} times {factor:g}", old, ast.Tuple(parts, ast.Load())
        elif not (isinstance(value, int) and max(round(factor * value), 1) == value):  # half of one is one
            yield f"{name} times {factor:g}", old, _times(old, value, factor)


def _times(node: ast.expr, value: object, factor: float) -> ast.expr:
    if isinstance(value, int):
        return ast.Constant(max(round(factor * value), 1))
    return ast.BinOp(ast.Constant(factor), ast.Mult(), node)


def files_of(room: str) -> list[str]:
    """Return the modules of a room."""
    path = ROOT / room
    files = [path] if path.is_file() else sorted(path.rglob("*.py"))
    return [file.relative_to(ROOT).as_posix() for file in files]


def drawn(count: int, seed: int, files: Iterable[str], noticing: Noticing) -> list[Mutation]:
    """Return so many mutations, spread over modules by their size."""
    modules = [noticing.modules[file] for file in files]
    every = [(module, *change) for module in modules for change in changes_of(module)]
    random.Random(seed).shuffle(every)
    some = []
    for module, what, node, old, new in every[:count]:
        tests = noticing.of(module, node)
        seconds = sum(noticing.executed.seconds[test] for test in tests)
        line = getattr(node, "lineno", 0)
        some.append(Mutation(module.file, line, what, module.changed(old, new), tests, seconds))
    return some


def run_mutation(one: Mutation, folder: Path) -> tuple[Ended, str]:
    """Return how tests end on a mutation, in a copy of the project, and which one noticed it."""
    if not one.tests:
        return "survived", ""
    module = folder / one.file
    before = module.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as place:
        failed = Path(place) / "failed"
        try:
            module.write_text(one.source, encoding="utf-8")
            limit, environment = LONGER * one.seconds + COMPILING, {FAILED: str(failed)}
            ended = run_tests(one.tests, folder, "-x", limit=limit, environment=environment)
        except subprocess.TimeoutExpired:
            return "timed out", ""
        finally:
            module.write_text(before, encoding="utf-8")
        if ended.returncode in (pytest.ExitCode.USAGE_ERROR, pytest.ExitCode.NO_TESTS_COLLECTED):
            raise RuntimeError(ended.stdout + ended.stderr)
        if not ended.returncode:
            return "survived", ""
        return "killed", failed.read_text(encoding="utf-8") if failed.is_file() else ""


def check_unchanged(tests: set[str], executed: Executed, folder: Path) -> str:
    """Return why tests say nothing, empty if they pass on the unchanged program."""
    tests = tests - executed.passed[1]
    if tests:
        ended = run_tests(sorted(tests), folder)
        if ended.returncode:
            return f"tests fail on the unchanged program\n{ended.stdout}{ended.stderr}"
        executed.passed[1].update(tests)
        keep(executed)
    return ""


def main(count: int = 200, seed: int = 1, *rooms: str, processes: int = 2) -> int:
    """Run the mutations of the rooms, or of those in these folders, and print those that survive."""
    files = [file for room in ROOMS for file in files_of(room) if file.startswith(rooms or "")]
    found = Counter[tuple[str, Ended]]()
    with tempfile.TemporaryDirectory() as place, ThreadPoolExecutor(processes) as pool:
        folders: Queue[Path] = Queue()
        for k in range(processes):
            copied = Path(place) / str(k)
            shutil.copytree(
                ROOT, copied, ignore=shutil.ignore_patterns(".venv", ".git", "node_modules", "out", "build")
            )
            folders.put(copied)
        try:
            executed = measured(folders.queue[0])
        except RuntimeError as failed:
            print(failed)
            return 2
        some = drawn(count, seed, files, Noticing(executed))

        def ended_of(one: Mutation) -> tuple[Ended, str]:
            folder = folders.get()
            try:
                return run_mutation(one, folder)
            finally:
                folders.put(folder)

        noticed = set[str]()
        for k, (one, (ended, by)) in enumerate(zip(some, pool.map(ended_of, some), strict=True), start=1):
            found[one.file, ended] += 1
            noticed |= {by} - {""}
            if ended != "killed":
                tried = f"{len(one.tests)} tests, {one.seconds:.0f} s"
                print(f"{k} of {count}: {ended}: {one.file}:{one.line} {one.what} ({tried})", flush=True)
        failing = check_unchanged(noticed, executed, folders.queue[0])
        if failing:
            print(failing)
            return 2
    print(f"{'room':50} killed survived timed out")
    for file in sorted({one.file for one in some}):
        print(_row(file, *(found[file, ended] for ended in ("killed", "survived", "timed out"))))
    count_of = Counter[Ended]()
    for (_, ended), number in found.items():
        count_of[ended] += number
    killed, survived, out = count_of["killed"], count_of["survived"], count_of["timed out"]
    print(_row("all", killed, survived, out), f" {100 * killed / max(killed + survived, 1):.0f} %")
    return 0 if killed >= 0.95 * (killed + survived) else 1


def _row(name: str, killed: int, survived: int, out: int) -> str:
    return f"{name:50} {killed:6} {survived:8} {out:9}"


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:3]), *sys.argv[3:]))  # type: ignore[arg-type]
