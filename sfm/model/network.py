"""Network: the measurements, as frozen objects of arrays.

Photographs and points are identified by index: image i is `network.images[i]`, point j is
`network.points[j]`. A function that changes something returns a new object.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import cached_property
from itertools import combinations, pairwise
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from scipy.sparse import csc_matrix, csr_matrix, triu

from sfm.model.arguments import checked_arguments
from sfm.model.camera import Camera
from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.model.display import counted, listed
from sfm.model.errors import GeometryError, UnknownNameError
from sfm.model.estimate import Estimate
from sfm.model.observations.control_and_bars import InteriorObservations, ObjectPoints, ScaleBars
from sfm.model.observations.kind import PHOTOGRAPH, POINT, Kind
from sfm.model.observations.pose import ExteriorObservations

__all__ = [
    "ExteriorObservations",
    "ImagePoints",
    "InteriorObservations",
    "Kind",
    "Network",
    "ObjectPoints",
    "ScaleBars",
    "Source",
    "empty_estimate",
    "index_of",
    "rows_of",
    "without_given",
]

# kinds of which a network has one set of observations at most, in the order of their tables
SETS = (ObjectPoints, ExteriorObservations, InteriorObservations, ScaleBars)
K = TypeVar("K", bound=Kind)
MAX_NAMES = 10  # most names listed in a message
MAX_PAIRS_AT_ONCE = 4_000_000  # pairs of photographs compared in one sparse product


@dataclass(frozen=True)
class Source:
    """Where image points come from, and what the adjustment must know of them."""

    name: str
    names_last: bool = True  # whether its points keep their names in later runs
    fewest: int = 4  # image points that orient a photograph: three determine it, the fourth checks
    is_exact: bool = False  # whether they were handed over as they are
    has_common_errors: bool = False  # whether the errors of neighbours in a photograph have a common part
    is_matched: bool = False  # whether its image points are windows that were matched with one another
    points: str = "uncoded"  # what its points are that have no code
    # factor by which errors in common multiply the variance of what its image points tell of unknowns that
    # they share with other sources; as many image points have the weight of one with an error of its own
    design_effect: float = 1.0
    balance: float = 1.0  # factor that its standard deviations have got to weigh it against other sources
    noun: str = ""  # what remarks call its image points; else its name


@dataclass(frozen=True)
class ImagePoints:
    """Measured image points of all photographs."""

    image: IntArray  # index of the photograph, (k,)
    point: IntArray  # index of the object point, (k,)
    xy: FloatArray  # measured position in the pixel frame, px, (k, 2)
    covariance: FloatArray  # covariance of xy, px^2, (k, 2, 2)
    # which covariances were stated with the image points, rather than set by default when they were read; all
    # if None, (k,)
    stated: BoolArray | None = None
    source: IntArray | None = None  # index into the sources of the network; the first if None, (k,)

    def __len__(self) -> int:
        return len(self.image)

    def select(self, mask: BoolArray | IntArray) -> ImagePoints:
        """Return the image points that a mask or an array of indices selects."""
        return ImagePoints(
            self.image[mask],
            self.point[mask],
            self.xy[mask],
            self.covariance[mask],
            None if self.stated is None else self.stated[mask],
            None if self.source is None else self.source[mask],
        )

    @classmethod
    def joined(cls, parts: Sequence[ImagePoints]) -> ImagePoints:
        """Return the image points of several sets, one set after the other."""

        def optional(values: Sequence[AnyArray | None], otherwise: float) -> AnyArray | None:
            if all(array is None for array in values):
                return None
            missing = [np.full(len(part), otherwise) for part in parts]
            return np.concatenate([m if a is None else a for a, m in zip(values, missing, strict=True)])

        stated = optional([part.stated for part in parts], True)
        source = optional([part.source for part in parts], 0)
        return cls(
            np.concatenate([part.image for part in parts]),
            np.concatenate([part.point for part in parts]),
            np.concatenate([part.xy for part in parts]),
            np.concatenate([part.covariance for part in parts]),
            stated,
            source,
        )

    @property
    def median_sigma_px(self) -> float:
        """Median standard deviation of the coordinates, px."""
        return float(np.sqrt(np.median(np.diagonal(self.covariance, axis1=1, axis2=2))))

    @property
    def stated_sigma(self) -> FloatArray:
        """Standard deviations of x and y, px; NaN where none was stated, (k, 2)."""
        sigma = np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))
        return sigma if self.stated is None else np.where(self.stated[:, None], sigma, np.nan)

    @property
    def stated_covariance(self) -> FloatArray:
        """Covariances between x and y, px^2; 0 where none was stated, (k,)."""
        return (
            self.covariance[:, 0, 1]
            if self.stated is None
            else np.where(self.stated, self.covariance[:, 0, 1], 0.0)
        )


@dataclass(frozen=True, repr=False)
class Network:
    """All measurements of a survey.

    Example:
        >>> import sfm
        >>> network = sfm.Network.from_arrays(
        ...     image=["left", "left", "right", "right"],
        ...     point=["1", "2", "1", "2"],
        ...     xy=[[100.0, 50.0], [200.0, 52.0], [80.0, 51.0], [180.0, 53.0]],
        ...     sigma_px=0.1,
        ... )
        >>> network.with_control(["1"], [[0, 0, 0]]).with_scale_bar("1", "2", 1.5, 0.001)
        <Network: 2 photographs, 2 points, 4 image points, 1 control point, 1 scale bar>
    """

    images: tuple[str, ...]  # names of the photographs, m of them
    camera: IntArray  # index of the camera of each photograph in Estimate.cameras, (m,)
    points: tuple[str, ...]  # names of the object points, n of them
    image_points: ImagePoints
    observations: tuple[Kind, ...] = ()  # of all other kinds, those of `SETS` first
    # number of the moment of each photograph, 0, 1, ...; cameras of one rig share a pose at one moment; if
    # None, each photograph has its own, (m,)
    moment: IntArray | None = None
    sources: tuple[Source, ...] = (Source("image points"),)  # of the image points

    @property
    def source(self) -> IntArray:
        """Index of the source of each image point, (k,)."""
        source = self.image_points.source
        return np.zeros(len(self.image_points), dtype=np.int64) if source is None else source

    @property
    def share(self) -> FloatArray:
        """What each image point counts beside those of other sources, 1 without errors in common, (k,)."""
        return np.array([1 / source.design_effect for source in self.sources])[self.source]

    @property
    def may_correlate(self) -> BoolArray:
        """Which image points a correlation of the errors of neighbours is about, (k,)."""
        common = np.array([source.has_common_errors for source in self.sources])
        return common[self.source] if common.any() else np.ones(len(self.image_points), dtype=bool)

    @property
    def has_common_errors(self) -> bool:
        """Whether the errors of neighbouring image points of a source have a common part."""
        return any(source.has_common_errors for source in self.sources)

    @property
    def automatic_points(self) -> frozenset[str]:
        """Names of the points that may have other names in later runs."""
        return frozenset(name for name, named in zip(self.points, self.named, strict=True) if not named)

    @property
    def windows(self) -> frozenset[str]:
        """Names of the points that are the middles of matched windows, in all their image points."""
        matched = np.array([source.is_matched for source in self.sources])[self.source]
        others = np.unique(self.image_points.point[~matched])
        return frozenset(self.points) - {self.points[j] for j in others.tolist()}

    @cached_property
    def rows_by_photograph(self) -> dict[str, IntArray]:
        """Rows of the image points of each photograph, in order, by its name."""
        return dict(zip(self.images, rows_of(self.image_points.image, len(self.images)), strict=True))

    @cached_property
    def named(self) -> BoolArray:
        """Which points keep their names in later runs, (n,)."""
        lasting = np.array([source.names_last for source in self.sources])[self.source]
        named = np.full(len(self.points), all(source.names_last for source in self.sources))
        named[self.image_points.point[lasting]] = True
        return named

    def __post_init__(self) -> None:
        """Order the observations: the sets of `SETS`, then the others.

        Raises:
            GeometryError: there are two sets of one kind.
        """
        sets = [[given for given in self.observations if isinstance(given, kind)] for kind in SETS]
        for of_kind in sets:
            if len(of_kind) > 1:
                raise GeometryError(f"{of_kind[0].name}: {len(of_kind)} sets, expected one")
        ordered = (*(of_kind[0] for of_kind in sets if of_kind), *self.further)
        object.__setattr__(self, "observations", ordered)

    def of_kind(self, kind: type[K]) -> K:
        """Return the set of observations of a kind, which is empty if there is none."""
        given = next((given for given in self.observations if isinstance(given, kind)), None)
        return kind() if given is None else given

    @property
    def control(self) -> ObjectPoints:
        """Control points."""
        return self.of_kind(ObjectPoints)

    @property
    def exterior(self) -> ExteriorObservations:
        """Observed exterior orientation."""
        return self.of_kind(ExteriorObservations)

    @property
    def interior(self) -> InteriorObservations:
        """Observed interior orientation."""
        return self.of_kind(InteriorObservations)

    @property
    def scale_bars(self) -> ScaleBars:
        """Scale bars."""
        return self.of_kind(ScaleBars)

    @property
    def further(self) -> tuple[Kind, ...]:
        """Observations of kinds of which a network may have several sets."""
        return tuple(kind for kind in self.observations if not isinstance(kind, SETS))

    @classmethod
    def from_arrays(
        cls,
        image: Sequence[str],
        point: Sequence[str],
        xy: npt.ArrayLike,
        *,
        sigma_px: npt.ArrayLike = 0.1,
        camera: Mapping[str, int] | None = None,
    ) -> Network:
        """Return the network of measured image points, with photographs and points in order of appearance.

        Args:
            image: name of the photograph of each image point, k of them.
            point: name of the object point of each image point.
            xy: positions in the pixel frame, px, (k, 2).
            sigma_px: standard deviations of x and y, px, (k, 2) or broadcastable to it.
            camera: index in Estimate.cameras of the camera of each photograph, by its name; 0 if not named.

        Raises:
            GeometryError: arrays of different lengths, positions that are not finite, or sigmas that are not
                positive.
        """
        measured = np.asarray(xy, dtype=float)
        k = len(image)
        if not k or len(point) != k or measured.shape != (k, 2) or not np.isfinite(measured).all():
            raise GeometryError(
                f"network: {counted(k, 'photograph')}, {counted(len(point), 'point')} and "
                f"positions {measured.shape} of image "
                "points; expected k names, k names and finite numbers (k, 2)"
            )
        try:
            sigma = np.broadcast_to(np.asarray(sigma_px, dtype=float), (k, 2))
        except ValueError:
            sigma = np.zeros((k, 2))
        if not (sigma > 0).all():
            raise GeometryError(f"network: sigma_px {np.shape(sigma_px)}, expected positive numbers ({k}, 2)")
        images, points = tuple(dict.fromkeys(map(str, image))), tuple(dict.fromkeys(map(str, point)))
        image_number = {name: i for i, name in enumerate(images)}
        point_number = {name: j for j, name in enumerate(points)}
        seen = ImagePoints(
            np.array([image_number[str(name)] for name in image], dtype=np.int64),
            np.array([point_number[str(name)] for name in point], dtype=np.int64),
            measured.copy(),
            np.eye(2) * sigma[:, None, :] ** 2,
        )
        owner = np.array([(camera or {}).get(name, 0) for name in images], dtype=np.int64)
        return cls(images, owner, points, seen)

    def with_control(self, names: Sequence[str], xyz: npt.ArrayLike, sigma: npt.ArrayLike = 0.0) -> Network:
        """Return the network with the given control points in place of its present ones.

        Args:
            names: names of points of the network, c of them.
            xyz: coordinates, object unit, (c, 3).
            sigma: standard deviations, 0 = fixed, infinite = unknown, object unit, (c, 3) or broadcastable
                to it.

        Raises:
            UnknownNameError: a point is not in the network.
            GeometryError: arrays of another shape, a negative sigma, or values that are not numbers.
        """
        index = np.array([self.point_index(name) for name in names], dtype=np.int64)
        known, s = np.asarray(xyz, dtype=float), np.asarray(sigma, dtype=float)
        if known.shape != (len(index), 3) or s.shape not in ((), (3,), (len(index), 1), known.shape):
            raise GeometryError(
                f"control: coordinates {known.shape} and sigmas {s.shape} of {len(index)} points, expected "
                f"({len(index)}, 3) and the same or one number"
            )
        s = np.broadcast_to(s, known.shape)
        if not (s >= 0).all():
            raise GeometryError(f"control: sigma {s[~(s >= 0)][0]:g}, expected 0 (fixed) or more")
        for name, bad in zip(names, (np.isfinite(s) & ~np.isfinite(known)).any(axis=1).tolist(), strict=True):
            if bad:
                raise GeometryError(
                    f"control point {name}: expected finite coordinates where sigma is finite"
                )
        covariance = np.zeros((len(index), 3, 3))
        covariance[:, range(3), range(3)] = s**2
        return self.with_given(ObjectPoints(index, np.where(np.isfinite(s), known, 0.0), covariance))

    def with_scale_bar(self, start: str, end: str, length: float, sigma: float) -> Network:
        """Return the network with one more scale bar, a measured distance between two of its points.

        Args:
            start: name of the point at one end.
            end: name of the point at the other end.
            length: measured distance, object unit.
            sigma: standard deviation of the distance, object unit.

        Raises:
            UnknownNameError: a point is not in the network.
        """
        bars = self.scale_bars
        added = ScaleBars(
            np.append(bars.start, self.point_index(start)),
            np.append(bars.end, self.point_index(end)),
            np.append(bars.length, length),
            np.append(bars.sigma, sigma),
            np.append(bars.table, 0) if len(bars.table) else bars.table,
        )
        return self.with_given(added)

    def with_given(self, *sets: Kind, further: Iterable[Kind] | None = None) -> Network:
        """Return the network with given values in place of its present ones of the same kinds.

        Args:
            sets: control, exterior or interior observations, or scale bars; an empty set removes them.
            further: observations of all other kinds, in place of the present ones; unchanged if None.

        Raises:
            GeometryError: one of the sets is of another kind, or two are of one kind.
        """
        for given in sets:
            if not isinstance(given, SETS):
                name = getattr(given, "name", type(given).__name__)
                raise GeometryError(f"{name}: not with_given, expected further or with_observations")
        replaced = tuple(kind for kind in SETS if any(isinstance(given, kind) for given in sets))
        kept = [
            present
            for present in self.observations
            if isinstance(present, SETS) and not isinstance(present, replaced)
        ]
        rest = self.further if further is None else tuple(further)
        return replace(self, observations=(*kept, *(given for given in sets if len(given)), *rest))

    def with_observations(self, *kinds: Kind) -> Network:
        """Return the network with further observations, of kinds of `sfm.model.observations` or one's own.

        Args:
            kinds: observations of one kind each, by index of the points and photographs of the network.

        Raises:
            GeometryError: a point or photograph that is not in the network, a value that is not finite, a
                standard deviation that is not positive, or a kind that has a method of its own here.

        Example:
            >>> import numpy as np
            >>> from sfm.model.observations import HeightDifferences
            >>> ends = np.array([0, 1]), np.array([2, 3])
            >>> level = HeightDifferences(*ends, np.array([[0.02], [-0.01]]), np.full((2, 1), 1e-4))
            >>> [kind.name for kind in result.network.with_observations(level).further]
            ['height differences']
        """
        size = {POINT: len(self.points), PHOTOGRAPH: len(self.images)}
        for kind in kinds:
            if isinstance(kind, SETS):
                raise GeometryError(f"{kind.name}: not with_observations, expected with_given")
            for block in kind.blocks():
                outside = block.at[(block.at < 0) | (block.at >= size.get(block.of, np.inf))]
                if outside.size:
                    raise GeometryError(
                        f"{kind.name}: {block.of} {outside.flat[0]}, expected 0 to {size[block.of] - 1}"
                    )
            variance = np.einsum("nii->ni", kind.covariances())
            if not (np.isfinite(kind.values).all() and (variance > 0).all()):
                raise GeometryError(
                    f"{kind.name}: finite values and standard deviations above 0 are needed for each"
                )
        return replace(self, observations=(*self.observations, *kinds))

    def image_index(self, name: str) -> int:
        """Return the index of a photograph; UnknownNameError if no photograph has that name."""
        return index_of(self.images, name, "photograph")

    def point_index(self, name: str) -> int:
        """Return the index of a point; UnknownNameError if no point has that name."""
        return index_of(self.points, name, "point")

    def rays(self) -> IntArray:
        """Return the number of photographs in which each point was measured, (n,)."""
        return np.bincount(self.image_points.point, minlength=len(self.points))

    def incidence(self, usable: BoolArray) -> csr_matrix:
        """Return a sparse matrix, 1 where usable image points (k,) show a point in a photograph, (m, n)."""
        seen = self.image_points.select(usable)
        shape = (len(self.images), len(self.points))
        sees = csr_matrix((np.ones(len(seen), dtype=np.int32), (seen.image, seen.point)), shape=shape)
        sees.sum_duplicates()
        sees.data[:] = 1
        return sees

    def correlated_control(self) -> Iterator[tuple[str, str, float]]:
        """Yield name, coordinate pair (XY, XZ, YZ) and covariance of correlated control coordinates."""
        for j, C in zip(self.control.point, self.control.covariance, strict=True):
            for row, column in combinations(range(3), 2):
                if np.isfinite(C[row, column]) and C[row, column] != 0:
                    yield self.points[j], "XYZ"[row] + "XYZ"[column], float(C[row, column])

    def common_points(self, usable: BoolArray) -> Iterator[tuple[IntArray, IntArray, IntArray]]:
        """Yield the pairs of photographs that share points, and the number of points that they share.

        The pairs come in parts of a few million. All pairs at once would take gigabytes where many
        photographs see the same points.

        Args:
            usable: which image points count, (k,).

        Yields:
            Index of the first photograph, larger index of the second, and number of shared points, (p,) each.
            They are sorted by the first and then by the second photograph.
        """
        sees = self.incidence(usable)
        seen_by = sees.T.tocsr()
        rays = np.diff(seen_by.indptr)
        most = np.minimum(sees @ rays, len(self.images))  # pairs of each photograph, at most
        part = np.cumsum(most) // MAX_PAIRS_AT_ONCE
        for start, end in pairwise([*np.flatnonzero(np.diff(part, prepend=-1)), len(self.images)]):
            common = triu(sees[start:end] @ seen_by, int(start) + 1).tocsr()
            common.sort_indices()
            pairs = common.tocoo()
            yield pairs.row.astype(np.int64) + start, pairs.col.astype(np.int64), pairs.data.astype(np.int64)

    def __repr__(self) -> str:
        parts = (
            (len(self.images), "photograph"),
            (len(self.points), "point"),
            (len(self.image_points), "image point"),
            (len(self.control), "control point"),
            (len(self.scale_bars), "scale bar"),
        )
        counts = [counted(count, what) for count, what in parts if count]
        return f"<Network: {', '.join(counts)}>"


def without_given(network: Network) -> Network:
    """Return the network with its image points and interior observations only."""
    return replace(network, observations=(network.interior,))


def rows_of(index: IntArray, count: int) -> list[IntArray]:
    """Return, for each value from 0 to count - 1, the rows of `index` with that value, in order."""
    order = np.argsort(index, kind="stable")
    return np.split(order, np.searchsorted(index[order], np.arange(1, count)))[:count]


def sum_rows(index: IntArray, values: FloatArray, count: int) -> FloatArray:
    """Return the sums of the rows of `values` with the same index, from 0 to count - 1, (count, ...).

    A sparse product adds them in their order, as `np.add.at` does, in a small part of its time.
    """
    rows, width = len(index), math.prod(values.shape[1:])
    pattern = csc_matrix((np.ones(rows), index, np.arange(rows + 1)), shape=(count, rows))
    return np.asarray(pattern @ values.reshape(rows, width)).reshape(count, *values.shape[1:])


@checked_arguments()
def empty_estimate(network: Network, cameras: tuple[Camera, ...]) -> Estimate:
    """Return an estimate with the start values of the cameras; everything else is NaN.

    Args:
        network: network of m photographs and n points.
        cameras: start values of the interior orientations.

    Example:
        >>> import sfm
        >>> sfm.empty_estimate(result.network, result.estimate.cameras).oriented.any()
        np.False_
    """
    m, n = len(network.images), len(network.points)
    return Estimate(cameras, np.full((m, 3), np.nan), np.full((m, 3, 3), np.nan), np.full((n, 3), np.nan))


def indices_of(names: Sequence[str], wanted: Sequence[str], what: str = "point") -> IntArray:
    """Return the index of each of many names, (k,).

    Args:
        names: all names.
        wanted: k names to find.
        what: see `index_of`.

    Raises:
        UnknownNameError: a name is not among them.
    """
    first = {name: k for k, name in reversed(list(enumerate(names)))}
    rows = [first[name] if name in first else index_of(names, name, what) for name in wanted]
    return np.array(rows, dtype=np.int64)


def index_of(names: Sequence[str], name: object, what: str) -> int:
    """Return the index of a name.

    Args:
        names: all names.
        name: name to find.
        what: kind of thing that has the name, for the message.

    Raises:
        UnknownNameError: the name is not among them.
    """
    try:
        return names.index(str(name))
    except ValueError:
        similar = listed(get_close_matches(str(name), names, n=MAX_NAMES) or names, most=MAX_NAMES)
        raise UnknownNameError(f"unknown {what} '{name}', expected one of {similar or 'none'}") from None
