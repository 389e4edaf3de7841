"""Survey observations of any kind, judged against the free network, confirmed given values and one another.

If a common mistake of a kind explains all contradictions, the kind is left out and its mistake is named.
Otherwise single observations are left out that the others identify as wrong, or whole kinds that the others
contradict. If standard deviations that are too small explain more, they are enlarged.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfm.conventions import IntArray
from sfm.distributions import LEVEL
from sfm.judgement.given.free_network import FreeNetwork, Reference, confirmed
from sfm.judgement.given.values import GivenModel, judge_values
from sfm.network import Estimate, Network
from sfm.observations.kind import Group, Kind, TableKind
from sfm.remarks.remark import Remark, remark
from sfm.similarity import Similarity


@dataclass(frozen=True)
class Contradiction:
    """Observations of a kind that contradict others."""

    kind: str  # name of the kind
    names: tuple[str, ...]  # as in `Kind.parts`
    whole: bool = False  # whether most of the kind contradict: nothing shows which are right
    mistakes: tuple[str, ...] = ()  # correcting any of these makes them agree, see `Kind.mistakes`
    factor: float = 1.0  # on the standard deviations of the kind, with which its observations agree

    @property
    def remark(self) -> Remark:
        """The remark on these observations."""
        if self.factor != 1.0:
            return remark("given_sigmas", of=self.kind, factor=self.factor, used=self.factor)
        if self.whole:
            return remark("kind_wrong", of=self.kind, mistake=self.mistakes or None)
        return remark("observations_wrong", observations=self.names, mistake=self.mistakes or None)


def judge_tables(
    network: Network, free: FreeNetwork, place: Callable[[Network], Similarity]
) -> tuple[Contradiction, ...]:
    """Return the survey observations that contradict others.

    Args:
        network: that of the image points, with the given values that they confirm, and the observations.
        free: adjustment of the image points alone.
        place: gives the object frame from the frame of the free network, by all given values of a network.
    """
    reference = free.reference_of([*confirmed(network), *network.observations])
    if reference is None or not network.observations:
        return ()
    judge = _Judge(network, reference, place)
    tables, found = network.observations, list[Contradiction]()
    while tables and not judge.fit(tables):
        wrong = list(judge.explained(tables)) or judge.contradicting(tables)
        tables = as_judged(network, judge.estimate, tables, wrong)
        found += wrong
    unexplained = (not one.mistakes and one.factor == 1.0 for one in found)
    return tuple(
        replace(one, mistakes=judge.mistakes_of(one, tables)) if open_ else one
        for one, open_ in zip(found, unexplained, strict=True)
    )


def as_judged(
    network: Network, estimate: Estimate, tables: Sequence[Kind], wrong: Sequence[Contradiction]
) -> tuple[Kind, ...]:
    """Return the tables without observations that contradict others, with standard deviations that fit.

    Args:
        network: network of the tables.
        estimate: its values.
        tables: observations.
        wrong: those that contradict others.
    """
    whole = {one.kind for one in wrong if one.whole}
    names = {name for one in wrong for name in one.names}
    factors = {one.kind: one.factor for one in wrong if one.factor != 1.0}
    kept = []
    for kind in (kind for kind in tables if kind.name not in whole):
        on = np.array([name not in names for name in kind.parts(network, estimate)], dtype=bool)
        part = kind if on.all() else kind.select_parts(on)
        if isinstance(part, TableKind) and part.name in factors:
            part = part.with_sigma(factors[part.name] * part.sigma)
        kept.append(part)
    return tuple(kind for kind in kept if len(kind))


@dataclass(frozen=True)
class _Judge:
    """What survey observations are compared with."""

    network: Network
    reference: Reference
    place: Callable[[Network], Similarity]

    @property
    def estimate(self) -> Estimate:
        """Values of the free network, for names."""
        return self.reference.marginal.adjustment.estimate

    def model(self, tables: Sequence[Kind]) -> tuple[GivenModel, IntArray]:
        """Return the differences of observations from what the right values imply, and the kind of each."""
        right = [kind for kind in confirmed(self.network) if len(kind)]
        placing = self.place(replace(self.network, observations=tuple(tables)))
        model, kind = self.reference.differences([*right, *tables], placing)
        of_right = kind < len(right)
        return model.beside(of_right[model.item]), kind[~of_right] - len(right)

    def fit(self, tables: Sequence[Kind]) -> bool:
        """Return whether observations fit the network, the right values and one another."""
        return self.model(tables)[0].fits(LEVEL)

    def explained(self, tables: Sequence[Kind]) -> Iterator[Contradiction]:
        """Yield each kind whose common mistake explains all contradictions; several leave the cause open."""
        names = dict.fromkeys(kind.name for kind in tables)
        sources = [[kind for kind in tables if kind.name == name] for name in names]
        sources += [[kind] for kinds in sources if len(kinds) > 1 for kind in kinds]  # each group
        explained = set[str]()
        for kinds in sources:
            others = [kind for kind in tables if not any(kind is one for one in kinds)]
            name, mistakes = kinds[0].name, self._mistakes(kinds, others)
            if mistakes and name not in explained:
                whole = not any(kind.name == name for kind in others)
                explained.add(name)
                yield Contradiction(name, self._parts(kinds), whole, mistakes)

    def contradicting(self, tables: Sequence[Kind]) -> list[Contradiction]:
        """Return single observations that are wrong, imprecise kinds, or kinds that the others contradict."""
        model, kind = self.model(tables)
        names, of = self._parts(tables), np.array([tables[k].name for k in kind])
        judgement = judge_values(model, LEVEL)
        rows = {name: np.flatnonzero(of == name) for name in dict.fromkeys(of.tolist())}
        wrong = {name: np.intersect1d(at, judgement.wrong) for name, at in rows.items()}
        if judgement.wrong and all(2 * len(wrong[name]) <= len(at) for name, at in rows.items()):
            singled = {name: tuple(names[k] for k in at) for name, at in wrong.items() if len(at)}
            return [Contradiction(name, out) for name, out in singled.items()]
        if judgement.factor != 1.0:
            return self._imprecise(tables, judgement.factor)
        without = {name: model.kept(tuple(at.tolist())).probability() for name, at in rows.items()}
        blamed = [name for name, probability in without.items() if probability >= LEVEL]
        return [
            Contradiction(name, tuple(names[k] for k in rows[name]), whole=True)
            for name in blamed or [max(without, key=lambda name: without[name])]
        ]

    def _imprecise(self, tables: Sequence[Kind], factor: float) -> list[Contradiction]:
        """Return the kind whose standard deviations are too small, or all kinds if no single one is."""
        kinds = [Contradiction(name, (), factor=factor) for name in dict.fromkeys(k.name for k in tables)]
        alone = (one for one in kinds if self.fit(as_judged(self.network, self.estimate, tables, [one])))
        imprecise = next(alone, None)
        return kinds if imprecise is None else [imprecise]

    def mistakes_of(self, found: Contradiction, tables: Sequence[Kind]) -> tuple[str, ...]:
        """Return the mistakes whose correction makes observations agree that were left out."""
        out, others = list[Kind](), list(tables)
        for kind in (kind for kind in self.network.observations if kind.name == found.kind):
            on = np.isin(self._parts([kind]), found.names)
            if isinstance(kind, Group) and on.any():  # its rows share parameters
                out.append(kind)
                others = [one for one in others if not (type(one) is type(kind) and one.group == kind.group)]
            elif on.any():
                out.append(kind.select_parts(on))
        return self._mistakes(out, others)

    def _mistakes(self, kinds: Sequence[Kind], others: Sequence[Kind]) -> tuple[str, ...]:
        """Return the mistakes whose correction makes observations agree with others.

        A unit also changes the standard deviations. It explains nothing if these alone do.
        """
        found = []
        corrected = [kind.mistakes() for kind in kinds]
        for mistake in dict.fromkeys(mistake for mistakes in corrected for mistake in mistakes):
            mended = [by.get(mistake, kind) for by, kind in zip(corrected, kinds, strict=True)]
            looser = [
                kind.with_sigma(other.sigma)
                for kind, other in zip(kinds, mended, strict=True)
                if isinstance(kind, TableKind) and isinstance(other, TableKind)
            ]
            if self.fit([*others, *mended]) and not self.fit([*others, *looser]):
                found.append(mistake)
        return tuple(found)

    def _parts(self, kinds: Sequence[Kind]) -> tuple[str, ...]:
        return tuple(name for kind in kinds for name in kind.parts(self.network, self.estimate))
