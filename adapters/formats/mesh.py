"""Triangle meshes in STL and PLY (binary and text), read as untrusted files.

Polygons in PLY are split into triangles from their first corner. The size stated in a file is checked against
its actual size before memory is allocated.

Source: 3D Systems (1989), StereoLithography Interface Specification; Turk (1994), The PLY polygon file
format.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from adapters.reading.text_lines import Lines
from sfm.files.csv_tables import MAX_NUMBER
from sfm.files.plain_text import shorten
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.errors import SurveyFileError

MAX_BYTES = 1_000_000_000
STL_HEADER, STL_RECORD = 84, 50  # bytes
MAX_CORNERS = 255  # of a polygon
MAX_PROPERTIES = 100
MAX_HEADER = 100_000  # bytes of a PLY header
TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip


def read_mesh(path: Path) -> tuple[FloatArray, IntArray]:
    """Read the triangles of an STL or PLY file.

    Returns:
        Vertices (v, 3) and the indices of the vertices of each triangle (t, 3).

    Raises:
        SurveyFileError: the file is not a valid mesh.
    """
    try:
        if not path.is_file():
            raise SurveyFileError(f"{path}: not a file, a mesh (.stl or .ply) is needed")
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise SurveyFileError(f"{path}: {size} bytes, at most {MAX_BYTES} are read")
        with path.open("rb") as file:
            first = file.read(STL_HEADER)
        if path.suffix.lower() == ".ply":
            vertices, triangles = _read_ply(path, path.read_bytes())
        elif path.suffix.lower() == ".stl":
            count = int.from_bytes(first[80:84], "little")
            binary = size == STL_HEADER + STL_RECORD * count and size > STL_HEADER
            if binary:
                record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
                corners = np.fromfile(path, dtype=record, offset=STL_HEADER)["corners"].astype(float)
            else:
                corners = _text_corners(path)
            vertices = corners.reshape(-1, 3)  # shared by no two triangles
            triangles = np.arange(len(vertices), dtype=np.int64).reshape(-1, 3)
        else:
            raise SurveyFileError(f"{path}: unknown ending {path.suffix!r:.40}, a mesh is .stl or .ply")
    except OSError as error:
        raise SurveyFileError(f"{path}: cannot be read: {error.strerror or error}") from error
    if not len(triangles):
        raise SurveyFileError(f"{path}: no triangles, at least one is needed")
    if not (np.abs(vertices) <= MAX_NUMBER).all():
        raise SurveyFileError(f"{path}: a coordinate is not a finite number of at most {MAX_NUMBER:g}")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise SurveyFileError(
            f"{path}: vertex {triangles.max()} of a triangle, the mesh has {len(vertices)} (counted from 0)"
        )
    return vertices, triangles


def _text_corners(path: Path) -> FloatArray:
    """Return the corners of the triangles of a text STL file, (t, 3, 3)."""
    text = Lines.of(path)
    first = (text.maybe_line() or "").split()
    if first[:1] != ["solid"]:
        text.number = 1
        raise text.error(
            "neither a binary STL file of the size that it states, nor a text that begins with 'solid'"
        )
    corners: list[float] = []
    while (line := text.maybe_line()) is not None:
        words = line.split()
        if words[:1] == ["vertex"]:
            if len(words) != 4:
                raise text.error(f"'{shorten(line)}', needed 'vertex X Y Z'")
            corners += [text.number_of(word) for word in words[1:]]
    if len(corners) % 9:
        raise text.error(f"{len(corners) // 3} vertices, each triangle needs three")
    return np.array(corners).reshape(-1, 3, 3)


def _read_ply(path: Path, data: bytes) -> tuple[FloatArray, IntArray]:
    end = data.find(b"end_header", 0, MAX_HEADER)
    after = data.find(b"\n", end)
    if not data.startswith(b"ply") or end < 0 or after < 0:
        raise SurveyFileError(f"{path}, line 1: not a PLY file, needed 'ply' and a header")
    lines = data[:end].decode("ascii", errors="replace").splitlines()
    form = ""
    elements: list[tuple[str, int, list[tuple[str, ...]]]] = []
    for number, line in enumerate(lines, 1):
        words = line.split()
        where = f"{path}, line {number}: '{shorten(line)}'"
        if words[:1] == ["format"] and len(words) > 1:
            form = words[1]
        elif words[:1] == ["element"]:
            if len(words) != 3 or not words[2].isdecimal() or len(words[2]) > 10:
                raise SurveyFileError(f"{where}, needed 'element NAME COUNT'")
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            known = len(words) == 3 and words[1] in TYPES
            listed = len(words) == 5 and words[1] == "list" and {words[2], words[3]} <= TYPES.keys()
            if not elements or not (known or listed) or len(elements[-1][2]) >= MAX_PROPERTIES:
                raise SurveyFileError(f"{where}, needed 'property TYPE NAME' of an element")
            elements[-1][2].append(tuple(words[1:]))
    if form not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise SurveyFileError(f"{path}: format {shorten(form) or 'missing'}, expected ascii or binary")
    reader = _Values(path, data[after + 1 :], form)
    vertices, triangles = np.empty((0, 3)), np.empty((0, 3), dtype=np.int64)
    for name, count, properties in elements:
        if name == "vertex":
            vertices = reader.table(count, properties)
        elif name == "face":
            triangles = reader.faces(count, properties)
            break
        else:
            reader.faces(count, properties, keep=False)
    return vertices, triangles


class _Values:
    """Reads the values of a PLY file one after another."""

    def __init__(self, path: Path, data: bytes, form: str) -> None:
        self.path, self.form, self.at = path, form, 0
        self.order = ">" if form == "binary_big_endian" else "<"
        self.words = data.split() if form == "ascii" else []
        self.data = data

    def table(self, count: int, properties: list[tuple[str, ...]]) -> FloatArray:
        """Read the vertices, which have no lists, and return their coordinates.

        Raises:
            SurveyFileError: vertices without x, y and z.
        """
        names = [entry[-1] for entry in properties]
        if not {"x", "y", "z"} <= set(names) or any(entry[0] == "list" for entry in properties):
            raise SurveyFileError(f"{self.path}: the vertices lack x, y and z, or have lists")
        if self.form == "ascii":
            rows = self._words(count * len(names)).reshape(count, len(names))
            return rows[:, [names.index(axis) for axis in "xyz"]]
        record = np.dtype([(f"{k}", self.order + TYPES[entry[0]]) for k, entry in enumerate(properties)])
        packed = np.frombuffer(self._bytes(count * record.itemsize), dtype=record)
        return np.stack([packed[f"{names.index(axis)}"] for axis in "xyz"], axis=1).astype(float)

    def faces(self, count: int, properties: list[tuple[str, ...]], keep: bool = True) -> IntArray:
        """Read an element with lists row by row, and return the polygons of the first list as triangles.

        Raises:
            SurveyFileError: a polygon has too few or too many corners, or elements outnumber bytes.
        """
        triangles: list[tuple[int, int, int]] = []
        if count * max(len(properties), 1) > len(self.data):
            raise SurveyFileError(f"{self.path}: {count} elements do not fit in {len(self.data)} bytes")
        for _ in range(count if properties else 0):
            polygon: list[int] | None = None
            for entry in properties:
                many = 1
                if entry[0] == "list":
                    many = int(self._numbers(1, entry[1])[0])
                    if not 0 <= many <= MAX_CORNERS:
                        raise SurveyFileError(f"{self.path}: a polygon of {many} corners")
                values = self._numbers(many, entry[2] if entry[0] == "list" else entry[0])
                if entry[0] == "list" and polygon is None:
                    polygon = [int(value) for value in values]
            if keep and polygon is not None:
                triangles += [(polygon[0], polygon[k], polygon[k + 1]) for k in range(1, len(polygon) - 1)]
        return np.array(triangles, dtype=np.int64).reshape(-1, 3)

    def _numbers(self, count: int, kind: str) -> FloatArray:
        if self.form == "ascii":
            return self._words(count)
        dtype = np.dtype(self.order + TYPES[kind])
        return np.frombuffer(self._bytes(count * dtype.itemsize), dtype=dtype).astype(float)

    def _bytes(self, count: int) -> bytes:
        part = self.data[self.at : self.at + count]
        if len(part) < count:
            raise SurveyFileError(f"{self.path}: ends before the last value that its header announces")
        self.at += count
        return part

    def _words(self, count: int) -> FloatArray:
        part = self.words[self.at : self.at + count]
        if len(part) < count:
            raise SurveyFileError(f"{self.path}: ends before the last value that its header announces")
        self.at += count
        try:
            return np.array([float(word) for word in part])
        except ValueError as error:
            raise SurveyFileError(f"{self.path}: a value is not a number") from error
