"""The survey file of a converted network: its tables adjusted again as they are, with its control.

    survey.toml     cameras, image points, control, approximate values, datum
    control.csv     id,X,Y,Z,sX,sY,sZ[,cXY,cXZ,cYZ]; empty where a coordinate is not known

Source: the README, "The survey file".
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from sfm.camera import Camera
from sfm.conventions import FloatArray
from sfm.files.plain_text import csv_text
from sfm.network import Estimate, Network, ObjectPoints

MIN_CONTROL = 3  # points that fix position, attitude and scale
PAIRS = ((0, 1), (0, 2), (1, 2))  # of coordinates, for cXY, cXZ, cYZ


def write_survey_file(folder: Path, network: Network, estimate: Estimate, *, title: str) -> None:
    """Write the survey file of tables that are in a folder, and the control beside it.

    Args:
        folder: that the tables are in.
        network: what was measured; its control holds the network where it is enough for that.
        estimate: the cameras, free or not, and approximate values.
        title: name of the survey.
    """
    control = network.control
    unit = 'unit = "m"  # other programs do not state it: put here what the coordinates are in'
    lines = ["[survey]", f"name = {_text(title)}", unit, ""]
    for index, camera in enumerate(estimate.cameras):
        images = [name for name, own in zip(network.images, network.camera, strict=True) if own == index]
        if images:
            lines += [*_camera(camera, images), ""]
    lines += ["[observations]", 'file = "image_points.csv"', ""]
    lines += [
        "[approximate]",
        'images = "images.csv"',
        'points = "points.csv"',
        'cameras = "cameras.csv"',
        "",
    ]
    if len(control):
        text = _control(network.points, control)
        (folder / "control.csv").write_text(text, encoding="utf-8", newline="")
        lines += ["[control]", 'file = "control.csv"', ""]
    kind = "control" if len(control.complete) >= MIN_CONTROL else "free"
    lines += ["[datum]", f'kind = "{kind}"']
    (folder / "survey.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _camera(camera: Camera, images: list[str]) -> Iterator[str]:
    """Yield the section of a camera; values of free parameters come from cameras.csv."""
    yield "[[camera]]"
    yield f"name = {_text(camera.name)}"
    yield f"images = [{', '.join(_text(name.replace('[', '[[]').replace('*', '[*]')) for name in images)}]"
    yield f"size_px = [{camera.size_px[0]}, {camera.size_px[1]}]"
    yield f"pixel_mm = [{camera.pixel_mm[0]!s}, {camera.pixel_mm[1]!s}]"
    yield f"c_mm = {camera.c_px * float(np.mean(camera.pixel_mm))!s}"
    yield f'model = "{camera.model}"'
    free = [name for name, is_free in zip(camera.names, camera.free, strict=True) if is_free]
    yield f"free = [{', '.join(_text(name) for name in free)}]"
    held = [(n, v) for n, v in zip(camera.names, camera.parameters.tolist(), strict=True) if n not in free]
    held = [(name, value) for name, value in held if value and name != "c"]
    if held:
        yield "[camera.fixed]"
        yield from (f"{name} = {value!r}" for name, value in held)


def _control(points: tuple[str, ...], control: ObjectPoints) -> str:
    """Return the table of control, empty cells where a coordinate is not known."""
    variance = np.einsum("nii->ni", control.covariance)
    known = np.isfinite(variance)
    xyz = np.where(known, control.xyz, np.nan)
    sigma = np.where(known, np.sqrt(np.where(known, variance, 0.0)), np.nan)
    between = np.stack([control.covariance[:, row, column] for row, column in PAIRS], axis=1)
    header: tuple[str, ...] = ("id", "X", "Y", "Z", "sX", "sY", "sZ")
    values: FloatArray = np.concatenate([xyz, sigma], axis=1)
    if between.any():
        header, values = (*header, "cXY", "cXZ", "cYZ"), np.concatenate([values, between], axis=1)
    rows = [
        (points[j], *("" if np.isnan(value) else value for value in row))
        for j, row in zip(control.point, values.tolist(), strict=True)
    ]
    return csv_text(header, rows)


def _text(value: str) -> str:
    """Return a string as TOML writes it, which is as JSON does."""
    return json.dumps(value)
