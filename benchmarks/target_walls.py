"""Surveys of targets on walls that grow with the photographs: how the time of each stage grows.

    python -m benchmarks.target_walls --photographs 60 250 1000

A folded wall has two targets for each photograph, half of them coded and half plain dots, whose homologous
image points are found by the orientation. Photographs (640 x 480 px, rendered) look at the nodes of a grid
from both sides and from above and below, every other one turned, so that a target has about ten rays. They
are kept in --work.

Printed are oriented photographs, points and rays; the RMS error of the projection centres after a similarity
onto the truth, its prediction in the same datum, and their ratio; the joint squared Mahalanobis distance of
centres and rotations per degree of freedom; the processor time, that of each stage, and the peak memory. With
several numbers of photographs, the exponents of growth are printed too.
"""

from __future__ import annotations

import argparse
import resource
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from benchmarks.textured import covariance_on_centres, errors_before, joint_distance
from sfm.model.camera import Camera, camera_from_values
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.similarity import fit_similarity
from sfm.pipeline import run_survey
from sfm.products.planning.stations import aim_camera
from sfm.products.rendering.render import render_photographs
from sfm.products.rendering.scene import (
    CircularTargets,
    Faces,
    Optics,
    Scene,
    coded_ring,
    discs,
    join_marks,
)
from sfm.survey.inputs.survey import read_survey
from sfm.targets.codes.plates import code_family
from sfm.targets.codes.rings import CodeFamily

SIZE_PX, PIXEL_MM, C_MM = (640, 480), 0.0096, 8.2
CODES = "ring20"
DISTANCE, TILT_DEG = 1000.0, 22.0  # of the photographs from the wall, mm, and from its normal
NODES = (210.0, 167.0)  # between what photographs look at, mm
RUN, RISE = 420.0, 110.0  # of a fold, mm
SPACING, RADIUS = 130.0, 8.0  # of the targets, mm
FREE = 40.0  # from the edge of a fold, mm
SEEN = 900.0  # from what it looks at, a photograph shows no target, mm
SEED = 5
SURVEY = f"""[survey]
name = "wall"
unit = "mm"
[[camera]]
name = "small"
images = "*.png"
pixel_mm = [{PIXEL_MM}, {PIXEL_MM}]
c_mm = {C_MM}
[targets]
polarity = "dark"
codes = "{CODES}"
[compare]
backend = "none"
"""
HEAD = (
    "photographs  oriented  points    rays   centres mm  predicted mm  ratio  Mahalanobis/dof"
    "   cpu s  s/photograph  memory GB"
)


@dataclass(frozen=True)
class Wall:
    """A wall, its targets, and the stations of the photographs."""

    faces: Faces
    face: IntArray  # of each target, (n,)
    centre: FloatArray  # of each target on its face, mm, (n, 2)
    code: IntArray  # of each target, -1 of a plain dot, (n,)
    camera: Camera
    aim: FloatArray  # what photographs look at, mm, (m, 3)
    position: FloatArray  # mm, (m, 3)
    rotation: FloatArray  # (m, 3, 3)


def wall_of(photographs: int) -> Wall:
    """Return the wall for a number of photographs."""
    rng = np.random.default_rng([SEED, photographs])
    rows = max(round(float(np.sqrt(photographs / 1.6))), 1)
    row, column = np.divmod(np.arange(photographs), -(-photographs // rows))
    width, height = NODES[0] * (column.max() + 3), NODES[1] * (row.max() + 3)
    folds = int(np.ceil(width / RUN))
    up = np.where(np.arange(folds) % 2 == 0, RISE, -RISE)
    along = np.column_stack([np.full(folds, RUN), np.zeros(folds), up])
    length = np.linalg.norm(along, axis=1)
    axes = np.stack([along / length[:, None], np.tile([0.0, 1.0, 0.0], (folds, 1))], axis=1)
    middle = np.column_stack(
        [RUN * (np.arange(folds) + 0.5), np.full(folds, height / 2), np.full(folds, RISE / 2)]
    )
    half = np.column_stack([length / 2, np.full(folds, height / 2)])
    faces = Faces(middle, axes, half, np.full(folds, 0.8), np.zeros(folds), np.full(folds, 5.0))
    places = [
        (f, x, y)
        for f in range(folds)
        for x in np.arange(-length[f] / 2 + FREE, length[f] / 2 - FREE + 1, SPACING)
        for y in np.arange(-height / 2 + FREE, height / 2 - FREE + 1, SPACING)
    ]
    face = np.array([place[0] for place in places])
    centre = np.array([place[1:] for place in places]) + rng.uniform(-12, 12, (len(places), 2))
    family = code_family(CODES)
    assert isinstance(family, CodeFamily)
    numbers = rng.choice(family.number, len(places), replace=False)
    code = np.where(np.arange(len(places)) % 2 == 0, numbers, -1)
    aim = np.column_stack([NODES[0] * (column + 1.5), NODES[1] * (row + 1.5), np.zeros(photographs)])
    aim[:, :2] += rng.uniform(-20, 20, (photographs, 2))
    azimuth, tilt = np.pi / 2 * ((column + 2 * row) % 4) + np.pi / 4, np.radians(TILT_DEG)
    level = np.column_stack([np.cos(azimuth), np.sin(azimuth)]) * np.sin(tilt)
    outward = np.column_stack([level, np.full(photographs, np.cos(tilt))])
    position = aim + (DISTANCE + rng.uniform(-60, 60, (photographs, 1))) * outward
    rotation = [
        aim_camera(aim[i] - position[i], np.pi / 2 * (i // 2 % 2) + rng.uniform(-0.1, 0.1))
        for i in range(photographs)
    ]
    camera = camera_from_values(
        "small", "brown", SIZE_PX, (PIXEL_MM, PIXEL_MM), c_mm=C_MM * 1.01, values=(("K1", -6e-4),)
    )
    return Wall(faces, face, centre, code, camera, aim, position, np.array(rotation))


def write_survey(folder: Path, wall: Wall) -> None:
    """Write the photographs of a wall and its survey file; each shows the targets that are near."""
    folder.mkdir(parents=True, exist_ok=True)
    family = code_family(CODES)
    assert isinstance(family, CodeFamily)
    X, rng = wall.faces.place(wall.face, wall.centre), np.random.default_rng(SEED)
    turn = rng.uniform(0, 2 * np.pi, len(X))
    optics = Optics(blur_px=0.7, noise=0.004, shot_noise=0.004)
    for i in range(len(wall.position)):
        near = np.flatnonzero(np.linalg.norm(X - wall.aim[i], axis=1) < SEEN)
        marks = join_marks(
            [
                coded_ring(
                    int(wall.face[j]), wall.centre[j], RADIUS, int(wall.code[j]), family, 0.06, turn=turn[j]
                )
                if wall.code[j] >= 0
                else discs(int(wall.face[j]), wall.centre[j][None], RADIUS, 0.06)
                for j in near.tolist()
            ]
        )
        shown = CircularTargets(
            wall.face[near], wall.centre[near], np.full(len(near), RADIUS), wall.code[near]
        )
        station = slice(i, i + 1)
        (picture,), _ = render_photographs(
            Scene(wall.faces, marks, shown),
            wall.camera,
            wall.position[station],
            wall.rotation[station],
            optics=optics,
            seed=i,
            threads=1,
        )
        cv2.imwrite(str(folder / f"{i:05d}.png"), picture)
    (folder / "survey.toml").write_text(SURVEY, "utf-8")


def run_wall(folder: Path, wall: Wall, jobs: int) -> dict[str, float]:
    """Run the survey of a wall, print its errors, and return the times of its stages, s."""
    begun = time.process_time()
    result = run_survey(read_survey(folder / "survey.toml"), jobs=jobs)
    seconds = time.process_time() - begun
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    a = result.adjustment
    on = np.flatnonzero(a.estimate.oriented)
    of_truth = [int(Path(a.network.images[i]).stem) for i in on]
    moved = fit_similarity(a.estimate.position[on], wall.position[of_truth])
    placed = moved.apply_estimate(a.estimate)
    centres, true_rotation = placed.position[on] - wall.position[of_truth], wall.rotation[of_truth]
    covariance = covariance_on_centres(a)
    predicted = moved.scale * rms_of(np.sqrt(np.diagonal(covariance)).reshape(-1, 6)[:, :3])
    errors = errors_before(moved, centres, true_rotation, placed.rotation[on])
    print(
        f"{len(wall.position):>11}{len(on):>10}{len(a.network.points):>8}{len(a.network.image_points):>8}"
        f"{rms_of(centres):>12.4f}{predicted:>14.4f}{rms_of(centres) / predicted:>7.2f}"
        f"{joint_distance(errors, covariance):>17.2f}{seconds:>8.1f}{seconds / len(wall.position):>14.3f}"
        f"{peak:>11.2f}",
        flush=True,
    )
    stages = {stage.stage: stage.seconds for stage in result.seconds}
    print("   ", ", ".join(f"{name} {took:.1f} s" for name, took in stages.items()), flush=True)
    print("   ", ", ".join(remark.kind for remark in result.remarks), flush=True)
    return stages | {"together": seconds}


def rms_of(vectors: FloatArray) -> float:
    """Return the root mean square length of vectors, (m, 3)."""
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else "")
    parser.add_argument("--photographs", type=int, nargs="+", default=[60, 250])
    parser.add_argument("--jobs", type=int, default=1, help="photographs processed at a time")
    parser.add_argument("--work", type=Path, default=Path("build/target_walls"))
    arguments = parser.parse_args()
    print(HEAD)
    times = []
    for photographs in arguments.photographs:
        wall, folder = wall_of(photographs), arguments.work / str(photographs)
        if not (folder / "survey.toml").is_file():
            write_survey(folder, wall)
        times.append(run_wall(folder, wall, arguments.jobs))
    if len(times) > 1:
        for name in times[0]:
            power = np.polyfit(
                np.log(arguments.photographs), np.log([of_size[name] for of_size in times]), 1
            )[0]
            print(f"{name} grows as n^{power:.2f}")


if __name__ == "__main__":
    main()
