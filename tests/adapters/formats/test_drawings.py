"""Meshes that are read, and drawings that are written."""

from __future__ import annotations

import io
import os
import struct
import subprocess
import sys
import zipfile
from pathlib import Path

import ezdxf
import ezdxf.units
import numpy as np
import pytest
import trimesh

from adapters.formats.dxf import DxfCircle, DxfLine, write_dxf
from adapters.formats.mesh import read_mesh
from sfm.model.errors import MissingLibraryError, SurveyFileError
from tests.places import ROOT

CORNERS = np.array([[0.0, 0, 0], [2, 0, 0], [2, 3, 0], [0, 3, 0.5]])


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


def obj() -> bytes:
    corners = "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS)
    return f"mtllib /etc/passwd\n{corners}usemtl steel\nf 1 2 3\nusemtl brass\nf 1/1 3/1 4/1\n".encode()


def mesh_3mf(copies: int = 0, nested: int = 0) -> bytes:
    """Return a file of the body, placed once, or `copies` times on each of several levels."""
    body = trimesh.Trimesh(CORNERS, [[0, 1, 2], [0, 2, 3]], process=False)
    packed = trimesh.exchange.threemf.export_3MF(trimesh.Scene({"body": body}))
    if not copies:
        return packed
    corner = "".join(f'<vertex x="{x}" y="{y}" z="{z}"/>' for x, y, z in CORNERS)
    objects = (
        f'<object id="1"><mesh><vertices>{corner}</vertices><triangles><triangle v1="0" v2="1" v3="2"/>'
        "</triangles></mesh></object>"
    )
    for level in range(2, nested + 2):
        component = f'<component objectid="{level - 1}"/>'
        objects += f'<object id="{level}"><components>{copies * component}</components></object>'
    model = (
        '<model unit="millimeter" xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">'
        f'<resources>{objects}</resources><build><item objectid="{nested + 1}"/></build></model>'
    )
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("3D/3dmodel.model", model)
    return file.getvalue()


FILES = {
    "text.stl": (stl_text(CORNERS), 1),
    "binary.stl": (stl_binary(CORNERS), 1),
    "text.ply": (ply("ascii"), 2),
    "little.ply": (ply("binary_little_endian"), 2),
    "big.PLY": (ply("binary_big_endian"), 2),
    "text.obj": (obj(), 2),
    "packed.3mf": (mesh_3mf(), 2),
}


@pytest.mark.parametrize("name", FILES)
def test_meshes_are_read(name: str, tmp_path: Path) -> None:
    data, count = FILES[name]
    (tmp_path / name).write_bytes(data)
    vertices, triangles = read_mesh(tmp_path / name)
    assert len(triangles) == count
    a, b, c = vertices[triangles].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a) / 2  # with the order of the corners
    expected = [np.cross(CORNERS[1] - CORNERS[0], CORNERS[2] - CORNERS[0]) / 2]
    if count == 2:
        expected.append(np.cross(CORNERS[2] - CORNERS[0], CORNERS[3] - CORNERS[0]) / 2)
    np.testing.assert_allclose(sorted(normals.tolist()), sorted(np.array(expected).tolist()))
    np.testing.assert_allclose(np.unique(vertices[triangles].reshape(-1, 3), axis=0),
                               np.unique(CORNERS[: count + 2], axis=0))  # fmt: skip


@pytest.mark.parametrize(
    ("name", "data", "told"),
    [
        ("a.off", b"OFF", "unknown ending '.off', a mesh is .stl or .ply or .obj or .3mf"),
        ("a.stl", b"", "neither a binary STL file of the size that it states, nor a text"),
        ("a.stl", stl_binary(CORNERS)[:-1], "no readable STL file|no triangles"),
        ("a.stl", b"solid x\nvertex 1 2 3\nendsolid", "no readable STL file"),
        ("a.stl", stl_text(np.full((3, 3), np.nan)), "a coordinate is not a finite number"),
        ("a.stl", b"solid x\nendsolid", "no triangles, at least one is needed"),
        ("a.stl", stl_binary(np.full((3, 3), np.inf)), "a coordinate is not a finite number"),
        ("a.ply", b"plx", "line 1: not a PLY file"),
        ("a.ply", ply("ascii").replace(b"4 0 1 2 3", b"4 0 1 2 9"), "vertex 9 of a triangle, the mesh has 4"),
        ("a.ply", ply("ascii").replace(b"4 0 1 2 3", b"4 0 1 2 x"), "no readable PLY file"),
        ("a.ply", ply("ascii").replace(b"vertex 4", b"vertex x"), "no readable PLY file"),
        ("a.ply", ply("ascii").replace(b"face 1", b"face 999999999"), "1000000003 elements do not fit in"),
        ("a.ply", ply("ascii").replace(b"face 1", b"face 9"), "4 vertices and 2 triangles, its header anno"),
        ("a.ply", ply("binary_little_endian")[:-3], "no readable PLY file"),
        ("a.ply", ply("ascii").replace(b"format ascii", b"format middle"), "no readable PLY file"),
        ("a.obj", b"v 0 0 0\n", "no triangles, at least one is needed"),
        ("a.obj", obj().replace(b"f 1 2 3", b"f 1 2 9"), "no readable OBJ file"),
        ("a.3mf", b"PK", "no readable 3MF file"),
        ("a.3mf", mesh_3mf()[:-40], "no readable 3MF file"),
        ("a.3mf", mesh_3mf(copies=2, nested=19), "places more than 10000 bodies"),
        ("a.3mf", mesh_3mf(copies=1, nested=25), "bodies are nested more than 20 deep"),
    ],
)  # fmt: skip
def test_what_is_no_mesh_is_refused(name: str, data: bytes, told: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(data)
    with np.errstate(invalid="ignore"), pytest.raises(SurveyFileError, match=told) as refusal:
        read_mesh(tmp_path / name)
    assert "\n" not in str(refusal.value)


def test_copies_of_a_body_are_one_mesh(tmp_path: Path) -> None:
    (tmp_path / "a.3mf").write_bytes(mesh_3mf(copies=3, nested=2))
    vertices, triangles = read_mesh(tmp_path / "a.3mf")
    assert len(triangles) == 9
    np.testing.assert_allclose(vertices[triangles], np.broadcast_to(CORNERS[:3], (9, 3, 3)))


def test_a_file_that_unpacks_to_too_many_bytes_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.3mf").write_bytes(mesh_3mf(copies=5000, nested=1))
    monkeypatch.setattr("adapters.formats.mesh.MAX_BYTES", 20_000)
    with pytest.raises(SurveyFileError, match=r"unpacks to \d+ bytes, at most 20000"):
        read_mesh(tmp_path / "a.3mf")


def test_a_missing_library_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.3mf").write_bytes(mesh_3mf())
    monkeypatch.setitem(sys.modules, "networkx", None)
    with pytest.raises(MissingLibraryError, match=r"mesh .3mf needs trimesh and lxml and networkx; install"):
        read_mesh(tmp_path / "a.3mf")


def test_a_drawing_has_names_as_text_and_a_layer_for_each_group(tmp_path: Path) -> None:
    normal, centre = np.array([0.0, 0.6, 0.8]), np.array([1.0, 2.0, 3.0])
    names, layers = ("101", "Tür\n2"), ("rim", "the <rest>")
    for name in ("a.dxf", "b.dxf"):
        write_dxf(
            tmp_path / name,
            names,
            CORNERS[:2],
            layers,
            unit="mm",
            lines=[DxfLine("axes", CORNERS[0], CORNERS[2])],
            circles=[DxfCircle("Rim", centre, normal, 0.75)],
            texts=[("holes", "bore 1", centre)],
        )
    assert (tmp_path / "a.dxf").read_bytes() == (tmp_path / "b.dxf").read_bytes()
    drawing = ezdxf.readfile(tmp_path / "a.dxf")
    assert not drawing.audit().has_errors
    assert drawing.dxfversion == "AC1032" and drawing.header["$INSUNITS"] == ezdxf.units.MM
    assert drawing.header["$EXTMAX"] == (2.0, 3.0, 3.0)
    assert {"rim", "the _rest_", "axes", "holes"} < {layer.dxf.name for layer in drawing.layers}
    space = drawing.modelspace()
    assert [text.dxf.text for text in space.query("TEXT")] == ["101", "Tür 2", "bore 1"]
    points = np.array([point.dxf.location for point in space.query("POINT")])
    np.testing.assert_array_equal(points, CORNERS[:2])
    (line,), (circle,) = space.query("LINE"), space.query("CIRCLE")
    assert (tuple(line.dxf.start), tuple(line.dxf.end)) == (tuple(CORNERS[0]), tuple(CORNERS[2]))
    assert circle.dxf.radius == 0.75 and circle.dxf.layer.lower() == "rim"
    np.testing.assert_allclose(circle.ocs().to_wcs(circle.dxf.center), centre)
    np.testing.assert_allclose(circle.dxf.extrusion, normal)


@pytest.mark.parametrize(("unit", "code"), [("m", 6), ("in", 1), ("", 0), ("object units", 0)])
def test_a_drawing_has_the_unit_of_the_survey(unit: str, code: int, tmp_path: Path) -> None:
    write_dxf(tmp_path / "a.dxf", ("1",), CORNERS[:1], ("0",), unit=unit)
    assert ezdxf.readfile(tmp_path / "a.dxf").header["$INSUNITS"] == code


def test_settings_of_a_received_folder_change_no_drawing(tmp_path: Path) -> None:
    """The library reads ezdxf.ini of the current folder when it is imported."""
    draw = (
        "import sys, numpy; from pathlib import Path; from adapters.formats.dxf import write_dxf;"
        "write_dxf(Path(sys.argv[1]), ('1',), numpy.zeros((1, 3)), ('0',)); import ezdxf;"
        "print(ezdxf.options.support_dirs)"
    )

    def drawn(settings: str) -> subprocess.CompletedProcess[str]:
        (tmp_path / "ezdxf.ini").write_text(settings)
        command = [sys.executable, "-c", draw, str(tmp_path / "a.dxf")]
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        return subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)

    usual = drawn("[core]\nSUPPORT_DIRS = /somewhere\n")
    assert usual.returncode == 0 and "somewhere" not in usual.stdout
    damaged = drawn("SUPPORT_DIRS = 1\n")
    assert "OutputError: ezdxf.ini: ezdxf cannot read its settings" in damaged.stderr
