"""Codes and tie points of a second object: photographs of it are left out, its motion is reported."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from sfm.judgement.survey_result import SurveyResult
from sfm.model.camera import camera_from_values, project
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, empty_estimate
from sfm.model.remarks.remark import kinds_of, of_kind
from sfm.orientation.incremental.sequence import Orientation, orient
from sfm.pipeline import run_survey
from sfm.products.rendering.render import render_photographs
from sfm.products.rendering.scene import CircularTargets, Faces, Optics, Scene, coded_ring, join_marks
from sfm.survey.diagnosis.contradicting_codes import find_contested_codes
from sfm.survey.diagnosis.lost_photographs import MOTION_POINTS, find_second_motion, find_second_objects
from sfm.survey.inputs.given_values import KnownPoints
from sfm.survey.inputs.measurements import Naming
from sfm.survey.inputs.survey import read_survey
from sfm.survey.measuring.measured_store import MeasuredStore
from sfm.survey.orientation import refine
from sfm.targets.codes.plates import code_family
from sfm.targets.codes.rings import CodeFamily
from tests.findings import findings_of
from tests.survey.test_photograph_cameras import with_zoom
from tests.surveys import C_MM, PIXEL_MM, SIZE_PX, SURVEY, stations, survey_of
from tests.synthetic import SIZE_PX as OF_NETWORK
from tests.synthetic import make_network, seed_of

# Places on a plate and on one above it, mm: (face, x, y).
PLACES = [(0, x, y) for x in (-165.0, -110.0, 110.0, 165.0) for y in (-115.0, -40.0, 40.0, 115.0)]
PLACES += [(0, x, y) for x in (-40.0, 40.0) for y in (-120.0, 120.0)]
PLACES += [(1, x, y) for x in (-35.0, 35.0) for y in (-25.0, 25.0)]
FIRST_CODE = 10
MIRRORED = ("photograph_mirrored", "photograph_of_mirror_image")


def two_plates(place: dict[int, int]) -> Scene:
    """Return a plate and a smaller one above it, with codes at places of these numbers."""
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
    marks = []
    for code, k in place.items():
        face, x, y = PLACES[k]
        marks.append(coded_ring(face, np.array([x, y]), 7.0, code, family, 0.08, turn=0.3 * code))
    none = CircularTargets(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0), np.zeros(0, np.int64))
    return Scene(faces, join_marks(marks), none)


SHEET = 16
LEFT_FREE = FIRST_CODE + 3  # its place is free for a code that moves


def places_of(sheet: int, seed: int) -> dict[int, int]:
    """Return the places of all codes: the sheet's are alike for all seeds, those of the object are not."""
    rest = np.random.default_rng(seed).permutation(np.arange(sheet, len(PLACES)))
    return {FIRST_CODE + k: int(at) for k, at in enumerate([*range(sheet), *rest])}


def photograph(folder: Path, name: str, place: dict[int, int], at: tuple[int, ...]) -> None:
    """Render an object from some of nine stations into a folder."""
    camera = camera_from_values("small", "brown", SIZE_PX, (PIXEL_MM, PIXEL_MM), c_mm=C_MM)
    position, rotation = (values[list(at)] for values in stations(9))
    optics = Optics(blur_px=0.7, noise=2 / 255)
    pictures, _ = render_photographs(two_plates(place), camera, position, rotation, optics=optics, seed=at[0])
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
    assert all(one.reason.kind == "photograph_of_second_object" for one in result.failed)
    assert bool(result.failed[0].reason.names("agreeing")) == agree
    assert (result.code >= 0).all() and len(result.code) == len(PLACES) - 1


@pytest.mark.parametrize(
    ("shown", "elsewhere", "left_out"), [(20, 2, False), (20, 3, True), (40, 3, False), (40, 4, True)]
)
def test_a_photograph_with_three_codes_and_a_tenth_elsewhere_is_left_out(
    shown: int, elsewhere: int, left_out: bool
) -> None:
    """Six photographs; the last one shows some codes at points of their own."""
    codes, places = np.arange(shown), np.arange(shown)
    other = np.where(codes < elsewhere, shown + codes, places)
    naming = Naming(
        tuple(map(str, range(2 * shown))),
        np.append(codes, np.full(shown, -1)),
        (*[places] * 5, other),
    )
    targets: Any = tuple(SimpleNamespace(code=codes) for _ in range(6))
    photographs: Any = SimpleNamespace(names=tuple("abcdef"), targets=targets)
    found = find_contested_codes(photographs, naming, None)
    assert sorted(found.places) == list(range(elsewhere))
    assert sorted(found.left_out) == ([5] if left_out else [])


def test_a_code_that_moved_is_reported_and_costs_no_photograph(folder: Path) -> None:
    result = surveyed(folder, ["a*", "c*"])
    assert result.failed == ()
    (moved,) = of_kind(result.remarks, "codes_at_several_places")
    assert moved.names("codes") == (str(FIRST_CODE),) and moved.names("photographs")
    assert all(name.startswith("c") for name in moved.names("photographs"))


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_photographs_that_fit_one_another_only_are_a_second_object(seed: int) -> None:
    """The same numbers are at other places of another object."""
    rng = seed_of(f"second object {seed}")
    network, truth = make_network(rng, images=10, points=40)
    other, _ = make_network(rng, images=10, points=40)
    mine, its = network.image_points, other.image_points
    own = mine.image < 6
    network = replace(network, image_points=join(mine.select(own), its.select(its.image >= 6)))
    found = orient(network, empty_estimate(network, truth.cameras))
    reasons = find_second_objects(network, found, orient)
    assert list(reasons) == ["image 7", "image 8", "image 9", "image 10"]
    assert {one.kind for one in reasons.values()} == {"photograph_of_second_object"}


def join(first: ImagePoints, second: ImagePoints) -> ImagePoints:
    """Return the image points of both."""
    return ImagePoints(
        np.append(first.image, second.image),
        np.append(first.point, second.point),
        np.vstack([first.xy, second.xy]),
        np.concatenate([first.covariance, second.covariance]),
    )


@pytest.mark.parametrize("seed", [3, pytest.param(10, marks=pytest.mark.slow)])
def test_zoomed_photographs_are_no_second_object(seed: int) -> None:
    """They orient one another, and adjusted with a c of their own they show the same shape."""
    network, truth = with_zoom(f"zoomed alike {seed}", dict.fromkeys(range(6, 10), 1.4))
    found = orient(network, empty_estimate(network, truth.cameras), refine=refine)
    assert not found.estimate.oriented.all()
    assert find_second_objects(network, found, orient) == {}


@pytest.mark.parametrize("mirrored", [4, pytest.param(6, marks=pytest.mark.slow)])
def test_photographs_of_the_mirror_image_are_named(mirrored: int) -> None:
    network, truth = make_network(seed_of("mirror images"), images=10, points=40)
    seen = network.image_points
    xy = seen.xy.copy()
    turned = seen.image < mirrored
    xy[turned, 0] = OF_NETWORK[0] - 1 - xy[turned, 0]
    result = run_survey(survey_of(replace(network, image_points=replace(seen, xy=xy)), truth))
    assert len(result.failed) == 4
    for one in result.failed:
        assert one.reason.kind == "photograph_of_mirror_image"
        assert one.reason.number("points") >= 30 and len(one.reason.names("photographs")) == 4


@pytest.mark.sweep(1, 3)
@pytest.mark.parametrize(
    ("mirrored", "control", "severity"),
    [(9, 0, "error"), (8, 0, "error"), (3, 0, "warning"), (8, 8, "warning")],
)
def test_of_two_parts_of_equal_size_none_is_believed_unless_control_decides(
    mirrored: int, control: int, severity: str
) -> None:
    """The larger part was the result, fair, also where it was the mirrored one."""
    network, truth = make_network(seed_of(f"half mirrored {mirrored}"), images=17, points=40)
    seen = network.image_points
    xy = seen.xy.copy()
    turned = seen.image < mirrored
    xy[turned, 0] = OF_NETWORK[0] - 1 - xy[turned, 0]
    names = [str(k + 1) for k in range(control)]
    given: dict[str, Any] = {"datum": {"kind": "control"}} if control else {}
    if control:
        given["control"] = KnownPoints.from_arrays(names, truth.points[:control], 1e-4)
    result = run_survey(survey_of(replace(network, image_points=replace(seen, xy=xy)), truth, **given))
    said = [one for one in result.verdict.remarks if one.kind in MIRRORED]
    assert said and {one.severity for one in said} == {severity}
    assert (result.verdict.level == "bad") is (severity == "error")


@pytest.mark.parametrize("control", [0, 8])
def test_one_mirrored_photograph_is_named(control: int) -> None:
    """It was said to contradict the others."""
    network, truth = make_network(seed_of("one mirrored"), images=8, points=30)
    seen = network.image_points
    xy = seen.xy.copy()
    xy[seen.image == 3, 0] = OF_NETWORK[0] - 1 - xy[seen.image == 3, 0]
    given: dict[str, Any] = {}
    if control:
        names = [str(k + 1) for k in range(control)]
        given = {
            "control": KnownPoints.from_arrays(names, truth.points[:control], 1e-4),
            "datum": {"kind": "control"},
        }
    result = run_survey(survey_of(replace(network, image_points=replace(seen, xy=xy)), truth, **given))
    (one,) = result.failed
    assert (one.image, one.reason.kind) == ("image 4", "photograph_mirrored")
    assert one.reason.number("turned") < 0.5 and one.reason.number("before") > 5


@pytest.mark.sweep(0)
@pytest.mark.parametrize("datum", ["control", "free"])
def test_control_names_photographs_that_are_all_mirrored(datum: str) -> None:
    """Of a camera that is adjusted: K2 is known to 1 % at the corner, the image points to 0.1 %."""
    network, truth = make_network(seed_of("all mirrored"), images=8, points=30)
    seen = network.image_points
    xy = np.column_stack([OF_NETWORK[0] - 1 - seen.xy[:, 0], seen.xy[:, 1]])
    control = KnownPoints.from_arrays([str(k + 1) for k in range(8)], truth.points[:8], 1e-4)
    survey = survey_of(
        replace(network, image_points=replace(seen, xy=xy)), truth,
        free=("c", "x0", "y0", "K1", "K2"), control=control, datum={"kind": datum},
    )  # fmt: skip
    result = run_survey(survey)
    assert "given_mirrored" in kinds_of(result.remarks)
    assert findings_of(result).verdict.level == "bad"


IMAGES, POINTS, NOISE_PX = 8, 200, 0.1


def walked(count: int, *, by_chance: bool = False) -> tuple[Network, Estimate]:
    """Return a network of which the last points walk on together from photograph to photograph, and the rest.

    Args:
        count: of these points.
        by_chance: whether each has errors of its own instead.
    """
    rng = seed_of("second motion")
    network, truth = make_network(rng, images=IMAGES, points=POINTS, free=(), noise_px=NOISE_PX)
    seen, xy = network.image_points, network.image_points.xy.copy()
    for i in range(IMAGES):
        rows = np.flatnonzero((seen.image == i) & (seen.point >= POINTS - count))
        moved = truth.points + 0.03 * i * np.array([1.0, 0.5, 0.2])
        at = project(truth.cameras[0], truth.position[i], truth.rotation[i], moved[seen.point[rows]])
        xy[rows] = at + NOISE_PX * rng.standard_normal(at.shape)
        if by_chance:
            xy[rows] = seen.xy[rows] + rng.uniform(-60, 60, at.shape)
    return replace(network, image_points=replace(seen, xy=xy)), truth


def oriented(network: Network, truth: Estimate) -> Orientation:
    return orient(network, empty_estimate(network, truth.cameras), refine=refine)


def orient_again(network: Network, start: Estimate) -> Orientation:
    return orient(network, start, refine=refine)


@pytest.mark.parametrize("count", [60, MOTION_POINTS + 5])
def test_points_that_walk_on_together_are_reported_with_their_share(count: int) -> None:
    network, truth = walked(count)
    (found,) = find_second_motion(network, oriented(network, truth), orient_again)
    assert found.kind == "second_motion" and found.severity == "error"
    assert found.number("share") == pytest.approx(count / POINTS, abs=0.02)
    assert found.number("points") == pytest.approx(count, abs=4) and len(found.names("photographs")) == IMAGES


def test_errors_by_chance_are_no_motion() -> None:
    network, truth = walked(60, by_chance=True)
    found = oriented(network, truth)
    assert found.estimate.oriented.all()
    assert find_second_motion(network, found, orient_again) == ()


@pytest.mark.parametrize("count", [0, MOTION_POINTS - 2])
def test_few_points_are_not_even_tried(count: int) -> None:
    network, truth = walked(count)

    def refuse(_: Network, __: Estimate) -> Orientation:
        raise AssertionError("tried")

    assert find_second_motion(network, oriented(network, truth), refuse) == ()


def test_photographs_without_orientation_have_their_own_reason() -> None:
    """Their points are not those of another motion, as where they show another object."""
    network, truth = walked(60)
    found = oriented(network, truth)
    position = found.estimate.position.copy()
    position[2:] = np.nan
    found = replace(found, estimate=replace(found.estimate, position=position))
    assert find_second_motion(network, found, orient_again) == ()
