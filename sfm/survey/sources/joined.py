"""The image points of all sources of a survey as one network, before and after its orientation.

Photographs and points are joined by their names. A point that several sources measure is one point.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import cast

import numpy as np

from sfm.adjustment.quality.correlations import design_effect_of_neighbours
from sfm.adjustment.quality.variance_components import estimate_common_part, estimate_components
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.judgement.survey_result import LeftOutPoint, PhotographTargets
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.distributions import chi2_isf
from sfm.model.errors import BackendError, GeometryError, KolinearError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, ScaleBars, indices_of, rows_of, without_given
from sfm.model.reduced_network import reduce_network, select_determined
from sfm.model.remarks.remark import Remark, remark
from sfm.orientation.image_rays import intersect_image_points
from sfm.orientation.incremental.sequence import Orientation
from sfm.photographs.reading import decoding_once
from sfm.runtime.executor import Call, itself, other_processes
from sfm.runtime.progress import Progress, StageClock
from sfm.survey.inputs.measurements import NO_NAMES, Measurements, Naming, PhotographList
from sfm.survey.inputs.settings import AdjustSettings
from sfm.survey.inputs.sources import Declared, declared, stated_sources
from sfm.survey.inputs.start import network_of, scale_bars
from sfm.survey.inputs.survey import Survey
from sfm.survey.inputs.survey_file import SurveyFile
from sfm.survey.measuring.measured_store import Measured, MeasuredStore
from sfm.survey.measuring.surface_points import RAYS_OF_NOISE, with_weights
from sfm.survey.measuring.targets import each_photograph
from sfm.survey.orientation import Oriented
from sfm.survey.sources.repeated import without_repeated
from sfm.survey.sources.source import Correspondences, SurveySource

SAME_PX = 0.1  # by which two measurements of one target differ, whatever their stated precision
REFUSED_PX = 1.0  # by which a target that a person refused may be elsewhere in a later run
RAYS_OF_SOURCE = 2_000  # about so many rays of a source give its weight to two percent
MIN_SAME = 2  # photographs in which a point without a name is where another is


def sources_of(survey: Survey | SurveyFile) -> tuple[tuple[Declared, SurveySource], ...]:
    """Return the sources of a survey, each with its row."""
    return tuple(
        (row, cast(SurveySource, import_module(f"sfm.survey.sources.{row.source.name}").SOURCE))
        for row in declared(survey)
    )


def measure_sources(
    survey: Survey, files: PhotographList, *, jobs: int, store: MeasuredStore | None, clock: StageClock
) -> Measurements:
    """Return the image points of all sources of a survey.

    Args:
        survey: settings of the survey.
        files: its photographs; none if it measures nothing.
        jobs: number of photographs measured at the same time.
        store: keeps the measurements; None to measure all anew.
        clock: times the stages.
    """
    measured = {}
    sources = sources_of(survey)
    listed_first = sorted(sources, key=lambda pair: not pair[0].is_listed)  # faults of files show first
    first = sum(source.measure_one is not None for _, source in sources) > 1 or other_processes() is not None
    for row, source in listed_first:
        if first and source.measure_one is not None:
            first, store = False, store or MeasuredStore(None)
            with clock.stage("photographs", len(files)):
                _measure_each(survey, files, jobs=jobs, store=store, progress=clock.progress)
        with clock.stage(row.stage, len(files)) if row.stage else nullcontext():
            measured[row] = source.measure(survey, files, jobs=jobs, store=store, progress=clock.progress)
    return _joined_measurements(survey, [measured[row] for row, _ in sources])


def _measure_each(
    survey: Survey, files: PhotographList, *, jobs: int, store: MeasuredStore, progress: Progress
) -> None:
    """Measure each photograph for all sources while it is in memory; the store holds what they find.

    Other processes measure, if there are any; what they cannot read is left to this one.
    """
    names_and_paths, keeper = list(zip(files.names, files.paths, strict=True)), other_processes()
    if keeper is None:
        name_of = {path: name for name, path in names_and_paths}
        each_photograph(
            files,
            lambda path: measure_photograph_once(survey, name_of[path], path, store),
            jobs=jobs,
            progress=progress,
        )
        return
    stored = [_is_stored(survey, name, path, store) for name, path in names_and_paths]
    kept = keeper.keep([Call(itself, (survey,))])[0]
    left = [pair for pair, known in zip(names_and_paths, stored, strict=True) if not known]
    keeps = store.folder is not None
    calls = [Call(_measured_photograph, (kept, name, path.absolute(), keeps)) for name, path in left]
    with suppress(BackendError):  # if all of them are gone, what comes next says so
        for number, held in keeper.each(calls):
            store.adopt(held)
            progress.advance(left[number][0])


class _NotStoredError(Exception):
    """A photograph was not measured before."""


@dataclass(frozen=True)
class _StoredOnly(MeasuredStore):
    """A store that measures nothing."""

    def begin(self) -> None:
        """Raise an error instead of measuring."""
        raise _NotStoredError


def _is_stored(survey: Survey, image: str, path: Path, store: MeasuredStore) -> bool:
    """Return whether a store has all that is measured in a photograph; it is held then."""
    try:
        measure_photograph_once(survey, image, path, _StoredOnly(store.folder, store.held))
    except (_NotStoredError, KolinearError):
        return False
    return True


def _measured_photograph(
    survey: Survey, image: str, path: Path, keeps: bool
) -> dict[str, tuple[Measured, bool]]:
    """Return what is found in a photograph by its keys in a store, each with whether it was read from it.

    A photograph that cannot be read here, or measured, gives nothing.

    keeps: whether the user's store on this computer is searched, and keeps what is found.
    """
    store = MeasuredStore(None)
    with suppress(KolinearError):
        store = MeasuredStore.of_user() if keeps else store
    try:
        measure_photograph_once(survey, image, path, store)
    except KolinearError:
        return {}
    return store.held


def measure_photograph_once(
    survey: Survey | SurveyFile, image: str, path: Path, store: MeasuredStore
) -> tuple[dict[str, int], bool]:
    """Measure a photograph for each source of a survey, and decode it and its mask once.

    Args:
        survey: settings of the survey, or its file.
        image: name of the photograph.
        path: its file.
        store: stores what is found.

    Returns:
        Counts of what was measured by name, and whether all of it was read from the store.

    Raises:
        PhotographError: the photograph or its mask cannot be read.
        SurveyFileError: the mask has another size than the photograph.
    """
    counts, stored = dict[str, int](), True
    with decoding_once():
        for _, source in sources_of(survey):
            if source.measure_one is not None:
                of_source, was_stored = source.measure_one(survey, image, path, store)
                counts, stored = counts | of_source, stored and was_stored
    return counts, stored


def complete_sources(oriented: Oriented, *, jobs: int = 1) -> Correspondences:
    """Return the network of a survey with all its image points, and approximate values.

    Args:
        oriented: the image points so far, and the orientation with its final tolerance.
        jobs: number of photographs processed in parallel.

    Raises:
        GeometryError: fewer than two photographs keep enough points.
    """
    survey, measured, start = oriented.survey, oriented.measured, oriented.orientation
    sources = [source for _, source in sources_of(survey)]
    if len(sources) == 1:
        completed = [sources[0].complete(oriented, measured, start, jobs=jobs)]
    else:
        completed = [
            source.complete(oriented, part, _orientation_of(start, measured, k), jobs=jobs)
            for k, (source, part) in enumerate(zip(sources, measured.parts, strict=True))
        ]
    return _joined_correspondences(survey, measured, start, completed)


def _joined_measurements(survey: Survey, parts: Sequence[Measurements]) -> Measurements:
    """Return the measurements of all sources as those of one network."""
    if len(parts) == 1:
        return replace(parts[0], network=_of_one_source(survey, parts[0].network))
    named = [part.network.points for part in parts]
    used = [_not_refused(survey, part) for part in parts]
    networks = _renamed(parts)
    parts = [replace(part, network=renamed) for part, renamed in zip(parts, networks, strict=True)]
    network, repeated = _joined(survey, networks, named, used)
    lost = {failed.image: failed for part in parts for failed in part.failed}
    seen = set(network.images)
    by_points = [  # they take part with given image points
        name
        for name, failed in lost.items()
        if name in seen and failed.reason.kind == "photographs_unreadable"
    ]
    unread = (remark("photographs_unreadable", photographs=by_points),) if by_points else ()
    return Measurements(
        network,
        parts[0].cameras,
        tuple(dict.fromkeys(name for part in parts for name in part.images)),
        _fewest_rays(network, parts),
        tuple(failed for name, failed in lost.items() if name not in by_points),
        _joined_overlays([part.overlays for part in parts]),
        next((part.files for part in parts if part.files is not None), None),
        next((part.photographs for part in parts if part.photographs is not None), None),
        next((part.naming for part in parts if part.naming.names), NO_NAMES),
        tuple(said for part in parts for said in part.remarks) + repeated.of_sources + unread,
        tuple(point for part in parts for point in part.left_out) + repeated.left_out,
        tuple(parts),
    )


def _of_one_source(survey: Survey, network: Network) -> Network:
    return replace(network, sources=stated_sources(survey))


def _not_refused(survey: Survey, part: Measurements | Correspondences) -> BoolArray:
    """Return which image points of a source no person refused, (k,).

    A point that is numbered anew in each run is the refused one only at the same place.
    """
    network, running = part.network, _running(part)
    seen = network.image_points
    used: BoolArray = np.ones(len(seen), dtype=bool)
    image = {name: i for i, name in enumerate(network.images)}
    point = {name: j for j, name in enumerate(network.points)}
    for mark in survey.refused:
        if mark.photograph in image and mark.point in point:
            refused = (seen.image == image[mark.photograph]) & (seen.point == point[mark.point])
            if mark.point in running:
                refused &= np.linalg.norm(seen.xy - (mark.x, mark.y), axis=1) <= REFUSED_PX
            used &= ~refused
    return used


def _named_as_given(survey: Survey, completed: Sequence[Correspondences]) -> list[Correspondences]:
    """Return the points of all sources, where those without a name that others name have this name.

    A target without a code that a person marked too is one point. It is that of the mark where both are at
    the same place in most photographs that show both, and in two at least.
    """
    named = []
    for k, matched in enumerate(completed):
        names = dict[str, str]()
        for j, other in enumerate(completed):
            if j != k:
                names = _same_points(survey, matched, other) | names
        points = tuple(names.get(name, name) for name in matched.network.points)
        named.append(replace(matched, network=replace(matched.network, points=points)))
    return named


def _naming_of(
    completed: Sequence[Correspondences], before: Sequence[Sequence[str]], after: Sequence[Sequence[str]]
) -> Naming:
    """Return the naming of the targets, with the names that their points have after others named them."""
    for matched, old, new in zip(completed, before, after, strict=True):
        if matched.naming.names:
            names = dict(zip(old, new, strict=True))
            return replace(
                matched.naming, names=tuple(names.get(name, name) for name in matched.naming.names)
            )
    return NO_NAMES


def _same_points(survey: Survey, matched: Correspondences, other: Correspondences) -> dict[str, str]:
    """Return the names that another source has for points of one without a name."""
    running, given = _running(matched), set(other.network.points) - _running(other)
    a, b = matched.network, other.network
    if not running or not given:
        return {}
    unnamed = np.array([name in running for name in a.points], dtype=bool)
    has_name = np.array([name in given for name in b.points], dtype=bool)
    index = {name: i for i, name in enumerate(b.images)}
    both = np.zeros((len(a.points), len(b.points)), dtype=np.int64)
    alike = both.copy()
    of_a, of_b = a.image_points, b.image_points
    rows_a, rows_b = rows_of(of_a.image, len(a.images)), rows_of(of_b.image, len(b.images))
    for i, name in enumerate(a.images):
        if name not in index:
            continue
        first = rows_a[i][unnamed[of_a.point[rows_a[i]]]]
        second = rows_b[index[name]]
        second = second[has_name[of_b.point[second]]]
        if not (len(first) and len(second)):
            continue
        pairs = np.ix_(of_a.point[first], of_b.point[second])
        both[pairs] += 1
        d = of_a.xy[first][:, None] - of_b.xy[second]
        C = of_a.covariance[first][:, None] + of_b.covariance[second] + SAME_PX**2 * np.eye(2)
        square = np.einsum("abi,abij,abj->ab", d, np.linalg.inv(C), d)
        alike[pairs] += square <= chi2_isf(survey.adjust.levels.question, 2)
    names = dict[str, str]()
    for p, q in np.argwhere((alike >= MIN_SAME) & (2 * alike > both)).tolist():
        names.setdefault(a.points[p], b.points[q])
    taken = list(names.values())
    return {name: new for name, new in names.items() if taken.count(new) == 1 and new not in a.points}


def _renamed(parts: Sequence[Measurements | Correspondences]) -> list[Network]:
    """Return the networks of all sources, where running names of points are those of no other point.

    A code, or a name that was given, is the same point in all sources. A number that a source gives to a
    point without a name, such as u001, may be that of a point of an earlier run in another.
    """
    given = [{name for name in part.network.points if name not in _running(part)} for part in parts]
    networks = []
    for k, part in enumerate(parts):
        others = set().union(*(names for j, names in enumerate(given) if j != k))
        double = others & _running(part)
        points = tuple(f"{name} (2)" if name in double else name for name in part.network.points)
        networks.append(replace(part.network, points=points))
    return networks


def _running(part: Measurements | Correspondences) -> set[str]:
    """Return the names of the points of a source that were numbered in this run."""
    names = part.naming.names
    if names:
        return {name for name, code in zip(names, part.naming.code.tolist(), strict=True) if code < 0}
    return set() if part.network.sources[0].names_last else set(part.network.points)


@dataclass(frozen=True)
class _Repeated:
    """Image points that several sources measured."""

    of_sources: tuple[Remark, ...]  # on sources that contradict one another
    contradicting: tuple[str, ...]  # image points, left out

    @property
    def left_out(self) -> tuple[LeftOutPoint, ...]:
        """The image points that contradict one another, each of two sources."""
        return tuple(
            LeftOutPoint(name, 2, remark("image_points_contradicting", image_points=name))
            for name in self.contradicting
        )

    def after(self, measured: Measurements) -> _Repeated:
        """Return what was not yet known before the photographs were oriented."""
        known = {said.names("sources") for said in measured.remarks if said.kind == "sources_contradict"}
        before = {point.point for point in measured.left_out}
        return _Repeated(
            tuple(said for said in self.of_sources if said.names("sources") not in known),
            tuple(name for name in self.contradicting if name not in before),
        )


def _joined(
    survey: Survey, networks: Sequence[Network], named: Sequence[Sequence[str]], used: Sequence[BoolArray]
) -> tuple[Network, _Repeated]:
    """Return the network of the image points of all sources, with everything else that the survey gives.

    named: names that the points of each network had before running names were changed.
    used: which image points of each network take part.
    """
    sources = stated_sources(survey)
    images = tuple(dict.fromkeys(name for network in networks for name in network.images))
    points = tuple(dict.fromkeys(name for network in networks for name in network.points))
    camera = np.zeros(len(images), dtype=np.int64)
    parts, bars = [], [scale_bars(survey.scale_bars, points)]
    for k, (network, before) in enumerate(zip(networks, named, strict=True)):
        of_image, of_point = indices_of(images, network.images), indices_of(points, network.points)
        camera[of_image] = network.camera
        seen = network.image_points
        source = np.full(len(seen), k)
        every = replace(seen, image=of_image[seen.image], point=of_point[seen.point], source=source)
        parts.append(every.select(used[k]))
        stated = len(scale_bars(survey.scale_bars, before))  # all others are of the source alone
        bars.append(
            network.scale_bars.select(np.arange(stated, len(network.scale_bars))).renumbered(of_point)
        )
    once = without_repeated(ImagePoints.joined(parts), sources)
    contradicting = tuple(f"{points[j]} in {images[i]}" for i, j in once.contradicting)
    tables = [
        of_source.table if len(of_source.table) else np.zeros(len(of_source), dtype=np.int64)
        for of_source in bars
    ]
    all_bars = ScaleBars(
        np.concatenate([of_source.start for of_source in bars]),
        np.concatenate([of_source.end for of_source in bars]),
        np.concatenate([of_source.length for of_source in bars]),
        np.concatenate([of_source.sigma for of_source in bars]),
        np.concatenate(tables),
    )
    network = network_of(survey, images, camera, points, once.image_points, bars=all_bars)
    return replace(network, sources=sources), _Repeated(once.remarks, contradicting)


def _joined_overlays(overlays: Sequence[Sequence[PhotographTargets]]) -> tuple[PhotographTargets, ...]:
    """Return one overlay of each photograph, in the order of their first source."""
    by_name: dict[str, PhotographTargets] = {}
    for drawn in (drawn for of_source in overlays for drawn in of_source):
        before = by_name.get(drawn.image)
        by_name[drawn.image] = drawn if before is None else before.with_more(drawn)
    return tuple(by_name.values())


def _fewest_rays(network: Network, parts: Sequence[Measurements | Correspondences]) -> IntArray:
    """Return how many rays each point needs, by the source that asks for the fewest, (n,)."""
    fewest = np.full(len(network.points), np.iinfo(np.int64).max)
    for part in parts:
        np.minimum.at(fewest, indices_of(network.points, part.network.points), part.min_rays)
    return fewest


def _orientation_of(start: Orientation, measured: Measurements, source: int) -> Orientation:
    """Return the orientation of the photographs and points of a source."""
    whole, part, estimate = measured.network, measured.parts[source], start.estimate
    images, points = (
        indices_of(whole.images, part.network.images),
        indices_of(whole.points, part.network.points),
    )
    known = set(part.network.points)
    return replace(
        start,
        estimate=replace(
            estimate,
            position=estimate.position[images],
            rotation=estimate.rotation[images],
            points=estimate.points[points],
        ),
        point_failures=tuple(failure for failure in start.point_failures if failure[0] in known),
        fits=_rows_of(part.network, images, points, start.fits, whole),
    )


def _rows_of(part: Network, images: IntArray, points: IntArray, fits: BoolArray, whole: Network) -> BoolArray:
    """Return which image points of a source fit, (k,); those that another source has in their place do not.

    Args:
        part: network of the source.
        images: index of its photographs in the whole network, (m,).
        points: index of its points, (n,).
        fits: which image points of the whole network fit.
        whole: network of all sources.
    """
    n = len(whole.points)
    seen = whole.image_points.select(fits)
    fitting = np.unique(seen.image * n + seen.point)
    return np.isin(images[part.image_points.image] * n + points[part.image_points.point], fitting)


def _joined_correspondences(
    survey: Survey, measured: Measurements, start: Orientation, completed: Sequence[Correspondences]
) -> Correspondences:
    """Return the image points of all sources in the orientation of all photographs."""
    if len(completed) == 1:
        alone = completed[0].network
        seen = alone.image_points.select(_not_refused(survey, completed[0]))
        return replace(completed[0], network=_of_one_source(survey, replace(alone, image_points=seen)))
    without_names = [matched.network.points for matched in completed]
    completed = _named_as_given(survey, completed)
    named = [matched.network.points for matched in completed]
    used = [_not_refused(survey, matched) for matched in completed]
    completed = [
        replace(matched, network=part) for matched, part in zip(completed, _renamed(completed), strict=True)
    ]
    network, repeated = _joined(survey, [matched.network for matched in completed], named, used)
    repeated = repeated.after(measured)
    images = indices_of(measured.network.images, network.images)
    position, rotation = start.estimate.position[images].copy(), start.estimate.rotation[images].copy()
    elsewhere = {name: reason for matched in completed for name, reason in matched.left_out}
    out = np.isin(network.images, list(elsewhere))
    position[out], rotation[out] = np.nan, np.nan
    estimate = replace(start.estimate, position=position, rotation=rotation)
    min_rays = _fewest_rays(network, completed)
    rays = intersect_image_points(
        network.image_points,
        network.camera,
        estimate,
        n_points=len(network.points),
        tolerance_px=float(start.tolerance_px.max()),
    )
    estimate = replace(estimate, points=rays.points)
    if survey.adjust.weights == "components":
        network = _balanced(network, estimate, min_rays, survey.adjust)
    return Correspondences(
        network,
        estimate,
        min_rays,
        _naming_of(completed, without_names, named),
        next((matched.eccentricity for matched in completed if matched.eccentricity is not None), None),
        tuple(name for matched in completed for name in matched.no_circles),
        tuple(said for matched in completed for said in matched.remarks) + repeated.of_sources,
        start.point_failures,
        start.kind == "given",
        tuple(elsewhere.items()),
        tuple(dict.fromkeys(name for matched in completed for name in matched.suspected)),
        tuple(point for matched in completed for point in matched.left_out_image_points) + repeated.left_out,
        _joined_overlays(
            [
                part.overlays if matched.overlays is None else matched.overlays
                for part, matched in zip(measured.parts, completed, strict=True)
            ]
        ),
    )


def _balanced(network: Network, estimate: Estimate, min_rays: IntArray, settings: AdjustSettings) -> Network:
    """Return the network with the weights of its sources relative to one another, from their residuals.

    The median covariance does not change: sigma0 still shows how much worse the image points are than
    expected. A source with errors in common gets its design effect. Of very many points only some take part.
    Named points are weighted by the covariance of their windows, as far as their residuals confirm it.
    """
    start = estimate

    def adjust_with(part: Network, factor: FloatArray) -> Adjustment:
        nonlocal start
        # rejection with weights that are far off would lose the image points of the less precise source
        adjustment = adjust(
            part,
            start,
            false_alarm=settings.false_alarm,
            reject="huber",
            options=AdjustmentOptions(sigma_px=settings.sigma_px, image_sigma_factor=factor),
        )
        start = adjustment.estimate
        return adjustment

    try:
        part, start = _thinned(network, estimate, min_rays, RAYS_OF_SOURCE)
        present, group = np.unique(part.source, return_inverse=True)
        names = tuple(network.sources[k].name for k in present)
        _, of_groups, converged = estimate_components(lambda factor: adjust_with(part, factor), group, names)
        if not converged:
            return network
        factors = np.ones(len(network.sources))
        factors[present] = of_groups
        shown = _with_matching(network, part, factors, adjust_with, settings.sigma_px)
        common = np.array([source.has_common_errors for source in network.sources])
        effect = 1.0
        if common.any() and not common.all():
            part, start = _thinned(network, estimate, min_rays, RAYS_OF_NOISE)
            natural = common[part.source]
            if not natural.any():  # no natural point fits the orientation by the others
                return network
            density = common[network.source].sum() / natural.sum()
            effect = design_effect_of_neighbours(adjust_with(part, factors[part.source]), density=density)
    except GeometryError:  # the adjustment of the survey reports or repairs it
        return network
    weighted = with_weights(network, shown)
    variance = np.trace(weighted.image_points.covariance, axis1=1, axis2=2)
    balance = np.sqrt(variance / np.trace(network.image_points.covariance, axis1=1, axis2=2))
    sources = tuple(
        replace(
            source,
            balance=float(np.median(balance[rows])) if len(rows) else 1.0,
            design_effect=effect if source.has_common_errors else source.design_effect,
        )
        for source, rows in zip(network.sources, rows_of(network.source, len(network.sources)), strict=True)
    )
    return replace(weighted, sources=sources)


def _with_matching(
    network: Network,
    part: Network,
    factors: FloatArray,
    adjust_with: Callable[[Network, FloatArray], Adjustment],
    sigma_px: float,
) -> FloatArray:
    """Return covariances with the factors of the sources; those of named points have two parts, (k, 2, 2).

    Named points are matched windows whose neighbours have no error in common. What matching states differs
    from window to window, and the sigma expected of any image point would hide it. A factor of it and a
    common part are estimated in its place.

    Args:
        network: network of k image points.
        part: the image points that take part in the estimation.
        factors: on the standard deviations of each source.
        adjust_with: adjusts a network with factors of its image points.
        sigma_px: in all covariances, beside what matching states, px.

    Raises:
        GeometryError: fewer than two photographs keep enough points.
    """
    shown = factors[network.source][:, None, None] ** 2 * network.image_points.covariance
    named = np.array([source.is_matched and not source.has_common_errors for source in network.sources])
    expected, of_named = sigma_px**2 * np.eye(2), named[part.source]
    matching = part.image_points.covariance[of_named] - expected
    if not len(matching):
        return np.asarray(shown)
    of_part = factors[part.source][:, None, None] ** 2 * part.image_points.covariance

    def adjust_matching(covariance: FloatArray) -> Adjustment:
        of_part[of_named] = covariance
        weighted = replace(part, image_points=replace(part.image_points, covariance=of_part.copy()))
        return adjust_with(weighted, np.ones(len(of_part)))

    common_px = float(factors[named][0]) * sigma_px
    try:
        factor, common_px = estimate_common_part(adjust_matching, matching, common_px, rows=of_named)
    except np.linalg.LinAlgError:  # windows that are all alike do not tell the parts of their errors
        return np.asarray(shown)
    rows = named[network.source]
    matched = network.image_points.covariance[rows] - expected
    shown[rows] = factor**2 * matched + common_px**2 * np.eye(2)
    return np.asarray(shown)


def _thinned(
    network: Network, estimate: Estimate, min_rays: IntArray, rays_of_source: int
) -> tuple[Network, Estimate]:
    """Return a part of the image points without given values, with about so many rays of each source.

    Raises:
        GeometryError: fewer than two photographs keep enough points.
    """
    seen = network.image_points
    step = np.ones(len(network.points), dtype=np.int64)
    for k in range(len(network.sources)):
        of_source = network.source == k
        step[seen.point[of_source]] = max(1, int(of_source.sum()) // rays_of_source)
    chosen = estimate.determined & (np.arange(len(step)) % step == 0)
    rays = np.ones(len(seen), dtype=bool)
    images, points = select_determined(
        network,
        replace(estimate, points=np.where(chosen[:, None], estimate.points, np.nan)),
        rays,
        min_rays,
    )
    return reduce_network(without_given(network), estimate, images, points, rays)
