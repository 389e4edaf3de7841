"""Codes that contradict one another: photographs of a second object are left out, single codes are told."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.camera import camera_from_values
from sfm.network import ImagePoints, empty_estimate
from sfm.orientation.incremental.sequence import orient
from sfm.pipeline import run_survey
from sfm.rendering.render import render_photographs
from sfm.rendering.scene import CircularTargets, Faces, Optics, Scene, coded_ring, join_marks
from sfm.result import SurveyResult
from sfm.survey.diagnosis.second_object import find_second_objects, tell_second_objects
from sfm.survey.inputs.survey import read_survey
from sfm.survey.measuring.measured_store import MeasuredStore
from sfm.targets.codes.families import code_family
from sfm.targets.codes.rings import CodeFamily
from tests.surveys import C_MM, PIXEL_MM, SIZE_PX, SURVEY, stations
from tests.synthetic import make_network, seed_of

# Places on a plate and on one above it, mm: (face, x, y).
PLACES = [(0, x, y) for x in (-165.0, -110.0, 110.0, 165.0) for y in (-115.0, -40.0, 40.0, 115.0)]
PLACES += [(0, x, y) for x in (-40.0, 40.0) for y in (-120.0, 120.0)]
PLACES += [(1, x, y) for x in (-35.0, 35.0) for y in (-25.0, 25.0)]
FIRST_CODE, SHEET = 10, 16
LEFT_FREE = FIRST_CODE + 3  # its place is free for a code that moves


def scene_of(place: dict[int, int]) -> Scene:
    """Return plates with codes at the given numbers of PLACES."""
    family = code_family("ring14")
    assert isinstance(family, CodeFamily)
    faces = Faces(
        np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 60.0]]),
        np.tile(np.eye(3)[:2], (2, 1, 1)),
        np.array([[210.0, 160.0], [60.0, 50.0]]),
        np.array([0.8, 0.85]),
        np.zeros(2),
        np.ones(2),
    )
    marks = [
        coded_ring(PLACES[k][0], np.array(PLACES[k][1:]), 7.0, code, family, 0.08, turn=0.3 * code)
        for code, k in place.items()
    ]
    none = CircularTargets(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0), np.zeros(0, np.int64))
    return Scene(faces, join_marks(marks), none)


def places_of(sheet: int, seed: int) -> dict[int, int]:
    """Return the places of all codes: the sheet's are alike for all seeds, those of the object are not."""
    rest = np.random.default_rng(seed).permutation(np.arange(sheet, len(PLACES)))
    return {FIRST_CODE + k: int(at) for k, at in enumerate([*range(sheet), *rest])}


def photograph(folder: Path, name: str, place: dict[int, int], at: tuple[int, ...]) -> None:
    """Render an object from some of nine stations into a folder."""
    camera = camera_from_values("small", "brown", SIZE_PX, (PIXEL_MM, PIXEL_MM), c_mm=C_MM)
    position, rotation = (values[list(at)] for values in stations(9))
    optics = Optics(blur_px=0.7, noise=2 / 255)
    pictures, _ = render_photographs(scene_of(place), camera, position, rotation, optics=optics, seed=at[0])
    for k, picture in enumerate(pictures):
        cv2.imwrite(str(folder / f"{name}{k}.png"), picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of photographs: a of an object, b of a second one, c of the first with a moved code."""
    folder = tmp_path_factory.mktemp("objects")
    first = places_of(SHEET, 1)
    free = first.pop(LEFT_FREE)
    photograph(folder, "a", first, (0, 2, 3, 5, 6, 8))
    photograph(folder, "b", places_of(SHEET, 2), (1, 4, 7))
    photograph(folder, "c", first | {FIRST_CODE: free}, (4, 7))
    return folder


def surveyed(folder: Path, globs: list[str]) -> SurveyResult:
    """Return the result of a survey of some of the photographs, each measured once."""
    text = SURVEY.format(name="objects", backend="none") + "[adjust]\nsigma_px = 0.02\n"
    (folder / "survey.toml").write_text(
        text.replace('"*.png"', str(globs).replace("'", '"')), encoding="utf-8"
    )
    return run_survey(read_survey(folder / "survey.toml"), store=MeasuredStore(folder / "store"))


@pytest.mark.parametrize(("globs", "agree"), [(["a*", "b*"], True), (["a*", "b1*"], False)])
def test_another_object_with_the_same_sheet_is_left_out(folder: Path, globs: list[str], agree: bool) -> None:
    """Sixteen codes of the sheet orient all photographs; the others would become foreign points."""
    result = surveyed(folder, globs)
    assert {one.image[0] for one in result.failed} == {"b"}
    assert len(result.failed) == (3 if agree else 1)
    assert all("are elsewhere than in the others" in one.reason for one in result.failed)
    assert ("a second object with the same codes" in result.failed[0].reason) == agree
    assert (result.code >= 0).all() and len(result.code) == len(PLACES) - 1


def test_a_code_that_moved_is_told_and_costs_no_photograph(folder: Path) -> None:
    result = surveyed(folder, ["a*", "c*"])
    assert result.failed == ()
    start = f"code {FIRST_CODE} is read at several places, c"
    (line,) = [one for one in result.warnings if one.startswith(start)]
    assert "a target that was moved, two of one number, or a misread code" in line


@pytest.mark.parametrize("seed", [1, 2])
def test_photographs_that_fit_one_another_only_are_a_second_object(seed: int) -> None:
    """The same numbers are at other places of another object."""
    rng = seed_of(f"second object {seed}")
    network, truth = make_network(rng, images=10, points=40)
    other, _ = make_network(rng, images=10, points=40)
    mine, its = network.image_points, other.image_points
    own = mine.image < 6
    network = replace(network, image_points=join(mine.select(own), its.select(its.image >= 6)))
    found = orient(network, empty_estimate(network, truth.cameras))
    (group,) = find_second_objects(network, found, orient)
    assert group.images == ("image 7", "image 8", "image 9", "image 10") and group.certain
    told = dict(tell_second_objects(found, (group,)).failures)
    assert all("a second object with the same codes" in told[image] for image in group.images)


def join(first: ImagePoints, second: ImagePoints) -> ImagePoints:
    """Return the image points of both."""
    return ImagePoints(
        np.append(first.image, second.image),
        np.append(first.point, second.point),
        np.vstack([first.xy, second.xy]),
        np.concatenate([first.covariance, second.covariance]),
    )
