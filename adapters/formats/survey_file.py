"""The survey file of a converted network, with which its tables and control can be adjusted again.

    survey.toml     unit, cameras, rigs, image points, approximate values, scale bars, datum
    control.csv     control and check points, see `control_tables`
    exterior.csv    image,X,Y,Z,sX,sY,sZ,omega_deg,phi_deg,kappa_deg,somega_deg,sphi_deg,skappa_deg

Source: the README, "The survey file".
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from glob import escape
from pathlib import Path

import numpy as np

from adapters.formats.content import Content
from adapters.formats.control_tables import CONTROL, write_known_points
from sfm.files.plain_text import csv_text
from sfm.files.result_tables import MOMENTS
from sfm.model.camera import Camera
from sfm.model.conventions import METRES, angles_from_rotation
from sfm.model.estimate import Estimate
from sfm.model.network import Network

MIN_CONTROL = 3  # points that fix position, attitude and scale
EXTERIOR = ("image", "X", "Y", "Z", "omega_deg", "phi_deg", "kappa_deg")
EXTERIOR_SIGMAS = ("sX", "sY", "sZ", "somega_deg", "sphi_deg", "skappa_deg")


def write_survey_file(folder: Path, content: Content, *, title: str) -> None:
    """Write the survey file for the tables in a folder, and the tables of given values.

    Args:
        folder: folder of the tables.
        content: content of the survey; its control defines the datum if it is sufficient and no other datum
            is known.
        title: name of the survey.
    """
    result = content.result
    network, estimate, control = result.network, result.estimate, result.network.control
    unit = 'unit = "m"  # other programs do not state it: put here what the coordinates are in'
    if result.unit in METRES:
        unit = f"unit = {_text(result.unit)}"
    lines = ["[survey]", f"name = {_text(title)}", unit, ""]
    seen = network.interior
    for camera, images, varying in _families(network, estimate):
        weighted = {}  # value and standard deviation of the weighted parameters
        for k, s, value, sigma in zip(seen.camera, seen.parameter, seen.value, seen.sigma, strict=True):
            observed = estimate.cameras[k]
            if camera.name in (observed.name, observed.owner_of(s)) and camera.model == observed.model:
                weighted[observed.names[s]] = (float(value), float(sigma))
        lines += [*_camera(camera, images, weighted, varying), ""]
    lines += _rigs(folder, network, estimate)
    lines += ["[observations]", 'file = "image_points.csv"', ""]
    lines += [
        "[approximate]",
        'images = "images.csv"',
        'points = "points.csv"',
        'cameras = "cameras.csv"',
        "",
    ]
    if len(control) or len(content.checks):
        write_known_points(folder / CONTROL, network.points, control, content.checks)
        lines += ["[control]", f'file = "{CONTROL}"', ""]
    if len(network.exterior):
        (folder / "exterior.csv").write_text(_exterior(network), encoding="utf-8", newline="")
        lines += ["[exterior]", 'file = "exterior.csv"', ""]
    bars = network.scale_bars
    for start, end, length, sigma in zip(bars.start, bars.end, bars.length, bars.sigma, strict=True):
        ends = [_text(network.points[j]) for j in (start, end)]
        lines += ["[[scale_bar]]", f"from = {ends[0]}", f"to = {ends[1]}"]
        lines += [f"length = {float(length)!r}", f"sigma = {float(sigma)!r}", ""]
    adjust = []
    if len(content.rejected):
        adjust.append('reject = "tau"')  # they are among the image points, and will be detected again
    if content.stated_weights:
        adjust.append('weights = "stated"')
    if adjust:
        lines += ["[adjust]", *adjust, ""]
    kind = result.datum or ("control" if len(control.complete) >= MIN_CONTROL else "free")
    lines += ["[datum]", f'kind = "{kind}"']
    (folder / "survey.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _rigs(folder: Path, network: Network, estimate: Estimate) -> list[str]:
    """Return the sections of rigs, and write the mounts that are held fixed; moments are in moments.csv."""
    mounts, lines = estimate.mounts, list[str]()
    if mounts is None or network.moment is None:
        return []
    for number, (rig, cameras) in enumerate(mounts.by_rig().items(), 1):
        on = [a for a in cameras if (network.camera == a).any()]
        if len(on) < 2 or on[0] != cameras[0]:
            continue  # photographs of one camera are single ones
        names = [estimate.cameras[a].name for a in on]
        lines += ["[[rig]]", f"name = {_text(rig)}", f"cameras = [{', '.join(map(_text, names))}]"]
        lines.append(f'moment = "{MOMENTS}"')
        held = [a for a in on[1:] if not mounts.free[a].any()]
        if held:
            angles = np.degrees(angles_from_rotation(mounts.rotation))
            rows = [(estimate.cameras[a].name, *mounts.position[a], *angles[a], *[0.0] * 6) for a in held]
            text = csv_text(("camera", *EXTERIOR[1:], *EXTERIOR_SIGMAS), rows)
            (folder / f"held_mounts_{number}.csv").write_text(text, encoding="utf-8", newline="")
            lines.append(f'mounts = "held_mounts_{number}.csv"')
        lines.append("")
    return lines


def _families(network: Network, estimate: Estimate) -> Iterator[tuple[Camera, list[str], tuple[str, ...]]]:
    """Yield cameras, their photographs, and the parameters that vary between photographs.

    Cameras that share parameters and took one photograph each become one camera.
    """
    images = [
        [name for name, a in zip(network.images, network.camera, strict=True) if a == k]
        for k in range(len(estimate.cameras))
    ]
    groups: dict[str, list[int]] = {}
    for k, camera in enumerate(estimate.cameras):
        group = next((owner for owner in camera.shared if owner), "")
        alone = group and len(images[k]) == 1 and camera.name == f"{group} {images[k][0]}"
        groups.setdefault(group if alone else f"{camera.name}\n{k}", []).append(k)
    for group, members in groups.items():
        camera = estimate.cameras[members[0]]
        varying: tuple[str, ...] = ()
        if "\n" not in group:
            pairs = zip(camera.names, camera.shared, camera.free, strict=True)
            varying = tuple(name for name, owner, free in pairs if free and not owner)
            camera = replace(camera, name=group)
        names = [name for k in members for name in images[k]]
        if names:
            yield camera, names, varying


def _exterior(network: Network) -> str:
    """Return the table of observed exterior orientations, with empty cells for unobserved values."""
    seen, rows = network.exterior, []
    factor = np.repeat([1.0, np.degrees(1.0)], 3)
    for i, position, angles, C in zip(seen.image, seen.position, seen.angles, seen.covariance, strict=True):
        variance = np.diagonal(C)
        known = np.isfinite(variance)
        value = np.where(known, factor * np.concatenate([position, angles]), np.nan)
        sigma = np.where(known, factor * np.sqrt(np.where(known, variance, 0.0)), np.nan)
        cells = ("" if np.isnan(v) else v for v in (*value.tolist(), *sigma.tolist()))
        rows.append((network.images[i], *cells))
    return csv_text((*EXTERIOR, *EXTERIOR_SIGMAS), rows)


def _camera(
    camera: Camera, images: list[str], weighted: dict[str, tuple[float, float]], varying: tuple[str, ...]
) -> Iterator[str]:
    """Yield the section of a camera; values of free parameters come from cameras.csv."""
    yield "[[camera]]"
    yield f"name = {_text(camera.name)}"
    yield f"images = [{', '.join(_text(escape(name)) for name in images)}]"
    yield f"size_px = [{camera.size_px[0]}, {camera.size_px[1]}]"
    yield f"pixel_mm = [{camera.pixel_mm[0]!s}, {camera.pixel_mm[1]!s}]"
    if "c" not in weighted:
        yield f"c_mm = {camera.c_px * float(np.mean(camera.pixel_mm))!s}"
    yield f'model = "{camera.model}"'
    adjusted = [name for name, is_free in zip(camera.names, camera.free, strict=True) if is_free]
    free = [name for name in adjusted if name not in weighted]
    yield f"free = [{', '.join(_text(name) for name in free)}]"
    if varying:
        yield f"per_photograph = [{', '.join(_text(name) for name in varying)}]"
    free = [*free, *weighted]
    held = [(n, v) for n, v in zip(camera.names, camera.parameters.tolist(), strict=True) if n not in free]
    held = [(name, value) for name, value in held if value and name != "c"]
    if held:
        yield "[camera.fixed]"
        yield from (f"{name} = {value!r}" for name, value in held)
    if weighted:
        yield "[camera.weighted]"
        yield from (f"{name} = [{value!r}, {sigma!r}]" for name, (value, sigma) in weighted.items())


def _text(value: str) -> str:
    """Return a string in TOML syntax, which for strings is that of JSON."""
    return json.dumps(value)
