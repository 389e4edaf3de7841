"""The summary of a result on the terminal."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from sfm.cli.process import FAILED
from sfm.model.display import MAX_LISTED, counted, listed, program_name, wrapped
from sfm.model.remarks.row import Severity
from sfm.model.remarks.verdict import Line, Verdict, split_lines
from sfm.report.findings import Findings
from sfm.report.page import Banner
from sfm.report.pdf import write_pdf
from sfm.report.phrases import (
    describe_calibration,
    describe_check,
    describe_neighbours,
    describe_precision,
    describe_rigs,
    describe_sigma0,
    describe_test,
    describe_view,
    finer_unit,
    significant,
    words_left_out,
)
from sfm.report.unfinished import verdict
from sfm.survey.unfinished import UnfinishedSurvey

COLOURS = {"good": "green", "fair": "yellow", "bad": "red"}
COLUMN_GAP = 2  # characters between columns
STYLES: dict[Severity, str] = {"error": "red", "warning": "yellow", "note": "dim"}


def print_page(what: str, page: Path, *, pdf: bool) -> None:
    """Print the path of a page that was written.

    Args:
        what: what the page is, such as Report.
        page: path of the page.
        pdf: whether to write it as PDF too.

    Raises:
        OutputError: it cannot be printed.
    """
    console = Console(highlight=False)
    console.print(Text(f"{what}: {page}", style="bold"), soft_wrap=True)
    if pdf:
        console.print(Text(f"PDF: {write_pdf(page)}", style="bold"), soft_wrap=True)


def print_result(findings: Findings, page: Path, *, seconds: float, verbose: bool, pdf: bool = False) -> bool:
    """Print the summary of a survey: verdict, figures with units, remarks, failures and path of the report.

    Args:
        findings: the result and its remarks.
        page: path of the report.
        seconds: duration of the run, s.
        verbose: whether to add details, photographs and cameras.
        pdf: whether to write the report as PDF too.

    Returns:
        Whether the result is dependable.
    """
    result, verdict = findings.result, findings.verdict
    a = result.adjustment
    console = Console(highlight=False)
    console.print(Text(verdict.headline, style=f"bold {COLOURS[verdict.level]}"), soft_wrap=True)
    table = Table(show_header=False, box=None, padding=(0, COLUMN_GAP, 0, 0), pad_edge=False)
    figures = (*_figures(findings), ("time", f"{seconds:.1f} s, including the report"))
    rows = (*figures, *(_details(findings) if verbose else ()))
    room = console.width - max(len(name) for name, _ in rows) - COLUMN_GAP
    for name, value in rows:
        table.add_row(Text(name, style="dim"), Text(wrapped(value, room)))
    console.print(table)
    print_remarks(console, verdict.lines, folded=not verbose)
    for line in _failures(findings):
        console.print(Text(f"  {line}"), soft_wrap=True)
    if verbose:
        photographs = Table(box=None, padding=(0, 2, 0, 0))
        for name in ("photograph", "targets", "rejected candidates"):
            photographs.add_column(name, justify="left" if name != "targets" else "right")
        for photograph in result.photographs:
            reasons = ", ".join(f"{count} {reason}" for reason, count in photograph.reasons())
            photographs.add_row(Text(photograph.image), str(len(photograph.xy)), Text(reasons))
        console.print(photographs)
        for camera in a.estimate.cameras:
            values = ", ".join(
                f"{name} {significant(value, 6)} {unit}"
                for name, value, unit, free in zip(
                    camera.names, camera.parameters, camera.units, camera.free, strict=True
                )
                if free
            )
            console.print(Text(f"  camera {camera.name} ({camera.model}): {values}"))
    print_page("Report", page, pdf=pdf)
    return verdict.level != "bad"


def print_unfinished(reached: UnfinishedSurvey, page: Path, *, pdf: bool = False) -> None:
    """Print why a survey could not be finished, the remarks so far, and the path of its report."""
    print_verdict(verdict(reached))
    print_page("Report", page, pdf=pdf)


def print_verdict(verdict: Verdict | Banner) -> None:
    """Print a verdict: its headline in its colour, then its remarks."""
    console = Console(highlight=False)
    console.print(Text(verdict.headline, style=f"bold {COLOURS[verdict.level]}"), soft_wrap=True)
    print_remarks(console, verdict.lines)


def exit_by(verdict: Verdict | Banner) -> None:
    """End the command with exit code 1 if its verdict is bad; `print_verdict` says why.

    Raises:
        SystemExit: the verdict is bad.
    """
    if verdict.level == "bad":
        raise SystemExit(FAILED)


def print_remarks(console: Console, lines: Sequence[Line], *, folded: bool = False) -> None:
    """Print remarks: errors and warnings with a leading `!`, then notes.

    Remedies are printed except for notes on which no photograph or point was lost.

    Args:
        console: console of the terminal.
        lines: remarks in order of severity.
        folded: whether notes are counted only where there are many.
    """
    shown, rest = split_lines(lines) if folded else (lines, ())
    for line in shown:
        is_note = line.severity == "note"
        remedy = "" if is_note and not line.lost else line.remedy
        text = f"{' ' if is_note else '!'} {line.text} {remedy}".rstrip()
        console.print(Text(text, style=STYLES[line.severity]), soft_wrap=True)
    if rest:
        more = f"  {counted(len(rest), 'more note')}: in the report, or with --verbose"
        console.print(Text(more, style=STYLES["note"]), soft_wrap=True)


def _failures(findings: Findings) -> list[str]:
    """Return the reasons why photographs are not in the result, with remedies; equal reasons are merged.

    Reasons that another remark explains are left out.
    """
    said = {
        (image, kind)
        for remark in findings.verdict.remarks
        for image in remark.names("photographs")
        for kind in remark.row.explains
    }
    told = {remark.kind for remark in findings.verdict.remarks}  # with the remedy
    images: dict[tuple[str, str], list[str]] = {}
    for failed in findings.result.failed:
        if (failed.image, failed.reason.kind) not in said:
            reason = failed.reason
            remedy = "" if reason.kind in told else reason.remedy
            images.setdefault((reason.text, remedy), []).append(failed.image)
    return [
        f"{listed(names)}{', each' if len(names) > 1 else ''}: {text} {remedy}".rstrip()
        for (text, remedy), names in images.items()
    ]


def _figures(findings: Findings) -> tuple[tuple[str, str], ...]:
    """Return names and values of the figures of the summary, with units."""
    result, precision = findings.result, findings.precision
    a = result.adjustment
    typical, largest = float(precision.rms[3]), float(precision.largest[3])
    text = describe_precision(typical, largest, result.length_unit)
    if not math.isfinite(typical):
        text = "all coordinates are fixed" if precision.fixed_points else "not known"
    rows = [
        *_cameras(findings),
        *describe_rigs(findings.rigs, findings.result.length_unit),
        ("photographs", f"{len(a.network.images)} of {result.images_total} oriented"),
        (
            "object points",
            f"{len(a.network.points)} ({result.point_counts})",
        ),
        ("image points", result.image_point_counts),
        ("adjustment", f"{'converged' if a.converged else 'NOT converged'}, {a.steps}"),
        ("datum", f"{a.datum}, rank defect {a.defect} (expected {a.expected_defect})"),
        ("sigma0", f"{', '.join(describe_sigma0(findings.sigma0))}, redundancy {a.redundancy}"),
        ("residuals", f"RMS {a.rms_px:.4f} px per coordinate, largest {a.max_residual_px:.3f} px"),
    ]
    if a.error_correlation is not None:
        rows.append(("correlation", describe_neighbours(a)))
    if not findings.calibrated:
        rows.append(("point precision", text))
    if result.control_check is not None:
        rows.append(("check at control", describe_check(result.control_check, result.length_unit)))
    adjusters = result.comparison
    if adjusters is not None:
        word: str = "stopped early, same optimum" if adjusters.stopped_early else adjusters.outcome
        if adjusters.better is not None and adjusters.agree:
            word = f"free {', '.join(adjusters.better.free)}: fits {adjusters.better.times:.3g} times better"
        rms, other = adjusters.comparison.rms_px, program_name(adjusters.backend)
        left_out = words_left_out(findings)
        rows.append(
            (
                other,
                f"{word}: RMS {rms[0]:.7f} px (Kolinear), {rms[1]:.7f} px ({other}), both from the image "
                f"points alone{f', {left_out}' if left_out else ''}, with equal weights, a free datum and "
                f"the camera model {adjusters.model}",
            )
        )
    baseline = result.baseline
    if baseline is not None:
        factor, unit = finer_unit(result.length_unit, baseline.point_rms)
        rows.append(
            (
                baseline.name,
                f"{baseline.photographs[1]} of {baseline.total} oriented, RMS {baseline.rms_px[1]:.3f} px, "
                f"{significant(factor * baseline.point_rms)} {unit} from the survey at "
                f"{counted(baseline.targets, 'point')}, "
                f"{baseline.seconds[1]:.0f} s",
            )
        )
    return tuple(rows)


def _cameras(findings: Findings) -> Iterator[tuple[str, str]]:
    """Yield the calibrated cameras, if the survey is a calibration without adjusted coordinates."""
    for camera in findings.calibrated[:MAX_LISTED]:
        values, sigmas, within, projection = describe_calibration(camera)
        yield f"camera {camera.name}", f"{values}; 1 sigma {sigmas}; 95 % {within}"
        yield "  projection", projection
        if view := describe_view(findings, camera.name):
            yield "  view", view
    if len(findings.calibrated) > MAX_LISTED:
        yield "cameras", f"{len(findings.calibrated) - MAX_LISTED} more, in the report"


def _details(findings: Findings) -> tuple[tuple[str, str], ...]:
    """Return further key figures, for --verbose."""
    result, counts = findings.result, findings.counts
    a = result.adjustment
    rows = [
        ("observations", f"{counts.total}: {counted(counts.image, 'image coordinate')}, "
        f"{counts.control} of control, "
         f"{counted(counts.scale_bars, 'scale bar')}, {counts.further} further; "
         f"{counted(counts.constraints, 'constraint')}, "
         f"{counted(a.unknowns, 'unknown')}"),
    ]  # fmt: skip
    rows += [("global test", describe_test(test, a)) for test in findings.statistics.global_tests]
    eccentricity = result.eccentricity
    if eccentricity is not None:
        rows.append(
            (
                "eccentricity",
                f"corrected by {eccentricity.rms_px:.4f} px RMS, {eccentricity.largest_px:.4f} px at most",
            )
        )
    if result.no_circles:
        rows.append(("no circles", f"{len(result.no_circles)} left out: {', '.join(result.no_circles)}"))
    return tuple(rows)
