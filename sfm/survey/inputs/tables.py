"""The tables that a survey file names (CSV): control, observed exterior orientation, image points, points.

Every refusal names the line and the column; what is true of all tables is in `sfm.files.csv_tables`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sfm.conventions import FloatArray, IntArray, rotation_from_angles
from sfm.errors import SurveyFileError
from sfm.files.csv_tables import CsvTable, read_header, read_table

MIN_SIGMA = 1e-9  # in any unit used here less than an atom
MAX_EXTENT_PER_SIGMA = 1e6  # no control is known to better than a millionth of its extent
FULL_TURN = 360.0  # deg
LEAST_COS_PHI = 0.01  # nearer to phi = +-90 deg omega and kappa say nearly the same
AXES, ANGLES = ("X", "Y", "Z"), ("omega_deg", "phi_deg", "kappa_deg")
SIGMAS_OF_AXES, SIGMAS_OF_ANGLES = ("sX", "sY", "sZ"), ("somega_deg", "sphi_deg", "skappa_deg")


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
class ObservedExteriorTable:
    """Observed exterior orientations of exterior.csv: X0, Y0, Z0 in the object unit, angles in rad."""

    names: tuple[str, ...]  # photographs, (e,)
    value: FloatArray  # X0, Y0, Z0, omega, phi, kappa; NaN where not observed, (e, 6)
    sigma: FloatArray  # standard deviations, 0 = fixed, infinite where not observed, (e, 6)
    line: IntArray  # line of the file, (e,)


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
        ignored=("sX", "sY", "sZ", "rays", "code", "angle_deg", "rms_px"),
    )
    return PointTable(table.keys("point"), table.values, np.zeros_like(table.values))


def read_exterior(path: Path) -> ExteriorTable:
    """Read exterior orientations: image,X,Y,Z,omega_deg,phi_deg,kappa_deg; images.csv of a result is welcome.

    Raises:
        SurveyFileError: unreadable, wrong columns, not a finite number or a duplicate image.
    """
    ignored = ("camera", *SIGMAS_OF_AXES, *SIGMAS_OF_ANGLES, "points", "rms_px", "coverage")
    table = read_table(path, ("image",), (*AXES, *ANGLES), ignored=ignored)
    rotation = [rotation_from_angles(*row) for row in np.radians(table.values[:, 3:])]
    return ExteriorTable(
        table.keys("image"), table.values[:, :3], np.reshape(rotation, (-1, 3, 3)), table.line
    )


def read_observed_exterior(path: Path) -> ObservedExteriorTable:
    """Read observed exterior orientations; images.csv of a result is welcome.

    Columns are image,X,Y,Z[,sX,sY,sZ][,omega_deg,phi_deg,kappa_deg[,somega_deg,sphi_deg,skappa_deg]]. An
    empty cell means not observed; no column of sigma, or a sigma of 0, means fixed.

    Raises:
        SurveyFileError: unreadable, wrong columns, not a finite number, a duplicate image, a sigma that is
            negative or stands alone or is missing, one so small that its unit must be another, angles of
            which only some are fixed, or that cannot be told apart.
    """
    header = read_header(path)
    sigmas_of_axes = SIGMAS_OF_AXES if any(name in header for name in SIGMAS_OF_AXES) else ()
    sigmas_of_angles = SIGMAS_OF_ANGLES if any(name in header for name in SIGMAS_OF_ANGLES) else ()
    angles = ANGLES if any(name in header for name in (*ANGLES, *sigmas_of_angles)) else ()
    columns = (*AXES, *sigmas_of_axes, *angles, *sigmas_of_angles)
    aliases = (("photograph", "image"), ("X0", "X"), ("Y0", "Y"), ("Z0", "Z"))
    table = read_table(
        path,
        ("image",),
        columns,
        tuple(name for name in (*SIGMAS_OF_AXES, *ANGLES, *SIGMAS_OF_ANGLES) if name not in columns),
        aliases=aliases,
        ignored=("camera", "points", "rms_px", "coverage"),
        blank=columns,
    )
    value, sigma = np.full((len(table.line), 6), np.nan), np.full((len(table.line), 6), np.inf)
    for place, names, sigmas in ((0, AXES, sigmas_of_axes), (3, angles, sigmas_of_angles)):
        for k, name in enumerate(names):
            given = table.values[:, columns.index(name)]
            own = (
                table.values[:, columns.index(sigmas[k])] if sigmas else np.where(np.isnan(given), given, 0.0)
            )
            _refuse_halves(table, given, own, name, sigmas[k] if sigmas else "")
            value[:, place + k], sigma[:, place + k] = given, np.where(np.isnan(own), np.inf, own)
    _refuse_impossible(table, value, sigma)
    value[:, 3:], sigma[:, 3:] = np.radians(value[:, 3:]), np.radians(sigma[:, 3:])
    return ObservedExteriorTable(table.keys("image"), value, sigma, table.line)


def _refuse_halves(table: CsvTable, given: FloatArray, sigma: FloatArray, name: str, sigma_name: str) -> None:
    """Refuse a value without its sigma and a sigma without its value."""
    for k in np.flatnonzero(np.isnan(given) != np.isnan(sigma))[:1]:
        empty, other = (name, sigma_name) if np.isnan(given[k]) else (sigma_name, name)
        raise SurveyFileError(
            f"{table.path}, line {table.line[k]}: column {empty} is empty beside a value in {other}; needed "
            "both, sigma 0 for a fixed value, or neither for one that was not observed"
        )


def _refuse_impossible(table: CsvTable, value: FloatArray, sigma: FloatArray) -> None:
    """Refuse observed orientations (degrees) that no adjustment can take as they stand."""
    columns = (*SIGMAS_OF_AXES, *SIGMAS_OF_ANGLES)
    table.refuse(sigma, sigma < 0, columns, "0 (fixed) or more")
    known = value[np.isfinite(value[:, :3]).all(axis=1), :3]
    extent = float(np.ptp(known, axis=0).max()) if len(known) else 0.0
    least = np.array([max(MIN_SIGMA, extent / MAX_EXTENT_PER_SIGMA)] * 3 + [MIN_SIGMA] * 3)
    table.refuse(
        sigma,
        (sigma > 0) & (sigma < least),
        columns,
        f"at least {least[0]:.3g} (of angles {MIN_SIGMA:g} deg), or 0 for a fixed value: coordinates and "
        "sigmas are in the object unit, angles in degrees",
    )
    angles = value[:, 3:]
    table.refuse(angles, np.abs(angles) > FULL_TURN, ANGLES, f"degrees, at most {FULL_TURN:g}")
    fixed = sigma[:, 3:] == 0
    some = fixed & ~fixed.all(axis=1, keepdims=True)
    table.refuse(sigma[:, 3:], some, SIGMAS_OF_ANGLES, "omega, phi, kappa fixed together or none of them")
    phi = np.abs(np.cos(np.radians(angles[:, 1]))) < LEAST_COS_PHI
    table.refuse(
        angles,
        phi[:, None] & np.array([False, True, False]),
        ANGLES,
        "another than +-90, where omega and kappa cannot be told apart; leave the three angles empty",
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
