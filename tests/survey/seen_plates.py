"""Surveys of plates from simulated image points, without photographs to be rendered and measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from sfm.judgement.survey_result import SurveyResult
from sfm.model.camera import camera_from_values, project
from sfm.model.conventions import BoolArray, FloatArray, rotation_from_vector
from sfm.pipeline import run_survey
from sfm.survey.inputs.measurements import MeasuredPhotographs, Measurements, PhotographList
from sfm.survey.inputs.survey import Survey, read_survey
from sfm.survey.target_network import build_network, min_rays, name_coded
from sfm.targets.detect import Targets, _of_crossings
from sfm.targets.fits.saddle import Saddles
from tests.plates import PITCH, PIXEL_MM, SIZE_PX, SURVEY, camera

SIGMA_PX = 0.03
FREE = 'free = ["c", "x0", "y0", "K1", "K2"]\n'
TAGS = 'dictionary = "apriltag36h11"\ntag_size = 9.0\n'
SIZES = ((8, 10), (6, 8), (6, 6))  # corners of the AprilGrids, in rows and columns


@dataclass(frozen=True)
class Plates:
    """Places of the points of fixed plates, in the frame of the first."""

    xyz: tuple[FloatArray, ...]

    @classmethod
    def side_by_side(cls, count: int = 2, *, tilt: float = -0.4) -> Plates:
        """Return so many AprilGrids, those behind the first to its right, tilted towards it, rad."""
        found = []
        for k, (rows, columns) in enumerate(SIZES[:count]):
            row, column = np.divmod(np.arange(rows * columns), columns)
            x, y = (PITCH * (at // 2 + at % 2 * 9.0 / PITCH) for at in (column, row))
            turn = rotation_from_vector(np.array([0.0, tilt, 0.1])) if k else np.eye(3)
            place = np.array([0.0, 70.0 * k, 0.0]) if k > 1 else np.array([160.0 * k, 5.0 * k, 12.0 * k])
            found.append(np.stack([x, -y, np.zeros(len(x))], axis=1) @ turn.T + place)
        return cls(tuple(found))


def plates_survey(
    folder: Path, count: int = 2, lines: Sequence[str] = (), free: str = FREE, c_mm: float = 8.0
) -> Survey:
    """Return a survey of AprilGrids, with lines more for each, their pitch among them if not PITCH."""
    more = [*lines, *[""] * count]
    more = [one if "pitch" in one else f"pitch = {PITCH}\n{one}" for one in more]
    text = SURVEY.format(
        name="plates", polarity="dark", pixel=PIXEL_MM, datum="control", pitch=f"{PITCH}\n{TAGS}",
        codes="aprilgrid", rows=8, columns=10, marks=[],
    ).replace("marks = []\n", "").replace(FREE, free)  # fmt: skip
    text = text.replace("c_mm = 8.0", f"c_mm = {c_mm}").replace(f"pitch = {PITCH}\n", f"{more[0]}\n")
    first = 20
    for k, (rows, columns) in enumerate(SIZES[1:count], 1):
        text += f'[[plate]]\ncodes = "aprilgrid"\nrows = {rows}\ncolumns = {columns}\n'
        text += f"{TAGS}first_tag = {first}\n{more[k]}\n"
        first += rows * columns // 4
    (folder / "survey.toml").write_text(text, encoding="utf-8")
    return read_survey(folder / "survey.toml")


def about(
    plates: Plates, rng: np.random.Generator, count: int, tilt_deg: float = 30.0, distance: float = 450.0
) -> list[tuple[FloatArray, FloatArray]]:
    """Return positions and rotations of photographs around plates, tilted by up to an angle."""
    middle, poses = np.concatenate(plates.xyz).mean(axis=0), []
    for k in range(count):
        azimuth, tilt = 2 * np.pi * k / count + rng.uniform(0, 0.5), tilt_deg * rng.uniform(0.6, 1)
        tilt = np.radians(tilt)
        z = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)])
        x = np.cross([0.0, 1.0, 0.0], z)
        x /= np.linalg.norm(x)
        roll = rotation_from_vector(np.array([0.0, 0.0, [0.1, np.pi / 2, np.pi, -0.2][k % 4]]))
        R = np.stack([x, np.cross(z, x), z], axis=1) @ roll
        poses.append((middle + distance * rng.uniform(0.93, 1.07) * z, R))
    return poses


def seen_targets(
    xyz: Sequence[FloatArray],
    position: FloatArray,
    rotation: FloatArray,
    rng: np.random.Generator,
    *,
    seen: BoolArray | None = None,
) -> Targets:
    """Return the image points of plates in one photograph, with noise of SIGMA_PX; of those seen at all."""
    points = np.concatenate(list(xyz))
    xy = project(camera(), position, rotation, points) + SIGMA_PX * rng.standard_normal((len(points), 2))
    inside = ((xy > 4) & (xy < np.array(SIZE_PX) - 5)).all(axis=1)
    if seen is not None:
        inside &= seen
    k = int(inside.sum())
    saddles = Saddles(xy[inside], np.tile(SIGMA_PX**2 * np.eye(2), (k, 1, 1)), np.ones(k), np.ones(k))
    return _of_crossings(saddles, np.flatnonzero(inside))


def run_plates(
    survey: Survey,
    plates: Plates,
    poses: Sequence[tuple[FloatArray, FloatArray]],
    rng: np.random.Generator,
    *,
    slipped: Sequence[int] = (),
    slip: FloatArray | None = None,
    seen: BoolArray | None = None,
) -> SurveyResult:
    """Return the result of image points with noise of SIGMA_PX.

    Args:
        survey: of these plates.
        plates: where their points are.
        poses: of the photographs.
        rng: of the noise.
        slipped: photographs that see the last plate elsewhere.
        slip: by how much, mm, (3,).
        seen: points that are seen at all.
    """
    start = camera_from_values(
        "small", "brown", SIZE_PX, (PIXEL_MM, PIXEL_MM), c_mm=survey.cameras[0].c_mm,
        free=survey.cameras[0].may_be_free,
    )  # fmt: skip
    names = tuple(f"{k}.png" for k in range(len(poses)))
    found: list[Targets] = []
    for k, pose in enumerate(poses):
        *others, last = plates.xyz
        moved = last + (slip if k in slipped and slip is not None else 0.0)
        found.append(seen_targets((*others, moved), *pose, rng, seen=seen))
    paths, of_camera = tuple(Path(name) for name in names), np.zeros(len(names), dtype=np.int64)
    photographs = MeasuredPhotographs(names, paths, of_camera, (start,), tuple(found), ())
    naming = name_coded(photographs)
    measured = Measurements(
        build_network(survey, photographs, naming), (start,), names, min_rays(naming),
        files=PhotographList(names, paths, of_camera, Path(".")), photographs=photographs, naming=naming,
    )  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sfm.pipeline._measure", lambda *_: (survey, measured))
        return run_survey(survey)
