"""Remarks on comparisons, epochs, refined models and other programs."""

from __future__ import annotations

from sfm.remarks.kind import Grade, Kind

OTHER_PROGRAMS = (
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
REFINING = (
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
ROWS = (
    Kind(
        "lengths_differ",
        "error",
        "Lengths in {second} are {lengths:.8g} +- {sigma:.2g} times those in {first}[[; {moved:point} "
        "{moved:differs|differ} besides]].",
        "a scale bar or control that is wrong in one of them, or an object that expanded, as warmth does",
        "Check the lengths of the scale bars, and the temperature of both surveys.",
    ),
    Kind(
        "unit_differs",
        "error",
        "Lengths in {second} are {lengths:.8g} times those in {first}[[, {rest:.8g} +- {sigma:.2g} beside "
        "the factor {factor:.8g}]], as between {finer} and {coarser}[[; {moved:point} {moved:differs|differ} "
        "besides]].",
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
        "results of two objects, or names that were given anew",
        "Check that both results are of one object with the same targets.",
    ),
    Kind(
        "strained",
        "error",
        "Lengths in {second} along {axis} are {lengths:.8g} +- {sigma:.2g} times those in {first}[[ beside "
        "the factor {factor:.8g}]][[; {moved:point} {moved:differs|differ} besides]].",
        "an object that expanded or was loaded in one direction, or a camera that is not described well",
        "Check temperature and load of the object; adjust both with per_photograph for c, and compare again.",
    ),
    Kind(
        "bent",
        "error",
        "{second} is bent as a whole against {first}, by up to {distance}[[; {moved:point} "
        "{moved:differs|differ} besides]].",
        "a camera that is not described well, as a lens that was zoomed, focused or loose; or a real bending",
        "Adjust both with per_photograph for c, x0 and y0, and compare again.",
    ),
    Kind(
        "points_differ",
        "error",
        "{differing:point} of {tested} {differing:differs|differ} significantly, by up to {distance}: "
        "{points}.",
        "points moved between the surveys, or an observation of one of them is wrong",
        "See the table of points.",
    ),
    Kind(
        "points_differ_together",
        "error",
        "The points differ as a whole (T {statistic}, limit {critical}), and none of them singly.",
        "many small displacements, or standard deviations that are too small",
        "See the picture for a pattern.",
    ),
    Kind(
        "no_majority_agrees",
        "error",
        "The points of {first} and {second} differ, and no half of them agrees.",
        "a change of the whole that is no simple one, or standard deviations that are far too small",
        "Name points that are known to be stable (--reference, --align control).",
    ),
    Kind(
        "interior_differs",
        "note",
        "Camera {camera} has another interior orientation: {parameter} differs by {difference}, {sigmas:.0f} "
        "standard deviations.",
        "zoom, focus or camera changed between the surveys, or a lens is loose",
        "Adjust both with per_photograph for the parameters, and compare again.",
    ),
    Kind(
        "tested_part",
        "note",
        "{tested} of {points} points {tested:is|are} tested, whose covariance together both results keep.",
        "of many points only a sample is kept with its covariance",
        "Nothing needs to be done.",
    ),
    Kind(
        "tested_singly",
        "note",
        "The test is approximate: the covariance between points is not known.",
        "the result is of another program, or of an older version",
        "Compare results of this version.",
    ),
    Kind(
        "no_common_points",
        "warning",
        "No points are common: only photographs and cameras are compared.",
        "names, image points and places are not the same",
        "See that names agree.",
    ),
    Kind(
        "same_image_points",
        "warning",
        "Not tested: {share:%} of the image points of {first} are those of {second}.",
        "two adjustments of one survey: the differences are those of adjusters, models and datum",
        "Compare results of separate photographs.",
    ),
    Kind(
        "no_sigmas",
        "warning",
        "Not tested: the standard deviations of the common points are not known.",
        "neither result has them",
        "Compare with a result that has standard deviations.",
    ),
    Kind(
        "no_common_datum",
        "warning",
        "Not tested: without an alignment only results in the datum of control are in one frame.",
        "a free or minimal datum, and --align none",
        "Align them by points or control.",
    ),
    Kind(
        "no_joint_covariance",
        "warning",
        "Not tested: the covariance between the points is not known.",
        "in a minimal datum or one of control, and between different datums, nothing can be tested without",
        "Run the survey again with this version, which keeps it.",
    ),
    Kind(
        "untestable",
        "warning",
        "Not tested: {reason}.",
        "too few points in common, or points that determine no datum",
        "Compare results with more points in common.",
    ),
    Kind(
        "displaced",
        "warning",
        "{first} to {second}: {displaced:point} of {tested} moved, by up to {distance}: {points}.",
        "what the epochs are for",
        "See the table of displacements.",
    ),
    Kind(
        "held_alike",
        "note",
        "{first} and {second} use the same held interior orientation of camera {cameras}: no standard "
        "deviation contains its error.",
        "its effect cancels only where photographs and object are the same; the rest can pass for a movement",
        "Adjust it (free), or together from a calibration with standard deviations (--together).",
    ),
    Kind(
        "held_apart",
        "note",
        "The interior orientation of camera {cameras} is held in {first} or {second} only, or at other "
        "values: no standard deviation contains its error.",
        "its effect does not cancel, and can pass for a movement",
        "Adjust it (free).",
    ),
    Kind(
        "mount_changed",
        "warning",
        "Camera {camera} was moved on its rig between {first} and {second} (T {statistic}, limit "
        "{critical}).",
        "the camera was taken off or knocked, or the frame of the rig bent",
        "Use mounts from the calibration that is nearer in time to a survey.",
    ),
    Kind(
        "one_camera",
        "note",
        "Camera {camera} has one interior orientation in {epochs}, on which they agree (T {statistic}, limit "
        "{critical}).",
        "the epochs were adjusted together",
        "Nothing needs to be done.",
    ),
)
