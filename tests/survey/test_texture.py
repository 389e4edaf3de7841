"""Points of natural texture: windows that show another place, wrong ones, few, scenes of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sfm.adjustment.result import Adjustment
from sfm.judgement.hypotheses.hypotheses import JudgedAssumptions
from sfm.model.camera import project
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.remarks.remark import of_kind, remark
from sfm.model.similarity import fit_similarity
from sfm.survey.adjusting import solved_survey
from sfm.survey.adjusting.choices import OF_CAMERAS, solve_survey
from sfm.survey.adjusting.settling import Task
from sfm.survey.adjusting.solved_survey import SolvedSurvey
from sfm.survey.inputs.sources import MARKS, TEXTURE
from sfm.survey.inputs.survey import CameraSetup, Survey
from sfm.survey.sources.source import Correspondences
from tests.survey.texture_scenes import (
    KINDS,
    NUMBERS,
    SHARE,
    WRONG,
    outcome_of,
    study,
    turntable,
    water,
    write_masks,
    write_scene,
)
from tests.surveys import survey_of
from tests.synthetic import make_network, seed_of

SPOILED = (5, 40, 90)  # points
NOISE_PX = 0.1
POINTS = 60


@pytest.fixture(scope="module")
def noisy() -> tuple[Network, Estimate]:
    """Return a network of which some points have errors of 2.5 sigma, too small for tests of single ones."""
    rng = seed_of("wrong windows")
    network, truth = make_network(rng, images=8, points=150, free=("c",), noise_px=NOISE_PX)
    seen, xy = network.image_points, network.image_points.xy.copy()
    wrong = np.isin(seen.point, SPOILED)
    turn = rng.uniform(0.0, 2 * np.pi, wrong.sum())
    xy[wrong] += 2.5 * NOISE_PX * np.column_stack([np.cos(turn), np.sin(turn)])
    return replace(network, image_points=replace(seen, xy=xy)), truth


def textured(network: Network, truth: Estimate) -> Correspondences:
    """Return image points of texture."""
    return Correspondences(replace(network, sources=(TEXTURE,)), truth, np.full(len(network.points), 3))


def rejecting(network: Network, truth: Estimate, reject: str) -> Survey:
    """Return a survey that rejects gross errors, or does not."""
    survey = survey_of(network, truth)
    return replace(survey, adjust=survey.adjust.model_copy(update={"reject": reject}))


def test_texture_loses_them_and_targets_are_named(noisy: tuple[Network, Estimate]) -> None:
    network, truth = noisy
    names = {network.points[j] for j in SPOILED}
    survey = rejecting(network, truth, "tau")
    of_targets = solve_survey(survey, Correspondences(network, truth, np.full(150, 3)))
    assert set(of_targets.adjustment.network.points) == set(network.points)
    of_texture = solve_survey(survey, textured(network, truth))
    assert set(network.points) - set(of_texture.adjustment.network.points) == names
    assert {one.point for one in of_texture.left_out} == names


def test_what_control_names_stays(noisy: tuple[Network, Estimate]) -> None:
    network, truth = noisy
    given = [*SPOILED[:1], 10, 60, 120]
    network = network.with_control([network.points[j] for j in given], truth.points[given], 1.0)
    found = solve_survey(rejecting(network, truth, "tau"), textured(network, truth))
    left = set(network.points) - set(found.adjustment.network.points)
    assert left == {network.points[j] for j in SPOILED[1:]}


def test_a_point_that_the_final_adjustment_leaves_one_ray_is_left_out(
    noisy: tuple[Network, Estimate], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its weights are others, and what they reject may be the second ray of a point."""
    network, truth = noisy
    seen, finally_adjusted = network.image_points, solved_survey.adjust_finally
    two = np.ones(len(seen), dtype=bool)
    two[np.flatnonzero(seen.point == 7)[2:]] = False
    network = replace(network, image_points=seen.select(two))

    def adjust_finally(task: Task, part: Network, *given: Any) -> Adjustment:
        final = finally_adjusted(task, part, *given)
        if network.points[7] not in part.points:
            return final
        row = np.flatnonzero(part.image_points.point == part.point_index(network.points[7]))[0]
        return replace(final, rejected=final.rejected | (np.arange(len(final.rejected)) == row))

    monkeypatch.setattr(solved_survey, "adjust_finally", adjust_finally)
    solution = solve_survey(
        rejecting(network, truth, "tau"), Correspondences(network, truth, np.full(150, 2))
    )
    assert network.points[7] not in solution.adjustment.network.points
    assert solution.adjustment.defect == solution.adjustment.expected_defect
    (left_out,) = [point for point in solution.left_out if point.point == network.points[7]]
    assert left_out.reason.kind == "points_contradicted" and left_out.reason.number("accepted") == 1


def test_a_survey_that_rejects_nothing_loses_nothing(noisy: tuple[Network, Estimate]) -> None:
    network, truth = noisy
    found = solve_survey(rejecting(network, truth, "none"), textured(network, truth))
    assert set(found.adjustment.network.points) == set(network.points)


def test_windows_show_another_place_where_targets_moved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether a test of alternatives found it, or rejected image points that agree."""
    network, truth = make_network(seed_of("elsewhere"), images=8, points=POINTS, free=("c",))
    moved = [
        remark("points_moved", points=[name], distance=away, shift=9.0, wrong=1.0, **{"from": image})
        for name, away, image in (("7", 0.1, "image 5"), ("17", 0.2, "image 6"))
    ]
    monkeypatch.setattr(
        solved_survey, "judge_alternatives", lambda *_, **__: JudgedAssumptions(causes=(moved[0],))
    )
    twice = remark("two_places", point="9", distance=0.1, sigmas=9.0, photographs=["image 3"])
    monkeypatch.setattr(solved_survey, "explain_rejections", lambda *_, **__: (moved[1], twice))
    survey = survey_of(network, truth)
    matched = Correspondences(network, truth, np.full(POINTS, 2))
    of_targets = solve_survey(survey, matched).remarks
    assert of_kind(of_targets, "points_moved") == tuple(moved) and of_kind(of_targets, "two_places")
    of_texture = solve_survey(survey, textured(network, truth)).remarks
    (found,) = of_kind(of_texture, "windows_elsewhere")
    assert found.names("points") == ("7", "17") and found.names("from") == ("image 5", "image 6")
    assert found.severity == "warning" and found.numbers["distance"].value == 0.2
    assert not of_kind(of_texture, "points_moved")
    assert not of_kind(of_texture, "two_places")  # nobody can measure a point without a name again


@pytest.mark.parametrize(
    ("group", "kind"), [((7, 17, 27), "windows_elsewhere"), ((7, 8, 17), "points_moved")]
)
def test_a_named_point_among_windows_is_one(
    monkeypatch: pytest.MonkeyPatch, group: tuple[int, ...], kind: str
) -> None:
    """Named points that are seen elsewhere by themselves, or in the majority, moved."""
    network, truth = make_network(seed_of("named"), images=8, points=POINTS, free=("c",))
    source = np.isin(network.image_points.point, [7, 8]).astype(np.int64)
    seen = replace(network.image_points, source=source)
    network = replace(network, image_points=seen, sources=(TEXTURE, MARKS))
    names = [network.points[j] for j in group]
    moved = remark("points_moved", points=names, distance=0.1, shift=9.0, wrong=1.0, **{"from": "image 5"})
    monkeypatch.setattr(
        solved_survey, "judge_alternatives", lambda *_, **__: JudgedAssumptions(causes=(moved,))
    )
    found = solve_survey(survey_of(network, truth), Correspondences(network, truth, np.full(POINTS, 2)))
    assert [one.kind for one in found.remarks if one.kind in ("windows_elsewhere", "points_moved")] == [kind]


@pytest.mark.parametrize(("left", "stays"), [(9, False), (30, True)])
def test_a_photograph_needs_more_tie_points_than_it_would_need_targets(left: int, stays: bool) -> None:
    network, truth = make_network(seed_of("few tie points"), images=10, points=60, free=("c",))
    seen = network.image_points
    last = np.flatnonzero(seen.image == 9)
    keep = np.ones(len(seen), dtype=bool)
    keep[last[left:]] = False
    network = replace(network, image_points=seen.select(keep))
    survey = survey_of(network, truth)
    matched = Correspondences(network, truth, np.full(len(network.points), 3))
    of_targets = solve_survey(survey, matched)
    assert len(of_targets.adjustment.network.images) == 10
    found = solve_survey(survey, textured(network, truth))
    assert len(found.adjustment.network.images) == (10 if stays else 9)
    told = [("image 10", remark("photograph_with_few_fitting", needed=15))]
    assert list(found.dropped_images) == ([] if stays else told)


def test_points_that_leave_with_a_photograph_are_reported_so() -> None:
    """All their rays are accepted, and one is of a photograph that is not in the result."""
    network, truth = make_network(seed_of("leave with it"), images=10, points=60, free=("c",))
    seen = network.image_points
    few = seen.point < 9
    keep = np.where(seen.image == 9, few, ~few | (seen.image < 2))
    network = replace(network, image_points=seen.select(keep))
    found = solve_survey(survey_of(network, truth), textured(network, truth))
    reasons = {(one.reason.kind, one.reason.number("least")) for one in found.left_out}
    assert reasons == {("points_not_determined", 3)}


IMAGES, ZOOMED = 9, (3, 4, 7)


def zoomed(change: float) -> tuple[Network, Estimate]:
    """Return photographs of which some have another c, by so much, and start values."""
    rng = seed_of("zoomed")
    network, truth = make_network(rng, images=IMAGES, points=POINTS, planar=True, free=("c",))
    seen, camera = network.image_points, truth.cameras[0]
    other = camera.with_parameters(np.where(camera.parts[0], 1 + change, 1.0) * camera.parameters)
    xy = seen.xy.copy()
    for i in ZOOMED:
        rows = np.flatnonzero(seen.image == i)
        at = project(other, truth.position[i], truth.rotation[i], truth.points[seen.point[rows]])
        xy[rows] = at + 0.1 * rng.standard_normal(at.shape)
    kept = np.flatnonzero(((xy > 0) & (xy < camera.size_px)).all(axis=1))
    return replace(network, image_points=replace(seen, xy=xy).select(kept)), truth


def solved(change: float, *, textured: bool = True, **settings: object) -> tuple[SolvedSurvey, float]:
    """Return the solution, and the error of its projection centres over their extent."""
    network, truth = zoomed(change)
    camera = truth.cameras[0]
    setup = CameraSetup(
        name="zoom", images="*", size_px=camera.size_px, pixel_mm=tuple(camera.pixel_mm.tolist()),
        c_mm=camera.value("c"), **settings,
    )  # fmt: skip
    survey = Survey(name="s", cameras=(setup,))
    start = replace(truth, cameras=(replace(camera, name="zoom"),))
    network = replace(network, sources=(TEXTURE,)) if textured else network
    found = solve_survey(survey, Correspondences(network, start, np.full(POINTS, 3)))
    centres = found.adjustment.estimate.position
    away = fit_similarity(centres, truth.position).apply(centres) - truth.position
    return found, float(np.sqrt((away**2).sum() / ((truth.position - truth.position.mean(0)) ** 2).sum()))


def test_every_photograph_has_its_own_c_where_texture_shows_that_it_differs() -> None:
    found, error = solved(0.04)
    (one,) = of_kind(found.remarks, "c_per_photograph")
    assert one.names("camera") == ("zoom",) and one.severity == "warning"
    assert one.number("most") / one.number("least") == pytest.approx(1.04, abs=0.01)
    assert len(found.adjustment.estimate.cameras) > IMAGES - 1
    assert error < 0.005 and not of_kind(found.remarks, "other_camera", "camera_varies")


@pytest.mark.sweep(0, 1, 3)
@pytest.mark.parametrize(
    ("change", "textured", "settings"),
    [(0.0, True, {}), (0.04, False, {}), (0.04, True, {"free": ("c",)}), (0.04, True, {"free": ()})],
)
def test_c_is_one_where_it_is_or_where_the_survey_says_so(
    change: float, textured: bool, settings: dict[str, object]
) -> None:
    found, _ = solved(change, textured=textured, **settings)
    assert not of_kind(found.remarks, "c_per_photograph")


def test_a_difference_of_c_that_focusing_makes_is_reported_alone() -> None:
    found, _ = solved(0.015)
    assert of_kind(found.remarks, *OF_CAMERAS) and not of_kind(found.remarks, "c_per_photograph")


@pytest.mark.slow
def test_moving_water_is_left_out_of_a_shore(tmp_path: Path) -> None:
    rng = seed_of("water 0")
    scene = water(rng)
    write_scene(tmp_path, scene, rng)
    found = outcome_of(tmp_path, scene)
    assert found.oriented == len(scene.position) and found.level in ("good", "fair")
    assert found.over_sigma < WRONG and found.share < SHARE
    assert replace(found, over_sigma=2 * WRONG, share=2 * SHARE).is_wrong_and_believed


@pytest.mark.slow
@pytest.mark.parametrize("masked", [True, False])
def test_an_object_on_a_turntable_is_oriented_without_its_background(tmp_path: Path, masked: bool) -> None:
    rng = seed_of("turntable 0")
    scene = turntable(rng)
    write_scene(tmp_path, scene, rng)
    if masked:
        write_masks(tmp_path / "masks", scene)
        text = (tmp_path / "survey.toml").read_text(encoding="utf-8")
        masks = text.replace("[survey]\n", '[survey]\nmasks = "masks"\n')
        (tmp_path / "survey.toml").write_text(masks, encoding="utf-8")
    found = outcome_of(tmp_path, scene)
    assert found.oriented == 24 and found.over_sigma < WRONG
    assert ("still_features" in found.kinds) != masked


@pytest.mark.slow
def test_no_scene_is_wrong_and_believed() -> None:
    assert not [one for one in study(0, NUMBERS, list(KINDS)) if one[2].is_wrong_and_believed]
