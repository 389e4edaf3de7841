"""Differences of two results of one object, with their standard deviations and tests.

Results are brought together by names of points or photographs. After an alignment (similarity over common
points or projection centres, or over control, or none) each difference d of a point is tested by
T = d' (Qa + Qb)^-1 d / 3, which under no change follows Fisher's F with 3 and the redundancy's degrees of
freedom (chi-square over 3 where that is not known). The covariance of the aligned result is turned and scaled
with it; the uncertainty of the alignment itself is left out, which makes the tests a little strict for few
points. Results that were adjusted from the same image points are not independent and are not tested.

Source: Luhmann et al. (2020), Close-Range Photogrammetry and 3D Imaging, sec. 2.4.2; Caspary (2000),
Concepts of network and deformation analysis, sec. 7.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2, f

from sfm.comparison.adjusters import rotation_angle_deg
from sfm.comparison.camera_conversion import Conversion, convert_camera
from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.errors import GeometryError
from sfm.network import Network
from sfm.similarity import Similarity, fit_similarity
from sfm.stored_result import StoredResult

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


@dataclass(frozen=True)
class ResultComparison:
    """Differences b - a of two results after b was aligned to a."""

    names: tuple[str, str]
    unit: str  # of a's lengths, as people call it; empty where nobody knows
    has_sigma: tuple[bool, bool]  # whether standard deviations of points of a and of b are known
    same_share: float  # of a's image points that b has too; NaN if a has none
    alignment: str  # points | cameras | control | none
    a_from_b: Similarity
    points: tuple[str, ...]  # names of the common points, n of them
    point_difference: FloatArray  # object unit of a, (n, 3)
    point_sigma: FloatArray  # of the differences, NaN where not known, (n, 3)
    statistic: FloatArray  # T of each point, NaN where not known, (n,)
    critical: float  # of T for one point among all; NaN if no covariance is known
    significant: BoolArray  # points with T above it, (n,)
    global_statistic: float  # mean of T over all points
    global_critical: float  # of the global test; NaN if no covariance is known
    images: tuple[str, ...]  # names of the common photographs, m of them
    position_difference: FloatArray  # of projection centres, object unit of a, (m, 3)
    rotation_deg: FloatArray  # angle between the rotations, deg, (m,)
    interior: tuple[InteriorDifference, ...]  # of cameras that share photographs

    @property
    def independent(self) -> bool:
        """Whether the results come from measurements of their own, as the test wants it."""
        return not self.same_share > SAME_SHARE

    @property
    def changed(self) -> bool | None:
        """Whether the points differ significantly as a whole; None if that is not tested."""
        if np.isnan(self.global_critical):
            return None
        return bool(self.global_statistic > self.global_critical)


def compare_results(
    a: StoredResult,
    b: StoredResult,
    *,
    align: str = "points",
    control: tuple[str, ...] = (),
    alpha: float = ALPHA,
) -> ResultComparison:
    """Align b to a and test the differences.

    Args:
        a: first result.
        b: second result; points and photographs are recognised by their names.
        align: points (all common ones), cameras (projection centres), control (the named points) or none.
        control: names of the points for align = control.
        alpha: probability of calling something a change that is none.

    Raises:
        GeometryError: an unknown alignment, too little in common for it, or nothing in common at all.
    """
    if align not in ALIGNMENTS:
        raise GeometryError(f"comparison: align '{align}', expected one of {', '.join(ALIGNMENTS)}")
    pa, pb = _common(a.network.points, a.estimate.determined, b.network.points, b.estimate.determined)
    ia, ib = _common(a.network.images, a.estimate.oriented, b.network.images, b.estimate.oriented)
    point_names = tuple(a.network.points[j] for j in pa)
    if not len(pa) and not len(ia):
        raise GeometryError(
            f"{a.name} and {b.name} have neither points nor photographs of the same names, so there is "
            "nothing to compare"
        )
    transform = _align(a, b, align, (pa, pb), (ia, ib), point_names, control)
    moved = transform.apply_estimate(b.estimate)
    difference = moved.points[pb] - a.estimate.points[pa]
    covariance = _sum(a.point_covariance, b.point_covariance, pa, pb, transform)
    same_share = _same_share(a.network, b.network)
    if same_share > SAME_SHARE:
        statistic, critical, global_critical = np.full(len(pa), np.nan), np.nan, np.nan
    else:
        statistic, critical, global_critical = _tests(a, b, difference, covariance, alpha)
    variance = np.einsum("njj->nj", covariance)
    return ResultComparison(
        (a.name, b.name),
        a.unit,
        (_has_sigma(a), _has_sigma(b)),
        same_share,
        align,
        transform,
        point_names,
        difference,
        np.sqrt(np.where(variance >= 0, variance, np.nan)),
        statistic,
        critical,
        statistic > critical,
        float(np.nanmean(statistic)) if np.isfinite(statistic).any() else np.nan,
        global_critical,
        tuple(a.network.images[i] for i in ia),
        moved.position[ib] - a.estimate.position[ia],
        rotation_angle_deg(a.estimate.rotation[ia], moved.rotation[ib]),
        _interior(a, b, ia, ib),
    )


def _common(
    a: tuple[str, ...], a_known: BoolArray, b: tuple[str, ...], b_known: BoolArray
) -> tuple[IntArray, IntArray]:
    """Indices of what both know, in the order of a."""
    index = {name: k for k, name in enumerate(b) if b_known[k]}
    rows = [(k, index[name]) for k, name in enumerate(a) if a_known[k] and name in index]
    table = np.array(rows, dtype=np.int64).reshape(-1, 2)
    return table[:, 0], table[:, 1]


def _align(
    a: StoredResult,
    b: StoredResult,
    align: str,
    points: tuple[IntArray, IntArray],
    images: tuple[IntArray, IntArray],
    names: tuple[str, ...],
    control: tuple[str, ...],
) -> Similarity:
    if align == "none":
        return Similarity(1.0, np.eye(3), np.zeros(3))
    if align == "cameras":
        source, target = b.estimate.position[images[1]], a.estimate.position[images[0]]
        what = "photographs"
    else:
        missing = [name for name in control if name not in names]
        if align == "control" and missing:
            raise GeometryError(f"comparison: control point {missing[0]} is not in both results")
        chosen = np.array([align == "points" or name in control for name in names], dtype=bool)
        source, target = b.estimate.points[points[1][chosen]], a.estimate.points[points[0][chosen]]
        what = "points" if align == "points" else "control points"
    if len(source) < 3:
        raise GeometryError(f"comparison: {len(source)} {what} in common, alignment needs 3")
    return fit_similarity(source, target)


def _has_sigma(result: StoredResult) -> bool:
    return result.point_covariance is not None and bool(np.isfinite(result.point_covariance).any())


def _same_share(a: Network, b: Network) -> float:
    """Share of a's image points that b has too, at the same place of the same photograph; NaN without any."""
    ours, theirs = a.image_points, b.image_points
    if not len(ours):
        return np.nan
    place = {
        (b.images[i], b.points[j]): xy for i, j, xy in zip(theirs.image, theirs.point, theirs.xy, strict=True)
    }
    same = 0
    for i, j, xy in zip(ours.image, ours.point, ours.xy, strict=True):
        other = place.get((a.images[i], a.points[j]))
        same += other is not None and bool(np.abs(other - xy).max() < SAME_PX)
    return same / len(ours)


def _sum(
    a: FloatArray | None, b: FloatArray | None, pa: IntArray, pb: IntArray, transform: Similarity
) -> FloatArray:
    """Covariance of the differences, NaN where neither is known; one that is not known counts as 0."""
    unknown = np.full((len(pa), 3, 3), np.nan)
    J = transform.scale * transform.rotation
    ours = unknown if a is None else a[pa]
    theirs = unknown if b is None else J @ b[pb] @ J.T
    first = np.isfinite(ours).all(axis=(1, 2), keepdims=True)
    second = np.isfinite(theirs).all(axis=(1, 2), keepdims=True)
    total = np.where(first, ours, 0.0) + np.where(second, theirs, 0.0)
    return np.where(first | second, total, np.nan)


def _tests(
    a: StoredResult, b: StoredResult, difference: FloatArray, covariance: FloatArray, alpha: float
) -> tuple[FloatArray, float, float]:
    """T of each point, its critical value for one of all points, and that of the mean of T."""
    n = len(difference)
    statistic = np.full(n, np.nan)
    # held points have covariance 0 on both sides and no test
    testable = np.isfinite(covariance).all(axis=(1, 2)) & (
        np.linalg.matrix_rank(np.nan_to_num(covariance)) == 3
    )
    d = difference[testable]
    statistic[testable] = (
        np.einsum("ni,ni->n", d, np.linalg.solve(covariance[testable], d[..., None])[..., 0]) / 3
    )
    tested = int(testable.sum())
    if not tested:
        return statistic, np.nan, np.nan
    redundancies = [r.redundancy for r in (a, b) if r.redundancy is not None]
    one, every = alpha / tested, alpha
    if not redundancies:
        return statistic, float(chi2.isf(one, 3) / 3), float(chi2.isf(every, 3 * tested) / (3 * tested))
    freedom = sum(redundancies)
    return statistic, float(f.isf(one, 3, freedom)), float(f.isf(every, 3 * tested, freedom))


def _interior(a: StoredResult, b: StoredResult, ia: IntArray, ib: IntArray) -> tuple[InteriorDifference, ...]:
    """Differences of the cameras that took the same photographs, each pair once."""
    found = []
    pairs = dict.fromkeys(zip(a.network.camera[ia].tolist(), b.network.camera[ib].tolist(), strict=True))
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
            sigma = _either(
                None if a.interior_sigma is None else a.interior_sigma[p],
                None if b.interior_sigma is None else b.interior_sigma[q],
                sigma,
            )
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


def _either(a: FloatArray | None, b: FloatArray | None, unknown: FloatArray) -> FloatArray:
    """Sigma of a difference; what only one knows is its sigma, what neither knows stays NaN."""
    known = [unknown if one is None else one for one in (a, b)]
    total = np.hypot(*(np.nan_to_num(one) for one in known))
    return np.where(np.isfinite(known[0]) | np.isfinite(known[1]), total, np.nan)
