"""Input of a survey besides photographs: control, image points, diameters and start values.

Each kind is a frozen dataclass. A function `read_...` makes it from a CSV file, and `from_arrays` from
arrays. Both refuse the same faults, and state the line or row and the column. `sfm.files.csv_tables` has the
rules of all tables.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import compress
from pathlib import Path

import numpy as np
import numpy.typing as npt

from sfm.files.csv_tables import MAX_NUMBER, CsvTable, array_table, read_header, read_table
from sfm.model.conventions import BoolArray, FloatArray, rotation_from_angles
from sfm.model.errors import SurveyFileError
from sfm.model.reduced_network import CORRELATION_LIMIT, possible_covariances

MIN_SIGMA = 1e-9  # less than an atom in any unit used here
MAX_EXTENT_PER_SIGMA = 1e6  # no length or position is known to better than a millionth of its extent
CHECKS = ("checkX", "checkY", "checkZ")  # of control: 1 for a coordinate that is only a check
COVARIANCES = ("cXY", "cXZ", "cYZ")  # of control, object unit^2
AXES, ANGLES = ("X", "Y", "Z"), ("omega_deg", "phi_deg", "kappa_deg")
SEEN_OF_POINTS = ("rays", "code", "angle_deg", "rms_px", "limiting_sX", "limiting_sY", "limiting_sZ")
SIGMAS_OF_AXES, SIGMAS_OF_ANGLES = ("sX", "sY", "sZ"), ("somega_deg", "sphi_deg", "skappa_deg")


@dataclass(frozen=True)
class KnownPoints:
    """Object points known beforehand: control, or start values.

    Example:
        >>> import sfm
        >>> control = sfm.KnownPoints.from_arrays(["501", "502"], [[0, 0, 0], [1000, 0, 0]], sigma=0.05)
        >>> control.sigma
        array([[0.05, 0.05, 0.05],
               [0.05, 0.05, 0.05]])
    """

    names: tuple[str, ...]  # (n,)
    xyz: FloatArray  # object unit, NaN for an unknown coordinate, (n, 3)
    sigma: FloatArray  # standard deviations, 0 = fixed, infinite = unknown, object unit, (n, 3)
    covariances: FloatArray | None = None  # of X and Y, X and Z, Y and Z, object unit^2, 0 if None, (n, 3)
    check: BoolArray | None = None  # coordinates that are not adjusted but check the result, (n, 3)

    def __post_init__(self) -> None:
        """Refuse impossible standard deviations and covariances.

        Raises:
            SurveyFileError: the message states the name of the point.
        """
        good: BoolArray = np.asarray((self.sigma >= 0).all(axis=1))
        good[good] = possible_covariances(self.covariance[good])
        for name, possible in zip(self.names, good.tolist(), strict=True):
            if not possible:
                raise SurveyFileError(
                    f"control point {name}: expected sigmas of 0 (fixed) or more and covariances that make a "
                    "positive definite matrix with them"
                )

    @property
    def covariance(self) -> FloatArray:
        """Covariance matrices, object unit^2; variance 0 = fixed, infinite = unknown, (n, 3, 3)."""
        C = np.zeros((len(self.names), 3, 3))
        C[:, range(3), range(3)] = self.sigma**2
        if self.covariances is not None:
            for k, (row, column) in enumerate(((0, 1), (0, 2), (1, 2))):
                C[:, row, column] = C[:, column, row] = self.covariances[:, k]
        return C

    @property
    def only_checks(self) -> bool:
        """Whether all known coordinates check the result, and none is adjusted."""
        return self.check is not None and bool((self.check | ~np.isfinite(self.xyz)).all())

    def select(self, rows: BoolArray) -> KnownPoints:
        """Return some of the points."""
        return replace(
            self,
            names=tuple(compress(self.names, rows)),
            xyz=self.xyz[rows],
            sigma=self.sigma[rows],
            covariances=None if self.covariances is None else self.covariances[rows],
            check=None if self.check is None else self.check[rows],
        )

    @classmethod
    def from_arrays(cls, names: Sequence[str], xyz: npt.ArrayLike, sigma: npt.ArrayLike = 0.0) -> KnownPoints:
        """Return points from arrays.

        Args:
            names: n unique names of the points.
            xyz: coordinates, object unit, NaN where unknown, (n, 3).
            sigma: standard deviations, 0 = fixed, object unit, (n, 3) or broadcastable to it.

        Raises:
            SurveyFileError: as in `read_control`.
        """
        columns = columns_of("control", (*AXES, *SIGMAS_OF_AXES), len(names), (xyz, 3), (sigma, 3))
        return known_points(array_table("control", {"id": names}, columns, blank=AXES))


@dataclass(frozen=True)
class StartOrientations:
    """Approximate exterior orientations, as in images.csv of a result."""

    names: tuple[str, ...]  # photographs, (m,)
    position: FloatArray  # projection centres X0, object unit, (m, 3)
    rotation: FloatArray  # R, image to object axes, (m, 3, 3)
    table: CsvTable  # their table, for error messages

    @classmethod
    def from_arrays(
        cls, names: Sequence[str], position: npt.ArrayLike, angles_deg: npt.ArrayLike
    ) -> StartOrientations:
        """Return start values from arrays.

        Args:
            names: m unique names of the photographs.
            position: projection centres, object unit, (m, 3).
            angles_deg: omega, phi, kappa, degrees, (m, 3).
        """
        columns = columns_of("start values", (*AXES, *ANGLES), len(names), (position, 3), (angles_deg, 3))
        return _start_orientations(array_table("start values", {"image": names}, columns))


@dataclass(frozen=True)
class StartCameras:
    """Approximate values of interior orientation, as in cameras.csv of a result."""

    camera: tuple[str, ...]  # camera of each row, or its photograph or group with separate values, (k,)
    parameter: tuple[str, ...]  # (k,)
    value: FloatArray  # in the parameter's unit, (k,)
    table: CsvTable  # their table, for error messages

    def of(self, camera: str) -> dict[str, float]:
        """Return the values of one camera, by parameter."""
        rows = zip(self.camera, self.parameter, self.value.tolist(), strict=True)
        return {parameter: value for name, parameter, value in rows if name == camera}


@dataclass(frozen=True)
class Observations:
    """Measured image points, in place of photographs or beside them.

    Example:
        >>> import sfm
        >>> seen = sfm.Observations.from_arrays(["a.jpg", "b.jpg"], ["1", "1"], [[10.5, 20.0], [30.0, 41.5]])
        >>> seen.unit, len(seen.xy)
        ('px', 2)
    """

    image: tuple[str, ...]  # photograph of each row, (k,)
    point: tuple[str, ...]  # point of each row, (k,)
    # px in the pixel frame, mm in the image frame, or x and y (down) from the middle in longer sides, (k, 2)
    xy: FloatArray
    sigma: FloatArray | None  # standard deviations in the same unit, NaN if not given, (k, 2); or None
    unit: str  # px | mm | of the longer side
    table: CsvTable  # their table, for error messages
    covariance: FloatArray | None = None  # of x and y in the square of the unit, 0 if None, (k,)
    sigma_px: float | None = None  # of rows without standard deviations; None: that of the survey
    names_last: bool = True  # whether points keep their names, or are matches that are numbered anew
    of_control: bool = False  # whether control has them, whose photographs may not be those of the survey

    def __len__(self) -> int:
        return len(self.point)

    def select(self, rows: BoolArray) -> Observations:
        """Return some of the image points."""
        return replace(
            self,
            image=tuple(compress(self.image, rows)),
            point=tuple(compress(self.point, rows)),
            xy=self.xy[rows],
            sigma=None if self.sigma is None else self.sigma[rows],
            table=self.table.select(rows),
            covariance=None if self.covariance is None else self.covariance[rows],
        )

    @classmethod
    def from_arrays(
        cls,
        image: Sequence[str],
        point: Sequence[str],
        xy: npt.ArrayLike,
        sigma: npt.ArrayLike | None = None,
        *,
        unit: str = "px",
    ) -> Observations:
        """Return measured image points from arrays.

        Args:
            image: name of the photograph of each of k rows.
            point: name of the point of each row.
            xy: positions, px in the pixel frame or mm in the image frame, (k, 2).
            sigma: standard deviations in the same unit, (k, 2) or broadcastable to it; the survey's sigma_px
                if not given.
            unit: px or mm.

        Raises:
            SurveyFileError: as in `read_image_points`, or an unknown unit.
        """
        if unit not in ("px", "mm"):
            raise SurveyFileError(f"observations: unit '{unit}', expected px or mm")
        names = (f"x_{unit}", f"y_{unit}", f"sx_{unit}", f"sy_{unit}")
        given = [(xy, 2)] if sigma is None else [(xy, 2), (sigma, 2)]
        columns = columns_of("observations", names[: 2 * len(given)], len(image), *given)
        return _observations(array_table("observations", {"image": image, "point": point}, columns), unit)


@dataclass(frozen=True)
class Diameters:
    """Known diameters of single targets."""

    names: tuple[str, ...]  # of the targets, (n,)
    diameter: FloatArray  # object unit, (n,)
    source: str  # name of the table, for error messages


@dataclass(frozen=True)
class ScaleBar:
    """A measured distance between two object points.

    Example:
        >>> import sfm
        >>> sfm.ScaleBar("506", "507", 1389.688, 0.010)
        ScaleBar(start='506', end='507', length=1389.688, sigma=0.01)
    """

    start: str  # name of the first point
    end: str  # name of the second point
    length: float  # object unit
    sigma: float  # standard deviation, object unit
    table: int = field(default=0, repr=False)  # number of the table of distances, 0: of none

    def __post_init__(self) -> None:
        for what, value in (("length", self.length), ("sigma", self.sigma)):
            if not MIN_SIGMA <= value <= MAX_NUMBER:
                raise SurveyFileError(
                    f"scale bar {self.start} - {self.end}: {what} {value}, needed more than 0"
                )


def read_control(path: Path) -> KnownPoints:
    """Read known object points: id,X,Y,Z[,sX,sY,sZ[,cXY,cXZ,cYZ][,checkX,checkY,checkZ]].

    No sigma, or a sigma of 0, means fixed. Coordinates with 1 in checkX, checkY or checkZ are not adjusted,
    but check the result. An empty cell among X, Y, Z means an unknown coordinate, and its sigma is ignored.
    cXY, cXZ and cYZ are covariances; empty or 0 means none.

    Raises:
        SurveyFileError: the table is unreadable or has wrong columns, a cell is not a finite number, an id
            occurs twice, a sigma is negative or so small that its unit must differ from that of the
            coordinates, or a covariance is larger than the sigmas allow.
    """
    header = read_header(path)
    covariances = COVARIANCES if COVARIANCES[0] in header else ()
    checks = CHECKS if CHECKS[0] in header else ()
    more = (*covariances, *checks)
    table = read_table(
        path,
        ("id",),
        AXES,
        optional=(*SIGMAS_OF_AXES, *more),
        aliases=(("point", "id"),),
        blank=(*AXES, *SIGMAS_OF_AXES, *more),
    )
    return known_points(table, len(covariances))


def refuse_tiny_sigmas(
    table: CsvTable, sigma: FloatArray, columns: tuple[str, ...], size: FloatArray, *, or_else: str = ""
) -> None:
    """Raise SurveyFileError for a standard deviation that no measurement has.

    Args:
        table: table of the standard deviations.
        sigma: standard deviations, in the units of the table, those of 0 are left to the caller, (n, d).
        columns: names of their columns.
        size: lengths, or extents of positions, that the standard deviations belong to, in the unit of the
            table; 0 for angles, (n, d) or (d,).
        or_else: what may be given in place of a standard deviation, for the error message.
    """
    least = np.broadcast_to(np.maximum(MIN_SIGMA, np.abs(size) / MAX_EXTENT_PER_SIGMA), sigma.shape)
    tiny: BoolArray = (sigma > 0) & (sigma < least)
    for k, c in np.argwhere(tiny)[:1]:
        of = ", a millionth of the length or extent" if least[k, c] > MIN_SIGMA else ""
        needed = f"at least {least[k, c]:.3g}{of}: values and sigmas in one unit{or_else}"
        table.refuse(sigma, tiny, columns, needed)


def known_points(table: CsvTable, covariances: int = 0) -> KnownPoints:
    """Return the points of a table that may have sigmas, `covariances` columns of covariances, and checks.

    Args:
        table: id, and X, Y, Z with these further columns.
        covariances: number of columns of covariances.

    Raises:
        SurveyFileError: as in `read_control`.
    """
    xyz, sigma, mixed, check = np.split(table.values, (3, 6, 6 + covariances), axis=1)
    if not sigma.size:
        sigma = np.zeros_like(xyz)
    unknown: BoolArray = np.isnan(xyz)
    table.refuse(
        xyz, unknown & unknown.all(axis=1, keepdims=True), AXES, "at least one coordinate of a point"
    )
    table.refuse(sigma, np.isnan(sigma) & ~unknown, SIGMAS_OF_AXES, "a number where the coordinate is given")
    sigma = np.where(unknown, np.inf, sigma)
    table.refuse(sigma, sigma < 0, SIGMAS_OF_AXES, "0 (fixed) or more")
    extent = max(float(np.ptp(axis[np.isfinite(axis)])) for axis in xyz.T if np.isfinite(axis).any())
    refuse_tiny_sigmas(table, sigma, SIGMAS_OF_AXES, np.full(3, extent), or_else="; 0 for a fixed coordinate")
    check = np.nan_to_num(check) if check.size else np.zeros_like(xyz)
    table.refuse(check, (check != 0) & (check != 1), CHECKS, "0, 1 or nothing")
    table.refuse(check, (check == 1) & unknown, CHECKS, "0 or nothing for a coordinate that is not known")
    names, mixed_or_none = table.keys("id"), _covariances(table, sigma, mixed)
    try:
        return KnownPoints(names, xyz, sigma, mixed_or_none, check == 1 if check.any() else None)
    except SurveyFileError as error:
        raise SurveyFileError(f"{table.path}: {error}") from None


def _covariances(table: CsvTable, sigma: FloatArray, given: FloatArray) -> FloatArray | None:
    """Return the covariances of control, 0 for empty cells; None without covariances.

    Raises:
        SurveyFileError: a covariance of a fixed or unknown coordinate, or an impossibly large one.
    """
    if not given.size:
        return None
    given = np.nan_to_num(given)
    pairs = sigma[:, [0, 0, 1]] * sigma[:, [1, 2, 2]]
    usable = np.isfinite(pairs) & (pairs > 0)
    table.refuse(given, (given != 0) & ~usable, COVARIANCES, "0 or empty for a coordinate fixed or not known")
    table.refuse(
        given,
        np.abs(given) > CORRELATION_LIMIT * np.where(usable, pairs, np.inf),
        COVARIANCES,
        "a correlation below 1 with the sigmas of the row",
    )
    return given


def read_diameters(path: Path) -> Diameters:
    """Read the diameters of targets: id,diameter, object unit.

    Raises:
        SurveyFileError: the table is unreadable or has wrong columns, a number that is not positive, or a
            duplicate id.
    """
    table = read_table(path, ("id",), ("diameter",), aliases=(("point", "id"),))
    table.refuse(table.values, table.values < MIN_SIGMA, ("diameter",), "more than 0")
    return Diameters(table.keys("id"), table.values[:, 0], path.name)


def read_points(path: Path) -> KnownPoints:
    """Read approximate object points: point,X,Y,Z; points.csv of a result is accepted too.

    Raises:
        SurveyFileError: the table is unreadable or has wrong columns, a number that is not finite, or a
            duplicate point.
    """
    table = read_table(
        path,
        ("point",),
        ("X", "Y", "Z"),
        aliases=(("id", "point"),),
        ignored=(*SIGMAS_OF_AXES, *SEEN_OF_POINTS),
    )
    return KnownPoints(table.keys("point"), table.values, np.zeros_like(table.values))


def read_exterior(path: Path) -> StartOrientations:
    """Read exterior orientations: image,X,Y,Z,omega_deg,phi_deg,kappa_deg.

    images.csv of a result is accepted too.

    Raises:
        SurveyFileError: the table is unreadable or has wrong columns, a number that is not finite, or a
            duplicate image.
    """
    ignored = ("camera", *SIGMAS_OF_AXES, *SIGMAS_OF_ANGLES, "points", "rms_px", "coverage")
    return _start_orientations(read_table(path, ("image",), (*AXES, *ANGLES), ignored=ignored))


def _start_orientations(table: CsvTable) -> StartOrientations:
    """Return the orientations of a table with angles in degrees."""
    rotation = [rotation_from_angles(*row) for row in np.radians(table.values[:, 3:])]
    return StartOrientations(
        table.keys("image"), table.values[:, :3], np.reshape(rotation, (-1, 3, 3)), table
    )


def read_start_cameras(path: Path) -> StartCameras:
    """Read interior orientation: camera,parameter,value; cameras.csv of a result is accepted too.

    Raises:
        SurveyFileError: the table is unreadable or has wrong columns, a number that is not finite, or a
            parameter of a camera twice.
    """
    table = read_table(path, ("camera", "parameter"), ("value",), ignored=("sigma", "unit"))
    camera, parameter = table.texts
    table.refuse_duplicates(tuple(zip(camera, parameter, strict=True)), ("camera", "parameter"))
    return StartCameras(camera, parameter, table.values[:, 0], table)


def read_image_points(path: Path) -> Observations:
    """Read image points: image,point,x_px,y_px[,sx_px,sy_px[,cxy_px2]], or with mm in place of px.

    Unknown sigmas may be empty. cxy is the covariance of x and y; empty or 0 means none.
    `sfm.survey.sources.repeated` treats points that occur twice in an image.

    image_points.csv of a result is accepted too. Its residuals and rejections are ignored, and all its image
    points are taken as measured.

    Raises:
        SurveyFileError: the table is unreadable or has wrong columns, a number that is not finite, or a sigma
            that is not positive.
    """
    unit = "mm" if "x_mm" in read_header(path) else "px"
    sigmas: tuple[str, ...] = (f"sx_{unit}", f"sy_{unit}")
    if f"cxy_{unit}2" in read_header(path):
        sigmas += (f"cxy_{unit}2",)
    table = read_table(
        path,
        ("image", "point"),
        (f"x_{unit}", f"y_{unit}"),
        sigmas,
        ignored=("vx_px", "vy_px", "rejected", "source"),
        blank=sigmas,
    )
    return _observations(table, unit)


def _observations(table: CsvTable, unit: str) -> Observations:
    """Return the image points of a table that may have sigmas and covariances."""
    xy, sigma, covariance = np.split(table.values, (2, 4), axis=1)
    sigmas = (f"sx_{unit}", f"sy_{unit}")
    table.refuse(sigma, sigma < MIN_SIGMA, sigmas, f"more than 0, at least {MIN_SIGMA:g}")
    table.refuse(
        sigma,
        np.isnan(sigma) != np.isnan(sigma[:, ::-1]),
        sigmas,
        "both standard deviations of an image point or none",
    )
    covariance = np.nan_to_num(covariance)
    table.refuse(
        covariance,
        (covariance != 0) & ~(np.abs(covariance) <= CORRELATION_LIMIT * sigma.prod(axis=1, keepdims=True)),
        (f"cxy_{unit}2",),
        "a correlation below 1 with the sigmas of the row",
    )
    image, point = table.texts
    stated = sigma if np.isfinite(sigma).any() else None
    between = covariance[:, 0] if covariance.any() else None
    return Observations(image, point, xy, stated, unit, table, between)


def columns_of(
    what: str, names: tuple[str, ...], rows: int, *given: tuple[npt.ArrayLike, int]
) -> dict[str, FloatArray]:
    """Return arrays as named columns.

    Args:
        what: name of the table in error messages.
        names: names of the columns.
        rows: number of rows.
        *given: (array, number of its columns), in the order of the names.

    Raises:
        SurveyFileError: an array has another shape.
    """
    columns: list[FloatArray] = []
    for values, width in given:
        try:
            columns += list(np.broadcast_to(np.asarray(values, dtype=float), (rows, width)).T)
        except (TypeError, ValueError) as error:
            name = ", ".join(names[len(columns) : len(columns) + width])
            raise SurveyFileError(
                f"{what}: {name} have the shape {np.shape(values)}, expected numbers ({rows}, {width})"
            ) from error
    return dict(zip(names, columns, strict=True))
