"""The layers of the house: every module imports only what stands to its left."""

from __future__ import annotations

import ast
import re
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from tests.places import ROOT

LAYERS = (
    ("sfm.model", "sfm.runtime", "sfm.files", "sfm.photographs"),
    ("sfm.targets", "sfm.matching", "sfm.orientation", "sfm.adjustment"),
    ("sfm.judgement.hypotheses",),  # of an adjustment; the rest of the room judges results
    (
        *("sfm.textbook", "sfm.comparison"),
        *("sfm.products.geometry", "sfm.products.epochs", "sfm.products.planning"),
        *("sfm.products.rendering", "sfm.products.printing", "sfm.products.georeferencing"),
    ),
    ("sfm.judgement.survey_result",),
    ("sfm.judgement",),
    (
        *("sfm.survey", "sfm.products.inspection", "sfm.products.drafting", "sfm.products.refining"),
        *("sfm.products.calibration", "sfm.products.auditing"),
    ),
    ("sfm.report",),
    (  # pages of products
        *("sfm.products.epochs.page", "sfm.products.inspection.page", "sfm.products.refining.page"),
        *("sfm.products.planning.page", "sfm.products.planning.further_page"),
        *("sfm.products.calibration.page", "sfm.products.auditing.page"),
    ),
    ("sfm.pipeline",),
    ("sfm.library",),  # the public functions
    ("sfm.products", "sfm.cli"),
)
CV2_ROOMS = (
    *("sfm.photographs", "sfm.targets", "sfm.matching", "sfm.orientation", "sfm.survey", "sfm.report"),
    *("sfm.products", "sfm.textbook"),
)
CV2_THREADS = "adapters.dask_cluster"  # holds OpenCV to one thread per worker, as it does BLAS
PAGES = LAYERS[8]  # of products
TERMINAL = ("sfm.products.batch.table", "sfm.runtime.progress_bar")
STAGES = (  # of a survey, in the order of `sfm.pipeline`
    ("sfm.survey.inputs",),
    ("sfm.survey.measuring", "sfm.survey.target_network"),
    ("sfm.survey.orientation", "sfm.survey.board_turns"),
    ("sfm.survey.sources.joined", "sfm.survey.sources.target_matching"),
    ("sfm.survey.adjusting",),
    ("sfm.survey.assembly",),
)
MAY_IMPORT_ADAPTERS = ("sfm.cli", "sfm.library")
ROOMS = LAYERS[1]  # of which none knows another


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {
    module_name(path): path for folder in ("sfm", "adapters") for path in (ROOT / folder).rglob("*.py")
}


@cache
def imported(path: Path) -> frozenset[str]:
    """Return the modules that a module imports anywhere in it, functions and type checking included."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            module = node.module or ""
            names.add(module)
            names.update(f"{module}.{a.name}" for a in node.names if f"{module}.{a.name}" in MODULES)
    return frozenset(names)


def belongs(name: str, group: str) -> bool:
    return name == group or name.startswith(group + ".")


def layer_of(name: str) -> int | None:
    """Return the layer of a module, which is that of the narrowest group that it belongs to."""
    groups = [(len(group), k) for k, groups in enumerate(LAYERS) for group in groups if belongs(name, group)]
    return max(groups)[1] if groups else None


def test_modules_import_only_to_the_left() -> None:
    for name in (name for name in MODULES if name.startswith("sfm.")):
        own = layer_of(name)
        assert own is not None, f"{name} is in no layer: give it a place in DESIGN's order and in this test"
        for other in (other for other in imported(MODULES[name]) if other.startswith("sfm.")):
            layer = layer_of(other)
            assert layer is not None, f"{name} imports {other}, which is in no layer"
            assert layer <= own, f"{name} imports {other}, which stands to its right"


@pytest.mark.parametrize("stage", range(len(STAGES)))
def test_no_stage_of_a_survey_reaches_a_later_one(stage: int) -> None:
    later = [name for names in STAGES[stage + 1 :] for name in names]
    for first in (name for name in MODULES for one in STAGES[stage] if belongs(name, one)):
        found, left = set[str](), [first]
        while left:
            name = left.pop()
            if name in MODULES and name not in found:
                assert not any(belongs(name, one) for one in later), f"{first} reaches {name}"
                found.add(name)
                left += [one for one in imported(MODULES[name]) if belongs(one, "sfm.survey")]


@pytest.mark.parametrize("room", ROOMS)
def test_siblings_do_not_import_one_another(room: str) -> None:
    for name, path in MODULES.items():
        if belongs(name, room):
            strangers = {o for o in imported(path) for r in ROOMS if r != room and belongs(o, r)}
            assert not strangers, f"{name} imports {sorted(strangers)} of a sibling room"


def test_measuring_depends_on_nothing_else() -> None:
    """The key of stored targets covers what these import; a changed sheet or renderer must not change it."""
    found: set[str] = set()
    left = ["sfm.targets.detect", "sfm.photographs.reading"]
    while left:
        name = left.pop()
        if name in MODULES and name not in found:
            found.add(name)
            left += imported(MODULES[name])
    types = {name for name in found if name.startswith("sfm.model.")}
    assert types == {f"sfm.model.{one}" for one in ("arguments", "conventions", "distributions", "errors")}
    rooms = {".".join(name.split(".")[:2]) for name in found}
    assert rooms == {"sfm.model", "sfm.photographs", "sfm.runtime", "sfm.targets"}


def test_only_the_command_line_and_the_library_import_adapters() -> None:
    for name, path in ((name, path) for name, path in MODULES.items() if belongs(name, "sfm")):
        if not any(belongs(name, room) for room in MAY_IMPORT_ADAPTERS):
            assert not [o for o in imported(path) if belongs(o, "adapters")], name
        elif belongs(name, "sfm.library"):  # in the functions that need them
            body = ast.parse(path.read_text(encoding="utf-8")).body
            at_once = [node.module or "" for node in body if isinstance(node, ast.ImportFrom)]
            assert not [o for o in at_once if belongs(o, "adapters")], name


def test_adapters_know_the_types_of_sfm_only() -> None:
    types = LAYERS[0]
    for name, path in MODULES.items():
        if name.startswith("adapters."):
            own = [o for o in imported(path) if o.startswith("sfm.")]
            assert all(any(belongs(o, t) for t in types) for o in own), f"{name} imports {own}"


def test_libraries_stay_in_their_rooms() -> None:
    for name, path in MODULES.items():
        libraries = {o.split(".")[0] for o in imported(path)}
        if "pycolmap" in libraries or "pyceres" in libraries:
            assert name == "adapters.colmap.adjuster", f"{name} imports pycolmap"
        if "cv2" in libraries:
            assert name == CV2_THREADS or any(belongs(name, room) for room in CV2_ROOMS), (
                f"{name} imports cv2"
            )
        assert not re.search(
            r"^(from|import) scipy(\.| import )stats", path.read_text(encoding="utf-8"), re.MULTILINE
        ), f"{name}: sfm.model.distributions spares a second of importing"
        if libraries & {"matplotlib"}:
            assert belongs(name, "sfm.report") or name in PAGES, f"{name} imports matplotlib"
        if libraries & {"typer", "rich"}:
            assert belongs(name, "sfm.cli") or name in TERMINAL, f"{name} imports libraries of the terminal"


def test_the_rules_would_notice() -> None:
    assert layer_of("sfm.targets.detect") == 1
    assert layer_of("sfm.survey.inputs.start") == 6
    assert layer_of("sfm.surveying") is None
    assert "sfm.model.errors" in imported(MODULES["sfm.cli"])


def test_no_two_rooms_import_one_another() -> None:
    """Of rooms neither of which lies in the other; the types of the field are a room each."""
    arrows: dict[tuple[str, str], str] = {}
    for name, path in MODULES.items():
        for other in imported(path) & MODULES.keys():
            arrows[room_of(name), room_of(other)] = f"{name} imports {other}"
    for (a, b), words in arrows.items():
        if "sfm" not in (a, b) and a != b and (b, a) in arrows and not belongs(a, b) and not belongs(b, a):
            raise AssertionError(f"{words}, and {arrows[b, a]}")


def test_no_modules_import_one_another_in_a_circle() -> None:
    """Not even in functions or for type checking."""
    arrows = {name: {other for other in imported(path) & MODULES.keys()} for name, path in MODULES.items()}
    for name, others in arrows.items():
        packages = {other for other in others if any(belongs(inner, other) for inner in others - {other})}
        others -= packages | {name}  # a package is named with its modules
    TopologicalSorter(arrows).prepare()


def room_of(name: str) -> str:
    room = name if MODULES[name].name == "__init__.py" else name.rpartition(".")[0]
    return name if room == "sfm.model" else room


def test_a_module_that_runs_has_all_its_functions_by_then() -> None:
    for name, path in MODULES.items():
        body = ast.parse(path.read_text(encoding="utf-8")).body
        runs = [isinstance(one, ast.If) and "__name__" in ast.unparse(one.test) for one in body]
        assert not any(runs[:-1]), f"{name} calls its main function before the last ones are defined"
