"""Parts of a large network, whose assumptions are tested one after another.

The tests need dense normal equations, whose time grows with the cube of the photographs. A part has
photographs that show the same points: they follow one another in the order of Cuthill and McKee, which
numbers neighbours near one another. The level of a question is divided by the number of parts.

Source: Cuthill and McKee (1969), Proc. 24th ACM National Conference (order); Bonferroni's inequality.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee

from sfm.model.conventions import BoolArray
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network
from sfm.model.reduced_network import reduce_network
from sfm.model.remarks.remark import Remark, together

MIN_RAYS = 2  # of a point in a part


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
    order = reverse_cuthill_mckee(csr_matrix(shows @ shows.T), symmetric_mode=True)
    photographs = np.bincount(moment)[order]
    count = int(np.ceil(len(network.images) / most))
    # parts as large as one another
    part = np.minimum(np.cumsum(photographs) * count // (len(network.images) + 1), count - 1)
    of_moment = np.empty(len(order), dtype=np.int64)
    of_moment[order] = part
    return [np.asarray(of_moment[moment] == k) for k in range(count)]


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


def of_all_parts(said: Sequence[Remark]) -> tuple[Remark, ...]:
    """Return one remark for those of several parts that are of one kind, and of one camera if it has one."""
    groups: dict[tuple[str, tuple[str, ...]], list[Remark]] = {}
    for of_part in said:
        camera = of_part.names("camera") if "camera" in of_part.subjects else ()
        groups.setdefault((of_part.kind, camera), []).append(of_part)
    return tuple(together(group) for group in groups.values())
