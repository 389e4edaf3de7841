"""COLMAP, COLMAP and refine, and Kolinear's own textured survey on rendered photographs with truth.

    python -m benchmarks.textured --photographs 20 --roughness smooth medium rough

Prints for each scene the RMS errors of centres and rotations after a similarity onto the truth, what the
result predicts for them, and the processor time, all in one run. The scenes are rendered into a folder
(--work) unless they are there.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from adapters.colmap.mapper import map_photographs
from benchmarks.textured_scenes import RIPPLES, TexturedScene, render_scene, textured_scene
from sfm.adjustment.result import Adjustment
from sfm.comparison.solutions import rotation_angle_deg
from sfm.network import Estimate, Network
from sfm.pipeline import run_survey
from sfm.similarity import fit_similarity
from sfm.survey.inputs.survey import read_survey
from sfm.survey.refine import refine_model

HEAD = (
    "scene            method           images  points   centre mm  rotation mdeg  predicted mm  ratio  cpu s"
)
METHODS = ["colmap", "kolinear"]


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else "")
    parser.add_argument("--photographs", type=int, default=20)
    parser.add_argument("--roughness", nargs="+", default=list(RIPPLES), choices=list(RIPPLES))
    parser.add_argument("--methods", nargs="+", default=METHODS, choices=METHODS)
    parser.add_argument("--work", type=Path, default=Path("build/textured_scenes"))
    arguments = parser.parse_args()
    print(HEAD)
    for roughness in arguments.roughness:
        folder = arguments.work / f"{roughness}{arguments.photographs}"
        scene = textured_scene(roughness, arguments.photographs)
        if not (folder / "survey.toml").is_file():
            render_scene(folder, roughness, arguments.photographs)
        if "kolinear" in arguments.methods:
            _kolinear(scene, folder)
        if "colmap" in arguments.methods:
            _colmap(scene, folder)


def _kolinear(scene: TexturedScene, folder: Path) -> None:
    """Run the survey and print its errors."""
    begun = time.process_time()
    found = run_survey(read_survey(folder / "survey.toml"))
    stages = ", ".join(f"{one.stage} {one.seconds:.1f} s" for one in found.seconds)
    a = found.adjustment
    _print(scene, folder.name, "Kolinear", a.network, a.estimate, time.process_time() - begun, a)
    rejected = f"{int(a.rejected.sum())} of {len(a.rejected)} image points rejected"
    print(f"{'':17}{a.iterations} iterations, {rejected}; {stages}")


def _colmap(scene: TexturedScene, folder: Path) -> None:
    """Run COLMAP's pipeline, then refine on its model, and print the errors of both."""
    begun = time.process_time()
    names = tuple(sorted(path.name for path in folder.glob("*.png")))
    mapped = map_photographs(folder, (names,))
    seconds = time.process_time() - begun
    _print(scene, folder.name, "COLMAP", mapped.network, mapped.estimate, seconds)
    found = refine_model(mapped.network, mapped.estimate, folder)
    a = found.adjustment
    _print(scene, folder.name, "COLMAP + refine", a.network, a.estimate, time.process_time() - begun, a)


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
    truth = {f"surface_{i + 1:03d}.png": i for i in range(len(scene.position))}
    on = np.flatnonzero(estimate.oriented)
    own = [truth[network.images[i]] for i in on]
    moved = fit_similarity(estimate.position[on], scene.position[own])
    placed = moved.apply_estimate(estimate)
    centres = placed.position[on] - scene.position[own]
    angles = rotation_angle_deg(scene.rotation[own], placed.rotation[on])
    predicted, ratio = np.nan, np.nan
    if adjustment is not None:
        cofactors = adjustment.covariance.exterior[:, :3, :3]
        predicted = moved.scale * float(np.sqrt(np.einsum("mii->m", cofactors).mean()))
        ratio = float(np.sqrt((centres**2).sum(axis=1).mean())) / predicted
    print(
        f"{name:<17}{method:<17}{len(on):>3}/{len(scene.position):<3}{len(network.points):>7}"
        f"{1000 * np.sqrt((centres**2).sum(axis=1).mean()):>12.4f}"
        f"{1000 * np.sqrt((angles**2).mean()):>15.3f}{1000 * predicted:>14.4f}{ratio:>7.2f}{seconds:>7.1f}",
        flush=True,
    )


if __name__ == "__main__":
    main()
