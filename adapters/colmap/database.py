"""COLMAP databases with our image points: cameras, photographs, keypoints and matches.

A database holds no object points. Which keypoints show the same point is said by matches of pairs of
photographs, so points are written as matches between all photographs they were measured in and read back as
the connected parts of the graph of matches. Keypoints are single precision: 1e-4 px at 2000 px.

Source: COLMAP 4.2 documentation, "Database Format".
"""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from adapters.colmap.adjuster import load_pycolmap, quiet, told
from adapters.colmap.scene import HALF_PIXEL, camera_of, colmap_camera
from adapters.formats.json_files import MAX_SIDE_PX
from sfm.camera import Camera
from sfm.conventions import IntArray
from sfm.errors import OutputError, SurveyFileError
from sfm.files.csv_tables import MAX_NUMBER, MAX_TABLE_BYTES
from sfm.files.whole_files import refuse_full, whole_file
from sfm.network import ImagePoints, Network

TABLES = ("cameras", "images", "keypoints", "matches", "two_view_geometries")
SQLITE_HEADER_BYTES = 100


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
        BackendError: pycolmap is missing, or a camera model that Kolinear has no equal of.
        SurveyFileError: not a readable database.
    """
    pycolmap = load_pycolmap()
    with quiet(pycolmap), _checked_copy(Path(path)) as copy:
        try:
            database = pycolmap.Database.open(str(copy))
            found = sorted(database.read_all_cameras(), key=lambda camera: camera.camera_id)
            images = sorted(database.read_all_images(), key=lambda image: image.image_id)
            keypoints = [database.read_keypoints(image.image_id)[:, :2] for image in images]
            pairs = _matches(pycolmap, database, [image.image_id for image in images])
            database.close()
        except (OSError, RuntimeError, ValueError, IndexError) as error:
            raise SurveyFileError(f"{path}: not a readable COLMAP database ({told(error)})") from error
    for camera in found:
        if not (1 <= camera.width <= MAX_SIDE_PX and 1 <= camera.height <= MAX_SIDE_PX):
            raise SurveyFileError(
                f"{path}: camera {camera.camera_id} has photographs of {camera.width} x {camera.height} px, "
                f"needed 1 to {MAX_SIDE_PX} on each side"
            )
    for image, xy in zip(images, keypoints, strict=True):
        if not (np.abs(xy) <= MAX_NUMBER).all():
            raise SurveyFileError(
                f"{path}: a keypoint of {image.name} is no finite number of at most {MAX_NUMBER:g}"
            )
    camera_ids = [camera.camera_id for camera in found]
    first = np.concatenate([[0], np.cumsum([len(points) for points in keypoints])]).astype(np.int64)
    edges = [(first[a] + matches[:, 0], first[b] + matches[:, 1]) for a, b, matches in pairs]
    if any(len(e) and e.max() >= first[-1] for edge in edges for e in edge):
        raise SurveyFileError(f"{path}: a match names a keypoint that is not there")
    image = np.repeat(np.arange(len(images)), np.diff(first))
    point = _tracks(edges, image)
    kept = np.flatnonzero(point >= 0)
    xy = np.concatenate([np.zeros((0, 2)), *keypoints]).astype(float) - HALF_PIXEL
    count = int(point.max(initial=-1)) + 1
    network = Network(
        tuple(one.name for one in images),
        np.array([camera_ids.index(one.camera_id) for one in images], dtype=np.int64),
        tuple(f"{j + 1}" for j in range(count)),
        ImagePoints(image[kept], point[kept], xy[kept], np.tile(np.eye(2), (len(kept), 1, 1))),
    )
    return network, tuple(camera_of(camera) for camera in found)


@contextmanager
def _checked_copy(path: Path) -> Iterator[Path]:
    """Give a copy of a whole COLMAP database: whoever opens one writes into it, and into files beside it.

    Source: sqlite.org/fileformat.html, sec. 1.3, for the header.
    """
    try:
        if not path.is_file():
            raise SurveyFileError(f"{path}: there is no such file")
        with path.open("rb") as file:
            header = file.read(SQLITE_HEADER_BYTES)
        size = path.stat().st_size
        if size > MAX_TABLE_BYTES:
            raise SurveyFileError(f"{path}: {size} bytes, at most {MAX_TABLE_BYTES} are read")
    except OSError as error:
        raise SurveyFileError(f"{path}: cannot be read ({error.strerror})") from error
    if header[:16] != b"SQLite format 3\0" or len(header) < SQLITE_HEADER_BYTES:
        raise SurveyFileError(f"{path}, line 1: not a COLMAP database (no SQLite file)")
    page = int.from_bytes(header[16:18], "big")
    whole = (65536 if page == 1 else page) * int.from_bytes(header[28:32], "big")
    if size < whole:
        raise SurveyFileError(
            f"{path}: the file is cut off, it has {size} of the {whole} bytes that its header says"
        )
    with tempfile.TemporaryDirectory(prefix="kolinear-database-") as folder:
        copy = Path(folder) / "copy.db"
        try:
            shutil.copyfile(path, copy)
            log = path.with_name(f"{path.name}-wal")  # what SQLite has not yet taken over
            if log.is_file() and log.stat().st_size <= MAX_TABLE_BYTES:
                shutil.copyfile(log, f"{copy}-wal")
        except OSError as error:
            raise SurveyFileError(f"{path}: cannot be read ({error.strerror})") from error
        _check_tables(copy, path)
        yield copy


def _check_tables(copy: Path, path: Path) -> None:
    """Refuse the copy of a database that is damaged or not COLMAP's."""
    try:
        database = sqlite3.connect(copy)
        try:
            damage = database.execute("PRAGMA quick_check(1)").fetchone()[0]
            tables = {row[0] for row in database.execute("SELECT name FROM sqlite_master")}
        finally:
            database.close()
    except sqlite3.Error as error:
        raise SurveyFileError(f"{path}: not a readable COLMAP database, {error}") from error
    if damage != "ok":
        raise SurveyFileError(f"{path}: the database is damaged, {' '.join(str(damage).split())[:200]}")
    missing = [name for name in TABLES if name not in tables]
    if missing:
        raise SurveyFileError(
            f"{path}: an SQLite file without the table {missing[0]}; a COLMAP database has "
            f"{', '.join(TABLES)}"
        )


def _fill(pycolmap: Any, database: Any, network: Network, cameras: tuple[Camera, ...]) -> None:
    """Write everything; cameras and photographs are numbered from 1, each photograph has its own frame."""
    for k, camera in enumerate(cameras):
        written = colmap_camera(pycolmap, camera, k + 1)
        database.write_camera(written, True)
        rig = pycolmap.Rig(rig_id=k + 1)
        rig.add_ref_sensor(written.sensor_id)
        database.write_rig(rig, True)
    seen = network.image_points
    slot = np.empty(len(seen), dtype=np.int64)
    for i, name in enumerate(network.images):
        camera_id = int(network.camera[i]) + 1
        image = pycolmap.Image(name=name, camera_id=camera_id, image_id=i + 1)
        database.write_image(image, True)
        frame = pycolmap.Frame(frame_id=i + 1, rig_id=camera_id)
        frame.add_data_id(image.data_id)
        database.write_frame(frame, True)
        rows = np.flatnonzero(seen.image == i)
        slot[rows] = np.arange(len(rows))
        xy = (seen.xy[rows] + HALF_PIXEL).astype(np.float32).reshape(-1, 2)
        database.write_keypoints(i + 1, xy)
    table = np.full((len(network.images), len(network.points)), -1, dtype=np.int64)
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


def _matches(pycolmap: Any, database: Any, image_ids: list[int]) -> list[tuple[int, int, IntArray]]:
    """Matches as (index of one photograph, of the other, keypoints (n, 2))."""
    pair_ids, tables = database.read_two_view_geometries()
    tables = [geometry.inlier_matches for geometry in tables]
    if not any(len(table) for table in tables):
        pair_ids, tables = database.read_all_matches()
    found = []
    for pair_id, table in zip(pair_ids, tables, strict=True):
        a, b = pycolmap.pair_id_to_image_pair(pair_id)
        found.append(
            (image_ids.index(a), image_ids.index(b), np.asarray(table, dtype=np.int64).reshape(-1, 2))
        )
    return found


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
