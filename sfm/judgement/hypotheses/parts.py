"""Parts of a large network, whose assumptions are tested one after another.

The tests need dense normal equations, whose time grows with the cube of the photographs. A network is halved
where fewest photographs have points in common, and so are its halves. The level of a question is divided by
the number of parts. What the cameras of all parts share has less evidence in each. The steps of one interior
parameter are therefore combined, with the information of each part as its weight.

Source: George (1973), SIAM J. Numer. Anal. 10(2) (dissection); Bonferroni's inequality; Koch (1999),
Parameter Estimation and Hypothesis Testing in Linear Models, sec. 3.2 (normal equations of groups add up).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from sfm.adjustment.engine.solvers.fronts import halve
from sfm.judgement.hypotheses.alternatives import interiors
from sfm.judgement.hypotheses.families import HELD, Alternative
from sfm.judgement.hypotheses.score import Gain, Reduced
from sfm.model.conventions import BoolArray
from sfm.model.estimate import Estimate
from sfm.model.likelihood import price_of
from sfm.model.network import ImagePoints, Network
from sfm.model.reduced_network import reduce_network
from sfm.model.remarks.remark import Remark, together

MIN_RAYS = 2  # of a point in a part
LISTS = ("points", "photographs")  # subjects that remarks of several parts have together


def parts_of(network: Network, used: BoolArray, most: int) -> list[BoolArray]:
    """Return parts of a network that together have all its photographs, each (m,).

    Photographs of one moment are in one part.

    Args:
        network: network of m photographs and k image points.
        used: image points that take part, (k,).
        most: number of photographs of a part, but for those of one moment.
    """
    seen = network.image_points.select(used)
    moment = np.arange(len(network.images)) if network.moment is None else network.moment
    moment = np.unique(moment, return_inverse=True)[1]
    shape = int(moment.max()) + 1, len(network.points)
    shows = csr_matrix((np.ones(len(seen), np.float32), (moment[seen.image], seen.point)), shape)
    common = csr_matrix(shows @ shows.T)
    photographs = np.bincount(moment).astype(float)
    parts, left = [], [np.arange(len(photographs))]
    while left:
        nodes = left.pop()
        graph = common[nodes][:, nodes]
        count, component = connected_components(graph, directed=False)
        if count > 1:
            left += [nodes[component == c] for c in range(count)]
        elif photographs[nodes].sum() > most and len(nodes) > 1:
            half = halve(graph, photographs[nodes])
            left += [nodes[half], nodes[~half]]
        else:
            parts.append(np.isin(moment, nodes))
    return parts


def reduced_to(
    network: Network, estimate: Estimate, used: BoolArray, parts: Iterable[BoolArray]
) -> Iterator[tuple[Network, Estimate, BoolArray]]:
    """Yield the network of each part, its estimate, and which image points of the whole it has, (k,).

    Cameras without a photograph in a part are held there.

    Args:
        network: network of m photographs and k image points.
        estimate: its estimate.
        used: image points that take part, (k,).
        parts: photographs of each part, (m,).
    """
    seen: ImagePoints = network.image_points
    for images in parts:
        rows = images[seen.image]
        points = np.bincount(seen.point[rows & used], minlength=len(network.points)) >= MIN_RAYS
        rows &= points[seen.point]
        part, start = reduce_network(network, estimate, images, points, np.ones_like(rows))
        cameras = tuple(
            camera if k in part.camera else replace(camera, free=np.zeros_like(camera.free))
            for k, camera in enumerate(start.cameras)
        )
        yield part, replace(start, cameras=cameras), rows


def held_parameters(parts: Sequence[Reduced]) -> list[Alternative]:
    """Return an alternative for each held interior parameter, with the evidence of all parts together.

    Its photographs are those of the parts, one after another.

    Args:
        parts: networks that have only cameras in common.
    """
    of_parameter: dict[tuple[tuple[int, int], ...], list[tuple[Alternative, Reduced]]] = {}
    for part in parts:
        for interior in interiors(part, HELD):
            if len(interior.gain.beta) == 1:
                of_parameter.setdefault(interior.parameters, []).append((interior.priced(part), part))
    return [_together(of_parts) for of_parts in of_parameter.values()]


def _together(of_parts: Sequence[tuple[Alternative, Reduced]]) -> Alternative:
    """Return the alternative of one parameter with the evidence of several parts."""
    every = [alternative for alternative, _ in of_parts]
    step = np.array([alternative.gain.beta[0] for alternative in every])
    information = np.array([alternative.gain.value for alternative in every]) / step**2
    total = float(information.sum())
    mean = float(information @ step) / total
    spread = every[0].spread
    spread = replace(
        spread,
        factor=float(information @ [alternative.spread.factor for alternative in every]) / total,
        redundancy=sum(alternative.spread.redundancy for alternative in every),
    )
    joint = replace(
        every[0],
        factor=np.concatenate([alternative.factor for alternative in every]),
        gain=Gain(total * mean**2, 1, np.array([mean])),
        spread=spread,
        price=price_of(1, sum(len(part.image) for _, part in of_parts), every[0].search),
        redundancy=sum(alternative.redundancy for alternative in every),
    )
    if not joint.evidence_beside_spread > 0:
        return joint  # not significant in any case
    effects = [part.design_effect(alternative.whitened(part)) for alternative, part in of_parts]
    return replace(joint, design_effect=float(information @ effects) / total)


def of_all_parts(said: Sequence[Remark]) -> tuple[Remark, ...]:
    """Return one remark for those of several parts that claim the same of other points or photographs."""
    groups: dict[object, list[Remark]] = {}
    for of_part in said:
        claim = {role: names for role, names in of_part.subjects.items() if role not in LISTS}
        signs = tuple((name, quantity.value > 0) for name, quantity in of_part.numbers.items())
        groups.setdefault((of_part.kind, tuple(claim.items()), signs), []).append(of_part)
    return tuple(together(group) for group in groups.values())
