"""The camcal photographs in two halves, a scale bar each: one object, compared without an option.

Uncoded points are numbered anew in either half, so that names say nothing, and the bars differ.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sfm
from adapters.formats.registry import format_named, read_comparable, write_any
from sfm.comparison.camera_conversion import convert_cameras
from sfm.comparison.significance import compare_results
from sfm.comparison.undistortion import undistort
from sfm.pipeline import run_survey
from sfm.report.differences import words_of_pairing, words_of_scale, words_of_test
from sfm.survey.inputs.given import ScaleBar
from sfm.survey.inputs.survey import Survey
from sfm.survey.measuring.target_store import TargetStore
from tests.places import DATASETS, SHARED

CAMCAL = SHARED / "data" / "camcal" / "images"
SIGMA = 2e-4  # of a bar, m

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not CAMCAL.is_dir(), reason="the camcal photographs are not here"),
]


def half(images: list[str], bar: ScaleBar | None) -> Survey:
    survey = sfm.read_survey(DATASETS / "camcal/survey.toml")
    camera = survey.cameras[0].model_copy(update={"images": tuple(images)})
    bars = () if bar is None else (bar,)
    return replace(survey, cameras=(camera,), scale_bars=bars, control=None)


@pytest.fixture(scope="module")
def halves(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    names = sorted(path.name for path in CAMCAL.glob("*.JPG"))
    survey = sfm.read_survey(DATASETS / "camcal/survey.toml")
    assert survey.control is not None
    xyz = dict(zip(survey.control.names, survey.control.xyz, strict=True))
    folders = []
    for number, (start, end) in enumerate((("1", "2"), ("3", "4"))):
        folder = tmp_path_factory.mktemp("camcal") / f"half {number}"
        bar = ScaleBar(start, end, float(np.linalg.norm(xyz[start] - xyz[end])), SIGMA)
        result = run_survey(half(names[number::2], bar), images_dir=CAMCAL, store=TargetStore.of_user())
        result.write(folder)
        folders.append(folder)
    return folders[0], folders[1]


def test_halves_are_compared_by_what_they_are(halves: tuple[Path, Path]) -> None:
    first, second = (read_comparable(folder, None) for folder in halves)
    found = compare_results(first, second, align="points", control=())
    print(words_of_pairing(found), words_of_scale(found), words_of_test(found), sep="\n")
    assert len(found.points) >= 90
    length = np.linalg.norm(np.asarray(found.point_difference), axis=1)
    assert length.max() < 2e-3  # m; with the numbers of uncoded points as names it was 0.88 m


@pytest.mark.parametrize("form", ["colmap-text", "bal", "sba"])
def test_a_result_is_its_own_model_in_other_formats(
    halves: tuple[Path, Path], form: str, tmp_path: Path
) -> None:
    first = read_comparable(halves[0], None)
    kind = format_named(form)
    network, estimate = first.network, first.estimate
    if kind.straight or kind.lacks:
        network, estimate = undistort(network, estimate, kind.models)
    if kind.models:
        estimate, _ = convert_cameras(estimate, kind.models, held=kind.lacks)
    target = tmp_path / ("model.txt" if form == "bal" else "model")
    write_any(target, form, network, estimate)
    found = compare_results(first, read_comparable(target, form), align="points", control=())
    print(form, words_of_pairing(found), words_of_test(found), sep="\n")
    assert len(found.points) == len(first.network.points)
    length = np.linalg.norm(np.asarray(found.point_difference), axis=1)
    assert length.max() < 1e-6
