"""The adjustment: convergence, rank, sigma0, tests of image points, other solutions."""

from __future__ import annotations

from sfm.remarks.kind import WRONG_SIGMAS, Grade, Kind

# sigma_px is a rough guess, so the global test alone says little. Twice the guess is worth a look; five
# times is no precision that anybody expected, but a wrong model, wrong names or wrong control.
SIGMA0 = Grade("ratio", warning=2.0, error=5.0)
# Data snooping leaves nothing beyond 4 or 5 sigma; ten is an outlier, thirty is a mistake that was kept.
RESIDUAL = Grade("over_sigma", warning=10.0, error=30.0)
REJECTED = Grade("share", warning=0.05)  # of the image points; gross errors are one in a hundred
SOLUTION = Grade("moved", error=WRONG_SIGMAS)  # the result is wrong if the other solution is the true one

ROWS = (
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
        "no observation determines something",
        "Hold what is not determined, or add photographs: of points with few rays, or tilted ones.",
    ),
    Kind(
        "sigma0_high",
        SIGMA0,
        "Sigma0 is {ratio} times the expected standard deviation of an image coordinate ({stated}).[[ "
        "Neighbours have errors of {common} in common over {length}: the camera model does not describe the "
        "photographs, as with a rolling shutter or a stabiliser.]]",
        "the camera, misidentified points or given values contradict the photographs, or sigma_px is too "
        "small",
        "Look for a camera that changed between photographs, misidentified points and wrong given values; "
        "set sigma_px to what the residuals show only where none is found.",
    ),
    Kind(
        "sigma_px_cautious",
        "note",
        "The stated standard deviation of the image points, {stated}, is pessimistic: residuals show "
        "{found}.",
        "sigma_px is larger than the measurements deserve",
        "Set sigma_px to what the residuals show.",
    ),
    Kind(
        "residual_kept",
        RESIDUAL,
        "The residual of point {point} in {photograph} is {length}, {over_sigma} times its standard "
        "deviation, and was not rejected.",
        "a wrong measurement in a place where nothing else checks it, or tests are switched off",
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
        "snooping_not_converging",
        "warning",
        "Data snooping ended after {rounds:round} that did not converge.",
        "gross errors in most of the observations, or an undetermined network",
        "Look for misidentified points and wrong start values.",
    ),
    Kind(
        "reweighting_not_converging",
        "warning",
        "Reweighting ended after {rounds:round} that did not converge.",
        "gross errors in most of the observations, or an undetermined network",
        "Look for misidentified points and wrong start values.",
    ),
    Kind(
        "snooping_unsolvable",
        "warning",
        "Data snooping ended early: with {more:image point} rejected in place of {rejected} the network is "
        "not determined.",
        "rejections leave a photograph or a point without the rays that determine it",
        "Look at the rejected image points; add photographs.",
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
        "weights_not_converged",
        "warning",
        "The weights of {groups} did not converge.",
        "each set of weights rejects other image points",
        'Look at the rejected image points, or set adjust.weights = "stated".',
    ),
    Kind(
        "held_to_converge",
        "warning",
        "{parameters} of camera {camera} {parameters:was|were} held fixed: with {parameters:it|them} free "
        "the adjustment does not "
        "converge.",
        "the photographs do not separate {parameters:this parameter|these parameters} from position and "
        "rotation",
        "Give {parameters:a calibrated value|calibrated values} and leave "
        "{parameters:the parameter|the parameters} out of free.",
    ),
    Kind(
        "better_solution_taken",
        "note",
        "The image points have two solutions: c of camera {camera} was {first} at first; with {better} "
        "v'Pv is {vPv} times as large, which was taken.",
        "a flat object or a narrow range of angles",
        "Give a calibrated c, or add photographs at larger angles and other distances.",
    ),
    Kind(
        "other_solution",
        SOLUTION,
        "The image points allow another solution with c of camera {camera} at {c} (v'Pv {vPv} times that of "
        "the result); points differ by {moved} standard deviations (RMS)[[, c by {c_moved}]].",
        "a flat object or a narrow range of angles: the photographs allow two shapes",
        "Hold c fixed at a calibrated value, or add photographs at larger angles and other distances.",
    ),
    Kind(
        "other_solution_reversed",
        SOLUTION,
        "The image points allow another solution, the object reversed in depth (v'Pv {vPv} times that of the "
        "result); points differ by {moved} standard deviations (RMS).",
        "a flat object or a narrow range of angles: the photographs allow two shapes",
        "Hold c fixed at a calibrated value, or add photographs at larger angles and other distances.",
    ),
)
