"""Orientation of a model from key points and coded targets that were measured again.

Only windows that do not overlap take part in the adjustment. The other points of the model are intersected
afterwards. Coded targets with control or scale bars define the object frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.matching.correlation import LsmFlag
from sfm.matching.lsm.coverage import points_apart
from sfm.model.conventions import MAD_TO_SIGMA, BoolArray, FloatArray, IntArray
from sfm.model.display import counted, in_words
from sfm.model.errors import GeometryError, SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, ObjectPoints, ScaleBars
from sfm.model.reduced_network import merge_estimate, reduce_network, select_determined
from sfm.model.remarks.remark import Remark, remark
from sfm.model.similarity import Similarity, fit_similarity
from sfm.orientation.image_rays import intersect_image_points
from sfm.products.refining.windows import MIN_RAYS, Windows, photograph_paths, read_of_size
from sfm.runtime.progress import SILENT, Progress
from sfm.survey.circles import check_circles
from sfm.survey.inputs.measurements import MeasuredPhotographs
from sfm.survey.inputs.survey import Survey
from sfm.survey.measuring.targets import targets_in
from sfm.survey.placing import MIN_CONTROL, object_scale
from sfm.survey.sources.target_matching import TOLERANCE_FACTOR
from sfm.survey.target_network import build_network, min_rays, name_coded

PREFIX = "target "  # of the names of targets, since points of the model may have the same numbers
SIGMA_PX = 0.02  # of a matched point, added to the noise of matching: surfaces are not plane over a window


@dataclass(frozen=True)
class OrientedKeyPoints:
    """Key points measured again, and the orientation from those whose windows do not overlap."""

    windows: Windows
    window_px: int
    network: Network  # of these image points, followed by the targets
    rows: IntArray  # image point of the model for each image point of the network but the targets
    rays: IntArray  # that each point needs
    solved: Estimate  # solution of the network, NaN where undetermined
    whole: Estimate  # the whole model in this orientation; see `whole_model`
    accepted: BoolArray  # image points of the network that fit
    spread_px: float  # robust standard deviation of the residuals of the key points
    lost: list[tuple[str, int]]  # (reason why key points were not measured, number)


def orient(
    network: Network,
    estimate: Estimate,
    windows: Windows,
    window_px: int,
    targets: ModelTargets | None,
    lost: list[tuple[str, int]],
) -> OrientedKeyPoints:
    """Adjust the image points of windows that do not overlap, and find the ones that do not fit.

    Raises:
        GeometryError: too few image points are left.
    """
    seen, came = network.image_points, estimate
    good = np.asarray(np.isfinite(windows.xy).all(axis=1))
    apart = points_apart(replace(seen, xy=windows.xy), good, window_px, n_points=len(network.points))
    rows = np.flatnonzero(good & apart[seen.point])
    anew = replace(
        network,
        image_points=ImagePoints(
            seen.image[rows],
            seen.point[rows],
            windows.xy[rows],
            windows.covariance[rows] + SIGMA_PX**2 * np.eye(2),
        ),
    )
    rays = np.full(len(network.points), MIN_RAYS)
    if targets is not None:
        anew, estimate = join_targets(anew, estimate, targets)
        rays = np.concatenate([rays, targets.min_rays])
    try:
        part, start, images, points = part_of(
            anew, estimate, np.ones(len(anew.image_points), dtype=bool), rays
        )
    except GeometryError as error:
        why = describe_reasons(by_count(lost))
        raise GeometryError(
            f"refine: {int(good.sum())} of {len(seen)} key points could be measured anew"
            + (f" (not: {why})" if why else "")
            + f", {len(rows)} of them with windows that do not overlap: too few to adjust; are these the "
            "photographs of the model?"
        ) from error
    alone = part.with_given(ObjectPoints(), ScaleBars())
    adjusted = adjust(alone, start, datum=Datum("free"), reject="huber", covariance=False)
    refuse_undetermined(alone, adjusted, lost)
    v = np.abs(adjusted.residuals)
    fits = np.ones(len(v), dtype=bool)
    matched = part.image_points.point < int(points[: len(network.points)].sum())
    for kind in (~matched, matched):  # targets are measured differently and have other residuals
        if kind.any():
            spread = MAD_TO_SIGMA * float(np.median(v[kind]))
            fits[kind] = (v[kind] <= TOLERANCE_FACTOR * spread).all(axis=1)
    accepted = images[anew.image_points.image] & points[anew.image_points.point]
    accepted[accepted] = fits
    solved = merge_estimate(adjusted.estimate, images, points)
    of_model = points[: len(network.points)]
    model, _ = whole_model(
        network, came, adjusted.estimate, windows, images, of_model, TOLERANCE_FACTOR * spread
    )
    return OrientedKeyPoints(windows, window_px, anew, rows, rays, solved, model, accepted, spread, lost)


def refuse_undetermined(part: Network, adjusted: Adjustment, lost: list[tuple[str, int]]) -> None:
    """Refuse an adjustment without redundancy, since every measurement fits it.

    Raises:
        GeometryError: no redundancy.
    """
    if adjusted.redundancy <= 0:
        why = describe_reasons(by_count(lost))
        raise GeometryError(
            f"refine: {counted(2 * len(part.image_points), 'coordinate')} of {len(part.points)} points "
            f"measured anew in {counted(len(part.images), 'photograph')} leave no redundancy; "
            "hold parameters of the cameras" + (f" (not measured anew: {why})" if why else "")
        )


def reasons_of(windows: Windows, rows: IntArray, *, few: int, masked: int) -> list[tuple[str, int]]:
    """Return the reasons why key points were not measured, with their numbers.

    Args:
        windows: the measured windows.
        rows: image points that should be measured.
        few: number of image points of points that too few photographs see.
        masked: number of image points where the mask is black.
    """
    lost = [(in_words(LsmFlag, flag), int(((windows.flag & flag) != 0).sum())) for flag in LsmFlag if flag]
    templates = int(((windows.flag[rows] == 0) & ~np.isfinite(windows.xy[rows]).all(axis=1)).sum())
    lost.append(("template of a point without a match", templates))
    lost.append((f"of a point that fewer than {MIN_RAYS} photographs see", few))
    lost.append(("where the mask is black", masked))
    return lost


def by_count(reasons: list[tuple[str, int]]) -> tuple[tuple[str, int], ...]:
    """Return the reasons with a number above 0, the most frequent first."""
    return tuple((why, count) for why, count in sorted(reasons, key=lambda reason: -reason[1]) if count)


def describe_reasons(reasons: tuple[tuple[str, int], ...]) -> str:
    """Return the reasons as a list within a sentence."""
    return ", ".join(f"{count} {why}" for why, count in reasons)


def whole_model(
    network: Network,
    estimate: Estimate,
    part: Estimate,
    windows: Windows,
    images: BoolArray,
    points: BoolArray,
    tolerance_px: float,
) -> tuple[Estimate, IntArray]:
    """Return the whole model with its adjusted part, and with its other points intersected.

    If at least three photographs measured such a point again, these rays are intersected. Otherwise all
    original rays are.

    Args:
        network: the model.
        estimate: the original solution of the model.
        part: adjusted part; targets follow the points of the model.
        windows: image points measured again.
        images: photographs of the part, (m,).
        points: points of the part, (n,).
        tolerance_px: largest residual of a ray measured again, px.

    Returns:
        The estimate, and the new image points whose rays meet in points that were not adjusted.
    """
    oriented = with_part(estimate, part, images, points)
    seen, xyz = network.image_points, oriented.points.copy()
    other = ~points[seen.point] & images[seen.image]
    rows = np.flatnonzero(other & np.isfinite(windows.xy).all(axis=1))
    anew = ImagePoints(seen.image[rows], seen.point[rows], windows.xy[rows], windows.covariance[rows])
    n = len(network.points)
    met = intersect_image_points(anew, network.camera, oriented, n_points=n, tolerance_px=tolerance_px)
    enough = met.rays >= MIN_RAYS
    xyz[enough] = met.points[enough]
    oriented = replace(oriented, points=xyz)
    whole = with_intersected(network, oriented, other & ~enough[seen.point])
    return whole, rows[met.used & enough[anew.point]]


def with_part(estimate: Estimate, part: Estimate, images: BoolArray, points: BoolArray) -> Estimate:
    """Return the solution of a model with an adjusted part.

    Args:
        estimate: the original solution.
        part: the adjusted part; targets follow the points of the model.
        images: photographs of the part, (m,).
        points: points of the part, (n,).
    """
    position, rotation, xyz = estimate.position.copy(), estimate.rotation.copy(), estimate.points.copy()
    position[images], rotation[images] = part.position, part.rotation
    xyz[points] = part.points[: int(points.sum())]
    return Estimate(part.cameras, position, rotation, xyz, part.mounts)


def with_intersected(network: Network, estimate: Estimate, rows: BoolArray) -> Estimate:
    """Return the solution of a model with the points of some of its image points, (k,), intersected."""
    met = intersect_image_points(
        network.image_points.select(rows),
        network.camera,
        estimate,
        n_points=len(network.points),
        tolerance_px=np.inf,
    ).points
    again = np.asarray(np.isfinite(met).all(axis=1))
    return replace(estimate, points=np.where(again[:, None], met, estimate.points))


def part_of(
    network: Network, estimate: Estimate, accepted: BoolArray, rays: IntArray
) -> tuple[Network, Estimate, BoolArray, BoolArray]:
    """Return the part of a network that accepted image points determine, and its photographs and points.

    Args:
        network: the whole network.
        estimate: solution of the network.
        accepted: accepted image points, (k,).
        rays: rays that each point needs, (n,).
    """
    images, points = select_determined(network, estimate, accepted, rays)
    part, start = reduce_network(network, estimate, images, points, accepted)
    return part, start, images, points


@dataclass(frozen=True)
class ModelTargets:
    """The coded targets in the photographs of a model."""

    network: Network  # their image points, control and scale bars; photographs as in the model
    points: FloatArray  # target coordinates in the frame of the model, NaN where unknown, (t, 3)
    min_rays: IntArray  # photographs that each target needs, (t,)
    placement: Similarity  # object frame from that of the model
    datum: Datum
    unit: str  # object unit
    contradicting: int  # number of image points that contradict their target
    remarks: tuple[Remark, ...]  # on targets, control and scale bars

    def placed(self) -> ModelTargets:
        """Return the targets in the object frame."""
        return replace(
            self,
            points=self.placement.apply(self.points),
            placement=Similarity(1.0, np.eye(3), np.zeros(3)),
        )


def measure_model_targets(
    survey: Survey,
    network: Network,
    estimate: Estimate,
    images_dir: Path,
    *,
    tolerance_px: float = 5.0,
    progress: Progress = SILENT,
) -> ModelTargets:
    """Find and measure the coded targets in the photographs of a model, and determine the object frame.

    Args:
        survey: states targets, control and scale bars; its cameras are not used.
        network: the model.
        estimate: solution of the model.
        images_dir: folder of the photographs.
        tolerance_px: largest distance of an image point from its intersected target, px; beyond it the image
            point belongs to another target.
        progress: receives every photograph.

    Raises:
        SurveyFileError: the survey has no coded targets, or a photograph of the model is not in the folder.
        PhotographError: a photograph cannot be read, or has another size than its camera.
        GeometryError: no two photographs see the same target, or too few control points or scale bars are
            among the targets.
    """
    family = survey.family
    if family is None:
        raise SurveyFileError(
            f"{survey.source}: refine needs a survey of coded targets, [targets] with codes"
        )
    oriented = np.flatnonzero(estimate.oriented)
    paths = photograph_paths(network, estimate, images_dir)
    names = tuple(network.images[i] for i in oriented)
    in_photographs = []
    progress.stage("targets", len(oriented))
    for i, name in zip(oriented.tolist(), names, strict=True):
        size = estimate.cameras[network.camera[i]].size_px
        photograph = read_of_size(paths[i], name, size, channel=survey.targets.channel)
        in_photographs.append(targets_in(photograph, survey.targets, family))
        progress.advance(name)
    photographs = MeasuredPhotographs(
        names,
        tuple(paths[i] for i in oriented),
        network.camera[oriented],
        estimate.cameras,
        tuple(in_photographs),
        (),
    )
    naming = name_coded(photographs)
    measured = build_network(survey, photographs, naming)
    part = Estimate(
        estimate.cameras, estimate.position[oriented], estimate.rotation[oriented], np.zeros((0, 3))
    )
    points = _intersect_targets(measured, part, tolerance_px)[1]
    if not np.isfinite(points).all(axis=1).any():
        raise GeometryError(
            f"no coded target ({survey.targets.codes}) in two of the {len(names)} photographs of the model"
        )
    circles = check_circles(survey, photographs, naming, measured, replace(part, points=points))
    targets, points, contradicting = _intersect_targets(circles.network, part, tolerance_px)
    placement, found_of_given = _object_frame(survey, targets, points)
    seen = targets.image_points
    return ModelTargets(
        replace(
            targets,
            images=network.images,
            camera=network.camera,
            points=tuple(f"{PREFIX}{name}" for name in targets.points),
            image_points=replace(seen, image=oriented[seen.image]),
        ),
        points,
        min_rays(naming),
        placement,
        Datum(survey.datum.kind),
        survey.unit,
        contradicting,
        (*circles.remarks, *found_of_given),
    )


def join_targets(network: Network, estimate: Estimate, targets: ModelTargets) -> tuple[Network, Estimate]:
    """Return a model with targets appended to its points, and with their control and scale bars."""
    n, added = len(network.points), targets.network
    first, second, control, bars = network.image_points, added.image_points, added.control, added.scale_bars
    joined = ImagePoints.joined([first, replace(second, point=n + second.point)])
    return replace(network, points=network.points + added.points, image_points=joined).with_given(
        ObjectPoints(n + control.point, control.xyz, control.covariance),
        bars.renumbered(n + np.arange(len(added.points))),
    ), replace(estimate, points=np.concatenate([estimate.points, targets.points]))


def _intersect_targets(
    network: Network, estimate: Estimate, tolerance_px: float
) -> tuple[Network, FloatArray, int]:
    """Return the network without contradicting image points, all targets, and the number of these points."""
    seen = network.image_points
    intersected = intersect_image_points(
        seen, network.camera, estimate, n_points=len(network.points), tolerance_px=tolerance_px
    )
    lost = ~intersected.used & np.isfinite(intersected.points[seen.point]).all(axis=1)
    return replace(network, image_points=seen.select(intersected.used)), intersected.points, int(lost.sum())


def _object_frame(
    survey: Survey, targets: Network, points: FloatArray
) -> tuple[Similarity, tuple[Remark, ...]]:
    """Return the transformation from model to object frame, by control, else by scale bars, and remarks.

    Raises:
        GeometryError: the datum is control but fewer than three control points are among the targets, or
            control or scale bars are given but too few are among the targets to give the scale.
    """
    control = targets.control.complete
    known: BoolArray = np.isfinite(points.sum(axis=1))
    on = known[control.point]
    given = () if survey.control is None else survey.control.names
    seen = {targets.points[j] for j in np.flatnonzero(known)}
    lost = [name for name in given if name not in seen]
    bars = [bar for bar in survey.scale_bars if not {bar.start, bar.end} <= seen]
    remarks = []
    if lost:
        remarks.append(remark("names_missing", of="control", names=lost))
    if bars:
        remarks.append(remark("names_missing", of="bars", names=[f"{bar.start} - {bar.end}" for bar in bars]))
    if on.sum() >= MIN_CONTROL:
        placed = fit_similarity(points[control.point[on]], control.xyz[on])
        return placed, tuple(remarks)
    if survey.datum.kind == "control":
        raise GeometryError(
            f"{on.sum()} of {len(given)} control points are targets in two photographs or more, needed "
            f"{MIN_CONTROL}"
        )
    scale = object_scale(targets, Estimate((), np.zeros((0, 3)), np.zeros((0, 3, 3)), points))
    if not scale > 0:
        if given or survey.scale_bars:
            missing = "; ".join(lost.text.rstrip(".") for lost in remarks)
            raise GeometryError(f"nothing gives the model its scale; {missing}")
        return Similarity(1.0, np.eye(3), np.zeros(3)), (remark("scale_undefined", unit=survey.unit),)
    return Similarity(scale, np.eye(3), np.zeros(3)), tuple(remarks)
