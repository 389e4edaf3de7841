"""Photographs that were taken near one another: by position and by sequence, complete, missing or wrong."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sfm.matching.tracks.feature_tracks import TiePoints, find_tie_points
from sfm.matching.tracks.matched_pairs import MatchedPairs
from sfm.model.conventions import IntArray
from sfm.model.errors import SurveyFileError
from sfm.model.remarks.remark import of_kind
from sfm.photographs.exif import Metadata, SatellitePosition
from sfm.pipeline import run_survey
from sfm.survey.inputs.cameras import start_cameras
from sfm.survey.inputs.exterior_table import ObservedExterior
from sfm.survey.inputs.given_values import StartOrientations
from sfm.survey.inputs.measurements import find_photographs
from sfm.survey.inputs.settings import TiePointSettings
from sfm.survey.inputs.survey import CameraSetup, Survey, read_survey
from sfm.survey.measuring import tie_points
from sfm.survey.measuring.neighbours import (
    NONE,
    given_exterior,
    neighbours_by_position,
    neighbours_in_sequence,
    neighbours_in_view,
)
from tests.satellite import state_position
from tests.synthetic import seed_of
from tests.textures import natural_texture

SILENT = Metadata((64, 48), "Maker", "Model", None, None, None, 1)
START = datetime(2026, 11, 26, 13, 0, 0)
M_PER_DEG = 111_200.0


def at(
    east: float, north: float, up: float = 30.0, sigma: tuple[float, float, float] = (np.nan,) * 3
) -> Metadata:
    """A photograph taken so many metres from a place on the equator at the date line."""
    longitude = (180 + east / M_PER_DEG + 180) % 360 - 180
    return replace(SILENT, position=SatellitePosition(north / M_PER_DEG, longitude, up, sigma))


def sequence(names: list[str], taken: list[datetime | None] | None = None) -> list[list[int]]:
    metadata = [replace(SILENT, taken=one) for one in taken or [None] * len(names)]
    return neighbours_in_sequence(names, metadata, 4).tolist()


def test_numbers_in_names_make_a_series() -> None:
    names = ["p10.jpg", "p9.jpg", "p11.jpg", "p08.jpg"]  # 8, 9, 10, 11 are 3, 1, 0, 2
    assert sequence(names) == [[2, 1, NONE, 3], [0, 3, 2, NONE], [NONE, 0, NONE, 1], [1, NONE, 0, NONE]]


def test_times_make_a_series_before_names() -> None:
    names = ["a.jpg", "b.jpg", "c.jpg", "d2.jpg", "d1.jpg"]
    taken = [START + timedelta(seconds=k) for k in (3, 1, 2, 0, 0)]  # d1, d2, b, c, a
    assert [row[0] for row in sequence(names, list(taken))] == [NONE, 2, 0, 1, 3]


def test_what_is_no_series_has_no_neighbours() -> None:
    nobody = [NONE] * 4
    assert sequence(["front.jpg", "back.jpg", "roof.jpg"]) == [nobody] * 3
    assert sequence(["left/1.jpg", "right/2.jpg", "a3.jpg", "b4.jpg"]) == [nobody] * 4
    two_cameras = [SILENT, replace(SILENT, serial="2")]
    assert (neighbours_in_sequence(["1.jpg", "2.jpg"], two_cameras, 4) == NONE).all()


@pytest.mark.parametrize("missing", [0, 2])
def test_neighbours_on_a_grid_are_those_beside(missing: int) -> None:
    """Two lines of ten, 20 m apart, across the date line; every other photograph may have no position."""
    x, y = np.meshgrid(20.0 * np.arange(10) - 90, [0.0, 20.0])
    metadata = [at(e, n) for e, n in zip(x.ravel(), y.ravel(), strict=True)]
    if missing:
        metadata[::missing] = [SILENT] * len(metadata[::missing])
    near = neighbours_by_position(metadata, 3)
    if missing:
        assert (near[::2] == NONE).all() and (near[1::2] % 2 == 1).all()
    else:
        assert set(near[4]) == {3, 5, 14} and set(near[10]) == {0, 1, 11}
    # one that is 50 km off has neighbours and is one of nobody else
    metadata[5] = at(50_000.0, 0.0)
    wrong = neighbours_by_position(metadata, 3)
    assert (wrong[5] >= 0).all() and (np.delete(wrong, 5, axis=0) != 5).all()


def test_positions_that_differ_by_no_more_than_their_errors_tell_nothing() -> None:
    rng = seed_of("positions")
    noise = rng.standard_normal((30, 3))

    def any_neighbours(scale: float, sigma: tuple[float, float, float] = (np.nan,) * 3) -> bool:
        rows = [at(*(scale * one), sigma=sigma) for one in noise]  # type: ignore[misc]
        return bool((neighbours_by_position(rows, 3) != NONE).any())

    assert not any_neighbours(0.0) and not any_neighbours(4.0) and any_neighbours(20.0)
    assert any_neighbours(4.0, (0.02, 0.02, 0.03)) and not any_neighbours(0.01, (0.02, 0.02, 0.03))


def test_heights_tell_neighbours_on_a_façade() -> None:
    tower = [at(0.0, 0.0, 15.0 * k) for k in range(12)]
    assert set(neighbours_by_position(tower, 2)[5]) == {4, 6}
    assert (neighbours_by_position([at(0.0, 0.0, np.nan)] * 12, 2) == NONE).all()
    alone = [SILENT, at(0.0, 0.0), SILENT]
    assert (neighbours_by_position(alone, 2) == NONE).all()
    assert neighbours_by_position([at(0, 0), at(200, 0)], 2).tolist() == [[1, NONE], [0, NONE]]


def flown(angles_deg: np.ndarray, position: np.ndarray, *, approximate: bool = False) -> IntArray:
    """Return the neighbours of photographs whose exterior orientation is given."""
    names = tuple(f"{k}.jpg" for k in range(len(position)))
    setup = CameraSetup(name="one", images="*.jpg", size_px=(400, 300), pixel_mm=(0.01, 0.01), c_mm=4.0)
    given: dict[str, Any] = {"exterior": ObservedExterior.from_arrays(names, position, 0.1, angles_deg)}
    if approximate:
        given = {"start_orientations": StartOrientations.from_arrays(names, position, angles_deg)}
    survey = Survey(name="flown", cameras=(setup,), tie_points=TiePointSettings(), **given)
    cameras = start_cameras(survey.cameras, "flown")
    exterior = given_exterior(survey, names, cameras)
    return neighbours_in_view(exterior, np.zeros(len(names), dtype=np.int64), 6)


@pytest.mark.parametrize("approximate", [False, True])
def test_neighbours_in_a_flown_block_look_at_the_same_ground(approximate: bool) -> None:
    """Two flights of 4 x 6 photographs 10 m apart, 40 m above ground: one looks down, one up and sideways."""
    x, y = (a.ravel() for a in np.meshgrid(10.0 * np.arange(6), 10.0 * np.arange(4)))
    position = np.column_stack([x, y, np.full(24, 40.0)])
    down, away = np.zeros((24, 3)), np.tile([110.0, 0.0, 0.0], (24, 1))
    near = flown(np.vstack([down, away]), np.vstack([position, position + 0.5]), approximate=approximate)
    assert (near[:24] < 24).all() and {6, 8, 1, 13} <= set(near[7])
    assert (near[24:] >= 24).sum() + (near[24:] == NONE).sum() == near[24:].size
    assert (near[24:] >= 24).any()


def test_oblique_photographs_have_the_neighbours_of_their_footprint() -> None:
    """A photograph from aside, 40 m off, looks at the middle of a strip; the one beside it looks away."""
    strip = np.column_stack([10.0 * np.arange(12), np.zeros(12), np.full(12, 40.0)])
    position = np.vstack([strip, [[55.0, -40.0, 40.0], [55.0, -41.0, 40.0]]])
    angles = np.zeros((14, 3))
    angles[12:, 0] = [45.0, -45.0]
    near = flown(angles, position)
    assert set(near[12, :4]) <= set(range(3, 9)) and 13 not in near[12]
    assert 12 not in near[13]


def test_positions_alone_give_the_nearest_ones() -> None:
    position = np.column_stack([10.0 * np.arange(12), np.zeros((12, 2))])
    near = flown(np.full((12, 3), np.nan), position)
    assert set(near[5, :2]) == {4, 6} and set(near[0]) == {1, 2, 3, 4, 5, 6}
    assert (flown(np.zeros((4, 3)), np.zeros((4, 3))) == NONE).all()


def write_strip(folder: Path, m: int) -> None:
    """Write m photographs along a strip, each moved by an eighth of its width."""
    step = 24
    strip = natural_texture(seed_of("strip of photographs"), (192 + m * step, 144))
    for k in range(m):
        part = np.clip(strip[:, k * step : k * step + 192], 0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / f"p{k:02d}.png"), part)


def test_the_survey_matches_neighbours_and_states_its_pairs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Photographs along a strip, each moved by an eighth of its width; the last third states positions."""
    m = 18
    write_strip(tmp_path, m)
    for k in range(12, m):
        position = SatellitePosition(0.001 * k, 7.0, 30.0, (np.nan,) * 3)
        state_position(tmp_path / f"p{k:02d}.png", position)
    camera = CameraSetup(name="one", images="p*.png", pixel_mm=(0.01, 0.01), c_mm=2.0)
    survey = Survey(name="strip", cameras=(camera,), tie_points=TiePointSettings(), folder=tmp_path)
    used: list[Sequence[IntArray]] = []

    def find(*arguments: Any, neighbours: Sequence[IntArray], **options: Any) -> TiePoints:
        used.append(neighbours)
        return find_tie_points(*arguments, neighbours=neighbours, **options)

    monkeypatch.setattr(tie_points, "find_tie_points", find)
    measured = tie_points.tie_photographs(survey, find_photographs(survey))
    by_position, in_sequence, in_view = used[0]
    assert (in_view == NONE).all()
    assert (by_position[:12] == NONE).all() and set(by_position[14, :2]) == {13, 15}
    assert in_sequence[5, :4].tolist() == [6, 4, 7, 3]
    (found,) = of_kind(measured.remarks, "pairs_matched")
    assert found.number("possible") == m * (m - 1) / 2 > found.number("pairs") >= 10 * m / 2
    assert (found.number("by_position"), found.number("in_sequence")) == (6, m)


STRIP = """\
[survey]
name = "strip"
unit = "m"
[[camera]]
name = "one"
images = "p*.png"
pixel_mm = [0.01, 0.01]
c_mm = 2.0
[tie_points]
pairs = "pairs.csv"
"""


def test_the_pairs_of_a_list_are_the_only_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In either order; that of photographs without a common part is tried, and no other connects them."""
    write_strip(tmp_path, 16)
    (tmp_path / "survey.toml").write_text(STRIP, encoding="utf-8")
    listed = [(k, k + step) for step in (1, 2) for k in range(16 - step) if (k, k + step) != (7, 8)]
    lines = [f"p{b:02d}.png,p{a:02d}.png" for a, b in [*listed, (0, 15)]]
    (tmp_path / "pairs.csv").write_text("\n".join(["image,other", *lines]) + "\n", encoding="utf-8")
    survey = read_survey(tmp_path / "survey.toml")
    used: list[set[tuple[int, int]]] = []

    def find(*arguments: Any, known: MatchedPairs, **options: Any) -> TiePoints:
        tied = find_tie_points(*arguments, known=known, **options)
        used.append(set(known.known))
        return tied

    monkeypatch.setattr(tie_points, "find_tie_points", find)
    measured = tie_points.tie_photographs(survey, find_photographs(survey))
    assert used[-1] == {*listed, (0, 15)}
    (found,) = of_kind(measured.remarks, "pairs_matched")
    assert found.number("pairs") == len(lines) and "the pairs of the given list" in found.text
    assert (np.bincount(measured.network.image_points.image) > 0).all()


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (["p00.png,p00.png"], "pairs.csv, line 2: image 'p00.png' twice, a pair has two photographs"),
        (
            ["p00.png,p01.png", "p01.png,p00.png"],
            "pairs.csv, line 3: image 'p00.png', other 'p01.png' is on line 2 already",
        ),
        (
            ["p00.png,p9.png"],
            "pairs.csv, line 2: column other: 'p9.png' is no photograph of the survey; correct the name",
        ),
        ([], "pairs.csv: no rows below the header, at least one is needed"),
    ],
)
def test_a_list_that_cannot_be_is_one_line(tmp_path: Path, rows: list[str], message: str) -> None:
    write_strip(tmp_path, 3)
    (tmp_path / "survey.toml").write_text(STRIP, encoding="utf-8")
    (tmp_path / "pairs.csv").write_text("\n".join(["image,other", *rows]) + "\n", encoding="utf-8")
    with pytest.raises(SurveyFileError, match=re.escape(message)):
        run_survey(read_survey(tmp_path / "survey.toml"))
