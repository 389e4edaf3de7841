"""The page of a validation of the adjuster."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict

import numpy as np

from sfm.comparison.solutions import SAME_SIGMAS
from sfm.comparison.two_adjusters.adjuster_validation import Trial, Validation
from sfm.display import counted, program_name
from sfm.remarks.catalogue import KINDS
from sfm.remarks.verdict import Verdict, judge
from sfm.report.figures.comparisons import time_figure
from sfm.report.figures.plots import plot
from sfm.report.page import YES, Column, FoldedParts, Note, Page, Paragraph, Section, Table
from sfm.report.phrases import fixed, general

TIME_CAPTION = (
    "Seconds of adjustment on one thread. The other adjuster runs until its cost is constant, for the sake "
    "of the comparison; in everyday use it stops earlier."
)
TRIALS = (
    *(Column("network", "network"), Column("arrangement", "arrangement")),
    *(Column("photographs", "photographs", format=str), Column("points", "points", format=str)),
    Column("image points", "image_points", format=str),
    *(
        Column(None, "planar", flag=YES),
        Column(None, "visibility"),
        Column("noise px", "noise_px", format="z.2f"),
    ),
    *(Column("model", "model"), Column(None, "cameras"), Column("interior", "interior")),
    *(Column("datum", "datum"), Column("cost", "cost_kolinear_px2", format=".6g")),
    *(Column(None, "cost_other_px2"), Column("relative difference", format=".1e")),
    *(Column(None, "rms_kolinear_px"), Column(None, "rms_other_px"), Column("steps", format=str)),
    *(Column(None, "iterations_kolinear"), Column(None, "iterations_other"), Column("seconds", format=str)),
    *(Column(None, "seconds_kolinear"), Column(None, "seconds_other"), Column(None, "interior_over_sigma")),
    *(Column(None, "position_over_sigma"), Column(None, "rotation_over_sigma")),
    Column("point / sigma", "point_over_sigma", format=".1e"),
    *(Column(None, "conditional_covariance_difference"), Column(None, "interior_covariance_difference")),
    *(Column(None, "marginal_over_conditional_sigma"), Column(), Column(None, "ended")),
    Column(None, "message"),
)


def page(found: Validation) -> Page:
    """Return the page: how the adjusters ended, largest differences, time, and every network."""
    other = program_name(found.backend)
    optima = [(ended(kind), count) for kind, count in found.counts()]
    differences = [(name, in_words(value, unit)) for name, value, unit in largest(found)]
    ratios = list(_known(one.marginal_over_conditional for one in found.trials))
    ratio = fixed(float(np.median(ratios)) if ratios else math.nan, 2)
    trials = Table(TRIALS, [trial_row(one) for one in found.trials], "validation")
    seconds = (sum(_known(one.seconds[k] for one in found.trials)) for k in (0, 1))
    return Page(
        "validation",
        "Validation",
        f"Kolinear and {other}, seed {found.seed}",
        verdict_of_validation(found),
        (
            Section(
                "Optima",
                Table((Column(), Column("networks", format=str)), optima),
                Note(
                    f"Same optimum: the costs differ by no more than a difference of "
                    f"{general(SAME_SIGMAS, 6)} standard deviations in one direction."
                ),
            ),
            Section(
                "Largest differences",
                Table((Column(), Column("largest difference")), differences),
                Paragraph(
                    "A point's sigma counts all that is uncertain (marginal); with photographs and "
                    f"cameras held, as {other} gives it, it is smaller: by {ratio} in the median."
                ),
            ),
            Section("Time", plot("time", TIME_CAPTION, time_figure(found))),
            Section("All networks", FoldedParts(counted(len(found.trials), "network"), trials)),
        ),
        summary={
            "backend": found.backend,
            "seed": found.seed,
            "networks": len(found.trials),
            "passed": found.passed,
            **verdict_of_validation(found).as_dict(),
            "ended": dict(found.counts()),
            "largest": {name: value for name, value, _ in largest(found)},
            "seconds": dict(zip(("kolinear", found.backend), seconds, strict=True)),
            "trials": [{**asdict(one), "remark": one.remark.as_dict()} for one in found.trials],
        },
    )


def trial_row(trial: Trial) -> tuple[object, ...]:
    """Return one trial in the order of TRIALS."""
    plan, (ours, theirs) = trial.plan, trial.cost
    return (
        *(trial.number, plan.arrangement, plan.images, trial.points, trial.image_points, plan.planar),
        *(plan.visibility, plan.noise_px, plan.model, plan.cameras, plan.interior, plan.datum),
        *(ours, theirs, (theirs - ours) / ours if ours > 0 else math.nan, *trial.rms_px),
        *(" / ".join(map(str, trial.iterations)), *trial.iterations),
        *(" / ".join(fixed(one, 2) for one in trial.seconds), *trial.seconds),
        *(trial.interior_sigmas, trial.position_sigmas, trial.rotation_sigmas, trial.point_sigmas),
        *(trial.conditional_difference, trial.interior_difference, trial.marginal_over_conditional),
        *(ended(trial.remark.kind), trial.remark.kind, "; ".join(messages_of(trial))),
    )


def largest(validation: Validation) -> tuple[tuple[str, float, str], ...]:
    """Return what was compared, its largest difference over all networks (NaN: none), and its unit."""
    trials = validation.trials
    solved = [t for t in trials if t.remark.kind == "same_optimum"]
    costs = [abs(t.cost[1] - t.cost[0]) / min(t.cost) for t in solved if min(t.cost) > 0]
    return (
        ("cost", max(costs, default=math.nan), "relative"),
        ("free parameter of interior orientation", _max(t.interior_sigmas for t in solved), "sigma"),
        ("projection centre, per coordinate", _max(t.position_sigmas for t in solved), "sigma"),
        ("rotation", _max(t.rotation_sigmas for t in solved), "sigma"),
        ("object coordinate", _max(t.point_sigmas for t in solved), "sigma"),
        (
            "covariance of a point, cameras held (conditional)",
            _max(t.conditional_difference for t in trials),
            "relative",
        ),
        (
            "covariance of interior orientation (marginal)",
            _max(t.interior_difference for t in trials),
            "relative",
        ),
    )


def in_words(value: float, unit: str) -> str:
    """Write a largest difference with its unit, or that there is none."""
    return f"{value:.1e} {unit}" if math.isfinite(value) else "nothing to compare"


def verdict_of_validation(validation: Validation) -> Verdict:
    """Return the verdict, by the networks in which the adjusters do not end at the same optimum."""
    remarks = [trial.remark for trial in validation.trials if trial.remark.severity != "note"]
    count = len(validation.trials)
    headline = f"{count - len(remarks)} of {count} networks: both adjusters end at the same optimum."
    return judge(remarks, {"good": headline, "fair": headline, "bad": headline})


def ended(kind: str) -> str:
    """Return how two adjusters ended, in a few words."""
    return KINDS[kind].short


def messages_of(trial: Trial) -> tuple[str, ...]:
    """Return what the programs that failed report: in words, or names of what is not determined."""
    return (*trial.remark.names("message"), *trial.remark.names("their_message"))


def _known(values: Iterable[float]) -> Iterator[float]:
    return (value for value in values if math.isfinite(value))


def _max(values: Iterable[float]) -> float:
    return max(_known(values), default=math.nan)
