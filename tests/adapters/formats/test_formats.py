"""Every format: there and back to the last digit it stores, known traps, and files that are damaged."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from adapters.colmap.camera_models import read_model, write_model
from adapters.colmap.database import read_database, write_database
from adapters.formats.bal import read_bal, write_bal
from adapters.formats.bundle_text import (
    read_bundle_csharp,
    read_bundle_matlab,
    write_bundle_csharp,
    write_bundle_matlab,
)
from adapters.formats.metashape import read_metashape, write_metashape
from adapters.formats.photomodeler import read_photomodeler, write_photomodeler
from adapters.formats.registry import FORMATS as FILE_FORMATS
from adapters.formats.registry import (
    describe_stored,
    format_named,
    format_of,
    model_name,
    read_any,
    read_comparable,
    write_any,
)
from adapters.formats.sba_text import read_sba_text, write_sba_text
from sfm.cli.commands.convert import convert
from sfm.comparison.camera_conversion import convert_camera, convert_cameras, undistort
from sfm.comparison.significance import compare_results
from sfm.comparison.solutions import reprojection
from sfm.files.csv_tables import write_ply
from sfm.model.camera import Camera, camera_from_values, pixel_jacobian
from sfm.model.errors import KolinearError, OutputError, SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import Network, ObjectPoints
from tests.places import SHARED
from tests.synthetic import DISTORTION, make_network, seed_of
from tests.tables import rows_of


def network_in(
    model: str, *, values: tuple[tuple[str, float], ...] | None = None, full: bool = False
) -> tuple[Network, Estimate]:
    """A network of six photographs whose camera has the distortion that a format can hold."""
    network, truth = make_network(
        seed_of(f"formats {model}"),
        images=6,
        points=20,
        model=model,
        noise_px=0.2,
        visibility=1.0 if full else 0.7,
    )
    if values is not None:
        old = truth.cameras[0]
        pixel = (float(old.pixel_mm[0]), float(old.pixel_mm[1]))
        camera = camera_from_values(old.name, model, old.size_px, pixel, c_mm=10.0, values=values)
        other = replace(truth, cameras=(camera,))
        seen = network.image_points
        moved = seen.xy + reprojection(network, other) - reprojection(network, truth)
        network, truth = replace(network, image_points=replace(seen, xy=moved)), other
    return network, truth


@dataclass(frozen=True)
class Format:
    """How to write and read a format in a folder, and which network it can hold."""

    name: str
    made: tuple[Network, Estimate]
    write: Callable[[Path, Network, Estimate], None]
    read: Callable[[Path], tuple[Network, Estimate]]
    files: tuple[str, ...]
    names: bool = True  # whether names of photographs and points are kept
    camera: bool = True  # whether the camera is kept as it was


def _no_affinity() -> tuple[tuple[str, float], ...]:
    return tuple((name, value) for name, value in DISTORTION["brown"] if name != "b1")


FORMATS = (
    Format(
        "photomodeler",
        network_in("brown", values=_no_affinity()),
        lambda folder, n, e: write_photomodeler(folder / "export.txt", n, e),
        lambda folder: read_photomodeler(folder / "export.txt"),
        ("export.txt",),
    ),
    Format(
        "bal",
        network_in("opencv", values=(("k1", -0.08), ("k2", 0.04))),
        lambda folder, n, e: write_bal(folder / "problem.txt", n, e),
        lambda folder: read_bal(folder / "problem.txt", size_px=(2000, 1500)),
        ("problem.txt",),
        names=False,
        camera=False,
    ),
    Format(
        "bundle matlab",
        network_in("brown", values=(("x0", 0.03), ("y0", -0.02))),
        lambda folder, n, e: write_bundle_matlab(
            folder / "cams.txt", folder / "pts.txt", folder / "sigmas.txt", spaceless(n), e
        ),
        lambda folder: read_bundle_matlab(
            folder / "cams.txt",
            folder / "pts.txt",
            folder / "sigmas.txt",
            c_mm=10.0,
            x0_mm=0.03,
            y0_mm=-0.02,
        ),
        ("cams.txt", "pts.txt", "sigmas.txt"),
        names=False,
        camera=False,
    ),
    Format(
        "bundle csharp",
        network_in("brown", values=(("x0", 0.03), ("y0", -0.02)), full=True),
        lambda folder, n, e: write_bundle_csharp(folder / "8pts.txt", spaceless(n), e),
        lambda folder: read_bundle_csharp(folder / "8pts.txt"),
        ("8pts.txt",),
        names=False,
        camera=False,
    ),
    Format(
        "sba",
        network_in("opencv", values=()),
        lambda folder, n, e: write_sba_text(folder / "cams.txt", folder / "pts.txt", n, e),
        lambda folder: read_sba_text(folder / "cams.txt", folder / "pts.txt"),
        ("cams.txt", "pts.txt"),
        names=False,
        camera=False,
    ),
    Format(
        "metashape opencv",
        network_in("opencv"),
        lambda folder, n, e: write_metashape(folder / "cameras.xml", n, e),
        lambda folder: read_metashape(folder / "cameras.xml"),
        ("cameras.xml",),
    ),
    Format(
        "metashape brown_forward_affine",
        network_in("brown_forward_affine", values=(*DISTORTION["brown_forward_affine"], ("K4", 1e-9))),
        lambda folder, n, e: write_metashape(folder / "cameras.xml", n, e),
        lambda folder: read_metashape(folder / "cameras.xml"),
        ("cameras.xml",),
    ),
    Format(
        "colmap text",
        network_in("full_opencv"),
        lambda folder, n, e: write_model(folder, n, e, text=True),
        read_model,
        ("cameras.txt", "images.txt", "points3D.txt", "rigs.txt", "frames.txt"),
    ),
    Format(
        "colmap binary",
        network_in("full_opencv"),
        write_model,
        read_model,
        ("cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"),
    ),
)
BY_NAME = pytest.mark.parametrize("form", FORMATS, ids=[form.name for form in FORMATS])


def spaceless(network: Network) -> Network:
    return replace(network, images=tuple(name.replace(" ", "_") for name in network.images))


def by_position(network: Network) -> np.ndarray:
    """Order of the image points by photograph and point."""
    return np.lexsort((network.image_points.point, network.image_points.image))


@BY_NAME
def test_round_trip(form: Format, tmp_path: Path) -> None:
    network, truth = form.made
    form.write(tmp_path, network, truth)
    again, estimate = form.read(tmp_path)
    if form.names:
        assert again.images == network.images
        assert again.points == network.points
    assert (len(again.images), len(again.points)) == (len(network.images), len(network.points))
    a, b = by_position(network), by_position(again)
    np.testing.assert_array_equal(again.image_points.image[b], network.image_points.image[a])
    np.testing.assert_array_equal(again.image_points.point[b], network.image_points.point[a])
    np.testing.assert_allclose(estimate.points, truth.points, rtol=1e-11)
    np.testing.assert_allclose(estimate.position, truth.position, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(estimate.rotation, truth.rotation, atol=1e-11)
    # The same residuals: pixel origin, sign of y, distortion and rotation are all in them.
    v = reprojection(network, truth)[a]
    np.testing.assert_allclose(reprojection(again, estimate)[b], v, atol=1e-7)
    assert np.sqrt((v**2).mean()) == pytest.approx(0.2, rel=0.3)
    if form.camera:
        np.testing.assert_allclose(
            estimate.cameras[0].parameters, truth.cameras[0].parameters, rtol=1e-12, atol=1e-15
        )
        # PhotoModeler's is brown with residuals of the corrected point, as DBAT has them
        assert estimate.cameras[0].model.removesuffix("_dbat") == truth.cameras[0].model
        assert estimate.cameras[0].size_px == truth.cameras[0].size_px


@BY_NAME
@pytest.mark.parametrize("part", [0.0, 0.3, 0.5, 0.9])
def test_truncated_files_are_refused_with_their_place(form: Format, part: float, tmp_path: Path) -> None:
    network, truth = form.made
    for name in form.files:
        folder = tmp_path / name
        folder.mkdir()
        form.write(folder, network, truth)
        data = (folder / name).read_bytes()
        rest = data[: int(part * len(data))]
        if form.name == "sba":  # it has no counts, and a number that lost its last digits is a number
            rest = rest[: rest.rfind(b" ") + 1]
        (folder / name).write_bytes(rest)
        with pytest.raises(SurveyFileError, match=r"\.(txt|xml|bin), (line|byte) \d+: "):
            form.read(folder)


@BY_NAME
def test_shuffled_files_are_refused_or_say_the_same(form: Format, tmp_path: Path) -> None:
    network, truth = form.made
    for name in form.files:
        if name.endswith(".bin"):
            continue
        for seed in range(5):
            folder = tmp_path / f"{name} {seed}"
            folder.mkdir()
            form.write(folder, network, truth)
            lines = (folder / name).read_text(encoding="utf-8").splitlines(keepends=True)
            random.Random(seed).shuffle(lines)
            (folder / name).write_text("".join(lines), encoding="utf-8")
            try:
                again, estimate = form.read(folder)
            except SurveyFileError as error:
                assert ", line " in str(error)
                continue
            if form.name in ("bundle matlab", "sba"):
                continue  # their lines have no names: another order is another survey
            v = reprojection(again, estimate)
            assert np.sqrt((v**2).mean()) == pytest.approx(
                np.sqrt((reprojection(network, truth) ** 2).mean()), rel=1e-6
            )


def test_database_keeps_image_points_in_single_precision(tmp_path: Path) -> None:
    network, truth = network_in("opencv")
    write_database(tmp_path / "scene.db", network, truth.cameras)
    again, start = read_database(tmp_path / "scene.db")
    assert again.images == network.images
    assert len(again.points) == len(network.points)
    np.testing.assert_allclose(start.cameras[0].parameters, truth.cameras[0].parameters, atol=1e-12)
    a, b = by_position(network), np.lexsort((again.image_points.xy[:, 0], again.image_points.image))
    a = np.lexsort((network.image_points.xy[:, 0], network.image_points.image))
    stored = (network.image_points.xy + 0.5).astype(np.float32).astype(float) - 0.5
    np.testing.assert_array_equal(again.image_points.xy[b], stored[a])
    # the same image points belong together, whatever the points are called
    pairs = set(zip(network.image_points.point[a], again.image_points.point[b], strict=True))
    assert len(pairs) == len(network.points)
    with pytest.raises(OutputError, match="already"):
        write_database(tmp_path / "scene.db", network, truth.cameras)


def test_damaged_database_is_refused(tmp_path: Path) -> None:
    network, truth = network_in("opencv")
    path = tmp_path / "scene.db"
    write_database(path, network, truth.cameras)
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(SurveyFileError, match=r"scene\.db: the file is cut off, it has 5000 of"):
        read_database(path)
    path.write_text("no database")
    with pytest.raises(SurveyFileError, match=r"scene\.db, line 1: not a COLMAP database"):
        read_database(path)


def test_ply_has_every_digit_and_the_names_as_comments(tmp_path: Path) -> None:
    rng = seed_of("ply")
    xyz, sigma = rng.standard_normal((5, 3)), rng.random((5, 3))
    names = ("1", "2", "A b", "ü", "5")
    path = tmp_path / "points.ply"
    write_ply(path, xyz, names=names, sigma=sigma)
    header, body = path.read_text(encoding="utf-8").split("end_header\n")
    first, form, _, *rest = header.splitlines()
    assert (first, form) == ("ply", "format ascii 1.0")
    properties = [f"property double {one}" for one in ("x", "y", "z", "sx", "sy", "sz")]
    assert rest == [*(f"comment name {one}" for one in names), "element vertex 5", *properties]
    table = np.array([line.split() for line in body.splitlines()], dtype=float)
    np.testing.assert_array_equal(table, np.hstack([xyz, sigma]))


def test_metashape_decentring_and_affinity_have_their_own_order(tmp_path: Path) -> None:
    """Written out by hand from the manual's formulas for one ray, not from the reader's code."""
    text = """<document><chunk><sensors><sensor id="0" label="s" type="frame"><resolution width="2000"
    height="1500"/><calibration type="frame" class="adjusted"><f>2000</f><cx>5</cx><cy>-4</cy><b1>1.5</b1>
    <k1>-0.1</k1><k2>0.02</k2><k3>0.003</k3><p1>0.0004</p1><p2>-0.0003</p2></calibration></sensor></sensors>
    <cameras><camera id="7" sensor_id="0" label="x"><transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform>
    </camera></cameras><markers><marker id="3" label="t"><reference x="0.2" y="0.1" z="1" enabled="true"/>
    </marker></markers><frames><frame id="0"><markers><marker marker_id="3"><location camera_id="7" x="{u}"
    y="{v}"/></marker></markers></frame></frames></chunk></document>"""
    x, y = 0.2, 0.1
    r2 = x * x + y * y
    radial = 1 - 0.1 * r2 + 0.02 * r2**2 + 0.003 * r2**3
    xd = x * radial + 0.0004 * (r2 + 2 * x * x) + 2 * -0.0003 * x * y
    yd = y * radial + -0.0003 * (r2 + 2 * y * y) + 2 * 0.0004 * x * y
    u, v = 1000 + 5 + xd * 2000 + xd * 1.5, 750 - 4 + yd * 2000
    path = tmp_path / "x.xml"
    path.write_text(text.format(u=u, v=v))
    network, estimate = read_metashape(path)
    assert estimate.cameras[0].model == "full_opencv"
    np.testing.assert_allclose(reprojection(network, estimate), 0, atol=1e-9)
    assert len(network.control) == 1
    # k4 and b2 act on the distorted point: K4 moves it, b2 is Zhang's skew
    xd, yd = xd + x * 0.001 * r2**4, yd + y * 0.001 * r2**4
    u, v = 1000 + 5 + xd * 2000 + xd * 1.5 + yd * 30, 750 - 4 + yd * 2000
    path.write_text(text.format(u=u, v=v).replace("<p2>", "<k4>0.001</k4><b2>30</b2><p2>"))
    network, estimate = read_metashape(path)
    assert estimate.cameras[0].model == "brown_forward_affine"
    np.testing.assert_allclose(reprojection(network, estimate), 0, atol=1e-9)


def test_metashape_chunk_transform_and_missing_orientation(tmp_path: Path) -> None:
    network, truth = network_in("opencv")
    position = truth.position.copy()
    position[1] = np.nan
    path = tmp_path / "x.xml"
    control = ObjectPoints(np.array([2]), truth.points[2:3], np.diag([1e-6, 4e-6, 9e-6])[None])
    write_metashape(path, network.with_given(control), replace(truth, position=position))
    again, estimate = read_metashape(path)
    assert list(estimate.oriented) == [True, False, True, True, True, True]
    np.testing.assert_array_equal(again.control.point, [2])
    np.testing.assert_allclose(again.control.covariance, control.covariance, rtol=1e-12)
    turned = path.read_text().replace(
        '    <markers next_id="20"',
        "<transform><rotation>0 -1 0 1 0 0 0 0 1</rotation><translation>1 2 3</translation>"
        '<scale>2</scale></transform><markers next_id="20"',
        1,
    )
    path.write_text(turned)
    _, moved = read_metashape(path)
    R = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    np.testing.assert_allclose(moved.position[0], 2 * R @ truth.position[0] + [1, 2, 3], rtol=1e-12)
    np.testing.assert_allclose(moved.rotation[0], R @ truth.rotation[0], atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            'sensor_id="0" label="image 3"',
            'sensor_id="9" label="image 3"',
            "line 28: sensor_id 9, there is no",
        ),
        ("<f>", "<f>x", "line 11: 'x"),
        ("<f>", "<f>-", "line 9: f = -"),
        ('camera_id="4"', 'camera_id="44"', "camera_id 44, there is no such camera"),
        ('camera_id="4"', f'camera_id="{"#" * 12_000}"', "camera_id is '#{40}', needed plain text"),
        ('<camera id="4"', f'<camera id="{"#" * 12_000}"', "id is '#{40}', needed plain text"),
        ("</cameras>", "</camera>", "not well-formed XML"),
        ('encoding="UTF-8"', 'encoding="UTF-99"', "line 1: the encoding cannot be read"),
        ('encoding="UTF-8"', 'encoding="GBK"', "line 1: the encoding cannot be read"),
        ('width="2000"', 'width="-5"', "line 6: width is -5 px, needed a whole number from 1 to"),
        ("<f>", "<f>1e300", "line 11: '1e300.*' in <f> is not a"),
        ('<document version="2.0.0">', '<!DOCTYPE x><document version="2.0.0">', "line 2: a document type"),
    ],
)
def test_bad_xml_names_its_line(old: str, new: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "x.xml"
    write_metashape(path, *network_in("opencv"))
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(SurveyFileError, match=message) as refused:
        read_metashape(path)
    assert "x.xml, line " in str(refused.value)


def test_what_a_format_cannot_hold_is_refused(tmp_path: Path) -> None:
    network, truth = network_in("full_opencv")
    path = tmp_path / "file"
    with pytest.raises(OutputError, match="Metashape has no k4-k6"):
        write_metashape(path, network, truth)
    with pytest.raises(OutputError, match="BAL has one focal length"):
        write_bal(path, network, truth)
    with pytest.raises(OutputError, match="PhotoModeler cannot store model full_opencv"):
        write_photomodeler(path, network, truth)
    with pytest.raises(OutputError, match="one camera, in model brown"):
        write_bundle_csharp(path, network, truth)
    brown, estimate = network_in("brown", values=(("K1", 1e-4),))
    with pytest.raises(OutputError, match="cannot store distortion"):
        write_bundle_csharp(path, brown, estimate)
    plain, estimate = network_in("brown", values=())
    with pytest.raises(OutputError, match="the file requires every point in every photograph"):
        write_bundle_csharp(path, spaceless(plain), estimate)
    named = replace(plain, points=("A", *plain.points[1:]))
    with pytest.raises(OutputError, match="point 'A': PhotoModeler numbers its points"):
        write_photomodeler(path, named, estimate)
    assert not path.exists()


def test_conversion_opens_the_way_between_formats(tmp_path: Path) -> None:
    """brown to Metashape: the misfit that is stated is the one that appears."""
    network, truth = network_in("brown")
    conversion = convert_camera(
        truth.cameras[0], "brown_forward_affine", held=format_named("metashape").lacks
    )
    assert conversion.max_px < 0.03  # affinity of 2e-4 and 40 px of distortion included
    write_metashape(tmp_path / "x.xml", network, replace(truth, cameras=(conversion.camera,)))
    again, estimate = read_metashape(tmp_path / "x.xml")
    cameras: tuple[Camera, ...] = estimate.cameras
    assert cameras[0].size_px == truth.cameras[0].size_px
    a, b = by_position(network), by_position(again)
    shift = reprojection(again, estimate)[b] - reprojection(network, truth)[a]
    assert np.hypot(*shift.T).max() <= conversion.max_px + 1e-9


def test_metashape_and_photomodeler_take_pixels_that_are_not_square(tmp_path: Path) -> None:
    network, truth = network_in("brown")
    old = truth.cameras[0]
    b1 = old.value("b1")
    assert b1 != 0
    for name, sx in (("metashape", 0.0051), ("photomodeler", 0.005)):
        wide = replace(truth, cameras=(replace(old, pixel_mm=np.array([sx, 0.005])),))
        seen = network.image_points
        moved = seen.xy + reprojection(network, wide) - reprojection(network, truth)
        measured = replace(network, image_points=replace(seen, xy=moved))
        form = format_named(name)
        estimate, (conversion,) = convert_cameras(wide, form.models, held=form.lacks)
        write_any(tmp_path / f"{name}.xml", name, measured, estimate)
        again, read = read_any(tmp_path / f"{name}.xml", name)
        a, b = by_position(measured), by_position(again)
        shift = reprojection(again, read)[b] - reprojection(measured, wide)[a]
        # Metashape distorts the ideal point; PhotoModeler's model is ours, so that nothing is lost
        assert conversion.max_px < (0.05 if name == "metashape" else 1e-8)
        assert np.hypot(*shift.T).max() <= conversion.max_px + 1e-7


@pytest.mark.parametrize("name", ["sba", "bundle-matlab", "bundle-csharp", "bal"])
def test_image_points_are_corrected_for_formats_without_distortion(name: str, tmp_path: Path) -> None:
    network, truth = network_in("brown", full=True)
    network = spaceless(network)
    form = format_named(name)
    bent, _ = convert_cameras(truth, form.models, held=form.lacks)
    with pytest.raises(KolinearError, match=f"format {name} cannot store .*; --undistort corrects"):
        write_any(tmp_path / "out", name, network, bent)
    straight, ideal = undistort(network, truth, form.models)
    write_any(tmp_path / "out", name, straight, ideal)
    again, read = read_any(tmp_path / "out", name)
    a, b = by_position(network), by_position(again)
    # residuals of the written survey are those of the measured one, carried through the distortion
    J = np.linalg.inv(pixel_jacobian(truth.cameras[0], network.image_points.xy))
    J = pixel_jacobian(ideal.cameras[0], straight.image_points.xy) @ J
    expected = np.einsum("kab,kb->ka", J, reprojection(network, truth))
    np.testing.assert_allclose(reprojection(again, read)[b], expected[a], atol=1e-5)


def test_what_was_written_is_reported(tmp_path: Path) -> None:
    network, truth = network_in("opencv")
    k = len(network.image_points)
    assert describe_stored("ply", network, truth) == "20 points"
    assert describe_stored("colmap", network, truth) == f"6 photographs, 20 points, {k} image points"
    assert describe_stored("colmap-database", network, truth) == (
        f"6 photographs, {k} image points, no coordinates of points"
    )
    position = truth.position.copy()
    position[0] = np.nan
    part = replace(truth, position=position)
    write_any(tmp_path / "t", "tables", network, part)
    again, _ = read_any(tmp_path / "t")
    assert len(again.images) == 5
    assert (
        describe_stored("tables", network, part)
        == f"5 photographs, 20 points, {len(again.image_points)} image points"
    )
    write_any(tmp_path / "c.db", "colmap-database", network, truth)
    with pytest.raises(
        SurveyFileError, match=r"c\.db: \d+ image points as format colmap-database, but no coord"
    ):
        read_comparable(tmp_path / "c.db")
    write_any(tmp_path / "c.ply", "ply", network, truth)
    with pytest.raises(SurveyFileError, match=r"c\.ply: format ply has only points"):
        read_comparable(tmp_path / "c.ply")
    bare = read_any(tmp_path / "c.db")
    for name in ("tables", "colmap", "ply"):
        with pytest.raises(OutputError, match=f"format {name} needs coordinates in the object, but no"):
            write_any(tmp_path / "none", name, *bare)
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize(
    "name",
    [
        form.name
        for form in FILE_FORMATS
        if form.readable and form.writable and form.name != "colmap-database"
    ],
)
def test_formats_are_recognised_and_go_round_by_name(name: str, tmp_path: Path) -> None:
    """From brown through any format: converted where it must be, read back by what is there."""
    values = () if name.startswith("bundle-") or name == "sba" else _no_affinity()
    network, truth = network_in("brown", values=values, full=True)
    if name == "bal":  # one focal length, no decentring
        network, truth = network_in("opencv", values=(("k1", -0.08), ("k2", 0.04)))
    form = format_named(name)
    estimate, conversions = truth, ()
    if form.models:
        estimate, conversions = convert_cameras(truth, form.models, held=form.lacks)
    if name == "micmac":  # it has the coordinates of control only
        network = network.with_control(network.points, truth.points)
    path = tmp_path / "out"
    write_any(path, name, spaceless(network), estimate)
    assert format_of(path.rename(tmp_path / "x.xml") if name == "metashape" else path).name == name
    again, read = read_any(tmp_path / "x.xml" if name == "metashape" else path)
    if "image points" not in form.keeps:
        np.testing.assert_allclose(read.position, truth.position, atol=1e-12)
        return
    a, b = by_position(network), by_position(again)
    shift = reprojection(again, read)[b] - reprojection(network, truth)[a]
    # BAL's photographs have no size, so only differences of pixels survive; those are residuals.
    assert np.abs(shift).max() <= max(one.max_px for one in conversions) + 1e-6


def test_results_of_any_format_can_be_compared(tmp_path: Path) -> None:
    network, truth = network_in("full_opencv")
    write_any(tmp_path / "model", "colmap", network, truth)
    write_any(tmp_path / "tables", "tables", network, truth)
    a, b = read_comparable(tmp_path / "model"), read_comparable(tmp_path / "tables")
    assert (a.name, b.name) == ("model", "tables")
    found = compare_results(a, b)
    assert np.abs(found.point_difference).max() < 1e-12
    assert found.interior[0].conversion is None


def test_formats_refuse_by_name(tmp_path: Path) -> None:
    network, truth = network_in("brown")
    with pytest.raises(SurveyFileError, match="format 'dxf', expected one of colmap"):
        format_named("dxf")
    with pytest.raises(KolinearError, match="format bal has models opencv, radial, not brown"):
        write_any(tmp_path / "x", "bal", network, truth)
    (tmp_path / "note.txt").write_text("hello\n")
    with pytest.raises(SurveyFileError, match=r"note\.txt, line 1: the format is not known"):
        format_of(tmp_path / "note.txt")
    with pytest.raises(SurveyFileError, match="neither a COLMAP model, nor tables"):
        format_of(tmp_path)
    with pytest.raises(OutputError, match="needs a new or empty folder"):
        write_any(tmp_path, "tables", network, truth)
    with pytest.raises(OutputError, match="needs a new file"):
        write_any(tmp_path, "photomodeler", network, truth)


def test_bal_projects_as_its_own_formulas_say(tmp_path: Path) -> None:
    """P = R X + t, p = -P / P_z, p' = f (1 + k1 |p|^2 + k2 |p|^4) p, y up: by hand for one point."""
    w, t, f, k1, k2 = np.array([0.1, -0.2, 0.3]), np.array([0.1, 0.2, -3.0]), 1500.0, -0.1, 0.02
    X = np.array([0.3, 0.4, 0.1])
    theta = np.linalg.norm(w)
    k = w / theta
    P = X * np.cos(theta) + np.cross(k, X) * np.sin(theta) + k * (k @ X) * (1 - np.cos(theta)) + t
    p = -P[:2] / P[2]
    r2 = p @ p
    x, y = f * (1 + k1 * r2 + k2 * r2**2) * p
    values = [*w, *t, f, k1, k2, *X]
    path = tmp_path / "problem.txt"
    path.write_text(
        "\n".join(["1 1 1", f"0 0 {float(x)!r} {float(y)!r}", *(repr(float(v)) for v in values)]) + "\n"
    )
    network, estimate = read_bal(path)
    np.testing.assert_allclose(reprojection(network, estimate), 0, atol=1e-9)


def test_published_start_values_of_the_bridge_pier_in_its_own_format(tmp_path: Path) -> None:
    """The C# file of the thesis, built from its clean figures; RMS at the start 4.22 micrometres."""
    folder = SHARED / "figures"
    if not folder.is_dir():
        pytest.skip("figures of the source documents are not beside the repository")

    def rows(name: str) -> list[dict[str, str]]:
        return rows_of(folder / name)

    exterior = rows("flyover_exterior_orientation.csv")
    points = rows("flyover_object_points_m.csv")
    seen = {(row["image"], row["point"]): row for row in rows("flyover_image_points_mm.csv")}
    lines = ["2 35 0 0"]
    lines += [" ".join(row.values()) for row in exterior]
    lines.append(f"{len(points)}")
    for row in points:
        xy = [seen[i, row["point"]][axis] for i in "12" for axis in "xy"]
        lines.append(" ".join([*row.values(), *xy]))
    for row in points:
        sigma = [seen[i, row["point"]][f"sigma_{axis}"] for i in "12" for axis in "xy"]
        lines.append(" ".join([row["point"], *sigma]))
    path = tmp_path / "8pts.txt"
    path.write_text("\n".join(lines) + "\n")
    network, estimate = read_bundle_csharp(path)
    v_mm = reprojection(network, estimate) * estimate.cameras[0].pixel_mm
    assert np.sqrt((v_mm**2).mean()) * 1000 == pytest.approx(4.22, abs=0.005)
    write_bundle_csharp(tmp_path / "again.txt", network, estimate)
    again = (tmp_path / "again.txt").read_text().split()
    assert [float(word) for word in again] == pytest.approx(
        [float(w) for w in path.read_text().split()], rel=1e-11
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("10 0.03\n", r"interior\.txt, line 1: 2 words, needed 3: c x0 y0"),
        ("# c x0 y0\n-10 0.03 0\n", r"interior\.txt, line 2: c is -10 mm, it must be positive"),
        ("10 0.03 0\n1\n", r"interior\.txt, line 2: '1' after the end"),
        ("", r"interior\.txt, line 1: the file ends here, c x0 y0 \(mm\) was expected"),
    ],
)
def test_bad_interior_orientation_names_its_line(text: str, message: str, tmp_path: Path) -> None:
    network, truth = network_in("brown", values=(("x0", 0.03), ("y0", -0.02)))
    write_any(tmp_path / "m", "bundle-matlab", spaceless(network), truth)
    (tmp_path / "m" / "interior.txt").write_text(text)
    with pytest.raises(SurveyFileError, match=message):
        read_any(tmp_path / "m")


def test_convert_tells_what_it_did(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    network, truth = network_in("brown", full=True)
    write_any(tmp_path / "in", "tables", spaceless(network), truth)
    with pytest.raises(KolinearError, match="--undistort"):
        convert(tmp_path / "in", tmp_path / "out", to_format="sba")
    assert capsys.readouterr().out == ""  # no misfit of what was not written
    convert(tmp_path / "in", tmp_path / "out", to_format="sba", straighten=True)
    convert(tmp_path / "in", tmp_path / "x.xml")
    convert(tmp_path / "in", tmp_path / "x.ply")
    told = [line for line in capsys.readouterr().out.splitlines() if "left out" not in line]
    name = truth.cameras[0].name
    assert told[0] == f"camera {name}: image points corrected for brown, ideal camera written"
    assert told[1] == f"{tmp_path / 'out'}: 6 photographs, 20 points, 120 image points as sba"
    assert told[2].startswith(f"camera {name}: brown to brown_forward_affine, misfit 0.0")
    assert told[4:] == [f"{tmp_path / 'x.ply'}: 20 points as ply"]


def test_matlab_files_have_the_names_of_the_thesis_or_are_named(tmp_path: Path) -> None:
    network, truth = network_in("brown", values=(("x0", 0.03), ("y0", -0.02)))
    write_any(tmp_path / "m", "bundle-matlab", spaceless(network), truth)
    ours = read_any(tmp_path / "m")
    for name, other in (("cams", "utara1_6"), ("pts", "utara1_20"), ("sigmas", "utara1_20re")):
        (tmp_path / "m" / f"{name}.txt").rename(tmp_path / "m" / f"{other}.txt")
    again, estimate = read_any(tmp_path / "m")
    np.testing.assert_array_equal(again.image_points.covariance, ours[0].image_points.covariance)
    np.testing.assert_array_equal(estimate.points, ours[1].points)
    (tmp_path / "m" / "interior.txt").unlink()
    assert format_of(tmp_path / "m").name == "bundle-matlab"
    for _ in range(2):  # without the interior orientation, then without the photographs too
        with pytest.raises(SurveyFileError) as told:
            read_any(tmp_path / "m", "bundle-matlab")
        for name in ("cams.txt", "pts.txt", "sigmas.txt", "interior.txt"):
            assert name in str(told.value)
        (tmp_path / "m" / "utara1_6.txt").unlink(missing_ok=True)


@pytest.mark.parametrize(
    ("folder", "name"),
    [("bridge/sparse/0", "bridge 0"), ("bridge/0", "bridge 0"), ("bridge/model", "model"), ("0", None)],
)
def test_a_model_of_a_number_has_the_name_of_its_project(
    folder: str, name: str | None, tmp_path: Path
) -> None:
    """COLMAP's first model was titled "0", and two of them could not be told apart in a comparison."""
    assert model_name(tmp_path / folder) == (name or f"{tmp_path.name} 0")
