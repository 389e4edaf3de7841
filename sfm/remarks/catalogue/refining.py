"""Refining the models of other programs."""

from __future__ import annotations

from sfm.remarks.kind import Grade, Kind

ROWS = (
    Kind(
        "refinement_hardly_better",
        "warning",
        "The RMS is {times} times that before, expected far less.",
        "a camera model that does not suit the lens, something that moved, or little texture",
        "Use another camera model; mask what moved.",
    ),
    Kind(
        "photographs_not_adjusted",
        "warning",
        "{photographs:photograph} {photographs:was|were} not adjusted: {photographs}.",
        "too few of {photographs:its|their} key points could be measured anew",
        "See the reasons beside the key points; {photographs:the photograph keeps|the photographs keep} the "
        "orientation of the model.",
    ),
    Kind(
        "key_points_not_measured",
        Grade("missing", warning=0.5),  # more than half: photographs or windows are wrong
        "Only {measured} of {total} key points {measured:was|were} measured anew.",
        "photographs of another size or state than those of the model, or little texture",
        "Give the photographs of the model; see the reasons beside the key points.",
    ),
)
