"""Mutations change one expression, and are tried with the tests that execute it."""

from __future__ import annotations

import ast

from tests import mutate
from tests.executed import Executed, _followed
from tests.mutate import Module, Noticing, changes_of

FILE = "sfm/judgement/checks.py"


def test_every_room_has_modules() -> None:
    """One that moved would be left out without a word."""
    assert not [room for room in mutate.ROOMS if not mutate.files_of(room)]


def test_a_mutation_changes_one_expression() -> None:
    module = Module(FILE)
    before = ast.dump(module.tree)
    texts = [module.changed(old, new) for _, _, old, new in changes_of(module)]
    assert len(texts) > 20 and len(set(texts)) == len(texts)
    assert ast.dump(module.tree) == before  # as it was
    text = module.text.decode()
    for changed in texts:
        assert ast.dump(ast.parse(changed)) != before
        assert changed.splitlines()[:10] == text.splitlines()[:10]


def test_numbers_are_scaled_and_conditions_turned() -> None:
    module = Module(FILE)
    whats = {what for what, *_ in changes_of(module)}
    assert {"TOLD_APART times 2", "TOLD_APART times 0.5", "condition negated", "Gt -> LtE"} <= whats
    (text,) = (
        module.changed(old, new) for what, _, old, new in changes_of(module) if what == "TOLD_APART times 2"
    )
    assert "TOLD_APART = (2.0 * 0.01)" in text


def test_a_text_with_a_computed_part_is_changed_as_a_whole() -> None:
    module = Module("sfm/model/remarks/row.py")
    texts = [
        module.changed(old, new)
        for _, node, old, new in changes_of(module)
        if any(isinstance(one, ast.JoinedStr) for one in module.around(node))
    ]
    assert texts and all(ast.parse(one) for one in texts)


def executed(*lines: tuple[int, str], file: str = FILE) -> Executed:
    """Return what tests execute, each of a second."""
    by_line: dict[int, set[str]] = {}
    for line, test in lines:
        by_line.setdefault(line, set()).add(test)
    program = {file: Module(file).text.decode()}
    tests = sorted({test for _, test in lines})
    seconds = {test: 1.0 + 0.1 * k for k, test in enumerate(tests)}
    return Executed(program, {}, seconds, {file: by_line}, ("", set()))


def line_of(words: str) -> int:
    lines = Module(FILE).text.decode().splitlines()
    return next(k for k, line in enumerate(lines, start=1) if words in line)


def test_a_line_is_tried_with_the_tests_that_execute_it_and_then_with_those_beside() -> None:
    line = line_of("shown = float(np.median(length))")
    noticing = Noticing(
        executed((line, "t.py::slow"), (line, "t.py::quick"), (1, "t.py::beside"), (1, "u.py::other"))
    )
    noticing.executed.seconds |= {"t.py::slow": 9.0, "t.py::beside": 0.1}
    module = noticing.modules[FILE]
    statement = next(one for one in ast.walk(module.tree) if getattr(one, "lineno", 0) == line)
    assert noticing.of(module, statement) == ("t.py::quick", "t.py::slow", "t.py::beside")
    noticing.executed.seconds["t.py::slow"] = mutate.BUDGET
    assert noticing.of(module, statement) == ("t.py::quick",)


def test_a_constant_is_tried_with_the_tests_that_execute_what_loads_it() -> None:
    """Directly, or as the default of a function that they call."""
    use = line_of("> TOLD_APART *")
    noticing = Noticing(executed((use, "t.py::uses"), (line_of("TOLD_APART = "), "u.py::imports")))
    module = noticing.modules[FILE]
    constant = next(one for one in module.tree.body if "TOLD_APART = " in ast.unparse(one))
    assert noticing.of(module, constant) == ("t.py::uses",)


def test_lines_that_moved_keep_their_tests() -> None:
    before, now = "a\nb\nc\nd\n", "new\na\nb changed\nb too\nd\n"
    lines = {1: {"A"}, 2: {"B"}, 3: {"C"}, 4: {"D"}}
    found = _followed(lines, before, now)
    assert (found[2], found[5]) == ({"A"}, {"D"})
    assert found[3] == found[4] and {"B", "C"} <= found[3]
