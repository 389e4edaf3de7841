"""The designer: its gains against full inverses, its networks against rings and random ones, its time."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from sfm.model.camera import camera_from_values, project
from sfm.model.conventions import FloatArray
from sfm.model.errors import GeometryError
from sfm.products.planning.designer import POWER, StationLimits, candidates, design_network, gains, image_rows
from sfm.products.planning.page import DIAGRAM_PIXELS, design_diagram
from sfm.products.planning.planned_object import PlannedObject, object_of_points, shape_object
from sfm.products.planning.prediction import (
    MIN_RAYS,
    WantedPrecision,
    displacement_per_sigma,
    found_displacement,
    predict_network,
    short_of,
)
from sfm.products.planning.stations import (
    Stations,
    aim_camera,
    arrangement,
    choose_coded,
    roll_deg,
    roll_rotations,
)
from sfm.products.planning.visibility import Seeing, compute_target_size, sight_of
from sfm.runtime.progress import Silent, StageClock
from tests.synthetic import seed_of

CAMERA = camera_from_values(
    "c", "brown", (6000, 4000), (0.006, 0.006), c_mm=28.0, free=("c", "x0", "y0", "K1", "K2", "P1", "P2")
)
SEEING = Seeing(sigma_px=0.05)
CORRIDOR = StationLimits((1.0, 2.4), np.array([[-2.5, -2.4, 0.2], [2.5, -0.5, 2.3]]))
OBJECTS = {  # shape, sizes [m], where one may stand, wanted sigma [m]
    "plate": ("plate", (1.0, 0.7), StationLimits(floor=0.0), 8e-6),
    "box": ("box", (1.0, 0.6, 0.4), StationLimits(floor=0.0), 1.5e-5),
    "cylinder": ("cylinder", (0.8, 1.0), StationLimits(floor=0.0), 2e-5),
    "dish": ("dish", (1.0, 0.25), StationLimits(floor=0.3), 8e-6),
    "wall": ("wall", (4.0, 2.0), CORRIDOR, 4e-5),
}
MOST = 60
RINGS = ("ring", "two-rings", "hemisphere")


def needed(planned: PlannedObject, wanted: WantedPrecision, make: object, most: int = MOST) -> int:
    """Return the fewest photographs with which an arrangement reaches what is wanted; most + 1: none."""
    every = np.ones(len(planned.names), dtype=bool)
    for count in range(4, most + 1):
        stations = make(count)  # type: ignore[operator]
        try:
            if short_of(predict_network(planned, CAMERA, stations, SEEING), wanted, every) <= 1:
                return count
        except GeometryError:
            continue
    return most + 1


def compared(name: str, points: int, draws: int, count: int = 300) -> tuple[int, int, int]:
    """Return photographs needed: designed, by the best of the rings, by the luckiest of random choices."""
    kind, sizes, allowed, sigma = OBJECTS[name]
    planned, wanted = shape_object(kind, sizes, points), WantedPrecision(sigma=sigma)
    found = design_network(planned, CAMERA, replace(allowed, photographs=MOST), SEEING, wanted, count=count)
    assert found.reached, found.limit
    every = np.ones(points, dtype=bool)
    assert short_of(found.prediction, wanted, every) <= 1  # by the full covariance
    rings = min(
        needed(planned, wanted, lambda k, kind=kind: arrangement(f"{kind}:{k}", planned, CAMERA))
        for kind in RINGS
    )
    if name == "wall":  # a ring does not fit into a corridor: parallel views with photographs rolled in turn
        rings = min(
            needed(
                planned,
                wanted,
                lambda k, rows=rows: arrangement(f"strips:{-(-k // rows)}x{rows}", planned, CAMERA),
            )
            for rows in (1, 2, 3)
        )
    room = candidates(planned, CAMERA, allowed, SEEING, count=count)
    rng = seed_of(name)
    lucky = MOST + 1
    for _ in range(draws):
        order = rng.permutation(room.count)
        order = np.where(np.arange(len(order)) % 2 == 0, order, order + room.count)
        lucky = min(lucky, needed(planned, wanted, lambda k, order=order: room.stations.of(order[:k])))
    return len(found.prediction.stations), rings, lucky


def test_fewer_photographs_than_a_ring_or_at_random() -> None:
    kind, sizes, allowed, sigma = OBJECTS["box"]
    planned, wanted = shape_object(kind, sizes, 40), WantedPrecision(sigma=4 * sigma)
    steps: list[str] = []
    watching = Silent()
    watching.step = lambda name, done=None, total=None: steps.append(name)  # type: ignore[method-assign]
    with StageClock(watching).stage("plan"):
        found = design_network(planned, CAMERA, allowed, SEEING, wanted, count=80)
    assert f"predicting {len(found.prediction.stations)} photographs" in steps
    designed = len(found.prediction.stations)
    assert found.reached and found.shortfall <= 1
    assert needed(planned, wanted, lambda k: arrangement(f"ring:{k}", planned, CAMERA), designed) > designed
    room = candidates(planned, CAMERA, allowed, SEEING, count=80)
    order = seed_of("random").permutation(80)
    order = np.where(np.arange(80) % 2 == 0, order, order + room.count)
    assert needed(planned, wanted, lambda k: room.stations.of(order[:k]), designed) > designed


@pytest.mark.slow
@pytest.mark.parametrize("name", OBJECTS)
def test_five_objects_need_fewer_photographs_than_rings_or_at_random(name: str) -> None:
    designed, rings, lucky = compared(name, 150, 10)
    shown = [str(k) if k <= MOST else f"more than {MOST}" for k in (designed, rings, lucky)]
    print(f"{name}: designed {shown[0]}, best of rings {shown[1]}, luckiest of 10 random {shown[2]}")
    assert designed <= min(rings, lucky)


@pytest.mark.slow
def test_1000_points_and_300_candidates_are_designed_within_a_minute() -> None:
    planned = shape_object("box", (1.0, 0.6, 0.4), 1000)
    start = time.process_time()
    found = design_network(planned, CAMERA, StationLimits(floor=0.0), SEEING, WantedPrecision(sigma=1.5e-5))
    seconds = time.process_time() - start  # of one core; the machine may have other work
    print(f"{len(found.prediction.stations)} photographs in {seconds:.1f} s, reached {found.reached}")
    assert found.reached and found.photographs_tried == 600
    assert seconds < 60


def normal_matrices(rows: FloatArray) -> FloatArray:
    """Return the sum of A'PA of each point over some photographs, (n, 3, 3)."""
    return np.asarray(np.einsum("mnai,mnaj->nij", rows, rows))


def test_gains_are_those_of_inverses() -> None:
    planned = shape_object("box", (1.0, 0.6, 0.4), 30)
    stations = arrangement("hemisphere:6", planned, CAMERA)
    sight = sight_of(planned, CAMERA, stations.position, stations.rotation, SEEING)
    rows = image_rows(planned, CAMERA, stations, sight)
    N = normal_matrices(rows[:3]) + 1e8 * np.eye(3)
    scale = seed_of("scale").uniform(1e6, 1e8, 30)
    before = np.trace(np.linalg.inv(N), axis1=1, axis2=2) / 3
    found = gains(np.linalg.inv(N), rows, scale, np.array([False, True, True, True, True, True]))
    assert found[0] == -1
    for c in range(1, 6):
        after = np.trace(np.linalg.inv(N + normal_matrices(rows[c : c + 1])), axis1=1, axis2=2) / 3
        expected = ((before * scale) ** POWER - (after * scale) ** POWER).sum()
        assert found[c] == pytest.approx(expected, rel=1e-9)
    # A is the derivative of the projection: against the limiting covariance of the adjustment
    p = predict_network(planned, CAMERA, stations, SEEING)
    Q = np.linalg.inv(normal_matrices(rows)[p.determined])
    assert np.allclose(
        Q, p.adjustment.covariance.points_limiting[p.point[p.determined]], rtol=1e-3, atol=1e-12
    )


def test_candidates_keep_to_what_is_allowed() -> None:
    planned = shape_object("wall", (4.0, 2.0), 80)
    found = candidates(planned, CAMERA, CORRIDOR, SEEING, count=40)
    X0, half = found.stations.position, found.count
    assert half == 40 and CORRIDOR.space is not None and CORRIDOR.distance is not None
    assert (CORRIDOR.space[0] <= X0).all() and (CORRIDOR.space[1] >= X0).all()
    nearest = np.linalg.norm(planned.xyz[None] - X0[:, None], axis=2).min(axis=1)
    assert nearest.min() >= CORRIDOR.distance[0] and nearest.max() <= CORRIDOR.distance[1]
    assert (X0[:half] == X0[half:]).all()
    turn = found.stations.rotation[:half].transpose(0, 2, 1) @ found.stations.rotation[half:]
    assert np.allclose(turn, roll_rotations(np.eye(3)))


BEHIND = StationLimits(space=np.array([[-3.0, 1.0, 0.0], [3.0, 3.0, 2.0]]))


@pytest.mark.parametrize(
    ("allowed", "message"),
    [
        (BEHIND, "places that are allowed fewer than 2 show 4 points; the object faces away"),
        (
            StationLimits(space=np.array([[50.0, 50, 50], [60, 60, 60]])),
            "no room within .* needed a space that reaches",
        ),
        (StationLimits(distance=(5.0, 2.0)), "distances 5 to 2, needed 0 < least < most"),
        (
            StationLimits(distance=(5.0, 5.0001), space=np.array([[-1.0, -1, 0], [1, 0, 1]])),
            "no station is 5 to 5.0001",
        ),
        (StationLimits(space=np.array([[1.0, -1, 0], [-1, 0, 1]])), "a side without length"),
    ],
)
def test_no_room_for_stations_is_reported(allowed: StationLimits, message: str) -> None:
    planned = shape_object("wall", (2.0, 1.0), 30)
    with pytest.raises(GeometryError, match=message):
        design_network(planned, CAMERA, allowed, SEEING, WantedPrecision(sigma=1e-4), count=20)


def test_what_limits_a_design_is_said() -> None:
    planned = shape_object("plate", (1.0, 0.7), 20)
    few = design_network(
        planned,
        CAMERA,
        StationLimits(floor=0.0, photographs=6),
        SEEING,
        WantedPrecision(sigma=1e-7),
        count=40,
    )
    assert not few.reached and few.shortfall > 1 and "the 6 photographs that are allowed" in few.limit
    assert len(few.prediction.stations) == 6


def test_displacements_and_lengths_that_are_wanted() -> None:
    planned = shape_object("plate", (1.0, 0.7), 20)
    p = predict_network(planned, CAMERA, arrangement("ring:6", planned, CAMERA), SEEING)
    every = np.ones(20, dtype=bool)
    assert displacement_per_sigma() == pytest.approx(
        np.sqrt(2) * 4.55, abs=0.2
    )  # root of 20.7: m 3, 0.1 %, 80 %
    worst = float(found_displacement(p).max())
    assert short_of(p, WantedPrecision(displacement=worst), every) == pytest.approx(1.0)
    assert short_of(p, WantedPrecision(length_sigma=2 * p.length_sigma), every) == pytest.approx(0.5)
    turned = replace(planned, normals=planned.normals * np.where(np.arange(20) == 4, -1.0, 1.0)[:, None])
    unseen = predict_network(turned, CAMERA, p.stations, SEEING)  # lengths between the others count
    assert not unseen.determined[4] and short_of(unseen, WantedPrecision(length_sigma=1.0), every) == np.inf
    assert short_of(
        unseen, WantedPrecision(length_sigma=p.length_sigma), np.arange(20) != 4
    ) == pytest.approx(1, abs=0.2)
    lonely = replace(p, sight=p.sight.of(np.arange(6)))
    lonely.sight.visibility[MIN_RAYS - 1 :, 0] = 1
    assert short_of(lonely, WantedPrecision(sigma=1.0), every) == np.inf
    with pytest.raises(GeometryError, match="wanted sigma is -1"):
        WantedPrecision(sigma=-1.0)


def test_coded_targets_give_every_photograph_five() -> None:
    seen = seed_of("coded").random((12, 60)) < 0.3
    seen[3] = False
    seen[3, :3] = True  # shows three only
    chosen = choose_coded(seen)
    assert (seen[:, chosen].sum(axis=1) >= np.minimum(5, seen.sum(axis=1))).all()
    assert len(chosen) < 40


@pytest.mark.parametrize("roll", [-90.0, 0.0, 37.0, 90.0])
@pytest.mark.parametrize("direction", [(1.0, 0.2, -0.3), (0.0, 0.0, -1.0)])
def test_the_roll_of_a_shot(direction: tuple[float, ...], roll: float) -> None:
    assert roll_deg(aim_camera(np.array(direction), np.radians(roll))) == pytest.approx(roll, abs=1e-6)
    assert isinstance(Stations(("a",), np.zeros((1, 3)), np.eye(3)[None]).places, int)
    assert object_of_points(("a", "b", "c"), np.eye(3), None).size == pytest.approx(np.sqrt(3))


def test_formula_of_document_000() -> None:
    # 7 px with the document's Nikon D60 (23.6 mm, 3872 px) and 18 mm: a line through the origin
    size = compute_target_size(p=7, w_mm=23.6, d=5000.0, c_mm=18.0, n=3872)
    assert size.diameter == pytest.approx(7 * 23.6 * 5000 / (18 * 3872), abs=1e-12)
    assert size.diameter == pytest.approx(11.85, abs=0.01)
    assert size.ring == pytest.approx(3 * size.diameter)
    assert compute_target_size(p=7, w_mm=23.6, d=10.0, c_mm=18.0, n=3872).diameter == pytest.approx(
        0.0237, abs=1e-4
    )


@pytest.mark.parametrize("tilt", [0.0, 60.0])
def test_a_target_of_that_size_shows_that_many_pixels(tilt: float) -> None:
    size = compute_target_size(p=12, w_mm=36.0, d=3000.0, c_mm=28.0, n=6000, tilt_deg=tilt)
    camera = camera_from_values("c", "brown", (6000, 4000), (0.006, 0.006), c_mm=28.0)
    t = np.linspace(0, 2 * np.pi, 721)
    r, slope = size.diameter / 2, np.radians(tilt)
    rim = r * np.column_stack([np.cos(t), np.sin(t) * np.cos(slope), np.sin(t) * np.sin(slope)])
    xy = project(camera, np.array([0.0, 0.0, 3000.0]), np.eye(3), rim)
    across = np.ptp(xy, axis=0)
    assert across.min() == pytest.approx(12, rel=1e-3)
    assert across.max() == pytest.approx(12 / np.cos(slope), rel=1e-3)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"d": 0.0}, "distance is 0"),
        ({"c_mm": float("nan")}, "principal distance is nan"),
        ({"tilt_deg": 80.0}, "tilt is 80 deg, needed 0 to 75"),
    ],
)
def test_nonsense_is_refused(wrong: dict[str, float], message: str) -> None:
    given = {"p": 7, "w_mm": 36.0, "d": 1000.0, "c_mm": 24.0, "n": 6000} | wrong
    with pytest.raises(GeometryError, match=message):
        compute_target_size(**given)


def test_command() -> None:
    camera = ["--c-mm", "18", "--sensor-width-mm", "23.6", "--width-px", "3872"]
    words = ["plan", "target-size", "--distance", "5", "--unit", "m", *camera]
    done = subprocess.run(
        [sys.executable, "-c", "from sfm.cli import main; main()", *words], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "0.01185 m, 7 px across" in done.stdout
    assert "0.03555 m outer diameter (ring14)" in done.stdout
    bad = [*words[:-1], "0"]
    done = subprocess.run(
        [sys.executable, "-c", "from sfm.cli import main; main()", *bad], capture_output=True, text=True
    )
    assert done.returncode == 2
    assert done.stderr.strip() == "kolinear: target size: photograph is 0, needed more than 0"
    bad = [*words[:5], "furlong", *camera]
    done = subprocess.run(
        [sys.executable, "-c", "from sfm.cli import main; main()", *bad], capture_output=True, text=True
    )
    assert done.returncode == 2
    assert (
        done.stderr.strip()
        == "kolinear: --unit furlong: expected one of km, m, dm, cm, mm, um, µm, nm, in, ft"
    )


def test_the_design_diagram_ends_at_the_diameters_of_the_farthest_distance() -> None:
    """Document 000, fig. 2.11: 7 px of a Nikon D60 at 18 mm; 23.6 mm x 7 / (18 mm x 3872) = 2.37 mm per m."""
    given = {"w_mm": 23.6, "d": 10.0, "c_mm": 18.0, "n": 3872}
    assert 1000 * compute_target_size(p=7, **given).diameter == pytest.approx(23.703, abs=5e-4)
    root = ElementTree.fromstring(design_diagram(unit="m", **given))
    path = "{http://www.w3.org/2000/svg}path"
    ends = {}
    for pixels in DIAGRAM_PIXELS:
        (line,) = root.findall(f".//*[@id='{pixels:g} px']/{path}")
        x0, y0, x1, y1 = map(float, re.findall(r"[\d.]+", line.attrib["d"]))
        ends[pixels] = x0, y0, x1, y0 - y1
    assert len({one[:3] for one in ends.values()}) == 1
    for pixels, end in ends.items():  # lengths in the picture are in proportion to the diameters
        assert end[3] / ends[7.0][3] == pytest.approx(pixels / 7, rel=1e-4)
    with pytest.raises(GeometryError):
        design_diagram(unit="m", w_mm=23.6, d=-1.0, c_mm=18.0, n=3872)
