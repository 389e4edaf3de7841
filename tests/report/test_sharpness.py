"""Photographs that are blurred beside the others: found by the edges of targets, seldom by chance."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sfm.adjustment.quality.consistency import Consistency, Uneven
from sfm.adjustment.solve import adjust
from sfm.conventions import FloatArray
from sfm.remarks.remark import remark
from sfm.report.findings.camera_remarks import edges_of, larger_than_the_others, sharpness_remarks
from sfm.result import FailedImage, PhotographTargets, SurveyResult
from tests.synthetic import make_network, seed_of


def photograph(name: str, blur: FloatArray | None, camera: str = "A") -> PhotographTargets:
    k = 0 if blur is None else len(blur)
    none = np.zeros(0, dtype=np.int64)
    return PhotographTargets(
        name,
        Path(name),
        np.zeros((k, 2)),
        np.ones((k, 2)),
        np.zeros(k),
        np.zeros((0, 2)),
        none,
        blur=blur,
        camera=camera,
    )


@pytest.mark.parametrize("count", [5, 8, 20, 60])
def test_chance_calls_one_survey_in_a_hundred_blurred(count: int) -> None:
    rng = seed_of("sharp")
    surveys = [larger_than_the_others(rng.normal(0, 0.1, count)).any() for _ in range(1500)]
    assert 0.003 < np.mean(surveys) < 0.025


@pytest.mark.parametrize("blurred", [1, 2, 3])
def test_a_few_blurred_photographs_do_not_hide_one_another(blurred: int) -> None:
    values = np.log(0.8) + seed_of("blurred").normal(0, 0.05, 12)
    values[:blurred] += np.log(2)
    assert np.flatnonzero(larger_than_the_others(values)).tolist() == list(range(blurred))


@pytest.mark.parametrize("values", [[], [1.0], [1.0, 9.0], [1.0, 1.0, 1.0, 1.0]])
def test_too_few_or_equal_values_have_no_outlier(values: list[float]) -> None:
    assert not larger_than_the_others(np.array(values)).any()


def test_blurred_photographs_are_named_where_that_explains_something() -> None:
    network, truth = make_network(seed_of("sharpness"), images=6, points=12)
    rng = seed_of("edges")
    sharp = [photograph(f"image {k}", 0.8 * np.exp(rng.normal(0, 0.03, 12))) for k in range(1, 7)]
    soft = [photograph(name, np.append(np.full(9, 2.0), np.nan)) for name in ("lost", "uneven", "no harm")]
    shown = (*sharp, *soft, photograph("crossings", np.full(4, np.nan)), photograph("none", None))
    edges = edges_of(shown)
    assert edges["lost"] == 2.0 and not {"crossings", "none"} & set(edges)
    failed = (FailedImage("lost", remark("photograph_with_few_points", seen=1, needed=4)),)
    solved = adjust(network, truth)
    result = SurveyResult("sharpness", "m", 7, failed, solved, np.full(12, -1), None, photographs=shown)
    uneven = Consistency((), Uneven(1e-6, "uneven", 2.0, 1.0))
    (said,) = sharpness_remarks(result, edges, uneven)
    assert said.kind == "photographs_blurred" and said.severity == "note"
    assert said.names("photographs") == ("lost", "uneven")
    assert said.number("blur") == 2.0 and said.number("others") == pytest.approx(0.8, rel=0.05)
    assert sharpness_remarks(replace(result, failed=()), edges, Consistency((), None)) == ()
    seen = network.image_points
    hidden = adjust(replace(network, image_points=seen.select((seen.image > 0) | (seen.point < 6))), truth)
    few = replace(result, failed=(), adjustment=hidden)
    (said,) = sharpness_remarks(few, edges | {"image 1": 1.9}, Consistency((), None))
    assert said.names("photographs") == ("image 1",)


def test_photographs_are_compared_with_those_of_their_camera() -> None:
    """Edges of a camera of larger pixels or a longer lens are softer in px, and none of its is blurred."""
    network, truth = make_network(seed_of("sharpness"), images=6, points=12)
    rng = seed_of("two cameras")
    edges = {f"A {k}": 0.8 for k in range(12)} | {f"B {k}": 1.6 for k in range(5)}
    few = remark("photograph_with_few_points", seen=1, needed=4)
    lost = tuple(FailedImage(name, few) for name in ("B 0", "B 1"))
    solved = adjust(network, truth)
    for blur, named in ((1.6, ()), (4.0, ("B 0",))):
        edges["B 0"] = blur
        shown = tuple(
            photograph(name, one * np.exp(rng.normal(0, 0.03, 12)), name[0]) for name, one in edges.items()
        )
        result = SurveyResult("both", "m", 17, lost, solved, np.full(12, -1), None, photographs=shown)
        said = sharpness_remarks(result, edges_of(shown), Consistency((), None))
        assert tuple(name for one in said for name in one.names("photographs")) == named
    assert said[0].names("camera") == ("B",)
    assert said[0].number("others") == pytest.approx(1.6, rel=0.05)
