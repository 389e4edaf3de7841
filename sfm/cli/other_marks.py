"""Marks of other programs, read into a marks file and written from one.

    .json   OpenSfM's ground_control_points.json
    .txt    OpenDroneMap's gcp_list.txt, written from an earlier one, whose projection and coordinates stay
    .xml    Metashape: markers with their image points
    .db     COLMAP: key points with a match

Names of points and photographs stay. Where a program states no standard deviation, that of pointing by
hand is assumed. Coordinates of points are read as control.

Source: documentation of OpenSfM, OpenDroneMap and Metashape, "Ground Control Points" and "Markers".
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from adapters.formats.registry import ENDINGS, format_named, read_any, write_any
from sfm.comparison.camera_conversion import convert_cameras
from sfm.files.plain_text import read_json
from sfm.files.whole_files import whole_file
from sfm.model.conventions import FloatArray, pixel_from_longer_side
from sfm.model.display import counted, listed
from sfm.model.errors import OutputError, SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.survey.inputs.ground_control import COORDINATES, READERS, OpenSfmPoints, read_ground_control
from sfm.survey.inputs.marks_file import Mark, Marking, StatedPoint, now
from sfm.survey.inputs.settings import ControlSettings

SIGMA_PX = 1.0  # of pointing by hand
PLACES = 12  # decimals of a part of the longer side: a millionth of a millionth of a photograph
MAX_MARKS = 20_000  # more are no marks, but the image points of a survey
READ = (*READERS, *ENDINGS)
WRITTEN = (".json", ".txt", ".xml", ".db")


def read_marks_of_others(
    path: Path, photographs: Sequence[str], sizes: Sequence[tuple[int, int]], unit: str
) -> Marking:
    """Return the marks of another program, by hand, with the control that it states.

    Args:
        path: the file; its ending states the format.
        photographs: names of the photographs that are marked.
        sizes: their widths and heights, px.
        unit: object unit of the control.

    Raises:
        SurveyFileError: an unknown ending, an unreadable file, no mark in these photographs, one outside its
            photograph, or too many.
    """
    ending, size_of = path.suffix.lower(), dict(zip(photographs, sizes, strict=True))
    marking, control = Marking(), dict[str, StatedPoint]()
    if ending in READERS:
        seen = READERS[ending](path)
        if seen.xyz:
            points = read_ground_control(path, ControlSettings(file=path.name), unit).points
            known = [bool(np.isfinite(xyz).all()) for xyz in points.xyz]
            control = _stated(points.names, points.xyz, points.sigma, known)
        rows = []
        for image, point, xy in zip(seen.image, seen.point, seen.xy, strict=True):
            place = np.array([xy], dtype=float)
            if seen.unit != "px" and image in size_of:  # parts of the longer side from the middle
                place = pixel_from_longer_side(place, np.array([size_of[image]], dtype=float))
            rows.append((image, point, float(place[0, 0]), float(place[0, 1]), SIGMA_PX**2 * np.eye(2)))
    elif ending in (".xml", ".db"):
        network, _ = read_any(path, ENDINGS[ending])
        given = network.control.complete
        control = _stated(
            [network.points[j] for j in given.point],
            given.xyz,
            np.sqrt(np.diagonal(given.covariance, axis1=1, axis2=2)),
        )
        of = network.image_points
        rows = [
            (network.images[i], network.points[j], float(xy[0]), float(xy[1]), C)
            for i, j, xy, C in zip(of.image.tolist(), of.point.tolist(), of.xy, of.covariance, strict=True)
        ]
    else:
        raise SurveyFileError(f"{path}: unknown ending '{ending}', expected {listed(sorted(set(READ)))}")
    here = [row for row in rows if row[0] in size_of]
    if not here:
        raise SurveyFileError(
            f"{path}: of {counted(len(rows), 'image point')} none is in these photographs, expected names as "
            f"{photographs[0]}"
        )
    if len(here) > MAX_MARKS:
        raise SurveyFileError(
            f"{path}: {counted(len(here), 'image point')}, at most {MAX_MARKS} are taken as marks"
        )
    when = now()
    for image, point, x, y, C in here:
        width, height = size_of[image]
        if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
            raise SurveyFileError(
                f"{path}: '{point}' in {image} is at {x:.1f}, {y:.1f} px, outside the photograph of {width} "
                f"x {height} px; it is of another size there"
            )
        mark = Mark(
            image, point, x, y, float(C[0, 0]), float(C[0, 1]), float(C[1, 1]), "hand", "hand", when=when
        )
        marking = replace(marking, marks={**marking.marks, mark.key: mark})
    return replace(marking, control=control)


def _stated(
    names: Sequence[str], xyz: FloatArray, sigma: FloatArray, known: Sequence[bool] | None = None
) -> dict[str, StatedPoint]:
    kept = [True] * len(names) if known is None else known
    return {
        name: StatedPoint((place[0], place[1], place[2]), (s[0], s[1], s[2]))
        for name, place, s, keep in zip(names, xyz.tolist(), sigma.tolist(), kept, strict=True)
        if keep
    }


def write_marks_of_others(
    path: Path,
    network: Network,
    estimate: Estimate,
    *,
    ground_control: Path | None = None,
) -> int:
    """Write marks for another program.

    Args:
        path: the new file; its ending states the format.
        network: the marks, with control.
        estimate: cameras, and what is oriented.
        ground_control: a file of the same format whose positions and further points stay; for .json, and
            needed for .txt.

    Returns:
        Number of marks in the file.

    Raises:
        OutputError: the file exists or cannot be written, or no such format is written.
        SurveyFileError: the file of ground control cannot be read.
    """
    ending = path.suffix.lower()
    if ending not in WRITTEN:
        raise OutputError(f"{path}: marks are written as {listed(WRITTEN)}, not as '{ending}'")
    count = len(network.image_points)
    if ending in READERS:
        if ending == ".json":
            text = json.dumps(_opensfm(network, estimate, ground_control), indent=4) + "\n"
        elif ground_control is None:
            raise OutputError(
                f"{path}: states coordinates in a projection, --import names the file that has it"
            )
        else:
            text, count = _gcp_list(network, ground_control)
        with whole_file(path, "the ground control") as part:
            part.write_text(text, encoding="utf-8")
        return count
    form = format_named(ENDINGS[ending])
    converted = convert_cameras(estimate, form.models, held=form.lacks)[0] if form.models else estimate
    write_any(path, form.name, network, converted)
    return count


def _gcp_list(network: Network, before: Path) -> tuple[str, int]:
    """Return marks as a gcp_list.txt, and how many; only points that the earlier file has are there.

    Lines whose mark is as before stay as they are.
    """
    earlier, lines = READERS[".txt"](before), before.read_text("utf-8-sig").splitlines()
    seen = network.image_points
    own = {
        (network.images[i], network.points[j]): f"{x:.4f} {y:.4f}"
        for i, j, (x, y) in zip(seen.image.tolist(), seen.point.tolist(), seen.xy.tolist(), strict=True)
        if network.points[j] in earlier.xyz
    }
    count, here = len(own), set(network.images)
    first = dict[str, tuple[str, str]]()  # coordinates of each point, and its name if it has one
    written = dict(enumerate(lines, 1))
    for image, point, xy, number in zip(
        earlier.image, earlier.point, earlier.xy, earlier.image_line, strict=True
    ):
        *fields, names = written[number].split(None, COORDINATES)
        name = names.partition(image)[2]
        first.setdefault(point, (" ".join(fields[:3]), name))
        place = own.pop((image, point), None)
        if place is None and image in here:
            del written[number]
        elif place not in (None, f"{xy[0]:.4f} {xy[1]:.4f}"):
            written[number] = f"{' '.join(fields[:3])} {place} {names}"
    new = [f"{first[point][0]} {place} {image}{first[point][1]}" for (image, point), place in own.items()]
    return "\n".join([*written.values(), *new]) + "\n", count


def _opensfm(network: Network, estimate: Estimate, ground_control: Path | None) -> dict[str, Any]:
    """Return marks as OpenSfM states them; points and image points keep the order of an earlier file."""
    seen, marked = network.image_points, dict[str, dict[str, list[float]]]()
    for i, j, (x, y) in zip(seen.image.tolist(), seen.point.tolist(), seen.xy.tolist(), strict=True):
        width, height = estimate.cameras[network.camera[i]].size_px
        part = [
            round((v - (side - 1) / 2) / max(width, height), PLACES) for v, side in ((x, width), (y, height))
        ]
        marked.setdefault(network.points[j], {})[network.images[i]] = part
    before: Mapping[str, Any] = {"points": []}
    if ground_control is not None:
        read_json(ground_control, OpenSfmPoints, "a file of ground control points")
        before = json.loads(ground_control.read_text(encoding="utf-8-sig"))
    here = set(network.images)
    points = []
    for point in before["points"]:
        own = marked.pop(point["id"], {})
        observations = [
            {**row, "projection": own.pop(row["shot_id"])} if row["shot_id"] in own else row
            for row in point.get("observations", [])
            if row["shot_id"] in own or row["shot_id"] not in here
        ]
        observations += [{"projection": xy, "shot_id": image} for image, xy in own.items()]
        points.append({**point, "observations": observations})
    points += [
        {
            "id": name,
            "observations": [{"projection": xy, "shot_id": image} for image, xy in own.items()],
        }
        for name, own in marked.items()
    ]
    return {**before, "points": points}
