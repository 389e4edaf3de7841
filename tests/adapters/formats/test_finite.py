"""No writer of any format writes a number that is not finite: it refuses, or leaves the number out."""

from __future__ import annotations

import json
import re
import sqlite3
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adapters.colmap.camera_models import read_scene, write_scene
from adapters.colmap.model_files import check_model_files
from adapters.formats.content import Content
from adapters.formats.registry import FORMATS, read_content, write_content
from sfm.adjustment.solve import adjust
from sfm.model.camera import camera_from_values
from sfm.model.conventions import AnyArray
from sfm.model.errors import OutputError
from sfm.model.network import ObjectPoints
from sfm.model.observations.control_and_bars import InteriorObservations
from sfm.model.observations.pose import ExteriorObservations
from tests.adapters.formats.clouds import library
from tests.synthetic import make_network

pycolmap = pytest.importorskip("pycolmap")

# In every format: nan, inf, 1.#INF and their spellings, as a number and not as a part of a name
NOT_FINITE = re.compile(r"(?<![\w.])[-+]?(nan|inf|infinity|1\.#\w+)(?![\w.])", re.IGNORECASE)
OPENCV = (
    *("colmap", "colmap-text", "colmap-database", "metashape", "bal", "sba", "rig"),
    *("opensfm", "nerfstudio", "alicevision"),
)
MODEL_OF = dict.fromkeys(OPENCV, "opencv") | {"bundler": "radial"}
MODEL_OF |= dict.fromkeys(("openmvg", "micmac", "aicon", "realitycapture"), "brown_forward")


def _content(model: str, *, calibrated: bool = False) -> Content:
    """Return an adjusted network with every kind of given value, and its covariances."""
    network, truth = make_network(
        np.random.default_rng(5), images=5, points=12, model=model, noise_px=0.1, visibility=1.0
    )
    camera = truth.cameras[0]
    pixel = (float(camera.pixel_mm[0]), float(camera.pixel_mm[1]))
    lens = camera_from_values(
        camera.name, model, camera.size_px, pixel, c_mm=10.0, free=() if calibrated else camera.names[:1]
    )
    solved = adjust(network, replace(truth, cameras=(lens,)), reject="none")
    rng = np.random.default_rng(0)
    angles = rng.normal(0, 0.1, (2, 3))
    network = (
        replace(network, points=tuple(str(j + 1) for j in range(len(network.points))))
        .with_given(
            ObjectPoints(np.arange(3), solved.estimate.points[:3], np.tile(1e-6 * np.eye(3), (3, 1, 1))),
            ExteriorObservations(
                np.arange(2), solved.estimate.position[:2], angles, np.tile(1e-4 * np.eye(6), (2, 1, 1))
            ),
            InteriorObservations(
                np.zeros(1, dtype=np.int64),
                np.zeros(1, dtype=np.int64),
                lens.parameters[:1],
                np.array([0.01]),
            ),
        )
        .with_scale_bar("1", "5", 1.0, 0.001)
    )
    seen = network.image_points
    checks = ObjectPoints(np.array([4]), solved.estimate.points[4:5], 1e-6 * np.eye(3)[None])
    result = replace(solved.solution, network=network, estimate=solved.estimate, unit="m")
    few = np.arange(len(seen)) < 3
    network = replace(network, image_points=seen.select(~few))
    return Content(replace(result, network=network), seen.select(few), checks, sigma0=1.0, sigma0_px=0.1)


def _places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the paths to all arrays of numbers in a dataclass of dataclasses and tuples."""
    if isinstance(value, np.ndarray) and value.dtype == np.float64 and value.size:
        yield path
    elif isinstance(value, tuple):
        for k, part in enumerate(value):
            yield from _places(part, (*path, k))
    elif is_dataclass(value) and type(value).__name__ not in ("JointCovariance", "Normals"):
        for field in fields(value):
            yield from _places(getattr(value, field.name), (*path, field.name))


def _with(value: Any, path: tuple[Any, ...], number: float, at: int) -> Any:
    """Return a copy of a value in which one number of the array at a path is another."""
    if not path:
        changed: AnyArray = value.copy()
        changed.flat[at % changed.size] = number
        return changed
    step, *rest = path
    if isinstance(step, int):
        return (*value[:step], _with(value[step], tuple(rest), number, at), *value[step + 1 :])
    return replace(value, **{step: _with(getattr(value, step), tuple(rest), number, at)})


def _refuse_not_finite(path: Path) -> None:
    """Assert that all numbers in a file or a folder are finite."""
    files = [file for file in path.rglob("*") if file.is_file()] if path.is_dir() else [path]
    assert files
    if (path / "cameras.bin").is_file():
        check_model_files(path, text=False)
    for file in files:
        if file.suffix == ".npy":
            assert np.isfinite(np.load(file)).all(), file.name
        elif file.suffix == ".npz":
            arrays = np.load(file)
            assert all(np.isfinite(arrays[k]).all() for k in arrays.files if arrays[k].dtype.kind == "f")
        elif file.read_bytes().startswith(b"SQLite"):
            with sqlite3.connect(file) as database:
                for table, kind in (("cameras", "<f8"), ("keypoints", "<f4")):
                    column = {"cameras": "params", "keypoints": "data"}[table]
                    for (blob,) in database.execute(f"SELECT {column} FROM {table}"):
                        assert np.isfinite(np.frombuffer(blob, kind)).all(), table
        elif file.read_bytes().startswith((b"LASF", b"ASTM-E57")):
            cloud = read_content(file).result
            assert np.isfinite(cloud.estimate.points).all()
            assert cloud.point_covariance is None or np.isfinite(cloud.point_covariance).all()
        elif file.suffix != ".bin":
            text = file.read_text(encoding="utf-8")
            assert NOT_FINITE.search(text) is None, (file.name, NOT_FINITE.search(text))
            if file.suffix == ".json":
                json.loads(text, parse_constant=pytest.fail)


@pytest.mark.parametrize("form", [form.name for form in FORMATS if form.writable])
def test_no_format_writes_a_number_that_is_not_finite(form: str, tmp_path: Path) -> None:
    library(form)
    content = _content(MODEL_OF.get(form, "brown"), calibrated=form in ("bal", "sba"))  # fx and fy stay equal
    rng = np.random.default_rng(len(form))
    refused = written = 0
    places = list(_places(content))
    assert len(places) > 20
    for number in (np.nan, np.inf):
        for k, path in enumerate(places):
            out = tmp_path / f"{k}{number}"
            try:
                write_content(out, form, _with(content, path, number, int(rng.integers(1000))))
            except OutputError:
                refused += 1
                assert not out.exists()
                continue
            written += 1
            _refuse_not_finite(out)
    assert refused > 5


def test_a_colmap_scene_with_a_number_that_is_not_finite_is_not_written(tmp_path: Path) -> None:
    write_content(tmp_path / "good", "colmap", _content("opencv"))
    scene = read_scene(tmp_path / "good")
    scene.image(2).points2D[3].xy = np.array([np.nan, 5.0])
    with pytest.raises(OutputError, match=r"images\.bin, byte \d+: image points before this position"):
        write_scene(tmp_path / "bad", scene)
