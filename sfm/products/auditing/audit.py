"""A model of another program, adjusted anew from its own image points, beside the figures it came with.

The model gives image points, start values and rigs; a survey may add cameras, rigs, control, scale bars and
survey observations. Everything else is that of any survey of image points: gross errors, datum, covariance,
judgement. What the model states of itself is how it projects its own points.

Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.5 and 15.4 (gauge of a block).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.covariance import change_datum
from sfm.adjustment.datum import Datum
from sfm.comparison.solutions import redundancy_of, robust_sigma_px
from sfm.judgement.checks import root_mean_square
from sfm.judgement.survey_result import SurveyResult
from sfm.model.camera import pixel_from_rays
from sfm.model.conventions import METRES, FloatArray, IntArray, angles_from_rotation
from sfm.model.display import counted, listed
from sfm.model.errors import GeometryError
from sfm.model.network import rows_of
from sfm.model.similarity import fit_similarity
from sfm.model.solution import Solution
from sfm.products.auditing.carried import carried_of
from sfm.products.refining.joined_cameras import LikeCameras, like_cameras
from sfm.products.refining.refinement import free_cameras
from sfm.survey.inputs.given_values import KnownPoints, Observations, ScaleBar, StartOrientations
from sfm.survey.inputs.survey import Survey

MIN_FIXED = 3  # points that a datum needs
MAX_NAMED = 20  # parts in a note on what is not used


@dataclass(frozen=True)
class Stated:
    """What a model states of itself, by its own projection of its points."""

    residuals: FloatArray  # computed minus measured, px, (k, 2)
    point: IntArray  # object point of each, (k,)
    unseen: int  # further image points, of points that their camera does not see where the model has both
    photographs: int  # with an orientation
    points: int  # with coordinates
    redundancy: int  # of its image points, at least 1

    @property
    def rms_px(self) -> float:
        """RMS per coordinate, px."""
        return root_mean_square(self.residuals)

    @property
    def mean_length_px(self) -> float:
        """Mean length of the residual vectors, px, which many programs call mean reprojection error."""
        return float(np.linalg.norm(self.residuals, axis=1).mean())

    @property
    def mean_of_points_px(self) -> float:
        """Mean over the points of the mean length of their residual vectors, px, COLMAP's mean error."""
        return mean_of_points(self.residuals, self.point)

    @property
    def sigma_px(self) -> float:
        """Robust standard deviation of a coordinate, px: residuals are smaller, by the root of its share."""
        return robust_sigma_px(self.residuals, self.redundancy)


@dataclass(frozen=True)
class Moved:
    """How far the adjustment moved what a model states, after the best similarity."""

    kind: str  # points or photographs
    rms: float  # object unit
    largest: float  # object unit
    name: str  # of the one that moved farthest
    over_sigma: float  # RMS over the adjusted standard deviations; NaN if these are not known


@dataclass(frozen=True)
class Audit:
    """A model beside the adjustment of its own image points."""

    model: Solution
    stated: Stated
    result: SurveyResult
    moved: tuple[Moved, ...]
    gauge: tuple[tuple[str, float, float], ...]  # datum, RMS of sX, sY, sZ of points and of photographs, unit
    notes: tuple[str, ...] = ()  # what reading it changed, and what of it is not used
    like: tuple[LikeCameras, ...] = ()  # cameras that could be one


def mean_of_points(residuals: FloatArray, point: IntArray) -> float:
    """Return the mean over the points of the mean length of their residual vectors.

    Args:
        residuals: of image points, (k, 2).
        point: object point of each, (k,).
    """
    count = np.bincount(point)
    length = np.bincount(point, np.linalg.norm(residuals, axis=1))
    return float((length[count > 0] / count[count > 0]).mean())


def stated_of(model: Solution) -> Stated:
    """Return what a model states of itself.

    Raises:
        GeometryError: it has no image point of an oriented photograph and a point with coordinates.
    """
    network, estimate = model.network, model.estimate
    seen = network.image_points
    seen = seen.select(estimate.oriented[seen.image] & estimate.determined[seen.point])
    outward = estimate.points[seen.point] - estimate.position[seen.image]
    rays = np.einsum("ki,kij->kj", outward, estimate.rotation[seen.image])
    residuals = np.empty((len(seen), 2))
    of_camera = rows_of(network.camera[seen.image], len(estimate.cameras))
    for camera, rows in zip(estimate.cameras, of_camera, strict=True):
        residuals[rows] = pixel_from_rays(camera, rays[rows]) - seen.xy[rows]
    known = np.isfinite(residuals).all(axis=1)
    residuals = residuals[known]
    if not len(residuals):
        raise GeometryError(
            "audit: no image points of oriented photographs and of points with coordinates, or that two "
            "photographs see: the model has "
            f"{counted(int(estimate.oriented.sum()), 'oriented photograph')}, "
            f"{counted(len(network.image_points), 'image point')} and "
            f"{counted(int(estimate.determined.sum()), 'point')} with coordinates; poses, cameras or points "
            "alone cannot be tested"
        )
    return Stated(
        residuals,
        seen.point[known],
        len(seen) - len(residuals),
        int(estimate.oriented.sum()),
        int(estimate.determined.sum()),
        redundancy_of(seen),
    )


def survey_of_model(
    model: Solution, stated: Stated, *, fixed: tuple[str, ...] = (), given: Survey | None = None
) -> tuple[Survey, tuple[str, ...]]:
    """Return the survey of a model's image points, with its cameras, photographs and points as start values.

    The rigs of the model are kept. The standard deviation of the image points is that of the model's
    residuals, unless they or the given survey state their own.

    Args:
        model: the model.
        stated: what it states of itself.
        fixed: names of interior parameters to hold, such as cx or k1.
        given: survey whose cameras, rigs, control, scale bars, tables, observed orientations, unit and
            settings of the adjustment are used.

    Returns:
        The survey, and what of the model and of the given survey is not used, a line for each.

    Raises:
        GeometryError: no camera has a parameter of a name to hold.
        SurveyFileError: a value that no survey may have.
    """
    network, estimate = model.network, model.estimate
    seen = network.image_points
    seen = seen.select(estimate.oriented[seen.image] & estimate.determined[seen.point])
    oriented, determined = np.unique(seen.image), np.unique(seen.point)  # those that have image points
    free = free_cameras(network, estimate, fixed)
    carried = carried_of(model, oriented, free, fixed, given)
    sigma = seen.stated_sigma
    survey = Survey(
        name=model.name,
        cameras=tuple(carried.cameras),
        rigs=tuple(carried.rigs),
        mounts=tuple(carried.mounts),
        moments=carried.moments,
        exterior=carried.exterior,
        unit=model.unit if model.unit in METRES else "m",  # without control or bars it stays unknown
        adjust={"sigma_px": stated.sigma_px, "reject": "tau"},  # type: ignore[arg-type]
        compare={"backend": "none"},  # type: ignore[arg-type]
        control=_control(model),
        scale_bars=_bars(model),
        observations=replace(
            Observations.from_arrays(
                [network.images[i] for i in seen.image],
                [network.points[j] for j in seen.point],
                seen.xy,
                sigma if np.isfinite(sigma).all() else None,
            ),
            names_last=model.points_named,
        ),
        start_orientations=StartOrientations.from_arrays(
            [network.images[i] for i in oriented],
            estimate.position[oriented],
            np.degrees([angles_from_rotation(estimate.rotation[i]) for i in oriented]),
        ),
        start_points=KnownPoints.from_arrays(
            [network.points[j] for j in determined], estimate.points[determined]
        ),
    )
    unused = (("the model", carried.of_model), ("the survey file", carried.of_survey))
    notes = tuple(f"not used of {whose}: {listed(parts, most=MAX_NAMED)}" for whose, parts in unused if parts)
    if given is None:
        return survey, notes
    own = {
        name: value
        for name, value in (("sigma_px", stated.sigma_px), ("reject", "tau"))
        if name not in given.adjust.model_fields_set
    }
    survey = replace(
        survey,
        unit=given.unit,
        control=given.control or survey.control,
        scale_bars=given.scale_bars or survey.scale_bars,
        tables=given.tables,
        equipment=given.equipment,
        datum=given.datum,
        adjust=given.adjust.model_copy(update=own),
    )
    return survey, notes


def _control(model: Solution) -> KnownPoints | None:
    """Return the control of a model's file."""
    control = model.network.control
    if not len(control.point):
        return None
    names = [model.network.points[j] for j in control.point]
    variance = np.diagonal(control.covariance, axis1=1, axis2=2)
    known = KnownPoints.from_arrays(names, control.xyz, np.sqrt(variance))
    return replace(known, covariances=control.covariance[:, (0, 0, 1), (1, 2, 2)])


def _bars(model: Solution) -> tuple[ScaleBar, ...]:
    """Return the scale bars of a model's file."""
    bars, names = model.network.scale_bars, model.network.points
    rows = zip(bars.start.tolist(), bars.end.tolist(), bars.length.tolist(), bars.sigma.tolist(), strict=True)
    return tuple(ScaleBar(names[i], names[j], length, sigma) for i, j, length, sigma in rows)


def audit_of(model: Solution, stated: Stated, result: SurveyResult, *, notes: tuple[str, ...] = ()) -> Audit:
    """Return a model beside the adjustment of its image points.

    Args:
        model: the model.
        stated: what it states of itself.
        result: the survey of `survey_of_model`.
        notes: what reading the model changed, and what of it is not used.
    """
    a = result.adjustment
    network, estimate = a.network, a.estimate
    numbers = {name: j for j, name in enumerate(model.network.points)}
    theirs = model.estimate.points[[numbers[name] for name in network.points]]
    placing = fit_similarity(theirs, estimate.points)
    numbers = {name: i for i, name in enumerate(model.network.images)}
    stations = model.estimate.position[[numbers[name] for name in network.images]]
    sigma = a.covariance
    moved = (
        _moved("points", network.points, placing.apply(theirs) - estimate.points, sigma.points),
        _moved(
            "photographs",
            network.images,
            placing.apply(stations) - estimate.position,
            sigma.exterior[:, :3, :3],
        ),
    )
    words = {"free": "inner constraints on all points, as in the report", "control": "the control"}
    datums = [(words.get(a.datum, a.datum), a)]
    if a.datum == "free" and len(network.points) > MIN_FIXED:
        datums.append(("seven coordinates of three points held", change_datum(a, Datum("minimal"))))
    gauge = tuple(
        (
            words,
            root_mean_square(np.sqrt(np.diagonal(of.covariance.points, axis1=1, axis2=2))),
            root_mean_square(np.sqrt(np.diagonal(of.covariance.exterior[:, :3, :3], axis1=1, axis2=2))),
        )
        for words, of in datums
    )
    return Audit(model, stated, result, moved, gauge, notes, like_cameras(a, a.false_alarm))


def _moved(kind: str, names: Sequence[str], off: FloatArray, covariance: FloatArray) -> Moved:
    """Return how far points or photographs moved, off (n, 3), in standard deviations of (n, 3, 3)."""
    length = np.linalg.norm(off, axis=1)
    variance = np.trace(covariance, axis1=1, axis2=2)
    known = variance > 0
    share = (length[known] ** 2 / variance[known]).mean() if known.any() else np.nan
    farthest = int(np.argmax(length))
    return Moved(
        kind,
        float(np.sqrt((length**2).mean() / 3)),
        float(length[farthest]),
        names[farthest],
        float(np.sqrt(share)),
    )
