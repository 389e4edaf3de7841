"""What the tests hold: small changes of the program, each of which a test must notice.

    python -m tests.mutate [COUNT [SEED]]       `make mutate`

draws mutations of the rooms below: a comparison turned round, a sum in place of a difference, a threshold
doubled or halved, a condition negated. Each is written into a copy of the project, the tests of its room run
until one fails, and the table lists which survived. Nothing is changed in the project.

Some change nothing that a test could notice: in score.py the centre of the motions that `_constraints` fixes,
as rotations about any centre are the same motions, and the scale of the normals, which only rounding needs.
"""

from __future__ import annotations

import ast
import copy
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import Queue

from tests.places import ROOT

TIMEOUT = 300  # s, of the tests of one mutation; one that never ends is noticed
ROOMS: dict[str, tuple[str, ...]] = {  # module or package, with the tests that hold it
    "sfm/adjustment/hypotheses": (
        "tests/adjustment/test_alternatives.py",
        "tests/adjustment/test_columns.py",
        "tests/adjustment/test_rejections.py",
        "tests/adjustment/test_families.py",
        "tests/adjustment/test_unchecked_assumptions.py",
        "tests/adjustment/test_hypotheses.py",
    ),
    "sfm/remarks/kind.py": ("tests/remarks",),
    "sfm/remarks/verdict.py": ("tests/remarks",),
    "sfm/remarks/remark.py": ("tests/remarks",),
    "sfm/adjustment/quality/statistics.py": (
        "tests/adjustment/test_statistical_tests.py",
        "tests/adjustment/test_statistics.py",
        "tests/adjustment/test_minimal_bias.py",
    ),
    "sfm/adjustment/quality/reliability.py": (
        "tests/adjustment/test_statistical_tests.py",
        "tests/adjustment/test_minimal_bias.py",
        "tests/adjustment/test_statistics.py",
    ),
    **{
        f"sfm/adjustment/quality/{module}.py": (
            "tests/adjustment/test_given_model.py",
            "tests/adjustment/test_given_values.py",
        )
        for module in ("given_values", "given_points")
    },
    "sfm/targets/codes/rings.py": ("tests/targets/test_codes.py",),
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
    source: str  # of the changed module
    tests: tuple[str, ...]


def mutations_of(file: str, tests: tuple[str, ...]) -> Iterator[Mutation]:
    """Return all mutations of a module."""
    tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
    for number, node in enumerate(ast.walk(tree)):
        for what, change in _changes(node):
            changed = copy.deepcopy(tree)
            other = next(one for k, one in enumerate(ast.walk(changed)) if k == number)
            change(other)
            line = getattr(node, "lineno", 0)
            yield Mutation(file, line, what, ast.unparse(ast.fix_missing_locations(changed)), tests)


def _changes(node: ast.AST) -> Iterator[tuple[str, object]]:
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
    elif isinstance(node, ast.Assign) and _is_threshold(node):
        for factor in (2.0, 0.5):
            yield f"{ast.unparse(node.targets[0])} times {factor:g}", lambda one, f=factor: _scale(one, f)


def _is_text(node: ast.BinOp) -> bool:
    return any(isinstance(one, ast.JoinedStr) or _is_string(one) for one in (node.left, node.right))


def _is_string(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def _is_threshold(node: ast.Assign) -> bool:
    """Return whether a number with a name of its own is set."""
    target, value = node.targets[0], node.value
    return (
        isinstance(target, ast.Name)
        and target.id.isupper()
        and isinstance(value, ast.Constant)
        and type(value.value) in (int, float)
    )


def _scale(node: ast.Assign, factor: float) -> None:
    assert isinstance(node.value, ast.Constant)
    value = node.value.value
    new = factor * value  # type: ignore[operator]
    node.value = ast.Constant(max(round(new), 1) if isinstance(value, int) else new)


def drawn(count: int, seed: int) -> list[Mutation]:
    """Return so many mutations, spread over the rooms by their size."""
    every: list[Mutation] = []
    for room, tests in ROOMS.items():
        path = ROOT / room
        files = [path] if path.is_file() else sorted(path.glob("*.py"))
        for file in files:
            every += mutations_of(str(file.relative_to(ROOT)), tests)
    random.Random(seed).shuffle(every)
    return every[:count]


def is_noticed(one: Mutation, folder: Path) -> bool:
    """Return whether the tests of a mutation fail, in a copy of the project."""
    path = folder / one.file
    before = path.read_text(encoding="utf-8")
    path.write_text(one.source, encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *one.tests]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    try:
        ended = subprocess.run(command, cwd=folder, capture_output=True, timeout=TIMEOUT, env=environment)
        return ended.returncode != 0
    except subprocess.TimeoutExpired:
        return True
    finally:
        path.write_text(before, encoding="utf-8")


def main(count: int = 100, seed: int = 1, processes: int = 2) -> int:
    """Run the mutations and print those that survive."""
    some, found = drawn(count, seed), Counter[tuple[str, bool]]()
    with tempfile.TemporaryDirectory() as place, ThreadPoolExecutor(processes) as pool:
        folders: Queue[Path] = Queue()
        for k in range(processes):
            copied = Path(place) / str(k)
            shutil.copytree(
                ROOT, copied, ignore=shutil.ignore_patterns(".venv", ".git", "node_modules", "out", "build")
            )
            folders.put(copied)

        def tried(one: Mutation) -> bool:
            folder = folders.get()
            try:
                return is_noticed(one, folder)
            finally:
                folders.put(folder)

        for one, noticed in zip(some, pool.map(tried, some), strict=True):
            found[one.file, noticed] += 1
            if not noticed:
                print(f"survived: {one.file}:{one.line} {one.what}", flush=True)
    print(f"{'room':50} killed of")
    for file in sorted({file for file, _ in found}):
        print(f"{file:50} {found[file, True]:6} {found[file, True] + found[file, False]}")
    killed = sum(number for (_, noticed), number in found.items() if noticed)
    print(f"{'all':50} {killed:6} {len(some)}  {100 * killed / max(len(some), 1):.0f} %")
    return 0 if killed >= 0.95 * len(some) else 1


if __name__ == "__main__":
    sys.exit(main(*(int(one) for one in sys.argv[1:])))
