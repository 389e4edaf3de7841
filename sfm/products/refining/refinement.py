"""Refinement of a solved model: its key points are measured again, and the model is adjusted again.

Key points are measured by least squares matching. Windows that do not overlap give the orientation, and the
other points are intersected in it. If coded targets bring control or scale bars, these take part in the final
adjustment. `free_cameras` chooses the interior parameters that are estimated again.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.quality.correlations import with_neighbours
from sfm.adjustment.quality.variance_components import estimate_components
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.judgement.given.free_network import FreeNetwork
from sfm.judgement.given.groups import GivenSettings
from sfm.judgement.given.judge import judge_given
from sfm.matching.correlation import MIN_CORRELATION
from sfm.matching.lsm.coverage import MAX_COST_RATIO, project_points
from sfm.matching.radiometry import odd_window
from sfm.model.camera import Camera
from sfm.model.conventions import MAD_TO_SIGMA, BoolArray, FloatArray, IntArray
from sfm.model.display import counted
from sfm.model.distortion.models import Role
from sfm.model.distributions import FALSE_ALARM
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network, without_given
from sfm.model.reduced_network import check_number
from sfm.model.remarks.remark import Remark, remark, unless_note
from sfm.model.remarks.row import significant
from sfm.products.refining.halves import halves_apart
from sfm.products.refining.joined_cameras import LikeCameras, like_cameras
from sfm.products.refining.oriented_windows import (
    ModelTargets,
    OrientedKeyPoints,
    by_count,
    describe_reasons,
    orient,
    part_of,
    reasons_of,
    refuse_undetermined,
    whole_model,
    with_intersected,
    with_part,
)
from sfm.products.refining.windows import (
    MAX_REDUCED_RATIO,
    MIN_RAYS,
    SHRINKS,
    KeyPoints,
    Limits,
    Size,
    Windows,
    best_size,
    match_reduced,
    match_windows,
    outside_masks,
)
from sfm.runtime.progress import SILENT, Progress
from sfm.survey.adjusting.settling import MANY_ITERATIONS, MAX_ITERATIONS
from sfm.survey.sources.target_matching import TOLERANCE_FACTOR

# Sides of windows that are tried. Larger windows that cover a photograph gain nothing. On a curved surface
# they measure its mean depth, with the same error in all photographs, and no residual shows it.
WINDOWS_PX = (15, 11)
MIN_PHOTOGRAPHS = 4  # of a camera whose principal point is freed
FOCAL_NAMES = ("f", "fx", "fy")  # any of these names holds the only principal distance of a camera
FIRST_RADIAL = {"k": "k1"}  # other name of a single radial coefficient

GROUPS = ("key points", "targets")

# No surface is plane over larger windows, and memory and time grow with the square of the side.
MAX_WINDOW_PX = 101
# Far off the axis tangents grow without bounds.
MAX_OFF_AXIS_DEG = 85.0
# Shift over the robust spread of the model's residuals, beyond which a match is another point.
MAX_SHIFT_FACTOR = 6.0
MIN_SHIFT_PX = 2.0
UNSUPPORTED = f"of a point that fewer than {MIN_RAYS} photographs match"
BEYOND = f"behind the photograph or more than {MAX_OFF_AXIS_DEG:g} degrees off the axis"


@dataclass(frozen=True)
class Refinement:
    """A model before and after its key points were measured again."""

    model: Network  # the original model
    start: Estimate  # its original solution; the parameters to estimate are free
    before_px: float  # RMS per coordinate of the original model, px
    readjusted: Adjustment  # of the original key points, without rejection
    adjustment: Adjustment  # of the new image points
    estimate: Estimate  # the whole model: adjusted values, other points intersected, the rest original
    rows: IntArray  # image point of the model for each one of the adjustment but the targets, (k,)
    further: IntArray  # new image points that were not adjusted but intersected afterwards
    xy: FloatArray  # new image points, NaN if not measured, px, (k, 2)
    window_px: int  # side of the windows
    images: BoolArray  # photographs of the model that were adjusted, (m,)
    points: BoolArray  # points of the model that were adjusted, (n,)
    residuals_before: FloatArray  # computed minus measured in the original model, px, NaN if unknown, (k, 2)
    reasons: tuple[tuple[str, int], ...]  # (why key points took no part, number), most frequent first
    targets: ModelTargets | None = None  # they follow the points of the model in the adjustment
    found: tuple[Remark, ...] = ()  # on targets, control and scale bars
    halves: tuple[float, float] = (np.nan, np.nan)
    """RMS difference of projection centres of two halves of the points, before and after, relative to the
    distance; see `halves_apart`"""
    like: tuple[LikeCameras, ...] = ()  # cameras that could be one
    as_it_came: Estimate = field(kw_only=True)  # the whole model, adjusted with its original key points

    @property
    def better(self) -> bool:
        """Whether halves of the points differ less than before, or cannot be compared."""
        return not self.halves[1] >= self.halves[0]

    @property
    def key_points(self) -> int:
        """Number of image points of the model."""
        return len(self.model.image_points)

    @property
    def refined(self) -> int:
        """Number of image points that were measured again and agree with the adjustment."""
        return int(self.accepted.sum())

    @property
    def readjusted_px(self) -> float:
        """RMS per coordinate of the original key points after adjustment, px."""
        return self.readjusted.rms_px

    @property
    def after_px(self) -> float:
        """RMS per coordinate of the new key points after adjustment, px."""
        v = self.adjustment.residuals[: len(self.rows)]
        return float(np.sqrt((v[~self.adjustment.rejected[: len(self.rows)]] ** 2).mean()))

    @property
    def accepted(self) -> BoolArray:
        """Image points of the model that were measured again and agree with the adjustment, (k,)."""
        accepted = np.zeros(self.key_points, dtype=bool)
        accepted[self.rows[~self.adjustment.rejected[: len(self.rows)]]] = True
        accepted[self.further] = True
        return accepted

    @property
    def dependable(self) -> bool:
        """Whether the adjustment converged and determines everything except the datum."""
        return self.adjustment.converged and self.adjustment.defect <= self.adjustment.expected_defect

    @property
    def remarks(self) -> tuple[Remark, ...]:
        """Remarks to read before the model is used."""
        adjustment, remarks = self.adjustment, []
        if not adjustment.converged:
            remarks.append(remark("not_converged", iterations=adjustment.iterations))
        if adjustment.defect > adjustment.expected_defect:
            remarks.append(
                remark("rank_defect", defect=adjustment.defect, expected=adjustment.expected_defect)
            )
        if not self.better:
            remarks.append(remark("refinement_not_better", times=self.halves[1] / self.halves[0]))
        lost = [name for name, used in zip(self.model.images, self.images, strict=True) if not used]
        if lost:
            remarks.append(remark("photographs_not_adjusted", photographs=lost))
        measured = remark(
            "key_points_not_measured",
            measured=self.refined,
            total=self.key_points,
            missing=1 - self.refined / max(self.key_points, 1),
        )
        return (*remarks, *unless_note(measured), *adjustment.remarks, *self.found)

    @property
    def points_anew(self) -> BoolArray:
        """Points of the model from new image points, adjusted or intersected, (n,)."""
        anew = self.points.copy()
        anew[self.model.image_points.point[self.further]] = True
        return anew

    @property
    def target_points(self) -> IntArray:
        """Indices of the targets among the points of the adjustment."""
        return np.arange(int(self.points.sum()), len(self.adjustment.network.points))


@dataclass(frozen=True)
class RefineSettings:
    """Settings for measuring the image points of a model again.

    Raises:
        GeometryError: an impossible window or correlation.
    """

    window_px: int | None = None  # odd side of the windows, at most MAX_WINDOW_PX; None: chosen by trial
    min_correlation: float = MIN_CORRELATION  # smallest coefficient r of a window and its template, 0 to 1
    fixed: tuple[str, ...] = ()  # interior parameters held at the values of the model, such as fx, cx or k1
    masks_dir: Path | None = None
    """folder of masks, named like their photographs plus .png; key points on black take no part"""
    false_alarm: float = FALSE_ALARM  # probability that right image points and given values are called wrong

    def __post_init__(self) -> None:
        """Refuse impossible settings before any photograph is read."""
        if self.window_px is not None and odd_window("refine", self.window_px) > MAX_WINDOW_PX:
            raise GeometryError(f"refine: window is {self.window_px} px, needed at most {MAX_WINDOW_PX} px")
        check_number("refine: false_alarm", self.false_alarm, 0.0, 1.0)
        if not 0 <= self.min_correlation <= 1:
            raise GeometryError(f"refine: smallest correlation is {self.min_correlation:g}, needed 0 to 1")


def refine_model(
    network: Network,
    estimate: Estimate,
    images_dir: Path,
    settings: RefineSettings = RefineSettings(),
    *,
    targets: ModelTargets | None = None,
    progress: Progress = SILENT,
) -> Refinement:
    """Measure all image points of a solved model by least squares matching, and adjust the model again.

    Windows that overlap measure the same pixels, and would make the precision look too good. Therefore only
    windows that do not overlap give the orientation. The other points are intersected afterwards.

    Args:
        network: a solved model, as returned by `adapters.colmap.camera_models.read_model`.
        estimate: solution of the model.
        images_dir: folder of the photographs.
        settings: windows, and the parameters to hold.
        targets: targets in the photographs, in the frame of the estimate; see `measure_model_targets`.
        progress: receives stages and their steps.

    Raises:
        SurveyFileError: a photograph of the model is not in the folder.
        PhotographError: a photograph cannot be read, or has another size than its camera.
        GeometryError: no camera has a parameter of a name to hold, or too little is left to adjust.
    """
    window_px = settings.window_px
    seen = network.image_points
    if not len(seen):
        raise GeometryError("refine: no key point of the model has a point, nothing to refine")
    estimate = replace(estimate, cameras=free_cameras(network, estimate, settings.fixed))
    residuals = project_points(estimate, network.camera, seen.image, estimate.points[seen.point]) - seen.xy
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
    first, start, of_first, held = part_of(network, estimate, usable, np.full(len(network.points), MIN_RAYS))
    readjusted = with_neighbours(adjust(first, start, datum=Datum("free"), reject="none"))
    as_it_came = with_intersected(
        network,
        with_part(estimate, readjusted.estimate, of_first, held),
        usable & ~held[seen.point] & of_first[seen.image],
    )
    masked = np.zeros(len(seen), dtype=bool)
    if settings.masks_dir is not None:
        masked = outside_masks(network, estimate, settings.masks_dir, images_dir)
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
    limits = Limits(max(MIN_SHIFT_PX, MAX_SHIFT_FACTOR * spread), settings.min_correlation)
    keys = KeyPoints(images_dir, network, rows, reference, limits)

    def reasons(windows: Windows) -> list[tuple[str, int]]:
        few = len(seen) - len(rows) - int(masked.sum()) - beyond
        return [*reasons_of(windows, rows, few=few, masked=int(masked.sum())), (BEYOND, beyond)]

    def best(orientation: Estimate, sizes: list[Size], spread_px: float, alike: float) -> Size:
        return best_size(keys, orientation, sizes, alike=alike, tolerance_px=TOLERANCE_FACTOR * spread_px)

    def measured(orientation: Estimate, size: Size) -> OrientedKeyPoints:
        windows = match_windows(keys, orientation, size, progress=progress)
        progress.stage("adjustment")
        return orient(network, orientation, windows, size.side_px, targets, reasons(windows))

    side_px = WINDOWS_PX[0] if window_px is None else window_px
    size = best(estimate, [Size(side_px, shrink) for shrink in SHRINKS], spread, MAX_REDUCED_RATIO)
    oriented = measured(estimate, size)
    if window_px is None:
        sizes = [Size(side, size.shrink) for side in WINDOWS_PX]
        chosen = best(oriented.whole, sizes, oriented.spread_px, MAX_COST_RATIO)
        if chosen != size:
            size, oriented = chosen, measured(oriented.whole, chosen)
    anew, tolerance_px = oriented.network, TOLERANCE_FACTOR * oriented.spread_px
    part, start, images, points = part_of(anew, oriented.solved, oriented.accepted, oriented.rays)
    progress.stage("matching in reduced photographs")
    others = ~points[: len(network.points)]  # adjusted points keep their image points
    windows = match_reduced(
        keys, oriented.whole, oriented.windows, others, size=size, tolerance_px=tolerance_px
    )
    final, remarks = adjust_finally(
        part,
        start,
        Datum("free") if targets is None else targets.datum,
        matched=int(points[: len(network.points)].sum()),
        unit="" if targets is None else targets.unit,
        false_alarm=settings.false_alarm,
    )
    refuse_undetermined(part, final, oriented.lost)
    final = with_neighbours(final)
    k = len(oriented.rows)
    adjusted = oriented.rows[
        (oriented.accepted & images[anew.image_points.image] & points[anew.image_points.point])[:k]
    ]
    points = points[: len(network.points)]
    model, further = whole_model(network, estimate, final.estimate, windows, images, points, tolerance_px)
    taken = np.zeros(len(seen), dtype=bool)
    taken[adjusted], taken[further] = ~final.rejected[: len(adjusted)], True
    # the larger residual of each new image point, NaN if its point has few rays
    known = np.isfinite(windows.xy).all(axis=1)
    rays = np.bincount(seen.point[known], minlength=len(network.points))
    v = project_points(model, network.camera, seen.image, model.points[seen.point]) - windows.xy
    residual_px = np.where(rays[seen.point] >= MIN_RAYS, np.abs(v).max(axis=1), np.nan)
    rejected = ~taken & (residual_px > tolerance_px)
    rejected[adjusted] = final.rejected[: len(adjusted)]
    left = int((np.isfinite(windows.xy).all(axis=1) & ~taken & ~rejected).sum())
    return Refinement(
        network,
        estimate,
        before,
        readjusted,
        final,
        model,
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
        halves=(
            halves_apart(first, readjusted.estimate, ~readjusted.rejected),
            halves_apart(final.network, final.estimate, ~final.rejected),
        ),
        like=like_cameras(final, settings.false_alarm),
        as_it_came=as_it_came,
    )


def refinement_text(result: Refinement) -> str:
    """Return the lines that the command line prints."""
    why = describe_reasons(result.reasons)
    before, after = result.halves
    halves = "halves        not compared: a half of the points leaves fewer than four photographs oriented\n"
    if np.isfinite(before + after):
        halves = (
            "halves        of the points: projection centres differ by "
            f"{significant(1e6 * before)} ppm of the distance before, {significant(1e6 * after)} ppm after\n"
        )
    return (
        f"key points    {result.refined} of {result.key_points} measured anew"
        + (f" (not: {why})" if why else "")
        + f"\nadjusted      {int(result.points.sum())} of {int(result.points_anew.sum())} points, "
        f"whose windows of {result.window_px} px do not overlap\n"
        f"RMS before    {result.before_px:.4f} px per coordinate, "
        f"{result.readjusted_px:.4f} px adjusted anew\n"
        f"RMS after     {result.after_px:.4f} px\n"
        f"sigma0        {result.adjustment.sigma0_px:.4f} px (redundancy {result.adjustment.redundancy})\n"
        + halves
        + _describe_targets(result)
        + "".join(f"{said.severity}: {said.text}\n" for said in result.remarks)
        + "".join(f"cameras       {cameras}\n" for cameras in result.like)
    )


def _describe_targets(result: Refinement) -> str:
    """Return the line on targets, control and scale bars; empty without targets."""
    if result.targets is None:
        return ""
    measured, a = result.targets.network, result.adjustment
    control = len(a.network.control) if a.datum == "control" else 0
    used = int((~a.rejected[len(result.rows) :]).sum())
    elsewhere = result.targets.contradicting
    return (
        f"targets       {len(result.target_points)} of {len(measured.points)}, {counted(used, 'image point')}"
        + (f" ({elsewhere} more are not where their target is)" if elsewhere else "")
        + ", "
        f"datum {a.datum}, {counted(control, 'control point')}, "
        f"{counted(len(a.network.scale_bars), 'scale bar')}\n"
    )


def _references(network: Network, estimate: Estimate, usable: BoolArray) -> IntArray:
    """Return the image point of each point with its median scale, -1 for points with few rays, (n,)."""
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
    usable_points = (count >= MIN_RAYS) & estimate.determined
    reference[usable_points] = order[first[usable_points] + count[usable_points] // 2]
    return reference


def _lengths(network: Network, estimate: Estimate) -> tuple[FloatArray, FloatArray]:
    """Return depth and distance of the point of each image point, NaN where unknown, (k,) each."""
    seen = network.image_points
    rays = estimate.points[seen.point] - estimate.position[seen.image]
    depth = -np.einsum("ki,ki->k", rays, estimate.rotation[seen.image, :, 2])
    return depth, np.asarray(np.linalg.norm(rays, axis=1))


def adjust_finally(
    part: Network, start: Estimate, datum: Datum, *, matched: int, unit: str, false_alarm: float
) -> tuple[Adjustment, tuple[Remark, ...]]:
    """Return the final adjustment with its covariance, and remarks on control and scale bars left out.

    If control or scale bars take part, key points and targets are weighted by their variance components.
    Control and bars then keep their stated standard deviations. Control or a bar that contradicts the key
    points and targets is left out.

    Args:
        part: accepted image points, with control and scale bars.
        start: solution in a free datum, near that of the control.
        datum: datum of position, attitude and scale.
        matched: number of points before the targets.
        unit: object unit.
        false_alarm: probability that right image points, or right given values, are called wrong.
    """

    def tested(network: Network, factor: float | FloatArray, *, reject: str) -> Adjustment:
        return adjust(
            network,
            start,
            datum=datum,
            reject=reject,
            false_alarm=false_alarm,
            options=AdjustmentOptions(image_sigma_factor=factor, max_iterations=MAX_ITERATIONS),
        )

    if not (len(part.scale_bars) or datum.kind == "control"):
        return tested(part, 1.0, reject="tau"), ()
    free = adjust(
        without_given(part),
        start,
        reject="tau",
        false_alarm=false_alarm,
        covariance=False,
        options=AdjustmentOptions(max_iterations=MANY_ITERATIONS),
    )
    given = judge_given(part, FreeNetwork(free), GivenSettings(datum, unit, false_alarm=false_alarm))
    part, datum = given.network, given.datum
    remarks = list(given.remarks)
    if given.placing is not None and datum.kind == "control":
        start = given.placing.apply_estimate(free.estimate)
    checked = tested(part, 1.0, reject="tau")
    good = replace(part, image_points=part.image_points.select(~checked.rejected))
    group = np.asarray(good.image_points.point >= matched, dtype=np.int64)
    _, factor, settled = estimate_components(
        lambda factor: tested(good, factor, reject="none"), group, GROUPS
    )
    if not settled:
        remarks.append(remark("rejection_not_converging", groups=GROUPS))
    weights = factor[np.asarray(part.image_points.point >= matched, dtype=np.int64)]
    return tested(part, weights, reject="tau"), tuple(remarks)


def free_cameras(network: Network, estimate: Estimate, fixed: tuple[str, ...]) -> tuple[Camera, ...]:
    """Return the cameras with the parameters to estimate free; see `_free_determined`.

    Raises:
        GeometryError: a name to hold is not a parameter of any camera.
    """
    known = dict.fromkeys(name for camera in estimate.cameras for name in camera.names)
    for name in fixed:
        if name not in (*known, *_other_names(tuple(known)), *FOCAL_NAMES):
            raise GeometryError(f"parameter '{name}' is to be held, expected one of {', '.join(known)}")
    photographs = np.bincount(network.camera[estimate.oriented], minlength=len(estimate.cameras))
    return tuple(
        _free_determined(camera, int(count), fixed)
        for camera, count in zip(estimate.cameras, photographs, strict=True)
    )


def _other_names(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of the parameters in models with more parameters."""
    return tuple(FIRST_RADIAL.get(name, name) for name in names)


def _free_determined(camera: Camera, photographs: int, fixed: tuple[str, ...]) -> Camera:
    """Free the parameters that the image points of a model determine, except for those to hold.

    These are the principal distances, the principal point, and the distortion that the model has. COLMAP
    fixes the principal point unless asked otherwise. If it is held at a wrong position, rotations of all
    photographs compensate for it.

    photographs: number of oriented photographs of the camera; fewer than MIN_PHOTOGRAPHS do not separate the
    principal point from a rotation.
    fixed: names of parameters to hold; f also stands for fx and fy, and fx or fy for a single f.
    """
    free = camera.free
    if not free.any():
        distortion = camera.plays(Role.RADIAL, Role.DENOMINATOR, Role.DECENTRING, Role.PRISM)
        free = distortion & (camera.parameters != 0)
        free |= camera.plays(Role.FOCAL)
        if photographs >= MIN_PHOTOGRAPHS:
            free |= camera.plays(Role.X0, Role.Y0)
    held = np.isin(camera.names, fixed) | np.isin(_other_names(camera.names), fixed)
    focal = camera.plays(Role.FOCAL)
    if "f" in fixed or (focal.sum() == 1 and {"fx", "fy"} & set(fixed)):
        held |= focal
    return replace(camera, free=free & ~held)
