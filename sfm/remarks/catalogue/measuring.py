"""Remarks on points and image points, and on measuring a result."""

from __future__ import annotations

from sfm.remarks.kind import Grade, Kind

POINTS = (
    Kind(
        "rays_rejected",
        "warning",
        "More rays of {points:point} were rejected than expected by chance: {points}.",
        "a point moved, was misidentified, or is hard to measure",
        "Look at {points:its|their} rejected image points in the report.",
    ),
    Kind(
        "two_rays",
        "note",
        "{two:point} of {total} {two:has|have} only two rays: errors along the epipolar line remain "
        "undetected.",
        "only two photographs show {two:it|them}",
        "Add a photograph of {two:this point|these points}.",
    ),
    Kind(
        "points_not_determined",
        "note",
        "{points:point} of {measured} {points:is|are} not in the result, as {points:its|their} rays do not "
        "determine {points:it|them}: {points}.",
        "a point is in fewer photographs than it needs, or its rays are almost parallel",
        "Add photographs of {points:this point|these points}, if you need {points:it|them}.",
    ),
    Kind(
        "points_contradicted",
        "warning",
        "{points:point} of {measured} {points:is|are} not in the result, as {points:its|their} rays do not "
        "meet: {points}.",
        "a point moved, or was misidentified in a photograph",
        "Look at the reasons in left_out.csv; correct {points:its|their} image points, or do without "
        "{points:it|them}.",
    ),
    Kind(
        "point_with_few_rays",
        "note",
        "It has {rays:ray}; {needed} are needed.",
        "the point is in fewer photographs than it needs",
        "Add photographs of the point, if you need it.",
    ),
    Kind(
        "point_of_lost_photographs",
        "note",
        "Fewer than {needed} of its {measured} rays are from photographs in the result.",
        "photographs that show it are not in the result",
        "See the reasons of these photographs.",
    ),
    Kind(
        "point_with_parallel_rays",
        "note",
        "Its {rays} rays are parallel within their precision.",
        "the point is far away, or its photographs were taken from one place",
        "Add photographs from other positions.",
    ),
    Kind(
        "point_with_rays_apart",
        "warning",
        "Its {rays} rays do not meet in front of their photographs.",
        "the point moved, or was misidentified in a photograph",
        "Correct its image points, or do without it.",
    ),
    Kind(
        "point_with_rays_rejected",
        "warning",
        "{accepted} of its {measured} rays {accepted:was|were} accepted; {needed} are needed.",
        "the point moved, was misidentified in a photograph, or its rays are almost parallel",
        "Correct its image points, or do without it.",
    ),
    Kind(
        "points_doubtful",
        "warning",
        "{points:point} {points:has|have} doubtful coordinates, as either of two rays may be wrong: "
        "{points}.",
        "too few rays to decide which one is wrong",
        "Add photographs of {points:this point|these points}.",
    ),
    Kind(
        "points_with_large_residuals",
        "warning",
        "Taken together, the residuals of {points:point} are larger than expected by chance: {points}.",
        "a point moved a little, is damaged, or is seen at a flat angle",
        "Look at {points:it|them} in the photographs; "
        "leave out {points:the point if you do not trust it|any that you do not trust}.",
    ),
    Kind(
        "image_points_identical",
        "note",
        "{image_points:image point} {image_points:appears|appear} more than once at the same position: "
        "{image_points}. Each counts once.",
        "repeated rows in the table",
        "Remove the copies.",
    ),
    Kind(
        "image_points_averaged",
        "note",
        "{image_points:image point} {image_points:was|were} measured more than once and averaged: "
        "{image_points}.",
        "the measurements differ by no more than chance",
        "Nothing needs to be done.",
    ),
    Kind(
        "image_points_contradicting",
        "warning",
        "{image_points:image point} {image_points:was|were} measured at different positions and left "
        "out: {image_points}.",
        "two points in one photograph share a name",
        "Correct the names.",
    ),
    Kind(
        "code_at_several_places",
        "warning",
        "Code {code} is read at several positions: {photographs} {photographs:shows|show} it elsewhere "
        "than {others:other photograph}[[, at {points}]].",
        "a target was moved, two targets share a number, or a code was misread",
        "Remove one of the targets, or survey the states separately.",
    ),
    Kind(
        "plate_elsewhere",
        "warning",
        "A plate is at a different position in {photographs}: that of {points:point} {points}.",
        "a plate slipped between the photographs, or the support of the plates bent",
        "Fix the plates to one another and photograph them again, or survey the states separately.",
    ),
    Kind(
        "plate_points_apart",
        "warning",
        "{points:point} of the plate {points:has|have} rays that do not meet at one position, from "
        "{photographs}: {points}.",
        "a board of another size, of which a part was named; a lens that the model does not describe; or a "
        "plate that was bent",
        "Let kolinear init draft the survey anew; it finds rows, columns and model of the lens.",
    ),
    Kind(
        "code_rays_apart",
        "warning",
        "The rays to code {code} from {photographs} do not meet.",
        "a target was moved, two targets share a number, or a code was misread",
        "Remove one of the targets, or survey the states separately.",
    ),
    Kind(
        "codes_too_small",
        "note",
        "{targets:target} {targets:has a code that is|have codes that are} too small to read: dots are "
        "{dot} across, with edges blurred by {blur}; {needed} are needed.",
        "targets are too small or too far away, or photographs are not sharp",
        "Print the targets larger, move closer or focus better.",
    ),
    Kind(
        "second_motion",
        # No rendered scene without motion has this remark. One twentieth of the points may be the object
        # itself, mostly hidden by things that move.
        Grade("share", warning=0.01, error=0.05),
        "{points:tie point}, {share:%} of all, in {photographs} {points:fits|fit} one another but not "
        "the others: the photographs show two things that moved relative to each other.",
        "people, vehicles or leaves that moved together, a pattern that repeats, or a reflection",
        "Check which points are in the result: they may be those of the thing that moved. Photograph the "
        "object without it.",
    ),
    Kind(
        "windows_disagree",
        # The share is 0.04 to 0.09 on stone and rendered surfaces. Of windows placed at random within 3 px of
        # the predicted positions, 0.33 agree by chance (ten photographs of a telephone).
        Grade("share", warning=0.3, error=0.6),
        "{share:%} of the matched windows disagree with each other, and some of the others agree only by "
        "chance.",
        "the surface looks different from photograph to photograph: shine, steps, angles beyond 25 degrees",
        "Add photographs at smaller angles; coordinates may be worse than their standard deviations.",
    ),
    Kind(
        "diameter_differs",
        "warning",
        "The stated diameter of {targets:target} is {stated}, but the ellipses show {found}.",
        "the diameter is that of a ring, or in another unit, or the scale is wrong",
        "State the diameter of the dot in the object unit, and check the scale bars.",
    ),
    Kind(
        "diameters_differ",
        "warning",
        "The ellipses of {differing} of {total} targets differ by more than {limit} from the stated "
        "{differing:diameter|diameters}, most that of {target}: {stated} stated, {found} found.",
        "diameters are those of rings, or in another unit, or of other targets",
        "State the diameters of the dots in the object unit, by the ids of the targets.",
    ),
    Kind(
        "diameters_of_unknown",
        "warning",
        "Diameters are stated for targets that are not in the survey: {targets}.",
        "ids that no target has",
        "Correct the ids in the table of diameters.",
    ),
)
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
        "{tolerance}: {undecided} of {total} deviations {undecided:is|are} too close to the limit to be "
        "decided.",
        "the uncertainty of the measurement reaches across the limit",
        "Measure with a smaller uncertainty: take more photographs, or move closer.",
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
        "others ignore correlations.",
        "of many points, results store the covariance of a sample only",
        "Give the points that you measure names: named points come first.",
    ),
    Kind(
        "covariance_of_single_points",
        "warning",
        "Only the covariance of each single point is known: standard deviations of shapes and distances "
        "ignore correlations.",
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
        "the joint covariance of the points was not stored",
        "Run the survey again.",
    ),
    Kind(
        "lengths_outside",
        "error",
        "{outside} of {total} lengths {outside:is|are} proven to be outside the limit.",
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
        "{undecided} of {total} lengths {undecided:is|are} proven neither inside nor outside the limit.",
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
        "points of two lines share a line name",
        "Correct the column line.",
    ),
    Kind(
        "lines_parallel",
        "warning",
        "Lines {lines} have the same direction; part 1 asks for different ones.",
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
