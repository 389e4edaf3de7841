"""3-D similarity (absolute orientation): closed form, weighted, with residuals and covariance.

A closed-form similarity brings corresponding points together. Similarities restricted to some motions serve
networks with a partial datum. The seven infinitesimal motions describe what a datum leaves open.
Two-dimensional similarity and affine transformations (fiducial marks) are in
`sfm.textbook.photo_coordinates`.

Source: Szeliski and Kang (1997), IEEE PAMI 19(5), for the reversal of depth; others with each function.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from sfm.model.arguments import checked_arguments
from sfm.model.conventions import FloatArray, skew
from sfm.model.display import counted
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate

PARAMETERS = 7
MIN_DEPTH_RATIO = 0.05  # ratio of an extent to the longest one below which points have no depth
OPEN = 1e-6  # share of a rotation or scale in the open motions; smaller shares are rounding
MAX_STEPS = 50  # iterations of a fit of some motions, which usually ends after about 5
MAX_COLLINEAR_RATIO = 1e-9  # ratio of the second singular value to the first below which points are collinear


@dataclass(frozen=True)
class Similarity:
    """target = scale * rotation @ source + translation.

    Example:
        >>> import sfm
        >>> sfm.Similarity(2.0, np.eye(3), np.array([1.0, 0.0, 0.0])).apply([[1.0, 2.0, 3.0]])
        array([[3., 4., 6.]])
    """

    scale: float  # target unit per source unit
    rotation: FloatArray  # (3, 3)
    translation: FloatArray  # target unit, (3,)

    def apply(self, points: FloatArray) -> FloatArray:
        """Return points of shape (..., 3) in the target frame."""
        return self.scale * (np.asarray(points) @ self.rotation.T) + self.translation

    def apply_estimate(self, estimate: Estimate) -> Estimate:
        """Return the estimate with points, positions, rotations and mounts in the target frame."""
        mounts = estimate.mounts
        if mounts is not None:  # mounts held fixed keep their given lengths
            scale = np.where(mounts.free[:, :3].any(axis=1, keepdims=True), self.scale, 1.0)
            mounts = replace(mounts, position=scale * mounts.position)
        return replace(
            estimate,
            mounts=mounts,
            position=self.apply(estimate.position),
            rotation=self.rotation @ estimate.rotation,
            points=self.apply(estimate.points),
        )

    def inverse(self) -> Similarity:
        """Return source_from_target."""
        R = self.rotation.T
        return Similarity(1 / self.scale, R, -(R @ self.translation) / self.scale)


@checked_arguments(source="n 3", target="m 3", weights="n")
def fit_similarity(
    source: FloatArray,
    target: FloatArray,
    *,
    weights: FloatArray | None = None,
    scale: float | None = None,
) -> Similarity:
    """Return the similarity that brings source points onto target points by least squares.

    Args:
        source: points in the source frame, shape (n, 3), source unit.
        target: the same points in the target frame, shape (n, 3), target unit.
        weights: weight of each point, shape (n,); equal if not given.
        scale: scale to hold fixed, target unit per source unit; estimated if not given.

    Raises:
        GeometryError: fewer than three points, all points on a line, or arrays of the wrong shape.

    Example:
        >>> import sfm
        >>> corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
        >>> round(sfm.fit_similarity(corners, 3 * corners).scale, 9)
        3.0

    Source: Horn (1987), J. Opt. Soc. Am. A 4(4), by the singular value decomposition of Umeyama
    (1991), IEEE PAMI 13(4), eqs. 40-42.
    """
    source, target = np.asarray(source, dtype=float), np.asarray(target, dtype=float)
    if source.ndim != 2 or source.shape[1] != 3 or source.shape != target.shape:
        raise GeometryError(f"similarity: points {source.shape} and {target.shape}, expected (n, 3) twice")
    if not (np.isfinite(source).all() and np.isfinite(target).all()):
        raise GeometryError("similarity: NaN or infinity among the coordinates, expected finite numbers")
    n = len(source)
    if n < 3:
        raise GeometryError(f"similarity: {counted(n, 'common point')}, at least 3 are needed")
    w = np.ones(n) if weights is None else np.asarray(weights, dtype=float)
    if not (np.isfinite(w).all() and w.min() >= 0 and w.sum() > 0):
        raise GeometryError(
            "similarity: weights that are negative, not finite or all 0, expected positive ones"
        )
    (similarity,) = _fitted(source[None], target[None], w / w.sum(), scale)
    if similarity is None:
        raise GeometryError("similarity: the common points lie on a line or coincide")
    return similarity


def fit_similarities(source: FloatArray, target: FloatArray) -> list[Similarity | None]:
    """Return the similarities of many sets of points at once; `fit_similarity` handles one set.

    Args:
        source: sets of n points in the source frame, n >= 3, shape (s, n, 3).
        target: the same points in the target frame, shape (s, n, 3).

    Returns:
        A similarity for each set; None for a set whose points lie on a line or are not finite.
    """
    known = np.isfinite(source + target).all(axis=(1, 2)).reshape(-1, 1, 1)
    n = source.shape[1]
    return _fitted(np.where(known, source, 0.0), np.where(known, target, 0.0), np.full(n, 1 / n), None)


def _fitted(
    source: FloatArray, target: FloatArray, w: FloatArray, scale: float | None
) -> list[Similarity | None]:
    """Return the similarities of sets of finite points, (s, n, 3), with weights that sum to 1, (n,)."""
    centre_s, centre_t = w @ source, w @ target
    s, t = source - centre_s[:, None], target - centre_t[:, None]
    spread = np.linalg.svd(s * np.sqrt(w)[:, None], compute_uv=False)
    U, d, Vt = np.linalg.svd(np.swapaxes(t * w[:, None], 1, 2) @ s)
    sign = np.ones_like(d)
    sign[:, 2] = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    R = (U * sign[:, None]) @ Vt
    fitted: list[Similarity | None] = []
    for k, on_line in enumerate(spread[:, 1] <= MAX_COLLINEAR_RATIO * spread[:, 0]):
        if on_line:
            fitted.append(None)
            continue
        factor = float((d[k] * sign[k]).sum() / (w @ (s[k] ** 2).sum(axis=1))) if scale is None else scale
        fitted.append(Similarity(factor, R[k], centre_t[k] - factor * R[k] @ centre_s[k]))
    return fitted


def fit_motions(source: FloatArray, target: FloatArray, motions: FloatArray) -> Similarity:
    """Return the similarity, restricted to some motions, that brings source points onto target points.

    The fit is by least squares. For a levelled network, for example, the motions are the shifts and the
    rotation about the vertical.

    Args:
        source: points in the source frame, (n, 3).
        target: the same points in the target frame, (n, 3).
        motions: displacements of the source points under each open motion, (n, 3, d).

    Raises:
        GeometryError: as for `fit_similarity`.
    """
    if not motions.shape[2]:
        return Similarity(1.0, np.eye(3), np.zeros(3))
    centre, size = source.mean(axis=0), float(np.ptp(source, axis=0).max())
    along = motions_along(source, motions, centre=centre, size=size)
    overall = fit_similarity(source, target)
    # an orthonormal basis of the space that the turns span
    U, sizes, _ = np.linalg.svd(along[3:6])
    axes = U[:, : int((sizes > OPEN).sum())]
    turn = Rotation.from_matrix(overall.rotation)
    if axes.shape[1] == 1:
        *v, q = turn.as_quat()
        w = 2 * np.arctan2(v @ axes[:, 0], q) * axes[:, 0]
    else:
        w = axes @ axes.T @ turn.as_rotvec()
    towards = size * np.append(w, np.log(overall.scale))
    step, A = np.linalg.lstsq(along[3:], towards, rcond=OPEN)[0], np.eye(4)
    for _ in range(MAX_STEPS):
        motion, generator = along @ step, np.zeros((4, 4))
        generator[:3, :3] = (skew(motion[3:6]) + motion[6] * np.eye(3)) / size
        generator[:3, 3] = motion[:3] - generator[:3, :3] @ centre
        A = expm(generator) @ A
        x = source @ A[:3, :3].T + A[:3, 3]
        J = similarity_motions(x, centre=centre, size=size).reshape(-1, 7) @ along
        step = np.linalg.lstsq(J, (target - x).ravel(), rcond=None)[0]
        if np.linalg.norm(step) < 1e-12 * size:
            break
    scale = float(np.cbrt(np.linalg.det(A[:3, :3])))
    return Similarity(scale, A[:3, :3] / scale, A[:3, 3])


def nearest_rotation(matrix: FloatArray) -> FloatArray:
    """Return the rotation R with the largest trace of R' M, (3, 3); for M = sum b a' it fits b = R a best.

    Source: Umeyama (1991), IEEE Trans. PAMI 13(4), lemma.
    """
    U, _, Vt = np.linalg.svd(matrix)
    return np.asarray((U * np.array([1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)])) @ Vt)


def similarity_motions(xyz: FloatArray, *, centre: FloatArray, size: float = 1.0) -> FloatArray:
    """Return the displacements of points under shifts, small rotations and a change of scale, (n, 3, 7).

    Args:
        xyz: points, (n, 3).
        centre: centre of rotations and scale, (3,).
        size: length that divides rotations and scale, so that all seven motions are of the same order.

    Source: Luhmann et al., Close-Range Photogrammetry (2020), sec. 4.4.3.
    """
    x = xyz - centre
    shift = np.broadcast_to(np.eye(3), (len(x), 3, 3))
    return np.concatenate([shift, -skew(x) / size, x[:, :, None] / size], axis=2)


def motions_along(xyz: FloatArray, motions: FloatArray, *, centre: FloatArray, size: float) -> FloatArray:
    """Express motions of points as orthonormal combinations of the seven `similarity_motions`, (7, d).

    Args:
        xyz: points, (n, 3).
        motions: displacements of the points under each motion, (n, 3, d).
        centre: as for `similarity_motions`.
        size: as for `similarity_motions`.
    """
    G = similarity_motions(xyz, centre=centre, size=size).reshape(-1, 7)
    return np.linalg.qr(np.linalg.lstsq(G, motions.reshape(len(G), -1), rcond=None)[0])[0]


def without_motions(xyz: FloatArray, away: FloatArray) -> FloatArray:
    """Return displacements of points after removing the best-fitting small similarity, (n, 3, q).

    Args:
        xyz: points, (n, 3); NaN where unknown.
        away: displacements of the points, (n, 3, q).
    """
    known = np.isfinite(xyz).all(axis=1)
    X = xyz[known]
    centre = X.mean(axis=0)
    G = similarity_motions(X, centre=centre, size=float(np.abs(X - centre).max())).reshape(-1, 7)
    flat = away[known].reshape(3 * len(X), -1)
    left = np.zeros_like(away)
    left[known] = (flat - G @ np.linalg.lstsq(G, flat, rcond=None)[0]).reshape(len(X), 3, -1)
    return left


def mean_distance(xyz: FloatArray) -> float:
    """Return the root mean square distance of points (n, 3) from their centroid."""
    return float(np.sqrt(((xyz - xyz.mean(axis=0)) ** 2).sum(axis=1).mean()))


def extended_axes(xyz: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the axes along which an object has extent (k, 3), and its coordinates along them (n, k)."""
    centred = xyz - xyz.mean(axis=0)
    _, extent, axes = np.linalg.svd(centred, full_matrices=False)
    axes = axes[MIN_DEPTH_RATIO * extent[0] < extent]
    return axes, centred @ axes.T


def reverse_depth(estimate: Estimate) -> Estimate:
    """Return the estimate reflected in depth, which is exact if the rays of each photograph are parallel.

    Args:
        estimate: NaN for photographs and points that are not determined; they stay NaN.
    """
    known, oriented = estimate.determined, estimate.oriented
    d = estimate.rotation[oriented, :, 2].mean(axis=0)
    F = np.eye(3) - 2 * np.outer(d, d) / (d @ d)
    centre = estimate.points[known].mean(axis=0)
    R = F @ estimate.rotation * np.array([1.0, 1.0, -1.0])
    from_centre = np.einsum("mji,mj->mi", estimate.rotation, estimate.position - centre)
    return replace(
        estimate,
        position=centre + np.einsum("mij,mj->mi", R, from_centre),
        rotation=R,
        points=centre + (estimate.points - centre) @ F,
    )


@dataclass(frozen=True)
class AbsoluteOrientation:
    """Seven parameters that bring a model into the frame of the control points."""

    similarity: Similarity  # control_from_model
    residuals: FloatArray  # v = transformed - control, control unit, (n, 3)
    sigma0: float  # a posteriori standard deviation of unit weight, control unit; NaN without redundancy
    redundancy: int  # 3 n - 7
    covariance: FloatArray  # scale, three small rotations about control axes (rad) and shift, (7, 7)


@checked_arguments(model="n 3", control="n 3", weights="n")
def orient_absolute(
    model: FloatArray, control: FloatArray, *, weights: FloatArray | None = None
) -> AbsoluteOrientation:
    """Return the 7-parameter similarity that brings model points onto control points.

    Args:
        model: points in the model, shape (n, 3), model unit, n >= 3.
        control: the same points in the control frame, shape (n, 3), control unit.
        weights: weight of each point, shape (n,); 1 if not given.

    Returns:
        The closed-form solution, which is the least-squares solution, and its covariance. The covariance is
        that of the scale, of w in exp([w]x) R, and of the translation of the model's centre of gravity.

    Raises:
        GeometryError: fewer than three points, or all points on a line.

    Source: document 004, "absolute orientation"; Horn (1987) for the closed form (sfm/model/similarity.py),
    Kraus (2007), sec. 4.4.3, for the differential equations.
    """
    model, control = np.asarray(model, dtype=float), np.asarray(control, dtype=float)
    similarity = fit_similarity(model, control, weights=weights)
    n = len(model)
    P = np.ones(n) if weights is None else np.asarray(weights, dtype=float)
    moved = similarity.apply(model)
    v = moved - control
    # about the weighted centre: d = (moved - centre) dm / m + w x (moved - centre) + dt
    arm = moved - (P @ moved) / P.sum()
    A = np.zeros((n, 3, PARAMETERS))
    A[:, :, 0] = arm / similarity.scale
    A[:, :, 1:4] = -skew(arm)
    A[:, :, 4:] = np.eye(3)
    N = np.einsum("nia,n,nib->ab", A, P, A)
    redundancy = 3 * n - PARAMETERS
    sigma0 = float(np.sqrt(np.sum(P * np.sum(v**2, axis=1)) / redundancy)) if redundancy > 0 else np.nan
    covariance = sigma0**2 * np.linalg.inv(N)
    return AbsoluteOrientation(similarity, v, sigma0, redundancy, np.asarray(covariance))
