"""Which photographs have enough in common to be worth matching, from a few features of each.

Matching every photograph with every other takes time with the square of their number. The coarsest features
are the most likely to be found again from elsewhere; how many of a few hundred of them choose each other
shows which photographs overlap, in a small part of the time of matching all.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from sfm.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.matching.tracks.features import RATIO

FEATURES = 250  # of each photograph, the coarsest
PARTNERS = 10  # that what they show chooses for each photograph
NEIGHBOURS = 4  # that were taken near each photograph, whatever they show
MIN_MUTUAL_FEATURES = 6  # features that choose each other by which an overlap is more than chance
# Partners of a photograph with few clear ones, and of one that is not connected with the others. So many hold
# nearly all that overlap (96 to 100 % where 3 of 10 features are found again); pairs grow with photographs.
MANY_PARTNERS = 30


def overlapping_pairs(
    score: IntArray, *, partners: int = PARTNERS, neighbours: Sequence[IntArray] = ()
) -> IntArray:
    """Return pairs of photographs (i < j) that are worth matching, (p, 2).

    Every photograph has its `partners` best ones and its nearest neighbours. One with clear partners for less
    than half has MANY_PARTNERS and all its neighbours.

    Args:
        score: features that photographs have in common, see `common_features`, (m, m).
        partners: how many others every photograph is matched with, at least; all, if there are no more.
        neighbours: photographs that were taken near each, the nearest first, negative for none: an array
            (m, k) for each way to know them.
    """
    m = len(score)
    if m <= partners + 1:
        return np.column_stack(np.triu_indices(m, 1))
    both = score + score.T
    lost = (both >= MIN_MUTUAL_FEATURES).sum(axis=1) < partners / 2
    wanted = _best(both, np.where(lost, MANY_PARTNERS, partners))
    for near in neighbours:
        used = (near >= 0) & (lost[:, None] | (np.arange(near.shape[1]) < NEIGHBOURS))
        wanted[np.nonzero(used)[0], near[used]] = True
    return np.argwhere(np.triu(wanted | wanted.T, 1))


def connecting_pairs(score: IntArray, part: IntArray, tried: IntArray) -> IntArray:
    """Return pairs of photographs (i < j) that may connect parts: MANY_PARTNERS for each photograph, (p, 2).

    Args:
        score: features that photographs have in common, see `common_features`, (m, m).
        part: which part each photograph belongs to, (m,).
        tried: pairs that were matched, (q, 2).
    """
    apart = part[:, None] != part
    apart[tried[:, 0], tried[:, 1]] = apart[tried[:, 1], tried[:, 0]] = False
    wanted = _best(np.where(apart, score + score.T, -1), np.full(len(score), MANY_PARTNERS)) & apart
    return np.argwhere(np.triu(wanted | wanted.T, 1))


def _best(score: IntArray, count: IntArray) -> BoolArray:
    """Return which others have the highest scores with each photograph, as many as it has to have, (m, m)."""
    ranked = np.where(np.eye(len(score), dtype=bool), -2, score)
    order = np.argsort(-ranked, axis=1, kind="stable")[:, : len(score) - 1]
    best = np.zeros(score.shape, dtype=bool)
    np.put_along_axis(best, order, np.arange(order.shape[1]) < count[:, None], axis=1)
    return best


def common_features(descriptors: Sequence[AnyArray], scales: Sequence[FloatArray]) -> IntArray:
    """Return how many of the coarsest features of photographs i < j choose each other, (m, m)."""
    m = len(descriptors)
    coarse = [d[np.argsort(-s, kind="stable")[:FEATURES]] for d, s in zip(descriptors, scales, strict=True)]
    first = np.cumsum([0, *(len(one) for one in coarse)])
    every = np.concatenate(coarse)
    score = np.zeros((m, m), dtype=np.int64)
    for i in range(m):
        if len(coarse[i]) < 2:
            continue
        similarity = every[first[i + 1] :] @ coarse[i].T
        forth = similarity.argmax(axis=1)
        rows = np.arange(len(similarity))
        best = similarity[rows, forth]
        # the best of each photograph for every feature of this one
        starts = first[i + 1 : -1] - first[i + 1]
        some = np.flatnonzero(np.diff(first[i + 1 :]))
        if not len(some):
            continue
        back = np.maximum.reduceat(similarity, starts[some], axis=0)
        of = np.repeat(np.arange(len(some)), np.diff(first[i + 1 :])[some])
        mutual = best >= back[of, forth]
        similarity[rows, forth] = -1.0
        clear = 1 - best < RATIO**2 * (1 - similarity.max(axis=1))
        score[i, i + 1 + some] = np.bincount(of[mutual & clear], minlength=len(some))
    return score


def connected_parts(pairs: IntArray, m: int) -> IntArray:
    """Return the number of the connected part that each of m photographs belongs to, (m,)."""
    links = csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(m, m))
    return np.asarray(connected_components(links, directed=False)[1], dtype=np.int64)
