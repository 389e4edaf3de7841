"""Remarks on every pair of epochs, and the verdict on all."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from sfm.comparison.findings import remarks_of_cause
from sfm.epochs.displacements import Displacements
from sfm.epochs.series import EpochSeries
from sfm.remarks.remark import Remark, remark
from sfm.remarks.verdict import Level, Verdict, judge

HEADLINES: Mapping[Level, str] = {
    "good": "No displacement is significant.",
    "fair": "Points moved, and the others agree.",
    "bad": "The epochs do not agree as a whole.",
}


def verdict_of_epochs(found: EpochSeries) -> Verdict:
    """Return the verdict on epochs with the remarks on every pair, those with the first epoch first."""
    remarks = [one for pair in found.pairs for one in remarks_of_pair(pair.displacements)]
    remarks += [
        remark(
            "mount_changed",
            camera=one.camera,
            first=pair.displacements.differences.names[0],
            second=pair.displacements.differences.names[1],
            statistic=one.statistic,
            critical=one.critical,
        )
        for pair in found.pairs
        for one in pair.mounts
        if one.changed
    ]
    cameras = [
        remark(
            "one_camera",
            camera=one.name,
            epochs=one.epochs,
            statistic=one.statistic,
            critical=one.critical,
        )
        for one in found.cameras
    ]
    return judge((*remarks, *cameras), HEADLINES)


def remarks_of_pair(found: Displacements) -> Iterator[Remark]:
    """Yield what two epochs show."""
    d = found.differences
    first, second = d.names
    length = np.linalg.norm(found.displacement, axis=1)
    unit = d.unit or "object units"
    if found.cause is not None:
        yield from remarks_of_cause(found.cause, first, second, len(d.points), (float(length.max()), unit))
    elif not found.agreed:
        yield remark("no_majority_agrees", first=first, second=second)
    elif found.moved.any():
        names = [name for name, moved in zip(d.points, found.moved, strict=True) if moved]
        yield remark(
            "displaced",
            first=first,
            second=second,
            points=names,
            displaced=len(names),
            tested=len(d.points),
            distance=(float(length[found.moved].max()), unit),
        )
    if d.held_alike:
        yield remark("held_alike", cameras=d.held_alike, first=first, second=second)
    if d.held_apart:
        yield remark("held_apart", cameras=d.held_apart, first=first, second=second)
