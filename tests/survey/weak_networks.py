"""Random weak networks with their truth: few photographs, small bases, flat objects, wrong start values of c.

`weak_network` makes one that depends on its number only; `study` runs surveys of many of them from scratch,
and tells how wrong each result is and what was said of it. Object unit m.

    python -m tests.survey.weak_networks FIRST END FILE [C_SIGMA]

writes a line of FILE for each; none of FILE is repeated. With C_SIGMA nothing is said of what is free, and
the start value of c is wrong by a random factor of that standard deviation, as of drafts of photographs.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from sfm.model.camera import Camera, camera_from_values, project
from sfm.model.conventions import FloatArray, rotation_from_vector
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network
from sfm.model.remarks.remark import kinds_of
from sfm.model.similarity import fit_similarity
from sfm.pipeline import run_survey
from sfm.survey.inputs.survey import CameraSetup, Survey
from tests.findings import findings_of
from tests.surveys import survey_of
from tests.synthetic import PIXEL_MM, SIZE_PX, seed_of

FREES = (("c",), ("c", "x0", "y0"), ("c", "K1"), ("c", "x0", "y0", "K1"), ("c", "x0", "y0", "K1", "K2"))
WRONG = 5.0  # standard deviations (root mean square over the coordinates)


@dataclass(frozen=True)
class Weak:
    """A weak network, a survey of it, and what it is."""

    survey: Survey
    network: Network
    truth: Estimate
    words: str


@dataclass(frozen=True)
class Outcome:
    """What a survey of a weak network gave."""

    number: int
    level: str  # good, fair or bad; none where the survey ended without a result
    over_sigma: float  # error of the coordinates over their standard deviations, root mean square
    relative: float  # error of the coordinates over the size of the object, root mean square
    c: float  # adjusted over true principal distance
    words: str
    remarks: tuple[str, ...]
    kinds: tuple[str, ...]  # of the remarks

    @property
    def is_wrong_and_believed(self) -> bool:
        """Whether the result is wrong by more than WRONG and called good or fair."""
        return self.level in ("good", "fair") and self.over_sigma > WRONG


def weak_network(number: int) -> Weak:
    """Return the weak network of this number, and a survey of its image points without start values."""
    rng = seed_of(f"weak network {number}")
    weakest = number % 3 == 0  # three photographs of a plane, c far from its start value
    images = 3 if weakest else int(rng.choice([2, 3, 3, 3, 4, 4, 5, 6]))
    points = int(rng.integers(8, 40))
    relief = float(rng.choice([0.0, 0.0, 0.02, 0.1, 0.5]))  # of the radius of the object
    relief *= not weakest
    spread_deg = float(np.exp(rng.uniform(np.log(7), np.log(70))))  # of the viewing directions
    rolled, free = bool(rng.random() < 0.4), FREES[int(rng.integers(len(FREES)))]
    c_mm, noise = float(np.exp(rng.uniform(np.log(8), np.log(60)))), float(rng.choice([0.05, 0.1, 0.3]))
    off = float(np.exp(rng.normal(0, 0.5 if weakest else rng.choice([0.0, 0.03, 0.15]))))
    off = 1.0 if images == 2 else off  # two photographs do not check c, which is held, and told to be
    camera = camera_from_values("synthetic", "brown", SIZE_PX, PIXEL_MM, c_mm=c_mm, free=free)
    xyz = rng.uniform(-1, 1, (points, 3)) * (1, 1, relief)
    position, rotation = _stations(rng, images, spread_deg, rolled, c_mm)
    network = _measured(rng, camera, position, rotation, xyz, noise, float(rng.uniform(0.75, 1.0)))
    truth = Estimate((camera,), position, rotation, xyz)
    p = camera.parameters.copy()
    p[0] *= off
    given = replace(truth, cameras=(camera.with_parameters(p),))
    reject = str(rng.choice(["tau", "none"]))
    survey = survey_of(network, given, free=free, adjust={"sigma_px": noise, "reject": reject})
    words = (
        f"{images} photographs within {spread_deg:.0f} deg{' rolled' if rolled else ''}, {points} points, "
        f"relief {relief:g}, c {c_mm:.1f} mm from {off:.2f} c, {noise:g} px, free {' '.join(free)}, {reject}"
    )
    return Weak(survey, network, truth, words)


def unstated(weak: Weak, off: float) -> Weak:
    """Return a weak network whose survey says nothing of its camera but c, which is wrong by a factor."""
    stated, c = weak.survey.cameras[0], weak.truth.cameras[0].value("c")
    camera = CameraSetup(name=stated.name, size_px=stated.size_px, pixel_mm=stated.pixel_mm, c_mm=off * c)
    survey = replace(weak.survey)
    object.__setattr__(survey, "cameras", (camera,))  # with observations a survey takes cameras as calibrated
    return replace(weak, survey=survey, words=f"{weak.words}; not stated, c from {off:.2f} c")


def _stations(
    rng: np.random.Generator, images: int, spread_deg: float, rolled: bool, c_mm: float
) -> tuple[FloatArray, FloatArray]:
    """Return photographs before the object, within an angle, of different distance, that it nearly fills."""
    filling = 2.4 * c_mm / (min(SIZE_PX) * PIXEL_MM[0])  # distance at which it does
    tilt = np.radians(rng.uniform(0, 30))
    turn = rotation_from_vector(np.array([tilt, 0.0, 0.0]))
    position, rotation = np.empty((images, 3)), np.empty((images, 3, 3))
    for i in range(images):
        a, b = np.radians(spread_deg) * rng.uniform(-0.5, 0.5, 2)
        direction = turn @ np.array([np.sin(a), np.sin(b), np.sqrt(1 - np.sin(a) ** 2 - np.sin(b) ** 2)])
        position[i] = filling * rng.uniform(1.0, 1.3) * direction
        z = position[i] - 0.1 * rng.uniform(-1, 1, 3)
        z /= np.linalg.norm(z)
        x = np.cross([0.0, 1.0, 0.0], z)
        x /= np.linalg.norm(x)
        roll = np.array([0.0, 0.0, (np.pi / 2 * (i % 4) if rolled else 0.0) + rng.uniform(-0.1, 0.1)])
        rotation[i] = np.stack([x, np.cross(z, x), z], axis=1) @ rotation_from_vector(roll)
    return position, rotation


def _measured(
    rng: np.random.Generator,
    camera: Camera,
    position: FloatArray,
    rotation: FloatArray,
    xyz: FloatArray,
    noise: float,
    visibility: float,
) -> Network:
    rows = []
    for i in range(len(position)):
        xy = project(camera, position[i], rotation[i], xyz)
        inside = np.isfinite(xy).all(1) & (xy > 0).all(1) & (xy < np.array(SIZE_PX) - 1).all(1)
        j = np.flatnonzero(inside & (rng.random(len(xyz)) < visibility))
        rows.append((np.full(len(j), i), j, xy[j]))
    image, point, xy = (np.concatenate(part) for part in zip(*rows, strict=True))
    return Network(
        tuple(f"image {i + 1}" for i in range(len(position))),
        np.zeros(len(position), dtype=np.int64),
        tuple(str(j + 1) for j in range(len(xyz))),
        ImagePoints(
            image,
            point,
            xy + noise * rng.standard_normal(xy.shape),
            np.tile(noise**2 * np.eye(2), (len(xy), 1, 1)),
        ),
    )


def outcome_of(number: int, c_sigma: float | None = None) -> Outcome:
    """Run the survey of a weak network from scratch and hold its result against the truth.

    Args:
        number: of the network.
        c_sigma: standard deviation of the logarithm of the factor of c, with nothing stated of what is free.
    """
    weak = weak_network(number)
    if c_sigma is not None:
        weak = unstated(weak, float(np.exp(c_sigma * seed_of(f"off{number}").standard_normal())))
    try:
        result = run_survey(weak.survey)
    except GeometryError as error:
        return Outcome(number, "none", np.nan, np.nan, np.nan, weak.words, (str(error),), ())
    verdict = findings_of(result).verdict
    a = result.adjustment
    index = [weak.network.point_index(name) for name in result.network.points]
    X = weak.truth.points[index]
    placing = fit_similarity(a.estimate.points, X)
    error = placing.apply(a.estimate.points) - X
    stated = max(a.sigma0, 1.0) / a.sigma0 if a.sigma0 > 0 else np.nan
    sigma = placing.scale * stated * np.sqrt(np.trace(a.covariance.points, axis1=1, axis2=2).mean() / 3)
    rms = float(np.sqrt((error**2).mean()))
    c = a.estimate.cameras[0].value("c") / weak.truth.cameras[0].value("c")
    size = float(np.linalg.norm(np.ptp(X, axis=0)))
    return Outcome(
        number,
        verdict.level,
        rms / float(sigma),
        rms / size,
        c,
        weak.words,
        tuple(one.text for one in verdict.remarks),
        kinds_of((*verdict.remarks, *verdict.tests)),
    )


def study(numbers: Iterable[int], kept: Path | None = None, c_sigma: float | None = None) -> list[Outcome]:
    """Return the outcomes of weak networks, and print those that are wrong and believed.

    Args:
        numbers: numbers of the networks
        kept: file that keeps the outcomes, a JSON line each; those that stand in it are not computed again.
        c_sigma: as of `outcome_of`.
    """
    lines = kept.read_text().splitlines() if kept is not None and kept.exists() else []
    done = {one.number: one for one in (Outcome(**json.loads(line)) for line in lines)}
    found = []
    for number in numbers:
        one = done[number] if number in done else outcome_of(number, c_sigma)
        found.append(one)
        if kept is not None and number not in done:
            with kept.open("a") as file:
                file.write(json.dumps(asdict(one)) + "\n")
        if one.is_wrong_and_believed:
            print(f"{number}: {one.level}, {one.over_sigma:.1f} sigma, c {one.c:.3f}; {one.words}")
            for line in one.remarks:
                print(f"    {line}")
            sys.stdout.flush()
    levels = Counter(one.level for one in found)
    wrong = Counter(one.level for one in found if one.over_sigma > WRONG)
    print(f"{len(found)} networks: {dict(levels)}, of them wrong by more than {WRONG:g} sigma: {dict(wrong)}")
    return found


if __name__ == "__main__":
    first, end, file, *c_sigma = sys.argv[1:]
    study(range(int(first), int(end)), Path(file), *map(float, c_sigma))
