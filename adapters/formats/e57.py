"""Point clouds as E57, by pye57 of the extra kolinear[exchange].

    cartesianX, cartesianY, cartesianZ     in metres, as the standard demands, double precision
    kolinear:sX, kolinear:sY, kolinear:sZ  extension: standard deviations of the coordinates, m
    coordinateMetadata                     coordinate system in well-known text, if it is known

Coordinates in a known unit are written in metres; without one, as they are. Names of points are not stored.
All scans of a file are read, in its coordinates, without points that it marks as invalid.

Source: ASTM E2807-11, Standard Specification for 3D Imaging Data Exchange.
"""

from __future__ import annotations

import uuid
from pathlib import Path
from typing import Any

import numpy as np

from adapters.formats.clouds import reading, reason_of, refuse_large, refuse_unusable
from adapters.formats.content import Content, content_of_points, points_of
from sfm.files.whole_files import refuse_full, whole_file
from sfm.model.conventions import METRES, FloatArray
from sfm.model.errors import OutputError, missing_library

HEAD = "ASTM-E57"  # first bytes of a file
EXTENSION, URI = "kolinear", "urn:kolinear:standard-deviations:1"
AXES = ("cartesianX", "cartesianY", "cartesianZ")
SIGMAS = tuple(f"{EXTENSION}:s{axis}" for axis in "XYZ")


def load_pye57() -> Any:
    """Return pye57.

    Raises:
        MissingLibraryError: pye57 is not installed.
    """
    try:
        import pye57
    except ImportError as error:
        raise missing_library("format e57", ("pye57",), "exchange") from error
    return pye57


def read_e57(path: Path) -> Content:
    """Read the points of all scans, in m, with standard deviations if all scans have them.

    Raises:
        SurveyFileError: damaged, too many points, or a coordinate that is no reasonable number.
        MissingLibraryError: pye57 is not installed.
    """
    pye57 = load_pye57()
    scans: list[FloatArray] = []
    sigmas: list[FloatArray | None] = []
    with reading(path, "E57"), pye57.E57(str(path)) as file:
        headers = [file.get_header(k) for k in range(file.scan_count)]
        refuse_large(path, sum(header.point_count for header in headers))
        for k, header in enumerate(headers):
            if not header.point_count:
                continue
            data = file.read_scan(k, ignore_missing_fields=True)
            scans.append(np.column_stack([np.asarray(data[axis], dtype=float) for axis in AXES]))
            if not set(header.point_fields).issuperset(SIGMAS) or len(scans[-1]) != header.point_count:
                sigmas.append(None)
                continue
            # pye57 knows no fields of standard deviations
            values = [np.empty(header.point_count) for _ in SIGMAS]
            buffers = pye57.libe57.VectorSourceDestBuffer()
            for name, column in zip(SIGMAS, values, strict=True):
                buffers.append(
                    pye57.libe57.SourceDestBuffer(
                        file.image_file, name, column, header.point_count, True, True
                    )
                )
            header.points.reader(buffers).read()
            sigmas.append(np.column_stack(values))
        root = file.image_file.root()
        crs = root["coordinateMetadata"].value() if root.isDefined("coordinateMetadata") else ""
    xyz = np.concatenate([np.zeros((0, 3)), *scans])
    refuse_unusable(path, xyz)
    known = [sigma for sigma in sigmas if sigma is not None]
    sigma = np.concatenate(known) if len(known) == len(sigmas) else None
    return content_of_points(path.name, xyz, sigma, unit="m", crs=crs)


def write_e57(path: Path, content: Content) -> None:
    """Write the points that have coordinates as one scan.

    Raises:
        OutputError: the file cannot be written.
        MissingLibraryError: pye57 is not installed.
    """
    pye57 = load_pye57()
    lib = pye57.libe57
    xyz, sigma = points_of(content)
    metres = METRES.get(content.result.unit, 1.0)
    columns = dict(zip(AXES, (metres * xyz).T, strict=True))
    if sigma is not None:
        columns |= dict(zip(SIGMAS, (metres * sigma).T, strict=True))
    with whole_file(path) as part:
        try:
            image = lib.ImageFile(str(part), "w")
            try:
                _write_scan(lib, image, content, columns)
            finally:
                image.close()
        except lib.E57Exception as error:
            refuse_full(part.parent)
            raise OutputError(f"{path}: cannot be written ({reason_of(error)})") from error


def _write_scan(lib: Any, image: Any, content: Content, columns: dict[str, FloatArray]) -> None:
    """Write columns of numbers as the only scan of a file."""

    def structure(**values: float) -> Any:
        node = lib.StructureNode(image)
        for name, value in values.items():
            node.set(name, lib.FloatNode(image, value))
        return node

    root, scan, bounds, prototype = image.root(), structure(), structure(), structure()
    image.extensionsAdd("", lib.E57_V1_0_URI)
    image.extensionsAdd(EXTENSION, URI)
    created = structure(dateTimeValue=0.0)
    created.set("isAtomicClockReferenced", lib.IntegerNode(image, 0))
    scans = lib.VectorNode(image, True)
    for name, node in (
        ("formatName", lib.StringNode(image, "ASTM E57 3D Imaging Data File")),
        ("guid", lib.StringNode(image, f"{{{uuid.uuid4()}}}")),
        ("versionMajor", lib.IntegerNode(image, lib.E57_FORMAT_MAJOR)),
        ("versionMinor", lib.IntegerNode(image, lib.E57_FORMAT_MINOR)),
        ("e57LibraryVersion", lib.StringNode(image, lib.E57_LIBRARY_ID)),
        ("coordinateMetadata", lib.StringNode(image, content.crs)),
        ("creationDateTime", created),
        ("data3D", scans),
        ("images2D", lib.VectorNode(image, True)),
    ):
        root.set(name, node)
    scan.set("guid", lib.StringNode(image, f"{{{uuid.uuid4()}}}"))
    scan.set("name", lib.StringNode(image, content.result.name))
    buffers = lib.VectorSourceDestBuffer()
    arrays = {name: np.ascontiguousarray(values) for name, values in columns.items()}
    for name, values in arrays.items():
        low, high = float(values.min()), float(values.max())
        prototype.set(name, lib.FloatNode(image, low, lib.E57_DOUBLE, low, high))
        buffers.append(lib.SourceDestBuffer(image, name, values, len(values), True, True))
        if name in AXES:
            axis = name[-1].lower()
            bounds.set(f"{axis}Minimum", lib.FloatNode(image, low))
            bounds.set(f"{axis}Maximum", lib.FloatNode(image, high))
    scan.set("cartesianBounds", bounds)
    points = lib.CompressedVectorNode(image, prototype, lib.VectorNode(image, True))
    scan.set("points", points)
    scans.append(scan)
    writer = points.writer(buffers)
    writer.write(len(next(iter(arrays.values()))))
    writer.close()
