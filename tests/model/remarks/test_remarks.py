"""Remarks, the catalogue and the verdict."""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterator

import pytest

from sfm.model.display import MAX_LISTED
from sfm.model.remarks.catalogue import KINDS, SUBJECTS, TESTS
from sfm.model.remarks.catalogue.hypotheses import SHIFT
from sfm.model.remarks.remark import Remark, kinds_of, of_kind, remark, unless_note
from sfm.model.remarks.row import FIELD, OPTIONAL, Grade, Kind, Quantity, significant
from sfm.model.remarks.verdict import judge, lines_of
from tests.places import ROOT

HEADLINES = {"good": "It worked.", "fair": "It worked, with remarks.", "bad": "No result."}


def sentence(text: str, **parts: object) -> str:
    kind = Kind("some", "note", text, "cause", "remedy")
    subjects = {name: one for name, one in parts.items() if isinstance(one, tuple)}
    numbers = {name: one for name, one in parts.items() if isinstance(one, Quantity)}
    return kind.write(text, Remark("some", subjects, numbers))


@pytest.mark.parametrize(
    ("text", "parts", "said"),
    [
        ("{points} {points:is|are} off", {"points": ("a",)}, "a is off"),
        ("{points:point} {points:is|are} off", {"points": ("a", "b")}, "2 points are off"),
        ("{count:point}", {"count": Quantity(1)}, "1 point"),
        ("by {d}", {"d": Quantity(0.0123456, "mm")}, "by 12.3 µm"),
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


def test_what_another_remark_explains_is_left_out() -> None:
    held = remark("interior_held_of_pair", camera="A", parameters=("c",))
    high = remark("sigma0_high", ratio=9.0, stated=(0.1, "px"))
    other = remark("scale_undefined", unit="mm")
    assert judge([high, other, held], HEADLINES).remarks == (held, other)
    assert judge([high, other], HEADLINES).remarks == (high, other)


def test_what_wrong_coordinates_pull_away_is_not_told_beside_them() -> None:
    """Before, to leave points out and to set sigma_px were advised beside the cause."""
    pulled = (
        remark("image_points_rejected", rejected=80, total=768, share=80 / 768),
        remark("points_with_large_residuals", points=["89"]),
        remark("photographs_uneven", photograph="a", p=1e-4, ratio=1.7),
    )
    strained = remark("given_strained", of="control", elongation=(0.5, "%"), chi2=1e6, fitting=296.0)
    assert judge((*pulled, strained), HEADLINES).remarks == (strained,)
    high = remark("sigma0_high", ratio=6.0, stated=(0.05, "px"))
    assert (high.severity, pulled[1].severity) == ("error", "warning")
    for shift, severity, left in (
        (16.0, "error", ()),
        (4.0, "warning", ()),
        (1.9, "note", (high, pulled[1])),
    ):
        cause = remark("given_not_exact", of="control", sigma=(0.1, "mm"), shift=shift)
        assert cause.severity == severity
        verdict = judge((cause, pulled[1], high), HEADLINES)
        assert set(kinds_of(verdict.remarks)) == {cause.kind, *kinds_of(left)} and verdict.level == "bad"


def test_every_kind_that_is_explained_is_known() -> None:
    for row in KINDS.values():
        assert set(row.explains) <= set(KINDS)


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


LIMITS: dict[
    str, tuple[str, float, float | None]
] = {  # by kind: the number, and from where it is a warning and an error
    "sigma0_high": ("ratio", 2.0, 5.0),
    "scale_weak": ("sigma", 1.0, 5.0),
    "residual_kept": ("over_sigma", 10.0, 30.0),
    "image_points_rejected": ("share", 0.05, None),
    "other_solution": ("moved", 0.0, 5.0),
    "given_contradicted": ("shift", 0.0, 5.0),
    "given_differs": ("harm", 0.0, 5.0),
    "checks_differ": ("more", 0.0, 1.0),
    "rig_contradicted": ("share", 0.0, 0.5),
    "image_sigmas": ("factor", 0.0, 2.0),
    "given_not_exact": ("shift", 2.0, 5.0),
    "given_scatter": ("share", 0.2, None),
    "photographs_missing": ("share", 0.0, 0.5),
    "c_far_from_given": ("share", 5e-4, None),
    "c_hardly_determined": ("share", 0.05, 0.2),
    "camera_not_calibrated": ("rms", 0.51, 1.0),
    "margin_not_calibrated": ("rms", 0.51, 1.0),
    "principal_point_far": ("share", 0.1, None),
    "pixels_distorted": ("share", 0.01, 0.05),
    "halves_differ": ("times", 2.0, None),
    "windows_elsewhere": ("shift", 2.0, None),
    "photographs_differ": ("shift", 2.0, None),
    "windows_disagree": ("share", 0.3, 0.6),
    "second_motion": ("share", 0.01, 0.05),
    "still_features": ("share", 0.05, None),
    "key_points_not_measured": ("missing", 0.5, None),
    "targets_blurred": ("blur", 2.5, None),
}


SHIFTING = [name for name, row in KINDS.items() if row.severity is SHIFT]


@pytest.mark.parametrize("kind", LIMITS)
def test_limits_of_severity(kind: str) -> None:
    number, warning, error = LIMITS[kind]

    def severity(value: float) -> str:
        return Remark(kind, numbers={"surely": Quantity(0.0), number: Quantity(value)}).severity

    if warning > 0:
        assert severity(0.99 * warning) == "note"
    assert severity(1.01 * warning) == "warning"
    if error is not None:
        assert severity(0.99 * error) == "warning" and severity(1.01 * error) == "error"


def test_an_imprecise_calibration_is_an_error_where_its_image_points_are_more_precise() -> None:
    def severity(rms: float, times: float) -> str:
        numbers = {"rms": Quantity(rms), "times": Quantity(times)}
        return Remark("camera_not_calibrated", numbers=numbers).severity

    inf, nan = float("inf"), float("nan")
    assert severity(1.01, 4.99) == severity(1e3, 4.99) == severity(0.99, inf) == "warning"
    assert severity(1.01, 5.01) == severity(inf, inf) == severity(1.01, nan) == "error"
    assert severity(0.5, 0.1) == severity(0.5, 100.0) == "note" and severity(0.52, 0.1) == "warning"


def test_a_principal_point_half_way_to_a_corner_is_an_error() -> None:
    for surely, severity in ((0.24, "warning"), (0.26, "error")):
        numbers = {"share": Quantity(0.3), "surely": Quantity(surely)}
        assert Remark("principal_point_far", numbers=numbers).severity == severity


def test_limits_of_all_grades_are_tested() -> None:
    graded = {name for name, row in KINDS.items() if isinstance(row.severity, Grade)}
    assert graded == {*LIMITS, *SHIFTING}


def test_alternatives_that_shift_coordinates_have_one_grade() -> None:
    assert "points_moved" in SHIFTING
    for kind in SHIFTING:
        severity = [
            Remark(kind, numbers={"shift": Quantity(shift), "wrong": Quantity(rms)}).severity
            for shift, rms in ((1.9, 1.0), (2.1, 1.0), (100.0, 4.9), (100.0, 5.1), (5.1, 5.1))
        ]
        assert severity == ["note", "warning", "warning", "error", "error"], kind
        slight = {"shift": Quantity(1.0), "wrong": Quantity(1.0)}
        for otherwise, expected in ((1.9, "note"), (2.1, "warning"), (9.0, "warning")):
            one = Remark(kind, numbers=slight | {"otherwise": Quantity(otherwise)})
            assert one.severity == expected


def test_every_kind_is_made_somewhere_and_only_kinds_are_made() -> None:
    source = "\n".join(
        path.read_text(encoding="utf-8")
        for path in (ROOT / "sfm").rglob("*.py")
        if path.parent.name != "catalogue"
    )
    assert [kind for kind in (*KINDS, *TESTS) if f'"{kind}"' not in source] == []
    made = set(re.findall(r'\bremark\(\s*"(\w+)"', source))
    assert made - KINDS.keys() - TESTS.keys() == set()


def test_a_test_is_a_row_of_the_table_and_no_remark() -> None:
    """What could not be tested leaves a result good; the table states it."""
    weak = remark("given_weakly_checked", given=("1 - 2", "3 - 4"), of="lengths", sigmas=6.0)
    verdict = judge((weak,), HEADLINES)  # type: ignore[arg-type]
    assert verdict.level == "good" and verdict.remarks == () and verdict.tests == (weak,)
    test, on, result = weak.tested
    assert test and "1 - 2" in on and " 6 " in result
    stored = json.loads(json.dumps(verdict.as_dict()))
    assert stored["remarks"] == [] and stored["tests"][0]["kind"] == weak.kind
    assert (stored["tests"][0]["on"], stored["tests"][0]["result"]) == (on, result)
    assert not KINDS.keys() & TESTS.keys()


def test_sentences_are_short_and_plain() -> None:
    for name, row in KINDS.items():
        text = alternatives_apart(row.sentence).replace("[[", "").replace("]]", "")
        plain = re.sub(r"\{\w+:(\w+)\|[^}]*\}", r"\1", text)
        plain = re.sub(r"\{[^}]*\}", "n", plain)
        for sentence in re.split(r"[.:;] ", plain):
            assert len(sentence.split()) <= 25, f"{name}: {sentence}"
        assert not re.search(r"\b(tell|tells|say|says|bear|bears|own|let go)\b", plain), name


@pytest.mark.parametrize(
    ("value", "digits", "written"),
    [
        (0.0, 3, "0"), (1234.6, 3, "1235"), (12.345, 3, "12.3"), (0.00012345, 3, "0.000123"),
        (1.2345e-6, 3, "0.00000123"), (9.87e-7, 3, "9.87e-07"), (9_876_543.0, 3, "9876543"),
        (12_345_678.0, 3, "1.23e+07"), (-0.5, 2, "-0.50"), (0.25, 1, "0.2"), (float("inf"), 3, "not known"),
    ],
)  # fmt: skip
def test_a_number_is_written_with_significant_digits(value: float, digits: int, written: str) -> None:
    assert significant(value, digits) == written


@pytest.mark.parametrize(
    ("text", "parts", "said"),
    [
        ("{d:+}", {"d": Quantity(-0.5, "px")}, "-0.500 px"),
        ("{d:+}", {"d": Quantity(0.0, "px")}, "+0 px"),
        ("{d:.1f}", {"d": Quantity(0.55, "mm")}, "0.6 mm"),
        ("{d}", {"d": Quantity(0.000546, "m")}, "546 µm"),
        ("{d}", {"d": Quantity(1500.0, "mm")}, "1500 mm"),
        ("{a} of {b}", {"a": Quantity(0.01, "mm"), "b": Quantity(30.0, "mm")}, "0.0100 mm of 30.0 mm"),
        ("{a}, {b}", {"a": Quantity(15.0, "mm"), "b": Quantity(15.0382, "mm")}, "15.00 mm, 15.04 mm"),
        ("{a}, {b}", {"a": Quantity(15.0, "mm"), "b": Quantity(15.000022, "mm")}, "15.00000 mm, 15.00002 mm"),
        ("{a}, {b}", {"a": Quantity(15.0, "mm"), "b": Quantity(15.0, "mm")}, "15.0 mm, 15.0 mm"),
        ("{a}, {b}", {"a": Quantity(1.001, "px"), "b": Quantity(1.002, "mm")}, "1.00 px, 1.00 mm"),
        ("{d}", {"d": Quantity(0.01, "in")}, "0.0100 in"),
        ("{d}", {"d": Quantity(12345.0)}, "12,345"),
        ("{d}", {"d": Quantity(12345.0, "px")}, "12345 px"),
        ("{d}", {"d": Quantity(12.0, "px")}, "12.0 px"),
        ("{d}", {"d": Quantity(1.5)}, "1.50"),
        ("{d}", {"d": Quantity(2e15)}, "2.00e+15"),
        ("{d:%}", {"d": Quantity(1.55e144)}, "not known"),
        ("{d}", {"d": Quantity(float("nan"), "px")}, "not known"),
        ("{d:%}", {"d": Quantity(float("inf"))}, "not known"),
        ("{two:point} of {n}", {"two": Quantity(2171), "n": Quantity(2171)}, "2,171 points of 2,171"),
        ("{count:point} {count:is|are}", {"count": Quantity(12000)}, "12,000 points are"),
        ("{count:is|are}", {"count": Quantity(1)}, "is"),
        ("{names:is|are}", {"names": ("a", "b")}, "are"),
        ("{names:photograph}", {"names": ("a",)}, "1 photograph"),
        ("{a:@}", {"a": ("control", "other")}, "the control points, other"),
        ("{a:@bar}", {"a": ("1 - 2", "bars")}, "bar 1 - 2, the scale bars"),
        ("[[{a} and {b}]]", {"a": Quantity(1)}, ""),
        ("[[{a}]][[, {b}]]", {"b": Quantity(1)}, ", 1"),
    ],
)
def test_a_field_is_written_as_it_asks_for(text: str, parts: dict[str, object], said: str) -> None:
    assert sentence(text, **parts) == said


def test_the_fields_of_a_kind() -> None:
    assert Kind("some", "note", "{a} {b:is|are} [[{c:%}]]", "", "").fields == {"a", "b", "c"}


def test_of_two_grades_the_more_serious_counts() -> None:
    grade = Grade("a", warning=1.0, also=Grade("b", warning=1.0, error=2.0))

    def severity(a: float, b: float) -> str:
        return grade.severity_of(Remark("some", numbers={"a": Quantity(a), "b": Quantity(b)}))

    assert [severity(0, 0), severity(1, 0), severity(0, 1), severity(1, 2), severity(0, 2)] == [
        "note", "warning", "warning", "error", "error",
    ]  # fmt: skip
    assert Grade("a", warning=1.0).of(float("nan")) == "warning"
    assert Grade("a").of(-1e9) == "warning"
    assert Kind("some", "error", "", "", "").severity_of(Remark("some")) == "error"


def test_parts_of_a_remark_are_names_or_numbers() -> None:
    one = remark("two_places", point="12", distance=(0.3, "mm"), sigmas=8, photographs=["a", "b"])
    assert one.subjects == {"point": ("12",), "photographs": ("a", "b")}
    assert one.numbers == {"distance": Quantity(0.3, "mm"), "sigmas": Quantity(8.0)}
    two = remark("two_places", point=("a", "b"), distance=Quantity(1.0, "m"), sigmas=None)
    assert two.names("point") == ("a", "b") and two.number("distance") == 1.0
    assert "sigmas" not in two.numbers and two.number("sigmas") != two.number("sigmas")
    assert two.names("photographs") == ()
    assert remark("two_places", point=("a", "b", "c")).names("point") == ("a", "b", "c")


def test_remarks_are_selected_by_kind_and_severity() -> None:
    mild, warning = (remark("sigma0_high", ratio=ratio, stated=(0.1, "px")) for ratio in (1.9, 2.1))
    other = remark("two_places", point="12", distance=(0.3, "mm"), sigmas=8.0, photographs=("a",))
    assert unless_note(mild) == () and unless_note(warning) == (warning,)
    assert of_kind([mild, other, warning], "sigma0_high") == (mild, warning)
    assert kinds_of([mild, other]) == ("sigma0_high", "two_places")


def test_of_many_remarks_of_a_kind_the_first_are_printed() -> None:
    """The remedy stands once; how many more there are is stated."""
    many = [remark("sigma0_high", ratio=5.1 + k, stated=(0.1, "px")) for k in range(MAX_LISTED + 3)]
    lines = lines_of(many)
    assert [one.text for one in lines[:-1]] == [one.text for one in many[:MAX_LISTED]]
    assert lines[-1].text.startswith("3 ") and {one.severity for one in lines} == {"error"}
    assert lines[0].remedy == many[0].row.remedy and not any(one.remedy for one in lines[1:])
    assert len(lines_of(many[:MAX_LISTED])) == MAX_LISTED
    assert judge(many, HEADLINES).lines == lines  # type: ignore[arg-type]


def test_remedies_speak_of_targets_and_names_only_where_there_are_any() -> None:
    """Points of natural texture are no targets, and their names are nobody's: t00001, t00002 ..."""
    subjects = (
        "The adjustment",
        "Causes and assumptions",
        "Cameras",
        "Photographs",
        "Points and image points",
    )
    speaking = {
        row.name
        for subject in subjects
        for row in SUBJECTS[subject]
        if re.search(r"\b(targets?|names?|rename)\b", row.remedy)
    }
    of_tables = {"image_points_contradicting"}
    of_targets = {"codes_at_several_places", "codes_too_small"}
    assert speaking == of_tables | of_targets


def test_another_kind_has_its_short_name_in_a_sentence() -> None:
    short = KINDS["points_moved"].short
    parts = {"photographs": ("a",), "of": "coordinates", "shift": 4.0, "rms": 2.0, "change": (0.5, "%")}
    one = remark("other_camera", instead=("points_moved", "two_places"), **parts)  # type: ignore[arg-type]
    assert short and short in one.text and "points_moved" not in one.text
    assert not KINDS["two_places"].short and "two_places" in one.text
    assert one.names("instead") == ("points_moved", "two_places")


def test_probabilities_are_written_as_numbers_that_say_something() -> None:
    row = KINDS["sigma0_high"]
    for value, text in ((4.92e-31, "p < 0.001"), (0.0124, "p = 0.012"), (0.5, "p = 0.500")):
        one = Remark("sigma0_high", numbers={"p": Quantity(value)})
        assert row.write("{p:<}", one) == text


def test_a_cause_is_as_serious_as_what_it_explains() -> None:
    """Before, strained control led, which follows from a camera that changed by less than an error."""
    numbers = {
        "shift": Quantity(4.0),
        "wrong": Quantity(4.0),
        "rms": Quantity(1.0),
        "change": Quantity(1.0, "%"),
    }
    parts = {"photographs": ("a",), "of": ("cameras",)}
    cause = Remark("other_camera", parts, numbers)
    control = {"chi2": Quantity(900.0), "fitting": Quantity(50.0), "elongation": Quantity(0.5, "%")}
    strained = Remark("given_strained", {"of": ("control",)}, control)
    assert (cause.severity, strained.severity) == ("warning", "error")
    verdict = judge([strained, cause], HEADLINES)  # type: ignore[arg-type]
    assert verdict.level == "bad" and kinds_of(verdict.remarks) == ("other_camera",)
    slight = Remark("other_camera", parts, numbers | {"shift": Quantity(1.9), "wrong": Quantity(1.9)})
    assert kinds_of(judge([strained, slight], HEADLINES).remarks) == ("given_strained", "other_camera")  # type: ignore[arg-type]


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
    *("lines", "photographs", "size", "least", "parallel", "same"),
}
MANY = 9.0
BEFORE = "".join(
    f"(?<!{word} )" for word in ("of", "in", "along", "and", "camera", "line")
)  # no subject behind
PART = rf"(?: of (?:the |its |all )*(?:\{{\w+\}}(?: (?:{NOUNS}))?|\{{\w+:[a-z ]+\}}))?"


def alternatives_apart(sentence: str) -> str:
    """Return a sentence whose optional parts exclude one another as several sentences."""
    return re.sub(r"\]\]\[\[(?=[A-Z{])", "]]. [[", sentence)


def texts_of(name: str) -> tuple[str, str, str]:
    row = KINDS[name]
    return alternatives_apart(row.sentence), row.cause, row.remedy


def rendered(name: str, count: int) -> Iterator[str]:
    """Yield sentence, cause and remedy of a kind; what a noun or a verb agrees with is the count."""
    fields = [found for text in texts_of(name) for found in FIELD.findall(text)]
    agreed = {field for field, spec in fields if "|" in spec or spec[:1].isalpha()}
    subjects = {field: ("A", "B")[:count] for field, spec in fields if spec.startswith(("@", "?"))}
    numbers = {
        field: Quantity(float(count) if field in agreed else MANY)
        for field, _ in fields
        if field not in subjects
    }
    one = Remark(name, subjects, numbers)
    yield from (KINDS[name].write(text, one) for text in texts_of(name))


def test_nouns_verbs_and_pronouns_agree_with_one_and_with_two() -> None:
    for text in (text for name in KINDS for text in rendered(name, 1)):
        assert not re.search(rf"(?<![\d.,])1 (?:{NOUNS})\b", text), text
        assert not re.search(rf"(?<!of )(?<![\d.,])\b1 [a-z]+ (?:{PLURAL})\b", text), text
        assert not re.search(r"\b1 [a-z]+\b[^.]*\b(?:them|these)\b", text), text
    for text in (text for name in KINDS for text in rendered(name, 2)):
        assert not re.search(rf"(?<!of )(?<![\d.,])\b2 [a-z]+s (?:{SINGULAR})\b", text), text


def test_what_depends_on_a_number_is_written_by_the_number() -> None:
    """No verb or noun stands in the text as if what it belongs to were always several."""
    for text in (text for name in KINDS for text in texts_of(name)):
        plain = text.replace("[[", "").replace("]]", "")
        for verb in re.finditer(rf"{BEFORE}\{{(\w+)(?::[a-z ]+)?\}}{PART} (?:{PLURAL})\b", plain):
            assert verb.group(1) in SEVERAL and ":" not in verb.group(0).split("}")[0], text
        for noun in re.finditer(rf"(?<!points )\{{(\w+)\}} (?:{NOUNS})\b", plain):
            assert noun.group(1) in SEVERAL, text


def test_causes_and_remedies_have_the_parts_of_their_sentences() -> None:
    for name in KINDS:
        sentence, *others = texts_of(name)
        always = {field for field, _ in FIELD.findall(OPTIONAL.sub("", sentence))}
        assert {field for text in others for field, _ in FIELD.findall(text)} <= always, name


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
