"""The photograph in the frame of its control: resampled, with a world file and a coordinate system.

A pixel of the new picture is a square of the plane with sides along X and Y. The world file has, a line
each, the pixel size along X, two zeros, minus the pixel size along Y, and X and Y of the middle of the upper
left pixel.

Source: document 002, sec. II.1.1.4.1 (resampling); ESRI (2016), ArcGIS for Desktop Help, "World files for
raster datasets".
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import cv2
import numpy as np

from sfm.files.whole_files import refuse_existing, whole_file
from sfm.model.conventions import AnyArray, FloatArray
from sfm.model.errors import GeometryError, OutputError, SurveyFileError, missing_library
from sfm.products.georeferencing.transformation import PlaneTransformation

WORLD = {".png": ".pgw", ".tif": ".tfw", ".tiff": ".tfw", ".jpg": ".jgw", ".jpeg": ".jgw"}
OPAQUE = (".jpg", ".jpeg")  # formats without transparent pixels
MOST_PIXELS = 400_000_000
BLOCK = 1024  # rows and columns that are resampled at a time
BEYOND = 0.05  # of the extent of the control, by which the new picture reaches beyond it


@dataclass(frozen=True)
class MapGrid:
    """The squares of the new picture."""

    x0: float  # left edge, object unit
    y1: float  # upper edge, object unit
    pixel: float  # side, object unit
    width: int
    height: int

    def centres(self, rows: range, columns: range) -> FloatArray:
        """Return the middles of the pixels of some rows and columns, object unit, (rows, columns, 2)."""
        X = self.x0 + (np.array(columns) + 0.5) * self.pixel
        Y = self.y1 - (np.array(rows) + 0.5) * self.pixel
        return np.stack(np.broadcast_arrays(X[None, :], Y[:, None]), axis=-1)

    @property
    def world(self) -> str:
        """The lines of the world file."""
        values = (self.pixel, 0.0, 0.0, -self.pixel, self.x0 + self.pixel / 2, self.y1 - self.pixel / 2)
        return "".join(f"{value!r}\n" for value in values)


def map_grid(
    transformation: PlaneTransformation,
    control: FloatArray,
    *,
    pixel: float | None = None,
    extent: tuple[float, float, float, float] | None = None,
) -> MapGrid:
    """Return the squares of the new picture.

    Args:
        transformation: from the object to the photograph.
        control: control points in the plane, (n, 2), object unit.
        pixel: side of a square, object unit; None for the median of the photograph's at the control.
        extent: smallest X, smallest Y, largest X, largest Y; None for the control and a little beyond.

    Raises:
        GeometryError: the picture would be empty or larger than MOST_PIXELS.
    """
    if extent is None:
        low, high = control.min(axis=0), control.max(axis=0)
        margin = BEYOND * (high - low)
        low, high = low - margin, high + margin
    else:
        low, high = np.array(extent[:2]), np.array(extent[2:])
    side = float(np.median(transformation.pixel_size(control))) if pixel is None else pixel
    if not ((high > low).all() and side > 0 and np.isfinite([*low, *high, side]).all()):
        raise GeometryError(
            "georeferencing: the extent is empty or has no end, expected X0 < X1, Y0 < Y1 and a pixel above 0"
        )
    width, height = (max(1, math.ceil(length / side - 1e-9)) for length in (high - low).tolist())
    if width * height > MOST_PIXELS:
        raise GeometryError(
            f"georeferencing: {width} x {height} pixels of {side:g}, at most {MOST_PIXELS:,} are written; "
            "larger pixels or a smaller extent are needed"
        )
    return MapGrid(float(low[0]), float(high[1]), side, width, height)


def resample_to_map(
    photograph: AnyArray, transformation: PlaneTransformation, grid: MapGrid
) -> tuple[AnyArray, AnyArray]:
    """Return the photograph in the frame of the control, and which pixels it shows.

    Args:
        photograph: blue, green, red, (H, W, 3), uint8.
        transformation: from the object to the photograph.
        grid: the squares of the new picture.

    Returns:
        Blue, green, red, (h, w, 3), black where the photograph shows nothing; and 255 where it shows
        something, (h, w).

    Raises:
        GeometryError: the photograph shows nothing of the squares.
    """
    height, width = photograph.shape[:2]
    drawn = np.zeros((grid.height, grid.width, 3), np.uint8)
    shown = np.zeros((grid.height, grid.width), np.uint8)
    for top_row, first_column in product(range(0, grid.height, BLOCK), range(0, grid.width, BLOCK)):
        rows = range(top_row, min(top_row + BLOCK, grid.height))
        columns = range(first_column, min(first_column + BLOCK, grid.width))
        here = slice(rows.start, rows.stop), slice(columns.start, columns.stop)
        place = transformation.apply(grid.centres(rows, columns))
        beyond = np.maximum(-0.5 - place, place + 0.5 - np.array([width, height])).max(axis=-1)  # px
        inside = np.asarray(beyond <= 0)  # NaN is not
        if not inside.any():
            continue
        # remap takes no picture of more than 32,767 rows or columns: the part that this block shows
        left, top = (max(math.floor(v) - 4, 0) for v in place[inside].min(axis=0).tolist())
        right, bottom = (math.ceil(v) + 5 for v in place[inside].max(axis=0).tolist())
        part = photograph[top:bottom, left:right]
        x, y = (np.where(inside, place[..., k] - (left, top)[k], -9.0).astype(np.float32) for k in (0, 1))
        drawn[here] = np.where(
            inside[..., None], cv2.remap(part, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), 0
        )
        shown[here] = np.where(inside, 255, 0)
    if not shown.any():
        raise GeometryError("georeferencing: the photograph shows nothing of this extent")
    return drawn, shown


def refuse_map(path: Path) -> None:
    """Refuse a file that is no picture with a world file, or that exists, with its world file.

    Raises:
        OutputError: with the reason.
    """
    ending = path.suffix.lower()
    if ending not in WORLD:
        raise OutputError(f"--out {path}: expected a file {', '.join(WORLD)}")
    for file in (path, path.with_suffix(WORLD[ending]), path.with_suffix(".prj")):
        refuse_existing(file)


def write_map(path: Path, drawn: AnyArray, shown: AnyArray, grid: MapGrid, projection: str | None) -> None:
    """Write the picture, its world file, and its coordinate system; the picture is written last.

    Args:
        path: new file .png, .tif or .jpg.
        drawn: blue, green, red, (h, w, 3).
        shown: 255 where the photograph shows something, (h, w).
        grid: the squares of the picture.
        projection: coordinate system in ESRI's well-known text; None if it is not known.

    Raises:
        OutputError: a file exists or cannot be written.
    """
    ending = path.suffix.lower()
    pixels = drawn if ending in OPAQUE else np.dstack([drawn, shown])
    try:
        done, encoded = cv2.imencode(ending, pixels)
    except cv2.error:  # as a JPEG of more than 65,535 columns
        done = False
    if not done:
        raise OutputError(
            f"{path}: the picture cannot be encoded as {ending}, {grid.width} x {grid.height} pixels"
        )
    texts = {WORLD[ending]: grid.world} | ({} if projection is None else {".prj": projection})
    for suffix, text in texts.items():
        with whole_file(path.with_suffix(suffix)) as file:
            file.write_text(text, encoding="utf-8")
    with whole_file(path) as file:
        file.write_bytes(encoded.tobytes())


def projection_of(crs: str) -> str:
    """Return a coordinate system, as EPSG:32749, in ESRI's well-known text.

    Raises:
        MissingLibraryError: pyproj is not installed.
        SurveyFileError: it is not known.
    """
    try:
        from pyproj import CRS
        from pyproj.exceptions import CRSError
    except ImportError as error:
        raise missing_library("--crs", ("pyproj",), "exchange") from error
    try:
        return str(CRS.from_user_input(crs).to_wkt("WKT1_ESRI"))
    except CRSError:
        raise SurveyFileError(
            f"--crs '{crs}': not a known coordinate system, expected one as EPSG:32749"
        ) from None
