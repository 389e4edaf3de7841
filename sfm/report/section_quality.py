"""How good is it: the part of the report on precision of points, image coordinates and cameras."""

from __future__ import annotations

from html import escape

import numpy as np

from sfm.report.markup import finer_unit, raised, significant, table, with_exponent
from sfm.report.observed_exterior import exterior_section
from sfm.report.result import SurveyResult
from sfm.report.section_statistics import camera_notes, components, control, image_coordinates, worst
from sfm.report.statistics import InteriorParameter, families, interior_parameters
from sfm.report.tables import point_sigmas, root_mean_square


def quality_section(result: SurveyResult, pictures: dict[str, str]) -> str:
    """How good is it: precision of points, check at control, image coordinates, cameras."""
    a = result.adjustment
    sigma = point_sigmas(a)
    limiting = np.sqrt(np.einsum("nii->ni", a.covariance.points_limiting))
    factor, unit = finer_unit(result.length_unit, float(np.nanmax(sigma)))
    text = "<h3>Object points</h3>"
    text += table(
        (f"standard deviation [{unit}]", "X", "Y", "Z", "all"),
        [
            (name, *(significant(value * factor) for value in (*columns, over_all)))
            for name, columns, over_all in (
                ("RMS", np.sqrt(np.nanmean(sigma**2, axis=0)), root_mean_square(sigma)),
                ("largest", np.nanmax(sigma, axis=0), np.nanmax(sigma)),
                (
                    "RMS if the cameras were free of error",
                    np.sqrt(np.nanmean(limiting**2, axis=0)),
                    root_mean_square(limiting),
                ),
            )
        ],
    )
    text += (
        "<p class=note>Standard deviations are a posteriori and in the datum of the adjustment "
        f"({escape(a.datum)}); in a free network they say how the points lie to one another, not in an outer "
        "frame.</p>"
    )
    text += control(result) + exterior_section(result)
    text += image_coordinates(result)
    text += pictures.get("distribution", "") + pictures.get("residuals", "") + worst(result)
    text += "<h3>Cameras</h3>"
    text += _cameras(result)
    text += camera_notes(result)
    text += "<h3>Photographs</h3>" + pictures.get("photographs", "")
    return text + components(result)


def _cameras(result: SurveyResult) -> str:
    """Interior orientation of each camera; parameters of single photographs and groups in a table below."""
    a = result.adjustment
    parameters = interior_parameters(a)
    text = ""
    listed = families(a)
    for family, camera in listed:
        width, height = camera.size_px
        own = [one for one in parameters if one.owner == family]
        photographs = max((one.photographs for one in own), default=0)
        text += (
            f"<h4>{escape(family)}</h4><p class=note>model {escape(camera.model)}, {width} x "
            f"{height} px of {camera.pixel_mm[0] * 1e3:.5g} x {camera.pixel_mm[1] * 1e3:.5g} &micro;m"
            + (f"; these parameters are common to {photographs} photographs" if camera.shared else "")
            + "</p>"
        )
        text += table(
            ("parameter", "value", "sigma", "unit", "value / sigma"), [_row(one)[1:] for one in own]
        )
    single = [one for one in parameters if one.owner not in dict(listed)]
    if single:
        text += (
            f"<details{' open' if len(single) <= 30 else ''}><summary>{len(single)} parameters of single "
            "photographs and groups</summary>"
        )
        header = ("of", "parameter", "value", "sigma", "unit", "value / sigma")
        text += table(header, [_row(one) for one in single]) + "</details>"
    return text


def _row(one: InteriorParameter) -> tuple[str, ...]:
    ratio = f"{abs(one.value) / one.sigma:.1f}" if np.isfinite(one.sigma) and one.sigma > 0 else ""
    return (one.owner, one.name, *with_exponent(one.value, one.sigma), raised(one.unit), ratio)
