"""Weak networks from scratch: none is wrong by more than 5 sigma and called good or fair."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.quality.other_solutions import other_solutions
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.model.camera import camera_from_values, project
from sfm.model.conventions import BoolArray
from sfm.model.remarks.remark import remark
from sfm.pipeline import run_survey
from sfm.survey.adjusting import solved_survey
from sfm.survey.adjusting.settling import StableAdjustment
from sfm.survey.adjusting.solution_remarks import remarks_on_held_c
from sfm.survey.inputs.survey import CameraSetup
from tests.findings import findings_of
from tests.survey.weak_networks import outcome_of, study, weak_network
from tests.synthetic import make_network, seed_of


def test_a_second_solution_of_equal_cost_makes_the_survey_bad() -> None:
    """Three photographs of a plane, c 17.1 mm: 27.8 mm, 8 sigma wrong and called fair without the search."""
    found = outcome_of(72)
    assert found.level == "bad"
    assert "other_solution" in found.kinds


def test_two_photographs_of_a_plane_are_bad() -> None:
    """12 sigma wrong and called fair: two orientations fit alike."""
    found = outcome_of(59)
    assert found.level == "bad" and "plane_ambiguous" in found.kinds


def test_a_pair_has_both_solutions_of_a_plane() -> None:
    """Seen from 59 degrees and not from 29, with v'Pv 17 for 22: 11 sigma wrong and called fair."""
    found = outcome_of(1277)
    assert found.over_sigma > 5 and found.level == "bad"
    assert sum(kind.startswith("other_solution") for kind in found.kinds) == 1


def test_a_pair_from_a_grazing_angle_is_no_other_solution() -> None:
    """A plane from 6 degrees, whose other solution of 86 degrees has a v'Pv of 9 for 22: 26 sigma wrong."""
    found = outcome_of(913)
    assert found.over_sigma < 2 and found.kinds[0] == "interior_held_of_pair"
    assert not any(kind.startswith("other_solution") for kind in found.kinds)


def test_c_that_starts_too_short_is_neither_held_nor_kept() -> None:
    """A plane, c 49 % too short, where other values have 0.0004 times its v'Pv."""
    found = outcome_of(0)
    assert found.over_sigma < 2 and found.c == pytest.approx(1, abs=0.01)
    assert found.level == "fair" and "held_to_converge" not in found.kinds


def test_an_observed_c_beside_too_few_image_points_is_bad_and_no_failure() -> None:
    """17 image points of 8 points leave no redundancy: nothing scales their weights against those of c."""
    weak = weak_network(10)
    (one,), c = weak.survey.cameras, weak.truth.cameras[0].value("c")
    camera = CameraSetup(
        name=one.name, size_px=one.size_px, pixel_mm=one.pixel_mm, weighted={"c": (c, 0.1 * c)}
    )
    result = run_survey(replace(weak.survey, cameras=(camera,)))
    assert result.adjustment.redundancy == 0 and findings_of(result).verdict.level == "bad"


@pytest.mark.slow
@pytest.mark.parametrize("number", [77, 142])
def test_c_of_three_photographs_that_is_wrong_by_far_is_not_believed(number: int) -> None:
    """Held at its start value, nothing stated, the object was 6 and 11 sigma wrong, and good."""
    found = outcome_of(number, c_sigma=0.4)
    assert not found.is_wrong_and_believed
    assert "parameters_chosen" in found.kinds


@pytest.mark.parametrize(
    "number",
    [
        # two nearer solutions stood before the one that is 6 sigma away: 6.9 sigma, fair
        1308,
        # four photographs from within 9 degrees, c a quarter of the truth: 28 sigma wrong, fair
        pytest.param(667, marks=pytest.mark.slow),
        # the solution that was left for one of 0.987 times its v'Pv is the true one: 7.9 sigma, fair
        pytest.param(1251, marks=pytest.mark.slow),
    ],
)
def test_other_principal_distances_are_found_along_bent_valleys(number: int) -> None:
    found = outcome_of(number)
    assert found.level == "bad" and found.kinds[0] == "other_solution"


@pytest.mark.sweep(2)
@pytest.mark.parametrize(
    "number",
    [
        87,  # c 163 % too long and held there, with solutions of 0.02 times its v'Pv: bad
        # undamped steps: the last round of data snooping went to and fro across a valley, 1.6 sigma wrong
        1252,
        # c 60 % too short, 17 sigma wrong: no valley leads to the true one, but orientation from another c
        1344,
        # c 30 % too short and held: 7.2 sigma wrong, fair; damped steps crept along the valley
        pytest.param(378, marks=pytest.mark.slow),
        # c 88 % too long and held: 5.7 sigma wrong, fair
        pytest.param(309, marks=pytest.mark.slow),
        # c 23 % too short and held: 5.4 sigma wrong, fair, with sigma0 1.9 times
        pytest.param(141, marks=pytest.mark.slow),
    ],
)
def test_valleys_are_followed_to_their_lowest_point(number: int) -> None:
    found = outcome_of(number)
    assert found.over_sigma < 2 and "c_held_contradicted" not in found.kinds
    assert found.level == ("bad" if number == 309 else "fair")  # its c is known to 40 % only


def test_a_valley_whose_floor_cannot_be_solved_ends_the_step() -> None:
    """The same place along it was tried again for ever."""
    assert outcome_of(918).over_sigma < 2


def test_another_start_is_without_the_points_that_the_final_adjustment_lost(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A point is lost after the network has settled, and then another solution is better."""
    calls = []

    def lost_points(settled: StableAdjustment, _: Adjustment) -> BoolArray:
        lost = np.zeros(len(settled.points), dtype=bool)
        lost[np.flatnonzero(settled.points)[:1]] = not calls
        calls.append(settled.points.sum())
        return lost

    monkeypatch.setattr(solved_survey, "_lost_points", lost_points)
    found = outcome_of(95559)
    assert {"better_solution_taken", "points_not_determined"} <= set(found.kinds) and found.over_sigma < 2
    assert len(calls) > 2 and calls[1] == calls[0] - 1


def test_residuals_with_a_cause_contradict_a_camera_that_had_to_be_held() -> None:
    cause = remark("held_parameter", parameters="K1", camera="A", photographs=(), shift=8.0, rms=2.0)
    (found,) = remarks_on_held_c(("A",), (cause,))
    assert found.kind == "c_held_contradicted" and found.names("cameras") == ("A",)
    assert remarks_on_held_c((), (cause,)) == remarks_on_held_c(("A",), ()) == ()


def test_a_pair_does_not_determine_the_c_that_was_found_for_it() -> None:
    """c 40 % too long, found because the pair could be oriented with it: 18 sigma wrong and called fair."""
    found = outcome_of(1321)
    assert found.level == "bad" and found.kinds[0] == "c_looks_wrong"


def test_two_photographs_that_the_third_contradicts_are_bad() -> None:
    """c given 4.9 times too long: 12 sigma wrong and called fair, since nothing could check c."""
    found = outcome_of(99)
    assert found.over_sigma > 5 and found.level == "bad"
    assert found.kinds[0] == "pair_contradicted"


def test_a_narrow_relief_can_be_turned_inside_out() -> None:
    """Three photographs with a long lens from within 4 degrees: the reflected object fits as well."""
    network, truth = make_network(seed_of("narrow"), images=3, points=20, planar=True, free=())
    rng = seed_of("narrow noise")
    camera = camera_from_values("A", "brown", (2000, 1500), (0.005, 0.005), c_mm=1000.0)
    xyz = truth.points + np.array([0.0, 0.0, 0.1]) * rng.standard_normal((20, 1))
    position = np.array([[25.0, 0.0, 500.0], [-25.0, 8.0, 500.0], [0.0, -25.0, 500.0]])
    rotation = np.stack([_towards(place) for place in position])
    seen = network.image_points
    rows = zip(seen.image, seen.point, strict=True)
    xy = np.concatenate([project(camera, position[i], rotation[i], xyz[[j]]) for i, j in rows])
    noisy = replace(network, image_points=replace(seen, xy=xy + 0.3 * rng.standard_normal(xy.shape)))
    estimate = replace(truth, cameras=(camera,), position=position, rotation=rotation, points=xyz)
    a = adjust(
        noisy,
        estimate,
        datum=Datum("free"),
        reject="none",
        options=AdjustmentOptions(sigma_px=0.3, max_iterations=500),
    )
    (other,) = other_solutions(a)
    assert other.reflected and other.moved > 3


def _towards(place: np.ndarray) -> np.ndarray:
    """R of a photograph at a place, looking at the origin."""
    z = place / np.linalg.norm(place)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def test_a_strong_network_has_one_solution() -> None:
    network, truth = make_network(seed_of("strong"), images=4, points=30, free=("c",))
    assert other_solutions(adjust(network, truth, datum=Datum("free"))) == ()


@pytest.mark.slow
def test_no_weak_network_is_wrong_and_believed() -> None:
    found = study(range(1500))
    assert not [one.number for one in found if one.is_wrong_and_believed]


def test_a_flat_object_seen_by_a_telephoto_lens_starts_from_its_planes_too() -> None:
    """Coplanarity ended in another minimum, of 1.7 times the residuals: 36 sigma wrong, fair."""
    found = outcome_of(791)
    assert found.over_sigma < 2 and found.kinds[0] == "interior_held_of_pair"
    assert "better_solution_taken" in found.kinds
