"""Surface points of a textured survey: windows side by side that cover the oriented photographs.

Windows that overlap measure the same pixels twice. Their errors are correlated, and the result would look too
precise. Therefore windows side by side replace the tie points, which lie anywhere. Every pixel then takes
part once, whatever the size of the windows. The size is a compromise. Over large windows a surface is hardly
plane. In small windows noise that is correlated from pixel to pixel hides the texture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.quality.variance_components import estimate_common_part
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.judgement.survey_result import PhotographTargets
from sfm.matching.lsm.coverage import (
    CoveredPixels,
    first_alike,
    points_apart,
    project_points,
)
from sfm.matching.lsm.surface_planes import on_surface
from sfm.model.camera import project, tangents_from_pixel
from sfm.model.conventions import MAD_TO_SIGMA, AnyArray, BoolArray, FloatArray
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network, without_given
from sfm.model.observations.kind import no_index
from sfm.model.reduced_network import reduce_network
from sfm.model.remarks.remark import Remark, remark, unless_note
from sfm.model.similarity import fit_similarity
from sfm.orientation.incremental.sequence import Orientation
from sfm.orientation.intersection import intersect
from sfm.photographs.masks import Masks
from sfm.photographs.reading import PhotographFiles
from sfm.survey.inputs.measurements import MeasuredPhotographs, Measurements
from sfm.survey.inputs.settings import AdjustSettings, TiePointSettings
from sfm.survey.inputs.start import network_of
from sfm.survey.inputs.survey import Survey
from sfm.survey.measuring.covering_points import (
    CoveringPoints,
    covariance_with_slopes,
    find_covering_points,
)
from sfm.survey.measuring.tie_points import MIN_RAYS, drawn_windows, needed_rays
from sfm.targets.codes.plates import TargetFamily
from sfm.targets.codes.rings import CodeFamily
from sfm.targets.detect import Targets

# Sides of windows that are tried; the first of those with about the best precision is taken. Noise that is
# correlated over several pixels hides the texture of small windows. Over large ones a surface is curved:
# windows of 31 px measure its mean depth, with the same error in all photographs; their standard deviation
# is 0.93 to 1.8 times that of smaller ones.
TRIED_WINDOWS_PX = (15, 11, 21)
TRIAL_PHOTOGRAPHS = 2  # whose points choose the window
TRIAL_RAYS = 100  # with fewer rays the window stays as it is
TRIAL_SIDES = 4  # distance of trial windows in sides: they need not cover the photograph
# Residual of a ray of a tie point, over the spread of all residuals, beyond which it is not on the surface.
TOLERANCE_FACTOR = 6.0
RAYS_OF_NOISE = 10_000  # about so many rays estimate the noise of matching, to a percent
MIN_CONTROL = 3  # points that place the photographs in the system of the control


@dataclass(frozen=True)
class Surface:
    """The network of a survey with all its points, and approximate values."""

    network: Network
    estimate: Estimate
    overlays: tuple[PhotographTargets, ...]  # drawn into each photograph of the report
    remarks: tuple[Remark, ...]


def cover_photographs(
    survey: Survey,
    measured: Measurements,
    start: Orientation,
    *,
    targets: MeasuredPhotographs | None = None,
    jobs: int = 1,
) -> Surface | None:
    """Return the network of a textured survey with points wherever its photographs have texture.

    Args:
        survey: may state the window; states the sigma of an image coordinate.
        measured: the tie points.
        start: orientation of the photographs.
        targets: those of the photographs; what coded ones cover is measured already.
        jobs: number of photographs processed in parallel.

    Returns:
        The network; None if no tie point fits the orientation. Points are named t00001, t00002 ... in the
        order in which they are found, which may differ in the next run. If the windows give fewer rays than
        the tie points that share no pixels, for example if the surface is nowhere plane over them, these are
        the points.
    """
    network, estimate, files = measured.network, start.estimate, measured.files
    settings = survey.texture
    if files is None:
        return None
    seen = network.image_points
    fits = _fitting_rays(network, estimate)
    if not fits.any():
        return None
    path_of = files.path_of()
    paths = [path_of[name] for name in network.images]
    photographs = PhotographFiles(paths)
    surface = replace(network, image_points=seen.select(fits))
    hidden = masked_pixels(Masks(survey.masks), network, estimate)
    if targets is not None:
        hidden = _with_targets(hidden, targets, survey.family, network, estimate)
    window_px = _best_window(photographs, surface, estimate, settings, jobs, hidden)
    covered = find_covering_points(
        photographs,
        surface,
        estimate,
        window_px=window_px,
        side_px=_side(estimate, window_px, settings.max_points),
        hidden=hidden,
        threads=jobs,
    )
    if hidden is not None:
        of_covered = covered.image_points
        kept = hidden.free_positions(of_covered.image, of_covered.xy)
        shown = np.bincount(of_covered.point[kept], minlength=len(covered.points)) >= 2
        covered = _some_points(covered, shown, kept)
    covered = without_far_points(covered, estimate)
    apart = points_apart(seen, fits, settings.window_px, n_points=len(network.points))
    if len(covered.image_points) < (fits & apart[seen.point]).sum():
        images, rays = np.ones(len(network.images), dtype=bool), np.ones(len(seen), dtype=bool)
        tied, values = reduce_network(network, estimate, images, apart, rays)
        return Surface(tied, values, measured.overlays, ())
    points = tuple(f"t{j + 1:05d}" for j in range(len(covered.points)))
    order = np.argsort(covered.image_points.point, kind="stable")
    with_slopes = covariance_with_slopes(covered.image_points, covered.of_slopes)
    covering = network_of(
        survey,
        network.images,
        network.camera,
        points,
        replace(covered.image_points, covariance=with_slopes + survey.adjust.sigma_px**2 * np.eye(2)).select(
            order
        ),
    )
    placed = replace(estimate, points=covered.points)
    covering = _with_common_part(
        covering, placed, covered.image_points.covariance[order], with_slopes[order], survey.adjust
    )
    control = covering.control.complete
    if start.kind != "given" and len(control) >= MIN_CONTROL:  # tie points cannot be placed on control
        placed = fit_similarity(placed.points[control.point], control.xyz).apply_estimate(placed)
    return Surface(
        covering, placed, drawn_windows(covering, paths, window_px), remarks_on_disagreement(covered)
    )


def remarks_on_disagreement(covering: CoveringPoints) -> tuple[Remark, ...]:
    """Return the remark that many of the matched windows contradict each other, if they do."""
    return unless_note(
        remark("windows_disagree", share=1 - len(covering.image_points) / max(covering.matched, 1))
    )


def _with_common_part(
    network: Network,
    estimate: Estimate,
    matching: FloatArray,
    with_slopes: FloatArray,
    settings: AdjustSettings,
) -> Network:
    """Return the network with the share of matching in its covariances estimated from the residuals.

    Residuals do not show the errors of slopes, which have the factor of matching. The median covariance does
    not change: sigma0 still shows how much worse the image points are than expected.

    Args:
        network: covering points with the expected weights.
        estimate: approximate values.
        matching: covariance from matching, px^2, (k, 2, 2).
        with_slopes: the same with the slopes of windows, px^2, (k, 2, 2).
        settings: has the expected sigma of errors that matching does not see, px, and the level of the tests.
    """
    seen = network.image_points
    every = max(1, len(seen) // RAYS_OF_NOISE)
    chosen = np.arange(len(network.points)) % every == 0
    images, rays = np.ones(len(network.images), dtype=bool), np.ones(len(seen), dtype=bool)
    part, start = reduce_network(without_given(network), estimate, images, chosen, rays)

    before: Adjustment | None = None

    def adjust_with(covariance: FloatArray) -> Adjustment:
        nonlocal before
        weighted = replace(part, image_points=replace(part.image_points, covariance=covariance))
        before = adjust(
            weighted,
            start if before is None else before.estimate,
            false_alarm=settings.false_alarm,
            rejected=None if before is None else before.rejected,
        )
        return before

    try:
        factor, common_px = estimate_common_part(adjust_with, matching[chosen[seen.point]], settings.sigma_px)
    except GeometryError:  # the adjustment of the survey reports or repairs it
        return network
    shown = factor**2 * with_slopes + common_px**2 * np.eye(2)
    return with_weights(network, shown)


def with_weights(network: Network, shown: FloatArray) -> Network:
    """Return the network with other covariances of its image points, scaled to the median of those it has.

    Args:
        network: network of k image points.
        shown: covariances whose common factor means nothing, (k, 2, 2).
    """
    seen = network.image_points
    usual = np.median(np.trace(seen.covariance, axis1=1, axis2=2))
    covariance = shown * (usual / np.median(np.trace(shown, axis1=1, axis2=2)))
    return replace(network, image_points=replace(seen, covariance=covariance))


def _fitting_rays(network: Network, estimate: Estimate) -> BoolArray:
    """Return which rays of the tie points fit and belong to points that keep enough rays, (k,)."""
    seen = network.image_points
    projected = project_points(estimate, network.camera, seen.image, estimate.points[seen.point])
    off = np.hypot(projected[:, 0] - seen.xy[:, 0], projected[:, 1] - seen.xy[:, 1])
    known = np.isfinite(off)
    if not known.any():
        return np.asarray(known)
    fits = known & (off <= TOLERANCE_FACTOR * MAD_TO_SIGMA * np.median(off[known]))
    rays = np.bincount(seen.point[fits], minlength=len(network.points))
    needed = needed_rays(network)
    enough = (rays >= needed) & on_surface(seen.select(fits), estimate, needed < MIN_RAYS)
    return np.asarray(fits & enough[seen.point])


def masked_pixels(masks: Masks, network: Network, estimate: Estimate) -> CoveredPixels | None:
    """Return the masked pixels of the photographs; None if there are no masks."""
    if masks.folder is None:
        return None
    sizes = [estimate.cameras[lens].size_px for lens in network.camera]
    black = (masks.black(name, size) for name, size in zip(network.images, sizes, strict=True))
    return CoveredPixels([size[::-1] for size in sizes], black)


def _with_targets(
    hidden: CoveredPixels | None,
    photographs: MeasuredPhotographs,
    family: TargetFamily | None,
    network: Network,
    estimate: Estimate,
) -> CoveredPixels:
    """Return the masked pixels and those of coded targets, also where their codes are not read.

    Their pixels would take part twice. On blank paper with one straight edge, only noise holds a window along
    the edge. Windows at targets of a rendered sheet were three to seven times as far from it as others.
    """
    if hidden is None:
        hidden = CoveredPixels([estimate.cameras[lens].size_px[::-1] for lens in network.camera])
    reach = family.outer if isinstance(family, CodeFamily) else 1.0  # of a target, in radii of its dot
    at = {name: i for i, name in enumerate(network.images)}
    seen = [
        (at[name], targets)
        for name, targets in zip(photographs.names, photographs.targets, strict=True)
        if name in at and estimate.oriented[at[name]]
    ]
    coded = _coded_points(seen, network, estimate)
    for i, targets in seen:
        camera = estimate.cameras[network.camera[i]]
        shown = project(camera, estimate.position[i], estimate.rotation[i], coded)
        distance = np.linalg.norm(targets.xy[:, None] - shown, axis=2)
        covered = (targets.code >= 0) | (distance < targets.semi_axes[:, :1]).any(axis=1)
        sides = 2 * reach * targets.semi_axes[covered, 0]
        hidden.cover(np.full(len(sides), i), targets.xy[covered], sides)
    return hidden


def _coded_points(seen: Sequence[tuple[int, Targets]], network: Network, estimate: Estimate) -> FloatArray:
    """Return the points of the codes that two photographs show, (n, 3)."""
    image = np.concatenate(
        [np.full(int((targets.code >= 0).sum()), i) for i, targets in seen] or [no_index()]
    )
    code = np.concatenate([targets.code[targets.code >= 0] for _, targets in seen] or [no_index()])
    rays = [
        tangents_from_pixel(estimate.cameras[network.camera[i]], targets.xy[targets.code >= 0])
        for i, targets in seen
    ]
    point = np.unique(code, return_inverse=True)[1]
    points = intersect(
        np.concatenate(rays or [np.zeros((0, 2))]), image, point, estimate.position, estimate.rotation
    ).points
    return np.asarray(points[np.isfinite(points).all(axis=1)])


def without_far_points(covering: CoveringPoints, estimate: Estimate) -> CoveringPoints:
    """Return the points without two-ray points that are off the surface of their neighbours.

    The windows of these points agree with each other, so they no longer count as matched rays either.

    Args:
        covering: the points.
        estimate: orientation of the photographs.
    """
    seen, n = covering.image_points, len(covering.points)
    two = np.bincount(seen.point, minlength=n) < MIN_RAYS
    good = on_surface(seen, replace(estimate, points=covering.points), two)
    return _some_points(covering, good, np.ones(len(seen), dtype=bool))


def _some_points(covering: CoveringPoints, points: BoolArray, rays: BoolArray) -> CoveringPoints:
    """Return some points (n,) and rays (k,) of covering points."""
    seen = covering.image_points
    kept = points[seen.point] & rays
    number = np.cumsum(points) - 1
    return CoveringPoints(
        replace(seen.select(kept), point=number[seen.point[kept]]),
        covering.points[points],
        covering.of_slopes[kept],
        covering.residuals[kept],
        covering.matched - int((~kept).sum()),
    )


def _side(estimate: Estimate, window_px: int, most: int) -> int:
    """Return the side of the squares, px: a window, or larger if a photograph would have too many, odd."""
    area = max(lens.size_px[0] * lens.size_px[1] for lens in estimate.cameras)
    return max(window_px, int(np.sqrt(area / most)) | 1)


def _best_window(
    photographs: Sequence[AnyArray],
    surface: Network,
    estimate: Estimate,
    settings: TiePointSettings,
    jobs: int,
    hidden: CoveredPixels | None = None,
) -> int:
    """Return the side of TRIED_WINDOWS_PX whose rays together have the smallest standard deviation, px."""
    most = np.argsort(-np.bincount(surface.image_points.image, minlength=len(photographs)), kind="stable")
    costs: list[tuple[int, float]] = []
    sides_px = (settings.window_px,) if "window_px" in settings.model_fields_set else TRIED_WINDOWS_PX
    for window_px in sides_px:
        side = _side(estimate, window_px, settings.max_points)
        trial_side = max(TRIAL_SIDES * window_px + 1, side)
        trial = find_covering_points(
            photographs,
            surface,
            estimate,
            window_px=window_px,
            side_px=trial_side,
            references=most[:TRIAL_PHOTOGRAPHS].tolist(),
            hidden=hidden,
            threads=jobs,
        )
        if len(trial.residuals) >= TRIAL_RAYS:
            spread = MAD_TO_SIGMA * float(np.median(np.abs(trial.residuals)))
            rays = len(trial.residuals) * (trial_side / side) ** 2  # of windows side by side
            costs.append((window_px, spread / np.sqrt(rays)))
    return first_alike(costs) if costs else settings.window_px
