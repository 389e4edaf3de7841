"""`kolinear accept`: what is proven, what is lacking, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from adapters.formats.result_tables import read_scale_sources, write_tables
from sfm.cli.app import app
from sfm.model.errors import KolinearError, SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, without_given
from sfm.model.remarks.remark import remark
from sfm.model.solution import Solution
from sfm.products.inspection.acceptance import (
    Acceptance,
    CalibratedLengths,
    LengthLimit,
    accept_result,
    read_lengths,
)
from sfm.report.pages import write_page
from tests.products.inspection.benches import one_bench
from tests.synthetic import seed_of

DIRECTIONS = [[1, 1, 1], [1, 1, -1], [1, -1, 1], [-1, 1, 1], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
SIGMA = 0.002  # of the calibration, mm


def result_of(names: list[str], xyz: np.ndarray) -> Solution:
    none = np.zeros(0, dtype=np.int64)
    network = Network((), none, tuple(names), ImagePoints(none, none, np.zeros((0, 2)), np.zeros((0, 2, 2))))
    estimate = Estimate((), np.zeros((0, 3)), np.zeros((0, 3, 3)), xyz)
    n = len(names)
    return Solution("volume", network, estimate, np.tile(1e-4 * np.eye(3), (n, 1, 1)), unit="mm",
                        covariance=1e-4 * np.eye(3 * n), datum="free")  # fmt: skip


def volume(*, error: float = 0.0, lines: int = 7, sigma: float = SIGMA) -> tuple[Solution, CalibratedLengths]:
    """Return a cube of 1 m with lines through its centre, five lengths on each; its longest are too long."""
    rng = seed_of("volume")
    names, xyz, rows = ["s1", "s2"], [[0.0, 0, -400], [300, 0, -400]], []
    for k, direction in enumerate(DIRECTIONS[:lines], 1):
        along = 500.0 * np.array(direction)
        for i, t in enumerate((-1, -0.6, -0.2, 0.2, 0.6, 1)):
            names.append(f"{k}.{i}")
            xyz.append((t * along).tolist())
            if i:
                rows.append((f"{k}", f"{k}.0", f"{k}.{i}", np.linalg.norm((t + 1) * along)))
    line, start, end, length = zip(*rows, strict=True)
    true = np.array(length)
    given = true + sigma * rng.standard_normal(len(true))
    given[-1] -= error
    return result_of(names, np.array(xyz)), CalibratedLengths(
        line, start, end, given, np.full(len(true), sigma)
    )


def accepted(result: Solution, lengths: CalibratedLengths, **options: Any) -> Acceptance:
    limit = {key: options.pop(key) for key in ("a", "k", "b") if key in options}
    return accept_result(
        result, lengths, LengthLimit(**{"a": 0.02, "k": 2e-5} | limit), **{"bars": ["s1 - s2"]} | options
    )


def test_a_complete_test_is_proven(tmp_path: Path) -> None:
    found = accepted(*volume())
    assert found.verdict.level == "good" and found.lacking == () and found.count("in") == 35
    assert found.diagonal == pytest.approx(np.sqrt(3) * 1000)
    longest = int(np.argmax(found.lengths.length))
    assert found.limit[longest] == pytest.approx(0.02 + 2e-5 * np.sqrt(3) * 1000, rel=1e-5)
    assert accepted(*volume(), b=0.03).limit.max() == 0.03
    assert found.sigma[0] == pytest.approx(np.sqrt(2e-4), rel=1e-9)  # of two points with 0.01 mm each
    page = write_page(found, tmp_path / "out")
    text = page.read_text(encoding="utf-8")
    assert "VDI/VDE 2634 part 1" in text and "10360" not in text
    summary = json.loads((tmp_path / "out" / "acceptance.json").read_text(encoding="utf-8"))
    assert summary["in"] == 35 and summary["lines"] == 7 and summary["limit"]["B"] is None


def test_errors_are_proven_or_undecided() -> None:
    found = accepted(*volume(error=0.2))
    assert found.verdict.level == "bad" and found.decision[-1] == "out" and found.count("out") == 1
    assert found.error[-1] == pytest.approx(0.2, abs=5 * SIGMA)
    near = accepted(*volume(error=0.04))  # the limit at 1 m
    assert near.decision[-1] == "undecided" and near.verdict.level == "fair"
    assert near.verdict.remarks[0].kind == "tolerance_undecided"
    blind = accepted(*volume(sigma=0.0))
    unknown = replace(blind.lengths, sigma=np.full(35, np.nan))
    found = accepted(volume()[0], unknown)
    assert found.count("not known") == 35
    assert found.lacking == ()
    assert found.verdict.remarks[0].kind == "tolerance_unknown" and found.verdict.level == "fair"
    result, lengths = volume(error=616e3)
    found = accepted(result, replace(lengths, sigma=np.full(35, np.nan)))
    first, second = found.verdict.remarks[:2]
    assert found.verdict.level == "bad" and first.kind == "out_of_tolerance"
    assert first.number("out") == first.number("unknown") == 1
    assert second.kind == "tolerance_unknown" and second.number("unknown") == 34


def test_what_part_1_asks_for_and_the_data_lack_is_said() -> None:
    result, lengths = volume(lines=5)
    few = accepted(result, lengths, diagonal=4000.0)
    lines, longest = few.lacking
    assert lines.kind == "lengths_lacking" and (lines.number("lines"), lines.number("needed")) == (5, 7)
    assert longest.kind == "lengths_lacking" and longest.number("diagonal") == 4000
    assert longest.number("longest") == lengths.length.max() and few.verdict.level == "fair"
    kept = np.arange(len(lengths.length)) != 0
    fewer = CalibratedLengths(*(tuple(np.array(x)[kept]) for x in (lengths.line, lengths.start, lengths.end)),
                              lengths.length[kept], lengths.sigma[kept])  # fmt: skip
    assert remark("lengths_lacking", line="1", lengths=4, needed=5) in accepted(result, fewer).lacking
    same = replace(lengths, line=tuple("A" if k == 0 else one for k, one in enumerate(lengths.line)))
    told = accepted(result, same).lacking
    assert remark("lengths_lacking", parallel=("A", "1")) in told
    crossed = replace(lengths, line=tuple("1" if one == "2" else one for one in lengths.line))
    assert remark("line_not_straight", line="1") in accepted(result, crossed).lacking


def test_a_scale_from_what_is_tested_is_refused() -> None:
    result, lengths = volume()
    for options, told in (
        ({"bars": ["1.3 - 1.0"]}, "line 1: bar 1.3 - 1.0 gave the scale"),
        ({"bars": ["1.2 - 1.5"]}, "line 1: bar 1.2 - 1.5 gave the scale"),  # on the same line
        ({"bars": None}, "the origin of its scale is not stated"),
        ({"bars": []}, "the origin of its scale is not stated"),
        ({"bars": [], "control": ["2.0", "2.4"]}, "line 2: 2.0 and 2.4 are control points"),
        ({"a": -1.0}, "expected A and K not negative"),
    ):
        with pytest.raises(KolinearError, match=told):
            accepted(result, lengths, **options)
    with pytest.raises(KolinearError, match="its scale is undefined"):
        accepted(replace(result, unit="network units"), lengths)
    with pytest.raises(KolinearError, match=r"point 1\.0 is not in the result bench"):
        accepted(one_bench(), lengths)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("line,from,to,length\n1,a,b,0\n", "line 2: column length contains 0, needed more than 0"),
        ("line,from,to,length\n1,a,a,5\n", "line 2: both ends are point a, two points are needed"),
        ("line,from,to,length\n1,a,b,5\n2,b,a,5\n", "line 3: from 'a', to 'b' is on line 2 already"),
        ("line,from,to,length,sigma\n1,a,b,5,-1\n", "column sigma contains -1, needed more than 0"),
        ("from,to,length\na,b,5\n", "no column line, needed line,from,to,length"),
    ],
)
def test_bad_tables_are_one_line(text: str, told: str, tmp_path: Path) -> None:
    (tmp_path / "lengths.csv").write_text(text, encoding="utf-8")
    with pytest.raises(SurveyFileError, match=told):
        read_lengths(tmp_path / "lengths.csv")


def test_the_command_knows_where_the_scale_comes_from(tmp_path: Path) -> None:
    result = one_bench()
    write_tables(tmp_path / "result", replace(result, network=without_given(result.network)))
    names, xyz = list(result.network.points), result.estimate.points
    length = float(np.linalg.norm(xyz[names.index("p1")] - xyz[names.index("p5")]))
    rows = f"line,from,to,length,sigma\n1,p1,p5,{length + 1e-3!r},1e-5\n"
    (tmp_path / "lengths.csv").write_text(rows, encoding="utf-8")
    words = [
        "accept",
        str(tmp_path / "result"),
        str(tmp_path / "lengths.csv"),
        "--out",
        str(tmp_path / "out"),
    ]
    assert read_scale_sources(tmp_path / "result") == (None, ())
    refused = CliRunner().invoke(app, [*words, "--limit-a", "0.1"])
    assert "the origin of its scale is not stated" in str(refused.exception)
    head = "kind,name,coordinate,unit,given,difference,sigma,r,w\n"
    (tmp_path / "result" / "given.csv").write_text(head + "scale bar,p1 - p25,length,m,1.7,0,1e-5,0.5,\n")
    bare = tmp_path / "bare.csv"
    bare.write_text(f"line,from,to,length\n1,p1,p5,{length + 1e-3!r}\n", encoding="utf-8")
    for limit, code in (("2e-3", 0), ("1e-4", 1)):
        told = CliRunner().invoke(app, [*words[:2], str(bare), *words[3:], "--limit-a", limit])
        assert told.exit_code == code, told.output
        told = CliRunner().invoke(app, [*words, "--limit-a", limit])
        assert told.exit_code == code, told.output
    summary = json.loads((tmp_path / "out" / "acceptance.json").read_text(encoding="utf-8"))
    kinds = [one["kind"] for one in summary["remarks"]]
    assert (
        kinds[:2] == ["out_of_tolerance", "lengths_lacking"] and summary["remarks"][0]["text"] in told.output
    )
