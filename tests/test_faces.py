"""The rooms of sfm: their lists of public names, what they teach, and what their functions refuse."""

from __future__ import annotations

import ast
import doctest
import inspect
import pkgutil
import re
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np
import pytest

import sfm
from sfm.products.geometry import MeasuredPoints, Nominal, point_function
from tests.places import ROOMS, ROOT
from tests.products.epochs.scenes import POINTS, epoch
from tests.synthetic import make_network, seed_of

OWN = [("sfm", sfm), *((getattr(sfm, room).__name__, getattr(sfm, room)) for room in ROOMS)]
FUNCTIONS = {
    f"{room}.{name}": getattr(module, name)
    for room, module in OWN
    for name in module.__all__
    if isinstance(getattr(module, name), FunctionType)
}
XYZ = np.array([[0.0, 0, 5], [3, 0, 5], [3, 4, 5], [0, 4, 6]])
MEASURED = MeasuredPoints(tuple("abcd"), XYZ, None)
TANGENTS = sfm.orientation.tangents_of([1, 1, 10], np.eye(3), XYZ)
GREY = np.random.default_rng(1).integers(0, 255, (80, 80)).astype(np.uint8)
PLACE = np.array([[40.0, 40.0]])
STACK = np.zeros((2, 2, 2, 2))
NETWORK, TRUTH = make_network(seed_of("faces"), images=4, points=12, noise_px=0.1)
ADJUSTMENT = sfm.adjust(NETWORK, TRUTH)
PACKAGES = sorted(path for room in ("sfm", "adapters") for path in (ROOT / room).rglob("__init__.py"))
RAYS = {"positions": np.zeros((1, 3)), "rotations": np.eye(3)[None]}


@pytest.mark.parametrize("room", ROOMS)
def test_names_of_a_room_are_the_rows_of_its_stub(room: str) -> None:
    module = getattr(sfm, room)
    stub = (Path(module.__path__[0]) / "__init__.pyi").read_text(encoding="utf-8")
    assert list(module.__all__) == dir(module) == sorted(module.__all__)
    inner = {one.name for one in pkgutil.iter_modules(module.__path__)}
    assert not inner & set(module.__all__), "which of the two is meant depends on what was imported before"
    for name in module.__all__:
        source = getattr(module, name).__module__
        assert f"\nfrom {source} import {name} as {name}\n" in stub
    with pytest.raises(AttributeError, match=f"module '{module.__name__}' has no attribute 'orientate'"):
        module.orientate  # noqa: B018


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_explains_its_functions_and_its_example_runs(room: str) -> None:
    module = getattr(sfm, room)
    text = inspect.getdoc(module) or ""
    names = [name.rpartition(".")[2] for name in FUNCTIONS if name.startswith(f"sfm.{room}.")]
    assert not [name for name in names if name not in text]
    shift = np.zeros((POINTS, 3))
    shift[4] = 1.0
    given = {"first": epoch(0).result, "second": epoch(1, shift).result}
    finder = doctest.DocTestFinder(recurse=False, exclude_empty=True)
    (example,) = finder.find(module, room, extraglobs=given)
    assert len(example.examples) > 2
    assert doctest.DocTestRunner().run(example).failed == 0


@pytest.mark.parametrize("package", PACKAGES, ids=lambda path: path.parent.relative_to(ROOT).as_posix())
def test_a_room_describes_what_is_in_it(package: Path) -> None:
    """Names in its docstring are modules, folders or functions of the room, or full paths from the root."""
    text = ast.get_docstring(ast.parse(package.read_text())) or ""
    for name in re.findall(r"`([a-z_]\w*(?:\.\w+)*)/?`", text):
        folder = ROOT if name.startswith(("sfm.", "adapters.")) else package.parent
        assert _is_found(name, folder), f"{package}: {name}"


def _is_found(name: str, folder: Path) -> bool:
    """Return whether a dotted name is below a folder, or one alone is defined in any of its files."""
    if (folder / name).is_file():
        return True
    first, *rest = name.split(".")
    if (folder / first).is_dir():
        return not rest or _is_found(".".join(rest), folder / first)
    if (folder / f"{first}.py").is_file():
        return not rest or rest[0] in _defined(folder / f"{first}.py")
    return not rest and any(first in _defined(file) for file in folder.rglob("*.py*"))


@cache
def _defined(path: Path) -> frozenset[str]:
    """Return the names that a file defines at its top or, if it is a stub, imports."""
    if path.suffix not in (".py", ".pyi"):
        return frozenset()
    names = set()
    for one in ast.parse(path.read_text()).body:
        if isinstance(one, ast.FunctionDef | ast.ClassDef):
            names.add(one.name)
        elif isinstance(one, ast.AnnAssign | ast.Assign):
            names.update(name.id for name in ast.walk(one) if isinstance(name, ast.Name))
        elif isinstance(one, ast.ImportFrom) and path.suffix == ".pyi":
            names.update(alias.name for alias in one.names)
    return frozenset(names)


def test_importing_the_rooms_imports_no_library() -> None:
    rooms = ", ".join(f"sfm.{room}.__all__" for room in ROOMS)
    libraries = ("numpy", "numba", "cv2", "pydantic")
    code = f"import sys, sfm; {rooms}; print([one for one in {libraries} if one in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


@pytest.mark.parametrize("name", sorted(FUNCTIONS))
def test_an_argument_of_another_type_is_refused_by_its_name(name: str) -> None:
    function = FUNCTIONS[name]
    for parameter in inspect.signature(function).parameters:
        with pytest.raises(sfm.KolinearError, match=rf"^{function.__name__}: {parameter} is .*, expected "):
            function(**{parameter: object()})


@pytest.mark.parametrize(
    "call",
    [
        lambda: sfm.network_from_colmap(3),
        lambda: sfm.compare(NETWORK, NETWORK),
        lambda: sfm.orient(NETWORK, ["lens"]),
        lambda: sfm.project(TRUTH.cameras[0], [0, 0, 0], np.eye(3), [1, 2, 3]),
        lambda: sfm.fit_similarity(XYZ, XYZ, weights=np.zeros(4)),
        lambda: sfm.adjust(NETWORK, TRUTH, options=sfm.AdjustmentOptions(image_sigma_factor=STACK)),
        lambda: sfm.adjust(NETWORK, TRUTH, rejected=np.zeros(3, dtype=bool)),
        lambda: sfm.adjustment.w_test(ADJUSTMENT, alpha=7.0),
        lambda: sfm.comparison.robust_weights(np.zeros((5, 3)), np.zeros((3, 2)), np.ones(5, dtype=bool)),
        lambda: sfm.comparison.robust_weights(np.zeros((5, 3)), np.zeros((15, 2)), np.zeros(5, dtype=bool)),
        lambda: sfm.products.geometry.fit_shape(MEASURED, "plane", [99]),
        lambda: sfm.products.geometry.decide(np.zeros(3), np.zeros(2), 0.0, 1.0, 2.0),
        lambda: sfm.products.geometry.deviations_from_points(
            MEASURED, Nominal(("a",), XYZ[:1]), sfm.products.geometry.Tolerance("a", upper=1.0), chosen=[-1]
        ),
        lambda: sfm.products.geometry.distance(point_function(MEASURED, "a"), point_function(MEASURED, "x")),
        lambda: sfm.matching.match_points(STACK, GREY, PLACE),
        lambda: sfm.matching.match_ncc(GREY, GREY, PLACE, [PLACE]),
        lambda: sfm.matching.find_tie_points([GREY], []),
        lambda: sfm.matching.match_targets(TRUTH, NETWORK.camera, [STACK] * 4, tolerance_px=1.0),
        lambda: sfm.matching.match_targets(TRUTH, NETWORK.camera, [PLACE] * 4, tolerance_px=1.0, kinds=[[0]]),
        lambda: sfm.matching.match_targets(
            TRUTH, NETWORK.camera, [PLACE] * 4, tolerance_px=1.0, kinds=[[0, 1]] * 4
        ),
        lambda: sfm.matching.match_targets(TRUTH, [7] * 4, [PLACE] * 4, tolerance_px=1.0),
        lambda: sfm.matching.epipolar_paths(TRUTH, NETWORK.camera, 0, 77, PLACE, nearest=1.0, farthest=3.0),
        lambda: sfm.matching.resample(STACK, PLACE),
        lambda: sfm.targets.measure_edge_ellipses(STACK, PLACE, np.zeros((1, 3)), [1], noise=1.0),
        lambda: sfm.orientation.intersect(TANGENTS, [9] * 4, np.arange(4), **RAYS),
        lambda: sfm.orientation.intersect(TANGENTS, [0] * 4, [-1, 0, 1, 2], **RAYS),
        lambda: sfm.orientation.intersect(TANGENTS, [0] * 4, np.arange(4), **RAYS, n_points=2),
        lambda: sfm.orientation.intersect(TANGENTS, [0] * 4, np.arange(4), **RAYS, weights=STACK),
        lambda: sfm.orientation.choose_by_line(
            sfm.orientation.resect_fischler_bolles(TANGENTS, XYZ), np.vstack([TANGENTS, TANGENTS])
        ),
        lambda: sfm.orientation.expected_trials(0.0, 3),
        lambda: sfm.textbook.orient_direct(TANGENTS, [0] * 4, [9] * 4, XYZ),
        lambda: sfm.textbook.orient_direct(TANGENTS, [-2] * 4, np.arange(4), XYZ),
        lambda: sfm.textbook.orient_direct(TANGENTS[:0], [], [], XYZ),
        lambda: sfm.textbook.match_along_line(GREY, GREY, PLACE, [XYZ]),
        lambda: sfm.textbook.trilaterate(XYZ, [1, 2, 3], 1.0),
        lambda: sfm.textbook.pope_hinsken(XYZ[:3], XYZ[:3], [1, 2]),
        lambda: sfm.products.planning.object_of_points(("a",), XYZ, None),
        lambda: sfm.products.epochs.analyse_epochs([]),
    ],
)
def test_arguments_of_another_shape_are_refused_in_one_line(call: Callable[[], Any]) -> None:
    with pytest.raises(sfm.KolinearError) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_lists_are_taken_for_arrays() -> None:
    tangents, points = TANGENTS.tolist(), XYZ.tolist()
    found = sfm.orientation.resect_robust(tangents, points, tolerance=0.001)
    np.testing.assert_array_equal(
        found.position, sfm.orientation.resect_robust(TANGENTS, XYZ, tolerance=0.001).position
    )
    fits = [
        sfm.products.geometry.fit_shape(MEASURED, "plane", some, weights="equal")
        for some in (["a", "b", "c"], [0, 1, 2])
    ]
    np.testing.assert_array_equal(fits[0].distances, fits[1].distances)


@pytest.mark.parametrize("method", ["p4p", "rampal", "zeng_wang", "church", "dlt", "unknown_noise"])
def test_methods_of_resection_take_rays_and_points(method: str) -> None:
    """And answer with position, rotation and residuals, those with several solutions with the best first."""
    points = np.random.default_rng(4).uniform(-2, 2, (12, 3))
    if method == "p4p":
        points[:, 2] = 0.0
    position = np.array([0.5, -0.3, 9.0])
    tangents = sfm.orientation.tangents_of(position, np.eye(3), points)
    function = getattr(sfm.textbook, f"resect_{method}")
    assert list(inspect.signature(function).parameters)[1] == "points"
    found = function(tangents, points, position + 0.5) if method == "church" else function(tangents, points)
    best = found[0] if isinstance(found, tuple) else found
    np.testing.assert_allclose(best.position, position, atol=1e-6)
    np.testing.assert_allclose(best.rotation, np.eye(3), atol=1e-6)
    assert best.residuals.shape == tangents.shape


def test_steps_of_zeng_and_wang_lead_to_the_position() -> None:
    position, turn = np.array([1.0, 1.0, 10.0]), sfm.model.conventions.rotation_from_angles(0.1, -0.2, 0.3)
    tangents = sfm.orientation.tangents_of(position, turn, XYZ[:3])
    rays = np.column_stack([tangents, -np.ones(3)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    distances = np.linalg.norm(XYZ[:3] - position, axis=1)
    ratios = sfm.textbook.positive_roots(sfm.textbook.distance_quartic(rays, XYZ[:3]))
    assert np.abs(ratios - distances[2] / distances[0]).min() < 1e-9
    found = sfm.textbook.trilaterate(XYZ[:3], distances, sfm.textbook.direction_test(rays))
    np.testing.assert_allclose(found, position, atol=1e-9)
    np.testing.assert_allclose(sfm.textbook.pope_hinsken(rays, XYZ[:3], found), turn, atol=1e-9)
