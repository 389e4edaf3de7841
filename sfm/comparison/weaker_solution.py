"""Which of two solutions of the same photographs is the weaker one, by its image points or by its lens model.

Image points are compared by their residuals, the lens models by the image points of the other solution: these
are adjusted with its own cameras, and again with the model of the weaker one, with as many terms as are used
there. The leaner model is too lean where ln likelihood falls by more than its parameters save, and by more
than two alternatives that cannot be separated differ.

Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.6.8 and 4.7.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sfm.comparison.camera_conversion import convert_camera
from sfm.comparison.camera_readjustment import adjusted_with
from sfm.comparison.pairing import Pairing
from sfm.comparison.solutions import reprojection
from sfm.model.conventions import MAD_TO_SIGMA
from sfm.model.distributions import LEVEL, MIN_LEAD, f_sf
from sfm.model.errors import GeometryError, SurveyFileError
from sfm.model.likelihood import price_of
from sfm.model.solution import Solution

MAD_EFFICIENCY = 0.37  # of the median of absolute deviations against the standard deviation
MIN_COMMON = 0.5  # share of the photographs of the smaller solution that both must have


@dataclass(frozen=True)
class Weakness:
    """Why one of two solutions of the same photographs is weaker."""

    name: str  # of the weaker solution
    of: str  # name of the other one
    sigma_px: float | None  # robust standard deviation of its image coordinates, px; None: not worse
    of_sigma_px: float  # the same of the other one, px
    camera: str | None = None  # camera of the other one that its lens model does not describe; None: not so
    model: str = ""  # that lens model
    with_model_px: float = np.nan  # standard deviation of the other one's image coordinates with it, px
    own_px: float = np.nan  # the same with its own cameras, px


def weaker_solutions(a: Solution, b: Solution, pairing: Pairing) -> tuple[Weakness, ...]:
    """Return the weaknesses of each of two solutions against the other; none if they have other photographs.

    Args:
        a: first solution, without its rejected image points.
        b: second solution.
        pairing: their common points and photographs.
    """
    fewest = min(int(solution.estimate.oriented.sum()) for solution in (a, b))
    if len(pairing.images) < max(MIN_COMMON * fewest, 2) or not all(
        len(solution.network.image_points) for solution in (a, b)
    ):
        return ()
    cameras = {
        (int(a.network.camera[i]), int(b.network.camera[j])) for i, j in pairing.images.tolist()
    }  # of the common photographs
    if any(a.estimate.cameras[p].size_px != b.estimate.cameras[q].size_px for p, q in cameras):
        return ()  # photographs of another size have other pixels
    weaknesses = []
    for weaker, other, pairs in ((b, a, {(q, p) for p, q in cameras}), (a, b, cameras)):
        theirs, freedom = _sigma_px(weaker)
        ours, of_freedom = _sigma_px(other)
        lens = next(_leaner_lenses(weaker, other, sorted(pairs)), None)
        misfit = 1.0 if lens is None else lens[2] / lens[3]  # the lens alone makes residuals so much larger
        freedoms = (MAD_EFFICIENCY * freedom, MAD_EFFICIENCY * of_freedom)
        coarse = ours > 0 and float(f_sf((theirs / (misfit * ours)) ** 2, *freedoms)) < LEVEL
        if coarse or lens is not None:
            sigma_px = theirs if coarse else None
            weaknesses.append(Weakness(weaker.name, other.name, sigma_px, ours, *(lens or ())))
    return tuple(weaknesses)


def _sigma_px(solution: Solution) -> tuple[float, int]:
    """Return the robust standard deviation of an image coordinate, px, and its degrees of freedom."""
    v = reprojection(solution.network, solution.estimate)
    seen = solution.network.image_points
    unknowns = 6 * len(np.unique(seen.image)) + 3 * len(np.unique(seen.point)) - 7
    freedom = max(v.size - unknowns, 1)
    spread = MAD_TO_SIGMA * float(np.median(np.abs(v))) if v.size else np.nan
    return spread / float(np.sqrt(min(1.0, freedom / max(v.size, 1)))), freedom


def _leaner_lenses(
    weaker: Solution, other: Solution, cameras: list[tuple[int, int]]
) -> Iterator[tuple[str, str, float, float]]:
    """Yield cameras of the other solution that the lens model of the weaker one does not describe.

    With each its name, that model, and the standard deviation of an image coordinate with it and without, px.
    """
    before = None
    for q, p in {q: p for p, q in reversed(cameras)}.items():  # each camera of the other one once
        ours, theirs = other.estimate.cameras[q], weaker.estimate.cameras[p]
        used = zip(theirs.names, theirs.parameters, strict=True)
        try:  # with only the terms that are used there
            held = tuple(name for name, value in used if value == 0)
            leaner = convert_camera(ours, theirs.model, held=held).camera
        except (GeometryError, SurveyFileError):
            continue
        saved = int(ours.free.sum()) - int(leaner.free.sum())
        if saved <= 0:
            continue
        before = before or adjusted_with(other, {})
        after = adjusted_with(other, {ours.name: leaner})
        if before is None or after is None or not before.vPv > 0:
            continue
        loss = before.redundancy / 2 * float(np.log(after.vPv / before.vPv))
        seen = int((other.network.camera[other.network.image_points.image] == q).sum())
        if loss > price_of(saved, seen) + MIN_LEAD:
            yield ours.name, theirs.model, _sigma_px(after.solution)[0], _sigma_px(before.solution)[0]
