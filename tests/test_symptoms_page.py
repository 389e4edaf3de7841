"""docs/symptoms.md has every message: the remarks of the catalogue, and an entry for each error.

An entry is text in backticks in the first column of the tables of errors, … stands for what varies. The
messages are read from the source: what every error of `sfm.model.errors` says, and the sentences of the
rooms that find why a photograph cannot be used.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache

import pytest

from sfm.model import errors
from sfm.model.remarks.catalogue import KINDS
from sfm.targets.outlines import Flag
from tests.places import ROOT, load_page_code

VARIES = "…"
MIN_WORDS = 4  # of what the rooms below say; shorter texts are parts of sentences, keys and units
REASONS = (
    "sfm/files/globs.py",
    "sfm/survey/diagnosis",
    "sfm/products/drafting/camera_groups.py",
    "sfm/survey/measuring/targets.py",
    "sfm/survey/orientation.py",
    "sfm/survey/adjusting/settling.py",
    "sfm/survey/inputs/checks/contradictions.py",
    "sfm/survey/inputs/settings.py",
    "sfm/orientation/incremental",
    "sfm/pipeline.py",
)
ERRORS = {name for name, value in vars(errors).items() if isinstance(value, type)} | {"disk_errors"}
TABLES = load_page_code("remark_tables")
PAGE = (ROOT / "docs" / "symptoms.md").read_text(encoding="utf-8")


def text_of(node: ast.expr) -> str:
    """Return what a message says, … for what varies."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else VARIES
    if isinstance(node, ast.JoinedStr):
        return "".join(text_of(one) for one in node.values)
    if isinstance(node, ast.FormattedValue):
        return text_of(node.value) if isinstance(node.value, ast.Call) else VARIES
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return text_of(node.left) + text_of(node.right)
    if isinstance(node, ast.Call) and called(node) == "counted" and isinstance(node.args[1], ast.Constant):
        return f"{VARIES} {node.args[1].value}s"
    return VARIES


def words(text: str) -> int:
    return len(re.findall(r"[A-Za-z0-9]{2,}", text))


def called(node: ast.Call) -> str:
    return node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")


def trees(*places: str) -> Iterator[tuple[str, ast.Module]]:
    for place in places:
        path = ROOT / place
        assert path.exists(), f"{place} is not there any more: name where its messages went"
        for file in [path] if path.is_file() else sorted(path.rglob("*.py")):
            yield str(file.relative_to(ROOT)), ast.parse(file.read_text(encoding="utf-8"))


def error_messages(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield what errors say, and what is put into a list of remarks."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and node.args:
            target = node.func.value if isinstance(node.func, ast.Attribute) else None
            is_remark = isinstance(target, ast.Name) and target.id == "remarks" and called(node) == "append"
            if is_remark or called(node) in ERRORS:
                yield node.lineno, text_of(node.args[0])


def sentences(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield the texts outside of docstrings, and outside of errors and longer texts."""
    inside: set[int] = set()
    for node in ast.walk(tree):
        is_error = isinstance(node, ast.Call) and called(node) in ERRORS
        is_docstring = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if is_error or is_docstring or isinstance(node, ast.JoinedStr):
            inside |= {id(one) for one in ast.walk(node) if one is not node}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr | ast.Constant) and id(node) not in inside:
            text = text_of(node)
            if words(text) >= MIN_WORDS and text not in KINDS:
                yield node.lineno, text


@cache
def messages() -> dict[str, str]:
    """Return where each message stands, by message."""
    found: dict[str, str] = {}
    for file, tree in trees("sfm", "adapters"):
        found |= {text: f"{file}:{line}" for line, text in error_messages(tree) if words(text) >= 2}
    for file, tree in trees(*REASONS):
        found |= {text: f"{file}:{line}" for line, text in sentences(tree)}
    return found


@cache
def entries() -> list[str]:
    """Return the texts in backticks of the first columns, but for those of the candidates."""
    tables = PAGE.partition(TABLES.END)[2].partition("## Candidates")[0]
    rows = re.findall(r"^\| (.+?) \| ", tables, re.M)
    return [phrase for row in rows for phrase in re.findall(r"`([^`]+)`", row)]


def pattern_of(entry: str) -> re.Pattern[str]:
    """Return what finds an entry in a message, as whole words."""
    inner = ".*".join(re.escape(part) for part in entry.split(VARIES))
    before, after = (r"\b" if one.isalnum() else "" for one in (entry[0], entry[-1]))
    return re.compile(before + inner + after, re.S)


def test_the_remarks_are_those_of_the_catalogue() -> None:
    assert TABLES.with_tables(PAGE) == PAGE, "python docs/remark_tables.py docs/symptoms.md"
    assert all(f"`{kind}`" in PAGE for kind in KINDS)


def test_every_message_has_an_entry() -> None:
    assert len(messages()) > 500
    patterns = [pattern_of(entry) for entry in entries()]
    missing = [
        f"{place}: {text}"
        for text, place in messages().items()
        if not any(one.search(text) for one in patterns)
    ]
    assert not missing, "docs/symptoms.md has no entry for\n" + "\n".join(missing)


def test_every_entry_is_a_message() -> None:
    wrong = [
        entry
        for entry in entries()
        if not any(pattern_of(entry).search(text) for text in messages()) or words(entry) < 1
    ]
    assert not wrong, "no message of the program is\n" + "\n".join(wrong)
    assert len(set(entries())) == len(entries())


def test_every_reason_against_a_candidate_is_explained() -> None:
    table = PAGE.partition("## Candidates")[2]
    named = re.findall(r"^\| `([a-z ]+)` \|", table, re.M)
    assert named == [str(one.name).lower().replace("_", " ") for one in Flag if one.value]


@pytest.mark.parametrize(
    "code",
    [
        'remarks.append("a new one")',
        'raise GeometryError(f"a new one of {n}")',
        'raise errors.OutputError("a new one")',
    ],
)
def test_a_new_message_is_seen_and_has_no_entry(code: str) -> None:
    said = [text for _, text in error_messages(ast.parse(code))]
    assert len(said) == 1 and said[0].startswith("a new one")
    assert not any(pattern_of(entry).search(said[0]) for entry in entries())


def test_the_page_on_natural_texture_quotes_remarks_as_they_are() -> None:
    page = (ROOT / "docs/how-to/natural-texture.md").read_text(encoding="utf-8")
    quoted = re.findall(r'^\| "(.+?)" \|', page, re.M)
    assert len(quoted) >= 3
    assert [one for one in quoted if re.sub(r"\d+", VARIES, one) not in PAGE] == []
