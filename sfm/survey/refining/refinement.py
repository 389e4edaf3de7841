"""The key points of an existing model measured anew by multi-photo matching, and the model adjusted again."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.conventions import MAD_TO_SIGMA, BoolArray, FloatArray, IntArray
from sfm.errors import GeometryError
from sfm.matching.lsm.projected_points import pictures_of
from sfm.matching.match_flags import LsmFlag, in_words
from sfm.matching.radiometry import odd_window
from sfm.network import Estimate, ImagePoints, Network, ObjectPoints, ScaleBars
from sfm.orientation.image_rays import image_tangents
from sfm.orientation.intersection import intersect
from sfm.reduced_network import reduce_network
from sfm.runtime.progress import SILENT, Progress
from sfm.survey.adjusting.settling import determined, merge_estimate
from sfm.survey.adjusting.solution import TOLERANCE_FACTOR
from sfm.survey.refining.final_adjustment import adjust_finally
from sfm.survey.refining.free_parameters import free_cameras
from sfm.survey.refining.targets import ModelTargets, join_targets
from sfm.survey.refining.windows import match_windows, outside_masks

MIN_RAYS = 3
# Over larger windows no surface is a plane, and memory and time grow with the square of the side.
MAX_WINDOW_PX = 101
SIGMA_PX = 0.02  # of a matched point, on top of what matching knows: surfaces are not plane over a window
ORIENTATION_FACTOR = (
    3.0  # of the robust spread of the model's residuals, by which its projected points may be off
)
MAX_SHIFT_FACTOR = 6.0  # of that spread, beyond which a key point was another one
MIN_SHIFT_PX = 2.0


@dataclass(frozen=True)
class Refinement:
    """A model before and after its key points were measured anew."""

    model: Network  # as it came
    start: Estimate  # as it came, with the parameters freed that the adjustment estimates
    before_px: float  # RMS per coordinate of the model as it came, px
    readjusted: Adjustment  # the same points adjusted here, without rejection
    adjustment: Adjustment  # of the points measured anew
    estimate: Estimate  # of the whole model: adjusted, else as it came, points of few rays intersected anew
    rows: IntArray  # image point of the model of each one of the adjustment, targets behind them, (k,)
    images: BoolArray  # photographs of the model that were adjusted, (m,)
    points: BoolArray  # points of the model that were adjusted, (n,)
    residuals_before: (
        FloatArray  # computed minus measured in the model as it came, NaN if unknown, px, (k, 2)
    )
    reasons: tuple[tuple[str, int], ...]  # why key points took no part, and how many, most frequent first
    targets: ModelTargets | None = None  # points of the adjustment behind those of the model
    remarks: tuple[str, ...] = ()  # on what was given with them, one line each

    @property
    def key_points(self) -> int:
        """Image points of the model."""
        return len(self.model.image_points)

    @property
    def refined(self) -> int:
        """Of these, matched and part of the adjustment."""
        return int(self.accepted.sum())

    @property
    def readjusted_px(self) -> float:
        """RMS per coordinate of the model's key points adjusted here, px."""
        return self.readjusted.rms_px

    @property
    def after_px(self) -> float:
        """RMS per coordinate of the accepted key points measured anew, px."""
        v = self.adjustment.residuals[: len(self.rows)]
        return float(np.sqrt((v[~self.adjustment.rejected[: len(self.rows)]] ** 2).mean()))

    @property
    def accepted(self) -> BoolArray:
        """Image points of the model that are measured anew and part of the adjustment, (k,)."""
        accepted = np.zeros(self.key_points, dtype=bool)
        accepted[self.rows[~self.adjustment.rejected[: len(self.rows)]]] = True
        return accepted

    @property
    def target_points(self) -> IntArray:
        """Points of the adjustment that are targets."""
        return np.arange(int(self.points.sum()), len(self.adjustment.network.points))


def refine_model(
    network: Network,
    estimate: Estimate,
    images_dir: Path,
    *,
    window_px: int = 15,
    min_correlation: float = 0.7,
    fixed: tuple[str, ...] = (),
    masks_dir: Path | None = None,
    targets: ModelTargets | None = None,
    progress: Progress = SILENT,
) -> Refinement:
    """Measure all image points of a solved model by multi-photo least squares matching and adjust it again.

    Args:
        network: a solved model, as `adapters.colmap.camera_models.read_model` gives it.
        estimate: its solution.
        images_dir: folder of its photographs.
        window_px: odd side of the windows, at most MAX_WINDOW_PX.
        min_correlation: smallest coefficient r of a window and its template, 0 to 1.
        fixed: names of interior parameters that are held at the model's values, as fx, cx or k1.
        masks_dir: folder of masks, named as their photographs with .png behind; key points where a mask is
            black take no part.
        targets: of its photographs, in the frame of the estimate; see `measure_model_targets`.
        progress: told of stages and parts.

    Raises:
        SurveyFileError: a photograph of the model is not in the folder.
        PhotographError: a photograph that cannot be read, or of another size than its camera.
        GeometryError: an impossible window, correlation or name to hold, or too little is left to adjust.
    """
    if odd_window("refine", window_px) > MAX_WINDOW_PX:
        raise GeometryError(f"refine: window is {window_px} px, needed at most {MAX_WINDOW_PX} px")
    if not 0 <= min_correlation <= 1:
        raise GeometryError(f"refine: smallest correlation is {min_correlation:g}, needed 0 to 1")
    seen = network.image_points
    everything = np.ones(len(seen), dtype=bool)
    estimate = replace(estimate, cameras=free_cameras(network, estimate, fixed))
    residuals = pictures_of(estimate, network.camera, seen.image, estimate.points[seen.point]) - seen.xy
    usable = np.isfinite(residuals).all(axis=1)
    if not usable.any():
        raise GeometryError("no image point of an oriented photograph in the model, nothing to refine")
    if np.bincount(seen.point[usable]).max() < MIN_RAYS:
        raise GeometryError(
            f"refine: no point of the model in {MIN_RAYS} oriented photographs, nothing to refine"
        )
    before = float(np.sqrt((residuals[usable] ** 2).mean()))
    spread = MAD_TO_SIGMA * float(np.median(np.abs(residuals[usable])))
    progress.stage("adjustment as it came")
    first, start, _, _ = _part(network, estimate, everything, np.full(len(network.points), MIN_RAYS))
    readjusted = adjust(first, start, datum=Datum("free"), reject="none")
    masked = ~everything if masks_dir is None else outside_masks(network, estimate, masks_dir)
    reference = _references(network, estimate, usable & ~masked)
    rows = np.flatnonzero((reference >= 0)[seen.point] & usable & ~masked)
    if not len(rows):
        black = int(masked.sum())
        raise GeometryError(
            f"refine: none of {len(seen)} key points is left to be measured: {black} where the mask is "
            f"black, {len(seen) - black} of points that fewer than {MIN_RAYS} photographs see"
        )
    windows = match_windows(
        network,
        estimate,
        images_dir,
        rows,
        reference,
        orientation_px=max(ORIENTATION_FACTOR * spread, SIGMA_PX),
        window_px=window_px,
        max_shift_px=max(MIN_SHIFT_PX, MAX_SHIFT_FACTOR * spread),
        min_correlation=min_correlation,
        progress=progress,
    )
    good = np.asarray(np.isfinite(windows.xy).all(axis=1) & np.isfinite(windows.covariance).all(axis=(1, 2)))
    measured = ImagePoints(
        seen.image[good],
        seen.point[good],
        windows.xy[good],
        windows.covariance[good] + SIGMA_PX**2 * np.eye(2),
    )
    lost = [(in_words(LsmFlag, flag), int(((windows.flag & flag) != 0).sum())) for flag in LsmFlag if flag]
    templates = int(((windows.flag[rows] == 0) & ~good[rows]).sum())
    lost.append(("template of a point without a match", templates))
    few = len(seen) - len(rows) - int(masked.sum())
    lost.append((f"of a point that fewer than {MIN_RAYS} photographs see", few))
    lost.append(("where the mask is black", int(masked.sum())))
    progress.stage("adjustment")
    anew, whole = replace(network, image_points=measured), estimate
    rays = np.full(len(network.points), MIN_RAYS)
    if targets is not None:
        anew, whole = join_targets(anew, estimate, targets)
        rays = np.concatenate([rays, targets.min_rays])
    try:
        part, start, images, points = _part(anew, whole, np.ones(len(anew.image_points), dtype=bool), rays)
    except GeometryError as error:
        raise GeometryError(
            f"refine: {int(good.sum())} of {len(seen)} key points could be measured anew, too few to adjust "
            f"(not: {_words_of_reasons(_by_count(lost))}); are these the photographs of the model?"
        ) from error
    alone = replace(part, control=ObjectPoints(), scale_bars=ScaleBars())
    adjusted = adjust(alone, start, datum=Datum("free"), reject="huber", covariance=False)
    v = np.abs(adjusted.residuals)
    fits = np.ones(len(v), dtype=bool)
    matched = part.image_points.point < int(points[: len(network.points)].sum())
    for own in (matched, ~matched):  # targets are measured in another way, with other residuals
        if own.any():
            fits[own] = (v[own] <= TOLERANCE_FACTOR * MAD_TO_SIGMA * np.median(v[own])).all(axis=1)
    accepted = images[anew.image_points.image] & points[anew.image_points.point]
    accepted[accepted] = fits
    solved = merge_estimate(whole, adjusted.estimate, images, points)
    part, start, images, points = _part(anew, solved, accepted, rays)
    final, remarks = adjust_finally(
        part,
        start,
        Datum("free") if targets is None else targets.datum,
        matched=int(points[: len(network.points)].sum()),
        unit="" if targets is None else targets.unit,
    )
    taken = (accepted & images[anew.image_points.image] & points[anew.image_points.point])[: len(measured)]
    accepted_anew = int((~final.rejected[: int(taken.sum())]).sum())
    points = points[: len(network.points)]
    lost.append(("contradict the others", int(good.sum()) - accepted_anew))
    return Refinement(
        network,
        estimate,
        before,
        readjusted,
        final,
        _whole(network, estimate, final.estimate, images, points),
        np.flatnonzero(good)[taken],
        images,
        points,
        np.asarray(residuals),
        _by_count(lost),
        targets,
        remarks if targets is None else (*targets.warnings, *remarks),
    )


def _by_count(reasons: list[tuple[str, int]]) -> tuple[tuple[str, int], ...]:
    """Return why key points took no part, most frequent first, without what there was none of."""
    return tuple((why, count) for why, count in sorted(reasons, key=lambda one: -one[1]) if count)


def _words_of_reasons(reasons: tuple[tuple[str, int], ...]) -> str:
    return ", ".join(f"{count} {why}" for why, count in reasons)


def _whole(
    network: Network, estimate: Estimate, part: Estimate, images: BoolArray, points: BoolArray
) -> Estimate:
    """Return the whole model with an adjusted part in it, its other points intersected with what is new."""
    position, rotation, xyz = estimate.position.copy(), estimate.rotation.copy(), estimate.points.copy()
    position[images], rotation[images] = part.position, part.rotation
    xyz[points] = part.points[: int(points.sum())]  # targets behind them
    seen = network.image_points
    seen = seen.select(~points[seen.point] & images[seen.image])
    tangents = image_tangents(seen, network.camera, part.cameras)
    found = intersect(
        tangents, seen.image, seen.point, position, rotation, n_points=len(network.points)
    ).points
    again = ~points & np.isfinite(found).all(axis=1)
    xyz[again] = found[again]
    return Estimate(part.cameras, position, rotation, xyz)


def refinement_text(result: Refinement) -> str:
    """Return the lines that the command line prints."""
    why = _words_of_reasons(result.reasons)
    return (
        f"key points    {result.refined} of {result.key_points} measured anew"
        + (f" (not: {why})" if why else "")
        + f"\nRMS before    {result.before_px:.4f} px per coordinate, "
        f"{result.readjusted_px:.4f} px adjusted anew\n"
        f"RMS after     {result.after_px:.4f} px\n"
        f"sigma0        {result.adjustment.sigma0_px:.4f} px (redundancy {result.adjustment.redundancy})\n"
        + _words_of_targets(result)
        + "".join(f"warning: {line}\n" for line in result.remarks)
    )


def _words_of_targets(result: Refinement) -> str:
    """Return the line of targets, control and scale bars; none where they were not asked for."""
    if result.targets is None:
        return ""
    own, a = result.targets.network, result.adjustment
    control = len(a.network.control) if a.datum == "control" else 0
    used = int((~a.rejected[len(result.rows) :]).sum())
    elsewhere = result.targets.contradicting
    return (
        f"targets       {len(result.target_points)} of {len(own.points)}, {used} image points"
        + (f" ({elsewhere} more are not where their target is)" if elsewhere else "")
        + ", "
        f"datum {a.datum}, {control} control points, {len(a.network.scale_bars)} scale bars\n"
    )


def _part(
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


def _references(network: Network, estimate: Estimate, usable: BoolArray) -> IntArray:
    """Return the row of each point that sees it at its middle scale, -1 for points with few rays, (n,)."""
    seen = network.image_points
    rays = estimate.points[seen.point] - estimate.position[seen.image]
    depth = -np.einsum("ki,ki->k", rays, estimate.rotation[seen.image, :, 2])
    c = np.array([camera.c_px for camera in estimate.cameras])[network.camera[seen.image]]
    scale = np.where((depth > 0) & usable, c / depth, np.nan)
    reference = np.full(len(network.points), -1)
    count = np.bincount(seen.point[np.isfinite(scale)], minlength=len(reference))
    order = np.lexsort([scale, seen.point])
    first = np.searchsorted(seen.point[order], np.arange(len(reference)))
    some = (count >= MIN_RAYS) & estimate.determined
    reference[some] = order[first[some] + count[some] // 2]
    return reference
