"""What follows from the marks: orientation, points, precision, and places in other photographs.

It is computed anew from the marks, so that the same marks always give the same. Where marks were only
added, the last orientation is continued.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType

import numpy as np

from sfm.matching.radiometry import GreyPhotographs
from sfm.model.camera import Camera
from sfm.model.conventions import AnyArray, FloatArray, IntArray
from sfm.model.display import counted
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, empty_estimate
from sfm.products.marking.adjusting import TOLERANCE, MarkAdjustment, adjust_marks
from sfm.products.marking.clicks import Measured, Template
from sfm.products.marking.guidance import (
    SAME_PX,
    Guide,
    Look,
    Predicted,
    is_same_place,
    measure_predicted,
)
from sfm.products.marking.orienting import (
    MIN_COMMON,
    MIN_KNOWN,
    Evidence,
    Frame,
    HandOrientation,
    orient_by_hand,
)
from sfm.products.marking.project import GivenImagePoint, MarkedProject
from sfm.runtime.threads import cores
from sfm.survey.inputs.given_values import ScaleBar
from sfm.survey.inputs.marks_file import Mark, Marking, StatedPoint
from sfm.survey.inputs.start import scale_bars
from sfm.survey.measuring.templates import TemplateScene, match_templates


@dataclass(frozen=True)
class MarkedNetwork:
    """The network of the marks, and of what was measured automatically."""

    network: Network
    cameras: tuple[Camera, ...]
    keys: tuple[tuple[str, str], ...]  # photograph and point of each image point
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

    @property
    def xy(self) -> FloatArray:
        """Its place: measured, else predicted, px, (2,)."""
        return self.predicted.xy if self.measured is None else np.array([self.measured.x, self.measured.y])

    def is_as(self, shown: Proposal) -> bool:
        """Return whether a person who looked at another proposal has seen this one."""
        same = (self.measured is None) == (shown.measured is None)
        return same and float(np.linalg.norm(self.xy - shown.xy)) <= SAME_PX


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
    # photograph with the mark that did not fit, and its marks, when all was oriented anew for the last time
    tried: frozenset[tuple[str, str]] = frozenset()

    @property
    def doubted(self) -> frozenset[tuple[str, str]]:
        """The marks of the photograph with the mark that does not fit; empty if all fit."""
        if self.adjustment is None or self.adjustment.named is None:
            return frozenset()
        worst = self.adjustment.worst
        if worst is None:
            return frozenset()
        return frozenset(key for key in self.marked.keys if key[0] == worst.photograph)

    def is_better_than(self, other: Following) -> bool:
        """Return whether more photographs are oriented, fewer marks rejected, or residuals smaller."""
        a, b = self.adjustment, other.adjustment
        if a is None or b is None:
            return a is not None
        ranks = [
            (-int(row.images.sum()), int(row.adjustment.rejected.sum()) or int(row.named is not None))
            for row in (a, b)
        ]
        sigma0, of_other = a.adjustment.sigma0, b.adjustment.sigma0
        same = np.isclose(sigma0, of_other, rtol=TOLERANCE)  # both converged to the same
        return ranks[0] < ranks[1] or (ranks[0] == ranks[1] and sigma0 < of_other and not same)

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


def bars_of(project: MarkedProject, marking: Marking) -> tuple[ScaleBar, ...]:
    """Return the scale bars of the survey, and those that the person states, which come first."""
    own = marking.bars
    given = [bar for bar in project.bars if not {(bar.start, bar.end), (bar.end, bar.start)} & own.keys()]
    return (*given, *own.values())


def network_of_marks(project: MarkedProject, marking: Marking) -> MarkedNetwork:
    """Return the network of marks and of automatic image points, which marks of the same point replace."""
    names = project.photographs.names
    index = {name: i for i, name in enumerate(names)}
    control, bars = stated_points(project, marking), bars_of(project, marking)
    rows = [row for row in image_points_of(project, marking) if row.photograph in index]
    solved = () if project.solution is None else project.solution.network.points
    shown = dict.fromkeys(row.point for row in rows)
    points = tuple(dict.fromkeys((*control, *(name for name in solved if name in shown), *shown)))
    number = {name: j for j, name in enumerate(points)}
    seen = ImagePoints(
        np.array([index[row.photograph] for row in rows], dtype=np.int64),
        np.array([number[row.point] for row in rows], dtype=np.int64),
        np.array([row.xy for row in rows], dtype=float).reshape(-1, 2),
        np.array([row.covariance for row in rows], dtype=float).reshape(-1, 2, 2),
    )
    network = Network(names, project.photographs.camera, points, seen)
    if control:
        stated = control.values()
        network = network.with_control(
            tuple(control), [known.xyz for known in stated], [known.sigma for known in stated]
        )
    network = network.with_given(scale_bars(bars, points))
    keys = tuple((row.photograph, row.point) for row in rows)
    return MarkedNetwork(network, project.cameras, keys, control, bars)


def image_points_of(project: MarkedProject, marking: Marking) -> list[GivenImagePoint]:
    """Return the marks as image points, and the automatic ones that no person measured again or refused.

    sigma_px of the survey is added to marks that were measured.
    """
    other = {"measured": project.survey.adjust.sigma_px**2, "hand": 0.0}  # px^2
    replaced = marking.marks.keys() | marking.refused.keys()
    marks = [
        GivenImagePoint(*mark.key, (mark.x, mark.y), np.array(mark.covariance) + other[mark.by] * np.eye(2))
        for mark in marking.marks.values()
    ]
    automatic = automatic_image_points(project)
    return [*marks, *(row for row in automatic if (row.photograph, row.point) not in replaced)]


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
    if last is None or not _continues(marked, last):
        return _followed(project, marked, evidence, *_start(project, marked))
    points = _renumbered(last.marked.network.points, last.estimate.points, marked)
    earlier = replace(last.estimate, points=points), last.orientation.frame
    continued = _followed(project, marked, evidence, *earlier)
    doubted = continued.doubted
    if doubted in (frozenset(), last.tried):
        return replace(continued, tried=last.tried)
    anew = _followed(project, marked, evidence, *_start(project, marked))
    return replace(anew if anew.is_better_than(continued) else continued, tried=doubted)


def _followed(
    project: MarkedProject, marked: MarkedNetwork, evidence: Evidence, start: Estimate, frame: Frame
) -> Following:
    """Return the orientation and adjustment from what is oriented already."""
    network = marked.network
    orientation = orient_by_hand(network, start, evidence, frame=frame)
    adjustment = adjust_marks(
        network,
        orientation.estimate,
        marked.cameras,
        in_control=orientation.frame == "control",
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


def _start(project: MarkedProject, marked: MarkedNetwork) -> tuple[Estimate, Frame]:
    """Return what the result of the survey orients, nothing without one, and its frame."""
    network, solution = marked.network, project.solution
    estimate = empty_estimate(network, marked.cameras)
    if solution is None:
        return estimate, "model"
    position, rotation = estimate.position.copy(), estimate.rotation.copy()
    index = {name: i for i, name in enumerate(network.images)}
    for i, name in enumerate(solution.network.images):
        if name in index:
            position[index[name]] = solution.estimate.position[i]
            rotation[index[name]] = solution.estimate.rotation[i]
    points = _renumbered(solution.network.points, solution.estimate.points, marked)
    frame: Frame = "control" if solution.datum == "control" else "scaled" if solution.has_scale else "model"
    return Estimate(marked.cameras, position, rotation, points), frame


def _renumbered(names: Sequence[str], xyz: FloatArray, marked: MarkedNetwork) -> FloatArray:
    """Return the coordinates of the points of a network from those of another, NaN for new ones, (n, 3)."""
    number = marked.point
    points = np.full((len(number), 3), np.nan)
    for name, place in zip(names, xyz, strict=True):
        if name in number:
            points[number[name]] = place
    return points


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
    placed = last.orientation.frame == "control" or not marked.control
    return same and kept and certain and placed and bool(last.estimate.oriented.any())


def propose(
    following: Following,
    marking: Marking,
    read: Callable[[int], AnyArray],
    project: MarkedProject,
    fit: Callable[[Mark], Measured | None],
    points: set[str] | None = None,
    known: Mapping[tuple[str, str], Proposal] = MappingProxyType({}),
) -> dict[tuple[str, str], Proposal]:
    """Return the proposals of points: where they should be, and what is measured there.

    Args:
        following: the orientation.
        marking: the marks; refused places are not proposed.
        read: returns the intensities of a photograph, (H, W).
        project: gives names and codes.
        fit: returns what was measured at a mark; None where that is not known.
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
        look = look_of(point, marking, read, project, fit)
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
        for (key, predicted, _), there in zip(asked, measured, strict=True):
            found[key] = Proposal(predicted, key[1], there)
    return found


def match_single(
    following: Following,
    point: str,
    marking: Marking,
    read: Callable[[int], AnyArray],
    project: MarkedProject,
    fit: Callable[[Mark], Measured | None],
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
        fit: returns what was measured at a mark; None where that is not known.
    """
    marks = [mark for mark in marking.marks.values() if mark.point == point]
    adjustment, network, estimate = following.adjustment, following.marked.network, following.estimate
    if len(marks) != 1 or adjustment is None or marks[0].photograph not in network.images:
        return {}
    mark, i = marks[0], network.images.index(marks[0].photograph)
    look = look_of(point, marking, read, project, fit)
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
            there: Measured | None = Measured(float(xy[0]), float(xy[1]), C, "window", xy + box)
        else:
            there = measure_predicted(read, predicted, look, project.survey.family)
        found[key] = Proposal(predicted, point, there)
    return found


def look_of(
    point: str,
    marking: Marking,
    read: Callable[[int], AnyArray],
    project: MarkedProject,
    fit: Callable[[Mark], Measured | None],
) -> Look | None:
    """Return how a point looks at its marks; None if that is not known.

    Without the size and code of a target, a neighbour would be taken for it.
    """
    marks = [mark for mark in marking.marks.values() if mark.point == point and mark.by == "measured"]
    if not marks:
        return None
    kinds = [mark.kind for mark in marks]
    kind = max(dict.fromkeys(kinds), key=kinds.count)
    alike = [mark for mark in marks if mark.kind == kind]
    if kind == "window":
        return Look(kind, template=template_of(alike[0], read, project))
    if kind not in ("target", "ring"):
        return Look(kind)
    measured = next(filter(None, map(fit, alike)), None)
    return None if measured is None else Look(kind, measured.code, size_px=measured.size_px)


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
        marks = counted(waiting, "proposed mark")
        return f"{marks}: Enter accepts those of the chosen point, Shift+Enter all; X refuses the one here."
    for i in orientation.open:
        return f"{names[i]} has several orientations that fit its marks: mark one more point."
    if not estimate.oriented.any() and len(network.control.complete) < MIN_KNOWN:
        seen = network.image_points
        marked = np.zeros((len(names), len(network.points)), dtype=np.int64)
        marked[seen.image, seen.point] = 1
        common = np.triu(marked @ marked.T, 1)
        first, second = np.unravel_index(int(np.argmax(common)), common.shape)
        if not common[first, second]:
            return "Mark the same point in a second photograph: five common points orient two photographs."
        lacking = counted(max(MIN_COMMON - int(common[first, second]), 1), "more common point")
        return f"{names[first]} and {names[second]} need {lacking} until they are oriented."
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


def without_moved(last: Following, marking: Marking, project: MarkedProject) -> Following | None:
    """Return what followed last, with the network of new marks; None if its points have other numbers."""
    marked = network_of_marks(project, marking)
    old, new = last.marked.network.points, marked.network.points
    if new[: len(old)] != old or marked.control != last.marked.control:
        return None
    points = np.vstack([last.estimate.points, np.full((len(new) - len(old), 3), np.nan)])
    return replace(last, marked=marked, estimate=replace(last.estimate, points=points))
