"""A validation as validation.csv, validation.json and validation.html."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from sfm.comparison.solutions import SAME_SIGMAS
from sfm.comparison.two_adjusters.adjuster_validation import Trial, Validation
from sfm.files.plain_text import csv_text, or_none
from sfm.remarks.catalogue import KINDS
from sfm.remarks.verdict import Verdict, judge
from sfm.report.figures.comparisons import time_figure
from sfm.report.figures.plots import plot
from sfm.report.html.page import render
from sfm.report.page_files import write_files

FILES = ("validation.csv", "validation.json", "validation.html")
COLUMNS = (
    "network",
    "arrangement",
    "photographs",
    "points",
    "image_points",
    "planar",
    "visibility",
    "noise_px",
    "model",
    "cameras",
    "interior",
    "datum",
    "cost_kolinear_px2",
    "cost_other_px2",
    "rms_kolinear_px",
    "rms_other_px",
    "iterations_kolinear",
    "iterations_other",
    "seconds_kolinear",
    "seconds_other",
    "interior_over_sigma",
    "position_over_sigma",
    "rotation_over_sigma",
    "point_over_sigma",
    "conditional_covariance_difference",
    "interior_covariance_difference",
    "marginal_over_conditional_sigma",
    "ended",
    "message",
)
TIME_CAPTION = (
    "Seconds of adjustment on one thread. The other adjuster runs until its cost stands still, for the sake "
    "of the comparison; in everyday use it stops earlier."
)


def write_validation(validation: Validation, out: Path) -> Path:
    """Write a validation into a folder and return the path of its page.

    Raises:
        OutputError: the folder holds something else or cannot be written.
    """
    rows = [trial_row(trial) for trial in validation.trials]
    text = json.dumps(validation_summary(validation), indent=2, allow_nan=False)
    texts = (csv_text(COLUMNS, rows), text + "\n", validation_page(validation))
    return write_files(out, tuple(zip(FILES, texts, strict=True)), main=FILES[-1])


def trial_row(trial: Trial) -> tuple[object, ...]:
    """Return one trial in the order of COLUMNS."""
    plan = trial.plan
    return (
        *(trial.number, plan.arrangement, plan.images, trial.points, trial.image_points),
        *(int(plan.planar), plan.visibility, plan.noise_px, plan.model, plan.cameras, plan.interior),
        *(plan.datum, *trial.cost, *trial.rms_px, *trial.iterations, *trial.seconds),
        *(trial.interior_sigmas, trial.position_sigmas, trial.rotation_sigmas, trial.point_sigmas),
        *(trial.conditional_difference, trial.interior_difference, trial.marginal_over_conditional),
        *(trial.remark.kind, "; ".join(messages_of(trial))),
    )


def validation_summary(validation: Validation) -> dict[str, Any]:
    """Return what validation.json holds: plain values only, None for what is not known."""
    return {
        "backend": validation.backend,
        "seed": validation.seed,
        "networks": len(validation.trials),
        "passed": validation.passed,
        **verdict_of_validation(validation).as_dict(),
        "ended": dict(validation.counts()),
        "largest": {name: or_none(value) for name, value, _ in largest(validation)},
        "seconds": {
            "kolinear": or_none(sum(_known(t.seconds[0] for t in validation.trials))),
            validation.backend: or_none(sum(_known(t.seconds[1] for t in validation.trials))),
        },
        "trials": [
            {**_plain(asdict(trial)), "remark": trial.remark.as_dict()} for trial in validation.trials
        ],
    }


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


def validation_page(validation: Validation) -> str:
    """Return the page: how the adjusters ended, largest differences, time, and every network."""
    verdict = verdict_of_validation(validation)
    return render(
        "validation.html",
        v=validation,
        headline=verdict.headline,
        level=verdict.level,
        remarks=verdict.lines,
        same_sigmas=SAME_SIGMAS,
        ended=[(ended(kind), count) for kind, count in validation.counts()],
        networks=[(trial, ended(trial.remark.kind)) for trial in validation.trials],
        largest=[(name, in_words(value, unit)) for name, value, unit in largest(validation)],
        marginal_over_conditional=_median_ratio(validation),
        picture=plot("time", TIME_CAPTION, time_figure(validation)),
    )


def _median_ratio(validation: Validation) -> float:
    known = list(_known(t.marginal_over_conditional for t in validation.trials))
    return float(np.median(known)) if known else math.nan


def _known(values: Iterable[float]) -> Iterator[float]:
    return (value for value in values if math.isfinite(value))


def _max(values: Iterable[float]) -> float:
    return max(_known(values), default=math.nan)


def _plain(value: Any) -> Any:
    """Return a value with NaN as None and tuples as lists."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float | np.floating):
        return or_none(float(value))
    if isinstance(value, np.integer | np.bool_):
        return value.item()
    return value
