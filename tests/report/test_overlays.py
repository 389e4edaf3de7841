"""Overlays: rejected candidates stand where they were found, in the colour of their reason."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from sfm.pipeline import run_survey
from sfm.report.figures.overlays import INK, REASON_COLOURS, SHIFT, _crosses
from sfm.report.findings.survey_remarks import findings_of
from sfm.report.output import write_result
from sfm.survey.inputs.survey import read_survey
from sfm.targets.outlines import Flag
from tests.surveys import write_photograph_survey


def test_crosses_are_those_drawn_one_by_one() -> None:
    """Two lines through each candidate, short ones where it is too small; the first reason has the colour."""
    rng = np.random.default_rng(3)
    flags = [reason.value for reason, _ in REASON_COLOURS] + [0, (Flag.LOBED | Flag.TOO_SMALL).value]
    flag = np.repeat(flags, 3)
    xy = rng.permutation(np.stack(np.meshgrid(np.arange(8), np.arange(8)), axis=2).reshape(-1, 2))[
        : len(flag)
    ] * 30 + rng.uniform(5, 20, (len(flag), 2))
    picture, expected = np.full((250, 250, 3), 90, np.uint8), np.full((250, 250, 3), 90, np.uint8)
    _crosses(picture, xy, flag, 0.9)
    for at, value in zip(xy, flag.tolist(), strict=True):
        colour = next((colour for reason, colour in REASON_COLOURS if value & reason.value), INK)
        arm = (2 if value & Flag.TOO_SMALL.value else 4) << SHIFT
        x, y = (round(float(c)) for c in ((at + 0.5) * 0.9 - 0.5) * (1 << SHIFT))
        for sign in (1, -1):
            ends = (x - arm, y - sign * arm), (x + arm, y + sign * arm)
            cv2.line(expected, *ends, colour, 1, cv2.LINE_AA, SHIFT)
    assert (picture != 90).any()
    assert np.array_equal(picture, expected)


def test_no_candidates_draw_nothing() -> None:
    """A photograph without rejected candidates, and one outside of the picture."""
    picture = np.full((20, 20, 3), 90, np.uint8)
    _crosses(picture, np.zeros((0, 2)), np.zeros(0, np.int64), 1.0)
    _crosses(picture, np.array([[-500.0, 9e9]]), np.array([Flag.LOBED.value]), 1.0)
    assert (picture == 90).all()


def test_photographs_that_vanish_during_a_run_are_named(tmp_path: Path) -> None:
    folder = write_photograph_survey(tmp_path / "s", "vanished").parent
    result = run_survey(read_survey(folder / "survey.toml"))
    (folder / "photo 2.png").unlink()
    write_result(findings_of(result), tmp_path / "out")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    (said,) = [one for one in summary["verdict"]["remarks"] if one["kind"] == "photographs_not_drawn"]
    assert said["severity"] == "note" and "photo 2.png" in said["text"] and "photo 1.png" not in said["text"]
    assert said["text"] in " ".join((tmp_path / "out" / "report.txt").read_text(encoding="utf-8").split())
    assert len(list((tmp_path / "out" / "overlays").iterdir())) == len(result.photographs) - 1
