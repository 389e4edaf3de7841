"""A splined camera from the image points of another model, for a lens that no parametric model describes.

The distortion starts as that of the adjusted model, as a surface of B-splines over the stereographic plane of
rays. The image points change it. Without them the change of the coefficients is B p + d: p are changes of
the parameters of the model, which are free, and d is normal with mean 0 and covariance s^2 K, in which K is
the correlation of places a cell of the grid apart. A model that is adjusted where there are image points
therefore says no more elsewhere than its parameters are known beside d. The image points choose s: one
adjustment with a wide s gives what they know of the coefficients, that is N (B p + d) = n with their normal
equations. Without p these are N d = n, and

    ln p(image points | s) = n' (N + K^-1 / s^2)^-1 n / 2 - ln det(I + s^2 K N) / 2

is largest for the chosen s. It is 0 for s = 0, which is the adjusted model. The sum of
s^2 K N (I + s^2 K N)^-1 over its diagonal is the number of coefficients that the image points determine.
Where there are none, the covariance is that before them, with that of the parameters. The gain of ln
likelihood by the surface is, as of other models, that of v'Pv, now with the change, minus
ln det(I + s^2 K N) / 2. The image points choose the grid too: finer ones follow as long as the gain grows, or
stays where they bear a surface. What a grid is too coarse for is in no covariance.

Variances of image points are those of the adjustment with a wide s, sigma0^2 times the stated ones. An
observation of a coefficient therefore has s / sigma0: after the adjustment its variance is s^2.

Focal lengths and principal point keep their values: the surface has their effects too.

Source: Cressie (1993), Statistics for Spatial Data, sec. 3.4 (universal kriging: a trend with unknown
parameters beside a correlated field); MacKay (1992), Neural Computation 4(3), "Bayesian interpolation"
(evidence, determined parameters); Kogan (2021), mrcal documentation, "Splined stereographic lens model"
(regularised splines).
"""

from __future__ import annotations

import math
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
from sfm.model.estimate import Estimate
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
        if best is not None and (
            finer.gain <= best.gain + (-BARE if best.borne else BARE) or (best.borne and not finer.borne)
        ):
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
    present, given = adjustment.estimate.cameras[k], network.interior
    stated = np.isin(np.arange(len(present.names)), given.parameter[given.camera == k])
    B = _changes(present, start, xy, np.where(stated, adjustment.interior_sigma(k), np.inf))
    # sigma0 of the parametric model is too large, which only makes the prior narrower, and is removed again
    sigma = WIDEST_PX / (pixels * adjustment.sigma0)
    cameras = list(adjustment.estimate.cameras)
    cameras[k] = start
    begin = replace(adjustment.estimate, cameras=tuple(cameras))
    wide = _adjusted(adjustment, k, start, sigma**2 * K, begin)
    sigma0 = wide.sigma0
    d = wide.estimate.cameras[k].parameters[start.free] - start.parameters[start.free]
    known = np.linalg.inv(wide.covariance.interior[k])
    N = known - np.linalg.inv(K) / (sigma0 * sigma) ** 2
    # what the image points know of the coefficients beside any parameters of the model
    n, NB = known @ d, N @ B
    of_model = np.linalg.solve(B.T @ NB + np.eye(B.shape[1]), NB.T)
    sizes = np.geomspace(SMALLEST_PX, WIDEST_PX, STEPS)
    fit, price, determined = _evidence(N - NB @ of_model, n - of_model.T @ (B.T @ n), K, sizes / pixels)
    best = int((fit - price).argmax())
    expected = ((sizes[best] / pixels) ** 2 * K + B @ B.T) / sigma0**2
    final = _adjusted(adjustment, k, start, expected, wide.estimate)
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
    xy, rays = _places(camera, seen)
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
    p[free] = _surface(straight, rays, (xy - pixel_from_rays(straight, rays)).reshape(-1, 1))[:, 0]
    return straight.with_parameters(p)


def _places(camera: Camera, seen: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return places over the format, px, (k, 2), and the directions of their rays, (k, 3)."""
    width, height = camera.size_px
    x, y = np.linspace(-0.5, width - 0.5, PLACES), np.linspace(-0.5, height - 0.5, PLACES)
    xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    xy = np.vstack([xy[within_reach(camera, xy, seen)], seen[:: max(1, len(seen) // PLACES**2)]])
    rays = rays_from_pixel(camera, xy)
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    known = np.isfinite(rays).all(axis=1)
    return xy[known], rays[known]


def _changes(camera: Camera, start: Camera, seen: FloatArray, largest: FloatArray) -> FloatArray:
    """Return the changes of a surface that the free parameters of a parametric camera make, (f, q).

    Each is as large as its parameter makes it that shifts the image by WIDEST_PX over the format, RMS.

    Args:
        camera: adjusted.
        start: the splined camera.
        seen: image points, px, (k, 2).
        largest: change of each parameter that is not exceeded, infinite where nothing states it, (p,).
    """
    _, rays = _places(camera, seen)
    shifts = parameter_jacobian(camera, rays)[:, :, camera.free].reshape(2 * len(rays), -1)
    shifts *= np.minimum(WIDEST_PX / np.sqrt(2 * (shifts**2).mean(axis=0)), largest[camera.free])
    return _surface(start, rays, shifts)


def _surface(splined: Camera, rays: FloatArray, shifts: FloatArray) -> FloatArray:
    """Return the coefficients whose surface shifts image points most nearly as given, (f, s).

    Args:
        splined: camera with a surface; the image points are linear in its coefficients.
        rays: where shifts are given, camera frame, (k, 3). Where no rays are, the surface is straight.
        shifts: of both coordinates of each, px, (2 k, s).
    """
    free, knots = splined.free, math.isqrt(int(splined.free.sum()) // 2)
    A = parameter_jacobian(splined, rays)[:, :, free].reshape(-1, int(free.sum()))
    # the second differences of a surface along both axes of its grid
    D, eye = np.diff(np.eye(knots), n=2, axis=0), np.eye(knots)
    smooth = np.kron(np.eye(2), np.vstack([np.kron(eye, D), np.kron(D, eye)]))
    smooth *= STRAIGHT * splined.parameters[splined.plays(Role.FOCAL)][0]
    return np.asarray(np.linalg.solve(A.T @ A + smooth.T @ smooth, A.T @ shifts))


def _correlation(knots: int) -> FloatArray:
    """Return the correlation of the changes of all coefficients of both surfaces, (f, f)."""
    away = np.subtract.outer(np.arange(knots), np.arange(knots)) / CORRELATED_CELLS
    along = np.exp(-(away**2) / 2)
    return np.asarray(np.kron(np.eye(2), np.kron(along, along)))


def _evidence(
    N: FloatArray, n: FloatArray, K: FloatArray, sizes: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return what ln likelihood gains and loses by surfaces, and how many coefficients are determined, (s,).

    Args:
        N: normal equations of the coefficients by the image points, (f, f).
        n: N times the coefficients that fit the image points, (f,).
        K: correlation of the coefficients, (f, f).
        sizes: their standard deviations, (s,).
    """
    L = np.linalg.cholesky(K)
    values, vectors = np.linalg.eigh(L.T @ N @ L)
    along = (vectors.T @ (L.T @ n)) ** 2
    values = sizes[:, None] ** 2 * np.maximum(values, 0.0)
    gained = sizes**2 * (along / (1.0 + values)).sum(axis=1) / 2
    return gained, np.log1p(values).sum(axis=1) / 2, (values / (1.0 + values)).sum(axis=1)


def _adjusted(
    adjustment: Adjustment, k: int, start: Camera, expected: FloatArray, begin: Estimate
) -> Adjustment:
    """Return the adjustment with a splined camera, whose coefficients are expected where they start.

    Args:
        adjustment: with the parametric camera.
        k: index of the camera.
        start: the splined camera.
        expected: covariance of its coefficients before the adjustment, (f, f).
        begin: estimate with which the iterations begin.

    Raises:
        GeometryError: the network has no solution.
    """
    sigma = np.sqrt(np.diagonal(expected))
    network, kept = adjustment.network, ~adjustment.rejected
    free = np.flatnonzero(start.free)
    before = network.interior.select(network.interior.camera != k)
    count = len(before)
    R = np.eye(count + len(free))
    R[:count, :count] = np.eye(count) if before.correlation is None else before.correlation
    R[count:, count:] = expected / np.outer(sigma, sigma)
    interior = InteriorObservations(
        np.concatenate([before.camera, np.full(len(free), k)]),
        np.concatenate([before.parameter, free]),
        np.concatenate([before.value, start.parameters[free]]),
        np.concatenate([before.sigma, sigma]),
        R,
    )
    adjusted = adjust(
        replace(network, image_points=network.image_points.select(kept)).with_given(interior),
        begin,
        datum=Datum("control" if adjustment.datum == "control" else "free"),
        reject="none",
        options=AdjustmentOptions(image_sigma_factor=adjustment.image_sigma_factor[kept]),
    )
    if not adjusted.converged or not np.isfinite(adjusted.covariance.interior[k]).all():
        raise GeometryError(f"camera {start.name}: the network with a splined camera has no solution")
    return adjusted
