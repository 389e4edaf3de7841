"""How wrong an assumption may be before the tests name it: external reliability of alternatives.

Parameters b of an alternative have the noncentrality b'Hb and shift coordinates by E b. Where lambda is the
noncentrality that the tests find with 80 % probability, a coordinate of standard deviation s with the row e
of E shifts by up to sqrt(lambda e H^-1 e') / s before.

Source: Baarda (1968), A testing procedure for use in geodetic networks (external reliability); Foerstner and
Wrobel (2016), Photogrammetric Computer Vision, sec. 4.6.4.2.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator

import numpy as np
from scipy.special import chndtrinc

from sfm.adjustment.hypotheses.alternatives import (
    cameras_of_photographs,
    count_alternatives,
    interior_parameters,
    needed_gain,
    photographs_among,
)
from sfm.adjustment.hypotheses.columns import Columns, columns_of
from sfm.adjustment.hypotheses.families import (
    CAMERA_FAMILIES,
    HELD,
    STRAIN,
    Alternative,
    InteriorFamily,
)
from sfm.adjustment.hypotheses.patterns import MIN_GROUP, too_many_cameras
from sfm.adjustment.hypotheses.score import (
    MIN_DETERMINED_SHARE,
    NONE,
    Gain,
    Reduced,
    directions_of,
    reduce_adjustment,
)
from sfm.adjustment.result import Adjustment
from sfm.remarks.kind import WRONG_SIGMAS
from sfm.remarks.remark import Remark, remark
from sfm.similarity import without_motions

POWER = 0.80  # with which a detectable error is found; Baarda (1968)


def unchecked_assumptions(a: Adjustment, bodies: int = 0, without: str | None = None) -> tuple[Remark, ...]:
    """Return which assumptions the tests hardly check, with the shift that an error may cause unnoticed.

    Args:
        a: adjustment of the image points alone, with its covariance.
        bodies: bodies that are tested for having moved.
        without: what fixes all coordinates of the result, so that only those of `a` shift; None if nothing.

    Raises:
        numpy.linalg.LinAlgError: the network is not determined.
    """
    columns = columns_of(a)
    reduced = reduce_adjustment(a, columns)
    number, rows = cameras_of_photographs(a), count_alternatives(a, bodies)
    untested: tuple[Remark, ...] = ()
    if too_many_cameras(number):
        untested = (remark("cameras_untested", cameras=int(number.max()) + 1),)
    found: dict[str, float] = {}
    held: dict[str, dict[str, float]] = defaultdict(dict)
    for one in _typical(a, reduced):
        reach = reach_of(one, a, reduced, columns, rows=rows)
        if not reach > WRONG_SIGMAS:
            continue
        if isinstance(one.family, InteriorFamily):
            index, s = one.parameters[0]
            camera = a.estimate.cameras[index]
            held[camera.owner_of(s)][camera.names[s]] = reach
        else:
            found[one.family.unchecked] = max(reach, found.get(one.family.unchecked, 0.0))
    return (
        *untested,
        *(
            remark(
                "held_weakly_tested",
                camera=camera,
                parameters=tuple(some),
                sigmas=max(some.values()),
                without=without,
            )
            for camera, some in held.items()
        ),
        *(remark(kind, sigmas=reach, without=without) for kind, reach in found.items()),
    )


def _typical(a: Adjustment, reduced: Reduced) -> Iterator[Alternative]:
    """Return each held parameter, and a change of the camera and a strain of the object half way through.

    Of two or three photographs of a camera the last one differs. There is no bending: the worst of its 18
    directions is the shape of no object.
    """
    nothing = Gain(0.0, 0, np.zeros(0))
    for owner in interior_parameters(a, HELD):
        for some in owner:
            yield Alternative(
                *(HELD, "all", np.ones(reduced.photographs), nothing, NONE, 0.0, 0.0, 0.0, 0.0),
                parameters=some,
            )
    camera = cameras_of_photographs(a)
    for family in (*CAMERA_FAMILIES, STRAIN):
        for among in photographs_among(family, camera):
            m = int(among.sum())
            if m < MIN_GROUP or (m < 2 * MIN_GROUP and not family.of_camera):
                continue
            if m < 2 * MIN_GROUP:
                pattern, first, tried = ("single", m - 1, m) if m > MIN_GROUP else ("pair", 1, 1)
            else:
                pattern, first, tried = "split", m // 2, m - 2 * MIN_GROUP + 1
            after = (among & (np.cumsum(among) > first)).astype(float)
            search = float(np.log(tried))
            yield Alternative(*(family, pattern, after, nothing, NONE, 0.0, 0.0, search, 0.0), among=among)


def reach_of(one: Alternative, a: Adjustment, reduced: Reduced, columns: Columns, *, rows: int) -> float:
    """Return by how much coordinates shift at most before an alternative is named, in standard deviations.

    Args:
        one: the alternative.
        a: the adjustment.
        reduced: its normal equations.
        columns: its derivatives.
        rows: alternatives that are tested, which share the level.
    """
    D = reduced.whiten(one.columns(a, columns))
    H, _, squares = reduced.project(D)
    values, vectors, scale = directions_of(H, squares)
    rank = max(int((values > MIN_DETERMINED_SHARE).sum()), 1)
    touched = int((D != 0).any(axis=(1, 2)).sum())
    needed = needed_gain(rank, touched, one.search, rows)
    least = chndtrinc(needed, rank, 1 - POWER) * reduced.design_effect(D)  # noncentrality that is found
    longest = scale[:, None] * vectors * np.sqrt(least / np.maximum(values, MIN_DETERMINED_SHARE))
    X = a.estimate.points
    sigma = np.sqrt(np.diagonal(a.covariance.points, axis1=1, axis2=2))
    known = np.isfinite(X).all(axis=1) & (sigma > 0).all(axis=1)
    shifted = without_motions(X, reduced.shifts(D) @ longest)
    away = np.stack([one.family.displaced(one, X, b) for b in longest.T], axis=2)
    return max(
        float((np.linalg.norm(part[known], axis=2) / sigma[known]).max(initial=0.0))
        for part in (shifted, away)
    )
