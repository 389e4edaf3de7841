"""Which photographs have enough in common to be worth matching, from a few features of each.

Matching every photograph with every other takes time with the square of their number. The coarsest features
are the most likely to be found again from elsewhere; how many of a few hundred of them choose each other
tells which photographs overlap, in a small part of the time of matching all.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from sfm.conventions import AnyArray, FloatArray, IntArray
from sfm.matching.tracks.features import RATIO

FEATURES = 250  # of each photograph, the coarsest
PARTNERS = 10  # with which a photograph is matched
CLEAR = 6  # features that choose each other by which an overlap is more than chance


def overlapping_pairs(
    descriptors: Sequence[AnyArray], scales: Sequence[FloatArray], *, partners: int = PARTNERS
) -> IntArray:
    """Return pairs of photographs (i < j) that are worth matching, (p, 2).

    Every photograph has its `partners` best ones; one with clear ones for less than half has all others.

    Args:
        descriptors: of the features of m photographs, unit vectors, m arrays (k_i, 128).
        scales: sizes of the features, m arrays (k_i,).
        partners: how many others every photograph is matched with, at least; all, if there are no more.
    """
    m = len(descriptors)
    first, second = np.triu_indices(m, 1)
    if m <= partners + 1:
        return np.column_stack([first, second])
    score = common_features(descriptors, scales)
    score += score.T
    wanted = np.zeros((m, m), dtype=bool)
    best = np.argsort(-score, axis=1, kind="stable")[:, :partners]
    wanted[np.arange(m)[:, None], best] = True
    wanted[(score >= CLEAR).sum(axis=1) < partners / 2] = True
    wanted |= wanted.T
    return np.column_stack([first, second])[wanted[first, second]]


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
