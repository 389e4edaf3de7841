"""Remarks on measuring a result: shapes, tolerances, and acceptance tests against calibrated lengths."""

from __future__ import annotations

from sfm.remarks.kind import Kind

ROWS = (
    Kind(
        "out_of_tolerance",
        "error",
        "{tolerance}: {out} of {total} deviations {out:is|are} proven to be out of tolerance: {points}.",
        "the object deviates from its drawing by more than tolerance and uncertainty",
        "See the table of deviations.",
    ),
    Kind(
        "tolerance_undecided",
        "warning",
        "{tolerance}: {undecided} of {total} deviations {undecided:is|are} too near the limit to be decided.",
        "the uncertainty of the measurement reaches across the limit",
        "Measure with a smaller uncertainty: more photographs, or larger in the photographs.",
    ),
    Kind(
        "tolerance_unknown",
        "warning",
        "{tolerance}: {unknown} of {total} deviations {unknown:has|have} no standard deviation and "
        "{unknown:is|are} not decided.",
        "the result has no covariance of these points",
        "Run the survey again with this version, or measure a result with standard deviations.",
    ),
    Kind(
        "nominal_missing",
        "warning",
        "{tolerance}: {points:point} {points:was|were} not measured: {points}.",
        "the nominal table names points that the result lacks",
        "Measure {points:it|them}, or remove {points:it|them} from the table.",
    ),
    Kind(
        "no_precision",
        "warning",
        "The result has no standard deviations: nothing is tested or decided.",
        "the result is of another program",
        "Adjust it with Kolinear (kolinear adjust).",
    ),
    Kind(
        "covariance_of_sample",
        "warning",
        "The covariance between points is known of {known} of {total} points: standard deviations of the "
        "others leave out correlations.",
        "of many points only a sample is kept with its covariance",
        "Give the points that are measured names; those come first.",
    ),
    Kind(
        "covariance_of_single_points",
        "warning",
        "Only the covariance of each single point is known: standard deviations of shapes and distances "
        "leave out correlations.",
        "the result is of another program or an older version",
        "Run the survey again.",
    ),
    Kind(
        "network_units",
        "warning",
        "The scale is undefined: lengths are in network units.",
        "the survey has no scale bar and no control",
        "Add a scale bar to the survey.",
    ),
    Kind(
        "shape_not_converged",
        "warning",
        "{shape} did not converge.",
        "its points hardly determine it",
        "Add points that are spread over the shape, or hold a parameter.",
    ),
    Kind(
        "shape_deviates",
        "warning",
        "The points of {shape} deviate from this form: residuals are {times} times their precision, the "
        "limit is {limit}.",
        "the object is not of this form, or a point belongs to another part",
        "Look at the residuals; fit it with robust = true if single points are wrong.",
    ),
    Kind(
        "shape_points_left_out",
        "warning",
        "The fit of {shape} leaves out {points:point}: {points}.",
        "{points:it contradicts|they contradict} the others",
        "See whether {points:it belongs|they belong} to the shape.",
    ),
    Kind(
        "datum_dependent",
        "note",
        "Depends on the datum of a free network.",
        "nothing fixes position and attitude",
        "Use control or an alignment.",
    ),
    Kind(
        "correlations_unknown",
        "note",
        "The correlations of the points are not known.",
        "the covariance of the points was not kept together",
        "Run the survey again.",
    ),
    Kind(
        "lengths_outside",
        "error",
        "{outside} of {total} lengths {outside:is|are} proven to be outside of the limit.",
        "the error of length measurement is larger than the limit and the uncertainty of the calibration",
        "See the table of lengths.",
    ),
    Kind(
        "lengths_exceed_limit",
        "error",
        "{exceeding} of {total} errors of length {exceeding:exceeds|exceed} the limit; no standard "
        "deviation of "
        "the calibration is given that could explain {exceeding:it|them}.",
        "the error of length measurement is larger than the limit, and the column sigma is empty",
        "See the table of lengths; enter the standard deviations of the calibration.",
    ),
    Kind(
        "lengths_undecided",
        "warning",
        "{undecided} of {total} lengths {undecided:is|are} proven neither inside nor outside of the limit.",
        "the uncertainty of the calibration reaches across the limit",
        "Use lengths with a better calibration.",
    ),
    Kind(
        "lengths_without_sigma",
        "warning",
        "{unknown} of {total} lengths {unknown:has|have} no standard deviation of {unknown:its|their} "
        "calibration and {unknown:is|are} not decided.",
        "the column sigma is empty",
        "Enter the standard deviations of the calibration.",
    ),
    Kind(
        "lines_missing",
        "warning",
        "There {lines:is|are} {lines:measuring line}; part 1 asks for {needed}.",
        "VDI/VDE 2634 part 1, sec. 4",
        "Add measuring lines.",
    ),
    Kind(
        "line_short_of_lengths",
        "warning",
        "Line {line} has {lengths:length}; part 1 asks for {needed}.",
        "VDI/VDE 2634 part 1, sec. 4",
        "Add lengths on this line.",
    ),
    Kind(
        "line_not_straight",
        "warning",
        "The lengths of line {line} are not on one line.",
        "points of two lines have one name of a line",
        "Correct the column line.",
    ),
    Kind(
        "lines_parallel",
        "warning",
        "Lines {lines} have one direction; part 1 asks for different ones.",
        "VDI/VDE 2634 part 1, sec. 4",
        "Place the lines in different directions.",
    ),
    Kind(
        "longest_length_short",
        "warning",
        "The longest length is {longest}; part 1 asks for two thirds of the body diagonal of {diagonal}.",
        "VDI/VDE 2634 part 1, sec. 4",
        "Add a longer length, or state the measuring volume (--diagonal).",
    ),
    Kind(
        "temperature_unknown",
        "note",
        "The temperature of the lengths, and whether they were corrected for it, are not known here.",
        "no file states it",
        "Correct the lengths for temperature before the test.",
    ),
)
