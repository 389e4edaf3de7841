"""COLMAP databases with our image points: cameras, photographs, keypoints and matches.

A database holds no object points. Which keypoints show the same point is said by matches of pairs of
photographs, so points are written as matches between all photographs they were measured in and read back as
the connected parts of the graph of matches. Keypoints are single precision: 1e-4 px at 2000 px.

Source: COLMAP 4.2 documentation, "Database Format".
"""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from adapters.colmap.adjuster import load_pycolmap, quiet, told
from adapters.colmap.database_rows import read_rows
from adapters.colmap.reconstruction import HALF_PIXEL, as_opencv, camera_of, colmap_camera
from sfm.camera import Camera
from sfm.conventions import IntArray
from sfm.errors import OutputError
from sfm.files.whole_files import refuse_full, whole_file
from sfm.network import ImagePoints, Network, rows_of

MAX_PLACES = 100_000_000  # photographs times points, of which a table is kept


def write_database(path: Path, network: Network, cameras: tuple[Camera, ...]) -> None:
    """Write photographs, image points and their matches as a COLMAP database, ready for its mapper.

    Args:
        path: file to write; it must not be there yet.
        network: what was measured; names of points are lost.
        cameras: interior orientations, in an opencv model.

    Raises:
        BackendError: pycolmap is missing, or a camera is in a model that COLMAP does not know.
        OutputError: the file is there already or cannot be written.
    """
    pycolmap = load_pycolmap()
    if Path(path).exists():
        raise OutputError(f"{path}: there already is a file of this name")
    if len(network.images) * len(network.points) > MAX_PLACES:
        raise OutputError(
            f"{path}: {len(network.images)} photographs of {len(network.points)} points, databases are "
            f"written of at most {MAX_PLACES} of both multiplied"
        )
    with quiet(pycolmap), whole_file(path, "the database") as part:
        try:
            database = pycolmap.Database.open(str(part))
            _fill(pycolmap, database, network, cameras)
            database.close()
        except (RuntimeError, ValueError) as error:
            refuse_full(part.parent)
            raise OutputError(f"{path}: the database cannot be written: {told(error)}") from error


def read_database(path: Path) -> tuple[Network, tuple[Camera, ...]]:
    """Read photographs and image points of a COLMAP database, points from its matches.

    Verified matches are used where there are some, else the raw ones. Keypoints without a match and points
    that would be twice in one photograph are left out.

    Raises:
        BackendError: a camera model that Kolinear has no equal of.
        SurveyFileError: not a readable database.
    """
    rows = read_rows(path)
    first = np.concatenate([[0], np.cumsum([len(points) for points in rows.keypoints])]).astype(np.int64)
    edges = [(first[a] + matches[:, 0], first[b] + matches[:, 1]) for a, b, matches in rows.pairs]
    image = np.repeat(np.arange(len(rows.images)), np.diff(first))
    point = _tracks(edges, image)
    kept = np.flatnonzero(point >= 0)
    xy = np.concatenate([np.zeros((0, 2)), *rows.keypoints]) - HALF_PIXEL
    count = int(point.max(initial=-1)) + 1
    network = Network(
        rows.images,
        rows.camera,
        tuple(f"{j + 1}" for j in range(count)),
        ImagePoints(
            image[kept],
            point[kept],
            xy[kept],
            np.tile(np.eye(2), (len(kept), 1, 1)),
            np.zeros(len(kept), dtype=bool),
        ),
    )
    return network, tuple(as_opencv(camera_of(camera)) for camera in rows.cameras)


def _fill(pycolmap: Any, database: Any, network: Network, cameras: tuple[Camera, ...]) -> None:
    """Write everything; cameras and photographs are numbered from 1, each photograph has its own frame."""
    for k, camera in enumerate(cameras):
        written = colmap_camera(pycolmap, camera, k + 1)
        database.write_camera(written, True)
        rig = pycolmap.Rig(rig_id=k + 1)
        rig.add_ref_sensor(written.sensor_id)
        database.write_rig(rig, True)
    seen = network.image_points
    slot = np.empty(len(seen), dtype=np.int32)
    of_image = rows_of(seen.image, len(network.images))
    for i, name in enumerate(network.images):
        camera_id = int(network.camera[i]) + 1
        image = pycolmap.Image(name=name, camera_id=camera_id, image_id=i + 1)
        database.write_image(image, True)
        frame = pycolmap.Frame(frame_id=i + 1, rig_id=camera_id)
        frame.add_data_id(image.data_id)
        database.write_frame(frame, True)
        rows = of_image[i]
        slot[rows] = np.arange(len(rows))
        xy = (seen.xy[rows] + HALF_PIXEL).astype(np.float32).reshape(-1, 2)
        database.write_keypoints(i + 1, xy)
    table = np.full((len(network.images), len(network.points)), -1, dtype=np.int32)
    table[seen.image, seen.point] = slot
    for a, b in combinations(range(len(network.images)), 2):
        common = np.flatnonzero((table[a] >= 0) & (table[b] >= 0))
        if len(common):
            matches = np.stack([table[a, common], table[b, common]], axis=1).astype(np.uint32)
            database.write_matches(a + 1, b + 1, matches)
            geometry = pycolmap.TwoViewGeometry(
                config=pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED, inlier_matches=matches
            )
            database.write_two_view_geometry(a + 1, b + 1, geometry)


def _tracks(edges: list[tuple[IntArray, IntArray]], image: IntArray) -> IntArray:
    """Number of the point that each keypoint shows, -1 for none, (k,)."""
    count = len(image)
    if not edges:
        return np.full(count, -1)
    a, b = (np.concatenate(side) for side in zip(*edges, strict=True))
    _, part = connected_components(
        coo_matrix((np.ones(len(a)), (a, b)), shape=(count, count)), directed=False
    )
    size = np.bincount(part)
    twice = np.zeros(len(size), dtype=bool)
    order = np.lexsort((image, part))
    same = (part[order][1:] == part[order][:-1]) & (image[order][1:] == image[order][:-1])
    twice[part[order][1:][same]] = True
    good = (size[part] >= 2) & ~twice[part]
    # Points are counted in the order in which they first appear.
    names, where = np.unique(part[good], return_index=True)
    rank = np.empty(len(size), dtype=np.int64)
    rank[names[np.argsort(where)]] = np.arange(len(names))
    return np.where(good, rank[part], -1)
