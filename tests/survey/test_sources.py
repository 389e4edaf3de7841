"""Several sources of image points in one survey: targets and texture, and a source of one's own."""

from __future__ import annotations

import re
import sys
import weakref
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from sfm.judgement.survey_result import SurveyResult
from sfm.library.results import read_result
from sfm.library.surveys import write_result
from sfm.model.camera import project
from sfm.model.conventions import AnyArray
from sfm.model.network import ImagePoints, Source
from sfm.model.similarity import fit_similarity
from sfm.photographs import reading
from sfm.photographs.reading import read_photograph
from sfm.pipeline import run_survey
from sfm.products.rendering.render import render_photographs
from sfm.products.rendering.scene import Optics, join_marks, rectangles
from sfm.runtime.progress import SILENT, StageClock
from sfm.survey.inputs import sources
from sfm.survey.inputs.measurements import Measurements, find_photographs
from sfm.survey.inputs.sources import Declared, declared
from sfm.survey.inputs.survey import Survey, read_survey
from sfm.survey.measuring.measured_store import MeasuredStore
from sfm.survey.sources.joined import _measure_each, measure_sources
from sfm.survey.sources.repeated import OfOneSource, without_repeated
from sfm.survey.sources.source import SurveySource, complete_as_measured
from sfm.survey.target_network import measure_targets
from sfm.targets.detect import find_targets
from tests.places import ROOT
from tests.surveys import SURVEY, camera, code_centres, plates, stations, survey_of
from tests.synthetic import make_network, seed_of

NOISE = 2.0  # grey values
SWITCH = re.compile(
    r"\.tie_points\b(?: is (?:not )?None|:| and| or)|\.observations is (?:not )?None"
    r"|if (?:not )?survey\.tie_points"
)


@lru_cache
def pictures() -> tuple[AnyArray, ...]:
    """Render photographs of plates with coded targets on texture, without noise."""
    scene = plates()
    faces, targets = replace(scene.faces, texture=np.full(2, 0.2), grain=np.full(2, 2.0)), scene.targets
    paper = [  # without texture, which would move the centres of printed dots
        rectangles(face, xy[None], np.full((1, 2), 24.0), np.zeros(1), np.full(1, 0.8))
        for face, xy in zip(targets.face.tolist(), targets.centre, strict=True)
    ]
    scene = replace(scene, faces=faces, marks=join_marks([*paper, scene.marks]))
    position, rotation = stations(6)
    optics = Optics(blur_px=0.7, exposure=0.9)
    found, _ = render_photographs(scene, camera(), position, rotation, optics=optics, seed=1)
    return tuple(found)


def write(folder: Path, more: str = "", codes: str = "ring14") -> Path:
    """Write photographs and their survey file, with further tables; return the file."""
    rng = seed_of("sources")
    for number, picture in enumerate(pictures(), 1):
        noisy = np.rint(picture + NOISE * rng.standard_normal(picture.shape))
        grey = np.clip(noisy, 0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / f"photo {number}.png"), grey, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    text = SURVEY.format(name="sources", backend="none").replace("ring14", codes)
    path = folder / "survey.toml"
    path.write_text(text + more, "utf-8")
    return path


def error_of_codes(result: SurveyResult) -> float:
    """Return the root mean square of errors of coded targets over their standard deviations."""
    a, truth = result.adjustment, code_centres()
    rows = [j for j, name in enumerate(a.network.points) if name.isdigit()]
    X = np.array([truth[int(a.network.points[j])] for j in rows])
    placing = fit_similarity(a.estimate.points[rows], X)
    error = placing.apply(a.estimate.points[rows]) - X
    variance = placing.scale**2 * np.einsum("nii->n", a.covariance.points[rows])
    return float(np.sqrt((error**2).sum() / variance.sum()))


def test_targets_and_texture_are_one_survey(tmp_path: Path) -> None:
    both = run_survey(read_survey(write(tmp_path, "[tie_points]\n")))
    alone = run_survey(read_survey(write(tmp_path)))
    network = both.adjustment.network
    assert [source.name for source in network.sources] == ["targets", "texture"]
    named = set(np.array(network.points)[network.named])
    assert named == set(alone.adjustment.network.points)
    assert (network.source[network.named[network.image_points.point]] == 0).all()
    assert len(network.points) > 3 * len(named)
    assert both.verdict.level != "bad" and len(network.images) == 6
    assert 0.6 < error_of_codes(both) < 1.4
    assert (network.may_correlate == (network.source == 1)).all()
    seen, texture = network.image_points, network.source == 1
    for i in range(6):  # windows are beside the rings of targets
        rows, near = (np.flatnonzero((seen.image == i) & of) for of in (texture, ~texture))
        between = seen.xy[rows][:, None] - seen.xy[near][None]
        assert np.abs(between).max(axis=2).min() > 12
    tables = dict(both.settings)
    assert "targets" in tables and "tie_points" in tables
    (first, *_) = both.photographs
    assert len(first.xy) > len(alone.photographs[0].xy)


def paint_over(folder: Path, photographs: range, shown: list[int]) -> None:
    """Paint over the coded targets of photographs, counted from 1, except those shown."""
    for i, (at, R) in enumerate(zip(*stations(6), strict=True), 1):
        if i not in photographs:
            continue
        picture = cv2.imread(str(folder / f"photo {i}.png"), cv2.IMREAD_GRAYSCALE)
        for code, X in code_centres().items():
            if code not in shown:
                x, y = project(camera(), at, R, X[None])[0]
                cv2.circle(picture, (round(x), round(y)), 32, 110, -1)
        cv2.imwrite(str(folder / f"photo {i}.png"), picture)


def test_targets_too_few_to_orient_anything_stand_beside_texture(tmp_path: Path) -> None:
    """Two targets in each photograph: texture orients the photographs, and the targets are points of it."""
    path, shown = write(tmp_path, "[tie_points]\n"), sorted(code_centres())[:2]
    paint_over(tmp_path, range(1, 7), shown)
    result = run_survey(read_survey(path))
    network = result.adjustment.network
    assert len(network.images) == 6 and result.adjustment.estimate.oriented.all()
    assert set(map(str, shown)) <= set(network.points)
    rows = [network.points.index(str(code)) for code in shown]
    assert (network.rays()[rows] >= 3).all() and (network.source == 1).sum() > 500


def test_photographs_that_texture_orients_keep_their_few_targets(tmp_path: Path) -> None:
    """Fewer targets than orient a photograph took no part where other photographs showed enough of them."""
    path = write(tmp_path, "[tie_points]\n")
    paint_over(tmp_path, range(4, 7), sorted(code_centres())[::7])
    result = run_survey(read_survey(path))
    network = result.adjustment.network
    assert len(network.images) == 6 and result.adjustment.estimate.oriented.all()
    seen = network.image_points
    few = 0
    for i, name in enumerate(network.images):
        code = find_targets(read_photograph(tmp_path / name), codes="ring14").code
        read = set(map(str, code[code >= 0].tolist()))
        if 0 < len(read) < 4:
            few += 1
            assert read <= {network.points[j] for j in seen.point[seen.image == i].tolist()}
    assert few == 3


def test_photographs_are_decoded_as_often_as_for_one_source(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All sources measure a photograph while it is in memory, which has one at a time."""
    decode, read, alive = reading._decode, list[str](), list[weakref.ref[AnyArray]]()
    most = 0

    def counted(path: Path, channel: str, **rest: bool) -> AnyArray:
        nonlocal most
        picture = decode(path, channel, **rest)
        read.append(path.name)
        alive.append(weakref.ref(picture))
        most = max(most, sum(one() is not None for one in alive))
        return picture

    def decoded(codes: str) -> list[str]:
        read.clear()
        survey = read_survey(write(tmp_path, "[tie_points]\n", codes))
        measure_sources(survey, find_photographs(survey), jobs=1, store=None, clock=StageClock(SILENT))
        return sorted(read)

    monkeypatch.setattr(reading, "_decode", counted)
    assert decoded("ring14") == decoded("none")
    survey, store = read_survey(write(tmp_path, "[tie_points]\n")), MeasuredStore(None)
    files = find_photographs(survey)
    read.clear()
    most = 0
    _measure_each(survey, files, jobs=1, store=store, progress=SILENT)
    assert read == list(files.names) and most == 1
    measure_targets(survey, files, store=store)
    assert len(read) == 6 and store.folder is None


CORNERS = {"corner a": (-90.0, -60.0, 0.0), "corner b": (90.0, 70.0, 0.0), "u001": (-80.0, 80.0, 0.0)}


def write_given(path: Path, xyz: dict[str, tuple[float, ...]], off_px: float = 0.0) -> None:
    """Write image points with a noise of 0.2 px, all off by the same vector."""
    position, rotation = stations(6)
    noise = seed_of(path.name)
    lines = ["image,point,x_px,y_px"]
    for name, X in xyz.items():
        for i in range(6):
            exact = project(camera(), position[i], rotation[i], np.array([X]))[0]
            x, y = (exact + off_px + 0.2 * noise.standard_normal(2)).tolist()
            lines.append(f"photo {i + 1}.png,{name},{x},{y}")
    path.write_text("\n".join(lines) + "\n", "utf-8")


@pytest.mark.parametrize("by_hand", ["a3.csv", "g.csv"])  # of these seeds, rejection lost right image points
def test_given_image_points_stand_beside_targets(tmp_path: Path, by_hand: str) -> None:
    """Corners by hand, and those of codes by a program that counts pixels from their corners."""
    codes = {str(code): tuple(X.tolist()) for code, X in code_centres().items()}
    write_given(tmp_path / by_hand, CORNERS)
    write_given(tmp_path / "codes.csv", codes, off_px=0.5)
    more = f'[[observations]]\nfile = "{by_hand}"\nsigma_px = 0.2\n[[observations]]\nfile = "codes.csv"\n'
    result = run_survey(read_survey(write(tmp_path, more)))
    alone = run_survey(read_survey(write(tmp_path)))
    a, b = result.adjustment, alone.adjustment
    network = a.network
    assert [one.name for one in network.sources] == ["targets", "given"]
    (offset,) = [one for one in result.verdict.remarks if one.kind == "sources_contradict"]
    assert offset.numbers["x"].value == pytest.approx(0.5, abs=0.1)
    # given image points of codes are left out where the code was measured, and in no place twice
    seen, seen_alone = (
        [(n.images[i], n.points[j]) for i, j in zip(n.image_points.image, n.image_points.point, strict=True)]
        for n in (network, b.network)
    )
    source = dict(zip(seen, network.source.tolist(), strict=True))
    assert len(source) == len(seen) and not any(source[key] for key in seen_alone)
    common = [name for name in b.network.points if name in codes]
    here = [network.points.index(name) for name in (*common, *CORNERS)]
    there = [b.network.points.index(name) for name in common]
    truth = np.array([*(codes[name] for name in common), *CORNERS.values()])
    placing = fit_similarity(a.estimate.points[here][: len(common)], truth[: len(common)])
    sigma = placing.scale * np.sqrt(np.einsum("nii->ni", a.covariance.points[here]))
    error = (placing.apply(a.estimate.points[here]) - truth)[len(common) :]
    assert np.abs(error / sigma[len(common) :]).max() < 4
    before = fit_similarity(b.estimate.points[there], truth[: len(common)]).apply(b.estimate.points[there])
    moved = before - placing.apply(a.estimate.points[here])[: len(common)]
    assert np.abs(moved).max() < 3 * sigma[: len(common)].max()
    # the corner that has the number of an uncoded target is another point
    assert network.source[network.image_points.point == network.points.index("u001")].tolist() == [1] * 6
    assert 0.15 < a.sigma_of_sources[1] < 0.5  # few of its image points are off by 0.5 px
    folder = tmp_path / "out"
    write_result(result, folder)
    read = read_result(folder)
    assert [one.name for one in read.network.sources] == ["targets", "given"]
    kept = network.image_points.select(~a.rejected)
    assert (read.network.source == kept.source).all()
    rows = (folder / "residuals.csv").read_text("utf-8").splitlines()
    assert [row.split(",")[:2] for row in rows[1:3]] == [["source", "targets"], ["source", "given"]]


def test_what_two_sources_measure_is_used_once() -> None:
    rng, n = seed_of("two sources"), 30
    image, point = np.arange(n) % 5, np.arange(n)
    xy = rng.uniform(0, 1000, (n, 2))
    sources = (Source("first"), Source("second"))

    def both(noise_px: float, stated_px: float, wrong_px: float = 0.0) -> OfOneSource:
        other = xy + noise_px * rng.standard_normal((n, 2))
        other[3] += wrong_px
        sigma = np.full((n, 1, 1), stated_px**2) * np.eye(2)
        parts = [
            ImagePoints(image, point, seen, sigma, source=np.full(n, k)) for k, seen in enumerate((xy, other))
        ]
        return without_repeated(ImagePoints.joined(parts), sources)

    agreeing = both(0.1, 0.1)
    assert (agreeing.image_points.xy == xy).all() and not agreeing.contradicting and not agreeing.remarks
    assert not both(1.0, 0.1).contradicting  # sigmas that are too small contradict nothing
    (said,) = both(300.0, 0.1).remarks  # other names
    assert said.kind == "sources_contradict" and said.severity == "error"
    wrong = both(0.1, 0.1, wrong_px=5.0)
    assert wrong.contradicting == ((3, 3),) and len(wrong.image_points) == n - 1


def test_no_module_asks_which_source_a_survey_has() -> None:
    asking = [
        f"{path.relative_to(ROOT)}:{number}"
        for path in (ROOT / "sfm").rglob("*.py")
        if "sources" not in path.parts
        for number, line in enumerate(path.read_text("utf-8").splitlines(), 1)
        if SWITCH.search(line)
    ]
    assert asking == []


def test_a_new_source_is_one_module_and_one_row(monkeypatch: pytest.MonkeyPatch) -> None:
    """Image points that every survey of the test has beside its own, whose points have no lasting names."""
    network, truth = make_network(seed_of("a source"), images=6, points=40, free=("c",))
    seen = network.image_points
    first = replace(network, image_points=seen.select(seen.point < 25))
    second = replace(network, image_points=seen.select(seen.point >= 25))

    def measure(survey: Survey, files: object, **_: object) -> Measurements:
        points = tuple(f"s{name}" for name in second.points)
        return Measurements(
            replace(second, points=points), truth.cameras, second.images, np.full(len(points), 2)
        )

    row = Declared(Source("sensor", names_last=False), "name", "[sensor]", lambda _: "a sensor")
    beside = tuple(replace(other, is_alone=lambda settings: False) for other in sources.ROWS)
    monkeypatch.setattr(sources, "ROWS", (*beside, row))
    module = SimpleNamespace(SOURCE=SurveySource(measure, complete_as_measured))  # type: ignore[arg-type]
    monkeypatch.setitem(sys.modules, "sfm.survey.sources.sensor", module)  # type: ignore[arg-type]
    survey = survey_of(first, truth)
    assert [one.source.name for one in declared(survey)] == ["given", "sensor"]
    result = run_survey(survey)
    joined = result.adjustment.network
    assert {name for name, named in zip(joined.points, joined.named, strict=True) if not named} == {
        f"s{j + 1}" for j in range(25, 40)
    }
    assert len(joined.points) == 40 and result.verdict.level == "good"
