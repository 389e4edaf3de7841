"""Dots with rings around them, as codes have them, for a picture of codes that no family reads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sfm.model.conventions import AnyArray
from sfm.survey.inputs.sources import TARGETS
from sfm.targets.codes.plate_search import has_interrupted_ring
from sfm.targets.detect import Targets
from sfm.targets.measure import shape_from_axes
from sfm.targets.outlines import scale_of

CROP_PX, CROP_RADII = 160, 6.0  # side of the picture of a dot with its ring; half of it in radii of the dot
SHOWN_ROWS, SHOWN_COLUMNS = 4, 6  # dots in a picture of unread rings


@dataclass(frozen=True)
class Ringed:
    """Dots of a photograph with interrupted rings around them, as codes have."""

    photograph: str
    crops: tuple[AnyArray, ...]  # pictures of these dots, uint8, each (CROP_PX, CROP_PX)
    dots: int  # circles of the photograph, with such rings or without

    @property
    def are_most(self) -> bool:
        """Whether most dots have rings, and they are enough for two families of codes."""
        return len(self.crops) >= TARGETS.fewest and 2 * len(self.crops) > self.dots


def ringed_dots(name: str, grey: AnyArray, targets: Targets) -> Ringed:
    """Return the dots of a photograph that have interrupted rings around them.

    Args:
        name: name of the photograph.
        grey: intensities, (H, W), uint8.
        targets: measured in the photograph.
    """
    circle = targets.is_circle
    xy, shape = targets.xy[circle], shape_from_axes(targets.semi_axes[circle], targets.angle[circle])
    scale = 255 / scale_of(grey) if grey.dtype != np.uint8 else 1.0
    levels = scale * np.column_stack([targets.background, targets.contrast])[circle]
    rows = np.flatnonzero(has_interrupted_ring(grey, xy, shape, levels))
    side = CROP_RADII * np.sqrt(targets.semi_axes[circle].prod(axis=1))
    crops = tuple(
        cv2.warpAffine(
            grey,
            np.array([[s, 0, CROP_PX / 2 - s * x], [0, s, CROP_PX / 2 - s * y]]),
            (CROP_PX, CROP_PX),
            borderMode=cv2.BORDER_REPLICATE,
        )
        for (x, y), s in zip(xy[rows], CROP_PX / 2 / side[rows], strict=True)
    )
    return Ringed(name, crops, int(circle.sum()))


def picture_of_rings(ringed: Sequence[Ringed]) -> bytes:
    """Return a picture, PNG, of the dots with unread rings of the photograph that has most.

    Args:
        ringed: such dots of all photographs; the picture is empty without any.
    """
    if not ringed:
        return b""
    crops = list(
        max(ringed, key=lambda photograph: len(photograph.crops)).crops[: SHOWN_ROWS * SHOWN_COLUMNS]
    )
    crops += [np.full_like(crops[0], 255)] * (-len(crops) % SHOWN_COLUMNS)
    rows = [np.hstack(crops[k : k + SHOWN_COLUMNS]) for k in range(0, len(crops), SHOWN_COLUMNS)]
    return cv2.imencode(".png", np.vstack(rows))[1].tobytes()
