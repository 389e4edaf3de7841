"""The points that cover the photographs of a textured survey: their control, scale bars, and memory."""

from __future__ import annotations

import weakref
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sfm.matching.lsm.coverage import CoveredPixels
from sfm.matching.lsm.surface_planes import Planes
from sfm.matching.radiometry import GreyPhotographs
from sfm.matching.tracks import feature_tracks
from sfm.model.camera import project
from sfm.model.conventions import AnyArray
from sfm.model.network import ImagePoints, Network
from sfm.orientation.incremental.sequence import Orientation
from sfm.photographs import reading as reading_module
from sfm.photographs.reading import read_photograph
from sfm.survey.inputs.measurements import Measurements, PhotographList
from sfm.survey.inputs.settings import TiePointSettings
from sfm.survey.inputs.survey import Survey, read_survey
from sfm.survey.measuring import covering_points, surface_points, tie_points
from sfm.survey.measuring.covering_points import CoveringPoints, Squares, _visible
from sfm.survey.measuring.surface_points import Surface, cover_photographs
from sfm.survey.measuring.tie_points import natural_points_of
from tests.matching.test_tie_points import _scene as small_scene
from tests.synthetic import make_network, seed_of

SURVEY = """
[survey]
name = "surface"
unit = "m"
[[camera]]
name = "lens"
images = "*.png"
pixel_mm = [0.005, 0.005]
c_mm = 8.0
[targets]
codes = "none"
[tie_points]
"""
HELD = "window_px = 15\n"


def prepared(folder: Path, more: str) -> tuple[Survey, Measurements, Orientation]:
    """Return a survey of three small photographs, their true orientation and 35 tie points."""
    photographs, truth, _ = small_scene()
    (folder / "survey.toml").write_text(SURVEY + more)
    survey = read_survey(folder / "survey.toml")
    names = tuple(f"{i}.png" for i in range(3))
    for name, one in zip(names, photographs, strict=True):
        cv2.imwrite(str(folder / name), one.astype(np.uint8))
    n, camera = len(truth.points), np.zeros(3, dtype=np.int64)
    xy = np.concatenate([project(truth.cameras[0], truth.position[i], truth.rotation[i], truth.points)
                         for i in range(3)])  # fmt: skip
    seen = ImagePoints(
        np.repeat(np.arange(3), n), np.tile(np.arange(n), 3), xy, np.tile(np.eye(2), (3 * n, 1, 1))
    )
    network = Network(names, camera, tuple(f"tie {j + 1}" for j in range(n)), seen)
    files = PhotographList(names, tuple(folder / name for name in names), camera, folder)
    measured = Measurements(network, truth.cameras, names, np.full(n, 3), files=files)
    fits = np.ones(3 * n, dtype=bool)
    start = Orientation(truth, (), (), (names[0], names[1]), "spatial", fits, 0.1, np.ones(1))
    return survey, measured, start


def covered(folder: Path, more: str = HELD) -> Surface:
    """Return the surface of three small photographs from their true orientation and 35 tie points."""
    found = cover_photographs(*prepared(folder, more))
    assert found is not None
    return found


@pytest.mark.parametrize("copies", [1, 4])
def test_tie_points_stay_where_windows_are_fewer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, copies: int
) -> None:
    """Tie points of the same pixels count once: 35 are more than 30 windows, 140 are no more than 40."""
    survey, measured, start = prepared(tmp_path, HELD)
    network, estimate = measured.network, start.estimate
    n = len(network.points)
    beside = [replace(network.image_points, point=network.image_points.point + n * k) for k in range(copies)]
    points = tuple(f"{name} {k}" for k in range(copies) for name in network.points)
    network = replace(network, points=points, image_points=ImagePoints.joined(beside))
    measured = replace(measured, network=network, min_rays=np.full(n * copies, 3))
    start = replace(start, estimate=replace(estimate, points=np.tile(estimate.points, (copies, 1))))

    def first(windows: int) -> Surface | None:
        def some(*args: Any, **rest: Any) -> CoveringPoints:
            found = covering_points.find_covering_points(*args, **rest)
            kept = np.arange(len(found.points)) < windows
            return surface_points._some_points(found, kept, np.ones(len(found.image_points), dtype=bool))

        monkeypatch.setattr(surface_points, "find_covering_points", some)
        return cover_photographs(survey, measured, start)

    few, many = first(30), first(40)
    assert few is not None and many is not None
    assert few.network.points == points[:n]
    assert many.network.points[0] == "t00001"


@pytest.mark.parametrize(
    ("more", "searched"), [("", [2000] * 3 + [8000] * 3), ("max_features = 2000\n", [2000] * 3)]
)
def test_photographs_with_few_tie_points_are_searched_for_more_features(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, more: str, searched: list[int]
) -> None:
    survey, measured, _ = prepared(tmp_path, HELD + more)
    assert measured.files is not None
    asked = []
    monkeypatch.setattr(tie_points, "SCARCE_TIE_POINTS", 1000)  # those of this scene are fewer

    def found(path: Path, name: str, settings: TiePointSettings, *args: object, **rest: object) -> object:
        asked.append(settings.max_features)
        return natural_points_of(path, name, settings, *args, **rest)

    monkeypatch.setattr(tie_points, "natural_points_of", found)
    tied = tie_points.tie_photographs(survey, measured.files)
    assert asked == searched
    assert len(tied.network.points) > 10


def test_photographs_are_in_memory_only_while_they_are_needed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two of the three at a time, as the store of grey photographs has no place for more here."""
    survey, measured, start = prepared(tmp_path, HELD)
    assert measured.files is not None
    alive: list[weakref.ref[AnyArray]] = []
    most = 0

    def reading(path: Path, **channel: str) -> AnyArray:
        nonlocal most
        photograph = read_photograph(path, **channel)
        alive.append(weakref.ref(photograph))
        most = max(most, sum(one() is not None for one in alive))
        return photograph

    for module in (reading_module, tie_points):
        monkeypatch.setattr(module, "read_photograph", reading)
    for user in (feature_tracks, covering_points):
        monkeypatch.setattr(user, "GreyPhotographs", partial(GreyPhotographs, memory_bytes=0, grey_bytes=0))
    tie_points.tie_photographs(survey, measured.files)
    assert cover_photographs(survey, measured, start) is not None
    assert len(alive) > 6 and most <= 2


def test_control_and_scale_bars_are_of_the_points_of_the_result(tmp_path: Path) -> None:
    """By the names that the result gives them; the network is placed on three control points."""
    plain = covered(tmp_path)
    points = plain.estimate.points
    first, last = 0, len(points) - 1
    names, chosen = (
        plain.network.points,
        [first, last, int(points[:, 0].argmax()), int(points[:, 1].argmax())],
    )
    turned = 3 * points[:, [1, 0, 2]] * [-1, 1, 1] + 100
    rows = [f"{names[j]},{','.join(map(str, turned[j]))},1e-3,1e-3,1e-3" for j in chosen]
    (tmp_path / "control.csv").write_text("\n".join(["id,X,Y,Z,sX,sY,sZ", *rows]))
    bar = f'[[scale_bar]]\nfrom = "{names[first]}"\nto = "{names[last]}"\nlength = 2.5\nsigma = 1e-4\n'
    found = covered(tmp_path, HELD + bar + '[control]\nfile = "control.csv"\n')
    bars, control = found.network.scale_bars, found.network.control
    assert (bars.start.tolist(), bars.end.tolist()) == ([first], [last])
    assert sorted(control.point.tolist()) == sorted(chosen)
    np.testing.assert_allclose(found.estimate.points, turned, atol=1e-9)
    assert np.linalg.norm(found.estimate.position - 100, axis=1) == pytest.approx(
        3 * np.linalg.norm(plain.estimate.position, axis=1)
    )


def test_the_sigma_of_the_survey_sets_the_level_of_covariances_and_residuals_their_shape(
    tmp_path: Path,
) -> None:
    plain = covered(tmp_path, HELD + "[adjust]\nsigma_px = 0.1\n").network.image_points
    more = covered(tmp_path, HELD + "[adjust]\nsigma_px = 0.5\n").network.image_points
    np.testing.assert_array_equal(more.xy, plain.xy)
    ratio = np.linalg.norm(more.covariance, axis=(1, 2)) / np.linalg.norm(plain.covariance, axis=(1, 2))
    np.testing.assert_allclose(ratio, np.median(ratio), rtol=0.1)
    for one, sigma_px in ((plain, 0.1), (more, 0.5)):
        usual = np.median(np.trace(one.covariance, axis1=1, axis2=2)) / 2
        assert sigma_px**2 < usual < sigma_px**2 + 0.01


def test_a_photograph_has_as_many_points_as_the_survey_says(tmp_path: Path) -> None:
    """Of 480 x 360 pixels 100 take squares of 41, and each photograph adds few to those of the others."""
    per_photograph = {
        more: np.bincount(covered(tmp_path, HELD + more).network.image_points.image)
        for more in ("", "max_points = 100\n")
    }
    assert per_photograph["max_points = 100\n"].max() < 150 < per_photograph[""].min()


def test_windows_have_the_size_that_the_surface_bears_unless_the_survey_says_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(surface_points, "TRIED_WINDOWS_PX", (9,))
    monkeypatch.setattr(surface_points, "TRIAL_RAYS", 10)
    for more, side in (("", 9), (HELD, 15)):
        assert all((one.semi_axes == side / 2).all() for one in covered(tmp_path, more).overlays)


@pytest.mark.parametrize(
    ("found", "window_px"),
    [
        ({15: (1750, 0.057), 11: (2983, 0.066), 21: (973, 0.058)}, 11),  # stone
        ({15: (3889, 0.025), 11: (7112, 0.032), 21: (1937, 0.021)}, 15),  # smooth, white noise
        ({15: (265, 0.359), 11: (274, 0.316), 21: (300, 0.28)}, 21),  # correlated noise
        ({15: (265, 0.359), 11: (274, 0.316), 21: (10, 0.01)}, 11),  # too few of 21 px
        ({15: (1000, 0.05), 11: (1000, 0.048), 21: (1000, 0.048)}, 15),  # hardly better: not shown
        ({}, 15),
    ],
)
def test_windows_are_taken_whose_rays_together_are_precise(
    monkeypatch: pytest.MonkeyPatch, found: dict[int, tuple[int, float]], window_px: int
) -> None:
    """Rays and their spread on two photographs by side, four sides apart in each case."""

    def trial(*_: object, window_px: int, **__: object) -> CoveringPoints:
        rays, spread = found.get(window_px, (0, 1.0))
        seen = ImagePoints(*(np.zeros((rays, *shape)) for shape in ((), (), (2,), (2, 2))))
        return CoveringPoints(
            seen, np.zeros((0, 3)), np.zeros((rays, 2, 2)), np.full((rays, 2), spread), rays
        )

    monkeypatch.setattr(surface_points, "find_covering_points", trial)
    network, truth = make_network(seed_of("trial"), images=2, points=20)
    truth = replace(truth, cameras=tuple(replace(one, size_px=(1024, 768)) for one in truth.cameras))
    assert surface_points._best_window([], network, truth, TiePointSettings(), 1) == window_px
    given = TiePointSettings(window_px=15)
    assert surface_points._best_window([], network, truth, given, 1) == 15


def test_windows_that_agree_off_the_surface_do_not_disagree(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of ten points of two rays half are left out: no window of the 20 contradicts another."""
    network, truth = make_network(seed_of("off the surface"), images=2, points=10)
    seen = network.image_points
    good = np.arange(len(truth.points)) % 2 == 0
    monkeypatch.setattr(surface_points, "on_surface", lambda *_: good)
    found = CoveringPoints(
        seen, truth.points, np.zeros((len(seen), 2, 2)), np.zeros((len(seen), 2)), len(seen)
    )
    left = surface_points.without_far_points(found, truth)
    assert len(left.points) == good.sum() < len(good)
    assert left.matched == len(left.image_points) > 0
    assert surface_points.remarks_on_disagreement(left) == ()
    assert surface_points.remarks_on_disagreement(replace(left, matched=found.matched)) != ()


def test_rays_that_do_not_fit_tell_nothing_of_the_surface() -> None:
    """Nor do points that lose one of three by that."""
    _, truth, _ = small_scene()
    n = len(truth.points)
    xy = np.concatenate([project(truth.cameras[0], truth.position[i], truth.rotation[i], truth.points)
                         for i in range(3)])  # fmt: skip
    xy += 0.1 * np.random.default_rng(2).standard_normal(xy.shape)
    xy[n + 4] += 20.0
    seen = ImagePoints(
        np.repeat(np.arange(3), n), np.tile(np.arange(n), 3), xy, np.tile(np.eye(2), (3 * n, 1, 1))
    )
    network = Network(("a", "b", "c"), np.zeros(3, dtype=np.int64), tuple(map(str, range(n))), seen)
    fits = surface_points._fitting_rays(network, truth)
    assert (~fits).nonzero()[0].tolist() == [4, n + 4, 2 * n + 4]


def test_places_are_visible_where_photographs_look_at_their_plane_inside_their_border() -> None:
    _, truth, _ = small_scene()
    camera, X = np.zeros(3, dtype=np.int64), truth.points[[10, 10, 10]]
    to_second = truth.position[1] - X[0]
    to_second /= np.linalg.norm(to_second)
    across = np.cross(to_second, truth.rotation[1][:, 0])
    across /= np.linalg.norm(across)
    # normals that look at the second photograph, hardly look at it, and look away
    normal = np.stack([to_second, across + 0.2 * to_second, -to_second])
    planes = Planes(X, normal / np.linalg.norm(normal, axis=1, keepdims=True), np.zeros((3, 2, 2)))
    places = Squares(0, np.zeros((3, 2)), planes)
    covered_pixels = CoveredPixels([(360, 480)] * 3)
    assert _visible(truth, camera, places, covered_pixels, 11, 15)[1][1].tolist() == [
        True,
        False,
        False,
    ]
    assert not _visible(truth, camera, places, covered_pixels, 181, 15)[0][1].any()  # of 360 rows
    covered_pixels.cover(np.array([1]), np.array([[240.0, 180.0]]), np.array([1000.0]))
    seen, free = _visible(truth, camera, places, covered_pixels, 11, 15)
    assert free[0].all() and not free[1].any() and seen[1].any()
    # what a mask hides is not seen, and does not count as another photograph that shows the surface
    seen, free = _visible(truth, camera, places, CoveredPixels([(360, 480)] * 3), 11, 15, 15, covered_pixels)
    assert free[0].all() and not free[1].any() and not seen[1].any()
