"""Interior orientation of an earlier result: held in another survey, or an observation in it.

    summary.json                model, size and pixel of each camera
    cameras.csv                 camera,parameter,value,sigma of each parameter; without sigma it was held
    interior_correlations.csv   camera,first,second,correlation of those that were adjusted

As an observation it counts with the full covariance of its parameters, so that a calibration and a survey
adjusted one after the other give what both give adjusted together, as far as they share nothing else.

Source: Mikhail, Bethel and McGlone, Modern Photogrammetry (2001), sec. 5.6 (a priori parameter constraints).
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from sfm.camera import Camera
from sfm.distortion.models import MODELS
from sfm.errors import SurveyFileError
from sfm.files.csv_tables import read_table
from sfm.files.plain_text import Content, Name, Pixel, Side, read_json
from sfm.survey.inputs.settings import CameraSettings

TABLES = ("summary.json", "cameras.csv", "interior_correlations.csv")


@dataclass(frozen=True)
class Calibration:
    """The interior orientation of one camera of a result."""

    name: str
    model: str
    size_px: tuple[int, int]
    pixel_mm: tuple[float, float]
    values: dict[str, float]  # of all parameters of the model, in its units
    sigma: dict[str, float] = field(default_factory=dict)  # of those that were adjusted
    correlations: tuple[tuple[str, str, float], ...] = ()  # of pairs of these

    @classmethod
    def of_camera(cls, camera: Camera) -> Calibration:
        """Return that of a camera, as far as a camera has one: without standard deviations."""
        sides = (float(camera.pixel_mm[0]), float(camera.pixel_mm[1]))
        values = dict(zip(camera.names, camera.parameters.tolist(), strict=True))
        return cls(camera.name, camera.model, camera.size_px, sides, values)


class _Camera(Content):
    """A camera in the summary of a result."""

    name: Name
    model: Literal[tuple(MODELS)]  # type: ignore[valid-type]
    size_px: tuple[Side, Side]
    pixel_mm: tuple[Pixel, Pixel]


class _Summary(Content):
    """The part of summary.json that is read."""

    cameras: Annotated[tuple[_Camera, ...], Field(min_length=1)]


def read_calibrations(folder: Path) -> tuple[Calibration, ...]:
    """Read the interior orientations of the folder of a result.

    Raises:
        SurveyFileError: what is missing or wrong, with file and line number.
    """
    summary = read_json(folder / "summary.json", _Summary, "the summary of a result")
    table = read_table(
        folder / "cameras.csv", ("camera", "parameter"), ("value", "sigma"), ignored=None, blank=("sigma",)
    )
    keys = tuple(zip(*table.texts, strict=True))
    table.refuse_duplicates(keys, ("camera", "parameter"))
    sigma = table.values[:, 1:2]
    table.refuse(sigma, sigma < 0, ("sigma",), "0 or more, or nothing")
    rows = dict(zip(keys, table.values.tolist(), strict=True))
    path = folder / "interior_correlations.csv"
    correlations: dict[str, list[tuple[str, str, float]]] = {}
    adjusted_of = Counter(camera for (camera, _), (_, s) in rows.items() if np.isfinite(s) and s > 0)
    if path.is_file() and max(adjusted_of.values(), default=0) > 1:
        pairs = read_table(path, ("camera", "first", "second"), ("correlation",), blank=("correlation",))
        rho = pairs.values[:, :1]
        pairs.refuse(rho, np.abs(rho) > 1, ("correlation",), "from -1 to 1")
        for camera, first, second, value in zip(*pairs.texts, rho[:, 0].tolist(), strict=True):
            correlations.setdefault(camera, []).append((first, second, value))
    found = []
    for one in summary.cameras:
        missing = [name for name in MODELS[one.model].names if (one.name, name) not in rows]
        if missing:
            raise SurveyFileError(
                f"{table.path}: camera {one.name} has no {', '.join(missing)}, model {one.model} needs it"
            )
        of_camera = {name: rows[one.name, name] for name in MODELS[one.model].names}
        adjusted = {name: s for name, (_, s) in of_camera.items() if np.isfinite(s) and s > 0}
        found.append(
            Calibration(
                *(one.name, one.model, one.size_px, one.pixel_mm),
                {name: value for name, (value, _) in of_camera.items()},
                adjusted,
                tuple(
                    (p, q, value)
                    for p, q, value in correlations.get(one.name, ())
                    if p in adjusted and q in adjusted and np.isfinite(value)
                ),
            )
        )
    return tuple(found)


def calibrated(
    settings: CameraSettings,
    calibrations: tuple[Calibration, ...],
    where: str,
    source: str,
    *,
    weighted: bool = False,
) -> CameraSettings:
    """Return the settings of one camera, held at a calibration or with it as an observation.

    The camera takes that of its name; if the calibration has one camera only, it takes that one.

    Args:
        settings: of the camera; besides name and photographs nothing of them is used.
        calibrations: of an earlier result.
        where: what messages call the survey.
        source: what they call that result.
        weighted: adjusted, with the calibration and its covariance as an observation; else held.

    Raises:
        SurveyFileError: no camera of that name among several, photographs of another size, or no standard
            deviations to weight by.
    """
    named = [one for one in calibrations if one.name == settings.name]
    if not named and len(calibrations) > 1:
        raise SurveyFileError(
            f"{where}: camera {settings.name} is not in {source}, expected one of "
            f"{', '.join(one.name for one in calibrations)}"
        )
    found = (named or list(calibrations))[0]
    if settings.size_px is not None and settings.size_px != found.size_px:
        raise SurveyFileError(
            f"{where}: camera {settings.name} has {settings.size_px[0]} x {settings.size_px[1]} px, "
            f"{found.name} of {source} {found.size_px[0]} x {found.size_px[1]} px"
        )
    if weighted and not found.sigma:
        raise SurveyFileError(
            f"{where}: {source} has no standard deviations of camera {found.name}, so that it can be "
            "held but not weighted"
        )
    observed = found.sigma if weighted else {}
    return CameraSettings(
        name=settings.name,
        images=settings.images,
        size_px=found.size_px,
        pixel_mm=found.pixel_mm,
        model=found.model,
        free=(),
        fixed=tuple((name, value) for name, value in found.values.items() if name not in observed),
        weighted=tuple((name, (found.values[name], sigma)) for name, sigma in observed.items()),
        correlations=found.correlations if weighted else (),
    )
