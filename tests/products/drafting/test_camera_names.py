"""Cameras that the names of photographs propose, in names as programs and people write them."""

from __future__ import annotations

import re
import tomllib
from collections import Counter
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sfm.model.errors import SurveyFileError
from sfm.photographs.exif import Metadata
from sfm.products.drafting.camera_groups import Grouping, group_photographs
from sfm.products.drafting.camera_names import IN_ORDER, cameras_in_names
from sfm.products.drafting.draft import draft_survey
from tests.synthetic import seed_of

BARE = Metadata((960, 600), None, None, None, None, None, 1)
PHONE = Metadata((4000, 3000), "Maker", "Phone 7", 4.2, None, (0.0015, 0.0015), 1)
START = datetime(2020, 2, 17, 20, 58, 12)
PAIRS = {
    "second number": [f"dot_{k:02d}_{camera}.jpeg" for k in range(21) for camera in (0, 1)],
    "last letter": [f"{k}_{camera}.png" for k in range(6) for camera in "LR"],
    "first word": [f"{camera}{k:02d}.jpg" for k in range(1, 15) for camera in ("left", "right")],
    "words of other languages": [f"{camera}-{k}.png" for k in range(5) for camera in ("links", "rechts")],
    "two moments": [f"{camera}{k}.jpg" for k in (1, 2) for camera in ("left", "right")],
    "word in the middle": [f"scan_{camera}_{k:03d}.tif" for k in range(7) for camera in ("a", "b")],
    "folders": [f"cam{camera}/{k:04d}.png" for k in range(10) for camera in (0, 1, 2)],
    "folders and names": [f"cam{camera}/cam{camera}_{k:04d}.png" for k in range(10) for camera in (0, 1)],
    "more cameras than moments": [f"cam{camera}_{k}.png" for k in range(3) for camera in range(8)],
    "serial numbers": [f"Basler_{n}__{k}.tiff" for k in range(12) for n in (21998381, 21998382, 21998390)],
    "with a clock": [
        f"{camera}_{k:03d}_{1000 + 7 * k + j}.png" for k in range(9) for j, camera in enumerate("LR")
    ],
}


def times(pattern: str, seed: str, count: int = 23) -> list[str]:
    """Names by date and time of photographs that a person took every few seconds."""
    rng = seed_of(seed)
    taken = np.cumsum(rng.uniform(1.0, 12.0, count))
    return [
        (START + timedelta(seconds=float(s))).strftime(pattern).replace("#", f"{rng.integers(1000):03d}")
        for s in taken
    ]


@pytest.mark.parametrize("names", PAIRS.values(), ids=list(PAIRS))
def test_names_that_pair_up_are_cameras_and_moments(names: list[str]) -> None:
    for missing in (0, 1) if len(names) > 4 else (0,):  # also where a camera missed a moment
        some = names[missing:]
        found = cameras_in_names(some)
        assert found is not None and set(found.camera) == set(some)
        cameras = len(set(found.camera.values()))
        assert cameras == {"folders": 3, "more cameras": 8, "serial": 3}.get(_kind(names), 2)
        matches = {name: re.search(found.pattern, name) for name in some}
        moments = Counter(match[1] for match in matches.values() if match)
        assert sum(moments.values()) == len(some) and max(moments.values()) == cameras


def _kind(names: list[str]) -> str:
    (key,) = (key for key, some in PAIRS.items() if some is names)
    return next(
        (kind for kind in ("folders and", "folders", "more cameras", "serial") if key.startswith(kind)), ""
    )


@pytest.mark.parametrize(
    "pattern",
    [
        "img-%Y-%m-%d-%H-%M-%S-#.jpg",
        "WhatsApp Image %Y-%m-%d at %H.%M.%S.jpeg",
        "Foto %d.%m.%y, %H %M %S.jpg",
        "%Y%m%d_%H%M%S.jpg",
        "IMG_%Y%m%d_%H%M%S#.jpg",
        "Screenshot from %Y-%m-%d %H-%M-%S.png",
    ],
)
def test_dates_and_times_are_no_cameras(pattern: str) -> None:
    for seed in range(10):
        for count in (6, 23, 80):
            assert cameras_in_names(list(dict.fromkeys(times(pattern, f"{pattern} {seed}", count)))) is None
    every_two_seconds = [(START + timedelta(seconds=2 * k)).strftime(pattern) for k in range(120)]
    assert cameras_in_names(every_two_seconds) is None


@pytest.mark.parametrize(
    "names",
    [
        [f"P82500{k}.JPG" for k in range(21, 42)],
        [f"DSC_{k:04d}.jpg" for k in range(9)] + ["PANO_0009.jpg"],
        [f"front{k}.png" for k in range(9)] + [f"back{k}.png" for k in range(9, 18)],
        [f"row_{i}_{j}.png" for i in range(4) for j in range(5)],
        [f"IMG_2024010{day}_{k}.jpg" for day in (1, 2) for k in range(3)],
        ["a.png", "b.png"],
        [],
    ],
    ids=["counted", "a panorama", "counted through", "rows and columns", "days", "two", "none"],
)
def test_other_names_are_of_one_camera(names: list[str]) -> None:
    assert cameras_in_names(names) is None


def test_photographs_by_the_clock_or_in_several_places_are_in_the_order_of_their_names() -> None:
    stamp = [
        f"cam{a}/{17690955119 * 10**8 + k * 10**9 + a * 3 * 10**6}.png" for k in range(9) for a in (0, 1)
    ]
    found = cameras_in_names(stamp)
    assert found is not None and found.pattern == IN_ORDER and len(set(found.moment.values())) == 9
    assert cameras_in_names(stamp[1:]) is None, "a photograph is missing, and the order is no moment"
    apart = [f"plate{plate}_{side}_{k}.png" for plate in "AB" for side in ("left", "right") for k in range(5)]
    found = cameras_in_names(apart)
    assert found is not None and found.pattern == IN_ORDER
    assert {found.camera[name] for name in apart} == {"left", "right"}


def grouped(names: list[str], one: Metadata = BARE) -> Grouping:
    return group_photographs(dict.fromkeys(names, one))


def test_cameras_by_names_have_globs_names_and_a_rig() -> None:
    found = grouped(PAIRS["second number"])
    assert [one.globs for one in found.cameras] == [("dot_*_0.jpeg",), ("dot_*_1.jpeg",)]
    assert found.rig is not None and found.rig.moments == 21 and found.rig.cameras == ("camera-0", "camera-1")
    assert found.rig.example == ("dot_00_0.jpeg", "dot_00_1.jpeg")
    found = grouped(PAIRS["folders"])
    assert [one.name for one in found.cameras] == ["cam0", "cam1", "cam2"]
    assert [one.globs for one in found.cameras] == [(f"cam{k}/*.png",) for k in range(3)]
    found = grouped(times("img-%Y-%m-%d-%H-%M-%S-#.jpg", "one telephone"))
    assert len(found.cameras) == 1 and found.rig is None


def test_half_of_the_photographs_in_pairs_are_cameras_but_no_rig() -> None:
    names = [f"043_{k}.tif" for k in (5, 7, 9, 11, 13, 19)] + [f"671_{k}.tif" for k in (5, 11)]
    found = grouped(names)
    assert len(found.cameras) == 2 and found.rig is None
    assert grouped([*names, "671_13.tif"]).rig is not None


def test_serial_numbers_and_times_decide_before_names() -> None:
    names = PAIRS["first word"]
    assert len(grouped(names, PHONE).cameras) == 2, "two of one model"
    assert len(grouped(names, replace(PHONE, serial="1")).cameras) == 1
    of = {name: replace(PHONE, serial=name[:4]) for name in names}
    rig = group_photographs(of).rig
    assert rig is not None and rig.cameras == ("left", "right")

    def taken(name: str, *, walking: bool) -> Metadata:
        number, right = int(name[-6:-4]), name.startswith("right")
        gap = 300.0 + (number % 5) * 40.0 if walking else 300.4 + (number % 2)  # another clock, whole seconds
        return replace(PHONE, taken=START + timedelta(seconds=20 * number + gap * right))

    assert group_photographs({name: taken(name, walking=False) for name in names}).rig is not None
    apart = group_photographs({name: taken(name, walking=True) for name in names})
    assert apart.rig is None and len(apart.cameras) == 1


def test_never_more_cameras_than_half_the_photographs() -> None:
    for names in (
        *PAIRS.values(),
        times("%Y%m%d_%H%M%S.jpg", "phone"),
        [f"{k}{c}.png" for k in "abcd" for c in "xy"],
    ):
        assert len(grouped(names).cameras) <= len(names) / 2


def write(folder: Path, names: list[str]) -> None:
    for k, name in enumerate(names):
        (folder / name).parent.mkdir(exist_ok=True, parents=True)
        Image.new("L", (120, 80), 2 * k).save(folder / name)


def test_a_rig_is_drafted_from_names_and_from_subfolders(tmp_path: Path) -> None:
    for case, names in enumerate((PAIRS["first word"], PAIRS["folders"][:12])):
        write(tmp_path / str(case), names)
        draft = draft_survey(tmp_path / str(case))
        read = tomllib.loads(draft.text)
        (rig,) = read["rig"]
        assert rig["cameras"] == [one["name"] for one in read["camera"]]
        assert all(re.search(rig["moment"], name) for name in names)
        assert "Check that the cameras are fixed" in draft.text and "check" in dict(draft.found)["rig"]


def test_subfolders_that_are_no_cameras_are_refused_with_a_proposal(tmp_path: Path) -> None:
    write(tmp_path, ["bridge/IMG_1.png", "bridge/IMG_2.png", "tower/IMG_8.png", "tower/IMG_9.png"])
    with pytest.raises(SurveyFileError, match=r"no photographs \(.*try .*bridge; try .*tower"):
        draft_survey(tmp_path)
