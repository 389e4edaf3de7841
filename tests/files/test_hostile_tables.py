"""Tables and texts from a stranger: formulas in cells, invisible names, endless files."""

from __future__ import annotations

import csv
import io
import sys
import time
import unicodedata
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfm.files.csv_tables import read_table
from sfm.files.plain_text import BLOCK, as_cell, as_plain, csv_blocks, csv_text, from_cell, is_plain
from sfm.model.errors import SurveyFileError
from sfm.products.rendering.scene_file import read_scene
from sfm.survey.inputs.survey import read_survey

FORMULAS = ("=1+1", "+A1", "@SUM(A1)", "-A1", "-1+2", "\t=1", "\r=1", " =1", "a;=1", "\uff1d1", "\uff0dA1")
NO_FORMULAS = ("1", "-1", "-1.5e-3", "a=b", "a-b", "u001", "'quoted'", "DSC_1.jpg", "a;b", "-2;b")
HIDDEN = (
    "\u202e",
    "\u2066",
    "\u200b",
    "\u200d",
    "\ufeff",
    "\u2028",
    "\x1b",
    "\x85",
    "\u3164",
    "\ufe0f",
    "\xad",
)
SURVEY = '[survey]\nname = "a"\nunit = "m"\n[[camera]]\nname = "c"\nimages = "*.jpg"\n'


@pytest.mark.parametrize("text", FORMULAS)
def test_formulas_are_no_cells(text: str) -> None:
    (row,) = csv.reader(io.StringIO(csv_text(("a",), [(text,)]).partition("\n")[2], newline=""))
    cells = row[0].split(";")
    assert all(cell[:1] not in tuple("=+-@\t\r\uff1d\uff0d") for cell in (*cells, row[0].strip()))
    assert from_cell(row[0]) == as_plain(text)


@pytest.mark.parametrize("text", NO_FORMULAS)
def test_other_texts_and_numbers_stay_as_they_are(text: str) -> None:
    assert csv_text(("a", "b"), [(text, -1.5)]) == f"a,b\n{text},-1.5\n"


@given(text=st.text(alphabet="'=+-@;1.eE a\t\n\uff1d"))
def test_cells_give_back_every_text(text: str) -> None:
    assert from_cell(as_cell(text)) == text


@pytest.mark.parametrize("name", ["=1+1", "'=1+1", "''@a", "-x", "-1", "'a", "a;=b"])
def test_names_go_through_tables(tmp_path: Path, name: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(csv_text(("id", "X"), [(name, 1.0)]), encoding="utf-8")
    assert read_table(path, ("id",), ("X",)).texts == ((name,),)


def test_hidden_characters_are_those_of_unicode() -> None:
    wrong = {"Cc", "Cf", "Cs", "Zl", "Zp"}
    missed = [
        c for c in map(chr, range(sys.maxunicode + 1)) if unicodedata.category(c) in wrong and is_plain(c)
    ]
    assert missed == []
    assert all(
        is_plain(text) for text in ("Brücke 1", "\u6a4b-\u30ab", "\u05e2\u05d1", "e\u0301", "\U0001f4f7")
    )
    assert as_plain("a\u202eb\udcff\n") == r"a\u202eb\xff\n"


@pytest.mark.parametrize("hidden", HIDDEN)
def test_hidden_characters_are_refused_in_names(tmp_path: Path, hidden: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(f"id,X\na{hidden}b,1\n", encoding="utf-8", newline="")
    with pytest.raises(SurveyFileError, match=r"line [23]: (column id contains|[12] columns)"):
        read_table(path, ("id",), ("X",))
    escaped = f"\\U{ord(hidden):08x}"
    for text in (
        SURVEY.replace('"a"', f'"a{escaped}"'),
        SURVEY.replace('"c"', f'"c{escaped}"'),
        SURVEY.replace('"m"', f'"m{escaped}"'),
        SURVEY + f'[datum]\npoints = ["a{escaped}"]\n',
        SURVEY + f'per_group = ["c"]\ngroups = ["a{escaped}"]\n',
    ):
        (tmp_path / "s.toml").write_text(text, encoding="utf-8")
        with pytest.raises(SurveyFileError, match=r"found '[acm]\\[xu]\w+', needed plain text on one line"):
            read_survey(tmp_path / "s.toml")


@pytest.mark.parametrize(
    "text",
    [
        ".".join("a" * 90_000) + " = 1\n",
        "[" + ".".join("a" * 90_000) + "]\n",
        "a = { " + " . ".join(["'a'"] * 90_000) + " = 1 }\n",
    ],
)
def test_long_dotted_keys_are_refused_before_they_are_parsed(tmp_path: Path, text: str) -> None:
    for read in (read_survey, read_scene):
        (tmp_path / "s.toml").write_text(text, encoding="utf-8")
        begun = time.process_time()
        with pytest.raises(SurveyFileError, match=r"s.toml, line 1: more than 16 words joined by dots"):
            read(tmp_path / "s.toml")
        assert time.process_time() - begun < 2


@pytest.mark.parametrize(
    ("more", "refusal"),
    [
        (
            "".join(f'[[camera]]\nname = "c{k}"\nimages = "*"\n' for k in range(20_000)),
            r"camera: found .*, needed at most 20000 values",
        ),
        ("a" * 900_000 + " = 1\n", "unknown key 'aaa"),
        # with the third power of the blanks it took minutes
        ("[" + " " * 3000 + '"observations"]\nfile = 1\n', r"observations.file: found 1, needed"),
        ("[[scale_bar]]\n" * 5000, r"scale_bar 1.from, .* and 19990 more are missing"),
    ],
    ids=["cameras", "long key", "blanks in a header", "missing keys"],
)
def test_very_much_is_refused_at_once_and_in_short(tmp_path: Path, more: str, refusal: str) -> None:
    (tmp_path / "s.toml").write_text(SURVEY + more, encoding="utf-8")
    begun = time.process_time()
    with pytest.raises(SurveyFileError, match=refusal) as refused:
        read_survey(tmp_path / "s.toml")
    assert time.process_time() - begun < 5 and len(str(refused.value)) < 500


def test_what_the_parser_says_of_a_long_key_is_cut(tmp_path: Path) -> None:
    key = f"[{'x' * 5000}]\n"
    (tmp_path / "s.toml").write_text(key + key, encoding="utf-8")
    with pytest.raises(SurveyFileError, match=r"line 2: .*xxx.* is there twice, first in line 1") as refused:
        read_survey(tmp_path / "s.toml")
    assert len(str(refused.value)) < 500


def test_numbers_of_a_table_stay_numbers() -> None:
    assert (
        csv_text(("a",), [(np.float64(-2.5),), (-3,), (float("-inf"),), (None,)]) == 'a\n-2.5\n-3\n""\n""\n'
    )


def test_long_tables_are_written_block_by_block() -> None:
    taken: list[int] = []
    rows = ((k,) for k in range(2 * BLOCK + 1) if taken.append(k) is None)  # type: ignore[func-returns-value]
    blocks = csv_blocks(("a",), rows)
    assert (next(blocks), len(next(blocks).splitlines()), len(taken)) == ("a\n", BLOCK, BLOCK)
    assert "".join(blocks).splitlines() == [str(k) for k in range(BLOCK, 2 * BLOCK + 1)]
