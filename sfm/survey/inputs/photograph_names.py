"""Names of photographs in what a survey gives, as those of its files.

A text means a photograph of the survey if it is its name, its name without folders if no other photograph
has that, another spelling of its path (`./a.jpg`), or one of these in other letter case if only one fits.

The photographs of a survey are its files. A table of image points may bring more, those that the globs of a
camera match. A list of ground control brings none: it is of a whole flight, of which the survey may be a
part.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path, PurePosixPath
from typing import TypeVar

import numpy as np

from sfm.files.open_folders import path_inside
from sfm.model.display import listed
from sfm.model.errors import SurveyFileError
from sfm.model.remarks.remark import Remark, remark
from sfm.photographs.exif import read_metadata
from sfm.survey.inputs.cameras import cameras_of_images
from sfm.survey.inputs.exterior_table import ObservedExterior
from sfm.survey.inputs.given_values import Observations, StartOrientations
from sfm.survey.inputs.measurements import PhotographList
from sfm.survey.inputs.settings import PointSettings
from sfm.survey.inputs.sources import given_tables, with_each_table
from sfm.survey.inputs.survey import Survey

T = TypeVar("T", ObservedExterior, StartOrientations)


@dataclass(frozen=True)
class NamedPhotographs:
    """A survey that names its photographs as their files are named."""

    survey: Survey
    unmarked: frozenset[str] = frozenset()  # points that are marked only in photographs that are left out
    remarks: tuple[Remark, ...] = ()  # on photographs without a file

    def without_unmarked(self, survey: Survey, points: Sequence[str]) -> Survey:
        """Return a survey without control that is marked in none of its photographs, and not measured.

        Args:
            survey: the survey, once it is measured.
            points: names of its measured points.
        """
        lost = self.unmarked.difference(points)
        if survey.control is None or not lost:
            return survey
        kept = survey.control.select(np.array([name not in lost for name in survey.control.names]))
        return survey if not kept.names or kept.only_checks else replace(survey, control=kept)


def name_photographs(survey: Survey, files: PhotographList) -> NamedPhotographs:
    """Return a survey with the names that the files of its photographs have.

    Args:
        survey: its tables of image points, orientations and moments, and its named points, name photographs.
        files: all its photographs.

    Raises:
        SurveyFileError: no photograph of a table is one of the survey, a table of orientations or moments
            names one twice, or that of a named point is neither here nor a file of an earlier epoch, or does
            not show its place.
        PhotographError: a photograph of an earlier epoch cannot be read.
    """
    name_of = _names_by_text(files, survey.folder)
    marks = tuple(mark.model_copy(update={"image": name_of(mark.image)}) for mark in survey.marks)
    known = frozenset(files.names)
    for mark in marks:
        if mark.image not in known:
            _refuse_no_template(mark, survey)
    named = with_each_table(survey, lambda table: replace(table, image=tuple(map(name_of, table.image))))
    given = given_tables(named)
    without_file = dict.fromkeys(name for table in given for name in table.image if name not in known)
    of_survey = with_each_table(named, lambda table: _of_survey(table, survey, files))
    exterior = _renamed(survey.exterior, name_of)
    orientations = _renamed(survey.start_orientations, name_of)
    moments: dict[str, str] = {}
    for text, moment in survey.moments.items():
        name = name_of(text)
        before = moments.setdefault(name, moment)
        if before != moment:
            raise SurveyFileError(
                f"{survey.source}: photograph '{name}' has the moments '{before}' and '{moment}', needed one"
            )
    survey = replace(
        of_survey,
        marks=marks,
        refused=tuple(replace(mark, photograph=name_of(mark.photograph)) for mark in survey.refused),
        marked_hashes={name_of(name): value for name, value in survey.marked_hashes.items()},
        exterior=exterior,
        start_orientations=orientations,
        moments=moments,
    )
    if not without_file:
        return NamedPhotographs(survey)
    marked = {name for table in given_tables(survey) for name in table.point}
    unmarked = dict.fromkeys(name for table in given for name in table.point if name not in marked)
    said = remark("photographs_without_file", photographs=without_file, points=unmarked or None)
    return NamedPhotographs(survey, frozenset(unmarked), (said,))


def _refuse_no_template(mark: PointSettings, survey: Survey) -> None:
    """Raise SurveyFileError unless a mark is in a photograph of an earlier epoch."""
    path = path_inside(survey.folder, mark.image, survey.source, allow_outside=survey.allow_outside)
    if not path.is_file():
        raise SurveyFileError(
            f"{survey.source}: point '{mark.name}' is named in '{mark.image}', which is neither a "
            "photograph of the survey nor a file of an earlier epoch"
        )
    width, height = read_metadata(path).size_px
    if not (0 <= mark.x_px < width and 0 <= mark.y_px < height):
        raise SurveyFileError(
            f"{survey.source}: point '{mark.name}' is at {mark.x_px:g}, {mark.y_px:g} px, outside "
            f"{mark.image} of {width} x {height} px"
        )


def _of_survey(table: Observations, survey: Survey, files: PhotographList) -> Observations:
    """Return the image points of a table in photographs of the survey."""
    named = set(files.names)
    if not table.of_control:
        without_file = [name for name in dict.fromkeys(table.image) if name not in named]
        cameras = cameras_of_images(survey.cameras, without_file)
        named |= {name for name, of_name in zip(without_file, cameras, strict=True) if of_name}
    kept = np.array([name in named for name in table.image])
    if not kept.any():
        names, others = (listed(dict.fromkeys(images), most=1) for images in (table.image, files.names))
        raise SurveyFileError(
            f"{table.table.path}: none of its photographs ({names}) is among those of the survey ({others})"
        )
    return table if kept.all() else table.select(kept)


def _renamed(given: T | None, name_of: Callable[[str], str]) -> T | None:
    """Return orientations with the names of their files."""
    if given is None:
        return None
    names = tuple(map(name_of, given.names))
    given.table.refuse_duplicates(names, ("image",))
    return replace(given, names=names)


def _names_by_text(files: PhotographList, folder: Path) -> Callable[[str], str]:
    """Return a function for the name of the photograph that a text means; the text if it means none.

    folder: that of the survey, to which paths are relative, as they are to that of the photographs.
    """
    short = [PurePosixPath(name).name for name in files.names]
    once = {name for name, times in Counter(short).items() if times == 1}
    exact = {name: full for name, full in zip(short, files.names, strict=True) if name in once}
    exact |= {name: name for name in files.names}
    names_in_case: dict[str, set[str]] = {}
    for text, name in exact.items():
        names_in_case.setdefault(text.casefold(), set()).add(name)

    @cache
    def by_path() -> dict[str, str]:
        return {os.path.realpath(path): name for path, name in zip(files.paths, files.names, strict=True)}

    @cache
    def name_of(text: str) -> str:
        if text in exact:
            return exact[text]
        for base in (files.folder, folder):
            path = os.path.realpath(base / text.replace("\\", "/"))
            if path in by_path():
                return by_path()[path]
        in_case = names_in_case.get(text.casefold(), set())
        return next(iter(in_case)) if len(in_case) == 1 else text

    return name_of
