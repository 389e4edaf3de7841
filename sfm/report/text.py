"""report.txt: the bundle report on one page of plain text, as surveyors read it in a terminal.

Rank and datum, sigma0 and redundancy, tests, reliability, variance components, unknowns with their standard
deviations, correlations, worst residuals. No dates and hosts, so that two reports can be compared.
"""

from __future__ import annotations

import numpy as np

from sfm.adjustment.quality.statistics import STRONG
from sfm.adjustment.quality.variance_components import VarianceComponents
from sfm.report.checks import (
    count_observations,
    sigma0_ratio,
    worst_residuals,
)
from sfm.report.markup import finer_unit, significant, with_exponent
from sfm.report.observed_exterior import exterior_text
from sfm.report.precision import (
    adjusted_sigmas,
    point_precision,
    root_mean_squares,
    without_fixed,
    words_of_limiting,
)
from sfm.report.section_geometry import geometry_text
from sfm.report.statistics import (
    Statistics,
    datum_in_words,
    interior_parameters,
    quantiles,
    statistics_of,
    words_of_t,
    words_of_test,
    words_of_weights,
)
from sfm.report.text_given import given_text
from sfm.report.text_lines import MOST_ROWS, WIDTH, columns, head, line, wrapped
from sfm.report.verdict import verdict_of
from sfm.result import SurveyResult

WORST = 5


def text_report(result: SurveyResult) -> str:
    """Return the report as plain text of at most WIDTH columns.

    Args:
        result: the result.
    """
    statistics = statistics_of(result)
    verdict = verdict_of(result)
    lines = [f"KOLINEAR  {result.survey}"[:WIDTH], "=" * WIDTH, verdict.headline]
    for remark in verdict.remarks:
        lines += wrapped(f"- {remark}")
    for part in (
        _left_out(result),
        _warnings(result),
        _adjustment(result),
        _sigma0(result, statistics),
        _single_tests(result, statistics),
        _components(result, statistics),
        _interior(result, statistics),
        _points(result),
        geometry_text(result),
        given_text(result),
        exterior_text(result),
        _worst(result),
    ):
        lines += part
    lines += [
        "",
        "sigma: one standard deviation, a posteriori; w test and minimal bias rest on those of the weights.",
        "Residuals: computed minus measured. Pixel (0, 0): centre of the top-left pixel.",
        "Tables (.csv): points, images, cameras, image_points, given, reliability, variance_components.",
    ]
    return "\n".join(one.rstrip() for one in lines) + "\n"


def _left_out(result: SurveyResult) -> list[str]:
    """Photographs that are not in the result, and why."""
    lines = [one for f in result.failed[:MOST_ROWS] for one in wrapped(f"  {f.image}: {f.reason}")]
    if len(result.failed) > MOST_ROWS:
        lines.append(f"  and {len(result.failed) - MOST_ROWS} more, in summary.json")
    return head("Photographs that are not in the result") + lines if lines else []


def _warnings(result: SurveyResult) -> list[str]:
    """All warnings, of which the remarks tell the first."""
    if len(result.warnings) < 2:
        return []
    return head("Warnings") + [one for warning in result.warnings for one in wrapped(f"  {warning}")]


def _adjustment(result: SurveyResult) -> list[str]:
    a, counts = result.adjustment, count_observations(result.adjustment)
    network = a.network
    exterior = 6 * len(network.images)
    interior = sum(1 for p in interior_parameters(a) if np.isfinite(p.sigma))
    observed = [
        f"{number} {name}"
        for name, number in (
            ("image coordinates", counts.image),
            ("control coordinates", counts.control),
            ("exterior orientation", counts.exterior),
            ("interior orientation", counts.interior),
            ("scale bars", counts.scale_bars),
        )
        if number
    ]
    unknowns = (
        f"{exterior} exterior orientation, {interior} interior, {a.unknowns - exterior - interior} points"
    )
    rank = "as expected" if a.defect == a.expected_defect else f"expected {a.expected_defect}"
    lines = [
        *head("Network and rank"),
        line("photographs", f"{len(network.images)} of {result.images_total}"),
        line("object points", f"{len(network.points)}"),
        line("image points", f"{int((~a.rejected).sum())} accepted, {int(a.rejected.sum())} rejected"),
        line("adjustment", f"{'converged' if a.converged else 'NOT converged'}, {a.steps}"),
        line("datum", f"{datum_in_words(a)}; rank defect {a.defect}, {rank}"),
        line("observations", f"{a.observations} ({', '.join(observed)})"),
        line("unknowns", f"{a.unknowns} ({unknowns})"),
        line("constraints", f"{counts.constraints}"),
        line("redundancy", f"{a.redundancy}"),
    ]
    for words in a.undetermined:
        lines += wrapped(f"  NOT DETERMINED: {words}")
    return lines


def _sigma0(result: SurveyResult, statistics: Statistics) -> list[str]:
    a = result.adjustment
    lines = [
        *head("Sigma0 and global test"),
        line("sigma0", f"{a.sigma0_px:.5f} px, of all observations, a posteriori"),
        line("image points", f"{sigma0_ratio(result) * result.adjustment.stated_px:.5f} px, by themselves, "
              f"{sigma0_ratio(result):.3f} times the {result.adjustment.stated_px:.5f} px a priori"),
        line("residuals", f"RMS {a.rms_px:.5f} px per coordinate, longest {a.max_residual_px:.4f} px"),
    ]  # fmt: skip
    for test in statistics.global_tests:
        lines += wrapped(f"  global test, {words_of_test(test)}")
    words = words_of_weights(result)
    return lines + wrapped(f"  {words}") if words else lines


def _single_tests(result: SurveyResult, statistics: Statistics) -> list[str]:
    r = result.adjustment.redundancy_numbers
    lines = head("Tests and reliability of image coordinates")
    if not np.isfinite(r).any():
        return [*lines, line("", "not known, the adjustment has no covariance")]
    lines += [
        line(
            "redundancy numbers",
            f"sum {np.nansum(r):.1f}, of all observations {statistics.redundancy_sum:.1f}; mean "
            f"{np.nanmean(r):.3f}, smallest {np.nanmin(r):.3f}",
        )
    ]
    for name, test in (("w test (Baarda)", statistics.w), ("tau test (Pope)", statistics.tau)):
        lines.append(
            line(
                name,
                f"{test.beyond} of {test.tested} beyond {test.critical:.2f}, by chance {test.expected:.1f} "
                f"({100 * test.alpha:.1f} %); largest {np.nanmax(np.abs(test.statistic)):.2f}",
            )
        )
    found = statistics.reliability
    bias, external = quantiles(found.minimal_bias), quantiles(found.external)
    return [
        *lines,
        line(
            "minimal bias",
            f"median {significant(bias[0])} px, largest {_or_none(bias[1])} px: gross error found with "
            f"{100 * statistics.power:.0f} %",
        ),
        line(
            "external reliability",
            f"median {significant(external[0])}, largest {_or_none(external[1])} sigmas of an unknown: "
            "effect if not found",
        ),
    ]


def _components(result: SurveyResult, statistics: Statistics) -> list[str]:
    lines = head("Variance components: sigma0 of groups, a posteriori over that stated")
    rows = _component_rows("kind", statistics.kinds)
    rows += _component_rows("camera", statistics.cameras) if len(statistics.cameras.names) > 1 else []
    photographs = _component_rows("photograph", statistics.photographs)
    order = np.argsort(-np.nan_to_num(statistics.photographs.sigma0), kind="stable")
    shown = [photographs[k] for k in order[:WORST]]
    lines += columns(("", "group", "sigma0", "redundancy", "observations"), rows + shown, left=2)
    if len(photographs) > WORST:
        lines.append(f"  the {WORST} worst of {len(photographs)} photographs; all in variance_components.csv")
    return lines


def _component_rows(what: str, found: VarianceComponents) -> list[tuple[str, ...]]:
    return [
        (what, name, f"{s:.3f}" if np.isfinite(s) else "-", f"{r:.1f}", str(int(n)))
        for name, s, r, n in zip(found.names, found.sigma0, found.redundancy, found.count, strict=True)
    ]


def _interior(result: SurveyResult, statistics: Statistics) -> list[str]:
    a = result.adjustment
    parameters = interior_parameters(a)
    models = ", ".join(sorted({camera.model for camera in a.estimate.cameras}))
    rows = []
    for one in parameters[: 4 * MOST_ROWS]:
        value, sigma = with_exponent(one.value, one.sigma)
        rows.append((one.owner, one.name, value, sigma, "" if one.unit == "1" else one.unit, words_of_t(one)))
    lines = head(f"Interior orientation (model {models})")
    lines += columns(("camera", "", "value", "sigma", "unit", "value/sigma"), rows, left=2)
    if len(parameters) > len(rows):
        lines.append(f"  and {len(parameters) - len(rows)} more, in cameras.csv")
    weak = [f"{t.parameter} of {t.camera} (p {t.probability:.2f})" for t in statistics.significance
            if not t.significant]  # fmt: skip
    lines += wrapped(f"  not significant (t test, 5 %): {', '.join(weak) or 'none'}")
    pairs = [f"{pair.first} - {pair.second} {100 * pair.value:+.1f} %" for pair in statistics.correlations]
    over = f"{100 * STRONG:.0f} %"
    lines.append(f"  correlations over {over}: {len(pairs) or 'none'}")
    lines += [part for pair in pairs[:MOST_ROWS] for part in wrapped(f"    {pair}")]
    if len(pairs) > MOST_ROWS:
        lines.append(f"    and {len(pairs) - MOST_ROWS} more, in summary.json")
    return lines + _with_exterior(result, over)


def _with_exterior(result: SurveyResult, over: str) -> list[str]:
    """Camera parameters that hang together with exterior orientation."""
    found = result.orientation_correlations
    lines = [f"  of camera parameters with exterior orientation, over {over}: {len(found) or 'none'}"]
    for one in found[:MOST_ROWS]:
        largest = f"{100 * one.largest:+.1f} % ({one.part} of {one.image})"
        lines += wrapped(f"    {one.parameter} - {one.partners}; largest {largest}")
    if len(found) > MOST_ROWS:
        lines.append(f"    and {len(found) - MOST_ROWS} more, in summary.json")
    return lines


def _points(result: SurveyResult) -> list[str]:
    a = result.adjustment
    precision = point_precision(a)
    factor, unit = finer_unit(result.length_unit, float(precision[1, 3]))
    names = (
        "object points, RMS sigma",
        "object points, largest sigma",
        "limiting (cameras without error), RMS",
    )
    rows = [
        (name, *(significant(v * factor) for v in row), unit)
        for name, row in zip(names, precision, strict=True)
    ]
    exterior = adjusted_sigmas(a.covariance.exterior)
    centres, angles = exterior[:, :3] * factor, np.degrees(exterior[:, 3:]) * 3600
    rows += [
        ("projection centres, RMS sigma", *(significant(v) for v in root_mean_squares(centres)), unit),
        ("omega, phi, kappa, RMS sigma", *(significant(v) for v in root_mean_squares(angles)), "arc seconds"),
    ]
    return [
        *head("Precision of the unknowns"),
        *columns(("", "X", "Y", "Z", "all", "unit"), rows, left=1),
        *([f"  RMS {without_fixed(a)}"] if without_fixed(a) else []),
        *(wrapped(f"  {words_of_limiting(precision)}") if words_of_limiting(precision) else []),
    ]


def _worst(result: SurveyResult) -> list[str]:
    found = worst_residuals(result.adjustment, WORST)
    if not len(found.row):
        return []
    network = result.adjustment.network
    seen = network.image_points
    rows = [
        (network.images[seen.image[k]], network.points[seen.point[k]], f"{v[0]:+.3f}", f"{v[1]:+.3f}",
         f"{w:+.2f}", f"{tau:+.2f}")
        for k, v, w, tau in zip(found.row, found.v, found.w, found.tau, strict=True)
    ]  # fmt: skip
    return head(f"The {len(rows)} largest standardised residuals among the accepted") + columns(
        ("photograph", "point", "vx [px]", "vy [px]", "w", "tau"), rows, left=2
    )


def _or_none(value: float) -> str:
    return "unlimited" if np.isinf(value) else significant(value)
