"""Rendered photographs against analytic areas, centres of area and the collinearity equations."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from sfm.model.camera import camera_from_values, project
from sfm.model.conventions import rotation_from_angles
from sfm.model.errors import GeometryError, SurveyFileError
from sfm.products.rendering.render import (
    main,
    painting_order,
    project_targets,
    render_photograph,
    render_photographs,
    write_photographs,
)
from sfm.products.rendering.scene import (
    CircularTargets,
    Faces,
    Light,
    Optics,
    Scene,
    coded_ring,
    discs,
    join_marks,
)
from sfm.products.rendering.scene_file import read_scene
from sfm.targets.codes.plates import code_family
from sfm.targets.codes.rings import read_codes
from tests.places import ROOT
from tests.tables import rows_of

DEMO = ROOT / "datasets/demo/scene.toml"
SIZE = (320, 240)
DISTANCE = 200.0
CAMERAS = {
    "brown": (("K1", 4e-3), ("K2", -2e-4), ("P1", 2e-3), ("b1", 2e-3), ("x0", 0.02)),
    "brown_forward": (("K1", -4e-3), ("P2", 2e-3), ("b2", 1e-3)),
    "opencv": (("k1", -0.2), ("k2", 0.05), ("p1", 0.004)),
    "full_opencv": (("k1", 0.4), ("k4", 0.6), ("p2", -0.004)),
}
# A cell does not know where in it the light falls: moments of a dot of 5 px radius are true to 1.5e-3 px with
# 2 cells along a pixel, and four times better with 4. Rounding and linear rays in a pixel stay far below.
EXACT_PX = {2: 1.5e-3, 4: 4e-4}


def camera(model="brown", values=()):
    return camera_from_values("test", model, SIZE, (0.01, 0.01), c_mm=4.0, values=values)


def one_face(half=(40.0, 30.0), value=0.2):
    return Faces(
        np.zeros((1, 3)), np.array([[[1.0, 0, 0], [0, 1, 0]]]), np.array([half]), np.array([value]),
        np.zeros(1), np.ones(1),
    )  # fmt: skip


def dots(centres, radius, *, value=0.9):
    """A dark sheet with bright dots, all uncoded targets."""
    centres = np.asarray(centres, dtype=float)
    k = len(centres)
    targets = CircularTargets(np.zeros(k, dtype=int), centres, np.full(k, radius), np.full(k, -1))
    return Scene(one_face(), discs(0, centres, radius, value), targets, background=0.2)


def station(tilt_deg=0.0, kappa_deg=0.0, distance=DISTANCE):
    R = rotation_from_angles(np.radians(tilt_deg), np.radians(tilt_deg / 2), np.radians(kappa_deg))
    return R @ np.array([0.0, 0.0, distance]), R


def exact(**options):
    return Optics(**({"blur_px": 0.7, "exposure": 1.0, "bits": 16} | options))


def centre_of_light(photograph, near, reach, dark):
    """Centre and sum of the light above the dark, in a window around a place."""
    x0, y0 = np.round(near).astype(int)
    part = photograph[y0 - reach : y0 + reach + 1, x0 - reach : x0 + reach + 1].astype(float) / 65535 - dark
    y, x = np.mgrid[y0 - reach : y0 + reach + 1, x0 - reach : x0 + reach + 1]
    return np.array([(part * x).sum(), (part * y).sum()]) / part.sum(), part.sum()


@pytest.mark.parametrize("model", CAMERAS)
@pytest.mark.parametrize(("tilt", "cells"), [(0.0, 2), (50.0, 2), (50.0, 4)])
def test_centres_of_area_are_where_the_truth_says(model, tilt, cells):
    scene = dots([(-15.3, -8.1), (0.2, 0.1), (14.7, 9.4), (-12.2, 11.3), (13.0, -9.9)], 2.5)
    cam = camera(model, CAMERAS[model])
    position, R = station(tilt, 25.0)
    photograph, truth = render_photograph(
        scene, cam, position, R, optics=exact(oversampling=cells), rng=np.random.default_rng(0)
    )
    assert truth.visible.all()
    for k in range(5):
        centre, _ = centre_of_light(photograph, truth.outline_centre[k], 12, 0.2)
        assert centre == pytest.approx(truth.outline_centre[k], abs=EXACT_PX[cells])
    places = scene.faces.place(scene.targets.face, scene.targets.centre)
    assert truth.centre == pytest.approx(project(cam, position, R, places), abs=1e-9)


def test_area_of_a_circle_seen_square_and_its_contrast():
    radius, cam = 3.0, camera()
    position, R = station()
    photograph, truth = render_photograph(
        dots([(0.13, -0.27)], radius), cam, position, R, optics=exact(), rng=np.random.default_rng(0)
    )
    _, light = centre_of_light(photograph, truth.centre[0], 15, 0.2)
    r_px = radius * cam.c_px / DISTANCE
    assert light == pytest.approx(np.pi * r_px**2 * 0.7, rel=2e-4)
    assert truth.diameter[0] == pytest.approx(2 * r_px, rel=1e-6)
    assert truth.outline_centre == pytest.approx(truth.centre, abs=1e-6)


def test_the_centre_of_the_ellipse_is_off_by_the_eccentricity():
    """Dold (1996): a circle of radius r at tilt a and distance D is off by c r^2 sin a cos a / D^2."""
    scene, cam = dots([(0.0, 0.0)], 4.0), camera()
    tilt = np.radians(40.0)
    R = rotation_from_angles(tilt, 0, 0)
    position = R @ [0.0, 0.0, DISTANCE]
    _, truth = render_photograph(scene, cam, position, R, optics=exact(), rng=np.random.default_rng(0))
    first_order = cam.c_px * 16 * np.sin(tilt) * np.cos(tilt) / DISTANCE**2
    off = truth.outline_centre[0] - truth.centre[0]
    assert abs(off[0]) < 1e-6
    assert abs(off[1]) == pytest.approx(first_order, rel=2e-3)


@pytest.mark.parametrize("family", ["ring12", "ring14", "ring20", "arcs"])
@pytest.mark.parametrize("dark", [True, False])
def test_coded_rings_are_read_back(family, dark):
    codes = code_family(family)
    numbers = (
        [1, 2, 3, 4]
        if family == "arcs"
        else [int(codes.number[k]) for k in (0, 7, 40, len(codes.number) // 2)]
    )
    ink, paper = (0.05, 0.8) if dark else (0.85, 0.08)
    places = np.array([(-24.0, -15), (23, -14), (-23, 15), (22, 16)])
    marks = [
        coded_ring(0, at, 2.4, n, codes, ink, turn=0.3 * n) for at, n in zip(places, numbers, strict=True)
    ]
    targets = CircularTargets(np.zeros(4, dtype=int), places, np.full(4, 2.4), np.array(numbers))
    scene = Scene(one_face(value=paper), join_marks(marks), targets, background=paper)
    position, R = station(20.0, 70.0, distance=180.0)
    photograph, truth = render_photograph(
        scene, camera("brown", CAMERAS["brown"]), position, R,
        optics=Optics(noise=0.005), rng=np.random.default_rng(1),
    )  # fmt: skip
    rim = np.repeat(places, 2, axis=0) + np.tile(2.4 * np.eye(2), (4, 1))
    rim = scene.faces.place(np.zeros(8, dtype=int), rim)
    edge = project(camera("brown", CAMERAS["brown"]), position, R, rim)
    shape = []
    for k in range(4):
        A = (edge[2 * k : 2 * k + 2] - truth.centre[k]).T  # pictures of the radii along a and b
        value, vector = np.linalg.eigh(A @ A.T)
        S = vector @ np.diag(value**-0.5) @ vector.T
        shape.append([S[0, 0], S[0, 1], S[1, 1]])
    level = np.tile(255 * 0.9 * np.array([paper, ink - paper]), (4, 1))
    read, confidence, *_ = read_codes(photograph, truth.centre, np.array(shape), level, codes)
    assert read.tolist() == numbers
    assert confidence.min() > 0.3


def test_blur_noise_vignetting_and_light():
    flat = Scene(one_face((500.0, 500.0), 0.5), join_marks([]), dots([(0.0, 0.0)], 1.0).targets)
    position, R = station()
    optics = Optics(exposure=1.0, noise=0.01, shot_noise=0.02, vignetting=0.4, bits=16)
    photograph, _ = render_photograph(
        flat, camera(), position, R, optics=optics, rng=np.random.default_rng(2)
    )
    light = photograph / 65535
    assert light[110:130, 150:170].mean() == pytest.approx(0.5, abs=0.003)
    assert light[:8, :8].mean() == pytest.approx(0.5 * 0.62, abs=0.01)
    sigma = np.std(np.diff(light[100:140, 140:180], axis=1)) / np.sqrt(2)
    assert sigma == pytest.approx(np.hypot(0.01, 0.02 * np.sqrt(0.5)), rel=0.1)
    lit = replace(flat, light=Light(np.array([0.0, 0.0, 100.0]), 100.0, 0.1))
    photograph, _ = render_photograph(
        lit, camera(), position, R, optics=exact(), rng=np.random.default_rng(2)
    )
    X = (300 - 159.5) * DISTANCE / camera().c_px
    shine = 0.1 + 100**3 / np.hypot(X, 100.0) ** 3
    assert photograph[119, 160] / 65535 == pytest.approx(0.5 * 1.1, rel=1e-3)
    assert photograph[119, 300] / 65535 == pytest.approx(0.5 * shine, rel=5e-3)


def test_an_edge_blurred_by_the_point_spread_has_its_width():
    """The profile across a straight edge is the normal distribution of the blur, averaged over pixels."""
    from scipy.stats import norm

    half = 10.0 + 0.3 * DISTANCE / camera().c_px
    scene = Scene(one_face((half, 100.0), 1.0), join_marks([]), dots([(0, 0)], 1.0).targets, background=0.0)
    position, R = station()
    photograph, _ = render_photograph(
        scene, camera(), position, R, optics=exact(blur_px=0.8, oversampling=4), rng=np.random.default_rng(0)
    )
    edge = 159.5 + half * camera().c_px / DISTANCE
    x = np.arange(int(edge) - 6, int(edge) + 7)

    def integral(t):
        return t * norm.cdf(t) + norm.pdf(t)

    low, high = (edge - x - 0.5) / 0.8, (edge - x + 0.5) / 0.8
    expected = 0.8 * (integral(high) - integral(low))
    assert photograph[120, x] / 65535 == pytest.approx(expected, abs=1e-3)


def box_on_table():
    """A table, a box standing on it and a lid floating above a part of the table."""
    x, y, z = np.eye(3)
    return Faces(
        centre=np.array([[0, 0, 0], [0, 0, 20], [0, -10, 10], [10, 0, 10], [30, 0, 5.0]]),
        axes=np.array([[x, y], [x, y], [x, z], [y, z], [x, y]]),
        half=np.array([[60, 60], [10, 10], [10, 10], [10, 10], [8, 8.0]]),
        value=np.array([0.8, 0.1, 0.2, 0.3, 0.4]),
        texture=np.zeros(5),
        grain=np.ones(5),
    )


def test_faces_hide_what_is_behind_them():
    at = np.array([[0.0, 30.0], [30.0, 3.0], [-20.0, -20.0], [0.0, 0.0]])
    faces = np.array([0, 0, 0, 1])
    targets = CircularTargets(faces, at, np.full(4, 2.0), np.full(4, -1))
    scene = Scene(
        box_on_table(),
        join_marks([discs(f, a[None], 2.0, 0.5) for f, a in zip(faces, at, strict=True)]),
        targets,
    )
    R = rotation_from_angles(np.radians(60), np.radians(0), 0)
    position = R @ [0.0, 0.0, 250.0]
    order = list(painting_order(scene, position))
    assert order[0] == 0
    assert set(order) == {0, 1, 2, 4}  # the side x = 10 is seen from its edge
    photograph, truth = render_photograph(
        scene, camera(), position, R, optics=exact(), rng=np.random.default_rng(0)
    )
    # Behind the box (tan 30 deg * 35 > 20 high), under the lid, free on the table, on top of the box.
    assert truth.visible.tolist() == [False, False, True, True]

    def seen(X):
        column, row = np.round(project(camera(), position, R, np.array([X]))[0]).astype(int)
        return photograph[row, column] / 65535

    assert seen([5.0, 5.0, 20.0]) == pytest.approx(0.1, abs=0.01)
    assert seen([0.0, -10.0, 10.0]) == pytest.approx(0.2, abs=0.01)
    assert seen([30.0, 0.0, 5.0]) == pytest.approx(0.4, abs=0.01)
    assert seen([-30.0, 0.0, 0.0]) == pytest.approx(0.8, abs=0.01)


def test_targets_cut_by_the_border_or_behind_the_camera_are_not_visible():
    scene = dots([(0.0, 0.0), (79.5, 0.0), (200.0, 0.0)], 2.0)
    scene = replace(scene, faces=one_face((300.0, 300.0)))
    position, R = station()
    _, truth = render_photograph(scene, camera(), position, R, optics=exact(), rng=np.random.default_rng(0))
    assert truth.visible.tolist() == [True, False, False]
    away = np.diag([1.0, -1.0, -1.0])
    _, truth = render_photograph(
        scene, camera(), position, away, optics=exact(), rng=np.random.default_rng(0)
    )
    assert not truth.visible.any()


def test_the_seed_alone_decides_the_noise_whatever_the_threads():
    scene = dots([(0.0, 0.0)], 3.0)
    stations = [station(10.0 * k) for k in range(3)]
    arguments = (scene, camera(), np.array([p for p, _ in stations]), np.array([R for _, R in stations]))
    optics = Optics(noise=0.02)
    first, _ = render_photographs(*arguments, optics=optics, seed=5, threads=1)
    again, _ = render_photographs(*arguments, optics=optics, seed=5, threads=3)
    other, _ = render_photographs(*arguments, optics=optics, seed=6)
    assert all((a == b).all() for a, b in zip(first, again, strict=True))
    assert any((a != b).any() for a, b in zip(first, other, strict=True))


def test_bits_are_8_or_16():
    position, R = station()
    with pytest.raises(GeometryError, match="12 bits asked for"):
        render_photograph(
            dots([(0, 0)], 2.0), camera(), position, R, optics=Optics(bits=12), rng=np.random.default_rng(0)
        )


SMALL = """
[scene]
photographs = "p{}.png"
codes = "ring14"
[camera]
model = "brown"
size_px = [160, 120]
pixel_mm = [0.01, 0.01]
c_mm = 2.0
[[face]]
name = "sheet"
centre = [0.0, 0.0, 0.0]
a = [2.0, 0.0, 0.0]
b = [0.3, 1.0, 0.0]
size = [100.0, 80.0]
reflectance = 0.8
[[face.grid]]
first = [-20.0, 0.0]
step = [20.0, 0.0]
count = [3, 1]
radius = 2.5
reflectance = 0.1
codes = [7, 0, -1]
[[face.print]]
at = [-30.0, 30.0]
lines = 2
length = 40.0
height = 2.0
reflectance = 0.3
[[station]]
position = [10.0, -20.0, 100.0]
look_at = [0.0, 0.0, 0.0]
roll_deg = 30.0
[[station]]
position = [0.0, 0.0, 100.0]
look_at = [0.0, 0.0, 0.0]
"""


def test_a_scene_file_gives_photographs_and_their_truth(tmp_path):
    scene = tmp_path / "scene.toml"
    scene.write_text(SMALL)
    staging = read_scene(scene)
    np.testing.assert_allclose(staging.rotations[0] @ staging.rotations[0].T, np.eye(3), atol=1e-12)
    centre = project(staging.camera, staging.positions[0], staging.rotations[0], np.zeros((1, 3)))
    np.testing.assert_allclose(centre, [[79.5, 59.5]], atol=1e-9)
    write_photographs(staging, tmp_path / "out")
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        "manifest.json", "p1.png", "p2.png", "truth_image_points.csv", "truth_images.csv", "truth_points.csv",
    ]  # fmt: skip
    points = rows_of(tmp_path / "out/truth_points.csv")
    assert [(p["target"], p["code"], float(p["X"])) for p in points] == [
        ("7", "7", -20.0),
        ("t002", "-1", 0.0),
    ]
    assert len(rows_of(tmp_path / "out/truth_image_points.csv")) == 4


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("codes = [7, 0, -1]", "codes = [7, 0]", "face sheet: 2 codes for a grid of 3 x 1"),
        ('codes = "ring14"', "", "code 7, but .scene. codes is none"),
        ("reflectance = 0.8", "reflectance = 1.8", "face.0.reflectance"),
        ("radius = 2.5", "radius = 2.5\ncolour = 3", "colour"),
        ("[scene]", "[scene", "scene.toml"),
        ('codes = "ring14"', 'codes = "aruco4x4_50"', "codes = 'aruco4x4_50', expected rings or arcs"),
        ('model = "brown"', 'model = "panorama"', "camera.model: model 'panorama', expected one of brown"),
    ],
)
def test_wrong_scene_files_are_one_line(tmp_path, old, new, message):
    scene = tmp_path / "scene.toml"
    scene.write_text(SMALL.replace(old, new, 1))
    with pytest.raises(SurveyFileError, match=message) as error:
        read_scene(scene)
    assert "\n" not in str(error.value)


def test_unknown_code_numbers_are_named(tmp_path):
    scene = tmp_path / "scene.toml"
    scene.write_text(SMALL.replace("[7, 0, -1]", "[7000, 0, -1]"))
    with pytest.raises(GeometryError, match="code 7000: family ring14 has 1 to"):
        read_scene(scene)


def test_the_command_refuses_in_one_line(tmp_path):
    run = subprocess.run(
        [sys.executable, "-m", "sfm.products.rendering.render", str(tmp_path / "none.toml"), str(tmp_path)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert run.returncode == 2
    assert run.stderr.startswith("error: ")
    assert run.stderr.count("\n") == 1


def test_a_fault_of_the_command_is_one_line_and_its_own_exit_code(tmp_path, monkeypatch, capsys):
    def fail(_):
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr("sfm.products.rendering.render.read_scene", fail)
    monkeypatch.setattr("sys.argv", ["render", "a.toml", str(tmp_path / "out")])
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert main() == 70
    told = capsys.readouterr().err
    assert told.startswith("error: a fault of Kolinear: ZeroDivisionError: division by zero (test_render.py")
    assert told.count("\n") == 1 and len(list(tmp_path.glob("kolinear-fault-*.txt"))) == 1


def test_the_demo_scene_shows_most_targets_in_most_photographs():
    staging = read_scene(DEMO)
    assert len(staging.names) == 12
    seen = np.array(
        [
            project_targets(staging.scene, staging.camera, X0, R).visible
            for X0, R in zip(staging.positions, staging.rotations, strict=True)
        ]
    )
    assert (seen.sum(axis=0) >= 3).mean() > 0.9
    assert (seen.sum(axis=1) > 80).all()
