"""Remarks on the adjustment, and on alternative hypotheses that are preferred to its assumptions."""

from __future__ import annotations

from dataclasses import replace

from sfm.model.remarks.row import HARMLESS_SIGMAS, WRONG_SIGMAS, Grade, Kind

# sigma_px is a rough guess, so the global test alone says little. Of the planted faults of
# tests/survey/faults.py, three of each kind, a coordinate was wrong by more than WRONG_SIGMAS in 7 of 95 with
# a ratio below 1.2, in 9 of 20 below 2, where other tests name the cause, in 4 of 8 beyond 2, and in 2 of 3
# beyond 5.
SIGMA0 = Grade("ratio", warning=2.0, error=5.0)
# Of 60 networks of 4 to 12 photographs with one gross error that was kept, a coordinate shifted by more than
# WRONG_SIGMAS in 1 of 14 below 10, in 7 of 13 up to 30, and in 31 of 33 beyond.
RESIDUAL = Grade("over_sigma", warning=10.0, error=30.0)
REJECTED = Grade("share", warning=0.05)  # of the image points; usually 1 % are gross errors
SOLUTION = Grade("moved", error=WRONG_SIGMAS)  # the result is wrong if the other solution is the true one
ADJUSTMENT = (
    Kind(
        "not_converged",
        "error",
        "The adjustment did not converge in {iterations:iteration}.",
        "poor start values, too many free parameters, or misidentified points",
        "Check c_mm and pixel_mm, shorten free, look at the photograph or point with the largest residuals.",
        short="no convergence",
    ),
    Kind(
        "rank_defect",
        "error",
        "The rank defect is {defect}, expected {expected}[[; not determined ({undetermined})]].",
        "some unknowns have no observation that determines them",
        "Give more control or a scale bar where position, rotation or scale are not determined; else hold "
        "the undetermined parameters fixed, or add photographs: of points with few rays, or tilted ones.",
    ),
    Kind(
        "sigma0_high",
        SIGMA0,
        "Sigma0 is {ratio} times the expected standard deviation of an image coordinate ({stated}).[[ "
        "Image points within {length} of each other share errors of {common}: the camera model does not "
        "describe the photographs, as happens with a rolling shutter or a stabiliser.]]",
        "the camera, misidentified points or given values contradict the photographs, or sigma_px is too "
        "small",
        "Look for a camera that changed between photographs, misidentified points and wrong given values; "
        "set sigma_px to what the residuals show only where none is found.",
    ),
    Kind(
        "residual_kept",
        RESIDUAL,
        "The residual of point {point} in {photograph} is {length}, {over_sigma} times its standard "
        "deviation, and was not rejected.",
        "a wrong measurement that no other observation checks, or tests that are switched off",
        "Look at the photograph; correct or remove the image point.",
    ),
    Kind(
        "gross_errors_kept",
        "warning",
        "{beyond} of {tested} image coordinates {beyond:has a residual|have residuals} beyond {critical} "
        "robust "
        "standard deviations ({chance} by chance), and {beyond:it was not|none was} rejected.",
        'gross errors, and adjust.reject = "none"',
        'Set adjust.reject = "tau", which rejects gross errors.',
    ),
    Kind(
        "image_points_rejected",
        REJECTED,
        "{rejected} of {total} image points {rejected:was|were} rejected.",
        "wrong matches, misidentified points, an object that moved, or a camera model that does not suit the "
        "lens",
        "Look at the rejected image points in the report.",
    ),
    Kind(
        "rejection_not_converging",
        "warning",
        "The rejection of gross errors ended early[[ after {rounds:round} that did not converge]][[: with "
        "{more:image point} rejected instead of {rejected}, the network is not determined]][[: the "
        "weights of {groups} did not converge]].",
        "gross errors in most of the observations, or a network that few image points determine",
        "Look at the rejected image points and for wrong start values; add photographs, or set "
        'adjust.weights = "stated".',
    ),
    Kind(
        "photograph_without_weight",
        "warning",
        "No image point fits in {photographs}: nothing determines {photographs:its|their} position and "
        "rotation.",
        "the robust estimator gives all image points of a photograph a small weight",
        "Remove {photographs:the photograph|these photographs}, or correct {photographs:its|their} "
        "misidentified points.",
    ),
    Kind(
        "held_to_converge",
        "warning",
        "{parameters} of camera {camera} {parameters:was|were} held fixed: with {parameters:it|them} "
        "free, the adjustment does not converge.",
        "the photographs do not separate {parameters:this parameter|these parameters} from position and "
        "rotation",
        "Give {parameters:a calibrated value|calibrated values} and leave "
        "{parameters:the parameter|the parameters} out of free.",
    ),
    Kind(
        "other_solution",
        SOLUTION,
        "The image points allow another solution[[ with c of camera {camera} at {c}]][[, {reversed:@}]] "
        "(v'Pv {vPv} times that of the result); points differ by {moved} standard deviations (RMS)[[, c "
        "by {c_moved}]].",
        "a flat object or a narrow range of angles: the photographs allow two shapes",
        "Hold c fixed at a calibrated value, or add photographs at larger angles and other distances.",
    ),
)
# `shift`: standard deviations by which the alternative moves the coordinate that it moves most, or the
# parameter of a camera. `wrong`: the same; 0 where the image points concerned are rejected anyway.
# `otherwise`: the largest shift by another cause that explains the image points as well.
OTHERWISE = Grade("otherwise", warning=HARMLESS_SIGMAS)
WRONG = Grade("wrong", warning=WRONG_SIGMAS, error=WRONG_SIGMAS, also=OTHERWISE)
SHIFT = Grade("shift", warning=HARMLESS_SIGMAS, also=WRONG)
SHIFTED = "{of:@} shift by up to {shift} standard deviations[[, {rms} RMS]]."
INSTEAD = (
    "[[ The image points do not separate this from: {instead}.]]"
    "[[ That shifts them by up to {otherwise} standard deviations.]]"
)
# Kinds that follow if a camera that changed, or a plate that slipped, bends the network.
OF_GIVEN = ("given_contradicted", "given_strained", "plate_sizes_contradict", "shape_of_control")
ROWS: tuple[Kind, ...] = (
    Kind(
        "other_camera",
        SHIFT,
        "{photographs} {photographs:fits|fit} a different camera from the others[[ of camera "
        f"{{camera}}]][[, c {{change:+}}]][[, principal point {{away}} away]]. {SHIFTED}{INSTEAD}",
        "zoom, focus or camera changed during the survey, or photographs were cropped or resampled",
        "Give {photographs:this photograph|these photographs} a separate camera in the survey file, or "
        "set per_photograph.",
        short="a different camera in some photographs",
        explains=OF_GIVEN,
    ),
    Kind(
        "camera_varies",
        SHIFT,
        "The camera changes between photographs ({parameters:@all})[[, c by up to {change}]][[, principal "
        "point by up to {away}]][[, distortion at the edge by up to {distortion}]]. Standard deviations are "
        f"too small, by a factor of {{factor}} or more. {SHIFTED}{INSTEAD}",
        "autofocus, a stabiliser or a loose lens",
        "Set per_photograph for {parameters:@all}; switch off autofocus and stabiliser.",
        short="a camera that changes from photograph to photograph",
        explains=OF_GIVEN,
    ),
    Kind(
        "rolling_shutter",
        SHIFT,
        "The rows of a photograph were exposed one after the other while the camera moved: by up to {skew} "
        f"from the first row to the last, most in {{photographs}}. {SHIFTED}{INSTEAD}",
        "a rolling shutter, as of telephones, drones and video",
        "Keep the camera still during an exposure, or use one with a global shutter; leave out these "
        "photographs.",
        short="a rolling shutter",
        explains=OF_GIVEN,
    ),
    Kind(
        "camera_drift",
        SHIFT,
        "The camera[[ {camera}]] changes steadily through the sequence (c by {change:+} from first to last). "
        f"{SHIFTED}{INSTEAD}",
        "the camera warmed up, or its focus crept",
        "Set per_photograph for c, and let the camera warm up before the survey.",
        short="a camera that changes steadily",
        explains=OF_GIVEN,
    ),
    Kind(
        "held_parameter",
        SHIFT,
        "The image points contradict the held values of {parameters} of camera {camera}[[: held at "
        f"{{value}}, but {{instead_of}} fits]]. {SHIFTED}{INSTEAD}",
        "a calibration that does not describe these photographs",
        "Calibrate the camera again, or free the parameters if there are three photographs or more.",
        short="wrong held parameters",
    ),
    Kind(
        "given_parameter",
        SHIFT,
        "The image points contradict the given values of {parameters} of camera {camera}[[: {value} is "
        f"given, but {{instead_of}} fits]]. {SHIFTED}{INSTEAD}",
        "a certificate of another camera, zoom or focus, or standard deviations that are too small",
        "Correct the values, or their standard deviations.",
        short="wrong given parameters",
    ),
    Kind(
        "distortion_not_described",
        SHIFT,
        "Residuals depend on the position in the photograph, by up to {largest}: the camera model does "
        f"not describe the lens. {SHIFTED}{INSTEAD}",
        "distortion that the model cannot describe, or a film or sensor that is not flat",
        "Free K2, K3, P1, P2, b1 and b2, or choose another model.",
        short="distortion that the model cannot describe",
    ),
    Kind(
        "object_deformed",
        SHIFT,
        "The object has a different shape[[ in {photographs}]][[ each time, changing {how:@}]], "
        f"by up to {{deformation}}. {SHIFTED}{INSTEAD}",
        "the object expanded, bent or settled during the survey",
        "Adjust the states as separate surveys and compare them with epochs; photograph a steady change in a "
        "shorter time.",
        short="an object that deformed",
    ),
    Kind(
        "shape_of_control",
        "warning",  # it is known how precise the given points are, and the remedy adjusts with it
        "The control points, or those of the plate, are not as given: the image points place them up to "
        f"{{distance}} away, {{sigma}} RMS. {SHIFTED}{INSTEAD}",
        "coordinates of a print or a scan, a plate that is bent, or axes with different scales",
        "Measure the points, or state {sigma} as standard deviation of their coordinates (plate_sigma of a "
        "plate).",
        short="control points of a different shape",
        explains=("given_not_exact", "sigma0_high"),
    ),
    Kind(
        "rig_contradicted",
        # Of most photographs of these cameras, if half of these still share the pose of the rig and bend it.
        Grade("share", error=0.5, at_most=Grade("bound", error=0.5)),
        "{photographs:photograph} of {cameras} {photographs:contradicts|contradict} the rig, by up to "
        "{distance} and {angle}, {shift} standard deviations: {photographs}.",
        "the camera was moved on its rig, a wrong mount was given, or rig or object moved between cameras "
        "that were not triggered together",
        "Check mounts that are given; list the photographs from each place of the camera as blocks of the "
        "rig, correct their moments, or leave single ones out.",
        short="a camera that is not where its rig places it",
    ),
    Kind(
        "points_moved",
        SHIFT,  # not the RMS of all points, which a few points hardly change
        "{points:point} moved from {from} on, by up to {distance}, {shift} standard deviations: {points}."
        f"[[ The result contains their positions {{state}} the move.]]{INSTEAD}",
        "targets or parts of the object moved during the survey",
        "Adjust the two states as two surveys, or remove {points:this point|these points}.",
        short="points that moved",
    ),
    Kind(
        "photographs_differ",
        Grade("shift", warning=HARMLESS_SIGMAS),
        "Up to {first} and from {next} on, the photographs give different points: {count:point} "
        "{count:differs|differ} by {times} times their standard deviations (RMS). Coordinates shift by up to "
        "{shift} standard deviations.",
        "part of the object or the camera changed between the two",
        "Adjust the two parts as two surveys and compare them with epochs; use one of them if they differ.",
        short="photographs that give different points",
    ),
    Kind(
        "windows_elsewhere",
        Grade("shift", warning=HARMLESS_SIGMAS),  # of these points alone
        "From {from} on, {points:natural point} {points:shows|show} a different spot, up to {distance} away, "
        f"{{shift}} standard deviations: {{points}}.{INSTEAD}",
        "wrong matches, an edge in front of another surface, shine, shadows, or something that moved",
        "Do not use {points:this point|these points}; photographs at smaller steps produce fewer of them.",
        short="natural points that show a different spot",
    ),
    Kind(
        "calibrated_from_few",
        "warning",
        "Camera {camera} is calibrated from {photographs} alone: almost nothing would show that it "
        "changed, or that the given points are wrong.",
        "one or two photographs of a camera do not show how much others would differ from them",
        "Take four photographs or more, tilted by 30 to 45 degrees and rolled by 90 degrees.",
    ),
    Kind(
        "two_places",
        "warning",
        "Point {point} is at a different position in {photographs}, {distance} away ({sigmas} standard "
        "deviations).",
        "two points share one name, or the point moved",
        "Measure the two positions as two points, or remove the point.",
    ),
    Kind(
        "names_exchanged",
        "warning",
        "Points {first} and {second} are swapped in {photographs}.",
        "they were confused when the photographs were measured",
        "Swap the two in these photographs.",
    ),
)
# Each of them makes photographs give different points, of which no cause is known.
ROWS = tuple(
    replace(row, explains=(*row.explains, "photographs_differ")) if row.name != "photographs_differ" else row
    for row in ROWS
)
