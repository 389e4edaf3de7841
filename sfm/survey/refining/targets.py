"""Coded targets in the photographs of a model: points of it that bring scale and datum."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.errors import GeometryError, SurveyFileError
from sfm.network import Estimate, ImagePoints, Network, ObjectPoints, ScaleBars
from sfm.orientation.image_rays import intersect_image_points
from sfm.remarks.remark import Remark, remark
from sfm.runtime.progress import SILENT, Progress
from sfm.similarity import Similarity, fit_similarity
from sfm.survey.circles import check_circles
from sfm.survey.inputs.measurements import MeasuredPhotographs
from sfm.survey.inputs.survey import Survey
from sfm.survey.measuring.targets import targets_in
from sfm.survey.placing import MIN_CONTROL, object_scale
from sfm.survey.refining.windows import photograph_paths, read_of_size
from sfm.survey.target_network import build_network, min_rays, name_coded

PREFIX = "target "  # of the names of targets among the points of a model, which may have the same numbers


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
