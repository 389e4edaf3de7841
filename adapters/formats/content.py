"""All that a file of a program says of a survey, for whoever writes it in another format."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sfm.network import ImagePoints, ObjectPoints
from sfm.stored_result import StoredResult


def _no_image_points() -> ImagePoints:
    none = np.zeros(0, dtype=np.int64)
    return ImagePoints(none, none, np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, dtype=bool))


@dataclass(frozen=True)
class Content:
    """What was measured and solved, what took no part, and what the reader should know of it."""

    result: StoredResult
    rejected: ImagePoints = field(default_factory=_no_image_points)  # measured, but left out as gross errors
    checks: ObjectPoints = field(default_factory=ObjectPoints)  # known points that only check the result
    notes: tuple[str, ...] = ()  # lines about what was read and is not used as it stands
