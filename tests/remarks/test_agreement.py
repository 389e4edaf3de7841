"""Number: sentences of the catalogue and counted nouns agree with one thing as with two."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

import pytest

from sfm.remarks.catalogue import KINDS
from sfm.remarks.kind import FIELD, OPTIONAL
from sfm.remarks.remark import Quantity, Remark
from tests.places import ROOT

NOUNS = (
    "bars|cameras|candidates|circles|codes|coordinates|deviations|dots|image points|iterations|key points|"
    "lengths|lines|lost photographs|marks|networks|observations|parameters|photographs|points|rays|rounds|"
    "surveys|targets|unknowns"
)
PLURAL = (
    "agree|are|confirm|contradict|count|determine|differ|do|exceed|explain|fit|have|lie|move|need|overlap|share|"
    "show|stand|were"
)
SINGULAR = (
    "agrees|confirms|contradicts|counts|determines|differs|does|exceeds|explains|fits|has|is|lies|moves|"
    "needs|overlaps|shares|shows|stands|was"
)
SEVERAL = {  # fields that are two or more: what others are a part of, what is needed, and groups that agree
    *("all", "measured", "needed", "now", "oriented", "points", "rays", "tested", "total"),
    *("lines", "photographs", "size"),
}
MANY = 9.0
BEFORE = "".join(
    f"(?<!{word} )" for word in ("of", "in", "along", "and", "camera", "line")
)  # no subject behind
PART = rf"(?: of (?:the |its |all )*(?:\{{\w+\}}(?: (?:{NOUNS}))?|\{{\w+:[a-z ]+\}}))?"


def texts_of(name: str) -> tuple[str, str, str]:
    row = KINDS[name]
    return row.sentence, row.cause, row.remedy


def rendered(name: str, count: int) -> Iterator[str]:
    """Yield sentence, cause and remedy of a kind; what a noun or a verb agrees with is the count."""
    fields = [found for text in texts_of(name) for found in FIELD.findall(text)]
    agreed = {field for field, spec in fields if "|" in spec or spec[:1].isalpha()}
    subjects = {field: ("A", "B")[:count] for field, spec in fields if spec.startswith("@")}
    numbers = {
        field: Quantity(float(count) if field in agreed else MANY)
        for field, _ in fields
        if field not in subjects
    }
    one = Remark(name, subjects, numbers)
    yield from (KINDS[name].write(text, one) for text in texts_of(name))


@pytest.mark.parametrize("name", KINDS)
def test_nouns_verbs_and_pronouns_agree_with_one_and_with_two(name: str) -> None:
    for text in rendered(name, 1):
        assert not re.search(rf"(?<![\d.,])1 (?:{NOUNS})\b", text), text
        assert not re.search(rf"(?<!of )(?<![\d.,])\b1 [a-z]+ (?:{PLURAL})\b", text), text
        assert not re.search(r"\b1 [a-z]+\b[^.]*\b(?:them|these)\b", text), text
    for text in rendered(name, 2):
        assert not re.search(rf"(?<!of )(?<![\d.,])\b2 [a-z]+s (?:{SINGULAR})\b", text), text


@pytest.mark.parametrize("name", KINDS)
def test_what_depends_on_a_number_is_written_by_the_number(name: str) -> None:
    """No verb or noun stands in the text as if what it belongs to were always several."""
    for text in texts_of(name):
        plain = text.replace("[[", "").replace("]]", "")
        for verb in re.finditer(rf"{BEFORE}\{{(\w+)(?::[a-z ]+)?\}}{PART} (?:{PLURAL})\b", plain):
            assert verb.group(1) in SEVERAL and ":" not in verb.group(0).split("}")[0], verb.group(0)
        for noun in re.finditer(rf"(?<!points )\{{(\w+)\}} (?:{NOUNS})\b", plain):
            assert noun.group(1) in SEVERAL, noun.group(0)


@pytest.mark.parametrize("name", KINDS)
def test_causes_and_remedies_have_the_parts_of_their_sentences(name: str) -> None:
    sentence, *others = texts_of(name)
    always = {field for field, _ in FIELD.findall(OPTIONAL.sub("", sentence))}
    assert {field for text in others for field, _ in FIELD.findall(text)} <= always


COUNTED = re.compile(rf" (?:common |planned |coded |stable |control )?(?:{NOUNS})\b")
# behind these a number is what others are a part of; constants and limits are more than one
BEHIND = re.compile(r"\b(?:of|of the|of all|up to|at most|more than|the|x)\s*$")


def uncounted(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield f-strings that write a number before a noun in the plural, whatever the number is."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.JoinedStr):
            continue
        before = ""
        for one, after in zip(node.values, node.values[1:], strict=False):
            if isinstance(one, ast.Constant):
                before = str(one.value)
                continue
            if isinstance(after, ast.Constant) and COUNTED.match(str(after.value)):
                value = ast.unparse(one.value)  # type: ignore[attr-defined]
                number = re.fullmatch(
                    r"[a-z_.]+|len\(.*\)|int\(.*\)|sum\(.*\)|.*\.sum\(\)|.* [-+*] .*", value
                )
                if number and not BEHIND.search(before) and "if" not in value and value != "name":
                    yield node.lineno, value + str(after.value)[:30]


def test_numbers_before_nouns_are_written_by_counted() -> None:
    """But where targets are measured: their stored files depend on all that these modules import."""
    found = [
        f"{path.relative_to(ROOT)}:{line}: {text}"
        for path in sorted((ROOT / "sfm").rglob("*.py"))
        if "targets" not in path.parts
        for line, text in uncounted(ast.parse(path.read_text(encoding="utf-8")))
    ]
    assert not found, "write counted(number, noun)\n" + "\n".join(found)
