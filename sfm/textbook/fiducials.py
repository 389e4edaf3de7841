"""Interior orientation of scanned photographs: from comparator to photo coordinates by fiducial marks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.arguments import checked_arguments
from sfm.conventions import FloatArray
from sfm.display import counted
from sfm.errors import GeometryError

SIMILARITY, AFFINE = "similarity", "affine"
FEWEST = {SIMILARITY: 2, AFFINE: 3}
MIN_SINGULAR_RATIO = 1e-9  # second singular value over the first


@dataclass(frozen=True)
class FiducialTransformation:
    """photo = matrix @ measured + shift, with its precision by the fiducial marks."""

    kind: str  # similarity (4 parameters) | affine (6 parameters)
    matrix: FloatArray  # [[a11, a12], [a21, a22]], mm per comparator unit, (2, 2)
    shift: FloatArray  # mm, (2,)
    residuals: FloatArray  # v = computed - calibrated of the marks, mm, (n, 2)
    sigma0: float  # a posteriori standard deviation of a mark coordinate, mm; NaN without redundancy
    redundancy: int  # 2 n - 4 or 2 n - 6
    covariance: FloatArray  # of (a, b, tx, ty) or (a11, a12, tx, a21, a22, ty), (4, 4) or (6, 6)

    def apply(self, measured: FloatArray) -> FloatArray:
        """Return photo coordinates of measured ones, mm, shape (..., 2)."""
        return np.asarray(measured, dtype=float) @ self.matrix.T + self.shift

    def invert(self, photo: FloatArray) -> FloatArray:
        """Return measured coordinates of photo coordinates, comparator unit, shape (..., 2)."""
        return np.asarray((np.asarray(photo, dtype=float) - self.shift) @ np.linalg.inv(self.matrix).T)

    @property
    def scales(self) -> FloatArray:
        """Scale along the two measured axes, mm per comparator unit, (2,)."""
        return np.asarray(np.linalg.norm(self.matrix, axis=0))

    @property
    def rotation(self) -> float:
        """Angle alpha from the measured x axis to the photo x axis, rad."""
        return float(np.arctan2(self.matrix[1, 0], self.matrix[0, 0]))

    @property
    def shear(self) -> float:
        """Departure epsilon of the measured axes from a right angle, rad; 0 for a similarity."""
        return float(np.arctan2(-self.matrix[0, 1], self.matrix[1, 1])) - self.rotation


@checked_arguments(measured="k 2", calibrated="n 2")
def orient_fiducials(
    measured: FloatArray, calibrated: FloatArray, *, kind: str = AFFINE
) -> FiducialTransformation:
    """Return the transformation that brings measured fiducial marks onto their calibrated coordinates.

    Args:
        measured: comparator or pixel coordinates, shape (n, 2). For pixels (y down) only the affine
            transformation can turn the y axis round.
        calibrated: photo coordinates of the marks from the calibration certificate, shape (n, 2), mm.
        kind: similarity (x = a xm - b ym + tx, y = b xm + a ym + ty; 4 parameters) or affine (6 parameters).

    Returns:
        The transformation, with residuals (mm) and the covariance of its parameters.

    Raises:
        GeometryError: unknown kind, too few marks, or marks that do not determine it.

    Source: document 004, eqs. 1.2-1.9; Kraus (2007), sec. 3.2.1.
    """
    if kind not in FEWEST:
        raise GeometryError(f"fiducial marks: kind '{kind}', expected one of {', '.join(FEWEST)}")
    m = np.asarray(measured, dtype=float).reshape(-1, 2)
    f = np.asarray(calibrated, dtype=float).reshape(-1, 2)
    n = len(m)
    if n < FEWEST[kind] or len(f) != n:
        raise GeometryError(
            f"fiducial marks: {counted(min(n, len(f)), 'mark')}, {kind} needs at least {FEWEST[kind]} in "
            "both systems"
        )
    centre = m.mean(axis=0)
    spread = np.linalg.svd(m - centre, compute_uv=False)
    if spread[0] == 0 or (kind == AFFINE and spread[1] <= MIN_SINGULAR_RATIO * spread[0]):
        raise GeometryError("fiducial marks: the marks coincide or lie on one line")
    x, y = (m - centre).T
    one, zero = np.ones(n), np.zeros(n)
    if kind == SIMILARITY:
        # unknowns a, b, tx, ty: xf = a x - b y + tx, yf = b x + a y + ty
        A = np.concatenate([np.stack([x, -y, one, zero], axis=1), np.stack([y, x, zero, one], axis=1)])
    else:
        # unknowns a11, a12, tx, a21, a22, ty
        A = np.concatenate(
            [
                np.stack([x, y, one, zero, zero, zero], axis=1),
                np.stack([zero, zero, zero, x, y, one], axis=1),
            ]
        )
    l = np.concatenate([f[:, 0], f[:, 1]])
    p = np.linalg.lstsq(A, l, rcond=None)[0]
    v = (A @ p - l).reshape(2, n).T
    redundancy = 2 * n - A.shape[1]
    sigma0 = float(np.sqrt(np.sum(v**2) / redundancy)) if redundancy > 0 else np.nan
    if kind == SIMILARITY:
        matrix, shift = np.array([[p[0], -p[1]], [p[1], p[0]]]), p[2:]
        J = np.eye(4)  # from the shift at the centre of the marks to the one at the origin
        J[2, :2] = -centre[0], centre[1]
        J[3, :2] = -centre[1], -centre[0]
    else:
        matrix, shift = np.array([[p[0], p[1]], [p[3], p[4]]]), p[[2, 5]]
        J = np.eye(6)
        J[2, :2] = J[5, 3:5] = -centre
    covariance = sigma0**2 * J @ np.linalg.inv(A.T @ A) @ J.T
    return FiducialTransformation(
        kind, matrix, shift - matrix @ centre, v, sigma0, redundancy, np.asarray(covariance)
    )
