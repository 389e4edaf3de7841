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


class _OfPart(NamedTuple):
    """The test of one held parameter in one part."""

    part: int  # its number
    own: Alternative
    unit: float  # of the parameter, for one unit of its column
    slope: FloatArray  # along the column at the residuals, of each photograph, (m,)
    curvature: FloatArray  # change of the slope by one unit of the column, (m,)
    design_effect: float
    image_points: int  # number of those of the part

    @property
    def change(self) -> float:
        """Step of the parameter, in its unit."""
        return float(self.own.gain.beta[0]) * self.unit

    @property
    def information(self) -> float:
        """Inverse of the variance of the change."""
        return self.own.gain.value / self.change**2

    def scores(self, change: float) -> FloatArray:
        """Return what each photograph contributes to the slope along a change, after it, (m,)."""
        step = change / self.unit
        return step * (self.slope + step * self.curvature)


class SharedParameter(NamedTuple):
    """A held interior parameter, with the evidence of all parts together."""

    joint: Alternative  # its photographs are those of the parts, one after another; its step is in its unit
    of_parts: tuple[_OfPart, ...]  # the tests of the parts that determine it

    @property
    def change(self) -> float:
        """Change of the parameter, in its unit."""
        return float(self.joint.gain.beta[0])


class SharedEvidence:
    """Evidence of the parts of a network on the held interior parameters of its cameras.

    The parts have only cameras in common.
    """

    def __init__(self) -> None:
        """Start without parts."""
        self._of_parameter: dict[tuple[str, str], list[_OfPart]] = {}
        self._parts = 0

    def add(self, part: Reduced) -> None:
        """Add the evidence of a part."""
        cameras = part.adjustment.estimate.cameras
        for interior in interiors(part, HELD):
            if len(interior.gain.beta) > 1:
                continue
            index, s = interior.parameters[0]
            columns, _, (unit,) = interior_columns(part.adjustment, interior.parameters)
            D = part.whiten(columns)
            left = part.absorb(D)[2][:, :, 0]
            m = part.photographs
            test = _OfPart(
                self._parts,
                interior.priced(part),
                unit,
                np.bincount(part.image, (part.v * left).sum(axis=1), minlength=m).astype(float),
                np.bincount(part.image, (left**2).sum(axis=1), minlength=m).astype(float),
                part.design_effect(D),
                len(part.image),
            )
            owner = cameras[index].owner_of(s), cameras[index].names[s]
            self._of_parameter.setdefault(owner, []).append(test)
        self._parts += 1

    def together(self, level: float) -> list[SharedParameter]:
        """Return each held parameter with the evidence of all parts.

        Args:
            level: probability that parts which agree are taken for contradicting ones.
        """
        return [_together(tests, level) for tests in self._of_parameter.values()]


def _together(tests: Sequence[_OfPart], level: float) -> SharedParameter:
    """Return one parameter with the evidence of the parts that determine it."""
    change = np.array([test.change for test in tests])
    information = np.array([test.information for test in tests])
    total = float(information.sum())
    mean = float(information @ change) / total
    apart = float(information @ (change - mean) ** 2)
    first = tests[0].own
    if len(tests) == 1:
        spread = first.spread
    elif apart > chi2_isf(level, len(tests) - 1):
        spread = Spread(apart / (len(tests) - 1), len(tests) - 1, among=False)
    else:  # of all photographs along the common change, over that expected by chance
        scores = np.concatenate([test.scores(mean) for test in tests])
        m = len(scores)
        spread = Spread(float(scores @ scores) / (total * mean**2) * m / (m - 1), m - 1, among=False)
    joint = replace(
        first,
        factor=np.concatenate([test.own.factor for test in tests]),
        parameters=tuple(dict.fromkeys(pair for test in tests for pair in test.own.parameters)),
        gain=Gain(total * mean**2, 1, np.array([mean])),
        spread=spread,
        price=price_of(1, sum(test.image_points for test in tests), first.search),
        redundancy=sum(test.own.redundancy for test in tests),
        design_effect=float(information @ [test.design_effect for test in tests]) / total,
    )
    return SharedParameter(joint, tuple(tests))


def of_all_parts(said: Sequence[Remark]) -> tuple[Remark, ...]:
    """Return one remark for those of several parts that claim the same of other points or photographs."""
    groups: dict[object, list[Remark]] = {}
    for of_part in said:
        claim = {role: names for role, names in of_part.subjects.items() if role not in LISTS}
        signs = tuple((name, quantity.value > 0) for name, quantity in of_part.numbers.items())
        groups.setdefault((of_part.kind, tuple(claim.items()), signs), []).append(of_part)
    return tuple(together(group) for group in groups.values())
