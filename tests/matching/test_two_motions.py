"""Features that stand still while others move: left out where the camera stands still, else kept."""

from __future__ import annotations

import numpy as np
import pytest

from sfm.matching.tracks.feature_tracks import Tracks, link_features
from sfm.matching.tracks.features import Features
from sfm.model.conventions import FloatArray
from tests.synthetic import seed_of

C_PX, NOISE_PX = 800.0, 0.3
OBJECT, ROOM = 150, 250  # features


def turned(angle: float) -> FloatArray:
    """Return the rotation about the vertical."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])


def seen(
    rng: np.random.Generator, points: FloatArray, station: FloatArray, rotation: FloatArray
) -> FloatArray:
    """Return the noisy pictures of points by a camera that looks along its +z, px."""
    local = (points - station) @ rotation
    return np.asarray(C_PX * local[:, :2] / local[:, 2:] + 500 + rng.normal(0, NOISE_PX, (len(points), 2)))


def linked(views: list[FloatArray], rng: np.random.Generator) -> Tracks:
    """Return the tracks of photographs that all show the same features, at these places."""
    descriptor = rng.random((len(views[0]), 128)).astype(np.float32) ** 4
    descriptor /= np.linalg.norm(descriptor, axis=1, keepdims=True)
    k = len(descriptor)
    return link_features([Features(xy, np.full(k, 4.0), np.zeros(k), descriptor) for xy in views])


def points_of(rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Return points of an object 6 in front of the camera, and of a room behind it."""
    thing, room = rng.uniform(-1, 1, (OBJECT, 3)), rng.uniform([-4, -3, 3], [4, 3, 6], (ROOM, 3))
    return thing, room


AHEAD = np.array([0.0, -2.0, -6.0])
DOWN = np.array([[1.0, 0.0, 0.0], [0.0, 0.95, 0.3122], [0.0, -0.3122, 0.95]])


@pytest.mark.parametrize("step_deg", [5.0, 15.0])
def test_a_background_that_stands_still_is_left_out(step_deg: float) -> None:
    rng = seed_of("turntable features")
    thing, room = points_of(rng)
    views = [
        seen(rng, np.vstack([thing @ turned(np.radians(step_deg * i)), room]), AHEAD, DOWN) for i in range(9)
    ]
    tracks = linked(views, rng)
    assert (tracks.feature < OBJECT).all() and len(np.unique(tracks.feature)) > 0.95 * OBJECT
    assert np.all(np.abs(tracks.still - ROOM / (ROOM + OBJECT)) < 0.05)


def test_a_camera_that_moves_without_turning_keeps_its_distant_background() -> None:
    rng = seed_of("slider features")
    thing, room = points_of(rng)
    scene = np.vstack([thing, 5000 * (room + np.array([0.0, 0.0, 2.0]))])
    views = [seen(rng, scene, AHEAD + np.array([0.2 * i, 0.0, 0.0]), DOWN) for i in range(6)]
    tracks = linked(views, rng)
    assert not tracks.still.any() and len(np.unique(tracks.feature)) == len(scene)


def test_an_object_taken_several_times_from_a_tripod_is_kept_beside_a_crowd() -> None:
    rng = seed_of("tripod features")
    crowd, scene = points_of(rng)
    views = []
    for i in range(9):
        station = AHEAD + np.array([1.2 * (i // 3), 0.1 * (i // 3), 0.0])
        aside = turned(0.15 * (i // 3))
        views.append(seen(rng, np.vstack([crowd @ turned(0.3 * i), scene]), station, aside @ DOWN))
    tracks = linked(views, rng)
    assert not tracks.still.any()
    assert len(np.unique(tracks.feature[tracks.feature >= OBJECT])) > 0.95 * ROOM


@pytest.mark.parametrize("marks", [3, 40])
def test_writing_in_the_photographs_is_left_out(marks: int) -> None:
    """A few specks of dirt are wrong matches like others."""
    rng = seed_of("written features")
    _, room = points_of(rng)
    writing = rng.uniform([0, 900], [400, 1000], (marks, 2))
    views = [
        np.vstack(
            [seen(rng, room, AHEAD + np.array([0.6 * i, 0.2 * i, 0.0]), turned(0.1 * i) @ DOWN), writing]
        )
        for i in range(6)
    ]
    tracks = linked(views, rng)
    assert (tracks.feature < ROOM).all() and len(np.unique(tracks.feature)) == ROOM
    assert tracks.still == pytest.approx(0.0 if marks < 10 else marks / (marks + ROOM), abs=0.01)
