"""Remarks, the catalogue and the verdict."""

from __future__ import annotations

import json
import re

import pytest

from sfm.remarks.catalogue import KINDS
from sfm.remarks.kind import Grade, Kind
from sfm.remarks.remark import Quantity, Remark, remark
from sfm.remarks.verdict import judge
from tests.places import ROOT

HEADLINES = {"good": "It worked.", "fair": "It worked, with remarks.", "bad": "No result."}


def sentence(text: str, **parts: object) -> str:
    kind = Kind("some", "note", text, "cause", "remedy")
    subjects = {name: one for name, one in parts.items() if isinstance(one, tuple)}
    numbers = {name: one for name, one in parts.items() if isinstance(one, Quantity)}
    return kind.sentence_of(Remark("some", subjects, numbers))


@pytest.mark.parametrize(
    ("text", "parts", "said"),
    [
        ("{points} {points:is|are} off", {"points": ("a",)}, "a is off"),
        ("{points:point} {points:is|are} off", {"points": ("a", "b")}, "2 points are off"),
        ("{count:point}", {"count": Quantity(1)}, "1 point"),
        ("by {d}", {"d": Quantity(0.0123456, "mm")}, "by 0.0123 mm"),
        ("by {d:+}", {"d": Quantity(0.5, "px")}, "by +0.500 px"),
        ("{share:%}", {"share": Quantity(0.25)}, "25.0 %"),
        ("a[[ and {d}]].", {}, "a."),
        ("a[[ and {d}]].", {"d": Quantity(7)}, "a and 7."),
    ],
)
def test_a_sentence_writes_its_parts(text: str, parts: dict[str, object], said: str) -> None:
    assert sentence(text, **parts) == said


def test_a_missing_part_is_an_error() -> None:
    with pytest.raises(KeyError):
        sentence("by {d}")


def test_a_misspelt_kind_fails_where_it_is_made() -> None:
    with pytest.raises(KeyError):
        remark("no_such_kind")


@pytest.mark.parametrize(
    ("value", "severity"), [(0.9, "note"), (1.0, "warning"), (2.9, "warning"), (3.0, "error")]
)
def test_a_grade_is_by_its_number(value: float, severity: str) -> None:
    assert Grade("shift", warning=1.0, error=3.0).of(value) == severity


def test_an_unknown_number_is_as_bad_as_can_be() -> None:
    assert Grade("shift", warning=1.0, error=3.0).of(float("nan")) == "error"


def test_the_most_serious_remark_decides_and_comes_first() -> None:
    mild, warning, serious = (
        remark("sigma0_high", ratio=ratio, stated=(0.1, "px")) for ratio in (1.9, 2.1, 5.1)
    )
    assert judge([], HEADLINES).level == "good"
    assert judge([mild], HEADLINES).level == "good"
    assert judge([mild, warning], HEADLINES).level == "fair"
    verdict = judge([mild, serious, warning], HEADLINES)
    assert verdict.level == "bad" and verdict.headline == HEADLINES["bad"]
    assert verdict.remarks == (serious, warning, mild)


def test_every_row_has_a_cause_and_a_remedy_and_is_a_sentence() -> None:
    for name, row in KINDS.items():
        assert row.name == name
        assert row.cause and row.remedy, name
        assert row.sentence.rstrip("]").endswith((".", "?")), name
        if isinstance(row.severity, Grade):
            assert row.severity.warning < row.severity.error, name


def test_a_remark_is_plain_values_for_json() -> None:
    one = remark("sigma0_high", ratio=float("nan"), stated=(0.1, "px"))
    stored = json.loads(json.dumps(one.as_dict(), allow_nan=False))
    assert stored["kind"] == "sigma0_high" and stored["severity"] == "error"
    assert stored["numbers"]["stated"] == {"value": 0.1, "unit": "px"}
    assert stored["numbers"]["ratio"]["value"] is None


LIMITS = {  # by kind: the number, and from where it is a warning and an error
    "sigma0_high": ("ratio", 2.0, 5.0),
    "residual_kept": ("over_sigma", 10.0, 30.0),
    "image_points_rejected": ("share", 0.05, None),
    "other_solution": ("moved", 0.0, 3.0),
    "other_solution_reversed": ("moved", 0.0, 3.0),
    "photographs_missing": ("share", 0.0, 0.5),
    "c_far_from_given": ("share", 5e-4, None),
    "c_hardly_determined": ("share", 0.05, None),
    "principal_point_far": ("share", 0.1, None),
    "key_points_not_measured": ("missing", 0.5, None),
    "targets_blurred": ("blur", 2.5, None),
}


@pytest.mark.parametrize("kind", LIMITS)
def test_limits_of_severity(kind: str) -> None:
    number, warning, error = LIMITS[kind]

    def severity(value: float) -> str:
        return Remark(kind, numbers={number: Quantity(value)}).severity

    if warning > 0:
        assert severity(0.99 * warning) == "note"
    assert severity(1.01 * warning) == "warning"
    if error is not None:
        assert severity(0.99 * error) == "warning" and severity(1.01 * error) == "error"


def test_every_kind_is_made_somewhere() -> None:
    source = "\n".join(
        path.read_text(encoding="utf-8")
        for path in (ROOT / "sfm").rglob("*.py")
        if path.parent.name != "catalogue"
    )
    assert [kind for kind in KINDS if f'"{kind}"' not in source] == []


def test_sentences_are_short_and_plain() -> None:
    for name, row in KINDS.items():
        plain = re.sub(r"\{\w+:(\w+)\|[^}]*\}", r"\1", row.sentence.replace("[[", "").replace("]]", ""))
        plain = re.sub(r"\{[^}]*\}", "n", plain)
        for sentence in re.split(r"[.:;] ", plain):
            assert len(sentence.split()) <= 25, f"{name}: {sentence}"
        assert not re.search(r"\b(tell|tells|say|says|bear|bears|own|let go)\b", plain), name
