"""Codes of which too few are found: sides of plates, small ones; centres of concentric tags."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import sfm.pipeline as pipeline
from sfm.model.camera import camera_from_values
from sfm.model.conventions import AnyArray, BoolArray
from sfm.model.errors import SurveyFileError
from sfm.model.remarks.remark import Remark
from sfm.model.similarity import fit_similarity
from sfm.products.drafting.draft import draft_survey
from sfm.products.rendering.render import render_photograph, render_photographs
from sfm.products.rendering.scene import (
    CircularTargets,
    Faces,
    Optics,
    Scene,
    coded_ring,
    concentric_rings,
    join_marks,
)
from sfm.survey.diagnosis.codes_found import sides_not_found, small_codes
from sfm.survey.inputs.measurements import MeasuredPhotographs
from sfm.survey.inputs.survey import read_survey
from sfm.targets.codes.concentric import concentric_family
from sfm.targets.codes.plates import PlateFamily, code_family
from sfm.targets.codes.rings import CodeFamily
from sfm.targets.detect import Targets, find_targets
from tests.plates import BOARD, camera, plate_pictures
from tests.survey.seen_plates import Plates, about, seen_targets
from tests.surveys import stations
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


@pytest.mark.sweep(0, 3)
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


ACROSS, BLUR_PX = 5, 1.2


def picture_of_codes(diameter_px: float, name: str = "ring14") -> AnyArray:
    """Return a photograph of 25 codes of a family from the front, 1 px per unit."""
    family = code_family(name)
    assert isinstance(family, CodeFamily)
    radius = diameter_px / 2
    pitch = 2 * family.outer * radius + 11
    at = (np.arange(ACROSS) - (ACROSS - 1) / 2) * pitch
    places = np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)
    marks = [coded_ring(0, xy + 0.1 * k, radius, 10 + k, family, 0.08, turn=k) for k, xy in enumerate(places)]
    size = int(ACROSS * pitch)
    one = np.zeros(1)
    faces = Faces(np.zeros((1, 3)), np.eye(3)[None, :2], np.full((1, 2), size), one + 0.8, one, one + 1)
    none = CircularTargets(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0), np.zeros(0, np.int64))
    picture, _ = render_photograph(
        Scene(faces, join_marks(marks), none),
        camera_from_values("one", "brown", (size, size), (0.01, 0.01), c_mm=10.0),
        np.array([0.0, 0.0, 1000.0]),
        np.eye(3),
        optics=Optics(blur_px=BLUR_PX, noise=2 / 255),
        rng=np.random.default_rng(7),
    )
    return picture


def photographed(diameter_px: float) -> Targets:
    """Return the targets of a photograph of codes."""
    return find_targets(picture_of_codes(diameter_px), polarity="dark", codes="ring14", min_diameter_px=4.0)


@pytest.mark.parametrize("name", ["ring12", pytest.param("necklace12", marks=pytest.mark.slow)])
def test_a_folder_of_rings_is_recognised(name: str, tmp_path: Path) -> None:
    """Before: rings without parity were not tried, and the folder fell to natural texture."""
    picture = picture_of_codes(16.0, name)
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.rot90(picture, k))
    draft = draft_survey(tmp_path)
    assert f'codes = "{name}"' in draft.text


def test_small_codes_are_reported_with_what_would_do() -> None:
    small = [photographed(5.6) for _ in range(2)]
    (one,) = small_codes(small)
    assert one.kind == "codes_too_small"
    assert 4.5 < one.number("dot") < 6 < one.number("needed") < 10


@pytest.mark.parametrize("diameter_px", [9.0, 12.0])
def test_the_size_that_is_reported_does(diameter_px: float) -> None:
    found = photographed(diameter_px)
    assert (found.code >= 0).sum() >= ACROSS**2 - 1
    assert small_codes([found]) == () and small_codes([]) == ()


SURVEY = """\
[survey]
name = "concentric"
unit = "mm"
[[camera]]
name = "c"
images = "*.png"
free = ["c"]
pixel_mm = [0.005, 0.005]
c_mm = 6.0
[targets]
codes = "cctag3"
polarity = "dark"
{targets}
[compare]
backend = "none"
"""
# Places on a plate and on one above it, mm: (face, x, y).
PLACES = [(0, x, y) for x in (-165.0, -105.0, 105.0, 165.0) for y in (-115.0, 0.0, 115.0)]
PLACES += [(1, x, y) for x in (-35.0, 35.0) for y in (-30.0, 30.0)]
RADIUS_MM = 25.0


def scene() -> Scene:
    """Return two plates with tags, ids in the order of PLACES."""
    one = np.ones(2)
    faces = Faces(
        np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 60.0]]),
        np.tile(np.eye(3)[:2], (2, 1, 1)),
        np.array([[215.0, 165.0], [65.0, 60.0]]),
        0.8 * one,
        0 * one,
        one,
    )
    family = concentric_family("cctag3")
    marks = [
        concentric_rings(face, np.array([x, y]), RADIUS_MM, k, family, 0.08)
        for k, (face, x, y) in enumerate(PLACES)
    ]
    none = CircularTargets(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0), np.zeros(0, np.int64))
    return Scene(faces, join_marks(marks), none)


@pytest.mark.slow
def test_centres_are_not_corrected_twice(tmp_path: Path) -> None:
    camera = camera_from_values("c", "brown", (1200, 900), (0.005, 0.005), c_mm=6.0)
    positions, rotations = stations(6)
    pictures, _ = render_photographs(
        scene(), camera, positions, rotations, optics=Optics(blur_px=0.7, noise=2 / 255), seed=3
    )
    for i, picture in enumerate(pictures):
        cv2.imwrite(str(tmp_path / f"{i}.png"), picture)
    (tmp_path / "survey.toml").write_text(SURVEY.format(targets=""), encoding="utf-8")
    result = pipeline.run_survey(read_survey(tmp_path / "survey.toml"))
    assert result.eccentricity is None
    height = np.array([0.0, 60.0])
    truth = np.array([[x, y, height[face]] for face, x, y in PLACES])
    network, estimate = result.adjustment.network, result.adjustment.estimate
    coded = [j for j, name in enumerate(network.points) if name.isdigit()]
    assert len(coded) >= len(PLACES) - 2  # the upper plate hides some in most photographs
    points, truth = estimate.points[coded], truth[[int(network.points[j]) for j in coded]]
    moved = fit_similarity(points, truth).apply(points) - truth
    assert np.sqrt(np.mean(moved**2)) < 0.002  # mm, 0.004 px; a correction would be of 0.6 px RMS


def test_radii_of_rings_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "survey.toml"
    path.write_text(SURVEY.format(targets="ring_radii = [2.0, 3.0]"), encoding="utf-8")
    with pytest.raises(SurveyFileError):
        read_survey(path)
