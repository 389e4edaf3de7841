"""Counts right, wrong and refused matches of conjugate points at growing angles between viewing directions.

    python -m benchmarks.wide_matching --points 60

A textured surface of three roughnesses is photographed from the left and, at growing angles, from the right,
then with rotation and other scales. Points at random positions are matched in three ways: without further
information (key points lead), without key points from a search window that is off by up to 20 px (rotated
templates), and from the same window with upright templates. A match is wrong if it is more than 1 px, and
more than 4 of its standard deviations, from the truth.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from unittest.mock import patch

import numpy as np

from benchmarks import textured_scenes
from benchmarks.textured_scenes import PIXEL_MM, RIPPLES, TexturedScene, intensities, surface_at
from datasets.textured import render
from sfm.matching import conjugate
from sfm.matching.conjugate import affinities_around, match_points
from sfm.matching.conjugate_patches import MatchSettings
from sfm.model.camera import camera_from_values, project
from sfm.model.conventions import AnyArray, FloatArray

SIZE_PX = (640, 480)
# Angle between the viewing directions, rotation about the right one, degrees, and ratio of the distances.
VIEWS = (
    *((10, 0, 1.0), (20, 0, 1.0), (30, 0, 1.0), (40, 0, 1.0), (50, 0, 1.0), (60, 0, 1.0)),
    *((10, 30, 1.0), (10, 15, 1.3), (10, 30, 1 / 1.3), (20, 90, 1.0)),
)
LEFT_DEG = 25.0  # from the vertical
METHODS = ("key points", "turned", "upright")
OFF_PX = 20.0  # largest error of the given search windows
WRONG_PX, WRONG_SIGMAS = 1.0, 4.0
BORDER_PX = 30


@dataclass(frozen=True)
class Counts:
    """Counts and errors of the matches of one pair of photographs."""

    points: int
    right: int
    wrong: int
    refused: int
    rms_px: float  # error of the right matches, per axis
    ratio: float  # ratio of these errors to their standard deviations
    seconds: float

    def __str__(self) -> str:
        counts = f"{self.right:6}{self.wrong:7}{self.refused:9}"
        return f"{counts}{self.rms_px:9.3f}{self.ratio:8.2f}{self.seconds:7.1f}"


def wide_scene(roughness: str, views: tuple[tuple[float, float, float], ...] = VIEWS) -> TexturedScene:
    """Return a scene with the left photograph first, then one photograph for each view."""
    position, rotation = [], []
    for angle, turn, distance in ((0.0, 0.0, 1.0), *views):
        tilt, roll = np.radians(LEFT_DEG - angle), np.radians(turn)
        outward = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
        x, y = np.array([np.cos(tilt), 0.0, -np.sin(tilt)]), np.array([0.0, 1.0, 0.0])
        right = np.cos(roll) * x + np.sin(roll) * y
        position.append(textured_scenes.DISTANCE_M * distance * outward)
        rotation.append(np.column_stack([right, np.cross(outward, right), outward]))
    values = (("k1", -0.05), ("k2", 0.02), ("cx", SIZE_PX[0] / 2 + 3), ("cy", SIZE_PX[1] / 2 - 2))
    camera = camera_from_values(
        "lens", "opencv", SIZE_PX, (PIXEL_MM, PIXEL_MM), c_mm=textured_scenes.C_MM, values=values
    )
    return TexturedScene(roughness, np.array(position), np.array(rotation), camera)


def photograph(scene: TexturedScene, index: int, skin: AnyArray) -> AnyArray:
    """Return one photograph with noise, uint8."""
    noise = np.random.default_rng((render.SEED, index)).normal(0, render.NOISE, SIZE_PX[::-1])
    return np.rint(np.clip(intensities(scene, index, skin) + noise, 0, 255)).astype(np.uint8)


def points_and_truth(scene: TexturedScene, index: int, count: int) -> tuple[FloatArray, FloatArray]:
    """Return random points of the left photograph and their positions in another, px, (k, 2) each."""
    xy = np.random.default_rng((render.SEED, 100, index)).uniform(BORDER_PX, np.array(SIZE_PX) - BORDER_PX,
                                                                 (4 * count, 2))  # fmt: skip
    surface = surface_at(scene, 0, xy)
    truth = project(scene.camera, scene.position[index], scene.rotation[index], surface)
    seen = ((truth > BORDER_PX) & (truth < np.array(SIZE_PX) - BORDER_PX)).all(axis=1)
    same = np.zeros(len(xy), dtype=bool)
    same[seen] = np.linalg.norm(surface_at(scene, index, truth[seen]) - surface[seen], axis=1) < 1e-3
    rows = np.flatnonzero(seen & same)[:count]  # without points hidden in the other photograph
    return xy[rows], truth[rows]


def count_matches(left: AnyArray, right: AnyArray, xy: FloatArray, truth: FloatArray, method: str) -> Counts:
    """Match points by one of METHODS and compare them with the truth."""
    begun = time.process_time()
    if method == "key points":
        matches = match_points(left, right, xy)
    else:
        off = np.random.default_rng(len(xy)).uniform(-OFF_PX, OFF_PX, xy.shape)
        nothing = affinities_around(xy[:0], xy[:0], xy)
        with patch.object(conjugate, "local_affinities", lambda _l, _r, at, **_: affinities_around(
            nothing.xy[:0], nothing.xy[:0], at
        )):  # fmt: skip
            matches = match_points(
                left, right, xy, xy_right=truth + off, settings=MatchSettings(wide=method == "turned")
            )
    seconds = time.process_time() - begun
    error = np.linalg.norm(matches.right - truth, axis=1)
    with np.errstate(invalid="ignore"):
        told = error < WRONG_SIGMAS * np.linalg.norm(matches.sigma, axis=1)
    right_ones = matches.good & ((error <= WRONG_PX) | told)
    e = (matches.right - truth)[right_ones]
    some = len(e) > 0
    return Counts(
        len(xy),
        int(right_ones.sum()),
        int((matches.good & ~right_ones).sum()),
        int((~matches.good).sum()),
        float(np.sqrt((e**2).mean())) if some else np.nan,
        float(np.sqrt((e**2 / matches.sigma[right_ones] ** 2).mean())) if some else np.nan,
        seconds,
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else "")
    parser.add_argument("--points", type=int, default=60)
    parser.add_argument("--roughness", nargs="+", default=list(RIPPLES), choices=list(RIPPLES))
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(METHODS))
    arguments = parser.parse_args()
    skin = render.texture()
    print("scene   angle  turn  distance  method       right  wrong  refused   rms px  /sigma  cpu s")
    for roughness in arguments.roughness:
        scene = wide_scene(roughness)
        left = photograph(scene, 0, skin)
        for index, (angle, turn, distance) in enumerate(VIEWS, 1):
            right = photograph(scene, index, skin)
            xy, truth = points_and_truth(scene, index, arguments.points)
            for method in arguments.methods:
                counts = count_matches(left, right, xy, truth, method)
                print(f"{roughness:<8}{angle:>4}{turn:>7}{distance:>10.2f}  {method:<11}{counts}", flush=True)


if __name__ == "__main__":
    main()
