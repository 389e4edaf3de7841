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
from sfm.comparison.camera_conversion import convert_cameras, undistort
from sfm.comparison.comparison_remarks import verdict_of_comparison
from sfm.comparison.significance import compare_results
from sfm.model.remarks.remark import kinds_of
from sfm.pipeline import run_survey
from sfm.survey.inputs.given_values import ScaleBar
from sfm.survey.inputs.survey import Survey
from sfm.survey.measuring.measured_store import MeasuredStore
from tests.places import DATASETS, SHARED

CAMCAL = SHARED / "data" / "camcal" / "images"
SIGMA = 2e-4  # of a bar, m

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not CAMCAL.is_dir(), reason="the camcal photographs are not here"),
]


def half(images: list[str], bar: ScaleBar | None, own: tuple[str, ...] = ()) -> Survey:
    survey = sfm.read_survey(DATASETS / "camcal/survey.toml")
    camera = survey.cameras[0].model_copy(update={"images": tuple(images), "per_photograph": own})
    bars = () if bar is None else (bar,)
    return replace(survey, cameras=(camera,), scale_bars=bars, control=None)


def written_halves(parent: Path, own: tuple[str, ...] = ()) -> tuple[Path, Path]:
    names = sorted(path.name for path in CAMCAL.glob("*.JPG"))
    survey = sfm.read_survey(DATASETS / "camcal/survey.toml")
    assert survey.control is not None
    xyz = dict(zip(survey.control.names, survey.control.xyz, strict=True))
    folders = []
    for number, (start, end) in enumerate((("1", "2"), ("3", "4"))):
        bar = ScaleBar(start, end, float(np.linalg.norm(xyz[start] - xyz[end])), SIGMA)
        store = MeasuredStore.of_user()
        result = run_survey(half(names[number::2], bar, own), images_dir=CAMCAL, store=store)
        folders.append(parent / f"half {number}")
        result.write(folders[-1])
    return folders[0], folders[1]


@pytest.fixture(scope="module")
def halves(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return written_halves(tmp_path_factory.mktemp("camcal"))


def test_halves_are_compared_by_what_they_are(halves: tuple[Path, Path]) -> None:
    first, second = (read_comparable(folder, None) for folder in halves)
    found = compare_results(first, second, align="points", control=())
    assert len(found.points) >= 90
    length = np.linalg.norm(np.asarray(found.point_difference), axis=1)
    assert length.max() < 2e-3  # m; with the numbers of uncoded points as names it was 0.88 m
    verdict = verdict_of_comparison(found)
    print(*verdict.lines, sep="\n")
    assert {"bent", "interior_differs"} <= set(kinds_of(verdict.remarks))


def test_halves_agree_where_each_photograph_has_a_lens_of_its_own(tmp_path: Path) -> None:
    """The difference of the halves is the motion of the zoom lens between the exposures."""
    folders = written_halves(tmp_path, ("c", "x0", "y0"))
    found = compare_results(*(read_comparable(folder, None) for folder in folders))
    print(
        *verdict_of_comparison(found).lines,
        f"{found.global_statistic:.3f}, critical {found.global_critical:.3f}",
    )
    assert found.stable.sum() >= 95 and found.global_statistic < 1.5
    assert np.sqrt((found.point_difference**2).mean()) < 1.5 * np.sqrt((found.point_sigma**2).mean())


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
    assert len(found.points) == len(first.network.points)
    if form != "colmap-text":
        assert found.pairing.points_by_image_points == len(found.points)
    assert found.same_share > 0.99 and found.images == first.network.images
    length = np.linalg.norm(np.asarray(found.point_difference), axis=1)
    assert length.max() < 1e-6
