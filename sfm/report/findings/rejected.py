"""What was rejected, and why: image points by the tests, candidates of the photographs by their looks."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from sfm.conventions import FloatArray
from sfm.report.findings.geometry import Geometry
from sfm.result import SurveyResult, likest_first


@dataclass(frozen=True)
class RejectedPoint:
    """An image point that took no part in the adjustment."""

    image: str
    point: str
    xy: FloatArray  # px, (2,)
    v: FloatArray  # residual, px, (2,)

    @property
    def length(self) -> float:
        """Length of the residual, px."""
        return float(np.linalg.norm(self.v))


@dataclass(frozen=True)
class Candidates:
    """What was seen in a photograph, or in all of them."""

    image: str
    measured: int  # targets
    accepted: int  # image points in the result
    reasons: Counter[str]  # candidates that were not measured, by reason


@dataclass(frozen=True)
class Rejected:
    """Rejected image points and candidates."""

    points: tuple[RejectedPoint, ...]  # longest residual first
    share: float  # of all image points
    candidates: tuple[Candidates, ...]  # of each readable photograph
    total: Candidates  # of all

    @property
    def reasons(self) -> tuple[str, ...]:
        """All reasons, those of candidates that are most like targets first."""
        return tuple(likest_first(self.total.reasons))


def rejected_of(result: SurveyResult, geometry: Geometry) -> Rejected:
    """Return what was rejected in a survey."""
    a = result.adjustment
    rows, seen = np.flatnonzero(a.rejected), a.network.image_points
    length = np.linalg.norm(a.residuals[rows], axis=1)
    points = tuple(
        RejectedPoint(
            a.network.images[seen.image[k]], a.network.points[seen.point[k]], seen.xy[k], a.residuals[k]
        )
        for k in rows[np.argsort(-np.nan_to_num(length, nan=np.inf))]
    )
    used = dict(zip(a.network.images, geometry.image_points.tolist(), strict=True))
    candidates = tuple(
        Candidates(one.image, len(one.xy), used.get(one.image, 0), Counter(dict(one.reasons())))
        for one in result.photographs
    )
    total = Candidates(
        "all",
        sum(one.measured for one in candidates),
        sum(used.values()),
        sum((one.reasons for one in candidates), Counter()),
    )
    return Rejected(points, len(rows) / max(len(a.rejected), 1), candidates, total)
