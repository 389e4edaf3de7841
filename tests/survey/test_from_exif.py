"""EXIF data as observations: positions as projection centres, times as moments of rigs."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import ExifTags, Image

from sfm.judgement.survey_result import SurveyResult
from sfm.model.conventions import FloatArray
from sfm.model.errors import GeometryError, SurveyFileError
from sfm.model.remarks.remark import kinds_of, of_kind
from sfm.pipeline import run_survey
from sfm.survey.inputs.from_exif import moments_from_exif, observed_positions, plausible_positions
from sfm.survey.inputs.measurements import find_photographs
from sfm.survey.inputs.settings import RigSettings
from sfm.survey.inputs.survey import CameraSetup, Survey, read_survey
from tests.satellite import at, state_position
from tests.survey.test_exterior import written
from tests.surveys import stations, write_photograph_survey
from tests.synthetic import seed_of

SIGMA_M = (0.02, 0.04)  # of the positions of the synthetic networks, of some 7 m


def test_photographs_with_positions_are_placed_by_them(tmp_path: Path) -> None:
    path = write_photograph_survey(tmp_path / "placed", "positions in photographs")
    truth = stations(6)[0] - [0.0, 0.0, 900.0]  # mm; heights below sea level
    error = 0.5 * seed_of("errors of positions").standard_normal(truth.shape)
    for k, place in enumerate(1e-3 * (truth + error), 1):
        if k != 4:  # which states none
            state_position(path.parent / f"photo {k}.png", at(*place.tolist()))
    asked = path.read_text() + "[exterior]\nexif_sigma_m = [0.0005, 0.0005]\n"
    path.write_text(asked + '[datum]\nkind = "control"\n', encoding="utf-8")
    result = run_survey(read_survey(path))
    a = result.adjustment
    assert a.datum == "control" and len(a.network.images) == 6
    (found,) = of_kind(result.tests, "exif_positions")
    assert (found.number("positions"), found.number("photographs")) == (5, 6)
    assert (found.number("latitude"), abs(found.number("longitude"))) == (0, 180)
    assert np.abs(a.estimate.position - truth).max() < 5 * 0.5  # with the axes: east, north, up
    # without being asked for, they give nothing
    path.write_text(asked + '[datum]\nkind = "free"\n', encoding="utf-8")
    free = run_survey(read_survey(path))
    assert "exterior_unused" in kinds_of(free.remarks)
    assert free.adjustment.datum == "free" and not len(free.adjustment.network.exterior)


def run_with(
    folder: Path,
    name: str,
    change: Callable[[FloatArray], FloatArray],
    sigma_m: tuple[float, float] = SIGMA_M,
) -> tuple[SurveyResult, FloatArray]:
    """Return the result with changed positions, and the true projection centres."""
    path, truth = written(folder, name)
    noise = seed_of(name).standard_normal(truth.position.shape) * [SIGMA_M[0], SIGMA_M[0], SIGMA_M[1]]
    places = change(truth.position + noise)
    named = {f"image {k + 1}": at(*one) for k, one in enumerate(places.tolist()) if np.isfinite(one[0])}
    _, exterior = observed_positions(plausible_positions(named), sigma_m, "m")
    return run_survey(replace(read_survey(path), exterior=exterior)), truth.position


@pytest.mark.sweep(0, 2)
@pytest.mark.parametrize("off", [100.0, 50_000.0, 3e6])
def test_one_photograph_far_off_is_left_out(tmp_path: Path, off: float) -> None:
    def change(places: FloatArray) -> FloatArray:
        places[2, 0] += off
        return places

    result, truth = run_with(tmp_path, f"off by {off:g}", change)
    left = of_kind(result.remarks, "given_left_out")
    assert [one.names("given") for one in left] == ([("image 3",)] if off < 1e5 else [])
    assert len(result.adjustment.network.exterior) == 7
    assert np.abs(result.adjustment.estimate.position - truth).max() < 0.1


@pytest.mark.parametrize(
    ("name", "missing", "used", "heights", "within"),
    [
        ("half of them", np.s_[::2], 4, 4, 0.1),
        ("three heights", np.s_[3:, 2], 8, 3, 0.2),
    ],
)
def test_positions_and_heights_may_be_missing(
    tmp_path: Path, name: str, missing: Any, used: int, heights: int, within: float
) -> None:
    def change(places: FloatArray) -> FloatArray:
        places[missing] = np.nan
        return places

    result, truth = run_with(tmp_path, name, change)
    exterior = result.adjustment.network.exterior
    assert len(exterior) == used and np.isfinite(exterior.covariance[:, 2, 2]).sum() == heights
    assert np.abs(result.adjustment.estimate.position - truth).max() < within


def test_positions_that_do_not_differ_give_no_datum(tmp_path: Path) -> None:
    def same(places: FloatArray) -> FloatArray:
        return np.tile(places[:1], (len(places), 1))

    extents = r"8 places .*, (all the same|of RMS extents 0\.0 and 0\.0 standard deviations), "
    with pytest.raises(GeometryError, match=extents):
        run_with(tmp_path, "same", same)


def test_positions_of_a_telephone_at_a_close_range_give_no_datum(tmp_path: Path) -> None:
    """The error says how far apart they are in standard deviations, of 7.1 m, and what is needed."""
    with pytest.raises(GeometryError) as refused:
        run_with(tmp_path, "same", lambda places: places, (5.0, 10.0))
    said = re.search(r"extents (\S+) and (\S+) standard deviations, needed 3 in both", str(refused.value))
    assert said is not None
    places = written(tmp_path, "same")[1].position
    extents = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)[:2] / np.sqrt(len(places) * 50)
    np.testing.assert_allclose([float(one) for one in said.groups()], extents, atol=0.06)


def test_stated_standard_deviations_go_before_those_of_the_survey() -> None:
    named = {"a": at(0, 0, 5, (0.01, 0.02, np.nan)), "b": at(10, 0, 5), "c": at(0, 20, np.nan)}
    _, found = observed_positions(named, (3.0, 6.0), "cm")
    np.testing.assert_allclose(
        found.sigma[:, :3], [[1, 2, 600], [300, 300, 600], [300, 300, np.inf]], rtol=1e-12
    )
    np.testing.assert_allclose(
        found.value[:, :2] - found.value[0, :2], [[0, 0], [1000, 0], [0, 2000]], atol=0.1
    )
    assert np.isnan(found.value[2, 2]) and np.isinf(found.sigma[:, 3:]).all()


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ("exif_sigma_m = [3.0, 6.0]", r"exif_sigma_m needs photographs, the survey has \[observations\]"),
        ('file = "exterior.csv"\nexif_sigma_m = [3.0, 6.0]', "both are given, one is needed"),
        ("", "neither is given, one is needed"),
        ("exif_sigma_m = [3.0]", "needed 2 values"),
        ("exif_sigma_m = [3.0, -1.0]", "needed more than 0"),
    ],
)
def test_what_is_refused(tmp_path: Path, section: str, message: str) -> None:
    path, _ = written(tmp_path, "refused")
    path.write_text(path.read_text().replace('file = "exterior.csv"', section), encoding="utf-8")
    with pytest.raises(SurveyFileError, match=message):
        read_survey(path)


def test_photographs_without_positions_are_named(tmp_path: Path) -> None:
    path = write_photograph_survey(tmp_path / "none", "no positions", photographs=2)
    path.write_text(path.read_text() + "[exterior]\nexif_sigma_m = [3.0, 6.0]\n", encoding="utf-8")
    with pytest.raises(SurveyFileError, match=r"none of 2 photographs has one; leave it out, or give a file"):
        run_survey(read_survey(path))


@pytest.mark.parametrize("groups", [(3, 3), (2, 1, 2), (1, 1)])
def test_positions_in_distant_groups_are_refused_unless_one_has_most(
    tmp_path: Path, groups: tuple[int, ...]
) -> None:
    """Also where the middle of all is in the smallest group."""
    east = 500_000.0 * np.repeat(np.arange(len(groups)), groups)
    named = {f"photo {k}.png": at(x, 0.1 * k, 5.0) for k, x in enumerate(east.tolist(), 1)}
    path = write_photograph_survey(tmp_path / "groups", "groups", photographs=len(named))
    for name, position in named.items():
        state_position(path.parent / name, position)
    path.write_text(path.read_text() + "[exterior]\nexif_sigma_m = [3.0, 6.0]\n", encoding="utf-8")
    with pytest.raises(SurveyFileError, match=r"more than 100 km apart, as photo 1.*, and none has most"):
        run_survey(read_survey(path))
    named["another.png"] = at(0.0, 5.0, 5.0)
    assert len(plausible_positions(named)) == (groups[0] + 1 if len(groups) == 2 else 0)


START = datetime(2026, 5, 4, 12, 0, 0)


def photographed(folder: Path, camera: str, seconds: list[float | None]) -> None:
    """Write a photograph for each time; None states none."""
    for k, one in enumerate(seconds):
        exif, at = Image.Exif(), START + timedelta(seconds=one or 0.0)
        if one is not None:
            exif.get_ifd(ExifTags.IFD.Exif).update(
                {
                    ExifTags.Base.DateTimeOriginal.value: at.strftime("%Y:%m:%d %H:%M:%S"),
                    ExifTags.Base.SubsecTimeOriginal.value: f"{at.microsecond:06d}",
                }
            )
        Image.new("L", (8, 8)).save(folder / f"{camera}{k}.jpg", exif=exif)


def survey_of(folder: Path, tolerance_s: float) -> Survey:
    cameras = [CameraSetup(name=one, images=f"{one}*.jpg", c_mm=8.0) for one in ("left", "right")]
    rig = RigSettings(name="stereo", cameras=("left", "right"), moment="exif", tolerance_s=tolerance_s)
    return Survey(name="times", cameras=cameras, rigs=(rig,), folder=folder)  # type: ignore[arg-type]


@pytest.mark.parametrize("ahead", [0.0, 0.3, -7261.5])
def test_photographs_at_one_time_are_of_one_moment(ahead: float, tmp_path: Path) -> None:
    """Nine moments at irregular times, of which one camera misses one; triggers differ by some 10 ms."""
    rng = seed_of("times")
    times = np.cumsum(rng.uniform(3.0, 20.0, 9))
    photographed(tmp_path, "left", times.tolist())
    late = np.delete(times, 4) + ahead + 0.01 * rng.standard_normal(8)
    photographed(tmp_path, "right", late.tolist())
    survey = survey_of(tmp_path, 0.5)
    found, remarks = moments_from_exif(survey, find_photographs(survey))
    moment = found.moments
    of_right = [moment[f"right{k}.jpg"] for k in range(8)]
    assert of_right == [moment[f"left{k}.jpg"] for k in range(9) if k != 4]
    assert len(set(of_right)) == 8
    if abs(ahead) < 0.5:
        assert not remarks
    else:
        assert remarks[0].kind == "clock_differs"
        assert remarks[0].number("ahead") == pytest.approx(ahead, abs=0.05)


def test_a_photograph_without_time_is_refused(tmp_path: Path) -> None:
    photographed(tmp_path, "left", [0.0, 10.0])
    photographed(tmp_path, "right", [0.0, None])
    survey = survey_of(tmp_path, 0.5)
    with pytest.raises(SurveyFileError, match=r"photograph 'right1\.jpg' states no time"):
        moments_from_exif(survey, find_photographs(survey))


def test_regular_intervals_with_clocks_that_differ_are_refused(tmp_path: Path) -> None:
    """One photograph at the end is missing: two differences of the clocks fit as well."""
    times = 10.0 * np.arange(9)
    photographed(tmp_path, "left", times.tolist())
    photographed(tmp_path, "right", (times[:8] + 3600.0).tolist())
    survey = survey_of(tmp_path, 0.5)
    with pytest.raises(SurveyFileError, match="by 3590 s or 3600 s, and as many photographs agree"):
        moments_from_exif(survey, find_photographs(survey))


def test_a_second_offset_of_clocks_that_fits_as_well_is_named(tmp_path: Path) -> None:
    """Clocks one interval off, and the first photograph missing: as they are, eight agree, wrongly."""
    times = 10.0 * np.arange(9)
    photographed(tmp_path, "left", times.tolist())
    photographed(tmp_path, "right", (times[1:] - 10.0).tolist())
    survey = survey_of(tmp_path, 0.5)
    _, (found,) = moments_from_exif(survey, find_photographs(survey))
    assert found.kind == "clock_differs" and found.severity == "warning"
    assert found.number("ahead") == pytest.approx(-10.0)


def test_a_photograph_that_one_camera_misses_in_the_middle_leaves_the_clocks_sure(tmp_path: Path) -> None:
    times = 10.0 * np.arange(9)
    photographed(tmp_path, "left", times.tolist())
    photographed(tmp_path, "right", np.delete(times, 4).tolist())
    survey = survey_of(tmp_path, 0.5)
    assert moments_from_exif(survey, find_photographs(survey))[1] == ()
