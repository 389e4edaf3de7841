"""Orientation by hand, predicted places and the mark that fits least."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.model.camera import Camera, camera_from_values, project, tangents_from_pixel
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.distributions import chi2_isf
from sfm.model.estimate import Estimate
from sfm.model.network import Network, empty_estimate
from sfm.orientation.relative import five_point_orientations
from sfm.products.marking import adjusting
from sfm.products.marking.adjusting import CONTAINED, MarkAdjustment, adjust_marks
from sfm.products.marking.evidence import PictureEvidence, Pose
from sfm.products.marking.following import follow
from sfm.products.marking.guidance import Guide
from sfm.products.marking.orienting import HandOrientation, orient_by_hand
from sfm.products.marking.project import MarkedProject
from sfm.survey.inputs.given_values import KnownPoints
from sfm.survey.inputs.marks_file import Mark, Marking
from sfm.survey.inputs.measurements import PhotographList
from sfm.survey.inputs.survey import CameraSetup, Survey
from tests.products.marking.photographs import LENS, network_of_points, seen_points, stations

FALSE_ALARM = 0.05


class NoEvidence:
    """Photographs that show nothing but the marks."""

    def support(self, i: int, j: int, first: Pose, second: Pose) -> float:
        return 0.0

    def places(self, i: int, pose: Pose, points: FloatArray) -> float:
        return 0.0

    def matches(self, i: int, j: int) -> tuple[FloatArray, FloatArray]:
        return np.zeros((0, 2)), np.zeros((0, 2))

    def with_cameras(self, cameras: Sequence[Camera]) -> NoEvidence:
        return self


class SeenEvidence(NoEvidence):
    """Photographs that show more points than are marked, with noise."""

    def __init__(self, xy: FloatArray) -> None:
        self._uv = [tangents_from_pixel(LENS, places) for places in xy]

    def support(self, i: int, j: int, first: Pose, second: Pose) -> float:
        base = second[0] - first[0]
        b = base / max(float(np.linalg.norm(base)), 1e-12)
        skew = np.array([[0, -b[2], b[1]], [b[2], 0, -b[0]], [-b[1], b[0], 0]])
        E = second[1].T @ skew @ first[1]
        p, q = (np.column_stack([uv, -np.ones(len(uv))]) for uv in (self._uv[i], self._uv[j]))
        lines = p @ E.T
        off = np.abs((lines * q).sum(axis=1)) / np.hypot(lines[:, 0], lines[:, 1])
        return float((off <= 4 / LENS.c_px).sum())

    def places(self, i: int, pose: Pose, points: FloatArray) -> float:
        at = project(LENS, pose[0], pose[1], points[np.isfinite(points).all(axis=1)])
        seen = project(
            LENS, np.zeros(3), np.eye(3), np.column_stack([self._uv[i], -np.ones(len(self._uv[i]))])
        )
        near = np.linalg.norm(at[:, None] - seen, axis=2).min(axis=1) <= 5
        return float(near.sum())

    def matches(self, i: int, j: int) -> tuple[FloatArray, FloatArray]:
        return self._uv[i], self._uv[j]


def object_points(rng: np.random.Generator, count: int) -> FloatArray:
    return np.asarray(rng.uniform(-1, 1, (count, 3)) * [1.0, 1.0, 0.4])


def close(estimate: Estimate, i: int, place: FloatArray, rotation: FloatArray) -> bool:
    cosine = (np.trace(estimate.rotation[i].T @ rotation) - 1) / 2
    return bool(cosine > np.cos(np.radians(2)) and np.linalg.norm(estimate.position[i] - place) < 0.1)


def triple(rng: np.random.Generator, points: FloatArray) -> IntArray:
    """Return three of the first ten points that are not on a line."""
    while True:
        chosen = rng.choice(10, 3, replace=False)
        a, b, c = points[chosen]
        if np.linalg.norm(np.cross(b - a, c - a)) > 0.5:
            return np.asarray(chosen)


def test_three_marks_of_known_points_orient_a_photograph_50_of_50() -> None:
    rng, oriented = np.random.default_rng(1), 0
    for _ in range(50):
        points = object_points(rng, 30)
        places, rotations = stations(rng, 2, around=1.6)
        xy = seen_points(places, rotations, points) + rng.normal(0, 0.1, (2, 30, 2))
        marked = np.zeros((2, 30), dtype=bool)
        for i in range(2):
            marked[i, triple(rng, points)] = True
        network = network_of_points(xy, marked, 0.1).with_control(
            [f"p{j}" for j in range(10)], points[:10], 0.001
        )
        by_hand = orient_by_hand(network, empty_estimate(network, (LENS,)), SeenEvidence(xy))
        assert by_hand.frame == "control"
        oriented += all(close(by_hand.estimate, i, places[i], rotations[i]) for i in range(2))
    assert oriented == 50


class Pictures(PictureEvidence):
    """Photographs whose targets are known, and which show nothing that looks alike."""

    def __init__(self, xy: FloatArray) -> None:
        super().__init__(lambda i: np.zeros((0, 0)), [LENS] * len(xy))
        self._targets = lambda i: xy[i]
        self._alike = lambda i, j: (np.zeros((0, 2)), np.zeros((0, 2)))


def oriented_by_threes(rng: np.random.Generator, trials: int, c_sigma: float) -> tuple[int, int, int]:
    """Return how many photographs of a lens that is not calibrated are right, open, and wrong in silence."""
    right = left_open = silent = 0
    for _ in range(trials):
        c, K1 = 9.0 * (1 + c_sigma * rng.standard_normal()), 3e-4 * rng.uniform(-1, 1)
        lens = camera_from_values("lens", "brown", LENS.size_px, (0.004, 0.004), c_mm=c, values=(("K1", K1),))
        points = object_points(rng, 30)
        places, rotations = stations(rng, 2, around=1.6)
        xy = np.array([project(lens, X0, R, points) for X0, R in zip(places, rotations, strict=True)])
        marked = np.zeros((2, 30), dtype=bool)
        for i in range(2):
            marked[i, triple(rng, points)] = True
        network = network_of_points(xy + rng.normal(0, 0.1, xy.shape), marked, 0.1).with_control(
            [f"p{j}" for j in range(10)], points[:10], 0.001
        )
        by_hand = orient_by_hand(network, empty_estimate(network, (LENS,)), Pictures(xy))
        estimate = by_hand.estimate
        for i in range(2):
            turn = np.arccos(np.clip((np.trace(estimate.rotation[i].T @ rotations[i]) - 1) / 2, -1, 1))
            away = np.linalg.norm(estimate.position[i] - places[i]) / np.linalg.norm(places[i])
            ok = bool(turn < np.radians(8) and away < 0.15)
            right += ok
            left_open += i in by_hand.open and not ok
            silent += i not in by_hand.open and not ok
    return right, left_open, silent


@pytest.mark.parametrize("c_sigma", [0.03, 0.1])
def test_three_marks_orient_photographs_of_a_lens_that_is_not_calibrated(c_sigma: float) -> None:
    right, left_open, silent = oriented_by_threes(np.random.default_rng(21), 40, c_sigma)
    assert right >= 79 and silent <= 1 and right + left_open + silent == 80


def relative_pose(places: FloatArray, rotations: FloatArray) -> tuple[FloatArray, FloatArray]:
    base = rotations[0].T @ (places[1] - places[0])
    return base / np.linalg.norm(base), rotations[0].T @ rotations[1]


def test_five_common_points_orient_a_pair_50_of_50() -> None:
    rng, oriented = np.random.default_rng(2), 0
    for _ in range(50):
        points = object_points(rng, 40)
        places, rotations = stations(rng, 2, around=1.2)
        xy = seen_points(places, rotations, points) + rng.normal(0, 0.1, (2, 40, 2))
        network = network_of_points(xy[:, :5], np.ones((2, 5), dtype=bool), 0.1)
        by_hand = orient_by_hand(network, empty_estimate(network, (LENS,)), SeenEvidence(xy))
        estimate = by_hand.estimate
        assert estimate.oriented.all()
        base, rotation = relative_pose(estimate.position, estimate.rotation)
        true_base, true_rotation = relative_pose(places, rotations)
        cosine = (np.trace(rotation.T @ true_rotation) - 1) / 2
        oriented += bool(cosine > np.cos(np.radians(3)) and base @ true_base > np.cos(np.radians(5)))
    assert oriented == 50


def test_the_right_orientation_is_among_those_that_fit_five_points() -> None:
    rng = np.random.default_rng(3)
    for _ in range(50):
        points = object_points(rng, 5)
        places, rotations = stations(rng, 2, around=1.2)
        first, second = (tangents_from_pixel(LENS, xy) for xy in seen_points(places, rotations, points))
        _, rotation = relative_pose(places, rotations)
        found = five_point_orientations(first, second)
        assert found
        assert min(np.abs(pair.rotation - rotation).max() for pair in found) < 1e-5


def test_what_fits_several_orientations_says_so() -> None:
    rng = np.random.default_rng(5)
    several = 0
    for _ in range(20):
        points = object_points(rng, 3)
        places, rotations = stations(rng, 1)
        xy = seen_points(places, rotations, points)
        network = network_of_points(xy, np.ones((1, 3), dtype=bool), 0.1).with_control(
            [f"p{j}" for j in range(3)], points, 0.001
        )
        by_hand = orient_by_hand(network, empty_estimate(network, (LENS,)), NoEvidence())
        assert by_hand.estimate.oriented.all()
        assert by_hand.open or close(by_hand.estimate, 0, places[0], rotations[0])
        several += bool(by_hand.open)
    assert several


def test_a_photograph_on_a_pair_is_right_or_left_open() -> None:
    """Five common points of which two are known, and photographs that show nothing else."""
    rng, right, left_open = np.random.default_rng(11), 0, 0
    for _ in range(25):
        points = object_points(rng, 10)
        places, rotations = stations(rng, 3, around=1.6)
        xy = seen_points(places, rotations, points) + rng.normal(0, 0.1, (3, 10, 2))
        marked = np.zeros((3, 10), dtype=bool)
        marked[:2, :4] = True  # of known points
        marked[1:, [0, 1, 5, 6, 7]] = True  # common to the second photograph and the third
        network = network_of_points(xy, marked, 0.1).with_control(
            [f"p{j}" for j in range(4)], points[:4], 0.001
        )
        by_hand = orient_by_hand(network, empty_estimate(network, (LENS,)), NoEvidence())
        is_right = by_hand.estimate.oriented[2] and close(by_hand.estimate, 2, places[2], rotations[2])
        right += bool(is_right)
        left_open += 2 in by_hand.open
        assert is_right or 2 in by_hand.open
        assert not (2 in by_hand.open and by_hand.estimate.oriented[2])  # nothing is built on it
    assert left_open


class Misleading(SeenEvidence):
    """Photographs whose features seem to support the pose that is farthest from the right one."""

    def __init__(self, xy: FloatArray, places: FloatArray) -> None:
        super().__init__(xy)
        self._places = places

    def places(self, i: int, pose: Pose, points: FloatArray) -> float:
        return 100 * float(np.linalg.norm(pose[0] - self._places[i]))

    def support(self, i: int, j: int, first: Pose, second: Pose) -> float:
        return self.places(i, first, np.zeros((0, 3))) + self.places(j, second, np.zeros((0, 3)))


def test_a_wrong_orientation_is_left_when_further_marks_contradict_it(tmp_path: Path) -> None:
    """Three marks fit several orientations, and the features led to a wrong one."""
    rng, wrong = np.random.default_rng(12), 0
    for trial in range(12):
        points = object_points(rng, 8)
        places, rotations = stations(rng, 3, around=1.6)
        xy = seen_points(places, rotations, points) + rng.normal(0, 0.1, (3, 8, 2))
        project = project_of_lens(tmp_path / str(trial), points)
        evidence = Misleading(xy, places)
        marking = Marking("lens")
        for i, j in [(i, j) for i in (0, 1) for j in range(8)] + [(2, j) for j in range(3)]:
            marking = marking.with_mark(mark_at(i, j, xy))
        last = follow(project, marking, evidence)
        was_right = close(last.estimate, 2, places[2], rotations[2])
        wrong += not was_right
        for j in range(3, 6):
            marking = marking.with_mark(mark_at(2, j, xy))
            last = follow(project, marking, evidence, last)
        assert close(last.estimate, 2, places[2], rotations[2]), (trial, was_right)
        worst = None if last.adjustment is None else last.adjustment.worst
        assert worst is None or not worst.flagged
    assert wrong > 3


def mark_at(i: int, j: int, xy: FloatArray) -> Mark:
    return Mark(f"i{i}.png", f"p{j}", *map(float, xy[i, j]), 0.01, 0.0, 0.01, "target", when="t")  # type: ignore[misc]


def project_of_lens(folder: Path, points: FloatArray) -> MarkedProject:
    """Return a project of three photographs by the lens, all points of which are control."""
    folder.mkdir()
    camera = CameraSetup(
        name="lens",
        images="i*.png",
        size_px=LENS.size_px,
        pixel_mm=(0.004, 0.004),
        c_mm=LENS.value("c"),
        model="brown",
        free=("c",),
    )
    control = KnownPoints.from_arrays([f"p{j}" for j in range(8)], points, np.full((8, 3), 0.001))
    survey = Survey(name="lens", cameras=(camera,), control=control, folder=folder)
    files = tuple(folder / f"i{i}.png" for i in range(3))
    photographs = PhotographList(
        tuple(path.name for path in files), files, np.zeros(3, dtype=np.int64), folder
    )
    return MarkedProject(survey, photographs, (LENS.size_px,) * 3, (LENS,))


def adjusted(network: Network, start: Estimate, *, in_control: bool) -> MarkAdjustment:
    marks = adjust_marks(network, start, (LENS,), in_control=in_control, false_alarm=FALSE_ALARM)
    assert marks is not None
    return marks


def coverage(rng: np.random.Generator, trials: int) -> tuple[float, float, int]:
    """Return the parts of ellipses that contain the place, adjusted and new points, and their count."""
    inside = {True: [0, 0], False: [0, 0]}
    for _ in range(trials):
        points, new = object_points(rng, 13), 12
        places, rotations = stations(rng, 6)
        truth = seen_points(places, rotations, points)
        xy = truth + rng.normal(0, 0.3, truth.shape)
        marked = np.isfinite(truth).all(axis=2) & (rng.random(truth.shape[:2]) < 0.7)
        marked[:, new] = np.arange(6) < 2
        network = network_of_points(xy, marked, 0.3).with_control(
            ["p0", "p1", "p2", "p3"], points[:4], 0.0005
        )
        known = np.where(np.arange(13)[:, None] < new, points, np.nan)
        marks = adjusted(network, Estimate((LENS,), places, rotations, known), in_control=True)
        guide = Guide(network, marks.estimate, marks)
        found = marks.estimate.points.copy()
        found[new] = guide.with_rays(new)
        guide = Guide(network, Estimate(marks.estimate.cameras, *_poses(marks.estimate), found), marks)
        for j in range(13):
            for place in guide.predict(j):
                off = place.xy - truth[place.image, j]
                if np.isfinite(off).all():
                    square = off @ np.linalg.solve(place.covariance, off)
                    inside[j < new][0] += bool(square <= chi2_isf(CONTAINED, 2))
                    inside[j < new][1] += 1
    return inside[True][0] / inside[True][1], inside[False][0] / inside[False][1], inside[True][1]


def _poses(estimate: Estimate) -> tuple[FloatArray, FloatArray]:
    return estimate.position, estimate.rotation


def test_predicted_ellipses_contain_the_place() -> None:
    of_adjusted, of_new, count = coverage(np.random.default_rng(1), 40)
    assert count > 500
    assert 0.92 < of_adjusted < 0.98
    assert 0.88 < of_new < 0.99


@pytest.mark.slow
def test_predicted_ellipses_contain_the_place_in_93_to_97_of_100() -> None:
    of_adjusted, of_new, _ = coverage(np.random.default_rng(2), 400)
    assert 0.93 <= of_adjusted <= 0.97
    assert 0.93 <= of_new <= 0.97


def spoiled(rng: np.random.Generator, *, neighbour: bool, control: bool) -> tuple[bool, HandOrientation]:
    """Return whether a wrong mark among 12 points in three photographs is named."""
    points = object_points(rng, 12)
    places, rotations = stations(rng, 3, around=1.8)
    truth = seen_points(places, rotations, points)
    xy = truth + rng.normal(0, 0.1, truth.shape)
    i, j = int(rng.integers(3)), int(rng.integers(12))
    if neighbour:
        nearest = int(np.argsort(np.linalg.norm(truth[i] - truth[i, j], axis=1))[1])
        xy[i, j] = truth[i, nearest] + rng.normal(0, 0.1, 2)
    else:
        turn = rng.uniform(0, 2 * np.pi)
        xy[i, j] += 10 * np.array([np.cos(turn), np.sin(turn)])
    network = network_of_points(xy, np.isfinite(xy).all(axis=2), 0.1)
    if control:
        network = network.with_control(["p0", "p1", "p2", "p3"], points[:4], 0.001)
    by_hand = orient_by_hand(network, empty_estimate(network, (LENS,)), NoEvidence())
    marks = adjust_marks(
        network, by_hand.estimate, (LENS,), in_control=by_hand.frame == "control", false_alarm=FALSE_ALARM
    )
    worst = None if marks is None else marks.worst
    named = worst is not None and worst.flagged
    return bool(named and (worst.photograph, worst.point) == (f"i{i}.png", f"p{j}")), by_hand


@pytest.mark.parametrize("control", [False, True])
def test_a_wrong_mark_among_12_is_named(control: bool) -> None:
    rng = np.random.default_rng(7)
    assert sum(spoiled(rng, neighbour=k % 2 == 0, control=control)[0] for k in range(20)) >= 19


@pytest.mark.slow
@pytest.mark.parametrize("control", [False, True])
def test_a_wrong_mark_among_12_is_named_in_95_of_100(control: bool) -> None:
    rng = np.random.default_rng(8)
    assert sum(spoiled(rng, neighbour=k % 2 == 0, control=control)[0] for k in range(200)) >= 190


def test_right_marks_are_seldom_called_wrong() -> None:
    rng, called = np.random.default_rng(8), 0
    for _ in range(40):
        points = object_points(rng, 12)
        places, rotations = stations(rng, 3, around=1.8)
        truth = seen_points(places, rotations, points)
        network = network_of_points(
            truth + rng.normal(0, 0.1, truth.shape), np.ones((3, 12), dtype=bool), 0.1
        )
        by_hand = orient_by_hand(network, empty_estimate(network, (LENS,)), NoEvidence())
        worst = adjusted(network, by_hand.estimate, in_control=False).worst
        called += worst is not None and worst.flagged
    assert called <= 6  # of 40, at a false alarm of 0.05


@pytest.mark.parametrize(("off_px", "flagged"), [(0.05, False), (5.0, True)])
def test_a_mark_within_its_stated_precision_contradicts_nothing(off_px: float, flagged: bool) -> None:
    """All others fit a hundred times better than stated, as those of rendered targets do."""
    rng = np.random.default_rng(9)
    points = object_points(rng, 12)
    places, rotations = stations(rng, 4, around=1.8)
    xy = seen_points(places, rotations, points) + rng.normal(0, 0.001, (4, 12, 2))
    xy[1, 5] += off_px
    network = network_of_points(xy, np.ones((4, 12), dtype=bool), 0.1)
    by_hand = orient_by_hand(network, empty_estimate(network, (LENS,)), NoEvidence())
    worst = adjusted(network, by_hand.estimate, in_control=False).worst
    assert worst is not None and worst.flagged == flagged
    assert (worst.photograph, worst.point) == (network.images[1], network.points[5])


def test_an_adjustment_that_did_not_converge_contradicts_no_mark(monkeypatch: pytest.MonkeyPatch) -> None:
    """As with marks nearly on a line: the steps end in a valley, far from the optimum."""

    def not_converging(network: Network, estimate: Estimate, **options: Any) -> Adjustment:
        return replace(adjust(network, estimate, **options), converged=False)

    monkeypatch.setattr(adjusting, "adjust", not_converging)
    points = object_points(np.random.default_rng(9), 12)
    xy = seen_points(*stations(np.random.default_rng(9), 4, around=1.8), points)
    xy[1, 5] += 5.0
    network = network_of_points(xy, np.ones((4, 12), dtype=bool), 0.1)
    by_hand = orient_by_hand(network, empty_estimate(network, (LENS,)), NoEvidence())
    worst = adjusted(network, by_hand.estimate, in_control=False).worst
    assert worst is not None and not worst.flagged


def test_nothing_is_adjusted_before_anything_is_oriented() -> None:
    network = network_of_points(np.zeros((2, 4, 2)), np.ones((2, 4), dtype=bool), 0.1)
    empty = empty_estimate(network, (LENS,))
    assert not orient_by_hand(network, empty, NoEvidence()).estimate.oriented.any()
    assert adjust_marks(network, empty, (LENS,), in_control=False, false_alarm=FALSE_ALARM) is None
