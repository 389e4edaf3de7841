"""The rendered bridge deck in three epochs: its sag lies inside the intervals that are stated."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from functools import cache
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from sfm.adjustment.solve import adjust
from sfm.model.camera import project
from sfm.model.conventions import FloatArray
from sfm.model.distributions import t_ppf
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.remarks.remark import kinds_of
from sfm.model.similarity import fit_similarity
from sfm.products.epochs.differences import Epoch
from sfm.products.epochs.series import EpochSeries, analyse_epochs, verdict_of_epochs
from tests.places import DATASETS, ROOT
from tests.synthetic import stored_of
from tests.tables import rows_of

NOISE_PX = 0.01  # what the measured targets of the rendered photographs show
LEVEL = 0.95


@cache
def bridge() -> ModuleType:
    spec = spec_from_file_location("bridge_render", DATASETS / "bridge/render.py")
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def sag_between(first: str, second: str, names: list[str], placed: FloatArray) -> dict[str, FloatArray]:
    """Return the true displacement of every target in the frame of the first epoch, mm.

    Args:
        first: epoch.
        second: epoch.
        names: of points of the first epoch.
        placed: their coordinates in it.
    """
    made = bridge()
    before, after = (made.object_points(made.EPOCHS[epoch]) for epoch in (first, second))
    codes = list(map(str, made.codes()))
    known = [k for k, name in enumerate(names) if name in codes]
    frame = fit_similarity(before[[codes.index(names[k]) for k in known]], placed[known], scale=1.0)
    return dict(zip(codes, (after - before) @ frame.rotation.T, strict=True))


def judge(rows: list[tuple[str, FloatArray, FloatArray, bool, float]], truth: dict[str, FloatArray]) -> float:
    """Return the share of coordinates inside their 95 % intervals; no point that stands still is named.

    Args:
        rows: point, displacement, its standard deviations, whether it is said to move, and what would be
            found with 80 %.
        truth: the displacement of each point.
    """
    inside = [np.abs(d - truth[p]) <= t_ppf((1 + LEVEL) / 2, 690) * s for p, d, s, *_ in rows if p in truth]
    for point, d, s, moved, detectable in rows:
        if point not in truth:
            continue
        size = float(np.linalg.norm(truth[point]))
        assert not (moved and size == 0), point
        assert moved or size < 1.5 * detectable, point
        assert (np.abs(d - truth[point]) < 4.5 * s).all(), point
    return float(np.mean(inside))


def points_alone(epochs: int = 3, photographs: int = 6) -> EpochSeries:
    """Return the analysis of some photographs of each epoch, with noise on the true images of the targets."""
    made = bridge()
    found = []
    for number, (name, middle) in enumerate(list(made.EPOCHS.items())[:epochs]):
        rng = np.random.default_rng(number)
        xyz, camera = made.object_points(middle), made.camera()
        camera = replace(camera, free=np.isin(camera.names, ("c", "x0", "y0", "K1")))
        position, rotation = made.stations(rng, photographs)
        xy = np.concatenate([project(camera, position[i], rotation[i], xyz) for i in range(photographs)])
        points = list(map(str, made.codes()))
        network = Network.from_arrays(
            [f"{name} {i}" for i in range(photographs) for _ in points],
            points * photographs,
            xy + NOISE_PX * rng.standard_normal(xy.shape),
            sigma_px=NOISE_PX,
        )
        ends = points[-4:]
        for (a, b), length in zip((ends[:2], ends[2:]), made.BAR_READINGS, strict=True):
            network = network.with_scale_bar(a, b, length, made.BAR_SIGMA)
        a = adjust(network, Estimate((camera,), position, rotation, xyz), reject="none")
        stored = stored_of(name, a)
        found.append(Epoch(name, stored, network.scale_bars, sigma0=a.sigma0, sigma0_px=a.sigma0_px))
    return analyse_epochs(found, together=True)


def test_the_sag_is_found_from_few_photographs() -> None:
    found = points_alone()
    assert found.cameras[0].same and found.cameras[0].epochs == ("first", "second", "third")
    shares = []
    for pair in (one.displacements for one in found.pairs):
        names, d = pair.differences.names, pair.displacement
        points = list(pair.differences.points)
        rows = [
            (point, d[k], pair.sigma[k], bool(pair.moved[k]), float(pair.detectable[k]))
            for k, point in enumerate(points)
        ]
        truth = sag_between(*names, points, pair.differences.xyz)
        still = [p for p, _, _, moved, _ in rows if moved and not truth[p].any()]
        assert len(still) <= 1, still
        shares.append(judge([row for row in rows if row[0] not in still], truth))
        assert pair.cause is None, pair.cause  # a smooth sag is what epochs look for, no bent result
    assert min(shares) > 0.85 and np.mean(shares) > 0.9, shares
    verdict = verdict_of_epochs(found)
    assert kinds_of(verdict.remarks).count("displaced") == 3, verdict.text


@pytest.mark.slow
def test_from_photographs_to_the_page_in_one_command(tmp_path: Path) -> None:
    made = bridge()
    made.render(tmp_path)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "sfm.cli", "epochs", "first.toml", "second.toml", "third.toml"]
    ended = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    shown = (ROOT / "docs/how-to/epochs.md").read_text(encoding="utf-8")
    heads = re.findall(r"^! .* points of 44 moved, by up to \d+ µm", ended.stdout, re.M)
    assert len(heads) == 3 and all(head in shown for head in heads), ended.stdout
    assert "bent" not in ended.stdout
    out = tmp_path / "out"
    assert (out / "epochs/epochs.html").stat().st_size > 50_000
    table = rows_of(out / "epochs/displacements.csv")
    for first, second in (("first", "second"), ("first", "third"), ("second", "third")):
        placed = {
            row["id"]: [float(row[axis]) for axis in "XYZ"] for row in rows_of(out / first / "points.csv")
        }
        truth = sag_between(first, second, list(placed), np.array(list(placed.values())))
        rows = []
        for row in table:
            if (row["first"], row["second"]) == (first, second):
                d, sigma = (np.array([float(row[s + axis]) for axis in "XYZ"]) for s in ("d", "sd"))
                rows.append((row["id"], d, sigma, row["moved"] == "1", float(row["detectable"])))
        share = judge(rows, truth)
        print(first, second, f"{share:.1%} of the coordinates inside their 95 % intervals")
        assert share > 0.85
    summary = json.loads((out / "epochs/epochs.json").read_text(encoding="utf-8"))
    assert summary["changed"] and all(pair["agreed"] for pair in summary["pairs"])
