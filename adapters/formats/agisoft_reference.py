"""Reference of Agisoft Metashape (Export Reference, .csv): positions, angles and control with accuracies.

    # CoordinateSystem: well-known text
    #Label,Enable,X,Y,Z,Yaw,Pitch,Roll,Accuracy_X_(m),...,Accuracy_Yaw_(deg),...,X_est,Y_est,Z_est,Yaw_est,...

A folder has cameras.csv and markers.csv. A table with angles is of photographs, another of points. X to Roll
are what was observed, with the accuracies as standard deviations, and the columns _est what was estimated. A
point that is not enabled checks. Further columns are not read. Instead of yaw, pitch and roll there may be
omega, phi and kappa; axes may be called Easting, Northing and Altitude; an accuracy may be of X/Y or X/Y/Z.

R = Rz(-yaw) Rx(pitch) Ry(roll), as for RealityCapture.

Source: Agisoft Metashape Professional user manual 2.x, "Reference pane"; ypr2mat as in Agisoft's forum, topic
12200.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from adapters.formats.content import Content
from adapters.formats.stated_model import (
    StatedModel,
    content_of,
    heading_from_rotation,
    rotation_from_heading,
    unstated_camera,
)
from adapters.reading.text_lines import Lines, write_lines
from sfm.files.plain_text import csv_text, shorten
from sfm.model.conventions import METRES, FloatArray, angles_from_rotation, rotation_from_angles
from sfm.model.errors import SurveyFileError
from sfm.model.network import Network

IMAGES, POINTS = "cameras.csv", "markers.csv"
SYSTEM = "# CoordinateSystem: "
AXES, ANGLES, TURNS = ("x", "y", "z"), ("yaw", "pitch", "roll"), ("omega", "phi", "kappa")
WORDS = {"easting": "x", "northing": "y", "altitude": "z", "height": "z", "x/x": "x", "y/y": "y", "z/z": "z"}
HEAD = re.compile(r"^(# CoordinateSystem: .*\n)?#?\s*Label,", re.IGNORECASE)
OF_UNIT = re.compile(r"_?\((\w+)\)$")
SEPARABLE = 1e-9  # correlation of two angles, or sine between their axes, that is only rounding


def read_reference(path: Path) -> Content:
    """Read a table, or those of a folder.

    Raises:
        SurveyFileError: with file and line number.
    """
    stated = StatedModel(path, points_named=True)
    files = [path / name for name in (IMAGES, POINTS) if (path / name).is_file()] if path.is_dir() else [path]
    for file in files:
        if not file.resolve().is_relative_to(path.resolve()):
            raise SurveyFileError(f"{file}: a link that leaves its folder; the file itself is needed there")
        stated.text = Lines.of(file)
        kind = -1
        for label, enabled, row in _rows(stated):
            if kind < 0:
                kind = any(
                    name in row for name in (ANGLES[0], TURNS[0], f"{ANGLES[0]}_est", f"{TURNS[0]}_est")
                )
            (_add_photograph if kind else _add_point)(stated, label, enabled, row)
    stated.text = None
    return content_of(stated)


def write_reference(folder: Path, content: Content) -> None:
    """Write cameras.csv of the photographs and markers.csv of the points.

    Args:
        folder: new or empty.
        content: any; observed angles that are correlated as yaw, pitch and roll are left out.

    Raises:
        OutputError: the folder cannot be written.
    """
    result = content.result
    network, estimate = result.network, result.estimate
    unit = f"_({result.unit})" if result.unit in METRES else ""
    accuracies = [f"Accuracy_{axis}{unit}" for axis in "XYZ"]
    turns = [name.capitalize() for name in ANGLES]
    head = [f"{SYSTEM}{content.crs}"] if content.crs else []
    folder.mkdir(parents=True, exist_ok=True)
    if network.images or not network.points:
        observed = {int(i): row for i, row in zip(network.exterior.image, _observed(network), strict=True)}
        nothing = np.full(12, np.nan)
        rows = []
        for i, name in enumerate(network.images):
            value, sigma = np.split(observed.get(i, nothing), 2)
            turned = heading_from_rotation(estimate.rotation[i])
            cells = np.concatenate([value, sigma, estimate.position[i], turned])
            rows.append((name, int(i in observed), *_cells(cells)))
        columns = (
            "Label",
            "Enable",
            "X",
            "Y",
            "Z",
            *turns,
            *accuracies,
            *(f"Accuracy_{n}_(deg)" for n in turns),
        )
        columns = (*columns, *(f"{name}_est" for name in ("X", "Y", "Z", *turns)))
        write_lines(folder / IMAGES, [*head, "#" + csv_text(columns, rows).rstrip("\n")])
    if network.points:
        given: dict[int, tuple[int, FloatArray]] = {}
        for points, enabled in ((content.checks, 0), (network.control, 1)):
            variance = np.diagonal(points.covariance, axis1=1, axis2=2)
            known = np.isfinite(variance).all(axis=1, keepdims=True)
            cells_of = np.where(known, np.hstack([points.xyz, np.sqrt(variance)]), np.nan)
            given |= {j: (enabled, cells) for j, cells in zip(points.point.tolist(), cells_of, strict=True)}
        rows = []
        for j, name in enumerate(network.points):
            enabled, cells = given.get(j, (0, np.full(6, np.nan)))
            rows.append((name, enabled, *_cells(np.concatenate([cells, estimate.points[j]]))))
        columns = ("Label", "Enable", "X", "Y", "Z", *accuracies, "X_est", "Y_est", "Z_est")
        write_lines(folder / POINTS, [*head, "#" + csv_text(columns, rows).rstrip("\n")])


def kinds_kept(content: Content) -> frozenset[str]:
    """Return the kinds that are kept of this survey: observed poses whose angles were observed apart."""
    network = content.result.network
    if not len(network.exterior):
        return frozenset({"exterior", "exterior correlations"})
    apart = np.array([np.isfinite(row[:3]).any() for row in _observed(network)])
    return frozenset({"exterior"}) if apart.all() else frozenset()


def _rows(stated: StatedModel) -> Iterator[tuple[str, bool, dict[str, float]]]:
    """Yield label, whether it is enabled, and the numbers of each row by column, NaN of an empty cell."""
    text = stated.text
    assert text is not None
    header: list[str] = []
    while (line := text.maybe_line()) is not None:
        if line.startswith(SYSTEM):
            system = line.removeprefix(SYSTEM).strip()
            if system.startswith(("GEOGCS", "GEOGCRS")):
                raise text.error(
                    "longitude and latitude are no Cartesian coordinates; export a projected system"
                )
            stated.crs = "" if system.startswith("LOCAL_CS") else system
        if not line.strip() or line.startswith("# "):
            continue
        cells = text.cells()
        if not header:
            header = [_column(name, stated) for name in cells]
            if header[0] != "label" or len(set(header)) < len(header):
                raise text.error(
                    f"'{shorten(line)}', needed #Label,X,Y,Z and further columns of different names"
                )
            continue
        if len(cells) != len(header):
            raise text.error(f"{len(cells)} columns, the header has {len(header)}")
        row = {}
        for name, cell in zip(header[1:], cells[1:], strict=True):
            number = text.number_of(cell.strip()) if cell.strip() else np.nan
            kind, _, axes = name.partition("_")
            for axis in axes.split("/") if kind == "accuracy" else ():
                row[f"accuracy_{axis}"] = number
            row[name] = number
        for name in row:
            if name.startswith("accuracy") and row[name] < 0:
                raise text.error(f"{name} {row[name]:g}, needed 0 or more")
        yield text.name_of(cells[0].strip(), "the label"), row.get("enable", 1.0) != 0, row
    if not header:
        raise text.error("no table is in it, needed #Label,X,Y,Z")


def _column(name: str, stated: StatedModel) -> str:
    """Return the name of a column without its unit, which is stated if it is a length."""
    name = name.strip().lstrip("#").strip()
    unit = OF_UNIT.search(name)
    if unit is not None and unit[1] in METRES and name.lower().startswith("accuracy"):
        stated.unit = unit[1]
    name = OF_UNIT.sub("", name).lower()
    if "longitude" in name:
        raise stated.error("longitude and latitude are no Cartesian coordinates; export a projected system")
    for word, axis in WORDS.items():
        name = name.replace(word, axis)
    return name


def _values(row: dict[str, float], names: tuple[str, ...], ending: str = "", begin: str = "") -> FloatArray:
    return np.array([row.get(f"{begin}{name}{ending}", np.nan) for name in names])


def _add_photograph(stated: StatedModel, label: str, enabled: bool, row: dict[str, float]) -> None:
    """Add a photograph with its observed pose and its estimate, by default the observed one."""
    if not stated.cameras:
        stated.cameras.append(unstated_camera(stated))
    names, turned = (ANGLES, rotation_from_heading)
    if TURNS[0] in row or f"{TURNS[0]}_est" in row:
        names, turned = TURNS, lambda *angles: rotation_from_angles(*np.radians(angles))
    poses = []
    for ending in ("_est", ""):
        xyz, angles = _values(row, AXES, ending), _values(row, names, ending)
        if np.isfinite(xyz).all() and np.isfinite(angles).all():
            poses.append((xyz, turned(*angles.tolist())))
    i = len(stated.images)
    stated.add_image(label, 0, *(poses[0] if poses else (None, None)))
    xyz, angles = _values(row, AXES), _values(row, names)
    if not (enabled and np.isfinite(xyz).all()):
        return
    sigma = _values(row, AXES, begin="accuracy_")
    spread = np.radians(_values(row, names, begin="accuracy_"))
    C = np.diag(np.r_[np.where(np.isfinite(sigma), sigma, np.inf) ** 2, np.full(3, np.inf)])
    opk = np.zeros(3)
    if np.isfinite(angles).all() and np.isfinite(spread).all():
        opk = angles_from_rotation(turned(*angles.tolist()))
        of_opk, of_heading = _turned(opk)
        if abs(np.linalg.det(of_opk)) > SEPARABLE:
            J = np.eye(3) if names == TURNS else np.linalg.solve(of_opk, of_heading)
            C[3:, 3:] = J @ np.diag(spread**2) @ J.T
    if np.isfinite(np.diagonal(C)).any():
        stated.exterior[i] = (np.where(np.isfinite(sigma), xyz, 0.0), opk, C)


def _add_point(stated: StatedModel, label: str, enabled: bool, row: dict[str, float]) -> None:
    """Add a point with its reference as control, or as a check where it is not enabled."""
    xyz, estimated = _values(row, AXES), _values(row, AXES, "_est")
    known = np.isfinite(xyz).all()
    j = stated.add_point(
        label, estimated if np.isfinite(estimated).all() else xyz if known else np.full(3, np.nan)
    )
    if known:
        sigma = np.nan_to_num(_values(row, AXES, begin="accuracy_"))
        (stated.control if enabled else stated.checks)[j] = (xyz, np.diag(sigma**2))


def _observed(network: Network) -> FloatArray:
    """Return X to Roll and their standard deviations of observed poses, degrees, (n, 12).

    A pose that was not observed as it can be stored is NaN: whose position is not known or is correlated with
    its angles, or whose angles are correlated.
    """
    seen = network.exterior
    rows = np.full((len(seen), 12), np.nan)
    for k, (position, opk, C) in enumerate(zip(seen.position, seen.angles, seen.covariance, strict=True)):
        finite = np.isfinite(np.diagonal(C))
        if not finite[:3].all() or finite[3:].any() != finite[3:].all():
            continue
        rows[k, :3], rows[k, 6:9] = position, np.sqrt(np.diagonal(C)[:3])
        if not finite[3:].any():
            continue
        of_opk, of_heading = _turned(opk)
        if abs(np.linalg.det(of_heading)) <= SEPARABLE:
            rows[k] = np.nan
            continue
        J = np.eye(6)
        J[3:, 3:] = np.linalg.solve(of_heading, of_opk)
        turned = J @ C @ J.T
        s = np.sqrt(np.diagonal(turned))
        apart = turned - np.diag(s**2)
        apart[:3, :3] = 0.0
        if (np.abs(apart) > SEPARABLE * np.outer(s, s)).any():
            rows[k] = np.nan
            continue
        rows[k, 3:6], rows[k, 9:] = heading_from_rotation(rotation_from_angles(*opk)), np.degrees(s[3:])
    return rows


def _turned(opk: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return small rotations of the image axes by omega, phi, kappa, and by yaw, pitch, roll, (3, 3) each.

    They follow from the product of three rotations, of which the outer one turns about an axis of the object
    and the inner one about an axis of the image; they are singular where two angles are not separable.
    """
    R = rotation_from_angles(*opk)
    kappa, roll = opk[2], np.radians(heading_from_rotation(R)[2])
    of_opk = np.column_stack([R[0], [np.sin(kappa), np.cos(kappa), 0.0], [0.0, 0.0, 1.0]])
    of_heading = np.column_stack([-R[2], [np.cos(roll), 0.0, np.sin(roll)], [0.0, 1.0, 0.0]])
    return of_opk, of_heading


def _cells(values: FloatArray) -> list[object]:
    return [value if np.isfinite(value) else "" for value in values.tolist()]
