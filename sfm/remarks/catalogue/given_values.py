"""Remarks on datum and scale, and on given values: scale bars, control and observed orientation."""

from __future__ import annotations

from sfm.conventions import SWELLING
from sfm.remarks.kind import EXPECTED_SIGMAS, WRONG_SIGMAS, Grade, Kind, Unless

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
        "The scale is undefined: lengths are not in {unit}.",
        "photographs alone have no scale",
        "Measure a scale bar or control.",
    ),
    Kind(
        "control_missing",
        "warning",
        "Control is not in the result: {points}.",
        "names that no measured point has, or points with too few rays",
        "Correct the names: those of points.csv; coded targets have their numbers.",
    ),
    Kind(
        "scale_bars_missing",
        "warning",
        "Scale bars have an end that is not in the result: {bars}.",
        "names that no measured point has, or points with too few rays",
        "Correct from and to: names of points.csv; coded targets have their numbers.",
    ),
    Kind(
        "model_keeps_frame",
        "note",
        "The model keeps its frame and scale.",
        "neither control nor scale bars in the survey",
        "Give control or scale bars for lengths in the object unit.",
    ),
    Kind(
        "datum_points_missing",
        "warning",
        "Datum points are not in the network: {points}.",
        "names that no measured point has, or points with too few rays",
        "Correct the names in datum.points.",
    ),
    Kind(
        "exif_positions",
        "note",
        "EXIF data give the projection centres of {positions} of {photographs} photographs, used as "
        "observations: X east and Y north (WGS 84) from latitude {latitude:.3f}, longitude "
        "{longitude:.3f}, Z the height as stated, above sea level or the ellipsoid.",
        "exif_sigma_m in [exterior]. EXIF data do not state the reference of heights. Standard "
        "deviations do not include errors that photographs share: those of the receiver, metres over "
        "minutes, and the offset of its antenna from the camera",
        "Use bars or control for scale and coordinates that must be better than the receiver.",
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
        "The given approximate values orient {before} of the {now} photographs that can be oriented without "
        "them, and were not used.",
        "the values contradict the photographs",
        "Correct or complete [approximate], or leave it out.",
    ),
    Kind(
        "approximate_contradicts_control",
        "warning",
        "The given approximate values contradict the control and were not used.",
        "the values are in another frame, or control is wrong",
        "Correct or complete [approximate], or leave it out.",
    ),
    Kind(
        "orientation_replaced",
        "warning",
        "The given orientation of {photograph} was replaced: {before} of {image_points:image point} "
        "{before:fits|fit} it, {after} {after:fits|fit} the new one.",
        "the given orientation is wrong",
        "Correct or complete [approximate], or leave it out.",
    ),
)
CHECK_THE_LIST = "a number mistyped, the wrong ends or name, another unit, or a point that moved"
WRONG_SIZE = "pitch is mistyped or nominal, or a plate was printed to another scale"
# A value that a test rejects deserves a warning. It is an error if it makes the result wrong.
DETECTED = Grade("shift", error=WRONG_SIGMAS)
# Kinds that follow if fixed or weighted coordinates with a wrong shape distort the network.
PULLED = (
    *("image_points_rejected", "rays_rejected", "residual_kept", "sigma0_high", "points_doubtful"),
    *("points_with_large_residuals", "photographs_uneven"),
)
ROWS = (
    Kind(
        "kind_wrong",
        Unless("mistake", "error", "warning"),  # what is explained and not used does no harm
        "The other observations contradict most {of}; none of them was used.[[ They agree if {mistake:?}.]]",
        "another unit, order of columns, sense of an axis or angle, or names exchanged",
        "Check the table: signs, units, and the point or photograph of each row.",
    ),
    Kind(
        "observations_wrong",
        "warning",
        "{observations:survey observation} contradicted all others and {observations:was|were} not used: "
        "{observations}.[[ {observations:It agrees|They agree} if {mistake:?}.]]",
        "a misread or mistyped value, another point, or a standard deviation that is too small",
        "Correct {observations:this value|these values}, or state a larger standard deviation.",
    ),
    Kind(
        "observations_unused",
        "warning",
        "{observations:survey observation} {observations:was|were} not used: {observations}.",
        "their points or photographs are not in the result, or too few points of a group are: a plane "
        "needs 4, a line 3, a rigid frame 2, a station 2 targets",
        "Correct the names, or look among the points that were left out.",
    ),
    Kind(
        "observations_identical",
        "note",
        "{observations:survey observation} {observations:is|are} more than once in a table with the same "
        "numbers: {observations}. Each counts once.",
        "rows that were copied into the table twice",
        "Remove the copies; measurements that were repeated differ in a digit.",
    ),
    Kind(
        "frame_points_computed",
        "note",
        "{points:point} of rigid frames {points:is|are} in no photograph and {points:was|were} computed "
        "from the other points of the frame: {points}.",
        "a tip that touches the object, or a mistyped name",
        "Nothing needs to be done if photographs do not show {points:it|them}; otherwise correct the name.",
    ),
    Kind(
        "bar_left_out",
        "warning",
        "Scale bar {given} [[differs by {off:+} from]][[is {times} times]] the length that the other "
        "given values imply, {sigmas} standard deviations[[; nearly a factor of {unit_factor}, as "
        "between {finer} and {coarser}]]. It was left out.",
        CHECK_THE_LIST,
        "Correct the length of this bar or remove it.",
    ),
    Kind(
        "scale_left_out",
        "warning",
        "The scale of {given:@} [[differs by {off:+} from]][[is {times} times]] that of the other given "
        "values, {sigmas} standard deviations[[; nearly a factor of {unit_factor}, as between {finer} "
        "and {coarser}]]. They were left out.",
        "coordinates or lengths in another unit or of another temperature, a tape that is too long, a print "
        "that shrank, or points that moved",
        "Correct these values or remove them.",
    ),
    Kind(
        "scale_contradicted",
        "error",
        "No dependable scale: {given:@bar}[[ and {agreeing:scale bar}]] contradict one another by "
        "[[{off}]][[a factor of {times}]], {sigmas} standard deviations[[; nearly a factor of "
        "{unit_factor}, as between {finer} and {coarser}]].",
        CHECK_THE_LIST,
        "Check these lengths and their unit; a third length shows which one is wrong.",
    ),
    Kind(
        "mount_contradicted",
        Unless("mistake", "error", "warning"),
        "The mount given for {camera} contradicts the photographs, by {angle} in its rotation and "
        "{direction} in the direction of its base, {sigmas} standard deviations: it was not used.[[ It fits "
        "if {mistake:@}.]]",
        "another convention of rotations or signs, the mount of another camera, or a camera that was moved",
        "Give X, Y, Z and the rotation of this camera in the image axes of the reference camera, or remove "
        "its mount.",
    ),
    Kind(
        "mounts_scale_contradicted",
        "error",
        "No dependable scale: the scale by the given {cameras:mount|mounts} of {cameras} [[differs by "
        "{off:+} from]][[is {times} times]] that by {others:@}, {sigmas} standard deviations[[; nearly a "
        "factor of {unit_factor}, as between {finer} and {coarser}]]. Given mounts were not used.",
        CHECK_THE_LIST,
        "Check the base and these values and their unit; a third source of scale shows which is wrong.",
    ),
    Kind(
        "plate_size_left_out",
        "warning",
        "The size of {given} [[differs by {off:+} from]][[is {times} times]] the size that the other "
        "given values imply, {sigmas} standard deviations[[; nearly a factor of {unit_factor}, as "
        "between {finer} and {coarser}]]. It was left out.",
        WRONG_SIZE,
        "Correct pitch of this plate, or state plate_sigma.",
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
        "{distance}, {sigmas} standard deviations: {given:it was|they were} left out.",
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
        Grade("shift", warning=EXPECTED_SIGMAS, error=WRONG_SIGMAS),
        "Coordinates of {of:@}, held fixed, differ by {sigma} from the network of the image points, more "
        "than by chance. This shifts the result by up to {shift} of its standard deviations, which do "
        "not include it.",
        "coordinates of a drawing or a print, or points that moved",
        "State the standard deviations of these coordinates.",
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
        DETECTED,
        "The given {given} differs from the adjusted one by {difference}, {sigmas} standard deviations, and "
        "shifts it by {shift} standard deviations.",
        CHECK_THE_LIST,
        "Correct this value, or state a larger standard deviation.",
    ),
    Kind(
        "orientation_differs",
        "warning",
        "The given {given} differs from the adjusted one by {difference}, {sigmas} standard deviations.",
        "another order or sense of the angles, an instrument not aligned with the camera, or standard "
        "deviations that are too small",
        "Correct this value, or state a larger standard deviation.",
    ),
    Kind(
        "check_differs",
        "warning",
        "{coordinate} of check point {point} differs from its given value by {difference}, {sigmas} standard "
        "deviations.",
        CHECK_THE_LIST,
        "Check this coordinate, and the control near it.",
    ),
    Kind(
        "checks_contradict",
        "error",
        "{count} of the {all} check points {count:differs from its|differ from their} given coordinates, "
        "by up "
        "to {distance}.",
        "wrong control or scale, a weak network, or check points in another system or of another epoch",
        "Find out whether control or check points are wrong before you use the result.",
    ),
    Kind(
        "scale_unchecked",
        "note",
        "The scale rests on {given:@bar} alone: nothing checks it.",
        "one length or one source of lengths",
        "Add a scale bar from another source.",
    ),
    Kind(
        "given_unchecked",
        "note",
        "Nothing checks {given:@} among {of:@}.",
        "no more given values than the datum needs",
        "Add control or scale bars.",
    ),
    Kind(
        "given_partly_checked",
        "note",
        "An error of {given:@} among {of:@} would be detected in some directions only.",
        "only a few more given values than the datum needs",
        "Add control or scale bars.",
    ),
    Kind(
        "given_weakly_checked",
        "note",
        "An error of {given:@} among {of:@} may remain undetected and shift the result by up to {sigmas} "
        "of its standard deviations.",
        "few control points or bars, all on one side, or one far more precise than the others",
        "Add control or scale bars.",
    ),
    Kind(
        "given_not_judged",
        "note",
        "The image points alone do not determine the network: only residuals check {of:@}.",
        "photographs that only the control connects or calibrates",
        "Add photographs with common points.",
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
