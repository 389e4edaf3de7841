"""The orientation of a survey, and what its person must know where there is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sfm.errors import GeometryError
from sfm.network import Estimate, Network
from sfm.orientation.sequence import MIN_POINTS, Orientation, orient
from sfm.photographs.reading import read_photograph
from sfm.survey.inputs.start import PhotographList, approximate_values
from sfm.survey.inputs.survey_file import Survey
from sfm.survey.solution import refine
from sfm.survey.targets import MeasuredPhotographs
from sfm.targets.codes.rings import RINGS
from sfm.targets.detect import find_targets


def orient_photographs(
    survey: Survey, network: Network, files: PhotographList, photographs: MeasuredPhotographs
) -> Orientation:
    """Return approximate values of a network of measured targets.

    Args:
        survey: gives approximate values, if any; a failure names its settings.
        network: all targets that have a name.
        files: all photographs of the survey.
        photographs: those that the targets were measured in.

    Raises:
        GeometryError: no two photographs could be oriented.
        SurveyFileError: [approximate] names photographs that are none of the survey's.
    """
    estimate = approximate_values(survey, network, photographs.cameras, files.names)
    try:
        return orient_survey(survey, network, estimate)
    except GeometryError as error:
        if _most_in_common(network) >= MIN_POINTS:
            raise
        raise GeometryError(f"survey {survey.name}: {_codes_found(survey, photographs)}") from error


def orient_survey(survey: Survey, network: Network, estimate: Estimate) -> Orientation:
    """Return approximate values of a survey's network.

    Args:
        survey: says whether approximate values were given.
        network: all image points that have a name.
        estimate: cameras, and what [approximate] and the control tell.

    Raises:
        GeometryError: no two photographs could be oriented.
    """
    try:
        found = orient(network, estimate, refine=refine)
    except GeometryError as error:
        given = survey.approximate.images is not None or survey.approximate.points is not None
        hint = " (correct or complete [approximate], or leave it out)" if given else ""
        raise GeometryError(f"survey {survey.name}: {error}{hint}") from error
    return replace(found, warnings=tuple(f"[approximate]: {line}" for line in found.warnings))


def _most_in_common(network: Network) -> int:
    """Return how many points the two photographs with most in common share."""
    common = network.common_points(np.ones(len(network.image_points), dtype=bool))
    np.fill_diagonal(common, 0)
    return int(common.max(initial=0))


def _codes_found(survey: Survey, photographs: MeasuredPhotographs) -> str:
    """Say how many targets and codes were found where more codes were needed, and what decides on that."""
    targets = [len(found) for found in photographs.targets]
    codes = [int((found.code >= 0).sum()) for found in photographs.targets]
    with_codes = sum(count > 0 for count in codes)
    settings = survey.targets
    other = _other_family(survey, photographs)
    return (
        f"no two photographs have {MIN_POINTS} coded targets in common, which their orientation needs: "
        f"{sum(targets)} targets were found in {len(targets)} photographs, {sum(codes)} codes were read in "
        f"{with_codes} of them; check in [targets] codes = '{settings.codes}', "
        f"polarity = '{settings.polarity}' and min_diameter_px = {settings.min_diameter_px:g}{other}"
    )


def _other_family(survey: Survey, photographs: MeasuredPhotographs) -> str:
    """Say which other rings or arcs read more in the photograph with most targets, if any do."""
    settings = survey.targets
    if settings.codes not in (*RINGS, "none"):
        return ""
    fullest = int(np.argmax([len(found) for found in photographs.targets]))
    photograph = read_photograph(photographs.paths[fullest], channel=settings.channel)
    counts = []
    for family in RINGS:
        if family == settings.codes:
            continue
        found = find_targets(
            photograph,
            polarity=settings.polarity,
            codes=family,
            min_diameter_px=settings.min_diameter_px,
        )
        counts.append((len(np.unique(found.code[found.code >= 0])), family))
    most, best = max(counts)
    own = photographs.targets[fullest].code
    if most < MIN_POINTS or most <= len(np.unique(own[own >= 0])):
        return ""
    return f"; in {photographs.names[fullest]} codes = '{best}' reads {most} codes"
