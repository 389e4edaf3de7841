"""Parts of a large network, whose assumptions are tested one after another.

The tests need dense normal equations, whose time grows with the cube of the photographs. A network is halved
where fewest photographs have points in common, and so are its halves. The level of a question is divided by
the number of parts and one, for all of them together: what the cameras of all parts share has less evidence
in each. Its estimates by the parts are therefore combined, with their information as weights. Free parameters
of the cameras are eliminated in each part alone, so this states less evidence than the whole network has.
Parts that contradict each other are no evidence for a common value: their scatter then takes the place of
that of single photographs.

Source: George (1973), SIAM J. Numer. Anal. 10(2) (dissection); Bonferroni's inequality; Koch (1999),
Parameter Estimation and Hypothesis Testing in Linear Models, sec. 3.2 (weighted mean); Cochran (1954),
Biometrics 10 (scatter of estimates of one value).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from sfm.adjustment.engine.solvers.fronts import halve
from sfm.adjustment.result import Adjustment
from sfm.judgement.hypotheses.alternatives import interiors
from sfm.judgement.hypotheses.columns import interior_columns
from sfm.judgement.hypotheses.families import HELD, Alternative
from sfm.judgement.hypotheses.score import Gain, Reduced, Spread
from sfm.model.conventions import BoolArray, FloatArray
from sfm.model.distributions import chi2_isf
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


class SharedParameter(NamedTuple):
    """A held interior parameter, with the evidence of all parts together."""

    joint: Alternative  # its photographs are those of the parts, one after another
    change: float  # of the parameter, in its unit
    of_parts: tuple[tuple[int, Alternative], ...]  # number of each part that determines it, and its own test

    def step_in(self, part: Alternative, a: Adjustment) -> FloatArray:
        """Return the change in the unit of the column of a part, (1,)."""
        return np.array([self.change / interior_columns(a, part.parameters)[2][0]])


def held_parameters(parts: Sequence[Reduced]) -> list[SharedParameter]:
    """Return each held interior parameter with the evidence of all parts together.

    Args:
        parts: networks that have only cameras in common.
    """
    of_parameter: dict[tuple[str, str], list[tuple[int, Alternative]]] = {}
    for p, part in enumerate(parts):
        cameras = part.adjustment.estimate.cameras
        for interior in interiors(part, HELD):
            if len(interior.gain.beta) == 1:
                index, s = interior.parameters[0]
                of_both = cameras[index].owner_of(s), cameras[index].names[s]
                of_parameter.setdefault(of_both, []).append((p, interior.priced(part)))
    return [_together(parts, of_parts) for of_parts in of_parameter.values()]


def _together(parts: Sequence[Reduced], of_parts: Sequence[tuple[int, Alternative]]) -> SharedParameter:
    """Return one parameter with the evidence of the parts that determine it."""
    every = [alternative for _, alternative in of_parts]
    units = np.array([interior_columns(parts[p].adjustment, own.parameters)[2][0] for p, own in of_parts])
    change = np.array([own.gain.beta[0] for own in every]) * units
    information = np.array([own.gain.value for own in every]) / change**2
    total = float(information.sum())
    mean = float(information @ change) / total
    level = parts[0].adjustment.levels.family
    apart = float(information @ (change - mean) ** 2)
    if len(every) > 1 and apart > chi2_isf(level, len(every) - 1):
        spread = Spread(apart / (len(every) - 1), len(every) - 1, among=False)
    else:
        scores, photographs = 0.0, 0
        for (p, own), unit in zip(of_parts, units, strict=True):
            step = own.whitened(parts[p])[:, :, 0] * (mean / unit)
            scores += float((parts[p].scores(step, step) ** 2).sum())
            photographs += parts[p].photographs
        m = max(photographs, 2)
        spread = Spread(scores / (total * mean**2) * m / (m - 1), m - 1, among=False)
    if len(every) == 1:
        spread = every[0].spread
    search = every[0].search
    joint = replace(
        every[0],
        factor=np.concatenate([own.factor for own in every]),
        parameters=tuple(dict.fromkeys(pair for own in every for pair in own.parameters)),
        gain=Gain(total * mean**2, 1, np.array([mean])),
        spread=spread,
        price=price_of(1, sum(len(parts[p].image) for p, _ in of_parts), search),
        redundancy=sum(own.redundancy for own in every),
    )
    if joint.evidence_beside_spread > 0:  # else it is not significant in any case
        effects = [parts[p].design_effect(own.whitened(parts[p])) for p, own in of_parts]
        joint = replace(joint, design_effect=float(information @ effects) / total)
    return SharedParameter(joint, mean, tuple(of_parts))


def of_all_parts(said: Sequence[Remark]) -> tuple[Remark, ...]:
    """Return one remark for those of several parts that claim the same of other points or photographs."""
    groups: dict[object, list[Remark]] = {}
    for of_part in said:
        claim = {role: names for role, names in of_part.subjects.items() if role not in LISTS}
        signs = tuple((name, quantity.value > 0) for name, quantity in of_part.numbers.items())
        groups.setdefault((of_part.kind, tuple(claim.items()), signs), []).append(of_part)
    return tuple(together(group) for group in groups.values())
