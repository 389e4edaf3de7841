"""Rigs by times of exposure: two and three bodies, other clocks, missing photographs; and none by chance."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image

from sfm.model.conventions import FloatArray
from sfm.photographs.exif import Metadata
from sfm.products.drafting.camera_groups import group_photographs
from sfm.products.drafting.draft import draft_survey
from sfm.survey.inputs.from_exif import moments_from_exif
from sfm.survey.inputs.measurements import find_photographs
from sfm.survey.inputs.survey import read_survey
from tests.synthetic import seed_of

START = datetime(2026, 5, 4, 12, 0, 0)
FIRST = Metadata((120, 80), "Maker", "Body 7", 4.2, None, (0.0015, 0.0015), 1)
SECOND, THIRD = replace(FIRST, make="Other", model="Z9"), replace(FIRST, model="Q 2")
Camera = tuple[str, Metadata, FloatArray]  # prefix of the names, EXIF data, times, s


def taken(cameras: Sequence[Camera], *, whole: bool = False) -> dict[str, Metadata]:
    """Return the metadata of photographs of cameras, each numbered from another number."""
    photographs = {}
    for a, (prefix, one, seconds) in enumerate(cameras):
        for k, at in enumerate(np.sort(seconds).tolist()):
            time = START + timedelta(seconds=at)
            time = time.replace(microsecond=0 if whole else time.microsecond // 10_000 * 10_000)
            photographs[f"{prefix}{390 * a + k + 1:04d}.jpg"] = replace(one, taken=time)
    return photographs


def write(folder: Path, photographs: dict[str, Metadata]) -> None:
    for name, one in photographs.items():
        exif = Image.Exif()
        exif[ExifTags.Base.Make.value], exif[ExifTags.Base.Model.value] = one.make, one.model
        assert one.taken is not None
        exif.get_ifd(ExifTags.IFD.Exif).update(
            {
                ExifTags.Base.DateTimeOriginal.value: one.taken.strftime("%Y:%m:%d %H:%M:%S"),
                ExifTags.Base.SubsecTimeOriginal.value: f"{one.taken.microsecond:06d}",
            }
        )
        (folder / name).parent.mkdir(exist_ok=True, parents=True)
        Image.new("L", one.size_px).save(folder / name, exif=exif)


@pytest.mark.parametrize("prefixes", [("IMG_", "DSC_"), ("102CANON/IMG_", "114NIKON/DSC_")])
@pytest.mark.parametrize("ahead", [0.0, -7261.37])
def test_a_rig_is_drafted_from_times_and_its_moments_are_found(
    prefixes: tuple[str, str], ahead: float, tmp_path: Path
) -> None:
    """Names are numbered from other numbers, and one photograph is missing."""
    rng = seed_of(f"rig by times {ahead}")
    times = np.cumsum(rng.uniform(3.0, 20.0, 12))
    late = np.delete(times, 5) + ahead + 0.02 * rng.standard_normal(11)
    write(tmp_path, taken([(prefixes[0], FIRST, times), (prefixes[1], SECOND, late)]))
    draft = draft_survey(tmp_path)
    (rig,) = tomllib.loads(draft.text)["rig"]
    assert rig["moment"] == "exif" and len(rig["cameras"]) == 2
    assert "Times pair up: 11 moments" in draft.text and "by the times" in dict(draft.found)["rig"]
    (tmp_path / "survey.toml").write_text(draft.text, encoding="utf-8")
    survey = read_survey(tmp_path / "survey.toml")
    moments = moments_from_exif(survey, find_photographs(survey))[0].moments
    assert len(moments) == 23 and len(set(moments.values())) == 12


@pytest.mark.parametrize("whole", [False, True])
def test_three_bodies_are_one_rig(whole: bool) -> None:
    """Also by whole seconds, if the clocks agree."""
    rng = seed_of("three bodies")
    times = np.cumsum(rng.uniform(5.0, 20.0, 15))
    cameras = [("IMG_", FIRST, times), ("DSC_", SECOND, times[1:]), ("P10", THIRD, np.delete(times, 7))]
    cameras = [(prefix, one, at + 0.02 * rng.standard_normal(len(at))) for prefix, one, at in cameras]
    rig = group_photographs(taken(cameras, whole=whole)).rig
    assert rig is not None and len(rig.cameras) == 3 and rig.moments == 15


def test_short_intervals_have_a_smaller_tolerance() -> None:
    rng = seed_of("short intervals")
    times = np.cumsum(rng.uniform(1.0, 3.0, 15))
    rig = group_photographs(taken([("IMG_", FIRST, times), ("DSC_", SECOND, times + 0.02)])).rig
    assert rig is not None and rig.tolerance_s < 0.5


def in_turn(rng: np.random.Generator) -> list[Camera]:
    times = np.cumsum(rng.uniform(8.0, 25.0, 12))
    return [("IMG_", FIRST, times), ("DSC_", SECOND, times + 4.0 + 0.8 * rng.standard_normal(12))]


def at_any_time(rng: np.random.Generator) -> list[Camera]:
    return [("IMG_", FIRST, rng.uniform(0, 90, 15)), ("DSC_", SECOND, rng.uniform(0, 90, 15))]


def at_stations(rng: np.random.Generator) -> list[Camera]:
    stations = np.cumsum(rng.uniform(30.0, 90.0, 8))
    return [(name, one, stations + rng.uniform(0, 10, 8)) for name, one in (("I", FIRST), ("D", SECOND))]


def bursts(rng: np.random.Generator) -> list[Camera]:
    times = np.cumsum(rng.uniform(5.0, 20.0, 12))
    return [("IMG_", FIRST, times), ("BURST_", FIRST, times + 0.15)]


def copies(rng: np.random.Generator) -> list[Camera]:
    times = np.cumsum(rng.uniform(5.0, 20.0, 12))
    return [("IMG_", FIRST, times), ("small_", replace(FIRST, size_px=(60, 40)), times)]


def one_body(rng: np.random.Generator) -> list[Camera]:
    times, one = np.cumsum(rng.uniform(5.0, 20.0, 12)), replace(FIRST, serial="7")
    return [("IMG_", one, times), ("DSC_", one, times + 77.7)]


@pytest.mark.parametrize("ahead", [0.0, 3601.37])
@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("cameras", [in_turn, at_any_time, at_stations])
def test_two_cameras_by_hand_are_no_rig(
    cameras: Callable[[np.random.Generator], list[Camera]], whole: bool, ahead: float
) -> None:
    for seed in range(10):
        first, (prefix, one, times) = cameras(seed_of(f"by hand {seed}"))
        found = group_photographs(taken([first, (prefix, one, times + ahead)], whole=whole))
        assert found.rig is None and len(found.cameras) == 2


@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("cameras", [bursts, copies, one_body])
def test_one_body_is_no_rig(cameras: Callable[[np.random.Generator], list[Camera]], whole: bool) -> None:
    assert group_photographs(taken(cameras(seed_of("one body")), whole=whole)).rig is None
