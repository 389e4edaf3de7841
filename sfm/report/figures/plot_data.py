"""Data for the plots of a report, separate from the code that computes or draws them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from sfm.model.conventions import FloatArray, IntArray


@dataclass(frozen=True)
class Plot:
    """A picture of a page, as a whole and cut into its panels."""

    stem: str  # of its file name
    caption: str
    png: bytes
    panels: tuple[bytes, ...]  # a PNG each, row by row; a page puts as many side by side as are legible
    kind: ClassVar[str] = "figure"  # among the parts of a page


@dataclass(frozen=True)
class PlotCamera:
    """A camera as its user knows it, even if parameters vary between its photographs."""

    name: str
    c_px: float
    size_px: tuple[int, int]


@dataclass(frozen=True)
class ProjectionMap:
    """Projection uncertainty of a camera over its photographs."""

    x: FloatArray  # columns of a grid, px, (c,)
    y: FloatArray  # rows of the grid, px, (r,)
    sigma: FloatArray  # RMS of both coordinates, px; NaN where the model folds over, (r, c)


@dataclass(frozen=True)
class EpipolarMap:
    """Distances of image points of a camera from the epipolar lines of its reference camera."""

    name: str  # "right from left"
    size_px: tuple[int, int]
    xy: FloatArray  # px, (k, 2)
    distance_px: FloatArray  # (k,)
    rms_px: float


@dataclass(frozen=True)
class PlotData:
    """Network and residuals of m photographs and k accepted image points."""

    unit: str  # of length
    images: tuple[str, ...]  # names of the photographs
    position: FloatArray  # projection centres, object unit, (m, 3)
    rotation: FloatArray  # from camera to object axes, (m, 3, 3)
    points: FloatArray  # object points, object unit, (n, 3)
    cameras: tuple[PlotCamera, ...]
    camera: IntArray  # index of the camera of each photograph, (m,)
    image: IntArray  # photograph of each image point, (k,)
    xy: FloatArray  # image coordinates, px, (k, 2)
    from_centre: FloatArray  # image coordinates from the centre of the photograph, px, (k, 2)
    residuals: FloatArray  # px, (k, 2)
    standardised: FloatArray  # residuals over their standard deviation a posteriori, (2k,)
    image_rms_px: FloatArray  # root mean square residual per coordinate of each photograph, px, (m,)
    image_points: IntArray  # accepted image points of each photograph, (m,)
    rms_px: float  # of all
    sigma: FloatArray  # of the points, RMS of sX, sY, sZ; NaN where fixed or not known, (n,)
    sigma_unit: str  # unit of sigma
    projection: tuple[ProjectionMap | None, ...]  # of each camera; None if no parameter was adjusted
    epipolar: tuple[EpipolarMap, ...] = ()  # of each mount of a rig
