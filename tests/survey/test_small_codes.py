"""Codes that are too small to read are told, with the size that would do."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.camera import camera_from_values
from sfm.conventions import AnyArray
from sfm.rendering.render import render_photograph
from sfm.rendering.scene import CircularTargets, Faces, Optics, Scene, coded_ring, join_marks
from sfm.survey.diagnosis.codes_found import small_codes
from sfm.survey.drafting.draft import draft_survey
from sfm.targets.codes.plates import code_family
from sfm.targets.codes.rings import CodeFamily
from sfm.targets.detect import Targets, find_targets

ACROSS, BLUR_PX = 5, 1.2


def picture_of_codes(diameter_px: float, name: str = "ring14") -> AnyArray:
    """Return a photograph of 25 codes of a family from the front, 1 px per unit."""
    family = code_family(name)
    assert isinstance(family, CodeFamily)
    radius = diameter_px / 2
    pitch = 2 * family.outer * radius + 11
    at = (np.arange(ACROSS) - (ACROSS - 1) / 2) * pitch
    places = np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)
    marks = [coded_ring(0, xy + 0.1 * k, radius, 10 + k, family, 0.08, turn=k) for k, xy in enumerate(places)]
    size = int(ACROSS * pitch)
    one = np.zeros(1)
    faces = Faces(np.zeros((1, 3)), np.eye(3)[None, :2], np.full((1, 2), size), one + 0.8, one, one + 1)
    none = CircularTargets(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0), np.zeros(0, np.int64))
    picture, _ = render_photograph(
        Scene(faces, join_marks(marks), none),
        camera_from_values("one", "brown", (size, size), (0.01, 0.01), c_mm=10.0),
        np.array([0.0, 0.0, 1000.0]),
        np.eye(3),
        optics=Optics(blur_px=BLUR_PX, noise=2 / 255),
        rng=np.random.default_rng(7),
    )
    return picture


def photographed(diameter_px: float) -> Targets:
    """Return the targets of a photograph of codes."""
    return find_targets(picture_of_codes(diameter_px), polarity="dark", codes="ring14", min_diameter_px=4.0)


@pytest.mark.parametrize("name", ["ring12", "necklace12"])
def test_a_folder_of_rings_is_recognised(name: str, tmp_path: Path) -> None:
    """Before: rings without parity were not tried, and the folder fell to natural texture."""
    picture = picture_of_codes(16.0, name)
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.rot90(picture, k))
    draft = draft_survey(tmp_path)
    assert f'codes = "{name}"' in draft.text


def test_small_codes_are_reported_with_what_would_do() -> None:
    small = [photographed(5.6) for _ in range(2)]
    (one,) = small_codes(small)
    assert one.kind == "codes_too_small"
    assert 4.5 < one.number("dot") < 6 < one.number("needed") < 10


@pytest.mark.parametrize("diameter_px", [9.0, 12.0])
def test_the_size_that_is_reported_does(diameter_px: float) -> None:
    found = photographed(diameter_px)
    assert (found.code >= 0).sum() >= ACROSS**2 - 1
    assert small_codes([found]) == () and small_codes([]) == ()
