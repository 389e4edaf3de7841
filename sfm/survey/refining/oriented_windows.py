"""The orientation of a model from key points and coded targets measured anew."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.conventions import MAD_TO_SIGMA, BoolArray, FloatArray, IntArray
from sfm.display import counted
from sfm.errors import GeometryError, SurveyFileError
from sfm.matching.correlation import LsmFlag, in_words
from sfm.matching.lsm.coverage import points_apart
from sfm.network import Estimate, ImagePoints, Network, ObjectPoints, ScaleBars
from sfm.orientation.image_rays import intersect_image_points
from sfm.reduced_network import determined, merge_estimate, reduce_network
from sfm.remarks.remark import Remark, remark
from sfm.runtime.progress import SILENT, Progress
from sfm.similarity import Similarity, fit_similarity
from sfm.survey.circles import check_circles
from sfm.survey.correspondences import TOLERANCE_FACTOR
from sfm.survey.inputs.measurements import MeasuredPhotographs
from sfm.survey.inputs.survey import Survey
from sfm.survey.measuring.targets import targets_in
from sfm.survey.placing import MIN_CONTROL, object_scale
from sfm.survey.refining.windows import MIN_RAYS, Windows, photograph_paths, read_of_size
from sfm.survey.target_network import build_network, min_rays, name_coded

PREFIX = "target "  # of the names of targets among the points of a model, which may have the same numbers
SIGMA_PX = 0.02  # of a matched point, on top of what matching knows: surfaces are not plane over a window


@dataclass(frozen=True)
class OrientedKeyPoints:
    """Key points measured anew, and the orientation given by those whose windows do not overlap."""

    windows: Windows
    window_px: int
    network: Network  # of these image points and the targets
    rows: IntArray  # image point of the model of each of them, targets behind
    rays: IntArray  # that each point needs
    solved: Estimate  # of these points, NaN where they do not determine it
    whole: Estimate  # the model in this orientation; see `whole_model`
    accepted: BoolArray  # image points of the network that fit
    spread_px: float  # of the residuals of the key points among these
    lost: list[tuple[str, int]]  # why key points were not measured, and how many


def orient(
    network: Network,
    estimate: Estimate,
    windows: Windows,
    window_px: int,
    targets: ModelTargets | None,
    lost: list[tuple[str, int]],
) -> OrientedKeyPoints:
    """Adjust what was measured with windows that do not overlap, and find what does not fit.

    Raises:
        GeometryError: too few.
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
    alone = replace(part, control=ObjectPoints(), scale_bars=ScaleBars())
    adjusted = adjust(alone, start, datum=Datum("free"), reject="huber", covariance=False)
    refuse_undetermined(alone, adjusted, lost)
    v = np.abs(adjusted.residuals)
    fits = np.ones(len(v), dtype=bool)
    matched = part.image_points.point < int(points[: len(network.points)].sum())
    for kind in (~matched, matched):  # targets are measured in another way, with other residuals
        if kind.any():
            spread = MAD_TO_SIGMA * float(np.median(v[kind]))
            fits[kind] = (v[kind] <= TOLERANCE_FACTOR * spread).all(axis=1)
    accepted = images[anew.image_points.image] & points[anew.image_points.point]
    accepted[accepted] = fits
    solved = merge_estimate(adjusted.estimate, images, points)
    of_model = points[: len(network.points)]
    whole, _ = whole_model(
        network, came, adjusted.estimate, windows, images, of_model, TOLERANCE_FACTOR * spread
    )
    return OrientedKeyPoints(windows, window_px, anew, rows, rays, solved, whole, accepted, spread, lost)


def refuse_undetermined(part: Network, adjusted: Adjustment, lost: list[tuple[str, int]]) -> None:
    """Refuse an adjustment that nothing checks: every measurement fits it.

    Raises:
        GeometryError: no redundancy.
    """
    if adjusted.redundancy <= 0:
        why = describe_reasons(by_count(lost))
        raise GeometryError(
            f"refine: {counted(2 * len(part.image_points), 'coordinate')} of {len(part.points)} points "
            "measured anew in "
            f"{counted(len(part.images), 'photograph')} are not more than is to be estimated from them; "
            "hold parameters "
            "of the cameras" + (f" (not measured anew: {why})" if why else "")
        )


def reasons_of(windows: Windows, rows: IntArray, *, few: int, masked: int) -> list[tuple[str, int]]:
    """Return why key points were not measured, and how many.

    Args:
        windows: what was measured.
        rows: image points that were to be measured.
        few: image points of points that too few photographs see.
        masked: where the mask is black.
    """
    lost = [(in_words(LsmFlag, flag), int(((windows.flag & flag) != 0).sum())) for flag in LsmFlag if flag]
    templates = int(((windows.flag[rows] == 0) & ~np.isfinite(windows.xy[rows]).all(axis=1)).sum())
    lost.append(("template of a point without a match", templates))
    lost.append((f"of a point that fewer than {MIN_RAYS} photographs see", few))
    lost.append(("where the mask is black", masked))
    return lost


def by_count(reasons: list[tuple[str, int]]) -> tuple[tuple[str, int], ...]:
    """Return why key points took no part, most frequent first, without what there was none of."""
    return tuple((why, count) for why, count in sorted(reasons, key=lambda one: -one[1]) if count)


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
    """Return the whole model with an adjusted part in it, its other points intersected with what is new.

    Where three photographs or more measured such a point anew these rays meet in it, else all rays as they
    came.

    Args:
        network: the model.
        estimate: as it came.
        part: adjusted, targets behind the points of the model.
        windows: image points measured anew.
        images: photographs of the part, (m,).
        points: points of the part, (n,).
        tolerance_px: largest residual of a ray measured anew.

    Returns:
        The estimate, and the image points measured anew that meet in points which were not adjusted.
    """
    position, rotation, xyz = estimate.position.copy(), estimate.rotation.copy(), estimate.points.copy()
    position[images], rotation[images] = part.position, part.rotation
    xyz[points] = part.points[: int(points.sum())]
    oriented = Estimate(part.cameras, position, rotation, xyz, part.mounts)
    seen = network.image_points
    other = ~points[seen.point] & images[seen.image]
    rows = np.flatnonzero(other & np.isfinite(windows.xy).all(axis=1))
    anew = ImagePoints(seen.image[rows], seen.point[rows], windows.xy[rows], windows.covariance[rows])
    n = len(network.points)
    met = intersect_image_points(anew, network.camera, oriented, n_points=n, tolerance_px=tolerance_px)
    enough = met.rays >= MIN_RAYS
    xyz[enough] = met.points[enough]
    as_it_came = seen.select(other & ~enough[seen.point])
    found = intersect_image_points(
        as_it_came, network.camera, oriented, n_points=n, tolerance_px=np.inf
    ).points
    again = np.isfinite(found).all(axis=1)
    xyz[again] = found[again]
    return replace(oriented, points=xyz), rows[met.used & enough[anew.point]]


def part_of(
    network: Network, estimate: Estimate, accepted: BoolArray, rays: IntArray
) -> tuple[Network, Estimate, BoolArray, BoolArray]:
    """Return what accepted image points determine, and which photographs and points that are.

    Args:
        network: the whole.
        estimate: its solution.
        accepted: image points, (k,).
        rays: that each point needs, (n,).
    """
    images, points = determined(network, estimate, accepted, rays)
    part, start = reduce_network(network, estimate, images, points, accepted)
    return part, start, images, points


@dataclass(frozen=True)
class ModelTargets:
    """The coded targets in the photographs of a model."""

    network: Network  # their image points, control and scale bars; photographs as in the model
    points: FloatArray  # their coordinates by the orientation of the model, NaN where unknown, (t, 3)
    min_rays: IntArray  # photographs that each of them needs, (t,)
    placement: Similarity  # object frame from that of the model
    datum: Datum
    unit: str  # object unit
    contradicting: int  # image points that are not where their target is
    remarks: tuple[Remark, ...]  # on what was given

    def placed(self) -> ModelTargets:
        """Return them in the object frame."""
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
    """Find and measure the coded targets in the photographs of a model, and where the object frame is.

    Args:
        survey: describes the targets, and gives control and scale bars; its cameras are not used.
        network: the model.
        estimate: its solution.
        images_dir: folder of its photographs.
        tolerance_px: of an image point from its intersected target; farther away it is another target's.
        progress: receives photographs.

    Raises:
        SurveyFileError: the survey has no coded targets, or a photograph of the model is not in the folder.
        PhotographError: a photograph that cannot be read, or of another size than its camera.
        GeometryError: no target is seen by two photographs, or fewer of control and bars than are needed.
    """
    family = survey.family
    if family is None or survey.tie_points is not None or survey.observations is not None:
        raise SurveyFileError(
            f"{survey.source}: refine needs a survey of coded targets, [targets] with codes, and neither "
            "tie points nor observations"
        )
    oriented = np.flatnonzero(estimate.oriented)
    paths = photograph_paths(network, estimate, images_dir)
    names = tuple(network.images[i] for i in oriented)
    found = []
    progress.stage("targets", len(oriented))
    for i, name in zip(oriented.tolist(), names, strict=True):
        size = estimate.cameras[network.camera[i]].size_px
        photograph = read_of_size(paths[i], name, size, channel=survey.targets.channel)
        found.append(targets_in(photograph, survey.targets, family))
        progress.advance(name)
    photographs = MeasuredPhotographs(
        names,
        tuple(paths[i] for i in oriented),
        network.camera[oriented],
        estimate.cameras,
        tuple(found),
        (),
    )
    naming = name_coded(photographs)
    measured = build_network(survey, photographs, naming)
    part = Estimate(
        estimate.cameras, estimate.position[oriented], estimate.rotation[oriented], np.zeros((0, 3))
    )
    points = _intersected(measured, part, tolerance_px)[1]
    if not np.isfinite(points).all(axis=1).any():
        raise GeometryError(
            f"no coded target ({survey.targets.codes}) in two of the {len(names)} photographs of the model"
        )
    circles = check_circles(survey, photographs, naming, measured, replace(part, points=points))
    targets, points, contradicting = _intersected(circles.network, part, tolerance_px)
    placement, found_of_given = _placement(survey, targets, points)
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
    """Return a model with targets behind its points, and their control and scale bars."""
    n, added = len(network.points), targets.network
    first, second, control, bars = network.image_points, added.image_points, added.control, added.scale_bars
    joined = ImagePoints(
        np.concatenate([first.image, second.image]),
        np.concatenate([first.point, n + second.point]),
        np.concatenate([first.xy, second.xy]),
        np.concatenate([first.covariance, second.covariance]),
    )
    return replace(
        network,
        points=network.points + added.points,
        image_points=joined,
        control=ObjectPoints(n + control.point, control.xyz, control.covariance),
        scale_bars=ScaleBars(n + bars.start, n + bars.end, bars.length, bars.sigma),
    ), replace(estimate, points=np.concatenate([estimate.points, targets.points]))


def _intersected(
    network: Network, estimate: Estimate, tolerance_px: float
) -> tuple[Network, FloatArray, int]:
    """Return the network without image points that contradict their target, all targets, how many."""
    seen = network.image_points
    found = intersect_image_points(
        seen, network.camera, estimate, n_points=len(network.points), tolerance_px=tolerance_px
    )
    lost = ~found.used & np.isfinite(found.points[seen.point]).all(axis=1)
    return replace(network, image_points=seen.select(found.used)), found.points, int(lost.sum())


def _placement(survey: Survey, targets: Network, points: FloatArray) -> tuple[Similarity, tuple[Remark, ...]]:
    """Return the object frame from that of the model, by control, else by scale bars, and remarks.

    Raises:
        GeometryError: the datum is control, and fewer than three control points are among the targets; or
            control or scale bars are given, and too few of them are among the targets to give the scale.
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
        remarks.append(remark("control_missing", points=lost))
    if bars:
        remarks.append(remark("scale_bars_missing", bars=[f"{bar.start} - {bar.end}" for bar in bars]))
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
            missing = "; ".join(one.text.rstrip(".") for one in remarks)
            raise GeometryError(f"nothing gives the model its scale; {missing}")
        return Similarity(1.0, np.eye(3), np.zeros(3)), (remark("model_keeps_frame"),)
    return Similarity(scale, np.eye(3), np.zeros(3)), tuple(remarks)
