"""ViewerScene: everything that the viewer of a page shows, as parallel arrays, whoever computed it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.camera import Camera
from sfm.conventions import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class Rays:
    """The image points of a network, rejected ones included, in the order of their object points."""

    point: IntArray  # index of the object point, never falling, (k,)
    photo: IntArray  # index of the photograph, (k,)
    xy: FloatArray  # measured position, px, (k, 2)
    v: FloatArray  # residual, computed minus measured, px; NaN where not known, (k, 2)
    w: FloatArray  # Baarda's w of both coordinates; NaN where not known, (k, 2)
    rejected: BoolArray  # whether it took no part, (k,)
    ellipse: FloatArray  # semi-axes, larger first, px, and angle, rad; NaN where there is none, (k, 3)

    def __len__(self) -> int:
        return len(self.point)

    @property
    def length(self) -> FloatArray:
        """Length of the residual vectors, px, (k,)."""
        return np.asarray(np.linalg.norm(self.v, axis=1))

    def worst_first(self) -> IntArray:
        """Return the rays by |w|, where that is not known by the residual; rejected ones first, (k,)."""
        size = np.where(np.isfinite(self.w).any(axis=1), np.fmax(*np.abs(self.w).T), self.length)
        return np.lexsort((np.arange(len(self)), -np.nan_to_num(size), ~self.rejected))


@dataclass(frozen=True)
class Marks:
    """Candidates seen in photographs that are not in the result."""

    photo: IntArray  # index of the photograph, in rising order, (c,)
    xy: FloatArray  # px, (c, 2)
    reason: IntArray  # index into `reasons`, (c,)
    reasons: tuple[str, ...]  # in words, what matters most first

    @classmethod
    def none(cls) -> Marks:
        """Return no marks at all."""
        empty = np.zeros(0, dtype=np.int64)
        return cls(empty, np.zeros((0, 2)), empty, ())


@dataclass(frozen=True)
class Bar:
    """A scale bar."""

    start: int  # index of a point
    end: int
    length: float  # given, object unit
    sigma: float  # given, object unit
    difference: float  # adjusted minus given, object unit


@dataclass(frozen=True)
class ViewerScene:
    """A result to look at."""

    name: str
    unit: str  # of lengths
    cameras: tuple[Camera, ...]
    points: tuple[str, ...]  # names, n of them
    xyz: FloatArray  # object unit, (n, 3)
    covariance: FloatArray  # of each point by itself, object unit^2; NaN where not known, (n, 3, 3)
    rays_of_point: IntArray  # accepted, (n,)
    angle_deg: FloatArray  # largest between two rays, deg; NaN with fewer than two, (n,)
    point_rms_px: FloatArray  # (n,)
    photographs: tuple[str, ...]  # names, m of them
    camera: IntArray  # index of the camera of each photograph, (m,)
    position: FloatArray  # projection centres, object unit, (m, 3)
    rotation: FloatArray  # image to object axes, (m, 3, 3)
    exterior_sigma: FloatArray  # of X0 Y0 Z0 (object unit), omega phi kappa (deg); NaN if not known, (m, 6)
    photo_rms_px: FloatArray  # (m,)
    points_of_photo: IntArray  # accepted, (m,)
    rays: Rays
    marks: Marks
    bars: tuple[Bar, ...]
    control: tuple[int, ...]  # indices of points
    distance_sigma: FloatArray | None  # of the distance of each pair of points i < j, by rows, object unit
    rms_px: float  # residual per coordinate over the accepted image points
    notes: tuple[str, ...] = ()  # what the page leaves out, one line each
    deviation: FloatArray | None = (
        None  # of points from what is nominal, object unit; NaN where unknown, (n,)
    )
    displacement: FloatArray | None = (
        None  # of points since an earlier epoch, object unit; NaN likewise, (n, 3)
    )
    state: tuple[str, ...] = ()  # what a test says of the displacement of each point, (n,)


def distance_sigmas(xyz: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the standard deviation of the distance of each pair of points, from their joint covariance.

    With the unit vector u from point i to point j it is the root of u' (Qii + Qjj - Qij - Qji) u.

    Args:
        xyz: object unit, (n, 3).
        covariance: of all coordinates together, object unit^2, (3 n, 3 n).

    Returns:
        Of the pairs i < j, by rows, object unit; NaN where both points are in one place, (n (n - 1) / 2,).

    Source: law of propagation of variances; Luhmann et al., Close-Range Photogrammetry (2020), sec. 2.4.
    """
    n = len(xyz)
    Q = covariance.reshape(n, 3, n, 3)
    of_points = Q[np.arange(n), :, np.arange(n), :]
    rows = []
    for i in range(n - 1):
        u = xyz[i + 1 :] - xyz[i]
        length = np.linalg.norm(u, axis=1, keepdims=True)
        u = np.divide(u, length, out=np.full_like(u, np.nan), where=length > 0)
        cross = Q[i].transpose(1, 0, 2)[i + 1 :]
        of_difference = of_points[i] + of_points[i + 1 :] - cross - cross.transpose(0, 2, 1)
        variance = np.einsum("ja,jab,jb->j", u, of_difference, u)
        rows.append(np.sqrt(np.maximum(variance, 0.0)))
    return np.concatenate(rows) if rows else np.zeros(0)
