"""Motion and strain of groups of points: a block that tilted is separated from one that changed its shape.

The displacements of a group are d = t + omega x (X - c) + E (X - c), with a translation t of its centre c,
small rotations omega and the symmetric strain E, or the part of it that is asked for. Least squares with the
full covariance of the displacements, in the datum of the stable points outside of the group; what is left
shows whether the group moved as the model assumes.

Source: Chen (1983), Analysis of deformation surveys; Caspary (2000), Concepts of network and deformation
analysis, sec. 9; Welsch, Heunecke, Kuhlmann (2000), Auswertung geodaetischer Ueberwachungsmessungen, sec. 6.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from sfm.arguments import checked_arguments
from sfm.comparison.stable_points import critical_value, in_datum
from sfm.conventions import BoolArray, FloatArray
from sfm.display import counted
from sfm.epochs.displacements import Displacements
from sfm.errors import GeometryError
from sfm.similarity import similarity_motions

PARTS = (
    ("translation", ("tX", "tY", "tZ")),
    ("rotation", ("omega", "phi", "kappa")),
    ("scale", ("scale",)),
    ("shear", ("eXX-eYY", "eXX-eZZ", "eXY", "eXZ", "eYZ")),
)
MODELS = {"rigid": 2, "similarity": 3, "affine": 4}  # parts of PARTS that each has
MIN_POINTS = {"rigid": 3, "similarity": 3, "affine": 4}
RANK = 1e-9  # of the largest singular value below which a group does not determine a model


@dataclass(frozen=True)
class Part:
    """A translation, rotation, scale or shear, and its test."""

    name: str
    statistic: float  # over its degrees of freedom
    critical: float

    @property
    def significant(self) -> bool:
        """Whether it is more than chance."""
        return self.statistic > self.critical


@dataclass(frozen=True)
class BlockMotion:
    """How a group of points moved."""

    name: str
    points: tuple[str, ...]
    model: str  # rigid | similarity | affine
    centre: FloatArray  # to which the translation belongs, object unit, (3,)
    parameters: tuple[str, ...]  # names, p of them
    value: FloatArray  # object unit, rad and ratios, (p,)
    sigma: FloatArray  # (p,)
    parts: tuple[Part, ...]
    statistic: float  # of what is left over its degrees of freedom; NaN without any
    critical: float

    @property
    def fits(self) -> bool:
        """Whether the points moved as the model assumes."""
        return not self.statistic > self.critical

    @property
    def moved(self) -> bool:
        """Whether the group as a whole moved."""
        return any(part.significant for part in self.parts)


@checked_arguments()
def block_motion(
    found: Displacements, group: BoolArray, *, name: str, model: str = "rigid", alpha: float | None = None
) -> BlockMotion:
    """Fit the motion of a group of points to their displacements.

    Args:
        found: displacements of two epochs.
        group: the points, (n,).
        name: of the group.
        model: rigid (translation and rotation), similarity (scale, too) or affine (shear, too).
        alpha: level of each test; that of the displacements if not given.

    Raises:
        GeometryError: too few points, on a line or in a plane where the model needs more, or all stable
            points among them.
    """
    if model not in MODELS:
        raise GeometryError(f"group {name}: model '{model}', expected one of {', '.join(MODELS)}")
    chosen = np.flatnonzero(group)
    if len(chosen) < MIN_POINTS[model]:
        raise GeometryError(
            f"group {name}: {counted(len(chosen), 'point')}, a {model} motion needs "
            f"{MIN_POINTS[model]} or more"
        )
    d, Q, G = found.differences.difference, found.differences.covariance, found.differences.motions
    outside = found.stable & ~group
    if np.linalg.matrix_rank(G[np.repeat(outside, 3)], tol=RANK * np.linalg.norm(G, 2)) < G.shape[1]:
        raise GeometryError(
            f"group {name}: {counted(int(outside.sum()), 'stable point')} outside of it, too few or "
            "on a line: "
            "nothing is left against which it could move"
        )
    d, Q = in_datum(d, Q, G, outside.astype(float))
    alpha = found.alpha if alpha is None else alpha
    parts = PARTS[: MODELS[model]]
    x = found.differences.xyz[chosen]
    centre = x.mean(axis=0)
    A = _columns(x, centre, MODELS[model])
    spread = np.linalg.svd(A / np.maximum(np.linalg.norm(A, axis=0), 1e-300), compute_uv=False)
    if spread[-1] < RANK * spread[0]:
        raise GeometryError(
            f"group {name}: its points lie on a line or in a plane, which does not determine a {model} motion"
        )
    rows = (3 * chosen[:, None] + np.arange(3)).ravel()
    d = d[chosen].ravel()
    factor = cho_factor(Q[np.ix_(rows, rows)], lower=True)
    PA = cho_solve(factor, A)
    cofactor = np.linalg.inv(A.T @ PA)
    value = cofactor @ (PA.T @ d)
    v = d - A @ value
    freedom = len(d) - len(value)
    redundancy = found.differences.redundancy
    names = tuple(name for _, group_of in parts for name in group_of)
    tests, at = [], 0
    for part, members in parts:
        block = slice(at, at + len(members))
        statistic = float(value[block] @ np.linalg.solve(cofactor[block, block], value[block])) / len(members)
        tests.append(Part(part, statistic, critical_value(alpha, len(members), redundancy)))
        at += len(members)
    return BlockMotion(
        name=name,
        points=tuple(found.differences.points[j] for j in chosen),
        model=model,
        centre=centre,
        parameters=names,
        value=value,
        sigma=np.sqrt(np.diagonal(cofactor)),
        parts=tuple(tests),
        statistic=float(v @ cho_solve(factor, v)) / freedom if freedom else float("nan"),
        critical=critical_value(alpha, freedom, redundancy) if freedom else float("nan"),
    )


def _columns(xyz: FloatArray, centre: FloatArray, parts: int) -> FloatArray:
    """Return how the points move with each parameter, (3 k, p)."""
    motion = similarity_motions(xyz, centre=centre)
    columns = [motion[:, :, : (0, 3, 6, 7, 7)[parts]]]
    if parts == MODELS["affine"]:
        x, y, z = (xyz - centre).T
        o = np.zeros_like(x)
        shear = [(x, -y, o), (x, o, -z), (y, x, o), (z, o, x), (o, z, y)]
        columns.append(np.stack([np.stack(one, axis=1) for one in shear], axis=2))
    A = np.concatenate(columns, axis=2)
    return A.reshape(-1, A.shape[2])
