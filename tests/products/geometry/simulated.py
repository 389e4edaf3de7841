"""Shapes with points on them, and residuals of which the best fit is known exactly."""

from __future__ import annotations

import numpy as np

from sfm.model.conventions import FloatArray, rotation_from_vector
from sfm.model.similarity import similarity_motions
from sfm.products.geometry.shapes.kinds import KINDS, Shape

FORMS = {
    "line": (),
    "plane": (),
    "circle": (1.3,),
    "ellipse": (1.5, 0.9),
    "sphere": (1.2,),
    "cylinder": (0.8,),
    "cone": (1.0, 0.4),
    "torus": (1.5, 0.5),
    "paraboloid": (0.7,),
}


def simulated_shape(name: str, rng: np.random.Generator, *, size: float = 1000.0) -> Shape:
    """Return a shape of a size somewhere in space."""
    form = np.array(FORMS[name], dtype=float)
    shape = Shape(KINDS[name], rng.normal(size=3), rotation_from_vector(rng.normal(size=3)), form)
    return shape.scaled(size, np.zeros(3))


def points_on(shape: Shape, count: int, rng: np.random.Generator) -> FloatArray:
    """Return points all over a shape, (count, 3)."""
    name = shape.kind.name
    form = np.array(FORMS[name], dtype=float)
    size = 1000.0 if not len(form) else float(shape.form[0] / form[0])
    u, turn = rng.uniform(-1, 1, count), rng.uniform(0, 2 * np.pi, count)
    c, s, zero = np.cos(turn), np.sin(turn), np.zeros(count)
    if name == "line":
        y = np.stack([zero, zero, u], axis=1)
    elif name == "plane":
        y = np.stack([u, s, zero], axis=1)
    elif name in ("circle", "ellipse"):
        y = np.stack([form[0] * c, form[-1] * s, zero], axis=1)
    else:
        rho, z = {
            "sphere": lambda: (form[0] * np.sqrt(1 - u * u), form[0] * u),
            "cylinder": lambda: (np.full(count, form[0]), u),
            "cone": lambda: (form[0] + u * np.tan(form[1]), u),
            "torus": lambda: (form[0] + form[1] * np.cos(np.pi * u), form[1] * np.sin(np.pi * u)),
            "paraboloid": lambda: (1.2 * np.sqrt(np.abs(u)), 0.36 * np.abs(u) / form[0]),
        }[name]()
        y = np.stack([rho * c, rho * s, z], axis=1)
    return shape.origin + size * y @ shape.rotation.T


def design_of(shape: Shape, xyz: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return normals (n, c, 3) and derivatives by the shape's parameters, (n c, u)."""
    _, normals, A = shape.design(xyz)
    free = [*shape.kind.moves, *range(6, A.shape[2])]
    return normals, A[..., free].reshape(-1, len(free))


def in_null_space(J: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return random r with J' r = 0."""
    r = rng.normal(size=len(J))
    for _ in range(2):
        r -= J @ np.linalg.lstsq(J, r, rcond=None)[0]
    return r


def random_covariance(count: int, sigma: float, rng: np.random.Generator) -> FloatArray:
    """Return a covariance of points that are all correlated, (3 count, 3 count)."""
    L = rng.normal(size=(3 * count, 3 * count + 10))
    return sigma**2 * L @ L.T / L.shape[1]


def in_free_datum(covariance: FloatArray, xyz: FloatArray, motions: int = 6) -> FloatArray:
    """Return the covariance after the S-transformation to the inner constraints of all points."""
    G = similarity_motions(xyz, centre=xyz.mean(axis=0), size=1000.0).reshape(-1, 7)[:, :motions]
    S = np.eye(len(G)) - G @ np.linalg.solve(G.T @ G, G.T)
    return S @ covariance @ S.T
