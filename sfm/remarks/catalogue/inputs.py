"""Remarks on errors of the input that do not stop a survey."""

from __future__ import annotations

from sfm.remarks.kind import Kind

ROWS = (
    Kind(
        "copies",
        "note",
        "{copies:photograph} {copies:is a copy|are copies} of another, and {copies:counts|count} once: "
        "{copies}.",
        "the same photograph was copied or saved again; it is no second observation",
        "Remove the copies.",
    ),
    Kind(
        "image_points_outside",
        "note",
        "{image_points:image point} {image_points:is|are} outside of {image_points:its photograph|their "
        "photographs} and left out: {image_points}.",
        "a gross error or a mistyped coordinate",
        "Correct or remove the image points that are named.",
    ),
    Kind(
        "handedness_unchecked",
        "note",
        "Nothing checks whether image coordinates are mirrored: y must count downwards.",
        "image points of a file, and no control points or projection centres in space that take part",
        "Compare the result with the object, or give four points that do not lie in a plane.",
    ),
)
