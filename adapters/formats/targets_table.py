"""Targets measured and candidates rejected in the photographs, read from targets.csv of a result."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sfm.errors import SurveyFileError
from sfm.files.result_tables import TARGETS
from sfm.network import Network
from sfm.solution import MEASURED, SeenTargets


def read_targets(folder: Path, network: Network) -> SeenTargets | None:
    """Read the targets and rejected candidates of a result; None where it has no such table.

    Args:
        folder: of the result.
        network: what `read_result` has read of it.

    Raises:
        SurveyFileError: what is wrong, with file and line number.
    """
    path = folder / TARGETS.file
    if not path.is_file():
        return None
    table = TARGETS.read(folder)
    index = {name: i for i, name in enumerate(network.images)}
    images, reasons = table.texts
    for line, name in zip(table.line, images, strict=True):
        if name not in index:
            raise SurveyFileError(f"{path}, line {line}: image '{name}' is not in images.csv")
    axes = table.values[:, 2:4]
    table.refuse(axes, axes <= 0, ("a_px", "b_px"), "more than 0, or nothing")
    ellipse = np.column_stack([axes, np.deg2rad(table.values[:, 4])])
    for line, reason, outline in zip(table.line, reasons, ellipse, strict=True):
        if reason == MEASURED and not np.isfinite(outline).all():
            raise SurveyFileError(f"{path}, line {line}: a measured target without a_px, b_px and angle_deg")
    return SeenTargets(
        np.array([index[name] for name in images], dtype=np.int64),
        table.values[:, :2].copy(),
        ellipse,
        tuple("" if reason == MEASURED else reason for reason in reasons),
    )
