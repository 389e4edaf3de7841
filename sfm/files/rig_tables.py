"""Rigs of a result as tables: where their cameras are mounted, and which photographs are of one moment.

    mounts.csv     camera,rig,X,Y,Z,omega_deg,phi_deg,kappa_deg,sX,sY,sZ,somega_deg,sphi_deg,skappa_deg
    moments.csv    image,moment

Mounts are in the image axes of the reference camera of the rig, whose row is 0. A standard deviation of 0
means held fixed, an empty cell adjusted and not known. Photographs that moments.csv does not name are alone.

Source: RFC 4180 for CSV.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from sfm.conventions import IntArray, angles_from_rotation, rotation_from_angles
from sfm.errors import SurveyFileError
from sfm.files.csv_tables import read_table
from sfm.files.plain_text import csv_text
from sfm.network import Mounts, Network
from sfm.solution import Solution

MOUNTS, MOMENTS = "mounts.csv", "moments.csv"
VALUES = ("X", "Y", "Z", "omega_deg", "phi_deg", "kappa_deg")
SIGMAS = ("sX", "sY", "sZ", "somega_deg", "sphi_deg", "skappa_deg")
IN_FILES = np.repeat([1.0, np.degrees(1.0)], 3)  # degrees there


def write_rigs(folder: Path, solution: Solution) -> None:
    """Write the mounts and moments of a solution with rigs into a folder; nothing without."""
    network, mounts = solution.network, solution.estimate.mounts
    if mounts is None or network.moment is None:
        return
    values = IN_FILES * np.hstack([mounts.position, angles_from_rotation(mounts.rotation)]) + 0.0  # no -0
    Q = solution.mount_covariance
    sigma = (
        np.full_like(values, np.nan) if Q is None else IN_FILES * np.sqrt(np.diagonal(Q, axis1=1, axis2=2))
    )
    sigma[~mounts.free] = 0.0
    rows = [
        (solution.estimate.cameras[a].name, rig, *values[a], *sigma[a])
        for a, rig in enumerate(mounts.rig)
        if rig
    ]
    moments = [
        (name, int(moment) + 1)
        for name, moment, camera in zip(network.images, network.moment, network.camera, strict=True)
        if mounts.rig[camera]
    ]
    for name, header, table in (
        (MOUNTS, ("camera", "rig", *VALUES, *SIGMAS), rows),
        (MOMENTS, ("image", "moment"), moments),
    ):
        (folder / name).write_text(csv_text(header, table), encoding="utf-8", newline="")


def read_rigs(
    folder: Path, cameras: Sequence[str], network: Network
) -> tuple[Mounts | None, IntArray | None]:
    """Read mounts, and the moment of each photograph; None without rigs.

    Args:
        folder: of the result.
        cameras: names of its cameras, a of them.
        network: its photographs and their cameras.

    Raises:
        SurveyFileError: what is wrong, with file and line number.
    """
    path = folder / MOUNTS
    if not path.is_file():
        return None, None
    table = read_table(path, ("camera", "rig"), VALUES, SIGMAS, ignored=None, blank=SIGMAS)
    values, sigma = np.split(table.values, [6], axis=1)
    sigma = sigma if sigma.size else np.full_like(values, np.nan)
    table.refuse(sigma, sigma < 0, SIGMAS, "0 (held fixed) or more, or nothing")
    position, rotation = np.zeros((len(cameras), 3)), np.tile(np.eye(3), (len(cameras), 1, 1))
    free, rigs = np.zeros((len(cameras), 6), dtype=bool), [""] * len(cameras)
    for k, (name, rig) in enumerate(zip(table.keys("camera"), table.texts[1], strict=True)):
        if name not in cameras:
            raise SurveyFileError(f"{table.place(k)}: camera '{name}' is not in cameras.csv")
        a = cameras.index(name)
        position[a], rotation[a] = values[k, :3], rotation_from_angles(*np.radians(values[k, 3:]))
        free[a], rigs[a] = sigma[k] != 0, rig
    mounts = Mounts(position, rotation, free, tuple(rigs))
    references = {rigs[a] for a in np.flatnonzero(mounts.at_reference)}
    for rig in dict.fromkeys(table.texts[1]):
        if not rig or rigs.count(rig) < 2:
            raise SurveyFileError(f"{path}: rig '{rig}' has one camera, needed a name and at least 2 cameras")
        if rig not in references:
            raise SurveyFileError(f"{path}: rig '{rig}' has no reference camera, all values and sigmas 0")
    return mounts, _read_moments(folder / MOMENTS, cameras, network, mounts)


def read_moments(path: Path) -> Iterator[tuple[str, str]]:
    """Yield photographs and their moments from a table image,moment.

    Raises:
        SurveyFileError: unreadable, wrong columns, or a photograph comes twice.
    """
    table = read_table(path, ("image", "moment"), (), ignored=None)
    return zip(table.keys("image"), table.texts[1], strict=True)


def _read_moments(path: Path, cameras: Sequence[str], network: Network, mounts: Mounts) -> IntArray:
    """Return the moment of each photograph, (m,)."""
    of = dict(read_moments(path))
    for name in of.keys() - set(network.images):
        raise SurveyFileError(f"{path}: image '{name}' is not in images.csv")
    for name, a in zip(network.images, network.camera, strict=True):
        if mounts.rig[a] and name not in of:
            raise SurveyFileError(
                f"{path}: photograph {name} of camera {cameras[a]} is missing, which is on a rig"
            )
    order = list(dict.fromkeys((of[name],) if name in of else ("", name) for name in network.images))
    number = {key: t for t, key in enumerate(order)}
    found = [number[(of[name],) if name in of else ("", name)] for name in network.images]
    moment = np.array(found, dtype=np.int64)
    refuse_moments(str(path), cameras, network, mounts, moment)
    return moment


def refuse_moments(
    where: str, cameras: Sequence[str], network: Network, mounts: Mounts, moment: IntArray
) -> None:
    """Raise SurveyFileError where photographs of one moment are not of different cameras of one rig.

    Args:
        where: what they were read from.
        cameras: their names.
        network: the photographs.
        mounts: of the cameras.
        moment: of each photograph, (m,).
    """
    first: dict[int, int] = {}
    taken: dict[tuple[int, int], int] = {}
    for i, (t, a) in enumerate(zip(moment.tolist(), network.camera.tolist(), strict=True)):
        other = taken.setdefault((t, a), i)
        if other == i:
            other = first.setdefault(t, i)
        b = int(network.camera[other])
        if other != i and (a == b or not mounts.rig[a] or mounts.rig[a] != mounts.rig[b]):
            raise SurveyFileError(
                f"{where}: photographs {network.images[other]} of camera {cameras[b]} and "
                f"{network.images[i]} of camera {cameras[a]} are of one moment; needed different cameras of "
                "one rig"
            )
