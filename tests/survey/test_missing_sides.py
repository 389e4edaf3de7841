"""Outer rows and columns of a plate that no photograph shows, as where tags begin with another number."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sfm.conventions import BoolArray
from sfm.remarks.remark import Remark
from sfm.survey.diagnosis.codes_found import sides_not_found
from sfm.survey.inputs.measurements import MeasuredPhotographs
from sfm.targets.codes.plates import PlateFamily
from sfm.targets.detect import Targets, find_targets
from tests.plates import BOARD, camera, plate_pictures
from tests.survey.seen_plates import Plates, about, seen_targets
from tests.synthetic import seed_of

APRIL = PlateFamily("aprilgrid", 8, 10, (), "apriltag36h11", 0.75)


def remarks_on(plate: PlateFamily, targets: Sequence[Targets]) -> tuple[Remark, ...]:
    """Return the remarks on the sides of a plate in photographs."""
    names = tuple(str(k) for k in range(len(targets)))
    of_camera = np.zeros(len(names), dtype=np.int64)
    return sides_not_found(
        plate,
        MeasuredPhotographs(names, tuple(map(Path, names)), of_camera, (camera(),), tuple(targets), ()),
    )


@pytest.mark.parametrize(
    ("further", "sides"),
    [(0, ()), (1, ("last 2 columns",)), (2, ("last 4 columns",)), (5, ("first 2 rows",))],
)
def test_tags_that_begin_with_another_number_are_reported(further: int, sides: tuple[str, ...]) -> None:
    pictures = plate_pictures(APRIL, seed_of("another number"), 2)
    stated = replace(APRIL, first_tag=further)
    found = remarks_on(stated, [find_targets(one, codes=stated) for one in pictures])
    assert [one.kind for one in found] == ["plate_side_not_found"] * bool(sides)
    assert tuple(side for one in found for side in one.names("sides")) == sides
    assert all(one.number("views") == 2 for one in found)


def seen_without(hidden: BoolArray, distance: float, count: int = 4) -> tuple[Remark, ...]:
    """Return the remarks on an AprilGrid of which some points are hidden."""
    rng, plates = seed_of("hidden"), Plates.side_by_side(1)
    poses = about(plates, rng, count, distance=distance)
    return remarks_on(APRIL, [seen_targets(plates.xyz, *pose, rng, seen=~hidden) for pose in poses])


def test_a_side_is_reported_where_its_place_is_in_view() -> None:
    row, column = np.divmod(np.arange(APRIL.count), APRIL.columns)
    for hidden, sides in (
        (row < 2, ("first 2 rows",)),
        ((row > 5) | (column < 2), ("last 2 rows", "first 2 columns")),
    ):
        (found,) = seen_without(hidden, 300.0)
        assert found.names("sides") == sides
    assert seen_without((row < 2) & (column > 1), 300.0) == ()
    assert seen_without(row < 2, 300.0, count=1) == ()
    assert seen_without(column < 2, 60.0) == ()  # out of view


def test_a_board_without_a_side_in_view_is_not_reported() -> None:
    nothing = find_targets(np.full((60, 80), 128, np.uint8), polarity="dark")
    assert remarks_on(BOARD, [nothing, nothing]) == ()
