"""Photographs that probably show the same, found without comparing each with all others.

Every feature of a photograph votes for the photographs that have the features most like it. A vote counts by
how much nearer its feature is than the farthest of those found: what many photographs have in common, such as
equal windows, then counts little. Similar features are searched only among those in the same cells. A cell
consists of the descriptors that are nearest to one of them, a centre; the centres are chosen at random, and
their number makes the search of the nearest cells as long as that within them. Time therefore grows as
n^1.5, with 4 ms a photograph at 3,200 photographs. Centres by k-means find the same photographs (within 0.5 %
of the overlapping pairs). Histograms of 12,000 visual words with tf-idf, and VLAD (Jegou et al. 2010) of
128 x 128 numbers with intra-normalisation, need three and six times as many candidates for the same pairs
(400 photographs, half of them of repeated windows).

Source: Sivic and Zisserman (2003), ICCV (inverted file); Jegou, Douze and Schmid (2011), IEEE TPAMI 33(1)
(search in the nearest cells); McCann and Lowe (2012), CVPR (votes relative to the background).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sfm.matching.tracks.features import Features
from sfm.model.conventions import AnyArray, BoolArray, IntArray
from sfm.runtime.compiling import compiled

VOTES = 10  # photographs that a feature finds, the farthest of which counts nothing
CELLS = 2  # cells in which each feature searches
DIMENSIONS = 128  # of a descriptor
BLOCK = 256  # descriptors compared with those of a cell, or with the centres, at a time


def similar_photographs(
    features: Sequence[Features],
    rows: Sequence[IntArray],
    part: IntArray,
    asking: BoolArray,
    count: int,
    *,
    seed: int = 0,
) -> IntArray:
    """Return pairs of photographs that probably show the same, none within one part, (p, 2).

    Args:
        features: features of m photographs, with unit vectors as descriptors.
        rows: which features of each photograph to use.
        part: number of the part to which each photograph belongs, (m,).
        asking: photographs for which others are searched, (m,).
        count: largest number of photographs that are found for each of them, those with the most votes.
        seed: seed of the choice of the centres.

    Returns:
        A photograph that asks and one that it found; both orders of a pair may occur.
    """
    m = len(features)
    first = np.concatenate([[0], np.cumsum([len(used) for used in rows])]).astype(np.int64)
    # half precision: errors of 1e-4 beside distances of 0.1 and more
    every = np.empty((first[-1], DIMENSIONS), np.float16)
    for i, used in enumerate(rows):
        every[first[i] : first[i + 1]] = features[i].descriptor[used]
    similarity = np.full((len(every), VOTES), -1, np.float32)
    voted = np.full((len(every), VOTES), -1, np.int32)
    image = np.repeat(np.arange(m), np.diff(first))
    if len(every):
        _search_cells(every, image, part, asking, similarity, voted, np.random.default_rng(seed))
    pairs = [np.zeros((0, 2), dtype=np.int64)]
    for i in np.flatnonzero(asking).tolist():
        there = voted[first[i] : first[i + 1]] >= 0
        # of unit vectors, divided by sqrt(2)
        distance = np.sqrt(np.maximum(1 - similarity[first[i] : first[i + 1]], 0))
        weight = np.max(distance, axis=1, keepdims=True, where=there, initial=0) - distance
        named = voted[first[i] : first[i + 1]][there]
        votes = np.bincount(named, weight[there], minlength=m)
        times = np.bincount(named, minlength=m)  # decides among copies, whose votes count nothing
        best = np.lexsort((-times, -votes))[:count]
        best = best[times[best] > 0]
        pairs.append(np.column_stack([np.full(len(best), i), best]))
    return np.concatenate(pairs)


def _search_cells(
    every: AnyArray,
    image: IntArray,
    part: IntArray,
    asking: BoolArray,
    similarity: AnyArray,
    voted: AnyArray,
    rng: np.random.Generator,
) -> None:
    """Fill in, for the features that ask, the photographs with the most similar features in their cells.

    Args:
        every: descriptors of all features, float16, (n, 128).
        image: photograph of each feature, (n,).
        part: see `similar_photographs`.
        asking: see `similar_photographs`.
        similarity: product with the most similar feature of each photograph, largest first, (n, VOTES).
        voted: these photographs, (n, VOTES).
        rng: generator that chooses the centres.
    """
    n = len(every)
    centres = np.sort(rng.choice(n, min(n, int(np.ceil(np.sqrt(CELLS * n)))), replace=False))
    cells = min(CELLS, len(centres))
    transposed = np.ascontiguousarray(every[centres].astype(np.float32).T)
    nearest = np.empty((n, cells), np.int32)
    for begin in range(0, n, BLOCK):
        product = every[begin : begin + BLOCK].astype(np.float32) @ transposed
        for column in range(cells):
            best = product.argmax(axis=1)
            nearest[begin : begin + BLOCK, column] = best
            product[np.arange(len(product)), best] = -np.inf
    members = np.argsort(nearest[:, 0], kind="stable")
    of_cell = np.searchsorted(nearest[members, 0], np.arange(len(centres) + 1))
    features = np.flatnonzero(asking[image])
    searched = nearest[features].ravel()
    order = np.argsort(searched, kind="stable")
    searching, of_searched = (
        features[order // cells],
        np.searchsorted(searched[order], np.arange(len(centres) + 1)),
    )
    for cell in range(len(centres)):
        inside = members[of_cell[cell] : of_cell[cell + 1]]
        transposed = np.ascontiguousarray(every[inside].astype(np.float32).T)
        for begin in range(of_searched[cell], of_searched[cell + 1], BLOCK):
            rows = searching[begin : min(begin + BLOCK, of_searched[cell + 1])]
            product = every[rows].astype(np.float32) @ transposed
            _insert_similar(product, rows, image[inside], part[image[rows]], part, similarity, voted)


@compiled
def _insert_similar(
    product: AnyArray,
    rows: IntArray,
    photograph: IntArray,
    own: IntArray,
    part: IntArray,
    similarity: AnyArray,
    voted: AnyArray,
) -> None:
    """Insert the photographs of some features among those most similar to others, each photograph once.

    Args:
        product: similarity of features that search to those of a cell, (r, c).
        rows: the features that search, (r,).
        photograph: photograph of each feature of the cell, (c,).
        own: part of each feature that searches; its photographs are not inserted, (r,).
        part: part of each photograph, (m,).
        similarity: those of the photographs found for all features, largest first, (n, VOTES).
        voted: these photographs, (n, VOTES).
    """
    last = similarity.shape[1] - 1
    for i in range(len(rows)):
        best, of_best = similarity[rows[i]], voted[rows[i]]
        for j in range(len(photograph)):
            value = product[i, j]
            if value <= best[last] or part[photograph[j]] == own[i]:
                continue
            place = 0
            while place < last and of_best[place] != photograph[j]:
                place += 1
            if of_best[place] == photograph[j] and best[place] >= value:
                continue
            while place > 0 and best[place - 1] < value:
                best[place], of_best[place] = best[place - 1], of_best[place - 1]
                place -= 1
            best[place], of_best[place] = value, photograph[j]
