"""Point clouds as LAZ and LAS (1.4), by laspy with lazrs of the extra kolinear[exchange].

    X, Y, Z      whole numbers, times a scale and plus an offset
    sX, sY, sZ   extra dimensions: standard deviations of the coordinates, in their unit
    WKT          coordinate system, if it is known

Names of points are not stored. The scale is the finest power of ten that holds the extent: 1e-6 up to 4 km.

Source: ASPRS, LAS Specification 1.4 R15.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from adapters.formats.clouds import reading, reason_of, refuse_large, refuse_unusable
from adapters.formats.content import Content, content_of_points, points_of
from sfm.files.whole_files import whole_file
from sfm.model.errors import missing_library

HEAD = "LASF"  # first bytes of a file
LARGEST = 2**31 - 1  # of the whole numbers
FINEST = 1e-9  # scale; a smaller one has no more digits than the coordinates of a usual extent
POINT_FORMAT, VERSION = 6, "1.4"
SIGMAS = ("sX", "sY", "sZ")


def load_laspy() -> Any:
    """Return laspy.

    Raises:
        MissingLibraryError: laspy or lazrs is not installed.
    """
    try:
        import laspy
        import lazrs  # noqa: F401  laspy compresses with it
    except ImportError as error:
        raise missing_library("format laz", ("laspy", "lazrs"), "exchange") from error
    return laspy


def read_laz(path: Path) -> Content:
    """Read the points of a LAZ or LAS file, with standard deviations and coordinate system if it has them.

    Raises:
        SurveyFileError: damaged, too many points, or a coordinate that is no reasonable number.
        MissingLibraryError: laspy or lazrs is not installed.
    """
    laspy = load_laspy()
    notes: tuple[str, ...] = ()
    with reading(path, "LAZ or LAS"):
        with laspy.open(path) as file:
            header = file.header
            refuse_large(path, header.point_count)
            cloud = file.read()
        xyz = np.column_stack([cloud.x, cloud.y, cloud.z]).astype(float)
        known = set(cloud.point_format.extra_dimension_names)
        sigma = None
        if known.issuperset(SIGMAS):
            sigma = np.column_stack([np.asarray(cloud[name], dtype=float) for name in SIGMAS])
    refuse_unusable(path, xyz)
    crs = ""
    try:
        system = header.parse_crs()
        crs = "" if system is None else str(system.to_wkt())
    except Exception as error:  # pyproj is missing, or does not know the system
        notes = (f"its coordinate system is not read ({reason_of(error)})",)
    return content_of_points(path.name, xyz, sigma, crs=crs, notes=notes)


def write_laz(path: Path, content: Content) -> None:
    """Write the points that have coordinates, in the object unit.

    Raises:
        OutputError: the file cannot be written.
        MissingLibraryError: laspy or lazrs is not installed.
    """
    laspy = load_laspy()
    xyz, sigma = points_of(content)
    header = laspy.LasHeader(point_format=POINT_FORMAT, version=VERSION)
    header.offsets = np.round((xyz.max(axis=0) + xyz.min(axis=0)) / 2)
    half = np.abs(xyz - header.offsets).max()
    header.scales = np.full(3, max(FINEST, 10.0 ** np.ceil(np.log10(max(half, FINEST) / LARGEST))))
    if sigma is not None:
        header.add_extra_dims(
            [laspy.ExtraBytesParams(name, np.float64, f"standard deviation of {name[1:]}") for name in SIGMAS]
        )
    if content.crs:
        from pyproj import CRS

        header.add_crs(CRS.from_wkt(content.crs))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = xyz.T
    if sigma is not None:
        for name, column in zip(SIGMAS, sigma.T, strict=True):
            cloud[name] = column
    with whole_file(path) as part, part.open("wb") as file:
        cloud.write(file, do_compress=path.suffix.lower() != ".las")
