"""Other programs: whether another adjuster or pipeline agrees."""

from __future__ import annotations

from sfm.remarks.kind import Kind

ROWS = (
    Kind(
        "adjuster_differs",
        "warning",
        "{program} does not agree with the adjustment.",
        "one of the two has not reached the minimum",
        "Read the comparison in the report.",
    ),
    Kind(
        "adjuster_fits_alike",
        "note",
        "The image points do not separate the solutions of Kolinear and {program}: v'Pv differs by {gap} "
        "variances.",
        "the network hardly determines the camera model of the comparison",
        "The survey is valid; photograph from more directions and distances for a comparison of cameras.",
    ),
    Kind(
        "adjuster_fits_better",
        "warning",
        "The camera of {program} with {parameters} free fits {times} times better: {rms} in place of "
        "{before} RMS.",
        "the camera model of the survey does not suit the lens",
        "Free these parameters.",
    ),
    Kind(
        "adjuster_failed",
        "warning",
        "The comparison with another adjuster failed: {reason}.",
        "the other program refused the network",
        "The survey is valid without it.",
    ),
    Kind(
        "pipeline_failed",
        "warning",
        "The comparison with another pipeline failed: {reason}.",
        "the other program refused the photographs",
        "The survey is valid without it.",
    ),
    Kind(
        "adjuster_not_compared",
        "note",
        "Not compared with another adjuster: {reason}.",
        "a library is not installed",
        "Install it to compare.",
    ),
    Kind(
        "pipeline_not_compared",
        "note",
        "Not compared with another pipeline: {reason}.",
        "a library is not installed",
        "Install it to compare.",
    ),
)
