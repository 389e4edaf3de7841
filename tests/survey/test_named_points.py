"""Natural points that a person names: found in all photographs, and again in a later epoch."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.comparison.congruency import motions
from sfm.comparison.stable_points import in_datum
from sfm.judgement.survey_result import SurveyResult
from sfm.model.camera import project
from sfm.model.conventions import AnyArray, FloatArray
from sfm.model.distributions import Levels, chi2_ppf
from sfm.model.errors import SurveyFileError
from sfm.model.network import ImagePoints
from sfm.model.similarity import fit_similarity
from sfm.pipeline import run_survey
from sfm.products.rendering.render import render_photographs
from sfm.products.rendering.scene import Optics, join_marks, rectangles
from sfm.survey.inputs.survey import read_survey
from sfm.survey.measuring.templates import _Matched, _most_alike
from tests.surveys import SIZE_PX, SURVEY, camera, code_centres, plates, stations
from tests.synthetic import seed_of

PHOTOGRAPHS = 6
NOISE = 2.0  # grey values
LATTICE = (0.0, 105.0, 95.0)  # middle of the lattice of dots, mm
MOVED = (0.3, -0.2, 0.25)  # of the upper plate between the epochs, mm
TOP = [(0.0, y, 60.0) for y in (-38.0, -19.0, 0.0, 19.0, 38.0)]
FLOOR = [(x, y, 0.0) for x in (-185.0, -135.0, 105.0, 135.0, 185.0) for y in (-57.0, 57.0)]
POINTS = {f"corner {k}": np.array(xyz) for k, xyz in enumerate([*TOP, *FLOOR])}


@lru_cache
def pictures(moved: tuple[float, ...] = (0.0, 0.0, 0.0), *, dots: bool = False) -> tuple[AnyArray, ...]:
    """Render photographs of plates with coded targets on texture, the upper one moved, without noise.

    dots: a third plate, high above the floor, has a lattice of dots in place of texture.
    """
    scene, targets = plates(), plates().targets
    centre = scene.faces.centre + np.array([[0.0, 0.0, 0.0], moved])
    faces = replace(scene.faces, centre=centre, texture=np.full(2, 0.2), grain=np.full(2, 2.0))
    paper = [
        rectangles(face, xy[None], np.full((1, 2), 17.0 if face else 24.0), np.zeros(1), np.full(1, 0.8))
        for face, xy in zip(targets.face.tolist(), targets.centre, strict=True)
    ]
    if dots:
        faces = replace(
            faces,
            centre=np.vstack([faces.centre, LATTICE]),
            axes=np.concatenate([faces.axes, faces.axes[:1]]),
            half=np.vstack([faces.half, [45.0, 45.0]]),
            value=np.append(faces.value, 0.9),
            texture=np.append(faces.texture, 0.0),
            grain=np.append(faces.grain, 1.0),
        )
        places = lattice(range(-9, 10), range(-5, 6))
        places = places[np.abs(places).max(axis=1) < 40]
        paper.append(
            rectangles(
                2, places, np.full((len(places), 2), 2.0), np.zeros(len(places)), np.full(len(places), 0.15)
            )
        )
    scene = replace(scene, faces=faces, marks=join_marks([*paper, scene.marks]))
    found, _ = render_photographs(
        scene, camera(), *stations(PHOTOGRAPHS), optics=Optics(blur_px=0.7, exposure=0.9), seed=1
    )
    return tuple(found)


def lattice(columns: Iterable[int], rows: Iterable[int]) -> FloatArray:
    """Return places of a lattice of equal triangles of 8 mm, mm, (k, 2)."""
    return np.array([(8.0 * (a + b / 2), 4.0 * b * np.sqrt(3)) for b in rows for a in columns])


def write(
    folder: Path, marks: str, moved: tuple[float, ...] = (0.0, 0.0, 0.0), *, dots: bool = False
) -> Path:
    """Write photographs and their survey file with named points; return the file."""
    folder.mkdir()
    rng = seed_of(folder.name)
    for number, picture in enumerate(pictures(moved, dots=dots), 1):
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


def seen_in(number: int, xyz: FloatArray) -> FloatArray:
    """Return where a photograph shows a place, px, (2,)."""
    position, rotation = stations(PHOTOGRAPHS)
    return project(camera(), position[number - 1], rotation[number - 1], np.array([xyz]))[0]


def nearest(xyz: FloatArray) -> int:
    """Return the number of the nearest photograph that shows a place."""
    seen = np.array([seen_in(number, xyz) for number in range(1, PHOTOGRAPHS + 1)])
    inside = ((seen > 20) & (seen < np.array(SIZE_PX) - 20)).all(axis=1)
    away = np.linalg.norm(stations(PHOTOGRAPHS)[0] - xyz, axis=1)
    return 1 + int(np.argmin(np.where(inside, away, np.inf)))


def marks(points: Mapping[str, FloatArray] = POINTS, before: str = "") -> str:
    """Return named points, each in the nearest photograph that shows it."""
    numbers = {name: nearest(xyz) for name, xyz in points.items()}
    return "".join(mark(name, i, seen_in(i, points[name]), before) for name, i in numbers.items())


def placed(
    result: SurveyResult, points: Mapping[str, FloatArray] = POINTS
) -> tuple[list[str], FloatArray, FloatArray]:
    """Return the named points of a result in the frame of the truth, by the codes that did not move."""
    a, truth = result.adjustment, code_centres()
    names = list(a.network.points)
    fixed = [j for j, name in enumerate(names) if name.isdigit() and truth[int(name)][2] == 0]
    placing = fit_similarity(a.estimate.points[fixed], np.array([truth[int(names[j])] for j in fixed]))
    rows = [names.index(name) for name in points if name in names]
    R = placing.scale * placing.rotation
    covariance = np.einsum("ab,nbc,dc->nad", R, a.covariance.points[rows], R)
    return [names[j] for j in rows], placing.apply(a.estimate.points[rows]), covariance


def displacements(
    first: SurveyResult, later: SurveyResult, points: Mapping[str, FloatArray] = POINTS
) -> tuple[FloatArray, FloatArray]:
    """Return errors of displacements of named points, mm, and their covariance, in the datum of the codes.

    Each result has the datum of all its points, in which the named ones look 4 % more precise.
    """
    truth, placed_points, covariance = code_centres(), [], np.zeros(())
    known = set(first.adjustment.network.points) & set(later.adjustment.network.points)
    fixed = [str(code) for code, xyz in truth.items() if xyz[2] == 0 and str(code) in known]
    names = [*fixed, *(name for name in points if name in known)]
    for result in (first, later):
        a = result.adjustment
        xyz = a.estimate.points[[a.network.points.index(name) for name in names]]
        placing = fit_similarity(xyz[: len(fixed)], np.array([truth[int(name)] for name in fixed]))
        R = np.kron(np.eye(len(names)), placing.scale * placing.rotation)
        covariance = covariance + R @ a.solution.covariance_of(names) @ R.T
        placed_points.append(placing.apply(xyz))
    moved, covariance = in_datum(
        placed_points[1] - placed_points[0],
        covariance,
        motions(placed_points[0]),
        np.arange(len(names)) < len(fixed),
    )
    stated = np.array([MOVED if points[name][2] else (0.0, 0.0, 0.0) for name in names[len(fixed) :]])
    n = len(names)
    blocks = covariance.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)]
    return moved[len(fixed) :] - stated, blocks[len(fixed) :]


def test_named_points_are_found_and_found_again_in_a_later_epoch(tmp_path: Path) -> None:
    bar = '[[scale_bar]]\nfrom = "corner 5"\nto = "corner 14"\nlength = {length!r}\nsigma = 0.01\n'
    length = float(np.linalg.norm(POINTS["corner 5"] - POINTS["corner 14"]))
    first = run_survey(read_survey(write(tmp_path / "first", marks() + bar.format(length=length))))
    again = run_survey(read_survey(tmp_path / "first" / "survey.toml"))
    names, before, _ = placed(first)
    assert names == list(POINTS) and first.verdict.level != "bad" and len(first.network.scale_bars) == 1
    assert (placed(again)[1] == before).all()
    error = before - np.array([POINTS[name] for name in names])
    assert np.abs(error).max() < 0.05  # 0.06 px
    network = first.network
    assert [source.name for source in network.sources] == ["targets", "marks"]
    rays = np.bincount(network.image_points.point, minlength=len(network.points))
    assert min(rays[network.points.index(name)] for name in names) >= 3

    later = run_survey(
        read_survey(write(tmp_path / "later", marks(before="../first/"), MOVED), allow_outside=True)
    )
    assert placed(later)[0] == names
    difference, C = displacements(first, later)
    square = np.einsum("na,nab,nb->n", difference, np.linalg.inv(C), difference)
    # 12 of 15 or more, but for 0.5 % of draws
    assert (square < chi2_ppf(0.95, 3)).sum() >= 0.8 * len(names)
    assert 0.7 < np.sqrt(square.mean() / 3) < 1.4


@pytest.mark.slow
def test_displacements_lie_within_their_standard_deviations(tmp_path: Path) -> None:
    """Over 160 displacements, a root mean square of standardised errors scatters by about 0.04."""
    beside = [(x, y, 0.0) for x in (-160.0, -110.0) for y in (-30.0, 30.0)]
    further = [*beside, (120.0, -30.0, 0.0)]
    points = POINTS | {f"corner {15 + k}": np.array(xyz) for k, xyz in enumerate(further)}
    squares = []
    for seed in ("a57", "b57", "c57", "d57", "i57", "j57", "k57", "l57"):
        first = run_survey(read_survey(write(tmp_path / f"first {seed}", marks(points))))
        path = write(tmp_path / f"later {seed}", marks(points, f"../first {seed}/"), MOVED)
        later = run_survey(read_survey(path, allow_outside=True))
        difference, C = displacements(first, later, points)
        assert len(difference) == len(points)
        squares.append(np.einsum("na,nab,nb->n", difference, np.linalg.inv(C), difference))
    square = np.concatenate(squares)
    assert (square < chi2_ppf(0.95, 3)).mean() >= 0.9
    assert 0.85 < np.sqrt(square.mean() / 3) < 1.15


def test_a_point_of_an_earlier_epoch_that_is_marked_again_is_measured_once(tmp_path: Path) -> None:
    """The mark shows where it is now; the template stays that of the first epoch."""
    write(tmp_path / "first", marks())
    name = next(name for name, X in POINTS.items() if X[2])
    again = "".join(mark(name, i, seen_in(i, POINTS[name] + MOVED) + np.array((0.5, -0.4))) for i in (2, 3))
    text = marks({name: POINTS[name]}, "../first/") + again
    network = run_survey(read_survey(write(tmp_path / "later", text, MOVED), allow_outside=True)).network
    seen = network.image_points
    images = seen.image[seen.point == network.points.index(name)]
    assert len(images) == len(set(images.tolist())) >= 3


def test_a_place_that_nothing_matches_is_named(tmp_path: Path) -> None:
    beside = np.array([30.0, 30.0])  # where the photograph shows no plate
    result = run_survey(read_survey(write(tmp_path / "plain", mark("beside", 1, beside))))
    (said,) = [one for one in result.verdict.remarks if one.kind == "marks_unmatched"]
    assert said.names("points") == ("beside",) and "beside" not in result.network.points
    assert said.text == "1 named point was found in too few other photographs: beside."


def _candidates(at: list[list[float]], r: list[float]) -> _Matched:
    """Return candidates of a template with rays in photographs 0 to 2; the last was not stated."""
    n = len(at)
    image, point = np.tile(np.arange(3), n), np.repeat(np.arange(n), 3)
    xy = np.repeat(np.array(at), 3, axis=0)
    rays = ImagePoints(image, point, xy, np.tile(np.eye(2), (3 * n, 1, 1)))
    stated = np.arange(n) < n - 1
    return _Matched(
        np.zeros(n, dtype=int), ~stated, stated, np.zeros((n, 3)), rays, np.array(r), np.full(n, 3)
    )


def test_a_doubtful_point_is_where_it_was_marked_once() -> None:
    """A place is tried with two planes, which may lead to the same place."""
    pixels, levels = np.array([100.0]), Levels(0.05)
    rays, doubtful = _most_alike(
        _candidates([[50, 50], [50.1, 50], [90, 90]], [0.9, 0.89, 0.901]), pixels, levels
    )
    assert rays.image.tolist() == [0, 1, 2] and (rays.point == 0).all() and not len(doubtful)
    rays, doubtful = _most_alike(
        _candidates([[50, 50], [70, 50], [90, 90]], [0.9, 0.89, 0.901]), pixels, levels
    )
    assert not len(rays) and doubtful.tolist() == [0]


@pytest.mark.sweep(0)
@pytest.mark.parametrize("seed", range(8))
def test_a_point_on_a_repeated_pattern_is_not_measured_at_another_place(tmp_path: Path, seed: int) -> None:
    """Several depths of its ray look alike; a second mark, far from exact, decides between them."""
    rows = seed_of(f"dots {seed}").permutation(35)[:12]
    points = {
        f"dot {k}": np.array([*xy, 0.0]) + LATTICE
        for k, xy in enumerate(lattice(range(-2, 3), range(-3, 4))[rows])
    }
    text = marks(points)
    result = run_survey(read_survey(write(tmp_path / f"once {seed}", text, dots=True)))
    (said,) = [one for one in result.verdict.remarks if one.kind == "marks_unmatched"]
    assert "; several places look like dot " in said.text
    found, at, _ = placed(result, points)
    assert set(found).isdisjoint(said.names("points")) and len(found) < 0.2 * len(points)
    assert np.abs(at - np.array([points[name] for name in found]).reshape(-1, 3)).max(initial=0.0) < 0.1
    for name, xyz in points.items():
        second = 1 + nearest(xyz) % PHOTOGRAPHS
        text += mark(name, second, seen_in(second, xyz) + np.array((0.8, -0.6)))
    twice = run_survey(read_survey(write(tmp_path / f"twice {seed}", text, dots=True)))
    found, placed_at, _ = placed(twice, points)
    assert set(found) == set(points) and twice.verdict.level != "bad"
    assert max(np.abs(placed_at - np.array([points[name] for name in found])).max(axis=1)) < 0.1


@pytest.mark.sweep(0, 3)
@pytest.mark.parametrize("off", [(40.0, 25.0), (8.0, 5.0), (4.0, 0.0), (1.0, -0.5)])
def test_a_mark_beside_its_point_is_named_and_left_out(tmp_path: Path, off: tuple[float, float]) -> None:
    name, xyz = next(iter(POINTS.items()))
    other = 1 + nearest(xyz) % PHOTOGRAPHS
    text = marks() + mark(name, other, seen_in(other, xyz) + off)
    result = run_survey(read_survey(write(tmp_path / "beside", text)))
    contradicting = [one for one in result.verdict.remarks if one.kind == "image_points_contradicting"]
    wrong = [f"{name} in photo {other}.png"] if np.hypot(*off) > 2 else []
    assert [one.names("image_points") for one in contradicting] == [(one,) for one in wrong]
    assert [one.point for one in result.left_out] == wrong
    found, at, _ = placed(result)
    assert found == list(POINTS)
    assert np.abs(at - np.array(list(POINTS.values()))).max() < 0.06


def test_the_first_mark_in_an_oriented_photograph_is_the_template(tmp_path: Path) -> None:
    name, xyz = next(iter(POINTS.items()))
    text = mark(name, PHOTOGRAPHS + 1, np.array([200.0, 150.0])) + marks({name: xyz})
    path = write(tmp_path / "unoriented", text)
    nothing = seed_of("nothing").integers(0, 255, SIZE_PX[::-1], dtype=np.uint8)
    cv2.imwrite(str(path.parent / f"photo {PHOTOGRAPHS + 1}.png"), nothing)
    result = run_survey(read_survey(path))
    _, at, _ = placed(result, {name: xyz})
    assert np.abs(at - xyz).max() < 0.06


def test_where_most_marks_contradict_the_template_they_are_the_point(tmp_path: Path) -> None:
    name, xyz = next(iter(POINTS.items()))
    first = nearest(xyz)
    others = [number for number in range(1, PHOTOGRAPHS + 1) if number != first][:4]
    text = mark(name, first, seen_in(first, xyz) + np.array((14.0, 3.0)))
    text += "".join(mark(name, i, seen_in(i, xyz) + np.array((0.3, -0.4))) for i in others)
    result = run_survey(read_survey(write(tmp_path / "template", text)))
    _, at, _ = placed(result, {name: xyz})
    assert np.abs(at - xyz).max() < 1.0  # as the marks are
    (said,) = [one for one in result.verdict.remarks if one.kind == "image_points_contradicting"]
    assert said.names("image_points") == (f"{name} in photo {first}.png",)
    assert not any(one.kind == "marks_unmatched" for one in result.verdict.remarks)


def test_a_table_that_contradicts_a_named_point_is_named(tmp_path: Path) -> None:
    """Only once the point is matched in further photographs do they have common image points."""
    name, xyz = next(iter(POINTS.items()))
    others = [number for number in range(1, PHOTOGRAPHS + 1) if number != nearest(xyz)]
    path = write(tmp_path / "table", '[[observations]]\nfile = "given.csv"\n' + marks())
    rows = [
        f"photo {i}.png,{name},{x!r},{y!r}"
        for i in others
        for x, y in [(seen_in(i, xyz) + (12.0 if i == others[0] else 0.05)).tolist()]
    ]
    (path.parent / "given.csv").write_text("\n".join(["image,point,x_px,y_px", *rows, ""]), "utf-8")
    result = run_survey(read_survey(path))
    (said,) = [one for one in result.verdict.remarks if one.kind == "image_points_contradicting"]
    assert said.names("image_points") == (f"{name} in photo {others[0]}.png",)
    _, at, _ = placed(result, {name: xyz})
    assert np.abs(at - xyz).max() < 0.2


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
