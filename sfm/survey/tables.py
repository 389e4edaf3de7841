"""The tables that a survey file names (CSV): control, image points, exterior orientation, points.

Every refusal names the line and the column; what is true of all tables is in `sfm.csv_tables`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sfm.conventions import FloatArray, IntArray, rotation_from_angles
from sfm.csv_tables import read_header, read_table

MIN_SIGMA = 1e-9  # in any unit used here less than an atom
MAX_EXTENT_PER_SIGMA = 1e6  # no control is known to better than a millionth of its extent


@dataclass(frozen=True)
class PointTable:
    """Object points of control.csv or points.csv."""

    names: tuple[str, ...]  # (n,)
    xyz: FloatArray  # object unit, (n, 3)
    sigma: FloatArray  # standard deviations, 0 = fixed, object unit, (n, 3)


@dataclass(frozen=True)
class ExteriorTable:
    """Exterior orientations of images.csv."""

    names: tuple[str, ...]  # photographs, (m,)
    position: FloatArray  # projection centres X0, object unit, (m, 3)
    rotation: FloatArray  # R, image to object axes, (m, 3, 3)
    line: IntArray  # line of the file, (m,)


@dataclass(frozen=True)
class ImagePointTable:
    """Measured image points of image_points.csv, as they stand there."""

    image: tuple[str, ...]  # photograph of each row, (k,)
    point: tuple[str, ...]  # point of each row, (k,)
    xy: FloatArray  # px in the pixel frame or mm in the image frame, (k, 2)
    sigma: FloatArray | None  # standard deviations in the same unit, None if the table has none, (k, 2)
    unit: str  # px | mm
    line: IntArray  # line of the file, (k,)


def read_control(path: Path) -> PointTable:
    """Read known object points: id,X,Y,Z[,sX,sY,sZ]; no sigma or 0 means fixed.

    Raises:
        SurveyFileError: unreadable, wrong columns, not a finite number, a duplicate id, a negative sigma, or
            one that is so small beside the coordinates that its unit must be another.
    """
    table = read_table(path, ("id",), ("X", "Y", "Z"), ("sX", "sY", "sZ"), aliases=(("point", "id"),))
    xyz, sigma = table.values[:, :3], table.values[:, 3:]
    if not sigma.size:
        sigma = np.zeros_like(xyz)
    columns = ("sX", "sY", "sZ")
    table.refuse(sigma, sigma < 0, columns, "0 (fixed) or more")
    extent = float(np.ptp(xyz, axis=0).max())
    table.refuse(
        sigma,
        (sigma > 0) & (sigma * MAX_EXTENT_PER_SIGMA < extent),
        columns,
        f"at least a millionth of the extent of the points, {extent:g}: coordinates and sigmas in one unit; "
        "0 for a fixed coordinate",
    )
    return PointTable(table.keys("id"), xyz, sigma)


def read_diameters(path: Path) -> tuple[tuple[str, ...], FloatArray]:
    """Read the diameters of targets: id,diameter.

    Returns:
        Names of the points, and the diameters of their targets, object unit, (n,).

    Raises:
        SurveyFileError: unreadable, wrong columns, not a positive number or a duplicate id.
    """
    table = read_table(path, ("id",), ("diameter",), aliases=(("point", "id"),))
    table.refuse(table.values, table.values < MIN_SIGMA, ("diameter",), "more than 0")
    return table.keys("id"), table.values[:, 0]


def read_points(path: Path) -> PointTable:
    """Read approximate object points: point,X,Y,Z; points.csv of a result is welcome.

    Raises:
        SurveyFileError: unreadable, wrong columns, not a finite number or a duplicate point.
    """
    table = read_table(
        path,
        ("point",),
        ("X", "Y", "Z"),
        aliases=(("id", "point"),),
        ignored=("sX", "sY", "sZ", "rays", "code"),
    )
    return PointTable(table.keys("point"), table.values, np.zeros_like(table.values))


def read_exterior(path: Path) -> ExteriorTable:
    """Read exterior orientations: image,X,Y,Z,omega_deg,phi_deg,kappa_deg; images.csv of a result is welcome.

    Raises:
        SurveyFileError: unreadable, wrong columns, not a finite number or a duplicate image.
    """
    angles = ("omega_deg", "phi_deg", "kappa_deg")
    ignored = ("camera", "sX", "sY", "sZ", *(f"s{name}" for name in angles), "points", "rms_px")
    table = read_table(path, ("image",), ("X", "Y", "Z", *angles), ignored=ignored)
    rotation = [rotation_from_angles(*row) for row in np.radians(table.values[:, 3:])]
    return ExteriorTable(
        table.keys("image"), table.values[:, :3], np.reshape(rotation, (-1, 3, 3)), table.line
    )


def read_image_points(path: Path) -> ImagePointTable:
    """Read image points: image,point,x_px,y_px[,sx_px,sy_px] or image,point,x_mm,y_mm[,sx_mm,sy_mm].

    image_points.csv of a result is welcome; its residuals and rejections are passed over, everything is
    taken as measured.

    Raises:
        SurveyFileError: unreadable, wrong columns, not a finite number, a sigma that is not positive, or the
            same point twice in one image.
    """
    unit = "mm" if "x_mm" in read_header(path) else "px"
    sigmas = (f"sx_{unit}", f"sy_{unit}")
    table = read_table(
        path, ("image", "point"), (f"x_{unit}", f"y_{unit}"), sigmas, ignored=("vx_px", "vy_px", "rejected")
    )
    xy, sigma = table.values[:, :2], table.values[:, 2:]
    table.refuse(sigma, sigma < MIN_SIGMA, sigmas, f"more than 0, at least {MIN_SIGMA:g}")
    image, point = table.texts
    table.refuse_duplicates(tuple(zip(image, point, strict=True)), ("image", "point"))
    return ImagePointTable(image, point, xy, sigma if sigma.size else None, unit, table.line)
