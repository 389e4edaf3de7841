"""Survey observations of any kind, judged against the free network, confirmed given values and one another.

If a common mistake of a kind explains all contradictions, the kind is left out and its mistake is named.
Otherwise single observations are left out that the others identify as wrong, or whole kinds that the others
contradict. If standard deviations that are too small explain more, they are enlarged.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import prod
from typing import NamedTuple

import numpy as np

from sfm.judgement.given.free_network import Reference, confirmed, thinned
from sfm.judgement.given.mistakes import explanations
from sfm.judgement.given.values import GivenModel, judge_values
from sfm.model.conventions import IntArray
from sfm.model.network import Network
from sfm.model.observations.kind import Group, Kind, TableKind
from sfm.model.remarks.remark import Remark, remark
from sfm.model.similarity import Similarity


class Table(NamedTuple):
    """Observations of one kind, and which ones of the survey they are."""

    kind: Kind
    number: int  # of the kind among the observations of the survey
    parts: IntArray  # indices of its parts, see `Kind.parts`, (q,)

    def select(self, on: Sequence[int] | IntArray) -> Table:
        """Return the parts of the given indices."""
        kept = np.isin(np.arange(len(self.parts)), on)
        return self if kept.all() else Table(self.kind.select_parts(kept), self.number, self.parts[kept])


@dataclass(frozen=True)
class Contradiction:
    """Observations of a kind that contradict others."""

    kind: str  # name of the kind
    parts: tuple[tuple[int, int], ...] = ()  # index of the kind, and of the part
    whole: bool = False  # whether most of the kind contradict: nothing shows which are right
    mistakes: tuple[str, ...] = ()  # correcting any of these makes them agree, see `Kind.mistakes`
    factor: float = 1.0  # on the standard deviations of the kind, with which its observations agree
    rest: int | None = None  # degrees of freedom of the others, if these confirm one another

    def remark(self, names: Sequence[Sequence[str]]) -> Remark:
        """Return the remark on these observations, from the names of the parts of each kind of the survey."""
        if self.factor != 1.0:
            return remark("given_sigmas", of=self.kind, factor=self.factor, used=self.factor)
        if self.whole:
            return remark("kind_wrong", of=self.kind, mistake=self.mistakes or None, rest=self.rest)
        observations = [names[k][part] for k, part in self.parts]
        return remark("observations_wrong", observations=observations, mistake=self.mistakes or None)


def judge_tables(
    tables: Sequence[Table],
    network: Network,
    reference: Reference,
    place: Callable[[Network], Similarity],
    level: float,
) -> tuple[Contradiction, ...]:
    """Return the survey observations that contradict others. Of very many of a kind only some are judged.

    Args:
        tables: observations between points and photographs of the free network.
        network: the free network, with the given values that it confirms.
        reference: the unknowns of all these.
        place: gives the object frame from the frame of the free network, by all given values of a network.
        level: probability that right observations are reported as wrong.
    """
    judge = _Judge(network, reference, place, level)
    given = [table.select(thinned(len(table.parts))) for table in tables]
    kept, contradictions = given, list[Contradiction]()
    while kept and not judge.fit([table.kind for table in kept]):
        wrong = list(judge.explained(kept)) or judge.contradicting(kept)
        kept = as_judged(kept, wrong)
        contradictions += wrong
    return tuple(
        contradiction
        if contradiction.mistakes or contradiction.factor != 1.0
        else replace(contradiction, mistakes=judge.mistakes_of(contradiction, given, kept))
        for contradiction in contradictions
    )


def as_judged(tables: Sequence[Table], wrong: Sequence[Contradiction]) -> list[Table]:
    """Return the tables without observations that contradict others, with standard deviations that fit."""
    whole_kinds = {contradiction.kind for contradiction in wrong if contradiction.whole}
    parts = {part for contradiction in wrong for part in contradiction.parts}
    kept = []
    for table in (table for table in tables if table.kind.name not in whole_kinds):
        table = table.select(
            [k for k, p in enumerate(table.parts.tolist()) if (table.number, p) not in parts]
        )
        factor = prod(
            contradiction.factor for contradiction in wrong if contradiction.kind == table.kind.name
        )
        if factor != 1.0 and isinstance(table.kind, TableKind):
            table = table._replace(kind=table.kind.with_sigma(factor * table.kind.sigma))
        kept.append(table)
    return [table for table in kept if len(table.kind)]


@dataclass(frozen=True)
class _Judge:
    """What survey observations are compared with."""

    network: Network
    reference: Reference
    place: Callable[[Network], Similarity]
    level: float

    def model(self, kinds: Sequence[Kind]) -> tuple[GivenModel, IntArray]:
        """Return the differences of observations from what the right values imply, and the kind of each."""
        model, kind = self._beside_right(kinds)
        return model.beside((kind < 0)[model.item]), kind[kind >= 0]

    def _beside_right(self, kinds: Sequence[Kind]) -> tuple[GivenModel, IntArray]:
        """Return the differences of all, and the kind of each: negative for values that are right."""
        right = [kind for kind in confirmed(self.network) if len(kind)]
        placing = self.place(self.network.with_given(further=tuple(kinds)))
        model, kind = self.reference.differences([*right, *kinds], placing)
        return model, kind - len(right)

    def fit(self, kinds: Sequence[Kind]) -> bool:
        """Return whether observations fit the network, the right values and one another."""
        return self.model(kinds)[0].fits(self.level)

    def explained(self, tables: Sequence[Table]) -> Iterator[Contradiction]:
        """Yield each kind whose common mistake explains all contradictions; several leave the cause open."""
        names = dict.fromkeys(table.kind.name for table in tables)
        sources = [[table for table in tables if table.kind.name == name] for name in names]
        sources += [[table] for source in sources if len(source) > 1 for table in source]  # each group
        explained = set[str]()
        for source in sources:
            of_source = {table.number for table in source}
            others = [table.kind for table in tables if table.number not in of_source]
            name, mistakes = source[0].kind.name, self._mistakes([table.kind for table in source], others)
            if mistakes and name not in explained:
                of_all = not any(kind.name == name for kind in others)
                explained.add(name)
                yield Contradiction(name, _parts_of(source), of_all, mistakes)

    def contradicting(self, tables: Sequence[Table]) -> list[Contradiction]:
        """Return single observations that are wrong, imprecise kinds, or kinds that the others contradict."""
        model, kind = self.model([table.kind for table in tables])
        parts, of = _parts_of(tables), np.array([tables[k].kind.name for k in kind])
        judgement = judge_values(model, self.level)
        rows = {name: np.flatnonzero(of == name) for name in dict.fromkeys(of.tolist())}
        wrong = {name: np.intersect1d(at, judgement.wrong) for name, at in rows.items()}
        if judgement.wrong and all(2 * len(wrong[name]) <= len(at) for name, at in rows.items()):
            singled = {name: tuple(parts[k] for k in at) for name, at in wrong.items() if len(at)}
            return [Contradiction(name, out) for name, out in singled.items()]
        if judgement.factor != 1.0:
            return self._imprecise(tables, judgement.factor)
        without = {}  # probability of the observations of all other kinds, in place of those of a kind
        for name in rows:
            others = [table.kind for table in tables if table.kind.name != name]
            without[name] = self.model(others)[0].kept().probability() if others else 1.0
        blamed = [name for name, probability in without.items() if probability >= self.level]
        rest = self._rest(tables, blamed[0]) if len(blamed) == 1 else None
        return [
            Contradiction(name, tuple(parts[k] for k in rows[name]), whole=True, rest=rest)
            for name in blamed or [max(without, key=lambda name: without[name])]
        ]

    def _rest(self, tables: Sequence[Table], name: str) -> int | None:
        """Return the degrees of freedom of the others, if these exceed those by which a kind contradicts.

        If the kind contradicts the image points alone, at the scale of all, these are among the others.
        """
        model, kind = self._beside_right([table.kind for table in tables])
        named = np.flatnonzero([table.kind.name == name for table in tables])
        of_kind = np.isin(kind, named)[model.item]
        rest = model.part(~of_kind).kept().dof if (~of_kind).any() else 0
        confirming = rest
        at_scale = replace(model, A=np.delete(model.A, 6, axis=1)).part(of_kind)
        if not at_scale.fits(self.level):
            confirming += self.reference.marginal.adjustment.redundancy
        return confirming if confirming > model.kept().dof - rest else None

    def _imprecise(self, tables: Sequence[Table], factor: float) -> list[Contradiction]:
        """Return the kind whose standard deviations are too small, or all kinds if no single one is."""
        names = dict.fromkeys(table.kind.name for table in tables)
        kinds = [Contradiction(name, factor=factor) for name in names]
        alone = (
            contradiction
            for contradiction in kinds
            if self.fit([table.kind for table in as_judged(tables, [contradiction])])
        )
        imprecise = next(alone, None)
        return kinds if imprecise is None else [imprecise]

    def mistakes_of(
        self, contradiction: Contradiction, given: Sequence[Table], kept: Sequence[Table]
    ) -> tuple[str, ...]:
        """Return the mistakes whose correction makes observations agree that were left out."""
        out, others = list[Kind](), [table.kind for table in kept]
        for table in given:
            on = [
                k
                for k, part in enumerate(table.parts.tolist())
                if (table.number, part) in contradiction.parts
            ]
            kind = table.kind
            if isinstance(kind, Group) and on:  # its rows share parameters
                out.append(kind)
                others = [
                    other for other in others if not (type(other) is type(kind) and other.group == kind.group)
                ]
            elif on:
                out.append(table.select(on).kind)
        return self._mistakes(out, others)

    def _mistakes(self, kinds: Sequence[Kind], others: Sequence[Kind]) -> tuple[str, ...]:
        """Return the mistakes whose correction makes observations agree with others.

        A unit also changes the standard deviations. It explains nothing if these alone do.
        """
        if self.fit([*others, *kinds]):  # there is nothing to correct
            return ()

        def is_explained(mended: Sequence[Kind]) -> bool:
            looser = [
                kind.with_sigma(other.sigma)
                for kind, other in zip(kinds, mended, strict=True)
                if isinstance(kind, TableKind) and isinstance(other, TableKind)
            ]
            return self.fit([*others, *mended]) and not self.fit([*others, *looser])

        return tuple(explanations(kinds, is_explained))


def _parts_of(tables: Sequence[Table]) -> tuple[tuple[int, int], ...]:
    return tuple((table.number, part) for table in tables for part in table.parts.tolist())
