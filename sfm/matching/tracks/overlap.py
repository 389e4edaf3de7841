"""Pairs of photographs that overlap enough to be matched.

Matching every photograph with every other takes time that grows with the square of their number. A few
hundred of the coarsest features of two photographs are therefore compared first, since these are the most
likely to be found again from another viewpoint. The number of features that choose each other shows whether
the photographs overlap. This takes a small part of the time of matching them.

Of few photographs all pairs are compared. Of many, each is compared with those that `retrieval` finds and
with its neighbours, then with the partners of its partners, so that time grows little faster than the number
of photographs.

Source: Agarwal et al. (2009), ICCV (proposals by retrieval, then by the partners of partners); Chum et al.
(2007), ICCV (query expansion).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from sfm.matching.tracks.features import MIN_MUTUAL_FEATURES, RATIO, Features
from sfm.matching.tracks.retrieval import similar_photographs
from sfm.model.conventions import AnyArray, BoolArray, IntArray
from sfm.runtime.compiling import compiled
from sfm.runtime.progress import reported
from sfm.runtime.threads import in_threads

FEATURES = 250  # of each photograph, the coarsest ones
PARTNERS = 10  # of each photograph, by common features
NEIGHBOURS = 4  # of each photograph, by position, whatever they show
# Partners of a photograph with few clear ones, or that is not connected with the others. They include nearly
# all overlapping ones (96 to 100 % if 3 of 10 features are found again); more photographs mean more pairs.
MANY_PARTNERS = 30
# Photographs that each one is compared with, beside its neighbours: PARTNERS that retrieval finds, and
# MANY_PARTNERS of its partners' partners. With twice as many of the former, fewer pairs that overlap are
# found: they are no better partners.
COMPARED = PARTNERS + MANY_PARTNERS


class ComparedPairs(NamedTuple):
    """Pairs of photographs whose coarsest features were compared."""

    photographs: int  # m
    pairs: IntArray  # i < j, sorted, (p, 2)
    common: IntArray  # how many of their coarsest features choose each other, (p,)

    @property
    def both_ways(self) -> tuple[IntArray, IntArray, IntArray]:
        """Both photographs of each pair, the other one, and what they have in common, (2 p,) each."""
        i, j = self.pairs.T
        return np.concatenate([i, j]), np.concatenate([j, i]), np.tile(self.common, 2)


def compare_photographs(
    features: Sequence[Features], *, neighbours: Sequence[IntArray] = (), seed: int = 0, threads: int = 1
) -> ComparedPairs:
    """Compare the photographs that may overlap: all pairs of COMPARED + 1 photographs and fewer.

    Args:
        features: features of m photographs.
        neighbours: see `overlapping_pairs`.
        seed: seed of the random choices of `retrieval`.
        threads: number of photographs compared at the same time.
    """
    m, none = len(features), np.zeros(0, dtype=np.int64)
    coarse = _coarsest(features)
    compared = ComparedPairs(m, np.zeros((0, 2), dtype=np.int64), none)
    if m <= COMPARED + 1:
        return _with_pairs(compared, np.column_stack(np.triu_indices(m, 1)), features, coarse, threads)
    similar = similar_photographs(features, coarse, np.arange(m), np.ones(m, dtype=bool), PARTNERS, seed=seed)
    near = [np.column_stack([np.repeat(np.arange(m), of.shape[1]), of.ravel()]) for of in neighbours]
    proposed = np.concatenate([similar, *(pairs[pairs[:, 1] >= 0] for pairs in near)])
    compared = _with_pairs(compared, proposed, features, coarse, threads)
    return _with_pairs(compared, _partners_of_partners(compared), features, coarse, threads)


def compare_parts(
    features: Sequence[Features],
    compared: ComparedPairs,
    part: IntArray,
    *,
    seed: int = 0,
    threads: int = 1,
) -> ComparedPairs:
    """Return the compared pairs, and those that may connect the smaller parts with others.

    Args:
        features: features of m photographs.
        compared: pairs that were compared.
        part: number of the part to which each photograph belongs, (m,).
        seed: seed of the random choices of `retrieval`.
        threads: number of photographs compared at the same time.
    """
    if len(features) <= COMPARED + 1:  # all were compared
        return compared
    coarse = _coarsest(features)
    similar = similar_photographs(
        features, coarse, part, part != np.argmax(np.bincount(part)), COMPARED, seed=seed
    )
    return _with_pairs(compared, similar, features, coarse, threads)


def _coarsest(features: Sequence[Features]) -> list[IntArray]:
    """Return the rows of the coarsest features of each photograph, the coarsest first."""
    return [np.argsort(-of_photograph.scale, kind="stable")[:FEATURES] for of_photograph in features]


def _partners_of_partners(compared: ComparedPairs) -> IntArray:
    """Return photographs, and those with which their partners have the most in common, (p, 2).

    A photograph has at most PARTNERS partners, and these as many, so that one which overlaps with all others
    does not propose all pairs of them.
    """
    image, other, common = compared.both_ways
    partner = (common > 0) & _are_best(image, other, common, np.full(compared.photographs, PARTNERS))
    size = (compared.photographs, compared.photographs)
    strength = csr_matrix((common[partner], (image[partner], other[partner])), shape=size)
    indirect = (strength @ strength).tocoo()
    image, other = indirect.row.astype(np.int64), indirect.col.astype(np.int64)
    new = (image != other) & ~_contains(compared, np.column_stack([image, other]))
    image, other, value = image[new], other[new], indirect.data[new]
    return np.column_stack([image, other])[
        _are_best(image, other, value, np.full(compared.photographs, MANY_PARTNERS))
    ]


def _contains(compared: ComparedPairs, pairs: IntArray) -> BoolArray:
    """Return which pairs, in either order, were compared, (q,)."""
    m = compared.photographs
    return np.isin(pairs.min(axis=1) * m + pairs.max(axis=1), compared.pairs @ [m, 1])


def _with_pairs(
    compared: ComparedPairs,
    proposed: IntArray,
    features: Sequence[Features],
    coarse: Sequence[IntArray],
    threads: int,
) -> ComparedPairs:
    """Return the compared pairs and the proposed ones, compared too.

    Args:
        compared: pairs that were compared.
        proposed: other pairs, in either order, also repeated, (q, 2).
        features: features of m photographs.
        coarse: rows of the coarsest of them.
        threads: number of photographs compared at the same time.
    """
    new = np.unique(np.sort(proposed[~_contains(compared, proposed)], axis=1), axis=0)
    common = common_features(features, coarse, new, threads=threads)
    pairs, counts = np.concatenate([compared.pairs, new]), np.concatenate([compared.common, common])
    order = np.lexsort(pairs.T[::-1])
    return ComparedPairs(compared.photographs, pairs[order], counts[order])


def common_features(
    features: Sequence[Features], coarse: Sequence[IntArray], pairs: IntArray, *, threads: int = 1
) -> IntArray:
    """Return how many of the coarsest features of each pair of photographs choose each other, (p,).

    A feature of the second photograph must choose one of the first clearly, and that must choose it too.

    Args:
        features: features of m photographs.
        coarse: rows of the coarsest of them.
        pairs: photographs i < j, sorted, (p, 2).
        threads: number of photographs compared at the same time.
    """
    begin = np.searchsorted(pairs[:, 0], np.arange(len(features) + 1))
    groups = [
        (i, pairs[k : min(k + COMPARED, end), 1])
        for i, (first, end) in enumerate(zip(begin[:-1].tolist(), begin[1:].tolist(), strict=True))
        for k in range(first, end, COMPARED)
    ]

    def compare(group: tuple[int, IntArray]) -> IntArray:
        i, others = group
        size = np.array([len(coarse[j]) for j in others.tolist()])
        if len(coarse[i]) < 2 or not size.any():
            return np.zeros(len(others), dtype=np.int64)
        descriptors = np.concatenate([features[j].descriptor[coarse[j]] for j in others.tolist()])
        similarity = descriptors @ features[i].descriptor[coarse[i]].T
        best, second = np.empty((2, len(similarity)), similarity.dtype)
        mutual = np.empty(len(similarity), np.bool_)
        first = np.concatenate([[0], np.cumsum(size)])
        _choose_each_other(similarity, first, best, second, mutual)
        clear = 1 - best < RATIO**2 * (1 - second)
        return np.bincount(np.repeat(np.arange(len(others)), size)[mutual & clear], minlength=len(others))

    counts = in_threads(compare, groups, threads)
    return np.concatenate(
        [np.zeros(0, dtype=np.int64), *reported("photographs compared", counts, len(groups))]
    )


@compiled
def _choose_each_other(
    similarity: AnyArray, first: IntArray, best: AnyArray, second: AnyArray, mutual: BoolArray
) -> None:
    """Fill in the largest two similarities of each row, and whether the largest is that of its column too.

    Args:
        similarity: of the features of other photographs, one after the other, to those of one, (k, l).
        first: first row of each photograph, and the number of rows.
        best: largest similarity of each row, (k,).
        second: second-largest similarity of each row, (k,).
        mutual: whether no other row of the photograph is more similar to that column, (k,).
    """
    column = np.empty(len(similarity), np.int64)
    of_column = np.empty(similarity.shape[1], similarity.dtype)
    for photograph in range(len(first) - 1):
        of_column[:] = -np.inf
        for i in range(first[photograph], first[photograph + 1]):
            row = similarity[i]
            for j in range(len(row)):  # by itself, so that it is done for several columns at once
                of_column[j] = max(of_column[j], row[j])
            largest, next_one, at = -np.inf, -np.inf, 0
            for j in range(len(row)):
                if row[j] > next_one:
                    if row[j] > largest:
                        largest, next_one, at = row[j], largest, j
                    else:
                        next_one = row[j]
            best[i], second[i], column[i] = largest, next_one, at
        for i in range(first[photograph], first[photograph + 1]):
            mutual[i] = best[i] >= of_column[column[i]]


def overlapping_pairs(
    compared: ComparedPairs, *, partners: int = PARTNERS, neighbours: Sequence[IntArray] = ()
) -> IntArray:
    """Return the pairs of photographs (i < j) that are worth matching, (p, 2).

    Every photograph is paired with its best `partners` and its nearest neighbours. If fewer than half as many
    partners are clear, it receives MANY_PARTNERS and all its neighbours.

    Args:
        compared: the photographs that were compared with each.
        partners: smallest number of partners per photograph; all others if there are no more.
        neighbours: photographs taken near each photograph, the nearest first, negative for none. One array
            (m, k) for each source of this knowledge.
    """
    m = compared.photographs
    image, other, common = compared.both_ways
    lost = np.bincount(image[common >= MIN_MUTUAL_FEATURES], minlength=m) < partners / 2
    best = _are_best(image, other, common, np.where(lost, MANY_PARTNERS, partners))
    wanted = [np.column_stack([image, other])[best]]
    for near in neighbours:
        used = (near >= 0) & (lost[:, None] | (np.arange(near.shape[1]) < NEIGHBOURS))
        wanted.append(np.column_stack([np.nonzero(used)[0], near[used]]))
    return np.unique(np.sort(np.concatenate(wanted), axis=1), axis=0)


def connecting_pairs(compared: ComparedPairs, part: IntArray, tried: IntArray) -> IntArray:
    """Return pairs of photographs (i < j) that may connect parts: MANY_PARTNERS per photograph, (p, 2).

    Args:
        compared: the photographs that were compared with each.
        part: number of the part to which each photograph belongs, (m,).
        tried: pairs that were matched, (q, 2).
    """
    m = compared.photographs
    image, other, common = compared.both_ways
    matched = ComparedPairs(m, tried, np.zeros(len(tried), dtype=np.int64))
    apart = (part[image] != part[other]) & ~_contains(matched, np.column_stack([image, other]))
    image, other, common = image[apart], other[apart], common[apart]
    best = _are_best(image, other, common, np.full(m, MANY_PARTNERS))
    return np.unique(np.sort(np.column_stack([image, other])[best], axis=1), axis=0)


def _are_best(image: IntArray, other: IntArray, value: AnyArray, count: IntArray) -> BoolArray:
    """Return which pairs are among those of a photograph with the largest values, the first of equal ones.

    Args:
        image: photograph of each pair, (q,).
        other: the other photograph, (q,).
        value: value of each pair, (q,).
        count: number of pairs of each photograph, (m,).
    """
    order = np.lexsort((other, -value, image))
    rank = np.arange(len(order)) - np.searchsorted(image[order], image[order])
    best = np.zeros(len(order), dtype=bool)
    best[order] = rank < count[image[order]]
    return best


def connected_parts(pairs: IntArray, m: int) -> IntArray:
    """Return for each of m photographs the number of its connected part, (m,)."""
    links = csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(m, m))
    return np.asarray(connected_components(links, directed=False)[1], dtype=np.int64)
