"""Pairs of results that differ in a known way, and what comparison and epochs find of it. Object unit m.

    python -m tests.comparison.causes [CASES]    a table: how often each is named, and what else is

Every case has an object, photographs, noise and scale bars of its own; a case depends on its number only.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.comparison.comparison_remarks import verdict_of_comparison
from sfm.comparison.significance import compare_results
from sfm.model.conventions import FloatArray, IntArray, rotation_from_vector
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.remarks.remark import kinds_of
from sfm.model.solution import Solution
from sfm.products.epochs.differences import Epoch
from sfm.products.epochs.series import analyse_epochs, verdict_of_epochs
from tests.synthetic import make_network, observed_anew, seed_of, stored_of

NOISE_PX, BAR_SIGMA = 0.1, 2e-5
EXPECTED = {
    "nothing": (),
    "scale 1.0005": ("lengths_differ",),
    "mm for m": ("unit_differs",),
    "inch for m": ("unit_differs",),
    "mirrored": ("mirrored",),
    "all names permuted": ("names_differ",),
    "three names exchanged": ("names_differ",),
    "another object": ("another_object",),
    "mirrored, mm for m": ("mirrored", "unit_differs"),
    "a tenth moved": ("points_differ",),
    "six tenths moved together": ("points_differ",),
    "grown along x": ("strained",),
    "grown along x and y": ("strained",),
    "bent": ("bent",),
}
"""causes by case; in epochs points that moved are `displaced`"""


def pair(case: str, number: int) -> tuple[Solution, Solution]:
    """Return two results, the second of which differs as the case says."""
    rng = seed_of(f"cause {case} {number}")
    points = int(rng.integers(25, 70))
    flat = bool(rng.random() < 0.3)
    if case in ("mirrored", "grown along x and y"):  # a plane is its mirror image, and its growth a scale
        flat = False
    network, truth = make_network(rng, images=int(rng.integers(8, 15)), points=points, planar=flat)
    if flat:  # with a relief that is seen
        truth = replace(truth, points=truth.points + rng.uniform(-0.02, 0.02, (points, 3)) * [0, 0, 1])
    first = _measured("first", truth, network, rng)
    moved = truth.points.copy()
    if case == "a tenth moved":
        chosen = rng.choice(points, points // 10, replace=False)
        moved[chosen] += 0.01 * _directions(rng, len(chosen))
    if case == "six tenths moved together":
        moved[rng.permutation(points)[: -(-6 * points // 10)]] += 0.001
    if "grown" in case:
        moved *= [1.001, 1.001 if "y" in case else 1.0, 1.0]
    if case == "bent":
        along = moved[:, :2] @ _directions(rng, 1)[0, :2]
        moved[:, 2] += 0.01 * along**2
    if case == "another object":
        network, truth = make_network(rng, images=len(network.images), points=points, planar=flat)
        moved = truth.points
    second = _measured("second", replace(truth, points=moved), network, rng)
    return first, _changed(second, case, rng)


def _directions(rng: np.random.Generator, n: int) -> FloatArray:
    d = rng.standard_normal((n, 3))
    return np.asarray(d / np.linalg.norm(d, axis=1, keepdims=True))


def _measured(name: str, truth: Estimate, network: Network, rng: np.random.Generator) -> Solution:
    seen = observed_anew(network, truth, NOISE_PX, rng)
    for a, b in ((0, 7), (3, 15)):
        length = float(np.linalg.norm(truth.points[a] - truth.points[b]))
        seen = seen.with_scale_bar(
            network.points[a], network.points[b], length + BAR_SIGMA * rng.standard_normal(), BAR_SIGMA
        )
    return stored_of(name, adjust(seen, truth, reject="none", options=AdjustmentOptions(sigma_px=NOISE_PX)))


def _changed(result: Solution, case: str, rng: np.random.Generator) -> Solution:
    """Return a result in a frame of its own, with what the case does to scale, handedness and names."""
    n = len(result.network.points)
    J = rotation_from_vector(rng.standard_normal(3))
    J = J * {"scale 1.0005": 1.0005, "inch for m": 1 / 0.0254}.get(case, 1.0)
    if "mm for m" in case:
        J = J * 1000.0
    if "mirrored" in case:
        J = J @ np.diag([1.0, -1.0, 1.0])
    order = np.arange(n)
    if case == "all names permuted":
        order = rng.permutation(n)
    if case == "three names exchanged":
        chosen = rng.choice(n, 3, replace=False)
        order[chosen] = order[np.roll(chosen, 1)]
    return transformed(result, J, rng.standard_normal(3), order)


def transformed(result: Solution, J: FloatArray, shift: FloatArray, order: IntArray) -> Solution:
    """Return a result with coordinates J x + shift, and with points in another order under the old names."""
    assert result.covariance is not None and result.point_covariance is not None
    n, e = len(order), result.estimate
    Q = result.covariance.reshape(n, 3, n, 3)[order][:, :, order]
    Q = np.einsum("xi,aibj,yj->axby", J, Q, J).reshape(3 * n, 3 * n)
    scale = np.cbrt(np.linalg.det(J))
    rotation = J @ e.rotation / scale if scale > 0 else e.rotation  # a mirrored frame has no photographs
    estimate = replace(
        e, points=e.points[order] @ J.T + shift, position=e.position @ J.T + shift, rotation=rotation
    )
    return replace(
        result, estimate=estimate, covariance=Q, point_covariance=J @ result.point_covariance[order] @ J.T
    )


def compared(case: str, number: int) -> tuple[str, ...]:
    """Return the kinds of remarks of the comparison of a case, without notes."""
    verdict = verdict_of_comparison(compare_results(*pair(case, number)))
    return kinds_of(one for one in verdict.remarks if one.severity != "note")


def epochs(case: str, number: int) -> tuple[str, ...]:
    """Return the kinds of remarks of the two results of a case as epochs, without notes."""
    found = analyse_epochs([Epoch(one.name, one) for one in pair(case, number)])
    return kinds_of(one for one in verdict_of_epochs(found).remarks if one.severity != "note")


def expected(case: str, by: Callable[[str, int], tuple[str, ...]]) -> tuple[frozenset[str], ...]:
    """Return the sets of kinds that a case may have.

    An object that changed its shape between epochs has points that moved, where a majority stayed.
    """
    kinds = frozenset("displaced" if by is epochs and k == "points_differ" else k for k in EXPECTED[case])
    if by is epochs and kinds & {"strained", "bent"}:
        return kinds, frozenset({"displaced"})
    return (kinds,)


def study(cases: int) -> None:
    """Print how often each case is named by the comparison and by epochs, and what else is."""
    for case in EXPECTED:
        for by in (compared, epochs):
            found = Counter(by(case, number) for number in range(cases * (5 if case == "nothing" else 1)))
            right = sum(count for kinds, count in found.items() if set(kinds) in expected(case, by))
            others = {
                " + ".join(kinds) or "nothing": count
                for kinds, count in found.items()
                if set(kinds) not in expected(case, by)
            }
            print(
                f"{case:24} {by.__name__:9} {right:4} of {sum(found.values()):4}  {others or ''}", flush=True
            )


if __name__ == "__main__":
    study(int(sys.argv[1]) if len(sys.argv) > 1 else 20)
