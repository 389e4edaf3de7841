"""Triangle meshes in STL, PLY, OBJ and 3MF, read as untrusted files by trimesh of kolinear[exchange].

Polygons are split into triangles. What a file states is checked before trimesh takes memory for it, and its
numbers afterwards.

Source: 3D Systems (1989), StereoLithography Interface Specification; Turk (1994), The PLY polygon file
format; Wavefront (1995), Object Files (.obj); 3MF Consortium (2018), 3D Manufacturing Format 1.2.
"""

from __future__ import annotations

import re
import zipfile
from collections import Counter
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from adapters.formats.clouds import reading
from sfm.files.csv_tables import MAX_NUMBER
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.errors import SurveyFileError, missing_library

MAX_BYTES = 1_000_000_000
STL_HEADER, STL_RECORD = 84, 50  # bytes
MAX_BODIES, MAX_NESTING = 10_000, 20  # of a 3MF file, with all copies
MAX_HEADER = 100_000  # bytes of a PLY header
ENDINGS = (".stl", ".ply", ".obj", ".3mf")


def read_mesh(path: Path) -> tuple[FloatArray, IntArray]:
    """Read the triangles of a mesh; several bodies of a file become one mesh.

    Returns:
        Vertices (v, 3), in the unit of the file, and the indices of the vertices of each triangle (t, 3).

    Raises:
        SurveyFileError: the file is not a valid mesh.
        MissingLibraryError: trimesh is not installed, or for 3MF lxml or networkx.
    """
    ending = path.suffix.lower()
    if not path.is_file():
        raise SurveyFileError(f"{path}: not a file, a mesh ({', '.join(ENDINGS)}) is needed")
    if ending not in ENDINGS:
        raise SurveyFileError(f"{path}: unknown ending {path.suffix!r:.40}, a mesh is {' or '.join(ENDINGS)}")
    trimesh = _load_trimesh(ending)
    with reading(path, ending[1:].upper()):
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise SurveyFileError(f"{path}: {size} bytes, at most {MAX_BYTES} are read")
        data = path.read_bytes()
        stated = (0, 0)
        if ending == ".ply":
            stated = _stated_by_ply(path, data)
        elif ending == ".3mf":
            _refuse_bomb(path, data)
        elif ending == ".obj" or not _is_binary_stl(path, data):  # texts, of which names may be Latin-1
            data = data.decode("utf-8", errors="replace").encode()
        with np.errstate(invalid="ignore"):
            mesh = trimesh.load_mesh(BytesIO(data), file_type=ending[1:], process=False, skip_materials=True)
            if isinstance(mesh, trimesh.Scene):
                mesh = mesh.to_mesh()
        vertices = np.array(mesh.vertices, dtype=float).reshape(-1, 3)
        triangles = np.array(mesh.faces, dtype=np.int64).reshape(-1, 3)
    if len(vertices) < stated[0] or len(triangles) < stated[1]:
        raise SurveyFileError(
            f"{path}: {len(vertices)} vertices and {len(triangles)} triangles, its header announces "
            f"{stated[0]} and {stated[1]}"
        )
    if not len(triangles):
        raise SurveyFileError(f"{path}: no triangles, at least one is needed")
    if not (np.abs(vertices) <= MAX_NUMBER).all():
        raise SurveyFileError(f"{path}: a coordinate is not a finite number of at most {MAX_NUMBER:g}")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise SurveyFileError(
            f"{path}: vertex {triangles.max()} of a triangle, the mesh has {len(vertices)} (counted from 0)"
        )
    return vertices, triangles


def _load_trimesh(ending: str) -> Any:
    """Return trimesh, with the libraries that it needs for a kind of file.

    Raises:
        MissingLibraryError: one of them is not installed.
    """
    try:
        import trimesh

        if ending == ".3mf":
            import lxml.etree  # noqa: F401  both are used by trimesh
            import networkx  # noqa: F401
    except ImportError as error:
        libraries = ("trimesh", "lxml", "networkx") if ending == ".3mf" else ("trimesh",)
        raise missing_library(f"mesh {ending}", libraries, "exchange") from error
    return trimesh


def _is_binary_stl(path: Path, data: bytes) -> bool:
    """Return whether an STL file is binary, by the size that it states.

    Raises:
        SurveyFileError: it is neither binary nor text.
    """
    if len(data) > STL_HEADER and (
        len(data) == STL_HEADER + STL_RECORD * int.from_bytes(data[STL_HEADER - 4 : STL_HEADER], "little")
    ):
        return True
    if not data.lstrip().startswith(b"solid"):
        raise SurveyFileError(
            f"{path}: neither a binary STL file of the size that it states, nor a text that begins with "
            "'solid'"
        )
    return False


def _stated_by_ply(path: Path, data: bytes) -> tuple[int, int]:
    """Return the numbers of vertices and faces in the header of a PLY file.

    Raises:
        SurveyFileError: there is no header, or it announces more elements than the file has bytes.
    """
    end = data.find(b"end_header", 0, MAX_HEADER)
    if not data.startswith(b"ply") or end < 0:
        raise SurveyFileError(f"{path}, line 1: not a PLY file, needed 'ply' and a header")
    stated = {name: int(count) for name, count in re.findall(rb"element (\w+) (\d{1,12})\b", data[:end])}
    if sum(stated.values()) > len(data):
        raise SurveyFileError(f"{path}: {sum(stated.values())} elements do not fit in {len(data)} bytes")
    return stated.get(b"vertex", 0), stated.get(b"face", 0)


def _refuse_bomb(path: Path, data: bytes) -> None:
    """Refuse a 3MF file that unpacks to too many bytes, or places its bodies too often.

    Raises:
        SurveyFileError: it is such a file.
    """
    from lxml import etree

    parts: dict[str, list[str]] = {}  # objects of which an object is composed
    placed: list[str] = []
    with zipfile.ZipFile(BytesIO(data)) as archive:
        size = sum(entry.file_size for entry in archive.infolist())
        if size > MAX_BYTES:
            raise SurveyFileError(f"{path}: unpacks to {size} bytes, at most {MAX_BYTES} are read")
        for name in archive.namelist():
            if not name.lower().endswith(".model"):
                continue
            with archive.open(name) as file:
                owner: list[str] = []
                for event, element in etree.iterparse(
                    file,
                    events=("start", "end"),
                    tag=("{*}object", "{*}component", "{*}item"),
                    resolve_entities=False,
                ):
                    kind = etree.QName(element).localname
                    if kind == "object" and event == "start":
                        owner = parts.setdefault(element.get("id", ""), [])
                    elif event == "start":
                        (owner if kind == "component" else placed).append(element.get("objectid", ""))
                    else:
                        element.clear()
    count = Counter(placed)
    for _ in range(MAX_NESTING):
        below: Counter[str] = Counter()
        for outer, copies in count.items():
            for inner in parts.get(outer, ()):
                below[inner] += copies
        count = below
        if count.total() > MAX_BODIES:
            raise SurveyFileError(f"{path}: places more than {MAX_BODIES} bodies, no more are read")
    if count:
        raise SurveyFileError(f"{path}: bodies are nested more than {MAX_NESTING} deep")
