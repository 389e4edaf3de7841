"""First looks at a folder: photographs of one camera; texture is known at once, no target is missed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.model.conventions import AnyArray
from sfm.photographs.exif import Metadata
from sfm.products.drafting import target_trial
from sfm.products.drafting.camera_groups import group_photographs
from sfm.products.drafting.target_trial import MIN_PIXEL_RATIO, try_targets
from sfm.targets.codes import plate_search
from sfm.targets.codes.plate_search import Part, part_of_checkerboard
from tests.synthetic import seed_of

PHONE = Metadata((4000, 3000), "Maker", "Phone 7", 4.2, None, (0.0015, 0.0015), 1)
BARE = Metadata((2000, 1333), None, None, None, None, None, 1)


def photographs(*of: tuple[str, Metadata]) -> dict[str, Metadata]:
    return dict(of)


def test_make_model_serial_lens_focal_length_and_size_tell_cameras_apart() -> None:
    for other in (
        replace(PHONE, make="Other"),
        replace(PHONE, model="Phone 8"),
        replace(PHONE, serial="2"),
        replace(PHONE, lens="wide"),
        replace(PHONE, focal_mm=6.3),
        replace(PHONE, size_px=(2000, 1500)),
    ):
        taken = {f"a{k}.jpg": PHONE for k in range(3)} | {f"b{k}.jpg": other for k in range(2)}
        found = group_photographs(taken)
        assert [len(one.photographs) for one in found.cameras] == [3, 2]
        assert [one.globs for one in found.cameras] == [("a*.jpg",), ("b*.jpg",)]
        assert len({one.name for one in found.cameras}) == 2 and not found.left_out


def test_photographs_of_interleaved_names_are_listed() -> None:
    wide = replace(PHONE, focal_mm=2.1)
    taken = {f"IMG_{k}.jpg": (wide if k % 2 else PHONE) for k in range(6)}
    first, second = group_photographs(taken).cameras
    assert first.globs == ("IMG_0.jpg", "IMG_2.jpg", "IMG_4.jpg")
    assert second.globs == ("IMG_1.jpg", "IMG_3.jpg", "IMG_5.jpg")


def test_names_stand_for_cameras_where_no_file_names_one() -> None:
    taken = {name: BARE for name in ("043_1.tif", "043_2.tif", "671_1.tif", "671_2.tif", "671_3.tif")}
    assert [one.globs for one in group_photographs(taken).cameras] == [("671_*.tif",), ("043_*.tif",)]
    taken = {name: BARE for name in ("IMG_20240101_1.jpg", "IMG_20240101_2.jpg", "IMG_20240102_1.jpg")}
    assert [one.globs for one in group_photographs(taken).cameras] == [("IMG_*.jpg",)]


@pytest.mark.parametrize(
    ("odd", "why"),
    [
        (replace(PHONE, size_px=(3000, 4000)), "upright"),
        (replace(PHONE, size_px=(800, 600)), "800 x 600 px, the others have 4000 x 3000 px"),
        (replace(PHONE, focal_mm=8.0), "c = 8 mm, the others have 4.2 mm"),
        (replace(PHONE, serial="77"), "camera Maker Phone 7 77"),
    ],
)
def test_a_single_photograph_of_another_camera_is_left_out(odd: Metadata, why: str) -> None:
    found = group_photographs({f"a{k}.jpg": PHONE for k in range(3)} | {"odd.jpg": odd})
    assert [one.photographs for one in found.cameras] == [("a0.jpg", "a1.jpg", "a2.jpg")]
    ((name, reason),) = found.left_out
    assert name == "odd.jpg" and why in reason


def test_where_pixel_and_principal_distance_come_from() -> None:
    def camera(one: Metadata, width: float | None = None) -> tuple[float, float, str, bool]:
        (found,) = group_photographs({"a.jpg": one, "b.jpg": one}, lambda make, model: width).cameras
        return found.pixel_mm[0], found.c_mm, found.pixel_source, found.assumed

    assert camera(PHONE) == (0.0015, 4.2, "EXIF data", False)
    silent = replace(PHONE, pixel_mm=None)
    assert camera(silent, 6.0) == (6.0 / 4000, 4.2, "Maker Phone 7 in COLMAP's list of cameras", False)
    pixel, c, source, assumed = camera(silent)
    assert assumed and c == 4.2 and c / pixel == pytest.approx(1.2 * 4000) and "ASSUMED" in source
    pixel, c, source, assumed = camera(BARE)
    assert assumed and c / pixel == pytest.approx(1.2 * 2000) and pixel == 36 / 2000


def test_resampled_photographs_are_reported() -> None:
    small = replace(PHONE, taken_px=(8000, 6000))
    (found,) = group_photographs({"a.jpg": small, "b.jpg": replace(small, orientation=6)}).cameras
    (resampled,) = found.remarks
    assert resampled.kind == "photographs_resampled" and resampled.names("taken") == ("8000 x 6000 px",)
    (found,) = group_photographs({"a.jpg": replace(PHONE, taken_px=(3000, 4000)), "b.jpg": PHONE}).cameras
    assert found.remarks == ()


LOOK_PX = 450  # half of what is usual, for the time
SIDE = int(np.sqrt(MIN_PIXEL_RATIO) * LOOK_PX) + 100


@pytest.fixture
def small_look(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(target_trial, "LOOK_PX", LOOK_PX)


def texture(seed: str) -> AnyArray:
    rng = seed_of(seed)
    noise = rng.normal(0, 1, (SIDE, SIDE)).astype(np.float32)
    return np.clip(128 + 120 * cv2.GaussianBlur(noise, (0, 0), 3.0), 0, 255).astype(np.uint8)


def with_dots(photograph: AnyArray, *, diameter: int, spacing: int) -> AnyArray:
    shown = photograph.copy()
    for x in range(spacing, SIDE - spacing // 2, spacing):
        for y in range(spacing, SIDE - spacing // 2, spacing):
            cv2.circle(shown, (x, y), diameter, 235, -1, cv2.LINE_AA)
            cv2.circle(shown, (x, y), diameter // 2, 20, -1, cv2.LINE_AA)
    return shown


@pytest.mark.usefixtures("small_look")
def test_texture_is_not_measured_for_targets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for i, photograph in enumerate((texture("look 0"), np.full((SIDE, SIDE), 128, np.uint8))):
        cv2.imwrite(str(tmp_path / f"{i}.png"), photograph)
    monkeypatch.setattr(target_trial, "measure_photograph", lambda *args: pytest.fail("measured"))
    searched: list[AnyArray] = []

    def part(grey: AnyArray) -> Part | None:
        searched.append(grey)
        return part_of_checkerboard(grey)

    for module in (target_trial, plate_search):
        monkeypatch.setattr(module, "part_of_checkerboard", part)
    trial = try_targets(sorted(tmp_path.iterdir()))
    assert len(searched) == 2  # each photograph once, which takes a tenth of the time
    assert trial.codes == "none" and trial.plate is None and len(trial.photographs) == 2


@pytest.mark.usefixtures("small_look")
@pytest.mark.parametrize(("diameter", "spacing"), [(10, 60), (40, 140)])
def test_small_and_large_targets_are_seen(diameter: int, spacing: int) -> None:
    """Of 10 px, which are lost at low resolution, and of 40 px, few of which are in the middle."""
    photograph = with_dots(texture("look"), diameter=diameter, spacing=spacing)
    assert target_trial._look(photograph).shows_targets


@pytest.mark.usefixtures("small_look")
@pytest.mark.parametrize("side", [*(pytest.param(side, marks=pytest.mark.slow) for side in (24, 48)), 100])
def test_tags_are_seen(side: int) -> None:
    photograph = texture("look at tags")
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_6X6_250)
    step = 2 * side
    for number, (x, y) in enumerate(
        (x, y) for x in range(step, SIDE - step, 2 * step) for y in range(step, SIDE - step, 2 * step)
    ):
        tag = cv2.aruco.generateImageMarker(dictionary, number % 250, side)
        photograph[y - side // 4 : y + side + side // 4, x - side // 4 : x + side + side // 4] = 255
        photograph[y : y + side, x : x + side] = tag
    assert target_trial._look(photograph).shows_targets
