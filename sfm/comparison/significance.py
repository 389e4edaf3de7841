"""Differences of two results of one object, with their standard deviations and tests.

`sfm.comparison.pairing` pairs points and photographs. Then b is aligned to a: over common points, projection
centres or control, or not at all. The scale is only estimated if one of them has none.

If the joint covariance of all points is known, both results are transformed into one datum, and tested by
`sfm.comparison.congruency`. This test also finds the points that moved, and the alignment is repeated over
the others. If only the covariance of each single point is known, each difference d is tested by T = d' (Qa +
Qb)^-1 d / 3, an approximation for free networks only. Results that were adjusted from the same image points
are not independent, and are not tested. `sfm.comparison.causes` finds causes other than points that moved.

Source: Luhmann et al. (2020), Close-Range Photogrammetry and 3D Imaging, sec. 2.4.2; Caspary (2000), Concepts
of network and deformation analysis, sec. 7.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.comparison.camera_conversion import Conversion, convert_camera
from sfm.comparison.causes import Cause, find_cause
from sfm.comparison.congruency import Congruency, congruency
from sfm.comparison.pairing import (
    SAME_RAY_PX,
    Pairing,
    PointPairs,
    pair_results,
    pairs_of_results,
    rounding_of,
)
from sfm.comparison.pose_test import PoseTest, compare_poses, has_pose_sigma
from sfm.comparison.solutions import rotation_angle_deg
from sfm.comparison.stable_points import critical_value
from sfm.comparison.weaker_solution import Weakness, weaker_solutions
from sfm.model.arguments import checked_arguments
from sfm.model.conventions import METRES, BoolArray, FloatArray, IntArray
from sfm.model.display import html_table, text_table
from sfm.model.distributions import FALSE_ALARM
from sfm.model.errors import GeometryError, SurveyFileError
from sfm.model.network import Network
from sfm.model.remarks.remark import Remark, remark
from sfm.model.similarity import Similarity, fit_similarity
from sfm.model.solution import Solution

FREE_DATUMS = ("free", "")  # in which the covariance of single points gives about the same test
ALIGNMENTS = ("points", "cameras", "control", "none")
NO_COMMON_DATUM = "without an alignment, only results in the datum of control share a frame"
SAME_PX = 1e-3  # closer image points are one measurement
SAME_SHARE = 0.5  # of a's image points; if b has more of them, the results are not independent


@dataclass(frozen=True)
class InteriorDifference:
    """Interior orientation of one camera in both results."""

    camera: str
    model: str  # model of the comparison: that of a
    names: tuple[str, ...]
    units: tuple[str, ...]  # of each parameter
    difference: FloatArray  # b - a, (p,)
    sigma: FloatArray  # of the difference, NaN if unknown in this model, (p,)
    conversion: Conversion | None  # of b's camera into a's model, None if the models are the same


@dataclass(frozen=True, repr=False)
class ResultComparison:
    """Differences b - a of two results after b was aligned to a."""

    names: tuple[str, str]
    unit: str  # unit of a's lengths, for people; empty if unknown
    has_sigma: tuple[bool, bool]  # whether standard deviations of points of a and of b are known, or of poses
    same_share: float  # share of a's image points that b also has; NaN if a has none
    pairing: Pairing  # common points and photographs
    alignment: str  # points | cameras | control | none
    scale_estimated: bool  # whether the alignment estimates the scale, since not both results have one
    a_from_b: Similarity
    points: tuple[str, ...]  # names in a of the common points, (n,)
    point_difference: FloatArray  # object unit of a, (n, 3)
    point_sigma: FloatArray  # of the differences, NaN if unknown, object unit of a, (n, 3)
    untested: Remark | None  # why there is no test; None with a test
    approximate: bool  # whether the tests only use the covariance of single points
    statistic: FloatArray  # T of each point, NaN if not tested, (n,)
    critical: float  # critical value of T for one point among all; NaN without tests
    significant: BoolArray  # points that moved, (n,)
    global_statistic: float  # of the global test, over its degrees of freedom; NaN without tests
    global_critical: float  # critical value of the global test; NaN without tests
    stable: BoolArray  # points of the alignment, (n,); all points if none moved
    majority: bool  # whether most of the points agree; if not, the moved points are unknown
    cause: Cause | None  # cause of the differences; None if single points moved, or without a cause
    images: tuple[str, ...]  # names in a of the common photographs, (m,)
    poses: PoseTest | None  # of common photographs without common points; None if they are not tested
    position_difference: FloatArray  # of projection centres, object unit of a, (m, 3)
    rotation_deg: FloatArray  # angle between the rotations, deg, (m,)
    interior: tuple[InteriorDifference, ...]  # of cameras that share photographs
    weaker: tuple[Weakness, ...] = ()  # why one of them is the weaker solution of the same photographs

    @property
    def independent(self) -> bool:
        """Whether the results come from separate measurements, as the test requires."""
        return not self.same_share > SAME_SHARE

    @property
    def changed(self) -> bool | None:
        """Whether the points differ significantly, as a whole or singly; None without a test."""
        if self.cause is not None:
            return True
        if self.untested is not None:
            return None
        return bool(
            self.global_statistic > self.global_critical
            or self.significant.any()
            or not self.majority
            or (self.poses is not None and self.poses.significant.any())
        )

    def _rows(self) -> list[tuple[str, str]]:
        longest = float(np.linalg.norm(self.point_difference, axis=1).max(initial=0.0))
        test = f"{int(self.significant.sum())} of {len(self.points)} points moved"
        if self.untested is not None:
            test = self.untested.text
        elif self.poses is not None:
            tested = int(np.isfinite(self.poses.statistic).sum())
            test = f"{int(self.poses.significant.sum())} of {tested} photographs differ"
        elif self.cause is not None or not self.majority:
            test = "the points differ as a whole"
        return [
            ("points", f"{len(self.points)} common, aligned over {self.alignment}"),
            ("photographs", f"{len(self.images)} common"),
            ("largest difference", f"{longest:.3g} {self.unit}".rstrip()),
            ("test", test),
        ]

    def __repr__(self) -> str:
        return text_table(f"Comparison of {' and '.join(self.names)}", ("", ""), self._rows())

    def _repr_html_(self) -> str:
        return html_table(f"Comparison of {' and '.join(self.names)}", ("", ""), self._rows())


@checked_arguments()
def compare_results(
    a: Solution,
    b: Solution,
    *,
    align: str | None = None,
    control: tuple[str, ...] = (),
    alpha: float = FALSE_ALARM,
) -> ResultComparison:
    """Align b to a and test the differences.

    Where no points are common, the exterior orientations of photographs are tested, if they are in one
    coordinate system.

    Args:
        a: first result.
        b: second result.
        align: points (all common points that did not move), cameras (projection centres), control (the named
            points) or none. If not given, points, or none where a result has no points.
        control: names in a of the points for align = control.
        alpha: probability of reporting a change if there is none.

    Raises:
        GeometryError: an unknown alignment, too little in common for it, or nothing in common at all.
    """
    align = _alignment(a, b, align)
    pairing = pair_results(a, b)
    pa, pb = pairing.points.T
    ia, ib = pairing.images.T
    names = tuple(a.network.points[j] for j in pa)
    if not len(pa) and not len(ia):
        raise GeometryError(
            f"{a.name} and {b.name} have no points and no photographs in common: they share neither names, "
            "nor image points, nor positions of points"
        )
    chosen = _alignment_points(names, align, control)
    scale = known_scale(a, b)
    transform = _align(a, b, align, pairing, chosen, scale)
    same_share = _same_share(a.network, b.network, pairing)
    moved = transform.apply_estimate(b.estimate)
    pairs = pairs_of_results(a, b, pairing.points, scale)
    test = judge_points(a, b, pairing, pairs, transform, align, chosen, alpha)
    poses = compare_poses(a, b, pairing.images, alpha) if align == "none" and not len(pa) else None
    if poses is not None:
        test = replace(test, untested=None)
    if same_share > SAME_SHARE:
        same = remark("same_image_points", share=same_share, first=a.name, second=b.name)
        test = replace(test, untested=same)
    stable = chosen & test.stable if align == "control" else test.stable
    if align == "points" and test.untested is None and not stable.all():
        transform = fit_similarity(b.estimate.points[pb[stable]], a.estimate.points[pa[stable]], scale=scale)
        moved = transform.apply_estimate(b.estimate)
    points, free, _ = pairs
    cause = None
    if align != "none" and any(has_sigma(result) for result in (a, b)):
        agrees = test.untested is None and test.agrees
        cause = find_cause(points, reference=chosen[free], changed=not agrees)
    test = replace(test, stable=stable).without_untested
    known = has_sigma if poses is None else has_pose_sigma
    return ResultComparison(
        names=(a.name, b.name),
        unit=a.unit,
        has_sigma=(known(a), known(b)),
        same_share=same_share,
        pairing=pairing,
        alignment=align,
        scale_estimated=scale is None and align != "none",
        a_from_b=transform,
        points=names,
        point_difference=moved.points[pb] - a.estimate.points[pa],
        point_sigma=test.sigma,
        untested=test.untested,
        approximate=test.approximate,
        statistic=test.statistic,
        critical=test.critical,
        significant=test.significant,
        global_statistic=test.global_statistic,
        global_critical=test.global_critical,
        stable=test.stable,
        majority=test.majority,
        cause=cause,
        images=tuple(a.network.images[i] for i in ia),
        poses=poses,
        position_difference=moved.position[ib] - a.estimate.position[ia],
        rotation_deg=rotation_angle_deg(a.estimate.rotation[ia], moved.rotation[ib]),
        interior=_interior(a, b, ia, ib),
        weaker=weaker_solutions(a, b, pairing),
    )


def _alignment(a: Solution, b: Solution, align: str | None) -> str:
    """Return the alignment that was asked for, or the usual one."""
    if align is None:
        have_points = a.estimate.determined.any() and b.estimate.determined.any()
        return "points" if have_points else "none"
    if align not in ALIGNMENTS:
        raise GeometryError(f"comparison: align '{align}', expected one of {', '.join(ALIGNMENTS)}")
    return align


def _alignment_points(names: tuple[str, ...], align: str, control: tuple[str, ...]) -> BoolArray:
    """Return the common points that the alignment may use, (n,)."""
    if align != "control":
        return np.ones(len(names), dtype=bool)
    for name in control:
        if name not in names:
            raise GeometryError(f"comparison: control point {name} is not in both results")
    return np.isin(np.array(names, dtype=object), list(control))


def _align(
    a: Solution, b: Solution, align: str, pairing: Pairing, chosen: BoolArray, scale: float | None
) -> Similarity:
    if align == "none":
        return Similarity(1.0, np.eye(3), np.zeros(3))
    if align == "cameras":
        source, target = b.estimate.position[pairing.images[:, 1]], a.estimate.position[pairing.images[:, 0]]
        what = "photographs"
    else:
        pairs = pairing.points[chosen]
        source, target = b.estimate.points[pairs[:, 1]], a.estimate.points[pairs[:, 0]]
        what = "points" if align == "points" else "control points"
    if len(source) < 3:
        raise GeometryError(
            f"comparison: {len(source)} {what} in common, alignment needs 3; "
            "--align none compares two of one coordinate system"
        )
    return fit_similarity(source, target, scale=scale)


def _same_share(a: Network, b: Network, pairing: Pairing) -> float:
    """Return the share of a's image points that b has at the same position; NaN if a has none."""
    ours, theirs = a.image_points, b.image_points
    if not len(ours):
        return np.nan
    image = np.full(len(b.images), -1)
    image[pairing.images[:, 1]] = pairing.images[:, 0]
    point = np.full(len(b.points), -1)
    point[pairing.points[:, 1]] = pairing.points[:, 0]
    n = len(a.points)
    key_a = ours.image * n + ours.point
    known = (image[theirs.image] >= 0) & (point[theirs.point] >= 0)
    key_b = (image[theirs.image] * n + point[theirs.point])[known]
    _, i, j = np.intersect1d(key_a, key_b, return_indices=True)
    same_px = SAME_PX if pairing.xy[0] is ours.xy else SAME_RAY_PX
    same = np.abs(pairing.xy[0][i] - pairing.xy[1][known][j]).max(axis=1) < same_px
    return float(same.sum() / len(ours))


def _interior(a: Solution, b: Solution, ia: IntArray, ib: IntArray) -> tuple[InteriorDifference, ...]:
    """Return the differences of cameras with common photographs or the same name, each pair once.

    Cameras of B that do not convert to the model of A, such as a fisheye, are left out.
    """
    differences = []
    pairs = dict.fromkeys(zip(a.network.camera[ia].tolist(), b.network.camera[ib].tolist(), strict=True))
    if a.images_named and b.images_named:
        paired_a, paired_b = {p for p, _ in pairs}, {q for _, q in pairs}
        index = {
            (camera.name, camera.size_px): q
            for q, camera in enumerate(b.estimate.cameras)
            if q not in paired_b
        }
        pairs |= {
            (p, index[camera.name, camera.size_px]): None
            for p, camera in enumerate(a.estimate.cameras)
            if p not in paired_a and (camera.name, camera.size_px) in index
        }
    for p, q in pairs:
        ours, theirs = a.estimate.cameras[p], b.estimate.cameras[q]
        conversion = None
        sigma = np.full(len(ours.names), np.nan)
        if theirs.model != ours.model:
            if not theirs.in_mm:
                theirs = replace(theirs, pixel_mm=ours.pixel_mm)
            try:
                conversion = convert_camera(theirs, ours.model)
            except (GeometryError, SurveyFileError):
                continue
            theirs = conversion.camera
        else:
            known = [
                sigma if result.interior_sigma is None else result.interior_sigma[k]
                for result, k in ((a, p), (b, q))
            ]  # if only one sigma is known, it is that of the difference; if none is known, NaN
            total = np.hypot(*(np.nan_to_num(column) for column in known))
            sigma = np.where(np.isfinite(known).any(axis=0), total, np.nan)
        differences.append(
            InteriorDifference(
                ours.name,
                ours.model,
                ours.names,
                ours.units,
                theirs.parameters - ours.parameters,
                sigma,
                conversion,
            )
        )
    return tuple(differences)


@dataclass(frozen=True)
class PointTest:
    """Results of the tests of the points."""

    sigma: FloatArray  # of the differences, NaN if unknown, (n, 3)
    untested: Remark | None  # why there is no test
    statistic: FloatArray
    critical: float
    significant: BoolArray
    global_statistic: float
    global_critical: float
    stable: BoolArray
    approximate: bool = False
    majority: bool = True

    @property
    def without_untested(self) -> PointTest:
        """The test without figures that mean nothing, if there is a reason not to test."""
        if self.untested is None:
            return self
        nothing = np.full(len(self.statistic), np.nan)
        every = np.ones(len(self.statistic), dtype=bool)
        return replace(
            self,
            statistic=nothing,
            critical=np.nan,
            significant=~every,
            global_statistic=np.nan,
            global_critical=np.nan,
            stable=every,
        )

    @property
    def agrees(self) -> bool:
        """Whether no test shows that the points differ."""
        return not (
            self.global_statistic > self.global_critical or self.significant.any() or not self.majority
        )


def judge_points(
    a: Solution,
    b: Solution,
    pairing: Pairing,
    pairs: tuple[PointPairs, IntArray, BoolArray],
    transform: Similarity,
    align: str,
    chosen: BoolArray,
    alpha: float,
) -> PointTest:
    """Test the differences of the common points with the best known covariance.

    Args:
        a: first result.
        b: second result.
        pairing: common points and photographs.
        pairs: result of `pairs_of_results` for the common points.
        transform: a_from_b.
        align: alignment: points, cameras, control or none.
        chosen: points that the alignment may use, (n,).
        alpha: level of all tests together.
    """
    pa, pb = pairing.points.T
    n = len(pa)
    rounding = rounding_of(a.estimate.points[pa]) ** 2
    blocks = _covariance_of_differences(a.point_covariance, b.point_covariance, pa, pb, transform, rounding)
    variance = np.einsum("njj->nj", blocks)
    sigma = np.sqrt(np.where(variance >= 0, variance, np.nan))
    nothing = np.full(n, np.nan)
    every = np.ones(n, dtype=bool)

    def without(why: Remark) -> PointTest:
        return PointTest(sigma, why, nothing, np.nan, ~every, np.nan, np.nan, every)

    if not n:
        return without(remark("untestable", reason="no points are common"))
    if not any(has_sigma(result) for result in (a, b)):
        return without(remark("no_covariance", unknown="sigmas"))
    known = [result for result in (a, b) if has_sigma(result)]
    points, free, together = pairs
    if all(result.covariance is not None for result in known):
        if align == "none" and not all(result.datum == "control" for result in known):
            return without(remark("untestable", reason=NO_COMMON_DATUM))
        d, Q = points.differences(transform)
        try:
            test = congruency(
                d,
                Q,
                points.a,
                motion="none" if align == "none" else "similarity" if points.scale is None else "rigid",
                redundancy=points.redundancy,
                reference=chosen[free],
                alpha=alpha,
            )
        except GeometryError as error:
            return without(remark("untestable", reason=str(error)))
        sigma[together] = 0.0  # held in both results, or overwritten below
        return _congruency_test(test, free, sigma, together)
    if not all(result.datum in FREE_DATUMS for result in known):
        return without(remark("no_covariance", unknown="covariance"))
    difference = transform.apply(b.estimate.points[pb]) - a.estimate.points[pa]
    statistic, critical, global_critical = _single_tests(difference, blocks, points.redundancy, alpha)
    if not np.isfinite(statistic).any():
        return without(remark("no_covariance", unknown="sigmas"))
    return PointTest(
        sigma=sigma,
        untested=None,
        statistic=statistic,
        critical=critical,
        significant=statistic > critical,
        global_statistic=float(np.nanmean(statistic)),
        global_critical=global_critical,
        stable=every,
        approximate=True,
    )


def _congruency_test(test: Congruency, tested: IntArray, sigma: FloatArray, together: BoolArray) -> PointTest:
    """Return the test of all points, of which some took no part; `sigma` is overwritten in place."""
    n = len(together)
    statistic = np.full(n, np.nan)
    sigma[tested] = np.sqrt(np.diagonal(test.covariance).reshape(-1, 3).clip(0))
    statistic[tested] = test.statistic
    stable = together.copy()
    stable[tested] = test.stable
    significant = np.zeros(n, dtype=bool)
    significant[tested] = test.moved
    return PointTest(
        sigma=sigma,
        untested=None,
        statistic=statistic,
        critical=float(test.critical[test.reference][0]),
        significant=significant,
        global_statistic=test.first_test.statistic,
        global_critical=test.first_test.critical,
        stable=stable,
        majority=test.agreed,
    )


def _covariance_of_differences(
    a: FloatArray | None,
    b: FloatArray | None,
    pa: IntArray,
    pb: IntArray,
    transform: Similarity,
    rounding: float,
) -> FloatArray:
    """Return the covariance of the differences; a single unknown covariance counts as 0, two give NaN."""
    unknown = np.full((len(pa), 3, 3), np.nan)
    J = transform.scale * transform.rotation
    ours = unknown if a is None else a[pa]
    theirs = unknown if b is None else J @ b[pb] @ J.T
    first = np.isfinite(ours).all(axis=(1, 2), keepdims=True)
    second = np.isfinite(theirs).all(axis=(1, 2), keepdims=True)
    total = np.where(first, ours, 0.0) + np.where(second, theirs, 0.0) + rounding * np.eye(3)
    return np.where(first | second, total, np.nan)


def _single_tests(
    difference: FloatArray, covariance: FloatArray, redundancy: int | None, alpha: float
) -> tuple[FloatArray, float, float]:
    """Return T of each point, its critical value for one point among all, and that of the mean of T."""
    statistic = np.full(len(difference), np.nan)
    testable = np.isfinite(covariance).all(axis=(1, 2)) & (
        np.linalg.matrix_rank(np.nan_to_num(covariance)) == 3
    )
    d = difference[testable]
    statistic[testable] = (
        np.einsum("ni,ni->n", d, np.linalg.solve(covariance[testable], d[..., None])[..., 0]) / 3
    )
    tested = max(1, int(testable.sum()))
    single = critical_value(alpha / 2 / tested, 3, redundancy)
    return statistic, single, critical_value(alpha / 2, 3 * tested, redundancy)


def known_scale(a: Solution, b: Solution) -> float | None:
    """Return the scale of a over b if both have a scale; None if it must be estimated."""
    if not (a.has_scale and b.has_scale):
        return None
    if a.unit == b.unit:
        return 1.0
    return METRES[b.unit] / METRES[a.unit] if a.unit in METRES and b.unit in METRES else None


def has_sigma(result: Solution) -> bool:
    """Return whether the standard deviation of any point is known."""
    return result.point_covariance is not None and bool(np.isfinite(result.point_covariance).any())
