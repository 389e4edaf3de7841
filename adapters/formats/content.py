"""The full content of a survey file, by kind, for conversion to another format.

A format lists the kinds that it keeps. Kinds that it loses are reported when a survey is written.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import NamedTuple
from zlib import crc32

import numpy as np

from sfm.model.conventions import FloatArray
from sfm.model.display import counted
from sfm.model.errors import OutputError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, InteriorObservations, Network, ObjectPoints
from sfm.model.reduced_network import reduce_network
from sfm.model.solution import NO_SCALE, UNCODED, Solution

UNSTATED = "not stated"  # name of the camera that stands for one that a file does not state
PAIRS = ((0, 1), (0, 2), (1, 2))  # of coordinates, for cXY, cXZ and cYZ


def _no_image_points() -> ImagePoints:
    none = np.zeros(0, dtype=np.int64)
    return ImagePoints(none, none, np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, dtype=bool))


@dataclass(frozen=True)
class Content:
    """A solution, the observations that took no part, and notes for the reader."""

    result: Solution
    rejected: ImagePoints = field(default_factory=_no_image_points)  # measured, but left out as gross errors
    checks: ObjectPoints = field(default_factory=ObjectPoints)  # known points that only check the result
    sigma0: float | None = None  # of unit weight, the scale of the covariances
    sigma0_px: float | None = None  # a posteriori, of an image coordinate, px
    stated_weights: bool = False  # whether its program weights all observations as it states them
    notes: tuple[str, ...] = ()  # remarks on content that is read but not used unchanged
    crs: str = ""  # coordinate system of the object in well-known text; empty where unknown


Rows = Callable[[Content], FloatArray]


class Kind(NamedTuple):
    """Content that a survey may have and a format may lack."""

    name: str  # as in the list of a format
    words: str  # for people, in the plural
    rows: Rows  # all its numbers, one row per item, (n, d)


def _points_of(known: ObjectPoints) -> FloatArray:
    variance = np.einsum("nii->ni", known.covariance)
    xyz = np.where(np.isfinite(variance), known.xyz, np.nan)
    rows = np.concatenate([known.point[:, None], xyz, np.sqrt(variance)], axis=1)
    return np.asarray(rows[np.argsort(known.point, kind="stable")])


def _correlations(C: FloatArray) -> FloatArray:
    """Return matrix number, row, column and value of the nonzero elements above the diagonals, (n, 4)."""
    e, r, c = np.nonzero(np.triu(np.nan_to_num(C), 1))
    return np.stack([e, r, c, C[e, r, c]], axis=1)


def _by_image(content: Content) -> ImagePoints:
    seen = content.result.network.image_points
    return seen.select(np.lexsort((seen.point, seen.image)))


def _sigmas(covariance: FloatArray | None) -> FloatArray:
    if covariance is None:
        return np.zeros((0, 4))
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    known = np.isfinite(sigma).all(axis=1)
    return np.column_stack([np.flatnonzero(known), sigma[known]])


def _names(names: tuple[str, ...], identify: bool) -> FloatArray:
    kept = [name for name in names if identify and UNCODED.fullmatch(name) is None]
    return np.array([crc32(name.encode()) for name in kept], dtype=float)[:, None]


def _word(word: str) -> FloatArray:
    return _names((word,) if word and word != NO_SCALE else (), True)


KINDS: list[Kind] = []  # in the order in which losses are reported


def _kind(name: str, words: str) -> Callable[[Rows], Rows]:
    """Declare the numbers of a kind of content: a row of KINDS above the function that returns them."""

    def declare(rows: Rows) -> Rows:
        KINDS.append(Kind(name, words, rows))
        return rows

    return declare


@_kind("exterior orientations", "exterior orientations")
def _oriented(content: Content) -> FloatArray:
    return np.flatnonzero(content.result.estimate.oriented)[:, None].astype(float)


@_kind("cameras", "interior orientations of photographs")
def _cameras(content: Content) -> FloatArray:
    """Return the photographs with a camera that is stated; cameras without photographs likewise, (n, 1)."""
    network, estimate = content.result.network, content.result.estimate
    stated = np.array([camera.name != UNSTATED for camera in estimate.cameras], dtype=bool)
    if not network.images:
        return np.flatnonzero(stated)[:, None].astype(float)
    return np.flatnonzero(stated[network.camera])[:, None].astype(float)


@_kind("object points", "coordinates of points")
def _determined(content: Content) -> FloatArray:
    return np.flatnonzero(content.result.estimate.determined)[:, None].astype(float)


@_kind("image points", "image points")
def _image_points(content: Content) -> FloatArray:
    """Return the photograph of each, (k, 1); some formats number the points anew."""
    return np.sort(content.result.network.image_points.image)[:, None].astype(float)


@_kind("control", "control points")
def _control(content: Content) -> FloatArray:
    return _points_of(content.result.network.control.complete)


@_kind("partial control", "control points with coordinates that are not known")
def _partial(content: Content) -> FloatArray:
    control = content.result.network.control
    rows = _points_of(control)
    return np.asarray(rows[~np.isin(rows[:, 0], control.complete.point)])


@_kind("control correlations", "correlations of control")
def _correlated(content: Content) -> FloatArray:
    control = content.result.network.control
    between = np.stack([control.covariance[:, row, column] for row, column in PAIRS], axis=1)
    rows = np.concatenate([control.point[:, None], between], axis=1)[between.any(axis=1)]
    return np.asarray(rows[np.argsort(rows[:, 0], kind="stable")])


@_kind("scale bars", "scale bars")
def _bars(content: Content) -> FloatArray:
    bars = content.result.network.scale_bars
    return np.stack([bars.start, bars.end, bars.length, bars.sigma], axis=1)


@_kind("exterior", "observed exterior orientations")
def _exterior(content: Content) -> FloatArray:
    seen = content.result.network.exterior
    variance = np.einsum("eii->ei", seen.covariance)
    value = np.where(np.isfinite(variance), np.hstack([seen.position, seen.angles]), np.nan)
    return np.concatenate([seen.image[:, None], value, np.sqrt(variance)], axis=1)


@_kind("exterior correlations", "covariances of observed exterior orientations")
def _exterior_correlations(content: Content) -> FloatArray:
    C = content.result.network.exterior.covariance
    return _correlations(np.where(np.isfinite(C), C, 0.0))


@_kind("interior", "weighted interior parameters")
def _interior(content: Content) -> FloatArray:
    seen = content.result.network.interior
    return np.stack([seen.camera, seen.parameter, seen.value, seen.sigma], axis=1)


@_kind("interior correlations", "correlations of weighted interior parameters")
def _interior_correlations(content: Content) -> FloatArray:
    R = content.result.network.interior.correlation
    return np.zeros((0, 4)) if R is None else _correlations(R[None])


@_kind("checks", "check points")
def _checks(content: Content) -> FloatArray:
    return _points_of(content.checks)


@_kind("rejected", "rejected image points")
def _rejected(content: Content) -> FloatArray:
    seen = content.rejected
    return np.column_stack([seen.image, seen.point, seen.xy])


@_kind("image sigmas", "standard deviations of image points")
def _image_sigmas(content: Content) -> FloatArray:
    sigma = _by_image(content).stated_sigma
    return np.asarray(sigma[np.isfinite(sigma).all(axis=1)])


@_kind("image covariances", "covariances of x and y of image points")
def _image_covariances(content: Content) -> FloatArray:
    between = _by_image(content).stated_covariance
    return np.asarray(between[between != 0][:, None])


@_kind("point sigmas", "standard deviations of points")
def _point_sigmas(content: Content) -> FloatArray:
    return _sigmas(content.result.point_covariance)


@_kind("position sigmas", "standard deviations of projection centres")
def _position_sigmas(content: Content) -> FloatArray:
    return _sigmas(content.result.position_covariance)


@_kind("interior sigmas", "standard deviations of interior parameters")
def _interior_sigmas(content: Content) -> FloatArray:
    sigmas = content.result.interior_sigma or ()
    rows = [
        (k, s, v)
        for k, of_camera in enumerate(sigmas)
        for s, v in enumerate(of_camera.tolist())
        if np.isfinite(v)
    ]
    return np.array(rows, dtype=float).reshape(-1, 3)


@_kind("joint covariance", "rows of the covariance of all coordinates")
def _joint(content: Content) -> FloatArray:
    Q = content.result.covariance
    return np.zeros((0, 3)) if Q is None else np.asarray(Q)


@_kind("covariances", "covariances of exterior and interior orientation")
def _full(content: Content) -> FloatArray:
    Q = content.result.exterior_covariance
    parts = [] if Q is None else [Q.reshape(len(Q), -1)]
    parts += [C.reshape(1, -1) for C in content.result.interior_covariance if len(C) > 1]
    return np.concatenate([part.ravel() for part in parts])[:, None] if parts else np.zeros((0, 1))


@_kind("rigs", "cameras on rigs")
def _rigs(content: Content) -> FloatArray:
    estimate = content.result.estimate
    if estimate.mounts is None or content.result.network.moment is None:
        return np.zeros((0, 20))
    mounts = estimate.mounts
    rigs = [mounts.rig.index(name) for name in mounts.rig]  # the first camera of each
    on = [a for a, name in enumerate(mounts.rig) if name]
    R = mounts.rotation.reshape(-1, 9)
    return np.asarray(np.column_stack([np.arange(len(rigs)), rigs, mounts.position, R])[on])


@_kind("rig names", "names of rigs")
def _rig_names(content: Content) -> FloatArray:
    mounts = content.result.estimate.mounts
    kept = () if mounts is None or content.result.network.moment is None else mounts.by_rig()
    return _names(tuple(kept), True)


@_kind("held mounts", "mounts that are held")
def _held_mounts(content: Content) -> FloatArray:
    mounts = content.result.estimate.mounts
    if mounts is None or content.result.network.moment is None:
        return np.zeros((0, 7))
    at_reference = [of_rig[0] for of_rig in mounts.by_rig().values()]
    held = [
        a for a, rig in enumerate(mounts.rig) if rig and a not in at_reference and not mounts.free[a].all()
    ]
    return np.column_stack([held, mounts.free[held]]).astype(float)


@_kind("moments", "photographs of one moment with others")
def _moments(content: Content) -> FloatArray:
    """Return photographs taken at one moment, and the first photograph of that moment, (n, 2)."""
    moment = content.result.network.moment
    if moment is None or content.result.estimate.mounts is None:
        return np.zeros((0, 2))
    _, first, of, count = np.unique(moment, return_index=True, return_inverse=True, return_counts=True)
    together = np.flatnonzero(count[of] > 1)
    return np.column_stack([together, first[of[together]]]).astype(float)


@_kind("rig covariance", "rows of the covariance of mounts and interior orientation")
def _rig_covariance(content: Content) -> FloatArray:
    Q = content.result.rig_covariance
    return np.zeros((0, 1)) if Q is None else np.asarray(Q)


@_kind("statistics", "values of redundancy and sigma0")
def _statistics(content: Content) -> FloatArray:
    statistics = (content.result.redundancy, content.sigma0, content.sigma0_px)
    return np.array([value for value in statistics if value is not None], dtype=float)[:, None]


@_kind("datum", "kind of datum")
def _datum(content: Content) -> FloatArray:
    return _word(content.result.datum)


@_kind("unit", "unit of lengths")
def _unit(content: Content) -> FloatArray:
    return _word(content.result.unit)


@_kind("crs", "coordinate system")
def _crs(content: Content) -> FloatArray:
    return _word(content.crs)


@_kind("point names", "names of points")
def _point_names(content: Content) -> FloatArray:
    return _names(content.result.network.points, content.result.points_named)


@_kind("uncoded", "marks of points as uncoded, which get numbers,")
def _uncoded(content: Content) -> FloatArray:
    result = content.result
    rows = [j for j, name in enumerate(result.network.points) if UNCODED.fullmatch(name)]
    return np.array(rows if result.points_named else [], dtype=float)[:, None]


@_kind("image names", "names of photographs")
def _image_names(content: Content) -> FloatArray:
    return _names(content.result.network.images, content.result.images_named)


@_kind("free", "settings of interior parameters as free")
def _free(content: Content) -> FloatArray:
    cameras = content.result.estimate.cameras
    rows = [(k, s) for k, camera in enumerate(cameras) for s in np.flatnonzero(camera.free)]
    return np.array(rows, dtype=float).reshape(-1, 2)


@_kind("shared", "interior parameters shared by cameras")
def _shared(content: Content) -> FloatArray:
    """Return camera, parameter and the first camera of the group that shares it."""
    first: dict[tuple[str, int], int] = {}
    rows = []
    for k, camera in enumerate(content.result.estimate.cameras):
        for s in range(len(camera.shared)):
            group = first.setdefault((camera.owner_of(s), s), k)
            rows.append((k, s, group))
    return np.array(rows, dtype=float).reshape(-1, 3)


@_kind("unplaced", "photographs and points without coordinates")
def _unplaced(content: Content) -> FloatArray:
    estimate = content.result.estimate
    images, points = np.flatnonzero(~estimate.oriented), np.flatnonzero(~estimate.determined)
    return np.array([(0, i) for i in images] + [(1, j) for j in points], dtype=float).reshape(-1, 2)


ALL = frozenset(kind.name for kind in KINDS)


CONVERTED = frozenset(
    {"interior", "interior correlations", "interior sigmas", "covariances", "rig covariance"}
)


def content_of_points(
    name: str,
    xyz: FloatArray,
    sigma: FloatArray | None,
    *,
    names: tuple[str, ...] | None = None,
    unit: str = "",
    crs: str = "",
    notes: tuple[str, ...] = (),
) -> Content:
    """Return points alone as a survey.

    Args:
        name: of the survey.
        xyz: coordinates, object unit, (n, 3).
        sigma: their standard deviations, object unit, (n, 3); None if they are not known.
        names: of the points; None if a file only numbers them.
        unit: object unit; empty where unknown.
        crs: coordinate system in well-known text; empty where unknown.
        notes: remarks on what is read but not used unchanged.
    """
    none = np.zeros(0, dtype=np.int64)
    points = names or tuple(f"u{j}" for j in range(len(xyz)))
    network = Network((), none, points, _no_image_points())
    estimate = Estimate((), np.zeros((0, 3)), np.zeros((0, 3, 3)), xyz)
    C = None if sigma is None else np.where(np.eye(3, dtype=bool), sigma[:, None, :] ** 2, 0.0)
    result = Solution(name, network, estimate, C, unit=unit, points_named=names is not None)
    return Content(result, notes=notes, crs=crs)


def points_of(content: Content) -> tuple[FloatArray, FloatArray | None]:
    """Return the points that have coordinates, (n, 3), and their standard deviations, if all have them."""
    result = content.result
    known = result.estimate.determined
    C = result.point_covariance
    sigma = None if C is None else np.sqrt(np.diagonal(C, axis1=1, axis2=2))[known]
    return result.estimate.points[known], None if sigma is None or not np.isfinite(sigma).all() else sigma


def flat_names(images: tuple[str, ...]) -> tuple[str, ...]:
    """Return names of photographs without their folders, or with them where two would have one name."""
    names = [PurePosixPath(image).name for image in images]
    if len(set(names)) < len(names):
        names = [image.replace("/", "_") for image in images]
    return tuple(names)


def with_cameras(content: Content, network: Network, estimate: Estimate) -> tuple[Content, frozenset[str]]:
    """Return a survey with cameras in other models or image points corrected for distortion.

    Args:
        content: content of the survey.
        network: its network, possibly with corrected image points.
        estimate: its solution with the other cameras.

    Returns:
        The survey, and the kinds dropped because they belong to the former cameras.
    """
    result = content.result
    before, after = result.estimate.cameras, estimate.cameras
    gone: frozenset[str] = frozenset()
    if any(former.model != other.model for former, other in zip(before, after, strict=True)):
        gone |= CONVERTED
    if network.image_points is not result.network.image_points:
        gone |= CONVERTED | {"rejected"}
    if not gone:
        return replace(content, result=replace(result, network=network, estimate=estimate)), gone
    network = network.with_given(InteriorObservations())
    result = replace(
        result,
        network=network,
        estimate=estimate,
        interior_sigma=None,
        exterior_covariance=None,
        interior_covariance=(),
        rig_covariance=None,
    )
    content = replace(content, result=result)
    return replace(content, rejected=_no_image_points()) if "rejected" in gone else content, gone


def select_placed(content: Content) -> Content:
    """Return the part of a survey that has coordinates in the object."""
    result = content.result
    network, estimate = result.network, result.estimate
    images, points = estimate.oriented, estimate.determined
    if images.all() and points.all():
        return content
    every = np.ones(len(network.image_points), dtype=bool)
    rejected, checks = content.rejected, content.checks
    kept, known = images[rejected.image] & points[rejected.point], points[checks.point]
    image, point = np.cumsum(images) - 1, np.cumsum(points) - 1
    C, Q, full = result.point_covariance, result.position_covariance, result.exterior_covariance
    network, estimate = reduce_network(network, estimate, images, points, every)
    reduced = replace(
        result,
        network=network,
        estimate=estimate,
        point_covariance=None if C is None else C[points],
        position_covariance=None if Q is None else Q[images],
        covariance=result.covariance if points.all() else None,
        exterior_covariance=None if full is None else full[images],
    )
    rejected = rejected.select(kept)
    return replace(
        content,
        result=reduced,
        rejected=replace(rejected, image=image[rejected.image], point=point[rejected.point]),
        checks=ObjectPoints(point[checks.point[known]], checks.xyz[known], checks.covariance[known]),
    )


def refuse_not_finite(path: Path, content: Content) -> None:
    """Refuse content with a number that is not finite; NaN may only mark what is not determined.

    All formats are checked here, before anything is written.

    Args:
        path: file or folder to be written, for the message.
        content: content of a survey.

    Raises:
        OutputError: with the kind and the number of items.
    """
    for what, rows in _numbers(content):
        wrong = np.flatnonzero(~np.isfinite(rows).all(axis=tuple(range(1, rows.ndim))))
        if len(wrong):
            raise OutputError(
                f"{path}: {counted(len(wrong), what)} of {len(rows)} with numbers that are not finite "
                f"(NaN or infinite), the first is row {wrong[0] + 1}; nothing is written"
            )


def _numbers(content: Content) -> Iterator[tuple[str, FloatArray]]:
    """Yield the numbers that every format may write, by kind; those that are not determined are left out."""
    result = content.result
    network, estimate = result.network, result.estimate
    for what, seen in (("image point", network.image_points), ("rejected image point", content.rejected)):
        yield what, np.column_stack([seen.xy, seen.covariance.reshape(len(seen), 4)])
    for camera in estimate.cameras:
        yield "interior orientation", np.hstack([camera.pixel_mm, camera.parameters])[None]
    yield "exterior orientation", estimate.rotation[estimate.oriented]
    if estimate.mounts is not None:
        mounts = estimate.mounts
        yield "mount", np.column_stack([mounts.position, mounts.rotation.reshape(len(mounts.rig), 9)])
    for kind in (*network.observations, content.checks):
        covariance = kind.covariances()
        n, d = covariance.shape[:2]
        variance = np.einsum("nii->ni", covariance)
        given = ~np.isposinf(variance) if d > 1 else np.ones((n, 1), dtype=bool)  # infinite: not observed
        of_given = np.where(given[:, :, None] & given[:, None, :], covariance, 0.0)
        yield kind.single, np.column_stack([np.where(given, kind.values, 0.0), of_given.reshape(n, d * d)])
    for what, matrix in (
        ("row of the correlations of interior parameters", network.interior.correlation),
        ("row of the covariance of the points", result.covariance),
        ("row of the covariance of mounts", result.rig_covariance),
    ):
        if matrix is not None:
            yield what, matrix
    for Q in result.interior_covariance:
        yield "row of the covariance of a camera", Q


def losses(content: Content, held: frozenset[str]) -> tuple[tuple[Kind, int], ...]:
    """Return the kinds of content that a format cannot store, and their number of items.

    Args:
        content: content of a survey.
        held: names of the kinds that the format keeps.
    """
    counts = ((kind, len(kind.rows(content))) for kind in KINDS if kind.name not in held)
    return tuple((kind, count) for kind, count in counts if count)
