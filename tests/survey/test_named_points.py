"""Natural points that a person names: found in all photographs, and again in a later epoch."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.camera import project
from sfm.conventions import AnyArray, FloatArray
from sfm.distributions import chi2_ppf
from sfm.errors import SurveyFileError
from sfm.pipeline import run_survey
from sfm.rendering.render import render_photographs
from sfm.rendering.scene import Optics, join_marks, rectangles
from sfm.result import SurveyResult
from sfm.similarity import fit_similarity
from sfm.survey.inputs.survey import read_survey
from tests.surveys import SIZE_PX, SURVEY, camera, code_centres, plates, stations
from tests.synthetic import seed_of

PHOTOGRAPHS = 6
NOISE = 2.0  # grey values
MOVED = (0.3, -0.2, 0.25)  # of the upper plate between the epochs, mm
TOP = [(0.0, y, 60.0) for y in (-38.0, -19.0, 0.0, 19.0, 38.0)]
FLOOR = [(x, y, 0.0) for x in (-185.0, -135.0, 105.0, 135.0, 185.0) for y in (-57.0, 57.0)]
POINTS = {f"corner {k}": np.array(xyz) for k, xyz in enumerate([*TOP, *FLOOR])}


@lru_cache
def pictures(moved: tuple[float, ...] = (0.0, 0.0, 0.0)) -> tuple[AnyArray, ...]:
    """Render photographs of plates with coded targets on texture, the upper one moved, without noise."""
    scene, targets = plates(), plates().targets
    centre = scene.faces.centre + np.array([[0.0, 0.0, 0.0], moved])
    faces = replace(scene.faces, centre=centre, texture=np.full(2, 0.2), grain=np.full(2, 2.0))
    paper = [
        rectangles(face, xy[None], np.full((1, 2), 17.0 if face else 24.0), np.zeros(1), np.full(1, 0.8))
        for face, xy in zip(targets.face.tolist(), targets.centre, strict=True)
    ]
    scene = replace(scene, faces=faces, marks=join_marks([*paper, scene.marks]))
    found, _ = render_photographs(
        scene, camera(), *stations(PHOTOGRAPHS), optics=Optics(blur_px=0.7, exposure=0.9), seed=1
    )
    return tuple(found)


def write(folder: Path, marks: str, moved: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Path:
    """Write photographs and their survey file with named points; return the file."""
    folder.mkdir()
    rng = seed_of(folder.name)
    for number, picture in enumerate(pictures(moved), 1):
        noisy = np.rint(picture + NOISE * rng.standard_normal(picture.shape))
        cv2.imwrite(str(folder / f"photo {number}.png"), np.clip(noisy, 0, 255).astype(np.uint8))
    path = folder / "survey.toml"
    path.write_text(SURVEY.format(name=folder.name, backend="none") + marks, "utf-8")
    return path


def mark(name: str, image: int, xy: FloatArray, before: str = "") -> str:
    """Return a named point of a survey file."""
    return (
        f'[[point]]\nname = "{name}"\nimage = "{before}photo {image}.png"\n'
        f"x_px = {float(xy[0])!r}\ny_px = {float(xy[1])!r}\n"
    )


def marks(before: str = "") -> str:
    """Return the named points, each in the nearest photograph that shows it."""
    position, rotation = stations(PHOTOGRAPHS)
    text = ""
    for name, xyz in POINTS.items():
        seen = np.array(
            [project(camera(), X0, R, xyz[None])[0] for X0, R in zip(position, rotation, strict=True)]
        )
        inside = ((seen > 20) & (seen < np.array(SIZE_PX) - 20)).all(axis=1)
        i = int(np.argmin(np.where(inside, np.linalg.norm(position - xyz, axis=1), np.inf)))
        text += mark(name, i + 1, seen[i], before)
    return text


def placed(result: SurveyResult) -> tuple[list[str], FloatArray, FloatArray]:
    """Return the named points of a result in the frame of the truth, by the codes that did not move."""
    a, truth = result.adjustment, code_centres()
    names = list(a.network.points)
    fixed = [j for j, name in enumerate(names) if name.isdigit() and truth[int(name)][2] == 0]
    placing = fit_similarity(a.estimate.points[fixed], np.array([truth[int(names[j])] for j in fixed]))
    rows = [names.index(name) for name in POINTS if name in names]
    R = placing.scale * placing.rotation
    covariance = np.einsum("ab,nbc,dc->nad", R, a.covariance.points[rows], R)
    return [names[j] for j in rows], placing.apply(a.estimate.points[rows]), covariance


def test_named_points_are_found_and_found_again_in_a_later_epoch(tmp_path: Path) -> None:
    bar = '[[scale_bar]]\nfrom = "corner 5"\nto = "corner 14"\nlength = {length!r}\nsigma = 0.01\n'
    length = float(np.linalg.norm(POINTS["corner 5"] - POINTS["corner 14"]))
    first = run_survey(read_survey(write(tmp_path / "first", marks() + bar.format(length=length))))
    again = run_survey(read_survey(tmp_path / "first" / "survey.toml"))
    names, before, covariance = placed(first)
    assert names == list(POINTS) and first.verdict.level != "bad" and len(first.network.scale_bars) == 1
    assert (placed(again)[1] == before).all()
    error = before - np.array([POINTS[name] for name in names])
    assert np.abs(error).max() < 0.05  # 0.06 px
    network = first.network
    assert [source.name for source in network.sources] == ["targets", "marks"]
    rays = np.bincount(network.image_points.point, minlength=len(network.points))
    assert min(rays[network.points.index(name)] for name in names) >= 3

    later = run_survey(read_survey(write(tmp_path / "later", marks("../first/"), MOVED), allow_outside=True))
    found, after, covariance_after = placed(later)
    assert found == names
    moved = np.array([MOVED if POINTS[name][2] else (0.0, 0.0, 0.0) for name in names])
    difference = after - before - moved
    C = covariance + covariance_after
    square = np.einsum("na,nab,nb->n", difference, np.linalg.inv(C), difference)
    assert (square < chi2_ppf(0.95, 3)).sum() >= 0.85 * len(names)
    assert 0.7 < np.sqrt(square.mean() / 3) < 1.4


def test_a_point_of_an_earlier_epoch_that_is_marked_again_is_measured_once(tmp_path: Path) -> None:
    """The mark shows where it is now; the template stays that of the first epoch."""
    write(tmp_path / "first", marks())
    position, rotation = stations(PHOTOGRAPHS)
    name = next(name for name, X in POINTS.items() if X[2])
    now = POINTS[name] + MOVED
    again = "".join(
        mark(name, i, project(camera(), position[i - 1], rotation[i - 1], now[None])[0] + [0.5, -0.4])
        for i in (2, 3)
    )
    text = marks("../first/") + again
    network = run_survey(read_survey(write(tmp_path / "later", text, MOVED), allow_outside=True)).network
    seen = network.image_points
    images = seen.image[seen.point == network.points.index(name)]
    assert len(images) == len(set(images.tolist())) >= 3


def test_a_place_that_nothing_matches_is_named(tmp_path: Path) -> None:
    beside = np.array([30.0, 30.0])  # where the photograph shows no plate
    result = run_survey(read_survey(write(tmp_path / "plain", mark("beside", 1, beside))))
    (said,) = [one for one in result.verdict.remarks if one.kind == "marks_unmatched"]
    assert said.names("points") == ("beside",) and "beside" not in result.network.points


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (mark("a", 9, np.array([50.0, 50.0])), "neither a photograph of the survey nor a file"),
        (mark("a", 1, np.array([700.0, 50.0])), "outside its photograph"),
        (mark("a", 1, np.array([50.0, 50.0])) * 2, "named twice in photo 1.png"),
        (mark("a", 1, np.array([50.0, 50.0])) + mark("b", 1, np.array([50.5, 50.0])), "0.5 px apart"),
        (mark("5", 1, np.array([50.0, 50.0])), "has the name of a target"),
    ],
)
def test_wrong_marks_are_refused_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(SurveyFileError, match=message) as refused:
        run_survey(read_survey(write(tmp_path / "wrong", text)))
    assert "\n" not in str(refused.value)
