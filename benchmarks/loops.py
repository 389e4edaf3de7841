"""Walks around an object: whether the survey of image points alone closes the loop.

    python -m benchmarks.loops --photographs 60 250 500 --seeds 2
    python -m benchmarks.loops --photographs 500 --open

Each photograph shows a piece of the wall and shares points with the next ones only, so that errors grow
along the loop until it is closed. Nothing is given but the image points and a rough principal distance.
With --open, the points between the last photographs and the first have other names in both, so that nothing
closes the loop.

Printed are the photographs that are oriented; the RMS error of their centres after a similarity onto the
truth, and what the adjustment predicts in the same datum; the joint squared Mahalanobis distance of all
centres and rotations per degree of freedom; the largest error of a centre in standard deviations; the error
of the vector between the last centre and the first, and its largest coordinate in standard deviations; the
processor time.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.networks import SIZE_PX, photographed, shared_camera
from benchmarks.textured import covariance_on_centres, errors_before, joint_distance
from sfm.judgement.survey_result import SurveyResult
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.similarity import fit_similarity
from sfm.pipeline import run_survey
from sfm.survey.inputs.survey import read_survey

DISTANCE = 8.0  # of the camera from the wall, m; a photograph shows as much of it in width
STEP = 1.33  # between photographs, m
POINTS = 14  # new ones for each photograph, so that it shows about 80
HEAD = (
    "photographs  oriented   points  centres mm  predicted mm  ratio  Mahalanobis/dof  worst centre/sigma"
    "  closure mm  closure/sigma  cpu s  MiB"
)
SURVEY = """[survey]
name = "loop"
unit = "m"
[[camera]]
name = "A"
images = "*.jpg"
size_px = [{0}, {1}]
pixel_mm = [0.005, 0.005]
c_mm = 10.5
model = "opencv"
free = ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"]
[observations]
file = "image_points.csv"
[compare]
backend = "none"
"""


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else "")
    parser.add_argument("--photographs", type=int, nargs="+", default=[60, 500])
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--open", action="store_true", help="nothing closes the loop")
    arguments = parser.parse_args()
    print(HEAD)
    for photographs in arguments.photographs:
        for seed in range(arguments.seeds):
            _run(*walk(photographs, seed, closed=not arguments.open))


def walk(photographs: int, seed: int, *, closed: bool = True) -> tuple[Network, Estimate]:
    """Return the image points of photographs around a round wall of relief 1 m, and the true estimate."""
    rng = np.random.default_rng([photographs, seed])
    radius = photographs * STEP / (2 * np.pi)
    camera_radius = radius + DISTANCE
    angle = 2 * np.pi * np.arange(photographs) / photographs
    away = np.stack([np.cos(angle), np.sin(angle), np.zeros(photographs)], axis=1)
    position = camera_radius * away + rng.normal(0, 0.2, (photographs, 3))
    # towards the wall, every other photograph to the left and right by 12 degrees, and tilted
    turn = angle + np.radians(12.0) * (-1.0) ** np.arange(photographs) + rng.normal(0, 0.03, photographs)
    tilt = rng.normal(0, 0.08, photographs)
    z = np.stack([np.cos(tilt) * np.cos(turn), np.cos(tilt) * np.sin(turn), np.sin(tilt)], axis=1)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    rotation = np.stack([x, np.cross(z, x), z], axis=2)
    n = POINTS * photographs
    around = rng.uniform(0, 2 * np.pi, n)
    depth = radius + rng.uniform(-1, 1, n)
    X = np.stack([depth * np.cos(around), depth * np.sin(around), rng.uniform(-3, 3, n)], axis=1)
    apart = (around[None] - angle[:, None] + np.pi) % (2 * np.pi) - np.pi
    seen = [np.flatnonzero(np.abs(off) * camera_radius < DISTANCE) for off in apart]
    truth = Estimate((shared_camera(),), position, rotation, X)
    if not closed:  # points near angle 0 are other ones in the second half of the photographs
        end = np.flatnonzero(np.minimum(around, 2 * np.pi - around) * camera_radius < 2 * DISTANCE)
        other = np.arange(n)
        other[end] = n + np.arange(len(end))
        truth = Estimate(truth.cameras, position, rotation, np.concatenate([X, X[end]]))
        seen = [other[j] if 2 * i > photographs else j for i, j in enumerate(seen)]
    return photographed(truth, seen, rng), truth


@dataclass(frozen=True)
class Walked:
    """Errors of the survey of a walk after a similarity onto the truth, object unit m."""

    result: SurveyResult
    oriented: int  # photographs
    centres: float  # RMS error
    predicted: float  # the same by the covariance
    mahalanobis: float  # squared distance of all centres and rotations per degree of freedom
    worst: float  # largest coordinate error of a centre, standard deviations
    closure: FloatArray  # error of the vector between the last centre and the first, (3,)
    closure_sigma: FloatArray  # its standard deviations, (3,)

    @property
    def closure_sigmas(self) -> float:
        """Largest coordinate of the closure in standard deviations."""
        return float(np.abs(self.closure / self.closure_sigma).max())


def walked(network: Network, truth: Estimate) -> Walked:
    """Run the survey of the image points of a walk and compare it with the truth."""
    with tempfile.TemporaryDirectory() as scratch:
        _write(Path(scratch), network)
        result = run_survey(read_survey(Path(scratch) / "survey.toml"), jobs=1)
    a = result.adjustment
    on = np.flatnonzero(a.estimate.oriented)
    of_truth: IntArray = np.array([int(a.network.images[i][1:-4]) for i in on])
    moved = fit_similarity(a.estimate.position, truth.position[of_truth])
    placed = moved.apply_estimate(a.estimate)
    m, centres = len(on), placed.position - truth.position[of_truth]
    errors = errors_before(moved, centres, truth.rotation[of_truth], placed.rotation)
    covariance = covariance_on_centres(a)
    distance = joint_distance(errors, covariance)
    errors, sigma = errors.ravel(), np.sqrt(np.diagonal(covariance))
    order = np.argsort(of_truth)
    closing = np.zeros((3, 6 * m))
    closing[:, 6 * order[-1] : 6 * order[-1] + 3] = np.eye(3)
    closing[:, 6 * order[0] : 6 * order[0] + 3] = -np.eye(3)
    off, predicted = (moved.scale * _rms(of.reshape(m, 6)[:, :3]) for of in (errors, sigma))
    return Walked(
        result,
        m,
        off,
        predicted,
        distance,
        float(np.abs((errors / sigma).reshape(m, 6)[:, :3]).max()),
        moved.scale * (closing @ errors),
        moved.scale * np.sqrt(np.diagonal(closing @ covariance @ closing.T)),
    )


def _run(network: Network, truth: Estimate) -> None:
    """Run the survey of the image points and print its errors."""
    begun = time.process_time()
    walk = walked(network, truth)
    seconds, memory = time.process_time() - begun, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(
        f"{len(truth.position):>11}{walk.oriented:>10}{len(walk.result.adjustment.network.points):>9}"
        f"{1000 * walk.centres:>12.2f}{1000 * walk.predicted:>14.2f}{walk.centres / walk.predicted:>7.2f}"
        f"{walk.mahalanobis:>17.2f}{walk.worst:>20.2f}{1000 * np.linalg.norm(walk.closure):>12.2f}"
        f"{walk.closure_sigmas:>15.2f}{seconds:>7.1f}{memory / 1024:>5.0f}",
        flush=True,
    )
    for remark in walk.result.remarks:
        print("   ", remark.kind, flush=True)


def _rms(of_centres: FloatArray) -> float:
    """Return the root mean square length of vectors, (m, 3)."""
    return float(np.sqrt((of_centres**2).sum(axis=1).mean()))


def _write(folder: Path, network: Network) -> None:
    """Write the survey of image points."""
    seen = network.image_points
    rows = zip(seen.image.tolist(), seen.point.tolist(), seen.xy.tolist(), strict=True)
    lines = [f"i{network.images[i]}.jpg,{network.points[j]},{x:.4f},{y:.4f}" for i, j, (x, y) in rows]
    (folder / "image_points.csv").write_text(
        "\n".join(["image,point,x_px,y_px", *lines, ""]), encoding="utf-8"
    )
    (folder / "survey.toml").write_text(SURVEY.format(*SIZE_PX), encoding="utf-8")


if __name__ == "__main__":
    main()
