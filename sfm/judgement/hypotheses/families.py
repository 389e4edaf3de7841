"""Families of alternatives: a class for each, with the columns that it frees, its remark and displacements.

A new family needs a class here, and a line in `sfm.judgement.hypotheses.alternatives` that tests it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.judgement.hypotheses.columns import (
    BENDING_PLACES,
    CAMERA,
    CAMERA_PLACES,
    CAMERA_ROLES,
    STRAIN_PLACES,
    Columns,
    interior_columns,
    object_fields,
    rigid_motions,
)
from sfm.judgement.hypotheses.score import (
    NO_GAIN,
    NONE,
    Gain,
    Reduced,
    Spread,
    log_f_sf,
    log_likelihood_gain,
    log_probability,
    squares_gained,
)
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.likelihood import price_of
from sfm.model.remarks.row import Quantity
from sfm.model.similarity import without_motions

SEEN_PX = 1e-3  # change of an image coordinate below which no measurement shows it
CELLS = 5  # cells of the format in each direction

Parts = dict[str, str | Iterable[str] | float | tuple[float, str] | Quantity | None]


@dataclass(frozen=True)
class Alternative:
    """One alternative and the result of its score test."""

    family: Family
    pattern: str  # single | split | linear | alternating | group | each | all
    factor: FloatArray  # factor of each photograph, (m,); its run of photographs if `pattern` is each
    gain: Gain = NO_GAIN
    spread: Spread = NONE  # spread of the photographs or points outside the family
    search: float = 0.0  # ln of the number of patterns and sets of points from which it was chosen
    points: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # moved points
    parameters: tuple[tuple[int, int], ...] = ()  # (camera, parameter) freed
    among: BoolArray | None = None  # photographs within which some differ, (m,); None: all
    price: float = 0.0  # q / 2 ln n, plus the search
    redundancy: int = 1  # redundancy of the adjustment
    design_effect: float = 1.0  # factor of correlated errors of neighbours on the gain expected by chance

    def priced(self, reduced: Reduced) -> Alternative:
        """Return the alternative with its price, by the image points that each part of it moves."""
        on, parts = self.factor[reduced.image] != 0, 1
        if self.pattern == "each":
            on, parts = np.ones_like(on), int(self.factor.max()) + 1
        if len(self.points):
            on &= np.isin(reduced.point, self.points)
        price = price_of(self.gain.rank, int(on.sum()) // parts, self.search)
        return replace(self, price=price, redundancy=reduced.redundancy)

    @property
    def log_p(self) -> float:
        """Ln of the probability of its gain by chance."""
        gain, q, r = self.gain.value, self.gain.rank, self.redundancy
        log_p = log_probability(gain / self.design_effect, q, r)
        if self.spread.factor > 1 and q:
            log_p = max(log_p, log_f_sf(self.spread.ratio(gain, q, r), q, self.spread.redundancy))
        return log_p

    @property
    def evidence(self) -> float:
        """Gain of ln likelihood minus the price."""
        grows = self.spread.evidence(self.gain.value, self.gain.rank, self.redundancy)
        return min(grows - self.price, self.evidence_beside_spread)

    @property
    def evidence_beside_spread(self) -> float:
        """Evidence whatever the photographs differ by."""
        return log_likelihood_gain(self.gain.value / self.design_effect, self.redundancy) - self.price

    @property
    def photographs(self) -> IntArray:
        """Photographs that differ from the others: the smaller of the two sets."""
        among = np.ones(len(self.factor), dtype=bool) if self.among is None else self.among
        on = np.flatnonzero(among & (self.factor > 0))
        off = np.flatnonzero(among & (self.factor <= 0))
        return on if len(on) <= len(off) else off

    @property
    def kind(self) -> str:
        """Kind of its remark."""
        kinds = self.family.kinds
        return kinds.get(self.pattern, kinds[""])

    def columns(self, a: Adjustment, columns: Columns) -> FloatArray:
        """Return its columns for all image points of an adjustment, px, (k, 2, q)."""
        return self.family.columns(self, a, columns)

    def whitened(self, reduced: Reduced) -> FloatArray:
        """Return its whitened columns for the accepted image points, (k, 2, q)."""
        return reduced.whiten(self.columns(reduced.adjustment, reduced.columns))

    def deflated(self, gain: float, redundancy: int) -> float:
        """Return a gain of ln likelihood after dividing the gain of v'Pv by the design effect."""
        if self.design_effect == 1:
            return gain
        return log_likelihood_gain(squares_gained(gain, redundancy) / self.design_effect, redundancy)

    def inflated(self, gain: float, redundancy: int) -> float:
        """Return the gain of ln likelihood that is deflated to a given one."""
        if self.design_effect == 1:
            return gain
        return log_likelihood_gain(squares_gained(gain, redundancy) * self.design_effect, redundancy)


@dataclass(frozen=True)
class Family(ABC):
    """A set of columns that may be freed."""

    name: str
    constant: ClassVar[str] = ""  # what it doubts, named where a change would stay unnoticed; "": nothing
    kinds: ClassVar[dict[str, str]]  # kind of its remark by pattern; "": in all other patterns

    @abstractmethod
    def columns(self, alternative: Alternative, a: Adjustment, columns: Columns) -> FloatArray:
        """Return the columns of an alternative for all image points of an adjustment, px, (k, 2, q)."""

    @abstractmethod
    def parts(self, alternative: Alternative, a: Adjustment, beta: FloatArray, unit: str) -> Parts:
        """Return the parts of the remark on an alternative.

        The adjustment is the one with the alternative, and beta are its parameters, (q,).
        """

    def cause(self, alternative: Alternative) -> tuple[object, ...]:
        """Return a key for the cause; of alternatives with the same cause only the best is adjusted."""
        return (self.name,)

    def displaced(self, alternative: Alternative, points: FloatArray, beta: FloatArray) -> FloatArray:
        """Return the displacement of object points in the photographs that differ most, (n, 3)."""
        return np.zeros_like(points)


@dataclass(frozen=True)
class OfPhotographs(Family):
    """Some of the freedoms of a single photograph, see `Columns.freedoms`.

    In the pattern `each`, every photograph or run of photographs has separate parameters; the factors are
    then the numbers of the runs.
    """

    places: tuple[int, ...]  # indices in the freedoms
    of_camera: ClassVar[bool]  # whether the freedoms belong to a camera rather than the object

    def columns(self, alternative: Alternative, a: Adjustment, columns: Columns) -> FloatArray:
        """Return the columns of an alternative for all image points, px, (k, 2, q)."""
        factor = alternative.factor[a.network.image_points.image]
        freedoms = columns.freedoms[:, :, list(self.places)]
        if alternative.pattern != "each":
            return np.asarray(factor[:, None, None] * freedoms)
        D = np.zeros((len(freedoms), 2, int(alternative.factor.max()) + 1, len(self.places)))
        D[np.arange(len(freedoms)), :, factor.astype(np.int64)] = freedoms
        return D.reshape(len(freedoms), 2, -1)


@dataclass(frozen=True)
class CameraFamily(OfPhotographs):
    """Another camera in some photographs."""

    of_camera = True
    constant = "constant cameras"
    kinds: ClassVar[dict[str, str]] = {"": "other_camera", "linear": "camera_drift", "each": "camera_varies"}

    def cause(self, alternative: Alternative) -> tuple[object, ...]:
        """Return a key for the cause: photographs of a camera."""
        if alternative.pattern == "each":
            return ("camera", "each")
        return ("camera", *alternative.photographs.tolist())  # one key for any number of parameters

    def parts(self, alternative: Alternative, a: Adjustment, beta: FloatArray, unit: str) -> Parts:
        """Return the photographs and the differences of c and of the principal point."""
        camera = a.estimate.cameras[a.network.camera[alternative.photographs[0]]]
        half = max(camera.size_px) / 2
        if alternative.pattern == "each":
            varying = camera.plays(*(CAMERA_ROLES[place] for place in self.places))
            varying = varying & camera.free if (varying & camera.free).any() else varying
            of_each = self._of_each(beta.reshape(-1, len(self.places)), half)
            return {**of_each, "parameters": tuple(np.array(camera.names)[varying])}
        linear = alternative.pattern == "linear"
        # the photographs of the remark are those where the factor is 1, or the others
        grows = linear or alternative.factor[alternative.photographs[0]] > 0
        # a column of 1 moves an image point at the edge by 1 px
        largest = float(np.ptp(alternative.factor))  # from the first photograph to the last of a drift
        parts: Parts = {"photographs": tuple(a.network.images[i] for i in alternative.photographs)}
        if abs(largest * float(beta[0])) > SEEN_PX:
            change = 100 * largest * float(beta[0]) / half
            parts["change"] = (change if grows else -change, "%")
        if alternative.among is not None and not alternative.among.all():
            parts["camera"] = camera.shared_name
        if len(beta) > 2 and not linear and np.hypot(beta[1], beta[2]) > SEEN_PX:
            parts["away"] = (float(np.hypot(beta[1], beta[2])), "px")
        return parts

    def _of_each(self, beta: FloatArray, half: float) -> Parts:
        """Return the largest deviations of photographs from their mean; beta are their parameters, (m, f)."""
        off = np.abs(beta - beta.mean(axis=0))  # a column of 1 moves an image point at the edge by 1 px
        of_c, of_point = (np.isin(self.places, places) for places in ((0,), (1, 2)))
        parts: Parts = {}
        if off[:, of_c].max(initial=0.0) > SEEN_PX:
            parts["change"] = (100 * float(off[:, of_c].max()) / half, "%")
        away = np.linalg.norm(off[:, of_point], axis=1).max()
        if away > SEEN_PX:
            parts["away"] = (float(away), "px")
        distortion = off[:, ~of_c & ~of_point].max(initial=0.0)
        if distortion > SEEN_PX:
            parts["distortion"] = (float(distortion), "px")
        return parts


@dataclass(frozen=True)
class RowsFamily(OfPhotographs):
    """Rows that are exposed one after the other while the camera moves, at another speed in each photograph.

    The image is sheared and stretched along its columns. With y along the columns, and s the speed,
    s_x y is b2, and s_y y is c together with an equal and opposite b1.
    """

    of_camera = True
    kinds: ClassVar[dict[str, str]] = {"": "rolling_shutter"}

    def parts(self, alternative: Alternative, a: Adjustment, beta: FloatArray, unit: str) -> Parts:
        """Return the photographs that are displaced most, half as much or more, and by how much."""
        # from the first row to the last; a column of 1 moves an image point at the edge by 1 px
        sizes = np.array([camera.size_px for camera in a.estimate.cameras])[a.network.camera]
        stretch, _, shear = beta.reshape(-1, len(self.places)).T
        speed = np.hypot(stretch - stretch.mean(), shear)[alternative.factor.astype(np.int64)]
        skew = 2 * speed * sizes[:, 1] / sizes.max(axis=1)
        most = np.flatnonzero(2 * skew >= skew.max())
        return {
            "photographs": tuple(a.network.images[i] for i in most),
            "skew": (float(skew.max()), "px"),
        }


@dataclass(frozen=True)
class ObjectFamily(OfPhotographs):
    """Another shape of the object in some photographs."""

    of_camera = False
    constant = "constant object"
    kinds: ClassVar[dict[str, str]] = {"": "object_deformed", "all": "shape_of_control"}

    def cause(self, alternative: Alternative) -> tuple[object, ...]:
        """Return a key for the cause: a pattern of the object."""
        return ("object", alternative.pattern)

    def displaced(self, alternative: Alternative, points: FloatArray, beta: FloatArray) -> FloatArray:
        """Return the displacement of points in the photographs that differ most, (n, 3)."""
        largest = float(np.abs(alternative.factor - alternative.factor.mean()).max())
        return largest * without_motions(points, (self._field(points)[0] @ beta)[:, :, None])[:, :, 0]

    def parts(self, alternative: Alternative, a: Adjustment, beta: FloatArray, unit: str) -> Parts:
        """Return the largest displacement of a point; over the size of the object if it changes."""
        field_, size = self._field(a.estimate.points)
        if alternative.pattern == "all":
            return _parts_of_shape(field_ @ beta, unit)
        away = np.linalg.norm(field_ @ beta, axis=1) / size
        deformation = 1000 * float(np.ptp(alternative.factor)) * float(np.nanmax(away))
        steadily = alternative.pattern == "linear"
        return {
            "photographs": None if steadily else tuple(a.network.images[i] for i in alternative.photographs),
            "how": ("steadily",) if steadily else None,
            "deformation": (deformation, "‰ of the object"),
        }

    def _field(self, points: FloatArray) -> tuple[FloatArray, float]:
        fields, size = object_fields(points)
        return fields[:, :, np.array(self.places) - len(CAMERA_PLACES)], size


@dataclass(frozen=True)
class PointFamily(Family):
    """Object points that moved, or given ones that are not as given, each on its own."""

    kinds: ClassVar[dict[str, str]] = {"": "points_moved", "all": "shape_of_control"}

    def cause(self, alternative: Alternative) -> tuple[object, ...]:
        """Return a key for the cause: a pattern of the object."""
        return ("object", alternative.pattern)

    def columns(self, alternative: Alternative, a: Adjustment, columns: Columns) -> FloatArray:
        """Return the columns of an alternative for all image points, px, (k, 2, q)."""
        seen, place = a.network.image_points, np.full(len(a.network.points), -1)
        place[alternative.points] = np.arange(len(alternative.points))
        rows = np.flatnonzero(place[seen.point] >= 0)
        D = np.zeros((len(seen), 2, len(alternative.points), 3))
        D[rows, :, place[seen.point[rows]]] = (
            alternative.factor[seen.image[rows]][:, None, None] * columns.point[rows]
        )
        return D.reshape(len(seen), 2, -1)

    def displaced(self, alternative: Alternative, points: FloatArray, beta: FloatArray) -> FloatArray:
        """Return the displacement of points in the photographs that differ most, (n, 3)."""
        away = np.zeros_like(points)
        away[alternative.points] = beta.reshape(-1, 3)
        return away

    def parts(self, alternative: Alternative, a: Adjustment, beta: FloatArray, unit: str) -> Parts:
        """Return the points and their largest displacement.

        Of points that moved also the first photograph afterwards; of given ones the standard deviation of
        coordinates that covers all displacements.
        """
        shape = _parts_of_shape(
            self.displaced(alternative, a.estimate.points, beta)[alternative.points], unit
        )
        if alternative.pattern == "all":
            return shape
        return {
            "photographs": tuple(a.network.images[i] for i in alternative.photographs),
            "points": tuple(a.network.points[j] for j in alternative.points),
            "from": (a.network.images[int(np.flatnonzero(alternative.factor > 0)[0])],),
            "distance": shape["distance"],
        }


@dataclass(frozen=True)
class BodyFamily(PointFamily):
    """Object points that moved as a rigid body, by a vector and a small rotation."""

    def cause(self, alternative: Alternative) -> tuple[object, ...]:
        """Return a key for the cause: a body."""
        return ("body",)

    def columns(self, alternative: Alternative, a: Adjustment, columns: Columns) -> FloatArray:
        """Return the columns of an alternative for all image points, px, (k, 2, q)."""
        seen, motions = a.network.image_points, np.zeros((len(a.network.points), 3, 6))
        motions[alternative.points] = rigid_motions(a.estimate.points, alternative.points)[alternative.points]
        return alternative.factor[seen.image][:, None, None] * (columns.point @ motions[seen.point])

    def displaced(self, alternative: Alternative, points: FloatArray, beta: FloatArray) -> FloatArray:
        """Return the displacement of points in the photographs that differ most, (n, 3)."""
        away = np.zeros_like(points)
        away[alternative.points] = rigid_motions(points, alternative.points)[alternative.points] @ beta
        return away


@dataclass(frozen=True)
class InteriorFamily(Family):
    """Interior parameters that are held fixed."""

    kinds: ClassVar[dict[str, str]] = {"": "held_parameter"}
    of_given: ClassVar[bool] = False

    def cause(self, alternative: Alternative) -> tuple[object, ...]:
        """Return a key for the cause: single parameters, or all of a camera."""
        return (self.name, len({s for _, s in alternative.parameters}) > 1)

    def columns(self, alternative: Alternative, a: Adjustment, columns: Columns) -> FloatArray:
        """Return the columns of an alternative for all image points, px, (k, 2, q)."""
        return interior_columns(a, alternative.parameters)[0]

    def parts(self, alternative: Alternative, a: Adjustment, beta: FloatArray, unit: str) -> Parts:
        """Return the parameters and, for a single one, the value that fits the image points."""
        index, s = alternative.parameters[0]
        camera = a.estimate.cameras[index]
        measure = "" if camera.units[s] == "1" else camera.units[s]
        value = float(camera.parameters[s])
        names = tuple(dict.fromkeys(a.estimate.cameras[i].names[p] for i, p in alternative.parameters))
        parts: Parts = {"camera": camera.owner_of(s), "parameters": names}
        if len(names) == 1:
            fitting = value + float(beta[0]) * interior_columns(a, alternative.parameters)[2][0]
            given = a.network.interior
            at = np.flatnonzero((given.camera == index) & (given.parameter == s))
            stated = float(given.value[at[0]]) if self.of_given else value
            parts |= {"value": Quantity(stated, measure), "instead_of": Quantity(fitting, measure)}
        return parts


@dataclass(frozen=True)
class GivenFamily(InteriorFamily):
    """Interior parameters that are given with a standard deviation.

    A given parameter is already free. Its additional column lets the image points deviate from the given
    value. The adjusted value then equals the given one, and the gain is that of leaving the given value out.
    """

    kinds: ClassVar[dict[str, str]] = {"": "given_parameter"}
    of_given = True


@dataclass(frozen=True)
class FormatFamily(Family):
    """A displacement of image points for each cell of the format."""

    kinds: ClassVar[dict[str, str]] = {"": "distortion_not_described"}

    def columns(self, alternative: Alternative, a: Adjustment, columns: Columns) -> FloatArray:
        """Return the columns of an alternative for all image points, px, (k, 2, q).

        Photographs of all sizes have the same cells.
        """
        seen = a.network.image_points
        size = np.array([camera.size_px for camera in a.estimate.cameras])[a.network.camera[seen.image]]
        column, row = np.clip((CELLS * seen.xy / size).astype(np.int64), 0, CELLS - 1).T
        D = np.zeros((len(seen), 2, CELLS**2, 2))
        D[np.arange(len(seen)), :, CELLS * row + column] = np.eye(2)
        return D.reshape(len(seen), 2, 2 * CELLS**2)

    def parts(self, alternative: Alternative, a: Adjustment, beta: FloatArray, unit: str) -> Parts:
        """Return the largest displacement of a cell."""
        return {"largest": (float(np.linalg.norm(beta.reshape(-1, 2), axis=1).max()), "px")}


def _parts_of_shape(away: FloatArray, unit: str) -> Parts:
    """Return the largest displacement of points (n, 3), and their root mean square."""
    away = away[np.isfinite(away).all(axis=1)]
    return {
        "distance": Quantity(float(np.linalg.norm(away, axis=1).max()), unit),
        "sigma": Quantity(float(np.sqrt((away**2).mean())), unit),
    }


CAMERA_FAMILIES = (
    CameraFamily("c", (0,)),
    CameraFamily("centre", (0, 1, 2, 3)),  # c, x0, y0, K1
    CameraFamily("camera", CAMERA_PLACES),
)
STRAIN = ObjectFamily("strain", STRAIN_PLACES)
# a stabiliser moves x0 and y0 only; such a small set is affordable for each photograph
OF_EACH = (
    CAMERA_FAMILIES[0],
    CameraFamily("point", (1, 2)),
    RowsFamily("rows", tuple(map(CAMERA.index, ("c", "b1", "b2")))),
    *CAMERA_FAMILIES[1:],
)
OF_PHOTOGRAPHS: tuple[CameraFamily | ObjectFamily, ...] = (
    *CAMERA_FAMILIES,
    STRAIN,
    ObjectFamily("bending", BENDING_PLACES),
)
HELD, GIVEN = InteriorFamily("held"), GivenFamily("given")
FORMAT, MOVED, BODY = FormatFamily("format"), PointFamily("moved"), BodyFamily("body")
