"""Compares COLMAP, COLMAP with `kolinear refine`, and Kolinear's textured survey on rendered photographs.

    python -m benchmarks.textured --photographs 20 60 --roughness smooth medium rough
    python -m benchmarks.textured --photographs 15 30 60 120 --roughness medium --methods kolinear
    python -m benchmarks.textured --photographs 25 --finer 3 --roughness medium --methods kolinear
    python -m benchmarks.textured --photographs 60 250 1000 --layout block --finer 0.625 --roughness medium

For each scene, the following is printed: the RMS errors of centres and rotations after a similarity onto the
truth, their prediction by the result in the same datum, the joint squared Mahalanobis distance of centres and
rotations per degree of freedom, and the processor time. With several numbers of photographs, the exponent of
the growth of time is printed too. Of a block, COLMAP is told the pairs that overlap. Scenes are rendered into
a folder (--work) unless they exist there.
"""

from __future__ import annotations

import argparse
import resource
import time
from pathlib import Path

import numpy as np

from adapters.colmap.mapper import map_matches, match_photographs
from benchmarks.textured_scenes import (
    LAYOUTS,
    RIPPLES,
    TexturedScene,
    overlapping,
    photograph_name,
    render_scene,
    textured_scene,
)
from sfm.adjustment.covariance import marginal_of
from sfm.adjustment.result import Adjustment
from sfm.comparison.solutions import rotation_angle_deg
from sfm.files.user_cache import scratch_folder
from sfm.model.conventions import FloatArray
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.similarity import Similarity, fit_similarity
from sfm.pipeline import run_survey
from sfm.products.refining.refinement import refine_model
from sfm.survey.inputs.survey import read_survey

HEAD = (
    "scene            method           images  points   centre mm  rotation mdeg  predicted mm  ratio"
    "  Mahalanobis/dof  cpu s"
)
COLMAP = {"colmap": "COLMAP", "colmap-global": "COLMAP, global"}
METHODS = [*COLMAP, "kolinear"]


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else "")
    parser.add_argument("--photographs", type=int, nargs="+", default=[20])
    parser.add_argument("--finer", type=float, default=1.0, help="pixels along each of 1024 x 768")
    parser.add_argument("--jobs", type=int, default=1, help="photographs processed at a time")
    parser.add_argument("--layout", choices=LAYOUTS, default="dome", help="see benchmarks/textured_scenes.py")
    parser.add_argument("--roughness", nargs="+", default=list(RIPPLES), choices=list(RIPPLES))
    parser.add_argument("--methods", nargs="+", default=METHODS, choices=METHODS)
    parser.add_argument("--work", type=Path, default=Path("build/textured_scenes"))
    arguments = parser.parse_args()
    print(HEAD)
    finer = "" if arguments.finer == 1 else f"x{arguments.finer:g}"
    block = "" if arguments.layout == "dome" else "block"
    for roughness in arguments.roughness:
        seconds: list[list[float]] = []
        for photographs in arguments.photographs:
            folder = arguments.work / f"{roughness}{block}{photographs}{finer}"
            scene = textured_scene(roughness, photographs, arguments.finer, arguments.layout)
            if not (folder / "survey.toml").is_file():
                render_scene(folder, roughness, photographs, arguments.finer, arguments.layout)
            of_scene: list[float] = []
            if "kolinear" in arguments.methods:
                of_scene.append(_kolinear(scene, folder, arguments.jobs))
            if set(COLMAP).intersection(arguments.methods):
                of_scene += _colmap(scene, folder, [m for m in COLMAP if m in arguments.methods])
            seconds.append(of_scene)
        if len(arguments.photographs) > 1:
            power = np.polyfit(np.log(arguments.photographs), np.log(seconds), 1)[0]
            print(f"{roughness:<17}time grows as n^" + ", n^".join(f"{exponent:.2f}" for exponent in power))


def _kolinear(scene: TexturedScene, folder: Path, jobs: int) -> float:
    """Run the survey, print its errors and return its processor time."""
    begun, started = time.process_time(), time.perf_counter()
    result = run_survey(read_survey(folder / "survey.toml"), jobs=jobs)
    seconds, elapsed = time.process_time() - begun, time.perf_counter() - started
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6  # before the joint covariance
    stages = ", ".join(f"{stage.stage} {stage.seconds:.1f} s" for stage in result.seconds)
    a = result.adjustment
    _print(scene, folder.name, "Kolinear", a.network, a.estimate, seconds, a)
    rejected = f"{int(a.rejected.sum())} of {len(a.rejected)} image points rejected"
    print(
        f"{'':17}{a.iterations} iterations, {rejected}; {elapsed:.1f} s with {jobs} at a time: {stages}; "
        f"peak memory of the process so far {peak:.2f} GB"
    )
    return seconds


def _colmap(scene: TexturedScene, folder: Path, methods: list[str]) -> list[float]:
    """Run COLMAP's mappers on the same matches, and refine the model of the incremental one.

    The errors are printed. The times that are returned are those of the mappers and of `refine`, each with
    the time of the matches.
    """
    names = tuple(photograph_name(i) for i in range(len(scene.position)))
    pairs = [(names[i], names[j]) for i, j in overlapping(scene)] if scene.layout == "block" else None
    begun, times = time.process_time(), []
    with scratch_folder() as work:
        match_photographs(folder, (names,), work / "scene.db", pairs=pairs)
        matched = time.process_time() - begun
        print(f"{folder.name:<17}COLMAP: features and matches {matched:.1f} s", flush=True)
        for method in methods:
            begun = time.process_time()
            mapped = map_matches(folder, work / "scene.db", at_once=method == "colmap-global")
            times.append(matched + time.process_time() - begun)
            words = COLMAP[method]
            _print(scene, folder.name, words, mapped.network, mapped.estimate, times[-1])
            if method == "colmap":
                begun = time.process_time()
                a = refine_model(mapped.network, mapped.estimate, folder).adjustment
                times.append(times[-1] + time.process_time() - begun)
                _print(scene, folder.name, "COLMAP + refine", a.network, a.estimate, times[-1], a)
    return times


def _print(
    scene: TexturedScene,
    name: str,
    method: str,
    network: Network,
    estimate: Estimate,
    seconds: float,
    adjustment: Adjustment | None = None,
) -> None:
    """Print one row of the table."""
    truth = {photograph_name(i): i for i in range(len(scene.position))}
    on = np.flatnonzero(estimate.oriented)
    of_truth = [truth[network.images[i]] for i in on]
    moved = fit_similarity(estimate.position[on], scene.position[of_truth])
    placed = moved.apply_estimate(estimate)
    centres = placed.position[on] - scene.position[of_truth]
    angles = rotation_angle_deg(scene.rotation[of_truth], placed.rotation[on])
    centre = float(np.sqrt((centres**2).sum(axis=1).mean()))
    predicted, distance = np.nan, np.nan
    if adjustment is not None:
        errors = errors_before(moved, centres, scene.rotation[of_truth], placed.rotation[on])
        covariance = covariance_on_centres(adjustment)
        variances = np.diagonal(covariance).reshape(-1, 6)[:, :3]
        predicted = moved.scale * float(np.sqrt(variances.sum(axis=1).mean()))
        distance = joint_distance(errors, covariance)
    print(
        f"{name:<17}{method:<17}{len(on):>3}/{len(scene.position):<3}{len(network.points):>7}"
        f"{1000 * centre:>12.4f}"
        f"{1000 * np.sqrt((angles**2).mean()):>15.3f}{1000 * predicted:>14.4f}{centre / predicted:>7.2f}"
        f"{distance:>17.2f}{seconds:>7.1f}",
        flush=True,
    )


def errors_before(
    moved: Similarity, centres: FloatArray, true_rotation: FloatArray, rotation: FloatArray
) -> FloatArray:
    """Return errors of X0 and small rotations about the image axes in the frame of the estimate, (m, 6).

    Args:
        moved: similarity onto the truth.
        centres: errors of the centres after it, (m, 3).
        true_rotation: true rotations, (m, 3, 3).
        rotation: those of the estimate after it, (m, 3, 3).
    """
    turn = true_rotation.transpose(0, 2, 1) @ rotation
    turns = np.column_stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]])
    return np.column_stack([centres @ moved.rotation / moved.scale, turns])


def joint_distance(errors: FloatArray, covariance: FloatArray) -> float:
    """Return the squared Mahalanobis distance of errors, (m, 6), per degree of freedom."""
    scale = np.sqrt(np.diagonal(covariance))  # lengths and angles have the same weight in the rank
    inverse = np.linalg.pinv(covariance / np.outer(scale, scale), rcond=1e-10, hermitian=True)
    z = errors.ravel() / scale
    return float(z @ inverse @ z) / (errors.size - 7)


def covariance_on_centres(adjustment: Adjustment) -> FloatArray:
    """Return the joint covariance of all X0 and small rotations, datum on the centres, (6m, 6m).

    It refers to errors after a similarity onto the true centres; a datum on the points would predict more.
    Source: Baarda (1973), S-transformations.
    """
    m = len(adjustment.estimate.position)
    covariance = marginal_of(adjustment).joint(np.arange(6 * m), np.zeros(0, dtype=np.int64))
    S = onto_centres(adjustment)
    return np.asarray(S @ covariance @ S.T)


def onto_centres(adjustment: Adjustment) -> FloatArray:
    """Return the S-transformation of X0 and small rotations to the datum on the centres, (6m, 6m)."""
    estimate = adjustment.estimate
    m = len(estimate.position)
    from_middle = estimate.position - estimate.position.mean(axis=0)
    G = np.zeros((m, 6, 7))
    G[:, :3, :3] = np.eye(3)
    G[:, :3, 3:6] = -np.cross(from_middle[:, None], np.eye(3)[None]).transpose(0, 2, 1)
    G[:, 3:, 3:6] = estimate.rotation.transpose(0, 2, 1)
    G[:, :3, 6] = from_middle
    of_centres = G.copy()
    of_centres[:, 3:] = 0.0
    G, of_centres = G.reshape(6 * m, 7), of_centres.reshape(6 * m, 7)
    return np.asarray(np.eye(6 * m) - G @ np.linalg.solve(of_centres.T @ of_centres, of_centres.T))


if __name__ == "__main__":
    main()
