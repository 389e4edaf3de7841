"""The key points of a model measured anew by least squares matching, and the model adjusted again."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.quality.error_correlation import with_neighbours
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.conventions import MAD_TO_SIGMA, BoolArray, FloatArray, IntArray
from sfm.display import counted
from sfm.errors import GeometryError
from sfm.matching.lsm.coverage import ALIKE, WINDOWS_PX
from sfm.matching.lsm.projected_points import pictures_of
from sfm.matching.radiometry import odd_window
from sfm.network import Estimate, Network
from sfm.remarks.remark import Remark, remark, unless_note
from sfm.runtime.progress import SILENT, Progress
from sfm.survey.adjusting.solution import TOLERANCE_FACTOR
from sfm.survey.refining.final_adjustment import adjust_finally
from sfm.survey.refining.free_parameters import free_cameras
from sfm.survey.refining.model_photographs import Photographs, outside_masks
from sfm.survey.refining.oriented_windows import (
    Oriented,
    by_count,
    orient,
    part_of,
    reasons_of,
    refuse_undetermined,
    whole_model,
    words_of_reasons,
)
from sfm.survey.refining.targets import ModelTargets
from sfm.survey.refining.windows import (
    MIN_RAYS,
    REDUCED_ALIKE,
    SHRINKS,
    Limits,
    Size,
    Windows,
    best_size,
    match_reduced,
    match_windows,
)

# Over larger windows no surface is a plane, and memory and time grow with the square of the side.
MAX_WINDOW_PX = 101
# Off the axis tangents grow without bounds, and a pixel is worth less and less of them
MAX_OFF_AXIS_DEG = 85.0
# Of the robust spread of the model's residuals, beyond which a key point was another one
MAX_SHIFT_FACTOR = 6.0
MIN_SHIFT_PX = 2.0
UNSUPPORTED = f"of a point that fewer than {MIN_RAYS} photographs match"
# Not only the key points are wrong if the RMS after is more than this part of that before, and sigma0 more
# than twice what windows and surfaces explain; a model that was refined before has as low an RMS as after
HARDLY_BETTER = 0.5
MAX_SIGMA0 = 2.0
BEYOND = f"behind the photograph or more than {MAX_OFF_AXIS_DEG:g} degrees off the axis"


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
    further: IntArray  # image points measured anew of points that others cover, intersected afterwards
    xy: FloatArray  # image points measured anew, NaN where they are not, px, (k, 2)
    window_px: int  # side of the windows
    images: BoolArray  # photographs of the model that were adjusted, (m,)
    points: BoolArray  # points of the model that were adjusted, (n,)
    residuals_before: (
        FloatArray  # computed minus measured in the model as it came, NaN if unknown, px, (k, 2)
    )
    reasons: tuple[tuple[str, int], ...]  # why key points took no part, and how many, most frequent first
    targets: ModelTargets | None = None  # points of the adjustment behind those of the model
    found: tuple[Remark, ...] = ()  # on what was given with them

    @property
    def key_points(self) -> int:
        """Image points of the model."""
        return len(self.model.image_points)

    @property
    def refined(self) -> int:
        """Of these, measured anew in agreement with the adjustment."""
        return int(self.accepted.sum())

    @property
    def readjusted_px(self) -> float:
        """RMS per coordinate of the model's key points adjusted here, px."""
        return self.readjusted.rms_px

    @property
    def after_px(self) -> float:
        """RMS per coordinate of the key points measured anew and adjusted, px."""
        v = self.adjustment.residuals[: len(self.rows)]
        return float(np.sqrt((v[~self.adjustment.rejected[: len(self.rows)]] ** 2).mean()))

    @property
    def accepted(self) -> BoolArray:
        """Image points of the model that are measured anew and agree with the adjustment, (k,)."""
        accepted = np.zeros(self.key_points, dtype=bool)
        accepted[self.rows[~self.adjustment.rejected[: len(self.rows)]]] = True
        accepted[self.further] = True
        return accepted

    @property
    def dependable(self) -> bool:
        """Whether the adjustment converged and determines all but the datum."""
        return self.adjustment.converged and self.adjustment.defect <= self.adjustment.expected_defect

    @property
    def remarks(self) -> tuple[Remark, ...]:
        """What to know before the model is used."""
        own, remarks = self.adjustment, []
        if not own.converged:
            remarks.append(remark("not_converged", iterations=own.iterations))
        if own.defect > own.expected_defect:
            remarks.append(remark("rank_defect", defect=own.defect, expected=own.expected_defect))
        if self.after_px > HARDLY_BETTER * self.readjusted_px and own.sigma0 > MAX_SIGMA0:
            remarks.append(remark("refinement_hardly_better", times=self.after_px / self.readjusted_px))
        lost = [name for name, used in zip(self.model.images, self.images, strict=True) if not used]
        if lost:
            remarks.append(remark("photographs_not_adjusted", photographs=lost))
        measured = remark(
            "key_points_not_measured",
            measured=self.refined,
            total=self.key_points,
            missing=1 - self.refined / max(self.key_points, 1),
        )
        return (*remarks, *unless_note(measured), *own.remarks, *self.found)

    @property
    def points_anew(self) -> BoolArray:
        """Points of the model from image points measured anew, adjusted or intersected, (n,)."""
        anew = self.points.copy()
        anew[self.model.image_points.point[self.further]] = True
        return anew

    @property
    def target_points(self) -> IntArray:
        """Points of the adjustment that are targets."""
        return np.arange(int(self.points.sum()), len(self.adjustment.network.points))


def refine_model(
    network: Network,
    estimate: Estimate,
    images_dir: Path,
    *,
    window_px: int | None = None,
    min_correlation: float = 0.7,
    fixed: tuple[str, ...] = (),
    masks_dir: Path | None = None,
    targets: ModelTargets | None = None,
    progress: Progress = SILENT,
) -> Refinement:
    """Measure all image points of a solved model by least squares matching and adjust it again.

    Windows that overlap measure the same pixels. The orientation is adjusted from points whose windows do
    not, so that its precision is not told too good; the others are intersected afterwards.

    Args:
        network: a solved model, as `adapters.colmap.camera_models.read_model` gives it.
        estimate: its solution.
        images_dir: folder of its photographs.
        window_px: odd side of the windows, at most MAX_WINDOW_PX; what the surface bears if not given.
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
    if window_px is not None and odd_window("refine", window_px) > MAX_WINDOW_PX:
        raise GeometryError(f"refine: window is {window_px} px, needed at most {MAX_WINDOW_PX} px")
    if not 0 <= min_correlation <= 1:
        raise GeometryError(f"refine: smallest correlation is {min_correlation:g}, needed 0 to 1")
    seen = network.image_points
    if not len(seen):
        raise GeometryError("refine: no key point of the model has a point, nothing to refine")
    estimate = replace(estimate, cameras=free_cameras(network, estimate, fixed))
    residuals = pictures_of(estimate, network.camera, seen.image, estimate.points[seen.point]) - seen.xy
    depth, distance = _lengths(network, estimate)
    within = depth > np.cos(np.radians(MAX_OFF_AXIS_DEG)) * distance
    usable = np.isfinite(residuals).all(axis=1) & within
    if not usable.any():
        raise GeometryError("no image point of an oriented photograph in the model, nothing to refine")
    if np.bincount(seen.point[usable]).max() < MIN_RAYS:
        raise GeometryError(
            f"refine: no point of the model in {MIN_RAYS} oriented photographs, nothing to refine"
        )
    before = float(np.sqrt((residuals[usable] ** 2).mean()))
    spread = MAD_TO_SIGMA * float(np.median(np.abs(residuals[usable])))
    progress.stage("adjustment as it came")
    first, start, _, _ = part_of(network, estimate, usable, np.full(len(network.points), MIN_RAYS))
    readjusted = with_neighbours(adjust(first, start, datum=Datum("free"), reject="none"))
    masked = np.zeros(len(seen), dtype=bool)
    if masks_dir is not None:
        masked = outside_masks(network, estimate, masks_dir)
    beyond = int((np.isfinite(depth) & ~usable & ~masked).sum())
    reference = _references(network, estimate, usable & ~masked)
    rows = np.flatnonzero((reference >= 0)[seen.point] & usable & ~masked)
    if not len(rows):
        black = int(masked.sum())
        raise GeometryError(
            f"refine: none of {len(seen)} key points is left to be measured: {black} where the mask is "
            f"black, {len(seen) - black - beyond} of points that fewer than {MIN_RAYS} photographs see"
            + (f", {beyond} {BEYOND}" if beyond else "")
        )
    limits = Limits(max(MIN_SHIFT_PX, MAX_SHIFT_FACTOR * spread), min_correlation)

    def reasons(windows: Windows) -> list[tuple[str, int]]:
        few = len(seen) - len(rows) - int(masked.sum()) - beyond
        return [*reasons_of(windows, rows, few=few, masked=int(masked.sum())), (BEYOND, beyond)]

    def best(orientation: Estimate, sizes: list[Size], spread_px: float, alike: float) -> Size:
        return best_size(
            images_dir,
            network,
            orientation,
            rows,
            reference,
            sizes,
            alike=alike,
            limits=limits,
            tolerance_px=TOLERANCE_FACTOR * spread_px,
        )

    def measured(orientation: Estimate, size: Size) -> Oriented:
        windows = match_windows(
            Photographs(network, estimate, images_dir, shrink=size.shrink),
            network,
            orientation,
            rows,
            reference,
            window_px=size.window_px,
            limits=limits,
            progress=progress,
        )
        progress.stage("adjustment")
        return orient(network, orientation, windows, size.side_px, targets, reasons(windows))

    side_px = WINDOWS_PX[0] if window_px is None else window_px
    size = best(estimate, [Size(side_px, shrink) for shrink in SHRINKS], spread, REDUCED_ALIKE)
    oriented = measured(estimate, size)
    if window_px is None:
        sizes = [Size(side, size.shrink) for side in WINDOWS_PX]
        chosen = best(oriented.whole, sizes, oriented.spread_px, ALIKE)
        if chosen != size:
            size, oriented = chosen, measured(oriented.whole, chosen)
    anew, tolerance_px = oriented.network, TOLERANCE_FACTOR * oriented.spread_px
    progress.stage("matching in reduced photographs")
    windows = match_reduced(
        images_dir,
        network,
        oriented.whole,
        oriented.windows,
        rows,
        reference,
        size=size,
        limits=limits,
        tolerance_px=tolerance_px,
    )
    part, start, images, points = part_of(anew, oriented.solved, oriented.accepted, oriented.rays)
    final, remarks = adjust_finally(
        part,
        start,
        Datum("free") if targets is None else targets.datum,
        matched=int(points[: len(network.points)].sum()),
        unit="" if targets is None else targets.unit,
    )
    refuse_undetermined(part, final, oriented.lost)
    final = with_neighbours(final)
    k = len(oriented.rows)
    adjusted = oriented.rows[
        (oriented.accepted & images[anew.image_points.image] & points[anew.image_points.point])[:k]
    ]
    points = points[: len(network.points)]
    whole, further = whole_model(network, estimate, final.estimate, windows, images, points, tolerance_px)
    taken = np.zeros(len(seen), dtype=bool)
    taken[adjusted], taken[further] = ~final.rejected[: len(adjusted)], True
    rejected = ~taken & (_off_px(network, whole, windows) > tolerance_px)
    rejected[adjusted] = final.rejected[: len(adjusted)]
    left = int((np.isfinite(windows.xy).all(axis=1) & ~taken & ~rejected).sum())
    return Refinement(
        network,
        estimate,
        before,
        readjusted,
        final,
        whole,
        adjusted,
        further,
        windows.xy,
        oriented.window_px,
        images,
        points,
        np.asarray(residuals),
        by_count([*reasons(windows), ("contradict the others", int(rejected.sum())), (UNSUPPORTED, left)]),
        targets,
        remarks if targets is None else (*targets.remarks, *remarks),
    )


def _off_px(network: Network, whole: Estimate, windows: Windows) -> FloatArray:
    """Return the larger residual of each image point measured anew, px; NaN where its point has few, (k,)."""
    seen = network.image_points
    measured = np.isfinite(windows.xy).all(axis=1)
    rays = np.bincount(seen.point[measured], minlength=len(network.points))
    v = pictures_of(whole, network.camera, seen.image, whole.points[seen.point]) - windows.xy
    return np.where(rays[seen.point] >= MIN_RAYS, np.abs(v).max(axis=1), np.nan)


def refinement_text(result: Refinement) -> str:
    """Return the lines that the command line prints."""
    why = words_of_reasons(result.reasons)
    return (
        f"key points    {result.refined} of {result.key_points} measured anew"
        + (f" (not: {why})" if why else "")
        + f"\nadjusted      {int(result.points.sum())} of {int(result.points_anew.sum())} points, "
        f"whose windows of {result.window_px} px do not overlap\n"
        f"RMS before    {result.before_px:.4f} px per coordinate, "
        f"{result.readjusted_px:.4f} px adjusted anew\n"
        f"RMS after     {result.after_px:.4f} px\n"
        f"sigma0        {result.adjustment.sigma0_px:.4f} px (redundancy {result.adjustment.redundancy})\n"
        + _words_of_targets(result)
        + "".join(f"{one.severity}: {one.text}\n" for one in result.remarks)
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
        f"targets       {len(result.target_points)} of {len(own.points)}, {counted(used, 'image point')}"
        + (f" ({elsewhere} more are not where their target is)" if elsewhere else "")
        + ", "
        f"datum {a.datum}, {counted(control, 'control point')}, "
        f"{counted(len(a.network.scale_bars), 'scale bar')}\n"
    )


def _references(network: Network, estimate: Estimate, usable: BoolArray) -> IntArray:
    """Return the row of each point that sees it at its middle scale, -1 for points with few rays, (n,)."""
    seen = network.image_points
    depth, distance = _lengths(network, estimate)
    of = network.camera[seen.image]
    c = np.array([camera.c_px for camera in estimate.cameras])[of]
    wide = np.array([camera.wide_angle for camera in estimate.cameras])[of]
    scale = np.where(usable, c / np.where(wide, distance, depth), np.nan)
    reference = np.full(len(network.points), -1)
    count = np.bincount(seen.point[np.isfinite(scale)], minlength=len(reference))
    order = np.lexsort([scale, seen.point])
    first = np.searchsorted(seen.point[order], np.arange(len(reference)))
    some = (count >= MIN_RAYS) & estimate.determined
    reference[some] = order[first[some] + count[some] // 2]
    return reference


def _lengths(network: Network, estimate: Estimate) -> tuple[FloatArray, FloatArray]:
    """Return depth and distance of the point of each image point, NaN where unknown, (k,) each."""
    seen = network.image_points
    rays = estimate.points[seen.point] - estimate.position[seen.image]
    depth = -np.einsum("ki,ki->k", rays, estimate.rotation[seen.image, :, 2])
    return depth, np.asarray(np.linalg.norm(rays, axis=1))
