"""Photographs of a survey measured, and pairs matched, by other processes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NoReturn

import cv2
import numpy as np
import pytest

from adapters.dask_cluster import local_engine
from sfm.matching.tracks import matched_pairs
from sfm.model.errors import BackendError
from sfm.model.network import Network
from sfm.runtime.executor import Blocking, Call, KeptHere, in_blocks
from sfm.runtime.progress import SILENT, StageClock
from sfm.survey.inputs.measurements import find_photographs
from sfm.survey.inputs.settings import TiePointSettings
from sfm.survey.inputs.survey import CameraSetup, Survey
from sfm.survey.measuring import tie_points
from sfm.survey.measuring.measured_store import MeasuredStore
from sfm.survey.sources.joined import measure_sources
from tests.synthetic import seed_of
from tests.textures import natural_texture

M, STEP = 6, 24  # photographs, and by how much each is moved, px


@pytest.fixture
def survey(tmp_path: Path) -> Survey:
    """Return the survey of photographs along a strip."""
    strip = natural_texture(seed_of("measured elsewhere"), (192 + M * STEP, 144))
    for k in range(M):
        part = np.clip(strip[:, k * STEP : k * STEP + 192], 0, 255).astype(np.uint8)
        cv2.imwrite(str(tmp_path / f"p{k}.png"), part)
    camera = CameraSetup(name="one", images="p*.png", pixel_mm=(0.01, 0.01), c_mm=2.0)
    return Survey(name="strip", cameras=(camera,), tie_points=TiePointSettings(), folder=tmp_path)


def measured(survey: Survey, store: MeasuredStore) -> Network:
    clock = StageClock(SILENT)
    return measure_sources(survey, find_photographs(survey), jobs=1, store=store, clock=clock).network


def assert_same(network: Network, other: Network) -> None:
    assert network.images == other.images and network.points == other.points
    for name in ("image", "point", "xy", "covariance"):
        here, there = (getattr(one.image_points, name) for one in (network, other))
        np.testing.assert_array_equal(here, there)


def never(*_: Any, **__: Any) -> NoReturn:
    raise AssertionError("measured in this process")


def test_the_workers_of_a_cluster_measure_photographs_and_match_pairs(
    survey: Survey, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """This process stores what they find, so that a later run here finds it too."""
    here = measured(survey, MeasuredStore(tmp_path / "here"))
    monkeypatch.setattr(matched_pairs, "MIN_PAIRS_ELSEWHERE", 1)
    with monkeypatch.context() as patch, local_engine(2) as engine, in_blocks(Blocking(engine)):
        patch.setattr(tie_points, "natural_points", never)
        patch.setattr(matched_pairs, "matched_features", never)
        assert_same(measured(survey, MeasuredStore(tmp_path / "there")), here)
        assert_same(measured(survey, MeasuredStore(None)), here)
    with in_blocks(Blocking(Idle())):  # nothing is left for other processes
        assert_same(measured(survey, MeasuredStore(tmp_path / "there")), here)
    again = MeasuredStore(tmp_path / "there")
    monkeypatch.setattr(tie_points, "natural_points", never)
    monkeypatch.setattr(matched_pairs, "matched_features", never)
    assert_same(measured(survey, again), here)
    assert again.has_earlier


class Idle(KeptHere):
    """A keeper with workers that are asked nothing."""

    workers = 2

    def each(self, calls: Iterable[Call]) -> Iterator[tuple[int, Any]]:
        assert not list(calls)
        yield from ()


class WithoutFolders(KeptHere):
    """A keeper with workers that do not see some of the photographs, or that die of them."""

    workers = 2

    def __init__(self, dies: bool) -> None:
        self.dies = dies

    def each(self, calls: Iterable[Call]) -> Iterator[tuple[int, Any]]:
        for number, call in enumerate(calls):
            if number == 3 and self.dies:
                raise BackendError("worker processes died")
            *which, path, keeps = call.arguments
            unseen = Path("elsewhere") / path.name
            yield number, call.function(*which, unseen if number % 2 else path, keeps)


@pytest.mark.parametrize("dies", [False, True])
def test_what_the_workers_cannot_measure_is_measured_here(
    survey: Survey, dies: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = measured(survey, MeasuredStore(None))
    numbers = []
    natural_points = tie_points.natural_points

    def counted(*arguments: Any, **options: Any) -> Any:
        numbers.append(len(numbers))
        return natural_points(*arguments, **options)

    monkeypatch.setattr(tie_points, "natural_points", counted)
    with in_blocks(Blocking(WithoutFolders(dies))):
        assert_same(measured(survey, MeasuredStore(None)), here)
    assert len(numbers) == M  # each once, by the workers or here
