"""Two cameras before a plate that looks alike turned: one turn for both, or a remark."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sfm.camera import camera_from_values, project
from sfm.conventions import FloatArray, rotation_from_vector
from sfm.orientation.incremental.sequence import Orientation
from sfm.survey.board_turns import _is_certain, _Rig, agree_on_turns
from sfm.survey.inputs.measurements import MeasuredPhotographs, Measurements, PhotographList
from sfm.survey.inputs.survey import read_survey
from sfm.survey.orientation import orient_survey
from sfm.survey.target_network import build_network, min_rays, name_coded
from sfm.targets.codes.plates import PlateFamily
from sfm.targets.detect import Targets, _of_crossings
from sfm.targets.fits.saddle import Saddles
from tests.plates import PITCH, PIXEL_MM, SIZE_PX, SURVEY
from tests.synthetic import seed_of

TURNS = {
    PlateFamily("checkerboard", 6, 9): 0,
    PlateFamily("checkerboard", 7, 9): 1,
    PlateFamily("checkerboard", 6, 8): 1,
    PlateFamily("checkerboard", 7, 7): 1,  # colours tell one that is turned by 90 degrees
    PlateFamily("checkerboard", 8, 8): 3,
    PlateFamily("grid", 8, 9): 1,
    PlateFamily("grid", 9, 9): 3,
    PlateFamily("grid", 9, 9, ((2, 3), (4, 4), (5, 2))): 0,
    PlateFamily("asymmetric-grid", 11, 4): 0,
    PlateFamily("asymmetric-grid", 12, 4): 1,
    PlateFamily("hexagonal-grid", 9, 9): 0,
    PlateFamily("hexagonal-grid", 8, 9): 1,
    PlateFamily("charuco", 7, 9, (), "aruco4x4_50", 0.7): 0,
}
BASE = np.array([90.0, 0.0, 5.0])
CONVERGENCE = rotation_from_vector(np.array([0.01, 0.3, -0.02]))


@pytest.mark.parametrize("plate", TURNS, ids=lambda one: f"{one.name} {one.rows} x {one.columns}")
def test_turns_bring_a_plate_onto_itself(plate: PlateFamily) -> None:
    assert len(plate.turns) == TURNS[plate]
    middle = plate.plane(1.0).mean(axis=0)
    for number in plate.turns:
        away = plate.plane(1.0) - middle
        assert np.hypot(*away.T[:2]) == pytest.approx(np.hypot(*away[number].T[:2]))
        assert sorted(number.tolist()) == list(range(plate.count))
        if plate.name == "checkerboard":
            row, column = np.divmod(number[[0, plate.columns + 1]], plate.columns)
            assert (row.min() + column.min()) % 2 == 0


def measured_pairs(
    folder: Path, plate: PlateFamily, names: list[str], right_names: list[str], *, roll: float,
    moved: float = 1.0, apart: tuple[int, ...] = (),
) -> tuple[Measurements, Orientation, MeasuredPhotographs]:  # fmt: skip
    """Return a plate before two cameras, each photograph named as it is upright, and its orientation.

    Args:
        roll: of the right camera, rad.
        moved: by how much the plate is moved between pairs.
        apart: pairs that are not of one moment.
    """
    text = SURVEY.format(
        name="pairs", polarity="dark", pixel=PIXEL_MM, codes=plate.name, rows=plate.rows,
        columns=plate.columns, pitch=PITCH, marks=[], datum="control",
    ).replace("marks = []\n", "")  # fmt: skip
    begin, end = text.index("[[camera]]"), text.index("[targets]")
    sides = [
        text[begin:end].replace('"small"', f'"{s}"').replace("*.png", f"{s}*") for s in ("left", "right")
    ]
    (folder / "survey.toml").write_text(text[:begin] + "".join(sides) + text[end:])
    survey, rng = read_survey(folder / "survey.toml"), seed_of(f"pairs {plate.rows} {roll} {moved}")
    cameras = [
        camera_from_values(name, "brown", SIZE_PX, (PIXEL_MM, PIXEL_MM), c_mm=8.0, free=("c",))
        for name in ("left", "right")
    ]
    X = plate.plane(PITCH)
    targets: list[list[Targets]] = [[], []]
    for k in range(len(names)):
        turn = rotation_from_vector(np.array([0.0, 0.0, moved * rng.uniform(-np.pi, np.pi)]))
        R = rotation_from_vector(moved * np.array([*rng.uniform(-0.3, 0.3, 2), 0.0]) + (0.2, 0.1, 0.0)) @ turn
        X0 = X.mean(axis=0) + R @ (moved * rng.uniform(-12, 12, 3) + (-45.0, 0.0, 330.0))
        right_R = (
            R @ CONVERGENCE @ rotation_from_vector(np.array([0.0, 0.0, roll + (1 + 0.8 * k) * (k in apart)]))
        )
        for side, at, rotation in ((0, X0, R), (1, X0 + R @ BASE, right_R)):
            xy = project(cameras[side], at, rotation, X) + 0.03 * rng.standard_normal((plate.count, 2))
            targets[side].append(upright(xy, plate))
    every = [*names, *right_names]
    camera = np.repeat([0, 1], len(names))
    paths = tuple(folder / name for name in every)
    photographs = MeasuredPhotographs(
        tuple(every), paths, camera, tuple(cameras), (*targets[0], *targets[1]), ()
    )
    naming = name_coded(photographs)
    measured = Measurements(
        build_network(survey, photographs, naming), tuple(cameras), tuple(every), min_rays(naming),
        files=PhotographList(tuple(every), paths, camera, folder), photographs=photographs, naming=naming,
    )  # fmt: skip
    found, start = agree_on_turns(survey, measured, orient_survey(survey, measured))
    return found, start, photographs


def upright(xy: FloatArray, plate: PlateFamily) -> Targets:
    """Return the crossings of a plate, named in the turn in which its columns run to the right most."""
    ways = [np.arange(plate.count), *plate.turns]
    code = max(ways, key=lambda way: float(xy[way.argsort()][plate.columns - 1, 0] - xy[way.argsort()][0, 0]))
    k = len(xy)
    return _of_crossings(Saddles(xy, np.tile(1e-3 * np.eye(2), (k, 1, 1)), np.ones(k), np.ones(k)), code)


def bases(measured: Measurements, start: Orientation, count: int) -> FloatArray:
    """Return the base of each pair in the frame of its left photograph, mm, (p, 3)."""
    R, X0 = start.estimate.rotation, start.estimate.position
    return np.array([R[k].T @ (X0[count + k] - X0[k]) for k in range(count)])


def numbered(side: str, count: int, first: int = 1) -> list[str]:
    return [f"{side} {k + first:02d}.png" for k in range(count)]


@pytest.mark.parametrize(
    ("plate", "roll", "first"),
    [
        (PlateFamily("checkerboard", 7, 9), 1.3, 1),
        (PlateFamily("checkerboard", 8, 8), 0.8, 101),  # photographs in order, numbers without meaning
        (PlateFamily("grid", 8, 10), 2.8, 1),
    ],
)
def test_both_cameras_see_the_plate_in_one_turn(
    plate: PlateFamily, roll: float, first: int, tmp_path: Path
) -> None:
    left, right = numbered("left", 8), numbered("right", 8, first)
    measured, start, before = measured_pairs(tmp_path, plate, left, right, roll=roll)
    assert "plate_looks_alike_turned" not in [one.kind for one in start.remarks]
    assert np.abs(bases(measured, start, 8) - BASE).max() < 3
    assert measured.photographs is not None
    codes = zip(before.targets, measured.photographs.targets, strict=True)
    renamed = [bool((one.code != two.code).any()) for one, two in codes]
    assert not any(renamed[:8]) and any(renamed[8:])  # they were not in one turn


@pytest.mark.parametrize(("moved", "apart"), [(0.0, ()), (1.0, (0, 2, 3, 4, 5))])
def test_an_undecided_turn_is_reported(moved: float, apart: tuple[int, ...], tmp_path: Path) -> None:
    """A plate that was not moved, and photographs most of which are not of one moment."""
    names = numbered("left", 6), numbered("right", 6)
    plate = PlateFamily("checkerboard", 7, 9)
    _, start, _ = measured_pairs(tmp_path, plate, *names, roll=2.8, moved=moved, apart=apart)
    (told,) = [one for one in start.remarks if one.kind == "plate_looks_alike_turned"]
    assert len(told.names("photographs")) == 12 and told.names("cameras") == ("left", "right")


def test_a_pair_of_two_moments_is_reported(tmp_path: Path) -> None:
    names = numbered("left", 6), numbered("right", 6)
    plate = PlateFamily("checkerboard", 7, 9)
    measured, start, _ = measured_pairs(tmp_path, plate, *names, roll=2.8, apart=(3,))
    (told,) = [one for one in start.remarks if one.kind == "plate_looks_alike_turned"]
    assert told.names("photographs") == ("left 04.png", "right 04.png")
    assert np.abs(np.delete(bases(measured, start, 6), 3, axis=0) - BASE).max() < 3


def test_a_turn_is_certain_at_one_in_a_thousand() -> None:
    """F of 6 and 6 degrees of freedom exceeds 20.03 so often (Abramowitz, Stegun 1964, table 26.9)."""
    both = np.ones(2, dtype=bool)
    best = _Rig(np.zeros(2, dtype=np.int64), np.full(2, 0.1), both)
    for ratio, is_certain in ((18.0, False), (22.0, True)):
        other = _Rig(np.ones(2, dtype=np.int64), np.full(2, 0.1 * ratio**0.5), both)
        assert _is_certain(best, [other], 2) == is_certain
