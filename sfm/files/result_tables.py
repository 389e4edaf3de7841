"""The tables of a result: their columns, declared once for writers and readers.

Angles in files are in degrees, and lengths in the object unit of the survey. Sigmas are a posteriori standard
deviations, except for image points, whose sigmas are as measured. Numbers are written with enough digits to
reproduce them exactly.

Rigs have two tables, for the mounts of their cameras and for the moments of photographs:

    mounts.csv     camera,rig,X,Y,Z,omega_deg,phi_deg,kappa_deg,sX,sY,sZ,somega_deg,sphi_deg,skappa_deg
    moments.csv    image,moment

Mounts are in the image axes of the reference camera of the rig, whose row is 0. A standard deviation of 0
means held fixed. An empty cell means adjusted, with an unknown standard deviation. Photographs that
moments.csv does not list belong to no rig.

Source: RFC 4180 for CSV; docs/reference/results.md describes each column.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sfm.files.csv_tables import CsvTable, read_header, read_table
from sfm.files.plain_text import csv_blocks, csv_blocks_of_columns, csv_text
from sfm.model.conventions import (
    AnyArray,
    BoolArray,
    FloatArray,
    IntArray,
    angles_from_rotation,
    rotation_from_angles,
)
from sfm.model.errors import SurveyFileError
from sfm.model.estimate import Mounts
from sfm.model.network import ImagePoints, Network
from sfm.model.solution import Solution

MOUNTS, MOMENTS = "mounts.csv", "moments.csv"
VALUES = ("X", "Y", "Z", "omega_deg", "phi_deg", "kappa_deg")
SIGMAS = ("sX", "sY", "sZ", "somega_deg", "sphi_deg", "skappa_deg")
IN_FILES = np.repeat([1.0, np.degrees(1.0)], 3)  # factors from internal units to those of files
KINDS = (
    "name",  # text
    "label",  # text; the column may be missing
    "number",
    "blank",  # numbers; cells may be empty
    "optional",  # numbers; cells may be empty, and the whole group may be missing
    "flag",  # 0 or 1; the whole group may be missing
    "further",  # for people and other programs, not read back
)


class ResultTable:
    """A table of a result: groups of columns that are either all known or all unknown."""

    def __init__(self, stem: str, *groups: str, may_be_empty: bool = False) -> None:
        """Declare the columns of a table.

        Args:
            stem: name of its file without the ending.
            *groups: kind and names of each group, such as "number: X Y Z"; other optional groups are only
                read if the first optional group is present.
            may_be_empty: whether it may have no rows, as that of a model of poses, cameras or points alone.
        """
        self.may_be_empty = may_be_empty
        self.file = f"{stem}.csv"
        declared = []
        for text in groups:
            kind, _, names = text.partition(": ")
            if kind not in KINDS:
                raise ValueError(f"columns '{text}', expected one of {', '.join(KINDS)} before the names")
            declared.append((kind, tuple(names.split())))
        self.groups = tuple(declared)

    def names_of(self, *kinds: str) -> tuple[str, ...]:
        """Return the names of the columns of the given kinds; of all kinds if none is given."""
        return tuple(name for kind, names in self.groups if kind in (kinds or KINDS) for name in names)

    def read(self, folder: Path) -> CsvTable:
        """Read the names and numbers of the table of a result.

        Raises:
            SurveyFileError: something is missing or wrong; the message has file and line number.
        """
        path, blank = folder / self.file, self.names_of("blank", "optional")
        optional = [names for kind, names in self.groups if kind == "optional"]
        flags, labels = self.names_of("flag"), self.names_of("label")
        if flags or optional[1:]:
            header = read_header(path)
            flags = tuple(flag for flag in flags if flag in header)
            optional = optional[:1] + [names for names in optional[1:] if {*names, *optional[0]} <= {*header}]
        numbers = (*self.names_of("number"), *self.names_of("blank"), *flags)
        return read_table(
            path,
            (*self.names_of("name"), *(label for label in labels if label in read_header(path))),
            numbers,
            tuple(name for names in optional for name in names),
            ignored=None,
            blank=blank,
            may_be_empty=self.may_be_empty,
        )

    def write(self, folder: Path, *values: Any) -> None:
        """Write the table of a result.

        Args:
            folder: folder of the result.
            *values: values of each group: an array, (n, columns), a sequence for each column, or one sequence
                for a single column; None leaves the group out.
        """
        header: list[str] = []
        columns: list[Sequence[object] | AnyArray] = []
        for (_, names), value in zip(self.groups, values, strict=True):
            if value is not None:
                if isinstance(value, np.ndarray) and value.ndim == 2:
                    value = np.ascontiguousarray(value.T)
                alone = len(names) == 1 and not (isinstance(value, np.ndarray) and value.ndim == 2)
                of_group = [value] if alone else list(value) or [()] * len(names)
                if len(of_group) != len(names):
                    wrong = f"{len(of_group)} columns of values for {len(names)} columns of the table"
                    raise ValueError(wrong)
                header += names
                columns += of_group
        rows = {len(column) for column in columns}
        if len(rows) > 1:
            raise ValueError(f"columns of {', '.join(map(str, sorted(rows)))} rows in one table")
        self._save(folder, csv_blocks_of_columns(header, columns))

    def write_rows(self, folder: Path, rows: Iterable[Sequence[object]]) -> None:
        """Write the table of a result from rows with all columns."""
        self._save(folder, csv_blocks(self.names_of(), rows))

    def _save(self, folder: Path, blocks: Iterable[str]) -> None:
        with (folder / self.file).open("w", encoding="utf-8", newline="") as file:
            file.writelines(blocks)


EXTERIOR = "X0 Y0 Z0 omega phi kappa"


def _covariance_table(stem: str, what: str, parts: str) -> ResultTable:
    """Return a table for the upper triangles of covariance matrices."""
    names = parts.split()
    pairs = (f"{first}_{other}" for k, first in enumerate(names) for other in names[k:])
    return ResultTable(stem, f"name: {what}", f"further: {' '.join(pairs)}")


POINTS = ResultTable(
    "points",
    "name: id",
    "number: X Y Z",
    "optional: sX sY sZ",
    "further: rays code angle_deg rms_px limiting_sX limiting_sY limiting_sZ",
    may_be_empty=True,
)
IMAGES = ResultTable(
    "images",
    "name: image",
    "number: X Y Z omega_deg phi_deg kappa_deg",
    "optional: sX sY sZ",
    "further: somega_deg sphi_deg skappa_deg",
    "name: camera",
    "further: points rms_px coverage",
    may_be_empty=True,
)
CAMERAS = ResultTable(
    "cameras",
    "name: camera parameter",
    "number: value",
    "optional: sigma",
    "further: unit",
    may_be_empty=True,
)
IMAGE_POINTS = ResultTable(
    "image_points",
    "name: image point",
    "number: x_px y_px",
    "optional: sx_px sy_px",
    "optional: cxy_px2",
    "further: vx_px vy_px",
    "flag: rejected",
    "label: source",
    may_be_empty=True,
)
CAMERAS_BALANCED = ResultTable("cameras_balanced", "further: camera parameter value sigma unit")
TARGETS = ResultTable(
    "targets", "name: image", "number: x_px y_px", "blank: a_px b_px angle_deg", "name: reason"
)
LEFT_OUT = ResultTable("left_out", "further: kind name image_points reason")
GIVEN = ResultTable(
    "given",
    "name: kind name coordinate",
    "further: unit",
    "number: given",
    "further: difference",
    "blank: sigma",
    "further: r w",
)
RELIABILITY = ResultTable(
    "reliability",
    "name: image point",
    "further: vx_px vy_px rx ry",
    "blank: wx wy",
    "further: taux tauy mdbx_px mdby_px extx exty weight rejected errorx_px errory_px",
)
VARIANCE_COMPONENTS = ResultTable("variance_components", "further: kind group observations redundancy sigma0")
RESIDUALS = ResultTable(
    "residuals",
    "further: kind name accepted rejected rmsx_px rmsy_px largestx_px largesty_px largestx_at largesty_at",
)
CONTROL_POINTS = ResultTable(
    "control_points",
    "name: use point coordinate",
    "blank: given sigma_prior",
    "further: adjusted sigma_posterior difference test",
)
INTERIOR_CORRELATIONS = ResultTable("interior_correlations", "further: camera first second correlation")
EXTERIOR_CORRELATIONS = ResultTable("exterior_correlations", f"further: camera parameter image {EXTERIOR}")
POINT_COVARIANCES = _covariance_table("point_covariances", "id", "X Y Z")
IMAGE_COVARIANCES = _covariance_table("image_covariances", "image", EXTERIOR)
TABLES = tuple(table for table in list(globals().values()) if isinstance(table, ResultTable))


def write_solution(
    folder: Path,
    solution: Solution,
    seen: ImagePoints,
    rejected: BoolArray,
    *further: Sequence[Sequence[object]] | FloatArray,
) -> None:
    """Write the tables of points, photographs, cameras and image points.

    Args:
        folder: folder of the result.
        solution: has coordinates of all points and photographs.
        seen: all k image points, including rejected ones.
        rejected: which image points were rejected, (k,).
        *further: further columns of points, photographs and image points, for a survey; without them, columns
            without any known value are left out too.
    """
    network, estimate = solution.network, solution.estimate
    every = bool(further)
    of_points, of_images, residuals = further or (None, None, None)

    def known(values: FloatArray | None) -> FloatArray | None:
        return values if values is not None and (every or np.isfinite(values).any()) else None

    point = known(_sigmas(solution.point_covariance))
    position = known(_sigmas(solution.position_covariance))
    exterior = None if position is None else _sigmas(solution.exterior_covariance)
    angles = np.degrees(angles_from_rotation(estimate.rotation))
    names = [estimate.cameras[k].name for k in network.camera]
    POINTS.write(folder, network.points, estimate.points, point, of_points)
    IMAGES.write(
        folder,
        network.images,
        np.hstack([estimate.position, angles]),
        position,
        None if exterior is None else np.degrees(exterior[:, 3:]),
        names,
        of_images,
    )
    sigmas = solution.interior_sigma or [np.full(len(camera.names), np.nan) for camera in estimate.cameras]
    CAMERAS.write_rows(
        folder,
        (
            (camera.name, *row)
            for camera, sigma in zip(estimate.cameras, sigmas, strict=True)
            for row in zip(camera.names, camera.parameters, sigma, camera.units, strict=True)
        ),
    )
    names_of_rows = (
        [network.images[i] for i in seen.image],
        [network.points[j] for j in seen.point],
    )
    between = seen.stated_covariance
    sources = None if seen.source is None else [network.sources[k].name for k in seen.source.tolist()]
    IMAGE_POINTS.write(
        folder,
        names_of_rows,
        seen.xy,
        known(seen.stated_sigma),
        known(np.where(between == 0, np.nan, between)),  # 0 is an empty cell
        residuals,
        rejected.astype(int) if every or rejected.any() else None,
        sources,
    )


def _sigmas(covariance: FloatArray | None) -> FloatArray | None:
    """Return the standard deviations of covariance matrices, (n, d, d), NaN if unknown, (n, d)."""
    if covariance is None:
        return None
    variance = np.einsum("nii->ni", covariance)
    return np.asarray(np.sqrt(np.where(variance >= 0, variance, np.nan)))


def write_rigs(folder: Path, solution: Solution) -> None:
    """Write the mounts and moments of a solution with rigs into a folder; nothing without rigs."""
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
        folder: folder of the result.
        cameras: names of its cameras, (a,).
        network: has its photographs and their cameras.

    Raises:
        SurveyFileError: something is wrong; the message has file and line number.
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
    table.refuse_duplicates(table.texts[0], ("camera",))
    places = table.places("camera", cameras, "cameras.csv").tolist()
    for k, (a, rig) in enumerate(zip(places, table.texts[1], strict=True)):
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
        SurveyFileError: the table is unreadable, has wrong columns, or has a photograph twice.
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
                f"{path}: photograph {name} of camera {cameras[a]}, which is on a rig, is missing"
            )
    order = list(dict.fromkeys((of[name],) if name in of else ("", name) for name in network.images))
    number = {key: t for t, key in enumerate(order)}
    moments = [number[(of[name],) if name in of else ("", name)] for name in network.images]
    moment = np.array(moments, dtype=np.int64)
    refuse_moments(str(path), cameras, network, mounts, moment)
    return moment


def refuse_moments(
    where: str, cameras: Sequence[str], network: Network, mounts: Mounts, moment: IntArray
) -> None:
    """Raise SurveyFileError if photographs of one moment are not from different cameras of one rig.

    Args:
        where: source of the moments, for the error message.
        cameras: names of the cameras.
        network: has the photographs.
        mounts: mounts of the cameras.
        moment: moment of each photograph, (m,).
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
