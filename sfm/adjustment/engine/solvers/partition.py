"""Cuts a network into blocks of photographs, each with the image points that only it needs.

The photographs of the interface, the separators of a dissection (`fronts`), stand between the blocks: no
object point is seen from the inner photographs of two blocks. So each block can eliminate its inner
photographs and object points by itself. The photographs of the interface, interior orientation, mounts and
kept points are common to all blocks. Photographs that observations couple with one another belong to the
interface, too.

Photographs without image points are set aside before the network is cut, and are inner photographs of the
first block.

An object point belongs to the block of its inner photographs. The image points of a kept point go with their
photographs, because its coordinates are common.

Source: Helmert (1880); Wolf (1978); George (1973), SIAM J. Numer. Anal. 10(2).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_matrix

from sfm.adjustment.engine.collinearity import Observations, State
from sfm.adjustment.engine.solvers.fronts import split
from sfm.adjustment.engine.unknowns import Unknowns
from sfm.model.conventions import AnyArray, FloatArray, IntArray


@dataclass(frozen=True)
class Piece:
    """A block of photographs: where its unknowns and image points are in the network.

    Its poses are the inner ones, then those of the interface that its image points or its share of the kept
    points need. Its other reduced unknowns are those of the network.
    """

    inner: int  # number of inner poses, which come first
    poses: IntArray  # pose in the network of each of its poses, (poses,)
    images: IntArray  # photograph in the network of each of its photographs, (m,)
    points: IntArray  # object point in the network of each of its object points, (n,)
    rays: IntArray  # image point in the layout of the network of each of its image points, (k,)
    columns: IntArray  # reduced unknown of the network of each of its reduced unknowns, (reduced,)
    at: IntArray  # place among the unknowns of the interface of those after the inner ones, (6 r + b,)
    kept: IntArray  # places of the kept points among its object points, (s,)

    @property
    def own(self) -> IntArray:
        """Reduced unknowns of the network that the block eliminates, (6 inner,)."""
        return self.columns[: 6 * self.inner]

    def state(self, state: State) -> State:
        """Return the values of its own parameters.

        Args:
            state: values of all parameters of the network.
        """
        position, M = state.position[self.images], state.M[self.images]
        of_poses = position, M
        if state.pose_position is not state.position:
            of_poses = state.pose_position[self.poses], state.rig_from_object[self.poses]
        points = state.points[self.points]
        mounts = state.mount_position, state.camera_from_rig
        return State(position, M, state.parameters, points, *of_poses, *mounts)


@dataclass(frozen=True)
class Partition:
    """A network cut into blocks."""

    pieces: tuple[Piece, ...]
    poses: IntArray  # poses of the interface, ascending, (r,)
    columns: IntArray  # reduced unknowns of the interface: of its poses, then the border, (6 r + b,)


def graph_of(observations: Observations, kept: IntArray) -> csr_matrix:
    """Return the graph of the poses, nonzero where two see a point that is eliminated, (poses, poses).

    Args:
        observations: image points.
        kept: object points that are not eliminated, (s,).
    """
    ordinary = np.ones(len(observations.start) - 1, dtype=bool)
    ordinary[kept] = False
    on = ordinary[observations.point]
    pose, point = observations.pose[on], observations.point[on]
    ones = np.ones(len(pose), dtype=np.int32)
    sees = csr_matrix((ones, (pose, point)), shape=(observations.poses, len(ordinary)))
    return csr_matrix(sees @ sees.T)


def partition_of(layout: Unknowns, count: int, coupled: IntArray) -> Partition | None:
    """Return a network cut into blocks; None if it has no small separator.

    Args:
        layout: order of the unknowns.
        count: number of blocks; there are fewer if small separators are rare.
        coupled: poses that observations couple with one another.
    """
    o, first = layout.observations, layout.pose_free.size
    block = _blocks_of_poses(graph_of(o, layout.kept), np.unique(o.pose), count, coupled)
    blocks = int(block.max(initial=-1)) + 1
    if blocks < 2:
        return None
    kept = np.zeros(len(layout.point_free), dtype=bool)
    kept[layout.kept] = True
    interface = np.flatnonzero(block < 0)
    of_point = np.full(len(kept), -1)
    np.maximum.at(of_point, o.point, block[o.pose])
    needs = np.flatnonzero((block[o.pose] < 0) & (of_point[o.point] >= 0) & ~kept[o.point])
    owner = np.zeros(len(block), dtype=np.int64)  # block that has what only poses of the interface see
    owner[o.pose[needs]] = of_point[o.point[needs]]
    alone = np.flatnonzero((of_point[o.point] < 0) & ~kept[o.point])
    of_point[o.point[alone]] = owner[o.pose[alone]]
    of_point = np.maximum(of_point, 0)  # points that no image point sees
    of_ray = np.where(
        kept[o.point], np.where(block[o.pose] < 0, owner[o.pose], block[o.pose]), of_point[o.point]
    )
    place = np.full(layout.reduced, -1)
    columns = np.concatenate([_six(interface), np.arange(first, layout.reduced)])
    place[columns] = np.arange(len(columns))
    pieces = []
    for b in range(blocks):
        rays = np.flatnonzero(of_ray == b)
        on = np.zeros(len(block), dtype=bool)
        on[o.pose[rays]] = True
        outer = np.flatnonzero((block < 0) & (on | (owner == b)))
        poses = np.concatenate([np.flatnonzero(block == b), outer])
        points = np.flatnonzero((of_point == b) | kept)
        pieces.append(_piece(layout, poses, len(poses) - len(outer), points, rays, place))
    return Partition(tuple(pieces), interface, columns)


def _blocks_of_poses(graph: csr_matrix, seeing: IntArray, count: int, coupled: IntArray) -> IntArray:
    """Return the block of each pose, -1 at the interface; the largest block is cut until there are enough.

    Args:
        graph: nonzero where two poses see a point that is eliminated, (poses, poses).
        seeing: poses with image points; the others are no reason to cut.
        count: number of blocks.
        coupled: poses that observations couple with one another.
    """
    to_cut = np.setdiff1d(seeing, coupled)
    parts, whole = [to_cut] if len(to_cut) else [], list[IntArray]()
    while parts and len(parts) + len(whole) < count:
        largest = parts.pop(int(np.argmax([len(part) for part in parts])))
        halves = split(graph[largest][:, largest])
        if halves is None:
            whole.append(largest)
        else:
            parts += [largest[half] for half in halves[:2]]
    block = np.zeros(graph.shape[0], dtype=np.int64)
    block[seeing] = block[coupled] = -1
    for b, part in enumerate(sorted(parts + whole, key=lambda part: int(part[0]))):
        block[part] = b
    return block


def _six(poses: IntArray) -> IntArray:
    """Return the columns of the unknowns of some poses, (6 p,)."""
    columns: IntArray = (6 * poses[:, None] + np.arange(6)).ravel()
    return columns


def _piece(
    layout: Unknowns, poses: IntArray, inner: int, points: IntArray, rays: IntArray, place: IntArray
) -> Piece:
    """Return the block of some poses, object points and image points of a network."""
    o, first = layout.observations, layout.pose_free.size
    pose_at = np.full(o.poses, -1)
    pose_at[poses] = np.arange(len(poses))
    images = np.flatnonzero(pose_at[o.pose_of] >= 0)
    images = images[np.argsort(pose_at[o.pose_of[images]], kind="stable")]
    columns = np.concatenate([_six(poses), np.arange(first, layout.reduced)])
    kept = np.searchsorted(points, layout.kept)
    return Piece(inner, poses, images, points, rays, columns, place[columns[6 * inner :]], kept)


def layout_of(layout: Unknowns, piece: Piece) -> Unknowns:
    """Return the layout of the unknowns of a block, with its image points as they are sent.

    What the process of the block can derive is left out, so that an image point takes 20 to 52 bytes;
    `unpacked` restores it.

    Args:
        layout: order of the unknowns of the network.
        piece: the block.
    """
    o, rays, images = layout.observations, piece.rays, piece.images
    pose_at, image_at = np.full(o.poses, -1), np.full(len(o.pose_of), -1)
    pose_at[piece.poses], image_at[images] = np.arange(len(piece.poses)), np.arange(len(images))
    image: AnyArray = image_at.astype(np.int32)[o.image[rays]]
    point = np.searchsorted(piece.points, o.point[rays])
    start = np.zeros(len(piece.points) + 1, dtype=np.int64)
    np.cumsum(np.bincount(point, minlength=len(piece.points)), out=start[1:])
    shift = 6 * len(piece.poses) - layout.pose_free.size
    observations = o._replace(
        start=start,
        image=image,
        point=np.zeros(0, dtype=np.int64),
        xy=o.xy[rays],
        whitening=packed(o.whitening[rays]),
        share=packed(o.share[rays]),
        camera=o.camera[images],
        pose=np.zeros(0, dtype=np.int64),
        pose_of=pose_at[o.pose_of[images]],
        poses=len(piece.poses),
        free_column=np.maximum(o.free_column + shift, 0),
    )
    return replace(
        layout,
        observations=observations,
        order=np.zeros(0, dtype=np.int64),  # needed by the network only
        active=np.zeros(0, dtype=bool),
        pose_free=layout.pose_free[piece.poses],
        interior_column=tuple(column + shift for column in layout.interior_column),
        mount_column=np.where(layout.mount_column >= 0, layout.mount_column + shift, -1),
        point_free=layout.point_free[piece.points],
        image_on=layout.image_on[images],
        point_on=layout.point_on[piece.points],
        kept=piece.kept,
        reduced=layout.reduced + shift,
        held=(),
        held_defect=0,
    )


def unpacked(layout: Unknowns) -> Unknowns:
    """Return the layout of a block with all that was left out for sending.

    Args:
        layout: what `layout_of` returned.
    """
    o, k = layout.observations, len(layout.observations.xy)
    image = o.image.astype(np.int64)
    observations = o._replace(
        image=image,
        point=np.repeat(np.arange(len(o.start) - 1), np.diff(o.start)),
        pose=o.pose_of[image],
        whitening=repeated(o.whitening, k),
        share=repeated(o.share, k),
    )
    return replace(layout, observations=observations)


def packed(rows: FloatArray) -> FloatArray:
    """Return rows to send: one row if all are equal."""
    return rows[:1] if len(rows) and (rows == rows[:1]).all() else rows


def repeated(rows: FloatArray, count: int) -> FloatArray:
    """Return all rows of what `packed` returned.

    Args:
        rows: one row or all.
        count: number of rows.
    """
    return rows if len(rows) == count else np.repeat(rows, count, axis=0)


def added_at(total: FloatArray, rows: IntArray, part: FloatArray) -> None:
    """Add the lower triangle of a block to that of the interface.

    Args:
        total: matrix to add to, (t, t).
        rows: places of the unknowns of the block, ascending, (q,).
        part: lower triangle, (q, q).
    """
    for row, to in enumerate(rows):  # without a copy as large as the part
        total[to, rows[: row + 1]] += part[row, : row + 1]
