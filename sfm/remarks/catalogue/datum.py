"""Datum, scale and given values: what of them was not used or not found."""

from __future__ import annotations

from sfm.remarks.kind import Grade, Kind

ROWS = (
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
        "Projection centres of {positions} of {photographs} photographs are observed in EXIF data: X east "
        "and Y north (WGS 84) from latitude {latitude:.3f}, longitude {longitude:.3f}, Z the height as "
        "stated, above sea level or the ellipsoid.",
        "[exterior] exif_sigma_m; EXIF data do not say what heights are above. Errors that photographs have "
        "in common are in no standard deviation: the receiver's, of metres over minutes, and where its "
        "antenna is on the camera",
        "Use bars or control for scale and coordinates that must be better than the receiver.",
    ),
    Kind(
        "exif_positions_far",
        "warning",
        "The positions of {far} in EXIF data are more than {limit} from the others and were not used.",
        "a receiver without reception that stated its last or a default position",
        "Correct or remove the position if the photograph belongs to the survey.",
    ),
    Kind(
        "exterior_unused",
        "note",
        "Observed exterior orientation takes no part in datum '{datum}'.",
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
