"""Remarks on photographs, on the input, and on drafts of survey files."""

from __future__ import annotations

from sfm.model.remarks.row import Grade, Kind, Unless

DRAFTS = (
    Kind(
        "photographs_resampled",
        "warning",
        "{photographs:photograph} of camera {camera} {photographs:has|have} {size}, but the camera took "
        "{taken}.",
        "photographs that a program resampled or cropped",
        "Use the original photographs.",
    ),
    Kind(
        "camera_assumed",
        "note",
        "The files of camera {cameras} do not state the size of the pixels or the focal length[[, and "
        "COLMAP's list of cameras was not read: {reason}]].",
        "no EXIF data, or a camera that is not in the list; shapes and angles do not depend on it",
        "Give sensor_mm and c_mm if c in mm matters.",
    ),
    Kind(
        "several_cameras",
        "note",
        "The photographs are from {cameras:camera} or settings: {cameras}.",
        "another body, zoom, size or orientation of the photographs; a program that turned, cropped or "
        "resized them",
        "If they are one camera, combine those of one size in the survey file, and use the original files of "
        "others: EXIF orientation turns no photograph.",
    ),
    Kind(
        "targets_blurred",
        Grade("blur", warning=2.5),  # px: beyond it, centroids and codes suffer (`sfm.targets.fits.centroid`)
        "Edges of targets are blurred by {blur} (standard deviation).",
        "out of focus, or shaken",
        "Focus again, and use a tripod.",
    ),
    Kind(
        "circles_without_codes",
        "warning",
        "A photograph has {circles:circle}[[, in up to {rows} rows and {columns} columns]], but no code of a "
        "known family and no whole plate: texture orients the photographs.",
        "targets without codes, or a plate of dots that is cut by the border or covered",
        "Add coded targets, or state the rows and columns of the plate as the survey file shows.",
    ),
    Kind(
        "rings_not_read",
        "warning",
        "Of {dots:dot} of {photograph}, {ringed} {ringed:has a ring|have rings} that no known family of "
        "codes reads: texture orients the photographs.",
        "codes of another family, or rings of other proportions; too small, blurred or mirrored",
        "Compare the picture beside the survey file with the families; give a table of codes, or use other "
        "targets.",
    ),
    Kind(
        "plate_pitch_assumed",
        "note",
        "The pitch of the plate is assumed to be {pitch}.",
        "a calibration plate was found, its size is not known",
        "If lengths matter, give the distance of neighbouring dots or crossings: --pitch for a new survey "
        "file, targets.pitch without pitch_assumed in one that exists. Cameras do not depend on it.",
    ),
)
INPUT = (
    Kind(
        "copies",
        "note",
        "[[It is a copy of {original}: the {same} are the same]][[{copies:photograph} {copies:is a copy|are "
        "copies} of another, and {copies:counts|count} once: {copies}]].",
        "the same photograph was copied or saved again; it is not a second observation",
        "Remove the copies.",
    ),
    Kind(
        "image_points_outside",
        "note",
        "{image_points:image point} {image_points:is|are} outside {image_points:its photograph|their "
        "photographs} and left out: {image_points}.",
        "a gross error or a mistyped coordinate",
        "Correct or remove the image points that are named.",
    ),
)
ROWS = (
    Kind(
        "photographs_missing",
        Grade("share", error=0.5),  # if half or more are missing, the others may be the wrong half
        "{missing} of {total} photographs {missing:is|are} not in the result.",
        "damaged files, too few common points, or start values that do not fit",
        "The report states the reason of each.",
    ),
    Kind(
        "not_connected",
        "warning",
        "{photographs} {photographs:is|are} not connected to the {oriented} oriented photographs[[, with "
        "only {shared:point|points} {shared} in common]].[[ A photograph that shows {needed} of points "
        "{points} and {needed} of {others} would connect them.]]",
        "groups of photographs with too few common points",
        "Add a photograph that shows points of both groups.",
        explains=("photograph_with_few_points",),
    ),
    Kind(
        "photographs_posed_by_rig",
        "note",
        "{photographs} {photographs:has|have} too few accepted image points ({accepted}, {needed} are "
        "needed) to be oriented alone: the other cameras of the rig give the pose.",
        "little of the object in the view, misidentified points, or a photograph of another moment",
        "Check that {photographs:it shows|they show} the moment of the others; a shift of the camera on the "
        "rig goes unnoticed in {photographs:it|them}.",
    ),
    Kind(
        "clock_differs",
        Unless(("unsure",), "note", "warning"),
        "By the EXIF times, the clock of camera {camera} is {ahead} ahead of that of camera "
        "{reference}[[; they agree as well {unsure}]].",
        "clocks that were not set to the same time; or photographs at regular intervals, of which one camera "
        "misses the first or last",
        "Check in the report that photographs of the same moment show the same scene; if not, give the "
        "moments by an expression, 'order' or a table.",
    ),
    Kind(
        "photographs_uneven",
        "warning",
        "The photographs differ in precision (Bartlett's test, {p:<}): sigma0 of {photograph} is {ratio} "
        "times the median.",
        "a photograph that is not sharp or of a camera that moved, or misidentified points in it",
        "Look at this photograph; leave it out if you do not trust it.",
    ),
    Kind(
        "photographs_blurred",
        "note",
        "{photographs} {photographs:is|are} blurred: edges of targets are blurred by {blur} (standard "
        "deviation), those of the other photographs[[ of camera {camera}]] by {others}.",
        "out of focus, or the camera or the object moved during the exposure",
        "Take {photographs:the photograph|these photographs} again, or leave {photographs:it|them} out.",
    ),
    Kind(
        "camera_by_size",
        "note",
        "{photographs:photograph} of camera {camera} {photographs:has|have} {size} instead of {usual} "
        "({what}) and {photographs:was|were} assigned to camera {new}: {photographs}.",
        "photographs that are cropped, resampled or turned, or from another sensor",
        "Use original photographs.",
    ),
    Kind(
        "camera_per_photograph",
        "warning",
        "{photograph} does not fit camera {camera} ({rejected} of {points:point} rejected); with "
        "{parameters} per photograph, c {change:+}, residuals are {rms}.[[ It may be "
        "{other}, the other photograph of this camera, that changed.]]",
        "zoomed, refocused, cropped or resampled",
        "Give this photograph a separate camera in the survey file, or leave it out.",
    ),
    Kind(
        "c_per_photograph",
        "warning",
        "c of camera {camera} differs among its photographs and was adjusted for each: {least} to {most}.",
        "a zoom that slipped, autofocus or a stabiliser",
        "Fix zoom and focus; coordinates are less precise with c per photograph.",
    ),
    Kind(
        "plate_not_found",
        "note",
        "The {plate:@} of {size} was not found in {photographs:photograph}[[, where {dots:dot} "
        "{dots:does|do} not fit it]]: {photographs}.[[ {photographs:It shows|They show} a checkerboard of "
        "{other}.]]",
        "it is cut off or hidden, its marks are hidden or blurred, or rows and columns are not those of the "
        "plate; of a checkerboard they count crossings",
        "Show all of it with its rim, larger; move photographs of another board to a folder of their own; "
        "check rows, columns, marks and polarity, or run kolinear init on the folder.",
        explains=("photograph_with_few_points",),
    ),
    Kind(
        "board_not_found",
        "note",
        "The {plate:@} of {size} was not found in {photographs:photograph}: {photographs}.",
        "its tags are too small, blurred or hidden; rows and columns count crossings of a ChArUco board, "
        "and two corners for each tag of an AprilGrid",
        "Show more of it, larger; check rows, columns, tag_size, dictionary and first_tag.",
        explains=("photograph_with_few_points",),
    ),
    Kind(
        "plate_not_in_result",
        "warning",
        "The result has no point of the plate or board {codes} of {size}.",
        "it was found in fewer than two photographs, or its photographs do not belong to the others",
        "Take more photographs that show it beside the other plates, or remove it from the survey file.",
    ),
    Kind(
        "plate_looks_alike_turned",
        "warning",
        "The plate looks the same when rotated: {cameras} may count its points from different corners in "
        "{photographs:photograph} ({photographs}).",
        "cameras that were not mounted together, photographs that were not taken at the same moments, or "
        "a plate that was hardly moved",
        "Give photographs of one moment the same number; otherwise do not compare stations of one camera "
        "with those of the other, or use a plate with marks.",
    ),
    Kind(
        "plate_side_not_found",
        "warning",
        "Nothing was found of the {sides} of the {codes} of {size}; {views:photograph} "
        "{views:shows|show} the area.",
        "rows, columns or the first tag of the plate are wrong, so that points have wrong names, or this "
        "side is hidden",
        "Check rows and columns, and first_tag of a plate with tags.",
    ),
    Kind(
        "plane_ambiguous",
        "error",
        "The common points of {photographs} lie in a plane, and two orientations fit them equally well.",
        "the photographs do not decide which of the two is true",
        "Add points off the plane, or a third photograph.",
    ),
    # reasons why single photographs are not in the result
    Kind(
        "photographs_unreadable",
        "warning",
        "[[{photographs} could not be read]][[Not readable: {reason}]].",
        "damaged files, or files that are no photographs",
        "Copy them again, convert them to JPEG or TIFF, or remove them from the folder.",
    ),
    Kind(
        "photographs_changed",
        "warning",
        "{photographs:photograph} {photographs:has|have} changed since points were marked in "
        "{photographs:it|them}: {photographs}.",
        "edited, turned, resampled or replaced after the marking",
        "Put the original {photographs:file|files} back, or measure {photographs:its|their} marks again: M "
        "in kolinear mark.",
    ),
    Kind(
        "photographs_not_drawn",
        "note",
        "{photographs} {photographs:has|have} no overlay: {photographs:the file|the files} could not be read "
        "again when the report was written.",
        "a photograph was moved, removed or changed during the run",
        "Put {photographs:it|them} back and run the survey again.",
    ),
    Kind(
        "photograph_of_other_size",
        "warning",
        "It has {size}, camera {camera} has {usual} ({what})[[; {needed} such photographs would form a "
        "separate camera]].",
        "photographs that are cropped, resampled or turned, or from another sensor",
        "Use original photographs, or describe their camera.",
    ),
    Kind(
        "photograph_with_few_points",
        "warning",
        "It shows {seen:point} of the network; {needed} are needed.",
        "too few common points",
        "Add photographs that overlap more with it, or points that it shows.",
    ),
    Kind(
        "photograph_with_few_fitting",
        "warning",
        "Too few of its image points fit the network[[, {fitting} of {points}]]: at least {needed} "
        "{needed:is|are} needed.",
        "misidentified points, another object, or a wrong principal distance",
        "Check its points and the camera, or leave it out.",
    ),
    Kind(
        "photograph_contradicting",
        "warning",
        "Its image points contradict the network[[: {against} of {points}]][[, and {confirmed:condition} "
        "{confirmed:confirms|confirm} it]].",
        "another object or another state of it, a mirrored picture, wrong codes, or matches of a repeated "
        "pattern",
        "Leave it out, or survey it separately.",
    ),
    Kind(
        "photograph_mirrored",
        "warning",
        "[[{photograph} is not in the result. ]]It is a mirrored picture: its median residual is [[{before} "
        "as it is and ]]{turned} turned over.",
        "the picture was mirrored by a program, or seen in a mirror",
        "Use the original photograph.",
    ),
    Kind(
        "photograph_of_mirror_image",
        Unless(("decided_by",), "error", "warning"),
        "{photographs} {photographs:shows|show} the mirror image of the others, judging by "
        "{points:common point}.[[ {decided_by:@} shows that these are mirrored.]]",
        "{photographs:this photograph|these photographs} or the others were mirrored by a program, or x "
        "was reversed",
        "Use the original photographs; control, or points of known handedness, show which are mirrored.",
    ),
    Kind(
        "photograph_of_second_object",
        "warning",
        "[[{photographs} fit one another but not the others: {points:common point} "
        "{points:differs|differ} by {misfit:%} of their spread]][[{codes:code} {codes:is|are} elsewhere "
        "than in the others: {codes}]][[; {agreeing} {agreeing:agrees|agree} with it]].",
        "a second object with the same codes, this one in another state, or wrong codes",
        "Survey it separately, or correct the codes.",
    ),
)
