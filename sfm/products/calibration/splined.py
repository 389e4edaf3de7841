"""A splined camera from the image points of another model, for a lens that no parametric model describes.

The distortion starts as that of the adjusted model, as a surface of B-splines over the stereographic plane of
rays. The image points change it. Without them the change d of the coefficients is normal with mean 0 and
covariance s^2 K, in which K is the correlation of places a cell of the grid apart. The image points choose s:
one adjustment with a wide s gives what they know of d, that is N d = n with their normal equations, and

    ln p(image points | s) = n' (N + K^-1 / s^2)^-1 n / 2 - ln det(I + s^2 K N) / 2

is largest for the chosen s. It is 0 for s = 0, which is the adjusted model. The sum of
s^2 K N (I + s^2 K N)^-1 over its diagonal is the number of coefficients that the image points determine.
Where there are none, the covariance is that before them. The gain of ln likelihood by the surface is, as of
other models, that of v'Pv, now with the change, minus ln det(I + s^2 K N) / 2. The image points choose the
grid too: finer ones follow as long as the gain grows.

Variances of image points are those of the adjustment with a wide s, sigma0^2 times the stated ones. An
observation of a coefficient therefore has s / sigma0: after the adjustment its variance is s^2.

Focal lengths and principal point keep their values: the surface has their effects too.

Source: MacKay (1992), Neural Computation 4(3), "Bayesian interpolation" (evidence, determined parameters);
Kogan (2021), mrcal documentation, "Splined stereographic lens model" (regularised splines).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.model.arguments import checked_arguments
from sfm.model.camera import (
    Camera,
    parameter_jacobian,
    pixel_from_rays,
    ray_jacobian,
    rays_from_pixel,
    within_reach,
)
from sfm.model.conventions import FloatArray
from sfm.model.distortion.models import MODELS, Role
from sfm.model.distortion.splined import KNOTS
from sfm.model.errors import GeometryError
from sfm.model.observations.control_and_bars import InteriorObservations

PLACES = 41  # along each side of the format, at which the surface is fitted to the adjusted model
CORRELATED_CELLS = 1.0  # of the grid, over which the correlation of the change falls to exp(-1/2)
# Standard deviations of the change at a node that are compared, px, by their logarithms: from a hundredth of
# the precision of targets to more than any lens departs from its model.
SMALLEST_PX, WIDEST_PX, STEPS = 1e-3, 10.0, 81
BARE = 1.0  # gain of ln likelihood that is not worth more than a bare mention: Kass and Raftery (1995)
MARGIN = 1.05  # range of the surface over that of the rays, which the adjustment moves
STRAIGHT = 1e-4  # weight of second differences over that of a place, where only they determine a coefficient


@dataclass(frozen=True)
class SplinedCalibration:
    """A camera with a surface of distortion, adjusted with all unknowns of its network."""

    camera: Camera
    adjustment: Adjustment  # with the camera in place of the parametric one
    sigma_px: float  # expected size of the change of the distortion, which the image points choose
    determined: float  # number of coefficients that the image points determine
    gain: float  # of ln likelihood by the surface over the parametric model
    knots: int  # coefficients along each axis of the grid, which the image points choose
    price: float  # of choosing size and grid

    @property
    def borne(self) -> bool:
        """Whether the photographs bear the surface."""
        return self.gain > self.price


@checked_arguments()
def spline_camera(adjustment: Adjustment, camera: int = 0) -> SplinedCalibration:
    """Return the splined camera that the image points of a camera of an adjustment determine.

    Args:
        adjustment: finished.
        camera: index of the camera.

    Raises:
        GeometryError: parameters of the camera differ between photographs, too little of its format has rays,
            or the network with the surface has no solution.

    Example:
        >>> from sfm.products.calibration import spline_camera
        >>> splined = spline_camera(result.adjustment)
        >>> splined.camera.model, splined.borne
        ('splined_7', False)
    """
    present = adjustment.estimate.cameras[camera]
    if any(present.shared):
        raise GeometryError(
            f"camera {present.name}: some of its parameters differ between photographs, and a splined camera "
            "has the same in all"
        )
    best: SplinedCalibration | None = None
    failed: list[GeometryError] = []
    for knots in KNOTS:
        try:
            finer = _with_knots(adjustment, camera, knots)
        except GeometryError as error:
            failed.append(error)
            continue
        if best is not None and finer.gain <= best.gain + BARE:
            break
        best = finer
    if best is None:
        raise failed[0]
    return best


def _with_knots(adjustment: Adjustment, k: int, knots: int) -> SplinedCalibration:
    """Return the splined camera with one grid, whose change the image points choose.

    Raises:
        GeometryError: too little of the format has rays, or the network has no solution.
    """
    network = adjustment.network
    seen = network.image_points.select(~adjustment.rejected)
    xy = seen.xy[network.camera[seen.image] == k]
    start = splined_like(adjustment.estimate.cameras[k], xy, knots)
    pixels = start.parameters[start.plays(Role.FOCAL)].mean()
    K = _correlation(knots)
    # sigma0 of the parametric model is too large, which only makes the prior narrower, and is removed again
    sigma = WIDEST_PX / (pixels * adjustment.sigma0)
    wide = _adjusted(adjustment, k, start, sigma, K)
    sigma0 = wide.sigma0
    d = wide.estimate.cameras[k].parameters[start.free] - start.parameters[start.free]
    known = np.linalg.inv(wide.covariance.interior[k])
    N = known - np.linalg.inv(K) / (sigma0 * sigma) ** 2
    sizes = np.geomspace(SMALLEST_PX, WIDEST_PX, STEPS)
    fit, price, determined = np.transpose([_evidence(N, known @ d, K, size / pixels) for size in sizes])
    best = int((fit - price).argmax())
    final = _adjusted(adjustment, k, start, sizes[best] / (pixels * sigma0), K)
    return SplinedCalibration(
        final.estimate.cameras[k],
        final,
        float(sizes[best]),
        float(determined[best]),
        final.redundancy / 2 * float(np.log(adjustment.vPv / final.vPv)) - float(price[best]),
        knots,
        float(np.log(STEPS * len(KNOTS) / adjustment.levels.family)),
    )


def splined_like(camera: Camera, seen: FloatArray, knots: int) -> Camera:
    """Return the splined camera with the distortion of another camera, its surface free.

    Args:
        camera: interior orientation.
        seen: its image points, px, (k, 2); see `within_reach`.
        knots: coefficients along each axis of the grid, one of KNOTS.

    Raises:
        GeometryError: too little of the format has rays.
    """
    width, height = camera.size_px
    x, y = np.linspace(-0.5, width - 0.5, PLACES), np.linspace(-0.5, height - 0.5, PLACES)
    xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    xy = np.vstack([xy[within_reach(camera, xy, seen)], seen[:: max(1, len(seen) // PLACES**2)]])
    rays = rays_from_pixel(camera, xy)
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    known = np.isfinite(rays).all(axis=1)
    xy, rays = xy[known], rays[known]
    if len(xy) < knots**2:
        raise GeometryError(
            f"camera {camera.name}: {len(xy)} places of its format have a ray, needed at least {knots**2} "
            "for a splined camera"
        )
    axis = np.array([[0.0, 0.0, -1.0]])
    middle = pixel_from_rays(camera, axis)
    J = ray_jacobian(camera, middle, axis)[0]
    reach = MARGIN * np.abs(2 * rays[:, :2] / (1 - rays[:, 2])[:, None]).max(axis=0)
    values = [abs(J[0, 0]), abs(J[1, 1]), *middle[0], *reach]
    model = f"splined_{knots}"
    names = MODELS[model].names
    p = np.concatenate([values, np.zeros(len(names) - len(values))])
    free = np.arange(len(names)) >= len(values)
    straight = Camera(camera.name, model, camera.size_px, camera.pixel_mm, p, free)
    # residuals are linear in the coefficients; where the format has no rays, the surface is straight
    A = parameter_jacobian(straight, rays)[:, :, free].reshape(-1, int(free.sum()))
    rest = (xy - pixel_from_rays(straight, rays)).ravel()
    # the second differences of a surface along both axes of its grid
    D, eye = np.diff(np.eye(knots), n=2, axis=0), np.eye(knots)
    smooth = STRAIGHT * values[0] * np.kron(np.eye(2), np.vstack([np.kron(eye, D), np.kron(D, eye)]))
    p[free] = np.linalg.solve(A.T @ A + smooth.T @ smooth, A.T @ rest)
    return straight.with_parameters(p)


def _correlation(knots: int) -> FloatArray:
    """Return the correlation of the changes of all coefficients of both surfaces, (f, f)."""
    away = np.subtract.outer(np.arange(knots), np.arange(knots)) / CORRELATED_CELLS
    along = np.exp(-(away**2) / 2)
    return np.asarray(np.kron(np.eye(2), np.kron(along, along)))


def _evidence(N: FloatArray, n: FloatArray, K: FloatArray, size: float) -> tuple[float, float, float]:
    """Return what ln likelihood gains and loses by a surface, and how many coefficients are determined.

    Args:
        N: normal equations of the coefficients by the image points, (f, f).
        n: N times the coefficients that fit the image points, (f,).
        K: correlation of the coefficients, (f, f).
        size: their standard deviation.
    """
    L = np.linalg.cholesky(K) * size
    values, vectors = np.linalg.eigh(L.T @ N @ L)
    values = np.maximum(values, 0.0)
    along = vectors.T @ (L.T @ n)
    gained = ((along**2) / (1.0 + values)).sum() / 2
    return float(gained), float(np.log1p(values).sum() / 2), float((values / (1.0 + values)).sum())


def _adjusted(
    adjustment: Adjustment, k: int, start: Camera, sigma: float, correlation: FloatArray
) -> Adjustment:
    """Return the adjustment with a splined camera, whose coefficients are expected where they start."""
    network, kept = adjustment.network, ~adjustment.rejected
    free = np.flatnonzero(start.free)
    before = network.interior.select(network.interior.camera != k)
    count = len(before)
    R = np.eye(count + len(free))
    R[:count, :count] = np.eye(count) if before.correlation is None else before.correlation
    R[count:, count:] = correlation
    interior = InteriorObservations(
        np.concatenate([before.camera, np.full(len(free), k)]),
        np.concatenate([before.parameter, free]),
        np.concatenate([before.value, start.parameters[free]]),
        np.concatenate([before.sigma, np.full(len(free), sigma)]),
        R,
    )
    cameras = list(adjustment.estimate.cameras)
    cameras[k] = start
    adjusted = adjust(
        replace(network, image_points=network.image_points.select(kept)).with_given(interior),
        replace(adjustment.estimate, cameras=tuple(cameras)),
        datum=Datum("control" if adjustment.datum == "control" else "free"),
        reject="none",
        options=AdjustmentOptions(image_sigma_factor=adjustment.image_sigma_factor[kept]),
    )
    if not adjusted.converged or not np.isfinite(adjusted.covariance.interior[k]).all():
        raise GeometryError(f"camera {start.name}: the network with a splined camera has no solution")
    return adjusted
