"""Cross-validation of a camera: halves of the photographs are adjusted apart, and their cameras compared.

The halves share no image point, so the difference of their cameras has the sum of both covariances. Rays of
the whole calibration are projected with both cameras. A rotation is fitted to the differences and removed,
since a camera may turn in its mount without another image. What is left is compared with what the covariances
predict: whitened, its sum of squares is chi-square. Errors that image points have by chance give a ratio of 1
of difference and prediction. A camera that changed, an object that moved, or a model that does not fit the
lens give more, in the division of the photographs that shows it best.

Source: Kogan (2021), mrcal documentation, "Cross-validation" and "Model differencing"; Stone (1974), J. Royal
Stat. Soc. B 36; Foerstner, Wrobel (2016), sec. 4.6.4 (test of groups of parameters).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.quality.correlations import observed_part
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.model.arguments import checked_arguments
from sfm.model.camera import pixel_from_rays, rays_from_pixel
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.distributions import chi2_sf
from sfm.model.errors import GeometryError
from sfm.model.reduced_network import MIN_IMAGE_POINTS, reduce_network, select_supported
from sfm.products.calibration.projection import ProjectionUncertainty, grid_of

# Sigma of a mode of the difference, over that of the largest one, below which it moves no image point that
# matters: the difference is linear in the parameters to about this share only.
SMALLEST_MODE = 1e-3
MIN_HALF = 3  # photographs of a half; two determine no distortion that a third one checks


@dataclass(frozen=True)
class HalvesDifference:
    """Difference of a camera between two halves of its photographs, at n pixels that both halves cover."""

    camera: str
    division: str  # how the photographs are divided, in words
    photographs: tuple[int, int]  # of the camera in each half
    xy: FloatArray  # pixels, px, (n, 2)
    difference: FloatArray  # first minus second camera after the rotation, px, (n, 2)
    sigma: FloatArray  # its predicted standard deviation, RMS of both coordinates, px, (n,)
    chi2: float  # whitened sum of squares
    dof: int  # number of modes in which the cameras can differ
    probability: float  # of such a difference by chance

    @property
    def ratio(self) -> float:
        """Difference over its prediction, RMS of all modes; about 1 if nothing but chance differs."""
        return float(np.sqrt(self.chi2 / self.dof))

    @property
    def rms_px(self) -> float:
        """Difference, RMS per coordinate over the pixels, px."""
        return float(np.sqrt((self.difference**2).mean()))

    @property
    def expected_px(self) -> float:
        """Predicted difference, RMS per coordinate over the pixels, px."""
        return float(np.sqrt((self.sigma**2).mean()))

    @property
    def largest_px(self) -> float:
        """Largest difference, px."""
        return float(np.linalg.norm(self.difference, axis=1).max())


@dataclass(frozen=True)
class CrossValidation:
    """Differences of all cameras in all divisions of the photographs."""

    differences: tuple[HalvesDifference, ...]
    untested: tuple[tuple[str, str], ...]  # division, and why it has no difference

    def of_camera(self, camera: str) -> tuple[HalvesDifference, ...]:
        """Return the differences of a camera, given by name."""
        return tuple(difference for difference in self.differences if difference.camera == camera)

    def clearest(self, camera: str) -> HalvesDifference | None:
        """Return the difference of a camera that chance explains least; None without any.

        Of several whose probability is too small for a number, the largest over its prediction.
        """
        return min(
            self.of_camera(camera), key=lambda halves: (halves.probability, -halves.ratio), default=None
        )


@checked_arguments()
def cross_validate(adjustment: Adjustment) -> CrossValidation:
    """Return the differences of the cameras of an adjustment between halves of its photographs.

    Photographs of one moment of a rig stay together. A division without a difference says why.

    Args:
        adjustment: finished, with its covariance. Rejected image points take no part.

    Example:
        >>> from sfm.products.calibration import cross_validate
        >>> {halves.division for halves in cross_validate(result.adjustment).differences} >= {
        ...     "near and far photographs"
        ... }
        True
    """
    differences: list[HalvesDifference] = []
    untested: list[tuple[str, str]] = []
    for division, first in _divisions(adjustment):
        try:
            halves = _adjust_half(adjustment, first), _adjust_half(adjustment, ~first)
        except (GeometryError, np.linalg.LinAlgError) as error:
            untested.append((division, str(error)))
            continue
        for k, camera in enumerate(adjustment.estimate.cameras):
            if camera.free.any() and all((half.network.camera == k).any() for half in halves):
                try:
                    differences.append(_difference(adjustment, k, division, halves))
                except GeometryError as error:
                    untested.append((division, str(error)))
    return CrossValidation(tuple(differences), tuple(untested))


def _divisions(adjustment: Adjustment) -> Iterator[tuple[str, BoolArray]]:
    """Yield the divisions of the photographs: their name, and the first half, (m,)."""
    network, estimate = adjustment.network, adjustment.estimate
    m = len(network.images)
    seen = network.image_points.select(~adjustment.rejected)
    away = np.linalg.norm(estimate.points[seen.point] - estimate.position[seen.image], axis=1)
    count = np.bincount(seen.image, minlength=m)
    distance = np.bincount(seen.image, away, minlength=m) / np.maximum(count, 1)
    middle = np.array([camera.frame[:2] for camera in estimate.cameras])[network.camera[seen.image]]
    off = np.linalg.norm(seen.xy - middle, axis=1)
    radius = np.bincount(seen.image, off, minlength=m) / np.maximum(count, 1)
    together = np.arange(m) if network.moment is None else network.moment
    _, group = np.unique(together, return_inverse=True)
    members = np.bincount(group)
    # without rigs, each camera is divided by itself
    family = np.full(m, -1) if (members > 1).any() else network.camera
    order = np.bincount(group, np.arange(m)) / members
    far = np.bincount(group, distance) / members
    outer = np.bincount(group, radius) / members
    for division, key, alternate in (
        ("every other photograph", order, True),
        ("first and last photographs", order, False),
        ("near and far photographs", far, False),
        ("photographs of the middle and of the margins", outer, False),
    ):
        first = np.zeros(m, dtype=bool)
        for name in np.unique(family):
            groups = np.unique(group[family == name])
            ranked = groups[np.argsort(key[groups], kind="stable")]
            half = ranked[::2] if alternate else ranked[: (len(ranked) + 1) // 2]
            first |= np.isin(group, half)
        yield division, first


def _adjust_half(adjustment: Adjustment, half: BoolArray) -> Adjustment:
    """Return the adjustment of half of the photographs with the same free parameters and datum.

    Raises:
        GeometryError: the half has too few photographs of a camera, or does not determine it.
    """
    network, estimate = adjustment.network, adjustment.estimate
    control = adjustment.datum == "control"
    known = np.zeros(len(network.points), dtype=bool)
    if control:
        known[network.control.point] = True
    used = ~adjustment.rejected & half[network.image_points.image]
    images, points = select_supported(
        network, estimate, used, min_points=MIN_IMAGE_POINTS, min_rays=np.where(known, 1, 2)
    )
    images &= half
    measured = set(network.camera[network.image_points.image[~adjustment.rejected]].tolist())
    for k, camera in enumerate(estimate.cameras):
        taken = int((network.camera[images] == k).sum())
        if camera.free.any() and taken < MIN_HALF and k in measured:
            raise GeometryError(
                f"camera {camera.name}: half of its photographs are {taken}, needed {MIN_HALF}"
            )
    part, start = reduce_network(network, estimate, images, points, used)
    kept = used & images[network.image_points.image] & points[network.image_points.point]
    return adjust(
        part,
        start,
        datum=Datum("control" if control else "free"),
        reject="none",
        options=AdjustmentOptions(
            image_sigma_factor=adjustment.image_sigma_factor[kept], redundancy_numbers=False
        ),
    )


def _difference(
    adjustment: Adjustment, k: int, division: str, halves: tuple[Adjustment, Adjustment]
) -> HalvesDifference:
    """Return the difference of a camera between two halves.

    Raises:
        GeometryError: a half does not determine the camera, or both cover no part of the format.
    """
    camera = adjustment.estimate.cameras[k]
    covariances = [half.covariance.interior[k] for half in halves]
    if not all(half.converged and np.isfinite(Q).all() for half, Q in zip(halves, covariances, strict=True)):
        raise GeometryError(f"camera {camera.name}: half of its photographs do not determine it")
    xy = np.stack(np.meshgrid(*grid_of(camera)), axis=-1).reshape(-1, 2)
    photographs: list[int] = []
    for half in halves:
        of_camera = half.network.camera == k
        photographs.append(int(of_camera.sum()))
        seen = half.network.image_points
        xy = xy[observed_part(seen.xy[of_camera[seen.image]], xy)[1]]
    rays = rays_from_pixel(camera, xy)
    first, second = (pixel_from_rays(half.estimate.cameras[k], rays) for half in halves)
    known = np.isfinite(np.column_stack([rays, first, second])).all(axis=1)
    if known.sum() < 3:
        raise GeometryError(
            f"camera {camera.name}: both halves of its photographs cover no part of the format"
        )
    # effects of small rotations, (2n, 3), and of the free parameters, (2n, f), on pixels
    free: IntArray = np.flatnonzero(camera.free)
    by_unknown = ProjectionUncertainty(camera, free, np.zeros((0, 0))).derivatives(xy[known], np.inf)
    turn, by_parameters = by_unknown[:, :, 3:6].reshape(-1, 3), by_unknown[:, :, 6:].reshape(-1, len(free))
    shift = (first - second)[known].ravel()
    both = np.column_stack([shift, by_parameters])
    rest = both - turn @ np.linalg.lstsq(turn, both, rcond=None)[0]
    difference, J = rest[:, 0], rest[:, 1:]
    covariance = sum(covariances, np.zeros_like(covariances[0]))
    # of correlations, with 0 for parameters without variance
    sigma = np.sqrt(np.diagonal(covariance))
    sigma = np.where(sigma > 0, sigma, 1.0)
    correlations = covariance / np.outer(sigma, sigma)
    values, vectors = np.linalg.eigh(correlations)
    root = np.sqrt(np.diagonal(covariance))[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    modes, sizes, _ = np.linalg.svd(J @ root, full_matrices=False)
    clear = sizes > SMALLEST_MODE * sizes[0]
    chi2 = float(((modes[:, clear].T @ difference / sizes[clear]) ** 2).sum())
    dof = int(clear.sum())
    variance = ((J @ root) ** 2).sum(axis=1).reshape(-1, 2)
    return HalvesDifference(
        camera.name,
        division,
        (photographs[0], photographs[1]),
        xy[known],
        difference.reshape(-1, 2),
        np.sqrt(variance.mean(axis=1)),
        chi2,
        dof,
        float(chi2_sf(chi2, dof)),
    )
