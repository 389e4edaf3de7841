"""What `kolinear match` prints and writes."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.errors import GeometryError, OutputError, SurveyFileError
from sfm.report.matching import match_command
from tests.textures import random_texture, with_noise

SHIFT = (4.3, -2.6)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("photographs")
    texture = random_texture(np.random.default_rng(1), 2.0)
    y, x = np.mgrid[0:160, 0:200].astype(float)
    for k, (dx, dy) in enumerate([(0.0, 0.0), SHIFT]):
        grey = with_noise(texture.value(x - dx, y - dy), 2.0, k).clip(0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / f"{k}.png"), grey)
    return folder / "0.png", folder / "1.png"


def test_one_point_on_the_terminal(photographs: tuple[Path, Path]) -> None:
    text = match_command(*photographs, point="100,80", search_px=61)
    header, line = text.splitlines()
    assert "sigma px" in header
    x, y = (float(part.rstrip(",")) for part in line.split()[3:5])
    assert (x, y) == pytest.approx((100 + SHIFT[0], 80 + SHIFT[1]), abs=0.05)


@pytest.mark.parametrize("method", ["ncc", "lsm", "lsm8", "shift"])
def test_json(photographs: tuple[Path, Path], method: str) -> None:
    found = json.loads(match_command(*photographs, point="100,80", method=method, search_px=61, as_json=True))
    assert found["method"] == method
    entry = found["points"][0]
    assert entry["x_right_px"] == pytest.approx(100 + SHIFT[0], abs=0.25)
    assert entry["r"] > 0.9 and entry["reason"] == "" and entry["sx_px"] > 0
    lost = json.loads(match_command(*photographs, point="2,2", method=method, as_json=True))["points"][0]
    assert lost["x_right_px"] is None and lost["covariance_px2"] is None and lost["reason"] == "outside"


def test_tables_and_picture(photographs: tuple[Path, Path], tmp_path: Path) -> None:
    table = tmp_path / "points.csv"
    table.write_text(
        "point,x_px,y_px,x_right_px,y_right_px\na,60,60,64,58\nb,100.5,80,104,78\n", encoding="utf-8"
    )
    out, picture = tmp_path / "out.csv", tmp_path / "patches.png"
    line = match_command(*photographs, points=table, search_px=41, out=out, picture=picture)
    assert line.startswith("2 of 2 points matched")
    with out.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["point"] for row in rows] == ["a", "b"]
    assert float(rows[1]["x_right_px"]) == pytest.approx(100.5 + SHIFT[0], abs=0.05)
    drawn = cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE)
    assert drawn.shape == (2 * 21 * 8 + 4, 3 * 21 * 8 + 8)
    difference = drawn[: 21 * 8, -21 * 8 :].astype(float)
    assert abs(difference.mean() - 128) < 10  # grey: the patches are the same but for noise


def test_bad_input_is_one_line(photographs: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(SurveyFileError, match="either --point COL,ROW or --points FILE"):
        match_command(*photographs)
    with pytest.raises(SurveyFileError, match="needed COL,ROW such as"):
        match_command(*photographs, point="12")
    with pytest.raises(GeometryError, match="window of 20 px, needed an odd number"):
        match_command(*photographs, point="80,80", template_px=20)
    with pytest.raises(GeometryError, match="method 'sift' is none of"):
        match_command(*photographs, point="80,80", method="sift")
    with pytest.raises(GeometryError, match="nothing to draw"):
        match_command(*photographs, point="2,2", picture=tmp_path / "p.png")
    with pytest.raises(OutputError, match="cannot be written"):
        match_command(*photographs, point="80,80", out=tmp_path / "no" / "o.csv")
    table = tmp_path / "points.csv"
    for text, why in (
        ("id,x\n1,2\n", "columns id,x, needed"),
        ("point,x_px,y_px\n1,2,nan\n", "row 2"),
        ("", "none"),
    ):
        table.write_text(text, encoding="utf-8")
        with pytest.raises(SurveyFileError, match=why):
            match_command(*photographs, points=table)
