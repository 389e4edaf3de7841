"""The five parameters of a relative orientation: dependent pair and independent pair.

Dependent: photograph 1 keeps its frame, photograph 2 gets by, bz (at a given bx) and omega, phi, kappa.
Independent: the base is the X axis of the model, photograph 1 gets phi1, kappa1 (omega1 = 0), photograph 2
omega2, phi2, kappa2; model coordinates are in units of the base.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sfm.arguments import checked_arguments
from sfm.conventions import FloatArray, angles_from_rotation, rotation_from_angles
from sfm.errors import GeometryError
from sfm.orientation.relative import UNKNOWNS, refine_coplanarity, relative_orientations, turned_pair

DIFFERENCE = 1e-6  # rad, of central differences: their error is some 1e-12 of the derivative
NO_BX = 1e-6  # of the base: below it by and bz cannot be counted at a given bx
FIVE_POINT_TOLERANCE = 0.01  # tangents: pairs that are farther off take no part in the five-point start
DEPENDENT = ("by", "bz", "omega", "phi", "kappa")
INDEPENDENT = ("phi1", "kappa1", "omega2", "phi2", "kappa2")


@dataclass(frozen=True)
class PairOrientation:
    """Five parameters of a pair by least squares on the coplanarity condition."""

    kind: str  # dependent | independent
    names: tuple[str, ...]  # of the five parameters, in order
    parameters: FloatArray  # by, bz in the unit of bx, angles in rad, (5,)
    covariance: FloatArray  # of the parameters; NaN without redundancy, (5, 5)
    positions: FloatArray  # both projection centres in the frame of the pair, (2, 3)
    rotations: FloatArray  # R of both photographs, image axes to the frame of the pair, (2, 3, 3)
    residuals: FloatArray  # distance of each pair of rays from coplanarity, tangents, (n,)
    sigma0: float  # a posteriori standard deviation of an image coordinate, tangents; NaN without redundancy
    redundancy: int  # n - 5


@checked_arguments(first="n 2", second="n 2", start="5")
def orient_dependent(
    first: FloatArray, second: FloatArray, *, bx: float = 1.0, start: FloatArray | None = None
) -> PairOrientation:
    """Return the dependent relative orientation: by, bz, omega, phi, kappa of photograph 2.

    Args:
        first: tangents u = -U/W, v = -V/W of rays of photograph 1, shape (n, 2), n >= 5.
        second: the conjugate rays of photograph 2, shape (n, 2).
        bx: X component of the base, which sets the scale of the model.
        start: approximate by, bz (in the unit of bx), omega, phi, kappa (rad), shape (5,); from the
            five-point solution if not given (six pairs at least).

    Returns:
        The five parameters with their covariance, and both photographs in the frame of photograph 1.

    Raises:
        GeometryError: too few pairs, pairs that do not determine the parameters, no base, or a base without
            X component.

    Source: document 004, "dependent relative orientation"; Kraus (2007), sec. 4.3.
    """
    if bx == 0:
        raise GeometryError("dependent pair: bx is 0, it sets the scale and cannot be")
    if start is None:
        b, R = _five_point(first, second)
    else:
        b = np.array([bx, start[0], start[1]])
        R = rotation_from_angles(start[2], start[3], start[4])

    def parameters(base: FloatArray, rotation: FloatArray) -> FloatArray:
        return np.array([*(base[1:] * bx / base[0]), *angles_from_rotation(rotation)])

    b, R, v, Q = refine_coplanarity(first, second, b / np.linalg.norm(b), R)
    if abs(b[0]) < NO_BX:
        raise GeometryError("dependent pair: the base has no X component, use the independent pair")
    positions = np.stack([np.zeros(3), b * bx / b[0]])
    rotations = np.stack([np.eye(3), R])
    return _pair("dependent", DEPENDENT, parameters, b, R, v, Q, positions, rotations)


@checked_arguments(first="n 2", second="n 2", start="5")
def orient_independent(
    first: FloatArray, second: FloatArray, *, start: FloatArray | None = None
) -> PairOrientation:
    """Return the independent relative orientation: phi1, kappa1, omega2, phi2, kappa2, base = X axis.

    Args:
        first: tangents u = -U/W, v = -V/W of rays of photograph 1, shape (n, 2), n >= 5.
        second: the conjugate rays of photograph 2, shape (n, 2).
        start: approximate phi1, kappa1, omega2, phi2, kappa2, rad, shape (5,); from the five-point
            solution if not given (six pairs at least).

    Returns:
        The five parameters with their covariance, and both photographs in the frame of the base.

    Raises:
        GeometryError: too few pairs, pairs that do not determine the parameters, or no base.

    Source: document 004, "independent relative orientation"; Kraus (2007), sec. 4.3.
    """
    if start is None:
        b, R = _five_point(first, second)
    else:
        R1 = rotation_from_angles(0.0, start[0], start[1])
        b, R = R1[0], R1.T @ rotation_from_angles(start[2], start[3], start[4])

    def parameters(base: FloatArray, rotation: FloatArray) -> FloatArray:
        R1 = _base_frame(base)
        return np.array([*angles_from_rotation(R1)[1:], *angles_from_rotation(R1 @ rotation)])

    b, R, v, Q = refine_coplanarity(first, second, b, R)
    R1 = _base_frame(b)
    positions = np.array([[0.0, 0, 0], [1, 0, 0]])
    return _pair("independent", INDEPENDENT, parameters, b, R, v, Q, positions, np.stack([R1, R1 @ R]))


def _base_frame(base: FloatArray) -> FloatArray:
    """R1 = Ry(phi1) Rz(kappa1) that turns the base into the X axis: its first row is the base."""
    phi = np.arcsin(np.clip(base[2], -1.0, 1.0))
    kappa = np.arctan2(-base[1], base[0])
    return rotation_from_angles(0.0, phi, kappa)


def _five_point(first: FloatArray, second: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Base and rotation from nothing; of a planar scene the solution with the smaller residuals."""
    found = relative_orientations(first, second, tolerance=FIVE_POINT_TOLERANCE)
    if found[0].kind == "infinite":
        raise GeometryError(
            "relative orientation: a rotation explains the rays, there is no base to determine"
        )
    best = min(found, key=lambda one: one.rms)
    return best.base, best.rotation


def _pair(
    kind: str,
    names: tuple[str, ...],
    parameters: Callable[[FloatArray, FloatArray], FloatArray],
    base: FloatArray,
    rotation: FloatArray,
    residuals: FloatArray,
    cofactors: FloatArray,
    positions: FloatArray,
    rotations: FloatArray,
) -> PairOrientation:
    """Parameters and their covariance from those of the turns of base and rotation."""
    J = np.empty((UNKNOWNS, UNKNOWNS))
    for k, step in enumerate(np.eye(UNKNOWNS) * DIFFERENCE):
        plus = parameters(*turned_pair(base, rotation, step))
        minus = parameters(*turned_pair(base, rotation, -step))
        change = plus - minus
        # angles may pass +-180 deg between the two
        change[-3:] = (change[-3:] + np.pi) % (2 * np.pi) - np.pi
        J[:, k] = change / (2 * DIFFERENCE)
    redundancy = len(residuals) - UNKNOWNS
    sigma0 = float(np.sqrt(np.sum(residuals**2) / redundancy)) if redundancy > 0 else np.nan
    covariance = sigma0**2 * J @ cofactors @ J.T
    return PairOrientation(
        kind,
        names,
        parameters(base, rotation),
        covariance,
        positions,
        rotations,
        residuals,
        sigma0,
        redundancy,
    )
