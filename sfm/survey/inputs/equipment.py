"""The equipment file (TOML) of many surveys: calibrated bars, scale crosses, frames and probes.

Lengths are corrected from the temperature of their calibration to that of the survey,

    l = l0 (1 + alpha (T - T0)),

and the uncertainty of T and alpha is part of their standard deviations. An error that N placements have in
common is multiplied by sqrt(N) for each of them. The scale that they give together then has the correct
error. Placements of one item share the error of its calibration. Items with the same expansion (a material)
share the error of the coefficient. All placements share the error of T.

Source: ISO 1 (reference temperature of 20 deg C); JCGM 100 (GUM), sec. 5.1 and annex H.1 (end gauges).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from pydantic import Field, ValidationError, model_validator

from sfm.files.csv_tables import CsvTable, array_table, read_table
from sfm.files.open_folders import path_inside
from sfm.files.plain_text import read_toml
from sfm.judgement.survey_result import PlacedEquipment
from sfm.model.conventions import METRES, FloatArray
from sfm.model.display import listed
from sfm.model.errors import SurveyFileError
from sfm.survey.inputs.given_values import ScaleBar
from sfm.survey.inputs.settings import (
    EquipmentSettings,
    Length,
    Name,
    Names,
    Section,
    Temperature,
    Unit,
    first_error,
)
from sfm.survey.observation_tables import ObservationTable, observation_table

FRAME = "rigid frame"  # kind of observation of frames
PPM = 1e-6
MIN_PPM = 1e-3  # no material has a smaller coefficient: the unit is wrong, as in 11.5e-6 for 11.5
COORDINATES = ("X", "Y", "Z", "sX", "sY", "sZ")


class CalibratedEquipment(Section):
    """Data of a bar or a frame besides its lengths."""

    name: Name  # name used in surveys
    calibrated: date  # date of its calibration, as on its certificate
    temperature: Temperature = 20.0  # of its calibration, to which its lengths refer, deg C
    expansion: Annotated[float, Field(ge=-50, le=200)]  # coefficient, 1e-6 per K: steel 11.5
    expansion_sigma: Annotated[float, Field(ge=0, le=50)] = (
        0.0  # standard deviation of the expansion, 1e-6 per K
    )

    @model_validator(mode="after")
    def _plausible(self) -> Self:
        if 0 < abs(self.expansion) < MIN_PPM:
            raise ValueError(f"expansion = {self.expansion:g}, needed in 1e-6 per K, such as 11.5 for steel")
        if self.calibrated > date.today():
            raise ValueError(f"calibrated = {self.calibrated}, which is in the future")
        return self

    def factor(self, temperature: float) -> float:
        """Return the factor of lengths at a temperature, deg C."""
        return 1 + PPM * self.expansion * (temperature - self.temperature)

    @property
    def material(self) -> tuple[float, float]:
        """Expansion and its standard deviation, which items of one material share."""
        return self.expansion, self.expansion_sigma


class Bar(CalibratedEquipment):
    """[[bar]]: a scale bar."""

    points: Annotated[Names, Field(max_length=2)] = ()  # names of its ends
    length: Length  # between its ends
    sigma: Length  # standard deviation of the length


class Frame(CalibratedEquipment):
    """[[frame]]: targets fixed to one another, on a bar with several targets, a scale cross or a probe."""

    file: Name  # point,X,Y,Z,sX,sY,sZ in a separate system, beside the equipment file


class EquipmentFile(Section):
    """Content of an equipment file."""

    unit: Unit  # of its lengths
    bars: Annotated[tuple[Bar, ...], Field(strict=False, alias="bar")] = ()
    frames: Annotated[tuple[Frame, ...], Field(strict=False, alias="frame")] = ()


@dataclass(frozen=True)
class Equipment:
    """An equipment file with its tables."""

    path: Path
    content: EquipmentFile
    tables: dict[str, CsvTable]  # tables of the frames by their names


@dataclass(frozen=True)
class GivenEquipment:
    """Observations of a survey from its equipment."""

    bars: tuple[ScaleBar, ...] = ()
    frames: tuple[ObservationTable, ...] = ()
    placed: tuple[PlacedEquipment, ...] = ()  # equipment of these observations


def read_equipment(path: Path, *, allow_outside: bool = False) -> Equipment:
    """Read an equipment file and the tables that it names.

    Args:
        path: path of the file.
        allow_outside: whether its tables may be outside its folder.

    Raises:
        SurveyFileError: the file is unreadable, or it has an unknown key, a wrong type, a value out of
            bounds, a calibration in the future, a duplicate name, or a table that is outside its folder or
            unreadable.
    """
    text, table = read_toml(path, "an equipment file", repeated=("bar", "frame"))
    try:
        content = EquipmentFile.model_validate(table)
    except ValidationError as error:
        raise SurveyFileError(first_error(path, text, error, EquipmentFile)) from error
    names = [item.name for item in (*content.bars, *content.frames)]
    for name in names:
        if names.count(name) > 1:
            raise SurveyFileError(f"{path}: '{name}' occurs twice; bars and frames need different names")
    tables = {}
    for frame in content.frames:
        file = path_inside(path.parent, frame.file, str(path), allow_outside=allow_outside)
        points = read_table(file, ("point",), COORDINATES)
        points.keys("point")
        tables[frame.name] = points
    return Equipment(path, content, tables)


def given_by(
    equipment: Equipment,
    used: Iterable[EquipmentSettings],
    where: str,
    unit: str,
    temperature: float | None,
    temperature_sigma: float,
) -> GivenEquipment:
    """Return the scale bars and rigid frames of a survey from its photographed equipment.

    Args:
        equipment: the bars and frames of the equipment file.
        used: equipment of the survey, each item as often as it was placed.
        where: survey file, for error messages.
        unit: object unit of the survey.
        temperature: temperature of the equipment during the survey, deg C.
        temperature_sigma: its standard deviation, K.

    Raises:
        SurveyFileError: no temperature, an unknown name, a wrong number of points, or an item placed twice on
            the same points.
    """
    used = tuple(used)
    if used and temperature is None:
        raise SurveyFileError(
            f"{where}: [[equipment]] needs survey.temperature, the temperature of {used[0].name} in deg C"
        )
    known = {item.name: item for item in (*equipment.content.bars, *equipment.content.frames)}
    scale = METRES[equipment.content.unit] / METRES[unit]
    for placement in used:
        if placement.name not in known:
            names = listed(list(known)) or "none"
            raise SurveyFileError(
                f"{where}: unknown equipment '{placement.name}', {equipment.path.name} has {names}"
            )
    items = [known[placement.name] for placement in used]
    of_item, of_material = Counter(item.name for item in items), Counter(item.material for item in items)
    bars, frames, placed, places_of = [], [], [], dict[str, list[frozenset[str]]]()
    for placement, item in zip(used, items, strict=True):
        assert temperature is not None
        own = item.points if isinstance(item, Bar) else equipment.tables[placement.name].texts[0]
        count = 2 if isinstance(item, Bar) else len(own)
        points = tuple(placement.points or own)
        if len(points) != count or len(set(points)) < count:
            raise SurveyFileError(
                f"{where}: equipment '{placement.name}': points = {listed(list(points)) or 'none'}, needed "
                f"{count} different names, in the order of the equipment file"
            )
        places = places_of.setdefault(placement.name, [])
        if frozenset(points) in places:
            raise SurveyFileError(
                f"{where}: equipment '{placement.name}' is given twice on the points "
                f"{listed(sorted(points))}, needed other points for each position"
            )
        places.append(frozenset(points))
        factor, calibration = scale * item.factor(temperature), scale * of_item[placement.name] ** 0.5
        relative = PPM * float(
            np.hypot(
                item.expansion * temperature_sigma * len(used) ** 0.5,
                (temperature - item.temperature) * item.expansion_sigma * of_material[item.material] ** 0.5,
            )
        )
        if isinstance(item, Bar):
            sigma = float(np.hypot(calibration * item.sigma, factor * item.length * relative))
            bars.append(ScaleBar(points[0], points[1], factor * item.length, sigma))
            given_as = f"scale bar {points[0]} - {points[1]}"
        else:
            group = placement.name if len(places) == 1 else f"{placement.name} {len(places)}"
            frames.append(
                _frame(group, points, equipment.tables[placement.name], factor, calibration, relative)
            )
            given_as = f"{FRAME} {group}"
        placed.append(
            PlacedEquipment(
                name=placement.name,
                given_as=given_as,
                calibrated=item.calibrated,
                calibration_temperature=item.temperature,
                expansion=item.expansion,
                expansion_sigma=item.expansion_sigma,
                temperature=temperature,
                temperature_sigma=temperature_sigma,
                correction=(item.factor(temperature) - 1) / PPM,
            )
        )
    return GivenEquipment(tuple(bars), tuple(frames), tuple(placed))


def _frame(
    group: str, points: Names, table: CsvTable, factor: float, calibration: float, relative: float
) -> ObservationTable:
    """Return a frame at one placement, with coordinates at the temperature of the survey.

    Coordinates are multiplied by `factor`, which has the relative sigma `relative`; their sigmas by
    `calibration`.
    """
    xyz, sigma = np.split(table.values, [3], axis=1)
    away: FloatArray = factor * np.abs(xyz - xyz.mean(axis=0))
    common = relative * np.sqrt((away > 0).sum()) * away  # together they give the scale the correct error
    values = np.hstack([factor * xyz, np.hypot(calibration * sigma, common)])
    columns = dict(zip(COORDINATES, values.T, strict=True))
    return observation_table(
        FRAME, array_table(str(table.path), {"group": [group] * len(points), "point": points}, columns)
    )
