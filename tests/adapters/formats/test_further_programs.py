"""MicMac, AICON, RealityCapture, references of Metashape, and points with coordinate systems.

Each program's projection is written here again in a few lines; what is read must have the residuals that it
states.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from adapters.formats.content import KINDS, Content, losses
from adapters.formats.registry import format_named, format_of, losses_in_words, read_content, write_content
from adapters.formats.stated_model import heading_from_rotation, rotation_from_heading
from sfm.cli.commands.convert import convert
from sfm.comparison.solutions import reprojection
from sfm.model.camera import pixel_from_tangents
from sfm.model.conventions import angles_from_rotation, rotation_from_angles
from sfm.model.errors import OutputError, SurveyFileError
from sfm.model.network import ExteriorObservations, ObjectPoints, ScaleBars
from sfm.model.reduced_network import reduce_network
from sfm.model.solution import Solution
from tests.adapters.formats.clouds import WITHOUT
from tests.adapters.formats.test_models_of_programs import assert_one_line, by_names
from tests.synthetic import make_network, seed_of

NEW = ("micmac", "aicon", "realitycapture", "agisoft-reference", "points-csv", "geojson")
LENS = ("micmac", "aicon", "realitycapture")
K4, AFFINE = {"K4": -1e-9}, {"b1": 3e-4, "b2": -2e-4}


def model(form: str, name: str, *, cameras: int = 2) -> Content:
    """A model with control, scale bars and standard deviations, with a lens that the format has."""
    rng = seed_of(f"{form} {name}")
    network, truth = make_network(
        rng, images=5, points=14, model="brown_forward", noise_px=0.3, cameras=cameras, free=()
    )
    lens = ({} if form == "aicon" else K4) | ({} if form == "realitycapture" else AFFINE)
    given = [dict(zip(c.names, c.parameters.tolist(), strict=True)) | lens for c in truth.cameras]
    truth = replace(
        truth,
        cameras=tuple(
            c.with_parameters(np.array([p[n] for n in c.names]))
            for c, p in zip(truth.cameras, given, strict=True)
        ),
    )
    seen = network.image_points
    xy = seen.xy + reprojection(network, truth) + rng.normal(0, 0.3, seen.xy.shape)
    network = replace(
        network,
        images=tuple(f"DSC {i}.jpg" for i in range(5)),
        points=tuple(f"P{j}" for j in range(14)),
        image_points=replace(seen, xy=xy, covariance=np.tile(np.diag([0.04, 0.09]), (len(seen), 1, 1))),
    )
    control = ObjectPoints(
        np.arange(3), truth.points[:3] + 0.01, np.tile(np.diag([1e-4, 4e-4, 0]), (3, 1, 1))
    )
    bar = ScaleBars(np.array([4]), np.array([5]), np.array([1.5]), np.array([1e-3]))
    return Content(Solution(form, network.with_given(control, bar), truth, unit="m"))


def written(content: Content, form: str, folder: Path) -> Path:
    path = folder / {"realitycapture": "poses.csv", "points-csv": "p.csv", "geojson": "p.geojson"}.get(
        form, "Ori-A"
    )
    write_content(path, form, content)
    return path


def of_micmac(folder: Path) -> dict[tuple[str, str], np.ndarray]:
    """From the residuals of control only, the points whose coordinates MicMac has."""
    values = lambda node, tag: np.array(node.find(tag).text.split(), dtype=float)  # noqa: E731
    points = {
        node.find("NamePt").text: values(node, "Pt")
        for node in ElementTree.parse(folder / "MesuresAppuis.xml").getroot()
    }
    residuals = {}
    for image in ElementTree.parse(folder / "MesuresIm.xml").getroot():
        name = image.find("NameIm").text
        pose = ElementTree.parse(folder / f"Orientation-{name}.xml").getroot()[0]
        camera = ElementTree.parse(folder / pose.find("FileInterne").text).getroot()[0]
        outside = pose.find("Externe")
        rows = outside.find("ParamRotation/CodageMatr")
        R = np.array([values(rows, f"L{k}") for k in (1, 2, 3)])
        f, principal = values(camera, "F")[0], values(camera, "PP")
        lens = camera.find("CalibDistortion")[0]
        radial = [float(node.text) for node in lens.iter("CoeffDist")]
        p1, p2, b1, b2 = (float(lens.find(tag).text) for tag in ("P1", "P2", "b1", "b2"))
        for seen in image.iter("OneMesureAF1I"):
            point = seen.find("NamePt").text
            if point not in points:
                continue
            X, Y, Z = R.T @ (points[point] - values(outside, "Centre"))
            x, y = f * X / Z, f * Y / Z
            r2 = x * x + y * y
            s = 1 + sum(v * r2 ** (k + 1) for k, v in enumerate(radial))
            dx = s * x + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y + b1 * x + b2 * y
            dy = s * y + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
            residuals[name, point] = np.array([dx, dy]) + principal - values(seen, "PtIm")
    return residuals


def of_aicon(folder: Path, r0: float = 0.0) -> dict[tuple[str, str], np.ndarray]:
    """In mm, y up, turned into px; with a second zero of the distortion at r0, mm."""
    rows = {
        ending: [line.split() for line in (folder / f"survey.{ending}").read_text().splitlines()]
        for ending in ("ior", "eor", "obc", "phc")
    }
    cameras = {}
    for k in range(0, len(rows["ior"]), 5):
        number, _, c, *values = rows["ior"][k]
        assert float(values[4]) == r0
        flat = [float(v) for line in rows["ior"][k + 1 : k + 5] for v in line]
        cameras[number] = (-float(c), *map(float, values[:4]), *flat)
    points = {row[0]: np.array(row[1:4], dtype=float) for row in rows["obc"]}
    poses = {row[0]: (row[1], np.array(row[2:8], dtype=float)) for row in rows["eor"]}
    residuals = {}
    for image, point, *xy in rows["phc"]:
        number, pose = poses[image]
        c, x0, y0, A1, A2, A3, B1, B2, C1, C2, width, height, columns, lines = cameras[number]
        P = rotation_from_angles(*pose[3:]).T @ (points[point] - pose[:3])
        X, Y = -c * P[:2] / P[2]
        r2 = X * X + Y * Y
        s = 1 + A1 * (r2 - r0**2) + A2 * (r2**2 - r0**4) + A3 * (r2**3 - r0**6)
        x = x0 + s * X + B1 * (r2 + 2 * X * X) + 2 * B2 * X * Y + C1 * X + C2 * Y
        y = y0 + s * Y + B2 * (r2 + 2 * Y * Y) + 2 * B1 * X * Y
        mm = np.array([x, y]) - np.array(xy[:2], dtype=float)
        residuals[image, point] = mm / [width / columns, -height / lines]
    return residuals


OWN: dict[str, Callable[[Path], dict[tuple[str, str], np.ndarray]]] = {"micmac": of_micmac, "aicon": of_aicon}


def assert_own(path: Path, form: str, theirs: dict[tuple[str, str], np.ndarray]) -> None:
    result = read_content(path).result
    network, known = result.network, result.estimate.determined
    images, every = np.ones(len(network.images), dtype=bool), np.ones(len(network.image_points), dtype=bool)
    network, estimate = reduce_network(network, result.estimate, images, known, every)
    ours = by_names(network, reprojection(network, estimate))
    assert len(theirs) > 10
    for key, residual in theirs.items():
        np.testing.assert_allclose(ours[key], residual, atol=1e-6)


@pytest.mark.parametrize("form", OWN)
@pytest.mark.parametrize("seed", ["a", "b", "c"])
def test_residuals_are_those_of_the_program(form: str, seed: str, tmp_path: Path) -> None:
    path = written(model(form, seed), form, tmp_path)
    assert format_of(path).name == form
    assert_own(path, form, OWN[form](path))


def test_the_second_zero_of_the_distortion_is_read(tmp_path: Path) -> None:
    """AICON's r0: the linear term that it brings goes into the principal distance."""
    path = written(model("aicon", "r0"), "aicon", tmp_path)
    file = path / "survey.ior"
    lines = file.read_text().splitlines()
    for k in range(0, len(lines), 5):
        lines[k] = lines[k].removesuffix("0.0") + "3.5"
    file.write_text("\n".join(lines) + "\n")
    plain = read_content(path).result.estimate.cameras[0]
    assert plain.value("c") != float(-float(lines[0].split()[2]))
    assert_own(path, "aicon", of_aicon(path, 3.5))


@pytest.mark.parametrize("far", [0.0, 12.0])
def test_micmac_distorts_about_a_centre_of_its_own(far: float, tmp_path: Path) -> None:
    """The nearest lens is read where CDist is not PP, and its misfit is noted."""
    path = written(model("micmac", "centre", cameras=1), "micmac", tmp_path)
    file = path / "AutoCal-0.xml"
    text = file.read_text()
    before, _, rest = text.partition("<CDist>")
    x, y = map(float, rest.partition("</CDist>")[0].split())
    file.write_text(f"{before}<CDist>{x + far} {y - far}</CDist>{rest.partition('</CDist>')[2]}")
    content = read_content(path)
    camera = content.result.estimate.cameras[0]
    root = ElementTree.parse(file).getroot()[0]
    f, principal = float(root.find("F").text), np.array([x, y])
    lens = root.find("CalibDistortion")[0]
    radial = [float(node.text) for node in lens.iter("CoeffDist")]
    p1, p2, b1, b2 = (float(lens.find(tag).text) for tag in ("P1", "P2", "b1", "b2"))
    uv = np.stack(np.meshgrid(np.linspace(-0.4, 0.4, 9), np.linspace(-0.3, 0.3, 7)), -1).reshape(-1, 2)
    ideal = f * uv * (1, -1) + principal
    d = ideal - [x + far, y - far]
    r2, (a, b) = (d * d).sum(axis=1), d.T
    shift = d * sum(v * r2 ** (k + 1) for k, v in enumerate(radial))[:, None]
    shift[:, 0] += p1 * (r2 + 2 * a * a) + 2 * p2 * a * b + b1 * a + b2 * b
    shift[:, 1] += p2 * (r2 + 2 * b * b) + 2 * p1 * a * b
    misfit = np.abs(pixel_from_tangents(camera, uv) - ideal - shift).max()
    if far:
        assert misfit < 0.05 and content.notes[0].startswith("camera AutoCal-0: distortion about ")
    else:
        assert misfit < 1e-9 and not content.notes


@pytest.mark.parametrize("form", LENS)
def test_round_trip(form: str, tmp_path: Path) -> None:
    content = model(form, "round trip")
    path = written(content, form, tmp_path)
    again = read_content(path)
    a, b = content.result.estimate, again.result.estimate
    np.testing.assert_allclose(b.position, a.position, rtol=1e-12)
    np.testing.assert_allclose(b.rotation, a.rotation, atol=1e-12)
    uv = np.stack(np.meshgrid(np.linspace(-0.4, 0.4, 7), np.linspace(-0.3, 0.3, 7)), axis=-1).reshape(-1, 2)
    for i, k in enumerate(content.result.network.camera):
        lens, other = a.cameras[k], b.cameras[again.result.network.camera[i]]
        here, there = (
            (pixel_from_tangents(c, uv) - (np.array(c.size_px) - 1) / 2) / max(c.size_px)
            for c in (lens, other)
        )
        np.testing.assert_allclose(there, here, atol=1e-12)
        assert (lens.size_px == other.size_px) != (form == "realitycapture")
    named = {kind.name for kind, _ in losses(content, format_named(form).held(content))}
    for kind in KINDS:
        if kind.name in format_named(form).keeps and kind.name not in named:
            np.testing.assert_allclose(kind.rows(again), kind.rows(content), rtol=1e-9, err_msg=kind.name)
    assert ("scale bars" in named) != (form == "aicon") and ("control" in named) != (form == "micmac")


@pytest.mark.parametrize("form", NEW)
@pytest.mark.parametrize("part", ["poses", "points"])
def test_parts_alone(form: str, part: str, tmp_path: Path) -> None:
    content = model(form, "parts")
    network, estimate = content.result.network, content.result.estimate
    if part == "poses":
        estimate = replace(estimate, points=np.full_like(estimate.points, np.nan))
    else:
        estimate = replace(
            estimate, position=np.full_like(estimate.position, np.nan), rotation=estimate.rotation * np.nan
        )
    network = replace(network, observations=())
    content = Content(replace(content.result, network=network, estimate=estimate))
    only_points, no_points = form in ("points-csv", "geojson"), form == "realitycapture"
    if (part == "poses" and only_points) or (part == "points" and no_points):
        with pytest.raises(OutputError, match=f"{form} (needs coordinates|stores nothing of this survey)"):
            written(content, form, tmp_path)
        return
    read = read_content(written(content, form, tmp_path), form).result.estimate
    if part == "poses":
        np.testing.assert_allclose(read.position, estimate.position, rtol=1e-12)
    elif form != "micmac":
        np.testing.assert_allclose(read.points, estimate.points, rtol=1e-12)


# --- references of Metashape ---


def test_yaw_pitch_and_roll_are_those_of_metashape() -> None:
    """ypr2mat((30, 91, 0)) as printed in Agisoft's forum, topic 12200, and its twin (210, 89, 180)."""
    printed = [
        [0.8660254037844387, -0.008726203218641737, -0.4999238475781956],
        [-0.49999999999999994, -0.01511422733185856, -0.8658935039207541],
        [0.0, 0.9998476951563913, -0.017452406437283477],
    ]
    np.testing.assert_allclose(rotation_from_heading(30, 91, 0), printed, atol=1e-15)
    np.testing.assert_allclose(rotation_from_heading(210, 89, 180), printed, atol=1e-15)
    rng = seed_of("ypr")
    for angles in (*rng.uniform((-180, -89, -180), (180, 89, 180), (50, 3)), (20, 90, 0), (-70, -90, 0)):
        np.testing.assert_allclose(
            heading_from_rotation(rotation_from_heading(*angles)), angles, rtol=1e-9, atol=1e-9
        )


TABLE = """# CoordinateSystem: PROJCS["ETRS89 / UTM zone 32N",AUTHORITY["EPSG","25832"]]
#Label,Enable,X/Easting,Y/Northing,Z/Altitude,Yaw,Pitch,Roll,Error_(m),Accuracy_X/Y_(m),Accuracy_Z_(m),\
Accuracy_Yaw/Pitch/Roll_(deg),X_est,Y_est,Z_est,Yaw_est,Pitch_est,Roll_est
DSC1.JPG,1,500100.25,5600000.5,210.0,30,91,0,0.02,0.05,0.1,2,500100.3,5600000.4,210.1,31,90.5,0.1
"DSC2.JPG",0,500110.25,5600000.5,210.0,,,,0.02,0.05,0.1,2,500110.3,5600000.4,210.1,31,90.5,0.1
DSC3.JPG,1,500120.25,5600000.5,210.0,,,,,0.05,0.1,,,,,,,
# Total error,,,
"""
MARKERS = """Label,X/Easting,Y/Northing,Z/Altitude,Accuracy_X/Y/Z_(m),Enable
7,10,20,30,0.004,1
8,11,21,31,0.005,0
"""


def test_a_reference_as_metashape_writes_it(tmp_path: Path) -> None:
    (tmp_path / "cameras.csv").write_text(TABLE)
    (tmp_path / "markers.csv").write_text(MARKERS)
    assert format_of(tmp_path).name == format_of(tmp_path / "cameras.csv").name == "agisoft-reference"
    content = read_content(tmp_path)
    result, network = content.result, content.result.network
    assert (network.images, network.points) == (("DSC1.JPG", "DSC2.JPG", "DSC3.JPG"), ("7", "8"))
    assert result.estimate.oriented.tolist() == [True, True, False]
    np.testing.assert_allclose(result.estimate.rotation[0], rotation_from_heading(31, 90.5, 0.1), atol=1e-12)
    seen = network.exterior
    assert seen.image.tolist() == [0, 2] and result.unit == "m" and "25832" in content.crs
    np.testing.assert_allclose(seen.position[0], [500100.25, 5600000.5, 210.0])
    np.testing.assert_allclose(seen.angles[0], angles_from_rotation(rotation_from_heading(30, 91, 0)))
    sigma = np.sqrt(np.diagonal(seen.covariance, axis1=1, axis2=2))
    np.testing.assert_allclose(sigma[:, :3], [[0.05, 0.05, 0.1]] * 2)
    assert np.isinf(sigma[1, 3:]).all()
    control, checks = network.control, content.checks
    assert (control.point.tolist(), checks.point.tolist()) == ([0], [1])
    np.testing.assert_allclose(control.covariance[0], 0.004**2 * np.eye(3))
    # and back: observed angles that were observed apart are kept as they were
    write_content(tmp_path / "again", "agisoft-reference", content)
    again = read_content(tmp_path / "again")
    assert not losses_in_words("agisoft-reference", content)[
        1:
    ]  # the covariance of omega, phi and kappa alone
    for kind in KINDS:
        np.testing.assert_allclose(kind.rows(again), kind.rows(content), atol=1e-9, err_msg=kind.name)


def test_the_accuracies_of_angles_turn_with_them(tmp_path: Path) -> None:
    """By differences: what is small of yaw, pitch and roll, is so of omega, phi and kappa together."""
    (tmp_path / "cameras.csv").write_text(TABLE)
    seen = read_content(tmp_path / "cameras.csv").result.network.exterior
    step = 1e-6
    columns = [
        angles_from_rotation(rotation_from_heading(*(np.array([30, 91, 0]) + np.degrees(d)))) - seen.angles[0]
        for d in step * np.eye(3)
    ]
    J = np.array(columns).T / step
    np.testing.assert_allclose(seen.covariance[0][3:, 3:], np.radians(2) ** 2 * J @ J.T, rtol=1e-4)


def test_correlated_angles_are_left_out_and_named(tmp_path: Path) -> None:
    content = model("agisoft-reference", "correlated")
    A = seed_of("angles").normal(0, 0.01, (2, 6, 6))
    network = content.result.network.with_given(
        ExteriorObservations(np.array([0, 1]), np.zeros((2, 3)), np.zeros((2, 3)), A @ A.transpose(0, 2, 1))
    )
    content = replace(content, result=replace(content.result, network=network))
    assert "2 observed exterior orientations" in losses_in_words("agisoft-reference", content)
    again = read_content(written(content, "agisoft-reference", tmp_path))
    assert not len(again.result.network.exterior) and again.result.estimate.oriented.all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("X/Easting", "X/Longitude"), "line 2: longitude and latitude are no Cartesian coordinates"),
        (("PROJCS", "GEOGCS"), "line 1: longitude and latitude are no Cartesian coordinates"),
        (("0.05,0.1,2,500100.3", "-0.05,0.1,2,500100.3"), r"line 3: accuracy_x -0\.05, needed 0 or more"),
        (("DSC1.JPG,1,500100.25", "DSC1.JPG,1,nan"), "line 3: 'nan' is not a number"),
        (("DSC1.JPG,1,", "DSC1.JPG,"), "line 3: 17 columns, the header has 18"),
        (("#Label", "#Name"), "line 2: .*needed #Label"),
        (('"DSC2.JPG"', "DSC1.JPG"), "2 photographs with the name 'DSC1.JPG', needed one"),
    ],
)
def test_wrong_references_are_refused(change: tuple[str, str], message: str, tmp_path: Path) -> None:
    assert change[0] in TABLE
    (tmp_path / "c.csv").write_text(TABLE.replace(*change, 1))
    with pytest.raises(SurveyFileError, match=rf"c\.csv(, |: ){message}"):
        read_content(tmp_path / "c.csv", "agisoft-reference")


# --- RealityCapture ---


def test_realitycapture_without_cameras_and_with_its_later_names(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_text("#name,x,y,alt,heading,pitch,roll\na.jpg,1,2,3,30,91,0\n")
    content = read_content(path)
    np.testing.assert_allclose(content.result.estimate.rotation[0], rotation_from_heading(30, 91, 0))
    assert "6 interior" not in " ".join(losses_in_words("tables", content))
    assert content.notes[0].startswith("cameras are not stated")
    path.write_text(
        "#name,x,y,alt,heading,pitch,roll,f_35mm,px_norm,py_norm,k1\na.jpg,1,2,3,0,0,0,18,0.01,-0.02,0.1\n"
    )
    (camera,) = read_content(path).result.estimate.cameras
    found = [camera.value(name) for name in ("c", "x0", "y0")]
    np.testing.assert_allclose(found, [18, 0.36, 0.72])
    uv = np.array([[0.3, -0.2]])  # in parts of the larger side: f/36 (1 + k1 r2) u + px
    measured = (pixel_from_tangents(camera, uv) - (np.array(camera.size_px) - 1) / 2) / max(camera.size_px)
    np.testing.assert_allclose(measured, 0.5 * 1.013 * uv * (1, -1) + [0.01, -0.02], atol=1e-12)


# --- points ---


@pytest.mark.parametrize("form", ["points-csv", "geojson"])
def test_points_keep_names_sigmas_and_system(form: str, tmp_path: Path) -> None:
    CRS = pytest.importorskip("pyproj", reason=WITHOUT).CRS
    content = model(form, "points")
    n = len(content.result.network.points)
    C = np.eye(3) * seed_of("C").uniform(1e-6, 1e-4, (n, 1, 3))
    points = content.result.estimate.points + np.array([500_000, 5_600_000, 100])
    result = replace(
        content.result, estimate=replace(content.result.estimate, points=points), point_covariance=C
    )
    content = replace(content, result=result, crs=CRS.from_epsg(25832).to_wkt())
    path = written(content, form, tmp_path)
    assert format_of(path).name == form
    again = read_content(path)
    assert again.result.network.points == content.result.network.points
    np.testing.assert_allclose(again.result.estimate.points, points, rtol=1e-15)
    np.testing.assert_allclose(again.result.point_covariance, C, rtol=1e-12)
    assert CRS.from_wkt(again.crs).to_epsg() == 25832
    other = (
        written(replace(content, crs=""), form, tmp_path / "x") if (tmp_path / "x").mkdir() is None else path
    )
    assert read_content(other).crs == ""


def test_crs_transforms_points_with_their_covariances(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """From one zone of UTM to the next and to degrees; distances on the ground are what they were."""
    pyproj = pytest.importorskip("pyproj", reason=WITHOUT)
    source = tmp_path / "a.csv"
    source.write_text(
        "id,X,Y,Z,sX,sY,sZ\nA,700000,5600000,100,0.01,0.02,0.03\nB,700010,5600000,100,0.01,0.02,0.03\n"
    )
    convert(source, tmp_path / "b.csv", crs="EPSG:25832")  # stated, as none was known
    np.testing.assert_array_equal(
        read_content(tmp_path / "b.csv").result.estimate.points, read_content(source).result.estimate.points
    )
    convert(tmp_path / "b.csv", tmp_path / "c.geojson", crs="EPSG:25833")
    zone = read_content(tmp_path / "c.geojson").result
    x, y = pyproj.Transformer.from_crs(25832, 25833, always_xy=True).transform(
        [700000.0, 700010.0], [5.6e6, 5.6e6]
    )
    np.testing.assert_allclose(zone.estimate.points[:, :2], np.stack([x, y], 1), atol=1e-6)
    C = zone.point_covariance
    assert C is not None
    (dx,), (dy,) = np.diff(x), np.diff(y)  # the axis of X turned by the convergence of the meridians
    turned = np.array([dx, dy]) / 10
    J = np.column_stack([turned, [-turned[1], turned[0]]])
    expected = np.diagonal(J @ np.diag([1e-4, 4e-4]) @ J.T)
    np.testing.assert_allclose(np.diagonal(C[0])[:2], expected, rtol=1e-4)
    convert(tmp_path / "b.csv", tmp_path / "d.geojson", crs="EPSG:4979")
    file = json.loads((tmp_path / "d.geojson").read_text())
    assert "crs" not in file
    lon, lat = pyproj.Transformer.from_crs(25832, 4979, always_xy=True).transform(700000.0, 5.6e6)
    np.testing.assert_allclose(file["features"][0]["geometry"]["coordinates"][:2], [lon, lat], atol=1e-9)
    sigma = file["features"][0]["properties"]["sY"] * np.radians(1) * 6.37e6
    assert 0.01 < sigma < 0.021
    assert "left out" not in capsys.readouterr().out.replace("unit of lengths left out", "")


def test_what_crs_cannot_do_is_said(tmp_path: Path) -> None:
    pytest.importorskip("pyproj", reason=WITHOUT)
    source = tmp_path / "a.csv"
    source.write_text("id,X,Y,Z\nA,7,5,1\n")
    with pytest.raises(SurveyFileError, match="--crs: format colmap has photographs; only formats of points"):
        convert(source, tmp_path / "m", to_format="colmap", crs="EPSG:25832")
    with pytest.raises(
        SurveyFileError, match="--crs: 'EPSG:1' is no coordinate system, expected such as EPSG:32632"
    ):
        convert(source, tmp_path / "b.csv", crs="EPSG:1")
    source.write_text("# crs: nowhere\nid,X,Y,Z\nA,7,5,1\n")
    with pytest.raises(SurveyFileError, match="line 1: 'nowhere' is no coordinate system"):
        convert(source, tmp_path / "b.csv")


# --- damaged and hostile files ---


@pytest.mark.parametrize("form", NEW)
def test_damaged_files_end_in_one_line(form: str, tmp_path: Path) -> None:
    path = written(model(form, "damage"), form, tmp_path)
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    rng = seed_of(f"damage {form}")
    strange = ("nan", "x", "", "-5", "1e999", "9" * 30, "../../x", "1 2", "0", "\x1b[2J", "<a>", '"', "{}")
    refused = 0
    for file in files:
        whole = file.read_text()
        for trial in range(60):
            at = int(rng.integers(len(whole)))
            end = at + 1
            while end < len(whole) and whole[end] not in ' ,<>"\n:':
                end += 1
            while at > 0 and whole[at - 1] not in ' ,<>"\n:':
                at -= 1
            file.write_text(whole[:at] + strange[trial % len(strange)] + whole[end:])
            refused += assert_one_line(path, form)
        for part in (0.2, 0.6, 0.9):
            file.write_text(whole[: int(part * len(whole))])
            assert_one_line(path, form)
        file.write_bytes(b"\xff\xfe\x00")
        refused += assert_one_line(path, form)
        file.write_text(whole)
    assert refused > 10 * len(files)


def test_links_out_of_a_folder_are_refused(tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("1 2 3\n")
    for form, name in (
        ("micmac", "MesuresIm.xml"),
        ("aicon", "survey.obc"),
        ("agisoft-reference", "markers.csv"),
    ):
        (tmp_path / form).mkdir()
        path = written(model(form, "links"), form, tmp_path / form)
        (path / name).unlink()
        (path / name).symlink_to(tmp_path / "secret")
        with pytest.raises(SurveyFileError, match=f"{name}: a link that leaves its folder"):
            read_content(path)


def test_a_name_of_two_words_is_refused_by_aicon(tmp_path: Path) -> None:
    content = model("aicon", "names")
    network = replace(content.result.network, points=("a b", *content.result.network.points[1:]))
    with pytest.raises(OutputError, match="point 'a b' of format aicon, needed a name without spaces"):
        written(replace(content, result=replace(content.result, network=network)), "aicon", tmp_path)
