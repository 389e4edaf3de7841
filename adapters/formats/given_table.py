"""What a survey was given with a standard deviation, read from given.csv of its result.

    kind,name,coordinate,unit,given,difference,sigma,r,w

Source: RFC 4180 for CSV; the columns are described in the README.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from sfm.conventions import FloatArray
from sfm.files.csv_tables import read_table
from sfm.files.json_files import Content, read_json
from sfm.network import Network, ObjectPoints, ScaleBars


class _Summary(Content):
    """What is read of summary.json."""

    sigma0: Annotated[float, Field(gt=0, lt=1e9)] | None = None
    sigma0_px: Annotated[float, Field(gt=0, lt=1e9)] | None = None


@dataclass(frozen=True)
class GivenValues:
    """What a survey was given with a standard deviation, and what took part."""

    bars: ScaleBars
    control: ObjectPoints
    interior: tuple[tuple[str, str, float, float], ...]  # camera, parameter, value, sigma
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
    path = folder / "given.csv"
    summary = read_json(folder / "summary.json", _Summary, "the summary of a result")
    if not path.is_file() or not path.read_text(encoding="utf-8").strip().partition("\n")[2]:
        return GivenValues(ScaleBars(), ObjectPoints(), (), summary.sigma0 or 1.0, summary.sigma0_px)
    table = read_table(
        path, ("kind", "name", "coordinate"), ("given", "sigma"), ignored=None, blank=("sigma",)
    )
    table.refuse(table.values[:, 1:], table.values[:, 1:] < 0, ("sigma",), "0 or more, or nothing")
    index = {name: j for j, name in enumerate(network.points)}
    bars: list[tuple[int, int, float, float]] = []
    control: dict[int, tuple[FloatArray, FloatArray]] = {}
    interior = []
    for kind, name, coordinate, (given, sigma) in zip(*table.texts, table.values.tolist(), strict=True):
        if kind == "scale bar":
            ends = _ends(name, index)
            if ends is not None:
                bars.append((*ends, given, sigma))
        elif kind == "control point" and name in index and coordinate in ("X", "Y", "Z"):
            xyz, variance = control.setdefault(index[name], (np.zeros(3), np.full(3, np.inf)))
            k = "XYZ".index(coordinate)
            xyz[k], variance[k] = given, sigma**2 if np.isfinite(sigma) else np.inf
        elif kind == "interior orientation":
            parameter, _, camera = name.partition(" of camera ")
            interior.append((camera, parameter, given, sigma))
    rows = np.array(bars, dtype=float).reshape(-1, 4)
    return GivenValues(
        ScaleBars(rows[:, 0].astype(np.int64), rows[:, 1].astype(np.int64), rows[:, 2], rows[:, 3]),
        ObjectPoints(
            np.array(list(control), dtype=np.int64),
            np.array([xyz for xyz, _ in control.values()]).reshape(-1, 3),
            np.array([np.diag(variance) for _, variance in control.values()]).reshape(-1, 3, 3),
        ),
        tuple(interior),
        summary.sigma0 or 1.0,
        summary.sigma0_px,
    )


def _ends(name: str, index: dict[str, int]) -> tuple[int, int] | None:
    """Return the points of the bar `A - B`, whose names may hold dashes; None where one is not there."""
    words = name.split(" - ")
    for k in range(1, len(words)):
        first, second = " - ".join(words[:k]), " - ".join(words[k:])
        if first in index and second in index:
            return index[first], index[second]
    return None
