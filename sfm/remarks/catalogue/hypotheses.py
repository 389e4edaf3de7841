"""What an alternative hypothesis says if it wins over the assumptions of a survey."""

from __future__ import annotations

from sfm.remarks.kind import Grade, Kind

SHIFT = Grade("shift", warning=1.0, error=3.0)  # standard deviations by which coordinates move with it

ROWS = (
    Kind(
        "other_camera",
        SHIFT,
        "The camera of {photographs} differs from that of the others (c {change:+}[[, principal point "
        "{away} away]]): coordinates shift by up to {shift} of their standard deviations.",
        "zoom, focus or camera changed during the survey, or a photograph was cropped or resampled",
        "Give these photographs a [[camera]] of their own, or set per_photograph.",
    ),
)
