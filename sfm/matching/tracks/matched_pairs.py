"""The matches of many pairs of photographs: found once, here or by other processes, and kept as they come.

The pairs of a photograph with others form blocks. A block is matched by one call, in a thread of this process
or in a process of the `Keeper` that also adjusts large networks. What a store keeps of earlier runs, even of
those that did not end, is not matched again.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any, NamedTuple, Protocol

import cv2
import numpy as np

from sfm.matching.tracks.features import Features, PairMatches, TwoMotions, matched_features
from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.model.errors import BackendError
from sfm.runtime.compiling import code_version
from sfm.runtime.executor import Call, Keeper, itself, other_processes
from sfm.runtime.progress import reported
from sfm.runtime.threads import in_threads

Matches = dict[tuple[int, int], PairMatches]  # of pairs of photographs, i < j

LIBRARIES = f"{cv2.__version__} {np.__version__}"  # that measure
BLOCK_PAIRS = 32  # most pairs of a block: about half a second of work
BLOCKS_A_THREAD = 4  # at least, so that threads end together
# Features that the processes hold at a time, bytes: their scheduler keeps a copy of what it sends.
WAVE_BYTES = 200e6  # and what the last block adds
MIN_PAIRS_ELSEWHERE = 500  # new pairs from which other processes match them; fewer take some seconds here
MOST_KEPT = 500  # pairs of a photograph: of a table with more, what this run does not match again is dropped
OF_PAIR, OF_MOVING, OF_STILL = range(3)


@dataclass(frozen=True)
class MatchTable:
    """The matches of one photograph with others, as arrays."""

    rows: IntArray  # feature of this photograph and of the other one, (k, 2)
    distinct: FloatArray  # see `PairMatches`; 0 of features that stand still, (k,)
    kind: IntArray  # OF_PAIR, or OF_MOVING and OF_STILL where there are two motions, (k,)
    pair: IntArray  # number of the pair, sorted, (k,)
    pair_other: AnyArray  # fingerprint of the other photograph's features, text, (p,)
    pair_candidates: IntArray  # see `PairMatches`, (p,)
    pair_moves: BoolArray  # whether the pair shows two motions, (p,)

    @classmethod
    def of(cls, matches: dict[str, PairMatches]) -> MatchTable:
        """Return the table of matches by the fingerprints of the other photographs."""
        rows, distinct = [np.zeros((0, 2), np.int32)], [np.zeros(0)]
        kind, pair = [np.zeros(0, np.int8)], [np.zeros(0, np.int32)]
        for number, match in enumerate(matches.values()):
            parts = [(OF_PAIR, match.rows, match.distinct)]
            if match.motions is not None:
                still = match.motions.still
                parts += [
                    (OF_MOVING, match.motions.rows, match.motions.distinct),
                    (OF_STILL, still, np.zeros(len(still))),
                ]
            for which, of_part, distinct_of_part in parts:
                rows.append(of_part.astype(np.int32))
                distinct.append(distinct_of_part)
                kind.append(np.full(len(of_part), which, np.int8))
                pair.append(np.full(len(of_part), number, np.int32))
        return cls(
            np.concatenate(rows),
            np.concatenate(distinct),
            np.concatenate(kind),
            np.concatenate(pair),
            np.array(list(matches), dtype=str),
            np.array([match.candidates for match in matches.values()], dtype=np.int64),
            np.array([match.motions is not None for match in matches.values()], dtype=bool),
        )

    def matches(self) -> dict[str, PairMatches]:
        """Return the matches by the fingerprints of the other photographs."""
        first = np.searchsorted(self.pair, np.arange(len(self.pair_other) + 1))
        matches = {}
        for number, other in enumerate(self.pair_other.tolist()):
            part = slice(first[number], first[number + 1])
            rows, distinct, kind = self.rows[part], self.distinct[part], self.kind[part]
            pair, moving, still = (kind == which for which in (OF_PAIR, OF_MOVING, OF_STILL))
            motions = None
            if self.pair_moves[number]:
                motions = TwoMotions(rows[moving], distinct[moving], rows[still])
            matches[other] = PairMatches(
                rows[pair], distinct[pair], int(self.pair_candidates[number]), motions
            )
        return matches


class MatchStore(Protocol):
    """Keeps the matches of photographs, by fingerprints of their features."""

    def load(self, fingerprint: str, *, seed: int) -> MatchTable | None:
        """Return the matches of a photograph; None without any."""

    def save(self, fingerprint: str, table: MatchTable, *, seed: int) -> None:
        """Keep the matches of a photograph in place of earlier ones."""


class _Block(NamedTuple):
    """Pairs of one photograph with others."""

    image: int
    others: tuple[int, ...]


@dataclass
class MatchedPairs:
    """The matches of pairs of photographs, each found once."""

    known: Matches = field(default_factory=dict)
    store: MatchStore | None = None  # None: they are kept for this run alone

    def add(self, features: Sequence[Features], pairs: IntArray, *, seed: int, threads: int) -> Matches:
        """Return the matches of pairs; those that are not known yet are matched.

        Args:
            features: features of m photographs.
            pairs: photographs i < j, (p, 2).
            seed: seed of the random samples.
            threads: number of blocks matched at the same time in this process.

        Raises:
            BackendError: the processes that match are gone, or died repeatedly.
        """
        every = [(i, j) for i, j in pairs.tolist()]
        new = [pair for pair in every if pair not in self.known]
        store = None if self.store is None or not new else _Kept(self.store, features, seed)
        if store is not None:
            for i, of_first in groupby(sorted(new), key=lambda pair: pair[0]):
                self.known.update(store.read(i, [j for _, j in of_first]))
            new = [pair for pair in new if pair not in self.known]
        matched = self._matched(features, new, seed, threads, store)
        for pair, match in reported("pairs of photographs matched", matched, len(new)):
            self.known[pair] = match
        return {pair: self.known[pair] for pair in every}

    def _matched(
        self,
        features: Sequence[Features],
        new: list[tuple[int, int]],
        seed: int,
        threads: int,
        store: _Kept | None,
    ) -> Iterator[tuple[tuple[int, int], PairMatches]]:
        """Match pairs, and yield each with its matches once its block is matched and kept."""
        most = min(max(len(new) // (BLOCKS_A_THREAD * threads), 1), BLOCK_PAIRS)
        blocks = []
        for i, of_first in groupby(sorted(new), key=lambda pair: pair[0]):
            others = [j for _, j in of_first]
            blocks += [_Block(i, tuple(others[k : k + most])) for k in range(0, len(others), most)]

        def match(block: _Block) -> list[PairMatches]:
            return matched_block(seed, features[block.image], *(features[j] for j in block.others))

        keeper = other_processes()
        results: Iterable[tuple[_Block, list[PairMatches]]]
        results = zip(blocks, in_threads(match, blocks, threads), strict=True)
        if keeper is not None and len(new) >= MIN_PAIRS_ELSEWHERE:
            results = _matched_elsewhere(features, blocks, seed, keeper)
        for block, matches in results:
            if store is not None:
                store.write(block.image, dict(zip(block.others, matches, strict=True)))
            for j, match_of_pair in zip(block.others, matches, strict=True):
                yield (block.image, j), match_of_pair

    def forget(self, photographs: set[int]) -> None:
        """Forget the matches of photographs whose features have changed."""
        for pair in [pair for pair in self.known if not photographs.isdisjoint(pair)]:
            del self.known[pair]


class _Kept:
    """What a store keeps of the photographs of a survey."""

    def __init__(self, store: MatchStore, features: Sequence[Features], seed: int) -> None:
        self._store, self._features, self._seed = store, features, seed
        self._fingerprints: dict[int, str] = {}
        self._tables: dict[int, dict[str, PairMatches]] = {}  # of photographs with blocks to come

    def _fingerprint(self, image: int) -> str:
        if image not in self._fingerprints:
            self._fingerprints[image] = fingerprint(self._features[image])
        return self._fingerprints[image]

    def read(self, image: int, others: Sequence[int]) -> Matches:
        """Return what is kept of the pairs of a photograph with others."""
        table = self._store.load(self._fingerprint(image), seed=self._seed)
        if table is None:
            return {}
        kept, asked = table.matches(), Matches()
        for j in others:
            match = kept.get(self._fingerprint(j))
            if match is not None and _belong(match, self._features[image], self._features[j]):
                asked[image, j] = match
        if len(asked) < len(others) and len(kept) <= MOST_KEPT:
            self._tables[image] = kept
        return asked

    def write(self, image: int, matches: dict[int, PairMatches]) -> None:
        """Keep more pairs of a photograph with others."""
        kept = self._tables.setdefault(image, {})
        kept.update({self._fingerprint(j): match for j, match in matches.items()})
        self._store.save(self._fingerprint(image), MatchTable.of(kept), seed=self._seed)


def _belong(match: PairMatches, features: Features, others: Features) -> bool:
    """Return whether matches are of features that two photographs have."""
    every = [match.rows, *(() if match.motions is None else (match.motions.rows, match.motions.still))]
    size = (len(features), len(others))
    return all(bool(((rows >= 0) & (rows < size)).all()) for rows in every)


def fingerprint(features: Features) -> str:
    """Return the SHA-256 of what matches of a photograph depend on."""
    digest = hashlib.sha256(np.ascontiguousarray(features.xy).tobytes())
    digest.update(np.ascontiguousarray(features.descriptor).tobytes())
    return digest.hexdigest()


def matched_block(seed: int, features: Features, *others: Features) -> list[PairMatches]:
    """Return the matches of one photograph with each of some others."""
    return [matched_features(features, of_other, seed=seed) for of_other in others]


def matched_there(seed: int, features: Features, *others: Features) -> tuple[str, list[PairMatches]]:
    """Return the version of the code of this process, and the matches of a block."""
    return code_version(LIBRARIES, __name__), matched_block(seed, features, *others)


def _matched_elsewhere(
    features: Sequence[Features], blocks: Sequence[_Block], seed: int, keeper: Keeper
) -> Iterator[tuple[_Block, list[PairMatches]]]:
    """Match blocks in the processes of a keeper, wave by wave, and yield them as they come.

    The features of a wave go to the processes once.

    Raises:
        BackendError: they have another version of Kolinear, OpenCV or numpy, whose matches may differ.
    """
    version = code_version(LIBRARIES, __name__)
    begin = 0
    while begin < len(blocks):
        kept: dict[int, Any] = {}
        held, calls = 0.0, list[Call]()
        while begin + len(calls) < len(blocks) and (held < WAVE_BYTES or not calls):
            block = blocks[begin + len(calls)]
            for k in (block.image, *block.others):
                if k not in kept:
                    sent = Features(
                        features[k].xy, features[k].scale, features[k].angle, features[k].descriptor
                    )
                    kept[k] = keeper.keep([Call(itself, (sent,))])[0]
                    held += sum(a.nbytes for a in (sent.xy, sent.scale, sent.angle, sent.descriptor))
            calls.append(Call(matched_there, (seed, kept[block.image], *(kept[j] for j in block.others))))
        for number, (theirs, matches) in keeper.each(calls):
            if theirs != version:
                raise BackendError(
                    "the workers have another version of Kolinear, OpenCV or numpy than this computer"
                )
            yield blocks[begin + number], matches
        begin += len(calls)
