"""The interior orientation of one result holds the cameras of another survey."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import numpy as np
import pytest

import sfm
from sfm import cli
from tests.surveys import write_observed_survey


def adjust(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", ["kolinear", "adjust", *map(str, arguments)])
    try:
        cli.main()
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def parameters(result: Path) -> dict[str, tuple[str, str]]:
    with (result / "cameras.csv").open(newline="") as file:
        return {row["parameter"]: (row["value"], row["sigma"]) for row in csv.DictReader(file)}


def test_weighted_it_comes_with_its_full_covariance(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    first = write_observed_survey(tmp_path / "a" / "first", "first")
    first.write_text(first.read_text().replace('free = ["c"]', 'free = ["c", "K3"]'))
    lens = tmp_path / "a" / "lens"
    assert adjust(monkeypatch, first, "--out", lens) == 0
    weighted = ("--camera", lens, "--camera-weighted", "--out", tmp_path / "weighted")
    assert adjust(monkeypatch, first, *weighted) == 0
    found, again = parameters(lens), parameters(tmp_path / "weighted")
    for name, (value, sigma) in found.items():
        if sigma:  # the same observations again: the same values, with standard deviations less by root 2
            assert float(again[name][0]) == pytest.approx(float(value), abs=0.02 * float(sigma))
            assert float(again[name][1]) == pytest.approx(float(sigma) / np.sqrt(2), rel=0.02)
    named = tmp_path / "a" / "named.toml"
    text = first.read_text()
    begin, end = text.index("[[camera]]"), text.index("[observations]")
    camera = 'name = "lens"\nimages = "*"\ncalibration = "lens"\ncalibration_use = "weighted"\n'
    named.write_text(text[:begin] + "[[camera]]\n" + camera + text[end:])
    (tmp_path / "a" / "image_points.csv").write_bytes((first.parent / "image_points.csv").read_bytes())
    survey = sfm.read_survey(named)
    assert survey.cameras[0].correlations and dict(survey.cameras[0].weighted).keys() == {
        name for name, (_, sigma) in found.items() if sigma
    }
    capsys.readouterr()
    assert adjust(monkeypatch, first, "--camera-weighted", "--out", tmp_path / "none") == 2
    assert "expected --camera RESULT" in capsys.readouterr().err
    assert adjust(monkeypatch, first, "--camera", tmp_path / "held", "--out", tmp_path / "x") == 2
    capsys.readouterr()


def test_a_calibration_travels_and_is_held(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    first = write_observed_survey(tmp_path / "first", "first")
    assert adjust(monkeypatch, first, "--out", tmp_path / "calibrated") == 0
    second = write_observed_survey(tmp_path / "second", "second")
    second.write_text(second.read_text().replace("c_mm = 10.0", "c_mm = 10.3"))
    assert adjust(monkeypatch, second, "--camera", tmp_path / "calibrated", "--out", tmp_path / "held") == 0
    given, held = parameters(tmp_path / "calibrated"), parameters(tmp_path / "held")
    assert given["c"][1] and {name: value for name, (value, _) in given.items()} == {
        name: value for name, (value, _) in held.items()
    }
    assert not any(sigma for _, sigma in held.values())

    second.write_text(second.read_text().replace("[2000, 1500]", "[2000, 1600]"))
    capsys.readouterr()
    assert adjust(monkeypatch, second, "--camera", tmp_path / "calibrated", "--out", tmp_path / "other") == 2
    error = capsys.readouterr().err
    assert "has 2000 x 1600 px" in error and error.count("\n") == 1 and not (tmp_path / "other").exists()
