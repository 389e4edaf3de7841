"""Shapes that most of the points agree on: least median of squares, then Tukey's biweight.

Source: Rousseeuw and Leroy (1987), Robust Regression and Outlier Detection, ch. 5; Beaton and Tukey (1974),
Technometrics 16(2).
"""

from __future__ import annotations

import numpy as np

from sfm.conventions import MAD_TO_SIGMA, BoolArray, FloatArray
from sfm.display import counted
from sfm.errors import GeometryError
from sfm.geometry.shapes.kinds import Kind
from sfm.geometry.shapes.orthogonal import refine_orthogonal
from sfm.geometry.shapes.shape import Shape
from sfm.geometry.shapes.start import start_shapes

TRIALS = 30  # of few points: with 20 % of outliers 99 % find some without one, of a torus too
TRIAL_DIRECTIONS = 40  # of an axis that are tried for each
MORE_POINTS = 1  # than a shape needs, of each trial
TRIAL_STEPS = 15
TUKEY = 4.685  # standard deviations beyond which a point has no weight; 95 % efficient
ROUNDS = 50
SEED = 20  # of the trials, so that a fit gives the same each time


def robust_shape(
    kind: Kind,
    xyz: FloatArray,
    *,
    free: BoolArray,
    offset: FloatArray,
    origin: FloatArray | None,
    axis: FloatArray | None,
    form: FloatArray,
    placed: bool,
) -> tuple[Shape, BoolArray]:
    """Return the shape that most of the points agree on, and which points those are.

    Args:
        kind: of the shape.
        xyz: points about their centroid, of unit size, (n, 3).
        free: which of the six motions and the form are adjusted, (6 + q,).
        offset: signed distances that the points shall have, (c,).
        origin: where it must lie, None if that is free.
        axis: its direction, None if that is free.
        form: held form parameters, NaN of the free ones, (q,).
        placed: whether the origin may be anywhere along the axis.

    Raises:
        GeometryError: too few points to separate the good ones from the others.
    """
    n, size = len(xyz), kind.min_points + MORE_POINTS
    if n < size + 1:
        raise GeometryError(f"{counted(n, 'point')}, a robust fit of a {kind.name} needs {size + 1} or more")
    rng = np.random.default_rng(SEED)
    best, least = None, np.inf
    for trial in range(TRIALS + 1):
        rows = np.arange(n) if trial == 0 else rng.permutation(n)[:size]
        centre = xyz[rows].mean(axis=0)
        for start in start_shapes(
            kind,
            xyz[rows] - centre,
            origin=None if origin is None else origin - centre,
            axis=axis,
            directions=TRIAL_DIRECTIONS,
        )[:1]:
            shape = with_held(start.scaled(1.0, centre), origin, form)
            if not np.isfinite(shape.form).all():
                continue
            shape, _, _ = refine_orthogonal(
                shape, xyz[rows], free=free, offset=offset, placed=placed, iterations=TRIAL_STEPS
            )
            median = float(np.median(_lengths(shape, xyz, offset)))
            if median < least:
                best, least = shape, median
    if best is None:
        raise GeometryError(f"its points determine no {kind.name}")
    weight = np.ones(n)
    for _ in range(ROUNDS):
        length = _lengths(best, xyz, offset)
        sigma = max(robust_sigma(length, int(free.sum())), 1e-14)
        new = np.where(length < TUKEY * sigma, (1 - (length / (TUKEY * sigma)) ** 2) ** 2, 0.0)
        best, _, _ = refine_orthogonal(best, xyz, free=free, offset=offset, weight=new, placed=placed)
        if np.abs(new - weight).max() < 1e-6:
            break
        weight = new
    return best, weight > 0


def robust_sigma(length: FloatArray, parameters: int) -> float:
    """Return the standard deviation that most distances have, with Rousseeuw's factor for few of them."""
    return float(MAD_TO_SIGMA * (1 + 5 / max(len(length) - parameters, 1)) * np.median(length))


def with_held(shape: Shape, origin: FloatArray | None, form: FloatArray) -> Shape:
    """Return a shape with what is held of it in place."""
    return Shape(
        shape.kind,
        shape.origin if origin is None else origin,
        shape.rotation,
        np.where(np.isnan(form), shape.form, form),
    )


def _lengths(shape: Shape, xyz: FloatArray, offset: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(shape.distances(xyz) - offset, axis=1))
