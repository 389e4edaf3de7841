"""What follows from the marks: orientation, points, precision, and places in other photographs.

It is computed anew from the marks, so that the same marks always give the same. Where marks were only
added, the last orientation is continued.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType

import numpy as np

from sfm.matching.radiometry import GreyPhotographs
from sfm.model.camera import Camera
from sfm.model.conventions import AnyArray, IntArray
from sfm.model.display import counted
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, ObjectPoints, ScaleBars
from sfm.products.marking.adjusting import MarkAdjustment, adjust_marks
from sfm.products.marking.clicks import Measured, Template
from sfm.products.marking.guidance import Guide, Look, Predicted, is_same_place, measure_predicted
from sfm.products.marking.orienting import MIN_COMMON, MIN_KNOWN, Evidence, HandOrientation, orient_by_hand
from sfm.products.marking.project import GivenImagePoint, MarkedProject
from sfm.runtime.threads import cores
from sfm.survey.inputs.given_values import ScaleBar
from sfm.survey.inputs.marks_file import Mark, Marking, StatedPoint
from sfm.survey.measuring.templates import TemplateScene, match_templates


@dataclass(frozen=True)
class MarkedNetwork:
    """The network of the marks, and of what was measured automatically."""

    network: Network
    cameras: tuple[Camera, ...]
    keys: tuple[tuple[str, str], ...]  # photograph and point of each image point
    marks: int  # image points that are marks; the others were measured automatically
    control: Mapping[str, StatedPoint]
    bars: tuple[ScaleBar, ...]

    @property
    def point(self) -> dict[str, int]:
        """Index of each point."""
        return {name: j for j, name in enumerate(self.network.points)}


@dataclass(frozen=True)
class Proposal:
    """A place where a photograph should show a point."""

    predicted: Predicted
    point: str
    measured: Measured | None = None  # what is there


@dataclass(frozen=True)
class MarkFit:
    """How an image point fits."""

    place: tuple[float, float]  # px
    residual: tuple[float, float]  # v = computed - measured, px
    test: float  # largest |w|


@dataclass(frozen=True)
class Following:
    """What follows from marks."""

    marked: MarkedNetwork
    orientation: HandOrientation
    adjustment: MarkAdjustment | None
    estimate: Estimate  # adjusted, else oriented
    proposals: Mapping[tuple[str, str], Proposal] = field(default_factory=dict)

    @cached_property
    def residuals(self) -> dict[tuple[str, str], MarkFit]:
        """How each adjusted image point fits, by photograph and point."""
        if self.adjustment is None:
            return {}
        a, rows = self.adjustment.adjustment, self.adjustment.rows
        test = np.abs(a.standardised).max(axis=1) if len(a.standardised) else np.full(len(rows), np.nan)
        seen = self.marked.network.image_points
        return {
            self.marked.keys[k]: MarkFit(
                (float(seen.xy[k, 0]), float(seen.xy[k, 1])), (float(v[0]), float(v[1])), float(w)
            )
            for k, v, w in zip(rows.tolist(), a.residuals, test, strict=True)
        }

    @property
    def guide(self) -> Guide:
        """Where places are predicted."""
        return Guide(self.marked.network, self.estimate, self.adjustment)


def stated_points(project: MarkedProject, marking: Marking) -> dict[str, StatedPoint]:
    """Return the known points of the survey, and those that the person states, which come first."""
    stated = dict[str, StatedPoint]()
    control = project.control
    if control is not None:
        for name, xyz, sigma in zip(control.names, control.xyz, control.sigma, strict=True):
            if np.isfinite(xyz).all() and np.isfinite(sigma).all():
                (x, y, z), (sx, sy, sz) = xyz.tolist(), sigma.tolist()
                stated[name] = StatedPoint((x, y, z), (sx, sy, sz))
    return {**stated, **marking.control}


def scale_bars(project: MarkedProject, marking: Marking) -> tuple[ScaleBar, ...]:
    """Return the scale bars of the survey, and those that the person states, which come first."""
    own = marking.bars
    given = [bar for bar in project.bars if not {(bar.start, bar.end), (bar.end, bar.start)} & own.keys()]
    return (*given, *own.values())


def network_of_marks(project: MarkedProject, marking: Marking) -> MarkedNetwork:
    """Return the network of marks and of automatic image points, which marks of the same point replace."""
    names = project.photographs.names
    index = {name: i for i, name in enumerate(names)}
    control, bars = stated_points(project, marking), scale_bars(project, marking)
    rows = [mark for mark in marking.marks.values() if mark.photograph in index]
    keys = [mark.key for mark in rows]
    xy = [(mark.x, mark.y) for mark in rows]
    sigma_px = project.survey.adjust.sigma_px
    C = [
        np.array(mark.covariance) + (sigma_px**2 * np.eye(2) if mark.by == "measured" else 0.0)
        for mark in rows
    ]
    replaced = marking.marks.keys() | marking.refused.keys()
    for row in automatic_image_points(project):
        key = row.photograph, row.point
        if row.photograph in index and key not in replaced:
            keys.append(key)
            xy.append(row.xy)
            C.append(row.covariance)
    solved = () if project.solution is None else project.solution.network.points
    shown = {point for _, point in keys}
    points = tuple(
        dict.fromkeys((*control, *(name for name in solved if name in shown), *(p for _, p in keys)))
    )
    number = {name: j for j, name in enumerate(points)}
    seen = ImagePoints(
        np.array([index[photograph] for photograph, _ in keys], dtype=np.int64),
        np.array([number[point] for _, point in keys], dtype=np.int64),
        np.array(xy, dtype=float).reshape(-1, 2),
        np.array(C, dtype=float).reshape(-1, 2, 2),
    )
    network = Network(names, project.photographs.camera, points, seen)
    if control:
        variance = np.zeros((len(control), 3, 3))
        variance[:, range(3), range(3)] = np.array([known.sigma for known in control.values()]) ** 2
        network = network.with_given(
            ObjectPoints(
                np.array([number[name] for name in control], dtype=np.int64),
                np.array([known.xyz for known in control.values()], dtype=float),
                variance,
            )
        )
    between = [bar for bar in bars if bar.start in number and bar.end in number]
    if between:
        network = network.with_given(
            ScaleBars(
                np.array([number[bar.start] for bar in between], dtype=np.int64),
                np.array([number[bar.end] for bar in between], dtype=np.int64),
                np.array([bar.length for bar in between], dtype=float),
                np.array([bar.sigma for bar in between], dtype=float),
            )
        )
    return MarkedNetwork(network, project.cameras, tuple(keys), len(rows), control, bars)


def automatic_image_points(project: MarkedProject) -> tuple[GivenImagePoint, ...]:
    """Return what the survey gives and what its result measured, each image point once.

    Natural texture has too many points to look at, and is left out.
    """
    every = {(row.photograph, row.point): row for row in project.given}
    if project.solution is not None:
        network = project.solution.network
        common = np.array([source.has_common_errors for source in network.sources])[network.source]
        seen = network.image_points.select(~common)
        for i, j, (x, y), C in zip(
            seen.image.tolist(), seen.point.tolist(), seen.xy.tolist(), seen.covariance, strict=True
        ):
            key = network.images[i], network.points[j]
            every[key] = GivenImagePoint(*key, (x, y), C)
    return tuple(every.values())


def follow(
    project: MarkedProject, marking: Marking, evidence: Evidence, last: Following | None = None
) -> Following:
    """Return the orientation and adjustment that follow from marks.

    Args:
        project: photographs, cameras and given values.
        marking: the marks.
        evidence: decides between orientations that fit the marks.
        last: what followed from earlier marks.
    """
    marked = network_of_marks(project, marking)
    network = marked.network
    start, in_control = _start(project, marked, last)
    orientation = orient_by_hand(network, start, evidence, in_control=in_control)
    adjustment = adjust_marks(
        network,
        orientation.estimate,
        marked.cameras,
        in_control=orientation.in_control,
        false_alarm=project.survey.adjust.false_alarm,
    )
    estimate = orientation.estimate
    if adjustment is not None:
        whole, images, points = adjustment.estimate, adjustment.images, adjustment.points
        estimate = Estimate(
            whole.cameras,
            np.where(images[:, None], whole.position, estimate.position),
            np.where(images[:, None, None], whole.rotation, estimate.rotation),
            np.where(points[:, None], whole.points, estimate.points),
        )
    return Following(marked, orientation, adjustment, estimate)


def _start(project: MarkedProject, marked: MarkedNetwork, last: Following | None) -> tuple[Estimate, bool]:
    """Return what is oriented already, and whether it is in the frame of the control."""
    network = marked.network
    m, n = len(network.images), len(network.points)
    position, rotation = np.full((m, 3), np.nan), np.full((m, 3, 3), np.nan)
    points, in_control, cameras = np.full((n, 3), np.nan), False, marked.cameras
    number = marked.point
    if last is not None and _continues(marked, last):
        position, rotation = last.estimate.position, last.estimate.rotation
        in_control, cameras = last.orientation.in_control, last.estimate.cameras
        for name, xyz in zip(last.marked.network.points, last.estimate.points, strict=True):
            if name in number:
                points[number[name]] = xyz
    elif project.solution is not None:
        solution = project.solution
        in_control = solution.datum == "control"
        index = {name: i for i, name in enumerate(network.images)}
        for i, name in enumerate(solution.network.images):
            if name in index:
                position[index[name]] = solution.estimate.position[i]
                rotation[index[name]] = solution.estimate.rotation[i]
        for name, xyz in zip(solution.network.points, solution.estimate.points, strict=True):
            if name in number:
                points[number[name]] = xyz
    return Estimate(cameras, position, rotation, points), in_control


def _continues(marked: MarkedNetwork, last: Following) -> bool:
    """Return whether marks were only added, and the earlier orientation is certain."""
    before = last.marked
    same = marked.control == before.control and marked.bars == before.bars
    old, new = (
        before.network.image_points,
        dict(zip(marked.keys, marked.network.image_points.xy, strict=True)),
    )
    kept = all(
        key in new and np.array_equal(new[key], xy) for key, xy in zip(before.keys, old.xy, strict=True)
    )
    certain = not (last.orientation.open or last.orientation.contradicting)
    placed = last.orientation.in_control or not marked.control
    return same and kept and certain and placed and bool(last.estimate.oriented.any())


def propose(
    following: Following,
    marking: Marking,
    read: Callable[[int], AnyArray],
    project: MarkedProject,
    fits: Mapping[tuple[str, str], Measured],
    points: set[str] | None = None,
    known: Mapping[tuple[str, str], Proposal] = MappingProxyType({}),
) -> dict[tuple[str, str], Proposal]:
    """Return the proposals of points: where they should be, and what is measured there.

    Args:
        following: the orientation.
        marking: the marks; refused places are not proposed.
        read: returns the intensities of a photograph, (H, W).
        project: gives names and codes.
        fits: what was measured at the marks, by photograph and point.
        points: the points; all that are marked by hand if None.
        known: earlier proposals, which are not measured again where a place hardly moved.
    """
    guide, names = following.guide, following.marked.network.images
    number, family = following.marked.point, project.survey.family
    wanted = [p for p in marking.points if points is None or p in points]
    found, asked = dict[tuple[str, str], Proposal](), list[tuple[tuple[str, str], Predicted, Look]]()
    for point in wanted:
        if point not in number:
            continue
        look = look_of(point, marking, read, project, fits)
        for predicted in guide.predict(number[point]):
            key = names[predicted.image], point
            if key in marking.refused or key in marking.marks:
                continue
            before = known.get(key)
            if before is not None and is_same_place(before.predicted, predicted):
                found[key] = Proposal(predicted, point, before.measured)
            else:
                found[key] = Proposal(predicted, point)
                asked += [] if look is None else [(key, predicted, look)]
    with ThreadPoolExecutor(cores()) as pool:
        measured = pool.map(lambda row: measure_predicted(read, row[1], row[2], family), asked)
        for (key, predicted, _), fit in zip(asked, measured, strict=True):
            found[key] = Proposal(predicted, key[1], fit)
    return found


def match_single(
    following: Following,
    point: str,
    marking: Marking,
    read: Callable[[int], AnyArray],
    project: MarkedProject,
    fits: Mapping[tuple[str, str], Measured],
) -> dict[tuple[str, str], Proposal]:
    """Return the proposals of a point with one mark: its window matched along the ray of sight.

    Least squares matching finds the depth at which other photographs show its surroundings alike. A feature
    other than a natural point is then measured there by its fit.

    Args:
        following: the orientation, whose adjusted points give the surface.
        point: the point.
        marking: the marks; refused places are not proposed.
        read: returns the intensities of a photograph, (H, W).
        project: gives names and codes.
        fits: what was measured at the marks, by photograph and point.
    """
    marks = [mark for mark in marking.marks.values() if mark.point == point]
    adjustment, network, estimate = following.adjustment, following.marked.network, following.estimate
    if len(marks) != 1 or adjustment is None or marks[0].photograph not in network.images:
        return {}
    mark, i = marks[0], network.images.index(marks[0].photograph)
    look = look_of(point, marking, read, project, fits)
    if look is None or not estimate.oriented[i]:
        return {}
    seen = network.image_points.select(adjustment.rows)
    scene = TemplateScene(
        network,
        estimate,
        replace(seen, source=None, stated=None).select(~adjustment.adjustment.rejected),
        GreyPhotographs(read),
    )
    window_px, levels = project.survey.texture.window_px, project.survey.adjust.levels
    try:
        rays = match_templates(
            scene, i, np.array([[mark.x, mark.y]]), np.full((1, 3), np.nan), window_px, levels, cores()
        ).image_points
    except GeometryError:
        return {}
    found, half = dict[tuple[str, str], Proposal](), window_px // 2
    box = half * np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    for j, xy, C in zip(rays.image.tolist(), rays.xy, rays.covariance, strict=True):
        key = network.images[j], point
        if j == i or key in marking.refused or key in marking.marks:
            continue
        predicted = Predicted(j, xy, C)
        if look.kind == "window":
            fit: Measured | None = Measured(float(xy[0]), float(xy[1]), C, "window", xy + box)
        else:
            fit = measure_predicted(read, predicted, look, project.survey.family)
        found[key] = Proposal(predicted, point, fit)
    return found


def look_of(
    point: str,
    marking: Marking,
    read: Callable[[int], AnyArray],
    project: MarkedProject,
    fits: Mapping[tuple[str, str], Measured],
) -> Look | None:
    """Return how a point looks at its marks; None if it was never measured."""
    marks = [mark for mark in marking.marks.values() if mark.point == point and mark.by == "measured"]
    if not marks:
        return None
    kinds = [mark.kind for mark in marks]
    kind = max(dict.fromkeys(kinds), key=kinds.count)
    first = next(mark for mark in marks if mark.kind == kind)
    fit = fits.get(first.key)
    if kind == "window":
        return Look(kind, template=template_of(first, read, project))
    size = 0.0
    if fit is not None and kind in ("target", "ring"):
        size = fit.size_px
    return Look(kind, None if fit is None else fit.code, size_px=size)


def template_of(mark: Mark, read: Callable[[int], AnyArray], project: MarkedProject) -> Template | None:
    """Return the window of a mark; None if its photograph is not here."""
    names = project.photographs.names
    if mark.photograph not in names:
        return None
    return Template(read(names.index(mark.photograph)), mark.x, mark.y)


def marks_needed(following: Following) -> tuple[IntArray, IntArray]:
    """Return how many marks each photograph needs until it is oriented, and how many of its marks count.

    Returns:
        Needed marks, 0 for oriented photographs, and marks of known points, (m,) each.
    """
    network, estimate = following.marked.network, following.estimate
    seen, m, n = network.image_points, len(network.images), len(network.points)
    marked = np.zeros((m, n), dtype=np.int64)
    marked[seen.image, seen.point] = 1
    known = estimate.determined.copy()
    known[network.control.complete.point] = True
    of_known = marked @ known
    needed = MIN_KNOWN - of_known
    if not estimate.oriented.any() and len(network.control.complete) < MIN_KNOWN:
        common = marked @ marked.T
        np.fill_diagonal(common, 0)
        needed = MIN_COMMON - common.max(axis=1, initial=0)
    again = np.isin(np.arange(m), [*following.orientation.open, *following.orientation.contradicting])
    needed = np.maximum(needed, 1)
    needed[estimate.oriented & ~again] = 0
    needed[again] = 1
    return needed, of_known


def sentence_of(following: Following, proposals: Mapping[tuple[str, str], Proposal]) -> str:
    """Return what is to be done next, in a sentence."""
    network, estimate = following.marked.network, following.estimate
    names, orientation = network.images, following.orientation
    if not following.marked.keys:
        return "Click a point that several photographs show; the click is measured."
    needed, of_known = marks_needed(following)
    for i in orientation.contradicting:
        return f"The marks of {names[i]} fit no orientation: check them, or mark one more point."
    worst = None if following.adjustment is None else following.adjustment.worst
    if worst is not None and worst.flagged:
        return f"Check {worst.point} in {worst.photograph}: it does not fit the other marks."
    waiting = sum(proposal.measured is not None for proposal in proposals.values())
    if waiting:
        return f"{counted(waiting, 'proposed mark')}: Enter accepts those of the point, x refuses."
    for i in orientation.open:
        return f"{names[i]} has two orientations that fit its marks: mark one more point."
    if not estimate.oriented.any() and len(network.control.complete) < MIN_KNOWN:
        return _pair_sentence(following)
    waiting_photographs = np.flatnonzero(needed > 0)
    if len(waiting_photographs):
        i = int(
            waiting_photographs[np.lexsort((-of_known[waiting_photographs], needed[waiting_photographs]))[0]]
        )
        more = "more " if of_known[i] else ""
        marks = counted(int(needed[i]), f"{more}mark")
        return f"{names[i]} needs {marks} of known points until it is oriented."
    rays = np.bincount(network.image_points.point, minlength=len(network.points))
    short = [network.points[j] for j in np.flatnonzero((rays > 0) & (rays < 3)).tolist()]
    if short:
        more_rays = 3 - int(rays[network.points.index(short[0])])
        return f"Point {short[0]} needs {counted(more_rays, 'more ray')} to be checked."
    return "All photographs are oriented: find everything else automatically."


def _pair_sentence(following: Following) -> str:
    network = following.marked.network
    seen, names = network.image_points, network.images
    marked = np.zeros((len(names), len(network.points)), dtype=np.int64)
    marked[seen.image, seen.point] = 1
    common = np.triu(marked @ marked.T, 1)
    i, j = np.unravel_index(int(np.argmax(common)), common.shape)
    if not common[i, j]:
        return "Mark the same point in a second photograph: five common points orient two photographs."
    more = max(MIN_COMMON - int(common[i, j]), 1)
    return f"{names[i]} and {names[j]} need {counted(more, 'more common point')} until they are oriented."


def without_moved(last: Following, marking: Marking, project: MarkedProject) -> Following | None:
    """Return what followed last, with the network of new marks; None if its points have other numbers."""
    marked = network_of_marks(project, marking)
    old, new = last.marked.network.points, marked.network.points
    if new[: len(old)] != old or marked.control != last.marked.control:
        return None
    points = np.vstack([last.estimate.points, np.full((len(new) - len(old), 3), np.nan)])
    return replace(last, marked=marked, estimate=replace(last.estimate, points=points))
