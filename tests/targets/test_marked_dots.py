"""Dots with glare on each of them, and dots out of focus: the sigma is true, and they are found."""

from __future__ import annotations

import numpy as np
import pytest

from sfm.model.camera import camera_from_values
from sfm.model.conventions import AnyArray, FloatArray, rotation_from_angles
from sfm.products.rendering.render import render_photograph
from sfm.products.rendering.scene import CircularTargets, Faces, Optics, Scene, discs, join_marks
from sfm.targets.detect import Targets, find_targets

DOT, PAPER, GLARE = 0.8, 0.1, 1.0
DISTANCE = 3000.0  # for a c of as many pixels: one object unit is one pixel


def photograph(
    radius_px: float, *, columns: int, rows: int, seed: int, blur_px: float = 0.7,
    glare: tuple[float, float] | None = None,
) -> tuple[AnyArray, FloatArray]:  # fmt: skip
    """Return a photograph of bright dots, and their centres, px, (k, 2).

    Glare is a spot of a size on every dot, at a distance from the middle in a random direction, in radii.
    """
    rng = np.random.default_rng(seed)
    pitch = 2 * radius_px + 14 + 6 * blur_px
    across, down = np.meshgrid(np.arange(columns), np.arange(rows))
    places = pitch * np.column_stack([across.ravel(), down.ravel()])
    places += rng.uniform(-0.5, 0.5, places.shape) - places.mean(axis=0)
    marks = [discs(0, places, radius_px, DOT)]
    if glare is not None:
        size, away = glare
        turn = rng.uniform(0, 2 * np.pi, len(places))
        spots = places + away * radius_px * np.column_stack([np.cos(turn), np.sin(turn)])
        marks.append(discs(0, spots, size * radius_px, GLARE))
    sheet = Faces(
        np.zeros((1, 3)), np.array([[[1.0, 0, 0], [0, 1, 0]]]), np.full((1, 2), 1e4), np.array([PAPER]),
        np.zeros(1), np.ones(1),
    )  # fmt: skip
    targets = CircularTargets(
        np.zeros(len(places), int), places, np.full(len(places), radius_px), np.full(len(places), -1)
    )
    size_px = (int(columns * pitch + 30), int(rows * pitch + 30))
    camera = camera_from_values("test", "brown", size_px, (0.01, 0.01), c_mm=0.01 * DISTANCE)
    R = rotation_from_angles(0.0, 0.0, 0.0)
    picture, truth = render_photograph(
        Scene(sheet, join_marks(marks), targets, background=PAPER), camera, np.array([0.0, 0.0, DISTANCE]), R,
        optics=Optics(noise=0.01, blur_px=blur_px, oversampling=3), rng=rng,
    )  # fmt: skip
    return picture, truth.outline_centre


def over_stated(found: Targets, centre: FloatArray) -> tuple[float, float]:
    """Return the share of dots that are found, and the RMS of their errors in stated sigmas."""
    errors = []
    for xy in centre:
        distance = np.hypot(*(found.xy - xy).T)
        if len(distance) and distance.min() < 2:
            k = int(distance.argmin())
            errors.append(np.linalg.solve(np.linalg.cholesky(found.covariance[k]), found.xy[k] - xy))
    return len(errors) / len(centre), float(np.sqrt(np.mean(np.square(errors)))) if errors else np.inf


@pytest.mark.parametrize(
    ("radius_px", "glare", "most"),
    [
        (15.0, (0.2, 0.3), 1.3),  # 4.1 before
        (15.0, (0.2, 0.6), 1.3),  # 8.4
        (8.0, (0.35, 0.55), 1.4),  # 3.9
        (15.0, (0.35, 0.55), 2.0),  # 11.9: it reaches the edge
        (25.0, (0.35, 0.3), 1.3),  # 16.4
    ],
)
def test_glare_on_every_dot_does_not_deceive_the_sigma(
    radius_px: float, glare: tuple[float, float], most: float
) -> None:
    picture, centre = photograph(radius_px, columns=6, rows=5, seed=7, glare=glare)
    share, over = over_stated(find_targets(picture), centre)
    assert share > 0.9
    assert over < most


def test_glare_on_few_dots_does_not_deceive_the_sigma() -> None:
    """On four dots, which show nothing of what is usual, the ratio was 15."""
    parts = [photograph(25.0, columns=2, rows=2, seed=seed, glare=(0.35, 0.3)) for seed in range(4)]
    results = [over_stated(find_targets(picture), centre) for picture, centre in parts]
    assert min(share for share, _ in results) > 0.7
    assert np.sqrt(np.mean([over**2 for _, over in results])) < 1.5


@pytest.mark.parametrize(("radius_px", "blur_px"), [(10.0, 4.0), (6.0, 2.5), (15.0, 5.5)])
def test_dots_out_of_focus_are_found_with_a_true_sigma(radius_px: float, blur_px: float) -> None:
    """None of them before: an edge softer than 0.35 of the radius was refused."""
    picture, centre = photograph(radius_px, columns=6, rows=5, seed=8, blur_px=blur_px)
    share, over = over_stated(find_targets(picture), centre)
    assert share > 0.85
    assert over < 1.25
