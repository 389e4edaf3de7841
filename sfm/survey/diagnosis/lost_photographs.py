"""Diagnosis of photographs without orientation: not connected, without a base, or of a second object.

Photographs from a camera that only rotated at one position have no base. Rotations alone fit them, and no
point has a depth. An adjustment of such photographs has no minimum. It moves along a valley in which the base
is as small as the errors, and accepts the point where it stops as the solution. With a wrong principal
distance it even converges. Parallax is the angle between conjugate rays after the best rotation. It is
computed with the principal distance and the first radial distortion that minimise it. A wall photographed
from the front looks like a rotation with an infinite principal distance. Therefore nothing is refused if the
minimum lies at the limit of the search.

Parts of a survey that do not fit the rest show a second object with the same codes, a mirror image, or a
motion. The photographs without orientation are oriented by themselves, and both parts are adjusted. The
points that they have in common are compared like those of any two results (`sfm.comparison`). If a camera
error that bends the whole explains the difference, there is no second object. The same holds if all but
single points agree.

The orientation of tie points is that of the majority of them. If walkers or vehicles hide most of an object,
the orientation is theirs, and nothing in its precision shows it. Tie points that it does not explain are
oriented by themselves. Random errors have no orientation, but another rigid body has one.

Source: Hartley (1997), Self-calibration of stationary cameras, IJCV 22(1); Foerstner and Wrobel (2016),
Photogrammetric Computer Vision, sec. 13.3.6 (critical configurations); Torr (1998), Geometric motion
segmentation, Phil. Trans. R. Soc. A 356.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.comparison.significance import compare_results
from sfm.judgement.model_choice import Choice, choose
from sfm.model.camera import Camera
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.distributions import FALSE_ALARM
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.likelihood import areas_of_photographs, log_likelihood
from sfm.model.network import Network, empty_estimate, rows_of
from sfm.model.reduced_network import reduce_network, select_supported
from sfm.model.remarks.remark import Remark, remark, unless_note
from sfm.model.similarity import mean_distance, nearest_rotation
from sfm.model.solution import Solution
from sfm.orientation.image_rays import image_tangents, rays_of
from sfm.orientation.incremental.growth import MIN_SHARE, TOLERANCE_FACTOR, residual_lengths
from sfm.orientation.incremental.poor_photographs import best_connected
from sfm.orientation.incremental.sequence import MIN_POINTS, TRIED_FIRST, Orientation
from sfm.survey.diagnosis.photograph_cameras import MAJORITY_FRACTION

MIN_RAYS = 2
MOTION_RAYS = 3  # of a point that shows a motion; two rays can intersect by chance
MOTION_POINTS = 20  # in three photographs or more; with fewer an orientation may fit random motion
MIN_PARALLAX = 10.0  # standard deviations of image points; below it a depth is known to a tenth at best
# Fraction of the points of a pair that may have no depth, such as distant hills behind a near object; the
# remaining fraction may be wrong matches.
MAX_DISTANT_FRACTION = 0.9
MIN_COMMON = 20  # points of a pair of photographs; rotation and camera use up five of their coordinates
SCALES = np.geomspace(0.5, 2.0, 15)  # factors of c that are tried, 10 % apart; the best is refined
TRIMMINGS = 3  # rotations without the half of the pairs of rays that fits worst
# Largest first radial distortion that is tried, on the squared tangent; that of telephones is a few
# hundredths.
MAX_RADIAL = 0.2
STEP = 0.02  # first step of the radial distortion
# About so many pairs, spread over the network, are tried first. Two values of c and distortion are sought,
# which a few pairs determine; where rotations do not fit these, they do not fit all.
PAIRS_FIRST = 20
EVALUATIONS = 80  # of the parallax, by the simplex method of Nelder and Mead
C_FACTORS = (1.4, 0.7, 2.0, 0.5)  # of the given principal distance: a crop factor, an extender, a zoom
# RMS residual, in standard deviations of image points, from which another minimum is searched. It saves the
# search where nothing calls for one; the likelihood of the solutions decides.
MISFIT = 3.0
# If at least this share of the image points fits a central perspective, nothing calls for another one. The
# rest may be wrong matches.
MIN_FITTING_FRACTION = 0.9
PAIR_UNKNOWNS = 7  # of the epipolar geometry of two photographs with unknown cameras


@dataclass(frozen=True)
class LostGroup:
    """Photographs without orientation that belong together."""

    images: IntArray  # indices of the photographs
    shared: IntArray  # their points that oriented photographs determine
    connected: bool  # whether one of them shows enough of these points to be oriented


def explain_lost_photographs(network: Network, orientation: Orientation) -> Orientation:
    """Return the orientation with remarks on groups of photographs that are not connected to the others.

    Photographs with fewer points than any orientation needs get no remark: their failure reason states it.

    Args:
        network: has the named image points.
        orientation: that of this network.
    """
    groups = [
        group
        for group in lost_groups(network, orientation.estimate)
        if not group.connected and len(_points_of(network, group.images)) >= MIN_POINTS
    ]
    if not groups:
        return orientation
    oriented = orientation.estimate.oriented
    reasons = dict(orientation.failures)
    for group in groups:
        for i in group.images:
            count = int(np.isin(_points_of(network, [i]), group.shared).sum())
            reasons[network.images[i]] = remark("photograph_with_few_points", seen=count, needed=MIN_POINTS)
    groups.sort(key=lambda group: -len(group.images))
    remarks = []
    for group in groups:
        theirs = _most_seen_points(network, group.images)
        unconnected = remark(
            "not_connected",
            photographs=[network.images[i] for i in group.images],
            oriented=int(oriented.sum()),
            shared=[network.points[j] for j in group.shared if network.named[j]] or None,
            needed=MIN_POINTS,
            points=theirs if len(theirs) >= MIN_POINTS else None,
            others=_most_seen_points(network, np.flatnonzero(oriented)) or None,
        )
        remarks.append(unconnected)
    failures = tuple((image, reasons[image]) for image, _ in orientation.failures)
    return replace(orientation, failures=failures, remarks=(*orientation.remarks, *remarks))


def lost_groups(network: Network, estimate: Estimate) -> list[LostGroup]:
    """Return the photographs without orientation in groups that could be oriented among themselves."""
    oriented, seen = estimate.oriented, network.image_points
    lost = np.flatnonzero(~oriented)
    rays = np.bincount(seen.point[oriented[seen.image]], minlength=len(network.points))
    in_network = (rays >= 2) | (
        (rays == 1) & estimate.determined
    )  # one ray without coordinates gives no position
    label = np.arange(len(network.images))  # the group of each photograph
    for first, second, common in network.common_points(~oriented[seen.image]):
        linked = label[first[common >= MIN_POINTS]], label[second[common >= MIN_POINTS]]
        links = csr_matrix((np.ones(len(linked[0])), linked), shape=(len(label), len(label)))
        label = connected_components(links, directed=False)[1][label]
    groups = []
    for number in np.unique(label[lost]):
        images = lost[label[lost] == number]
        points = _points_of(network, images)
        most = max(int(in_network[_points_of(network, [i])].sum()) for i in images)
        groups.append(LostGroup(images, points[in_network[points]], most >= MIN_POINTS))
    return groups


def try_other_principal_distances(
    network: Network,
    estimate: Estimate,
    orientation: Orientation | None,
    orient: Callable[[Network, Estimate], Orientation],
    false_alarm: float = FALSE_ALARM,
) -> tuple[Orientation | None, tuple[Remark, ...]]:
    """Return the orientation with another principal distance if that orients more photographs, and remarks.

    Other principal distances are tried if photographs are lost although they show enough points of the
    others. Mirrored pictures do not count, since no principal distance corrects them. The new orientation
    must include most lost photographs and be likelier for all image points: more photographs with much larger
    residuals are no improvement.

    If c is adjusted and all photographs are oriented, but with residuals far larger than the image points
    have, they are tried with the cameras held. A network that estimates its camera while it grows may have
    moved along the valley of c and distance into a false minimum. They are not tried where nearly all image
    points fit as well as those of pairs of photographs do by themselves: no principal distance fits better.
    Many photographs are oriented with them only if that is likelier for a part of them.

    Args:
        network: has the named image points.
        estimate: start values.
        orientation: the orientation with the given principal distance; None if there was none.
        orient: returns the orientation of a network from start values.
        false_alarm: probability that a right result is called wrong.

    Returns:
        The better orientation if the survey adjusts c, else the given one. There are no remarks if no other
        principal distance orients more photographs.
    """
    m, seen = len(network.images), network.image_points
    if not len(seen):
        return orientation, ()
    lost = m if orientation is None else _count_unexplained(network, orientation)
    free = all(camera.free[0] for camera in estimate.cameras)
    single = lost < 2  # a single lost photograph has another cause
    least = _count_oriented(orientation) + (0 if single else int(MAJORITY_FRACTION * lost) + 1)
    limit = MISFIT * seen.median_sigma_px

    def starts(before: Orientation | None) -> list[Estimate]:
        if not single:
            return [_with_c(estimate, factor, free=True) for factor in C_FACTORS]
        if before is None or not free or before.rms_px <= limit or _fits_as_pairs(network, before):
            return []
        if _part_excludes_another_c(network, estimate, before, orient, false_alarm):
            return []
        return [_with_c(estimate, factor, free=False) for factor in (1.0, *C_FACTORS)]

    def gain(before: Orientation | None, after: Orientation | None) -> float:
        if _count_oriented(after) < least:
            return -math.inf
        return _likelihood(network, estimate.cameras, after) - _likelihood(network, estimate.cameras, before)

    def all_fits(after: Orientation | None) -> bool:
        return after is not None and _count_oriented(after) == m and after.rms_px <= limit

    row = Choice(starts, gain, lambda _, __: [(1, len(seen))], suffices=all_fits)
    best = choose(orientation, (row,), partial(orient, network), false_alarm=false_alarm)
    if best is None or best is orientation:
        return orientation, ()
    taken = orientation
    if free:  # the same parameters as in the start values
        pairs = zip(best.estimate.cameras, estimate.cameras, strict=True)
        cameras = tuple(replace(after, free=before.free) for after, before in pairs)
        taken = replace(best, estimate=replace(best.estimate, cameras=cameras))
    if single:
        return taken, ()
    remarks = tuple(
        remark(
            "c_looks_wrong",
            camera=given.name,
            given=(given.c_px * float(np.mean(given.pixel_mm)), "mm"),
            better=(better.c_px * float(np.mean(given.pixel_mm)), "mm"),
            oriented=_count_oriented(best),
            total=m,
            before=_count_oriented(orientation),
        )
        for given, better in zip(estimate.cameras, best.estimate.cameras, strict=True)
    )
    return taken, remarks


def _part_excludes_another_c(
    network: Network,
    estimate: Estimate,
    orientation: Orientation,
    orient: Callable[[Network, Estimate], Orientation],
    false_alarm: float,
) -> bool:
    """Return whether no other principal distance is likelier for the best connected of many photographs.

    A wrong one would not fit them either, as photographs of a camera share it. A part without a camera says
    nothing of that one.
    """
    oriented = orientation.estimate.oriented
    images = best_connected(network, orientation.estimate, TRIED_FIRST)
    if len(np.unique(network.camera[images])) < len(np.unique(network.camera[oriented])):
        return False
    if images.sum() == oriented.sum():
        return False
    rows = images[network.image_points.image]
    points = _count_rays(network, rows) >= MIN_RAYS
    rows &= points[network.image_points.point]
    part, start = reduce_network(network, estimate, images, points, rows)
    of_part = reduce_network(network, orientation.estimate, images, points, rows)[1]
    fits = orientation.fits[rows]
    square = float((residual_lengths(part, of_part)[fits] ** 2).mean()) if fits.any() else np.inf
    before = replace(orientation, estimate=of_part, fits=fits, failures=(), rms_px=math.sqrt(square / 2))
    return try_other_principal_distances(part, start, before, orient, false_alarm)[0] is before


def _count_oriented(orientation: Orientation | None) -> int:
    """Return the number of oriented photographs."""
    return 0 if orientation is None else int(orientation.estimate.oriented.sum())


def _count_unexplained(network: Network, orientation: Orientation) -> int:
    """Return how many photographs are lost although they show enough points and are not mirrored."""
    mirrored = [image for image, reason in orientation.failures if reason.kind == "photograph_mirrored"]
    lost = [
        i
        for group in lost_groups(network, orientation.estimate)
        if group.connected
        for i in group.images.tolist()
    ]
    return sum(network.images[i] not in mirrored for i in lost)


def _fits_as_pairs(network: Network, orientation: Orientation) -> bool:
    """Return whether an orientation fits as well as the epipolar geometries of pairs, whatever their cameras.

    They are those of the pairs that connect the network, from the image points that fit the orientation.

    Source: Hartley and Zisserman (2003), sec. 11.1 (eight points) and 11.4.3 (Sampson's distance).
    """
    if orientation.fits.mean() < MIN_FITTING_FRACTION:
        return False
    xy, squares, redundancy = network.image_points.xy, 0.0, 0
    for a, b in _conjugate_points(network):
        fit = orientation.fits[a] & orientation.fits[b]
        first, second = xy[a[fit]], xy[b[fit]]
        F = cv2.findFundamentalMat(first, second, cv2.FM_8POINT)[0] if len(first) >= MIN_COMMON else None
        if F is None:
            continue
        x, y = (np.column_stack([of_pair, np.ones(len(of_pair))]) for of_pair in (first, second))
        lines, lines_back = x @ F.T, y @ F
        slopes = (lines[:, :2] ** 2).sum(axis=1) + (lines_back[:, :2] ** 2).sum(axis=1)
        squares += float((np.einsum("ki,ki->k", y, lines) ** 2 / slopes).sum())
        redundancy += len(x) - PAIR_UNKNOWNS
    return redundancy > 0 and orientation.rms_px**2 <= squares / redundancy


def _likelihood(network: Network, cameras: tuple[Camera, ...], orientation: Orientation | None) -> float:
    """Return the log-likelihood of all image points; without an orientation all are misfits."""
    areas = areas_of_photographs(network, cameras)
    fits = np.zeros(len(areas), dtype=bool) if orientation is None else orientation.fits
    squares = 0.0 if orientation is None else orientation.rms_px**2 * 2 * float(fits.sum())
    return log_likelihood(squares, fits, areas)


def _with_c(estimate: Estimate, factor: float, *, free: bool) -> Estimate:
    """Return start values with another principal distance; c is free, or all camera parameters are held."""
    cameras = []
    for camera in estimate.cameras:
        p, focal = camera.parameters.copy(), camera.parts[0]
        p[focal] *= factor
        adjusted = camera.free | focal if free else np.zeros_like(camera.free)
        cameras.append(replace(camera.with_parameters(p), free=adjusted))
    return replace(estimate, cameras=tuple(cameras))


def _most_seen_points(network: Network, images: IntArray) -> list[str]:
    """Return the names of the points that these photographs show most often, of those that people know."""
    seen = network.image_points.select(network.named[network.image_points.point])
    rays = np.bincount(seen.point[np.isin(seen.image, images)], minlength=len(network.points))
    order = np.argsort(-rays, kind="stable")[: MIN_POINTS + 2]
    return [network.points[j] for j in order if rays[j]]


def _points_of(network: Network, images: IntArray | list[int]) -> IntArray:
    """Return the points that these photographs show."""
    seen = network.image_points
    return np.unique(seen.point[np.isin(seen.image, images)])


def refuse_no_base(network: Network, cameras: tuple[Camera, ...]) -> None:
    """Refuse photographs whose conjugate rays fit rotations alone, except for gross errors.

    Args:
        network: has image points with their standard deviations.
        cameras: start values.

    Raises:
        GeometryError: the parallax of every pair of photographs that connects the network is below
            MIN_PARALLAX standard deviations of its image points.
    """
    pairs = _conjugate_points(network)
    if not pairs:
        return
    needed = MIN_PARALLAX * network.image_points.median_sigma_px
    xy, turns = network.image_points.xy, ""
    parallax = np.array(
        [np.quantile(np.linalg.norm(xy[a] - xy[b], axis=1), MAX_DISTANT_FRACTION) for a, b in pairs]
    )
    if parallax.max() < needed:  # no rotation either, whatever the camera
        turns = "; if the object turns before a background that stands still, mask the background"
    else:
        few = pairs[:: 1 + len(pairs) // PAIRS_FIRST]
        least = _least_parallax(network, cameras, few)
        if len(few) < len(pairs) and (least is None or least.max() < needed):
            least = _least_parallax(network, cameras, pairs)
        if least is None or not least.max() < needed:
            return
        parallax = least
    raise GeometryError(
        f"orientation: no base: the {len(network.images)} photographs were taken from one position; "
        f"rotations alone fit {MAX_DISTANT_FRACTION:.0%} of their points to {np.median(parallax):.2g} px, "
        f"and depths need {needed:.2g} px; photograph from several places"
        f"{turns}"
    )


def _conjugate_points(network: Network) -> list[tuple[IntArray, IntArray]]:
    """Return the conjugate image points of the pairs of photographs in the strongest connecting tree."""
    seen, m = network.image_points, len(network.images)
    every = np.ones(len(seen), dtype=bool)
    links = [
        (i[common >= MIN_COMMON], j[common >= MIN_COMMON], common[common >= MIN_COMMON])
        for i, j, common in network.common_points(every)
    ]
    first, second, common = (np.concatenate(parts) for parts in zip(*links, strict=True))
    if not len(first):
        return []
    tree = minimum_spanning_tree(csr_matrix((1.0 / common, (first, second)), shape=(m, m))).tocoo()
    rows = rows_of(seen.image, m)
    pairs = []
    for i, j in zip(tree.row.tolist(), tree.col.tolist(), strict=True):
        _, a, b = np.intersect1d(seen.point[rows[i]], seen.point[rows[j]], return_indices=True)
        pairs.append((rows[i][a], rows[j][b]))
    return pairs


def _least_parallax(
    network: Network, cameras: tuple[Camera, ...], pairs: list[tuple[IntArray, IntArray]]
) -> FloatArray | None:
    """Return the parallax of each pair, px, minimised over c and distortion; None at the search limit."""
    from scipy.optimize import minimize  # importing takes half a second, and most surveys never need it

    rows, place = np.unique(np.concatenate([row for pair in pairs for row in pair]), return_inverse=True)
    seen = network.image_points.select(rows)
    ends = np.cumsum([len(a) for pair in pairs for a in pair])
    places = np.split(place, ends[:-1])
    given = image_tangents(seen, network.camera, cameras)
    c_px = np.array([camera.c_px for camera in cameras])[network.camera[seen.image]]

    def parallax(x: FloatArray) -> FloatArray:
        uv = given / np.exp(x[0])
        rays = rays_of(uv * (1 + x[1] * (uv**2).sum(axis=1, keepdims=True)))
        each = zip(places[::2], places[1::2], strict=True)
        return np.array([c_px[a[0]] * np.exp(x[0]) * _parallax(rays[a], rays[b]) for a, b in each])

    def cost(x: FloatArray) -> float:
        if not (SCALES[0] <= np.exp(x[0]) <= SCALES[-1] and abs(x[1]) <= MAX_RADIAL):
            return np.inf
        return float(np.log(np.maximum(parallax(x), np.finfo(float).tiny)).mean())

    start = min((np.array([np.log(scale), 0.0]) for scale in SCALES), key=cost)
    simplex = start + np.array([[0.0, 0.0], [np.log(SCALES[1] / SCALES[0]), 0.0], [0.0, STEP]])
    options = {"initial_simplex": simplex, "maxfev": EVALUATIONS}
    best = minimize(cost, start, method="Nelder-Mead", options=options).x
    inside = SCALES[1] < np.exp(best[0]) < SCALES[-2] and abs(best[1]) < MAX_RADIAL - STEP
    return parallax(best) if inside else None


def _parallax(first: FloatArray, second: FloatArray) -> float:
    """Return the parallax that most conjugate rays, (k, 3), do not exceed after the best rotation, rad."""
    known = np.isfinite(first + second).all(axis=1)  # some image points at wide angles have no ray
    if known.sum() < MIN_COMMON:
        return np.inf
    first = first[known] / np.linalg.norm(first[known], axis=1, keepdims=True)
    second = second[known] / np.linalg.norm(second[known], axis=1, keepdims=True)
    apart = np.zeros(len(first))
    for _ in range(TRIMMINGS):
        near = apart <= np.median(apart)
        R = nearest_rotation(second[near].T @ first[near])
        apart = np.linalg.norm(first @ R.T - second, axis=1)
    return float(np.quantile(apart, MAX_DISTANT_FRACTION))


def find_second_objects(
    network: Network, orientation: Orientation, orient: Callable[[Network, Estimate], Orientation]
) -> dict[str, Remark]:
    """Return the failure reasons, by name, of lost photographs that can be oriented among themselves.

    Args:
        network: its points with lasting names show whether photographs see the same object.
        orientation: its orientation, in which some photographs are missing.
        orient: returns the orientation of a network from start values; raises GeometryError if there is none.
    """
    lasting = network.named[network.image_points.point]
    network = replace(network, image_points=network.image_points.select(lasting))
    orientation = replace(orientation, fits=orientation.fits[lasting])
    seen, names = network.image_points, np.array(network.images, dtype=object)
    left = ~orientation.estimate.oriented
    left &= np.array([len(rows) for rows in rows_of(seen.image, len(names))]) >= MIN_POINTS
    reasons: dict[str, Remark] = {}
    while left.sum() >= 2:
        points = np.isin(np.arange(len(network.points)), seen.point[left[seen.image]])
        every = np.ones(len(seen), dtype=bool)
        start = empty_estimate(network, orientation.estimate.cameras)
        part = reduce_network(network, start, left, points, every)[0]
        part = part.with_given(type(part.control)(), type(part.exterior)())
        try:
            other = orient(part, empty_estimate(part, orientation.estimate.cameras))
        except GeometryError:
            break
        images = np.flatnonzero(left)[other.estimate.oriented]
        left[images] = False
        try:
            reason = _reason_for_misfit(
                _adjust_fitting(network, orientation), _adjust_fitting(part, other), tuple(names[images])
            )
        except (GeometryError, np.linalg.LinAlgError):  # too little is determined to compare
            continue
        if reason is not None:
            reasons |= dict.fromkeys(names[images], reason)
    return reasons


def _adjust_fitting(network: Network, orientation: Orientation) -> Solution | None:
    """Adjust the image points that fit an orientation by themselves; None without a solution."""
    alone = Network(network.images, network.camera, network.points, network.image_points)
    images, points = select_supported(
        alone, orientation.estimate, orientation.fits, min_points=MIN_POINTS, min_rays=MIN_RAYS
    )
    part, start = reduce_network(alone, orientation.estimate, images, points, orientation.fits)
    a = adjust(part, start, datum=Datum("free"), reject="tau")
    if not a.converged or a.undetermined:
        return None
    return a.solution.with_joint_covariance


def _reason_for_misfit(
    others: Solution | None, group: Solution | None, images: tuple[str, ...]
) -> Remark | None:
    """Return why photographs do not fit the others; None if they show the same object or too little of it."""
    if others is None or group is None:
        return None
    compared = compare_results(others, group)
    cause, size = compared.cause, mean_distance(others.estimate.points[compared.pairing.points[:, 0]])
    if cause is not None and cause.row.mirror:
        return remark("photograph_of_mirror_image", photographs=images, points=len(compared.points))
    if compared.majority if cause is None else cause.row.strain or cause.row.bending:
        return None
    rms = float(np.sqrt((compared.point_difference**2).sum(axis=1).mean()))
    return remark(
        "photograph_of_second_object", photographs=images, points=len(compared.points), misfit=rms / size
    )


def find_second_motion(
    network: Network, orientation: Orientation, orient: Callable[[Network, Estimate], Orientation]
) -> tuple[Remark, ...]:
    """Return the remark on tie points whose orientation differs from that of the others, if there are any.

    Args:
        network: has the tie points.
        orientation: its orientation.
        orient: returns the orientation of a network from start values; raises GeometryError if there is none.
    """
    images = orientation.estimate.oriented
    on = images[network.image_points.image]
    tolerance_px = TOLERANCE_FACTOR * orientation.rms_px
    fits = residual_lengths(network, orientation.estimate) <= tolerance_px
    rays, fitting = _count_rays(network, on), _count_rays(network, on & fits)
    left = (rays >= MOTION_RAYS) & (fitting < MIN_SHARE * rays)
    if left.sum() < MOTION_POINTS:
        return ()
    held = tuple(replace(camera, free=np.zeros_like(camera.free)) for camera in orientation.estimate.cameras)
    part, start = reduce_network(network, empty_estimate(network, held), images, left, on)
    try:
        other = orient(part, start)
    except GeometryError:
        return ()
    moved = _count_rays(part, residual_lengths(part, other.estimate) <= tolerance_px) >= MOTION_RAYS
    if moved.sum() < MOTION_POINTS:
        return ()
    seen = part.image_points
    of_moved = np.unique(seen.image[moved[seen.point]])
    others = int(((rays >= MOTION_RAYS) & (fitting >= MIN_SHARE * rays)).sum())
    return unless_note(
        remark(
            "second_motion",
            share=float(moved.sum() / (moved.sum() + others)),
            points=int(moved.sum()),
            photographs=[part.images[i] for i in of_moved],
        )
    )


def _count_rays(network: Network, rows: BoolArray) -> IntArray:
    """Return the number of rays of each object point among the selected image points, (n,)."""
    return np.bincount(network.image_points.point[rows], minlength=len(network.points))
