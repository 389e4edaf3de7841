"""Texture whose photographs differ in c: each has another, where the survey leaves to them what is free."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.camera import project
from sfm.network import Estimate, Network
from sfm.remarks.remark import of_kind
from sfm.similarity import fit_similarity
from sfm.survey.adjusting.solution import OF_CAMERAS, SolvedSurvey, solve_survey
from sfm.survey.correspondences import Correspondences
from sfm.survey.inputs.settings import TiePointSettings
from sfm.survey.inputs.survey import CameraSetup, Survey
from tests.synthetic import make_network, seed_of

IMAGES, POINTS, ZOOMED = 9, 60, (3, 4, 7)


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
    survey = Survey(name="s", cameras=(setup,), tie_points=TiePointSettings() if textured else None)
    start = replace(truth, cameras=(replace(camera, name="zoom"),))
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
