"""Remarks on points and image points, and on measuring a result."""

from __future__ import annotations

from sfm.model.remarks.row import Grade, Kind, Unless

POINTS = (
    Kind(
        "points_not_determined",
        "note",
        "[[{points:point} of {measured} {points:is|are} not in the result, as {points:its|their} rays do not "
        "determine {points:it|them}: {points}]][[It has {rays:ray}; {needed} are needed]][[Fewer than "
        "{least} of its {measured} rays are from photographs in the result]][[Its {parallel} rays are "
        "parallel within their precision]]."
        "[[ {checks} {checks:is a check point that checks|are check points that check} nothing.]]",
        "too few photographs, a point far away, or photographs from one place",
        "Add photographs from other positions where you need the coordinates.",
    ),
    Kind(
        "points_contradicted",
        "warning",
        "[[{points:point} of {measured} {points:is|are} not in the result, as {points:its|their} rays do not "
        "meet: {points}]][[Its {rays} rays do not meet in front of their photographs]][[{accepted} of its "
        "{measured} rays {accepted:was|were} accepted; {needed} are needed]]."
        "[[ {checks} {checks:is a check point that checks|are check points that check} nothing.]]",
        "a point moved, was misidentified in a photograph, or its rays are almost parallel",
        "Correct the image points for the reason that left_out.csv states, or leave them out.",
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
        "image_sigmas",
        # see `sfm.judgement.stated_precision`
        Grade("factor", warning=0.0, error=2.0, at_most=Grade("rejected", warning=0.0, error=0.05)),
        "Beside the others, {count:image point} of {points:point} {count:scatters|scatter} at least {factor} "
        "times as much as stated ({stated}): {points}.",
        "standard deviations that are those of the software alone, or in another unit",
        "State standard deviations that the residuals confirm, or leave sx_px and sy_px out.",
        explains=(
            *("image_points_rejected", "residual_kept", "sigma0_high", "points_doubtful"),
            *("points_with_large_residuals", "photographs_uneven"),
        ),
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
        "image_points_contradicting",
        "warning",
        "{image_points:image point} {image_points:was|were} measured at different positions and left "
        "out: {image_points}.",
        "two points in one photograph share a name, or a place was marked wrongly",
        "Correct the names, or the places that were marked.",
    ),
    Kind(
        "sources_contradict",
        Unless(("offset",), "error", "warning"),
        "{sources:@} contradict one another: {common:image point} that both have {common:is|are} {distance} "
        "apart (median)[[, all by about {offset}: {x:+} in x, {y:+} in y]]; the first were left out there.",
        "other names of points or photographs; if alike, another origin of pixels: the corner of the first "
        "pixel is half a pixel from its centre",
        "Correct the table of image points, or leave it out; the others in it are used, and may be off as "
        "well.",
    ),
    Kind(
        "photographs_without_file",
        "note",
        "{photographs:photograph} with given image points {photographs:is|are} not among the files: "
        "{photographs}[[; {points} {points:is|are} marked in no other]].",
        "the survey is a part of more photographs, only their image points were handed over, or a name in "
        "the table differs from that of the file",
        "Correct the table if the photograph is here.",
    ),
    Kind(
        "marks_unmatched",
        "warning",
        "{points:named point} {points:was|were} found in too few other photographs: {points}[[; several "
        "places look like {alike}]].",
        "the window around the place has no texture, repeats a pattern, is at an edge of the object or "
        "hidden in the others; or its photograph is not oriented",
        "Mark a place with texture on one surface, or mark the point in another photograph too.",
    ),
    Kind(
        "codes_at_several_places",
        "warning",
        "{codes:code} {codes:has|have} rays that do not meet at one position: {codes}, in "
        "{photographs}[[; the other positions are {points}]].",
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
        "{points:point} of the plate {points:is|are} elsewhere than in the other photographs[[, in "
        "{photographs}]]: {points}[[; {agreeing} {agreeing:agrees|agree} with it]].",
        "a board of another size, of which a part was named; another or a bent plate; or a lens that the "
        "model does not describe",
        "Let kolinear init draft the survey anew; it finds rows, columns and model of the lens.",
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
        "still_features",
        # a twentieth, as for a second motion
        Grade("share", warning=0.05),
        "{share:%} of the matched features in {photographs} stand still while the others move, and are left "
        "out.",
        "an object that turns before a background that stands still, or writing burned into the photographs",
        "Mask it ([survey] masks), if the result is not of the object.",
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
        "diameters_differ",
        "warning",
        "The ellipses of {differing:target}[[ of {total}]] contradict the stated "
        "{differing:diameter|diameters}[[, most that of {target}]]: {stated} stated, {found} found.",
        "diameters are those of rings, or in another unit, or of other targets, or the scale is wrong",
        "State the diameters of the dots in the object unit, and check the scale bars.",
    ),
)
ROWS = (
    Kind(
        "out_of_tolerance",
        "error",
        "[[{tolerance}: ]]{out} of {total} deviations {out:is|are} out of tolerance[[: {points}]][[; the "
        "standard deviation of {unknown} is unknown]].",
        "the deviation is larger than the tolerance and the uncertainty, or the column sigma is empty",
        "See the table of deviations; enter standard deviations of the calibration.",
    ),
    Kind(
        "tolerance_undecided",
        "warning",
        "[[{tolerance}: ]]{undecided} of {total} deviations {undecided:is|are} too close to the limit to be "
        "decided.",
        "the uncertainty of the measurement or of the calibration reaches across the limit",
        "Measure with a smaller uncertainty: take more photographs, move closer, or use lengths with a "
        "better calibration.",
    ),
    Kind(
        "tolerance_unknown",
        "warning",
        "[[{tolerance}: ]]{unknown} of {total} deviations {unknown:has|have} no standard deviation and "
        "{unknown:is|are} not decided.",
        "the result has no covariance of these points, or the column sigma of the lengths is empty",
        "Measure a result with standard deviations; enter those of the calibration.",
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
        "covariance_incomplete",
        "warning",
        "The covariance between points is known of {known} of {total} points: standard deviations of "
        "shapes and distances ignore the other correlations.",
        "the result is of another program, or of many points, of which results store the covariance of a "
        "sample",
        "Give the points that you measure names, as named points come first, or run the survey again.",
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
        "Add control to the survey, or an alignment to the features file; lengths do not depend on it.",
    ),
    Kind(
        "lengths_lacking",
        "warning",
        "[[There {lines:is|are} {lines:measuring line}; part 1 asks for {needed}]][[Line {line} has "
        "{lengths:length}; part 1 asks for {needed}]][[Lines {parallel} have the same direction; part 1 "
        "asks for different ones]][[The longest length is {longest}; part 1 asks for two thirds of the "
        "body diagonal of {diagonal}]].",
        "VDI/VDE 2634 part 1, sec. 4",
        "Add measuring lines or longer lengths, or state the measuring volume (--diagonal).",
    ),
    Kind(
        "line_not_straight",
        "warning",
        "The lengths of line {line} are not on one line.",
        "points of two lines share a line name",
        "Correct the column line.",
    ),
)
