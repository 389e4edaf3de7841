"""Remarks on other programs, refined models, comparisons and epochs."""

from __future__ import annotations

from sfm.model.remarks.row import Grade, Kind

OTHER_PROGRAMS = (
    Kind(
        "adjuster_differs",
        "warning",
        "{program} does not agree with the adjustment.",
        "one of the two has not reached the minimum",
        "Read the comparison in the report.",
    ),
    Kind(
        "adjuster_fits_better",
        "warning",
        "The camera of {program} with {parameters} free fits {times} times better: RMS {rms} instead of "
        "{before}.",
        "the camera model of the survey does not suit the lens",
        "Free these parameters, if a camera can have the values in the comparison.",
    ),
    Kind(
        "comparison_failed",
        "warning",
        "The comparison with {what:@} failed: {reason}.",
        "the other program refused the network or the photographs",
        "Correct what the reason names, or leave the comparison out of [compare]. The result is the same.",
    ),
)
REFINING = (
    Kind(
        "refinement_not_better",
        "error",
        "Halves of the points differ {times} times as much as those of the model as it came, which is kept.",
        "a model that was refined before, a camera model that does not suit the lens, something that moved, "
        "blurred photographs",
        "Use the model as it came; or another camera model, photographs of their original size, or masks for "
        "what moved.",
    ),
    Kind(
        "photographs_not_adjusted",
        "warning",
        "{photographs:photograph} {photographs:was|were} not adjusted: {photographs}.",
        "too few of {photographs:its|their} key points could be re-measured",
        "See the reasons beside the key points; {photographs:the photograph keeps|the photographs keep} the "
        "orientation of the model.",
    ),
    Kind(
        "key_points_not_measured",
        Grade("missing", warning=0.5),  # if half or more are missing, photographs or windows are wrong
        "Only {measured} of {total} key points {measured:was|were} re-measured.",
        "photographs of another size or state than those of the model, or little texture",
        "Give the photographs of the model; see the reasons beside the key points.",
    ),
)
ROWS = (
    Kind(
        "lengths_differ",
        "error",
        "Lengths in {second} are {lengths:.8g} +- {sigma:.2g} times those in {first}[[; in addition, "
        "{moved:point} {moved:differs|differ}]].",
        "a scale bar or control that is wrong in one of them, or an object that expanded, for example "
        "when it warmed up",
        "Check the lengths of the scale bars, and the temperature of both surveys.",
    ),
    Kind(
        "unit_differs",
        "error",
        "Lengths in {second} are {lengths:.8g} times those in {first}[[, {rest:.8g} +- {sigma:.2g} apart "
        "from the factor {factor:.8g}]], as between {finer} and {coarser}[[; in addition, {moved:point} "
        "{moved:differs|differ}]].",
        "lengths of bars or control were entered in another unit than the survey states",
        "Enter them in the object unit of the survey, or correct the unit.",
    ),
    Kind(
        "mirrored",
        "error",
        "{second} is the mirror image of {first}.",
        "axes exchanged or one of them reversed: left-handed control, x and y swapped, photographs flipped",
        "Check the handedness of control and image points; do not flip photographs.",
    ),
    Kind(
        "names_differ",
        "error",
        "{count:point} {count:has|have} other names in {second} than in {first}: {exchanged}.",
        "targets were exchanged or renumbered between the surveys, or a table was sorted",
        "Correct the names in one of them, and compare again.",
    ),
    Kind(
        "another_object",
        "error",
        "The {points:point} of {first} and {second} with the same names show no common shape.",
        "results of two objects, or points that were renamed",
        "Check that both results are of one object with the same targets.",
    ),
    Kind(
        "strained",
        "error",
        "Lengths in {second} along {axis} are {lengths:.8g} +- {sigma:.2g} times those in {first}[[ "
        "apart from the factor {factor:.8g}]][[; in addition, {moved:point} {moved:differs|differ}]].",
        "an object that expanded or was loaded in one direction, or a camera model that does not suit "
        "the lens",
        "Check temperature and load of the object; adjust both with per_photograph for c, and compare again.",
    ),
    Kind(
        "bent",
        "error",
        "{second} is bent as a whole relative to {first}, by up to {distance}[[; in addition, "
        "{moved:point} {moved:differs|differ}]].",
        "a camera model that does not suit the lens, or a lens that was zoomed, refocused or loose; or "
        "the object really bent",
        "Adjust both with per_photograph for c, x0 and y0, and compare again.",
    ),
    Kind(
        "points_differ",
        "error",
        "[[{differing:point} of {tested} {differing:differs|differ} significantly, by up to {distance}: "
        "{points}]][[The exterior orientation of {photographs} differs significantly: T {orientation}, limit "
        "{critical}]][[The points differ as a whole (T {statistic}, limit {critical}), but no single point "
        "does]].",
        "points or photographs moved between the surveys, an observation of one of them is wrong, or "
        "standard deviations are too small",
        "See the table of points or photographs, and look for a pattern in the figure.",
    ),
    Kind(
        "no_majority_agrees",
        "error",
        "The points of {first} and {second} differ, and no half of them agrees.",
        "a complex change of the whole object, or standard deviations that are far too small",
        "Of two results of the same photographs, in which nothing moved, use the one that is not the weaker; "
        "else name points that are known to be stable (--reference, --align control).",
    ),
    Kind(
        "interior_differs",
        "note",
        "Camera {camera} has a different interior orientation: {parameter} differs by {difference}, "
        "{sigmas:.0f} standard deviations.",
        "zoom, focus or camera changed between the surveys, or a lens is loose",
        "Adjust both with per_photograph for the parameters, and compare again.",
    ),
    Kind(
        "weaker_solution",
        "note",
        "{weaker} is weaker than {of}[[: the standard deviation of its image points is {theirs}, that of "
        "{of} {ours}]][[; its lens model {model} is too lean for {cameras:@camera}: with it, the standard "
        "deviation of the image points of {of} is {fits} in place of {own}]].",
        "photographs, targets or texture that are measured less precisely, or too few terms of distortion",
        "Of the same photographs, believe {of}; give {weaker} more precise image points, or a camera model "
        "with more terms.",
    ),
    Kind(
        "same_image_points",
        "warning",
        "Not tested: {share:%} of the image points of {first} are also those of {second}.",
        "two adjustments of one survey: the differences are those of adjusters, models and datum",
        "Compare results of separate photographs.",
    ),
    Kind(
        "no_covariance",
        "warning",
        "Not tested: {unknown:@} of the common points are not known.",
        "another program or an older version computed the results; in a minimal datum or one of control, and "
        "between different datums, nothing can be tested without them",
        "Compare results that this version computed.",
    ),
    Kind(
        "untestable",
        "warning",
        "Not tested: {reason}.",
        "names, image points or positions differ, too few points are common, or they determine no datum",
        "Make the names agree, align by points or control, or compare results with more points in common.",
    ),
    Kind(
        "displaced",
        "warning",
        "{first} to {second}: {displaced:point} of {tested} moved, by up to {distance}: {points}.",
        "points moved between the epochs",
        "See the table of displacements.",
    ),
    Kind(
        "cameras_held",
        "note",
        "{first} and {second} hold the interior orientation of camera {cameras} fixed, {how:@}: no standard "
        "deviation includes its error.",
        "its effect cancels only where values, photographs and object are the same; the rest can pass for a "
        "movement",
        "Adjust it (free), or together from a calibration with standard deviations (--together).",
    ),
    Kind(
        "mount_changed",
        "warning",
        "Camera {camera} was moved on its rig between {first} and {second} (T {statistic}, limit "
        "{critical}).",
        "the camera was taken off or knocked, or the frame of the rig bent",
        "For each survey, use the mounts that were calibrated nearest to it in time.",
    ),
)
