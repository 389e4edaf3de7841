"""Points as LAZ, LAS and E57, read back by their own libraries."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapters.formats.content import Content, losses
from adapters.formats.registry import format_named, format_of, read_content, write_content
from sfm.model.errors import MissingLibraryError, OutputError, SurveyFileError
from sfm.model.solution import Solution
from tests import commands
from tests.adapters.formats.clouds import WITHOUT, library
from tests.places import SHARED
from tests.synthetic import make_network, seed_of

FORMATS = {"laz": ("laspy", "cloud.laz"), "e57": ("pye57", "cloud.e57")}


def cloud(name: str, *, sigma: bool = True, far: float = 0.0) -> Content:
    """Points of a survey in m, some of them without coordinates, with covariances."""
    rng = seed_of(name)
    network, truth = make_network(rng, points=300)
    points = 500 * truth.points + (far, 10 * far, 100.0)
    points[::50] = np.nan
    A = 1e-3 * rng.standard_normal((300, 3, 3))
    C = A @ A.transpose(0, 2, 1) if sigma else None
    estimate = replace(truth, points=points)
    return Content(Solution("survey", network, estimate, point_covariance=C, unit="m"))


def written(content: Content, form: str, tmp_path: Path) -> Path:
    path = tmp_path / FORMATS[form][1]
    write_content(path, form, content)
    return path


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("far", [0.0, 500_000.0])
def test_points_are_read_back_to_a_micrometre(form: str, far: float, tmp_path: Path) -> None:
    """Also by the library of the format, and with coordinates of a national grid."""
    lib = library(form)
    assert lib is not None
    content = cloud(f"cloud {form}", far=far)
    path = written(content, form, tmp_path)
    known = content.result.estimate.determined
    xyz = content.result.estimate.points[known]
    C = content.result.point_covariance
    assert C is not None and format_of(path).name == form
    again = read_content(path)
    np.testing.assert_allclose(again.result.estimate.points, xyz, rtol=0, atol=1e-6)
    sigma = np.sqrt(np.diagonal(C, axis1=1, axis2=2))[known]
    covariance = again.result.point_covariance
    assert covariance is not None and not again.notes
    np.testing.assert_allclose(np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)), sigma, rtol=1e-12)
    if form == "laz":
        theirs = lib.read(path)
        columns = np.column_stack([theirs.x, theirs.y, theirs.z])
    else:
        with lib.E57(str(path)) as file:
            data = file.read_scan(0, ignore_missing_fields=True)
        columns = np.column_stack([data[f"cartesian{axis}"] for axis in "XYZ"])
    np.testing.assert_allclose(columns, xyz, rtol=0, atol=1e-6)


@pytest.mark.parametrize("form", FORMATS)
def test_what_a_cloud_loses_is_named(form: str, tmp_path: Path) -> None:
    library(form)
    content = cloud("lost", sigma=False)
    assert read_content(written(content, form, tmp_path)).result.point_covariance is None
    lost = {kind.name for kind, _ in losses(content, format_named(form).held(content))}
    assert {"image points", "point names", "exterior orientations"} <= lost and "object points" not in lost


@pytest.mark.parametrize("form", FORMATS)
def test_the_coordinate_system_is_carried(form: str, tmp_path: Path) -> None:
    library(form)
    CRS = pytest.importorskip("pyproj", reason=WITHOUT).CRS
    content = replace(cloud("system"), crs=CRS.from_epsg(32632).to_wkt())
    other = {"laz": "e57", "e57": "laz"}[form]
    library(other)
    first = read_content(written(content, form, tmp_path))
    second = read_content(written(first, other, tmp_path))
    for read in (first, second):
        assert CRS.from_wkt(read.crs).equals(CRS.from_epsg(32632))


def test_e57_is_in_metres(tmp_path: Path) -> None:
    library("e57")
    content = cloud("millimetres")
    content = replace(content, result=replace(content.result, unit="mm"))
    again = read_content(written(content, "e57", tmp_path)).result
    known = content.result.estimate.determined
    assert again.unit == "m"
    np.testing.assert_allclose(1000 * again.estimate.points, content.result.estimate.points[known], atol=1e-9)


@pytest.mark.parametrize("form", FORMATS)
def test_damaged_clouds_are_refused_in_one_line(form: str, tmp_path: Path) -> None:
    library(form)
    path = written(cloud("damaged"), form, tmp_path)
    data = path.read_bytes()
    for k, part in enumerate((data[:60], data[: len(data) // 2], data[:400] + b"\xff" * 500 + data[900:])):
        damaged = tmp_path / f"damaged {k}{path.suffix}"
        damaged.write_bytes(part)
        with pytest.raises(SurveyFileError, match=r"damaged \d\.\w+: no readable|a coordinate is") as refused:
            read_content(damaged)
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize("form", FORMATS)
def test_the_extra_is_named_where_it_is_missing(
    form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, FORMATS[form][0], None)
    path = tmp_path / FORMATS[form][1]
    with pytest.raises(MissingLibraryError, match=rf"format {form} needs .*kolinear\[exchange\]"):
        write_content(path, form, cloud("missing"))
    assert not path.exists()
    path.write_bytes(b"LASF" if form == "laz" else b"ASTM-E57")
    with pytest.raises(MissingLibraryError, match=rf"format {form} needs"):
        read_content(path)


def test_points_without_coordinates_are_no_cloud(tmp_path: Path) -> None:
    content = cloud("no coordinates")
    estimate = content.result.estimate
    nowhere = replace(estimate, points=np.full_like(estimate.points, np.nan))
    with pytest.raises(OutputError, match="format laz needs coordinates"):
        written(replace(content, result=replace(content.result, estimate=nowhere)), "laz", tmp_path)


def test_a_cloud_is_converted_and_audited_by_commands(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for form in FORMATS:
        library(form)
    path = written(cloud("command"), "laz", tmp_path)
    assert commands.kolinear("convert", path, tmp_path / "again.e57") == 0
    assert "294 points as e57" in capsys.readouterr().out
    assert commands.kolinear("convert", path, tmp_path / "points.ply") == 0
    assert commands.kolinear("audit", path, "--out", tmp_path / "audit") == 2
    assert "points alone cannot be tested" in capsys.readouterr().err


@pytest.mark.skipif(not (SHARED / "data" / "formats" / "simple.laz").is_file(), reason="needs ../shared")
def test_a_file_of_another_program_is_read() -> None:
    lib = library("laz")
    assert lib is not None
    path = SHARED / "data" / "formats" / "simple.laz"
    theirs = lib.read(path)
    points = read_content(path).result.estimate.points
    np.testing.assert_allclose(points, np.column_stack([theirs.x, theirs.y, theirs.z]), atol=1e-9)
