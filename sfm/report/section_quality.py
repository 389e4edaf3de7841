"""How good is it: the part of the report on precision of points, image coordinates and cameras."""

from __future__ import annotations

from html import escape

from sfm.report.given import interior_residuals, words_of_w
from sfm.report.markup import finer_unit, raised, signed, significant, table, with_exponent
from sfm.report.observed_exterior import exterior_section
from sfm.report.precision import point_precision, without_fixed, words_of_limiting
from sfm.report.section_geometry import geometry_section
from sfm.report.section_given import NOTE, given_section
from sfm.report.section_statistics import camera_notes, components, image_coordinates, worst
from sfm.report.statistics import InteriorParameter, families, interior_parameters, words_of_t
from sfm.result import SurveyResult


def quality_section(result: SurveyResult, pictures: dict[str, str]) -> str:
    """How good is it: precision of points, check at control, image coordinates, cameras."""
    a = result.adjustment
    precision = point_precision(a)
    factor, unit = finer_unit(result.length_unit, float(precision[1, 3]))
    fixed = f", {without_fixed(a)}" if without_fixed(a) else ""
    text = "<h3>Object points</h3>"
    text += table(
        (f"standard deviation [{unit}]", "X", "Y", "Z", "all"),
        [
            (name, *(significant(value * factor) for value in row))
            for name, row in zip(
                ("RMS", "largest", "limiting: RMS if the cameras were free of error"), precision, strict=True
            )
        ],
    )
    text += (
        "<p class=note>Standard deviations are a posteriori and in the datum of the adjustment "
        f"({escape(a.datum)}){fixed}; in a free network they say how the points lie to one another, not in "
        f"an outer frame. {words_of_limiting(precision)}</p>"
    )
    text += geometry_section(result) + given_section(result) + exterior_section(result)
    text += image_coordinates(result)
    text += pictures.get("distribution", "") + pictures.get("residuals", "") + worst(result)
    text += "<h3>Cameras</h3>"
    text += _cameras(result) + _observed_interior(result)
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


def _observed_interior(result: SurveyResult) -> str:
    """Interior orientation that was observed, as by a calibration certificate: by how much it differs."""
    found = interior_residuals(result)
    if found is None:
        return ""
    rows = []
    for q, name in enumerate(found.names):
        v, r, w = found.difference[q, 0], found.r[q, 0], found.w[q, 0]
        given, sigma = with_exponent(found.given[q, 0], found.sigma[q, 0])
        adjusted, _ = with_exponent(found.given[q, 0] + v, found.sigma[q, 0])
        rows.append(
            (name, adjusted, given, sigma, signed(v), raised(found.units[q]), f"{r:.3f}", words_of_w(w, r))
        )
    header = ("parameter", "adjusted", "observed", "its sigma", "adjusted minus observed", "unit", "r", "w")
    return "<h4>Observed interior orientation</h4>" + table(header, rows) + f"<p class=note>{NOTE}</p>"


def _row(one: InteriorParameter) -> tuple[str, ...]:
    return (one.owner, one.name, *with_exponent(one.value, one.sigma), raised(one.unit), words_of_t(one))
