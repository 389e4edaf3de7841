"""Remarks on cameras: adjusted parameters, and parameter values that no lens has."""

from __future__ import annotations

from sfm.model.remarks.row import EXPECTED_SIGMAS, WRONG_SIGMAS, Grade, Kind, Unless

# A warning if the 95 % value reaches one pixel, which no one expects of a calibrated camera. An error if the
# standard deviation reaches one pixel and is large compared with the image points of the calibration, so that
# points of that precision would contradict the camera. If these points are imprecise, it is only a weak
# calibration.
NOT_CALIBRATED = Grade("rms", warning=0.51, error=1.0, at_most=Grade("times", error=WRONG_SIGMAS))

ROWS = (
    Kind(
        "fisheye_taken",
        "note",
        "Camera {camera} has a fisheye lens and was adjusted with model opencv_fisheye: of {total} image "
        "points, {fitting} {fitting:fits|fit} this model and {before} a central perspective.",
        "the survey file does not state the model",
        "State the model in the survey file, which saves the trial.",
    ),
    Kind(
        "interior_held",
        "note",
        "The interior orientation of camera {camera} was held fixed, as {photographs:photograph} "
        "{photographs:does|do} not determine it.",
        "the survey file does not state what is free",
        "State a calibration in [camera.fixed], or add photographs, some turned by 90 degrees.",
    ),
    Kind(
        "interior_held_of_pair",
        "error",
        "Camera {camera} is not calibrated, and two photographs do not calibrate it: {parameters} "
        "{parameters:was|were} held fixed at the start values.",
        "an error of c scales the depth, one of the distortion bends the object; standard deviations do "
        "not include it",
        "Give a calibrated camera, or add photographs.",
        explains=(
            "c_held_contradicted",
            "held_parameter",
            "interior_held",
            "scale_contradicted",
            "sigma0_high",
        ),
    ),
    Kind(
        "pair_contradicted",
        "error",
        "Two photographs that fit each other do not determine the camera, and {others:other photograph} "
        "{others:does|do} not fit at its start values.",
        "the start values of the camera are wrong, or the photographs have too little in common",
        "Give a calibrated camera, or add photographs between those that do not fit.",
        explains=("interior_held_of_pair",),
    ),
    Kind(
        "c_looks_wrong",
        Unless(("pair",), "warning", "error"),
        "c = {given} of camera {camera} looks wrong: starting from {better}, {oriented} of {total} "
        "photographs can be oriented instead of {before}.[[ Two photographs do not determine {pair}.]]",
        "a wrong start value of c or a wrong size of the pixels",
        "Correct c_mm and pixel_mm, or free c; give a calibrated c for two photographs, or add some.",
        explains=("interior_held_of_pair",),
    ),
    Kind(
        "c_held_contradicted",
        "error",
        "c of camera {cameras} was held fixed at its start value, which the residuals contradict.",
        "c is wrong, and the photographs do not determine it",
        "Give a calibrated camera, or add photographs at larger angles.",
    ),
    Kind(
        "c_far_from_given",
        # Below it the network is not weak, as in the search for other solutions.
        Grade("share", warning=5e-4),
        "c of camera {camera} was adjusted from {given} to {found}, by {change:+} (standard deviation "
        "{share:%}).",
        "a wrong start value, or a network that does not determine c",
        "Give c from a calibration, or add photographs from other distances.",
    ),
    Kind(
        "c_held_elsewhere",
        "error",
        "c of camera {camera} was held at {found}, with which photographs can be oriented, instead of "
        "the stated {given}.",
        "c_mm or pixel_mm is wrong, or photographs that do not belong together fit another camera by chance",
        "Give c from a calibration, or add photographs that determine it.",
    ),
    Kind(
        "camera_not_calibrated",
        NOT_CALIBRATED,
        "The projection uncertainty of camera {camera}, whose calibration is the result, is {rms} over the "
        "photograph (1 sigma)[[, {times} times sigma0]].",
        "frontal photographs, whose distance absorbs an error of c, or few and imprecise ones",
        "Add photographs that are tilted by 30 to 45 degrees relative to the plate, in several directions.",
    ),
    Kind(
        "calibration_failed",
        "error",
        "Camera {camera} is not calibrated, as the photographs do not determine it[[: c was held fixed at "
        "{held}]].",
        "frontal photographs, whose distance absorbs an error of c, or too few of them",
        "Add photographs that are tilted by 30 to 45 degrees relative to the plate, in several directions.",
        explains=(
            *("interior_held", "held_to_converge", "held_parameter", "c_held_contradicted", "camera_varies"),
            *("given_not_exact", "scale_contradicted", "sigma0_high", "points_with_large_residuals"),
        ),
    ),
    Kind(
        "margin_not_calibrated",
        NOT_CALIBRATED,
        "The projection uncertainty of camera {camera}, whose calibration is the result, is {rms} over the "
        "photograph (1 sigma)[[, {times} times sigma0]]: its image points cover {observed:%} of the format.",
        "no image points near the margins of the photographs, where the distortion is then extrapolated",
        "Add photographs that show the plate in the corners and along the sides of the format.",
    ),
    Kind(
        "c_hardly_determined",
        # A warning if EXIF data and the sensor size give c equally well; an error if a result may be off by
        # as much as c itself.
        Grade("share", warning=0.05, error=1 / WRONG_SIGMAS),
        "{parameter} of camera {camera} is known only to {share:%}[[, strongly correlated with {partners}]].",
        "a long lens, few photographs, or small angles between them",
        "Hold it fixed at a calibrated value, or add photographs at larger angles and other distances.",
    ),
    Kind(
        "principal_point_far",
        # Of the diagonal; a decentred lens or sensor has 0.01 or 0.02. Half way to a corner there is none.
        # Where lenses in general tell more of it than these photographs, it must agree with them.
        Grade(
            "share",
            warning=0.1,
            also=Grade("surely", 0.25, 0.25, also=Grade("off_lenses", error=EXPECTED_SIGMAS)),
        ),
        "The adjusted principal point of camera {camera} is {share:%} of the diagonal from the centre of the "
        "photograph (standard deviation {sigma:%})[[; with the spread of lenses in general, that is "
        "{off_lenses} standard deviations]].",
        "a camera that the photographs hardly determine, wrong matches, or cropped photographs",
        "Hold it fixed, give uncropped photographs, or add photographs turned by 90 degrees.",
    ),
    Kind(
        "pixels_distorted",
        # Pixels of sensors are square to 1e-4, those of scans and of scaled photographs to one per cent.
        Grade("share", warning=0.01, error=0.05),
        "The adjusted {parameter} of camera {camera} is {share:%}: no sensor has such pixels.",
        "the network hardly determines it, or wrong matches that it fits",
        "Hold b1 and b2 at 0 (fx and fy at the same value), or add photographs turned by 90 degrees.",
    ),
    Kind(
        "format_of_other_size",
        "error",
        "The adjusted principal point of camera {camera} is the centre of photographs of "
        "{width} x {height} px.",
        "x and y of the image points are exchanged, or size_px is that of other photographs",
        "Correct size_px, or exchange x and y.",
    ),
    Kind(
        "pixels_not_square",
        "warning",
        "According to {where}, the pixels of camera {camera} are {width} x {height}, {off} from square.",
        "the nominal size of a sensor is not that of the photographs",
        "Set pixel_mm to two equal numbers, or free b1 (fx and fy).",
    ),
)
CALIBRATIONS = (
    Kind(
        "halves_differ",
        # Difference over its prediction. Where errors are half as large again as stated, it is 1.5.
        Grade("times", warning=2.0),
        "Halves of the photographs give different cameras {camera} ({division}): {difference} RMS, {times} "
        "times what chance explains ({p:<}).",
        "zoom, focus or a lens that moved between the photographs, an object that changed its shape, a rig "
        "that moved, or a camera model that does not suit the lens",
        "Hold focus and zoom, and photograph anew; or free the parameters that the page names, or choose "
        "another model. Until then, multiply the uncertainty of projection by {times}.",
    ),
    Kind(
        "model_insufficient",
        "warning",
        "The model of camera {camera} is insufficient: residuals depend on the place in the format, by "
        "{field} RMS ({p:<}).",
        "distortion that the model cannot describe, or a sensor that is not flat",
        "Free the parameters that the page names, use a splined camera if it offers one, or choose another "
        "model with --model.",
    ),
    Kind(
        "parameters_missing",
        "warning",
        "The photographs of camera {camera} demand {parameters}, which {parameters:was|were} not adjusted.",
        "distortion that the adjusted parameters do not describe, above all beyond the image points",
        "Add {parameters} to free of the camera in the survey file.",
    ),
    Kind(
        "halves_missing",
        "warning",
        "No halves of the {photographs} photographs of camera {camera} can be compared. Nothing checks its "
        "uncertainty of projection, which is true only if its model is.",
        "too few photographs, or halves that do not determine the camera",
        "Take 8 to 20 photographs of the object, tilted and turned.",
    ),
)
