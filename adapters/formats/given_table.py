"""Given values of a survey with standard deviations, read from and written to given.csv of its result."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from sfm.conventions import FloatArray
from sfm.files.json_files import Content, read_json
from sfm.files.result_tables import GIVEN
from sfm.given_residuals import given_residuals, given_rows
from sfm.network import Estimate, ExteriorObservations, Network, ObjectPoints, ScaleBars
from sfm.solution import CONTROL_COVARIANCE

ORIENTATION = ("X0", "Y0", "Z0", "omega", "phi", "kappa")
PAIRS = ("XY", "XZ", "YZ")  # of correlated coordinates


class Statistics(Content):
    """Unit of weight as summary.json states it."""

    sigma0: Annotated[float, Field(gt=0, lt=1e9)] | None = None
    sigma0_px: Annotated[float, Field(gt=0, lt=1e9)] | None = None


@dataclass(frozen=True)
class GivenValues:
    """Given values of a survey with standard deviations, and those that took part."""

    bars: ScaleBars
    control: ObjectPoints
    interior: tuple[tuple[str, str, float, float], ...]  # camera, parameter, value, sigma
    exterior: ExteriorObservations = field(default_factory=ExteriorObservations)
    sigma0: float = 1.0  # of unit weight, by which the covariance of the result is scaled
    sigma0_px: float | None = None  # a posteriori of an image coordinate, the median; None where not known


def read_given(folder: Path, network: Network) -> GivenValues:
    """Read what the survey of a result was given with a standard deviation, from given.csv.

    Args:
        folder: of the result.
        network: what `read_result` has read of it.

    Raises:
        SurveyFileError: what is missing or wrong, with file and line number.
    """
    path = folder / GIVEN.file
    summary = read_json(folder / "summary.json", Statistics, "the summary of a result")
    if not path.is_file() or not path.read_text(encoding="utf-8").strip().partition("\n")[2]:
        return GivenValues(
            *(ScaleBars(), ObjectPoints(), (), ExteriorObservations()),
            *(summary.sigma0 or 1.0, summary.sigma0_px),
        )
    table = GIVEN.read(folder)
    table.refuse(table.values[:, 1:], table.values[:, 1:] < 0, ("sigma",), "0 or more, or nothing")
    index = {name: j for j, name in enumerate(network.points)}
    bars: list[tuple[int, int, float, float]] = []
    control: dict[int, tuple[FloatArray, FloatArray]] = {}
    interior = []
    image = {name: i for i, name in enumerate(network.images)}
    exterior: dict[int, tuple[FloatArray, FloatArray]] = {}
    for kind, name, coordinate, (given, sigma) in zip(*table.texts, table.values.tolist(), strict=True):
        if kind == "scale bar":
            ends = _ends(name, index)
            if ends is not None:
                bars.append((*ends, given, sigma))
        elif kind == "control point" and name in index and coordinate in ("X", "Y", "Z"):
            xyz, C = control.setdefault(index[name], (np.zeros(3), np.diag(np.full(3, np.inf))))
            k = "XYZ".index(coordinate)
            xyz[k], C[k, k] = given, sigma**2 if np.isfinite(sigma) else np.inf
        elif kind == CONTROL_COVARIANCE and index.get(name) in control and coordinate in PAIRS:
            C, (row, column) = control[index[name]][1], map("XYZ".index, coordinate)
            C[row, column] = C[column, row] = given
        elif kind == "interior orientation":
            parameter, _, camera = name.partition(" of camera ")
            interior.append((camera, parameter, given, sigma))
        elif kind in ("projection centre", "rotation") and name in image and coordinate in ORIENTATION:
            value, variance = exterior.setdefault(image[name], (np.zeros(6), np.full(6, np.inf)))
            k = ORIENTATION.index(coordinate)
            factor = 1.0 if k < 3 else np.radians(1.0)
            value[k], variance[k] = factor * given, (factor * sigma) ** 2
    rows = np.array(bars, dtype=float).reshape(-1, 4)
    return GivenValues(
        ScaleBars(rows[:, 0].astype(np.int64), rows[:, 1].astype(np.int64), rows[:, 2], rows[:, 3]),
        ObjectPoints(
            np.array(list(control), dtype=np.int64),
            np.array([xyz for xyz, _ in control.values()]).reshape(-1, 3),
            np.array([C for _, C in control.values()]).reshape(-1, 3, 3),
        ),
        tuple(interior),
        ExteriorObservations(
            np.array(list(exterior), dtype=np.int64),
            np.array([value[:3] for value, _ in exterior.values()]).reshape(-1, 3),
            np.array([value[3:] for value, _ in exterior.values()]).reshape(-1, 3),
            np.array([np.diag(variance) for _, variance in exterior.values()]).reshape(-1, 6, 6),
        ),
        summary.sigma0 or 1.0,
        summary.sigma0_px,
    )


def write_given(folder: Path, network: Network, estimate: Estimate, unit: str) -> None:
    """Write what a network was given with a standard deviation, without tests; no file of nothing."""
    kinds = [kind for _, kind in given_residuals(network, estimate, unit)]
    rows = list(given_rows(kinds, network, unit))
    if rows:
        GIVEN.write_rows(folder, rows)


def _ends(name: str, index: dict[str, int]) -> tuple[int, int] | None:
    """Return the points of the bar `A - B`, whose names may hold dashes; None where one is not there."""
    words = name.split(" - ")
    for k in range(1, len(words)):
        first, second = " - ".join(words[:k]), " - ".join(words[k:])
        if first in index and second in index:
            return index[first], index[second]
    return None
