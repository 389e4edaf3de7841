"""Differences of two results of one object, with their standard deviations and tests.

Points and photographs are paired as in `sfm.comparison.pairing`, and b is aligned to a: over common points,
projection centres or control, or not at all. The scale is estimated only where one of them has none. Where
the covariance of all points together is known, both are brought into one datum and tested by
`sfm.comparison.congruency`, which also finds the points that moved; then the alignment is over those that did
not. Where only the covariance of each single point is known, each difference d is tested by
T = d' (Qa + Qb)^-1 d / 3, an approximation that is made for free networks only. Results that were adjusted
from the same image points are not independent and are not tested. Reasons other than points that moved
are in `sfm.comparison.causes`.

Source: Luhmann et al. (2020), Close-Range Photogrammetry and 3D Imaging, sec. 2.4.2; Caspary (2000), Concepts
of network and deformation analysis, sec. 7.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.arguments import checked_arguments
from sfm.camera import Camera
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
from sfm.comparison.solutions import rotation_angle_deg
from sfm.comparison.stable_points import critical_value
from sfm.conventions import METRES, BoolArray, FloatArray, IntArray
from sfm.display import html_table, text_table
from sfm.errors import GeometryError
from sfm.network import Network
from sfm.remarks.remark import Remark, remark
from sfm.similarity import Similarity, fit_similarity
from sfm.solution import Solution

FREE_DATUMS = ("free", "")  # in which the covariance of single points gives about what the whole one does
ALIGNMENTS = ("points", "cameras", "control", "none")
SAME_PX = 1e-3  # image points closer than this are one measurement
SAME_SHARE = 0.5  # of a's image points that b has too, from which on they are not independent
ALPHA = 0.05  # level of the global test; single points are tested at ALPHA / number of points (Bonferroni)


@dataclass(frozen=True)
class InteriorDifference:
    """Interior orientation of one camera in both results."""

    camera: str
    model: str  # in which they are compared: that of a
    names: tuple[str, ...]
    units: tuple[str, ...]  # of each parameter
    difference: FloatArray  # b - a, (p,)
    sigma: FloatArray  # of the difference where one is known in this model, NaN where none is, (p,)
    conversion: Conversion | None  # of b's camera into a's model, None if it was the same


@dataclass(frozen=True, repr=False)
class ResultComparison:
    """Differences b - a of two results after b was aligned to a."""

    names: tuple[str, str]
    unit: str  # of a's lengths, as people call it; empty where it is not known
    has_sigma: tuple[bool, bool]  # whether standard deviations of points of a and of b are known
    same_share: float  # of a's image points that b has too; NaN if a has none
    pairing: Pairing  # what is common, by index, and how it was recognised
    alignment: str  # points | cameras | control | none
    scale_estimated: bool  # in the alignment, since not both results have a scale
    a_from_b: Similarity
    points: tuple[str, ...]  # names in a of the common points, n of them
    point_difference: FloatArray  # object unit of a, (n, 3)
    point_sigma: FloatArray  # of the differences, NaN where not known, (n, 3)
    untested: Remark | None  # why no test is made; None where one is
    approximate: bool  # whether the tests know the covariance of single points only
    statistic: FloatArray  # T of each point, NaN where not tested, (n,)
    critical: float  # of T for one point among all; NaN without tests
    significant: BoolArray  # points that moved, (n,)
    global_statistic: float  # of all points together over its degrees of freedom; NaN without tests
    global_critical: float  # of the global test; NaN without tests
    stable: BoolArray  # points that the alignment is over, (n,); all of them where nothing moved
    majority: bool  # whether most of the points agree; if not, it is not known which of them moved
    cause: Cause | None  # what explains that they differ; None where single points moved, or nothing does
    images: tuple[str, ...]  # names in a of the common photographs, m of them
    position_difference: FloatArray  # of projection centres, object unit of a, (m, 3)
    rotation_deg: FloatArray  # angle between the rotations, deg, (m,)
    interior: tuple[InteriorDifference, ...]  # of cameras that share photographs

    @property
    def independent(self) -> bool:
        """Whether the results come from separate measurements, as the test wants it."""
        return not self.same_share > SAME_SHARE

    @property
    def changed(self) -> bool | None:
        """Whether the points differ significantly, as a whole or singly; None if that is not tested."""
        if self.cause is not None:
            return True
        if self.untested is not None:
            return None
        return bool(
            self.global_statistic > self.global_critical or self.significant.any() or not self.majority
        )

    def _rows(self) -> list[tuple[str, str]]:
        longest = float(np.linalg.norm(self.point_difference, axis=1).max(initial=0.0))
        test = f"{int(self.significant.sum())} of {len(self.points)} points moved"
        if self.untested is not None:
            test = self.untested.text
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
    a: Solution, b: Solution, *, align: str = "points", control: tuple[str, ...] = (), alpha: float = ALPHA
) -> ResultComparison:
    """Align b to a and test the differences.

    Args:
        a: first result.
        b: second result.
        align: points (all common ones that did not move), cameras (projection centres), control (the named
            points) or none.
        control: names in a of the points for align = control.
        alpha: probability of calling something a change that is none.

    Raises:
        GeometryError: an unknown alignment, too little in common for it, or nothing in common at all.
    """
    if align not in ALIGNMENTS:
        raise GeometryError(f"comparison: align '{align}', expected one of {', '.join(ALIGNMENTS)}")
    pairing = pair_results(a, b)
    pa, pb = pairing.points.T
    ia, ib = pairing.images.T
    names = tuple(a.network.points[j] for j in pa)
    if not len(pa) and not len(ia):
        raise GeometryError(
            f"{a.name} and {b.name} have no points and no photographs in common: neither names, nor image "
            "points, nor places in the object are the same"
        )
    chosen = _chosen(names, align, control)
    scale = known_scale(a, b)
    transform = _align(a, b, align, pairing, chosen, scale)
    same_share = _same_share(a.network, b.network, pairing)
    moved = transform.apply_estimate(b.estimate)
    pairs = pairs_of_results(a, b, pairing.points, scale)
    test = judge_points(a, b, pairing, pairs, transform, align, chosen, alpha)
    if same_share > SAME_SHARE:
        same = remark("same_image_points", share=same_share, first=a.name, second=b.name)
        test = replace(test, untested=same)
    stable = chosen & test.stable if align == "control" else test.stable
    if align == "points" and test.untested is None and not stable.all():
        transform = fit_similarity(b.estimate.points[pb[stable]], a.estimate.points[pa[stable]], scale=scale)
        moved = transform.apply_estimate(b.estimate)
    tested = test.untested is None
    points, free, _ = pairs
    cause = None
    if align != "none" and any(has_sigma(one) for one in (a, b)):
        agrees = tested and test.agrees
        cause = find_cause(points, reference=chosen[free], changed=not agrees)
    nothing = np.full(len(pa), np.nan)
    return ResultComparison(
        names=(a.name, b.name),
        unit=a.unit,
        has_sigma=(has_sigma(a), has_sigma(b)),
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
        statistic=test.statistic if tested else nothing,
        critical=test.critical if tested else np.nan,
        significant=test.significant & tested,
        global_statistic=test.global_statistic if tested else np.nan,
        global_critical=test.global_critical if tested else np.nan,
        stable=stable | (not tested),
        majority=test.majority,
        cause=cause,
        images=tuple(a.network.images[i] for i in ia),
        position_difference=moved.position[ib] - a.estimate.position[ia],
        rotation_deg=rotation_angle_deg(a.estimate.rotation[ia], moved.rotation[ib]),
        interior=_interior(a, b, ia, ib),
    )


def _chosen(names: tuple[str, ...], align: str, control: tuple[str, ...]) -> BoolArray:
    """Return which common points the alignment may be over, (n,)."""
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
        raise GeometryError(f"comparison: {len(source)} {what} in common, alignment needs 3")
    return fit_similarity(source, target, scale=scale)


def _same_share(a: Network, b: Network, pairing: Pairing) -> float:
    """Share of a's image points that b has too, at the same place of the same photograph; NaN without any."""
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
    """Differences of the cameras that took the same photographs, or have one name, each pair once."""
    found = []
    pairs = dict.fromkeys(zip(a.network.camera[ia].tolist(), b.network.camera[ib].tolist(), strict=True))
    if a.images_named and b.images_named:
        pairs |= dict.fromkeys(_of_one_name(a.estimate.cameras, b.estimate.cameras, set(pairs)))
    for p, q in pairs:
        ours, theirs = a.estimate.cameras[p], b.estimate.cameras[q]
        conversion = None
        sigma = np.full(len(ours.names), np.nan)
        if theirs.model != ours.model:
            if not theirs.in_mm:
                theirs = replace(theirs, pixel_mm=ours.pixel_mm)
            conversion = convert_camera(theirs, ours.model)
            theirs = conversion.camera
        else:
            known = [
                sigma if one.interior_sigma is None else one.interior_sigma[k] for one, k in ((a, p), (b, q))
            ]  # what only one knows is its sigma, what neither knows stays NaN
            total = np.hypot(*(np.nan_to_num(one) for one in known))
            sigma = np.where(np.isfinite(known).any(axis=0), total, np.nan)
        found.append(
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
    return tuple(found)


def _of_one_name(
    a: tuple[Camera, ...], b: tuple[Camera, ...], paired: set[tuple[int, int]]
) -> list[tuple[int, int]]:
    """Pair cameras of one name and one size of photographs, neither of which is paired yet."""
    ours, theirs = {p for p, _ in paired}, {q for _, q in paired}
    index = {(one.name, one.size_px): q for q, one in enumerate(b) if q not in theirs}
    return [
        (p, index[one.name, one.size_px])
        for p, one in enumerate(a)
        if p not in ours and (one.name, one.size_px) in index
    ]


@dataclass(frozen=True)
class PointTest:
    """Results of the tests of the points."""

    sigma: FloatArray  # of the differences, NaN where not known, (n, 3)
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
    """Test the differences of the common points with all that is known of their covariance.

    Args:
        a: first result.
        b: second result.
        pairing: what they have in common.
        pairs: the points with their covariances, which these are, and which are known, by `pairs_of_results`.
        transform: a_from_b.
        align: what they are aligned by.
        chosen: points that the alignment may be over, (n,).
        alpha: of all tests together.
    """
    pa, pb = pairing.points.T
    n = len(pa)
    rounding = rounding_of(a.estimate.points[pa]) ** 2
    blocks = _sum(a.point_covariance, b.point_covariance, pa, pb, transform, rounding)
    variance = np.einsum("njj->nj", blocks)
    sigma = np.sqrt(np.where(variance >= 0, variance, np.nan))
    nothing = np.full(n, np.nan)
    every = np.ones(n, dtype=bool)

    def without(why: Remark) -> PointTest:
        return PointTest(sigma, why, nothing, np.nan, ~every, np.nan, np.nan, every)

    if not n:
        return without(remark("no_common_points"))
    if not any(has_sigma(one) for one in (a, b)):
        return without(remark("no_sigmas"))
    known = [one for one in (a, b) if has_sigma(one)]
    points, free, together = pairs
    if all(one.covariance is not None for one in known):
        if align == "none" and not all(one.datum == "control" for one in known):
            return without(remark("no_common_datum"))
        d, Q = points.differences(transform)
        try:
            found = congruency(
                *(d, Q, points.a),
                motion="none" if align == "none" else "similarity" if points.scale is None else "rigid",
                redundancy=points.redundancy,
                reference=chosen[free],
                alpha=alpha,
            )
        except GeometryError as error:
            return without(remark("untestable", reason=str(error)))
        sigma[together] = 0.0  # held in both, or written over
        return _of_congruency(found, free, sigma, together)
    if not all(one.datum in FREE_DATUMS for one in known):
        return without(remark("no_joint_covariance"))
    difference = transform.apply(b.estimate.points[pb]) - a.estimate.points[pa]
    statistic, critical, global_critical = _single_tests(difference, blocks, points.redundancy, alpha)
    if not np.isfinite(statistic).any():
        return without(remark("no_sigmas"))
    mean = float(np.nanmean(statistic))
    return PointTest(
        *(sigma, None, statistic, critical, statistic > critical, mean, global_critical, every),
        approximate=True,
    )


def _of_congruency(found: Congruency, tested: IntArray, sigma: FloatArray, together: BoolArray) -> PointTest:
    """Return the test of all points where some took no part; sigma is written over where tested."""
    n = len(together)
    statistic = np.full(n, np.nan)
    sigma[tested] = np.sqrt(np.diagonal(found.covariance).reshape(-1, 3).clip(0))
    statistic[tested] = found.statistic
    stable = together.copy()
    stable[tested] = found.stable
    significant = np.zeros(n, dtype=bool)
    significant[tested] = found.moved
    first, critical = found.first_test, float(found.critical[found.reference][0])
    return PointTest(
        *(sigma, None, statistic, critical, significant, first.statistic, first.critical),
        *(stable, False, found.agreed),
    )


def _sum(
    a: FloatArray | None,
    b: FloatArray | None,
    pa: IntArray,
    pb: IntArray,
    transform: Similarity,
    rounding: float,
) -> FloatArray:
    """Covariance of the differences, NaN where neither is known; one that is not known counts as 0."""
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
    """T of each point, its critical value for one of all points, and that of the mean of T."""
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
    """Return the scale of a over b where both have one, None where it has to be estimated."""
    if not (a.has_scale and b.has_scale):
        return None
    if a.unit == b.unit:
        return 1.0
    return METRES[b.unit] / METRES[a.unit] if a.unit in METRES and b.unit in METRES else None


def has_sigma(result: Solution) -> bool:
    """Whether the standard deviation of any point is known."""
    return result.point_covariance is not None and bool(np.isfinite(result.point_covariance).any())
