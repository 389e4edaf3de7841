"""Rows of the table "What was tested": tests that were made, and tests that the data do not allow."""

from __future__ import annotations

from sfm.model.remarks.row import Tested

UNDETECTED = (
    "weak: {what}may shift coordinates[[ of the network without {{without:@}}]] by up to {{sigmas}} standard "
    "deviations before it is detected"
)
ROWS = (
    Tested(
        "image_sigma_tested",
        "standard deviation of the image points",
        "{tested:image coordinate}",
        "stated {stated}, found {found}",
    ),
    Tested(
        "gross_errors_tested",
        "gross errors",
        "{tested:image coordinate}",
        "{beyond} beyond {critical} standard deviations, {chance} expected by chance",
    ),
    Tested(
        "points_tested",
        "residuals of each point together",
        "{tested:point}",
        "{larger:point} with larger ones than chance allows[[: {points}]]",
    ),
    Tested(
        "parts_tested",
        "points from the first photographs and from the others",
        "{parts:division}",
        "{different:division} with other points than chance allows",
    ),
    Tested(
        "rays_tested",
        "rejected rays of each point",
        "{tested:ray}",
        "{more:point} with more than chance explains[[: {points}]]",
    ),
    Tested(
        "third_ray_missing",
        "third ray",
        "{two:point} of {total}",
        "not tested: with two rays, errors along the epipolar line remain undetected",
    ),
    Tested(
        "assumptions_tested",
        "constant cameras and object",
        "{photographs:photograph}[[, in {parts:part} of at most {most}]]"
        "[[, with {sample:image point} of {image_points}]]",
        "{causes:contradiction}",
    ),
    Tested(
        "assumptions_untested",
        "constant cameras and object",
        "all photographs",
        "not tested: the image points alone do not determine the network",
    ),
    Tested(
        "photographs_untested",
        "constant object[[ and cameras, in parts of at most {most:photograph}]]",
        "{photographs:photograph}",
        "not tested[[: the test needs {needed:photograph}]]",
    ),
    Tested("cameras_untested", "constant cameras", "{cameras:camera}", "not tested: too many cameras"),
    Tested("constancy_weakly_tested", "{of:@}", "all photographs", UNDETECTED.format(what="a change ")),
    Tested(
        "held_weakly_tested",
        "held parameters",
        "{parameters} of camera {camera}",
        UNDETECTED.format(what="a wrong value "),
    ),
    Tested(
        "given_tested",
        "given values against the image points",
        "{of:@}[[, {judged} of {given} of them]]",
        "[[chi-square {chi2}, {dof} degrees of freedom, {p:<}]][[standard deviations not stated, each "
        "compared with {others} others, {p:<}]]",
    ),
    Tested("scale_unchecked", "given values", "{given:@bar}", "not tested: nothing else gives the scale"),
    Tested(
        "given_unchecked",
        "given values",
        "{given:@} among {of:@}",
        "not tested: no more values than the datum needs",
    ),
    Tested(
        "given_partly_checked",
        "given values",
        "{given:@} among {of:@}",
        "weak: an error is detected in some directions only",
    ),
    Tested(
        "given_weakly_checked",
        "given values",
        "{given:@} among {of:@}",
        "weak: an error may shift the result by up to {sigmas} of its standard deviations before it is "
        "detected",
    ),
    Tested(
        "given_not_judged",
        "given values",
        "{of:@}",
        "not against the image points, which alone do not determine the network",
    ),
    Tested(
        "handedness_unchecked",
        "handedness",
        "image coordinates",
        "not tested: no given value shows whether y counts downwards",
    ),
    Tested(
        "pairs_matched",
        "common points",
        "{pairs} of {possible} pairs of photographs",
        "{how:@}[[, neighbours in the series of {in_sequence:photograph} (EXIF time or "
        "numbers in the names)]][[, neighbours by satellite navigation of {by_position:photograph} (EXIF)]]"
        "[[, neighbours by given exterior orientation of {by_exterior:photograph}]]",
    ),
    Tested(
        "adjuster_fits_alike",
        "other adjuster",
        "{program}",
        "fits equally well: the image points do not separate the two cameras, v'Pv differs by {gap} "
        "variances",
    ),
    Tested("not_compared", "{what:@}", "the survey", "not compared: {reason}"),
    Tested(
        "differences_tested",
        "significance of the differences",
        "{tested} of {points} points",
        "{how:@}",
    ),
    Tested(
        "one_camera",
        "one interior orientation",
        "camera {camera} in {epochs}",
        "agrees: T {statistic}, limit {critical}",
    ),
    Tested(
        "temperature_unknown", "temperature of the lengths", "all lengths", "not known: no file states it"
    ),
    Tested(
        "parameters_chosen",
        "free parameters, as the survey file states none",
        "camera {camera}, {photographs:photograph}",
        "[[{parameters} adjusted]][[{weighted} weighted with its start value {given}, standard deviation "
        "{sigma}]]",
    ),
    Tested(
        "better_solution_taken",
        "other solutions",
        "camera {camera}",
        "c {better} taken in place of {first}, found first: its v'Pv is {vPv} times as large",
    ),
    Tested(
        "image_points_misnamed",
        "names of rejected image points",
        "{photographs}",
        "{count:image point} where another point is seen",
    ),
    Tested(
        "image_points_averaged",
        "repeated measurements",
        "{image_points:image point}",
        "averaged, as they differ by no more than chance: {image_points}",
    ),
    Tested(
        "frame_points_computed",
        "points of rigid frames",
        "{points:point}",
        "in no photograph, computed from the other points of the frame: {points}",
    ),
    Tested(
        "exif_positions",
        "projection centres of EXIF data",
        "{positions} of {photographs} photographs",
        "observations: X east, Y north (WGS 84) from latitude {latitude:.3f}, longitude {longitude:.3f}, "
        "Z the height as stated; standard deviations do not include errors that photographs share",
    ),
    Tested(
        "doubtful_tested",
        "rejections that another ray explains as well",
        "{tested:rejected image point}",
        "{doubtful:point} with doubtful coordinates[[: {points}]]",
    ),
    Tested(
        "points_left_out",
        "rays of each point",
        "{measured:point}",
        "{points:point} left out, as too few rays meet",
    ),
    Tested(
        "slight_effect",
        "other assumptions",
        "{cause}",
        "an error that shifts the result by up to {shift} standard deviations only",
    ),
)
