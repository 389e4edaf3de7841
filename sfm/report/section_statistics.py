"""The statistics of an adjustment in the report: tests, worst residuals, control, bars, components."""

from __future__ import annotations

from html import escape

import numpy as np

from sfm.adjustment.quality.statistics import (
    STRONG,
    Correlation,
    correlations,
    significance,
)
from sfm.adjustment.quality.variance_components import VarianceComponents
from sfm.report.checks import (
    count_observations,
    sigma0_ratio,
    worst_residuals,
)
from sfm.report.markup import significant, table
from sfm.report.statistics import (
    Statistics,
    quantiles,
    statistics_of,
    words_of_test,
    words_of_weights,
)
from sfm.result import SurveyResult


def image_coordinates(result: SurveyResult) -> str:
    """Sigma0, the global test, residuals and redundancy, then the ten worst residuals."""
    a, found = result.adjustment, statistics_of(result)
    ratio = sigma0_ratio(result)
    rows = [
        ("sigma0, a posteriori, of all observations", f"{a.sigma0_px:.5f}", "px"),
        ("standard deviation by the image points alone", f"{ratio * result.adjustment.stated_px:.5f}", "px"),
        ("standard deviation stated beforehand", f"{result.adjustment.stated_px:.5f}", "px"),
        ("of the image points, a posteriori over that stated", f"{ratio:.3f}", ""),
        ("RMS residual per coordinate", f"{a.rms_px:.5f}", "px"),
        ("longest residual vector among the accepted", f"{a.max_residual_px:.4f}", "px"),
    ]
    text = "<h3>Image coordinates</h3>" + table(("", "value", "unit"), rows)
    tests = "".join(f"<li>{escape(words_of_test(test), quote=False)}</li>" for test in found.global_tests)
    text += f"<p>Global test:</p><ul>{tests}</ul>"
    words = words_of_weights(result)
    text += f"<p class=note>{escape(words)}</p>" if words else ""
    text += (
        "<p class=note>The global test asks whether the standard deviations stated beforehand are those of "
        "the residuals. That of the image points (sigma_px) is only a rough guess: a test that is not passed "
        "says by how much to correct it, unless sigma0 is several times too large.</p>"
    )
    known = np.isfinite(a.redundancy_numbers).any()
    return text + (_tests_and_reliability(result, found) if known else "")


def _tests_and_reliability(result: SurveyResult, found: Statistics) -> str:
    """Redundancy numbers, the tests for single gross errors, and what such an error could do."""
    r = result.adjustment.redundancy_numbers
    bias, external = quantiles(found.reliability.minimal_bias), quantiles(found.reliability.external)
    text = "<h3>Tests and reliability of single image coordinates</h3>" + table(
        ("test for a gross error", "coordinates", "critical value", "beyond it", "by chance", "largest"),
        [
            (
                f"{name}, {100 * test.alpha:.1f} %",
                str(test.tested),
                f"{test.critical:.2f}",
                str(test.beyond),
                f"{test.expected:.1f}",
                f"{np.nanmax(np.abs(test.statistic)):.2f}",
            )
            for name, test in (
                ("Baarda's w (sigma of the weights)", found.w),
                ("Pope's tau (sigma0 as found)", found.tau),
            )
        ],
    )
    text += table(
        ("reliability", "median", "worst", "unit"),
        [
            (
                "redundancy number (0 no check, 1 full check)",
                f"{np.nanmedian(r):.3f}",
                f"{np.nanmin(r):.3f}",
                "",
            ),
            ("smallest gross error that is found", significant(bias[0]), _or_unlimited(bias[1]), "px"),
            (
                "its effect on an unknown if it is not found",
                significant(external[0]),
                _or_unlimited(external[1]),
                "sigmas of the unknown",
            ),
        ],
    )
    return text + (
        f"<p class=note>The redundancy numbers add up to {found.redundancy_sum:.1f}, the redundancy is "
        f"{result.adjustment.redundancy}. The smallest gross error (minimal detectable bias) is found by the "
        f"w test in {100 * found.power:.0f} of 100 cases, with the standard deviations of the weights. "
        "Its effect is the external reliability. Of every image coordinate: reliability.csv.</p>"
    )


def _or_unlimited(value: float) -> str:
    return "unlimited" if np.isinf(value) else significant(value)


def worst(result: SurveyResult) -> str:
    """The accepted image points with the largest standardised residuals."""
    found = worst_residuals(result.adjustment)
    if not len(found.row):
        return ""
    network = result.adjustment.network
    seen = network.image_points
    return f"<h3>The {len(found.row)} largest residuals that were accepted</h3>" + table(
        ("photograph", "point", "vx [px]", "vy [px]", "w (Baarda)", "tau (Pope)"),
        [
            (
                network.images[seen.image[k]],
                network.points[seen.point[k]],
                *(f"{value:+.3f}" for value in v),
                f"{w:+.2f}",
                f"{tau:+.2f}",
            )
            for k, v, w, tau in zip(found.row, found.v, found.w, found.tau, strict=True)
        ],
    )


def observations(result: SurveyResult) -> str:
    """How many observations of each type took part."""
    counts = count_observations(result.adjustment)
    rows = [
        (name, str(count))
        for name, count in (
            ("image coordinates", counts.image),
            ("coordinates of control with a standard deviation", counts.control),
            ("parameters of exterior orientation", counts.exterior),
            ("parameters of interior orientation", counts.interior),
            ("scale bars", counts.scale_bars),
        )
        if count
    ]
    rows.append(("all", str(counts.total)))
    text = "<h3>Observations</h3>" + table(("observations", "number"), rows, last_bold=True)
    if counts.constraints:
        text += f"<p class=note>Besides, {counts.constraints} constraints fix the datum.</p>"
    return text


def camera_notes(result: SurveyResult) -> str:
    """What of the cameras cannot be told apart from something else, or from 0."""
    a = result.adjustment
    weak = [test for test in significance(a) if not test.significant]
    strong = camera_correlations(result)
    text = "<h3>Correlations and significance of camera parameters</h3>"
    if strong:
        text += table(
            ("parameter", "and", "correlation [%]"),
            [(pair.first, pair.second, f"{100 * pair.value:+.1f}") for pair in strong],
        )
        text += "<p class=note>So strongly correlated, each stands in for the other.</p>"
    else:
        text += f"<p>No two parameters of a camera are correlated beyond {100 * STRONG:.0f} %.</p>"
    with_exterior = result.orientation_correlations
    if with_exterior:
        rows = [
            (one.parameter, one.partners, f"{100 * one.largest:+.1f}", f"{one.part} of {one.image}")
            for one in with_exterior
        ]
        text += table(("camera parameter", "strongly correlated with", "largest [%]", "which is with"), rows)
        text += (
            "<p class=note>The photographs can hardly tell these apart, as c from Z0 in a flat network. "
            "Photographs turned about their axis, convergent ones, and an object with depth can.</p>"
        )
    else:
        text += (
            "<p>No camera parameter is correlated with the exterior orientation of a photograph beyond "
            f"{100 * STRONG:.0f} %.</p>"
        )
    if weak:
        names = ", ".join(f"{test.parameter} of {test.camera} ({test.t:.1f})" for test in weak)
        text += (
            "<p>Not significantly different from 0 (t test, 5 %; in brackets the value over its standard "
            f"deviation): {escape(names)}. Held at 0, each by itself would worsen the fit by no more "
            "than chance.</p>"
        )
    else:
        text += "<p>All adjusted parameters differ significantly from 0 (t test, 5 %).</p>"
    return text


def camera_correlations(result: SurveyResult) -> tuple[Correlation, ...]:
    """Return the pairs of camera parameters that are strongly correlated, without those of photographs."""
    a = result.adjustment
    names = {
        f"{name} of camera {camera.group_of(s) or camera.name}"
        for camera in a.estimate.cameras
        for s, name in enumerate(camera.names)
    }
    return tuple(pair for pair in correlations(a) if pair.first in names)


def components(result: SurveyResult) -> str:
    """Variance components of kinds of observation, cameras and photographs."""
    text = "<h3>Variance components</h3><p class=note>Sigma0 of a group over that stated beforehand; a group "
    text += "far above the others was measured worse, or does not fit.</p>"
    found = statistics_of(result)
    if len(found.kinds.names) > 1:
        rows = _component_rows(found.kinds)
        text += table(("kind of observation", "sigma0", "redundancy", "observations"), rows)
    text += table(("camera", "sigma0", "redundancy", "coordinates"), _component_rows(found.cameras))
    rows = _component_rows(found.photographs)
    return (
        text
        + f"<details><summary>{len(rows)} photographs</summary>"
        + table(("photograph", "sigma0", "redundancy", "coordinates"), rows)
        + "</details>"
    )


def _component_rows(found: VarianceComponents) -> list[tuple[str, ...]]:
    return [
        (name, f"{s:.3f}" if np.isfinite(s) else "not known", f"{r:.1f}", str(int(n)))
        for name, s, r, n in zip(found.names, found.sigma0, found.redundancy, found.count, strict=True)
    ]
