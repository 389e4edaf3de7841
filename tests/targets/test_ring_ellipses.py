"""Rings whose proportions, perspective or shape differ from those of their family and of their dots."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from sfm.model.camera import camera_from_values
from sfm.model.conventions import AnyArray, FloatArray, IntArray, rotation_from_angles
from sfm.products.rendering.render import render_photograph
from sfm.products.rendering.scene import CircularTargets, Faces, Optics, Scene, coded_ring, discs, join_marks
from sfm.targets.codes.plates import code_family
from sfm.targets.codes.rings import CodeFamily, even_patterns, smallest_rotation
from sfm.targets.detect import Targets, find_targets

COLUMNS, ROWS = 4, 3
# Ratio of exposures to print: ink and paper of dark targets, exchanged for bright ones.
INK, PAPER = 0.08, 0.85


def photograph(
    places: FloatArray, numbers: IntArray, family: CodeFamily, *, bright: bool, tilt_deg: float, seed: int
) -> tuple[AnyArray, FloatArray]:
    """Return a photograph of coded dots of radius 1 on one sheet, and the centres of the dots, px, (k, 2).

    A number of 0 is a dot without a ring.
    """
    rng = np.random.default_rng(seed)
    ink, paper = (PAPER, INK) if bright else (INK, PAPER)
    marks = [
        coded_ring(0, at, 1.0, int(number), family, ink, turn=rng.uniform(0, 6))
        if number
        else discs(0, at[None], 1.0, ink)
        for at, number in zip(places, numbers, strict=True)
    ]
    half = np.abs(places).max(axis=0) + family.outer + 1.5
    sheet = Faces(
        np.zeros((1, 3)), np.array([[[1.0, 0, 0], [0, 1, 0]]]), half[None], np.array([paper]), np.zeros(1),
        np.ones(1),
    )  # fmt: skip
    targets = CircularTargets(np.zeros(len(places), int), places, np.ones(len(places)), numbers)
    camera = camera_from_values("test", "brown", (720, 560), (0.01, 0.01), c_mm=9.0)
    R = rotation_from_angles(np.radians(tilt_deg), np.radians(5), np.radians(15))
    picture, truth = render_photograph(
        Scene(sheet, join_marks(marks), targets, background=0.4), camera, R @ [0.0, 0.0, 2.9 * half[0]], R,
        optics=Optics(noise=0.01), rng=rng,
    )  # fmt: skip
    return picture, truth.outline_centre


def sheet_of(
    name: str, radii: tuple[float, float], *, bright: bool, tilt_deg: float, seed: int = 0
) -> tuple[AnyArray, FloatArray, IntArray]:
    """Return a photograph of rings of other proportions, the centres of their dots, px, and their codes."""
    family = code_family(name)
    assert isinstance(family, CodeFamily)
    across, down = np.meshgrid(np.arange(COLUMNS), np.arange(ROWS))
    places = (2 * radii[1] + 1.2) * np.column_stack([across.ravel() - 1.5, down.ravel() - 1.0])
    codes = np.random.default_rng(seed).choice(family.number, len(places), replace=False)
    own = replace(family, inner=radii[0], outer=radii[1])
    picture, centre = photograph(places, codes, own, bright=bright, tilt_deg=tilt_deg, seed=seed)
    return picture, centre, codes


def count_read(targets: Targets, centre: FloatArray, codes: IntArray) -> int:
    """Return how many codes are read; none may be wrong."""
    read = np.flatnonzero(targets.code >= 0)
    for k in read:
        nearest = np.hypot(*(centre - targets.xy[k]).T).argmin()
        assert targets.code[k] == codes[nearest]
    return len(read)


@pytest.mark.sweep(0, 2, 4)
@pytest.mark.parametrize(
    ("name", "radii", "bright", "tilt_deg"),
    [
        ("ring14", (2.1, 3.35), True, 20.0),
        ("ring12", (2.5, 3.2), False, 45.0),  # a thin ring
        ("ring20", (1.6, 3.2), True, 0.0),  # a thick one
        ("ring14", (3.0, 4.5), False, 45.0),  # perspective displaces the ring by a tenth of its radius
        ("even14", (1.5, 2.0), False, 30.0),
    ],
)
def test_rings_of_other_proportions_are_read(
    name: str, radii: tuple[float, float], bright: bool, tilt_deg: float
) -> None:
    picture, centre, codes = sheet_of(name, radii, bright=bright, tilt_deg=tilt_deg)
    assert count_read(find_targets(picture, codes=name), centre, codes) >= len(codes) - 2


def test_sharpened_and_compressed_rings_of_other_proportions_are_read() -> None:
    picture, centre, codes = sheet_of("ring14", (2.1, 3.35), bright=True, tilt_deg=30.0)
    sharp = picture + 1.2 * (picture - cv2.GaussianBlur(picture.astype(np.float32), (0, 0), 1.2))
    file = cv2.imencode(".jpg", np.rint(sharp).clip(0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 75])
    stored = cv2.imdecode(file[1], cv2.IMREAD_GRAYSCALE)
    assert count_read(find_targets(stored, codes="ring14"), centre, codes) >= len(codes) - 2


def test_rings_are_read_whose_dots_motion_has_flattened() -> None:
    """Motion by half the radius of a dot flattens it by more than the ring around it."""
    picture, centre, codes = sheet_of("ring14", (2.0, 3.0), bright=True, tilt_deg=10.0)
    moved = cv2.blur(picture, (7, 1))
    assert count_read(find_targets(moved, codes="ring14"), centre, codes) >= len(codes) - 2


def test_two_rings_of_other_proportions_are_no_evidence() -> None:
    """Below three dots with one ring the proportions of the family hold."""
    family = code_family("ring14")
    assert isinstance(family, CodeFamily)
    places = np.array([[-4.5, 0.0], [4.5, 0.0]])
    own = replace(family, inner=2.6, outer=3.9)
    picture, _ = photograph(places, np.array([20, 40]), own, bright=False, tilt_deg=0.0, seed=1)
    assert (find_targets(picture, codes="ring14").code < 0).all()


@pytest.mark.parametrize("pitch", [3.4, 4.2])
def test_neighbours_in_a_grid_are_no_ring(pitch: float) -> None:
    """Four neighbours of a dot are in the places of a valid code of twelve cells."""
    across, down = np.meshgrid(np.arange(7), np.arange(5))
    places = pitch * np.column_stack([across.ravel() - 3.0, down.ravel() - 2.0])
    family = code_family("ring12")
    assert isinstance(family, CodeFamily)
    picture, _ = photograph(places, np.zeros(35, int), family, bright=False, tilt_deg=0.0, seed=2)
    found = find_targets(picture, codes="ring12")
    assert len(found) == len(places)
    assert (found.code < 0).all()


def test_codes_of_even_parity_have_the_numbers_printed_beside_them() -> None:
    """Patterns read counter-clockwise, and the numbers printed beside them on public sheets."""
    printed = {255: 31, 263: 32, 281: 37, 311: 44, 343: 52, 365: 58, 387: 63, 401: 67, 411: 69}
    assert {value: even_patterns(14).tolist().index(value) + 1 for value in printed} == printed
    assert (len(even_patterns(12)), len(even_patterns(14))) == (161, 561)
    family = code_family("even14")
    assert isinstance(family, CodeFamily)
    clockwise = int(f"{401:014b}"[::-1], 2)
    at = family.pattern.tolist().index(smallest_rotation(np.array([clockwise]), 14)[0])
    assert family.number[at] == 67
