"""Tags with modules in the wrong colour, which OpenCV reads by correcting them, are refused by their fit."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from sfm.conventions import AnyArray, BoolArray
from sfm.targets.codes.tags import find_tags, tag_family, tag_modules
from tests.synthetic import seed_of


def printed(black: BoolArray, side_px: int, rng: np.random.Generator) -> AnyArray:
    """Return a photograph of a tag with its clear margin."""
    levels = np.kron(np.where(np.pad(black, 1), 40.0, 200.0), np.ones((32, 32)))
    side = round(side_px * (len(black) + 2) / len(black))
    tag = cv2.resize(levels, (side, side), interpolation=cv2.INTER_AREA)
    photograph = cv2.GaussianBlur(np.pad(tag, 40, constant_values=200.0), (0, 0), 0.8)
    return np.rint(photograph + rng.normal(0, 2, photograph.shape)).clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize("name", ["apriltag16h5", "apriltag36h11", "aruco6x6_250"])
@pytest.mark.parametrize("side_px", [20, 60])
def test_a_wrong_module_is_not_taken_for_light(name: str, side_px: int) -> None:
    """Before, up to 8 of 12 tags with one wrong module were confirmed."""
    family, rng = tag_family(name), seed_of(f"wrong module {name} {side_px}")
    for _ in range(6):
        black = tag_modules(family, int(rng.integers(0, 29))).copy()
        assert len(find_tags(printed(black, side_px, rng), family, polarity="dark", scale=255.0).code)
        row, column = rng.integers(1, len(black) - 1, 2)
        black[row, column] ^= True
        assert not len(find_tags(printed(black, side_px, rng), family, polarity="dark", scale=255.0).code)
