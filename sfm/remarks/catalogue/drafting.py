"""Drafts of survey files: what the photographs of a folder do not show, or show badly."""

from __future__ import annotations

from sfm.remarks.kind import Grade, Kind

ROWS = (
    Kind(
        "photographs_resampled",
        "warning",
        "{photographs:photograph} of camera {camera} {photographs:has|have} {size}, but the camera took "
        "{taken}.",
        "photographs that a program resampled or cropped",
        "Use the original photographs.",
    ),
    Kind(
        "photographs_marked_as_turned",
        "note",
        "{photographs:photograph} of camera {camera} {photographs:is|are} marked as turned.",
        "pixels are taken as they are stored, which is right for one camera",
        "Nothing needs to be done.",
    ),
    Kind(
        "camera_assumed",
        "note",
        "The files of camera {cameras} do not state the size of the pixels or the focal length.",
        "no EXIF data, or a camera that is not in the list; shapes and angles do not depend on it",
        "Give sensor_mm and c_mm if c in mm matters.",
    ),
    Kind(
        "several_cameras",
        "note",
        "The photographs are of {cameras:camera} or settings: {cameras}.",
        "another body, zoom, size or orientation of the photographs",
        "Make them one camera in the survey file if they are one.",
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
        "A photograph has {circles:circle}, but no code of a known family: texture orients the photographs.",
        "targets without codes",
        "Put coded targets among them.",
    ),
    Kind(
        "plate_pitch_assumed",
        "note",
        "The pitch of the plate is assumed to be {pitch}.",
        "a calibration plate was found, its size is not known",
        "If lengths matter, give the distance of neighbouring dots or crossings: --pitch for a new survey "
        "file, targets.pitch without pitch_assumed in one that exists. Cameras do not depend on it.",
    ),
    Kind(
        "sensor_not_looked_up",
        "note",
        "{camera} was not looked up in COLMAP's list of cameras: {reason}.",
        "a library is not installed",
        "Install it, or give sensor_mm.",
    ),
)
