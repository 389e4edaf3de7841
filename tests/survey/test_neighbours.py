"""Photographs that were taken near one another: by position and by sequence, complete, missing or wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sfm.matching.tracks.feature_tracks import TiePoints, find_tie_points
from sfm.model.conventions import IntArray
from sfm.model.remarks.remark import of_kind
from sfm.photographs.exif import Metadata, SatellitePosition
from sfm.survey.inputs.measurements import find_photographs
from sfm.survey.inputs.settings import TiePointSettings
from sfm.survey.inputs.survey import CameraSetup, Survey
from sfm.survey.measuring import tie_points
from sfm.survey.measuring.tie_points import NONE, neighbours_by_position, neighbours_in_sequence
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


def test_the_survey_matches_neighbours_and_states_its_pairs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Photographs along a strip, each moved by an eighth of its width; the last third states positions."""
    m, step = 18, 24
    strip = natural_texture(seed_of("strip of photographs"), (192 + m * step, 144))
    for k in range(m):
        path = tmp_path / f"p{k:02d}.png"
        cv2.imwrite(str(path), np.clip(strip[:, k * step : k * step + 192], 0, 255).astype(np.uint8))
        if k >= 12:
            state_position(path, SatellitePosition(0.001 * k, 7.0, 30.0, (np.nan,) * 3))
    camera = CameraSetup(name="one", images="p*.png", pixel_mm=(0.01, 0.01), c_mm=2.0)
    survey = Survey(name="strip", cameras=(camera,), tie_points=TiePointSettings(), folder=tmp_path)
    used: list[Sequence[IntArray]] = []

    def find(*arguments: Any, neighbours: Sequence[IntArray], **options: Any) -> TiePoints:
        used.append(neighbours)
        return find_tie_points(*arguments, neighbours=neighbours, **options)

    monkeypatch.setattr(tie_points, "find_tie_points", find)
    measured = tie_points.tie_photographs(survey, find_photographs(survey))
    by_position, in_sequence = used[0]
    assert (by_position[:12] == NONE).all() and set(by_position[14, :2]) == {13, 15}
    assert in_sequence[5, :4].tolist() == [6, 4, 7, 3]
    (found,) = of_kind(measured.remarks, "pairs_matched")
    assert found.number("possible") == m * (m - 1) / 2 > found.number("pairs") >= 10 * m / 2
    assert (found.number("by_position"), found.number("in_sequence")) == (6, m)
