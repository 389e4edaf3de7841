"""The key points of an existing model measured anew by multi-photo matching, and the model adjusted again."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.camera import Camera
from sfm.conventions import MAD_TO_SIGMA, BoolArray, FloatArray, IntArray
from sfm.distortion.models import Role
from sfm.errors import GeometryError, PhotographError, SurveyFileError
from sfm.matching.lsm.multi_photo import match_multi
from sfm.matching.lsm.projected_points import pictures_of
from sfm.matching.match_flags import LsmFlag, in_words
from sfm.matching.radiometry import odd_window
from sfm.network import Estimate, ImagePoints, Network
from sfm.photographs.reading import read_photograph
from sfm.reduced_network import reduce_network
from sfm.runtime.progress import SILENT, Progress
from sfm.survey.adjusting.settling import FALSE_ALARM, determined, merge_estimate
from sfm.survey.adjusting.solution import TOLERANCE_FACTOR

MIN_RAYS = 3
MIN_PHOTOGRAPHS = 4  # of a camera whose principal point is freed
# Over larger windows no surface is a plane, and memory and time grow with the square of the side.
MAX_WINDOW_PX = 101
SIGMA_PX = 0.02  # of a matched point, on top of what matching knows: surfaces are not plane over a window
ORIENTATION_FACTOR = (
    3.0  # of the robust spread of the model's residuals, by which its projected points may be off
)
MAX_SHIFT_FACTOR = 6.0  # of that spread, beyond which a key point was another one
MIN_SHIFT_PX = 2.0
NOTHING = np.zeros((1, 1))  # in place of a photograph that the model has not oriented


@dataclass(frozen=True)
class Refinement:
    """A model before and after its key points were measured anew."""

    before_px: float  # RMS per coordinate of the model as it came, px
    readjusted_px: float  # the same points adjusted here, without rejection, px
    after_px: float  # measured anew and adjusted, accepted points, px
    adjustment: Adjustment  # of the points measured anew
    key_points: int  # of the model
    refined: int  # of these, matched and part of the adjustment
    reasons: tuple[tuple[str, int], ...]  # why key points took no part, and how many, most frequent first


def refine_model(
    network: Network,
    estimate: Estimate,
    images_dir: Path,
    *,
    window_px: int = 15,
    min_correlation: float = 0.7,
    fixed: tuple[str, ...] = (),
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
        progress: told of stages and photographs.

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
    photographs_of = np.bincount(network.camera[estimate.oriented], minlength=len(estimate.cameras))
    cameras = tuple(
        _freed(camera, int(count), fixed)
        for camera, count in zip(estimate.cameras, photographs_of, strict=True)
    )
    estimate = replace(estimate, cameras=cameras)
    residuals = pictures_of(estimate, network.camera, seen.image, estimate.points[seen.point]) - seen.xy
    usable = np.isfinite(residuals).all(axis=1)
    if not usable.any():
        raise GeometryError("no image point of an oriented photograph in the model, nothing to refine")
    before = float(np.sqrt((residuals[usable] ** 2).mean()))
    spread = MAD_TO_SIGMA * float(np.median(np.abs(residuals[usable])))
    first, start, _, _ = _part(network, estimate, everything)
    readjusted = adjust(first, start, datum=Datum("free"), reject="none", covariance=False)
    progress.stage("photographs", len(network.images))
    photographs = [
        _photograph(network, estimate, images_dir, i, progress) if oriented else NOTHING
        for i, oriented in enumerate(estimate.oriented)
    ]
    progress.stage("matching")
    reference = _references(network, estimate)
    known = reference >= 0
    rows = np.flatnonzero(known[seen.point] & usable)
    number, row_of = np.cumsum(known) - 1, np.full(len(seen), -1)
    row_of[rows] = np.arange(len(rows))
    matches = match_multi(
        photographs,
        replace(estimate, points=estimate.points[known]),
        network.camera,
        seen.image[rows],
        number[seen.point[rows]],
        seen.xy[rows],
        row_of[reference[known]],
        orientation_px=max(ORIENTATION_FACTOR * spread, SIGMA_PX),
        window_px=window_px,
        max_shift_px=max(MIN_SHIFT_PX, MAX_SHIFT_FACTOR * spread),
        min_correlation=min_correlation,
    )
    good = np.isfinite(matches.xy).all(axis=1) & np.isfinite(matches.covariance).all(axis=(1, 2))
    measured = ImagePoints(
        seen.image[rows][good],
        seen.point[rows][good],
        matches.xy[good],
        matches.covariance[good] + SIGMA_PX**2 * np.eye(2),
    )
    progress.stage("adjustment")
    anew = replace(network, image_points=measured)
    part, start, images, points = _part(anew, estimate, np.ones(len(measured), dtype=bool))
    adjusted = adjust(part, start, datum=Datum("free"), reject="huber", covariance=False)
    v = np.abs(adjusted.residuals)
    fits = (v <= TOLERANCE_FACTOR * MAD_TO_SIGMA * np.median(v)).all(axis=1)
    accepted = images[measured.image] & points[measured.point]
    accepted[accepted] = fits
    part, start, _, _ = _part(anew, merge_estimate(estimate, adjusted.estimate, images, points), accepted)
    tests = 2 * len(part.image_points)
    alpha = 1 - (1 - FALSE_ALARM) ** (1 / tests)
    final = adjust(part, start, datum=Datum("free"), reject="tau", alpha=alpha, covariance=True)
    counts = [(in_words(LsmFlag, flag), int(((matches.flag & flag) != 0).sum())) for flag in LsmFlag if flag]
    counts.append((f"of a point that fewer than {MIN_RAYS} photographs see", len(seen) - len(rows)))
    counts.append(("contradict the others", int(good.sum() - (~final.rejected).sum())))
    return Refinement(
        before,
        readjusted.rms_px,
        final.rms_px,
        final,
        len(seen),
        int((~final.rejected).sum()),
        tuple((why, count) for why, count in sorted(counts, key=lambda c: -c[1]) if count),
    )


def refinement_text(result: Refinement) -> str:
    """Return the lines that the command line prints."""
    why = ", ".join(f"{count} {reason}" for reason, count in result.reasons)
    return (
        f"key points    {result.refined} of {result.key_points} measured anew"
        + (f" (not: {why})" if why else "")
        + f"\nRMS before    {result.before_px:.4f} px per coordinate, "
        f"{result.readjusted_px:.4f} px adjusted anew\n"
        f"RMS after     {result.after_px:.4f} px\n"
        f"sigma0        {result.adjustment.sigma0_px:.4f} px (redundancy {result.adjustment.redundancy})\n"
    )


def _part(
    network: Network, estimate: Estimate, accepted: BoolArray
) -> tuple[Network, Estimate, BoolArray, BoolArray]:
    """Return what accepted image points determine, and which photographs and points that are."""
    images, points = determined(network, estimate, accepted, np.full(len(network.points), MIN_RAYS))
    part, start = reduce_network(network, estimate, images, points, accepted)
    return part, start, images, points


def _freed(camera: Camera, photographs: int, fixed: tuple[str, ...]) -> Camera:
    """Free what the image points of a model determine, but for what is to be held.

    Principal distances and principal point, and the distortion that the model has. COLMAP holds the principal
    point unless it is told otherwise; held at a wrong place all photographs are turned to make up for it.

    Args:
        camera: of the model.
        photographs: oriented ones of it; fewer than MIN_PHOTOGRAPHS do not tell the principal point from a
            rotation.
        fixed: names of parameters to hold.
    """
    unknown = [name for name in fixed if name not in camera.names]
    if unknown:
        raise GeometryError(
            f"refine: parameter '{unknown[0]}' of camera {camera.name} is to be held, expected one of "
            + ", ".join(camera.names)
        )
    free = camera.free
    if not free.any():
        free = camera.plays(Role.RADIAL, Role.DENOMINATOR, Role.DECENTRING) & (camera.parameters != 0)
        free |= camera.plays(Role.FOCAL)
        if photographs >= MIN_PHOTOGRAPHS:
            free |= camera.plays(Role.X0, Role.Y0)
    return replace(camera, free=free & ~np.isin(camera.names, fixed))


def _references(network: Network, estimate: Estimate) -> IntArray:
    """Return the row of each point that sees it at its middle scale, -1 for points with few rays, (n,)."""
    seen = network.image_points
    rays = estimate.points[seen.point] - estimate.position[seen.image]
    depth = -np.einsum("ki,ki->k", rays, estimate.rotation[seen.image, :, 2])
    c = np.array([camera.c_px for camera in estimate.cameras])[network.camera[seen.image]]
    scale = np.where(depth > 0, c / depth, np.nan)
    reference = np.full(len(network.points), -1)
    count = np.bincount(seen.point[np.isfinite(scale)], minlength=len(reference))
    order = np.lexsort([scale, seen.point])
    first = np.searchsorted(seen.point[order], np.arange(len(reference)))
    some = (count >= MIN_RAYS) & estimate.determined
    reference[some] = order[first[some] + count[some] // 2]
    return reference


def _photograph(network: Network, estimate: Estimate, folder: Path, i: int, progress: Progress) -> FloatArray:
    path = folder / network.images[i]
    if not path.resolve().is_relative_to(folder.resolve()):
        raise SurveyFileError(
            f"{folder}: photograph '{network.images[i]}' of the model is outside this folder"
        )
    if not path.is_file():
        raise SurveyFileError(
            f"{folder}: photograph '{network.images[i]}' of the model is not in this folder"
        )
    photograph = read_photograph(path)
    width, height = estimate.cameras[network.camera[i]].size_px
    if photograph.shape != (height, width):
        raise PhotographError(
            f"{network.images[i]}: {photograph.shape[1]} x {photograph.shape[0]} px, its camera has "
            f"{width} x {height} px"
        )
    progress.advance(network.images[i])
    return photograph
