"""Direct linear transformation: interior and exterior orientation from six or more points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.model.arguments import checked_arguments
from sfm.model.conventions import FloatArray
from sfm.model.display import counted
from sfm.model.errors import GeometryError

PARAMETERS = 11
DISTORTION = ("K1", "K2", "K3", "P1", "P2")
# Thickness of the points over their extent below which the system is nearly singular.
MIN_THICKNESS = 1e-3
MAX_STEPS = 100
MAX_LAST_CHANGE = 1e-12  # relative change of the parameters at which the iteration stops
MIN_SINGULAR_RATIO = 1e-11  # smallest over largest singular value of the scaled equations


@dataclass(frozen=True)
class DirectLinearTransformation:
    """Interior and exterior orientation of one photograph."""

    L: FloatArray  # L1 to L11, for image coordinates in mm and object coordinates in their unit, (11,)
    c: float  # principal distance of the y axis, mm
    affinity: float  # c of the x axis over c of the y axis, minus 1
    shear: float  # shear of the image axes, rad
    principal_point: FloatArray  # x0, y0, mm, (2,)
    distortion: FloatArray  # K1, K2, K3, P1, P2 as in `brown`, 0 where not requested, (5,)
    position: FloatArray  # projection centre X0, object unit, (3,)
    rotation: FloatArray  # R, image to object axes, (3, 3)
    residuals: FloatArray  # v = computed - measured, mm, (n, 2)
    sigma0: float  # a posteriori standard deviation of an image coordinate, mm; NaN without redundancy
    redundancy: int  # 2 n - 11 - distortion parameters
    cofactors: FloatArray  # L1 to L11 and the requested distortion parameters, (11 + d, 11 + d)

    @property
    def rms(self) -> float:
        """Root mean square residual per coordinate, mm."""
        return float(np.sqrt(np.mean(self.residuals**2)))


@checked_arguments(xy_mm="k 2", points="n 3")
def resect_dlt(
    xy_mm: FloatArray, points: FloatArray, *, distortion: tuple[str, ...] = ()
) -> DirectLinearTransformation:
    """Return interior and exterior orientation by the direct linear transformation.

    Args:
        xy_mm: measured image coordinates (y up), shape (n, 2), mm.
        points: object points that are not coplanar, shape (n, 3), object unit.
        distortion: which of K1, K2, K3, P1, P2 to determine as well; every two of them need one more point.

    Raises:
        GeometryError: there are too few points, they are nearly coplanar, or no camera has them in front.

    Source: Abdel-Aziz, Karara (1971) and Marzan, Karara (1975): x + dx = (L1 X + L2 Y + L3 Z + L4)/A,
    y + dy = (L5 X + L6 Y + L7 Z + L8)/A, A = L9 X + L10 Y + L11 Z + 1, dx = xb (K1 r2 + ...) + .... The
    solution is repeated with the weights 1/A and the principal point of the last step until it is stable.
    """
    unknown = [name for name in distortion if name not in DISTORTION]
    if unknown:
        raise GeometryError(f"dlt: no distortion parameter '{unknown[0]}', there are {', '.join(DISTORTION)}")
    xy = np.asarray(xy_mm, dtype=float).reshape(-1, 2)
    xyz = np.asarray(points, dtype=float).reshape(-1, 3)
    n, d = len(xyz), len(distortion)
    needed = (PARAMETERS + d + 1) // 2
    if n < needed or len(xy) != n:
        raise GeometryError(
            f"dlt: {counted(min(n, len(xy)), 'point')}, at least {needed} are needed for "
            f"{counted(PARAMETERS + d, 'parameter')}"
        )
    if not (np.isfinite(xy).all() and np.isfinite(xyz).all()):
        raise GeometryError("dlt: a coordinate is not a finite number")
    extents = np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False)
    if extents[0] == 0 or extents[2] <= MIN_THICKNESS * extents[0]:
        raise GeometryError(
            "dlt: the points lie in one plane or nearly so, which leaves the 11 parameters undetermined; "
            "use p4p or robust with a known camera"
        )
    columns = [DISTORTION.index(name) for name in distortion]
    # centre and scale: the equations are then well conditioned and no A is near zero
    origin, extent = xyz.mean(axis=0), float(extents[0] / np.sqrt(n))
    X, size = (xyz - origin) / extent, float(np.abs(xy).max())
    g, k = _solve_linear(xy / size, X, columns)
    P = g.reshape(3, 4)
    depths = X @ P[2, :3] + P[2, 3]
    if not ((depths > 0).all() or (depths < 0).all()):
        raise GeometryError("dlt: the points lie on both sides of the camera they define")
    H = np.eye(4)  # from object coordinates to centred and scaled ones
    H[:3] /= extent
    H[:3, 3] = -origin / extent
    P = np.diag([size, size, 1.0]) @ P @ H
    powers = np.array([2, 4, 6, 1, 1])
    return _decompose(P, k / size**powers, xy, xyz, columns)


def _solve_linear(xy: FloatArray, X: FloatArray, columns: list[int]) -> tuple[FloatArray, FloatArray]:
    """Return projection matrix (12,) and distortion (5,) in scaled coordinates by repeated linear steps."""
    n = len(X)
    X1 = np.concatenate([X, np.ones((n, 1))], axis=1)
    k, g = np.zeros(5), np.zeros(12)
    weight, centre = np.ones(n), np.zeros(2)
    zero = np.zeros((n, 4))
    for step in range(MAX_STEPS):
        B = _distortion_terms(xy - centre)[:, :, columns]  # (n, 2, d)
        left = np.stack(
            [
                np.concatenate([X1, zero, -xy[:, :1] * X1], axis=1),
                np.concatenate([zero, X1, -xy[:, 1:] * X1], axis=1),
            ],
            axis=1,
        )
        # the distortion terms are multiplied by A of the last step
        rows = np.concatenate([left * weight[:, None, None], -B], axis=2).reshape(2 * n, -1)
        if step == 0:
            rows = rows[:, :12]
        # homogeneous equations with 12 parameters of unit norm, solved by the smallest singular vector
        scale = np.linalg.norm(rows, axis=0)
        _, s, Vt = np.linalg.svd(rows / scale, full_matrices=len(rows) < rows.shape[1])
        if s[min(len(s), rows.shape[1] - 1) - 1] <= MIN_SINGULAR_RATIO * s[0]:
            raise GeometryError("dlt: the points do not determine the parameters (a critical arrangement)")
        h = Vt[-1] / scale
        norm = np.linalg.norm(h[8:11])
        h /= norm * (np.sign(np.mean(X1 @ h[8:12])) or 1.0)
        A = X1 @ h[8:12]
        # rows were divided by the last A, but the distortion parameters refer to the new A
        new_k = np.zeros(5)
        if step > 0:
            new_k[columns] = h[12:] / np.mean(A * weight)
        change = np.linalg.norm(h[:12] - g) / np.linalg.norm(h[:12]) + np.abs(new_k - k).sum()
        g, k, weight = h[:12], new_k, 1 / A
        r3 = g[8:11]
        centre = np.array([g[0:3] @ r3, g[4:7] @ r3])
        if step > 1 and change < MAX_LAST_CHANGE:
            break
    return g, k


def _distortion_terms(xb: FloatArray) -> FloatArray:
    """Return d (dx, dy) / d (K1, K2, K3, P1, P2) of `brown` at reduced image coordinates, (n, 2, 5)."""
    x, y = xb.T
    r2 = x * x + y * y
    dx = np.stack([x * r2, x * r2**2, x * r2**3, r2 + 2 * x * x, 2 * x * y], axis=1)
    dy = np.stack([y * r2, y * r2**2, y * r2**3, 2 * x * y, r2 + 2 * y * y], axis=1)
    return np.stack([dx, dy], axis=1)


def _decompose(
    P: FloatArray, k: FloatArray, xy: FloatArray, xyz: FloatArray, columns: list[int]
) -> DirectLinearTransformation:
    """Decompose a projection matrix x ~ P X (image y up, camera looks along -z) into the orientations."""
    P = P / np.linalg.norm(P[2, :3])
    position = -np.linalg.solve(P[:, :3], P[:, 3])
    if np.mean((xyz - position) @ P[2, :3]) > 0:
        P = -P  # the third row is the image z axis, which points away from the object
    # P = K M with K = [[-cx, s, x0], [0, -cy, y0], [0, 0, 1]] (x = x0 - c U/W): from the last row up
    m3 = P[2, :3]
    y0 = float(P[1, :3] @ m3)
    cy = float(np.linalg.norm(P[1, :3] - y0 * m3))
    m2 = -(P[1, :3] - y0 * m3) / cy
    x0, s = float(P[0, :3] @ m3), float(P[0, :3] @ m2)
    cx = float(np.linalg.norm(P[0, :3] - x0 * m3 - s * m2))
    m1 = -(P[0, :3] - x0 * m3 - s * m2) / cx
    M = np.stack([m1, m2, m3])
    if np.linalg.det(M) < 0:
        raise GeometryError("dlt: the image is mirrored against the object points (is y up?)")
    dx = np.einsum("nij,j->ni", _distortion_terms(xy - (x0, y0)), k)
    X1 = np.concatenate([xyz, np.ones((len(xyz), 1))], axis=1)
    mapped = X1 @ P.T
    residuals = mapped[:, :2] / mapped[:, 2:] - dx - xy
    redundancy = 2 * len(xyz) - PARAMETERS - len(columns)
    sigma0 = float(np.sqrt(np.sum(residuals**2) / redundancy)) if redundancy > 0 else float("nan")
    L = (P / P[2, 3]).ravel()[:11]
    A = np.asarray(mapped[:, 2] / P[2, 3])
    zero = np.zeros_like(X1)
    ideal = mapped[:, :2] / mapped[:, 2:]
    J = (
        np.stack(
            [
                np.concatenate([X1, zero, -ideal[:, :1] * X1[:, :3]], axis=1),
                np.concatenate([zero, X1, -ideal[:, 1:] * X1[:, :3]], axis=1),
            ],
            axis=1,
        )
        / A[:, None, None]
    )
    J = np.concatenate([J, -_distortion_terms(xy - (x0, y0))[:, :, columns]], axis=2).reshape(
        2 * len(xyz), -1
    )
    scale = np.linalg.norm(J, axis=0)
    cofactors = np.linalg.pinv((J / scale).T @ (J / scale), hermitian=True) / np.outer(scale, scale)
    return DirectLinearTransformation(
        L, cy, cx / cy - 1, float(np.arctan2(s, cy)), np.array([x0, y0]), k,
        np.asarray(position, dtype=float), M.T,
        np.asarray(residuals), sigma0, redundancy, np.asarray(cofactors),
    )  # fmt: skip
