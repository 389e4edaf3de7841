"""Matches of pairs: each is found once, kept as it comes, by whichever process."""

from __future__ import annotations

import os
import pickle
import signal
from collections.abc import Iterable, Iterator
from dataclasses import fields, replace
from itertools import chain, repeat
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adapters.dask_cluster import local_engine
from sfm.matching.tracks import matched_pairs
from sfm.matching.tracks.features import Features, PairMatches, TwoMotions, matched_features
from sfm.matching.tracks.interest import NaturalPoints
from sfm.matching.tracks.matched_pairs import MatchedPairs, Matches, MatchTable
from sfm.model.conventions import IntArray
from sfm.model.errors import BackendError
from sfm.runtime.executor import Blocking, Call, KeptHere, in_blocks
from sfm.survey.measuring import measured_store
from sfm.survey.measuring.measured_store import TEXTURE, MeasuredStore, StoredMatches, measured_once
from tests.matching.test_overlap import strip
from tests.synthetic import seed_of

PAIRS: IntArray = np.array([[i, j] for i in range(10) for j in range(i + 1, min(i + 5, 10))])


def contents(matches: Matches) -> list[tuple[Any, ...]]:
    """Return everything that matches state, for comparisons."""
    listed = []
    for pair, match in sorted(matches.items()):
        motions = () if match.motions is None else tuple(part.tolist() for part in match.motions)
        listed.append((pair, match.rows.tolist(), match.distinct.tolist(), match.candidates, motions))
    return listed


def add(matched: MatchedPairs, views: list[Features], threads: int = 2) -> list[tuple[Any, ...]]:
    return contents(matched.add(views, PAIRS, seed=0, threads=threads))


class Counted:
    """Matches pairs, notes how often, and fails at one of them."""

    def __init__(self, patch: pytest.MonkeyPatch, fails_at: int | None = None) -> None:
        self.times, self.fails_at = 0, fails_at
        patch.setattr(matched_pairs, "matched_features", self)

    def __call__(self, a: Features, b: Features, *, seed: int) -> PairMatches:
        if self.times == self.fails_at:
            raise KeyboardInterrupt
        self.times += 1
        return matched_features(a, b, seed=seed)


def test_matches_come_back_from_a_table_as_they_were() -> None:
    rng = seed_of("table")

    def rows(k: int) -> IntArray:
        return rng.integers(0, 2000, (k, 2))

    none = PairMatches(np.zeros((0, 2), dtype=np.int64), np.zeros(0), 7, None)
    moving = TwoMotions(rows(3), rng.random(3), rows(2))
    matches = {
        "a" * 64: PairMatches(rows(5), rng.random(5), 9, None),
        "b" * 64: none,
        "c" * 64: PairMatches(rows(4), rng.random(4), 11, moving),
        "d" * 64: none._replace(motions=moving),
    }
    back = MatchTable.of(matches).matches()
    assert list(back) == list(matches)
    numbered = [dict(enumerate(of.values())) for of in (back, matches)]
    assert contents({(k, k): m for k, m in numbered[0].items()}) == contents(
        {(k, k): m for k, m in numbered[1].items()}
    )
    assert MatchTable.of({}).matches() == {}


def test_a_run_that_was_ended_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All blocks but the one at work are there; with other features, only pairs of these are matched."""
    views = strip(10)
    whole = add(MatchedPairs(), views)
    monkeypatch.setattr(matched_pairs, "BLOCK_PAIRS", 2)
    store = StoredMatches(MeasuredStore(tmp_path))
    Counted(monkeypatch, fails_at=13)
    with pytest.raises(KeyboardInterrupt):
        add(MatchedPairs(store=store), views, threads=1)
    again = Counted(monkeypatch)
    assert add(MatchedPairs(store=store), views, threads=1) == whole
    assert len(PAIRS) - 13 <= again.times <= len(PAIRS) - 12
    nothing = Counted(monkeypatch)
    assert add(MatchedPairs(store=store), views) == whole and nothing.times == 0
    other = replace(views[9], xy=views[9].xy + 0.25)
    changed = Counted(monkeypatch)
    found = add(MatchedPairs(store=store), [*views[:9], other])
    assert changed.times == 4 and [row[0] for row in found] == [row[0] for row in whole]


def test_a_damaged_table_is_made_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    views, store = strip(10), StoredMatches(MeasuredStore(tmp_path))
    whole = add(MatchedPairs(store=store), views)
    entries = sorted(tmp_path.rglob("*.npz"))
    assert len(entries) == 9  # of each photograph that is the first of a pair
    entries[0].write_bytes(entries[0].read_bytes()[:-200])
    with np.load(entries[1]) as stored:
        arrays = {f.name: stored[f.name] for f in fields(MatchTable)}
    np.savez(entries[1], allow_pickle=False, **{**arrays, "rows": arrays["rows"] + 60})
    counted = Counted(monkeypatch)
    assert add(MatchedPairs(store=store), views) == whole
    assert 2 <= counted.times <= 8


class InTurn(KeptHere):
    """A keeper with two workers, which ends its calls in another order than they began."""

    workers = 2

    def __init__(self) -> None:
        self.calls = 0

    def each(self, calls: Iterable[Call]) -> Iterator[tuple[int, Any]]:
        ended = list(super().each(calls))
        self.calls += len(ended)
        yield from reversed(ended)


def test_other_processes_find_the_same_matches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Few pairs are matched here. Features go to the processes in waves; results are kept as they come."""
    views, keeper = strip(10), InTurn()
    whole = add(MatchedPairs(), views)
    store = StoredMatches(MeasuredStore(tmp_path))
    with in_blocks(Blocking(keeper)):
        assert add(MatchedPairs(), views) == whole and keeper.calls == 0
        monkeypatch.setattr(matched_pairs, "MIN_PAIRS_ELSEWHERE", 1)
        monkeypatch.setattr(matched_pairs, "WAVE_BYTES", 3 * views[0].descriptor.nbytes)
        assert add(MatchedPairs(store=store), views) == whole and keeper.calls >= 9
    nothing = Counted(monkeypatch)
    assert add(MatchedPairs(store=store), views) == whole and nothing.times == 0


def test_matches_of_another_version_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They may differ, and would be kept as those of this version."""
    versions = chain(["here"], repeat("there"))
    monkeypatch.setattr(matched_pairs, "code_version", lambda *_: next(versions))
    monkeypatch.setattr(matched_pairs, "MIN_PAIRS_ELSEWHERE", 1)
    with in_blocks(Blocking(InTurn())), pytest.raises(BackendError, match="another version of Kolinear"):
        add(MatchedPairs(store=StoredMatches(MeasuredStore(tmp_path))), strip(10))
    assert not list(tmp_path.rglob("*.npz"))


def test_workers_of_dask_find_the_same_matches(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Also if one of them is killed amid the work, which a line says."""
    views = strip(10)
    whole = add(MatchedPairs(), views)
    monkeypatch.setattr(matched_pairs, "MIN_PAIRS_ELSEWHERE", 1)
    with local_engine(2) as engine, in_blocks(Blocking(engine)):
        here = Counted(monkeypatch)
        assert add(MatchedPairs(), views) == whole and here.times == 0
        pids: dict[str, int] = engine.client.run(os.getpid)
        victim, first = min(pids), MatchedPairs()
        found = first._matched(views, [(i, j) for i, j in PAIRS.tolist()], 0, 1, None)
        matches = dict([next(found)])
        os.kill(pids[victim], signal.SIGKILL)
        matches.update(found)
    assert contents(matches) == whole
    assert f"worker {victim} was lost" in capfd.readouterr().err


def test_descriptors_of_a_stored_photograph_are_read_when_they_are_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In memory is what is small; all is as it was, and an entry without its descriptors is none."""
    rng = seed_of("mapped")
    k = 300
    points = NaturalPoints(
        rng.random((k, 2)),
        rng.random(k),
        rng.random(k),
        rng.random((k, 128)).astype(np.float32),
        rng.random((7, 2)),
    )
    photograph = tmp_path / "a.png"
    photograph.write_bytes(b"any")

    def anew() -> tuple[NaturalPoints, bool]:
        """Return what a new run finds, and whether it was stored."""
        return measured_once(MeasuredStore(tmp_path / "store"), photograph, TEXTURE, "", lambda: points)

    found = [anew(), anew()]
    assert [stored for _, stored in found] == [False, True]
    for of_store, _ in found:
        for field in fields(NaturalPoints):
            np.testing.assert_array_equal(getattr(of_store, field.name), getattr(points, field.name))
        assert type(of_store.descriptor) is np.ndarray and isinstance(of_store.descriptor.base, np.memmap)
        assert pickle.loads(pickle.dumps(of_store)).descriptor.tobytes() == points.descriptor.tobytes()
    with monkeypatch.context() as patch:  # as many files may be open as are mapped already
        patch.setattr(measured_store, "open_files", lambda: 0)
        in_memory, was_stored = anew()
        assert was_stored and not isinstance(in_memory.descriptor.base, np.memmap)
        np.testing.assert_array_equal(in_memory.descriptor, points.descriptor)
    (entry,) = (tmp_path / "store").rglob("*.npy")
    whole = entry.read_bytes()
    for damaged in (whole[:-1], whole[:100], b""):
        entry.write_bytes(damaged)
        assert (
            measured_once(MeasuredStore(tmp_path / "store"), photograph, TEXTURE, "", lambda: points)[1]
            is False
        )
        assert entry.read_bytes() == whole
    entry.unlink()
    assert not anew()[1]
