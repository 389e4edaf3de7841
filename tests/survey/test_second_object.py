"""Codes that contradict one another: photographs of a second object are left out, single codes are told."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from sfm.camera import camera_from_values
from sfm.network import ImagePoints, empty_estimate
from sfm.orientation.incremental.sequence import orient
from sfm.pipeline import run_survey
from sfm.remarks.remark import kinds_of, of_kind
from sfm.rendering.render import render_photographs
from sfm.rendering.scene import Optics
from sfm.report.findings.survey_remarks import findings_of
from sfm.result import SurveyResult
from sfm.survey.diagnosis.contradicting_codes import find_contested_codes
from sfm.survey.diagnosis.lost_photographs import find_second_objects
from sfm.survey.inputs.given import KnownPoints
from sfm.survey.inputs.measurements import Naming
from sfm.survey.inputs.survey import read_survey
from sfm.survey.measuring.measured_store import MeasuredStore
from sfm.survey.orientation import refine
from tests.survey.test_photograph_cameras import with_zoom
from tests.survey.two_plates import FIRST_CODE, PLACES, two_plates
from tests.surveys import C_MM, PIXEL_MM, SIZE_PX, SURVEY, stations, survey_of
from tests.synthetic import SIZE_PX as OF_NETWORK
from tests.synthetic import make_network, seed_of

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
    assert all(one.reason.kind == "photograph_with_codes_elsewhere" for one in result.failed)
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
    found = find_contested_codes(photographs, naming)
    assert sorted(found.places) == list(range(elsewhere))
    assert sorted(found.left_out) == ([5] if left_out else [])


def test_a_code_that_moved_is_reported_and_costs_no_photograph(folder: Path) -> None:
    result = surveyed(folder, ["a*", "c*"])
    assert result.failed == ()
    (moved,) = of_kind(result.remarks, "code_at_several_places", "code_rays_apart")
    assert moved.names("code") == (str(FIRST_CODE),) and moved.names("photographs")
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
