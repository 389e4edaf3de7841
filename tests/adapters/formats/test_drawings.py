"""Meshes that are read, and drawings that are written."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from adapters.formats.dxf import DxfCircle, DxfLine, write_dxf
from adapters.formats.mesh import read_mesh
from sfm.model.errors import SurveyFileError

CORNERS = np.array([[0.0, 0, 0], [2, 0, 0], [2, 3, 0], [0, 3, 0.5]])
AREA = 3.0  # of the first triangle


def stl_text(corners: np.ndarray) -> bytes:
    vertices = "".join(f"vertex {x} {y} {z}\n" for x, y, z in corners[:3])
    return f"solid x\nfacet normal 0 0 1\nouter loop\n{vertices}endloop\nendfacet\nendsolid x\n".encode()


def stl_binary(corners: np.ndarray) -> bytes:
    record = struct.pack("<12fH", 0, 0, 1, *corners[:3].ravel(), 0)
    return b"solid is said of binary files, too".ljust(80) + struct.pack("<I", 1) + record


def ply(form: str) -> bytes:
    head = (
        f"ply\nformat {form} 1.0\ncomment x\n"
        "element vertex 4\nproperty float x\nproperty double y\n"
        "property float z\nproperty uchar red\nelement face 1\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    if form == "ascii":
        return (head + "".join(f"{x} {y} {z} 7\n" for x, y, z in CORNERS) + "4 0 1 2 3\n").encode()
    sign = "<" if "little" in form else ">"
    rows = b"".join(struct.pack(f"{sign}fdfB", *corner, 7) for corner in CORNERS)
    return head.encode() + rows + struct.pack(f"{sign}B4i", 4, 0, 1, 2, 3)


FILES = {
    "text.stl": (stl_text(CORNERS), 1),
    "binary.stl": (stl_binary(CORNERS), 1),
    "text.ply": (ply("ascii"), 2),
    "little.ply": (ply("binary_little_endian"), 2),
    "big.PLY": (ply("binary_big_endian"), 2),
}


@pytest.mark.parametrize("name", FILES)
def test_meshes_are_read(name: str, tmp_path: Path) -> None:
    data, count = FILES[name]
    (tmp_path / name).write_bytes(data)
    vertices, triangles = read_mesh(tmp_path / name)
    assert len(triangles) == count
    np.testing.assert_allclose(vertices[triangles[0]], CORNERS[:3])
    a, b, c = vertices[triangles[0]]
    assert np.linalg.norm(np.cross(b - a, c - a)) / 2 == AREA
    if count == 2:
        np.testing.assert_allclose(vertices[triangles[1]], CORNERS[[0, 2, 3]])


@pytest.mark.parametrize(
    ("name", "data", "told"),
    [
        ("a.obj", b"v 0 0 0", "unknown ending '.obj', a mesh is .stl or .ply"),
        ("a.stl", b"", "neither a binary STL file of the size that it states, nor a text"),
        ("a.stl", stl_binary(CORNERS)[:-1], "no triangles"),
        ("a.stl", b"solid x\nvertex 1 2 3\nendsolid", "1 vertices, each triangle needs three"),
        ("a.stl", b"solid x\nvertex 1 2 nan\nendsolid", "line 2"),
        ("a.stl", b"solid x\nendsolid", "no triangles, at least one is needed"),
        ("a.stl", stl_binary(np.full((3, 3), np.inf)), "a coordinate is not a finite number"),
        ("a.ply", b"plx", "line 1: not a PLY file"),
        ("a.ply", ply("ascii").replace(b"4 0 1 2 3", b"4 0 1 2 9"), "vertex 9 of a triangle, the mesh has 4"),
        ("a.ply", ply("ascii").replace(b"4 0 1 2 3", b"4 0 1 2"), "ends before the last value"),
        ("a.ply", ply("ascii").replace(b"4 0 1 2 3", b"4 0 1 2 x"), "a value is not a number"),
        ("a.ply", ply("ascii").replace(b"vertex 4", b"vertex x"), "line 4: 'element vertex x', needed"),
        ("a.ply", ply("ascii").replace(b"face 1", b"face 999999999"), "do not fit in"),
        ("a.ply", ply("binary_little_endian")[:-3], "ends before the last value"),
        ("a.ply", ply("ascii").replace(b"format ascii", b"format middle"), "format middle, expected ascii"),
    ],
)  # fmt: skip
def test_what_is_no_mesh_is_refused(name: str, data: bytes, told: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(data)
    with np.errstate(invalid="ignore"), pytest.raises(SurveyFileError, match=told):
        read_mesh(tmp_path / name)


def test_a_drawing_has_names_as_text_and_a_layer_for_each_group(tmp_path: Path) -> None:
    path = tmp_path / "a.dxf"
    normal = np.array([0.0, 0.6, 0.8])
    centre = np.array([1.0, 2.0, 3.0])
    write_dxf(
        path,
        ("101", "Tür"),
        CORNERS[:2],
        ("rim", "the rest"),
        lines=[DxfLine("axes", CORNERS[0], CORNERS[2])],
        circles=[DxfCircle("holes", centre, normal, 0.75)],
        texts=[("holes", "bore 1", centre)],
    )
    lines = path.read_text(encoding="ascii").splitlines()
    pairs = list(zip(map(int, lines[::2]), lines[1::2], strict=True))
    assert pairs[0] == (0, "SECTION") and pairs[-1] == (0, "EOF")
    assert [value for code, value in pairs if code == 1][1:] == ["101", "T\\U+00FCr", "bore 1"]
    layers = [pairs[k + 1][1] for k, pair in enumerate(pairs) if pair == (0, "LAYER")]
    assert layers == ["0", "rim", "the_rest", "axes", "holes"]
    at = pairs.index((0, "CIRCLE"))
    own = [float(value) for code, value in pairs[at : at + 10] if code in (10, 20, 30)]
    # the arbitrary axes of this normal: x = Z x n, y = n x X
    x = np.cross([0, 0, 1.0], normal) / 0.6
    np.testing.assert_allclose(own, [x @ centre, np.cross(normal, x) @ centre, normal @ centre])
