"""Photographs: which are not in the result and why, and which differ from the others."""

from __future__ import annotations

from sfm.remarks.kind import Grade, Kind

ROWS = (
    Kind(
        "photographs_missing",
        Grade("share", error=0.5),  # half of them or more: the rest may be the wrong half
        "{missing} of {total} photographs {missing:is|are} not in the result.",
        "damaged files, too few common points, or start values that do not fit",
        "See the reason of each below.",
    ),
    Kind(
        "not_connected",
        "warning",
        "{photographs} {photographs:is|are} not connected with the {oriented} oriented "
        "photographs[[, with only {shared} in common]].[[ A photograph that shows {needed} of {points} and "
        "{needed} of {others} connects them.]]",
        "groups of photographs with too few common points",
        "Add a photograph that shows points of both groups.",
    ),
    Kind(
        "two_photographs",
        "note",
        "Two photographs: no third ray checks a point, and the camera is only as good as its given values.",
        "a point needs three rays to be checked; uncoded targets need three to be named",
        "Add a third photograph.",
    ),
    Kind(
        "photographs_uneven",
        "warning",
        "The photographs differ in precision (Bartlett's test, p = {p}): sigma0 of {photograph} is {ratio} "
        "times the median.",
        "a photograph that is not sharp or of a camera that moved, or wrong names in it",
        "Look at this photograph; leave it out if you do not trust it.",
    ),
    Kind(
        "camera_by_size",
        "note",
        "{photographs:photograph} of camera {camera} {photographs:has|have} {size} in place of {usual} "
        "({what}) and became camera {new}: {photographs}.",
        "photographs that are cropped, resampled or turned, or from another sensor",
        "Use original photographs.",
    ),
    Kind(
        "camera_per_photograph",
        "warning",
        "{photograph} does not fit camera {camera} ({rejected} of {points:point} rejected); with "
        "{parameters} per photograph, c {change:+}, residuals are {rms}.",
        "zoomed, focused anew, cropped or resampled",
        "Give this photograph a camera in the survey file, or leave it out.",
    ),
    Kind(
        "plate_not_found",
        "note",
        "The calibration plate of {size} dots was not found in {photographs:photograph}: {photographs}.",
        "a plate without marks must be seen whole, one with marks with all of them; nothing may look like "
        "a mark",
        "Show all of it; check rows, columns and marks.",
    ),
    Kind(
        "board_not_found",
        "note",
        "The board of {size} crossings was not found in {photographs:photograph}: {photographs}.",
        "a checkerboard must be seen whole with a white rim; rows and columns count crossings, not squares",
        "Show all of it with its rim; check rows, columns, tag_size and dictionary.",
    ),
    Kind(
        "plane_ambiguous",
        "error",
        "The common points of {photographs} lie in a plane, and two orientations fit them alike.",
        "the photographs do not decide which of the two is true",
        "Add points off the plane, or a third photograph.",
    ),
)
