"""Transformations from object coordinates of a plane to the pixels of one photograph.

A photograph of a plane without distortion is a projective image of it (eight parameters). An affine
transformation is enough for scans and for parallel planes; polynomials follow distortion or relief roughly,
and nothing else between the points. The transformations lead from the object to the photograph, since there
are the errors of measurement, and since each new pixel needs its place in the photograph.

Source: document 002, sec. II.1.1.3 and II.1.1.4 (georeferencing, geometric transformation); Kraus (2007),
sec. 2.1.3 and 3.2.1; Foerstner and Wrobel (2016), sec. 10.6.3 (homography by Gauss-Newton).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sfm.model.arguments import checked_arguments
from sfm.model.conventions import FloatArray
from sfm.model.display import counted
from sfm.model.errors import GeometryError

MAX_STEPS = 50
LAST_STEP = 1e-12  # of the parameters of normalised coordinates, at which an adjustment ends
MIN_SPREAD = 1e-6  # smallest singular value over the largest of points that are not on a line


@dataclass(frozen=True)
class PlaneTransformation:
    """A transformation from the object to the photograph, with its precision from the control points."""

    model: str  # a key of MODELS
    parameters: FloatArray  # of normalised coordinates, (u,)
    to_unit: tuple[FloatArray, float]  # centre (2,) and extent of the control, object unit
    from_unit: tuple[FloatArray, float]  # centre (2,) and extent of their image points, px
    residuals: FloatArray  # v = computed - measured, px, (n, 2)
    sigma0: float  # a posteriori standard deviation of an image coordinate, px; NaN without redundancy
    redundancy: int
    predicted: FloatArray  # v of each point from the others, px; NaN where these are too few, (n, 2)

    @property
    def predicted_rms(self) -> float:
        """RMS of an image coordinate of a point that takes no part, px; NaN if the points are too few."""
        return float(np.sqrt(np.mean(self.predicted**2)))

    def apply(self, xy: FloatArray) -> FloatArray:
        """Return the pixels of object coordinates, NaN beyond the horizon of a projection, shape (..., 2)."""
        unit = (np.asarray(xy, dtype=float) - self.to_unit[0]) / self.to_unit[1]
        return np.asarray(
            MODELS[self.model].image(self.parameters, unit) * self.from_unit[1] + self.from_unit[0]
        )

    def pixel_size(self, xy: FloatArray) -> FloatArray:
        """Return the side of a pixel at places, by the area that it covers, object unit, (n,)."""
        return np.asarray(1 / np.sqrt(np.abs(self._determinant(xy))))

    def is_mirrored(self, xy: FloatArray) -> bool:
        """Return whether the plane is seen from behind at places, (n, 2): rows count downwards, Y upwards."""
        return bool(np.median(self._determinant(xy)) > 0)

    def _determinant(self, xy: FloatArray) -> FloatArray:
        """Return the determinant of the derivatives at places, px^2 per square of the object unit, (n,)."""
        step = 1e-4 * self.to_unit[1]
        at = np.asarray(xy, dtype=float)
        J = np.stack(
            [(self.apply(at + e) - self.apply(at - e)) / (2 * step) for e in step * np.eye(2)], axis=-1
        )
        return np.asarray(np.linalg.det(J))


@dataclass(frozen=True)
class PlaneModel:
    """A kind of transformation."""

    unknowns: int
    image: Callable[[FloatArray, FloatArray], FloatArray]  # of parameters and points, (n, 2)
    design: Callable[[FloatArray, FloatArray], FloatArray]  # its derivatives by the parameters, (n, 2, u)
    start: Callable[[FloatArray, FloatArray], FloatArray]  # parameters from points and image points


def _terms(xy: FloatArray, degree: int) -> FloatArray:
    """Return the products of powers of x and y up to a degree, (..., k)."""
    x, y = xy[..., 0], xy[..., 1]
    return np.stack([x ** (d - j) * y**j for d in range(degree + 1) for j in range(d + 1)], axis=-1)


def _polynomial(degree: int) -> PlaneModel:
    k = (degree + 1) * (degree + 2) // 2

    def design(_: FloatArray, xy: FloatArray) -> FloatArray:
        terms = _terms(xy, degree)
        A = np.zeros((*terms.shape[:-1], 2, 2 * k))
        A[..., 0, :k], A[..., 1, k:] = terms, terms
        return A

    def image(p: FloatArray, xy: FloatArray) -> FloatArray:
        return np.asarray(_terms(xy, degree) @ p.reshape(2, k).T)

    return PlaneModel(2 * k, image, design, lambda xy, _: np.zeros(2 * k))


def _projected(p: FloatArray, xy: FloatArray) -> FloatArray:
    """Return (a X + b Y + c, d X + e Y + f) / (g X + h Y + 1), NaN where the denominator is not positive."""
    over = xy @ p[6:] + 1.0
    over = np.where(over > 0, over, np.nan)[..., None]
    return np.asarray((xy @ p[:6].reshape(2, 3)[:, :2].T + p[[2, 5]]) / over)


def _projective_design(p: FloatArray, xy: FloatArray) -> FloatArray:
    uv, over = _projected(p, xy), (xy @ p[6:] + 1.0)[..., None]
    A = np.zeros((*xy.shape[:-1], 2, 8))
    row = np.concatenate([xy, np.ones_like(over)], axis=-1) / over
    A[..., 0, :3], A[..., 1, 3:6] = row, row
    A[..., 6:] = -uv[..., :, None] * (xy / over)[..., None, :]
    return A


def _projective_start(xy: FloatArray, uv: FloatArray) -> FloatArray:
    """Return parameters by the linear equations of the projection."""
    A = np.zeros((len(xy), 2, 8))
    A[:, 0, :3] = A[:, 1, 3:6] = np.column_stack([xy, np.ones(len(xy))])
    A[:, :, 6:] = -uv[:, :, None] * xy[:, None, :]
    return np.asarray(np.linalg.lstsq(A.reshape(-1, 8), uv.ravel(), rcond=None)[0])


MODELS = {
    "affine": _polynomial(1),
    "projective": PlaneModel(8, _projected, _projective_design, _projective_start),
    "polynomial2": _polynomial(2),
    "polynomial3": _polynomial(3),
}


@checked_arguments(xy="n 2", pixel="n 2")
def fit_plane(xy: FloatArray, pixel: FloatArray, *, model: str = "projective") -> PlaneTransformation:
    """Return the transformation from object coordinates of a plane to pixels, by least squares.

    Args:
        xy: control points in the plane, shape (n, 2), object unit.
        pixel: their image points, shape (n, 2), px.
        model: affine (6 parameters), projective (8), polynomial2 (12) or polynomial3 (20).

    Raises:
        GeometryError: the model is unknown, the points are too few, or they do not determine it.
    """
    if model not in MODELS:
        raise GeometryError(f"georeferencing: model '{model}', expected one of {', '.join(MODELS)}")
    needed = MODELS[model].unknowns // 2
    if len(xy) < needed:
        raise GeometryError(
            f"georeferencing: {counted(len(xy), 'control point')}, {model} needs at least {needed}"
        )
    fit = _fit(np.asarray(xy, dtype=float), np.asarray(pixel, dtype=float), model)
    predicted = np.full((len(xy), 2), np.nan)
    if len(xy) > needed:
        for k in range(len(xy)):
            rest = np.arange(len(xy)) != k
            try:
                of_rest = _fit(xy[rest], pixel[rest], model)
            except GeometryError:
                continue  # the others do not determine it
            predicted[k] = of_rest.apply(xy[k]) - pixel[k]
    return PlaneTransformation(**{**fit.__dict__, "predicted": predicted})


def _fit(xy: FloatArray, pixel: FloatArray, name: str) -> PlaneTransformation:
    model, n = MODELS[name], len(xy)
    to_unit, from_unit = ((of.mean(axis=0), float(np.ptp(of, axis=0).max()) / 2) for of in (xy, pixel))
    spread = np.linalg.svd(xy - to_unit[0], compute_uv=False)
    if not (from_unit[1] > 0 and spread[1] > MIN_SPREAD * spread[0]):
        raise GeometryError("georeferencing: the control points coincide or lie on one line")
    unit, target = (xy - to_unit[0]) / to_unit[1], (pixel - from_unit[0]) / from_unit[1]
    p = model.start(unit, target)
    for _ in range(MAX_STEPS):
        A = model.design(p, unit).reshape(2 * n, -1)
        v = (target - model.image(p, unit)).ravel()
        if not np.isfinite(A).all() or np.linalg.matrix_rank(A) < model.unknowns:
            raise GeometryError(f"georeferencing: the control points do not determine {name}")
        step = np.linalg.lstsq(A, v, rcond=None)[0]
        p = p + step
        if np.abs(step).max() <= LAST_STEP * max(1.0, np.abs(p).max()):
            break
    residuals = (model.image(p, unit) - target) * from_unit[1]
    if not np.isfinite(residuals).all():
        raise GeometryError(f"georeferencing: control points beyond the horizon of the {name} transformation")
    redundancy = 2 * n - model.unknowns
    sigma0 = float(np.sqrt((residuals**2).sum() / redundancy)) if redundancy else np.nan
    return PlaneTransformation(
        name, p, to_unit, from_unit, residuals, sigma0, redundancy, np.full((n, 2), np.nan)
    )
