"""Remarks on datum and scale, and on given values: scale bars, control and observed orientation."""

from __future__ import annotations

from sfm.model.conventions import SWELLING
from sfm.model.remarks.row import HARMLESS_SIGMAS, WRONG_SIGMAS, Grade, Kind, Unless

DATUM = (
    Kind(
        "scale_weak",
        Grade("sigma", warning=1.0, error=5.0),
        "The scale rests on {observations} alone and is known to {sigma} (1 sigma).",
        "differences near 0, or few observations",
        "Add a scale bar or a distance.",
    ),
    Kind(
        "scale_undefined",
        "note",
        "The scale is undefined: lengths are not in {unit}[[; {control:control point} of the {needed} that "
        "give it {control:is|are} used]].",
        "photographs alone have no scale",
        "Measure a scale bar or control.",
    ),
    Kind(
        "names_missing",
        "warning",
        "Of {of:@}, {names} {names:is|are} not in the result.",
        "names that no measured point or target has, or points with too few rays: a plane needs 4, a line "
        "3, a rigid frame 2, a station 2 targets",
        "Mark a point that is in one photograph in another one; correct the names of all others: those of "
        "points.csv, and coded targets have their numbers.",
    ),
    Kind(
        "exif_positions_far",
        "warning",
        "The positions of {far} in EXIF data are more than {limit} from the others and were not used.",
        "a receiver without reception that repeated its last position or a default",
        "Correct or remove the position if the photograph belongs to the survey.",
    ),
    Kind(
        "exterior_unused",
        "note",
        "Observed exterior orientation is not used in datum '{datum}'.",
        "it determines position, attitude and scale, which this datum takes from the points",
        'Set datum.kind = "control" to use it.',
    ),
    Kind(
        "approximate_unused",
        "warning",
        "[[The given orientation of {photograph} was replaced: {fitting} of {image_points:image point} "
        "{fitting:fits|fit} it, {after} {after:fits|fit} the new one]][[The given approximate values orient "
        "{before} of the {now} photographs that can be oriented without them, and were not used]][[The given "
        "approximate values contradict {control:@} and were not used]].",
        "the values are wrong or in another frame, or control is wrong",
        "Correct or complete [approximate], or leave it out.",
    ),
)
CHECK_THE_LIST = "a number mistyped, the wrong ends or name, another unit, or a point that moved"
WRONG_SIZE = "pitch is mistyped or nominal, or a plate was printed to another scale"
# A value that a test rejects deserves a warning. It is an error if it makes the result wrong.
DETECTED = Grade("shift", error=WRONG_SIGMAS)
# Kinds that follow if fixed or weighted coordinates with a wrong shape distort the network.
PULLED = (
    *("image_points_rejected", "residual_kept", "sigma0_high", "points_doubtful"),
    *("points_with_large_residuals", "photographs_uneven"),
)
ROWS = (
    Kind(
        "kind_wrong",
        # what is explained, or alone contradicts a rest that agrees, does no harm if it is not used
        Unless(("mistake", "rest"), "error", "warning"),
        "The other observations contradict most {of}; none of them was used.[[ They agree if {mistake:@?}.]]"
        "[[ The rest agrees, with {rest} degrees of freedom.]]",
        "another unit, order of columns, sense of an axis or angle, or names exchanged",
        "Check the table: signs, units, and the point or photograph of each row.",
    ),
    Kind(
        "observations_wrong",
        "warning",
        "{observations:survey observation} contradicted all others and {observations:was|were} not used: "
        "{observations}.[[ {observations:It agrees|They agree} if {mistake:@?}.]]",
        "a misread or mistyped value, another point, or a standard deviation that is too small",
        "Correct {observations:this value|these values}, or state a larger standard deviation.",
    ),
    Kind(
        "rows_identical",
        "note",
        "{rows:row} of a table {rows:is|are} there more than once with the same numbers: {rows}. Each counts "
        "once.",
        "rows that were copied into the table twice",
        "Remove the copies; measurements that were repeated differ in a digit.",
    ),
    Kind(
        "scale_left_out",
        "warning",
        "The scale of [[{given:@bar}]][[{plate}]] [[differs by {off:+} from]][[is {times} times]] that of "
        "the other given values, {sigmas} standard deviations[[; nearly a factor of {unit_factor}, as "
        "between {finer} and {coarser}]]. It was left out.",
        "a mistyped, nominal or wrongly named length, another unit or temperature, a tape that is too long, "
        "a print that shrank, or points that moved",
        "Correct these values or remove them; state plate_sigma for a plate.",
    ),
    Kind(
        "scale_contradicted",
        "error",
        "No dependable scale: [[{given:@bar}]][[mounts of {cameras}]][[ and {agreeing:scale bar}]][[ and "
        "{others:@}]] contradict one another by [[{off}]][[a factor of {times}]], {sigmas} standard "
        "deviations[[; nearly a factor of {unit_factor}, as between {finer} and {coarser}]].",
        CHECK_THE_LIST,
        "Check these lengths, bases and their unit; a third source of scale shows which one is wrong.",
    ),
    Kind(
        "mount_contradicted",
        Unless(("mistake", "rest"), "error", "warning"),
        "The mount given for {camera} contradicts the photographs, by {angle} in its rotation and "
        "{direction} in the direction of its base, {sigmas} standard deviations: it was not used.[[ It fits "
        "if {mistake:@}.]]",
        "another convention of rotations or signs, the mount of another camera, or a camera that was moved",
        "Give X, Y, Z and the rotation of this camera in the image axes of the reference camera, or remove "
        "its mount.",
    ),
    Kind(
        "plate_sizes_contradict",
        "error",
        "No dependable scale: sizes of {given}[[ and of {others}]] contradict one another by "
        "[[{off}]][[a factor of {times}]], {sigmas} standard deviations[[; nearly a factor of "
        "{unit_factor}, as between {finer} and {coarser}]].",
        WRONG_SIZE,
        "Measure each plate from its first to its last row and column; correct pitch, or state plate_sigma.",
    ),
    Kind(
        "datum_contradicted",
        "error",
        "No dependable datum: {given:@} each fit the network of the image points, but place it up to "
        "{distance} apart (chi-square {chi2}, {dof} degrees of freedom): neither was used.",
        "coordinates of two systems or epochs, or antennas or prisms that are not in the projection centres",
        "Find out which of them are wrong; give projection centres in the system of the control, reduced by "
        "the offset from antenna or prism to camera.",
    ),
    Kind(
        "given_left_out",
        "warning",
        "Of {of:@}, {given} {given:does|do} not fit the network of the image points, by up to "
        "{distance}, {sigmas} standard deviations: {given:it was|they were} left out.[[ "
        "{given:It fits|They fit} if {mistake:@}.]]",
        CHECK_THE_LIST,
        "Correct these coordinates or remove them.",
    ),
    Kind(
        "given_contradicted",
        DETECTED,
        "Some of {of:@} contradict one another (chi-square {chi2}, {dof} degrees of freedom): {given} "
        "may be wrong[[; the wrong one shifts coordinates by up to {shift} standard deviations]].[[ The "
        "names of {exchanged} may be swapped, in more than one way.]]",
        CHECK_THE_LIST,
        "Check these coordinates; more given points show which one is wrong.",
    ),
    Kind(
        "given_strained",
        "error",
        "The coordinates of {of:@} are stretched by {elongation:+}[[ along {axis}]] (chi-square {chi2} "
        "as given, {fitting} without the stretch): scale and shape of the result are not dependable.",
        "coordinates of a print or a scan, or axes with different scales or units",
        "Correct the scale of the axes, or give measured coordinates.",
        explains=(*PULLED, "shape_of_control"),
    ),
    Kind(
        "given_renamed",
        "warning",
        "Of {of:@}, {given} {given:has|have} the coordinates of {given:another point|other points}: "
        "{given:its|their} coordinates were reassigned.",
        "swapped names or a list shifted by one row, in the given coordinates or in the photographs",
        "Correct {given:this name|these names}.",
    ),
    Kind(
        "given_mirrored",
        "error",
        "The coordinates of {of:@} are mirrored (chi-square {chi2} as given, {mirrored} if mirrored)[[, "
        "or the names of {exchanged} are swapped]]: they were not used.[[ Even mirrored, {given} "
        "{given:does|do} not fit: the second chi-square is without {given:it|them}.]]",
        "left-handed coordinates, two axes swapped, the sign of one axis changed, mirrored photographs, "
        "or the names of left and right swapped",
        "Give X, Y and Z of a right-handed system; check the names of the points.",
    ),
    Kind(
        "given_sigmas",
        "warning",
        "The standard deviations stated for {of:@} are {factor} times too small[[: the adjustment used "
        "{used} times the stated ones]].",
        "standard deviations in another unit or of the instrument alone, or points that moved",
        "State standard deviations that the differences at these points confirm.",
    ),
    Kind(
        "given_not_exact",
        # The test is on the differences; a result that they hardly shift is not harmed.
        Grade("shift", warning=HARMLESS_SIGMAS, error=WRONG_SIGMAS),
        "Coordinates of {of:@}, held fixed, differ by {sigma} from the network of the image points, more "
        "than by chance. This shifts the result by up to {shift} of its standard deviations, which do "
        "not include it.",
        "coordinates of a drawing or a print, or points that moved",
        "State the standard deviations of these coordinates.",
        short="fixed coordinates that are not exact",
        explains=PULLED,
    ),
    Kind(
        "given_scatter",
        # weighted, they harm no result; beyond the swelling of paper they are hardly rounded coordinates
        Grade("share", warning=100 * SWELLING, at_most=Grade("shift", warning=WRONG_SIGMAS)),
        "Coordinates of {of:@}, stated as exact, scatter by {sigma} ({share} of their extent) against the "
        "network of the image points, more than by chance: they were weighted with it. Held fixed, they "
        "would shift the result by up to {shift} of its standard deviations.",
        "rounded coordinates, coordinates of a drawing or a print, or points that moved",
        "State the standard deviations of these coordinates.",
    ),
    Kind(
        "given_differs",
        Grade("harm", error=WRONG_SIGMAS),  # the shift of a coordinate or length, 0 of an orientation
        "The given {given} differs from the adjusted one by {difference}, {sigmas} standard deviations[[, "
        "and shifts it by {shift} standard deviations]].",
        "a mistyped number, wrong ends or name, another unit, a point that moved; another order or sense "
        "of the angles",
        "Correct this value, or state a larger standard deviation.",
    ),
    Kind(
        "checks_differ",
        Grade("more", error=1.0),  # more of them differ than agree
        "{count} of the {all} check points {count:differs from its|differ from their} given coordinates, "
        "by up to {distance} in {coordinates}, {sigmas} standard deviations: {points}.",
        "wrong control or scale, a weak network, or check points that are mistyped, moved or in another "
        "system",
        "Find out whether control or check points are wrong before you use the result.",
    ),
    Kind(
        "scale_implausible",
        "error",
        "The scale is implausible: the object is {distance} in front of the camera, its image "
        "{magnification} times as large as the object.",
        "lengths or control in another unit than the survey",
        "Check the unit of the survey and of its lengths.",
    ),
)
