"""Observed exterior orientation of a survey, by satellite positioning, a tracker or known stations.

The same tables give the mounts of cameras on rigs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from sfm.files.csv_tables import CsvTable, array_table, read_header, read_table
from sfm.model.conventions import FloatArray
from sfm.model.display import listed
from sfm.model.errors import SurveyFileError
from sfm.model.observations.pose import MountObservations
from sfm.survey.inputs.given_values import (
    ANGLES,
    AXES,
    SIGMAS_OF_ANGLES,
    SIGMAS_OF_AXES,
    columns_of,
    refuse_tiny_sigmas,
)
from sfm.survey.inputs.settings import RigSettings

FULL_TURN = 360.0  # deg
MIN_COS_PHI = 0.01  # closer to phi = +-90 deg, omega and kappa describe nearly the same rotation


@dataclass(frozen=True)
class ObservedExterior:
    """Observed exterior orientations: X0, Y0, Z0 in the object unit, angles in rad.

    Example:
        >>> import sfm
        >>> sfm.ObservedExterior.from_arrays(["a.jpg"], [[10, 20, 30]], 0.02).sigma[0]
        array([0.02, 0.02, 0.02,  inf,  inf,  inf])
    """

    names: tuple[str, ...]  # photographs, (e,)
    value: FloatArray  # X0, Y0, Z0, omega, phi, kappa; NaN where not observed, (e, 6)
    sigma: FloatArray  # standard deviations, 0 = fixed, infinite where not observed, (e, 6)
    table: CsvTable  # their table, for error messages

    @classmethod
    def from_arrays(
        cls,
        names: Sequence[str],
        position: npt.ArrayLike,
        position_sigma: npt.ArrayLike = 0.0,
        angles_deg: npt.ArrayLike = np.nan,
        angles_sigma_deg: npt.ArrayLike = 0.0,
    ) -> ObservedExterior:
        """Return observed exterior orientations from arrays.

        Args:
            names: e unique names of the photographs.
            position: projection centres, object unit; NaN = not observed, (e, 3).
            position_sigma: their standard deviations, 0 = fixed, object unit, (e, 3) or broadcastable to it.
            angles_deg: omega, phi, kappa, degrees; NaN = not observed, (e, 3).
            angles_sigma_deg: their standard deviations, 0 = fixed, degrees, (e, 3) or broadcastable to it.

        Raises:
            SurveyFileError: as in `read_observed_exterior`.
        """
        what, names_of_columns = "observed exterior", (*AXES, *ANGLES, *SIGMAS_OF_AXES, *SIGMAS_OF_ANGLES)
        given = [(position, 3), (angles_deg, 3), (position_sigma, 3), (angles_sigma_deg, 3)]
        columns = columns_of(what, names_of_columns, len(names), *given)
        for name, sigma in zip((*AXES, *ANGLES), (*SIGMAS_OF_AXES, *SIGMAS_OF_ANGLES), strict=True):
            columns[sigma] = np.where(np.isnan(columns[name]), np.nan, columns[sigma])
        table = array_table(what, {"image": names}, columns, blank=names_of_columns)
        return _observed_exterior(table, table.values[:, :6], table.values[:, 6:])


def read_observed_exterior(path: Path, *, of: str = "image") -> ObservedExterior:
    """Read observed exterior orientations; images.csv of a result is accepted too.

    Columns are image,X,Y,Z[,sX,sY,sZ][,omega_deg,phi_deg,kappa_deg[,somega_deg,sphi_deg,skappa_deg]]. An
    empty cell means not observed. No column of sigma, or a sigma of 0, means fixed.

    Args:
        path: path of the table.
        of: name of its first column: "image" for photographs, or "camera" for mounts.

    Raises:
        SurveyFileError: the table is unreadable or has wrong columns, a number that is not finite, a
            duplicate image, a sigma without a value or a value without a sigma, a sigma that is negative or
            so small that its unit must be wrong, angles of which only some are fixed, or angles that cannot
            be distinguished.
    """
    header = read_header(path)
    sigmas_of_axes = SIGMAS_OF_AXES if any(name in header for name in SIGMAS_OF_AXES) else ()
    sigmas_of_angles = SIGMAS_OF_ANGLES if any(name in header for name in SIGMAS_OF_ANGLES) else ()
    angles = ANGLES if any(name in header for name in (*ANGLES, *sigmas_of_angles)) else ()
    columns = (*AXES, *sigmas_of_axes, *angles, *sigmas_of_angles)
    aliases = ((of, "image"), ("photograph", "image"), ("X0", "X"), ("Y0", "Y"), ("Z0", "Z"))
    table = read_table(
        path,
        ("image",),
        columns,
        tuple(name for name in (*SIGMAS_OF_AXES, *ANGLES, *SIGMAS_OF_ANGLES) if name not in columns),
        aliases=aliases,
        ignored=("camera", "rig", "points", "rms_px", "coverage"),
        blank=columns,
    )
    value, sigma = np.full((len(table.line), 6), np.nan), np.full((len(table.line), 6), np.nan)
    for place, names, sigmas in ((0, AXES, sigmas_of_axes), (3, angles, sigmas_of_angles)):
        for k, name in enumerate(names):
            given = table.values[:, columns.index(name)]
            deviation = (
                table.values[:, columns.index(sigmas[k])] if sigmas else np.where(np.isnan(given), given, 0.0)
            )
            for row in np.flatnonzero(np.isnan(given) != np.isnan(deviation))[:1]:
                halves = name, sigmas[k] if sigmas else ""
                empty, other = halves if np.isnan(given[row]) else halves[::-1]
                raise SurveyFileError(
                    f"{table.place(row)}: column {empty} is empty beside a value in {other}; needed "
                    "both, sigma 0 for a fixed value, or neither for one that was not observed"
                )
            value[:, place + k], sigma[:, place + k] = given, deviation
    return _observed_exterior(table, value, sigma, of)


def _observed_exterior(
    table: CsvTable, value: FloatArray, sigma: FloatArray, of: str = "image"
) -> ObservedExterior:
    """Return observed orientations from values and sigmas in degrees, NaN if not observed, (e, 6)."""
    sigma = np.where(np.isnan(sigma), np.inf, sigma)
    _refuse_impossible(table, value, sigma)
    names = table.texts[table.names.index("image")]
    table.refuse_duplicates(names, (of,))
    value, sigma = value.copy(), sigma.copy()
    value[:, 3:], sigma[:, 3:] = np.radians(value[:, 3:]), np.radians(sigma[:, 3:])
    return ObservedExterior(names, value, sigma, table)


def mount_observations(
    tables: Sequence[ObservedExterior], rigs: Sequence[RigSettings], cameras: Sequence[str]
) -> MountObservations:
    """Return the mounts from the tables of rigs.

    Args:
        tables: positions and angles of cameras in the axes of their rigs.
        rigs: rigs of the survey.
        cameras: names of all cameras of the survey.

    Raises:
        SurveyFileError: a mount of a camera that is on no rig or the reference of a rig, or a mount with
            missing values or only some values held fixed.
    """
    number = {name: a for a, name in enumerate(cameras)}
    mounted = {name for rig in rigs for name in rig.cameras[1:]}
    references = {rig.cameras[0] for rig in rigs}
    mounted_cameras: list[int] = []
    rows: list[tuple[FloatArray, FloatArray]] = []
    for table in tables:
        for k, name in enumerate(table.names):
            if name in references and not table.value[k].any() and not table.sigma[k].any():
                continue
            if name not in mounted:
                usable = listed(sorted(mounted))
                raise SurveyFileError(
                    f"{table.table.place(k)}: camera '{name}' is on no rig, or is the reference camera of "
                    f"one; needed {usable}"
                )
            sigma = table.sigma[k]
            if not np.isfinite(sigma).all() or ((sigma == 0).any() and (sigma > 0).any()):
                raise SurveyFileError(
                    f"{table.table.place(k)}: camera '{name}': needed all six values, held fixed (sigma 0) "
                    "together or none of them"
                )
            mounted_cameras.append(number[name])
            rows.append((table.value[k], sigma))
    value, sigma = np.array(rows).reshape(-1, 2, 6).swapaxes(0, 1)
    covariance = np.eye(6) * sigma[:, None, :] ** 2
    return MountObservations(
        np.array(mounted_cameras, dtype=np.int64), value[:, :3], value[:, 3:], covariance
    )


def _refuse_impossible(table: CsvTable, value: FloatArray, sigma: FloatArray) -> None:
    """Refuse observed orientations (degrees) that no adjustment can use."""
    columns = (*SIGMAS_OF_AXES, *SIGMAS_OF_ANGLES)
    table.refuse(sigma, sigma < 0, columns, "0 (fixed) or more")
    known = value[np.isfinite(value[:, :3]).all(axis=1), :3]
    extent = float(np.ptp(known, axis=0).max()) if len(known) else 0.0
    of_angles = "; angles in degrees, 0 for a fixed value"
    refuse_tiny_sigmas(table, sigma, columns, np.repeat([extent, 0.0], 3), or_else=of_angles)
    angles = value[:, 3:]
    table.refuse(angles, np.abs(angles) > FULL_TURN, ANGLES, f"degrees, at most {FULL_TURN:g}")
    fixed = sigma[:, 3:] == 0
    partly = fixed & ~fixed.all(axis=1, keepdims=True)
    table.refuse(sigma[:, 3:], partly, SIGMAS_OF_ANGLES, "omega, phi, kappa fixed together or none of them")
    phi = np.abs(np.cos(np.radians(angles[:, 1]))) < MIN_COS_PHI
    table.refuse(
        angles,
        phi[:, None] & np.array([False, True, False]),
        ANGLES,
        "another than +-90, where omega and kappa cannot be distinguished; leave the three angles empty",
    )
