"""Which of two solutions of the same photographs is the weaker one, by its image points or by its lens model.

Image points are compared by their residuals, the lens models by the image points of the other solution: these
are adjusted with its own cameras, and again with the model of the weaker one, with as many terms as are used
there. The leaner model is too lean where ln likelihood falls by more than its parameters save, and by more
than two alternatives that cannot be separated differ.

Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.6.8 and 4.7.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from sfm.comparison.camera_conversion import convert_camera
from sfm.comparison.camera_readjustment import adjusted_with
from sfm.comparison.pairing import Pairing
from sfm.comparison.solutions import redundancy_of, reprojection, robust_sigma_px
from sfm.model.camera import Camera
from sfm.model.distortion.models import Role
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
    cameras: tuple[str, ...] = ()  # cameras of the other one that its lens model does not describe
    model: str = ""  # that lens model, with the terms that are not used
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
    sigma_a, sigma_b = _sigma_px(a), _sigma_px(b)
    tried = (
        _weakness((b, *sigma_b), (a, *sigma_a), sorted((q, p) for p, q in cameras)),
        _weakness((a, *sigma_a), (b, *sigma_b), sorted(cameras)),
    )
    return tuple(weakness for weakness in tried if weakness is not None)


def _weakness(
    weaker: tuple[Solution, float, int], other: tuple[Solution, float, int], cameras: list[tuple[int, int]]
) -> Weakness | None:
    """Return why a solution is weaker than another one; None if it is not, or not beyond chance.

    Args:
        weaker: the solution, the standard deviation of its image coordinates, px, and their redundancy.
        other: the same of the other one.
        cameras: their cameras of common photographs.
    """
    of_weaker, theirs, freedom = weaker
    of_other, ours, of_freedom = other
    lens = _leaner_lens(of_weaker, of_other, cameras)
    misfit = 1.0 if lens is None else lens[2] / lens[3]  # the lens alone makes residuals so much larger
    freedoms = (MAD_EFFICIENCY * freedom, MAD_EFFICIENCY * of_freedom)
    coarse = float(f_sf((theirs / (misfit * ours)) ** 2, *freedoms)) < LEVEL
    if lens is None and not coarse:
        return None
    return Weakness(of_weaker.name, of_other.name, theirs if coarse else None, ours, *(lens or ()))


def _sigma_px(solution: Solution) -> tuple[float, int]:
    """Return the robust standard deviation of an image coordinate, px, NaN if unknown, and its redundancy."""
    network, estimate = solution.network, solution.estimate
    seen = network.image_points
    used = seen.select(estimate.oriented[seen.image] & estimate.determined[seen.point])
    v = reprojection(network, estimate)
    v = v[np.isfinite(v).all(axis=1)]
    redundancy = redundancy_of(used)
    return robust_sigma_px(v, redundancy) if len(v) else np.nan, redundancy


def _leaner_lens(
    weaker: Solution, other: Solution, cameras: list[tuple[int, int]]
) -> tuple[tuple[str, ...], str, float, float] | None:
    """Return cameras of the other solution that the lens model of the weaker one does not describe, or None.

    With them that model, and the standard deviation of an image coordinate with it and without, px. Cameras
    that have one model in the weaker solution are adjusted together.
    """
    leaner: dict[str, dict[str, Camera]] = defaultdict(dict)
    prices: dict[str, float] = defaultdict(float)
    cameras_of = other.network.camera[other.network.image_points.image]
    for q, p in sorted({q: p for p, q in reversed(cameras)}.items()):  # each camera of the other one once
        ours, theirs = other.estimate.cameras[q], weaker.estimate.cameras[p]
        used = zip(theirs.names, theirs.parameters, strict=True)
        held = tuple(name for name, value in used if value == 0)
        try:  # with only the terms that are used there
            camera = convert_camera(ours, theirs.model, held=held).camera
        except (GeometryError, SurveyFileError):
            continue
        saved = _free_terms(ours) - _free_terms(camera)
        if saved > 0:
            model = f"{theirs.model} without {', '.join(held)}" if held else theirs.model
            leaner[model][ours.name] = camera
            prices[model] += price_of(saved, int((cameras_of == q).sum()))
    before = adjusted_with(other, {}) if leaner else None
    if before is None or not before.vPv > 0:
        return None
    own, _ = _sigma_px(before.solution)
    for model, replaced in leaner.items():
        after = adjusted_with(other, replaced)
        if after is None:
            continue
        loss = before.redundancy / 2 * float(np.log(after.vPv / before.vPv))
        fits, _ = _sigma_px(after.solution)
        if loss > prices[model] + MIN_LEAD and fits > own:
            return tuple(replaced), model, fits, own
    return None


def _free_terms(camera: Camera) -> int:
    """Return the number of free parameters, where one or two focal lengths count as one."""
    focal = camera.plays(Role.FOCAL)
    return int(camera.free[~focal].sum()) + bool(camera.free[focal].any())
