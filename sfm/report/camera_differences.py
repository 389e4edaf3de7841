"""The page of the difference of two cameras."""

from __future__ import annotations

import math
from itertools import compress
from pathlib import Path

import numpy as np

from sfm.comparison.camera_difference import CameraDifference
from sfm.model.remarks.verdict import Level, Line
from sfm.report.figures.comparisons import camera_difference_figure
from sfm.report.figures.plot_data import Plot
from sfm.report.figures.plots import plot
from sfm.report.page import Banner, Column, Note, Page, Section, Table, file_columns
from sfm.report.phrases import significant

PICTURE = (
    "Where the second camera images the rays of the first one, after the rotation that both imply. Pale: no "
    "image points of one of them are near."
)
EDGE = 0.8  # part of the half diagonal beyond which a place is called the edge
REGION = Note(
    "The known region is the hull of the image points of both calibrations, or the whole photograph where "
    "they are unknown. The rotation (at a distance also the shift) that makes the differences there smallest "
    "is left out: exterior orientations take it up."
)


def page(difference: CameraDifference) -> Page:
    """Return the page of a difference of two cameras: verdict, figures, picture and table."""
    first, second = difference.names
    columns = file_columns("x_px", "y_px", "dx_px", "dy_px", "sigma_px", "known")
    X, Y = np.meshgrid(difference.x, difference.y)
    rows = np.column_stack(
        [
            *(X.ravel(), Y.ravel(), difference.difference.reshape(-1, 2)),
            *(difference.sigma_px.ravel(), difference.known.ravel()),
        ]
    ).tolist()
    return Page(
        "cameras",
        "Comparison of cameras",
        f"{second} minus {first}",
        verdict_of_difference(difference),
        (
            Section("Figures", _figures(difference), REGION),
            Section("Picture", _picture(difference)),
        ),
        summary=_summary(difference),
        files=(Table(columns, rows, "camera_difference"),),
    )


def _picture(difference: CameraDifference) -> Plot:
    return plot("difference", PICTURE, camera_difference_figure(difference))


def write_picture(difference: CameraDifference, folder: Path) -> None:
    """Write the picture of the page as difference.png and difference.svg into a folder."""
    (folder / "difference.png").write_bytes(_picture(difference).png)
    camera_difference_figure(difference).savefig(folder / "difference.svg", metadata={"Date": None})


def verdict_of_difference(difference: CameraDifference) -> Banner:
    """Return what the difference is, and whether chance explains it."""
    level: Level = "good" if difference.significant is False else "fair"
    lines = []
    known = list(compress(difference.names, difference.has_sigma))
    if not known:
        lines.append(
            Line("note", "Neither file has the covariance of its camera: whether they differ is not tested.")
        )
    elif len(known) == 1:
        lines.append(
            Line(
                "note",
                f"Only the covariance of {known[0]} is known; the other camera counts as free of error.",
            )
        )
    if len(known) == 2 and not difference.independent:
        lines.append(
            Line(
                "note",
                "Both cameras are of one adjustment or the same image points; their correlation is left out "
                "of the test.",
            )
        )
    part = float(difference.known.mean())
    if part < 0.5:
        lines.append(
            Line(
                "note",
                f"Both cameras are known in {100 * part:.0f} % of the photograph; the rest is extrapolation.",
            )
        )
    return Banner(level, describe_difference(difference), tuple(lines))


def describe_difference(difference: CameraDifference) -> str:
    """Return the difference of two cameras in a sentence."""
    row, column = difference.largest
    xy = np.array([difference.x[column], difference.y[row]])
    middle = (np.array(difference.size_px) - 1) / 2
    edge = float(np.linalg.norm(xy - middle) / np.linalg.norm(middle)) > EDGE
    words = (
        f"They differ by {significant(difference.rms_px)} px RMS, {significant(difference.largest_px)} px at "
        f"most ({'at the edge, ' if edge else ''}x {xy[0]:.0f}, y {xy[1]:.0f})"
    )
    if np.isnan(difference.p_value):
        return f"{words}; standard deviations are not known."
    if difference.significant is None:
        return f"{words}, {significant(difference.over_sigma)} standard deviations of separate calibrations."
    what = "more than chance" if difference.significant else "no more than chance"
    return f"{words}, {significant(difference.over_sigma)} standard deviations: {what}."


def _figures(difference: CameraDifference) -> Table:
    """Return the figures of a difference."""
    turn = np.degrees(difference.rotation)
    far = math.isinf(difference.distance)
    row, column = difference.largest
    rows = [
        ("RMS in the known region", significant(difference.rms_px), "px"),
        ("chance alone would give", _known(difference.expected_rms_px), "px"),
        ("largest in the known region", significant(difference.largest_px), "px"),
        ("its standard deviation", _known(float(difference.sigma_px[row, column])), "px"),
        ("probability by chance", _known(difference.p_value), ""),
        ("largest in the whole photograph", significant(float(np.nanmax(difference.length_px))), "px"),
        ("known to both", f"{100 * float(difference.known.mean()):.0f}", "% of the photograph"),
        ("distance", "infinite" if far else significant(difference.distance), ""),
        ("implied rotation about x, y, z", ", ".join(significant(float(angle)) for angle in turn), "deg"),
    ]
    if not far:
        shift = ", ".join(significant(float(part)) for part in difference.translation)
        rows.append(("implied shift in x, y, z", shift, "as the distance"))
    return Table((Column(), Column("value", format=str), Column("unit")), rows)


def _known(value: float) -> str:
    return "not known" if math.isnan(value) else significant(value)


def _summary(difference: CameraDifference) -> dict[str, object]:
    """Return the content of cameras.json."""
    row, column = difference.largest
    return {
        "cameras": difference.names,
        "size_px": difference.size_px,
        "covariances": difference.has_sigma,
        "distance": difference.distance,
        "rms_px": difference.rms_px,
        "expected_rms_px": difference.expected_rms_px,
        "standard_deviations": difference.over_sigma,
        "largest_px": difference.largest_px,
        "largest_at_px": [difference.x[column], difference.y[row]],
        "largest_sigma_px": float(difference.sigma_px[row, column]),
        "probability": difference.p_value,
        "independent": difference.independent,
        "significant": difference.significant,
        "known_part": float(difference.known.mean()),
        "rotation_deg": np.degrees(difference.rotation),
        "translation": difference.translation,
        "headline": describe_difference(difference),
    }
