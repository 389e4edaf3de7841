"""Boards in photographs of fisheye lenses: whole size, model of the lens, and no words on codes."""

from __future__ import annotations

import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import cv2
import numpy as np
import pytest

from sfm.model.conventions import AnyArray, rotation_from_angles
from sfm.model.errors import GeometryError
from sfm.model.remarks.remark import kinds_of
from sfm.products.drafting import target_trial
from sfm.products.drafting.draft import draft_survey
from sfm.survey.diagnosis.contradicting_codes import ContestedCodes, remarks_on_contested
from sfm.survey.inputs.measurements import MeasuredPhotographs, Naming
from sfm.survey.target_network import UNNAMED
from sfm.targets.codes.plate_search import part_of_checkerboard
from sfm.targets.codes.plates import PlateFamily
from sfm.targets.codes.rings import ring_family
from tests.plates import plate_pictures
from tests.synthetic import seed_of

SIZE = (1000, 750)
POSES = ((0, 0, 0), (35, 10, 3), (-30, 15, -4), (10, -38, 5), (-15, 30, 92), (25, -25, 178))  # degrees


def photograph(
    rows: int, columns: int, angles: tuple[float, float, float], *, c: float, fisheye: bool, reach: float
) -> AnyArray:
    """Photograph of a checkerboard with squares of 1; `reach` is the distance of the camera."""
    board = np.kron((np.indices((rows + 1, columns + 1)).sum(axis=0) + 1) % 2, np.ones((40, 40)))
    plane = np.pad(np.where(board > 0, 40.0, 210.0), 40, constant_values=210.0)
    x, y = np.meshgrid(*(np.arange(0, n, 0.5) - 0.25 for n in SIZE))  # twice as many pixels, then averaged
    x, y = (x - SIZE[0] / 2 - 3) / c, (y - SIZE[1] / 2 + 4) / c
    r = np.hypot(x, y)
    angle = np.minimum(r * (1 + 0.02 * r**2), 1.5) if fisheye else np.arctan(r)
    scale = np.tan(angle) / np.maximum(r, 1e-9)
    ray = np.stack([x * scale, y * scale, np.ones_like(x)], axis=-1)
    R = rotation_from_angles(*np.radians(angles))
    normal, centre = R[:, 2], np.array([0.0, 0.0, reach])
    t = (normal @ centre) / (ray @ normal)
    on = (ray * t[..., None] - centre) @ R
    u = (40 * (on[..., 0] + (columns + 3) / 2) - 0.5).astype(np.float32)
    v = (40 * (on[..., 1] + (rows + 3) / 2) - 0.5).astype(np.float32)
    u[t < 0] = -1e4
    seen = cv2.remap(plane.astype(np.float32), u, v, cv2.INTER_LINEAR, borderValue=130.0)
    small = cv2.GaussianBlur(cv2.resize(seen, SIZE, interpolation=cv2.INTER_AREA), (0, 0), 0.6)
    noise = seed_of(f"{angles} {c}").normal(0, 1.5, small.shape)
    return np.clip(small + noise, 0, 255).astype(np.uint8)


def folder_of(folder: Path, *, fisheye: bool) -> Path:
    folder.mkdir()
    c, reach = (330.0, 3.6) if fisheye else (900.0, 9.0)
    for k, angles in enumerate(POSES):
        shown = photograph(5, 6, angles, c=c, fisheye=fisheye, reach=reach)
        cv2.imwrite(str(folder / f"board {k}.png"), shown)
    return folder


@pytest.mark.sweep(1, 2)
@pytest.mark.parametrize(("rows", "columns"), [(9, 15), (6, 9), (12, 8)])
def test_a_bent_board_has_its_whole_size(rows: int, columns: int) -> None:
    for angles in POSES[:4]:
        shown = photograph(rows, columns, angles, c=300.0, fisheye=True, reach=0.62 * max(rows, columns))
        part = part_of_checkerboard(shown)
        assert part is not None and sorted(part[0]) == sorted((rows, columns)) and part[1] == (False, False)


@pytest.mark.parametrize("fisheye", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_the_lens_of_a_board_is_drafted_from_its_image_points(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, fisheye: bool
) -> None:
    monkeypatch.setattr(target_trial, "read_dictionaries", lambda _: {})  # takes 90 % of the time
    draft = draft_survey(folder_of(tmp_path / "boards", fisheye=fisheye))
    read = tomllib.loads(draft.text)
    assert (read["targets"]["rows"], read["targets"]["columns"]) == (5, 6)
    (camera,) = read["camera"]
    assert camera["model"] == ("opencv_fisheye" if fisheye else "brown")
    assert ("free" not in camera) == fisheye, "the photographs determine it"
    assert any(subject.startswith("lens of") for subject, _ in draft.found) == fisheye


def test_nothing_is_said_on_codes_of_a_plate() -> None:
    """The points of a plate that is named wrongly contradict one another; of rings, the codes are named."""
    found = ContestedCodes(
        {3: {0: frozenset({7}), 1: frozenset({8})}, 5: {1: frozenset({9}), 2: frozenset({UNNAMED})}},
        {},
        {3: 7},
        {},
    )
    photographs = cast(MeasuredPhotographs, SimpleNamespace(names=("a.jpg", "b.jpg", "c.jpg")))
    naming = cast(Naming, SimpleNamespace(corners=False, names=tuple(map(str, range(10)))))
    board = PlateFamily("checkerboard", 9, 15)
    (one,) = remarks_on_contested(found, photographs, naming, {}, board)
    assert one.kind == "plate_points_apart" and one.names("points") == ("3", "5")
    assert one.names("photographs") == ("a.jpg", "b.jpg", "c.jpg") and "ode" not in one.text.split("plate")[0]
    of_codes = remarks_on_contested(found, photographs, naming, {}, ring_family("ring14"))
    assert kinds_of(of_codes) == ("codes_at_several_places",)


@pytest.mark.parametrize(
    "plate",
    [
        PlateFamily("charuco", 7, 10, (), "aruco5x5_50", 0.6),
        PlateFamily("aprilgrid", 8, 10, (), "apriltag36h11", 0.77),
    ],
    ids=lambda plate: plate.name,
)
def test_mirrored_boards_with_tags_are_named(tmp_path: Path, plate: PlateFamily) -> None:
    """Not taken for a checkerboard or for texture."""
    for k, picture in enumerate(plate_pictures(plate, seed_of("mirrors"), 4)):
        cv2.imwrite(str(tmp_path / f"photo {k}.png"), picture[:, ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])
    with pytest.raises(GeometryError, match=r"tags of .* as in a mirror; print the board"):
        draft_survey(tmp_path)
