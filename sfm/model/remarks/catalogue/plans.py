"""Remarks on plans and batches."""

from __future__ import annotations

from sfm.model.remarks.row import Kind

BATCHES = (
    Kind(
        "surveys_failed",
        "error",
        "{surveys:survey} {how}: {surveys}.",
        "the reason in the row of each; a process that died, for example for lack of memory, sets its survey "
        "aside",
        "Correct the survey files, or run those that were set aside alone; run the batch again with "
        "--resume.",
    ),
    Kind(
        "surveys_not_dependable",
        "error",
        "{surveys:survey} {surveys:has|have} no dependable result: {surveys}.",
        "see the remarks in the report of each",
        "Correct what {surveys:its report names|their reports name}.",
    ),
    Kind(
        "surveys_with_warnings",
        "warning",
        "{surveys:survey} worked with warnings: {surveys}.",
        "see the remarks in the report of each",
        "Read {surveys:its report before using the result|their reports before using the results}.",
    ),
)
ROWS = (
    Kind(
        "plan_undetermined",
        "error",
        "The photographs do not determine the network: {unknown}[[; and {more} more]].",
        "too few photographs, or all from one direction",
        "Add stations from other directions and distances, rolled about the axis.",
        explains=("plan_does_not_calibrate",),
    ),
    Kind(
        "plan_points_undetermined",
        "error",
        "{lost} of {total} points {lost:is|are} not determined: {points}.",
        "fewer than two photographs show {lost:it|them}",
        "Add stations that see {lost:it|them}.",
    ),
    Kind(
        "plan_not_connected",
        "error",
        "{photographs} {photographs:shares|share} fewer than {needed} points with {others}: they are "
        "separate "
        "networks.",
        "too large steps between directions or heights, or parts of the object that nothing joins",
        "Add stations between them, from which points of both are seen.",
        explains=("plan_undetermined",),
    ),
    Kind(
        "plan_short_of_wanted",
        "warning",
        "The uncertainty is {times} times the wanted one.",
        "too few photographs, or from too far away",
        "Add stations, move closer, or allow more photographs.",
    ),
    Kind(
        "plan_has_few",
        "note",
        "[[{few:point} {few:has|have} fewer than {needed} rays]][[{photographs:photograph} "
        "{photographs:has|have} fewer than {needed} positions of coded targets: {photographs}]].",
        "few photographs show these points, or a photograph shows few points",
        "Add stations that see these points; plan more coded targets there.",
    ),
    Kind(
        "plan_does_not_calibrate",
        "warning",
        "The network does not determine the camera: {reasons}.",
        "too few directions or rolls, or too little of the photographs is filled",
        "Calibrate the camera beforehand, or hold it fixed.",
    ),
    Kind(
        "plan_limited",
        "note",
        "The plan is limited: {limit}.",
        "the allowed stations, distances or numbers of photographs",
        "Allow more.",
    ),
    Kind(
        "plan_photographs_apart",
        "warning",
        "{photographs:photograph} {photographs:shares|share} fewer than {needed} points with others: "
        "{photographs}.",
        "{photographs:it overlaps the others|they overlap} too little",
        "Add photographs beside {photographs:it|them}.",
    ),
    Kind(
        "plan_assumes",
        "note",
        "The plan assumes {assumed:@}.",
        "no scale, mesh, normals, precision or aperture was given",
        "Give --scale-bar, a mesh, nX, nY, nZ, --sigma-px of an earlier survey, or --f-number and --focus.",
    ),
)
