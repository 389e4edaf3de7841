"""The content of the viewer: the script is that of its sources, budgets are kept, crops are in place."""

from __future__ import annotations

import base64
import gzip
import json
import shutil
import subprocess
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.model.solution import SeenTargets, Solution
from sfm.report.viewer.embedded import joined_targets, packed_scene, scene_of_stored, sources
from sfm.report.viewer.pictures import Pictures, cut_pictures
from tests.places import ROOT
from tests.synthetic import SIZE_PX, make_network, seed_of

SOURCE = ROOT / "viewer"


def test_the_committed_scripts_are_what_their_sources_give(tmp_path: Path) -> None:
    node = shutil.which("node")
    if node is None or not (SOURCE / "node_modules" / "esbuild").is_dir():
        pytest.skip("no node, or no viewer/node_modules (npm ci in viewer): the viewer is not built again")
    subprocess.run([node, str(SOURCE / "build.mjs"), str(tmp_path)], check=True, cwd=SOURCE, timeout=120)
    built = {path.name: path.read_text(encoding="utf-8") for path in tmp_path.iterdir()}
    page = files("sfm.products.marking") / "page"
    committed = {name: (page / name).read_text(encoding="utf-8") for name in ("mark.js", "mark.css")}
    assert built == {"viewer.js": sources()[0], **committed}


def test_the_script_fits_into_a_page_and_names_its_licences() -> None:
    script, style = sources()
    assert "</script" not in script.lower() and "<!--" not in script
    assert "</style" not in style.lower()
    assert len(script) < 700_000
    version = json.loads((SOURCE / "package.json").read_text())["devDependencies"]["three"]
    licences = (ROOT / "sfm" / "report" / "viewer" / "LICENSES.txt").read_text(encoding="utf-8")
    assert f"three.js {version}" in script[:200] and f"three.js {version}" in licences
    assert "MIT License" in licences and "three.js authors" in licences


def test_locked_packages_name_no_host() -> None:
    lock = json.loads((SOURCE / "package-lock.json").read_text(encoding="utf-8"))
    assert all("resolved" not in package for package in lock["packages"].values())
    assert all("integrity" in package for path, package in lock["packages"].items() if path)


def stored(name: str) -> Solution:
    network, truth = make_network(seed_of(name), images=6, points=40, noise_px=0.1)
    return Solution(name, network, truth)


def test_each_image_point_has_the_outline_of_its_target() -> None:
    """In three photographs, of which the second has no image point and the third has two candidates."""
    rng = np.random.default_rng(seed_of("outlines of targets"))
    photo = rng.permutation(np.repeat([0, 2], 20))
    xy = rng.uniform(0, 1000, (40, 2))
    order = rng.permutation(40)
    outline = np.column_stack([rng.uniform(2, 9, (40, 2)), np.zeros(40)])
    seen = SeenTargets(
        np.concatenate([photo[order], [1, 2, 2]]),
        np.vstack([xy[order], xy[:3]]),  # at an image point, but of another photograph or rejected
        np.vstack([outline[order], np.ones((1, 3)), np.full((2, 3), np.nan)]),
        ("",) * 41 + ("too small",) * 2,
    )
    ellipse, marks = joined_targets(seen, photo, xy)
    np.testing.assert_array_equal(ellipse, outline)
    assert marks.photo.tolist() == [1, 2, 2]
    assert [marks.reasons[k] for k in marks.reason[1:]] == ["too small"] * 2


def unpacked(text: str) -> tuple[dict[str, object], bytes]:
    data = gzip.decompress(base64.b64decode(text))
    size = int.from_bytes(data[:4], "little")
    return json.loads(data[4 : 4 + size]), data


def test_scenes_come_back_as_they_were_packed() -> None:
    made = scene_of_stored(stored("packed"))
    header, data = unpacked(packed_scene(made, Pictures()))
    kind, first, count = header["arrays"]["point.xyz"]  # type: ignore[index]
    assert (kind, first % 8, count) == ("f8", 0, made.xyz.size)
    np.testing.assert_array_equal(np.frombuffer(data, "<f8", count, first).reshape(-1, 3), made.xyz)
    assert header["points"] == list(made.points)
    assert packed_scene(made, Pictures()) == packed_scene(made, Pictures())


def test_residuals_of_a_stored_result_are_those_of_its_noise() -> None:
    made = scene_of_stored(stored("noise"))
    assert made.rms_px == pytest.approx(0.1, rel=0.15)
    assert (np.diff(made.rays.point) >= 0).all()
    total = (made.photo_rms_px**2 * made.points_of_photo).sum() / made.points_of_photo.sum()
    assert np.sqrt(total) == pytest.approx(made.rms_px, rel=1e-12)


def test_what_has_no_coordinates_is_left_out_and_reported() -> None:
    one = stored("partial")
    position, points = one.estimate.position.copy(), one.estimate.points.copy()
    position[2], points[7] = np.nan, np.nan
    made = scene_of_stored(replace(one, estimate=replace(one.estimate, position=position, points=points)))
    assert len(made.photographs) == 5 and len(made.points) == 39
    assert one.network.points[7] not in made.points and one.network.images[2] not in made.photographs
    assert made.notes == (
        "1 of 6 photographs have no coordinates: omitted.",
        "1 of 40 points have no coordinates: omitted.",
    )
    assert made.rms_px == pytest.approx(0.1, rel=0.15)


@pytest.fixture(scope="module")
def noisy_files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("photographs")
    rng = seed_of("noise of photographs")
    found = {}
    for i in range(6):
        found[f"image {i + 1}"] = folder / f"{i}.png"
        picture = rng.integers(0, 255, SIZE_PX[::-1], dtype=np.uint8)
        cv2.imwrite(str(found[f"image {i + 1}"]), picture, [cv2.IMWRITE_PNG_COMPRESSION, 0])
    return found


@pytest.mark.parametrize("budget_mb", [0.0, 0.3, 15.0])
def test_pictures_keep_to_their_budget_and_the_worst_come_first(
    noisy_files: dict[str, Path], budget_mb: float
) -> None:
    made = scene_of_stored(stored("budget"))
    found = cut_pictures(made, noisy_files, budget_mb=budget_mb, beside="pictures")
    assert len(found.base64) <= 1e6 * budget_mb
    inside = found.ray[found.crop[:, 1] > 0]
    order = made.rays.worst_first()
    if budget_mb == 15.0:
        assert sorted(inside) == list(range(len(made.rays)))
        assert found.notes == ()
    else:
        rank = np.empty(len(order), dtype=int)
        rank[order] = np.arange(len(order))
        smallest = 0.9 * len(inside)  # one that is a little larger may have had no room before the others
        assert (rank[inside] < len(inside) + 5).sum() >= smallest
        assert any("crops of" in note for note in found.notes)
        assert sorted(found.ray) == list(range(len(made.rays)))  # the rest lies beside the page
        assert {name.removeprefix("pictures/") for name in found.crop_files} <= found.beside.keys()


def test_crops_show_the_target_where_it_was_measured(tmp_path: Path) -> None:
    made = scene_of_stored(stored("place"))
    picture = np.zeros(SIZE_PX[::-1], np.uint8)
    rows = np.flatnonzero(made.rays.photo == 0)
    for k in rows:
        x, y = np.rint(made.rays.xy[k]).astype(int)
        picture[y - 2 : y + 3, x - 2 : x + 3] = 255
    cv2.imwrite(str(tmp_path / "a.png"), picture)
    found = cut_pictures(made, {"image 1": tmp_path / "a.png"})
    data = base64.b64decode(found.base64)
    for c, k in enumerate(found.ray):
        start, length = 3 * found.crop[c]
        crop = cv2.imdecode(np.frombuffer(data[start : start + length], np.uint8), cv2.IMREAD_GRAYSCALE)
        left, top, side, px = found.frame[c]
        assert crop.shape == (px, px)
        column, row = (made.rays.xy[k] - (left, top)) * px / side
        assert crop[int(row), int(column)] > 200


def test_photographs_that_are_gone_are_reported(tmp_path: Path, noisy_files: dict[str, Path]) -> None:
    made = scene_of_stored(stored("gone"))
    found = cut_pictures(made, noisy_files | {"image 2": tmp_path / "none.png"})
    assert found.notes == ("1 of 6 photographs could not be read: they have no picture here.",)
    assert found.count == 5
